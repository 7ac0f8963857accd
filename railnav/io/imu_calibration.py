"""The calibration file of an inertial unit, `imu.toml`: written, read, and refused by the row that is wrong."""

from __future__ import annotations

import math
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from railnav.errors import EstimationError, InputError
from railnav.inertial.calibration import TriadCalibration
from railnav.inertial.imu_calibration import (
    ImuCalibration,
    Provenance,
    TriadNoise,
    TriadTemperature,
    apply_calibration,
)
from railnav.inertial.temperature import TemperaturePolynomial
from railnav.io.atomic import atomic_path
from railnav.run import ImuStream, Run

FloatArray = NDArray[np.float64]

#: Version of the layout that is written; a newer one is refused.
FORMAT = 1
#: A file larger than this is refused.
MAX_BYTES = 1_000_000
CELSIUS = 273.15
#: Units of the two triads as the keys spell them, and the largest believable bias in that unit.
_UNITS = {"accelerometer": ("m_s2", 50.0), "gyroscope": ("rad_s", 10.0)}
_KEY = re.compile(r"\s*([A-Za-z0-9_-]+)\s*=")
_TABLE = re.compile(r"\s*\[([A-Za-z0-9_.-]+)\]\s*(#.*)?$")

_Vector = tuple[float, float, float]
_Matrix = tuple[_Vector, _Vector, _Vector]
_Count = Annotated[int, Meta(ge=0)]


class _Head(Struct, forbid_unknown_fields=True):
    format: Annotated[int, Meta(ge=1)]
    name: str = ""


class _Provenance(Struct, forbid_unknown_fields=True):
    date: str = ""
    logs: tuple[str, ...] = ()
    gravity_m_s2: Annotated[float, Meta(gt=9.0, lt=10.5)] | None = None
    note: str = ""


class _Temperature(Struct, forbid_unknown_fields=True):
    reference_c: float
    centre_c: float
    half_range_c: Annotated[float, Meta(gt=0.0, le=200.0)]
    bias: list[_Vector]
    scale: list[_Vector]
    sigma_bias: _Vector
    sigma_scale: _Vector
    covariance: list[list[float]]


class _Noise(Struct, forbid_unknown_fields=True):
    random_walk: Annotated[float, Meta(ge=0.0)]
    bias_instability: Annotated[float, Meta(ge=0.0)] = 0.0
    rate_random_walk: Annotated[float, Meta(ge=0.0)] = 0.0


class _Triad(Struct, forbid_unknown_fields=True):
    bias: _Vector
    matrix: _Matrix
    method: str = ""
    sigma_bias: _Vector | None = None
    sigma_matrix: _Matrix | None = None
    covariance: list[list[float]] | None = None
    residual: Annotated[float, Meta(ge=0.0)] = 0.0
    positions: _Count = 0
    rank: _Count = 0
    condition: Annotated[float, Meta(ge=0.0)] = 0.0
    temperature: _Temperature | None = None
    noise: _Noise | None = None


class _File(Struct, forbid_unknown_fields=True):
    imu: _Head
    accelerometer: _Triad | None = None
    gyroscope: _Triad | None = None
    provenance: _Provenance = msgspec.field(default_factory=_Provenance)


