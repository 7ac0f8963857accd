"""The sliding window against dense least squares."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.errors import EstimationError
from railnav.estimation.window import Window


def random_problem(seed):
    """Variables that come and go, each tied to some that live with it; rows as (names, blocks, rhs)."""
    random = np.random.default_rng(seed)
    sizes = {k: int(random.integers(1, 4)) for k in range(9)}
    rows, live = [], []
    plan = []
    for k in range(9):
        live.append(k)
        plan.append(("add", k))
        for names in ([k], [n for n in live if random.random() < 0.7] or [k]):
            m = int(random.integers(1, 5)) + (sizes[k] if names == [k] else 0)
            row = {n: random.normal(size=(m, sizes[n])) for n in names}
            rhs = random.normal(size=m)
            rows.append((row, rhs))
            plan.append(("observe", len(rows) - 1))
        if len(live) > 3:
            gone = live.pop(int(random.integers(0, 2)))
            plan.append(("eliminate", gone))
    return sizes, rows, plan


@pytest.mark.parametrize("seed", range(6))
def test_sweep_equals_dense_least_squares(seed):
    sizes, rows, plan = random_problem(seed)
    start = np.concatenate([[0], np.cumsum([sizes[k] for k in range(9)])])
    A = np.zeros((sum(len(z) for _, z in rows), start[-1]))
    at = 0
    for row, z in rows:
        for n, block in row.items():
            A[at : at + len(z), start[n] : start[n + 1]] = block
        at += len(z)
    z = np.concatenate([z for _, z in rows])
    P = np.linalg.inv(A.T @ A)
    x = P @ A.T @ z
    window, squares = Window(), 0.0
    for what, k in plan:
        if what == "add":
            window.add(k, sizes[k])
        elif what == "observe":
            squares += window.observe(*rows[k])
        else:
            window.eliminate([k])
    assert squares == pytest.approx(float(np.sum((A @ x - z) ** 2)), rel=1e-9)
    seen = set()
    for marginal in window.backward():
        for a in marginal.names:
            for b in marginal.names:
                mean, covariance = marginal.of(a, b) if a != b else marginal.of(a)
                index = np.concatenate([np.arange(start[n], start[n + 1]) for n in ((a, b) if a != b else (a,))])
                np.testing.assert_allclose(mean, x[index], atol=1e-10)
                np.testing.assert_allclose(covariance, P[np.ix_(index, index)], atol=1e-10)
        seen |= set(marginal.names)
    assert seen == set(range(9))


def test_a_gated_row_changes_nothing():
    window = Window()
    window.add("a", 1)
    window.observe({"a": [[1.0]]}, [0.0])
    assert window.observe({"a": [[1.0]]}, [10.0], gate=9.0) == pytest.approx(50.0)
    assert window.marginal().mean[0] == 0.0
    assert window.observe({"a": [[1.0]]}, [1.0], gate=9.0) == pytest.approx(0.5)
    assert window.marginal().mean[0] == pytest.approx(0.5)


def test_mistakes_are_named():
    window = Window()
    window.add("a", 2)
    with pytest.raises(EstimationError, match="is in the window already"):
        window.add("a", 1)
    with pytest.raises(EstimationError, match="'b' is not in the window"):
        window.observe({"b": [[1.0]]}, [0.0])
    window.observe({"a": [[1.0, 0.0]]}, [0.0])
    with pytest.raises(EstimationError, match="do not determine"):
        window.marginal()
    with pytest.raises(EstimationError, match="do not determine"):
        window.eliminate(["a"])
