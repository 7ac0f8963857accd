"""Allan deviation of a static log, and the noise parameters that explain it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.run import ImuStream

FloatArray = NDArray[np.float64]

#: Noise terms that `fit_allan` knows.
TERMS = ("quantisation", "random_walk", "bias_instability", "gauss_markov", "rate_random_walk", "ramp")


@dataclass(frozen=True, slots=True, eq=False)
class AllanCurve:
    """Allan deviation against averaging time.

    Attributes
    ----------
    time : (k,) array
        Averaging time tau, s.
    deviation : (k,) array
        Of the means over tau, unit of the log.
    relative_error : (k,) array
        Sigma of the deviation over the deviation, 1/sqrt(2 (n/m - 1)).
    interval : float
        Sampling interval, s.
    duration : float
        Length of the log, s.
    """

    time: FloatArray
    deviation: FloatArray
    relative_error: FloatArray
    interval: float
    duration: float


@dataclass(frozen=True, slots=True)
class NoiseParameters:
    """Noise of a sensor, each part with its sigma; a part that was not fitted, or not found, is 0.

    Attributes
    ----------
    random_walk : float
        N, density of the white noise, unit sqrt(s): sigma^2 = N^2/tau.
    bias_instability : float
        B of flicker noise, unit: sigma^2 = (2 ln 2/pi) B^2, a floor of 0.664 B.
    rate_random_walk : float
        K, unit/sqrt(s): sigma^2 = K^2 tau/3.
    quantisation : float
        Q, unit s: sigma^2 = 3 Q^2/tau^2.
    ramp : float
        R, unit/s: sigma^2 = R^2 tau^2/2.
    gauss_markov : float
        Sigma of a first-order Gauss-Markov part, unit.
    correlation_time : float
        Of the Gauss-Markov part, s; 0 where there is none.
    sigma : dict of str to float
        Standard deviation of each part found. The points of an overlapping curve are correlated: good to a factor of about two.
    misfit : float
        Root mean square of (deviation - fit) over its sigma; 0.5 to 1 if the parts explain the curve, well above if they do not.
    """

    random_walk: float
    bias_instability: float
    rate_random_walk: float
    quantisation: float
    ramp: float
    gauss_markov: float
    correlation_time: float
    sigma: dict[str, float]
    misfit: float

    def parts(self, time: ArrayLike) -> dict[str, FloatArray]:
        """Allan variance that each part makes at averaging times, (k,) s -> (k,), unit^2, by the names of `TERMS`.

        Examples
        --------
        >>> NoiseParameters(2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, {}, 0.0).parts([4.0])["random_walk"]
        array([1.])
        """
        tau = np.asarray(time, dtype=np.float64)
        slow = _markov(tau, self.correlation_time) if self.gauss_markov > 0.0 else np.zeros_like(tau)
        return {
            "quantisation": 3.0 * self.quantisation**2 / tau**2,
            "random_walk": self.random_walk**2 / tau,
            "bias_instability": np.full_like(tau, 2.0 * math.log(2.0) / math.pi * self.bias_instability**2),
            "gauss_markov": self.gauss_markov**2 * slow,
            "rate_random_walk": self.rate_random_walk**2 * tau / 3.0,
            "ramp": self.ramp**2 * tau**2 / 2.0,
        }

    def deviation(self, time: ArrayLike) -> FloatArray:
        """Allan deviation of all parts together, (k,) s -> (k,), unit."""
        return np.asarray(np.sqrt(sum(self.parts(time).values())))

    def stands_out(self, term: str, time: ArrayLike) -> bool:
        """Whether a part was found for good: above four of its sigmas, and a tenth of the variance or more somewhere among the times."""
        sigma = self.sigma.get(term)
        if sigma is None or not getattr(self, term) > 4.0 * sigma:
            return False
        share = self.parts(time)[term] / self.deviation(time) ** 2
        return bool(share.max() > 0.1)


def allan_deviation(values: ArrayLike, interval: float, *, points_per_octave: int = 2) -> AllanCurve:
    """Overlapping Allan deviation of evenly spaced samples of a sensor at rest.

    sigma^2(tau) = 1/(2 tau^2 (n - 2m + 1)) sum (theta_(k+2m) - 2 theta_(k+m) + theta_k)^2, theta the running integral, tau = m dt.

    Parameters
    ----------
    values : (n,) array
        Means over (or samples at) equal intervals, any unit; n at least 16.
    interval : float
        Sampling interval, s.
    points_per_octave : int, optional
        Averaging times a doubling; the longest is a quarter of the log.

    Returns
    -------
    AllanCurve

    Raises
    ------
    ValueError
        Wrong shape, too few samples, an interval that is not positive.
    EstimationError
        A value that is not finite (a gap), or a log that never changes (a frozen or missing axis).

    Notes
    -----
    Gaps must not be closed up: cut the log there. The mean is taken off first, so that the running integral keeps its digits.
    A million samples take 0.05 s.

    References
    ----------
    IEEE Std 952-1997, annex C.

    Examples
    --------
    >>> curve = allan_deviation(np.random.default_rng(1).normal(size=4096), 0.01)
    >>> round(curve.deviation[0], 2)  # white noise of sigma 1
    np.float64(1.0)
    """
    x = np.asarray(values, dtype=np.float64)
    if x.ndim != 1:
        raise ValueError(f"values must have the shape (n,), not {x.shape}; take one axis at a time")
    if not (math.isfinite(interval) and interval > 0.0):
        raise ValueError(f"interval is {interval}; it must be positive")
    if len(x) < 16:
        raise ValueError(f"{len(x)} samples are too few for an Allan deviation; at least 16")
    bad = np.flatnonzero(~np.isfinite(x))
    if bad.size:
        raise EstimationError(f"sample {bad[0]} is not finite; cut the log at its gaps and take the longest piece")
    if np.ptp(x) == 0.0:
        raise EstimationError(f"all samples are {x[0]:g}: the axis is frozen or missing, it has no noise to measure")
    from railnav.inertial._kernels import allan_kernel

    octaves = math.log2(len(x) // 4)
    steps = np.round(2.0 ** np.arange(0.0, octaves + 1e-9, 1.0 / points_per_octave)).astype(np.int64)
    factors = np.unique(steps)
    integral = np.concatenate([[0.0], np.cumsum(x - x.mean())])
    variance = np.empty(len(factors))
    allan_kernel(integral, factors, variance)
    return AllanCurve(
        time=np.asarray(factors * interval, dtype=np.float64),
        deviation=np.sqrt(variance),
        relative_error=1.0 / np.sqrt(2.0 * (len(x) / factors - 1.0)),
        interval=interval,
        duration=len(x) * interval,
    )


def fit_allan(
    curve: AllanCurve, *, terms: tuple[str, ...] = ("random_walk", "bias_instability", "rate_random_walk")
) -> NoiseParameters:
    """Noise parameters of an Allan curve: a least-squares sum of non-negative parts, each point weighted by its own accuracy.

    Parameters
    ----------
    curve : AllanCurve
        From `allan_deviation`.
    terms : tuple of str, optional
        Parts to look for: any of `TERMS`. "gauss_markov" searches its correlation time too.

    Returns
    -------
    NoiseParameters

    Raises
    ------
    ValueError
        An unknown term.
    EstimationError
        Fewer points than parameters.

    Notes
    -----
    A slow part is only as well known as the log is long: with 1,000 correlation times its sigma is good to some 3 %, with ten to 30 %.
    Flicker and a Gauss-Markov part look alike around the floor; fit one of them.

    References
    ----------
    IEEE Std 952-1997, annex C; the Gauss-Markov part, C.1.4, eq. C.27.

    Examples
    --------
    >>> curve = allan_deviation(np.random.default_rng(1).normal(0.0, 0.5, 100_000), 0.01)
    >>> round(fit_allan(curve).random_walk, 3)  # 0.5 sqrt(0.01)
    0.05
    """
    unknown = [t for t in terms if t not in TERMS]
    if unknown:
        raise ValueError(f"unknown noise term {unknown[0]!r}; known are {', '.join(TERMS)}")
    tau = curve.time
    if len(tau) < len(terms) + 1 + ("gauss_markov" in terms):
        raise EstimationError(
            f"{len(tau)} points of the Allan curve cannot carry {len(terms)} noise terms; take a longer log"
        )
    variance = curve.deviation**2
    weight = 1.0 / (2.0 * curve.relative_error * variance)
    fixed = {
        "quantisation": 3.0 / tau**2,
        "random_walk": 1.0 / tau,
        "bias_instability": np.full_like(tau, 2.0 * math.log(2.0) / math.pi),
        "rate_random_walk": tau / 3.0,
        "ramp": tau**2 / 2.0,
    }

    def solve(correlation_time: float) -> tuple[float, FloatArray, FloatArray]:
        columns = [_markov(tau, correlation_time) if t == "gauss_markov" else fixed[t] for t in terms]
        A = np.stack(columns, axis=1) * weight[:, None]
        size = np.linalg.norm(A, axis=0)
        solution, residual = _non_negative(A / size, variance * weight)
        return residual, solution / size, A

    T = 0.0
    if "gauss_markov" in terms:
        grid = np.geomspace(2.0 * tau[0], 2.0 * tau[-1], 60)
        best = grid[int(np.argmin([solve(float(t))[0] for t in grid]))]
        step = grid[1] / grid[0]
        fine = np.geomspace(best / step, best * step, 41)
        T = float(fine[int(np.argmin([solve(float(t))[0] for t in fine]))])
    residual, square, A = solve(T)
    found = square > 0.0
    # neighbouring points share most of their data: they count as one an octave
    shared = max(1.0, (len(tau) - 1) / math.log2(tau[-1] / tau[0]))
    covariance = shared * np.linalg.pinv(A[:, found].T @ A[:, found])
    value = dict.fromkeys(TERMS, 0.0)
    sigma = dict.fromkeys(terms, math.nan)
    for k, c in zip(np.flatnonzero(found), np.diagonal(covariance), strict=True):
        value[terms[k]] = math.sqrt(square[k])
        sigma[terms[k]] = math.sqrt(c) / (2.0 * math.sqrt(square[k]))
    return NoiseParameters(
        **value,
        correlation_time=T if value["gauss_markov"] > 0.0 else 0.0,
        sigma={k: v for k, v in sigma.items() if not math.isnan(v)},
        misfit=residual / math.sqrt(len(tau)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class UnitNoise:
    """Noise of the six channels of an inertial unit at rest.

    Attributes
    ----------
    begin, end : float
        The part of the log that was used, s.
    interval : float
        Sampling interval, s.
    curves, fits : dict
        By channel: "gyro x" to "accelerometer z".
    """

    begin: float
    end: float
    interval: float
    curves: dict[str, AllanCurve]
    fits: dict[str, NoiseParameters]


def unit_noise(
    imu: ImuStream,
    *,
    between: tuple[float, float] | None = None,
    terms: tuple[str, ...] = ("random_walk", "bias_instability", "rate_random_walk"),
) -> UnitNoise:
    """Allan deviations and noise parameters of an inertial unit, over its longest rest.

    Parameters
    ----------
    imu : ImuStream
        Log.
    between : (float, float), optional
        Times instead of the longest rest, s.
    terms : tuple of str, optional
        See `fit_allan`.

    Returns
    -------
    UnitNoise

    Raises
    ------
    EstimationError
        The log never rests (with the evidence), is too short, has gaps or a frozen axis.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(0.0, [1e-3], (3000, 6)) - [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
    >>> found = unit_noise(ImuStream(np.arange(3000) * 0.01, noise[:, :3], noise[:, 3:]), terms=("random_walk",))
    >>> round(found.fits["gyro x"].random_walk, 5)  # 1e-3 sqrt(0.01)
    0.0001
    """
    from railnav.inertial.resting import find_stretches

    if between is not None:
        rows = slice(*np.searchsorted(imu.time, between, side="right").tolist())
    else:
        stretches, motion = find_stretches(imu.time, imu.gyro, imu.specific_force)
        rests = [one for one in stretches if not one.turning]
        if not rests:
            raise EstimationError(
                f"the log never rests: it turns by up to {math.degrees(motion.rate):.2f} deg/s and {motion.force:.2f} m/s^2 from piece to "
                "piece; noise is measured at rest"
            )
        best = max(rests, key=lambda one: one.duration)
        rows = slice(best.first, best.last)
    time = imu.time[rows]
    if len(time) < 64:
        raise EstimationError(f"{len(time)} samples are too few for an Allan deviation; record for longer")
    interval = float(np.median(np.diff(time)))
    wide = np.diff(time) > 1.5 * interval
    if wide.any():
        raise EstimationError(
            f"{int(wide.sum())} gaps, the first after {time[int(np.argmax(wide))]:.2f} s: an Allan deviation needs even samples; "
            "take a part without"
        )
    curves: dict[str, AllanCurve] = {}
    for what, x in (("gyro", imu.gyro[rows]), ("accelerometer", imu.specific_force[rows])):
        for axis in range(3):
            try:
                curves[f"{what} {'xyz'[axis]}"] = allan_deviation(x[:, axis], interval)
            except EstimationError as error:
                raise EstimationError(f"{what} {'xyz'[axis]}: {error}") from error
    fits = {name: fit_allan(curve, terms=terms) for name, curve in curves.items()}
    return UnitNoise(float(time[0]), float(time[-1]), interval, curves, fits)


def _markov(tau: FloatArray, T: float) -> FloatArray:
    """Allan variance of a Gauss-Markov process of unit variance and correlation time T."""
    x = tau / T
    # 2 T/tau (1 - T/(2 tau) (3 - 4 e^-x + e^-2x)), by its series where x is small
    closed = (2.0 * x - 3.0 + 4.0 * np.exp(-x) - np.exp(-2.0 * x)) / x**2
    return np.where(x < 1e-2, 2.0 * x / 3.0 - 0.5 * x**2, closed)


def _non_negative(A: FloatArray, b: FloatArray) -> tuple[FloatArray, float]:
    """Least squares with no negative unknown: solution and norm of the residual."""
    from scipy.optimize import nnls

    solution, residual = nnls(A, b)
    return np.asarray(solution), float(residual)
