"""Inner loops of the chain: the sweep forward, substitution back, covariances; float64 C-contiguous arrays, no validation."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import cast

import numpy as np
from numba import boolean, float64, int64, njit, types
from numpy.typing import NDArray

from railnav.estimation._row_kernels import EMPTY, invert_upper_kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# ---------------------------------------------------------------- forward

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
    out_f1, out_f2, out_i1, out_b1 = float64[::1], float64[:, ::1], int64[::1], boolean[::1]
    signature = int64(
        f3, f2, i1, f3, f3, f2, i1, int64, out_f2, f1, out_f2, out_f1, out_i1, out_b1, out_f1, out_i1, out_f2,
        out_f1,
    )  # fmt: skip

    @njit(signature, cache=True, error_model="numpy", fastmath={"contract"})  # type: ignore[untyped-decorator]
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
        # out: records (links | 0, size) [R_kk R_kn | d_k] by rows without the zeros left of the diagonal;
        # nis, dof, rejected (N,); link_nis, link_dof (links,);
        # link_nis, link_dof (0,): no room, for chains whose links are expected to have no redundant rows; -2 is returned where they do
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
        told = link_nis.shape[0] > 0
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
        plain = size == 3 and not gate and not measure
        for k in range(z.shape[0]):
            link = k - 1 + lead
            linked = False
            if plain and 0 <= link < links and link_counts[link] == 3 and D[3] != 0.0 and D[4] != 0.0 and D[5] != 0.0:
                # three upper-triangular rows on a full triangle, written out: the same rotations with all numbers in registers
                i, j, c = link * M_step, link * L_step, link * u_step
                m00, m01, m02, m11, m12, m22 = M[i, 0, 0], M[i, 0, 1], M[i, 0, 2], M[i, 1, 1], M[i, 1, 2], M[i, 2, 2]
                l00, l01, l02, l11, l12, l22 = L[j, 0, 0], L[j, 0, 1], L[j, 0, 2], L[j, 1, 1], L[j, 1, 2], L[j, 2, 2]
                if (
                    M[i, 1, 0] == 0.0 and M[i, 2, 0] == 0.0 and M[i, 2, 1] == 0.0
                    and L[j, 1, 0] == 0.0 and L[j, 2, 0] == 0.0 and L[j, 2, 1] == 0.0
                ):  # fmt: skip
                    # row 2 meets pivot 2 and fills pivot 5
                    d2, t2 = D[5], T[5, 6]
                    g2 = d2 + m22 * m22
                    f = 1.0 / g2
                    keep, take = d2 * f, m22 * f
                    s25 = take * l22
                    b = u[c, 2]
                    s2 = keep * t2 + take * b
                    b -= m22 * t2
                    e5 = keep * l22 * l22
                    q5 = b / l22
                    # row 1 meets pivots 1 and 2 and fills pivot 4
                    d1, t12, t1 = D[4], T[4, 5], T[4, 6]
                    g1 = d1 + m11 * m11
                    f = 1.0 / g1
                    keep, take = d1 * f, m11 * f
                    weight = keep
                    b = u[c, 1]
                    s12, s14, s15, s1 = keep * t12 + take * m12, take * l11, take * l12, keep * t1 + take * b
                    a = m12 - m11 * t12
                    b -= m11 * t1
                    strength = weight * a
                    d2 = g2
                    g2 = d2 + strength * a
                    f = 1.0 / g2
                    keep, take = d2 * f, strength * f
                    weight *= keep
                    r5 = l12 - a * s25
                    s24, s25 = take * l11, keep * s25 + take * l12
                    t = s2
                    s2 = keep * t + take * b
                    b -= a * t
                    e4 = weight * l11 * l11
                    f = 1.0 / l11
                    p45, q4 = r5 * f, b * f
                    # row 0 meets pivots 0, 1 and 2 and fills pivot 3
                    d0, t01, t02, t0 = D[3], T[3, 4], T[3, 5], T[3, 6]
                    g0 = d0 + m00 * m00
                    f = 1.0 / g0
                    keep, take = d0 * f, m00 * f
                    weight = keep
                    b = u[c, 0]
                    s01, s02 = keep * t01 + take * m01, keep * t02 + take * m02
                    s03, s04, s05, s0 = take * l00, take * l01, take * l02, keep * t0 + take * b
                    a = m01 - m00 * t01
                    r2 = m02 - m00 * t02
                    b -= m00 * t0
                    strength = weight * a
                    d1 = g1
                    g1 = d1 + strength * a
                    f = 1.0 / g1
                    keep, take = d1 * f, strength * f
                    weight *= keep
                    t = s12
                    s12 = keep * t + take * r2
                    r2 -= a * t
                    s13 = take * l00
                    r4, r5 = l01 - a * s14, l02 - a * s15
                    s14, s15 = keep * s14 + take * l01, keep * s15 + take * l02
                    t = s1
                    s1 = keep * t + take * b
                    b -= a * t
                    a = r2
                    strength = weight * a
                    d2 = g2
                    g2 = d2 + strength * a
                    f = 1.0 / g2
                    keep, take = d2 * f, strength * f
                    weight *= keep
                    s23 = take * l00
                    t = s24
                    s24 = keep * t + take * r4
                    r4 -= a * t
                    t = s25
                    s25 = keep * t + take * r5
                    r5 -= a * t
                    t = s2
                    s2 = keep * t + take * b
                    b -= a * t
                    e3 = weight * l00 * l00
                    f = 1.0 / l00
                    if (
                        e5 > EMPTY * (m22 * m22 + l22 * l22)
                        and e4 > EMPTY * (m11 * m11 + m12 * m12 + l11 * l11 + l12 * l12)
                        and e3 > EMPTY * (m00 * m00 + m01 * m01 + m02 * m02 + l00 * l00 + l01 * l01 + l02 * l02)
                    ):
                        linked = True
                        if (
                            broken < 0 and s03 == 0.0 and s04 == 0.0 and s05 == 0.0 and s13 == 0.0 and s14 == 0.0 and s15 == 0.0
                            and s23 == 0.0 and s24 == 0.0 and s25 == 0.0
                        ):  # fmt: skip
                            broken = link
                        if told:
                            link_nis[link] = 0.0
                            link_dof[link] = 0
                        if store:
                            f0, f1, f2 = np.sqrt(g0), np.sqrt(g1), np.sqrt(g2)
                            records[link, 0] = f0
                            records[link, 1] = f0 * s01
                            records[link, 2] = f0 * s02
                            records[link, 3] = f0 * s03
                            records[link, 4] = f0 * s04
                            records[link, 5] = f0 * s05
                            records[link, 6] = f0 * s0
                            records[link, 7] = f1
                            records[link, 8] = f1 * s12
                            records[link, 9] = f1 * s13
                            records[link, 10] = f1 * s14
                            records[link, 11] = f1 * s15
                            records[link, 12] = f1 * s1
                            records[link, 13] = f2
                            records[link, 14] = f2 * s23
                            records[link, 15] = f2 * s24
                            records[link, 16] = f2 * s25
                            records[link, 17] = f2 * s2
                        D[3], D[4], D[5] = e3, e4, e5
                        T[3, 4], T[3, 5], T[3, 6] = r4 * f, r5 * f, b * f
                        T[4, 5], T[4, 6], T[5, 6] = p45, q4, q5
            if not linked and 0 <= link < links:
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
                if told:
                    link_nis[link] = total
                    link_dof[link] = redundant
                elif redundant > 0:
                    return -2
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
                    at = 0
                    for i in range(n):
                        r = np.sqrt(D[i])
                        records[link, at] = r
                        for c in range(i + 1, w):
                            records[link, at + c - i] = r * T[i, c]
                        at += w - i
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
            i = k * H_step
            if plain and counts[k] == 3 and D[3] != 0.0 and D[4] != 0.0 and D[5] != 0.0 and (
                H[i, 1, 0] == 0.0 and H[i, 2, 0] == 0.0 and H[i, 2, 1] == 0.0
                and H[i, 0, 0] != 0.0 and H[i, 1, 1] != 0.0 and H[i, 2, 2] != 0.0
            ):  # fmt: skip
                redundant = 3
                d2, t2 = D[5], T[5, 6]
                a, b = H[i, 2, 2], z[k, 2]
                g2 = d2 + a * a
                f = 1.0 / g2
                keep = d2 * f
                s2 = keep * t2 + a * f * b
                b -= a * t2
                total = keep * b * b
                d1, t12, t1 = D[4], T[4, 5], T[4, 6]
                a, r2, b = H[i, 1, 1], H[i, 1, 2], z[k, 1]
                g1 = d1 + a * a
                f = 1.0 / g1
                keep, take = d1 * f, a * f
                weight = keep
                s12, s1 = keep * t12 + take * r2, keep * t1 + take * b
                r2 -= a * t12
                b -= a * t1
                strength = weight * r2
                d2 = g2
                g2 = d2 + strength * r2
                f = 1.0 / g2
                keep = d2 * f
                weight *= keep
                t = s2
                s2 = keep * t + strength * f * b
                b -= r2 * t
                total += weight * b * b
                d0, t01, t02, t0 = D[3], T[3, 4], T[3, 5], T[3, 6]
                a, r1, r2, b = H[i, 0, 0], H[i, 0, 1], H[i, 0, 2], z[k, 0]
                g0 = d0 + a * a
                f = 1.0 / g0
                keep, take = d0 * f, a * f
                weight = keep
                T[3, 4], T[3, 5], T[3, 6] = keep * t01 + take * r1, keep * t02 + take * r2, keep * t0 + take * b
                r1 -= a * t01
                r2 -= a * t02
                b -= a * t0
                strength = weight * r1
                d1 = g1
                g1 = d1 + strength * r1
                f = 1.0 / g1
                keep, take = d1 * f, strength * f
                weight *= keep
                T[4, 5], T[4, 6] = keep * s12 + take * r2, keep * s1 + take * b
                r2 -= r1 * s12
                b -= r1 * s1
                strength = weight * r2
                d2 = g2
                g2 = d2 + strength * r2
                f = 1.0 / g2
                keep = d2 * f
                T[5, 6] = keep * s2 + strength * f * b
                b -= r2 * s2
                total += weight * keep * b * b
                D[3], D[4], D[5] = g0, g1, g2
            for r in range(counts[k] - 1 if redundant == 0 else -1, -1, -1):
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


# ---------------------------------------------------------------- backward


@cache
def smooth_chain_kernel(size: int) -> Callable[..., int]:
    """Compile the substitution for states of one size, or for any size (0)."""

    @njit(cache=True, error_model="numpy", fastmath={"contract"})  # type: ignore[untyped-decorator]
    def substitute(records: FloatArray, last: FloatArray, state: FloatArray) -> int:
        """Substitute backwards, x_k = R_kk^-1 (d_k - R_kn x_(k+1)) (rail 15.3); give k n + i of an empty pivot, or -1."""
        # records (N - 1, size) packed by rows, last (n, n + 1) [R | b] of the last epoch; state (N, n) out
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
                at = i * (2 * n) - (i * (i - 1)) // 2  # element (i, c) is at + c
                pivot = records[k, at + i]
                if pivot == 0.0:
                    return int(k * n + i)
                inverse = 1.0 / pivot  # waits for nothing; the terms known last come last
                t = records[k, at + 2 * n]
                for c in range(n - 1, -1, -1):
                    t -= records[k, at + n + c] * state[k + 1, c]
                for c in range(n - 1, i, -1):
                    t -= records[k, at + c] * state[k, c]
                state[k, i] = t * inverse
        return -1

    return cast("Callable[..., int]", substitute)


@cache
def covariance_chain_kernel(size: int) -> Callable[..., None]:
    """Compile the recursion of the covariances for states of one size, or for any size (0)."""

    @njit(cache=True, error_model="numpy", fastmath={"contract"})  # type: ignore[untyped-decorator]
    def carry(records: FloatArray, last: FloatArray, covariance: FloatArray, lag_one: FloatArray) -> None:
        """Carry covariances backwards: P_k = R_kk^-1 R_kk^-T + G_k P_(k+1) G_k^T, C_k = G_k P_(k+1) (rail 15.3)."""
        # records (N - 1, size) packed by rows, last (n, n + 1): pivots all positive; covariance (N, n, n), lag_one (N - 1 | 0, n, n) out
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
                root[j, j] = 1.0 / records[k, j * (2 * n) - (j * (j - 1)) // 2 + j]
                for i in range(j - 1, -1, -1):
                    t = 0.0
                    for c in range(i + 1, j + 1):
                        t -= records[k, i * (2 * n) - (i * (i - 1)) // 2 + c] * root[c, j]
                    root[i, j] = t * root[i, i]
            for i in range(n):
                for j in range(n):
                    t = 0.0
                    for c in range(i, n):
                        t -= root[i, c] * records[k, c * (2 * n) - (c * (c - 1)) // 2 + n + j]
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
