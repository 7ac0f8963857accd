"""What the model's survey knows goes into the start; what the start could not know comes in later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import railnav as rn
from railnav.navigation.prior import FramePrior, frame_prior, usual_directions
from railnav.run import GnssStream, Run
from railnav.track import TrackSection, assemble, fit_alignment

REPORT = {
    "receivers": [
        {
            "receiver": "ublox",
            "offset_east_m": -1.3,
            "offset_north_m": -5.0,
            "sigma_east_m": 0.3,
            "sigma_north_m": 0.4,
            "scatter_m": 1.2,
        }
    ],
    "datum": {"sigma_east_m": 3.0, "sigma_north_m": 4.0},
    "runs": [{"direction": "up", "tracks": ["up"]}, {"direction": "down", "tracks": ["down"]}],
}


@pytest.fixture(scope="module")
def double_line():
    """Two straight tracks 4 m apart, 6 km, run one way each; "up" begins 300 m later than "down" ends."""
    frame = rn.demo_line().frame
    east, north = frame.to_grid(np.radians(50.6), np.radians(7.9))[:2]
    up = fit_alignment(frame, east + np.array([300.0, 6000.0]), north + np.zeros(2))
    down = fit_alignment(frame, east + np.array([6000.0, 0.0]), north + np.full(2, 4.0))
    model = assemble(frame, [TrackSection("up", up), TrackSection("down", down)])
    return replace(model, provenance={"build": REPORT}), float(east), float(north)


def drive(frame, east, north, *, receiver="", bias=(0.0, 0.0), seed=1, sigma=1.0):
    """A train on the axis of "up", eastward at 30 m/s, from where only "down" is near; GNSS once a second."""
    time = np.arange(190.0)
    random = np.random.default_rng(seed)
    coloured = np.zeros((len(time), 2))
    for i in range(1, len(time)):
        coloured[i] = coloured[i - 1] * np.exp(-1 / 60) + random.normal(0, sigma * np.sqrt(1 - np.exp(-2 / 60)), 2)
    error = coloured + random.normal(0, 0.3, (len(time), 2)) + bias
    latitude, longitude, _ = frame.to_geodetic(east + 20.0 + 30.0 * time + error[:, 0], north + error[:, 1])
    gnss = GnssStream(
        time,
        latitude,
        longitude,
        sigma_east=np.full(len(time), sigma),
        sigma_north=np.full(len(time), sigma),
        speed=np.full(len(time), 30.0),
        course=np.full(len(time), np.radians(90.0) + float(frame.convergence(east, north))),
        sigma_speed=np.full(len(time), 0.2),
        receiver=receiver,
    )
    from datetime import UTC, datetime

    return Run("r", datetime(2026, 1, 1, tzinfo=UTC), gnss=gnss)


def test_a_known_receiver_brings_its_offset_and_an_unknown_one_the_datums_doubt(double_line):
    model, _, _ = double_line
    known = frame_prior(model, "ublox")
    assert (known.east, known.north, known.known) == (-1.3, -5.0, True)
    assert known.sigma == pytest.approx(np.hypot(1.2, 0.5 / np.sqrt(2)))
    other = frame_prior(model, "phone")
    assert other == FramePrior(0.0, 0.0, pytest.approx(5.0 / np.sqrt(2)), False)
    assert frame_prior(replace(model, provenance={}), "ublox") == FramePrior()


def test_tracks_run_one_way_only_when_the_survey_says_so(double_line):
    model, _, _ = double_line
    assert usual_directions(model).tolist() == [1, 1]  # the tracks' offsets grow as their own runs went
    assert usual_directions(replace(model, provenance={})).tolist() == [0, 0]
    one_name = {"runs": [{"direction": "up", "tracks": ["up"]}, {"direction": "up", "tracks": ["down"]}]}
    assert usual_directions(replace(model, provenance={"build": one_name})).tolist() == [0, 0]


def test_a_track_out_of_reach_at_the_start_is_found_later(double_line):
    model, east, north = double_line
    here = {
        **REPORT["receivers"][0],
        "receiver": "rover",
        "offset_east_m": 0.0,
        "offset_north_m": 0.0,
        "scatter_m": 0.3,
    }
    model = replace(model, provenance={"build": {**REPORT, "receivers": [here]}})
    found, sure_of_the_wrong = 0, []
    for seed in range(6):
        solution = rn.navigate(drive(model.frame, east, north, receiver="rover", seed=seed), model)
        assert solution.track[0] == 1  # nothing else is near
        late = solution.time > 120.0
        sure_of_the_wrong.append(((solution.track == 1) & (solution.mode == rn.Mode.TRACKING))[late].mean())
        found += (solution.track[late] == 0).mean() > 0.9
        for i in np.flatnonzero(
            np.diff(solution.track)
        ):  # never from track to track: a row without a position stands between
            assert -1 in solution.track[i : i + 2]
    assert found >= 3
    assert np.mean(sure_of_the_wrong) < 0.1


def test_a_known_offset_is_taken_off_before_it_chooses_the_track(double_line):
    """A receiver that reads 5 m north of the datum would be put on the other track, 4 m north."""
    model, east, north = double_line
    shifted = {**REPORT["receivers"][0], "offset_east_m": 0.0, "offset_north_m": 5.0}
    model = replace(model, provenance={"build": {**REPORT, "runs": [], "receivers": [shifted]}})
    run = drive(model.frame, east + 400.0, north, receiver="ublox", bias=(0.0, 5.0))
    with_survey = rn.navigate(run, model)
    assert (with_survey.track == 0).mean() > 0.9
    without = rn.navigate(run, replace(model, provenance={}))
    assert (without.track == 0).mean() < 0.5


def test_the_usual_way_of_a_track_that_is_run_against_its_offsets(double_line):
    """A build lets the offsets of all tracks of a line grow as its first run went: trains of the other direction run against them."""
    frame = rn.demo_line().frame
    east, north = frame.to_grid(np.radians(50.6), np.radians(7.9))[:2]
    same = [
        TrackSection(name, fit_alignment(frame, east + np.array([0.0, 6000.0]), north + np.full(2, aside)))
        for name, aside in (("up", 0.0), ("down", 4.0))
    ]
    model = replace(assemble(frame, same), provenance={"build": REPORT})
    assert usual_directions(model).tolist() == [1, -1]
    told = [{**run, "sense": sense} for run, sense in zip(REPORT["runs"], (-1, 1), strict=True)]
    assert usual_directions(replace(model, provenance={"build": {**REPORT, "runs": told}})).tolist() == [-1, 1]


def test_a_lone_candidate_is_not_declared_where_another_track_begins_near(double_line):
    """Out of reach of "up", which begins 280 m on: the train may be making for it, and is not said to be on "down" for certain."""
    model, east, north = double_line
    solution = rn.navigate(drive(model.frame, east, north), model)
    alone = solution.time < 4.0
    assert (solution.track[alone] == 1).all()
    assert (solution.mode[alone] == rn.Mode.AMBIGUOUS).all()
    assert (
        solution.track_probability[alone].max() < 0.2
    )  # run the unusual way, where the other track is run the usual one


def usual_line(model, sigma):
    """The model with a stated error across its tracks."""
    covariance = np.zeros_like(model.covariance_g)
    covariance[:, [0, 3]] = sigma**2
    return replace(model, covariance_g=covariance, provenance={})


def test_tracks_that_the_model_knows_to_metres_are_not_told_apart_by_gnss(double_line):
    """The same fixes on the same axes: certain of the track where the model is exact, not where its axes may each be 2 m off."""
    model, east, north = double_line
    run = drive(model.frame, east + 400.0, north, sigma=0.5)
    exact = rn.navigate(run, replace(model, provenance={}))
    assert exact.track_probability[150] > 0.999
    assert exact.track[150] == 0
    vague = rn.navigate(run, usual_line(model, 2.0))
    assert vague.track_probability[10:150].max() < 0.99
    assert (vague.mode[10:150] == rn.Mode.AMBIGUOUS).all()
