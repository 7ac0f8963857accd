"""Rows of the measurements against differences of what they predict, on a path that bends, climbs and is canted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numba import njit

from railnav.matching import _kernels as paths
from railnav.navigation import Settings, State
from railnav.navigation import columns as c
from railnav.navigation.engine import Engine
from railnav.navigation.measurements import _kernels as equations
from railnav.units import RAIL_CENTRE_DISTANCE, STANDARD_GRAVITY

LEVER = (2.0, 0.4, -3.8)


@njit
def do_position(fil, net, shared, bank, work, h, row):
    return equations.position_row(fil, net, shared, bank, work, h, row)


@njit
def do_inertial(fil, net, shared, bank, work, h, row, dt):
    equations.inertial_rows(fil, net, shared, bank, work, h, row, dt)


@njit
def do_speed(fil, shared, bank, work, h, row):
    equations.speed_rows(fil, shared, bank, work, h, row)


@njit
def do_course(fil, shared, bank, work, h, row, sign):
    equations.course_row(fil, shared, bank, work, h, row, sign, 0.1)


@njit
def do_wheel_speed(fil, bank, work, h, row):
    return equations.wheel_speed_row(fil, bank, work, h, row)


@njit
def do_balise(fil, net, bank, work, h, row):
    equations.balise_row(fil, net, bank, work, h, row)


@njit
def do_missed(fil, net, bank, h):
    equations.missed_balises(fil, net, bank, h)


@pytest.fixture
def engine(curve):
    """One hypothesis on the winding track at 22 m/s, all states away from zero, hardly any uncertainty."""
    from dataclasses import replace

    covariance = np.zeros_like(curve.covariance_g)
    covariance[:, [0, 3]] = 4.0
    balises = [{"id": "B1", "track": "A", "offset_m": 2000.0}, {"id": "B2", "track": "A", "offset_m": 2500.0}]
    model = replace(curve, covariance_g=covariance, provenance={"balises": balises})
    engine = Engine(
        model,
        Settings(),
        imu=True,
        odometer="speed",
        speed=True,
        signed_odometer=True,
        lever_arm_b=LEVER,
        integrity_risk=1e-4,
        balises=True,
    )
    h = paths.take_slot(engine.bank)
    bank, at = engine.bank, engine.filter.at
    rng = np.random.default_rng(4)
    bank.x[h] = 0.01 * rng.standard_normal(engine.states)
    bank.x[h, at[State.SPEED]] = 22.0
    bank.x[h, at[State.POSITION]] = 2100.0
    bank.P_sqrt[h] = 1e-2 * np.eye(engine.states)
    bank.tags[h, paths.COUNT] = 1
    bank.tags[h, paths.SIGN] = 1
    common = engine.shared.common
    common[c.C_SCALE], common[c.C_SIGMA_EAST], common[c.C_SIGMA_NORTH] = 1.3, 2.0, 2.5
    return engine


def empty():
    return np.full(c.EPOCH_SIZE, np.nan)


def place(engine):
    """Geometry at the hypothesis' position, as the loop leaves it before the rows."""
    h, i_s = engine.living()[0], engine.filter.at[State.POSITION]
    engine.work.point[h, paths.POINT_SIZE] = engine.bank.x[h, i_s]
    point = np.empty(paths.POINT_SIZE)
    paths.track_point(engine.network, 0, 1, engine.bank.x[h, i_s], point)
    engine.work.point[h, : paths.POINT_SIZE] = point


def differences(engine, predicted, step=1e-4):
    """Derivative of a prediction by the state, central differences."""
    h = engine.living()[0]
    x = engine.bank.x[h].copy()
    found = []
    for i in range(len(x)):
        values = []
        for sign in (1.0, -1.0):
            engine.bank.x[h] = x
            engine.bank.x[h, i] += sign * step
            values.append(predicted())
        found.append((values[0] - values[1]) / (2.0 * step))
    engine.bank.x[h] = x
    return np.array(found)


def row_of(engine, update, innovation_sign=1.0):
    """The row that an update applied, up to its length: with P = p I the state moves along it."""
    h = engine.living()[0]
    x, P_sqrt = engine.bank.x[h].copy(), engine.bank.P_sqrt[h].copy()
    update()
    moved = engine.bank.x[h] - x
    engine.bank.x[h], engine.bank.P_sqrt[h] = x, P_sqrt
    return moved * innovation_sign


