"""Calibration: printed vectors of A10 and B11, honest sigmas (NEES), rank and unit refusals with advice."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from railnav.attitude import dcm_from_rotation_vector
from railnav.errors import EstimationError
from railnav.inertial.advice import advise_positions
from railnav.inertial.calibration import multi_position, six_position, vector_calibration
from railnav.inertial.positions import position_mean
from railnav.inertial.temperature import fit_temperature
from railnav.inertial.turns import advise_turns, finite_rotation, solvability, turned_force, turned_rate

DEGREE = np.pi / 180
UP = (0.0, 0.0, 1.0)
M_A = np.array(
    [
        [0.98063592376, 0.0090436028566, -0.0071902463288],
        [0.0090436028566, 0.97127915349, 0.0043566637153],
        [-0.0071902463288, 0.0043566637153, 0.99505388228],
    ]
)
B_A = np.array([0.0071776500508713, 0.097884534132332, -0.091424202472267])
BIAS = np.array([0.01, -0.02, 0.015])
K = np.array([[1.002, 0.003, -0.001], [0.002, 0.997, 0.004], [-0.0015, 0.001, 1.005]])


def directions(m):
    d = [s * e for e in np.eye(3) for s in (1, -1)] + [np.array(v, float) for v in ((1, 1, 0), (1, 0, 1), (0, 1, 1))]
    d += list(np.random.default_rng(11).normal(size=(max(0, m - 9), 3)))
    d = np.array(d[:m])
    return d / np.linalg.norm(d, axis=1, keepdims=True)


# --- positions by length -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("m", [9, 12, 24])
@pytest.mark.parametrize("g", [1.0, 9.81])
def test_measured_matrix_of_the_source_is_recovered(m, g):
    V = g * (directions(m) @ np.linalg.inv(M_A).T + B_A)
    got = multi_position(V, g)
    np.testing.assert_allclose(got.matrix, M_A, atol=2e-15)
    np.testing.assert_allclose(got.bias, g * B_A, atol=1e-14)
    if m == 9:
        assert got.condition == pytest.approx(3.9, abs=0.05)
    np.testing.assert_allclose(np.linalg.norm(got.apply(V), axis=1), g, rtol=1e-14)


def test_printed_inverse_and_six_positions_of_the_same_unit():
    response = np.linalg.inv(M_A)
    printed = [
        [1.01988867, -0.00952945, 0.00741143],
        [-0.00952945, 1.02967939, -0.00457712],
        [0.00741143, -0.00457712, 1.0050443],
    ]
    np.testing.assert_allclose(response, printed, atol=6e-9)
    up, down = np.diagonal(response + B_A[:, None]), np.diagonal(-response + B_A[:, None])
    got = six_position(up, down, 1.0)
    np.testing.assert_allclose(got.scale, [0.01988867, 0.02967939, 0.0050443], atol=6e-9)
    np.testing.assert_allclose(got.bias, B_A, atol=1e-15)
    np.testing.assert_allclose(np.diagonal(got.apply(np.diag(up))), 1.0, atol=1e-15)


def test_lower_form_is_the_same_triad_turned():
    S = np.array([[1.02, 0, 0], [0.01, 0.99, 0], [-0.02, 0.005, 1.01]])
    V = directions(12) @ S.T + BIAS
    got = multi_position(V, 1.0, form="lower")
    np.testing.assert_allclose(got.response, S, atol=1e-14)
    symmetric = multi_position(V, 1.0)
    np.testing.assert_allclose(symmetric.matrix.T @ symmetric.matrix, got.matrix.T @ got.matrix, atol=1e-14)
    np.testing.assert_allclose(symmetric.matrix, symmetric.matrix.T, atol=1e-16)


def test_a_turn_of_the_whole_triad_cannot_be_seen():
    R = dcm_from_rotation_vector(np.array([1, 2, 3]) * DEGREE)
    V = directions(12) @ np.linalg.inv(R @ M_A).T + B_A
    got = multi_position(V, 1.0)
    np.testing.assert_allclose(got.matrix, M_A, atol=1e-13)
    assert np.abs(got.matrix - R @ M_A).max() == pytest.approx(0.051, abs=0.003)


def test_gyros_on_a_rate_table_by_the_same_methods():
    rate = 60 * DEGREE
    bias = np.array([-0.352, -1.20873, 0.429655]) * DEGREE  # the source's L3G4200D
    scale = np.array([0.017023, 0.01931, -0.011668])
    V = rate * directions(12) * (1 + scale) + bias
    got = multi_position(V, rate)
    np.testing.assert_allclose(got.bias, bias, atol=1e-14)
    np.testing.assert_allclose(np.diagonal(got.matrix), 1 / (1 + scale), atol=1e-13)
    up, down = rate * (1 + scale) + bias, -rate * (1 + scale) + bias
    six = six_position(up, down, rate)
    np.testing.assert_allclose(six.scale, scale, atol=1e-14)
    runs = np.linspace(0.5, 1.5, 12)  # the table may turn at different rates
    varied = multi_position(rate * runs[:, None] * directions(12) * (1 + scale) + bias, rate * runs)
    np.testing.assert_allclose(varied.bias, bias, atol=1e-13)


@pytest.mark.parametrize(("m", "low", "high"), [(9, 0.68, 1.32), (24, 0.35, 0.65)])
def test_errors_of_noisy_positions_are_as_printed(m, low, high):
    V = directions(m) @ np.linalg.inv(M_A).T + B_A
    stated = multi_position(V, 1.0, sigma=1.0)
    upper = np.triu_indices(3)
    sigma = np.concatenate([stated.sigma_matrix[upper], stated.sigma_bias])
    assert np.all((sigma > low) & (sigma < high)), sigma
    rng = np.random.default_rng(1)
    fits = [multi_position(V + 1e-3 * rng.normal(size=V.shape), 1.0) for _ in range(200)]
    errors = np.array([np.concatenate([(f.matrix - M_A)[upper], f.bias - B_A]) for f in fits])
    np.testing.assert_allclose(np.sqrt(np.mean(errors**2, axis=0)) / 1e-3, sigma, rtol=0.2)


@pytest.mark.parametrize("form", ["symmetric", "lower"])
def test_sigmas_of_multi_position_are_honest(form):
    rng = np.random.default_rng(2)
    clean = directions(20) @ np.linalg.inv(M_A).T + B_A
    truth = multi_position(clean, 1.0, form=form)
    places = [0, 1, 2, 3, 7, 11, *([4, 5, 8] if form == "symmetric" else [6, 9, 10])]
    nees = []
    for _ in range(120):
        got = multi_position(clean + 2e-3 * rng.normal(size=clean.shape), 1.0, form=form, sigma=2e-3)
        error = np.concatenate([got.bias - truth.bias, (got.matrix - truth.matrix).ravel()])[places]
        nees.append(error @ np.linalg.solve(got.covariance[np.ix_(places, places)], error))
    low, high = chi2.ppf([0.0005, 0.9995], 9 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high
    estimated = [
        multi_position(clean + 2e-3 * rng.normal(size=clean.shape), 1.0, form=form).residual for _ in range(40)
    ]
    assert np.sqrt(np.mean(np.square(estimated))) == pytest.approx(2e-3, rel=0.1)


def test_sigmas_of_six_positions_are_honest():
    rng = np.random.default_rng(3)
    up, down, sigma = np.array([1.03, 1.01, 0.98]), np.array([-0.99, -0.97, -1.02]), 2e-3
    truth = six_position(up, down, 1.0)
    nees = []
    for _ in range(200):
        got = six_position(up + sigma * rng.normal(size=3), down + sigma * rng.normal(size=3), 1.0, sigma=sigma)
        error = np.concatenate([got.bias - truth.bias, np.diagonal(got.matrix - truth.matrix)])
        places = [0, 1, 2, 3, 7, 11]
        nees.append(error @ np.linalg.solve(got.covariance[np.ix_(places, places)], error))
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high
    assert truth.covariance is None
    assert truth.sigma_bias is None


# --- spatial calibration -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("step", "condition"), [(15, 9.1), (30, 9.1), (45, 9.1), (60, 12.4)])
def test_equal_turns_recover_the_printed_unit(step, condition):
    a = np.arange(360 // step) * step * DEGREE
    force = turned_force(a, a, a, up=UP)
    got = vector_calibration(BIAS + force @ K.T, force)
    np.testing.assert_allclose(got.bias, BIAS, atol=1e-10)
    np.testing.assert_allclose(got.response, K, atol=1e-10)
    assert got.condition == pytest.approx(condition, abs=0.05)


def test_finite_rotation_as_printed():
    v = finite_rotation(*(np.full(3, 30) * DEGREE))
    assert np.linalg.norm(v) / DEGREE == pytest.approx(55.7711336722, abs=6e-11)
    np.testing.assert_allclose(v / np.linalg.norm(v), (0.65465367, 0.37796447, 0.65465367), atol=6e-9)


def test_conditions_and_sigmas_as_printed():
    k = np.arange(12) * 30 * DEGREE
    equal = solvability(turned_force(k, k, k, up=UP))
    assert equal.condition == pytest.approx(9.10, abs=5e-3)
    np.testing.assert_allclose(equal.sigma_factor, (1.26, 1.15, 0.67, 1.41), atol=5.1e-3)
    unequal = solvability(turned_force(2 * k, 4 * k, k, up=UP))
    assert unequal.condition == pytest.approx(1.789, abs=5e-4)
    np.testing.assert_allclose(unequal.sigma_factor, (0.289, 0.516, 0.516, 0.471), atol=5e-4)
    zero = 0 * k
    tipped = turned_force(90 * DEGREE, 0.0, 0.0, up=UP)
    classic = np.concatenate(
        [turned_force(k, zero, zero, up=UP), turned_force(zero, k, zero, up=UP), turned_force(zero, zero, k, up=tipped)]
    )
    found = solvability(classic)
    assert found.condition == pytest.approx(1.73, abs=5e-3)
    np.testing.assert_allclose(found.sigma_factor, (0.167, 0.289, 0.289, 0.289), atol=5e-4)
    multiples, advised = advise_turns(30 * DEGREE, 12)
    assert multiples == (2, 4, 1)
    assert advised.condition == pytest.approx(1.789, abs=5e-4)
    # the same in forward, right, down: signs do not matter to the conditioning
    assert solvability(turned_force(2 * k, 4 * k, k)).condition == pytest.approx(unequal.condition, rel=1e-12)


def test_ranks_of_gyro_programmes_as_printed():
    k = np.arange(12)
    a, n = k * 30 * DEGREE, np.ones(3) / np.sqrt(3)
    zero = 0 * a
    cases = [
        (np.tile(n * 20, (12, 1)), 1, None),
        (np.outer(20 * np.sin(k), n), 2, None),
        (np.outer(k, [1, 2, 3]), 2, None),
        (turned_rate(a, a, zero, [10, 10, 0]), 3, None),
        (turned_rate(a, a, a, [10, 10, 10]), 4, 33.8),
        (np.concatenate([20 * np.eye(3), -20 * np.eye(3)]), 4, 11.5),
        (20 * np.column_stack([np.sin(a), np.cos(a), np.sin(2 * a)]), 4, 14.1),
    ]
    for w, rank, condition in cases:
        found = solvability(w, scale=1.0)  # deg/s, as in the source
        assert found.rank == rank
        if condition:
            assert found.condition == pytest.approx(condition, abs=0.06)
            got = vector_calibration(BIAS + w @ K.T, w)
            np.testing.assert_allclose(got.response, K, atol=1e-12)
        else:
            with pytest.raises(EstimationError, match="2 : 4 : 1"):
                vector_calibration(BIAS + w @ K.T, w)
            assert np.isinf(found.condition)


def test_turned_rate_is_the_derivative_of_the_turns():
    angles, rates, h = np.array([0.3, -0.5, 0.8]), np.array([0.2, 0.1, -0.4]), 1e-6

    def C(x):
        return np.stack([turned_force(*x, up=e) for e in np.eye(3)], axis=-1)

    S = -(C(angles + h * rates) - C(angles - h * rates)) / (2 * h) @ C(angles).T
    np.testing.assert_allclose(turned_rate(*angles, rates), [S[2, 1], S[0, 2], S[1, 0]], atol=1e-9)


def test_repeating_turns_are_refused():
    for step, rank in ((90, 2), (180, 1)):
        a = np.arange(360 // step) * step * DEGREE
        force = turned_force(a, a, a, up=UP)
        assert solvability(force).rank == rank
        with pytest.raises(EstimationError, match="unequal multiples"):
            vector_calibration(BIAS + force @ K.T, force)
    with pytest.raises(EstimationError, match="smaller step"):
        advise_turns(np.pi, 12)


def test_sigmas_of_vector_calibration_are_honest():
    rng = np.random.default_rng(4)
    k = np.arange(12) * 30 * DEGREE
    force = 9.81 * turned_force(2 * k, 4 * k, k)
    nees = []
    for _ in range(150):
        got = vector_calibration(BIAS + force @ K.T + 0.02 * rng.normal(size=force.shape), force, sigma=0.02)
        error = np.concatenate([got.bias - BIAS, (got.matrix - np.linalg.inv(K)).ravel()])
        nees.append(error @ np.linalg.solve(got.covariance, error))
    low, high = chi2.ppf([0.0005, 0.9995], 12 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high
    residual = [
        vector_calibration(BIAS + force @ K.T + 0.02 * rng.normal(size=force.shape), force).residual for _ in range(50)
    ]
    assert np.sqrt(np.mean(np.square(residual))) == pytest.approx(0.02, rel=0.05)


def test_covariance_of_a_very_skew_triad_is_propagated():
    response = np.array([[1.1, 0.5, -0.3], [0.0, 0.9, 0.4], [0.2, -0.6, 1.3]])
    k = np.arange(12) * 30 * DEGREE
    force = turned_force(2 * k, 4 * k, k)
    clean = force @ response.T + BIAS
    stated = vector_calibration(clean, force, sigma=1e-5).covariance
    base = vector_calibration(clean, force)
    covariance = np.zeros((12, 12))  # by perturbing every reading
    for place in np.ndindex(clean.shape):
        moved = clean.copy()
        moved[place] += 1e-5
        got = vector_calibration(moved, force)
        change = np.concatenate([got.bias - base.bias, (got.matrix - base.matrix).ravel()])
        covariance += np.outer(change, change)
    np.testing.assert_allclose(stated, covariance, rtol=1e-3, atol=1e-3 * np.abs(covariance).max())


# --- advice, rest, temperature ------------------------------------------------------------------------------------------------


def test_advice_makes_a_hopeless_set_solvable():
    six = directions(6)
    V = six @ np.linalg.inv(M_A).T + B_A
    with pytest.raises(EstimationError, match=r"add positions with these axes up: .*;.*;"):
        multi_position(V, 1.0)
    more = np.concatenate([six, advise_positions(six, 3)])
    got = multi_position(more @ np.linalg.inv(M_A).T + B_A, 1.0)
    np.testing.assert_allclose(got.matrix, M_A, atol=1e-13)
    coplanar = np.column_stack([np.cos(np.arange(12) * 0.5), np.sin(np.arange(12) * 0.5), np.zeros(12)])
    with pytest.raises(EstimationError, match="of 9 parameters; add"):
        multi_position(coplanar, 1.0)
    start = advise_positions(np.empty((0, 3)), 4, design="vector")
    assert solvability(start).rank == 4


def test_rest_is_checked():
    rng = np.random.default_rng(5)
    still = rng.normal([0, 0, 9.8], 0.02, (2000, 3))
    got = position_mean(still, largest_sigma=0.01)
    np.testing.assert_allclose(got.mean, [0, 0, 9.8], atol=4 * 0.02 / np.sqrt(2000))
    assert got.sigma.max() < 0.002
    moved = still.copy()
    moved[1500:, 1] += 0.1
    with pytest.raises(EstimationError, match=r"moved.*axis y"):
        position_mean(moved, largest_sigma=0.01)
    frozen = still.copy()
    frozen[:, 2] = 9.8
    with pytest.raises(EstimationError, match=r"axis z.*frozen"):
        position_mean(frozen, largest_sigma=0.01)
    gap = still.copy()
    gap[7, 0] = np.nan
    with pytest.raises(EstimationError, match="sample 7"):
        position_mean(gap, largest_sigma=0.01)


def test_temperature_polynomial():
    rng = np.random.default_rng(6)
    T = np.linspace(253.15, 333.15, 17)
    x = (T - 293.15) / 40
    truth = np.column_stack([0.1 + 0.05 * x - 0.02 * x**2, 0.01 - 0.003 * x])
    clean = fit_temperature(T, truth, sigma=1.0)
    at = np.array([260.0, 293.15, 330.0])
    u = (at - 293.15) / 40
    np.testing.assert_allclose(
        clean.at(at), np.column_stack([0.1 + 0.05 * u - 0.02 * u**2, 0.01 - 0.003 * u]), atol=1e-14
    )
    z = []
    for _ in range(300):
        fit = fit_temperature(T, truth + 1e-3 * rng.normal(size=truth.shape), sigma=1e-3)
        z.append((fit.at(300.0) - clean.at(300.0)) / fit.sigma_at(300.0))
    assert np.std(z) == pytest.approx(1.0, abs=0.08)
    with pytest.raises(EstimationError, match=r"350.0 K.*measure there"):
        clean.at(350.0)
    with pytest.raises(EstimationError, match="degree 3"):
        fit_temperature([273.0, 273.0, 283.0], [0.0, 0.0, 0.1], degree=3)
    with pytest.raises(EstimationError, match="left over"):
        fit_temperature([273.0, 283.0, 293.0], [0.0, 0.0, 0.1])


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: multi_position(directions(12), 9.81), EstimationError, r"g and m/s\^2 are mixed"),
        (lambda: multi_position(57.3 * directions(12), 1.0), EstimationError, "degrees and radians"),
        (lambda: vector_calibration(9.81 * directions(12), directions(12)), EstimationError, "mixed"),
        (lambda: six_position([9.8] * 3, [-9.8] * 3, 1.0), EstimationError, "mixed"),
        (lambda: six_position([1, 1, -1], [-1, -1, 1], 1.0), EstimationError, "axis z.*which way was up"),
        (lambda: vector_calibration(directions(12) * [1, 1, -1], directions(12)), EstimationError, "mirrored"),
        (lambda: multi_position(directions(12)[:, :2], 1.0), ValueError, "shape"),
        (lambda: multi_position(directions(12) * np.nan, 1.0), ValueError, "position 0"),
        (lambda: multi_position(directions(12), 1.0, form="upper"), ValueError, "lower"),
        (lambda: multi_position(directions(12), -1.0), ValueError, "positive"),
        (lambda: vector_calibration(directions(12), directions(11)), ValueError, "12 readings but 11"),
        (lambda: vector_calibration(directions(12), 0 * directions(12)), EstimationError, "zero"),
        (lambda: six_position([1, 1], [1, 1], 1.0), ValueError, "up"),
        (lambda: advise_positions([[0.0, 0.0, 0.0]], 1), ValueError, "length zero"),
    ],
)
def test_refusals_say_why(call, error, words):
    with pytest.raises(error, match=words):
        call()


def test_a_gross_error_is_not_fitted_in_silence():
    V = directions(24) @ np.linalg.inv(M_A).T + B_A
    V[3] *= 1.3
    assert multi_position(V, 1.0).residual > 0.03
