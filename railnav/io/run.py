"""Run folders: `run.toml` and the streams it names, read into a Run and written from one.

Units are turned into SI and radians here, and nowhere else. What a stream's columns mean stands in the table of formats in
`docs/`; every refusal names the file, the row as an editor counts it, the column, and a way out.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RunError
from railnav.io.atomic import atomic_folder
from railnav.io.gnss_log import LogSummary, read_log
from railnav.io.run_contents import (
    CONTENTS,
    FORMATS,
    STREAMS,
    ImuEntry,
    StreamEntry,
    contents_text,
    read_contents,
    start_of,
    stream_file,
)
from railnav.io.run_streams import (
    DECIMALS,
    STREAM_COLUMNS,
    balise_stream,
    gauge_stream,
    gnss_stream,
    gyro_angles_stream,
    imu_stream,
    odometer_stream,
    stamps,
    stream_columns,
)
from railnav.io.tables import Table, check_table, read_table, write_table
from railnav.run import ImuStream, Run

if TYPE_CHECKING:
    from railnav.truth import Truth

FloatArray = NDArray[np.float64]


def read_run(folder: str | Path, *, report: Callable[[LogSummary], None] | None = None) -> Run:
    r"""Read a run folder: `run.toml` and the streams it names.

    Parameters
    ----------
    folder : path
        Folder of one drive. Streams are CSV or Parquet, by the ending of their file; the GNSS stream may be a receiver's log
        (NMEA 0183 and others, see `railnav.io.gnss_log.LOG_FORMATS`).
    report : callable, optional
        Called with the summary of each log: what was read, what was left out and why. Without it, a summary that is not clean is
        still logged as a warning to "railnav.io".

    Returns
    -------
    Run
        Streams in SI and radians, `time_offset_s` added; arrays are read-only. A column that is absent, or empty
        throughout, is None; an empty cell is NaN.

    Raises
    ------
    RunError
        run.toml or a stream is missing, malformed or empty; a required column is missing; a value is not finite where one
        is needed or outside its lawful range; sigma is not positive; time stands still or runs backwards; a file lies
        outside the folder; a format is unknown; a log is refused by `railnav.io.gnss_log.read_log`.

    Notes
    -----
    GNSS coordinates in another frame than WGS 84 are turned to it by the one operation that `railnav.geodesy` pins for their
    place; `GnssStream.frame` keeps the name of the frame they came in. With `fixed_to` they are carried from their `epoch` (the
    run's start unless given) to that plate-fixed datum, so that runs of different years agree; `carried = true` says that they have
    been already, as in what `write_run` writes. An unsigned odometer that
    falls by more than 0.1 m is refused.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "run.toml").write_text(
    ...         '[run]\nid = "a"\nstart = "2026-05-04T08:00:00Z"\n[odometer]\nfile = "odometer.csv"\n')
    ...     _ = Path(folder, "odometer.csv").write_text("time_s,speed_m_s\n0.0,10.0\n0.1,10.2\n")
    ...     read_run(folder).odometer.speed.tolist()
    [10.0, 10.2]
    """
    folder = Path(folder)
    contents = read_contents(folder)
    file = folder / CONTENTS
    start = start_of(contents.run.start, file)
    tables: dict[str, Table] = {}
    for name in STREAMS:
        stream: StreamEntry | None = getattr(contents, name)
        if stream is None:
            continue
        path = stream_file(folder, name, stream)
        if stream.format in FORMATS:
            tables[name] = read_table(path, STREAM_COLUMNS[name], error=RunError)
            continue
        if name != "gnss":
            from railnav.io.ubx_sensors import sensor_table

            tables[name] = sensor_table(path, name, start)
            check_table(tables[name], STREAM_COLUMNS[name])
            continue
        log = read_log(path, stream.format, start=start)
        check_table(log.table, STREAM_COLUMNS[name])
        tables[name] = log.table
        if report is not None:
            report(log.summary)
    if not tables:
        cause = f"names no stream; a stream is one of {', '.join(STREAMS)}"
        raise RunError(cause, file=file, remedy='add for instance [gnss] with file = "gnss.csv"')
    time = {name: stamps(table, getattr(contents, name).time_offset_s) for name, table in tables.items()}
    return Run(
        id=contents.run.id,
        start=start,
        direction=contents.run.direction,
        gnss=gnss_stream(tables["gnss"], time["gnss"], contents.gnss, start, folder / CONTENTS)
        if contents.gnss
        else None,
        imu=imu_stream(tables["imu"], time["imu"], contents.imu, folder) if contents.imu else None,
        odometer=odometer_stream(tables["odometer"], time["odometer"], contents.odometer)
        if contents.odometer
        else None,
        gyro_angles=gyro_angles_stream(tables["gyro_angles"], time["gyro_angles"]) if contents.gyro_angles else None,
        gauge=gauge_stream(tables["gauge"], time["gauge"], contents.gauge) if contents.gauge else None,
        balise=balise_stream(tables["balise"], time["balise"]) if contents.balise else None,
        source=folder,
        simulated=contents.run.simulated,
    )


def read_imu_table(path: str | Path) -> ImuStream:
    """Read a table of inertial samples on its own, .csv or .parquet with the columns of an `imu` stream.

    Raises
    ------
    RunError
        The table is missing or malformed: with the row and the column.
    """
    table = read_table(path, STREAM_COLUMNS["imu"], error=RunError)
    return imu_stream(table, stamps(table, 0.0), ImuEntry(file=str(path)), Path(path).parent)


def write_run(run: Run, folder: str | Path, *, truth: Truth | None = None) -> None:
    """Write a run folder: `run.toml`, one CSV file a stream, and `truth.csv` where there is truth.

    Parameters
    ----------
    run : Run
        What to write; times must grow strictly within each stream.
    folder : path
        New or empty folder, or one that an earlier call wrote and that holds nothing else; replaced as a whole.
    truth : Truth, optional
        Written beside the streams in the format of `railnav.io.truth`.

    Raises
    ------
    RunError
        The run has no stream, or a stream has no rows.
    InputError
        The folder cannot be written, or holds other files.

    Notes
    -----
    Numbers are rounded to 1e-6 s, 1e-10 degrees (0.01 mm), 1e-5 m, 1e-10 rad/s and 1e-8 m/s2: the bytes depend on the run
    alone, and writing again what was read gives the same bytes.

    Examples
    --------
    >>> import tempfile
    >>> from datetime import UTC, datetime
    >>> from railnav.run import OdometerStream
    >>> run = Run("a", datetime(2026, 5, 4, 8, tzinfo=UTC), odometer=OdometerStream(np.arange(3.0), speed=np.ones(3)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_run(run, f"{folder}/a")
    ...     len(read_run(f"{folder}/a").odometer)
    3
    """
    from railnav.io.truth import write_truth

    streams = {name: columns for name in STREAMS if (columns := stream_columns(run, name))}
    if not streams:
        raise RunError("the run has no stream to write", file=folder)
    for name in streams:
        if not len(getattr(run, name).time):
            raise RunError(f"the {name} stream has no rows", file=folder, remedy="leave the stream out")
    written = [CONTENTS, "truth.csv", *(f"{name}.csv" for name in STREAMS)]
    with atomic_folder(folder, replaceable=written) as draft:
        (draft / CONTENTS).write_text(contents_text(run), encoding="utf-8", newline="\n")
        for name, columns in streams.items():
            write_table(draft / f"{name}.csv", columns, decimals=DECIMALS)
        if truth is not None:
            write_truth(truth, draft / "truth.csv")
