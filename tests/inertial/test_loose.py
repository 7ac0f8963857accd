"""Loose closed loop: one step equals the dense reference, honest NEES and NIS, outages, lever arm, delays, gross errors, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from railnav.attitude import dcm_from_euler, dcm_from_rotation_vector, rotation_vector_from_dcm
from railnav.errors import EstimationError
from railnav.estimation.square_root import predict, update
from railnav.geodesy import WGS84
from railnav.inertial.error_model import (
    error_dynamics,
    feed_back,
    gnss_design,
    position_scale,
    process_noise_sqrt,
)
from railnav.inertial.loose import ImuNoise, InitialSigma, integrate_gnss
from railnav.inertial.mechanization import GravityField, NavigationState, mechanize
from railnav.inertial.sensors import TriadModel, simulate_triad
from railnav.simulation.inertial import interval_means

DEGREE = np.pi / 180
FIELD = GravityField(free_air="linear")  # as the simulator
NOISE = ImuNoise(0.3 * DEGREE / 60, 0.1 / 60, 20 * DEGREE / 3600, 2e-3, 200.0, 200.0)
INITIAL = InitialSigma(np.full(3, 2.0), np.full(3, 0.2), np.array([0.5, 0.5, 3.0]) * DEGREE, 30 * DEGREE / 3600, 0.01)
ARM = np.array([1.0, 0.4, -3.0])
R_P, R_V = np.array([1.5, 1.5, 3.0]), np.array([0.1, 0.1, 0.15])


@pytest.fixture(scope="module")
def drive():
    """Two minutes of curves and stops at 50 Hz, as exact samples."""
    t = np.arange(0, 120.0001, 0.02)
    speed = 12 * (1 - np.cos(2 * np.pi * t / 60)) / 2 + 2
    heading = 1.2 * np.sin(2 * np.pi * t / 47) + 0.3
    climb = -0.3 * np.sin(2 * np.pi * t / 40)
    v = np.stack([speed * np.cos(heading), speed * np.sin(heading), climb], axis=-1)
    latitude, longitude, height = np.empty((3, len(t)))
    latitude[0], longitude[0], height[0] = 0.85, 0.3, 150.0
    for k in range(len(t) - 1):
        mean = 0.5 * (v[k] + v[k + 1])
        latitude[k + 1] = latitude[k] + 0.02 * mean[0] / (WGS84.meridian_radius(latitude[k]) + height[k])
        reach = (WGS84.transverse_radius(latitude[k]) + height[k]) * np.cos(latitude[k])
        longitude[k + 1] = longitude[k] + 0.02 * mean[1] / reach
        height[k + 1] = height[k] - 0.02 * mean[2]
    attitude = dcm_from_euler(0.03 * np.sin(t), 0.02 * np.cos(0.7 * t), heading)
    w, f = interval_means(t, latitude, height, v, attitude)
    return t, latitude, longitude, height, v, attitude, w, f


def fixes(drive, rng, every=10, arm=ARM, noise=1.0):
    t, latitude, longitude, height, v, attitude, w, _ = drive
    k = np.arange(every, len(t), every)
    scale = position_scale(NavigationState(latitude[0], longitude[0], height[0]))
    offset = attitude[k] @ arm * [1, 1, -1]
    whirl = np.einsum("kij,kj->ki", attitude[k], np.cross(0.5 * (w[k - 1] + w[np.minimum(k, len(w) - 1)]), arm))
    place = np.column_stack([latitude[k], longitude[k], height[k]])
    return {
        "fix_time": t[k],
        "fix_position": place + (offset + noise * rng.normal(0, R_P, (len(k), 3))) / scale,
        "fix_velocity_n": v[k] + whirl + noise * rng.normal(0, R_V, (len(k), 3)),
        "sigma_position": R_P,
        "sigma_velocity": R_V,
        "lever_arm_b": arm,
    }


def run(drive, seed, **changes):
    t, latitude, longitude, height, v, attitude, w, f = drive
    rng = np.random.default_rng(seed)
    scale = position_scale(NavigationState(latitude[0], longitude[0], height[0]))
    bg, ba = rng.normal(0, INITIAL.gyro_bias, 3), rng.normal(0, INITIAL.accelerometer_bias, 3)
    decay = np.exp(-t[1:, None] / 200.0)  # the biases are Gauss-Markov about zero
    gyro = TriadModel(random_walk=NOISE.angle_random_walk)
    force = TriadModel(random_walk=NOISE.velocity_random_walk)
    slow = []
    for sigma in (NOISE.gyro_instability, NOISE.accelerometer_instability):
        x, path = np.zeros(3), np.empty((len(w), 3))
        keep = np.exp(-0.02 / 200.0)
        for k in range(len(w)):
            x = keep * x + sigma * np.sqrt(1 - keep**2) * rng.normal(size=3)
            path[k] = x
        slow.append(path)
    true_bg, true_ba = bg * decay + slow[0], ba * decay + slow[1]
    w = simulate_triad(w, 0.02, gyro, seed=3 * seed + 1).measured + true_bg
    f = simulate_triad(f, 0.02, force, seed=3 * seed + 2).measured + true_ba
    p = rng.normal(0, INITIAL.position) / scale
    start = NavigationState.from_dcm(
        latitude[0] + p[0],
        longitude[0] + p[1],
        height[0] + p[2],
        velocity_n=v[0] + rng.normal(0, INITIAL.velocity),
        C_nb=dcm_from_rotation_vector(rng.normal(0, INITIAL.attitude)) @ attitude[0],
    )
    arguments = {**fixes(drive, rng), "start_time": 0.0, "gravity": FIELD, **changes}
    got = integrate_gnss(start, INITIAL, t[1:], w, f, NOISE, **arguments)
    end = got.trajectory.state()
    error = np.concatenate(
        [
            [end.latitude - latitude[-1], end.longitude - longitude[-1], end.height - height[-1]],
            end.velocity_n - v[-1],
            rotation_vector_from_dcm(attitude[-1] @ end.C_nb.T),
            true_bg[-1] - got.gyro_bias[-1],
            true_ba[-1] - got.accelerometer_bias[-1],
        ]
    )
    return got, error


def test_one_step_and_one_fix_equal_the_dense_reference():
    start = NavigationState.from_euler(0.85, 0.3, 150.0, velocity_n=[10, -3, 0.5], roll=0.02, pitch=-0.03, heading=2.0)
    w, f, h = np.array([0.01, -0.02, 0.1]), np.array([0.3, 0.2, -9.7]), 0.02
    z = np.array([1.2, -0.7, 2.0, 0.05, -0.02, 0.03])
    scale = position_scale(start)
    free = mechanize(start, h, [w], [f]).state()
    here = position_scale(free)
    place = np.array([free.latitude, free.longitude, free.height]) - z[:3] / here
    got = integrate_gnss(
        start,
        INITIAL,
        [h],
        [w],
        [f],
        NOISE,
        start_time=0.0,
        fix_time=[h],
        fix_position=[place],
        fix_velocity_n=[free.velocity_n - z[3:]],
        sigma_position=R_P,
        sigma_velocity=R_V,
        gate=1e9,
    )
    F = error_dynamics(start, f, gyro_correlation_time=200.0, accelerometer_correlation_time=200.0)
    Q = process_noise_sqrt(
        h,
        velocity_random_walk=NOISE.velocity_random_walk,
        angle_random_walk=NOISE.angle_random_walk,
        gyro_bias_walk=NOISE.gyro_instability * 0.1,
        accelerometer_bias_walk=NOISE.accelerometer_instability * 0.1,
    )
    sigma = [*INITIAL.position / scale, *INITIAL.velocity, *INITIAL.attitude, *[INITIAL.gyro_bias] * 3, *[0.01] * 3]
    P_sqrt = predict(np.diag(sigma), np.eye(15) + F * h, Q)
    done = update(np.zeros(15), P_sqrt, z, gnss_design(free), np.diag([*R_P, *R_V]))
    expected = feed_back(free, done.state)
    np.testing.assert_allclose(got.P_sqrt, done.P_sqrt, rtol=1e-6, atol=1e-16)
    end = got.trajectory.state()
    assert abs(end.latitude - expected.latitude) * 6.4e6 < 1e-8
    np.testing.assert_allclose(end.velocity_n, expected.velocity_n, atol=1e-12)
    np.testing.assert_allclose(end.C_nb, expected.C_nb, atol=1e-12)
    np.testing.assert_allclose(got.gyro_bias[-1], done.state[9:12], rtol=1e-6, atol=1e-15)
    assert got.nis.sum() == pytest.approx(done.nis, rel=1e-9)


def test_the_filter_knows_how_wrong_it_is(drive):
    nees, nis = [], []
    for seed in range(25):
        got, error = run(drive, seed)
        whitened = np.linalg.solve(got.P_sqrt, error)
        nees.append(whitened @ whitened)
        nis.append(got.nis.mean())
        assert got.used.mean() > 0.999
    low, high = chi2.ppf([0.0005, 0.9995], 15 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high, np.mean(nees)
    assert np.mean(nis) == pytest.approx(1.0, abs=0.03)


def test_a_wrong_noise_model_is_unmasked_by_nis(drive):
    got, _ = run(drive, 0, **fixes(drive, np.random.default_rng(0), noise=2.0))
    assert got.nis.mean() > 2.5


def test_an_outage_grows_and_heals(drive):
    f = fixes(drive, np.random.default_rng(1))
    keep = (f["fix_time"] < 60) | (f["fix_time"] > 80)
    f = {k: (v[keep] if np.ndim(v) and len(v) == len(keep) else v) for k, v in f.items()}
    got, _ = run(drive, 3, **f)
    horizontal = np.hypot(got.sigma[:, 0], got.sigma[:, 1])
    t = got.trajectory.time
    assert horizontal[t < 60][-1] < 0.5
    assert horizontal[(t > 79) & (t < 80)].max() > 1.0
    assert horizontal[-1] < 0.5
    at = np.searchsorted(t, 79.9)
    scale = position_scale(NavigationState(drive[1][0], 0, 150.0))
    miss = (
        np.array([got.trajectory.latitude[at] - drive[1][at], got.trajectory.longitude[at] - drive[2][at]]) * scale[:2]
    )
    assert np.linalg.norm(miss) < 4 * horizontal[at]


def test_lever_arm_matters_and_is_taken_into_account(drive):
    right, _ = run(drive, 4)
    wrong, _ = run(drive, 4, lever_arm_b=np.array([-5.0, 3.0, -1.0]))
    assert right.nis.mean() < 1.1
    assert wrong.nis.mean() > 1.5


def test_fixes_between_samples_are_carried(drive):
    f = fixes(drive, np.random.default_rng(5), every=10)
    t, latitude, longitude, height, v = drive[:5]
    shift = -0.013  # 13 ms before the sample
    scale = position_scale(NavigationState(latitude[0], longitude[0], height[0]))
    k = np.arange(10, len(t), 10)
    f["fix_time"] = f["fix_time"] + shift
    f["fix_position"] = f["fix_position"] + shift * v[k] * [1, 1, -1] / scale
    got, error = run(drive, 6, **f)
    assert got.nis.mean() == pytest.approx(1.0, abs=0.12)
    whitened = np.linalg.solve(got.P_sqrt, error)
    assert whitened @ whitened < chi2.ppf(0.9999, 15)


def test_gross_errors_are_left_out(drive):
    f = fixes(drive, np.random.default_rng(7))
    f["fix_position"][200, 0] += 60 / 6.4e6
    f["fix_velocity_n"][300, 1] += 3.0
    got, error = run(drive, 7, **f)
    assert not got.used[200, 0]
    assert not got.used[300, 4]
    assert got.used.mean() > 0.995
    whitened = np.linalg.solve(got.P_sqrt, error)
    assert whitened @ whitened < chi2.ppf(0.9999, 15)


def test_without_fixes_it_is_the_strapdown(drive):
    t, latitude, longitude, height, v, attitude, w, f = drive
    start = NavigationState.from_dcm(latitude[0], longitude[0], height[0], velocity_n=v[0], C_nb=attitude[0])
    none = {"fix_time": [500.0], "fix_position": [[0.85, 0.3, 150.0]], "fix_velocity_n": [[0.0, 0, 0]]}
    got = integrate_gnss(
        start,
        INITIAL,
        t[1:],
        w,
        f,
        NOISE,
        start_time=0.0,
        **none,
        sigma_position=R_P,
        sigma_velocity=R_V,
        gravity=FIELD,
    )
    free = mechanize(start, np.diff(t), w, f, gravity=FIELD)
    np.testing.assert_array_equal(got.trajectory.velocity_n, free.velocity_n)
    assert len(got.fix) == 0
    assert np.all(np.diff(np.hypot(got.sigma[:, 0], got.sigma[:, 1])) > 0)  # nothing measured: nothing gained


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"sigma_position": [0.0, 1.0, 1.0]}, ValueError, "sigma_position"),
        ({"fix_time": np.zeros(600)}, ValueError, "increase"),
        ({"fix_velocity_n": np.zeros((3, 3))}, ValueError, "one time"),
        ({"lever_arm_b": [0.0, 1.0]}, ValueError, "lever_arm_b"),
        ({"start_time": 5.0}, ValueError, "sample 0"),
        ({"start_time": -5.0}, EstimationError, "between samples"),
        ({"fix_position": np.tile([48.0, 2.0, 100.0], (600, 1))}, ValueError, "radians"),
        (
            {"fix_position": np.tile([0.851, 0.31, 9000.0], (600, 1)), "fix_velocity_n": np.full((600, 3), 99.0)},
            EstimationError,
            "ten fixes",
        ),
    ],
)
def test_refusals_say_why(drive, changes, error, words):
    with pytest.raises(error, match=words):
        run(drive, 1, **changes)
