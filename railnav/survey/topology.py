"""Where runs part and come together: ways, the tracks-to-be of a survey, and where one springs from another.

Runs that see each other on one track to within their accuracy are on one way; where a run leaves it, a new way begins at the toe of a
turnout. A turnout's curve leaves the through track as D = (s - s0)^2 / 2R, so the root of the distance between two runs is a straight
line of s, and s0, its zero, is the toe. Precise runs show turnouts between tracks that lie side by side; rough ones only lines that
part by more than they err.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from railnav.survey.nominal import Line
from railnav.survey.offsets import HOLD, robust_fit

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: Precise runs differ by less than this on one track, m; they are apart beyond it, or beyond six times their scatter.
SAME, PRECISE_SCATTER = 0.4, 0.12
#: Tracks are somewhere farther apart than this, m; of the way that two runs share no more than this share lies between.
LEAST_APART, DWELL = 2.5, 0.1
#: Stretches shorter than this are no track, and no common way, m.
LEAST_TRACK, LEAST_COMMON = 40.0, 40.0
#: Distances between which the root of the distance is taken as straight, m.
TOE_FROM, TOE_TO = 0.15, 2.5
#: The toe lies no farther than this before the place where runs are seen apart, m.
TOE_REACH = 60.0
#: Rough runs: lines part when they are farther apart than this for so long, and were together so long, m.
PARTED, PARTED_LENGTH, TOGETHER_LENGTH = 35.0, 300.0, 300.0
#: Distances of rough runs between which the toe is sought, m, and how far before, m.
ROUGH_FROM, ROUGH_TO, ROUGH_REACH = 12.0, 70.0, 800.0


@dataclass(slots=True, eq=False)
class Way:
    """A track-to-be along a line's nominal curve.

    Attributes
    ----------
    first, last : float
        Nodes where it begins and ends.
    leader : dict
        Run whose profile it follows, by node.
    members : list of (run, first, last)
        Stretches of runs on it, in nodes.
    start, finish : (way, node) or None
        The way that it springs from at either end, and where.
    """

    first: float
    last: float
    leader: dict[int, int]
    members: list[tuple[int, float, float]]
    start: tuple[int, float] | None = None
    finish: tuple[int, float] | None = None


def ways_of_line(value: FloatArray, design: FloatArray, step: float) -> list[Way] | None:
    """Part the profiles of precise runs into ways; None where no run changes track, or the runs are too rough to tell.

    Parameters
    ----------
    value : (K, N) array
        Distances to the right of a line's nominal curve, m; NaN where a run has none.
    design : (N, 2) array
        Normal of the curve.
    step : float
        Distance between nodes, m.
    """
    K = len(value)
    if K < 2:
        return None
    known = _levelled(value, design)
    if known is None:
        return None
    level, tolerance = known
    known_at = np.isfinite(level)
    free = known_at.copy()
    ways: list[Way] = []
    least = max(3, round(LEAST_TRACK / step))
    common = max(3, round(LEAST_COMMON / step))
    while True:
        k, a, b = _longest(free, known_at)
        if b - a < least:
            break
        way = Way(float(a), float(b - 1), dict.fromkeys(range(a, b), k), [(k, a, b - 1)])
        free[k, a:b] = False
        if ways and not _is_track(level, ways, way):
            continue  # no farther from the tracks around it than runs contradict each other: no track of its own
        _gather_members(level, free, way, tolerance, common)
        ways.append(way)
    if all(sum(m[0] == k for w in ways for m in w.members) <= 1 for k in range(K)):
        return None
    for number, way in enumerate(ways):
        k = way.leader[int(way.first)]
        for end in (0, 1):
            node = int(way.first) if end == 0 else int(way.last)
            beyond = node - 1 if end == 0 else node + 1
            for reach in range(1, max(3, round(30.0 / step))):
                at = node - reach if end == 0 else node + reach
                other = _way_at(ways, number, k, at)
                if other is not None:
                    toe = _toe(level, ways[other], k, node, -1 if end else 1, step)
                    if end == 0:
                        way.first, way.start = toe, (other, toe)
                    else:
                        way.last, way.finish = toe, (other, toe)
                    _cut_member(ways[other], k, beyond, toe, end)
                    break
        way.members = [_from_toe(ways, number, j, u, v, k, step) for j, u, v in way.members]
    return ways


def precise(value: FloatArray, design: FloatArray) -> bool:
    """Whether profiles (K, N) of runs are precise enough to show turnouts between tracks side by side."""
    return len(value) > 1 and _levelled(value, design) is not None


def _gather_members(level: FloatArray, free: BoolArray, way: Way, tolerance: float, common: int) -> None:
    """Take in the stretches of other runs on a way; where its leader's data end and a member goes on, the way goes on with it."""
    K, N = level.shape
    grown = True
    while grown:
        grown = False
        a, b = int(way.first), int(way.last) + 1
        line = np.array([level[way.leader[n], n] for n in range(a, b)])
        line = np.where(
            np.isfinite(line),
            line,
            np.interp(np.arange(b - a), np.flatnonzero(np.isfinite(line)), line[np.isfinite(line)]),
        )
        for j in range(K):
            near = free[j, a:b] & (np.abs(level[j, a:b] - line) < tolerance)
            if not near.any():
                continue
            for begin, stop in _stretches(near | ~np.isfinite(level[j, a:b]), near, common):
                way.members.append((j, a + begin, a + stop - 1))
                free[j, a + begin : a + stop] = False
        for forward in (False, True):
            end = int(way.last) if forward else int(way.first)
            rest = slice(end + 1, N) if forward else slice(0, end)
            if np.isfinite(level[way.leader[end], rest]).any():
                continue  # the leader goes on, on another way
            for j, u, v in tuple(way.members):
                touches = v >= end - 3 if forward else u <= end + 3
                more = np.flatnonzero(free[j, rest]) + (end + 1 if forward else 0)
                if not touches or not len(more):
                    continue
                far = int(more[-1]) if forward else int(more[0])
                new = range(end + 1, far + 1) if forward else range(far, end)
                way.leader.update(dict.fromkeys(new, j))
                way.first, way.last = min(way.first, float(far)), max(way.last, float(far))
                free[j, min(new) : max(new) + 1] = False
                way.members.remove((j, u, v))
                way.members.append((j, min(u, float(far)), max(v, float(far))))
                grown = True
                break


