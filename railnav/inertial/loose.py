"""Loosely coupled, closed loop: strapdown, a square-root filter of fifteen errors, and GNSS positions and velocities."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.inertial.error_model import position_scale
from railnav.inertial.mechanization import GravityField, NavigationState, Trajectory

FloatArray = NDArray[np.float64]

#: Chi-square of one degree of freedom at 0.9999: a fix component beyond it is left out.
GATE = 15.137


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise of an IMU as the filter takes it.

    Attributes
    ----------
    angle_random_walk, velocity_random_walk : float
        rad/sqrt(s), m/s/sqrt(s).
    gyro_instability, accelerometer_instability : float
        Sigma of the in-run biases, first-order Gauss-Markov, rad/s and m/s^2.
    gyro_correlation_time, accelerometer_correlation_time : float
        s.
    """

    angle_random_walk: float
    velocity_random_walk: float
    gyro_instability: float = 0.0
    accelerometer_instability: float = 0.0
    gyro_correlation_time: float = 600.0
    accelerometer_correlation_time: float = 600.0

    def __post_init__(self) -> None:
        for name in ("angle_random_walk", "velocity_random_walk", "gyro_instability", "accelerometer_instability"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must not be negative")
        for name in ("gyro_correlation_time", "accelerometer_correlation_time"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")


@dataclass(frozen=True, slots=True, eq=False)
class InitialSigma:
    """Standard deviations of the state before the first sample.

    Attributes
    ----------
    position : (3,) array
        North, east, up, m.
    velocity : (3,) array
        North, east, down, m/s.
    attitude : (3,) array
        Small turn about north, east, down, rad.
    gyro_bias, accelerometer_bias : float
        rad/s, m/s^2.
    """

    position: FloatArray
    velocity: FloatArray
    attitude: FloatArray
    gyro_bias: float
    accelerometer_bias: float


@dataclass(frozen=True, slots=True, eq=False)
class LooseSolution:
    """What the filter knew after each sample.

    Attributes
    ----------
    trajectory : Trajectory
        States before the first and after every sample.
    gyro_bias, accelerometer_bias : (n + 1, 3) array
        Estimates, rad/s and m/s^2.
    sigma : (n + 1, 15) array
        Of the errors in the order of `ErrorState`, but position in metres north, east, up.
    nis : (m, 6) array
        Normalised innovation squared of each component of each fix, in order, the later given the earlier: 1 on average.
    used : (m, 6) bool array
        Components let in.
    fix : (m,) int array
        Index of each of these fixes in what was given.
    P_sqrt : (15, 15) array
        Root of the covariance at the end, `ErrorState`.
    """

    trajectory: Trajectory
    gyro_bias: FloatArray
    accelerometer_bias: FloatArray
    sigma: FloatArray
    nis: FloatArray
    used: NDArray[np.bool_]
    fix: NDArray[np.int64]
    P_sqrt: FloatArray


def integrate_gnss(
    start: NavigationState,
    initial: InitialSigma,
    time: ArrayLike,
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    noise: ImuNoise,
    *,
    start_time: float,
    fix_time: ArrayLike,
    fix_position: ArrayLike,
    fix_velocity_n: ArrayLike,
    sigma_position: ArrayLike,
    sigma_velocity: ArrayLike,
    lever_arm_b: ArrayLike = (0.0, 0.0, 0.0),
    gravity: GravityField | None = None,
    gate: float = GATE,
) -> LooseSolution:
    """Integrate an IMU and let GNSS fixes correct it: the closed loop of the source, with the covariance carried at every sample as a root.

    Parameters
    ----------
    start : NavigationState
        Of the IMU at `start_time`.
    initial : InitialSigma
        How well it is known.
    time : (n,) array
        End of the interval of each sample, s, increasing from `start_time`.
    rate_ib_b, specific_force_b : (n, 3) array
        Means over the intervals, rad/s and m/s^2.
    noise : ImuNoise
        Of the IMU.
    start_time : float
        s.
    fix_time : (m,) array
        s, increasing; fixes outside the samples are left out (`LooseSolution.fix` names the others).
    fix_position : (m, 3) array
        Latitude, longitude, height of the antenna, rad, rad, m.
    fix_velocity_n : (m, 3) array
        North, east, down, m/s.
    sigma_position, sigma_velocity : (3,) or (m, 3) array
        North, east, up, m; north, east, down, m/s.
    lever_arm_b : (3,) array, optional
        IMU to antenna, forward, right, down, m.
    gravity : GravityField, optional
        Default: WGS 84.
    gate : float, optional
        Chi-square beyond which a component of a fix is left out.

    Returns
    -------
    LooseSolution

    Raises
    ------
    ValueError
        Wrong shapes, values that are not finite, times that do not increase, a sigma that is not positive.
    EstimationError
        A sample interval above 0.5 s, within 0.1 degrees of a pole, or every component of ten fixes in a row refused by the gate.

    Notes
    -----
    A fix between two samples is compared at the later one, carried there by the velocity: right to half the acceleration times the square
    of the sample interval. Innovations are predicted - measured inside, as the errors are estimate - truth; only their squares are given.
    GNSS errors are taken as white; real ones are not: multiply their variances (the source's experiments behave as with ten).

    References
    ----------
    `spec/inertial.md` B6, B7 (loose, closed loop), B10.

    Examples
    --------
    >>> start, zero = NavigationState(0.9, 0.0, 0.0), np.zeros((100, 3))
    >>> initial = InitialSigma(np.full(3, 5.0), np.full(3, 0.1), np.full(3, 0.01), 1e-6, 1e-3)
    >>> rest = zero + np.array([7.292115e-5 * np.cos(0.9), 0.0, -7.292115e-5 * np.sin(0.9)]), zero - GravityField().vector(0.9)
    >>> fixes = {"fix_time": [0.5], "fix_position": [[0.9, 0.0, 0.0]], "fix_velocity_n": [[0.0, 0.0, 0.0]]}
    >>> out = integrate_gnss(start, initial, np.arange(1, 101) * 0.01, *rest, ImuNoise(1e-5, 1e-4), start_time=0.0, **fixes,
    ...     sigma_position=[1.0, 1.0, 1.0], sigma_velocity=[0.1, 0.1, 0.1])
    >>> out.sigma[-1, :3].round(1)
    array([1., 1., 1.])
    """
    from railnav.inertial._kernels import loose_kernel

    t = np.asarray(time, dtype=np.float64)
    w, f = _table("rate_ib_b", rate_ib_b), _table("specific_force_b", specific_force_b)
    if t.ndim != 1 or not len(t) == len(w) == len(f) or not len(t):
        raise ValueError(f"needs one time, rate and specific force a sample, not {t.shape}, {w.shape}, {f.shape}")
    interval = np.diff(t, prepend=start_time)
    wrong = np.flatnonzero(~(interval > 0.0))
    if wrong.size:
        raise ValueError(f"time does not increase at sample {wrong[0]}: sort the samples, and start before the first")
    if interval.max() > 0.5:
        raise EstimationError(
            f"{interval.max():.2f} s between samples {int(np.argmax(interval)) - 1} and {int(np.argmax(interval))}: cut the log there"
        )
    stamps = np.asarray(fix_time, dtype=np.float64)
    position, velocity = _table("fix_position", fix_position), _table("fix_velocity_n", fix_velocity_n)
    if stamps.ndim != 1 or not len(stamps) == len(position) == len(velocity):
        raise ValueError(
            f"needs one time, position and velocity a fix, not {stamps.shape}, {position.shape}, {velocity.shape}"
        )
    if not np.isfinite(stamps).all() or np.any(np.diff(stamps) <= 0.0):
        raise ValueError("fix_time must be finite and increase")
    if len(position) and np.abs(position[:, 0]).max() > math.pi / 2:
        raise ValueError("a fix lies beyond the pole: latitudes are in radians")
    variance = np.empty((len(stamps), 6))
    for name, sigmas, place in (
        ("sigma_position", sigma_position, slice(0, 3)),
        ("sigma_velocity", sigma_velocity, slice(3, 6)),
    ):
        s = np.broadcast_to(np.asarray(sigmas, dtype=np.float64), (len(stamps), 3))
        if not (np.isfinite(s).all() and np.all(s > 0.0)):
            raise ValueError(f"{name} must be positive and finite")
        variance[:, place] = s * s
    inside = np.flatnonzero((stamps > start_time) & (stamps <= t[-1]))
    row = np.searchsorted(t, stamps[inside], side="left")
    arm = np.asarray(lever_arm_b, dtype=np.float64)
    if arm.shape != (3,) or not np.isfinite(arm).all():
        raise ValueError("lever_arm_b must be three finite numbers")
    scale = position_scale(start, gravity)
    sigma0 = np.concatenate(
        [
            np.asarray(initial.position, dtype=np.float64) / scale,
            np.asarray(initial.velocity, dtype=np.float64),
            np.asarray(initial.attitude, dtype=np.float64),
            np.full(3, initial.gyro_bias),
            np.full(3, initial.accelerometer_bias),
        ]
    )
    if sigma0.shape != (15,) or not (np.isfinite(sigma0).all() and np.all(sigma0 > 0.0)):
        raise ValueError("initial sigmas must be three, three, three and two positive numbers")
    P_sqrt = np.diag(sigma0)
    times = np.array([noise.gyro_correlation_time, noise.accelerometer_correlation_time])
    densities = np.array(
        [
            noise.velocity_random_walk,
            noise.angle_random_walk,
            noise.gyro_instability * math.sqrt(2.0 / times[0]),
            noise.accelerometer_instability * math.sqrt(2.0 / times[1]),
        ]
    )
    n, m = len(t), len(inside)
    out, bias, sigma = np.empty((n + 1, 10)), np.zeros((n + 1, 6)), np.empty((n + 1, 15))
    out[0] = [start.latitude, start.longitude, start.height, *start.velocity_n, *start.quaternion_nb]
    sigma[0] = sigma0
    nis, used = np.zeros((m, 6)), np.zeros((m, 6), dtype=np.bool_)
    done = loose_kernel(
        w * interval[:, None],
        f * interval[:, None],
        interval,
        (gravity or GravityField()).flat(),
        P_sqrt,
        densities,
        times,
        arm,
        row,
        t[row] - stamps[inside],
        np.ascontiguousarray(np.hstack([position, velocity])[inside]),
        np.ascontiguousarray(variance[inside]),
        float(gate),
        out,
        bias,
        sigma,
        nis,
        used,
    )
    if done < n:
        raise EstimationError(
            f"within 0.1 degrees of a pole, or lost, at sample {done}: check start, units, axes and sigmas"
        )
    refused = np.convolve(~used.any(axis=1), np.ones(10), "valid") if m >= 10 else np.zeros(0)
    if np.any(refused == 10):
        k = int(inside[np.argmax(refused == 10)])
        raise EstimationError(
            f"ten fixes in a row from {stamps[k]:.1f} s on are refused entirely: the filter has lost the vehicle; check the heading at the "
            "start, the axes and the sigmas"
        )
    sigma[:, :3] *= scale
    trajectory = Trajectory(np.concatenate([[start_time], t]), out[:, 0], out[:, 1], out[:, 2], out[:, 3:6], out[:, 6:])
    return LooseSolution(trajectory, bias[:, :3], bias[:, 3:], sigma, nis, used, inside, P_sqrt)


def _table(name: str, value: ArrayLike) -> FloatArray:
    x = np.asarray(value, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3:
        raise ValueError(f"{name} must have the shape (n, 3), not {x.shape}")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if bad.size:
        raise ValueError(f"{name} of row {bad[0]} is not finite; leave the row out or fill the gap")
    return x
