"""Alignment fitting: simulated curves over seeds, Mannheim's axes against their element table, SBB's main line, 30 km at 1 m.

Run `python benchmarks/alignment.py [--seeds N] [--minutes M]`; real axes are read from ../shared/data and left out where that is absent.
Mannheim's axes are taken in a fixed random order until M minutes of CPU are used; those that earlier figures, and some of the
prices, were looked at with are left to the end and told apart.
Noise is added to sampled designs, so every figure is of simulated measurements of real or made-up designs.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from railnav.errors import RailnavError
from railnav.io.designs import read_designs
from railnav.monitoring.design import Design, design_of_elements
from railnav.monitoring.fitting import axis_of_points, fit_design

FloatArray = NDArray[np.float64]
#: Axes that earlier figures were of: every n-th of all, so many.
LOOKED_AT = 21
DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def noise(rng: np.random.Generator, count: int, sigma: float, length: float = 0.0) -> FloatArray:
    """White noise, or noise correlated exponentially over `length` samples."""
    if not length:
        return rng.normal(0.0, sigma, count)
    keep = np.exp(-1.0 / length)
    drive = rng.normal(0.0, sigma * np.sqrt(1.0 - keep**2), count)
    drive[0] = rng.normal(0.0, sigma)
    return np.asarray(lfilter([1.0], [1.0, -keep], drive))


def curve(seeds: int, *, sigma: float = 0.010, length: float = 0.0, law: str = "clothoid") -> dict[str, Any]:
    """R = 600 m, L = 80 m between straights, points each metre."""
    design = design_of_elements(
        "1", ["straight", law, "arc", law, "straight"], [150.0, 80.0, 250.0, 80.0, 150.0], [0, 600.0, 600.0, 0, 0]
    )
    station = np.arange(0.0, design.length, 1.0)
    here = design.at(station)
    rows, named, other = [], 0, 0
    begin = time.perf_counter()
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        east, north = (v + noise(rng, len(station), sigma, length) for v in (here.easting, here.northing))
        fitted = fit_design(axis_of_points("1", east, north))
        found = fitted.design
        if tuple(k if k in ("straight", "arc") else "t" for k in found.kinds) != (
            "straight",
            "t",
            "arc",
            "t",
            "straight",
        ):
            other += 1
            continue
        named += found.kinds[1] == law
        foot = found.project(here.easting, here.northing, near=station)
        at = design.project(found.plan.easting, found.plan.northing)
        rows.append(
            [
                1.0 / found.plan.curvature_start[2] - 600.0,
                fitted.radius_sigma[2],
                found.plan.length[1] - 80.0,
                fitted.length_sigma[1],
                at.station[1] - 150.0,
                fitted.station_sigma[1],
                np.sqrt(np.mean(foot.cross**2)),
            ]
        )
    table = np.array(rows)
    z = [float(np.sqrt(np.mean((table[:, 2 * k] / table[:, 2 * k + 1]) ** 2))) for k in range(3)]
    covered = [float(np.mean(np.abs(table[:, 2 * k] / table[:, 2 * k + 1]) < 1.96)) for k in range(3)]
    return {
        "seeds": seeds,
        "other_elements": other,
        "law_named": named,
        "radius_rms_m": float(np.sqrt(np.mean(table[:, 0] ** 2))),
        "radius_within_100mm": float(np.mean(np.abs(table[:, 0]) < 0.1)),
        "transition_rms_m": float(np.sqrt(np.mean(table[:, 2] ** 2))),
        "transition_within_400mm": float(np.mean(np.abs(table[:, 2]) < 0.4)),
        "start_rms_m": float(np.sqrt(np.mean(table[:, 4] ** 2))),
        "axis_rms_mm": 1e3 * float(table[:, 6].mean()),
        "axis_worst_mm": 1e3 * float(table[:, 6].max()),
        "error_over_sigma": z,
        "within_95": covered,
        "seconds_each": (time.perf_counter() - begin) / seeds,
    }


def mannheim_designs() -> list[Design]:
    """Axes of the table of Mannheim, each with its stated elements."""
    from railnav.io import axis_table

    table = axis_table.read_table(DATA / "mannheim" / "mannheim_tracks.csv", axis_table._COLUMNS)
    words = table.words["n"]
    designs = []
    for code, track in enumerate(words.word):
        plan, _, _, _ = axis_table._read_track(table, track, np.flatnonzero(words.code == code), [])
        designs.append(Design(track, plan))
    return designs


def as_chain(design: Design) -> Any:
    """A design as elements tied to one another, straights that follow each other as one."""
    from railnav.monitoring.fitting import judgement

    plan, items = design.plan, []
    for j, kind in enumerate(plan.kind.tolist()):
        if kind == 0 and items and items[-1].kind == 0:
            items[-1] = replace(items[-1], length=items[-1].length + float(plan.length[j]))
            continue
        k0, k1 = float(plan.curvature_start[j]), float(plan.curvature_end[j])
        smooth = bool(items) and abs(k0 - items[-1].k1) < 1e-6 and max(kind, items[-1].kind) >= 2
        start = (float(plan.easting[j]), float(plan.northing[j]), float(plan.grid_bearing[j]))
        items.append(judgement.Item(kind, float(plan.length[j]), k0, k1, start, smooth))
    return judgement.chain_of(items)


def told_apart(design: Design, station: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Joints of a design, and which of them points of this noise can show within 2 m.

    A joint can be shown if its station would be known to 0.5 m by whoever knew which elements there are (the least variance that any
    fit can have), and if its change moves the track by over 4 sigmas of the mean of the shorter element beside it: curvature that
    jumps by d moves an element of length L by d L^2 / 8, a rate that jumps by r by r L^3 / 48.
    """
    from railnav.monitoring.fitting.editing import plan_sigmas
    from railnav.monitoring.fitting.plan import fit_plan
    from railnav.monitoring.fitting.segmentation import Noise

    chain = as_chain(design)
    here = design.at(station + design.start)
    exact = fit_plan(chain, station, here.easting, here.northing, Noise(sigma), steps=0)
    known = plan_sigmas(exact)[2][1:] < 0.5
    rate = (chain.k1 - chain.k0) / chain.length
    short = np.minimum(chain.length[:-1], chain.length[1:])
    moved = np.abs(chain.k0[1:] - chain.k1[:-1]) * short**2 / 8.0 + np.abs(np.diff(rate)) * short**3 / 48.0
    return chain.edges[1:-1], np.asarray(known & (moved > 4.0 * sigma / np.sqrt(np.maximum(short, 1.0))))


