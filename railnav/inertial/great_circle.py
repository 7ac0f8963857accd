"""Heading along a great circle and speed over ground, from rates of latitude and longitude."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.geodesy.ellipsoid import WGS84, Ellipsoid
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]


def great_circle_heading(
    latitude: float, latitude_before: float, heading_before: float, *, ellipsoid: Ellipsoid | None = None
) -> float:
    """Heading on a great circle from the change of latitude alone (Clairaut): sin H = cos(lat0)/cos(lat) sin H0.

    Parameters
    ----------
    latitude, latitude_before : float
        Now and before, rad.
    heading_before : float
        Clockwise from true north, rad.
    ellipsoid : Ellipsoid, optional
        Take reduced latitudes; on the sphere the heading is 3.4e-3 degrees wrong after one degree of latitude.

    Returns
    -------
    float
        rad, in (-pi, pi]. At the vertex, where errors of the latitude push the sine beyond 1, due east or west.

    Raises
    ------
    ValueError
        A value that is not finite.
    EstimationError
        The latitude lies beyond the vertex by more than a minute: the vehicle has left the great circle.

    Notes
    -----
    The source's arcsin alone fails past the vertex, by up to 84 degrees: here the heading points north while the latitude grows and south
    while it falls. Errors do not add up from step to step; near the vertex they grow as a square root.

    References
    ----------
    `spec/inertial.md` A7, UA(8).

    Examples
    --------
    >>> d = math.pi / 180
    >>> round(great_circle_heading(54.117036197 * d, 50 * d, 60 * d) / d, 6)
    71.756821
    """
    if not all(math.isfinite(v) for v in (latitude, latitude_before, heading_before)):
        raise ValueError("a latitude or heading is not finite")
    now, before = (_reduced(v, ellipsoid) for v in (latitude, latitude_before))
    constant = math.cos(before) * math.sin(heading_before)
    sine = constant / math.cos(now)
    if abs(sine) > 1.0:
        vertex = math.acos(min(1.0, abs(constant)))
        if abs(now) - vertex > math.radians(1.0 / 60.0):
            raise EstimationError(
                f"latitude {math.degrees(now):.3f} lies beyond the vertex of the great circle at {math.degrees(vertex):.3f} degrees: "
                "the vehicle turned; start again with a measured heading"
            )
        return math.copysign(0.5 * math.pi, sine)
    heading = math.asin(sine)
    return heading if latitude >= latitude_before else float(wrap_angle(math.pi - heading))


def great_circle_heading_error(
    latitude: float,
    latitude_before: float,
    heading_before: float,
    *,
    latitude_error: float = 0.0,
    latitude_before_error: float = 0.0,
    heading_before_error: float = 0.0,
) -> float:
    """Error of `great_circle_heading` to first order (on the sphere), rad, signed as the heading grows northbound.

    References
    ----------
    `spec/inertial.md` A7, UA(9).

    Examples
    --------
    >>> d = math.pi / 180
    >>> error = great_circle_heading_error(51 * d, 50 * d, 45 * d, heading_before_error=1e-3)
    >>> round(error, 6)
    0.001044
    """
    c, c0 = math.cos(latitude), math.cos(latitude_before)
    s = math.sin(heading_before)
    root = c * c - (c0 * s) ** 2
    if root <= 0.0:
        raise EstimationError("at the vertex of the great circle the error of the heading is not linear")
    change = (
        -s * math.sin(latitude_before) * latitude_before_error
        + c0 / c * s * math.sin(latitude) * latitude_error
        + c0 * math.cos(heading_before) * heading_before_error
    ) / math.sqrt(root)
    return change if latitude >= latitude_before else -change


def _reduced(latitude: float, ellipsoid: Ellipsoid | None) -> float:
    if ellipsoid is None:
        return latitude
    ratio = ellipsoid.semi_minor_axis / ellipsoid.semi_major_axis
    return math.atan2(ratio * math.sin(latitude), math.cos(latitude))


#: Radius of the sphere that the source assumes, m.
SPHERE_RADIUS = 6371000.0


def ground_speed(
    latitude_rate: ArrayLike,
    longitude_rate: ArrayLike,
    latitude: ArrayLike,
    *,
    height: ArrayLike = 0.0,
    ellipsoid: Ellipsoid | None = WGS84,
) -> FloatArray:
    """Speed over ground of any motion: v^2 = ((M + h) lat')^2 + ((N + h) cos(lat) lon')^2.

    Parameters
    ----------
    latitude_rate, longitude_rate, latitude : float or (...) array
        rad/s, rad/s, rad.
    height : float or (...) array, optional
        m.
    ellipsoid : Ellipsoid or None, optional
        None: the source's sphere of 6,371 km, up to 0.33 % wrong.

    Returns
    -------
    (...) array
        m/s.

    Notes
    -----
    The source proves it for loxodromes only; it holds for every motion. Rates from GNSS positions of 1 m at 1 Hz make 0.7 m/s.

    References
    ----------
    `spec/inertial.md` A8, UA(10), UA(11).

    Examples
    --------
    >>> round(float(ground_speed(1.2e-5, 2e-5, math.radians(50.0), ellipsoid=None)), 9)
    112.040943702
    """
    phi, h = np.asarray(latitude, dtype=np.float64), np.asarray(height, dtype=np.float64)
    if ellipsoid is None:
        along = across = SPHERE_RADIUS + h
    else:
        along, across = ellipsoid.meridian_radius(phi) + h, ellipsoid.transverse_radius(phi) + h
    north = along * np.asarray(latitude_rate, dtype=np.float64)
    east = across * np.cos(phi) * np.asarray(longitude_rate, dtype=np.float64)
    return np.asarray(np.hypot(north, east))[()]


def ground_speed_error(
    latitude_rate: float,
    longitude_rate: float,
    latitude: float,
    *,
    latitude_rate_error: float = 0.0,
    longitude_rate_error: float = 0.0,
    latitude_error: float = 0.0,
    radius_error: float = 0.0,
    radius: float = SPHERE_RADIUS,
) -> float:
    """Error of the speed on a sphere to first order, m/s.

    dv = R^2/v [lat' dlat' + lon' cos^2(lat) dlon' - lon'^2 sin cos dlat] + v/R dR; at rest R hypot(dlat', cos(lat) dlon').

    Notes
    -----
    The source prints single cosines, up to 170 % wrong.

    References
    ----------
    `spec/inertial.md` A8, UA(12).

    Examples
    --------
    >>> errors = {"latitude_rate_error": 1e-9, "longitude_rate_error": 1e-9, "latitude_error": 1e-4, "radius_error": 100.0}
    >>> round(ground_speed_error(1.2e-5, 2e-5, math.radians(50.0), **errors), 9)
    0.00196415
    """
    s, c = math.sin(latitude), math.cos(latitude)
    v = radius * math.hypot(latitude_rate, longitude_rate * c)
    if v == 0.0:
        return radius * math.hypot(latitude_rate_error, c * longitude_rate_error)
    turning = (
        latitude_rate * latitude_rate_error
        + longitude_rate * c * c * longitude_rate_error
        - longitude_rate**2 * s * c * latitude_error
    )
    return radius * radius / v * turning + v / radius * radius_error
