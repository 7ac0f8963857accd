"""Ways of new runs off the tracks that a model has: beyond their ends, beside them, on branches; and the tracks that they become."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.survey import _kernels
from railnav.survey.construction import step_for
from railnav.survey.fixes import BEYOND, CONTRADICTS, FAR, GROSS, OTHER_TRACK, USED, Fixes
from railnav.survey.grouping import PRECISE
from railnav.survey.laying import Ground
from railnav.survey.nominal import Nominal, smooth_course, through
from railnav.survey.offsets import HOLD, robust_fit
from railnav.survey.surveyed import GROSS_RATIO, OTHER_SIZE, Surveyed
from railnav.survey.topology import ROUGH_FROM, ROUGH_REACH, ROUGH_TO, TOE_FROM, TOE_REACH, TOE_TO
from railnav.track.records import ModelRecords

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: Shorter ways off the tracks are errors and no tracks, m: of precise runs, of rough ones.
LEAST_WAY, LEAST_ROUGH = 40.0, 300.0
#: A run that has left this much of its way unseen is not tied to where it was before, m.
LOST = 300.0
#: A way that begins so near to an end of a track goes on beyond it, m, and so many sigma of a fix.
AT_END, AT_END_SIGMA = 30.0, 6.0
#: Two runs that keep within this of each other are on one new track, m, or so many sigma of a fix.
TOGETHER, TOGETHER_SIGMA = 1.5, 6.0
SHARE_TOGETHER = 0.7
#: Points of a new course lie so far apart, m, and it is smoothed over so much (Gaussian sigma), m: of precise runs, of rough ones.
THINNING, SMOOTHING = (3.0, 15.0), (8.0, 40.0)
#: Heights of a new course are smoothed over this (Gaussian sigma), m.
LEVELLING = 30.0


@dataclass(frozen=True, slots=True)
class Tie:
    """Where a way leaves a track: its name, the offset on its nodes, m, which end it goes on beyond (None: between the ends)."""

    track: str
    offset: float
    end: int | None


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """A stretch of one run off the model's tracks.

    Attributes
    ----------
    run : int
    fixes : (m,) int array
        Its fixes, in time.
    length : float
        m.
    start, finish : Tie or None
        Where it comes from and goes to; None where the run begins or ends there, or was not seen for long.
    shift : (2,) array
        Frame offset of the run, east and north, as its distances to the model's tracks show it, m.
    sigma : float
        What a fix errs, m.
    """

    run: int
    fixes: IntArray
    length: float
    start: Tie | None
    finish: Tie | None
    shift: FloatArray
    sigma: float


def ways_beyond(tracks: Sequence[Surveyed], fixes: Sequence[Fixes], sigma: Sequence[float]) -> list[Way]:
    """Find the stretches of runs that are on none of the tracks they were laid along."""
    out: list[Way] = []
    for i, f in enumerate(fixes):
        at = np.flatnonzero((f.reason == USED) | (f.reason == FAR) | (f.reason == BEYOND))
        if len(at) < 3:
            continue
        on, offset, right, normal = _placed(i, tracks, f, at)
        shift = _shift(right, normal, sigma[i])
        rest = right - normal @ shift
        limit = max(OTHER_SIZE, GROSS_RATIO * sigma[i])
        off = (on < 0) | (np.abs(rest) > limit)
        least = LEAST_WAY if sigma[i] < PRECISE else LEAST_ROUGH
        xy = np.column_stack([f.easting[at], f.northing[at]])
        for a, b in _stretches(off):
            keep = _kernels.thin(np.ascontiguousarray(xy[a:b, 0]), np.ascontiguousarray(xy[a:b, 1]), 10.0)
            length = float(np.hypot(*np.diff(xy[a:b][keep], axis=0).T).sum())
            if length < least:
                continue
            start, first = _tied(tracks, on, offset, rest, xy, a, -1, sigma[i])
            finish, last = _tied(tracks, on, offset, rest, xy, b - 1, 1, sigma[i])
            out.append(Way(i, at[first : last + 1], length, start, finish, shift, sigma[i]))
    return out


def _placed(
    run: int, tracks: Sequence[Surveyed], f: Fixes, at: IntArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Track, offset, distance to the right and normal of each fix; -1 and NaN where it is on none."""
    on = np.full(len(f), -1, np.int64)
    offset, right = np.full(len(f), np.nan), np.full(len(f), np.nan)
    normal = np.zeros((len(f), 2))
    for number, t in enumerate(tracks):
        if run not in t.runs:
            continue
        laid = t.laid[t.runs.index(run)]
        mine = np.isfinite(laid.offset) & (f.reason == USED)
        node = np.clip(np.rint(laid.offset[mine] / t.nominal.step), 0, len(t.nominal) - 1).astype(np.int64)
        on[mine], offset[mine], right[mine] = number, laid.offset[mine], laid.right[mine]
        normal[mine] = t.design[node]
    return on[at], offset[at], right[at], normal[at]


