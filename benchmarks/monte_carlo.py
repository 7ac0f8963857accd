"""What the navigator promises, by seeded Monte Carlo on the bundled line; everything here is simulated.

    python benchmarks/monte_carlo.py [--only CASE ...] [--scale 1.0] [--json PATH]

Cases: open-sky, outage, turnouts, parallel, after-turnout, level, odometry. `--scale 0.1` runs a tenth of the seeds.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import railnav as rn
from railnav.evaluation import compare, evaluate, pooled
from railnav.evaluation.reliability import binomial_bounds, pooled_reliability, reliability
from railnav.navigation import Settings
from railnav.simulation import SERVICE, Driving, GnssSensor, Leg, OdometerSensor, Outfit, demo_line, simulate
from railnav.track.model import NodeKind, TrackModel

#: 1.5 m white, 0.1 m/s: the receiver of the specification's open-sky runs (rail.md 19.5).
WHITE = GnssSensor(
    white_horizontal=1.5, white_vertical=3.0, coloured_horizontal=0.0, coloured_vertical=0.0, speed_sigma=0.1
)
#: 1.5 m in all, most of it coloured over a minute: what receivers do.
COLOURED = GnssSensor()


def rms(values: list[float] | np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def share(count: int, of: float) -> str:
    """A share with its 95 % binomial bounds."""
    low, high = binomial_bounds(count, of)
    return f"{count} of {of:,.0f} ({count / max(of, 1):.3%}; 95 %: {low:.3%} to {high:.3%})"


def verdict(held: bool, why: str = "") -> str:
    """Whether a bar holds, and why not where that is known."""
    return "holds" if held else "DOES NOT HOLD" + (f": {why}" if why else "")


def as_assumed(run: rn.Run, seed: int, sigma: float) -> rn.Run:
    """The run of a receiver whose constant errors are drawn from what an untold navigator assumes: frame offset and stamps."""
    assert run.gnss is not None
    generator, usual = np.random.default_rng([seed, 77]), Settings()
    east, north = generator.standard_normal(2) * usual.gnss_frame_share * sigma
    gnss = run.gnss
    return replace(
        run,
        gnss=replace(
            gnss,
            time=gnss.time + generator.standard_normal() * usual.time_tag_sigma,
            latitude=gnss.latitude + north / 6.371e6,
            longitude=gnss.longitude + east / (6.371e6 * np.cos(gnss.latitude)),
        ),
    )


def open_sky(line: TrackModel, scale: float) -> dict[str, Any]:
    """GNSS 1.5 m, odometer, IMU; seven kilometres with curves; the run declares its sensors' errors, or does not."""
    found: dict[str, Any] = {}
    careful = "it allows for stamps, a frame and a latency that this receiver does not have"
    for name, gnss, told, drawn, cause in (
        ("white, declared", WHITE, True, False, ""),
        (
            "coloured, declared",
            COLOURED,
            True,
            False,
            "most of the error is correlated over a minute",
        ),
        ("white, not declared", WHITE, False, False, "it takes white fixes for correlated ones"),
        ("coloured, not declared", COLOURED, False, False, "most of the error is correlated over a minute"),
        (
            "coloured, not declared, frame and stamps as assumed",
            COLOURED,
            False,
            True,
            "the receiver's frame and stamps are off",
        ),
    ):
        parts, along, speed, squares, stated, over, epochs = [], [], [], [], [], 0, 0
        for seed in range(40_000, 40_000 + max(3, int(60 * scale))):
            outfit = replace(SERVICE, gnss=gnss, odometer=OdometerSensor())
            leg = Leg(("77R-03",), start=200.0, finish=9500.0)
            run, truth = simulate(line, leg, seed=seed, outfit=outfit, tunnels=False, declare=told)
            e = evaluate(rn.navigate(as_assumed(run, seed, gnss.sigma_horizontal) if drawn else run, line), truth)
            late = (e.time > 60.0) & np.isfinite(e.along)
            parts.append(e.consistency)
            along.append(rms(e.along[late]))
            speed.append(rms(e.speed[late]))
            stated.append(rms(e.sigma_along[late]))
            squares.append(float(np.mean((e.along[late] / e.sigma_along[late]) ** 2)))
            over, epochs = (
                over + int((np.abs(e.along[late]) > e.protection_level[late]).sum()),
                epochs + int(late.sum()),
            )
        c, nees = pooled(parts), float(np.mean(squares))
        spread = float(np.std(squares) / np.sqrt(len(squares)))
        fits, honest = rms(along) <= 0.25 and rms(speed) <= 0.02, 0.9 <= nees <= 1.1
        print(
            f"open sky, GNSS 1.5 m {name} + odometer + IMU, {len(parts)} runs: along {rms(along):.3f} m RMS (bar 0.25; stated sigma "
            f"{rms(stated):.3f}), speed "
            f"{rms(speed):.4f} m/s (bar 0.02): {verdict(fits, cause if rms(speed) <= 0.02 else 'speed')}; NEES after the first minute "
            f"{nees:.2f} +- {spread:.2f} (bar 0.9 to 1.1): "
            f"{verdict(honest, 'within two deviations of it' if abs(nees - np.clip(nees, 0.9, 1.1)) < 2 * spread else careful)}; all rows "
            f"{c.nees:.2f} (honest between {c.lower:.2f} and {c.upper:.2f}); {over} of {epochs:,} rows beyond the protection level at 1e-4"
        )
        found[name] = {
            "along_rms_m": rms(along),
            "speed_rms_m_s": rms(speed),
            "sigma_m": rms(stated),
            "nees": nees,
            "nees_sigma": spread,
            "beyond": over,
            "runs": len(parts),
        }
    return found


