"""A plane in a file of its own: TOML with the pinned transformation, and what the fit behind it said.

`[frame]` (or several `[[frame]]`, the sections of a long line) holds name, crs_wkt, pipeline, operation, accuracy_m; everything
else is report. Verbs take such a file as `--crs frame.toml`, or `--crs frame.toml:2` for its second section.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from railnav.errors import CrsError, InputError
from railnav.geodesy.plane import GridFrame
from railnav.io.atomic import atomic_path

#: A frame file larger than this is refused.
MAX_BYTES = 10_000_000

_KEYS = ("name", "crs_wkt", "pipeline", "operation")
_SECTION = re.compile(r"^(?P<path>.*\.toml)(?::(?P<section>\d{1,4}))?$", re.I)


def names_frame_file(crs: str) -> bool:
    """Whether a plane is named by a frame file.

    Examples
    --------
    >>> names_frame_file("tver.toml"), names_frame_file("line.toml:2"), names_frame_file("EPSG:28407")
    (True, True, False)
    """
    return _SECTION.match(crs.strip()) is not None


def read_frame(path: str | Path) -> GridFrame:
    """Read a plane that `railnav datum` or `railnav corridor` wrote.

    Parameters
    ----------
    path : path
        The file; with ":2" behind it the second of its sections.

    Returns
    -------
    GridFrame
        As it was written; its pipeline has been tried.

    Raises
    ------
    InputError
        The file is missing, no TOML, without a frame, or holds several and none is named.

    Examples
    --------
    >>> read_frame("nowhere.toml")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.toml: no such file
    """
    match = _SECTION.match(str(path))
    section = int(match["section"]) if match and match["section"] else None
    file = Path(match["path"]) if match else Path(path)
    frames = read_frames(file)
    if section is None and len(frames) > 1:
        raise InputError(
            f"holds {len(frames)} sections", file=file, remedy=f"name one of them, {file}:1 to {file}:{len(frames)}"
        )
    if section is not None and not 1 <= section <= len(frames):
        raise InputError(f"has no section {section}", file=file, remedy=f"it has {len(frames)}")
    return frames[(section or 1) - 1]


def read_frames(path: str | Path) -> list[GridFrame]:
    """Read every plane of a frame file, in order; see `read_frame`."""
    path = Path(path)
    if not path.is_file():
        raise InputError("no such file", file=path)
    if path.stat().st_size > MAX_BYTES:
        raise InputError("is too long for a frame file", file=path)
    try:
        document = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"is no TOML ({error})", file=path) from error
    tables = document.get("frame")
    tables = [tables] if isinstance(tables, dict) else tables
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise InputError(
            "the table [frame] is missing", file=path, remedy="make it with railnav datum or railnav corridor"
        )
    return [_frame(table, path) for table in tables]


def _frame(table: dict[str, Any], path: Path) -> GridFrame:
    for key in _KEYS:
        if not isinstance(table.get(key), str) or not table[key].strip():
            raise InputError("is missing or no text", file=path, column=f"frame.{key}", remedy="make the file again")
    accuracy = table.get("accuracy_m")
    if isinstance(accuracy, bool) or not isinstance(accuracy, int | float) or not 0 <= accuracy < math.inf:
        raise InputError(f"{accuracy!r} is no accuracy", file=path, column="frame.accuracy_m")
    from railnav.geodesy.projection import projection_of
    from railnav.geodesy.transformation import transformer

    try:
        transformer(table["pipeline"])
        projection_of(table["pipeline"])
    except CrsError as error:
        raise InputError(str(error), file=path, column="frame.pipeline", remedy="make the file again") from error
    return GridFrame(table["crs_wkt"], table["name"], table["pipeline"], table["operation"], float(accuracy))


def write_frames(
    path: str | Path,
    frames: Sequence[GridFrame],
    *,
    heading: str = "",
    facts: Sequence[Mapping[str, Any]] = (),
    tables: Mapping[str, Sequence[Mapping[str, Any]]] | None = None,
) -> None:
    """Write planes to a frame file, whole or not at all.

    Parameters
    ----------
    path : path
        File to write, .toml.
    frames : sequence of GridFrame
        One, or the sections of a line in order.
    heading : str
        Said in the first line.
    facts : sequence of mapping, optional
        Further keys of each frame: texts, numbers, lists of numbers.
    tables : mapping, optional
        Further lists of tables: name to rows.

    Examples
    --------
    >>> import tempfile, numpy as np
    >>> from railnav.geodesy import choose_frame
    >>> plane = choose_frame(np.radians(47.5), np.radians(21.0))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_frames(f"{folder}/gk.toml", [plane])
    ...     read_frame(f"{folder}/gk.toml") == plane
    True
    """
    from railnav import __version__

    lines = [f"# {line}" for line in (f"railnav {__version__}: {heading}".rstrip(": ")).splitlines()]
    single = len(frames) == 1
    for i, frame in enumerate(frames):
        values = {
            "name": frame.name,
            "crs_wkt": frame.crs_wkt,
            "pipeline": frame.pipeline,
            "operation": frame.operation,
            "accuracy_m": frame.accuracy,
            **(facts[i] if i < len(facts) else {}),
        }
        lines += [
            "",
            "[frame]" if single else "[[frame]]",
            *(f"{key} = {_toml(value)}" for key, value in values.items()),
        ]
    for name, rows in (tables or {}).items():
        for row in rows:
            lines += [
                "",
                f"[[{name}]]",
                *(f"{key} = {_toml(value)}" for key, value in row.items() if value is not None),
            ]
    with atomic_path(path) as draft:
        draft.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, Sequence):
        return f"[{', '.join(_toml(item) for item in value)}]"
    number = float(value)
    return repr(number) if math.isfinite(number) else ("nan" if math.isnan(number) else "inf" if number > 0 else "-inf")
