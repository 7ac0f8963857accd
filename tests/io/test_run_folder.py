"""Run folders: read in SI, refused with file, row, column and remedy, written back to the byte."""

from __future__ import annotations

import json
import tomllib
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from railnav.errors import InputError, RunError
from railnav.io import tables
from railnav.io.run import read_run, write_run
from railnav.io.truth import read_truth
from railnav.run import (
    BaliseStream,
    GaugeStream,
    GnssStream,
    GyroAnglesStream,
    ImuStream,
    OdometerStream,
    Run,
)
from railnav.truth import Truth

HEAD = '[run]\nid = "a"\nstart = "2021-06-29T10:35:17Z"\n'
GNSS = "time_s,latitude_deg,longitude_deg\n0.0,47.5,19.0\n1.0,47.6,19.1\n"
IMU = "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2\n0.01,1,2,3,4,5,-9.81\n"


@pytest.fixture
def folder(tmp_path):
    """Write a run folder of given streams: `folder(gnss=csv text, toml=lines)`."""

    def make(toml="", **streams):
        text = HEAD + "".join(f'[{name}]\nfile = "{name}.csv"\n' for name in streams) + toml
        (tmp_path / "run.toml").write_text(text, encoding="utf-8")
        for name, content in streams.items():
            data = content if isinstance(content, bytes) else content.encode()
            (tmp_path / f"{name}.csv").write_bytes(data)
        return tmp_path

    return make


def refusal(folder):
    with pytest.raises(RunError) as caught:
        read_run(folder)
    text = str(caught.value)
    assert "\n" not in text
    assert str(folder) in text
    return text.replace(f"{folder}/", "").replace(str(folder), "FOLDER")


# --- what is read -----------------------------------------------------------------------------------------------------


def test_all_streams_come_in_si_and_radians(folder):
    run = read_run(
        folder(
            gnss="time_s,latitude_deg,longitude_deg,height_m,sigma_east_m,speed_m_s,course_deg,hdop,satellites,other\n"
            "0,45,-90,120.5,1.5,10,90,0.9,7,x\n1,-45,180,,,,,,,y\n",
            imu=IMU,
            odometer="time_s,distance_m,speed_m_s,sigma_speed_m_s\n0,0,1,0.1\n1,1,,\n",
            gyro_angles="time_s,roll_deg,pitch_deg,heading_deg\n0,1,2,180\n",
            gauge="time_s,gauge_mm,cant_mm\n0,1435,-150\n",
            balise="time_s,id,sigma_m\n5,B-17,0.2\n9, B-18 ,\n",
        )
    )
    assert run.id == "a"
    assert run.start == datetime(2021, 6, 29, 10, 35, 17, tzinfo=UTC)
    assert run.source is not None
    gnss = run.gnss
    np.testing.assert_array_equal(gnss.latitude, np.radians([45, -45]))
    np.testing.assert_array_equal(gnss.longitude, np.radians([-90, 180]))
    np.testing.assert_array_equal(gnss.height, [120.5, np.nan])
    np.testing.assert_array_equal(gnss.course, [np.pi / 2, np.nan])
    assert gnss.sigma_north is None
    assert gnss.frame == "WGS84"
    np.testing.assert_array_equal(run.imu.gyro, [[1, 2, 3]])
    np.testing.assert_array_equal(run.imu.specific_force, [[4, 5, -9.81]])
    np.testing.assert_array_equal(run.odometer.speed, [1, np.nan])
    assert run.gyro_angles.heading[0] == np.pi
    assert (run.gauge.gauge[0], run.gauge.cant[0]) == (1.435, -0.15)
    assert run.balise.id == ("B-17", "B-18")
    for array in (gnss.time, gnss.latitude, gnss.height, run.imu.gyro, run.odometer.distance, gnss.lever_arm_b):
        assert array.dtype == np.float64
        assert array.flags.c_contiguous
        assert not array.flags.writeable


