"""Measurement equations, square-root steps and protection levels against dense algebra and outside numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numba import njit
from scipy import stats

from railnav.estimation._kernels import predict_kernel, update_scalar_kernel
from railnav.matching import _kernels as paths
from railnav.matching.network import pack_network
from railnav.navigation import Settings, State, layout
from railnav.navigation import columns as c
from railnav.navigation.dynamics import _kernels as dynamics
from railnav.navigation.integrity import normal_quantile, protection_level
from railnav.navigation.measurements import _kernels as equations
from railnav.navigation.measurements import specific_force, yaw_rate
from railnav.track.model import TrackPoints
from railnav.units import RAIL_CENTRE_DISTANCE, STANDARD_GRAVITY

# parts of the compiled loop cannot be called from Python: small doors to them


@njit
def do_predict(x, P_sqrt, F, Q, lead, count, new):
    dynamics.predict(x, P_sqrt, F, Q, lead, count, new, 0)


@njit
def do_transition(fil, x, dt, sign, force, rough, pull, slip, shake, step, tag, travel, stretch, F, Q, lead, new):
    return dynamics.transition(
        fil, x, dt, sign, force, rough, pull, slip, shake, step, tag, travel, stretch, dt, F, Q, lead, new
    )


@njit
def do_absorb(x, P_sqrt, h, innovation, variance, f, keep, move):
    s = dynamics.project(P_sqrt, h, f) + variance
    dynamics.absorb(x, P_sqrt, f, innovation, variance, keep, move)
    return s


@njit
def do_robust(x, P_sqrt, h, innovation, variance, f, keep, move):
    return dynamics.robust_row(x, P_sqrt, h, innovation, variance, f, keep, move)


@njit
def do_reweigh(x, P_sqrt, old, new, f, column, keep, move):
    return dynamics.reweigh_frame(x, P_sqrt, old, new, f, column, keep, move)


@njit
def do_antenna(point, lever, out):
    equations.antenna(point, lever, out)


@njit
def do_merge(bank, a, b, shift, position, column):
    paths.merge(bank, a, b, shift, position, column)


def a_filter(at, settings=None, signed=0):
    return c.Filter(at, (settings or Settings()).packed(), np.zeros(3), np.array([1e-4, 3.9, 0.0]), signed)


def a_root(rng, n):
    return np.linalg.cholesky((lambda a: a @ a.T / n + 0.1 * np.eye(n))(rng.standard_normal((n, n))))


def points(curvature, gradient, cant):
    one = np.zeros(1)
    return TrackPoints(one, one, one, one, one, np.array([curvature]), np.array([gradient]), np.array([cant]), one)


def test_TV13_yaw_rate_and_specific_force():
    # witness: specification rail.md 25, TV13: v 22, kappa 1/700, alpha .006, kappa_v 2e-6, phi .07, g 9.81; there axes are forward,
    # left, up, curves to the left and the right rail high: mirrored into ours
    alpha, kappa_v, phi = 0.006, 2e-6, 0.07
    here = points(1 / 700, math.tan(alpha), RAIL_CENTRE_DISTANCE * math.sin(phi))
    rate = kappa_v / math.cos(alpha) ** 2
    assert yaw_rate(22.0, here, gradient_rate=rate)[0] == pytest.approx(0.031347961, abs=1e-9)
    force = specific_force(22.0, 0.0, here, gradient_rate=rate, gravity=9.81)[0]
    assert force == pytest.approx([0.058859647, 0.003528161, -9.835124407], abs=1e-9)


def test_at_rest_on_level_track_only_gravity_is_felt():
    force = specific_force(0.0, 0.0, points(0.002, 0.0, 0.0))[0]
    assert force == pytest.approx([0.0, 0.0, -STANDARD_GRAVITY], abs=1e-12)


def test_running_the_other_way_mirrors_what_is_felt():
    """Reversing the path flips curvature, gradient and cant: the yaw rate and the side force change sign, the weight does not."""
    there = specific_force(20.0, 0.3, points(1 / 500, 0.01, 0.09))[0]
    back = specific_force(20.0, 0.3, points(-1 / 500, -0.01, -0.09))[0]
    assert back[1:] == pytest.approx([-there[1], there[2]], abs=1e-12)
    assert yaw_rate(20.0, points(-1 / 500, 0.0, -0.09))[0] == pytest.approx(
        -yaw_rate(20.0, points(1 / 500, 0.0, 0.09))[0]
    )


@pytest.mark.parametrize("way", [1, -1])
def test_antenna_derivative_by_differences(curve, way):
    """t + omega x lever is the antenna's derivative along the path; cant and grade change too slowly to matter to a millimetre a metre."""
    network = pack_network(curve)
    lever = np.array([6.0, 0.7, -3.8])
    point, here, ahead, behind = np.empty(paths.POINT_SIZE), np.empty(4), np.empty(4), np.empty(4)
    h = 0.5
    for s in (300.0, 1234.5, 2500.0, 4321.0):
        for where, out in ((s, here), (s + h, ahead), (s - h, behind)):
            paths.track_point(network, 0, way, where, point)
            do_antenna(point, lever, out)
        assert (ahead[:2] - behind[:2]) / (2 * h) == pytest.approx(here[2:], abs=2e-3)


