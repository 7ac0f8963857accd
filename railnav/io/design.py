"""Designed alignments laid out as knots by true ground length.

Offsets of the model are true lengths on the ground: grid length over the grid's scale, joined with the rise. The elements and
their laws stand in `railnav.track.elements`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.geodesy.grid import GridFrame
from railnav.track.alignment import KnotTable
from railnav.track.elements import (
    ARC,
    BLOSS,
    CLOTHOID,
    COSINE,
    CUBIC,
    HELMERT,
    SINE,
    STRAIGHT,
    VIENNESE,
    Cant,
    Plan,
    closing,
    curvature,
    integrate,
    law,
    turn,
)
from railnav.units import wrap_angle

__all__ = [
    "ARC",
    "BLOSS",
    "CLOTHOID",
    "COSINE",
    "CUBIC",
    "HELMERT",
    "LARGEST_GAP",
    "LARGEST_KINK",
    "SAID_KINK",
    "SINE",
    "STRAIGHT",
    "VIENNESE",
    "Cant",
    "Laid",
    "Plan",
    "Profile",
    "closing",
    "curvature",
    "integrate",
    "law",
    "lay",
    "turn",
]

FloatArray = NDArray[np.float64]

#: Height or its slope (derivative 1) at grid lengths from the track's start.
Profile = Callable[[FloatArray, int], FloatArray]

#: An element that ends further than this from the start of the next does not belong to it, m.
LARGEST_GAP = 0.10
#: Nor one that ends in a direction further than this from the next one's, rad.
LARGEST_KINK = np.radians(2.0)
#: A joint that turns by more than this is said, rad.
SAID_KINK = np.radians(0.1)

#: Joints closer than this share a knot, m.
_SAME_MARK = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Laid:
    """A track laid out: its knots, cut where asked, and true offsets by grid length.

    Attributes
    ----------
    tables : tuple of KnotTable
        One a part, offsets from 0 in each.
    grid, ground : (m,) array
        Grid lengths and the true offsets there, from the start of the first part, m.
    """

    tables: tuple[KnotTable, ...]
    grid: FloatArray
    ground: FloatArray

    def offset(self, along: FloatArray) -> FloatArray:
        """True offset of grid lengths, m."""
        return np.interp(along, self.grid, self.ground)


def lay(
    frame: GridFrame,
    plan: Plan,
    *,
    gap: FloatArray,
    profile: Profile | None = None,
    cant: Cant | None = None,
    breaks: ArrayLike = (),
    cuts: Sequence[float] = (),
    spacing: float = 1.0,
) -> Laid:
    """Lay elements, profile and cant out as knots by true ground length.

    Parameters
    ----------
    frame : GridFrame
        The plane.
    plan : Plan
        The elements.
    gap : (n, 2) array
        What each element misses the next one's start by (`closing`), m; it is spread along the element, so that the stated
        coordinates hold.
    profile : callable, optional
        Height and its slope by grid length; without one, the track has no heights.
    cant : Cant, optional
        Cant by grid length; without one, 0.
    breaks : array
        Further grid lengths where a knot shall stand, besides the joints of elements and cant: corners of the profile, m.
    cuts : sequence of float
        True offsets, ascending and inside the track, where it is cut into parts, m.
    spacing : float
        Wanted distance between knots, m; a joint has a knot of its own.
    """
    edges = plan.edges
    at_ends, _ = integrate(plan, edges)

    # true length: ground metres per grid metre on a grid of 1 m, Simpson between
    count = np.maximum(1, np.ceil(plan.length).astype(np.int64))
    fine = np.append(
        np.concatenate(
            [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(edges, edges[1:], count, strict=False)]
        ),
        edges[-1],
    )
    coarse = np.linspace(0.0, edges[-1], max(2, int(edges[-1] / 50.0) + 2))  # scale changes by under 1e-10 within 50 m
    points, bearing = integrate(plan, coarse)
    height = np.zeros(len(coarse)) if profile is None else profile(coarse, 0)
    scale = frame.ground_scale(points[:, 0], points[:, 1], height, bearing)

    def rate(at: FloatArray) -> FloatArray:
        """Ground metres per grid metre."""
        slope = 0.0 if profile is None else profile(at, 1)
        return np.hypot(1.0 / np.interp(at, coarse, scale), slope)

    middle, width = 0.5 * (fine[:-1] + fine[1:]), np.diff(fine)
    panels = width * (rate(fine[:-1]) + 4.0 * rate(middle) + rate(fine[1:])) / 6.0
    # the stated starts hold, so an element is as much longer as it misses the next one along its way
    chord = at_ends[1:] - np.column_stack([plan.easting, plan.northing])
    longer = (gap * chord).sum(axis=1) / np.maximum(np.hypot(chord[:, 0], chord[:, 1]) * plan.length, 1e-12)
    panels *= 1.0 + longer[np.clip(np.searchsorted(edges, middle) - 1, 0, len(longer) - 1)]
    run = np.append(0.0, np.cumsum(panels))

    corners = np.concatenate([edges, [] if cant is None else cant.edges, np.asarray(breaks, np.float64)])
    marks = np.interp(np.unique(corners), fine, run)
    borders = [0.0, *cuts, float(run[-1])]
    tables: list[KnotTable] = []
    for begin, end in pairwise(borders):
        n = max(2, round((end - begin) / spacing) + 1)
        offset = _onto(marks, np.linspace(begin, end, n))
        n = len(offset)
        at = np.interp(offset, run, fine)
        points, bearing = integrate(plan, at)
        owner = np.clip(np.searchsorted(edges, at, side="left") - 1, 0, len(plan.length) - 1)
        share = (at - edges[owner]) / plan.length[owner]
        points += gap[owner] * share[:, None]  # and what it misses the next one by is spread along it
        here = np.interp(at, coarse, scale)
        tables.append(
            KnotTable(
                offset=offset - begin,
                easting=points[:, 0],
                northing=points[:, 1],
                height=np.full(n, np.nan) if profile is None else profile(at, 0),
                grid_bearing=wrap_angle(bearing),
                curvature=curvature(plan, owner, share) / rate(at),
                gradient=np.zeros(n) if profile is None else profile(at, 1) * here,
                cant=np.zeros(n) if cant is None else cant.at(at),
                scale=here,
                covariance_g=np.full((n, 6), np.nan),
            )
        )
    return Laid(tuple(tables), fine, run)


def _onto(marks: FloatArray, offset: FloatArray) -> FloatArray:
    """Even knots and the marks between their ends; marks within 5 cm count once, even knots close to one give way."""
    step = offset[1] - offset[0]
    kept: list[float] = [float(offset[0])]
    for mark in marks[(marks > offset[0]) & (marks < offset[-1] - _SAME_MARK)].tolist():
        if mark - kept[-1] > _SAME_MARK:
            kept.append(mark)
    fixed = np.array([*kept, float(offset[-1])])
    right = np.searchsorted(fixed, offset[1:-1])
    near = np.minimum(fixed[right] - offset[1:-1], offset[1:-1] - fixed[right - 1])
    return np.sort(np.concatenate([fixed, offset[1:-1][near > 0.3 * step]]))
