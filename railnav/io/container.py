"""A GeoPackage as a container: the SQLite file, its reference systems, its layers and its geometries.

OGC 12-128r17 (GeoPackage 1.3), written through the standard library's sqlite3 alone. A geometry is a header (magic "GP",
version, flags, reference system, for lines an envelope) and well-known binary, little-endian. Coordinates always stand as
easting, northing, height, whatever axis order the registry gives the system.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError
from railnav.io.atomic import atomic_path

FloatArray = NDArray[np.float64]

#: "GPKG", and GeoPackage 1.3.0, as SQLite's header carries them.
APPLICATION_ID = 0x47504B47
USER_VERSION = 10300
#: The reference system's number where no registry has one.
OWN_SRS_ID = 100001
#: The table that marks a file as railnav's.
META = "railnav_meta"

_LONG_ROW_BYTES = 4_000_000

_WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)
_WGS84_2 = (
    'GEOGCRS["WGS 84",DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,298.257223563,'
    'LENGTHUNIT["metre",1]]],PRIMEM["Greenwich",0,ANGLEUNIT["degree",0.0174532925199433]],CS[ellipsoidal,2],'
    'AXIS["geodetic latitude (Lat)",north,ORDER[1],ANGLEUNIT["degree",0.0174532925199433]],'
    'AXIS["geodetic longitude (Lon)",east,ORDER[2],ANGLEUNIT["degree",0.0174532925199433]],ID["EPSG",4326]]'
)

_SCHEMA = """
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL,
  definition TEXT NOT NULL,
  description TEXT,
  definition_12_063 TEXT NOT NULL
);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY,
  data_type TEXT NOT NULL,
  identifier TEXT UNIQUE,
  description TEXT DEFAULT '',
  last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now')),
  min_x DOUBLE,
  min_y DOUBLE,
  max_x DOUBLE,
  max_y DOUBLE,
  srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id)
);
CREATE TABLE gpkg_geometry_columns (
  table_name TEXT NOT NULL,
  column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL,
  z TINYINT NOT NULL,
  m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id)
);
CREATE TABLE gpkg_extensions (
  table_name TEXT,
  column_name TEXT,
  extension_name TEXT NOT NULL,
  definition TEXT NOT NULL,
  scope TEXT NOT NULL,
  CONSTRAINT ge_tce UNIQUE (table_name, column_name, extension_name)
);
"""


class Container:
    """A GeoPackage being written; see `create`.

    Attributes
    ----------
    connection : sqlite3.Connection
        The open file.
    srs_id : int
        Number of the reference system that its layers are in.
    """

    def __init__(self, connection: sqlite3.Connection, crs_wkt: str) -> None:
        self.connection = connection
        self._stamp = _now()
        connection.executescript(f"{_SCHEMA}BEGIN;")
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {USER_VERSION}")
        self.srs_id = self._reference_systems(crs_wkt)
        connection.execute(
            "INSERT INTO gpkg_extensions VALUES (?, ?, ?, ?, ?)",
            (
                "gpkg_spatial_ref_sys",
                "definition_12_063",
                "gpkg_crs_wkt",
                "http://www.geopackage.org/spec130/#extension_crs_wkt",
                "read-write",
            ),
        )

    @property
    def stamp(self) -> str:
        """When the file is made, as its contents say it."""
        return self._stamp

    def _reference_systems(self, crs_wkt: str) -> int:
        undefined = "undefined"
        rows: list[tuple[str, int, str, int, str, str, str]] = [
            ("Undefined Cartesian SRS", -1, "NONE", -1, undefined, "undefined Cartesian", undefined),
            ("Undefined geographic SRS", 0, "NONE", 0, undefined, "undefined geographic", undefined),
            ("WGS 84 geodetic", 4326, "EPSG", 4326, _WGS84, "longitude and latitude in degrees", _WGS84_2),
        ]
        srs_id = 4326
        if crs_wkt:
            name, srs_id, organization, old, new = describe_crs(crs_wkt)
            if srs_id != 4326:
                rows.append((name, srs_id, organization, srs_id, old, "plane of the reference track model", new))
        self.connection.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?, ?)", rows)
        return srs_id

    def add_layer(
        self,
        name: str,
        columns: str,
        rows: Iterable[Sequence[Any]],
        *,
        geometry: str,
        bounds: tuple[float, float, float, float] | None,
        description: str,
    ) -> None:
        """Add a layer of features.

        Parameters
        ----------
        name : str
            Table and layer.
        columns : str
            SQL of the columns after `fid` and `geom`.
        rows : iterable of sequence
            `fid`, geometry or None, then the columns.
        geometry : str
            "POINT" or "LINESTRING"; heights are optional.
        bounds : tuple or None
            Least easting and northing, greatest easting and northing; None where there is no geometry.
        description : str
            For people.
        """
        self._add(name, f"geom {geometry}, {columns}", rows, "features", description, bounds)
        self.connection.execute(
            "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 2, 0)", (name, geometry, self.srs_id)
        )

    def add_table(self, name: str, columns: str, rows: Iterable[Sequence[Any]], *, description: str) -> None:
        """Add a table without geometry: rows are `fid`, then the columns."""
        self._add(name, columns, rows, "attributes", description, None)

    def add_meta(self, **values: Any) -> None:
        """Add the table of keys and JSON values that marks the file as railnav's; see `read_meta`."""
        rows = [
            (fid, key, json.dumps(value, allow_nan=False, ensure_ascii=False))
            for fid, (key, value) in enumerate(values.items(), 1)
        ]
        columns = "key TEXT NOT NULL UNIQUE, value TEXT NOT NULL"
        self.add_table(META, columns, rows, description="what this file is: keys and JSON values")

    def _add(
        self,
        name: str,
        columns: str,
        rows: Iterable[Sequence[Any]],
        data_type: str,
        description: str,
        bounds: tuple[float, float, float, float] | None,
    ) -> None:
        self.connection.execute(f"CREATE TABLE {name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, {columns})")
        srs_id = self.srs_id if data_type == "features" else None
        self.connection.execute(
            "INSERT INTO gpkg_contents VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (name, data_type, name, description, self._stamp, *(bounds or (None,) * 4), srs_id),
        )
        width = len(self.connection.execute(f"PRAGMA table_info({name})").fetchall())
        places = ", ".join("?" * width)
        self.connection.executemany(f"INSERT INTO {name} VALUES ({places})", rows)  # noqa: S608 - names are ours


