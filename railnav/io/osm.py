"""OpenStreetMap as a track network: ways become tracks between switches, crossings and ends, with the movements they permit.

The drawing is good to a metre and has kinks; it is rounded within 0.3 m (`railnav.io.drawn`). Which movements a node permits
follows from the directions of its ends over their first metres and from its tags: a turnout has one end on one side and two on the
other, a plain crossing two straight ways through, a slip crossing all ways across. There are no heights.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, InputError, RailnavError
from railnav.geodesy.grid import choose_frame
from railnav.io.drawn import round_lines
from railnav.run import Progress
from railnav.track.assembly import TrackSection, assemble
from railnav.track.model import MilePosts, NodeKind, TrackModel
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Values of `railway` that are tracks.
TRACKS = frozenset({"rail", "light_rail", "subway", "tram", "narrow_gauge"})
#: Greatest distance of the rounded curve from the drawing, m.
WITHIN = 0.3
#: Directions at a node are taken over this length of each end, m.
CHORD = 10.0
#: Vertices this near to a node, and no further than this off the straight to the next, only hide its direction, m.
CALM_REACH = 25.0
CALM = 0.15
#: No train passes a vertex that turns by more than this, rad.
DOUBLES_BACK = math.radians(100.0)
#: A train passes a drawn node when it turns by less than this, rad: tight curves are drawn with few vertices.
LARGEST_TURN = math.radians(60.0)
#: Movements that turn by more than this at their node are counted, rad.
SAID_TURN = math.radians(0.5)
#: Mile posts are laid on tracks of their line this near, m.
POST_REACH = 12.0
#: A post whose chainage disagrees with the others of its track by more than this is passed over, m.
POST_MISFIT = 250.0
#: Posts of one chainage this near are one, m.
SAME_POST = 15.0
#: Vertices nearer than this are one, m.
_SAME_VERTEX = 0.05
#: What one repeats while reading is said so often, then counted.
_MOST_NOTES = 20

_KILOMETRES = re.compile(r"^\s*(?:km\s*)?([+-]?\d{1,5})(?:[.,](\d{1,6}))?\s*(?:km)?\s*$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class _Way:
    """One way: its nodes and what its tags say."""

    id: int
    nodes: tuple[int, ...]
    kind: str
    line: str
    name: str
    tunnel: bool
    level: int
    electrified: str
    gauge: str


@dataclass(frozen=True, slots=True)
class _Map:
    """What a file holds of railways."""

    ways: tuple[_Way, ...]
    place: dict[int, tuple[float, float]]  # node: latitude, longitude, degrees
    tags: dict[int, dict[str, str]]  # of nodes that are something of a railway
    absent: int  # nodes of ways that the file lacks


@dataclass(frozen=True, slots=True)
class _Chain:
    """One track section: nodes in order, and the way of every step."""

    nodes: tuple[int, ...]
    ways: tuple[int, ...]


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
    found = _read_map(path)
    notes: list[str] = []
    if found.absent:
        notes.append(f"{found.absent} nodes of ways are not in the file; ways end there")
    chains = _chains(found.ways)
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
    junctions = _junctions(chains, lines, found.tags, notes)
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
    posts = _mileposts(model, found)
    corners = _corners(model, movements)
    if corners["slips"] or corners["others"]:
        notes.append(
            f"{corners['slips']} movements over slips drawn as a point and {corners['others']} others turn by more than half a degree "
            "at their node: no curve of 15 m within 0.3 m of the drawing meets them"
        )
    apart = _crossings_without_node(chains, lines, ways, frame)
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
        nodes=replace(model.nodes, kind=_kinds(model, chains, found.tags)),
        mileposts=posts.table,
        provenance={"import": told, "tunnels": tunnels},
    )


# --- the file ---------------------------------------------------------------------------------------------------------


def _read_map(path: Path) -> _Map:
    """Ways, the places of their nodes, and nodes of the railway."""
    try:
        import osmium
    except ImportError as error:
        raise RailnavError('OpenStreetMap needs osmium; install with: pip install "railnav[network]"') from error
    try:
        if path.is_dir():
            raise InputError("is a folder", file=path, remedy="name a .osm.pbf file")
        if path.stat().st_size == 0:
            raise InputError("is empty", file=path, remedy="download it again")
    except FileNotFoundError as error:
        raise InputError("does not exist", file=path, remedy="check the name") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(f"cannot be read ({reason})", file=path) from error
    raw: list[tuple[int, list[int], dict[str, str]]] = []
    place: dict[int, tuple[float, float]] = {}
    tags: dict[int, dict[str, str]] = {}
    try:
        source = osmium.FileProcessor(osmium.io.File(str(path), "pbf"))
        entities: Any = source.with_locations("flex_mem").with_filter(osmium.filter.KeyFilter("railway"))
        for entity in entities:  # a passing view, valid until the next one
            if entity.is_way() and entity.tags.get("railway") in TRACKS:
                raw.append((entity.id, [node.ref for node in entity.nodes], dict(entity.tags)))
                for node in entity.nodes:
                    if node.location.valid():
                        place[node.ref] = (node.location.lat, node.location.lon)
            elif entity.is_node() and entity.location.valid() and entity.tags.get("railway") in _NODES:
                place[entity.id] = (entity.location.lat, entity.location.lon)
                tags[entity.id] = dict(entity.tags)
    except (RuntimeError, ValueError, OSError, MemoryError) as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"is no whole OpenStreetMap file ({cause})", file=path, remedy="download it again") from error
    if not raw:
        raise InputError("holds no railway", file=path, remedy="extract railway=rail and the like")
    ways: list[_Way] = []
    absent = 0
    for number, nodes, words in raw:
        absent += sum(node not in place for node in nodes)
        ways += [_way(number, part, words) for part in _runs(nodes, place)]
    if not ways:
        raise InputError("holds ways without their nodes", file=path, remedy="extract ways complete with nodes")
    return _Map(tuple(ways), place, tags, absent)


#: Nodes of interest, by `railway`.
_NODES = frozenset({"switch", "railway_crossing", "tram_crossing", "milestone", "buffer_stop", "derail", "turntable"})


def _runs(nodes: Sequence[int], place: dict[int, tuple[float, float]]) -> Iterator[tuple[int, ...]]:
    """Stretches of a way whose nodes are there, repeated ones counted once."""
    run: list[int] = []
    for node in nodes:
        if node not in place:
            if len(run) > 1:
                yield tuple(run)
            run = []
        elif not run or run[-1] != node:
            run.append(node)
    if len(run) > 1:
        yield tuple(run)


def _way(number: int, nodes: tuple[int, ...], tags: dict[str, str]) -> _Way:
    try:
        level = int(float(tags.get("layer", "0")))
    except (ValueError, OverflowError):
        level = 0
    bridge = tags.get("bridge", "no") not in ("no", "")
    tunnel = tags.get("tunnel", "no") not in ("no", "")
    return _Way(
        number,
        nodes,
        tags.get("railway", ""),
        " ".join(tags.get("ref", "").split()),
        " ".join(tags.get("railway:track_ref", tags.get("name", "")).split()),
        tunnel,
        level if level else int(bridge) - int(tunnel),
        tags.get("electrified", "unknown"),
        tags.get("gauge", "unknown"),
    )


# --- the graph --------------------------------------------------------------------------------------------------------


def _chains(ways: Sequence[_Way]) -> list[_Chain]:
    """Track sections: from node to node where other than two steps meet; a ring is cut at its smallest node."""
    steps: dict[int, list[tuple[int, int]]] = {}  # node: (step, other node)
    drawn: list[tuple[int, int, int]] = []
    seen: set[tuple[int, int]] = set()
    for way in ways:
        for a, b in zip(way.nodes, way.nodes[1:], strict=False):
            key = (min(a, b), max(a, b))
            if key in seen:  # two ways over one step: one track
                continue
            seen.add(key)
            steps.setdefault(a, []).append((len(drawn), b))
            steps.setdefault(b, []).append((len(drawn), a))
            drawn.append((a, b, way.id))
    used = np.zeros(len(drawn), bool)

    def walk(start: int, step: int, onward: int) -> _Chain:
        nodes, by = [start, onward], [drawn[step][2]]
        used[step] = True
        while len(steps[onward]) == 2 and onward != start:
            (first, a), (second, b) = steps[onward]
            step, onward = (second, b) if first == step else (first, a)
            if used[step]:
                break
            used[step] = True
            nodes.append(onward)
            by.append(drawn[step][2])
        return _Chain(tuple(nodes), tuple(by))

    chains: list[_Chain] = []
    forward = {(a, b) for a, b, _ in drawn}
    for node, around in steps.items():
        if len(around) != 2:
            chains += [walk(node, step, other) for step, other in around if not used[step]]
    for step, (a, b, _) in enumerate(drawn):
        if not used[step]:
            ring = walk(a, step, b)
            middle = len(ring.ways) // 2  # two halves: a track has two ends
            chains.append(_Chain(ring.nodes[: middle + 1], ring.ways[:middle]))
            chains.append(_Chain(ring.nodes[middle:], ring.ways[middle:]))
    return [_along(chain, forward) for chain in chains if chain.ways]


def _along(chain: _Chain, forward: set[tuple[int, int]]) -> _Chain:
    """A section in the direction that most of its steps are drawn in."""
    agree = sum(pair in forward for pair in zip(chain.nodes, chain.nodes[1:], strict=False))
    return chain if 2 * agree >= len(chain.ways) else _Chain(chain.nodes[::-1], chain.ways[::-1])


def _lines(
    chains: Sequence[_Chain], known: IntArray, grid: FloatArray, notes: list[str]
) -> tuple[list[FloatArray], list[_Chain]]:
    """Vertices of every section, near-repeated ones left out; sections of no length are dropped."""
    lines: list[FloatArray] = []
    kept: list[_Chain] = []
    for chain in (part for whole in chains for part in _unfolded(whole, known, grid, notes)):
        points = grid[np.searchsorted(known, chain.nodes)]
        keep = np.append(True, np.hypot(*np.diff(points, axis=0).T) >= _SAME_VERTEX)
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


def _unfolded(chain: _Chain, known: IntArray, grid: FloatArray, notes: list[str]) -> list[_Chain]:
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
    return [_Chain(chain.nodes[a : b + 1], chain.ways[a:b]) for a, b in pairwise(borders)]


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


def _names(chains: Sequence[_Chain]) -> list[str]:
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
    chain: _Chain, ways: dict[int, _Way], known: IntArray, grid: FloatArray, ground: float
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


def _kilometres(found: _Map, known: IntArray, grid: FloatArray, what: str) -> dict[str, float]:
    """Kilometres of ways by a tag."""
    total: dict[str, float] = {}
    for way in found.ways:
        points = grid[np.searchsorted(known, way.nodes)]
        value = getattr(way, what)
        total[value] = total.get(value, 0.0) + float(np.hypot(*np.diff(points, axis=0).T).sum()) / 1e3
    return {key: round(value, 3) for key, value in sorted(total.items(), key=lambda item: -item[1])[:12]}


# --- movements --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Junctions:
    """What the nodes permit: by node, pairs of ends (2 * section + 0 start, 1 finish), and directions into the sections.

    `direction` (s, 2) is the bearing that points from each end into its section, NaN where the drawn one stands.
    """

    permitted: list[tuple[int, int]]
    direction: FloatArray
    told: dict[str, int]


def _junctions(
    chains: Sequence[_Chain], lines: Sequence[FloatArray], tags: dict[int, dict[str, str]], notes: list[str]
) -> _Junctions:
    """Movements and end directions of every node."""
    into = np.array([[_into(line), _into(line[::-1])] for line in lines]).reshape(-1)
    ends: dict[int, list[int]] = {}
    for i, chain in enumerate(chains):
        ends.setdefault(chain.nodes[0], []).append(2 * i)
        ends.setdefault(chain.nodes[-1], []).append(2 * i + 1)
    permitted: list[tuple[int, int]] = []
    direction = np.full(2 * len(chains), np.nan)
    told = dict.fromkeys(
        ("turnouts", "three_way", "double_slips", "single_slips", "crossings", "joints", "not_lawful"), 0
    )
    for node, members in ends.items():
        if len(members) < 2:
            continue
        words = tags.get(node, {})
        kind = words.get("railway:switch", words.get("switch", "")) if words.get("railway") == "switch" else ""
        slip = kind in ("double_slip", "single_slip")
        pairs, name = _movements(members, into, slip, words.get("railway") == "switch")
        told[name] += 1
        if name == "double_slips" and kind == "single_slip":
            told["double_slips"] -= 1
            told["single_slips"] += 1
        if name == "not_lawful":
            notes.append(f"node {node}: {len(members)} tracks meet at angles that no train can pass in every direction")
        permitted += [(a, b) for a, b, _ in pairs]
        # the straightest way through gives the direction that its ends, and legs that branch off, share
        straight: set[int] = set()
        for a, b, _ in sorted(pairs, key=lambda pair: pair[2]):
            if a in straight and b in straight:
                continue
            if a not in straight and b not in straight:
                through = float(into[a]) + 0.5 * float(wrap_angle(into[b] + math.pi - into[a]))
                direction[a], direction[b] = through, through + math.pi
            elif len(members) == 3:
                stem, leg = (a, b) if a in straight else (b, a)
                direction[leg] = direction[stem] + math.pi
            straight |= {a, b}
    if told["single_slips"]:
        notes.append(f"{told['single_slips']} single slips: their side is not known, both are permitted")
    return _Junctions(permitted, direction.reshape(-1, 2), told)


def _into(line: FloatArray) -> float:
    """Bearing from the first vertex to the point some metres along the line."""
    run = np.append(0.0, np.cumsum(np.hypot(*np.diff(line[:12], axis=0).T)))
    reach = min(CHORD, float(run[-1]))
    east, north = (float(np.interp(reach, run, line[:12, k])) for k in (0, 1))
    step = (east - line[0, 0], north - line[0, 1])
    return math.atan2(*step) if math.hypot(*step) > 1e-3 else math.atan2(*(line[1] - line[0]))


def _movements(
    members: Sequence[int], into: FloatArray, slip: bool, switch: bool
) -> tuple[list[tuple[int, int, float]], str]:
    """Pairs of ends that a train may pass between, with its turn, and what the node is."""
    turns = {
        (a, b): abs(float(wrap_angle(into[b] - into[a] - math.pi)))
        for i, a in enumerate(members)
        for b in members[i + 1 :]
    }
    open_ = [(a, b, turn) for (a, b), turn in turns.items() if turn < LARGEST_TURN]

    def turn(a: int, b: int) -> float:
        return turns[a, b] if (a, b) in turns else turns[b, a]

    if len(members) == 2:
        return open_, "joints" if open_ else "not_lawful"
    if len(members) == 3:
        stem = min(members, key=lambda s: sum(turn(s, other) for other in members if other != s))
        pairs = [(stem, other, turn(stem, other)) for other in members if other != stem]
        if all(t < LARGEST_TURN for _, _, t in pairs):
            return pairs, "turnouts"
        return [pair for pair in pairs if pair[2] < LARGEST_TURN], "not_lawful"
    if len(members) == 4:
        a, b, c, d = members
        ways = [((a, b), (c, d)), ((a, c), (b, d)), ((a, d), (b, c))]
        straight = min(ways, key=lambda way: sum(turn(*pair) for pair in way))
        through = [(*pair, turn(*pair)) for pair in straight]
        if all(t < LARGEST_TURN for *_, t in through):
            if slip or switch:
                return open_, "double_slips"
            return through, "crossings"
        for stem in members:
            legs = [(stem, other, turn(stem, other)) for other in members if other != stem]
            if all(t < LARGEST_TURN for *_, t in legs):
                return legs, "three_way"
    return open_, "not_lawful"


def _kinds(model: TrackModel, chains: Sequence[_Chain], tags: dict[int, dict[str, str]]) -> IntArray:
    """Kinds of the model's nodes by the number of ends there; buffer stops by their tag."""
    kind = np.asarray(model.nodes.kind).copy()
    degree = np.bincount(np.concatenate([model.start_node, model.end_node]), minlength=len(kind))
    kind[degree == 1] = NodeKind.END_OF_MODEL
    kind[degree == 2] = NodeKind.JOINT
    kind[degree == 3] = NodeKind.TURNOUT
    kind[degree >= 4] = NodeKind.CROSSING
    for i, chain in enumerate(chains):
        for node, number in ((chain.nodes[0], model.start_node[i]), (chain.nodes[-1], model.end_node[i])):
            if degree[number] == 1 and tags.get(node, {}).get("railway") == "buffer_stop":
                kind[number] = NodeKind.BUFFER_STOP
    return kind


