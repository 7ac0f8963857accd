"""Fixes in the grid: the antenna is brought to the reference point, and what cannot be right is set aside."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from survey_simulator import plane

from railnav.errors import RunError
from railnav.run import GaugeStream, GnssStream, GyroAnglesStream, Run
from railnav.survey.fixes import JUMP, STATED_SIGMA, USED, gather

ARM = np.array([2.0, 0.4, -3.6])
START = datetime(2026, 5, 4, tzinfo=UTC)


def straight_run(n=40, **columns):
    frame = plane()
    e0, n0, _ = (float(v) for v in frame.to_grid(np.radians(50.0), np.radians(9.4)))
    east, north = e0 + 20.0 * np.arange(n), np.full(n, n0)
    latitude, longitude, height = frame.to_geodetic(east, north, np.full(n, 200.0))
    gnss = GnssStream(time=np.arange(float(n)), latitude=latitude, longitude=longitude, height=height, **columns)
    return Run(id="a", start=START, gnss=gnss), frame, east, north


def test_the_lever_arm_turns_with_the_measured_attitude():
    run, frame, east, north = straight_run(lever_arm_b=ARM)
    roll, pitch, heading = 0.06, 0.02, 1.3
    time = np.array([0.0, 100.0])
    angles = GyroAnglesStream(time, np.full(2, roll), np.full(2, pitch), np.full(2, heading))
    fixes = gather(replace(run, gyro_angles=angles), frame)
    yaw = heading - float(frame.convergence(east[0], north[0]))
    Rx = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    Ry = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    Rz = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    ahead, right, down = Rz @ Ry @ Rx @ ARM  # grid north, grid east, down
    assert fixes.easting == pytest.approx(east - right, abs=1e-3)
    assert fixes.northing == pytest.approx(north - ahead, abs=1e-3)
    assert fixes.height == pytest.approx(200.0 + down, abs=1e-3)
    assert fixes.forward == 0.0
    assert not fixes.right.any()


def test_without_attitude_it_lies_along_the_track_and_leans_with_the_cant():
    run, frame, east, _ = straight_run(lever_arm_b=ARM)
    upright = gather(run, frame)
    assert upright.forward == 2.0
    assert upright.right == pytest.approx(np.full(40, 0.4))
    assert upright.height == pytest.approx(np.full(40, 200.0 - 3.6), abs=1e-6)
    assert upright.easting == pytest.approx(east, abs=1e-5)
    cant = 0.150
    gauge = GaugeStream(np.array([0.0, 100.0]), np.full(2, 1.435), np.full(2, cant))
    leaning = gather(replace(run, gauge=gauge), frame)
    lean = np.arcsin(cant / 1.5)
    assert leaning.right == pytest.approx(
        np.full(40, 0.4 * np.cos(lean) + 3.6 * np.sin(lean))
    )  # the right side is down
    assert leaning.height == pytest.approx(np.full(40, 200.0 + 0.4 * np.sin(lean) - 3.6 * np.cos(lean)), abs=1e-6)


def test_doubtful_and_impossible_fixes_are_set_aside():
    sigma = np.full(40, 1.0)
    sigma[:3] = 300.0
    run, frame, _, _ = straight_run(
        sigma_east=sigma, sigma_north=sigma, sigma_up=np.where(np.arange(40) == 9, 90.0, 2.0)
    )
    latitude = run.gnss.latitude.copy()
    latitude[20] += np.radians(0.01)  # a kilometre in a second, and back
    fixes = gather(replace(run, gnss=replace(run.gnss, latitude=latitude)), frame)
    assert list(np.flatnonzero(fixes.reason == STATED_SIGMA)) == [0, 1, 2]
    assert list(np.flatnonzero(fixes.reason == JUMP)) == [20]
    assert fixes.size[20] == pytest.approx(1112.0, rel=0.01)
    assert np.count_nonzero(fixes.reason == USED) == 36
    assert list(np.flatnonzero(np.isnan(fixes.height))) == [9]


def test_too_few_fixes_are_refused_by_name():
    run, frame, _, _ = straight_run(9)
    with pytest.raises(RunError, match=r"^a: 9 usable fixes of 9; a survey run needs at least 10; leave this run out"):
        gather(run, frame)


@pytest.mark.parametrize("rail", ["left", "right"])
def test_a_reference_rail_is_moved_to_the_axis_by_half_the_gauge(rail, tmp_path):
    from railnav.io.run import read_run, write_run

    plain, frame, _, _ = straight_run()
    time = np.asarray(plain.gnss.time)
    gauge = GaugeStream(time=time, gauge=np.full(len(time), 1.52), reference_rail=rail)
    run = replace(plain, gauge=gauge)
    a, b = gather(plain, frame), gather(run, frame)
    # what stands to the right of the axis is still to be taken off along the track's normal
    assert np.allclose(b.right - a.right, 0.76 if rail == "right" else -0.76)
    write_run(run, tmp_path / "run")
    assert read_run(tmp_path / "run").gauge.reference_rail == rail
