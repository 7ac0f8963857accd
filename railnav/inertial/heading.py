"""Heading from what moves or sees: GNSS velocity, two antennas."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import dcm_from_euler
from railnav.errors import EstimationError
from railnav.inertial._shapes import three
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class VelocityHeading:
    """Heading from velocity.

    Attributes
    ----------
    heading : (...) array
        Clockwise from true north, rad, in (-pi, pi]; NaN where not `valid`.
    sigma : (...) array
        rad; infinite where not `valid`.
    valid : (...) bool array
        Where the speed is large enough against its noise.
    """

    heading: FloatArray
    sigma: FloatArray
    valid: NDArray[np.bool_]


def heading_from_velocity(
    velocity_n: ArrayLike, sigma: float | ArrayLike, *, worst: float = math.radians(15.0), backwards: bool = False
) -> VelocityHeading:
    """Heading of a vehicle that moves along its nose: atan2(v_E, v_N).

    Parameters
    ----------
    velocity_n : (..., 2) or (..., 3) array
        North, east (and down), m/s.
    sigma : float or (...) array
        Of each horizontal component, m/s.
    worst : float, optional
        Sigma of the heading beyond which none is given, rad.
    backwards : bool, optional
        The vehicle backs up: its nose points the other way.

    Returns
    -------
    VelocityHeading
        sigma/speed, rad: with 0.1 m/s 11.8, 5.8, 2.9, 1.1, 0.6 degrees at 0.5, 1, 2, 5, 10 m/s.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or a sigma that is not positive.

    Notes
    -----
    The source's arctan(v_E/v_N) is half a turn wrong for v_N < 0. Side slip, and the angle between the track's tangent at the antenna and
    the nose on a curve, are not in the sigma.

    References
    ----------
    `spec/inertial.md` B10, KZ(2.22).

    Examples
    --------
    >>> float(heading_from_velocity([-5.0, 0.0], 0.1).heading)
    3.141592653589793
    """
    v = np.asarray(velocity_n, dtype=np.float64)
    if v.ndim < 1 or v.shape[-1] not in (2, 3) or not np.isfinite(v).all():
        raise ValueError("velocity_n must have the shape (..., 2) or (..., 3) and be finite")
    s = np.asarray(sigma, dtype=np.float64)
    if not (np.isfinite(s).all() and np.all(s > 0.0)):
        raise ValueError("sigma must be positive and finite")
    speed = np.hypot(v[..., 0], v[..., 1])
    spread = np.where(speed > 0.0, s / np.where(speed > 0.0, speed, 1.0), math.inf)
    valid = spread <= worst
    heading = np.arctan2(v[..., 1], v[..., 0]) + (math.pi if backwards else 0.0)
    return VelocityHeading(
        np.asarray(np.where(valid, wrap_angle(heading), math.nan)),
        np.asarray(np.where(valid, spread, math.inf)),
        np.asarray(valid),
    )


def heading_from_antennas(
    baseline_n: ArrayLike, baseline_b: ArrayLike, *, roll: float = 0.0, pitch: float = 0.0, sigma: float
) -> tuple[float, float]:
    """Heading from the measured vector between two antennas whose places on the vehicle are known.

    Parameters
    ----------
    baseline_n : (3,) array
        First to second antenna, north, east, down, m.
    baseline_b : (3,) array
        The same in body axes, m.
    roll, pitch : float, optional
        rad, to level the baseline.
    sigma : float
        Of each horizontal component of `baseline_n`, m.

    Returns
    -------
    heading, sigma_heading : float
        rad, in (-pi, pi].

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, a sigma that is not positive.
    EstimationError
        The lengths differ by more than five sigma (wrong ambiguities), or the baseline is nearly vertical.

    Examples
    --------
    >>> heading_from_antennas([0.0, 2.0, 0.0], [2.0, 0.0, 0.0], sigma=0.01)
    (1.5707963267948966, 0.005)
    """
    n, b = three("baseline_n", baseline_n), three("baseline_b", baseline_b)
    if not (math.isfinite(sigma) and sigma > 0.0):
        raise ValueError(f"sigma is {sigma}; it must be positive")
    levelled = dcm_from_euler(roll, pitch, 0.0) @ b
    reach = math.hypot(levelled[0], levelled[1])
    if reach < 10.0 * sigma:
        raise EstimationError(
            f"the level part of the baseline, {reach:.3f} m, is too short for a sigma of {sigma:.3f} m"
        )
    off = float(np.linalg.norm(n) - np.linalg.norm(b))
    if abs(off) > 5.0 * math.sqrt(3.0) * sigma:
        raise EstimationError(
            f"the measured baseline is {off:+.3f} m longer than the mounted one: the solution is wrong, wait for a fix"
        )
    heading = math.atan2(n[1], n[0]) - math.atan2(levelled[1], levelled[0])
    return float(wrap_angle(heading)), sigma / reach
