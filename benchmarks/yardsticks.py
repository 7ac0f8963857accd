"""The peers' yardsticks on their kind of data: many turnouts, tracks 4.5 m apart, 1 Hz GNSS with 3 m white and 2 m coloured error.

    python benchmarks/yardsticks.py [--runs 24] [--first-seed 5000] [--only CASE ...] [--json PATH]

A fictitious line of sixteen stations of four tracks, 96 crossovers and loops, run over from end to end on random lawful ways: at every
facing turnout one leg in so many. Each case is judged forward, as on board, at the fixes: epochs and turnouts right, what is declared,
moves that no train can make, errors along the track and whether they lie inside a 95 % bound. "Told" runs declare the receiver's white and
coloured parts in run.toml, as the peers are told them; the others state one sigma a fix and no more. A receiver alone is also judged
smoothed, after the fact. Then gaps of 300 s, and trains that stop and come back inside one. Beside them the track nearest to each fix.
Everything here is simulated.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import railnav as rn
from railnav.evaluation import compare, find_jumps
from railnav.evaluation.reliability import Reliability, binomial_bounds, pooled_reliability, reliability
from railnav.geodesy.grid import choose_frame
from railnav.run import Run
from railnav.simulation import Driving, GnssSensor, ImuSensor, Leg, OdometerSensor, Outfit, simulate
from railnav.simulation.driving import drive
from railnav.simulation.journey import directions, path_of
from railnav.simulation.layout import (
    Element,
    Profile,
    connecting_track,
    curve,
    parallel_track,
    place_axis,
    turnout_connection,
)
from railnav.track.assembly import TrackSection, assemble
from railnav.track.model import TrackModel

#: Distance of neighbouring tracks, m; stations; metres from one to the next.
SPACING, STATIONS, STATION_LENGTH = 4.5, 16, 2_600.0
#: Single track at either end of the line, m.
SINGLE = 1_000.0
#: The peers' receiver: 3 m white and 2 m coloured, per axis; it states the sigma of both together.
RECEIVER = GnssSensor(
    white_horizontal=3.0, white_vertical=5.0, coloured_horizontal=2.0, coloured_vertical=4.0, speed_sigma=0.1
)
WHEEL, INERTIAL = OdometerSensor(slip_rate=4.0), ImuSensor()
#: Which sensors: with "positions" the receiver gives no speed and no course, as the peers' data have none.
CASES: dict[str, Outfit] = {
    "GNSS + IMU + odometer": Outfit("all", gnss=RECEIVER, imu=INERTIAL, odometer=WHEEL),
    "GNSS + IMU": Outfit("imu", gnss=RECEIVER, imu=INERTIAL),
    "GNSS + odometer": Outfit("odometer", gnss=RECEIVER, odometer=WHEEL),
    "GNSS alone": Outfit("gnss", gnss=RECEIVER),
    "GNSS alone, told": Outfit("gnss", gnss=RECEIVER),
    "GNSS alone, told, smoothed": Outfit("gnss", gnss=RECEIVER),
    "GNSS positions alone": Outfit("positions", gnss=RECEIVER),
    "GNSS positions alone, told": Outfit("positions", gnss=RECEIVER),
}
#: A turnout counts as right when the track named is right this far past its toe, m, and later until the leg ends or `LEG` metres.
PAST, LEG = 40.0, 400.0


def station_line(stations: int = STATIONS) -> TrackModel:
    """Lay out the line: two main tracks, single at both ends; in each station two crossovers at either end and a loop on either side."""
    frame = choose_frame(np.radians(50.62), np.radians(10.90))
    e0, n0, *_ = frame.to_grid(np.radians(50.62), np.radians(10.90), 212.0)
    length = stations * STATION_LENGTH + 2.0 * SINGLE
    elements: list[Element] = [Element(SINGLE)]
    for k in range(stations):
        radius = (900.0, -1200.0, 1500.0, -700.0)[k % 4]
        bend = curve(radius, 450.0, transition=120.0, cant=0.09, straight_before=1_600.0)
        elements += [*bend, Element(STATION_LENGTH - sum(e.length for e in bend))]
    elements.append(Element(SINGLE))
    slopes = [(SINGLE + k * STATION_LENGTH + 1_800.0, (0.004, -0.006)[k % 2]) for k in range(stations)]
    placed = place_axis(
        frame,
        elements,
        Profile.of(212.0, [(0.0, -0.003), *slopes], radius=8_000.0),
        easting=float(e0),
        northing=float(n0),
        grid_bearing=np.radians(62.0),
    )
    half = 0.5 * SPACING
    cuts: dict[str, set[float]] = {"R": set(), "L": set()}
    sections: list[TrackSection] = []

    def connect(
        name: str, begin: float, start: str, finish: str, lateral: float, parallel: float
    ) -> tuple[float, float]:
        knots, station = connecting_track(
            placed,
            begin,
            half if start == "R" else -half,
            turnout_connection(lateral, number=9, radius=300.0, parallel=parallel),
            spacing=2.0,
        )
        sections.append(TrackSection(name, knots, line="9"))
        cuts[start].add(float(station[0]))
        cuts[finish].add(float(station[-1]))
        return float(station[0]), float(station[-1])

    for k in range(stations):
        at = SINGLE + k * STATION_LENGTH
        for i, (begin, side) in enumerate(((100.0, "R"), (210.0, "L"), (1_290.0, "R"), (1_400.0, "L"))):
            other = "L" if side == "R" else "R"
            connect(f"X{k:02d}{i}", at + begin, side, other, -SPACING if side == "R" else SPACING, 0.0)
        connect(f"S{k:02d}R", at + 330.0, "R", "R", SPACING, 750.0)
        connect(f"S{k:02d}L", at + 330.0, "L", "L", -SPACING, 750.0)
    _, left_begins = connect("XA", 0.6 * SINGLE, "R", "L", -SPACING, 0.0)
    left_ends, _ = connect("XB", length - 0.8 * SINGLE, "L", "R", SPACING, 0.0)
    cuts["R"] |= {0.0, length}
    assert {left_begins, left_ends} <= cuts["L"]
    for side, lateral in (("R", half), ("L", -half)):
        edges = sorted(cuts[side])
        for i, (a, b) in enumerate(itertools.pairwise(edges)):
            knots, _ = parallel_track(placed, a, b, lateral, spacing=2.0)
            sections.append(TrackSection(f"{side}{i:03d}", knots, line="9"))
    return assemble(frame, sections, provenance={"source": "benchmarks/yardsticks.py", "simulated": True})


@dataclass(frozen=True)
class Network:
    """Lawful ways on: (track, end entered) reached from (track, end left)."""

    line: TrackModel
    onward: dict[tuple[int, int], list[tuple[int, int]]]

    @property
    def far(self) -> str:
        """The last track of the line."""
        return max(name for name in self.line.track_id if name.startswith("R"))

    @classmethod
    def of(cls, line: TrackModel) -> Network:
        onward: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for a, end_a, b, end_b in line.movements.tolist():
            onward.setdefault((a, end_a), []).append((b, end_b))
            onward.setdefault((b, end_b), []).append((a, end_a))
        return cls(line, onward)

    def way(self, random: np.random.Generator) -> Leg:
        """A random way from one end of the line to the other, one leg in so many at each facing turnout."""
        first, last = (self.line.track_index(name) for name in ("R000", self.far))
        end = int(random.integers(2))  # which end of its track the train leaves by
        track, goal = (first, last) if end else (last, first)
        tracks = [track]
        while track != goal:
            ways = self.onward[track, end]
            track, entered = ways[int(random.integers(len(ways)))]
            end = 1 - entered
            tracks.append(track)
        # from 200 m inside to 100 m before the end
        length = float(self.line.lengths[tracks[0]]), float(self.line.lengths[tracks[-1]])
        names = tuple(self.line.track_id[t] for t in tracks)
        inside = (200.0, length[1] - 100.0) if tracks[0] == first else (length[0] - 200.0, 100.0)
        return Leg(names, start=inside[0], finish=inside[1], dwell=5.0)

    def facing(self, tracks: tuple[str, ...]) -> list[tuple[int, int]]:
        """Pairs of neighbouring tracks on a way between which the train could have gone elsewhere."""
        index = [self.line.track_index(t) for t in tracks]
        return [
            (a, b)
            for a, b in itertools.pairwise(index)
            for ways in (self.onward.get((a, end), []) for end in (0, 1))
            if len(ways) > 1 and any(t == b for t, _ in ways)
        ]


@dataclass
class Tally:
    """What is counted over the runs of one case."""

    epochs: int = 0
    right: int = 0
    placed: int = 0
    declared: int = 0
    declared_right: int = 0
    nearest_right: int = 0
    nearest_illegal: int = 0
    turnouts: int = 0
    turnouts_right: int = 0
    turnouts_declared: int = 0
    turnouts_wrong: int = 0
    nearest_turnouts: int = 0
    illegal: int = 0
    along: list[np.ndarray] = field(default_factory=list)
    beyond: int = 0
    parts: list[Reliability] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def rms(self) -> float:
        """Of the errors along the track, m."""
        return float(np.sqrt(np.mean(np.concatenate(self.along) ** 2)))


def stripped(run: Run) -> Run:
    """The run without speed and course of the receiver."""
    assert run.gnss is not None
    return replace(run, gnss=replace(run.gnss, speed=None, course=None, sigma_speed=None))


def at_fixes(solution: rn.Solution, run: Run) -> np.ndarray:
    """Rows of a solution at the run's fixes: epochs of the yardstick, 1 Hz."""
    assert run.gnss is not None
    rows = np.searchsorted(solution.time, run.gnss.time + 1e-9) - 1
    return np.unique(rows[rows >= 0])


