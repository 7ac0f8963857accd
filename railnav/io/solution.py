"""Solution files: one row an output epoch, in CSV, Parquet, GeoPackage (points for QGIS) or GeoJSON, by the ending.

Columns are those of the formats' chapter "A solution". What they cannot hold (run, start, plane, integrity risk, whether
smoothed or simulated, running direction, diagnostics) rides in the metadata of Parquet, GeoPackage and GeoJSON; a CSV file has no such
place, and reading one back takes the defaults of `Solution`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError
from railnav.io.atomic import atomic_path
from railnav.io.container import bounds_of, create, opened, point_blobs
from railnav.io.qgis_styles import add_styles
from railnav.io.tables import PARQUET_ENDINGS, Column, Table, Words, check_table, freeze, read_table, write_table
from railnav.navigation.solution import Alternatives, Mode, Solution

if TYPE_CHECKING:
    import pyarrow as pa

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: What `railnav_meta` calls the file's content.
CONTENT = "solution"
#: Version of the layout in GeoPackage.
SCHEMA_VERSION = 1
#: Layer of a GeoPackage.
LAYER = "solution"
#: Its table of candidates.
ALTERNATIVES = "alternatives"
#: Grid heights that differ from ellipsoidal ones by more than this, m, get a column of their own.
_SAME_HEIGHT = 1e-4


def _number(name: str, *, low: float = -np.inf, high: float = np.inf, infinite: bool = False) -> Column:
    return Column(name, complete=False, low=low, high=high, infinite=infinite)


_COLUMNS = (
    Column("time_s"),
    Column("track", text=True, complete=False),
    _number("offset_m"),
    Column("line", text=True, complete=False),
    _number("chainage_km"),
    _number("easting_m"),
    _number("northing_m"),
    _number("height_m"),
    _number("latitude_deg", low=-90, high=90),
    _number("longitude_deg", low=-180, high=180),
    _number("heading_deg"),
    _number("speed_m_s"),
    _number("acceleration_m_s2"),
    _number("sigma_along_m", low=0, infinite=True),
    _number("sigma_cross_m", low=0, infinite=True),
    _number("protection_level_along_m", low=0, infinite=True),
    _number("track_probability", low=0, high=1 + 1e-6),
    Column("mode", text=True),
)
#: Stands in a file only where the plane's heights are not ellipsoidal heights of WGS 84.
_GRID_HEIGHT = Column("grid_height_m", required=False, complete=False)

_ALTERNATIVES = (
    Column("time_s"),
    Column("track", text=True),
    Column("offset_m"),
    Column("probability"),
    Column("running_direction"),
)

_DECIMALS: Mapping[str, int] = {
    "time_s": 6,
    "offset_m": 4,
    "chainage_km": 7,
    "easting_m": 4,
    "northing_m": 4,
    "height_m": 4,
    "grid_height_m": 4,
    "latitude_deg": 10,
    "longitude_deg": 10,
    "heading_deg": 6,
    "speed_m_s": 5,
    "acceleration_m_s2": 5,
    "sigma_along_m": 4,
    "sigma_cross_m": 4,
    "protection_level_along_m": 4,
    "track_probability": 9,
}

_MODES = {mode.label: int(mode) for mode in Mode}


def write_solution(solution: Solution, path: str | Path) -> None:
    """Write a solution as .csv, .parquet, .gpkg or .geojson by the ending, whole or not at all.

    Parameters
    ----------
    solution : Solution
        What to write; rows without a position get empty cells, null, or no geometry.
    path : path
        File to write; replaced in one step if it exists.

    Raises
    ------
    InputError
        The ending is none of these, the solution has no rows, or the file cannot be written.

    Notes
    -----
    CSV and GeoJSON are rounded to 0.1 mm, 1e-10 degrees (0.01 mm), 1e-5 m/s; Parquet and GeoPackage keep every bit of
    their columns. `height_m` is the ellipsoidal height of WGS 84; where the plane's heights differ from it (a datum of
    its own), a column `grid_height_m` is added. A GeoPackage holds points in the model's plane. 100,000 rows take 0.3 s
    as CSV, 1.5 s as GeoPackage or GeoJSON.

    Examples
    --------
    >>> write_solution(read_solution("nowhere.csv"), "solution.gpkg")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.csv: does not exist; check the name
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in {".csv", ".gpkg", ".geojson", ".json", *PARQUET_ENDINGS}:
        cause = f"a solution cannot be written as {ending or 'a file without ending'!s}"
        raise InputError(cause, file=path, remedy="use .csv, .parquet, .gpkg or .geojson")
    if not len(solution):
        raise InputError("the solution has no rows", file=path)
    columns, metadata = _columns(solution), _metadata(solution, path)
    if ending == ".gpkg":
        _write_geopackage(path, columns, metadata, solution)
        return
    with atomic_path(path) as draft:
        if ending in (".geojson", ".json"):
            _write_geojson(draft, columns, metadata)
        else:
            write_table(draft, columns, decimals=_DECIMALS, metadata=metadata)


