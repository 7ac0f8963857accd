"""Targets for lining: the Whittaker smoother, and slews of least size under limits, by linear programming."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import RailnavError, TrackError

FloatArray = NDArray[np.float64]


class InfeasibleError(RailnavError):
    """Limits and fixed points of a lining plan that contradict each other; the message names them."""


@dataclass(frozen=True, slots=True)
class FixedPoint:
    """A place whose correction is prescribed.

    Attributes
    ----------
    name : str
        For messages.
    start, finish : float
        Distance along the section; equal for a single place, m.
    correction : float
        Slew to the right, or lift, m.
    tolerance : float
        The correction may differ by this either way, m.
    """

    name: str
    start: float
    finish: float
    correction: float = 0.0
    tolerance: float = 0.0


def whittaker(values: ArrayLike, step: float, cutoff: float, *, weight: ArrayLike | None = None) -> FloatArray:
    """Whittaker smoother with third differences: least squares between staying and running smoothly.

    Minimises sum w (y - x)^2 + lambda sum (third difference of x)^2, lambda = (cutoff / 2 pi step)^6: a wave of the cut-off length is
    halved, |H| = 1 / (1 + (cutoff / L)^6), zero phase; parabolas (circular curves) pass untouched.

    Parameters
    ----------
    values : (n,) array
        m; NaN is filled in by the smoothness.
    step, cutoff : float
        m.
    weight : (n,) array, optional
        Of each value; 1 by default.

    Returns
    -------
    (n,) array

    References
    ----------
    docs/theory/geometry.md (12); Eilers, Anal. Chem. 75 (2003).

    Examples
    --------
    >>> s = np.arange(0.0, 2000.0)
    >>> wave = np.sin(2 * np.pi * s / 100.0)
    >>> float(np.abs(whittaker(wave, 1.0, 100.0)[500:1500]).max().round(2))
    0.5
    """
    from scipy.linalg import LinAlgError, solveh_banded

    y = np.asarray(values, float)
    n = len(y)
    if n < 8:
        raise TrackError(f"{n} values are too few to smooth")
    if not cutoff > 2.0 * step:
        raise TrackError(f"a cut-off of {cutoff} m is too short for a step of {step} m")
    known = np.isfinite(y)
    if known.sum() < 4:
        raise TrackError(f"{int(known.sum())} of {n} values are known: too few to smooth between")
    w = np.where(known, 1.0 if weight is None else np.asarray(weight, float), 0.0)
    strength = (cutoff / (2.0 * math.pi * step)) ** 6
    stencil = np.array([-1.0, 3.0, -3.0, 1.0])
    band = np.zeros((4, n))
    for i in range(4):
        for j in range(i, 4):
            band[3 - (j - i), j : n - 3 + j] += strength * stencil[i] * stencil[j]
    band[3] += w
    # solved for the change, not for the values: coordinates of hundreds of kilometres would drown it in rounding
    index = np.arange(n, dtype=float)
    first = np.where(known, y, np.interp(index, index[known], y[known]))
    third = first[3:] - 3.0 * first[2:-1] + 3.0 * first[1:-2] - first[:-3]
    pull = np.zeros(n)
    for i in range(4):
        pull[i : n - 3 + i] -= strength * stencil[i] * third
    try:
        return np.asarray(first + solveh_banded(band, pull))
    except LinAlgError as error:
        raise TrackError("too few values are known to smooth between") from error


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a tamping machine may do.

    Attributes
    ----------
    least, most : float
        Correction, m: of slews -most to most; of lifts e.g. 0 to most, for a machine that cannot lower.
    third_difference : float
        Greatest third derivative of what is left of the deviation (of curvature: its rate), 1/m^2.
    ends : bool
        Whether the correction is zero at both ends, so that the work joins the track beyond.
    ramp : float
        Greatest correction over the distance from the nearer end, m/m, where `ends` holds.
    """

    least: float
    most: float
    third_difference: float
    ends: bool = True
    ramp: float = math.inf


