"""railML 3.1 to 3.3 infrastructure: net elements become tracks, net relations the movements, curves the plan, gradients the profile.

Signs are railML's: azimuth in degrees clockwise from north, radius negative to the left and 0 for a straight, gradients in per mille,
positive uphill; the radius of a vertical arc is negative in a valley. Coordinates are x (easting, longitude), y (northing, latitude).
railML 2 is read by `railnav.io.railml2`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, InputError, TrackError
from railnav.geodesy.grid import GridFrame, choose_frame, frame_for_grid
from railnav.io.design import LARGEST_GAP, closing, lay
from railnav.io.drawn import lay_line
from railnav.io.xml_document import children, local_name, read_document
from railnav.track.alignment import KnotTable
from railnav.track.assembly import TrackSection, assemble
from railnav.track.elements import (
    ARC,
    BLOSS,
    CLOTHOID,
    COSINE,
    CUBIC,
    SINE,
    STRAIGHT,
    Gradients,
    Plan,
    integrate,
)
from railnav.track.model import NodeKind, TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Kinds of curves that are read, by railML's name.
CURVES = {
    "straight": STRAIGHT,
    "arc": ARC,
    "clothoide": CLOTHOID,
    "curveBloss": BLOSS,
    "cosinusoide": COSINE,
    "sinusoide": SINE,
    "cubicParabola": CUBIC,
}
#: Ends that a relation joins are one node within this, m.
JOIN_WITHIN = 0.5
_SAME_PLACE = 1e-6  # of intrinsic coordinates
_MOST_NOTES = 20
_GEOGRAPHIC = {"4326", "4258", "4979", "4937", "CRS84"}


@dataclass(slots=True)
class _Element:
    """One net element: its points and what lies along it."""

    id: str
    node: Any
    length: float | None
    at: FloatArray  # intrinsic coordinates of the points
    point: FloatArray  # (n, 3) x, y, z (NaN without)
    measures: list[tuple[float, str, float]]  # intrinsic coordinate, system, measure
    curves: list[tuple[float, float, bool, Any]] = field(default_factory=list)
    gradients: list[tuple[float, float, bool, Any]] = field(default_factory=list)
    track: str = ""
    line: str = ""
    name: str = ""


class _Reader:
    """A file being read: where things stand, for messages, and what is noted."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []

    def refuse(self, node: Any, cause: str, remedy: str | None = None) -> NoReturn:
        name = node.get("id") or ""
        raise InputError(
            f"{local_name(node)} {name!r} in line {node.sourceline}: {cause}", file=self.path, remedy=remedy
        )

    def number(
        self, node: Any, name: str, default: float | None = None, *, low: float = -1e9, high: float = 1e9
    ) -> float:
        """A numeric attribute within bounds."""
        text = node.get(name)
        if text is None:
            if default is None:
                self.refuse(node, f"has no {name}")
            return default
        try:
            value = float(text)
        except ValueError:
            self.refuse(node, f"{name} is {str(text)[:40]!r}, not a number")
        if not low <= value <= high:
            self.refuse(node, f"{name} is {value:g}, not within {low:g} and {high:g}")
        return value

    def note(self, text: str) -> None:
        self.notes.append(text)

    def told(self) -> list[str]:
        left = len(self.notes) - _MOST_NOTES
        return self.notes[:_MOST_NOTES] + ([f"and {left} more"] if left > 0 else [])