def read_solution(path: str | Path) -> Solution:
    """Read a solution that `write_solution` wrote, or any table with the same columns.

    Parameters
    ----------
    path : path
        .csv, .parquet, .gpkg or .geojson.

    Returns
    -------
    Solution
        SI and radians, arrays read-only. `track_id` holds the tracks that rows name, in the order of their first row. The
        running direction comes from the metadata; from CSV it is told by the growth of offsets against the speed,
        and is 0 where the train never moves on a track.

    Raises
    ------
    InputError
        The file is missing or malformed, a column is missing, time does not grow, a mode is unknown, a row has a track
        and no offset, or the rows of one track name two lines.

    Examples
    --------
    >>> read_solution("nowhere.csv")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.csv: does not exist; check the name
    """
    path = Path(path)
    ending = path.suffix.lower()
    columns = (*_COLUMNS, _GRID_HEIGHT)
    others: Table | None = None
    if ending == ".gpkg":
        table, others = _read_geopackage(path)
    elif ending in (".geojson", ".json"):
        table = _read_geojson(path)
    else:
        table = read_table(path, columns)
    check_table(table, columns)
    return _solution(table, others)


def solution_table(solution: Solution) -> pa.Table:
    """A solution as an Arrow table: the columns of a solution file and a "geometry" of points in the model's plane.

    Parameters
    ----------
    solution : Solution
        What to give.

    Returns
    -------
    pyarrow.Table
        Angles in degrees, chainage in km, as the names say; null where a row has no position.
    """
    import pyarrow as pa

    from railnav.io.tables import _arrow
    from railnav.track.tables import geometry_column, points

    arrays = {name: _arrow(column, None) for name, column in _columns(solution).items()}
    shapes = points(solution.easting, solution.northing, solution.ellipsoidal_height)
    field, geometry = geometry_column(shapes, solution.crs_wkt)
    fields = [pa.field(name, array.type) for name, array in arrays.items()]
    return pa.Table.from_arrays([*arrays.values(), geometry], schema=pa.schema([*fields, field]))


# --- columns ----------------------------------------------------------------------------------------------------------


