"""Run folders: `run.toml` and the streams it names, read into a Run and written from one.

Units are turned into SI and radians here, and nowhere else. What a stream's columns mean stands in the table of formats in
`docs/`; every refusal names the file, the row as an editor counts it, the column, and a way out.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from railnav.errors import CrsError, RunError
from railnav.io.atomic import atomic_folder
from railnav.io.gnss_log import LOG_FORMATS, LogSummary, read_log
from railnav.io.tables import Column, Table, Words, check_table, freeze, read_table, write_table
from railnav.run import BaliseStream, GaugeStream, GnssStream, GyroAnglesStream, ImuStream, OdometerStream, Run

if TYPE_CHECKING:
    from railnav.truth import Truth

FloatArray = NDArray[np.float64]

#: The table of contents of a run folder.
CONTENTS = "run.toml"
#: Formats of tables, for every stream; a GNSS stream may also be a receiver's log.
FORMATS = ("csv", "parquet")
#: A run.toml larger than this is refused.
MAX_CONTENTS_BYTES = 1_000_000
#: An unsigned odometer may fall by its noise, m, not by more.
ODOMETER_NOISE = 0.1
#: Zero of the Celsius scale, K.
CELSIUS = 273.15

_Vector = tuple[float, float, float]


class _Stream(Struct):
    file: Annotated[str, Meta(min_length=1)]
    format: str = "csv"
    time_offset_s: Annotated[float, Meta(ge=-1e7, le=1e7)] = 0.0


class _Gnss(_Stream):
    frame: Annotated[str, Meta(min_length=1)] | int = "WGS84"
    epoch: Any = None
    fixed_to: str = ""
    plate: str = ""
    receiver: str = ""
    lever_arm_m: _Vector = (0.0, 0.0, 0.0)


class _Imu(_Stream):
    lever_arm_m: _Vector = (0.0, 0.0, 0.0)
    mounting_deg: _Vector = (0.0, 0.0, 0.0)
    calibration: str = ""


class _Odometer(_Stream):
    signed: bool = False


class _Gauge(_Stream):
    reference_rail: Literal["", "left", "right"] = ""


class _Head(Struct):
    id: Annotated[str, Meta(min_length=1)]
    start: Any
    direction: str = ""


class _Contents(Struct):
    run: _Head
    gnss: _Gnss | None = None
    imu: _Imu | None = None
    odometer: _Odometer | None = None
    gyro_angles: _Stream | None = None
    gauge: _Gauge | None = None
    balise: _Stream | None = None


STREAMS = ("gnss", "imu", "odometer", "gyro_angles", "gauge", "balise")


def _optional(*names: str, positive: bool = False) -> tuple[Column, ...]:
    return tuple(Column(name, required=False, complete=False, positive=positive) for name in names)


_TIME = Column("time_s")
_NO_FIX = "remove rows without a fix"
_COLUMNS: dict[str, tuple[Column, ...]] = {
    "gnss": (
        _TIME,
        Column("latitude_deg", low=-90, high=90, remedy=_NO_FIX),
        Column("longitude_deg", low=-180, high=180, remedy=_NO_FIX),
        *_optional("height_m", "speed_m_s", "course_deg", "quality", "satellites", "hdop"),
        *_optional("sigma_east_m", "sigma_north_m", "sigma_up_m", "sigma_speed_m_s", positive=True),
    ),
    "imu": (
        _TIME,
        *(Column(f"gyro_{axis}_rad_s") for axis in "xyz"),
        *(Column(f"accel_{axis}_m_s2") for axis in "xyz"),
        Column("temperature_c", required=False, complete=False, low=-100, high=200),
    ),
    "odometer": (_TIME, *_optional("distance_m", "speed_m_s"), *_optional("sigma_speed_m_s", positive=True)),
    "gyro_angles": (_TIME, Column("roll_deg"), Column("pitch_deg"), Column("heading_deg")),
    "gauge": (_TIME, Column("gauge_mm", low=100, high=5000), *_optional("cant_mm")),
    "balise": (_TIME, Column("id", text=True), *_optional("sigma_m", positive=True)),
}


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
    run's start unless given) to that plate-fixed datum, so that runs of different years agree. An unsigned odometer that
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
    contents = _read_contents(folder)
    file = folder / CONTENTS
    start = _start(contents.run.start, file)
    tables: dict[str, Table] = {}
    for name in STREAMS:
        stream: _Stream | None = getattr(contents, name)
        if stream is None:
            continue
        path = _stream_file(folder, name, stream)
        if stream.format in FORMATS:
            tables[name] = read_table(path, _COLUMNS[name], error=RunError)
            continue
        if name != "gnss":
            from railnav.io.ubx_sensors import sensor_table

            tables[name] = sensor_table(path, name, start)
            check_table(tables[name], _COLUMNS[name])
            continue
        log = read_log(path, stream.format, start=start)
        check_table(log.table, _COLUMNS[name])
        tables[name] = log.table
        if report is not None:
            report(log.summary)
    if not tables:
        cause = f"names no stream; a stream is one of {', '.join(STREAMS)}"
        raise RunError(cause, file=file, remedy='add for instance [gnss] with file = "gnss.csv"')
    time = {name: _time(table, getattr(contents, name).time_offset_s) for name, table in tables.items()}
    return Run(
        id=contents.run.id,
        start=start,
        direction=contents.run.direction,
        gnss=_gnss(tables["gnss"], time["gnss"], contents.gnss, start, folder / CONTENTS) if contents.gnss else None,
        imu=_imu(tables["imu"], time["imu"], contents.imu, folder) if contents.imu else None,
        odometer=_odometer(tables["odometer"], time["odometer"], contents.odometer) if contents.odometer else None,
        gyro_angles=_gyro_angles(tables["gyro_angles"], time["gyro_angles"]) if contents.gyro_angles else None,
        gauge=_gauge(tables["gauge"], time["gauge"], contents.gauge) if contents.gauge else None,
        balise=_balise(tables["balise"], time["balise"]) if contents.balise else None,
        source=folder,
    )


def read_imu_table(path: str | Path) -> ImuStream:
    """Read a table of inertial samples on its own, .csv or .parquet with the columns of an `imu` stream.

    Raises
    ------
    RunError
        The table is missing or malformed: with the row and the column.
    """
    table = read_table(path, _COLUMNS["imu"], error=RunError)
    return _imu(table, _time(table, 0.0), _Imu(file=str(path)), Path(path).parent)


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
    >>> run = Run("a", datetime(2026, 5, 4, 8, tzinfo=UTC), odometer=OdometerStream(np.arange(3.0), speed=np.ones(3)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_run(run, f"{folder}/a")
    ...     len(read_run(f"{folder}/a").odometer)
    3
    """
    from railnav.io.truth import write_truth

    streams = {name: columns for name in STREAMS if (columns := _stream_columns(run, name))}
    if not streams:
        raise RunError("the run has no stream to write", file=folder)
    for name in streams:
        if not len(getattr(run, name).time):
            raise RunError(f"the {name} stream has no rows", file=folder, remedy="leave the stream out")
    written = [CONTENTS, "truth.csv", *(f"{name}.csv" for name in STREAMS)]
    with atomic_folder(folder, replaceable=written) as draft:
        (draft / CONTENTS).write_text(_contents_text(run), encoding="utf-8", newline="\n")
        for name, columns in streams.items():
            write_table(draft / f"{name}.csv", columns, decimals=_DECIMALS)
        if truth is not None:
            write_truth(truth, draft / "truth.csv")


