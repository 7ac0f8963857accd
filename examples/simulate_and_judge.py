"""A simulated train, navigated and judged against its own truth.

    python examples/simulate_and_judge.py

The train leaves line 77 for the branch. GNSS is gone for forty seconds on the way; IMU and odometer carry on.
"""

from __future__ import annotations

import railnav as rn
from railnav.evaluation import Evaluation
from railnav.simulation import SERVICE, Leg


def main(seed: int = 4) -> Evaluation:
    """Simulate, navigate, evaluate."""
    model = rn.demo_line()
    branch = Leg(("77R-08", "77R-09", "78-01"), start=20.0, finish=2500.0)
    run, truth = rn.simulate(model, branch, seed=seed, outfit=SERVICE, outages=[(70.0, 110.0)])
    print(f"{len(run.gnss)} fixes, {len(run.imu)} inertial samples, {truth.time[-1]:.0f} s")

    solution = rn.navigate(run, model)
    evaluation = rn.evaluate(solution, truth, model=model)
    along, selection = evaluation.along_statistics, evaluation.selection
    print(f"along: {along.rms:.2f} m RMS, 95 % within {along.p95:.2f} m, never more than {along.max:.2f} m")
    print(
        f"right track: {selection.rate:.1%} of {selection.rows} epochs, {selection.wrong_while_tracking} wrong while sure"
    )
    for stretch in evaluation.coasting:
        print(
            f"without GNSS {stretch.start:.0f} to {stretch.end:.0f} s, {stretch.distance:.0f} m: "
            f"{stretch.error_at_end:+.2f} m at its end, stated sigma {stretch.sigma_at_end:.2f} m"
        )
    print(f"errors beyond the protection level: {evaluation.integrity.events} of {evaluation.integrity.rows}")
    return evaluation


if __name__ == "__main__":
    main()
