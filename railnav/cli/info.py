"""`railnav info`: what a file holds."""

from __future__ import annotations

from pathlib import Path

import click

from railnav.cli._verb import PATH, json_option


@click.command("info")
@click.argument("file", type=PATH)
@json_option
def command(file: Path, as_json: bool) -> None:
    """Describe a model, a run or a solution.

    Of a model: tracks and lengths, nodes by kind, permitted movements, the plane and its one pinned transformation,
    accuracy for each track, where it came from. Of a run folder: streams, duration, rates, gaps, extent. Of a
    solution: modes, path, how sure. A truth file is described too.

    \b
    Example:
      railnav info demo/line.gpkg
    """  # noqa: D301
    from railnav.cli import _describe, _files
    from railnav.cli._terminal import print_json

    kind = _files.kind_of(file)
    if kind == "model":
        facts, show = _describe.describe_model(_files.read_model(file)), _describe.print_model
    elif kind == "run":
        from railnav.io.run import read_run

        facts, show = _describe.describe_run(read_run(file)), _describe.print_run
    elif kind == "truth":
        from railnav.io.truth import read_truth

        facts, show = _describe.describe_truth(read_truth(file)), _describe.print_truth
    else:
        facts, show = _describe.describe_solution(_files.read_solution(file)), _describe.print_solution
    if as_json:
        print_json({"file": file, **facts})
    else:
        show(facts, str(file))
