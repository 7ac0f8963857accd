"""Filters along the track: wavelength bands without phase shift, resampling to a uniform step, and odd samples out.

The band-pass is stated, not implied: its amplitude is that of a Butterworth high-pass and a Butterworth low-pass of order 4 in
cascade, its phase is zero. It is applied as a product in the frequency domain, so that what stands here is what is done.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: Order of each edge of a band: 24 dB an octave.
ORDER = 4
#: sigma of a third difference of white noise over sigma of the noise, sqrt(1 + 9 + 9 + 1).
_THIRD_DIFFERENCE = math.sqrt(20.0)
#: sigma of a normal distribution over its median absolute deviation.
_MAD = 1.4826


@dataclass(frozen=True, slots=True)
class Band:
    """A band of wavelengths, m; -3 dB at both edges.

    Attributes
    ----------
    name : str
        "D1", "D2" or "D3" (EN 13848-1), or your own.
    lower, upper : float
        Shortest and longest wavelength, m.
    """

    name: str
    lower: float
    upper: float

    def __post_init__(self) -> None:
        if not 0.0 < self.lower < self.upper < math.inf:
            raise TrackError(f"band {self.name!r} from {self.lower} to {self.upper} m is none; 0 < lower < upper")

    @property
    def settling(self) -> float:
        """Length beside an end or a gap left empty, m: one and three quarters of the longest wave, and the error is below 1 %."""
        return 1.75 * self.upper


#: Wavelengths of EN 13848-1; the longest band of alignment reaches further than that of longitudinal level. D0, short waves of
#: longitudinal level, is 1 to 5 m in SignalProcessingTools, which cites EN 13848-1 (read there, not in the standard).
D0 = Band("D0", 1.0, 5.0)
D1, D2 = Band("D1", 3.0, 25.0), Band("D2", 25.0, 70.0)
D3_LEVEL, D3_ALIGNMENT = Band("D3", 70.0, 150.0), Band("D3", 70.0, 200.0)


def gain(wavelength: ArrayLike, band: Band) -> FloatArray:
    """Amplitude that a band-pass leaves of a wave: the stated filter.

    |H| = [1 + (f1 / f)^8]^(-1/2) [1 + (f / f2)^8]^(-1/2), f1 = 1 / upper, f2 = 1 / lower: Butterworth of order 4 at each edge, -3 dB
    there, 24 dB an octave beyond, phase zero.

    Parameters
    ----------
    wavelength : array
        m, positive.
    band : Band

    Returns
    -------
    array
        Of the same shape, between 0 and 1.

    References
    ----------
    docs/theory/geometry.md (1). EN 13848-1 asks for a band-pass of 24 dB an octave with -3 dB at the edges (recalled, not read);
    two passes of an ordinary filter (filtfilt) would have -6 dB there.

    Examples
    --------
    >>> gain([10.0, 25.0, 50.0], D1).round(4)
    array([0.9996, 0.7071, 0.0624])
    """
    return _gain(1.0 / np.asarray(wavelength, float), band)


def _gain(frequency: FloatArray, band: Band) -> FloatArray:
    """Amplitude at spatial frequencies, 1/m, zero included."""
    with np.errstate(divide="ignore"):
        high = 1.0 / np.sqrt(1.0 + (1.0 / (np.abs(frequency) * band.upper)) ** (2 * ORDER))
    low = 1.0 / np.sqrt(1.0 + (np.abs(frequency) * band.lower) ** (2 * ORDER))
    return np.asarray(high * low)


def band_pass(values: ArrayLike, step: float, band: Band, *, integrate: int = 0) -> FloatArray:
    """Filter a uniformly sampled channel to a band of wavelengths, without phase shift.

    Parameters
    ----------
    values : (n,) array
        Samples; NaN parts the channel into stretches that are filtered by themselves.
    step : float
        Distance between samples, m.
    band : Band
    integrate : int
        0: the values themselves; 1: their integral along the track (of a slope: a displacement); 2: the double integral (of a
        curvature: a displacement). The integral is taken in the frequency domain within the band, where it exists.

    Returns
    -------
    (n,) array
        NaN within `band.settling` of an end or a gap, where the answer would hang on what lies beyond.

    Raises
    ------
    TrackError
        A step too long for the band: at least three samples a shortest wavelength are needed.

    References
    ----------
    docs/theory/geometry.md (1), (2).

    Examples
    --------
    >>> s = np.arange(0.0, 200.0, 0.25)
    >>> out = band_pass(3e-3 * np.sin(2 * np.pi * s / 10.0), 0.25, D1)
    >>> float(np.nanmax(out).round(4))
    0.003
    """
    x = np.asarray(values, float)
    if x.ndim != 1:
        raise TrackError(f"a channel is one row of samples, not an array of shape {x.shape}")
    if integrate not in (0, 1, 2):
        raise TrackError(f"integrate is {integrate}; 0, 1 or 2")
    if not 0.0 < step <= band.lower / 3.0:
        raise TrackError(
            f"a step of {step} m is too long for {band.name} ({band.lower:g} to {band.upper:g} m); it takes {band.lower / 3.0:g} m"
        )
    out = np.full(len(x), np.nan)
    margin = round(band.settling / step)
    for a, b in stretches(np.isfinite(x)):
        if b - a > 2 * margin:
            out[a + margin : b - margin] = _filtered(x[a:b], step, band, integrate)[margin : b - a - margin]
    return out


def _filtered(x: FloatArray, step: float, band: Band, integrate: int) -> FloatArray:
    """Filter one stretch: extended at both ends, multiplied in the frequency domain."""
    from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

    n = len(x)
    pad = min(n - 1, math.ceil(2.0 * band.upper / step))
    trend = np.linspace(x[0], x[-1], n) if integrate == 0 else np.full(n, x.mean())
    y = x - trend  # a straight line has no wavelength; its filtered value is zero
    if integrate == 1:  # an even slope belongs to an odd displacement
        left, right = y[pad:0:-1], y[-2 : -pad - 2 : -1]
    elif integrate == 2:  # the curvature of an odd displacement is odd about zero
        left, right = -y[pad:0:-1], -y[-2 : -pad - 2 : -1]
    else:
        left, right = 2.0 * y[0] - y[pad:0:-1], 2.0 * y[-1] - y[-2 : -pad - 2 : -1]
    wide = np.concatenate([left, y, right])
    size = next_fast_len(len(wide) + pad, real=True)
    frequency = rfftfreq(size, step)
    response = _gain(frequency, band).astype(complex)
    if integrate:
        omega = 2.0 * np.pi * frequency[1:]
        response[1:] /= (1j * omega) ** integrate
        response[0] = 0.0
    return np.asarray(irfft(rfft(wide, size) * response, size)[pad : pad + n])


def low_pass(values: ArrayLike, step: float, wavelength: float) -> FloatArray:
    """Smooth a uniformly sampled channel: Gaussian weights that halve a wave of the given length, no phase shift.

    Parameters
    ----------
    values : (n,) array
        NaN is left out of the mean and stays NaN where less than a quarter of the weight is known.
    step, wavelength : float
        m.

    Returns
    -------
    (n,) array
    """
    x = np.asarray(values, float)
    sigma = math.sqrt(2.0 * math.log(2.0)) * wavelength / (2.0 * math.pi) / step
    known = np.isfinite(x)
    mass = _gaussian(known.astype(float), sigma)
    total = _gaussian(np.where(known, x, 0.0), sigma)
    return np.where(mass > 0.25, total / np.maximum(mass, 1e-12), np.nan)


def _gaussian(values: FloatArray, sigma: float) -> FloatArray:
    """Gaussian weights out to four sigma, zero beyond the ends."""
    from scipy.signal import oaconvolve

    reach = max(1, math.ceil(4.0 * sigma))
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.asarray(oaconvolve(values, weight / weight.sum(), mode="full")[reach : reach + len(values)])


def stretches(there: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and one past the last index of each stretch of True.

    Examples
    --------
    >>> stretches(np.array([True, True, False, True]))
    [(0, 2), (3, 4)]
    """
    edge = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edge[::2], edge[1::2], strict=True)]