def outage(line: TrackModel, scale: float) -> dict[str, Any]:
    """Without GNSS for 120 s and 300 s at line speed."""
    found: dict[str, Any] = {}
    for name, outfit in (("odometer + IMU", SERVICE), ("IMU alone", replace(SERVICE, odometer=None))):
        for length, bar in ((120.0, {"odometer + IMU": 0.5, "IMU alone": 5.0}[name]), (300.0, None)):
            errors, sigmas, wrong = [], [], 0
            for seed in range(max(4, int(40 * scale))):
                run, truth = simulate(
                    line,
                    _long_leg(line),
                    seed=seed,
                    outfit=outfit,
                    tunnels=False,
                    outages=[(150.0, 150.0 + length)],
                )
                solution = rn.navigate(run, line)
                e = evaluate(solution, truth)
                inside = np.flatnonzero((e.time > 150.0) & (e.time <= 149.9 + length))
                if not len(inside):
                    wrong += 1
                    continue
                errors.append(float(e.along[inside[-1]]))
                sigmas.append(float(e.sigma_along[inside[-1]]))
            bar_words = f"bar {bar:g}: {verdict(rms(errors) <= bar)}" if bar else "shown"
            print(
                f"{length:.0f} s without GNSS, {name}: {rms(errors):.2f} m RMS at its end ({bar_words}), worst "
                f"{np.abs(errors).max():.1f} m, stated sigma {rms(sigmas):.2f} m, {len(errors)} runs"
                + (f", {wrong} without a position" if wrong else "")
            )
            found[f"{name}, {length:.0f} s"] = {"rms_m": rms(errors), "sigma_m": rms(sigmas), "runs": len(errors)}
    return found


def _long_leg(line: TrackModel) -> Leg:
    """From the start of the right main track to the station and on: some 20 km through curves."""
    route = line.routes("77R-01", "77R-13")[0]
    return Leg(route.tracks, start=60.0)


def passages(line: TrackModel) -> list[tuple[tuple[str, str], float]]:
    """Each facing passage of a turnout with both ways on: (track before, track after), direction of the first track."""
    found = []
    ends: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for a, end_a, b, end_b in line.movements.tolist():
        ends.setdefault((a, end_a), []).append((b, end_b))
        ends.setdefault((b, end_b), []).append((a, end_a))
    for (a, end), others in ends.items():
        node = (line.end_node if end else line.start_node)[a]
        if len(others) > 1 and line.nodes.kind[node] == NodeKind.TURNOUT:
            found += [((line.track_id[a], line.track_id[b]), 1.0 if end else -1.0) for b, _ in others]
    return found