def read_railml(
    path: str | Path,
    *,
    crs: Any = None,
    zone_width: int = 6,
    ellipsoid: str = "wgs84",
    spacing: float = 1.0,
) -> TrackModel:
    """Read the infrastructure of a railML file as a track network.

    Parameters
    ----------
    path : path
        railML 3.1 to 3.3, or 2.x (geometry by geoMappings), .railml or .xml.
    crs, zone_width, ellipsoid
        The plane, as for `railnav.geodesy.choose_frame`, where coordinates are geographic; where they are plane coordinates, the
        file's own crsDefinition, or `crs` if it has none.
    spacing : float
        Wanted distance between the model's knots, m.

    Returns
    -------
    TrackModel
        A track is a net element, with the movements that netRelations of navigability Both, AB or BA permit. `line` is the name of the
        line it belongs to, measures of its linear positioning systems become chainage. `provenance["balises"]` lists balises by track
        and offset, `provenance["import"]` what was read, and what was passed over.

    Raises
    ------
    InputError
        The file is missing, no XML, no railML of a known version, or has a document type; coordinates are missing or of no stated
        plane; a curve is of an unknown kind; a relation names a net element that is not there.
    CrsError
        The plane does not serve the data.

    Notes
    -----
    Where horizontalCurves cover a net element they are laid exactly, from its first point; a transition takes its curvatures from the
    curves beside it, or from its radius (that of its sharper end) and deltaAzimuth. Where they lead more than 0.1 m past its last point,
    or cover it in part, its drawn line counts, and a note says so. Lines whose vertices turn by less than 4 degrees are splined, others
    rounded within 0.3 m. Superelevation curves are not read.

    References
    ----------
    railML 3.2 schema documentation: RTM geometricCoordinate, IS horizontalCurve, IS gradientCurve.

    Examples
    --------
    >>> read_railml("nowhere.railml")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.railml: does not exist; check the name
    """
    path = Path(path)
    if not spacing > 0.0:
        raise InputError(f"knot spacing {spacing} m is not positive", file=path, remedy="use 1 m")
    root = read_document(path, what="railML", too_large="export the infrastructure alone, without timetables")
    kind = local_name(root)
    if kind.lower() != "railml":
        raise InputError(f"is XML of the kind {kind!r}, not railML", file=path, remedy="export railML 3.2")
    version = _version(root)
    try:
        if version.startswith("2"):
            from railnav.io.railml2 import read_tracks

            return read_tracks(path, root, crs=crs, zone_width=zone_width, ellipsoid=ellipsoid, spacing=spacing)
        if not version.startswith("3"):
            raise InputError(f"is railML {version[:20]!r}", file=path, remedy="export railML 3.2 or 2.5")
        return _read(_Reader(path), root, version, crs, zone_width, ellipsoid, spacing)
    except CrsError as error:
        raise CrsError(f"{path}: {error}") from error
    except TrackError as error:
        raise InputError(str(error), file=path) from error


def _version(root: Any) -> str:
    """Version of the file: its attribute, or what its namespace says."""
    stated = str(root.get("version", "")).strip()
    if stated:
        return stated
    space = root.tag.rpartition("}")[0]
    for year, version in (("schemas/3", "3"), ("2009", "2.0"), ("2011", "2.1"), ("2013", "2.2"), ("2016", "2.3"),
                          ("2018", "2.4"), ("2021", "2.5")):  # fmt: skip
        if year in space:
            return version
    return "without a version"


def _read(
    reader: _Reader, root: Any, version: str, crs: Any, zone_width: int, ellipsoid: str, spacing: float
) -> TrackModel:
    infrastructure = _only(reader, root, "infrastructure")
    elements = _elements(reader, infrastructure)
    frame, geographic = _frame(reader, root, elements, crs, zone_width, ellipsoid)
    _along(reader, infrastructure, elements)
    sections = [_section(reader, frame, element, geographic, spacing) for element in elements.values()]
    model = assemble(frame, sections, join_within=JOIN_WITHIN)
    index = {element: i for i, element in enumerate(elements)}
    related = any(local_name(node) == "netRelations" for node in infrastructure.iter())
    movements = _movements(reader, infrastructure, index) if related else model.movements
    if not related and len(sections) > 1:
        reader.note("there are no netRelations; movements follow from the tangents")
    kinds, names = _points(reader, infrastructure, model, index)
    balises = _balises(reader, infrastructure, model, index)
    told = {
        "format": "railML",
        "version": version,
        "source": reader.path.name,
        "tracks": len(sections),
        "relations": len(movements),
        "switches": len(names),
        "balises": len(balises),
        "notes": reader.told(),
    }
    ids = tuple(names.get(i, name) for i, name in enumerate(model.nodes.id))
    unique = len(set(ids)) == len(ids)
    nodes = replace(model.nodes, kind=kinds, id=ids if unique else model.nodes.id)
    return replace(
        model,
        movements=movements,
        nodes=nodes,
        provenance={"import": told, "balises": balises},
    )


