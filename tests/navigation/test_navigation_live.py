"""The live navigator: sensors in any order, epochs that are late, gaps, reversals inside gaps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from railnav.errors import RunError
from railnav.navigation import Epoch, Mode, Navigator, epochs, navigate
from railnav.simulation import SERVICE, Leg, simulate

GNSS = ("latitude", "longitude", "sigma_east", "sigma_north", "hdop", "speed", "course", "sigma_speed")
WHEEL = ("distance",)
INERTIAL = ("forward_force", "yaw_rate", "sigma_yaw_rate", "side_force", "sigma_force")


@pytest.fixture(scope="module")
def ride(line):
    run, truth = simulate(line, Leg(("77R-03",), start=300.0, finish=3000.0), seed=4, outfit=SERVICE, tunnels=False)
    return run, truth


def apart(epoch):
    """One epoch a sensor."""
    for names in (GNSS, WHEEL, INERTIAL):
        brought = {name: getattr(epoch, name) for name in names if math.isfinite(getattr(epoch, name))}
        if brought:
            yield replace(Epoch(epoch.time), **brought)


def test_sensors_come_in_any_order_within_the_patience(line, ride):
    run, _ = ride
    whole = list(epochs(run))[:600]
    ordered = Navigator(line, lever_arm_b=run.gnss.lever_arm_b)
    for epoch in whole:
        expected = ordered.step(epoch)
    rng = np.random.default_rng(1)
    single = [(e.time + rng.uniform(0.0, 0.3), e) for epoch in whole for e in apart(epoch)]
    patient = Navigator(line, lever_arm_b=run.gnss.lever_arm_b, patience=0.4)
    first = patient.step(single[0][1])
    assert first.mode == Mode.INITIALISING
    assert first.track is None
    for _, epoch in sorted(single[1:], key=lambda item: item[0]):
        said = patient.step(epoch)
        assert said.time <= epoch.time
    final = patient.flush()
    assert final.time == expected.time
    assert final.offset == pytest.approx(expected.offset, abs=1e-9)
    assert final.track_probability == pytest.approx(expected.track_probability, abs=1e-9)
    assert final.protection_level_along == pytest.approx(expected.protection_level_along, abs=1e-9)


def test_what_comes_too_late_is_refused_with_a_statement(line, ride):
    run, _ = ride
    navigator = Navigator(line, lever_arm_b=run.gnss.lever_arm_b, patience=0.5)
    some = list(epochs(run))[:50]
    for epoch in some:
        navigator.step(epoch)
    with pytest.raises(RunError, match=r"0\.\d+ s late; sort the epochs, or give the navigator patience"):
        navigator.step(Epoch(some[-1].time - 1.0))
    assert navigator.flush().time == some[-1].time  # and it goes on
    with pytest.raises(ValueError, match="patience"):
        Navigator(line, patience=-1.0)


def test_a_reversal_inside_a_gap_is_found(line):
    """Without GNSS for a minute, in which the train stops and comes back; the signed wheel and the accelerometer tell."""
    out = replace(SERVICE, odometer=replace(SERVICE.odometer, signed=True, slip_rate=0.0))
    legs = [
        Leg(("77R-03",), start=2000.0, finish=3200.0, dwell=20.0),
        Leg(("77R-03",), start=3200.0, finish=2600.0, dwell=20.0),
    ]
    run, truth = simulate(line, legs, seed=5, outfit=out, tunnels=False)
    turn = float(truth.time[int(np.argmax(truth.offset))])
    keep = (run.gnss.time < turn - 20.0) | (run.gnss.time > turn + 45.0)
    names = (
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
    kept = {name: getattr(run.gnss, name)[keep] for name in names}
    gnss = replace(run.gnss, time=run.gnss.time[keep], quality=None, satellites=None, hdop=None, **kept)
    solution = navigate(replace(run, gnss=gnss), line)
    k = np.clip(np.searchsorted(truth.time, solution.time + 1e-4) - 1, 0, len(truth.time) - 1)
    here = solution.track == line.track_index("77R-03")
    inside = here & (solution.time > turn - 15.0) & (solution.time < turn + 44.0)
    assert inside.sum() > 300
    error = np.abs(solution.offset - truth.offset[k])[inside]
    assert error.max() < 5.0
    assert (error < solution.protection_level_along[inside]).all()
    back = inside & (truth.speed[k] < -1.0)
    assert back.sum() > 50
    assert (solution.speed[back] < 0.0).all()


def test_a_gap_of_five_minutes_is_survived(line):
    run, truth = simulate(line, Leg(("77R-03",), start=300.0, finish=9500.0), seed=6, outfit=SERVICE, tunnels=False)
    keep = (run.gnss.time < 60.0) | (run.gnss.time > 360.0)
    names = (
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
    kept = {name: getattr(run.gnss, name)[keep] for name in names}
    gnss = replace(run.gnss, time=run.gnss.time[keep], quality=None, satellites=None, hdop=None, **kept)
    solution = navigate(replace(run, gnss=gnss), line)
    k = np.clip(np.searchsorted(truth.time, solution.time + 1e-4) - 1, 0, len(truth.time) - 1)
    point, true = line.at(truth.track[k], truth.offset[k]), truth.offset[k]
    assert np.isfinite(point.easting).all()
    inside = (solution.time > 65.0) & (solution.time < 359.0) & (truth.time[-1] > solution.time)
    assert np.isin(solution.mode[inside], (Mode.COASTING, Mode.AMBIGUOUS)).all()
    error = np.abs(solution.offset - true)[inside]
    assert error.max() < 10.0
    assert (error <= solution.protection_level_along[inside]).all()
    assert solution.diagnostics["starts"] == 1


def test_a_live_row_is_the_offline_row(line, ride):
    """The expanded projection against the whole one, over the ride and a kilometre to the sides."""
    from railnav.navigation.epochs import LiveTable, kernel_table, raw_table

    run, _ = ride
    raw = raw_table(run)
    table = kernel_table(raw, line.frame, 0.88)
    live = LiveTable(line.frame, 0.88)
    for i, epoch in enumerate(epochs(run)):
        row = np.array(live.row(epoch, (math.nan, math.nan)))
        assert np.array_equal(np.isnan(row), np.isnan(table[i]))
        assert np.nanmax(np.abs(row - table[i])) < 2e-5


def test_memory_is_flat_over_a_long_ride(line, ride):
    """What the navigator holds does not grow with the epochs."""
    run, _ = ride
    navigator = Navigator(line, lever_arm_b=run.gnss.lever_arm_b)
    engine = navigator._engine
    sizes = []
    for i, epoch in enumerate(epochs(run)):
        navigator.step(epoch)
        if i in (10, 900):
            held = [*engine.bank, *engine.work, *engine.records, engine.shared.ring, engine.journal.lines]
            sizes.append(sum(array.nbytes for array in held))
    assert sizes[0] == sizes[1]
    assert len(navigator._waiting) == 0