def _is_track(level: FloatArray, ways: Sequence[Way], way: Way) -> bool:
    """Whether a way lies somewhere as far from the others as tracks do, or leads from one of them to another."""
    nearest: list[int] = []
    apart: float = 0.0
    for n, k in sorted(way.leader.items()):
        there = {w: float(level[o.leader[n], n]) for w, o in enumerate(ways) if n in o.leader}
        off = {w: abs(float(level[k, n]) - v) for w, v in there.items() if np.isfinite(v)}
        if not off or not np.isfinite(level[k, n]):
            continue
        near = min(off, key=lambda w: off[w])
        nearest.append(near)
        apart = max(apart, off[near])
    return not nearest or apart > LEAST_APART or nearest[0] != nearest[-1]


def _levelled(value: FloatArray, design: FloatArray) -> tuple[FloatArray, float] | None:
    """Profiles without the differences of their frames, and how far apart runs on one track may be; None where runs are rough."""
    K = len(value)
    reference = int(np.argmax(np.isfinite(value).sum(axis=1)))
    out = value.copy()
    scatter = []
    for j in range(K):
        if j == reference:
            continue
        D = value[j] - value[reference]
        use = np.isfinite(D)
        if np.count_nonzero(use) < 10:
            continue
        # turnouts and other tracks are steps of metres: the frame shows where the difference is small or constant
        near = np.abs(D[use]) < SAME
        part = np.flatnonzero(use)[near] if near.sum() >= 10 else np.zeros(0, np.int64)
        if len(part):
            x, spread = robust_fit(design[part], D[part], np.full(2, HOLD))
            out[j] = value[j] - design @ x
            scatter.append(spread)
        # turnouts pass quickly from one track to the next; errors that wander dwell in between
        between = np.abs(D[use] - (design[use] @ x if len(part) else 0.0))
        if np.mean((between > SAME) & (between < LEAST_APART)) > DWELL:
            return None
        jump = np.diff(D[use])
        scatter.append(1.4826 * float(np.median(np.abs(jump))) / np.sqrt(2.0))
    if not scatter or float(np.median(scatter)) > PRECISE_SCATTER:
        return None
    return out, max(SAME, 6.0 * float(np.median(scatter)))


