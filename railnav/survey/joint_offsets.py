"""Frame offsets of stored tracks, receivers and new runs, settled together with what a model knows of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.survey.offsets import RECEIVER_PRIOR, SCATTER_DOF, Knowledge
from railnav.track.records import Borders

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """Frame offsets of tracks, receivers and new runs together, B components each, relative to the stored datum.

    Attributes
    ----------
    run, receiver, track : (R, B), (C, B), (T, B) array
        m.
    covariance : (p, p) array
        Of all of them: tracks, receivers, runs, m^2.
    scatter : (C,) array
        How far runs of one receiver scatter, m.
    """

    run: FloatArray
    receiver: FloatArray
    track: FloatArray
    covariance: FloatArray
    scatter: FloatArray

    def part(self, tracks: Sequence[int], runs: Sequence[int]) -> IntArray:
        """Places of the offsets of some new runs and then some tracks."""
        B, T, C = self.run.shape[1], len(self.track), len(self.receiver)
        blocks = [T + C + r for r in runs] + list(tracks)
        return np.asarray((np.array(blocks, np.int64)[:, None] * B + np.arange(B)).ravel())


def settle_with(
    borders: Borders,
    receivers: Sequence[str],
    knowledge: Sequence[tuple[int | None, Knowledge]],
    kind: IntArray,
    scatter: FloatArray,
    known: FloatArray,
    B: int,
) -> Joint:
    """Solve for all frame offsets at once with what the model knows of them; scatter of receivers by EM.

    Parameters
    ----------
    borders : Borders
        What the model knows.
    receivers : sequence of str
        Kinds: those of the model first, in its order, then new ones.
    knowledge : sequence of (int or None, Knowledge)
        Track and what its chain says of the offsets of its runs, then of its own; None of a new one, which has none.
    kind : (R,) int array
        Receiver of each new run.
    scatter, known : (C,) array
        Scatter of the runs of each receiver, m, and from how many runs it is known.
    """
    T, C, R = len(borders.tracks), len(receivers), len(kind)
    p = (T + C + R) * B
    old = len(borders.value)
    rows = [np.zeros((old, p))]
    rows[0][:, :old] = borders.rows
    values = [borders.value]
    for c in range(len(borders.receivers), C):
        free = np.zeros((B, p))
        free[:, (T + c) * B : (T + c + 1) * B] = np.eye(B) / RECEIVER_PRIOR
        rows.append(free)
        values.append(np.zeros(B))
    for t, k in knowledge:
        blocks = [T + C + r for r in k.runs] + ([] if t is None else [t])
        who = (np.array(blocks)[:, None] * B + np.arange(B)).ravel()
        block = np.zeros((len(k.value), p))
        block[:, who] = k.rows
        rows.append(block)
        values.append(k.value)
    data, rhs = np.concatenate(rows), np.concatenate(values)
    scatter = np.array(scatter, float)
    first = scatter.copy()
    x, P = np.zeros(p), np.zeros((p, p))
    for _ in range(8):
        own = np.zeros((R * B, p))
        at = np.arange(R * B)
        own[at, (T + C) * B + at] = 1.0 / np.repeat(scatter[kind], B)
        own[at, (T + np.repeat(kind, B)) * B + at % B] = -own[at, (T + C) * B + at]
        full = np.concatenate([data, own])
        right = np.concatenate([rhs, np.zeros(len(own))])
        root = np.linalg.qr(full, mode="r")
        inverse = np.linalg.inv(root)
        P = inverse @ inverse.T
        x = P @ (full.T @ right)
        x += P @ (full.T @ (right - full @ x))
        theta, mean = x[(T + C) * B :].reshape(R, B), x[T * B : (T + C) * B].reshape(C, B)
        for c in range(C):
            members = np.flatnonzero(kind == c)
            if not len(members):
                continue
            dof = SCATTER_DOF + known[c]
            power = dof * first[c] ** 2
            for r in members:
                i, j = (T + C + r) * B + np.arange(B), (T + c) * B + np.arange(B)
                power += float(((theta[r] - mean[c]) ** 2 + P[i, i] + P[j, j] - 2 * P[i, j]).mean())
            scatter[c] = np.sqrt(power / (dof + len(members)))
    return Joint(
        run=x[(T + C) * B :].reshape(R, B),
        receiver=x[T * B : (T + C) * B].reshape(C, B),
        track=x[: T * B].reshape(T, B),
        covariance=P,
        scatter=scatter,
    )
