"""Strapdown mechanization: from angular rate and specific force to attitude, velocity and position.

State: geodetic latitude, longitude, height; velocity north, east, down; attitude C_nb. Five schemes share one interface, from the
first-order one of the source to one with coning, sculling and scrolling; `docs/theory/inertial.md` says what each is worth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import dcm_from_quaternion, euler_from_quaternion, quaternion_from_dcm, quaternion_from_euler
from railnav.errors import EstimationError
from railnav.geodesy.ellipsoid import WGS84, Ellipsoid

FloatArray = NDArray[np.float64]
Scheme = Literal["coning", "matrix", "euler", "predictor", "predictor_first_order"]

#: Rotation rate of the Earth, rad/s (WGS 84).
EARTH_RATE = 7.292115e-5
#: omega^2 a^2 b/GM of WGS 84, in the change of normal gravity with height.
_CENTRIFUGAL_RATIO = 0.00344978650684
_SCHEMES: dict[str, int] = {"coning": 0, "matrix": 1, "euler": 2, "predictor": 3, "predictor_first_order": 4}
_FREE_AIR = {"none": 0.0, "linear": 1.0, "second_order": 2.0}


@dataclass(frozen=True, slots=True)
class GravityField:
    """Gravity that a mechanization reckons with: normal gravity and what is known of its anomalies.

    Attributes
    ----------
    ellipsoid : Ellipsoid
        Its size, shape and normal gravity at the equator and the poles.
    free_air : {"second_order", "linear", "none"}
        Change of normal gravity with height: 1 - 2/a (1 + f + m - 2 f sin^2) h + 3 h^2/a^2, or 1 - 2 h/a, or left out as in the road
        predictor's source (3.1e-6 m/s^2 wrong per metre of height).
    deflection_north, deflection_east : float
        Deflections of the vertical xi and eta, rad: positive where the plumb line's zenith leans north, east.
    anomaly : float
        Delta g, m/s^2, added to normal gravity.
    earth_rate : float
        rad/s.

    References
    ----------
    `spec/inertial.md` 0.4; `spec/rail.md` 11, (2) and (3).

    Examples
    --------
    >>> GravityField().vector(np.radians(45.0), 1000.0)[2].round(6)
    np.float64(9.803113)
    """

    ellipsoid: Ellipsoid = WGS84
    free_air: Literal["second_order", "linear", "none"] = "second_order"
    deflection_north: float = 0.0
    deflection_east: float = 0.0
    anomaly: float = 0.0
    earth_rate: float = EARTH_RATE

    def flat(self) -> FloatArray:
        """The field as the kernels take it, (11,)."""
        e = self.ellipsoid
        k = e.semi_minor_axis * e.gravity_pole / (e.semi_major_axis * e.gravity_equator) - 1.0
        return np.array(
            [
                e.semi_major_axis,
                e.eccentricity_squared,
                e.gravity_equator,
                k,
                e.flattening,
                _CENTRIFUGAL_RATIO,
                _FREE_AIR[self.free_air],
                self.deflection_north,
                self.deflection_east,
                self.anomaly,
                self.earth_rate,
            ]
        )

    def vector(self, latitude: float, height: float = 0.0) -> FloatArray:
        """Gravity vector g_n, north, east, down, m/s^2; a body at rest has the specific force -g_n.

        Parameters
        ----------
        latitude, height : float
            Geodetic latitude, rad, and height above the ellipsoid, m.

        Returns
        -------
        (3,) array
        """
        from railnav.inertial._kernels import gravity

        return np.array(gravity(math.sin(latitude), float(height), self.flat()))


def _normal_field() -> GravityField:
    return GravityField()


@dataclass(frozen=True, slots=True, eq=False)
class NavigationState:
    """Where a body is, how fast it moves and how it lies.

    Attributes
    ----------
    latitude, longitude : float
        Geodetic, rad.
    height : float
        Above the ellipsoid, m.
    velocity_n : (3,) array
        North, east, down, m/s.
    quaternion_nb : (4,) array
        Scalar first: v_n = C_nb v_b.

    Examples
    --------
    >>> state = NavigationState.from_euler(0.87, 0.5, 100.0, velocity_n=[10.0, 0.0, 0.0], heading=0.1)
    >>> round(state.heading, 6)
    0.1
    """

    latitude: float
    longitude: float
    height: float
    velocity_n: FloatArray = field(default_factory=lambda: np.zeros(3))
    quaternion_nb: FloatArray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))

    def __post_init__(self) -> None:
        v, q = np.array(self.velocity_n, dtype=np.float64), np.array(self.quaternion_nb, dtype=np.float64)
        scalars = (self.latitude, self.longitude, self.height)
        if v.shape != (3,) or q.shape != (4,):
            raise ValueError(f"needs velocity_n (3,) and quaternion_nb (4,), not {v.shape} and {q.shape}")
        if not (all(math.isfinite(x) for x in scalars) and np.isfinite(v).all() and np.isfinite(q).all()):
            raise ValueError("a navigation state holds a value that is not finite")
        if abs(self.latitude) > math.pi / 2:
            raise ValueError(f"latitude {self.latitude:g} rad is beyond the pole; latitudes are in radians")
        norm = float(np.linalg.norm(q))
        if abs(norm - 1.0) > 1e-6:
            raise ValueError(f"quaternion_nb has the length {norm:.7g}, not 1")
        q /= norm
        v.flags.writeable = q.flags.writeable = False
        object.__setattr__(self, "velocity_n", v)
        object.__setattr__(self, "quaternion_nb", q)

    @classmethod
    def from_euler(
        cls,
        latitude: float,
        longitude: float,
        height: float,
        *,
        velocity_n: ArrayLike = (0.0, 0.0, 0.0),
        roll: float = 0.0,
        pitch: float = 0.0,
        heading: float = 0.0,
    ) -> NavigationState:
        """State with the attitude given by its angles, rad: right side down, nose up, clockwise from true north."""
        q = quaternion_from_euler(roll, pitch, heading)
        return cls(latitude, longitude, height, np.array(velocity_n, dtype=np.float64), q)

    @classmethod
    def from_dcm(
        cls,
        latitude: float,
        longitude: float,
        height: float,
        *,
        velocity_n: ArrayLike = (0.0, 0.0, 0.0),
        C_nb: ArrayLike,
    ) -> NavigationState:
        """State with the attitude given by its matrix."""
        return cls(latitude, longitude, height, np.array(velocity_n, dtype=np.float64), quaternion_from_dcm(C_nb))

    @property
    def C_nb(self) -> FloatArray:  # noqa: N802 - matrices are written as in the sources
        """Direction cosine matrix, v_n = C_nb v_b, (3, 3)."""
        return dcm_from_quaternion(self.quaternion_nb)

    @property
    def roll(self) -> float:
        """Right side down, rad."""
        return float(euler_from_quaternion(self.quaternion_nb)[0])

    @property
    def pitch(self) -> float:
        """Nose up, rad."""
        return float(euler_from_quaternion(self.quaternion_nb)[1])

    @property
    def heading(self) -> float:
        """Clockwise from true north, rad."""
        return float(euler_from_quaternion(self.quaternion_nb)[2])


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """States before the first and after every sample.

    Attributes
    ----------
    time : (n + 1,) array
        s from the start.
    latitude, longitude, height : (n + 1,) array
        rad, rad, m.
    velocity_n : (n + 1, 3) array
        North, east, down, m/s.
    quaternion_nb : (n + 1, 4) array
        Scalar first.
    """

    time: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    height: FloatArray
    velocity_n: FloatArray
    quaternion_nb: FloatArray

    @property
    def C_nb(self) -> FloatArray:  # noqa: N802 - matrices are written as in the sources
        """Direction cosine matrices, (n + 1, 3, 3)."""
        return dcm_from_quaternion(self.quaternion_nb)

    def euler(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Roll, pitch, heading, (n + 1,) each, rad."""
        return euler_from_quaternion(self.quaternion_nb)

    def state(self, index: int = -1) -> NavigationState:
        """State at one instant; by default the last."""
        return NavigationState(
            float(self.latitude[index]),
            float(self.longitude[index]),
            float(self.height[index]),
            self.velocity_n[index],
            self.quaternion_nb[index],
        )


