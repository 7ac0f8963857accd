"""Surveys that are refined: honesty by kind of survey, sequential against batch, slews found, and a real line updated.

    python benchmarks/records.py [--scale 1.0] [--first 9000] [--only PART ...] [--json PATH]

Some six minutes of CPU; `--scale 0.1` runs a tenth of the seeds. Each part says how much CPU time it took.

All but the last two parts is simulated, by the simulator of the survey's tests: three passes over 4 km, GNSS with 17 mm white noise
(and 10 mm correlated over 60 s), gyroscopic angles of 0.2 mrad white, 2 mrad off and wandering 1e-5 rad per root second, odometers
500 ppm off.
"""

# ruff: noqa: E402 - the thread pools read the environment when numpy is imported

from __future__ import annotations

import os

for _pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_pool, "1")

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "survey"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "navigation"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "estimation"))

import test_joint as trains
import test_menus as menus
import test_merging as merging
from survey_simulator import Gyros, Receiver, axis_error, centre_line, drive, knots, plane
from test_survey_topology import diverging

from railnav.estimation import ChainRecords, change_test, merge_chain, solve_chain
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


def plan(runs: list[Any]) -> list[Any]:
    """The runs without heights: what is asked of them here is the plan, and heights cost a quarter of the time."""
    return [replace(run, gnss=replace(run.gnss, height=None)) for run in runs]


def honesty(builds: int, start: int) -> list[dict[str, Any]]:
    """NEES across the track, a number a knot, with the standard error of its mean over the builds, and errors, by kind of survey.

    Errors that are alike over minutes are few in a build of 4 km: one or two that count where angles hold the axis together. The standard
    error says how far a mean over so many builds can be off for that reason alone; kinds with angles get more builds for it.
    """
    rows = []
    for kind, options in KINDS.items():
        nees, square, dark = [], [], []
        for seed in range(start, start + (2 * builds if "correlated GNSS, angles" in kind else builds)):
            rng, frame = np.random.default_rng([seed, 7]), plane()
            axis = centre_line(seed, 4.0, frame=frame)
            model = build(plan(drives(axis, frame, rng, "run", 3, 0, **options)))
            error, sigma = axis_error(model, "up", axis)
            k = slice(20, -20)
            nees.append(np.mean((error[k] / sigma[k]) ** 2))
            square.append(np.mean(error[k] ** 2))
            share = model.offset[knots(model, "up")] / model.offset[knots(model, "up")][-1]
            dark.append(np.abs(error[(share > 0.4) & (share < 0.5)]).max())
        rows.append(
            {
                "kind": kind,
                "runs": len(nees),
                "nees": float(np.mean(nees)),
                "nees_sigma": float(np.std(nees, ddof=1) / np.sqrt(len(nees))),
                "nees_median": float(np.median(nees)),
                "rms_mm": float(1e3 * np.sqrt(np.median(square))),
                "dark_mm": float(1e3 * np.median(dark)),
            }
        )
    return rows


def five_runs(cases: int) -> dict[str, float]:
    """Five runs over one kilometre merged one after the other against all rows at once (the witness: one dense chain of all rows)."""
    worst = spread = 0.0
    for case in range(cases):
        truth, rng = merging.axis()[0], np.random.default_rng([case, 2])
        runs = [merging.survey(truth, truth, rng) for _ in range(5)]
        solution = solve_chain(runs[0])
        for run in runs[1:]:
            solution = solve_chain(merge_chain(ChainRecords.of(solution), run))
        batch = solve_chain(merging.together(runs))
        worst = max(worst, float(np.abs(solution.state - batch.state).max()))
        spread = max(spread, float(np.abs(solution.sigma - batch.sigma).max()))
    return {"cases": cases, "largest_difference_m": worst, "largest_difference_of_sigma_m": spread}


