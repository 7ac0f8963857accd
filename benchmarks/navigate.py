"""The navigator: speed offline and live, the sample run against its truth, and a real line that has none.

    python benchmarks/navigate.py [--json PATH] [--quick]

The sample run is the independent simulator's in the shared data: 1 Hz GNSS with coloured errors, two gaps, 100 Hz IMU, odometer with a slip
and a slide. The line is line80: 8 trains with two or three receivers each, no truth; every run is navigated on a model built from the
telephones of the other trains. `jumps` are changes of track from row to row that no train can make while a track is claimed; beside
them those of the nearest track of each fix. Times are CPU seconds of one thread (the machine may be shared), compilation apart.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.evaluation import find_jumps
from railnav.io.geojson import read_geojson
from railnav.io.run import read_run
from railnav.io.truth import read_truth
from railnav.navigation import Mode, Navigator, Solution, epochs, navigate
from railnav.run import Run
from railnav.survey import build
from railnav.track.model import TrackModel
from railnav.truth import Truth

FloatArray = NDArray[np.float64]


def data_folder() -> Path | None:
    """Where the shared data lie, when they do."""
    folder = Path(os.environ.get("RAILNAV_DATA", Path(__file__).parents[2] / "shared" / "data"))
    return folder if folder.is_dir() else None


def percentiles(seconds: list[float]) -> dict[str, float]:
    """Median, 99th percentile and greatest, microseconds."""
    p50, p99, most = np.percentile(np.array(seconds) * 1e6, [50, 99, 100])
    return {"p50_us": round(float(p50), 1), "p99_us": round(float(p99), 1), "max_us": round(float(most), 1)}


def live(run: Run, model: TrackModel) -> dict[str, Any]:
    """Step through a run as on board; CPU and wall time of each step after the first hundred."""
    assert run.gnss is not None
    navigator = Navigator(
        model,
        imu=run.imu is not None,
        odometer="" if run.odometer is None else "distance",
        lever_arm_b=run.gnss.lever_arm_b,
    )
    cpu: list[float] = []
    wall: list[float] = []
    for epoch in epochs(run):
        begin, start = time.thread_time(), time.perf_counter()
        navigator.step(epoch)
        wall.append(time.perf_counter() - start)
        cpu.append(time.thread_time() - begin)
    return {"steps": len(cpu), "cpu": percentiles(cpu[100:]), "wall": percentiles(wall[100:])}


def against_truth(solution: Solution, truth: Truth, model: TrackModel) -> dict[str, Any]:
    """Errors along the track, right track, NEES and protection level of a solution."""
    k = np.clip(np.searchsorted(truth.time, solution.time + 1e-4) - 1, 0, len(truth.time) - 1)
    point = model.at(truth.track[k], truth.offset[k])
    along = (solution.easting - point.easting) * np.sin(point.grid_bearing)
    along += (solution.northing - point.northing) * np.cos(point.grid_bearing)
    rows = np.isfinite(along) & (np.abs(truth.time[k] - solution.time) < 0.02)
    claimed = rows & np.isin(solution.mode, (Mode.TRACKING, Mode.COASTING))
    right = solution.track == truth.track[k]
    near = np.minimum(truth.offset[k], model.lengths[truth.track[k]] - truth.offset[k]) < 1.0
    gaps = []
    starts = np.flatnonzero(np.diff((solution.mode == Mode.COASTING).astype(int)) == 1)
    for i in starts.tolist():
        end = i + 1 + int(np.argmax(np.append(solution.mode[i + 1 :] != Mode.COASTING, True)))
        gaps.append(
            {"seconds": float(solution.time[end - 1] - solution.time[i]), "error_at_end_m": float(along[end - 1])}
        )
    return {
        "rows": int(rows.sum()),
        "claimed_share": float(claimed.sum() / rows.sum()),
        "along_rms_m": float(np.sqrt(np.mean(along[rows] ** 2))),
        "along_rms_claimed_m": float(np.sqrt(np.mean(along[claimed] ** 2))),
        "along_max_m": float(np.abs(along[rows]).max()),
        "speed_rms_m_s": float(np.sqrt(np.mean((solution.speed - truth.speed[k])[claimed] ** 2))),
        "right_track_claimed": float((right | near)[claimed].mean()),
        "wrong_rows_claimed": int((~(right | near))[claimed].sum()),
        "nees_along": float(np.mean((along / solution.sigma_along)[claimed] ** 2)),
        "beyond_protection_level": float((np.abs(along) > solution.protection_level_along)[rows].mean()),
        "gaps": gaps,
        "jumps": len(find_jumps(solution, model).illegal),
    }


def sample(folder: Path) -> dict[str, Any]:
    """The sample run: accuracy forward and smoothed, time offline and live."""
    model = read_geojson(folder / "network.geojson")
    run, truth = read_run(folder), read_truth(folder / "truth.csv")
    index = np.array([model.track_index(t) for t in truth.track_id])
    truth = replace(truth, track_id=model.track_id, track=index[truth.track])
    found: dict[str, Any] = {}
    for name, smooth in (("forward", False), ("smoothed", True)):
        navigate(run, model, smooth=smooth)
        begin = time.process_time()
        solution = navigate(run, model, smooth=smooth)
        seconds = time.process_time() - begin
        found[name] = {**against_truth(solution, truth, model), "cpu_s": round(seconds, 3)}
        found[name]["rows_per_s"] = round(len(solution) / seconds)
    found["live"] = live(run, model)
    return found


def snapped_jumps(run: Run, model: TrackModel) -> int:
    """Changes of the nearest track from fix to fix."""
    from scipy.spatial import cKDTree

    gnss = run.gnss
    assert gnss is not None
    east, north, _ = model.frame.to_grid(gnss.latitude, gnss.longitude, None)
    track = np.repeat(np.arange(len(model.track_id)), np.diff(model.knot_start))
    distance, knot = cKDTree(np.column_stack([model.easting, model.northing])).query(np.column_stack([east, north]))
    return int((np.diff(track[knot[distance < 50.0]]) != 0).sum())


def real_line(folder: Path, quick: bool) -> dict[str, Any]:
    """line80: throughput, modes, jumps of the navigator and of the nearest track, each run on a model without its train."""
    runs = [read_run(path) for path in sorted(folder.iterdir()) if path.is_dir()]
    trains = sorted({run.id[:10] for run in runs})
    rows = []
    fixes = 0
    seconds = 0.0
    warm = False
    for train in trains[:2] if quick else trains:
        model = build([run for run in runs if "iphone" in run.id and not run.id.startswith(train)])
        for run in (run for run in runs if run.id.startswith(train)):
            assert run.gnss is not None
            if not warm:
                navigate(run, model)
                warm = True
            begin = time.process_time()
            solution = navigate(run, model)
            taken = time.process_time() - begin
            if "mtk" not in run.id:  # the bar is for the 16 runs of u-blox and telephones
                fixes, seconds = fixes + len(run.gnss), seconds + taken
            jumps = find_jumps(solution, model)
            claimed = np.isin(solution.mode, (Mode.TRACKING, Mode.COASTING))
            rows.append(
                {
                    "run": run.id,
                    "fixes": len(run.gnss),
                    "cpu_s": round(taken, 3),
                    "modes": {mode.label: int((solution.mode == mode).sum()) for mode in Mode},
                    "claimed_share": float(claimed.mean()),
                    "on_track_of_direction": float(
                        (solution.track[claimed] == model.track_id.index(run.direction)).mean()
                        if claimed.any()
                        else np.nan
                    ),
                    "sigma_along_median_m": float(np.nanmedian(solution.sigma_along)),
                    "jumps": len(jumps.illegal),
                    "revisions": solution.diagnostics["track_revisions"],
                    "snapped_jumps": snapped_jumps(run, model),
                    "frame_offset_m": solution.diagnostics["frame_offset_m"],
                }
            )
    return {
        "runs": rows,
        "fixes": fixes,
        "cpu_s": round(seconds, 3),
        "fixes_per_s": round(fixes / seconds),
        "jumps": sum(r["jumps"] for r in rows),
        "snapped_jumps": sum(r["snapped_jumps"] for r in rows),
        "receivers": {
            kind: _claims([r for r in rows if r["run"].endswith(kind)]) for kind in ("iphone", "ublox", "mtk")
        },
    }


def _claims(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Share of rows on which a track is declared, and of these the share off the usual track of the train's direction."""
    epochs = np.array([sum(r["modes"].values()) for r in rows], float)
    declared = epochs * np.array([r["claimed_share"] for r in rows])
    off = declared * (1.0 - np.nan_to_num(np.array([r["on_track_of_direction"] for r in rows]), nan=1.0))
    return {
        "declared_share": float(declared.sum() / max(epochs.sum(), 1.0)),
        "off_usual_share": float(off.sum() / max(declared.sum(), 1.0)),
    }


