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
def _reset(x, P, old, new, order, prior, states):  # x (states + 1,), P alike; numbers of live states -> cost, changed in place
    """Pass from one kind of element to another: what is continuous stays, what jumps is drawn anew, eq (6)."""
    cost = 0.0
    size = states + 1
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
    step, y, shift, turn, bow, white, decay, colour, sites, first, rules, price, prior, beam, margin
):  # (n,) each; first (states, 2); rules (r, 3) -> (m, 3) int: sample, live states, order of the break
    """Cheapest sequence of elements through n measured values by a bank of Kalman filters, eqs (3) to (7).

    States are the value and its derivatives along the track, the last state coloured noise. `step` (n,) from the sample before,
    m; `y` (n,) measured; `shift`, `turn`, `bow` (n,): what the reference curve itself gains over the step in value and slope, and
    its curvature; `white` (n,) variances; `decay` (n,), `colour`: coloured noise; `rules`: from live states, to live states,
    lowest order that breaks; `price` (r,): of each.
    """
    n = len(y)
    states = len(prior)
    size = states + 1
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
        P[count, states, states] = colour
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
                F[states, states] = decay[i]
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
                P[c, states, states] += colour * (1.0 - decay[i] * decay[i])
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
