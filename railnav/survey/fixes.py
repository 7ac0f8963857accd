"""The fixes of one run in the grid, and why some of them are not used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RunError
from railnav.units import cant_angle

if TYPE_CHECKING:
    from railnav.geodesy.grid import GridFrame
    from railnav.run import Run
    from railnav.survey.attribution import Attributions

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Reasons of rejection, in the order they are tried; a fix's `reason` is an index into this.
REASONS = (
    "used",
    "stated sigma far above the run's own",
    "faster than any train",
    "far from the line",
    "gross error across the track",
    "on another track here",
    "beyond the end of the track",
    "before or after turning back",
    "contradicts the other runs here",
    "contradicts the run's own odometer and gyroscopes",
)
USED, STATED_SIGMA, JUMP, FAR, GROSS, OTHER_TRACK, BEYOND, TURNED, CONTRADICTS, LINKS = range(len(REASONS))

#: A fix whose stated sigma is more than this times the run's median is left out: the receiver itself doubts it.
SIGMA_RATIO = 5.0
#: Speed that no train on conventional track reaches, m/s.
TOP_SPEED = 110.0
#: Fewest fixes a run must keep to take part.
FEWEST_FIXES = 10


@dataclass(slots=True, eq=False)
class Fixes:
    """The fixes of one run: grid position of the antenna, time, and what became of each.

    Attributes
    ----------
    run : Run
    receiver : str
        Kind of receiver; "unknown" where the run does not say.
    time, easting, northing : (m,) array
        Seconds since the run's start; grid metres.
    height : (m,) array
        Height of the reference point, m; NaN where none.
    sigma : (m,) array
        Stated horizontal standard deviation (per axis), m; NaN where none.
    reason : (m,) int array
        Index into `REASONS`.
    size : (m,) array
        How large the matter is: the stated sigma, the jump, or the distance, m.
    forward : float
        Reference point to antenna along the vehicle, m; 0 where the attitude is known and the antenna already brought down.
    right : (m,) array
        The same to the vehicle's right, leaning with the cant where it was measured, m.
    angles : (time, grid bearing, pitch) arrays or None
        Where the run has gyroscopic angles: s, rad from grid north, unwrapped, and rad.
    odometer : (time, distance) arrays or None
        Where it has an odometer: s and m.
    attributed : Attributions or None
        What fixes and increments of the run said of each other (`railnav.survey.attribution`).
    sigma_axes : three (m,) arrays or None
        Stated standard deviations east, north and up, m, NaN where none: what a fix weighs across a track depends on its bearing.
    """

    run: Run
    receiver: str
    time: FloatArray
    easting: FloatArray
    northing: FloatArray
    height: FloatArray
    sigma: FloatArray
    reason: IntArray
    size: FloatArray
    forward: float
    right: FloatArray
    angles: tuple[FloatArray, FloatArray, FloatArray] | None = None
    odometer: tuple[FloatArray, FloatArray] | None = None
    attributed: Attributions | None = None
    sigma_axes: tuple[FloatArray, FloatArray, FloatArray] | None = None

    def __len__(self) -> int:
        return len(self.time)


def gather(run: Run, frame: GridFrame) -> Fixes:
    """Bring a run's fixes into the grid, the antenna to the reference point, and set aside what cannot be right by itself.

    The lever arm is turned by the measured attitude where there is one; otherwise it leans with the measured cant, or stands
    upright, and lies along the track.

    Set aside are fixes whose stated sigma is over five times the run's median (the first minutes after switching on), and fixes
    that would need 110 m/s from both neighbours.

    Raises
    ------
    RunError
        No GNSS stream, or fewer than ten usable fixes.
    """
    gnss = run.gnss
    if gnss is None or len(gnss) == 0:
        raise RunError("no GNSS fixes", file=run.source or run.id, remedy="leave this run out of the build")
    height = gnss.height
    east, north, up = frame.to_grid(gnss.latitude, gnss.longitude, height)
    n = len(gnss)
    up = np.full(n, np.nan) if height is None else up
    if gnss.sigma_up is not None and np.isfinite(gnss.sigma_up).any():
        up = np.where(gnss.sigma_up > SIGMA_RATIO * np.nanmedian(gnss.sigma_up), np.nan, up)
    east, north, up, forward, right = _lowered(run, frame, gnss.time, east, north, up, gnss.lever_arm_b)
    sigma = np.full(n, np.nan)
    if gnss.sigma_east is not None and gnss.sigma_north is not None:
        sigma = np.sqrt(0.5 * (gnss.sigma_east**2 + gnss.sigma_north**2))
    elif gnss.sigma_east is not None or gnss.sigma_north is not None:
        sigma = np.array(gnss.sigma_east if gnss.sigma_east is not None else gnss.sigma_north)
    axes = None
    if gnss.sigma_east is not None and gnss.sigma_north is not None:
        upward = np.full(n, np.nan) if gnss.sigma_up is None else np.asarray(gnss.sigma_up, float)
        axes = (np.asarray(gnss.sigma_east, float), np.asarray(gnss.sigma_north, float), upward)
    reason, size = np.zeros(n, np.int64), np.zeros(n)

    stated = np.isfinite(sigma)
    if stated.any():
        doubtful = stated & (sigma > SIGMA_RATIO * np.median(sigma[stated]))
        reason[doubtful], size[doubtful] = STATED_SIGMA, sigma[doubtful]
    good = np.flatnonzero(reason == USED)
    if len(good) >= 3:
        step = np.hypot(np.diff(east[good]), np.diff(north[good]))
        slack = 20.0 if not stated.any() else 3.0 * float(np.median(sigma[stated]))
        fast = np.maximum(step - slack, 0.0) > TOP_SPEED * np.diff(gnss.time[good])
        wild = np.append(False, fast) & np.append(fast, False)
        jump = np.minimum(np.append(0.0, step), np.append(step, 0.0))
        reason[good[wild]], size[good[wild]] = JUMP, jump[wild]
    kept = int(np.count_nonzero(reason == USED))
    if kept < FEWEST_FIXES:
        raise RunError(
            f"{kept} usable fixes of {n}; a survey run needs at least {FEWEST_FIXES}",
            file=run.source or run.id,
            remedy="leave this run out of the build",
        )
    return Fixes(
        run=run,
        receiver=gnss.receiver or "unknown",
        time=np.asarray(gnss.time),
        easting=east,
        northing=north,
        height=up,
        sigma=sigma,
        reason=reason,
        size=size,
        forward=forward,
        right=right,
        angles=_angles(run, frame, np.asarray(gnss.time), east, north),
        odometer=_odometer(run),
        sigma_axes=axes,
    )


def _angles(
    run: Run, frame: GridFrame, time: FloatArray, east: FloatArray, north: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Gyroscopic angles as grid bearing and pitch: the convergence of the place is taken off."""
    angles = run.gyro_angles
    if angles is None or len(angles.time) < 2:
        return None
    turn = np.interp(angles.time, time, frame.convergence(east, north))
    return np.asarray(angles.time), np.unwrap(angles.heading) - turn, np.asarray(angles.pitch)


