"""Designs of tracks as files: LandXML alignments, or tables of elements with their profile and cant beside them.

`design.xml` holds everything. `design.csv` holds the plan, a row an element (the columns of a network of elements); where there is a
profile or cant, `design_profile.csv` (points of vertical intersection) and `design_cant.csv` (stretches) stand beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError, TrackError
from railnav.io.elements import plan_columns
from railnav.io.tables import Column, Table, Words, read_table, write_table
from railnav.monitoring.design import Design
from railnav.track.elements import ARC, CLOTHOID, CUBIC, KIND_NAMES, STRAIGHT, VIENNESE, Cant, Gradients, Plan

FloatArray = NDArray[np.float64]

LANDXML_ENDINGS = (".xml", ".landxml")
TABLE_ENDINGS = (".csv",)
#: Endings of designs.
DESIGN_ENDINGS = (*LANDXML_ENDINGS, *TABLE_ENDINGS)

_ELEMENTS = (
    *plan_columns(", ".join(KIND_NAMES)),
    Column("sway_1_m", required=False, complete=False),
)
_PROFILE = (
    Column("track", text=True),
    Column("station_m", low=-1e7, high=1e7),
    Column("height_m", low=-1000.0, high=10_000.0),
    Column("parabola_length_m", complete=False, low=0.0, high=1e5),
    Column("circle_radius_m", complete=False, low=0.0, high=1e9),
)
_CANT = (
    Column("track", text=True),
    Column("start_m", low=-1e7, high=1e7),
    Column("end_m", low=-1e7, high=1e7),
    Column("cant_start_mm", low=-500.0, high=500.0),
    Column("cant_end_mm", low=-500.0, high=500.0),
    Column("law", text=True),
)


def read_designs(path: str | Path, *, crs: str = "") -> tuple[Design, ...]:
    """Read the designs of tracks from LandXML or a table of elements.

    Parameters
    ----------
    path : path
        `.xml`, `.landxml` (plan, first profile, first cant of each Alignment), or `.csv` as `write_designs` writes it.
    crs : str
        The plane, where the file does not name it.

    Returns
    -------
    tuple of Design
        In the order of the file; never empty.

    Raises
    ------
    InputError
        The file is missing, malformed, or of another kind; see `railnav.io.landxml.read_landxml` and
        `railnav.io.elements.read_elements`.

    Examples
    --------
    >>> read_designs("nowhere.xml")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.xml: does not exist; check the name
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending in LANDXML_ENDINGS:
        return _read_landxml(path, crs)
    if ending in TABLE_ENDINGS:
        return _read_tables(path, crs)
    raise InputError("is no design that railnav reads", file=path, remedy=f"use {', '.join(DESIGN_ENDINGS)}")


def write_designs(designs: Sequence[Design], path: str | Path) -> tuple[Path, ...]:
    """Write designs as LandXML 1.2 or as tables, by the ending.

    Parameters
    ----------
    designs : sequence of Design
        At least one, each with a track of its own.
    path : path
        `.xml`, `.landxml` or `.csv`; replaced whole.

    Returns
    -------
    tuple of Path
        The files written.

    Raises
    ------
    InputError
        Nothing to write, a track twice, a cubic parabola in LandXML, or a file that cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from railnav.monitoring.design import design_of_elements
    >>> design = design_of_elements("1", ["straight", "bloss", "arc"], [100.0, 80.0, 200.0], [0, 600.0, 600.0])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     written = write_designs([design], f"{folder}/design.xml")
    ...     (again,) = read_designs(f"{folder}/design.xml")
    >>> again.kinds, bool(abs(again.at(380.0).easting - design.at(380.0).easting) < 1e-6)
    (('straight', 'bloss', 'arc'), True)
    """
    path = Path(path)
    if not designs:
        raise InputError("there is no design to write", file=path)
    names = [design.track for design in designs]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"track {name!r} has two designs", file=path, remedy="write one of each track")
    ending = path.suffix.lower()
    if ending in LANDXML_ENDINGS:
        return _write_landxml(designs, path)
    if ending in TABLE_ENDINGS:
        return _write_tables(designs, path)
    raise InputError("an ending unknown for designs", file=path, remedy=f"use {', '.join(DESIGN_ENDINGS)}")


