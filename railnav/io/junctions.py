"""Junctions of designed tracks: where a track ends on another one, that one is cut, so that both meet in a node.

Design files name no nodes: a branch begins somewhere on the axis of the track it leaves. Ends are projected onto the other
tracks; where the foot point is near and the directions agree, the other track is cut there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import CrsError, InputError, TrackError
from railnav.geodesy.grid import GridFrame
from railnav.io.design import Cant, Laid, Plan, Profile, lay
from railnav.track.assembly import JOIN_HEIGHT, TrackSection, assemble
from railnav.track.model import TrackModel
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]

#: An end this near another track's axis lies on it, m.
ON_AXIS = 0.05
#: And in its direction within this, rad.
IN_LINE = math.radians(5.0)
#: A foot point this near a track's own end is that end, m.
AT_END = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """One designed track, before it is cut at junctions.

    Attributes
    ----------
    track : str
        Unique identifier; parts are called `track.1`, `track.2`, ... where it is cut.
    plan : Plan
        Its elements.
    gap : (n, 2) array
        What they miss each other by, m.
    posts : callable
        From the track laid out to (p, 2) offsets and chainages, ends included, m; none where it has no chainage.
    profile, cant, breaks
        As for `railnav.io.design.lay`.
    line, name : str
        Published line; free name.
    """

    track: str
    plan: Plan
    gap: FloatArray
    posts: Callable[[Laid], FloatArray]
    profile: Profile | None = None
    cant: Cant | None = None
    breaks: ArrayLike = ()
    line: str = ""
    name: str = ""


def join_designs(
    path: Path, frame: GridFrame, designs: Sequence[Design], *, spacing: float, provenance: dict[str, Any]
) -> TrackModel:
    """Lay designed tracks out, cut them where others end on them, and assemble the network.

    Parameters
    ----------
    path : Path
        The file, for messages.
    frame : GridFrame
        Its plane.
    designs : sequence of Design
        Tracks with unique identifiers.
    spacing : float
        Wanted distance between knots, m.
    provenance : dict
        Goes into `provenance["import"]`, with "joined" (one entry a junction made by projection: which end, on which track and
        offset, how far off, turning by how much) and "not_joined" (ends on another track's axis that point elsewhere).

    Raises
    ------
    InputError
        A track leaves the plane.
    """

    def laid(design: Design, cuts: Sequence[float] = ()) -> Laid:
        try:
            result = lay(
                frame,
                design.plan,
                gap=design.gap,
                profile=design.profile,
                cant=design.cant,
                breaks=design.breaks,
                cuts=cuts,
                spacing=spacing,
            )
        except (CrsError, TrackError) as error:
            raise InputError(f"track {design.track!r}: {error}", file=path) from error
        for table in result.tables:
            if not all(
                np.isfinite(getattr(table, name)).all() for name in ("easting", "northing", "scale", "gradient")
            ):
                raise InputError(
                    f"track {design.track!r} leaves the plane", file=path, remedy="check --crs and the coordinates"
                )
        return result

    whole = [laid(design) for design in designs]
    rough = assemble(frame, [TrackSection(d.track, w.tables[0]) for d, w in zip(designs, whole, strict=True)])
    cuts, joined, astray = _find(rough)
    sections: list[TrackSection] = []
    for i, design in enumerate(designs):
        mine = _apart(cuts.get(i, []))
        here = laid(design, mine) if mine else whole[i]
        posts = design.posts(here)
        borders = [0.0, *mine, float(here.ground[-1])]
        for k, table in enumerate(here.tables):
            begin, end = borders[k], borders[k + 1]
            inner = posts[(posts[:, 0] > begin) & (posts[:, 0] < end)] - [begin, 0.0]
            known = len(posts) > 0
            first, last = np.interp([begin, end], posts[:, 0], posts[:, 1]) if known else (0.0, 0.0)
            sections.append(
                TrackSection(
                    f"{design.track}.{k + 1}" if mine else design.track,
                    table,
                    design.line,
                    design.name,
                    float(first) if known else None,
                    float(last) if known else None,
                    inner if len(inner) else None,
                )
            )
    told = {**provenance, "sections": len(sections), "joined": joined, "not_joined": astray}
    try:
        return assemble(frame, sections, provenance={"import": told})
    except TrackError as error:
        raise InputError(str(error), file=path) from error


def _apart(cuts: list[float]) -> list[float]:
    """Cuts in order, those nearer than a node's reach merged."""
    kept: list[float] = []
    for cut in sorted(cuts):
        if not kept or cut - kept[-1] > AT_END:
            kept.append(cut)
    return kept


def _find(model: TrackModel) -> tuple[dict[int, list[float]], list[dict[str, Any]], list[dict[str, Any]]]:
    """Offsets to cut tracks at, and the ends that ask for it or, pointing elsewhere, do not."""
    cuts: dict[int, list[float]] = {}
    joined: list[dict[str, Any]] = []
    astray: list[dict[str, Any]] = []
    lengths = model.lengths
    for t, track in enumerate(model.track_id):
        own = model.knots(track)
        for knot, end in ((own.start, "start"), (own.stop - 1, "finish")):
            for near in model.locate(float(model.easting[knot]), float(model.northing[knot]), within=ON_AXIS):
                other = model.track_index(near.track)
                inside = AT_END < near.offset < float(lengths[other]) - AT_END
                if other == t or not inside:
                    continue
                point = model.at(near.track, near.offset)
                if abs(float(point.height) - float(model.height[knot])) > JOIN_HEIGHT:
                    continue
                off = abs(float(wrap_angle(2.0 * (float(point.grid_bearing) - model.grid_bearing[knot])))) / 2.0
                entry = {
                    "track": track,
                    "end": end,
                    "on": near.track,
                    "offset_m": round(near.offset, 3),
                    "distance_m": round(near.distance, 4),
                    "turn_deg": round(math.degrees(off), 3),
                }
                if off > IN_LINE:
                    astray.append(entry)
                else:
                    joined.append(entry)
                    cuts.setdefault(other, []).append(near.offset)
    return cuts, joined, astray
