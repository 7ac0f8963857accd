"""Tables of track geometry limits: TOML, in millimetres and km/h, each value with its source and whether it was read there."""

from __future__ import annotations

import math
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

from railnav.errors import InputError
from railnav.monitoring.limits import CLASSES, LEVELS, ClassLimit, Combination, Limit, LimitTable
from railnav.monitoring.quality import COMBINABLE

#: The table used when none is named.
DEFAULT = "limits_1435.toml"
#: What may stand as status.
STATUS = ("read", "recalled", "own")
#: A table larger than this is refused.
MAX_BYTES = 1_000_000
_KEYS = {"channel", "speed_kmh", "radius_m", "status", "source", "note", *LEVELS}


def default_text() -> str:
    """Text of the default table, to edit."""
    return files("railnav.monitoring").joinpath(DEFAULT).read_text(encoding="utf-8")


def default_limits() -> LimitTable:
    """The default table: standard gauge, Bane NOR (read) and EN 13848 (in parts recalled).

    Examples
    --------
    >>> table = default_limits()
    >>> table.gauge, len(table.limits) > 20
    (1.435, True)
    """
    return _table(tomllib.loads(default_text()), DEFAULT)


def read_limits(path: str | Path) -> LimitTable:
    """Read a table of limits.

    Parameters
    ----------
    path : path
        TOML: `[table]` with name and gauge_mm, then `[[limit]]`, `[[deviation]]`, `[[class]]` and `[combined]`; see the default table.

    Returns
    -------
    LimitTable
        SI.

    Raises
    ------
    InputError
        The file is missing, is no TOML, or an entry is not lawful; the message names the entry.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("no such file", file=path, remedy="name a TOML table of limits")
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"is larger than {MAX_BYTES:,} bytes: no table of limits", file=path)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"is no TOML ({error})", file=path) from error
    return _table(content, path)


def _table(content: dict[str, Any], file: str | Path) -> LimitTable:
    unknown = set(content) - {"table", "limit", "deviation", "class", "combined"}
    if unknown:
        raise InputError(
            f"unknown table [{sorted(unknown)[0]}]",
            file=file,
            remedy="use [table], [[limit]], [[deviation]], [[class]], [combined]",
        )
    head = content.get("table", {})
    if not isinstance(head, dict):
        raise InputError("[table] is not a table", file=file)
    gauge = head.get("gauge_mm", math.nan)
    if isinstance(gauge, bool) or not isinstance(gauge, int | float) or not (math.isnan(gauge) or 100 <= gauge <= 5000):
        raise InputError(f"gauge_mm is {gauge!r}", file=file, column="table.gauge_mm", remedy="millimetres, e.g. 1435")
    entries: dict[str, list[dict[str, Any]]] = {}
    for kind in ("limit", "deviation", "class"):
        rows = content.get(kind, [])
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise InputError(f"{kind} is not a list of tables", file=file, remedy=f"write [[{kind}]]")
        entries[kind] = rows
    limits = tuple(_limit(row, file, f"limit {i + 1}") for i, row in enumerate(entries["limit"]))
    deviations = tuple(_limit(row, file, f"deviation {i + 1}") for i, row in enumerate(entries["deviation"]))
    classes = tuple(_class(row, file, f"class {i + 1}") for i, row in enumerate(entries["class"]))
    if not limits and not deviations and not classes:
        raise InputError("holds no limit", file=file, remedy="add [[limit]] entries; see the default table")
    combined = _combined(content["combined"], file) if "combined" in content else None
    return LimitTable(str(head.get("name", file)), gauge / 1e3, limits, deviations, classes, combined)


def _combined(row: Any, file: str | Path) -> Combination:
    """Weights of the combined standard deviation."""
    if not isinstance(row, dict):
        raise InputError("[combined] is not a table", file=file)
    status, source = _origin(row, file, "combined")
    weights: dict[str, float] = {}
    for key, value in row.items():
        if key in ("status", "source", "note"):
            continue
        if key not in COMBINABLE:
            raise InputError(
                f"unknown key {key!r}", file=file, column="combined", remedy=f"weigh {', '.join(COMBINABLE)}"
            )
        if not _number(value) or not 0.0 <= value <= 1e3:
            raise InputError(f"{value!r} is no weight", file=file, column=f"combined.{key}", remedy="0 to 1000")
        weights[key] = float(value)
    if not any(weights.values()):
        raise InputError("weighs nothing", file=file, column="combined", remedy=f"weigh {', '.join(COMBINABLE)}")
    return Combination(weights, status, source)


def _limit(row: dict[str, Any], file: str | Path, where: str) -> Limit:
    unknown = set(row) - _KEYS
    if unknown:
        raise InputError(
            f"unknown key {sorted(unknown)[0]!r}",
            file=file,
            column=where,
            remedy=f"keys are {', '.join(sorted(_KEYS))}",
        )
    channel, speed, status, source = _common(row, file, where)
    radius = _range(row.get("radius_m", [0.0, math.inf]), file, f"{where}.radius_m")
    levels: dict[str, tuple[float, float]] = {}
    scale = 1e-3 / _base(channel, file, where)
    for level in LEVELS:
        if level not in row:
            continue
        value = row[level]
        pair = value if isinstance(value, list) else [-value, value] if _number(value) else None
        if pair is None or len(pair) != 2 or not all(_number(v) for v in pair) or not pair[0] < 0 < pair[1]:
            raise InputError(
                f"{value!r} is no limit",
                file=file,
                column=f"{where}.{level}",
                remedy="a number, or [low, high] around 0",
            )
        levels[level] = (scale * float(pair[0]), scale * float(pair[1]))
    if not levels:
        raise InputError(
            "states no level", file=file, column=where, remedy=f"give {', '.join(LEVELS)}, or some of them"
        )
    for mild, severe in zip(list(levels)[:-1], list(levels)[1:], strict=True):
        if abs(levels[severe][0]) < abs(levels[mild][0]) or levels[severe][1] < levels[mild][1]:
            raise InputError(f"{severe} is milder than {mild}", file=file, column=where)
    return Limit(channel, speed, radius, levels, status, source)


def _class(row: dict[str, Any], file: str | Path, where: str) -> ClassLimit:
    unknown = set(row) - {"channel", "speed_kmh", "limits", "status", "source", "note"}
    if unknown:
        raise InputError(f"unknown key {sorted(unknown)[0]!r}", file=file, column=where)
    channel, speed, status, source = _common(row, file, where)
    values = row.get("limits")
    if (
        not isinstance(values, list)
        or len(values) != len(CLASSES) - 1
        or not all(_number(v) and v > 0 for v in values)
        or sorted(values) != values
    ):
        raise InputError(
            f"limits are {values!r}",
            file=file,
            column=where,
            remedy=f"{len(CLASSES) - 1} growing numbers, for A, B, C and D",
        )
    return ClassLimit(channel, speed, tuple(1e-3 * float(v) for v in values), status, source)


def _common(row: dict[str, Any], file: str | Path, where: str) -> tuple[str, tuple[float, float], str, str]:
    channel = row.get("channel")
    if not isinstance(channel, str) or not channel:
        raise InputError("names no channel", file=file, column=where, remedy='e.g. channel = "gauge"')
    low, high = _range(row.get("speed_kmh", [0.0, math.inf]), file, f"{where}.speed_kmh")
    return channel, (low / 3.6, high / 3.6), *_origin(row, file, where)


def _origin(row: dict[str, Any], file: str | Path, where: str) -> tuple[str, str]:
    """Status and source of an entry."""
    status = row.get("status", "own")
    if status not in STATUS:
        raise InputError(
            f"status {status!r} is not known", file=file, column=where, remedy=f"one of {', '.join(STATUS)}"
        )
    source = str(row.get("source", ""))
    if status != "own" and not source:
        raise InputError(f"is {status} but names no source", file=file, column=where, remedy="add source")
    return str(status), source


def _base(channel: str, file: str | Path, where: str) -> float:
    """Length that millimetres of this channel are over: the base of a twist, otherwise 1."""
    if not channel.startswith("twist_"):
        return 1.0
    try:
        base = float(channel.removeprefix("twist_").removesuffix("m"))
    except ValueError:
        base = math.nan
    if not 0.0 < base < 1e3:
        raise InputError(f"channel {channel!r} names no base", file=file, column=where, remedy='e.g. "twist_3m"')
    return base


def _range(value: Any, file: str | Path, where: str) -> tuple[float, float]:
    if (
        not isinstance(value, list)
        or len(value) != 2
        or not all(_number(v, infinite=True) for v in value)
        or not 0 <= value[0] < value[1]
    ):
        raise InputError(f"{value!r} is no range", file=file, column=where, remedy="[above, up to]")
    return float(value[0]), float(value[1])


def _number(value: Any, *, infinite: bool = False) -> bool:
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and not math.isnan(value)
        and (infinite or math.isfinite(value))
    )
