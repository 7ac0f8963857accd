"""Whole runs on simulated and hand-made data: the law of the track, honesty, recovery, bad input."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from railnav.errors import OffModelError, RunError
from railnav.navigation import Epoch, Mode, Navigator, Settings, epochs, navigate
from railnav.run import GnssStream, OdometerStream, Run
from railnav.simulation import PHONE, SERVICE, Leg, Stop, simulate
from railnav.simulation.sensors import GnssSensor

SIDING = ("77R-04", "77R-05", "77S-1", "77R-07", "77R-08", "77R-09", "77R-10")
CROSSOVER = ("77R-01", "77X-01", "77L-02", "77L-03")
START = datetime(2026, 5, 4, 8, tzinfo=UTC)

GNSS_ONLY = replace(SERVICE, imu=None, odometer=None)
WITH_ODOMETER = replace(SERVICE, imu=None)


def at_truth(solution, truth):
    """Row of the truth for each row of the solution, and whether there is one."""
    k = np.clip(np.searchsorted(truth.time, solution.time + 1e-4) - 1, 0, len(truth.time) - 1)
    return k, np.abs(truth.time[k] - solution.time) < 0.02


def errors(solution, truth, model):
    """Along-track error, m, whether the row counts, and whether the track is right or its end is near."""
    k, there = at_truth(solution, truth)
    point = model.at(truth.track[k], truth.offset[k])
    along = (solution.easting - point.easting) * np.sin(point.grid_bearing)
    along += (solution.northing - point.northing) * np.cos(point.grid_bearing)
    length = model.lengths[truth.track[k]]
    near = (truth.offset[k] < 8.0) | (truth.offset[k] > length - 8.0)
    return along, there & (solution.track >= 0), (solution.track == truth.track[k]) | near


def claimed(solution):
    """Rows that claim a track."""
    return (solution.mode == Mode.TRACKING) | (solution.mode == Mode.COASTING)


def unlawful(solution, model, longest_passed=60.0):
    """Changes of track from row to row that no permitted movement makes; tracks shorter than `longest_passed` may be passed unseen."""
    ends = {}
    for a, end_a, b, end_b in model.movements.tolist():
        ends.setdefault((a, end_a), set()).add((b, end_b))
        ends.setdefault((b, end_b), set()).add((a, end_a))
    found = []
    for i in np.flatnonzero(np.diff(solution.track) != 0).tolist():
        a, b = int(solution.track[i]), int(solution.track[i + 1])
        if a < 0 or b < 0:
            continue
        reached, frontier = set(), {(a, 0), (a, 1)}
        for _ in range(4):
            entered = set().union(*(ends.get(end, set()) for end in frontier))
            reached |= {track for track, _ in entered}
            frontier = {(t, 1 - end) for t, end in entered if model.lengths[t] < longest_passed}
        if b not in reached:
            found.append((float(solution.time[i + 1]), model.track_id[a], model.track_id[b]))
    return found


@pytest.fixture(scope="module")
def service(line):
    """A train in service: siding, stop, tunnel, coloured GNSS, IMU, odometer."""
    leg = Leg(("77R-03", *SIDING), start=1500.0, finish=1200.0, stops=(Stop("77S-1", 700.0, 20.0),))
    return simulate(line, leg, seed=5, outfit=SERVICE)


@pytest.fixture(scope="module")
def service_forward(service, line):
    return navigate(service[0], line)


def test_service_run_forward(service, service_forward, line):
    along, counts, right = errors(service_forward, service[1], line)
    sure = counts & claimed(service_forward)
    assert np.sqrt(np.mean(along[sure] ** 2)) < 1.0
    assert right[sure].all()
    assert np.mean((along[sure] / service_forward.sigma_along[sure]) ** 2) < 1.5
    assert np.mean(np.abs(along[counts]) > service_forward.protection_level_along[counts]) < 0.002
    assert unlawful(service_forward, line) == []
    assert service_forward.diagnostics["modes"]["coasting"] > 0


def test_service_run_smoothed(service, service_forward, line):
    smoothed = navigate(service[0], line, smooth=True)
    along, counts, right = errors(smoothed, service[1], line)
    filtered, *_ = errors(service_forward, service[1], line)
    assert counts.all()
    assert right.all()
    assert np.sqrt(np.mean(along**2)) < 0.5
    assert np.sqrt(np.mean(along**2)) < np.sqrt(np.nanmean(filtered**2))
    assert np.mean((along / smoothed.sigma_along) ** 2) < 1.5
    assert np.nanmean(smoothed.sigma_along) < np.nanmean(service_forward.sigma_along)
    k, _ = at_truth(smoothed, service[1])
    assert np.sqrt(np.mean((smoothed.speed - service[1].speed[k]) ** 2)) < 0.05
    assert np.sqrt(np.nanmean((np.gradient(service[1].speed, service[1].time)[k] - smoothed.acceleration) ** 2)) < 0.1
    assert smoothed.smoothed
    assert unlawful(smoothed, line) == []


def test_the_columns_agree_with_the_model(service_forward, service, line):
    rows = service_forward.track >= 0
    here = line.at(service_forward.track[rows], service_forward.offset[rows])
    assert np.array_equal(service_forward.easting[rows], here.easting)
    assert np.array_equal(service_forward.chainage[rows], here.chainage)
    k, _ = at_truth(service_forward, service[1])
    turned = np.angle(np.exp(1j * (service_forward.heading - service[1].heading[k])))
    sure = claimed(service_forward) & (service_forward.running_direction != 0)
    assert np.abs(turned[sure]).max() < math.radians(1.0)
    assert set(np.unique(service_forward.running_direction[sure])) == {1}
    assert service_forward.time[0] == 0.0
    assert (np.diff(service_forward.time) > 0).all()


def test_live_is_forward_to_a_tenth_of_a_millimetre(service, service_forward, line):
    """The same loop; the live projection is expanded about a place near by, to micrometres."""
    run = service[0]
    navigator = Navigator(line, lever_arm_b=run.gnss.lever_arm_b, settings=Settings.of_receiver(run.gnss.receiver))
    for row, epoch in enumerate(epochs(run)):
        here = navigator.step(epoch)
        track = int(service_forward.track[row])
        assert here.track == (line.track_id[track] if track >= 0 else None)
        for name in ("offset", "speed", "acceleration", "sigma_along", "protection_level_along", "track_probability"):
            was = float(getattr(service_forward, name)[row])
            assert getattr(here, name) == pytest.approx(was, abs=1e-4, nan_ok=True), (row, name)
        assert here.mode == service_forward.mode[row]
        assert sum(other.probability for other in here.alternatives) == pytest.approx(
            1.0 - (here.track_probability if here.track else 0.0), abs=1e-9
        )
        if row == 1500:
            assert here.chainage == pytest.approx(service_forward.chainage[row], abs=1e-4)
            assert here.geodetic[0] == pytest.approx(service_forward.latitude[row], abs=1e-12)
            break


def test_logging_progress_changes_nothing(service, service_forward, line):
    said = []
    again = navigate(service[0], line, progress=lambda label, done, total: said.append((label, done, total)))
    assert np.array_equal(again.offset, service_forward.offset, equal_nan=True)
    assert said[-1] == ("navigate", len(again), len(again))


@pytest.mark.parametrize(
    "outfit", [GNSS_ONLY, WITH_ODOMETER, PHONE, SERVICE], ids=["gnss", "odometer", "phone", "service"]
)
@pytest.mark.parametrize("seed", [1, 2])
def test_a_crossover_is_found_and_no_track_jumped(line, outfit, seed):
    run, truth = simulate(line, Leg(CROSSOVER, start=200.0, finish=2500.0), seed=seed, outfit=outfit)
    solution = navigate(run, line)
    along, counts, right = errors(solution, truth, line)
    assert unlawful(solution, line) == []
    sure = counts & claimed(solution)
    assert sure.mean() > 0.5
    assert right[sure].mean() > 0.98
    assert np.sqrt(np.mean(along[counts] ** 2)) < 6.0
    smoothed = navigate(run, line, smooth=True)
    _, counts, right = errors(smoothed, truth, line)
    assert unlawful(smoothed, line) == []
    if outfit is not PHONE:
        assert right[counts].all()


@pytest.mark.parametrize("outfit", [SERVICE, WITH_ODOMETER, GNSS_ONLY], ids=["service", "odometer", "gnss"])
def test_a_train_backs_up_with_its_nose_ahead(line, outfit):
    legs = [
        Leg(("77R-01", "77X-01", "77L-02"), start=300.0, finish=20.0, dwell=25.0),
        Leg(("77L-02", "77L-01"), finish=300.0, dwell=20.0),
    ]
    run, truth = simulate(line, legs, seed=3, outfit=outfit)
    assert truth.speed.min() < -3.0
    for smooth in (False, True):
        solution = navigate(run, line, smooth=smooth)
        along, counts, right = errors(solution, truth, line)
        assert unlawful(solution, line) == []
        sure = counts & claimed(solution)
        assert right[sure].mean() > (0.999 if smooth else 0.97)
        k, _ = at_truth(solution, truth)
        back = sure & (truth.speed[k] < -1.0)
        assert back.sum() > 20
        assert (solution.speed[back] < 0).mean() > 0.9
        assert np.sqrt(np.mean(along[sure] ** 2)) < 3.0


def test_gross_errors_are_held_off(line):
    clean = replace(SERVICE, imu=None, odometer=None, gnss=replace(GNSS_ONLY.gnss, outlier_probability=0.0))
    wild = replace(clean, gnss=replace(clean.gnss, outlier_probability=0.06, outlier_size=40.0))
    leg = Leg(("77R-03",), start=500.0, finish=6000.0)
    sizes = []
    for outfit in (clean, wild):
        run, truth = simulate(line, leg, seed=5, outfit=outfit)
        solution = navigate(run, line)
        along, counts, right = errors(solution, truth, line)
        sizes.append(np.sqrt(np.mean(along[counts & right] ** 2)))
        assert right[counts & claimed(solution)].all()
        assert unlawful(solution, line) == []
    assert solution.diagnostics["fixes_suspect"] >= 5
    assert sizes[1] < sizes[0] + 1.0


def test_a_frame_offset_is_found_and_is_no_reason_to_change_track(line):
    """9 m aside for the whole run (as the u-blox runs of line 80): told in the diagnostics, never drawn as a jump."""
    aside = replace(GNSS_ONLY, gnss=replace(GNSS_ONLY.gnss, frame_offset=(0.0, -9.0, 0.0), receiver="ublox"))
    run, truth = simulate(line, Leg(("77R-03", "77R-04", "77R-05"), start=100.0, finish=10.0), seed=2, outfit=aside)
    solution = navigate(run, line)
    assert unlawful(solution, line) == []
    along, counts, _ = errors(solution, truth, line)
    assert np.sqrt(np.mean(along[counts] ** 2)) < 9.0
    east, north = solution.diagnostics["frame_offset_m"]
    assert math.hypot(east, north) > 4.0
    assert north < -4.0
    assert solution.diagnostics["frame_offset_sigma_m"] > 3.0


def test_stamps_that_slip_by_a_second_do_not_move_the_train(line):
    """A logger that loses a second for half a minute (as the telephones on line 80): the train keeps its place."""
    run, truth = simulate(line, Leg(("77R-03",), start=500.0, finish=9000.0), seed=6, outfit=GNSS_ONLY, tunnels=False)
    gnss = run.gnss
    slipped = gnss.time.copy()
    late = (slipped > 150.0) & (slipped < 180.0)
    slipped[late] -= 1.0
    keep = np.append(True, np.diff(slipped) > 0.5)
    columns = (
        "latitude",
        "longitude",
        "height",
        "sigma_east",
        "sigma_north",
        "sigma_up",
        "speed",
        "course",
        "sigma_speed",
    )
    kept = {name: getattr(gnss, name)[keep] for name in columns}
    broken = replace(gnss, time=slipped[keep], quality=None, satellites=None, hdop=None, **kept)
    solution = navigate(replace(run, gnss=broken), line)
    along, counts, _ = errors(solution, truth, line)
    v = truth.speed[at_truth(solution, truth)[0]]
    during = counts & (solution.time > 155.0) & (solution.time < 178.0)
    assert v[during].min() > 20.0  # a second is more than 20 m
    assert np.abs(along[during]).max() < 10.0
    assert np.abs(along[counts & (solution.time > 185.0)]).max() < 10.0
    assert solution.diagnostics["gnss_steps"] >= 2


def test_a_long_gap_without_anything_is_bridged_and_recovered_from(line):
    run, truth = simulate(line, Leg(("77R-03",), start=500.0, finish=9500.0), seed=7, outfit=GNSS_ONLY, tunnels=False)
    gnss = run.gnss
    keep = (gnss.time < 120.0) | (gnss.time > 150.0)
    columns = (
        "latitude",
        "longitude",
        "height",
        "sigma_east",
        "sigma_north",
        "sigma_up",
        "speed",
        "course",
        "sigma_speed",
    )
    cut = replace(
        gnss,
        time=gnss.time[keep],
        quality=None,
        satellites=None,
        hdop=None,
        **{name: getattr(gnss, name)[keep] for name in columns},
    )
    solution = navigate(replace(run, gnss=cut), line)
    inside = (solution.time > 124.0) & (solution.time < 150.0)
    assert np.isin(solution.mode[inside], [Mode.COASTING, Mode.AMBIGUOUS]).all()
    assert inside.sum() >= 25
    sigma = solution.sigma_along[inside]
    assert (np.diff(sigma) > 0).all()
    along, counts, _ = errors(solution, truth, line)
    assert (np.abs(along[inside]) < solution.protection_level_along[inside]).all()
    after = counts & (solution.time > 155.0)
    assert np.sqrt(np.mean(along[after] ** 2)) < 4.0
    smoothed = navigate(replace(run, gnss=cut), line, smooth=True)
    assert smoothed.sigma_along[inside].max() < 0.5 * sigma.max()


def fixes_on(model, track, offset, *, time=None, east=0.0, north=0.0, **more):
    """A GNSS stream of fixes on a track, moved aside."""
    offset = np.asarray(offset, float)
    point = model.at(track, offset)
    latitude, longitude, _ = model.frame.to_geodetic(point.easting + east, point.northing + north, None)
    stamps = np.arange(len(offset), dtype=float) if time is None else np.asarray(time, float)
    return GnssStream(stamps, latitude, longitude, **more)


def a_run(gnss, **more):
    return Run("made", START, gnss=gnss, **more)


@pytest.mark.parametrize("count", [1, 2, 200])
def test_one_fix_and_fixes_all_alike(curve, count):
    solution = navigate(a_run(fixes_on(curve, "A", np.full(count, 1500.0))), curve)
    assert len(solution) == count
    assert (solution.track == 0).all()
    assert np.abs(solution.offset - 1500.0).max() < 3.0
    assert (solution.sigma_along > 0.3).all()
    assert (solution.running_direction == 0).all()
    assert solution.track_probability[-1] == pytest.approx(1.0)
    smoothed = navigate(a_run(fixes_on(curve, "A", np.full(count, 1500.0))), curve, smooth=True)
    assert np.abs(smoothed.offset - 1500.0).max() < 3.0


def test_sigma_and_speed_may_be_missing(curve):
    offset = 500.0 + 20.0 * np.arange(120.0)
    solution = navigate(a_run(fixes_on(curve, "A", offset)), curve)
    assert np.abs(solution.offset[20:] - offset[20:]).max() < 5.0
    assert solution.speed[40:] == pytest.approx(20.0, abs=1.0)
    assert (solution.running_direction[20:] == 1).all()


def test_running_against_the_offsets(curve):
    offset = 5000.0 - 20.0 * np.arange(120.0)
    solution = navigate(a_run(fixes_on(curve, "A", offset, speed=np.full(120, 20.0))), curve)
    assert np.abs(solution.offset[20:] - offset[20:]).max() < 5.0
    assert (solution.running_direction[20:] == -1).all()
    assert solution.speed[20:] == pytest.approx(20.0, abs=0.5)


def test_reversing_a_run_reverses_its_offsets(curve):
    """The law of the mirror: the same fixes driven the other way give the same places, smoothed."""
    rng = np.random.default_rng(3)
    offset = 600.0 + 18.0 * np.arange(200.0)
    east, north = rng.normal(0, 1.0, 200), rng.normal(0, 1.0, 200)
    speed = np.full(200, 18.0)
    there = navigate(a_run(fixes_on(curve, "A", offset, east=east, north=north, speed=speed)), curve, smooth=True)
    back = navigate(
        a_run(fixes_on(curve, "A", offset[::-1], east=east[::-1], north=north[::-1], speed=speed)), curve, smooth=True
    )
    # not exact: the statistical start and the scale of the sigmas are learned from the other end
    assert np.abs(there.offset[20:-20] - back.offset[::-1][20:-20]).max() < 1.0


def test_odometer_speed_and_distance_give_the_same_train(curve):
    time = np.arange(0.0, 150.0, 0.2)
    offset = 400.0 + 20.0 * time
    gnss = fixes_on(curve, "A", offset[::5], time=time[::5])
    distance = OdometerStream(time, distance=1.006 * (offset - offset[0]))
    speed = OdometerStream(time, speed=np.full(len(time), 1.006 * 20.0))
    for odometer in (distance, speed):
        solution = navigate(a_run(gnss, odometer=odometer), curve)
        late = solution.time > 60.0
        assert np.abs(solution.offset[late] - 400.0 - 20.0 * solution.time[late]).max() < 2.0
        assert solution.speed[late] == pytest.approx(20.0, abs=0.15)


def test_a_slipping_wheel_is_forgotten(curve):
    time = np.arange(0.0, 150.0, 0.1)
    offset = 400.0 + 20.0 * time
    wheel = offset - offset[0] + np.interp(time, [70.0, 76.0], [0.0, 18.0])
    gnss = fixes_on(curve, "A", offset[::10], time=time[::10], speed=np.full(150, 20.0), sigma_speed=np.full(150, 0.05))
    solution = navigate(a_run(gnss, odometer=OdometerStream(time, distance=np.round(wheel / 0.02) * 0.02)), curve)
    assert solution.diagnostics["wheel_slips"] >= 1
    late = solution.time > 60.0
    assert np.abs(solution.offset[late] - offset[np.round(solution.time[late] * 10).astype(int)]).max() < 2.0


def test_a_run_that_leaves_the_model_is_off_it_and_found_again(frame, curve):
    """Past the end of the model and back: off-model rows without a position, then the track again."""
    end = curve.length("A")
    out = np.concatenate([np.arange(end - 400.0, end, 10.0), np.full(1, end)])
    point = curve.at("A", end)
    beyond = 10.0 * np.arange(1, 60)
    beyond = np.concatenate([beyond, beyond[::-1]])
    inside = curve.at("A", out)
    easting = np.concatenate(
        [inside.easting, point.easting + beyond * np.sin(point.grid_bearing), inside.easting[::-1]]
    )
    northing = np.concatenate(
        [inside.northing, point.northing + beyond * np.cos(point.grid_bearing), inside.northing[::-1]]
    )
    latitude, longitude, _ = curve.frame.to_geodetic(easting, northing, None)
    solution = navigate(a_run(GnssStream(np.arange(len(easting), dtype=float), latitude, longitude)), curve)
    far = np.zeros(len(easting), bool)
    far[len(out) + 8 : len(out) + len(beyond) - 8] = True
    assert (solution.mode[far] == Mode.OFF_MODEL).all()
    assert (solution.track[far] == -1).all()
    assert np.isnan(solution.offset[far]).all()
    assert solution.mode[-1] == Mode.TRACKING
    assert solution.diagnostics["starts"] == 2


def test_a_run_elsewhere_is_refused_with_its_distance(curve):
    gnss = fixes_on(curve, "A", np.full(5, 3000.0), north=-4000.0)
    with pytest.raises(OffModelError, match=r"'made' never touches the model: its nearest fix lies [34]\.\d km"):
        navigate(a_run(gnss), curve)


def test_a_run_without_gnss_is_refused(curve):
    odometer = OdometerStream(np.arange(5.0), distance=np.arange(5.0))
    for gnss in (None, fixes_on(curve, "A", np.empty(0))):
        with pytest.raises(RunError, match="no GNSS fix"):
            navigate(Run("blind", START, gnss=gnss, odometer=odometer), curve)


def test_hopeless_sigmas_are_refused(curve):
    gnss = fixes_on(curve, "A", np.full(5, 3000.0), sigma_east=np.full(5, 400.0), sigma_north=np.full(5, 400.0))
    with pytest.raises(OffModelError, match="every fix states a sigma above 60 m"):
        navigate(a_run(gnss), curve)


def test_live_epochs_must_move_on(curve):
    navigator = Navigator(curve, imu=False, odometer="")
    navigator.step(Epoch(1.0))
    with pytest.raises(RunError, match=r"not later than the one before, at 1\.0 s"):
        navigator.step(Epoch(1.0))
    with pytest.raises(ValueError, match="odometer 'wheel'"):
        Navigator(curve, odometer="wheel")
    with pytest.raises(ValueError, match=r"integrity_risk 0\.0"):
        Navigator(curve, integrity_risk=0.0)


def test_live_bridges_a_gap_in_small_steps(curve):
    offset = 500.0 + 20.0 * np.arange(60.0)
    run = a_run(fixes_on(curve, "A", offset, speed=np.full(60, 20.0), time=np.append(np.arange(59.0), 90.0)))
    forward = navigate(run, curve)
    navigator = Navigator(curve, imu=False, odometer="")
    gnss = run.gnss
    for i in range(60):
        here = navigator.step(Epoch(gnss.time[i], gnss.latitude[i], gnss.longitude[i], speed=gnss.speed[i]))
    assert here.offset == pytest.approx(forward.offset[-1], abs=1e-4)
    assert here.sigma_along == pytest.approx(forward.sigma_along[-1], abs=1e-4)


def test_two_parallel_tracks_are_ambiguous_until_told_apart(line):
    """Standing between two tracks says nothing; both are named, and their probabilities sum to one."""
    right = line.at("77R-03", 5000.0)
    near = line.locate(float(right.easting), float(right.northing), within=10.0)
    left = next(c for c in near if c.track == "77L-03")
    other = line.at("77L-03", left.offset)
    easting = 0.5 * (float(right.easting) + float(other.easting))
    northing = 0.5 * (float(right.northing) + float(other.northing))
    latitude, longitude, _ = line.frame.to_geodetic(easting, northing, None)
    navigator = Navigator(line, imu=False, odometer="")
    for t in range(30):
        here = navigator.step(Epoch(float(t), float(latitude), float(longitude), sigma_east=2.0, sigma_north=2.0))
        assert here.mode == Mode.AMBIGUOUS
        assert here.track_probability == pytest.approx(0.5, abs=0.02)
        assert {here.track, *(a.track for a in here.alternatives)} == {"77R-03", "77L-03"}


def test_inputs_are_left_alone(service, line):
    run = service[0]
    before = run.gnss.latitude.copy()
    for array in (run.gnss.time, run.gnss.latitude, run.odometer.distance, run.imu.gyro):
        array.flags.writeable = False
    navigate(run, line)
    assert np.array_equal(run.gnss.latitude, before)


@pytest.mark.slow
def test_consistency_over_seeded_runs(line):
    """NEES along the track of GNSS and odometer with the errors that are assumed: near 1 over runs, hardly ever beyond the level."""
    honest = GnssSensor(white_horizontal=0.5, coloured_horizontal=1.8, correlation_time=60.0, speed_sigma=0.05)
    squares, beyond, rows = [], 0, 0
    for seed in range(16):
        # the constant part and the stamps' offset that are assumed, too
        east, north, late = np.array([0.56, 0.56, 0.02]) * np.random.default_rng([seed, 1]).standard_normal(3)
        outfit = replace(WITH_ODOMETER, gnss=replace(honest, frame_offset=(float(east), float(north), 0.0)))
        run, truth = simulate(
            line, Leg(("77R-03",), start=300.0, finish=6000.0), seed=seed, outfit=outfit, tunnels=False
        )
        run = replace(run, gnss=replace(run.gnss, time=run.gnss.time + float(late)))
        solution = navigate(run, line, integrity_risk=1e-3)
        along, counts, right = errors(solution, truth, line)
        assert right[counts & claimed(solution)].all()
        sure = counts & right & (solution.time > 30.0)
        squares.append(np.mean((along[sure] / solution.sigma_along[sure]) ** 2))
        beyond += int((np.abs(along[sure]) > solution.protection_level_along[sure]).sum())
        rows += int(sure.sum())
    assert 0.4 < np.mean(squares) < 1.6
    assert beyond / rows < 1e-2


@pytest.mark.slow
def test_no_unlawful_change_on_random_ways(line):
    """The law, hunted: random lawful ways through the station in both directions with the worst receiver."""
    rng = np.random.default_rng(1)
    routes = [
        r
        for a, b in (("77R-01", "77R-10"), ("77R-10", "77R-01"), ("77L-12", "77L-01"), ("77R-01", "78-01"))
        for r in line.routes(a, b)
    ]
    wrong = rows = 0
    for seed in range(8):
        route = routes[int(rng.integers(len(routes)))]
        run, truth = simulate(line, route, seed=seed, outfit=PHONE)
        for smooth in (False, True):
            solution = navigate(run, line, smooth=smooth)
            assert unlawful(solution, line) == []
            _, counts, right = errors(solution, truth, line)
            sure = counts & claimed(solution)
            wrong += int((~right[sure]).sum())
            rows += int(sure.sum())
    assert rows > 5000
    assert wrong / rows < 0.02


def test_sample_run_meets_its_figures(shared_data):
    """The independent simulator's run: along-track RMS under 1 m, right track wherever one is claimed, NEES in bounds."""
    from railnav.io.geojson import read_geojson
    from railnav.io.run import read_run
    from railnav.io.truth import read_truth

    folder = shared_data / "sample_run"
    model, run, truth = read_geojson(folder / "network.geojson"), read_run(folder), read_truth(folder / "truth.csv")
    index = np.array([model.track_index(t) for t in truth.track_id])
    truth = replace(truth, track_id=model.track_id, track=index[truth.track])
    for smooth, rms, least, most in ((False, 1.0, 0.5, 1.5), (True, 0.4, 0.2, 1.5)):
        solution = navigate(run, model, smooth=smooth)
        along, counts, right = errors(solution, truth, model)
        sure = counts & claimed(solution)
        assert np.sqrt(np.mean(along[counts] ** 2)) < rms
        assert right[sure].all()
        assert least < np.mean((along[sure] / solution.sigma_along[sure]) ** 2) < most
        assert sure.mean() > (0.99 if smooth else 0.9)
        assert (np.abs(along[counts]) < solution.protection_level_along[counts]).all()
        assert unlawful(solution, model) == []


@pytest.mark.parametrize("seed", [7247, 50699])
def test_a_slow_slip_is_no_scale_and_a_wild_one_no_speed(line, seed):
    """A wheel that slips by 6 % for half a minute passed for one of another diameter, one that slips by 40 % for the speed."""
    outfit = replace(
        SERVICE,
        imu=None,
        gnss=GnssSensor(),
        odometer=replace(SERVICE.odometer, interval=0.2, slip_rate=30.0, slip_size=0.15, slip_duration=5.0),
    )
    leg = Leg(("77R-03",), start=200.0, finish=8000.0)
    run, truth = simulate(line, leg, seed=seed, outfit=outfit, tunnels=False, outages=[(120.0, 1e5)])
    solution = navigate(run, line)
    along, counts, _ = errors(solution, truth, line)
    alone = counts & (solution.time > 120.0)
    gone = np.abs(solution.offset - solution.offset[np.argmax(alone)])
    assert (np.abs(along[alone]) < 5.0 + 0.05 * gone[alone]).all()
    assert solution.diagnostics["wheel_slips"] >= 1
