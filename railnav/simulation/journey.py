"""Journeys: lawful paths over the tracks of a model, leg by leg, and how far along them a position lies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError
from railnav.track.model import End, Route, TrackModel, TrackPoints

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Stop:
    """A halt on the way.

    Attributes
    ----------
    track : str
    offset : float
        Where the reference point stands, m.
    duration : float
        Standstill, s.
    """

    track: str
    offset: float
    duration: float = 30.0


@dataclass(frozen=True, slots=True)
class Leg:
    """One movement without reversing, from rest to rest.

    Attributes
    ----------
    tracks : tuple of str
        The tracks in the order met.
    start, finish : float, optional
        Offset on the first and on the last track, m. By default the leg begins where the first track is entered (or where the
        leg before ended) and runs to where the last track is left. On a single track, `finish < start` runs against growing
        offset.
    stops : tuple of Stop
        In the order met.
    dwell : float
        Standstill after the leg, s.
    """

    tracks: tuple[str, ...]
    start: float | None = None
    finish: float | None = None
    stops: tuple[Stop, ...] = ()
    dwell: float = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class Halt:
    """A standstill on a path: distance from the path's start, m, and duration, s."""

    distance: float
    duration: float


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Tracks laid end to end in the order a train runs them; distance counts every metre run, backwards too.

    Attributes
    ----------
    model : TrackModel
    distance : (p + 1,) array
        Distance at which each piece begins, and the whole length, m.
    track : (p,) int array
        Track index of each piece.
    direction : (p,) int array
        +1 where the train moves to growing offset, -1 otherwise.
    gear : (p,) int array
        +1 where it moves nose first, -1 where it backs up.
    entry : (p,) array
        Offset at which each piece begins, m.
    halts : tuple of Halt
        Standstills in order, the one at the end of each leg included.
    """

    model: TrackModel
    distance: FloatArray
    track: IntArray
    direction: IntArray
    gear: IntArray
    entry: FloatArray
    halts: tuple[Halt, ...]

    @property
    def length(self) -> float:
        """Whole distance run, m."""
        return float(self.distance[-1])

    def piece(self, distance: ArrayLike) -> IntArray:
        """Index of the piece at distances run; any shape."""
        where = np.searchsorted(self.distance, np.asarray(distance, float), side="right") - 1
        return np.clip(where, 0, len(self.track) - 1)

    def locate(self, distance: ArrayLike) -> tuple[IntArray, FloatArray]:
        """Track index and offset, m, at distances run; any shape."""
        run = np.asarray(distance, float)
        i = self.piece(run)
        along = np.clip(run - self.distance[i], 0.0, self.distance[i + 1] - self.distance[i])
        return self.track[i], self.entry[i] + self.direction[i] * along

    def at(self, distance: ArrayLike) -> TrackPoints:
        """Geometry of the tracks at distances run; signs as offset grows."""
        track, offset = self.locate(distance)
        return self.model.at(track, offset)

    def nose(self, distance: ArrayLike) -> IntArray:
        """+1 where the vehicle's nose points to growing offset, -1 otherwise; any shape."""
        i = self.piece(distance)
        return self.direction[i] * self.gear[i]


def directions(model: TrackModel, tracks: Sequence[str]) -> tuple[int, ...]:
    """Direction in which each track of a lawful path is run, from the permitted movements.

    Parameters
    ----------
    model : TrackModel
    tracks : sequence of str
        At least two for the direction to be known; a single track counts as +1.

    Returns
    -------
    tuple of int
        +1 for growing offset, -1 against it.

    Raises
    ------
    TrackError
        Where the model permits no movement from one track to the next.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> directions(demo_line(spacing=50.0), ["78-01", "77R-09", "77R-08"])
    (-1, -1, -1)
    """
    if not tracks:
        raise TrackError("a path needs at least one track")
    index = [model.track_index(t) for t in tracks]
    if len(index) == 1:
        return (1,)
    permitted: set[tuple[int, int, int, int]] = set()
    for a, end_a, b, end_b in model.movements.tolist():
        permitted |= {(a, end_a, b, end_b), (b, end_b, a, end_a)}

    def leaving(direction: int) -> int:
        return int(End.FINISH if direction > 0 else End.START)

    def entering(direction: int) -> int:
        return int(End.START if direction > 0 else End.FINISH)

    ways: dict[int, tuple[int, ...]] = {1: (1,), -1: (-1,)}
    for i in range(1, len(index)):
        onward: dict[int, tuple[int, ...]] = {}
        for before, way in ways.items():
            for after in (1, -1):
                if (index[i - 1], leaving(before), index[i], entering(after)) in permitted:
                    onward.setdefault(after, (*way, after))
        if not onward:
            raise TrackError(
                f"no permitted movement leads from {tracks[i - 1]!r} on to {tracks[i]!r} without reversing"
            )
        ways = onward
    return next(iter(ways.values()))


