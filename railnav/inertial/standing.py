"""What the inertial unit of a standing vehicle tells: roll, pitch, gyrocompass heading and latitude, each with its confidence interval."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.attitude import dcm_from_euler
from railnav.errors import EstimationError
from railnav.inertial.alignment import Alignment, coarse_align, level
from railnav.inertial.autonomous import coning_rate, fixed_latitude
from railnav.inertial.fine_alignment import FineAlignment, fine_align
from railnav.inertial.heading import heading_from_velocity
from railnav.inertial.inspection import inspect_log
from railnav.inertial.mechanization import EARTH_RATE
from railnav.inertial.resting import Rest, Stretch, find_stretches, rest
from railnav.run import GnssStream, ImuStream, OdometerStream, Run
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]

#: Two-sided 95 % of a normal distribution.
INTERVAL_95 = 1.959964
#: A vehicle faster than this moves, m/s, if that is also more than three sigma.
STANDING_SPEED = 0.1
#: What is taken for biases when nothing is known of the unit: a telephone's, rad/s and m/s^2.
UNKNOWN_GYRO_BIAS, UNKNOWN_ACCELEROMETER_BIAS = math.radians(1.0), 0.5
#: No road and no track leans more than this, rad.
LARGEST_LEAN = math.radians(9.0)
#: A latitude less sure than this is not worth giving, rad.
WORST_LATITUDE = math.radians(20.0)


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """What a standing vehicle's inertial unit tells.

    Attributes
    ----------
    begin, end : float
        The rest that was used, s.
    still : Rest
        Means in body axes, corrected.
    alignment : Alignment
        Roll, pitch, heading, with sigmas.
    fine : FineAlignment or None
        Refined by zero-velocity updates, where there was a heading to start from and it was asked for.
    latitude, sigma_latitude : float or None
        rad; None where the gyros cannot tell.
    latitude_note : str
        Why not.
    coning : float
        Mean rate that a conic motion of the base would add, rad/s, noise included.
    gyro_bias_sigma, accelerometer_bias_sigma : float
        What was taken for biases, rad/s and m/s^2.
    velocity_heading, sigma_velocity_heading : float or None
        Heading of the first motion after the rest, from GNSS, rad: of the nose, if the vehicle went forward.
    remarks : tuple of str
        What was assumed, and what nothing confirms.
    """

    begin: float
    end: float
    still: Rest
    alignment: Alignment
    fine: FineAlignment | None
    latitude: float | None
    sigma_latitude: float | None
    latitude_note: str
    coning: float
    gyro_bias_sigma: float
    accelerometer_bias_sigma: float
    velocity_heading: float | None
    sigma_velocity_heading: float | None
    remarks: tuple[str, ...]


def body_axes(imu: ImuStream) -> tuple[FloatArray, FloatArray]:
    """Rates and specific forces turned from the unit's axes into those of the vehicle, v_b = (Rz Ry Rx) v_imu, (m, 3) each."""
    roll, pitch, yaw = imu.mounting
    C = dcm_from_euler(float(roll), float(pitch), float(yaw))
    return imu.gyro @ C.T, imu.specific_force @ C.T