def resample(distance: ArrayLike, values: ArrayLike, grid: ArrayLike, *, gap: float) -> FloatArray:
    """Bring samples at uneven distances onto a uniform grid.

    Samples that fall into one cell of a fine grid are averaged, a cubic spline runs through the cells, and what is finer than the
    grid can hold is smoothed away, so that it does not fold into longer waves.

    Parameters
    ----------
    distance : (m,) array
        Where each sample was taken, m; any order, repeats allowed.
    values : (m,) array
        NaN samples are left out.
    grid : (n,) array
        Uniform distances, m.
    gap : float
        Samples further apart than this leave NaN between them, m.

    Returns
    -------
    (n,) array
        NaN in gaps and beyond the samples.

    Examples
    --------
    >>> s = np.array([0.0, 0.4, 0.9, 1.6, 2.0, 2.4])
    >>> resample(s, 2 * s, np.arange(0.0, 2.1, 0.5), gap=1.0).round(6)
    array([0., 1., 2., 3., 4.])
    """
    from scipy.interpolate import CubicSpline

    d, x, g = np.asarray(distance, float), np.asarray(values, float), np.asarray(grid, float)
    out = np.full(len(g), np.nan)
    known = np.isfinite(d) & np.isfinite(x)
    d, x = d[known], x[known]
    if len(d) < 2 or len(g) < 2:
        return out
    order = np.argsort(d, kind="stable")
    d, x = d[order], x[order]
    step = float(g[1] - g[0])
    spacing = float(np.median(np.diff(d)))
    parts = int(np.clip(math.ceil(step / max(spacing, 1e-9)), 1, 16))
    fine = step / parts
    cell = np.floor((d - g[0]) / fine + 0.5).astype(np.int64)
    first = np.flatnonzero(np.diff(cell, prepend=cell[0] - 1))
    count = np.diff(np.append(first, len(d)))
    d, x = np.add.reduceat(d, first) / count, np.add.reduceat(x, first) / count
    if len(d) < 4:
        return np.where((g >= d[0]) & (g <= d[-1]), np.interp(g, d, x), np.nan) if len(d) > 1 else out
    wide = np.flatnonzero(np.diff(d) > gap)
    for a, b in zip(np.append(0, wide + 1), np.append(wide + 1, len(d)), strict=True):
        i, j = np.searchsorted(g, [d[a] - 0.5 * step, d[b - 1] + 0.5 * step])
        if b - a < 4 or j - i < 1:
            continue
        spline = CubicSpline(d[a:b], x[a:b])
        if parts == 1:
            out[i:j] = spline(np.clip(g[i:j], d[a], d[b - 1]))
            continue
        dense = g[i] + fine * np.arange(-(parts - 1), (j - i - 1) * parts + parts)
        out[i:j] = _decimated(spline(np.clip(dense, d[a], d[b - 1])), parts, j - i)
    return out


