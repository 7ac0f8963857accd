"""Filters and chords against waves known in closed form, and the numbers of the specification."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.errors import TrackError
from railnav.monitoring.filters import (
    D1,
    D2,
    D3_ALIGNMENT,
    D3_LEVEL,
    Band,
    band_noise,
    band_pass,
    gain,
    low_pass,
    noise_floor,
    resample,
    spikes,
)
from railnav.monitoring.versines import (
    Chord,
    closed_versines,
    hallade,
    restore,
    slews_by_versines,
    versines,
    versines_in_plan,
)

STEP = 0.25
S = np.arange(0.0, 3000.0, STEP)
BANDS = (D1, D2, D3_LEVEL, D3_ALIGNMENT)


@pytest.mark.parametrize("band", BANDS, ids=lambda b: f"{b.name}-{b.upper:g}")
@pytest.mark.parametrize("integrate", [0, 1, 2])
def test_waves_pass_as_stated_without_shift_to_one_percent(band, integrate):
    for wave in np.geomspace(band.lower, band.upper, 12):
        omega = 2 * np.pi / wave
        given = np.sin(omega * S + 0.4 + 0.5 * np.pi * integrate) * omega**integrate
        out = band_pass(given, STEP, band, integrate=integrate)
        expected = gain(wave, band) * np.sin(omega * S + 0.4)
        assert np.nanmax(np.abs(out - expected)) < 0.01


@pytest.mark.parametrize("band", BANDS, ids=lambda b: f"{b.name}-{b.upper:g}")
def test_edges_are_at_minus_three_decibels_and_fall_by_24_an_octave(band):
    assert gain([band.lower, band.upper], band) == pytest.approx(np.sqrt(0.5), rel=0.01)
    far = gain([16 * band.upper, 32 * band.upper], band)
    assert 20 * np.log10(far[0] / far[1]) == pytest.approx(24.08, abs=0.05)


def test_the_amplitude_is_that_of_scipys_butterworth_filters():
    """An independent witness: analogue high-pass and low-pass of order 4 in cascade."""
    from scipy.signal import butter, freqs

    for band in BANDS:
        waves = np.geomspace(0.3 * band.lower, 3.0 * band.upper, 40)
        _, low = freqs(*butter(4, 1.0 / band.lower, analog=True), worN=1.0 / waves)
        _, high = freqs(*butter(4, 1.0 / band.upper, btype="high", analog=True), worN=1.0 / waves)
        assert np.abs(low * high) == pytest.approx(gain(waves, band), abs=1e-9)


def test_gaps_part_a_channel_and_leave_nan_about_them():
    x = np.sin(2 * np.pi * S / 10.0)
    x[6000:6010] = np.nan
    out = band_pass(x, STEP, D1)
    margin = round(D1.settling / STEP)
    assert np.isnan(out[6000 - margin : 6010 + margin]).all()
    assert np.isfinite(out[margin : 6000 - margin]).all()
    assert np.isfinite(out[6010 + margin : len(S) - margin]).all()


def test_what_cannot_be_filtered_is_refused_or_left_empty():
    with pytest.raises(TrackError, match="too long for D1"):
        band_pass(np.zeros(1000), 1.5, D1)
    with pytest.raises(TrackError, match="0, 1 or 2"):
        band_pass(np.zeros(1000), 0.25, D1, integrate=3)
    with pytest.raises(TrackError, match="one row"):
        band_pass(np.zeros((3, 3)), 0.25, D1)
    with pytest.raises(TrackError, match="0 < lower < upper"):
        Band("odd", 10.0, 5.0)
    assert np.isnan(band_pass(np.ones(100), 0.25, D3_LEVEL)).all()
    assert band_pass(np.empty(0), 0.25, D1).shape == (0,)


@pytest.mark.parametrize("integrate", [0, 1, 2])
def test_noise_in_a_band_is_what_is_stated(integrate):
    rng = np.random.default_rng(7)
    noise = 1e-3 * rng.standard_normal(len(S))
    out = band_pass(noise, STEP, D1, integrate=integrate)
    assert np.nanstd(out) == pytest.approx(band_noise(1e-3, STEP, D1, integrate=integrate), rel=0.25)


def test_resampling_keeps_a_short_wave_and_does_not_bridge_gaps():
    rng = np.random.default_rng(3)
    d = np.sort(rng.uniform(0.0, 500.0, 6000))
    d = d[(d < 200.0) | (d > 210.0)]
    out = resample(d, np.sin(2 * np.pi * d / 3.0), np.arange(0.0, 500.0, 0.25), gap=2.0)
    grid = np.arange(0.0, 500.0, 0.25)
    inside = (grid > 5) & (grid < 495) & ((grid < 195) | (grid > 215))
    assert np.abs(out - np.sin(2 * np.pi * grid / 3.0))[inside].max() < 0.05
    assert np.isnan(out[(grid > 200.5) & (grid < 209.5)]).all()
    assert np.isnan(resample([1.0], [2.0], grid, gap=1.0)).all()


def test_standing_still_does_not_weigh_more():
    d = np.concatenate([np.linspace(0, 10, 50), np.full(500, 10.0), np.linspace(10, 20, 50)])
    out = resample(d, 2 * d, np.arange(0.0, 20.0, 0.25), gap=1.0)
    error = np.abs(out - 2 * np.arange(0.0, 20.0, 0.25))
    assert error.max() < 0.1
    assert error[4:-4].max() < 3e-3


def test_lone_spikes_are_found_and_a_real_defect_is_not():
    rng = np.random.default_rng(4)
    x = 1e-4 * rng.standard_normal(2000)
    x += 0.02 * np.exp(-(((np.arange(2000) - 1000) / 8.0) ** 2))  # a defect over several samples
    x[[300, 301, 700]] += 0.03
    found = np.flatnonzero(spikes(x, least=0.003))
    assert {300, 301, 700} <= set(found) <= {300, 301, 700}


def test_noise_floor_ignores_slow_signals():
    rng = np.random.default_rng(5)
    x = np.sin(np.arange(5000) / 50.0) + 1e-3 * rng.standard_normal(5000)
    assert noise_floor(x) == pytest.approx(1e-3, rel=0.1)
    assert np.isnan(noise_floor([1.0, 2.0]))


# --- chords: the table of the specification (track_geometry.md 4) ---------------------------------------------------------


@pytest.mark.parametrize(
    ("a", "b", "versine", "low", "high", "zeros", "at70", "at150"),
    [
        (5.0, 5.0, 12.5, 0.0, 2.0, [5.0], 0.099, 0.022),
        (10.0, 10.0, 50.0, 0.0, 2.0, [10.0, 5.0, 3.33], 0.377, 0.086),
        (4.1, 17.4, 35.67, 0.264, 1.95, [], 0.263, 0.061),
        (4.0, 6.0, 12.0, 0.66, 1.90, [], 0.095, 0.021),
        (2.6, 6.0, 7.8, 0.44, 1.89, [], 0.062, 0.014),
        (9.4488, 9.4488, 44.6, 0.0, 2.0, [9.45, 4.73, 3.15], 0.339, 0.077),
    ],
)
def test_chord_transfer_of_the_table_to_its_digits(a, b, versine, low, high, zeros, at70, at150):
    chord = Chord(a, b)
    assert chord.factor == pytest.approx(versine, abs=0.05)
    seen = chord.seen(D1)
    assert seen[0] == pytest.approx(low, abs=0.0051)
    assert seen[1] == pytest.approx(high, abs=0.0051)
    assert chord.blind(3.0, 25.0) == pytest.approx(zeros, abs=0.0065)
    assert np.abs(chord.transfer([70.0, 150.0])) == pytest.approx([at70, at150], abs=0.00051)


@pytest.mark.parametrize("chord", [Chord.symmetric(10.0), Chord(4.0, 6.0), Chord(2.5, 6.0)])
def test_versines_of_a_wave_are_minus_its_transfer(chord):
    for wave in (7.0, 30.0, 90.0):
        y = np.sin(2 * np.pi * S / wave)
        v = versines(y, STEP, chord)
        expected = -np.imag(chord.transfer(wave) * np.exp(2j * np.pi * S / wave))
        assert np.nanmax(np.abs(v - expected)) < 1e-9


def test_a_right_hand_circle_has_positive_versines_in_plan():
    angle = np.arange(0.0, 200.0, 0.5) / 300.0
    chord = Chord(4.0, 6.0)
    v = versines_in_plan(300.0 * (1 - np.cos(angle)), 300.0 * np.sin(angle), 0.5, chord)
    assert np.nanmean(v) == pytest.approx(chord.factor / 300.0, rel=1e-3)
    assert np.isnan(v[:8]).all()
    assert np.isnan(v[-12:]).all()


@pytest.mark.parametrize("chord", [Chord(4.0, 6.0), Chord(2.5, 6.0)])
def test_versines_are_restored_by_the_inverse_transfer(chord):
    rng = np.random.default_rng(6)
    y = 0.01 * low_pass(rng.standard_normal(len(S)), STEP, 6.0)
    restored = restore(versines(y, STEP, chord), STEP, chord, D1)
    expected = band_pass(y, STEP, D1)
    inside = np.isfinite(restored) & np.isfinite(expected)
    assert inside.sum() > 8000
    assert np.abs(restored - expected)[inside].max() < 0.01 * np.abs(expected[inside]).max()


def test_a_blind_chord_is_refused_with_the_waves_it_misses():
    with pytest.raises(TrackError, match=r"10\.00, 5\.00, 3\.33 m: D1"):
        restore(np.zeros(4000), STEP, Chord.symmetric(20.0), D1)
    with pytest.raises(TrackError, match="no whole number of steps"):
        versines(np.zeros(100), 0.3, Chord.symmetric(20.0))
    with pytest.raises(TrackError, match="must be positive"):
        Chord(0.0, 5.0)


def test_hallade_closes_and_gives_the_slews_that_change_the_versines():
    rng = np.random.default_rng(8)
    y = np.zeros(41)
    y[2:-2] = 0.01 * rng.standard_normal(37)
    v_e = versines(y, 1.0, Chord.symmetric(2.0))[1:-1]
    v_e = np.concatenate([[0.0], v_e, [0.0]])
    slews = hallade(v_e, np.zeros(41))
    assert slews.closure == pytest.approx(0.0, abs=1e-12)  # sum of versine changes
    assert slews.closure_moment == pytest.approx(0.0, abs=1e-12)  # first moment
    assert slews.slew == pytest.approx(-y, abs=1e-12)


def test_closed_versines_keep_both_ends():
    rng = np.random.default_rng(9)
    v_e = 0.05 + 0.01 * rng.standard_normal(30)
    v_d = closed_versines(v_e, np.full(30, 0.05))
    assert (v_d - v_e).sum() == pytest.approx(0.0, abs=1e-12)
    assert np.arange(30) @ (v_d - v_e) == pytest.approx(0.0, abs=1e-11)
    assert hallade(v_e, v_d).slew[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-11)
    assert v_d[1:-1] == pytest.approx(0.05)


def test_hallade_refuses_what_does_not_fit():
    with pytest.raises(TrackError, match="equal length"):
        hallade([0.0, 1.0, 2.0], [0.0, 1.0])
    with pytest.raises(TrackError, match="versine 1 is not finite"):
        hallade([0.0, np.nan, 2.0], [0.0, 1.0, 2.0])


def test_smoothed_versines_take_short_waves_out_and_leave_long_ones_and_both_ends():
    s = 10.0 * np.arange(400)
    short, long = 0.006 * np.sin(2 * np.pi * s / 50.0), 0.03 * np.sin(2 * np.pi * s / 800.0)
    slew = slews_by_versines(short + long, 10.0)
    assert slew[0] == 0.0
    assert abs(slew[-1]) < 1e-9
    inside = slice(40, -40)
    assert np.abs(slew + short)[inside].max() < 0.1 * 0.006
    assert np.abs(slews_by_versines(short + long, float("nan")) + short + long)[inside].max() < 0.03


def test_versines_are_not_smoothed_where_nothing_is_left_to_smooth():
    assert len(slews_by_versines(np.zeros(7), 10.0)) == 0
    assert len(slews_by_versines(np.zeros(50), 2.0)) == 0
