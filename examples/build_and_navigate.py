"""The whole way in small: survey runs become a model, a train finds itself on it, and the truth says how well.

    python examples/build_and_navigate.py

Three passes of a survey car (2 cm GNSS) over 3 km of the bundled line's right track; then a train in service with 1.5 m GNSS, IMU and
odometer drives the same way, and is navigated on the model that the survey made.
"""

from __future__ import annotations

import railnav as rn
from railnav.evaluation import Evaluation
from railnav.simulation import SERVICE, SURVEY, Leg

#: Tracks of the bundled line that are surveyed: 3 km with a curve of 1200 m radius.
TRACKS = ("77R-01", "77R-02", "77R-03")
SURVEYED = Leg(TRACKS, start=100.0, finish=2100.0)
#: The train in service keeps inside: no model reaches beyond its survey.
SERVED = Leg(TRACKS, start=200.0, finish=2000.0)


def main(seed: int = 1) -> tuple[rn.TrackModel, Evaluation]:
    """Simulate, build, navigate, evaluate."""
    line = rn.demo_line()

    surveys = []
    for number in range(3):
        run, _ = rn.simulate(
            line, SURVEYED, seed=seed + number, outfit=SURVEY, run_id=f"survey-{number + 1}", direction="up"
        )
        surveys.append(run)
    model = rn.build(surveys)
    print(f"built from {len(surveys)} runs: {len(model.track_id)} tracks, {model.lengths.sum():.1f} m")

    run, truth = rn.simulate(line, SERVED, seed=seed + 100, outfit=SERVICE, direction="up")
    solution = rn.navigate(run, model)
    evaluation = rn.evaluate(solution, truth)
    along, across = evaluation.along_statistics, evaluation.across_statistics
    print(f"navigated {evaluation.positioned} of {evaluation.epochs} epochs")
    print(f"along: {along.rms:.2f} m RMS, 95 % within {along.p95:.2f} m")
    print(f"across: {100 * across.rms:.1f} cm RMS - the model's error, for the train is held to its track")
    return model, evaluation


if __name__ == "__main__":
    main()