def _longest(free: BoolArray, known: BoolArray) -> tuple[int, int, int]:
    """Run and nodes of the longest free stretch; where a run has nothing (a tunnel) it goes on, where it is on another way it ends."""
    best = (0, 0, 0)
    for k, row in enumerate(free):
        at = np.flatnonzero(row)
        if not len(at):
            continue
        taken = np.append(0, np.cumsum(known[k] & ~row))
        edges = np.flatnonzero(np.diff(taken[at]) > 2)
        for a, b in zip(at[np.append(0, edges + 1)], at[np.append(edges, len(at) - 1)], strict=True):
            if b + 1 - a > best[2] - best[1]:
                best = (k, int(a), int(b) + 1)
    return best


def _stretches(open_: BoolArray, near: BoolArray, least: int) -> list[tuple[int, int]]:
    """Stretches (from, to) where a run stays near, unknown nodes bridged, single outliers forgiven."""
    from scipy.ndimage import binary_closing

    joined = binary_closing(open_, np.ones(5)) | open_
    edges = np.flatnonzero(np.diff(np.concatenate([[0], joined.astype(np.int8), [0]])))
    out = []
    for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        inside = np.flatnonzero(near[a:b])
        if len(inside) >= 2 and inside[-1] - inside[0] >= least:
            out.append((a + int(inside[0]), a + int(inside[-1]) + 1))
    return out


def _way_at(ways: Sequence[Way], number: int, run: int, node: int) -> int | None:
    for w, way in enumerate(ways):
        if w != number and any(j == run and u <= node <= v for j, u, v in way.members):
            return w
    return None


def _toe(level: FloatArray, other: Way, run: int, node: int, ahead: int, step: float) -> float:
    """Node, as a fraction, where a run leaves a way: zero of the straight line through the root of their distance."""
    nodes = [
        n for n in range(node - 12 * ahead, node + 60 * ahead, ahead) if n in other.leader and 0 <= n < level.shape[1]
    ]
    at = np.array([n for n in nodes if np.isfinite(level[run, n]) and np.isfinite(level[other.leader[n], n])])
    reach = TOE_REACH / step
    if len(at):
        D = np.abs([level[run, n] - level[other.leader[n], n] for n in at])
        far = np.flatnonzero(D > TOE_TO)
        stop = far[0] if len(far) else len(D)
        use = np.flatnonzero(D[:stop] > TOE_FROM)
        use = use[use >= (np.flatnonzero(D[:stop] < TOE_FROM)[-1] if (D[:stop] < TOE_FROM).any() else 0)]
        if len(use) >= 3:
            slope, root = np.polyfit(np.sqrt(D[use]), at[use].astype(float), 1)
            if slope * ahead > 0:
                return float(np.clip(root, node - reach, node + reach))
    return float(node - ahead * 15.0 / step)


def _from_toe(
    ways: Sequence[Way], number: int, run: int, first: float, last: float, leader: int, step: float
) -> tuple[int, float, float]:
    """A run's stretch on a way that springs from others: it too begins and ends at the toes, and no sooner leaves the other way."""
    way, reach = ways[number], TOE_REACH / step
    edges = [first, last]
    for end, spring, own in ((0, way.start, way.first), (1, way.finish, way.last)):
        if spring is None:
            continue
        other, toe = spring
        away = 1 if end == 0 else -1
        if run == leader:
            edges[end] = own
        elif abs(edges[end] - toe) <= reach:
            beyond = edges[end] - away
            if any(j == run and u - 2 <= beyond <= v + 2 for j, u, v in ways[other].members):
                _cut_member(ways[other], run, int(beyond), toe, end)
                edges[end] = toe
    return run, edges[0], edges[1]


def _cut_member(way: Way, run: int, beyond: int, toe: float, end: int) -> None:
    """End a run's stretch on the way that it leaves at the toe."""
    out = []
    for j, u, v in way.members:
        if j == run and u - 2 <= beyond <= v + 2:
            u, v = (u, min(v, toe)) if end == 0 else (max(u, toe), v)
        if v > u:
            out.append((j, u, v))
    way.members = out


# ---------------------------------------------------------------- lines that part


