"""Overlay: a run shifted along the track until its channels lie on those of a reference run, to the decimetre."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.channels import Geometry
from railnav.monitoring.section import Passage

FloatArray = NDArray[np.float64]

#: Length over which one shift is found, m, and the distance from one to the next.
WINDOW, PITCH = 200.0, 100.0
#: A window is believed where the correlation is at least this.
LEAST_CORRELATION = 0.6
#: Channels that show the same track at every pass.
KEYS = ("gauge", "cross_level", "longitudinal_level_d1", "alignment_d1", "longitudinal_level_d2", "alignment_d2")


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """How a run lies on a reference.

    Attributes
    ----------
    distance : (w,) array
        Middle of each believed window, m.
    shift : (w,) array
        What the run's distances are too large by there, m.
    correlation : (w,) array
        Of the window, at that shift.
    windows : int
        Windows in which both runs have a channel in common.
    scatter : float
        Robust spread of the shifts about their neighbours' median, m: how well the run overlays once shifted. NaN below three windows.
    """

    distance: FloatArray
    shift: FloatArray
    correlation: FloatArray
    windows: int
    scatter: float

    def at(self, distance: FloatArray) -> FloatArray:
        """Smoothed shift at distances, m; 0 where no window was believed at all."""
        if not len(self.shift):
            return np.zeros(len(distance))
        return np.asarray(np.interp(distance, self.distance, _smoothed(self.shift)))


def overlay(geometry: Geometry, reference: Geometry, *, reach: float = 3.0) -> Overlay:
    """Find the shift along the track between two runs on one section, window by window.

    The correlation is the mean, over the channels that both have, of the correlation coefficients in the window; its greatest value
    among shifts within `reach` is refined by a parabola.

    Parameters
    ----------
    geometry, reference : Geometry
        On the same section and grid.
    reach : float
        Greatest shift looked for, m.

    Returns
    -------
    Overlay

    References
    ----------
    docs/theory/geometry.md (9).
    """
    pairs = [
        (geometry.channels[key].values, reference.channels[key].values)
        for key in KEYS
        if key in geometry.channels and key in reference.channels and geometry.channels[key].spacing <= 1.0
    ]
    return _laid_over(pairs, geometry.distance, geometry.recording.step, reach, LEAST_CORRELATION)


def _laid_over(
    pairs: Sequence[tuple[FloatArray, FloatArray]],
    distance: FloatArray,
    step: float,
    reach: float,
    enough: float,
) -> Overlay:
    """The shifts between rows, window by window."""
    count = len(distance)
    half, pitch, most = round(0.5 * WINDOW / step), round(PITCH / step), round(reach / step)
    middles = np.arange(half + most, count - half - most, pitch)
    if not pairs or not len(middles):
        return Overlay(np.empty(0), np.empty(0), np.empty(0), 0, math.nan)
    lags = np.arange(-most, most + 1)
    total, used = np.zeros((len(middles), len(lags))), np.zeros((len(middles), len(lags)))
    for a, b in pairs:
        if not (np.isfinite(a).any() and np.isfinite(b).any()):
            continue
        a, b = a - np.nanmedian(a), b - np.nanmedian(b)
        for j, lag in enumerate(lags):
            r = _window_correlation(np.roll(a, -lag), b, middles, half)
            known = np.isfinite(r)
            total[known, j] += r[known]
            used[known, j] += 1
    score = np.where(used > 0, total / np.maximum(used, 1), -1.0)
    best = np.argmax(score, axis=1)
    inner = (best > 0) & (best < len(lags) - 1)
    row = np.arange(len(middles))
    k = np.clip(best, 1, len(lags) - 2)
    left, peak, right = score[row, k - 1], score[row, k], score[row, k + 1]
    bend = left - 2.0 * peak + right
    fine = np.where(bend < 0.0, 0.5 * (left - right) / np.where(bend < 0.0, bend, -1.0), 0.0)
    believed = inner & (peak >= enough)
    shift = ((lags[k] + np.clip(fine, -1.0, 1.0)) * step)[believed]
    scatter = math.nan
    if len(shift) >= 3:
        scatter = float(1.4826 * np.median(np.abs(shift - _smoothed(shift))))
    common = int(((used > 0).any(axis=1)).sum())
    return Overlay(distance[middles][believed], shift, peak[believed], common, scatter)


def _window_correlation(a: FloatArray, b: FloatArray, middles: NDArray[np.int64], half: int) -> FloatArray:
    """Correlation coefficient of two rows in windows; NaN where less than four fifths is known."""
    known = np.isfinite(a) & np.isfinite(b)
    x, y = np.where(known, a, 0.0), np.where(known, b, 0.0)

    def sums(values: FloatArray) -> FloatArray:
        total = np.append(0.0, np.cumsum(values))
        return np.asarray(total[middles + half] - total[middles - half])

    n = sums(known.astype(float))
    safe = np.maximum(n, 1.0)
    mx, my = sums(x) / safe, sums(y) / safe
    xx, yy, xy = sums(x * x) / safe - mx**2, sums(y * y) / safe - my**2, sums(x * y) / safe - mx * my
    with np.errstate(invalid="ignore", divide="ignore"):
        r = xy / np.sqrt(np.maximum(xx, 0.0) * np.maximum(yy, 0.0))
    return np.where((n >= 1.6 * half) & (xx > 1e-12) & (yy > 1e-12), r, np.nan)


def _smoothed(shift: FloatArray) -> FloatArray:
    from scipy.ndimage import median_filter, uniform_filter1d

    return np.asarray(uniform_filter1d(median_filter(shift, 5, mode="nearest"), 3, mode="nearest"))


def shifted(passage: Passage, found: Overlay) -> Passage:
    """A passage with an overlay's shift taken off its distances."""
    distance = passage.distance - found.at(passage.distance)
    sense = 1.0 if passage.speed.sum() >= 0 else -1.0
    top = np.maximum.accumulate(np.append(-np.inf, sense * distance[:-1]))
    kept = (sense * distance > top + 1e-3) & (distance >= 0.0) & (distance <= passage.section.length)
    return replace(passage, time=passage.time[kept], distance=distance[kept], speed=passage.speed[kept])
