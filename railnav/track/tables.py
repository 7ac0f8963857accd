"""A model as tables: Arrow columns for any program that takes them, data frames for pandas, geometry as well-known binary."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RailnavError, TrackError
from railnav.track.model import NodeKind, TrackModel

if TYPE_CHECKING:
    import geopandas
    import pyarrow as pa

FloatArray = NDArray[np.float64]
Layer = Literal["tracks", "knots", "nodes", "mileposts", "movements"]

LAYERS: tuple[Layer, ...] = ("tracks", "knots", "nodes", "mileposts", "movements")


def geometry_column(shapes: Any, crs_wkt: str) -> tuple[pa.Field, pa.Array]:
    """A column of geometries as GeoArrow's well-known binary, with its coordinate system; null where there is none.

    Parameters
    ----------
    shapes : (n,) array of shapely geometries or None
    crs_wkt : str
        Their system; empty means WGS 84 longitude and latitude.

    Returns
    -------
    field, array
        Named "geometry".
    """
    import pyarrow as pa
    import shapely
    from pyproj import CRS

    system = CRS.from_wkt(crs_wkt) if crs_wkt else CRS.from_user_input("OGC:CRS84")
    said = {"crs": system.to_json_dict(), "crs_type": "projjson"}
    metadata = {"ARROW:extension:name": "geoarrow.wkb", "ARROW:extension:metadata": json.dumps(said)}
    blobs = shapely.to_wkb(np.asarray(shapes, object), include_srid=False)
    return pa.field("geometry", pa.binary(), metadata=metadata), pa.array(blobs.tolist(), pa.binary())


def points(easting: FloatArray, northing: FloatArray, height: FloatArray) -> Any:
    """Points, flat where a height is missing, None where a position is."""
    import shapely

    out = np.full(len(easting), None, object)
    known = np.isfinite(easting) & np.isfinite(northing)
    raised = known & np.isfinite(height)
    out[known & ~raised] = shapely.points(easting[known & ~raised], northing[known & ~raised])
    out[raised] = shapely.points(easting[raised], northing[raised], height[raised])
    return out


def model_table(model: TrackModel, layer: Layer = "knots") -> pa.Table:
    """One layer of a model as an Arrow table.

    Parameters
    ----------
    model : TrackModel
        The model.
    layer : {"knots", "tracks", "nodes", "mileposts", "movements"}
        "knots": one row a knot, every column of the knot tables with the chainage; "tracks": one a track, with its line through
        all knots; the others as in the model.

    Returns
    -------
    pyarrow.Table
        Units stand in the names; NaN is null; positions as a "geometry" column (GeoArrow well-known binary) in the model's plane.

    Raises
    ------
    TrackError
        No such layer.

    Examples
    --------
    >>> import railnav
    >>> table = model_table(railnav.demo_line(), "nodes")
    >>> table.column_names
    ['node', 'kind', 'easting_m', 'northing_m', 'height_m', 'geometry']
    """
    import pyarrow as pa
    import shapely

    if layer not in LAYERS:
        raise TrackError(f"a model has no layer {layer!r}; it has {', '.join(LAYERS)}")
    count = np.diff(model.knot_start)
    which = np.repeat(np.arange(len(model.track_id)), count)

    def text(names: Any, index: Any = None) -> pa.Array:
        if index is None:
            return pa.array(list(names), pa.string())
        return pa.DictionaryArray.from_arrays(pa.array(index, pa.int32()), pa.array(list(names), pa.string()))

    def real(values: FloatArray) -> pa.Array:
        return pa.array(values, pa.float64(), from_pandas=True)  # NaN is null

    shapes: Any = None
    if layer == "knots":
        columns = {
            "track": text(model.track_id, which),
            "offset_m": real(model.offset),
            "easting_m": real(model.easting),
            "northing_m": real(model.northing),
            "height_m": real(model.height),
            "grid_bearing_rad": real(model.grid_bearing),
            "curvature_1_m": real(model.curvature),
            "gradient": real(model.gradient),
            "cant_m": real(model.cant),
            "scale": real(model.scale),
            "chainage_m": real(model.chainage(which, model.offset)),
            **{
                f"covariance_{name}_m2": real(np.ascontiguousarray(model.covariance_g[:, k]))
                for k, name in enumerate(("ee", "en", "eu", "nn", "nu", "uu"))
            },
        }
        shapes = points(model.easting, model.northing, model.height)
    elif layer == "tracks":
        columns = {
            "track": text(model.track_id),
            "line": text(model.line),
            "name": text(model.name),
            "length_m": real(model.lengths),
            "start_node": text(model.nodes.id[i] for i in model.start_node.tolist()),
            "end_node": text(model.nodes.id[i] for i in model.end_node.tolist()),
        }
        shapes = np.full(len(model.track_id), None, object)
        for i in range(len(model.track_id)):
            part = slice(int(model.knot_start[i]), int(model.knot_start[i + 1]))
            xyz = [model.easting[part], model.northing[part]]
            if np.isfinite(model.height[part]).all():
                xyz.append(model.height[part])
            shapes[i] = shapely.LineString(np.column_stack(xyz))
    elif layer == "nodes":
        nodes = model.nodes
        kinds = [kind.name.lower().replace("_", "-") for kind in NodeKind]
        columns = {
            "node": text(nodes.id),
            "kind": text(kinds, nodes.kind),
            "easting_m": real(nodes.easting),
            "northing_m": real(nodes.northing),
            "height_m": real(nodes.height),
        }
        shapes = points(nodes.easting, nodes.northing, nodes.height)
    elif layer == "mileposts":
        posts = model.mileposts
        at = model.at(posts.track, posts.offset)
        columns = {
            "track": text(model.track_id, posts.track),
            "offset_m": real(posts.offset),
            "chainage_m": real(posts.chainage),
        }
        shapes = points(at.easting, at.northing, at.height)
    else:
        ends = ["start", "finish"]
        a, end_a, b, end_b = model.movements.T if len(model.movements) else np.zeros((4, 0), np.int64)
        columns = {
            "track_a": text(model.track_id, a),
            "end_a": text(ends, end_a),
            "track_b": text(model.track_id, b),
            "end_b": text(ends, end_b),
        }
    fields = [pa.field(name, column.type) for name, column in columns.items()]
    arrays = list(columns.values())
    if shapes is not None:
        field, array = geometry_column(shapes, model.frame.crs_wkt)
        fields.append(field)
        arrays.append(array)
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def frame_of(table: pa.Table) -> geopandas.GeoDataFrame:
    """A table with a "geometry" column as a GeoDataFrame (a DataFrame without one).

    Raises
    ------
    RailnavError
        geopandas is not installed.
    """
    try:
        import geopandas
    except ImportError as error:
        raise RailnavError('data frames need geopandas; install with: pip install "railnav[frames]"') from error
    if "geometry" not in table.column_names:
        return table.to_pandas()
    return geopandas.GeoDataFrame.from_arrow(table)
