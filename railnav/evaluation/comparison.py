"""A solution beside the truth, epoch by epoch: errors along and across the track, and whether the track is right.

Truth is interpolated to the solution's instants. Along the way the truth spans one coordinate: metres in the direction of the nose,
affine in the offset during each visit of a track. A solution on a track that the train visits about then has its error measured on
that coordinate, so that an error of two metres stays two metres when a joint lies between.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError
from railnav.geodesy.ellipsoid import WGS84
from railnav.navigation.solution import Solution
from railnav.truth import Truth
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: A visit of a track further away in time than this is another visit, s.
VISIT_WINDOW = 120.0

#: A solution that never comes nearer to the truth than this is of another run, m.
ANOTHER_RUN = 10_000.0


@dataclass(frozen=True, slots=True, eq=False)
class Visits:
    """The truth's stays on tracks, one after another.

    Attributes
    ----------
    first, last : (v,) int array
        Rows of the truth, both inclusive.
    track : (v,) int array
        Index into the truth's tracks.
    sense : (v,) int array
        +1 where the nose points to growing offset, -1 otherwise.
    origin : (v,) array
        Coordinate along the way = origin + sense * offset, m.
    """

    first: IntArray
    last: IntArray
    track: IntArray
    sense: IntArray
    origin: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Errors of every epoch that truth covers; (m,) arrays, NaN where the solution has no position.

    Attributes
    ----------
    row : (m,) int array
        Row of the solution.
    time : (m,) array
        s.
    way : (m,) array
        The truth's coordinate along the way, m.
    along, across : (m,) array
        Solution minus truth: ahead of the nose, and to the right of it, m.
    speed : (m,) array
        Solution minus truth, m/s.
    right : (m,) bool array
        The track is the true one, or the next one on the train's path when a small error along explains it.
    across_joint : (m,) bool array
        Right only in this second sense.
    true_track : (m,) int array
        Index into the truth's tracks.
    by_name : bool
        Tracks compared by identifier; otherwise by distance across.
    """

    row: IntArray
    time: FloatArray
    way: FloatArray
    along: FloatArray
    across: FloatArray
    speed: FloatArray
    right: BoolArray
    across_joint: BoolArray
    true_track: IntArray
    by_name: bool


def visits_of(truth: Truth) -> Visits:
    """Split a truth into visits of tracks and give the way one coordinate.

    Parameters
    ----------
    truth : Truth
        At least one row.

    Returns
    -------
    Visits
    """
    change = np.flatnonzero(np.diff(truth.track)) + 1
    first = np.append(0, change)
    last = np.append(change - 1, len(truth) - 1)
    sense = np.ones(len(first), np.int64)
    for v, (a, b) in enumerate(zip(first, last, strict=True)):
        moved = np.diff(truth.offset[a : b + 1])
        mean = 0.5 * (truth.speed[a:b] + truth.speed[a + 1 : b + 1])
        agree = float((moved * mean).sum())
        if agree != 0.0:
            sense[v] = 1 if agree > 0.0 else -1
        elif v > 0 and a == b:  # one row on a short track: as before
            sense[v] = sense[v - 1]
    origin = np.empty(len(first))
    way = 0.0
    for v, (a, b) in enumerate(zip(first, last, strict=True)):
        if v > 0:
            way += 0.5 * float(truth.speed[a - 1] + truth.speed[a]) * float(truth.time[a] - truth.time[a - 1])
        origin[v] = way - sense[v] * truth.offset[a]
        way = origin[v] + sense[v] * float(truth.offset[b])
    return Visits(first, last, truth.track[first].astype(np.int64), sense, origin)


def _hermite(
    u: FloatArray, step: FloatArray, y0: FloatArray, y1: FloatArray, d0: FloatArray, d1: FloatArray
) -> FloatArray:
    """Cubic through values and slopes at both ends of intervals."""
    u2, u3 = u * u, u * u * u
    return np.asarray(
        (2 * u3 - 3 * u2 + 1) * y0 + (u3 - 2 * u2 + u) * step * d0 + (3 * u2 - 2 * u3) * y1 + (u3 - u2) * step * d1
    )


@dataclass(frozen=True, slots=True, eq=False)
class _TruthAt:
    """Truth at given instants."""

    way: FloatArray
    visit: IntArray
    latitude: FloatArray
    longitude: FloatArray
    height: FloatArray
    heading: FloatArray
    speed: FloatArray


def truth_at(truth: Truth, visits: Visits, time: FloatArray) -> _TruthAt:
    """Interpolate truth to instants inside its time: cubic in the way and the position, linear in speed and heading."""
    if len(truth) == 1:
        i, u, step = np.zeros(len(time), np.int64), np.zeros(len(time)), np.ones(len(time))
        j = i
    else:
        i = np.clip(np.searchsorted(truth.time, time, side="right") - 1, 0, len(truth) - 2)
        j = i + 1
        step = truth.time[j] - truth.time[i]
        u = (time - truth.time[i]) / step
    visit_of_row = np.repeat(np.arange(len(visits.first)), visits.last - visits.first + 1)
    way = visits.origin[visit_of_row] + visits.sense[visit_of_row] * truth.offset
    height = np.nan_to_num(truth.height)
    meridian = WGS84.meridian_radius(truth.latitude) + height
    transverse = (WGS84.transverse_radius(truth.latitude) + height) * np.cos(truth.latitude)
    north, east = truth.speed * np.cos(truth.heading) / meridian, truth.speed * np.sin(truth.heading) / transverse
    return _TruthAt(
        way=_hermite(u, step, way[i], way[j], truth.speed[i], truth.speed[j]),
        visit=np.where(u < 0.5, visit_of_row[i], visit_of_row[j]),
        latitude=_hermite(u, step, truth.latitude[i], truth.latitude[j], north[i], north[j]),
        longitude=_hermite(u, step, truth.longitude[i], truth.longitude[j], east[i], east[j]),
        height=(1 - u) * height[i] + u * height[j],
        heading=truth.heading[i] + u * wrap_angle(truth.heading[j] - truth.heading[i]),
        speed=(1 - u) * truth.speed[i] + u * truth.speed[j],
    )


