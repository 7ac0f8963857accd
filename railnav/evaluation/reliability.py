"""Whether a stated track probability is true: of the rows that say 97 %, 97 % ought to be on the right track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import InputError
from railnav.evaluation.consistency import effective_samples

FloatArray = NDArray[np.float64]

#: Bounds of the classes of stated probability. They crowd towards 1: there a navigator makes its promises.
EDGES = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999, 1.0)


@dataclass(frozen=True, slots=True)
class ReliabilityClass:
    """Rows whose stated probability lies in one class.

    Attributes
    ----------
    low, high : float
        Bounds of the class: low <= stated < high, the last one closed.
    rows : int
    effective : float
        Effective number of independent rows: one decision, repeated for a minute, is one.
    stated : float
        Mean stated probability.
    right : float
        Share of rows on the right track.
    lower, upper : float
        Bounds of the true share at `Reliability.confidence` (Clopper-Pearson with the effective number).
    """

    low: float
    high: float
    rows: int
    effective: float
    stated: float
    right: float
    lower: float
    upper: float

    @property
    def honest(self) -> bool:
        """Whether the stated probability lies inside the bounds of the true share, or below them (modest is no fault)."""
        return self.stated <= self.upper


@dataclass(frozen=True, slots=True)
class Reliability:
    """Reliability diagram of the track probability.

    Attributes
    ----------
    classes : tuple of ReliabilityClass
        Those that hold rows, in growing order.
    rows : int
    brier : float or None
        Mean of (stated - [right])^2: 0 is certain and right.
    confidence : float
    """

    classes: tuple[ReliabilityClass, ...]
    rows: int
    brier: float | None
    confidence: float

    @property
    def honest(self) -> bool | None:
        """Whether no class states more than its rows allow; None without rows."""
        return all(c.honest for c in self.classes) if self.classes else None


def reliability(
    stated: ArrayLike, right: ArrayLike, *, edges: Sequence[float] = EDGES, confidence: float = 0.95
) -> Reliability:
    """Sort rows of one run by their stated probability and count how many are right.

    Parameters
    ----------
    stated : (m,) array
        Probability of the track named, row by row in time; rows with NaN are passed over.
    right : (m,) bool array
        Whether that track is the true one.
    edges : sequence of float
        Growing bounds of the classes, from 0 to 1.
    confidence : float
        Of the bounds of the share of right rows.

    Returns
    -------
    Reliability

    Raises
    ------
    InputError
        Arrays of different lengths, or probabilities outside 0 to 1.

    Notes
    -----
    Rows one epoch apart repeat the same decision. The effective number of independent rows is estimated from the autocorrelation
    of (right - stated) about zero, and shared among the classes by their rows, at least one to each.

    References
    ----------
    .. [1] A. H. Murphy, R. L. Winkler, "Reliability of subjective probability forecasts of precipitation and temperature",
       Applied Statistics 26(1), 1977.

    Examples
    --------
    >>> [(c.rows, round(c.stated, 2), c.right) for c in reliability([0.6, 0.6, 1.0, 1.0], [True, False, True, True]).classes]
    [(2, 0.6, 0.5), (2, 1.0, 1.0)]
    """
    p, hit = np.asarray(stated, float), np.asarray(right, bool)
    if p.shape != hit.shape or p.ndim != 1:
        raise InputError(f"{p.shape} stated probabilities do not match {hit.shape} verdicts: give one of each a row")
    known = np.isfinite(p)
    p, hit = p[known], hit[known]
    if len(p) and (p.min() < 0.0 or p.max() > 1.0 + 1e-9):
        raise InputError(f"a stated probability of {p.min():g} to {p.max():g} is outside 0 to 1")
    if not len(p):
        return Reliability((), 0, None, confidence)
    residual = hit - p
    share = effective_samples(residual)[0] / len(p)
    classes = []
    for low, high in pairwise(edges):
        inside = (p >= low) & ((p < high) if high < edges[-1] else (p <= high + 1e-9))
        rows = int(inside.sum())
        if rows:
            classes.append(
                _class(
                    low,
                    high,
                    rows,
                    max(1.0, rows * share),
                    float(p[inside].mean()),
                    float(hit[inside].mean()),
                    confidence,
                )
            )
    return Reliability(tuple(classes), len(p), float((residual**2).mean()), confidence)


def pooled_reliability(parts: Sequence[Reliability]) -> Reliability:
    """Judge the track probabilities of several independent runs together.

    Parameters
    ----------
    parts : sequence of Reliability
        With the same classes and one confidence.

    Returns
    -------
    Reliability

    Examples
    --------
    >>> one = reliability([0.6, 0.6], [True, False])
    >>> pooled_reliability([one, one]).classes[0].rows
    4
    """
    confidence = parts[0].confidence if parts else 0.95
    rows = sum(part.rows for part in parts)
    if not rows:
        return Reliability((), 0, None, confidence)
    by_bounds: dict[tuple[float, float], list[ReliabilityClass]] = {}
    for part in parts:
        for c in part.classes:
            by_bounds.setdefault((c.low, c.high), []).append(c)
    classes = []
    for (low, high), members in sorted(by_bounds.items()):
        count = sum(c.rows for c in members)
        stated = sum(c.rows * c.stated for c in members) / count
        right = sum(c.rows * c.right for c in members) / count
        classes.append(_class(low, high, count, sum(c.effective for c in members), stated, right, confidence))
    brier = sum(part.rows * part.brier for part in parts if part.brier is not None) / rows
    return Reliability(tuple(classes), rows, brier, confidence)


def _class(
    low: float, high: float, rows: int, effective: float, stated: float, right: float, confidence: float
) -> ReliabilityClass:
    lower, upper = binomial_bounds(right * effective, effective, confidence=confidence)
    return ReliabilityClass(low, high, rows, effective, stated, right, lower, upper)


def binomial_bounds(successes: float, trials: float, *, confidence: float = 0.95) -> tuple[float, float]:
    """Bounds of a probability from the share of successes (Clopper-Pearson; the numbers may be effective ones, not whole).

    Parameters
    ----------
    successes, trials : float
        0 <= successes <= trials.
    confidence : float
        Of the two-sided interval.

    Returns
    -------
    lower, upper : float

    Examples
    --------
    >>> [round(b, 4) for b in binomial_bounds(0, 100)]
    [0.0, 0.0362]
    """
    from scipy.stats import beta

    if trials <= 0.0:
        return 0.0, 1.0
    tail, failures = 0.5 * (1.0 - confidence), trials - successes
    lower = 0.0 if successes <= 1e-12 else float(beta.ppf(tail, successes, failures + 1.0))
    upper = 1.0 if failures <= 1e-12 else float(beta.ppf(1.0 - tail, successes + 1.0, failures))
    return lower, upper
