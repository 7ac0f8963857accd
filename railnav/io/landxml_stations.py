"""What lies along LandXML alignments by station: station equations, profile, cant."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.io.design import (
    Cant,
    Plan,
)
from railnav.io.landxml_document import KNOWN, SPIRALS, Place
from railnav.io.xml_document import children as _children
from railnav.io.xml_document import local_name as _local
from railnav.track.elements import Gradients

FloatArray = NDArray[np.float64]
#: Stations that agree within this are one, m.
SAME_STATION = 0.01
#: Cant whose station lies further than this outside the plan is said, m.
_OUTSIDE = 0.01
#: Half the distance of a pair of chainages on either side of a station equation, m.
EQUATION = 5e-4


def read_equations(
    place: Place, node: Any, start: float, length: float, notes: list[str]
) -> tuple[tuple[float, float, float, float], ...]:
    """Station equations in order: grid length, station back and ahead, +1 or -1 for stations that grow or fall after it."""
    found = []
    at, station, sense = 0.0, start, 1.0
    for equation in _children(node, "StaEquation"):
        where = place.number(equation, "staInternal") - start
        ahead = place.number(equation, "staAhead")
        onward = {"increasing": 1.0, "decreasing": -1.0}.get(str(equation.get("staIncrement", "increasing")))
        if onward is None:
            place.refuse(equation, f"staIncrement is {equation.get('staIncrement')!r}", "use increasing or decreasing")
        if not at + EQUATION < where < length - EQUATION:
            notes.append(
                f"{place.alignment}: the station equation at {where + start:.3f} lies outside and is passed over"
            )
            continue
        back = station + sense * (where - at)
        stated = place.number(equation, "staBack", default=back)
        if abs(stated - back) > SAME_STATION:
            notes.append(
                f"{place.alignment}: the station equation at {where + start:.3f} states {stated:.3f} back, where the length "
                f"gives {back:.3f}; the length counts"
            )
        found.append((where, back, ahead, onward))
        at, station, sense = where, ahead, onward
    return tuple(found)


def read_profile(
    place: Place, node: Any, start: float, length: float, notes: list[str]
) -> tuple[Gradients | None, FloatArray]:
    """The first ProfAlign as a callable, or None; and where its straights and curves meet."""
    chosen = [align for profile in _children(node, "Profile") for align in _children(profile, "ProfAlign")]
    if not chosen:
        return None, np.empty(0)
    if len(chosen) > 1:
        notes.append(f"{place.alignment}: {len(chosen)} profiles; the first, {chosen[0].get('name', '')!r}, counts")
    points: list[tuple[Any, float, float]] = []
    for child in chosen[0]:
        kind = _local(child)
        if kind in ("PVI", "ParaCurve", "UnsymParaCurve", "CircCurve"):
            station, elevation = place.numbers(child, 2)[:2]
            points.append((child, station - start, elevation))
        elif kind and kind != "Feature":
            place.refuse(child, "is no element of a profile", "use PVI, ParaCurve, UnsymParaCurve, CircCurve")
    if not points:
        return None, np.empty(0)
    along = np.array([p[1] for p in points])
    height = np.array([p[2] for p in points])
    if len(points) < 2:
        place.refuse(points[0][0], "is the only point of its profile", "a profile needs two")
    if (np.diff(along) <= 0.0).any():
        i = int(np.argmax(np.diff(along) <= 0.0)) + 1
        place.refuse(points[i][0], "its station does not follow the one before", "order the points by station")
    if (np.abs(height) > 10_000.0).any():
        i = int(np.argmax(np.abs(height) > 10_000.0))
        place.refuse(points[i][0], f"a height of {height[i]:g} m", "points of a profile are station elevation")
    slope = np.diff(height) / np.diff(along)
    if (np.abs(slope) > 0.5).any():
        i = int(np.argmax(np.abs(slope) > 0.5))
        place.refuse(points[i + 1][0], f"a gradient of {slope[i]:.2f} leads to it", "correct its station or elevation")
    if along[0] > SAME_STATION or along[-1] < length - SAME_STATION:
        short = max(along[0], length - along[-1])
        notes.append(f"{place.alignment}: the profile is {short:.3f} m short of the plan and goes on as it ends")
    return _lay_profile(place, [p[0] for p in points], along, height, slope, notes)


def _lay_profile(
    place: Place, nodes: list[Any], along: FloatArray, height: FloatArray, slope: FloatArray, notes: list[str]
) -> tuple[Gradients, FloatArray]:
    """Straights with curves: pieces, each from `begin`, of height h + g x + c x^2 or a circle of signed radius r."""
    begin, base, grade, bend, radius = [-math.inf], [height[0]], [slope[0]], [0.0], [0.0]
    origin = [along[0]]

    def piece(at: float, h: float, g: float, c: float = 0.0, r: float = 0.0) -> None:
        for column, value in zip((begin, origin, base, grade, bend, radius), (at, at, h, g, c, r), strict=True):
            column.append(value)

    reach = along[0]
    for i in range(1, len(along) - 1):
        node, kind = nodes[i], _local(nodes[i])
        g0, g1 = float(slope[i - 1]), float(slope[i])
        if kind == "PVI" or g0 == g1:
            before = after = 0.0
        elif kind == "ParaCurve":
            before = after = place.number(node, "length", low=0.0, high=1e5) / 2.0
        elif kind == "UnsymParaCurve":
            before = place.number(node, "lengthIn", low=0.0, high=1e5)
            after = place.number(node, "lengthOut", low=0.0, high=1e5)
        else:
            r = place.number(node, "radius", low=0.0, high=1e9)
            a0, a1 = math.atan(g0), math.atan(g1)
            tangent = r * math.tan(abs(a1 - a0) / 2.0)
            before, after = tangent * math.cos(a0), tangent * math.cos(a1)
            arc = place.number(node, "length", default=r * abs(a1 - a0), high=1e5)
            if abs(arc - r * abs(a1 - a0)) > 0.1 + 1e-2 * arc:
                notes.append(
                    f"{place.alignment}, line {node.sourceline}: the length of the CircCurve is {arc:.3f} m, radius and gradients "
                    f"give {r * abs(a1 - a0):.3f} m; the radius counts"
                )
        if along[i] - before < reach - SAME_STATION or along[i] + after > along[i + 1] + SAME_STATION:
            place.refuse(node, "overlaps the curve or point beside it", "shorten it")
        reach = float(along[i]) + after
        h0 = float(height[i]) - g0 * before
        if kind == "CircCurve" and before > 0.0:
            piece(float(along[i]) - before, h0, g0, r=math.copysign(r, g1 - g0))
        elif kind == "ParaCurve" and before > 0.0:
            piece(float(along[i]) - before, h0, g0, c=(g1 - g0) / (4.0 * before))
        elif kind == "UnsymParaCurve" and before > 0.0 and after > 0.0:
            middle = (g0 * before + g1 * after) / (before + after)  # both halves meet with the chord's gradient
            piece(float(along[i]) - before, h0, g0, c=(middle - g0) / (2.0 * before))
            piece(float(along[i]), h0 + before * (g0 + middle) / 2.0, middle, c=(g1 - middle) / (2.0 * after))
        piece(reach, float(height[i]) + g1 * after, g1)
    table = Gradients(*(np.array(column) for column in (begin, origin, base, grade, bend, radius)))
    return table, table.begin[1:]


def read_cant(place: Place, node: Any, start: float, plan: Plan, notes: list[str]) -> Cant | None:
    """Cant by grid length from the CantStations of the first Cant, or None."""
    tables = _children(node, "Cant")
    stations = _children(tables[0], "CantStation") if tables else []
    if not stations:
        return None
    length = float(plan.edges[-1])
    along = np.array([place.number(s, "station") for s in stations]) - start
    if along[-1] > length + 1.0:
        along = _recounted(place, node, along, start, length, notes)
    for i in np.flatnonzero(np.diff(along) < -1e-6)[:1]:
        place.refuse(stations[i + 1], "its station lies before the one above", "order the stations")
    values, kinds = [], []
    for station in stations:
        applied = place.number(station, "appliedCant", low=-500.0, high=500.0) * 1e-3
        rot = station.get("curvature")
        if rot not in ("cw", "ccw"):
            if applied != 0.0:
                place.refuse(station, f"curvature is {str(rot)[:20]!r}", "use cw or ccw: it names the higher rail")
            rot = "cw"
        sense = (1.0 if rot == "cw" else -1.0) * (-1.0 if str(station.get("adverse")).lower() in ("true", "1") else 1.0)
        values.append(sense * applied)
        law_ = str(station.get("transitionType", "clothoid"))
        if law_.lower() not in SPIRALS:
            place.refuse(station, f"transitionType {law_[:40]!r} is not read", f"known are {KNOWN}")
        kinds.append(SPIRALS[law_.lower()])
    if along[-1] < -_OUTSIDE or along[0] > length + _OUTSIDE:
        place.refuse(stations[0], "its stations lie outside the plan", "count them like staStart")
    if len(values) == 1:
        along, values, kinds = np.array([along[0], along[0] + 1.0]), values * 2, kinds * 2
    level = np.array(values)
    return Cant(along, level[:-1], level[1:], np.array(kinds[:-1], np.int64))


def _recounted(place: Place, node: Any, along: FloatArray, start: float, length: float, notes: list[str]) -> FloatArray:
    """Stations of programs that count cant from the alignment's start once past a station equation."""
    for equation in _children(node, "StaEquation"):
        where = place.number(equation, "staInternal") - start
        again = np.where(along > where + 1e-6, along + start, along)
        if start != 0.0 and (np.diff(again) >= -1e-6).all() and again[0] >= -_OUTSIDE and again[-1] <= length + 1.0:
            notes.append(
                f"{place.alignment}: past the station equation at {where + start:.3f}, cant is counted from the start of the "
                "alignment"
            )
            return again
    if (along > length + 1.0).all():
        return along
    notes.append(f"{place.alignment}: cant stations run {along[-1] - length:.3f} m past the end of the plan")
    return along
