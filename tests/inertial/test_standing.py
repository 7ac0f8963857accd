"""A standing vehicle: rests found, level, heading and latitude with honest intervals, motion refused with the evidence."""

from __future__ import annotations

import csv
import math
from datetime import UTC, datetime

import numpy as np
import pytest

from railnav.attitude import dcm_from_euler
from railnav.errors import EstimationError
from railnav.inertial import EARTH_RATE
from railnav.inertial.resting import find_stretches
from railnav.inertial.sensors import GRADES, TriadModel, simulate_triad
from railnav.inertial.standing import align_standing
from railnav.io.run import read_run
from railnav.run import GnssStream, ImuStream, OdometerStream, Run

DEGREE = np.pi / 180
HOUR = DEGREE / 3600
START = datetime(2026, 5, 4, tzinfo=UTC)
LATITUDE = 48.85 * DEGREE
#: A fibre-optic unit: 0.05 deg/h, 0.005 deg/sqrt(h); 0.1 mg.
FOG = {"gyro": 0.05 * HOUR, "force": 1e-4 * 9.81, "arw": 0.005 * DEGREE / 60, "vrw": 2e-4}


def standing(
    angles=(0.01, -0.02, 2.0),
    *,
    seed: int = 1,
    seconds: float = 120.0,
    gyro=None,
    force=None,
    unit=FOG,
    mounting=(0.0, 0.0, 0.0),
    **streams,
) -> Run:
    rng = np.random.default_rng(seed)
    n = round(seconds * 50)
    C = dcm_from_euler(*angles)
    w = C.T @ (EARTH_RATE * np.array([math.cos(LATITUDE), 0.0, -math.sin(LATITUDE)]))
    f = C.T @ np.array([0.0, 0.0, -9.81])
    gyro = rng.normal(0.0, unit["gyro"], 3) if gyro is None else gyro
    force = rng.normal(0.0, unit["force"], 3) if force is None else force
    rates = simulate_triad(
        np.tile(w, (n, 1)), 0.02, TriadModel(bias=tuple(gyro), random_walk=unit["arw"]), seed=seed
    ).measured
    forces = simulate_triad(
        np.tile(f, (n, 1)), 0.02, TriadModel(bias=tuple(force), random_walk=unit["vrw"]), seed=seed + 999
    ).measured
    B = dcm_from_euler(*mounting)
    imu = ImuStream(np.arange(1, n + 1) * 0.02, rates @ B, forces @ B, mounting=np.array(mounting))
    return Run("still", START, imu=imu, **streams)


def knowing(unit=FOG):
    return {"gyro_bias_sigma": unit["gyro"], "accelerometer_bias_sigma": unit["force"]}


def test_heading_and_latitude_are_found_with_honest_sigmas() -> None:
    scores = []
    for seed in range(40):
        got = align_standing(standing(seed=seed), latitude=LATITUDE, **knowing())
        a = got.alignment
        scores.append(
            [
                (a.roll - 0.01) / a.sigma_roll,
                (a.pitch + 0.02) / a.sigma_pitch,
                (a.heading - 2.0) / a.sigma_heading,
                (got.latitude - LATITUDE) / got.sigma_latitude,
            ]
        )
        assert a.sigma_heading < 1.0 * DEGREE
        assert got.sigma_latitude < 0.5 * DEGREE
        assert got.begin == 0.02
        assert got.end > 119.7
    squares = np.mean(np.square(scores), axis=0)
    assert np.all((squares > 0.4) & (squares < 1.7)), squares
    inside = np.mean(np.abs(scores) < 1.959964)
    assert 0.9 < inside < 0.99


def test_fine_alignment_keeps_to_its_sigma() -> None:
    got = align_standing(standing(seed=3, seconds=60.0), latitude=LATITUDE, fine=True, **knowing())
    assert got.fine is not None
    assert abs(got.fine.heading - 2.0) < 4.0 * float(got.fine.sigma_attitude_n[2])
    assert abs(got.fine.roll - 0.01) < 4.0 * float(got.fine.sigma_attitude_n.max())


