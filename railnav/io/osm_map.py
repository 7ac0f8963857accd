"""The map in an OpenStreetMap file: ways of rails with their nodes and tags, and chains of them between nodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from railnav.errors import InputError, RailnavError

#: Values of `railway` that are tracks.
TRACKS = frozenset({"rail", "light_rail", "subway", "tram", "narrow_gauge"})


@dataclass(frozen=True, slots=True)
class Way:
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
class Map:
    """What a file holds of railways."""

    ways: tuple[Way, ...]
    place: dict[int, tuple[float, float]]  # node: latitude, longitude, degrees
    tags: dict[int, dict[str, str]]  # of nodes that are something of a railway
    absent: int  # nodes of ways that the file lacks


@dataclass(frozen=True, slots=True)
class Chain:
    """One track section: nodes in order, and the way of every step."""

    nodes: tuple[int, ...]
    ways: tuple[int, ...]


def read_map(path: Path) -> Map:
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
    ways: list[Way] = []
    absent = 0
    for number, nodes, words in raw:
        absent += sum(node not in place for node in nodes)
        ways += [_way(number, part, words) for part in _runs(nodes, place)]
    if not ways:
        raise InputError("holds ways without their nodes", file=path, remedy="extract ways complete with nodes")
    return Map(tuple(ways), place, tags, absent)


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


def _way(number: int, nodes: tuple[int, ...], tags: dict[str, str]) -> Way:
    try:
        level = int(float(tags.get("layer", "0")))
    except (ValueError, OverflowError):
        level = 0
    bridge = tags.get("bridge", "no") not in ("no", "")
    tunnel = tags.get("tunnel", "no") not in ("no", "")
    return Way(
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


def join_ways(ways: Sequence[Way]) -> list[Chain]:
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

    def walk(start: int, step: int, onward: int) -> Chain:
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
        return Chain(tuple(nodes), tuple(by))

    chains: list[Chain] = []
    forward = {(a, b) for a, b, _ in drawn}
    for node, around in steps.items():
        if len(around) != 2:
            chains += [walk(node, step, other) for step, other in around if not used[step]]
    for step, (a, b, _) in enumerate(drawn):
        if not used[step]:
            ring = walk(a, step, b)
            middle = len(ring.ways) // 2  # two halves: a track has two ends
            chains.append(Chain(ring.nodes[: middle + 1], ring.ways[:middle]))
            chains.append(Chain(ring.nodes[middle:], ring.ways[middle:]))
    return [_continued(chain, forward) for chain in chains if chain.ways]


def _continued(chain: Chain, forward: set[tuple[int, int]]) -> Chain:
    """A section in the direction that most of its steps are drawn in."""
    agree = sum(pair in forward for pair in zip(chain.nodes, chain.nodes[1:], strict=False))
    return chain if 2 * agree >= len(chain.ways) else Chain(chain.nodes[::-1], chain.ways[::-1])
