"""The shared store of reference track models: PostgreSQL with PostGIS, several readers and one writer.

A model is a row of `model`, each save a row of `version`; everything else hangs on the version and is never changed again. Lines
and points are geometry columns that QGIS opens; the knots are little-endian float64 arrays as in the GeoPackage, to the bit.
Readers see one snapshot. Writers of one model queue by an advisory lock. No value is ever part of a statement's text.
"""

from __future__ import annotations

import json
import struct
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError, ModelError, TrackError
from railnav.geodesy.plane import GridFrame
from railnav.io.container import create
from railnav.io.geopackage import (
    BLOB_COLUMNS,
    _check_unique,
    _drawing,
    _packed,
    _version,
    _write_meta,
)
from railnav.io.geopackage_records import read_records, write_records
from railnav.io.line_references import kilometre_rows, position_rows, references_of_rows
from railnav.io.postgis_server import (
    connected,
    has_tables,
    hold_lock,
    make_tables,
    phrase,
    plane_srid,
    set_limits,
    show_newest,
    store_names,
)
from railnav.io.store_address import StoreAddress, store_address
from railnav.track.model import End, MilePosts, NodeKind, Nodes, TrackModel

if TYPE_CHECKING:
    import psycopg
    from psycopg import sql

FloatArray = NDArray[np.float64]

#: Version of the tables below.
SCHEMA_VERSION = 1
#: A version with more bytes of knots than this is refused before it is fetched.
MAX_KNOT_BYTES = 16 * 1024**3
#: Survey records of more bytes do not fit a field.
MAX_RECORD_BYTES = 900_000_000

_KNOT_BYTES = {name: 48 if name == "covariance_g" else 8 for name in BLOB_COLUMNS}


@dataclass(frozen=True, slots=True)
class StoredVersion:
    """One saved version: of which model, its number, when, by which program, with what note, tracks and length (m)."""

    model: str
    version: int
    created: datetime
    created_by: str
    note: str
    tracks: int
    length: float


def write_model(model: TrackModel, address: str | Path, *, note: str = "") -> int:
    """Save a model in a store as a new version, whole or not at all.

    Parameters
    ----------
    model : TrackModel
        What to save.
    address : str
        "postgresql://host/database?model=line80"; tables are made at the first save.
    note : str
        Said with the version; also `&note=` in the address.

    Returns
    -------
    int
        Number of the version, from 1.

    Raises
    ------
    ModelError
        The store cannot be reached or is of a newer schema; the address names no model, or a version; another writer holds the
        model for ten seconds; the database has no PostGIS; or the model holds what cannot be stored.

    Notes
    -----
    Versions are never overwritten. The views "<model> tracks", "<model> nodes" and "<model> mileposts" show the newest one.
    """
    where = store_address(address)
    if not where.model:
        raise ModelError("names no model", file=str(where), remedy="add ?model=name")
    if where.version is not None:
        raise ModelError(
            f"names version {where.version}, and a version is never overwritten", file=str(where), remedy="leave it out"
        )
    _check_unique(model.track_id, "track", str(where))
    _check_unique(model.nodes.id, "node", str(where))
    try:
        provenance = json.dumps(model.provenance, allow_nan=False, ensure_ascii=True)
    except (TypeError, ValueError) as error:
        raise ModelError(f"the provenance holds more than JSON values ({error})", file=str(where)) from error
    records = _packed_records(model, where)
    with connected(where) as connection, connection.transaction():
        set_limits(connection, lock=True)
        make_tables(connection, where)
        hold_lock(connection, where)
        srid = plane_srid(connection, model.frame.crs_wkt)
        names = store_names(where)
        row = connection.execute(
            phrase(
                "INSERT INTO {s}.model (name) VALUES (%s) ON CONFLICT (name) DO UPDATE SET name = excluded.name RETURNING model_id",
                names,
            ),
            (where.model,),
        ).fetchone()
        assert row is not None
        frame = model.frame
        crs = {
            "name": frame.name,
            "wkt": frame.crs_wkt,
            "pipeline": frame.pipeline,
            "operation": frame.operation,
            "accuracy_m": frame.accuracy,
        }
        made = connection.execute(
            phrase(
                "INSERT INTO {s}.version (model_id, version, schema_version, created_by, note, length_m, srid, crs, provenance) "
                "SELECT %s, coalesce(max(version), 0) + 1, %s, %s, %s, %s, %s, %s, %s FROM {s}.version WHERE model_id = %s "
                "RETURNING version_id, version",
                names,
            ),
            (
                row[0],
                SCHEMA_VERSION,
                _version(),
                note or where.note,
                float(model.lengths.sum()),
                srid,
                json.dumps(crs),
                provenance,
                row[0],
            ),
        ).fetchone()
        assert made is not None
        _copy_all(connection, names, int(made[0]), model, srid)
        if records is not None:
            connection.execute(phrase("INSERT INTO {s}.records VALUES (%s, %s)", names), (made[0], records))
        show_newest(connection, where, int(row[0]), srid)
        return int(made[1])