def test_positions_in_another_frame_become_wgs84(folder):
    """DB_REF (Bessel) lies some 100 m from WGS 84 in Germany; the operation is the registry's."""
    from pyproj import Transformer

    rows = "time_s,latitude_deg,longitude_deg,height_m\n0,50.0,9.0,150.0\n1,50.001,9.0,\n"
    run = read_run(folder(gnss=rows, toml='frame = "EPSG:5830"\n'))
    oracle = Transformer.from_crs("EPSG:5830", "EPSG:4979", allow_ballpark=False)
    latitude, longitude, height = oracle.transform(50.0, 9.0, 150.0)
    assert np.degrees(run.gnss.latitude[0]) == pytest.approx(latitude, abs=2e-8)
    assert np.degrees(run.gnss.longitude[0]) == pytest.approx(longitude, abs=2e-8)
    assert run.gnss.height[0] == pytest.approx(height, abs=2e-3)
    assert np.isnan(run.gnss.height[1])
    assert abs(np.degrees(run.gnss.latitude[0]) - 50.0) > 5e-4
    assert run.gnss.frame == "EPSG:5830"
    with pytest.raises(RunError, match=r"run\.toml, column gnss\.frame: .*MARS"):
        read_run(folder(gnss=rows, toml='frame = "MARS"\n'))


def test_settings_of_run_toml_are_kept(folder):
    toml = (
        'frame = "EPSG:7912"\nreceiver = "ublox"\nlever_arm_m = [1, 0.5, -3.1]\ntime_offset_s = -0.125\nunknown = 3\n'
        '[imu]\nfile = "imu.csv"\nmounting_deg = [180, -90, 45.0]\nlever_arm_m = [0.0, 0.0, -0.65]\n'
        '[odometer]\nfile = "odometer.csv"\nsigned = true\n[radar]\nfile = "radar.bin"\n'
    )
    path = folder(gnss=GNSS, toml=toml)
    (path / "imu.csv").write_text(IMU)
    (path / "odometer.csv").write_text("time_s,distance_m\n0,5\n1,2\n")
    run = read_run(path)
    assert (run.gnss.frame, run.gnss.receiver) == ("EPSG:7912", "ublox")
    np.testing.assert_array_equal(run.gnss.time, [-0.125, 0.875])
    np.testing.assert_array_equal(run.gnss.lever_arm_b, [1, 0.5, -3.1])
    np.testing.assert_array_equal(run.imu.mounting, np.radians([180, -90, 45]))
    np.testing.assert_array_equal(run.imu.lever_arm_b, [0, 0, -0.65])
    assert run.odometer.signed


@pytest.mark.parametrize(
    "start",
    [
        '"2021-06-29T10:35:17+00:00"',
        '"2021-06-29T12:35:17+02:00"',
        "2021-06-29T10:35:17Z",
        "2021-06-29T12:35:17+02:00",
        '" 2021-06-29 10:35:17Z "',
    ],
)
def test_start_is_utc_however_it_is_written(folder, start):
    path = folder(gnss=GNSS)
    text = (path / "run.toml").read_text().replace('"2021-06-29T10:35:17Z"', start)
    (path / "run.toml").write_text(text)
    assert read_run(path).start == datetime(2021, 6, 29, 10, 35, 17, tzinfo=UTC)
    assert read_run(path).start.tzinfo is UTC


@pytest.mark.parametrize(
    "text",
    [
        GNSS.replace("\n", "\r\n"),
        GNSS.replace("\n", "\r"),
        GNSS.rstrip("\n"),
        "\ufeff" + GNSS,
        "\n\n" + GNSS + "\n\n",
        GNSS.replace("time_s,", " time_s , "),
        GNSS.replace("47.5", " +47.50e0 ").replace("19.0", '"19.0"'),
        'extra,longitude_deg,,time_s,,latitude_deg\n"a,\nb",19.0,x,0.0,y,47.5\nb,19.1,,1.0,,47.6\n',
    ],
)
def test_ways_of_writing_the_same_table(folder, text):
    run = read_run(folder(gnss=text))
    np.testing.assert_array_equal(np.degrees(run.gnss.latitude).round(12), [47.5, 47.6])
    np.testing.assert_array_equal(np.degrees(run.gnss.longitude).round(12), [19.0, 19.1])
    np.testing.assert_array_equal(run.gnss.time, [0, 1])