@dataclass(slots=True, eq=False)
class Branch:
    """A line that springs from another one.

    Attributes
    ----------
    course : (k, 2) array
        Its own points, from one toe to the other or to its end.
    members : list of int
        Runs that follow it.
    parent : int
        Line that it springs from.
    at_start, at_finish : bool
        Whether it springs from it at its start and at its finish.
    """

    course: FloatArray
    members: list[int]
    parent: int
    at_start: bool
    at_finish: bool


@dataclass(slots=True, eq=False)
class Network:
    """Lines and the branches that spring from them.

    Attributes
    ----------
    lines : list of Line
            Members are the runs that follow them, in parts as well.
    branches : list of Branch
    """

    lines: list[Line]
    branches: list[Branch] = field(default_factory=list)


def parted_lines(lines: Sequence[Line]) -> Network:
    """Find lines that share a stretch with a longer one, and make branches of what they do not share."""
    out = Network([])
    for line in sorted(lines, key=lambda item: -_length(item.course)):
        found = None
        for number, parent in enumerate(out.lines):
            parts = _away(line.course, parent.course)
            if parts is not None:
                found = number, parts
                break
        if found is None:
            out.lines.append(Line(line.course, list(line.members)))
            continue
        number, parts = found
        out.lines[number].members = sorted({*out.lines[number].members, *line.members})
        for course, at_start, at_finish in parts:
            out.branches.append(Branch(course, list(line.members), number, at_start, at_finish))
    return out


def _length(points: FloatArray) -> float:
    return float(np.hypot(*np.diff(points, axis=0).T).sum()) if len(points) > 1 else 0.0


def _away(course: FloatArray, parent: FloatArray) -> list[tuple[FloatArray, bool, bool]] | None:
    """Parts of a course away from a parent that it runs along elsewhere, from toe to toe; None where they share nothing."""
    from scipy.spatial import cKDTree

    own, s = _dense(course)
    ground, _ = _dense(parent)
    distance, _ = cKDTree(ground).query(own)
    near = distance < PARTED
    edges = np.concatenate([[0], np.flatnonzero(np.diff(near.astype(np.int8))) + 1, [len(near)]])
    # short stretches belong to what is around them
    kind = near.copy()
    for a, b in pairwise(edges.tolist()):
        if s[b - 1] - s[a] < (TOGETHER_LENGTH if near[a] else PARTED_LENGTH) and a > 0 and b < len(near):
            kind[a:b] = ~near[a]
    edges = np.concatenate([[0], np.flatnonzero(np.diff(kind.astype(np.int8))) + 1, [len(kind)]])
    shared = sum(float(s[b - 1] - s[a]) for a, b in pairwise(edges.tolist()) if kind[a])
    if shared < TOGETHER_LENGTH:
        return None
    parts: list[tuple[FloatArray, bool, bool]] = []
    for a, b in pairwise(edges.tolist()):
        if kind[a] or s[b - 1] - s[a] < PARTED_LENGTH:
            continue
        begin, end = a > 0, b < len(kind)
        first = _rough_toe(s, distance, a, -1) if begin else a
        last = _rough_toe(s, distance, b - 1, 1) if end else b - 1
        parts.append((own[first : last + 1], begin, end))
    return parts or None


def _rough_toe(s: FloatArray, distance: FloatArray, at: int, back: int) -> int:
    """Point where two rough courses part: zero of the straight line through the root of their distance."""
    inward = -back
    use = []
    n = at
    while 0 <= n < len(s) and distance[n] > ROUGH_FROM and abs(s[n] - s[at]) < ROUGH_REACH:
        use.append(n)
        n += back
    n = at + inward
    while 0 <= n < len(s) and distance[n] < ROUGH_TO and abs(s[n] - s[at]) < ROUGH_REACH:
        use.append(n)
        n += inward
    rows = np.array(sorted(use))
    zero = s[at]
    if len(rows) >= 4:
        slope, root = np.polyfit(np.sqrt(distance[rows]), s[rows], 1)
        if slope * inward > 0:
            zero = root
    zero = float(np.clip(zero, s[at] - ROUGH_REACH, s[at] + ROUGH_REACH))
    return int(np.argmin(np.abs(s - zero)))


def _dense(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points every 20 m along a course, and their arc length."""
    p = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    s = np.linspace(0.0, p[-1], max(2, int(p[-1] / 20.0) + 1))
    return np.column_stack([np.interp(s, p, points[:, i]) for i in range(2)]), s
