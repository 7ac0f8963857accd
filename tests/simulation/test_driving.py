"""Journeys are lawful, and the driver keeps every limit."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.errors import TrackError
from railnav.simulation import Driving, Leg, Stop, drive, path_of, simulate
from railnav.simulation.driving import speed_limit
from railnav.simulation.journey import directions

STATION = ("77R-03", "77R-04", "77R-05", "77S-1", "77R-07")
LEG = Leg(STATION, start=7800.0, finish=60.0, stops=(Stop("77S-1", 700.0, 25.0),), dwell=15.0)


def test_directions_follow_the_movements(line):
    assert directions(line, ["77R-02", "77R-03"]) == (1, 1)
    assert directions(line, ["77R-03", "77R-02"]) == (-1, -1)
    assert directions(line, ["77L-02", "77X-01", "77R-01"]) == (-1, -1, -1)
    with pytest.raises(TrackError, match="no permitted movement"):
        directions(line, ["77R-01", "77X-02"])
    with pytest.raises(TrackError, match="no track"):
        directions(line, ["77R-01", "nowhere"])


def test_path_positions_are_continuous(line):
    path = path_of(line, LEG)
    run = np.linspace(0.0, path.length, 20_001)
    here = path.at(run)
    step = np.hypot(np.diff(here.easting), np.diff(here.northing))
    assert step.max() == pytest.approx(path.length / 20_000, rel=1e-3)
    track, offset = path.locate(np.array([0.0, path.length]))
    assert [line.track_id[t] for t in track] == ["77R-03", "77R-07"]
    np.testing.assert_allclose(offset, [7800.0, 60.0], atol=1e-9)


@pytest.fixture(scope="module")
def motion(line):
    return drive(path_of(line, LEG), Driving())


def test_acceleration_and_jerk_stay_inside(line, motion):
    limits = Driving()
    time = np.arange(0.0, motion.duration, 0.01)
    distance, speed, acceleration = motion.at(time)
    assert acceleration.max() <= limits.acceleration + 1e-9
    assert acceleration.min() >= -limits.braking - 1e-9
    assert np.abs(np.diff(acceleration)).max() / 0.01 <= limits.jerk + 1e-6
    assert np.diff(distance).min() >= -1e-9
    assert speed.min() >= -1e-9
    # the parts of the motion are derivatives of each other
    np.testing.assert_allclose(np.gradient(distance, 0.01)[1:-1], speed[1:-1], atol=2e-5)
    np.testing.assert_allclose(np.gradient(speed, 0.01)[1:-1], acceleration[1:-1], atol=5e-3)


def test_speed_keeps_to_curves_and_turnouts(line, motion):
    path, limits = path_of(line, LEG), Driving()
    time = np.arange(0.0, motion.duration, 0.05)
    distance, speed, _ = motion.at(time)
    distance = np.clip(distance, 0.0, path.length)
    assert (speed <= speed_limit(path, limits, distance) + 1e-9).all()
    here = path.at(distance)
    lateral = speed**2 * here.curvature - 9.80665 * here.cant / 1.5
    moving = speed > 5.0
    assert (lateral * np.sign(here.curvature))[moving].max() <= limits.lateral + 1e-6
    on_branch = distance[np.abs(here.curvature) > 1 / 305.0]
    assert len(on_branch) > 0
    assert speed[np.abs(here.curvature) > 1 / 305.0].max() == pytest.approx(14.0, abs=0.6)  # 50 km/h through 1:9 R=300


def test_stops_are_kept_to_the_place_and_the_second(line, motion):
    path = path_of(line, LEG)
    time = np.arange(0.0, motion.duration, 0.01)
    distance, speed, _ = motion.at(time)
    platform = path.halts[0].distance
    assert path.locate(platform)[1] == pytest.approx(700.0)
    standing = speed < 1e-6
    at_platform = standing & (np.abs(distance - platform) < 1e-6)
    assert at_platform.sum() * 0.01 == pytest.approx(25.0, abs=0.15)
    assert (standing & (distance < 1.0)).sum() * 0.01 == pytest.approx(Driving().first_standstill, abs=0.15)
    assert distance[-1] == pytest.approx(path.length, abs=1e-6)
    assert standing[-1]
    # nowhere else does it stand
    near = np.abs(distance[standing][:, None] - np.array([0.0, platform, path.length])).min(axis=1)
    assert near.max() < 1e-4


def test_work_done_is_energy_gained(line, motion):
    time = np.arange(0.0, motion.duration, 0.01)
    _, speed, acceleration = motion.at(time)
    work = np.append(0.0, np.cumsum(0.5 * (speed[1:] * acceleration[1:] + speed[:-1] * acceleration[:-1]) * 0.01))
    np.testing.assert_allclose(work, 0.5 * speed**2, atol=2e-3)


def test_running_back_mirrors_the_motion(line):
    tracks = ("77R-02", "77R-03")
    there = path_of(line, Leg(tracks, start=0.0, finish=3000.0, dwell=20.0))
    back = path_of(line, Leg(tracks[::-1], start=3000.0, finish=0.0, dwell=20.0))
    a, b = drive(there), drive(back)
    assert a.duration == pytest.approx(b.duration, abs=1e-6)
    time = np.linspace(0.0, a.duration, 500)
    run_there, speed_there, _ = a.at(time)
    run_back, speed_back, _ = b.at(a.duration - time)
    np.testing.assert_allclose(run_there, there.length - run_back, atol=1e-5)
    np.testing.assert_allclose(speed_there, speed_back, atol=1e-6)


def test_backing_up_keeps_the_nose(line):
    legs = [
        Leg(("77R-01", "77R-02"), start=500.0, finish=150.0, dwell=20.0),
        Leg(("77R-02", "77R-01"), finish=600.0, dwell=5.0),
    ]
    _, truth = simulate(line, legs, seed=1)
    moving = np.abs(truth.speed) > 0.5
    forward, backward = truth.speed > 0.5, truth.speed < -0.5
    assert forward.any()
    assert backward.any()
    turn = np.unwrap(truth.heading)
    assert np.ptp(turn) < 0.01
    assert (np.diff(truth.time) > 0).all()
    last_forward = np.flatnonzero(forward)[-1]
    assert np.flatnonzero(backward)[0] > last_forward
    assert truth.offset[-1] == pytest.approx(600.0, abs=1e-6)
    assert truth.track_id[truth.track[-1]] == "77R-01"
    assert moving.sum() < len(truth)


def test_zigzag_over_a_crossover(line):
    # from the left track over 77X-01 backwards is lawful only by reversing: two legs
    legs = [Leg(("77R-01", "77X-01", "77L-02"), start=300.0, finish=20.0), Leg(("77L-02", "77L-01"), finish=300.0)]
    path = path_of(line, legs)
    assert path.gear.tolist() == [1, 1, 1, -1, -1]
    assert path.direction.tolist() == [1, 1, 1, -1, -1]
    with pytest.raises(TrackError, match="leg 2 begins"):
        path_of(line, [legs[0], Leg(("77R-01",), start=0.0)])


@pytest.mark.parametrize(
    ("journey", "message"),
    [
        (Leg(("77R-01",), start=-1.0), "not on track"),
        (Leg(("77R-01",), finish=99_999.0), "not on track"),
        (Leg(("77R-01",), start=10.0, finish=10.0), "no length"),
        (Leg(("77R-01", "77R-02"), stops=(Stop("77L-01", 5.0),)), "does not lie on the leg"),
        (Leg(("77R-01",), stops=(Stop("77R-01", 5000.0),)), "does not lie inside"),
        (Leg(("77R-01",), stops=(Stop("77R-01", 500.0), Stop("77R-01", 400.0))), "out of order"),
        ([], "at least one track"),
    ],
)
def test_refusals(line, journey, message):
    with pytest.raises(TrackError, match=message):
        path_of(line, journey)


def test_limits_must_be_positive(line):
    path = path_of(line, Leg(("77R-01",)))
    with pytest.raises(TrackError, match="jerk 0"):
        drive(path, Driving(jerk=0.0))
    with pytest.raises(TrackError, match="negative time"):
        drive(path, Driving(first_standstill=-1.0))
    with pytest.raises(TrackError, match="negative time"):
        drive(path_of(line, Leg(("77R-01",), dwell=-3.0)))
