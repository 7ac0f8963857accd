"""The reference track model: a weighted metric graph in a projected plane, with permitted movements.

Conventions (house: `railnav.__doc__`): grid g = (easting, northing, height); offset is true 3-D arc length on the ground from
the track's start; grid_bearing clockwise from grid north; curvature = d(grid_bearing)/d(offset), positive to the right;
gradient = rise over horizontal run (tangent), positive uphill; cant in metres, positive with the left rail high; all as
offset grows.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError
from railnav.geodesy.grid import GridFrame
from railnav.track.chainage import LineReferences
from railnav.track.index import SpatialIndex, index_tracks
from railnav.units import wrap_angle

if TYPE_CHECKING:
    import geopandas
    import networkx as nx

    from railnav.track.records import ModelRecords, RecordSource

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


#: The knot columns in the order the kernels take them.
KNOT_COLUMNS = ("offset", "easting", "northing", "height", "grid_bearing", "curvature", "gradient", "cant", "scale")


class End(IntEnum):
    """An end of a track: offsets grow from START to FINISH."""

    START = 0
    FINISH = 1


class NodeKind(IntEnum):
    """What a point of the network is."""

    JOINT = 0
    TURNOUT = 1
    CROSSING = 2
    BUFFER_STOP = 3
    END_OF_MODEL = 4


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """The points of the network where track ends meet; arrays of length n.

    Attributes
    ----------
    id : tuple of str
        Unique names.
    kind : (n,) int array
        `NodeKind` values.
    easting, northing, height : (n,) array
        Grid position, m.
    """

    id: tuple[str, ...]
    kind: IntArray
    easting: FloatArray
    northing: FloatArray
    height: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MilePosts:
    """Published chainage at offsets: (k,) arrays sorted by track, then offset; chainage between them is linear.

    Attributes
    ----------
    track : (k,) int array
        Index of the track.
    offset : (k,) array
        True offset on that track, m.
    chainage : (k,) array
        Published chainage, m; may jump between tracks and need not agree with offset in length.
    """

    track: IntArray
    offset: FloatArray
    chainage: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TrackPoints:
    """Track geometry at given offsets: arrays of the shape asked for, frame g, SI and radians."""

    easting: FloatArray
    northing: FloatArray
    height: FloatArray
    grid_bearing: FloatArray
    heading: FloatArray
    curvature: FloatArray
    gradient: FloatArray
    cant: FloatArray
    chainage: FloatArray


@dataclass(frozen=True, slots=True)
class Candidate:
    """A foot point on a track near a position: never silently the nearest.

    Attributes
    ----------
    track : str
        Track identifier.
    offset : float
        Offset of the foot point, m.
    distance : float
        Horizontal distance to the foot point, m.
    cross : float
        Signed cross-track distance, m, positive to the right of growing offset.
    """

    track: str
    offset: float
    distance: float
    cross: float


@dataclass(frozen=True, slots=True)
class Route:
    """A lawful path: the tracks in the order met, the direction each is run in (+1 growing offset), and its true length, m."""

    tracks: tuple[str, ...]
    directions: tuple[int, ...]
    length: float


@dataclass(frozen=True, slots=True, eq=False)
class TrackModel:
    """Reference coordinate model of a railway: tracks as knot tables, nodes, permitted movements, chainage.

    All knots of all tracks lie one after another; track i owns `knot_start[i]:knot_start[i + 1]`.

    Attributes
    ----------
    frame : GridFrame
        The projected plane with its one pinned transformation from WGS 84.
    track_id, line, name : tuple of str, one a track
        Unique identifier; published line (may be empty); free name (may be empty).
    start_node, end_node : (t,) int array
        Node index at each track's START and FINISH.
    knot_start : (t + 1,) int array
        CSR pointer into the knot arrays.
    offset, easting, northing, height, grid_bearing, curvature, gradient, cant : (k,) array
        Knot tables; NaN height where the track has none (then gradient is 0 and lengths are horizontal at height 0).
    scale : (k,) array
        Grid metres per horizontal ground metre along the track (point scale times 1/(1 + h/R)).
    covariance_g : (k, 6) array
        Packed covariance of each knot (EE, EN, EU, NN, NU, UU), m^2; NaN where unknown.
    nodes : Nodes
    movements : (m, 4) int array
        Permitted movements: track a, end of a, track b, end of b. A train leaving a by that end enters b by that end, and the
        other way about; each pair stands once.
    mileposts : MilePosts
    provenance : dict
        Where the model came from: JSON values only.
    references : LineReferences
        Kilometres of the lines and the tracks they run over (see `railnav.track.chainage`); may be empty.
    record_source : callable or None
        Gives the square-root records of the surveys behind the model (`records`); None where it has none.
    """

    frame: GridFrame
    track_id: tuple[str, ...]
    line: tuple[str, ...]
    name: tuple[str, ...]
    start_node: IntArray
    end_node: IntArray
    knot_start: IntArray
    offset: FloatArray
    easting: FloatArray
    northing: FloatArray
    height: FloatArray
    grid_bearing: FloatArray
    curvature: FloatArray
    gradient: FloatArray
    cant: FloatArray
    scale: FloatArray
    covariance_g: FloatArray
    nodes: Nodes
    movements: IntArray
    mileposts: MilePosts
    provenance: dict[str, Any] = field(default_factory=dict)
    references: LineReferences = field(default_factory=LineReferences)
    record_source: RecordSource | None = field(default=None, repr=False)
    _index: SpatialIndex = field(init=False, repr=False)

    def __post_init__(self) -> None:
        tracks, knots, nodes = len(self.track_id), len(self.offset), len(self.nodes.id)
        if tracks == 0:
            raise TrackError("a model needs at least one track")
        for name in ("line", "name", "start_node", "end_node"):
            if len(getattr(self, name)) != tracks:
                raise TrackError(f"{name} has {len(getattr(self, name))} entries for {tracks} tracks")
        if len(self.knot_start) != tracks + 1 or self.knot_start[0] != 0 or self.knot_start[-1] != knots:
            raise TrackError(f"knot_start does not part {knots} knots into {tracks} tracks")
        if np.diff(self.knot_start).min() < 2:
            short = int(np.argmin(np.diff(self.knot_start)))
            raise TrackError(f"track {self.track_id[short]!r} has fewer than two knots")
        for name in KNOT_COLUMNS:
            if len(getattr(self, name)) != knots:
                raise TrackError(f"{name} has {len(getattr(self, name))} entries for {knots} knots")
        if self.covariance_g.shape != (knots, 6):
            raise TrackError(f"covariance_g has shape {self.covariance_g.shape}, not ({knots}, 6)")
        inside = np.ones(knots, bool)
        inside[self.knot_start[:-1]] = False
        backwards = np.flatnonzero(inside & (np.diff(self.offset, prepend=-np.inf) <= 0))
        if len(backwards):
            track = int(np.searchsorted(self.knot_start, backwards[0], side="right")) - 1
            raise TrackError(f"offsets of track {self.track_id[track]!r} do not grow at knot {int(backwards[0])}")
        for name in ("offset", "easting", "northing", "grid_bearing", "curvature", "gradient", "cant", "scale"):
            if not np.isfinite(getattr(self, name)).all():
                raise TrackError(f"{name} is not finite at knot {int(np.argmin(np.isfinite(getattr(self, name))))}")
        ends = np.concatenate([self.start_node, self.end_node])
        if ends.min() < 0 or ends.max() >= nodes:
            raise TrackError(f"a track ends at node {int(ends.max())} of {nodes}")
        if self.movements.shape[1:] != (4,) or (
            len(self.movements) and (self.movements.min() < 0 or self.movements[:, [0, 2]].max() >= tracks)
        ):
            raise TrackError("movements name a track that the model does not have")
        if len(self.references.track) and self.references.track.max() >= tracks:
            raise TrackError("a line reference names a track that the model does not have")
        for array in (
            self.start_node,
            self.end_node,
            self.knot_start,
            *(getattr(self, name) for name in KNOT_COLUMNS),
            self.covariance_g,
            self.movements,
            self.nodes.kind,
            self.nodes.easting,
            self.nodes.northing,
            self.nodes.height,
            self.mileposts.track,
            self.mileposts.offset,
            self.mileposts.chainage,
        ):
            array.flags.writeable = False
        object.__setattr__(self, "_index", index_tracks(self.knot_start, self.easting, self.northing))

    @classmethod
    def read(cls, path: str | Path) -> TrackModel:
        """Read a model from a GeoPackage; see `railnav.io.geopackage.read_model`."""
        from railnav.io.geopackage import read_model  # a door upward, named in the import contract

        return read_model(path)

    def to_file(self, path: str | Path) -> None:
        """Write the model as a GeoPackage; see `railnav.io.geopackage.write_model`."""
        from railnav.io.geopackage import write_model  # a door upward, named in the import contract

        write_model(self, path)

    @property
    def records(self) -> ModelRecords | None:
        """What the surveys behind the model know, to refine it with later runs (`railnav.update`); None where nothing is stored.

        Read from the file when asked for, not before.
        """
        return None if self.record_source is None else self.record_source()

    def to_geodataframe(self, layer: str = "tracks") -> geopandas.GeoDataFrame:
        """One layer of the model as a GeoDataFrame in its plane (extra "frames"); see `railnav.track.tables.model_table`.

        Parameters
        ----------
        layer : {"tracks", "knots", "nodes", "mileposts", "movements"}
            "movements" has no geometry and is a plain DataFrame.
        """
        from railnav.track.tables import frame_of, model_table

        return frame_of(model_table(self, layer))  # type: ignore[arg-type]  # an unknown layer is refused there

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """Arrow's PyCapsule protocol, one row a knot: `pyarrow.table(model)`, `polars.from_arrow(model)` and the like."""
        from railnav.track.tables import model_table

        return model_table(self, "knots").__arrow_c_stream__(requested_schema)

    @property
    def index(self) -> SpatialIndex:
        """Spatial index of all tracks, as flat arrays."""
        return self._index

    @property
    def knot_arrays(self) -> tuple[FloatArray, ...]:
        """The knot columns in the order the kernels take them, `KNOT_COLUMNS`."""
        return tuple(getattr(self, name) for name in KNOT_COLUMNS)

    @property
    def lengths(self) -> FloatArray:
        """True ground length of every track, (t,), m."""
        return self.offset[self.knot_start[1:] - 1] - self.offset[self.knot_start[:-1]]

    def track_index(self, track: str) -> int:
        """Index of a track by its identifier; raises TrackError with near names when the model has none such."""
        try:
            return self.track_id.index(track)
        except ValueError:
            from difflib import get_close_matches

            near = get_close_matches(track, self.track_id, 3)
            hint = f"; did you mean {', '.join(near)}" if near else f"; it has {len(self.track_id)} tracks"
            raise TrackError(f"the model has no track {track!r}{hint}") from None

    def length(self, track: str) -> float:
        """True ground length of a track, m."""
        return float(self.lengths[self.track_index(track)])

    def knots(self, track: str) -> slice:
        """Range of the knot arrays that a track owns."""
        i = self.track_index(track)
        return slice(int(self.knot_start[i]), int(self.knot_start[i + 1]))

    def at(self, track: str | ArrayLike, offset: ArrayLike) -> TrackPoints:
        """Geometry at offsets.

        Position is C2, bearing and curvature are continuous (quintic and cubic Hermite between knots, curvature linear).

        Parameters
        ----------
        track : str, or (m,) int array
            Identifier, or indices of tracks.
        offset : float or (m,) array
            Offsets on these tracks, m.

        Returns
        -------
        TrackPoints
            Arrays of the shape of `offset`; SI and radians.

        Raises
        ------
        TrackError
            An unknown track, or an offset beyond a track's ends by more than 1 mm.
        """
        offset = np.asarray(offset, np.float64)
        which = np.asarray(self.track_index(track) if isinstance(track, str) else track, np.int64)
        which, where = np.broadcast_arrays(which, offset)
        shape = where.shape
        which, where = np.ascontiguousarray(which.ravel()), where.ravel().copy()
        if len(which) and (which.min() < 0 or which.max() >= len(self.track_id)):
            raise TrackError(f"track index {int(which.min())}..{int(which.max())} outside 0..{len(self.track_id) - 1}")
        begin, end = self.offset[self.knot_start[:-1]][which], self.offset[self.knot_start[1:] - 1][which]
        outside = ~((where >= begin - 1e-3) & (where <= end + 1e-3))
        if outside.any():
            i = int(np.argmax(outside))
            raise TrackError(f"offset {where[i]} m is not on track {self.track_id[which[i]]!r}, 0..{end[i]:.3f} m")
        where = np.clip(where, begin, end)
        from railnav.track import _kernels

        table = _kernels.evaluate_many(self.knot_start, *self.knot_arrays, which, where)
        columns = [np.ascontiguousarray(table[:, k]).reshape(shape) for k in range(_kernels.POINT_SIZE)]
        easting, northing, height, bearing, curvature, gradient, cant, _ = columns
        return TrackPoints(
            easting=easting,
            northing=northing,
            height=height,
            grid_bearing=wrap_angle(bearing),
            heading=np.mod(bearing + self.frame.convergence(easting, northing), 2 * np.pi),
            curvature=curvature,
            gradient=gradient,
            cant=cant,
            chainage=self.chainage(which, where).reshape(shape),
        )

    def chainage(self, track: ArrayLike, offset: ArrayLike) -> FloatArray:
        """Published chainage of offsets, m: linear between posts, metre for metre beyond them, NaN without any.

        Parameters
        ----------
        track : (m,) int array
            Indices of tracks.
        offset : (m,) array
            True offsets, m.
        """
        track, offset = np.broadcast_arrays(np.asarray(track, np.int64), np.asarray(offset, np.float64))
        out = np.full(offset.shape, np.nan)
        posts = self.mileposts
        for i in np.unique(track):
            a, b = np.searchsorted(posts.track, [i, i + 1])
            if a == b:
                continue
            here = track == i
            x, y, s = posts.offset[a:b], posts.chainage[a:b], offset[here]
            sense = 1.0 if b - a < 2 or y[-1] >= y[0] else -1.0
            beyond = np.minimum(s - x[0], 0.0) + np.maximum(s - x[-1], 0.0)
            out[here] = np.interp(s, x, y) + sense * beyond
        return out

    def locate(self, easting: float, northing: float, *, within: float = 30.0) -> list[Candidate]:
        """Foot points on all tracks near a grid position, nearest first; empty when there is none.

        Parameters
        ----------
        easting, northing : float
            Position in the model's plane, m.
        within : float
            Greatest distance, m.

        Returns
        -------
        list of Candidate
            Every stretch of track that passes by, also a track twice when it comes near twice.
        """
        from railnav.track import _kernels

        if not (np.isfinite(easting) and np.isfinite(northing)):
            raise TrackError(f"position ({easting}, {northing}) is not finite")
        index, capacity = self._index, 256
        track, offset = np.empty(capacity, np.int64), np.empty(capacity)
        distance, cross = np.empty(capacity), np.empty(capacity)
        count = _kernels.locate(
            self.knot_start,
            *self.knot_arrays,
            index.keys,
            index.sample,
            index.sample_track,
            index.sample_knot,
            index.cell,
            index.east0,
            index.north0,
            index.columns,
            index.reach,
            float(easting),
            float(northing),
            float(within),
            track,
            offset,
            distance,
            cross,
        )
        return [
            Candidate(self.track_id[track[i]], float(offset[i]), float(distance[i]), float(cross[i]))
            for i in range(count)
        ]

    @property
    def graph(self) -> nx.DiGraph:
        """The network as a double-vertex digraph; every walk on it is lawful.

        Each track end is two vertices: `(track, end, "out")` for trains that enter the track there and `(track, end, "in")` for
        trains that arrive. Running a track leads from its "out" to the other end's "in" and weighs its true length; a permitted
        movement leads from an "in" to the next track's "out" and weighs nothing. Reversing is no edge.
        """
        import networkx as nx

        graph = nx.DiGraph()
        for i, (track, length) in enumerate(zip(self.track_id, self.lengths, strict=True)):
            for end in End:
                node = self.nodes.id[self.end_node[i] if end else self.start_node[i]]
                for side in ("out", "in"):
                    graph.add_node((track, end.name.lower(), side), node=node)
            graph.add_edge(
                (track, "start", "out"), (track, "finish", "in"), weight=float(length), track=track, direction=1
            )
            graph.add_edge(
                (track, "finish", "out"), (track, "start", "in"), weight=float(length), track=track, direction=-1
            )
        for a, end_a, b, end_b in self.movements.tolist():
            first = (self.track_id[a], End(end_a).name.lower())
            second = (self.track_id[b], End(end_b).name.lower())
            graph.add_edge((*first, "in"), (*second, "out"), weight=0.0)
            graph.add_edge((*second, "in"), (*first, "out"), weight=0.0)
        return graph

    def routes(self, a: str, b: str, *, at_most: int = 16) -> list[Route]:
        """Lawful paths from track `a` to track `b` without reversing, shortest first.

        Parameters
        ----------
        a, b : str
            First and last track, both run in full and counted in the length.
        at_most : int
            Greatest number of routes.

        Returns
        -------
        list of Route
            Empty when no lawful path exists.
        """
        import itertools

        import networkx as nx

        self.track_index(a), self.track_index(b)
        graph = self.graph
        routes: list[Route] = []
        for enter, leave in itertools.product(("start", "finish"), repeat=2):
            source, target = (a, enter, "out"), (b, leave, "in")
            try:
                paths = itertools.islice(nx.shortest_simple_paths(graph, source, target, weight="weight"), at_most)
                for path in paths:
                    runs = [graph.edges[u, v] for u, v in itertools.pairwise(path) if "track" in graph.edges[u, v]]
                    routes.append(
                        Route(
                            tuple(r["track"] for r in runs),
                            tuple(r["direction"] for r in runs),
                            float(sum(r["weight"] for r in runs)),
                        )
                    )
            except nx.NetworkXNoPath:
                continue
        return sorted(routes, key=lambda r: r.length)[:at_most]
