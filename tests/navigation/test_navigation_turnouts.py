"""Every turnout of the bundled line, every lawful movement over it, in both directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from railnav.evaluation import find_jumps
from railnav.navigation import Mode, navigate
from railnav.simulation import SERVICE, Leg, demo_line, simulate

LINE = demo_line()
#: How far a train runs before and behind the movement, m.
RUN_UP, RUN_OUT = 500.0, 400.0


def reaching(first, way, length):
    """Tracks that lead to a track run a given way (+1 growing offset), at least so long, and where to start on the first."""
    movements = LINE.movements
    tracks, covered, at, entry = [first], float(LINE.lengths[first]), first, 0 if way > 0 else 1
    while covered < length:
        before = [(int(a), int(e)) for a, e, b, f in movements if (b, f) == (at, entry)]
        before += [(int(b), int(f)) for a, e, b, f in movements if (a, e) == (at, entry)]
        before = [(t, e) for t, e in before if t not in tracks]
        if not before:
            break
        at, out = before[0]
        entry = 1 - out
        tracks.insert(0, at)
        covered += float(LINE.lengths[at])
    return tracks, max(covered - length, 5.0)


def turnout_movements():
    """Movements at track ends with more than one continuation: each in both directions."""
    count = {}
    for a, e, b, f in LINE.movements:
        count[(a, e)] = count.get((a, e), 0) + 1
        count[(b, f)] = count.get((b, f), 0) + 1
    found = []
    for a, e, b, f in LINE.movements.tolist():
        if count[(a, e)] > 1 or count[(b, f)] > 1:
            found += [(a, e, b, f), (b, f, a, e)]
    return found


MOVEMENTS = turnout_movements()


def passage(a, e, b, f, seed):
    """A run over the movement that leaves track a by end e and enters b by end f."""
    before, start = reaching(a, 1 if e == 1 else -1, RUN_UP)
    behind, back = reaching(b, 1 if f == 1 else -1, RUN_OUT)  # mirrored: the way on is a way to, run backwards
    tracks = [*before, *reversed(behind)]
    if len(set(tracks)) != len(tracks):
        tracks = [*before, b]
        back = max(float(LINE.lengths[b]) - RUN_OUT, 5.0)
    names = tuple(LINE.track_id[t] for t in tracks)
    ways = LINE_WAYS(tracks)
    first, last = tracks[0], tracks[-1]
    start = start if ways[0] > 0 else float(LINE.lengths[first]) - start
    finish = float(LINE.lengths[last]) - back if ways[-1] > 0 else back
    clean = replace(SERVICE, gnss=replace(SERVICE.gnss, outlier_probability=0.0))
    return simulate(LINE, Leg(names, start=start, finish=finish), seed=seed, outfit=clean, tunnels=False)


def LINE_WAYS(tracks):
    """Direction in which each track of a path is run."""
    ends = [-1] * len(tracks)
    for i in range(len(tracks) - 1):
        for a, e, b, f in [*LINE.movements.tolist(), *[(b, f, a, e) for a, e, b, f in LINE.movements.tolist()]]:
            if (a, b) == (tracks[i], tracks[i + 1]):
                ends[i] = 1 if e == 1 else -1
                ends[i + 1] = 1 if f == 0 else -1
    return ends


@pytest.mark.parametrize("part", range(4))
def test_every_turnout_is_passed_the_way_the_train_went(part):
    assert len(MOVEMENTS) > 60
    sure = wrong = 0
    for i, movement in enumerate(MOVEMENTS[part::4]):
        run, truth = passage(*movement, seed=i)
        solution = navigate(run, LINE)
        assert len(find_jumps(solution, LINE).illegal) == 0
        k = np.clip(np.searchsorted(truth.time, solution.time + 1e-4) - 1, 0, len(truth.time) - 1)
        index = np.array([LINE.track_index(t) for t in truth.track_id])
        true, offset = index[truth.track[k]], truth.offset[k]
        edge = np.minimum(offset, LINE.lengths[true] - offset) < 5.0  # within a sigma of the boundary
        claimed = np.isin(solution.mode, (Mode.TRACKING, Mode.COASTING)) & ~edge
        sure += int(claimed.sum())
        wrong += int((claimed & (solution.track != true)).sum())
        names = f"{LINE.track_id[movement[0]]} -> {LINE.track_id[movement[2]]}"
        assert solution.track[-1] == true[-1] or not claimed[-1], names
    assert wrong == 0
    assert sure > 1000
