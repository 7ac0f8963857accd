"""railML 2 infrastructure: tracks by their geographic points, cut at switches; movements by their connections.

A track's points are the geoCoord of its begin, end, switches and geoMappings, at the positions (`pos`) they state. Where a track has none
between its ends but radius changes (negative to the left, 0 straight), its arcs are laid between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError
from railnav.geodesy.grid import GridFrame, choose_frame, frame_for_grid
from railnav.io.design import lay
from railnav.io.drawn import lay_line
from railnav.io.railml_document import Reader
from railnav.io.xml_document import children, local_name
from railnav.track.alignment import KnotTable
from railnav.track.assembly import TrackSection, assemble
from railnav.track.elements import ARC, STRAIGHT, Gradients, Plan, integrate
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

#: Arcs laid by radius changes may miss the track's end by this share of its length, and 1 m.
_MISS = 2e-3
#: Positions on a track that agree within this are one, m.
_SAME_POS = 0.01


@dataclass(slots=True)
class _Track:
    """One track as the file has it: everything by position from its begin, m."""

    id: str
    name: str
    node: Any
    length: float
    points: list[tuple[float, tuple[float, ...]]]  # position, coordinates as they stand
    switches: list[tuple[float, Any]]
    radii: list[tuple[float, float]]
    slopes: list[tuple[float, float]]
    marks: list[tuple[float, float]]  # position, published position
    balises: list[tuple[float, Any]]
    parts: list[str] = field(default_factory=list)
    cuts: list[float] = field(default_factory=list)


def read_tracks(path: Path, root: Any, *, crs: Any, zone_width: int, ellipsoid: str, spacing: float) -> TrackModel:
    """Read the tracks of a railML 2 file; see `railnav.io.railml.read_railml`.

    Raises
    ------
    InputError
        No tracks, a track without positions at its ends, coordinates of several systems, a connection to what is not there.
    """
    reader = Reader(path)
    nodes = [node for node in root.iter() if local_name(node) == "track" and children(node, "trackTopology")]
    if not nodes:
        raise InputError("has no track with a trackTopology", file=path, remedy="export the infrastructure")
    systems: set[str] = set()
    tracks = [_track(reader, node, systems) for node in nodes]
    seen: set[str] = set()
    for track in tracks:
        if track.id in seen:
            reader.refuse(track.node, "stands twice", "give every track its own id")
        seen.add(track.id)
    frame, where = _frame(reader, root, tracks, systems, crs, zone_width, ellipsoid)
    sections: list[TrackSection] = []
    for track, points in zip(tracks, where, strict=True):
        sections += _sections(reader, frame, track, points, spacing)
    model = assemble(frame, sections)
    movements = _movements(reader, tracks, {name: i for i, name in enumerate(model.track_id)})
    balises = [
        {
            "id": str(node.get("id", "")),
            "name": str(node.get("name") or node.get("id") or ""),
            "track": track.parts[k],
            "offset_m": round(model.length(track.parts[k]) * share, 4),
        }
        for track in tracks
        for pos, node in track.balises
        for k, share in [_part(track, pos)]
    ]
    told = {
        "format": "railML",
        "version": str(root.get("version", "2")),
        "source": path.name,
        "tracks": len(tracks),
        "sections": len(sections),
        "switches": sum(len(track.switches) for track in tracks),
        "balises": len(balises),
        "notes": reader.told(),
    }
    return replace(
        model,
        movements=movements if len(movements) else model.movements,
        provenance={"import": told, "balises": balises},
    )


def _track(reader: Reader, node: Any, systems: set[str]) -> _Track:
    name = str(node.get("id") or node.get("name") or "")
    if not name:
        reader.refuse(node, "has neither id nor name")
    topology = children(node, "trackTopology")[0]
    begin, end = (children(topology, kind) for kind in ("trackBegin", "trackEnd"))
    if not begin or not end:
        reader.refuse(topology, "has no trackBegin or no trackEnd")
    first = reader.number(begin[0], "pos", 0.0)
    length = reader.number(end[0], "pos") - first
    if not 1e-2 < length < 1e7:
        reader.refuse(end[0], f"lies {length:g} m from the trackBegin", "pos counts metres from the track's begin")
    track = _Track(name, str(node.get("name", "")), node, length, [], [], [], [], [], [])

    def position(item: Any) -> float:
        return reader.number(item, "pos", low=first - 1.0, high=first + length + 1.0) - first

    def point(item: Any, at: float) -> None:
        for place in children(item, "geoCoord"):
            try:
                values = [float(word) for word in str(place.get("coord", "")).split()]
            except ValueError:
                values = []
            if len(values) not in (2, 3) or not all(abs(v) < 1e9 for v in values):
                reader.refuse(item, f"coord is {str(place.get('coord'))[:40]!r}, not two or three numbers")
            if len(values) == 2 and place.get("extraHeight"):
                values.append(reader.number(place, "extraHeight", low=-1000.0, high=10_000.0))
            systems.add(str(place.get("epsgCode", "")))
            track.points.append((at, tuple(values)))

    for item, at in ((begin[0], 0.0), (end[0], length)):
        point(item, at)
        if item.get("absPos") is not None:
            track.marks.append((at, reader.number(item, "absPos")))
    for item in node.iter():
        kind = local_name(item)
        if kind in ("switch", "crossing") and item.get("pos") is not None:
            at = position(item)
            point(item, at)
            track.switches.append((at, item))
        elif kind == "geoMapping":
            point(item, position(item))
        elif kind == "radiusChange":
            track.radii.append((position(item), reader.number(item, "radius")))
        elif kind == "gradientChange":
            track.slopes.append((position(item), reader.number(item, "slope", low=-500.0, high=500.0) * 1e-3))
        elif kind == "mileageChange":
            at = position(item)
            for attribute, off in (("absPosIn", -5e-4), ("absPos", 5e-4)):
                if item.get(attribute) is not None:
                    track.marks.append((at + off, reader.number(item, attribute)))
        elif kind == "balise" and item.get("pos") is not None:
            track.balises.append((position(item), item))
    return track


def _frame(
    reader: Reader,
    root: Any,
    tracks: Sequence[_Track],
    systems: set[str],
    crs: Any,
    zone_width: int,
    ellipsoid: str,
) -> tuple[GridFrame, list[FloatArray]]:
    """The plane, and the points of every track in it: rows of position, easting, northing, height."""
    import pyproj
    from pyproj.exceptions import CRSError

    for track in tracks:
        kept = dict(sorted(track.points))
        if len(kept) < 2 or min(kept) > _SAME_POS or max(kept) < track.length - _SAME_POS:
            reader.refuse(
                track.node,
                "has no geoCoord at both of its ends",
                "export geographic positions: a network without places is no track model",
            )
        track.points = sorted(kept.items())
    default = {
        str(item.get("epsgCode"))
        for info in root.iter()
        if local_name(info) == "infraAttributes"
        for item in info.iter()
        if local_name(item) == "geoCoord" and item.get("epsgCode")
    }
    stated = {system or next(iter(default), "4326") for system in systems}
    if len(stated) > 1:
        raise InputError(f"mixes coordinate systems ({', '.join(sorted(stated))[:80]})", file=reader.path)
    name = stated.pop()
    code = name.rpartition(":")[2].rpartition("/")[2]
    try:
        system = pyproj.CRS.from_user_input(f"EPSG:{code}" if code.isdigit() else name)
    except CRSError as error:
        raise InputError(f"epsgCode {name[:60]!r} is no coordinate system", file=reader.path) from error
    north_first = system.axis_info[0].direction.lower() == "north"
    rows = [
        np.array([[at, *(values[:2][::-1] if north_first else values[:2]), values[2] if len(values) > 2 else math.nan]
                  for at, values in track.points])
        for track in tracks
    ]  # fmt: skip
    every = np.concatenate(rows)
    if system.is_geographic:
        if np.abs(every[:, 1]).max() > 180.0 or np.abs(every[:, 2]).max() > 90.0:
            raise InputError(f"has coordinates outside the Earth's for {name}", file=reader.path)
        longitude, latitude = np.radians(every[:, 1]), np.radians(every[:, 2])
        frame = choose_frame(latitude, longitude, crs=crs, zone_width=zone_width, ellipsoid=ellipsoid)
        laid = [
            np.column_stack([r[:, 0], *frame.to_grid(np.radians(r[:, 2]), np.radians(r[:, 1]), r[:, 3])]) for r in rows
        ]
        return frame, laid
    return frame_for_grid(every[:, 1], every[:, 2], crs=system), rows


# --- geometry ---------------------------------------------------------------------------------------------------------


def _sections(
    reader: Reader, frame: GridFrame, track: _Track, points: FloatArray, spacing: float
) -> list[TrackSection]:
    """The track's parts between its switches."""
    bent = [radius for _, radius in track.radii if radius != 0.0]
    table = None
    if len(points) == 2 and bent:
        table = _by_radii(reader, frame, track, points, spacing)
    if table is None:
        table = lay_line(frame, points[:, 1:], spacing)
        if np.isnan(table.height).any():
            table = _with_slopes(track, points, table)
    whole = assemble(frame, [TrackSection("t", table)])
    end = float(table.offset[-1])
    borders = [0.0]
    for at, _ in sorted(track.switches, key=lambda item: item[0]):
        cut = at / track.length * end
        if cut - borders[-1] > 0.5 and end - cut > 0.5:
            borders.append(cut)
    track.cuts = [*borders[1:]]
    borders.append(end)
    track.parts = [track.id] if len(borders) == 2 else [f"{track.id}.{k + 1}" for k in range(len(borders) - 1)]
    track.cuts = [cut / end * track.length for cut in track.cuts]
    marks = np.array(sorted(track.marks)).reshape(-1, 2)
    sections = []
    for name, a, b in zip(track.parts, borders, borders[1:], strict=False):
        offset = np.linspace(a, b, max(2, round((b - a) / spacing) + 1))
        here = whole.at("t", offset)
        nothing = np.full((len(offset), 6), np.nan)
        knots = KnotTable(
            offset - a,
            here.easting,
            here.northing,
            here.height,
            here.grid_bearing,
            here.curvature,
            here.gradient,
            here.cant,
            np.interp(offset, table.offset, table.scale),
            nothing,
        )
        posts: FloatArray | None = None
        if len(marks):
            where = marks[:, 0] / track.length * end
            ends = np.interp([a, b], where, marks[:, 1])
            inner = (where > a) & (where < b)
            posts = np.vstack([[0.0, ends[0]], np.column_stack([where[inner] - a, marks[inner, 1]]), [b - a, ends[1]]])
        sections.append(TrackSection(name, knots, "", track.name, posts=posts))
    return sections


