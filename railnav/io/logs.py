"""Bare logs: told by their first bytes, read as a run, turned into other logs piece by piece.

`read_run` reads a log that a run folder names; here a log stands alone and its own first fix is the start of the run, unless that is
stated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RunError
from railnav.io import gnss_time
from railnav.io.atomic import atomic_folder, atomic_path
from railnav.io.gnss_log import LogSummary, read_log, stream_log
from railnav.io.run import read_run, write_run
from railnav.io.run_contents import CONTENTS, STREAMS, GnssEntry
from railnav.io.run_streams import STREAM_COLUMNS, gnss_stream, stream_columns
from railnav.io.tables import check_table
from railnav.run import Run

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Endings by which a log goes, and its format.
ENDINGS = {
    ".nmea": "nmea", ".nma": "nmea", ".ubx": "ubx", ".pos": "rtklib-pos", ".gpx": "gpx", ".gpsd": "gpsd",
    ".bag": "bag", ".mcap": "bag", ".db3": "bag",
}  # fmt: skip
#: And those that say nothing: the first bytes tell.
_TOLD = (".log", ".txt", ".jsonl", ".dat", ".raw", "")
_HEAD = 1 << 16
#: A log is written to its file within this of its first fix, as a rule, ns.
_NEAR_WRITTEN = 10 * gnss_time.DAY


def log_format(path: str | Path) -> str | None:
    """Format of a log by its ending and its first bytes; None where it is none.

    Examples
    --------
    >>> log_format("drive.ubx"), log_format("solution.csv")
    ('ubx', None)
    """
    path = Path(path)
    known = ENDINGS.get(path.suffix.lower())
    if known is not None:
        return known
    if path.is_dir():
        return "bag" if (path / "metadata.yaml").is_file() else None
    if path.suffix.lower() not in _TOLD or not path.is_file():
        return None
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if head.startswith((b"#ROSBAG", b"\x89MCAP")):
        return "bag"
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if text.startswith(b'{"class"'):
        return "gpsd"
    if text.startswith(b"%") and (b"latitude(deg)" in head or b"program" in text[:40]):
        return "rtklib-pos"
    if text.startswith(b"<") and b"<gpx" in head:
        return "gpx"
    if b"\xb5\x62" in head:
        return "ubx"
    return "nmea" if b"$G" in head else None


def read_bare_log(
    path: str | Path,
    *,
    format: str | None = None,  # noqa: A002 - the key in run.toml
    start: datetime | None = None,
    topics: Iterable[str] = (),
    report: Callable[[LogSummary], None] | None = None,
) -> tuple[Run, tuple[str, ...]]:
    """Read a log that stands alone as a run.

    Parameters
    ----------
    path : path
        NMEA, UBX, RTKLIB .pos, GPX, gpsd JSON, a ROS recording.
    format : str, optional
        "nmea", "ubx", "rtklib-pos", "gpx", "gpsd" or "bag"; by default told by ending and first bytes.
    start : datetime, optional
        Start of the run, with its time zone; by default the whole second of the first fix. Needed where the log states no date, and
        what tells a roll-over of GPS weeks.
    topics : iterable of str, optional
        Topics of a ROS recording.
    report : callable, optional
        Called with the summary of a GNSS log.

    Returns
    -------
    Run, notes
        The run (fixes; inertial samples and speed where the log has them), and what a user should know.

    Raises
    ------
    RunError
        The log is of no known format or is refused by its reader.

    Examples
    --------
    >>> read_bare_log("nowhere.nmea")
    Traceback (most recent call last):
    railnav.errors.RunError: nowhere.nmea: does not exist; check the name
    """
    path = Path(path)
    kind = _format(path, format)
    if kind == "bag":
        from railnav.io.bags import read_bag

        return read_bag(path, topics=topics, start=start)
    begin = start or first_instant(path, kind)
    log = read_log(path, kind, start=begin)
    check_table(log.table, STREAM_COLUMNS["gnss"])
    if report is not None:
        report(log.summary)
    run = Run(
        path.stem,
        begin,
        gnss=gnss_stream(log.table, log.table.increasing("time_s"), GnssEntry(path.name), begin, path),
        source=path,
    )
    notes = (*log.summary.notes, *(_displaced(path, begin) if start is None else ()))
    if kind == "ubx" and any(name in log.summary.counts for name in ("ESF-RAW", "ESF-MEAS")):
        from railnav.io.ubx_sensors import read_sensors

        found = read_sensors(path, begin)
        notes = (*notes, *found.notes)
        run = replace(run, imu=found.imu, odometer=found.odometer)
    return run, notes


def _format(path: Path, stated: str | None) -> str:
    if not path.exists():
        raise RunError("does not exist", file=path, remedy="check the name")
    kind = stated or log_format(path)
    if kind is None:
        raise RunError("is a log of no known format", file=path, remedy="name it with --format")
    return kind


class _Enough(Exception):  # noqa: N818 - no error: the first piece is there
    pass


def first_instant(path: str | Path, format: str) -> datetime:  # noqa: A002
    """The whole second of a log's first fix, UTC."""
    first: list[int] = []

    def take(stamp: IntArray, columns: Mapping[str, FloatArray]) -> None:  # noqa: ARG001
        first.append(int(stamp[0]))
        raise _Enough

    with suppress(_Enough):
        stream_log(path, format, take, part=1 << 14)
    second = first[0] // gnss_time.SECOND
    try:
        return datetime.fromtimestamp(second, UTC)
    except (OverflowError, OSError, ValueError) as error:
        raise RunError(f"its first fix is of {second} s since 1970", file=path, remedy="say --start") from error


