"""`railnav import`: a track network from elsewhere becomes a model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from railnav.cli._verb import PATH, crs_options, json_option


@click.command("import")
@click.argument("source", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Model to write, .gpkg.")
@crs_options
@click.option(
    "--spacing",
    type=click.FloatRange(0, min_open=True),
    default=1.0,
    show_default=True,
    help="Distance between knots, m.",
)
@json_option
def command(
    source: Path,
    output: Path,
    crs: str | None,
    zone_width: str | None,
    ellipsoid: str | None,
    spacing: float,
    as_json: bool,
) -> None:
    """Turn a track network (OpenStreetMap, GeoJSON, LandXML, elements CSV) into a reference track model.

    GeoJSON (.geojson, .json): one LineString a track, in WGS 84, property `track`. Elements (.csv, .parquet): straights, arcs
    and clothoids with the coordinates of their start; --crs names their plane. LandXML 1.2 (.xml): alignments with profile,
    cant and station equations, joined where one ends on another; --crs names their plane. Axis tables (.csv with the
    columns n, s, ds, R, cl, tang, rw, hw): points of alignment, joined likewise. OpenStreetMap (.osm.pbf): rail, light rail,
    underground, tram and narrow gauge with the movements of switches and crossings, mile posts and tunnels, good to a metre.

    \b
    Example:
      railnav import demo/line.geojson -o imported.gpkg
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._describe import describe_model, print_model
    from railnav.cli._terminal import print_json
    from railnav.cli._verb import frame_request
    from railnav.errors import InputError

    _files.check_output(output, (".gpkg",), inputs=[source])
    request = frame_request(crs, zone_width, ellipsoid)
    ending = source.suffix.lower()
    if not source.is_file():
        raise InputError("no such file", file=source)
    if ending in (".geojson", ".json"):
        from railnav.io.geojson import read_geojson

        model = read_geojson(source, **request, spacing=spacing)
    elif ending in (".csv", ".parquet"):
        from railnav.io.axis_table import AXIS_COLUMNS, read_axis_table
        from railnav.io.elements import read_elements

        read_table = read_axis_table if _files.columns(source) >= AXIS_COLUMNS else read_elements
        model = read_table(source, crs=_plane(source, request), spacing=spacing)
    elif source.name.lower().endswith(".osm.pbf"):
        from railnav.cli._terminal import progress
        from railnav.io.osm import read_osm

        with progress() as tell:
            model = read_osm(source, **request, spacing=spacing, progress=tell)
    elif ending == ".xml":
        from railnav.io.landxml import read_landxml

        model = read_landxml(source, crs=_plane(source, request), spacing=spacing)
    else:
        raise InputError(
            "a network of this ending cannot be imported",
            file=source,
            remedy="use .osm.pbf, .geojson, .json, LandXML .xml, or elements .csv or .parquet",
        )
    model.to_file(output)
    facts = describe_model(model)
    if as_json:
        print_json({**facts, "output": output})
    else:
        print_model(facts, f"{output} written")


def _plane(source: Path, request: dict[str, Any]) -> Any:
    """The plane that a file of grid coordinates needs and does not name itself."""
    from railnav.errors import InputError

    if request["crs"] is None:
        raise InputError(
            "grid coordinates need the plane they lie in", file=source, remedy="name it, e.g. --crs EPSG:31467"
        )
    return request["crs"]
