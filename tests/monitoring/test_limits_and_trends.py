"""Limits from tables, exceedances against simulated defects, quality, growth and its significance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from recorded import DEFECTS, TRACK, fields, line, recorded, solved

from railnav.errors import EstimationError, InputError, OffModelError, TrackError
from railnav.io.geometry import write_channels, write_exceedances
from railnav.io.limits import default_limits, default_text, read_limits
from railnav.monitoring.channels import channels_of
from railnav.monitoring.filters import D1, band_pass
from railnav.monitoring.limits import LEVELS, ClassLimit, Combination, exceedances
from railnav.monitoring.monitor import monitor, speed_class
from railnav.monitoring.quality import COMBINED, deviations, grade, segments
from railnav.monitoring.rails import RAILS
from railnav.monitoring.recording import record
from railnav.monitoring.section import onto, passages_of, section_of
from railnav.monitoring.trends import false_discoveries, growth, trends

SPEED = 120.0 / 3.6


def geometry(seed: int, **options):
    section = section_of(line(), [TRACK])
    part = onto(passages_of(solved(seed, **options), line())[0], section)
    assert part is not None
    return channels_of(record(recorded(seed, **options), part, against_model=True))


# --- tables ------------------------------------------------------------------------------------------------------------


def test_the_default_table_says_of_every_value_where_it_is_from():
    table = default_limits()
    for entry in (*table.limits, *table.deviations, *table.classes):
        assert entry.status in ("read", "recalled")
        assert entry.source
    assert 0 < table.recalled < len(table.limits) + len(table.deviations) + len(table.classes)


def test_the_default_table_holds_the_gauge_limits_that_were_read():
    wide = {
        (limit.speed[1] * 3.6): [round(1e3 * limit.levels[level][1]) for level in LEVELS]
        for limit in default_limits().limits
        if limit.channel == "gauge"
    }
    assert {round(k): v for k, v in wide.items()} == {
        40: [20, 30, 35],
        80: [20, 30, 35],
        120: [15, 30, 35],
        160: [15, 25, 35],
        230: [12, 20, 28],
        300: [10, 15, 28],
    }


def test_every_speed_up_to_300_has_exactly_one_limit_of_level_and_gauge():
    table = default_limits()
    for speed in np.arange(1.0, 300.5, 0.5) / 3.6:
        for channel in ("gauge", "longitudinal_level_d1", "alignment_d1"):
            assert sum(x.channel == channel and x.speed[0] < speed <= x.speed[1] + 1e-9 for x in table.limits) == 1


def test_twist_limits_are_over_the_base():
    limit = next(x for x in default_limits().limits if x.channel == "twist_9m" and x.radius[0] == 0.0)
    assert limit.levels["immediate"] == pytest.approx((-0.034 / 9, 0.034 / 9))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t + "\n[odd]\nx = 1\n", r"unknown table \[odd\]"),
        (lambda t: t.replace("gauge_mm = 1435", 'gauge_mm = "wide"'), "gauge_mm is 'wide'"),
        (lambda t: t.replace("alert = [-7, 20]", "alert = [7, 20]", 1), "limit 1.alert: .* is no limit"),
        (
            lambda t: t.replace("intervention = [-8, 30]", "intervention = [-6, 30]", 1),
            "limit 1: intervention is milder than alert",
        ),
        (lambda t: t.replace('status = "read"', 'status = "heard"', 1), "status 'heard' is not known"),
        (lambda t: t.replace("speed_kmh = [0, 40]", "speed_kmh = [40, 0]", 1), "is no range"),
        (lambda t: t.replace("[1.25, 1.75, 2.75, 3.75]", "[1.25, 1.75, 2.75]"), "class 1: limits are"),
        (lambda t: t.replace('channel = "twist_3m"', 'channel = "twist_m"', 1), "names no base"),
        (lambda t: t.replace("immediate = 21", "imediate = 21"), "unknown key 'imediate'"),
        (lambda t: t.replace("gauge_d1 = 1.0", "gauge = 1.0"), "combined: unknown key 'gauge'"),
        (lambda t: t.replace("gauge_d1 = 1.0", "gauge_d1 = -1.0"), "combined.gauge_d1: -1.0 is no weight"),
        (lambda t: t.replace("_d1 = 1.0", "_d1 = 0"), "combined: weighs nothing"),
        (lambda t: t.replace("[table]", "[table", 1), "is no TOML"),
        (lambda _: "", "holds no limit"),
    ],
)
def test_a_broken_table_is_refused_by_entry(tmp_path, change, said):
    file = tmp_path / "limits.toml"
    file.write_text(change(default_text()), encoding="utf-8")
    with pytest.raises(InputError, match=said) as caught:
        read_limits(file)
    assert "limits.toml" in str(caught.value)


def test_an_edited_table_is_used(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('[table]\nname = "mine"\n[[limit]]\nchannel = "gauge"\nalert = 3\n', encoding="utf-8")
    table = read_limits(file)
    assert table.limits[0].status == "own"
    assert math.isnan(table.gauge)
    found, verdicts = exceedances(geometry(1), table, SPEED)
    assert {e.channel for e in found} == {"gauge"}
    assert any(abs(e.offset - 1300.0) < 1.0 and e.value > 0.02 for e in found)
    assert next(v for v in verdicts if v.channel == "cross_level").reason == "the table has no limit for it"


# --- exceedances ------------------------------------------------------------------------------------------------------


def field_of(key: str, s: np.ndarray) -> np.ndarray:
    """The simulated track of a channel along TRACK: gauge as it is, a rail's channel in D1."""
    which = line().track_index(TRACK)
    right, up, cross, gauge = fields().at(np.full(len(s), which), s).T
    if key == "gauge":
        return gauge
    side = 0.5 if "_left_" in key else -0.5
    return band_pass(up + side * cross if key.startswith("longitudinal") else right - side * gauge, 0.25, D1)


