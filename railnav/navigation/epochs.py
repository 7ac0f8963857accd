"""Epochs: what the navigator is given at one instant, and how the streams of a run become a table of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RunError
from railnav.geodesy.grid import GridFrame
from railnav.navigation import columns as c
from railnav.run import ImuStream, OdometerStream, Run

FloatArray = NDArray[np.float64]
NAN = math.nan

#: Rotation of the Earth, rad/s.
EARTH_RATE = 7.292115e-5
#: Longest step between epochs while an IMU measures, and while nothing does, s.
IMU_STEP, IDLE_STEP = 0.1, 1.0
#: Times closer than this are one epoch, s.
SAME_TIME = 1e-3
#: Odometer readings closer than this to the one before are left out, s.
ODOMETER_STEP = 0.08
#: Sigma of a fix when the receiver states none: without and, per unit of it, with its dilution of precision, m.
UNSTATED_SIGMA, SIGMA_PER_HDOP = 4.0, 3.0
#: Sigma of a yaw-rate mean whose spread is not known, rad/s.
UNSTATED_SIGMA_YAW = 1e-3


@dataclass(frozen=True, slots=True)
class Epoch:
    """What one instant brings, SI and radians; NaN where it brings nothing.

    Attributes
    ----------
    time : float
        Seconds on the run's clock; later than the epoch before.
    latitude, longitude : float
        GNSS antenna, WGS 84, rad.
    sigma_east, sigma_north : float
        As the receiver states them, m; NaN: 4 m is assumed, or 3 m times `hdop`.
    hdop : float
        Horizontal dilution of precision.
    speed, course, sigma_speed : float
        GNSS ground speed, m/s; course over ground from true north, rad; sigma of the speed, m/s.
    distance : float
        Odometer: cumulative distance, m.
    wheel_speed, sigma_wheel_speed : float
        Odometer: speed and its sigma, m/s.
    forward_force : float
        Specific force along the vehicle's nose, mean since the epoch before, m/s^2.
    yaw_rate, sigma_yaw_rate : float
        Rate about the vehicle's down axis, mean since the epoch before, and sigma of that mean, rad/s.
    side_force : float
        Specific force to the vehicle's right, mean since the epoch before, m/s^2.
    sigma_force : float
        Sigma of the means of specific force, m/s^2.
    sigma_balise : float
        Sigma of the balise's place, m.
    balise : str
        Identifier of the balise read now; empty when none is.
    """

    time: float
    latitude: float = NAN
    longitude: float = NAN
    sigma_east: float = NAN
    sigma_north: float = NAN
    hdop: float = NAN
    speed: float = NAN
    course: float = NAN
    sigma_speed: float = NAN
    distance: float = NAN
    wheel_speed: float = NAN
    sigma_wheel_speed: float = NAN
    forward_force: float = NAN
    yaw_rate: float = NAN
    sigma_yaw_rate: float = NAN
    side_force: float = NAN
    sigma_force: float = NAN
    sigma_balise: float = NAN
    balise: str = ""


#: Columns of the raw table of epochs: the numbers of `Epoch`, then track and offset of the balise, resolved.
COLUMNS = (*(name for name in Epoch.__slots__ if name != "balise"), "balise_track", "balise_offset")
_NUMBERS = len(COLUMNS) - 2
_AT = {name: i for i, name in enumerate(COLUMNS)}
#: Columns that the kernels read as they come.
_PLAIN = tuple(
    (_AT[name], target)
    for name, target in (
        ("time", c.TIME),
        ("speed", c.GNSS_SPEED),
        ("sigma_speed", c.SIGMA_SPEED),
        ("distance", c.DISTANCE),
        ("wheel_speed", c.WHEEL_SPEED),
        ("sigma_wheel_speed", c.SIGMA_WHEEL),
        ("forward_force", c.FORCE),
        ("yaw_rate", c.YAW_RATE),
        ("sigma_yaw_rate", c.SIGMA_YAW),
        ("side_force", c.SIDE),
        ("sigma_force", c.SIGMA_FORCE),
        ("balise_track", c.BALISE_TRACK),
        ("balise_offset", c.BALISE_OFFSET),
        ("sigma_balise", c.SIGMA_BALISE),
    )
)


#: The same for single rows: by name.
_LIVE = tuple((COLUMNS[source], target) for source, target in _PLAIN if not COLUMNS[source].startswith("balise_"))


def epochs(run: Run) -> Iterator[Epoch]:
    """A run as the epochs that a live navigator would be given, one after the other.

    Every GNSS fix and odometer reading is an epoch; while an IMU measures, further ones keep the step at 0.1 s at most, and in
    a gap of everything at 1 s.

    Parameters
    ----------
    run : Run

    Yields
    ------
    Epoch
    """
    table = raw_table(run)
    read = (
        {}
        if run.balise is None
        else dict(zip(_rows(table[:, 0], run.balise.time).tolist(), run.balise.id, strict=True))
    )
    for i, row in enumerate(table.tolist()):
        yield replace(Epoch(*row[:_NUMBERS]), balise=read.get(i, "")) if i in read else Epoch(*row[:_NUMBERS])


def raw_table(run: Run, balises: Mapping[str, tuple[int, float]] | None = None) -> FloatArray:
    """A run as a table of epochs, (m, 20), columns as `COLUMNS`; `balises` says where balises lie: track index and offset, m.

    Raises
    ------
    RunError
        The run has no GNSS stream with a fix: there is nothing to start from.
    """
    gnss, odometer, imu = run.gnss, run.odometer, run.imu
    if gnss is None or len(gnss) == 0:
        raise RunError(
            f"run {run.id!r} has no GNSS fix: nothing says where on the model it starts",
            file=run.source,
            remedy="add a [gnss] stream",
        )
    wheel = _chosen_readings(odometer)
    times = [gnss.time]
    if odometer is not None and len(wheel):
        times.append(odometer.time[wheel])
    if run.balise is not None and len(run.balise.time):
        times.append(run.balise.time)
    latest = max(float(t[-1]) for t in times)
    if imu is not None and len(imu) and imu.time[-1] > latest + SAME_TIME:  # the IMU goes on alone
        times.append(imu.time[-1:])
    time = np.sort(np.concatenate(times))
    time = time[np.append(True, np.diff(time) > SAME_TIME)]
    time = _filled(time, imu)
    table = np.full((len(time), len(COLUMNS)), np.nan)
    table[:, _AT["time"]] = time
    rows = _rows(time, gnss.time)
    for name in ("latitude", "longitude", "sigma_east", "sigma_north", "hdop", "speed", "course", "sigma_speed"):
        value = getattr(gnss, name)
        if value is not None:
            table[rows, _AT[name]] = value
    if odometer is not None and len(wheel):
        rows = _rows(time, odometer.time[wheel])
        for name, value in (
            ("distance", odometer.distance),
            ("wheel_speed", odometer.speed if odometer.distance is None else None),
            ("sigma_wheel_speed", odometer.sigma_speed if odometer.distance is None else None),
        ):
            if value is not None:
                table[rows, _AT[name]] = value[wheel]
    if imu is not None and len(imu):
        force, side, rate, sigma, rough = _inertial_means(imu, time)
        table[:, _AT["side_force"]] = side
        table[:, _AT["sigma_force"]] = rough
        table[:, _AT["forward_force"]] = force
        table[:, _AT["yaw_rate"]] = rate
        table[:, _AT["sigma_yaw_rate"]] = sigma
    if run.balise is not None and balises:
        sigmas = run.balise.sigma
        for i, row in enumerate(_rows(time, run.balise.time).tolist()):
            if (place := balises.get(run.balise.id[i])) is not None:
                table[row, [_AT["balise_track"], _AT["balise_offset"]]] = place
                table[row, _AT["sigma_balise"]] = NAN if sigmas is None else sigmas[i]
    return table


def kernel_table(raw: FloatArray, frame: GridFrame, latitude: float) -> FloatArray:
    """Epochs as the kernels read them: fixes in the model's plane, courses from grid north, Earth rate taken off the gyro.

    Parameters
    ----------
    raw : (m, 20) array
        As `raw_table` gives it.
    frame : GridFrame
        The model's plane.
    latitude : float
        Of the middle of the model, rad: the vehicle is level to within cant and gradient, and the Earth's rate about its down
        axis is -Omega sin(latitude).

    Returns
    -------
    (m, 20) array
        Columns as in `railnav.navigation.columns`.
    """
    table = np.full((len(raw), c.EPOCH_SIZE), np.nan)
    for source, target in _PLAIN:
        table[:, target] = raw[:, source]
    table[:, c.YAW_RATE] += EARTH_RATE * math.sin(latitude)
    sigma = table[:, c.SIGMA_YAW]
    table[:, c.SIGMA_YAW] = np.where(np.isfinite(sigma), sigma, UNSTATED_SIGMA_YAW)
    rows = np.flatnonzero(np.isfinite(raw[:, _AT["latitude"]]))
    if len(rows) == 0:
        return table
    fixes = raw[rows]
    easting, northing, _ = frame.to_grid(fixes[:, _AT["latitude"]], fixes[:, _AT["longitude"]], None)
    table[rows, c.EAST] = easting
    table[rows, c.NORTH] = northing
    hdop = fixes[:, _AT["hdop"]]
    unstated = np.where(np.isfinite(hdop), SIGMA_PER_HDOP * hdop, UNSTATED_SIGMA)
    for name, target in (("sigma_east", c.SIGMA_EAST), ("sigma_north", c.SIGMA_NORTH)):
        sigma = fixes[:, _AT[name]]
        table[rows, target] = np.where(np.isfinite(sigma), sigma, unstated)
    course = fixes[:, _AT["course"]]
    if np.isfinite(course).any():
        bearing = course - frame.convergence(easting, northing)
        table[rows, c.COURSE_EAST] = np.sin(bearing)
        table[rows, c.COURSE_NORTH] = np.cos(bearing)
    return table


class LiveTable:
    """One epoch after the other as the kernels read them: as `kernel_table`, fast for single rows.

    The projection is expanded to second order about a place, anew every kilometre: off by 10 micrometres at most.

    Parameters
    ----------
    frame : GridFrame
        The model's plane.
    latitude : float
        Of the middle of the model, rad.
    """

    #: Reach of one expansion and spacing of the points that it is made from, rad.
    _REACH, _STEP = 1.6e-4, 1e-4

    def __init__(self, frame: GridFrame, latitude: float) -> None:
        self._frame, self._earth = frame, EARTH_RATE * math.sin(latitude)
        self._about = (math.inf, math.inf)
        self._terms: tuple[list[float], ...] = ()

    def row(self, epoch: Epoch, balise: tuple[float, float]) -> list[float]:
        """Columns of one epoch; its balise is given by track and offset."""
        row = [NAN] * c.EPOCH_SIZE
        for name, target in _LIVE:
            row[target] = getattr(epoch, name)
        row[c.BALISE_TRACK], row[c.BALISE_OFFSET] = balise
        row[c.YAW_RATE] += self._earth
        if not math.isfinite(row[c.SIGMA_YAW]):
            row[c.SIGMA_YAW] = UNSTATED_SIGMA_YAW
        if math.isfinite(epoch.latitude):
            row[c.EAST], row[c.NORTH], convergence = self._place(epoch.latitude, epoch.longitude)
            unstated = SIGMA_PER_HDOP * epoch.hdop if math.isfinite(epoch.hdop) else UNSTATED_SIGMA
            row[c.SIGMA_EAST] = epoch.sigma_east if math.isfinite(epoch.sigma_east) else unstated
            row[c.SIGMA_NORTH] = epoch.sigma_north if math.isfinite(epoch.sigma_north) else unstated
            if math.isfinite(epoch.course):
                bearing = epoch.course - convergence
                row[c.COURSE_EAST], row[c.COURSE_NORTH] = math.sin(bearing), math.cos(bearing)
        return row

    def _place(self, latitude: float, longitude: float) -> tuple[float, float, float]:
        """Easting, northing and convergence."""
        u, v = latitude - self._about[0], longitude - self._about[1]
        if not (abs(u) < self._REACH and abs(v) < self._REACH):
            self._expand(latitude, longitude)
            u, v = 0.0, 0.0
        east, north, turn = (a + u * (b + u * d + v * e) + v * (g + v * h) for a, b, g, d, e, h in self._terms)
        return east, north, turn

    def _expand(self, latitude: float, longitude: float) -> None:
        """Expand about a place: value, first and second derivatives of easting, northing and convergence."""
        h = self._STEP
        u = np.array([0.0, h, -h, 0.0, 0.0, h, -h, h, -h])
        v = np.array([0.0, 0.0, 0.0, h, -h, h, -h, -h, h])
        easting, northing, _ = self._frame.to_grid(latitude + u, longitude + v, None)
        terms = []
        for value in (easting, northing, self._frame.convergence(easting, northing)):
            f = value.tolist()
            along_u, along_v = (f[1] - f[2]) / (2.0 * h), (f[3] - f[4]) / (2.0 * h)
            bent_u, bent_v = (f[1] + f[2] - 2.0 * f[0]) / (2.0 * h * h), (f[3] + f[4] - 2.0 * f[0]) / (2.0 * h * h)
            mixed = (f[5] + f[6] - f[7] - f[8]) / (4.0 * h * h)
            terms.append([f[0], along_u, along_v, bent_u, mixed, bent_v])
        self._about, self._terms = (latitude, longitude), tuple(terms)


def _chosen_readings(odometer: OdometerStream | None) -> NDArray[np.int64]:
    """Indices of the odometer readings that are used, at least `ODOMETER_STEP` apart."""
    if odometer is None or len(odometer) == 0:
        return np.empty(0, np.int64)
    time = odometer.time
    if len(time) < 2 or np.diff(time).min() >= ODOMETER_STEP:
        return np.arange(len(time))
    slot = np.floor((time - time[0]) / IMU_STEP + 1e-6).astype(np.int64)
    return np.flatnonzero(np.append(True, np.diff(slot) > 0))


def _filled(time: FloatArray, imu: ImuStream | None) -> FloatArray:
    """Put further epochs into long steps: 0.1 s apart where an IMU measures, 1 s apart where nothing does."""
    gap = np.diff(time)
    longest = np.full(len(gap), 1.5 * IDLE_STEP)
    step = np.full(len(gap), IDLE_STEP)
    if imu is not None and len(imu):
        inside = (time[1:] > imu.time[0]) & (time[:-1] < imu.time[-1])
        longest[inside] = 1.5 * IMU_STEP
        step[inside] = IMU_STEP
    long = np.flatnonzero(gap > longest)
    if len(long) == 0:
        return time
    extra = [time[i] + step[i] * np.arange(1, math.ceil(gap[i] / step[i] - 1e-6)) for i in long.tolist()]
    return np.sort(np.concatenate([time, *extra]))


def _rows(time: FloatArray, of: FloatArray) -> NDArray[np.int64]:
    """Row of the epoch that stands for each time."""
    row = np.searchsorted(time, of + 0.5 * SAME_TIME, side="right") - 1
    return np.asarray(np.maximum(row, 0))


def body_from_imu(mounting: FloatArray) -> FloatArray:
    """Matrix Rz(yaw) Ry(pitch) Rx(roll) that turns IMU axes into body axes, (3, 3).

    Examples
    --------
    >>> import numpy as np
    >>> body_from_imu(np.array([0.0, 0.0, np.pi / 2])).round(6)[:, 0].tolist()
    [0.0, 1.0, 0.0]
    """
    (cr, cp, cy), (sr, sp, sy) = np.cos(mounting), np.sin(mounting)
    x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(z @ y @ x)


def _inertial_means(imu: ImuStream, time: FloatArray) -> tuple[FloatArray, ...]:
    """Means between epochs: forward and side force, yaw rate, sigma of the latter and of the forces; NaN where not half covered."""
    matrix = body_from_imu(imu.mounting)
    force = imu.specific_force @ matrix[0]
    side = imu.specific_force @ matrix[1]
    rate = imu.gyro @ matrix[2]
    usual = float(np.median(np.diff(imu.time))) if len(imu) > 1 else IMU_STEP
    width = np.minimum(np.diff(imu.time, prepend=imu.time[0] - usual), 1.5 * usual)
    # each sample counts over its own interval: what is whole before a time, and the part of the sample that it falls into
    begin = np.append(imu.time[0] - width[0], np.maximum(imu.time[1:] - width[1:], imu.time[:-1]))
    inside = np.minimum(np.searchsorted(imu.time, time), len(imu) - 1)
    part = np.clip((time - begin[inside]) / np.maximum(imu.time - begin, 1e-12)[inside], 0.0, 1.0)

    def between(value: FloatArray) -> FloatArray:
        at = np.cumsum(value)[inside] - (1.0 - part) * value[inside]
        return np.diff(at, prepend=NAN)

    covered = between(width)
    count = between(np.ones(len(width)))
    span = np.diff(time, prepend=NAN)
    with np.errstate(invalid="ignore", divide="ignore"):
        enough = covered >= 0.5 * span
        mean_force = np.where(enough, between(force * width) / covered, NAN)
        mean_side = np.where(enough, between(side * width) / covered, NAN)
        mean_rate = np.where(enough, between(rate * width) / covered, NAN)
        # differences of neighbours hold the noise but not the turn itself
        noise = 0.5 * np.diff(rate, prepend=rate[0]) ** 2
        sigma = np.sqrt(between(noise) / count / count)
        jitter = 0.25 * (np.diff(force, prepend=force[0]) ** 2 + np.diff(side, prepend=side[0]) ** 2)
        rough = np.sqrt(between(jitter) / count / count)
    sigma = np.where(enough & (count >= 3.0), np.maximum(sigma, 1e-6), NAN)
    return mean_force, mean_side, mean_rate, sigma, np.where(enough & (count >= 3.0), rough, NAN)
