"""Evaluation against cases worked out by hand, and against errors of known statistics."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from railnav.errors import InputError, TrackError
from railnav.evaluation import compare, evaluate, find_jumps, truth_as_solution
from railnav.navigation.solution import Mode
from railnav.simulation import Leg, demo_line, simulate
from railnav.simulation.sensors import Outfit, gauss_markov
from railnav.track import TrackModel

NOTHING = Outfit("nothing")


@pytest.fixture(scope="module")
def model() -> TrackModel:
    return demo_line(spacing=5.0)


@pytest.fixture(scope="module")
def ride(model):
    """Over two joints, forward."""
    _, truth = simulate(model, Leg(("77R-01", "77R-02", "77R-03"), start=300.0, finish=900.0), seed=1, outfit=NOTHING)
    return truth


def at_times(truth, model, times, **options):
    return truth_as_solution(truth, model, rows=np.searchsorted(truth.time, np.asarray(times) - 1e-6), **options)


def test_no_error_is_no_error(model, ride):
    e = evaluate(truth_as_solution(ride, model), ride, model=model)
    assert e.along_statistics.max < 1e-6
    assert e.across_statistics.max < 1e-6
    assert e.speed_statistics.max == 0.0
    assert e.selection.rate == e.selection.rate_tracking == 1.0
    assert e.selection.across_joint == 0
    assert e.epochs == e.positioned == len(ride)
    assert e.integrity.events == 0
    assert e.jumps.illegal == ()
    assert e.jumps.changes == 2
    assert e.modes == {"tracking": len(ride)}


def test_three_rows_by_hand(model, ride):
    solution = at_times(ride, model, [30.0, 45.0, 60.0], along=np.array([3.0, -4.0, 0.0]), sigma=2.0)
    solution = replace(solution, speed=solution.speed + np.array([0.1, 0.1, -0.2]))
    e = evaluate(solution, ride, alert_limit=7.0)
    assert e.along_statistics.rms == pytest.approx(np.sqrt(25 / 3))
    assert e.along_statistics.mean == pytest.approx(-1 / 3)
    assert e.along_statistics.median == pytest.approx(3.0)
    assert e.along_statistics.max == pytest.approx(4.0)
    assert e.along_statistics.p95 == pytest.approx(3.9)
    assert e.speed_statistics.rms == pytest.approx(np.sqrt(0.06 / 3))
    assert e.consistency.nees == pytest.approx((1.5**2 + 2.0**2) / 3)
    assert e.consistency.coverage == pytest.approx((1 / 3, 1.0, 1.0))
    assert e.integrity.median_level == pytest.approx(2 * 3.8905919, rel=1e-6)
    assert (e.integrity.available, e.integrity.unavailable) == (0, 3)  # level 7.78 m > limit 7 m


@pytest.mark.parametrize("backwards", [False, True])
def test_ahead_is_positive_whichever_way_the_track_counts(model, backwards):
    leg = Leg(("77R-03", "77R-02"), start=900.0, finish=20.0) if backwards else Leg(("77R-02", "77R-03"), finish=900.0)
    _, truth = simulate(model, leg, seed=1, outfit=NOTHING)
    fast = np.flatnonzero(truth.speed > 5.0)
    e = evaluate(truth_as_solution(truth, model, along=2.0, rows=fast), truth)
    inside = np.abs(e.along - 2.0) < 1e-3
    assert inside.mean() > 0.98  # near the end of a track the known error is cut short
    assert np.abs(e.across).max() < 0.01


def test_backing_up_keeps_signs(model):
    legs = [Leg(("77R-03",), start=500.0, finish=900.0), Leg(("77R-03",), finish=600.0)]
    _, truth = simulate(model, legs, seed=1, outfit=NOTHING)
    e = evaluate(truth_as_solution(truth, model, along=1.5), truth)
    assert truth.speed.min() < -3.0
    np.testing.assert_allclose(e.along, 1.5, atol=1e-6)


def test_truth_is_interpolated(model, ride):
    thin = replace(
        ride,
        **{
            c: getattr(ride, c)[::10]
            for c in ("time", "track", "offset", "speed", "latitude", "longitude", "height", "heading")
        },
    )
    e = evaluate(truth_as_solution(ride, model), thin)
    assert e.epochs == len(ride) - (len(ride) - 1) % 10
    assert e.along_statistics.max < 0.02  # cubic: jerk 0.4 m/s^3 over 1 s; linear would be 0.06
    assert e.across_statistics.max < 0.02
    assert e.selection.rate == 1.0


def test_joint_between_truth_and_solution_is_an_error_along(model, ride):
    """Truth 1.0 m before the joint, solution 2.5 m behind it: 3.5 m ahead on the path, and the track counts as right."""
    length = model.length("77R-01")
    rows = np.flatnonzero((ride.track == model.track_index("77R-01")) & (ride.offset > length - 3.0))
    solution = truth_as_solution(ride, model, rows=rows)
    behind = model.at("77R-02", 2.5)
    lat, lon, _ = model.frame.to_geodetic(behind.easting, behind.northing, behind.height)
    n = len(rows)
    moved = replace(
        solution,
        track=np.full(n, model.track_index("77R-02")),
        offset=np.full(n, 2.5),
        latitude=np.full(n, lat),
        longitude=np.full(n, lon),
    )
    e = evaluate(moved, ride)
    np.testing.assert_allclose(e.along, length - ride.offset[rows] + 2.5, atol=2e-3)
    assert e.selection.rate == 1.0
    assert e.selection.across_joint == n
    strict = evaluate(moved, ride, joint_within=1.0)
    assert strict.selection.rate == 0.0


def test_wrong_parallel_track(model, ride):
    """Four metres to the left: across says so, along does not, and being sure of it is the worst case."""
    solution = truth_as_solution(ride, model)
    rows = slice(600, 700)
    left = model.track_index("77L-01")
    track, offset = solution.track.copy(), solution.offset.copy()
    latitude, longitude = solution.latitude.copy(), solution.longitude.copy()
    for i in range(*rows.indices(len(track))):
        here = next(
            c
            for c in model.locate(float(solution.easting[i]), float(solution.northing[i]), within=6.0)
            if c.track.startswith("77L")
        )
        p = model.at(here.track, here.offset)
        track[i], offset[i] = model.track_index(here.track), here.offset
        latitude[i], longitude[i], _ = model.frame.to_geodetic(p.easting, p.northing, p.height)
    wrong = replace(solution, track=track, offset=offset, latitude=latitude, longitude=longitude)
    e = evaluate(wrong, ride, model=model)
    assert left in track
    assert e.selection.rate == pytest.approx(1 - 100 / len(ride))
    assert e.selection.wrong_while_tracking == 100
    assert e.selection.overconfident == 100
    assert [(w.rows, w.tracking, w.true_track[:3]) for w in e.selection.wrong] == [(100, 100, "77R")]
    np.testing.assert_allclose(e.across[rows], -4.0, atol=0.01)
    np.testing.assert_allclose(e.along[rows], 0.0, atol=0.02)
    assert len(e.jumps.illegal) == 2
    assert e.consistency.count == len(ride) - 100  # NEES only where the track is right
    unsure = replace(wrong, mode=np.where(np.isin(np.arange(len(track)), range(600, 700)), Mode.AMBIGUOUS, wrong.mode))
    e = evaluate(unsure, ride, model=model)
    assert e.selection.wrong_while_tracking == 0
    assert e.selection.rate_tracking == 1.0
    assert e.jumps.illegal == ()
    assert e.jumps.corrections == 2


def test_models_with_other_names_are_compared_by_distance(model, ride):
    solution = truth_as_solution(ride, model, along=1.0)
    renamed = replace(solution, track_id=tuple(f"built-{i}" for i in range(len(solution.track_id))))
    e = evaluate(renamed, ride)
    assert e.selection.compared_by == "distance"
    assert e.selection.rate == 1.0
    assert e.along_statistics.rms == pytest.approx(1.0, abs=5e-3)
    by_name = evaluate(renamed, ride, by="name")
    assert by_name.selection.rate == 0.0
    assert by_name.along_statistics.rms == pytest.approx(1.0, abs=5e-3)  # projected on the heading


def test_all_lost(model, ride):
    solution = truth_as_solution(ride, model)
    nothing = np.full(len(solution), np.nan)
    lost = replace(
        solution,
        track=np.full(len(solution), -1),
        **dict.fromkeys(("offset", "latitude", "longitude", "speed", "sigma_along", "protection_level_along"), nothing),
        mode=np.full(len(solution), Mode.LOST),
    )
    e = evaluate(lost, ride, model=model)
    assert e.positioned == 0
    assert e.availability == 0.0
    assert e.along_statistics.count == 0
    assert e.along_statistics.rms is None
    assert e.selection.rate is None
    assert e.consistency.nees is None
    assert e.consistency.inside is None
    assert e.integrity.rows == 0
    assert e.modes == {"lost": len(solution)}
    assert len(e.time) == 0
    json.dumps(e.to_dict(), allow_nan=False)


def test_no_common_time_and_other_refusals(model, ride):
    solution = truth_as_solution(ride, model)
    with pytest.raises(InputError, match=r"nowhere comes nearer to the truth than 1\d\d\.\d km"):
        evaluate(replace(solution, latitude=solution.latitude + np.radians(1.0)), ride)
    with pytest.raises(InputError, match="no common time"):
        evaluate(replace(solution, time=solution.time + 1e4), ride)
    with pytest.raises(InputError, match="no rows"):
        evaluate(at_times(ride, model, []), ride)
    with pytest.raises(InputError, match="alert limit"):
        evaluate(solution, ride, alert_limit=0.0)
    with pytest.raises(InputError, match="confidence"):
        evaluate(solution, ride, confidence=1.0)
    with pytest.raises(InputError, match="compared by"):
        compare(solution, ride, by="hope")
    other = replace(solution, track_id=tuple(f"x{t}" for t in solution.track_id))
    with pytest.raises(TrackError, match="made with"):
        find_jumps(other, model)


def test_only_the_overlap_counts(model, ride):
    solution = truth_as_solution(ride, model, along=1.0)
    late = replace(solution, time=solution.time + 30.0)
    e = evaluate(late, ride)
    assert e.epochs == int((late.time <= ride.time[-1] + 1e-6).sum())
    assert e.start == pytest.approx(30.0)
    assert e.end <= ride.time[-1] + 1e-6


def test_stanford_diagram(model, ride):
    times = [30.0, 35.0, 40.0, 45.0, 50.0]
    error = np.array([1.0, 2.0, 8.0, 30.0, 1.0])
    level = np.array([5.0, 30.0, 5.0, 5.0, np.nan])
    solution = replace(at_times(ride, model, times, along=error), protection_level_along=level)
    i = evaluate(solution, ride, alert_limit=20.0).integrity
    assert (i.rows, i.available, i.unavailable, i.misleading, i.hazardous, i.events) == (4, 1, 1, 1, 1, 2)
    assert i.largest_ratio == pytest.approx(6.0, rel=1e-3)


def test_coasting_stretches(model, ride):
    error = np.zeros(len(ride))
    error[500:600] = np.linspace(0.0, 6.0, 100)
    solution = truth_as_solution(ride, model, along=error)
    mode = solution.mode.copy()
    mode[500:600] = Mode.COASTING
    e = evaluate(replace(solution, mode=mode), ride)
    (stretch,) = e.coasting
    assert (stretch.start, stretch.end) == (pytest.approx(50.0), pytest.approx(59.9))
    assert stretch.error_at_end == pytest.approx(6.0, abs=1e-3)
    assert stretch.largest_error == pytest.approx(6.0, abs=1e-3)
    run = np.abs(ride.speed[500:600]).mean() * 9.9
    assert stretch.distance == pytest.approx(run, rel=0.01)
    assert e.along_by_mode["coasting"].count == 100
    assert e.along_by_mode["tracking"].max < 1e-6


def test_white_errors_have_nees_one_and_full_effect(model):
    _, truth = simulate(model, Leg(("77R-03",), start=500.0, finish=3000.0, dwell=100.0), seed=1, outfit=NOTHING)
    error = np.random.default_rng(5).standard_normal(len(truth)) * 2.0
    e = evaluate(truth_as_solution(truth, model, along=error, sigma=2.0), truth)
    c = e.consistency
    assert c.inside
    assert c.nees == pytest.approx(1.0, abs=0.1)
    assert c.effective > 0.8 * c.count
    np.testing.assert_allclose(c.coverage, (0.683, 0.954, 0.997), atol=0.03)
    assert c.correlation_time < 0.2
    sure = evaluate(truth_as_solution(truth, model, along=error, sigma=1.0), truth).consistency
    assert sure.nees == pytest.approx(4.0, rel=0.1)
    assert not sure.inside


def test_coloured_errors_widen_the_bounds(model):
    """Gauss-Markov of 20 s over 10 Hz rows: the bounds must hold in about 95 of 100 runs, where naive ones fail."""
    _, truth = simulate(model, Leg(("77R-03",), start=500.0, finish=3000.0, dwell=600.0), seed=1, outfit=NOTHING)
    generator, inside, naive = np.random.default_rng(9), 0, 0
    rows = np.arange(0, len(truth), 5)
    from railnav.evaluation import consistency

    runs, times = 200, []
    for _ in range(runs):
        error = gauss_markov(generator, len(rows), 0.5, 1.0, 20.0)
        c = consistency(error, np.ones(len(rows)), truth.time[rows])
        inside += bool(c.inside)
        half = 1.96 * np.sqrt(2.0 / len(rows))
        naive += abs(c.nees - 1.0) < half
        times.append(c.correlation_time)
    assert 0.90 < inside / runs < 0.99
    assert naive / runs < 0.5
    assert np.median(times) == pytest.approx(40.0, rel=0.2)  # twice the time constant


def test_runs_pooled_tell_what_one_run_cannot():
    """Errors 1.5 times too large for their sigma: one slow run lets it pass, forty together do not."""
    from railnav.evaluation import consistency, pooled

    generator, time = np.random.default_rng(3), np.arange(0.0, 600.0, 0.5)
    runs = [gauss_markov(generator, len(time), 0.5, 1.0, 60.0) for _ in range(40)]
    honest = pooled([consistency(r, np.ones(len(r)), time) for r in runs])
    sure = [consistency(1.5 * r, np.ones(len(r)), time) for r in runs]
    assert honest.inside
    assert honest.count == 40 * len(time)
    assert not pooled(sure).inside
    assert pooled(sure).nees == pytest.approx(2.25 * honest.nees)
    assert np.mean([bool(c.inside) for c in sure]) > 0.3
    assert pooled([]).nees is None


def test_json_is_plain(model, ride):
    e = evaluate(truth_as_solution(ride, model, along=1.0), ride, model=model)
    text = json.dumps(e.to_dict(), allow_nan=False)
    back = json.loads(text)
    assert back["along"]["rms"] == pytest.approx(1.0, abs=0.02)
    assert back["selection"]["rate"] == 1.0
    assert set(back) >= {
        "epochs",
        "along",
        "across",
        "speed",
        "selection",
        "consistency",
        "integrity",
        "jumps",
        "modes",
    }


def test_inputs_stay_untouched(model, ride):
    solution = truth_as_solution(ride, model)
    for table in (solution, ride):
        for column in table.__dataclass_fields__:
            value = getattr(table, column)
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
    evaluate(solution, ride, model=model)


def test_one_row_of_truth(model, ride):
    one = replace(
        ride,
        **{
            c: getattr(ride, c)[:1]
            for c in ("time", "track", "offset", "speed", "latitude", "longitude", "height", "heading")
        },
    )
    e = evaluate(truth_as_solution(ride, model, rows=[0]), one)
    assert e.epochs == 1
    assert e.along_statistics.max < 1e-6


def test_a_leap_through_a_lawful_way_is_lawful_only_as_far_as_the_train_can_run(model, ride):
    solution = at_times(ride, model, [40.0, 41.0])
    track = np.array([model.track_index("77R-01"), model.track_index("77X-01")])
    length = model.length("77R-01")
    near = replace(solution, track=track, offset=np.array([length - 5.0, 10.0]))
    assert find_jumps(near, model).illegal == ()
    far = replace(solution, track=track, offset=np.array([length - 200.0, 60.0]))
    assert len(find_jumps(far, model).illegal) == 1
    # from the main track beyond the toe one cannot slide onto the branch sideways
    aside = replace(
        solution,
        track=np.array([model.track_index("77R-02"), model.track_index("77X-01")]),
        offset=np.array([40.0, 40.0]),
    )
    assert len(find_jumps(aside, model).illegal) == 1
