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
    from railnav.cli._terminal import print_json, print_warnings
    from railnav.cli._verb import frame_request
    from railnav.errors import InputError

    _files.check_output(output, (".gpkg",), inputs=[source])
    request = frame_request(crs, zone_width, ellipsoid)
    ending = source.suffix.lower()
    if not source.exists():
        raise InputError("no such file", file=source)
    layered = ending in (".gpkg", ".shp", ".fgb", ".gdb", ".zip")
    if (layer or columns) and not layered:
        raise click.UsageError("--layer and --columns are for layers: .gpkg, .shp, .fgb, .gdb")
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
    elif ending == ".railml" or (ending == ".xml" and _files.xml_kind(source).lower() == "railml"):
        from railnav.io.railml import read_railml

        model = read_railml(source, **request, spacing=spacing)
    elif ending in (".xml", ".landxml"):
        from railnav.io.landxml import read_landxml

        model = read_landxml(source, crs=request["crs"], spacing=spacing)
    elif layered:
        from railnav.io.layers import read_layer

        _refuse_model(source)
        model = read_layer(source, layer=layer, columns=_mapping(columns), **request, spacing=spacing)
    else:
        raise InputError(
            "a network of this ending cannot be imported",
            file=source,
            remedy="use .osm.pbf, .geojson, .json, LandXML .xml, .railml, .gpkg, .shp, or elements .csv or .parquet",
        )
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


def _refuse_model(source: Path) -> None:
    """A GeoPackage that railnav wrote is no layer to import."""
    import sqlite3
    from contextlib import closing

    from railnav.errors import InputError
    from railnav.io.container import META

    if source.suffix.lower() != ".gpkg" or not source.is_file():
        return
    try:
        with closing(sqlite3.connect(f"{source.resolve().as_uri()}?mode=ro", uri=True)) as connection:
            ours = connection.execute("SELECT 1 FROM sqlite_master WHERE name = ?", (META,)).fetchone()
    except sqlite3.Error:
        return
    if ours:
        raise InputError("is a model or a solution of railnav already", file=source, remedy="use it as it is")


def _plane(source: Path, request: dict[str, Any]) -> Any:
    """The plane that a file of grid coordinates needs and does not name itself."""
    from railnav.errors import InputError

    if request["crs"] is None:
        raise InputError(
            "grid coordinates need the plane they lie in", file=source, remedy="name it, e.g. --crs EPSG:31467"
        )
    return request["crs"]
