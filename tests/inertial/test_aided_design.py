"""The aided filter's rows and transition against perturbation, and one step of it against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.attitude import dcm_from_euler, quaternion_from_dcm
from railnav.estimation.square_root import predict, update
from railnav.geodesy import WGS84
from railnav.inertial.aided import _kernels as kernels
from railnav.inertial.aided import layout as k
from railnav.inertial.aided.aiding import Fixes, Ranges, Rests, VehicleMotion
from railnav.inertial.aided.integration import integrate
from railnav.inertial.aided.unknowns import Unknowns, Vehicle
from railnav.inertial.error_model import error_dynamics, position_scale
from railnav.inertial.imu_noise import ImuNoise, InitialSigma
from railnav.inertial.mechanization import GravityField, NavigationState, mechanize

FIELD = GravityField().flat()
#: antenna, axle, mounting, time, odometer, clock, gyro scale, accelerometer scale, gyro bias, accelerometer bias
AT = np.array([0, 3, 6, 8, 9, 10, 12, 15, 18, 21])
NINE, N = 24, 33
SCALE = position_scale(NavigationState(0.85, 0.3, 150.0))


def unit(c):
    """Size of a perturbation of each state."""
    return 1e-3 / SCALE[c - NINE - 6] if c >= NINE + 6 else 1e-5


def situation():
    rng = np.random.default_rng(1)
    state = np.empty(10)
    state[:3] = 0.85, 0.3, 150.0
    state[3:6] = 12.0, -7.0, 0.4
    state[6:] = quaternion_from_dcm(dcm_from_euler(0.05, -0.03, -0.5))
    value = rng.normal(0, 0.01, NINE)
    value[AT[k.ANTENNA] : AT[k.ANTENNA] + 6] = rng.normal(0, 1.0, 6)
    value[AT[k.CLOCK] : AT[k.CLOCK] + 2] = 2.0, 40.0
    turn = np.array([0.02, -0.05, 0.3]) * 0.01
    nominal = np.array([1.0, 0.5, -2.0, -1.5, 0.2, 1.0, 0.02, -0.03])
    satellite = np.array(WGS84.to_cartesian(0.7, 0.6, 2.0e7)) if hasattr(WGS84, "to_cartesian") else None
    if satellite is None:
        w = WGS84.semi_major_axis / np.sqrt(1 - WGS84.eccentricity_squared * np.sin(0.7) ** 2) + 2.0e7
        satellite = w * np.array([np.cos(0.7) * np.cos(0.6), np.cos(0.7) * np.sin(0.6), np.sin(0.7)])
    return state, value, turn, nominal, satellite


def rows(kind, data, state, value, turn, nominal, age=0.0):
    z, H = np.empty(6), np.empty((6, N))
    acceleration = np.array([0.3, -0.2, 0.1])
    kernels.innovations(
        kind, data, age, state, value, AT, NINE, nominal, turn, 0.01, acceleration, FIELD, np.empty((3, 3)), z, H
    )
    return z, H


@pytest.mark.parametrize(("kind", "count"), [(k.FIX, 6), (k.BODY, 3), (k.REST, 6), (k.RANGE, 2)])
def test_rows_are_the_derivatives_of_the_innovation(kind, count):
    """z(estimate) - z(estimate less an error x) = H x, for every state that the measurement sees."""
    state, value, turn, nominal, satellite = situation()
    if kind == k.REST:
        state[3:6] = 0.0
    data = np.array([0.85, 0.3, 150.0, 12.0, -7.0, 0.4, 0.0, 0.0])
    if kind == k.RANGE:
        data = np.concatenate([satellite, [800.0, -2500.0, 1200.0], [2.1e7, 100.0]])
    z, H = rows(kind, data, state, value, turn, nominal)
    after, shifted = np.empty(10), np.empty(NINE)
    for c in range(N):
        if AT[k.GYRO_SCALE] <= c < AT[k.GYRO_BIAS]:
            assert not H[:count, c].any()  # of second order where the arms count
            continue
        x = np.zeros(N)
        x[c] = unit(c)
        kernels.corrected(state, value, x, NINE, after, shifted)
        moved = turn - x[AT[k.GYRO_BIAS] : AT[k.GYRO_BIAS] + 3] * 0.01
        other, _ = rows(kind, data, after, shifted, moved, nominal)
        slope = (z - other)[:count] / x[c]
        if kind == k.RANGE and c >= NINE + 6:  # the line of sight turns little over 20,000 km: left out of range rates
            assert abs((z - other)[1]) < 1e-6
            slope[1] = H[1, c]
        np.testing.assert_allclose(H[:count, c], slope, rtol=2e-3, atol=1e-2)


def test_a_step_with_scale_factors_equals_the_dense_reference():
    noise = ImuNoise(1e-4, 2e-3, 3e-5, 4e-3, 200.0, 300.0)
    initial = InitialSigma(np.full(3, 2.0), np.full(3, 0.2), np.array([0.01, 0.01, 0.05]), 1e-4, 0.01)
    extra = Unknowns(gyro_scale=0.01, accelerometer_scale=0.02, gyro_scale_walk=1e-4, accelerometer_scale_walk=2e-4)
    start = NavigationState.from_euler(0.85, 0.3, 150.0, velocity_n=[10, -3, 0.5], roll=0.02, pitch=-0.03, heading=2.0)
    w, f, h = np.array([0.01, -0.02, 0.3]), np.array([0.7, 1.2, -9.7]), 0.02
    free = mechanize(start, h, [w], [f]).state()
    z = np.array([1.2, -0.7, 2.0, 0.05, -0.02, 0.03])
    here = position_scale(free)
    fixes = Fixes(
        [h],
        [np.array([free.latitude, free.longitude, free.height]) - z[:3] / here],
        [1.5, 1.5, 3.0],
        [free.velocity_n - z[3:]],
        [0.1] * 3,
    )
    got = integrate(start, initial, [h], [w], [f], noise, start_time=0.0, fixes=fixes, unknowns=extra, gate=1e9)
    # order of the filter: scales, biases, attitude, velocity, position
    F15 = error_dynamics(start, f, gyro_correlation_time=200.0, accelerometer_correlation_time=300.0)
    order = [*range(9, 15), 6, 7, 8, 3, 4, 5, 0, 1, 2]
    F = np.zeros((21, 21))
    F[6:, 6:] = F15[np.ix_(order, order)]
    F[12:15, 0:3] = -start.C_nb * w
    F[15:18, 3:6] = start.C_nb * f
    densities = np.concatenate(
        [
            [1e-4] * 3,
            [2e-4] * 3,
            [3e-5 * np.sqrt(2 / 200)] * 3,
            [4e-3 * np.sqrt(2 / 300)] * 3,
            [1e-4] * 3,
            [2e-3] * 3,
            [0.0] * 3,
        ]
    )
    sigma = [
        *[0.01] * 3,
        *[0.02] * 3,
        *[1e-4] * 3,
        *[0.01] * 3,
        0.01,
        0.01,
        0.05,
        *[0.2] * 3,
        *(2.0 / position_scale(start)),
    ]
    P_sqrt = predict(np.diag(sigma), np.eye(21) + F * h, np.diag(densities * np.sqrt(h))[:, :18])
    H = np.zeros((6, 21))
    H[:3, 18:], H[3:, 15:18] = np.diag(here), np.eye(3)
    done = update(np.zeros(21), P_sqrt, z, H, np.diag([1.5, 1.5, 3.0, 0.1, 0.1, 0.1]))
    np.testing.assert_allclose(got.P_sqrt, done.P_sqrt, rtol=1e-6, atol=1e-15)
    assert np.nansum(got.nis["fixes"]) == pytest.approx(done.nis, rel=1e-9)
    np.testing.assert_allclose(got.parameters["gyro_scale"][-1], done.state[:3], rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(got.parameters["accelerometer_bias"][-1], done.state[9:12], rtol=1e-6, atol=1e-15)
    assert got.states[:2] == ("gyro_scale_x", "gyro_scale_y")
    assert len(got.states) == 21


def test_the_printed_odometer_update():
    """B8: the printed innovation of the body-frame form after the printed state, here with the state alone."""
    state = NavigationState.from_euler(
        np.radians(48),
        np.radians(2),
        100.0,
        velocity_n=[10, 5, -0.2],
        roll=np.radians(1),
        pitch=np.radians(2),
        heading=np.radians(30),
    )
    flat = np.array([state.latitude, state.longitude, state.height, *state.velocity_n, *state.quaternion_nb])
    z, H = np.empty(6), np.empty((6, N))
    value = np.zeros(NINE)
    kernels.innovations(
        k.BODY,
        np.array([11.0, *[0.0] * 7]),
        0.0,
        flat,
        value,
        AT,
        NINE,
        np.zeros(8),
        np.zeros(3),
        0.1,
        np.zeros(3),
        FIELD,
        np.empty((3, 3)),
        z,
        H,
    )
    from railnav.inertial.error_model import vehicle_design

    np.testing.assert_allclose(z[:3], state.C_nb.T @ state.velocity_n - [11.0, 0, 0], atol=1e-12)
    plain = vehicle_design(state)
    np.testing.assert_allclose(H[:3, NINE : NINE + 3], plain[:, 6:9], atol=1e-9)
    np.testing.assert_allclose(H[:3, NINE + 3 : NINE + 6], plain[:, 3:6], atol=1e-12)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Fixes([0.0, 0.0], np.zeros((2, 3)), [1.0] * 3), "increase"),
        (lambda: Fixes([0.0], [[48.0, 2.0, 100.0]], [1.0] * 3), "radians"),
        (lambda: Fixes([0.0], np.zeros((1, 3)), [0.0] * 3), "sigma_position"),
        (lambda: Fixes([0.0], np.zeros((1, 3)), [1.0] * 3, np.zeros((1, 3))), "come together"),
        (lambda: VehicleMotion([0.0, 1.0], forward=[1.0]), "shape"),
        (lambda: VehicleMotion([0.0], sigma_lateral=np.nan), "sigma_lateral"),
        (lambda: Rests([0.0], sigma_velocity=0.0), "positive"),
        (lambda: Ranges([0.0], np.zeros((1, 3)), np.zeros((1, 3)), [np.nan], [0.0]), "not finite"),
        (lambda: Unknowns(antenna_arm=-1.0), "antenna_arm"),
    ],
)
def test_what_aids_is_checked(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_requests_that_cannot_be_met_are_refused():
    start = NavigationState(0.85, 0.3, 150.0)
    initial = InitialSigma(np.full(3, 2.0), np.full(3, 0.2), np.full(3, 0.01), 1e-4, 0.01)
    still = ([0.01], [[0.0] * 3], [[0.0, 0, -9.8]], ImuNoise(1e-4, 1e-3))
    ranges = Ranges([0.01], [[2e7, 0, 0]], [[0.0] * 3], [1.4e7], [0.0])
    with pytest.raises(ValueError, match="clock"):
        integrate(start, initial, *still, start_time=0.0, ranges=ranges)
    with pytest.raises(ValueError, match="closed loop"):
        integrate(start, initial, *still, start_time=0.0, closed_loop=False, smooth=True)
    with pytest.raises(ValueError, match="arms"):
        integrate(start, initial, *still, start_time=0.0, vehicle=Vehicle(antenna_arm_b=(0.0, np.nan, 0.0)))
