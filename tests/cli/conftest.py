"""A short simulated line and a run over it, as files, for every test of the command line; copied, never changed."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from railnav.io.geojson import write_geojson
from railnav.io.run import write_run
from railnav.io.truth import write_truth
from railnav.simulation import SERVICE, SURVEY, Leg, demo_line, simulate


@pytest.fixture(scope="session")
def _stock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stock")
    model = demo_line(spacing=5.0)
    model.to_file(folder / "line.gpkg")
    write_geojson(model, folder / "line.geojson")
    leg = Leg(("77R-01", "77R-02", "77R-03"), start=60.0, finish=900.0)
    run, truth = simulate(model, leg, seed=3, outfit=SERVICE, run_id="service")
    write_run(run, folder / "service")
    write_truth(truth, folder / "truth.csv")
    for k in range(2):
        survey, _ = simulate(
            model,
            leg,
            seed=11 + k,
            outfit=replace(SURVEY, angles=None, gauge=None),
            run_id=f"survey-{k + 1}",
            direction="up",
        )
        write_run(survey, folder / f"survey-{k + 1}")
    return folder


@pytest.fixture
def stock(_stock: Path, tmp_path: Path) -> Path:
    """Folder with line.gpkg, line.geojson, service/, survey-1/, survey-2/ and truth.csv."""
    folder = tmp_path / "stock"
    shutil.copytree(_stock, folder)
    return folder
