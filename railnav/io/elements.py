"""Track networks as elements: straights, arcs and transitions with the grid coordinates of their starts.

Lengths, radii and coordinates are those of the plane in which the alignment was designed, and `length_m` is a grid length;
the laws of the transitions stand in `railnav.io.design`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, InputError, TrackError
from railnav.geodesy.grid import frame_for_grid
from railnav.io.design import (
    ARC,
    BLOSS,
    CLOTHOID,
    COSINE,
    HELMERT,
    LARGEST_GAP,
    LARGEST_KINK,
    SAID_KINK,
    SINE,
    STRAIGHT,
    Cant,
    Plan,
    closing,
    integrate,
    lay,
)
from railnav.io.tables import Column, Table, read_table
from railnav.track.assembly import TrackSection, assemble
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: What repeats is said so often, then counted.
_MOST_NOTES = 20
#: Stations and lengths that agree within this are continuous, m.
SAME_STATION = 0.01

_KINDS = {
    "straight": STRAIGHT, "line": STRAIGHT, "tangent": STRAIGHT,
    "arc": ARC, "circle": ARC, "curve": ARC,
    "clothoid": CLOTHOID, "spiral": CLOTHOID,
    "bloss": BLOSS,
    "cosine": COSINE, "cosinusoid": COSINE,
    "sine": SINE, "sinusoid": SINE, "klein": SINE,
    "helmert": HELMERT, "schramm": HELMERT, "biquadratic": HELMERT,
}  # fmt: skip
_KNOWN = "straight, arc, clothoid, bloss, cosine, sine, helmert"


def plan_columns(known: str) -> tuple[Column, ...]:
    """Columns of a table of elements that say where each one lies and how it bends; `known` lists the kinds of elements."""
    return (
        Column("track", text=True, remedy="name the track in every row"),
        Column("sequence"),
        Column("start_m", low=-1e7, high=1e7),
        Column("length_m", positive=True, high=1e5),
        Column("element", text=True, remedy=f"one of {known}"),
        Column("radius_start_m", complete=False, infinite=True),
        Column("radius_end_m", complete=False, infinite=True),
        Column("easting_m"),
        Column("northing_m"),
        Column("grid_bearing_deg", low=-360.0, high=360.0),
    )


_COLUMNS = (
    *plan_columns(_KNOWN),
    Column("height_m", required=False, complete=False, low=-1000.0, high=10_000.0),
    Column("gradient", required=False, complete=False, low=-0.2, high=0.2),
    Column("cant_start_mm", required=False, complete=False, low=-500.0, high=500.0),
    Column("cant_end_mm", required=False, complete=False, low=-500.0, high=500.0),
    Column("line", required=False, complete=False, text=True),
    Column("name", required=False, complete=False, text=True),
)


@dataclass(frozen=True, slots=True, eq=False)
class _Elements:
    """The elements of one track in order: arrays (n,), m."""

    rows: IntArray
    start: FloatArray
    height: FloatArray
    gradient: FloatArray
    plan: Plan
    cant: Cant


def read_elements(path: str | Path, *, crs: Any, spacing: float = 1.0) -> TrackModel:
    """Read a track network from a table of elements.

    Parameters
    ----------
    path : path
        CSV (or Parquet) with the columns `track, sequence, start_m, length_m, element, radius_start_m, radius_end_m,
        easting_m, northing_m, grid_bearing_deg` of each element's start and, optionally, `height_m, gradient,
        cant_start_mm, cant_end_mm, line, name`. Radii are positive in a curve to the right and empty on a straight;
        `element` is straight, arc, clothoid, bloss, cosine, sine (Klein) or helmert (Schramm). `height_m` is a height of the plane
        (ellipsoidal, of its datum); `start_m` becomes the chainage.
    crs : str or pyproj.CRS
        The plane of the coordinates: "EPSG:31467", WKT, a PROJ string, "gk3", "gk6".
    spacing : float
        Wanted distance between the model's knots, m.

    Returns
    -------
    TrackModel
        `provenance["import"]` reports how the elements close at their joints.

    Raises
    ------
    InputError
        The table is missing or malformed; an element is of an unknown kind, its radii do not fit its kind, a sequence number
        stands twice; an element ends more than 0.1 m or 2 degrees from the start of the next one (the message says by how much).
    CrsError
        No such plane, or one without a usable transformation, or coordinates that do not lie in it.

    Notes
    -----
    Positions are integrated by 8-point Gauss-Legendre panels of at most 2 m, exact to 1e-9 m. What an element misses the
    next one's start by is spread evenly along it, so the stated coordinates hold. Heights run through the stated ones with the
    stated gradients, as cubics; without gradients, as a spline.

    References
    ----------
    Curvature laws: `spec/track_geometry.md`, section 3.1.

    Examples
    --------
    >>> read_elements("nowhere.csv", crs="EPSG:31467")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.csv: does not exist; check the name
    """
    path = Path(path)
    if not spacing > 0.0:
        raise InputError(f"knot spacing {spacing} m is not positive", file=path, remedy="use 1 m")
    table = read_table(path, _COLUMNS)
    kind, curvature_start, curvature_end = _laws(table)
    number = table.number
    try:
        frame = frame_for_grid(number["easting_m"], number["northing_m"], crs=crs)
    except CrsError as error:
        raise CrsError(f"{path}: {error}") from error

    def optional(name: str, scale: float = 1.0, absent: float = 0.0) -> FloatArray:
        values = number.get(name)
        return np.full(table.length, absent) if values is None else np.where(np.isnan(values), absent, values * scale)

    cant_start, cant_end = optional("cant_start_mm", 1e-3), optional("cant_end_mm", 1e-3)
    height, gradient = optional("height_m", absent=np.nan), optional("gradient", absent=np.nan)
    words = table.words
    line, name = (words[key].each() if key in words else [""] * table.length for key in ("line", "name"))
    sections: list[TrackSection] = []
    gaps: list[FloatArray] = []
    kinks: list[FloatArray] = []
    notes: list[str] = []
    for code, track in enumerate(words["track"].word):
        rows = np.flatnonzero(words["track"].code == code)
        rows = _in_order(table, track, rows)
        plan = Plan(
            number["length_m"][rows],
            kind[rows],
            curvature_start[rows],
            curvature_end[rows],
            number["easting_m"][rows],
            number["northing_m"][rows],
            np.radians(number["grid_bearing_deg"][rows]),
            np.zeros(len(rows)),
        )
        cant = Cant(plan.edges, cant_start[rows], cant_end[rows], plan.kind)
        elements = _Elements(rows, number["start_m"][rows], height[rows], gradient[rows], plan, cant)
        _check_heights(table, track, elements, notes)
        gap, kink = _closing(table, track, elements)
        for i in np.flatnonzero(np.abs(kink) > SAID_KINK):
            turn = np.degrees(abs(kink[i]))
            row = table.row_of(int(elements.rows[i + 1]))
            notes.append(f"track {track[:60]!r}, row {row}: the axis turns {turn:.2f} degrees at the joint")
        gaps.append(np.hypot(*gap[:-1].T))
        kinks.append(np.abs(kink[:-1]))
        try:
            ends, bearing = integrate(plan, plan.edges)
            level = np.append(elements.height, elements.height[-1])
            profile = _profile(elements, frame.ground_scale(ends[:, 0], ends[:, 1], level, bearing))
            laid = lay(frame, plan, gap=gap, profile=profile, cant=cant, spacing=spacing)
        except (CrsError, TrackError) as error:
            raise InputError(f"track {track[:60]!r}: {error}", file=path, row=table.row_of(int(rows[0]))) from error
        stations = np.append(elements.start, elements.start[-1] + plan.length[-1])
        posts = np.column_stack([laid.offset(plan.edges), stations])
        sections.append(
            TrackSection(
                track,
                laid.tables[0],
                line[rows[0]],
                name[rows[0]],
                float(posts[0, 1]),
                float(posts[-1, 1]),
                _needed(posts),
            )
        )
    gap_all, kink_all = np.concatenate(gaps), np.concatenate(kinks)
    provenance: dict[str, Any] = {
        "format": "elements",
        "source": path.name,
        "tracks": len(sections),
        "elements": table.length,
        "joints": len(gap_all),
        "notes": notes[:_MOST_NOTES] + ([f"and {len(notes) - _MOST_NOTES} more"] if len(notes) > _MOST_NOTES else []),
    }
    if len(gap_all):
        provenance |= {
            "largest_gap_m": float(gap_all.max()),
            "rms_gap_m": float(np.sqrt(np.mean(gap_all**2))),
            "largest_kink_deg": float(np.degrees(kink_all.max())),
        }
    return assemble(frame, sections, provenance={"import": provenance})


# --- what the rows say ------------------------------------------------------------------------------------------------


def _laws(table: Table) -> tuple[IntArray, FloatArray, FloatArray]:
    """Kind of every element and the curvatures at its ends, 1/m."""
    words = table.words["element"]
    kinds = np.array([_KINDS.get(word.strip().lower().replace("-", ""), -1) for word in words.word], dtype=np.int64)
    kind = kinds[words.code]
    if (kind < 0).any():
        i = int(np.argmax(kind < 0))
        table.refuse(i, "element", f"{words.word[words.code[i]][:40]!r} is no known element", f"use {_KNOWN}")
    ends = []
    for column in ("radius_start_m", "radius_end_m"):
        radius = table.number[column]
        small = np.abs(radius) < 5.0
        if small.any():
            i = int(np.argmax(small))
            table.refuse(
                i, column, f"a radius of {radius[i]:g} m", "leave the cell empty on a straight; radii are metres"
            )
        ends.append(np.where(np.isnan(radius), 0.0, 1.0 / np.where(np.isnan(radius), np.inf, radius)))
    k0, k1 = ends
    for i in np.flatnonzero((kind == STRAIGHT) & ((k0 != 0.0) | (k1 != 0.0)))[:1]:
        table.refuse(
            int(i), "radius_start_m" if k0[i] else "radius_end_m", "a straight with a radius", "leave it empty"
        )
    uneven = (kind == ARC) & ((k0 == 0.0) | (np.abs(k1 - k0) > 1e-6 * np.abs(k0)))
    for i in np.flatnonzero(uneven)[:1]:
        cause = "an arc without a radius" if k0[i] == 0.0 else "an arc with two radii"
        table.refuse(
            int(i), "radius_start_m" if k0[i] == 0.0 else "radius_end_m", cause, "name the transition, or one radius"
        )
    for i in np.flatnonzero((kind >= CLOTHOID) & (k0 == 0.0) & (k1 == 0.0))[:1]:
        table.refuse(int(i), "radius_start_m", "a transition from straight to straight", "give one of its radii")
    return kind, k0, k1


def _in_order(table: Table, track: str, rows: IntArray) -> IntArray:
    """Rows of a track by sequence number."""
    sequence = table.number["sequence"][rows]
    order = np.argsort(sequence, kind="stable")
    rows = rows[order]
    again = np.flatnonzero(np.diff(sequence[order]) == 0.0)
    if len(again):
        i = int(rows[again[0] + 1])
        number = table.number["sequence"][i]
        table.refuse(
            i, "sequence", f"{number:g} stands twice in track {track[:60]!r}", "number the elements of a track"
        )
    return rows


def _check_heights(table: Table, track: str, elements: _Elements, notes: list[str]) -> None:
    known = np.isfinite(elements.height)
    if known.any() and not known.all():
        i = int(elements.rows[np.argmin(known)])
        table.refuse(i, "height_m", f"is empty while track {track[:60]!r} has heights", "give all of a track or none")
    sloped = np.isfinite(elements.gradient)
    if sloped.any() and not known.any():
        notes.append(f"track {track[:60]!r}: gradients without heights passed over")
    elif sloped.any() and not sloped.all():
        i = int(elements.rows[np.argmin(sloped)])
        table.refuse(i, "gradient", f"is empty while track {track[:60]!r} has gradients", "give all of a track or none")


def _closing(table: Table, track: str, elements: _Elements) -> tuple[FloatArray, FloatArray]:
    """What each element misses the next one's start by: (n, 2) m, and bearing, rad; refuse what does not belong."""
    gap, kink = closing(elements.plan)
    apart = np.hypot(gap[:, 0], gap[:, 1])
    wrong = (apart > LARGEST_GAP) | (np.abs(kink) > LARGEST_KINK)
    if wrong.any():
        i = int(np.argmax(wrong))
        what = f"{apart[i]:.3f} m" if apart[i] > LARGEST_GAP else f"{np.degrees(abs(kink[i])):.2f} degrees"
        table.refuse(
            int(elements.rows[i]),
            "element",
            f"the element ends {what} from the start of the next one of track {track[:60]!r} (row "
            f"{table.row_of(int(elements.rows[i + 1]))})",
            "check its kind, length, radii and their signs (right is positive), and that all are of this plane",
        )
    return gap, kink


def _needed(posts: FloatArray) -> FloatArray | None:
    """Chainage at the inner joints where it is not continuous with the lengths around it."""
    if len(posts) < 3:
        return None
    jump = np.abs(np.diff(posts[:, 1]) - np.diff(posts[:, 0])) > SAME_STATION + 1e-3 * np.diff(posts[:, 0])
    keep = np.zeros(len(posts), bool)
    keep[:-1] |= jump
    keep[1:] |= jump
    keep[[0, -1]] = False
    return posts[keep] if keep.any() else None


# --- geometry ---------------------------------------------------------------------------------------------------------


def _profile(elements: _Elements, scale: FloatArray) -> Any:
    """Height and its slope by grid length, or None without heights; scale at the edges (n + 1,)."""
    from scipy.interpolate import CubicHermiteSpline, CubicSpline

    edges, height, gradient = elements.plan.edges, elements.height, elements.gradient
    if not np.isfinite(height).all():
        return None
    if np.isfinite(gradient).all():
        # the last element keeps its gradient; a gradient is rise over ground, a slope is rise over grid
        slope = np.append(gradient, gradient[-1]) / scale
        return CubicHermiteSpline(edges, np.append(height, height[-1] + slope[-1] * elements.plan.length[-1]), slope)
    if len(height) == 1:
        return CubicHermiteSpline(edges, np.repeat(height, 2), np.zeros(2))
    spline = CubicSpline(edges[:-1], height, bc_type="natural")
    slope = spline(edges[[*range(len(height)), -2]], 1)  # the last element keeps the gradient at its start
    return CubicHermiteSpline(edges, np.append(height, height[-1] + slope[-1] * elements.plan.length[-1]), slope)
