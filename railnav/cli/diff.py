"""`railnav diff`: where the track has moved."""

from __future__ import annotations

from pathlib import Path

import click

from railnav.cli._verb import PATH, json_option


@click.command("diff")
@click.argument("old", type=PATH)
@click.argument("new", type=PATH)
@click.option(
    "-o", "--output", type=PATH, help="Also write slews and lifts point by point, .csv, .geojson or a page, .html."
)
@click.option(
    "--step", type=click.FloatRange(0, min_open=True), default=5.0, show_default=True, help="Distance of the points, m."
)
@click.option(
    "--false-alarm",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=1e-3,
    show_default=True,
    help="Probability that a track that has not moved is said to have.",
)
@json_option
def command(old: Path, new: Path, output: Path | None, step: float, false_alarm: float, as_json: bool) -> None:
    """Compare two models: where the track moved, by how much, and how sure that is.

    Slews are positive to the right as the offset of OLD grows, lifts upwards; sigmas are those of the difference. A
    shift of one datum against the other is told apart. The list of moved stretches comes from the models' survey
    records where both carry them.

    \b
    Example:
      railnav diff demo/line.gpkg line2.gpkg -o moved.geojson
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._survey import print_difference, write_difference
    from railnav.cli._terminal import print_json

    if output is not None:
        _files.check_output(output, (".csv", ".geojson", ".html"), inputs=[old, new])
        if output.suffix.lower() == ".html":
            _files.need_report()
    from railnav.survey.difference import difference

    first, second = _files.read_model(old), _files.read_model(new)
    found = difference(first, second, spacing=step, false_alarm=false_alarm)
    if output is not None and output.suffix.lower() == ".html":
        from railnav.web.difference import difference_page

        _files.write_text(output, difference_page(found, f"{old.name} and {new.name}"))
    elif output is not None:
        write_difference(found, first, output)
    if as_json:
        print_json({"old": old, "new": new, **({"output": output} if output else {}), **found.summary()})
        return
    print_difference(found, f"{old} and {new}")
