"""The verbs import and convert on the formats of other programs: there and back, and what they say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from click.testing import CliRunner

from railnav.cli import main
from railnav.evaluation import truth_as_solution
from railnav.io.geopackage import read_model
from railnav.io.run import read_run
from railnav.io.truth import read_truth


@pytest.fixture
def here(stock: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The stock folder as the current one, with a solution that knows its start."""
    model = read_model(stock / "line.gpkg")
    truth_as_solution(read_truth(stock / "truth.csv"), model, along=1.5).to_file(stock / "solution.gpkg")
    monkeypatch.chdir(stock)
    return stock


def run(*arguments: str) -> dict[str, Any]:
    done = CliRunner().invoke(main, [*arguments, "--json"])
    assert done.exit_code == 0, done.output
    value = json.loads(done.stdout)
    assert isinstance(value, dict)
    return value


@pytest.mark.parametrize(
    ("ending", "options"), [("xml", []), ("railml", []), ("csv", ["--crs", "PLANE"]), ("parquet", ["--crs", "PLANE"])]
)
def test_a_model_to_other_programs_and_back(here: Path, ending: str, options: list[str]) -> None:
    before = read_model(here / "line.gpkg")
    plane = [before.frame.crs_wkt if option == "PLANE" else option for option in options]
    run("convert", "line.gpkg", "-o", f"out.{ending}")
    run("import", f"out.{ending}", "-o", "back.gpkg", *plane)
    after = read_model(here / "back.gpkg")
    assert sorted(after.track_id) == sorted(before.track_id)
    assert len(after.movements) == len(before.movements)
    for track in before.track_id:
        length = min(before.length(track), after.length(track))
        at = np.linspace(0.0, length, 50)
        p, q = before.at(track, at), after.at(track, at)
        assert np.hypot(p.easting - q.easting, p.northing - q.northing).max() < 2e-3, track
        assert np.abs(np.nan_to_num(p.height - q.height)).max() < 2e-3, track


def test_drawings_are_well_formed(here: Path) -> None:
    run("convert", "line.gpkg", "-o", "line.kml")
    run("convert", "solution.gpkg", "-o", "solution.kml")
    run("convert", "service", "-o", "fixes.kml")
    space = "{http://www.opengis.net/kml/2.2}"
    gx = "{http://www.google.com/kml/ext/2.2}"
    assert len(ET.parse("line.kml").findall(f".//{space}LineString")) == 36
    drawn = ET.parse("solution.kml")
    assert drawn.findall(f".//{space}LineString")
    moving = ET.parse("fixes.kml")
    assert (
        len(moving.findall(f".//{gx}coord")) == len(moving.findall(f".//{space}when")) == len(read_run("service").gnss)
    )
    first = moving.find(f".//{gx}coord").text.split()
    assert float(first[0]) == pytest.approx(np.degrees(read_run("service").gnss.longitude[0]), abs=1e-7)


def test_moving_features(here: Path) -> None:
    done = CliRunner().invoke(main, ["convert", "solution.gpkg", "-o", "train.mfjson"])
    if done.exit_code:  # truth has no start of its own: it is said
        assert "does not say when it starts" in done.stderr
    from dataclasses import replace

    from railnav.io.moving_features import write_moving_features
    from railnav.io.solution import read_solution

    solution = replace(read_solution("solution.gpkg"), start="2026-05-04T08:00:00Z")
    latitude = solution.latitude.copy()
    latitude[5:8] = np.nan
    write_moving_features(replace(solution, latitude=latitude), "gap.mfjson")
    feature = json.loads(Path("gap.mfjson").read_text())
    prisms = feature["temporalGeometry"]["prisms"]
    assert [len(prism["datetimes"]) for prism in prisms] == [5, len(solution) - 8]
    assert all(len(prism["datetimes"]) == len(prism["coordinates"]) for prism in prisms)
    (measured,) = feature["temporalProperties"]
    assert measured["speed"]["form"] == "MTS"
    assert len(measured["speed"]["values"]) == len(measured["datetimes"]) == len(solution) - 3
    assert measured["datetimes"][0].startswith("2026-05-04T08:")


def test_layers_by_their_columns(here: Path) -> None:
    import pyogrio
    import shapely

    lines = [shapely.LineString([(3_460_000, 5_480_000), (3_460_000, 5_480_500)])]
    pyogrio.raw.write(
        "gis.gpkg", np.array([shapely.to_wkb(line) for line in lines]), [np.array(["7"])], ["GLEIS"], geometry_type="LineString",
        crs="EPSG:31467",
    )  # fmt: skip
    facts = run("import", "gis.gpkg", "-o", "model.gpkg", "--columns", "track=GLEIS")
    assert facts["tracks"][0]["track"] == "7"
    for wrong, code in ((["--columns", "track"], 2), (["--columns", "track=X"], 1), (["--layer", "y"], 1)):
        assert CliRunner().invoke(main, ["import", "gis.gpkg", "-o", "m.gpkg", *wrong]).exit_code == code


def test_logs_become_other_logs(here: Path) -> None:
    assert run("convert", "service", "-o", "a.nmea")["fixes"] == len(read_run("service").gnss)
    assert run("convert", "a.nmea", "-o", "b.gpx")["kind"] == "log"
    run("convert", "b.gpx", "-o", "again")
    assert len(read_run("again").gnss) == len(read_run("service").gnss)
    run("convert", "service", "-o", "copy")
    assert len(read_run("copy").imu) == len(read_run("service").imu)
    assert run("info", "copy")["kind"] == "run"


def test_what_an_address_sends(here: Path) -> None:
    import socket
    import threading

    run("convert", "service", "-o", "a.nmea")
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        link, _ = server.accept()
        with link:
            link.sendall(Path("a.nmea").read_bytes())

    threading.Thread(target=serve, daemon=True).start()
    facts = run("convert", f"tcp://127.0.0.1:{server.getsockname()[1]}", "-o", "heard.gpx")
    server.close()
    assert facts["fixes"] == len(read_run("service").gnss)
    done = CliRunner().invoke(main, ["convert", "a.nmea", "-o", "b.gpx", "--seconds", "5"])
    assert done.exit_code == 2


def test_a_log_is_described_and_judged(here: Path) -> None:
    run("convert", "service", "-o", "a.nmea")
    text = bytearray(Path("a.nmea").read_bytes())
    text[200] ^= 1
    Path("a.nmea").write_bytes(bytes(text))
    facts = run("info", "a.nmea")
    assert facts["logs"][0]["broken"] == 1
    done = CliRunner().invoke(main, ["info", "a.nmea"])
    assert "1, the first at" in done.stdout
    done = CliRunner().invoke(main, ["validate", "a.nmea"])
    assert done.exit_code == 0
    assert "remark: log" in done.stdout
    Path("b.nmea").write_text("no log at all")
    assert CliRunner().invoke(main, ["validate", "b.nmea"]).exit_code == 1


def test_styles_for_qgis(here: Path) -> None:
    import sqlite3

    for name, layers in (("line.gpkg", ["mileposts", "nodes", "tracks"]), ("solution.gpkg", ["solution"])):
        connection = sqlite3.connect(name)
        rows = connection.execute("SELECT f_table_name, styleQML, useAsDefault FROM layer_styles ORDER BY 1").fetchall()
        connection.close()
        assert [row[0] for row in rows] == layers
        for _, text, default in rows:
            assert default == 1
            root = ET.fromstring(text)
            assert root.tag == "qgis"
            symbols = {symbol.get("name") for symbol in root.iter("symbol")}
            assert {category.get("symbol") for category in root.iter("category")} <= symbols
