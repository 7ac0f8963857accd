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
from railnav.monitoring.fitting.segmentation import ARC, STRAIGHT, Pieces
from railnav.track import elements
from railnav.track.elements import Plan

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Residuals beyond this many sigmas weigh less.
ROBUST = 3.5
#: Unknowns of an element: easting, northing, bearing of its start, its length.
_OWN = 4
_MOST_STEPS = 40
#: Lengths settle within this, m.
_SETTLED = 2e-4
#: How far elements may miss each other on the way, sigmas of the points, and the length over which a miss of direction counts, m.
_APART, _ARM = 2.0, 20.0
#: Share of what points tell that every unknown is held with.
_TRACE = np.array([1e-10, 1e-10, 1e-10, 1e-9])
#: No track bends more than this, 1/m.
_SHARPEST = 0.2
#: A length changes by no more than this share in a step.
_STRIDE = 0.5


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
    cost : float
        Weighted sum of squares.
    settled : bool
        Whether the steps came to rest.
    design : sparse array (n, p)
        d(residual)/d(unknowns), whitened.
    factor : SuperLU
        Of the normal equations with their conditions.
    sigma : (n,) array
        Sigmas of the points, as used, m.
    """

    chain: Chain
    residual: FloatArray
    along: FloatArray
    weight: FloatArray
    cost: float
    settled: bool
    design: object
    factor: object
    sigma: FloatArray


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
    sigma: FloatArray,
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
    sigma : (n,) array
        Of the points across the track, m.
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
    robust = np.ones(len(x))
    state = _lay(chain, owner, s)
    for _ in range(3):
        owner, s = _feet(chain, owner, s, x, y, state)
        state = _lay(chain, owner, s)
    damping, merit = 1e-5, _merit(chain, x, y, sigma, state)
    for count in range(steps):
        given = partial(_equations, chain, owner, s, x, y, sigma, robust, state)
        count_of = _OWN * m + len(chain.bend)
        step, damping = _step_of(given, held, damping, count_of, chain.length)
        end = s[-1] if owner[-1] == m - 1 else None
        for _ in range(7):  # a step that leads away is taken again, shorter
            trial, moved = _stepped(chain, step, end)
            if not _lawful(trial, reach):
                damping = max(damping * 10.0, 1e-4)
                step, damping = _step_of(given, held, damping, count_of, chain.length)
                trial, moved = chain, 0.0
                trial_owner, trial_s, trial_state, trial_merit = owner, s, state, merit
                continue
            trial_owner, trial_s = _refooted(chain, trial, owner, s)
            trial_state = _lay(trial, trial_owner, trial_s)
            trial_owner, trial_s = _feet(trial, trial_owner, trial_s, x, y, trial_state)
            trial_state = _lay(trial, trial_owner, trial_s)
            trial_merit = _merit(trial, x, y, sigma, trial_state)
            if trial_merit <= merit * (1.0 + 1e-9) + 1e-6 or count == 0:
                damping = max(damping * 0.2, 1e-9)
                break
            damping = max(damping * 10.0, 1e-4)
            step, damping = _step_of(given, held, damping, count_of, chain.length)
        gained = merit - trial_merit
        chain, owner, s, state, merit = trial, trial_owner, trial_s, trial_state, trial_merit
        residual = _across(x, y, state)
        ratio = np.abs(residual) / sigma
        robust = np.where(ratio > ROBUST, ROBUST / np.maximum(ratio, ROBUST), 1.0)
        if count > 1 and (moved < _SETTLED or abs(gained) < 1e-5 * max(merit, 1.0)):
            settled = True
            break
    for _ in range(3):
        owner, s = _feet(chain, owner, s, x, y, state)
        state = _lay(chain, owner, s)
    residual, rows, kkt, _ = _equations(chain, owner, s, x, y, sigma, robust, state, 0.0, held)
    cost = float(np.sum(robust * (residual / sigma) ** 2))
    along = chain.edges[owner] + s
    start = chain.start.copy()
    start[:, :2] += origin
    return PlanFit(replace(chain, start=start), residual, along, robust, cost, settled, rows, _factor(kkt), sigma)


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
    state: tuple[FloatArray, ...],
    damping: float = 0.0,
    held: NDArray[np.bool_] | None = None,
    change: FloatArray | None = None,
) -> tuple[FloatArray, object, object, FloatArray]:
    """Residuals, whitened design, and the normal equations with their conditions, eq (10)."""
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
    design = sparse.csr_array(
        (
            np.concatenate([(-b * weight)[k] for b, k in zip(by, keep, strict=True)]),
            (
                np.concatenate([row[k] for k in keep]),
                np.concatenate([column[k] for column, k in zip(columns, keep, strict=True)]),
            ),
        ),
        shape=(n, p),
    )
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
    conditions = sparse.csr_array(
        (np.concatenate(data), (np.concatenate(rows), np.concatenate(cols))), shape=(3 * (m - 1) + 2 + len(stay), p)
    )
    normal = design.T @ design
    scale = _damping(chain, normal.diagonal()) + damping * normal.diagonal()
    kkt = sparse.block_array([[normal + sparse.diags_array(scale), conditions.T], [conditions, None]], format="csc")
    rhs = np.concatenate([-(design.T @ (weight * residual)), rest])
    return residual, design, kkt, rhs


def _lawful(chain: Chain, reach: float) -> bool:
    """Whether a step has led to elements that there can be."""
    finite = np.isfinite(chain.start).all() and np.isfinite(chain.length).all() and np.isfinite(chain.bend).all()
    return bool(finite and chain.length.sum() < reach and np.abs(chain.bend).max(initial=0.0) < _SHARPEST)


def _across(x: FloatArray, y: FloatArray, state: tuple[FloatArray, ...]) -> FloatArray:
    """Distances of points from the axis at their feet, positive to the right."""
    here = state[0]
    return np.asarray((x - here[:, 0]) * np.cos(here[:, 2]) - (y - here[:, 1]) * np.sin(here[:, 2]))


def _merit(chain: Chain, x: FloatArray, y: FloatArray, sigma: FloatArray, state: tuple[FloatArray, ...]) -> float:
    """What a step must not raise: Huber's sum over the points, and how far elements miss each other."""
    ratio = np.abs(_across(x, y, state)) / sigma
    points = np.where(ratio > ROBUST, ROBUST * (2.0 * ratio - ROBUST), ratio**2).sum()
    ends = state[2]
    miss = chain.start[1:] - ends[:-1, :3]
    allowed = _APART * float(np.median(sigma))
    apart = (miss[:, 0] ** 2 + miss[:, 1] ** 2).sum() / allowed**2
    apart += (miss[:, 2] ** 2).sum() / (allowed / _ARM) ** 2
    return float(points + apart)


