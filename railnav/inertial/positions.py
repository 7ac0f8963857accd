"""Logs taken position by position: one long log cut into them, each inspected, and its mean readings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.inertial.inspection import inspect_log
from railnav.inertial.resting import REST_FORCE, REST_RATE, TURNING, find_stretches
from railnav.run import ImuStream

FloatArray = NDArray[np.float64]

#: A face that is further off than this is not levelled, rad.
LARGEST_TILT = math.radians(10.0)


@dataclass(frozen=True, slots=True, eq=False)
class Position:
    """Mean reading at rest in one position.

    Attributes
    ----------
    mean : (3,) array
        Unit of the readings.
    sigma : (3,) array
        Of the mean, from the scatter of ten pieces, so that slow noise counts.
    samples : int
        How many there were.
    """

    mean: FloatArray
    sigma: FloatArray
    samples: int


def position_mean(samples: ArrayLike, *, largest_sigma: float) -> Position:
    """Mean of a log at rest, refused if the triad moved or an axis is dead.

    Parameters
    ----------
    samples : (n, 3) array
        At least 20.
    largest_sigma : float
        Scatter of the means of ten equal pieces that still counts as rest, unit.

    Returns
    -------
    Position

    Raises
    ------
    ValueError
        Wrong shape, too few samples.
    EstimationError
        A gap, a frozen axis, or motion: with the axis and its scatter.

    Examples
    --------
    >>> position_mean(np.random.default_rng(1).normal([0, 0, 9.8], 0.01, (1000, 3)), largest_sigma=0.01).mean.round(2)
    array([0. , 0. , 9.8])
    """
    x = np.asarray(samples, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or len(x) < 20:
        raise ValueError(f"a position needs samples of the shape (n, 3), n at least 20, not {x.shape}")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if bad.size:
        raise EstimationError(f"sample {bad[0]} is not finite; cut the log there")
    for axis in np.flatnonzero(np.ptp(x, axis=0) == 0.0)[:1]:
        raise EstimationError(f"axis {'xyz'[axis]} reads {x[0, axis]:g} all the time: it is frozen or missing")
    pieces = np.array([piece.mean(axis=0) for piece in np.array_split(x, 10)])
    scatter = pieces.std(axis=0, ddof=1)
    for axis in np.flatnonzero(scatter > largest_sigma)[:1]:
        raise EstimationError(
            f"the triad moved: means of tenths of the log scatter by {scatter[axis]:.3g} on axis {'xyz'[axis]}, "
            f"more than {largest_sigma:.3g}; record this position again at rest"
        )
    return Position(x.mean(axis=0), scatter / math.sqrt(10.0), len(x))


@dataclass(frozen=True, slots=True, eq=False)
class PositionLog:
    """What was recorded in one position.

    Attributes
    ----------
    name : str
        Of the log.
    imu : ImuStream
        As measured.
    up : (3,) array or None
        Direction of the specific force in block axes, where known.
    rate : float or None
        Rate of the table, rad/s, where known; its size counts.
    turns : (3,) array or None
        Turns alpha, beta, gamma of the block in this position, rad.
    turn_rates : (3,) array or None
        Their rates while the log was taken, rad/s.
    """

    name: str
    imu: ImuStream
    up: FloatArray | None = None
    rate: float | None = None
    turns: FloatArray | None = None
    turn_rates: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PositionResult:
    """What one log gave.

    Attributes
    ----------
    name : str
        Of the log.
    up : str
        Block axis that points up, or the direction in words.
    force, rate : Position
        Means, as measured.
    turning : bool
        Whether the block turned.
    temperature : float
        Mean, K; NaN if unknown.
    duration : float
        s.
    """

    name: str
    up: str
    force: Position
    rate: Position
    turning: bool
    temperature: float
    duration: float


def cut_positions(
    name: str, imu: ImuStream, *, shortest: float = 5.0, by_rate: bool = False
) -> tuple[PositionLog, ...]:
    """Cut one long log into the positions in which the block stood, or turned evenly.

    Parameters
    ----------
    name : str
        Of the log: the positions are called name@seconds.
    imu : ImuStream
        As measured.
    shortest : float, optional
        A stretch that is shorter does not count, s.
    by_rate : bool, optional
        Look for even turning rather than rest.

    Returns
    -------
    tuple of PositionLog

    Raises
    ------
    EstimationError
        The log never rests for long enough: with the evidence.

    Examples
    --------
    >>> force = np.repeat([[0.0, 0.0, -9.8], [0.0, 9.8, 0.0]], 1000, axis=0)
    >>> [p.name for p in cut_positions("cube", ImuStream(np.arange(2000) * 0.01, np.zeros((2000, 3)), force))]
    ['cube@0', 'cube@10']
    """
    found, motion = find_stretches(imu.time, imu.gyro, imu.specific_force, shortest=shortest, by_rate=by_rate)
    if not found:
        raise EstimationError(
            f"{name}: no stretch of {shortest:g} s in which the block rests or turns evenly; it turns by up to "
            f"{math.degrees(motion.rate):.2f} deg/s and {motion.force:.2f} m/s^2 from piece to piece (at {motion.rate_time:.0f} and "
            f"{motion.force_time:.0f} s): record each position for longer, without touching it"
        )
    out = []
    for stretch in found:
        rows = slice(stretch.first, stretch.last)
        part = replace(
            imu,
            time=imu.time[rows],
            gyro=imu.gyro[rows],
            specific_force=imu.specific_force[rows],
            temperature=None if imu.temperature is None else imu.temperature[rows],
        )
        out.append(PositionLog(f"{name}@{stretch.begin:.0f}", part))
    return tuple(out)


def position_result(log: PositionLog, *, turning: bool = False) -> PositionResult:
    """Means of one position, after an inspection of its log.

    Parameters
    ----------
    log : PositionLog
        As measured.
    turning : bool, optional
        Whether the block turned, see `which_turn`.

    Returns
    -------
    PositionResult

    Raises
    ------
    EstimationError
        The log cannot be used: with its name, what is wrong and what would work.
    """
    imu = log.imu
    if imu.calibration:
        raise EstimationError(
            f"position {log.name} is calibrated already (by {imu.calibration}): take the key calibration out of its run.toml"
        )
    if len(imu) < 50:
        raise EstimationError(
            f"position {log.name} has {len(imu)} samples; record it for longer, some seconds at least"
        )
    for finding in inspect_log(imu.time, imu.gyro, imu.specific_force):
        if finding.kind in ("axes", "gap") or (finding.kind == "unit" and finding.channel == "rate" and turning):
            continue  # any axis may be up here, and a table may turn fast
        raise EstimationError(f"position {log.name}: {finding.sentence}")
    try:
        rate = position_mean(
            imu.gyro, largest_sigma=max(REST_RATE, 0.005 * float(np.linalg.norm(imu.gyro.mean(axis=0))))
        )
        force = position_mean(imu.specific_force, largest_sigma=math.inf if turning else REST_FORCE)
    except EstimationError as error:
        raise EstimationError(f"position {log.name}: {error}") from error
    direction = force.mean / np.linalg.norm(force.mean)
    kelvin = math.nan if imu.temperature is None else float(np.mean(imu.temperature))
    return PositionResult(log.name, up_words(direction), force, rate, turning, kelvin, float(np.ptp(imu.time)))


def which_turn(logs: Sequence[PositionLog], *, rate: float | None = None, bias: FloatArray | None = None) -> list[bool]:
    """Which logs were taken while the block turned.

    Parameters
    ----------
    logs : sequence of PositionLog
        As measured.
    rate : float, optional
        Of a table on which all logs were taken, rad/s.
    bias : (3,) array, optional
        Of the gyros, where known, rad/s.

    Returns
    -------
    list of bool
        True where the log names a rate, or where its median rate differs from the median over all logs, which is the gyros' bias if the
        positions are spread evenly, by more than `TURNING` (or half of `rate`). With fewer than five logs and no `bias` the rate itself
        is taken.
    """
    medians = np.array([np.median(log.imu.gyro, axis=0) for log in logs])
    if bias is None:
        bias = np.median(medians, axis=0) if len(logs) >= 5 else np.zeros(3)
    least = TURNING if rate is None else 0.5 * abs(rate)
    out = []
    for log, median in zip(logs, medians, strict=True):
        told = log.rate if log.turn_rates is None else float(np.linalg.norm(log.turn_rates))
        out.append(bool(told) if told is not None else float(np.linalg.norm(median - bias)) > least)
    return out


def up_words(direction: FloatArray) -> str:
    """Axis that points up, or the two or three that do together with their shares."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) > math.cos(LARGEST_TILT):
        return f"{'+' if direction[axis] > 0 else '-'}{'xyz'[axis]}"
    return " ".join(f"{c:+.2f}{n}" for c, n in zip(direction, "xyz", strict=True) if abs(c) > 0.1)
