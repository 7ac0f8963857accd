"""`railnav simulate`: a train that never was, with its truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from railnav.cli._verb import PATH, json_option

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime

    from railnav.track.model import Route, TrackModel


@click.command("simulate")
@click.option("-m", "--model", type=PATH, required=True, help="Reference track model, .gpkg (or .geojson).")
@click.option("-o", "--output", type=PATH, required=True, help="Run folder to make; truth.csv is written into it.")
@click.option(
    "--route",
    metavar="TRACK,TRACK",
    help="Tracks in the order run; between two that do not meet, the straightest short way.  "
    "[default: the longest way through the model]",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Same seed, same run.")
@click.option(
    "--grade",
    type=click.Choice(["survey", "service", "phone", "mems", "tactical", "geometry"]),
    default="service",
    show_default=True,
    help="Sensors: survey car (2 cm GNSS), train in service (GNSS, IMU, odometer), telephone, a train with an IMU of a data "
    "sheet, low-cost or tactical, or a track recording car (angles, gauge and cant at 200 Hz) over irregular track.",
)
@click.option(
    "--irregular",
    "roughness",
    metavar="TIMES",
    type=click.FloatRange(0, 20),
    help="Irregularities of the track, times those of a fair main line; 0 for none.  [default: 1 with --grade geometry, else 0]",
)
@click.option(
    "--track-seed",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="Same track seed, same irregularities, whatever runs over them.",
)
@click.option(
    "--start",
    type=click.DateTime(["%Y-%m-%d", "%Y-%m-%dT%H:%M:%S"]),
    help="When the run begins, UTC, e.g. 2026-03-01.  [default: a day in January 2026]",
)
@click.option(
    "--imu",
    type=click.Choice(["L3G4200D", "IMU440", "RT3003", "STIM300"]),
    help="Another IMU, by its data sheet (L3G4200D: with the LSM303DLH).",
)
@click.option(
    "--declare/--no-declare",
    default=True,
    show_default=True,
    help="Write what the sensors' data sheets say of their errors into run.toml, where navigate reads it.",
)
@click.option("--balises", is_flag=True, help="Carry a reader too: the model's balises are read as they are run over.")
@click.option("--top-speed", type=click.FloatRange(1, 400), default=120.0, show_default=True, help="Top speed, km/h.")
@click.option(
    "--outage",
    metavar="FROM-TO",
    multiple=True,
    help="Seconds without GNSS, e.g. 120-180; may be given more than once.",
)
@click.option(
    "--fault",
    metavar="NAME@SECONDS",
    multiple=True,
    help="What goes wrong, and when, e.g. gnss-ramp-left-0.5@120; may be given more than once.",
)
@click.option(
    "--list-faults",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=lambda ctx, _, value: _list_faults(ctx) if value else None,
    help="List the faults by name, and stop.",
)
@json_option
def command(
    model: Path,
    output: Path,
    route: str | None,
    seed: int,
    grade: str,
    roughness: float | None,
    track_seed: int,
    start: datetime | None,
    imu: str | None,
    declare: bool,
    balises: bool,
    top_speed: float,
    outage: tuple[str, ...],
    fault: tuple[str, ...],
    as_json: bool,
) -> None:
    """Simulate a run over a model, with its truth.

    The train keeps limits of speed, acceleration and jerk, and its sensors have errors of their kind. The data are
    simulated: they show what the program does, not what a real line is like.

    \b
    Example:
      railnav simulate -m demo/bundled.gpkg -o run --route 77R-01,77R-13 --seed 7
      railnav simulate -m demo/bundled.gpkg -o car --grade geometry --route 77R-03 --start 2026-03-01
    """  # noqa: D301
    from dataclasses import replace
    from datetime import UTC

    from railnav.cli import _files
    from railnav.cli._describe import describe_run, print_run
    from railnav.cli._terminal import print_json, progress
    from railnav.errors import RailnavError

    outages = [_outage(text) for text in outage]
    faults = [_fault(text) for text in fault]
    _files.check_output_folder(output)
    from railnav.io.run import write_run
    from railnav.simulation import BaliseSensor, Driving, outfit_of, simulate, with_fault
    from railnav.simulation.irregularities import GEOMETRY, irregular, simulate_geometry

    reference = _files.read_model(model)
    names = _names(route) if route is not None else ()
    if route is not None and not names:
        raise RailnavError("--route names no track")
    if grade == GEOMETRY.name and imu is not None:
        raise click.UsageError("a recording car (--grade geometry) measures angles, not rates: leave --imu out")
    outfit = GEOMETRY if grade == GEOMETRY.name else outfit_of(grade, imu=imu)
    rough = roughness if roughness is not None else float(grade == GEOMETRY.name)
    tracks = _way(reference, names) if names else _longest(reference)
    with progress() as tell:
        carried = replace(outfit, balise=BaliseSensor()) if balises else outfit
        driving = Driving(speed=top_speed / 3.6)
        more: dict[str, Any] = {"start": start.replace(tzinfo=UTC)} if start is not None else {}
        more |= {"outages": outages, "run_id": output.resolve().name, "progress": tell}
        if rough > 0.0:
            fields = irregular(reference, seed=track_seed, times=rough, tracks=tracks)
            run, truth = simulate_geometry(
                reference, tracks, fields, seed=seed, outfit=carried, driving=driving, **more
            )
        else:
            run, truth = simulate(
                reference, tracks, seed=seed, outfit=carried, driving=driving, declare=declare, **more
            )
    for name, onset in faults:
        run = with_fault(run, name, start=onset, seed=seed)
    write_run(run, output, truth=truth)
    facts = describe_run(run)
    if as_json:
        print_json(
            {
                **facts,
                "route": tracks,
                "seed": seed,
                "grade": grade,
                "irregular": rough,
                "track_seed": track_seed if rough else None,
                "faults": list(fault),
                "simulated": True,
                "output": output,
            }
        )
    else:
        print_run(facts, f"{output} written (simulated)")
        click.echo(f"Route: {' > '.join(tracks)}")
        click.echo(f"Truth: {output / 'truth.csv'}")
        for name, onset in faults:
            click.echo(f"Fault: {name}, from {onset:g} s")


def _outage(text: str) -> tuple[float, float]:
    begin, _, end = text.partition("-")
    try:
        times = float(begin), float(end)
    except ValueError:
        raise click.BadParameter(f"{text!r} is not FROM-TO in seconds, e.g. 120-180", param_hint="--outage") from None
    if not 0 <= times[0] < times[1] < float("inf"):
        raise click.BadParameter(f"{text!r} does not grow", param_hint="--outage")
    return times


def _fault(text: str) -> tuple[str, float]:
    name, _, onset = text.partition("@")
    try:
        return name.strip(), float(onset or 0.0)
    except ValueError:
        raise click.BadParameter(
            f"{text!r} is not NAME@SECONDS, e.g. gnss-silent-60s@120", param_hint="--fault"
        ) from None


def _list_faults(ctx: click.Context) -> None:
    from railnav.simulation import FAULTS

    wide = max(len(name) for name in FAULTS)
    for fault in FAULTS.values():
        click.echo(f"{fault.name:<{wide}}  {fault.words}")
    ctx.exit()


def _names(route: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in route.split(",") if name.strip())


def _way(model: TrackModel, names: tuple[str, ...]) -> tuple[str, ...]:
    """Fill in the tracks between those named."""
    from itertools import pairwise

    from railnav.errors import TrackError

    tracks = [names[0]]
    model.track_index(names[0])
    for a, b in pairwise(names):
        routes = model.routes(a, b)
        if not routes:
            raise TrackError(f"no lawful way from track {a!r} to track {b!r} without reversing")
        shortest = routes[0].length
        tracks += _straightest(model, [r for r in routes if r.length <= 1.01 * shortest])[1:]
    return tuple(tracks)


def _longest(model: TrackModel) -> tuple[str, ...]:
    """Choose the longest of the shortest ways between ends of the model; of those as long to a percent, the straightest."""
    import numpy as np

    from railnav.track.model import NodeKind

    ends = np.isin(model.nodes.kind, [NodeKind.END_OF_MODEL, NodeKind.BUFFER_STOP])
    outer = [
        track
        for track, a, b in zip(model.track_id, model.start_node, model.end_node, strict=True)
        if ends[a] or ends[b]
    ]
    chosen = sorted(outer or model.track_id, key=model.length, reverse=True)[:12]
    routes = [route for a in chosen for b in chosen if a != b for route in model.routes(a, b, at_most=8)]
    if not routes:
        return (max(model.track_id, key=model.length),)
    enough = 0.99 * max(route.length for route in routes)
    return _straightest(model, [route for route in routes if route.length >= enough])


def _straightest(model: TrackModel, routes: Sequence[Route]) -> tuple[str, ...]:
    """Choose the way that turns least, all its bends together: it stays off the crossovers that only save centimetres."""
    import numpy as np

    def bend(track: str) -> float:
        knots = model.knots(track)
        return float(np.trapezoid(np.abs(model.curvature[knots]), model.offset[knots]))

    return min(routes, key=lambda route: sum(bend(track) for track in route.tracks)).tracks
