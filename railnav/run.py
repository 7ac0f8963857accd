"""A run: what one train recorded on one drive, as flat arrays on one clock.

Streams are frozen values in SI and radians; an absent optional column is `None`, an absent single value is NaN. Times are
seconds since `Run.start`, strictly increasing within a stream.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Called on long work with the stage, how much is done and how much there is.
Progress = Callable[[str, int, int], None]


def _zeros3() -> FloatArray:
    zeros = np.zeros(3)
    zeros.flags.writeable = False
    return zeros


@dataclass(frozen=True, slots=True)
class GnssErrors:
    """What a receiver's data sheet, or its owner, declares of its errors, one sigma each; NaN: not declared.

    Attributes
    ----------
    white, correlated, frame_offset : float
        Of a horizontal axis, m: from fix to fix; first-order Gauss-Markov; constant over a run.
    correlation_time : float
        Of the correlated part, s.
    stamp : float
        Constant offset of the time stamps, s.
    speed_latency : float
        Age of the speed, s.
    speed_correlated : float
        Correlated part of the speed's error, as a share of its stated sigma.
    """

    white: float = math.nan
    correlated: float = math.nan
    correlation_time: float = math.nan
    frame_offset: float = math.nan
    stamp: float = math.nan
    speed_latency: float = math.nan
    speed_correlated: float = math.nan


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """What is declared of an IMU and the vehicle under it, one sigma each; NaN: not declared.

    Attributes
    ----------
    gyro_bias, accelerometer_bias : float
        At switch-on, rad/s and m/s^2.
    gyro_walk, accelerometer_walk : float
        Random walk of the biases, rad/s/sqrt(s) and m/s^2/sqrt(s).
    gyro_scale : float
        Scale error of the gyros.
    mounting : float
        What is unknown of each mounting angle, rad.
    sway : float
        Yaw rate that the moving vehicle adds to the track's, rad/s.
    vibration : float
        Density of the noise of the forward accelerometer on a moving vehicle, m/s^2/sqrt(Hz).
    """

    gyro_bias: float = math.nan
    gyro_walk: float = math.nan
    gyro_scale: float = math.nan
    accelerometer_bias: float = math.nan
    accelerometer_walk: float = math.nan
    mounting: float = math.nan
    sway: float = math.nan
    vibration: float = math.nan


@dataclass(frozen=True, slots=True)
class OdometerErrors:
    """What is declared of a wheel, one sigma each; NaN: not declared: scale, and random creep with the way, m/sqrt(m)."""

    scale: float = math.nan
    creep: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class GnssStream:
    """GNSS fixes.

    Attributes
    ----------
    time : (m,) array
        Seconds since the run's start, strictly increasing.
    latitude, longitude : (m,) array
        Geodetic WGS 84 coordinates of the antenna, rad.
    height : (m,) array or None
        Ellipsoidal height of the antenna, m.
    sigma_east, sigma_north, sigma_up : (m,) array or None
        Standard deviations as the receiver states them, m; NaN where it says nothing.
    speed, course, sigma_speed : (m,) array or None
        Ground speed, m/s; course over ground from true north, rad; and sigma of the speed, m/s.
    quality, satellites, hdop : (m,) array or None
        The receiver's own words.
    lever_arm_b : (3,) array
        Reference point to antenna: forward, right, down, m.
    frame : str
        The frame that the coordinates came in, as run.toml names it; reading turned them to WGS 84.
    epoch : float or None
        Decimal year of the coordinates, where run.toml names one; otherwise that of the run's start.
    fixed_to : str
        The plate-fixed datum that reading carried the coordinates to and that stands for WGS 84; empty where none is named.
    receiver : str
        Kind of receiver, where run.toml names it; otherwise empty.
    errors : GnssErrors or None
        What is declared of its errors.
    """

    time: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    height: FloatArray | None = None
    sigma_east: FloatArray | None = None
    sigma_north: FloatArray | None = None
    sigma_up: FloatArray | None = None
    speed: FloatArray | None = None
    course: FloatArray | None = None
    sigma_speed: FloatArray | None = None
    quality: FloatArray | None = None
    satellites: FloatArray | None = None
    hdop: FloatArray | None = None
    lever_arm_b: FloatArray = field(default_factory=_zeros3)
    frame: str = "WGS84"
    receiver: str = ""
    epoch: float | None = None
    fixed_to: str = ""
    errors: GnssErrors | None = None

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, slots=True, eq=False)
class ImuStream:
    """Inertial samples: each row is the mean over the interval that ends at its time.

    Attributes
    ----------
    time : (m,) array
        Seconds since the run's start, strictly increasing.
    gyro, specific_force : (m, 3) array
        Angular rate, rad/s, and specific force, m/s^2, in the IMU's own axes (forward, right, down when mounted straight).
    lever_arm_b : (3,) array
        Reference point to IMU: forward, right, down, m.
    mounting : (3,) array
        Roll, pitch, yaw that turn body axes into IMU axes, rad: v_imu = (Rz Ry Rx)^T v_b.
    temperature : (m,) array or None
        Of the sensors, K.
    calibration : str
        Name of the calibration that was applied to the samples; empty if they stand as measured.
    errors : ImuErrors or None
        What is declared of its errors.
    """

    time: FloatArray
    gyro: FloatArray
    specific_force: FloatArray
    lever_arm_b: FloatArray = field(default_factory=_zeros3)
    mounting: FloatArray = field(default_factory=_zeros3)
    temperature: FloatArray | None = None
    calibration: str = ""
    errors: ImuErrors | None = None

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, slots=True, eq=False)
class OdometerStream:
    """Odometer readings: cumulative distance or speed.

    Attributes
    ----------
    time : (m,) array
        Seconds since the run's start, strictly increasing.
    distance : (m,) array or None
        Cumulative distance, m; unsigned (backing up adds) unless `signed`.
    speed : (m,) array or None
        Speed, m/s.
    sigma_speed : (m,) array or None
        Standard deviation of the speed, m/s.
    signed : bool
        Whether backing up subtracts.
    errors : OdometerErrors or None
        What is declared of its errors.
    """

    time: FloatArray
    distance: FloatArray | None = None
    speed: FloatArray | None = None
    sigma_speed: FloatArray | None = None
    signed: bool = False
    errors: OdometerErrors | None = None

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, slots=True, eq=False)
class GyroAnglesStream:
    """Attitude from a gyroscopic sensor: time, s; roll, pitch and heading from true north, rad; each (m,)."""

    time: FloatArray
    roll: FloatArray
    pitch: FloatArray
    heading: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class GaugeStream:
    """Gauge sensor: time, s; gauge and, where measured, cant, m; each (m,).

    `reference_rail` is the rail ("left" or "right" of the vehicle) that the run's lever arms count from; empty: they count from the axis.
    """

    time: FloatArray
    gauge: FloatArray
    cant: FloatArray | None = None
    reference_rail: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class BaliseStream:
    """Balise readings: time, s, (m,); identifiers; sigma along the track, m, (m,) or None."""

    time: FloatArray
    id: tuple[str, ...]
    sigma: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One drive: its streams, its clock and where it came from.

    Attributes
    ----------
    id : str
        The run's name.
    start : datetime
        UTC; every time in the streams counts from here.
    direction : str
        Direction of running as run.toml names it; empty when it does not. Separates the tracks of a double line.
    gnss, imu, odometer, gyro_angles, gauge, balise : stream or None
        The streams that exist.
    source : path or None
        The folder the run was read from.
    simulated : bool
        Whether its streams were made by a simulation; what is worked out from them says so.
    """

    id: str
    start: datetime
    direction: str = ""
    gnss: GnssStream | None = None
    imu: ImuStream | None = None
    odometer: OdometerStream | None = None
    gyro_angles: GyroAnglesStream | None = None
    gauge: GaugeStream | None = None
    balise: BaliseStream | None = None
    source: Path | None = None
    simulated: bool = False

    @classmethod
    def read(cls, folder: str | Path) -> Run:
        """Read a run folder (run.toml and the streams it names); see `railnav.io.run.read_run`."""
        from railnav.io.run import read_run  # a door upward, named in the import contract

        return read_run(folder)
