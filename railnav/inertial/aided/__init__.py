"""Aided strapdown: what aids it (`aiding`) and the square-root error filter and smoother that take it in (`integration`)."""

from __future__ import annotations

from railnav.inertial.aided.aiding import Fixes, Ranges, Rests, VehicleMotion, find_rests, without_lever_arm
from railnav.inertial.aided.integration import AidedSolution, integrate
from railnav.inertial.aided.unknowns import Unknowns, Vehicle

__all__ = [
    "AidedSolution",
    "Fixes",
    "Ranges",
    "Rests",
    "Unknowns",
    "Vehicle",
    "VehicleMotion",
    "find_rests",
    "integrate",
    "without_lever_arm",
]
