"""What an aided strapdown estimates beside its fifteen errors, and how IMU, antenna and wheels sit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.inertial.aided import layout as k
from railnav.inertial.imu_noise import ImuNoise, InitialSigma

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Unknowns:
    """Parameters that the filter estimates beside the fifteen errors: standard deviations before the first sample; 0: taken as known.

    Attributes
    ----------
    gyro_scale, accelerometer_scale : float
        Of each axis' scale factor s, measured = (1 + s) true + bias.
    gyro_scale_walk, accelerometer_scale_walk : float
        Random walk of the scale factors, 1/sqrt(s).
    antenna_arm : float
        Of each component of the arm IMU to antenna, m.
    axle_arm : float
        Of each component of the arm IMU to the point that moves along the nose (a car's rear axle, a bogie's pivot), m.
    mounting : float
        Of pitch and yaw of the vehicle against the IMU's body axes, rad.
    time_offset : float
        Of what is to be added to the stamps of the fixes to bring them to the IMU's clock, s.
    odometer_scale, odometer_scale_walk : float
        Of k in measured = (1 + k) true, and its random walk, 1/sqrt(s).
    clock_bias, clock_drift : float
        Of the receiver's clock, m, m/s; needed for ranges.
    clock_walk, drift_walk : float
        Random walks of bias and drift, m/sqrt(s), m/s/sqrt(s).
    """

    gyro_scale: float = 0.0
    accelerometer_scale: float = 0.0
    gyro_scale_walk: float = 0.0
    accelerometer_scale_walk: float = 0.0
    antenna_arm: float = 0.0
    axle_arm: float = 0.0
    mounting: float = 0.0
    time_offset: float = 0.0
    odometer_scale: float = 0.0
    odometer_scale_walk: float = 0.0
    clock_bias: float = 0.0
    clock_drift: float = 0.0
    clock_walk: float = 0.1
    drift_walk: float = 0.2

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (value >= 0.0 and math.isfinite(value)):
                raise ValueError(f"{name} is {value}; it must not be negative")


@dataclass(frozen=True, slots=True)
class Vehicle:
    """How IMU, antenna and wheels sit; nominal values where `Unknowns` estimates them.

    Attributes
    ----------
    antenna_arm_b, axle_arm_b : tuple of float
        IMU to antenna, IMU to the point that moves along the nose: forward, right, down, m.
    mounting : tuple of float
        Small turns about the body's right and down axes, rad, that bring the components of a vector in the body axes of the IMU into the
        vehicle's: v_vehicle = exp([(0, pitch, yaw) x]) v_b.
    """

    antenna_arm_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axle_arm_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mounting: tuple[float, float] = (0.0, 0.0)


def menu(
    extra: Unknowns, initial: InitialSigma, noise: ImuNoise
) -> tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray, tuple[str, ...]]:
    """First column of each group, sigmas, noise densities and rates of decay of the parameters, names of all states."""
    tau_g, tau_a = noise.gyro_correlation_time, noise.accelerometer_correlation_time
    rows: dict[str, tuple[float, float, float]] = {
        "antenna_arm": (extra.antenna_arm, 0.0, 0.0),
        "axle_arm": (extra.axle_arm, 0.0, 0.0),
        "mounting": (extra.mounting, 0.0, 0.0),
        "time_offset": (extra.time_offset, 0.0, 0.0),
        "odometer_scale": (extra.odometer_scale, extra.odometer_scale_walk, 0.0),
        "clock": (extra.clock_bias, 0.0, 0.0),
        "gyro_scale": (extra.gyro_scale, extra.gyro_scale_walk, 0.0),
        "accelerometer_scale": (extra.accelerometer_scale, extra.accelerometer_scale_walk, 0.0),
        "gyro_bias": (initial.gyro_bias, noise.gyro_instability * math.sqrt(2.0 / tau_g), 1.0 / tau_g),
        "accelerometer_bias": (
            initial.accelerometer_bias,
            noise.accelerometer_instability * math.sqrt(2.0 / tau_a),
            1.0 / tau_a,
        ),
    }
    at = np.full(len(k.GROUPS), -1, dtype=np.int64)
    sigma: list[float] = []
    density: list[float] = []
    decay: list[float] = []
    names: list[str] = []
    for g, (name, size) in enumerate(k.GROUPS):
        s, d, r = rows[name]
        if s == 0.0 and g < k.GYRO_BIAS:
            continue
        at[g] = len(sigma)
        if name == "clock":
            sigma += [extra.clock_drift, extra.clock_bias]
            density += [extra.drift_walk, extra.clock_walk]
            decay += [0.0, 0.0]
            names += ["clock_drift", "clock_bias"]
            continue
        sigma += [s] * size
        density += [d] * size
        decay += [r] * size
        letters = ("",) if size == 1 else (("_pitch", "_yaw") if size == 2 else ("_x", "_y", "_z"))
        names += [name + letter for letter in letters]
    for name, letters in (
        ("attitude", ("north", "east", "down")),
        ("velocity", ("north", "east", "down")),
    ):
        names += [f"{name}_{letter}" for letter in letters]
    names += ["latitude", "longitude", "height"]
    return at, np.array(sigma), np.array(density), np.array(decay), tuple(names)
