"""Calibration of a whole inertial unit from a set of logs, one a position: which method takes which log, and what it makes of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError
from railnav.inertial.advice import axes_up
from railnav.inertial.allan import allan_deviation, fit_allan
from railnav.inertial.calibration import Form, TriadCalibration, multi_position, six_position, vector_calibration
from railnav.inertial.faces import faces, repeated_sigma
from railnav.inertial.imu_calibration import ImuCalibration, Provenance, TriadNoise, TriadTemperature
from railnav.inertial.mechanization import EARTH_RATE
from railnav.inertial.positions import (
    Position,
    PositionLog,
    PositionResult,
    position_result,
    up_words,
    which_turn,
)
from railnav.inertial.resting import TURNING
from railnav.inertial.temperature import fit_temperature
from railnav.inertial.turns import advise_turns, turned_force, turned_rate

FloatArray = NDArray[np.float64]
Method = Literal["six-position", "modified-six-position", "multi-position", "modified-multi-position", "turns"]

METHODS: tuple[Method, ...] = (
    "six-position",
    "modified-six-position",
    "multi-position",
    "modified-multi-position",
    "turns",
)
#: Methods that calibrate gyros on a table that turns at a known rate.
RATE_METHODS = ("modified-six-position", "modified-multi-position")
#: Local gravity lies between these everywhere on land, m/s^2.
GRAVITY_RANGE = (9.76, 9.84)
#: Temperatures further apart than this are two series, K.
TEMPERATURE_STEP = 3.0
#: Logs at least this long show their noise, s; the flicker floor needs longer ones.
NOISE_DURATION, FLICKER_DURATION = 30.0, 600.0
#: A condition above this is worth advice.
POOR_CONDITION = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """A calibration and what it was made of.

    Attributes
    ----------
    calibration : ImuCalibration
        Of the unit.
    positions : tuple of PositionResult
        In the order of the logs.
    remarks : tuple of str
        What the user should know: poor conditions with advice, what was assumed.
    """

    calibration: ImuCalibration
    positions: tuple[PositionResult, ...]
    remarks: tuple[str, ...]


def calibrate_imu(
    logs: Sequence[PositionLog],
    methods: Sequence[Method],
    *,
    gravity: float | None = None,
    latitude: float | None = None,
    rate: float | None = None,
    form: Form = "symmetric",
    temperature_degree: int | None = None,
    keep: ImuCalibration | None = None,
    name: str = "",
    date: str = "",
) -> CalibrationResult:
    """Calibrate an inertial unit from logs, one a position.

    Parameters
    ----------
    logs : sequence of PositionLog
        As measured; those at rest serve the accelerometers, those that turn the gyros.
    methods : sequence of str
        One or more of `METHODS`: "six-position" and "multi-position" calibrate the accelerometers from rests (and the gyros' biases), their
        "modified" forms the gyros on a rate table; "turns" whatever the logs name turns for.
    gravity : float, optional
        Local gravity, m/s^2: needed where accelerometers are calibrated.
    latitude : float, optional
        rad: takes the vertical part of the Earth's rotation off the gyros.
    rate : float, optional
        Rate of the table where a log does not name its own, rad/s.
    form : {"symmetric", "lower"}, optional
        Of the matrix of the multi-position methods.
    temperature_degree : int, optional
        Fit polynomials of this degree to bias and scale over series taken at several temperatures.
    keep : ImuCalibration, optional
        What is not calibrated now is taken from here.
    name, date : str, optional
        Of the unit, and of the logs.

    Returns
    -------
    CalibrationResult

    Raises
    ------
    EstimationError
        A log that cannot be used, too few positions (says which to add), a face that is not levelled, unknown gravity or rate, wrong units
        or axes.

    Notes
    -----
    At rest the gyros show their bias plus the Earth's rotation: the vertical part is taken off where the latitude is known, the horizontal
    part (its azimuth is unknown) stays in the sigma: 15 deg/h are nothing to a MEMS gyro and spoil a fibre-optic one, which needs turns.

    References
    ----------
    `spec/inertial.md` A10, B11.
    """
    if not methods:
        raise EstimationError(f"no method named; there are {', '.join(METHODS)}")
    for method in methods:
        if method not in METHODS:
            raise EstimationError(f"no method {method!r}; there are {', '.join(METHODS)}")
    if not logs:
        raise EstimationError("no position to calibrate from")
    if gravity is not None and not GRAVITY_RANGE[0] <= gravity <= GRAVITY_RANGE[1]:
        raise EstimationError(
            f"gravity of {gravity:g} m/s^2 is found nowhere on land ({GRAVITY_RANGE[0]} to {GRAVITY_RANGE[1]}); give it in m/s^2"
        )
    moving = which_turn(logs, rate=rate if all(method in RATE_METHODS for method in methods) else None)
    found = tuple(position_result(log, turning=turning) for log, turning in zip(logs, moving, strict=True))
    remarks: list[str] = []
    groups = _by_temperature(found) if temperature_degree is not None else [np.arange(len(found))]
    triads: dict[str, list[TriadCalibration]] = {"accelerometer": [], "gyroscope": []}
    for group in groups:
        some = [logs[k] for k in group], [found[k] for k in group]
        for what, triad in _series(*some, methods, gravity, latitude, rate, form, remarks).items():
            triads[what].append(triad)
    made: dict[str, TriadCalibration | None] = {}
    warm: dict[str, TriadTemperature | None] = {"accelerometer": None, "gyroscope": None}
    kelvin = [float(np.mean([found[k].temperature for k in group])) for group in groups]
    for what, series in triads.items():
        if temperature_degree is None or not series:
            made[what] = series[0] if series else None
        else:
            made[what], warm[what] = _over_temperature(series, kelvin, temperature_degree)
    noise = _noise(logs, found, remarks)
    source = keep if keep is not None else ImuCalibration("")
    result = ImuCalibration(
        name or source.name or "imu",
        accelerometer=made["accelerometer"] or source.accelerometer,
        gyroscope=made["gyroscope"] or source.gyroscope,
        accelerometer_temperature=warm["accelerometer"] if made["accelerometer"] else source.accelerometer_temperature,
        gyroscope_temperature=warm["gyroscope"] if made["gyroscope"] else source.gyroscope_temperature,
        accelerometer_noise=noise[1] or source.accelerometer_noise,
        gyroscope_noise=noise[0] or source.gyroscope_noise,
        provenance=Provenance(
            date,
            tuple(log.name for log in logs),
            math.nan if gravity is None else gravity,
            f"kept from {source.name}" if keep is not None and not all(made.values()) else "",
        ),
    )
    return CalibrationResult(result, found, tuple(dict.fromkeys(remarks)))


def _series(
    logs: Sequence[PositionLog],
    found: Sequence[PositionResult],
    methods: Sequence[Method],
    gravity: float | None,
    latitude: float | None,
    rate: float | None,
    form: Form,
    remarks: list[str],
) -> dict[str, TriadCalibration]:
    """Calibrations of one series of positions, by what they calibrate."""
    out: dict[str, TriadCalibration] = {}
    still = [k for k, one in enumerate(found) if not one.turning]
    moving = [k for k, one in enumerate(found) if one.turning]
    for method in methods:
        if method == "turns":
            out |= _by_turns(logs, found, gravity, remarks)
        elif method in RATE_METHODS:
            if not moving:
                raise EstimationError(
                    f"{method} needs logs on a table that turns by more than {math.degrees(TURNING):.0f} deg/s; all {len(found)} rest"
                )
            some = [found[k] for k in moving]
            references = np.array([_table_rate(logs[k], found[k], rate, latitude) for k in moving])
            out["gyroscope"] = _modified(method, some, references, form, remarks)
        else:
            if not still:
                raise EstimationError(
                    f"{method} needs positions at rest; position {found[0].name} turns at "
                    f"{math.degrees(np.linalg.norm(found[0].rate.mean)):.1f} deg/s (if it did not, its rates are in degrees: "
                    "multiply them by pi/180)"
                )
            if gravity is None:
                raise EstimationError(
                    "local gravity is unknown: give it, or the latitude (0.5 % between equator and pole)"
                )
            some = [found[k] for k in still]
            for k in still:
                _check_up(logs[k], found[k])
            out["accelerometer"] = _static(method, some, gravity, form, remarks)
            if "gyroscope" not in out and not any(m in RATE_METHODS for m in methods):
                out["gyroscope"] = _bias_at_rest(some, out["accelerometer"], latitude)
    return out


def _static(
    method: Method, found: Sequence[PositionResult], gravity: float, form: Form, remarks: list[str]
) -> TriadCalibration:
    means = np.array([one.force.mean for one in found])
    sigma = _pooled([one.force for one in found])
    if method == "six-position":
        up, down, counts, scatter = faces(found, means, "up")
        return six_position(up, down, gravity, sigma=repeated_sigma(sigma, counts, scatter, remarks, "accelerometers"))
    triad = multi_position(means, gravity, form=form, sigma=sigma)
    triad = _widened(triad, sigma, partial(_norm, means, gravity, form), remarks, "accelerometers")
    _advise_norm(triad, means, remarks)
    return triad


def _modified(
    method: Method, found: Sequence[PositionResult], reference: FloatArray, form: Form, remarks: list[str]
) -> TriadCalibration:
    means = np.array([one.rate.mean for one in found])
    sigma = _pooled([one.rate for one in found])
    if method == "modified-six-position":
        if np.ptp(reference) > 0.02 * reference.mean():
            raise EstimationError(
                f"modified-six-position needs one rate of the table, not {math.degrees(reference.min()):.1f} to "
                f"{math.degrees(reference.max()):.1f} deg/s; use modified-multi-position"
            )
        # bring every run to the mean rate, so that the Earth's part of each counts
        nominal = float(reference.mean())
        bias = np.median(means, axis=0)
        scaled = means.copy()
        for k in range(len(found)):
            turned = means[k] - bias
            axis = int(np.argmax(np.abs(turned)))
            scaled[k, axis] -= math.copysign(float(reference[k]) - nominal, turned[axis])
        up, down, counts, scatter = faces(found, scaled, "turning")
        sigma_face = repeated_sigma(sigma, counts, scatter, remarks, "gyros")
        return replace(six_position(up, down, nominal, sigma=sigma_face), method="modified six-position")
    triad = multi_position(means, reference, form=form, sigma=sigma)
    triad = _widened(triad, sigma, partial(_norm, means, reference, form), remarks, "gyros")
    _advise_norm(triad, means, remarks)
    return replace(triad, method=f"modified multi-position, {form}")


def _by_turns(
    logs: Sequence[PositionLog], found: Sequence[PositionResult], gravity: float | None, remarks: list[str]
) -> dict[str, TriadCalibration]:
    """Spatial calibration: accelerometers from the positions that rest, gyros from those that turn."""
    out: dict[str, TriadCalibration] = {}
    for what, some in (
        ("accelerometer", [k for k, one in enumerate(found) if not one.turning]),
        ("gyroscope", [k for k, one in enumerate(found) if one.turning]),
    ):
        if not some:
            continue
        untold = [logs[k].name for k in some if logs[k].turns is None]
        if untold:
            raise EstimationError(
                f"turns needs the turns of each position: {untold[0]} has none; name turns_deg in positions.toml, or --turns"
            )
        angles = np.array([logs[k].turns for k in some])
        if what == "accelerometer":
            if gravity is None:
                raise EstimationError(
                    "local gravity is unknown: give it, or the latitude (0.5 % between equator and pole)"
                )
            reference = gravity * turned_force(*angles.T)
            readings = [found[k].force for k in some]
        else:
            missing = [logs[k].name for k in some if logs[k].turn_rates is None]
            if missing:
                raise EstimationError(f"{missing[0]} turns, but its turn_rates_deg_s are not named in positions.toml")
            rates = np.array([logs[k].turn_rates for k in some])
            reference = np.array([turned_rate(a[0], a[1], a[2], r) for a, r in zip(angles, rates, strict=True)])
            readings = [found[k].rate for k in some]
        means = np.array([one.mean for one in readings])
        sigma = _pooled(readings)
        triad = vector_calibration(means, reference, sigma=sigma)
        _check_order(triad)
        triad = _widened(triad, sigma, partial(_vector, means, reference), remarks, f"{what}s")
        if triad.condition > POOR_CONDITION:
            best, reached = advise_turns(math.radians(30.0), max(len(some), 4))
            remarks.append(
                f"the turns of the {what}s have the condition {triad.condition:.1f}; multiples {' : '.join(map(str, best))} of 30 "
                f"degrees reach {reached.condition:.1f} with as many positions"
            )
        out[what] = replace(triad, method="turns")
    return out


def _bias_at_rest(
    found: Sequence[PositionResult], accelerometer: TriadCalibration, latitude: float | None
) -> TriadCalibration:
    """Gyro biases from rests: the mean, less the vertical part of the Earth's rotation."""
    rates = np.array([one.rate.mean for one in found])
    up = accelerometer.apply(np.array([one.force.mean for one in found]))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    count = len(found)
    if latitude is None:  # any direction
        unseen = EARTH_RATE**2 / 3.0 * np.ones(3)
    else:
        rates = rates - EARTH_RATE * math.sin(latitude) * up
        unseen = (EARTH_RATE * math.cos(latitude)) ** 2 / 2.0 * np.mean(1.0 - up**2, axis=0)
    bias = rates.mean(axis=0)
    noise = np.mean([one.rate.sigma**2 for one in found], axis=0)
    scatter = rates.var(axis=0, ddof=1) if count > 1 else np.zeros(3)
    covariance = np.zeros((12, 12))
    np.fill_diagonal(covariance[:3, :3], np.maximum(scatter, noise + unseen) / count)
    residual = float(np.sqrt(np.mean((rates - bias) ** 2)))
    return TriadCalibration("mean at rest", bias, np.eye(3), covariance, residual, count, 3, 1.0)


def _table_rate(log: PositionLog, one: PositionResult, rate: float | None, latitude: float | None) -> float:
    """Size of the true rate: the table's, and the vertical part of the Earth's along it."""
    size = log.rate if log.rate is not None else rate
    if size is None or size == 0.0:
        raise EstimationError(
            f"position {one.name} turns, but the rate of the table is unknown: give it, in positions.toml or as --rate"
        )
    if latitude is None:
        return abs(size)
    along = one.force.mean @ one.rate.mean / float(np.linalg.norm(one.force.mean) * np.linalg.norm(one.rate.mean))
    return abs(size) + EARTH_RATE * math.sin(latitude) * float(along)


def _check_up(log: PositionLog, one: PositionResult) -> None:
    if log.up is None:
        return
    told = log.up / np.linalg.norm(log.up)
    felt = one.force.mean / np.linalg.norm(one.force.mean)
    angle = math.acos(float(np.clip(told @ felt, -1.0, 1.0)))
    if angle > math.radians(30.0):
        raise EstimationError(
            f"position {one.name} should have {up_words(told)} up, but gravity is felt on {one.up}: the axes stand in another order, a "
            "sign is turned, or the position is named wrongly"
        )


def _check_order(triad: TriadCalibration) -> None:
    response = triad.response
    size = np.abs(response)
    best = size.argmax(axis=1)
    if np.any(best != np.arange(3)) or np.any(np.diagonal(response) < 0.5):
        words = ", ".join(
            f"{'xyz'[i]} reads {'-' if response[i, j] < 0 else '+'}{'xyz'[j]}" for i, j in enumerate(best)
        )
        raise EstimationError(
            f"the axes are in another order than the turns say ({words}): reorder the columns of the log"
        )


def _widened(
    triad: TriadCalibration, sigma: float, again: Callable[[float], TriadCalibration], remarks: list[str], what: str
) -> TriadCalibration:
    """The same with the sigma that the residuals show, where they are larger than the noise of the readings."""
    if triad.residual <= sigma:
        return triad
    if triad.residual > 1.5 * sigma:
        remarks.append(
            f"the {what} miss their reference by {triad.residual / sigma:.1f} sigma of a reading: gravity, rate, attitude or rest "
            "are less sure than the noise says; the sigmas given are those of the residuals"
        )
    return again(triad.residual)


def _norm(means: FloatArray, reference: float | FloatArray, form: Form, sigma: float) -> TriadCalibration:
    return multi_position(means, reference, form=form, sigma=sigma)


def _vector(means: FloatArray, reference: FloatArray, sigma: float) -> TriadCalibration:
    return vector_calibration(means, reference, sigma=sigma)


def _advise_norm(triad: TriadCalibration, means: FloatArray, remarks: list[str]) -> None:
    if triad.condition > 2.0 * POOR_CONDITION:
        from railnav.inertial.advice import advise_positions

        add = "; ".join(axes_up(u) for u in advise_positions(means, 3))
        remarks.append(f"the positions have the condition {triad.condition:.1f}; better with these axes up too: {add}")


def _pooled(readings: Sequence[Position]) -> float:
    """Sigma of a mean reading, over all positions and axes."""
    return math.sqrt(float(np.mean([one.sigma**2 for one in readings])))


def _by_temperature(found: Sequence[PositionResult]) -> list[NDArray[np.int64]]:
    kelvin = np.array([one.temperature for one in found])
    if np.isnan(kelvin).any():
        bad = found[int(np.argmax(np.isnan(kelvin)))].name
        raise EstimationError(f"position {bad} has no temperature: its log needs a column temperature_c")
    order = np.argsort(kelvin, kind="stable")
    breaks = [k + 1 for k, (a, b) in enumerate(pairwise(kelvin[order])) if b - a > TEMPERATURE_STEP]
    return [np.sort(group) for group in np.split(order, breaks)]


def _over_temperature(
    series: Sequence[TriadCalibration], kelvin: Sequence[float], degree: int
) -> tuple[TriadCalibration, TriadTemperature]:
    """Polynomials over calibrations at several temperatures, and the calibration at the middle one."""
    if any(one.covariance is None for one in series):
        raise EstimationError(
            "the series at one temperature are too small to know their own sigmas; take more positions"
        )
    sigma_bias = np.sqrt(np.mean([one.sigma_bias**2 for one in series if one.sigma_bias is not None], axis=0))
    sigma_scale = np.sqrt(
        np.mean([np.diagonal(one.sigma_matrix) ** 2 for one in series if one.sigma_matrix is not None], axis=0)
    )
    floor = 1e-12
    bias = fit_temperature(
        kelvin, np.array([one.bias for one in series]), degree=degree, sigma=np.maximum(sigma_bias, floor)
    )
    scale = fit_temperature(
        kelvin, np.array([one.scale for one in series]), degree=degree, sigma=np.maximum(sigma_scale, floor)
    )
    middle = series[int(np.argmin(np.abs(np.asarray(kelvin) - bias.centre)))]
    reference = float(kelvin[int(np.argmin(np.abs(np.asarray(kelvin) - bias.centre)))])
    # the matrix of the middle series, its scales moved onto the polynomial; the bias is the polynomial's
    change = (1.0 + middle.scale) / (1.0 + scale.at(reference))
    matrix = middle.matrix * change[None, :]
    return (
        replace(middle, method=f"{middle.method}, {len(series)} temperatures", bias=bias.at(reference), matrix=matrix),
        TriadTemperature(bias, scale, reference),
    )


def _noise(
    logs: Sequence[PositionLog], found: Sequence[PositionResult], remarks: list[str]
) -> tuple[TriadNoise | None, TriadNoise | None]:
    """Noise of gyros and accelerometers from the longest rest, where it is long enough."""
    rests = [k for k, one in enumerate(found) if not one.turning and one.duration >= NOISE_DURATION]
    if not rests:
        return None, None
    log = logs[max(rests, key=lambda k: found[k].duration)]
    interval = float(np.median(np.diff(log.imu.time)))
    duration = float(np.ptp(log.imu.time))
    terms = ("random_walk", "bias_instability") if duration >= FLICKER_DURATION else ("random_walk",)
    remarks.append(
        f"noise from {log.name}, {duration:.0f} s" + ("" if len(terms) > 1 else ": too short for the flicker floor")
    )
    out = []
    for x in (log.imu.gyro, log.imu.specific_force):
        curves = [allan_deviation(x[:, axis], interval) for axis in range(3)]
        fits = [fit_allan(c, terms=terms) for c in curves]
        floors = [
            p.bias_instability for p, c in zip(fits, curves, strict=True) if p.stands_out("bias_instability", c.time)
        ]
        out.append(TriadNoise(max(p.random_walk for p in fits), max(floors, default=0.0)))
    return out[0], out[1]
