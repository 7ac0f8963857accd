"""One track under estimation: its runs along a nominal curve, robust weights, the chain across and the chain of heights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from railnav.survey import _kernels
from railnav.survey.axis import Chain, ErrorModel, Estimate, Slopes, Swept, log_evidence
from railnav.survey.fixes import GROSS, OTHER_TRACK, USED, Fixes
from railnav.survey.noise import Sample
from railnav.survey.nominal import Nominal
from railnav.survey.offsets import Knowledge
from railnav.survey.profiles import Profiles, Traverse, profiles, traverse

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: Fixes farther than this from the nominal curve of a track are not of it, m.
REACH = 60.0
#: A single run's way beyond all others is cut when no longer than this, m.
LONE_END = 500.0
#: Fixes of such a length at an end that lie beyond a gap of this length, m, are cut off with it.
ISLAND_GAP = 200.0
#: Of receivers better than this, m, stated sigmas that grow with the errors are believed, within this range of their median.
TOLD, TOLD_RANGE = 0.75, (0.3, 5.0)
#: Beyond this many sigma a node mean begins to lose weight (Huber).
HUBER = 2.5
#: A fix this many sigma off the axis is a gross error.
GROSS_RATIO = 6.0
#: A deviation of one sign over this length, m, and at least this size, m, is another track.
OTHER_LENGTH, OTHER_SIZE = 100.0, 1.5
#: Two tracks are no closer than this, m: values of precise runs farther apart are never averaged.
TRACKS_APART = 1.5
#: Curvature noise that is tried, 1/m per sqrt(m); the steepest clothoid, 1/(300 m * 50 m) over its 50 m, needs 5e-4.
NOISES = (1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3)
#: It is chosen on so many windows of so many nodes at most.
WINDOWS, WINDOW_NODES = 6, 400
#: A stretch without any measurement is longer than this, m; there curvature noise is that of the livelier parts (quantile).
BLIND, LIVELY = 60.0, 0.95
#: Degrees of freedom and reach, m, with which the curvature noise follows the track.
LOCAL_DOF, LOCAL_REACH = 2.0, 30.0


@dataclass(slots=True, eq=False)
class Surveyed:
    """A track and the runs on it.

    Attributes
    ----------
    name : str
        Identifier of the track.
    runs : tuple of int
        Who takes part.
    nominal : Nominal
    laid : list of Traverse
        The runs along the nominal curve.
    profile : Profiles
    axis : (N,) array
        Best guess of the axis: distance to the right of the nominal curve, m.
    errors : list of ErrorModel
        How each run errs.
    noise_level : float
        Curvature noise of the whole track, 1/m per sqrt(m); 0 until it is chosen.
    noise : (N-1,) array
        Curvature noise between nodes.
    estimate : Estimate or None
        The last estimate, relative to `nominal`.
    slopes : Slopes or None
        What gyroscopic angles say.
    masks : tuple of ((m,) bool array or None) or None
        Fixes of each run that belong to this track, where a run follows several.
    unit_weight : float
        Unit-weight RMS of the last estimate; NaN before.
    """

    name: str
    runs: tuple[int, ...]
    nominal: Nominal
    laid: list[Traverse]
    profile: Profiles
    axis: FloatArray
    errors: list[ErrorModel] = field(default_factory=list)
    noise_level: float = 0.0
    noise: FloatArray = field(default_factory=lambda: np.zeros(0))
    estimate: Estimate | None = None
    slopes: Slopes | None = None
    masks: tuple[BoolArray | None, ...] | None = None
    unit_weight: float = float("nan")

    @property
    def design(self) -> FloatArray:
        """Normal of the nominal curve, (N, 2): what one metre east and north adds to a distance to the right."""
        return np.column_stack(self.nominal.normal)

    def levelled(self, offset: FloatArray) -> FloatArray:
        """Distances to the right with the runs' frame offsets (R, 2) removed, (K, N)."""
        return np.asarray(self.profile.right - offset[list(self.runs)] @ self.design.T)