def _by_radii(reader: Reader, frame: GridFrame, track: _Track, points: FloatArray, spacing: float) -> KnotTable | None:
    """Arcs and straights between radius changes, turned so that they lead from the first point towards the last."""
    changes = dict(sorted(track.radii))
    begin = np.array([0.0, *(at for at in changes if _SAME_POS < at < track.length - _SAME_POS)])
    radius = np.array([next((r for at, r in reversed(changes.items()) if at <= b + _SAME_POS), 0.0) for b in begin])
    small = (radius != 0.0) & (np.abs(radius) < 5.0)
    if small.any():
        reader.refuse(track.node, f"has a radius of {radius[small][0]:g} m", "radii are metres, 0 for a straight")
    bend = np.where(radius == 0.0, 0.0, 1.0 / np.where(radius == 0.0, 1.0, radius))
    length = np.diff(np.append(begin, track.length))
    kind = np.where(bend == 0.0, STRAIGHT, ARC).astype(np.int64)
    zero = np.zeros(len(length))
    bearing = np.append(0.0, np.cumsum(bend * length)[:-1])

    def chained(turn: float) -> tuple[Plan, FloatArray]:
        loose = Plan(length, kind, bend, bend, zero, zero, bearing + turn, zero)
        ends, _ = integrate(loose, loose.edges)
        at = points[0, 1:3] + np.vstack([[0.0, 0.0], np.cumsum(ends[1:], axis=0)])
        return Plan(length, kind, bend, bend, at[:-1, 0].copy(), at[:-1, 1].copy(), bearing + turn, zero), at[-1]

    _, end = chained(0.0)
    chord, drawn = points[-1, 1:3] - points[0, 1:3], end - points[0, 1:3]
    plan, end = chained(math.atan2(*chord) - math.atan2(*drawn))
    miss = points[-1, 1:3] - end
    off = float(np.hypot(*miss))
    if off > 1.0 + _MISS * track.length:
        reader.note(
            f"track {track.id}: its radii lead {off:.1f} m past its end; a straight line between its points counts"
        )
        return None
    gap = miss * (length / length.sum())[:, None]  # spread over the track
    shift = np.vstack([[0.0, 0.0], np.cumsum(gap, axis=0)[:-1]])
    plan = replace(plan, easting=plan.easting + shift[:, 0], northing=plan.northing + shift[:, 1])
    profile = None
    if np.isfinite(points[:, 3]).all():
        rise = (points[-1, 3] - points[0, 3]) / track.length
        profile = Gradients(*(np.array([v]) for v in (-np.inf, 0.0, points[0, 3], rise, 0.0, 0.0)))
    return lay(frame, plan, gap=gap, profile=profile, spacing=spacing).tables[0]


