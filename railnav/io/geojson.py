"""Track networks as GeoJSON (RFC 7946): one LineString a track section, in WGS 84.

Properties: `track` (unique text), and where known `line`, `name`, `start_km`, `end_km`, `cant_mm` (one value a vertex, left
rail high positive). railnav adds two of its own, which other programs pass over: `covariance_m2` (one list EE, EN, EU, NN,
NU, UU a vertex) and `posts` (pairs of offset in m and chainage in km, where chainage is not linear between the ends).
Heights are ellipsoidal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, InputError, TrackError
from railnav.geodesy.grid import choose_frame
from railnav.io.atomic import atomic_path
from railnav.track.alignment import SAME_VERTEX, fit_alignment
from railnav.track.assembly import TrackSection, assemble
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

#: A larger file is refused: it is read as a whole.
MAX_GEOJSON_BYTES = 1024**3
#: A vertex further from the one before than this is a mistake, m.
LONGEST_STEP = 20_000.0
#: What one repeats while reading is said for so many features, then counted.
_MOST_NOTES = 20


@dataclass(frozen=True, slots=True)
class _Feature:
    """One track section as the file has it: arrays in radians, m."""

    number: int
    track: str
    line: str
    name: str
    start_chainage: float | None
    end_chainage: float | None
    position: FloatArray  # (n, 3) latitude, longitude, height (NaN without)
    cant: FloatArray | None
    covariance_g: FloatArray | None
    posts: FloatArray | None

    @property
    def label(self) -> str:
        return f"feature {self.number} (track {self.track!r})"


def read_geojson(
    path: str | Path,
    *,
    crs: Any = None,
    zone_width: int = 6,
    ellipsoid: str = "wgs84",
    spacing: float = 1.0,
) -> TrackModel:
    """Read a track network from GeoJSON and lay it into a plane.

    Vertices become a C2 curve (`fit_alignment`); ends within 0.5 m become one node, and the tangents tell which movements a
    turnout permits (`assemble`).

    Parameters
    ----------
    path : path
        GeoJSON in WGS 84, UTF-8.
    crs, zone_width, ellipsoid
        The plane, as for `railnav.geodesy.choose_frame`; by default the 6-degree Gauss-Krueger zone of the data.
    spacing : float
        Distance between the model's knots, m.

    Returns
    -------
    TrackModel
        `provenance["import"]` says where it came from and, under "notes", what was passed over.

    Raises
    ------
    InputError
        The file is missing, too large or no GeoJSON; a feature is no LineString, lacks `track`, repeats another's, has
        fewer than two distinct vertices, a position that is none, or a list that does not fit its vertices. The message names
        the feature, counted from 1.
    CrsError
        The plane does not serve the data.

    Notes
    -----
    Consecutive vertices closer than 1 mm count once, and a note says so. 1,000 km with a vertex every 5 m
    take some 4 s of CPU.

    Examples
    --------
    >>> read_geojson("nowhere.geojson")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.geojson: does not exist; check the name
    """
    path = Path(path)
    features = _features(path)
    position = np.concatenate([feature.position for feature in features])
    try:
        frame = choose_frame(position[:, 0], position[:, 1], crs=crs, zone_width=zone_width, ellipsoid=ellipsoid)
        grid = np.column_stack(frame.to_grid(position[:, 0], position[:, 1], position[:, 2]))
    except CrsError as error:
        raise CrsError(f"{path}: {error}") from error
    sections: list[TrackSection] = []
    notes: list[str] = []
    start = 0
    for feature in features:
        vertices = grid[start : start + len(feature.position)]
        start += len(feature.position)
        step = np.hypot(np.diff(vertices[:, 0]), np.diff(vertices[:, 1]))
        if (step > LONGEST_STEP).any():
            i = int(np.argmax(step > LONGEST_STEP))
            raise InputError(
                f"{feature.label}: vertex {i + 2} lies {step[i] / 1e3:.0f} km from the one before",
                file=path,
                remedy="correct its coordinates (GeoJSON has longitude first)",
            )
        if repeated := int((step < SAME_VERTEX).sum()):
            notes.append(
                f"{feature.label}: {repeated} repeated {'vertex' if repeated == 1 else 'vertices'} counted once"
            )
        try:
            knots = fit_alignment(
                frame,
                vertices[:, 0],
                vertices[:, 1],
                vertices[:, 2],
                cant=feature.cant,
                covariance_g=feature.covariance_g,
                spacing=spacing,
            )
        except TrackError as error:
            raise InputError(f"{feature.label}: {error}", file=path) from error
        sections.append(
            TrackSection(
                feature.track,
                knots,
                feature.line,
                feature.name,
                feature.start_chainage,
                feature.end_chainage,
                feature.posts,
            )
        )
    said = notes[:_MOST_NOTES] + ([f"and {len(notes) - _MOST_NOTES} more"] if len(notes) > _MOST_NOTES else [])
    provenance = {
        "import": {
            "format": "GeoJSON",
            "source": path.name,
            "tracks": len(features),
            "vertices": len(position),
            "notes": said,
        }
    }
    return assemble(frame, sections, provenance=provenance)


def write_geojson(model: TrackModel, path: str | Path, *, step: float = 5.0, tolerance: float = 2e-4) -> None:
    """Write a model's tracks as GeoJSON, thinned so that reading them back gives the same curve.

    Parameters
    ----------
    model : TrackModel
        What to write.
    path : path
        File to write; replaced in one step if it exists.
    step : float
        Greatest distance between vertices, m.
    tolerance : float
        Greatest deviation of the curve through the vertices from the model's knots, m, across and in height (five times as
        much in cant); vertices are added where it would be more.

    Raises
    ------
    InputError
        The file cannot be written.

    Notes
    -----
    WGS 84 with 9 decimals (0.1 mm) and heights with 4; cant with 3 (mm). Reading back gives positions within 1 mm and
    lengths within 1 ppm. GeoJSON has no place for nodes, movements and the plane: they follow from the tangents and the
    data when the file is read.

    Examples
    --------
    >>> write_geojson(read_geojson("nowhere.geojson"), "line.geojson")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.geojson: does not exist; check the name
    """
    import msgspec

    lines = [msgspec.json.encode(_as_feature(model, i, step, tolerance)) for i in range(len(model.track_id))]
    with atomic_path(path) as draft, draft.open("wb") as file:
        file.write(b'{"type":"FeatureCollection","features":[\n')
        file.write(b",\n".join(lines))
        file.write(b"\n]}\n")


# --- reading ----------------------------------------------------------------------------------------------------------


def _features(path: Path) -> list[_Feature]:
    """Every track section of a file, checked."""
    document = _document(path)
    kind = document.get("type") if isinstance(document, dict) else None
    if kind not in {"FeatureCollection", "Feature"}:
        found = f"a {kind}" if isinstance(kind, str) else f"JSON without a GeoJSON type ({type(document).__name__})"
        raise InputError(f"is {found}", file=path, remedy="give a FeatureCollection of LineStrings (RFC 7946)")
    _refuse_other_crs(document, path)
    items = document.get("features") if kind == "FeatureCollection" else [document]
    if not isinstance(items, list) or not items:
        raise InputError("has no features", file=path, remedy="give one LineString a track section")
    features: list[_Feature] = []
    first: dict[str, int] = {}
    for number, item in enumerate(items, 1):
        feature = _feature(path, number, item)
        if feature.track in first:
            raise InputError(
                f"{feature.label} repeats the track of feature {first[feature.track]}",
                file=path,
                remedy="give every section its own track",
            )
        first[feature.track] = number
        features.append(feature)
    return features


def _document(path: Path) -> Any:
    import msgspec

    try:
        if path.is_dir():
            raise InputError("is a folder", file=path, remedy="name a .geojson file")
        size = path.stat().st_size
        if size > MAX_GEOJSON_BYTES:
            raise InputError(
                f"is {size / 1e9:.1f} GB; GeoJSON up to {MAX_GEOJSON_BYTES / 1e9:.1f} GB is read",
                file=path,
                remedy="split the network",
            )
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise InputError("does not exist", file=path, remedy="check the name") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(f"cannot be read ({reason})", file=path) from error
    if not data.strip():
        raise InputError("is empty", file=path, remedy="give a FeatureCollection of LineStrings (RFC 7946)")
    try:
        return msgspec.json.decode(data.removeprefix(b"\xef\xbb\xbf"))
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"is no JSON ({error})", file=path, remedy="write it again; it may be cut short") from error


def _refuse_other_crs(document: dict[str, Any], path: Path) -> None:
    """GeoJSON of 2008 could name another system; RFC 7946 is WGS 84."""
    member = document.get("crs")
    if member is None:
        return
    properties = member.get("properties") if isinstance(member, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    plain = str(name).upper().replace("::", ":").rsplit(":", 2)
    if plain[-1] not in {"CRS84", "4326", "4979", "CRS84H"}:
        raise InputError(
            f"is in {name or 'an unnamed system'}",
            file=path,
            remedy="export it in WGS 84 longitude, latitude (RFC 7946)",
        )


def _feature(path: Path, number: int, item: Any) -> _Feature:
    def refuse(cause: str, remedy: str | None = None) -> InputError:
        track = properties.get("track") if isinstance(properties, dict) else None
        label = f"feature {number}" + (f" (track {str(track)[:60]!r})" if isinstance(track, str) and track else "")
        return InputError(f"{label}: {cause}", file=path, remedy=remedy)

    properties: Any = None
    if not isinstance(item, dict) or item.get("type") != "Feature":
        raise refuse("is no Feature", "give one LineString a track section")
    properties = item.get("properties")
    if not isinstance(properties, dict):
        raise refuse("has no properties", "name the track in the property `track`")
    track = _word(properties.get("track"))
    if not track:
        given = properties.get("track")
        raise refuse(
            "has no property `track`" if given is None else f"property `track` is {str(given)[:40]!r}",
            "give every section a unique text",
        )
    words = {key: _word(properties.get(key)) for key in ("line", "name")}
    for key, word in words.items():
        if word is None:
            raise refuse(f"property `{key}` is no text")
    chainage: dict[str, float | None] = {}
    for key in ("start_km", "end_km"):
        value = properties.get(key)
        if value is not None and not (_is_number(value) and abs(value) < 1e6):
            raise refuse(f"property `{key}` is {str(value)[:40]!r}, not a number of kilometres")
        chainage[key] = None if value is None else float(value) * 1e3
    geometry = item.get("geometry")
    shape = geometry.get("type") if isinstance(geometry, dict) else None
    if not isinstance(geometry, dict) or shape != "LineString":
        remedy = "give each part its own feature and track" if shape == "MultiLineString" else "leave it out"
        raise refuse(f"is a {shape or 'feature without geometry'}, not a LineString", remedy)
    position = _positions(geometry.get("coordinates"), refuse)
    cant = _list(properties.get("cant_mm"), "cant_mm", (len(position),), refuse)
    if cant is not None and (np.abs(cant) > 500.0).any():
        raise refuse(f"`cant_mm` reaches {np.abs(cant).max():g} mm", "give millimetres, left rail high positive")
    covariance = _list(properties.get("covariance_m2"), "covariance_m2", (len(position), 6), refuse)
    posts = properties.get("posts")
    table = None if posts is None else _list(posts, "posts", (len(posts) if isinstance(posts, list) else 0, 2), refuse)
    return _Feature(
        number,
        track,
        words["line"] or "",
        words["name"] or "",
        chainage["start_km"],
        chainage["end_km"],
        position,
        None if cant is None else cant * 1e-3,
        covariance,
        None if table is None else table * [1.0, 1e3],
    )


def _word(value: Any) -> str | None:
    """Text of a property: "" where absent, whole numbers as digits, None for anything else."""
    if value is None:
        return ""
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    return " ".join(value.split()) if isinstance(value, str) else None


def _is_number(value: Any) -> bool:
    """A number that a float can hold: JSON may write whole ones of any size."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -1e300 < value < 1e300


