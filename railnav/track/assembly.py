"""Assemble tracks into a network: join ends, name the nodes, derive the movements that the tangents permit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.track.alignment import KnotTable
from railnav.track.model import MilePosts, NodeKind, Nodes, TrackModel
from railnav.units import wrap_angle

if TYPE_CHECKING:
    from railnav.geodesy.grid import GridFrame
    from railnav.track.records import RecordSource

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Ends at different levels by more than this do not join, m (a bridge over a line).
JOIN_HEIGHT = 2.0
#: A train passes from end to end when it turns by less than this, rad.
LARGEST_TURN = math.radians(15.0)
#: Where four or more ends meet, only turns this close to the straightest one are permitted, rad: a plain diamond has no slip.
CROSSING_TOLERANCE = math.radians(2.0)


@dataclass(frozen=True, slots=True, eq=False)
class TrackSection:
    """One track between two nodes, before assembly.

    Attributes
    ----------
    track_id : str
        Unique identifier.
    knots : KnotTable
        Its geometry.
    line, name : str
        Published line; free name.
    start_chainage, end_chainage : float or None
        Published chainage at the ends, m.
    posts : (p, 2) array or None
        Further (offset, chainage) pairs, m.
    """

    track_id: str
    knots: KnotTable
    line: str = ""
    name: str = ""
    start_chainage: float | None = None
    end_chainage: float | None = None
    posts: FloatArray | None = None


def assemble(
    frame: GridFrame,
    sections: Sequence[TrackSection],
    *,
    join_within: float = 0.5,
    provenance: dict[str, Any] | None = None,
    record_source: RecordSource | None = None,
) -> TrackModel:
    """Join track sections into a model.

    Ends within `join_within` of each other (and 2 m in height) are one node. A movement between two ends of a node is permitted
    when the train's direction changes by less than 15 degrees; where four or more ends meet, only within 2 degrees of the
    straightest way on, so that a plain diamond crossing has no slip movements.

    Parameters
    ----------
    frame : GridFrame
        Plane of the sections.
    sections : sequence of TrackSection
        At least one; identifiers unique.
    join_within : float
        Greatest distance of joined ends, m.
    provenance : dict, optional
        Where the model comes from; JSON values.
    record_source : callable, optional
        Gives the records of the surveys behind it.

    Returns
    -------
    TrackModel

    Raises
    ------
    TrackError
        No sections, or an identifier twice.
    """
    if not sections:
        raise TrackError("a model needs at least one track")
    seen: set[str] = set()
    for section in sections:
        if section.track_id in seen:
            raise TrackError(f"track {section.track_id!r} stands twice; identifiers are unique")
        seen.add(section.track_id)
    tables = [section.knots for section in sections]
    # ends in the order: track 0 START, track 0 FINISH, track 1 START, ...
    ends = np.array([[t.easting[i], t.northing[i], t.height[i]] for t in tables for i in (0, -1)])
    node_of_end = _cluster(ends, join_within)
    movements = _movements(tables, node_of_end)
    nodes = _nodes(ends, node_of_end, movements)

    post_track: list[int] = []
    posts: list[FloatArray] = []
    for i, section in enumerate(sections):
        pairs = [] if section.posts is None else [np.asarray(section.posts, float).reshape(-1, 2)]
        if section.start_chainage is not None:
            pairs.insert(0, np.array([[0.0, section.start_chainage]]))
        if section.end_chainage is not None:
            pairs.append(np.array([[section.knots.offset[-1], section.end_chainage]]))
        if pairs:
            table = np.concatenate(pairs)
            table = table[np.argsort(table[:, 0], kind="stable")]
            table = table[np.append(True, np.diff(table[:, 0]) > 0)]
            posts.append(table)
            post_track += [i] * len(table)
    post = np.concatenate(posts) if posts else np.empty((0, 2))

    def stacked(name: str) -> FloatArray:
        return np.concatenate([np.asarray(getattr(t, name), float) for t in tables])

    return TrackModel(
        frame=frame,
        track_id=tuple(s.track_id for s in sections),
        line=tuple(s.line for s in sections),
        name=tuple(s.name for s in sections),
        start_node=node_of_end[0::2],
        end_node=node_of_end[1::2],
        knot_start=np.append(0, np.cumsum([len(t.offset) for t in tables])).astype(np.int64),
        offset=stacked("offset"),
        easting=stacked("easting"),
        northing=stacked("northing"),
        height=stacked("height"),
        grid_bearing=stacked("grid_bearing"),
        curvature=stacked("curvature"),
        gradient=stacked("gradient"),
        cant=stacked("cant"),
        scale=stacked("scale"),
        covariance_g=stacked("covariance_g"),
        nodes=nodes,
        movements=movements,
        mileposts=MilePosts(np.array(post_track, np.int64), post[:, 0].copy(), post[:, 1].copy()),
        provenance=dict(provenance or {}),
        record_source=record_source,
    )


def _cluster(ends: FloatArray, within: float) -> IntArray:
    """Node number of each end: ends joined by a chain of near neighbours share one; numbered in order of appearance."""
    from scipy.spatial import cKDTree

    parent = np.arange(len(ends))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = int(parent[i])
        return i

    for a, b in sorted(cKDTree(ends[:, :2]).query_pairs(within)):
        rise = abs(ends[a, 2] - ends[b, 2])
        if not rise > JOIN_HEIGHT:  # NaN: a height is missing, the plane decides
            ra, rb = root(a), root(b)
            parent[max(ra, rb)] = min(ra, rb)
    roots = np.array([root(i) for i in range(len(ends))])
    _, number = np.unique(roots, return_inverse=True)
    return number.astype(np.int64)


def _movements(tables: Sequence[KnotTable], node_of_end: IntArray) -> IntArray:
    """Permitted movements, (m, 4): track a, end a, track b, end b."""
    leaving = np.empty(2 * len(tables))  # direction of a train that leaves the track by this end
    for i, t in enumerate(tables):
        leaving[2 * i] = t.grid_bearing[0] + np.pi
        leaving[2 * i + 1] = t.grid_bearing[-1]
    members: dict[int, list[int]] = {}
    for e, node in enumerate(node_of_end):
        members.setdefault(int(node), []).append(e)
    found: list[tuple[int, int, int, int]] = []
    for group in members.values():
        turns = {
            (a, b): abs(float(wrap_angle(leaving[b] + np.pi - leaving[a]))) for a in group for b in group if a != b
        }
        for i, a in enumerate(group):
            for b in group[i + 1 :]:
                if turns[a, b] >= LARGEST_TURN:
                    continue
                if len(group) >= 4:
                    straightest = max(
                        min(turns[a, c] for c in group if c != a), min(turns[b, c] for c in group if c != b)
                    )
                    if turns[a, b] > straightest + CROSSING_TOLERANCE:
                        continue
                found.append((a // 2, a % 2, b // 2, b % 2))
    return np.array(found, np.int64).reshape(-1, 4)


def _nodes(ends: FloatArray, node_of_end: IntArray, movements: IntArray) -> Nodes:
    """Nodes at the mean of their ends, their kind from what meets and moves there."""
    count = int(node_of_end.max()) + 1
    degree = np.bincount(node_of_end, minlength=count)
    position = np.empty((count, 3))
    for k in range(3):
        position[:, k] = np.bincount(node_of_end, weights=ends[:, k], minlength=count) / degree
    passing = np.bincount(node_of_end[2 * movements[:, 0] + movements[:, 1]], minlength=count)
    kind = np.full(count, NodeKind.JOINT, np.int64)
    kind[degree == 1] = NodeKind.END_OF_MODEL
    kind[(degree == 3) & (passing >= 2)] = NodeKind.TURNOUT
    kind[degree >= 4] = NodeKind.CROSSING
    width = len(str(count))
    return Nodes(
        tuple(f"n{i + 1:0{width}d}" for i in range(count)), kind, position[:, 0], position[:, 1], position[:, 2]
    )
