"""Consistency statistics: against scipy, and with estimators that are honest, boastful and timid."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.errors import EstimationError
from railnav.estimation import consistency, coverage, nees


def test_nees_is_the_quadratic_form() -> None:
    rng = np.random.default_rng(0)
    A = rng.standard_normal((20, 3, 6))
    P, e = A @ np.swapaxes(A, 1, 2), rng.standard_normal((20, 3))
    expected = [v @ np.linalg.solve(K, v) for v, K in zip(e, P, strict=True)]
    np.testing.assert_allclose(nees(e, P), expected, rtol=1e-9)
    np.testing.assert_allclose(nees(e, P[0])[0], expected[0], rtol=1e-9)


def test_bounds_are_chi_square_quantiles() -> None:
    from scipy.stats import chi2

    report = consistency(np.full(50, 3.0), 3, probability=0.95)
    assert report.ratio == 1.0
    assert report.dof == 150
    np.testing.assert_allclose([report.lower, report.upper], chi2.ppf([0.025, 0.975], 150) / 150, rtol=1e-10)


def test_bounds_hold_as_often_as_they_say() -> None:
    rng = np.random.default_rng(1)
    inside = [consistency(rng.chisquare(3, 40), 3, probability=0.9).consistent for _ in range(1000)]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.03)


def test_the_boastful_and_the_timid_fall_outside() -> None:
    rng = np.random.default_rng(2)
    honest = rng.chisquare(3, 400)
    assert consistency(honest, 3).consistent
    assert consistency(1.4 * honest, 3).ratio > consistency(honest, 3).upper
    assert not consistency(1.4 * honest, 3).consistent
    assert not consistency(0.7 * honest, 3).consistent


def test_blocks_without_redundancy_do_not_count() -> None:
    assert consistency([0.0, 3.0], [0, 3]).dof == 3


def test_dependent_samples_widen_the_bounds() -> None:
    values = np.full(1000, 3.3)
    assert not consistency(values, 3).consistent
    wide = consistency(values, 3, independent=20)
    assert wide.dof == pytest.approx(60)
    assert wide.consistent


def test_coverage_of_a_normal_error_and_of_a_boast() -> None:
    rng = np.random.default_rng(4)
    e = rng.standard_normal(5000)
    for k in (1.0, 2.0, 3.0):
        assert coverage(e, np.ones(5000), k=k).consistent
    assert coverage(e, np.ones(5000), k=2.0).expected == pytest.approx(0.9545, abs=1e-4)
    assert not coverage(e, np.full(5000, 0.8), k=2.0).consistent
    assert coverage(e[:200], np.ones(200), independent=10).upper == 1.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: nees(np.zeros((2, 3)), np.eye(2)), "error has shape"),
        (lambda: nees([[np.nan]], np.eye(1)), "error 0 is not finite"),
        (lambda: nees([[1.0]], [[0.0]]), "perfect"),
        (lambda: consistency([], 3), "nothing to judge"),
        (lambda: consistency([1.0], 0), "nothing to judge"),
        (lambda: consistency([-1.0], 3), "statistic 0 is -1"),
        (lambda: consistency([1.0], 3, probability=1.0), "probability 1.0"),
        (lambda: consistency([1.0], 3, independent=0), "independent samples"),
        (lambda: coverage([1.0], [0.0]), "row 0 has error 1.0 and sigma 0.0"),
        (lambda: coverage([], []), "N > 0"),
    ],
)
def test_what_cannot_be_judged_is_refused(call: object, message: str) -> None:
    with pytest.raises(EstimationError, match=message):
        call()