def _with_slopes(track: _Track, points: FloatArray, table: KnotTable) -> KnotTable:
    """Heights from one known height and the gradient changes, where both are there."""
    known = np.flatnonzero(np.isfinite(points[:, 3]))
    slopes = dict(sorted(track.slopes))
    if not len(known) or not slopes or min(slopes) > _SAME_POS:
        return table
    run = table.offset / table.offset[-1] * track.length
    at = np.array([*slopes, track.length])
    rise = np.append(0.0, np.cumsum(np.array([*slopes.values()]) * np.diff(at)))
    height = np.interp(run, at, rise)
    height += points[known[0], 3] - np.interp(points[known[0], 0], at, rise)
    which = np.clip(np.searchsorted(at, run, side="right") - 1, 0, len(slopes) - 1)
    offset = np.append(0.0, np.cumsum(np.hypot(np.diff(table.offset), np.diff(height))))
    return replace(table, offset=offset, height=height, gradient=np.array([*slopes.values()])[which])


# --- movements --------------------------------------------------------------------------------------------------------


def _part(track: _Track, pos: float) -> tuple[int, float]:
    """The part of a track that a position lies on, and the share of that part's length."""
    borders = [0.0, *track.cuts, track.length]
    k = int(np.clip(np.searchsorted(borders, pos, side="right") - 1, 0, len(borders) - 2))
    return k, float(np.clip((pos - borders[k]) / (borders[k + 1] - borders[k]), 0.0, 1.0))


