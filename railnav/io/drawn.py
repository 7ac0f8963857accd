"""Drawn lines: polylines of metre accuracy become straights joined by arcs, never further from the drawing than stated.

A cubic spline through the vertices of a drawn line swings out beside every kink. Here each corner is cut by the arc that
touches both segments and passes the vertex at no more than `within`, so the curve stays inside the drawn corner; at the ends a
stated direction is met by two arcs that leave the first segment by no more than `within`. Directions are continuous and so
are positions; curvature steps from arc to arc.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.geodesy.grid import GridFrame
from railnav.track.alignment import KnotTable, fit_alignment
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]

#: Vertices of a line whose directions turn by less than this at each are points of a curve, not corners of a drawing, rad.
SURVEYED_TURN = np.radians(4.0)
#: A rounded curve stays this near to a drawing with corners, m.
WITHIN = 0.3
#: Vertices nearer than this are one, m.
_SAME_VERTEX = 0.05

#: Bends that differ by more than this meet in a knot, 1/m.
_BEND_STEP = 2e-3
#: Knots nearer than this are one, m.
_SAME_KNOT = 0.05
#: Turns smaller than this are none, rad.
_NO_TURN = 1e-9
#: A stated end direction is met where that needs no radius below this, m.
SHARPEST_BLEND = 15.0
#: Of the segment at a stated end direction, this share may bend.
_FOR_BLEND = 0.7
#: And turns by less than this, rad.
LARGEST_BLEND = np.radians(20.0)


def round_lines(
    frame: GridFrame,
    lines: Sequence[FloatArray],
    *,
    start_bearing: FloatArray | None = None,
    end_bearing: FloatArray | None = None,
    within: float = 0.3,
    spacing: float = 1.0,
) -> list[KnotTable]:
    """Round drawn lines and tabulate each by true ground length; no heights, lengths are horizontal at height 0.

    Parameters
    ----------
    frame : GridFrame
        Plane of the vertices.
    lines : sequence of (n, 2) array
        Easting and northing of at least two vertices, no two neighbours at one place, m.
    start_bearing, end_bearing : (l,) array, optional
        Grid bearings wanted at the ends as the line runs, rad; NaN where the drawn direction stands. One that would need a
        radius below 15 m or a turn over 20 degrees is not met.
    within : float
        Greatest distance of the curve from the drawn line, m.
    spacing : float
        Wanted distance between knots, m.

    Returns
    -------
    list of KnotTable
        One a line.

    Examples
    --------
    >>> from railnav.geodesy.grid import frame_for_grid
    >>> plane = frame_for_grid(3.5e6, 5.6e6, crs="EPSG:31467")
    >>> corner = np.array([[3.5e6, 5.6e6], [3.5e6, 5600100.0], [3500010.0, 5600200.0]])
    >>> (table,) = round_lines(plane, [corner])
    >>> bool(np.abs(table.easting - 3.5e6)[table.northing < 5600050.0].max() < 1e-6)
    True
    """
    count = np.array([len(line) for line in lines])
    absent = np.full(len(lines), np.nan)
    tau0 = absent if start_bearing is None else start_bearing
    tau1 = absent if end_bearing is None else end_bearing
    vertex = np.concatenate(lines)
    of_vertex = np.repeat(np.arange(len(lines)), count)
    inside = of_vertex[1:] == of_vertex[:-1]  # steps that are segments
    step = np.diff(vertex, axis=0)[inside]
    origin = vertex[:-1][inside]
    line = of_vertex[:-1][inside]
    length = np.hypot(step[:, 0], step[:, 1])
    unit = step / length[:, None]
    bearing = np.arctan2(step[:, 0], step[:, 1])
    last = np.append(line[1:] != line[:-1], True)
    first = np.append(True, last[:-1])

    # corners: between a segment and the next of the same line
    phi = np.append(wrap_angle(np.diff(bearing)), 0.0)
    phi[last] = 0.0
    phi[np.abs(phi) < _NO_TURN] = 0.0
    reach = within / np.maximum(np.tan(np.abs(phi) / 4.0), 1e-12)
    # a segment that a wanted direction bends keeps most of its length for that
    wanted = (first & np.isfinite(tau0[line]), last & np.isfinite(tau1[line]))
    lent = np.where(wanted[0] ^ wanted[1], 1.0 - _FOR_BLEND, 0.5) * length
    cut = np.minimum(np.minimum(lent, np.append(lent[1:], np.inf)), reach)
    cut[phi == 0.0] = 0.0
    cut_before = np.append(0.0, cut[:-1])

    # ends: directions wanted there
    def blend(tau: FloatArray, at: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        delta = np.where(at, wrap_angle(bearing - np.nan_to_num(tau[line])), 0.0)
        delta[np.isnan(tau[line]) | (np.abs(delta) < _NO_TURN) | (np.abs(delta) > LARGEST_BLEND)] = 0.0
        most = np.where(wanted[0] & wanted[1], 0.5, _FOR_BLEND) * length
        run = np.minimum(most, 6.0 * within / np.maximum(np.abs(delta), 1e-12))  # swings out by delta run / 6
        delta[run < 3.0 * np.abs(delta) * SHARPEST_BLEND] = 0.0
        return delta, np.where(delta == 0.0, 0.0, run)

    delta0, run0 = blend(tau0, first)
    delta1, run1 = blend(tau1, last)

    # six pieces a segment: two arcs in, straight, two arcs out, corner; each with start, bearing, turn, length
    pieces = np.zeros((len(length), 6, 5))

    def put(k: int, point: FloatArray, direction: FloatArray, turn: FloatArray, chord: FloatArray) -> None:
        half = np.where(turn == 0.0, 1.0, turn / 2.0)
        pieces[:, k, 0:2] = point
        pieces[:, k, 2] = direction
        pieces[:, k, 3] = turn
        pieces[:, k, 4] = np.where(turn == 0.0, chord, chord * half / np.sin(half))

    def ahead(point: FloatArray, direction: FloatArray, chord: FloatArray) -> FloatArray:
        return np.asarray(point + chord[:, None] * np.column_stack([np.sin(direction), np.cos(direction)]))

    chord = run0 / (2.0 * np.cos(delta0 / 4.0))
    put(0, origin, bearing - delta0, 1.5 * delta0, chord)
    put(1, ahead(origin, bearing - delta0 / 4.0, chord), bearing + delta0 / 2.0, -delta0 / 2.0, chord)
    begin, end = np.maximum(run0, cut_before), length - np.maximum(run1, cut)
    put(2, origin + begin[:, None] * unit, bearing, np.zeros(len(length)), np.maximum(end - begin, 0.0))
    chord = run1 / (2.0 * np.cos(delta1 / 4.0))
    leave = origin + (length - run1)[:, None] * unit
    put(3, leave, bearing, delta1 / 2.0, chord)
    put(4, ahead(leave, bearing + delta1 / 4.0, chord), bearing + delta1 / 2.0, -1.5 * delta1, chord)
    put(5, origin + (length - cut)[:, None] * unit, bearing, phi, 2.0 * cut * np.cos(phi / 2.0))
    owner = np.repeat(line, 6)
    flat = pieces.reshape(-1, 5)
    kept = flat[:, 4] > 1e-9
    return _tabulate(frame, flat[kept], owner[kept], len(lines), spacing)


def lay_line(frame: GridFrame, point: FloatArray, spacing: float) -> KnotTable:
    """Lay a line of vertices, a survey's or a drawing's: splined where it has no corners, else rounded.

    Parameters
    ----------
    frame : GridFrame
        Plane of the vertices.
    point : (n, 3) array
        Easting, northing, height (NaN where unknown), m; n >= 2.
    spacing : float
        Wanted distance between knots, m.

    Returns
    -------
    KnotTable
        Through the vertices (`fit_alignment`) where none turns by more than 4 degrees, else within 0.3 m of the line, with heights linear
        between its vertices.

    Raises
    ------
    TrackError
        A line of no length.
    """
    keep = [0]
    for i in range(1, len(point)):
        if np.hypot(*(point[i, :2] - point[keep[-1], :2])) >= _SAME_VERTEX:
            keep.append(i)
    if len(keep) < 2:
        raise TrackError("a line has no length")
    if keep[-1] != len(point) - 1:  # the end stays, what lies upon it goes
        keep[-1 if len(keep) > 2 or len(point) == 2 else 1] = len(point) - 1
    point = point[keep]
    step = np.diff(point[:, :2], axis=0)
    turn = np.diff(np.unwrap(np.arctan2(step[:, 0], step[:, 1])))
    if np.abs(turn).max(initial=0.0) <= SURVEYED_TURN:
        return fit_alignment(frame, point[:, 0], point[:, 1], point[:, 2], spacing=spacing)
    (table,) = round_lines(frame, [point[:, :2]], within=WITHIN, spacing=spacing)
    if np.isfinite(point[:, 2]).all():
        run = np.append(0.0, np.cumsum(np.hypot(step[:, 0], step[:, 1])))
        height = np.interp(table.offset / table.offset[-1] * run[-1], run, point[:, 2])
        gradient = np.gradient(height, table.offset)
        offset = np.append(0.0, np.cumsum(np.hypot(np.diff(table.offset), np.diff(height))))
        table = replace(table, offset=offset, height=height, gradient=gradient)
    return table


def _tabulate(
    frame: GridFrame, pieces: FloatArray, owner: NDArray[np.int64], lines: int, spacing: float
) -> list[KnotTable]:
    """Knots of straights and arcs (start easting, northing, bearing, turn, grid length) by line."""
    east, north, bearing, turn, length = pieces.T

    def point(which: NDArray[np.int64], share: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        half = 0.5 * turn[which] * share
        chord = share * length[which] * np.sinc(half / np.pi)
        direction = bearing[which] + half
        return east[which] + chord * np.sin(direction), north[which] + chord * np.cos(direction), direction + half

    every = np.arange(len(length))
    at_end = point(every, np.ones(len(length)))
    level = np.zeros(len(length))
    scale0 = frame.ground_scale(east, north, level, bearing)
    scale1 = frame.ground_scale(at_end[0], at_end[1], level, at_end[2])
    run = np.append(0.0, np.cumsum(2.0 * length / (scale0 + scale1)))  # ground metres, all lines one after another
    begin = np.searchsorted(owner, np.arange(lines), side="left")
    finish = np.searchsorted(owner, np.arange(lines), side="right")
    total = run[finish] - run[begin]
    even = np.maximum(2, np.rint(total / spacing).astype(np.int64) + 1)
    count = np.append(0, np.cumsum(even))
    of = np.repeat(np.arange(lines), even)
    offset = (np.arange(count[-1]) - count[of]) / (even[of] - 1) * total[of]
    # besides, knots on both sides of a step of the bend: between two knots it must be that of one piece
    bend = np.where(length > 0.0, turn / np.where(length > 0.0, length, 1.0), 0.0)
    step = np.flatnonzero((owner[1:] == owner[:-1]) & (np.abs(np.diff(bend)) > _BEND_STEP))
    where = run[step + 1] - run[begin][owner[step]]
    room = 0.6 * _SAME_KNOT
    inside = (where > 2.0 * room) & (where < total[owner[step]] - 2.0 * room)
    step, where = step[inside], where[inside]
    of = np.concatenate([of, owner[step], owner[step]])
    offset = np.concatenate([offset, where - room, where + room])
    fixed = np.append(np.zeros(count[-1], bool), np.ones(2 * len(step), bool))
    order = np.lexsort((offset, of))
    of, offset, fixed = of[order], offset[order], fixed[order]
    close = (of[1:] == of[:-1]) & (np.diff(offset) < _SAME_KNOT)
    at_end = np.append(of[1:] != of[:-1], True) | np.append(True, of[1:] != of[:-1])
    drop = np.zeros(len(of), bool)
    drop[1:] |= close & (
        fixed[:-1] | ~fixed[1:] | at_end[:-1]
    )  # of two knots at one place, that of a step stays, and an end
    drop[:-1] |= close & fixed[1:] & ~fixed[:-1]
    drop &= ~at_end
    of, offset = of[~drop], offset[~drop]
    n = np.bincount(of, minlength=lines)
    before = np.append(0, np.cumsum(n))
    along = np.minimum(run[begin][of] + offset, run[finish][of])
    which = np.clip(np.searchsorted(run, along, side="right") - 1, begin[of], finish[of] - 1)
    part = np.clip((along - run[which]) / (run[which + 1] - run[which]), 0.0, 1.0)
    e, north_, b = point(which, part)
    scale = scale0[which] + part * (scale1[which] - scale0[which])
    curvature = turn[which] / length[which] * scale
    nothing = np.zeros(int(n.max()))
    unknown = np.full(int(n.max()), np.nan)
    unknowns = np.full((int(n.max()), 6), np.nan)
    b = wrap_angle(b)
    tables = []
    for i in range(lines):
        own = slice(int(before[i]), int(before[i + 1]))
        m = int(n[i])
        tables.append(
            KnotTable(
                offset[own],
                e[own],
                north_[own],
                unknown[:m],
                b[own],
                curvature[own],
                nothing[:m],
                nothing[:m],
                scale[own],
                unknowns[:m],
            )
        )
    return tables
