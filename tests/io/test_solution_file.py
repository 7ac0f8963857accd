"""Solutions and truth: exactly the columns of the formats, whole rows or empty cells, there and back."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sqlite3
import subprocess

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small import frame_of

from railnav.errors import InputError
from railnav.io.geopackage import read_model, write_model
from railnav.io.solution import read_solution, write_solution
from railnav.io.truth import read_truth, write_truth
from railnav.navigation.solution import Mode, Solution
from railnav.truth import Truth

HEADER = (
    "time_s,track,offset_m,line,chainage_km,easting_m,northing_m,height_m,latitude_deg,longitude_deg,heading_deg,speed_m_s,"
    "acceleration_m_s2,sigma_along_m,sigma_cross_m,protection_level_along_m,track_probability,mode"
)
ENDINGS = ("csv", "parquet", "gpkg", "geojson")


def make_solution(*, seed=1, crs=True, datum_shift=0.0):
    """Twelve epochs: lost, then forwards on one track, a stand, backwards on another, lost again."""
    random = np.random.default_rng(seed)
    frame = frame_of(47.5, 19.1)
    track = np.array([-1, 0, 0, 0, 0, 2, 2, 2, 2, 2, 2, -1])
    none = track < 0
    offset = np.array([np.nan, 10, 20, 30, 30.0001, 400, 390, 380, 380, 380, 370, np.nan])
    speed = np.array([np.nan, 10, 10, 10, 0, -10, -10, -10, 0, 0, -10, np.nan])

    def some(scale):
        return np.where(none, np.nan, random.uniform(0, scale, 12))

    latitude, longitude, height = np.radians(47.5) + some(1e-3), np.radians(19.1) + some(1e-3), some(200)
    grid = np.full((2, 12), np.nan)
    grid[:, ~none] = frame.to_grid(latitude[~none], longitude[~none])[:2]
    return Solution(
        track_id=("80R-01", "80R-02", 'Gleis 3, "süd"'),
        line=("80", "80", ""),
        time=np.arange(12) * 0.1,
        track=track,
        offset=offset,
        chainage=np.where(track == 2, np.nan, offset + 117_000),
        easting=grid[0],
        northing=grid[1],
        height=height + datum_shift,
        latitude=latitude,
        longitude=longitude,
        ellipsoidal_height=height,
        heading=np.where(none, np.nan, np.linspace(-1, 7, 12)),
        speed=speed,
        acceleration=some(1),
        sigma_along=some(3),
        sigma_cross=np.where(track == 0, 0.1, np.nan),
        protection_level_along=np.where(np.arange(12) == 5, np.inf, some(10)),
        track_probability=some(1),
        mode=np.where(none, Mode.LOST, np.where(track == 2, Mode.OFF_MODEL, Mode.TRACKING)).astype(np.int64),
        running_direction=np.where(none, 0, 1),
        run_id="run 7",
        start="2026-05-04T08:00:00Z",
        crs_wkt=frame.crs_wkt if crs else "",
        integrity_risk=1e-5,
        smoothed=True,
        diagnostics={"fixes": 12, "rejected": [3]},
    )


def assert_same(before, after, tolerance):
    names = [before.track_id[i] if i >= 0 else None for i in before.track]
    assert [after.track_id[i] if i >= 0 else None for i in after.track] == names
    lines = [before.line[i] if i >= 0 else None for i in before.track]
    assert [after.line[i] if i >= 0 else None for i in after.track] == lines
    for name in before.__slots__:
        x, y = getattr(before, name), getattr(after, name)
        if isinstance(x, np.ndarray) and name not in ("track", "heading", "running_direction"):
            scale = 2e-8 if name in ("latitude", "longitude") else 1.0
            np.testing.assert_allclose(y, x, rtol=1e-15, atol=tolerance * scale, err_msg=name)
            assert y.dtype == x.dtype
    np.testing.assert_allclose(after.heading, np.mod(before.heading, 2 * np.pi), rtol=0, atol=tolerance + 1e-15)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("options", [{}, {"crs": False}, {"datum_shift": 42.5}], ids=["plane", "degrees", "own datum"])
def test_there_and_back(tmp_path, ending, options):
    solution = make_solution(**options)
    solution_file = tmp_path / f"s.{ending}"
    solution.to_file(solution_file)
    again = read_solution(solution_file)
    if ending == "geojson":  # JSON knows no infinity
        bound = np.where(np.isinf(solution.protection_level_along), np.nan, solution.protection_level_along)
        solution = dataclasses.replace(solution, protection_level_along=bound)
    assert_same(solution, again, 1e-14 if ending in ("parquet", "gpkg") else 5.1e-5)
    np.testing.assert_array_equal(again.running_direction, solution.running_direction)
    if ending != "csv":
        for name in ("run_id", "start", "crs_wkt", "integrity_risk", "smoothed", "diagnostics"):
            assert getattr(again, name) == getattr(solution, name), name
    write_solution(again, tmp_path / f"t.{ending}")
    if ending in ("csv", "geojson"):
        assert (tmp_path / f"t.{ending}").read_bytes() == solution_file.read_bytes()


def test_columns_are_those_of_the_formats(tmp_path):
    solution = make_solution()
    for ending in ENDINGS:
        write_solution(solution, tmp_path / f"s.{ending}")
    lines = (tmp_path / "s.csv").read_text().splitlines()
    assert lines[0] == HEADER
    assert len(lines) == 13
    assert lines[1] == '0,,,,,,,,,,,,,,,,,"lost"'
    assert lines[2].startswith('0.1,"80R-01",10,"80",117.01,')
    assert pq.read_schema(tmp_path / "s.parquet").names == HEADER.split(",")
    assert pq.read_table(tmp_path / "s.parquet")["easting_m"].null_count == 2
    features = json.loads((tmp_path / "s.geojson").read_text())["features"]
    assert list(features[1]["properties"]) == HEADER.split(",")
    assert features[0]["geometry"] is None
    longitude, latitude, height = features[1]["geometry"]["coordinates"]
    assert (round(longitude), round(latitude)) == (19, 48)
    assert height == features[1]["properties"]["height_m"]
    with sqlite3.connect(tmp_path / "s.gpkg") as connection:
        names = [row[1] for row in connection.execute("PRAGMA table_info(solution)")]
        assert names == ["fid", "geom", *HEADER.split(",")]
        empty = connection.execute("SELECT count(*) FROM solution WHERE geom IS NULL AND track IS NULL").fetchone()
        assert empty == (2,)
    connection.close()


def test_names_without_commas_stand_without_quotes(tmp_path):
    solution = dataclasses.replace(make_solution(), track_id=("a", "b", "c"))
    write_solution(solution, tmp_path / "s.csv")
    assert (tmp_path / "s.csv").read_text().splitlines()[1] == "0,,,,,,,,,,,,,,,,,lost"


def test_own_datum_gets_a_column_of_its_own(tmp_path):
    write_solution(make_solution(datum_shift=42.5), tmp_path / "s.csv")
    assert (tmp_path / "s.csv").read_text().splitlines()[0] == f"{HEADER},grid_height_m"


def test_running_direction_is_told_from_csv(tmp_path):
    solution = make_solution()
    backwards = dataclasses.replace(solution, offset=1000 - solution.offset)
    write_solution(backwards, tmp_path / "s.csv")
    np.testing.assert_array_equal(read_solution(tmp_path / "s.csv").running_direction, -solution.running_direction)
    still = dataclasses.replace(solution, speed=solution.speed * 0)
    write_solution(still, tmp_path / "s.csv")
    assert not read_solution(tmp_path / "s.csv").running_direction.any()


ROW = "0,A,1.5,80,0.0015,1,2,3,47,19,90,10,0,1,0.1,5,0.99,tracking"
REFUSALS = {
    "missing column": (
        HEADER.replace(",sigma_cross_m", "") + "\n" + ROW.replace(",0.1", ""),
        r"s.csv, row 1, column sigma_cross_m: required column is missing; the file has: time_s, track",
    ),
    "mode": (
        f"{HEADER}\n{ROW.replace('tracking', 'guessing')}",
        r"row 2, column mode: 'guessing' is no mode; modes are",
    ),
    "empty mode": (f"{HEADER}\n{ROW.replace('tracking', '')}", r"row 2, column mode: is empty"),
    "time": (f"{HEADER}\n{ROW}\n{ROW}", r"row 3, column time_s: two rows at one instant"),
    "probability": (
        f"{HEADER}\n{ROW.replace('0.99', '1.5')}",
        r"row 2, column track_probability: 1.5 is outside 0 to 1",
    ),
    "sigma": (f"{HEADER}\n{ROW.replace(',1,0.1', ',-1,0.1')}", r"row 2, column sigma_along_m: -1 is outside 0 to inf"),
    "no offset": (
        f"{HEADER}\n{ROW.replace('1.5,', ',', 1)}",
        r"row 2, column offset_m: is empty where the row has a track",
    ),
    "no track": (f"{HEADER}\n{ROW.replace('A', '')}", r"row 2, column track: is empty where the row has an offset"),
    "two lines": (
        f"{HEADER}\n{ROW}\n{ROW.replace('0,A', '1,A').replace(',80,', ',81,')}",
        r"row 3, column line: track 'A' stood",
    ),
    "truth": ("time_s,track,offset_m\n0,A,1\n", r"column line: required column is missing"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_csv_is_refused(tmp_path, case):
    text, message = REFUSALS[case]
    (tmp_path / "s.csv").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_solution(tmp_path / "s.csv")
    assert str(caught.value).startswith(f"{tmp_path}/s.csv")
    assert "\n" not in str(caught.value)


def test_writing_is_refused(tmp_path):
    solution = make_solution()
    with pytest.raises(
        InputError, match=r"s.shp: a solution cannot be written as .shp; use .csv, .parquet, .gpkg or .geojson"
    ):
        write_solution(solution, tmp_path / "s.shp")
    with pytest.raises(InputError, match="a file without ending"):
        write_solution(solution, tmp_path / "s")
    with pytest.raises(InputError, match="the diagnostics hold more than JSON values"):
        write_solution(dataclasses.replace(solution, diagnostics={"x": np.int64(3)}), tmp_path / "s.csv")
    with pytest.raises(InputError, match=r"the folder .* does not exist"):
        write_solution(solution, tmp_path / "gone" / "s.csv")
    with pytest.raises(InputError, match="the coordinate system is no well-known text"):
        write_solution(dataclasses.replace(solution, crs_wkt="gibberish"), tmp_path / "s.gpkg")
    assert list(tmp_path.iterdir()) == []


def test_geojson_and_geopackage_are_refused(tmp_path, small_model):
    target = tmp_path / "s.geojson"
    for text in ("", "[]", "{}", '{"features": [3]}', '{"features": {"a": 1}}', "[" * 100_000, "\xff"):
        target.write_text(text, encoding="latin-1")
        with pytest.raises(InputError, match="is no GeoJSON of a solution"):
            read_solution(target)
    with pytest.raises(InputError, match="does not exist"):
        read_solution(tmp_path / "gone.geojson")
    write_solution(make_solution(), target)
    data = json.loads(target.read_text())
    data["features"][4]["properties"]["offset_m"] = "far"
    target.write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"row 6, column offset_m: 'far' is not a number"):
        read_solution(target)
    data["features"][4]["properties"]["offset_m"] = 10**400
    target.write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"column offset_m: holds a number beyond all bounds"):
        read_solution(target)
    del data["features"][4]["properties"]["mode"]
    target.write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"row 6, column mode: property is missing"):
        read_solution(target)
    data["features"] = []
    target.write_text(json.dumps(data))
    with pytest.raises(InputError, match="has no rows"):
        read_solution(target)

    target = tmp_path / "m.gpkg"
    write_model(small_model, target)
    with pytest.raises(InputError, match=r"m.gpkg: holds a reference track model, not a solution"):
        read_solution(target)
    target = tmp_path / "s.gpkg"
    write_solution(make_solution(), target)
    with pytest.raises(InputError, match=r"s.gpkg: holds a solution, not a reference track model"):
        read_model(target)
    with sqlite3.connect(target) as connection:
        connection.execute("UPDATE solution SET speed_m_s = 'fast' WHERE fid = 3")
    connection.close()
    with pytest.raises(InputError, match=r"s.gpkg, row 4, column speed_m_s: 'fast' is not a number"):
        read_solution(target)
    with sqlite3.connect(target) as connection:
        connection.execute("ALTER TABLE solution DROP COLUMN speed_m_s")
    connection.close()
    with pytest.raises(InputError, match=r"s.gpkg, column solution: column 'speed_m_s' is missing"):
        read_solution(target)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_read_or_refused(tmp_path, data):
    ending = data.draw(st.sampled_from(ENDINGS))
    target = tmp_path / f"s.{ending}"
    if not target.exists():
        write_solution(make_solution(), target)
    whole = target.read_bytes()
    cut = data.draw(st.integers(0, len(whole) - 1))
    patch = data.draw(st.binary(max_size=20))
    damaged = whole[:cut] + patch + (whole[cut + len(patch) :] if data.draw(st.booleans()) else b"")
    broken = tmp_path / f"broken.{ending}"
    broken.write_bytes(damaged)
    try:
        read_solution(broken)
    except InputError as error:
        assert str(broken) in str(error)  # noqa: PT017 - either outcome is lawful


@pytest.mark.parametrize("crs", [True, False])
def test_ogr_opens_the_points(tmp_path, crs):
    if shutil.which("ogrinfo") is None:
        pytest.skip("ogrinfo (GDAL) is not installed")
    write_solution(make_solution(crs=crs), tmp_path / "s.gpkg")
    run = subprocess.run(
        ["ogrinfo", "-so", tmp_path / "s.gpkg", "solution"], capture_output=True, text=True, check=True
    )
    assert run.stderr == ""
    assert "Feature Count: 12" in run.stdout
    assert "Geometry: 3D Point" in run.stdout
    assert ("Gauss-Kruger zone 4" if crs else 'GEOGCRS["WGS 84"') in run.stdout
    assert "Extent: (4" in run.stdout or not crs


# --- truth ------------------------------------------------------------------------------------------------------------

TRUTH_HEADER = "time_s,track,offset_m,speed_m_s,latitude_deg,longitude_deg,height_m,heading_deg"


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_truth_there_and_back(tmp_path, ending):
    truth = Truth(
        track_id=("unused", "A", "B"),
        time=np.arange(3.0),
        track=np.array([2, 2, 1]),
        offset=np.array([0.1, 1.1, 3.0]),
        speed=np.array([1.0, np.nan, -1.0]),
        latitude=np.radians([47.0, 47.1, 47.2]),
        longitude=np.radians([19.0, 19.1, 19.2]),
        height=np.full(3, np.nan),
        heading=np.radians([0.0, 90.0, 359.0]),
        simulated=True,
    )
    write_truth(truth, tmp_path / f"truth.{ending}")
    again = read_truth(tmp_path / f"truth.{ending}")
    assert again.track_id == ("B", "A")
    np.testing.assert_array_equal(again.track, [0, 0, 1])
    for name in ("time", "offset", "speed", "latitude", "longitude", "height", "heading"):
        np.testing.assert_allclose(getattr(again, name), getattr(truth, name), rtol=0, atol=1e-15, err_msg=name)
    assert again.simulated == (ending == "parquet")
    if ending == "csv":
        assert (tmp_path / "truth.csv").read_text().splitlines()[:2] == [TRUTH_HEADER, "0,B,0.1,1,47,19,,0"]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("0,,1,0,47,19,,0", "row 2, column track: is empty"),
        ("0,A,,0,47,19,,0", "row 2, column offset_m: is empty or not a number"),
        ("0,A,1,0,470,19,,0", "row 2, column latitude_deg: 470 is outside -90 to 90"),
        ("1,A,1,0,47,19,,0\n0,A,1,0,47,19,,0", "row 3, column time_s: time runs backwards"),
    ],
)
def test_truth_is_refused(tmp_path, row, message):
    (tmp_path / "truth.csv").write_text(f"{TRUTH_HEADER}\n{row}\n")
    with pytest.raises(InputError, match=f"truth.csv, {message}"):
        read_truth(tmp_path / "truth.csv")


def test_truth_of_the_sample_run_reads(shared_data):
    truth = read_truth(shared_data / "sample_run" / "truth.csv")
    assert len(truth) == 8343
    assert truth.track_id[0] == "80R-01"