@contextmanager
def create(path: str | Path, crs_wkt: str) -> Iterator[Container]:
    """Write a GeoPackage, whole or not at all.

    Parameters
    ----------
    path : path
        File to write; replaced in one step if it exists.
    crs_wkt : str
        Plane of the layers; WGS 84 degrees when empty.

    Yields
    ------
    Container
        To which layers and tables are added.

    Raises
    ------
    InputError
        The file cannot be written, or another program has the one that it replaces open.
    """
    _refuse_open(path)
    with atomic_path(path) as draft:
        connection = sqlite3.connect(draft, isolation_level=None)
        try:
            connection.execute("PRAGMA journal_mode = OFF")  # the draft is thrown away when anything fails
            connection.execute("PRAGMA synchronous = OFF")  # atomic_path flushes it once
            yield Container(connection, crs_wkt)
            connection.execute("COMMIT")
            _refuse_open(path)
        except sqlite3.Error as error:
            cause = f"cannot be written ({error})"
            raise InputError(cause, file=path, remedy="choose another place or make room") from error
        finally:
            connection.close()


def _refuse_open(path: str | Path) -> None:
    """Refuse a target with a log beside it: SQLite would play the old file's log into the new one."""
    for ending in ("-wal", "-journal"):
        try:
            log = Path(f"{Path(path).resolve()}{ending}")
            left = log.stat().st_size
        except (OSError, ValueError, RuntimeError):  # none there, or a path that atomic_path refuses
            continue
        if left:
            cause = f"the file is open in another program, or was when that crashed ({log.name} stands beside it)"
            raise InputError(cause, file=path, remedy=f"close it there, in QGIS for instance, or remove {log.name}")


