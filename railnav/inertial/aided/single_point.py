"""Position, velocity and clock of a receiver from the pseudoranges and range rates of one instant, and how good the geometry is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.geodesy.ellipsoid import WGS84

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SinglePoint:
    """What four satellites or more tell at one instant.

    Attributes
    ----------
    position_e, velocity_e : (3,) array
        Earth-centred, Earth-fixed, m, m/s.
    clock_bias, clock_drift : float
        m, m/s.
    latitude, longitude, height : float
        WGS 84, rad, rad, m.
    velocity_n : (3,) array
        North, east, down, m/s.
    cofactor_n : (4, 4) array
        (H^T H)^-1 in north, east, down and clock: times the variance of a range it is the covariance.
    iterations : int
    """

    position_e: FloatArray
    velocity_e: FloatArray
    clock_bias: float
    clock_drift: float
    latitude: float
    longitude: float
    height: float
    velocity_n: FloatArray
    cofactor_n: FloatArray
    iterations: int

    @property
    def dilution(self) -> dict[str, float]:
        """Dilutions of precision: "gdop", "pdop", "hdop", "vdop", "tdop"."""
        q = np.diagonal(self.cofactor_n)
        parts = {"gdop": q.sum(), "pdop": q[:3].sum(), "hdop": q[:2].sum(), "vdop": q[2], "tdop": q[3]}
        return {name: float(np.sqrt(value)) for name, value in parts.items()}


def single_point(
    satellite_position: ArrayLike,
    satellite_velocity: ArrayLike,
    pseudorange: ArrayLike,
    range_rate: ArrayLike,
    *,
    start: ArrayLike | None = None,
) -> SinglePoint:
    """Solve rho_i = |x - s_i| + b and its rate by least squares, from the Earth's centre if need be.

    Parameters
    ----------
    satellite_position, satellite_velocity : (m, 3) array
        Earth-centred, Earth-fixed, m, m/s.
    pseudorange, range_rate : (m,) array
        m, m/s.
    start : (3,) array, optional
        Approximate position, m.

    Returns
    -------
    SinglePoint

    Raises
    ------
    ValueError
        Wrong shapes, values that are not finite.
    EstimationError
        Fewer than four satellites, satellites that do not fix a position, no convergence.

    References
    ----------
    `spec/inertial.md` B7.

    Examples
    --------
    >>> sats = 2.6e7 * np.array([[1.0, 0, 0], [0.8, 0.6, 0], [0.8, 0, 0.6], [0.8, -0.4, -0.447]])
    >>> here = np.array([6378137.0, 0.0, 0.0])
    >>> fix = single_point(sats, 0 * sats, np.linalg.norm(sats - here, axis=1) + 30.0, np.zeros(4))
    >>> round(fix.height, 3) + 0.0, round(fix.clock_bias, 3)
    (0.0, 30.0)
    """
    s, w = np.asarray(satellite_position, dtype=np.float64), np.asarray(satellite_velocity, dtype=np.float64)
    rho, rate = np.asarray(pseudorange, dtype=np.float64), np.asarray(range_rate, dtype=np.float64)
    m = len(rho) if rho.ndim == 1 else -1
    if s.shape != (m, 3) or w.shape != (m, 3) or rate.shape != (m,):
        raise ValueError("needs one position, velocity, pseudorange and range rate a satellite")
    if not all(np.isfinite(x).all() for x in (s, w, rho, rate)):
        raise ValueError("a satellite's value is not finite; leave it out")
    if m < 4:
        raise EstimationError(
            f"{m} satellites do not fix a position and a clock: four are needed (tight coupling takes fewer)"
        )
    x = np.zeros(4)
    if start is not None:
        x[:3] = np.asarray(start, dtype=np.float64)
    iterations = 0
    while True:
        iterations += 1
        if iterations > 20:
            raise EstimationError("the position does not converge: check units and the order of the satellites")
        line = x[:3] - s
        distance = np.linalg.norm(line, axis=1)
        H = np.column_stack([line / distance[:, None], np.ones(m)])
        if np.linalg.cond(H) > 1e6:
            raise EstimationError("these satellites do not fix a position: their directions lie on a cone")
        step = np.linalg.lstsq(H, rho - distance - x[3], rcond=None)[0]
        x += step
        if np.linalg.norm(step) < 1e-6:
            break
    v = np.linalg.lstsq(H, rate + np.einsum("ij,ij->i", H[:, :3], w), rcond=None)[0]
    latitude, longitude, height = (float(c) for c in WGS84.to_geodetic(*x[:3]))
    C = np.eye(4)
    C[:3, :3] = north_east_down(latitude, longitude)
    Q = C @ np.linalg.inv(H.T @ H) @ C.T
    return SinglePoint(
        x[:3], v[:3], float(x[3]), float(v[3]), latitude, longitude, height, C[:3, :3] @ v[:3], Q, iterations
    )


def north_east_down(latitude: float, longitude: float) -> FloatArray:
    """C_ne of KZ(A.6): Earth-fixed into north, east, down axes, (3, 3); angles in rad.

    Examples
    --------
    >>> north_east_down(0.0, 0.0) @ [1.0, 0.0, 0.0] + 0.0
    array([ 0.,  0., -1.])
    """
    sp, cp, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array([[-sp * cl, -sp * sl, cp], [-sl, cl, 0.0], [-cp * cl, -cp * sl, -sp]])
