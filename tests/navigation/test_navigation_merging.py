"""Ways that part and meet again: what was not certain inside stays uncertain in the smoothed solution, whoever won where they met."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from railnav.evaluation import compare
from railnav.navigation import Mode, navigate
from railnav.simulation import Driving, GnssSensor, Leg, Outfit, simulate
from railnav.simulation.layout import (
    Element,
    Profile,
    connecting_track,
    parallel_track,
    place_axis,
    turnout_connection,
)
from railnav.track import TrackSection, assemble

SEEDS = range(300, 312)


@pytest.fixture(scope="module")
def loop(frame):
    """Five kilometres of straight track with a loop of 750 m at 4.5 m beside it."""
    e0, n0, *_ = frame.to_grid(np.radians(50.0), np.radians(9.0), 0.0)
    profile = Profile.of(200.0, [(0.0, 0.0)], radius=8_000.0)
    placed = place_axis(frame, [Element(5_000.0)], profile, easting=float(e0), northing=float(n0), grid_bearing=1.0)
    beside, station = connecting_track(
        placed, 2_000.0, 0.0, turnout_connection(4.5, number=9, radius=300.0, parallel=750.0), spacing=2.0
    )
    cuts = [0.0, float(station[0]), float(station[-1]), 5_000.0]
    sections = [TrackSection("loop", beside)]
    for name, a, b in zip(("before", "main", "after"), cuts, cuts[1:], strict=False):
        sections.append(TrackSection(name, parallel_track(placed, a, b, 0.0, spacing=2.0)[0]))
    return assemble(frame, sections)


def test_where_ways_meet_again_what_was_uncertain_stays_so(loop):
    """Positions alone tell little inside the loop; on the single track behind it the pasts are one, and none of them is lost."""
    rough = GnssSensor(white_horizontal=3.0, coloured_horizontal=2.0)
    stated, right, sure = [], [], []
    for seed in SEEDS:
        way = ("before", "loop" if seed % 2 else "main", "after")
        run, truth = simulate(
            loop,
            Leg(way, start=800.0, finish=1_500.0),
            seed=seed,
            outfit=Outfit("rough", gnss=rough),
            driving=Driving(speed=25.0),
            tunnels=False,
        )
        run = replace(run, gnss=replace(run.gnss, speed=None, course=None, sigma_speed=None))
        solution = navigate(run, loop, smooth=True)
        c = compare(solution, truth, by="name")
        inside = np.isin(c.true_track, [truth.track_id.index(t) for t in ("loop", "main") if t in truth.track_id])
        rows = c.row[inside]
        stated.append(solution.track_probability[rows])
        right.append(c.right[inside])
        sure.append(np.isin(solution.mode[rows], (Mode.TRACKING, Mode.COASTING)))
        # the candidates of such rows are told, and their probabilities are one
        others = solution.alternatives
        for row in rows[solution.mode[rows] == Mode.AMBIGUOUS][:3]:
            assert others.probability[others.row == row].sum() == pytest.approx(1.0, abs=0.01)
        assert (solution.track_probability <= 1.0).all()
    p, hit, declared = (np.concatenate(a) for a in (stated, right, sure))
    assert hit.mean() > 0.5
    assert p.mean() < 0.98  # positions of 3.6 m, tracks 4.5 m apart: it is not certain, and says so
    assert abs(p.mean() - hit.mean()) < 0.15
    assert (declared & ~hit).sum() <= 0.01 * len(hit)
