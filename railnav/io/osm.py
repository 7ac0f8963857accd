"""OpenStreetMap as a track network: ways become tracks between switches, crossings and ends, with the movements they permit.

The drawing is good to a metre and has kinks; it is rounded within 0.3 m (`railnav.io.drawn`). Which movements a node permits
follows from the directions of its ends over their first metres and from its tags: a turnout has one end on one side and two on the
other, a plain crossing two straight ways through, a slip crossing all ways across. There are no heights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, InputError
from railnav.geodesy.grid import choose_frame
from railnav.io.drawn import round_lines
from railnav.io.osm_junctions import SAME_VERTEX, count_corners, crossings_without_node, find_junctions, node_kinds
from railnav.io.osm_map import Chain, Map, Way, join_ways, read_map
from railnav.io.osm_mileposts import mileposts
from railnav.run import Progress
from railnav.track.assembly import TrackSection, assemble
from railnav.track.model import TrackModel
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Greatest distance of the rounded curve from the drawing, m.
WITHIN = 0.3
#: Vertices this near to a node, and no further than this off the straight to the next, only hide its direction, m.
CALM_REACH = 25.0
CALM = 0.15
#: No train passes a vertex that turns by more than this, rad.
DOUBLES_BACK = math.radians(100.0)
#: What one repeats while reading is said so often, then counted.
_MOST_NOTES = 20


def read_osm(
    path: str | Path,
    *,
    crs: Any = None,
    zone_width: int = 6,
    ellipsoid: str = "wgs84",
    spacing: float = 1.0,
    progress: Progress | None = None,
) -> TrackModel:
    """Read the railways of an OpenStreetMap file.

    Ways of railway = rail, light_rail, subway, tram and narrow_gauge are cut where other than two steps meet, and joined from way to
    way elsewhere. A track is named after its first way, `way.1`, `way.2` where that gives several.

    Parameters
    ----------
    path : path
        OpenStreetMap data as .osm.pbf.
    crs, zone_width, ellipsoid
        The plane, as for `railnav.geodesy.choose_frame`; by default the 6-degree Gauss-Krueger zone of the data.
    spacing : float
        Distance between the model's knots, m.
    progress : callable, optional
        Told of the stages.

    Returns
    -------
    TrackModel
        Without heights and covariance. `line` is the `ref` of the longer part of a track, mile posts of the line (railway:position)
        become chainage; `provenance["tunnels"]` lists stretches in tunnels, `provenance["import"]` what was read, and the nodes and
        posts that did not fit.

    Raises
    ------
    InputError
        The file is missing, cut short, no OpenStreetMap data, or holds no railway.
    CrsError
        The plane does not serve the data.
    RailnavError
        osmium is not installed.

    Notes
    -----
    The curve stays within 0.3 m of the drawn line; at turnouts the leg that branches leaves in the direction of the stem where
    that needs no radius below 15 m. The side of a single slip is not known to OpenStreetMap: both are permitted, and it is
    said.

    Examples
    --------
    >>> read_osm("nowhere.osm.pbf")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.osm.pbf: does not exist; check the name
    """
    path = Path(path)
    if not spacing > 0.0:
        raise InputError(f"knot spacing {spacing} m is not positive", file=path, remedy="use 1 m")

    def tell(stage: str, done: int) -> None:
        if progress is not None:
            progress(stage, done, 4)

    tell("read", 0)
    found = read_map(path)
    notes: list[str] = []
    if found.absent:
        notes.append(f"{found.absent} nodes of ways are not in the file; ways end there")
    chains = join_ways(found.ways)
    known = np.array(sorted({node for chain in chains for node in chain.nodes}), np.int64)
    degrees = np.array([found.place[int(node)] for node in known])
    try:
        latitude, longitude = np.radians(degrees.T)
        frame = choose_frame(latitude, longitude, crs=crs, zone_width=zone_width, ellipsoid=ellipsoid)
        easting, northing, _ = frame.to_grid(latitude, longitude)
    except CrsError as error:
        raise CrsError(f"{path}: {error}") from error
    tell("shape", 1)
    grid = np.column_stack([easting, northing])
    lines, chains = _lines(chains, known, grid, notes)
    if not lines:
        raise InputError("holds no railway of any length", file=path, remedy="extract railway=rail and the like")
    junctions = find_junctions(chains, lines, found.tags, notes)
    tables = round_lines(
        frame,
        lines,
        start_bearing=wrap_angle(junctions.direction[:, 0]),
        end_bearing=wrap_angle(junctions.direction[:, 1] + math.pi),
        within=WITHIN,
        spacing=spacing,
    )
    tell("join", 2)
    ways = {way.id: way for way in found.ways}
    names = _names(chains)
    sections = []
    tunnels: list[dict[str, Any]] = []
    for track, chain, table in zip(names, chains, tables, strict=True):
        ref, name, stretches = _describe(chain, ways, known, grid, float(table.offset[-1]))
        sections.append(TrackSection(track, table, ref, name))
        tunnels += [{"name": n, "track": track, "from_m": a, "to_m": b} for n, a, b in stretches]
    model = assemble(frame, sections, join_within=1e-4)
    movements = np.array([(a // 2, a % 2, b // 2, b % 2) for a, b in junctions.permitted], np.int64).reshape(-1, 4)
    tell("mile posts", 3)
    posts = mileposts(model, found)
    corners = count_corners(model, movements)
    if corners["slips"] or corners["others"]:
        notes.append(
            f"{corners['slips']} movements over slips drawn as a point and {corners['others']} others turn by more than half a degree "
            "at their node: no curve of 15 m within 0.3 m of the drawing meets them"
        )
    apart = crossings_without_node(chains, lines, ways, frame)
    notes += apart
    told = {
        "format": "OpenStreetMap",
        "source": path.name,
        "tracks": len(sections),
        "ways": len(found.ways),
        "switches": sum(tags.get("railway") == "switch" for tags in found.tags.values()),
        "junctions": junctions.told,
        "corners": corners,
        "ways_that_cross_without_a_node": len(apart),
        "mileposts": posts.told,
        "electrified_km": _kilometres(found, known, grid, "electrified"),
        "gauge_km": _kilometres(found, known, grid, "gauge"),
        "rounded_within_m": WITHIN,
        "attribution": "OpenStreetMap contributors, ODbL",
        "notes": notes[:_MOST_NOTES] + ([f"and {len(notes) - _MOST_NOTES} more"] if len(notes) > _MOST_NOTES else []),
    }
    tell("done", 4)
    return replace(
        model,
        movements=movements,
        nodes=replace(model.nodes, kind=node_kinds(model, chains, found.tags)),
        mileposts=posts.table,
        provenance={"import": told, "tunnels": tunnels},
    )


# --- the graph --------------------------------------------------------------------------------------------------------


def _lines(
    chains: Sequence[Chain], known: IntArray, grid: FloatArray, notes: list[str]
) -> tuple[list[FloatArray], list[Chain]]:
    """Vertices of every section, near-repeated ones left out; sections of no length are dropped."""
    lines: list[FloatArray] = []
    kept: list[Chain] = []
    for chain in (part for whole in chains for part in _unfolded(whole, known, grid, notes)):
        points = grid[np.searchsorted(known, chain.nodes)]
        keep = np.append(True, np.hypot(*np.diff(points, axis=0).T) >= SAME_VERTEX)
        if not keep[-1]:  # the end stays, what lies upon it goes
            keep[np.flatnonzero(keep)[-1]] = keep.sum() == 1
            keep[-1] = True
        line = _calm(_calm(points[keep])[::-1])[::-1]
        if len(line) < 2 or np.hypot(*np.diff(line, axis=0).T).min() < 1e-3:
            notes.append(f"way {chain.ways[0]}: {len(chain.nodes)} nodes upon each other passed over")
            continue
        lines.append(line)
        kept.append(chain)
    return lines, kept


def _unfolded(chain: Chain, known: IntArray, grid: FloatArray, notes: list[str]) -> list[Chain]:
    """A section parted where it doubles back: there a train comes to a stand, no curve leads on."""
    points = grid[np.searchsorted(known, chain.nodes)]
    step = np.diff(points, axis=0)
    bearing = np.arctan2(step[:, 0], step[:, 1])
    back = np.flatnonzero(np.abs(wrap_angle(np.diff(bearing))) > DOUBLES_BACK) + 1
    back = back[[min(np.hypot(*step[i - 1]), np.hypot(*step[i])) > 1.0 for i in back.tolist()]] if len(back) else back
    if not len(back):
        return [chain]
    notes.append(
        f"way {chain.ways[int(back[0])]} doubles back at node {chain.nodes[int(back[0])]}: no train passes there"
    )
    borders = [0, *back.tolist(), len(chain.ways)]
    return [Chain(chain.nodes[a : b + 1], chain.ways[a:b]) for a, b in pairwise(borders)]


def _calm(line: FloatArray) -> FloatArray:
    """Leave out vertices near the first one that lie on the way to the next but for a hand's breadth: short steps hide directions."""
    reach = np.hypot(*(line[1:] - line[0]).T)
    for j in range(int(np.searchsorted(np.maximum.accumulate(reach), CALM_REACH, side="right")), 1, -1):
        if j >= len(line):
            continue
        ahead = (line[j] - line[0]) / max(float(reach[j - 1]), 1e-9)
        inner = line[1:j] - line[0]
        off = np.abs(inner[:, 0] * ahead[1] - inner[:, 1] * ahead[0])
        if off.max() <= CALM:
            return np.concatenate([line[:1], line[j:]])
    return line


