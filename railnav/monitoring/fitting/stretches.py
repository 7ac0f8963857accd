"""Profile and cant fitted to measured values: grades and vertical curves, levels and ramps, by station.

Pieces are polynomials of their own start; that value (and slope) pass on from one to the next is a condition, the places where they
meet are unknowns like the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError
from railnav.monitoring.fitting.plan import ROBUST
from railnav.monitoring.fitting.segmentation import Pieces

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_MOST_STEPS = 30
_SETTLED = 1e-4
#: How often a step is taken again, shorter.
_HALVED = 7
#: A place moves by no more than this share of the shorter piece beside it in a step.
_STRIDE = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """Pieces of a profile (two states: height, slope) or of cant (one state): arrays (m, ...).

    Attributes
    ----------
    begin : (m,) array
        Where they begin, m.
    end : float
        Where the last one ends, m.
    state : (m, k) array
        Value, and for a profile slope, at their begins.
    top : (m,) array
        What the highest state changes by per metre; 0 where `bent` is False.
    bent : (m,) bool array
        Whether it changes at all.
    order : (m,) int array
        States that pass on from the piece before: all k, or fewer at a kink.
    """

    begin: FloatArray
    end: float
    state: FloatArray
    top: FloatArray
    bent: NDArray[np.bool_]
    order: IntArray

    @property
    def length(self) -> FloatArray:
        """Lengths of the pieces, m."""
        return np.diff(np.append(self.begin, self.end))

    def at(self, where: FloatArray, derivative: int = 0) -> FloatArray:
        """Value or a derivative at places."""
        owner = np.clip(np.searchsorted(self.begin, where, side="right") - 1, 0, len(self.begin) - 1)
        return _value(self, owner, where - self.begin[owner], derivative)


@dataclass(frozen=True, slots=True, eq=False)
class StretchesFit:
    """Fitted pieces, their residuals, m, robust weights, sum of squares, whitened design and factored equations."""

    stretches: Stretches
    residual: FloatArray
    weight: FloatArray
    cost: float
    settled: bool
    design: Any
    factor: Any


def stretches_of_pieces(pieces: Pieces, along: FloatArray, values: FloatArray, states: int) -> Stretches:
    """First pieces by least squares of each on its own values."""
    begin = along[pieces.begin]
    end = float(along[-1])
    stop = np.append(pieces.begin[1:], len(along) - 1) + 1
    count = len(begin)
    state, top = np.zeros((count, states)), np.zeros(count)
    bent = pieces.live > states
    for j in range(count):
        rows = slice(int(pieces.begin[j]), int(stop[j]))
        x = along[rows] - begin[j]
        degree = min(states - 1 + int(bent[j]), len(x) - 1)
        scale = max(float(x[-1]), 1e-9)
        powers = np.vander(x / scale, degree + 1, increasing=True)
        fit = np.linalg.lstsq(powers, values[rows], rcond=None)[0]
        for k in range(min(states, len(fit))):
            state[j, k] = fit[k] / scale**k
        if bent[j] and len(fit) > states:
            top[j] = fit[states] / scale**states * (2.0 if states == 2 else 1.0)
    order = np.where(np.arange(count) == 0, 0, np.minimum(pieces.order, states))
    return Stretches(begin, end, state, top, bent, order)


def fit_stretches(
    stretches: Stretches, along: FloatArray, values: FloatArray, sigma: FloatArray, *, steps: int = _MOST_STEPS
) -> StretchesFit:
    """Adjust all pieces to values (n,) at places `along` (n,) with `sigma` (n,)."""
    base = float(values[0])
    y = values - base
    state = stretches.state.copy()
    state[:, 0] -= base
    stretches = replace(stretches, state=state)
    robust = np.ones(len(y))
    settled = False
    stretches, robust, cost = _filled(stretches, along, y, sigma, robust)
    for count in range(steps):
        solution = _solved(stretches, along, y, sigma, robust)
        share = 1.0
        for _ in range(_HALVED):  # places that lead away are moved less
            trial, moved = _stepped(stretches, share * solution)
            trial, trial_robust, trial_cost = _filled(trial, along, y, sigma, robust)
            if trial_cost <= cost * (1.0 + 1e-9) + 1e-3:
                break
            share *= 0.4
        else:
            settled = True  # nothing better nearby
            break
        stretches, robust, cost = trial, trial_robust, trial_cost
        if moved < _SETTLED and count > 2:
            settled = True
            break
    residual, design, kkt, _ = _equations(stretches, along, y, sigma, robust)
    state = stretches.state.copy()
    state[:, 0] += base
    cost = float(np.sum(robust * (residual / sigma) ** 2))
    return StretchesFit(replace(stretches, state=state), residual, robust, cost, settled, design, _factor(kkt))


def unknowns(stretches: Stretches) -> int:
    """How many unknowns the pieces have: states, begin, top of each."""
    return int((stretches.state.shape[1] + 2) * len(stretches.begin))


# --- within -----------------------------------------------------------------------------------------------------------


def _filled(
    stretches: Stretches, along: FloatArray, y: FloatArray, sigma: FloatArray, robust: FloatArray
) -> tuple[Stretches, FloatArray, float]:
    """The best values of pieces whose places stay, robust weights, and Huber's sum."""
    m, k = stretches.state.shape
    for _ in range(2):
        solution = _solved(stretches, along, y, sigma, robust, stay=True)
        own = solution[: (k + 2) * m].reshape(m, k + 2)
        top = stretches.top + np.where(stretches.bent, own[:, k + 1], 0.0)
        stretches = replace(stretches, state=stretches.state + own[:, :k], top=top)
        owner, x = _owners(stretches, along)
        ratio = np.abs(y - _value(stretches, owner, x, 0)) / sigma
        robust = np.where(ratio > ROBUST, ROBUST / np.maximum(ratio, ROBUST), 1.0)
    square = np.where(ratio > ROBUST, ROBUST * (2.0 * ratio - ROBUST), ratio**2)
    return stretches, robust, float(square.sum())


