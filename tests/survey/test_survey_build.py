"""What surveys are really like: offsets, stops, outliers, gaps, other tracks, missing directions; and what is refused."""

import json

import numpy as np
import pytest
from survey_simulator import (
    PHONE,
    SURVEY,
    Receiver,
    axis_error,
    centre_line,
    changed,
    double_line,
    drive,
    knots,
    only,
    plane,
)

from railnav.errors import RunError
from railnav.run import Run
from railnav.survey import build

PASSES = 3


def single_line(seed, *, km=4.0, passes=PASSES, receivers=(SURVEY,), direction="up", **options):
    """Runs over one track, all one way."""
    rng = np.random.default_rng([seed, 2])
    frame = plane()
    axis = centre_line(seed, km, frame=frame)
    runs = [
        drive(
            axis,
            frame,
            rng,
            run_id=f"run-{p + 1}",
            direction=direction,
            receiver=receivers[p % len(receivers)],
            day=p,
            **options,
        )
        for p in range(passes)
    ]
    return runs, axis, frame, rng


def report(model):
    return model.provenance["build"]


def entry(model, name):
    return next(run for run in report(model)["runs"] if run["id"] == name)


def rms(model, track, axis):
    error, _ = axis_error(model, track, axis)
    return float(np.sqrt(np.mean(error**2)))


# ------------------------------------------------------------------------------------------------------------ report


def test_the_report_is_json_and_counts_every_fix():
    runs, _, _, _ = single_line(1, km=2.0)
    model = build(runs)
    text = json.dumps(model.provenance, allow_nan=False)
    assert json.loads(text) == model.provenance
    for run in runs:
        fixes = entry(model, run.id)["fixes"]
        assert fixes["total"] == len(run.gnss)
        assert fixes["used"] + sum(r["count"] for r in fixes["rejected"].values()) == fixes["total"]
    assert report(model)["tracks"][0]["runs"] == ["run-1", "run-2", "run-3"]
    assert report(model)["tracks"][0]["length_m"] == pytest.approx(model.length("up"), abs=1e-3)


def test_progress_is_told_and_inputs_are_not_touched():
    runs, _, _, _ = single_line(1, km=1.0)
    for run in runs:
        for name in ("time", "latitude", "longitude", "height", "sigma_east", "sigma_north"):
            getattr(run.gnss, name).flags.writeable = False
    told = []
    first = build(runs, progress=lambda stage, done, total: told.append((stage, done, total)))
    assert {stage for stage, _, _ in told} >= {"gather", "estimate", "tabulate"}
    assert all(0 <= done <= total for _, done, total in told)
    again = build(runs)
    assert np.array_equal(first.easting, again.easting)
    assert first.provenance == again.provenance


# ----------------------------------------------------------------------------------------------------- frame offsets


def test_an_offset_between_receivers_is_found_and_reported():
    logger = Receiver("logger", white=0.5, correlated=1.5, memory=60.0, rate=5.0, offset=(-2.4, -9.8, 0.0))
    phone = Receiver("phone", white=0.8, correlated=1.5, memory=40.0, rate=1.0)
    runs, _truth, _ = double_line(7, km=15.0, passes=4, receivers=(logger, phone))
    model = build(runs)
    kinds = {r["receiver"]: r for r in report(model)["receivers"]}
    east = kinds["logger"]["offset_east_m"] - kinds["phone"]["offset_east_m"]
    north = kinds["logger"]["offset_north_m"] - kinds["phone"]["offset_north_m"]
    sigma_e = np.hypot(kinds["logger"]["sigma_east_m"], kinds["phone"]["sigma_east_m"])
    sigma_n = np.hypot(kinds["logger"]["sigma_north_m"], kinds["phone"]["sigma_north_m"])
    assert abs(east + 2.4) < 3 * sigma_e < 6.0
    assert abs(north + 9.8) < 3 * sigma_n < 6.0
    # the datum lies between the two, and is known no better than they agree
    assert kinds["logger"]["offset_north_m"] == pytest.approx(-kinds["phone"]["offset_north_m"], abs=0.05)
    assert report(model)["datum"]["observable"]
    assert report(model)["datum"]["sigma_north_m"] == pytest.approx(0.5 * abs(north), abs=0.05)
    assert any("difference of frames" in w and "m north" in w for w in report(model)["warnings"])