def read_calibration(path: str | Path) -> ImuCalibration:
    r"""Read a calibration file of an inertial unit.

    Parameters
    ----------
    path : path
        `imu.toml` as `write_calibration` writes it, or written by hand: [imu] with format = 1, and [accelerometer], [gyroscope] or both.

    Returns
    -------
    ImuCalibration

    Raises
    ------
    InputError
        The file is missing, no TOML, of a newer format, or says what no sensor is like: with file, row and key.

    Examples
    --------
    >>> import tempfile
    >>> text = '[imu]\nformat = 1\n[gyroscope]\nbias_rad_s = [0.1, 0, 0]\nmatrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n'
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "imu.toml").write_text(text)
    ...     read_calibration(f"{folder}/imu.toml").gyroscope.bias
    array([0.1, 0. , 0. ])
    """
    path = Path(path)
    text = _text(path)
    try:
        values = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise InputError(
            f"is no TOML ({' '.join(str(error).split())})", file=path, remedy="text stands in double quotes"
        ) from error
    rows = _rows(text)
    if not isinstance(values.get("imu"), dict):
        raise InputError(
            "the table [imu] is missing", file=path, remedy="this is no calibration file; it begins with [imu]"
        )
    version = values["imu"].get("format")
    if isinstance(version, int) and version > FORMAT:
        raise InputError(
            f"format {version} is newer than this program knows ({FORMAT})",
            file=path,
            row=rows.get("imu.format"),
            remedy="update railnav",
        )
    for name, (unit, _) in _UNITS.items():  # keys spell their unit; inside, the bare names
        triad = values.get(name)
        if isinstance(triad, dict):
            _rename(
                triad,
                {f"bias_{unit}": "bias", f"sigma_bias_{unit}": "sigma_bias", f"residual_{unit}": "residual"},
                name,
                path,
                rows,
            )
            if isinstance(triad.get("temperature"), dict):
                _rename(
                    triad["temperature"],
                    {f"bias_{unit}": "bias", f"sigma_bias_{unit}": "sigma_bias"},
                    f"{name}.temperature",
                    path,
                    rows,
                )
    try:
        file = msgspec.convert(values, _File)
    except msgspec.ValidationError as error:
        cause, _, where = str(error).partition(" - at `$")
        key = where.rstrip("`").lstrip(".")
        row = _row(rows, key)
        raise InputError(
            cause[:1].lower() + cause[1:], file=path, row=row, column=key or None, remedy="see docs/formats.md"
        ) from error
    if file.accelerometer is None and file.gyroscope is None:
        raise InputError("neither [accelerometer] nor [gyroscope] stands here", file=path, remedy="add one of them")
    made: dict[str, Any] = {}
    for name in _UNITS:
        triad = getattr(file, name)
        if triad is not None:
            check = _Checker(path, rows, name)
            made[name] = _triad(triad, check, name)
            made[f"{name}_temperature"] = _temperature(triad.temperature, check) if triad.temperature else None
            made[f"{name}_noise"] = (
                TriadNoise(triad.noise.random_walk, triad.noise.bias_instability, triad.noise.rate_random_walk)
                if triad.noise
                else None
            )
    source = file.provenance
    gravity = math.nan if source.gravity_m_s2 is None else source.gravity_m_s2
    return ImuCalibration(
        file.imu.name or path.stem, **made, provenance=Provenance(source.date, source.logs, gravity, source.note)
    )


def write_calibration(calibration: ImuCalibration, path: str | Path) -> None:
    """Write a calibration file, whole or not at all; the bytes depend on the calibration alone.

    Parameters
    ----------
    calibration : ImuCalibration
        What to write.
    path : path
        File to write, .toml; replaced in one step if it exists.

    Raises
    ------
    InputError
        The file cannot be written, or the calibration holds no triad.

    Examples
    --------
    >>> import tempfile
    >>> from railnav.inertial import six_position
    >>> unit = ImuCalibration("A7", gyroscope=six_position([1.0, 1.1, 1.0], [-1.0, -1.0, -1.0], 1.0))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_calibration(unit, f"{folder}/imu.toml")
    ...     read_calibration(f"{folder}/imu.toml").gyroscope.bias.round(3)
    array([0.  , 0.05, 0.  ])
    """
    if calibration.accelerometer is None and calibration.gyroscope is None:
        raise InputError("neither triad was calibrated", file=path, remedy="there is nothing to write")
    with atomic_path(path) as draft:
        draft.write_text(calibration_text(calibration), encoding="utf-8", newline="\n")


def calibrated_stream(imu: ImuStream, file: str | Path) -> ImuStream:
    """Apply the calibration of a file to a stream, naming the file in what is refused.

    Raises
    ------
    InputError
        The file is refused, or does not fit the stream.
    """
    try:
        return apply_calibration(imu, read_calibration(file))
    except EstimationError as error:
        raise InputError(str(error), file=file) from error


