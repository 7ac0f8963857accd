"""What was simulated says so, from the run folder to the page."""

from __future__ import annotations

from dataclasses import replace

import pytest

from railnav import build, navigate
from railnav.io.geopackage import read_model
from railnav.io.run import read_run, write_run
from railnav.io.solution import read_solution, write_solution
from railnav.simulation import SERVICE, Leg, demo_line, simulate
from railnav.web.evaluation_report import evaluation_page
from railnav.web.report import SIMULATED, is_simulated, solution_page


@pytest.fixture(scope="module")
def made():
    model = demo_line(spacing=10.0)
    run, truth = simulate(model, Leg(("77R-03",), start=0.0, finish=1500.0), seed=5, outfit=SERVICE, run_id="made")
    return model, run, truth


def test_a_run_folder_says_that_it_is_simulated(made, tmp_path):
    _, run, _ = made
    write_run(run, tmp_path / "run")
    assert "simulated = true\n" in (tmp_path / "run" / "run.toml").read_text(encoding="utf-8")
    assert read_run(tmp_path / "run").simulated
    write_run(replace(run, simulated=False), tmp_path / "real")
    assert "simulated = " not in (tmp_path / "real" / "run.toml").read_text(encoding="utf-8")
    assert not read_run(tmp_path / "real").simulated


@pytest.mark.parametrize("ending", ["parquet", "gpkg", "geojson"])
def test_a_solution_and_its_pages_say_it_on(made, tmp_path, ending):
    from railnav.evaluation import evaluate

    model, run, truth = made
    for simulated in (True, False):
        solution = navigate(replace(run, simulated=simulated), model)
        write_solution(solution, tmp_path / f"s.{ending}")
        again = read_solution(tmp_path / f"s.{ending}")
        assert again.simulated is solution.simulated is simulated
    real = replace(truth, simulated=False)
    for solution, expected in ((navigate(run, model), True), (again, False)):
        assert (SIMULATED in solution_page(solution)) is expected
        assert (SIMULATED in evaluation_page(solution, real, evaluate(solution, real))) is expected


def test_a_model_built_from_simulated_runs_says_so(made, tmp_path):
    model, run, _ = made
    other, _ = simulate(model, Leg(("77R-03",), start=0.0, finish=1500.0), seed=6, outfit=SERVICE, run_id="other")
    for runs, expected in (
        ((run, replace(other, simulated=False)), True),
        ([replace(r, simulated=False) for r in (run, other)], False),
    ):
        build(runs, spacing=5.0).to_file(tmp_path / "m.gpkg")
        assert is_simulated(read_model(tmp_path / "m.gpkg")) is expected
