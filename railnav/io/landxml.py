"""Alignments as LandXML 1.2: plan, profile, cant and station equations become tracks.

What the format leaves open is settled by the file's own points, which are "northing easting": the direction of an element
follows from its centre or its point of intersection, never from `dir`, which programs count from north or from east, left or
right about. `rot="cw"` is a curve to the right (positive here); `appliedCant` is in millimetres and raises the outer rail of
the curve that `curvature` names, unless it is adverse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, InputError, TrackError
from railnav.geodesy.grid import frame_for_grid
from railnav.io.design import (
    ARC,
    BLOSS,
    CLOTHOID,
    COSINE,
    CUBIC,
    HELMERT,
    LARGEST_GAP,
    LARGEST_KINK,
    SAID_KINK,
    SINE,
    STRAIGHT,
    VIENNESE,
    Cant,
    Laid,
    Plan,
    closing,
    integrate,
)
from railnav.io.junctions import Design, join_designs
from railnav.io.xml_document import children as _children
from railnav.io.xml_document import local_name as _local
from railnav.io.xml_document import read_document
from railnav.track.elements import Gradients
from railnav.track.model import TrackModel
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]

#: Stations that agree within this are one, m.
SAME_STATION = 0.01
#: Cant whose station lies further than this outside the plan is said, m.
_OUTSIDE = 0.01
#: What one repeats while reading is said so often, then counted.
_MOST_NOTES = 20
#: An element shorter than this is none, m.
_NOTHING = 1e-3
#: Distance of the posts that keep stations to a millimetre while the grid's scale changes, m.
_POST_EVERY = 500.0
#: Half the distance of a pair of chainages on either side of a station equation, m.
_EQUATION = 5e-4
#: Distance of the rails' middles, m: what turns cant into an angle.
_CANT_BASE = 1.5
#: Heights of a vehicle's centre of gravity that a Viennese bend may be made for, m.
_SWAY_HEIGHT = (0.5, 3.0)

#: From just behind the start of an element to just before its end, m.
_INSIDE = np.array([1e-6, -1e-6])

_SPIRALS = {
    "clothoid": CLOTHOID,
    "bloss": BLOSS,
    "cosine": COSINE,
    "sinusoid": SINE,
    "biquadratic": HELMERT,
    "wienerbogen": VIENNESE,
    "weinerbogen": VIENNESE,  # as the schema spells it
    "cubicparabola": CUBIC,
}
_KNOWN = "clothoid, bloss, cosine, sinusoid (Klein), biquadratic (Helmert), wienerBogen, cubicParabola"
#: A cubic parabola ends within this of its stated end, m: a clothoid, or another curve of that name, is some millimetres off or more.
_CUBIC_GAP = 2e-3

_ANGLES = {
    "radians": 1.0,
    "grads": math.pi / 200.0,
    "decimal degrees": math.pi / 180.0,
    "decimal dd.mm.ss": math.pi / 180.0,
}
#: What `dir` may mean: name, bearing of its zero, its sense.
_SENSES = (
    ("clockwise from north", 0.0, 1.0),
    ("counter-clockwise from north", 0.0, -1.0),
    ("counter-clockwise from east", math.pi / 2.0, -1.0),
    ("clockwise from east", math.pi / 2.0, 1.0),
)
#: A stated direction further than this from the points' is said, rad.
_SAID_DIRECTION = math.radians(0.1)


def read_landxml(path: str | Path, *, crs: Any = None, spacing: float = 1.0) -> TrackModel:
    """Read the alignments of a LandXML file as tracks, joined where one ends on another.

    Parameters
    ----------
    path : path
        LandXML 1.x in metres, points "northing easting [height]".
    crs : str or pyproj.CRS, optional
        The plane of the coordinates: "EPSG:2056", WKT, a PROJ string, "gk3", "gk6". By default the one that the file's
        CoordinateSystem names, which few files do.
    spacing : float
        Wanted distance between the model's knots, m.

    Returns
    -------
    TrackModel
        The track is the alignment's name, in parts `name.1`, `name.2` where others end on it; stations, with their equations, become
        chainage. Heights are taken as heights of the plane. `provenance["import"]` reports how elements close at their joints,
        which tracks were joined, and what was noted.

    Raises
    ------
    InputError
        lxml is missing; the file is missing, no XML, no LandXML, too large, or has a document type (entities are never
        expanded); it is not in metres; an element is incomplete, of an unknown kind, or contradicts its own points; an element
        ends more than 0.1 m or 2 degrees from the start of the next; a profile or cant that does not run forward.
    CrsError
        No such plane, or coordinates that do not lie in it.

    Notes
    -----
    Positions are integrated as for elements (`railnav.io.design`). Vertical curves are exact: parabolas of ParaCurve and UnsymParaCurve,
    circles of CircCurve. The height of the centre of gravity that a Viennese bend is made for is no part of LandXML; it follows
    from the stated end point, and is refused outside 0.5 to 3 m where the cant is known. A cubicParabola is exact in arc length
    (`railnav.track.elements`) and must end within 2 mm of its End. Cubic, radioid, sine half-wave and reversed transitions are refused by
    name, not approximated.

    References
    ----------
    LandXML-1.2.xsd; curvature laws: `spec/track_geometry.md`, section 3.1.

    Examples
    --------
    >>> read_landxml("nowhere.xml", crs="EPSG:2056")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.xml: does not exist; check the name
    """
    path = Path(path)
    if not spacing > 0.0:
        raise InputError(f"knot spacing {spacing} m is not positive", file=path, remedy="use 1 m")
    root = _document(path)
    named = _named_plane(root)
    if crs is None and not named:
        raise InputError(
            "grid coordinates need the plane they lie in", file=path, remedy="name it, e.g. --crs EPSG:31467"
        )
    unit = _direction_unit(root, path)
    found = [node for node in root.iter() if _local(node) == "Alignment"]
    if not found:
        raise InputError("has no Alignment", file=path, remedy="export the track's alignments, with CoordGeom")
    notes: list[str] = []
    if crs is not None and named and str(crs) != named:
        notes.append(f"the file names {named[:60]}, but --crs counts: {str(crs)[:60]}")
    crs = named if crs is None else crs
    alignments = [_read_alignment(path, node, unit, notes) for node in found]
    seen: set[str] = set()
    for alignment in alignments:
        if alignment.name in seen:
            raise InputError(
                f"alignment {alignment.name!r} stands twice", file=path, remedy="give every alignment its own name"
            )
        seen.add(alignment.name)
    try:
        frame = frame_for_grid(
            np.concatenate([a.plan.easting for a in alignments]),
            np.concatenate([a.plan.northing for a in alignments]),
            crs=crs,
        )
    except CrsError as error:
        raise CrsError(f"{path}: {error}") from error
    gaps = np.hypot(*np.concatenate([a.gap for a in alignments]).T)
    kinks = np.concatenate([a.kink for a in alignments])
    provenance = {
        "format": "LandXML",
        "source": path.name,
        "tracks": len(alignments),
        "elements": sum(len(a.plan.length) for a in alignments),
        "joints": len(kinks),
        "largest_gap_m": float(gaps.max()),
        "rms_gap_m": float(np.sqrt(np.mean(gaps**2))),
        "largest_kink_deg": float(np.degrees(kinks.max())) if len(kinks) else 0.0,
        "directions": sorted({a.directions for a in alignments} - {""}),
        "notes": notes[:_MOST_NOTES] + ([f"and {len(notes) - _MOST_NOTES} more"] if len(notes) > _MOST_NOTES else []),
    }
    designs = [
        Design(a.name, a.plan, a.gap, a.posts, a.profile, a.cant, a.breaks, line=a.line, name=a.description)
        for a in alignments
    ]
    return join_designs(path, frame, designs, spacing=spacing, provenance=provenance)


# --- the document -----------------------------------------------------------------------------------------------------


def _document(path: Path) -> Any:
    """Root of the file."""
    root = read_document(path, what="LandXML", too_large="export the alignments alone, without surfaces")
    if _local(root) != "LandXML":
        raise InputError(f"is XML of the kind {_local(root)!r}, not LandXML", file=path, remedy="export LandXML 1.2")
    version = str(root.get("version", "1.2"))
    if not version.startswith("1."):
        raise InputError(f"is LandXML {version[:20]!r}", file=path, remedy="export LandXML 1.2")
    return root


def _named_plane(root: Any) -> str:
    """The plane that the file names, its EPSG code or its well-known text; empty where it names none."""
    for system in _children(root, "CoordinateSystem"):
        code = str(system.get("epsgCode", "")).strip().removeprefix("EPSG:")
        if code.isdigit() and len(code) < 7:
            return f"EPSG:{code}"
        text = str(system.get("ogcWktCode", "")).strip()
        if text[:5].upper() in ("PROJC", "BOUND", "COMPO", "DERIV"):
            return text[:20_000]
    return ""


def _features(node: Any) -> dict[str, str]:
    """What railnav's own writer noted where LandXML has no place."""
    return {
        str(item.get("label", "")): " ".join(str(item.get("value", "")).split())
        for feature in _children(node, "Feature")
        if feature.get("code") == "railnav"
        for item in _children(feature, "Property")
    }


