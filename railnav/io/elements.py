"""Track networks as elements: straights, arcs and transitions with the grid coordinates of their starts.

Lengths, radii and coordinates are those of the plane in which the alignment was designed: an arc is an arc in the grid, and
`length_m` is a grid length. Offsets of the model are true lengths on the ground all the same: grid length over the grid's
scale, joined with the rise. The curvature of an element runs by t = s/L from k0 to k1 as k0 + (k1 - k0) f(t), cant along
with it:

========= ============================================= ==========================================
element   f(t)                                          integral of f
========= ============================================= ==========================================
arc       0 (k0 = k1)                                   0
clothoid  t                                             t^2/2
bloss     3t^2 - 2t^3                                   t^3 - t^4/2
cosine    (1 - cos(pi t))/2                             t/2 - sin(pi t)/(2 pi)
sine      t - sin(2 pi t)/(2 pi)                        t^2/2 + (cos(2 pi t) - 1)/(4 pi^2)
helmert   2t^2, after the middle -1 + 4t - 2t^2         2t^3/3, 1/6 - t + 2t^2 - 2t^3/3
========= ============================================= ==========================================
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, InputError, TrackError
from railnav.geodesy.grid import GridFrame, frame_for_grid
from railnav.io.tables import Column, Table, read_table
from railnav.track.alignment import KnotTable
from railnav.track.assembly import TrackSection, assemble
from railnav.track.model import TrackModel
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: An element that ends further than this from the start of the next does not belong to it, m.
LARGEST_GAP = 0.10
#: Nor one that ends in a direction further than this from the next one's, rad.
LARGEST_KINK = np.radians(2.0)
#: A joint that turns by more than this is said, rad.
SAID_KINK = np.radians(0.1)
#: What repeats is said so often, then counted.
_MOST_NOTES = 20
#: Stations and lengths that agree within this are continuous, m.
SAME_STATION = 0.01

STRAIGHT, ARC, CLOTHOID, BLOSS, COSINE, SINE, HELMERT = range(7)

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

_COLUMNS = (
    Column("track", text=True, remedy="name the track in every row"),
    Column("sequence"),
    Column("start_m", low=-1e7, high=1e7),
    Column("length_m", positive=True, high=1e5),
    Column("element", text=True, remedy=f"one of {_KNOWN}"),
    Column("radius_start_m", complete=False, infinite=True),
    Column("radius_end_m", complete=False, infinite=True),
    Column("easting_m"),
    Column("northing_m"),
    Column("grid_bearing_deg", low=-360.0, high=360.0),
    Column("height_m", required=False, complete=False, low=-1000.0, high=10_000.0),
    Column("gradient", required=False, complete=False, low=-0.2, high=0.2),
    Column("cant_start_mm", required=False, complete=False, low=-500.0, high=500.0),
    Column("cant_end_mm", required=False, complete=False, low=-500.0, high=500.0),
    Column("line", required=False, complete=False, text=True),
    Column("name", required=False, complete=False, text=True),
)

#: Gauss-Legendre nodes and weights on [-1, 1].
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
#: Longest panel of the integration, m.
_PANEL = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class _Elements:
    """The elements of one track in order: arrays (n,), m, rad, 1/m."""

    rows: IntArray
    start: FloatArray
    length: FloatArray
    kind: IntArray
    curvature_start: FloatArray
    curvature_end: FloatArray
    easting: FloatArray
    northing: FloatArray
    grid_bearing: FloatArray
    height: FloatArray
    gradient: FloatArray
    cant_start: FloatArray
    cant_end: FloatArray

    @property
    def edges(self) -> FloatArray:
        """Grid lengths from the track's start to the elements' starts and the end, (n + 1,)."""
        return np.append(0.0, np.cumsum(self.length))


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

    columns = {
        "start": number["start_m"],
        "length": number["length_m"],
        "kind": kind,
        "curvature_start": curvature_start,
        "curvature_end": curvature_end,
        "easting": number["easting_m"],
        "northing": number["northing_m"],
        "grid_bearing": np.radians(number["grid_bearing_deg"]),
        "height": optional("height_m", absent=np.nan),
        "gradient": optional("gradient", absent=np.nan),
        "cant_start": optional("cant_start_mm", 1e-3),
        "cant_end": optional("cant_end_mm", 1e-3),
    }
    words = table.words
    line, name = (words[key].each() if key in words else [""] * table.length for key in ("line", "name"))
    sections: list[TrackSection] = []
    gaps: list[FloatArray] = []
    kinks: list[FloatArray] = []
    notes: list[str] = []
    for code, track in enumerate(words["track"].word):
        rows = np.flatnonzero(words["track"].code == code)
        rows = _in_order(table, track, rows)
        elements = _Elements(rows, **{key: values[rows] for key, values in columns.items()})
        _check_heights(table, track, elements, notes)
        gap, kink = _closing(table, track, elements)
        for i in np.flatnonzero(np.abs(kink) > SAID_KINK):
            turn = np.degrees(abs(kink[i]))
            row = table.row_of(int(elements.rows[i + 1]))
            notes.append(f"track {track!r}, row {row}: the axis turns {turn:.2f} degrees at the joint")
        gaps.append(np.hypot(gap[:, 0], gap[:, 1]))
        kinks.append(np.abs(kink))
        try:
            knots, at_edges = _tabulate(frame, elements, gap, spacing)
        except (CrsError, TrackError) as error:
            raise InputError(f"track {track!r}: {error}", file=path, row=table.row_of(int(rows[0]))) from error
        posts = np.column_stack([at_edges, np.append(elements.start, elements.start[-1] + elements.length[-1])])
        sections.append(
            TrackSection(
                track, knots, line[rows[0]], name[rows[0]], float(posts[0, 1]), float(posts[-1, 1]), _needed(posts)
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
        table.refuse(i, "sequence", f"{number:g} stands twice in track {track!r}", "number the elements of a track")
    return rows


def _check_heights(table: Table, track: str, elements: _Elements, notes: list[str]) -> None:
    known = np.isfinite(elements.height)
    if known.any() and not known.all():
        i = int(elements.rows[np.argmin(known)])
        table.refuse(i, "height_m", f"is empty while track {track!r} has heights", "give all of a track or none")
    sloped = np.isfinite(elements.gradient)
    if sloped.any() and not known.any():
        notes.append(f"track {track!r}: gradients without heights passed over")
    elif sloped.any() and not sloped.all():
        i = int(elements.rows[np.argmin(sloped)])
        table.refuse(i, "gradient", f"is empty while track {track!r} has gradients", "give all of a track or none")


def _closing(table: Table, track: str, elements: _Elements) -> tuple[FloatArray, FloatArray]:
    """What each element misses the next one's start by: (n - 1, 2) m, and bearing, rad; refuse what does not belong."""
    if len(elements.length) == 1:
        return np.empty((0, 2)), np.empty(0)
    inside = np.arange(len(elements.length) - 1)
    points, _ = _integrate(elements, elements.edges)
    ends = points[np.searchsorted(elements.edges, elements.edges[1:-1])]
    gap = np.column_stack([elements.easting[1:], elements.northing[1:]]) - ends
    turned = elements.grid_bearing[:-1] + _turn(elements, inside, elements.length[:-1])
    kink = wrap_angle(elements.grid_bearing[1:] - turned)
    apart = np.hypot(gap[:, 0], gap[:, 1])
    wrong = (apart > LARGEST_GAP) | (np.abs(kink) > LARGEST_KINK)
    if wrong.any():
        i = int(np.argmax(wrong))
        what = f"{apart[i]:.3f} m" if apart[i] > LARGEST_GAP else f"{np.degrees(abs(kink[i])):.2f} degrees"
        table.refuse(
            int(elements.rows[i]),
            "element",
            f"the element ends {what} from the start of the next one of track {track!r} (row "
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


def _share(kind: IntArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The curvature law f(t) of each kind and its integral from 0."""
    f, whole = np.zeros_like(t), np.zeros_like(t)
    for law in np.unique(kind):
        at = kind == law
        u = t[at]
        if law == CLOTHOID:
            f[at], whole[at] = u, u * u / 2.0
        elif law == BLOSS:
            f[at], whole[at] = u * u * (3.0 - 2.0 * u), u**3 - u**4 / 2.0
        elif law == COSINE:
            f[at], whole[at] = (1.0 - np.cos(np.pi * u)) / 2.0, u / 2.0 - np.sin(np.pi * u) / (2.0 * np.pi)
        elif law == SINE:
            f[at] = u - np.sin(2.0 * np.pi * u) / (2.0 * np.pi)
            whole[at] = u * u / 2.0 + (np.cos(2.0 * np.pi * u) - 1.0) / (4.0 * np.pi**2)
        elif law == HELMERT:
            f[at] = np.where(u < 0.5, 2.0 * u * u, -1.0 + 4.0 * u - 2.0 * u * u)
            whole[at] = np.where(u < 0.5, 2.0 * u**3 / 3.0, 1.0 / 6.0 - u + 2.0 * u * u - 2.0 * u**3 / 3.0)
    return f, whole


def _turn(elements: _Elements, which: IntArray, s: FloatArray) -> FloatArray:
    """Change of bearing from the start of elements `which` over s metres of them, rad."""
    length, k0, k1 = elements.length[which], elements.curvature_start[which], elements.curvature_end[which]
    _, whole = _share(elements.kind[which], s / length)
    return np.asarray(k0 * s + (k1 - k0) * length * whole)


def _integrate(elements: _Elements, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Position (m, 2) and bearing (m,) where each element, laid from its own stated start, has run to grid length `at`.

    A joint belongs to the element that ends there.
    """
    edges = elements.edges
    halves = edges[:-1] + 0.5 * elements.length  # the Helmert law has a break in the middle
    stops = np.unique(np.concatenate([edges, halves, at]))
    pieces = np.maximum(1, np.ceil(np.diff(stops) / _PANEL).astype(np.int64))
    first = np.repeat(np.append(0, np.cumsum(pieces)[:-1]), pieces)
    share = (np.arange(pieces.sum()) - first) / np.repeat(pieces, pieces)
    begin = np.repeat(stops[:-1], pieces) + share * np.repeat(np.diff(stops), pieces)
    width = np.repeat(np.diff(stops) / pieces, pieces)
    which = np.clip(np.searchsorted(edges, begin + 0.5 * width) - 1, 0, len(elements.length) - 1)
    s = (begin - edges[which])[:, None] + 0.5 * width[:, None] * (1.0 + _NODES)
    deep = np.repeat(which[:, None], len(_NODES), axis=1)
    bearing = elements.grid_bearing[which][:, None] + _turn(elements, deep, s)
    step_e = 0.5 * width * (np.sin(bearing) @ _WEIGHTS)
    step_n = 0.5 * width * (np.cos(bearing) @ _WEIGHTS)
    run = np.column_stack([np.append(0.0, np.cumsum(step_e)), np.append(0.0, np.cumsum(step_n))])
    border = np.append(begin, stops[-1])  # run is the sum of all panels up to each border
    owner = np.clip(np.searchsorted(edges, at, side="left") - 1, 0, len(elements.length) - 1)
    here, origin = run[np.searchsorted(border, at)], run[np.searchsorted(border, edges[owner])]
    points = np.column_stack([elements.easting[owner], elements.northing[owner]]) + here - origin
    return points, elements.grid_bearing[owner] + _turn(elements, owner, at - edges[owner])


def _profile(elements: _Elements, scale: FloatArray) -> Any:
    """Height and its slope by grid length: a callable (l, derivative) or None without heights; scale at the edges (n + 1,)."""
    from scipy.interpolate import CubicHermiteSpline, CubicSpline

    edges, height, gradient = elements.edges, elements.height, elements.gradient
    if not np.isfinite(height).all():
        return None
    if np.isfinite(gradient).all():
        # the last element keeps its gradient; a gradient is rise over ground, a slope is rise over grid
        slope = np.append(gradient, gradient[-1]) / scale
        return CubicHermiteSpline(edges, np.append(height, height[-1] + slope[-1] * elements.length[-1]), slope)
    if len(height) == 1:
        return CubicHermiteSpline(edges, np.repeat(height, 2), np.zeros(2))
    spline = CubicSpline(edges[:-1], height, bc_type="natural")
    slope = spline(edges[[*range(len(height)), -2]], 1)  # the last element keeps the gradient at its start
    return CubicHermiteSpline(edges, np.append(height, height[-1] + slope[-1] * elements.length[-1]), slope)


def _tabulate(frame: GridFrame, elements: _Elements, gap: FloatArray, spacing: float) -> tuple[KnotTable, FloatArray]:
    """Knots by true ground length, and the offsets of the elements' edges (n + 1,)."""
    edges = elements.edges
    at_ends, bearing = _integrate(elements, edges)
    level = np.append(elements.height, elements.height[-1])
    profile = _profile(elements, frame.ground_scale(at_ends[:, 0], at_ends[:, 1], level, bearing))

    # true length: ground metres per grid metre on a grid of 1 m, Simpson between
    count = np.maximum(1, np.ceil(elements.length).astype(np.int64))
    fine = np.append(
        np.concatenate(
            [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(edges, edges[1:], count, strict=False)]
        ),
        edges[-1],
    )
    coarse = np.linspace(0.0, edges[-1], max(2, int(edges[-1] / 50.0) + 2))  # scale changes by under 1e-10 within 50 m
    points, bearing = _integrate(elements, coarse)
    height = np.zeros(len(coarse)) if profile is None else profile(coarse)
    scale = frame.ground_scale(points[:, 0], points[:, 1], height, bearing)

    def rate(at: FloatArray) -> FloatArray:
        """Ground metres per grid metre."""
        slope = 0.0 if profile is None else profile(at, 1)
        return np.hypot(1.0 / np.interp(at, coarse, scale), slope)

    middle, width = 0.5 * (fine[:-1] + fine[1:]), np.diff(fine)
    panels = width * (rate(fine[:-1]) + 4.0 * rate(middle) + rate(fine[1:])) / 6.0
    if len(gap):  # the stated starts hold, so an element is as much longer as it misses the next one along its way
        chord = at_ends[1:-1] - np.column_stack([elements.easting, elements.northing])[:-1]
        longer = (gap * chord).sum(axis=1) / (np.hypot(chord[:, 0], chord[:, 1]) * elements.length[:-1])
        panels *= 1.0 + np.append(longer, 0.0)[np.clip(np.searchsorted(edges, middle) - 1, 0, len(longer))]
    run = np.append(0.0, np.cumsum(panels))
    at_edges = run[np.searchsorted(fine, edges)]

    n = max(2, round(run[-1] / spacing) + 1)
    offset = np.linspace(0.0, run[-1], n)
    at = np.interp(offset, run, fine)
    at[-1] = edges[-1]
    points, bearing = _integrate(elements, at)
    owner = np.clip(np.searchsorted(edges, at, side="left") - 1, 0, len(elements.length) - 1)
    share = (at - edges[owner]) / elements.length[owner]
    if len(gap):  # and what it misses the next one by is spread along it
        points += np.append(gap, np.zeros((1, 2)), axis=0)[owner] * share[:, None]
    f, _ = _share(elements.kind[owner], share)
    k0, k1 = elements.curvature_start[owner], elements.curvature_end[owner]
    c0, c1 = elements.cant_start[owner], elements.cant_end[owner]
    ramp = np.where(elements.kind[owner] >= CLOTHOID, f, share)  # cant runs with the curvature of a transition
    here = np.interp(at, coarse, scale)
    knots = KnotTable(
        offset=offset,
        easting=points[:, 0],
        northing=points[:, 1],
        height=np.full(n, np.nan) if profile is None else profile(at),
        grid_bearing=wrap_angle(bearing),
        curvature=(k0 + (k1 - k0) * f) / rate(at),
        gradient=np.zeros(n) if profile is None else profile(at, 1) * here,
        cant=c0 + (c1 - c0) * ramp,
        scale=here,
        covariance_g=np.full((n, 6), np.nan),
    )
    return knots, at_edges
