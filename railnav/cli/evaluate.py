"""`railnav evaluate`: a solution against the truth."""

from __future__ import annotations

from pathlib import Path

import click

from railnav.cli._verb import PATH, json_option


@click.command("evaluate")
@click.argument("solution", type=PATH)
@click.argument("truth", type=PATH)
@click.option("--report", type=PATH, help="Also write a page with the error along time and along the line, .html.")
@click.option("-m", "--model", type=PATH, help="The solution's model: checks jumps between tracks; drawn on the page.")
@click.option(
    "--alert-limit",
    type=click.FloatRange(0, min_open=True),
    default=25.0,
    show_default=True,
    help="Largest tolerable error along the track, m.",
)
@json_option
def command(
    solution: Path, truth: Path, report: Path | None, model: Path | None, alert_limit: float, as_json: bool
) -> None:
    """Compare a solution with the truth: errors along and across, track selection, integrity.

    TRUTH is a truth.csv, from a simulation or a reference system.

    \b
    Example:
      railnav evaluate demo/solution.gpkg demo/truth.csv --report evaluation.html -m demo/line.gpkg
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_json

    if report is not None:
        _files.check_output(report, _files.PAGE_ENDINGS, inputs=[solution, truth, *([model] if model else [])])
        _files.need_report()
    from railnav.cli._describe import print_evaluation
    from railnav.evaluation import evaluate
    from railnav.io.truth import read_truth

    found, reference = _files.read_solution(solution), read_truth(truth)
    line = _files.read_model(model) if model else None
    evaluation = evaluate(found, reference, model=line, alert_limit=alert_limit)
    if report is not None:
        from railnav.web.evaluation_report import evaluation_page

        _files.write_text(report, evaluation_page(found, reference, evaluation, line))
    if as_json:
        print_json({**evaluation.to_dict(), **({"report": report} if report else {})})
    else:
        print_evaluation(evaluation, f"{solution} against {truth}")
        if report is not None:
            click.echo(f"Page: {report}")
