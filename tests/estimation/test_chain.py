"""The chain against the specification's vectors, against other means, and against its own laws."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from railnav.errors import EstimationError
from railnav.estimation import (
    Chain,
    ChainFilter,
    ChainRecords,
    consistency,
    constant_velocity_chain,
    fixed_lag,
    increment_chain,
    inverse_root,
    nees,
    solve_chain,
)
from railnav.estimation import _row_kernels as kernels
from railnav.estimation import chain as chain_module
from railnav.estimation.oracle import banded_solution, dense_system, kalman_rts, row_reduction


def random_chain(
    seed: int,
    n: int,
    *,
    epochs: int = 40,
    m: int = 3,
    q: int | None = None,
    gaps: bool = True,
    prior: bool = True,
) -> Chain:
    """Whitened rows of a stable random chain; with gaps, epochs have 0 to m rows."""
    rng = np.random.default_rng(seed)
    q = n if q is None else q
    H, z = rng.standard_normal((epochs, m, n)), rng.standard_normal((epochs, m))
    counts = rng.integers(0, m + 1, epochs) if gaps else np.full(epochs, m)
    F = 0.9 * np.linalg.qr(rng.standard_normal((epochs - 1, n, n)))[0]
    W = np.triu(rng.standard_normal((epochs - 1, n, n))) + 3 * np.eye(n)
    M, L, u = -W @ F, W, rng.standard_normal((epochs - 1, n))
    if q > n:  # differences measured between neighbours
        M = np.concatenate([M, rng.standard_normal((epochs - 1, q - n, n))], axis=1)
        L = np.concatenate([L, rng.standard_normal((epochs - 1, q - n, n))], axis=1)
        u = np.concatenate([u, rng.standard_normal((epochs - 1, q - n))], axis=1)
    start = (rng.standard_normal((n, n)), rng.standard_normal(n)) if prior else None
    return Chain(H, z, M, L, u, counts=counts, prior=start)


def dense(chain: Chain) -> tuple[np.ndarray, np.ndarray, float, int]:
    """States, covariance of all, sum of squares and redundancy by dense least squares."""
    system = dense_system(chain)
    x, _, rank, _ = np.linalg.lstsq(system.A, system.b, rcond=None)
    residual = system.A @ x - system.b
    return x, np.linalg.inv(system.A.T @ system.A), float(residual @ residual), len(system.b) - rank


def agree(chain: Chain, tolerance: float = 1e-10) -> None:
    """Assert that the chain's solution is the dense one in every part."""
    solution = solve_chain(chain)
    x, P, vtv, redundancy = dense(chain)
    N, n = len(chain), chain.n
    blocks = P.reshape(N, n, N, n)
    np.testing.assert_allclose(solution.state.ravel(), x, atol=tolerance, rtol=tolerance)
    k = np.arange(N)
    np.testing.assert_allclose(solution.covariance, blocks[k, :, k, :], atol=tolerance, rtol=tolerance)
    np.testing.assert_allclose(solution.lag_one, blocks[k[:-1], :, k[1:], :], atol=tolerance, rtol=tolerance)
    assert solution.redundancy == redundancy
    assert solution.sum_of_squares == pytest.approx(vtv, rel=1e-10, abs=1e-10)


# ---------------------------------------------------------------- test vectors of the specification

#: TV2: X = 0, 1.1, 1.9 and dX = 1, 1 with unit weights.
TV2 = increment_chain([[0.0], [1.1], [1.9]], [[1.0]], [[1.0], [1.0]], [[1.0]])

#: TV3.
TV3_X = [[0, 0, 0], [1.02, 0.01, 0.03], [1.99, -0.02, 0.0]]
TV3_DX = [[1, 0.002, 0.008], [1, -0.004, 0.009]]
TV3_K = 1e-4 * np.array([[4, 1, 0], [1, 4, 0], [0, 0, 9]])
TV3_KD = 1e-6 * np.array([[1, 0, 0], [0, 4, 1], [0, 1, 4]])


def test_tv2_states_variances_and_sum_of_squares() -> None:
    solution = solve_chain(TV2, filtered=True)
    np.testing.assert_allclose(solution.state.ravel(), [1 / 80, 41 / 40, 157 / 80], rtol=0, atol=1e-15)
    np.testing.assert_allclose(solution.covariance.ravel(), [0.625, 0.5, 0.625], rtol=0, atol=1e-15)
    assert solution.sum_of_squares == pytest.approx(0.01375, abs=1e-15)
    assert solution.redundancy == 2
    assert solution.unit_weight_rms == pytest.approx(np.sqrt(0.01375 / 2))
    assert solution.filtered[-1, 0] == pytest.approx(157 / 80)


def test_tv2_triangle_and_residuals_row_by_row() -> None:
    rows = np.array([[1, 0, 0, 0], [-1, 1, 0, 1], [0, 1, 0, 1.1], [0, -1, 1, 1], [0, 0, 1, 1.9]], dtype=float)
    W = np.zeros((3, 4))
    entered = [kernels.insert_row_kernel(W, row.copy()) for row in rows]
    assert [pivot for pivot, _ in entered] == [0, 1, -1, 2, -1]
    np.testing.assert_allclose([entered[2][1], entered[4][1]], [0.057735026919, -0.102062072616], rtol=0, atol=1e-12)
    expected = [
        [np.sqrt(2), -0.7071067812, 0, -0.7071067812],
        [0, 1.5811388301, -0.6324555320, 0.3794733192],
        [0, 0, 1.2649110641, 2.4823879632],
    ]
    np.testing.assert_allclose(W, expected, rtol=0, atol=5e-11)


def test_tv2_records_are_the_rows_of_the_triangle() -> None:
    solution = solve_chain(TV2)
    np.testing.assert_allclose(solution.records[0, 0], [np.sqrt(2), -0.7071067812, -0.7071067812], rtol=0, atol=5e-11)
    np.testing.assert_allclose(solution.records[1, 0], [1.5811388301, -0.6324555320, 0.3794733192], rtol=0, atol=5e-11)
    np.testing.assert_allclose(solution.triangle[0], [1.2649110641, 2.4823879632], rtol=0, atol=5e-11)