@pytest.mark.parametrize("kind", [pa.float64(), pa.float32(), pa.int32(), pa.decimal128(20, 6)])
def test_parquet_wherever_csv(folder, kind):
    path = folder(toml='[gnss]\nfile = "gnss.parquet"\n[balise]\nfile = "balise.parquet"\nformat = "parquet"\n')
    columns = {"time_s": [0, 1], "latitude_deg": [47, 48], "longitude_deg": [19, 20], "height_m": [None, 120]}
    pq.write_table(
        pa.table({key: pa.array(value, pa.int32()).cast(kind) for key, value in columns.items()}), path / "gnss.parquet"
    )
    pq.write_table(pa.table({"time_s": [0.0, 1.0], "id": ["a", "b"]}), path / "balise.parquet")
    run = read_run(path)
    np.testing.assert_array_equal(np.degrees(run.gnss.latitude).round(9), [47, 48])
    np.testing.assert_array_equal(run.gnss.height, [np.nan, 120])
    assert run.balise.id == ("a", "b")


def test_column_that_is_empty_throughout_is_absent(folder):
    run = read_run(folder(gnss="time_s,latitude_deg,longitude_deg,sigma_east_m,course_deg\n0,47,19,,\n1,47,19,nan,\n"))
    assert run.gnss.sigma_east is None
    assert run.gnss.course is None


def test_all_real_runs_read(shared_data):
    rows = 0
    for contents in sorted([*shared_data.glob("line80/*/run.toml"), *shared_data.glob("hev_cinkota/*/run.toml")]):
        run = read_run(contents.parent)
        rows += len(run.gnss)
        assert run.direction
        assert run.gnss.receiver
        assert np.isfinite(run.gnss.latitude).all()
    assert rows > 300_000
    run = read_run(shared_data / "sample_run")
    assert len(run.imu) == 83429
    assert len(run.odometer) == 8343
    assert abs(run.imu.specific_force[:, 2].mean() + 9.81) < 0.1


# --- what is refused: the table ---------------------------------------------------------------------------------------

