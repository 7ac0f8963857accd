"""Track axes from layers of GeoPackage, Shapefile, FlatGeobuf and what else GDAL reads, by a mapping of columns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, InputError, RailnavError, TrackError
from railnav.geodesy.grid import GridFrame, choose_frame, frame_for_grid
from railnav.io.drawn import lay_line
from railnav.track.assembly import TrackSection, assemble
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

#: Endings that are taken for layers.
LAYER_ENDINGS = (".gpkg", ".shp", ".fgb", ".gdb", ".zip")
#: What columns may be mapped to.
FIELDS = ("track", "line", "name", "start_km", "end_km")
#: More features than this are refused.
MAX_FEATURES = 1_000_000
#: A vertex further from the one before than this is a mistake, m.
LONGEST_STEP = 20_000.0
_MOST_NOTES = 20


def read_layer(
    path: str | Path,
    *,
    layer: str | None = None,
    columns: Mapping[str, str] | None = None,
    crs: Any = None,
    zone_width: int = 6,
    ellipsoid: str = "wgs84",
    spacing: float = 1.0,
) -> TrackModel:
    """Read track axes from a layer of lines.

    Parameters
    ----------
    path : path
        GeoPackage, Shapefile, FlatGeobuf, File Geodatabase, or a zipped Shapefile.
    layer : str, optional
        The layer; not needed where the file has one layer of lines.
    columns : mapping, optional
        From what a track has ("track", "line", "name", "start_km", "end_km") to the layer's column of it. Where `track` is
        not mapped, a column of that name counts; "fid" takes the number of the feature. A column that is mapped must be there.
    crs, zone_width, ellipsoid
        The plane of the model, as for `railnav.geodesy.choose_frame`; by default the layer's own where that is a plane. Where the
        layer names none, its coordinates are taken to lie in `crs`.
    spacing : float
        Wanted distance between the model's knots, m.

    Returns
    -------
    TrackModel
        One track a feature (`name.1`, `name.2` where one has several parts). Ends within 0.5 m are one node; movements follow
        from the tangents.

    Raises
    ------
    InputError
        No such layer or column; a layer without lines; a feature without a line or an identifier, or with another's; a file that
        GDAL does not read; a plane that is not known.
    RailnavError
        pyogrio is not installed.

    Notes
    -----
    Lines whose vertices turn by less than 4 degrees are splined, others rounded within 0.3 m. Z coordinates are heights of the layer's
    system.

    Examples
    --------
    >>> read_layer("nowhere.shp")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.shp: does not exist; check the name
    """
    path = Path(path)
    if not spacing > 0.0:
        raise InputError(f"knot spacing {spacing} m is not positive", file=path, remedy="use 1 m")
    try:
        import pyogrio
        from pyogrio.errors import DataLayerError, DataSourceError, FieldError
    except ImportError as error:
        raise RailnavError('layers need pyogrio; install with: pip install "railnav[frames]"') from error
    if not path.exists():
        raise InputError("does not exist", file=path, remedy="check the name")
    wanted = dict(columns or {})
    unknown = [key for key in wanted if key not in FIELDS]
    if unknown:
        raise InputError(f"{unknown[0][:40]!r} is nothing of a track", file=path, remedy=f"map {', '.join(FIELDS)}")
    try:
        chosen = _chosen(path, layer, pyogrio.list_layers(str(path)))
        about = pyogrio.read_info(str(path), layer=chosen)
        if about["features"] > MAX_FEATURES:
            raise InputError(
                f"has {about['features']} features", file=path, column=chosen, remedy="extract the railway"
            )
        fields = list(about["fields"])
        for key, column in wanted.items():
            if column not in fields and not (key == "track" and column == "fid"):
                raise InputError(
                    f"has no column {column[:60]!r}",
                    file=path,
                    column=chosen,
                    remedy=f"it has: {', '.join(fields)[:300]}",
                )
        if "track" not in wanted and "track" not in fields:
            raise InputError(
                "which column names the tracks?",
                file=path,
                column=chosen,
                remedy=f"say --columns track=COLUMN (or track=fid); it has: {', '.join(fields)[:300]}",
            )
        used = {key: wanted.get(key, key) for key in FIELDS if wanted.get(key, key) in fields}
        meta, fids, shapes, values = pyogrio.raw.read(
            str(path), layer=chosen, columns=sorted(set(used.values())), return_fids=True
        )
    except (DataSourceError, DataLayerError, FieldError, RuntimeError, UnicodeDecodeError) as error:
        cause = " ".join(str(error).split())[:200]
        raise InputError(f"cannot be read ({cause})", file=path, remedy="is it a GeoPackage or Shapefile?") from error
    table = dict(zip(meta["fields"], values, strict=True))
    try:
        frame, parts = _laid_into(path, chosen, shapes, fids, meta["crs"], crs, zone_width, ellipsoid)
    except CrsError as error:
        raise CrsError(f"{path}: {error}") from error
    return _assembled(path, chosen, frame, parts, fids, {key: table[name] for key, name in used.items()}, spacing)


def _chosen(path: Path, layer: str | None, found: Any) -> str:
    """The layer to read: the one named, or the only one of lines."""
    names = [str(name) for name, _ in found]
    lines = [str(name) for name, kind in found if kind is not None and "LineString" in str(kind)]
    if layer is not None:
        if layer not in names:
            raise InputError(f"has no layer {layer[:60]!r}", file=path, remedy=f"it has: {', '.join(names)[:300]}")
        if layer not in lines:
            raise InputError(
                "holds no lines", file=path, column=layer, remedy=f"layers of lines: {', '.join(lines)[:300]}"
            )
        return layer
    if not lines:
        raise InputError("has no layer of lines", file=path, remedy="tracks are LineStrings")
    if len(lines) > 1:
        raise InputError(
            "has several layers of lines", file=path, remedy=f"choose with --layer: {', '.join(lines)[:300]}"
        )
    return lines[0]


def _laid_into(
    path: Path,
    layer: str,
    shapes: Any,
    fids: Any,
    stated: str | None,
    crs: Any,
    zone_width: int,
    ellipsoid: str,
) -> tuple[GridFrame, list[list[FloatArray]]]:
    """The plane, and the parts of every feature as (n, 3) vertices in it."""
    import pyproj
    import shapely
    from pyproj.exceptions import CRSError

    lines = shapely.from_wkb(shapes, on_invalid="ignore")
    parts: list[list[FloatArray]] = []
    for fid, line in zip(fids.tolist(), lines, strict=True):
        if line is None or line.is_empty or line.geom_type not in ("LineString", "MultiLineString"):
            kind = "nothing" if line is None or line.is_empty else line.geom_type
            raise InputError(f"feature {fid} holds {kind}, not a line", file=path, column=layer, remedy="remove it")
        merged = shapely.line_merge(line) if line.geom_type == "MultiLineString" else line
        pieces = [shapely.get_coordinates(piece, include_z=True) for piece in getattr(merged, "geoms", [merged])]
        for piece in pieces:
            if not np.isfinite(piece[:, :2]).all():
                raise InputError(f"feature {fid} has a vertex that is not finite", file=path, column=layer)
        parts.append(pieces)
    if not parts:
        raise InputError("has no features", file=path, column=layer)
    every = np.concatenate([piece for pieces in parts for piece in pieces])
    try:
        system = None if not stated else pyproj.CRS.from_user_input(stated)
    except CRSError as error:
        raise InputError(f"its coordinate system is not known ({str(error)[:80]})", file=path, column=layer) from error
    if system is None:
        if crs is None:
            raise InputError(
                "does not say in which coordinate system it is",
                file=path,
                column=layer,
                remedy="name it, e.g. --crs EPSG:31467",
            )
        return frame_for_grid(every[:, 0], every[:, 1], crs=crs), parts
    if system.is_geographic:
        outside = (np.abs(every[:, 0]) > 180.0) | (np.abs(every[:, 1]) > 90.0)
        if outside.any():
            raise InputError(
                "has coordinates outside the Earth's", file=path, column=layer, remedy="check its coordinate system"
            )
        if system.geodetic_crs is not None and system.to_2d().to_epsg() not in (4326, None):
            from railnav.geodesy.transformation import geodetic_frame

            turned = geodetic_frame(system.to_wkt(), np.radians(every[:, 1]), np.radians(every[:, 0]))

            def to_wgs84(piece: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
                known = np.isfinite(piece[:, 2])
                up = np.where(known, piece[:, 2], 0.0)
                latitude, longitude, height = turned.to_wgs84(np.radians(piece[:, 1]), np.radians(piece[:, 0]), up)
                return latitude, longitude, np.where(known, height, np.nan)
        else:

            def to_wgs84(piece: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
                return np.radians(piece[:, 1]), np.radians(piece[:, 0]), piece[:, 2]

        latitude, longitude, _ = to_wgs84(every)
        frame = choose_frame(latitude, longitude, crs=crs, zone_width=zone_width, ellipsoid=ellipsoid)
        return frame, [[np.column_stack(frame.to_grid(*to_wgs84(piece))) for piece in pieces] for pieces in parts]
    own = frame_for_grid(every[:, 0], every[:, 1], crs=system)
    if crs is None:
        return own, parts
    latitude, longitude, _ = own.to_geodetic(every[:, 0], every[:, 1], None)
    frame = choose_frame(latitude, longitude, crs=crs, zone_width=zone_width, ellipsoid=ellipsoid)
    return frame, [
        [np.column_stack(frame.to_grid(*own.to_geodetic(p[:, 0], p[:, 1], p[:, 2]))) for p in pieces]
        for pieces in parts
    ]


def _assembled(
    path: Path,
    layer: str,
    frame: GridFrame,
    parts: list[list[FloatArray]],
    fids: Any,
    table: Mapping[str, Any],
    spacing: float,
) -> TrackModel:
    names = _texts(table["track"]) if "track" in table else [str(fid) for fid in fids.tolist()]
    line, name = (_texts(table[key]) if key in table else [""] * len(names) for key in ("line", "name"))
    ends = [_kilometres(path, layer, table[key], key) if key in table else None for key in ("start_km", "end_km")]
    first: dict[str, int] = {}
    sections: list[TrackSection] = []
    notes: list[str] = []
    for i, fid in enumerate(fids.tolist()):
        if not names[i]:
            raise InputError(
                f"feature {fid} names no track", file=path, column=layer, remedy="fill the column, or use track=fid"
            )
        if names[i] in first:
            raise InputError(
                f"features {first[names[i]]} and {fid} are both called {names[i][:60]!r}",
                file=path,
                column=layer,
                remedy="give every feature its own track, or use track=fid",
            )
        first[names[i]] = fid
        several = len(parts[i]) > 1
        if several:
            notes.append(f"feature {fid} ({names[i]}) has {len(parts[i])} parts")
        for k, piece in enumerate(parts[i]):
            step = np.hypot(*np.diff(piece[:, :2], axis=0).T)
            if (step > LONGEST_STEP).any():
                j = int(np.argmax(step > LONGEST_STEP))
                raise InputError(
                    f"feature {fid}: vertex {j + 2} lies {step[j] / 1e3:.0f} km from the one before",
                    file=path,
                    column=layer,
                )
            try:
                knots = lay_line(frame, piece, spacing)
            except TrackError as error:
                raise InputError(f"feature {fid}: {error}", file=path, column=layer) from error
            known = [None if end is None or several or np.isnan(end[i]) else float(end[i]) * 1e3 for end in ends]
            track = f"{names[i]}.{k + 1}" if several else names[i]
            sections.append(TrackSection(track, knots, line[i], name[i], known[0], known[1]))
    said = notes[:_MOST_NOTES] + ([f"and {len(notes) - _MOST_NOTES} more"] if len(notes) > _MOST_NOTES else [])
    told = {"format": "layer", "source": path.name, "layer": layer, "tracks": len(sections), "notes": said}
    try:
        return assemble(frame, sections, provenance={"import": told})
    except TrackError as error:
        raise InputError(str(error), file=path, column=layer) from error


def _texts(values: Any) -> list[str]:
    """Cells as text; empty where there is none, whole numbers without a point."""
    found = []
    for value in values.tolist():
        if value is None or (isinstance(value, float) and np.isnan(value)):
            found.append("")
        elif isinstance(value, float) and value.is_integer():
            found.append(str(int(value)))
        else:
            found.append(" ".join(str(value).split()))
    return found


def _kilometres(path: Path, layer: str, values: Any, key: str) -> FloatArray:
    try:
        return np.array([np.nan if value is None or value == "" else float(value) for value in values.tolist()])
    except (TypeError, ValueError) as error:
        raise InputError(
            f"the column of {key} holds {str(error)[:60]}, not kilometres", file=path, column=layer
        ) from error
