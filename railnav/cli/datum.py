"""`railnav datum`: datums, the choice between published transformations, and a fit of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from railnav.cli._verb import PATH, json_option


@click.group("datum", invoke_without_command=True, subcommand_metavar="[choices|fit|pin|points]")
@json_option
@click.pass_context
def command(ctx: click.Context, as_json: bool) -> None:
    """List datums, compare and pin their transformations, and fit one to common points.

    Without a word behind it: the table of datums and of the transformations between them that railnav runs itself. `choices`
    compares the published transformations of a plane at a place; `pin` writes one of them to a frame file; `fit` computes one
    from points known in both systems; `points` carries a table of points from one datum and epoch to another. Every verb
    that takes --crs takes a frame file.

    \b
    Example:
      railnav datum choices EPSG:28407 --at 55.75,37.6
    """  # noqa: D301
    if ctx.invoked_subcommand is not None:
        return
    from railnav.cli._terminal import print_json, print_table
    from railnav.geodesy.datums import DATUMS, LINKS

    if as_json:
        print_json(
            {
                "datums": [
                    {"name": d.name, "moving": d.moving, "epsg": d.codes, "aliases": d.aliases} for d in DATUMS.values()
                ],
                "links": [
                    {
                        "source": link.source,
                        "target": link.target,
                        "accuracy_m": link.accuracy,
                        "epoch": link.epoch,
                        "published": link.published,
                    }
                    for link in LINKS
                ],
            }
        )
        return
    print_table(
        "Datums",
        ("datum", "also", "fixed to", "EPSG"),
        [
            (
                d.name,
                ", ".join(d.aliases),
                "the Earth: give the epoch" if d.moving else "its plate",
                " ".join(map(str, d.codes)),
            )
            for d in DATUMS.values()
        ],
        left=4,
    )
    print_table(
        "Transformations",
        ("from", "to", "published", "epoch", "accuracy, m"),
        [
            (
                link.source,
                link.target,
                link.published,
                "any" if link.epoch is None else f"{link.epoch:.1f}",
                f"{link.accuracy:g}",
            )
            for link in LINKS
        ],
        left=3,
    )


def _place(text: str) -> tuple[float, float]:
    import math

    try:
        latitude, longitude = (float(part) for part in text.replace(";", ",").split(","))
    except ValueError:
        raise click.UsageError(
            f"--at {text!r} is no place; write latitude,longitude in degrees, as 55.75,37.6"
        ) from None
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0):
        raise click.UsageError(f"--at {text!r} is no place on Earth; latitude comes first, degrees")
    return math.radians(latitude), math.radians(longitude)


@command.command("choices")
@click.argument("crs")
@click.option("--at", "place", required=True, help="Where: latitude,longitude in degrees.")
@json_option
def choices(crs: str, place: str, as_json: bool) -> None:
    """Compare the published transformations of a plane at a place.

    Each with its stated accuracy and how far it puts the place from where the first does: that is what changing one's mind in
    the middle of a project costs.

    \b
    Example:
      railnav datum choices EPSG:28407 --at 55.75,37.6
    """  # noqa: D301
    from railnav.cli._terminal import print_json, print_table
    from railnav.geodesy.choices import transformation_choices

    found = transformation_choices(*_place(place), crs=crs)
    rows = [
        {"pin": c.pin, "operation": c.frame.operation, "accuracy_m": c.frame.accuracy, "apart_m": c.apart}
        for c in found
    ]
    if as_json:
        print_json({"crs": crs, "choices": rows})
        return
    print_table(
        f"{found[0].frame.name} at {place}",
        ("pin with --operation", "what it is", "accuracy, m", "from the first, m"),
        [(r["pin"], r["operation"], f"{r['accuracy_m']:.3g}", f"{r['apart_m']:.3f}") for r in rows],
        left=2,
    )


@command.command("pin")
@click.argument("crs")
@click.option("--at", "place", required=True, help="Where: latitude,longitude in degrees.")
@click.option("--operation", help='EPSG code or name of the transformation, or "table".  [default: the most accurate]')
@click.option("-o", "--output", type=PATH, required=True, help="Frame file to write, .toml.")
@json_option
def pin(crs: str, place: str, operation: str | None, output: Path, as_json: bool) -> None:
    """Pin one transformation of a plane and write it to a frame file.

    All models of a project that name this file lie in one plane by one transformation, whatever a registry later prefers.

    \b
    Example:
      railnav datum pin EPSG:28407 --at 55.75,37.6 --operation table -o moscow.toml
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_facts, print_json
    from railnav.geodesy.grid import choose_frame
    from railnav.io.frame_file import write_frames

    _files.check_output(output, (".toml",))
    latitude, longitude = _place(place)
    frame = choose_frame(latitude, longitude, crs=f"EPSG:{crs}" if crs.isdigit() else crs, operation=operation)
    write_frames(output, [frame], heading=f"pinned at {place}")
    if as_json:
        print_json({"name": frame.name, "operation": frame.operation, "accuracy_m": frame.accuracy, "output": output})
        return
    print_facts(
        f"{output} written",
        {
            "plane": frame.name,
            "transformation": frame.operation,
            "accuracy": f"{frame.accuracy:.3g} m",
            "use": f"--crs {output}",
        },
    )