def vertical_points(design: Design) -> FloatArray:
    """Points of vertical intersection: (n, 4) of length from the start, height, parabola's length, circle's radius, m."""
    profile = design.profile
    if profile is None:
        return np.empty((0, 4))
    length = design.length
    begins = np.maximum(profile.begin, 0.0)
    ends = np.append(begins[1:], length)
    rows = [(0.0, float(profile(np.array([0.0]))[0]), 0.0, 0.0)]
    straight = (profile.bend == 0.0) & (profile.radius == 0.0)
    for i in range(len(begins)):
        a, b = float(begins[i]), float(min(ends[i], length))
        if b - a < 1e-6 or a >= length:
            continue
        (h0, h1), (g0, g1) = _inside(profile, i, a, b)
        if straight[i]:
            if a > 1e-6 and straight[i - 1]:
                rows.append((a, h0, 0.0, 0.0))
            continue
        if abs(g1 - g0) < 1e-12:
            continue
        x = (h1 - h0 - g1 * (b - a)) / (g0 - g1)
        radius = abs(float(profile.radius[i]))
        rows.append((a + x, h0 + g0 * x, 0.0 if radius else b - a, radius))
    rows.append((length, float(profile(np.array([length]))[0]), 0.0, 0.0))
    return np.array(rows)


def _inside(profile: Gradients, i: int, a: float, b: float) -> tuple[FloatArray, FloatArray]:
    """Heights and slopes of piece i at both ends of a stretch."""
    own = Gradients(
        np.array([-np.inf]),
        profile.origin[i : i + 1],
        profile.height[i : i + 1],
        profile.slope[i : i + 1],
        profile.bend[i : i + 1],
        profile.radius[i : i + 1],
    )
    at = np.array([a, b])
    return own(at, 0), own(at, 1)


# --- LandXML ----------------------------------------------------------------------------------------------------------


def _read_landxml(path: Path, crs: str) -> tuple[Design, ...]:
    from railnav.io.landxml import read_alignment
    from railnav.io.landxml_document import direction_unit, document
    from railnav.io.xml_document import local_name as _local

    root = document(path)
    unit = direction_unit(root, path)
    for node in root:
        if not crs and _local(node) == "CoordinateSystem":
            code = str(node.get("epsgCode", "")).removeprefix("EPSG:")
            crs = f"EPSG:{code}" if code.isdigit() else str(node.get("ogcWktCode", ""))[:20_000]
    notes: list[str] = []
    designs: list[Design] = []
    for node in root.iter():
        if _local(node) == "Alignment":
            a = read_alignment(path, node, unit, notes)
            designs.append(Design(a.name, a.plan, start=a.start, profile=a.profile, cant=a.cant, crs=crs))
    if not designs:
        raise InputError("has no Alignment", file=path, remedy="export the track's alignments, with CoordGeom")
    return tuple(designs)


def _write_landxml(designs: Sequence[Design], path: Path) -> tuple[Path, ...]:
    from railnav.io.designed import DesignedAlignment, VerticalPoints
    from railnav.io.landxml_writer import SPIRALS, write_landxml

    rows = []
    for design in designs:
        unknown = [name for kind, name in enumerate(KIND_NAMES) if kind >= CLOTHOID and kind not in SPIRALS]
        for name in unknown:
            if name in design.kinds:
                raise InputError(
                    f"track {design.track!r} has a {name}, which railnav does not write to LandXML",
                    file=path,
                    remedy="write the design as .csv",
                )
        points = vertical_points(design)
        vertical = VerticalPoints(*(points[:, k].copy() for k in range(4))) if len(points) else None
        rows.append(DesignedAlignment(design.track, design.plan, vertical, design.cant, design.start))
    crs = designs[0].crs
    write_landxml(rows, path, crs_wkt=_as_wkt(crs))
    return (path,)


def _as_wkt(crs: str) -> str:
    """Well-known text of a plane; empty where it is none that the registry knows."""
    if not crs:
        return ""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return str(CRS.from_user_input(crs).to_wkt())
    except CRSError as error:
        raise InputError(f"{crs[:60]!r} is no coordinate system", remedy="name it as EPSG:2056") from error


# --- tables -----------------------------------------------------------------------------------------------------------


def _beside(path: Path, what: str) -> Path:
    return path.with_name(f"{path.stem}_{what}{path.suffix}")