def drifting(surveys: int) -> list[dict[str, float]]:
    """Increments whose errors drift: the menu of three that calls them white, and the menu of six that follows the drift."""
    rows = []
    found: dict[str, list[tuple[float, float]]] = {"n = 3, white": [], "n = 6, drifts": []}
    rng = np.random.default_rng(505)
    for _ in range(surveys):
        survey = menus.Survey(rng, drifting=True, correlated=False)
        white = float(np.hypot(menus.SIGMA_STEP, 2.5e-4))
        found["n = 3, white"].append(menus.judge(survey.solve(drift=False, correlated=False, step_sigma=white)))
        found["n = 6, drifts"].append(menus.judge(survey.solve(drift=True, correlated=False)))
    for name, told in found.items():
        nees, size = np.mean(told, axis=0)
        error = float(np.std([t[0] for t in told], ddof=1) / np.sqrt(surveys))
        rows.append(
            {"menu": name, "surveys": surveys, "nees": float(nees), "nees_sigma": error, "rms_mm": 1e3 * float(size)}
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


def one_by_one(seeds: int) -> list[dict[str, Any]]:
    """A build on three runs, then five updates of one run each, against a build of all eight: NEES and RMS after each."""
    rows = []
    for kind in ("white GNSS", "correlated GNSS", "correlated GNSS, angles"):
        nees: list[list[float]] = []
        square: list[list[float]] = []
        for seed in range(seeds):
            rng, frame = np.random.default_rng([seed, 1977]), plane()
            axis = centre_line(seed, 3.0, frame=frame)
            runs = drives(axis, frame, rng, "run", 8, 0, **KINDS[kind])
            model = build(runs[:3])
            models = [model]
            for run in runs[3:]:
                models.append(update(models[-1], [run]))
            models.append(build(runs))
            told = [axis_error(m, "up", axis) for m in models]
            nees.append([float(np.mean((e / s)[20:-20] ** 2)) for e, s in told])
            square.append([float(np.mean(e[20:-20] ** 2)) for e, _ in told])
        rows.append(
            {
                "kind": kind, "seeds": seeds, "nees": np.mean(nees, axis=0).tolist(),
                "rms_mm": (1e3 * np.sqrt(np.mean(square, axis=0))).tolist(),
            }
        )  # fmt: skip
    return rows


def turnouts(seeds: int) -> dict[str, float]:
    """A single line with a branch, each way driven twice, updated with as many runs; against a build of all of them."""
    ratio, before, after = [], [], []
    for seed in range(seeds):
        rng, frame = np.random.default_rng([seed, 41]), plane()
        axis = centre_line(seed, 2.0, frame=frame)
        branch = axis.shifted(diverging(axis.arc, 0.55 * axis.arc[-1], gap=40.0))
        old, new = (
            [
                r
                for name, a in (("main", axis), ("branch", branch))
                for r in drives(a, frame, rng, f"{name}{day}", 2, day)
            ]
            for day in (0, 10)
        )
        model, batch = build(old), build([*old, *new])
        updated = update(model, new)
        if updated.track_id != batch.track_id:
            continue
        found = difference(batch, updated)
        for i, track in enumerate(found.tracks):
            here = np.flatnonzero(found.track == i)[4:-4]
            rest = (found.slew - found.common_slew)[here]
            ratio.append(float(np.nanmean((rest / (found.sigma_slew[here] / np.sqrt(2.0))) ** 2)))
            if track.startswith("up/"):
                for m, out in ((model, before), (updated, after)):
                    errors = [np.mean(axis_error(m, track, a)[0][30:-30] ** 2) for a in (axis, branch)]
                    out.append(float(min(errors)))
    return {
        "tracks": len(ratio), "ratio": float(np.sqrt(np.median(ratio))),
        "before_mm": 1e3 * float(np.sqrt(np.median(before))), "after_mm": 1e3 * float(np.sqrt(np.median(after))),
    }  # fmt: skip


def longer(seeds: int) -> dict[str, float]:
    """The middle of a line surveyed three times, then three runs over all of it make it longer; against a build of all six."""
    squares: dict[str, list[float]] = {"extended": [], "batch": []}
    nees, length = [], []
    for seed in range(seeds):
        rng, frame = np.random.default_rng([seed, 43]), plane()
        axis = centre_line(seed, 3.0, frame=frame)
        old = drives(axis, frame, rng, "old", 3, 0, begin=0.25, end=0.75)
        new = drives(axis, frame, rng, "new", 3, 10)
        model = update(build(old), new, extend=True)
        for name, m in (("extended", model), ("batch", build([*old, *new]))):
            error, sigma = axis_error(m, "up", axis)
            squares[name].append(float(np.mean(error[20:-20] ** 2)))
            if name == "extended":
                nees.append(float(np.mean((error / sigma)[20:-20] ** 2)))
                length.append(m.length("up") / axis.arc[-1])
    return {
        **{k: 1e3 * float(np.sqrt(np.mean(v))) for k, v in squares.items()},
        "nees": float(np.mean(nees)), "share": float(np.mean(length)), "seeds": seeds,
    }  # fmt: skip


def zones(cases: int) -> list[dict[str, float]]:
    """The specification's case (rail 18): nodes 1 m apart, fixes of 10 mm every 5 m, increments of 0.5 mm, old axis of five runs.

    10 mm over 60 m; RMS on the plateau after merging 1, 2 and 3 new runs: naively, with what the window test flags forgotten, and with
    the stretch known exactly.
    """
    truth, slewed, across = merging.moved_axis()
    sides = np.stack([across, np.broadcast_to([0.0, 0.0, 1.0], across.shape)], axis=1)
    rng = np.random.default_rng(31)
    exact = np.zeros(len(truth), bool)
    exact[480:541] = True
    rows: dict[int, dict[str, list[float]]] = {p: {"naive": [], "flagged": [], "known": []} for p in (1, 2, 3)}
    bound: dict[int, list[float]] = {p: [] for p in rows}
    false = dict.fromkeys(rows, 0)
    for case in range(cases):
        if case % 20 == 0:
            stored = merging.model_of(5, truth, rng)
            old = stored.solve()
        runs = [merging.survey(slewed, truth, rng) for _ in range(3)]
        still = [merging.survey(truth, truth, rng) for _ in range(3)]
        for passes, out in rows.items():
            new = None
            for run in still[:passes]:
                seen = solve_chain(run if new is None else merge_chain(new, run))
                new = ChainRecords.of(seen)
            false[passes] += bool(change_test(old, seen, components=sides).changed.any())
            new = None
            for run in runs[:passes]:
                seen = solve_chain(run if new is None else merge_chain(new, run))
                new = ChainRecords.of(seen)
            test = change_test(old, seen, components=sides)
            if not test.changed.any():
                continue
            for name, kept in (
                ("naive", stored), ("flagged", stored.forgotten(test.nodes())), ("known", stored.forgotten(exact))
            ):  # fmt: skip
                for k, run in enumerate(runs[:passes]):
                    last = name == "known" and k == passes - 1
                    solution = solve_chain(merge_chain(kept, run), covariance=last)
                    kept = ChainRecords.of(solution)
                if solution.covariance is not None:
                    P = np.einsum("ki,kij,kj->k", across, solution.covariance, across)
                    bound[passes].append(float(P[488:533].mean()))
                error = ((solution.state + truth - slewed) * across).sum(axis=1)[488:533]
                out[name].append(float(np.mean(error**2)))
    return [
        {
            "passes": p, "found": len(v["known"]), "cases": cases, "false_alarms": false[p],
            "bound_mm": 1e3 * float(np.sqrt(np.mean(bound[p]))), **{f"{k}_mm": 1e3 * float(np.sqrt(np.mean(e))) for k, e in v.items()},
        }
        for p, v in rows.items()
    ]  # fmt: skip


def service(lines: int) -> list[dict[str, float]]:
    """What a map learns from one train after another (rail 23), its chain stored after each: RMS and NEES, with the NEES' own sigma."""
    square: dict[int, list[float]] = {}
    honest: dict[int, list[float]] = {}
    for line in range(lines):
        delta, chain = trains.map_errors(600 + line), trains.MapChain.stationary(8200.0, sigma=0.5)
        for run in range(6):
            seed = 100_000 + 1000 * (600 + line) + run
            s, _, _, z, dx = trains.ride(delta, seed)
            seen = trains.estimate(chain, seed, s, z, dx)
            chain = seen.chain
            mean, P = chain.marginals()
            nodes = slice(seen.first_node + 2, seen.last_node - 2)
            square.setdefault(run, []).append(float(np.mean((mean[nodes] - delta[nodes]) ** 2)))
            honest.setdefault(run, []).append(trains.nees(mean[nodes] - delta[nodes], P[nodes]))
    return [
        {
            "passes": k + 1, "lines": lines, "rms_mm": 1e3 * float(np.sqrt(np.mean(square[k]))), "nees": float(np.mean(honest[k])),
            "nees_sigma": float(np.std(honest[k], ddof=1) / np.sqrt(lines)),
        }
        for k in square
    ]  # fmt: skip


def suburban() -> list[dict[str, Any]] | None:
    """hev_cinkota: three of the five runs, updated with the other two, against a build of all."""
    folder = _data() / "hev_cinkota"
    if not folder.is_dir():
        return None
    runs = [read_run(d) for d in sorted(folder.iterdir()) if d.is_dir()]
    batch, first = build(runs), build(runs[0::2])
    rows = []
    for name, model in (("three runs", first), ("updated", update(first, runs[1::2]))):
        found = difference(batch, model)
        for i, track in enumerate(found.tracks):
            rest = (found.slew - found.common_slew)[found.track == i]
            sigma = found.sigma_slew[found.track == i] / np.sqrt(2.0)
            rows.append(
                {
                    "model": name, "track": track, "rms_m": float(np.sqrt(np.nanmean(rest**2))),
                    "in_sigmas": float(np.sqrt(np.nanmean((rest / sigma) ** 2))),
                }
            )  # fmt: skip
    return rows


def _data() -> Path:
    return Path(os.environ.get("RAILNAV_DATA", Path(__file__).parents[2] / "shared" / "data"))


def slews(cases: int) -> list[dict[str, Any]]:
    """Slews of 60 m with ramps of 8 m found by an update of three runs, old axis of four; and false alarms without one."""
    rows = []
    for size in (0.010, 0.020, 0.0):
        found = false = 0
        zone, naive, elsewhere, stated = [], [], [], []
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
            for models, out in ((model, naive), (refined, zone)):
                place = models.offset[knots(models, "up")] - middle
                inside = (place > 8) & (place < 52)
                error, sigma = axis_error(models, "up", after)
                out.append(float(np.mean(error[inside] ** 2)))
            still = (np.abs(place - 30) > 100) & (np.abs(place - 30) < 400)
            elsewhere.append(float(np.mean(error[still] ** 2)))
            stated.append(float(np.mean(sigma[inside] ** 2)))
        rows.append(
            {
                "slew_mm": 1e3 * size, "cases": cases, "found": found, "false_alarms": false,
                "zone_rms_mm": 1e3 * float(np.sqrt(np.mean(zone))), "old_axis_rms_mm": 1e3 * float(np.sqrt(np.mean(naive))),
                "unmoved_rms_mm": 1e3 * float(np.sqrt(np.mean(elsewhere))), "zone_stated_mm": 1e3 * float(np.sqrt(np.mean(stated))),
            }
        )  # fmt: skip
    return rows


def real_line() -> dict[str, Any] | None:
    """line80: build on four dates, update with the other four, against a build of all; and how axes repeat."""
    folder = _data() / "line80"
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


def _print_honesty(rows: list[dict[str, Any]]) -> None:
    print("simulated                             builds    NEES  its sigma  median      RMS   worst in 400 m of tunnel")
    for r in rows:
        dark = f"{r['dark_mm']:10.0f} mm" if "tunnel" in r["kind"] else ""
        print(
            f"{r['kind']:38}{r['runs']:6d}{r['nees']:8.2f}{r['nees_sigma']:10.2f}{r['nees_median']:9.2f}{r['rms_mm']:6.1f} mm{dark}"
        )


def _print_five_runs(r: dict[str, float]) -> None:
    print(
        f"simulated: five runs of 1 km merged one by one against all rows at once, {r['cases']:.0f} cases: "
        f"{r['largest_difference_m']:.1e} m at most, sigmas {r['largest_difference_of_sigma_m']:.1e} m (bar 1e-9)"
    )


def _print_drifting(rows: list[dict[str, Any]]) -> None:
    print("simulated: increments that drift by 1e-3 and 1.5e-5 per root metre, fixes every 10 m, a gap of 200 m")
    for r in rows:
        print(
            f"  {r['menu']:14} NEES / 3 {r['nees']:7.2f} (+- {r['nees_sigma']:.2f}), RMS {r['rms_mm']:5.1f} mm ({r['surveys']} surveys)"
        )


def _print_sequential(s: dict[str, float]) -> None:
    print(
        f"simulated: three runs, then three more: RMS {s['first']:.1f} mm, updated {s['updated']:.1f} mm, all six built at once "
        f"{s['batch']:.1f} mm; update and build differ by {s['ratio_median']:.2f} sigma (median of RMS ratios)"
    )


def _print_one_by_one(rows: list[dict[str, Any]]) -> None:
    print("simulated: a build on three runs, then five updates of one run each; and all eight built at once")
    print(
        "                                   NEES after 0, 1, ... updates           at once   RMS, mm: first   last   at once"
    )
    for r in rows:
        nees, rms = r["nees"], r["rms_mm"]
        print(
            f"{r['kind']:26}"
            + "".join(f"{v:7.2f}" for v in nees[:-1])
            + f"{nees[-1]:12.2f}{rms[0]:15.1f}{rms[-2]:7.1f}{rms[-1]:10.1f}"
        )


def _print_turnouts(t: dict[str, float]) -> None:
    print(
        f"simulated: a line with a branch, twice as many runs: RMS {t['before_mm']:.1f} mm, updated {t['after_mm']:.1f} mm; "
        f"update and build of all differ by {t['ratio']:.2f} sigma (median of {t['tracks']} tracks)"
    )


def _print_longer(g: dict[str, float]) -> None:
    print(
        f"simulated: half a line made whole by update --extend: RMS {g['extended']:.1f} mm, NEES {g['nees']:.2f}, "
        f"{100 * g['share']:.1f} % of its length; all runs built at once {g['batch']:.1f} mm ({g['seeds']} lines)"
    )


def _print_service(rows: list[dict[str, float]]) -> None:
    print(f"simulated: a map of 0.5 m learns from trains (positions 1 m), {rows[0]['lines']} lines")
    for r in rows:
        print(
            f"  after {r['passes']:.0f} passes  RMS {r['rms_mm']:4.0f} mm   NEES {r['nees']:.2f} (+- {r['nees_sigma']:.2f})"
        )


def _print_zones(rows: list[dict[str, float]]) -> None:
    print("simulated, the specification's case: 10 mm over 60 m, window test over 1 km; RMS on the plateau, mm (bar 2)")
    print(
        "  new runs      found   false alarms   merged naively   flagged forgotten   stretch known exactly   its covariance says"
    )
    for r in rows:
        print(
            f"  {r['passes']:8d} {r['found']:4d} of {r['cases']:3d} {r['false_alarms']:6d} of {r['cases']:3d}"
            f"{r['naive_mm']:17.2f}{r['flagged_mm']:20.2f}{r['known_mm']:24.2f}{r['bound_mm']:22.2f}"
        )


def _print_slews(rows: list[dict[str, Any]]) -> None:
    print(
        "simulated, with angles and correlated GNSS: slew over 60 m, ramps of 8 m, old axis of four runs, three new ones\n"
        "          found   false alarms   RMS in it, old axis   updated   its stated sigma   where nothing moved"
    )
    for r in rows:
        what = f"{r['slew_mm']:.0f} mm" if r["slew_mm"] else "none"
        print(
            f"{what:>6} {r['found']:4d} of {r['cases']} {r['false_alarms']:11d}"
            f"{r['old_axis_rms_mm']:18.1f} mm{r['zone_rms_mm']:10.1f} mm{r['zone_stated_mm']:13.1f} mm{r['unmoved_rms_mm']:17.1f} mm"
        )


def _print_line(line: dict[str, Any] | None) -> None:
    if line is None:
        print("line80 is not here")
        return
    print(
        f"line80: built on four dates, updated with four more in {line['update_s']:.1f} s; against a build of all eight:"
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


def _print_suburban(lines: list[dict[str, Any]] | None) -> None:
    if lines is None:
        print("hev_cinkota is not here")
        return
    print("hev_cinkota (phones): built on three runs, updated with two more; against a build of all five:")
    for r in lines:
        print(f"  {r['model']:12}{r['track']:20} RMS {r['rms_m']:.2f} m, {r['in_sigmas']:.2f} sigma")


def main() -> None:
    """Print the figures, and write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=float, default=1.0, help="share of the seeds")
    parser.add_argument("--first", type=int, default=9000, help="first seed of the builds judged by kind")
    parser.add_argument("--json", type=Path, metavar="PATH")

    def many(seeds: int) -> int:
        return max(2, round(options.scale * seeds))

    parts: dict[str, tuple[Callable[[], Any], Callable[[Any], None]]] = {
        "honesty": (lambda: honesty(many(80), options.first), _print_honesty),
        "five_runs": (lambda: five_runs(many(10)), _print_five_runs),
        "drifting": (lambda: drifting(many(60)), _print_drifting),
        "sequential": (lambda: sequential(many(12)), _print_sequential),
        "one_by_one": (lambda: one_by_one(many(6)), _print_one_by_one),
        "turnouts": (lambda: turnouts(many(6)), _print_turnouts),
        "longer": (lambda: longer(many(6)), _print_longer),
        "service": (lambda: service(many(20)), _print_service),
        "zones": (lambda: zones(many(200)), _print_zones),
        "slews": (lambda: slews(many(20)), _print_slews),
        "line80": (real_line, _print_line),
        "hev_cinkota": (suburban, _print_suburban),
    }
    parser.add_argument("--only", nargs="+", choices=list(parts), metavar="PART", help=f"of {', '.join(parts)}")
    options = parser.parse_args()
    figures: dict[str, Any] = {}
    for name in options.only or parts:
        measure, tell = parts[name]
        begin = time.process_time()
        figures[name] = measure()
        tell(figures[name])
        print(f"  ({time.process_time() - begin:.0f} s of CPU)\n", flush=True)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
