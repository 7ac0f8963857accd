"""Conversions for the edges: inside railnav a bare name is SI and radians.

Examples
--------
>>> round(kmh(10.0), 6), round(from_kmh(36.0), 6)
(36.0, 10.0)
>>> round(float(cant_angle(0.160)), 5)
0.10687
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Standard gravity, m/s^2 (where a model of normal gravity is not needed).
STANDARD_GRAVITY = 9.80665

#: Distance between the wheel contact points of standard-gauge track, m: cant in metres over this is the sine of the cant angle.
RAIL_CENTRE_DISTANCE = 1.500


def kmh(speed: float) -> float:
    """Convert a speed from m/s to km/h."""
    return speed * 3.6


def from_kmh(speed_kmh: float) -> float:
    """Convert a speed from km/h to m/s."""
    return speed_kmh / 3.6


def wrap_angle(angle: ArrayLike) -> NDArray[np.float64]:
    """Wrap angles to (-pi, pi]; scalar or array, radians.

    Examples
    --------
    >>> import numpy as np
    >>> float(wrap_angle(3 * np.pi))
    3.141592653589793
    """
    angle = np.asarray(angle, dtype=np.float64)
    return np.asarray(np.pi - np.mod(np.pi - angle, 2 * np.pi))


def cant_angle(cant: ArrayLike, rail_centre_distance: float = RAIL_CENTRE_DISTANCE) -> NDArray[np.float64]:
    """Cant angle, rad, of a cant in metres (positive: left rail high), asin(cant / rail centre distance)."""
    return np.arcsin(np.asarray(cant, dtype=np.float64) / rail_centre_distance)
