"""A run's streams brought onto a section: what each sensor saw, at distances along the track, with the signs of the section.

Left and right, up and down are the track's as distance grows, whichever way the vehicle stood and ran.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from railnav.attitude import dcm_from_euler, euler_rates
from railnav.monitoring.filters import noise_floor, resample, spikes
from railnav.monitoring.section import Passage
from railnav.run import GaugeStream, GnssStream, GyroAnglesStream, ImuStream, Run
from railnav.track.model import TrackPoints
from railnav.units import RAIL_CENTRE_DISTANCE, cant_angle, wrap_angle

FloatArray = NDArray[np.float64]

#: Slower than this a rate over speed is no curvature, m/s.
SLOWEST = 2.0
#: Standing still, for the bias of a gyro: slower than this, m/s, for this long, s.
STANDSTILL, STANDSTILL_TIME = 0.02, 5.0
#: Rotation rate of the Earth, rad/s (IERS conventional value).
EARTH_RATE = 7.292115e-5
#: Gauges that railways are built to, m.
GAUGES = (1.000, 1.067, 1.435, 1.520, 1.524, 1.600, 1.668, 1.676)
#: A gauge outside nominal - 40 mm .. + 80 mm is no gauge, m.
GAUGE_RANGE = (-0.040, 0.080)
#: A gauge stream with a larger share of impossible samples than this is none.
MOST_IMPOSSIBLE = 0.5
#: Samples farther apart than this miss short defects (EN 13848-1 asks for no more, recalled), m.
COARSEST_SAMPLING = 0.5
#: A step from the neighbours' median below this is never an odd sample out, m: gauge and cant; and the factor of the robust sigma.
SPIKE = 0.003


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One measured quantity on the section's grid.

    Attributes
    ----------
    values : (n,) array
        NaN where nothing was measured.
    noise : float
        Sigma of the white noise of one raw sample, at most (robust third differences), NaN where too few.
    spacing : float
        Distance between raw samples while moving, 95th percentile, m.
    source : str
        The stream, in words.
    rejected : int
        Raw samples left out as impossible or as odd ones out.
    """

    values: FloatArray
    noise: float
    spacing: float
    source: str
    rejected: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """One run on one section.

    Attributes
    ----------
    run : Run
    passage : Passage
    step : float
        Of the grid, m.
    distance : (n,) array
        Grid along the section, m: all of it, whether this run covers it or not.
    time, speed : (n,) array
        s since the run's start; m/s, positive; NaN where the run was not.
    series : dict of str to Series
        Keys: gauge, cross_level (m); bearing, slope (rad, minus the model's where `against_model`); curvature, pitch_rate (1/m, minus the
        model's where `against_model`); plan_gnss, height_gnss (m, minus the model's).
    points : TrackPoints
        The model's geometry at the grid, along the section.
    against_model : bool
        Whether the model's geometry was taken off bearings, slopes and curvatures: right where it is a design or exact; a model built
        from surveys of centimetres or decimetres would add its own noise to short waves.
    gauge_nominal : float
        m; NaN without a gauge stream.
    notes : tuple of str
        What the reader must know: biases found, samples rejected, offsets taken off.
    refused : dict of str to str
        Series that a stream should have given and did not, and why.
    """

    run: Run
    passage: Passage
    step: float
    distance: FloatArray
    time: FloatArray
    speed: FloatArray
    series: dict[str, Series]
    points: TrackPoints
    against_model: bool
    gauge_nominal: float = math.nan
    notes: tuple[str, ...] = field(default_factory=tuple)
    refused: dict[str, str] = field(default_factory=dict)

    @property
    def covered(self) -> float:
        """Share of the section that the run passed."""
        return float(np.isfinite(self.time).mean())


