"""Track that is not where its design says: irregularities of known size, and what a recording car sees of them.

Each track has four fields along its offset, zero at its ends: alignment (to the right), longitudinal level (up), cross level (left rail
high) and gauge (wide). They are random with the spectrum of track, plus isolated defects at known places.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError
from railnav.geodesy.ellipsoid import WGS84
from railnav.run import GaugeStream, GnssStream, GyroAnglesStream, ImuStream, Run
from railnav.simulation.driving import Driving, Motion, drive
from railnav.simulation.journey import Leg, Path, path_of
from railnav.simulation.sensors import SURVEY, AnglesSensor, GaugeSensor, Outfit
from railnav.simulation.train import simulate
from railnav.track.model import Route, TrackModel
from railnav.truth import Truth
from railnav.units import RAIL_CENTRE_DISTANCE, STANDARD_GRAVITY

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: The fields, in the order of their columns.
KINDS = ("alignment", "longitudinal_level", "cross_level", "gauge")
#: Distance between the values of a field, m.
STEP = 0.25
#: Fields fade in and out over this length at the ends of a track, m.
FADE = 25.0
#: Wavelength beyond which the spectrum of each field levels off, m.
LONGEST = (305.0, 305.0, 60.0, 60.0)
_DEGREE = math.pi / 180.0

#: Recording car: survey GNSS, attitude at 200 Hz to 0.002 degrees, gauge and cant at 200 Hz to 0.3 mm, odometer.
GEOMETRY = Outfit(
    "geometry",
    gnss=SURVEY.gnss,
    odometer=SURVEY.odometer,
    angles=AnglesSensor(interval=0.005, white=0.002 * _DEGREE, bias=0.005 * _DEGREE),
    gauge=GaugeSensor(interval=0.005, sigma=0.0003),
)


@dataclass(frozen=True, slots=True)
class Defect:
    """An isolated defect: half a wave of cosine about its middle.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    track : str
    offset : float
        Of the middle, m.
    size : float
        At the middle, m, with its sign.
    length : float
        From edge to edge, m.
    """

    kind: str
    track: str
    offset: float
    size: float
    length: float = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Irregularities:
    """Fields of all tracks of a model.

    Attributes
    ----------
    model : TrackModel
    start : (t + 1,) int array
        Row at which each track's fields begin.
    fields : (n, 4) array
        Values each `STEP` from each track's start, columns as `KINDS`, m.
    """

    model: TrackModel
    start: IntArray
    fields: FloatArray

    def at(self, track: ArrayLike, offset: ArrayLike, derivative: int = 0) -> FloatArray:
        """Values (m), slopes (derivative 1) or second derivatives (2) along the offset: (m, 4), cubic between rows."""
        from scipy.interpolate import CubicSpline

        which, where = np.broadcast_arrays(np.asarray(track, np.int64), np.asarray(offset, float))
        out = np.zeros((*which.shape, len(KINDS)))
        for i in np.unique(which):
            a, b = self.start[i], self.start[i + 1]
            here = which == i
            spline = CubicSpline(STEP * np.arange(b - a), self.fields[a:b], bc_type="clamped")
            out[here] = spline(np.clip(where[here], 0.0, STEP * (b - a - 1)), derivative)
        return out


def irregular(
    model: TrackModel,
    *,
    seed: int,
    level: float = 1.2e-3,
    alignment: float = 0.9e-3,
    cross_level: float = 0.9e-3,
    gauge: float = 1.0e-3,
    times: float = 1.0,
    tracks: Sequence[str] | None = None,
    defects: Sequence[Defect] = (),
) -> Irregularities:
    """Make fields of irregularities over all tracks of a model.

    The spectrum falls as 1 / ((f^2 + fr^2)(f^2 + fc^2)) with 2 pi fc = 0.8246 rad/m and 1 / fr of `LONGEST`: the
    shape of the ERRI B176 spectra (recalled, not read; there 1 / fr is 305 m for all); its size is set here.

    Parameters
    ----------
    model : TrackModel
    seed : int
        Same seed, same fields; each track draws from its own stream.
    level, alignment, cross_level, gauge : float
        Standard deviation in waves of 3 to 25 m, m.
    times : float
        All four, times this.
    tracks : sequence of str, optional
        Only these tracks are irregular; by default all. What a track gets does not hang on the others.
    defects : sequence of Defect

    Returns
    -------
    Irregularities
        Simulated.

    Raises
    ------
    TrackError
        A defect of an unknown kind, or off its track; a negative size.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> fields = irregular(demo_line(spacing=50.0), seed=1)
    >>> float(abs(fields.fields[0]).max())
    0.0
    """
    count = np.floor(model.lengths / STEP + 1e-9).astype(np.int64) + 1
    start = np.append(0, np.cumsum(count))
    fields = np.zeros((start[-1], len(KINDS)))
    wanted = tuple(times * size for size in (alignment, level, cross_level, gauge))
    if min(wanted) < 0.0:
        raise TrackError(f"irregularities of {1e3 * min(wanted):g} mm: a size is not negative")
    rough = set(range(len(count))) if tracks is None else {model.track_index(name) for name in tracks}
    for i, generator in enumerate(map(np.random.default_rng, np.random.SeedSequence(seed).spawn(len(count)))):
        if i not in rough:
            continue
        block = fields[start[i] : start[i + 1]]
        for k, sigma in enumerate(wanted):
            if sigma > 0.0:
                block[:, k] = sigma * _coloured(generator, len(block), LONGEST[k])
        s = STEP * np.arange(len(block))
        end = np.minimum(s, s[-1] - s) / min(FADE, max(s[-1] / 2.0, STEP))
        block *= np.square(np.sin(0.5 * np.pi * np.clip(end, 0.0, 1.0)))[:, None]
    for defect in defects:
        if defect.kind not in KINDS:
            raise TrackError(f"a defect of {defect.kind!r} is not known; one of {', '.join(KINDS)}")
        i = model.track_index(defect.track)
        if not 0.5 * defect.length <= defect.offset <= float(model.lengths[i]) - 0.5 * defect.length:
            raise TrackError(f"the defect at {defect.offset} m does not lie on track {defect.track!r}")
        s = STEP * np.arange(count[i]) - defect.offset
        bump = np.where(np.abs(s) < 0.5 * defect.length, np.square(np.cos(np.pi * s / defect.length)), 0.0)
        fields[start[i] : start[i + 1], KINDS.index(defect.kind)] += defect.size * bump
    return Irregularities(model, start, fields)


def _coloured(generator: np.random.Generator, count: int, longest: float) -> FloatArray:
    """A row with the spectrum of track, of standard deviation 1 in waves of 3 to 25 m."""
    from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

    size = next_fast_len(max(count, 64) + round(400.0 / STEP), real=True)
    omega = 2.0 * np.pi * rfftfreq(size, STEP)
    shape = 1.0 / np.sqrt((omega**2 + (2.0 * np.pi / longest) ** 2) * (omega**2 + 0.8246**2))
    shape *= 1.0 / np.sqrt(1.0 + (omega * 1.5 / (2.0 * np.pi)) ** 8)  # nothing shorter than 1.5 m
    shape[0] = 0.0
    in_band = (omega >= 2.0 * np.pi / 25.0) & (omega <= 2.0 * np.pi / 3.0)
    density = 2.0 * np.sum(shape[in_band] ** 2) / size  # variance in the band when white noise of unit sigma is shaped
    row = irfft(rfft(generator.standard_normal(size)) * shape, size)[:count]
    return np.asarray(row / math.sqrt(density))


def simulate_geometry(
    model: TrackModel,
    journey: Route | Leg | Sequence[str] | Sequence[Leg],
    irregularities: Irregularities,
    *,
    seed: int,
    outfit: Outfit = GEOMETRY,
    driving: Driving | None = None,
    **options: object,
) -> tuple[Run, Truth]:
    """Drive a recording car over irregular track.

    Parameters
    ----------
    model, journey, seed, outfit, driving, **options
        As in `railnav.simulation.train.simulate`.
    irregularities : Irregularities
        Of the same model.

    Returns
    -------
    run : Run
        Its streams show design plus irregularities.
    truth : Truth
        On the design's axis.
    """
    run, truth = simulate(model, journey, seed=seed, outfit=outfit, driving=driving, **options)  # type: ignore[arg-type]
    path = path_of(model, journey)
    return roughen(run, path, drive(path, driving), irregularities), truth


def roughen(run: Run, path: Path, motion: Motion, irregularities: Irregularities) -> Run:
    """Add what a vehicle on two points of the track sees of its irregularities to a run simulated on the design.

    Angles and rates follow slopes and second derivatives of the fields, positions their values; small angles, no springs, no
    wheelbase.
    """
    made: dict[str, GnssStream | ImuStream | GyroAnglesStream | GaugeStream] = {}

    def where(time: FloatArray) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        distance, speed, _ = motion.at(time)
        distance = np.clip(distance, 0.0, path.length)
        track, offset = path.locate(distance)
        return track, offset, path.nose(distance).astype(float), speed * path.direction[path.piece(distance)]

    if run.gauge is not None:
        track, offset, nose, _ = where(run.gauge.time)
        value = irregularities.at(track, offset)
        cant = None if run.gauge.cant is None else run.gauge.cant + nose * value[:, 2]
        made["gauge"] = replace(run.gauge, gauge=run.gauge.gauge + value[:, 3], cant=cant)
    if run.gyro_angles is not None:
        angles = run.gyro_angles
        track, offset, nose, _ = where(angles.time)
        value, slope = irregularities.at(track, offset), irregularities.at(track, offset, 1)
        made["gyro_angles"] = replace(
            angles,
            heading=np.mod(angles.heading + slope[:, 0], 2.0 * np.pi),
            pitch=angles.pitch + nose * slope[:, 1],
            roll=angles.roll + nose * value[:, 2] / RAIL_CENTRE_DISTANCE,
        )
    if run.imu is not None and len(run.imu):
        imu = run.imu
        interval = np.diff(imu.time, prepend=2.0 * imu.time[0] - imu.time[1])
        track, offset, nose, way = where(imu.time - 0.5 * interval)
        value, slope, bend = (irregularities.at(track, offset, k) for k in range(3))
        gyro, force = imu.gyro.copy(), imu.specific_force.copy()
        gyro[:, 0] += nose * slope[:, 2] / RAIL_CENTRE_DISTANCE * way
        gyro[:, 1] += nose * bend[:, 1] * way
        gyro[:, 2] += bend[:, 0] * way
        force[:, 0] += STANDARD_GRAVITY * nose * slope[:, 1]
        force[:, 1] += nose * (bend[:, 0] * way**2 - STANDARD_GRAVITY * value[:, 2] / RAIL_CENTRE_DISTANCE)
        force[:, 2] -= bend[:, 1] * way**2
        made["imu"] = replace(imu, gyro=gyro, specific_force=force)
    if run.gnss is not None and len(run.gnss):
        gnss = run.gnss
        track, offset, _, _ = where(gnss.time)
        value = irregularities.at(track, offset)
        begin = path.model.offset[path.model.knot_start[:-1]]
        heading = path.model.at(track, offset + begin[track]).heading
        right = value[:, 0] - gnss.lever_arm_b[2] * value[:, 2] / RAIL_CENTRE_DISTANCE
        height = np.zeros(len(gnss)) if gnss.height is None else gnss.height
        made["gnss"] = replace(
            gnss,
            latitude=gnss.latitude - right * np.sin(heading) / (WGS84.meridian_radius(gnss.latitude) + height),
            longitude=gnss.longitude
            + right * np.cos(heading) / ((WGS84.transverse_radius(gnss.latitude) + height) * np.cos(gnss.latitude)),
            height=None if gnss.height is None else gnss.height + value[:, 1],
        )
    return replace(run, **made)  # type: ignore[arg-type]
