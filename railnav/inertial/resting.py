"""Whether and when a base is at rest, and what its sensors read there on the mean."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.units import STANDARD_GRAVITY

FloatArray = NDArray[np.float64]


#: A base that turns faster than this between pieces of a log does not rest, rad/s.
REST_RATE = math.radians(0.5)


#: A base whose specific force scatters more than this between pieces of a log does not rest, m/s^2.
REST_FORCE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Means of a log at rest.

    Attributes
    ----------
    rate_ib_b, specific_force_b : (3,) array
        Means, rad/s and m/s^2.
    sigma_rate, sigma_force : (3,) array
        Of the means, from the scatter of pieces of the log.
    duration : float
        s.
    """

    rate_ib_b: FloatArray
    specific_force_b: FloatArray
    sigma_rate: FloatArray
    sigma_force: FloatArray
    duration: float


def rest(
    interval: float,
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    *,
    largest_rate: float = REST_RATE,
    largest_scatter: float = REST_FORCE,
) -> Rest:
    """Means of a static log, after making sure that it is one.

    The log is cut into pieces of about a second (at least ten): the mean rate and specific force of each must agree with the mean of all.

    Parameters
    ----------
    interval : float
        Sampling interval, s.
    rate_ib_b, specific_force_b : (n, 3) array
        Samples, rad/s and m/s^2; n at least 100.
    largest_rate : float, optional
        Largest difference of a piece from the mean rate, rad/s.
    largest_scatter : float, optional
        Largest standard deviation of the pieces' specific force, m/s^2.

    Returns
    -------
    Rest

    Raises
    ------
    ValueError
        Wrong shape, too few samples, an interval that is not positive.
    EstimationError
        Motion (with the time and size), a gap, a frozen axis, or a unit other than m/s^2 or rad/s (recognised where it can be).

    References
    ----------
    `spec/inertial.md` B10, edge cases.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(0.0, 1e-3, (2, 500, 3))
    >>> rest(0.01, noise[0], noise[1] - [0.0, 0.0, 9.81]).specific_force_b.round(2)
    array([ 0.  ,  0.  , -9.81])
    """
    w, f = (np.asarray(v, dtype=np.float64) for v in (rate_ib_b, specific_force_b))
    if w.ndim != 2 or w.shape[1] != 3 or w.shape != f.shape or len(w) < 100:
        raise ValueError(f"needs rates and specific forces (n, 3), n at least 100, not {w.shape} and {f.shape}")
    if not (math.isfinite(interval) and interval > 0.0):
        raise ValueError(f"interval is {interval}; it must be positive")
    for name, x in (("rate", w), ("specific force", f)):
        bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
        if bad.size:
            raise EstimationError(f"{name} of sample {bad[0]} is not finite; cut the log there")
        for axis in np.flatnonzero(np.ptp(x, axis=0) == 0.0)[:1]:
            raise EstimationError(
                f"{name} on axis {'xyz'[axis]} is {x[0, axis]:g} all the time: the axis is frozen or missing"
            )
    length = float(np.linalg.norm(f.mean(axis=0)))
    if not 0.95 < length / STANDARD_GRAVITY < 1.05:
        if 0.95 < length < 1.05:
            raise EstimationError(
                f"the specific force is {length:.3f} long: it is in g; multiply it by {STANDARD_GRAVITY}"
            )
        raise EstimationError(
            f"the specific force is {length:.3f} m/s^2 long, not gravity: the base accelerates, an axis fails or the unit is wrong"
        )
    pieces = max(10, round(len(w) * interval))
    w_piece, f_piece = (np.array([p.mean(axis=0) for p in np.array_split(x, pieces)]) for x in (w, f))
    turning = np.linalg.norm(w_piece - w_piece.mean(axis=0), axis=1)
    worst = int(np.argmax(turning))
    if turning[worst] > largest_rate:
        raise EstimationError(
            f"the base moves: it turns at {math.degrees(turning[worst]):.2f} deg/s at {worst * len(w) * interval / pieces:.0f} s "
            f"(allowed {math.degrees(largest_rate):.2f}); align at rest, or give rates in rad/s if they are in degrees"
        )
    scatter = f_piece.std(axis=0, ddof=1)
    axis = int(np.argmax(scatter))
    if scatter[axis] > largest_scatter:
        raise EstimationError(
            f"the base moves: specific force on axis {'xyz'[axis]} scatters by {scatter[axis]:.3f} m/s^2 from second to second "
            f"(allowed {largest_scatter:.3f}); align at rest"
        )
    root = math.sqrt(pieces)
    return Rest(w.mean(axis=0), f.mean(axis=0), w_piece.std(axis=0, ddof=1) / root, scatter / root, len(w) * interval)
