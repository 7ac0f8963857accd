"""GNSS logs onto the run's clock: the reader of each format, one row an instant, the summary of what was left out.

A log is a receiver's own file. Unlike a table, it may be damaged in places: what a checksum or its syntax condemns is counted,
left out and said in the `LogSummary`; where too much is damaged, or nothing is left, the log is refused.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RunError
from railnav.io import gnss_time
from railnav.io.log_reading import NO_DATE, Found
from railnav.io.tables import Table, _check_file, freeze

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Formats of GNSS logs, as run.toml names them.
LOG_FORMATS = ("nmea", "rtklib-pos", "ubx", "gpx", "gpsd")
#: A log with more than one broken row, and a larger share of them, is refused.
MAX_BROKEN_SHARE = 0.1
#: Fixes handed on at a time where a log is streamed.
PART = 1 << 17

_logger = logging.getLogger("railnav.io")


@dataclass(frozen=True, slots=True)
class LogSummary:
    """What a log held, and what of it was left out.

    Attributes
    ----------
    file : path
        The log.
    format : str
        As run.toml names it.
    unit : str
        What is counted: sentences, rows, messages or points.
    fixes : int
        Instants with a position: the rows of the stream.
    good : int
        Sentences, rows, messages or points that were read, those included that carry nothing used here.
    broken : int
        Those left out because their checksum or their syntax is wrong.
    first_broken : int or None
        Where the first of them is: row as an editor counts it, byte offset in a binary file.
    void : int
        Instants at which the receiver says that it has no fix; left out.
    duplicates : int
        Second fixes at one instant; the better was kept.
    counts : mapping of str to int
        How many of each kind.
    notes : tuple of str
        What else a user should know, one sentence each.
    """

    file: Path
    format: str
    unit: str
    fixes: int
    good: int
    broken: int = 0
    first_broken: int | None = None
    void: int = 0
    duplicates: int = 0
    counts: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def suspicious(self) -> bool:
        """Whether something was damaged, doubtful or put right."""
        return bool(self.broken or self.notes)

    def __str__(self) -> str:
        parts = [f"{self.fixes} fixes from {self.good} {self.unit}"]
        if self.broken:
            where = "byte" if self.format == "ubx" else "row"
            parts.append(f"{self.broken} broken {self.unit} left out (the first at {where} {self.first_broken})")
        if self.void:
            parts.append(f"{self.void} instants without a fix left out")
        if self.duplicates:
            parts.append(f"{self.duplicates} second fixes at one instant left out")
        return f"{self.file}: {'; '.join([*parts, *self.notes])}"


@dataclass(frozen=True, slots=True, eq=False)
class GnssLog:
    """A log on the run's clock.

    Attributes
    ----------
    table : Table
        `time_s` and the columns of the `gnss` stream that the log carries, one row an instant; NaN where it says nothing.
    summary : LogSummary
        What was left out.
    """

    table: Table
    summary: LogSummary


def read_log(path: str | Path, format: str, *, start: datetime) -> GnssLog:  # noqa: A002 - the key in run.toml
    """Read a GNSS log onto the run's clock.

    Parameters
    ----------
    path : path
        The log.
    format : str
        "nmea", "rtklib-pos", "ubx", "gpx" or "gpsd".
    start : datetime
        Start of the run, with its time zone; times count from here.

    Returns
    -------
    GnssLog
        The stream's columns and the summary of what was left out.

    Raises
    ------
    RunError
        The file is missing or holds no fix; more than a tenth of it is broken; time runs backwards; its first fix is more than
        7 days from `start`.

    Notes
    -----
    The log is read in blocks of 2 MB: memory grows with the fixes kept, about 170 bytes each, not with the file. A log that is
    displaced by whole roll-overs of 1,024 GPS weeks (a receiver with old firmware) is put right when it then starts within a
    day of `start`, and a note says so. Summaries that are not clean are also logged as a warning to "railnav.io".

    Examples
    --------
    >>> import tempfile
    >>> from datetime import UTC
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "a.nmea").write_text(
    ...         "$GPGGA,172814.0,3723.46587704,N,12202.26957864,W,2,6,1.2,18.893,M,-25.669,M,2.0,0031*4F")
    ...     log = read_log(f"{folder}/a.nmea", "nmea", start=datetime(2026, 5, 4, 17, 28, tzinfo=UTC))
    >>> log.table.number["time_s"].tolist(), log.table.number["height_m"].round(3).tolist()
    ([14.0], [-6.776])
    """
    path = Path(path)
    _check_file(path, RunError)
    scan = _reader(path, format)
    origin = gnss_time.nanoseconds(start)
    try:
        found = scan(path, origin)
    except OSError as error:
        raise RunError(f"cannot be read ({error.strerror or error})", file=path) from error
    log = settle(found, origin)
    if log.summary.suspicious:
        _logger.warning("%s", log.summary)
    return log


def stream_log(
    path: str | Path,
    format: str,  # noqa: A002 - the key in run.toml
    take: Callable[[IntArray, Mapping[str, FloatArray]], None],
    *,
    start: datetime | None = None,
    part: int = PART,
) -> LogSummary:
    """Read a GNSS log piece by piece: memory does not grow with the log.

    Parameters
    ----------
    path : path
        The log.
    format : str
        "nmea", "rtklib-pos", "ubx", "gpx" or "gpsd".
    take : callable
        Called with every piece: stamps, ns since 1970 UTC, strictly growing also from piece to piece, and the columns that the piece
        carries, in the units of the table of formats.
    start : datetime, optional
        When the run starts, with its time zone: gives the day where the log states none, and puts roll-overs of GPS weeks right.
        Without it, the log must state its dates.
    part : int
        Fixes a piece.

    Returns
    -------
    LogSummary
        What was read and left out, as `read_log` gives it.

    Raises
    ------
    RunError
        As for `read_log`; pieces may have been taken by then.

    Notes
    -----
    A peak of some 150 MB whatever the size of the log (`benchmarks/logs.py --stream`). Of two fixes at one instant that stand in different
    pieces the first is kept.
    """
    path = Path(path)
    _check_file(path, RunError)
    scan = _reader(path, format)
    relay = _Relay(take, None if start is None else gnss_time.nanoseconds(start))
    origin = gnss_time.nanoseconds(start) if start is not None else 0
    try:
        found = scan(path, origin, sink=relay, part=part)
    except OSError as error:
        raise RunError(f"cannot be read ({error.strerror or error})", file=path) from error
    relay(found)
    _check_broken(found)
    if not relay.fixes:
        raise _no_fix(found)
    notes = [*relay.notes, *found.notes]
    summary = _summary(found, relay.fixes, relay.duplicates, tuple(dict.fromkeys(notes)))
    if summary.suspicious:
        _logger.warning("%s", summary)
    return summary


class _Relay:
    """Hands pieces on in order, on UTC, one row an instant."""

    def __init__(self, take: Callable[[IntArray, Mapping[str, FloatArray]], None], start: int | None) -> None:
        self.take, self.start = take, start
        self.shift: int | None = None
        self.last: int | None = None
        self.fixes = self.duplicates = 0
        self.notes: list[str] = []

    def __call__(self, found: Found) -> None:
        stamp = found.stamp
        if not len(stamp):
            return
        if self.start is None and any(NO_DATE in note for note in found.notes):
            raise RunError(NO_DATE, file=found.file, remedy="say when the log starts, with --start")
        if self.shift is None:
            self.shift = gnss_time.roll_overs(int(stamp[0]), self.start) if self.start is not None else 0
            if self.shift:
                before = gnss_time.calendar(int(stamp[0]))
                self.notes.append(_moved(before, self.shift))
        stamp = stamp + self.shift * gnss_time.ROLL_OVER
        if found.gps_time:
            stamp = gnss_time.gps_to_utc(stamp)
        if self.last is None and self.start is not None and abs(int(stamp[0]) - self.start) > gnss_time.MAX_FROM_START:
            cause = (
                f"the first fix is of {gnss_time.calendar(int(stamp[0]))}, the run starts at "
                f"{gnss_time.calendar(self.start)}"
            )
            raise RunError(cause, file=found.file, row=_row(found, 0), remedy="correct the start")
        joined = stamp if self.last is None else np.append(self.last, stamp)
        back = np.flatnonzero(joined[1:] < joined[:-1])
        if len(back):
            index = int(back[0]) + 1
            before, now = (gnss_time.calendar(int(joined[i])) for i in (index - 1, index))
            row = _row(found, index - (len(joined) - len(stamp)))
            cause = f"time runs backwards ({now} after {before})"
            raise RunError(cause, file=found.file, row=row, remedy="split the log where the clock was set back")
        keep = _best(stamp, found.better) if (stamp[1:] == stamp[:-1]).any() else np.arange(len(stamp))
        if self.last is not None:
            keep = keep[stamp[keep] > self.last]
        self.duplicates += len(stamp) - len(keep)
        if not len(keep):
            return
        self.last = int(stamp[keep[-1]])
        self.fixes += len(keep)
        columns = {name: values[keep] for name, values in found.number.items() if not np.isnan(values).all()}
        self.take(stamp[keep], columns)


def _moved(before: str, shift: int) -> str:
    return f"its dates ({before}) are displaced by a GPS week roll-over and were moved by {shift * 1024:+d} weeks"


def _reader(path: Path, format: str) -> Callable[..., Found]:  # noqa: A002
    """Choose the reader; numba is not loaded for the others."""
    if format == "nmea":
        from railnav.io.nmea import scan
    elif format == "rtklib-pos":
        from railnav.io.rtklib import scan
    elif format == "ubx":
        from railnav.io.ubx import scan
    elif format == "gpx":
        from railnav.io.gpx import scan
    elif format == "gpsd":
        from railnav.io.gpsd import scan
    else:
        raise RunError(f"{format[:40]!r} is no format of GNSS logs; {', '.join(LOG_FORMATS)} are", file=path)
    return scan


def _check_broken(found: Found) -> None:
    """Refuse a log that is damaged in more than places."""
    where = f"the first at {'byte' if found.format == 'ubx' else 'row'} {found.first_broken}"
    if found.broken > max(1.0, MAX_BROKEN_SHARE * (found.good + found.broken)):  # the last may be torn
        cause = f"{found.broken} of {found.good + found.broken} {found.unit} are broken ({where})"
        remedy = (
            "copy the log again from the receiver" if found.good else f"is this a log in the format {found.format}?"
        )
        raise RunError(cause, file=found.file, remedy=remedy)


def _no_fix(found: Found) -> RunError:
    held = ", ".join(f"{count} {kind}" for kind, count in found.counts.items() if count) or f"no {found.unit}"
    cause = f"holds no fix ({found.void} instants without one; {held})"
    return RunError(cause, file=found.file, remedy="leave the stream out, or name the right format")


def _summary(found: Found, fixes: int, duplicates: int, notes: tuple[str, ...]) -> LogSummary:
    return LogSummary(
        file=found.file,
        format=found.format,
        unit=found.unit,
        fixes=fixes,
        good=found.good,
        broken=found.broken,
        first_broken=found.first_broken,
        void=found.void,
        duplicates=found.duplicates + duplicates,
        counts={kind: count for kind, count in found.counts.items() if count},
        notes=notes,
    )


def settle(found: Found, start: int) -> GnssLog:
    """Put what a reader found on the run's clock (`start` in ns since 1970), one row an instant, or refuse it."""
    file = found.file
    _check_broken(found)
    if not len(found.stamp):
        raise _no_fix(found)
    stamp = found.stamp
    shift = gnss_time.roll_overs(int(stamp[0]), start)
    if shift:
        before = gnss_time.calendar(int(stamp[0]))
        stamp = stamp + shift * gnss_time.ROLL_OVER
        found.notes.append(_moved(before, shift))
    if found.gps_time:
        stamp = gnss_time.gps_to_utc(stamp)
    if abs(int(stamp[0]) - start) > gnss_time.MAX_FROM_START:
        cause = (
            f"the first fix is of {gnss_time.calendar(int(stamp[0]))}, the run starts at {gnss_time.calendar(start)}"
        )
        raise RunError(cause, file=file, row=_row(found, 0), remedy="correct run.start, or look for a log of this run")
    back = np.flatnonzero(stamp[1:] < stamp[:-1])
    if len(back):
        index = int(back[0]) + 1
        before, now = (gnss_time.calendar(int(stamp[i])) for i in (index - 1, index))
        cause = f"time runs backwards ({now} after {before})"
        raise RunError(cause, file=file, row=_row(found, index), remedy="split the log where the clock was set back")
    keep = _best(stamp, found.better) if (stamp[1:] == stamp[:-1]).any() else None
    number: dict[str, FloatArray] = {}
    for name in list(found.number):
        values = found.number.pop(name)
        if not np.isnan(values).all():
            number[name] = freeze(values if keep is None else values[keep])
    duplicates, row = 0, found.row
    if keep is not None:
        duplicates = len(stamp) - len(keep)
        stamp, row = stamp[keep], row[keep]
    number = {"time_s": freeze((stamp - start) / gnss_time.SECOND)} | number
    summary = _summary(found, len(stamp), duplicates, tuple(found.notes))
    return GnssLog(Table(file, len(stamp), number, error=RunError, row_of=lambda index: int(row[index])), summary)


def _row(found: Found, index: int) -> int | None:
    return None if found.format == "ubx" else int(found.row[index])


def _best(stamp: IntArray, better: Callable[[], FloatArray]) -> IntArray:
    """Indices of one row an instant: the best, the first of equals. Stamps do not fall."""
    group = np.cumsum(np.concatenate([[True], stamp[1:] > stamp[:-1]]))
    order = np.lexsort((np.arange(len(stamp)), -better(), group))
    first = np.concatenate([[True], group[order][1:] != group[order][:-1]])
    return np.asarray(order[first], dtype=np.int64)