def test_three_kinds_of_receiver_outvote_one():
    north = {"a": 0.0, "b": 0.3, "c": -9.8}
    kinds = [Receiver(name, 0.05, 0.1, 30.0, 1.0, offset=(0.0, off, 0.0)) for name, off in north.items()]
    runs, axis, _, _ = single_line(3, km=6.0, passes=6, receivers=tuple(kinds))
    model = build(runs)
    offsets = {r["receiver"]: r["offset_north_m"] for r in report(model)["receivers"]}
    assert offsets["c"] < -8.5
    assert max(abs(offsets["a"]), abs(offsets["b"])) < 1.2
    assert rms(model, "up", axis) < 1.2


def test_one_kind_of_receiver_cannot_see_a_common_offset_and_says_so():
    runs, _, frame, _ = single_line(5, km=3.0)
    moved = []
    for run in runs:
        e, n, h = frame.to_grid(run.gnss.latitude, run.gnss.longitude, run.gnss.height)
        latitude, longitude, _ = frame.to_geodetic(e + 3.0, n - 7.0, h)
        moved.append(changed(run, latitude=latitude, longitude=longitude))
    here, there = build(runs), build(moved)
    m = min(len(here.easting), len(there.easting))
    assert np.abs(there.easting[:m] - here.easting[:m] - 3.0).max() < 0.02
    assert np.abs(there.northing[:m] - here.northing[:m] + 7.0).max() < 0.02
    a, b = (
        np.array([[r["frame_offset"][c] for c in ("east_m", "north_m", "up_m")] for r in report(m)["runs"]])
        for m in (here, there)
    )
    assert np.abs(a - b).max() < 1e-3
    assert not report(here)["datum"]["observable"]
    assert any("one kind of receiver" in w for w in report(here)["warnings"])


def test_one_run_that_stands_apart_is_named():
    runs, _, frame, _ = single_line(6, km=6.0, passes=4)
    e, n, h = frame.to_grid(runs[2].gnss.latitude, runs[2].gnss.longitude, runs[2].gnss.height)
    latitude, longitude, _ = frame.to_geodetic(e, n + 0.40, h + 0.25)
    runs[2] = changed(runs[2], latitude=latitude, longitude=longitude, height=h + 0.25)
    offsets = [r["frame_offset"] for r in report(build(runs))["runs"]]
    others = np.mean([offsets[i]["north_m"] for i in (0, 1, 3)])
    assert offsets[2]["north_m"] - others == pytest.approx(0.40, abs=0.05)
    others = np.mean([offsets[i]["up_m"] for i in (0, 1, 3)])
    assert offsets[2]["up_m"] - others == pytest.approx(0.25, abs=0.05)


# --------------------------------------------------------------------------------------------- stops, outliers, sigmas


