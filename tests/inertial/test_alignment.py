"""Alignment: printed vectors of A6 and B10, honest sigmas, refusals with evidence, a real train at rest."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from scipy.stats import chi2

from railnav.attitude import dcm_from_euler, dcm_from_rotation_vector, rotation_vector_from_dcm
from railnav.errors import EstimationError
from railnav.inertial.alignment import coarse_align, level, lever_arm_motion
from railnav.inertial.compass import compass_heading, gyrocompass, gyrocompass_error
from railnav.inertial.fine_alignment import fine_align
from railnav.inertial.heading import heading_from_antennas, heading_from_velocity
from railnav.inertial.mechanization import EARTH_RATE, GravityField
from railnav.inertial.resting import Rest, rest
from railnav.inertial.sensors import TriadModel, simulate_triad
from railnav.units import wrap_angle

DEGREE = np.pi / 180
HOUR = DEGREE / 3600  # deg/h
SWAP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
LATITUDE = 50 * DEGREE


def earth(latitude=LATITUDE):
    return EARTH_RATE * np.array([np.cos(latitude), 0.0, -np.sin(latitude)])


# --- gyrocompass (A6) -----------------------------------------------------------------------------------------------------------

#: The source's vector: psi 40 (counter-clockwise), theta 10, gamma -5 degrees; gravity components point down.
RATE = SWAP @ [7.067831409629, 9.294557925357, 9.481068191429] * HOUR
FORCE = -SWAP @ [-0.842008498051, -1.703488622913, -9.624201172088]
ERRORS = {
    "rate_error": SWAP @ [0.01, 0.02, -0.01] * HOUR,
    "force_error": -SWAP @ [1e-3, -2e-3, 1e-3],
    "latitude_error": DEGREE / 60,
}


def test_printed_gyrocompass_vector():
    C_nb = gyrocompass(RATE, FORCE, LATITUDE, gravity=9.81)
    # the print takes 15.04106718 deg/h for 7.292115e-5 rad/s
    assert compass_heading(C_nb) / DEGREE == pytest.approx(-40.0, abs=1e-6)
    np.testing.assert_allclose(C_nb @ C_nb.T, np.eye(3), atol=3e-8)
    predicted = gyrocompass_error(C_nb, RATE, LATITUDE, **ERRORS)
    assert -predicted / DEGREE == pytest.approx(-0.01607056, abs=6e-9)
    w, f = RATE + ERRORS["rate_error"], FORCE + ERRORS["force_error"]
    disturbed = compass_heading(gyrocompass(w, f, LATITUDE + ERRORS["latitude_error"], gravity=9.81))
    assert -(disturbed - compass_heading(C_nb)) / DEGREE == pytest.approx(-0.01604409, abs=2e-8)
    without = compass_heading(gyrocompass(w, f)) - compass_heading(gyrocompass(RATE, FORCE))
    assert -without / DEGREE == pytest.approx(-0.01826178, abs=2e-8)


@pytest.mark.parametrize(
    ("error", "degrees"),
    [
        ({"rate_error": SWAP @ [0.01 * HOUR, 0, 0]}, 0.059262),
        ({"force_error": -SWAP @ [9.81e-4, 0, 0]}, 0.4097 / 60),
        ({"rate_error": SWAP @ [0, 0.01 * HOUR, 0]}, 0.0),
        ({"rate_error": SWAP @ [0, 0, 0.01 * HOUR]}, 0.0),
        ({"latitude_error": DEGREE / 60}, 0.0),
    ],
)
def test_printed_errors_of_a_level_base(error, degrees):
    got = gyrocompass_error(np.eye(3), earth(), LATITUDE, **error)
    assert -got / DEGREE == pytest.approx(degrees, abs=6e-7 if degrees > 0.01 else 1e-6)


def test_full_error_model_is_the_derivative_of_the_algorithm():
    rng = np.random.default_rng(3)
    for _ in range(300):
        latitude = rng.uniform(-1.2, 1.2)
        C_nb = dcm_from_euler(rng.uniform(-1.2, 1.2), rng.uniform(-1.2, 1.2), rng.uniform(-3.1, 3.1))
        w, f = C_nb.T @ earth(latitude), -C_nb.T @ [0, 0, 9.81]
        dw, df, dphi = rng.normal(size=3) * 1e-6 * EARTH_RATE, rng.normal(size=3) * 1e-6, rng.normal() * 1e-6
        ends = [
            compass_heading(gyrocompass(w + s * dw, f + s * df, latitude + s * dphi, gravity=9.81)) for s in (1, -1)
        ]
        numeric = float(wrap_angle(ends[0] - ends[1])) / 2
        model = gyrocompass_error(C_nb, w, latitude, rate_error=dw, force_error=df, latitude_error=dphi)
        assert model == pytest.approx(numeric, rel=1e-5, abs=1e-11)


def test_both_ways_find_any_attitude():
    rng = np.random.default_rng(4)
    for _ in range(200):
        C_nb = dcm_from_euler(rng.uniform(-3, 3), rng.uniform(-1.5, 1.5), rng.uniform(-3, 3))
        latitude = rng.uniform(-1.4, 1.4)
        w, f = C_nb.T @ earth(latitude), -C_nb.T @ GravityField().vector(latitude)
        for found in (gyrocompass(w, f, latitude), gyrocompass(w, f)):
            np.testing.assert_allclose(found, C_nb, atol=1e-12)


# --- level (B10) -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angles", [(5, -3, 120), (0, 0, 0), (-20, 30, 10), (179, 2, 0), (0, 90, 0)])
def test_level(angles):
    C_nb = dcm_from_euler(*(np.array(angles) * DEGREE))
    roll, pitch = level(C_nb.T @ [0, 0, -9.81])
    assert pitch / DEGREE == pytest.approx(angles[1], abs=1e-9)
    if angles[1] != 90:
        assert roll / DEGREE == pytest.approx(angles[0], abs=1e-9)


def test_a_milli_g_tilts_by_as_much_as_printed():
    assert level([9.81e-3, 0, -9.81])[1] / DEGREE == pytest.approx(0.0573, abs=5e-5)


def test_lever_arm_as_printed():
    C_nb = dcm_from_euler(*(np.array([2, -3, 40]) * DEGREE))
    offset, velocity = lever_arm_motion(C_nb, [0.5, 0.8, -1.2], [0.01, 0.02, 0.3])
    np.testing.assert_allclose(offset, (-0.11137774, 1.00490231, -1.14357612), atol=6e-9)
    np.testing.assert_allclose(velocity, (-0.30621813, -0.04550925, -0.01016676), atol=6e-9)
    np.testing.assert_array_equal(lever_arm_motion(C_nb, [0.5, 0.8, -1.2])[1], 0.0)


# --- coarse -----------------------------------------------------------------------------------------------------------------------


def still(C_nb, *, gyro_bias=0.0, accelerometer_bias=0.0, seed=0, seconds=60.0, interval=0.02, arw=1e-5, vrw=1e-4):
    n = round(seconds / interval)
    gyro = TriadModel(bias=tuple(np.broadcast_to(gyro_bias, 3)), random_walk=arw)
    force = TriadModel(bias=tuple(np.broadcast_to(accelerometer_bias, 3)), random_walk=vrw)
    w = simulate_triad(np.tile(C_nb.T @ earth(), (n, 1)), interval, gyro, seed=2 * seed).measured
    f = simulate_triad(np.tile(-C_nb.T @ GravityField().vector(LATITUDE), (n, 1)), interval, force, seed=2 * seed + 1)
    return interval, w, f.measured


def test_coarse_alignment_knows_how_good_it_is():
    rng = np.random.default_rng(5)
    sigma_g, sigma_a = 0.1 * HOUR, 2e-3
    scores = []
    for seed in range(60):
        angles = rng.uniform([-0.1, -0.1, -3.1], [0.1, 0.1, 3.1])
        C_nb = dcm_from_euler(*angles)
        log = still(
            C_nb,
            gyro_bias=rng.normal(0, sigma_g, 3),
            accelerometer_bias=rng.normal(0, sigma_a, 3),
            seed=seed,
            arw=2e-7,
            vrw=1e-3,
            seconds=20,
        )
        got = coarse_align(rest(*log), LATITUDE, gyro_bias_sigma=sigma_g, accelerometer_bias_sigma=sigma_a)
        assert got.method == "gyrocompass"
        assert got.sigma_heading < 3 * DEGREE
        error = [got.roll - angles[0], got.pitch - angles[1], float(wrap_angle(got.heading - angles[2]))]
        scores.append(np.array(error) / [got.sigma_roll, got.sigma_pitch, got.sigma_heading])
    squares = np.sum(np.square(scores), axis=0)
    low, high = chi2.ppf([0.0005, 0.9995], len(scores))
    assert np.all((squares > low) & (squares < high)), squares / len(scores)


def test_a_consumer_gyro_gives_level_but_no_heading():
    C_nb = dcm_from_euler(0.02, -0.03, 1.0)
    got = coarse_align(
        rest(*still(C_nb, gyro_bias=10 * HOUR)), LATITUDE, gyro_bias_sigma=10 * HOUR, accelerometer_bias_sigma=0.01
    )
    assert got.heading is None
    assert "hide the Earth's rotation" in got.note
    assert got.roll == pytest.approx(0.02, abs=1e-3)
    with pytest.raises(EstimationError, match="GNSS velocity"):
        got.dcm()


def test_a_bias_larger_than_stated_is_noticed_by_the_latitude():
    got = coarse_align(
        rest(*still(np.eye(3), gyro_bias=(3 * HOUR, 0.0, 0.0), arw=2e-7)),
        LATITUDE,
        gyro_bias_sigma=0.05 * HOUR,
        accelerometer_bias_sigma=1e-3,
    )
    assert got.heading is None
    assert "not the Earth's at this latitude" in got.note


# --- fine -------------------------------------------------------------------------------------------------------------------------


def test_fine_alignment_converges_and_its_sigmas_are_honest():
    rng = np.random.default_rng(6)
    sigma_g, sigma_a, arw, vrw = 0.02 * HOUR, 5e-4, 0.002 * DEGREE / 60, 0.003 / 60
    initial = np.array([0.3, 0.3, 2.0]) * DEGREE
    scores, heading = [], []
    for seed in range(10):
        C_nb = dcm_from_euler(*rng.uniform([-0.05, -0.05, -3.0], [0.05, 0.05, 3.0]))
        bg, ba = rng.normal(0, sigma_g, 3), rng.normal(0, sigma_a, 3)
        log = still(C_nb, gyro_bias=bg, accelerometer_bias=ba, seed=seed, seconds=300, interval=0.1, arw=arw, vrw=vrw)
        start = dcm_from_rotation_vector(rng.normal(0, initial)) @ C_nb
        got = fine_align(
            start,
            *log,
            LATITUDE,
            initial_sigma=initial,
            gyro_bias_sigma=sigma_g,
            accelerometer_bias_sigma=sigma_a,
            angle_random_walk=arw,
            velocity_random_walk=vrw,
            update_every=5.0,
        )
        error = np.concatenate(
            [
                rotation_vector_from_dcm(C_nb @ got.C_nb.T),
                bg - got.gyro_bias,
                ba - got.accelerometer_bias,
            ]
        )
        scores.append(error @ np.linalg.solve(got.covariance[3:, 3:], error))
        heading.append(got.sigma_attitude_n[2])
        assert abs(error[2]) < 4 * got.sigma_attitude_n[2]
    low, high = chi2.ppf([0.0005, 0.9995], 9 * len(scores)) / len(scores)
    assert low < np.mean(scores) < high, np.mean(scores)
    floor = sigma_g / (EARTH_RATE * np.cos(LATITUDE))  # the east gyro bias cannot be told from a heading error
    assert floor < np.mean(heading) < 1.6 * floor


def test_a_moving_base_is_refused_by_the_filter():
    interval, w, f = still(np.eye(3), seconds=60, interval=0.1, arw=1e-7, vrw=1e-5)
    f = f + np.outer(np.linspace(0, 0.2, len(f)), [1.0, 0, 0])
    with pytest.raises(EstimationError, match="sigma: the base moves"):
        fine_align(
            np.eye(3),
            interval,
            w,
            f,
            LATITUDE,
            initial_sigma=[1e-3, 1e-3, 0.03],
            gyro_bias_sigma=1e-8,
            accelerometer_bias_sigma=1e-4,
            angle_random_walk=1e-7,
            velocity_random_walk=1e-5,
        )


# --- heading from velocity and antennas --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("speed", "printed"), [(0.5, 11.8), (1, 5.8), (2, 2.9), (5, 1.1), (10, 0.6)])
def test_heading_noise_as_printed(speed, printed):
    noise = np.random.default_rng(7).normal([speed, 0], 0.1, (40_000, 2))
    got = heading_from_velocity(noise, 0.1, worst=10.0)
    assert got.heading.std() / DEGREE == pytest.approx(printed, abs=0.13)
    stated = heading_from_velocity([speed, 0.0], 0.1).sigma / DEGREE
    assert stated == pytest.approx(printed, rel=0.05)


def test_heading_has_the_right_quadrant_and_a_floor():
    got = heading_from_velocity([[-5.0, 1.0], [0.1, 0.0], [0.0, 0.0]], 0.1)
    assert got.heading[0] / DEGREE == pytest.approx(168.690, abs=1e-3)
    np.testing.assert_array_equal(got.valid, [True, False, False])
    assert np.isnan(got.heading[1:]).all()
    assert np.isinf(got.sigma[1:]).all()
    back = heading_from_velocity([-5.0, 1.0], 0.1, backwards=True)
    assert back.heading / DEGREE == pytest.approx(-11.310, abs=1e-3)


def test_two_antennas():
    rng = np.random.default_rng(8)
    for _ in range(100):
        roll, pitch, heading = rng.uniform([-0.2, -0.2, -3.1], [0.2, 0.2, 3.1])
        b = rng.normal([2, 0, 0], 1.0)
        n = dcm_from_euler(roll, pitch, heading) @ b
        got, sigma = heading_from_antennas(n, b, roll=roll, pitch=pitch, sigma=0.005)
        assert float(wrap_angle(got - heading)) == pytest.approx(0.0, abs=1e-12)
        assert sigma == pytest.approx(0.005 / np.hypot(n[0], n[1]))
    with pytest.raises(EstimationError, match="wait for a fix"):
        heading_from_antennas([3.0, 0, 0], [2.0, 0, 0], sigma=0.01)
    with pytest.raises(EstimationError, match="too short"):
        heading_from_antennas([0, 0, 2.0], [0, 0, 2.0], sigma=0.01)


# --- rest ---------------------------------------------------------------------------------------------------------------------------


def changed(index, change):
    log = [x if np.isscalar(x) else x.copy() for x in still(np.eye(3), seconds=30)]
    log[index] = change(log[index])
    return log


def swing(w):
    w[700:900, 2] += 1.0 * DEGREE
    return w


def drive(f):
    f[500:, 0] += 0.3
    return f


def freeze(f):
    f[:, 1] = 0.0
    return f


def gap(w):
    w[42, 0] = np.nan
    return w


@pytest.mark.parametrize(
    ("index", "change", "words"),
    [
        (1, swing, r"turns at 0\.\d+ deg/s at 1\d s"),
        (2, drive, "axis x scatters by 0.1"),
        (2, freeze, "axis y is 0 all the time"),
        (1, gap, "sample 42"),
        (2, lambda f: f / 9.80665, "it is in g"),
        (2, lambda f: f * 1.2, "not gravity"),
    ],
)
def test_logs_that_are_not_at_rest_are_refused_with_the_evidence(index, change, words):
    with pytest.raises(EstimationError, match=words):
        rest(*changed(index, change))


def test_a_real_train_at_rest_and_starting(shared_data):
    file = shared_data / "tud_train" / "imu_processed_data.csv"
    if not file.is_file():
        pytest.skip("tud_train is not here")
    with file.open(encoding="utf-8") as stream:
        rows = [[float(v) for v in row[1:]] for row in list(csv.reader(stream))[1:]]
    x = np.array(rows)
    w, f = x[:, 3:] * DEGREE, x[:, :3]
    # it starts to roll after two seconds, long before GNSS shows a speed
    quiet = rest(0.002, w[:1000], f[:1000])
    got = coarse_align(quiet, 50.555 * DEGREE, gyro_bias_sigma=10 * HOUR, accelerometer_bias_sigma=0.02)
    assert got.heading is None  # a MEMS unit
    assert abs(got.roll) < 1 * DEGREE
    assert abs(got.pitch) < 1 * DEGREE
    with pytest.raises(EstimationError, match="the base moves"):
        rest(0.002, w, f)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: rest(0.01, np.zeros((50, 3)), np.zeros((50, 3))), ValueError, "at least 100"),
        (lambda: rest(0.0, np.zeros((100, 3)), np.zeros((100, 3))), ValueError, "interval"),
        (lambda: level([0.0, 0.0, 0.0]), ValueError, "zero"),
        (lambda: level([0.0, 0.0]), ValueError, "shape"),
        (lambda: gyrocompass(earth(np.pi / 2), [0, 0, -9.8]), EstimationError, "pole"),
        (lambda: gyrocompass(earth(), [0, 0, -9.8], np.pi / 2), EstimationError, "pole"),
        (lambda: gyrocompass_error(np.eye(3), earth(), np.pi / 2), EstimationError, "pole"),
        (lambda: heading_from_velocity([1.0], 0.1), ValueError, "shape"),
        (lambda: heading_from_velocity([1.0, 0.0], 0.0), ValueError, "sigma"),
        (
            lambda: coarse_align(
                Rest(earth(), np.array([0, 0, -9.8]), np.zeros(3), np.zeros(3), 1.0),
                gyro_bias_sigma=-1.0,
                accelerometer_bias_sigma=0.0,
            ),
            ValueError,
            "negative",
        ),
    ],
)
def test_refusals_say_why(call, error, words):
    with pytest.raises(error, match=words):
        call()
