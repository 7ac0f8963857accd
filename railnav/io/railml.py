"""railML 3.1 to 3.3 infrastructure: net elements become tracks, net relations the movements, curves the plan, gradients the profile.

Signs are railML's: azimuth in degrees clockwise from north, radius negative to the left and 0 for a straight, gradients in per mille,
positive uphill; the radius of a vertical arc is negative in a valley. Coordinates are x (easting, longitude), y (northing, latitude).
railML 2 is read by `railnav.io.railml2`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, InputError, TrackError
from railnav.geodesy.grid import GridFrame, choose_frame, frame_for_grid
from railnav.io.railml_document import NetElement, Reader
from railnav.io.railml_geometry import CURVES, SAME_PLACE, section
from railnav.io.xml_document import children, local_name, read_document
from railnav.track.assembly import assemble
from railnav.track.model import NodeKind, TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Ends that a relation joins are one node within this, m.
JOIN_WITHIN = 0.5
_GEOGRAPHIC = {"4326", "4258", "4979", "4937", "CRS84"}


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
        return _read(Reader(path), root, version, crs, zone_width, ellipsoid, spacing)
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
    reader: Reader, root: Any, version: str, crs: Any, zone_width: int, ellipsoid: str, spacing: float
) -> TrackModel:
    infrastructure = _only(reader, root, "infrastructure")
    elements = _elements(reader, infrastructure)
    frame, geographic = _frame(reader, root, elements, crs, zone_width, ellipsoid)
    _along(reader, infrastructure, elements)
    sections = [section(reader, frame, element, geographic, spacing) for element in elements.values()]
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


def _only(reader: Reader, root: Any, name: str) -> Any:
    found = children(root, name)
    if not found:
        raise InputError(f"has no {name}", file=reader.path, remedy=f"export the {name}")
    return found[0]


def _elements(reader: Reader, infrastructure: Any) -> dict[str, NetElement]:
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
    elements: dict[str, NetElement] = {}
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


def _element(reader: Reader, node: Any, name: str) -> NetElement:
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
    if len(at_) < 2 or at_[0] > SAME_PLACE or at_[-1] < 1.0 - SAME_PLACE:
        reader.refuse(
            node,
            "has no geometricCoordinate at both of its ends (intrinsicCoord 0 and 1)",
            "export geographic positions: a network without places is no track model",
        )
    length = reader.number(node, "length", low=1e-3, high=1e7) if node.get("length") else None
    return NetElement(name, node, length, at_, np.array([rows[a] for a in at_]), sorted(measures))


def _frame(
    reader: Reader, root: Any, elements: dict[str, NetElement], crs: Any, zone_width: int, ellipsoid: str
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


def _is_geographic(definition: str, reader: Reader) -> bool:
    import pyproj
    from pyproj.exceptions import CRSError

    try:
        return bool(pyproj.CRS.from_user_input(definition).is_geographic)
    except CRSError as error:
        raise InputError(
            f"crsDefinition {definition[:60]!r} is no coordinate system", file=reader.path, remedy="use EPSG:code"
        ) from error


def _movements(reader: Reader, infrastructure: Any, index: dict[str, int]) -> IntArray:
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


def _along(reader: Reader, infrastructure: Any, elements: dict[str, NetElement]) -> None:
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


def _range(reader: Reader, place: Any, element: NetElement) -> tuple[float, float]:
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


def _spot(reader: Reader, node: Any, model: TrackModel, index: dict[str, int]) -> tuple[int, float] | None:
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
    reader: Reader, infrastructure: Any, model: TrackModel, index: dict[str, int]
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


def _balises(reader: Reader, infrastructure: Any, model: TrackModel, index: dict[str, int]) -> list[dict[str, Any]]:
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
