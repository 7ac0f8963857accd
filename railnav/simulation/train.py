"""A simulated train: truth on a model, and what its sensors would have recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.geodesy.ellipsoid import WGS84
from railnav.run import (
    BaliseStream,
    GaugeStream,
    GnssStream,
    GyroAnglesStream,
    ImuStream,
    OdometerStream,
    Progress,
    Run,
)
from railnav.simulation.driving import Driving, Motion, drive
from railnav.simulation.inertial import attitude_matrix, interval_means
from railnav.simulation.journey import Leg, Path, path_of
from railnav.simulation.sensors import (
    SERVICE,
    AnglesSensor,
    BaliseSensor,
    GaugeSensor,
    GnssSensor,
    ImuSensor,
    OdometerSensor,
    Outfit,
    gauss_markov,
)
from railnav.track.model import Route, TrackModel
from railnav.truth import Truth
from railnav.units import cant_angle, wrap_angle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: When a simulated run starts unless told otherwise.
START = datetime(2026, 5, 4, 8, 0, 0, tzinfo=UTC)
#: Below this speed a receiver states no course, m/s.
SLOWEST_COURSE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Where the reference point is and how the vehicle stands: (m,) arrays, SI and radians.

    Attributes
    ----------
    time, distance : (m,) array
        s; distance run, m.
    speed, acceleration : (m,) array
        Along the nose, m/s, m/s^2.
    latitude, longitude, height : (m,) array
        WGS 84; height 0 where the model has none.
    roll, pitch, heading : (m,) array
        Right side down, nose up, nose from true north, rad.
    """

    time: FloatArray
    distance: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    height: FloatArray
    roll: FloatArray
    pitch: FloatArray
    heading: FloatArray

    @property
    def attitude_nb(self) -> FloatArray:
        """C_nb, (m, 3, 3)."""
        return attitude_matrix(self.roll, self.pitch, self.heading)

    @property
    def velocity_n(self) -> FloatArray:
        """North, east, down, (m, 3), m/s."""
        ahead = self.speed * np.cos(self.pitch)
        return np.stack(
            [ahead * np.cos(self.heading), ahead * np.sin(self.heading), -self.speed * np.sin(self.pitch)], axis=-1
        )


def poses(path: Path, motion: Motion, time: FloatArray) -> Poses:
    """Pose of the vehicle at times.

    Body axes follow the track under the reference point: heading and pitch its tangent, roll its cant angle.

    Parameters
    ----------
    path : Path
    motion : Motion
    time : (m,) array
        s.

    Returns
    -------
    Poses
    """
    distance, speed, acceleration = motion.at(time)
    distance = np.clip(distance, 0.0, path.length)
    here, nose = path.at(distance), path.nose(distance)
    gear = path.gear[path.piece(distance)]
    height = np.nan_to_num(here.height)
    latitude, longitude, up = path.model.frame.to_geodetic(here.easting, here.northing, height)
    return Poses(
        time=time,
        distance=distance,
        speed=gear * speed,
        acceleration=gear * acceleration,
        latitude=latitude,
        longitude=longitude,
        height=up,
        roll=nose * cant_angle(here.cant),
        pitch=np.asarray(nose * np.arctan(here.gradient)),
        heading=np.mod(here.heading + np.where(nose > 0, 0.0, np.pi), 2.0 * np.pi),
    )


