"""Does an estimator know how wrong it is? NEES, NIS and coverage with the bounds that chance allows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Consistency:
    """A mean of chi-square statistics, divided by their degrees of freedom, and the interval that chance allows.

    Attributes
    ----------
    ratio : float
        Sum of the statistics over the sum of their degrees of freedom: 1 expected; above, the estimator is too sure.
    lower, upper : float
        Interval that holds the ratio with the stated probability.
    dof : float
        Degrees of freedom in all, after the correction for dependent samples.
    """

    ratio: float
    lower: float
    upper: float
    dof: float

    @property
    def consistent(self) -> bool:
        """Whether the ratio lies inside its bounds."""
        return self.lower <= self.ratio <= self.upper


@dataclass(frozen=True, slots=True)
class Coverage:
    """How often the truth lay within k sigma.

    Attributes
    ----------
    fraction : float
        Observed fraction.
    expected : float
        Fraction of a normal distribution.
    lower, upper : float
        Interval that holds the observed fraction with the stated probability.
    """

    fraction: float
    expected: float
    lower: float
    upper: float

    @property
    def consistent(self) -> bool:
        """Whether the fraction lies inside its bounds."""
        return self.lower <= self.fraction <= self.upper


def nees(error: ArrayLike, covariance: ArrayLike) -> FloatArray:
    """Normalised estimation error squared, e^T P^-1 e, of each estimate.

    Parameters
    ----------
    error : (N, n) array
        Estimate - truth.
    covariance : (N, n, n) or (n, n) array
        What the estimator said.

    Returns
    -------
    (N,) array
        NEES, chi-square with n degrees of freedom if the estimator is honest.

    Raises
    ------
    EstimationError
        Shapes do not fit, an error is not finite, or a covariance is not positive definite.

    Examples
    --------
    >>> nees([[1.0, 2.0]], np.diag([1.0, 4.0]))
    array([2.])
    """
    e = np.asarray(error, np.float64)
    P = np.asarray(covariance, np.float64)
    if e.ndim != 2 or P.shape not in ((e.shape[1],) * 2, (*e.shape, e.shape[1])):
        raise EstimationError(f"error has shape {e.shape} and covariance {P.shape}; (N, n) and (N, n, n) fit")
    for k in np.flatnonzero(~np.isfinite(e).all(axis=1))[:1]:
        raise EstimationError(f"error {k} is not finite; compare only estimates that exist")
    from railnav.estimation.square_root import inverse_root

    W = np.broadcast_to(inverse_root(P), (*e.shape, e.shape[1]))
    return np.asarray((np.einsum("kij,kj->ki", W, e) ** 2).sum(axis=1))


def consistency(
    statistic: ArrayLike, dof: ArrayLike | int, *, probability: float = 0.99, independent: float | None = None
) -> Consistency:
    """Compare NEES or NIS with what chance allows: their sum is chi-square with the sum of the degrees of freedom.

    Parameters
    ----------
    statistic : (N,) array
        NEES or NIS.
    dof : int or (N,) array
        Degrees of freedom of each; those of none are left out.
    probability : float
        Probability that an honest estimator lies inside the bounds.
    independent : float, optional
        Number of independent samples among them, if fewer than all: smoothed errors of neighbours are alike, and the NEES of K
        runs of one chain holds little more than K samples. Innovations are independent.

    Returns
    -------
    Consistency
        Ratio and bounds.

    Raises
    ------
    EstimationError
        Nothing to judge, a statistic that is negative or not finite, or a probability that is none.

    Examples
    --------
    >>> honest = consistency([2.5, 3.5, 3.0, 3.2], 3)
    >>> round(honest.ratio, 3), honest.consistent
    (1.017, True)
    """
    values = np.atleast_1d(np.asarray(statistic, np.float64))
    freedom = np.broadcast_to(np.asarray(dof, np.int64), values.shape)
    for k in np.flatnonzero(~(np.isfinite(values) & (values >= 0)))[:1]:
        raise EstimationError(f"statistic {k} is {values[k]}; sums of squares are finite and >= 0")
    values, freedom = values[freedom > 0], freedom[freedom > 0]
    if len(values) == 0:
        raise EstimationError("no statistic has degrees of freedom: nothing to judge")
    low, high = _tails(probability)
    total = float(freedom.sum())
    effective = total if independent is None else total * min(independent / len(values), 1.0)
    if not effective > 0:
        raise EstimationError(f"{independent} independent samples cannot be judged; at least one is needed")
    from scipy.special import chdtri

    return Consistency(
        ratio=float(values.sum() / total),
        lower=float(chdtri(effective, high) / effective),
        upper=float(chdtri(effective, low) / effective),
        dof=effective,
    )


def coverage(
    error: ArrayLike, sigma: ArrayLike, *, k: float = 2.0, probability: float = 0.99, independent: float | None = None
) -> Coverage:
    """Fraction of errors within k sigma, beside the normal distribution's.

    Parameters
    ----------
    error : (N,) array
        Estimate - truth.
    sigma : (N,) array
        What the estimator said.
    k : float
        Factor.
    probability : float
        Probability that an honest estimator lies inside the bounds.
    independent : float, optional
        Number of independent samples among them, if fewer than all.

    Returns
    -------
    Coverage
        Observed and expected fraction with bounds (binomial).

    Raises
    ------
    EstimationError
        Nothing to judge, shapes differ, a sigma is not positive, or a value is not finite.

    Examples
    --------
    >>> coverage([0.1, -0.5, 0.9, 1.5], [1.0, 1.0, 1.0, 1.0], k=1.0).fraction
    0.75
    """
    e, s = np.atleast_1d(np.asarray(error, np.float64)), np.atleast_1d(np.asarray(sigma, np.float64))
    if e.shape != s.shape or e.ndim != 1 or len(e) == 0:
        raise EstimationError(f"error has shape {e.shape} and sigma {s.shape}; both are (N,), N > 0")
    for i in np.flatnonzero(~(np.isfinite(e) & np.isfinite(s) & (s > 0)))[:1]:
        raise EstimationError(
            f"row {i} has error {e[i]} and sigma {s[i]}; finite errors and positive sigmas can be compared"
        )
    low, high = _tails(probability)
    from scipy.special import erf
    from scipy.stats import binom

    expected = float(erf(k / np.sqrt(2.0)))
    count = max(int(len(e) if independent is None else min(independent, len(e))), 1)
    return Coverage(
        fraction=float((np.abs(e) <= k * s).mean()),
        expected=expected,
        lower=float(binom.ppf(low, count, expected)) / count,
        upper=float(binom.ppf(high, count, expected)) / count,
    )


def _tails(probability: float) -> tuple[float, float]:
    if not 0.0 < probability < 1.0:
        raise EstimationError(f"probability {probability} is none; 0 < p < 1 is")
    return (1.0 - probability) / 2.0, (1.0 + probability) / 2.0