def corrections(
    deviation: ArrayLike,
    target: ArrayLike,
    step: float,
    bounds: Bounds,
    *,
    fixed: Sequence[FixedPoint] = (),
    start: float = 0.0,
) -> FloatArray:
    """Corrections that bring a deviation as near to its target as limits allow: a linear programme.

    minimise sum |r - t|, r = y + e, subject to least <= e <= most, |third difference of r| <= J step^3, e within the tolerance of each
    fixed point, e = 0 at the ends. Solved exactly by HiGHS. Along a fixed stretch of four nodes or more the third difference may stay what
    that of y is there: track that is held cannot be smoothed.

    Parameters
    ----------
    deviation : (n,) array
        y: measured minus design (or minus a smooth base), m, at uniform distances.
    target : (n,) array
        t: what it should become, m; zero to reach the design.
    step : float
        m.
    bounds : Bounds
    fixed : sequence of FixedPoint
    start : float
        Distance of the first value, m: that of fixed points counts from the same zero.

    Returns
    -------
    (n,) array
        Corrections e, m.

    Raises
    ------
    InfeasibleError
        No correction satisfies all limits; the message names a smallest set of fixed points that contradict each other, or says that the
        limits do so by themselves, and where.

    References
    ----------
    docs/theory/geometry.md (13).

    Examples
    --------
    >>> bump = 0.02 * np.exp(-(((np.arange(61) - 30.0) / 3.0) ** 2))
    >>> e = corrections(bump, np.zeros(61), 1.0, Bounds(-0.05, 0.05, 1e-4))
    >>> bool(abs(bump + e).max() < 1e-6)
    True
    """
    y, t = np.asarray(deviation, float), np.asarray(target, float)
    n = len(y)
    if n < 8 or y.shape != t.shape or not (np.isfinite(y).all() and np.isfinite(t).all()):
        raise TrackError(f"{y.shape} deviations and {t.shape} targets; two rows of at least 8 finite values are needed")
    low, high = np.full(n, bounds.least), np.full(n, bounds.most)
    if bounds.ends:
        nearest = step * np.minimum(np.arange(n), n - 1 - np.arange(n))
        most = np.where(nearest > 0.0, np.minimum(bounds.ramp, 1e9) * nearest, 0.0)
        low, high = np.clip(low, -most, most), np.clip(high, -most, most)
    spans = [_rows(point, start, step, n) for point in fixed]
    inside = [(point, span) for point, span in zip(fixed, spans, strict=True) if span.stop > span.start]
    lows, highs = low.copy(), high.copy()
    for point, span in inside:
        lows[span] = np.maximum(lows[span], point.correction - point.tolerance)
        highs[span] = np.minimum(highs[span], point.correction + point.tolerance)
    jump = _jumps(y, bounds.third_difference * step**3, inside)
    solved = _solve(y, t, lows, highs, jump) if (lows <= highs + 1e-12).all() else None
    if solved is not None:
        return np.clip(solved, lows, np.maximum(lows, highs))
    raise InfeasibleError(_why(y, step, start, low, high, bounds, inside))


def _rows(point: FixedPoint, start: float, step: float, n: int) -> slice:
    """Rows that a fixed point holds: at least the nearest one where it lies on the section."""
    first, last = (point.start - start) / step, (point.finish - start) / step
    if last < -0.5 or first > n - 0.5:
        return slice(0, 0)
    a, b = math.ceil(first - 1e-9), math.floor(last + 1e-9)
    if b < a:
        a = b = round(0.5 * (first + last))
    return slice(max(a, 0), min(b, n - 1) + 1)


def _jumps(y: FloatArray, jump: float, inside: Sequence[tuple[FixedPoint, slice]]) -> FloatArray:
    """Bound of each third difference: where a stretch is held, track that may not be moved may stay as rough as it is there."""
    bound = np.full(len(y) - 3, jump)
    rough = np.abs(np.diff(y, 3))
    for _, span in inside:
        if span.stop - span.start > 3:
            rows = slice(max(span.start - 3, 0), min(span.stop, len(bound)))
            bound[rows] = np.maximum(bound[rows], rough[rows].max(initial=0.0))
    return bound


def _differences(n: int) -> Any:
    from scipy.sparse import diags_array

    return diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(n - 3, n), format="csr")


