"""The inertial verbs: calibrate, diagnose, align, allan, on simulated positions and runs, through the door."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from railnav.cli import main
from railnav.io.imu_calibration import read_calibration
from railnav.io.positions import read_positions


def run(*arguments: str | Path, code: int = 0) -> Result:
    done = CliRunner().invoke(main, [str(a) for a in arguments])
    assert done.exit_code == code, (done.stdout, done.stderr, done.exception)
    return done


def facts(*arguments: str | Path, code: int = 0) -> dict:
    return json.loads(run(*arguments, "--json", code=code).stdout)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench")
    run("calibrate", folder / "cube", "--simulate", "--method", "multi-position", "--unit", "STIM300", "--seed", "7")
    run("calibrate", folder / "cube", "--method", "multi-position", "-o", folder / "imu.toml", "--name", "unit 7")
    return folder


def test_calibrate_writes_what_it_says(bench: Path, tmp_path: Path) -> None:
    got = facts("calibrate", bench / "cube", "--method", "multi-position", "-o", tmp_path / "a.toml")
    file = read_calibration(tmp_path / "a.toml")
    assert got["accelerometer"]["bias_m_s2"] == pytest.approx(file.accelerometer.bias.tolist())
    assert got["accelerometer"]["positions"] == 12
    assert len(got["positions"]) == 12
    assert file.name == "cube"
    assert file.provenance.gravity == pytest.approx(9.80967, abs=1e-4)
    words = run("calibrate", bench / "cube", "--method", "multi-position", "-o", tmp_path / "b.toml").stdout
    assert "bias, mg" in words
    assert "deg/h" in words
    assert (tmp_path / "a.toml").read_text().replace('"a"', '"b"') == (tmp_path / "b.toml").read_text()


@pytest.mark.parametrize("method", ["six-position", "modified-six-position", "modified-multi-position", "turns"])
def test_every_method_runs_on_what_simulate_makes(tmp_path: Path, method: str) -> None:
    made = facts("calibrate", tmp_path / "set", "--simulate", "--method", method, "--unit", "IMU440", "--seed", "3")
    assert made["simulated"]
    got = facts("calibrate", tmp_path / "set", "--method", method, "-o", tmp_path / "imu.toml")
    what = "gyroscope" if method.startswith("modified") else "accelerometer"
    spelled = "rad_s" if what == "gyroscope" else "m_s2"
    error = np.array(got[what][f"bias_{spelled}"]) - made[f"{what}_bias_{spelled}"]
    assert np.all(np.abs(error) < 5.0 * np.array(got[what][f"sigma_bias_{spelled}"]))


@pytest.mark.parametrize(
    "method", ["six-position", "modified-six-position", "multi-position", "modified-multi-position", "turns"]
)
def test_a_plan_is_a_set_of_positions_that_can_be_solved(tmp_path: Path, method: str) -> None:
    import tomllib

    from railnav.inertial import multi_position, solvability, turned_force
    from railnav.io.positions import _up

    text = run("calibrate", "positions", "--plan", "--method", method, "--rate", "30").stdout
    planned = tomllib.loads(text)["position"]
    if method == "turns":
        assert "2 : 4 : 1" in text
        found = solvability(turned_force(*np.radians([p["turns_deg"] for p in planned]).T))
        assert (found.rank, round(found.condition, 2)) == (4, 1.79)
        return
    ups = np.array([_up(p["up"], tmp_path, 0) for p in planned])
    assert all(p.get("rate_deg_s") == (30.0 if method.startswith("modified") else None) for p in planned)
    if method.endswith("six-position"):
        assert sorted(p["up"] for p in planned) == ["+x", "+y", "+z", "-x", "-y", "-z"]
    else:
        assert len(ups) == 12
        assert multi_position(ups * [1.01, 0.99, 1.0], 1.0).condition < 4.0


def test_two_methods_and_an_earlier_file(bench: Path, tmp_path: Path) -> None:
    run(
        "calibrate",
        tmp_path / "table",
        "--simulate",
        "--method",
        "modified-six-position",
        "--unit",
        "STIM300",
        "--seed",
        "7",
    )
    got = facts(
        "calibrate",
        tmp_path / "table",
        "--method",
        "modified-six-position",
        "--keep",
        bench / "imu.toml",
        "-o",
        tmp_path / "c.toml",
    )
    assert got["name"] == "table"
    assert got["accelerometer"]["method"] == "multi-position, symmetric"
    assert got["gyroscope"]["method"] == "modified six-position"


def test_one_long_log_and_tables_without_runs(bench: Path, tmp_path: Path) -> None:
    logs = read_positions(bench / "cube").logs
    rng = np.random.default_rng(1)
    header = "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2"
    rows = []
    (tmp_path / "tables").mkdir()
    for k, log in enumerate(logs):
        block = np.hstack([log.imu.gyro, log.imu.specific_force])
        rows += [block, np.hstack([rng.normal(0, 1.0, (200, 3)), rng.normal(0, 5.0, (200, 3))])]
        table = np.column_stack([log.imu.time, block])
        np.savetxt(tmp_path / "tables" / f"p{k:02d}.csv", table, delimiter=",", header=header, comments="", fmt="%.9f")
    whole = np.vstack(rows)
    np.savetxt(
        tmp_path / "long.csv",
        np.column_stack([np.arange(1, len(whole) + 1) * 0.01, whole]),
        delimiter=",",
        header=header,
        comments="",
        fmt="%.9f",
    )
    for source in ("tables", "long.csv"):
        got = facts(
            "calibrate",
            tmp_path / source,
            "--method",
            "multi-position",
            "--latitude",
            "48.85",
            "-o",
            tmp_path / "d.toml",
        )
        assert got["accelerometer"]["positions"] == 12
        assert got["accelerometer"]["bias_m_s2"] == pytest.approx(
            read_calibration(bench / "imu.toml").accelerometer.bias.tolist(), abs=2e-3
        )
    done = run("calibrate", tmp_path / "tables", "--method", "multi-position", "-o", tmp_path / "d.toml", code=1)
    assert "local gravity is unknown" in done.stderr


def test_diagnose_says_healthy_or_what_failed(bench: Path, tmp_path: Path) -> None:
    got = facts("diagnose", bench / "cube", "--against", bench / "imu.toml")
    assert got["healthy"]
    assert got["failures"] == []
    assert "healthy: nothing moved" in run("diagnose", bench / "cube", "--against", bench / "imu.toml").stdout
    run(
        "calibrate", tmp_path / "later", "--simulate", "--method", "multi-position", "--unit", "STIM300", "--seed", "7", "--fault",
        "accelerometer bias y=0.05",
    )  # fmt: skip
    got = facts("diagnose", tmp_path / "later", "--against", bench / "imu.toml", code=1)
    assert not got["healthy"]
    assert got["failures"][0].startswith("accelerometer bias y moved by +5.")
    done = run("diagnose", tmp_path / "later", "--against", bench / "imu.toml", code=1)
    assert "failed: accelerometer bias y moved by" in done.stdout
    assert done.stderr == ""
    assert facts("diagnose", tmp_path / "later", "--against", bench / "imu.toml", "--tolerance", "6")["healthy"]


def test_align_reads_the_calibration_and_refuses_motion(stock: Path, bench: Path) -> None:
    got = facts("align", stock / "service", "--unit", "IMU440")
    assert abs(got["roll_deg"]) < 8.0
    assert got["heading_deg"] is None
    assert "cannot see the Earth's rotation" in got["heading_note"]
    assert got["end_s"] - got["begin_s"] > 2.0
    known = facts("align", stock / "service", "--calibration", bench / "imu.toml")
    assert known["calibration"] == "unit 7"
    words = run("align", stock / "service", "--unit", "IMU440").stdout
    assert "degrees (95 %)" in words
    assert "none: the gyros cannot see" in words
    done = run("align", stock / "service", "--between", "30-40", code=1)
    assert "the vehicle moves between 30 and 40 s: " in done.stderr
    (stock / "service" / "imu.toml").write_text((bench / "imu.toml").read_text())
    toml = stock / "service" / "run.toml"
    toml.write_text(toml.read_text().replace('file = "imu.csv"', 'file = "imu.csv"\ncalibration = "imu.toml"'))
    named = facts("align", stock / "service")
    assert named["calibration"] == "unit 7"
    assert named["gyro_bias_sigma_deg_h"] == pytest.approx(known["gyro_bias_sigma_deg_h"])
    wider = facts("align", stock / "service", "--unit", "STIM300")
    assert wider["gyro_bias_sigma_deg_h"] == pytest.approx(np.hypot(known["gyro_bias_sigma_deg_h"], 0.5))
    assert any("how far the gyros' biases wander" in remark for remark in named["remarks"])
    done = run("align", stock / "service", "--calibration", bench / "imu.toml", code=1)
    assert "calibrated already (by unit 7)" in done.stderr


def test_navigate_uses_the_calibration(stock: Path, tmp_path: Path) -> None:
    """A unit with a gross gyro scale error navigates worse than with its calibration, and the file is refused where it does not fit."""
    from dataclasses import replace

    from railnav.inertial import six_position
    from railnav.inertial.imu_calibration import ImuCalibration
    from railnav.io.imu_calibration import write_calibration
    from railnav.io.run import read_run, write_run

    clean = read_run(stock / "service")
    assert clean.imu is not None
    bent = replace(clean, imu=replace(clean.imu, gyro=clean.imu.gyro * 1.1 + [0.0, 0.0, 0.01]))
    write_run(bent, tmp_path / "bent")
    write_calibration(
        ImuCalibration("bent", gyroscope=six_position([1.1, 1.1, 1.11], [-1.1, -1.1, -1.09], 1.0)),
        tmp_path / "imu.toml",
    )
    solutions = {}
    for name, arguments in (
        ("clean", [stock / "service"]),
        ("corrected", [tmp_path / "bent", "--calibration", tmp_path / "imu.toml"]),
        ("raw", [tmp_path / "bent"]),
    ):
        output = tmp_path / f"{name}.csv"
        run("navigate", *arguments, "-m", stock / "line.gpkg", "-o", output)
        solutions[name] = np.genfromtxt(output, delimiter=",", names=True, dtype=None, encoding="utf-8")["offset_m"]
    np.testing.assert_allclose(solutions["corrected"], solutions["clean"], atol=0.02)
    assert not np.allclose(solutions["raw"], solutions["clean"], atol=0.02)
    done = run(
        "navigate",
        stock / "service",
        "-m",
        stock / "line.gpkg",
        "-o",
        tmp_path / "x.csv",
        "--calibration",
        tmp_path / "none.toml",
        code=1,
    )
    assert "none.toml: does not exist" in done.stderr


@pytest.mark.parametrize("ending", [".png", ".svg", ".html"])
def test_allan_draws_and_fits(bench: Path, tmp_path: Path, ending: str) -> None:
    got = facts("allan", bench / "cube" / "01", "-o", tmp_path / f"a{ending}", "--term", "random_walk")
    arw = np.degrees(got["channels"]["gyro x"]["random_walk"]) * 60.0
    assert arw == pytest.approx(0.15, rel=0.1)  # STIM300 by its sheet
    assert (tmp_path / f"a{ending}").stat().st_size > 10_000
    assert "deg/sqrt(h)" in run("allan", bench / "cube" / "01").stdout


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["calibrate", "none", "--method", "six-position", "-o", "x.toml"], 1, "none: does not exist"),
        (["calibrate", "cube", "--method", "six-position", "-o", "x.toml"], 1, "cube: position 07 lies 5"),
        (
            ["calibrate", "cube", "--method", "turns", "-o", "x.toml"],
            1,
            "turns needs the turns of each position: 01 has none",
        ),
        (["calibrate", "cube", "--method", "turns", "--turns", "1,2", "-o", "x.toml"], 2, "three angles in degrees"),
        (["calibrate", "cube", "--method", "multi-position"], 2, "--output"),
        (["calibrate", "cube", "-o", "x.toml"], 2, "--method"),
        (["calibrate", "cube", "--method", "multi-position", "-o", "x.csv"], 1, "use .toml"),
        (
            ["calibrate", "cube", "--method", "multi-position", "-o", "x.toml", "--gravity", "1"],
            1,
            "found nowhere on land",
        ),
        (["calibrate", "cube", "--method", "multi-position", "-o", "cube/positions.toml"], 1, "would be overwritten"),
        (
            ["calibrate", "cube", "--method", "multi-position", "-o", "x.toml", "--fault", "a=1"],
            2,
            "--fault goes with --simulate",
        ),
        (["calibrate", "new", "--simulate", "--method", "turns", "--fault", "baro=1"], 1, "no triad"),
        (["calibrate", "new", "--simulate", "--method", "turns", "--fault", "baro"], 2, "NAME=SIZE"),
        (["diagnose", "cube", "--against", "none.toml"], 1, "none.toml: does not exist"),
        (["diagnose", "cube", "--against", "cube/positions.toml"], 1, "table [imu] is missing"),
        (["align", "cube/01", "--between", "5"], 2, "FROM-TO"),
        (["align", "cube"], 1, "holds no run.toml"),
        (["allan", "cube"], 1, "is a folder of positions"),
        (["allan", "cube/01", "-o", "x.txt"], 1, "use .png"),
        (["allan", "cube/01", "--between", "0-0.1"], 1, "too few for an Allan deviation"),
    ],
)
def test_bad_requests_are_one_line(
    bench: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], code: int, words: str
) -> None:
    monkeypatch.chdir(bench)
    before = sorted(p.name for p in bench.iterdir())
    done = run(*arguments, code=code)
    assert words in done.stderr
    assert done.stdout == ""
    if code == 1:
        assert done.stderr.count("\n") == 1
    assert sorted(p.name for p in bench.iterdir()) == before


def spoil(folder: Path, log: str, change) -> None:
    """Change the rows of one log's IMU table."""
    file = folder / log / "imu.csv"
    header, *lines = file.read_text().splitlines()
    table = np.array([[float(v) for v in line.split(",")] for line in lines])
    change(table)
    np.savetxt(file, table, delimiter=",", header=header, comments="", fmt="%.9f")


