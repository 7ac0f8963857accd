"""Every example runs, and says what it should."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[2] / "examples"


def run(name: str) -> Any:
    return runpy.run_path(str(FOLDER / f"{name}.py"))["main"]()


def test_every_example_is_tested():
    assert {p.stem for p in FOLDER.glob("*.py")} == {
        "own_track",
        "simulate_and_judge",
        "build_and_navigate",
        "calibrate_imu",
        "other_programs",
        "through_an_outage",
    }


def test_own_track(capsys):
    model = run("own_track")
    said = capsys.readouterr().out
    assert model.length("3") == pytest.approx(300.0, abs=0.3)
    assert "1 to 3: 1 > 3" in said
    assert "2 to 3 without reversing: no way" in said
    assert "radius 49" in said or "radius 50" in said


def test_simulate_and_judge(capsys):
    evaluation = run("simulate_and_judge")
    assert "along:" in capsys.readouterr().out
    assert evaluation.along_statistics.rms < 3.0
    assert evaluation.selection.wrong_while_tracking == 0
    assert evaluation.jumps.illegal == ()
    assert evaluation.coasting


def test_build_and_navigate(capsys):
    model, evaluation = run("build_and_navigate")
    assert "built from 3 runs" in capsys.readouterr().out
    assert model.lengths.sum() == pytest.approx(3011.6, abs=3.0)
    assert evaluation.availability > 0.95
    assert evaluation.along_statistics.rms < 3.0
    assert evaluation.across_statistics.rms < 0.05
    assert evaluation.selection.compared_by == "distance"
    assert evaluation.selection.rate == 1.0


def test_calibrate_imu(capsys):
    unit, health = run("calibrate_imu")
    said = capsys.readouterr().out
    assert "accelerometer x: bias" in said
    assert "a year later: accelerometer scale y moved by +3.1" in said
    assert unit.accelerometer.positions == 18
    assert not health.healthy


def test_other_programs(capsys):
    worst, fixes = run("other_programs")
    said = capsys.readouterr().out
    assert said.count("back within") == 2
    assert max(worst.values()) < 1e-3
    assert fixes > 20


def test_through_an_outage(capsys):
    worst = run("through_an_outage")
    assert "loose" in capsys.readouterr().out
    assert worst["odometer"] < 0.5 * worst["loose"]
    assert worst["odometer, smoothed"] < worst["loose"]
    assert worst["track"] < 10.0
