"""What each verb does when all is well: files, words, one JSON object, exit code 0, and nothing on stderr."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from railnav.cli import main
from railnav.cli.simulate import _straightest, _way
from railnav.evaluation import truth_as_solution
from railnav.io.geopackage import read_model
from railnav.io.run import read_run
from railnav.io.truth import read_truth
from railnav.simulation import demo_line


@pytest.fixture
def here(stock: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The stock folder as the current one, with a solution whose error along is known: 1.5 m."""
    model = read_model(stock / "line.gpkg")
    truth_as_solution(read_truth(stock / "truth.csv"), model, along=1.5).to_file(stock / "solution.csv")
    monkeypatch.chdir(stock)
    return stock


def run(*arguments: str) -> str:
    done = CliRunner().invoke(main, arguments)
    assert done.exception is None, done.output
    assert done.exit_code == 0, done.output
    said = [line for line in done.stderr.splitlines() if not line.startswith("railnav: warning: ")]
    assert said == [], "progress stays silent without a terminal"
    return done.stdout


def run_json(*arguments: str) -> dict[str, Any]:
    value = json.loads(run(*arguments, "--json"))
    assert isinstance(value, dict)
    return value


def test_info_of_a_model(here: Path) -> None:
    facts = run_json("info", "line.gpkg")
    assert facts["kind"] == "model"
    assert len(facts["tracks"]) == 36
    branch = next(track for track in facts["tracks"] if track["track"] == "78-01")
    assert abs(branch["length_m"] - 4000.377) < 0.01
    assert branch["line"] == "78"
    assert facts["nodes"]["buffer_stop"] == 1
    assert facts["operation_accuracy_m"] == 0.0
    text = run("info", "line.gpkg")
    assert "36, together 57.276 km" in text
    assert "4,000.377 m" in text
    assert "1 buffer stop" in text
    assert "exact, no datum shift" in text


def test_info_of_a_run(here: Path) -> None:
    facts = run_json("info", "service")
    recorded = read_run(here / "service")
    assert recorded.gnss is not None
    assert facts["streams"]["gnss"]["rows"] == len(recorded.gnss)
    assert facts["streams"]["gnss"]["rate_hz"] == pytest.approx(1.0)
    assert set(facts["streams"]) == {"gnss", "imu", "odometer"}
    text = run("info", "service")
    assert "1.00 Hz" in text
    assert "10.00 Hz" in text or "10.0 Hz" in text


def test_info_of_a_solution_and_of_truth(here: Path) -> None:
    facts = run_json("info", "solution.csv")
    assert (facts["kind"], facts["placed"]) == ("solution", facts["epochs"])
    assert facts["tracks"] == ["77R-01", "77R-02", "77R-03"]
    assert "77R-01 > 77R-02 > 77R-03" in run("info", "solution.csv")
    truth = run_json("info", "truth.csv")
    assert (truth["kind"], truth["tracks"]) == ("truth", facts["tracks"])
    assert "77R-01 > 77R-02 > 77R-03" in run("info", "truth.csv")


def test_validate_finds_nothing_in_good_data(here: Path) -> None:
    good = {"file": "line.gpkg", "kind": "model", "valid": True, "defects": [], "remarks": []}
    assert run_json("validate", "line.gpkg") == good
    assert "no defects" in run("validate", "line.gpkg")
    assert run_json("validate", "service")["valid"]


def test_validate_reports_every_defect_at_once(here: Path) -> None:
    from dataclasses import replace

    model = demo_line(spacing=5.0)
    easting = model.easting.copy()
    for track in ("77R-02", "78-01"):
        easting[model.knots(track).start] += 0.4
    replace(model, easting=easting).to_file(here / "bent.gpkg")
    done = CliRunner().invoke(main, ["validate", "bent.gpkg"])
    assert done.exit_code == 1
    assert "77R-02" in done.stdout
    assert "78-01" in done.stdout
    assert done.stderr == ""
    done = CliRunner().invoke(main, ["validate", "bent.gpkg", "--json"])
    assert done.exit_code == 1
    report = json.loads(done.stdout)
    assert not report["valid"]
    assert len(report["defects"]) >= 2


