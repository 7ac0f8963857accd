"""A run navigated by its IMU without a map: honest errors, levelled mountings, outages, refusals; and the real logs where they are."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from railnav.errors import EstimationError, RunError
from railnav.geodesy.ellipsoid import WGS84
from railnav.inertial.aided import Ranges
from railnav.navigation import Mode
from railnav.navigation.schemes import INERTIAL_SCHEMES, navigate_inertial
from railnav.run import GnssStream, ImuStream, OdometerStream, Run
from railnav.simulation.constellation import elevations, satellites
from railnav.simulation.road import RoadDrive, gnss_error, road_drive
from railnav.simulation.sensors import gauss_markov

DEGREE = np.pi / 180
H = 0.02


@pytest.fixture(scope="module")
def drive() -> RoadDrive:
    return road_drive("city", 240.0, interval=H)


def as_run(drive, seed, *, mounting=(0.0, 0.0, 0.0), stated=None, dark=None, odometer=True, sigma=2.0):
    """A drive as a run: the IMU of a low-cost grade turned by `mounting`, though run.toml states `stated`."""
    from railnav.navigation.epochs import body_from_imu

    rng = np.random.default_rng(seed)
    n = len(drive.rate_ib_b)
    slow = np.stack([gauss_markov(rng, n, H, 60 * DEGREE / 3600, 300.0) for _ in range(3)], axis=1)
    w = drive.rate_ib_b + rng.normal(0, 0.05 * DEGREE, 3) + slow + rng.normal(0, 2.0 * DEGREE / 60 / np.sqrt(H), (n, 3))
    f = drive.specific_force_b + rng.normal(0, 0.05, 3) + rng.normal(0, 0.5 / 60 / np.sqrt(H), (n, 3))
    # a moving vehicle shakes
    f = f + (drive.speed[1:] > 0.05)[:, None] * rng.normal(0, 0.3, (n, 3))
    C = body_from_imu(np.array(mounting))
    k = np.arange(50, n, 50)  # 1 Hz
    error = gnss_error(rng, len(k), 1.0, variance=2 * sigma**2, white=0.3, correlation_time=30.0)
    scale = np.array(
        [
            WGS84.meridian_radius(drive.latitude[0]),
            WGS84.transverse_radius(drive.latitude[0]) * np.cos(drive.latitude[0]),
            1.0,
        ]
    )
    place = np.column_stack([drive.latitude, drive.longitude, drive.height])[k] + error / scale
    course = np.arctan2(drive.velocity_n[k, 1], drive.velocity_n[k, 0])
    keep = np.ones(len(k), bool) if dark is None else (drive.time[k] < dark[0]) | (drive.time[k] > dark[1])
    m = int(keep.sum())
    gnss = GnssStream(
        time=drive.time[k][keep],
        latitude=place[keep, 0],
        longitude=place[keep, 1],
        height=place[keep, 2],
        sigma_east=np.full(m, sigma),
        sigma_north=np.full(m, sigma),
        sigma_up=np.full(m, 2 * sigma),
        speed=np.abs(drive.speed[k][keep] + rng.normal(0, 0.1, m)),
        course=course[keep],
        sigma_speed=np.full(m, 0.1),
    )
    imu = ImuStream(
        time=drive.time[1:], gyro=w @ C, specific_force=f @ C, mounting=np.array(mounting if stated is None else stated)
    )
    j = np.arange(5, n, 5)
    wheels = None
    if odometer:
        way = np.cumsum(drive.speed[:-1] * H)
        wheels = OdometerStream(time=drive.time[j], distance=np.round(1.01 * way[j] / 0.02) * 0.02)
    return Run("road", datetime(2026, 5, 4, tzinfo=UTC), gnss=gnss, imu=imu, odometer=wheels)


def errors(drive, solution):
    """Errors along and across the true heading, m, and those over sigma, where there is a position."""
    rows = np.flatnonzero(np.isfinite(solution.latitude))
    t = solution.time[rows]
    at = lambda column: np.interp(t, drive.time, column)  # noqa: E731
    north = (solution.latitude[rows] - at(drive.latitude)) * WGS84.meridian_radius(drive.latitude[0])
    east = (
        (solution.longitude[rows] - at(drive.longitude))
        * WGS84.transverse_radius(drive.latitude[0])
        * np.cos(drive.latitude[0])
    )
    heading = at(drive.heading)
    along, across = north * np.cos(heading) + east * np.sin(heading), east * np.cos(heading) - north * np.sin(heading)
    return t, along, across, along / solution.sigma_along[rows], across / solution.sigma_cross[rows]


@pytest.mark.parametrize("scheme", ["loose", "odometer", "decentralised"])
def test_sigmas_hold(drive, scheme):
    over, size, beyond, rows = [], [], 0, 0
    for seed in range(4):
        solution = navigate_inertial(as_run(drive, seed), scheme=scheme)
        _, along, across, a, b = errors(drive, solution)
        over.append([np.mean(a**2), np.mean(b**2)])
        size.append(np.sqrt(np.mean(along**2 + across**2)))
        levels = solution.protection_level_along[np.isfinite(solution.latitude)]
        beyond += int((np.abs(along) > levels).sum())
        rows += len(levels)
    assert np.mean(size) < 3.5
    assert 0.2 < np.mean(over) < 1.6, np.mean(over, axis=0)
    assert beyond / rows < 1e-3


def test_smoothing_gains_and_stays_honest(drive):
    plain = [errors(drive, navigate_inertial(as_run(drive, s, dark=(120, 150)), scheme="odometer")) for s in (1, 2)]
    late = [
        errors(drive, navigate_inertial(as_run(drive, s, dark=(120, 150)), scheme="odometer", smooth=True))
        for s in (1, 2)
    ]
    rms = lambda runs: np.mean([np.sqrt(np.mean(r[1] ** 2 + r[2] ** 2)) for r in runs])  # noqa: E731
    assert rms(late) < rms(plain)
    assert np.mean([np.mean(r[3] ** 2) for r in late]) < 3.0


def test_an_outage_is_bridged_better_the_more_is_known(drive):
    worst = {}
    for scheme in ("loose", "decentralised", "odometer"):
        found = []
        for seed in (1, 2):
            solution = navigate_inertial(as_run(drive, seed, dark=(120.0, 160.0)), scheme=scheme)
            t, along, across, a, b = errors(drive, solution)
            hole = (t > 125) & (t < 160)
            found.append(np.hypot(along, across)[hole].max())
            assert np.abs(np.concatenate([a[hole], b[hole]])).max() < 5.0
            modes = solution.mode[(solution.time > 125) & (solution.time < 159)]
            assert np.all(np.isin(modes, [Mode.COASTING, Mode.LOST]))
        worst[scheme] = np.mean(found)
    assert worst["odometer"] < 8.0
    assert worst["decentralised"] < 0.5 * worst["loose"]
    assert worst["odometer"] < 0.5 * worst["loose"]


def test_a_wrong_mounting_is_levelled_and_said(drive):
    run = as_run(drive, 3, mounting=(3 * DEGREE, 12 * DEGREE, 0.0), stated=(0.0, 0.0, 0.0))
    solution = navigate_inertial(run, scheme="odometer")
    assert solution.diagnostics["levelled_pitch_deg"] == pytest.approx(12.0, abs=1.0)
    assert solution.diagnostics["levelled_roll_deg"] == pytest.approx(3.0, abs=1.2)
    _, along, across, *_ = errors(drive, solution)
    assert np.sqrt(np.mean(along**2 + across**2)) < 3.5


def test_what_was_found_of_the_sensors_is_told(drive):
    facts = navigate_inertial(as_run(drive, 1), scheme="odometer").diagnostics
    value, sigma = facts["odometer_scale"]["value"][0], facts["odometer_scale"]["sigma"][0]
    assert abs(value - 0.01) < 4 * sigma
    assert sigma < 2e-3
    assert facts["scheme"] == "odometer"
    assert facts["rests_used"] > 10


def test_rows_have_no_track_and_start_when_the_vehicle_does(drive):
    solution = navigate_inertial(as_run(drive, 1), scheme="loose")
    assert np.all(solution.track == -1)
    assert np.isnan(solution.offset).all()
    first = np.flatnonzero(np.isfinite(solution.latitude))[0]
    assert np.all(solution.mode[:first] == Mode.INITIALISING)
    assert solution.time[first] < 10.0
    e, n, _ = solution.easting[first], solution.northing[first], solution.height[first]
    assert np.isfinite([e, n]).all()


def test_tight_needs_ranges_and_takes_three_satellites(drive):
    run = as_run(drive, 2)
    with pytest.raises(RunError, match="pseudoranges"):
        navigate_inertial(run, scheme="tight")
    rng = np.random.default_rng(0)
    rows = []
    for k in range(50, len(drive.rate_ib_b), 50):
        s, v = satellites(20000.0 + drive.time[k])
        here = drive.latitude[k], drive.longitude[k], drive.height[k]
        up = elevations(s, *here)
        seen = np.argsort(-up)[: 3 if 100 < drive.time[k] < 140 else 8]
        from railnav.inertial.aided.single_point import north_east_down

        x = np.array(WGS84.to_cartesian(*here)).ravel()
        velocity = north_east_down(here[0], here[1]).T @ drive.velocity_n[k]
        for i in seen:
            line = x - s[i]
            r = np.linalg.norm(line)
            rate = line @ (velocity - v[i]) / r
            rows.append([drive.time[k], *s[i], *v[i], r + 70 + rng.normal(0, 2.0), rate + rng.normal(0, 0.05)])
    a = np.array(rows)
    ranges = Ranges(a[:, 0], a[:, 1:4], a[:, 4:7], a[:, 7], a[:, 8])
    solution = navigate_inertial(run, scheme="tight", ranges=ranges)
    t, along, across, a_, _ = errors(drive, solution)
    assert np.hypot(along, across)[(t > 40) & (t < 100)].max() < 5.0
    assert np.hypot(along, across)[(t > 100) & (t < 140)].max() < 20.0
    assert np.mean(a_[t > 40] ** 2) < 3.0


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        (lambda r: replace(r, imu=None), {}, "no IMU"),
        (lambda r: replace(r, gnss=None), {}, "no GNSS"),
        (lambda r: replace(r, odometer=None), {"scheme": "decentralised"}, "no odometer"),
        (lambda r: replace(r, gnss=replace(r.gnss, speed=0.0 * r.gnss.speed)), {}, "never moves faster"),
    ],
)
def test_refusals_say_what_would_work(drive, change, options, words):
    with pytest.raises(RunError, match=words):
        navigate_inertial(change(as_run(drive, 1)), **options)


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        (lambda i: replace(i, gyro=np.degrees(i.gyro)), "divide the rates by 57.3"),
        (lambda i: replace(i, specific_force=i.specific_force / 9.80665), "if they are in g"),
        (lambda i: replace(i, gyro=i.gyro * [1, 1, -1]), "reads -1.0"),
        (
            lambda i: replace(
                i, gyro=i.gyro[:, [1, 0, 2]] * [1, -1, 1], specific_force=i.specific_force[:, [1, 0, 2]] * [1, -1, 1]
            ),
            "90 degrees",
        ),
    ],
)
def test_wrong_units_and_axes_are_recognised(drive, turn, words):
    run = as_run(drive, 1)
    for scheme in ("loose", "odometer"):
        with pytest.raises(RunError, match=words):
            navigate_inertial(replace(run, imu=turn(run.imu)), scheme=scheme)


def test_an_imu_upside_down_is_turned_over_and_said(drive):
    run = as_run(drive, 1)
    flip = np.array([1.0, -1.0, -1.0])
    over = replace(run, imu=replace(run.imu, gyro=run.imu.gyro * flip, specific_force=run.imu.specific_force * flip))
    solution = navigate_inertial(over, scheme="odometer")
    assert abs(solution.diagnostics["levelled_roll_deg"]) == pytest.approx(180.0, abs=3.0)
    _, along, across, *_ = errors(drive, solution)
    assert np.hypot(along, across).max() < 6.0


def test_streams_that_contradict_each_other_are_refused(drive):
    run = as_run(drive, 1)
    late = replace(run, gnss=replace(run.gnss, time=run.gnss.time + 6.0))
    with pytest.raises((RunError, EstimationError)):
        navigate_inertial(late, scheme="odometer")


@pytest.mark.parametrize(
    "change",
    [
        lambda g: replace(g, height=None, sigma_up=None),
        lambda g: replace(g, sigma_east=None, sigma_north=None, sigma_up=None, sigma_speed=None),
        lambda g: replace(g, course=np.where(g.speed < 0.5, np.nan, g.course)),
        lambda g: replace(g, latitude=g.latitude + np.where(np.arange(len(g)) % 40 == 20, 2e-5, 0.0)),
    ],
)
def test_poorer_receivers_will_do(drive, change):
    run = as_run(drive, 1)
    _, along, across, a, b = errors(drive, navigate_inertial(replace(run, gnss=change(run.gnss)), scheme="odometer"))
    assert np.hypot(along, across).max() < 6.0
    assert max(np.mean(a**2), np.mean(b**2)) < 1.6


def test_a_log_that_starts_in_motion(drive):
    run = as_run(drive, 1)
    cut = replace(
        run,
        imu=replace(
            run.imu, time=run.imu.time[2000:], gyro=run.imu.gyro[2000:], specific_force=run.imu.specific_force[2000:]
        ),
    )
    _, along, across, *_ = errors(drive, navigate_inertial(cut))
    assert np.hypot(along, across).max() < 6.0


def test_a_hole_in_the_imu_is_refused(drive):
    run = as_run(drive, 1)
    keep = (run.imu.time < 60) | (run.imu.time > 62)
    cut = replace(
        run,
        imu=replace(
            run.imu, time=run.imu.time[keep], gyro=run.imu.gyro[keep], specific_force=run.imu.specific_force[keep]
        ),
    )
    with pytest.raises(RunError, match="silent for 2"):
        navigate_inertial(cut)


def test_bad_requests(drive):
    run = as_run(drive, 1)
    with pytest.raises(ValueError, match="none of"):
        navigate_inertial(run, scheme="deep")
    with pytest.raises(ValueError, match="smoothed"):
        navigate_inertial(run, scheme="decentralised", smooth=True)
    assert set(INERTIAL_SCHEMES) == {"loose", "tight", "odometer", "decentralised"}


def test_the_real_drive(shared_data):
    from railnav.io.run import read_run

    run = read_run(shared_data / "gnss_imu_drive")
    solution = navigate_inertial(run, scheme="odometer")
    assert solution.diagnostics["levelled_pitch_deg"] == pytest.approx(-13.6, abs=0.5)
    assert solution.diagnostics["time_offset_s"]["value"][0] == pytest.approx(0.058, abs=0.02)
    rows = np.flatnonzero(np.isfinite(solution.latitude))
    lever = 0.1  # antenna over the reference point: roll and pitch are small
    north = (
        np.interp(run.gnss.time + 0.058, solution.time[rows], solution.latitude[rows]) - run.gnss.latitude
    ) * 6.36e6
    inside = (run.gnss.time > 60) & (run.gnss.time < solution.time[-1] - 1)
    assert np.sqrt(np.mean(north[inside] ** 2)) < lever + 0.15