@pytest.mark.parametrize("root", ["cholesky", "symmetric"])
def test_tv3(root: str) -> None:
    solution = solve_chain(increment_chain(TV3_X, TV3_K, TV3_DX, TV3_KD, root=root), filtered=True)
    smoothed = [
        [0.0033345614, -0.0032586850, 0.0017064089],
        [1.0033456260, -0.0013004405, 0.0097030800],
        [2.0033198126, -0.0054408745, 0.0185905111],
    ]
    np.testing.assert_allclose(solution.state, smoothed, rtol=0, atol=5e-11)
    np.testing.assert_allclose(solution.filtered[1], [1.0100119887, 0.0060140376, 0.0190263711], rtol=0, atol=5e-11)
    np.testing.assert_allclose(solution.nis, [0, 0.7795565035, 1.7546924428], rtol=0, atol=5e-11)
    np.testing.assert_array_equal(solution.dof, [0, 3, 3])
    np.testing.assert_allclose(
        1e3 * solution.sigma[0], [11.5709770827, 11.6418684789, 17.3842367527], rtol=0, atol=5e-10
    )
    assert solution.redundancy == 3 * (3 - 1)


def scalar_chain(r: float, q: float, epochs: int) -> Chain:
    return increment_chain(np.zeros((epochs, 1)), [[r]], np.zeros((epochs - 1, 1)), [[q]])


@pytest.mark.parametrize(("r", "q"), [(1.0, 1.0), (1.0, 0.01), (4e-4, 1e-6)])
def test_tv5_scalar_steady_state(r: float, q: float) -> None:
    solution = solve_chain(scalar_chain(r, q, 4001))
    filtered = (-q + np.sqrt(q * q + 4 * q * r)) / 2
    smoothed = 1 / np.sqrt(1 / r**2 + 4 / (r * q))
    rho = 1 + q / (2 * r) - np.sqrt(q / r + (q / (2 * r)) ** 2)
    assert solution.covariance[-1, 0, 0] == pytest.approx(filtered, rel=1e-9)
    assert solution.covariance[2000, 0, 0] == pytest.approx(smoothed, rel=1e-9)
    correlation = solution.lag_one[2000, 0, 0] / solution.covariance[2000, 0, 0]
    assert correlation == pytest.approx(rho, rel=1e-9)
    if (r, q) == (1.0, 0.01):
        assert filtered == pytest.approx(0.0951249, abs=5e-8)
        assert smoothed == pytest.approx(0.0499376, abs=5e-8)


def test_tv14_fixed_lag() -> None:
    live = ChainFilter(1, lag=20)
    chain = scalar_chain(1.0, 0.01, 2001)
    live.sweep(chain.H, chain.z, chain.M, chain.L, chain.u)
    variances = [live.lagged(lag).covariance[0, 0] for lag in (0, 1, 5, 10, 20)]
    np.testing.assert_allclose(variances, [0.095125, 0.086937, 0.066568, 0.056058, 0.050767], rtol=0, atol=5e-7)


# ---------------------------------------------------------------- the same answer by other means


@pytest.mark.parametrize("n", range(1, 10))
def test_chain_is_dense_least_squares(n: int) -> None:
    agree(random_chain(n, n))


@pytest.mark.parametrize("n", [1, 3, 4, 6])
def test_redundant_couplings(n: int) -> None:
    chain = random_chain(n, n, q=n + 2)
    agree(chain)
    assert (solve_chain(chain).coupling_dof == 2).all()


@pytest.mark.parametrize("n", [2, 3, 6])
def test_no_prior_and_first_fix_late(n: int) -> None:
    chain = random_chain(n, n, m=n, gaps=False, prior=False)
    counts = np.full(len(chain), n)
    counts[:5] = 0
    late = Chain(chain.H, chain.z, chain.M, chain.L, chain.u, counts=counts)
    agree(late)
    solution = solve_chain(late, filtered=True)
    assert solution.first_determined == 5
    assert np.isnan(solution.filtered[:5]).all()
    assert np.isfinite(solution.filtered[5:]).all()


@pytest.mark.parametrize("n", [3, 4])
def test_start_seen_piece_by_piece(n: int) -> None:
    """One row an epoch: the pivots fill one by one, on the row-by-row path."""
    chain = random_chain(7, n, m=1, gaps=False, prior=False)
    agree(chain, 1e-8)
    solution = solve_chain(chain, filtered=True)
    assert solution.first_determined == n - 1
    assert (solution.dof[:n] == [0] * n).all()
    assert (solution.dof[n:] == 1).all()


def test_same_row_twice_is_redundant_not_a_pivot_of_rounding() -> None:
    h = np.array([[0.1, 0.2, 0.3], [0.3, 0.6, 0.9], [0.7, 1.4, 2.1]])
    filtering = ChainFilter(3)
    block = filtering.observe(h, [1.0, 3.0, 7.0])
    assert block.dof == 2
    assert not filtering.determined
    with pytest.raises(EstimationError, match="component 1 of the state is not determined"):
        filtering.estimate()


@pytest.mark.parametrize("n", [3, 6])
def test_filter_smoother_and_nis_are_those_of_kalman_and_rts(n: int) -> None:
    rng = np.random.default_rng(n)
    N, m = 60, 3
    F = np.eye(n) + 0.1 * rng.standard_normal((N - 1, n, n))
    g = rng.standard_normal((N - 1, n))
    A, B = rng.standard_normal((N - 1, n, n)), rng.standard_normal((N, m, m))
    Q, R = A @ np.swapaxes(A, 1, 2) + np.eye(n), B @ np.swapaxes(B, 1, 2) + np.eye(m)
    H, z = rng.standard_normal((N, m, n)), rng.standard_normal((N, m))
    z[10:15] = np.nan
    x0, P0 = rng.standard_normal(n), 4 * np.eye(n)
    expected = kalman_rts(x0, P0, F, g, Q, H, R, z)
    WQ, WR, WP = inverse_root(Q), inverse_root(R), inverse_root(P0)
    counts = np.where(np.isnan(z).any(axis=1), 0, m)
    chain = Chain(
        WR @ H,
        (WR @ z[:, :, None])[:, :, 0],
        -WQ @ F,
        WQ,
        (WQ @ g[:, :, None])[:, :, 0],
        counts=counts,
        prior=(WP, WP @ x0),
    )
    solution = solve_chain(chain, filtered=True)
    np.testing.assert_allclose(solution.filtered, expected.filtered, atol=1e-10, rtol=1e-10)
    np.testing.assert_allclose(solution.state, expected.state, atol=1e-10, rtol=1e-10)
    np.testing.assert_allclose(solution.covariance, expected.covariance, atol=1e-10, rtol=1e-10)
    np.testing.assert_allclose(solution.nis, expected.nis, atol=1e-10, rtol=1e-10)
    np.testing.assert_array_equal(solution.dof, counts)