def simulate(
    model: TrackModel,
    journey: Route | Leg | Sequence[str] | Sequence[Leg],
    *,
    seed: int,
    outfit: Outfit = SERVICE,
    driving: Driving | None = None,
    outages: Sequence[tuple[float, float]] = (),
    tunnels: bool = True,
    run_id: str = "simulated",
    start: datetime = START,
    direction: str = "",
    truth_interval: float = 0.1,
    declare: bool = False,
    progress: Progress | None = None,
) -> tuple[Run, Truth]:
    """Drive a train over a model and record what its sensors would have seen.

    Parameters
    ----------
    model : TrackModel
    journey : Route, Leg, sequence of str, or sequence of Leg
        A lawful path; see `railnav.simulation.journey.path_of`.
    seed : int
        Same seed, same run; each sensor draws from its own stream of numbers.
    outfit : Outfit
        Sensors carried: `SURVEY`, `SERVICE`, `PHONE` or your own.
    driving : Driving, optional
        Limits that the driver keeps.
    outages : sequence of (from, to)
        Times without GNSS, s.
    tunnels : bool
        Whether GNSS is silent in `model.provenance["tunnels"]`.
    run_id, start, direction
        As in run.toml; `start` is UTC.
    truth_interval : float
        Time between rows of truth, s.
    declare : bool
        Whether the run declares its sensors' errors, as their data sheets would (`Run.gnss.errors` and so on); the data are the same.
    progress : callable, optional
        Told the stage, done and total.

    Returns
    -------
    run : Run
    truth : Truth

    Raises
    ------
    TrackError
        An unlawful path, a place off the model, a path that has heights only in parts, or an interval that is not positive.

    Notes
    -----
    Twenty minutes with a 100 Hz IMU take about 0.5 s. The vehicle is rigid and follows the track under its reference point: where
    a cant ramp begins it rolls at once, and an IMU on a long lever arm feels a knock that suspension would soften.

    Examples
    --------
    >>> from railnav.simulation import Leg, demo_line
    >>> run, truth = simulate(demo_line(spacing=20.0), Leg(("77R-01",), start=50.0, finish=700.0), seed=1)
    >>> len(run.imu) // 100 == int(truth.time[-1]), round(float(truth.offset[-1]), 3)
    (True, 700.0)
    """
    path = path_of(model, journey)
    known = np.isfinite(path.at(np.append(np.arange(0.0, path.length, 10.0), path.length)).height)
    if known.any() and not known.all():
        raise TrackError("the path has heights only in parts; give all of its tracks heights, or none")
    motion = drive(path, driving)
    streams = {
        name: np.random.default_rng(sequence)
        for name, sequence in zip(
            ("gnss", "imu", "odometer", "angles", "gauge", "balise"), np.random.SeedSequence(seed).spawn(6), strict=True
        )
    }
    made: dict[str, Any] = {}
    carried = [name for name in streams if getattr(outfit, name) is not None]
    for done, name in enumerate(carried):
        if progress is not None:
            progress("simulating sensors", done, len(carried))
        sensor = getattr(outfit, name)
        if not sensor.interval > 0.0:
            raise TrackError(f"the interval of {name} is {sensor.interval} s, not positive")
        time = _ticks(motion.duration, sensor.interval)
        generator = streams[name]
        if name == "gnss":
            silent = _silent(model, path, motion, time, sensor, outages, tunnels)
            made[name] = _gnss(path, motion, time, sensor, generator, ~silent, bool(known.all()))
        elif name == "imu":
            made[name] = _imu(path, motion, time, sensor, generator)
        elif name == "odometer":
            made[name] = _odometer(path, motion, time, sensor, generator)
        elif name == "angles":
            made["gyro_angles"] = _angles(path, motion, time, sensor, generator)
        elif name == "gauge":
            made[name] = _gauge(path, motion, time, sensor, generator)
        else:
            read = _balises(path, motion, time, sensor, generator)
            made[name] = read if len(read.time) else None
        if declare and name in ("gnss", "imu", "odometer"):
            made[name] = replace(made[name], errors=sensor.sheet)
    if progress is not None:
        progress("simulating sensors", len(carried), len(carried))
    if not truth_interval > 0.0:
        raise TrackError(f"the interval of the truth is {truth_interval} s, not positive")
    run = Run(id=run_id, start=start, direction=direction, simulated=True, **made)
    return run, _truth(path, motion, _ticks(motion.duration, truth_interval), bool(known.all()))


def _ticks(duration: float, interval: float) -> FloatArray:
    """Instants k * interval from 0 to the duration."""
    return np.round(np.arange(int(duration / interval + 1e-9) + 1) * float(interval), 9)


def _truth(path: Path, motion: Motion, time: FloatArray, heights: bool) -> Truth:
    here = poses(path, motion, time)
    track, offset = path.locate(here.distance)
    return Truth(
        track_id=path.model.track_id,
        time=time,
        track=track.astype(np.int64),
        offset=offset,
        speed=here.speed,
        latitude=here.latitude,
        longitude=here.longitude,
        height=here.height if heights else np.full(len(time), np.nan),
        heading=here.heading,
        simulated=True,
    )


def _silent(
    model: TrackModel,
    path: Path,
    motion: Motion,
    time: FloatArray,
    sensor: GnssSensor,
    outages: Sequence[tuple[float, float]],
    tunnels: bool,
) -> BoolArray:
    """Epochs without a fix: outages, tunnels, and the time to find the satellites again."""
    fine = np.arange(0.0, motion.duration + 0.1, 0.1)
    dark = np.zeros(len(fine), bool)
    for begin, end in outages:
        if not end > begin:
            raise TrackError(f"the outage from {begin} to {end} s has no length")
        dark |= (fine >= begin - 1e-9) & (fine < end - 1e-9)
    if tunnels and model.provenance.get("tunnels"):
        track, offset = path.locate(np.clip(motion.at(fine)[0], 0.0, path.length))
        for tunnel in model.provenance["tunnels"]:
            inside = (offset >= tunnel["from_m"]) & (offset <= tunnel["to_m"])
            dark |= inside & (track == model.track_index(tunnel["track"]))
    last_dark = np.maximum.accumulate(np.where(dark, fine, -np.inf))
    i = np.clip(np.round(time / 0.1).astype(int), 0, len(fine) - 1)
    return np.asarray(dark[i] | (time - last_dark[i] < sensor.reacquisition))


