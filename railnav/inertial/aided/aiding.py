"""What aids a strapdown: GNSS fixes, satellites, the vehicle's own motion and its rests; frozen, checked when they are made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import dcm_from_quaternion
from railnav.inertial.mechanization import EARTH_RATE, NavigationState

FloatArray = NDArray[np.float64]
_NOTHING = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """GNSS positions and velocities of the antenna.

    Attributes
    ----------
    time : (m,) array
        s, increasing.
    position : (m, 3) array
        Latitude, longitude, height, rad, rad, m.
    sigma_position : (3,) or (m, 3) array
        North, east, up, m; infinite where a component is not to be used.
    velocity_n : (m, 3) array or None
        North, east, down, m/s.
    sigma_velocity : (3,) or (m, 3) array
        m/s; infinite where a component is not to be used.
    """

    time: FloatArray
    position: FloatArray
    sigma_position: FloatArray
    velocity_n: FloatArray | None = None
    sigma_velocity: FloatArray | None = None

    def __post_init__(self) -> None:
        m = _times(self)
        _set(self, "position", _rows("position", self.position, m, 3))
        _set(self, "sigma_position", _sigmas("sigma_position", self.sigma_position, (m, 3)))
        if len(self.position) and np.abs(self.position[:, 0]).max() > np.pi / 2:
            raise ValueError("a fix lies beyond the pole: latitudes are in radians")
        if (self.velocity_n is None) != (self.sigma_velocity is None):
            raise ValueError("velocity_n and sigma_velocity come together")
        if self.velocity_n is not None:
            _set(self, "velocity_n", _rows("velocity_n", self.velocity_n, m, 3))
            _set(self, "sigma_velocity", _sigmas("sigma_velocity", self.sigma_velocity, (m, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class VehicleMotion:
    """Odometer speed and non-holonomic constraint: a vehicle on wheels moves along its nose.

    Attributes
    ----------
    time : (m,) array
        s, increasing.
    forward : (m,) array or None
        Speed of the odometer, m/s, negative backwards; None: the constraint alone.
    sigma_forward : float or (m,) array
        m/s.
    sigma_lateral, sigma_vertical : float or (m,) array
        Of the speed across, m/s; infinite where it is not to be used.
    """

    time: FloatArray
    forward: FloatArray | None = None
    sigma_forward: FloatArray | float = np.inf
    sigma_lateral: FloatArray | float = 0.1
    sigma_vertical: FloatArray | float = 0.1

    def __post_init__(self) -> None:
        m = _times(self)
        if self.forward is not None:
            _set(self, "forward", _rows("forward", np.asarray(self.forward)[:, None], m, 1)[:, 0])
        for name in ("sigma_forward", "sigma_lateral", "sigma_vertical"):
            _set(self, name, _sigmas(name, getattr(self, name), (m,)))


@dataclass(frozen=True, slots=True, eq=False)
class Rests:
    """Instants at which the vehicle stands: zero velocity, and the gyros read their biases and the Earth's rate.

    Attributes
    ----------
    time : (m,) array
        s, increasing.
    rate_ib_b : (m, 3) array or None
        Mean of the gyros about that time, rad/s.
    sigma_velocity : float
        m/s.
    sigma_rate : float
        rad/s.
    """

    time: FloatArray
    rate_ib_b: FloatArray | None = None
    sigma_velocity: float = 0.02
    sigma_rate: float = 1e-3

    def __post_init__(self) -> None:
        m = _times(self)
        if self.rate_ib_b is not None:
            _set(self, "rate_ib_b", _rows("rate_ib_b", self.rate_ib_b, m, 3))
        if not (self.sigma_velocity > 0.0 and self.sigma_rate > 0.0):
            raise ValueError("sigmas of rests must be positive")


@dataclass(frozen=True, slots=True, eq=False)
class Ranges:
    """Pseudoranges and their rates, one row a satellite and instant.

    Attributes
    ----------
    time : (m,) array
        s, not decreasing.
    satellite_position, satellite_velocity : (m, 3) array
        Earth-centred, Earth-fixed, at the instant of the measurement, m and m/s.
    pseudorange, range_rate : (m,) array
        Corrected for the satellite's clock and the atmosphere: distance + receiver clock, m; its rate, m/s.
    sigma_range, sigma_rate : float or (m,) array
        m, m/s.
    """

    time: FloatArray
    satellite_position: FloatArray
    satellite_velocity: FloatArray
    pseudorange: FloatArray
    range_rate: FloatArray
    sigma_range: FloatArray | float = 2.0
    sigma_rate: FloatArray | float = 0.05

    def __post_init__(self) -> None:
        m = _times(self, repeated=True)
        for name in ("satellite_position", "satellite_velocity"):
            _set(self, name, _rows(name, getattr(self, name), m, 3))
        for name in ("pseudorange", "range_rate"):
            _set(self, name, _rows(name, np.asarray(getattr(self, name))[:, None], m, 1)[:, 0])
        for name in ("sigma_range", "sigma_rate"):
            _set(self, name, _sigmas(name, getattr(self, name), (m,)))


def find_rests(
    time: ArrayLike,
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    *,
    window: float = 1.0,
    every: float = 0.2,
    rate_spread: float | None = None,
    force_spread: float | None = None,
    sigma_velocity: float = 0.02,
) -> Rests:
    """Rests of a vehicle by the quiet of its IMU: the spread of rate and force in a window stays near the quietest of the log.

    Parameters
    ----------
    time : (n,) array
        s.
    rate_ib_b, specific_force_b : (n, 3) array
        rad/s, m/s^2.
    window : float, optional
        s; windows end at their instant.
    every : float, optional
        Step between the instants given, s.
    rate_spread, force_spread : float, optional
        Largest standard deviation, root of the sum over axes, of a rest, rad/s and m/s^2. Default: twice that of the
        quietest windows of the log, which needs one that rests somewhere and moves elsewhere: otherwise an empty `Rests`.
    sigma_velocity : float, optional
        m/s.

    Returns
    -------
    Rests

    Raises
    ------
    ValueError
        Wrong shapes.

    Notes
    -----
    Smooth running at constant speed looks like rest to an IMU: let GNSS or an odometer confirm the instants where it can.

    Examples
    --------
    >>> t = np.arange(0, 20, 0.01)
    >>> shake = np.where(t > 10, 1.0, 0.01)[:, None] * np.random.default_rng(0).normal(size=(len(t), 3))
    >>> rests = find_rests(t, 0.01 * shake, shake)
    >>> bool(8 < rests.time[-1] <= 10)
    True
    """
    t = np.asarray(time, dtype=np.float64)
    w, f = np.asarray(rate_ib_b, dtype=np.float64), np.asarray(specific_force_b, dtype=np.float64)
    if t.ndim != 1 or w.shape != (len(t), 3) or f.shape != (len(t), 3):
        raise ValueError("needs one time, rate and specific force a sample")
    if len(t) < 10 or t[-1] - t[0] < 2 * window:
        return Rests(np.empty(0), np.empty((0, 3)), sigma_velocity)
    ends = np.arange(t[0] + window, t[-1], every)
    high, low = np.searchsorted(t, ends, side="right"), np.searchsorted(t, ends - window, side="left")
    count = high - low
    spread, mean_w = [], np.empty((0, 3))
    for k, x in enumerate((w, f)):
        centre = x.mean(axis=0)
        one = np.vstack([_NOTHING, np.cumsum(x - centre, axis=0)])
        two = np.vstack([_NOTHING, np.cumsum((x - centre) ** 2, axis=0)])
        mean = (one[high] - one[low]) / np.maximum(count, 1)[:, None]
        variance = (two[high] - two[low]) / np.maximum(count, 1)[:, None] - mean**2
        spread.append(np.sqrt(np.maximum(variance, 0.0).sum(axis=1)))
        if k == 0:
            mean_w = mean + centre
    full = count > 0.5 * np.median(count)
    limits = []
    for given, s in zip((rate_spread, force_spread), spread, strict=True):
        limits.append(2.0 * float(np.percentile(s[full], 0.1)) if given is None else given)
    still = full & (spread[0] < limits[0]) & (spread[1] < limits[1])
    if (rate_spread is None or force_spread is None) and still.sum() > 0.9 * full.sum():
        return Rests(np.empty(0), np.empty((0, 3)), sigma_velocity)
    noise = float(np.median(spread[0][still])) / np.sqrt(3.0) if still.any() else 1e-3
    sigma_rate = max(noise / np.sqrt(max(float(np.median(count)), 1.0)) * 3.0, 1e-6)
    return Rests(ends[still], mean_w[still], sigma_velocity, sigma_rate)


def without_lever_arm(
    state: NavigationState, arm_b: ArrayLike, rate_ib_b: ArrayLike = (0.0, 0.0, 0.0)
) -> NavigationState:
    """State of the point an arm away: from the antenna to the IMU give the arm antenna to IMU.

    Parameters
    ----------
    state : NavigationState
        Of one point of a rigid body.
    arm_b : (3,) array
        From it to the other point, m.
    rate_ib_b : (3,) array, optional
        Of the body, rad/s.

    Returns
    -------
    NavigationState

    References
    ----------
    `spec/inertial.md` KZ(2.18), KZ(2.19).

    Examples
    --------
    >>> without_lever_arm(NavigationState(0.9, 0.0, 100.0), [0.0, 0.0, 3.0]).height
    97.0
    """
    from railnav.inertial.error_model import position_scale

    arm, C = np.asarray(arm_b, dtype=np.float64), dcm_from_quaternion(state.quaternion_nb)
    earth = EARTH_RATE * np.array([np.cos(state.latitude), 0.0, -np.sin(state.latitude)])
    offset = C @ arm
    step = offset * [1.0, 1.0, -1.0] / position_scale(state)
    velocity = state.velocity_n + C @ np.cross(
        np.asarray(rate_ib_b, dtype=np.float64) - C.T @ earth * np.any(rate_ib_b), arm
    )
    return NavigationState(
        state.latitude + float(step[0]),
        state.longitude + float(step[1]),
        state.height + float(step[2]),
        velocity,
        state.quaternion_nb,
    )


def _set(value: object, name: str, array: FloatArray) -> None:
    object.__setattr__(value, name, array)


def _times(value: Fixes | VehicleMotion | Rests | Ranges, *, repeated: bool = False) -> int:
    t = np.array(value.time, dtype=np.float64)
    step = np.diff(t)
    if t.ndim != 1 or not np.isfinite(t).all() or np.any(step < 0.0 if repeated else step <= 0.0):
        raise ValueError(f"times of {type(value).__name__} must be finite and increase: sort the rows")
    _set(value, "time", t)
    return len(t)


def _rows(name: str, value: ArrayLike, rows: int, columns: int) -> FloatArray:
    x = np.array(value, dtype=np.float64)
    if x.shape != (rows, columns):
        raise ValueError(f"{name} must have the shape ({rows}, {columns}), not {x.shape}: one row a time")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if bad.size:
        raise ValueError(f"{name} of row {bad[0]} is not finite; leave the row out")
    return x


def _sigmas(name: str, value: ArrayLike | None, shape: tuple[int, ...]) -> FloatArray:
    s = np.array(np.broadcast_to(np.asarray(value, dtype=np.float64), shape))
    if np.isnan(s).any() or np.any(s <= 0.0):
        raise ValueError(f"{name} must be positive; infinite where a component is not to be used")
    return s
