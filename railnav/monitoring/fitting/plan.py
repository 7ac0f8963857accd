"""Plan elements fitted to measured points: all of them at once, tangent to one another.

Each element has its own start, direction, length and end curvatures; that it begins where the one before ends is a condition of the
adjustment, so that its normal equations are sparse however long the line. Observations are the distances of the points across the
axis from their feet, which move with it; gross errors weigh less. Lengths are the plane's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError
from railnav.monitoring.fitting import _kernels
from railnav.monitoring.fitting.segmentation import ARC, STRAIGHT, Noise, Pieces
from railnav.monitoring.fitting.waves import Waves
from railnav.track import elements
from railnav.track.elements import Plan

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Residuals beyond this many sigmas weigh less.
ROBUST = 3.5
#: Unknowns of an element: easting, northing, bearing of its start, its length.
_OWN = 4
_MOST_STEPS, _MOST_TRIALS = 40, 9
#: Steps that would lower the sum of squares by no more than this, and leave elements apart by no more than that, m, are at rest.
_AT_REST, _CLOSED = 1e-2, 1e-7
#: No element gets shorter than this, m.
_LEAST_LENGTH = 0.02
#: How far elements may miss each other on the way, sigmas of the points, and the length over which a miss of direction counts, m.
_APART, _ARM = 0.1, 20.0
#: Elements meet if they miss each other by less than this share of the points' sigma.
_MEETS = 0.1
#: A length that the points do not tell is held as if it were known to this, m, a curvature to this, 1/m.
_HARDLY_LENGTH, _HARDLY_BEND = 300.0, 0.1
#: Damping of one holds a length to its own size and a curvature to its own, at least this, 1/m.
_BEND_SIZE = 1e-3
#: No track bends more than this, 1/m.
_SHARPEST = 0.2
#: A length changes by no more than this share in a step.
_STRIDE = 0.5
_LEAST_DAMPING = 1e-9
#: Equations of fewer unknowns are solved dense.
_SMALL = 220
_UNDETERMINED = "the elements are not determined by the points; fewer elements, or points further along, would do"


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Elements in the making: (m,) arrays, and the (c,) curvatures that they share.

    Attributes
    ----------
    kind : (m,) int array
        As in `railnav.track.elements`.
    length : (m,) array
        m.
    first, last : (m,) int array
        Which curvature an element begins and ends with; -1 for none.
    bend : (c,) array
        Curvatures, positive to the right, 1/m.
    start : (m, 3) array
        Easting, northing, m, and bearing, rad, of each element's start.
    sway : (m,) array
        Of Viennese bends, for one metre of height of the centre of gravity: change of the cant angle.
    """

    kind: IntArray
    length: FloatArray
    first: IntArray
    last: IntArray
    bend: FloatArray
    start: FloatArray
    sway: FloatArray

    @property
    def k0(self) -> FloatArray:
        """Curvatures at the elements' starts, 1/m."""
        return np.where(self.first < 0, 0.0, np.append(self.bend, 0.0)[self.first])

    @property
    def k1(self) -> FloatArray:
        """Curvatures at the elements' ends, 1/m."""
        return np.where(self.last < 0, 0.0, np.append(self.bend, 0.0)[self.last])

    @property
    def edges(self) -> FloatArray:
        """Lengths to the starts of elements and to the end, (m + 1,), m."""
        return np.append(0.0, np.cumsum(self.length))

    @property
    def plan(self) -> Plan:
        """The elements as a plan."""
        return Plan(
            self.length,
            self.kind,
            self.k0,
            self.k1,
            self.start[:, 0].copy(),
            self.start[:, 1].copy(),
            self.start[:, 2].copy(),
            self._swing,
        )

    @property
    def _swing(self) -> FloatArray:
        return np.where(self.kind == elements.VIENNESE, self.sway / self.length**2, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class PlanFit:
    """A fitted plan.

    Attributes
    ----------
    chain : Chain
    residual : (n,) array
        Distance of the points from the axis, positive to the right, m.
    along : (n,) array
        Lengths of their feet from the start of the axis, m.
    weight : (n,) array
        Robust weights, 1 for points that fit.
    square : (n,) array
        What each point, and the wave that leads to it, add to the cost.
    cost : float
        -2 log likelihood of the points but for a constant: Huber's sum of their squares and those of the waves.
    settled : bool
        Whether the steps came to rest.
    factor : Factored
        Of the normal equations with their conditions.
    noise : Noise
        Of the points, as used.
    apart : float
        By how much elements miss each other at most, m; directions over 20 m.
    """

    chain: Chain
    residual: FloatArray
    along: FloatArray
    weight: FloatArray
    square: FloatArray
    cost: float
    settled: bool
    factor: Factored
    noise: Noise
    apart: float = 0.0

    @property
    def closed(self) -> bool:
        """Whether elements meet as far as the points could tell: what is not at rest may hide a kink between them."""
        return self.settled or self.apart < _MEETS * float(np.median(self.noise.sigma))


def chain_of_pieces(pieces: Pieces, along: FloatArray, ref: tuple[FloatArray, ...]) -> Chain:
    """First elements from pieces and the smooth curve beside the points."""
    east, north, bearing, bend = ref
    begin = pieces.begin
    count = len(begin)
    end = np.append(begin[1:], len(along) - 1)
    length = np.maximum(along[end] - along[begin], 1e-3)
    mean = (bearing[end] - bearing[begin]) / length
    live = pieces.live
    first, last = np.full(count, -1), np.full(count, -1)
    values: list[float] = []

    def new(value: float) -> int:
        values.append(value)
        return len(values) - 1

    for j in range(count):
        if live[j] == ARC:
            first[j] = last[j] = new(float(mean[j]))
    for j in range(count):
        if live[j] in (STRAIGHT, ARC):
            continue
        smooth_in = j > 0 and pieces.order[j] == 3
        smooth_out = j < count - 1 and pieces.order[j + 1] == 3
        first[j] = last[j - 1] if smooth_in else new(float(bend[begin[j]]))
        if smooth_out and live[j + 1] in (STRAIGHT, ARC):
            last[j] = first[j + 1]
        else:
            last[j] = new(float(bend[end[j]]))
    kind = np.where(live == STRAIGHT, elements.STRAIGHT, np.where(live == ARC, elements.ARC, elements.CLOTHOID))
    start = np.column_stack([east[begin], north[begin], bearing[begin]])
    return Chain(kind.astype(np.int64), length, first, last, np.array(values), start, np.zeros(count))


def fit_plan(
    chain: Chain,
    along: FloatArray,
    east: FloatArray,
    north: FloatArray,
    noise: Noise,
    *,
    steps: int = _MOST_STEPS,
    held: NDArray[np.bool_] | None = None,
) -> PlanFit:
    """Adjust all elements to points.

    Parameters
    ----------
    chain : Chain
        Elements near enough to begin from.
    along : (n,) array
        Lengths along the chain where the feet of the points about lie, m.
    east, north : (n,) array
        Points in order, m.
    noise : Noise
        Of the points across the track.
    steps : int
        At most.
    held : (m + c,) bool array, optional
        Lengths, then shared curvatures, that stay as they are.

    Raises
    ------
    EstimationError
        The equations have no unique solution.

    Notes
    -----
    Gauss-Newton with conditions (docs/theory/alignment.md, eqs 8 to 11). Coordinates are reckoned from the first point.
    """
    origin = np.array([east[0], north[0]])
    x, y = east - origin[0], north - origin[1]
    start = chain.start.copy()
    start[:, :2] -= origin
    chain = replace(chain, start=start)
    m = len(chain.kind)
    settled = False
    reach = 2.0 * float(along[-1] - along[0]) + 100.0
    edges = chain.edges
    owner = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, m - 1).astype(np.int64)
    s = along - edges[owner]
    sigma = np.broadcast_to(np.asarray(noise.sigma, np.float64), (len(x),))
    waves = Waves(along, noise)
    robust = np.ones(len(x))
    state = _lay(chain, owner, s)
    for _ in range(3):
        owner, s = _feet(chain, owner, s, x, y, state)
        state = _lay(chain, owner, s)
    wave, merit = _merit(chain, x, y, sigma, robust, waves, state)
    count_of = _OWN * m + len(chain.bend)
    damping, grow = merit / (_OWN * m), 2.0  # a poor start asks for short steps
    for count in range(steps):
        given = partial(_equations, chain, owner, s, x, y, sigma, robust, waves, wave, state)
        end = s[-1] if owner[-1] == m - 1 else None
        for _ in range(_MOST_TRIALS):  # a step that leads away is taken again, shorter
            step, damping, promised, solver = _step_of(given, held, damping, count_of, chain.length)
            trial = _closed(_stepped(chain, step, end), solver, count_of, waves.count)
            if _lawful(trial, reach):
                trial_owner, trial_s = _refooted(chain, trial, owner, s)
                trial_state = _lay(trial, trial_owner, trial_s)
                trial_owner, trial_s = _feet(trial, trial_owner, trial_s, x, y, trial_state)
                trial_state = _lay(trial, trial_owner, trial_s)
                trial_wave, trial_merit = _merit(trial, x, y, sigma, robust, waves, trial_state)
                if trial_merit <= merit + 0.1 * _AT_REST or (count == 0 and trial_merit < 3.0 * merit):
                    share = (merit - trial_merit) / max(promised, 1e-30)
                    damping = max(damping * max(0.1, 1.0 - (2.0 * min(share, 1.0) - 1.0) ** 3), _LEAST_DAMPING)
                    grow = 2.0
                    chain, owner, s, state, merit = trial, trial_owner, trial_s, trial_state, trial_merit
                    wave = trial_wave
                    break
            damping, grow = max(damping * grow, 1e-4), 2.0 * grow
        else:
            settled = promised < 1.0 and _apart(chain, state) < _CLOSED  # nothing better nearby
            break
        ratio = np.abs(_across(x, y, state) - waves.at(wave)) / sigma
        robust = np.where(ratio > ROBUST, ROBUST / np.maximum(ratio, ROBUST), 1.0)
        wave, merit = _merit(chain, x, y, sigma, robust, waves, state)
        if count > 1 and promised < _AT_REST and _apart(chain, state) < _CLOSED:
            settled = True
            break
    for _ in range(3):
        owner, s = _feet(chain, owner, s, x, y, state)
        state = _lay(chain, owner, s)
    residual = _across(x, y, state)
    wave, _ = _merit(chain, x, y, sigma, robust, waves, state)
    _, kkt, _ = _equations(chain, owner, s, x, y, sigma, robust, waves, wave, state, 0.0, held)
    square = _huber(residual - waves.at(wave), sigma) + waves.squares(wave)
    along = chain.edges[owner] + s
    start = chain.start.copy()
    start[:, :2] += origin
    factor = factored(kkt, count_of + waves.count)
    return PlanFit(
        replace(chain, start=start),
        residual,
        along,
        robust,
        square,
        float(square.sum()),
        settled,
        factor,
        noise,
        _apart(chain, state),
    )


