"""Trains in service on the bundled line, simulated: errors, tracks, and whether the covariance and the bound hold, over many seeds.

    python benchmarks/service.py [--seeds 20] [--json PATH]

Each seed draws one of the lawful ways through the line (either direction, main line or branch, over any crossovers), a stop at the station,
and the errors of the sensors: 1 Hz GNSS with white and coloured errors, 100 Hz low-cost IMU, odometer, two tunnels. Epochs of one
run are not independent; the bounds of the pooled NEES allow for that.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

import railnav as rn
from railnav.evaluation import Evaluation, pooled
from railnav.simulation import SERVICE, Leg, Stop

#: Ends between which the ways run.
ENDS = (("77R-01", "77R-13"), ("77R-01", "78-01"), ("77R-13", "77R-01"), ("77L-12", "77L-01"), ("77L-01", "77L-12"))


def one(line: rn.TrackModel, seed: int) -> dict[str, Evaluation]:
    """Simulate one service run and navigate it forward and smoothed."""
    random = np.random.default_rng([seed, 7])
    first, last = ENDS[seed % len(ENDS)]
    route = line.routes(first, last)[int(random.integers(16))]
    ends = [line.length(route.tracks[0]), line.length(route.tracks[-1])]
    start = 60.0 if route.directions[0] > 0 else ends[0] - 60.0
    finish = ends[1] - 60.0 if route.directions[-1] > 0 else 60.0
    station = next(t for t in route.tracks if t in {"77R-06", "77L-06", "77S-1", "77S-4"})
    leg = Leg(route.tracks, start=start, finish=finish, stops=(Stop(station, 700.0, 45.0),))
    run, truth = rn.simulate(line, leg, seed=seed, outfit=SERVICE)
    return {
        name: rn.evaluate(rn.navigate(run, line, smooth=smooth), truth, model=line)
        for name, smooth in (("forward", False), ("smoothed", True))
    }


def summary(parts: list[Evaluation]) -> dict[str, Any]:
    """Figures over all runs."""
    along = np.concatenate([p.along for p in parts])
    level = np.concatenate([p.protection_level for p in parts])
    at_end = np.array([c.error_at_end for p in parts for c in p.coasting if c.error_at_end is not None])
    epochs = sum(p.positioned for p in parts)
    consistent = pooled([p.consistency for p in parts])
    tracking = sum(p.selection.tracking for p in parts)
    return {
        "runs": len(parts),
        "epochs": epochs,
        "along_rms_m": float(np.sqrt(np.mean(along**2))),
        "along_p95_m": float(np.quantile(np.abs(along), 0.95)),
        "along_max_m": float(np.abs(along).max()),
        "coasting_end_rms_m": float(np.sqrt(np.mean(at_end**2))) if len(at_end) else None,
        "right_track": sum(p.selection.right for p in parts) / max(1, sum(p.selection.rows for p in parts)),
        "tracking": tracking / epochs,
        "tracking_right": sum(p.selection.tracking_right for p in parts) / max(1, tracking),
        "sure_of_a_wrong_track": sum(p.selection.overconfident for p in parts),
        "illegal_jumps": sum(len(p.jumps.illegal) for p in parts if p.jumps is not None),
        "nees": consistent.nees,
        "nees_bounds": (consistent.lower, consistent.upper),
        "coverage": consistent.coverage,
        "beyond_bound": int(np.sum(np.abs(along) > level)),
        "integrity_risk": parts[0].integrity.integrity_risk,
    }


def main() -> None:
    """Print the figures, and write them where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--json", type=Path, metavar="PATH")
    options = parser.parse_args()
    line = rn.demo_line()
    parts: dict[str, list[Evaluation]] = {"forward": [], "smoothed": []}
    for seed in range(1, options.seeds + 1):
        for name, evaluation in one(line, seed).items():
            parts[name].append(evaluation)
    figures = {name: summary(evaluations) for name, evaluations in parts.items()}
    print(f"simulated: {options.seeds} service runs over the bundled line, {figures['forward']['epochs']:,} epochs")
    for name, f in figures.items():
        lower, upper = f["nees_bounds"]
        print(
            f"\n{name}\n"
            f"  along-track error          {f['along_rms_m']:.2f} m RMS, 95 % {f['along_p95_m']:.2f} m, worst {f['along_max_m']:.2f} m\n"
            f"  at the end of coasting     {f['coasting_end_rms_m'] or float('nan'):.2f} m RMS\n"
            f"  right track                {f['right_track']:.3%} of epochs; tracking {f['tracking']:.1%}, of these right "
            f"{f['tracking_right']:.3%}\n"
            f"  sure of a wrong track      {f['sure_of_a_wrong_track']} epochs\n"
            f"  unlawful jumps             {f['illegal_jumps']}\n"
            f"  NEES along                 {f['nees']:.2f}, honest between {lower:.2f} and {upper:.2f}\n"
            f"  within 1, 2, 3 sigma       {', '.join(f'{c:.1%}' for c in f['coverage'])}\n"
            f"  beyond the bound           {f['beyond_bound']} of {f['epochs']:,} (risk {f['integrity_risk']:g} an epoch)"
        )
    if options.json:
        options.json.write_text(json.dumps({"simulated": True} | figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