def turnouts(line: TrackModel, scale: float) -> dict[str, Any]:
    """Facing turnouts: which leg, and how far past the toe it is known."""
    all_ways = passages(line)
    wrong, undecided, distances, count = 0, 0, [], max(len(all_ways), int(2000 * scale))
    wrong_names: dict[str, int] = {}
    for k in range(count):
        (before, after), direction = all_ways[k % len(all_ways)]
        leg = _approach(line, before, after, direction)
        run, truth = simulate(line, leg, seed=10_000 + k, outfit=SERVICE, driving=Driving(speed=22.0), tunnels=False)
        solution = rn.navigate(run, line)
        e = compare(solution, truth)
        toe = _way_at_toe(truth, line, after)
        if toe is None:
            continue
        past = e.way > toe
        sure = past & (solution.mode[e.row] == rn.Mode.TRACKING)
        on_leg = np.array([line.track_id[t] == after for t in solution.track[e.row]])
        true_leg = np.array([truth.track_id[t] == after for t in e.true_track])
        bad = sure & true_leg & ~e.right
        if bad.any():
            wrong += 1
            wrong_names[f"{before}>{after}"] = wrong_names.get(f"{before}>{after}", 0) + 1
        decided = np.flatnonzero(sure & on_leg & true_leg)
        if len(decided):
            distances.append(float(e.way[decided[0]] - toe))
        else:
            undecided += 1
    d = np.array(distances)
    print(
        f"facing turnouts, coloured GNSS + gyro + odometer, {count:,} passages of {len(all_ways)} ways: wrong {share(wrong, count)} "
        f"(bar 0.1 %: {verdict(wrong <= 0.001 * count)}), decided {np.median(d):.1f} m past the toe in the median (bar 5 m: "
        f"{verdict(float(np.median(d)) <= 5.0)}), 95 % within {np.quantile(d, 0.95):.1f} m, "
        f"{undecided} not decided on the leg"
    )
    if wrong_names:
        print("  wrong at", ", ".join(f"{n} ({c})" for n, c in sorted(wrong_names.items(), key=lambda x: -x[1])[:6]))
    return {"passages": count, "wrong": wrong, "median_m": float(np.median(d)), "undecided": undecided}


def _approach(line: TrackModel, before: str, after: str, direction: float) -> Leg:
    """At least 900 m up to a turnout, through tracks before it where needed, and over the leg to its far end or 400 m."""
    tracks, way = [before, after], line.length(before)
    while way < 900.0:
        first = line.track_index(tracks[0])
        gone = {line.track_index(t) for t in tracks}
        came = _onward(line, first, _first_end(line, tracks, direction))
        came = [c for c in came if c not in gone]
        if not came:
            break
        tracks.insert(0, line.track_id[max(came, key=lambda c: line.lengths[c])])
        way += line.length(tracks[0])
    from railnav.simulation.journey import directions

    ways = directions(line, tracks)
    length = line.length(tracks[0])
    start = (max(20.0, length - 1500.0) if ways[0] > 0 else min(length - 20.0, 1500.0)) if way > 1500.0 else None
    last = line.length(after)
    finish = (min(last - 5.0, 400.0) if ways[-1] > 0 else max(5.0, last - 400.0)) if len(tracks) > 1 else None
    return Leg(tuple(tracks), start=start, finish=finish, dwell=5.0)


def _first_end(line: TrackModel, tracks: list[str], direction: float) -> int:
    from railnav.simulation.journey import directions

    ways = directions(line, tracks) if len(tracks) > 1 else (int(direction),)
    return 0 if ways[0] > 0 else 1


def _onward(line: TrackModel, track: int, end: int) -> list[int]:
    """Tracks that a permitted movement joins to one end of a track."""
    found = []
    for a, end_a, b, end_b in line.movements.tolist():
        if (a, end_a) == (track, end):
            found.append(b)
        if (b, end_b) == (track, end):
            found.append(a)
    return found