def nearest(line: TrackModel, run: Run) -> np.ndarray:
    """Track nearest to each fix, -1 where there is none within 60 m."""
    assert run.gnss is not None
    lever = run.gnss.lever_arm_b
    e, n, *_ = line.frame.to_grid(run.gnss.latitude, run.gnss.longitude, np.zeros(len(run.gnss.time)))
    assert abs(lever[1]) < 1e-9  # on the axis: the nearest track of the antenna is that of the train
    found = [line.locate(float(x), float(y), within=60.0) for x, y in zip(e, n, strict=True)]
    return np.array([line.track_index(c[0].track) if c else -1 for c in found])


def judge(tally: Tally, net: Network, run: Run, truth: rn.Truth, leg: Leg, *, smooth: bool = False) -> None:
    """Navigate one run and count."""
    line = net.line
    begun = time.process_time()
    solution = rn.navigate(run, line, integrity_risk=0.05, smooth=smooth)
    tally.seconds += time.process_time() - begun
    c = compare(solution, truth, by="name")
    keep = np.isin(c.row, at_fixes(solution, run))
    right, along, way, row = c.right[keep], c.along[keep], c.way[keep], c.row[keep]
    true = np.array([line.track_index(truth.track_id[t]) for t in c.true_track[keep]])
    declared = np.isin(solution.mode[row], (rn.Mode.TRACKING, rn.Mode.COASTING))
    placed = solution.track[row] >= 0
    tally.epochs += len(row)
    tally.right += int(right.sum())
    tally.placed += int(placed.sum())
    tally.declared += int(declared.sum())
    tally.declared_right += int((declared & right).sum())
    known = np.isfinite(along)
    tally.along.append(along[known])
    tally.beyond += int((np.abs(along[known]) > solution.protection_level_along[row][known]).sum())
    tally.parts.append(reliability(solution.track_probability[row][placed], right[placed]))
    tally.illegal += len(find_jumps(solution, line).illegal)
    assert run.gnss is not None
    named = nearest(line, run)
    own = np.interp(run.gnss.time, c.time[keep], np.arange(len(row))).round().astype(int)
    hit = named == true[own]
    tally.nearest_right += int(hit.sum())
    change = np.flatnonzero(np.diff(named))
    for i in change.tolist():
        a, b = int(named[i]), int(named[i + 1])
        lawful = any(t == b for end in (0, 1) for t, _ in net.onward.get((a, end), []))
        tally.nearest_illegal += not lawful
    for before, after in net.facing(leg.tracks):
        for start in np.flatnonzero((true[1:] == after) & (true[:-1] == before)) + 1:
            toe = way[start]
            leg_rows = np.flatnonzero((way > toe + PAST) & (way < toe + LEG) & (np.arange(len(way)) >= start))
            if not len(leg_rows):
                continue
            on_leg = leg_rows[true[leg_rows] == after]
            first = int(leg_rows[0]) if not len(on_leg) else int(on_leg[-1])
            tally.turnouts += 1
            tally.turnouts_right += bool(right[first])
            sure = declared[start : leg_rows[-1] + 1]
            tally.turnouts_declared += bool(sure.any())
            tally.turnouts_wrong += bool((sure & ~right[start : leg_rows[-1] + 1]).any())
            tally.nearest_turnouts += bool(hit[np.searchsorted(own, first)])