def test_mounting_is_taken_off() -> None:
    plain = align_standing(standing(), **knowing()).alignment
    turned = align_standing(standing(mounting=(math.pi, 0.0, 1.0)), **knowing()).alignment
    for name in ("roll", "pitch", "heading"):
        assert getattr(turned, name) == pytest.approx(getattr(plain, name), abs=1e-9)


@pytest.mark.parametrize("unit", ["L3G4200D", "IMU440", "ASM330LHH"])
def test_a_mems_gyro_cannot_see_the_earth_and_says_so(unit: str) -> None:
    sheet, other = GRADES[f"{unit} gyroscope"], GRADES[f"{'LSM303DLH' if unit == 'L3G4200D' else unit} accelerometer"]
    mems = {"gyro": sheet.bias, "force": other.bias, "arw": sheet.random_walk, "vrw": other.random_walk}
    got = align_standing(standing(unit=mems), **knowing(mems))
    assert got.alignment.heading is None
    assert "cannot see the Earth's rotation" in got.alignment.note
    assert got.latitude is None
    assert "would make the latitude" in got.latitude_note
    assert abs(got.alignment.roll - 0.01) < 4.0 * got.alignment.sigma_roll


def test_without_knowledge_of_the_unit_nothing_is_claimed() -> None:
    got = align_standing(standing())
    assert got.alignment.heading is None
    assert got.latitude is None
    assert got.alignment.sigma_roll > 2.0 * DEGREE
    assert sum("nothing is known" in remark for remark in got.remarks) == 2
    assert any("neither GNSS nor odometer" in remark for remark in got.remarks)


def test_a_bias_larger_than_stated_is_noticed() -> None:
    got = align_standing(standing(gyro=(5 * HOUR, 0.0, 0.0)), latitude=LATITUDE, **knowing())
    assert got.alignment.heading is None
    assert "biases are larger than stated" in got.alignment.note
    assert got.latitude is None


def test_a_base_that_cones_is_told() -> None:
    """A cone of half a tenth of a degree at 5 Hz: no piece of the log moves on the mean, but the latitude is degrees off."""
    run = standing()
    assert run.imu is not None
    t, half, turn = run.imu.time, 0.1 * DEGREE, 2 * np.pi * 5
    cone = turn * np.column_stack(
        [-np.sin(half) * np.sin(turn * t), np.sin(half) * np.cos(turn * t), np.full_like(t, -2 * np.sin(half / 2) ** 2)]
    )
    got = align_standing(Run("x", START, imu=ImuStream(t, run.imu.gyro + cone, run.imu.specific_force)), **knowing())
    assert got.coning / HOUR == pytest.approx(9.9, rel=0.05)
    assert any("the base cones: 9" in remark or "the base cones: 10" in remark for remark in got.remarks)
    assert not any("cones" in remark for remark in align_standing(run, **knowing()).remarks)
    mems = {"gyro": 36 * HOUR, "force": 0.02, "arw": 4.5 * DEGREE / 60, "vrw": 0.0167}
    for seed in range(20):
        assert not any(
            "cones" in remark
            for remark in align_standing(standing(seed=seed, seconds=20.0, unit=mems), **knowing(mems)).remarks
        )


def moving(seconds: float = 60.0, acceleration: float = 0.0) -> Run:
    run = standing(seconds=seconds)
    assert run.imu is not None
    f = run.imu.specific_force + np.array([acceleration, 0.0, 0.0])
    t = np.arange(seconds)
    gnss = GnssStream(
        t, np.full(len(t), LATITUDE), np.zeros(len(t)), speed=np.full(len(t), 12.0), course=np.full(len(t), 2.0)
    )
    return Run("ride", START, imu=ImuStream(run.imu.time, run.imu.gyro, f), gnss=gnss)


def test_running_evenly_is_told_by_gnss_or_odometer() -> None:
    run = moving()
    with pytest.raises(
        EstimationError, match=r"moves throughout: from 0\.0 to 59\.\d s it runs evenly: GNSS shows 12\.00 m/s"
    ):
        align_standing(run, **knowing())
    with pytest.raises(EstimationError, match=r"moves between 10 and 50 s: GNSS shows 12\.00 m/s"):
        align_standing(run, between=(10.0, 50.0), **knowing())
    rolling = Run("ride", START, imu=run.imu, odometer=OdometerStream(np.arange(60.0), distance=5.0 * np.arange(60.0)))
    with pytest.raises(EstimationError, match=r"odometer shows 5\.00 m/s"):
        align_standing(rolling, **knowing())