def read_model(address: str | Path) -> TrackModel:
    """Read a model from a store.

    Parameters
    ----------
    address : str
        "postgresql://host/database?model=line80", the newest version, or with "&version=3" that one. The model may be left out
        where the store has only one.

    Returns
    -------
    TrackModel
        As it was saved, to the bit.

    Raises
    ------
    ModelError
        The store cannot be reached, has no such model or version, is of a newer schema, or its rows do not agree.
    """
    where = store_address(address)
    names = store_names(where)
    with connected(where) as connection:
        connection.read_only = True
        from psycopg import IsolationLevel

        connection.isolation_level = IsolationLevel.REPEATABLE_READ
        with connection.transaction():
            set_limits(connection)
            where, version_id, crs, provenance = _find(connection, where)
            tracks = _rows(connection, names, "track", ("track", "line", "name", "start_node", "end_node"), version_id)
            nodes = _rows(connection, names, "node", ("node", "kind", "easting", "northing", "height"), version_id)
            posts = _rows(connection, names, "milepost", ("track", "offset_m", "chainage_m"), version_id)
            movements = _rows(connection, names, "movement", ("track_a", "end_a", "track_b", "end_b"), version_id)
            lines = _rows(
                connection, names, "kilometre", ("line", "label", "start_m", "end_m", "counted_m", "unit_m"), version_id
            )
            places = _rows(connection, names, "line_position", ("track", "line", "offset_m", "position_m"), version_id)
            knot_start, knots = _read_knots(connection, names, version_id, len(tracks), where)
            kept = connection.execute(
                phrase("SELECT 1 FROM {s}.records WHERE version_id = %s", names), (version_id,)
            ).fetchone()
    try:
        known = {row[0]: i for i, row in enumerate(tracks)}
        node_of = {row[0]: i for i, row in enumerate(nodes)}
        ends = {end.name.lower(): int(end) for end in End}
        kinds = {kind.name.lower().replace("_", "-"): int(kind) for kind in NodeKind}
        post = sorted((known[t], float(s), float(c)) for t, s, c in posts)
        model = TrackModel(
            frame=GridFrame(crs["wkt"], crs["name"], crs["pipeline"], crs["operation"], float(crs["accuracy_m"])),
            track_id=tuple(row[0] for row in tracks),
            line=tuple(row[1] for row in tracks),
            name=tuple(row[2] for row in tracks),
            start_node=np.array([node_of[row[3]] for row in tracks], np.int64),
            end_node=np.array([node_of[row[4]] for row in tracks], np.int64),
            knot_start=knot_start,
            **{name: values for name, values in knots.items() if name != "covariance_g"},
            covariance_g=knots["covariance_g"],
            nodes=Nodes(
                tuple(row[0] for row in nodes),
                np.array([kinds[row[1]] for row in nodes], np.int64),
                np.array([row[2] for row in nodes], np.float64),
                np.array([row[3] for row in nodes], np.float64),
                np.array([np.nan if row[4] is None else row[4] for row in nodes], np.float64),
            ),
            movements=np.array([(known[a], ends[x], known[b], ends[y]) for a, x, b, y in movements], np.int64).reshape(
                -1, 4
            ),
            mileposts=MilePosts(
                np.array([p[0] for p in post], np.int64),
                np.array([p[1] for p in post], np.float64),
                np.array([p[2] for p in post], np.float64),
            ),
            references=references_of_rows(lines, places, tuple(known)),
            provenance=provenance,
            record_source=None if kept is None else _Records(where, version_id),
        )
    except KeyError as error:
        raise ModelError(f"a row names {error}, which the model does not have", file=str(where)) from error
    except TrackError as error:
        raise ModelError(str(error), file=str(where), remedy="save the model again") from error
    return model