def record(
    run: Run,
    passage: Passage,
    *,
    step: float = 0.25,
    against_model: bool | None = None,
    gauge: float | None = None,
) -> Recording:
    """Bring the streams of a run onto the grid of a section.

    Parameters
    ----------
    run : Run
    passage : Passage
        Where the run was when, from `railnav.monitoring.section.passages_of`.
    step : float
        Of the grid, m; EN 13848-1 wants 0.5 m or less.
    against_model : bool, optional
        Take the model's geometry off bearings, slopes and curvatures. By default, where the model states no covariance: it is then a
        design, not a survey.
    gauge : float, optional
        Nominal gauge, m; by default the usual one nearest to the median.

    Returns
    -------
    Recording

    Notes
    -----
    Gyro angles and IMU ride on a body with springs: above some hertz they do not show the rails. A gauge stream does.
    """
    grid = passage.section.grid(step)
    order = np.argsort(passage.distance)
    inside = (grid >= passage.extent[0]) & (grid <= passage.extent[1])
    time = np.where(inside, np.interp(grid, passage.distance[order], passage.time[order]), np.nan)
    speed = np.where(inside, np.abs(np.interp(grid, passage.distance[order], passage.speed[order])), np.nan)
    if against_model is None:
        against_model = not passage.section.surveyed
    series: dict[str, Series] = {}
    notes: list[str] = []
    refused: dict[str, str] = {}
    nominal = math.nan
    if run.gauge is not None and len(run.gauge.time):
        nominal = _gauge(run.gauge, passage, grid, gauge, series, notes, refused)
    if run.gyro_angles is not None and len(run.gyro_angles.time):
        _angles(run.gyro_angles, passage, grid, against_model, series)
    if run.imu is not None and len(run.imu):
        _imu(run.imu, passage, grid, against_model, series, notes)
    if run.gnss is not None and len(run.gnss):
        _gnss(run.gnss, passage, grid, series, notes)
    points = passage.section.at(grid)
    return Recording(
        run, passage, step, grid, time, speed, series, points, against_model, nominal, tuple(notes), refused
    )


def inertial_curvature(rate: FloatArray, speed: FloatArray, *, slowest: float = SLOWEST) -> FloatArray:
    """Curvature from a rate of turn and the speed: d(bearing)/dt over d(distance)/dt.

    Parameters
    ----------
    rate : (m,) array
        Rate of the bearing, rad/s, positive to the right, the Earth's rate and the gyro's bias taken off.
    speed : (m,) array
        d(distance)/dt, m/s; negative against growing distance, and the curvature then changes sign.
    slowest : float
        Where the train is slower, there is no answer (NaN), m/s.

    Returns
    -------
    (m,) array
        1/m, positive to the right as distance grows.

    References
    ----------
    docs/theory/geometry.md (7).

    Examples
    --------
    >>> inertial_curvature(np.array([0.02, 0.02]), np.array([20.0, 0.5])).round(4)
    array([0.001,   nan])
    """
    moving = np.abs(speed) >= slowest
    return np.where(moving, rate / np.where(moving, speed, 1.0), np.nan)


def _placed(
    distance: FloatArray,
    values: FloatArray,
    grid: FloatArray,
    source: str,
    rejected: int = 0,
    noise: float | None = None,
) -> Series:
    """Resample one quantity and say how fine it was."""
    known = np.isfinite(distance) & np.isfinite(values)
    d, x = distance[known], values[known]
    spacing = _spacing(d)
    gap = max(4.0 * spacing, 2.0) if math.isfinite(spacing) else 2.0
    if noise is None:
        moving = np.abs(np.diff(d, append=d[-1] if len(d) else 0.0)) > 1e-3
        noise = noise_floor(x[moving])
    return Series(resample(d, x, grid, gap=gap), noise, spacing, source, rejected)


