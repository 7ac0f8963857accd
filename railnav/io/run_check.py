"""Every defect of a run folder at once: each stream and each column is judged on its own, where reading stops at the first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError, RailnavError, RunError
from railnav.io.gnss_log import LogSummary, read_log
from railnav.io.run import read_run
from railnav.io.run_contents import CONTENTS, FORMATS, STREAMS, read_contents, start_of, stream_file
from railnav.io.run_streams import STREAM_COLUMNS
from railnav.io.tables import Column, Table, read_table

#: What is found: kind, where, what.
Finding = tuple[str, str, str]
#: So many rows are named, the others counted.
_NAMED = 3


def run_defects(folder: str | Path) -> tuple[list[Finding], list[Finding]]:
    """Judge a run folder.

    Parameters
    ----------
    folder : path
        With run.toml.

    Returns
    -------
    defects, remarks : list of (kind, where, what)
        What would have the run refused, every one; and what was left out or put right of a receiver's log. Kinds are "run" and the
        streams' names.

    Examples
    --------
    >>> defects, _ = run_defects("nowhere")
    >>> defects[0][2]
    'does not exist; a run is a folder that holds run.toml'
    """
    folder = Path(folder)
    defects: list[Finding] = []
    remarks: list[Finding] = []
    try:
        contents = read_contents(folder)
        start = start_of(contents.run.start, folder / CONTENTS)
    except InputError as error:
        return [_finding("run", error)], []
    for name in STREAMS:
        stream = getattr(contents, name)
        if stream is None:
            continue
        try:
            path = stream_file(folder, name, stream)
            if stream.format in FORMATS:
                defects += [_finding(name, error) for error in _table_defects(path, STREAM_COLUMNS[name])]
            elif name != "gnss":
                from railnav.io.ubx_sensors import sensor_table

                defects += [
                    _finding(name, error) for error in _judge(sensor_table(path, name, start), STREAM_COLUMNS[name])
                ]
            else:
                log = read_log(path, stream.format, start=start)
                defects += [_finding(name, error) for error in _judge(log.table, STREAM_COLUMNS[name])]
                remarks += _log_remarks(name, log.summary)
        except InputError as error:
            defects.append(_finding(name, error))
    try:
        read_run(folder)
    except InputError as error:  # what only shows when all is read: a frame, an odometer that falls, a calibration
        if not any(_names(found, error) for found in defects):
            defects.append(_finding("run", error))
    except RailnavError as error:
        defects.append(("run", str(folder), str(error)))
    return defects, remarks


def log_defects(path: str | Path) -> tuple[list[Finding], list[Finding]]:
    """Judge a log that stands alone: what would have it refused, and what was left out or put right."""
    from railnav.io.logs import read_bare_log

    summaries: list[LogSummary] = []
    try:
        _, notes = read_bare_log(path, report=summaries.append)
    except InputError as error:
        return [_finding("log", error)], []
    remarks = [finding for summary in summaries for finding in _log_remarks("log", summary)]
    said = {what for _, _, what in remarks}
    return [], remarks + [("log", str(path), note) for note in notes if note not in said]


def _finding(kind: str, error: InputError) -> Finding:
    where = ", ".join([str(error.file), *([f"row {error.row}"] if error.row else [])])
    where += f", column {error.column}" if error.column else ""
    return kind, where, f"{error.cause}; {error.remedy}" if error.remedy else error.cause


def _names(found: Finding, error: InputError) -> bool:
    """Whether an error is one that is listed: of the same column, or of the same file as a whole."""
    where = _finding("run", error)[1]
    return found[1] == where or (
        str(error.file) in found[1] and (not error.column or f"column {error.column}" in found[1])
    )


def _log_remarks(name: str, summary: LogSummary) -> list[Finding]:
    where, place = str(summary.file), "byte" if summary.format == "ubx" else "row"
    found = [(name, where, note) for note in summary.notes]
    for count, what in (
        (summary.broken, f"broken {summary.unit} left out (the first at {place} {summary.first_broken})"),
        (summary.void, "instants without a fix left out"),
        (summary.duplicates, "second fixes at one instant left out"),
    ):
        if count:
            found.append((name, where, f"{count} {what}"))
    return found


def _table_defects(path: Path, columns: tuple[Column, ...]) -> Iterator[InputError]:
    """Column by column, so that one that cannot be read does not hide the others."""
    try:
        whole = read_table(path, [_lax(column) for column in columns], error=RunError)
    except InputError as error:
        first = error
    else:
        yield from _judge(whole, columns)
        return
    if not first.column:  # the file as a whole
        yield first
        return
    told = False
    for column in columns:
        try:
            table = read_table(path, [_lax(column)], error=RunError)
        except InputError as error:
            told = True
            yield error
        else:
            yield from _judge(table, (column,))
    if not told:
        yield first


def _lax(column: Column) -> Column:
    """The column without its limits: they are judged here, all rows at once."""
    if column.text:
        return replace(column, complete=False)
    return replace(column, complete=False, infinite=True, low=-np.inf, high=np.inf, positive=False)


def _judge(table: Table, columns: tuple[Column, ...]) -> Iterator[RunError]:
    for column in columns:
        if column.text:
            words = table.words.get(column.name)
            if words is not None and column.complete and (words.code < 0).any():
                yield _told(table, column, words.code < 0, "empty", "")
            continue
        values = table.number.get(column.name)
        if values is None:
            continue
        missing = np.isnan(values)
        infinite = np.isinf(values)
        if column.complete and missing.any():
            yield _told(table, column, missing, "empty or not a number", column.remedy)
        if not column.infinite and infinite.any():
            yield _told(table, column, infinite, "infinite", "")
        outside = ~missing & ~infinite & ((values < column.low) | (values > column.high))
        if outside.any():
            yield _told(
                table, column, outside, f"outside {column.low:g} to {column.high:g}", "correct them or their unit"
            )
        if column.positive and (values <= 0).any():
            yield _told(table, column, values <= 0, "not positive", "leave cells empty where nothing is known")
        if column.name == "time_s":
            step = np.diff(values)
            for wrong, what, remedy in (
                (step == 0.0, "at the instant of the row before", "keep one of them"),
                (step < 0.0, "before the row above: time runs backwards", "sort the rows"),
            ):
                if wrong.any():
                    yield _told(table, column, np.append(False, wrong), what, remedy)


def _told(table: Table, column: Column, wrong: NDArray[Any], what: str, remedy: str) -> RunError:
    rows = np.flatnonzero(wrong)
    named = ", ".join(str(table.row_of(int(row))) for row in rows[:_NAMED]) + (", ..." if len(rows) > _NAMED else "")
    count = f"{len(rows)} cells are" if len(rows) > 1 else "is"
    where = f" (rows {named})" if len(rows) > 1 else ""
    return RunError(
        f"{count} {what}{where}",
        file=table.file,
        row=table.row_of(int(rows[0])),
        column=column.name,
        remedy=remedy or None,
    )
