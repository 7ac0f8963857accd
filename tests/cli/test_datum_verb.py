"""`railnav datum`: the table, the choices, a pinned plane, a fit, points carried; and frame files as --crs."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from railnav.cli import main
from railnav.errors import InputError
from railnav.geodesy import choose_frame
from railnav.io.frame_file import read_frame, read_frames, write_frames
from railnav.track.model import TrackModel

LOCAL = "+proj=tmerc +lat_0=0 +lon_0=35.48333333333 +k=1 +x_0=2250000 +y_0=-6012900.566 +ellps=krass +units=m +no_defs"


def run(*arguments, ok=True):
    done = CliRunner().invoke(main, [str(a) for a in arguments])
    assert (done.exit_code == 0) == ok, done.output
    return done.output


@pytest.fixture
def points(tmp_path):
    random = np.random.default_rng(4)
    latitude, longitude = (
        np.radians(56.85 + random.uniform(-0.4, 0.4, 9)),
        np.radians(35.9 + random.uniform(-0.6, 0.6, 9)),
    )
    truth = choose_frame(latitude, longitude, crs=f"{LOCAL} +towgs84=23.57,-140.95,-79.8,0,0.35,0.79,-0.22")
    grid = np.column_stack(truth.to_grid(latitude, longitude, np.full(9, 150.0))) + 0.01 * random.standard_normal(
        (9, 3)
    )
    grid[4, 0] += 0.5
    rows = [
        f"P{i + 1},{math.degrees(latitude[i])!r},{math.degrees(longitude[i])!r},150.0,{grid[i, 0]:.4f},{grid[i, 1]:.4f},{grid[i, 2]:.4f}"
        for i in range(9)
    ]
    file = tmp_path / "points.csv"
    file.write_text(
        "point,latitude_deg,longitude_deg,height_m,easting_m,northing_m,local_height_m\n" + "\n".join(rows) + "\n"
    )
    return file


def test_the_table():
    assert "GSK-2011" in run("datum")
    assert {d["name"] for d in json.loads(run("datum", "--json"))["datums"]} >= {"SK-42", "PZ-90.11", "DB_REF"}


def test_choices_and_pin(tmp_path):
    found = json.loads(run("datum", "choices", "EPSG:28407", "--at", "55.75,37.6", "--json"))["choices"]
    assert found[0]["apart_m"] == 0.0
    assert any(c["pin"] == "table" and 0.1 < c["apart_m"] < 0.3 for c in found)
    for choice in found[1:]:  # every choice that is offered can be pinned
        run("datum", "pin", "28407", "--at", "55.75,37.6", "--operation", choice["pin"], "-o", tmp_path / "a.toml")
        assert read_frame(tmp_path / "a.toml").operation == choice["operation"]
    assert "is no place" in CliRunner().invoke(main, ["datum", "choices", "28407", "--at", "x"]).output


def test_fit_and_its_use(points, tmp_path):
    output = tmp_path / "local.toml"
    facts = json.loads(run("datum", "fit", points, "--crs", LOCAL, "-o", output, "--json"))
    assert [p["point"] for p in facts["points"] if not p["agrees"]] == ["P5"]
    assert facts["sigma_m"] < 0.02
    words = run("datum", "fit", points, "--crs", LOCAL, "-o", output)
    assert "set aside  P5" in words
    # the fitted plane is where an import puts a model
    frame = read_frame(output)
    line = {
        "type": "Feature",
        "properties": {"track": "T1"},
        "geometry": {"type": "LineString", "coordinates": [[35.9, 56.85], [35.91, 56.86], [35.92, 56.87]]},
    }
    (tmp_path / "line.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [line]}))
    run("import", tmp_path / "line.geojson", "--crs", output, "-o", tmp_path / "line.gpkg")
    model = TrackModel.read(tmp_path / "line.gpkg")
    assert model.frame == frame
    east, north, _ = frame.to_grid(math.radians(56.85), math.radians(35.9))
    assert abs(model.easting[0] - east) < 1e-6
    assert abs(model.northing[0] - north) < 1e-6
    assert run("info", tmp_path / "line.gpkg")


def test_points_are_carried(points, tmp_path):
    facts = json.loads(
        run(
            "datum",
            "points",
            points,
            "--from",
            "ITRF2020",
            "--epoch",
            2026.5,
            "--to",
            "GSK-2011",
            "-o",
            tmp_path / "b.csv",
            "--json",
        )
    )
    assert facts["moved_m"][0] == pytest.approx(0.4, abs=0.02)
    home = json.loads(
        run(
            "datum",
            "points",
            tmp_path / "b.csv",
            "--from",
            "GSK-2011",
            "--to",
            "ITRF2020",
            "--to-epoch",
            2026.5,
            "-o",
            tmp_path / "c.csv",
            "--json",
        )
    )
    assert home["moved_m"][0] == pytest.approx(facts["moved_m"][0], abs=1e-3)
    first, last = (np.loadtxt(p, delimiter=",", skiprows=1, usecols=(1, 2, 3)) for p in (points, tmp_path / "c.csv"))
    np.testing.assert_allclose(first[:, :2], last[:, :2], atol=5e-9)
    np.testing.assert_allclose(first[:, 2], last[:, 2], atol=5e-4)
    assert "give their epoch" in run(
        "datum", "points", points, "--from", "ITRF2020", "--to", "GSK-2011", "-o", tmp_path / "d.csv", ok=False
    )


def test_bad_tables(points, tmp_path):
    text = points.read_text()
    (tmp_path / "twice.csv").write_text(text.replace("P2,", "P1,"))
    assert "row 3, column point: point 'P1' stands twice" in run(
        "datum", "fit", tmp_path / "twice.csv", "--crs", LOCAL, "-o", tmp_path / "x.toml", ok=False
    )
    (tmp_path / "short.csv").write_text("\n".join(text.splitlines()[:3]) + "\n")
    assert "need 3 common points" in run(
        "datum", "fit", tmp_path / "short.csv", "--crs", LOCAL, "-o", tmp_path / "x.toml", ok=False
    )
    assert not (tmp_path / "x.toml").exists()
    assert "no such file" in run(
        "build", tmp_path, "--crs", tmp_path / "none.toml", "-o", tmp_path / "m.gpkg", ok=False
    )


def test_frame_files(tmp_path):
    frames = [choose_frame(np.radians(47.5), np.radians(lon)) for lon in (19.0, 21.0)]
    write_frames(
        tmp_path / "two.toml", frames, heading='a "line"\nof two', tables={"junction": [{"km": 1.5, "name": 'ä"b'}]}
    )
    assert read_frames(tmp_path / "two.toml") == frames
    assert read_frame(f"{tmp_path}/two.toml:2") == frames[1]
    for text, words in (
        (None, "holds 2 sections; name one of them"),
        ("x = [", "is no TOML"),
        ("a = 1", r"\[frame\] is missing"),
        (
            '[frame]\nname = "a"\ncrs_wkt = "b"\noperation = "c"\npipeline = "proj=nonsense"\naccuracy_m = 1.0',
            "cannot run",
        ),
        (
            '[frame]\nname = "a"\ncrs_wkt = "b"\noperation = "c"\npipeline = "proj=noop"\naccuracy_m = 1.0',
            "no map projection",
        ),
        (
            '[frame]\nname = "a"\ncrs_wkt = "b"\noperation = "c"\npipeline = "proj=noop"\naccuracy_m = -1.0',
            "is no accuracy",
        ),
        ('[frame]\nname = "a"', r"frame.crs_wkt: is missing"),
    ):
        file = tmp_path / "two.toml"
        if text is not None:
            file = tmp_path / "bad.toml"
            file.write_text(text)
        with pytest.raises(InputError, match=words):
            read_frame(file)
    with pytest.raises(InputError, match="has no section 3"):
        read_frame(f"{tmp_path}/two.toml:3")
