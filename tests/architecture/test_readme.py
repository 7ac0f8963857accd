"""What the README prints is run: its commands one after another, and its Python."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner

import railnav as rn
from railnav.cli import main
from railnav.io.geojson import write_geojson
from railnav.io.run import write_run
from railnav.io.truth import write_truth
from railnav.simulation import SERVICE, SURVEY, Leg

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
TRACKS = ("77R-01", "77R-02", "77R-03")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files that the README speaks of, for two kilometres of the bundled line, simulated."""
    folder = tmp_path_factory.mktemp("readme")
    line = rn.demo_line()
    (folder / "runs").mkdir()
    for seed in (1, 2):
        run, _ = rn.simulate(line, Leg(TRACKS, start=50.0, finish=1000.0), seed=seed, outfit=SURVEY, direction="up")
        write_run(run, folder / "runs" / f"survey-{seed}")
    run, truth = rn.simulate(line, Leg(TRACKS, start=200.0, finish=800.0), seed=3, outfit=SERVICE, direction="up")
    write_run(run, folder / "runs" / "train-7")
    write_truth(truth, folder / "truth.csv")
    write_geojson(line, folder / "network.geojson")
    return folder


def expanded(word):
    """What a shell makes of a word."""
    return sorted(str(p) for p in Path().glob(word)) if "*" in word else [word]


@pytest.mark.slow
def test_commands_run_one_after_another(folder, monkeypatch):
    monkeypatch.chdir(folder)
    commands = [line.strip().split("#")[0] for line in README.splitlines() if line.startswith("    railnav ")]
    assert len(commands) >= 6
    for command in commands:
        words = [w for word in shlex.split(command)[1:] for w in expanded(word)]
        result = CliRunner().invoke(main, words)
        assert result.exit_code == 0, f"{command}: {result.output}"


@pytest.mark.slow
def test_python_runs(folder, monkeypatch):
    monkeypatch.chdir(folder)
    rn.demo_line().to_file("line.gpkg")
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names: dict = {}
    exec(code, names)  # our own words, above
    assert names["here"].curvature.shape == ()
    assert names["there"][0].track == "77R-03"
    assert (folder / "solution.gpkg").exists()


def test_links_lead_somewhere():
    """Those of every page, headings within a page included."""
    root = Path(__file__).parents[2]
    links = 0
    for page in [*root.glob("*.md"), *root.glob("docs/**/*.md"), *root.glob("track_models/*.md")]:
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            if "://" in target or target.startswith("mailto:"):
                continue
            file, _, heading = target.partition("#")
            there = page.parent / file if file else page
            assert there.exists(), f"{page.name}: {target}"
            if heading:
                text = there.read_text(encoding="utf-8")
                titles = [
                    re.sub(r"[^\w\- ]", "", line.lstrip("# ").lower()).replace(" ", "-")
                    for line in text.splitlines()
                    if line.startswith("#")
                ]
                assert heading in titles, f"{page.name}: {target}"
            links += 1
    assert links >= 40


@pytest.mark.slow
def test_the_tutorial_runs_from_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (Path(__file__).parents[2] / "docs" / "tutorial.md").read_text(encoding="utf-8")
    commands = [line.strip() for line in text.splitlines() if line.startswith("    railnav ")]
    assert len(commands) > 15
    for command in commands:
        result = CliRunner().invoke(main, shlex.split(command)[1:])
        assert result.exit_code == 0, f"{command}: {result.output}"
