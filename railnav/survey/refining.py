"""One coordinate of a stored track refined by new runs: the stored rows beside theirs, what has moved, and the frame offsets of all.

Everything holds across a track and in height alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.estimation.change import change_test
from railnav.estimation.gross_error import chi_square_limit
from railnav.estimation.merging import ChainRecords
from railnav.survey import _kernels, surveyed
from railnav.survey.angles import slopes_of
from railnav.survey.axis import Chain, ErrorModel, Estimate, Links, Slopes, smooth_links, solve, sweep
from railnav.survey.fixes import CONTRADICTS, USED
from railnav.survey.offsets import HOLD, RECEIVER_PRIOR, SCATTER_DOF, Knowledge, robust_fit
from railnav.survey.surveyed import GROSS_RATIO, TRACKS_APART, Surveyed, white_variances
from railnav.track.records import AxisRecords, Borders

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: A window of the change test: nodes, and how much of the track it spans, m.
WINDOW_NODES, WINDOW_LENGTH = 9, 80.0
#: So many windows say how much more than stated surveys differ.
FEWEST_WINDOWS = 40
#: What is forgotten beyond each end of a moved stretch, m.
MARGIN = 10.0
#: Longest way without new fixes that one change test spans, m.
LONGEST_GAP = 200.0
#: Runs farther apart than so many sigma over half a window contradict each other.
APART_SIGMA = 5.0
#: Probability that runs which agree are called a contradiction.
CONTRADICTION = 1e-4
#: Runs whose fixes are no better than this, m, must see a distance of so many sigma.
PRECISE, CLEAR = 0.75, 3.0
#: Curvature noise of a track that was moved, in terms of what it was before.
MOVED_NOISE = 3.0
#: Rounds of weights.
ROUNDS = 3


@dataclass(slots=True, eq=False)
class Change:
    """A stretch that the new runs see elsewhere.

    Attributes
    ----------
    first, last : int
        Nodes.
    statistic, limit, dof : float
        Of the window that shows it best.
    shift, sigma : float
        Greatest difference in it, new less old, m (to the right; up), and its standard deviation.
    verdict : str
        "moved", "contradiction" (the new runs disagree with each other there), "another track" (farther than tracks are moved), or
        "unsure" (rough receivers see another shape but no clear distance): merged, and said.
    runs : tuple of int
        Runs that see it.
    """

    first: int
    last: int
    statistic: float
    limit: float
    dof: int
    shift: float
    sigma: float
    verdict: str
    runs: tuple[int, ...]


@dataclass(slots=True, eq=False)
class Side:
    """One coordinate of one stored track and the new runs that show it.

    Attributes
    ----------
    track : Surveyed
        The new runs on the stored nodes; in height its `right` is height less the stored one.
    stored : AxisRecords
    up : bool
    errors : list of ErrorModel
    axis : (N,) array
        Where the axis is taken to be, less the stored one, m.
    design : (N, B) array
    base : (N,) array
        Stored heights, m; zero across.
    changes : list of Change
    excluded : (N,) bool array or None
        Nodes where the new runs are not used.
    estimate : Estimate or None
    """

    track: Surveyed
    stored: AxisRecords
    up: bool
    axis: FloatArray
    design: FloatArray
    base: FloatArray
    changes: list[Change] = field(default_factory=list)
    excluded: BoolArray | None = None
    estimate: Estimate | None = None

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
            noise=self.stored.noise,
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
        """First knowledge of the frame offsets: robust, from the distances to the stored axis."""
        K, B = len(self.track.runs), self.design.shape[1]
        rows, values = [], []
        for k in range(K):
            d = self.track.profile.right[k]
            use = np.isfinite(d)
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


def stored_links(stored: AxisRecords, records: ChainRecords, moved: BoolArray, chain: Chain) -> Links:
    """Stored rows as links of a chain, and the curvature's random walk beside them where they have been forgotten."""
    N = len(records)
    R, S, d = records.records[:, :, :3], records.records[:, :, 3:6], records.records[:, :, 6]
    B = stored.lean.shape[2]
    q = 6 if moved.any() else 3
    M, L, U = np.zeros((N - 1, q, 3)), np.zeros((N - 1, q, 3)), np.zeros((N - 1, q, 1 + B))
    M[:, :3], L[:, :3], U[:, :3, 0] = R, S, d
    U[:, :3, 1:] = -(R @ stored.lean[:-1] + S @ stored.lean[1:])
    if q == 6:
        smooth = smooth_links(chain.step, MOVED_NOISE * chain.noise, chain.bend)
        free = moved[:-1] | moved[1:]
        M[free, 3:], L[free, 3:] = smooth.M[free], smooth.L[free]
        U[free, 3:, 0] = smooth.U[free, :, 0]
    T = records.triangle
    final_value = np.concatenate([T[:, 3:], -(T[:, :3] @ stored.lean[-1])], axis=1)
    return Links(M, L, U, np.ascontiguousarray(T[:, :3]), np.ascontiguousarray(final_value))


