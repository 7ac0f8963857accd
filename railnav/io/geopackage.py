"""The store of a reference track model: one GeoPackage that opens in QGIS as it is.

Layers for people (tracks, nodes, mileposts) and tables for the program (movements, knots, railnav_meta); the schema is
described column by column in `track_models/README.md`. The knots carry the truth to the bit; the lines of the layer
`tracks` are drawn from them to 5 mm and are not read back.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError, ModelError, RailnavError
from railnav.geodesy.grid import GridFrame
from railnav.io.container import Container, Reader, bounds_of, create, decode_point, line_blob, opened, point_blobs
from railnav.io.geopackage_records import CONTENT, SCHEMA_VERSION, checksum, record_source, write_records
from railnav.io.line_references import read_references, write_references
from railnav.io.qgis_styles import add_styles
from railnav.io.store_address import is_store
from railnav.track.model import KNOT_COLUMNS, End, MilePosts, NodeKind, Nodes, TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Drawn lines keep within this distance of the knots, m.
DRAWING_TOLERANCE = 0.005
#: The knot table's BLOB columns in the order of their checksum.
BLOB_COLUMNS = (*KNOT_COLUMNS, "covariance_g")

_KNOT_BYTES = {name: 48 if name == "covariance_g" else 8 for name in BLOB_COLUMNS}
_ENDS = {end.name.lower(): int(end) for end in End}
_KINDS = {kind.name.lower().replace("_", "-"): int(kind) for kind in NodeKind}


def write_model(model: TrackModel, path: str | Path) -> None:
    """Write a reference track model as a GeoPackage, whole or not at all.

    Parameters
    ----------
    model : TrackModel
        What to write.
    path : path
        File to write; replaced in one step if it exists.

    Raises
    ------
    ModelError
        Two tracks or two nodes share an identifier, or the provenance holds more than JSON values.
    InputError
        The file cannot be written.

    Notes
    -----
    Every number of the model is stored with all its bits. A column that is the same at every knot of a track is stored
    once. `benchmarks/store.py` gives size, time and memory for 1,000 km at 1 m. The time stamps inside follow the
    environment variable SOURCE_DATE_EPOCH where it is set, so that the same model gives the same bytes.

    Examples
    --------
    >>> import tempfile, railnav
    >>> model = railnav.demo_line()
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_model(model, f"{folder}/line.gpkg")
    ...     read_model(f"{folder}/line.gpkg").track_id == model.track_id
    True
    """
    if is_store(path):  # a shared model: the same interface, another store
        from railnav.io.postgis import write_model as save

        save(model, path)
        return
    _check_unique(model.track_id, "track", path)
    _check_unique(model.nodes.id, "node", path)
    records = model.records  # before the file that they may lie in is replaced
    try:
        with create(path, model.frame.crs_wkt) as container:
            _write_meta(container, model)
            _write_tracks(container, model)
            _write_nodes(container, model)
            _write_mileposts(container, model)
            write_references(container, model.references, model.track_id)
            _write_movements(container, model)
            _write_knots(container, model)
            add_styles(container, ("tracks", "nodes", "mileposts"))
            if records is not None:
                write_records(container, records)
    except (TypeError, ValueError) as error:
        raise ModelError(f"the provenance holds more than JSON values ({error})", file=path) from error


def read_model(path: str | Path) -> TrackModel:
    """Read a reference track model from a GeoPackage that railnav wrote.

    Parameters
    ----------
    path : path
        File to read; opened read-only.

    Returns
    -------
    TrackModel
        The model as it was written, to the bit; lines, names and mile posts as they were last edited.

    Raises
    ------
    ModelError
        The file is missing, no GeoPackage, damaged, not railnav's, of a newer schema, or its tables do not agree.

    Examples
    --------
    >>> read_model("nowhere.gpkg")
    Traceback (most recent call last):
    railnav.errors.ModelError: nowhere.gpkg: does not exist; check the name
    """
    if is_store(path):
        from railnav.io.postgis import read_model as fetch

        return fetch(path)
    with opened(path, CONTENT, newest=SCHEMA_VERSION, error=ModelError) as reader:
        frame = _read_frame(reader)
        provenance = reader.meta.get("provenance", {})
        if not isinstance(provenance, dict):
            reader.refuse("provenance is no table", layer="railnav_meta")
        nodes = _read_nodes(reader)
        tracks = _read_tracks(reader, nodes)
        knot_start, knots = _read_knots(reader, tracks["track_id"])
        try:
            return TrackModel(
                frame=frame,
                track_id=tracks["track_id"],
                line=tracks["line"],
                name=tracks["name"],
                start_node=tracks["start_node"],
                end_node=tracks["end_node"],
                knot_start=knot_start,
                offset=knots["offset"],
                easting=knots["easting"],
                northing=knots["northing"],
                height=knots["height"],
                grid_bearing=knots["grid_bearing"],
                curvature=knots["curvature"],
                gradient=knots["gradient"],
                cant=knots["cant"],
                scale=knots["scale"],
                covariance_g=knots["covariance_g"],
                nodes=nodes,
                movements=_read_movements(reader, tracks["track_id"]),
                mileposts=_read_mileposts(reader, tracks["track_id"]),
                references=read_references(reader, tracks["track_id"]),
                provenance=provenance,
                record_source=record_source(reader, path),
            )
        except InputError:
            raise
        except RailnavError as error:
            raise ModelError(str(error), file=path, remedy="make the model again") from error


def _version() -> str:
    from railnav import __version__

    return f"railnav {__version__}"


def _check_unique(names: tuple[str, ...], what: str, path: str | Path) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen or not name:
            raise ModelError(f"{what} {name!r} stands twice or is empty", file=path, remedy="identifiers are unique")
        seen.add(name)


# --- writing ----------------------------------------------------------------------------------------------------------


def _write_meta(container: Container, model: TrackModel) -> None:
    frame = model.frame
    container.add_meta(
        content=CONTENT,
        schema_version=SCHEMA_VERSION,
        created_by=_version(),
        crs_name=frame.name,
        crs_wkt=frame.crs_wkt,
        crs_pipeline=frame.pipeline,
        crs_operation=frame.operation,
        crs_accuracy_m=frame.accuracy,
        provenance=model.provenance,
    )


def _write_tracks(container: Container, model: TrackModel) -> None:
    tracks = np.arange(len(model.track_id))
    lengths = model.lengths
    first = model.offset[model.knot_start[:-1]]
    ends_km = [model.chainage(tracks, offset) / 1000 for offset in (first, first + lengths)]

    def rows() -> Iterator[tuple[Any, ...]]:
        for i in tracks.tolist():
            yield (
                i + 1,
                line_blob(container.srs_id, _drawing(model, i)),
                model.track_id[i],
                model.line[i],
                model.name[i],
                float(lengths[i]),
                float(ends_km[0][i]),
                float(ends_km[1][i]),
                model.nodes.id[model.start_node[i]],
                model.nodes.id[model.end_node[i]],
            )

    container.add_layer(
        "tracks",
        "track TEXT NOT NULL UNIQUE, line TEXT, name TEXT, length_m DOUBLE, start_km DOUBLE, "
        "end_km DOUBLE, start_node TEXT NOT NULL, end_node TEXT NOT NULL",
        rows(),
        geometry="LINESTRING",
        bounds=bounds_of(model.easting, model.northing),
        description="Track axes, drawn from the knots to 5 mm; length is true ground length",
    )


def _drawing(model: TrackModel, track: int) -> FloatArray:
    """Vertices that keep within the drawing tolerance of the knots; flat where a height is missing."""
    import shapely

    part = slice(int(model.knot_start[track]), int(model.knot_start[track + 1]))
    easting, northing, height = model.easting[part], model.northing[part], model.height[part]
    numbered = np.column_stack([easting, northing, np.arange(len(easting))])
    step = 4096  # simplification costs n log n as a rule and n^2 at worst
    kept = [np.zeros(1, np.int64)]
    for start in range(0, len(numbered) - 1, step):
        line = shapely.simplify(shapely.linestrings(numbered[start : start + step + 1]), DRAWING_TOLERANCE)
        kept.append(shapely.get_coordinates(line, include_z=True)[1:, 2].astype(np.int64))  # z is the knot's number
    index = np.concatenate(kept)
    columns = [easting, northing, height] if np.isfinite(height).all() else [easting, northing]
    return np.column_stack(columns)[index]


def _write_nodes(container: Container, model: TrackModel) -> None:
    nodes = model.nodes
    blobs = point_blobs(container.srs_id, nodes.easting, nodes.northing, nodes.height)
    kinds = [NodeKind(kind).name.lower().replace("_", "-") for kind in nodes.kind.tolist()]
    container.add_layer(
        "nodes",
        "node TEXT NOT NULL UNIQUE, kind TEXT NOT NULL",
        zip(range(1, len(nodes.id) + 1), blobs, nodes.id, kinds, strict=True),
        geometry="POINT",
        bounds=bounds_of(nodes.easting, nodes.northing),
        description="Points where track ends meet",
    )


def _write_mileposts(container: Container, model: TrackModel) -> None:
    posts = model.mileposts
    at = np.full((len(posts.track), 3), np.nan)
    for i in np.unique(posts.track).tolist():
        here = posts.track == i
        part = slice(int(model.knot_start[i]), int(model.knot_start[i + 1]))
        for axis, column in enumerate((model.easting, model.northing, model.height)):
            at[here, axis] = np.interp(posts.offset[here], model.offset[part], column[part])
    container.add_layer(
        "mileposts",
        "track TEXT NOT NULL, offset_m DOUBLE NOT NULL, chainage_m DOUBLE NOT NULL",
        zip(
            range(1, len(at) + 1),
            point_blobs(container.srs_id, at[:, 0], at[:, 1], at[:, 2]),
            [model.track_id[i] for i in posts.track.tolist()],
            posts.offset.tolist(),
            posts.chainage.tolist(),
            strict=True,
        ),
        geometry="POINT",
        bounds=bounds_of(at[:, 0], at[:, 1]),
        description="Published chainage at offsets of tracks; linear in between",
    )


def _write_movements(container: Container, model: TrackModel) -> None:
    ends = [end.name.lower() for end in End]
    container.add_table(
        "movements",
        "track_a TEXT NOT NULL, end_a TEXT NOT NULL, track_b TEXT NOT NULL, end_b TEXT NOT NULL",
        (
            (fid, model.track_id[a], ends[end_a], model.track_id[b], ends[end_b])
            for fid, (a, end_a, b, end_b) in enumerate(model.movements.tolist(), 1)
        ),
        description="Permitted movements: a train that leaves track_a by end_a enters track_b by end_b, and back",
    )


def _write_knots(container: Container, model: TrackModel) -> None:
    def rows() -> Iterator[tuple[Any, ...]]:
        for i, track in enumerate(model.track_id):
            part = slice(int(model.knot_start[i]), int(model.knot_start[i + 1]))
            blobs = [_packed(getattr(model, name)[part]) for name in BLOB_COLUMNS]
            yield (i + 1, track, part.stop - part.start, checksum(blobs), *blobs)

    container.add_table(
        "knots",
        "track TEXT NOT NULL UNIQUE, knots INTEGER NOT NULL, crc32 INTEGER NOT NULL, "
        + ", ".join(f"{name} BLOB NOT NULL" for name in BLOB_COLUMNS),
        rows(),
        description="Track geometry: little-endian float64, one value a knot, or one value for all knots",
    )


def _packed(values: FloatArray) -> bytes:
    """Little-endian float64; a column that is the same at every knot, to the bit, shrinks to one value."""
    values = np.ascontiguousarray(values, "<f8")
    bits = values.view("<u8")
    return (values[:1] if (bits == bits[:1]).all() else values).tobytes()


# --- reading ----------------------------------------------------------------------------------------------------------


class _Rows:
    """Rows of one table, each cell checked for its kind."""

    def __init__(self, reader: Reader, table: str, columns: tuple[str, ...]) -> None:
        self._reader, self._table, self._columns = reader, table, columns
        rows = reader.select(table, columns)
        self.length = len(rows)
        self._cells = dict(zip(columns, zip(*rows, strict=True), strict=True)) if rows else dict.fromkeys(columns, ())

    def refuse(self, row: int, column: str, cause: str) -> NoReturn:
        where = f"{self._table}.{column}"
        raise self._reader.error(
            cause, file=self._reader.path, row=row + 1, column=where, remedy="make the model again"
        )

    def texts(self, column: str) -> tuple[str, ...]:
        """Text cells; an editor may have left NULL where a text was emptied."""
        for row, cell in enumerate(self._cells[column]):
            if cell is not None and not isinstance(cell, str):
                self.refuse(row, column, f"{cell!r:.40} is no text")
        return tuple(cell or "" for cell in self._cells[column])

    def numbers(self, column: str) -> FloatArray:
        """Finite numbers."""
        for row, cell in enumerate(self._cells[column]):
            if not isinstance(cell, int | float) or not abs(cell) < np.inf:
                self.refuse(row, column, f"{cell!r:.40} is no finite number")
        return np.array(self._cells[column], dtype=np.float64)

    def places(self, column: str, names: dict[str, int], what: str) -> IntArray:
        """Indices of names."""
        for row, cell in enumerate(self._cells[column]):
            if not isinstance(cell, str) or cell not in names:
                self.refuse(row, column, f"{cell!r:.40} is no {what}")
        return np.array([names[cell] for cell in self._cells[column]], dtype=np.int64)

    def points(self, column: str) -> FloatArray:
        """Points, (n, 3)."""
        points = np.empty((self.length, 3))
        for row, cell in enumerate(self._cells[column]):
            point = decode_point(cell)
            if point is None or not np.isfinite(point[:2]).all():
                self.refuse(row, column, "is no point")
            points[row] = point
        return points

    def unique(self, column: str) -> tuple[str, ...]:
        """Identifiers."""
        texts, seen = self.texts(column), set()
        for row, text in enumerate(texts):
            if not text or text in seen:
                self.refuse(row, column, f"{text!r:.40} is empty or stands twice")
            seen.add(text)
        return texts


def _order(names: tuple[str, ...]) -> dict[str, int]:
    return {name: index for index, name in enumerate(names)}


def _read_frame(reader: Reader) -> GridFrame:
    texts = {}
    for key in ("crs_wkt", "crs_name", "crs_pipeline", "crs_operation"):
        value = reader.meta.get(key)
        if not isinstance(value, str) or (not value and key in ("crs_wkt", "crs_pipeline")):
            reader.refuse(f"{key} is missing", layer="railnav_meta", remedy="make the model again")
        texts[key.removeprefix("crs_")] = str(value)
    accuracy = reader.meta.get("crs_accuracy_m")
    if not isinstance(accuracy, int | float) or isinstance(accuracy, bool) or not 0 <= accuracy < np.inf:
        reader.refuse(f"crs_accuracy_m is {accuracy!r:.40}", layer="railnav_meta", remedy="make the model again")
        raise AssertionError
    return GridFrame(
        crs_wkt=texts["wkt"],
        name=texts["name"],
        pipeline=texts["pipeline"],
        operation=texts["operation"],
        accuracy=float(accuracy),
    )


def _read_nodes(reader: Reader) -> Nodes:
    rows = _Rows(reader, "nodes", ("geom", "node", "kind"))
    at = rows.points("geom")
    return Nodes(
        id=rows.unique("node"),
        kind=rows.places("kind", _KINDS, f"kind of node ({', '.join(_KINDS)})"),
        easting=at[:, 0].copy(),
        northing=at[:, 1].copy(),
        height=at[:, 2].copy(),
    )


def _read_tracks(reader: Reader, nodes: Nodes) -> dict[str, Any]:
    rows = _Rows(reader, "tracks", ("track", "line", "name", "start_node", "end_node"))
    if not rows.length:
        reader.refuse("has no track", layer="tracks")
    known = _order(nodes.id)
    return {
        "track_id": rows.unique("track"),
        "line": rows.texts("line"),
        "name": rows.texts("name"),
        "start_node": rows.places("start_node", known, "node"),
        "end_node": rows.places("end_node", known, "node"),
    }


def _read_mileposts(reader: Reader, track_id: tuple[str, ...]) -> MilePosts:
    rows = _Rows(reader, "mileposts", ("track", "offset_m", "chainage_m"))
    track = rows.places("track", _order(track_id), "track")
    offset, chainage = rows.numbers("offset_m"), rows.numbers("chainage_m")
    order = np.lexsort((offset, track))  # posts may have been added by hand
    return MilePosts(track[order], offset[order], chainage[order])


def _read_movements(reader: Reader, track_id: tuple[str, ...]) -> IntArray:
    rows = _Rows(reader, "movements", ("track_a", "end_a", "track_b", "end_b"))
    known = _order(track_id)
    columns = [
        rows.places("track_a", known, "track"),
        rows.places("end_a", _ENDS, "end (start, finish)"),
        rows.places("track_b", known, "track"),
        rows.places("end_b", _ENDS, "end (start, finish)"),
    ]
    return np.ascontiguousarray(np.column_stack(columns))


def _read_knots(reader: Reader, track_id: tuple[str, ...]) -> tuple[IntArray, dict[str, FloatArray]]:
    sizes = _Rows(reader, "knots", ("track", "knots", "crc32", "fid"))
    place = sizes.places("track", _order(track_id), "track of the layer tracks")
    sizes.unique("track")
    if sizes.length != len(track_id):
        absent = track_id[min(set(range(len(track_id))) - set(place.tolist()))]
        reader.refuse(f"track {absent!r:.40} has no knots", layer="knots", remedy="make the model again")
    counts, crc, fid = (sizes.numbers(column) for column in ("knots", "crc32", "fid"))
    count = np.zeros(len(track_id), np.int64)
    lengths = reader.select_lengths("knots", BLOB_COLUMNS)
    for row in range(sizes.length):
        if not 2 <= counts[row] < 2**40 or counts[row] % 1:
            sizes.refuse(row, "knots", f"{counts[row]:g} is no number of knots")
        count[place[row]] = int(counts[row])
        for name, length in zip(BLOB_COLUMNS, lengths[row], strict=True):
            size = _KNOT_BYTES[name]
            lawful = (size * counts[row],) if name == "offset" else (size * counts[row], size)
            if length is None:
                sizes.refuse(row, name, "is no BLOB")
            if length not in lawful:
                sizes.refuse(row, name, f"is {length} bytes long where {counts[row]:.0f} knots need {lawful[0]:.0f}")
    knot_start = np.concatenate([[0], np.cumsum(count)])
    knots = {name: np.empty((knot_start[-1], 6) if name == "covariance_g" else knot_start[-1]) for name in BLOB_COLUMNS}
    for row, i in enumerate(place.tolist()):
        part = slice(int(knot_start[i]), int(knot_start[i + 1]))
        checksum = 0
        for (name, blob), length in zip(reader.blobs("knots", BLOB_COLUMNS, int(fid[row])), lengths[row], strict=True):
            if not isinstance(blob, bytes) or len(blob) != length:
                sizes.refuse(row, name, "changes between two readings")
            checksum = zlib.crc32(blob, checksum)
            values = np.frombuffer(blob, "<f8")
            knots[name][part] = values.reshape(-1, 6) if name == "covariance_g" else values
        if checksum != crc[row]:
            sizes.refuse(row, "crc32", f"the geometry of track {track_id[i]!r:.40} is damaged (checksum differs)")
    return knot_start, knots