def scaled(columns: slice, factor: float):
    def change(table: np.ndarray) -> None:
        table[:, columns] *= factor

    return change


def put(column: int, rows: slice, value: float):
    def change(table: np.ndarray) -> None:
        table[rows, column] = value

    return change


def swapped(table: np.ndarray) -> None:
    table[:, [4, 5]] = table[:, [5, 4]]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (scaled(slice(4, 7), 1 / 9.80665), "position 01: the specific force is 1.00"),
        (put(5, slice(None), 0.0), "position 01: specific force y is 0 all the time: the axis is frozen or missing"),
        (put(4, slice(0, None, 9), 19.6), "end of its range"),
        (put(0, slice(1000, None), 3.0), "imu.csv, row 1002, column time_s: time runs backwards"),
        (swapped, "position 01 should have +x up, but gravity is felt on +y"),
    ],
)
def test_damage_is_named_through_the_verb(tmp_path: Path, change, words: str) -> None:
    run("calibrate", tmp_path / "set", "--simulate", "--method", "six-position", "--unit", "STIM300")
    spoil(tmp_path / "set", "01", change)
    if words == "end of its range":  # three samples at the end of the range
        spoil(tmp_path / "set", "01", lambda table: table.__setitem__((slice(100, 160), 4), 19.6))
    done = run("calibrate", tmp_path / "set", "--method", "six-position", "-o", tmp_path / "imu.toml", code=1)
    assert words in done.stderr
    assert not (tmp_path / "imu.toml").exists()