def test_cross_covariances_are_the_dense_ones() -> None:
    chain = random_chain(5, 3, epochs=12)
    blocks = dense(chain)[1].reshape(12, 3, 12, 3)
    solution = solve_chain(chain)
    for i, j in ((0, 0), (2, 3), (1, 9)):
        np.testing.assert_allclose(solution.cross_covariance(i, j), blocks[i, :, j, :], rtol=0, atol=1e-12)
    with pytest.raises(EstimationError, match="not 0 <= i <= j"):
        solution.cross_covariance(3, 2)


def test_numpy_rows_are_the_twin_of_the_compiled_sweep() -> None:
    for n in (2, 3, 6):
        chain = random_chain(n + 20, n)
        solution, twin = solve_chain(chain), row_reduction(chain)
        np.testing.assert_allclose(solution.state, twin.state, rtol=0, atol=1e-12)
        # rows of a triangle with positive diagonal are unique
        np.testing.assert_allclose(solution.records, twin.records, rtol=0, atol=1e-12)
        np.testing.assert_allclose(solution.triangle, twin.triangle, rtol=0, atol=1e-12)
        nis = np.zeros(len(chain))
        for epoch, f in twin.residuals:
            nis[epoch] += f * f
        np.testing.assert_allclose(solution.nis, nis, rtol=0, atol=1e-11)


def test_sizes_compiled_apart_agree_with_the_general_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    chain = random_chain(1, 3, q=4)
    special = solve_chain(chain)
    monkeypatch.setattr(chain_module, "SPECIALISED_SIZES", ())
    general = solve_chain(chain)
    np.testing.assert_allclose(special.state, general.state, rtol=0, atol=1e-13)
    np.testing.assert_allclose(special.records, general.records, rtol=0, atol=1e-13)


