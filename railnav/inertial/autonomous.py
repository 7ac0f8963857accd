"""Latitude, longitude, heading and speed without GNSS, from gyros, accelerometers and a reference azimuth.

Every result comes with its error model and its honest limits: with gyros of deg/h these methods are good for degrees, not for metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import dcm_from_euler
from railnav.errors import EstimationError
from railnav.geodesy.ellipsoid import WGS84, Ellipsoid
from railnav.inertial.mechanization import EARTH_RATE
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
Azimuth = Literal["loxodrome", "sighted", "great_circle"]

#: Radius of the sphere that the source assumes, m.
SPHERE_RADIUS = 6371000.0


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


@dataclass(frozen=True, slots=True)
class ReferenceLongitude:
    """Longitude from the azimuth of a reference point, with its error model.

    Attributes
    ----------
    longitude : float
        rad, in (-pi, pi].
    by_latitude, by_reference_latitude, by_azimuth : float
        Derivatives of the longitude on the loxodrome, good for short lines of every kind.
    """

    longitude: float
    by_latitude: float
    by_reference_latitude: float
    by_azimuth: float

    def sigma(self, latitude: float, reference_latitude: float, azimuth: float) -> float:
        """Standard deviation from those of latitude, reference latitude and azimuth, rad."""
        return math.hypot(
            self.by_latitude * latitude, self.by_reference_latitude * reference_latitude, self.by_azimuth * azimuth
        )


@dataclass(frozen=True, slots=True, eq=False)
class MovingPosition:
    """Position of a moving base from its gyros and its attitude.

    Attributes
    ----------
    latitude, longitude : (n,) array
        rad; NaN where not `valid`.
    longitude_rate : (n,) array
        rad/s; NaN where not `valid`.
    valid : (n,) bool array
        False where the base flies west about as fast as the Earth turns and its rate vanishes; longitude stays lost from there on.
    """

    latitude: FloatArray
    longitude: FloatArray
    longitude_rate: FloatArray
    valid: NDArray[np.bool_]


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
    w, f = (_vectors(n, v) for n, v in (("rate_ib_b", rate_ib_b), ("specific_force_b", specific_force_b)))
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
        _vectors(n, v)
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


def longitude_from_reference(
    latitude: float,
    reference_latitude: float,
    reference_longitude: float,
    azimuth: float,
    *,
    kind: Azimuth = "great_circle",
    ellipsoid: Ellipsoid | None = None,
) -> ReferenceLongitude:
    """Longitude of a point of known latitude from the azimuth in which it sees a reference point.

    Loxodrome: lon = lon0 + [psi(lat) - psi(lat0)] tan A, psi(x) = asinh(tan x) (- e artanh(e sin x) on an ellipsoid).

    Parameters
    ----------
    latitude : float
        Of the point, rad.
    reference_latitude, reference_longitude : float
        rad.
    azimuth : float
        Of the reference from the point, clockwise from true north, rad.
    kind : {"great_circle", "sighted", "loxodrome"}, optional
        What the azimuth is. Sighted or gyrocompassed, it is the azimuth of the great circle at the point: solved as a spherical triangle,
        or ("sighted") by the loxodrome with the azimuth at half way, good to 2 m at 80 km and 5 km at 1,000 km.
        The source puts a sighted azimuth into the loxodrome: 23 m wrong at 16 km, 9.6 km at 321 km.
    ellipsoid : Ellipsoid, optional
        For the loxodrome kinds; default: a sphere (the source), up to 0.009 degrees wrong over 2 degrees of latitude.

    Returns
    -------
    ReferenceLongitude

    Raises
    ------
    ValueError
        A value that is not finite, or an unknown kind.
    EstimationError
        Azimuth within 3 degrees of east or west, a point at a pole, or no great circle that reaches the reference's latitude.

    Notes
    -----
    d lon = tan A/cos(lat) d lat - tan A/cos(lat0) d lat0 + (psi - psi0)/cos^2 A dA: an error of three minutes in latitude alone makes 7.4
    minutes at 50 degrees and A = 57.7 degrees.

    References
    ----------
    `spec/inertial.md` A3, UA(3).

    Examples
    --------
    >>> d = math.pi / 180
    >>> round(longitude_from_reference(48 * d, 50 * d, 0.0, 30 * d, kind="loxodrome").longitude / d, 9)
    -1.760381833
    """
    values = (latitude, reference_latitude, reference_longitude, azimuth)
    if not all(math.isfinite(v) for v in values):
        raise ValueError("a latitude, longitude or azimuth is not finite")
    if kind not in ("loxodrome", "sighted", "great_circle"):
        raise ValueError(f"kind is 'loxodrome', 'sighted' or 'great_circle', not {kind!r}")
    if abs(math.cos(azimuth)) < 0.05:
        raise EstimationError(
            f"azimuth {math.degrees(azimuth):.1f} degrees: due east or west the latitude says nothing of the longitude; "
            "take a reference further north or south"
        )
    if min(math.cos(latitude), math.cos(reference_latitude)) < 1e-6:
        raise EstimationError("at a pole there is no longitude")
    e = math.sqrt(ellipsoid.eccentricity_squared) if ellipsoid is not None else 0.0

    def psi(x: float) -> float:
        return math.asinh(math.tan(x)) - (e * math.atanh(e * math.sin(x)) if e else 0.0)

    rise = psi(latitude) - psi(reference_latitude)
    tangent = math.tan(azimuth)
    partials = (
        tangent / math.cos(latitude),
        -tangent / math.cos(reference_latitude),
        rise / math.cos(azimuth) ** 2,
    )
    change = rise * tangent
    if kind == "sighted":
        middle = math.sin(0.5 * (latitude + reference_latitude))
        for _ in range(6):
            change = rise * math.tan(azimuth - 0.5 * change * middle)
    elif kind == "great_circle":
        change = -_great_circle(latitude, reference_latitude, azimuth)
    return ReferenceLongitude(float(wrap_angle(reference_longitude + change)), *partials)


def _great_circle(latitude: float, reference_latitude: float, azimuth: float) -> float:
    """Longitude of the reference minus that of the point: the first place where the circle reaches the reference's latitude."""
    a, b = math.sin(latitude), math.cos(latitude) * math.cos(azimuth)  # sin lat0 = a cos s + b sin s
    size, phase = math.hypot(a, b), math.atan2(b, a)
    ratio = math.sin(reference_latitude) / size
    if abs(ratio) > 1.0:
        raise EstimationError("the great circle in this azimuth never reaches the latitude of the reference")
    swing = math.acos(ratio)
    turns = sorted((phase + sign * swing) % (2.0 * math.pi) for sign in (1.0, -1.0))
    s = next((t for t in turns if t > 1e-12), 0.0)
    return math.atan2(
        math.sin(s) * math.sin(azimuth),
        math.cos(latitude) * math.cos(s) - math.sin(latitude) * math.sin(s) * math.cos(azimuth),
    )


