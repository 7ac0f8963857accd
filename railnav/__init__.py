"""railnav: reference track models from survey runs, and trains held to them.

The conventions, said once
--------------------------
*Units.* A bare name is SI and radians, float64; anything else spells its unit (`latitude_deg`, `speed_kmh`, `cant_mm`) and lives in
`railnav.io`, `railnav.cli` or `railnav.web`.

*Frames.* i inertial, e Earth-fixed, n local north-east-down, b body (forward, right, down), g grid (easting, northing, height), t track
(along, right, down). A vector's last letter is the frame it is resolved in (`lever_arm_b`); a matrix reads `v_n = C_nb @ v_b`.

*Directions.* `heading` is clockwise from true north, `grid_bearing` clockwise from grid north; heading = grid_bearing + convergence.

*Track.* `offset` is true 3-D arc length on the ground from a track's start; `chainage` is the published reference of its line and may
jump. Curvature is positive to the right, gradient positive uphill, cant positive with the left rail high, all as offset grows.
A position is (track, offset, running direction); reversing changes the direction and is never an edge of the graph.

*Estimates.* innovation = measured - predicted; square roots `P_sqrt` are lower triangular with a positive diagonal; the posterior of all
hypotheses sums to 1; `protection_level_along` bounds the along-track error at a stated `integrity_risk`.

*Results* are new, frozen values; options stand after `*`. Errors descend from `RailnavError` and say what, where and what would work.

Examples
--------
>>> import railnav as rn
>>> model = rn.demo_line()
>>> model.at(model.track_id[0], 100.0).curvature.shape
()
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from railnav.errors import RailnavError
    from railnav.evaluation import evaluate
    from railnav.io.geojson import read_geojson
    from railnav.io.network import read_network
    from railnav.io.solution import read_solution
    from railnav.io.truth import read_truth
    from railnav.navigation import Mode, Navigator, Solution, navigate
    from railnav.run import Run
    from railnav.simulation import demo_line, simulate
    from railnav.survey import build, update
    from railnav.survey.difference import difference
    from railnav.track import TrackModel, validate
    from railnav.truth import Truth

__version__ = "0.1.0"

#: Where each public name lives; a room is imported when one of its names is first used, so that `railnav --help` stays quick.
_HOME = {
    "Mode": "railnav.navigation",
    "Navigator": "railnav.navigation",
    "RailnavError": "railnav.errors",
    "Run": "railnav.run",
    "Solution": "railnav.navigation",
    "TrackModel": "railnav.track",
    "Truth": "railnav.truth",
    "build": "railnav.survey",
    "demo_line": "railnav.simulation",
    "difference": "railnav.survey",
    "evaluate": "railnav.evaluation",
    "navigate": "railnav.navigation",
    "read_geojson": "railnav.io.geojson",
    "read_network": "railnav.io.network",
    "read_solution": "railnav.io.solution",
    "read_truth": "railnav.io.truth",
    "simulate": "railnav.simulation",
    "update": "railnav.survey",
    "validate": "railnav.track",
}

__all__ = [
    "Mode",
    "Navigator",
    "RailnavError",
    "Run",
    "Solution",
    "TrackModel",
    "Truth",
    "build",
    "demo_line",
    "difference",
    "evaluate",
    "navigate",
    "read_geojson",
    "read_network",
    "read_solution",
    "read_truth",
    "simulate",
    "update",
    "validate",
]


def __getattr__(name: str) -> Any:
    """Import a public name from its room on first use (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module 'railnav' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
