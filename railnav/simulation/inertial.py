"""What an error-free IMU measures on a given motion: the strapdown equations run backwards.

Between two instants a strapdown navigator turns interval means into a change of attitude and velocity; here the attitude and velocity
are known at both ends and the equations are solved for the means, so that integrating the answer gives the motion back.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from railnav.geodesy.ellipsoid import WGS84

FloatArray = NDArray[np.float64]

#: Rotation rate of the Earth, rad/s (WGS 84).
EARTH_RATE = 7.292115e-5


def attitude_matrix(roll: FloatArray, pitch: FloatArray, heading: FloatArray) -> FloatArray:
    """C_nb = Rz(heading) Ry(pitch) Rx(roll): body axes (forward, right, down) into north, east, down.

    Parameters
    ----------
    roll, pitch, heading : (m,) array
        rad: right side down, nose up, clockwise from north.

    Returns
    -------
    (m, 3, 3) array

    Examples
    --------
    >>> attitude_matrix(*np.array([[0.0], [0.0], [np.pi / 2]])).round(12)[0] @ np.array([1.0, 0.0, 0.0])
    array([0., 1., 0.])
    """
    sr, cr = np.sin(roll), np.cos(roll)
    sp, cp = np.sin(pitch), np.cos(pitch)
    sh, ch = np.sin(heading), np.cos(heading)
    rows = [
        [ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr],
        [sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def rotation_vector(matrix: FloatArray) -> FloatArray:
    """Rotation vector of rotations by less than a right angle, (m, 3, 3) -> (m, 3), rad."""
    skew = 0.5 * np.stack(
        [
            matrix[:, 2, 1] - matrix[:, 1, 2],
            matrix[:, 0, 2] - matrix[:, 2, 0],
            matrix[:, 1, 0] - matrix[:, 0, 1],
        ],
        axis=-1,
    )
    sine = np.linalg.norm(skew, axis=-1)
    factor = np.where(sine > 1e-8, np.arcsin(np.minimum(sine, 1.0)) / np.maximum(sine, 1e-300), 1.0)
    return skew * factor[:, None]


def rotation_matrix(vector: FloatArray) -> FloatArray:
    """Rotation by a vector (Rodrigues), (m, 3) rad -> (m, 3, 3)."""
    angle = np.linalg.norm(vector, axis=-1)
    a = np.sinc(angle / np.pi)  # sin(x)/x
    b = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2  # (1 - cos x)/x^2
    x, y, z = vector.T
    zero = np.zeros_like(x)
    cross = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), (0, 1), (-2, -1))
    return np.asarray(np.eye(3) + a[:, None, None] * cross + b[:, None, None] * (cross @ cross))


def earth_rates(latitude: FloatArray, height: FloatArray, velocity_n: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rate of the Earth and of the local frame over it, w_ie_n and w_en_n, rad/s.

    Parameters
    ----------
    latitude, height : (m,) array
        rad, m.
    velocity_n : (m, 3) array
        North, east, down, m/s.

    Returns
    -------
    rate_ie_n, rate_en_n : (m, 3) array
    """
    meridian = WGS84.meridian_radius(latitude) + height
    transverse = WGS84.transverse_radius(latitude) + height
    zero = np.zeros_like(latitude)
    earth = EARTH_RATE * np.stack([np.cos(latitude), zero, -np.sin(latitude)], axis=-1)
    transport = np.stack(
        [
            velocity_n[:, 1] / transverse,
            -velocity_n[:, 0] / meridian,
            -velocity_n[:, 1] * np.tan(latitude) / transverse,
        ],
        axis=-1,
    )
    return earth, transport


def interval_means(
    time: FloatArray, latitude: FloatArray, height: FloatArray, velocity_n: FloatArray, attitude_nb: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Angular rate and specific force, averaged over each interval, of a body moving as given.

    exp(w_ib dt) = C_nb(k)^T exp(w_in dt) C_nb(k+1) and f_b = C_bn(mid) (dv/dt - g + (2 w_ie + w_en) x v), with the normal gravity of
    WGS 84 and its free-air change.

    Parameters
    ----------
    time : (m,) array
        s.
    latitude, height : (m,) array
        rad, m.
    velocity_n : (m, 3) array
        North, east, down, m/s.
    attitude_nb : (m, 3, 3) array
        C_nb.

    Returns
    -------
    rate_ib_b, specific_force_b : (m - 1, 3) array
        rad/s, m/s^2, forward, right, down.

    Notes
    -----
    The attitude turns evenly within an interval: at 100 Hz on a railway the neglected part stays below 1e-7 m/s^2. Integrated
    again over four minutes and 2.4 km, the means give the motion back to 0.4 mm (tests/simulation/test_inertial.py).

    References
    ----------
    Inverse of the mechanization in `spec/rail.md` (1) to (8), here in north, east, down.

    Examples
    --------
    >>> rest = np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1))
    >>> rate, force = interval_means(np.array([0.0, 0.01]), np.zeros(2), np.zeros(2), *rest)
    >>> force.round(6)
    array([[ 0.      ,  0.      , -9.780325]])
    """
    dt = np.diff(time)[:, None]
    mid_velocity = 0.5 * (velocity_n[1:] + velocity_n[:-1])
    mid_latitude, mid_height = 0.5 * (latitude[1:] + latitude[:-1]), 0.5 * (height[1:] + height[:-1])
    earth, transport = earth_rates(mid_latitude, mid_height, mid_velocity)
    frame_turn = rotation_matrix((earth + transport) * dt)
    before, after = attitude_nb[:-1], attitude_nb[1:]
    turn = rotation_vector(np.swapaxes(before, 1, 2) @ frame_turn @ after)
    gravity = np.zeros_like(mid_velocity)
    gravity[:, 2] = WGS84.normal_gravity(mid_latitude, mid_height)
    kinematic = np.diff(velocity_n, axis=0) / dt - gravity + np.cross(2.0 * earth + transport, mid_velocity)
    middle = rotation_matrix(-0.5 * (earth + transport) * dt) @ before @ rotation_matrix(0.5 * turn)
    return turn / dt, np.einsum("kij,ki->kj", middle, kinematic)