def align_standing(
    run: Run,
    *,
    between: tuple[float, float] | None = None,
    latitude: float | None = None,
    gyro_bias_sigma: float | None = None,
    accelerometer_bias_sigma: float | None = None,
    angle_random_walk: float | None = None,
    velocity_random_walk: float | None = None,
    fine: bool = False,
    shortest: float = 1.5,
) -> Standing:
    """Align a vehicle at rest from its inertial unit: level, gyrocompass, latitude.

    Parameters
    ----------
    run : Run
        With an IMU stream, calibrated if a calibration is at hand; GNSS and odometer, where there are, say whether it stood.
    between : (float, float), optional
        Times between which to align, s: refused, with the evidence, if the vehicle moved. By default the longest rest that neither GNSS nor
        odometer contradicts.
    latitude : float, optional
        rad; default: from GNSS. Checks the rate, and is needed for the fine alignment.
    gyro_bias_sigma, accelerometer_bias_sigma : float, optional
        What biases may remain, rad/s and m/s^2; default: unknown, taken as large, and said so.
    angle_random_walk, velocity_random_walk : float, optional
        For the fine alignment, rad/sqrt(s), m/s/sqrt(s); default: from the scatter of the samples.
    fine : bool, optional
        Refine by zero-velocity updates.
    shortest : float, optional
        A rest that is shorter does not count, s.

    Returns
    -------
    Standing

    Raises
    ------
    EstimationError
        No IMU, a defect of the log, or motion: with the evidence.

    Notes
    -----
    sigma of the latitude: gyro errors over the Earth's rate and accelerometer errors over gravity, together; a bias is not averaged out. A
    gyro of 10 deg/h finds neither heading nor latitude.

    References
    ----------
    `spec/inertial.md` A1, A6, B10.
    """
    if run.imu is None:
        raise EstimationError(f"run {run.id} has no IMU: there is nothing to align with")
    imu = run.imu
    w, f = body_axes(imu)
    for finding in inspect_log(imu.time, imu.gyro, imu.specific_force):
        if finding.kind not in ("gap", "axes"):
            raise EstimationError(finding.sentence)
    for finding in inspect_log(imu.time, w, f):
        if finding.kind == "axes":
            raise EstimationError(finding.sentence)
    stretch, remarks = _rest_of(run, w, f, between, shortest)
    rows = slice(stretch.first, stretch.last)
    interval = float(np.median(np.diff(imu.time[rows])))
    still = rest(interval, w[rows], f[rows])
    known_gyro, known_force = gyro_bias_sigma is not None, accelerometer_bias_sigma is not None
    gyro = gyro_bias_sigma if gyro_bias_sigma is not None else UNKNOWN_GYRO_BIAS
    force = accelerometer_bias_sigma if accelerometer_bias_sigma is not None else UNKNOWN_ACCELEROMETER_BIAS
    if not known_gyro:
        remarks.append(
            f"nothing is known of the gyros' biases: taken as {math.degrees(gyro):.0f} deg/s, so that there is no heading and no latitude; "
            "give a calibration or the unit's data sheet"
        )
    if not known_force:
        remarks.append(
            f"nothing is known of the accelerometers' biases: taken as {force:.1f} m/s^2 ({math.degrees(force / 9.8):.1f} degrees of tilt)"
        )
    gnss = run.gnss
    place = latitude
    if place is None and gnss is not None and len(gnss):
        place = float(np.median(gnss.latitude))
    found = coarse_align(still, place, gyro_bias_sigma=gyro, accelerometer_bias_sigma=force)
    if found.heading is None:
        rate = math.hypot(gyro, float(still.sigma_rate.max()))
        earth = EARTH_RATE * (math.cos(place) if place is not None else 1.0)
        if rate > earth:
            note = (
                f"the gyros cannot see the Earth's rotation: their errors of {_hour(rate):.3g} deg/h exceed its level part of "
                f"{_hour(earth):.1f} deg/h"
            )
            found = replace(found, note=note)
    coning = coning_rate(w[rows], interval)
    by_noise = _density(w[rows], interval) ** 2  # white noise alone encloses about half of its density squared a second
    if coning > max(5.0 * by_noise, 0.5 * math.hypot(gyro, float(still.sigma_rate.max()))):
        remarks.append(
            f"the base cones: {_hour(coning):.2f} deg/h are added to the Earth's rotation, which heading and latitude take "
            "for it; stop the machine"
        )
    remarks += _mounted(imu, imu.specific_force[rows].mean(axis=0), found)
    where, sigma_where, why = _latitude(still, gyro, force)
    refined = None
    if fine:
        if found.heading is None or place is None:
            remarks.append(
                "no fine alignment: "
                + ("there is no heading to start from" if found.heading is None else "the latitude is unknown")
            )
        else:
            arw = angle_random_walk if angle_random_walk is not None else _density(w[rows], interval)
            vrw = velocity_random_walk if velocity_random_walk is not None else _density(f[rows], interval)
            refined = fine_align(
                found,
                interval,
                w[rows],
                f[rows],
                place,
                gyro_bias_sigma=gyro,
                accelerometer_bias_sigma=force,
                angle_random_walk=arw,
                velocity_random_walk=vrw,
            )
    heading = _first_heading(gnss, stretch.end) if gnss is not None else None
    return Standing(
        stretch.begin,
        stretch.end,
        still,
        found,
        refined,
        where,
        sigma_where,
        why,
        coning,
        gyro,
        force,
        None if heading is None else heading[0],
        None if heading is None else heading[1],
        tuple(remarks),
    )


def _rest_of(
    run: Run, w: FloatArray, f: FloatArray, between: tuple[float, float] | None, shortest: float
) -> tuple[Stretch, list[str]]:
    """The stretch to align in, after asking GNSS and odometer."""
    imu = run.imu
    assert imu is not None
    remarks: list[str] = []
    if between is not None:
        begin, end = between
        inside = np.flatnonzero((imu.time >= begin) & (imu.time <= end))
        if len(inside) < 100:
            raise EstimationError(
                f"{len(inside)} IMU samples from {begin:g} to {end:g} s are too few; the log runs from {imu.time[0]:.1f} "
                f"to {imu.time[-1]:.1f} s"
            )
        moved = _moving(run, begin, end)
        if moved:
            raise EstimationError(f"the vehicle moves between {begin:g} and {end:g} s: {moved}; align at rest")
        stretch = Stretch(
            int(inside[0]), int(inside[-1]) + 1, float(imu.time[inside[0]]), float(imu.time[inside[-1]]), False
        )
        return stretch, remarks + _unconfirmed(run)
    found, motion = find_stretches(imu.time, w, f, shortest=shortest)
    evidence = (
        f"it turns by up to {math.degrees(motion.rate):.2f} deg/s and {motion.force:.2f} m/s^2 from piece to piece "
        f"(at {motion.rate_time:.1f} and {motion.force_time:.1f} s)"
    )
    rests = []
    contradicted = ""
    for stretch in found:
        if stretch.turning or stretch.last - stretch.first < 100:
            continue
        moved = _moving(run, stretch.begin, stretch.end)
        if moved:
            contradicted = contradicted or f"from {stretch.begin:.1f} to {stretch.end:.1f} s it runs evenly: {moved}"
        else:
            rests.append(stretch)
    if not rests:
        why = f"{contradicted}; elsewhere {evidence}" if contradicted else evidence
        raise EstimationError(f"the vehicle moves throughout: {why}; align at rest, for {shortest:g} s or longer")
    if run.gnss is None and run.odometer is None:
        # without a witness even running looks like rest: the first rest is the likeliest to be one
        return rests[0], remarks + _unconfirmed(run)
    return max(rests, key=lambda one: one.duration), remarks


