"""Channels of simulated recording cars against the fields they drove over: values, signs, sigmas, place, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recorded import DEFECTS, FIRST, LAST, TRACK, fields, line, recorded, solved

from railnav.errors import TrackError
from railnav.monitoring.channels import channels_of, twist, twist_gain, versine_channel
from railnav.monitoring.filters import band_pass
from railnav.monitoring.overlay import overlay, shifted
from railnav.monitoring.recording import inertial_curvature, record
from railnav.monitoring.section import onto, passages_of, section_of
from railnav.monitoring.versines import Chord
from railnav.run import GaugeStream
from railnav.simulation import ImuSensor, Leg
from railnav.simulation.irregularities import GEOMETRY, simulate_geometry


def passage(seed: int, **options):
    section = section_of(line(), [TRACK])
    part = onto(passages_of(solved(seed, **options), line())[0], section)
    assert part is not None
    return part


def geometry(seed: int, **options):
    return channels_of(record(recorded(seed, **options), passage(seed, **options), against_model=True))


def true_of(made, key: str) -> np.ndarray:
    """The simulated field of a channel, through the same filter, on the section."""
    which, offset = made.recording.passage.section.locate(made.distance)
    column = {"alignment": 0, "longitudinal_level": 1, "cross_level": 2, "gauge": 3}
    channel = made.channels[key]
    field = fields().at(which, offset)[:, column[key.rsplit("_", 1)[0] if channel.band else key]]
    if channel.band:
        return band_pass(field, made.recording.step, channel.band)
    return field + (made.recording.gauge_nominal if key == "gauge" else made.recording.points.cant)


KEYS = (
    "gauge",
    "cross_level",
    *(f"{name}_d{i}" for name in ("longitudinal_level", "alignment") for i in (1, 2, 3)),
)


@pytest.mark.parametrize("backwards", [False, True], ids=["with offset", "against it"])
@pytest.mark.parametrize("key", KEYS)
def test_channels_are_the_simulated_track(key, backwards):
    made = geometry(1, backwards=backwards)
    error = made.channels[key].values - true_of(made, key)
    known = np.isfinite(error)
    assert known.mean() > 0.15 or key.endswith("d3")
    size = np.std(true_of(made, key)[known])
    assert np.std(error[known]) < 0.1 * size, f"{1e3 * np.std(error[known]):.3f} of {1e3 * size:.3f} mm"
    assert abs(error[known].mean()) < 0.05 * size


def test_stated_sigma_covers_the_error_of_every_channel():
    """Ratio of error to stated sigma over runs of both directions: never understated by half, nor overstated fourfold."""
    for key in KEYS:
        ratio = []
        for seed, back in ((1, False), (2, False), (1, True)):
            made = geometry(seed, backwards=back)
            error = made.channels[key].values - true_of(made, key)
            ratio.append(np.nanstd(error) / made.channels[key].sigma)
        assert 0.25 < np.mean(ratio) < 1.5, f"{key}: {ratio}"


@pytest.mark.parametrize("backwards", [False, True], ids=["with offset", "against it"])
@pytest.mark.parametrize("rail", ["left", "right"])
def test_rails_are_the_simulated_ones_whichever_way_the_car_ran(rail, backwards):
    """Left stands above by half the cross level and to the left by half the gauge; errors within the stated sigma."""
    made = geometry(1, backwards=backwards)
    which, offset = made.recording.passage.section.locate(made.distance)
    right, up, cross, gauge = fields().at(which, offset).T
    side = 0.5 if rail == "left" else -0.5
    for name, field in (("longitudinal_level", up + side * cross), ("alignment", right - side * gauge)):
        for band in (1, 2, 3):
            channel = made.channels[f"{name}_{rail}_d{band}"]
            error = channel.values - band_pass(field, 0.25, channel.band)
            size = np.nanstd(band_pass(field, 0.25, channel.band))
            assert np.nanstd(error) < 0.15 * size, (
                f"{name} D{band}: {1e3 * np.nanstd(error):.3f} of {1e3 * size:.3f} mm"
            )
            assert 0.2 < np.nanstd(error) / channel.sigma < 1.5


def test_short_waves_of_level_are_given_where_samples_are_close_enough():
    made = geometry(1)
    assert made.channels["longitudinal_level_left_d0"].band.lower == 1.0
    assert "longitudinal_level_d0" not in channels_of(record(recorded(1), passage(1), step=0.5)).channels
    coarse = channels_of(record(recorded(1), passage(1), step=0.5)).refused
    assert "takes steps of 0.33 m, not of 0.5 m" in coarse["longitudinal_level_d0"]


def test_rails_are_refused_with_the_reason_where_cross_level_or_gauge_is_missing():
    run = recorded(1)
    made = channels_of(record(replace(run, gauge=replace(run.gauge, cant=None)), passage(1), against_model=True))
    assert "longitudinal_level_left_d1" in made.channels  # by the roll of the body
    made = channels_of(record(replace(run, gauge=None), passage(1), against_model=True))
    assert "the run has no gauge" in made.refused["alignment_left_d1"]
    assert "alignment_d1" in made.channels


def test_twist_is_the_growth_of_cross_level_and_a_ramp_shows_its_slope():
    made = geometry(1)
    true = true_of(made, "cross_level")
    for base in (3.0, 9.0):
        channel = made.channels[f"twist_{base:g}m"]
        error = channel.values - twist(true, 0.25, base)
        assert np.nanstd(error) < 1.5 * channel.sigma
    ramp = np.arange(400) * 0.25 / 500.0
    assert np.nanmax(np.abs(twist(ramp, 0.25, 3.0) - 1 / 500.0)) < 1e-12
    assert twist_gain([3.0, 6.0], 3.0) == pytest.approx([0.0, 2.0], abs=1e-12)
    with pytest.raises(TrackError, match="does not fit"):
        twist(ramp, 0.25, 0.3)


def test_a_run_over_the_section_reversed_gives_the_same_section_channels():
    up, down = geometry(1), geometry(1, backwards=True)
    for key in ("gauge", "cross_level", "longitudinal_level_d1", "alignment_d1"):
        a, b = up.channels[key].values, down.channels[key].values
        both = np.isfinite(a) & np.isfinite(b)
        assert np.corrcoef(a[both], b[both])[0, 1] > 0.97, key


def test_runs_overlay_to_the_decimetre_and_better():
    reference = geometry(1)
    for options in ({"seed": 2}, {"seed": 1, "backwards": True}):
        lies = overlay(geometry(**options), reference)
        assert lies.windows > 20
        assert len(lies.shift) > 0.9 * lies.windows
        moved = shifted(passage(**options), lies)
        again = overlay(channels_of(record(recorded(**options), moved, against_model=True)), reference)
        assert np.abs(again.shift).max() < 0.1
        assert np.abs(again.shift).max() <= np.abs(lies.shift).max() + 0.01


def test_overlay_finds_a_shift_that_was_put_in():
    made = passage(2)
    wrong = replace(made, distance=made.distance + 0.8)
    lies = overlay(channels_of(record(recorded(2), wrong, against_model=True)), geometry(1))
    assert np.median(lies.shift) == pytest.approx(0.8, abs=0.1)


def test_imu_alone_gives_curvature_and_short_waves():
    outfit = replace(GEOMETRY, angles=None, gauge=None, imu=ImuSensor())
    run, _ = simulate_geometry(
        line(), Leg((TRACK,), start=FIRST, finish=LAST), fields(), seed=9, outfit=outfit, tunnels=False
    )
    from railnav.navigation import navigate

    found = passages_of(navigate(run, line(), smooth=True), line())[0]
    made = channels_of(record(run, found, against_model=True))
    assert "gauge" not in made.channels
    assert "no gauge stream" in made.refused["gauge"]
    expected = made.recording.points.curvature
    inside = np.isfinite(made.channels["curvature"].values) & (made.recording.speed > 10.0)
    assert np.abs(made.channels["curvature"].values - expected)[inside].mean() < 4e-5
    for key in ("longitudinal_level_d1", "alignment_d1"):
        error = made.channels[key].values - true_of(made, key)
        assert np.nanstd(error) < 0.25 * np.nanstd(true_of(made, key))
        assert np.nanstd(error) < made.channels[key].sigma


def test_inertial_curvature_has_the_sign_of_the_section_and_none_at_a_crawl():
    assert inertial_curvature(np.array([0.01, 0.01, 0.01]), np.array([10.0, -10.0, 0.1])) == pytest.approx(
        [1e-3, -1e-3, np.nan], nan_ok=True
    )


def test_coarse_streams_are_refused_band_by_band_with_the_reason():
    run = recorded(1)
    angles, gauge = run.gyro_angles, run.gauge
    thin = replace(
        run,
        gyro_angles=replace(
            angles,
            time=angles.time[::40],
            roll=angles.roll[::40],
            pitch=angles.pitch[::40],
            heading=angles.heading[::40],
        ),
        gauge=GaugeStream(time=gauge.time[::35], gauge=gauge.gauge[::35], cant=gauge.cant[::35]),
    )
    made = channels_of(record(thin, passage(1), against_model=True))
    assert "sampled each" in made.refused["longitudinal_level_d1"]
    assert "GNSS" not in made.refused["longitudinal_level_d1"]
    assert "longitudinal_level_d2" in made.channels
    assert "base of 3 m takes 1.5 m" in made.refused["twist_3m"]
    assert any("shorter defects are missed" in note for note in made.recording.notes)


def test_gnss_alone_gives_long_waves_and_says_what_it_would_leave_in_the_bands():
    run = replace(recorded(1), gyro_angles=None, gauge=None)
    made = channels_of(record(run, passage(1), against_model=True))
    assert set(made.channels) == {"plan_deviation", "height_deviation"}
    assert "mm of noise in D3" in made.refused["alignment_d3"]
    assert "too far for waves of 3 m" in made.refused["alignment_d1"]
    assert made.channels["plan_deviation"].title.endswith("waves over 200 m")


def test_gauge_outliers_are_left_out_counted_and_said():
    run = recorded(1)
    rng = np.random.default_rng(1)
    wild = run.gauge.gauge.copy()
    rows = np.flatnonzero(np.isfinite(passage(1).where(run.gauge.time)))
    hit = rng.choice(rows[50:-50], 40, replace=False)
    wild[hit[:20]] = 0.9  # no gauge at all
    wild[hit[20:]] += 0.012  # a lone spike
    made = channels_of(record(replace(run, gauge=replace(run.gauge, gauge=wild)), passage(1), against_model=True))
    clean = geometry(1)
    difference = made.channels["gauge"].values - clean.channels["gauge"].values
    assert np.nanmax(np.abs(difference)) < 0.002
    said = next(note for note in made.recording.notes if note.startswith("gauge"))
    assert "20 samples outside" in said
    assert int(said.split(" and ")[1].split()[0]) >= 15
    # the real defect of 22 mm over 5 m stays
    at = np.abs(made.distance - 1300.0) < 1.0
    assert np.nanmax(made.channels["gauge"].values[at]) - 1.435 > 0.018


def test_versines_of_the_measured_alignment_are_those_of_the_simulated_one():
    made = geometry(1)
    v = versine_channel(made, Chord.symmetric(10.0))
    assert np.isfinite(v).sum() > 1000
    with pytest.raises(TrackError, match="no alignment channel"):
        versine_channel(replace(made, channels={}), Chord.symmetric(10.0))


def test_a_section_is_lawful_or_refused():
    model = line()
    with pytest.raises(TrackError, match="stands twice"):
        section_of(model, [TRACK, TRACK])
    with pytest.raises(TrackError, match="no permitted movements"):
        section_of(model, ["77R-01", "77L-01"])
    with pytest.raises(TrackError, match="no track 'x'"):
        section_of(model, ["x"])
    section = section_of(model, ["77R-01", "77R-02"])
    d = np.linspace(0.0, section.length, 50)
    assert section.project(*section.locate(d)) == pytest.approx(d, abs=1e-6)
    assert np.isnan(section.project([section.model.track_index(TRACK)], [10.0])).all()


def test_defects_are_where_they_were_put():
    made = geometry(1)
    for defect, key in zip(DEFECTS, ("longitudinal_level_d1", "gauge", "alignment_d1", "twist_3m"), strict=True):
        x = made.channels[key].values - (1.435 if key == "gauge" else 0.0)
        near = np.abs(made.distance - defect.offset) < 30.0
        k = np.flatnonzero(near)[np.nanargmax(np.abs(x[near]))]
        assert abs(made.distance[k] - defect.offset) < (0.6 if key != "twist_3m" else 3.0)
        if key != "twist_3m":
            assert np.sign(x[k]) == np.sign(defect.size)
