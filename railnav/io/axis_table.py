"""Track axes as a table of alignment points (Mannheim's trams): radius, clothoid parameter, azimuth, coordinates at each.

A row is a point of a track `n`; the element that begins there runs to the next row: an arc of radius `R` (0 straight, positive
to the right), or with `cl` a clothoid of that parameter A from `R` to the next row's `R`, its length A^2 |1/R' - 1/R|. `tang`
is the azimuth in gon, `rw` and `hw` (Rechtswert, Hochwert) are easting and northing, `ds` is the length of the element that
ends in the row. Which tracks meet is not given: ends are projected onto the other tracks.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, InputError
from railnav.geodesy.grid import frame_for_grid
from railnav.io.design import ARC, CLOTHOID, LARGEST_GAP, LARGEST_KINK, SAID_KINK, STRAIGHT, Laid, Plan, closing
from railnav.io.junctions import Design, join_designs
from railnav.io.tables import Column, Table, read_table
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Stations and lengths, clothoid parameters and radii agree within this, m and as a share.
_AGREE = 0.01
#: What one repeats while reading is said so often, then counted.
_MOST_NOTES = 20
#: Rows of a track nearer than this are one point, m.
_NOTHING = 1e-3

_COLUMNS = (
    Column("n", text=True, remedy="name the track in every row"),
    Column("s", low=-1e7, high=1e7),
    Column("ds", low=0.0, high=1e5),
    Column("R", low=-1e7, high=1e7),
    Column("cl", low=0.0, high=1e6),
    Column("tang", low=-400.0, high=800.0),
    Column("rw"),
    Column("hw"),
)
#: What the header of such a table holds.
AXIS_COLUMNS = frozenset(column.name for column in _COLUMNS)


def read_axis_table(path: str | Path, *, crs: Any, spacing: float = 1.0) -> TrackModel:
    """Read track axes from a table of alignment points, and join them where one ends on another.

    Parameters
    ----------
    path : path
        CSV (or Parquet) with the columns `n, s, ds, R, cl, tang, rw, hw`; others are left alone.
    crs : str or pyproj.CRS
        The plane of the coordinates: "EPSG:31467", WKT, a PROJ string, "gk3", "gk6".
    spacing : float
        Wanted distance between the model's knots, m.

    Returns
    -------
    TrackModel
        Without heights. The track is `n`, in parts `n.1`, `n.2` where others end on it; `s` becomes chainage.
        `provenance["import"]` reports how elements close, which ends were joined by projection, and what was noted.

    Raises
    ------
    InputError
        The table is missing or malformed; a track has one row only, or `s` does not grow; a length does not fit `s`, or a
        clothoid its parameter; an element ends more than 0.1 m or 2 degrees from the start of the next one.
    CrsError
        No such plane, or coordinates that do not lie in it.

    Examples
    --------
    >>> read_axis_table("nowhere.csv", crs="EPSG:31467")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.csv: does not exist; check the name
    """
    path = Path(path)
    if not spacing > 0.0:
        raise InputError(f"knot spacing {spacing} m is not positive", file=path, remedy="use 1 m")
    table = read_table(path, _COLUMNS)
    try:
        frame = frame_for_grid(table.number["rw"], table.number["hw"], crs=crs)
    except CrsError as error:
        raise CrsError(f"{path}: {error}") from error
    notes: list[str] = []
    designs: list[Design] = []
    gaps: list[FloatArray] = []
    kinks: list[FloatArray] = []
    words = table.words["n"]
    for code, track in enumerate(words.word):
        rows = np.flatnonzero(words.code == code)
        plan, gap, kink, stations = _read_track(table, track, rows, notes)
        designs.append(Design(track, plan, gap, _posts(plan, stations)))
        gaps.append(np.hypot(gap[:, 0], gap[:, 1]))
        kinks.append(np.abs(kink))
    gap_all, kink_all = np.concatenate(gaps), np.concatenate(kinks)
    provenance: dict[str, Any] = {
        "format": "axis table",
        "source": path.name,
        "tracks": len(designs),
        "elements": sum(len(design.plan.length) for design in designs),
        "joints": len(gap_all),
        "largest_gap_m": float(gap_all.max(initial=0.0)),
        "rms_gap_m": float(np.sqrt(np.mean(gap_all**2))) if len(gap_all) else 0.0,
        "largest_kink_deg": float(np.degrees(kink_all.max(initial=0.0))),
        "notes": notes[:_MOST_NOTES] + ([f"and {len(notes) - _MOST_NOTES} more"] if len(notes) > _MOST_NOTES else []),
    }
    return join_designs(path, frame, designs, spacing=spacing, provenance=provenance)


def _read_track(
    table: Table, track: str, rows: IntArray, notes: list[str]
) -> tuple[Plan, FloatArray, FloatArray, FloatArray]:
    """Elements of one track, what they miss each other by (the last: what it misses the last row), and stations."""
    number = table.number
    if len(rows) < 2:
        table.refuse(int(rows[0]), "n", f"track {track[:60]!r} has one point only", "a track needs two")
    back = np.flatnonzero(np.diff(number["s"][rows]) < 0.0)
    if len(back):
        table.refuse(
            int(rows[back[0] + 1]), "s", f"stations of track {track[:60]!r} do not grow", "order the rows by s"
        )
    far = np.flatnonzero(np.abs(np.diff(number["s"][rows]) - number["ds"][rows[1:]]) > _AGREE)
    if len(far):
        i = int(rows[far[0] + 1])
        table.refuse(
            i, "ds", f"a length of {number['ds'][i]:g} m does not lead from the last s to this one", "correct s or ds"
        )
    repeated = number["ds"][rows[1:]] < _NOTHING
    if repeated.any():
        notes.append(f"track {track[:60]!r}: {int(repeated.sum())} rows without length passed over")
        rows = rows[np.append(~repeated, True)]  # of two rows at one point, the later tells what begins there
    if len(rows) < 2:
        table.refuse(int(rows[0]), "ds", f"track {track[:60]!r} has no length", "remove it")
    radius, parameter, length = number["R"][rows], number["cl"][rows][:-1], number["ds"][rows[1:]]
    small = np.flatnonzero((radius != 0.0) & (np.abs(radius) < 5.0))
    if len(small):
        i = int(rows[small[0]])
        table.refuse(i, "R", f"a radius of {number['R'][i]:g} m", "radii are metres; a straight has 0")
    bend = np.where(radius == 0.0, 0.0, 1.0 / np.where(radius == 0.0, 1.0, radius))
    spiral = parameter > 0.0
    k0, k1 = bend[:-1], np.where(spiral, bend[1:], bend[:-1])
    wanted = np.abs(k1 - k0) * parameter**2
    wrong = np.flatnonzero(spiral & (np.abs(wanted - length) > _AGREE * length + 0.1))
    if len(wrong):
        i = int(wrong[0])
        table.refuse(
            int(rows[i]),
            "cl",
            f"a clothoid of parameter {parameter[i]:g} between these radii is {wanted[i]:.3f} m long, not {length[i]:g} m",
            "correct cl, ds or the next row's R",
        )
    plan = Plan(
        length,
        np.where(spiral, CLOTHOID, np.where(k0 == 0.0, STRAIGHT, ARC)),
        k0,
        k1,
        number["rw"][rows][:-1],
        number["hw"][rows][:-1],
        np.radians(0.9 * number["tang"][rows][:-1]),
        np.zeros(len(length)),
    )
    last = rows[-1]
    gap, kink = closing(
        plan,
        end=np.array([number["rw"][last], number["hw"][last]]),
        end_bearing=float(np.radians(0.9 * number["tang"][last])),
    )
    apart = np.hypot(gap[:, 0], gap[:, 1])
    for i in range(len(length)):
        if apart[i] > LARGEST_GAP or abs(kink[i]) > LARGEST_KINK:
            what = f"{apart[i]:.3f} m" if apart[i] > LARGEST_GAP else f"{np.degrees(abs(kink[i])):.2f} degrees"
            table.refuse(
                int(rows[i]),
                "R",
                f"the element ends {what} from the next row of track {track[:60]!r} (row {table.row_of(int(rows[i + 1]))})",
                "check R, cl, ds and tang of both, and that rw is easting and hw northing",
            )
        if abs(kink[i]) > SAID_KINK:
            row = table.row_of(int(rows[i + 1]))
            notes.append(
                f"track {track[:60]!r}, row {row}: the axis turns {np.degrees(abs(kink[i])):.2f} degrees at the joint"
            )
    return plan, gap, kink, number["s"][rows]


def _posts(plan: Plan, stations: FloatArray) -> Callable[[Laid], FloatArray]:
    return lambda laid: np.column_stack([laid.offset(plan.edges), stations])[[0, -1]]