def _decimated(dense: FloatArray, parts: int, count: int) -> FloatArray:
    """Every `parts`-th value of a fine row after a zero-phase low-pass at two grid steps."""
    from scipy.signal import butter, sosfiltfilt

    if len(dense) > 60:
        dense = sosfiltfilt(butter(4, 0.9 / parts, output="sos"), dense)
    return np.asarray(dense[parts - 1 :: parts][:count])


def spikes(values: ArrayLike, *, reach: int = 4, least: float = 0.0, factor: float = 8.0) -> BoolArray:
    """Find odd samples out: further from the median of their neighbours than noise explains (Hampel).

    Parameters
    ----------
    values : (n,) array
        In the order taken; NaN is never a spike.
    reach : int
        Neighbours on each side.
    least : float
        A distance from the median below this is never a spike.
    factor : float
        Robust standard deviations (1.4826 times the median absolute deviation of the neighbourhood, or of the whole row if that is
        greater) that are.

    Returns
    -------
    (n,) bool array

    Examples
    --------
    >>> spikes([1.0, 1.1, 1.0, 9.0, 1.1, 1.0, 1.1], reach=2, least=0.5).nonzero()[0]
    array([3])
    """
    from scipy.ndimage import median_filter

    x = np.asarray(values, float)
    known = np.isfinite(x)
    found = np.zeros(len(x), bool)
    if known.sum() < 2 * reach + 1:
        return found
    y = x[known]
    residual = np.abs(y - median_filter(y, 2 * reach + 1, mode="nearest"))
    scale = np.maximum(median_filter(residual, 2 * reach + 1, mode="nearest"), np.median(residual)) * _MAD
    found[known] = (residual > factor * scale) & (residual > least)
    return found


def noise_floor(values: ArrayLike) -> float:
    """Sigma of the white noise of a row of samples, at most: robust spread of its third differences.

    What the track itself does over three samples counts as noise here, so that the figure errs to the large side. NaN for fewer
    than eight samples.

    Examples
    --------
    >>> round(noise_floor(np.random.default_rng(1).normal(0.0, 2.0, 4000)), 1)
    2.0
    """
    x = np.asarray(values, float)
    third = np.diff(x[np.isfinite(x)], 3)
    if len(third) < 5:
        return math.nan
    return float(_MAD * np.median(np.abs(third)) / _THIRD_DIFFERENCE)


def band_noise(sigma: float, spacing: float, band: Band, *, integrate: int = 0) -> float:
    """Sigma that white noise of the samples leaves in a band.

    White noise of sigma at samples `spacing` apart has the spectral density 2 sigma^2 spacing (one-sided, per 1/m); integrating it k
    times divides by (2 pi f)^(2k), and the ideal band takes it from 1/upper to 1/lower.

    Parameters
    ----------
    sigma : float
        Of each sample.
    spacing : float
        Distance between samples, m.
    band : Band
    integrate : int
        0, 1 or 2, as in `band_pass`.

    Returns
    -------
    float

    References
    ----------
    docs/theory/geometry.md (3).

    Examples
    --------
    >>> round(band_noise(1.0, 0.25, D1), 4)
    0.383
    """
    low, high = 1.0 / band.upper, 1.0 / band.lower
    power = 1 - 2 * integrate
    integral = (high**power - low**power) / power / (2.0 * math.pi) ** (2 * integrate)
    return float(sigma * math.sqrt(2.0 * spacing * integral))
