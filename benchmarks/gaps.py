"""Gaps cut into the real runs of line 80, GNSS alone, no odometer, no IMU: where the train is when the fixes come back.

    python benchmarks/gaps.py [--trains 8]

Each train runs on a model built without its own runs. Gaps of 10 and 30 s are cut every two minutes. The position at the end of a gap,
before the first fix after it, is compared with the smoothed solution of the uncut run: no truth, but metres better than what a gap leaves.
Baseline: the last fix before the gap, carried on along the track at the speed that the receiver gave with it.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

import railnav as rn
from railnav.run import Run

DATA = Path(os.environ.get("RAILNAV_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"))
PERIOD = 120.0


def cut(run: Run, gap: float) -> Run:
    """Leave out the fixes of the last `gap` seconds of every two minutes."""
    assert run.gnss is not None
    keep = np.mod(run.gnss.time - run.gnss.time[0], PERIOD) < PERIOD - gap
    gnss = run.gnss
    columns = {
        name: value[keep]
        for name in gnss.__slots__
        if isinstance(value := getattr(gnss, name), np.ndarray) and len(value) == len(gnss.time)
    }
    return replace(run, gnss=replace(gnss, **columns))


def ends_of_gaps(run: Run, cut_run: Run, gap: float) -> list[tuple[float, float]]:
    """Last fix before each gap and first fix after it, s; gaps of the run itself left out."""
    assert cut_run.gnss is not None
    assert run.gnss is not None
    t = cut_run.gnss.time
    before = np.flatnonzero(np.diff(t) > 0.8 * gap)
    whole = run.gnss.time
    found = []
    for k in before:
        inside = whole[(whole > t[k]) & (whole < t[k + 1])]
        if len(inside) and np.diff(np.concatenate([[t[k]], inside, [t[k + 1]]])).max() < 3.0:
            found.append((float(t[k]), float(t[k + 1])))
    return found


def one(model: rn.TrackModel, run: Run, gap: float) -> tuple[list[float], list[float], list[float], list[bool], int]:
    """At the ends of gaps: errors along, stated sigmas, the baseline's errors, whether inside the bound; and changes of track inside."""
    reference = rn.navigate(run, model, smooth=True)
    short = cut(run, gap)
    found = rn.navigate(short, model)
    errors, sigmas, naive, inside, changes = [], [], [], [], 0
    for begin, end in ends_of_gaps(run, short, gap):
        i = int(np.searchsorted(found.time, end - 1e-6)) - 1
        j = int(np.argmin(np.abs(reference.time - found.time[i])))
        if found.track[i] < 0 or reference.track[j] < 0 or abs(reference.time[j] - found.time[i]) > 0.6:
            continue
        along = _along(found, i, reference, j)
        if along is None:
            continue
        errors.append(along)
        sigmas.append(float(found.sigma_along[i]))
        inside.append(abs(along) <= found.protection_level_along[i])
        k = int(np.searchsorted(found.time, begin + 1e-6)) - 1
        changes += int(len(set(found.track[k : i + 1].tolist())) > 1)
        a = int(np.argmin(np.abs(reference.time - begin)))
        naive.append(_carried_on(model, run, begin, found.time[i], reference, a) - _run_between(reference, a, j))
    return errors, sigmas, naive, inside, changes


def _carried_on(model: rn.TrackModel, run: Run, begin: float, end: float, reference: rn.Solution, a: int) -> float:
    """Way from the reference's place at the last fix to where its position and speed, both as received, lead until the gap's end, m."""
    gnss = run.gnss
    assert gnss is not None
    k = int(np.argmin(np.abs(gnss.time - begin)))
    east, north, *_ = model.frame.to_grid(gnss.latitude[k], gnss.longitude[k], 0.0)
    ahead = np.sin(reference.heading[a]), np.cos(reference.heading[a])
    offset = (east - reference.easting[a]) * ahead[0] + (north - reference.northing[a]) * ahead[1]
    speed = gnss.speed[k] if gnss.speed is not None and np.isfinite(gnss.speed[k]) else reference.speed[a]
    return float(offset + speed * (end - begin))


def _run_between(solution: rn.Solution, a: int, b: int) -> float:
    step = np.hypot(np.diff(solution.easting[a : b + 1]), np.diff(solution.northing[a : b + 1]))
    return float(np.nansum(step))


def _along(found: rn.Solution, i: int, reference: rn.Solution, j: int) -> float | None:
    """Difference along the track, m: positive ahead. A parallel track is the same place along."""
    dt = found.time[i] - reference.time[j]
    east, north = found.easting[i] - reference.easting[j], found.northing[i] - reference.northing[j]
    ahead = np.sin(reference.heading[j]), np.cos(reference.heading[j])
    if not np.isfinite(east) or not np.isfinite(reference.heading[j]):
        return None
    return float(east * ahead[0] + north * ahead[1] - reference.speed[j] * dt)


def main() -> None:
    """Build, cut, navigate, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trains", type=int, default=8)
    trains = parser.parse_args().trains
    folders = sorted((DATA / "line80").iterdir())
    runs = {f.name: Run.read(f) for f in folders if not f.name.endswith("mtk")}
    days = sorted({name.split("_")[0] for name in runs})[:trains]
    total: dict[tuple[float, str], list[np.ndarray]] = {}
    for day in days:
        model = rn.build([run for name, run in runs.items() if not name.startswith(day)])
        for name in (n for n in runs if n.startswith(day)):
            for gap in (10.0, 30.0):
                errors, sigmas, naive, inside, changes = one(model, runs[name], gap)
                kind = name.rsplit("_", 1)[1]
                total.setdefault((gap, kind), []).append(np.array([errors, sigmas, naive, inside], float))
                print(
                    f"  {name} {gap:.0f} s: {len(errors)} gaps, {np.sqrt(np.mean(np.square(errors))):.1f} m RMS at the end, constant speed "
                    f"{np.sqrt(np.mean(np.square(naive))):.1f} m, changes of track inside gaps {changes}",
                    flush=True,
                )
    for (gap, kind), parts in sorted(total.items()):
        e, s, n, within = np.concatenate(parts, axis=1)
        words = [
            f"{gap:.0f} s gaps, {kind}: {len(e)} gaps; at their end {np.sqrt(np.mean(e**2)):.2f} m RMS",
            f"median {np.median(np.abs(e)):.2f} m, 95 % {np.quantile(np.abs(e), 0.95):.1f} m",
            f"stated sigma {np.sqrt(np.mean(s**2)):.2f} m, within 2 sigma {np.mean(np.abs(e) < 2 * s):.1%}",
            f"within the bound {np.mean(within):.2%}; constant speed {np.sqrt(np.mean(n**2)):.2f} m RMS",
            f"median {np.median(np.abs(n)):.2f} m, 95 % {np.quantile(np.abs(n), 0.95):.1f} m",
        ]
        print(", ".join(words))


if __name__ == "__main__":
    main()
