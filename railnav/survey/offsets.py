"""Frame offsets: how far each run's positions stand from the others, and the datum that this leaves open.

On a line with bends, distances across the track show both components of the offset between two runs. What all runs have in common
no run can show; the datum is a choice, and it is made in one place: the weighted offsets of the kinds of receiver add up to
nothing (weights in `_datum_weights`: two kinds that differ count the same, of three or more the majority counts), and each run's
own offset lies about its receiver's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: A kind of receiver farther than this from the datum has no more influence on it than one at this distance, m.
MAJORITY = 1.0
#: Prior of a receiver's own offset, m: none to speak of.
RECEIVER_PRIOR = 1e3
#: Draws an offset that a straight line does not show to nothing.
HOLD = 1e-3
#: Weight of the datum's condition, 1/m.
GAUGE = 1e4
#: Degrees of freedom of the prior on how far runs of one receiver scatter.
SCATTER_DOF = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Knowledge:
    """What a chain says of the offsets of its runs: whitened rows (r, runs * B) and values (r,)."""

    runs: tuple[int, ...]
    rows: FloatArray
    value: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Offsets:
    """Frame offsets of R runs and C kinds of receiver, B components each, relative to the datum.

    Attributes
    ----------
    run, receiver : (R, B), (C, B) array
        How far the positions stand from the datum, m.
    covariance : (R * B, R * B) array
        Of the runs' offsets, m^2; the datum itself taken as exact.
    receiver_covariance : (C * B, C * B) array
        m^2.
    scatter : (C,) array
        How far runs of one receiver scatter, m.
    weight : (C,) array
        Weight of each receiver in the datum, sum 1.
    joint : ((R + C) * B, (R + C) * B) array
        Covariance of all offsets, the runs' before the receivers', m^2.
    """

    run: FloatArray
    receiver: FloatArray
    covariance: FloatArray
    receiver_covariance: FloatArray
    scatter: FloatArray
    weight: FloatArray
    joint: FloatArray

    def common(self, runs: Sequence[int]) -> FloatArray:
        """Covariance of the mean offset of some runs, (B, B), m^2."""
        B = self.run.shape[1]
        mean = np.zeros((B, len(self.covariance)))
        for r in runs:
            mean[:, r * B : (r + 1) * B] = np.eye(B) / len(runs)
        return np.asarray(mean @ self.covariance @ mean.T)

    def sigma(self, run: int) -> FloatArray:
        """Standard deviations of one run's offset, (B,), m."""
        B = self.run.shape[1]
        return np.sqrt(np.diag(self.covariance)[run * B : (run + 1) * B])

    def datum_sigma(self) -> FloatArray | None:
        """Uncertainty of the datum as the disagreement of the receivers shows it, (B,), m; None with one kind of receiver."""
        C = len(self.receiver)
        if C < 2:
            return None
        middle = self.weight @ self.receiver
        spread = np.sqrt(((self.receiver - middle) ** 2).sum(axis=0) / (C - 1))
        return np.asarray(spread * np.sqrt((self.weight**2).sum()))


def settle(knowledge: Sequence[Knowledge], kind: IntArray, scale: FloatArray, components: int) -> Offsets:
    """Solve for all frame offsets at once, with the scatter between runs of one receiver estimated (EM).

    Parameters
    ----------
    knowledge : sequence of Knowledge
        One a chain.
    kind : (R,) int array
        Receiver of each run, 0..C-1.
    scale : (C,) array
        Expected scatter between runs of one receiver, m (a weak prior).
    components : int
        B: 2 in the plane, 1 in height.
    """
    R, C, B = len(kind), int(kind.max()) + 1, components
    heard = np.zeros(C, np.bool_)  # only receivers that the chains speak of take part in the datum
    for k in knowledge:
        heard[kind[list(k.runs)]] = True
    weight = heard / heard.sum()
    scatter = np.array(scale, float)
    p = (R + C) * B
    blocks, values = [], []
    for k in knowledge:
        block = np.zeros((len(k.value), p))
        columns = (np.array(k.runs)[:, None] * B + np.arange(B)).ravel()
        block[:, columns] = k.rows
        blocks.append(block)
        values.append(k.value)
    data = np.asarray(np.linalg.qr(np.column_stack([np.concatenate(blocks), np.concatenate(values)]), mode="r"))
    x, P = np.zeros(p), np.zeros((p, p))
    for _ in range(12):
        own = np.zeros((R * B, p))  # each run about its receiver
        r_b = np.arange(R * B)
        own[r_b, r_b] = 1.0 / np.repeat(scatter[kind], B)
        own[r_b, (R + np.repeat(kind, B)) * B + r_b % B] = -own[r_b, r_b]
        gauge = np.zeros((B, p))  # the datum
        for b in range(B):
            gauge[b, R * B + b :: B] = GAUGE * weight
        prior = np.zeros((C * B, p))
        prior[:, R * B :] = np.eye(C * B) / RECEIVER_PRIOR
        full = np.concatenate([data[:, :p], own, gauge, prior])
        rhs = np.concatenate([data[:, p], np.zeros(len(full) - len(data))])
        T = np.linalg.qr(full, mode="r")
        inverse = np.linalg.inv(T)
        P = inverse @ inverse.T
        x = P @ (full.T @ rhs)
        x += P @ (full.T @ (rhs - full @ x))  # one step of refinement
        theta, receiver = x[: R * B].reshape(R, B), x[R * B :].reshape(C, B)
        for c in range(C):
            members = np.flatnonzero(kind == c)
            power = SCATTER_DOF * float(scale[c]) ** 2
            for r in members:
                i, j = r * B + np.arange(B), (R + c) * B + np.arange(B)
                square = (theta[r] - receiver[c]) ** 2 + P[i, i] + P[j, j] - 2 * P[i, j]
                power += float(square.mean())
            scatter[c] = np.sqrt(power / (SCATTER_DOF + len(members)))
        weight = _datum_weights(
            receiver, scatter / np.sqrt(np.maximum(np.bincount(kind, minlength=C), 1)), weight, heard
        )
    return Offsets(
        run=x[: R * B].reshape(R, B),
        receiver=x[R * B :].reshape(C, B),
        covariance=P[: R * B, : R * B],
        receiver_covariance=P[R * B :, R * B :],
        scatter=scatter,
        weight=weight,
        joint=P,
    )