def test_shaking_is_refused_with_the_evidence() -> None:
    run = standing(seconds=30.0)
    assert run.imu is not None
    t = run.imu.time
    f = run.imu.specific_force + np.column_stack([0.8 * np.sin(1.7 * t), 0.5 * np.cos(2.3 * t), 0.0 * t])
    w = run.imu.gyro + np.column_stack([0.05 * np.sin(1.1 * t), 0.0 * t, 0.1 * np.sin(0.6 * t)])
    shaken = Run("ride", START, imu=ImuStream(t, w, f))
    with pytest.raises(
        EstimationError, match=r"moves throughout: it turns by up to .* deg/s and .* m/s\^2 from piece to piece \(at"
    ):
        align_standing(shaken, **knowing())
    with pytest.raises(EstimationError, match="the base moves: it turns at"):
        align_standing(shaken, between=(0.0, 30.0), **knowing())


def test_the_rest_before_the_start_is_found() -> None:
    still, go = standing(seconds=40.0), moving(20.0, acceleration=0.6)
    assert still.imu is not None
    assert go.imu is not None
    imu = ImuStream(
        np.arange(1, 3001) * 0.02,
        np.vstack([still.imu.gyro, go.imu.gyro]),
        np.vstack([still.imu.specific_force, go.imu.specific_force]),
    )
    t = np.arange(60.0)
    gnss = GnssStream(
        t,
        np.full(60, LATITUDE),
        np.zeros(60),
        speed=np.maximum(0.0, 0.6 * (t - 40.0)),
        course=np.full(60, -0.5),
        sigma_speed=np.full(60, 0.05),
    )
    got = align_standing(Run("start", START, imu=imu, gnss=gnss), **knowing())
    assert got.begin == 0.02
    assert 38.0 < got.end < 40.1
    assert got.velocity_heading == pytest.approx(-0.5)
    assert got.sigma_velocity_heading < 5 * DEGREE


def test_a_mounting_stated_the_wrong_way_round_is_noticed() -> None:
    run = standing(angles=(0.0, 0.0, 0.0), mounting=(math.pi, -0.1185, 3.235))
    assert run.imu is not None
    C = dcm_from_euler(math.pi, -0.1185, 3.235)
    # in body axes, and from there turned as if v_imu were C v_b
    wrong = ImuStream(
        run.imu.time, (run.imu.gyro @ C.T) @ C.T, (run.imu.specific_force @ C.T) @ C.T, mounting=run.imu.mounting
    )
    got = align_standing(Run("x", START, imu=wrong), **knowing())
    assert any("check mounting_deg; turned the other way" in remark for remark in got.remarks), got.remarks


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda w, f: (w, f / 9.80665), "it is in g; multiply it by 9.80665"),
        (
            lambda w, f: (w, f[:, [2, 1, 0]]),
            "gravity is felt on -x, not on -z: .* reorder the axes, or state the mounting",
        ),
        (lambda w, f: (w, f * [1, -1, -1]), r"gravity is felt on \+z, not on -z: .* turn the signs of y and z"),
        (lambda w, f: (w, f * [1, 1, 0]), "specific force z is -?0 all the time: the axis is frozen or missing"),
        (lambda w, f: (w * [1, 0, 1], f), "rate y is -?0 all the time"),
        (lambda w, f: (w * [1, np.nan, 1], f), "rate y is missing"),
        (
            lambda w, f: (w + np.random.default_rng(1).normal(0, 0.1, w.shape), f),
            "in degrees per second; multiply them by pi/180",
        ),
    ],
)
def test_defects_of_the_log_are_named(change, words: str) -> None:
    run = standing(seconds=20.0)
    assert run.imu is not None
    w, f = change(run.imu.gyro, run.imu.specific_force)
    with pytest.raises(EstimationError, match=words):
        align_standing(Run("x", START, imu=ImuStream(run.imu.time, w, f)), **knowing())


