"""Alignments as LandXML 1.2: what `railnav.io.landxml` reads, written.

Points are "northing easting", `rot="cw"` is a curve to the right, directions are radians clockwise from north, cant is in
millimetres. The line of a track, which LandXML has no place for, rides in a Feature of the alignment.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from railnav.errors import InputError
from railnav.io.atomic import atomic_path
from railnav.io.design import ARC, BLOSS, CLOTHOID, COSINE, CUBIC, HELMERT, SINE, STRAIGHT, VIENNESE, Plan, integrate
from railnav.io.designed import DesignedAlignment, designed_tracks
from railnav.track.model import TrackModel

#: Names of the transitions as LandXML has them.
SPIRALS = {
    CLOTHOID: "clothoid",
    BLOSS: "bloss",
    COSINE: "cosine",
    SINE: "sinusoid",
    HELMERT: "biquadratic",
    VIENNESE: "weinerBogen",  # as the schema spells it
    CUBIC: "cubicParabola",
}
#: Mark of the Feature that carries what LandXML has no place for.
FEATURE = "railnav"


def write_landxml(
    tracks: TrackModel | Sequence[DesignedAlignment],
    path: str | Path,
    *,
    crs_wkt: str = "",
    project: str = "",
    tolerance: float = 2e-4,
) -> None:
    """Write a model or designed alignments as LandXML 1.2, whole or not at all.

    Parameters
    ----------
    tracks : TrackModel or sequence of DesignedAlignment
        A model's tracks are laid into straights, arcs and clothoids first (`railnav.io.designed.designed_tracks`); designed ones keep
        their elements.
    path : path
        File to write; replaced in one step if it exists.
    crs_wkt : str
        Plane of designed alignments as well-known text, for the file's CoordinateSystem; a model has its own.
    project : str
        Name of the project; by default the file's.
    tolerance : float
        Greatest distance of a model's elements from its knots, m.

    Raises
    ------
    InputError
        No alignments, one without elements, a name twice, a transition other than a clothoid that bends both ways, or a file that
        cannot be written.

    Notes
    -----
    A clothoid that bends both ways becomes two, which meet where it is straight: LandXML has one sense of turning for each.
    Coordinates have 7 decimals and curvature all digits. A model read back lies within 1 mm, its stations within 10 mm of its
    posts. Nodes, movements, covariance and provenance have no place in LandXML: junctions follow from the ends when it is read.
    Where stations count in ground metres, or kilometres are stretched, they fit at the posts and drift between them.

    References
    ----------
    LandXML-1.2.xsd: Alignment, CoordGeom, Profile, Cant, StaEquation.

    Examples
    --------
    >>> import tempfile
    >>> from railnav import demo_line
    >>> from railnav.io.landxml import read_landxml
    >>> model = demo_line()
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_landxml(model, f"{folder}/line.xml")
    ...     again = read_landxml(f"{folder}/line.xml")
    >>> bool(np.abs(again.lengths - model.lengths).max() < 2e-3)
    True
    """
    path = Path(path)
    if isinstance(tracks, TrackModel):
        crs_wkt = tracks.frame.crs_wkt
        alignments: Sequence[DesignedAlignment] = designed_tracks(tracks, tolerance=tolerance)
    else:
        alignments = tracks
    if not alignments:
        raise InputError("there are no alignments to write", file=path)
    seen: set[str] = set()
    alignments = [replace(alignment, plan=_bent_one_way(alignment.plan)) for alignment in alignments]
    for alignment in alignments:
        if alignment.name in seen:
            raise InputError(f"alignment {alignment.name!r} stands twice", file=path, remedy="name each of them")
        seen.add(alignment.name)
        if not len(alignment.plan.length):
            raise InputError(f"alignment {alignment.name!r} has no elements", file=path)
        both = (alignment.plan.curvature_start * alignment.plan.curvature_end < 0.0).nonzero()[0]
        if len(both):
            law = SPIRALS.get(int(alignment.plan.kind[both[0]]), "element")
            cause = f"alignment {alignment.name!r}, element {int(both[0]) + 1}: a {law} that bends both ways"
            raise InputError(
                cause, file=path, remedy="LandXML has one rot for each, and only clothoids can be split: use clothoids"
            )
    with atomic_path(path) as draft, draft.open("w", encoding="utf-8", newline="\n") as file:
        for line in _document(alignments, crs_wkt, project or path.stem):
            file.write(line + "\n")


def _bent_one_way(plan: Plan) -> Plan:
    """Return the plan with every clothoid that bends both ways cut in two at its point of inflection; the axis stays what it is."""
    first, last = plan.curvature_start, plan.curvature_end
    both = np.flatnonzero((first * last < 0.0) & (plan.kind == CLOTHOID))
    if not len(both):
        return plan
    share = first[both] / (first[both] - last[both])
    points, bearing = integrate(plan, plan.edges[both] + share * plan.length[both])
    length, curvature_end = plan.length.copy(), last.copy()
    length[both], curvature_end[both] = share * plan.length[both], 0.0
    return Plan(
        length=np.insert(length, both + 1, (1.0 - share) * plan.length[both]),
        kind=np.insert(plan.kind, both + 1, CLOTHOID),
        curvature_start=np.insert(first, both + 1, 0.0),
        curvature_end=np.insert(curvature_end, both + 1, last[both]),
        easting=np.insert(plan.easting, both + 1, points[:, 0]),
        northing=np.insert(plan.northing, both + 1, points[:, 1]),
        grid_bearing=np.insert(plan.grid_bearing, both + 1, bearing),
        sway=np.insert(plan.sway, both + 1, 0.0),
    )


def _document(alignments: Sequence[DesignedAlignment], crs_wkt: str, project: str) -> Iterator[str]:
    from railnav import __version__
    from railnav.io.container import _now

    now = datetime.fromisoformat(_now().replace("Z", "+00:00")).astimezone(UTC)
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield (
        f'<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2" date="{now:%Y-%m-%d}" time="{now:%H:%M:%S}">'
    )
    yield (
        ' <Units><Metric areaUnit="squareMeter" linearUnit="meter" volumeUnit="cubicMeter" temperatureUnit="celsius" '
        'pressureUnit="HPA" angularUnit="radians" directionUnit="radians"/></Units>'
    )
    if crs_wkt:
        from railnav.io.container import describe_crs

        name, code, organization, _, wkt = describe_crs(crs_wkt)
        epsg = f' epsgCode="{code}"' if organization == "EPSG" else ""
        yield f" <CoordinateSystem name={quoteattr(name)}{epsg} ogcWktCode={quoteattr(wkt)}/>"
    yield f" <Project name={quoteattr(project)}/>"
    yield f' <Application name="railnav" version={quoteattr(__version__)}/>'
    yield f" <Alignments name={quoteattr(project)}>"
    for alignment in alignments:
        yield from _alignment(alignment)
    yield " </Alignments>"
    yield "</LandXML>"


def _number(value: float, decimals: int = 7) -> str:
    text = f"{float(value):.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def _point(name: str, at: Any) -> str:
    return f"<{name}>{at[1]:.7f} {at[0]:.7f}</{name}>"


def _alignment(alignment: DesignedAlignment) -> Iterator[str]:
    plan = alignment.plan
    edges = plan.edges
    start = alignment.start_station or 0.0
    about = f" desc={quoteattr(alignment.description)}" if alignment.description else ""
    yield (
        f'  <Alignment name={quoteattr(alignment.name)} length="{_number(edges[-1])}" staStart="{_number(start)}"{about}>'
    )
    yield "   <CoordGeom>"
    ends, bearing = integrate(plan, edges)
    starts = np.column_stack([plan.easting, plan.northing])
    stated = np.vstack([starts[1:], ends[-1]])
    for i, kind in enumerate(plan.kind.tolist()):
        yield "    " + _element(
            kind,
            float(plan.length[i]),
            (float(plan.curvature_start[i]), float(plan.curvature_end[i])),
            (starts[i], stated[i]),
            (float(plan.grid_bearing[i]), float(bearing[i + 1])),
        )
    yield "   </CoordGeom>"
    yield from _profile(alignment, start)
    yield from _cant(alignment, start)
    for where, ahead, sense in alignment.equations:
        way = "" if sense > 0.0 else ' staIncrement="decreasing"'
        yield f'   <StaEquation staInternal="{_number(start + where)}" staAhead="{_number(ahead)}"{way}/>'
    told = {"line": alignment.line} if alignment.line else {}
    if alignment.start_station is None:
        told["chainage"] = "none"
    if told:
        inner = "".join(f'<Property label="{key}" value={quoteattr(value)}/>' for key, value in told.items())
        yield f'   <Feature code="{FEATURE}">{inner}</Feature>'
    yield "  </Alignment>"


def _element(
    kind: int, length: float, bend: tuple[float, float], ends: tuple[Any, Any], bearings: tuple[float, float]
) -> str:
    start, end = ends
    first = np.array([math.sin(bearings[0]), math.cos(bearings[0])])
    heading = f"{bearings[0] % (2.0 * math.pi):.12g}"
    if kind == STRAIGHT or bend == (0.0, 0.0):
        drawn = math.atan2(*(end - start)) % (2.0 * math.pi)
        return (
            f'<Line dir="{drawn:.12g}" length="{_number(length)}">{_point("Start", start)}{_point("End", end)}</Line>'
        )
    rot = "cw" if sum(bend) > 0.0 else "ccw"
    if kind == ARC:
        radius = 1.0 / bend[0]
        centre = start + radius * np.array([first[1], -first[0]])
        return (
            f'<Curve rot="{rot}" crvType="arc" radius="{abs(radius):.10g}" length="{_number(length)}" dirStart="{heading}">'
            f"{_point('Start', start)}{_point('Center', centre)}{_point('End', end)}</Curve>"
        )
    radii = ["INF" if k == 0.0 else f"{abs(1.0 / k):.12g}" for k in bend]
    turn = bearings[1] - bearings[0]
    chord = end - start
    reach = 0.5 * length  # for turns too small to tell the tangents' intersection
    if abs(math.sin(turn)) > 1e-6:
        last = np.array([math.sin(bearings[1]), math.cos(bearings[1])])
        reach = float((chord[0] * last[1] - chord[1] * last[0]) / (first[0] * last[1] - first[1] * last[0]))
        reach = reach if 0.05 * length < reach < 20.0 * length else 0.5 * length
    return (
        f'<Spiral spiType="{SPIRALS[kind]}" rot="{rot}" length="{_number(length)}" radiusStart="{radii[0]}" '
        f'radiusEnd="{radii[1]}" dirStart="{heading}">'
        f"{_point('Start', start)}{_point('PI', start + reach * first)}{_point('End', end)}</Spiral>"
    )


def _profile(alignment: DesignedAlignment, start: float) -> Iterator[str]:
    vertical = alignment.vertical
    if vertical is None:
        return
    yield f"   <Profile><ProfAlign name={quoteattr(alignment.name)}>"
    for along, height, length, radius in zip(
        vertical.along, vertical.height, vertical.curve_length, vertical.radius, strict=True
    ):
        at = f"{start + along:.7f} {height:.7f}"
        if radius > 0.0:
            yield f'    <CircCurve radius="{radius:.10g}">{at}</CircCurve>'
        elif length > 0.0:
            yield f'    <ParaCurve length="{_number(length)}">{at}</ParaCurve>'
        else:
            yield f"    <PVI>{at}</PVI>"
    yield "   </ProfAlign></Profile>"


def _cant(alignment: DesignedAlignment, start: float) -> Iterator[str]:
    cant = alignment.cant
    if cant is None:
        return
    yield f'   <Cant name={quoteattr(alignment.name)} gauge="1.435" rotationPoint="center">'
    rows: list[tuple[float, float, int]] = []
    for i in range(len(cant.start)):
        if not rows or abs(rows[-1][1] - cant.start[i]) > 1e-9:
            rows.append((float(cant.edges[i]), float(cant.start[i]), int(cant.kind[i])))
        else:
            rows[-1] = (*rows[-1][:2], int(cant.kind[i]))
        rows.append((float(cant.edges[i + 1]), float(cant.end[i]), CLOTHOID))
    for where, level, kind in rows:
        rot = "cw" if level >= 0.0 else "ccw"
        law = SPIRALS.get(kind, SPIRALS[CLOTHOID])
        yield (
            f'    <CantStation station="{start + where:.7f}" appliedCant="{_number(abs(level) * 1e3, 5)}" curvature="{rot}" '
            f'transitionType="{law}"/>'
        )
    yield "   </Cant>"