def test_every_simulated_defect_beyond_a_limit_is_reported_with_its_place():
    """A defect of level or alignment shows on both rails, and half of one of gauge or cross level on each."""
    found, _ = exceedances(geometry(1), default_limits(), SPEED)
    s = np.arange(0.0, line().length(TRACK), 0.25)
    for defect, name in zip(DEFECTS[:3], ("longitudinal_level", "gauge", "alignment"), strict=True):
        for key in [name] if name == "gauge" else [f"{name}_{rail}_d1" for rail in ("left", "right")]:
            field = field_of(key, s)
            near = np.abs(s - defect.offset) < 5.0
            peak = field[near][np.nanargmax(np.abs(field[near]))]
            mine = [e for e in found if e.channel == key and abs(e.offset - defect.offset) < 5.0 and e.value * peak > 0]
            assert len(mine) == 1, key
            assert mine[0].track == TRACK
            assert mine[0].value == pytest.approx(peak, abs=1e-3)
            point = line().at(TRACK, mine[0].offset)
            assert (mine[0].easting, mine[0].northing) == pytest.approx(
                (float(point.easting), float(point.northing)), abs=1e-6
            )
            assert 0.0 < mine[0].length < defect.length + 2.0
    assert not [e for e in found if e.channel in ("longitudinal_level_d1", "alignment_d1")]
    assert [LEVELS.index(e.level) for e in found] == sorted((LEVELS.index(e.level) for e in found), reverse=True)


def test_limits_hold_for_each_rail_and_for_the_axis_only_where_rails_are_not_shown():
    made = geometry(1)
    _, verdicts = exceedances(made, default_limits(), SPEED)
    reason = {v.channel: v.reason for v in verdicts}
    assert reason["longitudinal_level_d1"] == reason["alignment_d1"] == "judged rail by rail"
    assert not any(reason[f"{name}_{rail}_d1"] for name in ("longitudinal_level", "alignment") for rail in RAILS)
    axis = {key: channel for key, channel in made.channels.items() if "_left_" not in key and "_right_" not in key}
    found, verdicts = exceedances(replace(made, channels=axis), default_limits(), SPEED)
    assert not {v.channel: v.reason for v in verdicts}["alignment_d1"]
    assert {e.channel for e in found} >= {"longitudinal_level_d1", "alignment_d1"}