def test_rows_of_a_fix(engine):
    """Position with lever arm, GNSS error, frame, time stamp and the model's own error."""
    h = engine.living()[0]
    row = empty()
    row[[c.TIME, c.SIGMA_EAST, c.SIGMA_NORTH]] = 0.0, 2.0, 2.5
    row[c.EAST], row[c.NORTH] = engine.model.easting[0], engine.model.northing[0]

    def predicted(axis):
        place_before = engine.work.point[h].copy()
        do_position(engine.filter, engine.network, engine.shared, engine.bank, engine.work, h, row)
        engine.work.point[h] = place_before
        return (row[c.EAST], row[c.NORTH])[axis] - engine.work.fix[h, axis]

    place(engine)
    do_position(engine.filter, engine.network, engine.shared, engine.bank, engine.work, h, row)
    rows = engine.work.rows[h, :2].copy()
    for axis in (0, 1):
        numeric = differences(engine, lambda axis=axis: predicted(axis))
        assert rows[axis] == pytest.approx(numeric, abs=2e-5)
    assert np.abs(rows[:, engine.filter.at[State.MAP_CROSS]]).max() > 1.0


def yaw_and_side(engine):
    """What gyro and side accelerometer read in the middle of a step of 0.1 s."""
    h, at = engine.living()[0], engine.filter.at
    x = engine.bank.x[h]
    v = x[at[State.SPEED]]
    point = np.empty(paths.POINT_SIZE)
    paths.track_point(engine.network, 0, 1, x[at[State.POSITION]] - 0.05 * 22.0, point)
    bend = equations.yaw_rate_kernel(
        1.0,
        point[paths.P_CURVATURE],
        point[paths.P_GRADIENT],
        point[paths.P_GRADIENT_RATE],
        point[paths.P_CANT],
    )
    roll = point[paths.P_CANT_RATE] / RAIL_CENTRE_DISTANCE
    lean = point[paths.P_CANT] / RAIL_CENTRE_DISTANCE / math.hypot(1.0, point[paths.P_GRADIENT])
    yaw = v * bend + x[at[State.GYRO_BIAS]] + x[at[State.GYRO_TILT]] * v * roll
    side = v * v * bend - STANDARD_GRAVITY * lean + x[at[State.SIDE_BIAS]]
    return yaw, side


@pytest.mark.parametrize("which", [0, 1])
def test_rows_of_the_inertial_sensors(engine, which):
    h = engine.living()[0]
    row = empty()
    row[[c.TIME, c.SIGMA_YAW]] = 0.0, 1e-3
    row[(c.YAW_RATE, c.SIDE)[which]] = yaw_and_side(engine)[which] + 1e-3
    applied = row_of(
        engine, lambda: do_inertial(engine.filter, engine.network, engine.shared, engine.bank, engine.work, h, row, 0.1)
    )
    numeric = differences(engine, lambda: yaw_and_side(engine)[which], step=1e-3)
    cosine = applied @ numeric / np.linalg.norm(applied) / np.linalg.norm(numeric)
    assert cosine == pytest.approx(1.0, abs=1e-6)
    assert np.count_nonzero(np.abs(applied) > 1e-9 * np.abs(applied).max()) >= 3


def test_row_of_the_speed_of_the_receiver(engine):
    h, at = engine.living()[0], engine.filter.at
    place(engine)
    row = empty()
    row[[c.TIME, c.SIGMA_SPEED, c.GNSS_SPEED, c.FORCE]] = 0.0, 0.1, 22.3, 0.4

    def predicted():
        x = engine.bank.x[h]
        g = engine.work.point[h, paths.P_GRADIENT]
        a = 0.4 - 0.0 * x[0] - engine.bank.x[h, at[State.ACCELEROMETER_BIAS]] - STANDARD_GRAVITY * g / math.hypot(1, g)
        share = Settings().speed_error_share * 0.1
        return x[at[State.SPEED]] - x[at[State.SPEED_LATENCY]] * a + share * x[at[State.SPEED_ERROR]]

    applied = row_of(engine, lambda: do_speed(engine.filter, engine.shared, engine.bank, engine.work, h, row))
    numeric = differences(engine, predicted)
    numeric[at[State.ACCELEROMETER_BIAS]] = 0.0  # latency times a bias: left out, of second order
    cosine = applied @ numeric / np.linalg.norm(applied) / np.linalg.norm(numeric)
    assert cosine == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("way", [1.0, -1.0], ids=["onward", "backing up"])