def _direction_unit(root: Any, path: Path) -> str:
    """Unit of directions; refuse any length but the metre."""
    unit = "radians"
    for units in _children(root, "Units"):
        for system in units:
            if _local(system) == "Imperial" or str(system.get("linearUnit", "meter")).lower() not in ("meter", "metre"):
                unit = str(system.get("linearUnit", "no metre"))[:40]
                raise InputError(f"is in {unit}", file=path, remedy="export it in metres")
            unit = str(system.get("directionUnit", unit)).lower()
            if unit not in _ANGLES:
                raise InputError(
                    f"directionUnit {unit[:40]!r} is unknown", file=path, remedy=f"use {', '.join(_ANGLES)}"
                )
    return unit


@dataclass(frozen=True, slots=True)
class _Place:
    """Where in the file something stands, for messages."""

    path: Path
    alignment: str

    def refuse(self, node: Any, cause: str, remedy: str | None = None) -> NoReturn:
        what = "" if node is None else f" {_local(node)} in line {node.sourceline}"
        raise InputError(
            f"alignment {self.alignment!r},{what}: {cause}".replace(",:", ":"), file=self.path, remedy=remedy
        )

    def number(
        self,
        node: Any,
        name: str,
        *,
        default: float | None = None,
        low: float = -1e8,
        high: float = 1e8,
        infinite: bool = False,
    ) -> float:
        """A numeric attribute; INF only where it means a straight."""
        text = node.get(name)
        if text is None:
            if default is None:
                self.refuse(node, f"has no {name}", "LandXML 1.2 requires it")
            return default
        if infinite and str(text).strip().upper() in ("INF", "+INF", "-INF", "INFINITY"):
            return math.inf
        try:
            value = float(text)
        except ValueError:
            self.refuse(node, f"{name} is {str(text)[:40]!r}, not a number")
        if not low <= value <= high:  # NaN too
            self.refuse(node, f"{name} is {value:g}, not within {low:g} and {high:g}")
        return value

    def numbers(self, node: Any, least: int) -> list[float]:
        """The numbers that are an element's text."""
        try:
            values = [float(word) for word in (node.text or "").split()]
        except ValueError:
            self.refuse(node, f"holds {(node.text or '').strip()[:40]!r}, not numbers")
        if len(values) < least or not all(abs(value) < 1e9 for value in values[:3]):
            self.refuse(node, f"holds {(node.text or '').strip()[:40]!r}, not {least} coordinates")
        return values

    def point(self, node: Any, name: str) -> FloatArray:
        """Easting and northing of a point of an element, which the file has as northing easting."""
        found = _children(node, name)
        if not found:
            self.refuse(node, f"has no {name}", "LandXML 1.2 requires it")
        if found[0].get("pntRef") and not (found[0].text or "").strip():
            self.refuse(found[0], "refers to a CgPoint", "export the coordinates with the elements")
        northing, easting = self.numbers(found[0], 2)[:2]
        return np.array([easting, northing])