def _corners(model: TrackModel, movements: IntArray) -> dict[str, int]:
    """Movements whose direction still turns at the node, over slips and elsewhere."""
    ends = np.stack([model.knot_start[:-1], model.knot_start[1:] - 1])
    bearing = model.grid_bearing[ends] + np.array([[math.pi], [0.0]])  # of a train that leaves by this end
    leave = bearing[movements[:, 1], movements[:, 0]]
    enter = bearing[movements[:, 3], movements[:, 2]] + math.pi
    turned = np.abs(wrap_angle(enter - leave)) > SAID_TURN
    node = np.where(movements[:, 1] == 1, model.end_node[movements[:, 0]], model.start_node[movements[:, 0]])
    degree = np.bincount(np.concatenate([model.start_node, model.end_node]), minlength=len(model.nodes.id))[node]
    return {"slips": int((turned & (degree > 3)).sum()), "others": int((turned & (degree <= 3)).sum())}


def _crossings_without_node(
    chains: Sequence[_Chain], lines: Sequence[FloatArray], ways: dict[int, _Way], frame: Any
) -> list[str]:
    """Tracks on one level that cross where no node says so."""
    import shapely

    # steps with the level of their way; ends are shrunk so that tracks which meet in a node do not cross there
    shapes, owner, level = [], [], []
    for i, (chain, line) in enumerate(zip(chains, lines, strict=True)):
        levels = {ways[number].level for number in chain.ways}
        if len(levels) == 1 and len(line) == 2 and np.hypot(*(line[1] - line[0])) < 1.0:
            continue
        shapes.append(shapely.LineString(line))
        owner.append(i)
        level.append(levels)
    tree = shapely.STRtree(shapes)
    first, second = tree.query(shapes, predicate="crosses")
    told = []
    for a, b in sorted({(min(i, j), max(i, j)) for i, j in zip(first.tolist(), second.tolist(), strict=True)}):
        one, other = chains[owner[a]], chains[owner[b]]
        if level[a].isdisjoint(level[b]) or len(level[a]) > 1 or len(level[b]) > 1:
            continue
        meet = shapely.get_coordinates(shapely.intersection(shapes[a], shapes[b]))
        ends = np.concatenate([lines[owner[k]][[0, -1]] for k in (a, b)])
        free = [point for point in meet if np.hypot(*(ends - point).T).min() > _SAME_VERTEX]
        if free:
            latitude, longitude, _ = frame.to_geodetic(free[0][0], free[0][1])
            told.append(
                f"ways {one.ways[0]} and {other.ways[0]} cross without a node at "
                f"{math.degrees(float(latitude)):.6f}, {math.degrees(float(longitude)):.6f}"
            )
    return told


# --- mile posts -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Posts:
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


def _mileposts(model: TrackModel, found: _Map) -> _Posts:
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
    return _Posts(MilePosts(table[:, 0].astype(np.int64), table[:, 1].copy(), table[:, 2].copy()), told)


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