def _shift(right: FloatArray, normal: FloatArray, sigma: float) -> FloatArray:
    """Frame offset of a run: by the fixes near the tracks where it is precise; none where these are few."""
    known = np.isfinite(right)
    near = known & (np.abs(right) < OTHER_SIZE) if sigma < PRECISE else known
    if np.count_nonzero(near) < max(10, 0.05 * np.count_nonzero(known)):
        return np.zeros(2)
    shift, _ = robust_fit(normal[near], right[near], np.full(2, HOLD))
    return shift


def _stretches(off: BoolArray) -> list[tuple[int, int]]:
    """Stretches (from, to) of fixes that are off; a few that stray on or off between others do as these."""
    from scipy.ndimage import median_filter

    smooth = median_filter(off.astype(np.int8), 7, mode="nearest") > 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], smooth.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 3]


def _tied(
    tracks: Sequence[Surveyed],
    on: IntArray,
    offset: FloatArray,
    rest: FloatArray,
    xy: FloatArray,
    edge: int,
    ahead: int,
    sigma: float,
) -> tuple[Tie | None, int]:
    """Where a way that has its end at a fix is tied to a track, looking `ahead` (-1 before it, 1 after); and the fix there."""
    n = edge + ahead
    if not 0 <= n < len(on) or on[n] < 0 or float(np.hypot(*(xy[n] - xy[edge]))) > LOST:
        return None, edge
    t = tracks[int(on[n])]
    length = (len(t.nominal) - 1) * t.nominal.step
    s = float(offset[n])
    reach = AT_END + AT_END_SIGMA * sigma
    if on[edge] < 0 and min(s, length - s) < reach:
        return Tie(t.name, s, 0 if s < length - s else 1), edge
    low, high, far = (TOE_FROM, TOE_TO, TOE_REACH) if sigma < PRECISE else (ROUGH_FROM, ROUGH_TO, ROUGH_REACH)
    # the root of the distance is a straight line of the offset, its zero the toe
    use = np.flatnonzero(
        (on == on[n]) & (np.abs(offset - s) < 2.0 * far) & (np.abs(rest) > low) & (np.abs(rest) < high)
    )
    side = np.sign(rest[edge]) if np.isfinite(rest[edge]) else 0.0
    use = use[(np.abs(use - edge) < 2000) & ((np.sign(rest[use]) == side) if side else True)]
    toward = np.sign(offset[n] - offset[edge]) if on[edge] == on[n] else 0.0
    toe = s
    if len(use) >= 4 and np.ptp(offset[use]) > 1.0:
        slope, root = np.polyfit(np.sqrt(np.abs(rest[use])), offset[use], 1)
        if toward == 0.0 or slope * toward < 0.0:
            toe = float(np.clip(root, s - far, s + far))
    toe = float(np.clip(toe, 0.0, length))
    # the way begins with the fix that passes the toe
    at = edge
    while 0 <= at + ahead < len(on) and on[at + ahead] == on[n]:
        at += ahead
        if (offset[at] - toe) * (offset[n] - toe) <= 0.0 or abs(offset[at] - toe) > 2.0 * far:
            break
    if abs(offset[at] - toe) > 2.0 * far:
        at = edge
    end = 0 if toe < 1.0 else 1 if toe > length - 1.0 else None
    return Tie(t.name, toe, end), at


@dataclass(frozen=True, slots=True, eq=False)
class Extension:
    """What ways off the tracks become.

    Attributes
    ----------
    grounds : dict
        All tracks: stored, lengthened and new.
    joins : tuple of dict
        As in `ModelRecords`.
    labels : dict
        Directions of the runs that made the new tracks.
    became : list of str
        Of each way the track that it lengthened or made; empty where none could be made.
    causes : list of str
        Why not.
    """

    grounds: dict[str, Ground]
    joins: tuple[dict[str, Any], ...]
    labels: dict[str, set[str]]
    became: list[str]
    causes: list[str]


