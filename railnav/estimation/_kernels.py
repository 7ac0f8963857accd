"""Inner loops on covariances and their roots: float64 C-contiguous arrays, no validation; "overwritten" says what changes.

Loops of other rooms call these; after a change here, empty that room's numba cache (numba watches one file only). The loops of the
chain are in `_chain_kernels`, those of borders and few noises in `_bordered_kernels`, those of single rows in `_row_kernels`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from railnav.estimation._row_kernels import EMPTY, invert_upper_kernel

FloatArray = NDArray[np.float64]

#: A variance this small, given the ones before it, against itself: the covariance is singular.
VARIANCE_TOLERANCE = 1e-13

# ---------------------------------------------------------------- whitening


@njit(cache=True)
def inverse_cholesky_kernel(K: FloatArray, out: FloatArray) -> int:
    """Invert the upper Cholesky factor of each covariance, W = U^-1, K = U U^T; give the first that is none, or -1."""
    # K (N, n, n) symmetric, only the lower triangle is read; out (N, n, n) upper triangular
    n = K.shape[1]
    U = np.zeros((n, n))
    for k in range(K.shape[0]):
        for j in range(n - 1, -1, -1):
            t = K[k, j, j]
            for c in range(j + 1, n):
                t -= U[j, c] * U[j, c]
            if not t > VARIANCE_TOLERANCE * K[k, j, j]:
                return k
            U[j, j] = np.sqrt(t)
            for i in range(j):
                t = K[k, j, i]
                for c in range(j + 1, n):
                    t -= U[i, c] * U[j, c]
                U[i, j] = t / U[j, j]
        invert_upper_kernel(U, out[k])
    return -1


# ---------------------------------------------------------------- square roots of covariances


@njit(cache=True)
def triangularize_rows(A: FloatArray, rows: int) -> int:
    """Reflect columns until the first `rows` rows are [L 0], L lower triangular with L L^T = A A^T; give the rank."""
    # A (at least `rows`, k), k >= rows, overwritten; rows beyond `rows` are left alone
    # each diagonal element of L is positive, or else its whole column is zero (a singular covariance)
    k = A.shape[1]
    column = 0
    for i in range(rows):
        before = 0.0
        for j in range(column):
            before += A[i, j] * A[i, j]
        below = 0.0
        for j in range(column + 1, k):
            below += A[i, j] * A[i, j]
        alpha = A[i, column] if column < k else 0.0
        tail = alpha * alpha + below
        if tail <= EMPTY * (before + tail):
            for j in range(column, k):
                A[i, j] = 0.0
            continue
        if below > 0.0:
            norm = np.sqrt(tail)
            v = alpha - norm if alpha <= 0.0 else -below / (alpha + norm)
            beta = 2.0 * v * v / (below + v * v)
            inverse = 1.0 / v
            for j in range(column + 1, k):
                A[i, j] *= inverse
            for r in range(i + 1, rows):
                t = A[r, column]
                for j in range(column + 1, k):
                    t += A[i, j] * A[r, j]
                t *= beta
                A[r, column] -= t
                for j in range(column + 1, k):
                    A[r, j] -= t * A[i, j]
            A[i, column] = norm
            for j in range(column + 1, k):
                A[i, j] = 0.0
        elif alpha < 0.0:
            for r in range(i, rows):
                A[r, column] = -A[r, column]
        column += 1
    rank = column
    if rank < rows:  # singular: bring each column under the row of its first element; what is left are zero columns
        for j in range(rank - 1, -1, -1):
            lead = j
            while A[lead, j] == 0.0:
                lead += 1
            if lead > j:
                for i in range(lead, rows):
                    A[i, lead] = A[i, j]
                    A[i, j] = 0.0
    return rank


@njit(cache=True)
def predict_kernel(P_sqrt: FloatArray, F: FloatArray, Q_sqrt: FloatArray) -> None:
    """Carry a covariance square root over one step: P_sqrt P_sqrt^T becomes F P F^T + Q."""
    # P_sqrt (n, n) lower, overwritten; F (n, n); Q_sqrt (n, q), any q >= 0
    n = P_sqrt.shape[0]
    q = Q_sqrt.shape[1]
    A = np.empty((n, n + q))
    for i in range(n):
        for j in range(n):
            t = 0.0
            for m in range(j, n):
                t += F[i, m] * P_sqrt[m, j]
            A[i, j] = t
        for j in range(q):
            A[i, n + j] = Q_sqrt[i, j]
    triangularize_rows(A, n)
    for i in range(n):
        for j in range(n):
            P_sqrt[i, j] = A[i, j] if j <= i else 0.0


@njit(cache=True)
def innovation_variance_kernel(P_sqrt: FloatArray, h: FloatArray, variance: float) -> float:
    """Variance of the innovation of one scalar row, h P h^T + variance; what a gate needs before it lets the row in."""
    # P_sqrt (n, n) lower; h (n,)
    n = P_sqrt.shape[0]
    s = variance
    for j in range(n):
        f = 0.0
        for i in range(j, n):
            f += P_sqrt[i, j] * h[i]
        s += f * f
    return s


@njit(cache=True)
def update_scalar_kernel(
    x: FloatArray, P_sqrt: FloatArray, h: FloatArray, innovation: float, variance: float
) -> tuple[float, float]:
    """Let one scalar row in (Carlson's rotations, lower form); give NIS and the log of the innovation variance."""
    # x (n,) and P_sqrt (n, n) lower, overwritten; h (n,); innovation = measured - predicted; variance > 0
    n = x.shape[0]
    f = np.empty(n)
    for j in range(n):
        t = 0.0
        for i in range(j, n):
            t += P_sqrt[i, j] * h[i]
        f[j] = t
    keep = np.empty(n)
    move = np.empty(n)
    s = variance
    for j in range(n - 1, -1, -1):
        grown = s + f[j] * f[j]
        keep[j] = np.sqrt(s / grown)
        move[j] = f[j] / np.sqrt(s * grown)
        s = grown
    gain_scale = innovation / s
    for i in range(n):
        cross = 0.0  # (P_sqrt f)_i gathered from the last column to the first
        for j in range(i, -1, -1):
            t = P_sqrt[i, j]
            P_sqrt[i, j] = keep[j] * t - move[j] * cross
            cross += t * f[j]
        x[i] += cross * gain_scale
    return innovation * gain_scale, np.log(s)


@njit(cache=True)
def update_kernel(
    x: FloatArray, P_sqrt: FloatArray, innovation: FloatArray, H: FloatArray, R_sqrt: FloatArray, S_sqrt: FloatArray
) -> tuple[float, float]:
    """Let a block of rows in by one triangular array; give NIS and ln det S, S_sqrt filled with the root of S."""
    # x (n,) and P_sqrt (n, n) lower, overwritten; innovation (m,); H (m, n); R_sqrt (m, r), rank m; S_sqrt (m, m) out
    #   [ R_sqrt  H P_sqrt ]      [ S_sqrt    0     ]
    #   [   0      P_sqrt  ]  ->  [ K S_sqrt  P_sqrt+ ]
    n = x.shape[0]
    m = innovation.shape[0]
    r = R_sqrt.shape[1]
    A = np.zeros((m + n, max(r, m) + n))
    for i in range(m):
        for j in range(r):
            A[i, j] = R_sqrt[i, j]
        for j in range(n):
            t = 0.0
            for k in range(j, n):
                t += H[i, k] * P_sqrt[k, j]
            A[i, max(r, m) + j] = t
    for i in range(n):
        for j in range(i + 1):
            A[m + i, max(r, m) + j] = P_sqrt[i, j]
    triangularize_rows(A, m + n)
    nis = 0.0
    logdet = 0.0
    y = np.empty(m)
    for i in range(m):
        t = innovation[i]
        for j in range(i):
            t -= A[i, j] * y[j]
        y[i] = t / A[i, i]
        nis += y[i] * y[i]
        logdet += 2.0 * np.log(A[i, i])
        for j in range(m):
            S_sqrt[i, j] = A[i, j] if j <= i else 0.0
    for i in range(n):
        t = 0.0
        for j in range(m):
            t += A[m + i, j] * y[j]
        x[i] += t
        for j in range(n):
            P_sqrt[i, j] = A[m + i, m + j] if j <= i else 0.0
    return nis, logdet


@njit(cache=True)
def smooth_kernel(
    x: FloatArray,
    P_sqrt: FloatArray,
    F: FloatArray,
    Q_sqrt: FloatArray,
    x_predicted: FloatArray,
    x_smoothed: FloatArray,
    P_sqrt_smoothed: FloatArray,
    gain: FloatArray,
) -> None:
    """Carry the smoothed next state back to this one (Rauch-Tung-Striebel in square roots)."""
    # x (n,) and P_sqrt (n, n) lower: filtered here, smoothed after; F (n, n), Q_sqrt (n, q) of the step from here;
    # x_predicted (n,): the next state as predicted from here; x_smoothed, P_sqrt_smoothed: the next state smoothed;
    # gain (n, n) out: the covariance between this state and the next is gain P_smoothed
    #   [ F P_sqrt  Q_sqrt ]      [ P_sqrt-  0 ]
    #   [  P_sqrt     0    ]  ->  [    A     B ]     gain = A (P_sqrt-)^-1,  B B^T = P - gain P- gain^T
    n = x.shape[0]
    q = Q_sqrt.shape[1]
    width = n + max(q, n)
    A = np.zeros((2 * n, width))
    for i in range(n):
        for j in range(n):
            t = 0.0
            for m in range(j, n):
                t += F[i, m] * P_sqrt[m, j]
            A[i, j] = t
        for j in range(q):
            A[i, n + j] = Q_sqrt[i, j]
        for j in range(i + 1):
            A[n + i, j] = P_sqrt[i, j]
    triangularize_rows(A, 2 * n)
    for i in range(n):
        for j in range(n - 1, -1, -1):
            if A[j, j] == 0.0:  # a state known exactly: nothing to learn from it
                gain[i, j] = 0.0
                continue
            t = A[n + i, j]
            for m in range(j + 1, n):
                t -= gain[i, m] * A[m, j]
            gain[i, j] = t / A[j, j]
    B = np.empty((n, 2 * n))
    for i in range(n):
        t = 0.0
        for m in range(n):
            t += gain[i, m] * (x_smoothed[m] - x_predicted[m])
        x[i] += t
        for j in range(n):
            B[i, j] = A[n + i, n + j]
            t = 0.0
            for m in range(j, n):
                t += gain[i, m] * P_sqrt_smoothed[m, j]
            B[i, n + j] = t
    triangularize_rows(B, n)
    for i in range(n):
        for j in range(n):
            P_sqrt[i, j] = B[i, j] if j <= i else 0.0
