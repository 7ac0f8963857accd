"""Lining plans as tables, and tables of fixed points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError, TrackError
from railnav.io.addresses import addresses
from railnav.io.atomic import atomic_path
from railnav.io.tables import Column, Words, read_table, write_table
from railnav.monitoring.lining import LiningPlan
from railnav.monitoring.section import Section
from railnav.monitoring.smoothing import FixedPoint

FloatArray = NDArray[np.float64]

_FIXED = (
    Column("track", text=True),
    Column("offset_m", low=-1.0, high=1e7),
    Column("to_offset_m", required=False, complete=False, low=-1.0, high=1e7),
    Column("slew_mm", required=False, complete=False, low=-1000.0, high=1000.0),
    Column("slew_tolerance_mm", required=False, complete=False, low=0.0, high=1000.0),
    Column("lift_mm", required=False, complete=False, low=-1000.0, high=1000.0),
    Column("lift_tolerance_mm", required=False, complete=False, low=0.0, high=1000.0),
    Column("name", text=True, required=False, complete=False),
)


def read_fixed_points(path: str | Path, section: Section) -> tuple[tuple[FixedPoint, ...], tuple[FixedPoint, ...]]:
    """Read fixed points of a section.

    Parameters
    ----------
    path : path
        CSV or Parquet: `track, offset_m` (growing to `to_offset_m` for a stretch), `slew_mm` with `slew_tolerance_mm`, `lift_mm` with
        `lift_tolerance_mm` (empty: 0), `name`. A row without slew and tolerance of slew fixes no slew, and likewise for the lift; a row
        with neither holds both at zero. Slews are to the right as the track's offset grows.
    section : Section

    Returns
    -------
    slews, lifts : tuple of FixedPoint

    Raises
    ------
    InputError
        A row off the section, or malformed.
    """
    table = read_table(path, _FIXED)
    words = table.words["track"].each()
    names = table.words["name"].each() if "name" in table.words else [""] * len(words)
    count = len(words)

    def numbers(column: str) -> FloatArray:
        return table.number.get(column, np.full(count, np.nan))

    to, slew, slew_by = numbers("to_offset_m"), numbers("slew_mm"), numbers("slew_tolerance_mm")
    lift, lift_by = numbers("lift_mm"), numbers("lift_tolerance_mm")
    slews: list[FixedPoint] = []
    lifts: list[FixedPoint] = []
    for i, track in enumerate(words):
        first = float(table.number["offset_m"][i])
        last = float(to[i]) if np.isfinite(to[i]) else first
        try:
            which = section.model.track_index(track)
        except TrackError as error:
            raise InputError(str(error), file=path, row=i + 2, column="track") from error
        place = section.project([which, which], [first, last])
        if not np.isfinite(place).all():
            raise InputError(
                f"{track!r} at {first:g} m does not lie on section {section.name}",
                file=path,
                row=i + 2,
                column="offset_m",
                remedy="remove the row",
            )
        sense = int(section.direction[int(np.flatnonzero(section.track == which)[0])])
        name = names[i] or f"{track} {first:g} m"
        start, finish = float(place.min()), float(place.max())
        neither = not np.isfinite([slew[i], slew_by[i], lift[i], lift_by[i]]).any()
        if neither or np.isfinite([slew[i], slew_by[i]]).any():
            slews.append(FixedPoint(name, start, finish, sense * _mm(slew[i]), _mm(slew_by[i])))
        if neither or np.isfinite([lift[i], lift_by[i]]).any():
            lifts.append(FixedPoint(name, start, finish, _mm(lift[i]), _mm(lift_by[i])))
    return tuple(slews), tuple(lifts)


def _mm(value: float) -> float:
    return 1e-3 * float(value) if np.isfinite(value) else 0.0


def write_plan(plan: LiningPlan, path: str | Path) -> None:
    """Write a lining plan, one row a node.

    Columns: `distance_m, track, offset_m, chainage_km, address` (published, where the model has line references: kilometres that jump leave
    `chainage_km` ambiguous), `station_m, easting_m, northing_m, height_m, slew_mm, lift_mm` (to the right as
    the distance grows, and up), `right_before_mm, right_after_mm, up_before_mm, up_after_mm, versine_before_mm, versine_after_mm,
    slew_versine_mm, sigma_slew_mm, sigma_lift_mm`.

    Parameters
    ----------
    plan : LiningPlan
    path : path
        .csv or .parquet; replaced whole or not at all.
    """
    track, offset = plan.section.locate(plan.distance)
    where = addresses(plan.section.model, np.asarray(track, np.int64), offset)
    n = len(plan.distance)
    classic = np.full(n, np.nan)
    if len(plan.hallade_distance):
        inside = (plan.distance >= plan.hallade_distance[0]) & (plan.distance <= plan.hallade_distance[-1])
        classic[inside] = np.interp(plan.distance[inside], plan.hallade_distance, plan.hallade_slew)
    table: dict[str, FloatArray | Words] = {
        "distance_m": plan.distance,
        "track": Words(np.asarray(track, np.int64), plan.section.model.track_id),
        "offset_m": offset,
        "chainage_km": plan.section.at(plan.distance).chainage / 1e3,
        **({} if where is None else {"address": where}),
        "station_m": plan.station,
        "easting_m": plan.easting,
        "northing_m": plan.northing,
        "height_m": plan.height,
        "slew_mm": 1e3 * plan.slew,
        "lift_mm": 1e3 * plan.lift,
        "right_before_mm": 1e3 * plan.right_before,
        "right_after_mm": 1e3 * plan.right_after,
        "up_before_mm": 1e3 * plan.up_before,
        "up_after_mm": 1e3 * plan.up_after,
        "versine_before_mm": 1e3 * plan.versine_before,
        "versine_after_mm": 1e3 * plan.versine_after,
        "slew_versine_mm": 1e3 * classic,
        "sigma_slew_mm": 1e3 * plan.sigma_slew,
        "sigma_lift_mm": 1e3 * plan.sigma_lift,
    }
    decimals = {name: 2 if name.endswith("_mm") else 4 for name in table} | {"chainage_km": 6}
    with atomic_path(path) as draft:
        write_table(draft, table, decimals=decimals)