def extended(
    grounds: Mapping[str, Ground], records: ModelRecords, ways: Sequence[Way], fixes: Sequence[Fixes]
) -> Extension:
    """Lengthen tracks and add new ones where runs go beyond them."""
    out = Extension(dict(grounds), tuple(records.joins), {}, [""] * len(ways), [""] * len(ways))
    joins = list(out.joins)
    taken = {*grounds, *(section for parts in records.parts.values() for section in parts)}
    for group in _groups(ways, fixes):
        leader = max(group, key=lambda w: (_tied_ends(ways[w]), _has_height(fixes[ways[w].run]), ways[w].length))
        way = ways[leader]
        name, cause = _lengthened(out, joins, way, fixes[way.run])
        if not name and not cause:
            name, cause = _added(out, joins, [ways[w] for w in group], way, fixes, taken)
        for w in group:
            out.became[w], out.causes[w] = name, cause
        if name:
            taken.add(name)
            label = {fixes[ways[w].run].run.direction for w in group}
            out.labels.setdefault(name, set()).update(label)
    return replace(out, joins=tuple(joins))


def _tied_ends(way: Way) -> int:
    return (way.start is not None) + (way.finish is not None)


def _has_height(f: Fixes) -> bool:
    return bool(np.isfinite(f.height).any())


def _groups(ways: Sequence[Way], fixes: Sequence[Fixes]) -> list[list[int]]:
    """Ways of runs that keep together."""
    from scipy.spatial import cKDTree

    left = sorted(range(len(ways)), key=lambda w: -ways[w].length)
    groups: list[list[int]] = []
    trees: list[Any] = []
    for w in left:
        xy = _points(ways[w], fixes[ways[w].run])
        for group, tree in zip(groups, trees, strict=True):
            limit = max(TOGETHER, TOGETHER_SIGMA * max(ways[w].sigma, ways[group[0]].sigma))
            spacing = float(np.median(np.hypot(*np.diff(tree.data, axis=0).T)))
            if np.mean(tree.query(xy)[0] < np.hypot(limit, spacing)) >= SHARE_TOGETHER:
                group.append(w)
                break
        else:
            groups.append([w])
            trees.append(cKDTree(xy))
    return groups


def _points(way: Way, f: Fixes) -> FloatArray:
    """Points of a way, its frame offset taken off, thinned so that stops weigh no more than a pass."""
    x, y = f.easting[way.fixes] - way.shift[0], f.northing[way.fixes] - way.shift[1]
    spacing = THINNING[way.sigma >= PRECISE]
    keep: BoolArray = _kernels.thin(x, y, spacing)
    if np.hypot(x[-1] - x[keep][-1], y[-1] - y[keep][-1]) > 0.5 * spacing:
        keep[-1] = True
    return np.column_stack([x, y])[keep]


def _course(way: Way, f: Fixes, head: FloatArray, tail: FloatArray) -> FloatArray:
    """A smooth course of a way from the points before it to those after it."""
    points = np.concatenate([head, _points(way, f), tail])
    step = np.hypot(*np.diff(points, axis=0).T)
    points = points[np.append(True, step > 0.5)]
    rough = way.sigma >= PRECISE
    laid = smooth_course(points, THINNING[rough], SMOOTHING[rough])
    return np.column_stack([laid.easting, laid.northing])


