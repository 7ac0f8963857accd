"""Designed alignments as values: plan, profile, cant and stations of one track, as exchange formats write them.

A model's knots have no elements any more. `designed_track` finds the longest straights, arcs and clothoids that pass the knots within
a fraction of a millimetre, parabolas for the profile and straight ramps for the cant: what a design program can read, and what
gives the same curve when it is read back.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.io.design import ARC, CLOTHOID, STRAIGHT, Cant, Plan
from railnav.track.model import TrackModel
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Curvature below this is none, 1/m: a radius of 1,000 km leaves its tangent by 5 mm in 100 m.
STRAIGHTEST = 1e-6
#: Of a transition, an end that bends less than this is straight, 1/m.
FLATTEST = 1e-8
#: A simpler element is preferred until another reaches this many times further.
_WORTH = 1.25
#: Stations that agree within this need no equation, m.
_SAME_STATION = 0.01
#: Behind the start of an alignment, where an equation turns the sense of its stations, m.
_TURN_STATIONS = 1e-3

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


@dataclass(frozen=True, slots=True, eq=False)
class VerticalPoints:
    """Points of vertical intersection: (n,) arrays in order, n >= 2; no curve at the first and last.

    Attributes
    ----------
    along : (n,) array
        Grid lengths from the track's start, m, strictly increasing.
    height : (n,) array
        Heights of the tangents' intersections, m.
    curve_length : (n,) array
        Length in plan of the symmetric parabola at each, m; 0 without.
    radius : (n,) array
        Radius of the circle at each, m, positive; 0 without. A point has a parabola or a circle, not both.
    """

    along: FloatArray
    height: FloatArray
    curve_length: FloatArray
    radius: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class DesignedAlignment:
    """One designed track, ready to be written.

    Attributes
    ----------
    name : str
        Unique identifier.
    plan : Plan
        Its elements (`railnav.io.design`): grid lengths, kinds, curvatures positive to the right, starts.
    vertical : VerticalPoints, optional
        Its profile.
    cant : Cant, optional
        By grid length, m, left rail high positive.
    start_station : float, optional
        Chainage at the start, m; None where there is no chainage.
    equations : tuple of (grid length, station ahead, sense)
        Where stations jump: grid length from the start, the station that counts from there, +1.0 or -1.0 for stations that grow or fall.
    line, description : str
        Published line; free name.
    """

    name: str
    plan: Plan
    vertical: VerticalPoints | None = None
    cant: Cant | None = None
    start_station: float | None = None
    equations: tuple[tuple[float, float, float], ...] = field(default=())
    line: str = ""
    description: str = ""


def designed_track(model: TrackModel, track: str, *, tolerance: float = 2e-4) -> DesignedAlignment:
    """Find the elements that a track of a model runs through.

    Parameters
    ----------
    model : TrackModel
        Where the track is.
    track : str
        Its identifier.
    tolerance : float
        Greatest distance of the elements from the knots, m, in plan and in height; a tenth of it in cant.

    Returns
    -------
    DesignedAlignment
        Straights, arcs and clothoids; other transition laws come as several clothoids. Stations have an equation wherever the
        model's posts leave them by more than 10 mm.

    Raises
    ------
    TrackError
        An unknown track, or a tolerance that is not positive.

    Examples
    --------
    >>> from railnav import demo_line
    >>> model = demo_line()
    >>> found = designed_track(model, model.track_id[0])
    >>> len(found.plan.length) < 60
    True
    """
    if not tolerance > 0.0:
        raise TrackError(f"a tolerance of {tolerance} m is not positive; use 0.2 mm")
    own = model.knots(track)
    point = np.column_stack([model.easting[own], model.northing[own]])
    bearing = np.unwrap(model.grid_bearing[own])
    height, scale, slope = model.height[own], model.scale[own], model.gradient[own] / model.scale[own]
    known = bool(np.isfinite(height).all())
    bend = model.curvature[own] * np.hypot(1.0 / scale, slope if known else 0.0)  # in the grid
    chord = np.hypot(*np.diff(point, axis=0).T)
    half = 0.5 * np.diff(bearing)
    along = np.append(0.0, np.cumsum(chord / np.sinc(half / np.pi)))  # arc over chord
    plan = _plan(point, bearing, bend, along, tolerance)
    vertical = _vertical(along, height, slope, tolerance) if known else None
    cant = _cant(along, model.cant[own], 0.1 * tolerance)
    index = model.track_index(track)
    start, equations = _stations(model, index, along, model.offset[own])
    return DesignedAlignment(track, plan, vertical, cant, start, equations, model.line[index], model.name[index])


def designed_tracks(model: TrackModel, *, tolerance: float = 2e-4) -> list[DesignedAlignment]:
    """Every track of a model; see `designed_track`."""
    return [designed_track(model, track, tolerance=tolerance) for track in model.track_id]


# --- plan -------------------------------------------------------------------------------------------------------------


def _plan(point: FloatArray, bearing: FloatArray, bend: FloatArray, along: FloatArray, tolerance: float) -> Plan:
    """Greedy: from every joint, the furthest knot that one element reaches."""
    rows: list[tuple[float, int, float, float, float, float, float]] = []
    i, last = 0, len(along) - 1
    while i < last:
        best = (i + 1, STRAIGHT)
        for kind in (STRAIGHT, ARC, CLOTHOID):
            j = _reach(point, bearing, bend, along, i, kind, tolerance)
            if j is not None and (j - i > _WORTH * (best[0] - i) or (j == last and best[0] < last)):
                best = (j, kind)
        j, kind = best
        if j == i + 1 and _misfit(point, bearing, bend, along, i, j, STRAIGHT)[0] > tolerance:
            kind = ARC
        _, start, k0, k1 = _misfit(point, bearing, bend, along, i, j, kind)
        if kind != STRAIGHT and max(abs(k0), abs(k1)) < STRAIGHTEST:
            kind, k0, k1 = STRAIGHT, 0.0, 0.0
        rows.append((along[j] - along[i], kind, k0, k1, point[i, 0], point[i, 1], start))
        i = j
    length, kind_, k0_, k1_, east, north, start_ = (np.array(column) for column in zip(*rows, strict=True))
    return Plan(length, kind_.astype(np.int64), k0_, k1_, east, north, wrap_angle(start_), np.zeros(len(rows)))


def _reach(
    point: FloatArray, bearing: FloatArray, bend: FloatArray, along: FloatArray, i: int, kind: int, tolerance: float
) -> int | None:
    """The furthest knot that an element of this kind reaches from knot i within the tolerance; None where none."""
    last = len(along) - 1

    def fits(j: int) -> bool:
        return _misfit(point, bearing, bend, along, i, j, kind)[0] <= tolerance

    if not fits(i + 1):
        return None
    good, step = i + 1, 2
    while good < last:
        bad = min(good + step, last)
        if not fits(bad):
            break
        good, step = bad, 2 * step
    else:
        return good
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (middle, bad) if fits(middle) else (good, middle)
    return good


def _misfit(
    point: FloatArray, bearing: FloatArray, bend: FloatArray, along: FloatArray, i: int, j: int, kind: int
) -> tuple[float, float, float, float]:
    """Greatest distance of knots i..j from the element, and its start bearing and curvatures."""
    chord = point[j] - point[i]
    if kind == STRAIGHT:
        width = float(np.hypot(*chord))
        off = (point[i : j + 1, 0] - point[i, 0]) * chord[1] - (point[i : j + 1, 1] - point[i, 1]) * chord[0]
        kink = max(abs(_wrapped(bearing[k] - np.arctan2(chord[0], chord[1]))) for k in (i, j))
        misfit = float(np.abs(off).max()) / width
        return (misfit if kink < 1e-3 else np.inf), float(np.arctan2(chord[0], chord[1])), 0.0, 0.0
    s = along[i : j + 1] - along[i]
    length, turned = float(s[-1]), float(bearing[j] - bearing[i])
    mean = turned / length
    rate = 0.0
    if kind == CLOTHOID:  # bearing = start + (mean - rate L / 2) s + rate s^2 / 2
        shape = 0.5 * s * (s - length)
        within = bearing[i : j + 1] - bearing[i] - mean * s
        square = float(shape @ shape)
        rate = float(shape @ within) / square if square > 0.0 else float(bend[j] - bend[i]) / length
    k0, k1 = mean - 0.5 * rate * length, mean + 0.5 * rate * length
    if k0 * k1 < 0.0 or min(abs(k0), abs(k1)) < FLATTEST < max(abs(k0), abs(k1)):  # an element bends to one side
        k0, k1 = (0.0, 2.0 * mean) if abs(k0) < abs(k1) else (2.0 * mean, 0.0)
        rate = (k1 - k0) / length
    middle, width_ = 0.5 * (s[1:] + s[:-1]), np.diff(s)
    u = middle[:, None] + 0.5 * width_[:, None] * _NODES
    theta = bearing[i] + k0 * u + 0.5 * rate * u * u
    east = np.append(0.0, np.cumsum(0.5 * width_ * (np.sin(theta) @ _WEIGHTS)))
    north = np.append(0.0, np.cumsum(0.5 * width_ * (np.cos(theta) @ _WEIGHTS)))
    # turn the element so that it meets the last knot: what is left is shape
    swing = float(_wrapped(np.arctan2(chord[0], chord[1]) - np.arctan2(east[-1], north[-1])))
    c, w = np.cos(swing), np.sin(swing)
    e, n = point[i, 0] + c * east + w * north, point[i, 1] - w * east + c * north
    misfit = float(np.hypot(e - point[i : j + 1, 0], n - point[i : j + 1, 1]).max())
    if abs(swing) > 1e-3:
        misfit = np.inf
    return misfit, float(bearing[i]) + swing, k0, k1


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)


# --- profile, cant, stations ------------------------------------------------------------------------------------------


def _vertical(along: FloatArray, height: FloatArray, slope: FloatArray, tolerance: float) -> VerticalPoints:
    """Pairs of parabolas that keep height and slope at their joints; a straight where one is enough."""

    def pair(i: int, j: int) -> tuple[float, float]:
        """Slope in the middle, and the greatest misfit of the knots between."""
        width = along[j] - along[i]
        middle = 2.0 * (height[j] - height[i]) / width - 0.5 * (slope[i] + slope[j])
        x = along[i : j + 1] - along[i]
        half = 0.5 * width
        near = height[i] + slope[i] * x + (middle - slope[i]) / width * x * x
        y = x - half
        at_half = height[i] + 0.5 * half * (slope[i] + middle)
        far = at_half + middle * y + (slope[j] - middle) / width * y * y
        return float(middle), float(np.abs(np.where(x <= half, near, far) - height[i : j + 1]).max())

    points: list[tuple[float, float, float]] = [(float(along[0]), float(height[0]), 0.0)]
    i, last = 0, len(along) - 1
    while i < last:
        good, step = i + 1, 2
        bad = good
        while good < last:
            bad = min(good + step, last)
            if pair(i, bad)[1] > tolerance:
                break
            good, step = bad, 2 * step
        while good < last and bad - good > 1:
            mid = (good + bad) // 2
            good, bad = (mid, bad) if pair(i, mid)[1] <= tolerance else (good, mid)
        middle, _ = pair(i, good)
        half = 0.5 * (along[good] - along[i])
        if max(abs(middle - slope[i]), abs(middle - slope[good])) > 1e-9:
            rise = height[i] + 0.5 * half * (slope[i] + middle)
            points.append((float(along[i] + 0.5 * half), float(height[i] + 0.5 * half * slope[i]), float(half)))
            points.append((float(along[i] + 1.5 * half), float(rise + 0.5 * half * middle), float(half)))
        elif good < last:
            points.append((float(along[good]), float(height[good]), 0.0))
        i = good
    points.append((float(along[-1]), float(height[-1]), 0.0))
    table = np.array(points).T
    return VerticalPoints(table[0], table[1], table[2], np.zeros(len(points)))


def _cant(along: FloatArray, cant: FloatArray, tolerance: float) -> Cant | None:
    """Straight ramps within the tolerance; None where there is no cant."""
    if not cant.any():
        return None
    keep = [0]
    i, last = 0, len(along) - 1
    while i < last:
        good = i + 1
        low, high = -np.inf, np.inf
        for j in range(i + 1, last + 1):  # the cone of ramps that pass all knots so far
            x = along[j] - along[i]
            low, high = max(low, (cant[j] - tolerance - cant[i]) / x), min(high, (cant[j] + tolerance - cant[i]) / x)
            if low > high:
                break
            if low <= (cant[j] - cant[i]) / x <= high:
                good = j
        keep.append(good)
        i = good
    edges, level = along[keep], cant[keep]
    return Cant(edges, level[:-1], level[1:], np.full(len(keep) - 1, CLOTHOID, np.int64))


def _stations(
    model: TrackModel, track: int, along: FloatArray, offset: FloatArray
) -> tuple[float | None, tuple[tuple[float, float, float], ...]]:
    """Chainage at the start, and equations where stations that count grid metres would leave the posts."""
    posts = model.mileposts
    a, b = np.searchsorted(posts.track, [track, track + 1])
    if a == b:
        return None, ()
    start, finish = (float(v) for v in model.chainage(np.array([track, track]), offset[[0, -1]]))
    sense = 1.0 if finish >= start else -1.0
    equations: list[tuple[float, float, float]] = []
    at, station = 0.0, start
    if sense < 0.0:
        at, station = _TURN_STATIONS, start - _TURN_STATIONS
        equations.append((at, station, sense))
    for where, chainage in zip(np.interp(posts.offset[a:b], offset, along), posts.chainage[a:b], strict=True):
        if not at + 6e-4 < where < along[-1] - 6e-4:
            continue
        if abs(station + sense * (where - at) - chainage) > _SAME_STATION:
            at, station = float(where), float(chainage)
            equations.append((at, station, sense))
    return start, tuple(equations)