def _displaced(path: Path, begin: datetime) -> tuple[str, ...]:
    """A doubt, where the log's dates lie whole roll-overs of GPS weeks before the day on which its file was last written."""
    written = int(path.stat().st_mtime) * gnss_time.SECOND
    behind = written - gnss_time.nanoseconds(begin)
    count = round(behind / gnss_time.ROLL_OVER)
    if count < 1 or abs(behind - count * gnss_time.ROLL_OVER) > _NEAR_WRITTEN:
        return ()
    weeks = count * 1024
    return (
        f"its dates lie {weeks} weeks before the file was written: a roll-over of GPS weeks? say --start to put it right",
    )


def convert_log(
    source: str | Path,
    output: str | Path,
    *,
    format: str | None = None,  # noqa: A002
    start: datetime | None = None,
    topics: Iterable[str] = (),
) -> tuple[int, tuple[str, ...]]:
    """Turn a run folder or a log into another log, or into a run folder.

    Parameters
    ----------
    source : path
        A run folder, or a log as for `read_bare_log`.
    output : path
        By its ending .nmea, .pos, .gpx, .csv or .parquet (the fixes), .kml; without an ending, a run folder with all streams.
    format, start, topics
        As for `read_bare_log`.

    Returns
    -------
    fixes, notes
        How many fixes were written, and what a user should know.

    Raises
    ------
    RunError
        The source is refused, or has no fixes to write.
    InputError
        The output cannot be written.

    Notes
    -----
    GNSS logs become .nmea, .pos, .gpx, .csv and run folders piece by piece, in memory that does not grow with the log; .parquet and .kml,
    inertial data and ROS recordings are held as a whole.
    """
    source, output = Path(source), Path(output)
    ending = output.suffix.lower()
    if source.is_dir() and (source / CONTENTS).is_file():
        return _convert_run(read_run(source), output, scale=_scale_of(source))
    kind = _format(source, format)
    inertial = kind == "bag" or (kind == "ubx" and not ending and _has_sensors(source))
    if ending in (".parquet", ".kml") or inertial:
        run, notes = read_bare_log(source, format=kind, start=start, topics=topics)
        count, more = _convert_run(run, output, scale=kind)
        return count, (*notes, *more)
    begin = start or first_instant(source, kind)
    if not ending:
        with atomic_folder(output, replaceable=_written()) as draft:
            count, notes = _pieces(source, kind, start, begin, Path("gnss.csv"), draft / "gnss.csv")
            head = Run(source.stem, begin)
            (draft / CONTENTS).write_text(
                _head(head) + '\n[gnss]\nfile = "gnss.csv"\nformat = "csv"\nframe = "WGS84"\n'
            )
        return count, notes
    with atomic_path(output) as draft:
        return _pieces(source, kind, start, begin, output, draft)


