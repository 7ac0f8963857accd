"""Designed alignments: elements in a plane, with profile and cant, laid out as knots by true ground length.

Lengths, radii and coordinates are those of the plane in which the alignment was designed: an arc is an arc in the grid.
Offsets of the model are true lengths on the ground all the same: grid length over the grid's scale, joined with the rise.
The curvature of an element runs by t = s/L from k0 to k1 as k0 + (k1 - k0) f(t):

========== ============================================= ==========================================
element    f(t)                                          integral of f
========== ============================================= ==========================================
arc        0 (k0 = k1)                                   0
clothoid   t                                             t^2/2
bloss      3t^2 - 2t^3                                   t^3 - t^4/2
cosine     (1 - cos(pi t))/2                             t/2 - sin(pi t)/(2 pi)
sine       t - sin(2 pi t)/(2 pi)                        t^2/2 + (cos(2 pi t) - 1)/(4 pi^2)
helmert    2t^2, after the middle -1 + 4t - 2t^2         2t^3/3, 1/6 - t + 2t^2 - 2t^3/3
viennese   35t^4 - 84t^5 + 70t^6 - 20t^7                 7t^5 - 14t^6 + 10t^7 - 5t^8/2
========== ============================================= ==========================================

A Viennese bend has besides the term -sway f''(t) in its curvature, sway = h dphi / L^2: the track swings out, so that the
vehicle's centre of gravity, h above the rails, runs smoothly while the cant angle changes by dphi.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.geodesy.grid import GridFrame
from railnav.track.alignment import KnotTable
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Height or its slope (derivative 1) at grid lengths from the track's start.
Profile = Callable[[FloatArray, int], FloatArray]

STRAIGHT, ARC, CLOTHOID, BLOSS, COSINE, SINE, HELMERT, VIENNESE = range(8)

#: An element that ends further than this from the start of the next does not belong to it, m.
LARGEST_GAP = 0.10
#: Nor one that ends in a direction further than this from the next one's, rad.
LARGEST_KINK = np.radians(2.0)
#: A joint that turns by more than this is said, rad.
SAID_KINK = np.radians(0.1)

#: Gauss-Legendre nodes and weights on [-1, 1].
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
#: Joints closer than this share a knot, m.
_SAME_MARK = 0.05
#: Longest panel of the integration, m.
_PANEL = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """The elements of one track in order, each with its own stated start: arrays (n,), m, rad, 1/m.

    Attributes
    ----------
    length : (n,) array
        Grid lengths, m.
    kind : (n,) int array
        STRAIGHT, ARC, CLOTHOID, ...
    curvature_start, curvature_end : (n,) array
        In the grid, positive to the right, 1/m.
    easting, northing, grid_bearing : (n,) array
        Of each element's start, m, rad.
    sway : (n,) array
        h dphi / L^2 of Viennese bends, positive where a cant to the right grows, 1/m; else 0.
    """

    length: FloatArray
    kind: IntArray
    curvature_start: FloatArray
    curvature_end: FloatArray
    easting: FloatArray
    northing: FloatArray
    grid_bearing: FloatArray
    sway: FloatArray

    @property
    def edges(self) -> FloatArray:
        """Grid lengths from the track's start to the elements' starts and the end, (n + 1,)."""
        return np.append(0.0, np.cumsum(self.length))


@dataclass(frozen=True, slots=True, eq=False)
class Cant:
    """Cant by stretches of grid length: (n + 1,) edges; cant at the start and end of each, m; its law between.

    Beyond the first and last edge it stays as it is there.
    """

    edges: FloatArray
    start: FloatArray
    end: FloatArray
    kind: IntArray

    def at(self, where: FloatArray) -> FloatArray:
        """Cant at grid lengths, m; at an edge, of the stretch that ends there."""
        where = np.clip(where, self.edges[0], self.edges[-1])
        owner = np.clip(np.searchsorted(self.edges, where, side="left") - 1, 0, len(self.start) - 1)
        width = self.edges[owner + 1] - self.edges[owner]
        share = (where - self.edges[owner]) / np.where(width > 0.0, width, 1.0)
        f, _ = law(np.maximum(self.kind[owner], CLOTHOID), share)
        return np.asarray(self.start[owner] + (self.end[owner] - self.start[owner]) * f)


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


def law(kind: IntArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Evaluate the curvature law f(t) of each kind, and its integral from 0.

    Examples
    --------
    >>> f, whole = law(np.array([CLOTHOID, BLOSS]), np.array([0.25, 0.5]))
    >>> f.tolist()
    [0.25, 0.5]
    """
    f, whole = np.zeros_like(t), np.zeros_like(t)
    for each in np.unique(kind):
        at = kind == each
        u = t[at]
        if each == CLOTHOID:
            f[at], whole[at] = u, u * u / 2.0
        elif each == BLOSS:
            f[at], whole[at] = u * u * (3.0 - 2.0 * u), u**3 - u**4 / 2.0
        elif each == COSINE:
            f[at], whole[at] = (1.0 - np.cos(np.pi * u)) / 2.0, u / 2.0 - np.sin(np.pi * u) / (2.0 * np.pi)
        elif each == SINE:
            f[at] = u - np.sin(2.0 * np.pi * u) / (2.0 * np.pi)
            whole[at] = u * u / 2.0 + (np.cos(2.0 * np.pi * u) - 1.0) / (4.0 * np.pi**2)
        elif each == HELMERT:
            f[at] = np.where(u < 0.5, 2.0 * u * u, -1.0 + 4.0 * u - 2.0 * u * u)
            whole[at] = np.where(u < 0.5, 2.0 * u**3 / 3.0, 1.0 / 6.0 - u + 2.0 * u * u - 2.0 * u**3 / 3.0)
        elif each == VIENNESE:
            f[at] = u**4 * (35.0 - 84.0 * u + 70.0 * u * u - 20.0 * u**3)
            whole[at] = u**5 * (7.0 - 14.0 * u + 10.0 * u * u - 2.5 * u**3)
    return f, whole


