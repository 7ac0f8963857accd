"""Initial attitude at rest: level from specific force, heading from the Earth's rotation.

Everything comes with its sigma. A base that moves is refused with the evidence; a heading that the gyros cannot find is not given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import dcm_from_euler
from railnav.errors import EstimationError
from railnav.inertial._shapes import three
from railnav.inertial.compass import compass_heading, gyrocompass
from railnav.inertial.mechanization import EARTH_RATE
from railnav.inertial.resting import Rest

FloatArray = NDArray[np.float64]

#: Coarser than this a gyrocompass heading is not worth giving, rad.
WORST_HEADING = math.radians(30.0)


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
    C, arm = np.asarray(C_nb, dtype=np.float64), three("lever_arm_b", lever_arm_b)
    w = np.zeros(3) if isinstance(rate_nb_b, int) else three("rate_nb_b", rate_nb_b)
    return np.asarray(C @ arm), np.asarray(C @ np.cross(w, arm))