def merged(side: Side, records: ChainRecords, moved: BoolArray, offset: FloatArray, slack: float) -> Chain:
    """The chain of the new runs with the stored rows in it."""
    chain = side.chain(offset, slack)
    return replace(chain, links=stored_links(side.stored, records, moved, chain))


# ---------------------------------------------------------------- frame offsets


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
    knowledge: Sequence[tuple[int, Knowledge]],
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
    knowledge : sequence of (int, Knowledge)
        Track and what its chain says of the offsets of its runs, then of its own.
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
        who = (np.array([*(T + C + r for r in k.runs), t])[:, None] * B + np.arange(B)).ravel()
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


# ---------------------------------------------------------------- what has moved


def covered(side: Side) -> list[tuple[int, int]]:
    """Stretches (first, last) that new runs cover without a longer gap, and long enough to be tested."""
    nodes = np.flatnonzero(np.isfinite(side.track.profile.right).any(axis=0))
    if not len(nodes):
        return []
    step = side.track.nominal.step
    edges = np.flatnonzero(np.diff(nodes) > max(1, int(LONGEST_GAP / step)))
    firsts, lasts = nodes[np.append(0, edges + 1)], nodes[np.append(edges, len(nodes) - 1)]
    return [(int(a), int(b)) for a, b in zip(firsts, lasts, strict=True) if (b - a) * step >= WINDOW_LENGTH]


def middle(side: Side, offset: FloatArray) -> FloatArray:
    """Where the new runs see the axis, (N,): middle of the largest clump at each node, outliers and noise smoothed away."""
    from scipy.ndimage import gaussian_filter1d, median_filter

    spread = max(e.total for e in side.errors)
    guess, clumps = np.empty(len(side.axis)), np.empty(len(side.axis), np.int64)
    _kernels.middle(side.levelled(offset), max(TRACKS_APART, 6.0 * spread), guess, clumps)
    at = np.flatnonzero(np.isfinite(guess))
    width = 2 * max(1, round(20.0 / side.track.nominal.step)) + 1
    smooth = median_filter(guess[at], min(width, len(at)), mode="nearest")
    line = np.interp(np.arange(len(guess)), at, smooth)
    return np.asarray(gaussian_filter1d(line, max(0.5, 10.0 / side.track.nominal.step), mode="nearest"))