def measure(*, quick: bool = False) -> dict[str, Any]:
    """All figures; empty when the shared data are not here."""
    folder = data_folder()
    if folder is None:
        return {}
    return {
        "command": "python benchmarks/navigate.py --json PATH",
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "sample_run": sample(folder / "sample_run"),
        "line80": real_line(folder / "line80", quick),
    }


def main(arguments: list[str] | None = None) -> int:
    """Print the figures, and write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the figures here")
    parser.add_argument("--quick", action="store_true", help="two trains of the line only")
    options = parser.parse_args(arguments)
    figures = measure(quick=options.quick)
    if not figures:
        print("the shared data are not here; set RAILNAV_DATA", file=sys.stderr)
        return 1
    for name in ("forward", "smoothed"):
        f = figures["sample_run"][name]
        ends = ", ".join(f"{g['error_at_end_m']:+.2f} m after {g['seconds']:.0f} s" for g in f["gaps"])
        print(
            f"sample run, {name}: along RMS {f['along_rms_m']:.3f} m (claimed rows {f['along_rms_claimed_m']:.3f}), "
            f"right track {f['right_track_claimed']:.4f} of {f['claimed_share']:.3f} claimed, NEES {f['nees_along']:.2f}, "
            f"beyond the level {f['beyond_protection_level']:.5f}, jumps {f['jumps']}, gaps: {ends or 'none'}, "
            f"{f['rows_per_s']:,} rows/s"
        )
    step = figures["sample_run"]["live"]
    print(
        f"live step: CPU p50 {step['cpu']['p50_us']:.0f}, p99 {step['cpu']['p99_us']:.0f} us; "
        f"wall p50 {step['wall']['p50_us']:.0f}, p99 {step['wall']['p99_us']:.0f} us (bar: p99 100 us)"
    )
    line = figures["line80"]
    for r in line["runs"]:
        print(
            f"  {r['run']}: {r['fixes']} fixes in {r['cpu_s']:.2f} s, claimed {r['claimed_share']:.2f}, of it on the track of its "
            f"direction {r['on_track_of_direction']:.2f}, jumps {r['jumps']} (nearest track {r['snapped_jumps']}), "
            f"revisions {r['revisions']}"
        )
    for kind, of in line["receivers"].items():
        print(
            f"  {kind}: a track is declared on {of['declared_share']:.1%} of rows, {of['off_usual_share']:.1%} of these off the usual "
            f"track of the direction"
        )
    print(
        f"line80: {line['fixes']:,} fixes in {line['cpu_s']:.2f} s, {line['fixes_per_s']:,} fixes/s (bar: 100,000); jumps "
        f"{line['jumps']} (nearest track {line['snapped_jumps']})"
    )
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
