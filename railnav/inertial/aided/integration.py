"""Aided strapdown: one square-root error filter for loose, tight and odometer integration, open or closed loop, and its smoother.

Fifteen errors are always there (position, velocity, attitude, biases). `Unknowns` adds scale factors, lever arms, the mounting of the IMU
in the vehicle, the time offset between IMU and GNSS, the odometer's scale and a receiver's clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import dcm_from_rotation_vector, quaternion_from_dcm
from railnav.errors import EstimationError
from railnav.inertial.aided import layout as k
from railnav.inertial.aided.aiding import Fixes, Ranges, Rests, VehicleMotion
from railnav.inertial.aided.unknowns import Unknowns, Vehicle, menu
from railnav.inertial.error_model import position_scale
from railnav.inertial.imu_noise import ImuNoise, InitialSigma
from railnav.inertial.mechanization import GravityField, NavigationState, Trajectory

FloatArray = NDArray[np.float64]

#: Chi-square of one degree of freedom at 0.9999: a component beyond it is left out.
GATE = 15.137
#: Longest step between two nodes of the smoother, s.
NODE_STEP = 0.25
#: Most memory that the nodes of the smoother may take, bytes.
NODE_MEMORY = 3e9


@dataclass(frozen=True, slots=True, eq=False)
class AidedSolution:
    """What the filter (or the smoother) knew after each sample.

    Attributes
    ----------
    trajectory : Trajectory
        States before the first and after every sample, (n + 1,).
    sigma : (n + 1, 9) array
        Position north, east, up, m; velocity north, east, down, m/s; attitude about north, east, down, rad.
    covariance_north_east : (n + 1,) array
        Of the position, m^2.
    parameters, parameter_sigma : mapping of name to (n + 1, k) array
        "gyro_bias", "accelerometer_bias" and the `Unknowns` that were estimated, as corrections to the nominal values; "clock" holds drift
        and bias. SI and radians.
    nis, used : mapping of name to (m, c) array
        Normalised innovation squared of each component of the "fixes", "vehicle", "rests", "ranges" that fell among the samples, the later
        given the earlier, 1 on average, NaN where there was none; and whether it was let in.
    kept : mapping of name to (m,) int array
        Which rows of what was given these are.
    P_sqrt : (N, N) array
        Root of the covariance at the end, lower triangular, in the order of `states`.
    states : tuple of str
        Names of the states.
    smoothed : bool
        Whether all data stand behind each row, or those before it.
    """

    trajectory: Trajectory
    sigma: FloatArray
    covariance_north_east: FloatArray
    parameters: Mapping[str, FloatArray]
    parameter_sigma: Mapping[str, FloatArray]
    nis: Mapping[str, FloatArray]
    used: Mapping[str, NDArray[np.bool_]]
    kept: Mapping[str, NDArray[np.int64]]
    P_sqrt: FloatArray
    states: tuple[str, ...]
    smoothed: bool = False


def integrate(
    start: NavigationState,
    initial: InitialSigma,
    time: ArrayLike,
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    noise: ImuNoise,
    *,
    start_time: float,
    fixes: Fixes | None = None,
    vehicle_motion: VehicleMotion | None = None,
    rests: Rests | None = None,
    ranges: Ranges | None = None,
    vehicle: Vehicle | None = None,
    unknowns: Unknowns | None = None,
    closed_loop: bool = True,
    smooth: bool = False,
    gravity: GravityField | None = None,
    gate: float | Mapping[str, float] = GATE,
) -> AidedSolution:
    """Integrate an IMU, aided by whatever there is; the covariance is carried at every sample as a root.

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
    fixes, vehicle_motion, rests, ranges : optional
        What aids; rows outside the samples are left out (`AidedSolution.kept`).
    vehicle : Vehicle, optional
        Arms and mounting.
    unknowns : Unknowns, optional
        What else is estimated.
    closed_loop : bool, optional
        Feed estimated errors back at once (the default), or let the strapdown run free and take them off its output.
    smooth : bool, optional
        Use later data too: Rauch-Tung-Striebel in square roots over nodes at every measurement; closed loop only.
    gravity : GravityField, optional
        Default: WGS 84.
    gate : float or mapping, optional
        Chi-square beyond which a component is left out; by kind ("fixes", "vehicle", "rests", "ranges") if a mapping.

    Returns
    -------
    AidedSolution

    Raises
    ------
    ValueError
        Wrong shapes, values that are not finite, times that do not increase, sigmas that are not positive, ranges without a clock.
    EstimationError
        A sample interval above 0.5 s, within 0.1 degrees of a pole, every component of ten fixes in a row refused, or too much for the
        smoother's memory.

    Notes
    -----
    A measurement between two samples is compared at the later one, carried there by velocity and acceleration: a time offset beyond some
    20 ms leaves errors of the turn within it; run again with the stamps moved by the first answer. GNSS errors are taken as
    white; multiply their variances where they are not. Open loop holds for a good IMU and a short time: errors must stay small enough to be
    linear. With 15 states some 330, with 21 some 180 thousand samples/s a core; the smoother keeps some 18 kB a node with 24 states.

    References
    ----------
    `spec/inertial.md` B6 to B8, B10, B12; Rauch, Tung and Striebel (1965) in the square-root form of `railnav.estimation`.

    Examples
    --------
    >>> start, zero = NavigationState(0.9, 0.0, 0.0), np.zeros((100, 3))
    >>> initial = InitialSigma(np.full(3, 5.0), np.full(3, 0.1), np.full(3, 0.01), 1e-6, 1e-3)
    >>> rest = zero + np.array([7.292115e-5 * np.cos(0.9), 0.0, -7.292115e-5 * np.sin(0.9)]), zero - GravityField().vector(0.9)
    >>> out = integrate(start, initial, np.arange(1, 101) * 0.01, *rest, ImuNoise(1e-5, 1e-4), start_time=0.0,
    ...     fixes=Fixes([0.5], [[0.9, 0.0, 0.0]], [1.0, 1.0, 1.0]), rests=Rests([0.7]))
    >>> out.sigma[-1, :3].round(1), out.sigma[-1, 3:6].round(2)
    (array([1., 1., 1.]), array([0.03, 0.03, 0.02]))
    """
    from railnav.inertial.aided._kernels import aided_kernel, smooth_nodes_kernel

    t, w, f, interval = _samples(time, rate_ib_b, specific_force_b, start_time)
    if smooth and not closed_loop:
        raise ValueError("the smoother needs the closed loop")
    extra, setting = unknowns or Unknowns(), vehicle or Vehicle()
    if ranges is not None and not (extra.clock_bias > 0.0 and extra.clock_drift > 0.0):
        raise ValueError("ranges need the receiver's clock: give unknowns with clock_bias and clock_drift")
    at, sigmas, densities, decay, names = menu(extra, initial, noise)
    scale = position_scale(start, gravity)
    sigma0 = np.concatenate(
        [
            sigmas,
            np.asarray(initial.attitude, dtype=np.float64),
            np.asarray(initial.velocity, dtype=np.float64),
            np.asarray(initial.position, dtype=np.float64) / scale,
        ]
    )
    N, nine = len(sigma0), len(sigma0) - 9
    if sigma0.shape != (len(sigmas) + 9,) or not (np.isfinite(sigma0).all() and np.all(sigma0 > 0.0)):
        raise ValueError("initial sigmas must be three, three, three and two positive numbers")
    spread = np.concatenate(
        [densities, np.full(3, noise.angle_random_walk), np.full(3, noise.velocity_random_walk), np.zeros(3)]
    )
    driven = np.flatnonzero(spread > 0.0)
    table, kept = _measurements(t, start_time, fixes, vehicle_motion, rests, ranges)
    limits = np.array([gate.get(name, GATE) for name in k.KINDS] if isinstance(gate, Mapping) else [gate] * 4)
    nominal = np.array([*setting.antenna_arm_b, *setting.axle_arm_b, *setting.mounting], dtype=np.float64)
    if nominal.shape != (8,) or not np.isfinite(nominal).all():
        raise ValueError("arms must be three, the mounting two finite numbers")
    n, m = len(t), len(table.row)
    out, value, sigma = np.empty((n + 1, 10)), np.zeros((n + 1, nine)), np.empty((n + 1, N))
    out[0] = [start.latitude, start.longitude, start.height, *start.velocity_n, *start.quaternion_nb]
    sigma[0] = sigma0
    slant = np.zeros(n + 1)
    nis, used = np.full((m, 6), np.nan), np.zeros((m, 6), dtype=np.bool_)
    node = _nodes(t, table.row, start_time) if smooth else np.empty(0, np.int64)
    K = len(node) + 1 if smooth else 0
    if 4.0 * 8 * K * N * N > NODE_MEMORY:
        raise EstimationError(
            f"{K} nodes of {N} states take {32e-9 * K * N * N:.1f} GB: smooth the log in pieces, or give fewer measurements a second"
        )
    kept_state, kept_value, kept_x = np.empty((K, 10)), np.empty((K, nine)), np.zeros((K, N))
    kept_U, kept_Phi, kept_Q = np.zeros((K, N, N)), np.zeros((K, N, N)), np.zeros((K, N, N))
    U = np.diag(sigma0)
    done = aided_kernel(
        w * interval[:, None],
        f * interval[:, None],
        interval,
        (gravity or GravityField()).flat(),
        at,
        U,
        decay,
        driven,
        spread[driven],
        nominal,
        table.kind,
        table.row,
        table.age,
        table.data,
        table.variance,
        limits.astype(np.float64),
        bool(closed_loop),
        out,
        value,
        sigma,
        slant,
        nis,
        used,
        node,
        kept_state,
        kept_value,
        kept_U,
        kept_Phi,
        kept_Q,
        kept_x,
    )
    if done < n:
        raise EstimationError(
            f"within 0.1 degrees of a pole, or lost, at sample {done}: check start, units, axes and sigmas"
        )
    _check_refused(table, used, fixes, kept)
    P_sqrt = np.ascontiguousarray(U.T)
    if smooth:
        error, roots = np.zeros((K, N)), np.zeros((K, N, N))
        smooth_nodes_kernel(kept_U, kept_Phi, kept_Q, kept_x, error, roots)
        node_time = np.concatenate([[start_time], t[node]])
        out, value = _spread(out, value, np.concatenate([[start_time], t]), node_time, error, kept_x, nine)
        at_nodes = np.sqrt(np.einsum("kij,kij->ki", roots, roots))
        stamps = np.concatenate([[start_time], t])
        sigma = np.stack([np.interp(stamps, node_time, column) for column in at_nodes.T], axis=1)
        slant = np.interp(stamps, node_time, np.einsum("kj,kj->k", roots[:, N - 3], roots[:, N - 2]))
    sigma[:, nine + 6 :] *= scale
    place = [(name, int(at[g]), size) for g, (name, size) in enumerate(k.GROUPS) if at[g] >= 0]
    by_kind = {name: table.kind == code for code, name in enumerate(k.KINDS) if np.any(table.kind == code)}
    return AidedSolution(
        Trajectory(np.concatenate([[start_time], t]), out[:, 0], out[:, 1], out[:, 2], out[:, 3:6], out[:, 6:]),
        np.hstack([sigma[:, nine + 6 :], sigma[:, nine + 3 : nine + 6], sigma[:, nine : nine + 3]]),
        slant * scale[0] * scale[1],
        {name: value[:, c : c + size] for name, c, size in place},
        {name: sigma[:, c : c + size] for name, c, size in place},
        {name: nis[rows] for name, rows in by_kind.items()},
        {name: used[rows] for name, rows in by_kind.items()},
        kept,
        P_sqrt,
        names,
        smooth,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    kind: NDArray[np.int64]
    row: NDArray[np.int64]
    age: FloatArray
    data: FloatArray
    variance: FloatArray


def _samples(
    time: ArrayLike, rate: ArrayLike, force: ArrayLike, start_time: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    t = np.asarray(time, dtype=np.float64)
    w, f = _table("rate_ib_b", rate), _table("specific_force_b", force)
    if t.ndim != 1 or not len(t) == len(w) == len(f) or not len(t):
        raise ValueError(f"needs one time, rate and specific force a sample, not {t.shape}, {w.shape}, {f.shape}")
    interval = np.diff(t, prepend=start_time)
    wrong = np.flatnonzero(~(interval > 0.0))
    if wrong.size:
        raise ValueError(f"time does not increase at sample {wrong[0]}: sort the samples, and start before the first")
    if interval.max() > 0.5:
        last = int(np.argmax(interval))
        raise EstimationError(f"{interval.max():.2f} s between samples {last - 1} and {last}: cut the log there")
    return t, w, f, interval


def _table(name: str, value: ArrayLike) -> FloatArray:
    x = np.asarray(value, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3:
        raise ValueError(f"{name} must have the shape (n, 3), not {x.shape}")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if bad.size:
        raise ValueError(f"{name} of row {bad[0]} is not finite; leave the row out or fill the gap")
    return x


def _measurements(
    t: FloatArray,
    start_time: float,
    fixes: Fixes | None,
    motion: VehicleMotion | None,
    rests: Rests | None,
    ranges: Ranges | None,
) -> tuple[_Table, dict[str, NDArray[np.int64]]]:
    kinds, rows, ages, data, variances = [], [], [], [], []
    kept: dict[str, NDArray[np.int64]] = {}

    def add(code: int, stamps: FloatArray, values: Any, sigmas: Any) -> None:
        inside = np.flatnonzero((stamps > start_time) & (stamps <= t[-1]))
        kept[k.KINDS[code]] = inside
        row = np.searchsorted(t, stamps[inside], side="left")
        table, variance = np.zeros((len(inside), 8)), np.zeros((len(inside), 8))
        for c, v in enumerate(values):
            table[:, c] = v[inside]
        for c, s in enumerate(sigmas):
            variance[:, c] = np.where(np.isfinite(s[inside]), s[inside] ** 2, 0.0)
        kinds.append(np.full(len(inside), code))
        rows.append(row)
        ages.append(t[row] - stamps[inside])
        data.append(table)
        variances.append(variance)

    if fixes is not None:
        unknown = np.full((len(fixes.time), 3), np.inf)
        v = fixes.velocity_n if fixes.velocity_n is not None else np.zeros_like(unknown)
        sv = fixes.sigma_velocity if fixes.sigma_velocity is not None else unknown
        add(k.FIX, fixes.time, [*fixes.position.T, *v.T], [*fixes.sigma_position.T, *sv.T])
    if motion is not None:
        size = len(motion.time)
        forward = motion.forward if motion.forward is not None else np.zeros(size)
        along = motion.sigma_forward if motion.forward is not None else np.full(size, np.inf)
        add(k.BODY, motion.time, [forward], [np.asarray(along), motion.sigma_lateral, motion.sigma_vertical])
    if rests is not None:
        size = len(rests.time)
        rate = rests.rate_ib_b if rests.rate_ib_b is not None else np.zeros((size, 3))
        sigma = rests.sigma_rate if rests.rate_ib_b is not None else np.inf
        add(k.REST, rests.time, rate.T, [np.full(size, rests.sigma_velocity)] * 3 + [np.full(size, sigma)] * 3)
    if ranges is not None:
        values = [*ranges.satellite_position.T, *ranges.satellite_velocity.T, ranges.pseudorange, ranges.range_rate]
        add(k.RANGE, ranges.time, values, [np.asarray(ranges.sigma_range), np.asarray(ranges.sigma_rate)])
    if not kinds:
        empty = np.empty(0, np.int64)
        return _Table(empty, empty, np.empty(0), np.empty((0, 8)), np.empty((0, 8))), kept
    row = np.concatenate(rows)
    order = np.argsort(row, kind="stable")
    table = _Table(
        np.concatenate(kinds)[order],
        row[order],
        np.concatenate(ages)[order],
        np.ascontiguousarray(np.vstack(data)[order]),
        np.ascontiguousarray(np.vstack(variances)[order]),
    )
    return table, kept


def _nodes(t: FloatArray, rows: NDArray[np.int64], start_time: float) -> NDArray[np.int64]:
    regular = np.searchsorted(t, np.arange(start_time + NODE_STEP, t[-1], NODE_STEP))
    return np.unique(np.concatenate([rows, regular, [len(t) - 1]])).astype(np.int64)


def _spread(
    out: FloatArray,
    value: FloatArray,
    stamps: FloatArray,
    node_time: FloatArray,
    error: FloatArray,
    correction: FloatArray,
    nine: int,
) -> tuple[FloatArray, FloatArray]:
    """Smoothed states at all samples: the error of the filtered run between nodes runs linearly to what it was before the node's update."""
    right = np.searchsorted(node_time, stamps, side="left")
    exact = node_time[np.minimum(right, len(node_time) - 1)] == stamps
    left = np.maximum(right - 1, 0)
    right = np.minimum(right, len(node_time) - 1)
    width = np.maximum(node_time[right] - node_time[left], 1e-12)
    part = ((stamps - node_time[left]) / width)[:, None]
    x = (1.0 - part) * error[left] + part * (error[right] + correction[right])
    x[exact] = error[right[exact]]
    C = dcm_from_rotation_vector(x[:, nine : nine + 3])
    from railnav.attitude import dcm_from_quaternion

    result = np.empty_like(out)
    result[:, :3] = out[:, :3] - x[:, nine + 6 :]
    result[:, 3:6] = out[:, 3:6] - x[:, nine + 3 : nine + 6]
    result[:, 6:] = quaternion_from_dcm(C @ dcm_from_quaternion(out[:, 6:]))
    return result, value + x[:, :nine]


def _check_refused(
    table: _Table, used: NDArray[np.bool_], fixes: Fixes | None, kept: Mapping[str, NDArray[np.int64]]
) -> None:
    if fixes is None:
        return
    rows = table.kind == k.FIX
    refused = ~used[rows].any(axis=1)
    if len(refused) < 10:
        return
    runs = np.convolve(refused, np.ones(10), "valid")
    if np.any(runs == 10):
        first = kept["fixes"][int(np.argmax(runs == 10))]
        raise EstimationError(
            f"ten fixes in a row from {fixes.time[first]:.1f} s on are refused entirely: the filter has lost the vehicle; check the "
            "heading at the start, the axes and the sigmas"
        )
