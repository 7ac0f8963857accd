"""Parts of the protection level against the normal law: quantiles, sigmas that lie, the odds of a frame that is off."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numba import njit
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from railnav.matching import _kernels as paths
from railnav.navigation import columns as c
from railnav.navigation.integrity import _kernels as integrity
from railnav.navigation.integrity import protection_level
from railnav.navigation.state import Settings


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
    return integrity.wander(info, paths.ASTRAY_CROSS, paths.ASTRAY_VARIANCE, off, white, walk)


@njit
def do_offset(info, error, white, coloured, phi, walk):
    return integrity.offset_row(info, error, white, coloured, phi, walk)


@njit
def do_odds(fil, info, known):
    integrity.known_odds(fil, info, known)


@njit
def do_missing(info):
    return integrity.track_missing(info)


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


def settings(**changes):
    """A filter of which the kernels read the settings only."""
    at = np.full(17, -1, np.int64)
    return c.Filter(at, Settings(**changes).packed(), np.zeros(3), np.zeros(3), 0)


def seen(errors, *, white=0.5, coloured=1.0, phi=0.98, walk=0.0):
    """Marks of a hypothesis after fixes with these errors across."""
    info = np.zeros(paths.INFO)
    info[[paths.ASTRAY, paths.OFFSET_VARIANCE]] = -np.inf, -1.0
    total = 0.0
    for error in errors:
        nis, spread = do_offset(info, error, white, coloured, phi, walk)
        total += -0.5 * (nis + math.log(2.0 * math.pi * spread))
    return info, total


def exact(errors, prior, *, white=0.5, coloured=1.0, phi=0.98):
    """ln p of errors = constant + first-order Gauss-Markov + white noise, by the covariance of all of them at once."""
    m = len(errors)
    lags = np.abs(np.subtract.outer(np.arange(m), np.arange(m)))
    return multivariate_normal(np.zeros(m), prior + coloured * phi**lags + white * np.eye(m)).logpdf(errors)


def test_what_is_known_of_a_constant_error_is_weighed_after_the_fact_as_exactly_as_beforehand():
    """A wide prior, exchanged for a narrow one or a mixture, against the joint law of all fixes under these."""
    errors = 2.0 + 0.4 * np.random.default_rng(3).standard_normal(40)
    info, total = seen(errors)
    assert total == pytest.approx(exact(errors, c.ANYWHERE**2), abs=1e-6)
    do_odds(settings(frame_fault=0.1, frame_fault_sigma=7.0), info, 0.3)
    sound, fault = exact(errors, 0.3) + math.log(0.9), exact(errors, 49.3) + math.log(0.1)
    assert total + info[paths.KNOWN_ODDS] == pytest.approx(np.logaddexp(sound, fault), abs=1e-6)
    assert total + info[paths.FAULT_ODDS] == pytest.approx(fault, abs=1e-6)
    assert do_frame_off(info) == pytest.approx(math.exp(fault - np.logaddexp(sound, fault)), rel=1e-6)


def test_a_track_that_the_model_lacks_is_as_probable_as_the_joint_law_has_it():
    errors = 4.5 + 0.4 * np.random.default_rng(4).standard_normal(60)
    info, total = seen(errors)
    do_odds(settings(frame_fault=0.0, track_missing=0.05), info, 0.2)
    beside = np.linspace(c.BESIDE_LEAST, c.BESIDE_MOST, 2001)
    law = [exact(errors - side * d, 0.2) for side in (-1.0, 1.0) for d in beside]
    elsewhere = math.log(0.05) + logsumexp(law) - math.log(len(law))
    assert total + info[paths.MISSING_ODDS] == pytest.approx(elsewhere, abs=0.01)
    here = exact(errors, 0.2)
    assert do_missing(info) == pytest.approx(math.exp(elsewhere - np.logaddexp(here, elsewhere)), abs=0.01)
    assert do_missing(info) > 0.5


def test_nothing_is_said_of_a_missing_track_before_the_first_fix_nor_where_none_is_presumed():
    info = np.zeros(paths.INFO)
    info[[paths.ASTRAY, paths.OFFSET_VARIANCE]] = -np.inf, -1.0
    do_odds(settings(), info, 0.2)
    assert do_missing(info) == do_frame_off(info) == 0.0
    info, _ = seen([5.0] * 100)
    do_odds(settings(track_missing=0.0), info, 0.2)
    assert do_missing(info) == 0.0


def test_an_error_that_may_be_anything_is_a_scalar_kalman_filter():
    """Against the textbook: ln p, then mean and variance; a negative variance starts at the first fix."""
    info = np.zeros(paths.INFO)
    info[paths.ASTRAY_VARIANCE] = 100.0
    mean, variance = 0.0, 100.0
    for off in (7.5, 8.0, 6.9):
        total = variance + 0.3 + 0.5
        nis, spread = do_wander(info, off, 0.5, 0.3)
        said = nis + math.log(2.0 * math.pi * spread)
        assert said == pytest.approx(-2.0 * norm.logpdf(off, mean, math.sqrt(total)))
        gain = (variance + 0.3) / total
        mean, variance = mean + gain * (off - mean), (1.0 - gain) * (variance + 0.3)
        assert info[[paths.ASTRAY_CROSS, paths.ASTRAY_VARIANCE]] == pytest.approx([mean, variance])
    info[paths.ASTRAY_VARIANCE] = -1.0
    assert math.isnan(do_wander(info, 3.0, 0.5, 0.3)[0])
    assert info[[paths.ASTRAY_CROSS, paths.ASTRAY_VARIANCE]] == pytest.approx([3.0, 0.5])