def _gauge(
    stream: GaugeStream,
    passage: Passage,
    grid: FloatArray,
    wanted: float | None,
    series: dict[str, Series],
    notes: list[str],
    refused: dict[str, str],
) -> float:
    d = passage.where(stream.time)
    if not np.isfinite(d).any():
        return math.nan
    median = float(np.nanmedian(stream.gauge[np.isfinite(d)]))
    nominal = wanted if wanted is not None else min(GAUGES, key=lambda g: abs(g - median))
    impossible = (stream.gauge < nominal + GAUGE_RANGE[0]) | (stream.gauge > nominal + GAUGE_RANGE[1])
    values = np.where(impossible, np.nan, stream.gauge)
    # where samples lie further apart than a defect is long, a lone deviation may be one: nothing is called odd there
    fine = _spacing(d) <= COARSEST_SAMPLING
    odd = spikes(values, least=SPIKE) if fine else np.zeros(len(values), bool)
    here = np.isfinite(d)
    out = int((impossible & here).sum()), int((odd & here).sum())
    if out[0] > MOST_IMPOSSIBLE * here.sum():
        refused["gauge"] = (
            f"{100.0 * out[0] / here.sum():.0f} % of the gauge samples lie outside {1e3 * (nominal + GAUGE_RANGE[0]):.0f} to "
            f"{1e3 * (nominal + GAUGE_RANGE[1]):.0f} mm (median {1e3 * median:,.1f} mm): another unit, another gauge, or a broken sensor"
        )
        nominal = math.nan
    else:
        series["gauge"] = _placed(d, np.where(odd, np.nan, values), grid, "gauge stream", sum(out))
    if not fine:
        notes.append(
            f"gauge and cant were sampled each {_spacing(d):.1f} m: shorter defects are missed, and lone spikes not told from them"
        )
    if "gauge" in refused:
        notes.append(f"gauge: {refused['gauge']}; not used")
    elif sum(out):
        notes.append(
            f"gauge: {out[0]:,} samples outside {1e3 * (nominal + GAUGE_RANGE[0]):.0f} to {1e3 * (nominal + GAUGE_RANGE[1]):.0f} mm and "
            f"{out[1]:,} lone spikes of {int(here.sum()):,} were left out"
        )
    if stream.cant is not None and np.isfinite(stream.cant).any():
        cant = passage.nose * stream.cant
        odd = spikes(cant, least=SPIKE) if fine else np.zeros(len(cant), bool)
        series["cross_level"] = _placed(d, np.where(odd, np.nan, cant), grid, "gauge stream", int((odd & here).sum()))
        if (odd & here).any():
            notes.append(f"cross level: {int((odd & here).sum()):,} lone spikes were left out")
    return nominal


def _spacing(distance: FloatArray) -> float:
    """Distance between samples of a moving train, m: 95 % lie no farther apart; NaN without any."""
    steps = np.abs(np.diff(distance[np.isfinite(distance)]))
    steps = steps[steps > 1e-3]
    return float(np.quantile(steps, 0.95)) if len(steps) else math.nan


def _angles(
    stream: GyroAnglesStream, passage: Passage, grid: FloatArray, against_model: bool, series: dict[str, Series]
) -> None:
    d = passage.where(stream.time)
    here = np.isfinite(d)
    if here.sum() < 8:
        return
    d = d[here]
    model = passage.section.at(d)
    heading = stream.heading[here] + (0.0 if passage.nose > 0 else math.pi)
    off = wrap_angle(heading - model.heading)
    slope = passage.nose * stream.pitch[here]
    if against_model:
        bearing, slope = np.unwrap(off), slope - np.arctan(model.gradient)
    else:
        bearing = np.unwrap(off) + np.unwrap(model.heading)
    series["bearing"] = _placed(d, bearing, grid, "gyro angles")
    series["slope"] = _placed(d, slope, grid, "gyro angles")
    if "cross_level" not in series:
        cant = passage.nose * RAIL_CENTRE_DISTANCE * np.sin(stream.roll[here])
        series["cross_level"] = _placed(d, cant, grid, "gyro angles (roll of the body, springs included)")