def test_thousands_of_fixes_at_a_stop_do_not_bend_the_track():
    runs, axis, frame, _ = single_line(8, km=3.0, stop=0.0)
    plain = build(runs)
    gnss = runs[0].gnss
    at = len(gnss) // 2
    many = 20000  # more than an hour at 5 Hz, held by the receiver 6 cm off
    e, n, h = frame.to_grid(gnss.latitude[at], gnss.longitude[at], gnss.height[at])
    latitude, longitude, _ = frame.to_geodetic(float(e) + 0.06, float(n) + 0.06, float(h))

    def with_stop(values, held):
        return np.concatenate([values[:at], np.full(many, held), values[at:]])

    halted = changed(
        runs[0],
        time=np.concatenate([gnss.time[:at], gnss.time[at] + 0.2 * np.arange(many), gnss.time[at:] + 0.2 * many]),
        latitude=with_stop(gnss.latitude, float(latitude)),
        longitude=with_stop(gnss.longitude, float(longitude)),
        height=with_stop(gnss.height, float(h)),
        sigma_east=with_stop(gnss.sigma_east, gnss.sigma_east[at]),
        sigma_north=with_stop(gnss.sigma_north, gnss.sigma_north[at]),
    )
    stopped = build([halted, *runs[1:]])
    m = min(len(plain.easting), len(stopped.easting))
    moved = np.hypot(stopped.easting[:m] - plain.easting[:m], stopped.northing[:m] - plain.northing[:m])
    error_plain, _ = axis_error(plain, "up", axis)
    error, _ = axis_error(stopped, "up", axis)
    middle = slice(m // 2 - 100, m // 2 + 100)
    assert np.abs(error[middle] - error_plain[middle]).max() < 0.015
    assert np.median(moved) < 0.01


def test_outliers_are_set_aside_and_the_worst_is_shown():
    runs, axis, frame, rng = single_line(9)
    spoilt, wild = [], {}
    for run in runs:
        e, n, h = frame.to_grid(run.gnss.latitude, run.gnss.longitude, run.gnss.height)
        bad = rng.random(len(run.gnss)) < 0.03
        size = rng.uniform(2.0, 40.0, len(bad)) * rng.choice([-1, 1], len(bad)) * bad
        _, at = axis.right_of(e, n)
        latitude, longitude, _ = frame.to_geodetic(
            e + size * np.cos(axis.bearing[at]), n - size * np.sin(axis.bearing[at]), h
        )
        spoilt.append(changed(run, latitude=latitude, longitude=longitude))
        wild[run.id] = (int(bad.sum()), float(run.gnss.time[np.argmax(np.abs(size))]), float(np.abs(size).max()))
    model = build(spoilt)
    assert rms(model, "up", axis) < 0.015
    for name, (many, when, size) in wild.items():
        rejected = entry(model, name)["fixes"]["rejected"]
        assert set(rejected) <= {"gross error across the track", "faster than any train"}
        count = sum(reason["count"] for reason in rejected.values())
        assert 0.99 * many <= count <= 1.05 * many + 3
        worst = max((reason["worst"][0] for reason in rejected.values()), key=lambda w: w["size_m"])
        assert worst["time_s"] == pytest.approx(when, abs=1e-3)
        assert worst["size_m"] == pytest.approx(
            size, abs=6.0
        )  # a jump is measured from where the train was before or after


@pytest.mark.parametrize("factor", [None, 0.1, 10.0])
def test_stated_sigmas_may_lie_or_be_missing(factor):
    runs, axis, _, _ = single_line(10, km=3.0)
    honest = build(runs)
    if factor is None:
        lying = [changed(run, sigma_east=None, sigma_north=None) for run in runs]
    else:
        lying = [
            changed(run, sigma_east=factor * run.gnss.sigma_east, sigma_north=factor * run.gnss.sigma_north)
            for run in runs
        ]
    model = build(lying)
    assert rms(model, "up", axis) < 0.014
    assert np.abs(model.easting - honest.easting).max() < 1e-3
    assert np.allclose(model.covariance_g[:, [0, 3]], honest.covariance_g[:, [0, 3]], rtol=0.05)


def test_the_minutes_after_switching_on_are_left_out():
    runs, axis, frame, _ = single_line(11, km=3.0)
    e, n, h = frame.to_grid(runs[1].gnss.latitude, runs[1].gnss.longitude, runs[1].gnss.height)
    fade = np.exp(-runs[1].gnss.time / 15.0)
    latitude, longitude, _ = frame.to_geodetic(e + 300.0 * fade, n - 200.0 * fade, h)
    sigma = runs[1].gnss.sigma_east + 400.0 * fade
    runs[1] = changed(runs[1], latitude=latitude, longitude=longitude, sigma_east=sigma, sigma_north=sigma)
    model = build(runs)
    assert rms(model, "up", axis) < 0.015
    assert entry(model, "run-2")["fixes"]["rejected"]["stated sigma far above the run's own"]["count"] > 300


def test_coarse_digits_and_whole_seconds():
    receiver = Receiver("logger", white=0.3, correlated=0.6, memory=40.0, rate=1.0)
    runs, axis, _, rng = single_line(12, km=5.0, receivers=(receiver,))
    digits = np.radians(1e-6)
    coarse = [
        changed(
            run,
            latitude=np.round(run.gnss.latitude / digits) * digits,
            longitude=np.round(run.gnss.longitude / digits) * digits,
            time=run.gnss.time + np.clip(rng.normal(0.0, 0.2, len(run.gnss)), -0.45, 0.45),
        )
        for run in runs
    ]
    assert rms(build(coarse), "up", axis) < rms(build(runs), "up", axis) + 0.10


# ------------------------------------------------------------------------------------------- gaps, parts, other tracks


def test_a_tunnel_is_bridged_with_an_honest_sigma_and_reported():
    runs, axis, frame, _ = single_line(13)

    def outside(run):
        e, n, _ = frame.to_grid(run.gnss.latitude, run.gnss.longitude)
        _, at = axis.right_of(e, n)
        return (at < 1800) | (at > 2200)

    model = build([only(run, outside(run)) for run in runs])
    error, sigma = axis_error(model, "up", axis)
    k = knots(model, "up")
    _, at = axis.right_of(model.easting[k], model.northing[k])
    inside = (at > 1810) & (at < 2190)
    assert (np.abs(error[inside]) < 4.0 * sigma[inside]).all()
    assert sigma[inside].max() > 10 * np.median(sigma[~inside])
    assert np.sqrt(np.mean(error[~inside] ** 2)) < 0.015
    bare = [part for part in report(model)["tracks"][0]["survey_again"] if part["reason"] == "no fixes"]
    assert len(bare) == 1
    assert bare[0]["to_m"] - bare[0]["from_m"] == pytest.approx(400.0 - 120.0, abs=40.0)
    assert any("no fixes" in w for w in report(model)["warnings"])
    assert entry(model, "run-1")["coverage"]["gaps"] == 1


def test_a_run_may_cover_a_part_only():
    runs, axis, frame, rng = single_line(14, passes=2)
    runs.append(drive(axis, frame, rng, run_id="half", direction="up", begin=0.3, end=0.7))
    model = build(runs)
    assert rms(model, "up", axis) < 0.015
    assert entry(model, "half")["coverage"]["share"] == pytest.approx(0.4, abs=0.05)


def test_runs_that_overlap_end_to_end_make_one_track():
    frame, rng = plane(), np.random.default_rng(5)
    axis = centre_line(15, 6.0, frame=frame)
    runs = [
        drive(axis, frame, rng, run_id=f"{b}", direction="up", begin=b, end=e)
        for b, e in ((0.0, 0.4), (0.3, 0.7), (0.6, 1.0))
    ]
    model = build(runs)
    assert model.track_id == ("up",)
    assert model.length("up") == pytest.approx(axis.arc[-1], rel=2e-3)
    assert rms(model, "up", axis) < 0.03


def test_a_stretch_on_another_track_is_seen_and_never_averaged():
    """Precise runs make a track of it, between two turnouts."""
    runs, axis, frame, rng = single_line(16)
    s = axis.arc
    ramp = np.clip((s - 1500.0) / 60.0, 0.0, 1.0) * np.clip((2600.0 - s) / 60.0, 0.0, 1.0)
    beside = axis.shifted(4.5 * ramp**2 * (3.0 - 2.0 * ramp))
    runs[1] = drive(beside, frame, rng, run_id="run-2", direction="up")
    model = build(runs)
    assert sorted(model.track_id) == ["up-2", "up/1", "up/2", "up/3"]
    for part in ("up/1", "up/2", "up/3"):
        assert rms(model, part, axis) < 0.015
    assert rms(model, "up-2", beside) < 0.03
    assert model.length("up/1") == pytest.approx(1500.0, abs=25.0)
    assert model.length("up-2") == pytest.approx(1100.0, abs=50.0)
    assert entry(model, "run-2")["tracks"] == ["up", "up-2"]


@pytest.mark.parametrize("apart", [1.6, 2.2])
def test_runs_too_near_to_be_on_two_tracks_contradict_and_are_not_averaged(apart):
    runs, axis, frame, rng = single_line(17, passes=2)
    s = axis.arc
    ramp = np.clip((s - 1500.0) / 60.0, 0.0, 1.0) * np.clip((2600.0 - s) / 60.0, 0.0, 1.0)
    runs[1] = drive(axis.shifted(apart * ramp**2 * (3.0 - 2.0 * ramp)), frame, rng, run_id="run-2", direction="up")
    model = build(runs)
    assert model.track_id == ("up",)
    assert rms(model, "up", axis) < 0.03  # it follows the first run
    assert entry(model, "run-2")["other_track"]
    assert entry(model, "run-1")["other_track"] == []


# ---------------------------------------------------------------------------------------------------------- grouping


def test_without_directions_accurate_runs_tell_the_tracks_apart():
    runs, truth, _ = double_line(18, km=4.0, directions=("", ""))
    model = build(runs)
    assert model.track_id == ("track-1", "track-2")
    assert sorted(len(t["runs"]) for t in report(model)["tracks"]) == [3, 3]
    assert rms(model, "track-1", truth["up"]) < 0.015
    assert rms(model, "track-2", truth["down"]) < 0.015


def test_a_single_track_run_both_ways_is_one_track():
    frame, rng = plane(), np.random.default_rng(6)
    axis = centre_line(19, 4.0, frame=frame)
    runs = [drive(axis, frame, rng, run_id=f"{i}", backwards=bool(i % 2)) for i in range(4)]
    model = build(runs)
    assert model.track_id == ("track-1",)
    assert rms(model, "track-1", axis) < 0.015


def test_the_data_overrule_a_wrong_direction():
    runs, truth, _ = double_line(20, km=4.0, directions=("up", "up"))
    model = build(runs)
    assert model.track_id == ("up", "up-2")
    assert any("the data decide" in w for w in report(model)["warnings"])
    assert rms(model, "up-2", truth["down"]) < 0.015


def test_phones_without_directions_do_not_invent_a_second_track_in_silence():
    runs, _, _ = double_line(21, km=4.0, receivers=(PHONE,), directions=("", ""))
    model = build(runs)
    assert len(model.track_id) in (1, 2)
    assert any("no direction" in w for w in report(model)["warnings"])


def test_runs_on_different_lines_make_different_tracks():
    frame, rng = plane(), np.random.default_rng(7)
    one, other = centre_line(22, 2.0, frame=frame), centre_line(23, 2.0, frame=frame, bearing=3.5)
    runs = [
        drive(axis, frame, rng, run_id=f"{name}-{i}", direction=name)
        for name, axis in (("a", one), ("b", other))
        for i in (1, 2)
    ]
    model = build(runs)
    assert model.track_id == ("a", "b")


def test_the_order_of_runs_changes_nothing_but_the_order():
    runs, _, _ = double_line(24, km=2.0)
    one, two = build(runs), build([runs[0], *runs[:0:-1]])
    assert set(one.track_id) == set(two.track_id)
    for name in one.track_id:
        a, b = knots(one, name), knots(two, name)
        assert np.abs(one.easting[a] - two.easting[b]).max() < 2e-3


def test_a_run_that_turns_back_is_cut_and_said_so():
    runs, axis, frame, rng = single_line(27, km=3.0)
    there = drive(axis, frame, rng, run_id="both", direction="up", begin=0.1, end=0.9)
    back = drive(axis.shifted(-4.0), frame, rng, run_id="back", backwards=True, begin=0.4, end=0.9)
    join = {
        name: np.concatenate([getattr(there.gnss, name), getattr(back.gnss, name)])
        for name in ("latitude", "longitude", "height", "sigma_east", "sigma_north")
    }
    time = np.concatenate([there.gnss.time, there.gnss.time[-1] + 60.0 + back.gnss.time])
    model = build([changed(there, time=time, **join), *runs])
    assert model.track_id == ("up",)
    assert rms(model, "up", axis) < 0.015
    aside = entry(model, "both")["fixes"]["rejected"]["before or after turning back"]
    assert aside["count"] == pytest.approx(len(back.gnss), rel=0.1)
    assert any("both turns back" in w for w in report(model)["warnings"])


def test_a_track_of_three_hundred_metres():
    runs, axis, _, _ = single_line(28, km=0.1)
    keep = [only(run, slice(0, 60)) for run in runs]
    model = build(keep)
    assert 200.0 < model.length("up") < 350.0
    assert rms(model, "up", axis) < 0.03


def test_a_lever_arm_leans_with_the_cant():
    from dataclasses import replace

    from railnav.run import GaugeStream

    arm = np.array([0.0, 0.4, -3.6])
    frame, rng = plane(), np.random.default_rng(8)
    axis = centre_line(25, 3.0, frame=frame)
    cant = 45.0 * axis.curvature  # 150 mm at 300 m; a curve to the right lifts the left rail
    runs = []
    for i in range(3):
        back = (
            i == 2
        )  # the third run goes the other way: left and right change places, and so does the sign of the cant
        sense = -1.0 if back else 1.0
        lean = arm[1] * np.cos(np.arcsin(cant / 1.5)) - arm[2] * sense * cant / 1.5
        run = drive(axis.shifted(sense * lean), frame, rng, run_id=f"{i}", direction="up", stop=0.0, backwards=back)
        e, n, h = frame.to_grid(run.gnss.latitude, run.gnss.longitude, run.gnss.height)
        _, at = axis.right_of(e, n)
        gauge = GaugeStream(time=run.gnss.time, gauge=np.full(len(at), 1.435), cant=sense * cant[at])
        runs.append(replace(run, gnss=replace(run.gnss, lever_arm_b=arm, height=h + 3.6), gauge=gauge))
    model = build(runs)
    assert rms(model, "up", axis) < 0.016
    assert all(run["fixes"]["used"] > 0.98 * run["fixes"]["total"] for run in report(model)["runs"])
    k = knots(model, "up")
    _, at = axis.right_of(model.easting[k], model.northing[k])
    assert np.abs(model.cant[k] - cant[at])[20:-20].max() < 0.02


# ----------------------------------------------------------------------------------------------------------- refusals


def test_nothing_to_build_from():
    with pytest.raises(RunError, match="no runs"):
        build([])


def test_a_run_without_gnss():
    runs, _, _, _ = single_line(1, km=1.0)
    with pytest.raises(RunError, match=r"bare.*no GNSS"):
        build([*runs, Run(id="bare", start=runs[0].start)])


def test_a_run_of_three_fixes():
    runs, _, _, _ = single_line(1, km=1.0)
    short = only(runs[0], slice(100, 103))
    with pytest.raises(RunError, match="run-1: 3 usable fixes of 3"):
        build([short])
    model = build([short, *runs[1:]])  # among others it is left out, and the report says so
    assert entry(model, "run-1")["fixes"]["used"] == 0
    assert any("run-1 was left out" in w for w in report(model)["warnings"])


def test_a_run_that_never_moves():
    runs, _, _, _ = single_line(1, km=1.0)
    gnss = runs[0].gnss
    still = changed(
        runs[0], latitude=0 * gnss.latitude + gnss.latitude[0], longitude=0 * gnss.longitude + gnss.longitude[0]
    )
    with pytest.raises(RunError, match="moves over 0 m"):
        build([still])


def test_a_run_in_another_part_of_the_world_is_named():
    runs, _, _, _ = single_line(1, km=1.0)
    runs[1] = changed(runs[1], longitude=runs[1].gnss.longitude + np.radians(30.0))
    with pytest.raises(
        RunError, match=r"run-2: the run lies around latitude 50\.\d+, longitude 39\.\d+ deg, far from run-1"
    ):
        build(runs)


def test_one_run_alone_is_built_and_warned_about():
    runs, axis, _, _ = single_line(26, km=2.0, passes=1)
    model = build(runs)
    assert rms(model, "up", axis) < 0.05
    assert any("rests on one run" in w for w in report(model)["warnings"])
    assert any("assumed" in w for w in report(model)["warnings"])


# ---------------------------------------------------------------------------------------- verdicts and repeatability


def test_every_gross_error_is_told_with_time_place_size_and_reason():
    runs, _axis, _frame, _ = single_line(3, km=2.0)
    latitude = runs[0].gnss.latitude.copy()
    latitude[200] += np.radians(20.0 / 111_000)
    told = report(build([changed(runs[0], latitude=latitude), *runs[1:]]))["verdicts"]
    fix = next(v for v in told["list"] if v["what"] == "fix" and v["run"] == "run-1")
    assert fix["time_s"] == pytest.approx(runs[0].gnss.time[200])
    assert fix["size"] > 1.0
    assert fix["reason"]
    assert fix["fixes"] == 1
    assert told["total"] >= len(told["list"]) >= 1


def test_fixes_that_follow_one_another_are_one_verdict_and_counted_one_by_one():
    runs, _axis, _frame, _ = single_line(3, km=2.0)
    latitude = runs[0].gnss.latitude.copy()
    latitude[200:210] += np.radians(2.0 / 111_000)
    latitude[400] += np.radians(3.0 / 111_000)
    told = report(build([changed(runs[0], latitude=latitude), *runs[1:]]))
    mine = [v for v in told["verdicts"]["list"] if v["what"] == "fix" and v["run"] == "run-1"]
    t = runs[0].gnss.time
    many = next(v for v in mine if v["fixes"] >= 10)
    assert many["fixes"] <= 16  # a few neighbours, judged by an axis that it had bent
    assert many["time_s"] == pytest.approx(t[200], abs=1.5)
    assert many["to_time_s"] == pytest.approx(t[209], abs=1.5)
    assert many["to_m"] - many["offset_m"] == pytest.approx(9 * 0.2 * 22, rel=0.6)
    assert any(v["fixes"] == 1 and v["time_s"] == pytest.approx(t[400]) for v in mine)
    gone = sum(r["count"] for r in told["runs"][0]["fixes"]["rejected"].values())
    assert told["verdicts"]["total"] >= gone >= 11


def test_heights_that_are_left_out_are_told_with_time_and_place():
    runs, _, _, _ = single_line(4, km=3.0)
    height = runs[1].gnss.height.copy()
    height[300:320] += 5.0
    told = report(build([runs[0], changed(runs[1], height=height), runs[2]]))["verdicts"]
    (high,) = (v for v in told["list"] if v["what"] == "height" and v["run"] == "run-2")
    t = runs[1].gnss.time
    assert (high["time_s"], high["to_time_s"]) == (pytest.approx(t[300], abs=1.5), pytest.approx(t[319], abs=1.5))
    assert high["size"] == pytest.approx(5.0, abs=0.3)
    assert 40.0 < abs(high["to_m"] - high["offset_m"]) < 120.0


def test_the_unit_weight_of_a_track_is_one_and_told():
    runs, _, _, _ = single_line(4, km=3.0)
    (track,) = report(build(runs))["tracks"]
    assert 0.85 < track["unit_weight_rms"] < 1.15


def test_repeatability_between_dates_is_a_histogram():
    runs, _, _, _ = single_line(4, km=3.0)
    (told,) = report(build(runs))["repeatability"]
    assert told["receiver"] == "survey"
    assert told["pairs"] == 3
    assert 0.97 * told["points"] <= sum(told["counts"]) <= told["points"]
    assert 0.004 < told["rms_m"] < 0.03  # 17 mm white and 10 mm correlated, smoothed, of two runs
    assert report(build(runs[:1]))["repeatability"] == []


def test_stated_sigmas_that_grow_with_the_errors_are_used():
    """Base stations 50 to 100 km apart: errors grow with the distance, and the receiver says so."""
    frame, axis = plane(), centre_line(6, 4.0, frame=plane())
    rms_of = {}
    for told in (True, False):
        rng = np.random.default_rng(3)
        runs = []
        for p in range(3):
            run = drive(
                axis, frame, rng, run_id=f"r{p}", direction="up", day=p, receiver=Receiver("far", correlated=0.0)
            )
            share = np.linspace(0.0, 1.0, len(run.gnss)) if p % 2 else np.linspace(1.0, 0.0, len(run.gnss))
            sigma = 0.01 + 0.12 * share
            north, east = (rng.standard_normal(len(sigma)) * sigma / 6.37e6 for _ in range(2))
            runs.append(
                changed(
                    run,
                    latitude=run.gnss.latitude + north,
                    longitude=run.gnss.longitude + east / np.cos(np.radians(50.0)),
                    sigma_east=sigma if told else None,
                    sigma_north=sigma if told else None,
                )
            )
        rms_of[told] = rms(build(runs), "up", axis)
    assert rms_of[True] < 0.8 * rms_of[False]