def joints(design: Design, sigma: float = 0.005, seed: int = 0) -> dict[str, Any] | None:
    """Fit one sampled design and match joints within 2 m."""
    station = np.arange(0.0, design.length, 1.0)
    here = design.at(station + design.start)
    rng = np.random.default_rng(seed)
    east, north = (v + rng.normal(0.0, sigma, len(station)) for v in (here.easting, here.northing))
    begin = time.perf_counter()
    try:
        fitted = fit_design(axis_of_points(design.track, east, north))
    except RailnavError as error:
        return {"track": design.track, "failed": str(error)}
    seconds = time.perf_counter() - begin
    found = fitted.design
    near = found.stations - found.start + design.start
    at = design.project(found.plan.easting, found.plan.northing, near=near[:-1]).station[1:]
    true, visible = told_apart(design, station, sigma)
    true = true + design.start
    used = np.zeros(len(at), bool)
    miss: list[float] = []
    hit = np.zeros(len(true), bool)
    sure = fitted.station_sigma[1:] < 0.5
    for j in range(len(true)):
        gap = np.where(used, np.inf, np.abs(at - true[j])) if len(at) else np.array([np.inf])
        k = int(np.argmin(gap))
        if gap[k] <= 2.0:
            used[k], hit[j] = True, True
            miss.append(float(gap[k]))
    foot = found.project(here.easting, here.northing, near=station + found.start)
    return {
        "track": design.track,
        "length": design.length,
        "true": len(true),
        "visible": int(visible.sum()),
        "found": len(at),
        "hit": int(hit.sum()),
        "hit_visible": int((hit & visible).sum()),
        "sure": int(sure.sum()),
        "sure_hit": int((sure & used).sum()),
        "miss": miss,
        "axis": float(np.sqrt(np.mean(foot.cross**2))),
        "seconds": seconds,
    }


def main_line(design: Design, sigma: float = 0.005, seed: int = 1) -> dict[str, float]:
    """Curvature, cant, gradient and height of a main line recovered from points each metre."""
    station = np.arange(design.start, design.start + design.length, 1.0)
    here = design.at(station)
    rng = np.random.default_rng(seed)
    count = len(station)
    axis = axis_of_points(
        design.track,
        here.easting + rng.normal(0.0, sigma, count),
        here.northing + rng.normal(0.0, sigma, count),
        here.height + rng.normal(0.0, sigma, count) if design.profile is not None else None,
        cant=here.cant + rng.normal(0.0, 5e-4, count) if design.cant is not None else None,
    )
    begin, cpu = time.perf_counter(), time.process_time()
    found = fit_design(axis).design
    seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
    foot = found.project(here.easting, here.northing, near=station - design.start + found.start)
    again = found.at(foot.station)

    def rms(values: FloatArray) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return {
        "length_km": design.length / 1e3,
        "elements": len(design.kinds),
        "found": len(found.kinds),
        "axis_rms_mm": 1e3 * rms(foot.cross),
        "curvature_rms_1_km": 1e3 * rms(again.curvature - here.curvature),
        "height_rms_mm": 1e3 * rms(again.height - here.height),
        "gradient_rms_permille": 1e3 * rms(again.gradient - here.gradient),
        "cant_rms_mm": 1e3 * rms(again.cant - here.cant),
        "seconds": seconds,
        "cpu_seconds": cpu,
    }


