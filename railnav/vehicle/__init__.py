"""How vehicles move: odometry of wheels and steering.

Headings clockwise from north, so that a plane position is (north, east) and a turn to the right is positive.
"""

from __future__ import annotations

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
    "WheelScale",
    "dead_reckon",
    "fit_wheel_scale",
    "minimum_radius",
    "ticks_to_distance",
    "tricycle",
    "two_wheels",
]