def path_of(model: TrackModel, journey: Route | Leg | Sequence[str] | Sequence[Leg]) -> Path:
    """Lay a journey out as one path.

    Parameters
    ----------
    model : TrackModel
    journey : Route, Leg, sequence of str, or sequence of Leg
        A lawful route (run in full), one leg, the tracks of one leg, or several legs. A leg that begins against the direction in
        which the one before ended backs up: the nose keeps its direction.

    Returns
    -------
    Path

    Raises
    ------
    TrackError
        Unlawful movement, offsets off the track, stops out of order, or a leg that does not begin where the last one ended.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> path = path_of(demo_line(spacing=50.0), Leg(("77R-01",), start=100.0, finish=700.0))
    >>> path.length
    600.0
    """
    legs = _legs(journey)
    track: list[int] = []
    direction: list[int] = []
    gear: list[int] = []
    entry: list[float] = []
    distance = [0.0]
    halts: list[Halt] = []
    last: tuple[str, float, int, int] | None = None  # track, offset, direction, gear at the end of the leg before
    for number, (leg, given) in enumerate(legs):
        start, finish = leg.start, leg.finish
        if last is not None:
            if leg.tracks[0] != last[0] or (start is not None and abs(start - last[1]) > 1e-3):
                raise TrackError(
                    f"leg {number + 1} begins on {leg.tracks[0]!r} at {start} m, but leg {number} ends on {last[0]!r} at "
                    f"{last[1]:.3f} m"
                )
            start = last[1]
        ways = given or directions(model, leg.tracks)
        length = [model.length(t) for t in leg.tracks]
        if given is None and len(ways) == 1 and finish is not None and finish < (0.0 if start is None else start):
            ways = (-1,)
        begin = start if start is not None else (0.0 if ways[0] > 0 else length[0])
        end = finish if finish is not None else (length[-1] if ways[-1] > 0 else 0.0)
        for name, offset, limit in ((leg.tracks[0], begin, length[0]), (leg.tracks[-1], end, length[-1])):
            if not 0.0 <= offset <= limit + 1e-6:
                raise TrackError(f"offset {offset} m is not on track {name!r}, 0..{limit:.3f} m")
        sense = 1 if last is None or ways[0] == last[2] else -1
        gear_now = sense * (1 if last is None else last[3])
        first_piece = len(track)
        for i, (name, way) in enumerate(zip(leg.tracks, ways, strict=True)):
            a = begin if i == 0 else (0.0 if way > 0 else length[i])
            b = end if i == len(ways) - 1 else (length[i] if way > 0 else 0.0)
            if (b - a) * way < 0.0:
                raise TrackError(f"the leg would run {name!r} from {a:.1f} to {b:.1f} m, against its direction")
            track.append(model.track_index(name))
            direction.append(way)
            gear.append(gear_now)
            entry.append(a)
            distance.append(distance[-1] + abs(b - a))
        if distance[-1] - distance[first_piece] <= 0.0:
            raise TrackError(f"leg {number + 1} over {', '.join(leg.tracks)} has no length")
        halts += _halts(model, leg, track, direction, entry, distance, first_piece)
        halts.append(Halt(distance[-1], leg.dwell))
        last = (leg.tracks[-1], end, ways[-1], gear_now)
    return Path(
        model, np.array(distance), np.array(track), np.array(direction), np.array(gear), np.array(entry), tuple(halts)
    )


def _legs(journey: Route | Leg | Sequence[str] | Sequence[Leg]) -> list[tuple[Leg, tuple[int, ...] | None]]:
    """Legs, each with its directions where a route states them."""
    if isinstance(journey, Route):
        return [(Leg(journey.tracks), journey.directions)]
    if isinstance(journey, Leg):
        return [(journey, None)]
    if isinstance(journey, str):
        return [(Leg((journey,)), None)]
    items = list(journey)
    if not items:
        raise TrackError("a journey needs at least one track")
    names = [item for item in items if isinstance(item, str)]
    if len(names) == len(items):
        return [(Leg(tuple(names)), None)]
    return [(item, None) for item in items if isinstance(item, Leg)]


def _halts(
    model: TrackModel,
    leg: Leg,
    track: list[int],
    direction: list[int],
    entry: list[float],
    distance: list[float],
    first: int,
) -> list[Halt]:
    """Stops of a leg by distance run."""
    found: list[Halt] = []
    at = first
    for stop in leg.stops:
        wanted = model.track_index(stop.track)
        where = next((i for i in range(at, len(track)) if track[i] == wanted), None)
        if where is None:
            raise TrackError(f"the stop on {stop.track!r} does not lie on the leg, or stands out of order")
        along = (stop.offset - entry[where]) * direction[where]
        if not 0.0 < along < distance[where + 1] - distance[where]:
            raise TrackError(f"the stop at {stop.offset} m on {stop.track!r} does not lie inside the leg")
        halt = Halt(distance[where] + along, stop.duration)
        if found and halt.distance <= found[-1].distance:
            raise TrackError(f"the stop at {stop.offset} m on {stop.track!r} stands out of order")
        found.append(halt)
        at = where
    return found
