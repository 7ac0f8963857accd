"""Gyroscopic angles and odometer of a run, laid along a curve: slopes that bridge what GNSS does not see.

A bearing measured by gyros, less that of the nominal curve where the train was, is the slope y' of the track (its tangent); a pitch is
its gradient. Both drift. Where the train was between fixes the odometer says: its distance, held to the fixes by a correction that
changes linearly across a gap, so that its scale need not be known. What the angles err, white from sample to sample and wandering
as a random walk in time, is found from the differences of two runs, in which the track cancels, or else against the axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.survey.axis import Slopes
from railnav.survey.fixes import USED, Fixes
from railnav.survey.profiles import passing_count
from railnav.units import wrap_angle

if TYPE_CHECKING:
    from railnav.survey.surveyed import Surveyed

FloatArray = NDArray[np.float64]

#: Slope error of a run before anything is known of it, rad.
FIRST_ERROR = 0.05
#: A slope farther than this from the nominal curve is no slope of it (a switch-back, a wrong sign), rad.
LARGEST_SLOPE = 1.0
#: Seconds over which the odometer is held to the fixes.
HELD = 20.0
#: Nodes in the blocks whose means are compared, one with the next.
BLOCKS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
#: Of node means no more than this is believed: what changes within a node is not white, rad.
FLOOR = 2e-5
#: Least random walk, rad per sqrt(s): 0.007 degrees per root hour; no survey car's gyros are believed to be better.
LEAST_WALK = 2e-6
#: A slope this many white sigma off the running median of so many nodes, and at least so far, rad, is a gross error.
SLIP_RATIO, SLIP_NODES, LEAST_SLIP = 10.0, 31, 2e-3
#: The same where no third run is there to decide, rad.
LONE_SLIP = 0.03
#: More good fixes than this between two of a track: the run was elsewhere meanwhile.
MOST_OTHERS = 5
#: A gap in the angles longer than this is not interpolated, s.
LONGEST_GAP = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class AngleError:
    """How gyroscopic angles err: white part of one node mean, rad, and random walk, rad per sqrt(s)."""

    white: float
    walk: float


def along_at(fixes: Fixes, offset: FloatArray, sense: int, time: FloatArray) -> FloatArray:
    """Offset along the curve at given times, m; NaN before the first and after the last fix.

    With an odometer its distance, corrected by what the fixes say (averaged over `HELD` seconds, linear across gaps); without one
    linear between the fixes.
    """
    use = np.flatnonzero((fixes.reason == USED) & np.isfinite(offset))
    out = np.full(len(time), np.nan)
    if len(use) < 2:
        return out
    t, s = fixes.time[use], offset[use]
    inside = (time >= t[0]) & (time <= t[-1])
    # where the run has good fixes that are not of this track it was on another one
    others = np.append(0, np.cumsum((fixes.reason == USED) & ~np.isfinite(offset)))
    between = np.diff(others[use])
    inside &= ~(np.append(between, 0) > MOST_OTHERS)[np.clip(np.searchsorted(t, time, side="right") - 1, 0, len(t) - 1)]
    odometer = fixes.odometer
    if odometer is None or odometer[0][0] > t[0] + 1.0 or odometer[0][-1] < t[-1] - 1.0:
        out[inside] = np.interp(time[inside], t, s)
        return out
    correction = s - sense * np.interp(t, *odometer)
    held = _held(t, correction, np.array([fixes.time[after] for _, after in _broken(fixes)]))
    out[inside] = sense * np.interp(time[inside], *odometer) + np.interp(time[inside], t, held)
    return out


def _broken(fixes: Fixes) -> list[tuple[int, int]]:
    """Fixes before and after each link of the run that was found wrong."""
    return [] if fixes.attributed is None else fixes.attributed.breaks


def _held(t: FloatArray, v: FloatArray, breaks: FloatArray) -> FloatArray:
    """Mean over `HELD` seconds around each instant; neither a gap nor a slip of the odometer is averaged across."""
    out = np.empty_like(v)
    edges = np.unique(
        np.concatenate(
            [[0], np.flatnonzero(np.diff(t) > LONGEST_GAP) + 1, np.searchsorted(t, breaks), [len(t)]]
        ).astype(np.int64)
    )
    for a, b in pairwise(edges.tolist()):
        total = np.append(0.0, np.cumsum(v[a:b]))
        first = np.searchsorted(t[a:b], t[a:b] - 0.5 * HELD)
        last = np.searchsorted(t[a:b], t[a:b] + 0.5 * HELD, side="right")
        # symmetric about the instant, so that a change of scale is followed
        reach = np.minimum(np.arange(b - a) - first, last - 1 - np.arange(b - a))
        low, high = np.arange(b - a) - reach, np.arange(b - a) + reach + 1
        out[a:b] = (total[high] - total[low]) / (high - low)
    return out


def lay_angles(track: Surveyed, *, up: bool = False) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Slopes (across) or gradients (up) of the runs of a track at its nodes: means (K, N), their lead, m, and how many; None without."""
    K, N = len(track.laid), len(track.nominal)
    step = track.nominal.step
    value, lead, count = np.full((K, N), np.nan), np.zeros((K, N)), np.zeros((K, N))
    bearing = np.unwrap(np.arctan2(track.nominal.tangent_e, track.nominal.tangent_n))
    curvature = track.nominal.curvature
    for k, t in enumerate(track.laid):
        angles = t.fixes.angles
        if angles is None:
            continue
        time, nose, pitch = angles
        s = along_at(t.fixes, t.offset, t.sense, time)
        rows = np.flatnonzero(np.isfinite(s) & (s >= 0.0) & (s <= (N - 1) * step))
        if len(rows) < 2:
            continue
        s = s[rows]
        if up:
            slope = t.sense * np.tan(pitch[rows])
        else:
            turned = nose[rows] + (0.0 if t.sense > 0 else np.pi) - _bearing_at(s / step, bearing, step * curvature)
            slope = wrap_angle(turned)
        good = np.abs(slope) < LARGEST_SLOPE
        rows, s, slope = rows[good], s[good], slope[good]
        slope = slope if up else np.tan(slope)
        node = np.rint(s / step).astype(np.int64)
        many = np.bincount(node, minlength=N).astype(float)
        hit = many > 0
        value[k, hit] = np.bincount(node, weights=slope, minlength=N)[hit] / many[hit]
        lead[k, hit] = np.bincount(node, weights=s - node * step, minlength=N)[hit] / many[hit]
        count[k] = np.minimum(many, passing_count(many[hit]))  # a stop tells no more than a passing
    return (value, lead, count) if np.isfinite(value).any() else None


