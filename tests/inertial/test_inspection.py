"""Inspection of inertial logs: each defect is found where it is and nothing is found in a sound log."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from railnav.inertial.inspection import inspect_log

N, DT = 3000, 0.01


def log(seed=0):
    rng = np.random.default_rng(seed)
    t = np.arange(N) * DT
    w = rng.normal(0, 2e-3, (N, 3)) + 0.03 * np.sin(0.2 * t)[:, None]
    f = rng.normal(0, 0.05, (N, 3)) + np.array([0.2, 0.1, -9.81])
    return [t, w, f]


@pytest.mark.parametrize("seed", range(10))
def test_a_sound_log_has_no_findings(seed):
    assert inspect_log(*log(seed)) == ()


@pytest.mark.parametrize("quantum", [1e-3, 0.01, 0.05])
def test_a_coarse_but_sound_log_has_no_findings(quantum):
    t, w, f = log()
    assert inspect_log(t, np.round(w / quantum * 10) * quantum / 10, np.round(f / quantum) * quantum) == ()


def backwards(t, w, f):
    t[1200:] -= 5.0


def gap(t, w, f):
    t[700:] += 2.5


def not_finite(t, w, f):
    w[400:410, 1] = np.nan


def missing(t, w, f):
    f[:, 0] = np.nan


def dead(t, w, f):
    f[:, 1] = 0.0


def frozen(t, w, f):
    w[1000:1400, 2] = w[1000, 2]


def saturated(t, w, f):
    f[2000:2030, 0] = 19.6133


def in_g(t, w, f):
    f /= 9.80665


def in_mg(t, w, f):
    f /= 9.80665e-3


def in_gal(t, w, f):
    f *= 100.0


def in_degrees(t, w, f):
    w += 0.2 * np.sin(t)[:, None]
    w *= 180 / np.pi


def upward(t, w, f):
    f[:, 1:] *= -1


def turned(t, w, f):
    f[:] = f[:, [2, 0, 1]]


def without_gravity(t, w, f):
    f[:, 2] += 9.81


@pytest.mark.parametrize(
    ("spoil", "kind", "channel", "first", "words"),
    [
        (backwards, "clock", "", 1200, "sort the rows"),
        (gap, "gap", "", 700, "2.51 s before sample 700"),
        (not_finite, "not finite", "rate y", 400, "10 samples, first 400"),
        (missing, "not finite", "specific force x", 0, "is missing"),
        (dead, "frozen", "specific force y", 0, "all the time"),
        (frozen, "frozen", "rate z", 1000, "for 4.0 s"),
        (saturated, "saturated", "specific force x", 2000, "end of its range"),
        (in_g, "unit", "specific force", 0, "in g; multiply it by 9.80665"),
        (in_mg, "unit", "specific force", 0, "in mg"),
        (in_gal, "unit", "specific force", 0, "in Gal; multiply it by 0.01"),
        (in_degrees, "unit", "rate", None, "degrees per second"),
        (upward, "axes", "specific force", 0, "turn the signs of y and z"),
        (turned, "axes", "specific force", 0, "reorder the axes"),
        (without_gravity, "unit", "specific force", 0, "gravity was taken off"),
    ],
)
def test_each_defect_is_found(spoil, kind, channel, first, words):
    data = log()
    spoil(*data)
    found = inspect_log(*data)
    match = [x for x in found if (x.kind, x.channel) == (kind, channel)]
    assert len(match) == 1, found
    assert words in match[0].sentence
    if first is not None:
        assert match[0].first == first
    assert len(found) == 1 or spoil is missing, found


def test_real_train_is_sound_once_in_radians(shared_data):
    file = shared_data / "tud_train" / "imu_processed_data.csv"
    if not file.is_file():
        pytest.skip("tud_train is not here")
    with file.open(encoding="utf-8") as stream:
        x = np.array([[float(v) for v in row[1:]] for row in list(csv.reader(stream))[1:]])
    found = inspect_log(np.arange(len(x)) * 0.002, np.radians(x[:, 3:]), x[:, :3])
    assert found == ()


def test_refusals():
    t, w, f = log()
    with pytest.raises(ValueError, match="needs time"):
        inspect_log(t, w[:-1], f)
    with pytest.raises(ValueError, match="at least 50"):
        inspect_log(t[:10], w[:10], f[:10])
