"""Runs sorted into lines, ways and tracks, each laid along a first nominal curve; and where tracks spring from each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.survey import surveyed
from railnav.survey.fixes import Fixes
from railnav.survey.grouping import tracks_of_line
from railnav.survey.nominal import Nominal, lines, smooth_course
from railnav.survey.report import Survey
from railnav.survey.surveyed import Surveyed
from railnav.survey.topology import Branch, Way, parted_lines, precise, ways_of_line

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Distance between nodes while the lie of the runs is not known, m, and where precise runs are parted into ways.
COARSE_STEP, FINE_STEP = 20.0, 5.0
#: Smoothing of the first nominal curve (Gaussian sigma), m; of a way's, m.
SMOOTHING, WAY_SMOOTHING = 40.0, 5.0
#: Reach of the first nominal curve, m: two tracks of a line part this far at most.
LINE_REACH = 150.0


@dataclass(frozen=True, slots=True)
class Join:
    """One end of a track that springs from another one: which track, which end (0 start, 1 finish), its parent, and about where, m."""

    track: str
    end: int
    parent: str
    easting: float
    northing: float


def lay_out(survey: Survey) -> tuple[list[Surveyed], list[Join]]:
    """Sort runs into lines and tracks, and lay each track's runs along its first nominal curve."""
    fixes = survey.fixes
    tracks: list[Surveyed] = []
    joins: list[Join] = []
    network = parted_lines(lines(survey.courses))
    for number, line in enumerate(network.lines):
        branches = [b for b in network.branches if b.parent == number]
        members = tuple(line.members)
        masks = tuple(_off_branches(fixes[i], [b for b in branches if i in b.members]) for i in members)
        nominal = smooth_course(line.course, COARSE_STEP, SMOOTHING)
        whole = surveyed.lay("", members, fixes, nominal, reach=LINE_REACH, masks=masks)
        if whole.laid[0].sense < 0:  # offsets grow as the first run went
            nominal = nominal.reversed()
            whole = surveyed.lay("", members, fixes, nominal, reach=LINE_REACH, masks=masks)
        if branches:
            name = survey.name_track((max(line.members, key=lambda i: len(survey.courses[i])),), tracks)
            tracks.append(surveyed.lay(name, members, fixes, nominal, reach=LINE_REACH, masks=masks))
            for branch in branches:
                own = _branch(survey, branch, tracks)
                tracks.append(own)
                joins += [
                    Join(own.name, end, name, float(at[0]), float(at[1]))
                    for end, at, springs in (
                        (0, branch.course[0], branch.at_start),
                        (1, branch.course[-1], branch.at_finish),
                    )
                    if springs
                ]
            continue
        ways = None
        if precise(whole.profile.right, whole.design):
            fine = surveyed.lay("", members, fixes, nominal.resampled(FINE_STEP), reach=LINE_REACH)
            ways = ways_of_line(fine.profile.right, fine.design, fine.nominal.step)
        if ways is not None:
            found = _ways(survey, fine, ways, tracks)
            tracks += found
            joins += _joins(fine, ways, found)
            continue
        groups, warnings = tracks_of_line(
            whole.profile.right,
            whole.design,
            [fixes[i].run.direction for i in members],
            [t.sense for t in whole.laid],
            [fixes[i].run.id for i in members],
        )
        survey.warnings += warnings
        for group in groups:
            who = tuple(members[i] for i in group)
            tracks.append(surveyed.lay(survey.name_track(who, tracks), who, fixes, nominal, reach=LINE_REACH))
    tracks = [t for t in tracks if t.profile.present.any()]
    kept = {t.name for t in tracks}
    return tracks, [j for j in joins if j.track in kept and j.parent in kept]


def _off_branches(f: Fixes, branches: list[Branch]) -> BoolArray | None:
    """Fixes of a run that are on none of the branches that it follows; None for all of them."""
    if not branches:
        return None
    out = np.ones(len(f), np.bool_)
    for branch in branches:
        out &= ~_on_branch(f, branch)
    return out


def _on_branch(f: Fixes, branch: Branch) -> BoolArray:
    """Fixes whose nearest point of a branch is not the toe that it springs from."""
    from scipy.spatial import cKDTree

    _, at = cKDTree(branch.course).query(np.column_stack([f.easting, f.northing]))
    on = np.ones(len(f), np.bool_)
    if branch.at_start:
        on &= at > 0
    if branch.at_finish:
        on &= at < len(branch.course) - 1
    return np.asarray(on)


def _branch(survey: Survey, branch: Branch, tracks: list[Surveyed]) -> Surveyed:
    """The track of a branch, from its toe."""
    members = tuple(branch.members)
    masks = tuple(_on_branch(survey.fixes[i], branch) for i in members)
    nominal = smooth_course(branch.course, COARSE_STEP, SMOOTHING)
    name = survey.name_track((max(members, key=lambda i: len(survey.courses[i])),), tracks)
    return surveyed.lay(name, members, survey.fixes, nominal, reach=LINE_REACH, masks=masks)


def _ways(survey: Survey, fine: Surveyed, ways: list[Way], tracks: list[Surveyed]) -> list[Surveyed]:
    """Tracks of the ways of precise runs."""
    from scipy.ndimage import gaussian_filter1d

    step = fine.nominal.step
    found: list[Surveyed] = []
    for way in ways:
        a, b = max(0, int(np.floor(way.first))), min(len(fine.nominal) - 1, int(np.ceil(way.last)))
        leader = way.leader[min(way.leader, key=lambda n: abs(n - 0.5 * (a + b)))]
        right = fine.profile.right[leader, a : b + 1]
        known = np.flatnonzero(np.isfinite(right))
        y = np.interp(np.arange(b + 1 - a), known, right[known])
        y = gaussian_filter1d(y, WAY_SMOOTHING / step, mode="nearest")
        nominal = fine.nominal.part(a, b + 1).shifted(y)
        rows = sorted({j for j, _, _ in way.members})
        masks = []
        for j in rows:
            s = fine.laid[j].offset / step
            mask = np.zeros(len(s), np.bool_)
            for k, u, v in way.members:
                if k == j:
                    with np.errstate(invalid="ignore"):
                        mask |= (s >= u - 0.5) & (s <= v + 0.5)
            masks.append(mask)
        who = tuple(fine.runs[j] for j in rows)
        name = survey.name_track(who, [*tracks, *found])
        found.append(surveyed.lay(name, who, survey.fixes, nominal, masks=tuple(masks)))
    return found


def _joins(fine: Surveyed, ways: list[Way], found: list[Surveyed]) -> list[Join]:
    """Where ways spring from each other."""
    out = []
    for way, own in zip(ways, found, strict=True):
        for end, at in ((0, way.start), (1, way.finish)):
            if at is None:
                continue
            other, node = at
            east, north = _place(fine, ways[other], node)
            out.append(Join(own.name, end, found[other].name, east, north))
    return out


def _place(fine: Surveyed, way: Way, node: float) -> tuple[float, float]:
    """Grid position of a node of a way."""
    n = int(np.clip(round(node), 0, len(fine.nominal) - 1))
    leader = way.leader[min(way.leader, key=lambda k: abs(k - n))]
    right = fine.profile.right[leader]
    known = np.flatnonzero(np.isfinite(right))
    y = float(np.interp(n, known, right[known]))
    nominal: Nominal = fine.nominal
    e, north = nominal.normal
    return float(nominal.easting[n] + y * e[n]), float(nominal.northing[n] + y * north[n])
