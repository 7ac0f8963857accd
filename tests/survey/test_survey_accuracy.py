"""A simulated double line, 2 cm GNSS, three passes a track: is the axis as good as it says, and as good as it should be?"""

import numpy as np
import pytest
from survey_simulator import PHONE, Receiver, axis_error, centre_line, changed, double_line, drive, knots, plane

from railnav.survey import build
from railnav.track.model import TrackModel


@pytest.fixture(scope="module")
def surveyed() -> tuple[TrackModel, list, dict, object]:
    runs, truth, frame = double_line(2)
    return build(runs), runs, truth, frame


def test_two_directions_become_two_tracks_in_one_sense(surveyed):
    model, _, truth, _ = surveyed
    assert model.track_id == ("up", "down")
    for name in model.track_id:
        k = knots(model, name)
        _, at = truth[name].right_of(model.easting[k], model.northing[k])
        assert at[-1] - at[0] > 7500  # offsets grow as the first run went, on both tracks
    e, n = (
        np.interp(3000.0, model.offset[knots(model, "up")], v[knots(model, "up")])
        for v in (model.easting, model.northing)
    )
    beside = [c for c in model.locate(e, n, within=10.0) if c.track == "down"]
    assert beside[0].distance == pytest.approx(4.0, abs=0.05)


@pytest.mark.parametrize("name", ["up", "down"])
def test_axis_within_a_centimetre_and_length_within_20_ppm(surveyed, name):
    model, _, truth, frame = surveyed
    k = knots(model, name)
    error, _ = axis_error(model, name, truth[name])
    assert np.sqrt(np.mean(error**2)) < 0.010
    assert np.abs(error).max() < 0.05
    T = truth[name]
    _, at = T.right_of(model.easting[k], model.northing[k])
    a, b = at[0], at[-1]
    steps = frame.ground_length(
        T.east[a:b], T.north[a:b], T.height[a:b], T.east[a + 1 : b + 1], T.north[a + 1 : b + 1], T.height[a + 1 : b + 1]
    )
    true_length = float(np.sum(steps))
    for end, i, sign in ((a, 0, -1.0), (b, -1, 1.0)):  # what the ends lie beyond the nearest true points
        east, north = model.easting[k][i] - T.east[end], model.northing[k][i] - T.north[end]
        true_length += sign * (east * np.sin(T.bearing[end]) + north * np.cos(T.bearing[end]))
    assert model.length(name) == pytest.approx(true_length, rel=20e-6)


@pytest.mark.parametrize("name", ["up", "down"])
def test_curvature_keeps_the_clothoids(surveyed, name):
    model, _, truth, _ = surveyed
    k = knots(model, name)
    T = truth[name]
    _, at = T.right_of(model.easting[k], model.northing[k])
    inner = slice(50, -50)
    error = model.curvature[k][inner] - T.curvature[at][inner]
    assert np.sqrt(np.mean(error**2)) < 6e-5  # a sixtieth of a 300 m curve
    rise = (
        np.abs(np.gradient(T.curvature)[at][inner]) > 3e-5
    )  # on the steepest clothoids no bias: nothing is smoothed away
    toward = np.sign(T.curvature[at][inner])
    assert abs(np.mean((error * toward)[rise])) < 4e-5


@pytest.mark.parametrize("seed", [0, 2])
def test_curvature_of_a_rough_survey_is_what_its_covariance_supports(seed):
    """Phones, nodes 20 m apart: corrections to a nominal curve may not zigzag about it, nor turn the ends into tight curves."""
    frame, rng = plane(), np.random.default_rng([seed, 5])
    axis = centre_line(seed, 6.0, frame=frame)
    model = build([drive(axis, frame, rng, run_id=f"p{p}", direction="up", day=p, receiver=PHONE) for p in range(4)])
    k = knots(model, "up")
    error = model.curvature[k] - axis.curvature[axis.right_of(model.easting[k], model.northing[k])[1]]
    assert np.sqrt(np.mean(error**2)) < 3e-4  # half of what corrections at nodes alone left
    assert np.abs(model.curvature[k]).max() < 1.25 * np.abs(axis.curvature).max()
    assert np.abs(np.concatenate([error[:60], error[-60:]])).max() < 2.5e-3
    bends = np.diff(model.curvature[k][::20])
    assert np.mean(bends[1:] * bends[:-1] < 0) < 0.5  # changes of curvature follow each other, they do not alternate


def test_heights_where_present(surveyed):
    model, _, truth, _ = surveyed
    for name in model.track_id:
        k = knots(model, name)
        _, at = truth[name].right_of(model.easting[k], model.northing[k])
        assert np.sqrt(np.mean((model.height[k] - truth[name].height[at]) ** 2)) < 0.025
    assert all(track["heights"] for track in model.provenance["build"]["tracks"])


def test_without_heights_the_model_says_so():
    runs, _, _ = double_line(2, km=2.0)
    model = build([changed(run, height=None) for run in runs])
    assert np.isnan(model.height).all()
    assert np.isnan(model.covariance_g[:, 5]).all()
    assert np.isfinite(model.covariance_g[:, [0, 1, 3]]).all()
    assert not any(track["heights"] for track in model.provenance["build"]["tracks"])


def test_the_covariance_is_honest():
    across, up = [], []
    for seed in (0, 1, 2, 3, 5, 6):
        runs, truth, _ = double_line(seed)
        model = build(runs)
        for name in model.track_id:
            error, sigma = axis_error(model, name, truth[name])
            across.append(np.mean((error / sigma) ** 2))
            k = knots(model, name)
            _, at = truth[name].right_of(model.easting[k], model.northing[k])
            up.append(np.mean((model.height[k] - truth[name].height[at]) ** 2 / model.covariance_g[k, 5]))
    assert 0.8 < np.mean(across) < 1.2
    assert 0.7 < np.mean(up) < 1.3


def test_errors_that_wander_are_not_averaged_as_white():
    wandering = Receiver("survey", white=0.004, correlated=0.020, memory=60.0, rate=1.0)
    across, sigmas = [], []
    for seed in (0, 1, 2, 3):
        runs, truth, _ = double_line(seed, receivers=(wandering,))
        model = build(runs)
        for name in model.track_id:
            error, sigma = axis_error(model, name, truth[name])
            across.append(np.mean((error / sigma) ** 2))
            sigmas.append(np.median(sigma))
    assert 0.6 < np.mean(across) < 1.5
    assert np.median(sigmas) > 0.008  # 20 mm over the root of three passes, however many fixes there are


def test_phones_alone():
    runs, truth, _ = double_line(4, receivers=(PHONE,), passes=4)
    model = build(runs)
    for name in model.track_id:
        error, sigma = axis_error(model, name, truth[name])
        assert np.sqrt(np.mean(error**2)) < 2.0
        assert 0.6 < np.median(sigma) < 2.5
        assert np.mean((error / sigma) ** 2) < 2.5
