"""Lay out tracks from alignment elements: straights, arcs and clothoids on the ground, tabulated exactly in the grid.

A placed axis carries everything: its elements run on horizontal ground metres from an origin in the grid, its profile gives the
heights, and tracks are laid beside it (parallel, at a constant distance) or across it (turnouts, crossovers, loops). Nothing is
sampled and fitted: bearing, curvature and gradient are the elements' own, position is their integral (Gauss-Legendre, five points
a panel, below 1e-9 m), and every change of an element is a knot, so that the table's linear curvature between knots is exact.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError
from railnav.track.alignment import KnotTable

if TYPE_CHECKING:
    from railnav.geodesy.grid import GridFrame

FloatArray = NDArray[np.float64]

#: Longest panel of the position integral, m.
PANEL = 10.0
#: Distance between nodes of the grid scale, m: it changes by less than 1e-9 a metre, smoothly.
SCALE_SPACING = 50.0
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(5)


@dataclass(frozen=True, slots=True)
class Element:
    """A stretch of axis along which curvature and cant run linearly.

    Attributes
    ----------
    length : float
        Horizontal ground length, m.
    curvature_start, curvature_finish : float
        1/m, positive to the right.
    cant_start, cant_finish : float
        m, positive with the left rail high.
    """

    length: float
    curvature_start: float = 0.0
    curvature_finish: float = 0.0
    cant_start: float = 0.0
    cant_finish: float = 0.0


def curve(
    radius: float, arc: float, *, transition: float = 0.0, cant: float = 0.0, straight_before: float = 0.0
) -> list[Element]:
    """Straight, clothoid, arc, clothoid.

    Parameters
    ----------
    radius : float
        m, positive to the right.
    arc, transition, straight_before : float
        Lengths of the circular arc, of each clothoid and of the straight before them, m; 0 leaves the element out.
    cant : float
        Cant of the arc, m; its sign is taken from the radius (outer rail high).

    Returns
    -------
    list of Element

    Examples
    --------
    >>> [e.length for e in curve(-700.0, 250.0, transition=90.0, straight_before=40.0)]
    [40.0, 90.0, 250.0, 90.0]
    """
    bend, roll = 1.0 / radius, math.copysign(cant, radius)
    elements = [
        Element(straight_before),
        Element(transition, 0.0, bend, 0.0, roll),
        Element(arc, bend, bend, roll, roll),
        Element(transition, bend, 0.0, roll, 0.0),
    ]
    return [e for e in elements if e.length > 0.0]


def turnout_connection(
    lateral: float, *, number: float, radius: float, ramp: float = 2.0, parallel: float = 0.0
) -> list[Element]:
    """Branch through a turnout 1:number onto a parallel track: arc, straight, counter-arc; heading closes exactly.

    Each arc turns by atan(1/number); the straight between them is solved so that the lateral distance is met. The steps of
    curvature are laid as ramps of `ramp` metres (about the wheel base of a bogie, over which a vehicle feels them), because a
    knot holds one curvature.

    Parameters
    ----------
    lateral : float
        Distance of the other track, m, positive to the right.
    number : float
        Turnout number: 9 for 1:9.
    radius : float
        Radius of the branch, m, positive.
    ramp : float
        Length of each change of curvature, m.
    parallel : float
        When positive: length of a parallel stretch after which the track comes back (a loop), m.

    Returns
    -------
    list of Element

    Raises
    ------
    TrackError
        When the two arcs alone reach further than `lateral`.

    Examples
    --------
    >>> round(sum(e.length for e in turnout_connection(4.0, number=9, radius=300.0)), 2)
    71.38
    """
    side, angle, bend = math.copysign(1.0, lateral), math.atan(1.0 / number), 1.0 / radius
    arc = angle * radius - ramp
    if arc <= 0.0:
        raise TrackError(f"a turnout 1:{number:g} of radius {radius:g} m has no room for ramps of {ramp:g} m")

    def swing(sign: float) -> list[Element]:
        return [
            Element(ramp, 0.0, sign * bend),
            Element(arc, sign * bend, sign * bend),
            Element(ramp, sign * bend, 0.0),
        ]

    closed = Axis.of([*swing(side), *swing(-side)])
    reach = abs(float(closed.plane(closed.station[-1])[0]))
    middle = (abs(lateral) - reach) / math.sin(angle)
    if middle < 0.0:
        raise TrackError(f"two turnouts 1:{number:g} R={radius:g} m reach {reach:.3f} m, more than {abs(lateral):g} m")
    out = [*swing(side), Element(middle), *swing(-side)]
    if parallel > 0.0:
        out += [Element(parallel), *swing(-side), Element(middle), *swing(side)]
    return [e for e in out if e.length > 0.0]


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """Elements one after another in a plane: bearing and position are integrals of the curvature.

    Attributes
    ----------
    station : (n + 1,) array
        Boundaries of the elements from 0, horizontal ground metres.
    bearing : (n + 1,) array
        Bearing at the boundaries, rad.
    curvature, curvature_rate, cant, cant_rate : (n,) array
        Of each element: value at its start and slope; 1/m, 1/m^2, m, 1.
    """

    station: FloatArray
    bearing: FloatArray
    curvature: FloatArray
    curvature_rate: FloatArray
    cant: FloatArray
    cant_rate: FloatArray

    @classmethod
    def of(cls, elements: Sequence[Element], *, bearing: float = 0.0) -> Axis:
        """Chain elements from a bearing at station 0."""
        if not elements or min(e.length for e in elements) <= 0.0:
            raise TrackError("an axis needs elements of positive length")
        length = np.array([e.length for e in elements])
        k0, k1 = np.array([(e.curvature_start, e.curvature_finish) for e in elements]).T
        c0, c1 = np.array([(e.cant_start, e.cant_finish) for e in elements]).T
        turn = 0.5 * (k0 + k1) * length
        return cls(
            np.append(0.0, np.cumsum(length)),
            bearing + np.append(0.0, np.cumsum(turn)),
            k0,
            (k1 - k0) / length,
            c0,
            (c1 - c0) / length,
        )

    def at(self, station: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Bearing (rad), curvature (1/m) and cant (m) at stations; any shape."""
        u = np.asarray(station, float)
        i = np.clip(np.searchsorted(self.station, u, side="right") - 1, 0, len(self.curvature) - 1)
        x = u - self.station[i]
        return (
            self.bearing[i] + x * (self.curvature[i] + 0.5 * x * self.curvature_rate[i]),
            self.curvature[i] + x * self.curvature_rate[i],
            self.cant[i] + x * self.cant_rate[i],
        )

    def panels(self) -> FloatArray:
        """Edges of panels no longer than `PANEL` that end at every element's boundary."""
        return subdivide(self.station, PANEL)

    def plane(
        self, station: ArrayLike, *, scale_station: ArrayLike | None = None, scale: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Easting and northing from the axis's origin, m: integral of scale * (sin, cos) of the bearing.

        Parameters
        ----------
        station : array
            Where, m.
        scale_station, scale : (q,) array, optional
            Grid scale along the axis, linear between nodes; 1 by default.

        Returns
        -------
        easting, northing : array
            Of the shape of `station`.
        """
        u = np.asarray(station, float)
        nodes = np.array([0.0, self.station[-1]]) if scale_station is None else np.asarray(scale_station, float)
        factor = np.ones(len(nodes)) if scale is None else np.asarray(scale, float)

        def rate(x: FloatArray) -> FloatArray:
            bearing, m = self.at(x)[0], np.interp(x, nodes, factor)
            return np.stack([m * np.sin(bearing), m * np.cos(bearing)], axis=-1)

        edges = self.panels()
        half = 0.5 * np.diff(edges)
        inner = edges[:-1, None] + half[:, None] * (1.0 + _NODE)
        whole = np.einsum("pqk,q->pk", rate(inner), _WEIGHT) * half[:, None]
        ends = np.concatenate([np.zeros((1, 2)), np.cumsum(whole, axis=0)])
        j = np.clip(np.searchsorted(edges, u, side="right") - 1, 0, len(half) - 1)
        rest = 0.5 * (u - edges[j])
        part = np.einsum("...qk,q->...k", rate(edges[j][..., None] + rest[..., None] * (1.0 + _NODE)), _WEIGHT)
        point = ends[j] + part * rest[..., None]
        return point[..., 0], point[..., 1]


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Heights along an axis: gradients joined by parabolas.

    Attributes
    ----------
    station : (n,) array
        Where the gradient's slope changes, m.
    gradient : (n,) array
        Gradient there; linear between, constant beyond.
    height : (n,) array
        Height there, m.
    """

    station: FloatArray
    gradient: FloatArray
    height: FloatArray

    @classmethod
    def of(cls, height: float, grades: Sequence[tuple[float, float]], *, radius: float) -> Profile:
        """Chain gradients.

        Parameters
        ----------
        height : float
            At station 0, m.
        grades : sequence of (station, gradient)
            Points of vertical intersection and the gradient from there on; the first station is 0.
        radius : float
            Radius of the vertical curves, m; they are centred on the points of intersection.
        """
        station, gradient = [0.0], [grades[0][1]]
        for (_, before), (at, after) in itertools.pairwise(grades):
            half = 0.5 * radius * abs(after - before)
            if at - half <= station[-1]:
                raise TrackError(f"the vertical curve at {at:g} m overlaps the one before")
            station += [at - half, at + half]
            gradient += [before, after]
        s, g = np.array(station), np.array(gradient)
        rise = np.append(0.0, np.cumsum(0.5 * (g[1:] + g[:-1]) * np.diff(s)))
        return cls(s, g, height + rise)

    def at(self, station: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Height (m) and gradient at stations; any shape."""
        u = np.asarray(station, float)
        g = np.interp(u, self.station, self.gradient)
        i = np.clip(np.searchsorted(self.station, u, side="right") - 1, 0, len(self.station) - 1)
        return self.height[i] + 0.5 * (g + self.gradient[i]) * (u - self.station[i]), g


@dataclass(frozen=True, slots=True, eq=False)
class PlacedAxis:
    """An axis in the grid, with heights; tracks are laid along it.

    Attributes
    ----------
    frame : GridFrame
    axis : Axis
        Bearings are grid bearings.
    profile : Profile
    easting, northing : float
        Grid position of station 0, m.
    scale_station, scale : (q,) array
        Grid metres per horizontal ground metre along the axis.
    """

    frame: GridFrame
    axis: Axis
    profile: Profile
    easting: float
    northing: float
    scale_station: FloatArray
    scale: FloatArray

    def at(self, station: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Easting and northing of the axis at stations, m."""
        e, n = self.axis.plane(station, scale_station=self.scale_station, scale=self.scale)
        return self.easting + e, self.northing + n


def subdivide(edges: ArrayLike, longest: float) -> FloatArray:
    """Edges with equal steps no longer than `longest` between each two.

    Examples
    --------
    >>> subdivide([0.0, 1.0, 4.0], 1.6)
    array([0. , 1. , 2.5, 4. ])
    """
    edges = np.asarray(edges, float)
    pieces = np.maximum(1, np.ceil(np.diff(edges) / longest - 1e-9).astype(int))
    first = np.repeat(edges[:-1], pieces)
    step = np.repeat(np.diff(edges) / pieces, pieces)
    number = np.arange(len(first)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    return np.append(first + number * step, edges[-1])


def place_axis(
    frame: GridFrame,
    elements: Sequence[Element],
    profile: Profile,
    *,
    easting: float,
    northing: float,
    grid_bearing: float,
) -> PlacedAxis:
    """Lay an axis on the ground from a grid position.

    The grid scale along the axis depends on where it runs; three rounds of the integral settle it below 1e-12.

    Parameters
    ----------
    frame : GridFrame
    elements : sequence of Element
    profile : Profile
    easting, northing : float
        Start in the grid, m.
    grid_bearing : float
        Direction at the start, rad from grid north.

    Returns
    -------
    PlacedAxis
    """
    axis = Axis.of(elements, bearing=grid_bearing)
    nodes = subdivide(axis.station[[0, -1]], SCALE_SPACING)
    height, bearing = profile.at(nodes)[0], axis.at(nodes)[0]
    scale = np.ones(len(nodes))
    for _ in range(3):
        e, n = axis.plane(nodes, scale_station=nodes, scale=scale)
        scale = np.asarray(frame.ground_scale(easting + e, northing + n, height, bearing), float)
    return PlacedAxis(frame, axis, profile, easting, northing, nodes, scale)


def parallel_track(
    placed: PlacedAxis, begin: float, end: float, lateral: float, *, spacing: float = 1.0, sigma: float = 0.01
) -> tuple[KnotTable, FloatArray]:
    """Tabulate a track at a constant distance from an axis, at the axis's height.

    The offset curve of an axis with curvature k at distance d to the right has the same bearing, the length element (1 - k d) du
    and the curvature k / (1 - k d).

    Parameters
    ----------
    placed : PlacedAxis
    begin, end : float
        Stations of the axis, m.
    lateral : float
        Distance on the ground, m, positive to the right.
    spacing : float
        Longest distance between knots along the axis, m.
    sigma : float
        Standard deviation to state per coordinate, m.

    Returns
    -------
    knots : KnotTable
    station : (k,) array
        The axis's station of each knot, m.
    """
    profile, axis = placed.profile, placed.axis
    breaks = np.concatenate([axis.station, profile.station])
    edges = np.unique(np.concatenate([[begin, end], breaks[(breaks > begin + 1e-6) & (breaks < end - 1e-6)]]))
    station = subdivide(edges, spacing)
    e, n = placed.at(station)
    bearing, bend, cant = axis.at(station)
    m = np.interp(station, placed.scale_station, placed.scale)

    def length_rate(u: FloatArray) -> FloatArray:
        _, k, _ = axis.at(u)
        return 1.0 - k * lateral

    e, n = e + lateral * m * np.cos(bearing), n - lateral * m * np.sin(bearing)
    knots = _tabulate(placed, station, station, e, n, bearing, bend / (1.0 - bend * lateral), cant, length_rate, sigma)
    return knots, station


def connecting_track(
    placed: PlacedAxis,
    begin: float,
    lateral: float,
    elements: Sequence[Element],
    *,
    spacing: float = 1.0,
    sigma: float = 0.01,
) -> tuple[KnotTable, FloatArray]:
    """Tabulate a track that starts tangentially beside a straight stretch of an axis and follows its own elements.

    Parameters
    ----------
    placed : PlacedAxis
    begin : float
        Station of the axis where the track starts, m.
    lateral : float
        Distance of its start from the axis, m, positive to the right.
    elements : sequence of Element
        From bearing 0, the axis's own.
    spacing, sigma : float
        As in `parallel_track`.

    Returns
    -------
    knots : KnotTable
    station : (k,) array
        The axis's station of each knot, m.

    Raises
    ------
    TrackError
        When the axis bends, or its gradient changes, beside the track.
    """
    local = Axis.of(elements)
    w = subdivide(local.station, spacing)
    across, along = local.plane(w)
    station, y = begin + along, lateral + across
    inside = (placed.axis.station > begin) & (placed.axis.station < station[-1])
    if np.abs(placed.axis.at(station)[1]).max() > 0.0 or inside.any():
        raise TrackError(f"the axis is not straight from {begin:.1f} to {station[-1]:.1f} m, where a connection lies")
    grade = placed.profile.at(station)[1]
    if np.ptp(grade) > 0.0:
        raise TrackError(f"the gradient changes between {begin:.1f} and {station[-1]:.1f} m, where a connection lies")
    e, n = placed.at(station)
    bearing0 = placed.axis.at(station)[0]
    turn, bend, cant = local.at(w)
    m = np.interp(station, placed.scale_station, placed.scale)
    e, n = e + y * m * np.cos(bearing0), n - y * m * np.sin(bearing0)
    knots = _tabulate(placed, w, station, e, n, bearing0 + turn, bend, cant, np.ones_like, sigma, turn)
    return knots, station


def _tabulate(
    placed: PlacedAxis,
    parameter: FloatArray,
    station: FloatArray,
    easting: FloatArray,
    northing: FloatArray,
    bearing: FloatArray,
    bend: FloatArray,
    cant: FloatArray,
    length_rate: Callable[[FloatArray], FloatArray],
    sigma: float,
    turn: FloatArray | None = None,
) -> KnotTable:
    """Knots from the plane geometry of a track: gradient, true length and scale of its own."""
    height, grade = placed.profile.at(station)
    ahead = np.ones(len(parameter)) if turn is None else np.cos(turn)  # metres of axis per metre of track
    gradient = grade * ahead / length_rate(parameter)
    coarse = np.unique(np.append(np.arange(0, len(parameter), max(1, int(SCALE_SPACING))), len(parameter) - 1))
    own = np.asarray(
        placed.frame.ground_scale(easting[coarse], northing[coarse], height[coarse], bearing[coarse]), float
    )
    scale = np.interp(parameter, parameter[coarse], own)
    ratio = np.interp(station, placed.scale_station, placed.scale) / scale
    # true length of each cell: grid metres of the curve over its own scale, along the slope
    half = 0.5 * np.diff(parameter)
    inner = parameter[:-1, None] + half[:, None] * (1.0 + _NODE)
    share = 0.5 * (1.0 + _NODE)

    def between(values: FloatArray) -> FloatArray:
        return values[:-1, None] * (1.0 - share) + values[1:, None] * share

    slope = placed.profile.at(inner)[1] / length_rate(inner) if turn is None else between(grade) * np.cos(between(turn))
    cell = (between(ratio) * length_rate(inner) * np.hypot(1.0, slope)) @ _WEIGHT * half
    variance = sigma**2
    covariance = np.tile([variance, 0.0, 0.0, variance, 0.0, variance], (len(parameter), 1))
    return KnotTable(
        offset=np.append(0.0, np.cumsum(cell)),
        easting=easting,
        northing=northing,
        height=height,
        grid_bearing=np.mod(bearing, 2.0 * np.pi),
        curvature=bend / np.hypot(1.0, gradient),
        gradient=gradient,
        cant=cant,
        scale=scale,
        covariance_g=covariance,
    )