def _solve(y: FloatArray, t: FloatArray, low: FloatArray, high: FloatArray, jump: FloatArray) -> FloatArray | None:
    """The programme in millimetres: r = t + p - q with p, q >= 0; None where it has no solution."""
    from scipy.optimize import linprog
    from scipy.sparse import hstack, vstack

    n = len(y)
    scale = 1e3
    D = _differences(n)
    # e = r - y, so that p - q = e + y - t lies between low + y - t and high + y - t
    least, most = scale * (low + y - t), scale * (high + y - t)
    over, under = np.maximum(most, 0.0), np.maximum(-least, 0.0)
    cost = np.ones(2 * n)
    both = hstack([D, -D])
    shape = scale * np.asarray(D @ t)
    bound = scale * jump
    answer = linprog(
        cost,
        A_ub=vstack([both, -both]),
        b_ub=np.concatenate([bound - shape, bound + shape]),
        bounds=np.column_stack(
            [np.concatenate([np.maximum(least, 0.0), np.maximum(-most, 0.0)]), np.concatenate([over, under])]
        ),
        method="highs",
    )
    if answer.status == 2:
        return None
    if answer.status != 0:
        raise TrackError(f"the linear programme was not solved ({answer.message})")
    return np.asarray((answer.x[:n] - answer.x[n:]) / scale + t - y)


def feasible(y: FloatArray, low: FloatArray, high: FloatArray, jump: float | FloatArray) -> bool:
    """Whether corrections within low and high leave third differences of y + e within a bound."""
    from scipy.optimize import linprog
    from scipy.sparse import vstack

    if (low > high + 1e-12).any():
        return False
    n, scale = len(y), 1e3
    D = _differences(n)
    shape = scale * np.asarray(D @ y)
    answer = linprog(
        np.zeros(n),
        A_ub=vstack([D, -D]),
        b_ub=np.concatenate([scale * jump - shape, scale * jump + shape]),
        bounds=np.column_stack([scale * low, scale * np.maximum(high, low)]),
        method="highs",
    )
    return bool(answer.status == 0)


def _unramped(bounds: Bounds, n: int) -> tuple[FloatArray, FloatArray]:
    """Least and most correction without the ramps: only the ends stay."""
    inside = (np.arange(n) > 0) & (np.arange(n) < n - 1) | (not bounds.ends)
    return np.where(inside, bounds.least, 0.0), np.where(inside, bounds.most, 0.0)


def _why(
    y: FloatArray,
    step: float,
    start: float,
    low: FloatArray,
    high: FloatArray,
    bounds: Bounds,
    inside: Sequence[tuple[FixedPoint, slice]],
) -> str:
    """Name a smallest set of fixed points that cannot be met together (deletion filter), or say where the limits alone fail."""
    jump = bounds.third_difference * step**3

    def possible(kept: Sequence[int]) -> bool:
        lows, highs = low.copy(), high.copy()
        for k in kept:
            point, span = inside[k]
            lows[span] = np.maximum(lows[span], point.correction - point.tolerance)
            highs[span] = np.minimum(highs[span], point.correction + point.tolerance)
        return feasible(y, lows, highs, _jumps(y, jump, [inside[k] for k in kept]))

    if not possible([]):
        window = max(16, round(200.0 / step))
        for a in range(0, max(len(y) - window, 1), max(window // 2, 1)):
            part = slice(a, min(a + window, len(y)))
            if not feasible(y[part], low[part], high[part], jump):
                where = f"between {start + a * step:.0f} and {start + (part.stop - 1) * step:.0f} m"
                break
        else:
            where = "over the whole section"
        if math.isfinite(bounds.ramp) and feasible(y, *_unramped(bounds, len(y)), jump):
            return (
                f"corrections that begin and fade out at {1e3 * bounds.ramp:g} mm a metre at most leave a curvature rate of more than "
                f"{bounds.third_difference:.1e} 1/m^2 {where}; allow a steeper ramp, or line farther"
            )
        return (
            f"no correction between {1e3 * bounds.least:+.4g} and {1e3 * bounds.most:+.4g} mm leaves a curvature rate of at most "
            f"{bounds.third_difference:.1e} 1/m^2 {where}, even without fixed points; allow more of either"
        )
    kept = list(range(len(inside)))
    kept.sort(key=lambda k: inside[k][0].start)
    for k in list(kept):
        rest = [other for other in kept if other != k]
        if rest and not possible(rest):
            kept = rest
    names = []
    for k in kept:
        point = inside[k][0]
        names.append(
            f"{point.name!r} at {point.start:.1f} m ({1e3 * point.correction:+.1f} +- {1e3 * point.tolerance:.1f} mm)"
        )
    if len(names) == 1:
        return f"fixed point {names[0]} cannot be met under the limits of correction and curvature rate; widen its tolerance or them"
    return f"fixed points {', '.join(names[:-1])} and {names[-1]} contradict each other under the limits; widen a tolerance or drop one"
