"""Track geometry: filters against sinusoids, chords, channels and detections on simulated irregular track, overlay, lining, and how fast.

    python benchmarks/geometry.py [--seeds 4] [--quick] [--json PATH]

Recording cars are simulated on the bundled line (or a line of 100 km) with irregularities and defects of known size; everything that has a
truth is held against it. Real lines carry no truth and are not in here.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

import railnav as rn
from railnav.io.limits import default_limits
from railnav.monitoring.channels import channels_of
from railnav.monitoring.filters import D0, D1, D2, D3_ALIGNMENT, D3_LEVEL, band_pass, gain
from railnav.monitoring.limits import exceedances
from railnav.monitoring.lining import LiningLimits, line_up
from railnav.monitoring.monitor import monitor
from railnav.monitoring.overlay import overlay, shifted
from railnav.monitoring.position import measured_axis
from railnav.monitoring.quality import deviations
from railnav.monitoring.rails import RAILS, axis_key
from railnav.monitoring.recording import record
from railnav.monitoring.section import onto, passages_of
from railnav.monitoring.smoothing import whittaker
from railnav.monitoring.trends import growth
from railnav.monitoring.versines import Chord
from railnav.simulation import Leg
from railnav.simulation.irregularities import KINDS, Defect, irregular, simulate_geometry

CHORDS = (
    ("10 m", 5.0, 5.0),
    ("20 m", 10.0, 10.0),
    ("4.1 + 17.4 m", 4.1, 17.4),
    ("4 + 6 m", 4.0, 6.0),
    ("2.6 + 6 m", 2.6, 6.0),
    ("62 ft", 9.4488, 9.4488),
)


def filters() -> tuple[float, float]:
    """Greatest error of the filters against analytic sinusoids, as a share of the amplitude: everywhere, and far from ends."""
    s = np.arange(0.0, 4000.0, 0.25)
    worst = 0.0
    inner = 0.0
    middle = np.abs(s - 2000.0) < 500.0
    for band in (D0, D1, D2, D3_LEVEL, D3_ALIGNMENT):
        for wave, phase in zip(np.geomspace(band.lower, band.upper, 40), np.linspace(0.0, 25.0, 40), strict=True):
            expected = float(gain(wave, band)) * np.sin(2 * np.pi * s / wave + phase)
            for times in (0, 1, 2):
                given = np.sin(2 * np.pi * s / wave + phase + 0.5 * np.pi * times) * (2 * np.pi / wave) ** times
                error = np.abs(band_pass(given, 0.25, band, integrate=times) - expected)
                worst = max(worst, float(np.nanmax(error)))
                inner = max(inner, float(np.nanmax(error[middle])))
    return worst, inner


def chords() -> list[list[str]]:
    """The chord table of the specification, computed."""
    rows = []
    for name, a, b in CHORDS:
        chord = Chord(a, b)
        low, high = chord.seen(D1)
        blind = ", ".join(f"{w:.2f}" for w in chord.blind(3.0, 25.0)[::-1]) or "none"
        at = np.abs(chord.transfer([70.0, 150.0]))
        rows.append([name, f"{chord.factor:.2f}", f"{low:.3f} to {high:.2f}", blind, f"{at[0]:.3f}", f"{at[1]:.3f}"])
    return rows


def track(model: rn.TrackModel) -> tuple[str, float]:
    """The longest track."""
    longest = max(model.track_id, key=model.length)
    return longest, model.length(longest)


def drive(model: rn.TrackModel, fields: Any, seed: int, *, month: float = 0.0, name: str = "") -> tuple[rn.Run, Any]:
    """A recording car over the longest track, and where it was."""
    which, length = track(model)
    start = datetime.fromtimestamp(1_770_000_000 + month * 2_629_800.0, UTC)
    run, _ = simulate_geometry(
        model,
        Leg((which,), start=50.0, finish=length - 50.0),
        fields,
        seed=seed,
        tunnels=False,
        start=start,
        run_id=name or f"run-{seed}",
    )
    return run, passages_of(rn.navigate(run, model, smooth=True), model)[0]


def accuracy(model: rn.TrackModel, seeds: int) -> dict[str, list[float]]:
    """Errors of the channels against the simulated fields, and their ratio to the stated sigma."""
    errors: dict[str, list[tuple[float, float, float]]] = {}
    column = {"alignment": 0, "longitudinal_level": 1, "cross_level": 2, "gauge": 3}
    for seed in range(seeds):
        fields = irregular(model, seed=100 + seed)
        run, passage = drive(model, fields, seed)
        recording = record(run, passage, against_model=True)
        geometry = channels_of(recording)
        where, offset = passage.section.locate(geometry.distance)
        truth = fields.at(where, offset)
        for key, channel in geometry.channels.items():
            name = axis_key(key).rsplit("_", 1)[0] if channel.band else key
            if name not in column and key != "cross_level_deviation":
                continue
            true = rail_field(truth, key) if axis_key(key) != key else truth[:, column.get(name, 2)]
            if channel.band:
                true = band_pass(true, recording.step, channel.band)
            elif key == "gauge":
                true = true + recording.gauge_nominal
            elif key == "cross_level":
                true = true + passage.section.at(geometry.distance).cant
            error = channel.values - true
            errors.setdefault(key, []).append((float(np.nanstd(error)), channel.sigma, float(np.nanstd(true))))
    return {key: [float(np.mean([e[i] for e in rows])) for i in range(3)] for key, rows in errors.items()}


def rail_field(truth: np.ndarray, key: str) -> np.ndarray:
    """The simulated rail that a channel's key names, from the four fields."""
    side = 0.5 if "_left_" in key else -0.5
    right, up, cross, gauge = truth.T
    return np.asarray(up + side * cross if key.startswith("longitudinal") else right - side * gauge)


