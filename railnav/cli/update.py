"""`railnav update`: later runs refine a stored model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from railnav.cli._verb import PATH, json_option

if TYPE_CHECKING:
    from railnav.track.model import TrackModel


@click.command("update")
@click.argument("model", type=PATH)
@click.argument("runs", type=PATH, nargs=-1, required=True, metavar="RUN...")
@click.option("-o", "--output", type=PATH, required=True, help="Model to write, .gpkg.")
@click.option(
    "--from-service",
    is_flag=True,
    help="The runs are trains in service: each is navigated on the model, any model, and refines it across the track.",
)
@click.option(
    "--extend",
    is_flag=True,
    help="Make track of what runs show beyond the model: longer tracks, new ones, and turnouts.  [default: report it]",
)
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
    from_service: bool,
    extend: bool,
    crs: str | None,
    half_life: float | None,
    false_alarm: float,
    as_json: bool,
) -> None:
    """Refine a stored model with later runs; the old raw data are not needed.

    MODEL carries what the runs behind it know. Each new RUN is compared with it first.
    Where the track was moved, the old axis is forgotten; where new runs contradict each other, they are set aside. Runs
    on another line, and runs that are in the model already, are refused. Where runs leave the model's tracks, that is
    reported; with --extend it becomes track.

    With --from-service any model will do, drawn from a map too, and any run that can be navigated on it: train and map
    errors are estimated together. The result carries no survey records.

    \b
    Example:
      railnav update demo/line.gpkg demo/later -o line2.gpkg --extend
      railnav update demo/line.gpkg demo/service -o line3.gpkg --from-service
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
    if from_service:
        if half_life is not None:
            raise click.UsageError("--half-life is of stored surveys; it does not go with --from-service")
        if extend:
            raise click.UsageError("--extend makes track of surveys; it does not go with --from-service")
        _from_service(model, stored, runs, output, as_json)
        return
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
            extend=extend,
            progress=tell,
        )
    _files.write_model(refined, output)
    entry = refined.provenance["updates"][-1]
    if as_json:
        print_json({**describe_model(refined), "output": output, "update": entry})
        return
    print_update(entry, f"{output} written")


def _from_service(path: Path, stored: TrackModel, runs: tuple[Path, ...], output: Path, as_json: bool) -> None:
    """Refine with runs in service, and say what they did."""
    from railnav.cli import _files
    from railnav.cli._describe import describe_model
    from railnav.cli._terminal import print_facts, print_json, print_table, progress
    from railnav.io.run import read_run
    from railnav.survey.service import refine_from_service
    from railnav.web import words

    with progress() as tell:
        refined = refine_from_service(stored, [read_run(run) for run in runs], progress=tell)
    _files.write_model(refined, output)
    entry = refined.provenance["service"][-1]
    if as_json:
        print_json({**describe_model(refined), "output": output, "service": entry})
        return
    print_facts(f"{output} written", {"from": str(path), "gauge": entry["gauge"]})
    print_table(
        "Runs",
        ("run", "fixes used", "tracks", ""),
        [[r["id"], f"{r['fixes_used']:,}", f"{len(r['tracks'])}", r["words"]] for r in entry["runs"]],
        left=1,
    )
    print_table(
        "Tracks",
        ("track", "moved (RMS)", "at most", "sigma before", "sigma", "length"),
        [
            [
                t["track"],
                words.length(t["moved_rms_m"], 2),
                words.length(t["moved_max_m"], 2),
                words.length(t["sigma_before_m"], 2),
                words.length(t["sigma_m"], 2),
                words.exact_length(t["length_m"]),
            ]
            for t in entry["tracks"]
        ],
        left=1,
    )
