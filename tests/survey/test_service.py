"""Service runs refine a model: what they say of the axis, how honestly, and that tracks which met still meet. All simulated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import railnav as rn
from railnav.errors import RunError
from railnav.simulation import SERVICE, SURVEY, Leg, demo_line, simulate
from railnav.survey.service import SPACING, cross_sigma, refine_from_service

TRACKS = ("77R-02", "77R-03", "77R-04")


@pytest.fixture(scope="module")
def line():
    return demo_line(spacing=2.0)


def mistaken(line, seed, *, sigma=0.5, length=200.0):
    """The line as a map would have it: each axis wanders by half a metre, ends of tracks kept where they are; and it says so."""
    random = np.random.default_rng(seed)
    easting, northing, bearing = line.easting.copy(), line.northing.copy(), line.grid_bearing.copy()
    for track in line.track_id:
        k = line.knots(track)
        s, phi = line.offset[k], np.exp(-SPACING / length)
        wander = np.empty(int(np.ceil(s[-1] / SPACING)) + 2)
        wander[0] = random.normal(0.0, sigma)
        for i in range(1, len(wander)):
            wander[i] = phi * wander[i - 1] + random.normal(0.0, sigma * np.sqrt(1.0 - phi * phi))
        calm = np.clip(np.minimum(s, s[-1] - s) / min(200.0, 0.5 * s[-1]), 0.0, 1.0) ** 2
        aside = calm * CubicSpline(SPACING * np.arange(len(wander)), wander)(s)
        b = bearing[k].copy()
        easting[k] += aside * np.cos(b)
        northing[k] -= aside * np.sin(b)
        bearing[k] = b + np.arctan(np.gradient(aside, s))
    covariance = np.full((len(easting), 6), np.nan)
    covariance[:, [0, 3]], covariance[:, 1] = sigma**2, 0.0
    return replace(line, easting=easting, northing=northing, grid_bearing=bearing, covariance_g=covariance)


def across(model, line, track):
    """Distance of a model's axis from the true one and its stated sigma, every 50 m, m."""
    k = model.knots(track)
    sigma = cross_sigma(model, track)
    error, stated = [], []
    for i in range(k.start + 50, k.stop - 50, 25):
        for foot in line.locate(float(model.easting[i]), float(model.northing[i]), within=6.0):
            if foot.track == track:
                error.append(foot.cross)
                stated.append(sigma[i - k.start])
    return np.array(error), np.array(stated)


def ride(line, seed, *, backwards=False, outfit=SERVICE, finish=4000.0):
    leg = Leg(TRACKS[:2], start=10.0, finish=finish)
    if backwards:
        leg = Leg(("77R-03", "77R-02"), start=finish, finish=10.0)
    return simulate(line, leg, seed=seed, outfit=outfit, tunnels=False, run_id=f"train-{seed}")[0]


def test_accurate_trains_bring_a_poor_map_to_centimetres(line):
    model = mistaken(line, 1)
    before, _ = across(model, line, "77R-03")
    runs = [ride(line, seed, backwards=seed == 2, outfit=replace(SURVEY, gauge=None)) for seed in (1, 2)]
    refined = refine_from_service(model, runs)
    after, sigma = across(refined, line, "77R-03")
    seen = np.arange(len(after)) < len(after) * 3700 / 9900  # the trains ran over the first part alone
    assert np.sqrt(np.mean(before[seen] ** 2)) > 0.3
    assert np.sqrt(np.mean(after[seen] ** 2)) < 0.06
    assert np.mean((after[seen] / sigma[seen]) ** 2) < 3.0
    np.testing.assert_allclose(after[~seen][20:], before[~seen][20:], atol=0.1)  # beyond, nothing is known better
    assert np.median(sigma[seen]) < 0.06 < 0.3 < np.median(sigma[~seen][20:])


def test_tracks_that_met_still_meet_and_go_on_straight(line):
    refined = refine_from_service(mistaken(line, 2), [ride(line, 3, outfit=replace(SURVEY, gauge=None))])
    ends = {}
    for i, track in enumerate(refined.track_id):
        k = refined.knots(track)
        for node, at in ((refined.start_node[i], k.start), (refined.end_node[i], k.stop - 1)):
            ends.setdefault(int(node), []).append((refined.easting[at], refined.northing[at]))
    assert max(np.ptp(np.array(p), axis=0).max() for p in ends.values() if len(p) > 1) < 0.005
    assert not [d for d in rn.validate(refined) if d.where.startswith(("77R-02", "77R-03"))]
    entry = refined.provenance["service"][-1]
    assert entry["runs"][0]["tracks"] == ["77R-02", "77R-03"]
    assert {t["track"] for t in entry["tracks"]} == {"77R-02", "77R-03"}
    assert all(t["sigma_m"] <= t["sigma_before_m"] for t in entry["tracks"])


@pytest.mark.slow
def test_everyday_receivers_help_little_and_say_so(line):
    """1.5 m errors that last a minute: six trains take a map's 0.45 m to less, and the covariance tells how much (NEES)."""
    gained, honest = [], []
    for seed in range(5):
        model = mistaken(line, 10 + seed)
        before, _ = across(model, line, "77R-03")
        runs = [ride(line, 100 * seed + k, backwards=k % 2 == 1, finish=9000.0) for k in range(4)]
        after, sigma = across(refine_from_service(model, runs), line, "77R-03")
        gained.append((np.mean(before**2), np.mean(after**2)))
        honest.append(np.mean((after / sigma) ** 2))
    before, after = np.sqrt(np.mean(gained, axis=0))
    assert after < before
    assert 0.4 < np.mean(honest) < 1.6


def test_a_model_that_states_nothing_is_taken_for_metres(line):
    model = replace(mistaken(line, 4), covariance_g=np.full_like(line.covariance_g, np.nan))
    refined = refine_from_service(model, [ride(line, 5, outfit=replace(SURVEY, gauge=None), finish=2000.0)])
    sigma = cross_sigma(refined, "77R-03")
    assert sigma[200] < 0.1
    assert sigma[-200] == pytest.approx(2.0, rel=0.2)


def test_runs_that_cannot_help_are_refused(line):
    with pytest.raises(RunError, match="no runs"):
        refine_from_service(line, [])
    run = ride(line, 6, finish=600.0)
    with pytest.raises(RunError, match="none of the 1 runs"):
        refine_from_service(line, [replace(run, gnss=None, imu=None)])
