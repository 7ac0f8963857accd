"""A journey without GNSS: position from gyros and attitude, heading of its legs, speed, and what the parts say of each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import dcm_from_euler, dcm_from_rotation_vector, rotation_vector_from_dcm
from railnav.errors import EstimationError
from railnav.geodesy.ellipsoid import WGS84, Ellipsoid
from railnav.inertial.autonomous import fixed_latitude
from railnav.inertial.great_circle import SPHERE_RADIUS, great_circle_heading, great_circle_heading_error
from railnav.inertial.mechanization import EARTH_RATE
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LegCheck:
    """Heading of one great-circle leg, by latitude alone and by the ratio of the speeds.

    Attributes
    ----------
    begin, end : float
        s.
    heading : float
        At the end of the leg, from the heading at its beginning and the latitudes (A7), rad.
    course : float
        At the end of the leg, atan2(v_E, v_N), rad.
    mismatch : float
        course - heading, rad.
    sigma : float
        Of the mismatch by UA(9), from the sigma of the latitude and of the course, rad; infinite at the vertex.
    """

    begin: float
    end: float
    heading: float
    course: float
    mismatch: float
    sigma: float


@dataclass(frozen=True, slots=True)
class HaltCheck:
    """Latitude at a halt from gravity and the Earth's rotation (A1), against that of the journey.

    Attributes
    ----------
    begin, end : float
        s.
    latitude, sigma : float
        At rest, rad.
    drift : float
        Latitude of the journey less that at rest, rad.
    """

    begin: float
    end: float
    latitude: float
    sigma: float
    drift: float


@dataclass(frozen=True, slots=True, eq=False)
class Journey:
    """A journey without GNSS, interval by interval.

    Attributes
    ----------
    time : (n - 1,) array
        Middle of each interval, s.
    latitude, longitude : (n - 1,) array
        rad; NaN from where the Earth's rotation was lost.
    velocity_north, velocity_east : (n - 1,) array
        From the rates of latitude and longitude, m/s.
    speed, course : (n - 1,) array
        m/s and rad.
    legs : tuple of LegCheck
    halts : tuple of HaltCheck
    """

    time: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    velocity_north: FloatArray
    velocity_east: FloatArray
    speed: FloatArray
    course: FloatArray
    legs: tuple[LegCheck, ...]
    halts: tuple[HaltCheck, ...]


def autonomous_journey(
    time: ArrayLike,
    rate_ib_b: ArrayLike,
    attitude: ArrayLike,
    start_longitude: float,
    *,
    specific_force_b: ArrayLike | None = None,
    legs: Sequence[tuple[float, float]] = (),
    halts: Sequence[tuple[float, float]] = (),
    latitude_sigma: float = 0.0,
    course_sigma: float = 0.0,
    smoothing: int = 1,
    ellipsoid: Ellipsoid | None = WGS84,
) -> Journey:
    """Follow a vehicle by its gyros and a known attitude, and let the parts check each other.

    The turn of the body against the local frame is taken from two attitudes as one rotation vector (A9), so that no derivatives of
    angles are
    needed; what is left of the gyros' rate is the turn of the local frame: latitude = atan(-w_D/w_N), lon' = w_N/cos(lat) - Omega (A5).
    Rates of
    both give the speed (A8). Along legs on great circles the heading follows from the latitude alone (A7) and must agree with the
    course; at
    halts gravity and the Earth's rotation give the latitude anew (A1).

    Parameters
    ----------
    time : (n,) array
        s, increasing.
    rate_ib_b : (n - 1, 3) array
        Means over the intervals between the times, forward, right, down, rad/s; where the motion cones, rotation vectors over them
        (`railnav.attitude`), divided by their length.
    attitude : (n, 3) array
        Roll, pitch, heading at the times, rad.
    start_longitude : float
        At the first time, rad.
    specific_force_b : (n - 1, 3) array, optional
        Means, needed for halts, m/s^2.
    legs, halts : sequence of (float, float), optional
        From and to, s.
    latitude_sigma, course_sigma : float, optional
        Of one latitude and of one course, rad: for the legs' checks.
    smoothing : int, optional
        Intervals over which latitude and longitude are differenced for the speed: noise falls, quick changes are lost.
    ellipsoid : Ellipsoid or None, optional
        None: the source's sphere.

    Returns
    -------
    Journey

    Raises
    ------
    ValueError
        Shapes that do not fit, values that are not finite, times that do not increase.
    EstimationError
        A leg or halt without samples, or a leg that leaves its great circle.

    Notes
    -----
    The latitude needs no integration, so that its error is that of the gyros and of the attitude now: 0.022 degrees for 0.01 deg/h, a
    minute for
    a minute of pitch. Without an attitude of that quality from elsewhere there is no journey: gyros alone cannot tell their own level.

    References
    ----------
    `spec/inertial.md` A12 (A1, A5, A7, A8, A9).

    Examples
    --------
    >>> still = EARTH_RATE * np.array([[np.cos(0.9), 0.0, -np.sin(0.9)]] * 9)
    >>> autonomous_journey(np.arange(10.0), still, np.zeros((10, 3)), 0.5).speed.round(6).max()
    np.float64(0.0)
    """
    t = np.asarray(time, dtype=np.float64)
    w, angles = np.asarray(rate_ib_b, dtype=np.float64), np.asarray(attitude, dtype=np.float64)
    n = len(t)
    if t.ndim != 1 or n < 3 or w.shape != (n - 1, 3) or angles.shape != (n, 3):
        raise ValueError(
            f"needs times (n,), rates (n - 1, 3), attitude (n, 3), not {t.shape}, {w.shape}, {angles.shape}"
        )
    if not (np.isfinite(t).all() and np.isfinite(w).all() and np.isfinite(angles).all()):
        raise ValueError("a time, rate or angle is not finite")
    if np.any(np.diff(t) <= 0.0):
        raise ValueError(f"time does not increase at sample {int(np.argmax(np.diff(t) <= 0.0)) + 1}")
    if smoothing < 1:
        raise ValueError(f"smoothing is {smoothing}; at least 1")
    step = np.diff(t)
    C = dcm_from_euler(*angles.T)
    # exp(h w_in_n) = C_nb(k) exp(h w_ib_b) C_nb(k+1)^T, exact for any turn of the body
    turned = C[:-1] @ dcm_from_rotation_vector(step[:, None] * w) @ np.swapaxes(C[1:], 1, 2)
    turning = rotation_vector_from_dcm(turned) / step[:, None]
    north, up = turning[:, 0], -turning[:, 2]
    known = np.logical_and.accumulate(np.hypot(north, up) >= 0.2 * EARTH_RATE)
    latitude = np.where(known, np.arctan2(up * np.where(north < 0.0, -1.0, 1.0), np.abs(north)), np.nan)
    with np.errstate(invalid="ignore"):
        rate = north / np.cos(latitude) - EARTH_RATE
    whole = np.concatenate([[0.0], np.cumsum(step * rate)])
    longitude = start_longitude + 0.5 * (whole[1:] + whole[:-1])
    middle = 0.5 * (t[1:] + t[:-1])
    latitude_rate = _slope(middle, latitude, smoothing)
    longitude_rate = rate if smoothing == 1 else _slope(middle, longitude, smoothing)
    if ellipsoid is None:
        along = across = np.full(n - 1, SPHERE_RADIUS)
    else:
        safe = np.where(known, latitude, 0.0)
        along, across = ellipsoid.meridian_radius(safe), ellipsoid.transverse_radius(safe)
    v_n, v_e = along * latitude_rate, across * np.cos(latitude) * longitude_rate
    course = np.arctan2(v_e, v_n)
    checked_legs = []
    for begin, end in legs:
        rows = _rows(middle, begin, end, "leg")
        a, b = rows[0], rows[-1]
        told = great_circle_heading(float(latitude[b]), float(latitude[a]), float(course[a]), ellipsoid=ellipsoid)
        try:
            parts = [
                great_circle_heading_error(float(latitude[b]), float(latitude[a]), float(course[a]), **{key: size})
                for key, size in (
                    ("latitude_error", latitude_sigma),
                    ("latitude_before_error", latitude_sigma),
                    ("heading_before_error", course_sigma),
                )
            ]
            sigma = math.hypot(*parts, course_sigma)
        except EstimationError:
            sigma = math.inf
        mismatch = float(wrap_angle(float(course[b]) - told))
        checked_legs.append(LegCheck(float(middle[a]), float(middle[b]), told, float(course[b]), mismatch, sigma))
    checked_halts = []
    for begin, end in halts:
        if specific_force_b is None:
            raise ValueError("halts need the specific force")
        f = np.asarray(specific_force_b, dtype=np.float64)
        if f.shape != w.shape:
            raise ValueError(f"specific_force_b must have the shape {w.shape}, not {f.shape}")
        rows = _rows(middle, begin, end, "halt")
        found = fixed_latitude(w[rows], f[rows])
        drift = float(np.mean(latitude[rows])) - found.latitude
        checked_halts.append(
            HaltCheck(float(middle[rows[0]]), float(middle[rows[-1]]), found.latitude, found.sigma or math.inf, drift)
        )
    return Journey(
        middle,
        latitude,
        np.asarray(np.where(known, wrap_angle(np.where(known, longitude, 0.0)), np.nan)),
        v_n,
        v_e,
        np.hypot(v_n, v_e),
        course,
        tuple(checked_legs),
        tuple(checked_halts),
    )


def _slope(t: FloatArray, x: FloatArray, count: int) -> FloatArray:
    """Derivative by differences over `count` intervals on each side, one-sided at the ends."""
    rows = np.arange(len(t))
    a, b = np.maximum(rows - count, 0), np.minimum(rows + count, len(t) - 1)
    return np.asarray((x[b] - x[a]) / (t[b] - t[a]))


def _rows(t: FloatArray, begin: float, end: float, what: str) -> NDArray[np.int64]:
    rows = np.flatnonzero((t >= begin) & (t <= end))
    if len(rows) < 2:
        raise EstimationError(
            f"the {what} from {begin:g} to {end:g} s has no samples; the record runs from {t[0]:.1f} to {t[-1]:.1f} s"
        )
    return rows
