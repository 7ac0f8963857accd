"""`railnav demo`: the whole way on a simulated line, ending in one page."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from railnav.cli._verb import PATH, json_option

if TYPE_CHECKING:
    from railnav.evaluation import AxisError
    from railnav.run import Progress, Run
    from railnav.track.model import TrackModel
    from railnav.truth import Truth

#: The file by which a folder is known to be a demo's, and may be replaced.
REPORT = "report.html"
#: Survey passes over each of the two main tracks.
PASSES = 3
#: How far a stretch of track was moved a month after the survey, at most, m.
MOVED = 0.08


@click.command("demo")
@click.option("-o", "--output", type=PATH, default=Path("demo"), show_default=True, help="Folder to make.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Same seed, same demo.")
@json_option
def command(output: Path, seed: int, as_json: bool) -> None:
    """Simulate a survey and a service run, build, navigate, evaluate, and write a report.

    Everything is simulated on the bundled line: three survey passes over each main track, a reference track model
    built from them, a train in service with two tunnels and a stop, its solution, and the errors against the truth.
    The folder holds the page report.html and every file in between, for the other verbs to try.

    \b
    Example:
      railnav demo -o demo --seed 1
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_json, progress

    _files.check_output_folder(output, mark=REPORT)
    _files.need_report()
    begin = time.perf_counter()
    with progress() as tell, _staging(output) as folder, _second_core() as compiled:
        facts, lines = _demo(folder, output, seed, tell, compiled)
    facts["wall_s"] = round(time.perf_counter() - begin, 1)
    if as_json:
        print_json(facts)
        return
    click.secho(f"Demo on simulated data, done in {facts['wall_s']:.0f} s", bold=True)
    for line in lines:
        click.echo(click.wrap_text(line, 100, initial_indent="  ", subsequent_indent="  ") + "\n")
    click.echo(f"Open the page:\n  {(output / REPORT).resolve()}\n\nGo on with:")
    for line in next_commands(output):
        click.echo(f"  {line}")


@contextmanager
def _staging(output: Path) -> Iterator[Path]:
    """Lend a folder that becomes the output when all is done; a demo's older folder gives way then, not before."""
    import shutil
    import tempfile

    target = output.resolve()
    draft = Path(tempfile.mkdtemp(prefix=".railnav-demo-", suffix=".partial", dir=target.parent))
    try:
        yield draft
        draft.chmod(0o755)
        if target.exists():
            old = draft.with_suffix(".old")
            target.rename(old)
            draft.rename(target)
            shutil.rmtree(old, ignore_errors=True)
        else:
            draft.rename(target)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


#: What the second process does: a minute's run, navigated and smoothed, so that numba compiles and stores the navigator's kernels.
_COMPILE_NAVIGATOR = """
from railnav.navigation import navigate
from railnav.simulation import Leg, demo_line, simulate
model = demo_line(spacing=20.0)
run, _ = simulate(model, Leg(("77R-01",), start=50.0, finish=600.0), seed=1)
navigate(run, model, smooth=True)
"""


@contextmanager
def _second_core() -> Iterator[Callable[[Progress | None], None]]:
    """Let a second process compile the navigator's kernels while this one simulates and builds; first time only.

    Yields
    ------
    callable
        Waits for that process; without need, it returns at once.
    """
    import subprocess
    import sys

    import railnav.navigation

    room = Path(railnav.navigation.__file__).parent
    stored = [*room.glob("__pycache__/*.nbi")]  # where numba keeps what it compiled, unless it is told another place
    if elsewhere := os.environ.get("NUMBA_CACHE_DIR"):
        stored = [*Path(elsewhere).glob(f"{room.name}_*/*.nbi")]
    if not sys.executable or stored:
        yield lambda _: None
        return
    command = [sys.executable, "-c", _COMPILE_NAVIGATOR]
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)  # noqa: S603 - our own words

    def wait(tell: Progress | None) -> None:
        if tell:
            tell("compile, first time only", 0, 1)
        process.wait()
        if tell:
            tell("compile, first time only", 1, 1)

    try:
        yield wait
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()


class _Watch:
    """Wall time of each step, s."""

    def __init__(self) -> None:
        self.steps: list[tuple[str, float]] = []
        self._last = time.perf_counter()

    def done(self, step: str) -> None:
        now = time.perf_counter()
        self.steps.append((step, now - self._last))
        self._last = now


