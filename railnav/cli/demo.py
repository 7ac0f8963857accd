"""`railnav demo`: the whole way on a simulated line, ending in one page."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from railnav.cli._verb import PATH, json_option

if TYPE_CHECKING:
    from railnav.run import Progress, Run
    from railnav.track.model import TrackModel
    from railnav.truth import Truth

#: The file by which a folder is known to be a demo's, and may be replaced.
REPORT = "report.html"
#: Survey passes over each of the two main tracks.
PASSES = 3


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
    with progress() as tell, _staging(output) as folder:
        facts, lines = _demo(folder, output, seed, tell)
    facts["wall_s"] = round(time.perf_counter() - begin, 1)
    if as_json:
        print_json(facts)
        return
    click.secho(f"Demo on simulated data, done in {facts['wall_s']:.0f} s", bold=True)
    for line in lines:
        click.echo(f"  {line}")
    click.echo(f"\nOpen the page:\n  {(output / REPORT).resolve()}\n\nGo on with:")
    for line in next_commands(output):
        click.echo(f"  {line}")


def next_commands(folder: Path) -> list[str]:
    """Commands that go on from where the demo ends."""
    return [
        f"railnav info {folder}/line.gpkg",
        f"railnav build {folder}/survey-* -o my-line.gpkg --report my-line.html",
        f"railnav navigate {folder}/service -m my-line.gpkg -o my-solution.gpkg --smooth",
        f"railnav evaluate my-solution.gpkg {folder}/truth.csv",
        f"railnav simulate -m {folder}/bundled.gpkg -o my-run --route 77R-01,78-01 --seed 7",
        f"railnav navigate my-run -m {folder}/bundled.gpkg -o branch.csv",
    ]
