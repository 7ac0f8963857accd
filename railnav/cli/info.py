"""`railnav info`: what a file holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from railnav.cli._verb import PATH, json_option


@click.command("info")
@click.argument("file", type=PATH)
@json_option
def command(file: Path, as_json: bool) -> None:
    """Describe a model, a run or a solution.

    Of a model: tracks and lengths, nodes by kind, permitted movements, the plane and its one pinned transformation,
    accuracy for each track, where it came from. Of a run folder or a receiver's log: streams, duration, rates, gaps, extent, and
    what of a log was left out. Of a solution: modes, path, how sure. A truth file is described too.

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

        logs: list[Any] = []
        facts = {**_describe.describe_run(read_run(file, report=logs.append)), "logs": _told(logs)}
        show = _describe.print_run
    elif kind == "log":
        from railnav.io.logs import read_bare_log

        logs = []
        run, notes = read_bare_log(file, report=logs.append)
        extra = [note for note in notes if all(note not in log.notes for log in logs)]
        facts = {**_describe.describe_run(run), "logs": _told(logs), "notes": extra}
        show = _describe.print_run
    elif kind == "truth":
        from railnav.io.truth import read_truth

        facts, show = _describe.describe_truth(read_truth(file)), _describe.print_truth
    else:
        facts, show = _describe.describe_solution(_files.read_solution(file)), _describe.print_solution
    if as_json:
        print_json({"file": file, **facts})
    else:
        show(facts, str(file))


def _told(logs: list[Any]) -> list[dict[str, Any]]:
    """Summaries of logs as plain values."""
    return [
        {
            "file": str(log.file),
            "format": log.format,
            "fixes": log.fixes,
            "good": log.good,
            "unit": log.unit,
            "broken": log.broken,
            "first_broken": log.first_broken,
            "void": log.void,
            "duplicates": log.duplicates,
            "counts": dict(log.counts),
            "notes": list(log.notes),
            "summary": str(log),
        }
        for log in logs
    ]