def _columns(solution: Solution) -> dict[str, FloatArray | Words]:
    lines = Words.of(solution.line)
    at = np.append(lines.code, -1)  # track -1 has no line
    heading = np.rad2deg(solution.heading)
    columns: dict[str, FloatArray | Words] = {
        "time_s": solution.time,
        "track": Words(solution.track, solution.track_id),
        "offset_m": solution.offset,
        "line": Words(at[solution.track], lines.word),
        "chainage_km": solution.chainage / 1000,
        "easting_m": solution.easting,
        "northing_m": solution.northing,
        "height_m": solution.ellipsoidal_height,
        "latitude_deg": np.rad2deg(solution.latitude),
        "longitude_deg": np.rad2deg(solution.longitude),
        "heading_deg": np.where((heading < 0) | (heading >= 360), np.mod(heading, 360.0), heading),
        "speed_m_s": solution.speed,
        "acceleration_m_s2": solution.acceleration,
        "sigma_along_m": solution.sigma_along,
        "sigma_cross_m": solution.sigma_cross,
        "protection_level_along_m": solution.protection_level_along,
        "track_probability": solution.track_probability,
        "mode": Words(solution.mode, tuple(mode.label for mode in Mode)),
    }
    same = np.abs(solution.height - solution.ellipsoidal_height) <= _SAME_HEIGHT
    if not (same | (np.isnan(solution.height) & np.isnan(solution.ellipsoidal_height))).all():
        columns["grid_height_m"] = solution.height
    return columns


