"""A run by its IMU, without a map: loose, tight, with odometer, decentralised; the answer is a `Solution` without tracks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.attitude import euler_from_dcm
from railnav.geodesy import choose_frame
from railnav.geodesy.plane import GridFrame
from railnav.inertial.aided import AidedSolution, Ranges, Unknowns, Vehicle, integrate
from railnav.inertial.error_model import position_scale
from railnav.inertial.mechanization import Trajectory
from railnav.navigation.epochs import raw_table
from railnav.navigation.schemes.contradictions import check_agreement, check_axes, check_streams
from railnav.navigation.schemes.decentralised import fused_position, position_of, wheel_filter
from railnav.navigation.schemes.streams import (
    InertialSettings,
    Start,
    antenna_arm,
    body_samples,
    find_start,
    fixes_of,
    motion_of,
    rests_of,
)
from railnav.navigation.solution import Mode, Solution
from railnav.run import Progress, Run

FloatArray = NDArray[np.float64]

#: Schemes of this module, as the command line names them.
INERTIAL_SCHEMES = ("loose", "tight", "odometer", "decentralised")
_DEGREE = math.pi / 180


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
    check_streams(run, scheme, ranges)
    assert run.gnss is not None
    assert run.imu is not None
    begin = find_start(run, assumed)
    time, rate, force = body_samples(run, begin)
    check_axes(run, time, rate, force)
    fixes = fixes_of(run.gnss, assumed)
    rests = rests_of(run, time, rate, force)
    motion = motion_of(run.odometer, time, assumed)
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
            vehicle=Vehicle(antenna_arm_b=antenna_arm(run)),
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
    check_agreement(run, found)
    position, covariance = position_of(found)
    moving = found.trajectory
    extra: dict[str, Any] = {}
    if scheme == "decentralised":
        wheels = wheel_filter(found, time, rate, force, rests, motion, run.gnss.time, assumed)
        position, covariance, moving, weight = fused_position(found, *wheels)
        extra = {"mean_weight_of_gnss_filter": float(weight.mean())}
        if progress is not None:
            progress("integrate", 2, steps)
    told = ranges.time if scheme == "tight" and ranges is not None else run.gnss.time
    rows = _solution(run, found, moving, position, covariance, told, begin, frame, integrity_risk, smooth, assumed)
    rows.diagnostics.update({"scheme": scheme, **_diagnostics(found, begin, len(rests.time)), **extra})
    if progress is not None:
        progress("integrate", steps, steps)
    return rows


def _solution(
    run: Run,
    found: AidedSolution,
    moving: Trajectory,
    position: FloatArray,
    covariance: FloatArray,
    told: FloatArray,
    begin: Start,
    frame: GridFrame | None,
    integrity_risk: float,
    smooth: bool,
    assumed: InertialSettings,
) -> Solution:
    from scipy.stats import norm

    tr, imu = moving, run.imu
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
        simulated=run.simulated,
        diagnostics={
            "epochs": m,
            "modes": {kind.label: int((mode == kind).sum()) for kind in Mode},
        },
    )


def _diagnostics(found: AidedSolution, begin: Start, rests: int) -> dict[str, Any]:
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
