"""Fine alignment: strapdown with zero-velocity updates in an iterated square-root filter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import (
    dcm_from_quaternion,
    dcm_from_rotation_vector,
    euler_from_dcm,
    orthonormalise,
    propagate,
    rotation_vector_from_dcm,
    skew,
)
from railnav.errors import EstimationError
from railnav.inertial._shapes import three
from railnav.inertial.alignment import Alignment
from railnav.inertial.mechanization import EARTH_RATE, NavigationState, mechanize

FloatArray = NDArray[np.float64]


#: Passes of the fine alignment, each about the result of the last.
_PASSES = 4


@dataclass(frozen=True, slots=True, eq=False)
class FineAlignment:
    """Attitude after a static filter.

    Attributes
    ----------
    C_nb : (3, 3) array
        Attitude at the end.
    sigma_attitude_n : (3,) array
        Of its error as a small turn about north, east, down, rad; the third is the heading's.
    gyro_bias, accelerometer_bias : (3,) array
        Estimates, rad/s and m/s^2.
    sigma_gyro_bias, sigma_accelerometer_bias : (3,) array
        Their sigmas; those that rest cannot show stay at what was given.
    covariance : (12, 12) array
        Of velocity error, attitude error, gyro bias and accelerometer bias.
    nis : float
        Mean normalised innovation squared of a zero-velocity update, over its 3 degrees of freedom: 1 if the noise given is right.
    """

    C_nb: FloatArray
    sigma_attitude_n: FloatArray
    gyro_bias: FloatArray
    accelerometer_bias: FloatArray
    sigma_gyro_bias: FloatArray
    sigma_accelerometer_bias: FloatArray
    covariance: FloatArray
    nis: float

    @property
    def roll(self) -> float:
        """Right side down, rad."""
        return float(euler_from_dcm(self.C_nb)[0])

    @property
    def pitch(self) -> float:
        """Nose up, rad."""
        return float(euler_from_dcm(self.C_nb)[1])

    @property
    def heading(self) -> float:
        """Clockwise from true north, rad."""
        return float(euler_from_dcm(self.C_nb)[2])


def fine_align(
    start: Alignment | FloatArray,
    interval: float,
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    latitude: float,
    *,
    height: float = 0.0,
    initial_sigma: ArrayLike | None = None,
    gyro_bias_sigma: float,
    accelerometer_bias_sigma: float,
    angle_random_walk: float,
    velocity_random_walk: float,
    velocity_sigma: float = 1e-3,
    update_every: float = 1.0,
) -> FineAlignment:
    """Refine the attitude of a base at rest that may shake: strapdown with zero-velocity updates in an iterated square-root filter.

    Errors: velocity, attitude (R_true = (I + [eps x]) R_est), biases. dv' = [f_n x] eps + C ba - (2 w_ie) x dv,
    eps' = -w_in x eps - C bg the coupling of dv to the frame rate left out. The linear filter is
    run again about its own result: fed back step by step, a tilt of 0.3 degrees would pass for a drift, and that for a heading.

    Parameters
    ----------
    start : Alignment or (3, 3) array
        Coarse attitude; errors within some 10 degrees in heading and 1 degree in level.
    interval : float
        Sampling interval, s.
    rate_ib_b, specific_force_b : (n, 3) array
        Samples, rad/s and m/s^2.
    latitude, height : float
        rad, m.
    initial_sigma : (3,) array, optional
        Of the coarse attitude as a turn about north, east, down, rad; default: from `start`.
    gyro_bias_sigma, accelerometer_bias_sigma : float
        Prior of the biases, rad/s and m/s^2.
    angle_random_walk, velocity_random_walk : float
        Densities of the noise, rad/sqrt(s) and m/s/sqrt(s).
    velocity_sigma : float, optional
        How still the base is over an update, m/s.
    update_every : float, optional
        s between zero-velocity updates.

    Returns
    -------
    FineAlignment

    Raises
    ------
    ValueError
        Wrong shapes, values that are not finite.
    EstimationError
        Innovations far beyond their sigma: the base moves, or the noise is not what was stated.

    Notes
    -----
    Rest shows level, the north and down gyro biases relative to the heading, and the vertical accelerometer bias; it cannot tell the east
    gyro bias from a heading error, nor horizontal accelerometer biases from tilt. Those sigmas stay at what the priors say: heading
    sigma = gyro_bias_sigma/(Omega cos(lat)).

    References
    ----------
    `spec/inertial.md` A6, B6, B10.

    Examples
    --------
    >>> from railnav.attitude import dcm_from_euler
    >>> from railnav.inertial import GravityField
    >>> n, earth = 6000, EARTH_RATE * np.array([np.cos(0.9), 0.0, -np.sin(0.9)])
    >>> force = -GravityField().vector(0.9)
    >>> kind = {"gyro_bias_sigma": 1e-8, "accelerometer_bias_sigma": 1e-4, "angle_random_walk": 1e-7, "velocity_random_walk": 1e-5}
    >>> tilted = dcm_from_euler(0.001, -0.001, 0.01)
    >>> found = fine_align(tilted, 0.01, [earth] * n, [force] * n, 0.9, initial_sigma=[1e-3, 1e-3, 1e-2], **kind)
    >>> abs(found.roll) < 1e-5, abs(found.heading) < 2e-3
    (True, True)
    """
    from railnav.estimation.square_root import lower_root, predict, update

    w, f = (np.asarray(v, dtype=np.float64) for v in (rate_ib_b, specific_force_b))
    if w.ndim != 2 or w.shape[1] != 3 or w.shape != f.shape:
        raise ValueError(f"needs rates and specific forces (n, 3), not {w.shape} and {f.shape}")
    if isinstance(start, Alignment):
        C = start.dcm()
        if initial_sigma is None:
            level_sigma = math.hypot(start.sigma_roll, start.sigma_pitch)
            initial_sigma = (level_sigma, level_sigma, start.sigma_heading)
    else:
        C = orthonormalise(start)
    if initial_sigma is None:
        raise ValueError("initial_sigma is needed with a matrix: about north, east, down, rad")
    per_update = max(1, round(update_every / interval))
    count = len(w) // per_update
    if count < 2:
        raise ValueError(f"{len(w)} samples are shorter than two updates of {update_every} s")
    h = per_update * interval
    rate_e = EARTH_RATE * np.array([math.cos(latitude), 0.0, -math.sin(latitude)])
    sigma0 = np.concatenate(
        [
            np.full(3, velocity_sigma),
            three("initial_sigma", initial_sigma),
            np.full(3, gyro_bias_sigma),
            np.full(3, accelerometer_bias_sigma),
        ]
    )
    prior_sqrt = lower_root(np.diag(np.maximum(sigma0, 1e-15) ** 2))
    H = np.hstack([np.eye(3), np.zeros((3, 9))])
    R_sqrt = velocity_sigma * np.eye(3)
    noise = np.zeros((12, 6))
    noise[:3, :3] = velocity_random_walk * math.sqrt(h) * np.eye(3)
    noise[3:6, 3:] = angle_random_walk * math.sqrt(h) * np.eye(3)
    begin, bg, ba = C, np.zeros(3), np.zeros(3)
    for _ in range(_PASSES):
        # one linear filter about a fixed strapdown run: nothing is fed back, so that no direction gains knowledge it has not
        x = np.concatenate([np.zeros(3), rotation_vector_from_dcm(C @ begin.T), -bg, -ba])
        P_sqrt, turned, nis = prior_sqrt, begin, 0.0
        for k in range(count):
            piece = slice(k * per_update, (k + 1) * per_update)
            end = mechanize(
                NavigationState.from_dcm(latitude, 0.0, height, C_nb=turned),
                interval,
                w[piece],
                f[piece],
                gyro_bias=bg,
                accelerometer_bias=ba,
            ).state()
            force_n = turned @ (f[piece].mean(axis=0) - ba)
            F = np.zeros((12, 12))
            F[:3, :3], F[:3, 3:6], F[:3, 9:] = -2.0 * skew(rate_e), skew(force_n), turned
            F[3:6, 3:6], F[3:6, 6:9] = -skew(rate_e), -turned
            Phi = np.eye(12) + F * h + 0.5 * (F @ F) * h * h + (F @ F @ F) * h**3 / 6.0
            noise[:3, 3:] = 0.5 * h * skew(force_n) @ noise[3:6, 3:]
            P_sqrt = predict(P_sqrt, Phi, noise)
            x = Phi @ x
            done = update(
                x, P_sqrt, end.velocity_n - x[:3], H, R_sqrt
            )  # at rest the velocity found is the error of the velocity
            x, P_sqrt, nis = done.state, done.P_sqrt, nis + done.nis / (3.0 * count)
            x[:3] -= end.velocity_n  # the next piece starts at rest
            turned = end.C_nb
        found = dcm_from_rotation_vector(x[3:6]) @ turned
        bg, ba = bg + x[6:9], ba + x[9:]
        # the start that leads there with the biases found, for the next pass
        turns = propagate([1.0, 0.0, 0.0, 0.0], interval * (w[: count * per_update] - bg))[-1]
        back = dcm_from_rotation_vector(rate_e * h * count)
        free = back.T @ begin @ dcm_from_quaternion(turns)
        step = back @ rotation_vector_from_dcm(found @ free.T)
        begin = dcm_from_rotation_vector(step) @ begin
        if float(np.linalg.norm(step)) < 1e-8:
            break
    if nis > 2.0 + 6.0 * math.sqrt(2.0 / (3.0 * count)):
        raise EstimationError(
            f"zero-velocity updates miss by {math.sqrt(nis):.1f} sigma: the base moves, or the noise or biases are larger than stated"
        )
    covariance = P_sqrt @ P_sqrt.T
    sigma = np.sqrt(np.diagonal(covariance))
    return FineAlignment(found, sigma[3:6], bg, ba, sigma[6:9], sigma[9:], covariance, nis)
