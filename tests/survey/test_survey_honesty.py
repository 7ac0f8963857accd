"""Builds know how wrong they are: NEES across the track by kind of survey, noises estimated from the same data (A7 on builds)."""

import numpy as np
import pytest
from survey_simulator import Gyros, Receiver, axis_error, centre_line, drive, plane

from railnav.survey import build

#: Kind of survey, builds, and how far the mean may be off for want of independent errors alone (two standard errors of the mean).
KINDS = [
    ("white GNSS", {"receiver": Receiver("survey", correlated=0.0)}, 15, 0.08),
    ("white GNSS, angles", {"receiver": Receiver("survey", correlated=0.0), "gyros": Gyros()}, 15, 0.13),
    ("correlated GNSS", {}, 25, 0.20),
    ("correlated GNSS, angles", {"gyros": Gyros()}, 25, 0.30),
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "options", "builds", "scatter"), KINDS, ids=[kind[0] for kind in KINDS])
def test_nees_of_builds_is_one(kind, options, builds, scatter):
    found = []
    for seed in range(7000, 7000 + builds):
        rng, frame = np.random.default_rng([seed, 7]), plane()
        axis = centre_line(seed, 4.0, frame=frame)
        runs = [drive(axis, frame, rng, run_id=f"run-{p}", direction="up", day=p, **options) for p in range(3)]
        error, sigma = axis_error(build(runs), "up", axis)
        found.append(np.mean((error[20:-20] / sigma[20:-20]) ** 2))
    print(f"{kind}: NEES {np.mean(found):.3f}, standard error {np.std(found) / np.sqrt(builds):.3f}")  # noqa: T201
    assert 0.9 - scatter < np.mean(found) < 1.1 + scatter
