"""`railnav corridor`: a frame file for a line, its picture, and its use as --crs."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

import railnav
from railnav.cli import main
from railnav.io.frame_file import read_frame, read_frames
from railnav.track.course import course

PLACES = "latitude_deg,longitude_deg,height_m\n55.776,37.655,165\n56.34,36.73,175\n56.835,35.893,\n57.58,34.56,180\n"


def run(*arguments, ok=True):
    done = CliRunner().invoke(main, [str(a) for a in arguments])
    assert (done.exit_code == 0) == ok, done.output
    return done.output


def test_a_table_of_places(tmp_path):
    (tmp_path / "line.csv").write_text(PLACES)
    facts = json.loads(run("corridor", tmp_path / "line.csv", "-o", tmp_path / "a.toml", "--section-km", 150, "--json"))
    assert len(facts["sections"]) == 2
    assert facts["largest_ppm"] < 2.0
    assert facts["length_m"] == pytest.approx(281e3, abs=5e3)
    assert len(facts["junctions"]) == 1
    first, second = read_frames(tmp_path / "a.toml")
    junction = facts["junctions"][0]
    np.testing.assert_allclose(
        first.to_geodetic(*junction["before_m"], None)[:2],
        second.to_geodetic(*junction["after_m"], None)[:2],
        atol=1e-9,
    )
    words = run(
        "corridor", tmp_path / "line.csv", "-o", tmp_path / "b.toml", "--plot", tmp_path / "b.png", "--base", "7683"
    )
    assert "Gauss-Kruger zone" in words
    assert (tmp_path / "b.png").stat().st_size > 10_000
    assert "GSK-2011" in read_frame(tmp_path / "b.toml").crs_wkt


def test_a_model_moves_into_its_corridor(tmp_path):
    model = railnav.demo_line()
    model.to_file(tmp_path / "line.gpkg")
    facts = json.loads(run("corridor", tmp_path / "line.gpkg", "-o", tmp_path / "c.toml", "--json"))
    assert facts["largest_ppm"] < 8.0  # heights vary by 70 m or so along the demo line
    run("convert", tmp_path / "line.gpkg", "-o", tmp_path / "line.geojson")
    run("import", tmp_path / "line.geojson", "--crs", tmp_path / "c.toml", "-o", tmp_path / "moved.gpkg")
    moved = railnav.TrackModel.read(tmp_path / "moved.gpkg")
    assert moved.frame == read_frame(tmp_path / "c.toml")
    # lengths on the ground are lengths in the plane: scale is 1 to what the corridor promises
    assert np.abs(moved.scale - 1.0).max() * 1e6 < facts["largest_ppm"] + 1.0
    np.testing.assert_allclose(sorted(moved.lengths), sorted(model.lengths), rtol=2e-5)


def test_the_course_of_a_model():
    model = railnav.demo_line()
    latitude, longitude, height = course(model, spacing=500.0)
    assert len(latitude) == len(longitude) == len(height)
    east, north, _ = model.frame.to_grid(latitude, longitude, height)
    assert (
        max(min(c.distance for c in model.locate(e, n, within=500.0)) for e, n in zip(east, north, strict=True)) < 100.0
    )


def test_refusals(tmp_path):
    (tmp_path / "one.csv").write_text("latitude_deg,longitude_deg\n55.0,37.0\n")
    assert "two points" in run("corridor", tmp_path / "one.csv", "-o", tmp_path / "x.toml", ok=False)
    assert "no such file" in run("corridor", tmp_path / "none.gpkg", "-o", tmp_path / "x.toml", ok=False)
    assert "use .toml" in run("corridor", tmp_path / "one.csv", "-o", tmp_path / "x.txt", ok=False)
    assert not (tmp_path / "x.toml").exists()
