"""The real line: 122 km of double track, seen by loggers and telephones."""

import numpy as np
import pytest

from railnav.io.run import read_run
from railnav.survey import build


@pytest.fixture(scope="module")
def line80(shared_data):
    return [read_run(d) for d in sorted((shared_data / "line80").iterdir()) if d.name.endswith(("_ublox", "_iphone"))]


@pytest.mark.slow
def test_loggers_alone_cannot_see_their_offset_and_say_so(line80):
    model = build([run for run in line80 if run.gnss.receiver == "ublox"])
    report = model.provenance["build"]
    assert model.track_id == ("fuzesabony-keleti", "keleti-fuzesabony")
    assert all(123e3 < length < 126e3 for length in model.lengths)
    assert not report["datum"]["observable"]
    assert any("cannot be seen" in w for w in report["warnings"])
    assert np.isfinite(model.height).all()


@pytest.mark.slow
def test_with_telephones_the_loggers_offset_shows(line80):
    report = build(line80).provenance["build"]
    kinds = {r["receiver"]: r for r in report["receivers"]}
    north = kinds["ublox"]["offset_north_m"] - kinds["iphone"]["offset_north_m"]
    assert north == pytest.approx(-9.8, abs=1.5)  # "about 9 m south, and some east-west"
    assert any("difference of frames" in w for w in report["warnings"])
    used = sum(run["fixes"]["used"] for run in report["runs"])
    total = sum(run["fixes"]["total"] for run in report["runs"])
    assert total > 250_000
    assert used / total > 0.97
    for track in report["tracks"]:
        assert track["sigma_cross_m"] < 1.5
