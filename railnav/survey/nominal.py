"""The nominal curve of a line: what corrections are estimated to, and how a run lies along it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.survey import _kernels
from railnav.survey.fixes import JUMP, STATED_SIGMA, TURNED, USED, Fixes

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: A run's course is thinned to points this far apart, m.
THINNING = 30.0
#: A run turns back when this much of its way lies along itself, m.
TURNING_BACK = 200.0
#: Two courses closer than this run alongside, m.
ALONGSIDE = 80.0
#: Share of a run's course that must lie on a line for the run to belong to it.
SHARE_ON_LINE = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Nominal:
    """A smooth curve by nodes every `step` metres of grid length.

    Attributes
    ----------
    step : float
        Arc length between nodes in the grid, m.
    easting, northing : (n,) array
        Grid, m.
    tangent_e, tangent_n : (n,) array
        Unit tangent, as the nodes go.
    curvature : (n,) array
        Positive to the right, 1/m (grid).
    """

    step: float
    easting: FloatArray
    northing: FloatArray
    tangent_e: FloatArray
    tangent_n: FloatArray
    curvature: FloatArray

    def __len__(self) -> int:
        return len(self.easting)

    @property
    def normal(self) -> tuple[FloatArray, FloatArray]:
        """Unit vector to the right of the curve at the nodes: (east, north)."""
        return self.tangent_n, -self.tangent_e

    def part(self, first: int, last: int) -> Nominal:
        """Give the nodes first..last-1 as a curve of their own."""
        cut = slice(first, last)
        return Nominal(
            self.step,
            self.easting[cut].copy(),
            self.northing[cut].copy(),
            self.tangent_e[cut].copy(),
            self.tangent_n[cut].copy(),
            self.curvature[cut].copy(),
        )

    def reversed(self) -> Nominal:
        """Give the same curve from its other end."""
        back = slice(None, None, -1)
        return Nominal(
            self.step,
            self.easting[back].copy(),
            self.northing[back].copy(),
            -self.tangent_e[back],
            -self.tangent_n[back],
            -self.curvature[back],
        )

    def resampled(self, step: float) -> Nominal:
        """Give the same curve by nodes every `step` metres."""
        return curve(self.easting, self.northing, step)

    def shifted(self, right: FloatArray) -> Nominal:
        """Give the curve through the nodes moved to the right by `right` (n,), m."""
        e, n = self.normal
        return curve(self.easting + right * e, self.northing + right * n, self.step)


def curve(easting: FloatArray, northing: FloatArray, step: float) -> Nominal:
    """Lay a C2 curve through points in order and tabulate it about every `step` metres of its own length, end to end."""
    from scipy.interpolate import CubicSpline

    chord = np.hypot(np.diff(easting), np.diff(northing))
    keep = np.append(True, chord > 0.05 * step)
    points = np.column_stack([easting, northing])[keep]
    p = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    spline = CubicSpline(p, points, bc_type="natural")
    first = spline.derivative(1)
    fine = np.linspace(0.0, p[-1], max(2, int(p[-1] / min(step, 5.0)) + 1))
    rate = np.hypot(*first(fine).T)
    middle = np.hypot(*first(0.5 * (fine[1:] + fine[:-1])).T)
    s = np.append(0.0, np.cumsum(np.diff(fine) * (rate[1:] + rate[:-1] + 4.0 * middle) / 6.0))
    count = max(3, round(float(s[-1]) / step) + 1)
    step = float(s[-1]) / (count - 1)
    at = np.interp(np.linspace(0.0, s[-1], count), s, fine)
    d1, d2 = first(at), spline.derivative(2)(at)
    size = np.hypot(d1[:, 0], d1[:, 1])
    xy = spline(at)
    return Nominal(
        step=step,
        easting=np.ascontiguousarray(xy[:, 0]),
        northing=np.ascontiguousarray(xy[:, 1]),
        tangent_e=d1[:, 0] / size,
        tangent_n=d1[:, 1] / size,
        curvature=(d2[:, 0] * d1[:, 1] - d1[:, 0] * d2[:, 1]) / size**3,
    )


def through(easting: FloatArray, northing: FloatArray, step: float) -> Nominal:
    """Lay a C2 curve through nodes that lie about `step` metres apart, and keep these nodes."""
    from scipy.interpolate import CubicSpline

    p = np.append(0.0, np.cumsum(np.hypot(np.diff(easting), np.diff(northing))))
    spline = CubicSpline(p, np.column_stack([easting, northing]))
    d1, d2 = spline(p, 1), spline(p, 2)
    size = np.hypot(d1[:, 0], d1[:, 1])
    return Nominal(
        step=step,
        easting=np.array(easting),
        northing=np.array(northing),
        tangent_e=d1[:, 0] / size,
        tangent_n=d1[:, 1] / size,
        curvature=(d2[:, 0] * d1[:, 1] - d1[:, 0] * d2[:, 1]) / size**3,
    )


def course(fixes: Fixes) -> FloatArray:
    """Points of a run about 30 m apart, (k, 2), without the wandering at stops and without folds.

    Of a run that turns back the longest way in one sense is taken; the fixes of the others are set aside.
    """
    used = np.flatnonzero(fixes.reason == USED)
    x, y = fixes.easting[used], fixes.northing[used]
    keep = _kernels.thin(x, y, THINNING)
    if len(x) and np.hypot(x[-1] - x[keep][-1], y[-1] - y[keep][-1]) > 0.2 * THINNING:
        keep[-1] = True
    at = used[keep]
    for _ in range(5):
        step = np.diff(np.column_stack([fixes.easting[at], fixes.northing[at]]), axis=0)
        fold = (step[1:] * step[:-1]).sum(axis=1) < 0.0
        if len(at) < 3 or not fold.any():
            break
        at = at[np.concatenate([[True], ~fold, [True]])]
    points = np.column_stack([fixes.easting[at], fixes.northing[at]])
    first, last = _one_way(points)
    if first > 0 or last < len(points):
        aside = np.ones(len(fixes), np.bool_)
        aside[at[first] : at[last - 1] + 1] = False
        fixes.reason[aside & (fixes.reason == USED)] = TURNED
    return points[first:last]


def _one_way(points: FloatArray) -> tuple[int, int]:
    """Longest stretch (from, to) of a course that does not come back along itself; all of it when less than 200 m does."""
    from scipy.spatial import cKDTree

    if len(points) < 10:
        return 0, len(points)
    direction = np.gradient(points, axis=0)
    direction /= np.maximum(np.hypot(*direction.T), 1e-9)[:, None]
    back = np.zeros(len(points), np.bool_)
    pairs = cKDTree(points).query_pairs(1.5 * THINNING, output_type="ndarray")
    against = (direction[pairs[:, 0]] * direction[pairs[:, 1]]).sum(axis=1) < -0.5
    back[pairs[against].max(axis=1)] = True
    if np.count_nonzero(back) * THINNING < TURNING_BACK:
        return 0, len(points)
    # a change of sense within a few points is noise
    back = np.convolve(back, np.ones(5), mode="same") > 2.5
    edges = np.concatenate([[0], np.flatnonzero(np.diff(back.astype(np.int8))) + 1, [len(points)]])
    longest = int(np.argmax(np.diff(edges)))
    return int(edges[longest]), int(edges[longest + 1])


@dataclass(slots=True, eq=False)
class Line:
    """Runs that follow one another: their merged course and who they are."""

    course: FloatArray
    members: list[int]


def lines(courses: Sequence[FloatArray]) -> list[Line]:
    """Sort runs into lines: a run belongs to a line when four fifths of its course lie alongside it or continue it."""
    order = sorted(range(len(courses)), key=lambda i: -_length(courses[i]))
    found: list[Line] = []
    waiting = order
    while waiting:
        line = Line(courses[waiting[0]], [waiting[0]])
        waiting = waiting[1:]
        grown = True
        while grown:  # a run may reach the line only after another has lengthened it
            grown = False
            for i in list(waiting):
                merged = _merge(line.course, courses[i])
                if merged is not None:
                    line.course = merged
                    line.members.append(i)
                    waiting.remove(i)
                    grown = True
        line.members.sort()
        found.append(line)
    return found


def _length(points: FloatArray) -> float:
    return float(np.hypot(*np.diff(points, axis=0).T).sum()) if len(points) > 1 else 0.0


def _merge(base: FloatArray, other: FloatArray) -> FloatArray | None:
    """Insert what `other` adds to the course `base` (its gaps, its ends); None when `other` goes elsewhere."""
    if len(other) < 2 or len(base) < 2:
        return None
    dense, owner = _densify(base)
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(dense).query(other)
    near = distance < ALONGSIDE
    if not near.any():
        return None
    at = owner[nearest]
    accepted = near.copy()
    inserts: list[tuple[int, FloatArray]] = []  # (after base point, points)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (~near).astype(int), [0]])))
    last = len(base) - 1
    for a, b in zip(edges[::2], edges[1::2], strict=True):  # stretches a:b of other away from base
        piece = other[a:b]
        before = int(at[a - 1]) if a > 0 else None
        after = int(at[b]) if b < len(other) else None
        if before is not None and after is not None:
            if abs(after - before) <= 2:
                onward = piece if after >= before else piece[::-1]
                inserts.append((_gap_for(base, onward, min(before, after), max(before, after)), onward))
                accepted[a:b] = True
        else:
            touch = before if before is not None else after
            outward = piece if before is not None else piece[::-1]
            if touch is not None and touch <= 2:
                inserts.append((-1, outward[::-1]))
                accepted[a:b] = True
            elif touch is not None and touch >= last - 3:
                inserts.append((last, outward))
                accepted[a:b] = True
    if accepted.mean() < SHARE_ON_LINE:
        return None
    parts: list[FloatArray] = []
    previous = 0
    for after_index, piece in sorted(inserts, key=lambda item: item[0]):
        parts += [base[previous : after_index + 1], piece]
        previous = max(previous, after_index + 1)
    parts.append(base[previous:])
    merged = np.concatenate(parts)
    return np.asarray(merged[np.append(True, np.hypot(*np.diff(merged, axis=0).T) > 5.0)])


def _gap_for(base: FloatArray, piece: FloatArray, first: int, last: int) -> int:
    """Point of the course, near points first..last, after which a piece goes in with the least detour.

    The nearest point may lie a step before the gap that the piece fills; a fold there would not be smoothed away.
    """
    at = np.arange(max(0, first - 1), min(len(base) - 2, last) + 1)
    to, onward = base[at] - piece[0], base[at + 1] - piece[-1]
    detour = np.hypot(*to.T) + np.hypot(*onward.T) - np.hypot(*(base[at + 1] - base[at]).T)
    return int(at[np.argmin(detour)])


def _densify(points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Points every 60 m along a course, save across gaps longer than 300 m, and the course point each comes after."""
    chord = np.hypot(*np.diff(points, axis=0).T)
    pieces = np.where(chord > 300.0, 1, np.maximum(1, np.ceil(chord / 60.0))).astype(int)
    owner = np.append(np.repeat(np.arange(len(chord)), pieces), len(points) - 1)
    start = np.repeat(np.cumsum(pieces) - pieces, pieces)
    u = (np.arange(pieces.sum()) - start) / np.repeat(pieces, pieces)
    dense = points[owner[:-1]] + u[:, None] * np.repeat(np.diff(points, axis=0), pieces, axis=0)
    return np.concatenate([dense, points[-1:]]), owner.astype(np.int64)