def test_packed_geometry_is_the_models(curve):
    network = pack_network(curve)
    point = np.empty(paths.POINT_SIZE)
    for offset in np.linspace(0.0, float(network.length[0]), 97):
        paths.track_point(network, 0, 1, float(offset), point)
        there = curve.at("A", offset)
        assert point[paths.P_EAST] == pytest.approx(float(there.easting), abs=1e-6)
        assert point[paths.P_NORTH] == pytest.approx(float(there.northing), abs=1e-6)
        bearing = math.atan2(point[paths.P_D_EAST], point[paths.P_D_NORTH])
        assert bearing == pytest.approx(float(there.grid_bearing), abs=1e-6)
        assert point[paths.P_CURVATURE] == pytest.approx(float(there.curvature), abs=1e-12)
        paths.track_point(network, 0, -1, float(network.length[0] - offset), point)
        assert point[paths.P_CURVATURE] == pytest.approx(-float(there.curvature), abs=1e-9)
        assert point[paths.P_GRADIENT] == pytest.approx(-float(there.gradient), abs=1e-9)


LAYOUTS = [
    {"imu": False, "odometer": ""},
    {"imu": True, "odometer": "distance"},
    {"imu": False, "odometer": "distance"},
    {"imu": True, "odometer": "", "speed": False},
    {"imu": True, "odometer": "distance", "map_error": True},
]


@pytest.mark.parametrize("streams", LAYOUTS)
@pytest.mark.parametrize("dt", [0.1, 1.0])
def test_transition_is_the_derivative_of_the_prediction(streams, dt):
    at = layout(**streams)
    n = int(at.max()) + 1
    fil = a_filter(at)
    rng = np.random.default_rng(3)
    x = 0.1 * rng.standard_normal(n)
    x[at[State.SPEED]] = 17.0
    x[at[State.POSITION]] = 250.0
    F, Q, lead, new = np.empty((n, n)), np.empty((c.NOISES, n)), np.empty(c.NOISES, np.int64), np.empty(n)

    def step(state):
        do_transition(fil, state, dt, 1.0, 0.4, 0.0, 0.05, 0.0, 0.0, 0.0, 0.0, 7.0, 0.0, F, Q, lead, new)
        return new.copy()

    step(x)
    derivative = F.copy()
    assert np.array_equal(derivative, np.tril(derivative))
    for j in range(n):
        e = np.zeros(n)
        e[j] = 1e-4
        numeric = (step(x + e) - step(x - e)) / 2e-4
        assert derivative[:, j] == pytest.approx(numeric, abs=1e-6)


@pytest.mark.parametrize("streams", LAYOUTS)
def test_prediction_equals_the_dense_one(streams):
    """Against F P F' + Q and against the estimation room's kernel."""
    at = layout(**streams)
    n = int(at.max()) + 1
    rng = np.random.default_rng(5)
    x, P_sqrt = rng.standard_normal(n), a_root(rng, n)
    F, Q, lead, new = np.empty((n, n)), np.zeros((c.NOISES, n)), np.empty(c.NOISES, np.int64), np.empty(n)
    count = do_transition(a_filter(at), x, 0.7, 1.0, 0.3, 0.1, 0.0, 4.0, 0.1, 0.2, 0.3, 90.0, 0.5, F, Q, lead, new)
    noise = Q[:count].copy()
    dense = F @ P_sqrt @ P_sqrt.T @ F.T + noise.T @ noise
    other = P_sqrt.copy()
    predict_kernel(other, F, np.ascontiguousarray(noise.T))
    mean = new.copy()
    do_predict(x, P_sqrt, F, Q, lead, count, new)
    assert np.array_equal(x, mean)
    assert np.array_equal(P_sqrt, np.tril(P_sqrt))
    assert P_sqrt @ P_sqrt.T == pytest.approx(dense, abs=1e-11)
    assert P_sqrt == pytest.approx(other, abs=1e-11)