@contextmanager
def opened(path: str | Path, content: str, *, newest: int, error: type[InputError]) -> Iterator[Reader]:
    """Open a GeoPackage that railnav wrote, read-only.

    Parameters
    ----------
    path : path
        File to read.
    content : str
        What it must hold, as `add_meta(content=...)` named it.
    newest : int
        The newest schema version that is understood.
    error : type
        The kind of InputError to raise.

    Yields
    ------
    Reader
        Whose failures become errors that name the file.

    Raises
    ------
    InputError
        The file is missing, no GeoPackage, damaged, not railnav's, of other content or of a newer schema.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise error("is a folder", file=path, remedy="name the GeoPackage in it")
        if not path.exists():
            raise error("does not exist", file=path, remedy="check the name")
        if not path.is_file():
            raise error("is no ordinary file", file=path)
        if path.stat().st_size == 0:
            raise error("is empty", file=path, remedy="make it again")
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, timeout=5.0, isolation_level=None)
    except (OSError, ValueError, sqlite3.Error) as cause:
        raise error(f"cannot be opened ({_one_line(cause)})", file=path) from cause
    try:
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA query_only = ON")
        reader = Reader(path, connection, error)
        reader.check(content, newest)
        yield reader
    except sqlite3.OperationalError as cause:
        if "locked" in str(cause) or "busy" in str(cause):
            raise error("is in use by another program", file=path, remedy="close it there") from cause
        raise _damaged(path, cause, error) from cause
    except (sqlite3.Error, OverflowError, UnicodeError) as cause:  # damaged names are no UTF-8
        raise _damaged(path, cause, error) from cause
    finally:
        connection.close()


def _one_line(text: object) -> str:
    return " ".join(str(text).split())


def _damaged(path: Path, cause: Exception, error: type[InputError]) -> InputError:
    text = f"is no GeoPackage, or a damaged one ({_one_line(cause)})"
    return error(text, file=path, remedy="make it again, or take it from where it came")


class Reader:
    """A GeoPackage open for reading; see `opened`.

    Attributes
    ----------
    path : path
        The file.
    connection : sqlite3.Connection
        Read-only.
    error : type
        The kind of InputError to raise.
    meta : dict
        What `add_meta` wrote.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, error: type[InputError]) -> None:
        self.path, self.connection, self.error = path, connection, error
        self.meta: dict[str, Any] = {}

    def refuse(self, cause: str, *, layer: str | None = None, remedy: str | None = None) -> NoReturn:
        """Raise the error for this file."""
        raise self.error(_one_line(cause), file=self.path, column=layer, remedy=_one_line(remedy or "") or None)

    def tables(self) -> set[str]:
        """Names of the tables in the file; views do not count."""
        return {name for (name,) in self.connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}

    def check(self, content: str, newest: int) -> None:
        """Refuse what is not railnav's, other content, and a newer schema; read `meta`."""
        if META not in self.tables():
            remedy = "railnav reads what railnav wrote; import a network from GeoJSON"
            self.refuse(f"holds no {content} (there is no table {META})", remedy=remedy)
        for key, value in self.connection.execute(f"SELECT key, value FROM {META}"):  # noqa: S608 - a constant
            try:
                self.meta[str(key)] = json.loads(value)
            except (TypeError, ValueError, RecursionError):
                self.refuse(f"the value of {str(key)[:40]!r} is no JSON", layer=META)
        if self.meta.get("content") != content:
            self.refuse(f"holds a {str(self.meta.get('content'))[:40]}, not a {content}")
        version = self.meta.get("schema_version")
        if type(version) is not int or version < 1:
            self.refuse(f"schema version {str(version)[:40]!r} is no number", layer=META)
        elif version > newest:
            made_by = str(self.meta.get("created_by", "a newer railnav"))[:60]
            cause = f"has schema version {version}, and this railnav reads up to {newest}"
            self.refuse(cause, remedy=f"use {made_by} or later")

    def select(self, table: str, columns: Sequence[str]) -> list[tuple[Any, ...]]:
        """Read columns of a table by the order of `fid`; refuse when table or column is missing."""
        self._check_columns(table, columns)
        listed = ", ".join(f'"{column}"' for column in columns)
        return self.connection.execute(f"SELECT {listed} FROM {table} ORDER BY fid").fetchall()  # noqa: S608 - our names

    def columns(self, table: str) -> set[str]:
        """Names of the columns of a table; refuse when it is missing."""
        if table not in self.tables():
            self.refuse("the table is missing", layer=table)
        return {row[1] for row in self.connection.execute(f"PRAGMA table_info({table})")}

    def _check_columns(self, table: str, columns: Sequence[str]) -> None:
        names = self.columns(table)
        for column in (*columns, "fid"):
            if column not in names:
                self.refuse(f"column {column!r} is missing", layer=table)

    def select_lengths(self, table: str, columns: Sequence[str]) -> list[tuple[int | None, ...]]:
        """Lengths in bytes of BLOB cells by the order of `fid`; None where a cell is no BLOB."""
        self._check_columns(table, columns)
        listed = ", ".join(f"CASE typeof({name}) WHEN 'blob' THEN length({name}) END" for name in columns)
        return self.connection.execute(f"SELECT {listed} FROM {table} ORDER BY fid").fetchall()  # noqa: S608 - our names

    def blobs(self, table: str, columns: Sequence[str], fid: int) -> Iterator[tuple[str, bytes]]:
        """Read the BLOB cells of one row, a long row one by one, so that memory holds one of them."""
        listed = ", ".join(columns)
        sizes = " + ".join(f"length({name})" for name in columns)
        found = self.connection.execute(f"SELECT {sizes} FROM {table} WHERE fid = ?", (fid,)).fetchone()  # noqa: S608
        if not found or found[0] is None:
            self.refuse(f"row {fid} cannot be found again", layer=table)
        if found[0] < _LONG_ROW_BYTES:
            row = self.connection.execute(f"SELECT {listed} FROM {table} WHERE fid = ?", (fid,)).fetchone()  # noqa: S608
            yield from zip(columns, row, strict=True)
            return
        for name in columns:
            with self.connection.blobopen(table, name, fid, readonly=True) as blob:
                yield name, blob.read()


