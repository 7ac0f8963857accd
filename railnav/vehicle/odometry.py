"""Odometry: from wheel ticks, wheel rates and steering angles to speed, turn rate and a plane track; wheel radius from GNSS."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError

FloatArray = NDArray[np.float64]
Integration = Literal["arc", "midpoint", "euler"]

#: Turn in a step below which an arc counts as straight, rad.
_STRAIGHT = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class PlanarMotion:
    """Speed of the reference point along the nose and rate of turn.

    Attributes
    ----------
    speed : (...) array
        m/s, negative backwards.
    turn_rate : (...) array
        rad/s, positive to the right.
    """

    speed: FloatArray
    turn_rate: FloatArray


@dataclass(frozen=True, slots=True)
class WheelScale:
    """True distance over odometer distance: multiply the metres per tick, or the wheel radius, by it.

    Attributes
    ----------
    scale, sigma : float
        And its standard deviation.
    used, rejected : int
        Samples used, and left out as slip or spin.
    chi_square : float
        Mean square of the normalised residuals of those used: about 1 if the sigmas are right.
    """

    scale: float
    sigma: float
    used: int
    rejected: int
    chi_square: float


def ticks_to_distance(ticks: ArrayLike, metres_per_tick: float, *, modulus: int | None = None) -> FloatArray:
    """Distance between successive readings of a tick counter, signed, across its wrap.

    Parameters
    ----------
    ticks : (n,) array of int
        Counter; signed direction counts down.
    metres_per_tick : float
        m, 2 pi radius over ticks a turn.
    modulus : int, optional
        Counts after which the counter starts again: steps are taken the short way round.

    Returns
    -------
    (n - 1,) array
        m.

    Raises
    ------
    ValueError
        Wrong shape, values that are not finite, metres per tick or modulus not positive.
    EstimationError
        A step of a quarter of the modulus or more: its direction is in doubt, read the counter more often.

    References
    ----------
    `spec/inertial.md` B4, KZ(1.60), KZ(1.62) and edge cases.

    Examples
    --------
    >>> ticks_to_distance([65530, 4, 14], 0.01, modulus=65536).round(6)
    array([0.1, 0.1])
    """
    t = np.asarray(ticks, dtype=np.float64)
    if t.ndim != 1 or not np.isfinite(t).all():
        raise ValueError(f"ticks must be a finite array of the shape (n,), not {t.shape}")
    if not (math.isfinite(metres_per_tick) and metres_per_tick > 0.0):
        raise ValueError(f"metres_per_tick is {metres_per_tick}; it must be positive")
    step = np.diff(t)
    if modulus is not None:
        if modulus <= 0:
            raise ValueError(f"modulus is {modulus}; it must be positive")
        step = np.mod(step + 0.5 * modulus, modulus) - 0.5 * modulus
        wide = np.flatnonzero(np.abs(step) >= 0.25 * modulus)
        if wide.size:
            raise EstimationError(
                f"the counter moves by {step[wide[0]]:.0f} of {modulus} ticks before reading {wide[0] + 1}: "
                "too far to know the direction; read it more often or check the modulus"
            )
    return np.asarray(step * metres_per_tick)


def two_wheels(left: ArrayLike, right: ArrayLike, *, track: float) -> PlanarMotion:
    """Motion of an axle from the speeds of its wheels: u = (v_R + v_L)/2, turn rate = (v_L - v_R)/track.

    Parameters
    ----------
    left, right : float or (...) array
        Speeds of the wheels over ground, m/s (radius times rate).
    track : float
        Distance between the wheels, m.

    Returns
    -------
    PlanarMotion

    Raises
    ------
    ValueError
        A value that is not finite, or a track that is not positive.

    Notes
    -----
    Half a per cent between the radii on a track of 1.2 m turns the heading by 239 degrees a kilometre: take the turn rate from a gyro.
    The source counts headings the other way round.

    References
    ----------
    `spec/inertial.md` B4, KZ(1.53), KZ(1.61).

    Examples
    --------
    >>> two_wheels(6.0, 5.4, track=1.5).turn_rate.round(6)
    np.float64(0.4)
    """
    v_left, v_right = _finite("left", left), _finite("right", right)
    if not (math.isfinite(track) and track > 0.0):
        raise ValueError(f"track is {track} m; it must be positive")
    return PlanarMotion(np.asarray(0.5 * (v_left + v_right))[()], np.asarray((v_left - v_right) / track)[()])


def tricycle(
    speed: ArrayLike, steering: ArrayLike, *, wheelbase: float, driven: Literal["rear", "front"] = "rear"
) -> PlanarMotion:
    """Motion of the rear axle of a vehicle that steers at the front.

    Rear drive: u = v, turn rate = v tan(phi)/L. Front drive: u = v cos(phi), turn rate = v sin(phi)/L.

    Parameters
    ----------
    speed : float or (...) array
        Of the driven axle, m/s.
    steering : float or (...) array
        phi, positive to the right, less than a right angle, rad.
    wheelbase : float
        L, m.
    driven : {"rear", "front"}, optional
        Where the speed is measured.

    Returns
    -------
    PlanarMotion

    Raises
    ------
    ValueError
        A value that is not finite, a steering angle of a right angle or more, a wheelbase that is not positive.

    References
    ----------
    `spec/inertial.md` B4, KZ(1.58), KZ(1.59).

    Examples
    --------
    >>> tricycle(5.0, np.radians(20.0), wheelbase=2.5, driven="front").speed.round(9)
    np.float64(4.698463104)
    """
    v, phi = _finite("speed", speed), _finite("steering", steering)
    if np.any(np.abs(phi) >= 0.5 * math.pi):
        raise ValueError("a steering angle of a right angle or more has no turning circle; is it in degrees?")
    if not (math.isfinite(wheelbase) and wheelbase > 0.0):
        raise ValueError(f"wheelbase is {wheelbase} m; it must be positive")
    if driven == "rear":
        return PlanarMotion(v[()], np.asarray(v * np.tan(phi) / wheelbase)[()])
    if driven == "front":
        return PlanarMotion(np.asarray(v * np.cos(phi))[()], np.asarray(v * np.sin(phi) / wheelbase)[()])
    raise ValueError(f"driven is 'rear' or 'front', not {driven!r}")


def minimum_radius(steering: float, wheelbase: float) -> float:
    """Smallest radius of turn of the rear axle, L/tan(phi_max), m; KZ(1.57).

    Examples
    --------
    >>> round(minimum_radius(math.radians(30.0), 2.5), 6)
    4.330127
    """
    return wheelbase / math.tan(steering)


def dead_reckon(
    speed: ArrayLike,
    turn_rate: ArrayLike,
    interval: ArrayLike,
    *,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    integration: Integration = "arc",
) -> FloatArray:
    """Plane track of a vehicle from its speed and turn rate, each constant over its interval.

    Parameters
    ----------
    speed, turn_rate : (n,) array
        m/s and rad/s, positive to the right (of wheels or a gyro).
    interval : float or (n,) array
        s.
    start : tuple of float, optional
        North, east, heading: m, m, rad.
    integration : {"arc", "midpoint", "euler"}, optional
        Exact arc; chord in the mean heading (second order); heading held as the source has it (first order).

    Returns
    -------
    (n + 1, 3) array
        North, east, heading (not wrapped) before the first and after each step.

    Raises
    ------
    ValueError
        Shapes that do not fit, values that are not finite, an interval that is not positive.

    Notes
    -----
    Distance along a slope is not level distance: multiply the speed by the cosine of the pitch. The end error of a run without GNSS is
    the heading error times the distance from the start, not times the way.

    References
    ----------
    `spec/inertial.md` B4, KZ(1.56), KZ(1.62) to KZ(1.64).

    Examples
    --------
    >>> dead_reckon([np.pi / 2], [np.pi / 2], 1.0)[-1].round(6)  # a quarter of a circle of 1 m to the right
    array([1.      , 1.      , 1.570796])
    """
    u, w = _finite("speed", speed), _finite("turn_rate", turn_rate)
    if u.ndim != 1 or u.shape != w.shape:
        raise ValueError(f"speed and turn_rate must have one shape (n,), not {u.shape} and {w.shape}")
    h = np.broadcast_to(_finite("interval", interval), u.shape)
    wrong = np.flatnonzero(h <= 0.0)
    if wrong.size:
        raise ValueError(f"interval of step {wrong[0]} is {h[wrong[0]]:g} s; it must be positive")
    turn = w * h
    heading = start[2] + np.concatenate([[0.0], np.cumsum(turn)])
    if integration == "arc":  # the chord of the arc lies in the mean heading and is sin(x)/x of it long
        half = 0.5 * turn
        chord = np.where(np.abs(turn) < _STRAIGHT, 1.0, np.sinc(half / math.pi))
        direction = heading[:-1] + half
    elif integration in ("midpoint", "euler"):
        chord = np.ones_like(u)
        direction = heading[:-1] + (0.5 * turn if integration == "midpoint" else 0.0)
    else:
        raise ValueError(f"integration is 'arc', 'midpoint' or 'euler', not {integration!r}")
    way = u * h * chord
    north = start[0] + np.concatenate([[0.0], np.cumsum(way * np.cos(direction))])
    east = start[1] + np.concatenate([[0.0], np.cumsum(way * np.sin(direction))])
    return np.stack([north, east, heading], axis=-1)


def fit_wheel_scale(
    reference_speed: ArrayLike,
    odometer_speed: ArrayLike,
    *,
    reference_sigma: float,
    odometer_sigma: float = 0.0,
    slowest: float = 1.0,
    reject: float = 4.0,
) -> WheelScale:
    """Scale of an odometer against GNSS speeds: weighted least squares through zero, without slip.

    Parameters
    ----------
    reference_speed, odometer_speed : (n,) array
        At the same times, m/s; signs alike.
    reference_sigma, odometer_sigma : float
        Standard deviations, m/s.
    slowest : float, optional
        Odometer speeds below are left out: GNSS ground speed is biased upwards near rest, m/s.
    reject : float, optional
        Residuals beyond this many sigma count as slip or spin and are left out, the worst first.

    Returns
    -------
    WheelScale

    Raises
    ------
    ValueError
        Shapes that do not fit, values that are not finite, a sigma that is not positive.
    EstimationError
        Fewer than ten speeds left, or more than a third of them rejected: times that do not fit, or a wrong unit.

    References
    ----------
    `spec/inertial.md` B4, systematic errors.

    Examples
    --------
    >>> v = np.linspace(5.0, 25.0, 50)
    >>> round(fit_wheel_scale(1.01 * v, v, reference_sigma=0.1).scale, 6)
    1.01
    """
    z, v = _finite("reference_speed", reference_speed), _finite("odometer_speed", odometer_speed)
    if z.ndim != 1 or z.shape != v.shape:
        raise ValueError(f"needs two arrays of one shape (n,), not {z.shape} and {v.shape}")
    if not (reference_sigma > 0.0 and odometer_sigma >= 0.0):
        raise ValueError("reference_sigma must be positive, odometer_sigma not negative")
    sigma = math.hypot(reference_sigma, odometer_sigma)
    moving = np.abs(v) >= slowest
    z, v = z[moving], v[moving]
    if len(v) < 10:
        raise EstimationError(f"{len(v)} speeds above {slowest:g} m/s are too few; ten are needed")
    scale = float(np.median(z / v))
    keep = np.ones(len(v), dtype=bool)
    for _ in range(20):
        new = np.abs(z - scale * v) <= reject * sigma
        if new.sum() < 10 or new.sum() < 2 * len(v) / 3:
            raise EstimationError(
                f"{len(v) - int(new.sum())} of {len(v)} speeds disagree with a scale of {scale:.3f} by more than {reject:g} sigma: "
                "check the clocks, the units and the sigmas"
            )
        scale = float((z[new] @ v[new]) / (v[new] @ v[new]))
        if np.array_equal(new, keep):
            break
        keep = new
    residual = (z[keep] - scale * v[keep]) / sigma
    used = int(keep.sum())
    return WheelScale(
        scale, sigma / math.sqrt(float(v[keep] @ v[keep])), used, len(v) - used, float(residual @ residual / (used - 1))
    )


def _finite(name: str, value: ArrayLike) -> FloatArray:
    x = np.asarray(value, dtype=np.float64)
    if not np.isfinite(x).all():
        raise ValueError(f"{name} holds a value that is not finite")
    return x
