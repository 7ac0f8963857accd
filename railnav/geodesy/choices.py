"""The published transformations of one plane, side by side: what each puts where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from railnav.errors import CrsError
from railnav.geodesy.datums import find_datum
from railnav.geodesy.grid import choose_frame, read_plane
from railnav.geodesy.plane import GridFrame
from railnav.geodesy.transformation import Extent, usable_operations


@dataclass(frozen=True, slots=True)
class Choice:
    """One published transformation: what pins it as `operation`, the plane with it, and its distance from the first, m."""

    pin: str
    frame: GridFrame
    apart: float


def transformation_choices(latitude: ArrayLike, longitude: ArrayLike, *, crs: Any) -> list[Choice]:
    """Every transformation to a plane that may be pinned at a place, most accurate first.

    Parameters
    ----------
    latitude, longitude : float or array
        Where, WGS 84, rad.
    crs : str or pyproj.CRS
        The plane.

    Returns
    -------
    list of Choice
        At least one.

    Raises
    ------
    CrsError
        None may be pinned, or the plane does not serve there.

    Examples
    --------
    >>> found = transformation_choices(np.radians(55.75), np.radians(37.6), crs="EPSG:28407")
    >>> found[0].frame.operation.split(" + ")[0], max(c.apart for c in found) > 5.0
    ('Inverse of Pulkovo 1942 to WGS 84 (20)', True)
    """
    from pyproj import CRS

    name = f"EPSG:{crs}" if isinstance(crs, str) and crs.strip().isdigit() else crs
    system, extent = read_plane(name), Extent.of(latitude, longitude)
    first = choose_frame(latitude, longitude, crs=name)
    frames = {first.operation: ("", first)}
    for _, operation, _ in sorted(usable_operations(CRS.from_epsg(4979), system, extent)[0], key=lambda u: u[2]):
        plain = operation.split(" + ")[0].removeprefix("Inverse of ")
        if operation not in frames:
            frames[operation] = (plain, choose_frame(latitude, longitude, crs=name, operation=plain))
    if not system.is_bound and find_datum(system) is not None:
        try:
            table = choose_frame(latitude, longitude, crs=name, operation="table")
            frames.setdefault(table.operation, ("table", table))
        except CrsError:
            pass  # the table's chain does not lead to this plane: it is no choice
    at = [
        np.stack(frame.to_grid(extent.latitude * np.pi / 180, extent.longitude * np.pi / 180, 0.0))
        for _, frame in frames.values()
    ]
    return [
        Choice(pin, frame, float(np.linalg.norm(x - at[0])))
        for (pin, frame), x in zip(frames.values(), at, strict=True)
    ]