def find_changes(side: Side, joint: Joint, place: int, slack: float, false_alarm: float) -> FloatArray:
    """Compare what the new runs alone see with what is stored; fills `side.changes`, gives the axis that they see (N,).

    Parameters
    ----------
    side : Side
    joint : Joint
        Frame offsets as the distances to the stored axis give them.
    place : int
        Of the track among the joint offsets.
    slack : float
        How far the first guess of an axis may be off, m.
    false_alarm : float
        Probability of any alarm along a stretch that has not moved.
    """
    runs = side.track.runs
    at = joint.part([place], runs)
    border_covariance = joint.covariance[np.ix_(at, at)]
    many = len(runs) * side.design.shape[1]
    border = joint.run[list(runs)].ravel()
    kept = side.axis
    seen = middle(side, joint.run)
    clashes = contradictions(side, joint, seen)
    side.axis = seen.copy()
    parts = covered(side)
    estimates: list[Estimate | None] = [None] * len(parts)
    for turn in range(ROUNDS):
        chain = side.chain(joint.run, slack if turn == 0 else 0.0)
        for number, (a, b) in enumerate(parts):
            piece = chain.part(a, b + 1)
            estimate = solve(piece, sweep(piece), border, border_covariance[:many, :many], sure=turn == ROUNDS - 1)
            side.axis[a : b + 1] = estimate.state[:, 0]
            estimates[number] = estimate
    seen, side.axis = side.axis, kept
    old = side.stored.chain().solve()
    side.changes = clashes
    clear = ~mask(side, "contradiction")
    for (a, b), found in zip(parts, estimates, strict=True):
        assert found is not None
        estimate = found
        assert old.covariance is not None
        # the frame offsets are known by the distances to the stored axis, and are wrong with it
        lean = np.concatenate([estimate.lean, -side.stored.lean[a : b + 1]], axis=2)
        P = estimate.inner + lean @ border_covariance @ lean.transpose(0, 2, 1)
        C = estimate.inner_lag + lean[:-1] @ border_covariance @ lean[1:].transpose(0, 2, 1)
        new = ChainRecords.of_marginals(estimate.state, P, C).solve()
        before = replace(
            old, state=old.state[a : b + 1], covariance=old.covariance[a : b + 1], records=old.records[a:b]
        )
        spacing = max(1, round(WINDOW_LENGTH / (WINDOW_NODES - 1) / side.track.nominal.step))
        window = min(WINDOW_NODES, (b - a) // spacing + 1)
        settings: dict[str, Any] = {
            "window": window,
            "spacing": spacing,
            "step": max(1, spacing // 2),
            "components": np.array([[1.0, 0.0, 0.0]]),
            "false_alarm": false_alarm / len(parts),
        }
        test = change_test(before, new, **settings)
        if test.excess > 1.0 and len(test.statistic) >= FEWEST_WINDOWS:
            test = change_test(before, new, **settings, variance_factor=test.excess)
        for first, last in test.stretches:
            hit = test.changed & (test.first <= last) & (test.last >= first)
            best = int(np.argmax(np.where(hit, test.statistic, -np.inf)))
            peak = first + int(np.argmax(np.abs(test.difference[first : last + 1, 0])))
            if not clear[a + first : a + last + 1].any():
                continue  # said already
            change = Change(
                first=a + first,
                last=a + last,
                statistic=float(test.statistic[best]),
                limit=float(test.limit),
                dof=test.dof,
                shift=float(test.difference[peak, 0]),
                sigma=float(test.sigma[peak, 0]),
                verdict="moved",
                runs=(),
            )
            side.changes.append(_judged(side, change, joint))
    return seen


def contradictions(side: Side, joint: Joint, seen: FloatArray) -> list[Change]:
    """Stretches where precise new runs lie apart from each other, and no two of them agree.

    Each run's running median about the axis that all see is held against what its errors allow; where fewer than two runs stand the
    test and two or more fail it, there is no majority to follow.
    """
    level = side.levelled(joint.run) - seen
    K, N = level.shape
    if K < 2 or max(e.total for e in side.errors) >= PRECISE:
        return []
    width = max(3, round(0.5 * WINDOW_LENGTH / side.track.nominal.step))
    fails, stands = np.zeros(N, np.int64), np.zeros(N, np.int64)
    score = np.zeros(N)
    for k, model in enumerate(side.errors):
        at = np.flatnonzero(np.isfinite(level[k]))
        if len(at) < width:
            continue
        views = np.lib.stride_tricks.sliding_window_view(level[k, at], width)
        middles = np.median(views, axis=1)
        fixes = width * float(np.median(side.track.profile.count[k, at]))
        sigma = float(np.sqrt(model.correlated**2 + 1.6 * model.white**2 / fixes))
        ratio = np.abs(middles) / sigma
        centre = at[width // 2 : width // 2 + len(middles)]
        fails[centre] += ratio > APART_SIGMA
        stands[centre] += ratio <= APART_SIGMA
        score[centre] = np.maximum(score[centre], ratio)
    clash = (fails >= 2) & (stands < 2)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], clash.astype(np.int8), [0]])))
    out = []
    for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        best = a + int(np.argmax(score[a:b]))
        column = level[:, max(a - 1, 0) : b + 1]
        spread = float(np.nanmax(column) - np.nanmin(column))
        who = tuple(r for r, row in zip(side.track.runs, column, strict=True) if np.isfinite(row).any())
        out.append(
            Change(
                first=max(a - width // 2, 0),
                last=min(b - 1 + width // 2, N - 1),
                statistic=float(score[best] ** 2),
                limit=APART_SIGMA**2,
                dof=1,
                shift=spread,
                sigma=spread / float(score[best]),
                verdict="contradiction",
                runs=who,
            )
        )
    return out


def _judged(side: Side, change: Change, joint: Joint) -> Change:
    """Say of a stretch whether the new runs agree about it, and whether tracks are moved that far."""
    here = slice(change.first, change.last + 1)
    level = side.levelled(joint.run)[:, here]
    mean, variance, who = [], [], []
    for k, model in enumerate(side.errors):
        known = np.isfinite(level[k])
        many = int(np.count_nonzero(known))
        if not many:
            continue
        mean.append(float(np.median(level[k, known])))
        fixes = max(many * float(np.median(side.track.profile.count[k, here][known])), 1.0)
        variance.append(model.correlated**2 + 1.6 * model.white**2 / fixes)  # of a median
        who.append(side.track.runs[k])
    m, v = np.array(mean), np.array(variance)
    verdict = "moved"
    if len(m) >= 2:
        centre = float((m / v).sum() / (1.0 / v).sum())
        if ((m - centre) ** 2 / v).sum() > chi_square_limit(len(m) - 1, CONTRADICTION):
            verdict = "contradiction"
    if verdict == "moved" and not side.up and abs(change.shift) >= TRACKS_APART:
        verdict = "another track"
    rough = min(e.total for e in side.errors) >= PRECISE  # excursions of such receivers have shapes of their own
    if verdict != "contradiction" and rough and abs(change.shift) < CLEAR * change.sigma:
        verdict = "unsure"
    return replace(change, verdict=verdict, runs=tuple(who))


def mask(side: Side, *verdicts: str) -> BoolArray:
    """Nodes (N,) of the stretches with one of these verdicts, and what lies within the margin of them."""
    out = np.zeros(len(side.axis), np.bool_)
    margin = max(1, int(np.ceil(MARGIN / side.track.nominal.step)))
    for change in side.changes:
        if change.verdict in verdicts:
            out[max(change.first - margin, 0) : change.last + margin + 1] = True
    return out


def set_aside(side: Side) -> None:
    """Take the new runs out of the stretches where they contradict each other or are on another track."""
    side.excluded = mask(side, "contradiction", "another track")
    clash = mask(side, "contradiction")
    if side.up or not clash.any():
        return
    for t in side.track.laid:
        node = np.clip(np.rint(np.nan_to_num(t.offset) / side.track.nominal.step), 0, len(clash) - 1).astype(np.int64)
        here = np.isfinite(t.offset) & (t.fixes.reason == USED) & clash[node]
        t.fixes.reason[here] = CONTRADICTS
        t.fixes.size[here] = np.abs(t.right[here])


def know_with(side: Side, border: FloatArray, value: FloatArray) -> Knowledge:
    """What a merged chain says of the frame offsets of its runs and its track; of a shift common to all it says nothing."""
    B = side.design.shape[1]
    common = border @ np.tile(np.eye(B), (border.shape[1] // B, 1))
    Q, _ = np.linalg.qr(common)
    return Knowledge(side.track.runs, border - Q @ (Q.T @ border), value - Q @ (Q.T @ value))