@pytest.mark.parametrize(("lever", "near"), [(0.0, 1e-6), (2.0, 1e-5)], ids=["axis", "antenna ahead"])
def test_row_of_the_course(engine, lever, near, way):
    """Velocity across the path: the row against differences of the whole geometry, at the place that the time stamp says.

    The change of the curvature over a lever arm ahead is left out. A train that backs up sees the same curves under its course.
    """
    h, at = engine.living()[0], engine.filter.at
    engine.bank.x[h, at[State.SPEED]] = 22.0 * way
    engine.filter.lever[:] = lever, 0.4, -3.8
    engine.bank.x[h, at[State.TIME_TAG]] = 0.0
    place(engine)
    row = empty()
    point = engine.work.point[h]
    bearing = math.atan2(point[paths.P_D_EAST], point[paths.P_D_NORTH]) + 2e-4
    row[[c.TIME, c.SIGMA_SPEED, c.GNSS_SPEED, c.FORCE]] = 0.0, 0.1, 22.0, 0.4
    row[[c.COURSE_EAST, c.COURSE_NORTH]] = way * math.sin(bearing), way * math.cos(bearing)

    def predicted():
        x = engine.bank.x[h]
        there = np.empty(paths.POINT_SIZE)
        paths.track_point(
            engine.network, 0, 1, x[at[State.POSITION]] + x[at[State.SPEED]] * x[at[State.TIME_TAG]], there
        )
        east, north = there[[paths.P_D_EAST, paths.P_D_NORTH]] / np.hypot(*there[[paths.P_D_EAST, paths.P_D_NORTH]])
        across = 22.0 * (math.sin(bearing) * north - math.cos(bearing) * east)
        return 22.0 * there[paths.P_CURVATURE] * lever - across

    def update():
        engine.work.vector[c.W_H] = 0.0
        do_course(engine.filter, engine.shared, engine.bank, engine.work, h, row, way)

    applied = row_of(engine, update)
    numeric = differences(engine, predicted, step=1e-3)
    numeric[at[State.SPEED]] = 0.0  # speed times a stamp's error times bend: of second order
    cosine = applied @ numeric / np.linalg.norm(applied) / np.linalg.norm(numeric)
    assert cosine == pytest.approx(1.0, abs=1e-6)
    i_s = at[State.POSITION]
    kernel_row = applied[at[State.TIME_TAG]] / applied[i_s]
    assert kernel_row == pytest.approx(engine.bank.x[h, at[State.SPEED]], rel=1e-5)
    assert point[paths.P_CURVATURE] == pytest.approx(numeric[i_s] / 22.0, abs=near)


def test_row_of_the_wheel(engine):
    h, at = engine.living()[0], engine.filter.at
    row = empty()
    row[[c.TIME, c.WHEEL_SPEED]] = 0.0, 22.7

    def predicted():
        x = engine.bank.x[h]
        return (1.0 + x[at[State.ODOMETER_SCALE]]) * x[at[State.SPEED]]

    def update():
        engine.work.vector[c.W_H] = 0.0
        do_wheel_speed(engine.filter, engine.bank, engine.work, h, row)

    applied = row_of(engine, update)
    numeric = differences(engine, predicted)
    cosine = applied @ numeric / np.linalg.norm(applied) / np.linalg.norm(numeric)
    assert cosine == pytest.approx(1.0, abs=1e-9)


def test_a_balise_places_the_train_and_a_missed_one_counts_against_it(engine):
    h, at = engine.living()[0], engine.filter.at
    i_s = at[State.POSITION]
    engine.bank.x[h, i_s] = 1873.0
    engine.bank.P_sqrt[h, i_s, i_s] = 5.0
    row = empty()
    row[[c.TIME, c.BALISE_TRACK, c.BALISE_OFFSET, c.SIGMA_BALISE]] = 0.0, 0, 1880.0, 0.3
    engine.work.vector[c.W_H] = 0.0
    do_balise(engine.filter, engine.network, engine.bank, engine.work, h, row)
    assert engine.bank.x[h, i_s] == pytest.approx(1880.0, abs=0.1)
    assert np.linalg.norm(engine.bank.P_sqrt[h, i_s]) == pytest.approx(0.3, abs=0.01)
    before = float(engine.bank.info[h, paths.BY_BALISE])
    engine.bank.info[h, paths.PASSED] = 1880.0
    engine.bank.x[h, i_s] = 2300.0  # past B1 at 2000 m, in silence
    do_missed(engine.filter, engine.network, engine.bank, h)
    assert engine.bank.info[h, paths.BY_BALISE] - before == pytest.approx(math.log(Settings().balise_missed))
    do_missed(engine.filter, engine.network, engine.bank, h)  # once only
    assert engine.bank.info[h, paths.BY_BALISE] - before == pytest.approx(math.log(Settings().balise_missed))
    row[c.BALISE_OFFSET] = 5000.0  # far away: no place for it on this path
    x = engine.bank.x[h].copy()
    do_balise(engine.filter, engine.network, engine.bank, engine.work, h, row)
    assert np.array_equal(engine.bank.x[h], x)
    assert engine.bank.info[h, paths.BY_BALISE] < before + c.STRANGE_BALISE