def test_levels_follow_the_size():
    made = geometry(1)
    for factor, level in ((0.7, "alert"), (1.3, "intervention"), (3.0, "immediate")):
        channel = made.channels["gauge"]
        moved = replace(channel, values=np.full(len(channel.values), 1.435))
        at = np.abs(made.distance - 1300.0) < 2.0
        limit = {"alert": 0.015, "intervention": 0.030, "immediate": 0.035}[level]
        moved.values[at] += limit + 0.002
        found, _ = exceedances(replace(made, channels={"gauge": moved}), default_limits(), SPEED)
        assert [e.level for e in found] == [level], factor


def test_noisy_channels_and_uncertain_tracks_are_not_judged():
    made = geometry(1)
    noisy = replace(made.channels["gauge"], sigma=0.004)
    found, verdicts = exceedances(replace(made, channels={"gauge": noisy}), default_limits(), SPEED)
    assert not found
    assert "over a third" in next(v for v in verdicts if v.channel == "gauge").reason
    unknown = replace(noisy, sigma=math.nan)
    assert not exceedances(replace(made, channels={"gauge": unknown}), default_limits(), SPEED)[0]
    beside = replace(made, recording=replace(made.recording, passage=replace(made.recording.passage, probability=0.1)))
    found, verdicts = exceedances(beside, default_limits(), SPEED)
    assert not found
    assert all(v.reason for v in verdicts)
    assert not exceedances(made, default_limits(), 320.0 / 3.6)[0]


def test_standard_deviations_and_classes():
    x = np.tile([1e-3, -1e-3], 800)
    assert deviations(x, 800) == pytest.approx([1e-3, 1e-3])
    x[:500] = np.nan
    assert np.isnan(deviations(x, 800)[0])
    with pytest.raises(TrackError, match="is none"):
        deviations(x, 1)
    table = ClassLimit("longitudinal_level_d1", (0.0, 40.0), (0.75e-3, 1.1e-3, 1.8e-3, 2.5e-3), "read", "")
    assert [grade(v, table) for v in (0.5e-3, 0.75e-3, 1.0e-3, 2.0e-3, 9e-3)] == ["A", "A", "B", "D", "E"]
    made = geometry(1)
    graded = [s for s in segments(made, default_limits(), SPEED) if s.channel == "longitudinal_level_d1"]
    assert len(graded) > 10
    which, offset = made.recording.passage.section.locate(made.distance)
    truth = band_pass(fields().at(which, offset)[:, 1], 0.25, D1)
    for s in graded:
        mine = truth[
            (made.distance >= s.start) & (made.distance < s.finish) & np.isfinite(made.channels[s.channel].values)
        ]
        assert s.deviation == pytest.approx(np.std(mine), rel=0.05)
        assert s.grade in "ABCDE"


# --- trends -----------------------------------------------------------------------------------------------------------


def test_growth_rates_are_covered_by_their_sigma_and_false_findings_are_rare():
    rng = np.random.default_rng(1)
    months = np.array([0.0, 2.0, 5.0, 9.0])
    squares, false, found = [], 0, 0
    for _ in range(60):
        rate = np.zeros(150)
        rate[:15] = 0.08
        made = growth(months, 1.0 + rate * months[:, None] + rng.normal(0.0, 0.1, (4, 150)))
        squares.append(np.mean(((made.rate - rate) / made.sigma) ** 2))
        false += made.significant[15:].sum()
        found += made.significant[:15].sum()
        assert made.noise == pytest.approx(0.1, rel=0.2)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.05)
    assert false / (false + found) < 0.07  # the share of false findings among all findings
    assert found > 0.9 * 60 * 15


