"""run.toml: what a run folder names, read, checked and written."""

from __future__ import annotations

import tomllib
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from railnav.errors import RunError
from railnav.io.gnss_log import LOG_FORMATS
from railnav.run import (
    GaugeStream,
    GnssErrors,
    GnssStream,
    ImuErrors,
    ImuStream,
    OdometerErrors,
    OdometerStream,
    Run,
)

FloatArray = NDArray[np.float64]
#: The table of contents of a run folder.
CONTENTS = "run.toml"
#: Formats of tables, for every stream; a GNSS stream may also be a receiver's log.
FORMATS = ("csv", "parquet")
#: A run.toml larger than this is refused.
MAX_CONTENTS_BYTES = 1_000_000
_Vector = tuple[float, float, float]


class StreamEntry(Struct):
    """What run.toml says of any stream."""

    file: Annotated[str, Meta(min_length=1)]
    format: str = "csv"
    time_offset_s: Annotated[float, Meta(ge=-1e7, le=1e7)] = 0.0


_Sigma = Annotated[float, Meta(ge=0.0, le=1e6)]


class GnssErrorsEntry(Struct, forbid_unknown_fields=True):
    """Table [gnss.errors]: what is declared of the receiver."""

    white_m: _Sigma | None = None
    correlated_m: _Sigma | None = None
    correlation_time_s: Annotated[float, Meta(gt=0.0, le=1e6)] | None = None
    frame_offset_m: _Sigma | None = None
    stamp_s: _Sigma | None = None
    speed_latency_s: _Sigma | None = None
    speed_correlated: _Sigma | None = None


class ImuErrorsEntry(Struct, forbid_unknown_fields=True):
    """Table [imu.errors]: what is declared of the IMU and the vehicle."""

    gyro_bias_rad_s: _Sigma | None = None
    gyro_walk_rad_s_sqrt_s: _Sigma | None = None
    gyro_scale: _Sigma | None = None
    accelerometer_bias_m_s2: _Sigma | None = None
    accelerometer_walk_m_s2_sqrt_s: _Sigma | None = None
    mounting_deg: _Sigma | None = None
    sway_rad_s: _Sigma | None = None
    vibration_m_s2_sqrt_hz: _Sigma | None = None


class OdometerErrorsEntry(Struct, forbid_unknown_fields=True):
    """Table [odometer.errors]: what is declared of the wheel."""

    scale: _Sigma | None = None
    creep_m_sqrt_m: _Sigma | None = None


class GnssEntry(StreamEntry):
    """Table [gnss]."""

    frame: Annotated[str, Meta(min_length=1)] | int = "WGS84"
    epoch: Any = None
    fixed_to: str = ""
    plate: str = ""
    carried: bool = False
    receiver: str = ""
    lever_arm_m: _Vector = (0.0, 0.0, 0.0)
    errors: GnssErrorsEntry | None = None


class ImuEntry(StreamEntry):
    """Table [imu]."""

    lever_arm_m: _Vector = (0.0, 0.0, 0.0)
    mounting_deg: _Vector = (0.0, 0.0, 0.0)
    calibration: str = ""
    errors: ImuErrorsEntry | None = None


class OdometerEntry(StreamEntry):
    """Table [odometer]."""

    signed: bool = False
    errors: OdometerErrorsEntry | None = None


class GaugeEntry(StreamEntry):
    """Table [gauge]."""

    reference_rail: Literal["", "left", "right"] = ""


class _Head(Struct):
    id: Annotated[str, Meta(min_length=1)]
    start: Any
    direction: str = ""
    simulated: bool = False


class Contents(Struct):
    """A run.toml as a whole."""

    run: _Head
    gnss: GnssEntry | None = None
    imu: ImuEntry | None = None
    odometer: OdometerEntry | None = None
    gyro_angles: StreamEntry | None = None
    gauge: GaugeEntry | None = None
    balise: StreamEntry | None = None