def lay(
    name: str,
    runs: tuple[int, ...],
    fixes: Sequence[Fixes],
    nominal: Nominal,
    *,
    reach: float = REACH,
    masks: tuple[BoolArray | None, ...] | None = None,
) -> Surveyed:
    """Lay runs along a nominal curve and cut it where they end; of each run only the fixes in its mask, where it has one."""
    laid = [traverse(nominal, fixes[i], reach) for i in runs]
    if masks is not None:
        laid = [
            t
            if mask is None
            else replace(t, offset=np.where(mask, t.offset, np.nan), right=np.where(mask, t.right, np.nan))
            for t, mask in zip(laid, masks, strict=True)
        ]
    profile = profiles(laid, len(nominal), nominal.step)
    return cut_ends(Surveyed(name, runs, nominal, laid, profile, np.zeros(len(nominal)), masks=masks))


def cut_ends(track: Surveyed) -> Surveyed:
    """Cut a track to what its used fixes cover.

    With three runs or more, a short end (up to 500 m) that a single run reaches is cut as well: at a terminus every run stops
    somewhere else, on another platform track, and wanders.
    """
    ends = [np.flatnonzero(row) for row in track.profile.present if row.any()]
    N = len(track.nominal)
    if not ends:
        return track
    first, last = sorted(int(e[0]) for e in ends), sorted(int(e[-1]) for e in ends)
    a, b = first[0], last[-1]
    if len(track.runs) >= 3 and len(ends) >= 2:
        short = LONE_END / track.nominal.step
        a = first[1] if first[1] - a <= short else a
        b = last[-2] if b - last[-2] <= short else b
    a, b = _mainland(track, a, b)
    if (a == 0 and b == N - 1) or b - a < 3:
        return track
    keep = slice(a, b + 1)
    laid = []
    for t in track.laid:
        offset = t.offset - a * track.nominal.step
        outside = ~((offset >= -0.5 * track.nominal.step) & (offset <= (b - a + 0.5) * track.nominal.step))
        laid.append(replace(t, offset=np.where(outside, np.nan, offset), right=np.where(outside, np.nan, t.right)))
    nominal = track.nominal.part(a, b + 1)
    e = track.estimate
    if e is not None:
        e = e.part(a, b + 1)
    return replace(
        track,
        nominal=nominal,
        laid=laid,
        profile=profiles(laid, len(nominal), nominal.step),
        axis=track.axis[keep],
        noise=track.noise[a:b],
        estimate=e,
        slopes=None if track.slopes is None else track.slopes.part(a, b + 1),
    )


def _mainland(track: Surveyed, a: int, b: int) -> tuple[int, int]:
    """Ends a..b of a track without short islands of fixes beyond a gap: a curve across the gap to them is anybody's guess."""
    nodes = np.flatnonzero(track.profile.present[:, a : b + 1].any(axis=0)) + a
    gap, island = ISLAND_GAP / track.nominal.step, LONE_END / track.nominal.step
    while len(nodes) > 3:
        breaks = np.flatnonzero(np.diff(nodes) > gap)
        if len(breaks) and nodes[breaks[0]] - nodes[0] < island and len(nodes) - breaks[0] > 3:
            nodes = nodes[breaks[0] + 1 :]
        elif len(breaks) and nodes[-1] - nodes[breaks[-1] + 1] < island and breaks[-1] > 2:
            nodes = nodes[: breaks[-1] + 1]
        else:
            break
    return (int(nodes[0]), int(nodes[-1])) if len(nodes) else (a, b)


