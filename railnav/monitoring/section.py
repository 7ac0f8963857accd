"""Sections: tracks laid end to end, so that everything a run measured has one distance to stand at."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError
from railnav.track.model import End, TrackPoints
from railnav.units import wrap_angle

if TYPE_CHECKING:
    from railnav.navigation.solution import Solution
    from railnav.run import Run
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Rows of a solution on one track that run back by more than this have turned, m.
TURNED = 5.0
#: A way between two rows may be this much longer than the train can have run, m.
SLACK = 60.0
#: Most tracks passed unseen between two rows.
UNSEEN = 8
#: Sigma along the track above which a row of a solution says nothing of where a sample lies, m.
USELESS_SIGMA = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Tracks in the order met; distance grows from the first to the last.

    Attributes
    ----------
    model : TrackModel
    track : (p,) int array
        Track index of each piece.
    direction : (p,) int array
        +1 where distance grows with the track's offset, -1 otherwise.
    distance : (p + 1,) array
        Where each piece begins, and the whole length, m.
    entry : (p,) array
        Offset at which each piece begins, m.
    """

    model: TrackModel
    track: IntArray
    direction: IntArray
    distance: FloatArray
    entry: FloatArray

    @property
    def length(self) -> float:
        """Whole length, m."""
        return float(self.distance[-1])

    @property
    def name(self) -> str:
        """First and last track."""
        names = [self.model.track_id[i] for i in (self.track[0], self.track[-1])]
        return names[0] if len(self.track) == 1 else f"{names[0]} to {names[1]}"

    @property
    def surveyed(self) -> bool:
        """Whether the model states covariances here: it is then a survey, whose short waves are its own noise, and not a design."""
        start = self.model.knot_start
        return any(
            bool(np.isfinite(self.model.covariance_g[int(start[i]) : int(start[i + 1])]).any()) for i in self.track
        )

    def grid(self, step: float) -> FloatArray:
        """Uniform distances from 0 to the end, m."""
        return np.asarray(step * np.arange(int(self.length / step + 1e-9) + 1))

    def locate(self, distance: ArrayLike) -> tuple[IntArray, FloatArray]:
        """Track index and offset, m, at distances; any shape."""
        d = np.asarray(distance, float)
        piece = np.clip(np.searchsorted(self.distance, d, side="right") - 1, 0, len(self.track) - 1)
        along = np.clip(d - self.distance[piece], 0.0, self.distance[piece + 1] - self.distance[piece])
        return self.track[piece], self.entry[piece] + self.direction[piece] * along

    def project(self, track: ArrayLike, offset: ArrayLike) -> FloatArray:
        """Distances of places on the model's tracks, m; NaN where they do not lie on the section."""
        which, where = np.broadcast_arrays(np.asarray(track, np.int64), np.asarray(offset, float))
        out = np.full(which.shape, np.nan)
        for k in range(len(self.track)):
            here = which == self.track[k]
            along = (where[here] - self.entry[k]) * self.direction[k]
            span = self.distance[k + 1] - self.distance[k]
            out[here] = np.where((along >= -1e-6) & (along <= span + 1e-6), self.distance[k] + along, out[here])
        return out

    def at(self, distance: ArrayLike) -> TrackPoints:
        """Geometry of the model along the section: bearings, curvature, gradient and cant as distance grows."""
        track, offset = self.locate(distance)
        begin = self.model.offset[self.model.knot_start[:-1]]
        points = self.model.at(track, offset + begin[track])
        sense = self._sense(distance)
        turn = np.where(sense > 0, 0.0, np.pi)
        return TrackPoints(
            easting=points.easting,
            northing=points.northing,
            height=points.height,
            grid_bearing=wrap_angle(points.grid_bearing + turn),
            heading=np.mod(points.heading + turn, 2.0 * np.pi),
            curvature=sense * points.curvature,
            gradient=sense * points.gradient,
            cant=sense * points.cant,
            chainage=points.chainage,
        )

    def _sense(self, distance: ArrayLike) -> IntArray:
        d = np.asarray(distance, float)
        piece = np.clip(np.searchsorted(self.distance, d, side="right") - 1, 0, len(self.track) - 1)
        return self.direction[piece]


