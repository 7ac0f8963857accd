"""The same answers by other means: witnesses for tests and benchmarks, plain rather than fast.

Dense least squares, banded normal equations by scipy, the rotations of the chain row by row in numpy, and the textbook Kalman
filter with the Rauch-Tung-Striebel smoother in covariances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.estimation.chain import Chain

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class DenseSystem:
    """All rows of a chain as one matrix.

    Attributes
    ----------
    A : (rows, N n) array
        Coefficients; rows of zeros are left out.
    b : (rows,) array
        Right-hand sides.
    prior_rows : int
        How many of the first rows are the prior's.
    """

    A: FloatArray
    b: FloatArray
    prior_rows: int


@dataclass(frozen=True, slots=True, eq=False)
class RowReduction:
    """A chain reduced row by row in plain numpy.

    Attributes
    ----------
    records : (N - 1, n, 2n + 1) array
        As in `ChainSolution`.
    triangle : (n, n + 1) array
        As in `ChainSolution`.
    residuals : list of (epoch, f)
        Residual of each redundant row of the observations, in order of entry.
    state : (N, n) array
        Back-substituted states.
    """

    records: FloatArray
    triangle: FloatArray
    residuals: list[tuple[int, float]]
    state: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RtsSolution:
    """Kalman filter and Rauch-Tung-Striebel smoother in covariances.

    Attributes
    ----------
    filtered, filtered_covariance : (N, n), (N, n, n) array
        Estimates from the data up to each epoch.
    state, covariance : (N, n), (N, n, n) array
        Estimates from all data.
    nis : (N,) array
        nu^T S^-1 nu.
    """

    filtered: FloatArray
    filtered_covariance: FloatArray
    state: FloatArray
    covariance: FloatArray
    nis: FloatArray


def dense_system(chain: Chain) -> DenseSystem:
    """Write all rows of a chain into one matrix.

    Parameters
    ----------
    chain : Chain
        Whitened rows.

    Returns
    -------
    DenseSystem
        A x = b, unit weights.

    Examples
    --------
    >>> chain = Chain([[1.0]], [[0.0], [1.1]], [[-1.0]], [[1.0]], [[1.0]])
    >>> dense_system(chain).A
    array([[ 1.,  0.],
           [-1.,  1.],
           [ 0.,  1.]])
    """
    N, n = len(chain), chain.n
    m, q = chain.z.shape[1], chain.u.shape[1]
    H = np.broadcast_to(chain.H, (N, m, n))
    M, L = (np.broadcast_to(a, (N - 1, q, n)) for a in (chain.M, chain.L))
    u = np.broadcast_to(chain.u, (N - 1, q))
    rows: list[FloatArray] = []
    right: list[float] = []

    def add(first: int, coefficients: FloatArray, value: float) -> None:
        if np.any(coefficients != 0.0):
            row = np.zeros(N * n)
            row[first * n : first * n + len(coefficients)] = coefficients
            rows.append(row)
            right.append(value)

    if chain.prior is not None:
        for coefficients, value in zip(*chain.prior, strict=True):
            add(0, coefficients, value)
    prior_rows = len(rows)
    for k in range(N):
        for i in range(chain.counts[k]):
            add(k, H[k, i], chain.z[k, i])
        if k < N - 1:
            for i in range(chain.coupling_counts[k]):
                add(k, np.concatenate([M[k, i], L[k, i]]), u[k, i])
    return DenseSystem(np.array(rows).reshape(-1, N * n), np.array(right), prior_rows)


def banded_solution(chain: Chain) -> FloatArray:
    """Solve a chain by banded normal equations, scipy.linalg.solveh_banded, building the band included.

    Squares the condition number: for well-conditioned chains only.

    Parameters
    ----------
    chain : Chain
        Whitened rows.

    Returns
    -------
    (N, n) array
        States.

    Examples
    --------
    >>> chain = Chain([[1.0]], [[0.0], [1.1], [1.9]], [[-1.0]], [[1.0]], [[1.0], [1.0]])
    >>> banded_solution(chain).ravel()
    array([0.0125, 1.025 , 1.9625])
    """
    from scipy.linalg import solveh_banded

    N, n = len(chain), chain.n
    H, z, M, L, u = chain.H, chain.z, chain.M, chain.L, chain.u
    if not (chain.counts == z.shape[1]).all():
        used = np.arange(z.shape[1]) < chain.counts[:, None]
        H, z = np.where(used[:, :, None], H, 0.0), np.where(used, z, 0.0)
    if not (chain.coupling_counts == u.shape[1]).all():
        used = np.arange(u.shape[1]) < chain.coupling_counts[:, None]
        M, L, u = np.where(used[:, :, None], M, 0.0), np.where(used[:, :, None], L, 0.0), np.where(used, u, 0.0)
    # component by component on contiguous columns: twice as fast as products of small matrices
    H, M, L = (np.ascontiguousarray(a.transpose(1, 2, 0)) for a in (H, M, L))
    z, u = np.ascontiguousarray(z.T), np.ascontiguousarray(u.T)

    def product(A: FloatArray, B: FloatArray) -> FloatArray:
        return np.asarray(sum(a * b for a, b in zip(A, B, strict=True)), np.float64)

    band = np.zeros((2 * n, N * n))  # upper form: band[2n - 1 + i - j, j] = A[i, j]
    right = np.empty((N, n))
    for i in range(n):
        for j in range(i, n):
            entry = np.zeros(N) + product(H[:, i], H[:, j])
            entry[:-1] += product(M[:, i], M[:, j])
            entry[1:] += product(L[:, i], L[:, j])
            band[2 * n - 1 + i - j, j::n] = entry
        for j in range(n):
            band[n - 1 + i - j, n + j :: n] = product(M[:, i], L[:, j])
        entry = np.zeros(N) + product(H[:, i], z)
        entry[:-1] += product(M[:, i], u)
        entry[1:] += product(L[:, i], u)
        right[:, i] = entry
    if chain.prior is not None:
        R0, b0 = chain.prior
        for i in range(n):
            for j in range(i, n):
                band[2 * n - 1 + i - j, j] += R0[:, i] @ R0[:, j]
            right[0, i] += R0[:, i] @ b0
    solved = solveh_banded(band, right.ravel(), overwrite_ab=True, overwrite_b=True, check_finite=False)
    return np.asarray(solved).reshape(N, n)


def insert_row(W: FloatArray, row: FloatArray) -> tuple[int, float]:
    """Rotate one row into [R | b] in plain numpy; both arguments are overwritten.

    Parameters
    ----------
    W : (p, p + 1) array
        Triangle and right-hand side.
    row : (p + 1,) array
        Coefficients and right-hand side.

    Returns
    -------
    pivot : int
        The pivot that a necessary row filled, or -1 for a redundant row.
    f : float
        Residual of a redundant row, 0 for a necessary one.

    References
    ----------
    Specification rail 5, equations (22)-(23).

    Examples
    --------
    >>> W = np.zeros((1, 2))
    >>> insert_row(W, np.array([1.0, 2.0])), insert_row(W, np.array([1.0, 2.0]))[0]
    ((0, 0.0), -1)
    """
    p = len(W)
    floor = 1e-12 * np.linalg.norm(row[:p])
    for j in range(p):
        if row[j] == 0.0:
            continue
        if W[j, j] == 0.0:
            if abs(row[j]) <= floor:
                row[j] = 0.0
                continue
            W[j, j:] = np.sign(row[j]) * row[j:]
            row[j:] = 0.0
            return j, 0.0
        h = np.hypot(W[j, j], row[j])
        c, s = W[j, j] / h, row[j] / h
        W[j, j:], row[j:] = c * W[j, j:] + s * row[j:], c * row[j:] - s * W[j, j:]
        row[j] = 0.0
    return -1, float(row[p])


def row_reduction(chain: Chain) -> RowReduction:
    """Reduce a chain row by row in plain numpy: the twin of the compiled sweep.

    Parameters
    ----------
    chain : Chain
        Whitened rows.

    Returns
    -------
    RowReduction
        Records, last triangle, residuals and states.

    References
    ----------
    Specification rail 5 (the eight steps) and 15.2.

    Examples
    --------
    >>> chain = Chain([[1.0]], [[0.0], [1.1], [1.9]], [[-1.0]], [[1.0]], [[1.0], [1.0]])
    >>> [round(f, 9) for _, f in row_reduction(chain).residuals]
    [0.057735027, -0.102062073]
    """
    N, n = len(chain), chain.n
    m, q = chain.z.shape[1], chain.u.shape[1]
    H = np.broadcast_to(chain.H, (N, m, n))
    M, L = (np.broadcast_to(a, (N - 1, q, n)) for a in (chain.M, chain.L))
    u = np.broadcast_to(chain.u, (N - 1, q))
    W = np.zeros((2 * n, 2 * n + 1))
    records = np.zeros((N - 1, n, 2 * n + 1))
    residuals: list[tuple[int, float]] = []
    if chain.prior is not None:
        for coefficients, value in zip(*chain.prior, strict=True):
            insert_row(W, np.concatenate([coefficients, np.zeros(n), [value]]))
    for k in range(N):
        for i in range(chain.counts[k]):
            if H[k, i].any():
                pivot, f = insert_row(W, np.concatenate([H[k, i], np.zeros(n), [chain.z[k, i]]]))
                if pivot < 0:
                    residuals.append((k, f))
        if k < N - 1:
            for i in range(chain.coupling_counts[k]):
                insert_row(W, np.concatenate([M[k, i], L[k, i], [u[k, i]]]))
            records[k] = W[:n]
            below = W[n:].copy()
            W[:] = 0.0
            W[:n, :n], W[:n, -1] = below[:, n : 2 * n], below[:, -1]
    triangle = np.column_stack([W[:n, :n], W[:n, -1]])
    state = np.empty((N, n))
    state[-1] = np.linalg.solve(triangle[:, :n], triangle[:, n])
    for k in range(N - 2, -1, -1):
        known = records[k, :, 2 * n] - records[k, :, n : 2 * n] @ state[k + 1]
        state[k] = np.linalg.solve(records[k, :, :n], known)
    return RowReduction(records, triangle, residuals, state)


def kalman_rts(
    state: FloatArray,
    covariance: FloatArray,
    F: FloatArray,
    g: FloatArray,
    Q: FloatArray,
    H: FloatArray,
    R: FloatArray,
    z: FloatArray,
) -> RtsSolution:
    """Filter and smooth in covariances, as the textbooks write it; nothing is whitened here.

    Parameters
    ----------
    state, covariance : (n,), (n, n) array
        Prior of the first state.
    F, g, Q : (N - 1, n, n), (N - 1, n), (N - 1, n, n) array
        x_(k+1) = F_k x_k + g_k + w_k, w_k ~ N(0, Q_k).
    H, R, z : (N, m, n), (N, m, m), (N, m) array
        Observations; an epoch whose z has a NaN has none.

    Returns
    -------
    RtsSolution
        Filtered and smoothed estimates, NIS.

    Examples
    --------
    >>> one = np.ones((1, 1, 1))
    >>> kalman_rts(np.zeros(1), np.eye(1), one[:0], one[:0, 0], one[:0], one, one, np.array([[2.0]])).state
    array([[1.]])
    """
    N, n = len(z), len(state)
    x, P = state, covariance
    filtered, roots, predicted, spread, nis = [], [], [x], [P], np.zeros(N)
    for k in range(N):
        if k:
            x, P = F[k - 1] @ x + g[k - 1], F[k - 1] @ P @ F[k - 1].T + Q[k - 1]
            predicted.append(x)
            spread.append(P)
        if np.isfinite(z[k]).all():
            nu, S = z[k] - H[k] @ x, H[k] @ P @ H[k].T + R[k]
            K = np.linalg.solve(S, H[k] @ P).T
            nis[k] = nu @ np.linalg.solve(S, nu)
            x, J = x + K @ nu, np.eye(n) - K @ H[k]
            P = J @ P @ J.T + K @ R[k] @ K.T
        filtered.append(x)
        roots.append(P)
    xs, Ps = [filtered[-1]], [roots[-1]]
    for k in range(N - 2, -1, -1):
        G = np.linalg.solve(spread[k + 1], F[k] @ roots[k]).T
        xs.append(filtered[k] + G @ (xs[-1] - predicted[k + 1]))
        Ps.append(roots[k] + G @ (Ps[-1] - spread[k + 1]) @ G.T)
    return RtsSolution(np.array(filtered), np.array(roots), np.array(xs[::-1]), np.array(Ps[::-1]), nis)
