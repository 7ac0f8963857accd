"""Increments of a survey vehicle in space, from distance, bearing and gradient, with their covariance: the adaptive measuring complex.

All readings are synchronous, one row a step. Coordinates are of the grid: easting, northing, height.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.units import cant_angle

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SpaceIncrements:
    """Increments of position with covariances.

    Attributes
    ----------
    increment : (N, 3) array
        Easting, northing, height, m.
    covariance : (N, 3, 3) array
        Of their white errors, m^2.
    directions : (N, 3, 3) array
        Columns: derivatives of the increment by the relative error of the distance, by the bearing and by the slope angle,
        ds [t, dt/dbearing, dt/dslope]: what an error of scale, bearing and slope that lasts does to the increment.
    """

    increment: FloatArray
    covariance: FloatArray
    directions: FloatArray

    def between(self, first_step: ArrayLike) -> SpaceIncrements:
        """Sum sub-steps to increments between nodes: increments, covariances and directions add up.

        Parameters
        ----------
        first_step : (K + 1,) integer array
            Increment k is made of the steps ``first_step[k]`` to ``first_step[k + 1] - 1``; strictly increasing.

        Returns
        -------
        SpaceIncrements
            K increments.

        Raises
        ------
        EstimationError
            The boundaries do not increase, or lie outside the steps.
        """
        edge = np.asarray(first_step)
        N = len(self.increment)
        if edge.ndim != 1 or len(edge) < 2 or not np.issubdtype(edge.dtype, np.integer):
            raise EstimationError(
                f"first_step has shape {edge.shape} and type {edge.dtype}; at least two integers are needed"
            )
        if (np.diff(edge) <= 0).any() or edge[0] < 0 or edge[-1] > N:
            raise EstimationError(
                f"first_step runs from {edge[0]} to {edge[-1]}; strictly increasing within 0 to {N} fits"
            )
        part = slice(int(edge[0]), int(edge[-1]))
        start = (edge[:-1] - edge[0]).astype(np.int64)
        return SpaceIncrements(
            *(np.add.reduceat(a[part], start, axis=0) for a in (self.increment, self.covariance, self.directions))
        )


def space_increments(
    distance: ArrayLike,
    grid_bearing: ArrayLike,
    gradient: ArrayLike,
    *,
    distance_sigma: ArrayLike,
    bearing_sigma: ArrayLike,
    slope_sigma: ArrayLike,
) -> SpaceIncrements:
    """Turn odometer steps and gyro angles into increments, dX = ds t, with K(dX) = J diag(sigma^2) J^T.

    t = (sin b cos a, cos b cos a, sin a) with bearing b and slope angle a = atan(gradient);
    J = [t, ds dt/db, ds dt/da].

    Parameters
    ----------
    distance : (N,) array
        Steps along the track, m; negative backwards (the bearing stays that of the nose).
    grid_bearing : (N,) array
        Bearing of the nose from grid north, clockwise, rad, at the middle of each step.
    gradient : (N,) array
        Rise over run in the direction of the nose, positive uphill.
    distance_sigma, bearing_sigma, slope_sigma : float or (N,) array
        Sigma of each step's distance, m, bearing, rad, and slope angle, rad: the errors that change from step to step. What
        lasts (scale, gyro drift) belongs into the state: `directions` are its coefficients.

    Returns
    -------
    SpaceIncrements
        Easting, northing, height.

    Raises
    ------
    EstimationError
        Shapes differ, a value is not finite, or a sigma is not positive.

    Notes
    -----
    Distances are of the ground; multiply by the grid's scale where the difference counts (1 m of 10 km at 100 ppm). The covariance
    of a step at rest has rank 1; summed steps of a moving vehicle are regular. Errors that are alike from step to step make sums
    of these covariances too small: take n = 6.

    References
    ----------
    Specification rail 7.

    Examples
    --------
    >>> steps = space_increments([1.0], [0.0], [0.0], distance_sigma=1e-3, bearing_sigma=5e-4, slope_sigma=3e-4)
    >>> steps.increment[0], (1e3 * np.sqrt(np.diagonal(steps.covariance[0]))).round(6)
    (array([0., 1., 0.]), array([0.5, 1. , 0.3]))
    """
    s = np.atleast_1d(np.asarray(distance, np.float64))
    b, g = np.atleast_1d(np.asarray(grid_bearing, np.float64)), np.atleast_1d(np.asarray(gradient, np.float64))
    if s.ndim != 1 or b.shape != s.shape or g.shape != s.shape:
        raise EstimationError(f"distance has shape {s.shape}, grid_bearing {b.shape}, gradient {g.shape}; all are (N,)")
    for name, value in (("distance", s), ("grid_bearing", b), ("gradient", g)):
        for k in np.flatnonzero(~np.isfinite(value))[:1]:
            raise EstimationError(f"{name} is not finite at step {k}; leave that step out and start anew behind it")
    sigmas = []
    for name, sigma in (
        ("distance_sigma", distance_sigma),
        ("bearing_sigma", bearing_sigma),
        ("slope_sigma", slope_sigma),
    ):
        value = np.asarray(sigma, np.float64)
        if value.shape not in ((), s.shape):
            raise EstimationError(f"{name} has shape {value.shape}; one number or {s.shape} fits")
        if not ((value > 0) & np.isfinite(value)).all():
            raise EstimationError(f"{name} is not positive somewhere; use 1e-6 rather than 0")
        sigmas.append(np.broadcast_to(value, s.shape))
    a = np.arctan(g)
    sb, cb, sa, ca = np.sin(b), np.cos(b), np.sin(a), np.cos(a)
    t = np.column_stack([sb * ca, cb * ca, sa])
    by_bearing = np.column_stack([cb * ca, -sb * ca, np.zeros_like(s)])
    by_slope = np.column_stack([-sb * sa, -cb * sa, ca])
    J = np.stack([t, s[:, None] * by_bearing, s[:, None] * by_slope], axis=2)
    scaled = J * np.column_stack(sigmas)[:, None, :]
    directions = J.copy()
    directions[:, :, 0] *= s[:, None]
    return SpaceIncrements(s[:, None] * t, scaled @ np.swapaxes(scaled, 1, 2), directions)


def rail_to_axis(
    position: ArrayLike,
    grid_bearing: ArrayLike,
    gauge: ArrayLike,
    cant: ArrayLike = 0.0,
    *,
    rail: Literal["left", "right"],
) -> FloatArray:
    """Move points of one rail to the axis: half the measured gauge across, along the plane of the rail heads.

    Parameters
    ----------
    position : (N, 3) array
        Easting, northing, height of the rail, m.
    grid_bearing : float or (N,) array
        Bearing in which left and right are meant, rad.
    gauge : float or (N,) array
        Measured gauge, m.
    cant : float or (N,) array
        Cant, m, positive with the left rail high.
    rail : {"left", "right"}
        Which rail was measured.

    Returns
    -------
    (N, 3) array
        The axis between the rails, at the height of the mid of the rail heads.

    Raises
    ------
    EstimationError
        Shapes do not fit, or a gauge is not positive.

    References
    ----------
    Specification rail 7, gauge sensor.

    Examples
    --------
    >>> rail_to_axis([[0.0, 0.0, 0.0]], 0.0, 1.52, rail="left").round(9) + 0.0
    array([[0.76, 0.  , 0.  ]])
    """
    X = np.asarray(position, np.float64)
    width, bearing = np.asarray(gauge, np.float64), np.asarray(grid_bearing, np.float64)
    lean = cant_angle(cant)
    if X.ndim != 2 or X.shape[1] != 3 or any(v.shape not in ((), (len(X),)) for v in (width, bearing, lean)):
        raise EstimationError(
            f"position has shape {X.shape}; (N, 3) with one gauge, bearing and cant for all or for each fits"
        )
    if not (width > 0).all():
        raise EstimationError("a gauge is not positive; it is the distance of the rails, 1.435 m or 1.520 m")
    half = np.broadcast_to(0.5 * width if rail == "left" else -0.5 * width, (len(X),))
    right = np.column_stack(
        np.broadcast_arrays(
            np.sin(bearing + np.pi / 2) * np.cos(lean), np.cos(bearing + np.pi / 2) * np.cos(lean), -np.sin(lean)
        )
    )
    return np.asarray(X + half[:, None] * right)
