"""Inner loops of the estimation room: float64 C-contiguous arrays, no validation; "overwritten" says what changes.

Loops of another room may call these; after a change here, empty that room's numba cache (numba watches one file only).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import cast

import numpy as np
from numba import boolean, float64, int64, njit, types
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: A pivot this small against the row it would come from counts as empty (rail 15.8).
PIVOT_TOLERANCE = 1e-12
EMPTY = PIVOT_TOLERANCE * PIVOT_TOLERANCE

#: A variance this small, given the ones before it, against itself: the covariance is singular.
VARIANCE_TOLERANCE = 1e-13


# ---------------------------------------------------------------- rows into a triangle


@njit(cache=True)
def insert_row_kernel(W: FloatArray, row: FloatArray) -> tuple[int, float]:
    """Rotate one row into the triangle [R | b] (rail 5, eqs 22-23); give (pivot, 0) if necessary, (-1, f) if redundant."""
    # W (p, p + 1) upper triangular with its right-hand side, row (p + 1,): both overwritten
    p = W.shape[0]
    norm2 = 0.0
    for j in range(p):
        norm2 += row[j] * row[j]
    floor = PIVOT_TOLERANCE * np.sqrt(norm2)
    for j in range(p):
        a = row[j]
        if a == 0.0:
            continue
        r = W[j, j]
        if r == 0.0:
            if abs(a) <= floor:  # what rounding left of a zero is no information
                row[j] = 0.0
                continue
            sign = 1.0 if a > 0.0 else -1.0
            for i in range(j, p + 1):
                W[j, i] = sign * row[i]
                row[i] = 0.0
            return j, 0.0
        h = np.sqrt(r * r + a * a)
        c = r / h
        s = a / h
        W[j, j] = h
        row[j] = 0.0
        for i in range(j + 1, p + 1):
            t = W[j, i]
            W[j, i] = c * t + s * row[i]
            row[i] = c * row[i] - s * t
    return -1, float(row[p])


@njit(cache=True)
def insert_rows_kernel(W: FloatArray, rows: FloatArray, count: int) -> tuple[float, int]:
    """Rotate `count` rows in one by one; give the sum of f^2 and the number of redundant rows (rows of zeros are absent)."""
    # W (p, p + 1), rows (at least count, p + 1): both overwritten
    p = W.shape[0]
    total = 0.0
    redundant = 0
    for i in range(count):
        empty = True
        for j in range(p):
            if rows[i, j] != 0.0:
                empty = False
                break
        if empty:
            continue
        pivot, f = insert_row_kernel(W, rows[i])
        if pivot < 0:
            total += f * f
            redundant += 1
    return total, redundant


# ---------------------------------------------------------------- the chain, forward

_READ_ONLY = (
    types.Array(float64, 1, "C", readonly=True),
    types.Array(float64, 2, "C", readonly=True),
    types.Array(float64, 3, "C", readonly=True),
    types.Array(int64, 1, "C", readonly=True),
)


@cache
def forward_kernel(size: int) -> Callable[..., int]:
    """Compile the forward sweep for states of one size (loops of constant length), or for any size (0)."""
    # one signature, inputs read-only: otherwise each mixture of read-only and writable arrays would compile anew
    f1, f2, f3, i1 = _READ_ONLY
    out_f1, out_f2, out_f3, out_i1, out_b1 = float64[::1], float64[:, ::1], float64[:, :, ::1], int64[::1], boolean[::1]
    signature = int64(
        f3, f2, i1, f3, f3, f2, i1, int64, out_f2, f1, out_f3, out_f1, out_i1, out_b1, out_f1, out_i1, out_f2,
        out_f1,
    )  # fmt: skip

    @njit(signature, cache=True, error_model="numpy")
    def forward(
        H: FloatArray,
        z: FloatArray,
        counts: IntArray,
        M: FloatArray,
        L: FloatArray,
        u: FloatArray,
        link_counts: IntArray,
        lead: int,
        triangle: FloatArray,
        limits: FloatArray,
        records: FloatArray,
        nis: FloatArray,
        dof: IntArray,
        rejected: NDArray[np.bool_],
        link_nis: FloatArray,
        link_dof: IntArray,
        filtered: FloatArray,
        growth: FloatArray,
    ) -> int:
        """Sweep a whitened block-bidiagonal chain: observe each epoch, eliminate it, carry the triangle on (rail 15.2)."""
        # H (N | 1, m, n), z (N, m), counts (N,): observation rows, the first counts[k] of each epoch
        # M, L (links | 1, q, n), u (links | 1, q), link_counts (links,): M_k x_k + L_k x_(k+1) = u_k
        # lead 1: link 0 goes before epoch 0 (a chain continued), links = N; lead 0: links = N - 1
        # triangle (n, n + 1): [R | b] of the current epoch, overwritten; limits (m + 1,): NIS by dof that a block may have
        # out: records (links | 0, n, 2n + 1) [R_kk R_kn | d_k]; nis, dof, rejected (N,); link_nis, link_dof (links,);
        # filtered (N | 0, n), NaN while the triangle is singular; growth (N | 0,): sum ln R-_jj - sum ln R+_jj of each epoch's
        # rows (rail 15.4), NaN where R- is singular. Returns the first broken link, or -1
        n = size if size > 0 else H.shape[2]
        w = 2 * n + 1
        H_step = 1 if H.shape[0] > 1 else 0
        M_step = 1 if M.shape[0] > 1 else 0
        L_step = 1 if L.shape[0] > 1 else 0
        u_step = 1 if u.shape[0] > 1 else 0
        links = link_counts.shape[0]
        store = records.shape[0] > 0
        estimate = filtered.shape[0] > 0
        gate = limits.shape[0] > 0
        measure = growth.shape[0] > 0
        broken = -1
        # Rows 0..n-1 hold the epoch that goes, rows n..2n-1 the epoch that comes, R = D^(1/2) (I + T): W. M. Gentleman's
        # rotations without square roots. A row waits for one division a column, and rows follow each other one column behind,
        # which is twice as fast as rotations or reflections with square roots. The new row of T is written as the weighted
        # mean it is (four multiplications): T + take (a - a_j T) would lose digits when a strong row meets a weak pivot.
        # Rows enter from the last to the first: the zeros of upper-triangular whitening matrices (`inverse_root`) then stay
        # zeros and are skipped, 12 rotations an epoch instead of 21 for n = 3. The loop stands here twice because numba's
        # inlining costs a third of the speed.
        D = np.zeros(2 * n)
        T = np.zeros((2 * n, w))
        D_kept = np.zeros(n)
        T_kept = np.zeros((n, n + 1))
        row = np.zeros(w)
        for i in range(n):
            r = triangle[i, i]
            if r != 0.0:
                D[n + i] = r * r
                for c in range(i + 1, n + 1):
                    T[n + i, n + c] = triangle[i, c] / r
        for k in range(z.shape[0]):
            link = k - 1 + lead
            if 0 <= link < links:
                for i in range(n):
                    D[i] = D[n + i]
                    D[n + i] = 0.0  # empty; what its row holds is not read until a necessary row fills it
                    for c in range(i + 1, n):
                        T[i, c] = T[n + i, n + c]
                    T[i, 2 * n] = T[n + i, 2 * n]
                    for c in range(n, 2 * n):
                        T[i, c] = 0.0
                total = 0.0
                redundant = 0
                for r in range(link_counts[link] - 1, -1, -1):
                    norm2 = 0.0
                    for c in range(n):
                        row[c] = M[link * M_step, r, c]
                        row[n + c] = L[link * L_step, r, c]
                    for c in range(2 * n):
                        norm2 += row[c] * row[c]
                    if norm2 != 0.0:  # a row of zeros is absent
                        row[2 * n] = u[link * u_step, r]
                        weight = 1.0
                        for j in range(2 * n):
                            a = row[j]
                            if a == 0.0:
                                continue
                            strength = weight * a
                            d = D[j]
                            if d != 0.0:
                                grown = d + strength * a
                                inverse = 1.0 / grown
                                keep = d * inverse
                                take = strength * inverse
                                weight *= keep
                                D[j] = grown
                                for c in range(j + 1, w):
                                    t = T[j, c]
                                    T[j, c] = keep * t + take * row[c]
                                    row[c] -= a * t
                            elif not strength * a <= EMPTY * norm2:  # else: what rounding left of a zero
                                D[j] = strength * a
                                inverse = 1.0 / a
                                for c in range(j + 1, w):
                                    T[j, c] = row[c] * inverse
                                weight = -1.0  # a necessary row
                                break
                        if weight >= 0.0:
                            total += weight * row[2 * n] * row[2 * n]
                            redundant += 1
                link_nis[link] = total
                link_dof[link] = redundant
                if broken < 0:
                    tied = False
                    for i in range(n):
                        for c in range(n, 2 * n):
                            if D[i] != 0.0 and T[i, c] != 0.0:
                                tied = True
                                break
                        if tied:
                            break
                    if not tied:
                        broken = link
                if store:
                    for i in range(n):
                        r = np.sqrt(D[i])
                        for c in range(i):
                            records[link, i, c] = 0.0
                        records[link, i, i] = r
                        for c in range(i + 1, w):
                            records[link, i, c] = r * T[i, c]
            if gate:
                for i in range(n):
                    D_kept[i] = D[n + i]
                    for c in range(i + 1, n + 1):
                        T_kept[i, c] = T[n + i, n + c]
            if measure:
                growth[k] = 0.0
                for i in range(n):
                    growth[k] += 0.5 * np.log(D[n + i]) if D[n + i] > 0.0 else np.nan
            total = 0.0
            redundant = 0
            for r in range(counts[k] - 1, -1, -1):
                norm2 = 0.0
                for c in range(n):
                    row[n + c] = H[k * H_step, r, c]
                    norm2 += row[n + c] * row[n + c]
                if norm2 != 0.0:
                    row[2 * n] = z[k, r]
                    weight = 1.0
                    for j in range(n, 2 * n):
                        a = row[j]
                        if a == 0.0:
                            continue
                        strength = weight * a
                        d = D[j]
                        if d != 0.0:
                            grown = d + strength * a
                            inverse = 1.0 / grown
                            keep = d * inverse
                            take = strength * inverse
                            weight *= keep
                            D[j] = grown
                            for c in range(j + 1, w):
                                t = T[j, c]
                                T[j, c] = keep * t + take * row[c]
                                row[c] -= a * t
                        elif not strength * a <= EMPTY * norm2:  # else: what rounding left of a zero
                            D[j] = strength * a
                            inverse = 1.0 / a
                            for c in range(j + 1, w):
                                T[j, c] = row[c] * inverse
                            weight = -1.0  # a necessary row
                            break
                    if weight >= 0.0:
                        total += weight * row[2 * n] * row[2 * n]
                        redundant += 1
            if measure:
                for i in range(n):
                    growth[k] -= 0.5 * np.log(D[n + i]) if D[n + i] > 0.0 else np.nan
            nis[k] = total
            dof[k] = redundant
            rejected[k] = gate and redundant > 0 and total > limits[redundant]
            if rejected[k]:
                for i in range(n):
                    D[n + i] = D_kept[i]
                    for c in range(i + 1, n + 1):
                        T[n + i, n + c] = T_kept[i, c]
            if estimate:
                determined = True
                for i in range(n - 1, -1, -1):
                    determined = determined and D[n + i] != 0.0
                    t = T[n + i, 2 * n]
                    for c in range(i + 1, n):
                        t -= T[n + i, n + c] * filtered[k, c]
                    filtered[k, i] = t
                if not determined:
                    for i in range(n):
                        filtered[k, i] = np.nan
        for i in range(n):
            r = np.sqrt(D[n + i])
            triangle[i, i] = r
            for c in range(i + 1, n + 1):
                triangle[i, c] = r * T[n + i, n + c]
        return broken

    return cast("Callable[..., int]", forward)


# ---------------------------------------------------------------- the chain, backward


@cache
def smooth_chain_kernel(size: int) -> Callable[..., int]:
    """Compile the substitution for states of one size, or for any size (0)."""

    @njit(cache=True, error_model="numpy")
    def substitute(records: FloatArray, last: FloatArray, state: FloatArray) -> int:
        """Substitute backwards, x_k = R_kk^-1 (d_k - R_kn x_(k+1)) (rail 15.3); give k n + i of an empty pivot, or -1."""
        # records (N - 1, n, 2n + 1), last (n, n + 1) [R | b] of the last epoch; state (N, n) out
        links = records.shape[0]
        n = size if size > 0 else last.shape[0]
        for i in range(n - 1, -1, -1):
            if last[i, i] == 0.0:
                return int(links * n + i)
            t = last[i, n]
            for c in range(n - 1, i, -1):
                t -= last[i, c] * state[links, c]
            state[links, i] = t / last[i, i]
        for k in range(links - 1, -1, -1):
            for i in range(n - 1, -1, -1):
                pivot = records[k, i, i]
                if pivot == 0.0:
                    return int(k * n + i)
                inverse = 1.0 / pivot  # waits for nothing; the terms known last come last
                t = records[k, i, 2 * n]
                for c in range(n - 1, -1, -1):
                    t -= records[k, i, n + c] * state[k + 1, c]
                for c in range(n - 1, i, -1):
                    t -= records[k, i, c] * state[k, c]
                state[k, i] = t * inverse
        return -1

    return cast("Callable[..., int]", substitute)


@njit(cache=True)
def invert_upper_kernel(R: FloatArray, inverse: FloatArray) -> None:
    """Invert the upper triangle in the first n columns of R."""
    # R (n, >= n) with non-zero diagonal; inverse (n, n) out, zeros below the diagonal
    n = inverse.shape[0]
    for j in range(n):
        for i in range(n):
            inverse[i, j] = 0.0
        inverse[j, j] = 1.0 / R[j, j]
        for i in range(j - 1, -1, -1):
            t = 0.0
            for c in range(i + 1, j + 1):
                t -= R[i, c] * inverse[c, j]
            inverse[i, j] = t / R[i, i]


@cache
def covariance_chain_kernel(size: int) -> Callable[..., None]:
    """Compile the recursion of the covariances for states of one size, or for any size (0)."""

    @njit(cache=True, error_model="numpy")
    def carry(records: FloatArray, last: FloatArray, covariance: FloatArray, lag_one: FloatArray) -> None:
        """Carry covariances backwards: P_k = R_kk^-1 R_kk^-T + G_k P_(k+1) G_k^T, C_k = G_k P_(k+1) (rail 15.3)."""
        # records (N - 1, n, 2n + 1), last (n, n + 1): pivots all positive; covariance (N, n, n), lag_one (N - 1 | 0, n, n) out
        links = records.shape[0]
        n = size if size > 0 else last.shape[0]
        root = np.zeros((n, n))
        G = np.zeros((n, n))
        C = np.zeros((n, n))
        invert_upper_kernel(last, root)
        for i in range(n):
            for j in range(i, n):
                t = 0.0
                for c in range(j, n):
                    t += root[i, c] * root[j, c]
                covariance[links, i, j] = t
                covariance[links, j, i] = t
        for k in range(links - 1, -1, -1):
            for j in range(n):
                root[j, j] = 1.0 / records[k, j, j]
                for i in range(j - 1, -1, -1):
                    t = 0.0
                    for c in range(i + 1, j + 1):
                        t -= records[k, i, c] * root[c, j]
                    root[i, j] = t * root[i, i]
            for i in range(n):
                for j in range(n):
                    t = 0.0
                    for c in range(i, n):
                        t -= root[i, c] * records[k, c, n + j]
                    G[i, j] = t
            for i in range(n):
                for j in range(n):
                    t = 0.0
                    for c in range(n):
                        t += G[i, c] * covariance[k + 1, c, j]
                    C[i, j] = t
            for i in range(n):
                for j in range(i, n):
                    t = 0.0
                    for c in range(j, n):
                        t += root[i, c] * root[j, c]
                    for c in range(n):
                        t += C[i, c] * G[j, c]
                    covariance[k, i, j] = t
                    covariance[k, j, i] = t
            if lag_one.shape[0] > 0:
                for i in range(n):
                    for j in range(n):
                        lag_one[k, i, j] = C[i, j]

    return cast("Callable[..., None]", carry)


# ---------------------------------------------------------------- chains with constants, and chains driven by few noises


@njit(cache=True)
def bordered_forward_kernel(
    H: FloatArray,
    H_border: FloatArray,
    z: FloatArray,
    counts: IntArray,
    M: FloatArray,
    L: FloatArray,
    M_border: FloatArray,
    u: FloatArray,
    link_counts: IntArray,
    triangle: FloatArray,
    records: FloatArray,
    nis: FloatArray,
    dof: IntArray,
    link_nis: FloatArray,
    link_dof: IntArray,
    growth: FloatArray,
) -> int:
    """Sweep a chain whose rows also hold p constants theta, carried as a border (rail 15.6)."""
    # H (N | 1, m, n), H_border (N | 1, m, p), z (N, m), counts (N,); M, L (links | 1, q, n), M_border (links | 1, q, p),
    # u (links | 1, q), link_counts (links,); triangle (n + p, n + p + 1) of (x_0, theta), overwritten with that of the last epoch
    # out: records (links, n, 2n + p + 1) [R_kk R_kn R_kt | d_k]; nis, dof (N,); link_nis, link_dof (links,);
    # growth (N,) as in the plain sweep. Returns the first link that couples nothing, or -1
    n = H.shape[2]
    p = H_border.shape[2]
    w = 2 * n + p
    links = link_counts.shape[0]
    H_step = 1 if H.shape[0] > 1 else 0
    Hb_step = 1 if H_border.shape[0] > 1 else 0
    M_step = 1 if M.shape[0] > 1 else 0
    L_step = 1 if L.shape[0] > 1 else 0
    Mb_step = 1 if M_border.shape[0] > 1 else 0
    u_step = 1 if u.shape[0] > 1 else 0
    W = np.zeros((w, w + 1))  # columns x_k | x_(k+1) | theta | right-hand side
    rows = np.zeros((max(z.shape[1], M.shape[1]), w + 1))
    near = np.zeros((max(z.shape[1], 1), n + p + 1))
    broken = -1
    for k in range(z.shape[0]):
        m = counts[k]
        growth[k] = 0.0
        for i in range(n + p):
            growth[k] += np.log(triangle[i, i]) if triangle[i, i] > 0.0 else np.nan
        for r in range(m):
            for c in range(n):
                near[r, c] = H[k * H_step, r, c]
            for c in range(p):
                near[r, n + c] = H_border[k * Hb_step, r, c]
            near[r, n + p] = z[k, r]
        nis[k], dof[k] = insert_rows_kernel(triangle, near, m)
        for i in range(n + p):
            growth[k] -= np.log(triangle[i, i]) if triangle[i, i] > 0.0 else np.nan
        if k == links:
            break
        for i in range(w):
            for c in range(w + 1):
                W[i, c] = 0.0
        for i in range(n + p):
            target = i if i < n else n + i
            for c in range(i, n + p + 1):
                W[target, c if c < n else n + c] = triangle[i, c]
        q = link_counts[k]
        for r in range(q):
            for c in range(n):
                rows[r, c] = M[k * M_step, r, c]
                rows[r, n + c] = L[k * L_step, r, c]
            for c in range(p):
                rows[r, 2 * n + c] = M_border[k * Mb_step, r, c]
            rows[r, w] = u[k * u_step, r]
        link_nis[k], link_dof[k] = insert_rows_kernel(W, rows, q)
        tied = False
        for i in range(n):
            for c in range(w + 1):
                records[k, i, c] = W[i, c]
            for c in range(n, 2 * n):
                tied = tied or (W[i, i] != 0.0 and W[i, c] != 0.0)
        if broken < 0 and not tied:
            broken = k
        for i in range(n + p):
            for c in range(n + p + 1):
                triangle[i, c] = W[n + i, n + c]
    return broken


@njit(cache=True)
def bordered_backward_kernel(
    records: FloatArray,
    state: FloatArray,
    theta: FloatArray,
    covariance: FloatArray,
    lag_one: FloatArray,
    cross: FloatArray,
    theta_covariance: FloatArray,
) -> int:
    """Substitute backwards with known constants; covariances of the states, with their next and with theta (rail 15.3, 15.6)."""
    # records (links, n, 2n + p + 1); state (N, n), covariance (N, n, n), cross (N, n, p) cov(x_k, theta): last one given, the
    # others out; lag_one (links, n, n) out; theta (p,), theta_covariance (p, p). Returns k n + i of an empty pivot, or -1
    links, n = records.shape[0], records.shape[1]
    p = theta.shape[0]
    root = np.zeros((n, n))
    G = np.zeros((n, n))
    B = np.zeros((n, p))
    for k in range(links - 1, -1, -1):
        for i in range(n - 1, -1, -1):
            if records[k, i, i] == 0.0:
                return int(k * n + i)
            t = records[k, i, 2 * n + p]
            for c in range(p):
                t -= records[k, i, 2 * n + c] * theta[c]
            for c in range(n):
                t -= records[k, i, n + c] * state[k + 1, c]
            for c in range(i + 1, n):
                t -= records[k, i, c] * state[k, c]
            state[k, i] = t / records[k, i, i]
        invert_upper_kernel(records[k], root)
        for i in range(n):
            for c in range(n + p):
                t = 0.0
                for j in range(i, n):
                    t -= root[i, j] * records[k, j, n + c]
                if c < n:
                    G[i, c] = t
                else:
                    B[i, c - n] = t
        for i in range(n):
            for j in range(n):
                t = 0.0
                for c in range(n):
                    t += G[i, c] * covariance[k + 1, c, j]
                for c in range(p):
                    t += B[i, c] * cross[k + 1, j, c]
                lag_one[k, i, j] = t
            for j in range(p):
                t = 0.0
                for c in range(n):
                    t += G[i, c] * cross[k + 1, c, j]
                for c in range(p):
                    t += B[i, c] * theta_covariance[c, j]
                cross[k, i, j] = t
        for i in range(n):
            for j in range(i, n):
                t = 0.0
                for c in range(j, n):
                    t += root[i, c] * root[j, c]
                for c in range(n):
                    t += lag_one[k, i, c] * G[j, c]
                for c in range(p):
                    t += cross[k, i, c] * B[j, c]
                covariance[k, i, j] = t
                covariance[k, j, i] = t
    return -1


@njit(cache=True)
def driven_forward_kernel(
    H: FloatArray,
    z: FloatArray,
    counts: IntArray,
    F_inverse: FloatArray,
    g: FloatArray,
    G: FloatArray,
    triangle: FloatArray,
    records: FloatArray,
    nis: FloatArray,
    dof: IntArray,
    filtered: FloatArray,
    growth: FloatArray,
) -> None:
    """Sweep x+ = F x + g + G w, w ~ N(0, I) of rank below n, keeping w (rail 15.5)."""
    # H (N | 1, m, n), z (N, m), counts (N,); F_inverse (links | 1, n, n), g (links | 1, n), G (links | 1, n, r);
    # triangle (n, n + 1), overwritten. out: records (links, r, r + n + 1) [R_w R_wx | d_w]; nis, dof (N,);
    # filtered (N, n) NaN while the triangle is singular; growth (N,) as in the plain sweep
    n = H.shape[2]
    r = G.shape[2]
    w = r + n
    links = records.shape[0]
    H_step = 1 if H.shape[0] > 1 else 0
    F_step = 1 if F_inverse.shape[0] > 1 else 0
    g_step = 1 if g.shape[0] > 1 else 0
    G_step = 1 if G.shape[0] > 1 else 0
    W = np.zeros((w, w + 1))  # columns w | x_(k+1) | right-hand side
    rows = np.zeros((n, w + 1))
    near = np.zeros((max(z.shape[1], 1), n + 1))
    for k in range(z.shape[0]):
        growth[k] = 0.0
        for i in range(n):
            growth[k] += np.log(triangle[i, i]) if triangle[i, i] > 0.0 else np.nan
        for i in range(counts[k]):
            for c in range(n):
                near[i, c] = H[k * H_step, i, c]
            near[i, n] = z[k, i]
        nis[k], dof[k] = insert_rows_kernel(triangle, near, counts[k])
        determined = True
        for i in range(n - 1, -1, -1):
            growth[k] -= np.log(triangle[i, i]) if triangle[i, i] > 0.0 else np.nan
            determined = determined and triangle[i, i] != 0.0
            t = triangle[i, n]
            for c in range(i + 1, n):
                t -= triangle[i, c] * filtered[k, c]
            filtered[k, i] = t / triangle[i, i] if determined else np.nan
        if not determined:
            for i in range(n):
                filtered[k, i] = np.nan
        if k == links:
            break
        # R F^-1 (x+ - g - G w) = b
        for i in range(n):
            for c in range(n):
                t = 0.0
                for j in range(i, n):
                    t += triangle[i, j] * F_inverse[k * F_step, j, c]
                rows[i, r + c] = t
            t = triangle[i, n]
            for c in range(n):
                t += rows[i, r + c] * g[k * g_step, c]
            rows[i, w] = t
            for j in range(r):
                t = 0.0
                for c in range(n):
                    t -= rows[i, r + c] * G[k * G_step, c, j]
                rows[i, j] = t
        for i in range(w):
            for c in range(w + 1):
                W[i, c] = 0.0
        for i in range(r):
            W[i, i] = 1.0
        insert_rows_kernel(W, rows, n)
        for i in range(r):
            for c in range(w + 1):
                records[k, i, c] = W[i, c]
        for i in range(n):
            for c in range(n + 1):
                triangle[i, c] = W[r + i, r + c]


@njit(cache=True)
def driven_backward_kernel(
    F_inverse: FloatArray,
    g: FloatArray,
    G: FloatArray,
    records: FloatArray,
    state: FloatArray,
    noise: FloatArray,
    covariance: FloatArray,
    lag_one: FloatArray,
) -> None:
    """Substitute backwards through kept noises: w = R_w^-1 (d_w - R_wx x+), x = F^-1 (x+ - g - G w), P likewise (rail 15.5)."""
    # records (links, r, r + n + 1); state (N, n), covariance (N, n, n): last one given, the others out;
    # noise (links, r), lag_one (links, n, n) out
    links, r = noise.shape
    n = state.shape[1]
    F_step = 1 if F_inverse.shape[0] > 1 else 0
    g_step = 1 if g.shape[0] > 1 else 0
    G_step = 1 if G.shape[0] > 1 else 0
    root = np.zeros((r, r))
    free = np.zeros((n, r))  # G R_w^-1
    inner = np.zeros((n, n))  # I + G R_w^-1 R_wx
    T = np.zeros((n, n))
    E = np.zeros((n, r))
    step = np.zeros(n)
    for k in range(links - 1, -1, -1):
        kF, kG = k * F_step, k * G_step
        invert_upper_kernel(records[k], root)
        for i in range(r - 1, -1, -1):
            t = records[k, i, r + n]
            for c in range(n):
                t -= records[k, i, r + c] * state[k + 1, c]
            for c in range(i + 1, r):
                t -= records[k, i, c] * noise[k, c]
            noise[k, i] = t / records[k, i, i]
        for i in range(n):
            t = state[k + 1, i] - g[k * g_step, i]
            for c in range(r):
                t -= G[kG, i, c] * noise[k, c]
            step[i] = t
            for c in range(r):
                t = 0.0
                for j in range(c + 1):
                    t += G[kG, i, j] * root[j, c]
                free[i, c] = t
            for c in range(n):
                t = 1.0 if c == i else 0.0
                for j in range(r):
                    t += free[i, j] * records[k, j, r + c]
                inner[i, c] = t
        for i in range(n):
            t = 0.0
            for c in range(n):
                t += F_inverse[kF, i, c] * step[c]
            state[k, i] = t
            for c in range(n):
                t = 0.0
                for j in range(n):
                    t += F_inverse[kF, i, j] * inner[j, c]
                T[i, c] = t
            for c in range(r):
                t = 0.0
                for j in range(n):
                    t += F_inverse[kF, i, j] * free[j, c]
                E[i, c] = t
        for i in range(n):
            for j in range(n):
                t = 0.0
                for c in range(n):
                    t += T[i, c] * covariance[k + 1, c, j]
                lag_one[k, i, j] = t
        for i in range(n):
            for j in range(i, n):
                t = 0.0
                for c in range(n):
                    t += lag_one[k, i, c] * T[j, c]
                for c in range(r):
                    t += E[i, c] * E[j, c]
                covariance[k, i, j] = t
                covariance[k, j, i] = t


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
