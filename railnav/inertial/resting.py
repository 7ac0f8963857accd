"""Whether and when a base is at rest, and what its sensors read there on the mean."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.units import STANDARD_GRAVITY

FloatArray = NDArray[np.float64]


#: A base that turns faster than this between pieces of a log does not rest, rad/s.
REST_RATE = math.radians(0.5)


#: A base whose specific force scatters more than this between pieces of a log does not rest, m/s^2.
REST_FORCE = 0.05
#: Pieces of a stretch may differ by so many sigma of their noise.
NOISE_SIGMAS = 4.5
#: A base that turns evenly faster than this turns; slower, it is the bias of a gyro at rest, rad/s.
TURNING = math.radians(15.0)


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


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch of a log in which its means stay what they are.

    Attributes
    ----------
    first, last : int
        Samples, the last not included.
    begin, end : float
        Times of the first and of the last sample of it, s.
    turning : bool
        Whether it turns evenly, faster than `TURNING`, rather than rest.
    """

    first: int
    last: int
    begin: float
    end: float
    turning: bool

    @property
    def duration(self) -> float:
        """Of the stretch, s."""
        return self.end - self.begin


@dataclass(frozen=True, slots=True)
class Motion:
    """What keeps a log from counting as rest, at its worst.

    Attributes
    ----------
    rate, rate_time : float
        Largest change of the angular rate from one piece to the next, rad/s, and when, s.
    force, force_time : float
        Largest change of the specific force, m/s^2, and when, s.
    """

    rate: float
    rate_time: float
    force: float
    force_time: float


def find_stretches(
    time: ArrayLike,
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    *,
    shortest: float = 2.0,
    by_rate: bool = False,
    largest_rate: float = REST_RATE,
    largest_change: float = REST_FORCE,
) -> tuple[tuple[Stretch, ...], Motion]:
    """Stretches of a log at rest, or turning evenly, and the evidence of motion between them.

    The log is cut into pieces of an eighth of `shortest` (at least five samples, at most half a second); a stretch goes on as long as the
    mean of the next piece agrees with the mean of the stretch. Beside motion one piece is left out on each side.
    White noise of the samples, as the quietest quarter of the pieces shows it, widens what is allowed, at most fourfold.

    Parameters
    ----------
    time : (n,) array
        s, increasing; a gap ends a stretch.
    rate_ib_b, specific_force_b : (n, 3) array
        rad/s and m/s^2.
    shortest : float, optional
        A stretch that is shorter does not count, s.
    by_rate : bool, optional
        Look at the rates only: on a rate table whose axis is not vertical the specific force turns along.
    largest_rate, largest_change : float, optional
        How far a piece may lie from the mean of its stretch, rad/s (or half a percent of the rate, if that is more) and m/s^2.

    Returns
    -------
    stretches : tuple of Stretch
    motion : Motion
        Over the whole log.

    Raises
    ------
    ValueError
        Shapes that do not fit, fewer than 20 samples, values that are not finite.

    Notes
    -----
    A vehicle that runs evenly on a straight track looks at rest to its inertial sensors; only wheels or GNSS tell.

    Examples
    --------
    >>> force = np.repeat([[0.0, 0.0, -9.8], [0.0, 9.8, 0.0]], 1000, axis=0)
    >>> found, _ = find_stretches(np.arange(2000) * 0.01, np.zeros((2000, 3)), force)
    >>> [(s.begin, round(s.end, 2)) for s in found]
    [(0.0, 9.74), (10.25, 19.99)]
    """
    t = np.asarray(time, dtype=np.float64)
    w, f = (np.asarray(v, dtype=np.float64) for v in (rate_ib_b, specific_force_b))
    if t.ndim != 1 or w.shape != (len(t), 3) or w.shape != f.shape or len(t) < 20:
        raise ValueError(
            f"needs times (n,), rates and specific forces (n, 3), n at least 20, not {t.shape}, {w.shape}, {f.shape}"
        )
    if not (np.isfinite(t).all() and np.isfinite(w).all() and np.isfinite(f).all()):
        raise ValueError("a time, rate or specific force is not finite; cut the log there")
    if not (math.isfinite(shortest) and shortest > 0.0):
        raise ValueError(f"shortest is {shortest}; it must be positive")
    step = float(np.median(np.diff(t)))
    size = max(5, round(min(0.5, shortest / 8.0) / step))
    pieces = []  # first sample of each piece, gaps between pieces, never within
    for part in np.split(np.arange(len(t)), np.flatnonzero(np.diff(t) > 5.0 * step) + 1):
        pieces += [part[k : k + size] for k in range(0, len(part) - size + 1, size)]
    if len(pieces) < 2:
        raise ValueError("the log is shorter than two pieces; record for longer")
    W, F = (np.array([x[piece].mean(axis=0) for piece in pieces]) for x in (w, f))
    joined = [b[0] == a[-1] + 1 for a, b in pairwise(pieces)]
    turn, jerk = np.linalg.norm(np.diff(W, axis=0), axis=1), np.linalg.norm(np.diff(F, axis=0), axis=1)
    a, b = int(np.argmax(turn)), int(np.argmax(jerk))
    motion = Motion(float(turn[a]), float(t[pieces[a + 1][0]]), float(jerk[b]), float(t[pieces[b + 1][0]]))
    noise_w, noise_f = (_piece_noise(x, pieces, size) for x in (w, f))
    allowed_f = min(math.hypot(largest_change, NOISE_SIGMAS * noise_f), 4.0 * largest_change)
    least_w = min(math.hypot(largest_rate, NOISE_SIGMAS * noise_w), 4.0 * largest_rate)
    found = []
    k = 0
    while k < len(pieces):
        last = k + 1
        sum_w, sum_f = W[k].copy(), F[k].copy()
        while last < len(pieces) and joined[last - 1]:
            mean_w = sum_w / (last - k)
            allowed = max(least_w, 0.005 * float(np.linalg.norm(mean_w)))
            if np.linalg.norm(W[last] - mean_w) > allowed:
                break
            if not by_rate and np.linalg.norm(F[last] - sum_f / (last - k)) > allowed_f:
                break
            sum_w += W[last]
            sum_f += F[last]
            last += 1
        inner = k if k == 0 or not joined[k - 1] else k + 1
        outer = last if last == len(pieces) or not joined[last - 1] else last - 1
        if outer > inner:
            begin, end = int(pieces[inner][0]), int(pieces[outer - 1][-1])
            if t[end] - t[begin] + step >= shortest:
                found.append(
                    Stretch(
                        begin,
                        end + 1,
                        float(t[begin]),
                        float(t[end]),
                        bool(np.linalg.norm(sum_w / (last - k)) > TURNING),
                    )
                )
        k = last
    return tuple(found), motion


def _piece_noise(x: FloatArray, pieces: list[NDArray[np.int64]], size: int) -> float:
    """Sigma of the mean of a piece by white noise, all axes together, in the quietest quarter of the pieces."""
    scatter = [float(np.linalg.norm(np.diff(x[piece], axis=0).std(axis=0))) for piece in pieces]
    return float(np.percentile(scatter, 25.0)) / math.sqrt(2.0 * size)
