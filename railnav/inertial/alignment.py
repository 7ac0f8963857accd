"""Initial attitude: level from specific force, heading from the Earth's rotation, from GNSS velocity or from two antennas.

Everything comes with its sigma. A base that moves is refused with the evidence; a heading that the gyros cannot find is not given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import (
    dcm_from_euler,
    dcm_from_quaternion,
    dcm_from_rotation_vector,
    euler_from_dcm,
    orthonormalise,
    propagate,
    rotation_vector_from_dcm,
    skew,
)
from railnav.errors import EstimationError
from railnav.inertial.mechanization import EARTH_RATE, NavigationState, mechanize
from railnav.units import STANDARD_GRAVITY, wrap_angle

FloatArray = NDArray[np.float64]

#: A base that turns faster than this between pieces of a log does not rest, rad/s.
REST_RATE = math.radians(0.5)
#: A base whose specific force scatters more than this between pieces of a log does not rest, m/s^2.
REST_FORCE = 0.05
#: Coarser than this a gyrocompass heading is not worth giving, rad.
WORST_HEADING = math.radians(30.0)
#: Passes of the fine alignment, each about the result of the last.
_PASSES = 4
#: East, north, up of the source <-> north, east, down; right, forward, up <-> forward, right, down.
_SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


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


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Initial attitude and how well it is known.

    Attributes
    ----------
    method : str
        How it was found.
    roll, pitch : float
        Right side down, nose up, rad.
    heading : float or None
        Clockwise from true north, rad; None where the gyros cannot find it: see `note`.
    sigma_roll, sigma_pitch : float
        rad, instrument biases included.
    sigma_heading : float
        rad; infinite where there is no heading.
    note : str
        What limits it.
    """

    method: str
    roll: float
    pitch: float
    heading: float | None
    sigma_roll: float
    sigma_pitch: float
    sigma_heading: float
    note: str = ""

    def dcm(self) -> FloatArray:
        """C_nb, (3, 3).

        Raises
        ------
        EstimationError
            There is no heading.
        """
        if self.heading is None:
            raise EstimationError(
                f"no heading: {self.note}; take it from GNSS velocity once the vehicle moves, or from two antennas"
            )
        return dcm_from_euler(self.roll, self.pitch, self.heading)


@dataclass(frozen=True, slots=True, eq=False)
class FineAlignment:
    """Attitude after a static filter.

    Attributes
    ----------
    C_nb : (3, 3) array
        Attitude at the end.
    sigma_attitude_n : (3,) array
        Of its error as a small turn about north, east, down, rad; the third is the heading's.
    gyro_bias, accelerometer_bias : (3,) array
        Estimates, rad/s and m/s^2.
    sigma_gyro_bias, sigma_accelerometer_bias : (3,) array
        Their sigmas; those that rest cannot show stay at what was given.
    covariance : (12, 12) array
        Of velocity error, attitude error, gyro bias and accelerometer bias.
    nis : float
        Mean normalised innovation squared of a zero-velocity update, over its 3 degrees of freedom: 1 if the noise given is right.
    """

    C_nb: FloatArray
    sigma_attitude_n: FloatArray
    gyro_bias: FloatArray
    accelerometer_bias: FloatArray
    sigma_gyro_bias: FloatArray
    sigma_accelerometer_bias: FloatArray
    covariance: FloatArray
    nis: float

    @property
    def roll(self) -> float:
        """Right side down, rad."""
        return float(euler_from_dcm(self.C_nb)[0])

    @property
    def pitch(self) -> float:
        """Nose up, rad."""
        return float(euler_from_dcm(self.C_nb)[1])

    @property
    def heading(self) -> float:
        """Clockwise from true north, rad."""
        return float(euler_from_dcm(self.C_nb)[2])


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


