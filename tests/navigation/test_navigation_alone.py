"""Receivers alone: what nothing but the fixes tells must not be learnt from their noise; and turnouts passed without any fix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from railnav.evaluation import compare
from railnav.geodesy.grid import choose_frame
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
from railnav.simulation.sensors import ImuSensor
from railnav.track.assembly import TrackSection, assemble

#: The peers' receiver: 3 m white, 2 m coloured.
ROUGH = GnssSensor(
    white_horizontal=3.0, white_vertical=5.0, coloured_horizontal=2.0, coloured_vertical=4.0, speed_sigma=0.1
)


@pytest.fixture(scope="module")
def long_way(line):
    return Leg(line.routes("77R-01", "77R-13")[0].tracks, start=60.0)


def test_a_receiver_alone_does_not_shift_its_own_stamps(line, long_way):
    """Twenty kilometres of GNSS alone: stamps and latency that follow the noise take the train along by metres, all one way."""
    squares, means, inside = [], [], []
    for seed in (41, 42, 43):
        run, truth = simulate(line, long_way, seed=seed, outfit=Outfit("gnss", gnss=ROUGH), tunnels=False)
        solution = navigate(run, line, integrity_risk=0.05)
        c = compare(solution, truth)
        late = np.isfinite(c.along) & (c.time > 33.0) & (c.time < 200.0)
        squares.append(np.mean(c.along[late] ** 2))
        means.append(np.mean(c.along[late]))
        inside.append(np.mean(np.abs(c.along[late]) <= solution.protection_level_along[c.row[late]]))
    assert np.sqrt(np.mean(squares)) < 2.0
    assert abs(np.mean(means)) < 1.0
    assert np.mean(inside) > 0.9


def shifted(run, model, metres, begin, end):
    """The run with the fixes of a while moved ahead along their course."""
    gnss = run.gnss
    moved = (gnss.time >= begin) & (gnss.time < end)
    course = np.nan_to_num(gnss.course)
    latitude = gnss.latitude + np.where(moved, metres * np.cos(course) / 6.37e6, 0.0)
    longitude = gnss.longitude + np.where(moved, metres * np.sin(course) / (6.37e6 * np.cos(gnss.latitude)), 0.0)
    return replace(run, gnss=replace(gnss, latitude=latitude, longitude=longitude))


def test_a_jump_that_stays_was_the_place_and_one_that_goes_the_receiver(line):
    """Fixes jump ahead by 200 m. After half a minute the train is where they stay, or where it was when they have come back."""
    run, truth = simulate(
        line,
        Leg(("77R-03",), start=300.0, finish=6000.0),
        seed=7,
        outfit=Outfit("gnss", gnss=GnssSensor()),
        tunnels=False,
    )
    for last, shift in ((np.inf, 200.0), (108.0, 0.0)):
        solution = navigate(shifted(run, line, 200.0, 100.0, last), line)
        c = compare(solution, truth)
        after = np.flatnonzero((c.time > 140.0) & (c.time < 170.0) & np.isfinite(c.along))
        assert len(after) > 20
        assert np.abs(c.along[after] - shift).max() < 25.0
        during = np.flatnonzero((c.time > 103.0) & (c.time < 108.0) & np.isfinite(c.along))
        both = np.minimum(np.abs(c.along[during]), np.abs(c.along[during] - 200.0))
        assert (both <= solution.protection_level_along[c.row[during]]).all()


def straight_with_a_crossover():
    """Two straight tracks 4.5 m apart, and a crossover from the right one to the left 6 km on."""
    frame = choose_frame(0.88, 0.19)
    e, n, *_ = frame.to_grid(0.88, 0.19, 200.0)
    placed = place_axis(
        frame,
        [Element(8000.0)],
        Profile.of(200.0, [(0.0, 0.0)], radius=5000.0),
        easting=float(e),
        northing=float(n),
        grid_bearing=1.0,
    )
    cross, station = connecting_track(
        placed, 6000.0, 2.25, turnout_connection(-4.5, number=9, radius=300.0), spacing=2.0
    )
    sections = [TrackSection("X", cross)]
    for side, lateral, at in (("R", 2.25, float(station[0])), ("L", -2.25, float(station[-1]))):
        for i, (a, b) in enumerate(((0.0, at), (at, 8000.0))):
            sections.append(TrackSection(f"{side}{i}", parallel_track(placed, a, b, lateral, spacing=2.0)[0]))
    return assemble(frame, sections)


def test_a_crossover_in_a_long_gap_is_not_ruled_out_before_its_toe():
    """Without a fix the place is known to a dozen metres only: that the train has not turned yet tells nothing of a toe ahead."""
    model = straight_with_a_crossover()
    for seed in (2, 3):
        run, truth = simulate(
            model,
            Leg(("R0", "X", "L1"), start=5000.0, finish=1500.0),
            seed=seed,
            outfit=Outfit("imu", gnss=ROUGH, imu=ImuSensor()),
            driving=Driving(speed=16.0),
            outages=[(30.0, 200.0)],
        )
        c = compare(solution := navigate(run, model), truth, joint_within=200.0)
        sure = np.isin(solution.mode[c.row], (Mode.TRACKING, Mode.COASTING)) & (c.time > 33.0) & (c.time < 200.0)
        over = np.array([truth.track_id[t] == "L1" for t in c.true_track]) & (c.time < 200.0)
        assert c.right[over & sure].all()
        assert c.right[over].mean() > 0.99


def test_a_smoothed_solution_names_the_candidates_too(line):
    """Two tracks side by side, no turnout, a receiver alone: rows that are not certain list both, and their probabilities add up."""
    run, _ = simulate(
        line, Leg(("77R-03",), start=300.0, finish=2500.0), seed=3, outfit=Outfit("gnss", gnss=ROUGH), tunnels=False
    )
    solution = navigate(run, line, smooth=True)
    others = solution.alternatives
    open_rows = np.flatnonzero((solution.track_probability < 0.999) & (solution.track >= 0))
    assert len(open_rows) > 10
    for row in open_rows[::10].tolist():
        here = others.row == row
        assert here.sum() >= 2
        assert 0.98 < others.probability[here].sum() < 1.0 + 1e-9
        assert (np.diff(others.probability[here]) <= 0.0).all()
        own = here & (others.track == solution.track[row])
        assert others.probability[own].sum() == pytest.approx(solution.track_probability[row], abs=1e-3)
        assert np.abs(others.offset[own] - solution.offset[row]).min() < 20.0