@lru_cache(maxsize=8)
def describe_crs(crs_wkt: str) -> tuple[str, int, str, str, str]:
    """Describe a coordinate system as GeoPackage wants it.

    Parameters
    ----------
    crs_wkt : str
        Well-known text, any version.

    Returns
    -------
    name, srs_id, organization, definition, definition_12_063
        The EPSG code where the system is exactly that one; WKT1 ("undefined" where it cannot say it), WKT2.

    Examples
    --------
    >>> import pyproj
    >>> describe_crs(pyproj.CRS(28409).to_wkt())[:3]
    ('Pulkovo 1942 / Gauss-Kruger zone 9', 28409, 'EPSG')
    """
    import pyproj
    from pyproj.exceptions import CRSError

    try:
        crs = pyproj.CRS.from_wkt(crs_wkt)
    except CRSError as error:
        raise InputError(f"the coordinate system is no well-known text ({str(error)[:80]})") from error
    code = crs.to_epsg(min_confidence=100)
    try:
        old = crs.to_wkt("WKT1_GDAL") or "undefined"
    except CRSError:
        old = "undefined"
    return crs.name, code or OWN_SRS_ID, "EPSG" if code else "NONE", old, crs.to_wkt()


def _now() -> str:
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")  # reproducible-builds.org: the same bytes from the same input
    now = datetime.fromtimestamp(int(epoch), UTC) if epoch.isdigit() else datetime.now(UTC)
    return now.strftime("%Y-%m-%dT%H:%M:%S.000Z")