def calibrated_run(run: Run, file: str | Path | None) -> Run:
    """Give a run with its IMU corrected by a calibration file; as it is where none is named.

    Raises
    ------
    InputError
        The run has no IMU, or the file is refused or does not fit.
    """
    if file is None:
        return run
    if run.imu is None:
        raise InputError(f"the run {run.id} has no IMU to calibrate", file=file, remedy="name no calibration")
    return replace(run, imu=calibrated_stream(run.imu, file))


def named_calibration(folder: str | Path) -> ImuCalibration | None:
    """Read the calibration that a run folder's run.toml names; None where it names none.

    Raises
    ------
    InputError
        The file is refused.
    """
    contents = tomllib.loads((Path(folder) / "run.toml").read_bytes().removeprefix(b"\xef\xbb\xbf").decode())
    name = contents.get("imu", {}).get("calibration", "")
    return read_calibration(Path(folder) / name) if name else None


def calibration_text(calibration: ImuCalibration) -> str:
    """Text of a calibration file."""
    lines = [
        "# Calibration of an inertial unit: true = matrix (measured - bias), in the unit's own axes.",
        "[imu]",
        f"format = {FORMAT}",
    ]
    lines.append(f"name = {_quoted(calibration.name)}")
    for name, (unit, _) in _UNITS.items():
        triad: TriadCalibration | None = getattr(calibration, name)
        if triad is None:
            continue
        lines += ["", f"[{name}]", f"method = {_quoted(triad.method)}"]
        lines.append(f"bias_{unit} = {_vector(triad.bias)}{_remark(name, triad.bias)}")
        lines.append(f"matrix = {_matrix(triad.matrix)}")
        if triad.covariance is not None:
            assert triad.sigma_bias is not None
            assert triad.sigma_matrix is not None
            lines.append(f"sigma_bias_{unit} = {_vector(triad.sigma_bias)}{_remark(name, triad.sigma_bias)}")
            lines.append(f"sigma_matrix = {_matrix(triad.sigma_matrix)}")
            if np.any(triad.covariance - np.diag(np.diagonal(triad.covariance))):
                lines.append("# of bias and matrix, row by row; the lower triangle")
                lines.append(f"covariance = {_matrix([row[: k + 1] for k, row in enumerate(triad.covariance)])}")
        lines.append(f"residual_{unit} = {float(triad.residual)!r}")
        lines += [f"positions = {triad.positions}", f"rank = {triad.rank}"]
        if math.isfinite(triad.condition):
            lines.append(f"condition = {float(triad.condition)!r}")
        warm: TriadTemperature | None = getattr(calibration, f"{name}_temperature")
        if warm is not None:
            lines += [
                "",
                f"[{name}.temperature]",
                "# rows: powers of (temperature - centre)/half range; columns: x, y, z",
            ]
            lines.append(f"reference_c = {round(float(warm.reference - CELSIUS), 9)!r}")
            lines.append(f"centre_c = {round(float(warm.bias.centre - CELSIUS), 9)!r}")
            lines.append(f"half_range_c = {float(warm.bias.half_range)!r}")
            lines.append(f"bias_{unit} = {_matrix(warm.bias.coefficients)}")
            lines.append(f"scale = {_matrix(warm.scale.coefficients)}")
            lines.append(f"sigma_bias_{unit} = {_vector(warm.bias.sigma)}")
            lines.append(f"sigma_scale = {_vector(warm.scale.sigma)}")
            lines.append(f"covariance = {_matrix(warm.bias.covariance)}")
        noise: TriadNoise | None = getattr(calibration, f"{name}_noise")
        if noise is not None:
            lines += ["", f"[{name}.noise]", f"random_walk = {float(noise.random_walk)!r}"]
            lines.append(f"bias_instability = {float(noise.bias_instability)!r}")
            lines.append(f"rate_random_walk = {float(noise.rate_random_walk)!r}")
    source = calibration.provenance
    lines += ["", "[provenance]", f"date = {_quoted(source.date)}"]
    lines.append(f"logs = [{', '.join(_quoted(log) for log in source.logs)}]")
    if math.isfinite(source.gravity):
        lines.append(f"gravity_m_s2 = {float(source.gravity)!r}")
    if source.note:
        lines.append(f"note = {_quoted(source.note)}")
    return "\n".join(lines) + "\n"