# --- run.toml ---------------------------------------------------------------------------------------------------------


def _read_contents(folder: Path) -> _Contents:
    file = folder / CONTENTS
    if not folder.is_dir():
        cause = "is no run folder" if folder.exists() else "does not exist"
        raise RunError(cause, file=folder, remedy=f"a run is a folder that holds {CONTENTS}")
    if not file.is_file():
        raise RunError(f"the folder holds no {CONTENTS}", file=folder, remedy="name a run folder, or write one")
    try:
        if file.stat().st_size > MAX_CONTENTS_BYTES:
            raise RunError("is larger than 1 MB", file=file, remedy="it only names the streams")
        values = tomllib.loads(file.read_bytes().removeprefix(b"\xef\xbb\xbf").decode())
    except UnicodeDecodeError as error:
        raise RunError("is not UTF-8 text", file=file, remedy="save it as UTF-8") from error
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise RunError(f"is no TOML ({_one_line(error)})", file=file, remedy="text stands in double quotes") from error
    except OSError as error:
        raise RunError(f"cannot be read ({error.strerror or error})", file=file) from error
    if not isinstance(values.get("run"), dict):
        raise RunError("the table [run] is missing", file=file, remedy="add [run] with id and start")
    for key in ("id", "start"):
        if key not in values["run"]:
            example = "2021-06-29T10:35:17Z" if key == "start" else folder.resolve().name
            raise RunError("is missing", file=file, column=f"run.{key}", remedy=f'add {key} = "{example}"')
    try:
        contents = msgspec.convert(values, _Contents)
    except msgspec.ValidationError as error:
        cause, _, where = str(error).partition(" - at `$.")
        raise RunError(_one_line(cause), file=file, column=where.rstrip("`") or None) from error
    for name in STREAMS:
        for key in ("lever_arm_m", "mounting_deg", "time_offset_s"):
            value = getattr(getattr(contents, name), key, None)
            if value is not None and not np.isfinite(value).all():
                raise RunError("is not finite", file=file, column=f"{name}.{key}")
    return contents