def level(specific_force_b: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Roll and pitch of a base at rest: pitch = atan2(f_x, hypot(f_y, f_z)), roll = atan2(-f_y, -f_z).

    Parameters
    ----------
    specific_force_b : (..., 3) array
        Any unit.

    Returns
    -------
    roll, pitch : (...) array
        Right side down, nose up, rad.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or a vector of length zero.

    Notes
    -----
    A bias of 1 mg tilts by 0.0573 degrees. The source's arcsin(A_x/g) loses its sense near the vertical and fails for |A_x| > g; not so
    atan2. With the nose vertical roll is undefined (0 is given).

    References
    ----------
    `spec/inertial.md` B10, KZ(2.20), KZ(2.21).

    Examples
    --------
    >>> roll, pitch = level([0.0, -1.0, -9.75])
    >>> round(float(roll), 4), float(pitch)
    (0.1022, 0.0)
    """
    f = np.asarray(specific_force_b, dtype=np.float64)
    if f.ndim < 1 or f.shape[-1] != 3 or not np.isfinite(f).all():
        raise ValueError("specific_force_b must have the shape (..., 3) and be finite")
    if np.any(np.linalg.norm(f, axis=-1) == 0.0):
        raise ValueError("specific_force_b is zero: nothing tells what is up")
    level_part = np.hypot(f[..., 1], f[..., 2])
    roll = np.where(level_part > 0.0, np.arctan2(-f[..., 1], -f[..., 2]), 0.0)
    return roll[()], np.asarray(np.arctan2(f[..., 0], level_part))[()]


def gyrocompass(
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    latitude: float | None = None,
    *,
    gravity: float | None = None,
) -> FloatArray:
    """Attitude of a base at rest from the directions of gravity and of the Earth's rotation, C_bn not made orthonormal.

    With the latitude: down = -f/g, north = (w/Omega + sin(lat) down)/cos(lat), east = down x north, the source's way. Without:
    east = normalised w x f, north = up x east.

    Parameters
    ----------
    rate_ib_b, specific_force_b : (3,) array
        Means at rest, rad/s and m/s^2.
    latitude : float, optional
        rad; None for the way without it.
    gravity : float, optional
        m/s^2; default: the length of the specific force.

    Returns
    -------
    (3, 3) array
        C_nb: rows north, east, down in body axes. Orthonormal only as far as rate, latitude and gravity agree.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite.
    EstimationError
        At a pole, or without a rate that could be the Earth's (the length is given).

    Notes
    -----
    Heading error on a level base: east gyro error over Omega cos(lat), 5.93 degrees per deg/h at 50 degrees. A gyro of 10 deg/h finds no
    heading: 45 degrees wrong.

    References
    ----------
    `spec/inertial.md` A6.

    Examples
    --------
    >>> C_nb = gyrocompass(EARTH_RATE * np.array([np.cos(0.9), 0.0, -np.sin(0.9)]), [0.0, 0.0, -9.8], 0.9)
    >>> bool(np.allclose(C_nb, np.eye(3)))
    True
    """
    w, f = _three("rate_ib_b", rate_ib_b), _three("specific_force_b", specific_force_b)
    if not np.any(f):
        raise ValueError("specific_force_b is zero: nothing tells what is up")
    if latitude is None:
        up = f / np.linalg.norm(f)
        east = np.cross(w, up)
        size = float(np.linalg.norm(east))
        if size < 1e-3 * EARTH_RATE:
            raise EstimationError(
                f"horizontal rate of {size:.2g} rad/s is too small to show north: at a pole, or a dead gyro"
            )
        east = east / size
        return np.stack([np.cross(up, east), east, -up])
    cosine = math.cos(latitude)
    if abs(cosine) < 1e-3:
        raise EstimationError("at a pole there is no heading: the Earth's rotation is vertical")
    down = -f / (gravity if gravity is not None else float(np.linalg.norm(f)))
    north = (w / EARTH_RATE + math.sin(latitude) * down) / cosine
    return np.stack([north, np.cross(down, north), down])


def compass_heading(C_nb: ArrayLike) -> float:
    """Heading of a matrix that need not be orthonormal, atan2(c_21, c_11), rad.

    Examples
    --------
    >>> compass_heading(np.eye(3))
    0.0
    """
    C = np.asarray(C_nb, dtype=np.float64)
    return math.atan2(C[1, 0], C[0, 0])


def gyrocompass_error(
    C_nb: ArrayLike,
    rate_ib_b: ArrayLike,
    latitude: float,
    *,
    rate_error: ArrayLike = (0.0, 0.0, 0.0),
    force_error: ArrayLike = (0.0, 0.0, 0.0),
    latitude_error: float = 0.0,
    gravity: float = 9.81,
) -> float:
    """Error of the gyrocompass heading to first order, of gyros, accelerometers and latitude together.

    Parameters
    ----------
    C_nb : (3, 3) array
        Attitude.
    rate_ib_b : (3,) array
        Measured rates, rad/s.
    latitude : float
        rad.
    rate_error, force_error : (3,) array, optional
        In body axes, rad/s and m/s^2.
    latitude_error : float, optional
        rad.
    gravity : float, optional
        m/s^2, held at its nominal value, as the Earth's rate.

    Returns
    -------
    float
        Error of the heading, rad, clockwise.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite.
    EstimationError
        At a pole, or with the nose vertical.

    References
    ----------
    `spec/inertial.md` A6, UA(7), with the source's axes and its counter-clockwise yaw turned into those of the house.

    Examples
    --------
    >>> east = EARTH_RATE * np.array([np.cos(0.9), 0.0, -np.sin(0.9)])
    >>> round(gyrocompass_error(np.eye(3), east, 0.9, rate_error=[0.0, 1e-8, 0.0]) * 1e6)
    -221
    """
    c = _SWAP @ np.asarray(C_nb, dtype=np.float64).T @ _SWAP  # the source's c_ij: body axis i, east, north, up
    w, dw = (_SWAP @ _three(n, v) for n, v in (("rate_ib_b", rate_ib_b), ("rate_error", rate_error)))
    dg = -_SWAP @ _three("force_error", force_error) / gravity  # of the gravity components, in units of gravity
    phi, dphi = float(latitude), float(latitude_error)
    level_part = c[1, 0] ** 2 + c[1, 1] ** 2
    if abs(math.cos(phi)) < 1e-3 or level_part < 1e-6:
        raise EstimationError("no heading at a pole, or with the nose vertical")
    x, y, z = (
        dw[i] / (EARTH_RATE * math.cos(phi))
        + dg[i] * math.tan(phi)
        + (w[i] / EARTH_RATE * math.sin(phi) - c[i, 2]) * dphi / math.cos(phi) ** 2
        for i in range(3)
    )
    yaw = (
        c[1, 1] * c[2, 1] * dg[0]
        - c[0, 1] * c[1, 1] * dg[2]
        + c[1, 0] * y
        - c[1, 1] * c[0, 2] * z
        + c[1, 1] * c[2, 2] * x
    ) / level_part
    return float(-yaw)


def coarse_align(
    still: Rest,
    latitude: float | None = None,
    *,
    gyro_bias_sigma: float,
    accelerometer_bias_sigma: float,
    worst_heading: float = WORST_HEADING,
) -> Alignment:
    """Roll, pitch and, if the gyros are good enough, heading of a base at rest, with sigmas.

    Parameters
    ----------
    still : Rest
        From `rest`.
    latitude : float, optional
        rad: refuses a rate that does not fit the Earth's there.
    gyro_bias_sigma, accelerometer_bias_sigma : float
        What biases the triads may have after calibration, rad/s and m/s^2 (1 sigma).
    worst_heading : float, optional
        Sigma beyond which no heading is given, rad.

    Returns
    -------
    Alignment

    Raises
    ------
    ValueError
        A sigma that is negative.

    Notes
    -----
    sigma_heading = hypot(gyro error over Omega cos(lat), tan(lat) accelerometer error over g); the way without latitude is used, so that
    errors of the latitude do not count.

    References
    ----------
    `spec/inertial.md` A6, B10.

    Examples
    --------
    >>> earth = EARTH_RATE * np.array([np.cos(0.9), 0.0, -np.sin(0.9)])
    >>> still = Rest(earth, np.array([0.0, 0.0, -9.81]), np.zeros(3), np.zeros(3), 600.0)
    >>> found = coarse_align(still, 0.9, gyro_bias_sigma=5e-8, accelerometer_bias_sigma=1e-3)
    >>> round(found.heading, 6), round(np.degrees(found.sigma_heading), 3)
    (0.0, np.float64(0.064))
    """
    if gyro_bias_sigma < 0.0 or accelerometer_bias_sigma < 0.0:
        raise ValueError("sigmas must not be negative")
    roll, pitch = (float(v) for v in level(still.specific_force_b))
    g = float(np.linalg.norm(still.specific_force_b))
    force = math.hypot(accelerometer_bias_sigma, float(still.sigma_force.max())) / g
    rate = math.hypot(gyro_bias_sigma, float(still.sigma_rate.max()))
    sigma_roll = force / max(math.cos(pitch), 1e-3)

    def without(note: str) -> Alignment:
        return Alignment("level", roll, pitch, None, sigma_roll, force, math.inf, note)

    up = still.specific_force_b / g
    vertical = float(still.rate_ib_b @ up)
    horizontal = float(np.linalg.norm(still.rate_ib_b - vertical * up))
    expected = EARTH_RATE * (1.0 if latitude is None else math.cos(latitude))
    if rate > worst_heading * expected:
        return without(
            f"gyro errors of {math.degrees(rate) * 3600:.3g} deg/h hide the Earth's rotation ({math.degrees(expected) * 3600:.1f} deg/h)"
        )
    if latitude is not None and math.hypot(
        horizontal - expected, vertical - EARTH_RATE * math.sin(latitude)
    ) > 5.0 * rate + (5.0 * force * EARTH_RATE):
        return without(
            f"the measured rate ({math.degrees(horizontal) * 3600:.2f} deg/h level, {math.degrees(vertical) * 3600:.2f} up) is not the "
            "Earth's at this latitude: the base turns, or the biases are larger than stated"
        )
    C_nb = gyrocompass(still.rate_ib_b, still.specific_force_b)
    tangent = vertical / max(horizontal, 1e-3 * EARTH_RATE)
    sigma_heading = math.hypot(rate / horizontal, tangent * force)
    if sigma_heading > worst_heading:
        return without(f"the heading would be {math.degrees(sigma_heading):.0f} degrees wrong")
    return Alignment("gyrocompass", roll, pitch, compass_heading(C_nb), sigma_roll, force, sigma_heading)


def fine_align(
    start: Alignment | FloatArray,
    interval: float,
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    latitude: float,
    *,
    height: float = 0.0,
    initial_sigma: ArrayLike | None = None,
    gyro_bias_sigma: float,
    accelerometer_bias_sigma: float,
    angle_random_walk: float,
    velocity_random_walk: float,
    velocity_sigma: float = 1e-3,
    update_every: float = 1.0,
) -> FineAlignment:
    """Refine the attitude of a base at rest that may shake: strapdown with zero-velocity updates in an iterated square-root filter.

    Errors: velocity, attitude (R_true = (I + [eps x]) R_est), biases. dv' = [f_n x] eps + C ba - (2 w_ie) x dv,
    eps' = -w_in x eps - C bg the coupling of dv to the frame rate left out. The linear filter is
    run again about its own result: fed back step by step, a tilt of 0.3 degrees would pass for a drift, and that for a heading.

    Parameters
    ----------
    start : Alignment or (3, 3) array
        Coarse attitude; errors within some 10 degrees in heading and 1 degree in level.
    interval : float
        Sampling interval, s.
    rate_ib_b, specific_force_b : (n, 3) array
        Samples, rad/s and m/s^2.
    latitude, height : float
        rad, m.
    initial_sigma : (3,) array, optional
        Of the coarse attitude as a turn about north, east, down, rad; default: from `start`.
    gyro_bias_sigma, accelerometer_bias_sigma : float
        Prior of the biases, rad/s and m/s^2.
    angle_random_walk, velocity_random_walk : float
        Densities of the noise, rad/sqrt(s) and m/s/sqrt(s).
    velocity_sigma : float, optional
        How still the base is over an update, m/s.
    update_every : float, optional
        s between zero-velocity updates.

    Returns
    -------
    FineAlignment

    Raises
    ------
    ValueError
        Wrong shapes, values that are not finite.
    EstimationError
        Innovations far beyond their sigma: the base moves, or the noise is not what was stated.

    Notes
    -----
    Rest shows level, the north and down gyro biases relative to the heading, and the vertical accelerometer bias; it cannot tell the east
    gyro bias from a heading error, nor horizontal accelerometer biases from tilt. Those sigmas stay at what the priors say: heading
    sigma = gyro_bias_sigma/(Omega cos(lat)).

    References
    ----------
    `spec/inertial.md` A6, B6, B10.

    Examples
    --------
    >>> from railnav.inertial.mechanization import GravityField
    >>> n, earth = 6000, EARTH_RATE * np.array([np.cos(0.9), 0.0, -np.sin(0.9)])
    >>> force = -GravityField().vector(0.9)
    >>> kind = {"gyro_bias_sigma": 1e-8, "accelerometer_bias_sigma": 1e-4, "angle_random_walk": 1e-7, "velocity_random_walk": 1e-5}
    >>> tilted = dcm_from_euler(0.001, -0.001, 0.01)
    >>> found = fine_align(tilted, 0.01, [earth] * n, [force] * n, 0.9, initial_sigma=[1e-3, 1e-3, 1e-2], **kind)
    >>> abs(found.roll) < 1e-5, abs(found.heading) < 2e-3
    (True, True)
    """
    from railnav.estimation.square_root import lower_root, predict, update

    w, f = (np.asarray(v, dtype=np.float64) for v in (rate_ib_b, specific_force_b))
    if w.ndim != 2 or w.shape[1] != 3 or w.shape != f.shape:
        raise ValueError(f"needs rates and specific forces (n, 3), not {w.shape} and {f.shape}")
    if isinstance(start, Alignment):
        C = start.dcm()
        if initial_sigma is None:
            level_sigma = math.hypot(start.sigma_roll, start.sigma_pitch)
            initial_sigma = (level_sigma, level_sigma, start.sigma_heading)
    else:
        C = orthonormalise(start)
    if initial_sigma is None:
        raise ValueError("initial_sigma is needed with a matrix: about north, east, down, rad")
    per_update = max(1, round(update_every / interval))
    count = len(w) // per_update
    if count < 2:
        raise ValueError(f"{len(w)} samples are shorter than two updates of {update_every} s")
    h = per_update * interval
    rate_e = EARTH_RATE * np.array([math.cos(latitude), 0.0, -math.sin(latitude)])
    sigma0 = np.concatenate(
        [
            np.full(3, velocity_sigma),
            _three("initial_sigma", initial_sigma),
            np.full(3, gyro_bias_sigma),
            np.full(3, accelerometer_bias_sigma),
        ]
    )
    prior_sqrt = lower_root(np.diag(np.maximum(sigma0, 1e-15) ** 2))
    H = np.hstack([np.eye(3), np.zeros((3, 9))])
    R_sqrt = velocity_sigma * np.eye(3)
    noise = np.zeros((12, 6))
    noise[:3, :3] = velocity_random_walk * math.sqrt(h) * np.eye(3)
    noise[3:6, 3:] = angle_random_walk * math.sqrt(h) * np.eye(3)
    begin, bg, ba = C, np.zeros(3), np.zeros(3)
    for _ in range(_PASSES):
        # one linear filter about a fixed strapdown run: nothing is fed back, so that no direction gains knowledge it has not
        x = np.concatenate([np.zeros(3), rotation_vector_from_dcm(C @ begin.T), -bg, -ba])
        P_sqrt, turned, nis = prior_sqrt, begin, 0.0
        for k in range(count):
            piece = slice(k * per_update, (k + 1) * per_update)
            end = mechanize(
                NavigationState.from_dcm(latitude, 0.0, height, C_nb=turned),
                interval,
                w[piece],
                f[piece],
                gyro_bias=bg,
                accelerometer_bias=ba,
            ).state()
            force_n = turned @ (f[piece].mean(axis=0) - ba)
            F = np.zeros((12, 12))
            F[:3, :3], F[:3, 3:6], F[:3, 9:] = -2.0 * skew(rate_e), skew(force_n), turned
            F[3:6, 3:6], F[3:6, 6:9] = -skew(rate_e), -turned
            Phi = np.eye(12) + F * h + 0.5 * (F @ F) * h * h + (F @ F @ F) * h**3 / 6.0
            noise[:3, 3:] = 0.5 * h * skew(force_n) @ noise[3:6, 3:]
            P_sqrt = predict(P_sqrt, Phi, noise)
            x = Phi @ x
            done = update(
                x, P_sqrt, end.velocity_n - x[:3], H, R_sqrt
            )  # at rest the velocity found is the error of the velocity
            x, P_sqrt, nis = done.state, done.P_sqrt, nis + done.nis / (3.0 * count)
            x[:3] -= end.velocity_n  # the next piece starts at rest
            turned = end.C_nb
        found = dcm_from_rotation_vector(x[3:6]) @ turned
        bg, ba = bg + x[6:9], ba + x[9:]
        # the start that leads there with the biases found, for the next pass
        turns = propagate([1.0, 0.0, 0.0, 0.0], interval * (w[: count * per_update] - bg))[-1]
        back = dcm_from_rotation_vector(rate_e * h * count)
        free = back.T @ begin @ dcm_from_quaternion(turns)
        step = back @ rotation_vector_from_dcm(found @ free.T)
        begin = dcm_from_rotation_vector(step) @ begin
        if float(np.linalg.norm(step)) < 1e-8:
            break
    if nis > 2.0 + 6.0 * math.sqrt(2.0 / (3.0 * count)):
        raise EstimationError(
            f"zero-velocity updates miss by {math.sqrt(nis):.1f} sigma: the base moves, or the noise or biases are larger than stated"
        )
    covariance = P_sqrt @ P_sqrt.T
    sigma = np.sqrt(np.diagonal(covariance))
    return FineAlignment(found, sigma[3:6], bg, ba, sigma[6:9], sigma[9:], covariance, nis)


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
    n, b = _three("baseline_n", baseline_n), _three("baseline_b", baseline_b)
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


def lever_arm_motion(
    C_nb: ArrayLike, lever_arm_b: ArrayLike, rate_nb_b: ArrayLike | Literal[0] = 0
) -> tuple[FloatArray, FloatArray]:
    """Position and velocity of a point of the body against its reference point: C_nb l and C_nb (w_nb x l).

    Parameters
    ----------
    C_nb : (3, 3) array
        Attitude.
    lever_arm_b : (3,) array
        Reference point to the point, m.
    rate_nb_b : (3,) array, optional
        Rate of the body against the local frame, rad/s.

    Returns
    -------
    offset_n, velocity_n : (3,) array
        m and m/s: reference = antenna - offset.

    References
    ----------
    `spec/inertial.md` B10, KZ(2.18), KZ(2.19).

    Examples
    --------
    >>> lever_arm_motion(np.eye(3), [0.0, 0.0, -3.0], [0.0, 0.1, 0.0])[1].round(6) + 0.0
    array([-0.3,  0. ,  0. ])
    """
    C, arm = np.asarray(C_nb, dtype=np.float64), _three("lever_arm_b", lever_arm_b)
    w = np.zeros(3) if isinstance(rate_nb_b, int) else _three("rate_nb_b", rate_nb_b)
    return np.asarray(C @ arm), np.asarray(C @ np.cross(w, arm))


def _three(name: str, value: ArrayLike) -> FloatArray:
    x = np.asarray(value, dtype=np.float64)
    if x.shape != (3,) or not np.isfinite(x).all():
        raise ValueError(f"{name} must be three finite numbers")
    return x