class _Checker:
    """Refuses a key of one triad, with its row."""

    def __init__(self, file: Path, rows: dict[str, int], triad: str) -> None:
        self.file, self.rows, self.triad, self.unit = file, rows, triad, _UNITS[triad][0]

    def refuse(self, key: str, cause: str, remedy: str | None = None) -> InputError:
        full = f"{self.triad}.{key}"
        return InputError(cause, file=self.file, row=_row(self.rows, full), column=full, remedy=remedy)

    def array(self, key: str, value: Any) -> FloatArray:
        try:
            x = np.asarray(value, dtype=np.float64)
        except ValueError as error:
            raise self.refuse(key, "rows are not of one length") from error
        if not np.isfinite(x).all():
            raise self.refuse(key, "holds a value that is not finite", "leave the key out where nothing is known")
        return x

    def sigmas(self, key: str, value: Any) -> FloatArray:
        x = self.array(key, value)
        if np.any(x < 0.0):
            raise self.refuse(key, f"a standard deviation of {x.min():g} is negative")
        return x


def _triad(triad: _Triad, check: _Checker, name: str) -> TriadCalibration:
    unit, most = _UNITS[name]
    bias = check.array(f"bias_{unit}", triad.bias)
    if np.abs(bias).max() > most:
        raise check.refuse(
            f"bias_{unit}",
            f"a bias of {np.abs(bias).max():g} is beyond belief",
            f"the unit is {unit.replace('_s2', '/s^2').replace('rad_s', 'rad/s')}",
        )
    matrix = check.array("matrix", triad.matrix)
    if np.linalg.det(matrix) <= 0.0:
        raise check.refuse(
            "matrix", "is singular or mirrors the axes", "true = matrix (measured - bias), near the identity"
        )
    if np.abs(matrix - np.eye(3)).max() > 0.5:
        raise check.refuse(
            "matrix",
            f"is {np.abs(matrix - np.eye(3)).max():.2f} away from the identity",
            "readings are in SI, x on x; swap axes by mounting_deg",
        )
    covariance = None
    if triad.covariance is not None:
        lower = triad.covariance
        if len(lower) != 12 or any(len(row) != k + 1 for k, row in enumerate(lower)):
            raise check.refuse(
                "covariance", "is no lower triangle of 12 rows", "leave it out and give sigma_bias and sigma_matrix"
            )
        covariance = np.zeros((12, 12))
        for k, row in enumerate(lower):
            covariance[k, : k + 1] = covariance[: k + 1, k] = check.array("covariance", row)
        variances = np.diagonal(covariance)
        if np.any(variances < 0.0) or np.linalg.eigvalsh(_scaled(covariance)).min() < -1e-6:
            raise check.refuse("covariance", "is not positive semi-definite")
    if (triad.sigma_bias is None) != (triad.sigma_matrix is None):
        missing = "sigma_matrix" if triad.sigma_matrix is None else f"sigma_bias_{unit}"
        raise check.refuse(missing, "is missing", "sigmas of bias and matrix stand together; 0 for elements held fixed")
    if triad.sigma_bias is not None:
        sigma = np.concatenate(
            [
                check.sigmas(f"sigma_bias_{unit}", triad.sigma_bias),
                check.sigmas("sigma_matrix", triad.sigma_matrix).ravel(),
            ]
        )
        if covariance is None:
            covariance = np.diag(sigma**2)
        elif np.any(np.abs(np.sqrt(np.diagonal(covariance)) - sigma) > 0.01 * sigma + 1e-15):
            raise check.refuse("covariance", "contradicts the sigmas beside it", "remove one of them")
    condition = triad.condition if triad.condition > 0.0 else math.inf
    return TriadCalibration(
        triad.method, bias, matrix, covariance, triad.residual, triad.positions, triad.rank, condition
    )


