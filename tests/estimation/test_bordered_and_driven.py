"""Chains with constants, chains driven by few noises, evidence and fixed lag: against dense least squares and Kalman filters."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from railnav.errors import EstimationError
from railnav.estimation import (
    Chain,
    ChainFilter,
    fixed_lag,
    inverse_root,
    solve_bordered_chain,
    solve_chain,
    solve_driven_chain,
)
from railnav.estimation.oracle import dense_system, kalman_rts


def random_chain(seed: int, n: int, *, epochs: int = 30, m: int = 3, q: int | None = None, prior: bool = True) -> Chain:
    rng = np.random.default_rng(seed)
    q = n if q is None else q
    F = 0.9 * np.linalg.qr(rng.standard_normal((epochs - 1, n, n)))[0]
    W = np.triu(rng.standard_normal((epochs - 1, n, n))) + 3 * np.eye(n)
    M, L = -W @ F, W
    if q > n:
        M = np.concatenate([M, rng.standard_normal((epochs - 1, q - n, n))], axis=1)
        L = np.concatenate([L, rng.standard_normal((epochs - 1, q - n, n))], axis=1)
    return Chain(
        rng.standard_normal((epochs, m, n)),
        rng.standard_normal((epochs, m)),
        M,
        L,
        rng.standard_normal((epochs - 1, q)),
        counts=rng.integers(0, m + 1, epochs),
        prior=(rng.standard_normal((n, n)), rng.standard_normal(n)) if prior else None,
    )


# ---------------------------------------------------------------- constants


@pytest.mark.parametrize(("n", "p", "extra"), [(1, 1, 0), (3, 1, 0), (3, 4, 0), (4, 2, 2), (6, 3, 0), (9, 5, 1)])
@pytest.mark.parametrize("prior", [False, True])
def test_border_is_dense_least_squares(n: int, p: int, extra: int, prior: bool) -> None:
    chain = random_chain(n + p, n, q=n + extra)
    rng = np.random.default_rng(p)
    N, m, q = len(chain), chain.z.shape[1], n + extra
    Hb, Mb = rng.standard_normal((N, m, p)), rng.standard_normal((N - 1, q, p))
    border_prior = (0.3 * np.eye(p), rng.standard_normal(p)) if prior else None
    solution = solve_bordered_chain(chain, Hb, Mb, border_prior=border_prior)

    system = dense_system(chain)
    columns = [np.zeros((n, p))]
    for k in range(N):
        columns.append(Hb[k, : chain.counts[k]])
        if k < N - 1:
            columns.append(Mb[k])
    A, b = np.hstack([system.A, np.vstack(columns)]), system.b
    if border_prior is not None:
        A = np.vstack([A, np.hstack([np.zeros((p, N * n)), border_prior[0]])])
        b = np.r_[b, border_prior[1]]
    x = np.linalg.lstsq(A, b, rcond=None)[0]
    P = np.linalg.inv(A.T @ A)
    blocks = P[: N * n, : N * n].reshape(N, n, N, n)
    k = np.arange(N)
    close = {"rtol": 1e-9, "atol": 1e-10}
    np.testing.assert_allclose(solution.state.ravel(), x[: N * n], **close)
    np.testing.assert_allclose(solution.border, x[N * n :], **close)
    np.testing.assert_allclose(solution.border_covariance, P[N * n :, N * n :], **close)
    np.testing.assert_allclose(solution.border_sigma**2, np.diagonal(P)[N * n :], **close)
    np.testing.assert_allclose(solution.covariance, blocks[k, :, k, :], **close)
    np.testing.assert_allclose(solution.lag_one, blocks[k[:-1], :, k[1:], :], **close)
    np.testing.assert_allclose(solution.cross.reshape(N * n, p), P[: N * n, N * n :], **close)
    assert solution.sum_of_squares == pytest.approx(np.sum((A @ x - b) ** 2), rel=1e-10)
    assert solution.redundancy == len(b) - len(x)


def test_border_of_zeros_is_the_plain_chain() -> None:
    chain = random_chain(1, 3)
    plain = solve_chain(chain, evidence=True)
    solution = solve_bordered_chain(chain, np.zeros((3, 1)), np.zeros((3, 1)), border_prior=([[1.0]], [0.5]))
    np.testing.assert_allclose(solution.state, plain.state, rtol=0, atol=1e-12)
    np.testing.assert_allclose(solution.covariance, plain.covariance, rtol=0, atol=1e-12)
    np.testing.assert_allclose(solution.log_evidence, plain.log_evidence, rtol=0, atol=1e-11)
    assert solution.border == pytest.approx([0.5])


def test_constant_that_nothing_shows_is_named() -> None:
    chain = random_chain(2, 3)
    with pytest.raises(EstimationError, match="constant 1 is not determined"):
        solve_bordered_chain(chain, np.ones((3, 1)) * [[1.0, 0.0]], np.zeros((3, 2)))


def test_odometer_scale_and_run_bias_of_two_runs_are_found() -> None:
    """Two receivers over the same nodes, the second displaced; increments 0.3 per mille long."""
    rng = np.random.default_rng(5)
    N = 400
    truth = np.arange(N) * 1.0
    H, Hb = np.full((N, 2, 1), 1 / 0.02), np.zeros((N, 2, 2))
    Hb[:, 1, 1] = 1 / 0.02
    z = (truth[:, None] + rng.normal(0, 0.02, (N, 2)) + [0.0, 0.15]) / 0.02
    W = 1 / 1e-3
    u = W * (1.0003 + rng.normal(0, 1e-3, (N - 1, 1)))
    Mb = np.array([[W, 0.0]])
    solution = solve_bordered_chain(Chain(H, z, [[-W]], [[W]], u), Hb, Mb)
    assert abs(solution.border[0] - 3e-4) < 3 * solution.border_sigma[0] < 2e-4
    assert abs(solution.border[1] - 0.15) < 3 * solution.border_sigma[1] < 0.01
    # the state is known no better than the first receiver alone and the increments allow
    assert solution.covariance[0, 0, 0] > solve_chain(Chain(H, z, [[-W]], [[W]], u)).covariance[0, 0, 0]


def test_border_refuses_by_meaning() -> None:
    chain = random_chain(3, 2, epochs=4)
    with pytest.raises(EstimationError, match=r"M_border has shape \(3, 1\); \(3, 2, 2\)"):
        solve_bordered_chain(chain, np.ones((3, 2)), np.ones((3, 1)))
    bad = np.ones((3, 2, 1))
    bad[1] = np.nan
    with pytest.raises(EstimationError, match="M_border is not finite at coupling 1"):
        solve_bordered_chain(chain, np.ones((3, 1)), bad)
    cut = Chain([[1.0]], np.zeros((3, 1)), [[1.0]], [[1.0]], [[0.0], [0.0]], coupling_counts=[1, 0])
    with pytest.raises(EstimationError, match="between epochs 1 and 2 couples no states"):
        solve_bordered_chain(cut, [[0.1]], [[0.2]])


def test_border_leaves_inputs_alone_and_takes_read_only_ones() -> None:
    chain = random_chain(4, 2, epochs=5)
    Hb, Mb = np.ones((5, 3, 1)), np.ones((4, 2, 1))
    for array in (chain.H, chain.z, chain.M, chain.L, chain.u, Hb, Mb):
        array.flags.writeable = False
    solve_bordered_chain(chain, Hb, Mb)


# ---------------------------------------------------------------- singular process noise


def velocity_model(h: float, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Constant velocity in space, noise of rank 3 in 6."""
    one, none = np.eye(3), np.zeros((3, 3))
    return np.block([[one, h * one], [none, one]]), sigma * np.vstack([0.5 * h * h * one, h * one])