def turn(plan: Plan, which: IntArray, s: FloatArray) -> FloatArray:
    """Change of bearing from the start of elements `which` over s metres of them, rad."""
    length, k0, k1 = plan.length[which], plan.curvature_start[which], plan.curvature_end[which]
    t = s / length
    _, whole = law(plan.kind[which], t)
    swing = plan.sway[which] * length * 140.0 * t**3 * (1.0 - t) ** 3  # f' of the Viennese law
    return np.asarray(k0 * s + (k1 - k0) * length * whole - swing)


def curvature(plan: Plan, which: IntArray, t: FloatArray) -> FloatArray:
    """Curvature in the grid where a share t of elements `which` is run, 1/m."""
    f, _ = law(plan.kind[which], t)
    k0, k1 = plan.curvature_start[which], plan.curvature_end[which]
    swing = plan.sway[which] * 420.0 * t * t * (1.0 - t) ** 2 * (1.0 - 2.0 * t)  # f'' of the Viennese law
    return np.asarray(k0 + (k1 - k0) * f - swing)


def integrate(plan: Plan, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Position (m, 2) and bearing (m,) where each element, laid from its own stated start, has run to grid length `at`.

    A joint belongs to the element that ends there. Gauss-Legendre, 8 points on panels of at most 2 m: exact to 1e-9 m.
    """
    edges = plan.edges
    halves = edges[:-1] + 0.5 * plan.length  # the Helmert law has a break in the middle
    stops = np.unique(np.concatenate([edges, halves, at]))
    pieces = np.maximum(1, np.ceil(np.diff(stops) / _PANEL).astype(np.int64))
    first = np.repeat(np.append(0, np.cumsum(pieces)[:-1]), pieces)
    share = (np.arange(pieces.sum()) - first) / np.repeat(pieces, pieces)
    begin = np.repeat(stops[:-1], pieces) + share * np.repeat(np.diff(stops), pieces)
    width = np.repeat(np.diff(stops) / pieces, pieces)
    which = np.clip(np.searchsorted(edges, begin + 0.5 * width) - 1, 0, len(plan.length) - 1)
    s = (begin - edges[which])[:, None] + 0.5 * width[:, None] * (1.0 + _NODES)
    deep = np.repeat(which[:, None], len(_NODES), axis=1)
    bearing = plan.grid_bearing[which][:, None] + turn(plan, deep, s)
    step_e = 0.5 * width * (np.sin(bearing) @ _WEIGHTS)
    step_n = 0.5 * width * (np.cos(bearing) @ _WEIGHTS)
    run = np.column_stack([np.append(0.0, np.cumsum(step_e)), np.append(0.0, np.cumsum(step_n))])
    border = np.append(begin, stops[-1])  # run is the sum of all panels up to each border
    owner = np.clip(np.searchsorted(edges, at, side="left") - 1, 0, len(plan.length) - 1)
    here, origin = run[np.searchsorted(border, at)], run[np.searchsorted(border, edges[owner])]
    points = np.column_stack([plan.easting[owner], plan.northing[owner]]) + here - origin
    return points, plan.grid_bearing[owner] + turn(plan, owner, at - edges[owner])


def closing(
    plan: Plan, *, end: FloatArray | None = None, end_bearing: float | None = None
) -> tuple[FloatArray, FloatArray]:
    """What each element misses the next one's start by, the last one the stated end: (n, 2) m and, of bearings, (n,) rad.

    Without a stated end the last one misses nothing.
    """
    ends, bearing = integrate(plan, plan.edges)
    stated = np.column_stack([plan.easting[1:], plan.northing[1:]])
    gap = np.vstack([stated, ends[-1] if end is None else end]) - ends[1:]
    turned = np.append(plan.grid_bearing[1:], bearing[-1] if end_bearing is None else end_bearing) - bearing[1:]
    return gap, wrap_angle(turned)


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