class SensorsEntry(Struct, forbid_unknown_fields=True):
    """A file of declared errors: the tables of a run.toml's streams, without their [stream.errors] prefix."""

    gnss: GnssErrorsEntry | None = None
    imu: ImuErrorsEntry | None = None
    odometer: OdometerErrorsEntry | None = None


STREAMS = ("gnss", "imu", "odometer", "gyro_angles", "gauge", "balise")


def read_contents(folder: Path) -> Contents:
    """Read and check the run.toml of a folder."""
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
        contents = msgspec.convert(values, Contents)
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


def decimal_year(instant: datetime) -> float:
    """Year and its part, as epochs of coordinates are counted."""
    first = instant.replace(month=1, day=1, hour=0, minute=0, second=0, microsecond=0)
    return instant.year + (instant - first) / (first.replace(year=instant.year + 1) - first)


def epoch_of(epoch: object, file: Path) -> float:
    """Epoch of coordinates: a decimal year, or a date."""
    try:
        if isinstance(epoch, int | float) and not isinstance(epoch, bool):
            year = float(epoch)
        else:
            instant = epoch if isinstance(epoch, datetime) else datetime.fromisoformat(str(epoch).strip())
            year = decimal_year(instant)
    except ValueError:
        year = float("nan")
    if not 1980.0 <= year <= 2100.0:
        remedy = "write a decimal year (2026.49) or a date"
        raise RunError(f"{str(epoch)[:40]!r} is no epoch", file=file, column="gnss.epoch", remedy=remedy)
    return year


def start_of(start: object, file: Path) -> datetime:
    """Instant of the run's start, UTC."""
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


def stream_file(folder: Path, name: str, stream: StreamEntry) -> Path:
    """Path of the file of a stream, in a format that is read."""
    contents, column = folder / CONTENTS, f"{name}.file"
    logs = {"gnss": LOG_FORMATS, "imu": ("ubx",), "odometer": ("ubx",)}  # UBX: ESF-RAW, ESF-MEAS
    formats = (*FORMATS, *logs.get(name, ()))
    if stream.format not in formats:
        cause = f"{stream.format[:40]!r} is no format that is read here; {', '.join(formats)} are"
        remedy = "convert the stream to CSV with the columns of formats.md"
        raise RunError(cause, file=contents, column=f"{name}.format", remedy=remedy)
    return inside_folder(folder, stream.file, column)


def inside_folder(folder: Path, name: str, column: str) -> Path:
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


def quoted(text: str) -> str:
    """Text as a TOML string."""
    escaped = "".join(
        f"\\u{ord(c):04x}" if ord(c) < 0x20 or ord(c) == 0x7F else f"\\{c}" if c in '"\\' else c for c in text
    )
    return f'"{escaped}"'


def _vector(values: FloatArray, decimals: int) -> str:
    return f"[{', '.join(repr(float(value)) for value in np.round(values, decimals) + 0.0)}]"


#: Keys of the tables of errors, by the names of their values.
_DECLARED = {
    GnssErrors: {
        "white": "white_m",
        "correlated": "correlated_m",
        "correlation_time": "correlation_time_s",
        "frame_offset": "frame_offset_m",
        "stamp": "stamp_s",
        "speed_latency": "speed_latency_s",
        "speed_correlated": "speed_correlated",
    },
    ImuErrors: {
        "gyro_bias": "gyro_bias_rad_s",
        "gyro_walk": "gyro_walk_rad_s_sqrt_s",
        "gyro_scale": "gyro_scale",
        "accelerometer_bias": "accelerometer_bias_m_s2",
        "accelerometer_walk": "accelerometer_walk_m_s2_sqrt_s",
        "mounting": "mounting_deg",
        "sway": "sway_rad_s",
        "vibration": "vibration_m_s2_sqrt_hz",
    },
    OdometerErrors: {"scale": "scale", "creep": "creep_m_sqrt_m"},
}
_Errors = TypeVar("_Errors", GnssErrors, ImuErrors, OdometerErrors)