def _way_at_toe(truth: rn.Truth, line: TrackModel, after: str) -> float | None:
    """Coordinate along the way where the train first enters the leg."""
    from railnav.evaluation.comparison import visits_of

    visits = visits_of(truth)
    leg = line.track_index(after)
    for v in range(len(visits.track)):
        if truth.track_id[visits.track[v]] == line.track_id[leg]:
            offset = 0.0 if visits.sense[v] > 0 else line.length(after)
            return float(visits.origin[v] + visits.sense[v] * offset)
    return None


def parallel(line: TrackModel, scale: float) -> dict[str, Any]:
    """Parallel tracks 4 m apart, no turnout seen."""
    parts, decided, sure_rows, wrong_rows, wrong_runs, count = [], [], 0, 0, 0, max(6, int(300 * scale))
    for seed in range(count):
        track = ("77R-03", "77L-03")[seed % 2]
        run, _ = simulate(
            line, Leg((track,), start=300.0, finish=6300.0), seed=500 + seed, outfit=SERVICE, tunnels=False
        )
        solution = rn.navigate(run, line)
        hit = solution.track == line.track_index(track)
        sure = solution.mode == rn.Mode.TRACKING
        sure_rows, wrong_rows = sure_rows + int(sure.sum()), wrong_rows + int((sure & ~hit).sum())
        wrong_runs += bool((sure & ~hit).any())
        decided.append(float(solution.time[np.argmax(sure)]) if sure.any() else np.inf)
        placed = solution.track >= 0
        parts.append(reliability(solution.track_probability[placed], hit[placed]))
    together = pooled_reliability(parts)
    q50, q90 = np.quantile(decided, [0.5, 0.9])
    print(
        f"parallel tracks 4 m apart, coloured 1.5 m GNSS, no turnout: ever sure of the wrong one in {share(wrong_runs, count)} of runs, "
        f"{wrong_rows / max(sure_rows, 1):.3%} of sure epochs (bar 0.2 %: "
        f"{verdict(wrong_rows <= 0.002 * max(sure_rows, 1))}); decided after {q50:.0f} s (median), {q90:.0f} s (90 %)"
    )
    print("  stated probability   epochs  independent   stated    right   95 % bounds")
    for c in together.classes:
        print(
            f"  {c.low:8.3f} to {c.high:5.3f} {c.rows:9d} {c.effective:12.0f} {c.stated:8.4f} {c.right:8.4f}   "
            f"{c.lower:.4f} to {c.upper:.4f}"
        )
    print(f"  honest in every class: {'yes' if together.honest else 'NO'}")
    return {"runs": count, "wrong_runs": wrong_runs, "median_s": q50, "honest": together.honest}


def after_turnout(line: TrackModel, scale: float) -> dict[str, Any]:
    """On one of the parallel tracks, over a crossover onto the other, and on for three kilometres, the IMU looking on."""
    right, sure_rows, rows, wrong_sure, count = 0, 0, 0, 0, max(6, int(200 * scale))
    pairs = (("77R-01", "77L-03"), ("77L-01", "77R-03"))
    routes = [route for pair in pairs for route in line.routes(*pair)[:1]]
    for seed in range(count):
        route = routes[seed % len(routes)]
        run, truth = simulate(
            line, Leg(route.tracks, start=60.0, finish=3000.0), seed=900 + seed, outfit=SERVICE, tunnels=False
        )
        solution = rn.navigate(run, line)
        c = compare(solution, truth)
        last = np.array([truth.track_id[t] == route.tracks[-1] for t in c.true_track]) & np.isfinite(c.along)
        last &= c.way > c.way[np.argmax(last)] + 20.0
        sure = last & (solution.mode[c.row] == rn.Mode.TRACKING)
        rows, right, sure_rows = (
            rows + int(last.sum()),
            right + int((last & c.right).sum()),
            sure_rows + int(sure.sum()),
        )
        wrong_sure += bool((sure & ~c.right).any())
    print(
        f"parallel tracks after a crossover run through with IMU: right {right / rows:.3%} of epochs (bar 99.9 %: "
        f"{verdict(right >= 0.999 * rows)}), "
        f"declared {sure_rows / rows:.1%}, ever sure of the wrong one in {share(wrong_sure, count)} of runs"
    )
    return {"right": right / rows, "declared": sure_rows / rows, "runs": count}


