"""Orientation update: printed vectors and coefficients of A9, drift and order under coning, refusals."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from railnav import attitude as at

RATES = np.array([(0.1, 0.2, -0.3), (0.15, 0.1, -0.2), (0.3, -0.1, 0), (0.2, -0.2, 0.1), (0.1, -0.3, 0.3)])
INCREMENTS = np.array([(0.02, -0.01, 0.03), (0.015, 0.02, 0.01)])


def coning(t, half_angle, rate):
    """Attitude, body rate and integral of the body rate of pure coning; the reference of section A9.2."""
    t = np.asarray(t, dtype=float)
    s, c, zero = np.sin(rate * t), np.cos(rate * t), np.zeros_like(t)
    q = np.stack([np.cos(half_angle / 2) + zero, np.sin(half_angle / 2) * c, np.sin(half_angle / 2) * s, zero], axis=-1)
    sweep = 2 * np.sin(half_angle / 2) ** 2
    w = rate * np.stack([-np.sin(half_angle) * s, np.sin(half_angle) * c, -sweep + zero], axis=-1)
    integral = np.stack([np.sin(half_angle) * c, np.sin(half_angle) * s, -sweep * rate * t], axis=-1)
    return q, w, integral


def drift(samples, n, w, *, half_angle=1e-3, steps=None, third_order="none"):
    """Drift about the cone's axis per half_angle^2 and radian, for a sampling step of w rad of coning."""
    steps = steps or round(2 * np.pi * 40 / (n * w))
    t = np.arange(n * steps + 1) * w
    q, rate, integral = coning(t, half_angle, 1.0)
    if samples == "rates":
        index = n * np.arange(steps)[:, None] + np.arange(n + 1)
        phi = at.rotation_vector_from_rates(rate[index], n * w, third_order=third_order)
    else:
        phi = at.rotation_vector_from_increments(
            np.diff(integral, axis=0).reshape(steps, n, 3), third_order=third_order
        )
    end = at.propagate(q[0], phi)[-1]
    error = at.rotation_vector_from_quaternion(at.quaternion_multiply(end, q[-1] * [1, -1, -1, -1]))
    return error[2] / (half_angle**2 * t[-1])


@pytest.mark.parametrize(
    ("n", "expected"),
    [
        (1, (0.012491666667, 0.014979166667, -0.025016666667)),
        (2, (0.016641666667, 0.008261666667, -0.018388333333)),
        (3, (0.020584166667, -0.000110632440, -0.010089174107)),
        (4, (0.017952601411, -0.005774938272, -0.003651931217)),
    ],
)
def test_printed_vectors_from_rates(n, expected):
    np.testing.assert_allclose(at.rotation_vector_from_rates(RATES[: n + 1], 0.1), expected, atol=6e-13)


@pytest.mark.parametrize(
    ("third_order", "expected"),
    [
        ("none", (0.034533333333, 0.010166666667, 0.040366666667)),
        ("bortz", (0.034532241667, 0.010162170833, 0.040367320833)),
        ("complete", (0.034530466667, 0.010164433333, 0.040364033333)),
    ],
)
def test_printed_vectors_from_increments(third_order, expected):
    phi = at.rotation_vector_from_increments(INCREMENTS, third_order=third_order)
    np.testing.assert_allclose(phi, expected, atol=6e-13)


