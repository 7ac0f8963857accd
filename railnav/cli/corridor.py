"""`railnav corridor`: a plane of its own for a trunk line, in which a metre is a metre on the ground."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from railnav.cli._verb import PATH, json_option


@click.command("corridor")
@click.argument("line", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Frame file to write, .toml.")
@click.option(
    "--section-km", type=click.FloatRange(1.0, 2000.0), help="Part the line into sections no longer than this."
)
@click.option(
    "--overlap-km", type=click.FloatRange(0.0, 100.0), default=5.0, show_default=True, help="How far sections overlap."
)
@click.option(
    "--base", default="EPSG:4326", show_default=True, help="Geographic system beneath, e.g. EPSG:4258 or EPSG:7683."
)
@click.option("--name", default="", help="Name of the plane.")
@click.option("--plot", type=PATH, help="Also draw the distortion along the line, .png, .svg or .pdf.")
@json_option
def command(
    line: Path,
    output: Path,
    section_km: float | None,
    overlap_km: float,
    base: str,
    name: str,
    plot: Path | None,
    as_json: bool,
) -> None:
    """Fit a low-distortion plane to a whole line, and write it as a frame file.

    LINE is a model (.gpkg, .geojson) or a table of places in order (.csv, .parquet) with latitude_deg, longitude_deg and
    height_m (ellipsoidal). The plane is an oblique Mercator projection whose largest distortion along the line, heights
    included, is the least possible. With --section-km a long line gets several planes; where two meet, the file gives
    one place in both. Any verb then takes --crs FILE, or --crs FILE:2 for the second section.

    \b
    Example:
      railnav corridor demo/line.gpkg -o corridor.toml --plot corridor.png
    """  # noqa: D301
    import math

    import numpy as np

    from railnav.cli import _files
    from railnav.cli._terminal import print_facts, print_json, print_table
    from railnav.errors import CrsError
    from railnav.geodesy.corridor import compare_planes, fit_corridor
    from railnav.geodesy.grid import choose_frame
    from railnav.io.frame_file import write_frames

    _files.check_output(output, (".toml",), inputs=[line])
    if plot is not None:
        _files.check_output(plot, (".png", ".svg", ".pdf"), inputs=[line, output])
        _files.need_report()
    latitude, longitude, height = _course(line)
    title = name.strip() or f"Corridor of {line.stem}"
    found = fit_corridor(
        latitude,
        longitude,
        height,
        section_length=None if section_km is None else section_km * 1e3,
        overlap=overlap_km * 1e3,
        base=f"EPSG:{base}" if base.isdigit() else base,
        name=title,
    )
    sections: list[dict[str, Any]] = [
        {
            **section.parameters,
            "first_m": section.first,
            "last_m": section.last,
            "largest_ppm": float(np.abs(section.distortion).max() * 1e6),
            "rms_ppm": float(np.sqrt(np.mean(section.distortion**2)) * 1e6),
        }
        for section in found.sections
    ]
    junctions: list[dict[str, Any]] = [
        {
            "station_m": j.station,
            "latitude_deg": math.degrees(j.latitude),
            "longitude_deg": math.degrees(j.longitude),
            "height_m": j.height,
            "before_m": list(j.before),
            "after_m": list(j.after),
            "turn_deg": math.degrees(j.turn),
        }
        for j in found.junctions
    ]
    others: list[dict[str, Any]] = []
    for width in ("gk6", "gk3"):
        try:
            others += compare_planes(latitude, longitude, height, [choose_frame(latitude, longitude, crs=width)])
        except CrsError:
            others.append({"plane": f"{width}: the line leaves the zone"})
    write_frames(
        output,
        [section.frame for section in found.sections],
        heading=f"{title}, {found.length / 1e3:.3f} km, at most {found.largest * 1e6:.2f} mm/km",
        facts=sections,
        tables={"junction": junctions},
    )
    if plot is not None:
        _draw(plot, found, title, latitude, longitude, height)
    if as_json:
        print_json(
            {
                "length_m": found.length,
                "largest_ppm": found.largest * 1e6,
                "sections": sections,
                "junctions": junctions,
                "compared": others,
                "output": output,
            }
        )
        return
    print_facts(
        f"{output} written",
        {
            "line": f"{found.length / 1e3:.3f} km on the ground",
            "heights": "included" if np.isfinite(height).any() else "none: the ground is taken to be the ellipsoid",
            "largest distortion": f"{found.largest * 1e6:.2f} mm/km",
            "use": f"--crs {output}" if len(sections) == 1 else f"--crs {output}:1 to --crs {output}:{len(sections)}",
        },
    )
    print_table(
        "Planes",
        ("section", "from, km", "to, km", "axis azimuth", "scale on it", "largest, mm/km", "rms, mm/km"),
        [
            (
                i,
                f"{s['first_m'] / 1e3:.1f}",
                f"{s['last_m'] / 1e3:.1f}",
                f"{s['azimuth_deg']:.4f}",
                f"{s['scale']:.9f}",
                f"{s['largest_ppm']:.2f}",
                f"{s['rms_ppm']:.2f}",
            )
            for i, s in enumerate(sections, 1)
        ],
    )
    print_table(
        "For comparison",
        ("plane", "least, mm/km", "largest, mm/km", "mean, mm/km", "whole line, m"),
        [
            (
                row["plane"],
                *(
                    f"{row[key]:.1f}" if key in row else ""
                    for key in ("least_ppm", "largest_ppm", "mean_ppm", "length_error_m")
                ),
            )
            for row in others
        ],
    )
    print_table(
        "Junctions",
        ("at, km", "easting before", "northing before", "easting after", "northing after", "turn, degrees"),
        [
            (
                f"{j['station_m'] / 1e3:.3f}",
                *(f"{v:.4f}" for v in (*j["before_m"], *j["after_m"])),
                f"{j['turn_deg']:.6f}",
            )
            for j in junctions
        ],
    )
    if plot is not None:
        click.echo(f"Picture: {plot}")


def _course(line: Path) -> tuple[Any, Any, Any]:
    """Places of a line in order: of a model, or of a table."""
    import numpy as np

    from railnav.cli import _files
    from railnav.errors import InputError

    if line.suffix.lower() in (".csv", ".parquet"):
        from railnav.io.common_points import read_course

        return read_course(line)
    kind = _files.kind_of(line)
    if kind != "model":
        raise InputError(f"is a {kind}, not a line", file=line, remedy="name a model, or a table of places in order")
    from railnav.track.course import course

    latitude, longitude, height = course(_files.read_model(line))
    return latitude, longitude, np.asarray(height)


def _draw(plot: Path, found: Any, title: str, latitude: Any, longitude: Any, height: Any) -> None:
    import numpy as np

    from railnav.geodesy.corridor import ground_profile
    from railnav.web.distortion import distortion_figure
    from railnav.web.pictures import save

    curves = [
        (
            f"section {i}" if len(found.sections) > 1 else title,
            section.first + (section.station - section.station[0]),
            section.distortion,
        )
        for i, section in enumerate(found.sections, 1)
    ]
    ground = ground_profile(latitude, longitude, height) if np.isfinite(height).any() else None
    figure = distortion_figure(curves, height=ground, title=f"{title}: at most {found.largest * 1e6:.2f} mm/km")
    save(figure, plot)
