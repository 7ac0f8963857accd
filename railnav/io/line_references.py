"""Line references in files: two tables of a model's GeoPackage, and a CSV of kilometres to bring them in.

`kilometres`: one row a kilometre in order along its line; `line_positions`: one row an anchor of a line on a track. Both may be
corrected by hand, in QGIS or SQL, and are checked when they are read.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError, TrackError
from railnav.io.container import Container, Reader
from railnav.io.tables import Column, read_table
from railnav.track.chainage import LineReference, LineReferences

FloatArray = NDArray[np.float64]

KILOMETRES = "kilometres"
POSITIONS = "line_positions"
KILOMETRE_COLUMNS = ("line", "label", "start_m", "end_m", "counted_m", "unit_m")
POSITION_COLUMNS = ("track", "line", "offset_m", "position_m")


def kilometre_rows(references: LineReferences) -> list[tuple[Any, ...]]:
    """Rows of the table of kilometres, in the order of `KILOMETRE_COLUMNS`."""
    return [
        (line.line, int(label), float(start), float(end), float(counted), float(line.unit))
        for line in references.lines
        for label, start, end, counted in zip(line.label, line.start[:-1], line.start[1:], line.counted, strict=True)
    ]


def position_rows(references: LineReferences, track_id: Sequence[str]) -> list[tuple[Any, ...]]:
    """Rows of the table of anchors, in the order of `POSITION_COLUMNS`."""
    return [
        (track_id[track], references.lines[line].line, float(offset), float(position))
        for track, line, offset, position in zip(
            references.track.tolist(), references.line.tolist(), references.offset, references.position, strict=True
        )
    ]


def references_of_rows(
    kilometres: Iterable[Sequence[Any]], positions: Iterable[Sequence[Any]], track_id: Sequence[str]
) -> LineReferences:
    """Line references of rows as `kilometre_rows` and `position_rows` give them.

    Raises
    ------
    TrackError
        A cell that is none, kilometres that do not follow each other, or an anchor of a track or line that there is not.
    """
    by_line: dict[str, list[Sequence[Any]]] = {}
    for row in kilometres:
        _check(row, KILOMETRE_COLUMNS, KILOMETRES, texts=1)
        by_line.setdefault(str(row[0]), []).append(row)
    lines = []
    for name, rows in by_line.items():
        table = np.array([[float(cell) for cell in row[1:]] for row in rows])
        gap = np.flatnonzero(np.abs(table[1:, 1] - table[:-1, 2]) > 1e-6)
        if len(gap):
            raise TrackError(
                f"line {name!r}: kilometre {table[gap[0] + 1, 0]:g} does not begin where kilometre {table[gap[0], 0]:g} ends"
            )
        start = np.append(table[:, 1], table[-1, 2])
        lines.append(LineReference(name, table[:, 0].astype(np.int64), start, table[:, 3].copy(), float(table[0, 4])))
    tracks = {name: i for i, name in enumerate(track_id)}
    places = {line.line: i for i, line in enumerate(lines)}
    anchors = []
    for row in positions:
        _check(row, POSITION_COLUMNS, POSITIONS, texts=2)
        for cell, known, what in ((row[0], tracks, "track"), (row[1], places, "line of the table kilometres")):
            if cell not in known:
                raise TrackError(f"{POSITIONS}: {str(cell)[:40]!r} is no {what}")
        anchors.append((tracks[row[0]], places[row[1]], float(row[2]), float(row[3])))
    anchors.sort()
    columns: list[list[Any]] = [list(column) for column in zip(*anchors, strict=True)] if anchors else [[], [], [], []]
    return LineReferences(
        tuple(lines),
        np.array(columns[0], np.int64),
        np.array(columns[1], np.int64),
        np.array(columns[2], np.float64),
        np.array(columns[3], np.float64),
    )


def _check(row: Sequence[Any], columns: Sequence[str], table: str, *, texts: int) -> None:
    for i, (cell, column) in enumerate(zip(row, columns, strict=True)):
        if i < texts:
            if not isinstance(cell, str):
                raise TrackError(f"{table}.{column}: {cell!r:.40} is no text")
        elif isinstance(cell, bool) or not isinstance(cell, int | float) or not abs(cell) < np.inf:
            raise TrackError(f"{table}.{column}: {cell!r:.40} is no finite number")


# --- GeoPackage ---------------------------------------------------------------------------------------------------------


def write_references(container: Container, references: LineReferences, track_id: Sequence[str]) -> None:
    """Add both tables to a model that has line references."""
    if not len(references):
        return
    container.add_table(
        KILOMETRES,
        "line TEXT NOT NULL, label INTEGER NOT NULL, start_m DOUBLE NOT NULL, end_m DOUBLE NOT NULL, "
        "counted_m DOUBLE NOT NULL, unit_m DOUBLE NOT NULL",
        ((fid, *row) for fid, row in enumerate(kilometre_rows(references), 1)),
        description="Published kilometres of each line: true positions and the metres counted in each",
    )
    container.add_table(
        POSITIONS,
        "track TEXT NOT NULL, line TEXT NOT NULL, offset_m DOUBLE NOT NULL, position_m DOUBLE NOT NULL",
        ((fid, *row) for fid, row in enumerate(position_rows(references, track_id), 1)),
        description="Where lines lie on tracks: offset on the track, position on the line; linear in between",
    )


def read_references(reader: Reader, track_id: Sequence[str]) -> LineReferences:
    """Read both tables; a model without them has no line references."""
    if not {KILOMETRES, POSITIONS} & reader.tables():
        return LineReferences()
    kilometres = reader.select(KILOMETRES, KILOMETRE_COLUMNS)
    positions = reader.select(POSITIONS, POSITION_COLUMNS)
    try:
        return references_of_rows(kilometres, positions, track_id)
    except TrackError as error:
        reader.refuse(str(error), remedy="correct the table, or make the model again")


# --- CSV ----------------------------------------------------------------------------------------------------------------


def read_kilometres(path: str | Path, *, stretched: bool = False) -> list[LineReference]:
    """Read the kilometre tables of lines.

    Parameters
    ----------
    path : path
        .csv or .parquet: `line` (may be left out where there is one), `km` (label), `length_m` (true length), and
        `counted_m` (metres counted in it) where the two differ; rows in the order along the line.
    stretched : bool
        Every kilometre counts 1000 m, whatever it measures; where `counted_m` does not say otherwise.

    Returns
    -------
    list of LineReference

    Raises
    ------
    InputError
        A missing file or column, a kilometre that is no whole number or stands twice, or one without length.
    """
    path = Path(path)
    columns = [
        Column("line", required=False, complete=False, text=True),
        Column("km", low=-1e6, high=1e6),
        Column("length_m", positive=True, high=1e6),
        Column("counted_m", required=False, complete=False, positive=True, high=1e6),
    ]
    table = read_table(path, columns)
    km, length = table.number["km"], table.number["length_m"]
    for i in np.flatnonzero(km % 1.0):
        table.refuse(int(i), "km", f"{km[i]:g} is no whole kilometre", "give the label of the kilometre")
    counted = table.number.get("counted_m", np.full(len(km), np.nan))
    counted = np.where(np.isnan(counted), 1000.0 if stretched else length, counted)
    words = table.words.get("line")
    names = [""] * len(km) if words is None else [words.word[c] if c >= 0 else "" for c in words.code.tolist()]
    found = []
    for name in dict.fromkeys(names):
        rows = np.array([i for i, other in enumerate(names) if other == name])
        start = np.concatenate([[0.0], np.cumsum(length[rows])])
        try:
            found.append(LineReference(name, km[rows].astype(np.int64), start, counted[rows].copy()))
        except TrackError as error:
            raise InputError(str(error), file=path) from error
    return found
