"""Simulated irregularities: their size, their ends, and what a vehicle sees of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from railnav.errors import TrackError
from railnav.monitoring.filters import D1, band_pass
from railnav.simulation import ImuSensor, Leg, demo_line, drive, path_of, simulate
from railnav.simulation.irregularities import GEOMETRY, STEP, Defect, irregular, roughen

TRACK = "77R-03"


@pytest.fixture(scope="module")
def model():
    return demo_line(spacing=5.0)


def test_fields_have_the_size_asked_for_and_vanish_at_the_ends(model):
    made = irregular(model, seed=2, level=1.5e-3, alignment=1.0e-3, cross_level=0.8e-3, gauge=0.7e-3)
    i = model.track_index(TRACK)
    block = made.fields[made.start[i] : made.start[i + 1]]
    for column, sigma in enumerate((1.0e-3, 1.5e-3, 0.8e-3, 0.7e-3)):
        assert np.nanstd(band_pass(block[:, column], STEP, D1)) == pytest.approx(sigma, rel=0.1)
    assert block[[0, -1]] == pytest.approx(0.0, abs=1e-6)
    again = irregular(model, seed=2, level=1.5e-3, alignment=1.0e-3, cross_level=0.8e-3, gauge=0.7e-3)
    assert np.array_equal(made.fields, again.fields)


def test_defects_stand_where_they_are_put(model):
    plain = irregular(model, seed=2)
    made = irregular(model, seed=2, defects=[Defect("gauge", TRACK, 500.0, 0.02, 6.0)])
    i = model.track_index(TRACK)
    difference = (made.fields - plain.fields)[made.start[i] : made.start[i + 1]]
    assert difference[2000] == pytest.approx([0.0, 0.0, 0.0, 0.02])
    assert not difference[: 2000 - 12].any()
    assert not difference[2000 + 12 :].any()
    for wrong, said in (
        (Defect("colour", TRACK, 500.0, 0.02), "not known"),
        (Defect("gauge", TRACK, 1e6, 0.02), "does not lie"),
    ):
        with pytest.raises(TrackError, match=said):
            irregular(model, seed=1, defects=[wrong])


@pytest.mark.parametrize("backwards", [False, True])
def test_what_the_sensors_see_more_is_the_field_and_its_derivatives(model, backwards):
    """Angles, rates and positions minus those of the design, held against numerical derivatives along the way."""
    leg = Leg((TRACK,), start=1500.0 if backwards else 300.0, finish=300.0 if backwards else 1500.0)
    outfit = replace(GEOMETRY, imu=ImuSensor())
    run, _ = simulate(model, leg, seed=4, outfit=outfit, tunnels=False)
    path = path_of(model, leg)
    motion, fields = drive(path, None), irregular(model, seed=3)
    rough = roughen(run, path, motion, fields)
    way = -1.0 if backwards else 1.0

    def field(time: np.ndarray) -> np.ndarray:
        track, offset = path.locate(np.clip(motion.at(time)[0], 0.0, path.length))
        return fields.at(track, offset)

    t = run.gyro_angles.time
    speed = motion.at(t)[1]
    moving = speed > 5.0
    rate = (field(t + 1e-3) - field(t - 1e-3)) / 2e-3
    slope = way * rate / np.where(moving, speed, 1.0)[:, None]
    assert (rough.gyro_angles.heading - run.gyro_angles.heading)[moving] == pytest.approx(slope[moving, 0], abs=2e-6)
    assert (rough.gyro_angles.pitch - run.gyro_angles.pitch)[moving] == pytest.approx(way * slope[moving, 1], abs=2e-6)
    assert rough.gyro_angles.roll - run.gyro_angles.roll == pytest.approx(way * field(t)[:, 2] / 1.5, abs=1e-12)
    assert rough.gauge.gauge - run.gauge.gauge == pytest.approx(field(run.gauge.time)[:, 3], abs=1e-12)
    assert rough.gauge.cant - run.gauge.cant == pytest.approx(way * field(run.gauge.time)[:, 2], abs=1e-12)
    # the gyro's z shows the turning of the bearing, whichever way the train runs
    t = run.imu.time - 0.5 * np.diff(run.imu.time, prepend=0.0)
    moving = motion.at(t)[1] > 5.0

    def bearing(time: np.ndarray) -> np.ndarray:
        here, speed = (field(time + 1e-3) - field(time - 1e-3)) / 2e-3, motion.at(time)[1]
        return way * here[:, 0] / np.where(speed > 1.0, speed, 1.0)

    turning = (bearing(t + 5e-3) - bearing(t - 5e-3)) / 1e-2
    seen = rough.imu.gyro[:, 2] - run.imu.gyro[:, 2]
    assert np.std((seen - turning)[moving]) < 0.05 * np.std(turning[moving])