def test_convert_a_model_there_and_back(here: Path) -> None:
    assert "written" in run("convert", "line.gpkg", "-o", "out.geojson")
    assert run_json("import", "out.geojson", "-o", "back.gpkg", "--spacing", "5")["output"] == "back.gpkg"
    before, after = read_model(here / "line.gpkg"), read_model(here / "back.gpkg")
    assert before.track_id == after.track_id
    np.testing.assert_allclose(after.lengths, before.lengths, atol=0.01)


def test_import_into_another_plane(here: Path) -> None:
    facts = run_json("import", "line.geojson", "-o", "gk3.gpkg", "--crs", "gk3", "--spacing", "10")
    assert "3-degree" in facts["crs"] + facts["operation"]
    facts = run_json("import", "line.geojson", "-o", "utm.gpkg", "--crs", "32632", "--spacing", "10")
    assert "UTM zone 32N" in facts["crs"]
    assert abs(facts["length_m"] - 57276.0) < 2.0, "true ground length does not depend on the plane"


def test_import_elements(here: Path) -> None:
    """A straight of 100 m, then a quarter circle to the right of 400 m radius; lengths in the plane, as the table has them."""
    quarter = 400.0 * np.pi / 2
    (here / "elements.csv").write_text(
        "track,sequence,start_m,length_m,element,radius_start_m,radius_end_m,easting_m,northing_m,grid_bearing_deg\n"
        "1,1,0,100,straight,,,3460000,5480000,90\n"
        f"1,2,100,{quarter},arc,400,400,3460100,5480000,90\n"
    )
    facts = run_json("import", "elements.csv", "-o", "elements.gpkg", "--crs", "31467")
    assert facts["length_m"] == pytest.approx(100.0 + quarter, rel=1e-4)
    assert facts["tracks"][0]["tightest_radius_m"] == pytest.approx(400.0, rel=1e-3)
    model = read_model(here / "elements.gpkg")
    assert model.easting[-1] == pytest.approx(3460500.0, abs=0.01)
    assert model.northing[-1] == pytest.approx(5479600.0, abs=0.01)
    for plane in ([], ["--crs", "gk3"]):
        done = CliRunner().invoke(main, ["import", "elements.csv", "-o", "other.gpkg", *plane])
        assert (done.exit_code, len(done.stderr.splitlines())) == (1, 1)
        assert "--crs EPSG" in done.stderr


@pytest.mark.parametrize("ending", ["parquet", "gpkg", "geojson", "csv"])
def test_convert_a_solution(here: Path, ending: str) -> None:
    facts = run_json("convert", "solution.csv", "-o", f"out.{ending}")
    assert facts["kind"] == "solution"
    assert run_json("info", f"out.{ending}")["tracks"] == ["77R-01", "77R-02", "77R-03"]


def test_evaluate(here: Path) -> None:
    found = run_json("evaluate", "solution.csv", "truth.csv", "-m", "line.gpkg")
    assert found["along"]["rms"] == pytest.approx(1.5, abs=0.01)
    assert found["selection"]["rate"] == 1.0
    assert found["jumps"]["illegal"] == []
    text = run("evaluate", "solution.csv", "truth.csv", "-m", "line.gpkg", "--report", "page.html")
    assert "1.50 m RMS" in text
    assert "100 %" in text
    assert "0 illegal" in text
    page = (here / "page.html").read_text(encoding="utf-8")
    assert "Content-Security-Policy" in page
    assert "1.50 m" in page


