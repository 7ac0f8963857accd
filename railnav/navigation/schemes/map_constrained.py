"""Inertial navigation held to a map of points: the source's predictor with its literal corrector, and the arc-length one in its place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.geodesy.ellipsoid import WGS84, Ellipsoid
from railnav.geodesy.helmert import Helmert
from railnav.inertial.mechanization import GravityField, NavigationState, Trajectory

FloatArray = NDArray[np.float64]
Corrector = Literal["literal", "literal_half_interval", "gnss", "arc"]
_CORRECTORS = {"literal": 0, "literal_half_interval": 1, "gnss": 2, "arc": 3}

#: Seven-parameter sets of the datum chain, coordinate-frame signs: translation, m, rotations, arc seconds, scale, ppm (rail 12).
DATUM_SETS = {
    "2001": (
        ((25.0, -141.0, -80.0), (0.0, -0.35, -0.66), 0.0),  # Pulkovo 1942 -> PZ-90, GOST R 51794-2001
        ((-1.08, -0.27, -0.90), (0.0, 0.0, -0.16), -0.12),  # PZ-90 -> WGS 84
    ),
    "2008": (
        ((23.93, -141.03, -79.98), (0.0, -0.35, -0.79), -0.22),  # Pulkovo 1942 -> PZ-90.02, GOST R 51794-2008
        ((-0.36, 0.08, 0.18), (0.0, 0.0, 0.0), 0.0),  # PZ-90.02 -> WGS 84
    ),
}


def datum_chain(
    position: ArrayLike, *, parameters: str = "2008", start: Literal["pulkovo", "pz90"] = "pulkovo"
) -> FloatArray:
    """Cartesian coordinates of Pulkovo 1942 or PZ-90 in WGS 84, as the source's corrector needs them before it meets the map.

    X' = T + (1 + m) [[1, rz, -ry], [-rz, 1, rx], [ry, -rx, 1]] X for each leg.

    Parameters
    ----------
    position : (..., 3) array
        Earth-centred, Earth-fixed, m.
    parameters : {"2008", "2001"}, optional
        Edition of GOST R 51794. Source B gives no parameters; the editions differ by 0.73 m at Moscow.
    start : {"pulkovo", "pz90"}, optional
        Where the coordinates come from: INS ("pulkovo"), GLONASS ("pz90").

    Returns
    -------
    (..., 3) array

    Raises
    ------
    ValueError
        An unknown set or start, a wrong shape.

    Notes
    -----
    For coordinates of models and runs `railnav.geodesy.transformation` pins PROJ's own operations; this chain is here because the source's
    scheme names it. With the opposite sign of the rotations the answer is 24 m off.

    References
    ----------
    `spec/rail.md` 12.

    Examples
    --------
    >>> x = [2850680.9358, 2195319.8573, 5249043.0734]
    >>> datum_chain(x, parameters="2001").round(2).tolist()
    [2850704.69, 2195189.66, 5248956.71]
    """
    if parameters not in DATUM_SETS:
        raise ValueError(f"parameters {parameters!r} are none of {', '.join(DATUM_SETS)}")
    if start not in ("pulkovo", "pz90"):
        raise ValueError(f"start {start!r} is none of pulkovo, pz90")
    x = np.asarray(position, dtype=np.float64)
    if x.shape[-1:] != (3,) or not np.isfinite(x).all():
        raise ValueError("position must be (..., 3) and finite")
    for shift, turn, scale in DATUM_SETS[parameters][0 if start == "pulkovo" else 1 :]:
        x = Helmert.of(shift, turn, scale, convention="coordinate_frame").apply(x)
    return np.asarray(x)


@dataclass(frozen=True, slots=True, eq=False)
class PointMap:
    """A way as points at a fixed step, as the source's corrector wants them.

    Attributes
    ----------
    step : float
        Between points, m.
    position_e : (m, 3) array
        Earth-fixed, m.
    place : (m, 3) array
        Latitude, longitude, height, rad, rad, m.
    azimuth : (m,) array
        Of the piece that each point lies on, from true north, rad.
    closed : bool
        Whether the last point is followed by the first.
    """

    step: float
    position_e: FloatArray
    place: FloatArray
    azimuth: FloatArray
    closed: bool = False

    @classmethod
    def from_line(
        cls,
        latitude: ArrayLike,
        longitude: ArrayLike,
        height: ArrayLike,
        *,
        step: float = 1.0,
        closed: bool = False,
        ellipsoid: Ellipsoid = WGS84,
    ) -> PointMap:
        """Resample a piecewise-linear way to a fixed step.

        Parameters
        ----------
        latitude, longitude, height : (p,) array
            Vertices, rad, rad, m.
        step : float, optional
            m.
        closed : bool, optional
            Whether the way returns to its first vertex.
        ellipsoid : Ellipsoid, optional
            Of the coordinates.

        Returns
        -------
        PointMap

        Raises
        ------
        ValueError
            Fewer than two vertices, values that are not finite, a step that is not positive or longer than the way.
        """
        llh = np.stack([np.asarray(c, dtype=np.float64) for c in (latitude, longitude, height)], axis=1)
        if llh.ndim != 2 or len(llh) < 2 or not np.isfinite(llh).all():
            raise ValueError("a way needs two finite vertices and more")
        vertex = np.stack(ellipsoid.to_cartesian(*llh.T), axis=1)
        if closed:
            vertex = np.vstack([vertex, vertex[:1]])
        piece = np.linalg.norm(np.diff(vertex, axis=0), axis=1)
        vertex = vertex[np.append(True, piece > 0)]
        along = np.append(0.0, np.cumsum(piece[piece > 0]))
        if not 0.0 < step <= along[-1]:
            raise ValueError(f"a step of {step:g} m does not fit a way of {along[-1]:.1f} m")
        count = int(along[-1] / step)
        if closed:  # an even step all round
            step = float(along[-1]) / count
            s = np.arange(count) * step
        else:
            s = np.arange(count + 1) * step
        x = np.stack([np.interp(s, along, c) for c in vertex.T], axis=1)
        place = np.stack(ellipsoid.to_geodetic(*x.T), axis=1)
        on = np.clip(np.searchsorted(along, s, side="right") - 1, 0, len(vertex) - 2)
        line = (vertex[1:] - vertex[:-1])[on]
        sp, cp, sl, cl = np.sin(place[:, 0]), np.cos(place[:, 0]), np.sin(place[:, 1]), np.cos(place[:, 1])
        north = -sp * cl * line[:, 0] - sp * sl * line[:, 1] + cp * line[:, 2]
        east = -sl * line[:, 0] + cl * line[:, 1]
        return cls(float(step), x, place, np.arctan2(east, north), closed)


@dataclass(frozen=True, slots=True, eq=False)
class MapConstrained:
    """What the predictor with its corrector found.

    Attributes
    ----------
    trajectory : Trajectory
        States before the first and after every sample.
    ins_chosen : float
        Share of corrections at which the source's rule took the INS candidate; 0 for the others.
    """

    trajectory: Trajectory
    ins_chosen: float


def map_constrained(
    start: NavigationState,
    time: ArrayLike,
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    fix_time: ArrayLike,
    fix_position_e: ArrayLike,
    way: PointMap,
    *,
    start_time: float,
    corrector: Corrector = "arc",
    alpha: float = 0.15,
    beta: float = 0.012,
    window: float = 50.0,
    first_order: bool = False,
    gravity: GravityField | None = None,
) -> MapConstrained:
    """Integrate an IMU and put the vehicle back onto the map at every fix.

    "literal": of the map points nearest to the INS and nearest to GNSS the one that is closer to its candidate, velocities from the last
    two corrections, azimuth and slope of the road: rail (10) to (12). "literal_half_interval" adds the change of velocity that the mean of
    the last interval lags behind. "gnss": the GNSS candidate always. "arc": e = s_c - s_u along the map, s = s_u + alpha e,
    v = v.t + beta e/T; position, direction and attitude from the map.

    Parameters
    ----------
    start : NavigationState
        At `start_time`.
    time : (n,) array
        End of the interval of each sample, s.
    rate_ib_b, specific_force_b : (n, 3) array
        Forward, right, down, rad/s, m/s^2.
    fix_time, fix_position_e : (J,), (J, 3) array
        s and Earth-fixed coordinates of the map's frame, m (`datum_chain` where they are of another).
    way : PointMap
        The map.
    start_time : float
        s.
    corrector : {"arc", "literal", "literal_half_interval", "gnss"}, optional
        Which.
    alpha, beta : float, optional
        Gains of "arc": 0.15, 0.012 for unbiased sensors; 0.4, 0.12 where biases are not compensated.
    window : float, optional
        Map points this near to the fix are looked at for the INS candidate, m.
    first_order : bool, optional
        Source's integrator with held samples instead of exponential and half-way.
    gravity : GravityField, optional
        Default: WGS 84 with the free-air change left out, as the source has it.

    Returns
    -------
    MapConstrained

    Raises
    ------
    ValueError
        Wrong shapes, times that do not increase, gains out of range.

    Notes
    -----
    The literal rule does not meet the source's own figures: just put onto the map, the INS lies nearer to it than GNSS does nine times
    of ten, so that the error along is hardly ever corrected, and where GNSS wins, (11) makes a speed error of its jump: numbers in
    `docs/theory/inertial.md`. Neither has a covariance.

    References
    ----------
    `spec/rail.md` 11 to 14.

    Examples
    --------
    >>> way = PointMap.from_line([0.9, 0.901], [0.0, 0.0], [0.0, 0.0])
    >>> still = np.zeros((100, 3)), np.tile(-GravityField().vector(0.9001), (100, 1))
    >>> out = map_constrained(NavigationState(0.9001, 0.0, 0.0), np.arange(1, 101) * 0.1, *still, [5.0], way.position_e[[650]], way,
    ...     start_time=0.0)
    >>> len(out.trajectory.time)
    101
    """
    from railnav.inertial._kernels import PREDICTOR, PREDICTOR_FIRST_ORDER
    from railnav.navigation.schemes._kernels import map_kernel

    if corrector not in _CORRECTORS:
        raise ValueError(f"corrector {corrector!r} is none of {', '.join(_CORRECTORS)}")
    if not (0.0 < alpha <= 1.0 and 0.0 <= beta <= 2.0 and window > 0.0):
        raise ValueError("alpha must lie in 0 to 1, beta in 0 to 2, the window must be positive")
    t = np.asarray(time, dtype=np.float64)
    w, f = np.asarray(rate_ib_b, dtype=np.float64), np.asarray(specific_force_b, dtype=np.float64)
    if (
        t.ndim != 1
        or w.shape != (len(t), 3)
        or f.shape != (len(t), 3)
        or not (np.isfinite(w).all() and np.isfinite(f).all())
    ):
        raise ValueError("needs one time, rate and specific force a sample, all finite")
    interval = np.diff(t, prepend=start_time)
    if np.any(interval <= 0.0):
        raise ValueError("times must increase from start_time")
    stamps, fixes = np.asarray(fix_time, dtype=np.float64), np.asarray(fix_position_e, dtype=np.float64)
    if (
        stamps.ndim != 1
        or fixes.shape != (len(stamps), 3)
        or np.any(np.diff(stamps) <= 0.0)
        or not np.isfinite(fixes).all()
    ):
        raise ValueError("needs one time and finite position a fix, in order")
    inside = (stamps > start_time) & (stamps <= t[-1] + 1e-9)
    row = np.searchsorted(t, stamps[inside] - 1e-9, side="left")
    out = np.empty((len(t) + 1, 10))
    out[0] = [start.latitude, start.longitude, start.height, *start.velocity_n, *start.quaternion_nb]
    chosen = np.zeros(len(row))
    map_kernel(
        PREDICTOR_FIRST_ORDER if first_order else PREDICTOR,
        w * interval[:, None],
        f * interval[:, None],
        interval,
        (gravity or GravityField(free_air="none")).flat(),
        row,
        np.ascontiguousarray(fixes[inside]),
        way.position_e,
        way.place,
        way.azimuth,
        way.step,
        way.closed,
        float(window),
        _CORRECTORS[corrector],
        float(alpha),
        float(beta),
        out,
        chosen,
    )
    stamps = np.concatenate([[start_time], t])
    trajectory = Trajectory(stamps, out[:, 0], out[:, 1], out[:, 2], out[:, 3:6], out[:, 6:])
    return MapConstrained(trajectory, float(chosen.mean()) if len(chosen) else 0.0)