def test_singular_noise_is_kalman_and_rts() -> None:
    rng = np.random.default_rng(11)
    N, n, m = 50, 6, 3
    F, G = velocity_model(1.0, 0.05)
    g = 0.1 * rng.standard_normal((N - 1, n))
    H = np.hstack([np.eye(3), np.zeros((3, 3))])
    z = rng.standard_normal((N, m))
    z[20:25] = np.nan
    P0 = np.diag([100.0] * 3 + [400.0] * 3)
    expected = kalman_rts(
        np.zeros(n),
        P0,
        np.repeat(F[None], N - 1, 0),
        g,
        np.repeat((G @ G.T)[None], N - 1, 0),
        np.repeat(H[None], N, 0),
        np.repeat(0.09 * np.eye(3)[None], N, 0),
        z,
    )
    counts = np.where(np.isnan(z).any(axis=1), 0, 3)
    prior = (np.diag(1 / np.sqrt(np.diag(P0))), np.zeros(n))
    solution = solve_driven_chain(H / 0.3, z / 0.3, F, G, g=g, counts=counts, prior=prior)
    np.testing.assert_allclose(solution.filtered, expected.filtered, rtol=0, atol=1e-10)
    np.testing.assert_allclose(solution.state, expected.state, rtol=0, atol=1e-9)
    np.testing.assert_allclose(solution.covariance, expected.covariance, rtol=0, atol=1e-8)
    np.testing.assert_allclose(solution.nis, expected.nis, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(solution.dof, counts)


@pytest.mark.parametrize(("n", "r"), [(2, 1), (4, 1), (4, 3), (3, 3), (2, 4)])
@pytest.mark.parametrize("prior", [False, True])
def test_driven_chain_is_dense_least_squares_in_start_and_noises(n: int, r: int, prior: bool) -> None:
    """Dense: unknowns x_0 and all w, observations rewritten in them."""
    rng = np.random.default_rng(10 * n + r)
    N, m = 15, 2
    F = np.linalg.qr(rng.standard_normal((N - 1, n, n)))[0] * rng.uniform(0.8, 1.2, (N - 1, 1, 1))
    G, g = rng.standard_normal((N - 1, n, r)), rng.standard_normal((N - 1, n))
    H, z = rng.standard_normal((N, m, n)), rng.standard_normal((N, m))
    rows = (rng.standard_normal((n, n)), rng.standard_normal(n)) if prior else None
    solution = solve_driven_chain(H, z, F, G, g=g, prior=rows)

    unknowns = n + (N - 1) * r
    to_state, constant = [np.eye(n, unknowns)], [np.zeros(n)]
    for k in range(N - 1):
        T = F[k] @ to_state[-1]
        T[:, n + k * r : n + (k + 1) * r] += G[k]
        to_state.append(T)
        constant.append(F[k] @ constant[-1] + g[k])
    A = [np.eye(unknowns)[n:], *(H[k] @ to_state[k] for k in range(N))]
    b = [np.zeros((N - 1) * r), *(z[k] - H[k] @ constant[k] for k in range(N))]
    if rows is not None:
        A.append(rows[0] @ np.eye(n, unknowns))
        b.append(rows[1])
    A, b = np.vstack(A), np.concatenate(b)
    y = np.linalg.lstsq(A, b, rcond=None)[0]
    P = np.linalg.inv(A.T @ A)
    close = {"rtol": 1e-8, "atol": 1e-9}
    for k in range(N):
        np.testing.assert_allclose(solution.state[k], to_state[k] @ y + constant[k], **close)
        np.testing.assert_allclose(solution.covariance[k], to_state[k] @ P @ to_state[k].T, **close)
    for k in range(N - 1):
        np.testing.assert_allclose(solution.lag_one[k], to_state[k] @ P @ to_state[k + 1].T, **close)
    np.testing.assert_allclose(solution.noise.ravel(), y[n:], **close)
    assert solution.sum_of_squares == pytest.approx(np.sum((A @ y - b) ** 2), rel=1e-8)
    assert solution.redundancy == len(b) - unknowns


def test_driven_chain_of_full_noise_is_the_plain_chain() -> None:
    rng = np.random.default_rng(3)
    N, n = 25, 3
    F = np.eye(n) + 0.2 * rng.standard_normal((N - 1, n, n))
    G = np.tril(rng.standard_normal((N - 1, n, n))) + 2 * np.eye(n)
    H, z = rng.standard_normal((N, 3, n)), rng.standard_normal((N, 3))
    W = inverse_root(G @ np.swapaxes(G, 1, 2))
    plain = solve_chain(Chain(H, z, -W @ F, W, np.zeros((N - 1, n))), filtered=True, evidence=True)
    driven = solve_driven_chain(H, z, F, G)
    np.testing.assert_allclose(driven.state, plain.state, rtol=0, atol=1e-10)
    np.testing.assert_allclose(driven.covariance, plain.covariance, rtol=0, atol=1e-10)
    np.testing.assert_allclose(driven.filtered, plain.filtered, rtol=0, atol=1e-9, equal_nan=True)
    np.testing.assert_allclose(driven.log_evidence, plain.log_evidence, rtol=0, atol=1e-9, equal_nan=True)


def test_driven_chain_refuses_by_meaning() -> None:
    z = np.zeros((4, 1))
    with pytest.raises(EstimationError, match="step 0 has no inverse"):
        solve_driven_chain([[1.0, 0.0]], z, [[1.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    with pytest.raises(EstimationError, match="component 1 of the last state is not determined"):
        solve_driven_chain([[1.0, 0.0]], z, np.eye(2), [[1.0], [0.0]])
    with pytest.raises(EstimationError, match=r"\(n, r\) with r >= 1"):
        solve_driven_chain([[1.0, 0.0]], z, np.eye(2), np.zeros((2, 0)))
    with pytest.raises(EstimationError, match=r"H has shape \(1, 1\)"):
        solve_driven_chain([[1.0]], z, np.eye(2), [[1.0], [0.0]])
    with pytest.raises(EstimationError, match="z is not finite at epoch 2"):
        solve_driven_chain([[1.0]], [[0.0], [0.0], [np.nan], [0.0]], [[1.0]], [[1.0]])


def test_driven_chain_of_one_epoch() -> None:
    solution = solve_driven_chain([[2.0]], [[4.0]], [[1.0]], [[1.0]])
    assert solution.state.ravel() == pytest.approx([2.0])
    assert solution.covariance.ravel() == pytest.approx([0.25])


# ---------------------------------------------------------------- evidence, fixed lag


@pytest.mark.parametrize("n", [3, 4])
def test_evidence_of_every_block_is_scipys(n: int) -> None:
    chain = random_chain(8, n, epochs=12)
    solution = solve_chain(chain, evidence=True)
    R, b = chain.prior
    x, P = np.linalg.solve(R, b), np.linalg.inv(R.T @ R)
    total = 0.0
    for k in range(len(chain)):
        H, z = chain.H[k, : chain.counts[k]], chain.z[k, : chain.counts[k]]
        if len(z):
            S = H @ P @ H.T + np.eye(len(z))
            expected = multivariate_normal(H @ x, S).logpdf(z)
            K = P @ H.T @ np.linalg.inv(S)
            x, P = x + K @ (z - H @ x), P - K @ S @ K.T
        else:
            expected = 0.0
        assert solution.log_evidence[k] == pytest.approx(expected, abs=1e-10)
        total += expected
        if k < len(chain) - 1:
            M, L, u = chain.M[k], chain.L[k], chain.u[k]
            x = np.linalg.solve(L, u - M @ x)
            P = np.linalg.inv(L) @ (np.eye(n) + M @ P @ M.T) @ np.linalg.inv(L).T
    assert solution.log_evidence.sum() == pytest.approx(total, abs=1e-9)


def test_evidence_of_sweep_is_that_of_single_blocks_and_nan_before_the_state_exists() -> None:
    chain = random_chain(9, 3, epochs=12, prior=False)
    solution = solve_chain(chain, evidence=True)
    live = ChainFilter(3)
    swept = live.sweep(chain.H, chain.z, chain.M, chain.L, chain.u, counts=chain.counts, evidence=True)
    np.testing.assert_array_equal(swept.log_evidence, solution.log_evidence)
    live = ChainFilter(3)
    for k in range(12):
        if k:
            live.couple(chain.M[k - 1], chain.L[k - 1], chain.u[k - 1])
        block = live.observe(chain.H[k, : chain.counts[k]], chain.z[k, : chain.counts[k]])
        if block.log_evidence is None:
            assert np.isnan(solution.log_evidence[k])
        else:
            assert solution.log_evidence[k] == pytest.approx(block.log_evidence, abs=1e-10)
    assert np.isnan(solution.log_evidence[0])


@pytest.mark.parametrize("n", [2, 3])
def test_fixed_lag_is_the_smoother_of_the_chain_cut_there(n: int) -> None:
    chain = random_chain(6, n, epochs=20)
    solution = solve_chain(chain, filtered=True)
    np.testing.assert_array_equal(fixed_lag(solution, 0), solution.filtered)
    np.testing.assert_allclose(fixed_lag(solution, 19)[0], solution.state[0], rtol=0, atol=1e-12)
    lagged = fixed_lag(solution, 7)
    assert lagged.shape == (13, n)
    for i in (0, 5, 12):
        k = i + 7
        cut = Chain(
            chain.H[: k + 1],
            chain.z[: k + 1],
            chain.M[:k],
            chain.L[:k],
            chain.u[:k],
            counts=chain.counts[: k + 1],
            prior=chain.prior,
        )
        np.testing.assert_allclose(lagged[i], solve_chain(cut).state[i], rtol=0, atol=1e-12)
    with pytest.raises(EstimationError, match="not within 0 to 19"):
        fixed_lag(solution, 20)
    with pytest.raises(EstimationError, match="without filtered"):
        fixed_lag(solve_chain(chain), 1)


def test_fixed_lag_does_not_exist_before_the_state_does() -> None:
    chain = Chain([[1.0]], np.arange(6.0)[:, None], [[-1.0]], [[1.0]], np.ones((5, 1)), counts=[0, 0, 0, 1, 1, 1])
    lagged = fixed_lag(solve_chain(chain, filtered=True), 2)
    np.testing.assert_allclose(lagged.ravel(), [np.nan, 1.0, 2.0, 3.0], rtol=0, atol=1e-14)
