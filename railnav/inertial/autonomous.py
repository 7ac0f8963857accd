"""Latitude of a base at rest without GNSS, from gyros and accelerometers.

The result comes with its error model and its honest limits: with gyros of deg/h it is good for degrees, not for metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.geodesy.ellipsoid import WGS84, Ellipsoid
from railnav.inertial._shapes import vectors
from railnav.inertial.mechanization import EARTH_RATE

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FixedLatitude:
    """Latitude of a base at rest.

    Attributes
    ----------
    latitude : float
        Geodetic, rad.
    sigma : float or None
        From the scatter of the rates, rad; None if only a mean was given.
    coning_rate : float or None
        Mean rate that a conic motion of the base adds, rad/s; None if only a mean was given.
    """

    latitude: float
    sigma: float | None
    coning_rate: float | None


def fixed_latitude(
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    *,
    interval: float | None = None,
    largest_coning: float | None = None,
) -> FixedLatitude:
    """Latitude of a base at rest at any unknown attitude: atan2(w . f, |w x f|) of the mean vectors.

    Parameters
    ----------
    rate_ib_b : (3,) or (n, 3) array
        Angular rate, rad/s; samples are averaged before the formula, never after.
    specific_force_b : (3,) or (n, 3) array
        Specific force, any unit.
    interval : float, optional
        Sampling interval of the rates, s: needed for the coning guard.
    largest_coning : float, optional
        Refuse when the coning rate of the base exceeds this, rad/s.

    Returns
    -------
    FixedLatitude

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or a vector of length zero.
    EstimationError
        The base cones more than allowed.

    Notes
    -----
    Attitude drops out of the product. sigma = gyro noise/(sqrt(n) Omega): with the 34.5 deg/h a sample of a STIM300 and 38,281 samples
    0.67 degrees, so that the source's differences between filters are noise. Deflection of the vertical enters in full. A cone of 6.6
    arc seconds at 10 Hz costs one minute of latitude; vertical vibration costs nothing. The source's arcsin is the same but has no
    accuracy at the poles.

    References
    ----------
    `spec/inertial.md` A1, UA(1) with the sign for specific force.

    Examples
    --------
    >>> w = np.array([8.833422523201, 5.800855442584, 10.703010070729]) * np.radians(1 / 3600)
    >>> f = [0.482727220312, 0.871544111294, 9.759276883706]
    >>> round(math.degrees(fixed_latitude(w, f).latitude), 6)
    50.45
    """
    w, f = (vectors(n, v) for n, v in (("rate_ib_b", rate_ib_b), ("specific_force_b", specific_force_b)))
    mean_w, mean_f = (x.reshape(-1, 3).mean(axis=0) for x in (w, f))
    if not (np.any(mean_w) and np.any(mean_f)):
        raise ValueError("rate or specific force is zero: it has no direction")
    latitude = math.atan2(float(mean_w @ mean_f), float(np.linalg.norm(np.cross(mean_w, mean_f))))
    sigma = coning = None
    if w.ndim == 2 and len(w) > 1:
        # only noise in the meridian plane counts: along u - s e, of length cos(latitude), over Omega cos(latitude)
        e, u = mean_w / np.linalg.norm(mean_w), mean_f / np.linalg.norm(mean_f)
        across = u - (e @ u) * e
        size = float(np.linalg.norm(across))
        if size > 1e-6:
            sigma = float((w @ (across / size)).std(ddof=1)) / math.sqrt(len(w)) / float(np.linalg.norm(mean_w))
        if interval is not None:
            coning = coning_rate(w, interval)
    if largest_coning is not None:
        if coning is None:
            raise ValueError("the coning guard needs samples and their interval")
        if coning > largest_coning:
            raise EstimationError(
                f"the base cones: {math.degrees(coning) * 3600:.2f} deg/h are added to the Earth's rate "
                f"(allowed {math.degrees(largest_coning) * 3600:.2f}); damp the base or stop the machine"
            )
    return FixedLatitude(latitude, sigma, coning)


def coning_rate(rate_ib_b: ArrayLike, interval: float) -> float:
    """Mean rate that a conic motion adds, |mean of 1/2 theta x w| over the swinging part of the motion, rad/s.

    Parameters
    ----------
    rate_ib_b : (n, 3) array
        rad/s, sampled at ten times the frequency of the vibration or more.
    interval : float
        s.

    Returns
    -------
    float

    Notes
    -----
    The noise of the gyros makes a small number of its own: compare with that of a base known to be still.

    References
    ----------
    `spec/inertial.md` A1.4.

    Examples
    --------
    >>> t = np.arange(2000) * 0.001
    >>> swing = np.column_stack([np.cos(62.8 * t), np.sin(62.8 * t), 0.0 * t]) * 0.1
    >>> round(coning_rate(swing, 0.001), 7)  # half of 0.1^2/62.8
    7.96e-05
    """
    w = np.asarray(rate_ib_b, dtype=np.float64)
    if w.ndim != 2 or w.shape[1] != 3 or len(w) < 3:
        raise ValueError(f"rates must have the shape (n, 3), not {w.shape}")
    swing = w - w.mean(axis=0)
    angle = np.cumsum(swing, axis=0) * interval
    angle = angle - 0.5 * swing * interval  # at the middle of each sample
    angle = angle - angle.mean(axis=0)
    return float(np.linalg.norm(0.5 * np.cross(angle, swing).mean(axis=0)))


def fixed_latitude_error(
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    *,
    rate_error: ArrayLike = (0.0, 0.0, 0.0),
    force_error: ArrayLike = (0.0, 0.0, 0.0),
) -> float:
    """Error of `fixed_latitude` to first order: [(u - s e).dw/Omega + (e - s u).df/g]/c, e, u unit vectors of w and f.

    Parameters
    ----------
    rate_ib_b, specific_force_b : (3,) array
        Means, any units.
    rate_error, force_error : (3,) array, optional
        Their errors, in the same units.

    Returns
    -------
    float
        rad.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite.
    EstimationError
        At a pole, where the error is not linear.

    Notes
    -----
    East components do not count: level, it is (dw_U cos - dw_N sin)/Omega + df_N/g.

    References
    ----------
    `spec/inertial.md` A1.2.

    Examples
    --------
    >>> round(fixed_latitude_error([1.0, 0.0, 1.0], [0.0, 0.0, 1.0], rate_error=[0.0, 0.0, 1e-3]), 6)
    0.0005
    """
    w, f, dw, df = (
        vectors(n, v)
        for n, v in (
            ("rate_ib_b", rate_ib_b),
            ("specific_force_b", specific_force_b),
            ("rate_error", rate_error),
            ("force_error", force_error),
        )
    )
    omega, g = float(np.linalg.norm(w)), float(np.linalg.norm(f))
    e, u = w / omega, f / g
    s = float(e @ u)
    c = float(np.linalg.norm(np.cross(e, u)))
    if c < 1e-6:
        raise EstimationError("at a pole the error of the latitude is not linear in the errors of the sensors")
    return float(((u - s * e) @ dw / omega + (e - s * u) @ df / g) / c)


def required_grade(latitude_error: float) -> tuple[float, float]:
    """Gyro drift, rad/s, and accelerometer offset, in g, that give a latitude error, half of it each.

    Examples
    --------
    >>> gyro, accelerometer = required_grade(math.radians(1 / 60))
    >>> round(math.degrees(gyro) * 3600, 5), round(accelerometer, 7)
    (0.00219, 0.0001454)
    """
    return 0.5 * latitude_error * EARTH_RATE, 0.5 * latitude_error


def averaging_time(angle_random_walk: float, latitude_sigma: float) -> float:
    """Time of averaging, s, that a gyro of a given random walk (rad/sqrt(s)) needs for a sigma of the latitude, rad.

    Examples
    --------
    >>> round(averaging_time(math.radians(0.2) / 60, math.radians(1.0)) / 3600, 2)  # 0.2 deg/sqrt(h), 1 degree
    0.58
    """
    return (angle_random_walk / (EARTH_RATE * latitude_sigma)) ** 2


def geodetic_minus_geocentric(latitude_geocentric: ArrayLike, ellipsoid: Ellipsoid = WGS84) -> FloatArray:
    """What to add to a geocentric latitude: atan2((k - 1) sin cos, cos^2 + k sin^2), k = (a/b)^2.

    Parameters
    ----------
    latitude_geocentric : float or (...) array
        rad.
    ellipsoid : Ellipsoid, optional
        Default: WGS 84.

    Returns
    -------
    (...) array
        rad; at most 11.5 minutes, at 45 degrees.

    Notes
    -----
    Between WGS 84 and Krassowsky it differs by at most 2.7471e-5 degrees or 3.058 m; the source's 175.21 m are degrees times radius.

    References
    ----------
    `spec/inertial.md` A2, UA(2).

    Examples
    --------
    >>> round(math.degrees(geodetic_minus_geocentric(math.radians(45.0))), 9)
    0.192423216
    """
    x = np.asarray(latitude_geocentric, dtype=np.float64)
    k = (ellipsoid.semi_major_axis / ellipsoid.semi_minor_axis) ** 2
    s, c = np.sin(x), np.cos(x)
    return np.asarray(np.arctan2((k - 1.0) * s * c, c * c + k * s * s))[()]
