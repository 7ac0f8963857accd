"""What a filter over an IMU must be told: the noise of its triads, and how well the state is known before the first sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise of an IMU as the filter takes it.

    Attributes
    ----------
    angle_random_walk, velocity_random_walk : float
        rad/sqrt(s), m/s/sqrt(s).
    gyro_instability, accelerometer_instability : float
        Sigma of the in-run biases, first-order Gauss-Markov, rad/s and m/s^2.
    gyro_correlation_time, accelerometer_correlation_time : float
        s.
    """

    angle_random_walk: float
    velocity_random_walk: float
    gyro_instability: float = 0.0
    accelerometer_instability: float = 0.0
    gyro_correlation_time: float = 600.0
    accelerometer_correlation_time: float = 600.0

    def __post_init__(self) -> None:
        for name in ("angle_random_walk", "velocity_random_walk", "gyro_instability", "accelerometer_instability"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must not be negative")
        for name in ("gyro_correlation_time", "accelerometer_correlation_time"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")


@dataclass(frozen=True, slots=True, eq=False)
class InitialSigma:
    """Standard deviations of the state before the first sample.

    Attributes
    ----------
    position : (3,) array
        North, east, up, m.
    velocity : (3,) array
        North, east, down, m/s.
    attitude : (3,) array
        Small turn about north, east, down, rad.
    gyro_bias, accelerometer_bias : float
        rad/s, m/s^2.
    """

    position: FloatArray
    velocity: FloatArray
    attitude: FloatArray
    gyro_bias: float
    accelerometer_bias: float