def _list(value: Any, key: str, shape: tuple[int, ...], refuse: Any) -> FloatArray | None:
    """A list of numbers of one shape, or None where absent."""
    if value is None:
        return None
    if not isinstance(value, list):
        raise refuse(f"`{key}` is no list")
    if len(value) != shape[0]:
        raise refuse(f"`{key}` has {len(value)} values for {shape[0]} vertices", "give one value a vertex")
    array = _numbers(value)
    if array is None or array.shape != shape:
        wanted = "numbers" if len(shape) == 1 else f"lists of {shape[1]} numbers"
        raise refuse(f"`{key}` does not hold {shape[0]} {wanted}")
    return array


def _numbers(value: list[Any]) -> FloatArray | None:
    """An array of a list of numbers or of equally long lists of numbers; None of anything else."""
    try:
        array = np.array(value)
    except ValueError:  # ragged
        return None
    return array.astype(np.float64) if array.dtype.kind in "fiu" and np.isfinite(array).all() else None


def _positions(coordinates: Any, refuse: Any) -> FloatArray:
    """Vertices as (n, 3) latitude, longitude (rad), height (m, NaN without)."""
    if not isinstance(coordinates, list) or len(coordinates) < 2:
        count = len(coordinates) if isinstance(coordinates, list) else 0
        raise refuse(f"has {count} {'vertex' if count == 1 else 'vertices'}", "a track needs two")
    array = _numbers(coordinates)
    if array is None or array.ndim != 2 or array.shape[1] not in (2, 3):
        raise refuse(*_bad_vertex(coordinates))
    longitude, latitude = array[:, 0], array[:, 1]
    height = array[:, 2] if array.shape[1] == 3 else np.full(len(array), np.nan)
    outside = ~((np.abs(longitude) <= 180.0) & (np.abs(latitude) <= 90.0))
    if outside.any():
        i = int(np.argmax(outside))
        swapped = abs(latitude[i]) <= 180.0 and abs(longitude[i]) <= 90.0
        raise refuse(
            f"vertex {i + 1} at longitude {longitude[i]:g}, latitude {latitude[i]:g} is outside the Earth's",
            "GeoJSON has longitude first" if swapped else "give WGS 84 degrees, not grid coordinates",
        )
    wild = (height < -1000.0) | (height > 10_000.0)
    if wild.any():
        i = int(np.argmax(wild))
        raise refuse(f"vertex {i + 1} has height {height[i]:g} m", "give metres above the ellipsoid, or no heights")
    return np.column_stack([np.radians(latitude), np.radians(longitude), height])