def _imu(
    stream: ImuStream,
    passage: Passage,
    grid: FloatArray,
    against_model: bool,
    series: dict[str, Series],
    notes: list[str],
) -> None:
    section = passage.section
    # a row is the mean over the interval that ends at its time: it belongs to the middle
    time = stream.time - 0.5 * float(np.median(np.diff(stream.time))) if len(stream.time) > 1 else stream.time
    d = passage.where(time)
    inside = np.isfinite(d)
    # standstill beyond the passage counts too: the passage's rows leave it out
    gyro = stream.gyro @ dcm_from_euler(*stream.mounting).T
    bias, words = _gyro_bias(stream, passage, gyro)
    rows = np.flatnonzero(inside)
    if len(rows) < 8:
        return
    d = d[rows]
    speed = passage.speed_at(time[rows])
    model = section.at(d)
    rate_b = gyro[rows] - bias
    if not words:  # no standstill: the Earth's rate about the vertical goes off by formula, its share elsewhere is below 5e-5 rad/s
        latitude, _, _ = section.model.frame.to_geodetic(model.easting[:1], model.northing[:1], np.zeros(1))
        rate_b = rate_b + np.array([0.0, 0.0, EARTH_RATE * math.sin(float(latitude[0]))])
    roll = passage.nose * cant_angle(np.clip(model.cant, -0.3, 0.3))
    pitch = passage.nose * np.arctan(model.gradient)
    rates = euler_rates(roll, pitch, rate_b)
    curvature = inertial_curvature(rates[:, 2], speed)
    bend = passage.nose * inertial_curvature(rates[:, 1], speed)
    expected = model.curvature
    known = np.isfinite(curvature)
    if not words and known.sum() > 100:
        # what is left of the bias, in the median over the whole passage against the model
        left = float(np.median((curvature - expected)[known] * speed[known]))
        curvature = curvature - left / speed
        words = f"gyro z bias {math.degrees(bias[2] + left) * 3600:.0f} deg/h from the model's curvature (no standstill in the run)"
    notes.append(f"IMU: {words}" if words else "IMU: gyro bias unknown (no standstill)")
    noise_z, noise_y = noise_floor(curvature), noise_floor(bend)
    series["curvature_full"] = whole = _placed(d, curvature, grid, "IMU", noise=noise_z)
    bending = _placed(d, bend, grid, "IMU", noise=noise_y)
    if against_model:
        # differences of the model's angles on the grid, so that a kink between two tracks is in them as it is in the rates
        point, step = section.at(grid), float(grid[1] - grid[0])
        whole = replace(whole, values=whole.values - np.gradient(np.unwrap(point.heading), step))
        slope = np.arctan(point.gradient)
        rise = np.gradient(np.where(np.isfinite(slope), slope, 0.0), step)
        bending = replace(bending, values=bending.values - rise)
    series["curvature"], series["pitch_rate"] = whole, bending


def _gyro_bias(stream: ImuStream, passage: Passage, gyro: FloatArray) -> tuple[FloatArray, str]:
    """Mean rate at standstill (the Earth's rate included), and what to say; zero and no words without one."""
    when = (stream.time >= passage.time[0] - 120.0) & (stream.time <= passage.time[-1] + 120.0)
    interval = float(np.median(np.diff(stream.time))) if len(stream.time) > 1 else 1.0
    width = max(3, round(1.0 / interval))
    rows = np.flatnonzero(when)
    if len(rows) < 5 * width:
        return np.zeros(3), ""
    force = stream.specific_force[rows]
    kernel = np.ones(width) / width
    mean = np.convolve(np.linalg.norm(force, axis=1), kernel, mode="same")
    spread = np.sqrt(np.maximum(np.convolve(np.linalg.norm(force, axis=1) ** 2, kernel, mode="same") - mean**2, 0.0))
    turning = np.abs(np.convolve(gyro[rows, 2], kernel, mode="same"))
    # a standing train is where neither place nor the sensors move: no progress in the passage's rows for a while
    moved = np.interp(stream.time[rows], passage.time, passage.distance)
    speed = np.abs(np.gradient(moved, stream.time[rows]))
    quiet = (speed < STANDSTILL) & (spread < 5.0 * np.quantile(spread, 0.02) + 1e-6) & (turning < 0.01)
    if quiet.sum() * interval < STANDSTILL_TIME:
        return np.zeros(3), ""
    mean_rate = gyro[rows][quiet].mean(axis=0)
    return (
        mean_rate,
        f"gyro bias from {quiet.sum() * interval:.0f} s of standstill, z {math.degrees(mean_rate[2]) * 3600:.0f} deg/h",
    )