# --- geometries -------------------------------------------------------------------------------------------------------

_HEADER = [("magic", "S2"), ("version", "u1"), ("flags", "u1"), ("srs_id", "<i4")]
_POINT = np.dtype([*_HEADER, ("order", "u1"), ("type", "<u4"), ("at", "<f8", (2,))])
_POINT_Z = np.dtype([*_HEADER, ("order", "u1"), ("type", "<u4"), ("at", "<f8", (3,))])
_LINE = np.dtype([*_HEADER, ("bounds", "<f8", (4,)), ("order", "u1"), ("type", "<u4"), ("count", "<u4")])


def point_blobs(srs_id: int, easting: FloatArray, northing: FloatArray, height: FloatArray) -> list[bytes | None]:
    """Encode points; without a height they are flat, without a position None.

    Parameters
    ----------
    srs_id : int
        Reference system.
    easting, northing, height : (n,) array
        Coordinates; NaN where unknown.

    Returns
    -------
    list of bytes or None
    """
    blobs: list[bytes | None] = [None] * len(easting)
    known = np.isfinite(easting) & np.isfinite(northing)
    flat = ~np.isfinite(height)
    for kind, which, columns in (
        (_POINT, known & flat, (easting, northing)),
        (_POINT_Z, known & ~flat, (easting, northing, height)),
    ):
        rows = np.flatnonzero(which)
        record = np.zeros(len(rows), kind)
        record["magic"], record["flags"], record["srs_id"], record["order"] = b"GP", 1, srs_id, 1
        record["type"] = 1 if kind is _POINT else 1001
        record["at"] = np.column_stack([column[rows] for column in columns])
        data, size = record.tobytes(), kind.itemsize
        for place, row in enumerate(rows.tolist()):
            blobs[row] = data[place * size : (place + 1) * size]
    return blobs


def line_blob(srs_id: int, vertices: FloatArray) -> bytes:
    """Encode a line of (n, 2) or (n, 3) vertices, with its envelope."""
    record = np.zeros(1, _LINE)
    record["magic"], record["flags"], record["srs_id"], record["order"] = b"GP", 3, srs_id, 1
    record["bounds"] = [
        vertices[:, 0].min(),
        vertices[:, 0].max(),
        vertices[:, 1].min(),
        vertices[:, 1].max(),
    ]
    record["type"], record["count"] = (1002 if vertices.shape[1] == 3 else 2), len(vertices)
    return record.tobytes() + np.ascontiguousarray(vertices, "<f8").tobytes()


def decode_point(blob: object) -> tuple[float, float, float] | None:
    """Decode a point as any writer may have left it; None when it is none. A flat point has height NaN."""
    if not isinstance(blob, bytes) or len(blob) < 8 or blob[:2] != b"GP":
        return None
    envelope = (0, 32, 48, 48, 64, 0, 0, 0)[(blob[3] >> 1) & 7]
    body = blob[8 + envelope :]
    if len(body) < 5 or body[0] > 1:
        return None
    order = "<" if body[0] else ">"
    kind = int(np.frombuffer(body, f"{order}u4", 1, 1)[0])
    size = {1: 2, 1001: 3, 2001: 3, 3001: 4, 0x80000001: 3}.get(kind)
    if size is None or len(body) < 5 + 8 * size:
        return None
    at = np.frombuffer(body, f"{order}f8", size, 5)
    has_height = kind in (1001, 3001, 0x80000001)
    return float(at[0]), float(at[1]), float(at[2]) if has_height else float("nan")


def bounds_of(easting: FloatArray, northing: FloatArray) -> tuple[float, float, float, float] | None:
    """Least easting and northing, greatest easting and northing; None when no position is known."""
    known = np.isfinite(easting) & np.isfinite(northing)
    if not known.any():
        return None
    e, n = easting[known], northing[known]
    return float(e.min()), float(n.min()), float(e.max()), float(n.max())