def middle_axis(track: Surveyed, offset: FloatArray, spread: float, step: float, smooth: float) -> FloatArray:
    """Guess the axis without a model: every `step` metres the middle of the largest clump of runs, smoothed.

    Clumps are separated by `TRACKS_APART` or six times `spread`, whichever is more; between equal clumps the run that stands first
    in the track decides all along, so that the axis stays on one real track.
    """
    from scipy.ndimage import gaussian_filter1d

    value = reduced(track, offset, step).value
    guess, clumps = np.empty(value.shape[1]), np.empty(value.shape[1], np.int64)
    _kernels.middle(value, max(TRACKS_APART, 6.0 * spread), guess, clumps)
    known = np.isfinite(guess)
    at = np.arange(len(guess)) * step
    guess = np.interp(at, at[known], guess[known])
    if smooth > 0:
        guess = gaussian_filter1d(guess, smooth / step, mode="nearest")
    return np.asarray(track.axis + np.interp(np.arange(len(track.nominal)) * track.nominal.step, at, guess))


def fix_spacing(track: Surveyed) -> float:
    """How far apart the fixes of a moving run usually lie, m; the widest of the runs."""
    widest = 0.0
    for t in track.laid:
        s = t.offset[(t.fixes.reason == USED) & np.isfinite(t.offset)]
        move = np.abs(np.diff(s))
        move = move[move > 0.5]
        if len(move):
            widest = max(widest, float(np.median(move)))
    return widest


def reduced(track: Surveyed, offset: FloatArray, step: float, receivers: list[str] | None = None) -> Sample:
    """Reduce runs to means every `step` metres of their distance from the present axis, frame offsets removed."""
    nominal = track.nominal
    nodes = np.arange(len(nominal))
    e, n = nominal.normal
    many = int(np.ceil((len(nominal) - 1) * nominal.step / step)) + 1
    K = len(track.runs)
    value, time = np.full((K, many), np.nan), np.zeros((K, many))
    usual, rate = np.ones(K), np.ones(K)
    for k, (i, t) in enumerate(zip(track.runs, track.laid, strict=True)):
        use = np.flatnonzero((t.fixes.reason == USED) & np.isfinite(t.offset))
        node = np.rint(t.offset[use] / step).astype(np.int64)
        inside = (node >= 0) & (node < many)
        use, node = use[inside], node[inside]
        if not len(use):
            continue
        at = t.offset[use] / nominal.step
        residual = t.right[use] - np.interp(at, nodes, track.axis + offset[i, 0] * e + offset[i, 1] * n)
        count = np.bincount(node, minlength=many)
        hit = count > 0
        value[k, hit] = np.bincount(node, weights=residual, minlength=many)[hit] / count[hit]
        when = np.bincount(node, weights=t.fixes.time[use], minlength=many)[hit] / count[hit]
        time[k] = np.interp(np.arange(many), np.flatnonzero(hit), when)
        usual[k] = 1.0 / np.mean(1.0 / count[hit])  # the variance of a mean, on average
        rate[k] = 1.0 / max(float(np.median(np.diff(t.fixes.time[use]))), 1e-3) if len(use) > 1 else 1.0
    kinds = tuple(receivers[i] for i in track.runs) if receivers is not None else ("",) * K
    node = np.minimum(np.arange(many) * step / nominal.step, len(nominal) - 1).astype(np.int64)
    return Sample(value, time, usual, rate, kinds, np.column_stack([e[node], n[node]]))


def relaid(track: Surveyed, fixes: Sequence[Fixes], *, step: float | None = None) -> Surveyed:
    """Make the estimated axis the nominal curve and lay the runs anew."""
    track = cut_ends(track)
    nominal = track.nominal.shifted(track.axis)
    if step is not None:
        nominal = nominal.resampled(step)
    new = lay(track.name, track.runs, fixes, nominal, masks=track.masks)
    new.errors, new.noise_level = track.errors, track.noise_level
    return new


