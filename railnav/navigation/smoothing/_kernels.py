"""Inner loops of the fixed-interval smoother: lineages of records, from the last epoch back. No validation."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from railnav.estimation import _kernels as estimation
from railnav.estimation._kernels import smooth_kernel
from railnav.matching import _kernels as paths
from railnav.matching._kernels import source_stamp
from railnav.navigation import columns, state
from railnav.navigation.columns import (
    FORCE,
    NOISES,
    POSITION,
    R_EPOCH,
    R_PARENT,
    R_PULL,
    R_SHAKE,
    R_SIGN,
    R_SLIP,
    R_SLOW,
    R_STEP,
    R_STRETCH,
    R_TAG,
    R_TRAVEL,
    R_VERSION,
    SIGMA_FORCE,
    SPEED,
    TIME,
)
from railnav.navigation.dynamics import _kernels as dynamics
from railnav.navigation.dynamics._kernels import transition, variance_of


@njit(cache=True)
def new_lineage(
    records, last, seen, chain
):  # record index, (records,) in and out, (m,) out -> first epoch of it, or -1
    """Walk from a record to the first ancestor that is seen already, and see them."""
    r = last
    e = -1
    while r >= 0 and seen[r] == 0:
        seen[r] = 1
        e = int(records.numbers[r, R_EPOCH])
        chain[e] = r
        r = int(records.numbers[r, R_PARENT])
    return e


@njit(cache=True)
def weigh(records, begin, end, joins_end, weight):  # record indices; (records,) in: the last epoch's, out: all
    """Posterior of every record from `begin` to `end`, given the whole run: each hands its own on to the pasts that it was merged of.

    `joins_end` is the number of joins before `end`; gives that before `begin`.
    """
    j = joins_end - 1
    for r in range(end - 1, begin - 1, -1):
        rest = weight[r]
        while j >= 0 and records.joins[j, 0] > r:
            j -= 1
        k = j
        while k >= 0 and records.joins[k, 0] == r:
            part = min(records.joins[k, 2] * weight[r], rest)
            weight[int(records.joins[k, 1])] += part
            rest -= part
            k -= 1
        parent = int(records.numbers[r, R_PARENT])
        if parent >= 0:
            weight[parent] += rest


@njit(cache=True)
def window_index(records, version, s):  # path coordinate -> index in a stored window
    """Which track of a stored window holds a path coordinate."""
    i = 0
    while i < records.tracks[version] - 1 and s >= records.begin[version, i + 1]:
        i += 1
    return i


def _compiled(stamp: int) -> Any:
    """The smoother, bound to the sources that it is made of (see `railnav.navigation._kernels`)."""

    @njit(cache=True)
    def smooth_lineage(fil, records, epochs, chain, first, last, x, sigma):
        """Carry the smoothed state back along a lineage (Rauch-Tung-Striebel in square roots, noise as the filter applied it)."""
        # chain (m,) record by epoch; x (m, n) and sigma (m, 2: position, speed) out
        if stamp < 0:  # never: it makes the checksum part of the cache's key
            return
        n = x.shape[1]
        i_s, i_v = fil.at[POSITION], fil.at[SPEED]
        F = np.zeros((n, n))
        Q = np.empty((NOISES, n))
        lead = np.empty(NOISES, np.int64)
        new = np.empty(n)
        gain = np.empty((n, n))
        state = records.x[chain[last]].copy()
        P_sqrt = records.P_sqrt[chain[last]].copy()
        next_state = np.empty(n)
        next_P = np.empty((n, n))
        for e in range(last, first - 1, -1):
            if e < last:
                r = chain[e]
                numbers = records.numbers[chain[e + 1]]
                for i in range(n):
                    next_state[i] = state[i]
                    state[i] = records.x[r, i]
                    for j in range(n):
                        next_P[i, j] = P_sqrt[i, j]
                        P_sqrt[i, j] = records.P_sqrt[r, i, j]
                dt = epochs[e + 1, TIME] - epochs[e, TIME]
                columns = transition(
                    fil,
                    state,
                    dt,
                    numbers[R_SIGN],
                    epochs[e + 1, FORCE],
                    epochs[e + 1, SIGMA_FORCE],
                    numbers[R_PULL],
                    numbers[R_SLIP],
                    numbers[R_SHAKE],
                    numbers[R_STEP],
                    numbers[R_TAG],
                    numbers[R_TRAVEL],
                    numbers[R_STRETCH],
                    numbers[R_SLOW],
                    F,
                    Q,
                    lead,
                    new,
                )
                smooth_kernel(state, P_sqrt, F, np.ascontiguousarray(Q[:columns].T), new, next_state, next_P, gain)
            for i in range(n):
                x[e, i] = state[i]
            sigma[e, 0] = np.sqrt(variance_of(P_sqrt, i_s))
            sigma[e, 1] = np.sqrt(variance_of(P_sqrt, i_v))

    return smooth_lineage


smooth_lineage = _compiled(source_stamp(paths, columns, state, dynamics, estimation))


@njit(cache=True)
def standing_of(fil, records, begin, end, track):  # (records,) out
    """Track that each of the records from `begin` to `end` stands on."""
    i_s = fil.at[POSITION]
    for r in range(begin, end):
        version = int(records.numbers[r, R_VERSION])
        track[r] = records.track[version, window_index(records, version, records.x[r, i_s])]


@njit(cache=True)
def place(fil, net_length, records, chain, first, last, x, track, way, offset):
    """Track, direction and offset of smoothed path coordinates, each in the window of its own epoch."""
    i_s = fil.at[POSITION]
    for e in range(first, last + 1):
        version = int(records.numbers[chain[e], R_VERSION])
        s = x[e, i_s]
        i = window_index(records, version, s)
        t = records.track[version, i]
        w = records.way[version, i]
        length = net_length[t]
        local = min(max(s - records.begin[version, i], 0.0), length)
        track[e] = t
        way[e] = w
        offset[e] = local if w > 0 else length - local