def _write_tables(designs: Sequence[Design], path: Path) -> tuple[Path, ...]:
    with_profile = [design for design in designs if design.profile is not None]
    with_cant = [(design, design.cant) for design in designs if design.cant is not None]
    for what, some in (("profile", with_profile), ("cant", with_cant)):
        if not some and _beside(path, what).exists():
            raise InputError(
                f"has no {what}, but {_beside(path, what).name} stands beside it", file=path, remedy="remove that"
            )
    written = [path]
    plan = [design.plan for design in designs]
    names = [design.track for design in designs for _ in design.plan.length]
    with np.errstate(divide="ignore"):
        k0, k1 = (np.concatenate([getattr(p, f"curvature_{end}") for p in plan]) for end in ("start", "end"))
        radius = [np.where(k == 0.0, np.nan, 1.0 / k) for k in (k0, k1)]
    columns: dict[str, FloatArray | Words] = {
        "track": Words.of(names),
        "sequence": np.concatenate([np.arange(1.0, len(p.length) + 1.0) for p in plan]),
        "start_m": np.concatenate([design.stations[:-1] for design in designs]),
        "length_m": np.concatenate([p.length for p in plan]),
        "element": Words.of([kind for design in designs for kind in design.kinds]),
        "radius_start_m": radius[0],
        "radius_end_m": radius[1],
        "easting_m": np.concatenate([p.easting for p in plan]),
        "northing_m": np.concatenate([p.northing for p in plan]),
        "grid_bearing_deg": np.degrees(np.concatenate([p.grid_bearing for p in plan])),
    }
    decimals = {"sequence": 0, "start_m": 7, "length_m": 7, "radius_start_m": 7, "radius_end_m": 7}
    decimals |= {"easting_m": 7, "northing_m": 7, "grid_bearing_deg": 12}
    if any(p.sway.any() for p in plan):
        columns["sway_1_m"] = np.concatenate([p.sway for p in plan])
    write_table(path, columns, decimals=decimals)
    if with_profile:
        tables = [vertical_points(design) for design in with_profile]
        table = np.vstack(tables)
        start = np.concatenate([np.full(len(t), d.start) for t, d in zip(tables, with_profile, strict=True)])
        beside = _beside(path, "profile")
        write_table(
            beside,
            {
                "track": Words.of([d.track for t, d in zip(tables, with_profile, strict=True) for _ in t]),
                "station_m": start + table[:, 0],
                "height_m": table[:, 1],
                "parabola_length_m": np.where(table[:, 2] > 0.0, table[:, 2], np.nan),
                "circle_radius_m": np.where(table[:, 3] > 0.0, table[:, 3], np.nan),
            },
            decimals={"station_m": 7, "height_m": 7, "parabola_length_m": 7, "circle_radius_m": 5},
        )
        written.append(beside)
    if with_cant:
        beside = _beside(path, "cant")
        write_table(
            beside,
            {
                "track": Words.of([d.track for d, cant in with_cant for _ in cant.start]),
                "start_m": np.concatenate([d.start + cant.edges[:-1] for d, cant in with_cant]),
                "end_m": np.concatenate([d.start + cant.edges[1:] for d, cant in with_cant]),
                "cant_start_mm": 1e3 * np.concatenate([cant.start for _, cant in with_cant]),
                "cant_end_mm": 1e3 * np.concatenate([cant.end for _, cant in with_cant]),
                "law": Words.of([KIND_NAMES[max(k, CLOTHOID)] for _, cant in with_cant for k in cant.kind]),
            },
            decimals={"start_m": 7, "end_m": 7, "cant_start_mm": 6, "cant_end_mm": 6},
        )
        written.append(beside)
    return tuple(written)


def _read_tables(path: Path, crs: str) -> tuple[Design, ...]:
    table = read_table(path, _ELEMENTS)
    profile = read_table(_beside(path, "profile"), _PROFILE) if _beside(path, "profile").is_file() else None
    cant = read_table(_beside(path, "cant"), _CANT) if _beside(path, "cant").is_file() else None
    words, number = table.words["track"], table.number
    kind = _kinds(table, "element")
    bends = []
    for column in ("radius_start_m", "radius_end_m"):
        radius = number[column]
        small = np.flatnonzero(np.abs(radius) < 5.0)
        if len(small):
            i = int(small[0])
            table.refuse(i, column, f"a radius of {radius[i]:g} m", "leave the cell empty on a straight")
        bends.append(np.where(np.isnan(radius), 0.0, 1.0 / np.where(np.isnan(radius), np.inf, radius)))
    k0, k1 = bends
    for i in np.flatnonzero((kind == STRAIGHT) & ((k0 != 0.0) | (k1 != 0.0)))[:1]:
        table.refuse(int(i), "radius_start_m", "a straight with a radius", "leave it empty")
    for i in np.flatnonzero((kind == ARC) & ((k0 == 0.0) | (np.abs(k1 - k0) > 1e-6 * np.abs(k0))))[:1]:
        table.refuse(int(i), "radius_start_m", "an arc needs one radius", "name the transition, or one radius")
    designs = []
    for code, track in enumerate(words.word):
        rows = np.flatnonzero(words.code == code)
        rows = rows[np.argsort(number["sequence"][rows], kind="stable")]
        sway = number.get("sway_1_m")
        swing = np.zeros(len(rows)) if sway is None else np.nan_to_num(sway[rows])
        plan = Plan(
            number["length_m"][rows],
            kind[rows],
            k0[rows],
            k1[rows],
            number["easting_m"][rows],
            number["northing_m"][rows],
            np.radians(number["grid_bearing_deg"][rows]),
            np.where(kind[rows] == VIENNESE, swing, 0.0),
        )
        start = float(number["start_m"][rows[0]])
        try:
            design = Design(
                track, plan, start, _profile_of(profile, track, start), _cant_of(cant, track, start), crs=crs
            )
        except TrackError as error:
            raise InputError(str(error), file=path, row=table.row_of(int(rows[0]))) from error
        gap = np.hypot(design.gap[:, 0], design.gap[:, 1])
        if gap.max() > 0.1:
            i = int(rows[int(np.argmax(gap))])
            table.refuse(
                i,
                "element",
                f"the element ends {gap.max():.3f} m from the start of the next one of track {track!r}",
                "check its kind, length, radii and their signs (right is positive)",
            )
        designs.append(design)
    return tuple(designs)