def _bearing_at(node: FloatArray, bearing: FloatArray, turn: FloatArray) -> FloatArray:
    """Bearing between nodes by cubics through the nodes' bearings and curvatures (`turn`: curvature times step).

    A straight line between nodes would be wrong by h^2/8 of the curvature's change, 0.2 mrad in a clothoid of 50 m to a radius of
    300 m with nodes 5 m apart: as much as a good gyroscope's noise, and all of one sign.
    """
    i = np.clip(node.astype(np.int64), 0, len(bearing) - 2)
    u = node - i
    step = bearing[i + 1] - bearing[i]
    a, b = turn[i] - step, step - turn[i + 1]
    return np.asarray(bearing[i] + u * step + u * (1.0 - u) * ((1.0 - u) * a + u * b))


def angle_error(value: FloatArray, time: FloatArray, axis: FloatArray | None) -> AngleError:
    """White part and random walk of the angles of a track's runs, from the Allan variances of their differences.

    Of a difference of two runs, in which the track cancels, adjacent means of B nodes, tau seconds long, differ with the variance
    4 v / B + 4/3 q^2 tau (v white, of one run; q^2 of its random walk); of one run less the axis with half of that.

    Parameters
    ----------
    value, time : (K, N) array
        Slopes at nodes, rad, and when they were passed, s.
    axis : (N,) array or None
        Slope of the axis, where only one run has angles.
    """
    from scipy.optimize import nnls

    has = np.flatnonzero(np.isfinite(value).sum(axis=1) >= 8)
    pairs = [(value[i] - value[j], time[i], 2.0) for a, i in enumerate(has) for j in has[:a]]
    if not pairs:
        line = np.zeros(value.shape[1]) if axis is None else axis
        pairs = [(value[i] - line, time[i], 1.0) for i in has]
    rows, power, weight = [], [], []
    for D, t, runs in pairs:
        at = np.flatnonzero(np.isfinite(D))
        total = np.append(0.0, np.cumsum(D[at]))
        for block in BLOCKS:
            if 4 * block > len(at):
                break
            mean = (total[block:] - total[:-block]) / block
            step = mean[block:] - mean[:-block]
            whole = at[2 * block - 1 :] - at[: len(step)] <= 2.2 * block  # not across gaps
            if np.count_nonzero(whole) < 8:
                continue
            spread = (1.4826 * float(np.median(np.abs(step[whole])))) ** 2
            tau = float(np.median(np.abs(t[at[block:]] - t[at[:-block]])))
            rows.append([2.0 * runs / block, 2.0 / 3.0 * runs * tau])
            power.append(spread)
            weight.append(np.sqrt(len(at) / block) / max(spread, 1e-16))
    if len(rows) < 2:
        return AngleError(1e-3, 1e-5)
    w = np.array(weight)
    (white, walk), _ = nnls(np.array(rows) * w[:, None], np.array(power) * w)
    return AngleError(max(float(np.sqrt(white)), FLOOR), max(float(np.sqrt(walk)), LEAST_WALK))


