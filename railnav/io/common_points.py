"""Tables of points: known in WGS 84, and in a local plane as well."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError
from railnav.io.atomic import atomic_path
from railnav.io.tables import Column, Table, Words, freeze, read_table, write_table

FloatArray = NDArray[np.float64]

_POINT = Column("point", required=False, complete=False, text=True)
_GEODETIC = (
    Column("latitude_deg", low=-90.0, high=90.0),
    Column("longitude_deg", low=-360.0, high=360.0),
    Column("height_m", low=-12e3, high=1e5),
)
_LOCAL = (
    Column("easting_m"),
    Column("northing_m"),
    Column("local_height_m", required=False, complete=False, low=-12e3, high=1e5),
)


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points by name: latitude, longitude (rad), ellipsoidal height (m), arrays (n,)."""

    names: tuple[str, ...]
    latitude: FloatArray
    longitude: FloatArray
    height: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CommonPoints(Points):
    """Points known in a local plane, too: easting, northing, height (NaN where unknown), m, arrays (n,)."""

    easting: FloatArray
    northing: FloatArray
    local_height: FloatArray


def read_points(path: str | Path) -> Points:
    """Read a table of points.

    Parameters
    ----------
    path : path
        .csv or .parquet: latitude_deg, longitude_deg, height_m and, where points have names, point.

    Returns
    -------
    Points

    Raises
    ------
    InputError
        A missing file or column, an empty cell, or two points of one name.
    """
    table = read_table(path, [_POINT, *_GEODETIC])
    return Points(*_geodetic(table, Path(path)))


def read_common_points(path: str | Path) -> CommonPoints:
    """Read points known in WGS 84 and in a local plane.

    Parameters
    ----------
    path : path
        .csv or .parquet: the columns of `read_points` and easting_m, northing_m, local_height_m (optional, may be empty).

    Returns
    -------
    CommonPoints

    Raises
    ------
    InputError
        As for `read_points`.
    """
    table = read_table(path, [_POINT, *_GEODETIC, *_LOCAL])
    names, latitude, longitude, height = _geodetic(table, Path(path))
    missing = np.full(len(latitude), np.nan)
    local = table.number.get("local_height_m", missing)
    return CommonPoints(
        names, latitude, longitude, height, table.number["easting_m"], table.number["northing_m"], local
    )


def read_course(path: str | Path) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Read the places of a line in order.

    Parameters
    ----------
    path : path
        .csv or .parquet: latitude_deg, longitude_deg and, where known, height_m.

    Returns
    -------
    latitude, longitude, height : (n,) array
        rad, rad, m (NaN where unknown).

    Raises
    ------
    InputError
        A missing file or column, or an empty cell where a place is needed.
    """
    table = read_table(path, [*_GEODETIC[:2], replace(_GEODETIC[2], required=False, complete=False)])
    latitude, longitude = (freeze(np.radians(table.number[key])) for key in ("latitude_deg", "longitude_deg"))
    return latitude, longitude, table.number.get("height_m", np.full(len(latitude), np.nan))


def write_points(
    path: str | Path, names: tuple[str, ...], latitude: FloatArray, longitude: FloatArray, height: FloatArray
) -> None:
    """Write points, whole or not at all: rad, rad, m; to 1e-9 degrees and 0.1 mm."""
    words = Words(np.arange(len(names)), names)
    columns: dict[str, FloatArray | Words] = {
        "point": words,
        "latitude_deg": np.degrees(latitude),
        "longitude_deg": np.degrees(longitude),
        "height_m": np.asarray(height, np.float64),
    }
    with atomic_path(path) as draft:
        write_table(draft, columns, decimals={"latitude_deg": 10, "longitude_deg": 10, "height_m": 4})


def _geodetic(table: Table, path: Path) -> tuple[tuple[str, ...], FloatArray, FloatArray, FloatArray]:
    count = len(table.number["latitude_deg"])
    words = table.words.get("point")
    names = [str(i) for i in range(1, count + 1)]
    if words is not None:
        names = [words.word[code] if code >= 0 else names[i] for i, code in enumerate(words.code.tolist())]
    seen: set[str] = set()
    for i, name in enumerate(names):
        if name in seen:
            raise InputError(f"point {name!r} stands twice", file=path, row=table.row_of(i), column="point")
        seen.add(name)
    latitude, longitude = (freeze(np.radians(table.number[key])) for key in ("latitude_deg", "longitude_deg"))
    return tuple(names), latitude, longitude, table.number["height_m"]
