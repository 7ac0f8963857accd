"""Where elements begin: the cheapest sequence of straights, arcs and transitions through a measured axis.

Curvature of a track runs in pieces that are zero, constant or linear. Measured points are held against all such sequences at once:
each hypothesis is a Kalman filter whose states are the distance from the measured axis and its derivatives, a new piece may begin at
every point, and the cheapest hypotheses go on. The cost is -2 log likelihood and a price for each piece, so that a piece stands
only where the points ask for it. Correlated noise is a state of its own: waves that it explains become no elements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.monitoring.fitting import _kernels

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Live states of the pieces of a plan: distance and direction; curvature; its change.
STRAIGHT, ARC, TRANSITION = 2, 3, 4
#: Live states of the pieces of a profile: height and slope; the change of slope.
GRADE, CURVE = 2, 3
#: Live states of the pieces of cant: the cant; its change.
LEVEL, RAMP = 1, 2

#: Price of a piece, in -2 log likelihood: what its place costs to say.
_PRICE = 8.0
#: Further price of a curvature that jumps, or a gradient that kinks.
_JUMP_PRICE = 10.0
#: Hypotheses that cost more than the cheapest by this are given up.
_MARGIN = 70.0
#: Hypotheses that go on: for the answer, and for the noise alone.
BEAM, NARROW = 240, 60

#: From, to, lowest derivative that breaks, further price.
_PLAN_RULES = (
    (STRAIGHT, TRANSITION, 3, 0.0),
    (ARC, TRANSITION, 3, 0.0),
    (TRANSITION, STRAIGHT, 3, 0.0),
    (TRANSITION, ARC, 3, 0.0),
    (TRANSITION, TRANSITION, 3, 6.0),
    (STRAIGHT, ARC, 2, _JUMP_PRICE),
    (ARC, STRAIGHT, 2, _JUMP_PRICE),
    (ARC, ARC, 2, _JUMP_PRICE),
    (TRANSITION, STRAIGHT, 2, _JUMP_PRICE),
    (TRANSITION, ARC, 2, _JUMP_PRICE),
    (STRAIGHT, TRANSITION, 2, 2 * _JUMP_PRICE),
    (ARC, TRANSITION, 2, 2 * _JUMP_PRICE),
)
_PROFILE_RULES = (
    (GRADE, CURVE, 2, 0.0),
    (CURVE, GRADE, 2, 0.0),
    (CURVE, CURVE, 2, 0.0),
    (GRADE, GRADE, 1, _JUMP_PRICE),
)
_CANT_RULES = (
    (LEVEL, RAMP, 1, 0.0),
    (RAMP, LEVEL, 1, 0.0),
    (RAMP, RAMP, 1, 0.0),
    (LEVEL, LEVEL, 0, 2 * _JUMP_PRICE),
)


@dataclass(frozen=True, slots=True, eq=False)
class Prices:
    """What pieces of a plan cost, in -2 log likelihood: -2 ln of how often they are built.

    Attributes
    ----------
    place : float
        That a piece begins at a point at all.
    of_rule : (12,) array
        Which one follows which, and how.
    """

    place: float
    of_rule: FloatArray


#: As railways are built: curvature runs on, from a straight by a transition to an arc and back.
RAILWAY = Prices(_PRICE, np.array([rule[3] for rule in _PLAN_RULES]))
#: As tramways are: curvature jumps as often as not.
TRAMWAY = Prices(_PRICE, np.array([2.0, 2.0, 1.0, 1.0, 8.0, 1.0, 2.0, 2.0, 12.0, 12.0, 12.0, 12.0]))
#: As railways look where metre errors hide transitions: straights meet arcs, and only jumps beside a transition seen are dear.
UNSEEN = Prices(_PRICE, np.array([0.0, 0.0, 0.0, 0.0, 20.0, 2.0, 2.0, 8.0, 25.0, 25.0, 25.0, 25.0]))
#: Weight of what is built elsewhere beside what a track itself shows, pieces.
_ELSEWHERE = 4.0
_CHEAPEST, _DEAREST_PLACE = 5.0, 14.0


def _seen(pieces: Pieces) -> FloatArray:
    """How often each rule was followed."""
    return np.array(
        [
            np.sum((pieces.live[:-1] == a) & (pieces.live[1:] == b) & (pieces.order[1:] == order))
            for a, b, order, _ in _PLAN_RULES
        ],
        np.float64,
    )


def _usual() -> tuple[IntArray, FloatArray]:
    """Kind of piece before, and weight of each rule elsewhere, in pieces."""
    first = np.array([rule[0] for rule in _PLAN_RULES])
    usual = np.exp(-0.5 * RAILWAY.of_rule)
    for kind in (STRAIGHT, ARC, TRANSITION):
        usual[first == kind] *= _ELSEWHERE / usual[first == kind].sum()
    return first, usual


def learnt(pieces: Pieces, count: int) -> Prices:
    """What pieces cost on a track of `count` points that is built like these."""
    seen = _seen(pieces)
    first, usual = _usual()
    of_rule = np.empty(len(seen))
    for kind in (STRAIGHT, ARC, TRANSITION):
        here = first == kind
        share = seen[here] + usual[here]
        of_rule[here] = -2.0 * np.log(share / share.sum())
    place = float(np.clip(2.0 * np.log(count / max(len(pieces.begin), 2)), _CHEAPEST, _DEAREST_PLACE))
    return Prices(place, of_rule)


def whole_cost(pieces: Pieces, prices: Prices, count: int) -> float:
    """-2 log likelihood of pieces found at some prices, with what it costs to say how this track is built.

    What follows what is told by a Dirichlet distribution about how railways build: the first jump is dear, the twentieth cheap.
    """
    from scipy.special import gammaln

    seen = _seen(pieces)
    first, usual = _usual()
    told = 0.0
    for kind in (STRAIGHT, ARC, TRANSITION):
        here = first == kind
        told -= 2.0 * float(np.sum(gammaln(seen[here] + usual[here]) - gammaln(usual[here])))
        told += 2.0 * float(gammaln(seen[here].sum() + _ELSEWHERE) - gammaln(_ELSEWHERE))
    joints = len(pieces.begin) - 1
    place = float(np.clip(2.0 * np.log(count / max(joints + 1, 2)), _CHEAPEST, _DEAREST_PLACE))
    return pieces.cost - float(seen @ (prices.of_rule + prices.place)) + told + place * joints


def rarity_of_jumps(prices: Prices) -> float:
    """How much rarer straights and arcs meet with a jump than through a transition, in -2 log likelihood, 0 where they do not."""
    jumps = [k for k, (a, b, order, _) in enumerate(_PLAN_RULES) if order == 2 and TRANSITION not in (a, b)]
    smooth = [k for k, (a, b, order, _) in enumerate(_PLAN_RULES) if order == 3 and a != TRANSITION and b == TRANSITION]
    return max(float(prices.of_rule[jumps].min() - prices.of_rule[smooth].mean()), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """A sequence of pieces: (m,) arrays.

    Attributes
    ----------
    begin : (m,) int array
        Sample at which each begins; the first is 0.
    live : (m,) int array
        Its live states: STRAIGHT, ARC, TRANSITION; GRADE, CURVE; or LEVEL, RAMP.
    order : (m,) int array
        Lowest derivative that breaks at its begin.
    cost : float
        -2 log likelihood with prices.
    """

    begin: IntArray
    live: IntArray
    order: IntArray
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Noise of a measured quantity: white, and waves.

    Attributes
    ----------
    sigma : float or (n,) array
        White noise, m.
    correlated : float
        Size of the waves, m.
    length : float
        Distance d over which they forget, m: their correlation is exp(-d / length), and (1 + a) exp(-a), a = sqrt(3) d / length,
        where they are smooth.
    smooth : bool
        Whether they have a slope, as the errors of smoothed points do.
    """

    sigma: FloatArray | float
    correlated: float = 0.0
    length: float = 1.0
    smooth: bool = False

    @property
    def total(self) -> float:
        """Of a point, m."""
        return float(np.hypot(np.mean(self.sigma), self.correlated))

    def scaled(self, factor: float) -> Noise:
        """The same noise so many times as large."""
        return Noise(float(np.mean(self.sigma)) * factor, self.correlated * factor, self.length, self.smooth)

    def correlation(self, distance: FloatArray) -> FloatArray:
        """Correlation of the waves over distances."""
        if self.smooth:
            a = np.sqrt(3.0) * np.abs(distance) / self.length
            return np.asarray((1.0 + a) * np.exp(-a))
        return np.exp(-np.abs(distance) / self.length)

    def passing(self, step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How waves and their slope pass on over steps, (n, 4) row by row, and their variances, (2,)."""
        variance = self.correlated**2
        zero = np.zeros(len(step))
        if not self.smooth:
            return np.column_stack([np.exp(-step / self.length), zero, zero, zero]), np.array([variance, 0.0])
        rate = np.sqrt(3.0) / self.length
        a = rate * step
        e = np.exp(-a)
        return (
            np.column_stack([(1.0 + a) * e, step * e, -rate * a * e, (1.0 - a) * e]),
            np.array([variance, rate**2 * variance]),
        )


def reference(along: FloatArray, east: FloatArray, north: FloatArray, window: float) -> tuple[FloatArray, ...]:
    """Smooth curve beside measured points: local parabolas over `window` metres.

    Returns
    -------
    east, north, bearing, bend : (n,) array
        The curve's points, its bearing and its curvature, m, rad, 1/m.
    """
    n = len(along)
    points = np.column_stack([east, north])
    origin = points.mean(axis=0)
    points = points - origin
    half = 0.5 * window
    first = np.searchsorted(along, along - half)
    last = np.searchsorted(along, along + half, side="right")
    short = last - first < 5
    first = np.where(short, np.clip(np.arange(n) - 2, 0, max(n - 5, 0)), first)
    last = np.where(short, np.minimum(first + 5, n), last)
    most = int((last - first).max())
    sums = np.zeros((n, 5))
    rhs = np.zeros((n, 3, 2))
    for lag in range(most):
        j = np.minimum(first + lag, n - 1)
        use = (first + lag < last).astype(float)
        u = along[j] - along
        power = use.copy()
        for k in range(5):
            sums[:, k] += power
            if k < 3:
                rhs[:, k] += power[:, None] * points[j]
            power = power * u
    normal = sums[:, np.add.outer(np.arange(3), np.arange(3))]
    answer = np.linalg.solve(normal, rhs)
    x, d = answer[:, 0], answer[:, 1]
    bearing = np.unwrap(np.arctan2(d[:, 0], d[:, 1]))
    bend = np.gradient(bearing, along)
    return x[:, 0] + origin[0], x[:, 1] + origin[1], bearing, bend


def segment_plan(
    along: FloatArray,
    east: FloatArray,
    north: FloatArray,
    noise: Noise,
    *,
    window: float,
    every: float = 0.0,
    curvature_scale: float,
    rate_scale: float,
    beam: int = BEAM,
    prices: Prices | None = None,
) -> Pieces:
    """Pieces of a plan.

    Parameters
    ----------
    along : (n,) array
        Length along the points, m.
    east, north : (n,) array
        Points of the plane, m.
    noise : Noise
        Of the points, across the track.
    window : float
        Length over which the curve beside the points is smoothed, m.
    every : float
        Least distance between places where a piece may begin, m.
    curvature_scale, rate_scale : float
        What curvatures (1/m) and their changes along the track (1/m^2) are like.
    beam : int
        Hypotheses that go on.
    prices : Prices, optional
        What pieces cost; by default as on railways.
    """
    ref_e, ref_n, bearing, _ = reference(along, east, north, window)
    sin, cos = np.sin(bearing), np.cos(bearing)
    y = (east - ref_e) * cos - (north - ref_n) * sin
    step_e, step_n = np.diff(ref_e), np.diff(ref_n)
    # along and across the reference's own direction
    step = step_e * sin[:-1] + step_n * cos[:-1]
    shift = step_e * cos[:-1] - step_n * sin[:-1]
    turn = np.diff(bearing)
    arc = np.hypot(step_e, step_n) / np.sinc(0.5 * turn / np.pi)
    del step
    return _run(
        along,
        y,
        arc,
        shift,
        turn,
        turn / arc,
        noise,
        _PLAN_RULES,
        np.array([STRAIGHT, ARC, TRANSITION]),
        np.array([1.0, 0.01, curvature_scale**2, rate_scale**2]),
        every,
        beam,
        RAILWAY if prices is None else prices,
    )


def segment_profile(
    along: FloatArray, height: FloatArray, noise: Noise, *, every: float = 0.0, bend_scale: float, beam: int = BEAM
) -> Pieces:
    """Pieces of a profile: grades, and vertical curves whose slope changes evenly, `bend_scale` a metre (1/m)."""
    zero = np.zeros(len(along) - 1)
    start = height - height[0]
    return _run(
        along,
        start,
        np.diff(along),
        zero,
        zero,
        zero,
        noise,
        _PROFILE_RULES,
        np.array([GRADE, CURVE]),
        np.array([1.0, 1e-3, bend_scale**2]),
        every,
        beam,
    )


def segment_cant(
    along: FloatArray, cant: FloatArray, noise: Noise, *, every: float = 0.0, rate_scale: float, beam: int = BEAM
) -> Pieces:
    """Pieces of cant: level, and ramps of about `rate_scale` m a metre."""
    zero = np.zeros(len(along) - 1)
    return _run(
        along,
        cant - cant[0],
        np.diff(along),
        zero,
        zero,
        zero,
        noise,
        _CANT_RULES,
        np.array([LEVEL, RAMP]),
        np.array([0.01, rate_scale**2]),
        every,
        beam,
    )


def unlikeliness(along: FloatArray, off: FloatArray, noise: Noise) -> float:
    """-2 log likelihood of distances `off` (n,) at places under a noise, but for a constant."""
    n = len(along)
    zero = np.zeros(n)
    white = np.broadcast_to(np.asarray(noise.sigma, np.float64) ** 2, (n,)).copy()
    step = np.append(0.0, np.diff(along))
    passing, colour = noise.passing(step)
    none = np.zeros(n, bool)
    _, cost = _kernels.segment(
        step, np.ascontiguousarray(off), zero, zero, zero, white, passing, colour, none, np.array([1]),
        np.zeros((0, 3), np.int64), np.zeros(0), np.array([1e-12]), 4, _MARGIN,
    )  # fmt: skip
    return float(cost + np.log(white).sum())


def _run(
    along: FloatArray,
    y: FloatArray,
    step: FloatArray,
    shift: FloatArray,
    turn: FloatArray,
    bow: FloatArray,
    noise: Noise,
    rules: tuple[tuple[int, int, int, float], ...],
    first: IntArray,
    prior: FloatArray,
    every: float,
    beam: int,
    prices: Prices | None = None,
) -> Pieces:
    n = len(along)
    if n < 8:
        raise TrackError(f"{n} points are too few to find elements in; give at least 8")
    white = np.broadcast_to(np.asarray(noise.sigma, np.float64) ** 2, (n,)).copy()
    zero = np.zeros(1)
    passing, colour = noise.passing(np.append(0.0, step))
    if every > 0.0:
        slot = np.floor(along / every)
        sites = np.append(False, np.diff(slot) > 0)
    else:
        sites = np.ones(n, bool)
    table = np.array([rule[:3] for rule in rules], np.int64)
    price = _PRICE + np.array([rule[3] for rule in rules]) if prices is None else prices.place + prices.of_rule
    found, cost = _kernels.segment(
        np.append(zero, step),
        np.ascontiguousarray(y),
        np.append(zero, shift),
        np.append(zero, turn),
        np.append(zero, bow),
        white,
        passing,
        colour,
        sites,
        first,
        table,
        price,
        prior,
        beam,
        _MARGIN,
    )
    return Pieces(found[:, 0].copy(), found[:, 1].copy(), found[:, 2].copy(), float(cost))
