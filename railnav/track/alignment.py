"""Track alignment: a C2 curve through surveyed or designed points, tabulated by true arc length on the ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError

if TYPE_CHECKING:
    from railnav.geodesy.grid import GridFrame

FloatArray = NDArray[np.float64]

#: Vertices closer than this are one, m.
SAME_VERTEX = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class KnotTable:
    """One track by true offset: (k,) arrays, m, rad, 1/m; signs as offset grows (see `railnav.track.model`).

    Attributes
    ----------
    offset : (k,) array
        True 3-D ground arc length from 0, strictly increasing, m.
    easting, northing, height : (k,) array
        Grid position, m; height NaN where unknown.
    grid_bearing : (k,) array
        Clockwise from grid north, rad.
    curvature : (k,) array
        d(grid_bearing)/d(offset), positive to the right, 1/m.
    gradient : (k,) array
        Rise over horizontal ground run, positive uphill.
    cant : (k,) array
        Positive with the left rail high, m.
    scale : (k,) array
        Grid metres per horizontal ground metre.
    covariance_g : (k, 6) array
        Packed (EE, EN, EU, NN, NU, UU), m^2; NaN where unknown.
    """

    offset: FloatArray
    easting: FloatArray
    northing: FloatArray
    height: FloatArray
    grid_bearing: FloatArray
    curvature: FloatArray
    gradient: FloatArray
    cant: FloatArray
    scale: FloatArray
    covariance_g: FloatArray


def fit_alignment(
    frame: GridFrame,
    easting: ArrayLike,
    northing: ArrayLike,
    height: ArrayLike | None = None,
    *,
    cant: ArrayLike | None = None,
    covariance_g: ArrayLike | None = None,
    spacing: float = 1.0,
) -> KnotTable:
    """Lay a C2 curve through vertices and tabulate it by true ground arc length.

    Position is a cubic spline over chord length; offset is the integral of sqrt((dl / scale)^2 + dh^2) with
    scale = k / (1 + h / R) (Gauss-Legendre, five points an interval), bearing, curvature and gradient are the spline's own
    derivatives, never chord differences.

    Parameters
    ----------
    frame : GridFrame
        Plane of the vertices.
    easting, northing : (n,) array
        Vertices in order, m; n >= 2. Consecutive vertices closer than 1 mm count once.
    height : (n,) array, optional
        Ellipsoidal heights, m. Missing, or with any NaN: the track has no heights, and lengths are horizontal at height 0.
    cant : (n,) array, optional
        Cant at the vertices, m, positive with the left rail high; linear between them. Default 0.
    covariance_g : (n, 6) array, optional
        Packed covariance of the vertices, m^2; linear between them.
    spacing : float
        Wanted distance between knots, m; the true one divides the length evenly.

    Returns
    -------
    KnotTable

    Raises
    ------
    TrackError
        Fewer than two distinct vertices, a non-finite vertex, or arrays of different lengths.

    Notes
    -----
    Vertices rounded to 0.1 mm every 5 m give a curvature good to about 1e-5 1/m.
    """
    from scipy.interpolate import CubicSpline

    east, north = np.atleast_1d(np.asarray(easting, float)), np.atleast_1d(np.asarray(northing, float))
    n = len(east)
    up = np.full(n, np.nan) if height is None else np.asarray(height, float)
    roll = np.zeros(n) if cant is None else np.asarray(cant, float)
    cov = np.full((n, 6), np.nan) if covariance_g is None else np.asarray(covariance_g, float)
    if not (len(north) == len(up) == len(roll) == len(cov) == n) or cov.shape != (n, 6):
        raise TrackError(f"vertex arrays differ in length: {n} eastings, {len(north)} northings, {len(up)} heights")
    if not (np.isfinite(east).all() and np.isfinite(north).all()):
        row = int(np.flatnonzero(~(np.isfinite(east) & np.isfinite(north)))[0])
        raise TrackError(f"vertex {row + 1} is not finite")
    if spacing <= 0:
        raise TrackError(f"knot spacing {spacing} m is not positive")
    keep = np.append(True, np.hypot(np.diff(east), np.diff(north)) >= SAME_VERTEX)
    east, north, up, roll, cov = east[keep], north[keep], up[keep], roll[keep], cov[keep]
    if len(east) < 2:
        raise TrackError(f"a track needs two distinct vertices, got {n} within {SAME_VERTEX * 1e3:.0f} mm")
    has_height = bool(np.isfinite(up).all())

    p = np.append(0.0, np.cumsum(np.hypot(np.diff(east), np.diff(north))))
    # not-a-knot ends; with three points a parabola, with two a straight line
    spline = CubicSpline(p, np.column_stack([east, north, up if has_height else np.zeros(len(p))]))
    first, second = spline.derivative(1), spline.derivative(2)

    # point scale changes by less than 1e-10 over 100 m: tabulate it that finely and no finer
    q = np.linspace(0.0, p[-1], max(2, int(p[-1] / 100.0) + 2))
    at_q, along_q = spline(q), first(q)
    scale_q = frame.ground_scale(at_q[:, 0], at_q[:, 1], at_q[:, 2], np.arctan2(along_q[:, 0], along_q[:, 1]))

    def speed(parameter: FloatArray) -> FloatArray:
        """Ground metres per metre of parameter."""
        d = first(parameter)
        horizontal = np.hypot(d[..., 0], d[..., 1]) / np.interp(parameter, q, scale_q)
        return np.asarray(np.hypot(horizontal, d[..., 2]))

    # intervals of integration end at the vertices and are at most 5 m long
    pieces = np.maximum(1, np.ceil(np.diff(p) / 5.0).astype(int))
    before = np.append(0, np.cumsum(pieces))
    part = np.arange(before[-1]) - np.repeat(before[:-1], pieces)
    edges = np.append(np.repeat(p[:-1], pieces) + part * np.repeat(np.diff(p) / pieces, pieces), p[-1])
    node, weight = np.polynomial.legendre.leggauss(5)
    half = 0.5 * np.diff(edges)
    lengths = half * (speed(edges[:-1, None] + half[:, None] * (1.0 + node)) @ weight)
    s_edges = np.append(0.0, np.cumsum(lengths))
    length = float(s_edges[-1])

    count = max(2, round(length / spacing) + 1)
    offset = np.linspace(0.0, length, count)
    at = np.interp(offset, s_edges, edges)
    for _ in range(3):  # Newton on s(p) = offset, s(p) integrated from the interval's left edge
        j = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, len(edges) - 2)
        h = 0.5 * (at - edges[j])
        s_at = s_edges[j] + h * (speed(edges[j][:, None] + h[:, None] * (1.0 + node)) @ weight)
        at = np.clip(at + (offset - s_at) / speed(at), 0.0, p[-1])

    point, d1, d2 = spline(at), first(at), second(at)
    plane = np.hypot(d1[:, 0], d1[:, 1])
    scale = np.interp(at, q, scale_q)
    rate = speed(at)
    return KnotTable(
        offset=offset,
        easting=point[:, 0],
        northing=point[:, 1],
        height=point[:, 2] if has_height else np.full(count, np.nan),
        grid_bearing=np.arctan2(d1[:, 0], d1[:, 1]),
        curvature=(d2[:, 0] * d1[:, 1] - d1[:, 0] * d2[:, 1]) / plane**2 / rate,
        gradient=d1[:, 2] * scale / plane,
        cant=np.interp(at, p, roll),
        scale=scale,
        covariance_g=np.column_stack([np.interp(at, p, cov[:, i]) for i in range(6)]),
    )