def test_notes_of_the_operator_are_checked(bench: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(bench / "cube", tmp_path / "set")
    notes = tmp_path / "set" / "positions.toml"
    good = notes.read_text()
    for old, new, words in (
        ('log = "01"', 'log = "91"', "'91' is not in the folder"),
        ("up = [-1", 'up = "sideways" # [-1', "names no side"),
        ("latitude_deg = 48.85", "latitude_deg = 480.85", "<= 90.0"),
        ("latitude_deg", "latitude", "unknown field"),
        ("[[position]]", "[[position", "is no TOML"),
    ):
        assert old in good, old
        notes.write_text(good.replace(old, new, 1))
        done = run("calibrate", tmp_path / "set", "--method", "multi-position", "-o", tmp_path / "imu.toml", code=1)
        assert words in done.stderr
        assert "positions.toml" in done.stderr


@pytest.fixture
def still(tmp_path: Path) -> Path:
    """A run folder of a fibre-optic unit at rest for a minute: roll 0.01, pitch -0.02, heading 2 rad at 48.85 degrees."""
    from datetime import UTC, datetime

    from railnav.attitude import dcm_from_euler
    from railnav.io.run import write_run
    from railnav.run import ImuStream, Run

    rng = np.random.default_rng(3)
    C = dcm_from_euler(0.01, -0.02, 2.0)
    phi = np.radians(48.85)
    w = C.T @ (7.292115e-5 * np.array([np.cos(phi), 0.0, -np.sin(phi)])) + rng.normal(0.0, 1e-5, (3000, 3))
    f = C.T @ np.array([0.0, 0.0, -9.81]) + rng.normal(0.0, 1e-3, (3000, 3))
    write_run(
        Run("still", datetime(2026, 5, 4, tzinfo=UTC), imu=ImuStream(np.arange(1, 3001) * 0.02, w, f)),
        tmp_path / "still",
    )
    return tmp_path / "still"


def test_align_gives_heading_and_latitude_with_intervals(still: Path) -> None:
    known = ["--latitude", "48.85", "--gyro-bias", "0.05", "--accelerometer-bias", "0.1"]
    for extra in ([], ["--fine"]):
        got = facts("align", still, *known, *extra)
        for key, truth in (("roll", 0.01), ("pitch", -0.02), ("heading", 2.0)):
            assert abs(got[f"{key}_deg"] - np.degrees(truth)) < 4.0 * got[f"sigma_{key}_deg"]
        assert abs(got["latitude_deg"] - 48.85) < 4.0 * got["sigma_latitude_deg"]
        assert got["sigma_heading_deg"] < 1.0
        assert any("neither GNSS nor odometer" in remark for remark in got["remarks"])
    words = run("align", still, *known).stdout
    assert "Heading                 114" in words.replace("  +-", " +-")
    assert "Latitude" in words
    seen = facts("align", still, *known, "--antennas", "-0.83,1.82,0", "2,0,0", "--antenna-sigma", "0.02")
    assert seen["heading_by_antennas_deg"] == pytest.approx(114.5, abs=0.5)
    assert seen["sigma_heading_by_antennas_deg"] == pytest.approx(0.573, abs=0.01)
    done = run("align", still, "--antennas", "-0.83,2.82,0", "2,0,0", code=1)
    assert "longer than the mounted one" in done.stderr
    done = run("align", still, "--antennas", "1,2", "2,0,0", code=2)
    assert "three lengths in m" in done.stderr


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (scaled(slice(4, 7), 1 / 9.80665), "it is in g; multiply it by 9.80665"),
        (scaled(slice(4, 7), 100.0), "it is in Gal; multiply it by 0.01"),
        (scaled(slice(1, 4), 57.29578 * 200), "in degrees per second; multiply them by pi/180"),
        (put(6, slice(None), 0.0), "specific force z is 0 all the time: the axis is frozen or missing"),
        (put(3, slice(500, 900), 0.25), "rate z stands at 0.25 for 400 samples from sample 500"),
        (scaled(slice(6, 7), -1.0), "gravity is felt on +z, not on -z"),
        (put(4, slice(0, None, 2), 4.0), "the vehicle moves throughout|specific force"),
    ],
)
def test_align_names_what_is_wrong_with_the_log(still: Path, change, words: str) -> None:
    spoil(still.parent, "still", change)
    done = run("align", still, "--unit", "STIM300", code=1)
    assert any(part in done.stderr for part in words.split("|")), done.stderr
    assert done.stderr.count("\n") == 1


def test_align_of_a_clock_that_jumps(still: Path) -> None:
    spoil(still.parent, "still", put(0, slice(1000, None), 5.0))
    done = run("align", still, code=1)
    assert "imu.csv, row 1002, column time_s: time runs backwards" in done.stderr
