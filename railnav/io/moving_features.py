"""Solutions as OGC Moving Features JSON: one feature, its position in time and what it measured on the way.

Stretches without a position part the trajectory into prisms: nothing is drawn across them.
"""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError
from railnav.io.atomic import atomic_path
from railnav.navigation.solution import Mode, Solution

#: Measures of a solution: name, column, unit as UN/CEFACT Recommendation 20 codes it, decimals.
_MEASURES = (
    ("speed", "speed", "MTS", 4),
    ("offset", "offset", "MTR", 4),
    ("sigma_along", "sigma_along", "MTR", 4),
    ("protection_level_along", "protection_level_along", "MTR", 4),
    ("track_probability", "track_probability", "C62", 6),
)


def write_moving_features(solution: Solution, path: str | Path) -> None:
    """Write a solution as Moving Features JSON, whole or not at all.

    Parameters
    ----------
    solution : Solution
        What to write; needs its start.
    path : path
        File to write; replaced in one step if it exists.

    Raises
    ------
    InputError
        The solution does not say when it starts (a CSV file does not), or has no row with a position.

    References
    ----------
    OGC 19-045r3, Moving Features Encoding Extension - JSON: MF-JSON Trajectory, clauses 6 and 7.

    Examples
    --------
    >>> from railnav.io.solution import read_solution
    >>> write_moving_features(read_solution("nowhere.csv"), "train.mfjson")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.csv: does not exist; check the name
    """
    import msgspec

    if not solution.start:
        raise InputError(
            "the solution does not say when it starts", file=path, remedy="convert it from .parquet, .gpkg or .geojson"
        )
    placed = np.isfinite(solution.latitude) & np.isfinite(solution.longitude)
    if not placed.any():
        raise InputError("the solution has no row with a position", file=path)
    document = _feature(solution, placed, datetime.fromisoformat(solution.start))
    with atomic_path(path) as draft:
        draft.write_bytes(msgspec.json.encode(document) + b"\n")


def _feature(solution: Solution, placed: NDArray[np.bool_], start: datetime) -> dict[str, Any]:
    rows = np.flatnonzero(placed)
    parts = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    has_height = bool(np.isfinite(solution.ellipsoidal_height[rows]).all())
    columns = [np.round(np.degrees(solution.longitude), 9), np.round(np.degrees(solution.latitude), 9)]
    if has_height:
        columns.append(np.round(solution.ellipsoidal_height, 3))
    place = np.column_stack(columns)

    def instants(which: NDArray[np.int64]) -> list[str]:
        return [
            (start + timedelta(seconds=s)).isoformat(timespec="milliseconds").replace("+00:00", "Z")
            for s in solution.time[which].tolist()
        ]

    prisms = [
        {
            "type": "MovingPoint",
            "datetimes": instants(part),
            "coordinates": place[part].tolist(),
            "interpolation": "Linear",
        }
        for part in parts
    ]
    moving = prisms[0] if len(prisms) == 1 else {"type": "MovingGeometryCollection", "prisms": prisms}
    when = instants(rows)
    measured: dict[str, Any] = {"datetimes": when}
    for name, column, unit, decimals in _MEASURES:
        values = np.round(getattr(solution, column)[rows], decimals)
        if np.isfinite(values).all():
            measured[name] = {"type": "Measure", "form": unit, "values": values.tolist(), "interpolation": "Linear"}
    texts = {
        "track": [solution.track_id[t] if t >= 0 else "" for t in solution.track[rows].tolist()],
        "mode": [Mode(m).label for m in solution.mode[rows].tolist()],
    }
    for name, words in texts.items():
        measured[name] = {"type": "Text", "values": words, "interpolation": "Step"}
    height = "h" if has_height else ""
    return {
        "type": "Feature",
        "id": solution.run_id or "train",
        "crs": {
            "type": "Name",
            "properties": {"name": f"urn:ogc:def:crs:OGC:{'0' if has_height else '1.3'}:CRS84{height}"},
        },
        "trs": {
            "type": "Link",
            "properties": {"type": "OGCDEF", "href": "http://www.opengis.net/def/uom/ISO-8601/0/Gregorian"},
        },
        "time": [when[0], when[-1]],
        "bbox": [*place[rows].min(axis=0).tolist(), *place[rows].max(axis=0).tolist()],
        "temporalGeometry": moving,
        "temporalProperties": [measured],
        "properties": {
            "run": solution.run_id,
            "integrity_risk": float(solution.integrity_risk),
            "smoothed": bool(solution.smoothed),
        },
    }
