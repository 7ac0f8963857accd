"""A model as a table of elements: what `railnav.io.elements` reads, written as CSV or Parquet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railnav.io.atomic import atomic_path
from railnav.io.designed import DesignedAlignment, designed_tracks
from railnav.io.designs import profile_of_points
from railnav.io.tables import Words, write_table
from railnav.track.elements import ARC, STRAIGHT, Plan, curvature, integrate
from railnav.track.model import TrackModel
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]

#: The last element is this short, since a reader takes its gradient as constant, m.
_LAST = 1.0
_DECIMALS = {
    "sequence": 0,
    "start_m": 4,
    "length_m": 7,
    "radius_start_m": 7,
    "radius_end_m": 7,
    "easting_m": 7,
    "northing_m": 7,
    "grid_bearing_deg": 11,
    "height_m": 5,
    "gradient": 9,
    "cant_start_mm": 3,
    "cant_end_mm": 3,
}


def write_elements(model: TrackModel, path: str | Path, *, tolerance: float = 2e-4) -> None:
    """Write a model as a table of elements, .csv or .parquet, whole or not at all.

    Parameters
    ----------
    model : TrackModel
        What to write; its tracks are laid into straights, arcs and clothoids first, and these are cut where the profile or the
        cant bends, so that a row is all of one element.
    path : path
        File to write; replaced in one step if it exists.
    tolerance : float
        Greatest distance of the elements from the model's knots, m.

    Notes
    -----
    The table does not name its plane (give `--crs` when it is read); nodes, movements, covariance and posts between elements have no
    place in it. Tracks without chainage count from 0.

    Examples
    --------
    >>> import tempfile
    >>> from railnav import demo_line
    >>> from railnav.io.elements import read_elements
    >>> model = demo_line()
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_elements(model, f"{folder}/line.csv")
    ...     again = read_elements(f"{folder}/line.csv", crs=model.frame.crs_wkt)
    >>> bool(np.abs(again.lengths - model.lengths).max() < 2e-3)
    True
    """
    columns: dict[str, list[FloatArray]] = {}
    words: dict[str, list[str]] = {"track": [], "element": [], "line": [], "name": []}
    for i, track in enumerate(designed_tracks(model, tolerance=tolerance)):
        rows = _rows(model, i, track)
        count = len(rows["length_m"])
        for name, values in rows.items():
            columns.setdefault(name, []).append(values)
        words["track"] += [track.name] * count
        words["line"] += [track.line] * count
        words["name"] += [track.description] * count
        words["element"] += [
            "straight" if k == STRAIGHT else "arc" if k == ARC else "clothoid"
            for k in rows["kind"].astype(int).tolist()
        ]
    kept = {name: np.concatenate(values) for name, values in columns.items() if name != "kind"}
    table: dict[str, FloatArray | Words] = {
        "track": Words.of(words["track"]),
        "sequence": kept["sequence"],
        "start_m": kept["start_m"],
        "length_m": kept["length_m"],
        "element": Words.of(words["element"]),
    }
    table |= {
        name: kept[name] for name in ("radius_start_m", "radius_end_m", "easting_m", "northing_m", "grid_bearing_deg")
    }
    if np.isfinite(kept["height_m"]).any():
        table |= {name: kept[name] for name in ("height_m", "gradient")}
    if kept["cant_start_mm"].any() or kept["cant_end_mm"].any():
        table |= {name: kept[name] for name in ("cant_start_mm", "cant_end_mm")}
    table |= {name: Words.of(words[name]) for name in ("line", "name") if any(words[name])}
    path = Path(path)
    with atomic_path(path) as draft:
        write_table(draft, table, decimals=_DECIMALS)


def _rows(model: TrackModel, i: int, track: DesignedAlignment) -> dict[str, FloatArray]:
    """Columns of one track: its elements, cut where the profile and the cant bend."""
    plan = track.plan
    total = float(plan.edges[-1])
    v = track.vertical
    profile = None if v is None else profile_of_points(v.along, v.height, v.curve_length, v.radius)
    marks = [plan.edges]
    if profile is not None:
        marks += [profile.begin[np.isfinite(profile.begin)], np.array([max(total - _LAST, 0.5 * total)])]
    if track.cant is not None:
        marks.append(track.cant.edges)
    edges = np.unique(np.clip(np.concatenate(marks), 0.0, total))
    keep = np.append(True, np.diff(edges) > 1e-3)
    joints = np.min(np.abs(edges[:, None] - plan.edges[None, :]), axis=1) < 1e-12
    edges = edges[keep | joints]
    wide = np.append(np.diff(edges) > 1e-4, True)
    edges = edges[wide]
    edges[0] = 0.0
    at, bearing = integrate(plan, edges[:-1])
    owner = np.clip(np.searchsorted(plan.edges, 0.5 * (edges[1:] + edges[:-1])) - 1, 0, len(plan.length) - 1)
    starts = (
        np.abs(edges[:-1] - plan.edges[owner]) < 1e-9
    )  # an element begins where it says, not where the last one ends
    at[starts] = np.column_stack([plan.easting, plan.northing])[owner[starts]]
    bearing[starts] = plan.grid_bearing[owner[starts]]
    share0 = np.clip((edges[:-1] - plan.edges[owner]) / plan.length[owner], 0.0, 1.0)
    share1 = np.clip((edges[1:] - plan.edges[owner]) / plan.length[owner], 0.0, 1.0)
    k0, k1 = curvature(plan, owner, share0), curvature(plan, owner, share1)
    own = model.knots(track.name)
    along = np.interp(edges, _run(model, own, plan), model.offset[own])
    chainage = model.chainage(np.full(len(edges), i), along)
    if np.isnan(chainage).any():
        chainage = edges
    scale = np.interp(along, model.offset[own], model.scale[own])
    nothing = np.full(len(edges), np.nan)
    height = nothing if profile is None else profile(edges, 0)
    gradient = nothing if profile is None else profile(edges, 1) * scale
    inside = np.array([1e-9, -1e-9])
    cant0, cant1 = np.zeros(len(edges) - 1), np.zeros(len(edges) - 1)
    if track.cant is not None:
        cant0, cant1 = track.cant.at(edges[:-1] + inside[0]), track.cant.at(edges[1:] + inside[1])
    with np.errstate(divide="ignore"):
        radius0, radius1 = (np.where(k == 0.0, np.nan, 1.0 / k) for k in (k0, k1))
    return {
        "kind": plan.kind[owner].astype(np.float64),
        "sequence": np.arange(1.0, len(edges)),
        "start_m": chainage[:-1],
        "length_m": np.diff(edges),
        "radius_start_m": radius0,
        "radius_end_m": radius1,
        "easting_m": at[:, 0],
        "northing_m": at[:, 1],
        "grid_bearing_deg": np.degrees(wrap_angle(bearing)),
        "height_m": height[:-1],
        "gradient": gradient[:-1],
        "cant_start_mm": cant0 * 1e3,
        "cant_end_mm": cant1 * 1e3,
    }


def _run(model: TrackModel, own: slice, plan: Plan) -> FloatArray:
    """Grid lengths of a track's knots, brought to the plan's whole length."""
    step = np.hypot(np.diff(model.easting[own]), np.diff(model.northing[own]))
    half = 0.5 * np.diff(np.unwrap(model.grid_bearing[own]))
    run = np.append(0.0, np.cumsum(step / np.sinc(half / np.pi)))
    return np.asarray(run * (float(plan.edges[-1]) / run[-1]))
