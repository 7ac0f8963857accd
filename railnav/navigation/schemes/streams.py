"""What a run's streams say to an inertial scheme: where it starts, samples in body axes, fixes, rests, the vehicle's motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from railnav.attitude import dcm_from_euler
from railnav.errors import RunError
from railnav.inertial.aided import Fixes, Rests, VehicleMotion, find_rests
from railnav.inertial.error_model import position_scale
from railnav.inertial.imu_noise import ImuNoise, InitialSigma
from railnav.inertial.mechanization import NavigationState
from railnav.navigation.epochs import body_from_imu
from railnav.run import GnssStream, OdometerStream, Run

FloatArray = NDArray[np.float64]
_DEGREE = math.pi / 180


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
class Start:
    """Where inertial navigation begins."""

    time: float
    state: NavigationState
    initial: InitialSigma
    levelled: FloatArray  # turn of the IMU's body axes that makes the vehicle level at rest, (3, 3)
    tilt: tuple[float, float]


def gnss_velocity(gnss: GnssStream) -> FloatArray:
    """North and east velocity of each fix, m/s, NaN where it says nothing; from positions where the stream has no speed."""
    if gnss.speed is not None and gnss.course is not None:
        # a resting receiver has no course, but its velocity is known
        course = np.where(np.isnan(gnss.course) & (gnss.speed < 0.5), 0.0, gnss.course)
        return np.stack([gnss.speed * np.cos(course), gnss.speed * np.sin(course)], axis=1)
    scale = position_scale(NavigationState(float(gnss.latitude[0]), float(gnss.longitude[0]), 0.0))
    place = np.stack([gnss.latitude * scale[0], gnss.longitude * scale[1]], axis=1)
    return np.asarray(np.gradient(place, gnss.time, axis=0))


def find_start(run: Run, assumed: InertialSettings) -> Start:
    """Level at rest, head for the course of the first motion, begin with the last fix before it (or in motion if there is no rest)."""
    gnss, imu = run.gnss, run.imu
    assert gnss is not None
    assert imu is not None
    velocity = gnss_velocity(gnss)
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
    offset = C_nb @ np.asarray(antenna_arm(run)) / position_scale(antenna)
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
    return Start(float(gnss.time[at]), state, initial, levelled, tilt)


def _quiet(time: FloatArray, force: FloatArray, end: float) -> NDArray[np.bool_] | None:
    """Samples of the two seconds before an instant, None if the vehicle shakes in them."""
    still = (time > end - 2.0) & (time <= end)
    if still.sum() < 10:
        return None
    halves = np.array_split(force[still], 4)
    apart = np.ptp([h.mean(axis=0) for h in halves], axis=0).max()
    return still if apart < 0.3 else None


def antenna_arm(run: Run) -> tuple[float, float, float]:
    """IMU to antenna, body axes, m."""
    assert run.gnss is not None
    assert run.imu is not None
    a, b, c = (float(x) for x in run.gnss.lever_arm_b - run.imu.lever_arm_b)
    return a, b, c


def body_samples(run: Run, begin: Start) -> tuple[FloatArray, FloatArray, FloatArray]:
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


def fixes_of(gnss: GnssStream, assumed: InertialSettings) -> Fixes:
    """Fixes with sigmas that count an error which lasts once."""
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
    velocity = gnss_velocity(gnss)
    speed_sigma = np.full(len(gnss), assumed.speed_sigma)
    if gnss.sigma_speed is not None:
        speed_sigma = np.where(np.isfinite(gnss.sigma_speed), np.maximum(gnss.sigma_speed, 0.02), speed_sigma)
    # course is as good as the speed across allows; a resting receiver's is none, but its velocity is zero all the same
    across = np.hypot(speed_sigma, assumed.course_sigma * gnss.speed)
    each = np.where(np.isfinite(velocity).all(axis=1), 1.7 * np.maximum(speed_sigma, across), np.inf)
    sigma_v = np.stack([each, each, np.full(len(gnss), np.inf)], axis=1)
    return Fixes(gnss.time, position, sigma, np.column_stack([np.nan_to_num(velocity), np.zeros(len(gnss))]), sigma_v)


def rests_of(run: Run, time: FloatArray, rate: FloatArray, force: FloatArray) -> Rests:
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


def motion_of(odometer: OdometerStream | None, time: FloatArray, assumed: InertialSettings) -> VehicleMotion:
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