def _refooted(chain: Chain, trial: Chain, owner: IntArray, s: FloatArray) -> tuple[IntArray, FloatArray]:
    """Feet kept where they were along the axis when lengths change."""
    edges = trial.edges
    total = chain.edges[owner] + s
    found = np.clip(np.searchsorted(edges, total, side="right") - 1, 0, len(edges) - 2).astype(np.int64)
    return found, total - edges[found]


def _damping(chain: Chain, diagonal: FloatArray) -> FloatArray:
    """A trace of weight on every unknown, so that what the points do not tell stays put: 1e-9 of what they tell of their kind."""
    m = len(chain.kind)
    scale = np.zeros(len(diagonal))
    own = diagonal[: _OWN * m].reshape(m, _OWN)
    told = np.maximum(own.max(axis=0), 1e-30)
    scale[: _OWN * m] = np.tile(_TRACE * told, m)
    bends = diagonal[_OWN * m :]
    if len(bends):
        scale[_OWN * m :] = 1e-12 * max(float(bends.max()), 1e-30)
    return scale


def _factor(kkt: object) -> object:
    from scipy.sparse.linalg import splu

    try:
        return splu(kkt)
    except RuntimeError as error:
        raise EstimationError(
            "the elements are not determined by the points; fewer elements, or points further along, would do"
        ) from error


def _step_of(
    equations: Callable[..., tuple[Any, Any, Any, FloatArray]],
    held: NDArray[np.bool_] | None,
    damping: float,
    count: int,
    length: FloatArray,
) -> tuple[FloatArray, float]:
    """Unknowns' step (count,) and the damping it took: equations without a solution are damped until they have one."""
    m = len(length)
    bound = _STRIDE * np.maximum(length, 0.5)
    for _ in range(6):
        _, _, kkt, rhs = equations(damping=damping, held=held)
        try:
            step = _solve(kkt, rhs)[:count]
            stays = np.zeros(m + (count - _OWN * m), bool) if held is None else held.copy()
            change = np.zeros(len(stays))
            for _ in range(3):  # lengths that would change too much change by what they may
                wanted = step[_OWN - 1 : _OWN * m : _OWN]
                over = np.append((np.abs(wanted) > 1.0001 * bound)[:-1], False) & ~stays[:m]
                if not over.any():
                    break
                stays[:m] |= over
                change[:m] = np.where(over, np.copysign(bound, wanted), change[:m])
                _, _, kkt, rhs = equations(damping=damping, held=stays, change=change)
                step = _solve(kkt, rhs)[:count]
        except EstimationError:
            damping = max(damping * 100.0, 1e-6)
        else:
            return step, damping
    raise EstimationError("the elements are not determined by the points; fewer elements would do")


def _solve(kkt: object, rhs: FloatArray) -> FloatArray:
    solution: FloatArray = _factor(kkt).solve(rhs)  # type: ignore[attr-defined]
    if not np.isfinite(solution).all():
        raise EstimationError("the elements are not determined by the points")
    return solution


def _stepped(chain: Chain, step: FloatArray, last: float | None) -> tuple[Chain, float]:
    """The chain after a step, lengths bounded, and the largest change of a length."""
    m = len(chain.kind)
    own = step[: _OWN * m].reshape(m, _OWN)
    change = own[:, 3].copy()
    change[-1] = 0.0
    bound = _STRIDE * np.maximum(chain.length, 0.5)
    share = min(1.0, float(np.min(bound / np.maximum(np.abs(change), 1e-30))))
    share = max(share, 0.05)
    new = np.maximum(chain.length + share * change, 0.02)
    if last is not None:
        new[-1] = max(last, 0.02)
    start = chain.start + share * own[:, :3]
    moved = float(np.abs(new - chain.length)[:-1].max(initial=0.0))
    moved = max(moved, float(np.abs(own[:, :2]).max()))
    return replace(chain, length=new, start=start, bend=chain.bend + share * step[_OWN * m :]), moved