def _movements(reader: Reader, tracks: Sequence[_Track], index: dict[str, int]) -> NDArray[np.int64]:
    """Through every cut, and by connections: ends of tracks to each other and to the switches of others."""
    rows: set[tuple[int, int, int, int]] = set()
    ends: dict[str, list[tuple[int, int]]] = {}  # id of a connection: ends of parts that a train reaches it by
    asked: list[tuple[Any, str, str]] = []
    for track in tracks:
        own = [index[part] for part in track.parts]
        for a, b in pairwise(own):
            rows.add((a, 1, b, 0))
        topology = children(track.node, "trackTopology")[0]
        for kind, end in (("trackBegin", (own[0], 0)), ("trackEnd", (own[-1], 1))):
            for item in children(topology, kind):
                for connection in children(item, "connection"):
                    ends.setdefault(str(connection.get("id")), []).append(end)
                    asked.append((connection, str(connection.get("id")), str(connection.get("ref"))))
        for at, item in track.switches:
            nearest = min(range(len(track.cuts)), key=lambda k: abs(track.cuts[k] - at), default=None)
            for connection in children(item, "connection"):
                outgoing = str(connection.get("orientation", "outgoing")) != "incoming"
                if nearest is None or abs(track.cuts[nearest] - at) > 1.0:  # at the track's own end
                    last = at > 0.5 * track.length
                    end = (own[-1], 1) if last else (own[0], 0)
                else:
                    end = (own[nearest], 1) if outgoing else (own[nearest + 1], 0)
                ends.setdefault(str(connection.get("id")), []).append(end)
                asked.append((connection, str(connection.get("id")), str(connection.get("ref"))))
    for connection, mine, other in asked:
        if other not in ends:
            reader.refuse(connection, f"refers to {other[:40]!r}, which is not there")
        for one in ends[mine]:
            for two in ends[other]:
                if one != two:
                    rows.add((*min(one, two), *max(one, two)))
    return np.array(sorted(rows), np.int64).reshape(-1, 4)
