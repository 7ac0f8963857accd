"""Fusion, the plain switch, pairs and smoothing of streams, single points, tight coupling: vectors, laws and orders of the source."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from railnav.errors import EstimationError
from railnav.geodesy.ellipsoid import WGS84
from railnav.inertial.aided.aiding import Fixes
from railnav.inertial.aided.fusion import fuse, switch_to_gnss
from railnav.inertial.aided.single_point import north_east_down, single_point
from railnav.inertial.aided.synchronisation import exponential_smoothing, pair_nearest, trend_smoothing
from railnav.inertial.mechanization import GravityField, NavigationState
from railnav.simulation.constellation import elevations, satellites
from railnav.simulation.road import gnss_error, road_drive


def script(name):
    """A benchmark, to hold a small part of what it prints."""
    path = Path(__file__).parents[2] / "benchmarks" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# ---------------------------------------------------------------- fusion


def test_the_printed_fusion():
    both = fuse([1.0, 2.0], np.diag([4.0, 1.0]), [2.0, 0.0], np.diag([1.0, 9.0]), method="information")
    np.testing.assert_allclose(both.state, [1.8, 1.8], atol=1e-12)
    np.testing.assert_allclose(both.covariance, np.diag([0.8, 0.9]), atol=1e-12)


def test_the_sources_rule_is_optimistic_under_correlation_and_intersection_is_not():
    rng = np.random.default_rng(0)
    P = np.array([[4.0, 0.6 * 2.0], [0.6 * 2.0, 1.0]])
    e = rng.multivariate_normal([0, 0], P, 40_000)
    one, two = e[:, :1], e[:, 1:]
    V1, V2 = np.full((len(e), 1, 1), 4.0), np.full((len(e), 1, 1), 1.0)
    told = fuse(one, V1, two, V2, method="information")
    assert told.covariance[0, 0, 0] == pytest.approx(0.8)
    assert told.state.var() == pytest.approx(1.184, rel=0.03)
    safe = fuse(one, V1, two, V2)
    assert safe.state.var() <= safe.covariance[0, 0, 0] * 1.02


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.floats(-1.0, 1.0))
def test_intersection_is_conservative_for_any_correlation(seed, share):
    """P_claimed - P_true is never negative, whatever links the two errors."""
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(3, 3)) + 2 * np.eye(3), rng.normal(size=(3, 3)) + 2 * np.eye(3)
    P1, P2 = A @ A.T, B @ B.T
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    cross = np.linalg.cholesky(P1) @ (share * turn) @ np.linalg.cholesky(P2).T
    both = fuse(np.zeros(3), P1, np.zeros(3), P2)
    w = both.weight
    K1 = both.covariance @ (w * np.linalg.inv(P1))
    K2 = both.covariance @ ((1 - w) * np.linalg.inv(P2))
    true = K1 @ P1 @ K1.T + K2 @ P2 @ K2.T + K1 @ cross @ K2.T + K2 @ cross.T @ K1.T
    assert np.linalg.eigvalsh(both.covariance - true).min() > -1e-9 * np.trace(both.covariance)


def test_fusion_refuses():
    with pytest.raises(EstimationError, match="positive definite"):
        fuse([0.0], [[0.0]], [0.0], [[1.0]])
    with pytest.raises(ValueError, match="shapes"):
        fuse([0.0, 1.0], [[1.0]], [0.0], [[1.0]])
    with pytest.raises(ValueError, match="method"):
        fuse([0.0], [[1.0]], [0.0], [[1.0]], method="average")


# ---------------------------------------------------------------- the plain switch


def test_the_switch_gives_the_fix_at_a_fix_and_the_ins_between():
    drive = road_drive("city", 30.0)
    k = np.arange(100, 3000, 100)
    place = np.column_stack([drive.latitude, drive.longitude, drive.height])[k] + [1e-6, 0, 0]
    start = NavigationState.from_dcm(
        drive.latitude[0],
        drive.longitude[0],
        drive.height[0],
        velocity_n=drive.velocity_n[0],
        C_nb=drive.attitude_nb[0],
    )
    out = switch_to_gnss(
        start,
        drive.time[1:],
        drive.rate_ib_b,
        drive.specific_force_b,
        Fixes(drive.time[k], place, [3.0] * 3),
        start_time=0.0,
        gravity=GravityField(free_air="linear"),
    )
    np.testing.assert_allclose(out.latitude[k], place[:, 0], rtol=0, atol=1e-15)
    error = drive.error(out.latitude, out.longitude)
    assert np.abs(error[500:, 0] - 6.37).max() < 0.05  # the error of the fix is carried on
    assert np.abs(error[500:, 1]).max() < 0.05


# ---------------------------------------------------------------- streams


def test_pairs_equal_brute_force_and_respect_the_gap():
    rng = np.random.default_rng(0)
    reference = np.arange(0, 100, 0.5) + rng.normal(0, 0.01, 200)
    source = np.sort(np.arange(0, 100, 0.1) + rng.normal(0, 0.01, 1000))
    source = source[(source < 40) | (source > 45)]
    pairs = pair_nearest(reference, source)
    for i, when in zip(pairs, reference, strict=True):
        gap = np.abs(source - when)
        assert (i == -1) == (gap.min() > 0.6 * np.median(np.diff(source)))
        if i >= 0:
            assert gap[i] == gap.min()
    assert (pairs >= 0).sum() == 190
    assert np.abs(source[pairs[pairs >= 0]] - reference[pairs >= 0]).max() == pytest.approx(0.0428, abs=1e-3)


def test_smoothing_vectors():
    np.testing.assert_allclose(exponential_smoothing([1.0, 0, 0, 0], 0.3), [1, 0.7, 0.49, 0.343], atol=1e-15)
    ramp = exponential_smoothing(np.arange(6.0), 0.3)
    np.testing.assert_allclose(ramp, [0, 0.3, 0.81, 1.467, 2.2269, 3.05883], atol=1e-12)
    noise = exponential_smoothing(np.random.default_rng(0).normal(size=200_000), 0.5)
    assert noise.var() == pytest.approx(0.5 / 1.5, rel=0.02)
    long = 15.0 * np.arange(300.0)
    assert (exponential_smoothing(long, 0.5) - long)[-1] == pytest.approx(-15.0)  # a lag of (1 - a)/a samples
    assert abs((trend_smoothing(long, 0.5, 0.3) - long)[-1]) < 1e-9


@pytest.mark.parametrize("bad", [0.0, 1.5, np.nan])
def test_a_share_out_of_range_is_refused(bad):
    with pytest.raises(ValueError, match="share"):
        exponential_smoothing([1.0], bad)
    with pytest.raises(ValueError, match="trend_share"):
        trend_smoothing([1.0, 2.0], 0.5, bad)


def test_gnss_errors_have_the_asked_variance_and_memory():
    e = gnss_error(np.random.default_rng(2), 400_000, 0.2, variance=8.0, white=0.5, correlation_time=10.0)
    assert (e[:, :2] ** 2).sum(axis=1).mean() == pytest.approx(8.0, rel=0.05)
    assert np.mean(e[50:, 0] * e[:-50, 0]) / 4.0 == pytest.approx(0.5 * np.exp(-1.0), abs=0.03)
    assert e[:, 2].std() == pytest.approx(4.0, rel=0.05)


# ---------------------------------------------------------------- satellites


def scene():
    here = np.radians(48.8388), np.radians(2.1033), 150.0
    s, v = satellites(0.0)
    x = np.array(WGS84.to_cartesian(*here)).ravel()
    order = np.flatnonzero(elevations(s, *here) > np.radians(10))
    return here, x, s[order], v[order]


def test_the_printed_constellation_and_dilutions():
    here, x, s, v = scene()
    assert len(s) == 8
    fix = single_point(s, v, np.linalg.norm(s - x, axis=1) + 30.0, np.zeros(len(s)))
    assert np.linalg.norm(fix.position_e - x) < 1e-6
    assert fix.clock_bias == pytest.approx(30.0, abs=1e-6)
    assert fix.iterations <= 7
    assert fix.latitude == pytest.approx(here[0], abs=1e-12)
    printed = {"gdop": 3.0047, "pdop": 2.6844, "hdop": 0.9777, "vdop": 2.5000, "tdop": 1.3500}
    for name, value in printed.items():
        assert fix.dilution[name] == pytest.approx(value, abs=6e-5), name
    four = single_point(s[:4], v[:4], np.linalg.norm(s[:4] - x, axis=1), np.zeros(4))
    assert four.dilution["gdop"] == pytest.approx(16.914, abs=6e-4)


def test_single_points_scatter_as_their_dilution_says():
    _, x, s, v = scene()
    rng = np.random.default_rng(0)
    rho = np.linalg.norm(s - x, axis=1) + 30.0
    errors = []
    for _ in range(1500):
        fix = single_point(s, v, rho + 2.0 * rng.normal(size=len(s)), np.zeros(len(s)), start=x)
        errors.append(north_east_down(fix.latitude, fix.longitude) @ (fix.position_e - x))
    e = np.array(errors)
    assert np.sqrt((e[:, :2] ** 2).sum(axis=1).mean()) == pytest.approx(1.955, rel=0.05)
    assert e[:, 2].std() == pytest.approx(5.0, rel=0.06)


def test_a_moving_receiver_and_its_clock_are_found():
    _, x, s, v = scene()
    velocity, drift = np.array([3.0, -8.0, 2.0]), 1.5
    line = x - s
    rate = np.einsum("ij,ij->i", line / np.linalg.norm(line, axis=1)[:, None], velocity - v) + drift
    fix = single_point(s, v, np.linalg.norm(line, axis=1), rate)
    np.testing.assert_allclose(fix.velocity_e, velocity, atol=1e-8)
    assert fix.clock_drift == pytest.approx(drift, abs=1e-8)


def test_velocities_of_satellites_are_the_derivatives_of_their_places():
    before, _ = satellites(99.0)
    after, _ = satellites(101.0)
    _, velocity = satellites(100.0)
    np.testing.assert_allclose((after - before) / 2, velocity, atol=1e-3)


def test_too_few_satellites_are_an_error():
    _, x, s, v = scene()
    with pytest.raises(EstimationError, match="four are needed"):
        single_point(s[:3], v[:3], np.linalg.norm(s[:3] - x, axis=1), np.zeros(3))
    with pytest.raises(EstimationError, match="cone"):
        single_point(np.repeat(s[:1], 5, axis=0), np.zeros((5, 3)), np.full(5, 2e7), np.zeros(5))


def test_tight_coupling_in_the_canyon_ranks_as_printed():
    """B7: three satellites bound the error; each one less costs more; loose has nothing below four."""
    bench = script("integration")
    drive = road_drive("city", 170.0, interval=0.02)
    worst = {k: bench.canyon_trial(drive, 1, k) for k in (3, 2, 1)}
    assert worst[3]["tight"] < 10.0
    assert worst[3]["tight"] < 0.3 * worst[2]["tight"] < 0.3 * worst[1]["tight"] < 0.3 * worst[3]["loose"]


# ---------------------------------------------------------------- the experiments of the source, a small part


def test_the_gain_over_gnss_depends_on_how_long_its_errors_last():
    bench = script("integration")
    drive = road_drive("campus", 200.0)
    ratio = {}
    for name, white, tau, inflate in (("white", 1.0, 30.0, 1.0), ("slow", 0.5, 60.0, 10.0)):
        values = []
        for seed in (0, 1, 2):
            trial = bench.Trial(drive, seed, variance=8.8775, white=white, tau=tau, inflate=inflate)
            raw = (trial.gnss_error[drive.time[trial.k] > 20, :2] ** 2).sum(axis=1).mean()
            values.append(bench.after(trial, trial.horizontal(trial.solve(fixes=trial.fixes).trajectory)) / raw)
        ratio[name] = np.mean(values)
    assert ratio["white"] < 0.02
    assert ratio["white"] < ratio["slow"] < 0.6


def test_the_odometer_bridges_ten_minutes_on_a_compact_route():
    """K5: below 5 m with the IMU440 class (median), below 1 m with the RT3003 class, after two minutes of GNSS."""
    bench = script("integration")
    drive = road_drive("campus", 720.0)
    last = {grade: [] for grade in bench.GRADES}
    for grade in bench.GRADES:
        for seed in (0, 1, 2):
            trial = bench.Trial(drive, seed, variance=8.8775, grade=grade)
            got = trial.solve(fixes=trial.without(120.0, 1e9), vehicle_motion=trial.motion)
            last[grade].append(np.hypot(*trial.horizontal(got.trajectory)[-1]))
    assert np.median(last["imu440"]) < 5.0
    assert np.median(last["rt3003"]) < 1.5