def _names(chains: Sequence[Chain]) -> list[str]:
    """A name for every section: its first way's, numbered where that gives several."""
    total: dict[int, int] = {}
    for chain in chains:
        total[chain.ways[0]] = total.get(chain.ways[0], 0) + 1
    count: dict[int, int] = {}
    names = []
    for chain in chains:
        way = chain.ways[0]
        count[way] = count.get(way, 0) + 1
        names.append(f"{way}.{count[way]}" if total[way] > 1 else str(way))
    return names


def _describe(
    chain: Chain, ways: dict[int, Way], known: IntArray, grid: FloatArray, ground: float
) -> tuple[str, str, list[tuple[str, float, float]]]:
    """Line and name of the longer part of a section, and its stretches in tunnels by offset."""
    points = grid[np.searchsorted(known, chain.nodes)]
    run = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    run *= ground / run[-1] if run[-1] > 0.0 else 0.0
    share: dict[tuple[str, str], float] = {}
    stretches: list[tuple[str, float, float]] = []
    for i, number in enumerate(chain.ways):
        way = ways[number]
        for what, value in (("line", way.line), ("name", way.name)):
            share[what, value] = share.get((what, value), 0.0) + run[i + 1] - run[i]
        if way.tunnel:
            if stretches and stretches[-1][2] == run[i]:
                stretches[-1] = (stretches[-1][0], stretches[-1][1], float(run[i + 1]))
            else:
                stretches.append((way.name or way.line or str(number), float(run[i]), float(run[i + 1])))
    best = {
        what: max(((length, value) for (w, value), length in share.items() if w == what and value), default=(0.0, ""))[
            1
        ]
        for what in ("line", "name")
    }
    return best["line"], best["name"], [(n, round(a, 2), round(b, 2)) for n, a, b in stretches]


def _kilometres(found: Map, known: IntArray, grid: FloatArray, what: str) -> dict[str, float]:
    """Kilometres of ways by a tag."""
    total: dict[str, float] = {}
    for way in found.ways:
        points = grid[np.searchsorted(known, way.nodes)]
        value = getattr(way, what)
        total[value] = total.get(value, 0.0) + float(np.hypot(*np.diff(points, axis=0).T).sum()) / 1e3
    return {key: round(value, 3) for key, value in sorted(total.items(), key=lambda item: -item[1])[:12]}