# --- topology ---------------------------------------------------------------------------------------------------------


def _only(reader: _Reader, root: Any, name: str) -> Any:
    found = children(root, name)
    if not found:
        raise InputError(f"has no {name}", file=reader.path, remedy=f"export the {name}")
    return found[0]


def _elements(reader: _Reader, infrastructure: Any) -> dict[str, _Element]:
    """Net elements of the most detailed level, with their points."""
    found = [node for node in infrastructure.iter() if local_name(node) == "netElement"]
    if not found:
        raise InputError("has no netElement", file=reader.path, remedy="export the topology, level Micro")
    micro = {
        resource.get("ref")
        for level in infrastructure.iter()
        if local_name(level) == "level" and str(level.get("descriptionLevel")) == "Micro"
        for resource in children(level, "networkResource")
    }
    elements: dict[str, _Element] = {}
    passed = 0
    for node in found:
        name = node.get("id")
        if not name:
            reader.refuse(node, "has no id")
        whole = any(local_name(child).startswith("elementCollection") for child in node)
        if whole or (micro and name not in micro):
            passed += 1
            continue
        if name in elements:
            reader.refuse(node, "stands twice", "give every net element its own id")
        elements[name] = _element(reader, node, name)
    if passed:
        reader.note(f"{passed} net elements of coarser levels passed over")
    if not elements:
        raise InputError("has no netElement of level Micro", file=reader.path, remedy="export the topology in detail")
    return elements


def _element(reader: _Reader, node: Any, name: str) -> _Element:
    rows: dict[float, tuple[float, float, float]] = {}
    measures: list[tuple[float, str, float]] = []
    for system in children(node, "associatedPositioningSystem"):
        for place in children(system, "intrinsicCoordinate"):
            at = reader.number(place, "intrinsicCoord", low=-1e-6, high=1.0 + 1e-6)
            for point in children(place, "geometricCoordinate"):
                x, y = (reader.number(point, axis, low=-1e8, high=1e8) for axis in ("x", "y"))
                z = reader.number(point, "z", math.nan, low=-1000.0, high=10_000.0) if point.get("z") else math.nan
                rows[min(max(at, 0.0), 1.0)] = (x, y, z)
            for mark in children(place, "linearCoordinate"):
                value = reader.number(mark, "measure", low=-1e8, high=1e8)
                measures.append((at, str(mark.get("positioningSystemRef", "")), value))
    at_ = np.array(sorted(rows))
    if len(at_) < 2 or at_[0] > _SAME_PLACE or at_[-1] < 1.0 - _SAME_PLACE:
        reader.refuse(
            node,
            "has no geometricCoordinate at both of its ends (intrinsicCoord 0 and 1)",
            "export geographic positions: a network without places is no track model",
        )
    length = reader.number(node, "length", low=1e-3, high=1e7) if node.get("length") else None
    return _Element(name, node, length, at_, np.array([rows[a] for a in at_]), sorted(measures))


