"""How sure fitted elements are: covariance under the noise that the points have.

The adjustment weighs points as if each erred alone; its covariance is then told with the noise that they have, waves included:
Cov = A J^T T J A, T the covariance of the points (docs/theory/alignment.md, eq 12).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.fitting.segmentation import Noise

FloatArray = NDArray[np.float64]

#: Waves further apart than this many lengths are independent.
_REACH = 5.0
#: Combinations of unknowns told at a time.
_CHUNK = 400
#: Most neighbours of a point whose common noise is reckoned.
_NEIGHBOURS = 400


def noise_of_points(design: Any, along: FloatArray, noise: Noise, sigma: FloatArray, weight: FloatArray) -> Any:
    """J^T T J for a whitened design J and points with white and correlated noise, sparse (p, p)."""
    from scipy import sparse

    n = len(along)
    scale = np.sqrt(weight) / sigma  # the design is whitened with this; T is in metres
    white = np.broadcast_to(np.asarray(noise.sigma, np.float64), (n,))
    variance = (white * scale) ** 2
    total = design.T @ sparse.diags_array(variance) @ design
    if noise.correlated > 0.0:
        step = max(float(np.median(np.diff(along))), 1e-6)
        # beyond the reach in samples, take each k-th point for k: the waves are smooth at that distance
        lags = int(np.ceil(_REACH * noise.length / step))
        thin = max(1, lags // _NEIGHBOURS)
        if thin > 1:
            gather = sparse.csr_array((np.ones(n), (np.arange(n) // thin, np.arange(n))))
            pooled, place = gather @ (sparse.diags_array(scale) @ design), along[::thin]
        else:
            pooled, place = sparse.diags_array(scale) @ design, along
        common = _correlation(place, noise)
        total = total + noise.correlated**2 * (pooled.T @ (common @ pooled))
    return total


def _correlation(place: FloatArray, noise: Noise) -> Any:
    """Correlation of waves at places in order, sparse."""
    from scipy import sparse

    n = len(place)
    step = max(float(np.median(np.diff(place))), 1e-9)
    lags = min(n - 1, int(np.ceil(_REACH * noise.length / step)))
    diagonals, offsets = [np.ones(n)], [0]
    for lag in range(1, lags + 1):
        value = noise.correlation(place[lag:] - place[:-lag])
        diagonals += [value, value]
        offsets += [lag, -lag]
    return sparse.diags_array(diagonals, offsets=offsets, format="csr")


def sigmas_of_elements(factor: Any, combinations: FloatArray | Any) -> FloatArray:
    """Standard deviations of combinations (q, p) of unknowns of equations that weigh points by their whole noise."""
    from scipy import sparse

    rows = sparse.csr_array(combinations)
    out = np.empty(rows.shape[0])
    for begin in range(0, rows.shape[0], _CHUNK):
        part = rows[begin : begin + _CHUNK].toarray()
        right = np.zeros((factor.shape[0], len(part)))
        right[: part.shape[1]] = part.T
        solved = factor.solve(right)[: part.shape[1]].T
        out[begin : begin + len(part)] = np.sqrt(np.maximum((part * solved).sum(axis=1), 0.0))
    return out


def sigmas(factor: Any, unknowns: int, combinations: FloatArray | Any, middle: Any) -> FloatArray:
    """Standard deviations of combinations (q, p) of unknowns, from the factored equations and J^T T J."""
    from scipy import sparse

    rows = sparse.csr_array(combinations)
    size = factor.shape[0]
    out = np.empty(rows.shape[0])
    for begin in range(0, rows.shape[0], _CHUNK):
        part = rows[begin : begin + _CHUNK].toarray()
        right = np.zeros((size, len(part)))
        right[:unknowns] = part.T
        solved = factor.solve(right)[:unknowns].T
        out[begin : begin + len(part)] = np.sqrt(np.maximum(((middle @ solved.T).T * solved).sum(axis=1), 0.0))
    return out