def _written() -> list[str]:
    return [CONTENTS, "truth.csv", *(f"{name}.csv" for name in STREAMS)]


def _head(run: Run) -> str:
    from railnav.io.run_contents import quoted

    start = run.start.astimezone(UTC).isoformat().replace("+00:00", "Z")
    return f"[run]\nid = {quoted(run.id)}\nstart = {quoted(start)}\n"


def _pieces(
    source: Path, kind: str, start: datetime | None, begin: datetime, output: Path, draft: Path
) -> tuple[int, tuple[str, ...]]:
    from railnav.io.log_writers import to_gga, writer_for

    writer = writer_for(output, draft, gnss_time.nanoseconds(begin))

    def take(stamp: IntArray, columns: Mapping[str, FloatArray]) -> None:
        if kind == "rtklib-pos" and "quality" in columns:
            columns = {**columns, "quality": to_gga(columns["quality"])}
        writer.add(stamp, columns)

    try:
        summary = stream_log(source, kind, take, start=start)
    finally:
        writer.close()
    if not writer.fixes:
        raise RunError("has no fix that this format can hold", file=source, remedy="write .nmea, .gpx or .csv")
    said = [*summary.notes, *writer.notes, *(_displaced(source, begin) if start is None else ())]
    if summary.broken:
        said.insert(0, f"{summary.broken} broken {summary.unit} left out (the first at {summary.first_broken})")
    return writer.fixes, tuple(said)


def _scale_of(folder: Path) -> str:
    """Format of the fixes of a run folder: it says on which scale their quality is."""
    from railnav.io.run_contents import read_contents

    contents = read_contents(folder)
    return contents.gnss.format if contents.gnss is not None else "csv"


def _has_sensors(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(1 << 22)
    return b"\xb5\x62\x10\x03" in head or b"\xb5\x62\x10\x02" in head


def _convert_run(run: Run, output: Path, *, scale: str) -> tuple[int, tuple[str, ...]]:
    """A run that is in memory: all its streams as a folder, or its fixes as a log."""
    ending = output.suffix.lower()
    count = 0 if run.gnss is None else len(run.gnss)
    if not ending:
        write_run(run, output)
        return count, ()
    if ending == ".kml":
        from railnav.io.kml import write_run_kml

        write_run_kml(run, output)
        return count, ()
    if run.gnss is None or not count:
        raise RunError("the run has no GNSS fixes to write", file=run.source)
    columns = stream_columns(run, "gnss")
    if scale == "rtklib-pos" and isinstance(columns.get("quality"), np.ndarray):
        from railnav.io.log_writers import to_gga

        columns["quality"] = to_gga(np.asarray(columns["quality"]))
    with atomic_path(output) as draft:
        if ending == ".parquet":
            from railnav.io.tables import write_table

            write_table(draft, columns, decimals={})
            return count, ()
        from railnav.io.log_writers import writer_for

        begin = gnss_time.nanoseconds(run.start)
        writer = writer_for(output, draft, begin)
        stamp = begin + np.round(run.gnss.time * 1e9).astype(np.int64)
        try:
            writer.add(stamp, {name: np.asarray(v) for name, v in columns.items() if name != "time_s"})
        finally:
            writer.close()
        if not writer.fixes:
            raise RunError("has no fix that this format can hold", file=run.source, remedy="write .nmea, .gpx or .csv")
    return writer.fixes, tuple(writer.notes)
