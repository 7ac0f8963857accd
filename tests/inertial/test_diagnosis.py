"""Scalar control and diagnosis: printed vector of A11, isolation and false-alarm rates, blind spots, advice."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.attitude import dcm_from_quaternion
from railnav.errors import EstimationError
from railnav.inertial.calibration import multi_position
from railnav.inertial.diagnosis import CAUSES, diagnose, scalar_control

EDGES = np.array([(1, 1, 0), (1, 0, 1), (0, 1, 1)]) / np.sqrt(2)
FACES = np.array([s * e for e in np.eye(3) for s in (1, -1)])
NINE = np.concatenate([FACES, EDGES])
#: Printed unit: the source's vector is gravity, so that specific force points the other way.
BIAS = np.array([1e-3, -2e-3, 1.5e-3])
RESPONSE = np.eye(3) + np.array([[2e-3, 1e-3, -5e-4], [2e-3, -1e-3, 1e-3], [-1e-3, 5e-4, 5e-4]])
TRUTH = np.array([*BIAS, 2e-3, -1e-3, 5e-4, 1e-3 + 2e-3, -5e-4 - 1e-3, 1e-3 + 5e-4])


def fault(p, size):
    """Bias and response of a triad with one fault."""
    bias, response = np.zeros(3), np.eye(3)
    if p < 3:
        bias[p] = size
    elif p < 6:
        response[p - 3, p - 3] += size
    else:
        i, j = ((0, 1), (0, 2), (1, 2))[p - 6]
        response[i, j] += size
    return bias, response


def test_printed_right_sides_and_solution():
    up = -NINE
    readings = up @ RESPONSE.T + BIAS
    printed = [
        0.001011625,
        0.003004625,
        0.001001,
        -0.0029915,
        -0.000993875,
        0.002002625,
        0.002713117504,
        -0.001257554642,
        0.000856076677,
    ]
    residual = scalar_control(readings, 1.0, limit=1e-3).residual
    np.testing.assert_allclose(residual, printed, atol=6e-13)
    x, y, z = up.T
    first_order = np.linalg.solve(np.column_stack([up, x * x, y * y, z * z, x * y, x * z, y * z]), residual)
    assert np.abs(first_order - TRUTH).max() == pytest.approx(8.2e-6, abs=0.1e-6)
    got = diagnose(readings, up, 1.0, sigma=1e-5)
    assert np.abs(got.parameters - TRUTH).max() == pytest.approx(1.5e-6, abs=0.1e-6)
    assert set(got.failed) == set(CAUSES)


def test_condition_and_sigmas_as_printed():
    got = diagnose(NINE, NINE, 1.0, sigma=1.0)
    assert got.condition == pytest.approx(7.287, abs=5e-4)
    np.testing.assert_allclose(got.sigma, [0.707] * 6 + [2.646] * 3, atol=5e-4)
    other = np.array([(1, -1, 0), (1, 0, -1), (0, 1, -1)]) / np.sqrt(2)
    assert diagnose(*[np.concatenate([NINE, other])] * 2, 1.0, sigma=1.0).condition == pytest.approx(4.993, abs=5e-4)


def test_six_faces_are_refused_with_advice():
    with pytest.raises(EstimationError, match=r"only 6 of 9 causes apart; add positions with these axes up: .*;.*;"):
        diagnose(FACES, FACES, 1.0, sigma=1e-4)


@pytest.mark.parametrize("p", range(9))
def test_a_single_fault_is_isolated(p):
    rng = np.random.default_rng(p)
    bias, response = fault(p, 2e-3)
    limits = np.full(9, 1e-3)
    right = 0
    for _ in range(150):
        readings = 9.81 * (NINE @ response.T + bias + rng.normal(0, 1e-4, (9, 3)))
        right += diagnose(readings, NINE, 9.81, sigma=9.81e-4 / 10, limits=limits).failed == (CAUSES[p],)
    assert right >= 149


def test_false_alarms_come_as_often_as_asked():
    rng = np.random.default_rng(1)
    alarms = sum(
        not diagnose(NINE + rng.normal(0, 1e-4, (9, 3)), NINE, 1.0, sigma=1e-4, false_alarm=0.1).healthy
        for _ in range(1500)
    )
    assert 0.05 < alarms / 1500 < 0.115  # the nine are correlated: a little rarer than asked


def test_blind_spots_of_the_scalar_are_as_printed():
    q = np.random.default_rng(2).normal(size=(20_000, 4))
    up = dcm_from_quaternion(q / np.linalg.norm(q, axis=1, keepdims=True))[:, :, 2]
    for p, printed in ((0, 0.90), (3, 0.68), (6, 0.70)):
        bias, response = fault(p, 5e-3)
        tripped = ~scalar_control(up @ response.T + bias, 1.0, limit=5e-4).healthy
        assert tripped.mean() == pytest.approx(printed, abs=0.015)
    level = scalar_control([5e-3, 0.0, -1.0], 1.0, limit=5e-4)
    assert level.healthy


def test_diagnosis_sees_the_change_since_the_calibration():
    unit = np.array([[0.98, 0.009, -0.007], [0.009, 0.97, 0.004], [-0.007, 0.004, 0.995]])
    up = np.concatenate([NINE, -EDGES])
    before = up @ np.linalg.inv(unit).T + 0.05
    calibration = multi_position(before, 1.0)
    assert diagnose(calibration.apply(before), up, 1.0, sigma=1e-5).healthy
    after = diagnose(calibration.apply(before + np.array([0.0, 0.01, 0.0])), up, 1.0, sigma=1e-4)
    assert after.failed[0] == "bias y"
    assert "bias y moved by" in after.sentence()
    assert "healthy" in diagnose(up, up, 1.0, sigma=1e-4).sentence()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: diagnose(NINE, NINE[:8], 1.0, sigma=1e-4), "shape|needs"),
        (lambda: diagnose(NINE * np.nan, NINE, 1.0, sigma=1e-4), "finite"),
        (lambda: diagnose(NINE, NINE, 0.0, sigma=1e-4), "positive"),
        (lambda: diagnose(NINE, NINE, 1.0, sigma=1e-4, limits=[1e-3]), "nine"),
        (lambda: scalar_control([1.0, 2.0], 1.0, limit=1e-3), "shape"),
        (lambda: scalar_control([1.0, 0.0, 0.0], 1.0, limit=0.0), "positive"),
    ],
)
def test_refusals_say_why(call, words):
    with pytest.raises(ValueError, match=words):
        call()