def _datum_weights(receiver: FloatArray, sigma: FloatArray, weight: FloatArray, heard: BoolArray) -> FloatArray:
    """Weights of the kinds of receiver in the datum, sum 1 (one step; `receiver` stands about the present weighted mean).

    A kind weighs by how well its own offset is known, beside how far kinds differ anyway (as in a meta-analysis with random
    effects); with three kinds or more the influence of one that stands apart is bounded (Huber).
    """
    offset, own = receiver[heard], sigma[heard]
    if len(offset) < 2:
        return weight
    apart = np.linalg.norm(offset - np.median(offset, axis=0), axis=1)
    between = np.sqrt(2.0) * float(apart.max()) if len(offset) == 2 else 1.4826 * float(np.median(apart))
    pull = 1.0 / (between**2 + own**2)
    if len(offset) >= 3:
        pull *= np.minimum(1.0, MAJORITY / np.maximum(np.linalg.norm(offset, axis=1), 1e-9))
    out = np.zeros(len(weight))
    out[heard] = pull / pull.sum()
    return out


def differences(value: FloatArray, design: FloatArray, runs: Sequence[int]) -> Knowledge:
    """First knowledge of the offsets, robust and without an axis: from the differences of every two runs of a track.

    Parameters
    ----------
    value : (K, N) array
        Distances to the right of the nominal curve, m; NaN where a run has none.
    design : (N, B) array
        Normal of the curve (east, north), or ones for heights.
    runs : sequence of int
        Who the K runs are.
    """
    K, B = value.shape[0], design.shape[1]
    rows, values = [], []
    for i in range(K):
        for j in range(i + 1, K):
            D = value[i] - value[j]
            use = np.isfinite(D)
            if np.count_nonzero(use) < 10:
                continue
            x, spread = robust_fit(design[use], D[use], np.full(B, HOLD))
            A = design[use]
            information = A.T @ A / (50.0 * spread**2)  # some 50 nodes err together
            L = np.linalg.cholesky(information + 1e-9 * np.eye(B)).T
            block = np.zeros((B, K * B))
            block[:, i * B : (i + 1) * B] = L
            block[:, j * B : (j + 1) * B] = -L
            rows.append(block)
            values.append(L @ x)
    if not rows:
        return Knowledge(tuple(runs), np.zeros((1, K * B)), np.zeros(1))
    return Knowledge(tuple(runs), np.concatenate(rows), np.concatenate(values))


def robust_fit(A: FloatArray, d: FloatArray, hold: FloatArray) -> tuple[FloatArray, float]:
    """Robust regression d = A x: trimmed least squares from two starts, the one with the smaller scatter; and that scatter, m.

    One start is nothing but the first column's median where it is constant (a stretch on another track is then what stands out),
    the other least squares. `hold` (B,) draws each coefficient to nothing, lightly: a straight line does not show them all.
    """
    B = A.shape[1]
    ridge = np.diag(hold)
    plain = np.zeros(B)
    if np.ptp(A[:, 0]) == 0.0 and hold[0] == 0.0:
        plain[0] = float(np.median(d)) / A[0, 0]
    best: FloatArray = np.asarray(plain)
    best_spread = np.inf
    for start in (plain, np.linalg.solve(A.T @ A + len(A) * ridge, A.T @ d)):
        x: FloatArray = np.asarray(start)
        kept: BoolArray | None = None
        for _ in range(8):
            e = np.abs(d - A @ x)
            take = e <= 3.0 * max(1.4826 * float(np.median(e)), 1e-3)
            if kept is not None and np.array_equal(take, kept):
                break  # settled
            kept = take
            x = np.asarray(np.linalg.solve(A[take].T @ A[take] + take.sum() * ridge, A[take].T @ d[take]))
        spread = max(1.4826 * float(np.median(np.abs(d - A @ x))), 1e-3)
        if spread < best_spread:
            best, best_spread = x, spread
    return best, best_spread