def _metadata(solution: Solution, path: Path) -> dict[str, Any]:
    try:
        diagnostics = json.loads(json.dumps(solution.diagnostics, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise InputError(f"the diagnostics hold more than JSON values ({error})", file=path) from error
    direction = solution.running_direction
    changes = np.flatnonzero(np.diff(direction, prepend=direction[0] + 1 if len(direction) else 0))
    return {
        "run_id": solution.run_id,
        "start": solution.start,
        "crs_wkt": solution.crs_wkt,
        "integrity_risk": solution.integrity_risk,
        "smoothed": solution.smoothed,
        "simulated": solution.simulated,
        "running_direction": [[int(row), int(direction[row])] for row in changes],
        "diagnostics": diagnostics,
    }


def _solution(table: Table, others: Table | None = None) -> Solution:
    time = table.increasing("time_s")
    track, number, metadata = table.words["track"], table.number, table.metadata
    _check_rows(table)
    track_id, lines, alternatives = track.word, _lines(table), Alternatives.none()
    if others is not None:
        check_table(others, _ALTERNATIVES)
        track_id, lines, alternatives = _with_alternatives(track_id, lines, time, others)
    mode = table.words["mode"]
    known = np.array([_MODES.get(word, -1) for word in mode.word], dtype=np.int64)[mode.code]
    if (known < 0).any():
        row = int(np.argmax(known < 0))
        cause = f"{mode.word[mode.code[row]]!r:.40} is no mode"
        table.refuse(row, "mode", cause, f"modes are {', '.join(_MODES)}")
    ellipsoidal_height = number["height_m"]
    direction = _stored_direction(metadata, table.length)
    if direction is None:
        direction = _told_direction(track.code, number["offset_m"], number["speed_m_s"])
    risk = metadata.get("integrity_risk")
    diagnostics = metadata.get("diagnostics")
    return Solution(
        track_id=track_id,
        line=lines,
        time=time,
        track=track.code,
        offset=number["offset_m"],
        chainage=freeze(number["chainage_km"] * 1000),
        easting=number["easting_m"],
        northing=number["northing_m"],
        height=number.get("grid_height_m", ellipsoidal_height),
        latitude=freeze(np.deg2rad(number["latitude_deg"])),
        longitude=freeze(np.deg2rad(number["longitude_deg"])),
        ellipsoidal_height=ellipsoidal_height,
        heading=freeze(np.deg2rad(number["heading_deg"])),
        speed=number["speed_m_s"],
        acceleration=number["acceleration_m_s2"],
        sigma_along=number["sigma_along_m"],
        sigma_cross=number["sigma_cross_m"],
        protection_level_along=number["protection_level_along_m"],
        track_probability=number["track_probability"],
        mode=freeze(known),
        running_direction=freeze(direction),
        run_id=str(metadata.get("run_id", "")),
        start=str(metadata.get("start", "")),
        crs_wkt=str(metadata.get("crs_wkt", "")),
        integrity_risk=risk if isinstance(risk, float) and 0 < risk < 1 else 1e-4,
        smoothed=metadata.get("smoothed") is True,
        simulated=metadata.get("simulated") is True,
        diagnostics=diagnostics if isinstance(diagnostics, dict) else {},
        alternatives=alternatives,
    )


def _with_alternatives(
    track_id: tuple[str, ...], lines: tuple[str, ...], time: FloatArray, others: Table
) -> tuple[tuple[str, ...], tuple[str, ...], Alternatives]:
    """Candidates of a file; tracks that no row stands on are added behind those of the rows, their line unknown."""
    named = others.words["track"]
    index = {name: i for i, name in enumerate(track_id)}
    for name in named.word:
        index.setdefault(name, len(index))
    row = np.searchsorted(time, others.number["time_s"] - 1e-7)
    if (
        wrong := (row >= len(time)) | (np.abs(time[np.minimum(row, len(time) - 1)] - others.number["time_s"]) > 1e-6)
    ).any():
        others.refuse(int(np.argmax(wrong)), "time_s", "is no time of the solution", "write the file anew")
    code = np.array([index[name] for name in named.word], np.int64)
    alternatives = Alternatives(
        freeze(row.astype(np.int64)),
        freeze(code[named.code]),
        others.number["offset_m"],
        others.number["probability"],
        freeze(others.number["running_direction"].astype(np.int64)),
    )
    return tuple(index), (*lines, *("" for _ in range(len(index) - len(track_id)))), alternatives


def alternatives_columns(solution: Solution) -> dict[str, FloatArray | Words]:
    """The candidates of a solution as columns of a table."""
    told = solution.alternatives
    return {
        "time_s": solution.time[told.row],
        "track": Words(told.track, solution.track_id),
        "offset_m": told.offset,
        "probability": told.probability,
        "running_direction": told.running_direction.astype(np.float64),
    }


def write_alternatives(solution: Solution, path: str | Path) -> None:
    """Write the candidates of a solution's uncertain rows as .csv or .parquet by the ending, whole or not at all.

    Parameters
    ----------
    solution : Solution
        One that was not smoothed.
    path : path
        File to write; replaced in one step if it exists. Columns: `time_s, track, offset_m, probability, running_direction`.

    Raises
    ------
    InputError
        The ending is neither, or the file cannot be written.

    Examples
    --------
    >>> write_alternatives(read_solution("nowhere.csv"), "alternatives.csv")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.csv: does not exist; check the name
    """
    path = Path(path)
    if path.suffix.lower() not in {".csv", *PARQUET_ENDINGS}:
        raise InputError("alternatives are written as .csv or .parquet", file=path)
    decimals = {"time_s": 6, "offset_m": 4, "probability": 9, "running_direction": 0}
    with atomic_path(path) as draft:
        write_table(draft, alternatives_columns(solution), decimals=decimals, metadata={})


def _check_rows(table: Table) -> None:
    placed, unplaced = table.words["track"].code >= 0, np.isnan(table.number["offset_m"])
    if (wrong := placed & unplaced).any():
        table.refuse(int(np.argmax(wrong)), "offset_m", "is empty where the row has a track", "fill both or neither")
    if (wrong := ~placed & ~unplaced).any():
        table.refuse(int(np.argmax(wrong)), "track", "is empty where the row has an offset", "fill both or neither")


def _lines(table: Table) -> tuple[str, ...]:
    track, line = table.words["track"], table.words["line"]
    names = []
    for code, word in enumerate(track.word):
        rows = np.flatnonzero(track.code == code)
        other = line.code[rows] != line.code[rows[0]]
        if other.any():
            row = int(rows[np.argmax(other)])
            table.refuse(row, "line", f"track {word!r:.40} stood on another line before", "a track has one line")
        names.append(line.word[line.code[rows[0]]] if line.code[rows[0]] >= 0 else "")
    return tuple(names)


def _stored_direction(metadata: Mapping[str, Any], length: int) -> IntArray | None:
    changes = metadata.get("running_direction")
    direction = np.zeros(length, np.int64)
    try:
        for row, value in changes:  # type: ignore[union-attr]
            if not (0 <= row < length and value in (-1, 0, 1)):
                return None
            direction[row:] = value
    except (TypeError, ValueError):
        return None
    return direction


def _told_direction(track: IntArray, offset: FloatArray, speed: FloatArray) -> IntArray:
    """Running direction from the growth of offsets against the speed; a stand takes its neighbour on the same track."""
    direction = np.zeros(len(track), np.int64)
    grown, mean = np.diff(offset), (speed[1:] + speed[:-1]) / 2
    moves = (track[1:] == track[:-1]) & (track[1:] >= 0) & (np.abs(grown) > 0.02) & (np.abs(mean) > 0.05)
    rows = np.flatnonzero(moves)
    direction[rows + 1] = (np.sign(grown[rows]) * np.sign(mean[rows])).astype(np.int64)
    begins = np.flatnonzero(np.diff(track, prepend=track[:1] - 1))
    for begin, end in zip(begins, [*begins[1:], len(track)], strict=True):
        part = direction[begin:end]
        told = np.flatnonzero(part)
        if len(told):
            nearest = np.clip(np.searchsorted(told, np.arange(len(part)), side="right") - 1, 0, None)
            part[:] = part[told[nearest]]
    return direction


# --- GeoPackage -------------------------------------------------------------------------------------------------------


def _cells(column: FloatArray | Words) -> list[Any]:
    if isinstance(column, Words):
        return [word or None for word in column.each()]
    cells: list[Any] = column.tolist()
    for row in np.flatnonzero(np.isnan(column)).tolist():
        cells[row] = None
    return cells


def _write_geopackage(
    path: Path, columns: Mapping[str, FloatArray | Words], metadata: Mapping[str, Any], solution: Solution
) -> None:
    from railnav import __version__

    if solution.crs_wkt:
        at = (solution.easting, solution.northing, solution.height)
    else:
        at = (np.rad2deg(solution.longitude), np.rad2deg(solution.latitude), solution.ellipsoidal_height)
    kinds = ", ".join(f"{name} {'TEXT' if isinstance(column, Words) else 'DOUBLE'}" for name, column in columns.items())
    with create(path, solution.crs_wkt) as container:
        cells = [_cells(column) for column in columns.values()]
        blobs = point_blobs(container.srs_id, *at)
        container.add_layer(
            LAYER,
            kinds,
            zip(range(1, len(solution) + 1), blobs, *cells, strict=True),
            geometry="POINT",
            bounds=bounds_of(at[0], at[1]),
            description=f"Train positions {solution.run_id}, time from {solution.start}".strip(),
        )
        if len(solution.alternatives):
            told = alternatives_columns(solution)
            kinds = ", ".join(f"{name} {'TEXT' if isinstance(v, Words) else 'DOUBLE'}" for name, v in told.items())
            container.add_table(
                ALTERNATIVES,
                kinds,
                zip(range(1, len(solution.alternatives) + 1), *(_cells(v) for v in told.values()), strict=True),
                description="Candidates of the epochs whose track is not certain, most probable first",
            )
        add_styles(container, (LAYER,))
        container.add_meta(
            content=CONTENT, schema_version=SCHEMA_VERSION, created_by=f"railnav {__version__}", **metadata
        )


def _read_geopackage(path: Path) -> tuple[Table, Table | None]:
    with opened(path, CONTENT, newest=SCHEMA_VERSION, error=InputError) as reader:
        found = reader.columns(LAYER)
        wanted = [*_COLUMNS, *([_GRID_HEIGHT] if _GRID_HEIGHT.name in found else [])]
        rows = reader.select(LAYER, [column.name for column in wanted])
        if not rows:
            reader.refuse("has no rows", layer=LAYER)
        table = _typed(path, wanted, zip(*rows, strict=True), reader.meta)
        if ALTERNATIVES not in reader.tables():
            return table, None
        others = reader.select(ALTERNATIVES, [column.name for column in _ALTERNATIVES])
        return table, _typed(path, list(_ALTERNATIVES), zip(*others, strict=True), {}) if others else None


def _typed(path: Path, wanted: list[Column], cells: Any, metadata: dict[str, Any]) -> Table:
    """Columns of cells as a table; every cell must be of its column's kind or null."""
    number: dict[str, FloatArray] = {}
    words: dict[str, Words] = {}
    length = 0
    for column, values in zip(wanted, cells, strict=True):
        kinds: tuple[type, ...] = (str,) if column.text else (int, float)
        length = len(values)
        for index, value in enumerate(values):
            if value is not None and (not isinstance(value, kinds) or isinstance(value, bool)):
                kind = "text" if column.text else "a number"
                raise InputError(f"{value!r:.40} is not {kind}", file=path, row=index + 2, column=column.name)
        if column.text:
            words[column.name] = Words.of(value or "" for value in values)
        else:
            try:
                number[column.name] = freeze(np.array(values, dtype=np.float64))
            except OverflowError as error:
                raise InputError("holds a number beyond all bounds", file=path, column=column.name) from error
    return Table(path, length, number, words, metadata)


# --- GeoJSON ----------------------------------------------------------------------------------------------------------


def _write_geojson(path: Path, columns: Mapping[str, FloatArray | Words], metadata: Mapping[str, Any]) -> None:
    import msgspec

    rounded = {
        name: column if isinstance(column, Words) else np.round(column, _DECIMALS[name]) + 0.0
        for name, column in columns.items()
    }
    cells = [_cells(column) for column in rounded.values()]
    names = list(rounded)
    place = [names.index(name) for name in ("longitude_deg", "latitude_deg", "height_m")]
    encode = msgspec.json.Encoder().encode
    head = {"content": CONTENT, "geometry": "Point", "schema_version": SCHEMA_VERSION, **metadata}
    with path.open("wb") as file:
        file.write(b'{"type":"FeatureCollection",\n"railnav":' + encode(head) + b',\n"features":[')
        separator = b"\n"
        for row in zip(*cells, strict=True):
            longitude, latitude, height = (row[index] for index in place)
            geometry = None
            if longitude is not None and latitude is not None:
                at = [longitude, latitude] if height is None else [longitude, latitude, height]
                geometry = {"type": "Point", "coordinates": at}
            properties = dict(zip(names, row, strict=True))
            file.write(separator + encode({"type": "Feature", "geometry": geometry, "properties": properties}))
            separator = b",\n"
        file.write(b"\n]}\n")


def _read_geojson(path: Path) -> Table:
    try:
        with path.open(encoding="utf-8-sig") as file:
            collection = json.load(file)
        features = collection["features"]
        rows = [feature["properties"] for feature in features]
        if not rows:
            raise InputError("has no rows", file=path)
        for index, row in enumerate(rows):
            for column in _COLUMNS:
                if column.name not in row:
                    raise InputError("property is missing", file=path, row=index + 2, column=column.name)
    except FileNotFoundError as error:
        raise InputError("does not exist", file=path, remedy="check the name") from error
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", file=path) from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        cause = f"is no GeoJSON of a solution ({type(error).__name__}: {str(error)[:80]})"
        raise InputError(cause, file=path, remedy="write it with railnav navigate") from error
    wanted = [*_COLUMNS, *([_GRID_HEIGHT] if _GRID_HEIGHT.name in rows[0] else [])]
    metadata = collection.get("railnav", {})
    cells = [[row.get(column.name) for row in rows] for column in wanted]
    return _typed(path, wanted, cells, metadata if isinstance(metadata, dict) else {})
