"""Surveys that are refined: honesty by kind of survey, sequential against batch, slews found, and a real line updated.

    python benchmarks/records.py [--seeds 60] [--first 5000] [--slews 40] [--json PATH]

All but the last part is simulated, by the simulator of the survey's tests: three passes over 4 km, GNSS with 17 mm white noise (and 10 mm
correlated over 60 s), gyroscopic angles of 0.2 mrad white, 2 mrad off and wandering 1e-5 rad per root second, odometers 500 ppm off.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "survey"))

from survey_simulator import Gyros, Receiver, axis_error, centre_line, drive, knots, plane

from railnav.io.run import read_run
from railnav.survey import build, difference, update

KINDS: dict[str, dict[str, Any]] = {
    "white GNSS": {"receiver": Receiver("survey", correlated=0.0)},
    "correlated GNSS": {},
    "white GNSS, angles": {"receiver": Receiver("survey", correlated=0.0), "gyros": Gyros()},
    "correlated GNSS, angles": {"gyros": Gyros()},
    "correlated GNSS, angles, tunnel": {"gyros": Gyros(), "tunnels": ((0.4, 0.5),)},
    "correlated GNSS, tunnel, no angles": {"tunnels": ((0.4, 0.5),)},
}


def drives(axis: Any, frame: Any, rng: Any, name: str, many: int, first: int, **options: Any) -> list[Any]:
    return [
        drive(axis, frame, rng, run_id=f"{name}-{p}", direction="up", day=first + p, **options) for p in range(many)
    ]


def honesty(seeds: int, start: int) -> list[dict[str, Any]]:
    """NEES across the track, a number a knot, with the standard error of its mean over the builds, and errors, by kind of survey.

    Errors that are alike over minutes are few in a build of 4 km: one or two that count where angles hold the axis together. The standard
    error says how far a mean over so many builds can be off for that reason alone.
    """
    rows = []
    for kind, options in KINDS.items():
        nees, square, dark = [], [], []
        for seed in range(start, start + seeds):
            rng, frame = np.random.default_rng([seed, 7]), plane()
            axis = centre_line(seed, 4.0, frame=frame)
            model = build(drives(axis, frame, rng, "run", 3, 0, **options))
            error, sigma = axis_error(model, "up", axis)
            k = slice(20, -20)
            nees.append(np.mean((error[k] / sigma[k]) ** 2))
            square.append(np.mean(error[k] ** 2))
            share = model.offset[knots(model, "up")] / model.offset[knots(model, "up")][-1]
            dark.append(np.abs(error[(share > 0.4) & (share < 0.5)]).max())
        rows.append(
            {
                "kind": kind,
                "runs": seeds,
                "nees": float(np.mean(nees)),
                "nees_sigma": float(np.std(nees) / np.sqrt(len(nees))),
                "nees_median": float(np.median(nees)),
                "rms_mm": float(1e3 * np.sqrt(np.median(square))),
                "dark_mm": float(1e3 * np.median(dark)),
            }
        )
    return rows


def sequential(seeds: int) -> dict[str, float]:
    """Build on three runs and update with three against a build of all six; in terms of the latter's sigma."""
    ratio, errors = [], {"first": [], "updated": [], "batch": []}
    for seed in range(seeds):
        rng, frame = np.random.default_rng([seed, 3]), plane()
        axis = centre_line(seed, 3.0, frame=frame)
        old, new = drives(axis, frame, rng, "old", 3, 0), drives(axis, frame, rng, "new", 3, 10)
        first, batch = build(old), build([*old, *new])
        updated = update(first, new)
        found = difference(batch, updated)
        k = slice(20, -20)
        ratio.append(float(np.sqrt(np.nanmean((found.slew[k] / (found.sigma_slew[k] / np.sqrt(2.0))) ** 2))))
        for name, model in (("first", first), ("updated", updated), ("batch", batch)):
            errors[name].append(float(np.mean(axis_error(model, "up", axis)[0] ** 2)))
    return {"ratio_median": float(np.median(ratio)), **{k: float(1e3 * np.sqrt(np.mean(v))) for k, v in errors.items()}}


