"""The design that a section is lined to: which alignment of a file lies along the measured axis, and how far off it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.monitoring.design import Design
from railnav.monitoring.filters import stretches
from railnav.monitoring.section import Section

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: A design farther than this from the measured axis is not this track's, m.
FARTHEST = 1.0
#: Heights of a design farther than this from the measured ones have another datum, m.
FARTHEST_HEIGHT = 1.0
#: A foot this far ahead of or behind its point lies beyond the design's ends, m.
BEYOND = 0.05
#: Shortest stretch that is lined, m.
SHORTEST = 100.0
#: Two designs closer than this are the same line, m.
SAME = 0.002
#: Points of the axis that designs are compared at.
SAMPLES = 600


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A design along a measured axis.

    Attributes
    ----------
    design : Design
    sense : float
        +1 where stations grow with the distance, -1 otherwise.
    rows : slice
        Of the axis: those that the design covers.
    station, cross : (n,) array
        Of every point of the axis: the foot's station, and the point's distance to the right of the design as stations grow, m.
    notes : tuple of str
    """

    design: Design
    sense: float
    rows: slice
    station: FloatArray
    cross: FloatArray
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """How a design lies along the sampled axis."""

    design: Design
    over: BoolArray
    cross: FloatArray

    @property
    def near(self) -> BoolArray:
        return self.over & (np.abs(self.cross) < FARTHEST)

    @property
    def median(self) -> float:
        return float(np.median(np.abs(self.cross[self.over]))) if self.over.any() else np.inf


def target_along(
    designs: Sequence[Design],
    east: FloatArray,
    north: FloatArray,
    distance: FloatArray,
    section: Section,
    *,
    name: str = "",
) -> Target:
    """Choose the design that lies along a measured axis.

    By name where one is given; otherwise the one that bears the name of a track of the section, or lies within a metre of most of it.

    Parameters
    ----------
    designs : sequence of Design
        In the model's plane.
    east, north : (n,) array
        The measured axis, m.
    distance : (n,) array
        Along the section, m.
    section : Section
    name : str
        Name of the design meant.

    Returns
    -------
    Target

    Raises
    ------
    TrackError
        No design of that name; none near the axis (the message says by how much the nearest misses it, and where); several that could be
        meant, with their distances.
    """
    if name:
        named = [design for design in designs if design.track == name]
        if not named:
            there = ", ".join(repr(design.track) for design in designs[:8]) + (", ..." if len(designs) > 8 else "")
            raise TrackError(f"there is no design {name!r}; there are {there}")
        designs = named[:1]
    sample = slice(0, len(east), max(1, len(east) // SAMPLES))
    apart = float(distance[-1] - distance[0]) / max(len(east[sample]) - 1, 1)
    found = []
    for design in designs:
        feet = design.project(east[sample], north[sample])
        found.append(_Candidate(design, np.abs(feet.distance - np.abs(feet.cross)) < BEYOND, feet.cross))
    likely = [c for c in found if c.near.sum() * apart >= SHORTEST]
    if not likely:
        _refuse(found, apart, section, distance[sample], east[sample], north[sample])
    chosen, notes = _chosen(likely, section)
    return _laid(chosen.design, east, north, distance, section, notes)


def _chosen(likely: Sequence[_Candidate], section: Section) -> tuple[_Candidate, tuple[str, ...]]:
    """The one of several that is meant, or a refusal that names those that could be."""
    order = sorted(likely, key=lambda c: (-int(c.near.sum()), c.median))
    tracks = [section.model.track_id[i] for i in section.track]
    namesakes = [c for c in order if any(t == c.design.track or t.startswith(f"{c.design.track}.") for t in tracks)]
    if len(namesakes) == 1 and namesakes[0].near.sum() >= 0.5 * order[0].near.sum():
        best = namesakes[0]
    else:
        best = order[0]
        rivals = [
            c
            for c in order[1:]
            if (c.near & best.near).sum() >= 0.5 * best.near.sum()
            and float(np.abs(np.abs(c.cross) - np.abs(best.cross))[c.near & best.near].max()) > SAME
        ]
        if rivals:
            words = ", ".join(f"{c.design.track!r} ({c.median:.3f} m off)" for c in (best, *rivals))
            raise TrackError(f"designs {words} all lie along section {section.name}: name the one that is meant")
    others = [c.design.track for c in order if c is not best]
    if not others:
        return best, ()
    return best, (
        f"design {best.design.track!r} is used; {', '.join(map(repr, others[:6]))} also lie along parts of the section",
    )


def _refuse(
    found: Sequence[_Candidate],
    apart: float,
    section: Section,
    distance: FloatArray,
    east: FloatArray,
    north: FloatArray,
) -> None:
    """Say why no design is this track's."""
    beside = [c for c in found if c.over.sum() * apart >= SHORTEST]
    if not beside:
        best = max(found, key=lambda c: int(c.over.sum()))
        gap = float(best.design.project(east, north).distance.min())
        raise TrackError(
            f"design {best.design.track!r} covers {best.over.sum() * apart:.0f} m of section {section.name}, too little to line "
            f"(its nearest point is {gap:,.2f} m from the axis); is it this track's design, and in the model's plane?"
        )
    best = min(beside, key=lambda c: c.median)
    rows = np.flatnonzero(best.over)
    worst = int(rows[np.argmax(np.abs(best.cross[rows]))])
    raise TrackError(_misses(best.design, best.cross, worst, best.median, section, distance))


def _misses(
    design: Design, cross: FloatArray, worst: int, median: float, section: Section, distance: FloatArray
) -> str:
    track, offset = section.locate(distance[worst])
    where = repr(section.model.track_id[int(track)])
    return (
        f"design {design.track!r} misses the measured axis by {abs(float(cross[worst])):,.2f} m on track {where} at "
        f"{float(offset):.0f} m (median {median:,.2f} m): not this track's design, or another plane"
    )


def _laid(
    design: Design,
    east: FloatArray,
    north: FloatArray,
    distance: FloatArray,
    section: Section,
    notes: tuple[str, ...],
) -> Target:
    feet = design.project(east, north)
    over = np.abs(feet.distance - np.abs(feet.cross)) < BEYOND
    parts = stretches(over)
    a, b = max(parts, key=lambda part: part[1] - part[0]) if parts else (0, 0)
    covered = float(distance[b - 1] - distance[a]) if b > a else 0.0
    if covered < SHORTEST:
        raise TrackError(
            f"design {design.track!r} covers {covered:.0f} m of section {section.name}, too little to line; is it this track's design?"
        )
    worst = a + int(np.argmax(np.abs(feet.cross[a:b])))
    if abs(feet.cross[worst]) > FARTHEST:
        median = float(np.median(np.abs(feet.cross[a:b])))
        raise TrackError(_misses(design, feet.cross, worst, median, section, distance))
    sense = 1.0 if feet.station[b - 1] >= feet.station[a] else -1.0
    return Target(design, sense, slice(a, b), feet.station, feet.cross, notes)


def level_above(design: Design, station: FloatArray, height: FloatArray) -> tuple[FloatArray, str]:
    """Measured height above a design's profile, m, NaN where there is none or its datum is another; and what to say of it."""
    nothing = np.full(len(station), np.nan)
    if design.profile is None:
        return nothing, ""
    level = height - design.at(station).height
    if not np.isfinite(level).all():
        return nothing, ""
    middle = float(np.median(level))
    if abs(middle) > FARTHEST_HEIGHT:
        return nothing, f"the design's heights lie {-middle:+.2f} m from the measured ones (another datum?): no lifts"
    return level, ""
