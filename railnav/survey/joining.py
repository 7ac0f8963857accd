"""Tracks that spring from each other meet in a node: ends drawn onto the through track, tables parted there."""

from __future__ import annotations

from collections.abc import Sequence
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
#: Nodes of a track closer than this are one, m.
SAME_NODE = 3.0
#: A node closer than this to an end of its parent is that end, m.
AT_END = 5.0


def join_tracks(
    names: Sequence[str], tables: Sequence[KnotTable], joins: Sequence[Join]
) -> tuple[list[TrackSection], dict[str, list[str]]]:
    """Draw ends onto the tracks that they spring from, and part those there.

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
        tables[i] = _drawn(tables[i], join.end, parent, k)
    sections: list[TrackSection] = []
    parts: dict[str, list[str]] = {}
    for name, table in zip(names, tables, strict=True):
        edges = [0, *sorted(cuts[name]), len(table.offset) - 1]
        if len(edges) == 2:
            sections.append(TrackSection(name, table))
            continue
        parts[name] = [f"{name}/{n + 1}" for n in range(len(edges) - 1)]
        for n, (a, b) in enumerate(pairwise(edges)):
            piece = {f.name: getattr(table, f.name)[a : b + 1].copy() for f in fields(table)}
            piece["offset"] -= piece["offset"][0]
            sections.append(TrackSection(parts[name][n], KnotTable(**piece)))
    return sections, parts


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