TABLES = {
    "missing column": (
        "time_s,latitude_deg\n0,47\n",
        "gnss.csv, row 1, column longitude_deg: required column is missing; the file has: time_s, latitude_deg",
    ),
    "semicolons": (
        "time_s;latitude_deg;longitude_deg\n0;47,5;19\n",
        "gnss.csv, row 1, column time_s: required column is missing; fields are separated by semicolons: use commas and a decimal point",
    ),
    "column twice": (
        "time_s,latitude_deg,longitude_deg,time_s\n0,47,19,0\n",
        "gnss.csv, row 1, column time_s: column stands twice; keep one of them",
    ),
    "empty cell": (
        "time_s,latitude_deg,longitude_deg\n0,47,19\n1,,19\n",
        "gnss.csv, row 3, column latitude_deg: is empty or not a number; remove rows without a fix",
    ),
    "not a number": (
        "time_s,latitude_deg,longitude_deg\n0,47,19\n1,nan,19\n",
        "gnss.csv, row 3, column latitude_deg: is empty or not a number; remove rows without a fix",
    ),
    "infinite": (
        "time_s,latitude_deg,longitude_deg\n0,47,19\n1,47,19\ninf,47,19\n",
        "gnss.csv, row 4, column time_s: is infinite; remove the row or fill the cell",
    ),
    "overflow": (
        "time_s,latitude_deg,longitude_deg,height_m\n0,47,19,1e999\n",
        "gnss.csv, row 2, column height_m: is infinite; remove the row or fill the cell",
    ),
    "word": (
        "time_s,latitude_deg,longitude_deg\n0,47,19\n\n1,47,none\n",
        "gnss.csv, row 4, column longitude_deg: 'none' is not a number; correct the cell, or remove the row",
    ),
    "decimal comma": (
        'time_s,latitude_deg,longitude_deg\n0,"47,5",19\n',
        "gnss.csv, row 2, column latitude_deg: '47,5' is not a number; use a decimal point",
    ),
    "time backwards": (
        "time_s,latitude_deg,longitude_deg\n0,47,19\n2.5,47,19\n\n2,47,19\n",
        "gnss.csv, row 5, column time_s: time runs backwards (2 s after 2.5 s); "
        "sort the rows, or split the file where the clock was set back",
    ),
    "one instant": (
        "time_s,latitude_deg,longitude_deg\n0,47,19\n0.1,47,19\n0.1,47,19\n",
        "gnss.csv, row 4, column time_s: two rows at one instant (0.10000000000000001 s); keep one of them",
    ),
    "sigma zero": (
        "time_s,latitude_deg,longitude_deg,sigma_east_m\n0,47,19,\n1,47,19,0\n",
        "gnss.csv, row 3, column sigma_east_m: 0 is not positive; leave the cell empty where nothing is known",
    ),
    "sigma negative": (
        "time_s,latitude_deg,longitude_deg,sigma_up_m\n0,47,19,-1.5\n",
        "gnss.csv, row 2, column sigma_up_m: -1.5 is not positive; leave the cell empty where nothing is known",
    ),
    "latitude": (
        "time_s,latitude_deg,longitude_deg\n0,90.5,19\n",
        "gnss.csv, row 2, column latitude_deg: 90.5 is outside -90 to 90; correct the value or its unit",
    ),
    "longitude": (
        "time_s,latitude_deg,longitude_deg\n0,47,-181\n",
        "gnss.csv, row 2, column longitude_deg: -181 is outside -180 to 180; correct the value or its unit",
    ),
    "short row": (
        "time_s,latitude_deg,longitude_deg\n0,47,19\n1,47,19\n2,4",
        "gnss.csv, row 4: has 2 cells where the header has 3; complete the row or remove it",
    ),
    "long row": (
        "time_s,latitude_deg,longitude_deg\n0,47,19,3\n",
        "gnss.csv, row 2: has 4 cells where the header has 3; complete the row or remove it",
    ),
    "row after a cell of two lines": (
        'note,time_s,latitude_deg,longitude_deg\n"a\nb",0,47,19\nc,1,47,200\n',
        "gnss.csv, row 4, column longitude_deg: 200 is outside -180 to 180; correct the value or its unit",
    ),
    "header only": (
        "time_s,latitude_deg,longitude_deg\n\n",
        "gnss.csv: has a header and no rows; leave the file out where nothing was recorded",
    ),
    "nothing": ("", "gnss.csv: is empty; a table starts with one header row"),
    "blank lines": ("\n \n", "gnss.csv: is empty; a table starts with one header row"),
    "not UTF-8": (
        b"time_s,latitude_deg,longitude_deg,note\n0,47,19,a\n1,47,19,M\xfcnchen\n",
        "gnss.csv, row 3: is not UTF-8 text; save it as UTF-8",
    ),
    "UTF-16": (GNSS.encode("utf-16"), "gnss.csv, row 1: is not UTF-8 text; save it as UTF-8"),
}


@pytest.mark.parametrize("case", TABLES)
def test_table_is_refused_with_row_and_column(folder, case):
    text, message = TABLES[case]
    assert refusal(folder(gnss=text)) == message


ODOMETER = {
    "neither": (
        "time_s\n0\n",
        "odometer.csv, row 1: neither distance_m nor speed_m_s has values; an odometer needs one of these columns",
    ),
    "hole": (
        "time_s,speed_m_s\n0,1\n1,\n",
        "odometer.csv, row 3, column speed_m_s: is empty or not a number; remove rows without a reading",
    ),
    "falls": (
        "time_s,distance_m\n0,100\n1,\n2,99.5\n".replace("1,\n", "1,100\n"),
        "odometer.csv, row 4, column distance_m: cumulative distance falls from 100 to 99.5 m; "
        "set signed = true under [odometer] in run.toml, or split the run",
    ),
}