@dataclass(frozen=True, slots=True, eq=False)
class Passage:
    """One uninterrupted way of a train over a section, without turning back.

    Attributes
    ----------
    section : Section
    time, distance : (m,) array
        s; distance along the section at that time, m, strictly monotonic.
    speed : (m,) array
        d(distance)/d(time), m/s: negative against growing distance.
    nose : int
        +1 where the vehicle's nose points to growing distance.
    sigma : float
        Median standard deviation along the track, m.
    probability : float
        Share of rows whose track is at least 99 % probable.
    """

    section: Section
    time: FloatArray
    distance: FloatArray
    speed: FloatArray
    nose: int
    sigma: float
    probability: float

    @property
    def extent(self) -> tuple[float, float]:
        """Least and greatest distance, m."""
        return float(self.distance.min()), float(self.distance.max())

    def where(self, time: ArrayLike) -> FloatArray:
        """Distance at times, m: cubic through places and speeds; NaN outside the passage."""
        from scipy.interpolate import CubicHermiteSpline

        t = np.asarray(time, float)
        inside = (t >= self.time[0]) & (t <= self.time[-1])
        out = np.full(t.shape, np.nan)
        out[inside] = CubicHermiteSpline(self.time, self.distance, self.speed)(t[inside])
        return out

    def speed_at(self, time: ArrayLike) -> FloatArray:
        """d(distance)/d(time) at times, m/s; NaN outside the passage."""
        return np.asarray(np.interp(np.asarray(time, float), self.time, self.speed, left=np.nan, right=np.nan))


def section_of(model: TrackModel, tracks: Sequence[str]) -> Section:
    """Lay named tracks end to end; each must lead lawfully into the next.

    Raises
    ------
    TrackError
        An unknown track, one named twice, or no permitted movement from one to the next.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> section = section_of(demo_line(spacing=50.0), ["77R-08", "77R-09"])
    >>> section.direction, len(section.distance)
    (array([1, 1]), 3)
    """
    index = [model.track_index(name) for name in tracks]
    if not index:
        raise TrackError("a section needs at least one track")
    twice = next((name for i, name in enumerate(tracks) if name in tracks[:i]), None)
    if twice is not None:
        raise TrackError(f"track {twice!r} stands twice in the section")
    if len(index) == 1:
        return _laid(model, [(index[0], 1)])
    onward = _onward(model)
    for first in (1, -1):
        way = [(index[0], first)]
        for track in index[1:]:
            leads = [state for state in onward.get(way[-1], ()) if state[0] == track]
            if not leads:
                break
            way.append(leads[0])
        if len(way) == len(index):
            return _laid(model, way)
    raise TrackError(f"no permitted movements lead through {', '.join(tracks)} in this order without reversing")


def passages_of(solution: Solution, model: TrackModel) -> list[Passage]:
    """Part a navigated run into uninterrupted ways, each over a section of its own, longest first.

    A way ends where the train turns back, where it has no place on the model, where two places are not joined by permitted
    movements, or where it comes to a track that it has already run.

    Parameters
    ----------
    solution : Solution
    model : TrackModel
        The model that it was navigated on.

    Returns
    -------
    list of Passage
        Only ways of at least ten rows and 50 m. Sections are laid so that most of their length runs with growing offset.
    """
    onward = _onward(model)
    visits = _visits(solution)
    ways: list[tuple[list[tuple[int, int]], list[int]]] = []
    states: list[tuple[int, int]] = []
    rows: list[int] = []
    for a, b, track, direction in visits:
        state = (track, direction)
        via: list[tuple[int, int]] | None = None
        if states and state == states[-1]:
            via = []
        elif states and all(track != t for t, _ in states):
            ahead = float(np.nanmax(np.abs(solution.speed[[rows[-1], a]]))) * (
                solution.time[a] - solution.time[rows[-1]]
            )
            via = _between(model, onward, states[-1], state, ahead + SLACK)
            if via is not None and any(t == passed for t, _ in via for passed, _ in states):
                via = None
        if via is None:
            if states:
                ways.append((states, rows))
            states, rows = [state], list(range(a, b))
        else:
            states = states + via + ([state] if state != states[-1] else [])
            rows += range(a, b)
    if states:
        ways.append((states, rows))
    passages = [_passage(solution, model, way, np.array(kept)) for way, kept in ways]
    found = [p for p in passages if p is not None]
    return sorted(found, key=lambda p: p.extent[0] - p.extent[1])


def told_apart(runs: Sequence[Run]) -> None:
    """Refuse two runs of one name: what was found could not be told apart, or would count twice.

    Raises
    ------
    TrackError
        Two runs bear the same name.
    """
    names = [run.id for run in runs]
    twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if twice is not None:
        raise TrackError(f"two runs are called {twice!r}; give each run once, or another id in its run.toml")


def onto(passage: Passage, section: Section) -> Passage | None:
    """The part of a passage that lies on another section, or None where it has less than ten rows or 50 m there."""
    track, offset = passage.section.locate(passage.distance)
    d = section.project(track, offset)
    there = np.isfinite(d)
    if there.sum() < 10:
        return None
    sense = np.sign(np.diff(d[there])).sum()
    if sense == 0 or np.ptp(d[there]) < 50.0:
        return None
    flip = 1 if (sense > 0) == (passage.speed.sum() > 0) else -1
    kept = np.flatnonzero(there)
    good = _monotonic(d[kept], 1 if sense > 0 else -1)
    kept = kept[good]
    if len(kept) < 10:
        return None
    return Passage(
        section,
        passage.time[kept],
        d[kept],
        flip * passage.speed[kept],
        passage.nose * flip,
        passage.sigma,
        passage.probability,
    )


