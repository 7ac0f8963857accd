"""The Earth and its planes: ellipsoids, normal gravity, projected coordinate systems and the transformations to them.

Geodetic coordinates are latitude, longitude (rad) and ellipsoidal height (m); grid coordinates g are easting, northing,
height (m), in this order whatever the axis order a registry states. `convergence` is the true azimuth of grid north:
heading = grid_bearing + convergence. No time, no train.
"""

from __future__ import annotations

from railnav.geodesy.ellipsoid import (
    BESSEL,
    ELLIPSOIDS,
    GRS80,
    GSK2011,
    KRASSOWSKY,
    PZ90,
    WGS84,
    Ellipsoid,
)
from railnav.geodesy.grid import GridFrame, choose_frame, frame_for_grid
from railnav.geodesy.transformation import GeodeticFrame, geodetic_frame

__all__ = [
    "BESSEL",
    "ELLIPSOIDS",
    "GRS80",
    "GSK2011",
    "KRASSOWSKY",
    "PZ90",
    "WGS84",
    "Ellipsoid",
    "GeodeticFrame",
    "GridFrame",
    "choose_frame",
    "frame_for_grid",
    "geodetic_frame",
]
