"""A train that goes to and fro on one track: what it knew on the way out it still knows on the way back."""

from dataclasses import replace

import numpy as np
import pytest

import railnav as rn
from railnav.simulation import SERVICE, Leg, simulate

TRACK = "77R-03"


@pytest.mark.parametrize("seed", [11, 12])
@pytest.mark.parametrize("left_out", [(), ("imu",), ("imu", "odometer")], ids=["all", "no imu", "gnss alone"])
def test_the_place_does_not_creep_with_every_turn(seed, left_out):
    line = rn.demo_line()
    there, back = Leg((TRACK,), finish=5500.0, dwell=20.0), Leg((TRACK,), finish=500.0, dwell=20.0)
    run, truth = simulate(
        line, [replace(there, start=500.0), back, there, back], seed=seed, outfit=SERVICE, tunnels=False
    )
    solution = rn.navigate(replace(run, **dict.fromkeys(left_out)), line)
    at = np.clip(np.searchsorted(truth.time, solution.time + 1e-4) - 1, 0, len(truth.time) - 1)
    error = solution.offset - truth.offset[at]
    right = solution.track == truth.track[at]
    last = (
        solution.time > 0.75 * solution.time[-1]
    ) & right  # the fourth way; curves let in with a wrong sign cost 5 m by then
    assert last.sum() > 0.9 * (solution.time > 0.75 * solution.time[-1]).sum()
    assert np.sqrt(np.mean(error[last] ** 2)) < 1.5
    assert np.sqrt(np.mean((error[last] / solution.sigma_along[last]) ** 2)) < 2.0
    assert np.mean(np.abs(error[right]) > solution.protection_level_along[right]) < 1e-3
