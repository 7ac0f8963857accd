"""How errors grow while nothing aids: the position error of a free inertial leg, term by term."""

from __future__ import annotations

import math
from dataclasses import dataclass

from railnav.units import STANDARD_GRAVITY


@dataclass(frozen=True, slots=True)
class LegError:
    """Position error at the end of a leg of constant heading, m, by cause.

    Attributes
    ----------
    position, velocity : float
        Of the start.
    accelerometer_bias, gyro_bias : float
        Of constant biases.
    tilt, heading : float
        Of the attitude at the start: along, and across.
    accelerometer_scale, gyro_scale : float
        Of scale errors under the acceleration and the turn of the leg.
    """

    position: float
    velocity: float
    accelerometer_bias: float
    gyro_bias: float
    tilt: float
    heading: float
    accelerometer_scale: float
    gyro_scale: float

    @property
    def total(self) -> float:
        """Sum of all terms, the worst case of their signs if all are given positive, m."""
        return math.fsum(getattr(self, name) for name in self.__slots__)

    @property
    def root_sum_square(self) -> float:
        """The same if they are independent sigmas, m."""
        return math.hypot(*(getattr(self, name) for name in self.__slots__))


def leg_error(
    duration: float,
    *,
    position: float = 0.0,
    velocity: float = 0.0,
    accelerometer_bias: float = 0.0,
    gyro_bias: float = 0.0,
    tilt: float = 0.0,
    heading: float = 0.0,
    speed: float = 0.0,
    accelerometer_scale: float = 0.0,
    acceleration: float = 0.0,
    gyro_scale: float = 0.0,
    turn: float = 0.0,
    gravity: float = STANDARD_GRAVITY,
) -> LegError:
    """Position error of a free inertial leg.

    dP0 + dV0 T + b_a T^2/2 + b_g g T^3/6 + tilt g T^2/2 + dH V T + SF_a F T^2/2 + SF_g turn V T/2.

    Parameters
    ----------
    duration : float
        T, s.
    position, velocity : float, optional
        Errors at the start, m, m/s.
    accelerometer_bias, gyro_bias : float, optional
        m/s^2, rad/s.
    tilt, heading : float, optional
        Errors of the attitude at the start, rad.
    speed : float, optional
        m/s.
    accelerometer_scale, acceleration : float, optional
        Scale error and the acceleration of the leg, m/s^2.
    gyro_scale, turn : float, optional
        Scale error and the total turn of the leg, rad.
    gravity : float, optional
        m/s^2.

    Returns
    -------
    LegError

    Raises
    ------
    ValueError
        A duration that is negative or not finite.

    Notes
    -----
    Good for some minutes: 1 mg makes 441 m by the formula and 436 m by the full equations after 300 s, where the Schuler loop begins to
    turn
    errors back; the error of a bias never exceeds 2 (b/g) R, 1,274 m for 0.1 mg.

    References
    ----------
    `spec/inertial.md` B2, KZ(1.20) to KZ(1.26), KZ(2.26).

    Examples
    --------
    >>> round(leg_error(60.0, accelerometer_bias=9.81e-3).total, 3)
    17.658
    """
    T = float(duration)
    if not (math.isfinite(T) and T >= 0.0):
        raise ValueError(f"duration is {duration}; it must not be negative")
    return LegError(
        position,
        velocity * T,
        accelerometer_bias * T**2 / 2.0,
        gyro_bias * gravity * T**3 / 6.0,
        tilt * gravity * T**2 / 2.0,
        heading * speed * T,
        accelerometer_scale * acceleration * T**2 / 2.0,
        gyro_scale * turn * speed * T / 2.0,
    )
