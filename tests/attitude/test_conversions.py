"""Attitude conversions: round trips, an outside witness (scipy), singular and degenerate cases, printed vectors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from railnav import attitude as at

DEGREE = np.pi / 180
vectors = arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))


def random_rotations(n: int = 500) -> np.ndarray:
    return Rotation.random(n, random_state=7).as_matrix()


def test_printed_matrix_of_section_b1():
    expected = [
        [0.813797681349, -0.44096961053, 0.37852230637],
        [0.469846310393, 0.882564119259, 0.018028311236],
        [-0.342020143326, 0.163175911167, 0.925416578398],
    ]
    np.testing.assert_allclose(at.dcm_from_euler(*(np.array([10, 20, 30]) * DEGREE)), expected, atol=6e-13)


def test_axes_are_forward_right_down():
    forward, right, down = np.eye(3)
    assert (at.dcm_from_euler(0, 0.1, 0) @ forward)[2] < 0  # nose up
    assert (at.dcm_from_euler(0.1, 0, 0) @ right)[2] > 0  # right side down
    assert (at.dcm_from_euler(0, 0, 0.1) @ forward)[1] > 0  # clockwise from north: to the east
    np.testing.assert_allclose(at.dcm_from_euler(0, 0, 2.0) @ down, down, atol=1e-15)


def test_scipy_agrees():
    rng = np.random.default_rng(1)
    r, p, h = rng.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (300, 3)).T
    witness = Rotation.from_euler("ZYX", np.column_stack([h, p, r]))
    np.testing.assert_allclose(at.dcm_from_euler(r, p, h), witness.as_matrix(), atol=1e-14)
    q = witness.as_quat(canonical=True, scalar_first=True)
    np.testing.assert_allclose(at.quaternion_from_euler(r, p, h), q, atol=1e-14)
    np.testing.assert_allclose(at.rotation_vector_from_quaternion(q), witness.as_rotvec(), atol=1e-13)


@given(vectors)
@settings(max_examples=200, deadline=None)
def test_rotation_vectors_come_back(v):
    if np.linalg.norm(v) >= np.pi - 1e-9:
        return
    np.testing.assert_allclose(at.rotation_vector_from_dcm(at.dcm_from_rotation_vector(v)), v, atol=2e-15 + 4e-15)
    np.testing.assert_allclose(at.rotation_vector_from_quaternion(at.quaternion_from_rotation_vector(v)), v, atol=4e-15)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-160, 1e-20, 1e-12, 1e-9, 1e-8, 1e-6, 1e-4, 0.04999, 0.05001, 0.1])
def test_small_angles_lose_no_digit(size):
    v = size * np.array([0.6, -0.64, 0.48])
    np.testing.assert_allclose(
        at.rotation_vector_from_quaternion(at.quaternion_from_rotation_vector(v)), v, rtol=1e-14, atol=0
    )
    C = at.dcm_from_rotation_vector(v)
    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize("gap", [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3])
def test_half_a_turn(gap):
    for axis in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.64, 0.48], [0.0, 0.6, -0.8]):
        v = (np.pi - gap) * np.array(axis, dtype=float)
        back = at.rotation_vector_from_dcm(at.dcm_from_rotation_vector(v))
        np.testing.assert_allclose(back, v, atol=3e-15)


def test_exactly_half_a_turn_takes_the_positive_axis():
    for axis in range(3):
        q = np.zeros(4)
        q[1 + axis] = -1.0
        expected = np.pi * np.eye(3)[axis]
        np.testing.assert_array_equal(at.rotation_vector_from_quaternion(q), expected)
        np.testing.assert_array_equal(at.rotation_vector_from_dcm(2 * np.diag(np.eye(3)[axis]) - np.eye(3)), expected)
    np.testing.assert_array_equal(
        at.rotation_vector_from_quaternion([0, 0, -0.6, 0.8]), np.pi * np.array([0, 0.6, -0.8])
    )


def test_euler_angles_come_back_everywhere():
    C = random_rotations()
    np.testing.assert_allclose(at.dcm_from_euler(*at.euler_from_dcm(C)), C, atol=2e-15)
    q = at.quaternion_from_dcm(C)
    np.testing.assert_allclose(at.dcm_from_quaternion(q), C, atol=2e-15)
    np.testing.assert_allclose(at.euler_from_quaternion(q), at.euler_from_dcm(C), atol=1e-12)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-9, 1e-5])
def test_vertical_nose(sign, gap):
    C = at.dcm_from_euler(0.4, sign * (np.pi / 2 - gap), 1.0)
    roll, pitch, heading = at.euler_from_dcm(C)
    assert abs(pitch - sign * (np.pi / 2 - gap)) < 1e-15 + 1e-9 * gap
    np.testing.assert_allclose(at.dcm_from_euler(roll, pitch, heading), C, atol=1.01e-7 if 0 < gap < 1e-7 else 1e-9)
    if gap < 1e-7:
        assert roll == 0.0
        assert heading == pytest.approx(1.0 - sign * 0.4)


def test_euler_rates_are_the_derivative():
    rng = np.random.default_rng(0)
    angles, rates, h = rng.uniform(-1.3, 1.3, (100, 3)), rng.normal(size=(100, 3)), 1e-6
    step = at.dcm_from_euler(*(angles + h * rates).T) - at.dcm_from_euler(*(angles - h * rates).T)
    S = np.swapaxes(at.dcm_from_euler(*angles.T), 1, 2) @ step / (2 * h)
    w = np.stack([S[:, 2, 1], S[:, 0, 2], S[:, 1, 0]], axis=-1)
    np.testing.assert_allclose(at.euler_rates(angles[:, 0], angles[:, 1], w), rates, atol=1e-8)
    with pytest.raises(ValueError, match="right angle"):
        at.euler_rates(0.0, np.pi / 2, [0.0, 0.0, 0.1])


def test_products_agree():
    A, B = random_rotations()[:250], random_rotations()[250:]
    q = at.quaternion_multiply(at.quaternion_from_dcm(A), at.quaternion_from_dcm(B))
    np.testing.assert_allclose(at.dcm_from_quaternion(q), A @ B, atol=2e-15)


def test_orthonormalise_finds_the_nearest_rotation():
    C = random_rotations()
    noisy = C + np.random.default_rng(0).normal(0, 1e-3, C.shape)
    back = at.orthonormalise(noisy)
    np.testing.assert_allclose(back @ np.swapaxes(back, 1, 2), np.broadcast_to(np.eye(3), C.shape), atol=1e-14)
    closer = np.linalg.norm(back - noisy, axis=(1, 2)) <= np.linalg.norm(C - noisy, axis=(1, 2)) + 1e-12
    assert closer.all()
    with pytest.raises(ValueError, match="axis order"):
        at.orthonormalise(np.diag([1.0, 1.0, -1.0]))


def test_batches_of_any_shape_and_read_only():
    v = np.random.default_rng(0).normal(size=(2, 3, 4, 3)) * 0.5
    v.flags.writeable = False
    C = at.dcm_from_rotation_vector(v)
    assert C.shape == (2, 3, 4, 3, 3)
    np.testing.assert_allclose(at.rotation_vector_from_dcm(C), v, atol=1e-14)
    np.testing.assert_array_equal(C[1, 2, 3], at.dcm_from_rotation_vector(v[1, 2, 3]))
    assert at.dcm_from_rotation_vector(np.empty((0, 3))).shape == (0, 3, 3)
    assert at.quaternion_from_dcm(np.empty((0, 3, 3))).shape == (0, 4)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: at.dcm_from_rotation_vector([np.nan, 0, 0]), "not finite"),
        (lambda: at.dcm_from_rotation_vector([0.0, 0.0]), "shape"),
        (lambda: at.dcm_from_quaternion([1.0, 0.1, 0, 0]), "unit length"),
        (lambda: at.quaternion_from_dcm(np.eye(3) * 1.01), "orthonormalise"),
        (lambda: at.euler_from_dcm(np.diag([1.0, 1.0, -1.0])), "reflection"),
        (lambda: at.euler_from_dcm(np.eye(4)), "shape"),
        (lambda: at.dcm_from_euler(0.0, np.inf, 0.0), "pitch"),
        (lambda: at.skew(3.0), "shape"),
    ],
)
def test_refusals_say_why(call, words):
    with pytest.raises(ValueError, match=words):
        call()