def test_simulate_is_repeatable_and_lawful(here: Path) -> None:
    arguments = ("-m", "line.gpkg", "--route", "77R-01,77R-03", "--seed", "9", "--outage", "60-90", "--top-speed", "80")
    first = run_json("simulate", *arguments, "-o", "a")
    assert first["route"] == ["77R-01", "77R-02", "77R-03"]
    assert first["streams"]["gnss"]["longest_gap_s"] >= 30.0
    assert "Truth: b/truth.csv" in run("simulate", *arguments, "-o", "b")
    for name in ("gnss.csv", "imu.csv", "odometer.csv", "truth.csv"):
        assert (here / "a" / name).read_bytes() == (here / "b" / name).read_bytes()
    speed = read_truth(here / "a" / "truth.csv").speed
    assert float(speed.max()) <= 80 / 3.6 + 1e-6


def test_simulate_finds_its_way(here: Path) -> None:
    facts = run_json("simulate", "-m", "line.gpkg", "-o", "long", "--grade", "phone")
    assert len(facts["route"]) == 13, "the main track from end to end, off the crossovers"
    assert set(facts["streams"]) == {"gnss"}
    model = demo_line(spacing=20.0)
    assert _way(model, ("77R-01", "78-01"))[-2:] == ("77R-09", "78-01")
    assert _straightest(model, model.routes("77R-01", "77R-03")) == ("77R-01", "77R-02", "77R-03")


@pytest.mark.parametrize("ending", ["png", "svg", "html"])
@pytest.mark.parametrize("file", ["line.gpkg", "solution.csv", "line.geojson"])
def test_view(here: Path, file: str, ending: str) -> None:
    more = ("-m", "line.gpkg") if file == "solution.csv" else ()
    assert run_json("view", file, *more, "-o", f"out.{ending}")["output"] == f"out.{ending}"
    assert (here / f"out.{ending}").stat().st_size > 10_000


def test_view_names_its_own_output(here: Path) -> None:
    assert run("view", "solution.csv") == "solution.html written\n"
    assert (here / "solution.html").is_file()


@pytest.mark.parametrize("ending", ["csv", "parquet", "gpkg", "geojson"])
def test_navigate(here: Path, ending: str) -> None:
    facts = run_json("navigate", "service", "-m", "line.gpkg", "-o", f"out.{ending}")
    assert facts["placed"] > 0.9 * facts["epochs"]
    assert facts["output"] == f"out.{ending}"
    found = run_json("evaluate", f"out.{ending}", "truth.csv", "-m", "line.gpkg")
    assert found["along"]["rms"] < 2.0
    assert found["jumps"]["illegal"] == []


def test_navigate_smooths(here: Path) -> None:
    text = run("navigate", "service", "-m", "line.gpkg", "-o", "out.csv", "--smooth", "--integrity-risk", "1e-5")
    assert "smoothed" in text
    assert "risk 1e-05" in text


def test_build(here: Path) -> None:
    text = run("build", "survey-1", "survey-2", "-o", "built.gpkg", "--report", "built.html", "--spacing", "2")
    assert "survey-1" in text
    assert "Page: built.html" in text
    facts = run_json("info", "built.gpkg")
    assert "build" in facts["provenance"]
    assert (here / "built.html").is_file()
    assert (
        run_json("build", "survey-1", "survey-2", "-o", "again.gpkg", "--spacing", "2")["length_m"] == facts["length_m"]
    )