# --- an alignment -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Alignment:
    """One alignment, checked."""

    name: str
    description: str
    start: float
    equations: tuple[tuple[float, float, float, float], ...]  # grid length, station back, ahead, sense after
    plan: Plan
    gap: FloatArray
    kink: FloatArray
    profile: Gradients | None
    breaks: FloatArray
    cant: Cant | None
    directions: str
    line: str
    counted: bool

    def posts(self, laid: Laid) -> FloatArray:
        """Offsets and chainages at the ends and on both sides of station equations, (p, 2) m."""
        length = float(self.plan.edges[-1])
        if not self.counted:
            return np.empty((0, 2))
        rows, at, station, sense = [(0.0, self.start)], 0.0, self.start, 1.0
        for where, back, ahead, onward in (*self.equations, (length, 0.0, 0.0, 1.0)):
            between = np.arange(at + _POST_EVERY, where - 1.0, _POST_EVERY)
            rows += zip(laid.offset(between).tolist(), (station + sense * (between - at)).tolist(), strict=True)
            if where < length:
                offset = float(laid.offset(np.array([where]))[0])
                rows += [(offset - _EQUATION, back), (offset + _EQUATION, ahead)]
                at, station, sense = where, ahead, onward
        rows.append((float(laid.ground[-1]), station + sense * (length - at)))
        return np.array(rows)