def _frame(
    reader: _Reader, root: Any, elements: dict[str, _Element], crs: Any, zone_width: int, ellipsoid: str
) -> tuple[GridFrame, bool]:
    """The plane; coordinates of geographic systems are laid into it. True where they were geographic."""
    used = {
        point.get("positioningSystemRef")
        for element in elements.values()
        for point in element.node.iter()
        if local_name(point) == "geometricCoordinate"
    }
    stated = {
        str(system.get("crsDefinition", "")).strip()
        for system in root.iter()
        if local_name(system) == "geometricPositioningSystem" and (system.get("id") in used or len(used) != 1)
    } - {""}
    if len(stated) > 1:
        raise InputError(f"mixes coordinate systems ({', '.join(sorted(stated))[:80]})", file=reader.path)
    definition = next(iter(stated), "")
    points = np.concatenate([element.point for element in elements.values()])
    code = definition.upper().replace("::", ":").rpartition(":")[2].rpartition("/")[2]
    if code in _GEOGRAPHIC or (definition and _is_geographic(definition, reader)):
        if np.abs(points[:, 0]).max() > 180.0 or np.abs(points[:, 1]).max() > 90.0:
            raise InputError(
                f"has coordinates outside the Earth's for {definition}", file=reader.path, remedy="x is longitude"
            )
        latitude, longitude = np.radians(points[:, 1]), np.radians(points[:, 0])
        frame = choose_frame(latitude, longitude, crs=crs, zone_width=zone_width, ellipsoid=ellipsoid)
        for element in elements.values():
            x, y, z = element.point.T
            element.point = np.column_stack(frame.to_grid(np.radians(y), np.radians(x), z))
        return frame, True
    plane = f"EPSG:{code}" if code.isdigit() else definition or crs
    if definition and crs is not None and str(crs) != str(plane):
        reader.note(f"the file names {definition[:60]}, but --crs counts: {str(crs)[:60]}")
        plane = crs
    if plane is None:
        raise InputError(
            "does not state the coordinate system of its positions (crsDefinition)",
            file=reader.path,
            remedy="name it, e.g. --crs EPSG:5684; positions of a schematic drawing are of no use",
        )
    if not definition:
        reader.note("the file states no coordinate system; --crs counts")
    return frame_for_grid(points[:, 0], points[:, 1], crs=plane), False


def _is_geographic(definition: str, reader: _Reader) -> bool:
    import pyproj
    from pyproj.exceptions import CRSError

    try:
        return bool(pyproj.CRS.from_user_input(definition).is_geographic)
    except CRSError as error:
        raise InputError(
            f"crsDefinition {definition[:60]!r} is no coordinate system", file=reader.path, remedy="use EPSG:code"
        ) from error


def _movements(reader: _Reader, infrastructure: Any, index: dict[str, int]) -> IntArray:
    rows: set[tuple[int, int, int, int]] = set()
    one_way = 0
    known = {node.get("id") for node in infrastructure.iter() if local_name(node) == "netElement"}
    for relation in infrastructure.iter():
        if local_name(relation) != "netRelation":
            continue
        ends: list[tuple[int, int]] = []
        for name, where in (("elementA", "positionOnA"), ("elementB", "positionOnB")):
            found = children(relation, name)
            ref = found[0].get("ref") if found else None
            if ref in index:
                at = reader.number(relation, where)
                if at not in (0.0, 1.0):
                    reader.refuse(relation, f"{where} is {at:g}", "relations join ends: 0 or 1")
                ends.append((index[ref], int(at)))
            elif ref is None:
                reader.refuse(relation, f"has no {name}")
            elif ref not in known:
                reader.refuse(relation, f"names a net element {str(ref)[:40]!r} that is not there")
        navigable = str(relation.get("navigability", "Both"))
        if navigable not in ("Both", "AB", "BA", "None"):
            reader.refuse(relation, f"navigability is {navigable[:20]!r}", "use Both, AB, BA or None")
        if len(ends) < 2 or navigable == "None" or ends[0] == ends[1]:
            continue
        one_way += navigable != "Both"
        a, b = sorted(ends)
        rows.add((*a, *b))
    if one_way:
        reader.note(f"{one_way} relations lead one way only; movements of the model lead both ways")
    return np.array(sorted(rows), np.int64).reshape(-1, 4)


# --- what lies along net elements -------------------------------------------------------------------------------------