def _owners(stretches: Stretches, along: FloatArray) -> tuple[IntArray, FloatArray]:
    owner = np.clip(np.searchsorted(stretches.begin, along, side="right") - 1, 0, len(stretches.begin) - 1)
    return owner, along - stretches.begin[owner]


def _value(stretches: Stretches, owner: IntArray, x: FloatArray, derivative: int) -> FloatArray:
    columns = [stretches.state[:, k] for k in range(stretches.state.shape[1])]
    columns.append(np.where(stretches.bent, stretches.top, 0.0))
    out, term = np.zeros(len(x)), np.ones(len(x))
    for k in range(derivative, len(columns)):
        out += columns[k][owner] * term
        term = term * x / (k - derivative + 1)
    return out


def _equations(
    stretches: Stretches,
    along: FloatArray,
    y: FloatArray,
    sigma: FloatArray,
    robust: FloatArray,
    damping: float = 0.0,
    stay: bool = False,
) -> tuple[FloatArray, Any, Any, FloatArray]:
    from scipy import sparse

    m, k = stretches.state.shape
    per = k + 2  # states, begin, top
    owner, x = _owners(stretches, along)
    residual = y - _value(stretches, owner, x, 0)
    weight = np.sqrt(robust) / sigma
    n = len(y)
    row = np.arange(n)
    powers = [np.ones(n)]
    for p in range(1, k + 1):
        powers.append(powers[-1] * x / p)
    columns = [per * owner + p for p in range(k)] + [per * owner + k, per * owner + k + 1]
    slopes = [-powers[p] for p in range(k)] + [_value(stretches, owner, x, 1), -powers[k]]
    keep = [np.ones(n, bool)] * k + [owner > 0, stretches.bent[owner]]
    design = sparse.csr_array(
        (
            np.concatenate([(b * weight)[u] for b, u in zip(slopes, keep, strict=True)]),
            (
                np.concatenate([row[u] for u in keep]),
                np.concatenate([c[u] for c, u in zip(columns, keep, strict=True)]),
            ),
        ),
        shape=(n, per * m),
    )
    rows: list[int] = []
    cols: list[int] = []
    data: list[float] = []
    rest: list[float] = []
    length = stretches.length
    each = np.arange(m)
    passed = [_value(stretches, each, length, d) for d in range(k + 1)]

    def put(row_: int, column: int, value: float) -> None:
        rows.append(row_)
        cols.append(column)
        data.append(value)

    for j in range(1, m):
        for p in range(int(stretches.order[j])):
            r = len(rest)
            i = j - 1
            term = 1.0
            for q in range(p, k):
                put(r, per * i + q, term)
                term *= length[i] / (q - p + 1)
            if stretches.bent[i]:
                put(r, per * i + k + 1, term)
            put(r, per * j + p, -1.0)
            gain = float(passed[p + 1][i])
            put(r, per * j + k, gain)
            if i > 0:
                put(r, per * i + k, -gain)
            rest.append(float(stretches.state[j, p] - passed[p][i]))
    for j in range(m if stay else 1):  # the first begin stays in any case
        put(len(rest), per * j + k, 1.0)
        rest.append(0.0)
    for j in np.flatnonzero(~stretches.bent).tolist():
        put(len(rest), per * j + k + 1, 1.0)
        rest.append(0.0)
    conditions = sparse.csr_array((data, (rows, cols)), shape=(len(rest), per * m))
    normal = design.T @ design
    diagonal = normal.diagonal().reshape(m, per)
    trace = np.tile(np.maximum(diagonal.max(axis=0), 1e-30) * np.array([*[1e-12] * k, 1e-9, 1e-12]), m)
    trace = trace + damping * np.tile(np.maximum(diagonal.max(axis=0), 1e-30), m)
    kkt = sparse.block_array([[normal + sparse.diags_array(trace), conditions.T], [conditions, None]], format="csc")
    return residual, design, kkt, np.concatenate([-(design.T @ (weight * residual)), rest])