def _gnss(stream: GnssStream, passage: Passage, grid: FloatArray, series: dict[str, Series], notes: list[str]) -> None:
    section = passage.section
    d = passage.where(stream.time)
    here = np.flatnonzero(np.isfinite(d))
    if len(here) < 8:
        return
    d = d[here]
    frame = section.model.frame
    height = None if stream.height is None else stream.height[here]
    east, north, up = frame.to_grid(stream.latitude[here], stream.longitude[here], height)
    point = section.at(d)
    arm = stream.lever_arm_b
    roll = cant_angle(np.clip(point.cant, -0.3, 0.3))
    right = passage.nose * arm[1] * np.cos(roll) - arm[2] * np.sin(roll)
    sin, cos = np.sin(point.grid_bearing), np.cos(point.grid_bearing)
    forward = passage.nose * arm[0]
    # a lever arm ahead on a curve: the antenna stands off the tangent's foot by what the axis itself does there
    ahead = section.at(np.clip(d + forward, 0.0, section.length))
    cross = (east - ahead.easting) * cos - (north - ahead.northing) * sin - right
    sigma = stream.sigma_east[here] if stream.sigma_east is not None else np.full(len(here), np.nan)
    doubtful = (
        np.isfinite(sigma) & (sigma > 5.0 * np.nanmedian(sigma))
        if np.isfinite(sigma).any()
        else np.zeros(len(here), bool)
    )
    gross = doubtful | (np.abs(cross - np.median(cross)) > 6.0 * _spread(cross) + 0.05)
    offset = float(np.median(cross[~gross]))
    series["plan_gnss"] = _placed(
        d, np.where(gross, np.nan, cross), grid, "GNSS", int(gross.sum()), noise=_stated(sigma, cross)
    )
    words = f"GNSS: median distance from the model {1e3 * offset:+.0f} mm across"
    if height is not None and np.isfinite(up).any() and np.isfinite(point.height).any():
        above = up + arm[2] * np.cos(roll) - ahead.height
        wrong = gross | ~np.isfinite(above) | (np.abs(above - np.nanmedian(above)) > 6.0 * _spread(above) + 0.05)
        vertical = stream.sigma_up[here] if stream.sigma_up is not None else np.full(len(here), np.nan)
        if (~wrong).sum() > 8:
            level = float(np.median(above[~wrong]))
            series["height_gnss"] = _placed(
                d,
                np.where(wrong, np.nan, above - level),
                grid,
                "GNSS",
                int(wrong.sum()),
                noise=_stated(vertical, above),
            )
            words += f", {1e3 * level:+.0f} mm in height (taken off: heights may have another zero)"
    notes.append(f"{words}; {int(gross.sum()):,} of {len(here):,} fixes left out")


def _spread(values: FloatArray) -> float:
    x = values[np.isfinite(values)]
    return float(1.4826 * np.median(np.abs(x - np.median(x)))) if len(x) else math.nan


def _stated(sigma: FloatArray, values: FloatArray) -> float:
    """The greater of what the receiver states and what its samples show from one to the next."""
    stated = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else 0.0
    floor = noise_floor(values)
    return max(stated, floor if math.isfinite(floor) else 0.0, 0.0)
