"""What a run's streams cannot have said together: missing streams, units, axes, and sensors that contradict each other."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError, RunError
from railnav.inertial.aided import AidedSolution, Ranges
from railnav.navigation.schemes.streams import gnss_velocity
from railnav.run import Run

FloatArray = NDArray[np.float64]
_DEGREE = math.pi / 180


def check_streams(run: Run, scheme: str, ranges: Ranges | None) -> None:
    """Refuse a run without the streams that a scheme needs."""
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


def check_axes(run: Run, time: FloatArray, rate: FloatArray, force: FloatArray) -> None:
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
    velocity = gnss_velocity(gnss)
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


def check_agreement(run: Run, found: AidedSolution) -> None:
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
