"""The shared store's server side: connection and limits, tables, the writers' lock, planes, and views for people.

Identifiers are quoted by the driver and values are parameters; nothing else becomes part of a statement.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from railnav.errors import ModelError, RailnavError
from railnav.io.container import describe_crs
from railnav.io.geopackage import BLOB_COLUMNS
from railnav.io.store_address import StoreAddress

if TYPE_CHECKING:
    import psycopg
    from psycopg import sql

#: Seconds to wait for the server, for another writer, and for one statement.
CONNECT_TIMEOUT, LOCK_TIMEOUT, STATEMENT_TIMEOUT = 10, 10, 120
_LOCK_ROOM = 0x7261696C  # "rail": the advisory locks of this program

_TABLES = """
CREATE TABLE {s}.model (
  model_id serial PRIMARY KEY,
  name text NOT NULL UNIQUE
);
CREATE TABLE {s}.version (
  version_id bigserial PRIMARY KEY,
  model_id integer NOT NULL REFERENCES {s}.model ON DELETE CASCADE,
  version integer NOT NULL,
  schema_version integer NOT NULL,
  created timestamptz NOT NULL DEFAULT now(),
  created_by text NOT NULL,
  note text NOT NULL,
  length_m double precision NOT NULL,
  srid integer NOT NULL,
  crs json NOT NULL,
  provenance json NOT NULL,
  UNIQUE (model_id, version)
);
CREATE TABLE {s}.track (
  version_id bigint NOT NULL REFERENCES {s}.version ON DELETE CASCADE,
  ordinal integer NOT NULL,
  track text NOT NULL,
  line text NOT NULL,
  name text NOT NULL,
  length_m double precision NOT NULL,
  start_km double precision,
  end_km double precision,
  start_node text NOT NULL,
  end_node text NOT NULL,
  geom geometry NOT NULL,
  PRIMARY KEY (version_id, ordinal)
);
CREATE TABLE {s}.node (
  version_id bigint NOT NULL REFERENCES {s}.version ON DELETE CASCADE,
  ordinal integer NOT NULL,
  node text NOT NULL,
  kind text NOT NULL,
  easting double precision NOT NULL,
  northing double precision NOT NULL,
  height double precision,
  geom geometry NOT NULL,
  PRIMARY KEY (version_id, ordinal)
);
CREATE TABLE {s}.milepost (
  version_id bigint NOT NULL REFERENCES {s}.version ON DELETE CASCADE,
  ordinal integer NOT NULL,
  track text NOT NULL,
  offset_m double precision NOT NULL,
  chainage_m double precision NOT NULL,
  geom geometry,
  PRIMARY KEY (version_id, ordinal)
);
CREATE TABLE {s}.movement (
  version_id bigint NOT NULL REFERENCES {s}.version ON DELETE CASCADE,
  ordinal integer NOT NULL,
  track_a text NOT NULL,
  end_a text NOT NULL,
  track_b text NOT NULL,
  end_b text NOT NULL,
  PRIMARY KEY (version_id, ordinal)
);
CREATE TABLE {s}.kilometre (
  version_id bigint NOT NULL REFERENCES {s}.version ON DELETE CASCADE,
  ordinal integer NOT NULL,
  line text NOT NULL,
  label bigint NOT NULL,
  start_m double precision NOT NULL,
  end_m double precision NOT NULL,
  counted_m double precision NOT NULL,
  unit_m double precision NOT NULL,
  PRIMARY KEY (version_id, ordinal)
);
CREATE TABLE {s}.line_position (
  version_id bigint NOT NULL REFERENCES {s}.version ON DELETE CASCADE,
  ordinal integer NOT NULL,
  track text NOT NULL,
  line text NOT NULL,
  offset_m double precision NOT NULL,
  position_m double precision NOT NULL,
  PRIMARY KEY (version_id, ordinal)
);
CREATE TABLE {s}.knots (
  version_id bigint NOT NULL REFERENCES {s}.version ON DELETE CASCADE,
  ordinal integer NOT NULL,
  knots bigint NOT NULL,
  crc32 bigint NOT NULL,
  {knots},
  PRIMARY KEY (version_id, ordinal)
);
CREATE TABLE {s}.records (
  version_id bigint PRIMARY KEY REFERENCES {s}.version ON DELETE CASCADE,
  container bytea NOT NULL
);
CREATE INDEX ON {s}.track USING gist (geom);
CREATE INDEX ON {s}.node USING gist (geom);
"""


@contextmanager
def connected(where: StoreAddress) -> Iterator[psycopg.Connection[Any]]:
    """A connection whose failures become errors that name the store, without its password."""
    try:
        import psycopg
    except ImportError as error:
        raise RailnavError('stores need psycopg; install with: pip install "railnav[stores]"') from error
    try:
        connection = psycopg.connect(
            where.dsn, connect_timeout=CONNECT_TIMEOUT, application_name="railnav", autocommit=False
        )
    except (psycopg.Error, ValueError, OSError) as error:
        raise ModelError(f"cannot be reached ({_one_line(error, where)})", file=str(where)) from error
    try:
        yield connection
    except psycopg.errors.LockNotAvailable as error:
        raise ModelError(
            f"another writer is saving this model, for more than {LOCK_TIMEOUT} s",
            file=str(where),
            remedy="try again later",
        ) from error
    except psycopg.errors.QueryCanceled as error:
        raise ModelError(f"a statement took more than {STATEMENT_TIMEOUT} s", file=str(where)) from error
    except psycopg.errors.InsufficientPrivilege as error:
        raise ModelError(
            f"refuses ({_one_line(error, where)})", file=str(where), remedy="ask for the rights"
        ) from error
    except (psycopg.Error, UnicodeError) as error:
        raise ModelError(f"fails ({_one_line(error, where)})", file=str(where)) from error
    finally:
        connection.close()


def _one_line(error: BaseException, where: StoreAddress) -> str:
    from urllib.parse import unquote, urlsplit

    text = " ".join(str(error).split())[:200]
    password = urlsplit(where.dsn).password
    for secret in filter(None, (password, unquote(password) if password else None)):
        text = text.replace(secret, "***")
    return text


def store_names(where: StoreAddress) -> dict[str, sql.Composable]:
    """The identifiers of statements: `{s}` is the schema, quoted."""
    try:
        from psycopg import sql
    except ImportError as error:
        raise RailnavError('stores need psycopg; install with: pip install "railnav[stores]"') from error
    return {"s": sql.Identifier(where.schema)}


def phrase(statement: str, names: dict[str, sql.Composable]) -> sql.Composed:
    """A statement with its identifiers quoted; values are always parameters."""
    from psycopg import sql

    return sql.SQL(statement).format(**names)  # constants of this module


def set_limits(connection: psycopg.Connection[Any], *, lock: bool = False) -> None:
    """Limits that the server keeps, for this transaction."""
    connection.execute("SELECT set_config('statement_timeout', %s, true)", (str(STATEMENT_TIMEOUT * 1000),))
    connection.execute("SELECT set_config('idle_in_transaction_session_timeout', %s, true)", ("60000",))
    if lock:
        connection.execute("SELECT set_config('lock_timeout', %s, true)", (str(LOCK_TIMEOUT * 1000),))


def has_tables(connection: psycopg.Connection[Any], where: StoreAddress) -> bool:
    """Whether anything was ever saved in the schema."""
    row = connection.execute(
        "SELECT 1 FROM information_schema.tables WHERE table_schema = %s AND table_name = 'version'", (where.schema,)
    ).fetchone()
    return row is not None


def make_tables(connection: psycopg.Connection[Any], where: StoreAddress) -> None:
    """Make the tables at the first save."""
    import psycopg
    from psycopg import sql

    connection.execute("SELECT pg_advisory_xact_lock(%s, 0)", (_LOCK_ROOM,))  # two first saves at once
    if has_tables(connection, where):
        return
    try:
        with connection.transaction():
            connection.execute("CREATE EXTENSION IF NOT EXISTS postgis")
    except (
        psycopg.errors.UndefinedFile,
        psycopg.errors.FeatureNotSupported,
        psycopg.errors.InsufficientPrivilege,
    ) as error:
        raise ModelError(
            f"the database has no PostGIS ({_one_line(error, where)})",
            file=str(where),
            remedy="CREATE EXTENSION postgis",
        ) from error
    names = store_names(where)
    connection.execute(phrase("CREATE SCHEMA IF NOT EXISTS {s}", names))
    columns = sql.SQL(", ").join(sql.SQL("{} bytea NOT NULL").format(sql.Identifier(name)) for name in BLOB_COLUMNS)
    connection.execute(phrase(_TABLES, {**names, "knots": columns}))
    for table, column in (*(("knots", name) for name in BLOB_COLUMNS), ("records", "container")):
        connection.execute(  # surveyed digits do not compress: trying costs more than it saves
            sql.SQL("ALTER TABLE {}.{} ALTER COLUMN {} SET STORAGE EXTERNAL").format(
                sql.Identifier(where.schema), sql.Identifier(table), sql.Identifier(column)
            )
        )


def hold_lock(connection: psycopg.Connection[Any], where: StoreAddress) -> None:
    """Queue behind other writers of this model; released when the transaction ends."""
    key = zlib.crc32(f"{where.schema}\0{where.model}".encode()) & 0x7FFFFFFF or 1
    connection.execute("SELECT pg_advisory_xact_lock(%s, %s)", (_LOCK_ROOM, key))


def plane_srid(connection: psycopg.Connection[Any], crs_wkt: str) -> int:
    """Number of the plane in the database: its EPSG code, or one of our own; 0 where we may not add one."""
    import psycopg

    _, code, organization, old, new = describe_crs(crs_wkt)
    if organization == "EPSG":
        found = connection.execute("SELECT 1 FROM spatial_ref_sys WHERE srid = %s", (code,)).fetchone()
        if found:
            return code
    text = new if old == "undefined" else old
    srid = 910_000 + zlib.crc32(text.encode()) % 80_000
    try:
        with connection.transaction():
            for _ in range(100):
                connection.execute(
                    "INSERT INTO spatial_ref_sys (srid, auth_name, auth_srid, srtext, proj4text) "
                    "VALUES (%s, 'railnav', %s, %s, '') ON CONFLICT (srid) DO NOTHING",
                    (srid, srid, text[:2048]),
                )
                row = connection.execute("SELECT srtext FROM spatial_ref_sys WHERE srid = %s", (srid,)).fetchone()
                if row and row[0] == text[:2048]:
                    return srid
                srid += 1
    except psycopg.errors.InsufficientPrivilege:
        return 0  # lines and points are there all the same; QGIS asks for their system
    return 0


def show_newest(connection: psycopg.Connection[Any], where: StoreAddress, model_id: int, srid: int) -> None:
    """Views of the newest version with typed geometry, so that QGIS opens them with a click."""
    from psycopg import sql

    for table, kind in (("track", "LineString"), ("node", "Point"), ("milepost", "Point")):
        columns = {
            "track": ("track", "line", "name", "length_m", "start_km", "end_km", "start_node", "end_node"),
            "node": ("node", "kind"),
            "milepost": ("track", "offset_m", "chainage_m"),
        }[table]
        view = sql.SQL("{}.{}").format(sql.Identifier(where.schema), sql.Identifier(f"{where.model[:40]} {table}s"))
        connection.execute(sql.SQL("DROP VIEW IF EXISTS {}").format(view))
        connection.execute(
            sql.SQL(
                "CREATE VIEW {} AS SELECT ordinal + 1 AS fid, {}, ST_Force3D(geom)::geometry({}Z, {}) AS geom FROM {}.{} "
                "WHERE version_id = (SELECT version_id FROM {}.version WHERE model_id = {} ORDER BY version DESC LIMIT 1)"
            ).format(
                view,
                sql.SQL(", ").join(map(sql.Identifier, columns)),
                sql.SQL(kind),  # one of two constants
                sql.Literal(srid),
                sql.Identifier(where.schema),
                sql.Identifier(table),
                sql.Identifier(where.schema),
                sql.Literal(model_id),
            )
        )