def _levels(way: Way, f: Fixes, xy: FloatArray) -> FloatArray | None:
    """Heights of points along a way by its nearest fixes, smoothed, m; None where it has none."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.spatial import cKDTree

    at = way.fixes[np.isfinite(f.height[way.fixes])]
    if len(at) < 5:
        return None
    _, near = cKDTree(np.column_stack([f.easting[at] - way.shift[0], f.northing[at] - way.shift[1]])).query(xy)
    spacing = float(np.median(np.hypot(*np.diff(xy, axis=0).T)))
    smooth: FloatArray = gaussian_filter1d(f.height[at][near], LEVELLING / spacing, mode="nearest")
    return smooth


def _evenly(xy: FloatArray, step: float) -> FloatArray:
    """Points every `step` metres along a course, the first one included; what is left at the end is dropped."""
    from scipy.interpolate import CubicSpline

    s = np.append(0.0, np.cumsum(np.hypot(*np.diff(xy, axis=0).T)))
    points: FloatArray = np.asarray(CubicSpline(s, xy)(np.arange(0.0, s[-1] + 1e-9, step)), np.float64)
    return points


def _lengthened(out: Extension, joins: list[dict[str, Any]], way: Way, f: Fixes) -> tuple[str, str]:
    """Lengthen the track beyond whose end a way goes; its name, or why not, or nothing where the way begins between ends."""
    for tie, other, outward in ((way.start, way.finish, True), (way.finish, way.start, False)):
        if tie is None or tie.end is None:
            continue
        ground = out.grounds[tie.track]
        if any(j["track"] == tie.track and int(j["end"]) == tie.end for j in joins):
            continue  # that end springs from another track
        known = ground.known
        levels = known is not None and known.height is not None
        if levels and not _has_height(f):
            return "", f"track {tie.track} has heights and run {f.run.id} has none"
        line, back = ground.line, tie.end == 0
        nodes = np.column_stack([line.easting, line.northing])
        nodes = nodes[::-1] if back else nodes
        fixes = way.fixes if outward else way.fixes[::-1]
        course = _course(replace(way, fixes=fixes), f, nodes[-6:], _place(out, other))
        new = _beyond(course, nodes, line.step)
        if len(new) < 2:
            return "", f"it goes less than {2 * line.step:.0f} m beyond the end of track {tie.track}"
        height = ground.height
        if levels and height is not None:
            rise = _levels(way, f, np.concatenate([nodes[-1:], new]))
            assert rise is not None
            last = height[0] if back else height[-1]
            more = rise[1:] + (last - rise[0])
            height = np.concatenate([more[::-1], height]) if back else np.concatenate([height, more])
        xy = np.concatenate([nodes, new])
        xy = xy[::-1] if back else xy
        out.grounds[tie.track] = replace(
            ground,
            line=through(np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1]), line.step),
            height=height,
            first=ground.first + (len(new) if back else 0),
        )
        if other is not None:
            joins.append(_join(out, tie.track, tie.end, other))
        return tie.track, ""
    return "", ""


def _beyond(course: FloatArray, nodes: FloatArray, step: float) -> FloatArray:
    """Nodes every step metres of a course beyond the last of the nodes, in line with it."""
    ahead = nodes[-1] - nodes[-2]
    ahead /= np.hypot(*ahead)
    near = int(np.argmin(np.hypot(*(course - nodes[-1]).T)))
    rest = course[near:]
    rest = rest[(rest - nodes[-1]) @ ahead > 0.25 * step] if len(rest) and near == 0 else rest
    far = np.hypot(*(rest - nodes[-1]).T) > 0.5 * step if len(rest) else np.zeros(0, np.bool_)
    rest = rest[int(np.argmax(far)) :] if far.any() else rest[:0]
    if len(rest) < 2:
        return np.zeros((0, 2))
    return _evenly(np.concatenate([nodes[-1:], rest]), step)[1:]


def _place(out: Extension, tie: Tie | None) -> FloatArray:
    """The point of a tie, (1, 2) m, or none."""
    if tie is None:
        return np.zeros((0, 2))
    line = out.grounds[tie.track].line
    at = float(np.clip(tie.offset / line.step, 0, len(line) - 1))
    nodes = np.arange(len(line))
    return np.array([[np.interp(at, nodes, line.easting), np.interp(at, nodes, line.northing)]])


def _join(out: Extension, track: str, end: int, tie: Tie) -> dict[str, Any]:
    (place,) = _place(out, tie)
    return {
        "track": track,
        "end": end,
        "parent": tie.track,
        "easting_m": float(place[0]),
        "northing_m": float(place[1]),
    }


def _added(
    out: Extension,
    joins: list[dict[str, Any]],
    group: Sequence[Way],
    leader: Way,
    fixes: Sequence[Fixes],
    taken: set[str],
) -> tuple[str, str]:
    """Add the track that the ways of a group show; its name, or why not."""
    if leader.start is None and leader.finish is None:
        return "", "it is tied to no track of the model"
    f = fixes[leader.run]
    ties = [_toe(group, leader, finish) for finish in (False, True)]
    course = _course(leader, f, _place(out, ties[0]), _place(out, ties[1]))
    step = step_for(leader.sigma)
    xy = _evenly(course, step)
    if len(xy) < 6:
        return "", f"it is shorter than {6 * step:.0f} m"
    line: Nominal = through(np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1]), step)
    base = f.run.direction or "track"
    number, name = 1, base
    while name in taken:
        number += 1
        name = f"{base}-{number}"
    out.grounds[name] = Ground(name, line, _levels(leader, f, xy), None)
    joins += [_join(out, name, end, tie) for end, tie in enumerate(ties) if tie is not None]
    return name, ""


def _toe(group: Sequence[Way], leader: Way, finish: bool) -> Tie | None:
    """Where the track of a group springs from another one: in the middle of what its runs say."""
    tie = leader.finish if finish else leader.start
    if tie is None:
        return None
    said = [
        other.offset
        for way in group
        for other in (way.start, way.finish)
        if other is not None and other.track == tie.track and abs(other.offset - tie.offset) < TOE_REACH
    ]
    return replace(tie, offset=float(np.median(said)))


def laid_anew(ground: Ground, axis: FloatArray, rise: FloatArray | None, seen: BoolArray) -> Ground:
    """The new nodes of a track moved to where they were found, and those at its ends that no fix supports left out.

    Parameters
    ----------
    ground : Ground
    axis, rise : (N,) array
        Found to the right, and up where there are heights, m; stored nodes stay.
    seen : (N,) bool array
        Nodes with fixes.
    """
    stored = ground.stored()
    if stored.all():
        return ground
    e, n = ground.line.normal
    y = np.where(stored, 0.0, axis)
    east, north = ground.line.easting + y * e, ground.line.northing + y * n
    height = ground.height
    if height is not None and rise is not None:
        height = height + np.where(stored, 0.0, rise)
    at = np.flatnonzero(stored | seen)
    a, b = int(at[0]), int(at[-1]) + 1
    return replace(
        ground,
        line=through(east[a:b].copy(), north[a:b].copy(), ground.line.step),
        height=None if height is None else height[a:b],
        first=ground.first - a,
    )


def judged_again(fixes: Sequence[Fixes]) -> None:
    """Let the verdicts of one laying not stand in the next."""
    for f in fixes:
        f.reason[np.isin(f.reason, (GROSS, OTHER_TRACK, CONTRADICTS, FAR, BEYOND))] = USED


def beside(t: Surveyed, ways: Sequence[Way]) -> BoolArray:
    """Nodes (N,) of a track that runs are laid along though they are on ways of their own there."""
    out = np.zeros(len(t.nominal), np.bool_)
    for way in ways:
        if way.run not in t.runs:
            continue
        offset = t.laid[t.runs.index(way.run)].offset[way.fixes]
        offset = offset[np.isfinite(offset)]
        if len(offset):
            a, b = int(offset.min() / t.nominal.step), int(offset.max() / t.nominal.step)
            out[max(a - 1, 0) : b + 2] = True
    return out


def told_ways(ways: Sequence[Way], fixes: Sequence[Fixes], extension: Extension | None) -> list[dict[str, Any]]:
    """The ways as JSON values, for the report of an update."""
    out = []
    for number, way in enumerate(ways):
        f = fixes[way.run]
        became = extension.became[number] if extension is not None else ""
        out.append(
            {
                "run": f.run.id,
                "from_s": round(float(f.time[way.fixes[0]]), 1),
                "to_s": round(float(f.time[way.fixes[-1]]), 1),
                "length_m": round(way.length, 1),
                "fixes": len(way.fixes),
                "where": _where(way),
                "became": became or None,
                "cause": extension.causes[number] if extension is not None and not became else "",
            }
        )
    return out


def _where(way: Way) -> str:
    """Where a way is, in words."""
    ties = [tie for tie in (way.start, way.finish) if tie is not None]
    if not ties:
        return "away from the model's tracks"
    if len(ties) == 2 and ties[0].track == ties[1].track and all(tie.end is None for tie in ties):
        a, b = sorted(tie.offset for tie in ties)
        return f"beside track {ties[0].track} from offset {a:.0f} to {b:.0f} m"
    return " and ".join(
        f"beyond the {'start' if tie.end == 0 else 'end'} of track {tie.track}"
        if tie.end is not None
        else f"off track {tie.track} at offset {tie.offset:.0f} m"
        for tie in ties
    )


def ways_in_words(told: Sequence[Mapping[str, Any]]) -> list[str]:
    """Warnings about ways that became no track; ways of several runs in one place are one warning."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for way in told:
        if way["became"] is None:
            groups.setdefault(_alike(str(way["where"])), []).append(way)
    out = []
    for members in groups.values():
        first = max(members, key=lambda way: float(way["length_m"]))
        runs = (
            f"run {first['run']} goes" if len(members) == 1 else f"{len(members)} runs ({first['run']} and others) go"
        )
        end = f": {first['cause']}" if first["cause"] else "; `railnav update --extend` makes track of it"
        out.append(f"{runs} {first['length_m']:.0f} m {first['where']}, which the model does not have{end}")
    return out


def _alike(where: str) -> str:
    """The words without their numbers."""
    return " ".join(word for word in where.split() if not word.isdigit())