def reject(track: Surveyed, offset: FloatArray, slack: float) -> None:
    """Set aside the fixes that the axis refuses: gross errors, and stretches on another track. Earlier verdicts are forgotten.

    `slack`, m, is how far the present axis itself may be off.
    """
    step, nodes = track.nominal.step, np.arange(len(track.nominal))
    e, n = track.nominal.normal
    for k, (i, t) in enumerate(zip(track.runs, track.laid, strict=True)):
        f = t.fixes
        mine = np.isfinite(t.offset)
        again = mine & ((f.reason == GROSS) | (f.reason == OTHER_TRACK))
        f.reason[again] = USED
        use = np.flatnonzero(mine & (f.reason == USED))
        if not len(use):
            continue
        s = t.offset[use] / step
        across = np.interp(s, nodes, track.axis + offset[i, 0] * e + offset[i, 1] * n)
        residual = t.right[use] - across
        limit = GROSS_RATIO * track.errors[k].total + slack
        bad = np.abs(residual) > limit
        f.size[use] = np.abs(residual)
        f.reason[use[bad]] = GROSS
        if not bad.any():
            continue
        order = np.argsort(s, kind="stable")
        sign = np.where(bad, np.sign(residual), 0.0)[order]
        edges = np.flatnonzero(np.diff(np.concatenate([[0.0], sign, [0.0]])))
        for a, b in pairwise(edges):
            if sign[a] == 0.0:
                continue
            piece = order[a:b]
            long = (s[order[b - 1]] - s[order[a]]) * step >= OTHER_LENGTH
            if long and float(np.median(np.abs(residual[piece]))) >= max(OTHER_SIZE, limit):
                # the way there and back belongs to it: as far as the deviation keeps its sign and stays above two sigma
                same = np.sign(residual[order]) == sign[a]
                off = same & (np.abs(residual[order]) > 2.0 * track.errors[k].total)
                while a > 0 and off[a - 1]:
                    a -= 1
                while b < len(order) and off[b]:
                    b += 1
                f.reason[use[order[a:b]]] = OTHER_TRACK
    track.profile = profiles(track.laid, len(track.nominal), step)


def cross_chain(track: Surveyed, offset: FloatArray, slack: float, level: float | None = None) -> Chain:
    """The chain across the track, rows weighted by what is known of each run and by how it stands to the present axis.

    Curvature noise is the track's own, or `level` everywhere.
    """
    residual = track.levelled(offset) - track.axis
    noise = track.noise
    if level is not None or not len(noise):
        noise = np.full(len(track.nominal) - 1, track.noise_level if level is None else level)
    return Chain(
        step=track.nominal.step,
        value=track.profile.right,
        lead=track.profile.lead,
        variance=white_variances(track.profile, residual, track.errors, slack),
        time=track.profile.time,
        design=np.broadcast_to(track.design, (*residual.shape, 2)),
        errors=track.errors,
        bend=track.nominal.curvature,
        noise=noise,
        slopes=track.slopes,
    )


def white_variances(P: Profiles, residual: FloatArray, errors: list[ErrorModel], slack: float) -> FloatArray:
    """Variance of the white part of each node mean (K, N), inflated for doubtful ones by what a correlated error would be."""
    variance = np.full(residual.shape, np.nan)
    for k, model in enumerate(errors):
        known = np.isfinite(residual[k])
        if not known.any():
            continue
        count = P.count[k][known]
        # nodes that err together: the doubt of one counts for all of them
        pace = float(np.median(np.abs(np.diff(P.time[k][known])))) if np.count_nonzero(known) > 1 else 1.0
        together = max(1.0, 2.0 * model.memory / max(pace, 1e-3))
        doubt, scale = np.zeros(len(count)), np.ones(len(count))
        stated = P.sigma[k][known]
        if np.isfinite(stated).any():
            ratio = stated / float(np.nanmedian(stated))
            if model.total < TOLD and tells(ratio, residual[k][known]):
                scale = np.where(np.isfinite(ratio), np.clip(ratio, *TOLD_RANGE) ** 2, 1.0)
            else:
                doubt += np.where(np.isfinite(ratio), np.maximum(ratio**2 - 2.0, 0.0), 0.0)
        strain = np.maximum(np.abs(residual[k][known]) - slack, 0.0) / (HUBER * model.total * np.sqrt(scale))
        doubt += np.maximum(strain - 1.0, 0.0) + np.maximum(strain**2 - 1.0, 0.0)
        variance[k, known] = scale * model.white**2 / count + doubt * model.total**2 * together
    return variance