def detection(model: rn.TrackModel, seeds: int) -> dict[str, dict[str, int]]:
    """Simulated defects: found, missed and false, against the true channel through the same filter; 5 % about a limit is left out."""
    table, speed = default_limits(), 120.0 / 3.6
    keys = ["gauge"] + [f"{name}_{rail}_d1" for name in ("longitudinal_level", "alignment") for rail in RAILS]
    counts = {key: {"beyond": 0, "found": 0, "reported": 0, "false": 0} for key in keys}
    which, length = track(model)
    for seed in range(seeds):
        generator = np.random.default_rng(1000 + seed)
        places = np.arange(300.0, length - 300.0, 120.0)
        defects = []
        for i, place in enumerate(places):
            kind = ("gauge", "longitudinal_level", "alignment")[i % 3]
            size = {"gauge": 0.020, "longitudinal_level": 0.016, "alignment": 0.013}[kind] * generator.uniform(0.4, 1.6)
            sign = 1.0 if kind == "gauge" else generator.choice([-1.0, 1.0])
            defects.append(Defect(kind, which, float(place), float(sign * size), float(generator.uniform(4.0, 14.0))))
        fields = irregular(model, seed=200 + seed, defects=defects)
        run, passage = drive(model, fields, 50 + seed)
        geometry = channels_of(record(run, passage, against_model=True))
        found, _ = exceedances(geometry, table, speed)
        at, offset = passage.section.locate(geometry.distance)
        truth = fields.at(at, offset)
        for key in keys:
            limit = next(x for x in table.limits if x.channel == axis_key(key) and x.speed[0] < speed <= x.speed[1])
            low, high = limit.levels["alert"]
            true = truth[:, KINDS.index(key)] if key == "gauge" else band_pass(rail_field(truth, key), 0.25, D1)
            mine = np.array([e.peak for e in found if e.channel == key])
            beyond = np.flatnonzero((true > 1.05 * high) | (true < 1.05 * low))
            groups = np.split(beyond, np.flatnonzero(np.diff(beyond) > 8) + 1) if len(beyond) else []
            for group in groups:
                counts[key]["beyond"] += 1
                near = np.abs(mine - geometry.distance[group].mean()) < 0.5 * np.ptp(geometry.distance[group]) + 1.0
                counts[key]["found"] += bool(near.any())
            for place in mine:
                near = np.abs(geometry.distance - place) < 1.0
                counts[key]["reported"] += 1
                inside = (true[near] <= 0.95 * high) & (true[near] >= 0.95 * low)
                counts[key]["false"] += bool(inside.all())
    return counts