def _along(reader: _Reader, infrastructure: Any, elements: dict[str, _Element]) -> None:
    """Hand curves, gradients, lines and names to the net elements they lie on."""
    passed = 0
    for node in infrastructure.iter():
        kind = local_name(node)
        if kind == "superelevationCurve":
            passed += 1
        if kind not in ("horizontalCurve", "gradientCurve", "line", "track"):
            continue
        places = [
            place
            for location in children(node, "linearLocation")
            for place in children(location, "associatedNetElement")
        ]
        if kind in ("line", "track"):
            name = next((str(child.get("name", "")) for child in children(node, "name")), "")
            name = name or (str(node.get("id", "")) if kind == "line" else "")
            for place in places:
                element = elements.get(str(place.get("netElementRef")))
                if element is not None and kind == "line":
                    element.line = element.line or " ".join(name.split())
                elif element is not None and len(places) == 1:
                    element.name = element.name or " ".join(name.split())
                    for label in children(node, "designator"):
                        if label.get("register") == "railnav":
                            element.track = str(label.get("entry", ""))
            continue
        if kind == "horizontalCurve" and str(node.get("curveType")) not in CURVES:
            reader.refuse(
                node, f"curveType {str(node.get('curveType'))[:40]!r} is not read", f"known are {', '.join(CURVES)}"
            )
        if len(places) > 1:
            reader.note(f"{kind} {node.get('id')!r} spans {len(places)} net elements and is passed over")
            continue
        for place in places:
            element = elements.get(str(place.get("netElementRef")))
            if element is None:
                continue
            begin, end = _range(reader, place, element)
            keeps = str(place.get("keepsOrientation", "true")).lower() in ("true", "1")
            into = element.curves if kind == "horizontalCurve" else element.gradients
            into.append((begin, end, keeps, node))
    if passed:
        reader.note(f"{passed} superelevation curves are not read")
    named = [element.track for element in elements.values() if element.track]
    for element in elements.values():
        if not element.track or len(set(named)) < len(named):
            element.track = element.id


def _range(reader: _Reader, place: Any, element: _Element) -> tuple[float, float]:
    """Intrinsic coordinates between which something lies on a net element; all of it where none are stated."""
    ends = []
    for name, absolute, default in (("intrinsicCoordBegin", "posBegin", 0.0), ("intrinsicCoordEnd", "posEnd", 1.0)):
        if place.get(name) is not None:
            ends.append(reader.number(place, name, low=-1e-6, high=1.0 + 1e-6))
        elif place.get(absolute) is not None and element.length:
            ends.append(reader.number(place, absolute, low=-1.0, high=element.length + 1.0) / element.length)
        else:
            ends.append(default)
    return min(ends), max(ends)


def _spot(reader: _Reader, node: Any, model: TrackModel, index: dict[str, int]) -> tuple[int, float] | None:
    """Track and offset of a spotLocation, or None where it names no net element of the model."""
    for place in children(node, "spotLocation"):
        track = index.get(str(place.get("netElementRef")))
        if track is None:
            continue
        length = float(model.lengths[track])
        if place.get("intrinsicCoord") is not None:
            return track, reader.number(place, "intrinsicCoord", low=-1e-6, high=1.0 + 1e-6) * length
        if place.get("pos") is not None:
            return track, min(max(reader.number(place, "pos", low=-1.0, high=1e7), 0.0), length)
        return track, 0.0
    return None


def _name(node: Any) -> str:
    found = [str(child.get("name", "")) for child in children(node, "name")]
    return " ".join((found[0] if found else "").split()) or str(node.get("id", ""))


