"""Error model: printed entries and the printed updates of B6 and B8, perturbation of the mechanization, feedback, lever arm."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.attitude import dcm_from_rotation_vector, rotation_vector_from_dcm
from railnav.estimation.square_root import lower_root, predict, update
from railnav.geodesy import WGS84
from railnav.inertial.error_model import (
    ErrorState,
    error_dynamics,
    error_transition,
    feed_back,
    gnss_design,
    position_scale,
    process_noise_sqrt,
    vehicle_design,
)
from railnav.inertial.mechanization import NavigationState, mechanize

DEGREE = np.pi / 180
STATE = NavigationState.from_euler(
    48 * DEGREE,
    2 * DEGREE,
    100.0,
    velocity_n=[10, 5, -0.2],
    roll=1 * DEGREE,
    pitch=2 * DEGREE,
    heading=30 * DEGREE,
)
FORCE = np.array([0.2, 0.1, -9.8])
PRINTED = {
    (0, 2): -2.463809473e-13,
    (0, 3): 1.569652660079e-7,
    (1, 0): 1.298723612587e-6,
    (1, 2): -1.829992198e-13,
    (1, 4): 2.338751986397e-7,
    (3, 0): -4.966757581579e-4,
    (3, 3): -3.139305320e-8,
    (3, 4): -1.101199820175e-4,
    (3, 5): 1.569652660079e-6,
    (3, 7): 9.797774148414,
    (3, 8): 0.1636968263897,
    (4, 0): 1.015027906432e-3,
    (4, 6): -9.797774148414,
    (5, 2): -3.075788109448e-6,
    (5, 6): -0.1636968263897,
    (6, 0): -5.419097529036e-5,
    (6, 4): 1.564930534781e-7,
    (7, 3): -1.569652660079e-7,
    (8, 0): -5.054137831570e-5,
    (8, 4): -1.738031436766e-7,
}


def away(state, x):
    """The estimate that is off a true state by the error x."""
    return NavigationState.from_dcm(
        state.latitude + x[0],
        state.longitude + x[1],
        state.height + x[2],
        velocity_n=state.velocity_n + x[3:6],
        C_nb=dcm_from_rotation_vector(-np.asarray(x[6:9])) @ state.C_nb,
    )


def error(estimate, truth):
    return np.array(
        [
            estimate.latitude - truth.latitude,
            estimate.longitude - truth.longitude,
            estimate.height - truth.height,
            *(estimate.velocity_n - truth.velocity_n),
            *rotation_vector_from_dcm(truth.C_nb @ estimate.C_nb.T),
        ]
    )


def test_printed_entries():
    F = error_dynamics(STATE, FORCE)
    for place, value in PRINTED.items():
        assert F[place] == pytest.approx(value, rel=2e-10), place


def test_dynamics_are_the_derivative_of_the_mechanization():
    state = NavigationState.from_euler(
        48 * DEGREE, 2 * DEGREE, 300.0, velocity_n=[20, -15, 1], roll=0.09, pitch=-0.07, heading=2.27
    )
    w, f, h = np.array([0.02, -0.01, 0.1]), np.array([0.3, 0.5, -9.7]), 1e-3
    F = error_dynamics(state, f)
    sizes = np.array([1e-5, 1e-5, 10, 0.1, 0.1, 0.1, *[1e-4] * 6, *[1e-2] * 3])
    numeric = np.empty((9, 15))
    for j, size in enumerate(sizes):
        ends = []
        for sign in (1, -1):
            x = np.zeros(15)
            x[j] = sign * size
            estimate = mechanize(away(state, x), h, [w + x[9:12]], [f + x[12:]], scheme="matrix").state()
            ends.append(error(estimate, mechanize(state, h, [w], [f], scheme="matrix").state()))
        numeric[:, j] = ((ends[0] - ends[1]) / (2 * size) - np.eye(15)[:9, j]) / h
    # what the model leaves out on purpose: the radius' and gravity's change with latitude
    assert numeric[0, 0] == pytest.approx(-3.8e-8, rel=0.01)
    assert numeric[5, 0] - F[5, 0] == pytest.approx(0.0516, rel=0.01)
    F[0, 0], F[5, 0] = numeric[0, 0], numeric[5, 0]
    # a step of h has second-order parts: F h/2 of the largest entry of the row, from turning within the step
    # and 2 g/a is 0.7 % short of the change of normal gravity with height
    allowed = 8e-3 * np.abs(F[:9]) + h * np.abs(F[:9]) @ np.abs(F) + 2e-9 / sizes
    assert np.all(np.abs(numeric - F[:9]) <= allowed), np.argwhere(np.abs(numeric - F[:9]) > allowed)


def printed_filter():
    M, N = WGS84.meridian_radius(STATE.latitude), WGS84.transverse_radius(STATE.latitude)
    bias, force = 36 * DEGREE / 3600, 0.01962
    sigma = [2 / M, 2 / N, 3, 0.1, 0.1, 0.1, 0.3 * DEGREE, 0.3 * DEGREE, 3 * DEGREE, *[bias] * 3, *[force] * 3]
    noise = process_noise_sqrt(
        0.1,
        velocity_random_walk=1 / 60,
        angle_random_walk=4.5 * DEGREE / 60,
        gyro_bias_walk=10 * DEGREE / 3600 * np.sqrt(2 / 600),
        accelerometer_bias_walk=0.5e-3 * 9.81 * np.sqrt(2 / 600),
    )
    P_sqrt = predict(lower_root(np.diag(np.square(sigma))), error_transition(error_dynamics(STATE, FORCE), 0.1), noise)
    z = np.array([1, -2, 3, 0.05, -0.02, 0.01])
    return update(np.zeros(15), P_sqrt, z, gnss_design(STATE), np.diag([2, 2, 4, 0.1, 0.1, 0.1]))


def test_printed_gnss_update_in_square_root():
    x = printed_filter().state
    printed = (
        7.8680263e-8,
        -1.4482665e-7,
        1.0796834511,
        0.0251346428,
        -0.0102006062,
        0.0049467246,
        2.6562068e-5,
        6.6604913e-5,
        4.1214461e-5,
        -3.0981788e-9,
        -2.4733086e-9,
        -8.8465982e-11,
        6.3198342e-5,
        -8.0836562e-5,
        2.2854042e-5,
    )
    np.testing.assert_allclose(x, printed, rtol=2e-7)
    np.testing.assert_allclose((x * [*position_scale(STATE), *[1] * 12])[:2], (0.501259071, -0.619247560), atol=6e-9)


def test_printed_odometer_update():
    # as the check does it: the first correction is not fed back and not counted again
    before = printed_filter()
    z = STATE.C_nb.T @ STATE.velocity_n - [11, 0, 0]
    np.testing.assert_allclose(z, (0.160435412, -0.6664618214, 0.2012711007), atol=6e-10)
    x = update(np.zeros(15), before.P_sqrt, z, vehicle_design(STATE), 0.1 * np.eye(3)).state
    np.testing.assert_allclose(x[6:9], (1.3417658e-3, -2.6618313e-3, -5.6383045e-2), rtol=2e-7)
    np.testing.assert_allclose(x[3:6], (0.064592185, 0.0214082871, 0.0502573185), rtol=2e-8)
    forward = NavigationState.from_euler(0.8, 0, 0, pitch=2 * DEGREE, heading=30 * DEGREE).C_nb @ [11, 0, 0]
    np.testing.assert_allclose(forward, (9.5204762896, 5.4966495486, -0.3838944637), atol=6e-11)


def test_designs_are_derivatives():
    arm, w = np.array([1.2, 0.3, -3.0]), np.array([0.02, -0.05, 0.1])
    sizes = np.array([1e-7, 1e-7, 1e-2, 1e-3, 1e-3, 1e-3, *[1e-5] * 3, *[1e-5] * 3, *[1e-3] * 3])

    def antenna(state, rate):
        place = state.C_nb @ arm
        up = np.array([1, 1, -1]) * place
        whole = np.array([state.latitude, state.longitude, state.height]) * position_scale(STATE) + up
        return np.concatenate([whole, state.velocity_n + state.C_nb @ np.cross(rate, arm)])

    H, V = gnss_design(STATE, lever_arm_b=arm, rate_nb_b=w), vehicle_design(STATE)
    for j, size in enumerate(sizes):
        x = np.zeros(15)
        x[j] = size
        # about the estimate: the truth is the estimate less its error
        truth = feed_back(STATE, x)
        change = (antenna(STATE, w) - antenna(truth, w - x[9:12])) / size
        np.testing.assert_allclose(H[:, j], change, rtol=1e-4, atol=1e-4 * max(1, np.abs(H[:, j]).max()))
        body = (STATE.C_nb.T @ STATE.velocity_n - truth.C_nb.T @ truth.velocity_n) / size
        np.testing.assert_allclose(V[:, j], body, atol=2e-4)


def test_feedback_undoes_an_error():
    rng = np.random.default_rng(0)
    x = rng.normal(size=15) * [1e-6, 1e-6, 5, 1, 1, 1, 0.02, 0.02, 0.1, *[1e-5] * 3, *[1e-2] * 3]
    back = feed_back(away(STATE, x), x)
    np.testing.assert_allclose(error(back, STATE), 0.0, atol=1e-12)


def test_transition_and_noise():
    F = error_dynamics(STATE, FORCE, gyro_correlation_time=600.0)
    assert F[ErrorState.GYRO_BIAS_Y, ErrorState.GYRO_BIAS_Y] == -1 / 600
    from scipy.linalg import expm

    np.testing.assert_allclose(error_transition(F, 0.01), expm(F * 0.01), atol=2e-6)
    root = process_noise_sqrt(
        0.25, velocity_random_walk=1.0, angle_random_walk=2.0, gyro_bias_walk=3.0, accelerometer_bias_walk=4.0
    )
    np.testing.assert_allclose(np.diagonal(root @ root.T), [0] * 3 + [0.25] * 3 + [1.0] * 3 + [2.25] * 3 + [4.0] * 3)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: error_dynamics(STATE, [0.0, 0.0]), "three finite"),
        (lambda: error_dynamics(STATE, FORCE, gyro_correlation_time=0.0), "correlation"),
        (lambda: feed_back(STATE, np.zeros(9)), "fifteen"),
        (
            lambda: process_noise_sqrt(
                0.1, velocity_random_walk=-1.0, angle_random_walk=0, gyro_bias_walk=0, accelerometer_bias_walk=0
            ),
            "negative",
        ),
    ],
)
def test_refusals_say_why(call, words):
    with pytest.raises(ValueError, match=words):
        call()