def compare(
    solution: Solution,
    truth: Truth,
    *,
    by: str = "auto",
    joint_within: float = 25.0,
    track_within: float = 1.9,
) -> Comparison:
    """Errors of a solution at every epoch that truth covers.

    Parameters
    ----------
    solution : Solution
    truth : Truth
    by : {"auto", "name", "distance"}
        How tracks are compared. "name": by identifier, where both come from one model. "distance": right when the solution's
        position is within `track_within` of the true one across, where the model was built anew and names its tracks otherwise.
        "auto": by name when solution and truth have any track in common.
    joint_within : float
        A track that the train visits just before or after counts as right when the error along the way is no more than this, m.
    track_within : float
        Largest distance across on the right track, m: just under half the usual distance of tracks.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        An empty solution or truth, no common time, a solution that is kilometres from the truth all the time, or a `by` that is none
        of the three.

    Notes
    -----
    A solution that names no tracks at all (of a scheme without a map) has errors along and across the true heading, and no track that
    could be wrong.

    Where the solution is on a track that the train does not visit within two minutes, the error along is the offset between the
    positions projected on the true heading.
    """
    if by not in {"auto", "name", "distance"}:
        raise InputError(f"tracks are compared by 'auto', 'name' or 'distance', not {by!r}")
    for what, table in (("solution", solution), ("truth", truth)):
        if len(table) == 0:
            raise InputError(f"the {what} has no rows")
    begin, end = float(truth.time[0]), float(truth.time[-1])
    row = np.flatnonzero((solution.time >= begin - 1e-6) & (solution.time <= end + 1e-6)).astype(np.int64)
    if len(row) == 0:
        raise InputError(
            f"solution ({solution.time[0]:g} to {solution.time[-1]:g} s) and truth ({begin:g} to {end:g} s) have no common time",
            remedy="evaluate a solution against the truth of the same run",
        )
    time = np.clip(solution.time[row], begin, end)
    visits = visits_of(truth)
    here = truth_at(truth, visits, time)

    names = {name: i for i, name in enumerate(truth.track_id)}
    index = np.array([names.get(name, -1) for name in solution.track_id] + [-1], np.int64)
    track = np.where(solution.track[row] >= 0, index[solution.track[row]], -1)
    used = {solution.track_id[t] for t in np.unique(solution.track[row]) if t >= 0}
    free = not used and bool(
        np.isfinite(solution.latitude[row]).any()
    )  # of a scheme without a map: places, but no tracks
    by_name = not free and (by == "name" or (by == "auto" and bool(used & set(truth.track_id) or not used)))

    north = (solution.latitude[row] - here.latitude) * (WGS84.meridian_radius(here.latitude) + here.height)
    east = (
        wrap_angle(solution.longitude[row] - here.longitude)
        * (WGS84.transverse_radius(here.latitude) + here.height)
        * np.cos(here.latitude)
    )
    ahead = north * np.cos(here.heading) + east * np.sin(here.heading)
    across = east * np.cos(here.heading) - north * np.sin(here.heading)
    positioned = (solution.track[row] >= 0) & np.isfinite(solution.offset[row])
    if free:
        positioned = np.isfinite(solution.latitude[row]) & np.isfinite(solution.longitude[row])
    apart = np.hypot(north, east)[positioned]
    if len(apart) and apart.min() > ANOTHER_RUN:
        raise InputError(
            f"the solution nowhere comes nearer to the truth than {apart.min() / 1000:.1f} km",
            remedy="evaluate a solution against the truth of the same run",
        )
    along = np.where(positioned, ahead, np.nan)
    true_track = visits.track[here.visit]
    if by_name:
        measured, on_path = _along_the_way(solution.offset[row], track, time, here.way, truth, visits)
        along = np.where(on_path & positioned, measured, along)
        same = positioned & (track == true_track)
        joint = positioned & ~same & on_path & (np.abs(measured) <= joint_within)
        right = same | joint
    else:
        right = positioned if free else positioned & (np.abs(across) <= track_within)
        joint = np.zeros(len(row), bool)
    return Comparison(
        row=row,
        time=solution.time[row],
        way=here.way,
        along=along,
        across=np.where(positioned, across, np.nan),
        speed=np.where(positioned, solution.speed[row] - here.speed, np.nan),
        right=right,
        across_joint=joint,
        true_track=true_track,
        by_name=by_name,
    )


def _along_the_way(
    offset: FloatArray, track: IntArray, time: FloatArray, way: FloatArray, truth: Truth, visits: Visits
) -> tuple[FloatArray, BoolArray]:
    """Error on the truth's coordinate by the visit of the same track nearest in time; and where there is such a visit."""
    error = np.full(len(offset), np.nan)
    gap = np.full(len(offset), np.inf)
    began, ended = truth.time[visits.first], truth.time[visits.last]
    for v, t in enumerate(visits.track):
        here = np.flatnonzero(track == t)
        away = np.maximum(np.maximum(began[v] - time[here], time[here] - ended[v]), 0.0)
        nearer = here[(away <= VISIT_WINDOW) & (away < gap[here])]
        gap[nearer] = np.maximum(np.maximum(began[v] - time[nearer], time[nearer] - ended[v]), 0.0)
        error[nearer] = visits.origin[v] + visits.sense[v] * offset[nearer] - way[nearer]
    return error, np.isfinite(error)