def long_line(length: float = 30_000.0) -> Design:
    """A made-up line of that length: an S curve of R 400 to 3000 m each kilometre and a half."""
    rng = np.random.default_rng(7)
    kinds, lengths, radii, total = ["straight"], [300.0], [0.0], 300.0
    side = 1.0
    while total < length:
        radius = float(rng.choice([400.0, 600.0, 800.0, 1200.0, 2000.0, 3000.0])) * side
        transition, arc, straight = (
            float(rng.choice([40.0, 60.0, 80.0, 120.0])),
            float(rng.uniform(150, 500)),
            float(rng.uniform(100, 700)),
        )
        kinds += ["clothoid", "arc", "clothoid", "straight"]
        lengths += [transition, arc, transition, straight]
        radii += [radius, radius, 0.0, 0.0]
        total += 2 * transition + arc + straight
        side = -side
    return design_of_elements("long", kinds, lengths, radii)


def main() -> None:
    """Print every figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--minutes", type=float, default=4.0, help="CPU minutes for Mannheim's axes; 0 for all of them")
    options = parser.parse_args()
    for label, given in (
        ("clothoid, white 10 mm", {}),
        ("clothoid, 10 mm correlated over 10 m", {"length": 10.0}),
        ("Bloss, white 2 mm", {"law": "bloss", "sigma": 0.002}),
    ):
        seeds = options.seeds if not given else max(options.seeds // 4, 2)
        got = curve(seeds, **given)
        print(f"R 600 L 80, {label}: " + ", ".join(f"{k} {_short(v)}" for k, v in got.items()), flush=True)
    line = long_line()
    begin = time.process_time()
    got_line = joints(line, 0.010)
    assert got_line is not None
    cpu = time.process_time() - begin
    print(f"{line.length / 1e3:.1f} km at 1 m, {cpu:.1f} CPU s: {_short(got_line)}", flush=True)
    if not DATA.is_dir():
        print("real axes: left out, no ../shared/data")
        return
    for name in ("zuerich-winterthur.landxml.xml",):
        designs = read_designs(DATA / "sbb" / name, crs="EPSG:2056")
        for design in sorted(designs, key=lambda d: -d.length)[:2]:
            print(f"SBB {design.track}, 5 mm: {_short(main_line(design))}", flush=True)
    designs = sorted(mannheim_designs(), key=lambda d: d.track)
    designs = [design for design in designs if design.length >= 60.0]
    looked_at = designs[:: max(len(designs) // LOOKED_AT, 1)][:LOOKED_AT]
    rest = [design for design in designs if design not in looked_at]
    order = [rest[k] for k in np.random.default_rng(0).permutation(len(rest)).tolist()] + looked_at
    begin, done = time.process_time(), 0
    rows: dict[bool, list[dict[str, Any]]] = {False: [], True: []}
    failed = []
    for design in order:
        if options.minutes and time.process_time() - begin > 60.0 * options.minutes:
            break
        done += 1
        row = joints(design)
        if row is None or "failed" in row:
            failed.append(row)
            continue
        rows[done > len(rest)].append(row)
        if sys.stderr.isatty():
            print(f"\r{done}/{len(order)}", end="", file=sys.stderr)
    print(f"Mannheim: {done} of {len(order)} axes in {time.process_time() - begin:.0f} CPU s; failed {len(failed)}")
    for seen, label in ((False, "never looked at"), (True, "looked at before")):
        if rows[seen]:
            print(f"  {label}: {summary(rows[seen])}")
    for row in sorted(rows[False] + rows[True], key=lambda row: -row["axis"])[:3]:
        print(f"  worst axis: {_short(row)}")
    for row in failed[:5]:
        print(f"  {row}")


def summary(rows: list[dict[str, Any]]) -> str:
    """Say what fits of several axes found."""
    total: dict[str, Any] = {
        key: sum(row[key] for row in rows)
        for key in ("length", "true", "visible", "found", "hit", "hit_visible", "sure", "sure_hit", "seconds")
    }
    miss = np.array([m for row in rows for m in row["miss"]])
    true, seen, found, hit, hit_seen = (total[key] for key in ("true", "visible", "found", "hit", "hit_visible"))
    axis = np.array([row["axis"] for row in rows])
    return (
        f"{len(rows)} axes, {total['length'] / 1e3:.1f} km, 5 mm at 1 m: joints {true}, of them {seen} that such points can "
        f"show; found {found}; within 2 m: {hit}; recall {hit / true:.3f} ({hit_seen / seen:.3f} of those to be seen), precision "
        f"{hit / found:.3f} "
        f"({total['sure_hit'] / total['sure']:.3f} of the {total['sure']} whose station it knows to 0.5 m); stations "
        f"rms {np.sqrt(np.mean(miss**2)):.2f} m, median {np.median(miss):.2f} m; axis rms "
        f"{1e3 * np.sqrt(np.mean(axis**2)):.2f} mm, median {1e3 * np.median(axis):.2f} mm"
    )


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{k} {_short(v)}" for k, v in value.items() if k != "miss")
    if isinstance(value, list):
        return "[" + ", ".join(_short(v) for v in value) + "]"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
