"""How far off the train can be at a stated risk."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from railnav.navigation.integrity._kernels import mixture_bound

__all__ = ["normal_quantile", "protection_level"]


def normal_quantile(risk: float) -> float:
    """Two-sided normal quantile: k with 2 Q(k) = risk.

    Examples
    --------
    >>> round(normal_quantile(1e-7), 4)
    5.3267
    """
    return NormalDist().inv_cdf(1.0 - 0.5 * risk)


def protection_level(weight: ArrayLike, mean: ArrayLike, sigma: ArrayLike, *, integrity_risk: float) -> float:
    """Bound on the error of an estimate at 0 when the truth is a mixture of normal hypotheses.

    The smallest L with sum_j w_j [Q((L - mu_j) / sigma_j) + Q((L + mu_j) / sigma_j)] <= risk; for one hypothesis at 0,
    k sigma with 2 Q(k) = risk.

    Parameters
    ----------
    weight, mean, sigma : (m,) array
        Posterior, offset from the estimate and standard deviation of each hypothesis, m.
    integrity_risk : float
        Probability that the error may exceed the level.

    Returns
    -------
    float
        Level, m, at most 0.1 % too large.

    References
    ----------
    Specification rail.md 22.

    Examples
    --------
    >>> round(protection_level([0.999, 0.001], [0.0, 6.0], [0.6, 0.6], integrity_risk=1e-4), 1)
    6.8
    """
    w, m, s = (np.atleast_1d(np.asarray(v, np.float64)) for v in (weight, mean, sigma))
    if not (len(w) == len(m) == len(s) > 0) or not (s > 0).all() or not np.isclose(w.sum(), 1.0):
        raise ValueError("a mixture needs one weight, mean and positive sigma a hypothesis, and weights that sum to 1")
    if not 0.0 < integrity_risk < 1.0:
        raise ValueError(f"integrity_risk {integrity_risk} is not between 0 and 1")
    return float(mixture_bound(w, m, s, len(w), integrity_risk, normal_quantile(integrity_risk)))