def _odometer(run: Run) -> tuple[FloatArray, FloatArray] | None:
    """Distance run by time; a speed is summed up."""
    odometer = run.odometer
    if odometer is None or len(odometer.time) < 2:
        return None
    if odometer.distance is not None:
        return np.asarray(odometer.time), np.asarray(odometer.distance)
    if odometer.speed is None:
        return None
    mean = 0.5 * (odometer.speed[1:] + odometer.speed[:-1])
    return np.asarray(odometer.time), np.append(0.0, np.cumsum(mean * np.diff(odometer.time)))


def _from_axis(run: Run, time: FloatArray) -> FloatArray:
    """How far to the vehicle's right of the axis the point lies that lever arms count from: half the gauge, where that is a rail."""
    gauge = run.gauge
    if gauge is None or not gauge.reference_rail or len(gauge.time) == 0:
        return np.zeros(len(time))
    half = 0.5 * np.interp(time, gauge.time, gauge.gauge)
    return half if gauge.reference_rail == "right" else -half


def _lowered(
    run: Run,
    frame: GridFrame,
    time: FloatArray,
    east: FloatArray,
    north: FloatArray,
    up: FloatArray,
    lever_b: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, float, FloatArray]:
    """Bring antenna positions down to the reference point: position, and what of the lever arm is still to be taken off in plan."""
    n = len(time)
    angles, gauge = run.gyro_angles, run.gauge
    right: FloatArray = np.full(n, float(lever_b[1])) + _from_axis(run, time)
    if not lever_b.any() and not right.any():
        return east, north, up, 0.0, np.zeros(n)
    forward, down = float(lever_b[0]), float(lever_b[2])
    if angles is not None and len(angles.time) >= 2:
        roll = np.interp(time, angles.time, angles.roll)
        pitch = np.interp(time, angles.time, angles.pitch)
        bearing = np.interp(time, angles.time, np.unwrap(angles.heading)) - frame.convergence(east, north)
        level_right = right * np.cos(roll) - down * np.sin(roll)
        level_down = right * np.sin(roll) + down * np.cos(roll)
        ahead = forward * np.cos(pitch) + level_down * np.sin(pitch)
        below = level_down * np.cos(pitch) - forward * np.sin(pitch)
        sin, cos = np.sin(bearing), np.cos(bearing)
        return (
            east - ahead * sin - level_right * cos,
            north - ahead * cos + level_right * sin,
            up + below,
            0.0,
            np.zeros(n),
        )
    roll = np.zeros(n)
    if gauge is not None and gauge.cant is not None and len(gauge.time) >= 2:
        roll = cant_angle(np.interp(time, gauge.time, gauge.cant))  # left rail high: the right side is down
    lean = right * np.cos(roll) - down * np.sin(roll)
    return east, north, up + right * np.sin(roll) + down * np.cos(roll), forward, lean