def _points(
    reader: _Reader, infrastructure: Any, model: TrackModel, index: dict[str, int]
) -> tuple[IntArray, dict[int, str]]:
    """Kinds of nodes, and names of those where a switch or crossing stands."""
    kinds = np.asarray(model.nodes.kind).copy()
    names: dict[int, str] = {}
    stop: set[int] = set()
    for node in infrastructure.iter():
        kind = local_name(node)
        if kind not in ("switchIS", "crossing", "bufferStop"):
            continue
        spot = _spot(reader, node, model, index)
        if spot is None:
            continue
        i, offset = spot
        length = float(model.lengths[i])
        if min(offset, length - offset) > 1.0:
            if kind != "bufferStop":
                reader.note(f"{kind} {_name(node)!r} lies {offset:.1f} m along {model.track_id[i]}, not at an end")
            continue
        at = int(model.start_node[i] if offset < 0.5 * length else model.end_node[i])
        if kind == "bufferStop":
            stop.add(at)
            continue
        if kind == "switchIS" and np.count_nonzero(np.append(model.start_node, model.end_node) == at) < 3:
            reader.note(f"switch {_name(node)!r}: fewer than three net elements meet there")
        names[at] = _name(node)
    degree = np.bincount(np.concatenate([model.start_node, model.end_node]), minlength=len(kinds))
    kinds[degree == 3] = NodeKind.TURNOUT
    for at in stop:
        if degree[at] == 1:
            kinds[at] = NodeKind.BUFFER_STOP
    return kinds, names


def _balises(reader: _Reader, infrastructure: Any, model: TrackModel, index: dict[str, int]) -> list[dict[str, Any]]:
    found = []
    for node in infrastructure.iter():
        if local_name(node) != "balise":
            continue
        spot = _spot(reader, node, model, index)
        if spot is not None:
            track, offset = spot
            own = [label.get("entry") for label in children(node, "designator") if label.get("register") == "railnav"]
            found.append(
                {
                    "id": str(own[0] if own else node.get("id", "")),
                    "name": _name(node),
                    "track": model.track_id[track],
                    "offset_m": round(offset, 4),
                }
            )
    return found


# --- geometry ---------------------------------------------------------------------------------------------------------


def _section(reader: _Reader, frame: GridFrame, element: _Element, geographic: bool, spacing: float) -> TrackSection:
    """One track: its curves where they cover it, else its drawn line; heights, chainage."""
    knots = None
    if element.curves and geographic:
        reader.note(f"net element {element.id}: curves on geographic coordinates are not laid; its drawn line counts")
    elif element.curves:
        knots = _laid(reader, frame, element, spacing)
    if knots is None:
        knots = lay_line(frame, element.point, spacing)
    posts = _posts(reader, element, float(knots.offset[-1]))
    return TrackSection(element.track, knots, element.line, element.name, posts=posts)


def _posts(reader: _Reader, element: _Element, length: float) -> FloatArray | None:
    """Offsets and chainages of the linear positioning system that has most marks on the net element."""
    systems = {system for _, system, _ in element.measures}
    if not systems:
        return None
    best = max(sorted(systems), key=lambda s: sum(system == s for _, system, _ in element.measures))
    marks = np.array(sorted({(at * length, value) for at, system, value in element.measures if system == best}))
    grown = abs(marks[-1, 1] - marks[0, 1])
    span = marks[-1, 0] - marks[0, 0]
    if len(marks) > 1 and span > 1.0 and 0.5e-3 < grown / span < 2e-3:
        marks[:, 1] *= 1e3
        reader.note(f"net element {element.id}: measures are kilometres, told from its length")
    elif len(marks) > 1 and span > 10.0 and not 0.5 < grown / span < 2.0:
        reader.note(f"net element {element.id}: measures grow {grown:g} on {span:.1f} m")
    return marks


def _laid(reader: _Reader, frame: GridFrame, element: _Element, spacing: float) -> KnotTable | None:
    """The curves of a net element laid out; None, with a note, where they do not lead along its points."""
    rows = sorted(element.curves, key=lambda row: row[:2])
    begin, end = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    holes = max(begin[0], 1.0 - end[-1], float(np.abs(begin[1:] - end[:-1]).max(initial=0.0)))
    drawn = float(np.hypot(*np.diff(element.point[:, :2], axis=0).T).sum())
    if holes * drawn > LARGEST_GAP + 1e-6 * drawn:
        reader.note(
            f"net element {element.id}: its curves leave {holes * drawn:.2f} m uncovered; its drawn line counts"
        )
        return None
    length = np.array([reader.number(row[3], "length", low=1e-3, high=1e6) for row in rows])
    plan = _plan(reader, element, rows, length)
    gap, _ = closing(plan, end=element.point[-1, :2])
    off = np.hypot(gap[:, 0], gap[:, 1])
    worst = int(off.argmax())
    if off[worst] > LARGEST_GAP:
        reader.note(
            f"net element {element.id}: its curves lead {off[worst]:.2f} m past its points (horizontalCurve "
            f"{rows[worst][3].get('id')!r}); its drawn line counts"
        )
        return None
    profile, breaks = _profile(reader, element, plan)
    laid = lay(frame, plan, gap=gap, profile=profile, breaks=breaks, spacing=spacing)
    return laid.tables[0]