def test_two_dates_show_what_stands_out_among_the_others():
    rng = np.random.default_rng(2)
    values = 1.0 + 0.02 * rng.standard_normal((2, 200))
    values[1, 7] += 0.5
    made = growth([0.0, 3.0], values)
    assert made.significant[7]
    assert made.significant.sum() <= 4
    few = growth([0.0, 3.0], values[:, :4])
    assert not few.significant.any()
    assert np.isnan(few.sigma).all()


def test_two_dates_without_growth_rarely_show_any():
    rng = np.random.default_rng(11)
    wrong = sum(
        bool(growth([0.0, 3.0], 1.0 + 0.1 * rng.standard_normal((2, 50))).significant.any()) for _ in range(400)
    )
    assert wrong < 0.1 * 400  # of sections that do not change, called changed in any of their segments


def test_growth_is_taken_from_runs_of_one_kind_of_sensor():
    first, second = geometry(1, month=1), geometry(2, month=4)
    channel = second.channels["alignment_d2"]
    noisy = replace(channel, source="IMU", values=channel.values * 1.5)
    mixed = replace(second, channels=second.channels | {"alignment_d2": noisy})
    assert "alignment_d2" in {t.channel for t in trends([first, second])}
    assert "alignment_d2" not in {t.channel for t in trends([first, mixed])}
    third = geometry(3, month=7)
    made = next(t for t in trends([first, mixed, third]) if t.channel == "alignment_d2")
    assert made.months == pytest.approx([0.0, 5.95], abs=0.05)


def test_a_run_is_given_once():
    with pytest.raises(TrackError, match="two runs are called 'car-1'; give each run once"):
        monitor([recorded(1), recorded(1)], line(), default_limits())


def test_growth_needs_dates():
    with pytest.raises(EstimationError, match="two dates"):
        growth([1.0, 1.0], [[1.0], [2.0]])
    with pytest.raises(EstimationError, match="do not go with"):
        growth([0.0, 1.0], [[1.0, 2.0]])
    missing = growth([0.0, 1.0, 2.0], [[1.0, np.nan], [2.0, np.nan], [3.1, 4.0]])
    assert np.isnan(missing.rate[1])
    assert not missing.significant[1]
    assert not false_discoveries(np.array([np.nan]), 0.05).any()


def test_a_stretch_that_gets_worse_is_found_and_the_others_are_not():
    made = [geometry(1, month=1), geometry(2, month=4, growing=0.4), geometry(3, month=7, growing=0.8)]
    level = next(t for t in trends(made) if t.channel == "longitudinal_level_d1")
    assert level.months == pytest.approx([0.0, 2.96, 5.95], abs=0.05)
    growing = (level.start + 200.0 > 2300.0) & (level.start < 2600.0)
    assert level.growth.significant[growing].all()
    still = np.isfinite(level.growth.rate) & ~((level.start + 240.0 > 2300.0) & (level.start < 2640.0))
    assert level.growth.significant[still].sum() <= 1
    assert (level.growth.rate[growing] > 0).all()
    assert trends(made[:1]) == []


def test_what_is_significant_is_so_among_all_channels():
    """Two channels of chance alone: a probability that would stand out among a few segments of one does not among those of both."""
    from railnav.monitoring.trends import Growth, Trend, _among_all

    def made(name: str, probability: list[float]) -> Trend:
        p = np.array(probability)
        g = Growth(np.ones(len(p)), np.ones(len(p)), p, false_discoveries(p, 0.05), 1.0, 5.0)
        return Trend(name, name, 200.0 * np.arange(len(p)), np.array([0.0, 1.0]), np.ones((2, len(p))), g)

    few, many = made("gauge_d1", [0.004, 0.5]), made("alignment_d1", [0.3, 0.6] * 40)
    assert few.growth.significant[0]
    assert not any(trend.growth.significant.any() for trend in _among_all([few, many]))
    sure = _among_all([made("gauge_d1", [1e-6, 0.5]), many])
    assert [trend.growth.significant.sum() for trend in sure] == [1, 0]