def _lever(here: Poses, arm: FloatArray) -> FloatArray:
    """A lever arm in north, east, down, (m, 3), m."""
    return np.asarray(here.attitude_nb @ arm)


def _gnss(
    path: Path,
    motion: Motion,
    time: FloatArray,
    sensor: GnssSensor,
    generator: np.random.Generator,
    seen: BoolArray,
    heights: bool,
) -> GnssStream:
    count = len(time)
    arm = np.array(sensor.lever_arm_b)
    here = poses(path, motion, time)
    lever = _lever(here, arm)
    step = 1e-3  # the antenna's own speed: the lever arm turns with the vehicle
    turning = (_lever(poses(path, motion, time + step), arm) - _lever(poses(path, motion, time - step), arm)) / (
        2 * step
    )
    velocity = here.velocity_n + turning

    def errors(white: float, coloured: float) -> FloatArray:
        return generator.standard_normal(count) * white + gauss_markov(
            generator, count, sensor.interval, coloured, sensor.correlation_time
        )

    east = errors(sensor.white_horizontal, sensor.coloured_horizontal) + sensor.frame_offset[0]
    north = errors(sensor.white_horizontal, sensor.coloured_horizontal) + sensor.frame_offset[1]
    up = errors(sensor.white_vertical, sensor.coloured_vertical) + sensor.frame_offset[2]
    gross = np.where(generator.random(count) < sensor.outlier_probability, sensor.outlier_size, 0.0)
    wild = generator.standard_normal((3, count)) * gross
    north_total, east_total = lever[:, 0] + north + wild[0], lever[:, 1] + east + wild[1]
    latitude = here.latitude + north_total / (WGS84.meridian_radius(here.latitude) + here.height)
    longitude = here.longitude + east_total / (
        (WGS84.transverse_radius(here.latitude) + here.height) * np.cos(here.latitude)
    )
    height = here.height - lever[:, 2] + up + wild[2]
    speed_north, speed_east = velocity[:, :2].T + generator.standard_normal((2, count)) * sensor.speed_sigma
    speed = np.hypot(speed_north, speed_east)
    course = np.where(speed >= SLOWEST_COURSE, np.mod(np.arctan2(speed_east, speed_north), 2.0 * np.pi), np.nan)
    stated = np.full(int(seen.sum()), sensor.stated_factor)
    says = sensor.stated_factor > 0.0
    return GnssStream(
        time=time[seen],
        latitude=latitude[seen],
        longitude=longitude[seen],
        height=height[seen] if heights else None,
        sigma_east=stated * sensor.sigma_horizontal if says else None,
        sigma_north=stated * sensor.sigma_horizontal if says else None,
        sigma_up=stated * sensor.sigma_vertical if says and heights else None,
        speed=speed[seen],
        course=course[seen],
        sigma_speed=np.full(len(stated), sensor.speed_sigma) if sensor.speed_sigma > 0.0 else None,
        quality=np.full(len(stated), sensor.quality),
        lever_arm_b=arm,
        receiver=sensor.receiver,
    )


def _imu(path: Path, motion: Motion, time: FloatArray, sensor: ImuSensor, generator: np.random.Generator) -> ImuStream:
    here = poses(path, motion, time)
    arm = np.array(sensor.lever_arm_b)
    velocity, attitude = here.velocity_n, here.attitude_nb
    if arm.any():
        step = 1e-3
        velocity = velocity + (
            _lever(poses(path, motion, time + step), arm) - _lever(poses(path, motion, time - step), arm)
        ) / (2 * step)
    rate, force = interval_means(time, here.latitude, here.height, velocity, attitude)
    true_mounting = np.array(sensor.mounting) + generator.standard_normal(3) * sensor.mounting_sigma
    turn = attitude_matrix(*true_mounting[:, None])[0]  # v_imu = (Rz Ry Rx)^T v_body
    count, dt = len(rate), sensor.interval

    def spoil(value: FloatArray, white: float, bias: float, walk: float, scale: float, most: float) -> FloatArray:
        constant = generator.standard_normal(3) * bias
        factor = 1.0 + generator.standard_normal(3) * scale
        wander = np.cumsum(generator.standard_normal((count, 3)), axis=0) * (walk * np.sqrt(dt))
        noise = generator.standard_normal((count, 3)) * (white / np.sqrt(dt))
        return np.asarray(np.clip((value @ turn) * factor + constant + wander + noise, -most, most))

    return ImuStream(
        time=time[1:],
        gyro=spoil(
            rate, sensor.gyro_white, sensor.gyro_bias, sensor.gyro_bias_walk, sensor.gyro_scale, sensor.gyro_full_scale
        ),
        specific_force=spoil(
            force,
            sensor.accelerometer_white,
            sensor.accelerometer_bias,
            sensor.accelerometer_bias_walk,
            sensor.accelerometer_scale,
            sensor.accelerometer_full_scale,
        ),
        lever_arm_b=arm,
        mounting=np.array(sensor.mounting),
    )