@pytest.mark.parametrize("seed", range(6))
def test_three_states_with_upper_rows_are_the_general_loop(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rotations written out for n = 3: late starts, gaps, zeros within rows, links that say little, weights over eight decades."""
    rng = np.random.default_rng(seed)
    N = 60
    scale = 10.0 ** rng.uniform(-4, 4, (3, N, 1, 1))
    H, M, L = (np.triu(rng.standard_normal((N, 3, 3)) + 2 * np.eye(3)) * s for s in scale)
    H[7, 0, 1] = M[9, 1, 1] = M[11, 0, 2] = H[13, 2, 2] = L[15, 1, 1] = 0.0
    M[17] = -L[17]
    M[19, 2, 2] = 0.0
    L[21, 2] = 0.0
    counts, links = rng.choice([0, 3, 3, 3, 2], N), np.full(N - 1, 3)
    counts[: seed % 4] = 0
    links[30] = 2
    u, z = rng.standard_normal((2, N, 3))
    chain = Chain(H, z, M[:-1], L[:-1], u[:-1], counts=counts, coupling_counts=links, prior=(np.eye(3), np.ones(3)))
    special = solve_chain(chain, filtered=True)
    monkeypatch.setattr(chain_module, "SPECIALISED_SIZES", ())
    general = solve_chain(chain, filtered=True)
    for name in ("records", "triangle", "nis", "coupling_nis", "filtered", "state"):
        np.testing.assert_allclose(getattr(special, name), getattr(general, name), rtol=1e-8, atol=1e-9, err_msg=name)
    for name in ("dof", "coupling_dof"):
        np.testing.assert_array_equal(getattr(special, name), getattr(general, name), err_msg=name)
    twin = row_reduction(chain)
    np.testing.assert_allclose(special.state, twin.state, rtol=1e-7, atol=1e-8)


def test_long_chain_equals_banded_normal_equations() -> None:
    rng = np.random.default_rng(3)
    N = 20_000
    chain = increment_chain(
        0.02 * rng.standard_normal((N, 3)), 4e-4 * np.eye(3), 1e-3 * rng.standard_normal((N - 1, 3)), 1e-6 * np.eye(3)
    )
    np.testing.assert_allclose(solve_chain(chain, covariance=False).state, banded_solution(chain), rtol=0, atol=1e-12)


SCRIPT = """
import json
import numpy as np
from railnav.estimation import Chain, ChainFilter, solve_chain, update
rng = np.random.default_rng(0)
for n, q in ((2, 2), (3, 4)):
    H, z = rng.standard_normal((9, 2, n)), rng.standard_normal((9, 2))
    M, L = rng.standard_normal((2, 8, q, n))
    chain = Chain(H, z, M, L + 3 * np.eye(q, n), rng.standard_normal((8, q)), counts=[0, 1, 2, 2, 0, 2, 2, 1, 2])
    s = solve_chain(chain, filtered=True, gate=0.3)
    print(json.dumps(np.concatenate([s.state.ravel(), s.covariance.ravel(), s.nis, s.rejected, s.coupling_nis]).tolist()))
u = update([0.0, 1.0], np.eye(2), [1.0], [[1.0, 2.0]], [[0.5]])
print(json.dumps([*u.state, *u.P_sqrt.ravel(), u.nis, u.log_evidence]))
"""


def test_interpreted_and_compiled_kernels_agree() -> None:
    answers = []
    for off in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": off}
        out = subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True
        )
        answers.append([json.loads(line) for line in out.stdout.splitlines()])
    for compiled, interpreted in zip(*answers, strict=True):
        np.testing.assert_allclose(compiled, interpreted, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("n", [2, 3, 6])
def test_without_records_the_answer_is_the_same_and_the_store_small(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chain_module, "PAGE", 7)
    for q in (n, n + 1):
        chain = random_chain(n + 60, n, q=q)
        whole = solve_chain(chain, covariance=False, filtered=True, evidence=True, gate=0.5)
        lean = solve_chain(chain, covariance=False, filtered=True, evidence=True, gate=0.5, records=False)
        for name in (
            "state",
            "nis",
            "dof",
            "rejected",
            "filtered",
            "log_evidence",
            "coupling_nis",
            "coupling_dof",
            "triangle",
        ):
            np.testing.assert_allclose(getattr(lean, name), getattr(whole, name), rtol=0, atol=1e-11, err_msg=name)
        assert lean.records.shape == (0, n, 2 * n + 1)
        assert lean.redundancy == whole.redundancy
        assert whole.rejected.any()
    with pytest.raises(EstimationError, match="covariances need the records"):
        solve_chain(chain, records=False)
    with pytest.raises(EstimationError, match="without records"):
        ChainRecords.of(lean)
    with pytest.raises(EstimationError, match="without records"):
        fixed_lag(lean, 3)
    alone = Chain(chain.H, chain.z, chain.M[:, :n], chain.L[:, :n], chain.u[:, :n], counts=np.zeros(len(chain), int))
    with pytest.raises(EstimationError, match="epoch 39: component"):
        solve_chain(alone, covariance=False, records=False)


def test_links_of_n_rows_may_leave_residuals_too() -> None:
    """A link row that holds only the state before is redundant: room for residuals of links is made when they are met."""
    chain = random_chain(77, 3)
    L = chain.L.copy()
    L[20, 0] = 0.0
    odd = Chain(chain.H, chain.z, chain.M, L, chain.u, counts=chain.counts, prior=chain.prior)
    solution = solve_chain(odd)
    assert list(np.flatnonzero(solution.coupling_dof)) == [20]
    assert solution.coupling_dof[20] == 1
    assert solution.sum_of_squares == pytest.approx(dense(odd)[2], rel=1e-10)
    agree(odd, 1e-8)


# ---------------------------------------------------------------- live


@pytest.mark.parametrize("n", [1, 3, 6])
def test_filter_row_by_row_and_in_stretches_is_the_chain(n: int) -> None:
    chain = random_chain(n + 40, n, m=n, gaps=False)
    solution = solve_chain(chain, filtered=True)
    live, swept = ChainFilter(n, prior=chain.prior, lag=7), ChainFilter(n, prior=chain.prior, lag=7)
    for k in range(len(chain)):
        if k:
            live.couple(chain.M[k - 1], chain.L[k - 1], chain.u[k - 1])
        block = live.observe(chain.H[k], chain.z[k])
        assert block.nis == pytest.approx(solution.nis[k], abs=1e-11)
        np.testing.assert_allclose(live.estimate().state, solution.filtered[k], rtol=0, atol=1e-11)
    nis = []
    for a, b in ((0, 1), (1, 13), (13, 40)):
        couplings = slice(max(a - 1, 0), b - 1)
        result = swept.sweep(
            chain.H[a:b], chain.z[a:b], chain.M[couplings], chain.L[couplings], chain.u[couplings], filtered=True
        )
        np.testing.assert_allclose(result.filtered, solution.filtered[a:b], rtol=0, atol=1e-11)
        nis.append(result.nis)
    np.testing.assert_allclose(np.concatenate(nis), solution.nis, rtol=0, atol=1e-11)
    assert live.epoch == swept.epoch == 39
    for filtering in (live, swept):
        np.testing.assert_allclose(filtering.triangle, solution.triangle, rtol=0, atol=1e-11)
        for lag in (0, 3, 7):
            here = filtering.lagged(lag)
            assert here.epoch == 39 - lag
            np.testing.assert_allclose(here.state, solution.state[39 - lag], rtol=0, atol=1e-11)
            np.testing.assert_allclose(here.covariance, solution.covariance[39 - lag], rtol=0, atol=1e-11)
        with pytest.raises(EstimationError, match="lag 8 is not kept"):
            filtering.lagged(8)


def test_a_refused_row_leaves_the_filter_as_it_was() -> None:
    live = ChainFilter(2, prior=(np.eye(2), np.zeros(2)), lag=3)
    live.observe(np.eye(2), [1.0, 2.0])
    live.couple(-np.eye(2), np.eye(2), [1.0, 1.0])
    before = live.triangle
    for wrong, message in (
        (lambda: live.observe(np.eye(2), [np.nan, 0.0]), "z is not finite at epoch 0, row 0"),
        (lambda: live.couple(-np.eye(2), np.eye(2), [0.0, np.inf]), "u is not finite at coupling 0, row 1"),
        (lambda: live.couple(np.zeros((2, 2)), np.eye(2), [0.0, 0.0]), "link from epoch 1 couples nothing"),
        (lambda: live.observe(np.eye(3), np.zeros(3)), "3 coefficients; the filter's states have 2"),
        (lambda: ChainFilter(0), "makes no sense"),
    ):
        with pytest.raises(EstimationError, match=message):
            wrong()
        np.testing.assert_array_equal(live.triangle, before)
        assert live.epoch == 1
    np.testing.assert_allclose(live.lagged(1).state, [0.5, 1.0], rtol=0, atol=1e-14)


def test_evidence_is_the_normal_density_of_the_innovation() -> None:
    from scipy.stats import multivariate_normal

    rng = np.random.default_rng(11)
    P0, R = np.cov(rng.standard_normal((4, 20))), np.cov(rng.standard_normal((3, 20)))
    x0, H, y = rng.standard_normal(4), rng.standard_normal((3, 4)), rng.standard_normal(3)
    W0, W = inverse_root(P0), inverse_root(R)
    block = ChainFilter(4, prior=(W0, W0 @ x0)).observe(W @ H, W @ y, log_det_whitening=np.linalg.slogdet(W)[1])
    S = H @ P0 @ H.T + R
    nu = y - H @ x0
    assert block.nis == pytest.approx(nu @ np.linalg.solve(S, nu), rel=1e-12)
    assert block.log_evidence == pytest.approx(multivariate_normal(H @ x0, S).logpdf(y), rel=1e-12)
    assert ChainFilter(4).observe(W @ H, W @ y).log_evidence is None


# ---------------------------------------------------------------- degenerate chains


def test_one_epoch() -> None:
    chain = Chain([[2.0, 0.0], [0.0, 1.0], [1.0, 1.0]], [[2.0, 3.0, 4.0]])
    agree(chain)
    assert solve_chain(chain).lag_one.shape == (0, 2, 2)


def test_rows_of_zeros_are_absent() -> None:
    chain = random_chain(9, 3, m=3, gaps=False)
    H, z = chain.H.copy(), chain.z.copy()
    H[4:9] = 0.0
    H[20, 1] = 0.0
    z[20, 1] = 99.0
    counts = np.full(40, 3)
    counts[4:9] = 0
    counts[20] = 2
    packed = H.copy(), z.copy()
    packed[0][20, 1], packed[1][20, 1] = H[20, 2], z[20, 2]
    zeros = solve_chain(Chain(H, z, chain.M, chain.L, chain.u, prior=chain.prior))
    absent = solve_chain(Chain(*packed, chain.M, chain.L, chain.u, prior=chain.prior, counts=counts))
    np.testing.assert_allclose(zeros.state, absent.state, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(zeros.dof, counts)
    agree(Chain(H, z, chain.M, chain.L, chain.u, prior=chain.prior))


def test_couplings_padded_with_zeros_are_as_those_without() -> None:
    chain = random_chain(16, 3)
    pad = ((0, 0), (1, 2), (0, 0))
    padded = Chain(
        chain.H, chain.z, np.pad(chain.M, pad), np.pad(chain.L, pad), np.pad(chain.u, pad[:2], constant_values=7.0),
        counts=chain.counts, prior=chain.prior,
    )  # fmt: skip
    plain, same = solve_chain(chain), solve_chain(padded)
    np.testing.assert_array_equal(same.state, plain.state)
    assert not same.coupling_dof.any()
    assert not same.coupling_nis.any()


def test_values_beyond_the_count_may_be_anything() -> None:
    chain = random_chain(10, 3)
    H, z = chain.H.copy(), chain.z.copy()
    beyond = np.arange(3) >= chain.counts[:, None]
    H[beyond], z[beyond] = np.nan, np.nan
    again = Chain(H, z, chain.M, chain.L, chain.u, counts=chain.counts, prior=chain.prior)
    np.testing.assert_array_equal(solve_chain(again).state, solve_chain(chain).state)


def test_gap_makes_the_covariance_grow_and_nothing_else() -> None:
    X = np.zeros((50, 3))
    X[20:30] = np.nan
    solution = solve_chain(increment_chain(X, 1e-4 * np.eye(3), np.zeros((49, 3)), 1e-6 * np.eye(3)))
    sigma = solution.sigma[:, 0]
    assert np.argmax(sigma[5:45]) + 5 in (24, 25)
    np.testing.assert_allclose(solution.state, 0.0, rtol=0, atol=1e-15)


@pytest.mark.parametrize("how", ["counts", "zeros"])
def test_broken_link_is_refused_by_its_name(how: str) -> None:
    chain = random_chain(12, 3, m=3, gaps=False)
    M, L, counts = chain.M.copy(), chain.L.copy(), np.full(39, 3)
    if how == "counts":
        counts[17] = 0
    else:
        M[17] = L[17] = 0.0
    broken = Chain(chain.H, chain.z, M, L, chain.u, prior=chain.prior, coupling_counts=counts)
    with pytest.raises(EstimationError, match="between epochs 17 and 18 couples nothing"):
        solve_chain(broken)
    parts = solve_chain(broken, allow_breaks=True)
    head = Chain(chain.H[:18], chain.z[:18], M[:17], L[:17], chain.u[:17], prior=chain.prior)
    np.testing.assert_allclose(parts.state[:18], solve_chain(head).state, rtol=0, atol=1e-12)
    np.testing.assert_allclose(parts.lag_one[17], 0.0, rtol=0, atol=1e-15)


def test_undetermined_states_are_refused_with_epoch_and_component() -> None:
    chain = random_chain(13, 3, m=3, gaps=False, prior=False)
    never = Chain(chain.H, chain.z, chain.M, chain.L, chain.u, counts=np.zeros(40, int))
    with pytest.raises(EstimationError, match=r"epoch 39: component 2 .*there is no observation"):
        solve_chain(never)
    H = chain.H.copy()
    H[:, :, 2] = 0.0
    blind = Chain(H, chain.z, np.broadcast_to(-np.eye(3), (39, 3, 3)), np.eye(3), chain.u)
    with pytest.raises(EstimationError, match="component 2 of the state is not determined"):
        solve_chain(blind)


def test_values_that_are_not_finite_are_named() -> None:
    chain = random_chain(14, 3, m=3, gaps=False)
    for name, index, message in (
        ("z", (7, 1), "z is not finite at epoch 7, row 1"),
        ("H", (8, 2, 0), "H is not finite at epoch 8, row 2"),
        ("u", (9, 0), "u is not finite at coupling 9, row 0"),
        ("L", (3, 1, 1), "L is not finite at coupling 3, row 1"),
    ):
        arrays = {key: getattr(chain, key).copy() for key in ("H", "z", "M", "L", "u")}
        arrays[name][index] = np.nan
        with pytest.raises(EstimationError, match=message):
            solve_chain(Chain(**arrays, prior=chain.prior))
        filtering = ChainFilter(3, prior=chain.prior)
        with pytest.raises(EstimationError, match=message):
            filtering.sweep(**arrays)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"z": np.zeros(3)}, "z has shape"),
        ({"z": np.zeros((0, 2))}, "at least one epoch"),
        ({"H": np.zeros((4, 2, 3))}, "H has shape"),
        ({"H": np.zeros((3, 2, 0))}, "state of no numbers"),
        ({"M": None}, "need coupling rows"),
        ({"M": np.zeros((2, 2, 3))}, "M has shape"),
        ({"u": np.zeros((4, 3))}, "u has shape"),
        ({"counts": [1, 2]}, "counts has shape"),
        ({"counts": [1.0, 2.0, 2.0]}, "integers fit"),
        ({"counts": [1, 2, 3]}, "0 to 2 rows"),
        ({"coupling_counts": [-1, 3]}, "runs from -1"),
        ({"prior": (np.zeros((2, 2)), np.zeros(2))}, "prior has shapes"),
        ({"prior": (np.full((2, 3), np.nan), np.zeros(2))}, "prior is not finite"),
        ({"z": "abc"}, "z is not an array of numbers"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(change: dict[str, object], message: str) -> None:
    arrays = {"H": np.ones((3, 2, 3)), "z": np.ones((3, 2)), "M": np.eye(3), "L": np.eye(3), "u": np.zeros((2, 3))}
    with pytest.raises(EstimationError, match=message):
        Chain(**{**arrays, **change})


def test_arrays_given_once_hold_for_every_epoch() -> None:
    rng = np.random.default_rng(2)
    H, M, L, z = np.eye(3) * 2, -np.eye(3), np.eye(3), rng.standard_normal((20, 3))
    once = solve_chain(Chain(H, z, M, L, np.zeros(3)))
    every = solve_chain(
        Chain(np.tile(H, (20, 1, 1)), z, np.tile(M, (19, 1, 1)), np.tile(L, (19, 1, 1)), np.zeros((19, 3)))
    )
    np.testing.assert_array_equal(once.state, every.state)
    np.testing.assert_array_equal(once.covariance, every.covariance)
    agree(Chain(H, z, M, L, np.zeros(3)))


def test_inputs_are_left_alone_and_may_be_read_only() -> None:
    chain = random_chain(15, 3)
    before = [a.copy() for a in (chain.H, chain.z, chain.M, chain.L, chain.u)]
    for a in (chain.H, chain.z, chain.M, chain.L, chain.u):
        a.flags.writeable = False
    solve_chain(Chain(chain.H, chain.z, chain.M, chain.L, chain.u, counts=chain.counts, prior=chain.prior))
    for a, b in zip(before, (chain.H, chain.z, chain.M, chain.L, chain.u), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_perfect_measurement_is_refused() -> None:
    K = np.diag([1.0, 0.0, 1.0])
    with pytest.raises(EstimationError, match=r"perfect measurement .*use a sigma of 1e-6"):
        increment_chain(np.zeros((3, 3)), K, np.zeros((2, 3)), np.eye(3))


def test_no_redundancy_says_so() -> None:
    solution = solve_chain(Chain(np.eye(2), [[1.0, 2.0]]), covariance=False)
    with pytest.raises(EstimationError, match="no row is redundant"):
        _ = solution.unit_weight_rms
    with pytest.raises(EstimationError, match="without covariances"):
        _ = solution.sigma


def test_raw_coordinates_lose_digits_that_corrections_keep() -> None:
    """Corrections to nominal ones: the stated reason, measured."""
    rng = np.random.default_rng(6)
    N = 3000
    nominal = np.column_stack([6.2e6 + np.arange(N), 8.5e6 + 0.3 * np.arange(N), np.full(N, 150.0)])
    noise, steps = 0.02 * rng.standard_normal((N, 3)), 1e-3 * rng.standard_normal((N - 1, 3))
    K, KD = 4e-4 * np.eye(3), 1e-6 * np.eye(3)
    exact = solve_chain(increment_chain(noise, K, steps, KD)).state
    X, dX = nominal + noise, np.diff(nominal, axis=0) + steps
    corrections = solve_chain(increment_chain(X, K, dX, KD, nominal=nominal)).state
    raw = solve_chain(increment_chain(X, K, dX, KD)).state - nominal
    np.testing.assert_allclose(corrections, exact, rtol=0, atol=2e-9)  # the last digit of X itself is 1e-9 m
    assert np.abs(raw - exact).max() < 1e-6


def test_stiff_chain_keeps_its_digits() -> None:
    """Increments of 1 micrometre, a fix every 1000 nodes: against extended precision, where normal equations lose 1e-10 m."""
    rng = np.random.default_rng(7)
    N, sd = 10_000, 1e-6
    truth = np.cumsum(rng.normal(0, sd, N))
    X = np.full((N, 1), np.nan)
    X[::1000, 0] = truth[::1000] + 0.01 * rng.standard_normal(N // 1000)
    dX = np.diff(truth)[:, None] + sd * rng.standard_normal((N - 1, 1))
    chain = increment_chain(X, [[1e-4]], dX, [[sd**2]])
    wide = np.longdouble
    H, z = wide(chain.H[0, 0, 0]), chain.z[:, 0].astype(wide)
    W, u = wide(chain.L[0, 0, 0]), chain.u[:, 0].astype(wide)
    diagonal, right = np.where(chain.counts > 0, H * H, wide(0)), np.where(chain.counts > 0, H * z, wide(0))
    diagonal[:-1] += W * W
    diagonal[1:] += W * W
    right[:-1] -= W * u
    right[1:] += W * u
    for k in range(1, N):
        factor = W * W / diagonal[k - 1]
        diagonal[k] -= factor * W * W
        right[k] += factor * right[k - 1]
    exact = np.zeros(N, wide)
    exact[-1] = right[-1] / diagonal[-1]
    for k in range(N - 2, -1, -1):
        exact[k] = (right[k] + W * W * exact[k + 1]) / diagonal[k]
    ours = np.abs(solve_chain(chain, covariance=False).state[:, 0] - exact).max()
    normal = np.abs(banded_solution(chain)[:, 0] - exact).max()
    assert ours < 1e-12
    assert normal > 100 * ours  # the chain is hard enough for the test to mean something


@pytest.mark.parametrize("seed", range(5))
def test_a_strong_row_after_a_weak_pivot_keeps_its_digits(seed: int) -> None:
    """Weights 1e6 apart both ways, against exact fractions."""
    from fractions import Fraction

    rng = np.random.default_rng(seed)
    n = 3
    prior = (1e-6 * np.array([[1e-3, 1e3, 1.0], [0.0, 1.0, -1e3], [0.0, 0.0, 1.0]]), 1e-6 * rng.standard_normal(n))
    H, z = 1e6 * rng.standard_normal((2, n, n)), 1e6 * rng.standard_normal((2, n))
    M, L = rng.standard_normal((2, 1, n, n)) + 2 * np.eye(n)
    chain = Chain(H, z, M, L, rng.standard_normal((1, n)), prior=prior)
    system = dense_system(chain)
    A = [[Fraction(v) for v in row] for row in system.A]
    b = [Fraction(v) for v in system.b]
    size = 2 * n
    N = [[sum(r[i] * r[j] for r in A) for j in range(size)] + [sum(r[i] * y for r, y in zip(A, b, strict=True))]
         for i in range(size)]  # fmt: skip
    for i in range(size):
        N[i] = [v / N[i][i] for v in N[i]]
        for j in range(size):
            if j != i:
                N[j] = [a - N[j][i] * c for a, c in zip(N[j], N[i], strict=True)]
    exact = np.array([float(row[-1]) for row in N])
    spread = np.linalg.cond(H).max()
    np.testing.assert_allclose(
        solve_chain(chain).state.ravel(), exact, rtol=0, atol=2e-16 * spread * np.abs(exact).max()
    )


# ---------------------------------------------------------------- constant velocity


def test_constant_velocity_is_the_textbook_filter() -> None:
    rng = np.random.default_rng(8)
    N, S = 40, 0.3
    t = np.cumsum(rng.uniform(0.2, 2.0, N))
    X = rng.standard_normal((N, 3))
    V = rng.standard_normal((N, 3))
    X[5:8], V[7:12] = np.nan, np.nan
    K, KV = 0.2 * np.eye(3) + 0.1, 0.5 * np.eye(3) + 0.1
    P0 = np.diag([9.0] * 3 + [4.0] * 3)
    W0 = inverse_root(P0)
    nominal = np.column_stack([np.outer(t, [3.0, 1.0, 0.0]), np.tile([3.0, 1.0, 0.1], (N, 1))])
    chain = constant_velocity_chain(
        t, X, K, acceleration_density=S, velocity=V, velocity_covariance=KV, nominal=nominal,
        prior=(W0, -W0 @ nominal[0]),
    )  # fmt: skip
    h = np.diff(t)
    one, zero = np.eye(3), np.zeros((3, 3))
    F = np.array([np.block([[one, a * one], [zero, one]]) for a in h])
    Q = np.array([S * np.block([[a**3 / 3 * one, a**2 / 2 * one], [a**2 / 2 * one, a * one]]) for a in h])
    # an absent measurement is one of no weight
    R = np.array([np.block([[K if np.isfinite(x[0]) else 1e12 * one, zero], [zero, KV if np.isfinite(v[0]) else 1e12 * one]])
                  for x, v in zip(X, V, strict=True)])  # fmt: skip
    z = np.nan_to_num(np.column_stack([X, V]))
    expected = kalman_rts(np.zeros(6), P0, F, np.zeros((N - 1, 6)), Q, np.tile(np.eye(6), (N, 1, 1)), R, z)
    solution = solve_chain(chain)
    np.testing.assert_allclose(solution.state + nominal, expected.state, rtol=0, atol=1e-8)
    np.testing.assert_allclose(solution.covariance, expected.covariance, rtol=0, atol=1e-8)
    assert solution.dof[6] == 3
    assert solution.dof[7] == 0
    assert solution.dof[10] == 3


def test_constant_velocity_refuses_time_that_stands_still() -> None:
    with pytest.raises(EstimationError, match="time does not increase from epoch 1"):
        constant_velocity_chain([0, 1, 1], np.zeros((3, 1)), [[1.0]], acceleration_density=1.0)
    with pytest.raises(EstimationError, match="must be positive"):
        constant_velocity_chain([0, 1, 2], np.zeros((3, 1)), [[1.0]], acceleration_density=0.0)


def test_increment_chain_refuses_a_wrong_number_of_increments() -> None:
    with pytest.raises(EstimationError, match="3 positions have 2 increments"):
        increment_chain(np.zeros((3, 3)), np.eye(3), np.zeros((3, 3)), np.eye(3))
    with pytest.raises(EstimationError, match="increment_covariance has shape"):
        increment_chain(np.zeros((3, 3)), np.eye(3), np.zeros((2, 3)), np.ones((3, 3, 3)))


# ---------------------------------------------------------------- gate


def test_gate_leaves_out_a_bad_fix_and_only_that() -> None:
    rng = np.random.default_rng(4)
    X = 0.01 * rng.standard_normal((100, 3))
    X[50, 0] += 0.30
    K, KD = 1e-4 * np.eye(3), 1e-6 * np.eye(3)
    chain = increment_chain(X, K, np.zeros((99, 3)), KD)
    gated = solve_chain(chain, gate=1e-4)
    assert np.flatnonzero(gated.rejected).tolist() == [50]
    assert gated.nis[50] > 100
    X[50] = np.nan
    without = solve_chain(increment_chain(X, K, np.zeros((99, 3)), KD))
    np.testing.assert_allclose(gated.state, without.state, rtol=0, atol=1e-14)
    assert gated.redundancy == without.redundancy
    assert gated.sum_of_squares == pytest.approx(without.sum_of_squares)
    assert not solve_chain(chain).rejected.any()


# ---------------------------------------------------------------- laws

sizes = st.integers(1, 5)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), n=sizes, gaps=st.booleans())
def test_law_chain_is_dense(seed: int, n: int, gaps: bool) -> None:
    agree(random_chain(seed, n, epochs=8, gaps=gaps), 1e-7)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), n=sizes, epoch=st.integers(0, 9))
def test_law_a_measurement_never_adds_uncertainty(seed: int, n: int, epoch: int) -> None:
    chain = random_chain(seed, n, epochs=10)
    less = chain.counts.copy()
    less[epoch] = max(less[epoch] - 1, 0)
    more = solve_chain(chain).covariance
    fewer = solve_chain(Chain(chain.H, chain.z, chain.M, chain.L, chain.u, counts=less, prior=chain.prior)).covariance
    gain = np.linalg.eigvalsh(fewer - more)
    assert gain.min() > -1e-9 * np.abs(fewer).max()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), n=sizes, data=st.data())
def test_law_the_order_of_rows_in_a_block_is_immaterial(seed: int, n: int, data: st.DataObject) -> None:
    chain = random_chain(seed, n, epochs=10, m=4, gaps=False, q=n + 1)
    order = data.draw(st.permutations(range(4)))
    couplings = data.draw(st.permutations(range(n + 1)))
    shuffled = Chain(
        chain.H[:, order], chain.z[:, order], chain.M[:, couplings], chain.L[:, couplings], chain.u[:, couplings],
        prior=chain.prior,
    )  # fmt: skip
    a, b = solve_chain(chain), solve_chain(shuffled)
    scale = max(1.0, np.abs(a.state).max())
    np.testing.assert_allclose(a.state, b.state, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=0, atol=1e-9 * max(1.0, np.abs(a.covariance).max()))
    np.testing.assert_allclose(a.nis, b.nis, rtol=0, atol=1e-8 * max(1.0, a.nis.max()))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), n=sizes)
def test_law_a_chain_turned_round_has_the_same_posterior(seed: int, n: int) -> None:
    chain = random_chain(seed, n, epochs=10, m=n, gaps=False, prior=False)
    back = Chain(chain.H[::-1], chain.z[::-1], chain.L[::-1], chain.M[::-1], chain.u[::-1])
    a, b = solve_chain(chain), solve_chain(back)
    scale = max(1.0, np.abs(a.covariance).max())
    np.testing.assert_allclose(a.state, b.state[::-1], rtol=0, atol=1e-8 * scale)
    np.testing.assert_allclose(a.covariance, b.covariance[::-1], rtol=0, atol=1e-8 * scale)
    assert a.sum_of_squares == pytest.approx(b.sum_of_squares, rel=1e-7, abs=1e-9)


# ---------------------------------------------------------------- does it know how wrong it is?


def simulated(runs: int, epochs: int, seed: int) -> tuple[np.ndarray, list[np.ndarray], float]:
    """NEES in mid-chain of each run, NIS of all, unit-weight RMS over all runs."""
    rng = np.random.default_rng(seed)
    A = np.array([[4, 1, 0], [1, 4, 0], [0, 0, 9]]) * 1e-4
    B = np.array([[1, 0, 0], [0, 4, 1], [0, 1, 4]]) * 1e-6
    LA, LB = np.linalg.cholesky(A), np.linalg.cholesky(B)
    middle, nis, mu = [], [], []
    for _ in range(runs):
        X = rng.standard_normal((epochs, 3)) @ LA.T  # truth is zero: corrections to nominal
        dX = rng.standard_normal((epochs - 1, 3)) @ LB.T
        solution = solve_chain(increment_chain(X, A, dX, B))
        k = epochs // 2
        middle.append(nees(solution.state[k : k + 1], solution.covariance[k])[0])
        nis.append(solution.nis[1:])
        mu.append(solution.unit_weight_rms)
    return np.array(middle), nis, float(np.sqrt(np.mean(np.square(mu))))


def test_nees_and_nis_lie_inside_their_bounds() -> None:
    middle, nis, mu = simulated(runs=200, epochs=41, seed=1)
    assert consistency(middle, 3).consistent
    assert consistency(np.concatenate(nis), 3).consistent
    assert mu == pytest.approx(1.0, abs=0.015)  # three sigma of 200 runs with some 120 redundant rows


def test_the_bounds_catch_a_chain_that_is_too_sure() -> None:
    rng = np.random.default_rng(1)
    K, KD = 4e-4 * np.eye(3), 1e-6 * np.eye(3)
    X, dX = 0.02 * rng.standard_normal((400, 3)), 1e-3 * rng.standard_normal((399, 3))
    honest = solve_chain(increment_chain(X, K, dX, KD))
    boastful = solve_chain(increment_chain(X, K / 1.3, dX, KD))
    assert consistency(honest.nis, honest.dof).consistent
    assert not consistency(boastful.nis, boastful.dof).consistent


def test_records_are_kept_without_zeros() -> None:
    """144 bytes a node for n = 3 (rail 15.7): the whole solution of 20,000 nodes, residuals and all, fits in 190 bytes a node."""
    import tracemalloc

    rng = np.random.default_rng(4)
    N = 20_000
    chain = increment_chain(rng.standard_normal((N, 3)), np.eye(3), rng.standard_normal((N - 1, 3)), 0.01 * np.eye(3))
    solution = solve_chain(chain, covariance=False)
    assert solution.packed.shape == (N - 1, 18)
    np.testing.assert_array_equal(solution.records[:, 1:, 0], 0.0)
    np.testing.assert_array_equal(solution.records[:, 0], solution.packed[:, :7])
    tracemalloc.start()
    kept = solve_chain(chain, covariance=False)
    size, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(kept.state) == N
    assert peak < 190 * N, (size, peak)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_unpacked_records_are_rows_of_the_square_root(n: int) -> None:
    """Records of any size, unpacked, reproduce the states one by one: R_kk x_k + R_kn x_(k+1) = d_k."""
    rng = np.random.default_rng(n)
    chain = Chain(
        np.eye(n), rng.standard_normal((9, n)), -np.eye(n) + 0.1 * rng.standard_normal((8, n, n)), np.eye(n),
        rng.standard_normal((8, n)),
    )  # fmt: skip
    solution = solve_chain(chain)
    r = solution.records
    left = np.einsum("kij,kj->ki", r[:, :, :n], solution.state[:-1]) + np.einsum(
        "kij,kj->ki", r[:, :, n : 2 * n], solution.state[1:]
    )
    np.testing.assert_allclose(left, r[:, :, 2 * n], atol=1e-12)
