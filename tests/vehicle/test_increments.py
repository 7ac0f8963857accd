"""Increments of the measuring complex: the specification's covariance, sums of sub-steps, drifts in the state."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.errors import EstimationError
from railnav.estimation import IncrementDrift, nees, solve_chain, survey_chain
from railnav.units import cant_angle
from railnav.vehicle import rail_to_axis, space_increments

SIGMAS = {"distance_sigma": 1e-3, "bearing_sigma": 5e-4, "slope_sigma": 3e-4}


def test_covariance_of_the_specification() -> None:
    """Rail 7: ds = 1, psi = 0.7 from x towards y, slope 0.01. The source's x, y are northing, easting with bearings of the house."""
    steps = space_increments([1.0], [0.7], [np.tan(0.01)], **SIGMAS)
    north_east_up = [1, 0, 2]
    K = 1e6 * steps.covariance[0][np.ix_(north_east_up, north_east_up)]
    expected = [[0.688674, 0.369511, 0.006960], [0.369511, 0.561210, 0.005862], [0.006960, 0.005862, 0.090091]]
    np.testing.assert_allclose(K, expected, rtol=0, atol=5e-7)
    np.testing.assert_allclose(np.sqrt(np.linalg.eigvalsh(K)), [0.3, 0.5 * np.cos(0.01), 1.0], rtol=1e-9)
    t = [np.cos(0.7) * np.cos(0.01), np.sin(0.7) * np.cos(0.01), np.sin(0.01)]
    np.testing.assert_allclose(steps.increment[0][north_east_up], t, rtol=1e-14)


def test_directions_are_the_derivatives() -> None:
    rng = np.random.default_rng(1)
    s, b, a = rng.normal(0, 2, 20), rng.uniform(-4, 4, 20), rng.normal(0, 0.03, 20)
    steps = space_increments(s, b, np.tan(a), **SIGMAS)
    e = 1e-6
    for i, (ds, db, da) in enumerate(((e, 0, 0), (0, e, 0), (0, 0, e))):
        ahead = space_increments(s * (1 + ds), b + db, np.tan(a + da), **SIGMAS).increment
        behind = space_increments(s * (1 - ds), b - db, np.tan(a - da), **SIGMAS).increment
        np.testing.assert_allclose(steps.directions[:, :, i], (ahead - behind) / (2 * e), rtol=0, atol=1e-9)


def test_covariance_is_that_of_simulated_steps() -> None:
    rng = np.random.default_rng(2)
    n = 40_000
    steps = space_increments(
        2.0 + rng.normal(0, 1e-3, n), 1.1 + rng.normal(0, 5e-4, n), np.tan(0.02 + rng.normal(0, 3e-4, n)), **SIGMAS
    )
    stated = space_increments([2.0], [1.1], [np.tan(0.02)], **SIGMAS).covariance[0]
    np.testing.assert_allclose(np.cov(steps.increment.T), stated, rtol=0, atol=0.03 * stated.max())


def test_sub_steps_add_up() -> None:
    rng = np.random.default_rng(3)
    steps = space_increments(rng.normal(1, 0.1, 10), rng.normal(0, 1, 10), rng.normal(0, 0.02, 10), **SIGMAS)
    nodes = steps.between([1, 3, 4, 9])
    for k, (a, b) in enumerate(((1, 3), (3, 4), (4, 9))):
        np.testing.assert_allclose(nodes.increment[k], steps.increment[a:b].sum(axis=0), rtol=1e-13)
        np.testing.assert_allclose(nodes.covariance[k], steps.covariance[a:b].sum(axis=0), rtol=1e-13)
        np.testing.assert_allclose(nodes.directions[k], steps.directions[a:b].sum(axis=0), rtol=1e-12, atol=1e-15)
    for wrong in ([1, 1, 3], [0, 11], [3], [-1, 4]):
        with pytest.raises(EstimationError, match="first_step"):
            steps.between(wrong)


def test_backwards_along_the_same_bearing_comes_back() -> None:
    there = space_increments([3.0, -3.0], [0.4, 0.4], [0.01, 0.01], **SIGMAS)
    np.testing.assert_allclose(there.increment.sum(axis=0), 0.0, atol=1e-15)


