"""`railnav import`: a track network from elsewhere becomes a model."""

from __future__ import annotations

from pathlib import Path

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
@click.option("--layer", help="Layer of a GeoPackage or Geodatabase that holds the track axes.")
@click.option(
    "--columns",
    multiple=True,
    metavar="WHAT=COLUMN",
    help="Column of a layer that names the track (or line, name, start_km, end_km); several, or one list with commas.",
)
@json_option
def command(
    source: Path,
    output: Path,
    crs: str | None,
    zone_width: str | None,
    ellipsoid: str | None,
    spacing: float,
    layer: str | None,
    columns: tuple[str, ...],
    as_json: bool,
) -> None:
    """Turn a track network (OpenStreetMap, GeoJSON, LandXML, railML, layers, elements) into a reference track model.

    GeoJSON (.geojson, .json): one LineString a track, in WGS 84, property `track`. Elements (.csv, .parquet): straights, arcs
    and clothoids with the coordinates of their start; --crs names their plane. LandXML 1.2 (.xml): alignments with profile,
    cant and station equations, joined where one ends on another; --crs names their plane unless the file does. railML 3 (.railml,
    .xml): net elements with their relations, curves, gradients, switches and balises; railML 2 by its geographic points. Layers
    (.gpkg, .shp, .fgb): a line a track, --columns track=COLUMN names it. Axis tables (.csv with the
    columns n, s, ds, R, cl, tang, rw, hw): points of alignment, joined likewise. OpenStreetMap (.osm.pbf): rail, light rail,
    underground, tram and narrow gauge with the movements of switches and crossings, mile posts and tunnels, good to a metre.

    \b
    Example:
      railnav import demo/line.geojson -o imported.gpkg
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._describe import describe_model, print_model
    from railnav.cli._terminal import print_json, print_warnings, progress
    from railnav.cli._verb import frame_request
    from railnav.io.network import LAYER_ENDINGS, read_network

    _files.check_output(output, (".gpkg",), inputs=[source])
    request = frame_request(crs, zone_width, ellipsoid)
    if (layer or columns) and source.suffix.lower() not in LAYER_ENDINGS:
        raise click.UsageError(f"--layer and --columns are for layers: {', '.join(LAYER_ENDINGS)}")
    with progress() as tell:
        model = read_network(source, **request, spacing=spacing, layer=layer, columns=_mapping(columns), progress=tell)
    model.to_file(output)
    facts = describe_model(model)
    if as_json:
        print_json({**facts, "output": output})
    else:
        print_warnings(model.provenance.get("import", {}).get("notes", []))
        print_model(facts, f"{output} written")


def _mapping(columns: tuple[str, ...]) -> dict[str, str]:
    """What `--columns` says: from what a track has to the layer's column of it."""
    found: dict[str, str] = {}
    for part in (part for text in columns for part in text.split(",") if part.strip()):
        what, sign, column = part.partition("=")
        if not sign or not what.strip() or not column.strip():
            raise click.UsageError(f"--columns {part!r}: write WHAT=COLUMN, for instance track=GLEIS")
        found[what.strip()] = column.strip()
    return found
