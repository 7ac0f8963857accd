"""Inner loops of the survey room: flat float64 arrays, SI, grid frame, no validation."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True)
def thin(x: FloatArray, y: FloatArray, distance: float) -> NDArray[np.bool_]:
    """Keep the first point and each that lies `distance` or more from the last one kept."""
    # x, y (n,) m
    keep = np.zeros(x.shape[0], np.bool_)
    if x.shape[0] > 0:
        keep[0] = True
    last = 0
    for i in range(1, x.shape[0]):
        if (x[i] - x[last]) ** 2 + (y[i] - y[last]) ** 2 >= distance * distance:
            keep[i] = True
            last = i
    return keep


@njit(cache=True)
def foot_on_segment(
    east: FloatArray, north: FloatArray, te: FloatArray, tn: FloatArray, step: float, j: int, x: float, y: float
) -> tuple[float, float]:
    """Foot of (x, y) on the Hermite cubic from node j to j + 1: parameter (may leave 0..1) and signed distance, right positive."""
    # east, north (m,) nodes, m; te, tn (m,) unit tangents; step: arc length between nodes, m
    u = 0.0
    pe, pn, de, dn = east[j], north[j], te[j], tn[j]
    for k in range(5):
        if k == 0:
            u = ((x - east[j]) * te[j] + (y - north[j]) * tn[j]) / step
        else:
            u += ((x - pe) * de + (y - pn) * dn) / (step * (de * de + dn * dn))
        u = min(max(u, -1.0), 2.0)
        u2, u3 = u * u, u * u * u
        h00, h10, h01, h11 = 2 * u3 - 3 * u2 + 1, u3 - 2 * u2 + u, -2 * u3 + 3 * u2, u3 - u2
        g00, g10, g01, g11 = 6 * u2 - 6 * u, 3 * u2 - 4 * u + 1, -6 * u2 + 6 * u, 3 * u2 - 2 * u
        pe = h00 * east[j] + h10 * step * te[j] + h01 * east[j + 1] + h11 * step * te[j + 1]
        pn = h00 * north[j] + h10 * step * tn[j] + h01 * north[j + 1] + h11 * step * tn[j + 1]
        de = (g00 * east[j] + g01 * east[j + 1]) / step + g10 * te[j] + g11 * te[j + 1]
        dn = (g00 * north[j] + g01 * north[j + 1]) / step + g10 * tn[j] + g11 * tn[j + 1]
    size = np.sqrt(de * de + dn * dn)
    return u, ((x - pe) * dn - (y - pn) * de) / size


@njit(cache=True)
def walk(
    east: FloatArray, north: FloatArray, te: FloatArray, tn: FloatArray, step: float,
    x: FloatArray, y: FloatArray, limit: float, s: FloatArray, d: FloatArray,
) -> None:  # fmt: skip
    """Follow a curve along a run: foot offset s, m, and signed distance d, m, of every fix; NaN where farther than `limit`."""
    # east, north, te, tn (m,) nodes of the curve every `step` metres; x, y (n,) fixes in time order; s, d (n,) filled
    m, n = east.shape[0], x.shape[0]
    last, travelled = -1, 0.0
    for i in range(n):
        if i > 0:
            travelled += np.sqrt((x[i] - x[i - 1]) ** 2 + (y[i] - y[i - 1]) ** 2)
        low, high = 0, m
        if last >= 0:
            reach = int((travelled * 1.2 + 60.0) / step) + 2
            low, high = max(0, last - reach), min(m, last + reach + 1)
        best, at = np.inf, -1
        for j in range(low, high):
            r = (x[i] - east[j]) ** 2 + (y[i] - north[j]) ** 2
            if r < best:
                best, at = r, j
        s[i] = np.nan
        d[i] = np.nan
        if best > (limit + step) ** 2:
            continue
        j = min(max(at - 1, 0), m - 2)
        u, off = foot_on_segment(east, north, te, tn, step, j, x[i], y[i])
        if u > 1.0 and j < m - 2:
            u, off = foot_on_segment(east, north, te, tn, step, j + 1, x[i], y[i])
            j += 1
        if abs(off) > limit or u < -0.5 or u > 1.5:
            continue
        s[i] = (j + u) * step
        d[i] = off
        last, travelled = at, 0.0


@njit(cache=True)
def middle(value: FloatArray, apart: float, guess: FloatArray, clumps: IntArray) -> None:
    """Median of the largest clump of values at every node (gaps above `apart` part clumps; a tie goes to the first row)."""
    # value (K, N), NaN absent; guess (N,) and clumps (N,) filled: NaN and 0 where nothing is
    K, N = value.shape
    v = np.empty(K)
    for i in range(N):
        many = 0
        lead = np.nan
        for k in range(K):
            if np.isfinite(value[k, i]):
                if many == 0:
                    lead = value[k, i]
                v[many] = value[k, i]
                many += 1
        guess[i] = np.nan
        clumps[i] = 0
        if many == 0:
            continue
        w = np.sort(v[:many])
        best, best_a, best_b, has_lead = 0, 0, 0, False
        a = 0
        for b in range(1, many + 1):
            if b == many or w[b] - w[b - 1] > apart:
                clumps[i] += 1
                own = w[a] <= lead <= w[b - 1]
                if b - a > best or (b - a == best and own and not has_lead):
                    best, best_a, best_b, has_lead = b - a, a, b, own
                a = b
        m = (best_a + best_b) // 2
        guess[i] = w[m] if (best_b - best_a) % 2 == 1 else 0.5 * (w[m - 1] + w[m])


@njit(cache=True)
def reflect_columns(A: FloatArray, rows: int, columns: int) -> None:
    """Reflect rows 0..rows-1 of A so that its first `columns` columns are upper triangular (Householder, signs left as they fall)."""
    # A (>= rows, width), overwritten; rows may be fewer than columns
    width = A.shape[1]
    for j in range(min(columns, rows)):
        tail = 0.0
        for i in range(j + 1, rows):
            tail += A[i, j] * A[i, j]
        if tail == 0.0:
            continue
        a = A[j, j]
        norm = np.sqrt(a * a + tail)
        v = a - norm if a <= 0.0 else -tail / (a + norm)
        beta = 2.0 * v * v / (tail + v * v)
        for i in range(j + 1, rows):
            A[i, j] /= v
        w = A[j, j + 1 :].copy()
        for i in range(j + 1, rows):
            f = A[i, j]
            if f != 0.0:
                for c in range(j + 1, width):
                    w[c - j - 1] += f * A[i, c]
        for c in range(j + 1, width):
            A[j, c] -= beta * w[c - j - 1]
        for i in range(j + 1, rows):
            f = beta * A[i, j]
            if f != 0.0:
                for c in range(j + 1, width):
                    A[i, c] -= f * w[c - j - 1]
            A[i, j] = 0.0
        A[j, j] = norm


@njit(cache=True)
def sweep(
    phi: FloatArray, drive: FloatArray, first_sigma: FloatArray, M: FloatArray, L: FloatArray, U: FloatArray,
    first: IntArray, who: IntArray, place: IntArray, axis: FloatArray, weight: FloatArray, value: FloatArray, design: FloatArray,
    prior: FloatArray, prior_value: FloatArray, final: FloatArray, final_value: FloatArray, keep: bool,
    Rkk: FloatArray, Rkn: FloatArray, D: FloatArray, T: FloatArray,
) -> float:  # fmt: skip
    """Sweep the bordered chain forward (spec 15.2, 15.6); T gathers the rows left for the border, returns sum ln |R_kk|."""
    # N nodes, E errors, n = E + 3 states: [errors of the runs, y, y', y'']; b columns: value, then the border
    # phi (N-1, E) memory and drive (N-1, E) sd of the errors' steps; first_sigma (E,) sd at node 0
    # M, L (N-1, q, 3), U (N-1, q, 1 + c): M (y,y',y'')_k + L (y,y',y'')_k+1 + U[:, 1:] (last c borders) = U[:, 0], whitened
    # first (N+1,) CSR of rows; who (rows,) error state, -1 none; place (rows,) first border column, -1 none; axis (rows, 3),
    # weight (rows,) on the error, value (rows,), design (rows, B): whitened
    # prior, prior_value (3,) weights of [y, y', y''] at node 0; final (f, 3), final_value (f, 1 + c): rows at the last node
    # Rkk, Rkn (N, n, n), D (N, n, b) filled if keep (else N = 1)
    N = phi.shape[0] + 1
    errors = phi.shape[1]
    n = errors + 3
    b = T.shape[1]
    B = design.shape[1]
    q = M.shape[1]
    c_many = U.shape[2] - 1
    tail = b - c_many  # first of the last c border columns
    most = 0
    for k in range(N):
        most = max(most, first[k + 1] - first[k])
    most += final.shape[0]
    rows_A = n + errors + q
    A = np.zeros((rows_A, 2 * n + b))
    C = np.zeros((n + most, n + b))
    spare = max(most, errors + q - n)
    G = np.zeros((b + max(spare, 0), b))
    logdet = 0.0
    for j in range(errors):
        C[j, j] = 1.0 / first_sigma[j]
    for j in range(3):
        C[errors + j, errors + j] = prior[j]
        C[errors + j, n] = prior[j] * prior_value[j]
    for k in range(N):
        rows = n
        for i in range(first[k], first[k + 1]):
            for c in range(n + b):
                C[rows, c] = 0.0
            if who[i] >= 0:
                C[rows, who[i]] = weight[i]
            for c in range(3):
                C[rows, errors + c] = axis[i, c]
            C[rows, n] = value[i]
            if b > 1 and place[i] >= 0:
                for j in range(B):
                    C[rows, n + place[i] + j] = design[i, j]
            rows += 1
        if k == N - 1:
            for i in range(final.shape[0]):
                for c in range(n + b):
                    C[rows, c] = 0.0
                for c in range(3):
                    C[rows, errors + c] = final[i, c]
                C[rows, n] = final_value[i, 0]
                for c in range(c_many):
                    C[rows, n + tail + c] = final_value[i, 1 + c]
                rows += 1
        reflect_columns(C[:rows], rows, n)
        left = rows - n
        if left > 0:
            for i in range(left):
                for c in range(b):
                    G[b + i, c] = C[n + i, n + c]
            for i in range(b):
                for c in range(b):
                    G[i, c] = T[i, c]
            reflect_columns(G[: b + left], b + left, b)
            for i in range(b):
                for c in range(b):
                    T[i, c] = G[i, c]
        for j in range(n):
            logdet += np.log(abs(C[j, j])) if k == N - 1 else 0.0
        if k == N - 1:
            if keep:
                Rkk[k] = C[:n, :n]
                D[k] = C[:n, n:]
            break
        for i in range(rows_A):
            for c in range(2 * n + b):
                A[i, c] = 0.0
        for i in range(n):
            for c in range(i, n):
                A[i, c] = C[i, c]
            for c in range(b):
                A[i, 2 * n + c] = C[i, n + c]
        for j in range(errors):
            w = 1.0 / drive[k, j]
            A[n + j, j] = -w * phi[k, j]
            A[n + j, n + j] = w
        for i in range(q):
            for j in range(3):
                A[n + errors + i, errors + j] = M[k, i, j]
                A[n + errors + i, n + errors + j] = L[k, i, j]
            A[n + errors + i, 2 * n] = U[k, i, 0]
            for c in range(c_many):
                A[n + errors + i, 2 * n + tail + c] = U[k, i, 1 + c]
        beyond = rows_A - 2 * n
        reflect_columns(A, rows_A, 2 * n if beyond > 0 else n)
        for j in range(n):
            logdet += np.log(abs(A[j, j]))
        if keep:
            Rkk[k] = A[:n, :n]
            Rkn[k] = A[:n, n : 2 * n]
            D[k] = A[:n, 2 * n :]
        for i in range(n):
            for c in range(n):
                C[i, c] = A[n + i, n + c]
            for c in range(b):
                C[i, n + c] = A[n + i, 2 * n + c]
        if beyond > 0:  # redundant couplings speak of the border
            for i in range(beyond):
                for c in range(b):
                    G[b + i, c] = A[2 * n + i, 2 * n + c]
            for i in range(b):
                for c in range(b):
                    G[i, c] = T[i, c]
            reflect_columns(G[: b + beyond], b + beyond, b)
            for i in range(b):
                for c in range(b):
                    T[i, c] = G[i, c]
    return logdet


@njit(cache=True)
def back(Rkk: FloatArray, Rkn: FloatArray, D: FloatArray, X: FloatArray) -> None:
    """Substitute backwards (spec 15.3) for all right-hand sides at once: X (N, n, b) filled."""
    N, n = Rkk.shape[0], Rkk.shape[1]
    b = D.shape[2]
    for k in range(N - 1, -1, -1):
        X[k] = D[k]
        if k < N - 1:
            for i in range(n):
                for j in range(n):
                    f = Rkn[k, i, j]
                    for c in range(b):
                        X[k, i, c] -= f * X[k + 1, j, c]
        for i in range(n - 1, -1, -1):
            for j in range(i + 1, n):
                f = Rkk[k, i, j]
                for c in range(b):
                    X[k, i, c] -= f * X[k, j, c]
            for c in range(b):
                X[k, i, c] /= Rkk[k, i, i]


@njit(cache=True)
def covariances(Rkk: FloatArray, Rkn: FloatArray, axis: FloatArray, lag: FloatArray) -> None:
    """Covariance of [y, y', y''] (N, 3, 3) and with the next node's (N-1, 3, 3), borders held fixed (spec 15.3)."""
    N, n = Rkk.shape[0], Rkk.shape[1]
    a = n - 3
    P = np.zeros((n, n))
    G = np.zeros((n, n))
    V = np.zeros((n, n))
    H = np.zeros((n, n))
    for k in range(N - 1, -1, -1):
        # V = Rkk^-1, upper triangular
        for j in range(n):
            for i in range(n):
                V[i, j] = 0.0
        for i in range(n - 1, -1, -1):
            V[i, i] = 1.0 / Rkk[k, i, i]
            for m in range(i + 1, n):
                f = -Rkk[k, i, m] / Rkk[k, i, i]
                for j in range(m, n):
                    V[i, j] += f * V[m, j]
        if k < N - 1:
            for i in range(n):
                for j in range(n):
                    G[i, j] = 0.0
                for m in range(i, n):
                    f = -V[i, m]
                    for j in range(n):
                        G[i, j] += f * Rkn[k, m, j]
            for i in range(n):
                for j in range(n):
                    H[i, j] = 0.0
                for m in range(n):
                    f = G[i, m]
                    for j in range(n):
                        H[i, j] += f * P[m, j]
            for i in range(3):
                for j in range(3):
                    lag[k, i, j] = H[a + i, a + j]
            for i in range(n):
                for j in range(n):
                    t = 0.0
                    for m in range(n):
                        t += H[i, m] * G[j, m]
                    P[i, j] = t
        else:
            for i in range(n):
                for j in range(n):
                    P[i, j] = 0.0
        for i in range(n):
            for j in range(i, n):
                t = 0.0
                for m in range(j, n):
                    t += V[i, m] * V[j, m]
                P[i, j] += t
                if j > i:
                    P[j, i] = P[i, j]
        for i in range(3):
            for j in range(3):
                axis[k, i, j] = P[a + i, a + j]


@njit(cache=True)
def follow(cost: FloatArray, offset: FloatArray, joint: FloatArray, reach: float, leap: float, track: IntArray) -> None:
    """Cheapest way of a run through tracks, fix by fix: a joint is passed where it lies, any other change costs `leap`."""
    # cost, offset (n, S) of every fix on every track, offset in m, NaN where it is not on it; joint (j, 5): track, offset there, m,
    # track, offset there, m, and what passing it costs; track (n,) filled
    n, S = cost.shape
    total = cost[0].copy()
    came = np.empty((n, S), np.int16)
    for i in range(1, n):
        best = np.argmin(total)
        new = np.empty(S)
        for t in range(S):
            came[i, t] = t
            new[t] = total[t]
            if total[best] + leap < new[t]:
                came[i, t], new[t] = best, total[best] + leap
        for j in range(joint.shape[0]):
            for side in range(2):
                a, b = int(joint[j, 2 * side]), int(joint[j, 2 - 2 * side])
                here, place = offset[i, a], joint[j, 2 * side + 1]
                before = offset[i - 1, a]
                passed = np.isfinite(here) and np.isfinite(before) and (here - place) * (before - place) <= 0.0
                over = not np.isfinite(here) and np.isfinite(before) and abs(before - place) < reach
                there, toe = offset[i, b], joint[j, 3 - 2 * side]
                last = offset[i - 1, b]
                if np.isfinite(there):
                    passed = passed or (np.isfinite(last) and (there - toe) * (last - toe) <= 0.0)
                    over = over or (not np.isfinite(last) and abs(there - toe) < reach)
                if (passed or over) and total[a] + joint[j, 4] < new[b]:
                    came[i, b], new[b] = a, total[a] + joint[j, 4]
        for t in range(S):
            total[t] = new[t] + cost[i, t]
    track[n - 1] = np.argmin(total)
    for i in range(n - 1, 0, -1):
        track[i - 1] = came[i, track[i]]
