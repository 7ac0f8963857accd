"""Gross errors: the chi-square test of a block of rows, the test of its components, and the source's tolerance in metres.

The residuals f of a chain are whitened: dimensionless, of unit variance. The source's tolerance is in metres. The two are never
compared with each other: `block_test` takes sums of f^2, `geometric_test` takes differences in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class BlockTest:
    """Outcome of the chi-square test of blocks of rows.

    Attributes
    ----------
    statistic : (N,) array
        Sum of f^2 of each block.
    limit : (N,) array
        What it may be; infinite for a block without redundant rows, which cannot be tested.
    rejected : (N,) bool array
        Where the limit is passed.
    """

    statistic: FloatArray
    limit: FloatArray
    rejected: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class GeometricTest:
    """Outcome of the source's test of the geometric condition dX_k = X_(k+1) - X_k.

    Attributes
    ----------
    difference : (N, n) array
        X_(k+1) - (X_k + dX_k), measured - predicted, m.
    tolerance : (N, n) or (N,) array
        What its size may be, by component or for the vector's length, m.
    rejected : (N,) bool array
        Where a component, or the length, passes the tolerance.
    """

    difference: FloatArray
    tolerance: FloatArray
    rejected: NDArray[np.bool_]


@lru_cache(maxsize=1024)
def chi_square_limit(dof: int, significance: float) -> float:
    """Value that a chi-square variable passes with a given probability.

    Parameters
    ----------
    dof : int
        Degrees of freedom, at least 1.
    significance : float
        Probability of a false alarm, between 0 and 1.

    Returns
    -------
    float
        The limit.

    Raises
    ------
    EstimationError
        No degrees of freedom, or a probability that is none.

    Examples
    --------
    >>> round(chi_square_limit(3, 1e-4), 2)
    21.11
    """
    if dof < 1 or not 0.0 < significance < 1.0:
        raise EstimationError(
            f"a chi-square limit for {dof} degrees of freedom at {significance} does not exist; dof >= 1 and 0 < p < 1 do"
        )
    from scipy.special import chdtri

    return float(chdtri(dof, significance))


def block_test(nis: ArrayLike, dof: ArrayLike, *, significance: float = 1e-4) -> BlockTest:
    """Test blocks of rows by the sum of their squared whitened residuals, T ~ chi-square with `dof` degrees of freedom.

    Parameters
    ----------
    nis : (N,) array
        Sum of f^2 of each block (`ChainSolution.nis`): dimensionless.
    dof : (N,) array
        Redundant rows of each block.
    significance : float
        Probability of rejecting a good block.

    Returns
    -------
    BlockTest
        Statistic, limit and decision.

    Raises
    ------
    EstimationError
        A statistic is negative or not finite, or shapes differ.

    Notes
    -----
    Which of fix and link is wrong needs later data: a bad fix is normal again at the next epoch, a slip leaves an offset.

    References
    ----------
    Specification rail 6 (b) and 17.

    Examples
    --------
    >>> block_test([2.0, 30.0, 0.0], [3, 3, 0]).rejected
    array([False,  True, False])
    """
    statistic = np.atleast_1d(np.asarray(nis, np.float64))
    freedom = np.atleast_1d(np.asarray(dof, np.int64))
    if statistic.shape != freedom.shape or statistic.ndim != 1:
        raise EstimationError(f"nis has shape {statistic.shape} and dof {freedom.shape}; both are (N,)")
    for k in np.flatnonzero(~(np.isfinite(statistic) & (statistic >= 0)) | (freedom < 0))[:1]:
        raise EstimationError(
            f"block {k} has NIS {statistic[k]} with {freedom[k]} degrees of freedom; sums of squares are >= 0"
        )
    limit = np.full(len(statistic), np.inf)
    for value in np.unique(freedom[freedom > 0]):
        limit[freedom == value] = chi_square_limit(int(value), significance)
    return BlockTest(statistic, limit, statistic > limit)


def component_test(innovation: ArrayLike, S_sqrt: ArrayLike) -> FloatArray:
    """Test each component of an innovation by itself, w_j = (S^-1 nu)_j / sqrt((S^-1)_jj) ~ N(0, 1).

    Parameters
    ----------
    innovation : (m,) array
        Measured - predicted.
    S_sqrt : (m, m) array
        Root of its covariance, lower triangular.

    Returns
    -------
    (m,) array
        w: dimensionless, unit variance; the largest points at the component to look at first.

    Raises
    ------
    EstimationError
        Shapes do not fit, or the root is singular.

    References
    ----------
    Specification rail 15.4.

    Examples
    --------
    >>> component_test([3.0, 1.0], [[1.0, 0.0], [0.0, 2.0]])
    array([3. , 0.5])
    """
    nu, root = np.asarray(innovation, np.float64), np.asarray(S_sqrt, np.float64)
    if nu.ndim != 1 or root.shape != (nu.size, nu.size):
        raise EstimationError(f"innovation has shape {nu.shape} and S_sqrt {root.shape}; (m,) and (m, m) fit")
    if not (np.diagonal(root) > 0).all():
        raise EstimationError("S_sqrt is singular: a perfect measurement; use a sigma of 1e-6 instead of 0")
    inverse = np.linalg.solve(root, np.eye(nu.size))
    return np.asarray(inverse.T @ (inverse @ nu) / np.sqrt((inverse**2).sum(axis=0)))


def geometric_tolerance(
    covariance: ArrayLike, increment_covariance: ArrayLike, *, form: Literal["component", "vector"] = "component"
) -> FloatArray:
    """Tolerance of the geometric condition, metres: f_j = 2 sqrt(K(X_k)_jj + K(dX_k)_jj + K(X_(k+1))_jj).

    Parameters
    ----------
    covariance : (N, n, n) array
        Covariances K(X_k) of the observed positions, m^2.
    increment_covariance : (N - 1, n, n) array
        Covariances K(dX_k) of the increments, m^2.
    form : {"component", "vector"}
        By component, or 2 sqrt(trace) for the length of the vector.

    Returns
    -------
    (N - 1, n) or (N - 1,) array
        Tolerance, m.

    Raises
    ------
    EstimationError
        Shapes do not fit.

    Notes
    -----
    In metres: compare it with `geometric_test`'s difference, never with whitened residuals. It uses K(X_k), not the filtered
    covariance, so it is conservative later in a chain: at sigma 20 mm with increments of 3 mm its factor 2 acts as 2.64. On the
    first triangle it rejects 4.55 % of good components, 13.0 % of good triples, 0.74 % in the vector form. `block_test` is
    the test to prefer.

    References
    ----------
    Specification rail 5, step 4 (restored), and 6.

    Examples
    --------
    >>> geometric_tolerance(4e-4 * np.ones((2, 1, 1)), 9e-6 * np.ones((1, 1, 1))).round(6)
    array([[0.056886]])
    """
    KX, KD = np.asarray(covariance, np.float64), np.asarray(increment_covariance, np.float64)
    if KX.ndim != 3 or KX.shape[1] != KX.shape[2] or KD.shape != (len(KX) - 1, *KX.shape[1:]):
        raise EstimationError(
            f"covariance has shape {KX.shape} and increment_covariance {KD.shape}; (N, n, n), (N - 1, n, n) fit"
        )
    variance = np.einsum("kii->ki", KX[:-1] + KD + KX[1:])
    return np.asarray(2.0 * np.sqrt(variance if form == "component" else variance.sum(axis=1)))


def geometric_test(
    position: ArrayLike,
    covariance: ArrayLike,
    increment: ArrayLike,
    increment_covariance: ArrayLike,
    *,
    estimate: ArrayLike | None = None,
    form: Literal["component", "vector"] = "component",
) -> GeometricTest:
    """Test the geometric condition dX_k = X_(k+1) - X_k of each triangle as the source does, in metres.

    Parameters
    ----------
    position : (N, n) array
        Observed positions, m.
    covariance : (N, n, n) array
        Their covariances, m^2.
    increment : (N - 1, n) array
        Observed increments, m.
    increment_covariance : (N - 1, n, n) array
        Their covariances, m^2.
    estimate : (N, n) array, optional
        Filtered positions to start each triangle from, instead of the observed ones.
    form : {"component", "vector"}
        As in `geometric_tolerance`.

    Returns
    -------
    GeometricTest
        Differences, tolerance and decisions.

    Raises
    ------
    EstimationError
        Shapes do not fit.

    References
    ----------
    Specification rail 5, step 4, and 6 (a).

    Examples
    --------
    >>> K = 1e-4 * np.ones((1, 1, 1))
    >>> geometric_test([[0.0], [1.5]], np.repeat(K, 2, axis=0), [[1.0]], K).rejected
    array([ True])
    """
    X, dX = np.asarray(position, np.float64), np.asarray(increment, np.float64)
    start = X if estimate is None else np.asarray(estimate, np.float64)
    if X.ndim != 2 or dX.shape != (len(X) - 1, X.shape[1]) or start.shape != X.shape:
        raise EstimationError(f"position has shape {X.shape}, increment {dX.shape}; (N, n) and (N - 1, n) fit")
    tolerance = geometric_tolerance(covariance, increment_covariance, form=form)
    if len(tolerance) != len(dX):
        raise EstimationError(f"{len(dX)} increments have {len(tolerance)} covariances")
    difference = X[1:] - (start[:-1] + dX)
    size = np.abs(difference) if form == "component" else np.linalg.norm(difference, axis=1)
    beyond = np.asarray(size >= tolerance)
    return GeometricTest(difference, tolerance, np.asarray(beyond.reshape(len(dX), -1).any(axis=1)))
