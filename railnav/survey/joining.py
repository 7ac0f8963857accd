"""Tracks that spring from each other meet in a node: ends drawn onto the through track, tables parted there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from railnav.survey.layout import Join
from railnav.track.alignment import KnotTable
from railnav.track.assembly import TrackSection

FloatArray = NDArray[np.float64]

#: An end is drawn onto its node over a length that bends the track by no more than this, 1/m, within these bounds, m.
LARGEST_BEND = 1e-3
SHORTEST, LONGEST = 25.0, 200.0
#: A way of more than this that is missing between an end and its node is bridged, m; bridges reach so far into the track, m.
LEAST_BRIDGE, SHORTEST_INSIDE, LONGEST_INSIDE = 1.5, 10.0, 50.0
#: Fewest knots that are left of a track that is cut where it overlaps its parent.
MOST_CUT = 10
#: Nodes of a track closer than this are one, m.
SAME_NODE = 3.0
#: A node closer than this to an end of its parent is that end, m.
AT_END = 5.0


def join_tracks(
    names: Sequence[str],
    tables: Sequence[KnotTable],
    joins: Sequence[Join],
    *,
    before: Mapping[str, Sequence[tuple[str, FloatArray]]] | None = None,
) -> tuple[list[TrackSection], dict[str, list[str]]]:
    """Draw ends onto the tracks that they spring from, and part those there.

    Parameters
    ----------
    names, tables : sequence
        The surveyed tracks.
    joins : sequence of Join
        Where their ends spring from others.
    before : dict, optional
        Sections (name, (k, 2) points) that tracks had before: a section that stays whole keeps its name, one that is parted again
        gives it to its parts, with a number.

    Returns
    -------
    sections : list of TrackSection
        Ready to be assembled: ends that meet are at one place, in one tangent.
    parts : dict
        Names of the sections that each parted track became.
    """
    place = {name: i for i, name in enumerate(names)}
    cuts: dict[str, list[int]] = {name: [] for name in names}
    tables = list(tables)
    for join in joins:
        parent = tables[place[join.parent]]
        k = int(np.argmin(np.hypot(parent.easting - join.easting, parent.northing - join.northing)))
        near = [c for c in cuts[join.parent] if abs(parent.offset[c] - parent.offset[k]) < SAME_NODE]
        k = near[0] if near else k
        if parent.offset[k] < AT_END:
            k = 0
        elif parent.offset[-1] - parent.offset[k] < AT_END:
            k = len(parent.offset) - 1
        if 0 < k < len(parent.offset) - 1 and not near:
            cuts[join.parent].append(k)
        i = place[join.track]
        tables[i] = _drawn(_reaching(tables[i], join.end, parent, k), join.end, parent, k)
    sections: list[TrackSection] = []
    parts: dict[str, list[str]] = {}
    for name, table in zip(names, tables, strict=True):
        edges = [0, *sorted(cuts[name]), len(table.offset) - 1]
        if len(edges) == 2:
            sections.append(TrackSection(name, table))
            continue
        parts[name] = _names(name, table, edges, (before or {}).get(name, ()))
        for n, (a, b) in enumerate(pairwise(edges)):
            piece = {f.name: getattr(table, f.name)[a : b + 1].copy() for f in fields(table)}
            piece["offset"] -= piece["offset"][0]
            sections.append(TrackSection(parts[name][n], KnotTable(**piece)))
    return sections, parts


def _names(name: str, table: KnotTable, edges: Sequence[int], before: Sequence[tuple[str, FloatArray]]) -> list[str]:
    """Names of the sections of a parted track."""
    if not before:
        return [f"{name}/{n + 1}" for n in range(len(edges) - 1)]
    homes = []
    for a, b in pairwise(edges):
        middle = np.array([table.easting[(a + b) // 2], table.northing[(a + b) // 2]])
        homes.append(min(before, key=lambda old: float(np.hypot(*(old[1] - middle).T).min()))[0])
    out = []
    for n, home in enumerate(homes):
        many = homes.count(home)
        out.append(home if many == 1 else f"{home}/{homes[: n + 1].count(home)}")
    return out


def _reaching(table: KnotTable, end: int, parent: KnotTable, k: int) -> KnotTable:
    """Let an end of a track reach abreast of knot k of its parent: knots beyond it are cut, a missing way is bridged.

    The bridge is the cubic curve that leaves the knot in the parent's tangent and meets the track in its own, some way inside.
    """
    back = slice(None, None, -1 if end == 1 else 1)
    e, n = table.easting[back], table.northing[back]
    s = np.append(0.0, np.cumsum(np.hypot(np.diff(e), np.diff(n))))
    start = np.array([parent.easting[k], parent.northing[k]])
    turn = np.array([np.sin(parent.grid_bearing[k]), np.cos(parent.grid_bearing[k])])
    own = np.array([e[1] - e[0], n[1] - n[0]]) / s[1]
    turn *= np.sign(own @ turn) or 1.0
    missing = float((np.array([e[0], n[0]]) - start) @ own)
    columns: dict[str, FloatArray] = {f.name: getattr(table, f.name)[back] for f in fields(table)}
    spacing = float(np.median(np.diff(s)))
    if missing < -spacing:  # it begins before the knot
        near = int(np.argmin(np.hypot(e - start[0], n - start[1])))
        first = min(near, len(s) - MOST_CUT)
        if first <= 0:
            return table
        return _ordered({name: column[first:] for name, column in columns.items()}, end)
    if missing <= max(spacing, LEAST_BRIDGE):
        return table
    # how far the way from the knot is off an arc that leaves in its tangent: a longer bridge takes it up
    chord = np.array([e[0], n[0]]) - start
    mean = turn + own
    mean /= np.hypot(*mean)
    off = abs(float(chord[0] * mean[1] - chord[1] * mean[0]))
    inside = max(float(np.clip(missing, SHORTEST_INSIDE, LONGEST_INSIDE)), np.sqrt(6.0 * off / LARGEST_BEND) - missing)
    m = min(int(np.searchsorted(s, inside)), len(s) // 2)
    if m < 2:
        return table
    finish = np.array([e[m], n[m]])
    leave = np.array([e[m + 1] - e[m - 1], n[m + 1] - n[m - 1]]) / (s[m + 1] - s[m - 1])
    length = float(np.hypot(*(finish - start)))
    many = max(2, round(length / spacing))
    u = (np.arange(many) / many)[:, None]
    bridge = (
        (2 * u**3 - 3 * u**2 + 1) * start
        + (u**3 - 2 * u**2 + u) * length * turn
        + (3 * u**2 - 2 * u**3) * finish
        + (u**3 - u**2) * length * leave
    )
    at = np.clip((u[:, 0] * (s[m] + missing)) - missing, 0.0, s[m])  # where columns that go along are taken from
    out: dict[str, FloatArray] = {}
    for name, column in columns.items():
        flat = column.reshape(len(column), -1)
        piece = np.column_stack([np.interp(at, s, flat[:, c]) for c in range(flat.shape[1])])
        out[name] = np.concatenate([piece.reshape(many, *column.shape[1:]), column[m:]])
    out["easting"][:many], out["northing"][:many] = bridge[:, 0], bridge[:, 1]
    east, north = np.gradient(out["easting"]), np.gradient(out["northing"])
    bearing = np.unwrap(np.arctan2(east, north))
    bearing[0] = bearing[1] + np.angle(np.exp(1j * (np.arctan2(*turn) - bearing[1])))
    along = np.append(0.0, np.cumsum(np.hypot(np.diff(out["easting"]), np.diff(out["northing"])) / out["scale"][:-1]))
    bend = np.gradient(bearing, along)
    out["grid_bearing"][: many + 1] = bearing[: many + 1] + (np.pi if end == 1 else 0.0)
    out["grid_bearing"] = np.angle(np.exp(1j * out["grid_bearing"]))
    out["curvature"][: many + 1] = bend[: many + 1] * (-1.0 if end == 1 else 1.0)
    return _ordered(out, end)


def _ordered(columns: dict[str, FloatArray], end: int) -> KnotTable:
    """A table from columns that were told from one end, with offsets of their own."""
    back = slice(None, None, -1 if end == 1 else 1)
    out = {name: column[back].copy() for name, column in columns.items()}
    ground = np.hypot(np.diff(out["easting"]), np.diff(out["northing"])) / out["scale"][:-1]
    if np.isfinite(out["height"]).all():
        ground = np.hypot(ground, np.diff(out["height"]))
    out["offset"] = np.append(0.0, np.cumsum(ground))
    return KnotTable(**out)


def _drawn(table: KnotTable, end: int, parent: KnotTable, k: int) -> KnotTable:
    """Move an end of a track onto knot k of its parent, in its tangent, and let the move die away."""
    column = {f.name: getattr(table, f.name).copy() for f in fields(table)}
    reverse = end == 1
    e, n = column["easting"], column["northing"]
    if reverse:
        e, n = e[::-1], n[::-1]
    step = np.hypot(np.diff(e), np.diff(n))
    s = np.append(0.0, np.cumsum(step))
    gap = np.array([parent.easting[k] - e[0], parent.northing[k] - n[0]])
    reach = float(np.clip(np.sqrt(6.0 * float(np.hypot(*gap)) / LARGEST_BEND), SHORTEST, LONGEST))
    reach = min(reach, 0.5 * float(s[-1]))
    own = np.array([e[1] - e[0], n[1] - n[0]]) / step[0]
    wanted = np.array([np.sin(parent.grid_bearing[k]), np.cos(parent.grid_bearing[k])])
    wanted *= np.sign(own @ wanted) or 1.0
    u = np.clip(s / reach, 0.0, 1.0)
    move = np.outer(2 * u**3 - 3 * u**2 + 1, gap) + np.outer((u**3 - 2 * u**2 + u) * reach, wanted - own)
    e, n = e + move[:, 0], n + move[:, 1]
    d = np.gradient(np.column_stack([e, n]), s, axis=0)
    d[0] = wanted
    bearing = np.unwrap(np.arctan2(d[:, 0], d[:, 1]) + (np.pi if reverse else 0.0))
    ground = np.hypot(np.diff(e), np.diff(n)) / (column["scale"][:-1] if not reverse else column["scale"][::-1][:-1])
    height = column["height"][::-1] if reverse else column["height"]
    if np.isfinite(height).all() and np.isfinite(parent.height[k]):
        height = height + (2 * u**3 - 3 * u**2 + 1) * (parent.height[k] - height[0])
        ground = np.hypot(ground, np.diff(height))
    along = np.append(0.0, np.cumsum(ground))
    bend = np.gradient(bearing, along) * (-1.0 if reverse else 1.0)
    touched = u < 1.0
    back = slice(None, None, -1 if reverse else 1)
    column["easting"], column["northing"], column["height"] = e[back].copy(), n[back].copy(), height[back].copy()
    column["grid_bearing"] = np.where(touched, bearing, np.unwrap(column["grid_bearing"][back]))[back].copy()
    column["grid_bearing"] = np.arctan2(np.sin(column["grid_bearing"]), np.cos(column["grid_bearing"]))
    column["curvature"] = np.where(touched, bend, column["curvature"][back])[back].copy()
    column["offset"] = along if not reverse else (along[-1] - along)[::-1].copy()
    if np.isfinite(column["height"]).all():
        flat = np.hypot(np.gradient(column["easting"]), np.gradient(column["northing"])) / column["scale"]
        gradient = np.gradient(column["height"]) / flat
        column["gradient"] = np.where(touched[back], gradient, column["gradient"])
    return KnotTable(**column)