def _one_line(error: object) -> str:
    text = " ".join(str(error).split())
    return text[:1].lower() + text[1:200]


def _decimal_year(instant: datetime) -> float:
    """Year and its part, as epochs of coordinates are counted."""
    first = instant.replace(month=1, day=1, hour=0, minute=0, second=0, microsecond=0)
    return instant.year + (instant - first) / (first.replace(year=instant.year + 1) - first)


def _epoch(epoch: object, file: Path) -> float:
    """Epoch of coordinates: a decimal year, or a date."""
    try:
        if isinstance(epoch, int | float) and not isinstance(epoch, bool):
            year = float(epoch)
        else:
            instant = epoch if isinstance(epoch, datetime) else datetime.fromisoformat(str(epoch).strip())
            year = _decimal_year(instant)
    except ValueError:
        year = float("nan")
    if not 1980.0 <= year <= 2100.0:
        remedy = "write a decimal year (2026.49) or a date"
        raise RunError(f"{str(epoch)[:40]!r} is no epoch", file=file, column="gnss.epoch", remedy=remedy)
    return year


def _start(start: object, file: Path) -> datetime:
    example = 'write UTC, as in start = "2021-06-29T10:35:17Z"'
    try:
        value = start if isinstance(start, datetime) else datetime.fromisoformat(str(start).strip())
    except ValueError as error:
        raise RunError(f"{str(start)[:40]!r} is no instant", file=file, column="run.start", remedy=example) from error
    if value.utcoffset() is None:
        cause = f"'{value.isoformat()}' has no time zone"
        raise RunError(cause, file=file, column="run.start", remedy=example)
    try:
        return value.astimezone(UTC)
    except OverflowError as error:
        raise RunError(f"{value} is no instant", file=file, column="run.start", remedy=example) from error


def _stream_file(folder: Path, name: str, stream: _Stream) -> Path:
    contents, column = folder / CONTENTS, f"{name}.file"
    logs = {"gnss": LOG_FORMATS, "imu": ("ubx",), "odometer": ("ubx",)}  # UBX: ESF-RAW, ESF-MEAS
    formats = (*FORMATS, *logs.get(name, ()))
    if stream.format not in formats:
        cause = f"{stream.format[:40]!r} is no format that is read here; {', '.join(formats)} are"
        remedy = "convert the stream to CSV with the columns of formats.md"
        raise RunError(cause, file=contents, column=f"{name}.format", remedy=remedy)
    return _inside(folder, stream.file, column)


def _inside(folder: Path, name: str, column: str) -> Path:
    """Path of a file that run.toml names, which must lie in the run's folder."""
    contents, path = folder / CONTENTS, Path(name)
    try:
        inside = (folder / path).resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError) as error:
        raise RunError(f"{name[:80]!r} is no usable path", file=contents, column=column) from error
    if path.is_absolute() or not inside:
        cause = f"{name[:80]!r} lies outside the run folder"
        raise RunError(cause, file=contents, column=column, remedy="put the file into the folder")
    return folder / path


def _quoted(text: str) -> str:
    escaped = "".join(
        f"\\u{ord(c):04x}" if ord(c) < 0x20 or ord(c) == 0x7F else f"\\{c}" if c in '"\\' else c for c in text
    )
    return f'"{escaped}"'


def _vector(values: FloatArray, decimals: int) -> str:
    return f"[{', '.join(repr(float(value)) for value in np.round(values, decimals) + 0.0)}]"


