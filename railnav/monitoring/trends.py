"""Trends: how fast track gets worse, from runs of several dates on one section, and whether that is more than chance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.monitoring.channels import Geometry
from railnav.monitoring.quality import SEGMENT, deviations

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: A month, s: a twelfth of 365.25 days.
MONTH = 365.25 * 86400.0 / 12.0
#: Share of false findings among those called significant (Benjamini and Hochberg).
FALSE_DISCOVERY = 0.05
#: Dates nearer than this are one date, months.
SAME_DATE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Growth:
    """Growth of many values over several dates.

    Attributes
    ----------
    rate : (n,) array
        Per month; NaN where fewer than two dates are known.
    sigma : (n,) array
        Standard deviation of the rate.
    probability : (n,) array
        Two-sided probability of a rate this large by chance.
    significant : (n,) bool array
        Where it is significant with at most 5 % false findings over all n.
    noise : float
        Standard deviation of one value, common to all.
    freedom : float
        Degrees of freedom of `noise`.
    """

    rate: FloatArray
    sigma: FloatArray
    probability: FloatArray
    significant: BoolArray
    noise: float
    freedom: float


@dataclass(frozen=True, slots=True, eq=False)
class Trend:
    """Growth of the standard deviation of one channel over the segments of a section.

    Attributes
    ----------
    channel, title : str
    start : (n,) array
        Distance at which each segment begins, m; the segments are `SEGMENT` long.
    months : (d,) array
        Dates of the runs, months since the first.
    values : (d, n) array
        Standard deviations, m.
    growth : Growth
        Metres per month.
    """

    channel: str
    title: str
    start: FloatArray
    months: FloatArray
    values: FloatArray
    growth: Growth


def growth(months: ArrayLike, values: ArrayLike) -> Growth:
    """Fit a straight line in time to each of many values.

    The noise of one value is taken as common to all of them. With three dates or more it is the pooled residual; with two it is the robust
    spread of the changes about their median, so that a change common to all is kept as growth but what single values do must stand
    out among them.

    Parameters
    ----------
    months : (d,) array
        Dates.
    values : (d, n) array
        NaN where not known.

    Returns
    -------
    Growth

    Raises
    ------
    EstimationError
        Fewer than two different dates.

    References
    ----------
    docs/theory/geometry.md (10); Benjamini and Hochberg, J. R. Stat. Soc. B 57 (1995).

    Examples
    --------
    >>> found = growth([0.0, 1.0, 2.0], [[1.0, 1.0], [1.5, 1.01], [2.0, 0.99]])
    >>> found.rate.round(3), found.significant
    (array([ 0.5  , -0.005]), array([ True, False]))
    """
    from scipy.stats import t

    time, x = np.asarray(months, float), np.asarray(values, float)
    if x.ndim != 2 or x.shape[0] != len(time):
        raise EstimationError(f"{x.shape} values do not go with {len(time)} dates")
    if len(time) < 2 or np.ptp(time) < SAME_DATE:
        raise EstimationError("growth takes runs of at least two dates, more than a day apart")
    known = np.isfinite(x)
    n = known.sum(axis=0)
    safe = np.maximum(n, 1)
    filled = np.where(known, x, 0.0)
    tau = np.where(known, time[:, None], 0.0)
    centred = np.where(known, time[:, None] - tau.sum(axis=0) / safe, 0.0)
    spread = (centred**2).sum(axis=0)
    usable = (n >= 2) & (spread > 0.5 * SAME_DATE**2)
    rate = np.where(usable, (centred * filled).sum(axis=0) / np.where(usable, spread, 1.0), np.nan)
    mean = filled.sum(axis=0) / safe
    residual = np.where(known, x - mean - centred * np.where(usable, rate, 0.0), 0.0)
    freedom = float(np.maximum(n - 2, 0)[usable].sum())
    if freedom > 0:
        noise = math.sqrt(float((residual[:, usable] ** 2).sum()) / freedom)
        sigma = np.where(usable, noise / np.sqrt(np.where(usable, spread, 1.0)), np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):
            probability = 2.0 * t.sf(np.abs(rate) / sigma, freedom)
    else:
        typical = float(np.nanmedian(rate)) if usable.any() else math.nan
        per_month = 1.4826 * float(np.nanmedian(np.abs(rate - typical))) if usable.sum() >= 8 else math.nan
        sigma = np.where(usable, per_month, np.nan)
        noise = per_month * math.sqrt(float(np.median(spread[usable]))) if usable.any() else math.nan
        with np.errstate(invalid="ignore", divide="ignore"):
            # a median absolute deviation knows the spread as well as 0.37 times as many values in a standard deviation
            probability = 2.0 * t.sf(np.abs(rate) / sigma, 0.37 * float(usable.sum()))
    probability = np.where(np.isfinite(rate) & (np.nan_to_num(sigma) > 0.0), probability, np.nan)
    return Growth(rate, sigma, probability, false_discoveries(probability, FALSE_DISCOVERY), noise, freedom)


def false_discoveries(probability: FloatArray, share: float) -> BoolArray:
    """Which of many probabilities are significant with at most this share of false findings (Benjamini and Hochberg).

    Examples
    --------
    >>> false_discoveries(np.array([0.001, 0.02, 0.5, np.nan]), 0.05)
    array([ True,  True, False, False])
    """
    p = np.where(np.isfinite(probability), probability, 1.0)
    order = np.argsort(p)
    count = int(np.isfinite(probability).sum())
    passed = np.flatnonzero(p[order] <= share * (np.arange(len(p)) + 1) / max(count, 1))
    out = np.zeros(len(p), bool)
    if len(passed) and count:
        out[order[: passed[-1] + 1]] = True
    return out & np.isfinite(probability)


def trends(geometries: Sequence[Geometry]) -> list[Trend]:
    """Growth of the standard deviation over 200 m of every banded channel that at least two dates have by the same kind of sensor.

    Different sensors add different noise to a standard deviation, which would show as growth: of several kinds the one with the most
    runs counts, the latest of equals. What is significant is so among all segments of all channels, so that many channels do not make many
    findings.

    Parameters
    ----------
    geometries : sequence of Geometry
        Runs overlaid on one section and grid.

    Returns
    -------
    list of Trend
        Empty with a single date.
    """
    if len(geometries) < 2:
        return []
    start = [geometry.recording.run.start for geometry in geometries]
    months = np.array([(moment - min(start)).total_seconds() / MONTH for moment in start])
    found = []
    keys = list(
        dict.fromkeys(key for g in geometries for key, channel in g.channels.items() if channel.band is not None)
    )
    for key in keys:
        having = _alike(geometries, key)
        if len(having) < 2 or np.ptp(months[having]) < SAME_DATE:
            continue
        count = round(SEGMENT / geometries[0].recording.step)
        values = np.array([deviations(geometries[i].channels[key].values, count) for i in having])
        if not (np.isfinite(values).sum(axis=0) >= 2).any():
            continue
        title = geometries[having[0]].channels[key].title
        begin = SEGMENT * np.arange(values.shape[1], dtype=np.float64)
        found.append(Trend(key, title, begin, months[having], values, growth(months[having], values)))
    return _among_all(found)


def _among_all(found: Sequence[Trend]) -> list[Trend]:
    """The same trends, with what is significant told over all channels together."""
    if not found:
        return []
    told = false_discoveries(np.concatenate([trend.growth.probability for trend in found]), FALSE_DISCOVERY)
    parts = np.split(told, np.cumsum([len(trend.start) for trend in found])[:-1])
    return [
        replace(trend, growth=replace(trend.growth, significant=part)) for trend, part in zip(found, parts, strict=True)
    ]


def _alike(geometries: Sequence[Geometry], key: str) -> list[int]:
    """Runs that give a channel by the same kind of sensor."""
    kinds: dict[str, list[int]] = {}
    for i, geometry in enumerate(geometries):
        if key in geometry.channels:
            kinds.setdefault(geometry.channels[key].source, []).append(i)
    return max(
        kinds.values(), key=lambda rows: (len(rows), max(geometries[i].recording.run.start for i in rows)), default=[]
    )
