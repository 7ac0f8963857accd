"""Error models of inertial triads, and what data sheets say of some of them.

A triad measures three components of one vector: of the specific force f_b (m/s^2) or of the rate w_ib_b (rad/s). "unit" below is the
unit of the measured quantity. All models hold for both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.units import STANDARD_GRAVITY

FloatArray = NDArray[np.float64]
Vector = tuple[float, float, float]

_ZERO: Vector = (0.0, 0.0, 0.0)
_DEGREE = math.pi / 180.0
_DEGREE_PER_HOUR = _DEGREE / 3600.0
_DEGREE_PER_ROOT_HOUR = _DEGREE / 60.0
_SPEED_PER_ROOT_HOUR = 1.0 / 60.0
_MILLI_G = 1e-3 * STANDARD_GRAVITY


@dataclass(frozen=True, slots=True)
class TriadModel:
    """One triad with its own errors: measured = (I + K + N) true + K2 true^2 + b + d t + slow parts + noise, then quantised.

    Attributes
    ----------
    bias : (3,) tuple
        b, constant of this switch-on, unit.
    drift : (3,) tuple
        d, linear drift, unit/s (KZ(1.6)).
    scale : (3,) tuple
        K, relative error of the scale factors.
    quadratic : (3,) tuple
        K2, 1/unit (KZ(1.10)).
    cross_axis : ((3,), (3,), (3,)) tuple
        N, share of axis j seen by sensor i; zero diagonal.
    random_walk : float
        Density of the white noise, unit sqrt(s): angle or velocity random walk.
    instability : float
        Sigma of the in-run part, a first-order Gauss-Markov process, unit (KZ(1.8)).
    correlation_time : float
        Of the in-run part, s.
    rate_random_walk : float
        Density of the random walk of the bias, unit/sqrt(s).
    quantum : float
        Step of the output, unit; 0 for none.
    full_scale : float
        Greatest output, unit; beyond it the output saturates, and `TriadSamples.saturated` says so.
    bias_temperature : (3,) tuple
        Change of bias with temperature, unit/K.
    scale_temperature : (3,) tuple
        Change of scale with temperature, 1/K.
    reference_temperature : float
        Where both are zero, K.

    References
    ----------
    `spec/inertial.md` B2, KZ(1.4) to KZ(1.19), KZ(2.24), KZ(2.25).

    Examples
    --------
    >>> TriadModel(bias=(0.1, 0.0, 0.0)).bias
    (0.1, 0.0, 0.0)
    """

    bias: Vector = _ZERO
    drift: Vector = _ZERO
    scale: Vector = _ZERO
    quadratic: Vector = _ZERO
    cross_axis: tuple[Vector, Vector, Vector] = (_ZERO, _ZERO, _ZERO)
    random_walk: float = 0.0
    instability: float = 0.0
    correlation_time: float = 600.0
    rate_random_walk: float = 0.0
    quantum: float = 0.0
    full_scale: float = math.inf
    bias_temperature: Vector = _ZERO
    scale_temperature: Vector = _ZERO
    reference_temperature: float = 298.15

    def __post_init__(self) -> None:
        for name in ("random_walk", "instability", "rate_random_walk", "quantum"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must not be negative")
        for name in ("correlation_time", "full_scale"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")

    def sample_sigma(self, interval: float) -> float:
        """Sigma of the white noise in the mean over `interval` seconds, random_walk/sqrt(interval), unit."""
        return self.random_walk / math.sqrt(interval)


@dataclass(frozen=True, slots=True, eq=False)
class TriadSamples:
    """What a simulated triad gave.

    Attributes
    ----------
    measured : (n, 3) array
        Output, unit.
    bias : (n, 3) array
        Sum of all additive parts but white noise and quantisation, unit: the truth for a bias estimator.
    saturated : (n, 3) bool array
        Where the output stands at full scale.
    """

    measured: FloatArray
    bias: FloatArray
    saturated: NDArray[np.bool_]


def simulate_triad(
    true: ArrayLike, interval: float, model: TriadModel, *, seed: int, temperature: ArrayLike | None = None
) -> TriadSamples:
    """Output of a triad for a given true quantity.

    Parameters
    ----------
    true : (n, 3) array
        Means over the sampling intervals, unit.
    interval : float
        Sampling interval, s.
    model : TriadModel
        The triad.
    seed : int
        Of the random generator: the same seed gives the same samples.
    temperature : float or (n,) array, optional
        K; default: the model's reference temperature.

    Returns
    -------
    TriadSamples
        Output, true bias and saturation.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or an interval that is not positive.

    Notes
    -----
    The in-run part starts in its stationary distribution: b_(k+1) = e^(-dt/T) b_k + sigma sqrt(1 - e^(-2 dt/T)) n_k.

    References
    ----------
    `spec/inertial.md` B2.

    Examples
    --------
    >>> simulate_triad(np.zeros((2, 3)), 0.01, TriadModel(bias=(0.1, 0.2, 0.3), quantum=0.25), seed=1).measured
    array([[0.  , 0.25, 0.25],
           [0.  , 0.25, 0.25]])
    """
    x = np.asarray(true, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3:
        raise ValueError(f"true must have the shape (n, 3), not {x.shape}")
    if not np.isfinite(x).all():
        raise ValueError("true holds a value that is not finite")
    if not (math.isfinite(interval) and interval > 0.0):
        raise ValueError(f"interval is {interval}; it must be positive")
    n = len(x)
    warmer = np.zeros((n, 1))
    if temperature is not None:
        warmer = np.broadcast_to(np.asarray(temperature, dtype=np.float64), (n,))[:, None] - model.reference_temperature
        if not np.isfinite(warmer).all():
            raise ValueError("temperature holds a value that is not finite")
    random = np.random.default_rng(seed)
    white, slow, walk = (random.standard_normal((n, 3)) for _ in range(3))
    bias = np.asarray(model.bias) + np.outer(np.arange(n) * interval, model.drift)
    bias = bias + warmer * np.asarray(model.bias_temperature)
    if model.instability > 0.0:
        keep = math.exp(-interval / model.correlation_time)
        slow[1:] *= math.sqrt(-math.expm1(-2.0 * interval / model.correlation_time))
        bias = bias + model.instability * _first_order(slow, keep)
    if model.rate_random_walk > 0.0:
        bias = bias + model.rate_random_walk * math.sqrt(interval) * np.cumsum(walk, axis=0)
    matrix = np.eye(3) + np.diag(model.scale) + np.asarray(model.cross_axis)
    measured = x @ matrix.T + np.asarray(model.scale_temperature) * warmer * x + np.asarray(model.quadratic) * x**2
    measured = measured + bias + model.sample_sigma(interval) * white
    if model.quantum > 0.0:
        measured = model.quantum * np.round(measured / model.quantum)
    saturated = np.abs(measured) >= model.full_scale
    measured = np.clip(measured, -model.full_scale, model.full_scale) + 0.0
    return TriadSamples(measured, bias, saturated)


def misalignment_matrix(rotation: ArrayLike, skewness: ArrayLike = _ZERO) -> FloatArray:
    """Matrix of a triad that sits turned in its case and whose axes are not square: M = M_beta M_theta.

    M_theta = I + [theta x] for a small turn theta = (tx, ty, tz), M_beta = [1 0 0; byz 1 0; -bzy bzx 1].

    Parameters
    ----------
    rotation : (3,) array
        theta, rad.
    skewness : (3,) array, optional
        byz, bzy, bzx, rad; the first axis is the reference.

    Returns
    -------
    (3, 3) array
        measured = M true.

    Raises
    ------
    ValueError
        Wrong shape.

    Notes
    -----
    The source builds M_theta from elementary matrices of mixed sense, KZ(1.12) to KZ(1.14), whose product is not KZ(1.15): off by
    6e-3 for angles of 1 to 3 mrad. KZ(1.15) itself is right and used here.

    References
    ----------
    `spec/inertial.md` B2, KZ(1.15) to KZ(1.17).

    Examples
    --------
    >>> misalignment_matrix([0.0, 0.0, 1e-3])[0]
    array([ 1.   , -0.001,  0.   ])
    """
    t, b = np.asarray(rotation, dtype=np.float64), np.asarray(skewness, dtype=np.float64)
    if t.shape != (3,) or b.shape != (3,):
        raise ValueError(f"rotation and skewness must have the shape (3,), not {t.shape} and {b.shape}")
    M_theta = np.array([[1.0, -t[2], t[1]], [t[2], 1.0, -t[0]], [-t[1], t[0], 1.0]])
    M_beta = np.array([[1.0, 0.0, 0.0], [b[0], 1.0, 0.0], [-b[1], b[2], 1.0]])
    return np.asarray(M_beta @ M_theta)


@dataclass(frozen=True, slots=True)
class SensorGrade:
    """What a data sheet says of a kind of triad; `draw` makes one specimen of it.

    Attributes
    ----------
    name : str
        Type.
    kind : {"gyroscope", "accelerometer"}
        What it measures: rad/s or m/s^2.
    source : str
        Where the figures stand.
    full_scale, quantum : float
        Greatest output and step of the output, unit.
    bias : float
        Sigma of the switch-on bias, unit.
    instability, correlation_time : float
        Sigma of the in-run part, unit, and its correlation time, s.
    random_walk : float
        Density of the white noise, unit sqrt(s).
    scale, cross_axis : float
        Sigma of the scale errors and of the misalignments.
    bias_temperature : float
        Sigma of the change of bias with temperature, unit/K.
    scale_temperature : float
        Sigma of the change of scale with temperature, 1/K.

    Notes
    -----
    A sheet's "typical" or "less than" is taken as one sigma. What the source does not give is 0.
    """

    name: str
    kind: Literal["gyroscope", "accelerometer"]
    source: str
    full_scale: float = math.inf
    quantum: float = 0.0
    bias: float = 0.0
    instability: float = 0.0
    correlation_time: float = 600.0
    random_walk: float = 0.0
    scale: float = 0.0
    cross_axis: float = 0.0
    bias_temperature: float = 0.0
    scale_temperature: float = 0.0

    def draw(self, seed: int) -> TriadModel:
        """One specimen: constants drawn from normal distributions with the sheet's figures as sigmas.

        Parameters
        ----------
        seed : int
            Of the random generator.

        Returns
        -------
        TriadModel

        Examples
        --------
        >>> GRADES["IMU440 gyroscope"].draw(1) == GRADES["IMU440 gyroscope"].draw(1)
        True
        """
        random = np.random.default_rng(seed)

        def three(sigma: float) -> Vector:
            x, y, z = (float(sigma * v) for v in random.standard_normal(3))
            return x, y, z

        bias, scale, bias_temperature, scale_temperature = (
            three(s) for s in (self.bias, self.scale, self.bias_temperature, self.scale_temperature)
        )
        first, second = three(self.cross_axis), three(self.cross_axis)
        return TriadModel(
            bias=bias,
            scale=scale,
            cross_axis=((0.0, first[0], first[1]), (first[2], 0.0, second[0]), (second[1], second[2], 0.0)),
            random_walk=self.random_walk,
            instability=self.instability,
            correlation_time=self.correlation_time,
            quantum=self.quantum,
            full_scale=self.full_scale,
            bias_temperature=bias_temperature,
            scale_temperature=scale_temperature,
        )


_TABLES = "tables 4 to 9 of the source, spec/inertial.md B2"
_STIM300 = "manufacturer's sheet as quoted by NavToolkit, navtk::filtering::stim300_model (is4s.github.io/NavToolkit), 10 g range"

_ASM330 = (
    "noise, accelerometer bias and scale from the defaults of github.com/rsonawane2002/My_IMU (asm330lhh.py), a simulator, worse end of "
    "its ranges: the maker's table was not at hand; ranges from docs.rs/asm330lhhx-rs; switch-on bias of the gyro of 1 deg/s is assumed"
)

#: Data-sheet figures by name.
GRADES: dict[str, SensorGrade] = {
    g.name: g
    for g in (
        SensorGrade(
            "L3G4200D gyroscope",
            "gyroscope",
            _TABLES + " (250 deg/s range)",
            full_scale=250.0 * _DEGREE,
            quantum=8.75e-3 * _DEGREE,
            bias=10.0 * _DEGREE,
            random_walk=0.03 * _DEGREE,
            scale=0.02,
            bias_temperature=0.03 * _DEGREE,
        ),
        SensorGrade(
            "LSM303DLH accelerometer",
            "accelerometer",
            _TABLES + " (LSM303DLM, 2 g range); noise 218 ug/sqrt(Hz) from spec/rail.md 14",
            full_scale=2.0 * STANDARD_GRAVITY,
            quantum=_MILLI_G,
            bias=60.0 * _MILLI_G,
            random_walk=0.218 * _MILLI_G,
            bias_temperature=0.5 * _MILLI_G,
            scale_temperature=1e-4,
        ),
        SensorGrade(
            "IMU440 gyroscope",
            "gyroscope",
            _TABLES + "; switch-on bias 36 deg/h from B14.2",
            full_scale=200.0 * _DEGREE,
            bias=36.0 * _DEGREE_PER_HOUR,
            instability=10.0 * _DEGREE_PER_HOUR,
            random_walk=4.5 * _DEGREE_PER_ROOT_HOUR,
            scale=0.01,
            cross_axis=0.005,
        ),
        SensorGrade(
            "IMU440 accelerometer",
            "accelerometer",
            _TABLES + "; switch-on bias 2 mg and in-run 0.5 mg from B14.2",
            full_scale=4.0 * STANDARD_GRAVITY,
            bias=2.0 * _MILLI_G,
            instability=0.5 * _MILLI_G,
            random_walk=1.0 * _SPEED_PER_ROOT_HOUR,
            scale=0.01,
            cross_axis=0.01,
        ),
        SensorGrade(
            "RT3003 gyroscope",
            "gyroscope",
            _TABLES,
            full_scale=100.0 * _DEGREE,
            instability=2.0 * _DEGREE_PER_HOUR,
            random_walk=0.2 * _DEGREE_PER_ROOT_HOUR,
            scale=1e-3,
            cross_axis=0.05 * _DEGREE,
        ),
        SensorGrade(
            "RT3003 accelerometer",
            "accelerometer",
            _TABLES,
            full_scale=10.0 * STANDARD_GRAVITY,
            instability=2e-3 * _MILLI_G,
            random_walk=0.005 * _SPEED_PER_ROOT_HOUR,
            scale=1e-3,
            cross_axis=0.05 * _DEGREE,
        ),
        SensorGrade(
            "STIM300 gyroscope",
            "gyroscope",
            _STIM300,
            full_scale=400.0 * _DEGREE,
            bias=250.0 * _DEGREE_PER_HOUR,
            instability=0.5 * _DEGREE_PER_HOUR,
            random_walk=0.15 * _DEGREE_PER_ROOT_HOUR,
            scale=500e-6,
            cross_axis=1e-3,
        ),
        SensorGrade(
            "STIM300 accelerometer",
            "accelerometer",
            _STIM300,
            full_scale=10.0 * STANDARD_GRAVITY,
            bias=0.75 * _MILLI_G,
            instability=0.05 * _MILLI_G,
            random_walk=0.06 * _SPEED_PER_ROOT_HOUR,
            scale=300e-6,
            cross_axis=1e-3,
        ),
        SensorGrade(
            "ASM330LHH gyroscope",
            "gyroscope",
            _ASM330,
            full_scale=125.0 * _DEGREE,
            quantum=125.0 / 2**15 * _DEGREE,
            bias=1.0 * _DEGREE,
            instability=4.0 * _DEGREE_PER_HOUR,
            random_walk=5e-3 * _DEGREE,
            scale=1e-3,
        ),
        SensorGrade(
            "ASM330LHH accelerometer",
            "accelerometer",
            _ASM330,
            full_scale=2.0 * STANDARD_GRAVITY,
            quantum=2.0 / 2**15 * STANDARD_GRAVITY,
            bias=15.0 * _MILLI_G,
            random_walk=0.12 * _MILLI_G,
            scale=3e-3,
        ),
    )
}


def _first_order(driven: FloatArray, keep: float) -> FloatArray:
    """x_k = keep x_(k-1) + driven_k down the columns."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], [1.0, -keep], driven, axis=0))
