"""A run by its IMU, without a map: loose, tight, with odometer, decentralised; the answer is a `Solution` without tracks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.attitude import dcm_from_euler, euler_from_dcm
from railnav.errors import EstimationError, RunError
from railnav.geodesy import choose_frame
from railnav.geodesy.plane import GridFrame
from railnav.inertial.aided import (
    AidedSolution,
    Fixes,
    Ranges,
    Rests,
    Unknowns,
    Vehicle,
    VehicleMotion,
    find_rests,
    integrate,
)
from railnav.inertial.aided.fusion import fuse
from railnav.inertial.error_model import position_scale
from railnav.inertial.loose import ImuNoise, InitialSigma
from railnav.inertial.mechanization import NavigationState
from railnav.navigation.epochs import body_from_imu, raw_table
from railnav.navigation.solution import Mode, Solution
from railnav.run import GnssStream, OdometerStream, Progress, Run

FloatArray = NDArray[np.float64]

#: Schemes of this module, as the command line names them.
INERTIAL_SCHEMES = ("loose", "tight", "odometer", "decentralised")
_DEGREE = math.pi / 180
#: How long the INS/odometer filter of the decentralised scheme runs before it starts anew, while there are fixes, s.
RESTART = 60.0


def _low_cost() -> ImuNoise:
    return ImuNoise(5.0 * _DEGREE / 60, 1.5 / 60, 250 * _DEGREE / 3600, 0.015)


@dataclass(frozen=True, slots=True)
class InertialSettings:
    """What is assumed of sensors and vehicle.

    Attributes
    ----------
    noise : ImuNoise
        Of the IMU; the default is of a low-cost one, vibration of a vehicle included.
    gyro_bias, accelerometer_bias : float
        Sigma of the switch-on biases, rad/s, m/s^2.
    unstated_sigma, unstated_sigma_up : float
        Of a fix that states none, m.
    correlation_time : float
        Of the errors of code positions, s: the variance of a fix that states more than `white_below` is multiplied by twice this over
        the interval of the fixes, so that many fixes with one error do not pass for many measurements.
    white_below : float
        Sigma up to which position errors count as white (carrier-phase positions), m.
    speed_sigma, course_sigma : float
        Of a receiver's speed that states none, m/s, and the floor of its course, rad.
    lateral_sigma : float
        Of the vehicle's speed across its length and height, m/s.
    odometer_sigma : float
        Of an odometer's speed that states none, m/s.
    lead : float
        Sigma of what is to be added to the stamps of the fixes, s.
    heading_speed : float
        Speed from which the course tells the heading, m/s.
    coasting_after : float
        s without a fix.
    lost_sigma : float
        Horizontal sigma beyond which the position is lost, m.
    """

    noise: ImuNoise = field(default_factory=_low_cost)
    gyro_bias: float = 0.3 * _DEGREE
    accelerometer_bias: float = 0.15
    unstated_sigma: float = 4.0
    unstated_sigma_up: float = 8.0
    correlation_time: float = 30.0
    white_below: float = 0.3
    speed_sigma: float = 0.4
    course_sigma: float = 0.01
    lateral_sigma: float = 0.2
    odometer_sigma: float = 0.1
    lead: float = 0.1
    heading_speed: float = 3.0
    coasting_after: float = 3.0
    lost_sigma: float = 500.0


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """Where inertial navigation begins."""

    time: float
    state: NavigationState
    initial: InitialSigma
    levelled: FloatArray  # turn of the IMU's body axes that makes the vehicle level at rest, (3, 3)
    tilt: tuple[float, float]


def navigate_inertial(
    run: Run,
    *,
    scheme: str = "loose",
    smooth: bool = False,
    integrity_risk: float = 1e-4,
    ranges: Ranges | None = None,
    frame: GridFrame | None = None,
    settings: InertialSettings | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Navigate a run by its IMU and what aids it, without a map.

    Parameters
    ----------
    run : Run
        With IMU and GNSS streams.
    scheme : {"loose", "tight", "odometer", "decentralised"}
        "loose": GNSS positions and velocities, closed loop, and rests. "tight": pseudoranges and their rates (`ranges`) in place of
        positions; fewer than four satellites still help. "odometer": loose, and the vehicle moves along its nose, with the speed of
        the odometer where there is one. "decentralised": an INS/GNSS and an INS/odometer filter of their own, fused at the output by
        covariance intersection; the second starts anew from the first every minute while there are fixes.
    smooth : bool, optional
        Use later data too; not for "decentralised".
    integrity_risk : float, optional
        Risk, per row, of the protection level.
    ranges : Ranges, optional
        For "tight", on the run's clock.
    frame : GridFrame, optional
        Plane of easting and northing; default: the Gauss-Krueger zone of the run.
    settings : InertialSettings, optional
        What is assumed.
    progress : Progress, optional
        Called with a label, steps done and steps in all.

    Returns
    -------
    Solution
        One row an epoch as `navigate` gives; no tracks (-1). `sigma_along` and `sigma_cross` lie along and across the heading; the
        protection level is the normal quantile of sigma along. Rows before the vehicle first moves are `initialising`, beyond 3 s without
        GNSS `coasting`, beyond a sigma of 500 m `lost`. Diagnostics hold what was estimated.

    Raises
    ------
    RunError
        No IMU or GNSS stream, no ranges for "tight", no odometer for "decentralised", a vehicle that never moves.
    EstimationError
        The filter lost the vehicle, or the log is too long to be smoothed at once.
    ValueError
        A scheme that is none of these, smoothing of "decentralised".

    Notes
    -----
    The heading at the start is the course when the vehicle first moves faster than 3 m/s: it is taken to move forward. At rest before that
    it is taken to stand level: a mounting that says otherwise is corrected, and the correction is in the diagnostics
    (`levelled_roll_deg`, `levelled_pitch_deg`). That much looks ahead; everything after is causal unless smoothed.

    References
    ----------
    `spec/inertial.md` B7 to B10.

    Examples
    --------
    >>> from datetime import UTC, datetime
    >>> navigate_inertial(Run("r1", datetime(2026, 5, 4, tzinfo=UTC)))
    Traceback (most recent call last):
    railnav.errors.RunError: run 'r1' has no IMU stream: the scheme 'loose' integrates one; use the scheme 'track' with a model
    """
    if scheme not in INERTIAL_SCHEMES:
        raise ValueError(f"scheme {scheme!r} is none of {', '.join(INERTIAL_SCHEMES)}")
    if smooth and scheme == "decentralised":
        raise ValueError("the decentralised scheme fuses two outputs as they come: it cannot be smoothed")
    if not 0.0 < integrity_risk < 0.5:
        raise ValueError(f"integrity_risk is {integrity_risk}; it must lie between 0 and 0.5")
    assumed = settings or InertialSettings()
    _check_streams(run, scheme, ranges)
    assert run.gnss is not None
    assert run.imu is not None
    begin = _start(run, assumed)
    time, rate, force = _body_samples(run, begin)
    _check_axes(run, time, rate, force)
    fixes = _fixes(run.gnss, assumed)
    rests = _rests(run, time, rate, force)
    motion = _motion(run.odometer, time, assumed)
    steps = 3 if scheme == "decentralised" else 2
    if progress is not None:
        progress("integrate", 0, steps)

    def solve(**aids: Any) -> AidedSolution:
        wheels = aids.get("vehicle_motion") is not None
        gnss = aids.get("fixes") is not None
        unknown = Unknowns(
            time_offset=assumed.lead if gnss else 0.0,
            axle_arm=1.0 if wheels else 0.0,
            mounting=2.0 * _DEGREE if wheels else 0.0,
            odometer_scale=0.02 if wheels and run.odometer is not None else 0.0,
            gyro_scale=0.01,
            accelerometer_scale=0.01,
            clock_bias=3e5 if aids.get("ranges") is not None else 0.0,
            clock_drift=300.0 if aids.get("ranges") is not None else 0.0,
        )
        return integrate(
            begin.state,
            begin.initial,
            time,
            rate,
            force,
            assumed.noise,
            start_time=begin.time,
            rests=rests,
            vehicle=Vehicle(antenna_arm_b=_arm(run)),
            unknowns=unknown,
            smooth=smooth,
            gate={"fixes": 30.0, "vehicle": 20.0, "rests": 20.0, "ranges": 20.0},
            **aids,
        )

    if scheme == "loose":
        found = solve(fixes=fixes)
    elif scheme == "tight":
        found = solve(ranges=ranges)
    elif scheme == "odometer":
        found = solve(fixes=fixes, vehicle_motion=motion)
    else:
        found = solve(fixes=fixes)
    if progress is not None:
        progress("integrate", 1, steps)
    _check_agreement(run, found)
    position, covariance = _position(found)
    extra: dict[str, Any] = {}
    if scheme == "decentralised":
        wheels = _wheel_filter(found, time, rate, force, rests, motion, run.gnss.time, assumed)
        position, covariance, share = _fused(found, *wheels)
        extra = {"mean_weight_of_gnss_filter": share}
        if progress is not None:
            progress("integrate", 2, steps)
    told = ranges.time if scheme == "tight" and ranges is not None else run.gnss.time
    rows = _solution(run, found, position, covariance, told, begin, frame, integrity_risk, smooth, assumed)
    rows.diagnostics.update({"scheme": scheme, **_diagnostics(found, begin, len(rests.time)), **extra})
    if progress is not None:
        progress("integrate", steps, steps)
    return rows


