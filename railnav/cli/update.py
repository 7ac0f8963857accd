"""`railnav update`: later runs refine a stored model."""

from __future__ import annotations

from pathlib import Path

import click

from railnav.cli._verb import PATH, json_option


@click.command("update")
@click.argument("model", type=PATH)
@click.argument("runs", type=PATH, nargs=-1, required=True, metavar="RUN...")
@click.option("-o", "--output", type=PATH, required=True, help="Model to write, .gpkg.")
@click.option("--crs", help="Refuse unless the model is in this plane (an EPSG code or WKT).")
@click.option(
    "--half-life",
    type=click.FloatRange(0, min_open=True),
    metavar="YEARS",
    help="What is stored loses half its weight in so many years.  [default: it loses none]",
)
@click.option(
    "--false-alarm",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=1e-3,
    show_default=True,
    help="Probability that a track that has not moved is said to have.",
)
@json_option
def command(
    model: Path,
    runs: tuple[Path, ...],
    output: Path,
    crs: str | None,
    half_life: float | None,
    false_alarm: float,
    as_json: bool,
) -> None:
    """Refine a stored model with later runs; the old raw data are not needed.

    MODEL carries what the runs behind it know. Each new RUN is compared with it first.
    Where the track was moved, the old axis is forgotten; where new runs contradict each other, they are set aside. Runs
    on another line, and runs that are in the model already, are refused.

    \b
    Example:
      railnav update line.gpkg monday tuesday -o line2.gpkg
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._describe import describe_model
    from railnav.cli._survey import print_update
    from railnav.cli._terminal import print_json, progress
    from railnav.errors import ModelError

    inputs = [model, *(member for run in runs for member in _files.members(run))]
    _files.check_output(output, (".gpkg",), inputs=inputs)
    if model.suffix.lower() in (".geojson", ".json"):
        raise ModelError(
            "a GeoJSON model carries no survey records", file=model, remedy="update the .gpkg of the build"
        )
    from railnav.io.geopackage import read_model
    from railnav.io.run import read_run
    from railnav.survey import update

    stored = read_model(model)
    if stored.record_source is None:
        raise ModelError(
            "carries no survey records, so later runs cannot refine it", file=model, remedy="build it from its runs"
        )
    with progress() as tell:
        recorded = []
        for done, run in enumerate(runs):
            if tell:
                tell("read", done, len(runs))
            recorded.append(read_run(run))
        if tell:
            tell("read", len(runs), len(runs))
        refined = update(
            stored,
            recorded,
            crs=f"EPSG:{crs}" if crs and crs.strip().isdigit() else crs,
            half_life=half_life,
            false_alarm=false_alarm,
            progress=tell,
        )
    _files.write_model(refined, output)
    entry = refined.provenance["updates"][-1]
    if as_json:
        print_json({**describe_model(refined), "output": output, "update": entry})
        return
    print_update(entry, f"{output} written")