def test_coefficients_are_the_sources():
    table = {
        2: {(0, 1): "1/15", (0, 2): "1/60", (1, 2): "1/15"},
        3: {
            (0, 1): "39/2240",
            (0, 2): "3/140",
            (0, 3): "47/6720",
            (1, 2): "243/2240",
            (1, 3): "3/140",
            (2, 3): "39/2240",
        },
        4: {
            (0, 1): "38/2835",
            (0, 2): "1/135",
            (0, 3): "2/135",
            (0, 4): "37/11340",
            (1, 2): "8/189",
            (1, 3): "128/2835",
            (1, 4): "2/135",
            (2, 3): "8/189",
            (2, 4): "1/135",
            (3, 4): "38/2835",
        },
    }
    for n, row in table.items():
        double = at.update_coefficients("rates", n).double
        for (i, j), value in row.items():
            assert double[i, j] == pytest.approx(float(Fraction(value)), rel=1e-15), (n, i, j)
    two = at.update_coefficients("increments", 2)
    np.testing.assert_allclose(two.bortz[:, 0, 1], [7 / 60, 3 / 60], rtol=1e-15)
    np.testing.assert_allclose(two.complete[:, 0, 1], [2 / 15, -2 / 15], rtol=1e-15)
    three = at.update_coefficients("increments", 3).double  # Miller, J. Guidance 6 (4), 1983
    assert (three[0, 2], three[1, 2]) == (33 / 80, 57 / 80)


@pytest.mark.parametrize(
    ("n", "printed"),
    [
        (1, (8.33e-4, 7.45e-3, 7.74e-2)),
        (2, (1.66e-6, 1.34e-4, 1.51e-2)),
        (3, (1.24e-6, 9.57e-5, 5.91e-3)),
        (4, (1.04e-8, 7.30e-6, 6.25e-3)),
    ],
)
def test_printed_drifts_under_coning(n, printed):
    got = [abs(drift("rates", n, w, half_angle=1e-2, steps=200)) for w in (0.1, 0.3, 1.0)]
    np.testing.assert_allclose(got, printed, rtol=6e-3)


@pytest.mark.parametrize(
    ("samples", "n", "order", "leading"),
    [
        ("rates", 1, 2, -1 / 12),
        ("rates", 2, 4, -1 / 60),
        ("rates", 3, 4, 1 / 80),
        ("rates", 4, 6, 2 / 189),
        ("increments", 1, 2, -1 / 12),
        ("increments", 2, 4, -1 / 60),
        ("increments", 3, 4, 1 / 80),
        ("increments", 4, 6, 2 / 189),
    ],
)
def test_orders_under_coning(samples, n, order, leading):
    coarse, fine = (drift(samples, n, w) for w in (0.4, 0.2))
    assert np.log2(abs(coarse / fine)) == pytest.approx(order, abs=0.4)
    assert fine / 0.2**order == pytest.approx(leading, rel=0.05)


def test_accuracy_of_one_double_step_is_as_printed():
    rng = np.random.default_rng(4)
    draws = [(rng.normal(size=3) * 2, rng.normal(size=3) * 6) for _ in range(12)]
    printed = {
        0.4: (2.11e-2, 4.19e-2, 6.88e-3),
        0.2: (6.17e-4, 1.93e-3, 1.85e-4),
        0.1: (1.92e-5, 1.14e-4, 6.00e-6),
        0.05: (6.00e-7, 7.21e-6, 1.95e-7),
    }
    a, b = (np.array(v) for v in zip(*draws, strict=True))
    for H, row in printed.items():
        h = H / 400
        t = np.arange(400) * h
        # reference: fine steps whose increments are exact for a linear rate
        fine = a[:, None] * h + b[:, None] * (t[:, None] * h + h * h / 2)
        cross = np.cross(a[:, None] + b[:, None] * t[:, None], a[:, None] + b[:, None] * (t[:, None] + h)) * h * h / 12
        start = np.array([1.0, 0, 0, 0])
        exact = [at.rotation_vector_from_quaternion(at.propagate(start, f)[-1]) for f in fine + cross]
        pair = np.stack([a * H / 2 + b * H * H / 8, a * H / 2 + 3 * b * H * H / 8], axis=1)
        for kind, value in zip(("none", "bortz", "complete"), row, strict=True):
            phi = at.rotation_vector_from_increments(pair, third_order=kind, longest=3.0)
            rms = np.sqrt(np.mean(np.sum((phi - exact) ** 2, axis=-1)))
            assert rms == pytest.approx(value, rel=6e-3), (H, kind)