def overlays(model: rn.TrackModel, seeds: int) -> tuple[float, float]:
    """Scatter of the shift between runs before and after the overlay, m (root mean square over windows)."""
    before, after = [], []
    fields = irregular(model, seed=7)
    run, passage = drive(model, fields, 1)
    reference = channels_of(record(run, passage, against_model=True))
    for seed in range(seeds):
        other, way = drive(model, fields, 20 + seed)
        part = onto(way, passage.section)
        assert part is not None
        lies = overlay(channels_of(record(other, part, against_model=True)), reference)
        again = overlay(channels_of(record(other, shifted(part, lies), against_model=True)), reference)
        before.append(float(np.sqrt(np.mean(lies.shift**2))))
        after.append(float(np.sqrt(np.mean(again.shift**2))))
    return float(np.mean(before)), float(np.mean(after))


def growths(model: rn.TrackModel, seeds: int) -> dict[str, float]:
    """Growth a month from runs of several dates, as `railnav monitor` tells it, against the simulated track.

    Longitudinal level between 2 and 4 km grows by 3 % of its first size a month over four dates; and, by itself, track that does not change
    seen on three dates. Rates of every banded channel are held against those of the fields driven over, through the same filter.
    """
    squares: list[float] = []
    inside, told, growing, found, still, false = 0, 0, 0, 0, 0, 0
    errors: list[float] = []
    months = (0.0, 2.0, 4.0, 6.0)
    for seed in range(seeds):
        fields = [irregular(model, seed=500 + seed) for _ in months]
        for made, month in zip(fields, months, strict=True):
            a = int(made.start[model.track_index(track(model)[0])])
            made.fields[a + 8000 : a + 16000, 1] *= 1.0 + 0.03 * month
        runs = [
            drive(model, made, 5000 + 10 * seed + k, month=month, name=f"date-{k}")[0]
            for k, (made, month) in enumerate(zip(fields, months, strict=True))
        ]
        part = monitor(runs, model, default_limits(), against_model=True).sections[0]
        order = sorted(range(len(months)), key=lambda k: part.geometries[k].recording.run.start)
        geometries = [part.geometries[k] for k in order]
        for trend in part.trends:
            true = np.array(
                [
                    deviations(
                        np.where(
                            np.isfinite(g.channels[trend.channel].values), true_channel(made, g, trend.channel), np.nan
                        ),
                        800,
                    )
                    for made, g in zip(fields, geometries, strict=True)
                ]
            )
            rate, g = growth(months, true).rate, trend.growth
            known = np.isfinite(g.rate) & np.isfinite(rate)
            z = (g.rate[known] - rate[known]) / g.sigma[known]
            squares.append(float(np.mean(z**2)))
            inside, told = inside + int((np.abs(z) < 1.96).sum()), told + int(known.sum())
            if trend.channel == "longitudinal_level_d1":
                errors += (g.rate[known] - rate[known]).tolist()
            changing, same = known & (np.abs(rate) > 5.0 * g.sigma), known & (np.abs(rate) < 0.2 * g.sigma)
            growing, found = growing + int(changing.sum()), found + int(g.significant[changing].sum())
            still, false = still + int(same.sum()), false + int(g.significant[same].sum())
    reports = 0
    for seed in range(2 * seeds):
        made = irregular(model, seed=600 + seed)
        runs = [drive(model, made, 6000 + 10 * seed + k, month=2.0 * k, name=f"date-{k}")[0] for k in range(3)]
        part = monitor(runs, model, default_limits(), against_model=True).sections[0]
        reports += any(trend.growth.significant.any() for trend in part.trends)
    return {
        "nees": float(np.mean(squares)),
        "inside": inside / told,
        "rates": float(told),
        "error": float(np.sqrt(np.mean(np.square(errors)))),
        "growing": float(growing),
        "found": float(found),
        "still": float(still),
        "false": float(false),
        "reports": float(2 * seeds),
        "false_reports": float(reports),
    }


