"""A minute without GNSS, five ways: IMU alone, with wheels, with hindsight, held to the track, and the corrector for small computers.

    python examples/through_an_outage.py

A simulated train with 1.5 m GNSS, a low-cost IMU and an odometer; the receiver is silent for a minute. Schemes without a map need no model.
"""

from __future__ import annotations

import numpy as np

import railnav as rn
from railnav.navigation.schemes import navigate_inertial
from railnav.navigation.schemes.arc_run import navigate_arc
from railnav.simulation import SERVICE, Leg, simulate

#: Silence of the receiver, s on the run's clock.
SILENT = (150.0, 210.0)


def main(seed: int = 2) -> dict[str, float]:
    """Simulate, navigate by each scheme, and find the largest error along in the silence."""
    line = rn.demo_line()
    over = Leg(("77R-01", "77X-01", "77L-02", "77L-03"), start=100.0, finish=7000.0)
    run, truth = simulate(line, over, seed=seed, outfit=SERVICE, outages=[SILENT])

    solutions = {
        "loose": navigate_inertial(run, scheme="loose"),
        "odometer": navigate_inertial(run, scheme="odometer"),
        "odometer, smoothed": navigate_inertial(run, scheme="odometer", smooth=True),
        "map-corrector": navigate_arc(run, line),
        "track": rn.navigate(run, line),
    }
    worst = {}
    for name, solution in solutions.items():
        evaluation = rn.evaluate(solution, truth)
        silent = (evaluation.time > SILENT[0]) & (evaluation.time < SILENT[1])
        worst[name] = float(np.nanmax(np.abs(evaluation.along[silent])))
        sigma = float(np.nanmax(evaluation.sigma_along[silent]))
        print(f"{name:20} largest error along {worst[name]:6.1f} m (stated sigma at most {sigma:.1f} m)")
    return worst


if __name__ == "__main__":
    main()
