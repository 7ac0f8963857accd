"""Gross errors: limits against scipy, false-alarm rates of the specification, detection of a bad fix."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.errors import EstimationError
from railnav.estimation import (
    block_test,
    chi_square_limit,
    component_test,
    geometric_test,
    geometric_tolerance,
    increment_chain,
    solve_chain,
)


def test_limits_are_those_of_scipy_and_of_the_specification() -> None:
    from scipy.stats import chi2

    for dof in (1, 3, 12):
        for significance in (1e-2, 1e-4):
            assert chi_square_limit(dof, significance) == pytest.approx(chi2.isf(significance, dof), rel=1e-12)
    assert chi_square_limit(3, 1e-4) == pytest.approx(21.1, abs=0.05)


def test_blocks_without_redundancy_are_never_rejected() -> None:
    outcome = block_test([0.0, 25.0, 25.0], [0, 3, 9])
    assert outcome.rejected.tolist() == [False, True, False]
    assert outcome.limit[0] == np.inf


def test_component_test_points_at_the_wrong_component() -> None:
    rng = np.random.default_rng(0)
    A = rng.standard_normal((3, 6))
    S = A @ A.T
    root = np.linalg.cholesky(S)
    nu = np.array([0.1, 6.0, 0.2])
    inverse = np.linalg.inv(S)
    np.testing.assert_allclose(component_test(nu, root), inverse @ nu / np.sqrt(np.diagonal(inverse)), rtol=1e-10)
    assert np.argmax(np.abs(component_test(nu, root))) == 1
    w = np.array([component_test(root @ rng.standard_normal(3), root) for _ in range(4000)])
    np.testing.assert_allclose(w.std(axis=0), 1.0, rtol=0, atol=0.04)


def test_false_alarms_of_the_source_tolerance() -> None:
    """Rail 6: 4.55 % a component, 13.0 % for any of three, 0.74 % for the trace form."""
    rng = np.random.default_rng(3)
    T, sx, sd = 40_000, 0.02, 0.003
    counts = np.zeros(3)
    K, KD = np.tile(sx**2 * np.eye(3), (2, 1, 1)), sd**2 * np.eye(3)[None]
    tolerance = geometric_tolerance(K, KD)[0]
    assert geometric_tolerance(K, KD, form="vector")[0] == pytest.approx(np.linalg.norm(tolerance))
    difference = rng.normal(0, np.sqrt(2 * sx**2 + sd**2), (T, 3))
    counts[0] = (np.abs(difference[:, 0]) >= tolerance[0]).mean()
    counts[1] = (np.abs(difference) >= tolerance).any(axis=1).mean()
    counts[2] = (np.linalg.norm(difference, axis=1) >= np.linalg.norm(tolerance)).mean()
    np.testing.assert_allclose(counts, [0.0455, 0.130, 0.0074], rtol=0, atol=0.005)


def test_the_source_tolerance_is_conservative_in_the_steady_state() -> None:
    """Rail 6: sigma of the innovation over half the tolerance is 0.758; its factor 2 acts as 2.64."""
    sx, sd, N = 0.02, 0.003, 400
    K, KD = np.tile(sx**2 * np.eye(1), (N, 1, 1)), np.tile(sd**2 * np.eye(1), (N - 1, 1, 1))
    solution = solve_chain(increment_chain(np.zeros((N, 1)), K, np.zeros((N - 1, 1)), KD))
    innovation = np.sqrt(solution.covariance[-1, 0, 0] + sd**2 + sx**2)
    ratio = innovation / (geometric_tolerance(K, KD)[-1, 0] / 2)
    assert ratio == pytest.approx(0.758, abs=5e-4)
    assert 2 / ratio == pytest.approx(2.64, abs=5e-3)


def test_a_bad_fix_fails_both_tests_where_it_is_and_a_slip_leaves_an_offset() -> None:
    rng = np.random.default_rng(5)
    N, sx, sd = 60, 0.01, 0.002
    X, dX = sx * rng.standard_normal((N, 3)), sd * rng.standard_normal((N - 1, 3))
    X[30, 1] += 0.12
    K, KD = np.tile(sx**2 * np.eye(3), (N, 1, 1)), np.tile(sd**2 * np.eye(3), (N - 1, 1, 1))
    geometric = geometric_test(X, K, dX, KD)
    assert geometric.rejected[29]
    assert geometric.rejected[30]  # the next triangle starts from the bad fix
    chain = increment_chain(X, K, dX, KD)
    solution = solve_chain(chain, filtered=True)
    assert np.flatnonzero(block_test(solution.nis, solution.dof).rejected).tolist() == [30]
    from_filter = geometric_test(X, K, dX, KD, estimate=solution.filtered)
    np.testing.assert_allclose(from_filter.difference[29], X[30] - solution.filtered[29] - dX[29], rtol=0, atol=1e-15)
    assert geometric_test(X, K, dX, KD, form="vector").tolerance.shape == (N - 1,)


def test_detection_rate_of_the_specification() -> None:
    """Rail 17: sigma 1 cm, increments 2 mm: errors of 5, 8, 12 cm are found in 0.55, 0.99 and 1.00 of cases."""
    rng = np.random.default_rng(17)
    N, sx, sd, cases = 31, 0.01, 0.002, 150
    K, KD = sx**2 * np.eye(3), sd**2 * np.eye(3)
    rates = []
    for size in (0.05, 0.08, 0.12):
        found = 0
        for _ in range(cases):
            X = sx * rng.standard_normal((N, 3))
            direction = rng.standard_normal(3)
            X[20] += size * direction / np.linalg.norm(direction)
            solution = solve_chain(increment_chain(X, K, sd * rng.standard_normal((N - 1, 3)), KD), covariance=False)
            found += bool(block_test(solution.nis, solution.dof).rejected[20])
        rates.append(found / cases)
    assert rates[0] == pytest.approx(0.55, abs=0.12)
    assert rates[1] > 0.95
    assert rates[2] == 1.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: chi_square_limit(0, 0.1), "does not exist"),
        (lambda: chi_square_limit(3, 1.0), "does not exist"),
        (lambda: block_test([1.0], [1, 2]), "nis has shape"),
        (lambda: block_test([np.nan], [1]), "block 0 has NIS nan"),
        (lambda: component_test([1.0], np.eye(2)), "innovation has shape"),
        (lambda: component_test([1.0], [[0.0]]), "perfect measurement"),
        (lambda: geometric_tolerance(np.ones((2, 1, 1)), np.ones((2, 1, 1))), "covariance has shape"),
        (
            lambda: geometric_test(np.zeros((3, 1)), np.ones((3, 1, 1)), np.zeros((3, 1)), np.ones((2, 1, 1))),
            "position",
        ),
        (lambda: geometric_test(np.zeros((3, 1)), np.ones((2, 1, 1)), np.zeros((2, 1)), np.ones((1, 1, 1))), "2 incr"),
    ],
)
def test_what_does_not_fit_is_refused(call: object, message: str) -> None:
    with pytest.raises(EstimationError, match=message):
        call()