def _demo(
    folder: Path, shown: Path, seed: int, tell: Progress | None, compiled: Callable[[Progress | None], None]
) -> tuple[dict[str, Any], list[str]]:
    """Go the whole way in a folder; returns facts for JSON, and lines for people."""
    from dataclasses import replace

    from railnav.evaluation import axis_error, evaluate, truth_on
    from railnav.io.geojson import write_geojson
    from railnav.io.run import write_run
    from railnav.io.truth import write_truth
    from railnav.navigation import navigate
    from railnav.survey import build
    from railnav.web.demo_report import demo_page
    from railnav.web.evaluation_report import evaluation_words

    watch = _Watch()
    reference, surveys, later, service, simulated_truth = _simulated(seed, tell)
    watch.done("simulate the survey and the service run")
    reference.to_file(folder / "bundled.gpkg")
    for survey in surveys:
        write_run(survey, folder / survey.id)
    write_run(later, folder / later.id)
    write_run(service, folder / service.id, truth=simulated_truth)
    watch.done("write them in the formats of the files")
    model = build(surveys, progress=tell)
    model = replace(model, provenance={**model.provenance, "simulated": True})
    watch.done("build the reference track model")
    model.to_file(folder / "line.gpkg")
    write_geojson(model, folder / "line.geojson")
    truth = truth_on(model, simulated_truth)
    write_truth(truth, folder / "truth.csv")
    watch.done("write the model, and the truth on it")
    compiled(tell)
    solution = navigate(service, model, progress=tell)
    watch.done("navigate, as if live")
    smoothed = navigate(service, model, smooth=True, progress=tell)
    watch.done("navigate again, smoothed")
    solution.to_file(folder / "solution.gpkg")
    smoothed.to_file(folder / "smoothed.csv")
    evaluation, evaluation_smoothed = evaluate(solution, truth, model=model), evaluate(smoothed, truth, model=model)
    watch.done("evaluate")
    axis = axis_error(model, reference)
    page = demo_page(
        model=model,
        surveys=surveys,
        service=service,
        solution=solution,
        truth=truth,
        evaluation=evaluation,
        smoothed=evaluation_smoothed,
        axis_error=axis,
        steps=watch.steps,
        commands=next_commands(shown),
        seed=seed,
    )
    (folder / REPORT).write_text(page, encoding="utf-8")
    facts = {
        "simulated": True,
        "seed": seed,
        "folder": shown,
        "report": shown / REPORT,
        "model": {"tracks": len(model.track_id), "length_m": float(model.lengths.sum()), **_axis(axis)},
        "evaluation": evaluation.to_dict(),
        "evaluation_smoothed": evaluation_smoothed.to_dict(),
        "steps_s": {name: round(seconds, 2) for name, seconds in watch.steps},
    }
    return facts, evaluation_words(evaluation)


def _simulated(seed: int, tell: Progress | None) -> tuple[TrackModel, list[Run], Run, Run, Truth]:
    """Simulate survey passes over both main tracks, one more a month later when some metres were moved, and a train in service."""
    from datetime import timedelta

    import numpy as np

    from railnav.simulation import SERVICE, SURVEY, Leg, Stop, demo_line, simulate, with_stale_track
    from railnav.simulation.train import START

    reference = demo_line()
    right = tuple(sorted(track for track in reference.track_id if track.startswith("77R-")))
    left = tuple(sorted((track for track in reference.track_id if track.startswith("77L-")), reverse=True))
    seeds = [int(number) for number in np.random.SeedSequence(seed).generate_state(2 * PASSES + 2)]
    surveys = []
    for number in range(2 * PASSES):
        up = number % 2 == 0
        last = reference.length(right[-1]) - 20.0
        leg = (
            Leg(right, start=20.0, finish=last)
            if up
            else Leg(left, start=reference.length(left[0]) - 20.0, finish=20.0)
        )
        run, _ = simulate(
            reference,
            leg,
            seed=seeds[number],
            outfit=SURVEY,
            run_id=f"survey-{number + 1}",
            direction="up" if up else "down",
            progress=None,
        )
        surveys.append(run)
        if tell:
            tell("simulate", number + 1, 2 * PASSES + 2)
    later, _ = simulate(
        with_stale_track(reference, "77R-03", start=5_000.0, length=300.0, slew=MOVED),
        Leg(right, start=20.0, finish=reference.length(right[-1]) - 20.0),
        seed=seeds[-1],
        outfit=SURVEY,
        run_id="later",
        start=START + timedelta(days=30),
        direction="up",
    )
    if tell:
        tell("simulate", 2 * PASSES + 1, 2 * PASSES + 2)
    station = next(track for track in right if track == "77R-06")
    leg = Leg(right, start=60.0, finish=reference.length(right[-1]) - 60.0, stops=(Stop(station, 700.0, 45.0),))
    service, truth = simulate(reference, leg, seed=seeds[-2], outfit=SERVICE, run_id="service", direction="up")
    if tell:
        tell("simulate", 2 * PASSES + 2, 2 * PASSES + 2)
    return reference, surveys, later, service, truth


def _axis(found: AxisError) -> dict[str, float | None]:
    return {"axis_rms_m": found.rms, "axis_max_m": found.max, "axis_tunnel_max_m": found.tunnel_max}


def next_commands(folder: Path) -> list[str]:
    """Commands that go on from where the demo ends."""
    return [
        f"railnav info {folder}/line.gpkg",
        f"railnav build {folder}/survey-* -o my-line.gpkg --report my-line.html",
        f"railnav update {folder}/line.gpkg {folder}/later -o newer.gpkg",
        f"railnav diff {folder}/line.gpkg newer.gpkg -o moved.geojson",
        f"railnav navigate {folder}/service -m my-line.gpkg -o my-solution.gpkg --smooth",
        f"railnav evaluate my-solution.gpkg {folder}/truth.csv",
        f"railnav simulate -m {folder}/bundled.gpkg -o my-run --route 77R-01,78-01 --seed 7",
        f"railnav navigate my-run -m {folder}/bundled.gpkg -o branch.csv",
        "railnav evaluate branch.csv my-run/truth.csv --report branch.html",
    ]