def level(line: TrackModel, scale: float) -> dict[str, Any]:
    """How often the protection level fails, at two risks; epochs 100 s apart, so that they are nearly independent."""
    found = {}
    gnss = replace(COLOURED, interval=1.0)
    outfit = Outfit("level", gnss=gnss, odometer=OdometerSensor(interval=1.0))
    runs = max(5, int(400 * scale))
    recorded = [
        simulate(line, _long_leg(line), seed=3000 + s, outfit=outfit, driving=Driving(speed=22.0), tunnels=False)
        for s in range(runs)
    ]
    for risk in (1e-2, 1e-3, 1e-5):
        over, epochs = 0, 0
        for run, truth in recorded:
            e = evaluate(rn.navigate(run, line, integrity_risk=risk), truth)
            take = np.searchsorted(e.time, np.arange(60.0, e.time[-1], 100.0))
            known = take[np.isfinite(e.protection_level[take])]
            over += int((np.abs(e.along[known]) > e.protection_level[known]).sum())
            epochs += len(known)
        held = verdict(binomial_bounds(over, epochs)[0] <= risk)
        print(
            f"protection level at {risk:g}: exceeded {share(over, epochs)} epochs 100 s apart, not quite independent (bar: no more than "
            f"promised, within the interval: {held}; independent ones: benchmarks/protection_level.py)"
        )
        found[f"{risk:g}"] = {"exceeded": over, "epochs": epochs}
    return found


def odometry(line: TrackModel, scale: float) -> dict[str, Any]:
    """GNSS lost after two minutes; then a wheel that slips and slides, alone."""
    count, outside, at_end = max(10, int(1000 * scale)), 0, []
    for seed in range(count):
        outfit = Outfit(
            "wheel",
            gnss=COLOURED,
            odometer=OdometerSensor(interval=0.2, slip_rate=30.0, slip_size=0.15, slip_duration=5.0),
        )
        run, truth = simulate(
            line,
            Leg(("77R-03",), start=200.0, finish=8000.0),
            seed=52_000 + seed,
            outfit=outfit,
            tunnels=False,
            outages=[(120.0, 1e5)],
        )
        e = evaluate(rn.navigate(run, line), truth)
        since = e.time > 120.0
        if not since.any():
            outside += 1
            continue
        gone = np.abs(e.way - e.way[np.argmax(since)])[since]
        error = np.abs(e.along[since])
        outside += bool((error > 5.0 + 0.05 * gone).any())
        at_end.append(float(error[-1]))
    print(
        f"odometry alone with slip and slide, 7 km: outside 5 m + 5 % of the way in {share(outside, count)} runs (bar 0: "
        f"{verdict(outside == 0)}); "
        f"error at the end "
        f"{rms(at_end):.1f} m RMS, worst {np.max(at_end):.1f} m"
    )
    return {"runs": count, "outside": outside, "end_rms_m": rms(at_end)}


CASES: dict[str, Callable[[TrackModel, float], dict[str, Any]]] = {
    "open-sky": open_sky,
    "outage": outage,
    "turnouts": turnouts,
    "parallel": parallel,
    "after-turnout": after_turnout,
    "level": level,
    "odometry": odometry,
}


def main() -> None:
    """Run the cases asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--json", type=Path, metavar="PATH")
    options = parser.parse_args()
    line, figures = demo_line(), {}
    for name in options.only:
        begun = time.perf_counter()
        figures[name] = CASES[name](line, options.scale)
        print(f"  [{name}: {time.perf_counter() - begun:.0f} s]", flush=True)
    if options.json:
        options.json.write_text(json.dumps({"simulated": True} | figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
