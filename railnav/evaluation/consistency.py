"""Does the filter know how wrong it is: normalised errors, their bounds, and how often the truth lies inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

#: Share of a normal distribution within 1, 2 and 3 sigma.
NOMINAL_COVERAGE = (0.682689492137086, 0.954499736103642, 0.997300203936740)


@dataclass(frozen=True, slots=True)
class Consistency:
    """Normalised error squared along the track (NEES, one degree of freedom), and coverage.

    Attributes
    ----------
    count : int
        Epochs used: on the right track, with a sigma.
    nees : float or None
        Mean of (error / sigma)^2; 1 when the filter is honest.
    lower, upper : float or None
        Two-sided bounds of that mean at `confidence` for an honest filter, chi-square with the effective number of samples.
    effective : float or None
        Effective number of independent samples: errors are coloured, and one after another says little new.
    correlation_time : float or None
        Time over which normalised errors repeat themselves, s: the sum of their autocorrelation times the sampling interval.
    confidence : float
    coverage : tuple of float or None
        Share of epochs with |error| within 1, 2 and 3 sigma; nominal `NOMINAL_COVERAGE`.
    """

    count: int
    nees: float | None
    lower: float | None
    upper: float | None
    effective: float | None
    correlation_time: float | None
    confidence: float
    coverage: tuple[float, float, float] | None

    @property
    def inside(self) -> bool | None:
        """Whether the mean lies inside its bounds; None without epochs."""
        if self.nees is None or self.lower is None or self.upper is None:
            return None
        return self.lower <= self.nees <= self.upper


def autocorrelation(values: ArrayLike) -> FloatArray:
    """Autocorrelation about zero, not about the mean: a constant error is one sample, however often it is repeated.

    Parameters
    ----------
    values : (n,) array

    Returns
    -------
    (n,) array
        1 at lag 0; zeros when all values are zero.

    Examples
    --------
    >>> autocorrelation([1.0, -1.0, 1.0, -1.0]).round(3).tolist()
    [1.0, -0.75, 0.5, -0.25]
    """
    x = np.asarray(values, float)
    size = 1 << (2 * len(x) - 1).bit_length()
    spectrum = np.fft.rfft(x, size)
    product = np.fft.irfft(spectrum * np.conj(spectrum), size)[: len(x)]
    return product / product[0] if product[0] > 0.0 else np.zeros(len(x))


def effective_samples(values: ArrayLike) -> tuple[float, float]:
    """Effective number of samples in the mean square of a coloured sequence, and its correlation length in samples.

    For a normal sequence with autocorrelation r_k the variance of the mean square is 2 s^4 / n * (1 + 2 sum r_k^2), so that
    n / (1 + 2 sum r_k^2) independent samples would scatter as much. The sums end at the first lag whose correlation is not
    positive.

    Parameters
    ----------
    values : (n,) array

    Returns
    -------
    effective : float
        Between 1 and n.
    length : float
        1 + 2 sum r_k, samples.

    Notes
    -----
    Rows are taken as evenly spaced; gaps shorten the correlation found. For a first-order Gauss-Markov sequence with
    phi = exp(-1 / t) the answer tends to n / t for large t.

    Examples
    --------
    >>> effective_samples([1.0, 1.0, 1.0, 1.0])[0] < 2.0
    True
    """
    r = autocorrelation(values)
    beyond = np.flatnonzero(r[1:] <= 0.0)
    stop = int(beyond[0]) + 1 if len(beyond) else len(r)
    n = len(r)
    return float(max(1.0, n / (1.0 + 2.0 * (r[1:stop] ** 2).sum()))), float(1.0 + 2.0 * r[1:stop].sum())


def consistency(error: FloatArray, sigma: FloatArray, time: FloatArray, *, confidence: float = 0.95) -> Consistency:
    """Judge errors by the sigmas that came with them.

    Parameters
    ----------
    error, sigma : (n,) array
        m; sigma positive.
    time : (n,) array
        s, increasing.
    confidence : float
        Of the two-sided bounds.

    Returns
    -------
    Consistency
        With None for what no epoch can tell.

    Examples
    --------
    >>> consistency(np.array([1.0, -2.0]), np.array([1.0, 1.0]), np.array([0.0, 1.0])).nees
    2.5
    """
    if len(error) == 0:
        return Consistency(0, None, None, None, None, None, confidence, None)
    from scipy.stats import chi2

    z = error / sigma
    effective, length = effective_samples(z)
    tail = 0.5 * (1.0 - confidence)
    spacing = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    size = np.abs(z)
    return Consistency(
        count=len(z),
        nees=float((z * z).mean()),
        lower=float(chi2.ppf(tail, effective) / effective),
        upper=float(chi2.ppf(1.0 - tail, effective) / effective),
        effective=effective,
        correlation_time=length * spacing,
        confidence=confidence,
        coverage=(float((size <= 1.0).mean()), float((size <= 2.0).mean()), float((size <= 3.0).mean())),
    )


def pooled(parts: Sequence[Consistency]) -> Consistency:
    """Judge several independent runs together: one run with slow errors can hardly be told from an honest one, thirty can.

    Means are weighted by the epochs of each run (weighting by effective samples would favour runs that happened to wander little);
    the bounds come from 1 / sum(w^2 / effective) samples, w the weights.

    Parameters
    ----------
    parts : sequence of Consistency
        Of independent runs, at one confidence; those without epochs are passed over.

    Returns
    -------
    Consistency
        The correlation time is the weighted mean.

    Examples
    --------
    >>> one = consistency(np.array([1.0, -1.0]), np.ones(2), np.array([0.0, 1.0]))
    >>> pooled([one, one]).effective / one.effective
    2.0
    """
    from scipy.stats import chi2

    known = [p for p in parts if p.effective is not None]
    confidence = parts[0].confidence if parts else 0.95
    if not known:
        return Consistency(0, None, None, None, None, None, confidence, None)
    count, effective = np.array([(p.count, p.effective) for p in known], float).T
    weight = count / count.sum()
    total = float(1.0 / (weight**2 / effective).sum())
    tail = 0.5 * (1.0 - confidence)

    def mean(values: Sequence[float | None]) -> float:
        return float((np.array(values, float) * weight).sum())

    shares = [p.coverage for p in known if p.coverage is not None]
    return Consistency(
        count=sum(p.count for p in known),
        nees=mean([p.nees for p in known]),
        lower=float(chi2.ppf(tail, total) / total),
        upper=float(chi2.ppf(1.0 - tail, total) / total),
        effective=total,
        correlation_time=mean([p.correlation_time for p in known]),
        confidence=confidence,
        coverage=(mean([c[0] for c in shares]), mean([c[1] for c in shares]), mean([c[2] for c in shares])),
    )