def _odometer(
    path: Path, motion: Motion, time: FloatArray, sensor: OdometerSensor, generator: np.random.Generator
) -> OdometerStream:
    distance, _, acceleration = motion.at(time)
    distance = np.clip(distance, 0.0, path.length)
    scale = generator.standard_normal() * sensor.scale_sigma if sensor.scale_error is None else sensor.scale_error
    step = np.maximum(np.diff(distance), 0.0)
    # a rolling wheel's errors grow with the way, and stand still with it
    noisy = step * (1.0 + scale) + generator.standard_normal(len(step)) * sensor.roughness * np.sqrt(step)
    noisy = np.where(step > 0.0, np.maximum(noisy, 0.0), 0.0)
    pulling = np.sign(np.where(np.abs(acceleration[1:]) > 0.1, acceleration[1:], 0.0))
    starts = generator.random(len(step)) < sensor.slip_rate * sensor.interval / 3600.0
    lasts = np.maximum(1, np.round(generator.exponential(sensor.slip_duration, len(step)) / sensor.interval)).astype(
        int
    )
    sizes = generator.exponential(sensor.slip_size, len(step))
    for i in np.flatnonzero(starts & (pulling != 0.0)):
        span = slice(i, i + int(lasts[i]))
        noisy[span] *= np.maximum(1.0 + pulling[span] * min(float(sizes[i]), 0.9), 0.0)
    if sensor.signed:
        noisy = noisy * path.gear[path.piece(0.5 * (distance[1:] + distance[:-1]))]
    reading = np.append(0.0, np.cumsum(noisy))
    if sensor.resolution > 0.0:
        reading = np.floor(reading / sensor.resolution + 1e-9) * sensor.resolution
    return OdometerStream(time=time, distance=reading, signed=sensor.signed)


def _angles(
    path: Path, motion: Motion, time: FloatArray, sensor: AnglesSensor, generator: np.random.Generator
) -> GyroAnglesStream:
    here = poses(path, motion, time)
    bias = generator.standard_normal((3, 1)) * sensor.bias
    noise = generator.standard_normal((3, len(time))) * sensor.white + bias
    return GyroAnglesStream(
        time=time,
        roll=here.roll + noise[0],
        pitch=here.pitch + noise[1],
        heading=np.mod(wrap_angle(here.heading + noise[2]), 2.0 * np.pi),
    )


def _gauge(
    path: Path, motion: Motion, time: FloatArray, sensor: GaugeSensor, generator: np.random.Generator
) -> GaugeStream:
    distance = np.clip(motion.at(time)[0], 0.0, path.length)
    noise = generator.standard_normal((2, len(time))) * sensor.sigma
    # left and right are the vehicle's: facing against growing offset, the cant changes sign
    cant = path.at(distance).cant * path.nose(distance)
    return GaugeStream(time=time, gauge=sensor.gauge + noise[0], cant=cant + noise[1])


def _balises(
    path: Path, motion: Motion, time: FloatArray, sensor: BaliseSensor, generator: np.random.Generator
) -> BaliseStream:
    """Each balise of the model that the train runs over, in time; none where the model lists none."""
    distance = np.clip(motion.at(time)[0], 0.0, path.length)
    moving = np.append(np.diff(distance) > 0.0, False)  # standing rows would make the inversion ambiguous
    model = path.model
    found: list[tuple[float, str]] = []
    for entry in model.provenance.get("balises", []):
        track, offset = model.track_index(entry["track"]), float(entry["offset_m"])
        for piece in np.flatnonzero(path.track == track):
            here = path.distance[piece] + path.direction[piece] * (offset - path.entry[piece])
            if not path.distance[piece] <= here <= path.distance[piece + 1]:
                continue
            if generator.random() < sensor.missed:
                continue
            read = here + generator.standard_normal() * sensor.sigma
            found.append((float(np.interp(read, distance[moving], time[moving])), str(entry["id"])))
    found.sort()
    stamps = np.array([t for t, _ in found])
    keep = np.append(True, np.diff(stamps) > 1e-6) if len(stamps) else np.zeros(0, bool)
    return BaliseStream(
        time=stamps[keep],
        id=tuple(name for (_, name), kept in zip(found, keep, strict=True) if kept),
        sigma=np.full(int(keep.sum()), sensor.sigma),
    )