def _contents_text(run: Run) -> str:
    start = run.start.astimezone(UTC).isoformat().replace("+00:00", "Z")
    lines = ["[run]", f"id = {_quoted(run.id)}", f"start = {_quoted(start)}"]
    if run.direction:
        lines.append(f"direction = {_quoted(run.direction)}")
    for name in STREAMS:
        stream = getattr(run, name)
        if stream is None:
            continue
        lines += ["", f"[{name}]", f'file = "{name}.csv"', 'format = "csv"']
        if isinstance(stream, GnssStream):
            lines.append('frame = "WGS84"')  # whatever they came in, in memory they are WGS 84
            if stream.epoch is not None and not stream.fixed_to:
                lines.append(f"epoch = {stream.epoch!r}")
            if stream.receiver:
                lines.append(f"receiver = {_quoted(stream.receiver)}")
        if isinstance(stream, GnssStream | ImuStream):
            lines.append(f"lever_arm_m = {_vector(stream.lever_arm_b, 6)}")
        if isinstance(stream, ImuStream):
            lines.append(f"mounting_deg = {_vector(np.rad2deg(stream.mounting), 8)}")
        if isinstance(stream, OdometerStream) and stream.signed:
            lines.append("signed = true")
        if isinstance(stream, GaugeStream) and stream.reference_rail:
            lines.append(f'reference_rail = "{stream.reference_rail}"')
    return "\n".join(lines) + "\n"


# --- streams ----------------------------------------------------------------------------------------------------------


def _time(table: Table, offset: float) -> FloatArray:
    stamps = table.increasing("time_s")
    if offset == 0.0:
        return stamps
    shifted = freeze(stamps + offset)
    return replace(table, number={"time_s": shifted}).increasing("time_s")  # stamps so close that the sum merges them


def _known(table: Table, name: str) -> FloatArray | None:
    values = table.number.get(name)
    return None if values is None or np.isnan(values).all() else values


def _angle(table: Table, name: str) -> FloatArray | None:
    values = _known(table, name)
    return None if values is None else freeze(np.deg2rad(values))


def _fixed(values: Sequence[float]) -> FloatArray:
    return freeze(np.array(values, dtype=np.float64))


def _gnss(table: Table, time: FloatArray, stream: _Gnss, start: datetime, toml: Path) -> GnssStream:
    latitude, longitude = np.deg2rad(table.number["latitude_deg"]), np.deg2rad(table.number["longitude_deg"])
    height = _known(table, "height_m")
    epoch = None if stream.epoch is None else _epoch(stream.epoch, toml)
    named = str(stream.frame)  # an EPSG code may stand as a number
    if named != "WGS84" or stream.fixed_to:
        from railnav.geodesy.transformation import geodetic_frame

        try:
            frame = geodetic_frame(
                named,
                latitude,
                longitude,
                epoch=_decimal_year(start) if epoch is None else epoch,
                fixed_to=stream.fixed_to or None,
                plate=stream.plate or None,
            )
            latitude, longitude, up = frame.to_wgs84(latitude, longitude, height)
        except CrsError as error:
            raise RunError(str(error), file=toml, column="gnss.frame") from error
        height = None if height is None else freeze(up)
    return GnssStream(
        time=time,
        latitude=freeze(latitude),
        longitude=freeze(longitude),
        height=height,
        sigma_east=_known(table, "sigma_east_m"),
        sigma_north=_known(table, "sigma_north_m"),
        sigma_up=_known(table, "sigma_up_m"),
        speed=_known(table, "speed_m_s"),
        course=_angle(table, "course_deg"),
        sigma_speed=_known(table, "sigma_speed_m_s"),
        quality=_known(table, "quality"),
        satellites=_known(table, "satellites"),
        hdop=_known(table, "hdop"),
        lever_arm_b=_fixed(stream.lever_arm_m),
        frame=named,
        epoch=epoch,
        fixed_to=stream.fixed_to,
        receiver=stream.receiver,
    )


def _imu(table: Table, time: FloatArray, stream: _Imu, folder: Path) -> ImuStream:
    temperature = _known(table, "temperature_c")
    imu = ImuStream(
        time=time,
        gyro=freeze(np.column_stack([table.number[f"gyro_{axis}_rad_s"] for axis in "xyz"])),
        specific_force=freeze(np.column_stack([table.number[f"accel_{axis}_m_s2"] for axis in "xyz"])),
        lever_arm_b=_fixed(stream.lever_arm_m),
        mounting=_fixed(np.deg2rad(stream.mounting_deg).tolist()),
        temperature=None if temperature is None else freeze(temperature + CELSIUS),
    )
    if not stream.calibration:
        return imu
    from railnav.io.imu_calibration import calibrated_stream

    return calibrated_stream(imu, _inside(folder, stream.calibration, "imu.calibration"))