def test_the_commands_of_the_issue_on_the_sample_run(
    shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sample = shared_data / "sample_run"
    if not sample.is_dir():
        pytest.skip("the sample run is not here")
    monkeypatch.chdir(tmp_path)
    run("import", str(sample / "network.geojson"), "-o", "s.gpkg")
    run("navigate", str(sample), "-m", "s.gpkg", "-o", "s.csv")
    found = run_json("evaluate", "s.csv", str(sample / "truth.csv"))
    assert found["selection"]["rate"] == 1.0
    assert found["along"]["rms"] < 1.0


def test_a_demo_that_fails_leaves_the_older_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from railnav.errors import RailnavError

    older = tmp_path / "demo"
    older.mkdir()
    (older / "report.html").write_text("older")
    (older / "old.txt").write_text("")

    def fails(folder: Path, *_: object) -> None:
        (folder / "half.txt").write_text("")
        raise RailnavError("no luck")

    monkeypatch.setattr("railnav.cli.demo._demo", fails)
    done = CliRunner().invoke(main, ["demo", "-o", str(older)])
    assert (done.exit_code, done.stderr) == (1, "railnav: error: no luck\n")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["demo", "old.txt", "report.html"]

    def succeeds(folder: Path, *_: object) -> tuple[dict[str, object], list[str]]:
        (folder / "report.html").write_text("newer")
        return {}, ["done"]

    monkeypatch.setattr("railnav.cli.demo._demo", succeeds)
    done = CliRunner().invoke(main, ["demo", "-o", str(older)])
    assert done.exit_code == 0
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["demo", "report.html"]
    assert (older / "report.html").read_text() == "newer"


def test_the_second_core_is_given_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process that compiles meanwhile ends with the demo, however that ends; without need there is none."""
    import time

    import railnav.navigation
    from railnav.cli import demo

    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(railnav.navigation, "__file__", str(tmp_path / "__init__.py"))
    monkeypatch.setattr(demo, "_COMPILE_NAVIGATOR", "import time; time.sleep(60)")
    begin = time.perf_counter()
    with pytest.raises(KeyboardInterrupt), demo._second_core():
        raise KeyboardInterrupt
    assert time.perf_counter() - begin < 30.0
    monkeypatch.setattr(demo, "_COMPILE_NAVIGATOR", "raise SystemExit(3)")
    stages: list[tuple[str, int, int]] = []
    with demo._second_core() as compiled:
        compiled(lambda *stage: stages.append(stage))
    assert stages[-1] == ("compile, first time only", 1, 1)
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "__pycache__" / "kernels.nbi").touch()
    with demo._second_core() as compiled:
        compiled(lambda *stage: stages.append(stage))
    assert len(stages) == 2
    other = tmp_path / "cache" / f"{tmp_path.name}_0a1b"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(other.parent))
    with demo._second_core() as compiled:
        compiled(lambda *stage: stages.append(stage))
    assert len(stages) == 4
    other.mkdir(parents=True)
    (other / "kernels.nbi").touch()
    with demo._second_core() as compiled:
        compiled(lambda *stage: stages.append(stage))
    assert len(stages) == 4


@pytest.mark.slow
def test_an_interrupted_demo_leaves_nothing(tmp_path: Path) -> None:
    import signal
    import subprocess
    import sys
    import time

    process = subprocess.Popen(
        [sys.executable, "-m", "railnav", "demo", "-o", str(tmp_path / "demo")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a job in the background ignores it
    )
    time.sleep(2.5)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert "interrupted" in err
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_demo_and_every_example_of_the_help(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """House rule: run what you print. The examples of every verb run on what the demo leaves behind."""
    import inspect
    import shlex

    import click

    from railnav.cli import VERBS
    from railnav.cli.demo import next_commands

    monkeypatch.chdir(tmp_path)
    for verb in VERBS:
        command = main.get_command(click.Context(main), verb)
        assert command is not None
        lines = inspect.cleandoc(command.help or "").splitlines()
        examples = [line.split() for line in lines if line.strip().startswith(f"railnav {verb}")]
        assert examples
        for example in examples:
            if "postgresql://" not in " ".join(example):  # a server: tests/io/test_postgis.py
                run(*example[1:])
    for line in next_commands(Path("demo")):
        words = [
            w
            for word in shlex.split(line)[1:]
            for w in (sorted(map(str, Path().glob(word))) if "*" in word else [word])
        ]
        run(*words)
    page = (tmp_path / "demo" / "report.html").read_text(encoding="utf-8")
    assert "Simulated data" in page
    assert len(page.encode()) < 8e6
    facts = run_json("demo")
    assert facts["simulated"]
    assert facts["evaluation"]["selection"]["rate"] > 0.95
    assert facts["evaluation"]["jumps"]["illegal"] == []
    assert facts["model"]["axis_rms_m"] < 0.01
    assert facts["wall_s"] < 600.0
    shutil.rmtree(tmp_path / "demo")