def test_trends_tell_growth_over_all_channels_together():
    found = trends([geometry(1, month=1), geometry(2, month=4, growing=0.1), geometry(3, month=7, growing=0.2)])
    probability = [trend.growth.probability for trend in found]
    told = np.concatenate([trend.growth.significant for trend in found])
    assert np.array_equal(told, false_discoveries(np.concatenate(probability), 0.05))
    by_channel = np.concatenate([false_discoveries(p, 0.05) for p in probability])
    assert not np.array_equal(told, by_channel)  # else this test could not fail


@pytest.mark.slow
def test_track_that_did_not_change_rarely_shows_growth_and_rates_are_covered():
    """Five triples of dates over the same simulated track: sigma of a rate honest over all channels, no more than one false report."""
    squares, reports = [], 0
    for seed in range(0, 15, 3):
        made = [geometry(70 + seed + k, month=1 + 3 * k) for k in range(3)]
        found = trends(made)
        reports += any(trend.growth.significant.any() for trend in found)
        for trend in found:
            known = np.isfinite(trend.growth.rate)
            squares.append(np.mean((trend.growth.rate[known] / trend.growth.sigma[known]) ** 2))
    assert 0.8 < np.mean(squares) < 1.25
    assert reports <= 1


# --- the whole --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def report():
    runs = [recorded(1), recorded(2, month=4, growing=0.4)]
    return monitor(runs, line(), default_limits())


def test_monitor_lays_runs_over_one_section(report):
    assert len(report.sections) == 1
    part = report.sections[0]
    assert len(part.geometries) == 2
    assert part.overlays[0] is None
    assert part.overlays[1].scatter < 0.05
    assert part.speed == pytest.approx(SPEED)
    assert {e.run for e in part.exceedances} == {"car-1", "car-2"}
    assert part.exceedances[0].run == "car-2"  # the latest first


def test_tables_hold_what_the_report_holds(report, tmp_path):
    import csv

    rows = write_channels(report, tmp_path / "channels.csv")
    with (tmp_path / "channels.csv").open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert len(table) == rows
    assert {
        "run",
        "track",
        "offset_m",
        "gauge_mm",
        "twist_3m_mm_m",
        "longitudinal_level_d1_mm",
        "curvature_1_m",
    } <= set(table[0])
    write_exceedances(report.sections[0].exceedances, tmp_path / "e.csv")
    with (tmp_path / "e.csv").open(encoding="utf-8") as file:
        listed = list(csv.DictReader(file))
    assert len(listed) == len(report.sections[0].exceedances)
    assert float(listed[0]["value_mm"]) == pytest.approx(1e3 * report.sections[0].exceedances[0].value, abs=0.01)


def test_limits_for_another_gauge_are_not_applied():
    made = monitor([recorded(1)], line(), replace(default_limits(), gauge=1.520))
    assert not made.sections[0].exceedances
    assert any(
        "limits not applied: the table is for a gauge of 1520 mm, the runs show 1435 mm" in note for note in made.notes
    )


def test_a_run_that_does_not_cover_the_section_is_said_or_refused():
    with pytest.raises(
        OffModelError, match=r"no run covers any of section 77L-03 .*; they cover 77R-03 \(run 'car-1'\)"
    ):
        monitor([recorded(1)], line(), default_limits(), section=section_of(line(), ["77L-03"]))
    made = monitor([recorded(1)], line(), default_limits(), section=section_of(line(), [TRACK]))
    assert any("covers" in note and "asked for" in note for note in made.notes)
    with pytest.raises(TrackError, match="no run"):
        monitor([], line(), default_limits())


def test_speed_classes():
    assert [round(3.6 * speed_class(v / 3.6)) for v in (30.0, 79.0, 121.0, 125.0, 290.0, 400.0)] == [
        40,
        80,
        120,
        160,
        300,
        300,
    ]