# --- within -----------------------------------------------------------------------------------------------------------


def _lay(chain: Chain, owner: IntArray, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    n, m = len(s), len(chain.kind)
    here, slopes, ends, end_slopes = np.empty((n, 4)), np.empty((n, 8)), np.empty((m, 4)), np.empty((m, 11))
    _kernels.lay(
        chain.kind,
        chain.length,
        chain.k0,
        chain.k1,
        chain._swing,
        np.ascontiguousarray(chain.start[:, 0]),
        np.ascontiguousarray(chain.start[:, 1]),
        np.ascontiguousarray(chain.start[:, 2]),
        owner,
        s,
        here,
        slopes,
        ends,
        end_slopes,
    )
    return here, slopes, ends, end_slopes


def _feet(
    chain: Chain,
    owner: IntArray,
    s: FloatArray,
    x: FloatArray,
    y: FloatArray,
    state: tuple[FloatArray, ...],
) -> tuple[IntArray, FloatArray]:
    """Feet moved along the elements; kept in the order of the points."""
    here = state[0]
    sin, cos = np.sin(here[:, 2]), np.cos(here[:, 2])
    dx, dy = x - here[:, 0], y - here[:, 1]
    ahead, aside = dx * sin + dy * cos, dx * cos - dy * sin
    step = np.clip(ahead / np.maximum(1.0 - here[:, 3] * aside, 0.2), -20.0, 20.0)
    owner, s = owner.copy(), s.copy()
    _kernels.advance(owner, s, chain.length, step)
    total = np.maximum.accumulate(chain.edges[owner] + s)  # points are in order: feet that pass each other wait
    behind = total > chain.edges[owner] + s
    if behind.any():
        edges = chain.edges
        owner[behind] = np.clip(np.searchsorted(edges, total[behind], side="right") - 1, 0, len(edges) - 2)
        s[behind] = total[behind] - edges[owner[behind]]
    return owner, s


def _equations(
    chain: Chain,
    owner: IntArray,
    s: FloatArray,
    x: FloatArray,
    y: FloatArray,
    sigma: FloatArray,
    robust: FloatArray,
    waves: Waves,
    wave: FloatArray,
    state: tuple[FloatArray, ...],
    damping: float = 0.0,
    held: NDArray[np.bool_] | None = None,
    change: FloatArray | None = None,
) -> tuple[Any, Any, FloatArray]:
    """Whitened design, and the normal equations with their conditions, eq (10): elements first, then waves, then conditions."""
    from scipy import sparse

    here, slopes, ends, end_slopes = state
    m, c = len(chain.kind), len(chain.bend)
    n, p = len(s), _OWN * m + c
    sin, cos = np.sin(here[:, 2]), np.cos(here[:, 2])
    residual = (x - here[:, 0]) * cos - (y - here[:, 1]) * sin
    # d(residual) = -normal . d(point), normal = (cos, -sin)
    across = np.column_stack([cos, -sin])
    by = [across[:, 0], across[:, 1], across[:, 0] * slopes[:, 7] - across[:, 1] * slopes[:, 6]]
    by += [across[:, 0] * slopes[:, 2 * k] + across[:, 1] * slopes[:, 2 * k + 1] for k in (2, 0, 1)]
    columns = [_OWN * owner, _OWN * owner + 1, _OWN * owner + 2, _OWN * owner + 3]
    columns += [_OWN * m + chain.first[owner], _OWN * m + chain.last[owner]]
    keep = [np.ones(n, bool)] * 3 + [chain.kind[owner] >= elements.CLOTHOID]
    keep += [chain.first[owner] >= 0, chain.last[owner] >= 0]
    row = np.arange(n)
    weight = np.sqrt(robust) / sigma
    whole = p + waves.count
    small = whole + 3 * m < _SMALL
    design = _filled(
        np.concatenate([(-b * weight)[k] for b, k in zip(by, keep, strict=True)]),
        np.concatenate([row[k] for k in keep]),
        np.concatenate([column[k] for column, k in zip(columns, keep, strict=True)]),
        (n, p),
        small,
    )
    misfit = weight * residual
    if waves.count:
        through = -(sparse.diags_array(weight) @ waves.pick)
        if small:
            design = np.block([[design, through.toarray()], [np.zeros((waves.count, p)), waves.steps.toarray()]])
        else:
            design = sparse.block_array([[design, through], [None, waves.steps]], format="csr")
        misfit = np.concatenate([misfit - weight * waves.at(wave), waves.steps @ wave])
    # conditions: the end of element j is the start of j + 1
    j = np.arange(m - 1)
    sb, cb = np.sin(ends[:-1, 2]), np.cos(ends[:-1, 2])
    miss = np.column_stack([chain.start[1:, k] - ends[:-1, k] for k in range(3)])
    data: list[FloatArray] = []
    rows: list[IntArray] = []
    cols: list[IntArray] = []

    def put(r: IntArray, column: IntArray, value: FloatArray, use: NDArray[np.bool_] | None = None) -> None:
        use = np.ones(len(r), bool) if use is None else use
        rows.append(r[use])
        cols.append(column[use])
        data.append(np.broadcast_to(value, r.shape)[use])

    one = np.ones(m - 1)
    run_e, run_n = end_slopes[:-1, 6], end_slopes[:-1, 7]
    is_transition = chain.kind[:-1] >= elements.CLOTHOID
    for axis in range(3):
        r = 3 * j + axis
        put(r, _OWN * j + axis, one)
        put(r, _OWN * (j + 1) + axis, -one)
        if axis < 2:
            put(r, _OWN * j + 2, run_n if axis == 0 else -run_e)
        for what, source in ((0, chain.first[:-1]), (1, chain.last[:-1])):
            value = end_slopes[:-1, 2 * what + axis] if axis < 2 else end_slopes[:-1, 8 + what]
            put(r, _OWN * m + source, value, source >= 0)
        if axis < 2:
            value = (sb if axis == 0 else cb) + np.where(is_transition, end_slopes[:-1, 4 + axis], 0.0)
        else:
            value = ends[:-1, 3] + np.where(is_transition, end_slopes[:-1, 10], 0.0)
        put(r, _OWN * j + 3, value)
    # the start stands beside the first point, the end beside the last
    r0 = np.full(1, 3 * (m - 1))
    b0 = chain.start[0, 2]
    put(r0, np.array([0]), np.array([np.sin(b0)]))
    put(r0, np.array([1]), np.array([np.cos(b0)]))
    put(r0 + 1, np.array([_OWN * m - 1]), np.array([1.0]))
    stay = np.empty(0, np.int64) if held is None else np.flatnonzero(held)
    stay = stay[stay != m - 1]
    put(
        3 * (m - 1) + 2 + np.arange(len(stay)),
        np.where(stay < m, _OWN * stay + _OWN - 1, _OWN * m + stay - m),
        np.ones(len(stay)),
    )
    rest = np.concatenate(
        [
            miss.ravel(),
            [(x[0] - chain.start[0, 0]) * np.sin(b0) + (y[0] - chain.start[0, 1]) * np.cos(b0), 0.0],
            (np.zeros(len(stay)) if change is None else change[stay]),
        ]
    )
    conditions = _filled(
        np.concatenate(data),
        np.concatenate(rows),
        np.concatenate(cols),
        (3 * (m - 1) + 2 + len(stay), whole),
        small,
    )
    normal = _kernels.products(design) if small else design.T @ design
    scale = np.append(_hold(chain, damping), np.zeros(waves.count))
    if small:
        nothing = np.zeros((len(conditions), len(conditions)))
        kkt = np.block([[normal + np.diag(scale), conditions.T], [conditions, nothing]])
    else:
        kkt = sparse.block_array([[normal + sparse.diags_array(scale), conditions.T], [conditions, None]], format="csc")
    return design, kkt, np.concatenate([-(design.T @ misfit), rest])


def _filled(data: FloatArray, rows: IntArray, cols: IntArray, shape: tuple[int, int], small: bool) -> Any:
    """A matrix of sums at rows and columns: dense where it is small, which is quicker, else sparse."""
    from scipy import sparse

    if small:
        return np.bincount(rows * shape[1] + cols, data, shape[0] * shape[1]).reshape(shape)
    return sparse.csr_array((data, (rows, cols)), shape=shape)


def _lawful(chain: Chain, reach: float) -> bool:
    """Whether a step has led to elements that there can be."""
    finite = np.isfinite(chain.start).all() and np.isfinite(chain.length).all() and np.isfinite(chain.bend).all()
    return bool(finite and chain.length.sum() < reach and np.abs(chain.bend).max(initial=0.0) < _SHARPEST)


def _across(x: FloatArray, y: FloatArray, state: tuple[FloatArray, ...]) -> FloatArray:
    """Distances of points from the axis at their feet, positive to the right."""
    here = state[0]
    return np.asarray((x - here[:, 0]) * np.cos(here[:, 2]) - (y - here[:, 1]) * np.sin(here[:, 2]))


def _huber(off: FloatArray, sigma: FloatArray) -> FloatArray:
    ratio = np.abs(off) / sigma
    return np.asarray(np.where(ratio > ROBUST, ROBUST * (2.0 * ratio - ROBUST), ratio**2))


def _merit(
    chain: Chain,
    x: FloatArray,
    y: FloatArray,
    sigma: FloatArray,
    robust: FloatArray,
    waves: Waves,
    state: tuple[FloatArray, ...],
) -> tuple[FloatArray, float]:
    """Likeliest waves, and what a step must not raise: Huber's sum over the points, and how far elements miss each other."""
    off = _across(x, y, state)
    wave = waves.likeliest(off, robust / sigma**2)
    points = _huber(off - waves.at(wave), sigma).sum() + waves.squares(wave).sum()
    ends = state[2]
    miss = chain.start[1:] - ends[:-1, :3]
    allowed = _APART * float(np.median(sigma))
    apart = (miss[:, 0] ** 2 + miss[:, 1] ** 2).sum() / allowed**2
    apart += (miss[:, 2] ** 2).sum() / (allowed / _ARM) ** 2
    return wave, float(points + apart)


def _refooted(chain: Chain, trial: Chain, owner: IntArray, s: FloatArray) -> tuple[IntArray, FloatArray]:
    """Feet kept where they were along the axis when lengths change."""
    edges = trial.edges
    total = chain.edges[owner] + s
    found = np.clip(np.searchsorted(edges, total, side="right") - 1, 0, len(edges) - 2).astype(np.int64)
    return found, total - edges[found]


def _hold(chain: Chain, damping: float) -> FloatArray:
    """Weights that hold lengths and curvatures: a trace, so that what the points do not tell stays put, and the damping of a step.

    Starts and directions need none: lengths, curvatures and the points settle them.
    """
    m = len(chain.kind)
    scale = np.zeros(_OWN * m + len(chain.bend))
    scale[_OWN - 1 : _OWN * m : _OWN] = _HARDLY_LENGTH**-2 + damping * np.maximum(chain.length, 1.0) ** -2
    scale[_OWN * m :] = _HARDLY_BEND**-2 + damping * np.maximum(np.abs(chain.bend), _BEND_SIZE) ** -2
    return scale


@dataclass(frozen=True, slots=True, eq=False)
class Factored:
    """Equations with conditions, factored with rows and columns of like size: what a radius and a place tell differ by 1e12."""

    lu: Any
    scale: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Of the equations."""
        return (len(self.scale), len(self.scale))

    def solve(self, right: FloatArray) -> FloatArray:
        """Solutions of right sides (p,) or (p, q)."""
        by = self.scale if right.ndim == 1 else self.scale[:, None]
        if isinstance(self.lu, tuple):
            found = np.asarray(by * _kernels.back(*self.lu, (by * right).reshape(len(right), -1)).reshape(right.shape))
        else:
            found = np.asarray(by * self.lu.solve(by * right))
        if not np.isfinite(found).all():
            raise EstimationError(_UNDETERMINED)
        return found


def factored(kkt: Any, unknowns: int) -> Factored:
    """Factor equations of so many unknowns and then conditions.

    Raises
    ------
    EstimationError
        They have no unique solution.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    scale = np.ones(kkt.shape[0])
    scale[:unknowns] = np.minimum(np.maximum(kkt.diagonal()[:unknowns], 1e-30) ** -0.5, 1.0)
    if isinstance(kkt, np.ndarray):
        scale[unknowns:] = 1.0 / np.maximum(np.abs(kkt[unknowns:, :unknowns] * scale[:unknowns]).max(axis=1), 1e-30)
        scaled = scale[:, None] * kkt * scale
        pivot, regular = _kernels.decompose(scaled)
        if not regular or not np.isfinite(scaled).all():
            raise EstimationError(_UNDETERMINED)
        return Factored((scaled, pivot), scale)
    size = np.abs(kkt[unknowns:, :unknowns] @ sparse.diags_array(scale[:unknowns])).max(axis=1).toarray().ravel()
    scale[unknowns:] = 1.0 / np.maximum(size, 1e-30)
    by = sparse.diags_array(scale)
    try:
        return Factored(splu((by @ kkt @ by).tocsc()), scale)
    except RuntimeError as error:
        raise EstimationError(_UNDETERMINED) from error


def _step_of(
    equations: Callable[..., tuple[Any, Any, FloatArray]],
    held: NDArray[np.bool_] | None,
    damping: float,
    count: int,
    length: FloatArray,
) -> tuple[FloatArray, float, float, Factored]:
    """Unknowns' step (count,), the damping it took, by how much it promises to lower the sum of squares, and its equations.

    Lengths that would change by too much, or become none, change by what they may; equations without a solution are damped until
    they have one.
    """
    m = len(length)
    least = np.minimum(np.maximum(-_STRIDE * np.maximum(length, 0.5), _LEAST_LENGTH - length), 0.0)
    most = _STRIDE * np.maximum(length, 0.5)
    for _ in range(7):
        stays = np.zeros(m + (count - _OWN * m), bool) if held is None else held.copy()
        change = np.zeros(len(stays))
        try:
            for _ in range(4):
                design, kkt, rhs = equations(damping=damping, held=stays, change=change)
                solver = factored(kkt, design.shape[1])
                step = solver.solve(rhs)[: design.shape[1]]
                wanted = step[_OWN - 1 : _OWN * m : _OWN]
                over = (wanted < least - 1e-6) | (wanted > most + 1e-6)
                over[-1] = False
                over &= ~stays[:m]
                if not over.any():
                    break
                stays[:m] |= over
                change[:m] = np.where(over, np.clip(wanted, least, most), change[:m])
        except EstimationError:
            damping = max(damping * 100.0, 1e-4)
        else:
            gain = design @ step
            promised = float(2.0 * (rhs[: len(step)] @ step) - gain @ gain)
            return step, damping, abs(promised), solver
    raise EstimationError("the elements are not determined by the points; fewer elements would do")


def _stepped(chain: Chain, step: FloatArray, last: float | None) -> Chain:
    """The chain after a step; the last element ends where the last foot is."""
    m = len(chain.kind)
    own = step[: _OWN * m].reshape(m, _OWN)
    new = np.maximum(chain.length + np.append(own[:-1, 3], 0.0), _LEAST_LENGTH)
    if last is not None:
        new[-1] = max(last, _LEAST_LENGTH)
    return replace(
        chain, length=new, start=chain.start + own[:, :3], bend=chain.bend + step[_OWN * m : _OWN * m + len(chain.bend)]
    )


def _closed(chain: Chain, solver: Factored, count: int, waves: int) -> Chain:
    """The chain with what elements miss each other by after a step taken away, at least cost to the points."""
    m = len(chain.kind)
    if m < 2:
        return chain
    nowhere = np.empty(0, np.int64), np.empty(0)
    state = _lay(chain, *nowhere)
    for _ in range(2):
        right = np.zeros(solver.shape[0])
        right[count + waves : count + waves + 3 * (m - 1)] = (chain.start[1:] - state[2][:-1, :3]).ravel()
        try:
            step = solver.solve(right)[:count]
        except EstimationError:
            return chain
        own = step[: _OWN * m].reshape(m, _OWN)
        most = 0.2 * _STRIDE * np.maximum(chain.length, 0.5)
        change = np.append(own[:-1, 3], 0.0)
        if (np.abs(change) > most).any():
            return chain  # too far for this
        length = np.maximum(chain.length + change, _LEAST_LENGTH)
        nearer = replace(chain, length=length, start=chain.start + own[:, :3], bend=chain.bend + step[_OWN * m :])
        again = _lay(nearer, *nowhere)
        if not _apart(nearer, again) < 0.5 * _apart(chain, state):
            return chain
        chain, state = nearer, again
    return chain


def _apart(chain: Chain, state: tuple[FloatArray, ...]) -> float:
    """By how much elements miss each other at most, m; directions over `_ARM`."""
    miss = np.abs(chain.start[1:] - state[2][:-1, :3])
    return float(max(miss[:, :2].max(initial=0.0), _ARM * miss[:, 2].max(initial=0.0)))
