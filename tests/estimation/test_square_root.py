"""Roots of covariances: against covariances written out, on degenerate input, and by their laws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from railnav.errors import EstimationError
from railnav.estimation import _kernels as kernels
from railnav.estimation import (
    consistency,
    inverse_root,
    lower_root,
    nees,
    predict,
    repair_covariance,
    smooth,
    update,
)
from railnav.estimation.oracle import insert_row, kalman_rts


def covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.standard_normal((n, 2 * n))
    return A @ A.T / (2 * n)


def is_root(L: np.ndarray, P: np.ndarray, atol: float = 1e-12) -> None:
    assert not np.triu(L, 1).any()
    assert (np.diagonal(L) >= 0).all()
    np.testing.assert_allclose(L @ L.T, P, rtol=0, atol=atol)


# ---------------------------------------------------------------- whitening


def test_tv4_symmetric_inverse_root() -> None:
    K = 1e-4 * np.array([[4, 1, 0], [1, 3, 1], [0, 1, 2]])
    expected = [
        [51.8047684799, -9.1481607554, 3.2179023163],
        [-9.1481607554, 64.1708315516, -15.5839653880],
        [3.2179023163, -15.5839653880, 76.5368946233],
    ]
    np.testing.assert_allclose(inverse_root(K, method="symmetric"), expected, rtol=0, atol=5e-10)


@pytest.mark.parametrize("method", ["cholesky", "symmetric"])
@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_inverse_root_whitens(method: str, n: int) -> None:
    rng = np.random.default_rng(n)
    K = np.array([covariance(rng, n) for _ in range(20)])
    W = inverse_root(K, method=method)
    np.testing.assert_allclose(W @ K @ np.swapaxes(W, 1, 2), np.broadcast_to(np.eye(n), K.shape), rtol=0, atol=1e-10)
    if method == "cholesky":
        assert not np.tril(W, -1).any()


def test_repeated_eigenvalues_and_mixed_units_are_no_trouble() -> None:
    np.testing.assert_allclose(inverse_root(np.diag([1e-4, 1e-4, 4e-4]), method="symmetric"), np.diag([100, 100, 50]))
    mixed = np.diag([1e8, 1e-18])  # m^2 and rad^2
    np.testing.assert_allclose(np.diagonal(inverse_root(mixed)), [1e-4, 1e9])
    assert not repair_covariance(mixed).repaired


def test_covariances_that_are_none_are_refused_with_a_remedy() -> None:
    good = np.eye(2)
    for bad, message in (
        ([[1.0, 0.0], [0.0, 0.0]], "covariance 1 claims a perfect measurement .*use a sigma of 1e-6"),
        ([[1.0, 2.0], [2.0, 1.0]], "covariance 1 is not positive definite; repair_covariance"),
        ([[np.nan, 0.0], [0.0, 1.0]], "covariance 1 is not finite"),
        ([[-1.0, 0.0], [0.0, 1.0]], "variance 0 is -1"),
    ):
        with pytest.raises(EstimationError, match=message):
            inverse_root(np.array([good, bad]))
    with pytest.raises(EstimationError, match="shape"):
        inverse_root(np.ones(3))


def test_repair_lifts_what_rounding_lowered_and_refuses_the_rest() -> None:
    thin = np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]])  # a correlation a hair above one
    with pytest.raises(EstimationError, match="not positive definite"):
        inverse_root(thin)
    repaired = repair_covariance(np.array([np.eye(2), thin]))
    assert repaired.repaired.tolist() == [False, True]
    np.testing.assert_allclose(repaired.covariance, [np.eye(2), thin], rtol=0, atol=3e-9)
    assert np.isfinite(inverse_root(repaired.covariance)).all()
    again = repair_covariance(np.array([[1.0, 0.5 + 1e-9], [0.5, 1.0]]))
    assert again.repaired
    assert (again.covariance == again.covariance.T).all()
    for bad, message in (
        ([[1.0, 1.1], [1.1, 1.0]], "eigenvalue of its correlations is -0.1"),
        ([[1.0, 0.5], [0.4, 1.0]], "not symmetric"),
        ([[0.0, 0.0], [0.0, 1.0]], "perfect measurement"),
        ([[np.inf, 0.0], [0.0, 1.0]], "not finite"),
    ):
        with pytest.raises(EstimationError, match=message):
            repair_covariance(bad)


def test_lower_root_takes_singular_covariances() -> None:
    rng = np.random.default_rng(1)
    A = rng.standard_normal((5, 2))
    is_root(lower_root(A @ A.T), A @ A.T, 1e-6)
    np.testing.assert_array_equal(lower_root(np.zeros((3, 3))), np.zeros((3, 3)))
    P = covariance(rng, 4)
    P[2] = P[:, 2] = 0.0
    root = lower_root(P)
    is_root(root, P, 1e-7)
    assert not root[2].any()
    assert not root[:, 2].any()
    for bad, message in (
        ([[1.0, 2.0], [2.0, 1.0]], "negative eigenvalue"),
        ([[1.0, 0.2], [0.0, 1.0]], "not symmetric"),
        ([[-1.0]], "variance 0 is negative"),
        ([[np.nan]], "finite"),
    ):
        with pytest.raises(EstimationError, match=message):
            lower_root(bad)


# ---------------------------------------------------------------- steps


@pytest.mark.parametrize("n", [1, 2, 6, 9])
@pytest.mark.parametrize("q", [0, 1, 3, 9])
def test_predict_is_the_covariance_step(n: int, q: int) -> None:
    rng = np.random.default_rng(10 * n + q)
    P, F, Q_sqrt = covariance(rng, n), rng.standard_normal((n, n)), rng.standard_normal((n, q))
    is_root(predict(lower_root(P), F, Q_sqrt), F @ P @ F.T + Q_sqrt @ Q_sqrt.T, 1e-11)


def test_predict_through_a_singular_step() -> None:
    F = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 0.0], [2.0, 2.0, 0.0]])
    root = predict(np.eye(3), F, np.zeros((3, 1)))
    is_root(root, F @ F.T)
    assert np.count_nonzero(np.diagonal(root)) == 1  # one direction is left; the other columns are zero
    assert not root[:, 1:].any()


@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 1), (3, 5), (6, 3), (9, 2)])
def test_update_is_the_kalman_update(n: int, m: int) -> None:
    from scipy.stats import multivariate_normal

    rng = np.random.default_rng(n + 10 * m)
    x, P, R = rng.standard_normal(n), covariance(rng, n), covariance(rng, m)
    H, z = rng.standard_normal((m, n)), rng.standard_normal(m)
    nu, S = z - H @ x, H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    after = update(x, lower_root(P), nu, H, lower_root(R))
    np.testing.assert_allclose(after.state, x + K @ nu, rtol=0, atol=1e-10)
    is_root(after.P_sqrt, P - K @ S @ K.T, 1e-10)
    is_root(after.S_sqrt, S)
    assert after.nis == pytest.approx(nu @ np.linalg.solve(S, nu), rel=1e-9)
    assert after.log_evidence == pytest.approx(multivariate_normal(np.zeros(m), S).logpdf(nu), rel=1e-9)


def test_scalar_rows_one_by_one_are_the_block() -> None:
    rng = np.random.default_rng(3)
    n, m = 6, 4
    x, root = rng.standard_normal(n), lower_root(covariance(rng, n))
    H, z, sigma = rng.standard_normal((m, n)), rng.standard_normal(m), rng.uniform(0.1, 2.0, m)
    block = update(x, root, z - H @ x, H, np.diag(sigma))
    state, P_sqrt = x.copy(), root.copy()
    nis = logdet = 0.0
    for h, measured, s in zip(H, z, sigma, strict=True):
        innovation = measured - h @ state
        variance = kernels.innovation_variance_kernel(P_sqrt, h, s * s)
        part, log_variance = kernels.update_scalar_kernel(state, P_sqrt, h, innovation, s * s)
        assert part == pytest.approx(innovation**2 / variance)
        assert log_variance == pytest.approx(np.log(variance))
        nis, logdet = nis + part, logdet + log_variance
    np.testing.assert_allclose(state, block.state, rtol=0, atol=1e-12)
    np.testing.assert_allclose(P_sqrt, block.P_sqrt, rtol=0, atol=1e-12)  # the root is unique
    assert nis == pytest.approx(block.nis)
    assert -0.5 * (nis + logdet + m * np.log(2 * np.pi)) == pytest.approx(block.log_evidence)


@pytest.mark.parametrize("q", [1, 3, 6])
def test_filter_and_smoother_are_kalman_and_rts(q: int) -> None:
    """Also with singular process noise, where an information filter would need special care."""
    rng = np.random.default_rng(q)
    N, n, m = 40, 6, 3
    F = np.eye(n) + 0.1 * rng.standard_normal((N - 1, n, n))
    G = 0.3 * rng.standard_normal((N - 1, n, q))
    H, z = rng.standard_normal((N, m, n)), rng.standard_normal((N, m))
    R = np.array([covariance(rng, m) for _ in range(N)])
    P0, x0 = covariance(rng, n), rng.standard_normal(n)
    expected = kalman_rts(x0, P0, F, np.zeros((N - 1, n)), G @ np.swapaxes(G, 1, 2), H, R, z)
    x, root = x0, lower_root(P0)
    filtered, predicted = [], [x0]
    for k in range(N):
        if k:
            x, root = F[k - 1] @ x, predict(root, F[k - 1], G[k - 1])
            predicted.append(x)
        after = update(x, root, z[k] - H[k] @ x, H[k], lower_root(R[k]))
        assert after.nis == pytest.approx(expected.nis[k], rel=1e-9)
        x, root = after.state, after.P_sqrt
        filtered.append((x, root))
        np.testing.assert_allclose(x, expected.filtered[k], rtol=0, atol=1e-10)
        is_root(root, expected.filtered_covariance[k], 1e-10)
    for k in range(N - 2, -1, -1):
        back = smooth(*filtered[k], F[k], G[k], predicted=predicted[k + 1], smoothed=x, P_sqrt_smoothed=root)
        x, root = back.state, back.P_sqrt
        np.testing.assert_allclose(x, expected.state[k], rtol=0, atol=1e-9)
        is_root(root, expected.covariance[k], 1e-9)


def test_smoother_passes_a_state_known_exactly() -> None:
    """A constant of zero variance has no pivot in the prediction; nothing is learnt of it and nothing breaks."""
    root = np.diag([1.0, 0.0, 2.0])
    F = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    Q_sqrt = np.array([[0.1], [0.0], [0.3]])
    forward = predict(root, F, Q_sqrt)
    assert not forward[1].any()
    x_next = np.array([1.0, 0.0, -1.0])
    back = smooth(np.zeros(3), root, F, Q_sqrt, predicted=np.zeros(3), smoothed=x_next, P_sqrt_smoothed=0.5 * forward)
    keep = [0, 2]
    P, Fk = root[np.ix_(keep, keep)] ** 2, F[np.ix_(keep, keep)]
    prediction = Fk @ P @ Fk.T + Q_sqrt[keep] @ Q_sqrt[keep].T
    G = P @ Fk.T @ np.linalg.inv(prediction)
    np.testing.assert_allclose(back.state[keep], G @ x_next[keep], rtol=0, atol=1e-12)
    is_root(back.P_sqrt[np.ix_(keep, keep)], P - 0.75 * G @ prediction @ G.T)
    assert back.state[1] == 0.0
    assert not back.P_sqrt[1].any()


def test_roots_keep_what_covariances_lose() -> None:
    """A precise row on a wide prior, again and again: the covariance form ends with nonsense, the root does not."""
    P = 1e12 * np.eye(2)
    root = lower_root(P)
    x = np.zeros(2)
    for k in range(50):
        h = np.array([1.0, 1e-3 * (k % 5)])
        K = P @ h / (h @ P @ h + 1e-6)
        P = P - np.outer(K, h @ P)
        kernels.update_scalar_kernel(x, root, h, 0.0, 1e-6)
    rows = np.array([[1.0, 1e-3 * (k % 5)] for k in range(50)])
    exact = np.linalg.inv(1e-12 * np.eye(2) + rows.T @ rows / 1e-6)
    assert np.abs(P / exact - 1).max() > 0.1
    np.testing.assert_allclose(root @ root.T, exact, rtol=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: predict(np.eye(2), np.eye(3), np.zeros((2, 1))), "F has shape"),
        (lambda: predict([[1.0, 1.0], [0.0, 1.0]], np.eye(2), np.zeros((2, 1))), "not lower triangular"),
        (lambda: predict(-np.eye(2), np.eye(2), np.zeros((2, 1))), "positive diagonal"),
        (lambda: predict(np.eye(2), np.full((2, 2), np.nan), np.zeros((2, 1))), "F is not finite"),
        (lambda: predict(np.ones((2, 3)), np.eye(2), np.zeros((2, 1))), "P_sqrt has shape"),
        (lambda: update([0.0], [[1.0]], [1.0], [[1.0]], [[0.0]]), "claimed to be perfect .*1e-6 instead of 0"),
        (lambda: update([0.0, 1.0], [[1.0]], [1.0], [[1.0]], [[1.0]]), "state has shape"),
        (lambda: update([0.0], [[1.0]], [np.inf], [[1.0]], [[1.0]]), "innovation is not finite"),
        (lambda: update([0.0], [[np.nan]], [0.0], [[1.0]], [[1.0]]), "P_sqrt is not finite"),
    ],
)
def test_what_does_not_fit_is_refused(call: object, message: str) -> None:
    with pytest.raises(EstimationError, match=message):
        call()


def test_arguments_are_left_alone_and_may_be_read_only() -> None:
    x, root, F = np.zeros(2), np.eye(2), np.array([[1.0, 1.0], [0.0, 1.0]])
    for a in (x, root, F):
        a.flags.writeable = False
    predict(root, F, root)
    update(x, root, x, F, root)
    smooth(x, root, F, root, predicted=x, smoothed=x, P_sqrt_smoothed=root)
    assert (root == np.eye(2)).all()


# ---------------------------------------------------------------- laws


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), rows=st.integers(1, 6), extra=st.integers(0, 6), rank=st.integers(0, 6))
def test_law_triangularisation_keeps_the_product_at_any_rank(seed: int, rows: int, extra: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    rank = min(rank, rows)
    # whole numbers: a rank that is exact, pivots that vanish in odd places
    A = (rng.integers(-2, 3, (rows, rank)) @ rng.integers(-2, 3, (rank, rows + extra))).astype(float)
    B = A.copy()
    found = kernels.triangularize_rows(B, rows)
    assert found == np.linalg.matrix_rank(A)
    assert not B[:, rows:].any()
    is_root(B[:, :rows], A @ A.T, 1e-11)
    for j in range(rows):
        assert B[j, j] > 0 or not B[:, j].any()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 6), m=st.integers(1, 4))
def test_law_a_measurement_never_adds_uncertainty(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    P = covariance(rng, n)
    after = update(np.zeros(n), lower_root(P), np.zeros(m), rng.standard_normal((m, n)), lower_root(covariance(rng, m)))
    assert np.linalg.eigvalsh(P - after.P_sqrt @ after.P_sqrt.T).min() > -1e-10


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), data=st.data())
def test_law_the_order_of_scalar_rows_is_immaterial(seed: int, data: st.DataObject) -> None:
    rng = np.random.default_rng(seed)
    H, z = rng.standard_normal((4, 3)), rng.standard_normal(4)
    start = lower_root(covariance(rng, 3))
    answers = []
    for order in (range(4), data.draw(st.permutations(range(4)))):
        x, root, nis = np.zeros(3), start.copy(), 0.0
        for i in order:
            nis += kernels.update_scalar_kernel(x, root, H[i], z[i] - H[i] @ x, 0.25)[0]
        answers.append(np.concatenate([x, root.ravel(), [nis]]))
    np.testing.assert_allclose(*answers, rtol=0, atol=1e-9)


def test_nees_of_a_simulated_filter_lies_inside_its_bounds() -> None:
    rng = np.random.default_rng(12)
    F, G, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]]), np.array([[1.0, 0.0]])
    scores, nis = [], []
    for _ in range(150):
        root = np.diag([3.0, 1.0])
        truth = root @ rng.standard_normal(2)
        x = np.zeros(2)
        for _ in range(20):
            truth = F @ truth + 0.1 * G[:, 0] * rng.standard_normal()
            x, root = F @ x, predict(root, F, 0.1 * G)
            after = update(x, root, H @ (truth - x) + 0.5 * rng.standard_normal(1), H, [[0.5]])
            x, root = after.state, after.P_sqrt
            nis.append(after.nis)
        scores.append(nees([x - truth], root @ root.T)[0])
    assert consistency(scores, 2).consistent
    assert consistency(nis, 1).consistent


# ---------------------------------------------------------------- half the digits


def test_float32_square_root_keeps_what_a_float32_covariance_loses() -> None:
    """Rail 15.8: sigma of 1 km before, 1 cm rows after. The covariance filter ends at a variance of 0, the root at the true one."""
    one = np.float32
    rows = [np.array([1.0, 1e-3 * (k % 5)]) for k in range(200)]
    exact = np.linalg.inv(np.eye(2) * 1e-6 + sum(np.outer(h, h) / 1e-4 for h in rows))
    P, W = one(1e6) * np.eye(2, dtype=one), np.zeros((2, 3), one)
    W[0, 0] = W[1, 1] = 1e-3
    for h64 in rows:
        h = h64.astype(one)
        gain = (P @ h) / (h @ P @ h + one(1e-4))
        P = P - np.outer(gain, h @ P)
        insert_row(W, np.append(h / one(1e-2), one(0.0)).astype(one))
    assert W.dtype == P.dtype == np.float32
    R = W[:, :2].astype(float)
    root = np.linalg.inv(R.T @ R)
    np.testing.assert_allclose(root[0, 0], exact[0, 0], rtol=1e-5)
    np.testing.assert_allclose(root[1, 1], exact[1, 1], rtol=1e-5)
    assert abs(P[0, 0] - exact[0, 0]) > 0.5 * exact[0, 0]
    assert abs(P[1, 1] - exact[1, 1]) > 0.5 * exact[1, 1]
