"""Two filters on one IMU: the wheel-aided one beside the GNSS-aided one, and what both say together."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError
from railnav.inertial.aided import AidedSolution, Rests, Unknowns, Vehicle, VehicleMotion, integrate
from railnav.inertial.aided.fusion import fuse
from railnav.inertial.error_model import position_scale
from railnav.inertial.imu_noise import InitialSigma
from railnav.inertial.mechanization import Trajectory
from railnav.navigation.schemes.streams import InertialSettings

FloatArray = NDArray[np.float64]
_DEGREE = math.pi / 180
#: How long the wheel-aided filter runs before it starts anew, while there are fixes, s.
RESTART = 60.0


def position_of(found: AidedSolution) -> tuple[FloatArray, FloatArray]:
    """Latitude, longitude, height, (n + 1, 3), and horizontal covariance, north and east, m^2, (n + 1, 2, 2)."""
    tr = found.trajectory
    P = np.empty((len(tr.time), 2, 2))
    P[:, 0, 0], P[:, 1, 1] = found.sigma[:, 0] ** 2, found.sigma[:, 1] ** 2
    P[:, 0, 1] = P[:, 1, 0] = found.covariance_north_east
    return np.stack([tr.latitude, tr.longitude, tr.height], axis=1), P


def wheel_filter(
    guide: AidedSolution,
    time: FloatArray,
    rate: FloatArray,
    force: FloatArray,
    rests: Rests,
    motion: VehicleMotion,
    told: FloatArray,
    assumed: InertialSettings,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Position, horizontal covariance, velocity and attitude of the wheel-aided filter, started anew from the GNSS-aided one."""
    fixed = told[told <= time[-1]]
    starts = [guide.trajectory.time[0]]
    for t in fixed.tolist():
        if t - starts[-1] >= RESTART and t < time[-1] - 1.0:
            starts.append(t)
    edges = np.searchsorted(time, starts, side="right")
    edges[0] = 0
    place, P = position_of(guide)
    place, P = place.copy(), P.copy()
    velocity, quaternion = guide.trajectory.velocity_n.copy(), guide.trajectory.quaternion_nb.copy()
    mounting, mounting_sigma, scale, scale_sigma = np.zeros(2), 2.0 * _DEGREE, 0.0, 0.02
    for first, last in zip(edges, [*edges[1:], len(time)], strict=True):
        if last <= first:
            continue
        begin = float(guide.trajectory.time[first])
        bias = {name: guide.parameters[name][first] for name in guide.parameters}
        spread = {name: float(guide.parameter_sigma[name][first].max()) for name in guide.parameter_sigma}
        part = slice(first, last)
        inside = (motion.time > begin) & (motion.time <= time[last - 1])
        still = (rests.time > begin) & (rests.time <= time[last - 1])
        rates = None if rests.rate_ib_b is None else (rests.rate_ib_b[still] - bias["gyro_bias"])
        sigma = guide.sigma[first]
        lateral, vertical = np.asarray(motion.sigma_lateral)[inside], np.asarray(motion.sigma_vertical)[inside]
        forward = None if motion.forward is None else motion.forward[inside] / (1.0 + scale)
        got = integrate(
            guide.trajectory.state(int(first)),
            InitialSigma(sigma[:3], sigma[3:6], sigma[6:9], spread["gyro_bias"], spread["accelerometer_bias"]),
            time[part],
            (rate[part] - bias["gyro_bias"]) / (1.0 + bias["gyro_scale"]),
            (force[part] - bias["accelerometer_bias"]) / (1.0 + bias["accelerometer_scale"]),
            assumed.noise,
            start_time=begin,
            rests=Rests(rests.time[still], rates, rests.sigma_velocity, rests.sigma_rate),
            vehicle_motion=VehicleMotion(
                motion.time[inside], forward, np.asarray(motion.sigma_forward)[inside], lateral, vertical
            ),
            vehicle=Vehicle(mounting=(float(mounting[0]), float(mounting[1]))),
            unknowns=Unknowns(
                axle_arm=1.0,
                mounting=mounting_sigma,
                odometer_scale=scale_sigma,
                gyro_scale=spread["gyro_scale"],
                accelerometer_scale=spread["accelerometer_scale"],
            ),
            gate={"vehicle": 20.0, "rests": 20.0},
        )
        place[first + 1 : last + 1], P[first + 1 : last + 1] = (x[1:] for x in position_of(got))
        velocity[first + 1 : last + 1] = got.trajectory.velocity_n[1:]
        quaternion[first + 1 : last + 1] = got.trajectory.quaternion_nb[1:]
        mounting = mounting + got.parameters["mounting"][-1]
        # what one piece learnt the next one may doubt a little
        mounting_sigma = max(1.5 * float(got.parameter_sigma["mounting"][-1].max()), 0.2 * _DEGREE)
        scale = (1.0 + scale) * (1.0 + float(got.parameters["odometer_scale"][-1, 0])) - 1.0
        scale_sigma = max(1.5 * float(got.parameter_sigma["odometer_scale"][-1, 0]), 1e-3)
    return place, P, velocity, quaternion


def fused_position(
    first: AidedSolution, place: FloatArray, covariance: FloatArray, velocity: FloatArray, quaternion: FloatArray
) -> tuple[FloatArray, FloatArray, Trajectory, FloatArray]:
    """Fused position and covariance, a trajectory with velocity and attitude of the filter that weighs more, weights of the first."""
    a, Pa = position_of(first)
    tr = first.trajectory
    scale = position_scale(tr.state(0))[:2]
    apart = (place[:, :2] - a[:, :2]) * scale
    try:
        both = fuse(np.zeros_like(apart), Pa, apart, covariance)
    except EstimationError as error:
        raise EstimationError(f"the two filters cannot be fused: {error}") from None
    fused = a.copy()
    fused[:, :2] += both.state / scale
    wheels = (both.weight < 0.5)[:, None]
    moving = Trajectory(
        tr.time,
        fused[:, 0],
        fused[:, 1],
        fused[:, 2],
        np.where(wheels, velocity, tr.velocity_n),
        np.where(wheels, quaternion, tr.quaternion_nb),
    )
    return fused, both.covariance, moving, both.weight
