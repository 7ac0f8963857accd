"""A simulated survey of the bundled double line: how near the built axis and length come to the truth, and whether the covariance holds.

    python benchmarks/survey.py [--seeds 4] [--json PATH]

Three passes over each main track with 2 cm GNSS, everything simulated; tunnels are opened, so that GNSS is there all the way. Both lengths
are between the same two places on the ground, 24 km apart, found by foot points at both ends of the built track.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

import railnav as rn
from railnav.simulation import SURVEY, Leg
from railnav.track import TrackModel

PASSES = 3


def survey(line: TrackModel, seed: int) -> tuple[TrackModel, dict[str, tuple[str, ...]]]:
    """Simulate three passes a track, and build."""
    right = tuple(sorted(t for t in line.track_id if t.startswith("77R-")))
    left = tuple(sorted((t for t in line.track_id if t.startswith("77L-")), reverse=True))
    seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(2 * PASSES)]
    runs = []
    for number, one in enumerate(seeds):
        tracks, direction = (right, "up") if number % 2 == 0 else (left, "down")
        ends = (20.0, line.length(tracks[-1]) - 20.0) if direction == "up" else (line.length(tracks[0]) - 20.0, 20.0)
        leg = Leg(tracks, start=ends[0], finish=ends[1])
        run, _ = rn.simulate(
            line, leg, seed=one, outfit=SURVEY, tunnels=False, run_id=f"survey-{number + 1}", direction=direction
        )
        runs.append(run)
    return rn.build(runs), {"up": right, "down": left}


def judge(model: TrackModel, line: TrackModel, ways: dict[str, tuple[str, ...]]) -> list[dict[str, Any]]:
    """Errors of each built track against the line: across, in length, and over their stated sigma."""
    rows = []
    for track in model.track_id:
        tracks = ways[track]
        before = np.append(0.0, np.cumsum([line.length(t) for t in tracks]))
        knots = np.arange(model.knots(track).start + 400, model.knots(track).stop - 400, 25)
        error, sigma, way = [], [], []
        for k in knots:
            feet = line.locate(float(model.easting[k]), float(model.northing[k]), within=5.0)
            foot = min((f for f in feet if f.track in tracks), key=lambda f: f.distance)
            place = tracks.index(foot.track)
            along = foot.offset if track == "up" else line.length(foot.track) - foot.offset
            way.append(before[place] + along)
            error.append(foot.cross)
            cov = model.covariance_g[k]
            cos, sin = np.cos(model.grid_bearing[k]), -np.sin(model.grid_bearing[k])
            sigma.append(np.sqrt(cos * cos * cov[0] + 2 * cos * sin * cov[1] + sin * sin * cov[3]))
        e, s = np.array(error), np.array(sigma)
        built, true = model.offset[knots[-1]] - model.offset[knots[0]], abs(way[-1] - way[0])
        rows.append(
            {
                "track": track,
                "axis_rms_m": float(np.sqrt(np.mean(e**2))),
                "axis_max_m": float(np.abs(e).max()),
                "sigma_m": float(np.median(s)),
                "nees": float(np.mean((e / s) ** 2)),
                "length_m": float(true),
                "length_error_ppm": float((built - true) / true * 1e6),
            }
        )
    return rows


def main() -> None:
    """Print a table, and write the figures where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--json", type=Path, metavar="PATH")
    options = parser.parse_args()
    line = rn.demo_line()
    rows = []
    print("simulated: 2 cm GNSS, three passes a track, bundled line (bars: axis 10 mm RMS, length 20 ppm)\n")
    print("seed  track   axis RMS   worst   stated sigma   NEES   length      length error")
    for seed in range(1, options.seeds + 1):
        model, ways = survey(line, seed)
        for row in judge(model, line, ways):
            rows.append({"seed": seed, **row})
            print(
                f"{seed:4d}  {row['track']:6}{row['axis_rms_m'] * 1e3:7.1f} mm{row['axis_max_m'] * 1e3:6.0f} mm"
                f"{row['sigma_m'] * 1e3:10.1f} mm{row['nees']:9.2f}{row['length_m']:11.1f} m{row['length_error_ppm']:9.2f} ppm"
            )
    print(f"\nNEES over all: {np.mean([r['nees'] for r in rows]):.2f} (1 is honest)")
    if options.json:
        options.json.write_text(json.dumps({"simulated": True, "rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
