"""Does the navigator know how wrong it is: acceptance A7 of the specification (rail 28) for the navigator of section 19."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from railnav.navigation import Settings, State
from railnav.navigation import columns as c
from railnav.navigation.engine import Engine
from railnav.navigation.epochs import raw_table
from railnav.simulation import SERVICE, Leg, simulate
from railnav.simulation.sensors import GnssSensor

#: The receiver of section 19.5: 1.5 m and 0.1 m/s, white.
WHITE = GnssSensor(
    white_horizontal=1.5, white_vertical=3.0, coloured_horizontal=0.0, coloured_vertical=0.0, speed_sigma=0.1
)
OUTFIT = replace(SERVICE, gnss=WHITE, odometer=replace(SERVICE.odometer, slip_rate=0.0))
#: The navigator told so: white fixes, exact stamps, no latency, inertial sensors as good as this simulation's. The accelerometer's bias
#: walks a little faster than the sensor's own: in curves a mounting that is off turns side force into forward force.
TOLD = Settings(
    gnss_correlated_share=1e-3,
    gnss_white_share=1.0,
    gnss_frame_share=0.0,
    speed_error_share=1e-3,
    time_tag_sigma=1e-4,
    time_tag_walk=1e-6,
    accelerometer_noise=1.6e-3,
    accelerometer_walk=1.4e-4,
    gyro_scale=1e-3,
    gyro_floor=5e-5,
    speed_latency=0.01,
)


def errors_and_covariances(run, truth, model, settings):
    """Errors of offset and speed after the first minute, (m, 2), and the filter's covariance of them, (m, 2, 2)."""
    raw = raw_table(run)
    engine = Engine(
        model,
        settings,
        imu=True,
        odometer="distance",
        speed=True,
        signed_odometer=False,
        lever_arm_b=run.gnss.lever_arm_b,
        integrity_risk=1e-4,
        records=2 * len(raw) + 100,
    )
    out = np.empty((len(raw), c.OUTPUT_SIZE))
    engine.advance(engine.table(raw), out)
    records = engine.records
    numbers = records.numbers[: int(records.used[0])]
    epoch = numbers[:, c.R_EPOCH].astype(int)
    order = np.lexsort((numbers[:, c.R_LOGW], epoch))
    heaviest = order[np.append(np.diff(epoch[order]) > 0, True)]
    record = np.full(len(raw), -1)
    record[epoch[heaviest]] = heaviest
    k = np.clip(np.searchsorted(truth.time, raw[:, 0] + 1e-4) - 1, 0, len(truth.time) - 1)
    rows = (record >= 0) & (raw[:, 0] > 60.0) & (np.abs(truth.time[k] - raw[:, 0]) < 0.02)
    rows &= out[:, c.OUT_TRACK] == truth.track[k]
    at = engine.filter.at[[State.POSITION, State.SPEED]]
    root = records.P_sqrt[record[rows]]
    covariance = (root @ np.swapaxes(root, 1, 2))[:, at][:, :, at]
    offset, speed = out[rows, c.OUT_OFFSET] - truth.offset[k][rows], out[rows, c.OUT_SPEED] - truth.speed[k][rows]
    return np.column_stack([offset, speed]), covariance


def monte_carlo(line, settings, seeds, finish):
    """NEES/2 of each run, and the errors' root mean squares."""
    nees, squares = [], []
    for seed in seeds:
        run, truth = simulate(
            line, Leg(("77R-03",), start=200.0, finish=finish), seed=seed, outfit=OUTFIT, tunnels=False
        )
        error, covariance = errors_and_covariances(run, truth, line, settings)
        nees.append(0.5 * np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error).mean())
        squares.append((error**2).mean(axis=0))
    return np.array(nees), np.sqrt(np.mean(squares, axis=0))


@pytest.mark.slow
def test_a7_the_navigator_told_of_its_sensors_is_consistent(line):
    """GNSS 1.5 m white, odometer, IMU, an exact model: NEES/2 between 0.9 and 1.1 over 80 runs, along 0.25 m, speed 0.02 m/s."""
    nees, rms = monte_carlo(line, TOLD, range(79_000, 79_080), 9500.0)
    assert 0.9 < nees.mean() < 1.1
    assert rms[0] < 0.25
    assert rms[1] < 0.02


def test_an_untold_navigator_errs_on_the_safe_side(line):
    """It takes the fixes for coloured, as receivers' are: sigmas larger than errors, and never the other way."""
    nees, rms = monte_carlo(line, Settings(), range(62_000, 62_004), 4000.0)
    assert 0.02 < nees.mean() < 1.0
    assert rms[0] < 0.6
