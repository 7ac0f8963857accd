"""Latitude and longitude of a moving base from its gyros and a known attitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import dcm_from_euler
from railnav.inertial.mechanization import EARTH_RATE
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]


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
