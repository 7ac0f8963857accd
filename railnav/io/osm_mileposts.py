"""Mile posts of OpenStreetMap on the tracks of their line."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.io.osm_map import Map
from railnav.track.model import MilePosts, TrackModel

#: Mile posts are laid on tracks of their line this near, m.
POST_REACH = 12.0
#: A post whose chainage disagrees with the others of its track by more than this is passed over, m.
POST_MISFIT = 250.0
#: Posts of one chainage this near are one, m.
SAME_POST = 15.0
_KILOMETRES = re.compile(r"^\s*(?:km\s*)?([+-]?\d{1,5})(?:[.,](\d{1,6}))?\s*(?:km)?\s*$", re.IGNORECASE)


@dataclass(frozen=True, slots=True, eq=False)
class LaidPosts:
    """Mile posts by track, and how many were told apart."""

    table: MilePosts
    told: dict[str, int]


def kilometres(text: str) -> float | None:
    """Chainage of a mile post as tagged, m; None where it is no plain number of kilometres.

    Examples
    --------
    >>> kilometres("14.8"), kilometres("12,35 km"), kilometres("mi:7.5")
    (14800.0, 12350.0, None)
    """
    match = _KILOMETRES.match(text)
    if match is None:
        return None
    return round(float(f"{match[1]}.{match[2] or 0}") * 1e3, 3)


def mileposts(model: TrackModel, found: Map) -> LaidPosts:
    """Posts projected onto the near tracks of their line."""
    told = {"posts": 0, "without_number": 0, "without_line": 0, "laid": 0, "contradicting": 0}
    own_line: dict[int, str] = {}
    for way in found.ways:
        for node in way.nodes:
            if way.line and node in found.tags:
                own_line.setdefault(node, way.line)
    marks = [node for node, tags in found.tags.items() if tags.get("railway") == "milestone"]
    by_track: dict[int, list[tuple[float, float]]] = {}
    places = np.radians(np.array([found.place[node] for node in marks]).reshape(-1, 2))
    easting, northing, _ = model.frame.to_grid(places[:, 0], places[:, 1]) if marks else (places[:, 0],) * 3
    index = {track: i for i, track in enumerate(model.track_id)}
    for node, east, north in zip(marks, easting, northing, strict=True):
        told["posts"] += 1
        tags = found.tags[node]
        value = kilometres(tags.get("railway:position:exact", "")) if "railway:position:exact" in tags else None
        value = kilometres(tags.get("railway:position", "")) if value is None else value
        if value is None:
            told["without_number"] += 1
            continue
        near = model.locate(float(east), float(north), within=POST_REACH)
        line = own_line.get(node) or next((model.line[index[c.track]] for c in near if model.line[index[c.track]]), "")
        if not line:
            told["without_line"] += 1
            continue
        laid: set[int] = set()
        for candidate in near:
            track = index[candidate.track]
            if track not in laid and model.line[track] == line:
                laid.add(track)
                by_track.setdefault(track, []).append((candidate.offset, value))
        told["laid"] += len(laid)
    rows: list[tuple[int, float, float]] = []
    senses: dict[int, float] = {}
    for track, posts in sorted(by_track.items()):
        kept, sense, dropped = _consistent(posts)
        told["contradicting"] += dropped
        by_track[track] = kept
        senses[track] = sense
    lengths = model.lengths
    for track, kept in sorted(by_track.items()):
        if not kept:
            continue
        if len(kept) == 1:  # which way it counts follows from the nearest other post of the line
            sense = _sense(model, track, kept[0], by_track)
            if sense == 0.0:
                told["contradicting"] += 1
                continue
            offset, value = kept[0]
            far = 0.0 if offset > 0.5 * lengths[track] else float(lengths[track])
            kept = sorted([(offset, value), (far, value + sense * (far - offset))])
            if abs(far - offset) < 1e-3:
                continue
        rows += [(track, offset, value) for offset, value in kept]
    table = np.array(rows).reshape(-1, 3)
    return LaidPosts(MilePosts(table[:, 0].astype(np.int64), table[:, 1].copy(), table[:, 2].copy()), told)


def _consistent(posts: list[tuple[float, float]]) -> tuple[list[tuple[float, float]], float, int]:
    """Posts of a track in order that grow or fall metre for metre, their sense, and how many did not fit."""
    given = len(posts)
    table = np.array(sorted(posts))
    same = (np.diff(table[:, 0]) <= SAME_POST) & (np.diff(table[:, 1]) == 0.0)  # each track of a line has its own post
    given -= int(same.sum())
    table = table[np.append(True, ~same)]
    table = table[np.append(True, np.diff(table[:, 0]) > 1.0)]
    if len(table) == 1:
        return [(float(table[0, 0]), float(table[0, 1]))], 0.0, given - 1
    found: list[tuple[int, float, float, NDArray[np.bool_]]] = []
    for sense in (1.0, -1.0):
        level = table[:, 1] - sense * table[:, 0]
        misfit = np.abs(level - np.median(level))
        fits = misfit <= POST_MISFIT
        found.append((-int(fits.sum()), float(misfit[fits].sum()), sense, fits))
    count, _, sense, fits = min(found, key=lambda entry: entry[:2])
    if count > -2:
        return [], 0.0, given
    kept = table[fits]
    ahead = np.append(
        True, np.diff(np.maximum.accumulate(sense * kept[:, 1])) > 0.0
    )  # growing, so that chainage is one to one
    kept = kept[ahead]
    return [(float(o), float(c)) for o, c in kept], sense, given - len(kept)


def _sense(
    model: TrackModel, track: int, post: tuple[float, float], by_track: dict[int, list[tuple[float, float]]]
) -> float:
    """+1 where chainage grows with offset, by the nearest post of the line 50 m to 5 km away; 0 where there is none."""
    here = model.at(model.track_id[track], post[0])
    best, sense = math.inf, 0.0
    for other, posts in by_track.items():
        if model.line[other] != model.line[track] or other == track:
            continue
        for offset, value in posts:
            change = value - post[1]
            if not 50.0 < abs(change) < min(best, 5000.0):
                continue
            there = model.at(model.track_id[other], offset)
            step = (float(there.easting - here.easting), float(there.northing - here.northing))
            if math.hypot(*step) > 1.5 * abs(change) + 100.0:
                continue
            along = step[0] * math.sin(float(here.grid_bearing)) + step[1] * math.cos(float(here.grid_bearing))
            best, sense = abs(change), math.copysign(1.0, change * along)
    return sense
