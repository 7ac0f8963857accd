"""The main job end to end, on the data that users bring: a network and a run in, a position with its error out."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

import railnav as rn
from railnav.cli import main


def railnav(*words):
    """Run the command line; the JSON that it prints."""
    result = CliRunner().invoke(main, [str(word) for word in words] + ["--json"])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def sample(shared_data, tmp_path_factory):
    """The simulated sample run of the shared data, navigated forward and smoothed from the command line."""
    folder = tmp_path_factory.mktemp("sample")
    run = shared_data / "sample_run"
    railnav("import", run / "network.geojson", "-o", folder / "s.gpkg")
    railnav("navigate", run, "-m", folder / "s.gpkg", "-o", folder / "s.csv")
    railnav("navigate", run, "-m", folder / "s.gpkg", "-o", folder / "smooth.csv", "--smooth")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("file", "rms"), [("s.csv", 1.0), ("smooth.csv", 0.5)])
def test_sample_run_is_on_its_track_within_a_metre(sample, shared_data, file, rms):
    model = rn.TrackModel.read(sample / "s.gpkg")
    evaluation = rn.evaluate(
        rn.read_solution(sample / file), rn.read_truth(shared_data / "sample_run" / "truth.csv"), model=model
    )
    assert evaluation.positioned == evaluation.epochs
    assert evaluation.along_statistics.rms < rms
    assert evaluation.selection.right == evaluation.selection.rows  # every epoch on the right track
    assert evaluation.jumps.illegal == ()
    assert evaluation.integrity.events == 0
    assert evaluation.consistency.inside


@pytest.mark.slow
def test_smoothing_helps(sample, shared_data):
    truth = rn.read_truth(shared_data / "sample_run" / "truth.csv")
    forward, smooth = (rn.evaluate(rn.read_solution(sample / f), truth) for f in ("s.csv", "smooth.csv"))
    assert smooth.along_statistics.rms < 0.6 * forward.along_statistics.rms


@pytest.mark.slow
def test_a_real_line_is_built_and_a_run_that_it_did_not_see_is_held_to_it(shared_data, tmp_path):
    """Six iPhone runs make a model; a seventh is navigated: lawful, smooth in chainage, and honest about the track."""
    runs = sorted((shared_data / "line80").glob("*_iphone"))
    unseen, seen = runs[-1], runs[:-1]
    facts = railnav("build", *seen, "-o", tmp_path / "line.gpkg")
    assert facts
    model = rn.TrackModel.read(tmp_path / "line.gpkg")
    assert len(model.track_id) == 2
    assert all(120e3 < length < 127e3 for length in model.lengths)
    solution = rn.navigate(rn.Run.read(unseen), model)
    placed = solution.track >= 0
    assert placed.mean() > 0.99
    # two tracks without a turnout: no change of track while the navigator is sure of one
    sure = np.flatnonzero(placed & np.isin(solution.mode, [rn.Mode.TRACKING, rn.Mode.COASTING]))
    steps = np.diff(sure) == 1
    assert not (np.diff(solution.track[sure])[steps] != 0).any()
    speed = np.abs(np.gradient(solution.offset[sure], solution.time[sure]))
    assert np.quantile(speed, 0.999) < 60.0
