"""Plans of LandXML alignments: Line, Curve and Spiral, checked against their own points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.io.design import (
    ARC,
    CUBIC,
    LARGEST_GAP,
    LARGEST_KINK,
    SAID_KINK,
    STRAIGHT,
    VIENNESE,
    Plan,
    closing,
    integrate,
)
from railnav.io.landxml_document import ANGLES, KNOWN, SPIRALS, Place
from railnav.io.landxml_stations import read_cant
from railnav.io.xml_document import children as _children
from railnav.io.xml_document import local_name as _local
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
#: An element shorter than this is none, m.
_NOTHING = 1e-3
#: Distance of the rails' middles, m: what turns cant into an angle.
_CANT_BASE = 1.5
#: Heights of a vehicle's centre of gravity that a Viennese bend may be made for, m.
_SWAY_HEIGHT = (0.5, 3.0)
#: From just behind the start of an element to just before its end, m.
_INSIDE = np.array([1e-6, -1e-6])
#: A cubic parabola ends within this of its stated end, m: a clothoid, or another curve of that name, is some millimetres off or more.
_CUBIC_GAP = 2e-3
#: What `dir` may mean: name, bearing of its zero, its sense.
_SENSES = (
    ("clockwise from north", 0.0, 1.0),
    ("counter-clockwise from north", 0.0, -1.0),
    ("counter-clockwise from east", math.pi / 2.0, -1.0),
    ("clockwise from east", math.pi / 2.0, 1.0),
)


#: A stated direction further than this from the points' is said, rad.
_SAID_DIRECTION = math.radians(0.1)


def read_plan(place: Place, node: Any, notes: list[str]) -> tuple[Plan, list[Any], FloatArray, FloatArray]:
    """Elements, their XML, and what each misses the next one's start by (the last: its own end): m and rad."""
    geometry = _children(node, "CoordGeom")
    if not geometry:
        place.refuse(node, "has no CoordGeom", "export its plan")
    nodes: list[Any] = []
    for child in geometry[0]:
        kind = _local(child)
        if kind in ("Line", "Curve", "Spiral"):
            step = place.point(child, "End") - place.point(child, "Start")
            if np.hypot(*step) < _NOTHING and place.number(child, "length", default=0.0) < _NOTHING:
                notes.append(
                    f"{place.alignment}: the {kind} in line {child.sourceline} has no length and is passed over"
                )
            else:
                nodes.append(child)
        elif kind and kind != "Feature":
            place.refuse(child, "is no element of a designed track", "use Line, Curve and Spiral")
    if not nodes:
        place.refuse(geometry[0], "holds no elements")
    rows = [_READERS[_local(child)](place, child) for child in nodes]
    start = np.array([row.start for row in rows])
    end = np.array([row.end for row in rows])
    plan = Plan(
        np.array([row.length for row in rows]),
        np.array([row.kind for row in rows], np.int64),
        np.array([row.curvature[0] for row in rows]),
        np.array([row.curvature[1] for row in rows]),
        start[:, 0].copy(),
        start[:, 1].copy(),
        np.array([row.bearing for row in rows]),
        np.zeros(len(rows)),
    )
    if plan.edges[-1] > 5e6:
        place.refuse(geometry[0], f"is {plan.edges[-1] / 1e3:.0f} km long", "check the lengths")
    try:
        plan = _swing(place, node, nodes, plan, end)
        gap, kink = closing(plan, end=end[-1])
    except TrackError as error:  # a cubic parabola that cannot be
        place.refuse(geometry[0], str(error))
    shut = np.hypot(gap[:, 0], gap[:, 1])
    ends, _ = integrate(plan, plan.edges)
    own = np.hypot(*(end - ends[1:]).T)
    for i in np.flatnonzero((plan.kind == CUBIC) & (own > _CUBIC_GAP)).tolist():
        place.refuse(
            nodes[i],
            f"spiType 'cubicParabola': one of this length and radius ends {own[i] * 1e3:.1f} mm from its End",
            "it is another curve: say which, or use clothoid",
        )
    for i in range(len(rows)):
        apart, what = (own[i], "its own end") if own[i] > shut[i] else (shut[i], "the start of the next element")
        if apart > LARGEST_GAP:
            place.refuse(
                nodes[i],
                f"its length, radii and kind lead {apart:.3f} m past {what}",
                "check its spiType, length, radii and rot",
            )
    for i, bend in enumerate(np.abs(kink)):
        if bend > LARGEST_KINK:
            place.refuse(
                nodes[i],
                f"ends {np.degrees(bend):.2f} degrees off the direction of the next element",
                "check its rot, Center or PI",
            )
        if bend > SAID_KINK:
            notes.append(
                f"{place.alignment}, line {nodes[i].sourceline}: turns {np.degrees(bend):.2f} degrees at its end"
            )
    return plan, nodes, gap, kink


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    start: FloatArray
    end: FloatArray
    length: float
    kind: int
    curvature: tuple[float, float]
    bearing: float


