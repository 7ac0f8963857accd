"""The survey's square-root records in a model's GeoPackage: three tables beside the knots (`track_models/README.md`)."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError, ModelError, RailnavError
from railnav.io.container import Container, Reader, opened
from railnav.track.records import ROW_SIZE, AxisRecords, Borders, ModelRecords, RecordSource, TrackRecords

FloatArray = NDArray[np.float64]

#: What `railnav_meta` calls the file's content.
CONTENT = "reference track model"
#: Version of the schema in track_models/README.md.
SCHEMA_VERSION = 1
#: The table of chain records, a row a track, and its BLOB columns in the order of their checksum.
RECORDS = "records"
RECORD_COLUMNS = (
    "easting", "northing", "height", "across", "across_lean", "across_noise", "up", "up_lean", "up_noise",
)  # fmt: skip
#: Beside it: what is known of the frame offsets, one row for the plane and one for height.
BORDERS = "record_borders"


def checksum(blobs: list[bytes]) -> int:
    """CRC-32 of BLOBs one after the other."""
    checksum = 0
    for blob in blobs:
        checksum = zlib.crc32(blob, checksum)
    return checksum


def write_records(container: Container, records: ModelRecords) -> None:
    """Write the tables of the records into a model's container."""

    def rows() -> Iterator[tuple[Any, ...]]:
        for fid, (track, t) in enumerate(records.tracks.items(), 1):
            up = t.up if t.up is not None and t.height is not None else None
            arrays = [
                t.easting, t.northing, t.height if up else None, t.across.rows, t.across.lean, t.across.noise,
                *((up.rows, up.lean, up.noise) if up else (None,) * 3),
            ]  # fmt: skip
            blobs = [b"" if a is None else np.ascontiguousarray(a, "<f8").tobytes() for a in arrays]
            yield (fid, track, len(t.easting), float(t.step), checksum(blobs), *blobs)

    container.add_table(
        RECORDS,
        "track TEXT NOT NULL UNIQUE, nodes INTEGER NOT NULL, step_m DOUBLE NOT NULL, crc32 INTEGER NOT NULL, "
        + ", ".join(f"{name} BLOB NOT NULL" for name in RECORD_COLUMNS),
        rows(),
        description="Square-root records of the surveys, so that later runs refine the model: little-endian float64",
    )
    known = [("across", records.across), *([("up", records.up)] if records.up is not None else [])]
    container.add_table(
        BORDERS,
        "coordinate TEXT NOT NULL UNIQUE, who TEXT NOT NULL, crc32 INTEGER NOT NULL, rows BLOB NOT NULL, value BLOB NOT NULL",
        [
            (
                fid,
                name,
                json.dumps({"tracks": b.tracks, "receivers": b.receivers}, ensure_ascii=False),
                checksum(blobs := [np.ascontiguousarray(v, "<f8").tobytes() for v in (b.rows, b.value)]),
                *blobs,
            )
            for fid, (name, b) in enumerate(known, 1)
        ],
        description="What is known of the frame offsets of tracks and receivers",
    )
    container.add_table(
        "record_facts",
        "key TEXT NOT NULL UNIQUE, value TEXT NOT NULL",
        [
            (1, "receivers", json.dumps(records.receivers, allow_nan=False, ensure_ascii=False)),
            (2, "runs", json.dumps(records.runs, allow_nan=False, ensure_ascii=False)),
            (3, "joins", json.dumps(records.joins, allow_nan=False, ensure_ascii=False)),
            (4, "parts", json.dumps(records.parts, allow_nan=False, ensure_ascii=False)),
        ],
        description="Receivers and runs behind the records, and where their tracks join: keys and JSON values",
    )