def test_combined_standard_deviation_weighs_what_the_track_really_spreads():
    """Against the simulated fields: the mean of both rails in level and alignment, gauge and cross level, all in D1."""
    made = geometry(1)
    weights = {"longitudinal_level_d1": 0.8, "alignment_d1": 1.0, "gauge_d1": 0.5, "cross_level_d1": 0.3}
    table = replace(default_limits(), combined=Combination(weights, "own", ""))
    graded = [s for s in segments(made, table, SPEED) if s.channel == COMBINED]
    assert len(graded) > 10
    s = np.arange(0.0, line().length(TRACK), 0.25)
    which = line().track_index(TRACK)
    _, _, cross, gauge = fields().at(np.full(len(s), which), s).T
    parts = {
        "longitudinal_level_d1": [field_of(f"longitudinal_level_{rail}_d1", s) for rail in RAILS],
        "alignment_d1": [field_of(f"alignment_{rail}_d1", s) for rail in RAILS],
        "gauge_d1": [band_pass(gauge, 0.25, D1)],
        "cross_level_d1": [band_pass(cross, 0.25, D1)],
    }
    for one in graded:
        here = (s >= one.start) & (s < one.finish)
        if not 300.0 + 37.5 < one.start < one.finish < 3300.0 - 37.5:
            continue
        expected = math.sqrt(sum(w * np.mean([np.std(p[here]) for p in parts[key]]) ** 2 for key, w in weights.items()))
        assert one.deviation == pytest.approx(expected, rel=0.05)
    lone = replace(default_limits(), combined=Combination({"alignment_d1": 1.0}, "own", ""))
    by_rail = {s.channel: s.deviation for s in segments(made, lone, SPEED) if s.start == 1600.0}
    assert by_rail[COMBINED] == pytest.approx(0.5 * (by_rail["alignment_left_d1"] + by_rail["alignment_right_d1"]))
    without = replace(made, recording=replace(made.recording, series={}))
    assert not [s for s in segments(without, default_limits(), SPEED) if s.channel == COMBINED]


@pytest.mark.parametrize("sensors", ["imu", "angles"])
def test_perfect_track_with_turnouts_has_no_exceedance(sensors):
    """No irregularities, but turnouts of 300 m radius, taken by a train whose place is known to centimetres or decimetres."""
    from railnav.simulation import SERVICE, Leg, simulate
    from railnav.simulation.irregularities import GEOMETRY

    outfit = SERVICE if sensors == "imu" else GEOMETRY
    way = next(
        route for route in line().routes("77R-01", "77R-03") if len(route.tracks) > 3
    )  # by the station's other track
    leg = Leg(way.tracks, start=50.0, finish=1500.0)
    run, _ = simulate(line(), leg, seed=6, outfit=outfit, tunnels=False)
    made = monitor([run], line(), default_limits(), against_model=True)
    part = made.sections[0]
    judged = {v.channel for v in part.verdicts[0] if not v.reason}
    assert judged >= ({"alignment_d1"} if sensors == "imu" else {"alignment_left_d1", "alignment_right_d1"})
    assert [(e.channel, round(1e3 * e.value, 1), e.track, round(e.offset)) for e in part.exceedances] == []


def test_where_place_costs_too_much_a_channel_is_not_judged_there():
    made = geometry(1)
    channel = made.channels["alignment_d1"]
    at = np.abs(made.distance - 1700.0) < 20.0  # the defect of 15 mm
    local = np.where(at, 0.02, channel.local)
    found, verdicts = exceedances(
        replace(made, channels={"alignment_d1": replace(channel, local=local)}), default_limits(), SPEED
    )
    assert not [e for e in found if abs(e.offset - 1700.0) < 20.0]
    share = next(v for v in verdicts if v.channel == "alignment_d1").share
    assert 0.9 < share < 1.0
