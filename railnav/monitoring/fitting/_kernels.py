"""Inner loops of fitting: hypotheses on where elements begin, and elements laid past measured points.

SI and radians, float64, no validation. Equation numbers are those of docs/theory/alignment.md.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

#: Innovations beyond this many sigmas count as outliers.
OUTLIER = 5.0

# Gauss-Legendre, 4 points on [0, 1]
_X = 0.5 * (np.polynomial.legendre.leggauss(4)[0] + 1.0)
_W = 0.5 * np.polynomial.legendre.leggauss(4)[1]


@njit(cache=True)
def _reset(
    x, P, old, new, order, prior, states
):  # x (states + 2,), P alike; numbers of live states -> cost, changed in place
    """Pass from one kind of element to another: what is continuous stays, what jumps is drawn anew, eq (6)."""
    cost = 0.0
    size = states + 2
    for k in range(new, min(order, old)):  # continuous, and zero in the new element: condition on it
        s = P[k, k] + 1e-24
        cost += x[k] * x[k] / s + math.log(s / (prior[k] + 1e-300))
        gain = P[:, k].copy() / s
        nu = x[k]
        for a in range(size):
            x[a] -= gain[a] * nu
        for a in range(size):
            for b in range(size):
                P[a, b] -= gain[a] * gain[b] * s
    for k in range(min(order, new), states):
        x[k] = 0.0
        for a in range(size):
            P[a, k] = 0.0
            P[k, a] = 0.0
        if k < new and k >= order:
            P[k, k] = prior[k]
    return cost


@njit(cache=True)
def segment(
    step, y, shift, turn, bow, white, passing, colour, sites, first, rules, price, prior, beam, margin
):  # (n,) each; first (states, 2); rules (r, 3) -> (m, 3) int: sample, live states, order of the break
    """Cheapest sequence of elements through n measured values by a bank of Kalman filters, eqs (3) to (7).

    States are the value and its derivatives along the track, the last two coloured noise and its slope. `step` (n,) from the sample before,
    m; `y` (n,) measured; `shift`, `turn`, `bow` (n,): what the reference curve itself gains over the step in value and slope, and
    its curvature; `white` (n,) variances; `passing` (n, 4), `colour` (2,): how coloured noise passes on and its
    variances; `rules`: from live states, to live states, lowest order that breaks; `price` (r,): of each.
    """
    n = len(y)
    states = len(prior)
    size = states + 2
    most = beam * 2 + 64
    x = np.zeros((most, size))
    P = np.zeros((most, size, size))
    cost = np.zeros(most)
    live = np.zeros(most, np.int64)
    leaf = np.zeros(most, np.int64)
    x2 = np.zeros((64, size))
    P2 = np.zeros((64, size, size))
    tree = np.empty((4096, 4), np.int64)  # parent, sample, live states, order
    nodes = 0
    count = 0
    for r in range(len(first)):
        a = first[r]
        x[count, 0] = y[0]
        for k in range(states):
            if k < a:
                P[count, k, k] = prior[k]
        P[count, states, states] = colour[0]
        P[count, states + 1, states + 1] = colour[1]
        cost[count] = 0.0
        live[count] = a
        tree[nodes, 0] = -1
        tree[nodes, 1] = 0
        tree[nodes, 2] = a
        tree[nodes, 3] = 0
        leaf[count] = nodes
        nodes += 1
        count += 1
    Fx = np.zeros(size)
    FP = np.zeros((size, size))
    F = np.zeros((size, size))
    for i in range(n):
        h = step[i]
        best = 1e300
        for c in range(count):
            a = live[c]
            if i > 0:
                for p in range(size):
                    for q in range(size):
                        F[p, q] = 0.0
                for p in range(states):
                    term = 1.0
                    for q in range(p, a):
                        F[p, q] = term
                        term *= h / (q - p + 1)
                if states > 1:
                    F[1, 0] -= bow[i] * bow[i] * h  # a parallel curve turns alike over a shorter way
                F[states, states], F[states, states + 1] = passing[i, 0], passing[i, 1]
                F[states + 1, states], F[states + 1, states + 1] = passing[i, 2], passing[i, 3]
                for p in range(size):
                    v = 0.0
                    for q in range(size):
                        v += F[p, q] * x[c, q]
                    Fx[p] = v
                Fx[0] -= shift[i]
                if states > 1 and a > 1:
                    Fx[1] -= turn[i]
                for p in range(size):
                    for q in range(size):
                        v = 0.0
                        for m in range(size):
                            v += F[p, m] * P[c, m, q]
                        FP[p, q] = v
                for p in range(size):
                    x[c, p] = Fx[p]
                    for q in range(size):
                        v = 0.0
                        for m in range(size):
                            v += FP[p, m] * F[q, m]
                        P[c, p, q] = v
                for p in range(2):  # what it gains keeps it as large as it is: P = F P F' + Q
                    for q in range(2):
                        kept_ = passing[i, 2 * p] * passing[i, 2 * q] * colour[0]
                        kept_ += passing[i, 2 * p + 1] * passing[i, 2 * q + 1] * colour[1]
                        P[c, states + p, states + q] += (colour[p] if p == q else 0.0) - kept_
            nu = y[i] - x[c, 0] - x[c, states]
            s = P[c, 0, 0] + 2.0 * P[c, 0, states] + P[c, states, states] + white[i]
            ratio = nu * nu / s
            if ratio > OUTLIER * OUTLIER and i > 8:
                cost[c] += OUTLIER * OUTLIER + math.log(s / white[i])
            else:
                cost[c] += ratio + math.log(s / white[i])
                for p in range(size):
                    Fx[p] = (P[c, p, 0] + P[c, p, states]) / s
                for p in range(size):
                    x[c, p] += Fx[p] * nu
                    for q in range(size):
                        P[c, p, q] -= Fx[p] * Fx[q] * s
            if cost[c] < best:
                best = cost[c]
        # prune
        kept = 0
        limit = best + margin
        if count > beam:
            order_ = np.sort(cost[:count])
            if order_[beam - 1] < limit:
                limit = order_[beam - 1]
        for c in range(count):
            if cost[c] <= limit:
                if kept != c:
                    x[kept] = x[c]
                    P[kept] = P[c]
                    cost[kept] = cost[c]
                    live[kept] = live[c]
                    leaf[kept] = leaf[c]
                kept += 1
        count = kept
        if not sites[i] or i == 0 or i == n - 1:
            continue
        # children: of each rule the cheapest parent
        born = 0
        for r in range(len(rules)):
            parent = -1
            low = best + margin
            for c in range(count):
                if live[c] == rules[r, 0] and cost[c] + price[r] < low and tree[leaf[c], 1] < i - 1:
                    low = cost[c] + price[r]
                    parent = c
            if parent < 0:
                continue
            x2[born] = x[parent]
            P2[born] = P[parent]
            extra = _reset(x2[born], P2[born], rules[r, 0], rules[r, 1], rules[r, 2], prior, states)
            total = low + extra
            if total > best + margin or born >= 63:
                continue
            if nodes == len(tree):
                bigger = np.empty((2 * nodes, 4), np.int64)
                bigger[:nodes] = tree
                tree = bigger
            tree[nodes, 0] = leaf[parent]
            tree[nodes, 1] = i
            tree[nodes, 2] = rules[r, 1]
            tree[nodes, 3] = rules[r, 2]
            slot = count + born
            x[slot] = x2[born]
            P[slot] = P2[born]
            cost[slot] = total
            live[slot] = rules[r, 1]
            leaf[slot] = nodes
            nodes += 1
            born += 1
        count += born
    c = int(np.argmin(cost[:count]))
    length = 0
    node = leaf[c]
    while node >= 0:
        length += 1
        node = tree[node, 0]
    out = np.empty((length, 3), np.int64)
    node = leaf[c]
    for k in range(length - 1, -1, -1):
        out[k, 0] = tree[node, 1]
        out[k, 1] = tree[node, 2]
        out[k, 2] = tree[node, 3]
        node = tree[node, 0]
    return out, cost[c]


@njit(cache=True)
def _shape(kind, t):  # kind of railnav.track.elements, share of the length -> f, integral of f, t f
    """Law of a transition and its integral, eq (2)."""
    if kind == 2:
        return t, 0.5 * t * t
    if kind == 3:
        return t * t * (3.0 - 2.0 * t), t**3 - 0.5 * t**4
    if kind == 4:
        return 0.5 * (1.0 - math.cos(math.pi * t)), 0.5 * t - math.sin(math.pi * t) / (2.0 * math.pi)
    if kind == 5:
        w = 2.0 * math.pi * t
        return t - math.sin(w) / (2.0 * math.pi), 0.5 * t * t + (math.cos(w) - 1.0) / (4.0 * math.pi**2)
    if kind == 6:
        if t < 0.5:
            return 2.0 * t * t, 2.0 * t**3 / 3.0
        return -1.0 + 4.0 * t - 2.0 * t * t, 1.0 / 6.0 - t + 2.0 * t * t - 2.0 * t**3 / 3.0
    if kind == 7:
        return (
            t**4 * (35.0 - 84.0 * t + 70.0 * t * t - 20.0 * t**3),
            t**5 * (7.0 - 14.0 * t + 10.0 * t * t - 2.5 * t**3),
        )
    return 0.0, 0.0


@njit(cache=True)
def _run(p, v):  # slope at the end of a cubic parabola, share of its abscissa -> length over abscissa of the end
    """Length of y = x^3 / (6 c) up to v x_e: integral of sqrt(1 + p^2 w^4), by its series."""
    q = (p * v * v) ** 2
    return v * (1.0 + q / 10.0 - q * q / 72.0 + q**3 / 208.0 - 5.0 * q**4 / 2176.0 + 7.0 * q**5 / 5376.0)


@njit(cache=True)
def _cubic_slope(turn):  # |k| L -> slope p at the end
    """Solve k L = 2 p (1 + p^2)^(-3/2) G(p) for p by fixed-point steps."""
    p = 0.5 * turn
    for _ in range(40):
        p = 0.5 * turn * (1.0 + p * p) ** 1.5 / _run(p, 1.0)
        if p > 0.7:
            p = 0.7
    return p


@njit(cache=True)
def _bearing(kind, s, length, k0, k1, sway, p, out):  # -> turn, curvature, d turn / d (k0, k1, length) in out (5,)
    """Turn and curvature s metres into an element, and how the turn depends on its parameters, eqs (1), (2), (9)."""
    t = s / length
    if kind < 2:
        out[0] = k0 * s
        out[1] = k0
        out[2] = s
        out[3] = 0.0
        out[4] = 0.0
        return
    shape = kind if kind < 8 else 2
    f, whole = _shape(shape, t)
    out[0] = k0 * s + (k1 - k0) * length * whole
    out[1] = k0 + (k1 - k0) * f
    out[2] = s - length * whole
    out[3] = length * whole
    out[4] = (k1 - k0) * (whole - t * f)
    if kind == 7:
        rest = t * (1.0 - t)
        out[0] -= sway * length * 140.0 * rest**3
        out[1] -= sway * 420.0 * rest * rest * (1.0 - 2.0 * t)
    elif kind == 8:
        forward = k0 == 0.0
        k = k1 if forward else k0
        u = t if forward else 1.0 - t
        whole_run = _run(p, 1.0)
        v = u
        for _ in range(5):
            v -= (_run(p, v) - u * whole_run) / math.sqrt(1.0 + (p * v * v) ** 2)
        slope = p * v * v
        side = 1.0 if k > 0.0 else -1.0
        out[0] = side * (math.atan(slope) if forward else math.atan(p) - math.atan(slope))
        out[1] = side * 2.0 * p * v / (length / whole_run) * (1.0 + slope * slope) ** -1.5


@njit(cache=True)
def lay(kind, length, k0, k1, sway, east, north, bearing, owner, s, here, slopes, ends, end_slopes):
    """Points of elements and their derivatives by Gauss-Legendre, eqs (1), (9).

    Elements (m,), each from its own start; points sorted by (owner, s), (n,). Fills `here` (n, 4): easting, northing, bearing,
    curvature; `slopes` (n, 8): d(easting, northing) by k0, k1, length, and easting and northing from the element's start; and the
    same at the ends of elements with d(bearing) by k0, k1 and length in three more columns, (m, 4) and (m, 11).
    """
    n, m = len(s), len(length)
    out = np.empty(5)
    i = 0
    for j in range(m):
        p = 0.0
        if kind[j] == 8:
            p = _cubic_slope(max(abs(k0[j]), abs(k1[j])) * length[j])
        at = 0.0
        sums = np.zeros(8)
        done = False
        longest = 2.0
        sharp = max(abs(k0[j]), abs(k1[j]))
        if sharp > 0.0 and 0.2 / sharp < longest:
            longest = 0.2 / sharp
        while not done:
            if i < n and owner[i] == j:
                target = s[i]
            else:
                target = length[j]
                done = True
            width = target - at
            pieces = int(math.ceil(abs(width) / longest - 1e-9))
            if pieces < 1 or pieces > 1_000_000:
                pieces = 1
            h = width / pieces
            for q in range(pieces):
                for g in range(4):
                    _bearing(kind[j], at + h * (q + _X[g]), length[j], k0[j], k1[j], sway[j], p, out)
                    b = bearing[j] + out[0]
                    sb, cb = math.sin(b), math.cos(b)
                    w = h * _W[g]
                    sums[6] += w * sb
                    sums[7] += w * cb
                    for c in range(3):
                        sums[2 * c] += w * cb * out[2 + c]
                        sums[2 * c + 1] -= w * sb * out[2 + c]
            at = target
            _bearing(kind[j], at, length[j], k0[j], k1[j], sway[j], p, out)
            if done:
                ends[j, 0] = east[j] + sums[6]
                ends[j, 1] = north[j] + sums[7]
                ends[j, 2] = bearing[j] + out[0]
                ends[j, 3] = out[1]
                for c in range(8):
                    end_slopes[j, c] = sums[c]
                for c in range(3):
                    end_slopes[j, 8 + c] = out[2 + c]
            else:
                here[i, 0] = east[j] + sums[6]
                here[i, 1] = north[j] + sums[7]
                here[i, 2] = bearing[j] + out[0]
                here[i, 3] = out[1]
                for c in range(8):
                    slopes[i, c] = sums[c]
                i += 1


@njit(cache=True)
def advance(
    owner, s, length, step
):  # (n,) element and place in it, (m,) lengths, (n,) steps: owner and s changed in place
    """Move feet along the elements; the first and last element go on straight past their ends."""
    last = len(length) - 1
    for i in range(len(s)):
        s[i] += step[i]
        while s[i] < 0.0 and owner[i] > 0:
            owner[i] -= 1
            s[i] += length[owner[i]]
        while s[i] > length[owner[i]] and owner[i] < last:
            s[i] -= length[owner[i]]
            owner[i] += 1


@njit(cache=True)
def products(design):  # (n, p) -> (p, p)
    """Sums of products of the columns of a design whose rows are mostly zero; small, so that threads do not pay."""
    n, p = design.shape
    out = np.zeros((p, p))
    here = np.empty(p, np.int64)
    for i in range(n):
        count = 0
        for a in range(p):
            if design[i, a] != 0.0:
                here[count] = a
                count += 1
        for a in range(count):
            for b in range(a + 1):
                out[here[a], here[b]] += design[i, here[a]] * design[i, here[b]]
    for a in range(p):
        for b in range(a):
            out[b, a] = out[a, b]
    return out


@njit(cache=True)
def decompose(A):  # (n, n), changed in place -> pivots (n,), and whether it is regular
    """LU decomposition with row pivots."""
    n = len(A)
    pivot = np.empty(n, np.int64)
    for k in range(n):
        best, at = -1.0, k
        for i in range(k, n):
            if abs(A[i, k]) > best:
                best, at = abs(A[i, k]), i
        pivot[k] = at
        if not best > 1e-300:
            return pivot, False
        if at != k:
            for j in range(n):
                A[k, j], A[at, j] = A[at, j], A[k, j]
        for i in range(k + 1, n):
            if A[i, k] != 0.0:
                A[i, k] /= A[k, k]
                factor = A[i, k]
                for j in range(k + 1, n):
                    A[i, j] -= factor * A[k, j]
    return pivot, True


@njit(cache=True)
def back(LU, pivot, right):  # (n, n), (n,), (n, q) -> (n, q)
    """Solve the decomposed equations."""
    x = right.copy()
    n, q = x.shape
    for c in range(q):
        for k in range(n):
            at = pivot[k]
            if at != k:
                x[k, c], x[at, c] = x[at, c], x[k, c]
        for i in range(n):
            v = x[i, c]
            for j in range(i):
                v -= LU[i, j] * x[j, c]
            x[i, c] = v
        for i in range(n - 1, -1, -1):
            v = x[i, c]
            for j in range(i + 1, n):
                v -= LU[i, j] * x[j, c]
            x[i, c] = v / LU[i, i]
    return x
