"""Calibration of whole units from sets of positions, their honesty over many specimens, and every refusal."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from railnav.errors import EstimationError
from railnav.inertial.imu_calibration import ImuCalibration, apply_calibration
from railnav.inertial.positions import PositionLog, cut_positions, position_result
from railnav.inertial.procedure import METHODS, calibrate_imu
from railnav.run import ImuStream
from railnav.simulation.positions import UNITS, SimulatedPositions, simulate_positions

HOUR = math.radians(1.0) / 3600.0


def calibrated(made: SimulatedPositions, *methods: str, **options):
    return calibrate_imu(made.logs, methods, gravity=made.gravity, latitude=made.latitude, **options)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("unit", UNITS)
def test_every_method_finds_every_unit(method: str, unit: str) -> None:
    made = simulate_positions(method, unit=unit, seed=5, duration=10.0)
    got = calibrated(made, method).calibration
    pairs = [("accelerometer", made.accelerometer), ("gyroscope", made.gyroscope)]
    found = [what for what, _ in pairs if getattr(got, what) is not None]
    assert found == (
        ["gyroscope"]
        if method.startswith("modified")
        else ["accelerometer"]
        if method == "turns"
        else ["accelerometer", "gyroscope"]
    )
    for what, truth in pairs:
        triad = getattr(got, what)
        if triad is None:
            continue
        assert np.all(np.abs(triad.bias - truth.bias) < 5.0 * triad.sigma_bias + 1e-12)
        if triad.method == "mean at rest":
            assert np.all(triad.sigma_matrix == 0.0)
            continue
        # a levelled face is off by half the square of its tilt; six positions do not see cross-axis terms at all
        spare = 0.01**2 if "six" in method else 0.0
        assert np.all(np.abs(triad.scale - truth.scale) < 5.0 * np.diagonal(triad.sigma_matrix) + spare + 2e-4)


def test_corrected_readings_are_gravity() -> None:
    made = simulate_positions("multi-position", unit="L3G4200D", seed=2, count=18)
    got = calibrated(made, "multi-position").calibration
    before = [np.linalg.norm(log.imu.specific_force.mean(axis=0)) - made.gravity for log in made.logs]
    after = [
        np.linalg.norm(apply_calibration(log.imu, got).specific_force.mean(axis=0)) - made.gravity for log in made.logs
    ]
    assert np.abs(before).max() > 0.1
    assert np.abs(after).max() < 2e-3


@pytest.mark.parametrize("method", ["multi-position", "modified-multi-position"])
def test_stated_sigmas_are_honest_over_specimens(method: str) -> None:
    what = "gyroscope" if method.startswith("modified") else "accelerometer"
    scores = []
    for seed in range(40):
        made = simulate_positions(method, unit="STIM300", seed=seed, count=18, duration=5.0, levelling=0.0)
        triad = getattr(calibrated(made, method).calibration, what)
        scores.append((triad.bias - getattr(made, what).bias) / triad.sigma_bias)
    # mean of 120 squares; the sigmas are the larger of noise and residual, so a little on the safe side
    assert 0.6 < float(np.mean(np.square(scores))) < 1.35


def test_repeated_faces_know_the_slow_parts() -> None:
    """In-run biases change from face to face: six faces cannot tell, twelve can, and their sigmas are honest."""
    once, twice = [], []
    for seed in range(30):
        series = [
            simulate_positions("six-position", unit="STIM300", seed=seed, duration=20.0, series=k) for k in (0, 1)
        ]
        truth = series[0].accelerometer.bias
        one = calibrated(series[0], "six-position")
        assert any("take each face twice" in remark for remark in one.remarks)
        logs = series[0].logs + tuple(replace(log, name=f"{log.name}b") for log in series[1].logs)
        two = calibrate_imu(logs, ["six-position"], gravity=series[0].gravity, latitude=series[0].latitude)
        assert not any("twice" in remark for remark in two.remarks)
        for kept, got in ((once, one), (twice, two)):
            triad = got.calibration.accelerometer
            kept.append((triad.bias - truth) / triad.sigma_bias)
    assert float(np.mean(np.square(twice))) < 1.6
    assert float(np.mean(np.square(once))) > 1.5 * float(np.mean(np.square(twice)))


def test_both_triads_in_one_go_and_what_is_kept() -> None:
    still = simulate_positions("multi-position", seed=3, count=12, duration=5.0)
    table = simulate_positions("modified-multi-position", seed=3, count=12, duration=5.0)
    logs = still.logs + tuple(replace(log, name=f"t{log.name}") for log in table.logs)
    got = calibrate_imu(
        logs, ["multi-position", "modified-multi-position"], gravity=still.gravity, latitude=still.latitude
    )
    assert got.calibration.gyroscope.method == "modified multi-position, symmetric"
    assert got.calibration.accelerometer.positions == 12
    only = calibrated(table, "modified-multi-position", keep=got.calibration).calibration
    np.testing.assert_array_equal(only.accelerometer.bias, got.calibration.accelerometer.bias)
    assert "kept" in only.provenance.note


def test_temperature_polynomials_follow_the_sheet() -> None:
    made = simulate_positions(
        "multi-position", unit="L3G4200D", seed=4, count=9, duration=10.0, temperatures=[263.15, 283.15, 303.15, 323.15]
    )
    got = calibrated(made, "multi-position", temperature_degree=1).calibration
    warm = got.accelerometer_temperature
    slope = np.diff(warm.bias.at(np.array([283.15, 303.15])), axis=0)[0] / 20.0
    sigma = warm.bias.sigma_at(303.15)
    assert np.all(np.abs(slope - made.accelerometer.bias_temperature) < 5.0 * sigma / 10.0)
    assert np.abs(made.accelerometer.bias_temperature).max() > 1e-3
    # the matrix stands for the reference temperature: its scales are the polynomial's there
    np.testing.assert_allclose(got.accelerometer.scale, warm.scale.at(warm.reference), atol=1e-12)
    np.testing.assert_allclose(got.accelerometer.bias, warm.bias.at(warm.reference), atol=1e-12)
    log = made.logs[-1]
    length = np.linalg.norm(apply_calibration(log.imu, got).specific_force.mean(axis=0))
    assert length == pytest.approx(made.gravity, abs=5e-3)
    cold = replace(log.imu, temperature=None)
    with pytest.raises(EstimationError, match="no temperature_c"):
        apply_calibration(cold, got)
    with pytest.raises(EstimationError, match="position 01 has no temperature"):
        calibrate_imu(
            [replace(one, imu=replace(one.imu, temperature=None)) for one in made.logs],
            ["multi-position"],
            gravity=made.gravity,
            temperature_degree=1,
        )


def test_one_long_log_is_cut_where_it_rests() -> None:
    made = simulate_positions("multi-position", seed=6, count=10, duration=8.0)
    rng = np.random.default_rng(1)
    w, f = [], []
    for log in made.logs:
        w += [log.imu.gyro, rng.normal(0.0, 1.0, (200, 3))]  # two seconds of handling
        f += [log.imu.specific_force, log.imu.specific_force[-1] + rng.normal(0.0, 3.0, (200, 3))]
    gyro, force = np.vstack(w), np.vstack(f)
    stream = ImuStream(np.arange(1, len(gyro) + 1) * 0.01, gyro, force)
    cut = cut_positions("long", stream)
    assert len(cut) == 10
    assert all(6.0 < np.ptp(one.imu.time) < 8.1 for one in cut)
    got = calibrate_imu(cut, ["multi-position"], gravity=made.gravity).calibration
    assert np.all(np.abs(got.accelerometer.bias - made.accelerometer.bias) < 5.0 * got.accelerometer.sigma_bias)
    with pytest.raises(
        EstimationError, match=r"no stretch of 5 s in which the block rests.*record each position for longer"
    ):
        cut_positions("hand", ImuStream(stream.time, rng.normal(0, 1, gyro.shape), force))


def test_one_long_log_on_a_table_is_cut_where_it_turns_evenly() -> None:
    made = simulate_positions("modified-multi-position", unit="IMU440", seed=6, count=10, duration=8.0)
    rng = np.random.default_rng(1)
    w, f = [], []
    for log in made.logs:
        w += [log.imu.gyro, rng.normal(0.0, 1.0, (200, 3))]
        f += [log.imu.specific_force, log.imu.specific_force[-1] + rng.normal(0.0, 3.0, (200, 3))]
    gyro, force = np.vstack(w), np.vstack(f)
    cut = cut_positions("table", ImuStream(np.arange(1, len(gyro) + 1) * 0.01, gyro, force), by_rate=True)
    assert len(cut) == 10
    got = calibrate_imu(cut, ["modified-multi-position"], rate=math.radians(60.0), latitude=made.latitude).calibration
    assert np.all(np.abs(got.gyroscope.bias - made.gyroscope.bias) < 5.0 * got.gyroscope.sigma_bias)


def test_gyros_by_turns_about_each_axis_show_their_full_matrix() -> None:
    """Six runs, both ways about each axis: the cross-axis terms that lengths cannot tell from a turn of the triad come out too."""
    from railnav.inertial import simulate_triad

    made = simulate_positions("turns", seed=2, unit="IMU440", duration=2.0)
    logs = []
    for k, rate in enumerate(math.radians(60.0) * np.array([s * axis for axis in np.eye(3) for s in (1.0, -1.0)])):
        w = simulate_triad(
            np.tile(rate, (2000, 1)), 0.01, replace(made.gyroscope, instability=0.0), seed=50 + k
        ).measured
        f = simulate_triad(
            np.tile([0.0, 0.0, -made.gravity], (2000, 1)), 0.01, made.accelerometer, seed=90 + k
        ).measured
        logs.append(PositionLog(f"{k}", ImuStream(np.arange(1, 2001) * 0.01, w, f), turns=np.zeros(3), turn_rates=rate))
    triad = calibrate_imu(logs, ["turns"]).calibration.gyroscope
    truth = np.eye(3) + np.diag(made.gyroscope.scale) + np.array(made.gyroscope.cross_axis)
    assert np.all(np.abs(triad.matrix - np.linalg.inv(truth)) < 5.0 * triad.sigma_matrix)
    assert np.abs(made.gyroscope.cross_axis).max() > 10.0 * triad.sigma_matrix.max()
    with pytest.raises(EstimationError, match="0 turns, but its turn_rates_deg_s are not named"):
        calibrate_imu([replace(log, turn_rates=None, rate=1.0) for log in logs], ["turns"])
    with pytest.raises(EstimationError, match="determine only 3 of the 4 unknowns"):
        calibrate_imu(logs[:4], ["turns"])


def test_noise_is_measured_where_a_log_is_long_enough() -> None:
    made = simulate_positions("six-position", unit="IMU440", seed=1, duration=60.0)
    got = calibrated(made, "six-position")
    assert got.calibration.gyroscope_noise.random_walk == pytest.approx(made.gyroscope.random_walk, rel=0.05)
    assert got.calibration.gyroscope_noise.bias_instability == 0.0
    assert any("too short for the flicker floor" in remark for remark in got.remarks)


def test_poor_turns_are_answered_with_better_ones() -> None:
    made = simulate_positions("turns", seed=1, unit="STIM300", duration=5.0)
    step = np.radians(30.0)
    from railnav.inertial import simulate_triad, turned_force

    logs = []
    for k in range(12):
        up = turned_force(*(np.full(3, k * step)))
        f = simulate_triad(np.tile(made.gravity * up, (500, 1)), 0.01, made.accelerometer, seed=k).measured
        w = simulate_triad(np.zeros((500, 3)), 0.01, made.gyroscope, seed=100 + k).measured
        logs.append(PositionLog(f"{k}", ImuStream(np.arange(1, 501) * 0.01, w, f), turns=np.full(3, k * step)))
    got = calibrate_imu(logs, ["turns"], gravity=made.gravity)
    assert got.calibration.accelerometer.condition == pytest.approx(9.1, abs=0.05)
    assert any("reach 1.8" in remark for remark in got.remarks)
    repeated = [replace(log, turns=np.full(3, k * np.pi)) for k, log in enumerate(logs)]
    with pytest.raises(EstimationError, match=r"determine only 2 of the 4 unknowns|determine only 1 of the 4"):
        calibrate_imu(repeated, ["turns"], gravity=made.gravity)


SIX = simulate_positions("six-position", seed=1, unit="STIM300", duration=2.0)
NINE = simulate_positions("multi-position", seed=1, unit="STIM300", duration=2.0, count=9)
TURNS = simulate_positions("turns", seed=1, unit="STIM300", duration=2.0)
TABLE = simulate_positions("modified-six-position", seed=1, unit="STIM300", duration=2.0)


def spoilt(logs, k, **parts):
    return tuple(replace(log, imu=replace(log.imu, **parts)) if i == k else log for i, log in enumerate(logs))


def axis(x, k, values):
    out = x.copy()
    out[:, k] = values
    return out


FIRST = SIX.logs[0].imu


@pytest.mark.parametrize(
    ("logs", "methods", "options", "words"),
    [
        (SIX.logs, [], {}, "no method named"),
        (SIX.logs, ["guess"], {}, "no method 'guess'"),
        ((), ["six-position"], {}, "no position"),
        (SIX.logs, ["six-position"], {"gravity": 1.0}, "found nowhere on land"),
        (SIX.logs, ["six-position"], {"gravity": None}, "local gravity is unknown"),
        (SIX.logs[:5], ["six-position"], {}, "add positions with these axes up: -z"),
        (SIX.logs[:1], ["six-position"], {}, "1 position leaves faces out; add positions with these axes up: -x; \\+y; -y; \\+z; -z"),
        (NINE.logs, ["six-position"], {}, "45 degrees off the nearest axis.*multi-position"),
        (SIX.logs, ["multi-position"], {}, "6 positions cannot determine 9 parameters; add positions with these axes up:"),
        (NINE.logs[:8], ["multi-position"], {}, "8 positions cannot determine 9 parameters; add positions"),
        (TURNS.logs[:3], ["turns"], {}, "determine only 3 of the 4 unknowns"),
        (SIX.logs, ["turns"], {}, "turns needs the turns of each position: 01 has none"),
        (SIX.logs, ["modified-six-position"], {"rate": 1.0}, "needs logs on a table that turns"),
        (TABLE.logs, ["six-position"], {}, "turns at 60.* deg/s .*in degrees: multiply them by pi/180"),
        (tuple(replace(log, rate=None) for log in TABLE.logs), ["modified-six-position"], {}, "rate of the table is unknown"),
        (TABLE.logs, ["modified-multi-position"], {}, "6 positions cannot determine 9"),
        # one log is wrong
        (spoilt(SIX.logs, 0, specific_force=FIRST.specific_force / 9.80665), ["six-position"], {}, "position 01: .*it is in g; multiply it by 9.8"),  # noqa: E501
        (spoilt(SIX.logs, 0, specific_force=axis(FIRST.specific_force, 1, 0.0)), ["six-position"], {}, "position 01: specific force y is 0 all the time: the axis is frozen or missing"),  # noqa: E501
        (spoilt(SIX.logs, 0, gyro=axis(FIRST.gyro, 2, 0.001)), ["six-position"], {}, "position 01: rate z is 0.001 all the time"),
        (spoilt(SIX.logs, 0, specific_force=axis(FIRST.specific_force, 0, np.nan)), ["six-position"], {}, "position 01: specific force x is missing"),  # noqa: E501
        (spoilt(SIX.logs, 0, time=np.r_[FIRST.time[:100], FIRST.time[100:] - 1.0]), ["six-position"], {}, "position 01: time does not increase at sample 100"),  # noqa: E501
        (spoilt(SIX.logs, 0, gyro=FIRST.gyro + np.linspace(0, 0.3, 200)[:, None]), ["six-position"], {}, "position 01: the triad moved"),
        (spoilt(SIX.logs, 0, specific_force=np.where(np.arange(200)[:, None] % 40 < 6, [12.0, 0.0, 0.0], FIRST.specific_force)), ["six-position"], {}, "position 01: specific force x stands at 12 .*end of its range"),  # noqa: E501
        (spoilt(SIX.logs, 0, calibration="A7"), ["six-position"], {}, "position 01 is calibrated already"),
        (spoilt(SIX.logs, 0, time=FIRST.time[:30], gyro=FIRST.gyro[:30], specific_force=FIRST.specific_force[:30]), ["six-position"], {}, "position 01 has 30 samples"),  # noqa: E501
        (tuple(replace(log, imu=replace(log.imu, specific_force=log.imu.specific_force[:, [1, 0, 2]])) for log in SIX.logs), ["six-position"], {}, "position 01 should have \\+x up, but gravity is felt on \\+y"),  # noqa: E501
        (tuple(replace(log, imu=replace(log.imu, specific_force=log.imu.specific_force[:, [1, 2, 0]])) for log in TURNS.logs), ["turns"], {}, "axes are in another order than the turns say \\(x reads"),  # noqa: E501
        (tuple(replace(log, imu=replace(log.imu, specific_force=log.imu.specific_force * [1, 1, -1])) for log in TURNS.logs), ["turns"], {}, "mirrored against the reference"),  # noqa: E501
        (tuple(replace(log, imu=replace(log.imu, gyro=np.degrees(log.imu.gyro))) for log in TABLE.logs), ["modified-six-position"], {}, "degrees and radians"),  # noqa: E501
    ],
)  # fmt: skip
def test_bad_sets_are_refused_with_what_to_do(logs, methods, options, words) -> None:
    call = {"gravity": SIX.gravity, "latitude": SIX.latitude} | options
    with pytest.raises(EstimationError, match=words):
        calibrate_imu(logs, methods, **call)


def test_degrees_of_a_noisy_gyro_at_rest_are_recognised() -> None:
    made = simulate_positions("six-position", unit="IMU440", seed=1, duration=5.0)
    log = replace(made.logs[0], imu=replace(made.logs[0].imu, gyro=np.degrees(made.logs[0].imu.gyro)))
    with pytest.raises(
        EstimationError, match=r"position 01: the rates scatter .* in degrees per second; multiply them by pi/180"
    ):
        position_result(log)


def test_the_vertical_part_of_the_earths_rotation_is_taken_off() -> None:
    """Positions that lean to one side: without the latitude the biases would take it for their own."""
    from railnav.inertial import EARTH_RATE, Provenance, six_position
    from railnav.inertial.positions import Position, PositionResult
    from railnav.inertial.procedure import _bias_at_rest

    assert Provenance().gravity != 0.0
    latitude, bias = 0.85, np.array([1e-5, -2e-5, 3e-6])
    ups = np.array([[0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.0, 0.6, -0.8], [0.6, 0.6, -0.529]])
    ups /= np.linalg.norm(ups, axis=1, keepdims=True)
    still = [
        PositionResult(
            "a",
            "",
            Position(9.8 * up, np.zeros(3), 9),
            Position(bias + EARTH_RATE * math.sin(latitude) * up, np.zeros(3), 9),
            False,
            0.0,
            1.0,
        )
        for up in ups
    ]
    ideal = six_position([9.8] * 3, [-9.8] * 3, 9.8)
    np.testing.assert_allclose(_bias_at_rest(still, ideal, latitude).bias, bias, atol=1e-17)
    blind = _bias_at_rest(still, ideal, None)
    assert np.abs(blind.bias - bias).max() > 3e-5
    # what is not seen stays in the sigma: the level part of a known latitude, all of an unknown one
    assert blind.sigma_bias.min() >= EARTH_RATE / math.sqrt(3.0 * 4.0) * 0.999
    seen = _bias_at_rest(still, ideal, latitude).sigma_bias
    assert seen[0] == pytest.approx(
        EARTH_RATE * math.cos(latitude) / math.sqrt(2.0 * 4.0) * math.sqrt(np.mean(1 - ups[:, 0] ** 2))
    )


def test_simulation_refuses_what_it_does_not_know() -> None:
    for options, words in (
        ({"unit": "X"}, "no unit"),
        ({"fault": ("baro bias x", 1.0)}, "no triad"),
        ({"fault": ("gyroscope drift x", 1.0)}, "no parameter"),
    ):
        with pytest.raises(ValueError, match=words):
            simulate_positions("six-position", duration=1.0, **options)
    with pytest.raises(ValueError, match="no method"):
        simulate_positions("guess", duration=1.0)
    assert ImuCalibration("x").accelerometer is None