def tells(ratio: FloatArray, residual: FloatArray) -> bool:
    """Whether stated sigmas tell how large errors are (a base station far or near): residuals grow with them."""
    ok = np.isfinite(ratio) & np.isfinite(residual)
    if np.count_nonzero(ok) < 80:
        return False
    low, high = np.quantile(ratio[ok], [0.25, 0.75])
    if high < 1.3 * low:
        return False

    def spread(rows: BoolArray) -> float:
        return float(np.median(np.abs(residual[ok & rows])))

    return spread(ratio >= high) > 1.25 * spread(ratio <= low)


def choose_noise(chain: Chain) -> float:
    """Choose the curvature noise of a whole track that makes its data most likely, on up to `WINDOWS` windows of it."""
    windows = [chain.part(a, b) for a, b in _windows(len(chain.bend))]
    score = [sum(log_evidence(replace(w, noise=np.full(len(w.bend) - 1, level))) for w in windows) for level in NOISES]
    best = int(np.argmax(score))
    if 0 < best < len(score) - 1:  # the top of the parabola through three points
        a, b, c = score[best - 1 : best + 2]
        shift = 0.5 * (a - c) / (a - 2.0 * b + c)
        low, high = np.log(NOISES[best - 1]), np.log(NOISES[best + 1])
        return float(np.exp(np.log(NOISES[best]) + np.clip(shift, -0.5, 0.5) * 0.5 * (high - low)))
    return NOISES[best]


def _windows(nodes: int) -> list[tuple[int, int]]:
    """Spread windows of nodes (from, to) evenly over a track; all of it when it is short."""
    if nodes <= WINDOWS * WINDOW_NODES:
        return [(0, nodes)]
    starts = np.linspace(0, nodes - WINDOW_NODES, WINDOWS).astype(int)
    return [(int(a), int(a) + WINDOW_NODES) for a in starts]


def local_noise(estimate: Estimate, level: float, step: float) -> FloatArray:
    """Curvature noise along the track: what the estimate shows within `LOCAL_REACH`, drawn to the track's own level."""
    width = max(1, round(LOCAL_REACH / step))
    box = np.ones(2 * width + 1)
    power = np.convolve(estimate.step_power / step, box, mode="same")
    many = np.convolve(np.ones(len(estimate.step_power)), box, mode="same")
    return np.sqrt((LOCAL_DOF * level**2 + power) / (LOCAL_DOF + many))


def free_in_gaps(track: Surveyed, noise: FloatArray) -> FloatArray:
    """Where nothing was measured the track may bend as it does elsewhere: curvature noise no less than in its livelier parts."""
    seen = track.profile.present.any(axis=0)
    if track.slopes is not None:
        seen |= np.isfinite(track.slopes.value).any(axis=0)
    at = np.flatnonzero(seen)
    out = noise.copy()
    lively = float(np.quantile(noise, LIVELY))
    for a, b in pairwise(at.tolist()):
        if (b - a) * track.nominal.step > BLIND:
            out[a:b] = np.maximum(out[a:b], lively)
    return out


def know(track: Surveyed, swept: Swept) -> Knowledge:
    """What a swept chain says of the frame offsets of its runs among each other.

    Of a shift common to all runs the data say nothing; what the chain seems to say of it is the smoothness of the track at work on
    a curve moved bodily. A free common shift takes that out: rows are projected off its image.
    """
    rows, value = swept.border, swept.border_value
    many = len(track.runs)
    common = rows @ np.tile(np.eye(rows.shape[1] // many), (many, 1))
    Q, _ = np.linalg.qr(common)
    return Knowledge(track.runs, rows - Q @ (Q.T @ rows), value - Q @ (Q.T @ value))
