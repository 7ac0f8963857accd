"""Alignments as LandXML 1.2: plan, profile, cant and station equations become tracks.

What the format leaves open is settled by the file's own points, which are "northing easting": the direction of an element
follows from its centre or its point of intersection, never from `dir`, which programs count from north or from east, left or
right about. `rot="cw"` is a curve to the right (positive here); `appliedCant` is in millimetres and raises the outer rail of
the curve that `curvature` names, unless it is adverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, InputError
from railnav.geodesy.grid import frame_for_grid
from railnav.io.design import (
    Cant,
    Laid,
    Plan,
)
from railnav.io.junctions import Design, join_designs
from railnav.io.landxml_document import Place, direction_unit, document, features, named_plane
from railnav.io.landxml_plan import judge_directions, read_plan
from railnav.io.landxml_stations import EQUATION, SAME_STATION, read_cant, read_equations, read_profile
from railnav.io.xml_document import local_name as _local
from railnav.track.elements import Gradients
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

#: What one repeats while reading is said so often, then counted.
_MOST_NOTES = 20
#: Distance of the posts that keep stations to a millimetre while the grid's scale changes, m.
_POST_EVERY = 500.0


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
    root = document(path)
    named = named_plane(root)
    if crs is None and not named:
        raise InputError(
            "grid coordinates need the plane they lie in", file=path, remedy="name it, e.g. --crs EPSG:31467"
        )
    unit = direction_unit(root, path)
    found = [node for node in root.iter() if _local(node) == "Alignment"]
    if not found:
        raise InputError("has no Alignment", file=path, remedy="export the track's alignments, with CoordGeom")
    notes: list[str] = []
    if crs is not None and named and str(crs) != named:
        notes.append(f"the file names {named[:60]}, but --crs counts: {str(crs)[:60]}")
    crs = named if crs is None else crs
    alignments = [read_alignment(path, node, unit, notes) for node in found]
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
                rows += [(offset - EQUATION, back), (offset + EQUATION, ahead)]
                at, station, sense = where, ahead, onward
        rows.append((float(laid.ground[-1]), station + sense * (length - at)))
        return np.array(rows)


def read_alignment(path: Path, node: Any, unit: str, notes: list[str]) -> _Alignment:
    """Read one alignment: its plan, and what lies along it by station; what is odd goes to `notes`."""
    name = " ".join(str(node.get("name", "")).split())
    if not name:
        raise InputError(f"the Alignment in line {node.sourceline} has no name", file=path, remedy="name it")
    place = Place(path, name[:60])
    plan, nodes, gap, kink = read_plan(place, node, notes)
    length = float(plan.edges[-1])
    stated = place.number(node, "length", default=length)
    if abs(stated - length) > SAME_STATION:
        notes.append(f"{name}: the plan is {length:.3f} m long, the alignment says {stated:.3f} m; the plan counts")
    start = place.number(node, "staStart", default=0.0)
    profile, breaks = read_profile(place, node, start, length, notes)
    noted = features(node)
    return _Alignment(
        name,
        " ".join(str(node.get("desc", "")).split()),
        start,
        read_equations(place, node, start, length, notes),
        plan,
        gap,
        np.abs(kink[:-1]),
        profile,
        breaks,
        read_cant(place, node, start, plan, notes),
        judge_directions(place, nodes, plan, unit, notes),
        noted.get("line", ""),
        noted.get("chainage") != "none",
    )
