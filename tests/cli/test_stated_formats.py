"""The chapter of formats, statement by statement, through the verbs: every stream, every refusal, every ending."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from railnav.cli import main
from railnav.io.geopackage import read_model
from railnav.io.run import read_run

#: A few rows of every stream with its required columns alone.
STREAMS = {
    "gnss": ("time_s,latitude_deg,longitude_deg", "{k},{lat:.6f},9.02"),
    "imu": (
        "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2",
        "{k},0,0,0,0,0,-9.81",
    ),
    "odometer": ("time_s,distance_m", "{k},{k}"),
    "gyro_angles": ("time_s,roll_deg,pitch_deg,heading_deg", "{k},0.1,0.2,{k}"),
    "gauge": ("time_s,gauge_mm", "{k},1435"),
    "balise": ("time_s,id", "{k},B{k}"),
}
TRUTH = ["time_s", "track", "offset_m", "speed_m_s", "latitude_deg", "longitude_deg", "height_m", "heading_deg"]
SOLUTION = [
    "time_s", "track", "offset_m", "line", "chainage_km", "easting_m", "northing_m", "height_m", "latitude_deg", "longitude_deg",
    "heading_deg", "speed_m_s", "acceleration_m_s2", "sigma_along_m", "sigma_cross_m", "protection_level_along_m",
    "track_probability", "mode",
]  # fmt: skip
MODES = {"initialising", "tracking", "coasting", "ambiguous", "off-model", "lost"}

Table = list[list[str]]


def _table(stream: str) -> Table:
    header, row = STREAMS[stream]
    return [header.split(","), *(row.format(k=k, lat=49.97 + 1e-4 * k).split(",") for k in range(8))]


def _folder(path: Path, tables: dict[str, Table], toml: str = "") -> Path:
    path.mkdir(exist_ok=True)
    names = "".join(f'[{name}]\nfile = "{name}.csv"\nformat = "csv"\n' for name in tables)
    (path / "run.toml").write_text(f'[run]\nid = "a"\nstart = "2026-05-04T08:00:00Z"\n{names}{toml}', encoding="utf-8")
    for name, table in tables.items():
        (path / f"{name}.csv").write_text("".join(",".join(row) + "\n" for row in table), encoding="utf-8")
    return path


def _refused(*arguments: str) -> str:
    done = CliRunner().invoke(main, arguments)
    assert (done.exit_code, done.stdout) == (1, ""), done.output
    (line,) = done.stderr.splitlines()
    return line


def _said(*arguments: str) -> dict[str, object]:
    done = CliRunner().invoke(main, [*arguments, "--json"])
    assert done.exit_code == 0, done.output
    value = json.loads(done.stdout)
    assert isinstance(value, dict)
    return value


def _header(path: Path) -> list[str]:
    with path.open(encoding="utf-8") as file:
        return file.readline().strip().split(",")


def _no_column(table: Table) -> tuple[int, str]:
    name = table[0][-1]
    table[:] = [row[:-1] for row in table]
    return 1, name


def _no_number(table: Table) -> tuple[int, str]:
    table[5][0] = "nan"
    return 6, "time_s"


def _backwards(table: Table) -> tuple[int, str]:
    table[4], table[5] = table[5], table[4]
    return 6, "time_s"


def _twice(table: Table) -> tuple[int, str]:
    table[5][0] = table[4][0]
    return 6, "time_s"


@pytest.mark.parametrize("damage", [_no_column, _no_number, _backwards, _twice])
@pytest.mark.parametrize("stream", STREAMS)
def test_what_is_wrong_is_refused_with_file_row_and_column(
    tmp_path: Path, stream: str, damage: Callable[[Table], tuple[int, str]]
) -> None:
    tables = {name: _table(name) for name in STREAMS}
    row, column = damage(tables[stream])
    line = _refused("info", str(_folder(tmp_path / "run", tables)))
    where = f"{stream}.csv, row {row}"
    if stream == "odometer" and damage is _no_column:  # either of two columns serves
        assert f"{where}: neither distance_m nor speed_m_s" in line
    else:
        assert f"{where}, column {column}: " in line


@pytest.mark.parametrize("stream", STREAMS)
def test_streams_may_stand_alone_and_carry_more_columns(tmp_path: Path, stream: str) -> None:
    table = [[*row, "more"] for row in _table(stream)]
    run = read_run(
        _folder(tmp_path / "run", {stream: table}, "time_offset_s = 2.5\nwhatever = 1\n[camera]\nfps = 25\n")
    )
    assert getattr(run, stream).time[0] == 2.5
    assert [name for name in STREAMS if getattr(run, name) is not None] == [stream]


@pytest.mark.parametrize("frame", ['"WGS84"', '"EPSG:4258"', "4258", '"4258"', '"ETRS89"', '"ITRF2014"'])
def test_frames_by_code_and_by_name(tmp_path: Path, frame: str) -> None:
    """All of these lie within a metre of each other in Europe; what was named is kept."""
    run = read_run(_folder(tmp_path / "run", {"gnss": _table("gnss")}, f"frame = {frame}\n"))
    assert run.gnss is not None
    assert run.gnss.frame == frame.strip('"')
    assert abs(run.gnss.latitude[0] * 6.4e6 - 49.97 * 111_701.07) < 1.5


@pytest.fixture
def here(stock: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(stock)
    return stock


def test_parquet_wherever_csv(here: Path) -> None:
    import pyarrow.csv as arrow_csv
    import pyarrow.parquet as parquet

    shutil.copytree("service", "columns")
    for path in [*Path("columns").glob("*.csv"), Path("truth.csv")]:
        parquet.write_table(arrow_csv.read_csv(path), path.with_suffix(".parquet"))
        if path.parent.name:
            path.unlink()
    toml = Path("columns/run.toml")
    toml.write_text(toml.read_text(encoding="utf-8").replace('.csv"', '.parquet"'), encoding="utf-8")
    _said("navigate", "service", "-m", "line.gpkg", "-o", "a.csv")
    _said("navigate", "columns", "-m", "line.gpkg", "-o", "b.csv")
    assert Path("a.csv").read_bytes() == Path("b.csv").read_bytes()
    _said("convert", "a.csv", "-o", "c.parquet")
    assert _said("evaluate", "c.parquet", "truth.parquet")["along"] == _said("evaluate", "a.csv", "truth.csv")["along"]
    _said("convert", "line.gpkg", "-o", "elements.csv")
    parquet.write_table(arrow_csv.read_csv("elements.csv"), "elements2.parquet")
    lengths = [
        _said("import", name, "-o", "again.gpkg", "--crs", "31466", "--spacing", "10")["length_m"]
        for name in ("elements.csv", "elements2.parquet")
    ]
    assert lengths[0] == lengths[1]


def test_columns_of_a_solution_in_every_ending(here: Path) -> None:
    import pyarrow.parquet as parquet
    import pyogrio

    _said("navigate", "service", "-m", "line.gpkg", "-o", "s.csv")
    for ending in ("parquet", "gpkg", "geojson"):
        _said("convert", "s.csv", "-o", f"s.{ending}")
    assert _header(Path("s.csv"))[: len(SOLUTION)] == SOLUTION
    assert parquet.read_schema("s.parquet").names[: len(SOLUTION)] == SOLUTION
    meta, _, geometry, columns = pyogrio.raw.read("s.gpkg", layer="solution")
    assert [name for name in meta["fields"] if name in SOLUTION] == SOLUTION
    assert meta["geometry_type"].startswith("Point")
    features = json.loads(Path("s.geojson").read_text(encoding="utf-8"))["features"]
    assert [name for name in features[0]["properties"] if name in SOLUTION] == SOLUTION
    assert features[0]["geometry"]["type"] == "Point"
    rows = Path("s.csv").read_text(encoding="utf-8").splitlines()
    assert len(features) == len(geometry) == len(rows) - 1
    assert set(columns[list(meta["fields"]).index("mode")]) <= MODES


def test_the_verbs_as_they_are_stated(here: Path) -> None:
    """`simulate -m MODEL -o RUN`, `build RUN... -o MODEL`, `update MODEL RUN... -o MODEL`, and on what they leave the others."""
    assert _said("simulate", "-m", "line.gpkg", "-o", "run", "--route", "77R-01,77R-02")["kind"] == "run"
    assert _header(Path("run/truth.csv")) == TRUTH
    _said("build", "survey-1", "-o", "one.gpkg", "--spacing", "5")
    _said("update", "one.gpkg", "survey-2", "-o", "two.gpkg")
    for verb in ("info", "validate"):
        for what in ("two.gpkg", "run"):
            assert _said(verb, what)["kind"] == ("model" if what.endswith("gpkg") else "run")
    _said("navigate", "service", "-m", "two.gpkg", "-o", "s.gpkg")
    assert _said("evaluate", "s.gpkg", "truth.csv", "-m", "two.gpkg")["epochs"]
    _said("monitor", "survey-1", "-m", "two.gpkg", "-o", "report.html")
    _said("lining", "survey-1", "survey-2", "-m", "two.gpkg", "-o", "plan.csv")
    _said("view", "two.gpkg", "-o", "two.html")
    for name in ("report.html", "plan.csv", "two.html"):
        assert Path(name).stat().st_size > 500


def test_chainage_of_a_file_becomes_line_references(here: Path) -> None:
    """What an import keeps of posts answers addresses, there and back, also after a train that crossed over refined the tracks."""
    facts = _said("import", "line.geojson", "-o", "m.gpkg", "--spacing", "5")
    assert facts["lines"] == ["77", "78"]
    places = _said("chainage", "m.gpkg", "40.345", "--line", "77")["places"]
    assert isinstance(places, list)
    assert {place["track"] for place in places} >= {"77R-01"}
    _said("simulate", "-m", "m.gpkg", "-o", "crossing", "--route", "77R-01,77X-01,77L-02", "--seed", "3")
    _said("update", "m.gpkg", "crossing", "-o", "refined.gpkg", "--from-service")
    before, after = read_model(here / "m.gpkg"), read_model(here / "refined.gpkg")
    assert len(after.references) == len(before.references) > 0
    for name in ("77R-01", "77L-03"):
        ends = [
            m.references.offset[m.references.track == m.track_id.index(name)].max() / m.length(name)
            for m in (before, after)
        ]
        assert ends[0] == pytest.approx(ends[1], abs=1e-12)


def test_a_train_that_backs_up_keeps_its_heading_and_shows_a_negative_speed(here: Path) -> None:
    """In the truth and in the solution; the odometer's distance is unsigned and grows all the same."""
    from railnav.io.run import write_run
    from railnav.simulation import SERVICE, Leg, simulate

    legs = [
        Leg(("77R-03",), start=500.0, finish=1200.0, dwell=20.0),
        Leg(("77R-03",), start=1200.0, finish=700.0, dwell=20.0),
    ]
    run, truth = simulate(read_model(here / "line.gpkg"), legs, seed=2, outfit=SERVICE, run_id="shunt")
    write_run(run, here / "shunt", truth=truth)
    assert np.diff(run.odometer.distance if run.odometer and run.odometer.distance is not None else []).min() >= 0.0
    _said("navigate", "shunt", "-m", "line.gpkg", "-o", "s.csv")
    stated, true = (
        {row["time_s"]: row for row in csv.DictReader(Path(name).read_text(encoding="utf-8").splitlines())}
        for name in ("s.csv", "shunt/truth.csv")
    )
    back = [time for time in stated if time in true and float(true[time]["speed_m_s"]) < -2.0]
    assert len(back) > 100
    forward = float(next(iter(true.values()))["heading_deg"])
    for time in back:
        assert float(stated[time]["speed_m_s"]) == pytest.approx(float(true[time]["speed_m_s"]), abs=0.5)
        for row in (stated[time], true[time]):
            assert abs(float(row["heading_deg"]) - forward) < 20.0  # the track's own bend, not half a turn