def test_four_increments_with_the_complete_third_order_are_the_best():
    """A general motion: the complete third order lessens the error thirteenfold, Bortz's third term alone spoils it."""
    rng = np.random.default_rng(0)
    c = rng.normal(size=(7, 3)) * np.array([1, 1.5, 2, 2.5, 2.5, 2.5, 2.5])[:, None]
    powers = np.arange(1, 8)

    def integral(t):
        return (np.asarray(t)[..., None] ** powers / powers) @ c

    H, parts = 0.1, 400
    fine = np.diff(integral(np.linspace(0, H, 4 * parts + 1)), axis=0).reshape(parts, 4, 3)
    start = np.array([1.0, 0, 0, 0])
    exact = at.rotation_vector_from_quaternion(
        at.propagate(start, at.rotation_vector_from_increments(fine, third_order="complete"))[-1]
    )
    four = np.diff(integral(np.linspace(0, H, 5)), axis=0)
    error = {
        kind: np.linalg.norm(at.rotation_vector_from_increments(four, third_order=kind) - exact)
        for kind in ("none", "bortz", "complete")
    }
    assert error["complete"] < error["none"] / 10 < error["bortz"] / 50


def test_propagate_keeps_unit_length_and_equals_the_product():
    phi = np.random.default_rng(2).normal(0, 0.05, (20000, 3))
    q = at.propagate([0.6, 0.0, 0.8, 0.0], phi)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-14)
    C = at.dcm_from_quaternion(q[0])
    for v in phi[:200]:
        C = C @ at.dcm_from_rotation_vector(v)
    np.testing.assert_allclose(at.dcm_from_quaternion(q[200]), C, atol=1e-13)
    turns = at.propagate([-1.0, 0, 0, 0], np.full((3, 3), [0.0, 0.0, 3.0]))
    assert turns[0, 0] == -1.0
    big = at.dcm_from_quaternion(turns[1])
    np.testing.assert_allclose(big, at.dcm_from_rotation_vector([0, 0, 3.0]), atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.05, 0.19, 0.199999, 0.200001, 1.0, 6.0])
def test_one_step_is_exact_on_both_sides_of_the_series(size):
    phi = size * np.array([0.6, -0.64, 0.48])
    got = at.propagate([1.0, 0, 0, 0], [phi])[1]
    np.testing.assert_allclose(got, at.quaternion_from_rotation_vector(phi), atol=2.3e-16)


def test_a_fixed_axis_needs_no_correction():
    axis = np.array([0.6, -0.64, 0.48])
    for n in (1, 2, 3, 4):
        parts = np.outer(np.random.default_rng(n).uniform(-0.05, 0.1, n), axis)
        for kind in ("none", "bortz", "complete"):
            np.testing.assert_allclose(
                at.rotation_vector_from_increments(parts, third_order=kind), parts.sum(axis=0), atol=1e-17
            )


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: at.rotation_vector_from_increments(np.ones((5, 3)) * 0.01), "1 to 4"),
        (lambda: at.rotation_vector_from_increments([0.1, 0.2, 0.3]), "shape"),
        (lambda: at.rotation_vector_from_increments([[0.4, 0, 0], [0.4, 0, 0]]), "sample faster"),
        (lambda: at.rotation_vector_from_increments([[np.nan, 0, 0]]), "not finite"),
        (lambda: at.rotation_vector_from_rates(RATES[:1], 0.1), "shape"),
        (lambda: at.rotation_vector_from_rates(RATES, 0.0), "positive"),
        (lambda: at.rotation_vector_from_increments(INCREMENTS, third_order="half"), "complete"),
        (lambda: at.update_coefficients("rates", 5), "1 to 4"),
        (lambda: at.update_coefficients("angles", 2), "increments"),
        (lambda: at.propagate([1.0, 0, 0], INCREMENTS), "quaternion"),
        (lambda: at.propagate([1.0, 0, 0, 0], [[np.nan, 0, 0]]), "not finite"),
    ],
)
def test_refusals_say_why(call, words):
    with pytest.raises(ValueError, match=words):
        call()
