"""Odometry: printed vectors of B4, orders of integration, counter wrap, wheel scale with honest sigma."""

from __future__ import annotations

import math

import numpy as np
import pytest

from railnav.errors import EstimationError
from railnav.vehicle.odometry import (
    dead_reckon,
    fit_wheel_scale,
    minimum_radius,
    ticks_to_distance,
    tricycle,
    two_wheels,
)

DEGREE = math.pi / 180


def circle(integration, dt, left=6.0, right=5.4, seconds=10.0):
    motion = two_wheels(left, right, track=1.5)
    n = round(seconds / dt)
    return dead_reckon(np.full(n, motion.speed), np.full(n, motion.turn_rate), dt, integration=integration)


@pytest.mark.parametrize(
    ("integration", "errors", "tolerance"),
    [("euler", (0.518, 0.259, 0.130), 4e-3), ("midpoint", (1.7e-3, 4.3e-4, 1.1e-4), 0.05), ("arc", (0, 0, 0), 0)],
)
def test_two_wheels_on_a_circle_as_printed(integration, errors, tolerance):
    # radius 0.3 m, 20 and 18 rad/s: the source turns left, the house counts to the right
    exact = np.array([-10.78443556, 23.5644216])
    for dt, printed in zip((0.1, 0.05, 0.025), errors, strict=True):
        end = circle(integration, dt)[-1]
        assert end[2] == pytest.approx(4.0)
        assert np.linalg.norm(end[:2] - exact) == pytest.approx(printed, rel=tolerance, abs=6e-9)


def test_turning_left_is_the_mirror_image():
    right, left = circle("arc", 0.1), circle("arc", 0.1, left=5.4, right=6.0)
    np.testing.assert_allclose(left, right * [1, -1, -1], atol=1e-12)


def test_tricycle_as_printed():
    front = tricycle(5.0, 20 * DEGREE, wheelbase=2.5, driven="front")
    assert front.speed == pytest.approx(4.698463104, abs=5e-10)
    assert front.turn_rate == pytest.approx(0.6840402866, abs=1e-10)
    rear = tricycle(front.speed, 20 * DEGREE, wheelbase=2.5)
    assert rear.turn_rate == pytest.approx(front.turn_rate, rel=1e-14)
    assert minimum_radius(30 * DEGREE, 2.5) == pytest.approx(4.330127, abs=5e-7)
    assert rear.speed / rear.turn_rate == pytest.approx(minimum_radius(20 * DEGREE, 2.5))


def test_circle_by_speed_and_gyro_as_printed():
    end = dead_reckon(np.full(628, 8.0), np.full(628, 0.1), 0.1, integration="euler")[-1]
    assert end[:2] == pytest.approx((-0.254820, 0.001680), abs=6e-7)
    exact = dead_reckon(np.full(628, 8.0), np.full(628, 0.1), 0.1)[-1]
    assert exact[:2] == pytest.approx((80 * math.sin(6.28), 80 * (1 - math.cos(6.28))), abs=1e-11)


def test_ticks_as_printed_and_across_the_wrap():
    per_tick = 2 * math.pi * 0.28 / 512
    assert per_tick * 1e3 == pytest.approx(3.4361, abs=5e-5)
    assert per_tick / 0.1 == pytest.approx(0.0344, abs=5e-5)
    true = np.cumsum(np.random.default_rng(0).integers(-50, 200, 500)) + 1000
    wrapped = np.mod(true, 1024)
    np.testing.assert_allclose(ticks_to_distance(wrapped, per_tick, modulus=1024), np.diff(true) * per_tick)
    with pytest.raises(EstimationError, match="reading 1: too far"):
        ticks_to_distance([0, 400], per_tick, modulus=1024)


def test_unequal_wheels_turn_the_heading_as_printed():
    motion = two_wheels(10.05, 10.0, track=1.2)
    seconds = 1000 / 10.0
    assert motion.turn_rate * seconds / DEGREE == pytest.approx(239, abs=1)


def test_reversing_comes_back():
    rng = np.random.default_rng(1)
    u, w, h = rng.normal(5, 2, 300), rng.normal(0, 0.3, 300), rng.uniform(0.01, 0.2, 300)
    out = dead_reckon(u, w, h, start=(100.0, -50.0, 1.0))
    back = dead_reckon(-u[::-1], -w[::-1], h[::-1], start=tuple(out[-1]))
    np.testing.assert_allclose(back[-1], [100.0, -50.0, 1.0], atol=1e-10)
    straight = dead_reckon([2.0], [1e-13], 3.0)[-1]
    np.testing.assert_allclose(straight[:2], [6.0, 0.0], atol=1e-11)
    spin = dead_reckon([0.0], [1.0], 3.0)[-1]
    np.testing.assert_array_equal(spin, [0.0, 0.0, 3.0])


def test_wheel_scale_is_found_through_slip_with_an_honest_sigma():
    rng = np.random.default_rng(2)
    score, square = [], []
    for _ in range(200):
        v = np.abs(rng.normal(15, 6, 400))
        z = 0.985 * v + rng.normal(0, 0.1, 400)
        slipping = rng.random(400) < 0.05
        got = fit_wheel_scale(z, np.where(slipping, v * 1.4, v), reference_sigma=0.1)
        score.append((got.scale - 0.985) / got.sigma)
        square.append(got.chi_square)
        assert got.rejected >= 5
    assert np.std(score) == pytest.approx(1.0, abs=0.15)
    assert abs(np.mean(score)) < 0.3
    assert np.mean(square) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: two_wheels(1.0, 1.0, track=0.0), ValueError, "track"),
        (lambda: two_wheels(np.nan, 1.0, track=1.0), ValueError, "left"),
        (lambda: tricycle(1.0, 20.0, wheelbase=2.5), ValueError, "degrees"),
        (lambda: tricycle(1.0, 0.2, wheelbase=0.0), ValueError, "wheelbase"),
        (lambda: tricycle(1.0, 0.2, wheelbase=2.0, driven="middle"), ValueError, "front"),
        (lambda: dead_reckon([1.0, 1.0], [0.0], 0.1), ValueError, "shape"),
        (lambda: dead_reckon([1.0], [0.0], -0.1), ValueError, "step 0"),
        (lambda: dead_reckon([1.0], [0.0], 0.1, integration="rk"), ValueError, "arc"),
        (lambda: ticks_to_distance([1, 2], 0.0), ValueError, "metres_per_tick"),
        (lambda: ticks_to_distance([1, 2], 0.1, modulus=0), ValueError, "modulus"),
        (lambda: fit_wheel_scale([1.0] * 5, [1.0] * 5, reference_sigma=0.1), EstimationError, "too few"),
        (
            lambda: fit_wheel_scale(np.arange(50.0), np.arange(50.0)[::-1], reference_sigma=0.1),
            EstimationError,
            "check the clocks",
        ),
        (lambda: fit_wheel_scale([1.0], [1.0, 2.0], reference_sigma=0.1), ValueError, "shape"),
    ],
)
def test_refusals_say_why(call, error, words):
    with pytest.raises(error, match=words):
        call()