def test_process_noise_adds_up_over_steps():
    """Two steps of half the length make the same covariance as one: the discretisation is exact."""
    at = layout(imu=True, odometer="")
    n = int(at.max()) + 1
    fil = a_filter(at)

    def spread(steps, dt):
        x, P_sqrt = np.zeros(n), 1e-9 * np.eye(n)
        F, Q, lead, new = np.empty((n, n)), np.zeros((c.NOISES, n)), np.empty(c.NOISES, np.int64), np.empty(n)
        for _ in range(steps):
            count = do_transition(fil, x, dt, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 20.0 * dt, 0.0, F, Q, lead, new)
            do_predict(x, P_sqrt, F, Q, lead, count, new)
        return P_sqrt @ P_sqrt.T

    i = [int(at[State.SPEED]), int(at[State.POSITION]), int(at[State.GNSS_EAST]), int(at[State.SPEED_ERROR])]
    once, often = spread(1, 2.0), spread(8, 0.25)
    # speed and position take their noise from the accelerometer's white part; its bias walks once a step
    assert often[np.ix_(i, i)] == pytest.approx(once[np.ix_(i, i)], rel=2e-3, abs=1e-12)


def test_scalar_row_equals_the_dense_kalman_step():
    rng = np.random.default_rng(7)
    n = 9
    x, P_sqrt, h = rng.standard_normal(n), a_root(rng, n), rng.standard_normal(n)
    h[[1, 4]] = 0.0
    P = P_sqrt @ P_sqrt.T
    s = h @ P @ h + 0.3
    gain = P @ h / s
    expected = x + gain * 1.7
    other_x, other = x.copy(), P_sqrt.copy()
    update_scalar_kernel(other_x, other, h, 1.7, 0.3)
    got = do_absorb(x, P_sqrt, h, 1.7, 0.3, np.empty(n), np.empty(n), np.empty(n))
    assert got == pytest.approx(s)
    assert x == pytest.approx(expected, abs=1e-12)
    assert P_sqrt @ P_sqrt.T == pytest.approx(P - np.outer(gain, gain) * s, abs=1e-12)
    assert P_sqrt == pytest.approx(other, abs=1e-12)
    assert np.all(np.diag(P_sqrt) > 0)


def test_evidence_of_a_row_is_its_log_density_and_saturates():
    rng = np.random.default_rng(8)
    n = 4
    P_sqrt, h = a_root(rng, n), rng.standard_normal(n)
    s = float(h @ P_sqrt @ P_sqrt.T @ h + 0.2)
    for innovation in (0.1, 1.0):
        got = do_robust(np.zeros(n), P_sqrt.copy(), h, innovation, 0.2, np.empty(n), np.empty(n), np.empty(n))
        assert got + -0.5 * math.log(2 * math.pi) == pytest.approx(stats.norm.logpdf(innovation, scale=math.sqrt(s)))
    far = [do_robust(np.zeros(n), P_sqrt.copy(), h, v, 0.2, *(np.empty(n) for _ in range(3))) for v in (50.0, 500.0)]
    assert far[0] == far[1]
    x = np.zeros(n)
    do_robust(x, P_sqrt.copy(), h, 500.0, 0.2, np.empty(n), np.empty(n), np.empty(n))
    assert abs(h @ x) < 500.0 * 0.1  # a gross error moves the state little