def _check_streams(run: Run, scheme: str, ranges: Ranges | None) -> None:
    if run.imu is None or len(run.imu) < 2:
        raise RunError(
            f"run {run.id!r} has no IMU stream: the scheme {scheme!r} integrates one",
            file=run.source,
            remedy="use the scheme 'track' with a model",
        )
    if run.gnss is None or len(run.gnss) < 2:
        raise RunError(
            f"run {run.id!r} has no GNSS fixes: nothing says where it starts",
            file=run.source,
            remedy="add a [gnss] stream",
        )
    if scheme == "tight" and (ranges is None or len(ranges.time) == 0):
        raise RunError(
            f"run {run.id!r} brings no pseudoranges: tight coupling works on them",
            file=run.source,
            remedy="give a table of ranges, or use the scheme 'loose'",
        )
    if scheme == "decentralised" and run.odometer is None:
        raise RunError(
            f"run {run.id!r} has no odometer: the decentralised scheme's second filter needs one",
            file=run.source,
            remedy="use the scheme 'odometer', which takes the vehicle's constraints alone",
        )


def _velocity(gnss: GnssStream) -> FloatArray:
    """North and east velocity of each fix, m/s, NaN where it says nothing; from positions where the stream has no speed."""
    if gnss.speed is not None and gnss.course is not None:
        # a resting receiver has no course, but its velocity is known
        course = np.where(np.isnan(gnss.course) & (gnss.speed < 0.5), 0.0, gnss.course)
        return np.stack([gnss.speed * np.cos(course), gnss.speed * np.sin(course)], axis=1)
    scale = position_scale(NavigationState(float(gnss.latitude[0]), float(gnss.longitude[0]), 0.0))
    place = np.stack([gnss.latitude * scale[0], gnss.longitude * scale[1]], axis=1)
    return np.asarray(np.gradient(place, gnss.time, axis=0))