def share(count: int, of: int) -> str:
    """A share with its 95 % binomial bounds."""
    low, high = binomial_bounds(count, of)
    return f"{count / max(of, 1):.3%} ({low:.2%} to {high:.2%})"


def on_line(net: Network, name: str, runs: int, first: int) -> dict[str, Any]:
    """One case of sensors over random ways."""
    tally, driving = Tally(), Driving(speed=33.0)
    for seed in range(first, first + runs):
        leg = net.way(np.random.default_rng([seed, 1]))
        run, truth = simulate(
            net.line, leg, seed=seed, outfit=CASES[name], driving=driving, tunnels=False, declare="told" in name
        )
        run = stripped(run) if CASES[name].name == "positions" else run
        judge(tally, net, run, truth, leg, smooth="smoothed" in name)
    pooled = pooled_reliability(tally.parts)
    count = sum(len(a) for a in tally.along)
    print(f"{name}: {runs} runs, {tally.epochs:,} fixes, {tally.turnouts} facing turnouts")
    print(
        f"  epochs right {share(tally.right, tally.epochs)}; declared {tally.declared / tally.epochs:.1%}, of these right "
        f"{share(tally.declared_right, tally.declared)}"
    )
    print(
        f"  turnouts right {share(tally.turnouts_right, tally.turnouts)}; ever sure of a wrong leg {tally.turnouts_wrong}; moves that no "
        f"train can make {tally.illegal}"
    )
    print(
        f"  along the track {tally.rms:.2f} m RMS, inside the 95 % bound {share(count - tally.beyond, count)}; "
        f"probabilities {'honest' if pooled.honest else 'NOT honest'}, Brier {pooled.brier:.4f}"
    )
    print(
        f"  nearest track: epochs {tally.nearest_right / tally.epochs:.1%}, turnouts {tally.nearest_turnouts / tally.turnouts:.1%}, moves "
        f"that no train can make {tally.nearest_illegal:,}",
        flush=True,
    )
    return {
        "epochs": tally.epochs,
        "right": tally.right / tally.epochs,
        "declared": tally.declared / tally.epochs,
        "declared_right": tally.declared_right / max(tally.declared, 1),
        "turnouts": tally.turnouts,
        "turnouts_right": tally.turnouts_right / tally.turnouts,
        "illegal": tally.illegal,
        "along_rms_m": tally.rms,
        "inside_95": 1.0 - tally.beyond / count,
        "nearest_right": tally.nearest_right / tally.epochs,
        "cpu_s": tally.seconds,
    }