def _plan(
    reader: _Reader, element: _Element, rows: Sequence[tuple[float, float, bool, Any]], length: FloatArray
) -> Plan:
    """Elements in order, each from the net element's own point where one stands at its begin, else from the last one's end."""
    n = len(rows)
    kind = np.array([CURVES[str(row[3].get("curveType"))] for row in rows], np.int64)
    sense = np.array([1.0 if row[2] else -1.0 for row in rows])
    radius = np.array([reader.number(row[3], "radius", 0.0) for row in rows]) * sense
    turned = [
        math.radians(reader.number(row[3], "deltaAzimuth", low=-720.0, high=720.0)) * s
        if row[3].get("deltaAzimuth")
        else None
        for row, s in zip(rows, sense, strict=True)
    ]
    for i in np.flatnonzero((kind == ARC) & (np.abs(radius) < 5.0)).tolist():
        reader.refuse(rows[i][3], f"radius is {radius[i]:g} m", "an arc has the radius of its circle, a straight has 0")
    bend = np.where(kind == STRAIGHT, 0.0, 1.0 / np.where(radius == 0.0, np.inf, radius))
    places = np.array([row[0] for row in rows])
    known = np.abs(element.at[:, None] - places[None, :]) < max(_SAME_PLACE, 1e-7)
    start = np.full((n, 2), np.nan)
    for i in range(n):
        hits = np.flatnonzero(known[:, i])
        if len(hits):
            start[i] = element.point[hits[0], :2]
    start[0] = element.point[0, :2]
    stops = np.vstack([start[1:], element.point[-1, :2]])
    k0, k1, bearing, onward = np.empty(n), np.empty(n), np.empty(n), 0.0
    for i, (_, _, keeps, node) in enumerate(rows):
        if node.get("azimuth") is not None:
            bearing[i] = math.radians(reader.number(node, "azimuth", low=-720.0, high=720.0))
            if not keeps:
                bearing[i] += math.pi - (turned[i] or 0.0)
        elif i == 0:
            step = element.point[1, :2] - element.point[0, :2]
            bearing[0] = math.atan2(*step) - 0.5 * (turned[0] or bend[0] * length[0]) / max(len(element.at) - 1, 1)
        else:
            bearing[i] = onward
        choices = _ends(reader, i, kind, bend, turned, length, rows)
        one = None
        best = math.inf
        for a, b in choices:
            trial = Plan(
                length[i : i + 1], kind[i : i + 1], np.array([a]), np.array([b]),
                start[i : i + 1, 0], start[i : i + 1, 1], bearing[i : i + 1], np.zeros(1),
            )  # fmt: skip
            at, direction = integrate(trial, trial.edges)
            off = float(np.hypot(*(at[-1] - stops[i]))) if np.isfinite(stops[i]).all() else 0.0
            if one is None or off < best:
                one, best, k0[i], k1[i], onward = at[-1], off, a, b, float(direction[-1])
        if i + 1 < n and np.isnan(start[i + 1, 0]) and one is not None:
            start[i + 1] = one
    return Plan(length, kind, k0, k1, start[:, 0].copy(), start[:, 1].copy(), bearing, np.zeros(n))


