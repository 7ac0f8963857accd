"""Noise of static records: averaging, wavelets and Kalman averaging, with what each can do and what it cannot.

A latitude or an alignment uses the mean of each channel only, and no filter knows the mean better than the mean does: filtering is for
values sample by sample. What filters change in a mean comes from the ends of the record and from how they are started.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError, RailnavError

FloatArray = NDArray[np.float64]
Denoising = Literal["mean", "wavelet", "kalman"]
Extension = Literal["periodic", "symmetric"]

_MODES = {"periodic": "periodization", "symmetric": "symmetric"}


@dataclass(frozen=True, slots=True, eq=False)
class Denoised:
    """A static record with less noise.

    Attributes
    ----------
    values : (n,) or (n, k) array
        Sample by sample, unit of the record.
    mean : float or (k,) array
        Of the record as it was: what latitude and alignment should use.
    sigma : float or (k,) array
        Standard deviation of the mean, from the scatter of twenty pieces, so that slow noise counts.
    settled : slice
        Samples free of the ends of the record (wavelet) or of the start of the filter (Kalman).
    """

    values: FloatArray
    mean: FloatArray
    sigma: FloatArray
    settled: slice


def denoise(
    record: ArrayLike,
    method: Denoising = "mean",
    *,
    level: int = 10,
    wavelet: str = "db4",
    extension: Extension = "periodic",
    gain: float = 0.01,
    start: ArrayLike | None = None,
) -> Denoised:
    """Take noise off a static record.

    mean: the constant. wavelet: the details of `level` levels are set to zero, white noise falls by sqrt(2^level). kalman: a random
    constant,
    x_(k+1) = x_k + w, z = x + v, with the steady gain K = `gain`: white noise falls to sqrt(K/(2 - K)).

    Parameters
    ----------
    record : (n,) or (n, k) array
        Evenly sampled channels at rest, any unit.
    method : {"mean", "wavelet", "kalman"}, optional
        How.
    level : int, optional
        Of the wavelet decomposition.
    wavelet : str, optional
        A name that PyWavelets knows.
    extension : {"periodic", "symmetric"}, optional
        Of the record beyond its ends: periodic keeps the mean (to rounding, if n is a multiple of 2^level), symmetric does not.
    gain : float, optional
        Steady gain K of the Kalman average; its process noise is q = K^2 r/(1 - K).
    start : float or (k,) array, optional
        State at which the Kalman average starts, with its steady variance; default: the first sample, with that sample's variance, as a
        filter
        must be that knows nothing.

    Returns
    -------
    Denoised

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, an unknown method or extension, a gain not between 0 and 1.
    EstimationError
        A record too short for the wavelet, or frozen.
    RailnavError
        PyWavelets is not installed.

    Notes
    -----
    Of 200 simulated records the latitude scatters by 0.598 degrees from the raw means, by 0.598 after the periodic wavelet, by 0.658
    after the
    symmetric one. The source's "almost twofold improvement" (0.455 to 0.292 degrees) is an effect of the ends within the noise of 0.67;
    its Kalman row is spoilt by a filter that was started with gravity on the wrong axis.

    References
    ----------
    `spec/inertial.md` A4.

    Examples
    --------
    >>> noisy = np.random.default_rng(1).normal(5.0, 1.0, 8192)
    >>> found = denoise(noisy, "wavelet")
    >>> round(float(found.values.std()), 2), bool(abs(found.values.mean() - noisy.mean()) < 1e-12)
    (0.03, True)
    """
    x = np.asarray(record, dtype=np.float64)
    if x.ndim not in (1, 2) or len(x) < 20:
        raise ValueError(f"a record must have the shape (n,) or (n, k), n at least 20, not {x.shape}")
    bad = np.flatnonzero(~np.isfinite(x.reshape(len(x), -1)).all(axis=1))
    if bad.size:
        raise ValueError(f"sample {bad[0]} is not finite; cut the record there")
    if method not in ("mean", "wavelet", "kalman"):
        raise ValueError(f"method is 'mean', 'wavelet' or 'kalman', not {method!r}")
    frozen = np.flatnonzero(np.ptp(x.reshape(len(x), -1), axis=0) == 0.0)
    if frozen.size:
        raise EstimationError(
            f"channel {frozen[0]} never changes: it is frozen or missing, there is no noise to take off"
        )
    mean = x.mean(axis=0)
    pieces = np.array([piece.mean(axis=0) for piece in np.array_split(x, 20)])
    sigma = pieces.std(axis=0, ddof=1) / math.sqrt(20.0)
    if method == "mean":
        return Denoised(np.broadcast_to(mean, x.shape).copy(), mean, sigma, slice(0, len(x)))
    if method == "wavelet":
        values, edge = _wavelet(x, wavelet, level, extension)
        settled = slice(edge, len(x) - edge) if len(x) > 2 * edge else slice(0, 0)
        return Denoised(values, mean, sigma, settled)
    if not 0.0 < gain < 1.0:
        raise ValueError(f"gain is {gain}; it lies between 0 and 1")
    return Denoised(_kalman(x, gain, start), mean, sigma, slice(min(len(x), round(5.0 / gain)), len(x)))


def _wavelet(x: FloatArray, wavelet: str, level: int, extension: str) -> tuple[FloatArray, int]:
    """Record without its details, and how far the ends reach into it."""
    try:
        import pywt
    except ImportError as error:
        raise RailnavError('wavelets need PyWavelets; install with: pip install "railnav[denoise]"') from error
    if extension not in _MODES:
        raise ValueError(f"extension is 'periodic' or 'symmetric', not {extension!r}")
    try:
        length = pywt.Wavelet(wavelet).dec_len
    except ValueError as error:
        raise ValueError(f"no wavelet {wavelet!r}; db1 to db38, sym2, coif1, ...") from error
    needed = (length - 1) * 2**level
    if level < 1 or len(x) < needed:
        raise EstimationError(
            f"{len(x)} samples are too few for {level} levels of {wavelet}: {needed} are needed; record for longer or take fewer levels"
        )
    bands = pywt.wavedec(x, wavelet, mode=_MODES[extension], level=level, axis=0)
    bands = [bands[0], *(np.zeros_like(band) for band in bands[1:])]
    out = pywt.waverec(bands, wavelet, mode=_MODES[extension], axis=0)[: len(x)]
    return np.asarray(out, dtype=np.float64), length * 2**level


def _kalman(x: FloatArray, gain: float, start: ArrayLike | None) -> FloatArray:
    """Kalman average: gains that fall to the steady one, then an exponential filter."""
    from scipy.signal import lfilter

    q = gain * gain / (1.0 - gain)
    out = np.empty_like(x)
    if start is None:
        state, variance, first = x[0].copy(), 1.0, 1
        out[0] = x[0]
    else:
        state, variance, first = np.broadcast_to(np.asarray(start, dtype=np.float64), x.shape[1:]).copy(), gain, 0
    k = first
    while k < len(x) and abs(variance - gain) > 1e-13:
        variance += q
        weight = variance / (variance + 1.0)
        state = state + weight * (x[k] - state)
        variance *= 1.0 - weight
        out[k] = state
        k += 1
    if k < len(x):
        initial = np.expand_dims((1.0 - gain) * state, 0)
        out[k:] = lfilter([gain], [1.0, gain - 1.0], x[k:], axis=0, zi=initial)[0]
    return out