def slews(cases: int) -> list[dict[str, Any]]:
    """Slews of 60 m with ramps of 8 m found by an update of three runs, old axis of four; and false alarms without one."""
    rows = []
    for size in (0.010, 0.020, 0.0):
        found = false = 0
        zone, naive = [], []
        for seed in range(cases):
            rng, frame = np.random.default_rng([seed, 11]), plane()
            axis = centre_line(seed % 20, 2.0, frame=frame)
            model = build(drives(axis, frame, rng, "old", 4, 0, gyros=Gyros()))
            middle = 0.5 * axis.arc[-1]
            w = np.interp(axis.arc, [middle, middle + 8, middle + 52, middle + 60], [0.0, 1.0, 1.0, 0.0])
            after = axis.shifted(size * (0.5 - 0.5 * np.cos(np.pi * w)))
            refined = update(model, drives(after, frame, rng, "new", 3, 20, gyros=Gyros()))
            changes = refined.provenance["updates"][-1]["tracks"][0]["changes"]
            hit = [
                c
                for c in changes
                if c["coordinate"] == "across" and c["from_m"] < middle + 80 and c["to_m"] > middle - 20
            ]
            found += bool(hit) and size > 0
            false += len(changes) > (len(hit) if size else 0)
            for models, out in ((refined, zone), (model, naive)):
                k = knots(models, "up")
                inside = (models.offset[k] > middle + 8) & (models.offset[k] < middle + 52)
                out.append(float(np.mean(axis_error(models, "up", after)[0][inside] ** 2)))
        rows.append(
            {
                "slew_mm": 1e3 * size, "cases": cases, "found": found, "false_alarms": false,
                "zone_rms_mm": 1e3 * float(np.sqrt(np.mean(zone))), "old_axis_rms_mm": 1e3 * float(np.sqrt(np.mean(naive))),
            }
        )  # fmt: skip
    return rows


def real_line() -> dict[str, Any] | None:
    """line80: build on four dates, update with the other four, against a build of all; and how axes repeat."""
    folder = Path(os.environ.get("RAILNAV_DATA", Path(__file__).parents[2] / "shared" / "data")) / "line80"
    if not folder.is_dir():
        return None
    runs = [read_run(d) for d in sorted(folder.iterdir()) if d.name.endswith(("_ublox", "_iphone"))]
    dates = sorted({r.id[:10] for r in runs})
    first = build([r for r in runs if r.id[:10] in dates[:4]])
    begin = time.perf_counter()
    updated = update(first, [r for r in runs if r.id[:10] in dates[4:]])
    seconds = time.perf_counter() - begin
    batch = build(runs)
    out: dict[str, Any] = {
        "update_s": seconds,
        "tracks": [],
        "repeatability": batch.provenance["build"]["repeatability"],
    }
    for name, model in (("four dates", first), ("updated", updated)):
        found = difference(batch, model)
        for i, track in enumerate(found.tracks):
            rest = (found.slew - found.common_slew)[found.track == i][60:-160]
            sigma = found.sigma_slew[found.track == i][60:-160] / np.sqrt(2.0)
            out["tracks"].append(
                {
                    "model": name, "track": track, "rms_m": float(np.sqrt(np.nanmean(rest**2))),
                    "median_m": float(np.nanmedian(np.abs(rest))), "in_sigmas": float(np.sqrt(np.nanmean((rest / sigma) ** 2))),
                }
            )  # fmt: skip
    return out


def main() -> None:
    """Print the figures, and write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=60)
    parser.add_argument("--first", type=int, default=5000, help="first seed of the builds")
    parser.add_argument("--slews", type=int, default=40)
    parser.add_argument("--json", type=Path, metavar="PATH")
    options = parser.parse_args()
    figures: dict[str, Any] = {"honesty": honesty(options.seeds, options.first)}
    print("simulated                             builds    NEES  its sigma  median      RMS   worst in 400 m of tunnel")
    for r in figures["honesty"]:
        dark = f"{r['dark_mm']:10.0f} mm" if "tunnel" in r["kind"] else ""
        print(
            f"{r['kind']:38}{r['runs']:6d}{r['nees']:8.2f}{r['nees_sigma']:10.2f}{r['nees_median']:9.2f}{r['rms_mm']:6.1f} mm{dark}"
        )
    figures["sequential"] = s = sequential(max(options.seeds // 3, 4))
    print(
        f"\nsimulated: three runs, then three more: RMS {s['first']:.1f} mm, updated {s['updated']:.1f} mm, all six built at once "
        f"{s['batch']:.1f} mm; update and build differ by {s['ratio_median']:.2f} sigma (median of RMS ratios)"
    )
    figures["slews"] = slews(options.slews)
    print(
        "\nsimulated, with angles: slew over 60 m, ramps of 8 m     found   false alarms   RMS in it, old axis   updated"
    )
    for r in figures["slews"]:
        what = f"{r['slew_mm']:.0f} mm" if r["slew_mm"] else "none"
        print(
            f"{what:>52} {r['found']:6d} of {r['cases']} {r['false_alarms']:10d}"
            f"{r['old_axis_rms_mm']:15.1f} mm{r['zone_rms_mm']:9.1f} mm"
        )
    figures["line80"] = line = real_line()
    if line is not None:
        print(
            f"\nline80: built on four dates, updated with four more in {line['update_s']:.1f} s; against a build of all eight:"
        )
        for r in line["tracks"]:
            print(
                f"  {r['model']:12}{r['track']:20} RMS {r['rms_m']:.2f} m, median {r['median_m']:.2f} m, {r['in_sigmas']:.2f} sigma"
            )
        for r in line["repeatability"]:
            print(
                f"  axes of single runs of different dates, {r['receiver']}: {r['rms_m']:.2f} m RMS, median {r['median_m']:.2f} m, "
                f"95 % {r['q95_m']:.2f} m ({r['pairs']} pairs)"
            )
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
