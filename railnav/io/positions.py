r"""Sets of positions for a calibration: a folder of run folders or of tables, one a position, or one long log.

`positions.toml` may stand beside them and say what the operator knows: where the bench is, the rate of the table, which side was up.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct

from railnav.errors import InputError, RunError
from railnav.inertial.advice import advise_positions, axes_up
from railnav.inertial.mechanization import GravityField
from railnav.inertial.positions import PositionLog
from railnav.inertial.procedure import METHODS, RATE_METHODS, Method
from railnav.inertial.turns import advise_turns
from railnav.io.atomic import atomic_folder
from railnav.io.run import read_imu_table, read_run, write_run
from railnav.io.run_contents import CONTENTS
from railnav.run import ImuStream, Run

#: What the operator knows, beside the logs.
NOTES = "positions.toml"
#: Endings of tables that hold one position.
TABLES = (".csv", ".parquet")

_Vector = tuple[float, float, float]


class _Position(Struct, forbid_unknown_fields=True):
    log: Annotated[str, Meta(min_length=1)]
    up: str | _Vector | None = None
    rate_deg_s: float | None = None
    turns_deg: _Vector | None = None
    turn_rates_deg_s: _Vector | None = None


class _Notes(Struct, forbid_unknown_fields=True):
    latitude_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] | None = None
    height_m: Annotated[float, Meta(ge=-500.0, le=9000.0)] = 0.0
    gravity_m_s2: Annotated[float, Meta(gt=9.7, lt=9.9)] | None = None
    rate_deg_s: Annotated[float, Meta(gt=0.0)] | None = None
    position: list[_Position] = msgspec.field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class PositionSet:
    """Logs of positions and what is known of the bench.

    Attributes
    ----------
    logs : tuple of PositionLog
        In the order of `positions.toml`, or of their names.
    whole : bool
        Whether it is one long log, to be cut into positions.
    latitude, gravity, rate : float or None
        rad, m/s^2 and the table's rate, rad/s, where known: from `positions.toml`, or latitude and gravity from GNSS fixes of a run.
    date : str
        Day of the newest run; empty where the logs are tables.
    """

    logs: tuple[PositionLog, ...]
    whole: bool = False
    latitude: float | None = None
    gravity: float | None = None
    rate: float | None = None
    date: str = ""


def read_positions(path: str | Path) -> PositionSet:
    """Read a set of positions.

    Parameters
    ----------
    path : path
        Folder of run folders or of tables (.csv, .parquet with the columns of an `imu` stream), one a position; or one run folder or table
        that holds them all. `positions.toml` in the folder, where there is one, names logs, sides, rates and turns.

    Returns
    -------
    PositionSet

    Raises
    ------
    InputError
        There is no log, one is refused (see `railnav.io.run.read_run`), a run has no IMU, or `positions.toml` is wrong: with file and key.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     read_positions(folder)
    Traceback (most recent call last):
    railnav.errors.InputError: ...: holds neither run folders nor tables of positions; ...
    """
    path = Path(path)
    if not path.exists():
        raise InputError("does not exist", file=path, remedy="name a folder of positions")
    if path.is_file() or (path / CONTENTS).is_file():
        imu, run = _read(path)
        return _known(
            PositionSet((PositionLog(path.name if path.is_dir() else path.stem, imu),), whole=True),
            [run] if run else [],
            None,
        )
    notes = _notes(path / NOTES)
    if notes is not None and notes.position:
        files = [_member(path, one.log, k) for k, one in enumerate(notes.position)]
    else:
        files = sorted(
            file
            for file in path.iterdir()
            if (file.is_dir() and (file / CONTENTS).is_file()) or (file.is_file() and file.suffix.lower() in TABLES)
        )
    if not files:
        raise InputError(
            "holds neither run folders nor tables of positions",
            file=path,
            remedy="put one run folder (with run.toml) or one .csv with the columns of an IMU stream into it for each position",
        )
    logs, runs = [], []
    for k, file in enumerate(files):
        imu, run = _read(file)
        if run is not None:
            runs.append(run)
        told = notes.position[k] if notes is not None and notes.position else _Position(file.name)
        logs.append(
            PositionLog(
                file.name if file.is_dir() else file.stem,
                imu,
                up=_up(told.up, path / NOTES, k),
                rate=None if told.rate_deg_s is None else float(np.deg2rad(told.rate_deg_s)),
                turns=None if told.turns_deg is None else np.deg2rad(told.turns_deg),
                turn_rates=None if told.turn_rates_deg_s is None else np.deg2rad(told.turn_rates_deg_s),
            )
        )
    return _known(PositionSet(tuple(logs)), runs, notes)


def write_positions(
    logs: Sequence[PositionLog], folder: str | Path, *, latitude: float | None = None, start: datetime | None = None
) -> None:
    """Write a set of positions: a run folder for each, and `positions.toml`.

    Parameters
    ----------
    logs : sequence of PositionLog
        What to write.
    folder : path
        New or empty folder.
    latitude : float, optional
        rad.
    start : datetime, optional
        Of the first; default: the first instant of 2000.

    Raises
    ------
    InputError
        The folder cannot be written, or holds other files.
    """
    begin = start or datetime(2000, 1, 1, tzinfo=UTC)
    lines = [] if latitude is None else [f"latitude_deg = {float(np.rad2deg(latitude))!r}"]
    with atomic_folder(folder) as draft:
        for log in logs:
            write_run(Run(log.name, begin, imu=log.imu), draft / log.name)
            lines += ["", "[[position]]", f'log = "{log.name}"']
            for key, values in (
                ("up", log.up),
                ("rate_deg_s", None if log.rate is None else np.rad2deg(log.rate)),
                ("turns_deg", None if log.turns is None else np.rad2deg(log.turns)),
                ("turn_rates_deg_s", None if log.turn_rates is None else np.rad2deg(log.turn_rates)),
            ):
                if values is not None:
                    x = np.round(np.asarray(values, dtype=np.float64), 12) + 0.0
                    lines.append(f"{key} = {x.tolist()!r}")
        (draft / NOTES).write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def plan_text(method: Method, *, count: int = 12, step: float = 30.0, rate: float = 60.0) -> str:
    """Text of a `positions.toml` that says which positions to take for a method, best first.

    Parameters
    ----------
    method : str
        One of `railnav.inertial.METHODS`.
    count : int, optional
        Positions of the multi-position methods (at least 9) and of turns (at least 4).
    step : float, optional
        Smallest turn of the dividing head, degrees.
    rate : float, optional
        Of the table, degrees per second.

    Returns
    -------
    str

    Raises
    ------
    ValueError
        An unknown method, or too few positions for it.
    EstimationError
        Turns by this step determine nothing.

    Examples
    --------
    >>> print(plan_text("six-position").splitlines()[3])
    up = "+x"
    """
    if method not in METHODS:
        raise ValueError(f"no method {method!r}; there are {', '.join(METHODS)}")
    least = {"turns": 4, "multi-position": 9, "modified-multi-position": 9}.get(method, 6)
    if count < least:
        raise ValueError(f"{count} positions are too few for {method}; at least {least}")
    lines: list[str] = []
    told = [f"rate_deg_s = {rate!r}"] if method in RATE_METHODS else []
    if method == "turns":
        multiples, reached = advise_turns(math.radians(step), count)
        lines.append(
            f"# turns by {' : '.join(map(str, multiples))} times {step:g} degrees about x, y, z: condition {reached.condition:.2f}"
        )
        entries = [[f"turns_deg = {[float(k * m * step) for m in multiples]!r}"] for k in range(count)]
    else:
        if method.endswith("six-position"):
            ups = np.array([sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)])
            lines.append("# each axis up and down, levelled to a degree")
        else:
            faces = np.array([sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)])
            ups = np.vstack([faces, advise_positions(faces, count - 6)])
            lines.append("# attitudes need not be exact; spread over all sides")
        entries = [[f'up = "{axes_up(up)}"', *told] for up in ups]
    lines[0] += "; the turn axis is the one that points up" if told else ""
    for k, entry in enumerate(entries, start=1):
        lines += ["[[position]]", f'log = "{k:02d}"', *entry]
    return "\n".join(lines) + "\n"


def _read(path: Path) -> tuple[ImuStream, Run | None]:
    if path.is_file():
        return read_imu_table(path), None
    run = read_run(path)
    if run.imu is None:
        raise RunError("the run has no IMU", file=path / CONTENTS, remedy="name it: [imu] with file = ...")
    return run.imu, run


def _notes(file: Path) -> _Notes | None:
    if not file.is_file():
        return None
    try:
        return msgspec.convert(tomllib.loads(file.read_text(encoding="utf-8")), _Notes)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"is no TOML ({' '.join(str(error).split())})", file=file) from error
    except msgspec.ValidationError as error:
        cause, _, where = str(error).partition(" - at `$")
        raise InputError(
            cause[:1].lower() + cause[1:],
            file=file,
            column=where.rstrip("`").lstrip(".") or None,
            remedy="see docs/formats.md",
        ) from error


def _member(folder: Path, name: str, index: int) -> Path:
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()) or not path.exists():
        cause = f"{name!r} is not in the folder"
        raise InputError(
            cause, file=folder / NOTES, column=f"position[{index}].log", remedy="name a run folder or a table in it"
        )
    return path


def _up(told: str | _Vector | None, file: Path, index: int) -> Any:
    """Direction from words such as "+x" or "-y +z", or from a vector."""
    if told is None:
        return None
    column = f"position[{index}].up"
    if isinstance(told, str):
        up = np.zeros(3)
        for word in told.split():
            sign, axis = (word[0], word[1:]) if word[0] in "+-" else ("+", word)
            if axis not in ("x", "y", "z"):
                raise InputError(
                    f"{told!r} names no side",
                    file=file,
                    column=column,
                    remedy='write "+x", "-z", or "+x -y" for an edge',
                )
            up["xyz".index(axis)] = 1.0 if sign == "+" else -1.0
    else:
        up = np.array(told)
    if not np.any(up) or not np.isfinite(up).all():
        raise InputError("is no direction", file=file, column=column, remedy='write "+x", or three numbers')
    return up / np.linalg.norm(up)


def _known(found: PositionSet, runs: Sequence[Run], notes: _Notes | None) -> PositionSet:
    latitude = gravity = rate = None
    fixes = [run.gnss for run in runs if run.gnss is not None and len(run.gnss)]
    if fixes:
        latitude = float(np.median(fixes[0].latitude))
        height = 0.0 if fixes[0].height is None else float(np.nanmedian(fixes[0].height))
        gravity = float(GravityField().vector(latitude, height)[2])
    if notes is not None:
        rate = None if notes.rate_deg_s is None else float(np.deg2rad(notes.rate_deg_s))
        if notes.latitude_deg is not None:
            latitude = float(np.deg2rad(notes.latitude_deg))
            gravity = float(GravityField().vector(latitude, notes.height_m)[2])
        gravity = notes.gravity_m_s2 or gravity
    date = max((run.start for run in runs), default=None)
    return PositionSet(
        found.logs, found.whole, latitude, gravity, rate, "" if date is None else date.date().isoformat()
    )
