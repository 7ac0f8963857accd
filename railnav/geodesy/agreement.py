"""Which points agree: least squares, a robust first guess, and an F test of each point against the fit without it."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Probability that a set of good points loses one to the test.
FALSE_ALARM = 0.01


def least_squares(
    design: FloatArray, observed: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray, float, int]:
    """Solution, cofactor matrix, standard deviation of unit weight (NaN without redundancy), degrees of freedom."""
    live = weight.ravel() > 0.0
    A = (design * weight[:, :, None]).reshape(-1, design.shape[2])[live]
    y = (observed * weight).ravel()[live]
    q, r = np.linalg.qr(A)
    size = np.abs(np.diag(r))
    if len(A) < A.shape[1] or size.min() < 1e-9 * size.max():
        raise np.linalg.LinAlgError
    solution = np.linalg.solve(r, q.T @ y)
    inverse = np.linalg.inv(r)
    freedom = len(A) - A.shape[1]
    misfit = y - A @ solution
    s0 = math.sqrt(float(misfit @ misfit) / freedom) if freedom > 0 else math.nan
    return solution, inverse @ inverse.T, s0, freedom


def agreeing_points(
    design: FloatArray, observed: FloatArray, weight: FloatArray, sigma: float | None
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Which points agree; the F test of each against the fit without it; the smallest error that it would find."""
    n = len(design)
    used = _robust_start(design, observed, weight, sigma)
    ratio = np.full(n, np.nan)
    detectable = np.full(n, np.inf)
    for _ in range(2 * n):
        ratio, detectable = _tests(design, observed, weight, used, sigma)
        judged = np.nan_to_num(ratio, nan=0.0)
        inside, outside = np.where(used, judged, 0.0), np.where(used, np.inf, np.where(np.isnan(ratio), np.inf, ratio))
        if inside.max() > 1.0:
            used[int(np.argmax(inside))] = False
        elif outside.min() <= 1.0:
            used[int(np.argmin(outside))] = True
        else:
            break
    return used, ratio, detectable


def _robust_start(design: FloatArray, observed: FloatArray, weight: FloatArray, sigma: float | None) -> BoolArray:
    """Points that agree with the subset whose median misfit is least (least median of squares)."""
    n, size = len(design), -(-design.shape[2] // 3) if design.shape[2] != 5 else 2
    used = np.ones(n, bool)
    if n < size + 3:  # too few for a majority: every point is tested against all others
        return used
    subsets = list(itertools.islice(itertools.combinations(range(n), size), 301))
    if len(subsets) > 300:
        random = np.random.default_rng(0)
        subsets = [tuple(random.choice(n, size, replace=False)) for _ in range(300)]
    best, least = np.zeros((n, 3)), np.inf
    for subset in subsets:
        try:
            trial, _, _, _ = least_squares(design[list(subset)], observed[list(subset)], weight[list(subset)])
        except np.linalg.LinAlgError:
            continue
        misfit = (observed - design @ trial) * weight
        rest = np.delete(np.sum(misfit**2, axis=1), subset)
        median = float(np.median(rest))
        if median < least:
            best, least = misfit, median
    if not math.isfinite(least):
        return used
    spread = max(1.4826 * math.sqrt(least / 2.0), sigma or 0.0, 1e-9)
    near = np.sqrt(np.sum(best**2, axis=1)) < 6.0 * spread  # generous: the F test decides
    return near if near.sum() >= size + 1 else used


def _tests(
    design: FloatArray, observed: FloatArray, weight: FloatArray, used: BoolArray, sigma: float | None
) -> tuple[FloatArray, FloatArray]:
    """F over its critical value for each point against the fit to the other used ones, and what would be detected, m."""
    from scipy.stats import chi2, f

    n = len(design)
    ratio, detectable = np.full(n, np.nan), np.full(n, np.inf)
    for i in range(n):
        others = used.copy()
        others[i] = False
        try:
            solution, cofactor, s0, freedom = least_squares(design[others], observed[others], weight[others])
        except np.linalg.LinAlgError:
            continue
        scale = s0 if sigma is None else sigma
        if not math.isfinite(scale):
            continue
        scale = max(scale, 1e-6)
        live = weight[i] > 0.0
        p = int(live.sum())
        J = design[i][live]
        covariance = scale**2 * (np.diag(1.0 / weight[i][live] ** 2) + J @ cofactor @ J.T)
        miss = (observed[i] - design[i] @ solution)[live]
        level = 1.0 - FALSE_ALARM / n
        critical = float(chi2.ppf(level, p) / p if sigma is not None else f.ppf(level, p, freedom))
        ratio[i] = float(miss @ np.linalg.solve(covariance, miss)) / p / critical
        # a horizontal error e shifts the statistic by e^2/c; 0.84 sigma more than the threshold is found 4 times in 5
        spread = math.sqrt(max(np.linalg.eigvalsh(covariance[:2, :2])))
        detectable[i] = spread * (math.sqrt(critical * p) + 0.84)
    return ratio, detectable
