"""Stated track probabilities against what is true: counted by hand, and by navigators of known honesty."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.errors import InputError
from railnav.evaluation import pooled_reliability, reliability
from railnav.evaluation.reliability import binomial_bounds


def test_classes_by_hand():
    r = reliability([0.2, 0.6, 0.6, 0.6, 0.999, 1.0, np.nan], [False, True, True, False, True, True, True])
    assert [(c.low, c.high, c.rows) for c in r.classes] == [(0.0, 0.5, 1), (0.5, 0.7, 3), (0.999, 1.0, 2)]
    assert r.classes[1].right == pytest.approx(2 / 3)
    assert r.classes[2].stated == pytest.approx(0.9995)
    assert r.rows == 6
    assert r.brier == pytest.approx((0.04 + 0.16 * 2 + 0.36 + 1e-6) / 6)


def test_an_honest_navigator_is_found_honest_and_an_overconfident_one_is_not():
    random = np.random.default_rng(5)
    stated = random.uniform(0.5, 1.0, 6000)
    honest = reliability(stated, random.random(6000) < stated)
    assert honest.honest
    assert all(c.lower < c.stated < c.upper for c in honest.classes if c.rows > 50)
    boastful = reliability(stated, random.random(6000) < stated - 0.1)
    assert not boastful.honest
    modest = reliability(stated * 0.8, random.random(6000) < stated)
    assert modest.honest  # modest is no fault


def test_one_decision_repeated_is_one_sample():
    wrong_for_a_minute = np.r_[np.ones(300, bool), np.zeros(60, bool), np.ones(300, bool)]
    r = reliability(np.full(660, 0.97), wrong_for_a_minute)
    assert r.classes[0].effective < 20
    assert r.classes[0].upper > 0.97  # ten minutes with one bad minute do not convict
    scattered = reliability(np.full(660, 0.97), np.random.default_rng(1).permutation(wrong_for_a_minute))
    assert scattered.classes[0].effective > 200
    assert not scattered.honest


def test_runs_are_pooled_class_by_class():
    random = np.random.default_rng(2)
    parts = [reliability(p, random.random(200) < p) for p in random.uniform(0.6, 1.0, (40, 200))]
    together = pooled_reliability(parts)
    assert together.rows == 8000
    assert together.honest
    assert max(c.upper - c.lower for c in together.classes) < max(c.upper - c.lower for c in parts[0].classes)
    assert pooled_reliability([]).honest is None


def test_binomial_bounds_are_those_of_clopper_and_pearson():
    from scipy.stats import binomtest

    for k, n in ((0, 10), (3, 10), (10, 10), (1, 400)):
        ci = binomtest(k, n).proportion_ci(0.95, method="exact")
        assert binomial_bounds(k, n) == pytest.approx((ci.low, ci.high), abs=1e-12)


def test_nonsense_is_refused():
    with pytest.raises(InputError, match="outside 0 to 1"):
        reliability([1.2], [True])
    with pytest.raises(InputError, match="one of each a row"):
        reliability([0.5, 0.5], [True])