def mechanize(
    start: NavigationState,
    interval: ArrayLike,
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    *,
    scheme: Scheme = "coning",
    gravity: GravityField | None = None,
    gyro_bias: ArrayLike | None = None,
    accelerometer_bias: ArrayLike | None = None,
    accelerometer_scale: ArrayLike | None = None,
) -> Trajectory:
    """Integrate inertial samples from a known state.

    v' = C_nb f_b - (2 w_ie + w_en) x v + g_n, lat' = vN/(M + h), lon' = vE/((N + h) cos lat), h' = -vD,
    C_nb' = C_nb [w_ib_b x] - [w_in_n x] C_nb.

    Parameters
    ----------
    start : NavigationState
        State before the first sample.
    interval : float or (n,) array
        Length of the interval of each sample, s; longer than 0.1 s it is cut into equal parts.
    rate_ib_b : (n, 3) array
        Mean angular rate over each interval, forward, right, down, rad/s.
    specific_force_b : (n, 3) array
        Mean specific force over each interval (about -9.81 m/s^2 down at rest), m/s^2.
    scheme : str, optional
        "coning": rotation vector with the coning term of this and the last increment, rotation, sculling and scrolling terms, frame
        rates in the middle of the step. "matrix": second order, mean of the old and new attitude, the source's recommended variant.
        "euler": first order on roll, pitch and heading as the source prints it. "predictor": the road predictor, exponential with
        the specific force turned half way. "predictor_first_order": the same as its source has it, with held samples.
    gravity : GravityField, optional
        Default: WGS 84, change with height to second order.
    gyro_bias, accelerometer_bias : (3,) array, optional
        Taken off: w - b (the sign of KZ(1.44) is wrong in print), f - b; rad/s, m/s^2.
    accelerometer_scale : (3,) array, optional
        s in (f - b)/(1 + s), KZ(1.45).

    Returns
    -------
    Trajectory

    Raises
    ------
    ValueError
        Wrong shapes, a value that is not finite, an interval that is not positive: with the sample at fault.
    EstimationError
        The body comes within 0.1 degrees of a pole, or its nose within 0.06 degrees of the vertical under "euler".

    Notes
    -----
    Free inertial: the height diverges (doubling in about ten minutes), the horizontal error swings with 84.4 minutes. "coning" is of third
    order on smooth motion, "matrix" of second, "euler" and "predictor_first_order" of first. Some 3 million samples/s a core.

    References
    ----------
    `spec/inertial.md` B3, KZ(1.28) to KZ(1.52); `spec/rail.md` 11, (1) to (8). Savage, P. G.: Strapdown inertial navigation integration
    algorithm design. J. Guidance, Control and Dynamics 21 (1 and 2), 1998.

    Examples
    --------
    >>> start = NavigationState(0.87, 0.5, 100.0)
    >>> earth, g = EARTH_RATE * np.array([np.cos(0.87), 0.0, -np.sin(0.87)]), GravityField().vector(0.87, 100.0)
    >>> rest = mechanize(start, 0.01, np.tile(earth, (1000, 1)), np.tile(-g, (1000, 1)))
    >>> float(np.abs(rest.velocity_n).max()) < 1e-10
    True
    """
    from railnav.inertial._kernels import strapdown_kernel

    if scheme not in _SCHEMES:
        raise ValueError(f"scheme {scheme!r} is none of {', '.join(_SCHEMES)}")
    w, f = _samples("rate_ib_b", rate_ib_b), _samples("specific_force_b", specific_force_b)
    if len(w) != len(f):
        raise ValueError(f"{len(w)} angular rates but {len(f)} specific forces")
    h = np.ascontiguousarray(np.broadcast_to(np.asarray(interval, dtype=np.float64), (len(w),)))
    wrong = np.flatnonzero(~((h > 0.0) & np.isfinite(h)))
    if wrong.size:
        raise ValueError(
            f"interval of sample {wrong[0]} is {h[wrong[0]]:g} s; it must be positive: sort the samples by time"
        )
    if gyro_bias is not None:
        w = w - _vector("gyro_bias", gyro_bias)
    if accelerometer_bias is not None:
        f = f - _vector("accelerometer_bias", accelerometer_bias)
    if accelerometer_scale is not None:
        f = f / (1.0 + _vector("accelerometer_scale", accelerometer_scale))
    out = np.empty((len(w) + 1, 10))
    out[0, 0], out[0, 1], out[0, 2] = start.latitude, start.longitude, start.height
    out[0, 3:6], out[0, 6:] = start.velocity_n, start.quaternion_nb
    done = strapdown_kernel(
        _SCHEMES[scheme], w * h[:, None], f * h[:, None], h, (gravity or _normal_field()).flat(), out
    )
    if done < len(w):
        if scheme == "euler" and abs(out[done, 0]) < 1.5:
            raise EstimationError(f"the nose stands vertical at sample {done}: use the scheme 'coning' or 'matrix'")
        raise EstimationError(
            f"within 0.1 degrees of a pole, or lost, at sample {done}: north and east are undefined there; check start, units and axes"
        )
    time = np.concatenate([[0.0], np.cumsum(h)])
    return Trajectory(time, out[:, 0], out[:, 1], out[:, 2], out[:, 3:6], out[:, 6:])


def _samples(name: str, value: ArrayLike) -> FloatArray:
    x = np.asarray(value, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3:
        raise ValueError(f"{name} must have the shape (n, 3), not {x.shape}")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if bad.size:
        raise ValueError(f"{name} of sample {bad[0]} is not finite; fill the gap or cut the log there")
    return x


def _vector(name: str, value: ArrayLike) -> FloatArray:
    x = np.asarray(value, dtype=np.float64)
    if x.shape != (3,) or not np.isfinite(x).all():
        raise ValueError(f"{name} must be three finite numbers")
    return x
