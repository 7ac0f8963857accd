"""One coordinate of one track and the new runs that show it: the stored rows beside theirs.

Everything holds across a track and in height alike.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from railnav.estimation.merging import ChainRecords
from railnav.survey import surveyed
from railnav.survey.angles import slopes_of
from railnav.survey.axis import Chain, ErrorModel, Estimate, Links, Slopes, smooth_links
from railnav.survey.changes import Change
from railnav.survey.offsets import HOLD, Knowledge, differences, robust_fit
from railnav.survey.surveyed import GROSS_RATIO, Surveyed, white_variances
from railnav.track.records import AxisRecords

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Curvature noise of a track that was moved, in terms of what it was before.
MOVED_NOISE = 3.0


@dataclass(slots=True, eq=False)
class Side:
    """One coordinate of one stored track and the new runs that show it.

    Attributes
    ----------
    track : Surveyed
        The new runs on the stored nodes; in height its `right` is height less the stored one.
    stored : AxisRecords or None
        None of a track that is new.
    first : int
        Node at which the first stored one lies.
    up : bool
    errors : list of ErrorModel
    axis : (N,) array
        Where the axis is taken to be, less the stored (or first guessed) one, m.
    noise : (N - 1,) array
        Random walk of the second derivative, 1/m per sqrt(m).
    design : (N, B) array
    base : (N,) array
        Stored heights, m; zero across.
    changes : list of Change
    beside : (N,) bool array or None
        Nodes where runs are known to be on other tracks.
    alone : (N,) array or None
        Variance of the axis as the new runs by themselves know it, m^2; infinite where they do not reach or are set aside.
    excluded : (N,) bool array or None
        Nodes where the new runs are not used.
    estimate : Estimate or None
    """

    track: Surveyed
    stored: AxisRecords | None
    up: bool
    axis: FloatArray
    design: FloatArray
    base: FloatArray
    noise: FloatArray
    first: int = 0
    changes: list[Change] = field(default_factory=list)
    beside: BoolArray | None = None
    alone: FloatArray | None = None
    excluded: BoolArray | None = None
    estimate: Estimate | None = None

    @property
    def old(self) -> BoolArray:
        """Nodes (N,) that are stored."""
        out = np.zeros(len(self.axis), np.bool_)
        if self.stored is not None:
            out[self.first : self.first + len(self.stored.rows)] = True
        return out

    @property
    def errors(self) -> list[ErrorModel]:
        """How each run errs."""
        return self.track.errors

    def levelled(self, offset: FloatArray) -> FloatArray:
        """Values (K, N) with the frame offsets (R, B) removed, m."""
        return np.asarray(self.track.profile.right - offset[list(self.track.runs)] @ self.design.T)

    def chain(self, offset: FloatArray, slack: float) -> Chain:
        """The new runs as a chain, gross errors set aside, doubtful values weakened by where they stand to `axis`."""
        t = self.track
        if not self.up:
            t.axis = self.axis
            surveyed.reject(t, offset, slack)
        residual = self.levelled(offset) - self.axis
        variance = white_variances(t.profile, residual, self.errors, slack)
        if self.up:
            total = np.array([e.total for e in self.errors])[:, None]
            variance[np.abs(residual) > GROSS_RATIO * total + slack] = np.nan
        if self.excluded is not None:
            variance[:, self.excluded] = np.nan
        return Chain(
            step=t.nominal.step,
            value=t.profile.right,
            lead=t.profile.lead,
            variance=variance,
            time=t.profile.time,
            design=np.broadcast_to(self.design, (*residual.shape, self.design.shape[1])),
            errors=self.errors,
            bend=np.zeros(len(t.nominal)) if self.up else t.nominal.curvature,
            noise=self.noise,
            slopes=self.slopes(),
        )

    def slopes(self) -> Slopes | None:
        """What the gyroscopic angles of the new runs say about the stored axis; not where the runs are set aside."""
        # in height gradients count from the stored profile, as values do
        found = slopes_of(self.track, self.axis + self.base if self.up else self.axis, up=self.up)
        if found is None:
            return None
        value = found.value - np.gradient(self.base, self.track.nominal.step) if self.up else found.value
        if self.excluded is not None:
            value = np.where(self.excluded, np.nan, value)
        return replace(found, value=value) if np.isfinite(value).any() else None

    def first_offsets(self) -> Knowledge:
        """First knowledge of the frame offsets: robust, from the distances to the stored axis; of a new track, from each other."""
        K, B = len(self.track.runs), self.design.shape[1]
        if self.stored is None:
            return differences(self.track.profile.right, self.design, self.track.runs)
        rows, values = [], []
        for k in range(K):
            d = self.track.profile.right[k]
            use = np.isfinite(d) & self.old
            if np.count_nonzero(use) < 10:
                continue
            x, spread = robust_fit(self.design[use], d[use], np.full(B, HOLD))
            A = self.design[use]
            information = A.T @ A / (50.0 * spread**2)  # some 50 nodes err together
            root = np.linalg.cholesky(information + 1e-9 * np.eye(B)).T
            block = np.zeros((B, (K + 1) * B))
            block[:, k * B : (k + 1) * B] = root
            block[:, K * B :] = -root
            rows.append(block)
            values.append(root @ x)
        if not rows:
            return Knowledge(self.track.runs, np.zeros((1, (K + 1) * B)), np.zeros(1))
        return Knowledge(self.track.runs, np.concatenate(rows), np.concatenate(values))


def stored_links(
    stored: AxisRecords, records: ChainRecords, moved: BoolArray, chain: Chain, *, first: int = 0
) -> Links:
    """Stored rows as links of a chain, and the curvature's random walk beside them where they have been forgotten or end.

    Parameters
    ----------
    stored : AxisRecords
        Of n nodes.
    records : ChainRecords
        The same rows, aged and forgotten where the track has moved.
    moved : (N,) bool array
        Where it has.
    chain : Chain
        Of N nodes, the new runs.
    first : int
        Node of the chain at which the first stored one lies: beyond the stored ones the track is new.
    """
    N, last = len(chain.bend), first + len(records) - 1
    R, S, d = records.records[:, :, :3], records.records[:, :, 3:6], records.records[:, :, 6]
    B = stored.lean.shape[2]
    forgotten = moved[:-1] | moved[1:]
    fresh = np.ones(N - 1, np.bool_)
    fresh[first:last] = False
    free = forgotten | fresh
    q = 6 if free.any() else 3
    M, L, U = np.zeros((N - 1, q, 3)), np.zeros((N - 1, q, 3)), np.zeros((N - 1, q, 1 + B))
    old = slice(first, last)
    M[old, :3], L[old, :3], U[old, :3, 0] = R, S, d
    U[old, :3, 1:] = -(R @ stored.lean[:-1] + S @ stored.lean[1:])
    if q == 6:
        smooth = smooth_links(chain.step, np.where(forgotten & ~fresh, MOVED_NOISE, 1.0) * chain.noise, chain.bend)
        M[free, 3:], L[free, 3:] = smooth.M[free], smooth.L[free]
        U[free, 3:, 0] = smooth.U[free, :, 0]
    T = records.triangle
    end, end_value = T[:, :3], np.concatenate([T[:, 3:], -(T[:, :3] @ stored.lean[-1])], axis=1)
    if last < N - 1:  # what is known of the last stored node stands beside its link
        M[last, :3], U[last, :3] = end, end_value
        end, end_value = np.zeros((0, 3)), np.zeros((0, 1 + B))
    return Links(M, L, U, np.ascontiguousarray(end), np.ascontiguousarray(end_value))


def merged(side: Side, records: ChainRecords | None, moved: BoolArray, offset: FloatArray, slack: float) -> Chain:
    """The chain of the new runs with the stored rows in it."""
    chain = side.chain(offset, slack)
    if side.stored is None or records is None:
        return chain
    return replace(chain, links=stored_links(side.stored, records, moved, chain, first=side.first))


def know_with(side: Side, border: FloatArray, value: FloatArray) -> Knowledge:
    """What a merged chain says of the frame offsets of its runs and its track; of a shift common to all it says nothing (see `know`)."""
    B = side.design.shape[1]
    common = border @ np.tile(np.eye(B), (border.shape[1] // B, 1))
    Q, _ = np.linalg.qr(common)
    return Knowledge(side.track.runs, border - Q @ (Q.T @ border), value - Q @ (Q.T @ value))
