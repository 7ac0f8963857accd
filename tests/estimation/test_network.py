"""Networks of GNSS vectors: the specification's vector, dense least squares, loops, and what cannot be adjusted."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.errors import EstimationError
from railnav.estimation import adjust_network, network_loops

EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2)]
VECTORS = np.array(
    [
        [100.002, 0.001, 0.5],
        [0.003, 80.001, 0.3],
        [-99.998, 0.0, -0.2],
        [-0.004, -80.003, -0.601],
        [100.001, 79.998, 0.803],
    ]
)
COVARIANCE = np.array([5e-3, 5e-3, 5e-3, 5e-3, 7e-3])[:, None, None] ** 2 * np.eye(3)


def test_tv6_baseline_graph() -> None:
    solution = adjust_network(EDGES, VECTORS, COVARIANCE, fixed={0: [0.0, 0.0, 0.0]})
    expected = [
        [0, 0, 0],
        [100.000828, 0.000490, 0.500672],
        [100.002655, 80.000980, 0.801345],
        [0.004328, 80.001990, 0.601172],
    ]
    assert solution.nodes == (0, 1, 2, 3)
    np.testing.assert_allclose(solution.position, expected, rtol=0, atol=6e-7)
    assert solution.unit_weight_rms == pytest.approx(0.3035, abs=5e-5)
    assert solution.redundancy == 6


def test_tv6_loops() -> None:
    loops = network_loops(EDGES, VECTORS, COVARIANCE)
    assert [loop.nodes for loop in loops] == [(1, 2, 0), (2, 3, 0)]
    np.testing.assert_allclose(loops[0].closure, [0.004, 0.004, -0.003], rtol=0, atol=1e-9)
    np.testing.assert_allclose(loops[1].closure, [-0.001, -0.005, 0.002], rtol=0, atol=1e-9)
    assert all(loop.closes for loop in loops)
    assert loops[0].statistic == pytest.approx((16 + 16 + 9) * 1e-6 / (2 * 25e-6 + 49e-6))


def test_adjusted_vectors_close_and_residuals_are_theirs() -> None:
    solution = adjust_network(EDGES, VECTORS, COVARIANCE, fixed={0: [0.0, 0.0, 0.0]})
    adjusted = np.array([solution.at(j) - solution.at(i) for i, j in EDGES])
    np.testing.assert_allclose(solution.residual, adjusted - VECTORS, rtol=0, atol=1e-12)
    for loop in network_loops(EDGES, adjusted, COVARIANCE):
        np.testing.assert_allclose(loop.closure, 0.0, atol=1e-12)


def random_network(
    seed: int, points: int = 12, extra: int = 15
) -> tuple[list[tuple[str, str]], np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.normal(0, 1000, (points, 3)) + np.array([6.5e6, 5.1e6, 100.0])
    pairs = [(int(rng.integers(0, k)), k) for k in range(1, points)]
    while len(pairs) < points - 1 + extra:
        i, j = rng.integers(0, points, 2)
        if i != j:
            pairs.append((int(i), int(j)))
    A = rng.standard_normal((len(pairs), 3, 3))
    K = 1e-4 * (A @ np.swapaxes(A, 1, 2) + np.eye(3))
    b = np.array(
        [
            truth[j] - truth[i] + np.linalg.cholesky(k) @ rng.standard_normal(3)
            for (i, j), k in zip(pairs, K, strict=True)
        ]
    )
    return [(f"P{i}", f"P{j}") for i, j in pairs], b, K, truth


def test_covariance_is_honest_and_large_coordinates_cost_no_digits() -> None:
    ratios, squares = [], []
    for seed in range(60):
        edges, b, K, truth = random_network(seed)
        solution = adjust_network(edges, b, K, fixed={"P0": truth[0]})
        order = [int(str(name)[1:]) for name in solution.nodes]
        error = solution.position - truth[order]
        free = [k for k, name in enumerate(solution.nodes) if name != "P0"]
        ratios.append(
            np.mean([e @ np.linalg.solve(P, e) for e, P in zip(error[free], solution.covariance[free], strict=True)])
            / 3
        )
        squares.append(solution.sum_of_squares / solution.redundancy)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.08)
    shifted = adjust_network(edges, b, K, fixed={"P0": truth[0] - truth[0]})
    np.testing.assert_allclose(shifted.position + truth[0], solution.position, rtol=0, atol=2e-9)


def test_two_known_points_and_parallel_vectors() -> None:
    edges = [("A", "B"), ("A", "B"), ("B", "C")]
    b = [[1.0], [1.2], [1.0]]
    solution = adjust_network(edges, b, [[1.0]], fixed={"A": [0.0], "C": [2.4]})
    assert solution.at("B") == pytest.approx([(1.0 + 1.2 + 1.4) / 3])
    assert solution.redundancy == 2
    (loop,) = network_loops(edges, b, [[1.0]])
    assert loop.closure == pytest.approx([0.2])
    assert loop.edges == ((1, 1), (0, -1))


def test_loop_with_a_blunder_is_open() -> None:
    wrong = VECTORS.copy()
    wrong[1, 2] += 0.05
    first, second = network_loops(EDGES, wrong, COVARIANCE)
    assert not first.closes
    assert second.closes


def test_refused_by_meaning() -> None:
    with pytest.raises(EstimationError, match=r"part around 'C' \(2 points\) is known"):
        adjust_network([("A", "B"), ("C", "D")], np.zeros((2, 1)), [[1.0]], fixed={"A": [0.0]})
    with pytest.raises(EstimationError, match=r"vector 1 \('B' to 'C'\) is not finite"):
        adjust_network([("A", "B"), ("B", "C")], [[0.0], [np.nan]], [[1.0]], fixed={"A": [0.0]})
    with pytest.raises(EstimationError, match="from 'B' to itself"):
        network_loops([("A", "B"), ("B", "B")], [[0.0], [0.0]], [[1.0]])
    with pytest.raises(EstimationError, match="perfect measurement"):
        adjust_network([("A", "B")], [[0.0]], [[0.0]], fixed={"A": [0.0]})
    with pytest.raises(EstimationError, match=r"fixed\['A'\] has shape \(2,\)"):
        adjust_network([("A", "B")], [[0.0]], [[1.0]], fixed={"A": [0.0, 1.0]})
    with pytest.raises(EstimationError, match="'Z' is no end of any vector"):
        adjust_network([("A", "B")], [[0.0]], [[1.0]], fixed={"A": [0.0], "Z": [0.0]})
    with pytest.raises(EstimationError, match="no vector is redundant"):
        _ = adjust_network([("A", "B")], [[0.0]], [[1.0]], fixed={"A": [0.0]}).unit_weight_rms


def test_network_of_known_points_only_is_a_check() -> None:
    solution = adjust_network([("A", "B")], [[1.5]], [[0.25]], fixed={"A": [0.0], "B": [1.0]})
    assert solution.redundancy == 1
    assert solution.sum_of_squares == pytest.approx(1.0)
    assert solution.residual.ravel() == pytest.approx([-0.5])