def gaps(net: Network, runs: int, first: int) -> dict[str, Any]:
    """Five minutes without GNSS on a straight way, and with a reversal inside: where the train is at the end, and what is said of it."""
    found: dict[str, Any] = {}
    signed = replace(WHEEL, signed=True, slip_rate=0.0)
    outfits = {
        "GNSS + IMU + odometer": Outfit("all", gnss=RECEIVER, imu=INERTIAL, odometer=signed),
        "GNSS + IMU": CASES["GNSS + IMU"],
        "GNSS + odometer": Outfit("odometer", gnss=RECEIVER, odometer=signed),
    }
    for kind in ("300 s gaps", "reversals inside a gap"):
        for name, outfit in outfits.items():
            errors, inside, lost, wrong, right, rows, illegal = [], 0, 0, 0, 0, 0, 0
            for seed in range(first, first + runs):
                way = net.way(np.random.default_rng([seed, 1]))
                legs, begin, end = [way], 400.0, 700.0
                if kind != "300 s gaps":
                    legs, begin, end = _there_and_back(net, way)
                run, truth = simulate(
                    net.line,
                    legs,
                    seed=seed,
                    outfit=outfit,
                    driving=Driving(speed=25.0),
                    tunnels=False,
                    outages=[(begin, end)],
                )
                solution = rn.navigate(run, net.line, integrity_risk=0.05)
                c = compare(solution, truth, by="name", joint_within=300.0)  # how far along is the bound's matter here
                blind = np.flatnonzero((c.time > begin + 3.0) & (c.time < end))
                declared = np.isin(solution.mode[c.row[blind]], (rn.Mode.TRACKING, rn.Mode.COASTING))
                rows += len(blind)
                right += int(c.right[blind].sum())
                wrong += bool((declared & ~c.right[blind]).any())
                illegal += len(find_jumps(solution, net.line).illegal)
                last = blind[-1]
                lost += not np.isfinite(c.along[last])
                if np.isfinite(c.along[last]):
                    errors.append(float(c.along[last]))
                    inside += abs(c.along[last]) <= solution.protection_level_along[c.row[last]]
            e = np.abs(errors)
            print(
                f"{kind}, {name}: {runs} runs, at the end {np.sqrt(np.mean(e**2)):.2f} m RMS, worst {e.max():.1f} m, inside the 95 % bound "
                f"{inside} of {len(e)}; without a place {lost}, epochs right {right / rows:.2%}, ever sure of a wrong track {wrong}, moves "
                f"that no train can make {illegal}",
                flush=True,
            )
            found[f"{kind}, {name}"] = {
                "rms_m": float(np.sqrt(np.mean(e**2))),
                "worst_m": float(e.max()),
                "inside": int(inside),
                "runs": runs,
            }
    return found