@pytest.mark.parametrize("case", ODOMETER)
def test_odometer_is_refused(folder, case):
    text, message = ODOMETER[case]
    assert refusal(folder(odometer=text)) == message


def test_odometer_may_tremble(folder):
    assert len(read_run(folder(odometer="time_s,distance_m\n0,100\n1,99.95\n")).odometer) == 2


def test_gauge_in_metres_and_nameless_balise_are_refused(folder):
    assert "gauge.csv, row 2, column gauge_mm: 1.435 is outside 100 to 5000" in refusal(
        folder(gauge="time_s,gauge_mm\n0,1.435\n")
    )
    assert "balise.csv, row 3, column id: is empty" in refusal(folder(balise="time_s,id\n0,a\n1,\n"))


def test_offset_that_merges_stamps_is_refused(folder):
    path = folder(gnss=GNSS.replace("1.0,", "1e-12,"), toml="time_offset_s = 1e6\n")
    assert "gnss.csv, row 3, column time_s: two rows at one instant" in refusal(path)


@pytest.mark.parametrize("bound", ["constants", "memory"])
def test_huge_files_are_refused(folder, monkeypatch, bound):
    """By what is read at most anywhere, and by what this machine can hold."""
    if bound == "constants":
        monkeypatch.setattr(tables, "MAX_CSV_BYTES", 60)
        monkeypatch.setattr(tables, "MAX_TABLE_BYTES", 30)
    path = folder(gnss=GNSS)
    if bound == "memory":
        read_run(path)
        monkeypatch.setattr(tables, "_memory", lambda: 90)
    assert "gnss.csv: is 0.0 GB; text up to 0.0 GB is read on this machine; split the run" in refusal(path)
    path = folder(toml='[gnss]\nfile = "gnss.parquet"\n')
    pq.write_table(
        pa.table({"time_s": [0.0, 1.0], "latitude_deg": [0.0, 1.0], "longitude_deg": [0.0, 1.0]}), path / "gnss.parquet"
    )
    assert "gnss.parquet: has 2 rows; tables up to 0 GB are read on this machine" in refusal(path)