def _kinds(table: Table, column: str) -> NDArray[np.int64]:
    words = table.words[column]
    found = [KIND_NAMES.index(w.strip().lower()) if w.strip().lower() in KIND_NAMES else -1 for w in words.word]
    kind = np.array(found, np.int64)[words.code]
    if (kind < 0).any():
        i = int(np.argmax(kind < 0))
        table.refuse(
            i, column, f"{words.word[words.code[i]][:40]!r} is no known element", f"use {', '.join(KIND_NAMES)}"
        )
    return kind


def _of_track(table: Table, track: str) -> NDArray[np.int64]:
    words = table.words["track"]
    if track not in words.word:
        return np.empty(0, np.int64)
    return np.flatnonzero(words.code == list(words.word).index(track))


def _profile_of(table: Table | None, track: str, start: float) -> Gradients | None:
    rows = np.empty(0, np.int64) if table is None else _of_track(table, track)
    if table is None or not len(rows):
        return None
    number = table.number
    if len(rows) < 2:
        table.refuse(int(rows[0]), "station_m", f"the only point of the profile of track {track!r}", "give two")
    back = np.flatnonzero(np.diff(number["station_m"][rows]) <= 0.0)
    if len(back):
        table.refuse(
            int(rows[back[0] + 1]), "station_m", "does not follow the one before", "order the points by station"
        )
    length = np.nan_to_num(number["parabola_length_m"][rows])
    radius = np.nan_to_num(number["circle_radius_m"][rows])
    return profile_of_points(number["station_m"][rows] - start, number["height_m"][rows], length, radius)


def profile_of_points(along: FloatArray, height: FloatArray, length: FloatArray, radius: FloatArray) -> Gradients:
    """Profile of points of vertical intersection with parabolas of given length or circles of given radius, m; 0 without."""
    slope = np.diff(height) / np.diff(along)
    rows = [(-np.inf, along[0], height[0], slope[0], 0.0, 0.0)]
    for i in range(1, len(along) - 1):
        g0, g1 = float(slope[i - 1]), float(slope[i])
        before = after = 0.5 * float(length[i])
        r = 0.0
        if radius[i] > 0.0 and g0 != g1:
            a0, a1 = np.arctan(g0), np.arctan(g1)
            tangent = radius[i] * np.tan(abs(a1 - a0) / 2.0)
            before, after = float(tangent * np.cos(a0)), float(tangent * np.cos(a1))
            r = float(np.copysign(radius[i], g1 - g0))
        if before > 0.0 and g0 != g1:
            bend = 0.0 if r else (g1 - g0) / (2.0 * (before + after))
            begin = along[i] - before
            rows.append((begin, begin, height[i] - g0 * before, g0, bend, r))
        rows.append((along[i] + after, along[i] + after, height[i] + g1 * after, g1, 0.0, 0.0))
    return Gradients(*np.array(rows).T.copy())


def _cant_of(table: Table | None, track: str, start: float) -> Cant | None:
    rows = np.empty(0, np.int64) if table is None else _of_track(table, track)
    if table is None or not len(rows):
        return None
    number = table.number
    begin, end = number["start_m"][rows] - start, number["end_m"][rows] - start
    for i in np.flatnonzero(np.append(np.abs(end[:-1] - begin[1:]) > 1e-3, False) | (end < begin))[:1]:
        table.refuse(int(rows[i]), "end_m", "the stretches of cant do not follow one another", "order and close them")
    kind = _kinds(table, "law")[rows]
    return Cant(
        np.append(begin, end[-1]),
        1e-3 * number["cant_start_mm"][rows],
        1e-3 * number["cant_end_mm"][rows],
        np.where(kind == CUBIC, CLOTHOID, np.maximum(kind, CLOTHOID)),
    )