def _there_and_back(net: Network, way: Leg) -> tuple[list[Leg], float, float]:
    """A train that runs half a way, stops on a long track, goes back a kilometre and comes again; GNSS is gone while it turns."""
    long = [i for i, t in enumerate(way.tracks) if net.line.length(t) > 1_100.0]
    k = long[len(long) // 2]
    track, ways = way.tracks[k], directions(net.line, way.tracks)
    length = net.line.length(track)
    far, near = (length - 30.0, length - 930.0) if ways[k] > 0 else (30.0, 930.0)
    legs = [
        Leg(way.tracks[: k + 1], start=way.start, finish=far, dwell=20.0),
        Leg((track,), start=far, finish=near, dwell=20.0),
        Leg(way.tracks[k:], start=near, finish=way.finish, dwell=5.0),
    ]
    motion = drive(path_of(net.line, legs), Driving(speed=25.0))
    time = np.arange(0.0, motion.duration, 1.0)
    run = motion.at(time)[0]
    path = path_of(net.line, legs)
    turn = float(time[np.searchsorted(run, path.halts[0].distance - 0.5)])
    return legs, turn - 60.0, turn + 90.0


def main() -> None:
    """Run the cases asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=24)
    parser.add_argument("--first-seed", type=int, default=5000)
    parser.add_argument("--only", nargs="+", choices=[*CASES, "gaps"], default=[*CASES, "gaps"])
    parser.add_argument("--json", type=Path, metavar="PATH")
    options = parser.parse_args()
    net, figures = Network.of(station_line()), {}
    turnouts = sum(len(to) > 1 for to in net.onward.values())
    print(
        f"simulated: {STATIONS} stations, {len(net.line.track_id)} tracks, {turnouts} turnouts, tracks {SPACING} m apart"
    )
    for name in options.only:
        if name in CASES:
            figures[name] = on_line(net, name, options.runs, options.first_seed)
        else:
            figures |= gaps(net, options.runs, options.first_seed)
    if options.json:
        options.json.write_text(json.dumps({"simulated": True} | figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
