"""Parts of the protection level against the normal law: quantiles, sigmas that lie, the odds of a frame that is off."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numba import njit
from scipy.stats import norm

from railnav.matching import _kernels as paths
from railnav.navigation import columns as c
from railnav.navigation.integrity import _kernels as integrity
from railnav.navigation.integrity import protection_level


@njit
def do_quantile(risk):
    return integrity.tail_quantile(risk)


@njit
def do_misfit(common, nis):
    integrity.watch_misfit(common, nis)
    common[c.C_FIXES] += 1.0
    return integrity.understated(common)


@njit
def do_frame_off(info):
    return integrity.frame_off(info)


@njit
def do_wander(info, off, white, walk):
    return integrity.wander(info, paths.FRAMED_CROSS, paths.FRAMED_VARIANCE, off, white, walk)


@pytest.mark.parametrize("risk", [1e-9, 1e-7, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.3])
def test_the_quantile_is_safe_and_close(risk):
    exact = norm.isf(0.5 * risk)
    assert exact <= do_quantile(risk) < 1.03 * exact + 1e-3


def test_the_mixture_of_the_specification():
    """Section 22: w = (.999, .001), mu = (0, 6), sigma = .6."""
    for risk, level in ((1e-2, 1.567), (1e-4, 6.763), (1e-7, 8.225)):
        found = protection_level([0.999, 0.001], [0.0, 6.0], [0.6, 0.6], integrity_risk=risk)
        assert found == pytest.approx(level, rel=2e-3)


@pytest.mark.parametrize(("truth", "low", "high"), [(1.0, 1.0, 1.15), (3.0, 2.0, 3.5)])
def test_sigmas_that_lie_are_seen_by_their_innovations(truth, low, high):
    random = np.random.default_rng(5)
    common = np.zeros(c.COMMON_SIZE)
    factors = [do_misfit(common, truth**2 * random.chisquare(2)) for _ in range(400)]
    assert low <= np.mean(factors[40:]) < high


def test_the_odds_of_a_frame_that_is_off():
    info = np.zeros(paths.INFO)
    info[[paths.FADING, paths.ASTRAY, paths.FRAMED_ODDS]] = 0.0, -np.inf, math.log(0.01)
    assert do_frame_off(info) == pytest.approx(0.01 / 1.01)
    info[paths.ASTRAY] = 0.0
    assert do_frame_off(info) == pytest.approx(0.01 / 2.01)


def test_an_error_that_may_be_anything_is_a_scalar_kalman_filter():
    """Against the textbook: ln p, then mean and variance; a negative variance starts at the first fix."""
    info = np.zeros(paths.INFO)
    info[paths.FRAMED_VARIANCE] = 100.0
    mean, variance = 0.0, 100.0
    for off in (7.5, 8.0, 6.9):
        total = variance + 0.3 + 0.5
        nis, spread = do_wander(info, off, 0.5, 0.3)
        said = nis + math.log(2.0 * math.pi * spread)
        assert said == pytest.approx(-2.0 * norm.logpdf(off, mean, math.sqrt(total)))
        gain = (variance + 0.3) / total
        mean, variance = mean + gain * (off - mean), (1.0 - gain) * (variance + 0.3)
        assert info[[paths.FRAMED_CROSS, paths.FRAMED_VARIANCE]] == pytest.approx([mean, variance])
    info[paths.FRAMED_VARIANCE] = -1.0
    assert math.isnan(do_wander(info, 3.0, 0.5, 0.3)[0])
    assert info[[paths.FRAMED_CROSS, paths.FRAMED_VARIANCE]] == pytest.approx([3.0, 0.5])
