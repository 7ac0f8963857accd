"""Build of a real line: time, memory, and how well the model meets a run that it did not see.

    python benchmarks/build.py --json build.json

The line is line80 of the shared data: 8 trains, each with a u-blox M8N and an iPhone (one with an MTK3339 as well), 122 km, both
directions. There is no truth; a model is judged by runs that it did not see: the robust spread (1.4826 MAD) of their distances
across the track of their direction. The baseline is that of the data's notes: medians of the other receivers' runs in 10 m bins.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.io.run import read_run
from railnav.run import Run
from railnav.survey import build
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

#: Robust sigma across the track, nearest-track baseline, m (notes on the data).
BASELINE = {"iphone": 3.3, "ublox": 4.2, "mtk": 5.3}
#: Fixes whose stated sigma exceeds this, m, are left out of the judgement, as no user would take them; the baseline's were too.
DOUBTFUL = 50.0


def data_folder() -> Path | None:
    """Where the shared data lie, when they do."""
    folder = Path(os.environ.get("RAILNAV_DATA", Path(__file__).parents[2] / "shared" / "data")) / "line80"
    return folder if folder.is_dir() else None


def distances(model: TrackModel, run: Run) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Distances of a run's fixes to the right of the track of its direction, of the nearest track, m, and the normal there."""
    from scipy.spatial import cKDTree

    gnss = run.gnss
    assert gnss is not None
    sound = np.ones(len(gnss), bool) if gnss.sigma_east is None else gnss.sigma_east < DOUBTFUL
    east, north, _ = model.frame.to_grid(gnss.latitude[sound], gnss.longitude[sound])
    found = []
    for i in range(len(model.track_id)):
        k = slice(int(model.knot_start[i]), int(model.knot_start[i + 1]))
        e, n, bearing = model.easting[k], model.northing[k], model.grid_bearing[k]
        at = cKDTree(np.column_stack([e, n])).query(np.column_stack([east, north]))[1]
        sin, cos = np.sin(bearing[at]), np.cos(bearing[at])
        right = (east - e[at]) * cos - (north - n[at]) * sin
        inside = (at > 0) & (at < len(e) - 1)
        found.append((np.where(inside, right, np.nan), cos, -sin))
    own = model.track_id.index(run.direction)
    stack = np.array([f[0] for f in found])
    nearest = stack[
        np.nanargmin(np.where(np.isfinite(stack), np.abs(stack), np.inf), axis=0), np.arange(stack.shape[1])
    ]
    return found[own][0], nearest, found[own][1], found[own][2]


def spread(values: FloatArray) -> float:
    """1.4826 MAD about the median, m."""
    values = values[np.isfinite(values)]
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def judge(model: TrackModel, run: Run) -> dict[str, Any]:
    """Judge a model by a run that it did not see."""
    right, nearest, e, n = distances(model, run)
    use = np.isfinite(right)
    A, d = np.column_stack([e, n])[use], right[use]
    own = np.zeros(2)
    for _ in range(10):
        residual = d - A @ own
        keep = np.abs(residual - np.median(residual)) < 3.0 * spread(residual)
        own = np.linalg.lstsq(A[keep], d[keep], rcond=None)[0]
    receiver = run.gnss.receiver if run.gnss is not None else ""
    known = [r for r in model.provenance["build"]["receivers"] if r["receiver"] == receiver]
    usual = np.array([known[0]["offset_east_m"], known[0]["offset_north_m"]]) if known else np.full(2, np.nan)
    return {
        "run": run.id,
        "receiver": receiver,
        "fixes": int(use.sum()),
        "as_recorded_m": spread(right),
        "receiver_offset_removed_m": spread(d - A @ usual) if known else None,
        "own_offset_removed_m": spread(d - A @ own),
        "nearest_track_m": spread(nearest),
        "median_m": float(np.median(d)),
        "own_offset_m": [float(v) for v in own],
    }