def _bad_vertex(coordinates: Sequence[Any]) -> tuple[str, str]:
    """The first vertex that is none, and what would work."""
    for i, vertex in enumerate(coordinates, 1):
        if not isinstance(vertex, list) or not all(_is_number(value) for value in vertex) or len(vertex) not in (2, 3):
            return f"vertex {i} is {str(vertex)[:60]}", "give [longitude, latitude] or [longitude, latitude, height]"
        if len(vertex) != len(coordinates[0]):
            return f"vertex {i} has {len(vertex)} coordinates, vertex 1 has {len(coordinates[0])}", (
                "give heights to all vertices of a track or to none"
            )
    return "has coordinates that are no list of positions", "give [longitude, latitude] pairs"


# --- writing ----------------------------------------------------------------------------------------------------------


def _as_feature(model: TrackModel, i: int, step: float, tolerance: float) -> dict[str, Any]:
    begin, end = int(model.knot_start[i]), int(model.knot_start[i + 1])
    pick = begin + _thinned(model, slice(begin, end), step, tolerance)
    has_height = bool(np.isfinite(model.height[begin:end]).all())
    latitude, longitude, height = model.frame.to_geodetic(
        model.easting[pick], model.northing[pick], model.height[pick] if has_height else None
    )
    columns = [np.round(np.degrees(longitude), 9), np.round(np.degrees(latitude), 9)]
    if has_height:
        columns.append(np.round(height, 4))
    properties: dict[str, Any] = {"track": model.track_id[i]}
    if model.line[i]:
        properties["line"] = model.line[i]
    if model.name[i]:
        properties["name"] = model.name[i]
    properties |= _chainage(model, i)
    if model.cant[begin:end].any():
        properties["cant_mm"] = (np.round(model.cant[pick] * 1e3, 3) + 0.0).tolist()
    covariance = model.covariance_g[pick]
    if np.isfinite(covariance).all():
        properties["covariance_m2"] = [[float(f"{value:.6g}") for value in row] for row in covariance.tolist()]
    return {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": np.column_stack(columns).tolist()},
        "properties": properties,
    }