def _onward(model: TrackModel) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """Where each (track, direction) leads by one permitted movement."""
    lead: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for a, end_a, b, end_b in model.movements.tolist():
        for here, end, there, enter in ((a, end_a, b, end_b), (b, end_b, a, end_a)):
            way = 1 if end == End.FINISH else -1
            lead.setdefault((here, way), []).append((there, 1 if enter == End.START else -1))
    return lead


def _between(
    model: TrackModel,
    onward: dict[tuple[int, int], list[tuple[int, int]]],
    a: tuple[int, int],
    b: tuple[int, int],
    longest: float,
) -> list[tuple[int, int]] | None:
    """Tracks passed unseen from a to b, both left out; None where no lawful way is short enough."""
    length = model.lengths
    queue: deque[tuple[tuple[int, int], list[tuple[int, int]], float]] = deque([(a, [], 0.0)])
    while queue:
        state, via, way = queue.popleft()
        for after in onward.get(state, ()):
            if after == b:
                return via
            reach = way + float(length[after[0]])
            if len(via) < UNSEEN and reach <= longest and after not in via:
                queue.append((after, [*via, after], reach))
    return None


def _visits(solution: Solution) -> list[tuple[int, int, int, int]]:
    """Rows in a stretch on one track in one direction: first row, one past the last, track, direction of motion."""
    track = np.where(np.isfinite(solution.offset) & (solution.sigma_along < USELESS_SIGMA), solution.track, -1)
    edges = np.flatnonzero(np.diff(track, prepend=-2, append=-2))
    visits: list[tuple[int, int, int, int]] = []
    for a, b in pairwise(edges.tolist()):
        if track[a] < 0:
            continue
        motion = np.sign(solution.running_direction[a:b] * np.nan_to_num(solution.speed[a:b]))
        cut = [int(a)]
        way = 0
        offset = solution.offset[a:b]
        extreme = offset[0]
        for i in range(b - a):  # a turn: back by more than TURNED from the furthest point reached
            if way == 0:
                if abs(offset[i] - offset[0]) > TURNED:
                    way = 1 if offset[i] > offset[0] else -1
                    extreme = offset[i]
                continue
            if (offset[i] - extreme) * way > 0.0:
                extreme = offset[i]
            elif (extreme - offset[i]) * way > TURNED:
                visits.append((cut[-1], int(a) + i, int(track[a]), way))
                cut.append(int(a) + i)
                way, extreme = -way, offset[i]
        if way == 0:
            way = int(np.sign(motion.sum())) or 1
        visits.append((cut[-1], int(b), int(track[a]), way))
    return visits


def _laid(model: TrackModel, way: Sequence[tuple[int, int]]) -> Section:
    length = model.lengths
    with_offset = sum(float(length[t]) * d for t, d in way) >= 0.0
    if not with_offset:
        way = [(t, -d) for t, d in reversed(way)]
    track = np.array([t for t, _ in way], np.int64)
    direction = np.array([d for _, d in way], np.int64)
    return Section(
        model,
        track,
        direction,
        np.append(0.0, np.cumsum(length[track])),
        np.where(direction > 0, 0.0, length[track]),
    )


def _monotonic(distance: FloatArray, sense: int) -> NDArray[np.bool_]:
    """Rows that go on: each further than every row before it by a centimetre or more."""
    d = sense * distance
    top = np.maximum.accumulate(np.append(-np.inf, d[:-1]))
    return np.asarray(d > top + 0.01)


def _passage(solution: Solution, model: TrackModel, way: list[tuple[int, int]], rows: IntArray) -> Passage | None:
    section = _laid(model, way)
    sense = 1 if (int(section.track[0]), int(section.direction[0])) == way[0] else -1
    d = section.project(solution.track[rows], solution.offset[rows])
    there = np.isfinite(d)
    rows, d = rows[there], d[there]
    good = _monotonic(d, sense)
    rows, d = rows[good], d[good]
    if len(rows) < 10 or np.ptp(d) < 50.0:
        return None
    nose = np.sign((solution.running_direction[rows] * section._sense(d)).sum())
    return Passage(
        section,
        solution.time[rows],
        d,
        sense * np.abs(solution.speed[rows]),
        int(nose) or 1,
        float(np.median(solution.sigma_along[rows])),
        float(np.mean(solution.track_probability[rows] >= 0.99)),
    )
