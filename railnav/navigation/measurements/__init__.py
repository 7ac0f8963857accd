"""What sensors on a vehicle that follows the track read: yaw rate and specific force."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.navigation.measurements._kernels import specific_force_kernel, yaw_rate_kernel
from railnav.track.model import TrackPoints
from railnav.units import STANDARD_GRAVITY

FloatArray = NDArray[np.float64]

__all__ = ["specific_force", "yaw_rate"]


def yaw_rate(speed: ArrayLike, point: TrackPoints, *, gradient_rate: ArrayLike = 0.0) -> FloatArray:
    """Rate about a vehicle's down axis as it follows the track, rad/s, without the Earth's rate.

    omega_z = v (kappa cos(alpha) cos(phi) - kappa_v sin(phi)) with grade angle alpha, cant angle phi and kappa_v = d(alpha)/ds.

    Parameters
    ----------
    speed : float or (m,) array
        Along the offset, m/s.
    point : TrackPoints
        Geometry there; curvature positive to the right, cant positive with the left rail high.
    gradient_rate : float or (m,) array
        d(gradient)/d(offset), 1/m.

    Returns
    -------
    (m,) array
        rad/s, positive to the right.

    References
    ----------
    Specification rail.md 19.3, row "yaw gyro".

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> yaw_rate(20.0, demo_line().at(demo_line().track_id[0], [0.0, 10.0])).shape
    (2,)
    """
    v, k, g, r, c = np.broadcast_arrays(speed, point.curvature, point.gradient, gradient_rate, point.cant)
    rate = [
        yaw_rate_kernel(*row) for row in np.column_stack([a.ravel() for a in (v, k, g, r, c)]).astype(float).tolist()
    ]
    return np.array(rate).reshape(v.shape)


def specific_force(
    speed: ArrayLike,
    acceleration: ArrayLike,
    point: TrackPoints,
    *,
    gradient_rate: ArrayLike = 0.0,
    gravity: float = STANDARD_GRAVITY,
) -> FloatArray:
    """Specific force on a vehicle that follows the track: forward, right, down, m/s^2.

    f_x = a + g sin(alpha); f_y = v^2 kappa cos(alpha) cos(phi) - (g cos(alpha) + v^2 kappa_v) sin(phi);
    f_z = -(v^2 kappa cos(alpha) sin(phi) + (g cos(alpha) + v^2 kappa_v) cos(phi)).

    Parameters
    ----------
    speed, acceleration : float or (m,) array
        Along the offset, m/s and m/s^2.
    point : TrackPoints
        Geometry there.
    gradient_rate : float or (m,) array
        d(gradient)/d(offset), 1/m.
    gravity : float
        m/s^2.

    Returns
    -------
    (m, 3) array
        At rest on level track (0, 0, -g).

    References
    ----------
    Specification rail.md 19.3, rows "long., lateral, vertical accelerometer".
    """
    v, a, k, g, r, c = np.broadcast_arrays(
        speed, acceleration, point.curvature, point.gradient, gradient_rate, point.cant
    )
    rows = np.column_stack([part.ravel() for part in (v, a, k, g, r, c)]).astype(float)
    out = np.empty((len(rows), 3))
    for i, row in enumerate(rows.tolist()):
        specific_force_kernel(*row, gravity, out[i])
    return out.reshape(*v.shape, 3)