def test_parquet_is_refused_with_its_cause(folder):
    path = folder(toml='[gnss]\nfile = "gnss.parquet"\n')
    target = path / "gnss.parquet"
    target.write_bytes(b"PAR1 no more")
    assert "gnss.parquet: is no readable Parquet file" in refusal(path)
    columns = {"time_s": [0.0, 1.0], "latitude_deg": ["47", "48"], "longitude_deg": [0.0, 1.0]}
    pq.write_table(pa.table(columns), target)
    assert "gnss.parquet, column latitude_deg: holds string, not numbers" in refusal(path)
    pq.write_table(pa.table({"time_s": [0.0, None], "latitude_deg": [0.0, 0], "longitude_deg": [0.0, 1.0]}), target)
    assert "gnss.parquet, row 3, column time_s: is empty or not a number" in refusal(path)
    pq.write_table(pa.table({"time_s": [0.0]}), target)
    assert "gnss.parquet, row 1, column latitude_deg: required column is missing" in refusal(path)
    pq.write_table(pa.table({"time_s": pa.array([], pa.float64())}), target)
    assert "required column is missing" in refusal(path)
    data = target.read_bytes()
    target.write_bytes(data[: len(data) // 2])
    assert "gnss.parquet: is no readable Parquet file" in refusal(path)


# --- what is refused: run.toml ----------------------------------------------------------------------------------------

CONTENTS = {
    "no streams": (
        HEAD,
        "run.toml: names no stream; a stream is one of gnss, imu, odometer, gyro_angles, gauge, balise",
    ),
    "no run": ('[gnss]\nfile = "gnss.csv"', "run.toml: the table [run] is missing; add [run] with id and start"),
    "no id": ('[run]\nstart = "2021-06-29T10:35:17Z"', 'run.toml, column run.id: is missing; add id = "'),
    "no start": ('[run]\nid = "a"', 'run.toml, column run.start: is missing; add start = "2021-06-29T10:35:17Z"'),
    "no zone": (
        HEAD.replace("Z", "") + '[gnss]\nfile = "gnss.csv"\n',
        "run.toml, column run.start: '2021-06-29T10:35:17' has no time zone; write UTC",
    ),
    "no instant": (
        HEAD.replace("10:35:17Z", "23:59:60Z") + '[gnss]\nfile = "gnss.csv"\n',
        "run.toml, column run.start: '2021-06-29T23:59:60Z' is no instant; write UTC",
    ),
    "a date": (
        HEAD.replace('"2021-06-29T10:35:17Z"', "2021-06-29") + '[gnss]\nfile = "gnss.csv"\n',
        "run.toml, column run.start: '2021-06-29T00:00:00' has no time zone",
    ),
    "year 1": (
        HEAD.replace('"2021-06-29T10:35:17Z"', '"0001-01-01T00:00:00+05:00"') + '[gnss]\nfile = "gnss.csv"\n',
        "is no instant; write UTC",
    ),
    "id number": (HEAD.replace('"a"', "3"), "run.toml, column run.id: expected `str`, got `int`"),
    "no file": (HEAD + '[gnss]\nformat = "csv"\n', "run.toml, column gnss: object missing required field `file`"),
    "list": (HEAD + '[[gnss]]\nfile = "gnss.csv"\n', "run.toml, column gnss: expected `object | null`, got `array`"),
    "lever arm": (
        HEAD + '[gnss]\nfile = "gnss.csv"\nlever_arm_m = [1, 2]\n',
        "run.toml, column gnss.lever_arm_m: expected `array` of length 3, got 2",
    ),
    "lever arm nan": (
        HEAD + '[gnss]\nfile = "gnss.csv"\nlever_arm_m = [1, 2, nan]\n',
        "run.toml, column gnss.lever_arm_m: is not finite",
    ),
    "offset": (
        HEAD + '[gnss]\nfile = "gnss.csv"\ntime_offset_s = inf\n',
        "run.toml, column gnss.time_offset_s: expected `float` <=",
    ),
    "escape": (
        HEAD + '[gnss]\nfile = "../../etc/passwd"\n',
        "run.toml, column gnss.file: '../../etc/passwd' lies outside the run folder; put the file into the folder",
    ),
    "absolute": (
        HEAD + '[gnss]\nfile = "/etc/passwd"\n',
        "run.toml, column gnss.file: '/etc/passwd' lies outside the run folder; put the file into the folder",
    ),
    "link": (
        HEAD + '[gnss]\nfile = "link.csv"\n',
        "run.toml, column gnss.file: 'link.csv' lies outside the run folder",
    ),
    "NUL": (HEAD + '[gnss]\nfile = "a\\u0000b"\n', "run.toml, column gnss.file: 'a\\x00b' is no usable path"),
    "absent": (HEAD + '[gnss]\nfile = "gone.csv"\n', "gone.csv: does not exist; check the name"),
    "folder": (HEAD + '[gnss]\nfile = "."\n', "is a folder; name the file in it"),
    "format": (
        HEAD + '[gnss]\nfile = "a.bin"\nformat = "sirf"\n',
        "run.toml, column gnss.format: 'sirf' is no format that is read here; csv, parquet, nmea",
    ),
    "format of another stream": (
        HEAD + '[imu]\nfile = "a.nmea"\nformat = "nmea"\n',
        "run.toml, column imu.format: 'nmea' is no format that is read here; csv, parquet, ubx are; convert the stream to CSV",
    ),
    "no TOML": ("[run\nid = 3", "run.toml: is no TOML ("),
    "nested": ("a = " + "[" * 5000, "run.toml: is no TOML ("),
    "not UTF-8": (b'[run]\nid = "\xfc"', "run.toml: is not UTF-8 text; save it as UTF-8"),
    "huge": (b"#" * 1_000_001, "run.toml: is larger than 1 MB"),
}


@pytest.mark.parametrize("case", CONTENTS)
def test_run_toml_is_refused(tmp_path, case):
    text, message = CONTENTS[case]
    folder = tmp_path / "run"
    folder.mkdir()
    (tmp_path / "outside.csv").write_text(GNSS)
    (folder / "link.csv").symlink_to("../outside.csv")
    (folder / "run.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    assert message in refusal(folder)


def test_what_is_no_run_folder_is_refused(tmp_path):
    assert refusal(tmp_path) == "FOLDER: the folder holds no run.toml; name a run folder, or write one"
    assert refusal(tmp_path / "gone") == "FOLDER: does not exist; a run is a folder that holds run.toml"
    (tmp_path / "file").write_text("")
    assert refusal(tmp_path / "file") == "FOLDER: is no run folder; a run is a folder that holds run.toml"


# --- laws -------------------------------------------------------------------------------------------------------------

cells = st.one_of(
    st.floats(allow_nan=True).map(repr),
    st.integers(-(10**20), 10**20).map(str),
    st.sampled_from(
        ["", " ", "nan", "-inf", '"', '""', "1,2", "1_0", "0x1", "٣", "\x00", "\r", "é", "1e", "+.5", "--1"]
    ),
    st.text(max_size=5),
)


def read_or_refusal(path):
    try:
        return read_run(path)
    except RunError as error:
        return error


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rows=st.lists(st.lists(cells, min_size=2, max_size=4), max_size=6))
@example(rows=[["0", "47", "19"], ["1", "47", '"19']])
def test_any_table_is_read_or_refused(folder, rows):
    text = "time_s,latitude_deg,longitude_deg\n" + "\n".join(",".join(row) for row in rows)
    path = folder(gnss=text.encode("utf-8", "surrogatepass"))
    found = read_or_refusal(path)
    if isinstance(found, RunError):
        assert found.file is not None
        assert "\n" not in str(found)
    else:
        assert (np.diff(found.gnss.time) > 0).all()
        assert np.isfinite(found.gnss.latitude).all()


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    data=st.binary(max_size=200),
    where=st.sampled_from(["gnss.csv", "gnss.csv after header", "run.toml", "gnss.parquet"]),
)
def test_any_bytes_are_read_or_refused(folder, data, where):
    path = folder(gnss=GNSS)
    match where:
        case "gnss.csv":
            (path / "gnss.csv").write_bytes(data)
        case "gnss.csv after header":
            (path / "gnss.csv").write_bytes(b"time_s,latitude_deg,longitude_deg\n" + data)
        case "run.toml":
            (path / "run.toml").write_bytes(HEAD.encode() + data)
        case _:
            folder(toml='[gnss]\nfile = "gnss.parquet"\n')
            (path / "gnss.parquet").write_bytes(b"PAR1" + data + b"PAR1")
    read_or_refusal(path)


def full_run(random):
    time = np.round(np.cumsum(random.uniform(0.01, 2, 50)), 6)
    some = np.where(random.random(50) < 0.2, np.nan, random.uniform(0.1, 3, 50))
    return Run(
        id='run "7"\\ü\x7f',
        start=datetime(2026, 5, 4, 8, 0, 0, 250_000, tzinfo=timezone(timedelta(hours=2))),
        direction="A → B",
        gnss=GnssStream(
            time,
            random.uniform(-1.5, 1.5, 50),
            random.uniform(-3, 3, 50),
            height=some * 100,
            sigma_east=some,
            course=some,
            satellites=np.full(50, 7.0),
            lever_arm_b=np.array([1.2, -0.0, -3.1]),
            receiver="x",
        ),
        imu=ImuStream(
            time, random.normal(0, 0.1, (50, 3)), random.normal(0, 9, (50, 3)), mounting=np.radians([0.1, -3, 185.35])
        ),
        odometer=OdometerStream(time, distance=np.cumsum(random.normal(0, 5, 50)), signed=True),
        gyro_angles=GyroAnglesStream(time, some * 0 + 1, np.zeros(50), np.ones(50))
        if not np.isnan(some).any()
        else None,
        gauge=GaugeStream(time, random.uniform(1.42, 1.45, 50), cant=random.uniform(-0.15, 0.15, 50)),
        balise=BaliseStream(time[:3], ("a,b", 'c"d', "e\nf")),
    )


def truth_of(random):
    return Truth(
        track_id=("80R-01", "80L-01"),
        time=np.arange(20) * 0.1,
        track=np.repeat([1, 0], 10),
        offset=random.uniform(0, 1000, 20),
        speed=random.normal(0, 20, 20),
        latitude=random.uniform(-1.5, 1.5, 20),
        longitude=random.uniform(-3, 3, 20),
        height=np.full(20, np.nan),
        heading=random.uniform(0, 6.2, 20),
    )


def test_writing_keeps_every_value_and_says_the_same_twice(tmp_path):
    random = np.random.default_rng(5)
    run, truth = full_run(random), truth_of(random)
    write_run(run, tmp_path / "a", truth=truth)
    again = read_run(tmp_path / "a")
    assert (again.id, again.start, again.direction) == (run.id, run.start, run.direction)
    for name in ("gnss", "imu", "odometer", "gauge", "balise"):
        before, after = getattr(run, name), getattr(again, name)
        for attribute in before.__slots__:
            x, y = getattr(before, attribute), getattr(after, attribute)
            if isinstance(x, np.ndarray):
                np.testing.assert_allclose(
                    y, x, rtol=0, atol=6e-6 if x.ndim == 1 else 6e-9, err_msg=f"{name}.{attribute}"
                )
            else:
                assert x == y, f"{name}.{attribute}"
    np.testing.assert_allclose(again.gnss.latitude, run.gnss.latitude, rtol=0, atol=1e-12)  # 6 micrometres
    found = read_truth(tmp_path / "a" / "truth.csv")
    assert [found.track_id[i] for i in found.track] == [truth.track_id[i] for i in truth.track]
    np.testing.assert_allclose(found.offset, truth.offset, rtol=0, atol=5.1e-6)
    np.testing.assert_allclose(found.heading, truth.heading, rtol=0, atol=1e-9)
    write_run(again, tmp_path / "b", truth=found)
    for file in sorted((tmp_path / "a").iterdir()):
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes(), file.name


def test_written_text_is_plain(tmp_path):
    run = Run(
        "a", datetime(2026, 5, 4, tzinfo=UTC), odometer=OdometerStream(np.array([0.0, 0.1]), np.array([-0.0, 1e-7]))
    )
    write_run(run, tmp_path / "a")
    assert (tmp_path / "a" / "odometer.csv").read_text() == "time_s,distance_m\n0,0\n0.1,0\n"
    values = tomllib.loads((tmp_path / "a" / "run.toml").read_text())
    assert json.loads(json.dumps(values)) == {
        "run": {"id": "a", "start": "2026-05-04T00:00:00Z"},
        "odometer": {"file": "odometer.csv", "format": "csv"},
    }


def test_writing_refuses_what_could_not_be_read(tmp_path):
    with pytest.raises(RunError, match="the run has no stream to write"):
        write_run(Run("a", datetime.now(UTC)), tmp_path / "a")
    empty = OdometerStream(np.zeros(0), np.zeros(0))
    with pytest.raises(RunError, match="the odometer stream has no rows"):
        write_run(Run("a", datetime.now(UTC), odometer=empty), tmp_path / "a")
    run = Run("a", datetime.now(UTC), odometer=OdometerStream(np.arange(2.0), np.arange(2.0)))
    write_run(run, tmp_path / "a")
    write_run(run, tmp_path / "a")
    (tmp_path / "a" / "my notes.txt").write_text("do not touch")
    with pytest.raises(InputError, match=r"the folder is not empty \(it holds my notes.txt\)"):
        write_run(run, tmp_path / "a")
    assert (tmp_path / "a" / "my notes.txt").read_text() == "do not touch"