def measure(*, leave_one_out: bool = True, whole_trains: bool = True) -> dict[str, Any]:
    """Measure everything; an empty answer where the data are absent."""
    folder = data_folder()
    if folder is None:
        return {}
    runs = [read_run(d) for d in sorted(folder.iterdir()) if d.name.endswith(("_ublox", "_iphone"))]
    others = [read_run(d) for d in sorted(folder.iterdir()) if d.name.endswith("_mtk")]
    build(runs[:2])  # compiles
    start = time.perf_counter()
    model = build(runs)
    seconds = time.perf_counter() - start
    figures: dict[str, Any] = {
        "runs": len(runs),
        "fixes": sum(len(r.gnss) for r in runs if r.gnss is not None),
        "length_m": float(sum(t["length_m"] for t in model.provenance["build"]["tracks"])),
        "seconds": seconds,
        "peak_rss_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "receivers": model.provenance["build"]["receivers"],
        "datum": model.provenance["build"]["datum"],
        "tracks": [{k: v for k, v in t.items() if k != "survey_again"} for t in model.provenance["build"]["tracks"]],
        "baseline_m": BASELINE,
        "not_in_the_build": [judge(model, run) for run in others],
    }
    if leave_one_out:
        figures["one_run_left_out"] = [judge(build([r for r in runs if r is not run]), run) for run in runs]
    if whole_trains:
        left = []
        for day in sorted({run.id[:10] for run in runs}):
            rest = build([r for r in runs if not r.id.startswith(day)])
            left += [judge(rest, run) for run in runs + others if run.id.startswith(day)]
        figures["whole_train_left_out"] = left
    return figures


def summary(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Mean over the runs of each receiver."""
    keys = ("as_recorded_m", "nearest_track_m", "receiver_offset_removed_m", "own_offset_removed_m")
    return {
        receiver: {
            key: float(np.mean([r[key] for r in rows if r["receiver"] == receiver and r[key] is not None] or [np.nan]))
            for key in keys
        }
        for receiver in sorted({r["receiver"] for r in rows})
    }


def main(arguments: list[str] | None = None) -> int:
    """Print the figures, and write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the figures here")
    parser.add_argument("--quick", action="store_true", help="time and memory only")
    options = parser.parse_args(arguments)
    figures = measure(leave_one_out=not options.quick, whole_trains=not options.quick)
    if not figures:
        print("the shared data are not here; set RAILNAV_DATA", file=sys.stderr)
        return 1
    print(
        f"build of {figures['runs']} runs, {figures['fixes']:,} fixes, {figures['length_m'] / 1000:.1f} km of track: "
        f"{figures['seconds']:.1f} s, {figures['peak_rss_gb']:.2f} GB (bars: 60 s, 2 GB)"
    )
    for track in figures["tracks"]:
        print(
            f"  track {track['track']}: {track['length_m']:.1f} m, sigma across {track['sigma_cross_m']:.2f} m (median)"
        )
    for kind in figures["receivers"]:
        print(
            f"  receiver {kind['receiver']}: frame offset {kind['offset_east_m']:+.2f} m east, {kind['offset_north_m']:+.2f} m north "
            f"of the datum, sigma {kind['sigma_east_m']:.2f} and {kind['sigma_north_m']:.2f} m, {kind['runs']} runs"
        )
    titles = {
        "one_run_left_out": "one run left out",
        "whole_train_left_out": "all runs of that train left out",
        "not_in_the_build": "a receiver that is not in the build (all 16 runs are)",
    }
    for name, title in titles.items():
        rows = figures.get(name)
        if not rows:
            continue
        print(f"\n{title}: 1.4826 MAD of a run's distances across the track it did not help to make, m")
        print(f"{'':28}{'own track of its direction':>40}{'nearest':>10}{'baseline':>10}")
        print(f"{'run':28}{'as recorded':>12}{'receiver off.':>14}{'own offset':>14}{'track':>10}{'nearest':>10}")
        lines = [(r["run"], r) for r in rows] + [
            (f"mean of {k}", {**v, "receiver": k}) for k, v in summary(rows).items()
        ]
        for label, r in lines:
            numbers = [
                r["as_recorded_m"],
                r["receiver_offset_removed_m"],
                r["own_offset_removed_m"],
                r["nearest_track_m"],
            ]
            widths = (12, 14, 14, 10)
            cells = "".join(
                f"{'' if v is None or not np.isfinite(v) else f'{v:.2f}':>{w}}"
                for v, w in zip(numbers, widths, strict=True)
            )
            print(f"{label:28}{cells}{BASELINE.get(r['receiver'], float('nan')):>10.1f}")
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
