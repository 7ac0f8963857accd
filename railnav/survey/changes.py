"""What has moved: new runs compared with the stored axis window by window, contradictions among them, and what is done about it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.estimation.change import change_test
from railnav.estimation.gross_error import chi_square_limit
from railnav.estimation.merging import ChainRecords
from railnav.survey import _kernels
from railnav.survey.axis import Estimate, solve, sweep
from railnav.survey.fixes import CONTRADICTS, USED
from railnav.survey.surveyed import TRACKS_APART

if TYPE_CHECKING:
    from railnav.survey.joint_offsets import Joint
    from railnav.survey.sides import Side

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: A window of the change test: nodes, and how much of the track it spans, m.
WINDOW_NODES, WINDOW_LENGTH = 9, 80.0
#: So many windows say how much more than stated surveys differ.
FEWEST_WINDOWS = 40
#: What is forgotten beyond each end of a moved stretch, m.
MARGIN = 5.0
#: Longest way without new fixes that one change test spans, m.
LONGEST_GAP = 200.0
#: Runs farther apart than so many sigma over half a window contradict each other.
APART_SIGMA = 5.0
#: Probability that runs which agree are called a contradiction.
CONTRADICTION = 1e-4
#: Runs whose fixes are no better than this, m, must see a distance of so many sigma.
PRECISE, CLEAR = 0.75, 3.0
#: Gradients change without the transitions that curves have: vertical curvature noise of the new runs alone, in terms of the stored
#: one. (With 1 the windows on vertical curves have twice the mean of a chi-square, simulated; with 3 all are as they should be.)
FREER = 3.0
#: Rounds of weights of the new runs alone.
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


def covered(side: Side) -> list[tuple[int, int]]:
    """Stretches (first, last) of stored nodes that new runs cover without a longer gap, and long enough to be tested."""
    nodes = np.flatnonzero(np.isfinite(side.track.profile.right).any(axis=0) & side.old)
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
    if not len(at):
        return np.zeros(len(guess))
    width = 2 * max(1, round(20.0 / side.track.nominal.step)) + 1
    smooth = median_filter(guess[at], min(width, len(at)), mode="nearest")
    line = np.interp(np.arange(len(guess)), at, smooth)
    return np.asarray(gaussian_filter1d(line, max(0.5, 10.0 / side.track.nominal.step), mode="nearest"))


def find_changes(side: Side, joint: Joint, at: IntArray, slack: float, false_alarm: float) -> FloatArray:
    """Compare what the new runs alone see with what is stored; fills `side.changes`, gives the axis that they see (N,).

    Parameters
    ----------
    side : Side
    joint : Joint
        Frame offsets as the distances to the stored axis give them.
    at : integer array
        Places of the offsets of its runs and of the track among the joint ones.
    slack : float
        How far the first guess of an axis may be off, m.
    false_alarm : float
        Probability of any alarm along a stretch that has not moved.
    """
    runs = side.track.runs
    if side.stored is None:
        return side.axis
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
        if side.up:
            chain = replace(chain, noise=FREER * chain.noise)
        for number, (a, b) in enumerate(parts):
            piece = chain.part(a, b + 1)
            estimate = solve(piece, sweep(piece), border, border_covariance[:many, :many], sure=turn == ROUNDS - 1)
            side.axis[a : b + 1] = estimate.state[:, 0]
            estimates[number] = estimate
    seen, side.axis = side.axis, kept
    old = side.stored.chain().solve()
    side.alone = np.full(len(side.axis), np.inf)
    for (a, b), found in zip(parts, estimates, strict=True):
        assert found is not None
        lean = found.lean[:, 0, :]
        own = found.inner[:, 0, 0] + np.einsum("ki,ij,kj->k", lean, border_covariance[:many, :many], lean)
        # a freer axis is known less well: the variance of a smoothed line goes with the cube root of its noise
        side.alone[a : b + 1] = own * (FREER ** (-1.0 / 3.0) if side.up else 1.0)
    side.changes = clashes
    clear = ~mask(side, "contradiction")
    for (a, b), found in zip(parts, estimates, strict=True):
        assert found is not None
        estimate = found
        assert old.covariance is not None
        u, v = a - side.first, b - side.first
        # the frame offsets are known by the distances to the stored axis, and are wrong with it
        lean = np.concatenate([estimate.lean, -side.stored.lean[u : v + 1]], axis=2)
        P = estimate.inner + lean @ border_covariance @ lean.transpose(0, 2, 1)
        C = estimate.inner_lag + lean[:-1] @ border_covariance @ lean[1:].transpose(0, 2, 1)
        new = ChainRecords.of_marginals(estimate.state, P, C).solve()
        before = replace(old, state=old.state[u : v + 1], covariance=old.covariance[u : v + 1], packed=old.packed[u:v])
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
    if side.beside is not None:
        level[:, side.beside] = np.nan
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