def _bearing(step: FloatArray) -> float:
    return math.atan2(step[0], step[1])


def _right_of(a: FloatArray, b: FloatArray) -> float:
    """How far direction b points to the right of a: positive cross product in (east, north)."""
    return float(a[1] * b[0] - a[0] * b[1])


def _side(place: Place, node: Any) -> float:
    """+1 for a curve to the right."""
    rot = node.get("rot")
    if rot not in ("cw", "ccw"):
        place.refuse(node, f"rot is {str(rot)[:20]!r}", "use cw or ccw")
    return 1.0 if rot == "cw" else -1.0


def _mirrored(place: Place, node: Any) -> NoReturn:
    place.refuse(
        node,
        f"its points turn the other way than rot={node.get('rot')!r} says",
        "points are northing easting: the file may have its axes exchanged or mirrored",
    )


def _ends(place: Place, node: Any) -> tuple[FloatArray, FloatArray, float]:
    start, end = place.point(node, "Start"), place.point(node, "End")
    chord = float(np.hypot(*(end - start)))
    if not 1e-4 <= chord <= 1e5:
        place.refuse(node, f"runs {chord:g} m from Start to End", "remove it, or correct its points")
    return start, end, chord


def _read_line(place: Place, node: Any) -> _Row:
    start, end, chord = _ends(place, node)
    length = place.number(node, "length", default=chord, low=1e-4, high=1e5)
    return _Row(start, end, length, STRAIGHT, (0.0, 0.0), _bearing(end - start))


def _read_curve(place: Place, node: Any) -> _Row:
    if str(node.get("crvType", "arc")) != "arc":
        place.refuse(node, f"crvType {str(node.get('crvType'))[:40]!r} is no circle", "use arc")
    start, end, _ = _ends(place, node)
    center, side = place.point(node, "Center"), _side(place, node)
    arm, other = start - center, end - center
    drawn = float(np.hypot(*arm))
    radius = place.number(node, "radius", default=drawn, low=5.0, infinite=True)
    if not math.isfinite(radius):
        place.refuse(node, "radius is INF", "use a Line")
    if abs(drawn - radius) > 0.01 + 1e-5 * radius:
        place.refuse(node, f"radius is {radius:g} m, its Center lies {drawn:.3f} m from Start", "correct one of them")
    swept = math.atan2(_right_of(arm, other), float(arm @ other)) * side  # seen in the direction of rot
    if swept < 0.0:
        swept += 2.0 * math.pi
    length = place.number(node, "length", default=swept * radius, low=1e-4, high=1e5)
    if abs(swept * radius - length) > LARGEST_GAP and abs((2.0 * math.pi - swept) * radius - length) < LARGEST_GAP:
        _mirrored(place, node)
    return _Row(start, end, length, ARC, (side / radius, side / radius), _bearing(arm) + side * math.pi / 2.0)


def _read_spiral(place: Place, node: Any) -> _Row:
    kind = SPIRALS.get(str(node.get("spiType", "")).lower())
    if kind is None:
        place.refuse(node, f"spiType {str(node.get('spiType', ''))[:40]!r} is not read", f"known are {KNOWN}")
    start, end, _ = _ends(place, node)
    side, turning = _side(place, node), place.point(node, "PI")
    ends = [place.number(node, name, low=0.0, infinite=True) for name in ("radiusStart", "radiusEnd")]
    for name, radius in zip(("radiusStart", "radiusEnd"), ends, strict=True):
        if 0.0 < radius < 5.0:
            place.refuse(node, f"{name} is {radius:g} m", "radii are metres; a straight end is INF")
    k0, k1 = (0.0 if radius == 0.0 else side / radius for radius in ends)  # some programs write 0 for a straight end
    if k0 == k1 == 0.0:
        place.refuse(node, "is straight at both ends", "use a Line, or give one of its radii")
    length = place.number(node, "length", low=1e-4, high=1e5)
    first, last = turning - start, end - turning
    if np.hypot(*first) < 1e-4 * length:
        place.refuse(node, "its PI lies on its Start", "export the point of intersection of its tangents")
    if _right_of(first, last) * side < -1e-4 * length**2:
        _mirrored(place, node)
    return _Row(start, end, length, kind, (k0, k1), _bearing(first))


