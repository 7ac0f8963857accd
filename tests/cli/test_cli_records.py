"""`railnav update` and `railnav diff` on files, as a user would."""

import json

import pytest
from click.testing import CliRunner

from railnav.cli import main


def call(*words):
    return CliRunner().invoke(main, [str(w) for w in words])


@pytest.fixture
def built(stock):
    done = call("build", stock / "survey-1", "-o", stock / "built.gpkg")
    assert done.exit_code == 0, done.output
    return stock


def test_update_then_diff(built):
    done = call("update", built / "built.gpkg", built / "survey-2", "-o", built / "later.gpkg")
    assert done.exit_code == 0, done.output
    assert "survey-2" in done.output
    for name in ("moved.csv", "moved.geojson", "moved.html"):
        done = call("diff", built / "built.gpkg", built / "later.gpkg", "-o", built / name, "--step", 50)
        assert done.exit_code == 0, done.output
        assert "refined from the first" in done.output
    head, *rows = (built / "moved.csv").read_text().splitlines()
    assert head.startswith("track,offset_m,easting_m,northing_m,slew_m,lift_m")
    assert len(rows) > 10
    points = json.loads((built / "moved.geojson").read_text())["features"]
    assert {f["geometry"]["type"] for f in points} <= {"Point", "LineString"}
    assert "Where did the track move?" in (built / "moved.html").read_text()
    told = json.loads(call("diff", built / "built.gpkg", built / "later.gpkg", "--json").output)
    assert told["relation"] == "update"
    assert told["tracks"][0]["slew_rms_m"] < 0.05


def test_json_of_an_update_tells_what_changed(built):
    done = call("update", built / "built.gpkg", built / "survey-2", "-o", built / "later.gpkg", "--json")
    told = json.loads(done.output)["update"]
    assert told["runs"][0]["id"] == "survey-2"
    assert told["tracks"][0]["sigma_m"] < told["tracks"][0]["sigma_before_m"]


@pytest.mark.parametrize(
    ("words", "cause"),
    [
        (("built.gpkg", "survey-1"), "in the model already"),
        (("line.gpkg", "survey-2"), "carries no survey records"),
        (("line.geojson", "survey-2"), "carries no survey records"),
        (("built.gpkg", "survey-2", "--crs", "28409"), "keeps the model's plane"),
    ],
)
def test_refusals_are_one_line(built, words, cause):
    model, run, *rest = words
    done = call("update", built / model, built / run, *rest, "-o", built / "later.gpkg")
    assert done.exit_code == 1
    assert cause in done.output
    assert len(done.output.strip().splitlines()) == 1
    assert not (built / "later.gpkg").exists()


def test_models_in_different_planes_are_not_compared(built):
    assert call("build", built / "survey-2", "-o", built / "other.gpkg", "--zone-width", 3).exit_code == 0
    done = call("diff", built / "built.gpkg", built / "other.gpkg")
    assert done.exit_code == 1
    assert "different planes" in done.output
