"""How vehicles move: odometry of wheels and steering, and the increments in space of a survey vehicle.

Headings clockwise from north, so that a plane position is (north, east) and a turn to the right is positive.
"""

from __future__ import annotations

from railnav.vehicle.increments import SpaceIncrements, rail_to_axis, space_increments
from railnav.vehicle.odometry import (
    PlanarMotion,
    WheelScale,
    dead_reckon,
    fit_wheel_scale,
    minimum_radius,
    ticks_to_distance,
    tricycle,
    two_wheels,
)

__all__ = [
    "PlanarMotion",
    "SpaceIncrements",
    "WheelScale",
    "dead_reckon",
    "fit_wheel_scale",
    "minimum_radius",
    "rail_to_axis",
    "space_increments",
    "ticks_to_distance",
    "tricycle",
    "two_wheels",
]
