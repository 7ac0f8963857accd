"""What is known of one inertial unit: calibration of both triads, their temperature and noise, where it comes from; and its application.

true = matrix @ ((measured - bias(T)) / (1 + k(T))), bias(T) and k(T) polynomials of the temperature where there are any; all in the unit's
own axes, before any mounting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.inertial.calibration import TriadCalibration
from railnav.inertial.temperature import TemperaturePolynomial
from railnav.run import ImuStream

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TriadTemperature:
    """How bias and scale of a triad change with temperature.

    Attributes
    ----------
    bias : TemperaturePolynomial
        Of the three biases, unit of the readings: takes the place of `TriadCalibration.bias`.
    scale : TemperaturePolynomial
        Of the three scale errors.
    reference : float
        Temperature at which the matrix of the calibration holds, K.
    """

    bias: TemperaturePolynomial
    scale: TemperaturePolynomial
    reference: float

    def scale_change(self, temperature: ArrayLike) -> FloatArray:
        """k(T) of each sensor against the reference temperature, (...) K -> (..., 3)."""
        return np.asarray((1.0 + self.scale.at(temperature)) / (1.0 + self.scale.at(self.reference)) - 1.0)


@dataclass(frozen=True, slots=True)
class TriadNoise:
    """Noise of a triad, the worst of its axes.

    Attributes
    ----------
    random_walk : float
        Density of the white noise, unit sqrt(s).
    bias_instability : float
        Flicker floor B, unit; 0 where none was found.
    rate_random_walk : float
        unit/sqrt(s); 0 where none was found.
    """

    random_walk: float
    bias_instability: float = 0.0
    rate_random_walk: float = 0.0


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a calibration comes from.

    Attributes
    ----------
    date : str
        Day of the newest log, ISO 8601; empty if unknown.
    logs : tuple of str
        Names of the logs.
    gravity : float
        Local gravity that was used, m/s^2; NaN where none was.
    note : str
        Anything else.
    """

    date: str = ""
    logs: tuple[str, ...] = ()
    gravity: float = math.nan
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ImuCalibration:
    """Calibration of one inertial unit; a triad that was not calibrated is None and stands as it is.

    Attributes
    ----------
    name : str
        Of the unit.
    accelerometer, gyroscope : TriadCalibration or None
        m/s^2 and rad/s.
    accelerometer_temperature, gyroscope_temperature : TriadTemperature or None
        Where calibrated at several temperatures.
    accelerometer_noise, gyroscope_noise : TriadNoise or None
        Where measured.
    provenance : Provenance
        Where it comes from.

    Examples
    --------
    >>> from railnav.inertial import six_position
    >>> unit = ImuCalibration("A", accelerometer=six_position([9.9, 9.8, 9.8], [-9.7, -9.8, -9.8], 9.8))
    >>> unit.accelerometer_bias_sigma() is None
    True
    """

    name: str
    accelerometer: TriadCalibration | None = None
    gyroscope: TriadCalibration | None = None
    accelerometer_temperature: TriadTemperature | None = None
    gyroscope_temperature: TriadTemperature | None = None
    accelerometer_noise: TriadNoise | None = None
    gyroscope_noise: TriadNoise | None = None
    provenance: Provenance = Provenance()

    def gyro_bias_sigma(self) -> float | None:
        """What bias the gyros may still have (1 sigma), rad/s: of the calibration and in-run; None if unknown."""
        return _remaining(self.gyroscope, self.gyroscope_noise)

    def accelerometer_bias_sigma(self) -> float | None:
        """What bias the accelerometers may still have (1 sigma), m/s^2: of the calibration and in-run; None if unknown."""
        return _remaining(self.accelerometer, self.accelerometer_noise)


def apply_calibration(imu: ImuStream, calibration: ImuCalibration) -> ImuStream:
    """Correct the samples of an inertial unit.

    Parameters
    ----------
    imu : ImuStream
        As measured, in the unit's own axes.
    calibration : ImuCalibration
        Of this unit.

    Returns
    -------
    ImuStream
        New; `ImuStream.calibration` names what was applied. Arrays are read-only.

    Raises
    ------
    EstimationError
        The stream was calibrated already; the calibration holds for temperatures and the stream has none, or one far outside.

    Notes
    -----
    The correction of a steady offset of temperature is exact; a delay between sensor and thermometer is not modelled.

    Examples
    --------
    >>> from railnav.inertial import six_position
    >>> unit = ImuCalibration("A", gyroscope=six_position([1.01] * 3, [-0.99] * 3, 1.0))
    >>> raw = ImuStream(np.arange(2.0), np.full((2, 3), 0.02), np.zeros((2, 3)))
    >>> apply_calibration(raw, unit).gyro[0].round(9)
    array([0.01, 0.01, 0.01])
    """
    if imu.calibration:
        raise EstimationError(
            f"the IMU stream is calibrated already (by {imu.calibration}); name one calibration, in run.toml or on the command line"
        )
    gyro = _corrected(imu.gyro, imu, calibration.gyroscope, calibration.gyroscope_temperature)
    force = _corrected(imu.specific_force, imu, calibration.accelerometer, calibration.accelerometer_temperature)
    return replace(imu, gyro=gyro, specific_force=force, calibration=calibration.name or "a calibration")


def _corrected(
    measured: FloatArray, imu: ImuStream, triad: TriadCalibration | None, temperature: TriadTemperature | None
) -> FloatArray:
    if triad is None:
        return measured
    if temperature is None:
        out = triad.apply(measured)
    else:
        if imu.temperature is None or not np.isfinite(imu.temperature).all():
            raise EstimationError(
                "the calibration depends on temperature, and the run has no temperature_c for every sample; add the column, or use a "
                "calibration without temperature"
            )
        output = (measured - temperature.bias.at(imu.temperature)) / (1.0 + temperature.scale_change(imu.temperature))
        out = np.asarray(output @ triad.matrix.T)
    out.flags.writeable = False
    return out


def _remaining(triad: TriadCalibration | None, noise: TriadNoise | None) -> float | None:
    if triad is None or triad.sigma_bias is None:
        return None
    return math.hypot(float(triad.sigma_bias.max()), noise.bias_instability if noise is not None else 0.0)