def _chainage(model: TrackModel, i: int) -> dict[str, Any]:
    """The properties that carry a track's chainage."""
    posts = model.mileposts
    a, b = np.searchsorted(posts.track, [i, i + 1])
    if a == b:
        return {}
    offset, chainage = posts.offset[a:b], posts.chainage[a:b]
    ends = np.array([model.offset[model.knot_start[i]], model.offset[model.knot_start[i + 1] - 1]])
    start, finish = model.chainage(np.array([i, i]), ends)
    found: dict[str, Any] = {"start_km": round(float(start) / 1e3, 7), "end_km": round(float(finish) / 1e3, 7)}
    straight = start + (finish - start) * (offset - ends[0]) / (ends[1] - ends[0])
    if (np.abs(chainage - straight) > 1e-3).any():
        inner = (offset > ends[0]) & (offset < ends[1])
        found["posts"] = [
            [round(s, 4), round(c / 1e3, 7)]
            for s, c in zip(offset[inner].tolist(), chainage[inner].tolist(), strict=True)
        ]
    return found


def _thinned(model: TrackModel, own: slice, step: float, tolerance: float) -> NDArray[np.int64]:
    """Knots to keep: evenly spaced ones, and more where the spline through them would leave the others."""
    from scipy.interpolate import CubicSpline

    offset = model.offset[own]
    easting, northing = model.easting[own], model.northing[own]
    has_height = bool(np.isfinite(model.height[own]).all())
    height, cant = model.height[own] if has_height else np.zeros(len(offset)), model.cant[own]
    count = max(2, math.ceil((offset[-1] - offset[0]) / step) + 1)
    keep = np.unique(np.searchsorted(offset, np.linspace(offset[0], offset[-1], count)).clip(0, len(offset) - 1))
    across = np.column_stack([np.cos(model.grid_bearing[own]), -np.sin(model.grid_bearing[own])])
    while len(keep) < len(offset):
        vertices = np.column_stack([easting[keep], northing[keep], height[keep]])
        p = np.append(0.0, np.cumsum(np.hypot(np.diff(vertices[:, 0]), np.diff(vertices[:, 1]))))
        at = np.interp(offset, offset[keep], p)  # a little off along the track, where the curve is the same
        curve = CubicSpline(p, vertices)(at)
        error = np.abs((curve[:, 0] - easting) * across[:, 0] + (curve[:, 1] - northing) * across[:, 1])
        error = np.maximum(error, np.abs(curve[:, 2] - height))
        error = np.maximum(error, 0.2 * np.abs(np.interp(offset, offset[keep], cant[keep]) - cant))
        wrong = np.flatnonzero(error > tolerance)
        if not len(wrong):
            break
        gap = np.unique(np.searchsorted(keep, wrong, side="right") - 1).clip(0, len(keep) - 2)
        middle = (keep[gap] + keep[gap + 1]) // 2
        more = np.unique(np.concatenate([keep, middle]))
        if len(more) == len(keep):
            break
        keep = more
    return keep