def _start(run: Run, assumed: InertialSettings) -> _Start:
    """Level at rest, head for the course of the first motion, begin with the last fix before it (or in motion if there is no rest)."""
    gnss, imu = run.gnss, run.imu
    assert gnss is not None
    assert imu is not None
    velocity = _velocity(gnss)
    speed = np.hypot(*velocity.T)
    covered = (gnss.time > imu.time[0] + 1.0) & (gnss.time < imu.time[-1] - 1.0) & np.isfinite(speed)
    fast = np.flatnonzero(covered & (speed > assumed.heading_speed))
    if len(fast) == 0:
        raise RunError(
            f"run {run.id!r} never moves faster than {assumed.heading_speed:.0f} m/s while the IMU records: nothing tells the heading",
            file=run.source,
            remedy="use a log of a moving vehicle, or the scheme 'track' with a model",
        )
    moving = int(fast[0])
    noise = assumed.speed_sigma if gnss.sigma_speed is None else float(np.nanmedian(gnss.sigma_speed))
    slow = np.flatnonzero(covered & (speed < 0.3 + noise) & (np.arange(len(speed)) < moving))
    if len(slow):  # the last seconds may already roll
        slow = slow[gnss.time[slow] <= gnss.time[slow[-1]] - 1.0]
    C = body_from_imu(imu.mounting)
    rate, force = imu.gyro @ C.T, imu.specific_force @ C.T
    course = float(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    level_sigma, heading_sigma = 3.0 * _DEGREE, max(5.0 * _DEGREE, 3.0 * noise / float(speed[moving]))
    at, levelled, tilt = moving, np.eye(3), (0.0, 0.0)
    if len(slow) and (still := _quiet(imu.time, force, float(gnss.time[slow[-1]]))) is not None:
        at = int(slow[-1])
        f = force[still].mean(axis=0)
        roll, pitch = math.atan2(-f[1], -f[2]), math.atan2(f[0], math.hypot(f[1], f[2]))
        tilt = (roll, pitch)
        if max(abs(roll), abs(pitch)) > 4.0 * _DEGREE:  # beyond cant and gradient: the mounting is not as stated
            levelled = dcm_from_euler(roll, pitch, 0.0)
            roll = pitch = 0.0
        between = (imu.time > gnss.time[at]) & (imu.time <= gnss.time[moving])
        turned = rate[between] @ levelled.T - (rate[still] @ levelled.T).mean(axis=0)
        step = np.diff(imu.time[between], prepend=gnss.time[at])
        heading = course - float((turned[:, 2] * step).sum())
        level_sigma = 1.0 * _DEGREE
    else:
        roll = pitch = 0.0
        heading = course
    sigma_p, sigma_up = _position_sigma(gnss, assumed)
    moved = np.zeros(3) if at != moving else np.append(velocity[at], 0.0)
    C_nb = dcm_from_euler(roll, pitch, heading)
    height = 0.0 if gnss.height is None or not np.isfinite(gnss.height[at]) else float(gnss.height[at])
    antenna = NavigationState.from_dcm(
        float(gnss.latitude[at]), float(gnss.longitude[at]), height, velocity_n=moved, C_nb=C_nb
    )
    offset = C_nb @ np.asarray(_arm(run)) / position_scale(antenna)
    state = NavigationState.from_dcm(
        antenna.latitude - offset[0],
        antenna.longitude - offset[1],
        antenna.height + offset[2],
        velocity_n=moved,
        C_nb=C_nb,
    )
    initial = InitialSigma(
        np.array([sigma_p[at], sigma_p[at], sigma_up[at]]),
        np.full(3, 0.2 if at != moving else 0.5 + noise),
        np.array([level_sigma, level_sigma, heading_sigma]),
        assumed.gyro_bias,
        assumed.accelerometer_bias,
    )
    return _Start(float(gnss.time[at]), state, initial, levelled, tilt)


def _quiet(time: FloatArray, force: FloatArray, end: float) -> NDArray[np.bool_] | None:
    """Samples of the two seconds before an instant, None if the vehicle shakes in them."""
    still = (time > end - 2.0) & (time <= end)
    if still.sum() < 10:
        return None
    halves = np.array_split(force[still], 4)
    apart = np.ptp([h.mean(axis=0) for h in halves], axis=0).max()
    return still if apart < 0.3 else None


def _arm(run: Run) -> tuple[float, float, float]:
    """IMU to antenna, body axes, m."""
    assert run.gnss is not None
    assert run.imu is not None
    a, b, c = (float(x) for x in run.gnss.lever_arm_b - run.imu.lever_arm_b)
    return a, b, c


def _body_samples(run: Run, begin: _Start) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Samples after the start in the (levelled) body axes; gaps of the log are refused."""
    imu = run.imu
    assert imu is not None
    use = imu.time > begin.time + 1e-6
    time = imu.time[use]
    step = np.diff(time, prepend=begin.time)
    if step.max() > 0.5:
        at = int(np.argmax(step))
        raise RunError(
            f"run {run.id!r}: the IMU is silent for {step[at]:.1f} s at {time[at]:.1f} s; an inertial scheme cannot bridge that",
            file=run.source,
            remedy="cut the log there, or use the scheme 'track' with a model",
        )
    C = begin.levelled @ body_from_imu(imu.mounting)
    return time, imu.gyro[use] @ C.T, imu.specific_force[use] @ C.T


def _check_axes(run: Run, time: FloatArray, rate: FloatArray, force: FloatArray) -> None:
    """Refuse an IMU whose units or axes contradict gravity and the motion that GNSS sees, with the evidence."""
    gnss = run.gnss
    assert gnss is not None
    size = float(np.median(np.linalg.norm(force, axis=1)))
    if not 8.5 < size < 11.5:
        advice = "multiply them by 9.80665 if they are in g" if 0.8 < size < 1.3 else "check units and calibration"
        raise RunError(
            f"run {run.id!r}: the accelerometers read {size:.2f} m/s2 in the median, gravity is 9.81",
            file=run.source,
            remedy=advice,
        )
    velocity = _velocity(gnss)
    speed = np.hypot(*velocity.T)
    use = np.flatnonzero((gnss.time > time[0]) & (gnss.time < time[-1]) & np.isfinite(speed))
    if len(use) < 10:
        return
    step = np.diff(time, prepend=time[0])
    turned = np.interp(gnss.time[use], time, np.cumsum(rate[:, 2] * step))
    course = np.unwrap(np.arctan2(velocity[use, 1], velocity[use, 0]))
    pairs = (np.diff(gnss.time[use]) < 3.0) & (np.minimum(speed[use][1:], speed[use][:-1]) > 3.0)
    by_gyro, by_gnss = np.diff(turned)[pairs], np.diff(course)[pairs]
    if len(by_gyro) < 10:
        return
    by_gyro, by_gnss = by_gyro - np.median(by_gyro), by_gnss - np.median(by_gnss)
    if np.sqrt((by_gnss**2).sum()) > 0.5 and (by_gyro**2).sum() > 0:
        ratio = float((by_gyro * by_gnss).sum() / (by_gnss**2).sum())
        if not 0.6 < ratio < 1.6:
            advice = (
                "divide the rates by 57.3 if they are in degrees a second"
                if abs(abs(ratio) - 57.3) < 20
                else "check mounting_deg, the order of the axes and their signs (forward, right, down)"
            )
            raise RunError(
                f"run {run.id!r}: where GNSS turns by one degree the gyro about the down axis reads {ratio:.2f} degrees",
                file=run.source,
                remedy=advice,
            )
    if gnss.speed is None:  # differences of positions are too rough for an acceleration
        return
    total = np.stack([np.interp(gnss.time[use], time, np.cumsum(force[:, i] * step)) for i in (0, 1)], axis=1)
    span = np.diff(gnss.time[use])[pairs, None]
    read = np.diff(total, axis=0)[pairs] / span
    middle = 0.5 * (speed[use][1:] + speed[use][:-1])[pairs]
    seen = np.stack([np.diff(speed[use])[pairs] / span[:, 0], middle * by_gnss / span[:, 0]], axis=1)
    read, seen = read - np.median(read, axis=0), seen - np.median(seen, axis=0)
    if (seen**2).sum(axis=0).min() < 20.0 * 0.1**2 * len(seen) ** 0.5:
        return
    across = float((seen[:, 0] * read[:, 1] - seen[:, 1] * read[:, 0]).sum())
    agree = float((seen * read).sum())
    angle, share = math.atan2(across, agree), math.hypot(across, agree) / float((seen**2).sum())
    if abs(angle) > 20.0 * _DEGREE and share > 0.5:
        raise RunError(
            f"run {run.id!r}: accelerations seen by GNSS point {angle / _DEGREE:+.0f} degrees to the right of the IMU's forward axis",
            file=run.source,
            remedy="turn it by mounting_deg, or check the order of its axes (forward, right, down)",
        )


def _check_agreement(run: Run, found: AidedSolution) -> None:
    """Refuse an answer whose own sensors contradict it."""
    for kind, words in (("fixes", "fixes"), ("rests", "rests"), ("vehicle", "wheels"), ("ranges", "ranges")):
        if kind not in found.nis:
            continue
        there = np.isfinite(found.nis[kind])
        if there.sum() < 50:
            continue
        refused = float((~found.used[kind] & there).sum() / there.sum())
        if refused > 0.25:
            raise EstimationError(
                f"run {run.id!r}: {refused:.0%} of what {words} say contradict the IMU; check its units and axes, mounting_deg, the clocks "
                "of the streams, and the stated sigmas"
            )


def _position_sigma(gnss: GnssStream, assumed: InertialSettings) -> tuple[FloatArray, FloatArray]:
    """Sigma of each fix, horizontal axis and up, m."""
    m = len(gnss)
    flat = np.full(m, assumed.unstated_sigma)
    if gnss.sigma_east is not None and gnss.sigma_north is not None:
        stated = np.sqrt(0.5 * (gnss.sigma_east**2 + gnss.sigma_north**2))
        flat = np.where(np.isfinite(stated) & (stated > 0), stated, flat)
    up = np.full(m, 2.0 * assumed.unstated_sigma)
    if gnss.sigma_up is not None:
        up = np.where(np.isfinite(gnss.sigma_up) & (gnss.sigma_up > 0), gnss.sigma_up, up)
    return flat, up


def _fixes(gnss: GnssStream, assumed: InertialSettings) -> Fixes:
    flat, up = _position_sigma(gnss, assumed)
    interval = float(np.median(np.diff(gnss.time)))
    many = math.sqrt(max(1.0, 2.0 * assumed.correlation_time / interval))
    coarse = flat > assumed.white_below
    # carrier-phase positions are a little worse than they say on a moving vehicle
    flat = np.where(coarse, flat * many, np.maximum(2.0 * flat, 0.03))
    up = np.where(coarse, up * many, np.maximum(2.0 * up, 0.05))
    height = np.zeros(len(gnss)) if gnss.height is None else gnss.height
    up = np.where(np.isfinite(height), up, np.inf) if gnss.height is not None else np.full(len(gnss), 20.0)
    position = np.stack([gnss.latitude, gnss.longitude, np.nan_to_num(height)], axis=1)
    sigma = np.stack([flat, flat, up], axis=1)
    if gnss.speed is None or gnss.course is None:
        return Fixes(gnss.time, position, sigma)
    velocity = _velocity(gnss)
    speed_sigma = np.full(len(gnss), assumed.speed_sigma)
    if gnss.sigma_speed is not None:
        speed_sigma = np.where(np.isfinite(gnss.sigma_speed), np.maximum(gnss.sigma_speed, 0.02), speed_sigma)
    # course is as good as the speed across allows; a resting receiver's is none, but its velocity is zero all the same
    across = np.hypot(speed_sigma, assumed.course_sigma * gnss.speed)
    each = np.where(np.isfinite(velocity).all(axis=1), 1.7 * np.maximum(speed_sigma, across), np.inf)
    sigma_v = np.stack([each, each, np.full(len(gnss), np.inf)], axis=1)
    return Fixes(gnss.time, position, sigma, np.column_stack([np.nan_to_num(velocity), np.zeros(len(gnss))]), sigma_v)


def _rests(run: Run, time: FloatArray, rate: FloatArray, force: FloatArray) -> Rests:
    """Rests by the quiet of the IMU where neither GNSS nor odometer sees motion."""
    found = find_rests(time, rate, force)
    if len(found.time) == 0:
        return found
    keep = np.ones(len(found.time), dtype=bool)
    gnss, odometer = run.gnss, run.odometer
    assert gnss is not None
    if gnss.speed is not None:
        noise = 0.2 if gnss.sigma_speed is None else float(np.nanmedian(gnss.sigma_speed))
        near = np.interp(found.time, gnss.time, np.nan_to_num(gnss.speed, nan=0.0))
        apart = np.abs(gnss.time[np.clip(np.searchsorted(gnss.time, found.time), 0, len(gnss) - 1)] - found.time)
        keep &= (near < 0.3 + 3.0 * noise) | (apart > 2.0)
    if odometer is not None and len(odometer) > 1:
        if odometer.distance is not None:
            way = np.interp(found.time, odometer.time, odometer.distance)
            keep &= np.abs(way - np.interp(found.time - 1.0, odometer.time, odometer.distance)) < 0.1
        elif odometer.speed is not None:
            keep &= np.abs(np.interp(found.time, odometer.time, odometer.speed)) < 0.1
    rates = found.rate_ib_b
    assert rates is not None
    return Rests(found.time[keep], rates[keep], found.sigma_velocity, found.sigma_rate)


def _motion(odometer: OdometerStream | None, time: FloatArray, assumed: InertialSettings) -> VehicleMotion:
    """The constraint at 5 Hz; the odometer's speed with it where there is one."""
    across = assumed.lateral_sigma
    if odometer is None or len(odometer) < 3:
        return VehicleMotion(np.arange(time[0], time[-1], 0.2), sigma_lateral=across, sigma_vertical=across)
    if odometer.distance is not None:
        # mean speed of a fifth of a second and more: rounding of the distance counts less
        usual = float(np.median(np.diff(odometer.time)))
        n = max(1, math.ceil(0.4 / usual - 1e-9))
        span = odometer.time[n:] - odometer.time[:-n]
        speed = (odometer.distance[n:] - odometer.distance[:-n]) / span
        middle = 0.5 * (odometer.time[n:] + odometer.time[:-n])
        sigma = np.hypot(0.03 / span, 0.02)
        keep = span < 1.5 * n * usual
    else:
        assert odometer.speed is not None
        speed, middle = odometer.speed, odometer.time
        sigma = np.full(len(speed), assumed.odometer_sigma)
        if odometer.sigma_speed is not None:
            sigma = np.where(np.isfinite(odometer.sigma_speed), np.maximum(odometer.sigma_speed, 0.01), sigma)
        keep = np.isfinite(speed)
    keep[keep] = np.append(True, np.diff(np.floor(middle[keep] / 0.2 + 1e-6)) > 0)
    if not odometer.signed:  # wheels that do not tell the direction say nothing about a vehicle that creeps
        sigma = np.where(np.abs(speed) < 0.5, np.inf, sigma)
    return VehicleMotion(middle[keep], speed[keep], sigma[keep], across, across)


def _position(found: AidedSolution) -> tuple[FloatArray, FloatArray]:
    """Latitude, longitude, height, (n + 1, 3), and horizontal covariance, north and east, m^2, (n + 1, 2, 2)."""
    tr = found.trajectory
    P = np.empty((len(tr.time), 2, 2))
    P[:, 0, 0], P[:, 1, 1] = found.sigma[:, 0] ** 2, found.sigma[:, 1] ** 2
    P[:, 0, 1] = P[:, 1, 0] = found.covariance_north_east
    return np.stack([tr.latitude, tr.longitude, tr.height], axis=1), P


def _wheel_filter(
    guide: AidedSolution,
    time: FloatArray,
    rate: FloatArray,
    force: FloatArray,
    rests: Rests,
    motion: VehicleMotion,
    told: FloatArray,
    assumed: InertialSettings,
) -> tuple[FloatArray, FloatArray]:
    """Position and horizontal covariance of the INS/odometer filter, started anew from the INS/GNSS filter while that one has fixes."""
    fixed = told[told <= time[-1]]
    starts = [guide.trajectory.time[0]]
    for t in fixed.tolist():
        if t - starts[-1] >= RESTART and t < time[-1] - 1.0:
            starts.append(t)
    edges = np.searchsorted(time, starts, side="right")
    edges[0] = 0
    place, P = _position(guide)
    place, P = place.copy(), P.copy()
    mounting, mounting_sigma, scale, scale_sigma = np.zeros(2), 2.0 * _DEGREE, 0.0, 0.02
    for first, last in zip(edges, [*edges[1:], len(time)], strict=True):
        if last <= first:
            continue
        begin = float(guide.trajectory.time[first])
        bias = {name: guide.parameters[name][first] for name in guide.parameters}
        spread = {name: float(guide.parameter_sigma[name][first].max()) for name in guide.parameter_sigma}
        part = slice(first, last)
        inside = (motion.time > begin) & (motion.time <= time[last - 1])
        still = (rests.time > begin) & (rests.time <= time[last - 1])
        rates = None if rests.rate_ib_b is None else (rests.rate_ib_b[still] - bias["gyro_bias"])
        sigma = guide.sigma[first]
        lateral, vertical = np.asarray(motion.sigma_lateral)[inside], np.asarray(motion.sigma_vertical)[inside]
        forward = None if motion.forward is None else motion.forward[inside] / (1.0 + scale)
        got = integrate(
            guide.trajectory.state(int(first)),
            InitialSigma(sigma[:3], sigma[3:6], sigma[6:9], spread["gyro_bias"], spread["accelerometer_bias"]),
            time[part],
            (rate[part] - bias["gyro_bias"]) / (1.0 + bias["gyro_scale"]),
            (force[part] - bias["accelerometer_bias"]) / (1.0 + bias["accelerometer_scale"]),
            assumed.noise,
            start_time=begin,
            rests=Rests(rests.time[still], rates, rests.sigma_velocity, rests.sigma_rate),
            vehicle_motion=VehicleMotion(
                motion.time[inside], forward, np.asarray(motion.sigma_forward)[inside], lateral, vertical
            ),
            vehicle=Vehicle(mounting=(float(mounting[0]), float(mounting[1]))),
            unknowns=Unknowns(
                axle_arm=1.0,
                mounting=mounting_sigma,
                odometer_scale=scale_sigma,
                gyro_scale=spread["gyro_scale"],
                accelerometer_scale=spread["accelerometer_scale"],
            ),
            gate={"vehicle": 20.0, "rests": 20.0},
        )
        place[first + 1 : last + 1], P[first + 1 : last + 1] = (x[1:] for x in _position(got))
        mounting = mounting + got.parameters["mounting"][-1]
        # what one piece learnt the next one may doubt a little
        mounting_sigma = max(1.5 * float(got.parameter_sigma["mounting"][-1].max()), 0.2 * _DEGREE)
        scale = (1.0 + scale) * (1.0 + float(got.parameters["odometer_scale"][-1, 0])) - 1.0
        scale_sigma = max(1.5 * float(got.parameter_sigma["odometer_scale"][-1, 0]), 1e-3)
    return place, P


def _fused(first: AidedSolution, place: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    a, Pa = _position(first)
    scale = position_scale(first.trajectory.state(0))[:2]
    apart = (place[:, :2] - a[:, :2]) * scale
    try:
        both = fuse(np.zeros_like(apart), Pa, apart, covariance)
    except EstimationError as error:
        raise EstimationError(f"the two filters cannot be fused: {error}") from None
    fused = a.copy()
    fused[:, :2] += both.state / scale
    return fused, both.covariance, float(both.weight.mean())


def _solution(
    run: Run,
    found: AidedSolution,
    position: FloatArray,
    covariance: FloatArray,
    told: FloatArray,
    begin: _Start,
    frame: GridFrame | None,
    integrity_risk: float,
    smooth: bool,
    assumed: InertialSettings,
) -> Solution:
    from scipy.stats import norm

    tr, imu = found.trajectory, run.imu
    assert imu is not None
    time = raw_table(run)[:, 0]
    m = len(time)
    there = (time >= begin.time) & (time <= tr.time[-1] + 0.5)
    t = time[there]
    C_nb = tr.C_nb
    # the reference point, and axes of the vehicle
    C_nv = C_nb @ begin.levelled
    scale = position_scale(tr.state(0))
    arm = np.einsum("kij,j->ki", C_nv, imu.lever_arm_b)
    place = position - arm * [1.0, 1.0, -1.0] / scale

    def at(column: FloatArray) -> FloatArray:
        return np.asarray(np.interp(t, tr.time, column))

    nose = C_nb[:, :, 0]
    if "mounting" in found.parameters:
        pitch, yaw = found.parameters["mounting"].T
        # the vehicle's forward axis in body axes is the first row of exp([(0, pitch, yaw) x])
        nose = nose + C_nb[:, :, 1] * -yaw[:, None] + C_nb[:, :, 2] * pitch[:, None]
    heading = np.unwrap(np.arctan2(nose[:, 1], nose[:, 0]))
    along = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    speed = np.einsum("ki,ki->k", tr.velocity_n, nose / np.linalg.norm(nose, axis=1)[:, None])
    sigma_along = np.sqrt(np.maximum(np.einsum("ki,kij,kj->k", along, covariance, along), 0.0))
    side = np.stack([-along[:, 1], along[:, 0]], axis=1)
    sigma_cross = np.sqrt(np.maximum(np.einsum("ki,kij,kj->k", side, covariance, side), 0.0))
    usual = max(float(np.median(np.diff(tr.time))), 1e-3)
    window = max(1, round(0.5 / usual))
    smoothed_speed = np.convolve(
        np.pad(speed, (window // 2, window - 1 - window // 2), mode="edge"), np.ones(window) / window, "valid"
    )
    acceleration = np.gradient(smoothed_speed, tr.time)
    columns = {
        name: np.full(m, np.nan)
        for name in (
            "latitude",
            "longitude",
            "height",
            "heading",
            "speed",
            "acceleration",
            "along",
            "cross",
            "east",
            "north",
            "up",
        )
    }
    for name, value in (
        ("latitude", place[:, 0]),
        ("longitude", place[:, 1]),
        ("height", place[:, 2]),
        ("heading", heading),
        ("speed", speed),
        ("acceleration", acceleration),
        ("along", sigma_along),
        ("cross", sigma_cross),
    ):
        columns[name][there] = at(value)
    columns["heading"] = np.mod(columns["heading"], 2.0 * math.pi)
    since = np.full(m, np.inf)
    seen = np.searchsorted(told, time, side="right") - 1
    since[seen >= 0] = (time - told[np.maximum(seen, 0)])[seen >= 0]
    mode = np.where(since > assumed.coasting_after, int(Mode.COASTING), int(Mode.TRACKING))
    with np.errstate(invalid="ignore"):
        lost = np.hypot(columns["along"], columns["cross"]) > assumed.lost_sigma
    mode = np.where(lost, int(Mode.LOST), mode)
    mode = np.where(time < begin.time, int(Mode.INITIALISING), np.where(there, mode, int(Mode.LOST)))
    for column in columns.values():
        column[mode == Mode.LOST] = np.nan
    placed = np.flatnonzero(np.isfinite(columns["latitude"]))
    plane = frame or choose_frame(columns["latitude"][placed], columns["longitude"][placed])
    grid = plane.to_grid(*(columns[name][placed] for name in ("latitude", "longitude", "height")))
    for name, value in zip(("east", "north", "up"), grid, strict=True):
        columns[name][placed] = value
    unknown = np.full(m, np.nan)
    return Solution(
        track_id=(),
        line=(),
        time=time.copy(),
        track=np.full(m, -1, dtype=np.int64),
        offset=unknown.copy(),
        chainage=unknown.copy(),
        easting=columns["east"],
        northing=columns["north"],
        height=columns["up"],
        latitude=columns["latitude"],
        longitude=columns["longitude"],
        ellipsoidal_height=columns["height"],
        heading=columns["heading"],
        speed=columns["speed"],
        acceleration=columns["acceleration"],
        sigma_along=columns["along"],
        sigma_cross=columns["cross"],
        protection_level_along=columns["along"] * float(norm.isf(0.5 * integrity_risk)),
        track_probability=unknown.copy(),
        mode=mode.astype(np.int64),
        running_direction=np.zeros(m, dtype=np.int64),
        run_id=run.id,
        start=run.start.isoformat().replace("+00:00", "Z"),
        crs_wkt=plane.crs_wkt,
        integrity_risk=integrity_risk,
        smoothed=smooth,
        diagnostics={
            "epochs": m,
            "modes": {kind.label: int((mode == kind).sum()) for kind in Mode},
        },
    )


def _diagnostics(found: AidedSolution, begin: _Start, rests: int) -> dict[str, Any]:
    """What was estimated, at the end, with sigmas; JSON values, spelled units."""
    out: dict[str, Any] = {"start_s": begin.time, "rests_used": rests}
    roll, pitch = euler_from_dcm(begin.levelled)[:2]
    out["levelled_roll_deg"], out["levelled_pitch_deg"] = float(roll) / _DEGREE, float(pitch) / _DEGREE
    units = {
        "time_offset": ("time_offset_s", 1.0),
        "mounting": ("mounting_pitch_yaw_deg", 1.0 / _DEGREE),
        "axle_arm": ("axle_arm_m", 1.0),
        "odometer_scale": ("odometer_scale", 1.0),
        "gyro_bias": ("gyro_bias_deg_h", 3600.0 / _DEGREE),
        "accelerometer_bias": ("accelerometer_bias_m_s2", 1.0),
        "gyro_scale": ("gyro_scale", 1.0),
        "accelerometer_scale": ("accelerometer_scale", 1.0),
    }
    for name, (label, factor) in units.items():
        if name in found.parameters:
            value, sigma = found.parameters[name][-1] * factor, found.parameter_sigma[name][-1] * factor
            out[label] = {"value": value.tolist(), "sigma": sigma.tolist()}
    out["nis"] = {name: float(np.nanmean(v)) for name, v in found.nis.items() if np.isfinite(v).any()}
    out["rejected"] = {name: int((~used & np.isfinite(found.nis[name])).sum()) for name, used in found.used.items()}
    return out
