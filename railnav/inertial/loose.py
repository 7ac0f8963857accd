"""Loosely coupled, closed loop, in its plainest form: GNSS positions and velocities, fifteen errors; the work is `integration`'s."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.inertial.imu_noise import ImuNoise, InitialSigma
from railnav.inertial.mechanization import GravityField, NavigationState, Trajectory

FloatArray = NDArray[np.float64]

#: Chi-square of one degree of freedom at 0.9999: a fix component beyond it is left out.
GATE = 15.137


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
    from railnav.estimation._kernels import triangularize_rows
    from railnav.inertial.aided.aiding import Fixes
    from railnav.inertial.aided.integration import integrate
    from railnav.inertial.aided.unknowns import Vehicle

    arm = np.asarray(lever_arm_b, dtype=np.float64)
    if arm.shape != (3,) or not np.isfinite(arm).all():
        raise ValueError("lever_arm_b must be three finite numbers")
    stamps = np.asarray(fix_time, dtype=np.float64)
    shapes = [np.shape(x) for x in (stamps, fix_position, fix_velocity_n)]
    if stamps.ndim != 1 or shapes[1] != (len(stamps), 3) or shapes[2] != (len(stamps), 3):
        raise ValueError(f"needs one time, position and velocity a fix, not {', '.join(map(str, shapes))}")
    if not np.isfinite(stamps).all() or np.any(np.diff(stamps) <= 0.0):
        raise ValueError("fix_time must be finite and increase")
    fixes = Fixes(
        stamps,
        *(np.asarray(x, dtype=np.float64) for x in (fix_position, sigma_position, fix_velocity_n, sigma_velocity)),
    )
    got = integrate(
        start,
        initial,
        time,
        rate_ib_b,
        specific_force_b,
        noise,
        start_time=start_time,
        fixes=fixes,
        vehicle=Vehicle(antenna_arm_b=(float(arm[0]), float(arm[1]), float(arm[2]))),
        gravity=gravity,
        gate=gate,
    )
    # states from biases, attitude, velocity, position into the order of `ErrorState`
    root = np.ascontiguousarray(got.P_sqrt[[12, 13, 14, 9, 10, 11, 6, 7, 8, 0, 1, 2, 3, 4, 5]])
    triangularize_rows(root, 15)
    bg, ba = got.parameters["gyro_bias"], got.parameters["accelerometer_bias"]
    slow = (got.parameter_sigma["gyro_bias"], got.parameter_sigma["accelerometer_bias"])
    none = np.empty((0, 6))
    return LooseSolution(
        got.trajectory,
        bg,
        ba,
        np.hstack([got.sigma, *slow]),
        got.nis.get("fixes", none),
        got.used.get("fixes", none.astype(np.bool_)),
        got.kept["fixes"],
        root,
    )