def list_versions(address: str | Path) -> list[StoredVersion]:
    """Every version in a store, or of one model where the address names one; newest last.

    Parameters
    ----------
    address : str
        "postgresql://host/database" or with "?model=line80".

    Returns
    -------
    list of StoredVersion
        Empty where nothing was ever saved.

    Raises
    ------
    ModelError
        The store cannot be reached.
    """
    where = store_address(address)
    with connected(where) as connection:
        connection.read_only = True
        with connection.transaction():
            set_limits(connection)
            if not has_tables(connection, where):
                return []
            rows = connection.execute(
                phrase(
                    "SELECT m.name, v.version, v.created, v.created_by, v.note, "
                    "(SELECT count(*) FROM {s}.track t WHERE t.version_id = v.version_id), v.length_m "
                    "FROM {s}.version v JOIN {s}.model m USING (model_id) WHERE %s = '' OR m.name = %s "
                    "ORDER BY m.name, v.version",
                    store_names(where),
                ),
                (where.model, where.model),
            ).fetchall()
    return [StoredVersion(*row) for row in rows]


# --- writing -----------------------------------------------------------------------------------------------------------


def _point(srid: int, easting: float, northing: float, height: float) -> bytes | None:
    """A point as extended well-known binary; None without a position."""
    if not (np.isfinite(easting) and np.isfinite(northing)):
        return None
    if np.isfinite(height):
        return struct.pack("<BIIddd", 1, 0xA0000001, srid, easting, northing, height)
    return struct.pack("<BIIdd", 1, 0x20000001, srid, easting, northing)


def _line(srid: int, vertices: FloatArray) -> bytes:
    """A line as extended well-known binary."""
    kind = 0xA0000002 if vertices.shape[1] == 3 else 0x20000002
    return struct.pack("<BIII", 1, kind, srid, len(vertices)) + np.ascontiguousarray(vertices, "<f8").tobytes()


def _copy(
    connection: psycopg.Connection[Any],
    names: dict[str, sql.Composable],
    table: str,
    columns: Sequence[str],
    types: Sequence[str],
    version_id: int,
    rows: Iterable[Sequence[Any]],
) -> None:
    """Bring rows in by COPY in binary form: no text is built of any value."""
    from psycopg import sql

    listed = sql.SQL(", ").join(map(sql.Identifier, ("version_id", "ordinal", *columns)))
    statement = sql.SQL("COPY {}.{} ({}) FROM STDIN (FORMAT BINARY)").format(names["s"], sql.Identifier(table), listed)
    with connection.cursor() as cursor, cursor.copy(statement) as copy:
        copy.set_types(["int8", "int4", *types])
        for ordinal, row in enumerate(rows):
            copy.write_row((version_id, ordinal, *row))