@command.command("fit")
@click.argument("points", type=PATH)
@click.option(
    "--crs", required=True, help="The local plane's projection and ellipsoid; with 4 parameters a plane near it."
)
@click.option(
    "--parameters", type=click.Choice(["7", "4", "3"]), default="7", show_default=True, help="How many to fit."
)
@click.option("--sigma", type=click.FloatRange(0, min_open=True), help="Known sigma of one coordinate difference, m.")
@click.option("--keep-all", is_flag=True, help="Use points that the test condemns, too.")
@click.option("--name", default="", help="Name of the new plane.")
@click.option("-o", "--output", type=PATH, required=True, help="Frame file to write, .toml.")
@json_option
def fit(
    points: Path,
    crs: str,
    parameters: str,
    sigma: float | None,
    keep_all: bool,
    name: str,
    output: Path,
    as_json: bool,
) -> None:
    """Fit a local datum to points known in WGS 84 and in the local plane.

    POINTS is a table (.csv, .parquet) with point, latitude_deg, longitude_deg, height_m (WGS 84) and easting_m, northing_m,
    local_height_m (optional). Seven parameters join the datums in space, three only shift, four fit plane to plane. Points that
    contradict the others are set aside and named; every residual is shown.

    \b
    Example:
      railnav datum fit points.csv --crs "+proj=tmerc +lon_0=35.5 +ellps=krass" -o local.toml
      railnav import track.xml --crs local.toml -o line.gpkg
    """  # noqa: D301
    import numpy as np

    from railnav.cli import _files
    from railnav.cli._terminal import print_facts, print_json, print_table
    from railnav.geodesy.common_points import fit_datum
    from railnav.io.common_points import read_common_points
    from railnav.io.frame_file import write_frames

    _files.check_output(output, (".toml",), inputs=[points])
    data = read_common_points(points)
    kind: Any = int(parameters)
    found = fit_datum(
        data.latitude,
        data.longitude,
        data.height,
        data.easting,
        data.northing,
        data.local_height,
        crs=crs,
        parameters=kind,
        names=data.names,
        sigma=sigma,
        name=name,
        keep_all=keep_all,
    )
    here = found.predicted_sigma(data.latitude, data.longitude)
    rows: list[dict[str, Any]] = [
        {
            "point": found.names[i],
            "east_m": float(found.residual[i, 0]),
            "north_m": float(found.residual[i, 1]),
            "up_m": float(found.residual[i, 2]),
            "test": float(found.ratio[i]),
            "detectable_m": float(found.detectable[i]),
            "fit_sigma_m": float(here[i]),
            "agrees": bool(found.used[i]),
        }
        for i in range(len(found.names))
    ]
    facts: dict[str, Any] = {
        "parameters": found.parameters,
        "sigmas": found.sigmas,
        "sigma_m": found.sigma,
        "freedom": found.freedom,
        "advice": list(found.advice),
    }
    write_frames(
        output,
        [found.frame],
        heading=f"fitted to {points.name}",
        facts=[
            {
                **found.parameters,
                **{f"sigma_{key}": value for key, value in found.sigmas.items()},
                "sigma_m": found.sigma,
            }
        ],
        tables={"point": rows},
    )
    if as_json:
        print_json({**facts, "points": rows, "frame": found.frame.name, "output": output})
        return
    set_aside = [row["point"] for row in rows if not row["agrees"]]
    print_table(
        "Residuals (local minus transformed)",
        ("point", "", "east, m", "north, m", "up, m", "test (1 is the limit)", "found beyond, m"),
        [
            (
                row["point"],
                "" if row["agrees"] else ("contradicts, kept" if keep_all else "set aside"),
                f"{row['east_m']:.3f}",
                f"{row['north_m']:.3f}",
                "" if np.isnan(row["up_m"]) else f"{row['up_m']:.3f}",
                "" if np.isnan(row["test"]) else f"{row['test']:.2f}",
                "" if not np.isfinite(row["detectable_m"]) else f"{row['detectable_m']:.3f}",
            )
            for row in rows
        ],
        left=2,
    )
    print_table(
        "Parameters (WGS 84 to local, coordinate frame)" if kind != 4 else "Parameters (base plane to local plane)",
        ("parameter", "value", "sigma (shifts: amid the points)"),
        [
            (key, f"{value:.6g}" if "_m" not in key else f"{value:.4f}", f"{found.sigmas[key]:.3g}")
            for key, value in found.parameters.items()
        ],
    )
    print_facts(
        f"{output} written",
        {
            "plane": found.frame.name,
            "sigma": "unknown: no point is left over"
            if np.isnan(found.sigma)
            else f"{found.sigma:.4f} m a coordinate, {found.freedom} left over",
            "set aside": ", ".join(set_aside),
            "use": f"--crs {output}",
        },
    )
    for line in found.advice:
        click.echo(f"  - {line}")


