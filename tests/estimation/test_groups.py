"""Group least squares against dense least squares, against the projectors written out, and against the source's statements."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from railnav.errors import EstimationError
from railnav.estimation import group_least_squares


def onto(A: np.ndarray) -> np.ndarray:
    """P_R(A) = A A+."""
    return A @ np.linalg.pinv(A)


def random_groups(seed: int, m: int = 12, sizes: tuple[int, ...] = (3, 2, 3)) -> tuple[list[np.ndarray], np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.standard_normal((m, n)) for n in sizes], rng.standard_normal(m)


def test_tv1_two_groups() -> None:
    A1 = np.array([[1.0, 0], [1, 1], [1, 2], [1, 3]])
    A2 = np.array([[0.0], [1], [4], [9]])
    solution = group_least_squares([A1, A2], [1, 3, 2, 5])
    np.testing.assert_allclose(solution.remove(1, A2).ravel(), [1, -1, -1, 1], rtol=0, atol=1e-13)
    np.testing.assert_allclose(solution.remove(1, [1, 3, 2, 5]), [-0.1, 0.8, -1.3, 0.6], rtol=0, atol=1e-13)
    np.testing.assert_allclose(solution.x[1], [0.25], rtol=0, atol=1e-14)
    np.testing.assert_allclose(solution.x[0], [1.35, 0.35], rtol=0, atol=1e-14)
    np.testing.assert_allclose(solution.v, [0.35, -1.05, 1.05, -0.35], rtol=0, atol=1e-14)
    assert solution.redundancy == 1


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    sizes=st.lists(st.integers(1, 4), min_size=1, max_size=5),
    extra=st.integers(0, 8),
)
def test_groups_are_dense_least_squares(seed: int, sizes: list[int], extra: int) -> None:
    m = sum(sizes) + extra
    A, right = random_groups(seed, m, tuple(sizes))
    solution = group_least_squares(A, right)
    whole = np.hstack(A)
    x = np.linalg.lstsq(whole, right, rcond=None)[0]
    condition = np.linalg.cond(whole)
    np.testing.assert_allclose(np.concatenate(solution.x), x, rtol=1e-13 * condition, atol=1e-13 * condition**2)
    np.testing.assert_allclose(solution.v, whole @ x - right, rtol=0, atol=1e-12 * condition)
    assert solution.redundancy == extra


def test_two_group_projectors_equations_2_to_4() -> None:
    (A1, A2), right = random_groups(1, sizes=(3, 2))
    solution = group_least_squares([A1, A2], right)
    P = np.eye(12) - onto(A1)
    plus = np.linalg.inv(A2.T @ P @ A2) @ A2.T @ P
    np.testing.assert_allclose(solution.weighted_pseudo_inverse(1), plus, rtol=0, atol=1e-13)
    np.testing.assert_allclose(solution.x[1], plus @ right, rtol=0, atol=1e-13)
    oblique = A2 @ solution.weighted_pseudo_inverse(1)
    np.testing.assert_allclose(oblique @ oblique, oblique, rtol=0, atol=1e-13)
    assert np.abs(oblique - oblique.T).max() > 0.1
    np.testing.assert_allclose(oblique @ A1, 0.0, atol=1e-13)  # along R(A1) ...
    np.testing.assert_allclose(oblique @ solution.v, 0.0, atol=1e-13)  # ... and N(A^T), not N(A1^T) as printed
    assert np.abs(oblique @ P).max() > 0.1


def test_properties_p1_to_p4_and_equations_6_7_11() -> None:
    A, right = random_groups(2)
    solution = group_least_squares(A, right)
    P = [solution.projector(i) for i in range(3)]
    one = np.eye(12)
    for i in range(3):
        Q = one - sum(P[:i], np.zeros((12, 12)))
        np.testing.assert_allclose(P[i], onto(Q @ A[i]), rtol=0, atol=1e-13)
        np.testing.assert_allclose(P[i], Q @ A[i] @ np.linalg.inv(A[i].T @ Q @ A[i]) @ A[i].T @ Q, rtol=0, atol=1e-12)
        for j in range(3):
            if i != j:  # P1, P3
                np.testing.assert_allclose(P[i] @ P[j], 0.0, atol=1e-14)
    rest = one - sum(P)
    np.testing.assert_allclose((one - P[2]) @ (one - P[1]) @ (one - P[0]), rest, rtol=0, atol=1e-14)  # P4, eq. 6
    np.testing.assert_allclose(rest @ solution.v, solution.v, rtol=0, atol=1e-14)  # P2
    np.testing.assert_allclose(solution.v, -rest @ right, rtol=0, atol=1e-14)  # eq. 7
    np.testing.assert_allclose(solution.v, -solution.remove(3, right), rtol=0, atol=1e-14)
    np.testing.assert_allclose(solution.project(1, right), P[1] @ right, rtol=0, atol=1e-14)


def test_theorem_1_holds_with_the_weighted_pseudo_inverse_only() -> None:
    A, right = random_groups(3)
    solution = group_least_squares(A, right)
    P = [solution.projector(i) for i in range(3)]
    for i in (1, 2):
        Q = np.eye(12) - sum(P[:i])
        M = A[i].T @ Q @ A[i]
        plus = solution.weighted_pseudo_inverse(i)
        inverse = plus @ Q @ plus.T  # eq. 12, corrected
        np.testing.assert_allclose(inverse, np.linalg.inv(M), rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(Q @ A[i] @ plus, P[i], rtol=0, atol=1e-13)  # eq. 13, corrected
        printed = np.linalg.pinv(A[i]) @ Q @ np.linalg.pinv(A[i]).T
        assert np.abs(M @ printed @ M - M).max() > 0.1 * np.abs(M).max()


def test_counter_example_to_the_printed_theorem() -> None:
    """A1 = (1, 0), A2 = (1, 1): Q P_R(A2) Q is diag(0, 1/2), no projector; P_2 is diag(0, 1)."""
    A1, A2 = np.array([[1.0], [0.0]]), np.array([[1.0], [1.0]])
    solution = group_least_squares([A1, A2], [3.0, 4.0])
    Q = np.eye(2) - solution.projector(0)
    np.testing.assert_allclose(Q @ onto(A2) @ Q, np.diag([0, 0.5]), rtol=0, atol=1e-15)
    np.testing.assert_allclose(solution.projector(1), np.diag([0, 1.0]), rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.concatenate(solution.x), [-1.0, 4.0], rtol=0, atol=1e-15)


def test_printed_theorem_holds_when_projectors_commute() -> None:
    Q = np.linalg.qr(np.random.default_rng(4).standard_normal((12, 5)))[0]
    solution = group_least_squares([Q[:, :3], Q[:, 3:]], np.ones(12))
    np.testing.assert_allclose(solution.projector(1), onto(Q[:, 3:]), rtol=0, atol=1e-14)


@pytest.mark.parametrize("group", [0, 1, 2])
def test_deficient_group_keeps_fit_and_residuals_but_not_the_shortest_x(group: int) -> None:
    A, right = random_groups(5)
    source = 1 if group == 0 else 0
    A[group][:, 0] = 2 * A[source][:, 0] - A[source][:, 1]  # inside another group
    solution = group_least_squares(A, right)
    whole = np.hstack(A)
    shortest = np.linalg.pinv(whole) @ right
    np.testing.assert_allclose(whole @ np.concatenate(solution.x), whole @ shortest, rtol=0, atol=1e-12)
    np.testing.assert_allclose(solution.v, whole @ shortest - right, rtol=0, atol=1e-12)
    assert sum(solution.ranks) == 7
    assert solution.redundancy == 5
    assert np.linalg.norm(np.concatenate(solution.x)) > 1.0003 * np.linalg.norm(shortest)


def test_group_dependent_in_itself_takes_its_shortest_unknowns() -> None:
    rng = np.random.default_rng(6)
    a, right = rng.standard_normal(6), rng.standard_normal(6)
    solution = group_least_squares([np.column_stack([a, 2 * a])], right)
    expected = np.linalg.pinv(np.column_stack([a, 2 * a])) @ right
    np.testing.assert_allclose(solution.x[0], expected, rtol=0, atol=1e-14)
    assert solution.ranks == (1,)


def test_group_of_nothing_new_has_rank_zero() -> None:
    A = np.eye(4)[:, :2]
    solution = group_least_squares([A, A @ [[1.0], [2.0]], np.zeros((4, 1))], [1.0, 2.0, 3.0, 4.0])
    assert solution.ranks == (2, 0, 0)
    np.testing.assert_allclose(np.concatenate(solution.x), [1, 2, 0, 0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(solution.v, [0, 0, -3, -4], rtol=0, atol=1e-15)


def test_units_of_columns_do_not_matter() -> None:
    A, right = random_groups(7)
    expected = group_least_squares(A, right)
    units = [10.0 ** np.array([-9, 0, 9]), np.array([1e12, 1e-12]), np.ones(3)]
    scaled = group_least_squares([a * u for a, u in zip(A, units, strict=True)], right)
    for mine, theirs, u in zip(scaled.x, expected.x, units, strict=True):
        np.testing.assert_allclose(mine * u, theirs, rtol=1e-11, atol=1e-11)
    assert scaled.ranks == (3, 2, 3)


def test_bases_stay_orthogonal_when_a_group_nearly_lies_in_another() -> None:
    rng = np.random.default_rng(8)
    A1 = rng.standard_normal((50, 4))
    A2 = A1 @ rng.standard_normal((4, 3)) + 1e-9 * rng.standard_normal((50, 3))
    solution = group_least_squares([A1, A2], rng.standard_normal(50))
    assert solution.ranks == (4, 3)
    basis = np.hstack(solution.bases)
    np.testing.assert_allclose(basis.T @ basis, np.eye(7), rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.hstack([A1, A2]).T @ solution.v, 0.0, atol=1e-12)


def test_long_problems_never_form_a_projector() -> None:
    rng = np.random.default_rng(9)
    m = 200_000  # a projector would take 320 GB
    A, right = [rng.standard_normal((m, 3)), rng.standard_normal((m, 2))], rng.standard_normal(m)
    solution = group_least_squares(A, right)
    x = np.linalg.lstsq(np.hstack(A), right, rcond=None)[0]
    np.testing.assert_allclose(np.concatenate(solution.x), x, rtol=0, atol=1e-13)
    with pytest.raises(EstimationError, match=r"project\(\) applies it"):
        solution.projector(0)


def test_wrong_input_is_named() -> None:
    with pytest.raises(EstimationError, match=r"blocks\[1\] has shape \(3, 1\); \(4, n\)"):
        group_least_squares([np.ones((4, 1)), np.ones((3, 1))], np.ones(4))
    with pytest.raises(EstimationError, match=r"blocks\[0\] is not finite in row 2"):
        group_least_squares([[[1.0], [2.0], [np.nan]]], np.ones(3))
    with pytest.raises(EstimationError, match="l is not finite in row 1"):
        group_least_squares([np.ones((3, 1))], [1.0, np.inf, 0.0])
    with pytest.raises(EstimationError, match="at least one group"):
        group_least_squares([], np.ones(3))


def test_inputs_are_left_alone() -> None:
    A, right = random_groups(10)
    for array in (*A, right):
        array.flags.writeable = False
    group_least_squares(A, right)
