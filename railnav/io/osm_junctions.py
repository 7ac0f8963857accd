"""Movements of OpenStreetMap's switches and crossings, and what kind of node each is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.io.osm_map import Chain, Way
from railnav.track.model import NodeKind, TrackModel
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
#: Directions at a node are taken over this length of each end, m.
CHORD = 10.0
#: A train passes a drawn node when it turns by less than this, rad: tight curves are drawn with few vertices.
LARGEST_TURN = math.radians(60.0)
#: Movements that turn by more than this at their node are counted, rad.
SAID_TURN = math.radians(0.5)
#: Vertices nearer than this are one, m.
SAME_VERTEX = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Junctions:
    """What the nodes permit: by node, pairs of ends (2 * section + 0 start, 1 finish), and directions into the sections.

    `direction` (s, 2) is the bearing that points from each end into its section, NaN where the drawn one stands.
    """

    permitted: list[tuple[int, int]]
    direction: FloatArray
    told: dict[str, int]


def find_junctions(
    chains: Sequence[Chain], lines: Sequence[FloatArray], tags: dict[int, dict[str, str]], notes: list[str]
) -> Junctions:
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
        pairs, name = permitted_movements(members, into, slip, words.get("railway") == "switch")
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
    return Junctions(permitted, direction.reshape(-1, 2), told)


def _into(line: FloatArray) -> float:
    """Bearing from the first vertex to the point some metres along the line."""
    run = np.append(0.0, np.cumsum(np.hypot(*np.diff(line[:12], axis=0).T)))
    reach = min(CHORD, float(run[-1]))
    east, north = (float(np.interp(reach, run, line[:12, k])) for k in (0, 1))
    step = (east - line[0, 0], north - line[0, 1])
    return math.atan2(*step) if math.hypot(*step) > 1e-3 else math.atan2(*(line[1] - line[0]))


def permitted_movements(
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


def node_kinds(model: TrackModel, chains: Sequence[Chain], tags: dict[int, dict[str, str]]) -> IntArray:
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


def count_corners(model: TrackModel, movements: IntArray) -> dict[str, int]:
    """Movements whose direction still turns at the node, over slips and elsewhere."""
    ends = np.stack([model.knot_start[:-1], model.knot_start[1:] - 1])
    bearing = model.grid_bearing[ends] + np.array([[math.pi], [0.0]])  # of a train that leaves by this end
    leave = bearing[movements[:, 1], movements[:, 0]]
    enter = bearing[movements[:, 3], movements[:, 2]] + math.pi
    turned = np.abs(wrap_angle(enter - leave)) > SAID_TURN
    node = np.where(movements[:, 1] == 1, model.end_node[movements[:, 0]], model.start_node[movements[:, 0]])
    degree = np.bincount(np.concatenate([model.start_node, model.end_node]), minlength=len(model.nodes.id))[node]
    return {"slips": int((turned & (degree > 3)).sum()), "others": int((turned & (degree <= 3)).sum())}


def crossings_without_node(
    chains: Sequence[Chain], lines: Sequence[FloatArray], ways: dict[int, Way], frame: Any
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
        free = [point for point in meet if np.hypot(*(ends - point).T).min() > SAME_VERTEX]
        if free:
            latitude, longitude, _ = frame.to_geodetic(free[0][0], free[0][1])
            told.append(
                f"ways {one.ways[0]} and {other.ways[0]} cross without a node at "
                f"{math.degrees(float(latitude)):.6f}, {math.degrees(float(longitude)):.6f}"
            )
    return told
