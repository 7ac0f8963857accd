"""Sensor error models: printed laws of B2, moments of the noise, presets in SI; Allan deviation recovers what was simulated."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.errors import EstimationError
from railnav.inertial.allan import TERMS, allan_deviation, fit_allan
from railnav.inertial.sensors import GRADES, TriadModel, misalignment_matrix, simulate_triad

DEGREE = np.pi / 180


def test_constants_of_the_model_act_as_printed():
    true = np.array([[0.1, -0.2, 0.3]] * 4)
    model = TriadModel(
        bias=(0.01, 0.02, -0.03),
        drift=(1e-3, 0.0, -1e-3),
        scale=(0.01, -0.02, 0.0),
        quadratic=(0.1, 0.0, 0.0),
        cross_axis=((0, 0.003, 0), (0, 0, 0), (0.002, 0, 0)),
        bias_temperature=(0.0, 1e-3, 0.0),
        scale_temperature=(0.0, 0.0, 1e-4),
    )
    got = simulate_triad(true, 0.5, model, seed=0, temperature=308.15).measured
    t = np.arange(4) * 0.5
    np.testing.assert_allclose(got[:, 0], 0.1 * 1.01 + 0.1 * 0.01 + 0.003 * -0.2 + 0.01 + 1e-3 * t, atol=1e-15)
    np.testing.assert_allclose(got[:, 1], -0.2 * 0.98 + 0.02 + 10 * 1e-3, atol=1e-15)
    np.testing.assert_allclose(got[:, 2], 0.3 * (1 + 10 * 1e-4) + 0.002 * 0.1 - 0.03 - 1e-3 * t, atol=1e-15)


def test_noise_has_the_stated_moments_and_the_seed_decides():
    n, dt = 200_000, 0.01
    model = TriadModel(random_walk=0.02, instability=0.05, correlation_time=2.0)
    a = simulate_triad(np.zeros((n, 3)), dt, model, seed=3)
    white = a.measured - a.bias
    assert white.std() == pytest.approx(0.02 / np.sqrt(dt), rel=5e-3)
    assert model.sample_sigma(dt) == pytest.approx(0.2)
    assert a.bias.std() == pytest.approx(0.05, rel=0.05)
    lag = 200  # one correlation time
    assert np.mean(a.bias[lag:] * a.bias[:-lag]) / a.bias.var() == pytest.approx(np.exp(-1), abs=0.05)
    np.testing.assert_array_equal(a.measured, simulate_triad(np.zeros((n, 3)), dt, model, seed=3).measured)
    walk = simulate_triad(np.zeros((4000, 3)), 0.1, TriadModel(rate_random_walk=0.3), seed=1).bias
    assert np.diff(walk, axis=0).std() == pytest.approx(0.3 * np.sqrt(0.1), rel=0.03)


def test_quantised_and_saturated_and_said_so():
    true = np.array([[0.26, 5.0, -7.0]])
    got = simulate_triad(true, 0.01, TriadModel(quantum=0.25, full_scale=4.0), seed=0)
    np.testing.assert_array_equal(got.measured, [[0.25, 4.0, -4.0]])
    np.testing.assert_array_equal(got.saturated, [[False, True, True]])


def test_misalignment_matrix_is_the_printed_product():
    tx, ty, tz, byz, bzy, bzx = 1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 6e-3
    expected = [
        [1, -tz, ty],
        [byz + tz, 1 - byz * tz, byz * ty - tx],
        [bzx * tz - bzy - ty, bzx + bzy * tz + tx, 1 - bzx * tx - bzy * ty],
    ]
    np.testing.assert_allclose(misalignment_matrix([tx, ty, tz], [byz, bzy, bzx]), expected, atol=1e-17)


def test_presets_are_si():
    g = GRADES["L3G4200D gyroscope"]
    assert g.full_scale == pytest.approx(250 * DEGREE)
    assert g.random_walk * np.sqrt(50) == pytest.approx(0.212 * DEGREE, rel=2e-3)  # per sample at 50 Hz, rail.md 14
    a = GRADES["LSM303DLH accelerometer"]
    assert a.random_walk * np.sqrt(50) == pytest.approx(0.0151, rel=2e-3)
    imu = GRADES["IMU440 gyroscope"]
    assert imu.random_walk == pytest.approx(4.5 * DEGREE / 60)
    assert imu.instability == pytest.approx(10 * 4.84813681e-6)
    specimens = np.array([imu.draw(seed).bias for seed in range(300)])
    assert specimens.std() == pytest.approx(imu.bias, rel=0.05)
    for grade in GRADES.values():
        assert grade.source
        assert np.trace(np.array(grade.draw(0).cross_axis)) == 0.0


def test_allan_of_a_ramp_and_of_white_noise_is_exact():
    dt = 0.1
    ramp = allan_deviation(np.arange(1000) * dt * 0.3, dt)
    np.testing.assert_allclose(ramp.deviation, 0.3 * ramp.time / np.sqrt(2), rtol=1e-9)
    x = np.random.default_rng(0).normal(size=64)
    m = 4  # by the definition: differences of neighbouring means, all overlaps
    means = np.convolve(x, np.ones(m) / m, "valid")
    expected = np.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2))
    curve = allan_deviation(x, dt)
    assert curve.deviation[np.flatnonzero(np.isclose(curve.time, m * dt))[0]] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_walk_and_rate_random_walk_are_recovered(seed):
    log = simulate_triad(np.zeros((400_000, 3)), 0.01, TriadModel(random_walk=0.02, rate_random_walk=2e-3), seed=seed)
    got = fit_allan(allan_deviation(log.measured[:, 0], 0.01), terms=("random_walk", "rate_random_walk"))
    assert got.random_walk == pytest.approx(0.02, rel=0.005)
    assert got.rate_random_walk == pytest.approx(2e-3, rel=0.25)
    assert got.bias_instability == got.ramp == got.gauss_markov == 0.0
    assert 0.3 < got.misfit < 1.5


def test_gauss_markov_part_is_recovered_with_its_correlation_time():
    model = TriadModel(random_walk=0.02, instability=0.01, correlation_time=20.0)
    log = simulate_triad(np.zeros((600_000, 3)), 0.01, model, seed=4)
    got = fit_allan(allan_deviation(log.measured[:, 1], 0.01), terms=("random_walk", "gauss_markov"))
    assert got.gauss_markov == pytest.approx(0.01, rel=0.15)
    assert got.correlation_time == pytest.approx(20.0, rel=0.3)
    assert got.random_walk == pytest.approx(0.02, rel=0.005)


def test_flicker_floor_is_0_664_b():
    n, dt, B = 2**18, 0.01, 0.05
    rng = np.random.default_rng(5)
    f = np.fft.rfftfreq(n, dt)[1:]
    psd = B**2 / (2 * np.pi * f)  # two-sided, IEEE 952
    spectrum = np.concatenate(
        [[0], np.sqrt(psd * n / dt / 2) * (rng.normal(size=n // 2) + 1j * rng.normal(size=n // 2))]
    )
    curve = allan_deviation(np.fft.irfft(spectrum, n), dt)
    floor = curve.deviation[(curve.time > 0.1) & (curve.time < 10)]
    np.testing.assert_allclose(floor, 0.664 * B, rtol=0.15)
    assert fit_allan(curve).bias_instability == pytest.approx(B, rel=0.05)


def test_quantisation_is_recovered():
    rng = np.random.default_rng(6)
    q, dt = 1e-4, 0.01  # angle quantised by q: sigma of the angle q/sqrt(12) = Q
    angle = np.cumsum(rng.normal(0, 1e-4, 100_001))
    rate = np.diff(q * np.round(angle / q)) / dt
    got = fit_allan(allan_deviation(rate, dt), terms=("quantisation", "random_walk"))
    assert got.quantisation == pytest.approx(q / np.sqrt(12), rel=0.05)
    assert got.random_walk == pytest.approx(1e-4 / np.sqrt(dt), rel=0.05)


def test_stated_sigma_is_honest():
    fits = []
    for seed in range(25):
        log = simulate_triad(
            np.zeros((20_000, 3)), 0.01, TriadModel(random_walk=0.02, rate_random_walk=5e-3), seed=seed
        )
        fits.append(fit_allan(allan_deviation(log.measured[:, 0], 0.01), terms=("random_walk", "rate_random_walk")))
    for name in ("random_walk", "rate_random_walk"):
        spread = np.std([getattr(p, name) for p in fits])
        stated = np.mean([p.sigma[name] for p in fits])
        assert 0.4 < spread / stated < 2.5, name


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: allan_deviation(np.zeros(100), 0.01), EstimationError, "frozen or missing"),
        (lambda: allan_deviation(np.append(np.arange(99.0), np.nan), 0.01), EstimationError, "sample 99"),
        (lambda: allan_deviation(np.arange(8.0), 0.01), ValueError, "at least 16"),
        (lambda: allan_deviation(np.zeros((20, 3)), 0.01), ValueError, "one axis"),
        (lambda: allan_deviation(np.arange(20.0), 0.0), ValueError, "positive"),
        (lambda: fit_allan(allan_deviation(np.arange(20.0), 1.0), terms=TERMS), EstimationError, "longer log"),
        (lambda: fit_allan(allan_deviation(np.arange(20.0), 1.0), terms=("pink",)), ValueError, "pink"),
        (lambda: simulate_triad(np.zeros((2, 2)), 0.1, TriadModel(), seed=0), ValueError, "shape"),
        (lambda: simulate_triad(np.full((2, 3), np.nan), 0.1, TriadModel(), seed=0), ValueError, "finite"),
        (lambda: simulate_triad(np.zeros((2, 3)), -0.1, TriadModel(), seed=0), ValueError, "positive"),
        (lambda: TriadModel(random_walk=-1.0), ValueError, "random_walk"),
        (lambda: TriadModel(correlation_time=0.0), ValueError, "correlation_time"),
    ],
)
def test_refusals_say_why(call, error, words):
    with pytest.raises(error, match=words):
        call()


def test_parts_make_the_curve_and_only_real_ones_stand_out():
    x = np.random.default_rng(5).normal(0.0, 1.0, 200_000)
    x += np.random.default_rng(6).normal(0.0, 2e-3, 200_000).cumsum()
    curve = allan_deviation(x, 0.01)
    fit = fit_allan(curve)
    np.testing.assert_allclose(fit.deviation(curve.time), curve.deviation, rtol=0.35)
    assert sum(fit.parts(curve.time).values()) == pytest.approx(fit.deviation(curve.time) ** 2)
    assert fit.stands_out("random_walk", curve.time)
    assert fit.stands_out("rate_random_walk", curve.time) or fit.stands_out("bias_instability", curve.time)
    for seed in range(6):
        white = allan_deviation(np.random.default_rng(seed).normal(0.0, 1.0, 50_000), 0.01)
        found = fit_allan(white, terms=("random_walk", "gauss_markov"))
        assert found.stands_out("random_walk", white.time)
        assert not found.stands_out("gauss_markov", white.time)
