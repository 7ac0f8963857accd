"""How QGIS draws railnav's layers: the table `layer_styles` of a GeoPackage, read by QGIS when it opens one.

Tracks are lines with the line's name, nodes differ by kind, mile posts carry their chainage, points of a solution differ by mode.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.sax.saxutils import quoteattr

from railnav.io.container import Container

#: Colours (red, green, blue) and sizes in mm of what is drawn.
_MODES = {
    "initialising": (170, 170, 170),
    "tracking": (0, 150, 80),
    "coasting": (245, 165, 0),
    "ambiguous": (190, 40, 200),
    "off-model": (220, 30, 30),
    "lost": (0, 0, 0),
}
_KINDS = {
    "joint": ("circle", (120, 120, 120), 1.0),
    "turnout": ("triangle", (20, 90, 200), 2.4),
    "crossing": ("cross2", (20, 90, 200), 2.4),
    "buffer-stop": ("square", (190, 30, 30), 2.0),
    "end-of-model": ("circle", (255, 255, 255), 1.6),
}
_COLUMNS = (
    "id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT(256), f_table_schema TEXT(256), "
    "f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT, styleSLD TEXT, "
    "useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30), "
    "update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now'))"
)


def add_styles(container: Container, layers: Sequence[str]) -> None:
    """Add the table of styles for the layers named: "tracks", "nodes", "mileposts", "solution".

    Parameters
    ----------
    container : Container
        A GeoPackage being written that has these layers.
    layers : sequence of str
        Those of them that it has.
    """
    connection = container.connection
    connection.execute(f"CREATE TABLE layer_styles ({_COLUMNS})")
    stamp = container.stamp
    connection.execute(
        "INSERT INTO gpkg_contents VALUES ('layer_styles', 'attributes', 'layer_styles', 'how QGIS draws the layers', ?, "
        "NULL, NULL, NULL, NULL, NULL)",
        (stamp,),
    )
    connection.executemany(
        "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName, styleQML, "
        "styleSLD, useAsDefault, description, owner, ui, update_time) VALUES ('', '', ?, 'geom', ?, ?, '', 1, ?, '', NULL, ?)",
        [(layer, f"railnav {layer}", _STYLES[layer](), f"railnav: {layer}", stamp) for layer in layers],
    )


def _colour(colour: tuple[int, int, int]) -> str:
    return ",".join(map(str, (*colour, 255)))


def _layer(kind: str, options: Mapping[str, str]) -> str:
    """One symbol layer, with its options as QGIS writes them since 3.26 and as it wrote them before."""
    new = "".join(f'<Option type="QString" name="{key}" value={quoteattr(value)}/>' for key, value in options.items())
    old = "".join(f'<prop k="{key}" v={quoteattr(value)}/>' for key, value in options.items())
    return f'<layer class="{kind}" enabled="1" locked="0" pass="0"><Option type="Map">{new}</Option>{old}</layer>'


def _symbol(name: str, kind: str, layers: str) -> str:
    return f'<symbol type="{kind}" name="{name}" alpha="1" clip_to_extent="1" force_rhr="0">{layers}</symbol>'


def _marker(shape: str, colour: tuple[int, int, int], size: float) -> str:
    return _layer(
        "SimpleMarker",
        {
            "name": shape,
            "color": _colour(colour),
            "outline_color": "60,60,60,255",
            "outline_width": "0.2",
            "size": f"{size:g}",
            "size_unit": "MM",
        },
    )


def _categories(attribute: str, symbols: Mapping[str, str]) -> str:
    rows = "".join(
        f'<category value="{value}" label="{value}" symbol="{i}" render="true"/>' for i, value in enumerate(symbols)
    )
    drawn = "".join(_symbol(str(i), "marker", layers) for i, layers in enumerate(symbols.values()))
    return (
        f'<renderer-v2 type="categorizedSymbol" attr="{attribute}" enableorderby="0" forceraster="0" symbollevels="0">'
        f"<categories>{rows}</categories><symbols>{drawn}</symbols></renderer-v2>"
    )


def _single(kind: str, layers: str) -> str:
    return (
        '<renderer-v2 type="singleSymbol" enableorderby="0" forceraster="0" symbollevels="0">'
        f"<symbols>{_symbol('0', kind, layers)}</symbols></renderer-v2>"
    )


def _labels(expression: str, placement: int, scale: int) -> str:
    return (
        '<labeling type="simple"><settings calloutType="simple">'
        f'<text-style fieldName={quoteattr(expression)} isExpression="1" fontSize="8" fontSizeUnit="Point" textColor="40,40,40,255">'
        '<text-buffer bufferDraw="1" bufferSize="0.8" bufferColor="255,255,255,255"/></text-style>'
        f'<placement placement="{placement}"/>'
        f'<rendering scaleVisibility="1" scaleMin="{scale}" scaleMax="0" drawLabels="1" displayAll="0"/>'
        "</settings></labeling>"
    )


def _qml(body: str, geometry: int) -> str:
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
        f'<qgis version="3.28.0" styleCategories="Symbology|Labeling">{body}<layerGeometryType>{geometry}</layerGeometryType></qgis>'
    )


def _tracks() -> str:
    line = _layer(
        "SimpleLine", {"line_color": "60,60,70,255", "line_width": "0.5", "line_width_unit": "MM", "capstyle": "round"}
    )
    return _qml(_single("line", line) + _labels("coalesce(\"line\" || ' ', '') || \"track\"", 2, 25_000), 1)


def _nodes() -> str:
    return _qml(_categories("kind", {kind: _marker(*look) for kind, look in _KINDS.items()}), 0)


def _mileposts() -> str:
    return _qml(
        _single("marker", _marker("diamond", (255, 220, 60), 1.8))
        + _labels('format_number("chainage_m" / 1000, 3)', 1, 10_000),
        0,
    )


def _solution() -> str:
    return _qml(_categories("mode", {mode: _marker("circle", colour, 1.6) for mode, colour in _MODES.items()}), 0)


_STYLES = {"tracks": _tracks, "nodes": _nodes, "mileposts": _mileposts, "solution": _solution}