def _solved(
    stretches: Stretches, along: FloatArray, y: FloatArray, sigma: FloatArray, robust: FloatArray, *, stay: bool = False
) -> FloatArray:
    """The step; equations without a solution are damped until they have one."""
    damping = 0.0
    for _ in range(6):
        _, _, kkt, rhs = _equations(stretches, along, y, sigma, robust, damping, stay)
        try:
            solution: FloatArray = _factor(kkt).solve(rhs)
        except EstimationError:
            solution = np.full(1, np.nan)
        if np.isfinite(solution).all():
            return solution
        damping = max(damping * 100.0, 1e-8)
    raise EstimationError("the pieces are not determined by the values; fewer pieces would do")


def _factor(kkt: Any) -> Any:
    from scipy.sparse.linalg import splu

    try:
        return splu(kkt)
    except RuntimeError as error:
        raise EstimationError("the pieces are not determined by the values; fewer pieces would do") from error


def _stepped(stretches: Stretches, solution: FloatArray) -> tuple[Stretches, float]:
    m, k = stretches.state.shape
    own = solution[: (k + 2) * m].reshape(m, k + 2)
    change = own[:, k].copy()
    change[0] = 0.0
    length = stretches.length
    room = np.minimum(length, np.append(np.inf, length[:-1]))
    share = max(min(1.0, float(np.min(_STRIDE * np.maximum(room, 0.2) / np.maximum(np.abs(change), 1e-30)))), 0.02)
    begin = stretches.begin + share * change
    begin = np.minimum(np.maximum.accumulate(begin), stretches.end - 1e-3)
    moved = float(np.abs(share * change).max(initial=0.0)) if share == 1.0 else 1.0
    return (
        replace(
            stretches,
            begin=begin,
            state=stretches.state + share * own[:, :k],
            top=stretches.top + share * np.where(stretches.bent, own[:, k + 1], 0.0),
        ),
        moved,
    )