def true_channel(fields: Any, geometry: Any, key: str) -> np.ndarray:
    """The simulated track through the filter of a banded channel, of the axis or of a rail, on the grid of a recording."""
    truth = fields.at(*geometry.recording.passage.section.locate(geometry.distance))
    column = {"alignment": 0, "longitudinal_level": 1}
    values = rail_field(truth, key) if axis_key(key) != key else truth[:, column[key.rsplit("_", 1)[0]]]
    return band_pass(values, geometry.recording.step, geometry.channels[key].band)


def axis_error(model: rn.TrackModel, seeds: int) -> tuple[float, float, float, float]:
    """Measured axis of one run against the simulated one: error and stated sigma, right and up, m."""
    rows = []
    for seed in range(seeds):
        fields = irregular(model, seed=300 + seed)
        run, passage = drive(model, fields, 80 + seed)
        axis = measured_axis(passage.section, [record(run, passage, against_model=True)])
        where, offset = passage.section.locate(axis.distance)
        truth = fields.at(where, offset)
        right, up = axis.right - truth[:, 0], axis.up - truth[:, 1]
        rows.append((float(np.nanmean(right**2)), float(np.nanvar(up)), axis.sigma_right, axis.sigma_up))
    mean = np.mean(np.array(rows), axis=0)
    return math.sqrt(mean[0]), float(mean[2]), math.sqrt(mean[1]), float(mean[3])


