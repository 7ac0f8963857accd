"""Sensors and their errors: what each one measures, how wrong it is, and ready-made outfits.

An error is the sum of the parts that a filter must tell apart: white noise, a first-order Gauss-Markov part with a correlation time,
a constant drawn once a run, and rare gross errors. Every sensor draws from a generator of its own, so that leaving one out changes
nothing in the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError
from railnav.run import GnssErrors, ImuErrors, OdometerErrors

if TYPE_CHECKING:
    from railnav.inertial.sensors import SensorGrade

FloatArray = NDArray[np.float64]

_DEGREE = math.pi / 180.0
#: What a data sheet declares of a receiver's stamps, s; simulated ones are exact.
STAMP = 1e-3

#: Inertial units by data sheet: the names of gyroscope and accelerometer in `railnav.inertial.sensors.GRADES`.
IMU_SHEETS = {
    "L3G4200D": ("L3G4200D gyroscope", "LSM303DLH accelerometer"),
    "IMU440": ("IMU440 gyroscope", "IMU440 accelerometer"),
    "RT3003": ("RT3003 gyroscope", "RT3003 accelerometer"),
    "STIM300": ("STIM300 gyroscope", "STIM300 accelerometer"),
}


@dataclass(frozen=True, slots=True)
class GnssSensor:
    """A GNSS receiver.

    Attributes
    ----------
    interval : float
        Time between fixes, s.
    lever_arm_b : (3,) tuple
        Reference point to antenna: forward, right, down, m.
    white_horizontal, white_vertical : float
        Sigma of the white part, per axis, m.
    coloured_horizontal, coloured_vertical : float
        Sigma of the first-order Gauss-Markov part, per axis, m.
    correlation_time : float
        Of the Gauss-Markov part, s.
    speed_sigma : float
        Sigma of each horizontal velocity component, m/s.
    outlier_probability, outlier_size : float
        Probability of a gross error a fix, and its sigma per axis, m; the stated sigma does not tell.
    frame_offset : (3,) tuple
        Constant offset of the receiver's frame: east, north, up, m.
    stated_factor : float
        Stated sigma over true sigma: 1 is an honest receiver; 0 states none.
    reacquisition : float
        Time without fixes after an outage, s.
    quality : float
        What the quality column says.
    receiver : str
        Kind of receiver.
    """

    interval: float = 1.0
    lever_arm_b: tuple[float, float, float] = (1.2, 0.0, -3.1)
    white_horizontal: float = 0.5
    white_vertical: float = 0.9
    coloured_horizontal: float = 1.4
    coloured_vertical: float = 2.4
    correlation_time: float = 60.0
    speed_sigma: float = 0.05
    outlier_probability: float = 0.0
    outlier_size: float = 25.0
    frame_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stated_factor: float = 1.0
    reacquisition: float = 2.0
    quality: float = 1.0
    receiver: str = "simulated"

    @property
    def sigma_horizontal(self) -> float:
        """True sigma of one horizontal axis, m."""
        return math.hypot(self.white_horizontal, self.coloured_horizontal)

    @property
    def sigma_vertical(self) -> float:
        """True sigma of the height, m."""
        return math.hypot(self.white_vertical, self.coloured_vertical)

    @property
    def sheet(self) -> GnssErrors:
        """What its data sheet declares; stamps within a millisecond, a speed that is not smoothed."""
        return GnssErrors(
            white=self.white_horizontal,
            correlated=self.coloured_horizontal,
            correlation_time=self.correlation_time,
            frame_offset=0.0,
            stamp=STAMP,
            speed_latency=0.01,
            speed_correlated=0.0,
        )


@dataclass(frozen=True, slots=True)
class ImuSensor:
    """Three gyros and three accelerometers.

    Attributes
    ----------
    interval : float
        Time between samples, s.
    lever_arm_b : (3,) tuple
        Reference point to IMU: forward, right, down, m.
    mounting : (3,) tuple
        Nominal roll, pitch, yaw that turn body axes into IMU axes, rad.
    mounting_sigma : float
        Sigma of what remains unknown of each mounting angle, rad.
    gyro_white, accelerometer_white : float
        Angular random walk, rad/sqrt(s), and velocity random walk, m/s/sqrt(s): a sample's sigma is this over sqrt(interval).
    gyro_bias, accelerometer_bias : float
        Sigma of the bias at switch-on, rad/s and m/s^2.
    gyro_bias_walk, accelerometer_bias_walk : float
        Random walk of the biases, rad/s/sqrt(s) and m/s^2/sqrt(s).
    gyro_scale, accelerometer_scale : float
        Sigma of each axis's scale error.
    gyro_full_scale, accelerometer_full_scale : float
        Greatest reading, rad/s and m/s^2: beyond it an axis is saturated.
    """

    interval: float = 0.01
    lever_arm_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mounting_sigma: float = 0.2 * _DEGREE
    gyro_white: float = 0.2 * _DEGREE / 60.0
    accelerometer_white: float = 0.04 / 60.0
    gyro_bias: float = 0.03 * _DEGREE
    accelerometer_bias: float = 0.02
    gyro_bias_walk: float = 1e-6
    accelerometer_bias_walk: float = 2e-5
    gyro_scale: float = 1e-3
    accelerometer_scale: float = 1e-3
    gyro_full_scale: float = math.inf
    accelerometer_full_scale: float = math.inf

    @property
    def sheet(self) -> ImuErrors:
        """What its data sheet declares; the vehicle is rigid and follows the track, so that it does not sway."""
        return ImuErrors(
            gyro_bias=self.gyro_bias,
            gyro_walk=self.gyro_bias_walk,
            gyro_scale=self.gyro_scale,
            accelerometer_bias=self.accelerometer_bias,
            accelerometer_walk=self.accelerometer_bias_walk,
            mounting=self.mounting_sigma,
            sway=0.0,
        )

    @classmethod
    def of_sheet(cls, name: str, *, interval: float = 0.01) -> ImuSensor:
        """An IMU by its data sheet, one of `IMU_SHEETS`: white noise, switch-on bias, in-run instability, scale, range.

        The in-run part becomes a random walk of the bias that grows as fast: density = instability * sqrt(2 / correlation time).

        Raises
        ------
        InputError
            An unknown sheet.

        Examples
        --------
        >>> ImuSensor.of_sheet("STIM300").gyro_white < ImuSensor.of_sheet("IMU440").gyro_white
        True
        """
        from railnav.inertial.sensors import GRADES

        if name not in IMU_SHEETS:
            raise InputError(f"no data sheet {name!r}; there are {', '.join(IMU_SHEETS)}")
        gyro, accelerometer = (GRADES[sheet] for sheet in IMU_SHEETS[name])

        def walk(grade: SensorGrade) -> float:
            return grade.instability * math.sqrt(2.0 / grade.correlation_time)

        return cls(
            interval=interval,
            gyro_white=gyro.random_walk,
            accelerometer_white=accelerometer.random_walk,
            gyro_bias=math.hypot(gyro.bias, gyro.instability),
            accelerometer_bias=math.hypot(accelerometer.bias, accelerometer.instability),
            gyro_bias_walk=walk(gyro),
            accelerometer_bias_walk=walk(accelerometer),
            gyro_scale=gyro.scale,
            accelerometer_scale=accelerometer.scale,
            gyro_full_scale=gyro.full_scale,
            accelerometer_full_scale=accelerometer.full_scale,
        )


@dataclass(frozen=True, slots=True)
class OdometerSensor:
    """A wheel that counts.

    Attributes
    ----------
    interval : float
        Time between readings, s.
    scale_sigma : float
        Sigma of the relative scale error (wheel diameter).
    scale_error : float or None
        This scale error instead of a drawn one.
    roughness : float
        Random walk of the reading with distance, m/sqrt(m).
    resolution : float
        Distance a count, m; 0 for none.
    slip_rate : float
        Expected slips an hour while power or brakes are on.
    slip_size, slip_duration : float
        Mean relative slip, and its mean duration, s: the wheel runs ahead under power and falls behind under brakes.
    signed : bool
        Whether backing up subtracts.
    """

    interval: float = 0.1
    scale_sigma: float = 3e-3
    scale_error: float | None = None
    roughness: float = 2e-3
    resolution: float = 0.01
    slip_rate: float = 0.0
    slip_size: float = 0.08
    slip_duration: float = 4.0
    signed: bool = False

    @property
    def sheet(self) -> OdometerErrors:
        """What its data sheet declares."""
        return OdometerErrors(scale=self.scale_sigma, creep=self.roughness)


@dataclass(frozen=True, slots=True)
class AnglesSensor:
    """A gyroscopic sensor of roll, pitch and heading.

    Attributes
    ----------
    interval : float
        s.
    white : float
        Sigma of each reading, rad.
    bias : float
        Sigma of each angle's constant error, rad.
    """

    interval: float = 0.2
    white: float = 0.01 * _DEGREE
    bias: float = 0.01 * _DEGREE


@dataclass(frozen=True, slots=True)
class GaugeSensor:
    """A sensor of gauge and cant.

    Attributes
    ----------
    interval : float
        s.
    sigma : float
        Sigma of each reading, m.
    gauge : float
        True gauge, m.
    """

    interval: float = 0.2
    sigma: float = 0.0005
    gauge: float = 1.435


@dataclass(frozen=True, slots=True)
class BaliseSensor:
    """A reader of balises, where the model lists them in `provenance["balises"]`.

    Attributes
    ----------
    sigma : float
        Sigma of the place along the track at which a balise is read, m.
    missed : float
        Probability that one is passed unread.
    interval : float
        Time between looks, s: stamps are exact to better than this.
    """

    sigma: float = 0.3
    missed: float = 1e-3
    interval: float = 0.05


@dataclass(frozen=True, slots=True)
class Outfit:
    """The sensors of one train; None for those it does not carry."""

    name: str
    gnss: GnssSensor | None = None
    imu: ImuSensor | None = None
    odometer: OdometerSensor | None = None
    angles: AnglesSensor | None = None
    gauge: GaugeSensor | None = None
    balise: BaliseSensor | None = None


#: Survey car: carrier-phase GNSS of 2 cm, attitude, gauge and cant, calibrated odometer.
SURVEY = Outfit(
    "survey",
    gnss=GnssSensor(
        interval=0.2,
        lever_arm_b=(0.5, 0.0, -3.6),
        white_horizontal=0.017,
        white_vertical=0.025,
        coloured_horizontal=0.010,
        coloured_vertical=0.020,
        correlation_time=60.0,
        speed_sigma=0.02,
        outlier_probability=0.001,
        outlier_size=1.0,
        quality=4.0,
        receiver="carrier phase",
    ),
    odometer=OdometerSensor(scale_sigma=2e-4, roughness=5e-4, resolution=0.001),
    angles=AnglesSensor(),
    gauge=GaugeSensor(),
)

#: Train in service: code GNSS with coloured errors (1.5 m), MEMS IMU, odometer.
SERVICE = Outfit(
    "service",
    gnss=GnssSensor(outlier_probability=0.002),
    imu=ImuSensor(),
    odometer=OdometerSensor(slip_rate=4.0),
)

#: Telephone on the window sill: GNSS alone, slowly wandering, too sure of itself.
PHONE = Outfit(
    "phone",
    gnss=GnssSensor(
        lever_arm_b=(0.0, 1.2, -2.2),
        white_horizontal=1.0,
        white_vertical=2.0,
        coloured_horizontal=2.8,
        coloured_vertical=4.5,
        correlation_time=120.0,
        speed_sigma=0.2,
        outlier_probability=0.005,
        stated_factor=0.8,
        reacquisition=6.0,
        receiver="phone",
    ),
)

_SHEET_GNSS, _SHEET_ODOMETER = GnssSensor(outlier_probability=0.002), OdometerSensor(slip_rate=4.0)


def outfit_of(name: str, *, imu: str | None = None) -> Outfit:
    """An outfit by name: `OUTFITS`, or "mems" and "tactical": a service train whose IMU is that of a data sheet.

    Parameters
    ----------
    name : str
        "survey", "service", "phone", "mems" (IMU440) or "tactical" (STIM300).
    imu : str, optional
        One of `IMU_SHEETS`, instead of the outfit's own IMU.

    Returns
    -------
    Outfit

    Raises
    ------
    InputError
        Unknown names.

    Examples
    --------
    >>> outfit_of("tactical").imu.gyro_white < outfit_of("service").imu.gyro_white
    True
    """
    if name in SHEET_OUTFITS:
        outfit = Outfit(name, gnss=_SHEET_GNSS, imu=ImuSensor.of_sheet(SHEET_OUTFITS[name]), odometer=_SHEET_ODOMETER)
    elif name in OUTFITS:
        outfit = OUTFITS[name]
    else:
        raise InputError(f"no outfit {name!r}; there are {', '.join((*OUTFITS, *SHEET_OUTFITS))}")
    return outfit if imu is None else replace(outfit, imu=ImuSensor.of_sheet(imu))


#: Outfits by name.
OUTFITS = {outfit.name: outfit for outfit in (SURVEY, SERVICE, PHONE)}
#: Outfits of a service train with the IMU of a data sheet.
SHEET_OUTFITS = {"mems": "IMU440", "tactical": "STIM300"}


def gauss_markov(
    generator: np.random.Generator, count: int, interval: float, sigma: float, correlation_time: float
) -> FloatArray:
    """First-order Gauss-Markov sequence, stationary from its first value.

    x[k + 1] = phi x[k] + sqrt(1 - phi^2) sigma w[k], phi = exp(-interval / correlation_time), w white and standard normal.

    Parameters
    ----------
    generator : numpy Generator
    count : int
    interval, correlation_time : float
        s.
    sigma : float
        Standard deviation of every value.

    Returns
    -------
    (count,) array

    Examples
    --------
    >>> gauss_markov(np.random.default_rng(1), 3, 1.0, 0.0, 60.0)
    array([0., 0., 0.])
    """
    from scipy.signal import lfilter

    phi = math.exp(-interval / correlation_time)
    drive = generator.standard_normal(count)
    drive[1:] *= math.sqrt(1.0 - phi * phi)
    return np.asarray(sigma * lfilter([1.0], [1.0, -phi], drive))