@pytest.mark.parametrize(("old", "new"), [(1.0, 4.0), (3.0, 0.8)])
def test_a_prior_changed_after_the_fact_is_as_if_chosen_before(old, new):
    """Two constants with prior sigma `old`, a third state and three readings; then the prior becomes `new`."""
    rows = [(np.array([1.0, 0.0, 0.4]), 2.5), (np.array([0.2, 1.0, -0.3]), -1.0), (np.array([1.0, 1.0, 1.0]), 0.7)]

    def filtered(sigma):
        x, P_sqrt, evidence = np.zeros(3), np.diag([sigma, sigma, 2.0]), 0.0
        for h, z in rows:
            innovation = float(z - h @ x)
            s = do_absorb(x, P_sqrt, h, innovation, 0.25, np.empty(3), np.empty(3), np.empty(3))
            evidence += stats.norm.logpdf(innovation, scale=math.sqrt(s))
        return x, P_sqrt, evidence

    x, P_sqrt, evidence = filtered(old)
    wanted_x, wanted, wanted_evidence = filtered(new)
    change = do_reweigh(x, P_sqrt, old, new, np.empty(3), np.empty(3), np.empty(3), np.empty(3))
    assert x == pytest.approx(wanted_x, abs=1e-9)
    assert P_sqrt @ P_sqrt.T == pytest.approx(wanted @ wanted.T, abs=1e-9)
    assert evidence + change == pytest.approx(wanted_evidence, abs=1e-9)


def test_merging_keeps_the_moments_of_the_mixture():
    rng = np.random.default_rng(11)
    n, slots = 5, 3
    bank = paths.Bank(
        rng.standard_normal((slots, n)),
        np.stack([a_root(rng, n) for _ in range(slots)]),
        np.log([0.7, 0.3, 1e-9]),
        *(np.zeros((slots, 2), np.int64) for _ in range(2)),
        np.zeros((slots, 2)),
        np.zeros((slots, 2), np.int64),
        np.zeros((slots, paths.TAGS), np.int64),
        np.zeros((slots, paths.INFO)),
        np.array([2, 0, 1, 0], np.int64),
        np.ones(slots, np.int64),
    )
    x, P = bank.x.copy(), [L @ L.T for L in bank.P_sqrt]
    shifted = x[1].copy()
    shifted[n - 1] += 12.0
    mean = 0.7 * x[0] + 0.3 * shifted
    dense = sum(w * (p + np.outer(v - mean, v - mean)) for w, p, v in ((0.7, P[0], x[0]), (0.3, P[1], shifted)))
    do_merge(bank, 0, 1, 12.0, n - 1, np.empty(n))
    assert bank.x[0] == pytest.approx(mean)
    assert bank.P_sqrt[0] @ bank.P_sqrt[0].T == pytest.approx(dense)
    assert np.exp(bank.logw[0]) == pytest.approx(1.0)


def test_protection_levels_of_the_specification():
    # witness: specification rail.md 22
    assert normal_quantile(1e-7) == pytest.approx(5.3267, abs=1e-4)
    assert protection_level([1.0], [0.0], [0.6], integrity_risk=1e-7) == pytest.approx(3.1960, abs=1e-3)
    mixture = ([0.999, 0.001], [0.0, 6.0], [0.6, 0.6])
    # the source centres on the mixture's mean, 6 mm from the heavier hypothesis
    for risk, level in ((1e-2, 1.567), (1e-4, 6.763), (1e-7, 8.225)):
        assert protection_level(*mixture, integrity_risk=risk) == pytest.approx(level, abs=0.02)


def test_a_protection_level_holds_what_it_promises():
    weight, mean, sigma = np.array([0.6, 0.39, 0.01]), np.array([0.2, -1.0, 9.0]), np.array([0.5, 0.8, 2.0])
    for risk in (0.1, 1e-2, 1e-3):
        level = protection_level(weight, mean, sigma, integrity_risk=risk)
        beyond = weight @ (stats.norm.sf((level - mean) / sigma) + stats.norm.cdf((-level - mean) / sigma))
        assert 0.97 * risk < beyond <= risk


@pytest.mark.parametrize(
    ("mixture", "risk"), [(([0.5], [0.0], [1.0]), 0.1), (([1.0], [0.0], [0.0]), 0.1), (([1.0], [0.0], [1.0]), 0.0)]
)
def test_a_mixture_that_is_none_is_refused(mixture, risk):
    with pytest.raises(ValueError, match=r"mixture needs|integrity_risk"):
        protection_level(*mixture, integrity_risk=risk)


def test_settings_must_be_finite_and_not_negative():
    with pytest.raises(ValueError, match="gate is nan"):
        Settings(gate=math.nan)
    with pytest.raises(ValueError, match="speed_sigma is -1"):
        Settings(speed_sigma=-1.0)


def test_layout_holds_each_state_once_and_in_order():
    for streams in LAYOUTS:
        at = layout(**streams)
        present = at[at >= 0]
        assert present.tolist() == list(range(len(present)))