def _read_alignment(path: Path, node: Any, unit: str, notes: list[str]) -> _Alignment:
    name = " ".join(str(node.get("name", "")).split())
    if not name:
        raise InputError(f"the Alignment in line {node.sourceline} has no name", file=path, remedy="name it")
    place = _Place(path, name[:60])
    plan, nodes, gap, kink = _read_plan(place, node, notes)
    length = float(plan.edges[-1])
    stated = place.number(node, "length", default=length)
    if abs(stated - length) > SAME_STATION:
        notes.append(f"{name}: the plan is {length:.3f} m long, the alignment says {stated:.3f} m; the plan counts")
    start = place.number(node, "staStart", default=0.0)
    profile, breaks = _read_profile(place, node, start, length, notes)
    noted = _features(node)
    return _Alignment(
        name,
        " ".join(str(node.get("desc", "")).split()),
        start,
        _read_equations(place, node, start, length, notes),
        plan,
        gap,
        np.abs(kink[:-1]),
        profile,
        breaks,
        _read_cant(place, node, start, plan, notes),
        _judge_directions(place, nodes, plan, unit, notes),
        noted.get("line", ""),
        noted.get("chainage") != "none",
    )


def _read_plan(place: _Place, node: Any, notes: list[str]) -> tuple[Plan, list[Any], FloatArray, FloatArray]:
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


def _side(place: _Place, node: Any) -> float:
    """+1 for a curve to the right."""
    rot = node.get("rot")
    if rot not in ("cw", "ccw"):
        place.refuse(node, f"rot is {str(rot)[:20]!r}", "use cw or ccw")
    return 1.0 if rot == "cw" else -1.0


def _mirrored(place: _Place, node: Any) -> NoReturn:
    place.refuse(
        node,
        f"its points turn the other way than rot={node.get('rot')!r} says",
        "points are northing easting: the file may have its axes exchanged or mirrored",
    )


def _ends(place: _Place, node: Any) -> tuple[FloatArray, FloatArray, float]:
    start, end = place.point(node, "Start"), place.point(node, "End")
    chord = float(np.hypot(*(end - start)))
    if not 1e-4 <= chord <= 1e5:
        place.refuse(node, f"runs {chord:g} m from Start to End", "remove it, or correct its points")
    return start, end, chord


def _read_line(place: _Place, node: Any) -> _Row:
    start, end, chord = _ends(place, node)
    length = place.number(node, "length", default=chord, low=1e-4, high=1e5)
    return _Row(start, end, length, STRAIGHT, (0.0, 0.0), _bearing(end - start))


def _read_curve(place: _Place, node: Any) -> _Row:
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


def _read_spiral(place: _Place, node: Any) -> _Row:
    kind = _SPIRALS.get(str(node.get("spiType", "")).lower())
    if kind is None:
        place.refuse(node, f"spiType {str(node.get('spiType', ''))[:40]!r} is not read", f"known are {_KNOWN}")
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


def _swing(place: _Place, node: Any, nodes: list[Any], plan: Plan, end: FloatArray) -> Plan:
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
    cant = _read_cant(place, node, start, plan, [])
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


def _judge_directions(place: _Place, nodes: list[Any], plan: Plan, unit: str, notes: list[str]) -> str:
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
            stated.append(value * _ANGLES[unit])
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


# --- stations, profile, cant ------------------------------------------------------------------------------------------


def _read_equations(
    place: _Place, node: Any, start: float, length: float, notes: list[str]
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
        if not at + _EQUATION < where < length - _EQUATION:
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


def _read_profile(
    place: _Place, node: Any, start: float, length: float, notes: list[str]
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
    place: _Place, nodes: list[Any], along: FloatArray, height: FloatArray, slope: FloatArray, notes: list[str]
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


def _read_cant(place: _Place, node: Any, start: float, plan: Plan, notes: list[str]) -> Cant | None:
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
        if law_.lower() not in _SPIRALS:
            place.refuse(station, f"transitionType {law_[:40]!r} is not read", f"known are {_KNOWN}")
        kinds.append(_SPIRALS[law_.lower()])
    if along[-1] < -_OUTSIDE or along[0] > length + _OUTSIDE:
        place.refuse(stations[0], "its stations lie outside the plan", "count them like staStart")
    if len(values) == 1:
        along, values, kinds = np.array([along[0], along[0] + 1.0]), values * 2, kinds * 2
    level = np.array(values)
    return Cant(along, level[:-1], level[1:], np.array(kinds[:-1], np.int64))


def _recounted(
    place: _Place, node: Any, along: FloatArray, start: float, length: float, notes: list[str]
) -> FloatArray:
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
