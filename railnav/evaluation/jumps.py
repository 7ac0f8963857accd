"""Jumps between tracks that no train can make."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np

from railnav.errors import TrackError
from railnav.navigation.solution import Mode, Solution
from railnav.track.model import End, TrackModel


@dataclass(frozen=True, slots=True)
class Jump:
    """A change of track between neighbouring rows that the permitted movements do not allow within the way run.

    Attributes
    ----------
    time : float
        Of the row after the jump, s.
    before, after : str
        Tracks.
    """

    time: float
    before: str
    after: str


@dataclass(frozen=True, slots=True)
class Jumps:
    """Changes of track in a solution.

    Attributes
    ----------
    changes : int
        Neighbouring rows on different tracks.
    illegal : tuple of Jump
        Those that no train can make, with both rows tracking or coasting.
    corrections : int
        Those that no train can make, with a row in another mode: the navigator took back a choice and had said it was not sure.
    """

    changes: int
    illegal: tuple[Jump, ...]
    corrections: int


def find_jumps(solution: Solution, model: TrackModel) -> Jumps:
    """Check every change of track against the permitted movements.

    A change is lawful when a way without reversing joins the two positions and is no longer than the train can have run: 1.5 times
    the speed times the interval, three sigma of both rows, and 30 m.

    Parameters
    ----------
    solution : Solution
    model : TrackModel
        The model that the solution was made with.

    Returns
    -------
    Jumps

    Raises
    ------
    TrackError
        When the solution names a track that the model does not have.
    """
    index = []
    for name in solution.track_id:
        if name not in model.track_id:
            raise TrackError(
                f"the solution names track {name!r}, which the model does not have; give the model it was made with"
            )
        index.append(model.track_id.index(name))
    onward: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for a, end_a, b, end_b in model.movements.tolist():
        onward.setdefault((a, end_a), []).append((b, end_b))
        onward.setdefault((b, end_b), []).append((a, end_a))
    lengths = model.lengths
    steady = np.isin(solution.mode, (Mode.TRACKING, Mode.COASTING))
    track = solution.track
    changed = np.flatnonzero((track[1:] != track[:-1]) & (track[1:] >= 0) & (track[:-1] >= 0))
    illegal: list[Jump] = []
    corrections = 0
    for i in changed:
        sigma = np.nan_to_num(solution.sigma_along[i : i + 2]).sum()
        speed = np.nan_to_num(np.abs(solution.speed[i : i + 2])).max()
        reach = 1.5 * speed * (solution.time[i + 1] - solution.time[i]) + 3.0 * sigma + 30.0
        a, b = index[track[i]], index[track[i + 1]]
        if _connected(a, float(solution.offset[i]), b, float(solution.offset[i + 1]), float(reach), onward, lengths):
            continue
        if steady[i] and steady[i + 1]:
            names = solution.track_id[track[i]], solution.track_id[track[i + 1]]
            illegal.append(Jump(float(solution.time[i + 1]), *names))
        else:
            corrections += 1
    return Jumps(len(changed), tuple(illegal), corrections)


def _connected(
    a: int,
    offset_a: float,
    b: int,
    offset_b: float,
    reach: float,
    onward: dict[tuple[int, int], list[tuple[int, int]]],
    lengths: np.ndarray[tuple[int], np.dtype[np.float64]],
) -> bool:
    """Whether a lawful way no longer than `reach` leads from one position to another, forwards or backwards."""
    queue = [(offset_a, a, int(End.START)), (float(lengths[a]) - offset_a, a, int(End.FINISH))]
    heapq.heapify(queue)
    seen: set[tuple[int, int]] = set()
    while queue:
        run, track, end = heapq.heappop(queue)
        if run > reach or (track, end) in seen:
            continue
        seen.add((track, end))
        for entered, at in onward.get((track, end), []):
            if entered == b:
                rest = offset_b if at == End.START else float(lengths[b]) - offset_b
                if run + rest <= reach:
                    return True
            heapq.heappush(queue, (run + float(lengths[entered]), entered, 1 - at))
    return False
