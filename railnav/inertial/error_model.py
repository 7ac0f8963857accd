"""Errors of a strapdown navigator to first order: how they grow, what noise feeds them, how measurements see them, how they are fed back.

Fifteen states, in the order of `ErrorState`: errors of latitude, longitude (rad), height (m) and velocity (m/s), estimate - truth;
attitude as a small turn about north, east, down, C_true = (I + [eps x]) C_estimate; biases, true - estimated.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import dcm_from_rotation_vector, quaternion_from_dcm, skew
from railnav.inertial.mechanization import GravityField, NavigationState

FloatArray = NDArray[np.float64]


class ErrorState(IntEnum):
    """Places of the error states."""

    LATITUDE = 0
    LONGITUDE = 1
    HEIGHT = 2
    VELOCITY_NORTH = 3
    VELOCITY_EAST = 4
    VELOCITY_DOWN = 5
    ATTITUDE_NORTH = 6
    ATTITUDE_EAST = 7
    ATTITUDE_DOWN = 8
    GYRO_BIAS_X = 9
    GYRO_BIAS_Y = 10
    GYRO_BIAS_Z = 11
    ACCELEROMETER_BIAS_X = 12
    ACCELEROMETER_BIAS_Y = 13
    ACCELEROMETER_BIAS_Z = 14


_P, _V, _E, _G, _A = (slice(3 * k, 3 * k + 3) for k in range(5))


def error_dynamics(
    state: NavigationState,
    specific_force_b: ArrayLike,
    *,
    gravity: GravityField | None = None,
    gyro_correlation_time: float = math.inf,
    accelerometer_correlation_time: float = math.inf,
) -> FloatArray:
    """Matrix F of the error equations x' = F x + noise.

    dv' = [f_n x] eps + C ba - (2 w_ie + w_en) x dv - (2 dw_ie + dw_en) x v - (0, 0, 2 g/a dh);
    eps' = -w_in x eps + dw_in - C bg; b' = -b/tau.

    Parameters
    ----------
    state : NavigationState
        Estimate about which the errors are taken.
    specific_force_b : (3,) array
        Corrected for the estimated bias, m/s^2.
    gravity : GravityField, optional
        Default: WGS 84.
    gyro_correlation_time, accelerometer_correlation_time : float, optional
        tau of first-order Gauss-Markov biases, s; infinite for random walks.

    Returns
    -------
    (15, 15) array
        SI and radians.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, a correlation time that is not positive.

    Notes
    -----
    Left out: the change of the radii and of gravity with latitude: 1e-5 m/s^2 for a kilometre of error. The source announces F but does
    not print it.

    References
    ----------
    `spec/inertial.md` B6.

    Examples
    --------
    >>> F = error_dynamics(NavigationState(0.8, 0.0, 0.0), [0.0, 0.0, -9.8])
    >>> F[ErrorState.VELOCITY_NORTH, ErrorState.ATTITUDE_EAST], F[ErrorState.HEIGHT, ErrorState.VELOCITY_DOWN]
    (np.float64(9.8), np.float64(-1.0))
    """
    f = np.asarray(specific_force_b, dtype=np.float64)
    if f.shape != (3,) or not np.isfinite(f).all():
        raise ValueError("specific_force_b must be three finite numbers")
    if not (gyro_correlation_time > 0.0 and accelerometer_correlation_time > 0.0):
        raise ValueError("correlation times must be positive")
    field = gravity or GravityField()
    ellipsoid, omega = field.ellipsoid, field.earth_rate
    s, c = math.sin(state.latitude), math.cos(state.latitude)
    t = s / c
    A = float(ellipsoid.meridian_radius(state.latitude)) + state.height
    B = float(ellipsoid.transverse_radius(state.latitude)) + state.height
    vn, ve, _ = state.velocity_n
    C = state.C_nb
    rate_ie = np.array([omega * c, 0.0, -omega * s])
    rate_en = np.array([ve / B, -vn / A, -ve * t / B])
    ie_by_p = np.zeros((3, 3))
    ie_by_p[0, 0], ie_by_p[2, 0] = -omega * s, -omega * c
    en_by_p = np.zeros((3, 3))
    en_by_p[:, 2] = -ve / B**2, vn / A**2, ve * t / B**2
    en_by_p[2, 0] = -ve / (B * c * c)
    en_by_v = np.array([[0.0, 1.0 / B, 0.0], [-1.0 / A, 0.0, 0.0], [0.0, -t / B, 0.0]])
    across = skew(state.velocity_n)  # -(dw) x v = v x dw
    F = np.zeros((15, 15))
    F[0, 2], F[0, 3] = -vn / A**2, 1.0 / A
    F[1, 0], F[1, 2], F[1, 4] = ve * t / (B * c), -ve / (B * B * c), 1.0 / (B * c)
    F[2, 5] = -1.0
    F[_V, _P] = across @ (2.0 * ie_by_p + en_by_p)
    F[5, 2] -= 2.0 * float(ellipsoid.normal_gravity(state.latitude)) / ellipsoid.semi_major_axis
    F[_V, _V] = -skew(2.0 * rate_ie + rate_en) + across @ en_by_v
    F[_V, _E], F[_V, _A] = skew(C @ f), C
    F[_E, _P], F[_E, _V] = ie_by_p + en_by_p, en_by_v
    F[_E, _E], F[_E, _G] = -skew(rate_ie + rate_en), -C
    F[_G, _G] = -np.eye(3) / gyro_correlation_time
    F[_A, _A] = -np.eye(3) / accelerometer_correlation_time
    return F


def error_transition(F: ArrayLike, interval: float) -> FloatArray:
    """Transition matrix over a step to second order, I + F h + (F h)^2/2.

    Parameters
    ----------
    F : (15, 15) array
        From `error_dynamics`.
    interval : float
        h, s; the third order left out is below 1e-9 of a step for h up to 0.1 s.

    Returns
    -------
    (15, 15) array

    Examples
    --------
    >>> error_transition(np.zeros((15, 15)), 0.1).trace()
    np.float64(15.0)
    """
    step = np.asarray(F, dtype=np.float64) * interval
    return np.asarray(np.eye(len(step)) + step + 0.5 * (step @ step))


def process_noise_sqrt(
    interval: float,
    *,
    velocity_random_walk: float,
    angle_random_walk: float,
    gyro_bias_walk: float,
    accelerometer_bias_walk: float,
) -> FloatArray:
    """Root of the process noise of one step: each density times sqrt(h).

    Parameters
    ----------
    interval : float
        h, s.
    velocity_random_walk, angle_random_walk : float
        m/s/sqrt(s), rad/sqrt(s).
    gyro_bias_walk, accelerometer_bias_walk : float
        Densities of what drives the biases, rad/s/sqrt(s) and m/s^2/sqrt(s); of a Gauss-Markov part sigma sqrt(2/tau).

    Returns
    -------
    (15, 12) array

    Raises
    ------
    ValueError
        A density that is negative, an interval that is not positive.

    Examples
    --------
    >>> kind = {"velocity_random_walk": 0.1, "angle_random_walk": 0.0, "gyro_bias_walk": 0.0, "accelerometer_bias_walk": 0.0}
    >>> process_noise_sqrt(0.01, **kind)[ErrorState.VELOCITY_EAST].max().round(6)
    np.float64(0.01)
    """
    densities = (velocity_random_walk, angle_random_walk, gyro_bias_walk, accelerometer_bias_walk)
    if not (interval > 0.0 and all(d >= 0.0 for d in densities)):
        raise ValueError("the interval must be positive, densities not negative")
    root = np.zeros((15, 12))
    for k, density in enumerate(densities):
        root[3 + 3 * k : 6 + 3 * k, 3 * k : 3 * k + 3] = density * math.sqrt(interval) * np.eye(3)
    return root


def position_scale(state: NavigationState, gravity: GravityField | None = None) -> FloatArray:
    """Metres per unit of the position errors: (M + h, (N + h) cos lat, 1): north, east and up.

    Examples
    --------
    >>> position_scale(NavigationState(0.0, 0.0, 0.0)).round(0)
    array([6.335439e+06, 6.378137e+06, 1.000000e+00])
    """
    ellipsoid = (gravity or GravityField()).ellipsoid
    return np.array(
        [
            float(ellipsoid.meridian_radius(state.latitude)) + state.height,
            (float(ellipsoid.transverse_radius(state.latitude)) + state.height) * math.cos(state.latitude),
            1.0,
        ]
    )


def gnss_design(
    state: NavigationState, *, lever_arm_b: ArrayLike = (0.0, 0.0, 0.0), rate_nb_b: ArrayLike = (0.0, 0.0, 0.0)
) -> FloatArray:
    """Derivatives of (estimated - GNSS) position (north, east, up, m) and velocity (north, east, down, m/s) of the antenna.

    Parameters
    ----------
    state : NavigationState
        Estimate.
    lever_arm_b : (3,) array, optional
        IMU to antenna, m.
    rate_nb_b : (3,) array, optional
        Rate of the body, rad/s.

    Returns
    -------
    (6, 15) array
        H of z = H x + noise. Innovations of the house are measured - predicted: give -z and -H, or -z with x taken as truth - estimate.

    References
    ----------
    `spec/inertial.md` B6, B7, B10.

    Examples
    --------
    >>> gnss_design(NavigationState(0.8, 0.0, 0.0)).shape
    (6, 15)
    """
    H = np.zeros((6, 15))
    H[:3, _P] = np.diag(position_scale(state))
    H[3:, _V] = np.eye(3)
    # C_est l - C_true l = -eps x (C l) = [C l x] eps; third row: up is minus down
    arm = np.asarray(lever_arm_b, dtype=np.float64)
    whirl = np.cross(np.asarray(rate_nb_b, dtype=np.float64), arm)
    H[:3, _E] = np.diag([1.0, 1.0, -1.0]) @ skew(state.C_nb @ arm)
    H[3:, _E] = skew(state.C_nb @ whirl)
    H[3:, _G] = state.C_nb @ -skew(arm)  # estimated rate - true rate = bg: C (bg x l)
    return H


def vehicle_design(state: NavigationState) -> FloatArray:
    """Derivatives of the velocity in body axes, estimated - (odometer speed, 0, 0): non-holonomic constraint and odometer.

    z = C^T v - (v_odo, 0, 0) = [0, C^T, -C^T [v x], 0, 0] x.

    Parameters
    ----------
    state : NavigationState
        Estimate.

    Returns
    -------
    (3, 15) array

    Notes
    -----
    KZ(2.12) works in north, east, down and leaves out the attitude: 43 instead of 32 m^2 after 600 s without GNSS.

    References
    ----------
    `spec/inertial.md` B8, KZ(2.9) to KZ(2.14).

    Examples
    --------
    >>> H = vehicle_design(NavigationState(0.8, 0.0, 0.0, np.array([10.0, 0.0, 0.0])))
    >>> float(H[1, ErrorState.ATTITUDE_DOWN])  # a heading error moves the velocity sideways
    10.0
    """
    H = np.zeros((3, 15))
    back = state.C_nb.T
    H[:, _V] = back
    H[:, _E] = -back @ skew(state.velocity_n)
    return H


def feed_back(state: NavigationState, error: ArrayLike) -> NavigationState:
    """State less its estimated error: p - dp, v - dv, exp([eps x]) C. Biases are the caller's: b + b_error.

    Parameters
    ----------
    state : NavigationState
        Estimate.
    error : (15,) array
        Estimated error, `ErrorState`.

    Returns
    -------
    NavigationState

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite.

    Examples
    --------
    >>> error = np.zeros(15)
    >>> error[ErrorState.HEIGHT] = 2.0
    >>> feed_back(NavigationState(0.8, 0.0, 100.0), error).height
    98.0
    """
    x = np.asarray(error, dtype=np.float64)
    if x.shape != (15,) or not np.isfinite(x).all():
        raise ValueError("error must be fifteen finite numbers")
    return NavigationState(
        state.latitude - float(x[0]),
        state.longitude - float(x[1]),
        state.height - float(x[2]),
        state.velocity_n - x[_V],
        quaternion_from_dcm(dcm_from_rotation_vector(x[_E]) @ state.C_nb),
    )