def lined(model: rn.TrackModel, seeds: int) -> dict[str, dict[str, list[float]]]:
    """What lining makes of the simulated track itself, by band: spread of alignment before and after, m, planned from one measured run.

    After the slews of the programme, and after those of the versine method; and by what slews differ from those of a track known exactly,
    over their stated sigma.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for step in (5.0, 1.0):
        rows: dict[str, list[tuple[float, float, float]]] = {}
        ratio = []
        for seed in range(seeds):
            fields = irregular(model, seed=400 + seed)
            run, passage = drive(model, fields, 120 + seed)
            axis = measured_axis(passage.section, [record(run, passage, against_model=True)])
            where, offset = passage.section.locate(axis.distance)
            truth = fields.at(where, offset)
            exact = replace(
                axis,
                right=np.where(np.isfinite(axis.right), truth[:, 0], np.nan),
                up=np.where(np.isfinite(axis.up), truth[:, 1], np.nan),
            )
            plan, ideal = line_up(axis, step=step), line_up(exact, step=step)
            ratio.append(float(np.mean(((plan.slew - ideal.slew) / plan.sigma_slew) ** 2)))
            inside = (axis.distance >= plan.hallade_distance[0]) & (axis.distance <= plan.hallade_distance[-1])
            d, before = axis.distance[inside], truth[inside, 0]
            programme = before + PchipInterpolator(plan.distance, plan.slew)(d)
            strings = before + PchipInterpolator(plan.hallade_distance, plan.hallade_slew)(d)
            for band in (D1, D2, D3_ALIGNMENT):
                sd = [float(np.nanstd(band_pass(v, axis.step, band))) for v in (before, programme, strings)]
                rows.setdefault(band.name, []).append((sd[0], sd[1], sd[2]))
        found[f"{step:g}"] = {name: np.mean(np.array(values), axis=0).tolist() for name, values in rows.items()}
        found[f"{step:g}"]["ratio"] = [math.sqrt(float(np.mean(np.array(ratio))))]
    return found


def whittaker_example() -> list[list[str]]:
    """The example of the specification: 4.1, 7.1 and 9.9 mm in D1, D2 and D3, here as waves of 10, 54 and 124 m over 3 km."""
    rows = []
    s = np.arange(0.0, 3000.0)
    waves = ((4.1e-3, 10.0), (7.1e-3, 54.0), (9.9e-3, 124.0))
    y = np.sum([math.sqrt(2.0) * sigma * np.sin(2 * np.pi * s / wave) for sigma, wave in waves], axis=0)
    for cutoff in (100.0, 200.0):
        x = whittaker(y, 1.0, cutoff)
        sd = [float(1e3 * np.nanstd(band_pass(x, 1.0, band)[600:2400])) for band in (D1, D2, D3_ALIGNMENT)]
        rows.append([f"{cutoff:.0f} m", f"{1e3 * np.abs(x - y)[600:2400].max():.0f}", *(f"{v:.2f}" for v in sd)])
    return rows


def long_line() -> rn.TrackModel:
    """A line of 100 km that sways gently."""
    s = np.arange(0.0, 100_001.0, 25.0)
    bearing = 0.4 * np.sin(2 * np.pi * s / 9000.0)
    east, north = (np.append(0.0, np.cumsum(25.0 * f(0.5 * (bearing[1:] + bearing[:-1])))) for f in (np.sin, np.cos))
    metres = 111_320.0
    points = [
        [10.0 + e / (metres * math.cos(math.radians(50.0))), 50.0 + n / metres, 200.0]
        for e, n in zip(east, north, strict=True)
    ]
    feature = {
        "type": "Feature",
        "properties": {"track": "long", "line": ""},
        "geometry": {"type": "LineString", "coordinates": points},
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.geojson"
        path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}), encoding="utf-8")
        return rn.read_geojson(path)


def speed() -> dict[str, float]:
    """Processor seconds for channels of 100 km at 0.25 m, and for a lining plan of 10 km at 1 m."""
    model = long_line()
    fields = irregular(model, seed=1)
    begun = time.process_time()
    run, _ = simulate_geometry(model, Leg(("long",)), fields, seed=1)
    simulated = time.process_time() - begun
    begun = time.process_time()
    passage = passages_of(rn.navigate(run, model, smooth=True), model)[0]
    navigated = time.process_time() - begun
    begun = time.process_time()
    geometry = channels_of(record(run, passage, against_model=True))
    channels = time.process_time() - begun
    short = rn.demo_line()
    fields = irregular(short, seed=2)
    run, passage = drive(short, fields, 2)
    axis = measured_axis(passage.section, [record(run, passage, against_model=True)])
    begun = time.process_time()
    plan = line_up(axis, step=1.0, limits=LiningLimits())
    lined = time.process_time() - begun
    return {
        "kilometres": geometry.distance[-1] / 1e3,
        "samples": float(len(run.gauge.time) if run.gauge else 0),
        "simulate": simulated,
        "navigate": navigated,
        "channels": channels,
        "lining": lined,
        "lined_km": float(plan.distance[-1] - plan.distance[0]) / 1e3,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--quick", action="store_true", help="two seeds, no line of 100 km")
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args()
    seeds = 2 if wanted.quick else wanted.seeds
    result: dict[str, Any] = {"filter_error": filters()}
    print("Band-pass D0 to D3, also integrating once and twice, against analytic sinusoids:")
    worst, inner = (100 * v for v in result["filter_error"])
    print(f"{worst:.2f} % of the amplitude at most, at the ends of what is given; {inner:.5f} % far from them")
    print("\nchord          versine x R, m^2   |H| in D1      zeros, m               at 70 m   at 150 m")
    for row in chords():
        print(f"{row[0]:<15}{row[1]:>8}           {row[2]:<15}{row[3]:<22}{row[4]:>8}{row[5]:>10}")
    print("\nWhittaker, waves of 10, 54 and 124 m with 4.1, 7.1 and 9.9 mm")
    print("cut-off   max shift, mm    D1      D2      D3, mm")
    for row in whittaker_example():
        print(f"{row[0]:<10}{row[1]:>10}{row[2]:>11}{row[3]:>8}{row[4]:>8}")
    model = rn.demo_line()
    print(f"\nChannels, {seeds} simulated runs, {track(model)[1] / 1e3:.1f} km each (mm)")
    print("channel                         error   stated sigma   the track itself")
    result["channels"] = accuracy(model, seeds)
    for key, (error, sigma, size) in result["channels"].items():
        print(f"{key.replace('_', ' '):<31}{1e3 * error:>6.3f}{1e3 * sigma:>12.3f}{1e3 * size:>15.2f}")
    result["detection"] = detection(model, seeds)
    print("\nSimulated defects held against the alert limit at 120 km/h (5 % about it left out)")
    print("channel                      beyond    found   reported   false")
    for key, c in result["detection"].items():
        print(f"{key.replace('_', ' '):<28}{c['beyond']:>7}{c['found']:>9}{c['reported']:>11}{c['false']:>8}")
    result["overlay"] = overlays(model, seeds)
    apart, laid = (100 * v for v in result["overlay"])
    print(f"\nRuns over each other: {apart:.1f} cm apart as navigated, {laid:.1f} cm once overlaid (RMS)")
    result["trends"] = g = growths(model, max(1, seeds // 2) if wanted.quick else seeds)
    print(
        f"Growth a month over four dates, {g['rates']:.0f} rates of all channels: squared error over sigma squared {g['nees']:.2f}, "
        f"{100 * g['inside']:.1f} % within 1.96 sigma; longitudinal level D1 within {1e3 * g['error']:.4f} mm a month (RMS)"
    )
    print(
        f"Growing by more than 5 sigma a month: {g['found']:.0f} of {g['growing']:.0f} segments found; not growing (0.2 sigma): "
        f"{g['false']:.0f} of {g['still']:.0f} called so; track that does not change, three dates: {g['false_reports']:.0f} of "
        f"{g['reports']:.0f} reports tell of any growth"
    )
    result["axis"] = axis_error(model, seeds)
    a, sa, u, su = (1e3 * v for v in result["axis"])
    print(f"Measured axis of one run: {a:.1f} mm across (stated {sa:.1f}), {u:.1f} mm in height (stated {su:.1f})")
    result["lined"] = lined(model, seeds)
    print(
        "\nAlignment of the simulated track before and after lining to a smoothed target planned from one run (mm, machine exact)"
    )
    print("nodes    band    before   programme   versines")
    for step, made in result["lined"].items():
        for name in ("D1", "D2", "D3"):
            before, programme, strings = (1e3 * v for v in made[name])
            print(f"{step + ' m':<9}{name:<7}{before:>7.2f}{programme:>12.2f}{strings:>11.2f}")
    ratios = ", ".join(f"{made['ratio'][0]:.2f} at {step} m" for step, made in result["lined"].items())
    print(f"Slews against those of the track known exactly, over their stated sigma: {ratios} (1 is honest)")
    if not wanted.quick:
        result["speed"] = s = speed()
        print(
            f"\n{s['kilometres']:.0f} km at 0.25 m: channels in {s['channels']:.1f} s of processor time (navigation before it "
            f"{s['navigate']:.1f} s); lining of {s['lined_km']:.1f} km at 1 m in {s['lining']:.1f} s"
        )
    if wanted.json:
        wanted.json.write_text(json.dumps(result, indent=2), encoding="utf-8")


if __name__ == "__main__":
    main()