def _mounted(imu: ImuStream, force: FloatArray, found: Alignment) -> list[str]:
    """What to ask where a vehicle at rest seems to lean as none does."""
    lean = math.hypot(found.roll, found.pitch)
    if lean < LARGEST_LEAN:
        return []
    text = f"the vehicle leans by {math.degrees(lean):.0f} degrees, as none stands: check mounting_deg"
    roll, pitch, yaw = (float(v) for v in imu.mounting)
    other = math.hypot(*(float(v) for v in level(force @ dcm_from_euler(roll, pitch, yaw))))
    if other < 0.5 * lean:
        text += f"; turned the other way (its inverse) it would leave {math.degrees(other):.1f} degrees"
    return [text]


def _unconfirmed(run: Run) -> list[str]:
    if run.gnss is not None or run.odometer is not None:
        return []
    return [
        "neither GNSS nor odometer confirms that the vehicle stood: running evenly on straight track feels the same"
    ]


def _moving(run: Run, begin: float, end: float) -> str:
    """Evidence of motion from GNSS or odometer between two times; empty if there is none."""
    for name, stream in (("GNSS", run.gnss), ("odometer", run.odometer)):
        if stream is None:
            continue
        speed, sigma = _speed_of(stream)
        if speed is None:
            continue
        here = (stream.time >= begin) & (stream.time <= end) & np.isfinite(speed)
        fast = here & (np.abs(speed) > np.maximum(STANDING_SPEED, 3.0 * sigma))
        if np.any(fast):
            k = int(np.argmax(np.where(fast, np.abs(speed), 0.0)))
            return f"{name} shows {abs(float(speed[k])):.2f} m/s at {stream.time[k]:.1f} s"
    return ""


def _speed_of(stream: GnssStream | OdometerStream) -> tuple[FloatArray | None, FloatArray]:
    zero = np.zeros(len(stream))
    speed = stream.speed
    if speed is None and isinstance(stream, OdometerStream) and stream.distance is not None:
        speed = np.gradient(stream.distance, stream.time) if len(stream) > 1 else None
    sigma = zero if stream.sigma_speed is None else np.nan_to_num(stream.sigma_speed)
    return speed, sigma


def _latitude(still: Rest, gyro: float, force: float) -> tuple[float | None, float | None, str]:
    g = float(np.linalg.norm(still.specific_force_b))
    sigma = math.hypot(
        math.hypot(gyro, float(still.sigma_rate.max())) / EARTH_RATE,
        math.hypot(force, float(still.sigma_force.max())) / g,
    )
    if sigma > WORST_LATITUDE:
        return (
            None,
            None,
            f"gyro errors of {_hour(gyro):.3g} deg/h would make the latitude {math.degrees(sigma):.0f} degrees unsure",
        )
    size = float(np.linalg.norm(still.rate_ib_b))
    if abs(size - EARTH_RATE) > 4.0 * math.hypot(gyro, float(np.linalg.norm(still.sigma_rate))):
        return (
            None,
            None,
            f"the rate measured, {_hour(size):.2f} deg/h, is not the Earth's {_hour(EARTH_RATE):.2f}: the base turns, or the biases are "
            "larger than stated",
        )
    return fixed_latitude(still.rate_ib_b, still.specific_force_b).latitude, sigma, ""


def _first_heading(gnss: GnssStream, after: float) -> tuple[float, float] | None:
    """Heading of the first motion after a time whose GNSS velocity is sure enough."""
    if gnss.speed is None or gnss.course is None:
        return None
    sigma = gnss.sigma_speed if gnss.sigma_speed is not None else np.full(len(gnss), 0.1)
    for k in np.flatnonzero((gnss.time > after) & np.isfinite(gnss.speed) & np.isfinite(gnss.course)):
        v = gnss.speed[k] * np.array([math.cos(gnss.course[k]), math.sin(gnss.course[k])])
        s = float(sigma[k]) if np.isfinite(sigma[k]) and sigma[k] > 0.0 else 0.1
        found = heading_from_velocity(v, s, worst=math.radians(5.0))
        if bool(found.valid):
            return float(wrap_angle(found.heading)), float(found.sigma)
    return None


def _density(x: FloatArray, interval: float) -> float:
    """Density of the white noise of samples at rest, the worst axis."""
    return float(np.diff(x, axis=0).std(axis=0).max()) / math.sqrt(2.0) * math.sqrt(interval)


def _hour(rate: float) -> float:
    return math.degrees(rate) * 3600.0
