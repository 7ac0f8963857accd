"""Ways to navigate a run beside the track-bound filter: inertial schemes without a map, and a fixed-gain corrector that holds to one."""

from __future__ import annotations

from railnav.navigation.schemes.inertial import INERTIAL_SCHEMES, navigate_inertial

#: Names that `railnav navigate --scheme` knows.
SCHEMES = ("track", *INERTIAL_SCHEMES, "map-corrector")

__all__ = ["INERTIAL_SCHEMES", "SCHEMES", "navigate_inertial"]
