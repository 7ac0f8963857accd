"""Gross errors: found, attributed to the fix or to the link, and left out."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.errors import EstimationError
from railnav.estimation import Chain, increment_chain, screen_chain, solve_chain

SIGMA, SIGMA_STEP = 0.01, 0.002


def line(rng: np.random.Generator, nodes: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    truth = np.column_stack([np.arange(nodes) * 1.0, np.zeros((nodes, 2))])
    X = truth + rng.normal(0, SIGMA, (nodes, 3))
    return truth, X, np.diff(truth, axis=0) + rng.normal(0, SIGMA_STEP, (nodes - 1, 3))


def chain_of(X: np.ndarray, dX: np.ndarray, nominal: np.ndarray) -> Chain:
    return increment_chain(X, SIGMA**2 * np.eye(3), dX, SIGMA_STEP**2 * np.eye(3), nominal=nominal)


def direction(rng: np.random.Generator) -> np.ndarray:
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def test_bad_fixes_and_slips_are_found_attributed_and_left_out() -> None:
    rng = np.random.default_rng(1)
    truth, X, dX = line(rng, 1500)
    good = chain_of(X, dX, truth)
    fixes, slips = [100, 511, 512, 700, 1490], [300, 513 + 60, 1023]
    for k in fixes:
        X[k] += 0.3 * direction(rng)
    for k in slips:
        dX[k - 1] += 0.2 * direction(rng)
    chain = chain_of(X, dX, truth)
    screening = screen_chain(chain, outlier_range=1 / SIGMA)
    found = {v.epoch: v for v in screening.verdicts}
    assert {k for k, v in found.items() if v.wrong == "fix"} == set(fixes)
    assert {k for k, v in found.items() if v.wrong == "link"} == set(slips)
    assert all(v.nis > v.limit for v in screening.verdicts)
    assert all(v.log_odds > 3 for v in screening.verdicts)
    assert np.linalg.norm(found[100].residual) * SIGMA == pytest.approx(0.3, abs=0.05)
    # the cleaned chain is as good as the one without errors, the other is not
    clean, spoilt, best = (solve_chain(c).state for c in (screening.chain, chain, good))
    assert np.abs(clean - best).max() < 0.03
    assert np.abs(spoilt - best).max() > 0.06
    assert np.sqrt(np.mean(clean**2)) < 1.05 * np.sqrt(np.mean(best**2))
    assert solve_chain(screening.chain).unit_weight_rms == pytest.approx(1.0, abs=0.05)
    # the given chain is left alone
    assert (chain.counts == 3).all()


def test_good_chain_stays_as_it_is() -> None:
    rng = np.random.default_rng(2)
    truth, X, dX = line(rng, 1200)
    chain = chain_of(X, dX, truth)
    screening = screen_chain(chain, outlier_range=100.0, significance=1e-7)
    assert screening.verdicts == ()
    np.testing.assert_array_equal(solve_chain(screening.chain).state, solve_chain(chain).state)


def test_false_alarms_are_as_many_as_announced() -> None:
    rng = np.random.default_rng(3)
    truth, X, dX = line(rng, 20_000)
    alarms = len(screen_chain(chain_of(X, dX, truth), outlier_range=100.0, significance=1e-2).verdicts)
    assert alarms == pytest.approx(200, abs=4 * np.sqrt(200))


def test_last_epoch_and_first_epoch() -> None:
    rng = np.random.default_rng(4)
    truth, X, dX = line(rng)
    X[39] += 0.5
    verdicts = screen_chain(chain_of(X, dX, truth), outlier_range=100.0).verdicts
    assert [v.epoch for v in verdicts] == [39]  # nothing follows: found, hardly attributed
    assert abs(verdicts[0].log_odds) < 8
    truth, X, dX = line(rng)
    X[0] += 0.5
    prior = (100 * np.eye(3), np.zeros(3))
    chain = increment_chain(X, SIGMA**2 * np.eye(3), dX, SIGMA_STEP**2 * np.eye(3), nominal=truth, prior=prior)
    (verdict,) = screen_chain(chain, outlier_range=100.0).verdicts
    assert (verdict.epoch, verdict.wrong) == (0, "fix")  # no link leads there
    assert np.isnan(verdict.log_odds)


def test_fix_without_prediction_has_nothing_to_be_tested_by() -> None:
    rng = np.random.default_rng(5)
    truth, X, dX = line(rng)
    X[0] += 0.5  # believed, so that all that follows disagrees: the first link is blamed
    verdicts = screen_chain(chain_of(X, dX, truth), outlier_range=100.0).verdicts
    assert [(v.epoch, v.wrong) for v in verdicts] == [(1, "link")]


def test_only_the_rows_of_increments_are_weakened() -> None:
    """Two numbers a state, the second a constant that must not be freed by a slip of the first."""
    rng = np.random.default_rng(6)
    N = 60
    z = np.zeros((N, 1)) + rng.normal(0, 1, (N, 1))
    z[30:] += 40.0
    M, L = np.diag([-10.0, -1e3]), np.diag([10.0, 1e3])
    M[0, 1] = -10.0
    chain = Chain([[1.0, 0.0]], z, M, L, np.zeros((N - 1, 2)), prior=(np.array([[0.0, 1e3]]), np.zeros(1)))
    (verdict,) = screen_chain(chain, outlier_range=100.0, link_rows=[0]).verdicts
    assert (verdict.epoch, verdict.wrong) == (30, "link")
    cleaned = screen_chain(chain, outlier_range=100.0, link_rows=[0]).chain
    np.testing.assert_allclose(cleaned.M[29], [[-0.1, -0.1], [0, -1e3]], rtol=1e-12)


def test_refused_by_meaning() -> None:
    rng = np.random.default_rng(7)
    truth, X, dX = line(rng)
    chain = chain_of(X, dX, truth)
    with pytest.raises(EstimationError, match="one positive number or one for each of 40"):
        screen_chain(chain, outlier_range=np.ones(3))
    with pytest.raises(EstimationError, match=r"inflation 1\.0 make no sense"):
        screen_chain(chain, outlier_range=1.0, inflation=1.0)
    cut = Chain([[1.0]], np.zeros((5, 1)), [[-1.0]], [[1.0]], np.zeros((4, 1)), coupling_counts=[1, 1, 0, 1])
    with pytest.raises(EstimationError, match="between epochs 2 and 3 couples nothing"):
        screen_chain(cut, outlier_range=1.0)
    bad = Chain([[1.0]], np.array([[0.0], [np.nan], [0.0]]), [[-1.0]], [[1.0]], np.zeros((2, 1)))
    with pytest.raises(EstimationError, match="z is not finite at epoch 1"):
        screen_chain(bad, outlier_range=1.0)


@pytest.mark.slow
def test_detection_and_attribution_rates_of_the_specification() -> None:
    """Rail 17: detection 0.55, 0.99, 1.00 for 5, 8, 12 cm; attribution at least 0.988."""
    rng = np.random.default_rng(21)
    trials, at = 400, 20
    lines = []
    for wrong in ("fix", "link"):
        for size, expected in ((0.05, 0.55), (0.08, 0.99), (0.12, 1.0)):
            detected = right = 0
            for _ in range(trials):
                truth, X, dX = line(rng)
                if wrong == "fix":
                    X[at] += size * direction(rng)
                else:
                    dX[at - 1] += size * direction(rng)
                for verdict in screen_chain(chain_of(X, dX, truth), outlier_range=1 / SIGMA).verdicts:
                    if verdict.epoch == at:
                        detected += 1
                        right += verdict.wrong == wrong
            lines.append(f"{wrong} {size} m: detected {detected / trials:.3f}, attributed {right / detected:.4f}")
            sigma = np.sqrt(max(expected * (1 - expected), 0.005) / trials)
            assert detected / trials == pytest.approx(expected, abs=3 * sigma + 0.02), lines
            assert right / detected >= 0.98, lines
    print("\n".join(lines))  # noqa: T201 - what the documentation quotes
