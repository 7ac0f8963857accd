"""Attitude from gravity and the Earth's rotation, with the full first-order error."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.inertial._shapes import three
from railnav.inertial.mechanization import EARTH_RATE

FloatArray = NDArray[np.float64]


#: East, north, up of the source <-> north, east, down; right, forward, up <-> forward, right, down.
_SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


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
    w, f = three("rate_ib_b", rate_ib_b), three("specific_force_b", specific_force_b)
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
    w, dw = (_SWAP @ three(n, v) for n, v in (("rate_ib_b", rate_ib_b), ("rate_error", rate_error)))
    dg = -_SWAP @ three("force_error", force_error) / gravity  # of the gravity components, in units of gravity
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