def test_a_clock_that_jumps_back_and_short_intervals_are_refused() -> None:
    run = standing(seconds=20.0)
    assert run.imu is not None
    t = run.imu.time.copy()
    t[500:] -= 3.0
    with pytest.raises(EstimationError, match="time does not increase at sample 500"):
        align_standing(Run("x", START, imu=ImuStream(t, run.imu.gyro, run.imu.specific_force)), **knowing())
    with pytest.raises(EstimationError, match="51 IMU samples from 1 to 2 s are too few"):
        align_standing(run, between=(1.0, 2.0), **knowing())
    with pytest.raises(EstimationError, match="has no IMU"):
        align_standing(Run("x", START))


def test_a_gap_ends_a_stretch_and_even_turning_is_told() -> None:
    t = np.concatenate([np.arange(0.0, 10.0, 0.01), np.arange(30.0, 40.0, 0.01)])
    rng = np.random.default_rng(1)
    w = rng.normal(0.0, 1e-3, (len(t), 3)) + np.where(t[:, None] > 20.0, [0.0, 0.0, 0.5], 0.0)
    f = rng.normal([0.0, 0.0, -9.81], 1e-2, (len(t), 3))
    found, motion = find_stretches(t, w, f, shortest=3.0)
    assert [(s.turning, round(s.begin), round(s.end)) for s in found] == [(False, 0, 10), (True, 30, 40)]
    assert motion.rate == pytest.approx(0.5, abs=0.01)
    for bad, words in ((w[:5], "needs times"), (np.full_like(w, np.nan), "not finite")):
        with pytest.raises(ValueError, match=words):
            find_stretches(t, bad, f)
    with pytest.raises(ValueError, match="shortest is 0"):
        find_stretches(t, w, f, shortest=0.0)


def table(file) -> list[list[str]]:
    with file.open(encoding="utf-8") as stream:
        return list(csv.reader(stream))[1:]


def test_a_real_train_rests_for_two_seconds(shared_data) -> None:
    folder = shared_data / "tud_train"
    if not folder.is_dir():
        pytest.skip("tud_train is not here")
    x = np.array([[float(v) for v in row[1:]] for row in table(folder / "imu_processed_data.csv")])
    rows = table(folder / "gnss_processed_data.csv")
    column = {k: np.array([float(row[k]) for row in rows]) for k in (1, 2, 5, 6, 13)}
    gnss = GnssStream(
        np.arange(len(rows), dtype=float),
        *(np.radians(column[k]) for k in (1, 2)),
        speed=column[5],
        course=np.radians(column[6]),
        sigma_speed=column[13],
    )
    imu = ImuStream(np.arange(len(x)) * 0.002, np.radians(x[:, 3:]), x[:, :3])
    got = align_standing(
        Run("tud", START, imu=imu, gnss=gnss), gyro_bias_sigma=30 * HOUR, accelerometer_bias_sigma=0.02
    )
    assert 2.0 < got.end < 2.6  # then it rolls, long before GNSS shows a speed
    assert abs(got.alignment.roll) < 1 * DEGREE
    assert abs(got.alignment.pitch) < 1 * DEGREE
    assert got.alignment.heading is None
    # the heading of the first motion is the track's, within its own sigma of the later course
    late = np.radians(np.median(column[6][25:]))
    assert (
        abs((got.velocity_heading - late + np.pi) % (2 * np.pi) - np.pi) < 3.0 * got.sigma_velocity_heading + 2 * DEGREE
    )
    with pytest.raises(EstimationError, match=r"GNSS shows 4\.\d+ m/s"):
        align_standing(Run("tud", START, imu=imu, gnss=gnss), between=(0.0, 30.0))


def test_a_real_car_states_its_mounting_the_other_way_round(shared_data) -> None:
    folder = shared_data / "gnss_imu_drive"
    if not folder.is_dir():
        pytest.skip("gnss_imu_drive is not here")
    got = align_standing(read_run(folder), gyro_bias_sigma=100 * HOUR, accelerometer_bias_sigma=0.1)
    assert any("turned the other way (its inverse) it would leave 0." in remark for remark in got.remarks)