def _copy_all(
    connection: psycopg.Connection[Any],
    names: dict[str, sql.Composable],
    version_id: int,
    model: TrackModel,
    srid: int,
) -> None:
    tracks = np.arange(len(model.track_id))
    lengths, first = model.lengths, model.offset[model.knot_start[:-1]]
    ends_km = [model.chainage(tracks, offset) / 1000 for offset in (first, first + lengths)]
    nodes, posts = model.nodes, model.mileposts
    ends = [end.name.lower() for end in End]

    def known(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    def track_rows() -> Iterator[tuple[Any, ...]]:
        for i in tracks.tolist():
            yield (
                model.track_id[i],
                model.line[i],
                model.name[i],
                float(lengths[i]),
                known(ends_km[0][i]),
                known(ends_km[1][i]),
                nodes.id[model.start_node[i]],
                nodes.id[model.end_node[i]],
                _line(srid, _drawing(model, i)),
            )

    def post_rows() -> Iterator[tuple[Any, ...]]:
        for track, offset, chainage in zip(posts.track.tolist(), posts.offset, posts.chainage, strict=True):
            part = slice(int(model.knot_start[track]), int(model.knot_start[track + 1]))
            at = [
                float(np.interp(offset, model.offset[part], column[part]))
                for column in (model.easting, model.northing, model.height)
            ]
            yield model.track_id[track], float(offset), float(chainage), _point(srid, *at)

    def knot_rows() -> Iterator[tuple[Any, ...]]:
        for i in tracks.tolist():
            part = slice(int(model.knot_start[i]), int(model.knot_start[i + 1]))
            blobs = [_packed(getattr(model, name)[part]) for name in BLOB_COLUMNS]
            checksum = 0
            for blob in blobs:
                checksum = zlib.crc32(blob, checksum)
            yield (part.stop - part.start, checksum, *blobs)

    real, text = "float8", "text"
    # a geometry arrives as extended well-known binary, whose binary form on the wire is that of bytea
    for table, columns, types, rows in (
        (
            "track",
            ("track", "line", "name", "length_m", "start_km", "end_km", "start_node", "end_node", "geom"),
            (text, text, text, real, real, real, text, text, "bytea"),
            track_rows(),
        ),
        (
            "node",
            ("node", "kind", "easting", "northing", "height", "geom"),
            (text, text, real, real, real, "bytea"),
            (
                (
                    nodes.id[i],
                    NodeKind(int(nodes.kind[i])).name.lower().replace("_", "-"),
                    float(nodes.easting[i]),
                    float(nodes.northing[i]),
                    known(nodes.height[i]),
                    _point(srid, float(nodes.easting[i]), float(nodes.northing[i]), float(nodes.height[i])),
                )
                for i in range(len(nodes.id))
            ),
        ),
        ("milepost", ("track", "offset_m", "chainage_m", "geom"), (text, real, real, "bytea"), post_rows()),
        (
            "movement",
            ("track_a", "end_a", "track_b", "end_b"),
            (text, text, text, text),
            ((model.track_id[a], ends[x], model.track_id[b], ends[y]) for a, x, b, y in model.movements.tolist()),
        ),
        (
            "kilometre",
            ("line", "label", "start_m", "end_m", "counted_m", "unit_m"),
            (text, "int8", real, real, real, real),
            kilometre_rows(model.references),
        ),
        (
            "line_position",
            ("track", "line", "offset_m", "position_m"),
            (text, text, real, real),
            position_rows(model.references, model.track_id),
        ),
        ("knots", ("knots", "crc32", *BLOB_COLUMNS), ("int8", "int8", *["bytea"] * len(BLOB_COLUMNS)), knot_rows()),
    ):
        _copy(connection, names, table, columns, types, version_id, rows)


def _packed_records(model: TrackModel, where: StoreAddress) -> bytes | None:
    """The survey records of a model as a GeoPackage of their own; None where it has none."""
    records = model.records
    if records is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "records.gpkg"
        with create(path, model.frame.crs_wkt) as container:
            _write_meta(container, model)
            write_records(container, records)
        if path.stat().st_size > MAX_RECORD_BYTES:
            raise ModelError(
                f"survey records of {path.stat().st_size / 1e6:.0f} MB do not fit a field of the database",
                file=str(where),
                remedy="keep them in a GeoPackage and store dataclasses.replace(model, record_source=None)",
            )
        return path.read_bytes()


# --- reading -----------------------------------------------------------------------------------------------------------


def _find(
    connection: psycopg.Connection[Any], where: StoreAddress
) -> tuple[StoreAddress, int, dict[str, Any], dict[str, Any]]:
    """The version that an address means: the address in full, its key, its plane and its provenance."""
    if not has_tables(connection, where):
        raise ModelError("holds no models", file=str(where), remedy="save one, or name the schema by &schema=")
    names = store_names(where)
    models = [row[0] for row in connection.execute(phrase("SELECT name FROM {s}.model ORDER BY name", names))]
    model = where.model or (models[0] if len(models) == 1 else "")
    if model not in models:
        listed = ", ".join(models[:10]) or "none"
        what = f"has no model {where.model!r}" if where.model else "holds several models and none is named"
        raise ModelError(what, file=str(where), remedy=f"it has {listed}")
    row = connection.execute(
        phrase(
            "SELECT v.version_id, v.version, v.schema_version, v.created_by, v.crs, v.provenance FROM {s}.version v "
            "JOIN {s}.model m USING (model_id) WHERE m.name = %s AND (%s::int IS NULL OR v.version = %s) "
            "ORDER BY v.version DESC LIMIT 1",
            names,
        ),
        (model, where.version, where.version),
    ).fetchone()
    if row is None:
        newest = connection.execute(
            phrase("SELECT max(version) FROM {s}.version JOIN {s}.model USING (model_id) WHERE name = %s", names),
            (model,),
        ).fetchone()
        raise ModelError(
            f"has no version {where.version} of {model!r}",
            file=str(where),
            remedy=f"the newest is {newest[0] if newest else None}",
        )
    version_id, version, schema_version, made_by, crs, provenance = row
    if schema_version > SCHEMA_VERSION:
        raise ModelError(
            f"has schema version {schema_version}, and this railnav reads up to {SCHEMA_VERSION}",
            file=str(where),
            remedy=f"use {made_by} or later",
        )
    texts = ("name", "wkt", "pipeline", "operation")
    accuracy = crs.get("accuracy_m") if isinstance(crs, dict) else None
    if accuracy is None or not all(isinstance(crs.get(key), str) for key in texts) or not isinstance(provenance, dict):
        raise ModelError("the plane or the provenance is damaged", file=str(where), remedy="save the model again")
    full = StoreAddress(where.dsn, model, int(version), where.schema)
    return full, int(version_id), crs, provenance


def _rows(
    connection: psycopg.Connection[Any],
    names: dict[str, sql.Composable],
    table: str,
    columns: Sequence[str],
    version_id: int,
) -> list[tuple[Any, ...]]:
    from psycopg import sql

    statement = sql.SQL("SELECT {} FROM {}.{} WHERE version_id = %s ORDER BY ordinal").format(
        sql.SQL(", ").join(map(sql.Identifier, columns)), names["s"], sql.Identifier(table)
    )
    with connection.cursor(binary=True) as cursor:
        return cursor.execute(statement, (version_id,)).fetchall()


def _read_knots(
    connection: psycopg.Connection[Any],
    names: dict[str, sql.Composable],
    version_id: int,
    tracks: int,
    where: StoreAddress,
) -> tuple[NDArray[np.int64], dict[str, FloatArray]]:
    from psycopg import sql

    counts = connection.execute(
        phrase("SELECT knots FROM {s}.knots WHERE version_id = %s ORDER BY ordinal", names), (version_id,)
    ).fetchall()
    count = np.array([row[0] for row in counts], np.int64)
    if len(count) != tracks or (count < 2).any():
        raise ModelError(
            f"{len(count)} rows of knots for {tracks} tracks", file=str(where), remedy="save the model again"
        )
    if int(count.sum()) * sum(_KNOT_BYTES.values()) > MAX_KNOT_BYTES:
        raise ModelError(f"holds {int(count.sum()):,} knots, more than fit in memory", file=str(where))
    knot_start = np.concatenate([[0], np.cumsum(count)])
    knots = {name: np.empty((knot_start[-1], 6) if name == "covariance_g" else knot_start[-1]) for name in BLOB_COLUMNS}
    statement = sql.SQL("SELECT crc32, {} FROM {}.knots WHERE version_id = %s ORDER BY ordinal").format(
        sql.SQL(", ").join(map(sql.Identifier, BLOB_COLUMNS)), names["s"]
    )
    with connection.cursor(name="knots", binary=True) as cursor:  # by portions: memory holds a few tracks twice
        cursor.itersize = 8
        cursor.execute(statement, (version_id,))
        for i, row in enumerate(cursor):
            part, checksum = slice(int(knot_start[i]), int(knot_start[i + 1])), 0
            for name, blob in zip(BLOB_COLUMNS, row[1:], strict=True):
                size = _KNOT_BYTES[name]
                if len(blob) != size * count[i] and not (len(blob) == size and name != "offset"):
                    raise ModelError(
                        f"{name} of track {i + 1} has {len(blob)} bytes", file=str(where), column=f"knots.{name}"
                    )
                checksum = zlib.crc32(blob, checksum)
                values = np.frombuffer(blob, "<f8")
                knots[name][part] = values.reshape(-1, 6) if name == "covariance_g" else values
            if checksum != row[0]:
                raise ModelError(
                    f"the geometry of track {i + 1} is damaged (checksum differs)",
                    file=str(where),
                    column="knots.crc32",
                )
    return knot_start, knots


class _Records:
    """Fetch the survey records of a version when they are asked for."""

    def __init__(self, where: StoreAddress, version_id: int) -> None:
        self._where, self._version_id = where, version_id

    def __call__(self) -> Any:
        with connected(self._where) as connection, connection.cursor(binary=True) as cursor:
            row = cursor.execute(
                phrase("SELECT container FROM {s}.records WHERE version_id = %s", store_names(self._where)),
                (self._version_id,),
            ).fetchone()
        if row is None:
            raise InputError("its survey records are gone", file=str(self._where))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "records.gpkg"
            path.write_bytes(row[0])
            return read_records(path)