def declared(kind: type[_Errors], entry: Struct | None) -> _Errors | None:
    """Errors of a stream, SI and radians, from their table; None where there is none."""
    if entry is None:
        return None
    values = {name: getattr(entry, key) for name, key in _DECLARED[kind].items()}
    turned = {name: np.deg2rad(v) if name == "mounting" else v for name, v in values.items() if v is not None}
    return kind(**{name: float(v) for name, v in turned.items()})


def declared_text(errors: GnssErrors | ImuErrors | OdometerErrors) -> list[str]:
    """Lines of a table of errors, those that are declared."""
    lines = []
    for name, key in _DECLARED[type(errors)].items():
        value = float(getattr(errors, name))
        if not np.isnan(value):
            written = f"{np.rad2deg(value) if name == 'mounting' else value:.9g}"
            lines.append(f"{key} = {float(written)!r}")
    return lines


def read_sensors(file: Path) -> tuple[GnssErrors | None, ImuErrors | None, OdometerErrors | None]:
    """Errors of receiver, IMU and wheel from a TOML file with the tables [gnss], [imu], [odometer], keys as in run.toml.

    Raises
    ------
    RunError
        The file is missing or no TOML, or holds a key or a value that is none.
    """
    try:
        entry = msgspec.convert(tomllib.loads(file.read_text(encoding="utf-8")), SensorsEntry)
    except OSError as error:
        raise RunError(f"cannot be read ({error.strerror or error})", file=file) from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise RunError(f"is no TOML ({_one_line(error)})", file=file) from error
    except msgspec.ValidationError as error:
        cause, _, where = str(error).partition(" - at `$.")
        remedy = "tables are [gnss], [imu], [odometer], keys those of [gnss.errors] and so on in run.toml"
        raise RunError(_one_line(cause), file=file, column=where.rstrip("`") or None, remedy=remedy) from error
    return (
        declared(GnssErrors, entry.gnss),
        declared(ImuErrors, entry.imu),
        declared(OdometerErrors, entry.odometer),
    )


def contents_text(run: Run) -> str:
    """The run.toml of a run whose streams are written as CSV."""
    start = run.start.astimezone(UTC).isoformat().replace("+00:00", "Z")
    lines = ["[run]", f"id = {quoted(run.id)}", f"start = {quoted(start)}"]
    if run.direction:
        lines.append(f"direction = {quoted(run.direction)}")
    if run.simulated:
        lines.append("simulated = true")
    for name in STREAMS:
        stream = getattr(run, name)
        if stream is None:
            continue
        lines += ["", f"[{name}]", f'file = "{name}.csv"', 'format = "csv"']
        if isinstance(stream, GnssStream):
            lines.append('frame = "WGS84"')  # whatever they came in, in memory they are WGS 84
            if stream.epoch is not None:
                lines.append(f"epoch = {stream.epoch!r}")
            if stream.fixed_to:
                lines += [f"fixed_to = {quoted(stream.fixed_to)}", "carried = true"]
            if stream.receiver:
                lines.append(f"receiver = {quoted(stream.receiver)}")
        if isinstance(stream, GnssStream | ImuStream):
            lines.append(f"lever_arm_m = {_vector(stream.lever_arm_b, 6)}")
        if isinstance(stream, ImuStream):
            lines.append(f"mounting_deg = {_vector(np.rad2deg(stream.mounting), 8)}")
        if isinstance(stream, OdometerStream) and stream.signed:
            lines.append("signed = true")
        if isinstance(stream, GaugeStream) and stream.reference_rail:
            lines.append(f'reference_rail = "{stream.reference_rail}"')
        errors = getattr(stream, "errors", None)
        if errors is not None and (values := declared_text(errors)):
            lines += ["", f"[{name}.errors]", *values]
    return "\n".join(lines) + "\n"