@command.command("points")
@click.argument("points", type=PATH)
@click.option("--from", "source", required=True, help="Datum of the table, e.g. ITRF2020, PZ-90.11, SK-42, ETRS89.")
@click.option("--to", "target", required=True, help="Datum wanted.")
@click.option("--epoch", type=float, help="Decimal year of the coordinates, where their datum moves.")
@click.option("--to-epoch", type=float, help="Decimal year wanted, where that datum moves.")
@click.option("--plate", help="Tectonic plate, four letters.  [default: where the points lie]")
@click.option("-o", "--output", type=PATH, required=True, help="Table to write, .csv or .parquet.")
@json_option
def points_(
    points: Path,
    source: str,
    target: str,
    epoch: float | None,
    to_epoch: float | None,
    plate: str | None,
    output: Path,
    as_json: bool,
) -> None:
    """Carry a table of points from one datum and epoch to another.

    The table has latitude_deg, longitude_deg, height_m, and point if its points have names.

    \b
    Example:
      railnav datum points base.csv --from ITRF2020 --epoch 2026.5 --to GSK-2011 -o base-gsk.csv
    """  # noqa: D301
    import numpy as np

    from railnav.cli import _files
    from railnav.cli._terminal import print_facts, print_json
    from railnav.geodesy.datums import datum_shift, find_datum
    from railnav.io.common_points import read_points, write_points

    _files.check_output(output, (".csv", ".parquet"), inputs=[points])
    data = read_points(points)
    shift = datum_shift(source, target, data.latitude, data.longitude, epoch=epoch, target_epoch=to_epoch, plate=plate)
    first, second = find_datum(source), find_datum(target)
    assert first is not None
    assert second is not None
    x = np.column_stack(first.figure.to_cartesian(data.latitude, data.longitude, data.height))
    moved = shift.apply(x)
    write_points(output, data.names, *second.figure.to_geodetic(*moved.T))
    facts: dict[str, Any] = {
        "points": len(moved),
        "transformation": shift.operation,
        "accuracy_m": shift.accuracy,
        "moved_m": [
            float(v) for v in (np.linalg.norm(moved - x, axis=1).min(), np.linalg.norm(moved - x, axis=1).max())
        ],
    }
    if as_json:
        print_json({**facts, "output": output})
        return
    print_facts(
        f"{output} written",
        {
            "points": len(moved),
            "transformation": shift.operation,
            "accuracy": f"{shift.accuracy:.2g} m",
            "moved in space": f"{facts['moved_m'][0]:.3f} to {facts['moved_m'][1]:.3f} m",
        },
    )