def _odometer(table: Table, time: FloatArray, stream: _Odometer) -> OdometerStream:
    distance, speed = _known(table, "distance_m"), _known(table, "speed_m_s")
    if distance is None and speed is None:
        cause = "neither distance_m nor speed_m_s has values"
        raise RunError(cause, file=table.file, row=1, remedy="an odometer needs one of these columns")
    empty = np.ones(table.length, dtype=bool)
    for values in (distance, speed):
        if values is not None:
            empty &= np.isnan(values)
    if empty.any():
        column = "distance_m" if distance is not None else "speed_m_s"
        table.refuse(int(np.argmax(empty)), column, "is empty or not a number", "remove rows without a reading")
    if distance is not None and not stream.signed:
        known = np.flatnonzero(~np.isnan(distance))
        fallen = np.flatnonzero(np.diff(distance[known]) < -ODOMETER_NOISE)
        if len(fallen):
            before, now = known[fallen[0]], known[fallen[0] + 1]
            cause = f"cumulative distance falls from {distance[before]:.12g} to {distance[now]:.12g} m"
            table.refuse(
                int(now), "distance_m", cause, f"set signed = true under [odometer] in {CONTENTS}, or split the run"
            )
    return OdometerStream(time, distance, speed, _known(table, "sigma_speed_m_s"), stream.signed)


def _gyro_angles(table: Table, time: FloatArray) -> GyroAnglesStream:
    roll, pitch, heading = (freeze(np.deg2rad(table.number[f"{name}_deg"])) for name in ("roll", "pitch", "heading"))
    return GyroAnglesStream(time, roll, pitch, heading)


def _gauge(table: Table, time: FloatArray, stream: _Gauge) -> GaugeStream:
    cant = _known(table, "cant_mm")
    gauge = freeze(table.number["gauge_mm"] / 1000)
    return GaugeStream(time, gauge, None if cant is None else freeze(cant / 1000), stream.reference_rail)


def _balise(table: Table, time: FloatArray) -> BaliseStream:
    return BaliseStream(time, tuple(table.words["id"].each()), _known(table, "sigma_m"))


#: Decimals in the text files of a run.
_DECIMALS: Mapping[str, int] = {
    "time_s": 6,
    "latitude_deg": 10,
    "longitude_deg": 10,
    "height_m": 5,
    "speed_m_s": 6,
    "course_deg": 6,
    "sigma_east_m": 5,
    "sigma_north_m": 5,
    "sigma_up_m": 5,
    "sigma_speed_m_s": 6,
    "quality": 0,
    "satellites": 0,
    "hdop": 3,
    **{f"gyro_{axis}_rad_s": 10 for axis in "xyz"},
    **{f"accel_{axis}_m_s2": 8 for axis in "xyz"},
    "temperature_c": 4,
    "distance_m": 5,
    "roll_deg": 8,
    "pitch_deg": 8,
    "heading_deg": 8,
    "gauge_mm": 4,
    "cant_mm": 4,
    "sigma_m": 5,
}


def _stream_columns(run: Run, name: str) -> dict[str, FloatArray | Words]:
    """Columns of a stream in the units of its file; those it does not have are left out."""
    stream: Any = getattr(run, name)
    if stream is None:
        return {}
    columns: dict[str, Any] = {"time_s": stream.time}
    match stream:
        case GnssStream():
            columns |= {
                "latitude_deg": np.rad2deg(stream.latitude),
                "longitude_deg": np.rad2deg(stream.longitude),
                "height_m": stream.height,
                "sigma_east_m": stream.sigma_east,
                "sigma_north_m": stream.sigma_north,
                "sigma_up_m": stream.sigma_up,
                "speed_m_s": stream.speed,
                "course_deg": None if stream.course is None else np.rad2deg(stream.course),
                "sigma_speed_m_s": stream.sigma_speed,
                "quality": stream.quality,
                "satellites": stream.satellites,
                "hdop": stream.hdop,
            }
        case ImuStream():
            columns |= {f"gyro_{axis}_rad_s": stream.gyro[:, i] for i, axis in enumerate("xyz")}
            columns |= {f"accel_{axis}_m_s2": stream.specific_force[:, i] for i, axis in enumerate("xyz")}
            columns["temperature_c"] = None if stream.temperature is None else stream.temperature - CELSIUS
        case OdometerStream():
            columns |= {
                "distance_m": stream.distance,
                "speed_m_s": stream.speed,
                "sigma_speed_m_s": stream.sigma_speed,
            }
        case GyroAnglesStream():
            columns |= {
                "roll_deg": np.rad2deg(stream.roll),
                "pitch_deg": np.rad2deg(stream.pitch),
                "heading_deg": np.rad2deg(stream.heading),
            }
        case GaugeStream():
            columns |= {
                "gauge_mm": stream.gauge * 1000,
                "cant_mm": None if stream.cant is None else stream.cant * 1000,
            }
        case BaliseStream():
            columns |= {"id": Words.of(stream.id), "sigma_m": stream.sigma}
    return {key: value for key, value in columns.items() if value is not None}
