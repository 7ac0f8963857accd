"""A simulated constellation of navigation satellites: circular orbits, six planes of four, for tests of tight coupling."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.geodesy.ellipsoid import WGS84

FloatArray = NDArray[np.float64]
#: Radius of the orbits, m; inclination, rad; gravitational constant of the Earth, m^3/s^2; its rotation, rad/s.
RADIUS, INCLINATION, GRAVITATION, EARTH_RATE = 26_559_700.0, np.radians(55.0), 3.986004418e14, 7.292115e-5


def satellites(time: float, *, planes: int = 6, per_plane: int = 4) -> tuple[FloatArray, FloatArray]:
    """Positions and velocities of all satellites.

    Parameters
    ----------
    time : float
        s.
    planes, per_plane : int, optional
        How many orbits, and satellites on each.

    Returns
    -------
    position_e, velocity_e : (24, 3) array
        Earth-centred, Earth-fixed, m, m/s.

    References
    ----------
    `spec/inertial.md` B7, B13.

    Examples
    --------
    >>> position, velocity = satellites(0.0)
    >>> float(np.linalg.norm(position, axis=1).std().round(3))
    0.0
    """
    motion = np.sqrt(GRAVITATION / RADIUS**3)
    plane, number = np.divmod(np.arange(planes * per_plane), per_plane)
    node = plane * 2 * np.pi / planes - EARTH_RATE * time
    u = 2 * np.pi * (number / per_plane + plane * 0.11) + motion * time
    ci, si = np.cos(INCLINATION), np.sin(INCLINATION)
    orbit = RADIUS * np.stack([np.cos(u), np.sin(u) * ci, np.sin(u) * si], axis=1)
    moving = RADIUS * motion * np.stack([-np.sin(u), np.cos(u) * ci, np.cos(u) * si], axis=1)

    def turned(x: FloatArray) -> FloatArray:
        return np.stack(
            [np.cos(node) * x[:, 0] - np.sin(node) * x[:, 1], np.sin(node) * x[:, 0] + np.cos(node) * x[:, 1], x[:, 2]],
            axis=1,
        )

    position = turned(orbit)
    return position, turned(moving) - np.cross([0.0, 0.0, EARTH_RATE], position)


def elevations(position_e: ArrayLike, latitude: float, longitude: float, height: float) -> FloatArray:
    """Elevations of satellites above the horizon of a place, rad.

    Parameters
    ----------
    position_e : (m, 3) array
        m.
    latitude, longitude, height : float
        rad, rad, m.

    Returns
    -------
    (m,) array

    Examples
    --------
    >>> elevations([[2.6e7, 0.0, 0.0]], 0.0, 0.0, 0.0).round(3)
    array([1.571])
    """
    here = np.array(WGS84.to_cartesian(latitude, longitude, height)).ravel()
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    line = np.asarray(position_e, dtype=np.float64) - here
    return np.asarray(np.arcsin(line @ up / np.linalg.norm(line, axis=1)))