def record_source(reader: Reader, path: str | Path) -> RecordSource | None:
    """Read the records when they are asked for; None where the file has none."""
    if RECORDS not in reader.tables():
        return None
    place = Path(path).resolve()
    stamp = _stamp(place)

    def source() -> ModelRecords:
        if _stamp(place) != stamp:
            raise ModelError("has changed since the model was read from it", file=path, remedy="read the model again")
        return read_records(place)

    return source


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def read_records(path: str | Path) -> ModelRecords:
    """Read the square-root records of the surveys behind a stored model.

    Parameters
    ----------
    path : path
        A GeoPackage that `write_model` wrote.

    Returns
    -------
    ModelRecords

    Raises
    ------
    ModelError
        There are none, or they are damaged.

    Examples
    --------
    >>> read_records("nowhere.gpkg")
    Traceback (most recent call last):
    railnav.errors.ModelError: nowhere.gpkg: does not exist; check the name
    """
    with opened(path, CONTENT, newest=SCHEMA_VERSION, error=ModelError) as reader:
        tables = reader.tables()
        if not {RECORDS, BORDERS, "record_facts"} <= tables:
            reader.refuse(
                "holds no survey records", remedy="build the model from its runs with this version of railnav"
            )
        try:
            facts = {key: json.loads(value) for key, value in reader.select("record_facts", ("key", "value"))}
            borders = {
                name: _read_borders(reader, name, json.loads(who), crc, rows, value)
                for name, who, crc, rows, value in reader.select(
                    BORDERS, ("coordinate", "who", "crc32", "rows", "value")
                )
            }
            tracks = {
                track: _read_track_records(reader, fid, track, nodes, step, crc)
                for track, nodes, step, crc, fid in reader.select(RECORDS, ("track", "nodes", "step_m", "crc32", "fid"))
            }
            return ModelRecords(
                tracks=tracks,
                across=borders["across"],
                up=borders.get("up"),
                receivers=dict(facts["receivers"]),
                runs=tuple(facts["runs"]),
                joins=tuple(dict(join) for join in facts.get("joins", [])),
                parts={str(name): [str(part) for part in of] for name, of in facts.get("parts", {}).items()},
            )
        except InputError:
            raise
        except (KeyError, TypeError, ValueError, RecursionError, RailnavError) as error:
            reader.refuse(f"its survey records are damaged ({error})", layer=RECORDS, remedy="build the model again")


def _read_borders(reader: Reader, name: str, who: Any, crc: Any, rows: Any, value: Any) -> Borders:
    if not (isinstance(rows, bytes) and isinstance(value, bytes)) or checksum([rows, value]) != crc:
        reader.refuse(f"the frame offsets {name!r:.20} are damaged (checksum differs)", layer=BORDERS)
    size = (len(who["tracks"]) + len(who["receivers"])) * (2 if name == "across" else 1)
    return Borders(
        tuple(who["tracks"]),
        tuple(who["receivers"]),
        np.frombuffer(rows, "<f8").reshape(size, size),
        np.frombuffer(value, "<f8").reshape(size),
    )


def _read_track_records(reader: Reader, fid: int, track: str, nodes: Any, step: Any, crc: Any) -> TrackRecords:
    blobs = dict(reader.blobs(RECORDS, RECORD_COLUMNS, fid))
    sound = all(isinstance(blob, bytes) for blob in blobs.values())
    if not sound or type(nodes) is not int or nodes < 3 or checksum(list(blobs.values())) != crc:
        reader.refuse(f"the records of track {track!r:.40} are damaged (checksum differs)", layer=RECORDS)
    N = int(nodes)
    if not isinstance(step, float) or not 0 < step < np.inf:
        reader.refuse(f"the nodes of track {track!r:.40} lie {step!r:.20} m apart", layer=RECORDS)

    def of(name: str, *shape: int) -> FloatArray:
        return np.frombuffer(blobs[name], "<f8").reshape(shape)

    def axis(name: str, borders: int) -> AxisRecords:
        return AxisRecords(of(name, N, ROW_SIZE), of(f"{name}_lean", N, 3, borders), of(f"{name}_noise", N - 1))

    high = bool(blobs["height"])
    return TrackRecords(
        step=float(step),
        easting=of("easting", N),
        northing=of("northing", N),
        height=of("height", N) if high else None,
        across=axis("across", 2),
        up=axis("up", 1) if high else None,
    )
