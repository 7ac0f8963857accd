"""Elements of designed alignments: straights, arcs and transitions in a plane, vertical curves, cant ramps.

Lengths, radii and coordinates are those of the plane in which the alignment was designed: an arc is an arc in the grid.
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

The cubic parabola (kind CUBIC, from or to a straight) is exact in arc length: y = x^3 / (6 c), its tangent's slope
tan(theta) = p (x/x_e)^2, p and x_e such that it is L long and ends with the stated curvature.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

STRAIGHT, ARC, CLOTHOID, BLOSS, COSINE, SINE, HELMERT, VIENNESE, CUBIC = range(9)

#: Names of the kinds as users write them, in the order of their numbers.
KIND_NAMES = ("straight", "arc", "clothoid", "bloss", "cosine", "sine", "helmert", "viennese", "cubic-parabola")

#: Gauss-Legendre nodes and weights on [-1, 1].
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
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
        kind = self.kind[owner]
        f, _ = law(np.where((kind < CLOTHOID) | (kind == CUBIC), CLOTHOID, kind), share)
        return np.asarray(self.start[owner] + (self.end[owner] - self.start[owner]) * f)


@dataclass(frozen=True, slots=True, eq=False)
class Gradients:
    """A profile: straights, parabolas and circles one after another by grid length; arrays (n,), the first begins at -infinity.

    Attributes
    ----------
    begin : (n,) array
        Grid lengths from the track's start where the pieces begin, m; the last one goes on for ever.
    origin, height, slope : (n,) array
        Grid length, height, m, and slope (rise over grid length, positive uphill) from which a piece is reckoned.
    bend : (n,) array
        Of parabolas, half the change of slope per metre, positive in a sag, 1/m: h = height + slope x + bend x^2; else 0.
    radius : (n,) array
        Of circles, m, positive in a sag; else 0.
    """

    begin: FloatArray
    origin: FloatArray
    height: FloatArray
    slope: FloatArray
    bend: FloatArray
    radius: FloatArray

    def __call__(self, at: FloatArray, derivative: int = 0) -> FloatArray:
        """Height, m, or its slope (derivative 1), or the change of slope per metre (2) at grid lengths."""
        at = np.asarray(at, np.float64)
        which = np.clip(np.searchsorted(self.begin, at, side="right") - 1, 0, len(self.begin) - 1)
        x, h, g = at - self.origin[which], self.height[which], self.slope[which]
        c, r = self.bend[which], self.radius[which]
        # a circle from the point with gradient g: sine of the angle grows by x / r
        sine = np.where(r == 0.0, 0.0, g / np.hypot(1.0, g) + x / np.where(r == 0.0, 1.0, r))
        cosine = np.sqrt(np.maximum(1.0 - sine**2, 1e-12))
        if derivative == 2:
            return np.asarray(np.where(r == 0.0, 2.0 * c, 1.0 / np.where(r == 0.0, 1.0, r) / cosine**3))
        if derivative == 1:
            return np.asarray(np.where(r == 0.0, g + 2.0 * c * x, sine / cosine))
        round_ = r * (1.0 / np.hypot(1.0, g) - cosine)
        return np.asarray(h + np.where(r == 0.0, g * x + c * x * x, round_))


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
    kind = plan.kind[which]
    _, whole = law(kind, t)
    swing = plan.sway[which] * length * 140.0 * t**3 * (1.0 - t) ** 3  # f' of the Viennese law
    turned = np.asarray(k0 * s + (k1 - k0) * length * whole - swing)
    cubic = kind == CUBIC
    if cubic.any():
        turned[cubic], _ = _cubic(k0[cubic], k1[cubic], length[cubic], t[cubic])
    return turned


def curvature(plan: Plan, which: IntArray, t: FloatArray) -> FloatArray:
    """Curvature in the grid where a share t of elements `which` is run, 1/m."""
    f, _ = law(plan.kind[which], t)
    k0, k1 = plan.curvature_start[which], plan.curvature_end[which]
    swing = plan.sway[which] * 420.0 * t * t * (1.0 - t) ** 2 * (1.0 - 2.0 * t)  # f'' of the Viennese law
    bent = np.asarray(k0 + (k1 - k0) * f - swing)
    cubic = plan.kind[which] == CUBIC
    if cubic.any():
        _, bent[cubic] = _cubic(k0[cubic], k1[cubic], plan.length[which][cubic], t[cubic])
    return bent


#: The tangent's slope at the end of a cubic parabola, at most: there its curvature is largest for its length.
_STEEPEST = 0.7
#: Nodes and weights on [0, 1] for the length of a cubic parabola.
_U = 0.5 * (np.polynomial.legendre.leggauss(24)[0] + 1.0)
_W = 0.5 * np.polynomial.legendre.leggauss(24)[1]


def _cubic(k0: FloatArray, k1: FloatArray, length: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Turn and curvature where a share t of cubic parabolas is run, rad, 1/m."""
    backward = k1 == 0.0
    k = np.where(backward, k0, k1)
    if ((k0 != 0.0) & (k1 != 0.0)).any():
        raise TrackError("a cubic parabola between two arcs; it leads from or to a straight: use a clothoid")
    share = np.where(backward, 1.0 - t, t)
    wanted = np.abs(k) * length

    def run(p: FloatArray, v: FloatArray) -> FloatArray:
        """Length up to x = v x_e, in units of x_e: integral of sqrt(1 + p^2 w^4)."""
        return np.asarray(v * (np.sqrt(1.0 + (p[..., None] * (v[..., None] * _U) ** 2) ** 2) @ _W))

    one = np.ones_like(wanted)
    if (wanted > 2.0 * _STEEPEST * (1.0 + _STEEPEST**2) ** -1.5 * run(_STEEPEST * one, one)).any():
        raise TrackError(
            "a cubic parabola too long for its radius: its curvature does not grow that far; use a clothoid"
        )
    low, high = 0.0 * one, _STEEPEST * one
    p = 0.5 * wanted
    for _ in range(60):  # k L = 2 p (1 + p^2)^(-3/2) G(p), growing in p: secant within the bracket
        value = 2.0 * p * (1.0 + p * p) ** -1.5 * run(p, one) - wanted
        low, high = np.where(value < 0.0, p, low), np.where(value < 0.0, high, p)
        step = p - value / np.maximum(2.0 * (1.0 - 2.0 * p * p) * (1.0 + p * p) ** -2.5, 1e-2)
        again = np.where((step > low) & (step < high), step, 0.5 * (low + high))
        if np.abs(again - p).max(initial=0.0) < 1e-16:
            break
        p = again
    whole = run(p, one)
    v = share.copy()
    for _ in range(8):
        v = v - (run(p, v) - share * whole) / np.sqrt(1.0 + (p * v * v) ** 2)
    slope = p * v * v
    side = np.sign(k)
    forward = np.arctan(slope)
    turned = np.where(backward, np.arctan(p) - forward, forward)
    end = np.where(wanted == 0.0, 1.0, length / whole)  # x_e
    return side * turned, side * 2.0 * p * v / end * (1.0 + slope**2) ** -1.5


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