def slopes_of(
    track: Surveyed, axis: FloatArray | None, *, up: bool = False, rows: Sequence[int] | None = None
) -> Slopes | None:
    """What the angles of a track's runs say, with how they err; None where no run has any.

    Parameters
    ----------
    track : Surveyed
    axis : (N,) array or None
        Present guess of the axis, m, or of the heights: its slope is what a single run is compared with.
    up : bool
        Gradients for the chain of heights.
    rows : sequence of int, optional
        Which runs take part.
    """
    laid = lay_angles(track, up=up)
    if laid is None:
        return None
    value, lead, count = laid
    time = track.profile.time
    if rows is not None:
        part = list(rows)
        value, lead, count = value[part], lead[part], count[part]
        if time.shape[0] != len(part):
            time = time[part]
        if not np.isfinite(value).any():
            return None
    slope = None if axis is None else np.gradient(axis, track.nominal.step)
    error = angle_error(value, time, slope)
    if slope is not None:
        value = _without_slips(value, slope, error)
    usual = 1.0 / float(np.mean(1.0 / count[count > 0]))  # what the variance of a mean goes with, on average
    variance = error.white**2 * usual / np.maximum(count, 1.0)
    K = len(value)
    mine = track.laid if rows is None else [track.laid[k] for k in rows]
    broken = np.zeros((K, max(value.shape[1] - 1, 0)), np.bool_)
    for k, t in enumerate(mine):
        for before, after in _broken(t.fixes):
            # a step that the run begins before the break and ends after it; two steps where they meet in a node
            low, high = np.minimum(time[k, 1:], time[k, :-1]), np.maximum(time[k, 1:], time[k, :-1])
            broken[k] |= (low <= t.fixes.time[after]) & (high >= t.fixes.time[before]) & (high > low)
    return Slopes(
        value, lead, variance, np.full(K, FIRST_ERROR), np.full(K, error.walk), broken if broken.any() else None
    )


def _without_slips(value: FloatArray, slope: FloatArray, error: AngleError) -> FloatArray:
    """Slopes without gross errors: those that stand alone against the axis, their own neighbours, and the other runs there.

    With three runs or more the middle one is the witness; with fewer only what no track does counts, for the axis may be wrong.
    """
    from scipy.ndimage import median_filter

    out = value.copy()
    rest = value - slope
    apart = np.zeros_like(value)
    for k, row in enumerate(rest):
        at = np.flatnonzero(np.isfinite(row))
        if len(at) >= SLIP_NODES:
            apart[k, at] = row[at] - median_filter(row[at], SLIP_NODES, mode="nearest")
    known = np.isfinite(value)
    many = known.sum(axis=0)
    middle = np.zeros(value.shape[1])
    if (many >= 3).any():
        middle[many >= 3] = np.nanmedian(np.where(known, apart, np.nan)[:, many >= 3], axis=0)
    limit = np.where(many >= 3, max(SLIP_RATIO * error.white, LEAST_SLIP), LONE_SLIP)
    out[known & (np.abs(apart - middle) > limit)] = np.nan
    return out


def slips(track: Surveyed) -> list[tuple[int, int, float]]:
    """Slopes that were set aside: run of the track, node, and how far off, rad."""
    if track.slopes is None:
        return []
    laid = lay_angles(track)
    if laid is None:
        return []
    value = laid[0]
    gone = np.isfinite(value) & ~np.isfinite(track.slopes.value)
    slope = np.gradient(track.axis, track.nominal.step)
    return [(int(k), int(i), float(value[k, i] - slope[i])) for k, i in np.argwhere(gone)]
