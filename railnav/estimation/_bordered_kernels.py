"""Inner loops of chains with constants (a border) and of chains driven by few noises; float64 C-contiguous arrays, no validation."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from railnav.estimation._row_kernels import insert_rows_kernel, invert_upper_kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True)  # type: ignore[untyped-decorator]
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


@njit(cache=True)  # type: ignore[untyped-decorator]
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


@njit(cache=True)  # type: ignore[untyped-decorator]
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


@njit(cache=True)  # type: ignore[untyped-decorator]
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
