"""Simulated recording cars over a part of the bundled line, made once for the tests of monitoring."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache

from railnav.monitoring.design import Design, design_of_elements
from railnav.navigation import navigate
from railnav.run import Run
from railnav.simulation import Leg, demo_line
from railnav.simulation.irregularities import GEOMETRY, Defect, Irregularities, irregular, simulate_geometry
from railnav.track.model import TrackModel

TRACK = "77R-03"
FIRST, LAST = 300.0, 3300.0
#: What the simulated track has: kind, offset, size, length.
DEFECTS = (
    Defect("longitudinal_level", TRACK, 900.0, -0.018, 8.0),
    Defect("gauge", TRACK, 1300.0, 0.022, 5.0),
    Defect("alignment", TRACK, 1700.0, 0.015, 9.0),
    Defect("cross_level", TRACK, 2100.0, 0.030, 5.0),
)


@cache
def line() -> TrackModel:
    return demo_line(spacing=5.0)


@cache
def fields(growing: float = 0.0) -> Irregularities:
    """Irregular track; `growing` scales longitudinal level up between 2,300 and 2,600 m."""
    made = irregular(line(), seed=5, defects=DEFECTS)
    if growing:
        a = int(made.start[line().track_index(TRACK)])
        made.fields[a + round(2300 / 0.25) : a + round(2600 / 0.25), 1] *= 1.0 + growing
    return made


@cache
def recorded(seed: int, *, month: int = 1, growing: float = 0.0, backwards: bool = False) -> Run:
    """A recording car over 3 km, simulated."""
    ends = (LAST, FIRST) if backwards else (FIRST, LAST)
    run, _ = simulate_geometry(
        line(),
        Leg((TRACK,), start=ends[0], finish=ends[1]),
        fields(growing),
        seed=seed,
        outfit=replace(GEOMETRY, gauge=replace(GEOMETRY.gauge, interval=0.006)),
        tunnels=False,
        run_id=f"car-{seed}",
        start=datetime(2026, month, 5, 8, tzinfo=UTC),
    )
    return run


@cache
def solved(seed: int, **options):
    return navigate(recorded(seed, **options), line(), smooth=True)


def design_of(model: TrackModel, shift: float = 0.0, length: float = 1000.0) -> Design:
    """A design that starts as the track does, straight, and a shift to its right."""
    point = model.at(TRACK, 0.0)
    bearing = float(point.grid_bearing)
    return design_of_elements(
        "design",
        ["straight"],
        [length],
        [0.0],
        easting=float(point.easting) + shift * math.cos(bearing),
        northing=float(point.northing) - shift * math.sin(bearing),
        grid_bearing=bearing,
        crs=model.frame.crs_wkt,
    )