def _ends(
    reader: _Reader,
    i: int,
    kind: IntArray,
    bend: FloatArray,
    turned: Sequence[float | None],
    length: FloatArray,
    rows: Sequence[tuple[float, float, bool, Any]],
) -> list[tuple[float, float]]:
    """What the curvatures at both ends of a curve may be."""
    if kind[i] in (STRAIGHT, ARC):
        return [(float(bend[i]), float(bend[i]))]
    beside = [float(bend[j]) if 0 <= j < len(kind) and kind[j] in (STRAIGHT, ARC) else None for j in (i - 1, i + 1)]
    whole = turned[i]
    if whole is not None and bend[i] != 0.0 and kind[i] != CUBIC:
        other = 2.0 * whole / float(length[i]) - float(bend[i])
        other = 0.0 if abs(other) < 1e-9 else other
        either = [(float(bend[i]), other), (other, float(bend[i]))]
        # the one that goes on from its neighbours comes first: it counts where no point tells
        return sorted(
            either, key=lambda ends: sum(abs(k - b) for k, b in zip(ends, beside, strict=True) if b is not None)
        )
    first, last = beside
    if first is not None and last is not None:
        return [(first, last)]
    if bend[i] != 0.0 and kind[i] == CUBIC:
        return [(float(bend[i]), 0.0), (0.0, float(bend[i]))]
    if whole is not None and kind[i] != CUBIC and (first is not None or last is not None):
        rest = 2.0 * whole / float(length[i]) - (first if first is not None else last or 0.0)
        return [(first, rest)] if first is not None else [(rest, float(last or 0.0))]
    if bend[i] != 0.0 and (first is not None or last is not None):
        return [(first, float(bend[i]))] if first is not None else [(float(bend[i]), float(last or 0.0))]
    return reader.refuse(
        rows[i][3],
        "the curvatures at its ends are not known",
        "state its radius and deltaAzimuth, or a straight or arc on both sides",
    )


def _profile(reader: _Reader, element: _Element, plan: Plan) -> tuple[Any, FloatArray]:
    """Heights by grid length: gradient curves from the first height, or a spline through the heights of the points."""
    nothing = np.empty(0)
    total = float(plan.edges[-1])
    z = element.point[:, 2]
    have = np.isfinite(z)
    if not have.any():
        return None, nothing
    rows = sorted(element.gradients, key=lambda row: row[:2])
    along = element.at * total
    if rows and have[0] and rows[0][0] < _SAME_PLACE and rows[-1][1] > 1.0 - _SAME_PLACE:
        table = []
        height = float(z[0])
        for begin, end, keeps, node in rows:
            width = (end - begin) * total
            slope = reader.number(node, "gradient", 0.0, low=-500.0, high=500.0) * 1e-3
            change = reader.number(node, "deltaGradient", 0.0, low=-500.0, high=500.0) * 1e-3
            if not keeps:
                slope, change = -(slope + change), change
            if width < 1e-6:
                continue
            stated = np.flatnonzero(np.abs(element.at - begin) < _SAME_PLACE)
            height = float(z[stated[0]]) if len(stated) and have[stated[0]] else height
            table.append((begin * total, begin * total, height, slope, 0.5 * change / width, 0.0))
            height += (slope + 0.5 * change) * width
        if (table and abs(height - float(z[-1])) < LARGEST_GAP) or not have[-1]:
            columns = np.array(table).T.copy()
            columns[0, 0] = -np.inf
            return Gradients(*columns), columns[1, 1:]
        reader.note(
            f"net element {element.id}: its gradients lead {abs(height - float(z[-1])):.2f} m past its last height; "
            "its heights count"
        )
    if not have.all():
        reader.note(f"net element {element.id}: heights are missing at some of its points; it has none")
        return None, nothing
    from scipy.interpolate import CubicSpline

    curve = CubicSpline(along, z) if len(z) > 2 else None
    if curve is None:
        grade = (z[1] - z[0]) / total
        return Gradients(*(np.array([v]) for v in (-np.inf, 0.0, z[0], grade, 0.0, 0.0))), nothing

    def spline(at: FloatArray, derivative: int = 0) -> FloatArray:
        return np.asarray(curve(np.clip(at, 0.0, total), derivative))

    return spline, nothing
