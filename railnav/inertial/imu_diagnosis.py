"""Diagnosis of a whole inertial unit against its calibration: healthy, or which sensor failed and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError
from railnav.inertial.advice import advise_positions, axes_up
from railnav.inertial.calibration import TriadCalibration
from railnav.inertial.diagnosis import CAUSES, Diagnosis, ScalarControl, diagnose, scalar_control
from railnav.inertial.imu_calibration import ImuCalibration, apply_calibration
from railnav.inertial.inspection import inspect_log
from railnav.inertial.mechanization import EARTH_RATE
from railnav.inertial.positions import PositionLog, position_mean, which_turn
from railnav.inertial.resting import REST_FORCE, REST_RATE

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ImuDiagnosis:
    """What a set of positions says of an inertial unit and its calibration.

    Attributes
    ----------
    defects : tuple of str
        Sensors that are dead, frozen or saturated, log by log: found before anything is computed.
    names : tuple of str
        Positions that could be used.
    control : ScalarControl or None
        Of each of these positions: the length of the corrected specific force.
    limit : float
        Of the control.
    accelerometer : Diagnosis or None
        Of nine causes, where the positions tell them apart.
    gyro_change, gyro_sigma, gyro_limit : (3,) array
        Change of the gyros' biases since the calibration, rad/s; NaN where nothing can be said.
    advice : str
        Positions to add where the causes cannot be told apart; otherwise empty.
    """

    defects: tuple[str, ...]
    names: tuple[str, ...]
    control: ScalarControl | None
    limit: float
    accelerometer: Diagnosis | None
    gyro_change: FloatArray
    gyro_sigma: FloatArray
    gyro_limit: FloatArray
    advice: str

    @property
    def failures(self) -> tuple[str, ...]:
        """What failed and why, worst kind first; empty if healthy."""
        out = list(self.defects)
        if self.accelerometer is not None:
            for cause in self.accelerometer.failed:
                p = CAUSES.index(cause)
                out.append(
                    f"accelerometer {cause} moved by {self.accelerometer.parameters[p]:+.2e} of gravity "
                    f"(limit {self.accelerometer.limits[p]:.1e}, sigma {self.accelerometer.sigma[p]:.1e})"
                )
        elif self.control is not None and not self.control.healthy.all():
            k = int(np.argmax(np.abs(self.control.residual)))
            out.append(
                f"accelerometers: in position {self.names[k]} the length of the specific force is off by {self.control.residual[k]:+.2e} "
                f"(limit {self.limit:.1e}); which sensor it is needs more positions"
            )
        change, limit, sigma = (np.degrees(x) * 3600 for x in (self.gyro_change, self.gyro_limit, self.gyro_sigma))
        gyros = [
            f"gyro bias {'xyz'[k]} moved by {change[k]:+.3g} deg/h (limit {limit[k]:.2g}, sigma {sigma[k]:.2g})"
            for k in np.flatnonzero(np.abs(change) > limit)
        ]
        return (*out, *gyros)

    @property
    def healthy(self) -> bool:
        """Whether nothing failed."""
        return not self.failures


def diagnose_imu(
    logs: Sequence[PositionLog],
    calibration: ImuCalibration,
    *,
    gravity: float,
    latitude: float | None = None,
    false_alarm: float = 1e-3,
    tolerance: float = 0.0,
    gyro_tolerance: float = 0.0,
) -> ImuDiagnosis:
    """Compare positions at rest with the valid calibration of a unit.

    Dead, frozen and saturated axes are named first. Then the calibration is applied, the length of the specific force is controlled in each
    position (UA(17)), and where nine or more positions tell the causes apart, the change of each of the nine parameters is judged against
    its own sigma, that of the calibration included; the gyros' biases likewise.

    Parameters
    ----------
    logs : sequence of PositionLog
        As measured; logs on a turning table are left out.
    calibration : ImuCalibration
        What the unit is held against.
    gravity : float
        Local, m/s^2.
    latitude : float, optional
        rad: takes the vertical part of the Earth's rotation off the gyros.
    false_alarm : float, optional
        Share of healthy units called failed (of each triad).
    tolerance, gyro_tolerance : float, optional
        Change that is allowed beyond what noise makes, a share of gravity and rad/s: what the unit does from one switch-on to the next.

    Returns
    -------
    ImuDiagnosis

    Raises
    ------
    EstimationError
        No position at rest, motion during one, or a calibration without accelerometers and gyros.

    Notes
    -----
    The attitude need not be known: directions are taken from the corrected readings and improved with the parameters found. A turn of
    the whole triad cannot be seen, of the two cross-axis terms of a pair only the sum.

    References
    ----------
    `spec/inertial.md` A11, figure 13.
    """
    if calibration.accelerometer is None and calibration.gyroscope is None:
        raise EstimationError("the calibration holds neither triad: there is nothing to compare with")
    if not (
        math.isfinite(gravity)
        and gravity > 0.0
        and 0.0 < false_alarm < 1.0
        and tolerance >= 0.0
        and gyro_tolerance >= 0.0
    ):
        raise ValueError("gravity must be positive, false_alarm between 0 and 1, tolerances not negative")
    known = None if calibration.gyroscope is None else calibration.gyroscope.bias
    still = [log for log, turning in zip(logs, which_turn(logs, bias=known), strict=True) if not turning]
    if not still:
        raise EstimationError("no position at rest: diagnosis needs the unit standing still, in nine or more attitudes")
    defects, names, force, rate = [], [], [], []
    for log in still:
        found = [
            one
            for one in inspect_log(log.imu.time, log.imu.gyro, log.imu.specific_force)
            if one.kind in ("frozen", "saturated", "not finite", "unit", "clock")
        ]
        if found:
            defects += [f"position {log.name}: {one.sentence}" for one in found]
            continue
        corrected = apply_calibration(log.imu, calibration)
        try:
            force.append(position_mean(corrected.specific_force, largest_sigma=REST_FORCE))
            rate.append(position_mean(corrected.gyro, largest_sigma=REST_RATE))
        except EstimationError as error:
            raise EstimationError(f"position {log.name}: {error}") from error
        names.append(log.name)
    nothing = np.full(3, math.nan)
    if not names:
        return ImuDiagnosis(tuple(defects), (), None, math.nan, None, nothing, nothing, nothing, "")
    means = np.array([one.mean for one in force])
    control, limit, nine, advice = None, math.nan, None, ""
    if calibration.accelerometer is not None:
        own = parameter_sigma(calibration.accelerometer, gravity)
        sigma = math.sqrt(float(np.mean([one.sigma**2 for one in force])))
        size = NormalDist().inv_cdf(1.0 - 0.5 * (1.0 - (1.0 - false_alarm) ** (1.0 / len(means))))
        # along the direction of gravity a reading is as unsure as its noise and the calibration together
        limit = (
            size * math.hypot(sigma / gravity, float(np.linalg.norm(own[:3])) / math.sqrt(3.0), float(own[3:6].max()))
            + tolerance
        )
        control = scalar_control(means, gravity, limit=limit)
        try:
            nine = _nine(means, gravity, sigma, own, false_alarm, tolerance)
        except EstimationError:
            add = advise_positions(means, max(9 - len(means), 3))
            advice = (
                f"{len(means)} positions do not tell nine causes apart; add positions with these axes up: "
                + "; ".join(axes_up(u) for u in add)
            )
    change = spread = bound = nothing
    if calibration.gyroscope is not None and calibration.gyroscope.sigma_bias is not None:
        change, spread = _gyro_change(np.array([one.mean for one in rate]), means, latitude)
        noise = np.sqrt(np.mean([one.sigma**2 for one in rate], axis=0) / len(rate))
        in_run = 0.0 if calibration.gyroscope_noise is None else calibration.gyroscope_noise.bias_instability
        spread = np.sqrt(np.maximum(spread, noise) ** 2 + calibration.gyroscope.sigma_bias**2 + in_run**2)
        bound = NormalDist().inv_cdf(1.0 - 0.5 * (1.0 - (1.0 - false_alarm) ** (1.0 / 3.0))) * spread + gyro_tolerance
    return ImuDiagnosis(tuple(defects), tuple(names), control, limit, nine, change, spread, bound, advice)


def parameter_sigma(triad: TriadCalibration, gravity: float) -> FloatArray:
    """Standard deviations of a calibration in the order of `CAUSES`: biases over gravity, scales, sums of cross-axis terms, (9,)."""
    if triad.covariance is None:
        return np.zeros(9)
    pick = np.zeros((9, 12))
    pick[:3, :3] = np.eye(3) / gravity
    for p, (i, j) in enumerate(((0, 0), (1, 1), (2, 2))):
        pick[3 + p, 3 + 3 * i + j] = 1.0
    for p, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        pick[6 + p, 3 + 3 * i + j] = pick[6 + p, 3 + 3 * j + i] = 1.0
    return np.asarray(np.sqrt(np.einsum("pi,ij,pj->p", pick, triad.covariance, pick)))


def _nine(
    means: FloatArray, gravity: float, sigma: float, own: FloatArray, false_alarm: float, tolerance: float
) -> Diagnosis:
    """The nine parameters with directions found from the readings themselves, and limits that know the calibration's sigma."""
    directions = means / np.linalg.norm(means, axis=1, keepdims=True)
    found = diagnose(means, directions, gravity, sigma=max(sigma, 1e-12), false_alarm=false_alarm)
    for _ in range(8):
        p = found.parameters
        half = 0.5 * p[6:]
        response = np.array(
            [[1.0 + p[3], half[0], half[1]], [half[0], 1.0 + p[4], half[2]], [half[1], half[2], 1.0 + p[5]]]
        )
        true = np.linalg.solve(response, (means / gravity - p[:3]).T).T
        found = diagnose(
            means,
            true / np.linalg.norm(true, axis=1, keepdims=True),
            gravity,
            sigma=max(sigma, 1e-12),
            false_alarm=false_alarm,
        )
    left = len(means) - 9
    if left > 0:  # what the readings still miss gravity by may exceed their noise: slow parts from position to position
        lengths = np.linalg.norm(_undone(found.parameters, means / gravity), axis=1)
        residual = gravity * math.sqrt(float(np.sum((lengths - 1.0) ** 2)) / left)
        spread = np.hypot(found.sigma * max(1.0, residual / max(sigma, 1e-12)), own)
    else:
        spread = np.hypot(found.sigma, own)
    limits = found.limits / found.sigma * spread + tolerance
    score = np.abs(found.parameters) / spread
    failed = tuple(CAUSES[p] for p in np.argsort(-score) if abs(found.parameters[p]) > limits[p])
    return Diagnosis(found.parameters, spread, limits, failed, found.condition)


def _undone(p: FloatArray, readings: FloatArray) -> FloatArray:
    """Readings, in units of gravity, without the nine parameters."""
    half = 0.5 * p[6:]
    response = np.array(
        [[1.0 + p[3], half[0], half[1]], [half[0], 1.0 + p[4], half[2]], [half[1], half[2], 1.0 + p[5]]]
    )
    return np.asarray(np.linalg.solve(response, (readings - p[:3]).T).T)


def _gyro_change(rates: FloatArray, forces: FloatArray, latitude: float | None) -> tuple[FloatArray, FloatArray]:
    up = forces / np.linalg.norm(forces, axis=1, keepdims=True)
    count = len(rates)
    if latitude is None:
        unseen = np.full(3, EARTH_RATE**2 / 3.0)
    else:
        rates = rates - EARTH_RATE * math.sin(latitude) * up
        unseen = (EARTH_RATE * math.cos(latitude)) ** 2 / 2.0 * np.mean(1.0 - up**2, axis=0)
    scatter = rates.var(axis=0, ddof=1) if count > 1 else np.zeros(3)
    return rates.mean(axis=0), np.sqrt(np.maximum(scatter, unseen) / count)