def moving_position(
    time: ArrayLike,
    rate_ib_b: ArrayLike,
    attitude: ArrayLike,
    attitude_rate: ArrayLike,
    start_longitude: float,
) -> MovingPosition:
    """Latitude without integration and longitude by one, from gyros and an attitude known from elsewhere.

    The local frame turns at w_in_n = C_nb (w_ib_b - w_nb_b); latitude = atan(-w_D/w_N), lon' = w_N/cos(lat) - Omega.

    Parameters
    ----------
    time : (n,) array
        s, increasing.
    rate_ib_b : (n, 3) array
        Gyro rates, forward, right, down, rad/s.
    attitude, attitude_rate : (n, 3) array
        Roll, pitch, heading, rad, and their derivatives, rad/s: as accurate as the gyros must be.
    start_longitude : float
        rad.

    Returns
    -------
    MovingPosition

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, times that do not increase.

    Notes
    -----
    A gyro error of 0.01 deg/h north or up is 0.02 degrees of latitude, one minute of pitch one minute. The results printed in the source
    would need an angle random walk of 1.9e-4 deg/sqrt(h).

    References
    ----------
    `spec/inertial.md` A5, UA(5), UA(6).

    Examples
    --------
    >>> still = EARTH_RATE * np.array([[np.cos(0.9), 0.0, -np.sin(0.9)]] * 2)
    >>> moving_position([0.0, 1.0], still, np.zeros((2, 3)), np.zeros((2, 3)), 0.5).latitude.round(9)
    array([0.9, 0.9])
    """
    t = np.asarray(time, dtype=np.float64)
    w, angles, rates = (np.asarray(v, dtype=np.float64).reshape(-1, 3) for v in (rate_ib_b, attitude, attitude_rate))
    if t.ndim != 1 or not len(t) == len(w) == len(angles) == len(rates):
        raise ValueError(
            f"needs {t.size} rows of rates, attitude and attitude rates, not {len(w)}, {len(angles)}, {len(rates)}"
        )
    if not all(np.isfinite(x).all() for x in (t, w, angles, rates)):
        raise ValueError("a time, rate or angle is not finite")
    if np.any(np.diff(t) <= 0.0):
        raise ValueError(f"time does not increase at sample {int(np.argmax(np.diff(t) <= 0.0)) + 1}")
    roll, pitch, heading = angles.T
    sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    own = np.stack(  # w_nb_b of the angles' derivatives
        [
            rates[:, 0] - sp * rates[:, 2],
            cr * rates[:, 1] + sr * cp * rates[:, 2],
            -sr * rates[:, 1] + cr * cp * rates[:, 2],
        ],
        axis=-1,
    )
    turning = np.einsum("kij,kj->ki", dcm_from_euler(roll, pitch, heading), w - own)
    north, up = turning[:, 0], -turning[:, 2]
    known = np.hypot(north, up) >= 0.2 * EARTH_RATE
    latitude = np.where(known, np.arctan2(up * np.where(north < 0, -1.0, 1.0), np.abs(north)), np.nan)
    with np.errstate(invalid="ignore"):
        rate = north / np.cos(latitude) - EARTH_RATE
    steps = 0.5 * np.diff(t) * (rate[1:] + rate[:-1])
    longitude = start_longitude + np.concatenate([[0.0], np.cumsum(steps)])
    kept = known & np.isfinite(longitude)
    longitude = np.where(kept, np.asarray(wrap_angle(np.where(kept, longitude, 0.0))), np.nan)
    return MovingPosition(latitude, longitude, rate, kept)


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


def _reduced(latitude: float, ellipsoid: Ellipsoid | None) -> float:
    if ellipsoid is None:
        return latitude
    ratio = ellipsoid.semi_minor_axis / ellipsoid.semi_major_axis
    return math.atan2(ratio * math.sin(latitude), math.cos(latitude))


def _vectors(name: str, value: ArrayLike) -> FloatArray:
    x = np.asarray(value, dtype=np.float64)
    if x.ndim not in (1, 2) or x.shape[-1] != 3 or not x.size or not np.isfinite(x).all():
        raise ValueError(f"{name} must have the shape (3,) or (n, 3) and be finite")
    return x
