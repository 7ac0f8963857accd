"""A track network from whatever file holds one: the format is told by its ending, of XML by its root."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from railnav.errors import InputError
from railnav.run import Progress
from railnav.track.model import TrackModel

#: Endings of layers of lines.
LAYER_ENDINGS = (".gpkg", ".shp", ".fgb", ".gdb", ".zip")


def read_network(
    path: str | Path,
    *,
    crs: Any = None,
    zone_width: int = 6,
    ellipsoid: str = "wgs84",
    spacing: float = 1.0,
    layer: str | None = None,
    columns: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> TrackModel:
    """Read a track network and make a model of it.

    Parameters
    ----------
    path : path
        OpenStreetMap (.osm.pbf), GeoJSON (.geojson, .json), LandXML (.xml, .landxml), railML (.railml, .xml), layers of lines (.gpkg, .shp,
        .fgb, .gdb, .zip), elements or axis tables (.csv, .parquet).
    crs, zone_width, ellipsoid
        The plane of the model, as for `railnav.geodesy.choose_frame`; of grid coordinates that name none, the plane they lie in.
    spacing : float
        Wanted distance between the model's knots, m.
    layer, columns
        Of layers of lines; see `railnav.io.layers.read_layer`.
    progress : callable, optional
        Told of the stages of long work.

    Returns
    -------
    TrackModel
        `provenance["import"]["notes"]` says what was passed over. Tracks that name their line and have posts give it line references
        (`railnav.track.posts`), so that published addresses can be looked up.

    Raises
    ------
    InputError
        The file is missing, of no known format, or refused by its reader; a table of grid coordinates without `crs`.
    CrsError
        The plane does not serve the data.

    Examples
    --------
    >>> read_network("nowhere.osm.pbf")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.osm.pbf: no such file
    """
    path = Path(path)
    ending = path.suffix.lower()
    if not path.exists():
        raise InputError("no such file", file=path)
    if (layer or columns) and ending not in LAYER_ENDINGS:
        raise InputError("has no layers", file=path, remedy="layer and columns are for .gpkg, .shp, .fgb, .gdb")
    plane: dict[str, Any] = {"crs": crs, "zone_width": zone_width, "ellipsoid": ellipsoid}
    return _referenced(_read(path, plane, spacing, layer, columns, progress))


def _referenced(model: TrackModel) -> TrackModel:
    """The model with line references from the posts of tracks that name their line; what has some already keeps them."""
    from railnav.track.model import MilePosts
    from railnav.track.posts import references_from_posts, spread_references

    posts = model.mileposts
    named = np.array([bool(line) for line in model.line], np.bool_)[posts.track]
    if len(model.references) or not named.any():
        return model
    kept = MilePosts(posts.track[named], posts.offset[named], posts.chainage[named])
    found = references_from_posts(replace(model, mileposts=kept))
    return replace(model, references=spread_references(model, found)) if len(found) else model


def _read(
    path: Path,
    plane: dict[str, Any],
    spacing: float,
    layer: str | None,
    columns: Mapping[str, str] | None,
    progress: Progress | None,
) -> TrackModel:
    """Read the file by the reader of its kind."""
    crs, ending = plane["crs"], path.suffix.lower()
    if ending in (".geojson", ".json"):
        from railnav.io.geojson import read_geojson

        return read_geojson(path, **plane, spacing=spacing)
    if ending in (".csv", ".parquet"):
        from railnav.io.axis_table import AXIS_COLUMNS, read_axis_table
        from railnav.io.elements import read_elements
        from railnav.io.tables import header_of

        if crs is None:
            raise InputError(
                "grid coordinates need the plane they lie in", file=path, remedy="name it, e.g. --crs EPSG:31467"
            )
        read_table = read_axis_table if header_of(path) >= AXIS_COLUMNS else read_elements
        return read_table(path, crs=crs, spacing=spacing)
    if path.name.lower().endswith(".osm.pbf"):
        from railnav.io.osm import read_osm

        return read_osm(path, **plane, spacing=spacing, progress=progress)
    if ending == ".railml" or (ending == ".xml" and xml_kind(path).lower() == "railml"):
        from railnav.io.railml import read_railml

        return read_railml(path, **plane, spacing=spacing)
    if ending in (".xml", ".landxml"):
        from railnav.io.landxml import read_landxml

        return read_landxml(path, crs=crs, spacing=spacing)
    if ending in LAYER_ENDINGS:
        from railnav.io.layers import read_layer

        _refuse_own(path)
        return read_layer(path, layer=layer, columns=columns, **plane, spacing=spacing)
    raise InputError(
        "a network of this ending cannot be imported",
        file=path,
        remedy="use .osm.pbf, .geojson, .json, LandXML .xml, .railml, .gpkg, .shp, or elements .csv or .parquet",
    )


def xml_kind(path: Path) -> str:
    """Name of the root element of an XML file, by its first bytes; empty where there is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        head = file.read(65536)
    code = "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"
    text = re.sub(r"<[?!][^>]*>|<!--.*?-->", "", head.decode(code, "replace"), flags=re.DOTALL)
    found = re.search(r"<(?:[\w.-]+:)?([\w.-]+)", text)
    return found[1] if found else ""


def _refuse_own(path: Path) -> None:
    """A GeoPackage that railnav wrote is no layer to import."""
    from railnav.io.container import META

    if path.suffix.lower() != ".gpkg" or not path.is_file():
        return
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as connection:
            ours = connection.execute("SELECT 1 FROM sqlite_master WHERE name = ?", (META,)).fetchone()
    except sqlite3.Error:
        return
    if ours:
        raise InputError("is a model or a solution of railnav already", file=path, remedy="use it as it is")