@pytest.mark.slow
def test_odometer_and_gyros_that_drift_are_estimated_in_the_chain() -> None:
    """From readings to a track axis: 0.1 m steps summed to nodes 1 m apart, scale and bearing errors as states; NEES/3."""
    rng = np.random.default_rng(4)
    N, sub = 601, 10
    bearing = np.repeat(
        np.cumsum(np.interp(np.arange(N - 1), [0, 150, 200, 400, 450, 600], [0, 0, 2e-3, 2e-3, 0, 0])), sub
    )
    gradient = np.repeat(0.006 * np.sin(np.arange(N - 1) / 100), sub)
    distance = np.full((N - 1) * sub, 0.1)
    exact = {"distance_sigma": 1e-4, "bearing_sigma": 1e-3, "slope_sigma": 1e-3}
    edges = np.arange(0, (N - 1) * sub + 1, sub)
    truth = np.vstack(
        [
            np.zeros(3),
            np.cumsum(space_increments(distance, bearing, gradient, **exact).between(edges).increment, axis=0),
        ]
    )
    start, change = np.array([1e-3, 1e-3, 1e-3]), np.array([1e-7, 2e-5, 2e-5])
    ratios = []
    for _ in range(40):
        delta = np.repeat(
            np.cumsum(np.vstack([rng.normal(0, start), rng.normal(0, 1, (N - 2, 3)) * change]), axis=0), sub, axis=0
        )
        white = rng.normal(0, 1, (len(distance), 3))
        steps = space_increments(
            distance * (1 + delta[:, 0]) + 1e-4 * white[:, 0],
            bearing + delta[:, 1] + 1e-3 * white[:, 1],
            np.tan(np.arctan(gradient) + delta[:, 2] + 1e-3 * white[:, 2]),
            **exact,
        ).between(edges)
        X = truth + rng.normal(0, 0.01, truth.shape)
        X[np.arange(N) % 10 != 0] = np.nan
        drift = IncrementDrift(steps.directions, start, change)
        solution = solve_chain(
            survey_chain(X, 1e-4 * np.eye(3), steps.increment, steps.covariance, drift=drift, nominal=truth)
        )
        ratios.append(nees(solution.state[::20, :3], solution.covariance[::20, :3, :3]).mean() / 3)
    assert 0.9 < np.mean(ratios) < 1.1, np.mean(ratios)


@pytest.mark.parametrize("cant", [0.0, 0.1, -0.05])
def test_both_rails_give_the_same_axis(cant: float) -> None:
    lean = cant_angle(cant)
    bearing, gauge = 0.8, 1.52
    axis = np.array([[10.0, 20.0, 5.0]])
    right = 0.5 * gauge * np.array([np.cos(bearing) * np.cos(lean), -np.sin(bearing) * np.cos(lean), -np.sin(lean)])
    np.testing.assert_allclose(rail_to_axis(axis - right, bearing, gauge, cant, rail="left"), axis, rtol=1e-14)
    np.testing.assert_allclose(rail_to_axis(axis + right, [bearing], [gauge], [cant], rail="right"), axis, rtol=1e-14)
    if cant > 0:  # the left rail is high
        assert (axis - right)[0, 2] > axis[0, 2]


def test_wrong_input_is_named() -> None:
    with pytest.raises(EstimationError, match="gradient is not finite at step 1"):
        space_increments([1, 1], [0, 0], [0, np.nan], **SIGMAS)
    with pytest.raises(EstimationError, match=r"all are \(N,\)"):
        space_increments([1, 1], [0], [0, 0], **SIGMAS)
    with pytest.raises(EstimationError, match="slope_sigma is not positive"):
        space_increments([1], [0], [0], distance_sigma=1e-3, bearing_sigma=1e-3, slope_sigma=0.0)
    with pytest.raises(EstimationError, match="gauge is not positive"):
        rail_to_axis([[0.0, 0, 0]], 0.0, 0.0, rail="left")
