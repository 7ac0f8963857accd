"""Parallel tracks, simulated: whether the stated probability of the track is true, and how long deciding takes.

    python benchmarks/parallel.py [--seeds 60]

Six kilometres on one track of the bundled double line, 4 m from the other, no turnout on the way: 1 Hz GNSS with white and coloured errors,
IMU, odometer. One epoch in a hundred seconds is taken, so that they are nearly independent.
"""

from __future__ import annotations

import argparse
import itertools

import numpy as np

import railnav as rn
from railnav.simulation import SERVICE, Leg

EDGES = (0.0, 0.6, 0.8, 0.95, 0.99, 0.999, 1.0 + 1e-9)


def main() -> None:
    """Print the reliability table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=60)
    seeds = parser.parse_args().seeds
    line = rn.demo_line()
    stated, right, decided, wrong, claimed = [], [], [], 0, 0
    for seed in range(1, seeds + 1):
        track = ("77R-03", "77L-03")[seed % 2]
        run, truth = rn.simulate(
            line, Leg((track,), start=300.0, finish=6300.0), seed=seed, outfit=SERVICE, tunnels=False
        )
        solution = rn.navigate(run, line)
        hit = solution.track == line.track_index(track)
        sure = solution.mode == rn.Mode.TRACKING
        claimed += int(sure.sum())
        wrong += int((sure & ~hit).sum())
        decided.append(float(solution.time[np.argmax(sure)]) if sure.any() else np.inf)
        for t in np.arange(5.0, truth.time[-1], 100.0):
            i = min(int(np.searchsorted(solution.time, t)), len(solution) - 1)
            stated.append(float(solution.track_probability[i]))
            right.append(bool(hit[i]))
    p, r = np.array(stated), np.array(right)
    print(f"simulated: {seeds} runs, parallel tracks 4 m apart, track declared at 0.99")
    print("stated probability    epochs   mean stated   right")
    for low, high in itertools.pairwise(EDGES):
        inside = (p >= low) & (p < high)
        if inside.any():
            print(
                f"{low:8.3f} to {min(high, 1.0):.3f} {inside.sum():9d} {p[inside].mean():12.3f} {r[inside].mean():9.3f}"
            )
    print(
        f"epochs on a declared track: {claimed:,}, of them on the wrong one {wrong:,} ({wrong / max(claimed, 1):.3%})"
    )
    middle, late = np.quantile(decided, [0.5, 0.9])
    print(f"time until a track is declared: median {middle:.0f} s, 90 % within {late:.0f} s")


if __name__ == "__main__":
    main()