def smooth_course(points: FloatArray, step: float, width: float) -> Nominal:
    """Turn a course into a nominal curve: resampled every `step` metres and smoothed over `width` (Gaussian sigma, m)."""
    from scipy.ndimage import gaussian_filter1d

    p = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    at = np.linspace(0.0, p[-1], max(2, int(p[-1] / step) + 1))
    xy = np.column_stack([np.interp(at, p, points[:, i]) for i in range(2)])
    # smooth about the end points' own tangents: reflect through the ends
    pad = max(1, int(4 * width / step))
    pad = min(pad, len(xy) - 1)
    head = 2 * xy[0] - xy[pad:0:-1]
    tail = 2 * xy[-1] - xy[-2 : -pad - 2 : -1]
    soft = gaussian_filter1d(np.concatenate([head, xy, tail]), width / step, axis=0)[pad : pad + len(xy)]
    return curve(soft[:, 0], soft[:, 1], step)


def along(nominal: Nominal, fixes: Fixes, limit: float) -> tuple[FloatArray, FloatArray]:
    """Where each fix of a run lies: offset on the nominal curve, m, and distance to its right, m; NaN farther than `limit`."""
    s, d = np.full(len(fixes), np.nan), np.full(len(fixes), np.nan)
    sound = np.flatnonzero(~np.isin(fixes.reason, (STATED_SIGMA, JUMP, TURNED)))
    at, right = np.empty(len(sound)), np.empty(len(sound))
    _kernels.walk(
        nominal.easting,
        nominal.northing,
        nominal.tangent_e,
        nominal.tangent_n,
        nominal.step,
        fixes.easting[sound],
        fixes.northing[sound],
        limit,
        at,
        right,
    )
    s[sound], d[sound] = at, right
    return s, d
