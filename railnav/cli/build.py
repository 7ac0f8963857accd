"""`railnav build`: survey runs become a reference track model."""

from __future__ import annotations

from pathlib import Path

import click

from railnav.cli._verb import PATH, crs_options, json_option


@click.command("build")
@click.argument("runs", type=PATH, nargs=-1, required=True, metavar="RUN...")
@click.option("-o", "--output", type=PATH, required=True, help="Model to write, .gpkg (or .geojson).")
@crs_options
@click.option(
    "--spacing",
    type=click.FloatRange(0, min_open=True),
    default=1.0,
    show_default=True,
    help="Distance between knots, m.",
)
@click.option("--report", type=PATH, help="Also write a page about the build, .html.")
@json_option
def command(
    runs: tuple[Path, ...],
    output: Path,
    crs: str | None,
    zone_width: str | None,
    ellipsoid: str | None,
    spacing: float,
    report: Path | None,
    as_json: bool,
) -> None:
    """Build a reference track model from survey runs.

    Each RUN is a folder with a run.toml: one drive, with GNSS. Gaps, stops, outliers, different receivers and both
    directions of running are dealt with; the table says what was used, what was rejected and why, and by how much
    each run's positions stand apart from the others.

    \b
    Example:
      railnav build demo/survey-1 demo/survey-2 demo/survey-3 -o line.gpkg --report build.html
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._describe import describe_model, print_build
    from railnav.cli._terminal import print_json, progress
    from railnav.cli._verb import frame_request

    inputs = [member for run in runs for member in _files.members(run)]
    _files.check_output(output, _files.MODEL_ENDINGS, inputs=inputs)
    if report is not None:
        _files.check_output(report, _files.PAGE_ENDINGS, inputs=[*inputs, output])
        _files.need_report()
    request = frame_request(crs, zone_width, ellipsoid)
    from railnav.io.run import read_run
    from railnav.survey import build

    with progress() as tell:
        recorded = []
        for done, run in enumerate(runs):
            if tell:
                tell("read", done, len(runs))
            recorded.append(read_run(run))
        if tell:
            tell("read", len(runs), len(runs))
        model = build(recorded, **request, spacing=spacing, progress=tell)
    page = None
    if report is not None:
        from railnav.web.report import build_page

        page = build_page(model)
    _files.write_model(model, output)
    if report is not None and page is not None:
        _files.write_text(report, page)
    if as_json:
        print_json({**describe_model(model), "output": output, **({"report": report} if report else {})})
        return
    print_build(model, f"{output} written")
    if report is not None:
        click.echo(f"Page: {report}")
