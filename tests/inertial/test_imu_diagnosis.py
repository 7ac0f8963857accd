"""Diagnosis of whole units: each simulated fault is named, healthy units pass as often as asked, dead axes come first."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from railnav.errors import EstimationError
from railnav.inertial.imu_calibration import ImuCalibration
from railnav.inertial.imu_diagnosis import diagnose_imu, parameter_sigma
from railnav.inertial.procedure import calibrate_imu
from railnav.simulation.positions import simulate_positions

HOUR = math.radians(1.0) / 3600.0
SHORT = {"unit": "STIM300", "count": 18, "duration": 5.0}


def valid(seed: int) -> ImuCalibration:
    made = simulate_positions("multi-position", seed=seed, **SHORT)
    return calibrate_imu(made.logs, ["multi-position"], gravity=made.gravity, latitude=made.latitude).calibration


def later(seed: int, fault=None, series: int = 1, **options):
    made = simulate_positions("multi-position", seed=seed, series=series, fault=fault, **{**SHORT, **options})
    return {"logs": made.logs, "gravity": made.gravity, "latitude": made.latitude}


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (("accelerometer bias x", 0.05), "accelerometer bias x moved by +5."),
        (("accelerometer bias z", -0.05), "accelerometer bias z moved by -5."),
        (("accelerometer scale y", 0.005), "accelerometer scale y moved by +"),
        (("accelerometer misalignment xz", 0.01), "accelerometer misalignment xz moved by +"),
        (("gyroscope bias z", 60.0 * HOUR), "gyro bias z moved by +"),
    ],
)
@pytest.mark.parametrize("seed", [100, 103])
def test_the_sensor_that_failed_is_named(fault, words: str, seed: int) -> None:
    got = diagnose_imu(calibration=valid(seed), **later(seed, fault))
    assert not got.healthy
    assert len(got.failures) == 1, got.failures
    assert got.failures[0].startswith(words), got.failures
    assert "limit" in got.failures[0]


def test_healthy_units_pass() -> None:
    failed = sum(not diagnose_imu(calibration=valid(seed), **later(seed)).healthy for seed in range(200, 225))
    assert (
        failed <= 2
    )  # 0.1 % each triad is asked for; slow parts from series to series are not in the noise of five seconds


def test_change_is_that_of_the_specimen_with_an_honest_sigma() -> None:
    scores = []
    for seed in range(300, 320):
        got = diagnose_imu(calibration=valid(seed), **later(seed, ("accelerometer scale y", 0.004))).accelerometer
        truth = np.zeros(9)
        truth[4] = 0.004 / (1.0 + simulate_positions("multi-position", seed=seed, **SHORT).accelerometer.scale[1])
        scores.append((got.parameters - truth) / got.sigma)
    assert 0.4 < float(np.mean(np.square(scores))) < 1.6


def test_fewer_positions_control_but_do_not_isolate() -> None:
    call = later(100, ("accelerometer bias x", 0.05))
    got = diagnose_imu(calibration=valid(100), **{**call, "logs": call["logs"][:6]})
    assert got.accelerometer is None
    assert not got.healthy
    assert "which sensor it is needs more positions" in got.failures[0]
    assert "add positions with these axes up" in got.advice


def test_few_logs_of_a_gyro_with_a_large_bias_still_count_as_rest() -> None:
    made = simulate_positions("multi-position", seed=3, unit="L3G4200D", count=18, duration=5.0)
    assert np.linalg.norm(made.gyroscope.bias) > math.radians(15.0)
    unit = calibrate_imu(made.logs, ["multi-position"], gravity=made.gravity, latitude=made.latitude).calibration
    got = diagnose_imu(made.logs[:3], unit, gravity=made.gravity, latitude=made.latitude)
    assert got.names == ("01", "02", "03")
    assert got.healthy


def test_dead_axes_come_first_and_the_rest_is_still_judged() -> None:
    call = later(100)
    logs = list(call["logs"])
    x = logs[3].imu.gyro.copy()
    x[:, 1] = x[0, 1]
    logs[3] = replace(logs[3], imu=replace(logs[3].imu, gyro=x))
    f = np.clip(logs[5].imu.specific_force, -1e9, np.percentile(logs[5].imu.specific_force, 10, axis=0))
    logs[5] = replace(logs[5], imu=replace(logs[5].imu, specific_force=f))
    got = diagnose_imu(calibration=valid(100), **{**call, "logs": logs})
    assert "position 04: rate y is" in got.failures[0]
    assert "frozen or missing" in got.failures[0]
    assert len(got.names) == len(logs) - len({d.split(":")[0] for d in got.defects})
    assert got.accelerometer is not None


def test_tolerance_allows_what_a_switch_on_changes() -> None:
    call = later(100, ("accelerometer bias x", 0.05))
    assert not diagnose_imu(calibration=valid(100), **call).healthy
    assert diagnose_imu(calibration=valid(100), tolerance=6e-3, **call).healthy
    drift = later(100, ("gyroscope bias z", 60.0 * HOUR))
    assert diagnose_imu(calibration=valid(100), gyro_tolerance=100.0 * HOUR, **drift).healthy


def test_sigmas_of_a_calibration_in_the_order_of_the_causes() -> None:
    made = valid(100).accelerometer
    got = parameter_sigma(made, 9.81)
    np.testing.assert_allclose(got[:3], made.sigma_bias / 9.81)
    np.testing.assert_allclose(got[3:6], np.diagonal(made.sigma_matrix))
    # the two elements of a symmetric pair are one: the sum has twice the sigma
    np.testing.assert_allclose(got[6], 2.0 * made.sigma_matrix[0, 1], rtol=1e-9)


def test_directions_are_found_with_the_parameters() -> None:
    """Large changes, no noise: to first order alone the directions would be wrong by the change."""
    from railnav.inertial.imu_diagnosis import _nine

    rng = np.random.default_rng(1)
    up = rng.normal(size=(14, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    truth = np.array([0.01, -0.02, 0.015, 0.02, -0.01, 0.03, 0.02, -0.03, 0.01])
    half = 0.5 * truth[6:]
    response = np.array([[1.02, half[0], half[1]], [half[0], 0.99, half[2]], [half[1], half[2], 1.03]])
    got = _nine(9.81 * (up @ response.T + truth[:3]), 9.81, 1e-6, np.zeros(9), 1e-3, 0.0)
    np.testing.assert_allclose(got.parameters, truth, atol=1e-9)


def test_refusals_say_why() -> None:
    call = later(100)
    with pytest.raises(EstimationError, match="holds neither triad"):
        diagnose_imu(calibration=ImuCalibration("x"), **call)
    table = simulate_positions("modified-six-position", seed=1, unit="STIM300", duration=2.0)
    with pytest.raises(EstimationError, match="no position at rest"):
        diagnose_imu(table.logs, valid(100), gravity=table.gravity)
    moved = list(call["logs"])
    moved[0] = replace(moved[0], imu=replace(moved[0].imu, gyro=moved[0].imu.gyro + np.linspace(0, 0.3, 500)[:, None]))
    with pytest.raises(EstimationError, match="position 01: the triad moved"):
        diagnose_imu(calibration=valid(100), **{**call, "logs": moved})
    with pytest.raises(ValueError, match="gravity must be positive"):
        diagnose_imu(calibration=valid(100), **{**call, "gravity": -1.0})