_READERS = {"Line": _read_line, "Curve": _read_curve, "Spiral": _read_spiral}


def _swing(place: Place, node: Any, nodes: list[Any], plan: Plan, end: FloatArray) -> Plan:
    """Find how far Viennese bends swing out from their stated ends (linear in the sway)."""
    bends = np.flatnonzero(plan.kind == VIENNESE)
    if not len(bends):
        return plan
    edges = plan.edges

    def miss(sway: FloatArray) -> FloatArray:
        """To the right of the end's direction, m."""
        at, bearing = integrate(_with_sway(plan, sway), edges)
        off = end - at[1:]
        return np.asarray(off[:, 0] * np.cos(bearing[1:]) - off[:, 1] * np.sin(bearing[1:]))

    sway = np.zeros(len(edges) - 1)
    for _ in range(3):
        step = np.where(plan.kind == VIENNESE, 1e-6, 0.0)
        here = miss(sway)
        slope = (miss(sway + step) - here)[bends] / 1e-6
        sway[bends] -= here[bends] / np.where(slope == 0.0, np.inf, slope)
    start = place.number(node, "staStart", default=0.0)
    cant = read_cant(place, node, start, plan, [])
    for i in bends:
        grown = 0.0 if cant is None else float(np.diff(cant.at(edges[i : i + 2] + _INSIDE))[0])
        if abs(grown) > 1e-3:
            height = sway[i] * plan.length[i] ** 2 * _CANT_BASE / grown
            if not _SWAY_HEIGHT[0] <= height <= _SWAY_HEIGHT[1]:
                place.refuse(
                    nodes[i],
                    f"its end asks for a centre of gravity {height:.2f} m above the rails, not within "
                    f"{_SWAY_HEIGHT[0]:g} to {_SWAY_HEIGHT[1]:g} m",
                    "check its points, its radii and the cant",
                )
    return _with_sway(plan, sway)


def _with_sway(plan: Plan, sway: FloatArray) -> Plan:
    return Plan(
        plan.length,
        plan.kind,
        plan.curvature_start,
        plan.curvature_end,
        plan.easting,
        plan.northing,
        plan.grid_bearing,
        sway,
    )


def judge_directions(place: Place, nodes: list[Any], plan: Plan, unit: str, notes: list[str]) -> str:
    """Find from where, and which way about, `dir` and `dirStart` count; the points hold, a contradiction is said."""
    stated, drawn = [], []
    for node, bearing in zip(nodes, plan.grid_bearing, strict=True):
        name = "dir" if _local(node) == "Line" else "dirStart"
        if node.get(name) is not None:
            value = place.number(node, name, low=-1e4, high=1e4)
            if unit == "decimal dd.mm.ss":  # 45.3015 is 45 degrees 30 minutes 15 seconds
                seconds = round(abs(value) * 1e4, 6)
                degrees, rest = divmod(seconds, 1e4)
                value = math.copysign(degrees + rest // 100 / 60.0 + rest % 100 / 3600.0, value)
            stated.append(value * ANGLES[unit])
            drawn.append(bearing)
    if not stated:
        return ""
    off = {name: np.abs(wrap_angle(zero + sense * np.array(stated) - np.array(drawn))) for name, zero, sense in _SENSES}
    best = min(off, key=lambda name: float(np.median(off[name])))
    worst = float(off[best].max())
    if float(np.median(off[best])) > _SAID_DIRECTION:
        notes.append(f"{place.alignment}: dir fits the points in no sense ({unit}); the points count")
        return ""
    if worst > _SAID_DIRECTION:
        notes.append(f"{place.alignment}: dir is up to {math.degrees(worst):.2f} degrees off the points, which count")
    return best