def _temperature(warm: _Temperature, check: _Checker) -> TriadTemperature:
    count = len(warm.covariance)
    covariance = check.array("temperature.covariance", warm.covariance)
    bias, scale = check.array("temperature.bias", warm.bias), check.array("temperature.scale", warm.scale)
    if covariance.shape != (count, count) or not len(bias) == len(scale) == count or not 1 <= count <= 8:
        raise check.refuse(
            "temperature.covariance",
            "bias, scale and covariance need one row a power, at most 8",
            "see docs/formats.md",
        )
    if np.abs(scale[0]).max() > 0.5:
        raise check.refuse("temperature.scale", f"a scale error of {np.abs(scale[0]).max():g} is beyond belief")
    if abs(warm.reference_c - warm.centre_c) > warm.half_range_c + 1e-9:
        raise check.refuse("temperature.reference_c", f"{warm.reference_c:g} lies outside the temperatures measured")
    centre = warm.centre_c + CELSIUS

    def polynomial(coefficients: FloatArray, key: str, sigma: _Vector) -> TemperaturePolynomial:
        return TemperaturePolynomial(
            coefficients, covariance, check.sigmas(f"temperature.{key}", sigma), centre, warm.half_range_c
        )

    return TriadTemperature(
        polynomial(bias, "sigma_bias", warm.sigma_bias),
        polynomial(scale, "sigma_scale", warm.sigma_scale),
        warm.reference_c + CELSIUS,
    )


def _scaled(covariance: FloatArray) -> FloatArray:
    size = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    size = np.where(size > 0.0, size, 1.0)
    return np.asarray(covariance / size[:, None] / size[None, :])


def _text(path: Path) -> str:
    if path.is_dir():
        raise InputError("is a folder, not a calibration file", file=path, remedy="name the .toml file")
    if not path.is_file():
        raise InputError("does not exist", file=path, remedy="check the name, or make one with railnav calibrate")
    if path.stat().st_size > MAX_BYTES:
        raise InputError("is larger than 1 MB", file=path, remedy="a calibration file has some 50 lines")
    try:
        return path.read_bytes().removeprefix(b"\xef\xbb\xbf").decode()
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8 text", file=path, remedy="name a calibration file, .toml") from error


def _rows(text: str) -> dict[str, int]:
    """Row of each key, by its full name, and of each table."""
    rows: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if found := _TABLE.match(line):
            table = found.group(1)
            rows.setdefault(table, number)
        elif found := _KEY.match(line):
            rows.setdefault(f"{table}.{found.group(1)}" if table else found.group(1), number)
    return rows


def _row(rows: dict[str, int], key: str) -> int | None:
    """Row of a key; of the nearest table above it where the key itself is not there."""
    key = re.sub(r"\[.*", "", key)
    table, _, leaf = key.rpartition(".")
    for unit, _most in _UNITS.values():
        if f"{key}_{unit}" in rows:
            return rows[f"{key}_{unit}"]
    return rows.get(key) or rows.get(table) if leaf else None


def _rename(table: dict[str, Any], names: dict[str, str], where: str, path: Path, rows: dict[str, int]) -> None:
    for spelled, bare in names.items():
        if bare in table:
            raise InputError(
                "names no unit",
                file=path,
                row=_row(rows, f"{where}.{bare}"),
                column=f"{where}.{bare}",
                remedy=f"write {spelled}",
            )
        if spelled in table:
            table[bare] = table.pop(spelled)


def _quoted(text: str) -> str:
    return (
        '"'
        + "".join(
            f"\\u{ord(c):04x}" if ord(c) < 0x20 or ord(c) == 0x7F else f"\\{c}" if c in '"\\' else c for c in text
        )
        + '"'
    )


def _vector(values: Any) -> str:
    return f"[{', '.join(repr(float(v) + 0.0) for v in values)}]"


def _matrix(rows: Any) -> str:
    inner = "".join(f"\n    {_vector(row)}," for row in rows)
    return f"[{inner}\n]"


def _remark(name: str, values: FloatArray) -> str:
    """The same in the unit that people speak of."""
    if name == "gyroscope":
        return f"  # {', '.join(f'{math.degrees(v) * 3600:.4g}' for v in values)} deg/h"
    return f"  # {', '.join(f'{v / 9.80665e-3:.4g}' for v in values)} mg"
