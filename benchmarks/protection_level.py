"""How often the protection level fails at 1e-2, 1e-3 and 1e-5, simulated, over many independent epochs.

    python benchmarks/protection_level.py [--epochs 12000] [--full]

1 Hz GNSS whose error is 1.4 m correlated over half a minute and 0.5 m white, an outlier in 500; an odometer with an unknown scale, a
rolling wheel's creep and 1 cm rounding. Trains run six ways through the bundled line; each way is simulated once without noise.
With a wheel, errors along the track last for minutes (neighbours 60 s apart are correlated by 0.77): so every epoch has a run of
its own, begun anywhere on the way with a fresh filter and fresh errors of all sensors, and is judged after 30 to 90 s. Epochs are then
independent; only the six ways are shared. The three risks are asked at three rows on end. The navigator is told of its sensors, as
run.toml may declare them; a tenth of the epochs is counted again by a navigator that is not, whose bounds must allow for a constant
error of the receiver and for late stamps, which these receivers do not have. `--full` counts 300,000.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

import railnav as rn
from railnav.evaluation.reliability import binomial_bounds
from railnav.navigation import Settings
from railnav.navigation import columns as c
from railnav.navigation.engine import Engine, _fault_quantile
from railnav.navigation.epochs import raw_table
from railnav.navigation.integrity import normal_quantile
from railnav.simulation import Driving, GnssSensor, Leg, OdometerSensor, Outfit, demo_line, simulate

RISKS = (1e-2, 1e-3, 1e-5)
CORRELATED, WHITE, CORRELATION_TIME = 1.4, 0.5, 30.0
SPEED_SIGMA, OUTLIERS, OUTLIER_SIZE = 0.05, 0.002, 25.0
SCALE_SIGMA, CREEP, RESOLUTION = 0.003, 0.002, 0.01
SHORTEST, LONGEST = 30, 90
STATED = float(np.hypot(CORRELATED, WHITE))
#: What these sensors are, as the navigator may be told: no constant part, stamps to a millisecond, a speed of its moment.
TOLD = Settings(
    gnss_correlation_time=CORRELATION_TIME,
    gnss_correlated_share=CORRELATED / STATED,
    gnss_white_share=WHITE / STATED,
    gnss_frame_share=0.0,
    scale_prior=100.0,
    time_tag_sigma=1e-3,
    time_tag_walk=1e-6,
    speed_latency=1e-3,
    speed_error_share=0.0,
    odometer_scale=SCALE_SIGMA,
    odometer_slip=CREEP,
    odometer_sigma=RESOLUTION / np.sqrt(12.0),
)


@dataclass(frozen=True)
class Way:
    """A way through the line without noise: epochs as the loop reads them, and where the train is at each."""

    table: np.ndarray
    track: np.ndarray
    offset: np.ndarray
    lever_arm_b: tuple[float, ...]


def ways(line: rn.TrackModel) -> list[Way]:
    """Six of them: both directions, three speeds, each some twenty kilometres."""
    exact = GnssSensor(
        white_horizontal=1e-6,
        white_vertical=1e-6,
        coloured_horizontal=0.0,
        coloured_vertical=0.0,
        speed_sigma=1e-9,
        outlier_probability=0.0,
    )
    wheel = OdometerSensor(interval=1.0, scale_error=0.0, roughness=0.0, resolution=1e-9, slip_rate=0.0)
    outfit = Outfit("exact", gnss=exact, odometer=wheel)
    found = []
    for (first, last), speed in zip(
        (("77R-01", "77R-13"), ("77R-01", "77R-13"), ("77R-01", "77R-13"), *(("77L-12", "77L-01"),) * 3),
        (16.0, 22.0, 30.0, 16.0, 22.0, 30.0),
        strict=True,
    ):
        tracks = line.routes(first, last)[0].tracks
        run, truth = simulate(
            line, Leg(tracks, start=60.0), seed=1, outfit=outfit, driving=Driving(speed=speed), tunnels=False
        )
        assert run.gnss is not None
        engine = engine_for(line, tuple(run.gnss.lever_arm_b), TOLD)
        table = engine.table(raw_table(run, {}))
        at = np.searchsorted(truth.time, table[:, c.TIME] - 1e-6)
        index = np.array([line.track_index(t) for t in truth.track_id])
        found.append(Way(table, index[truth.track[at]], truth.offset[at], tuple(run.gnss.lever_arm_b)))
    return found


def engine_for(line: rn.TrackModel, lever_arm_b: tuple[float, ...], settings: Settings) -> Engine:
    """A fresh filter."""
    return Engine(
        line,
        settings,
        imu=False,
        odometer="distance",
        speed=True,
        signed_odometer=False,
        lever_arm_b=lever_arm_b,
        integrity_risk=RISKS[0],
    )


def noisy(exact: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Epochs with fresh noise."""
    table = exact.copy()
    m = len(table)
    phi = np.exp(-np.diff(table[:, c.TIME]).mean() / CORRELATION_TIME)
    drive = random.standard_normal((2, m)) * np.sqrt(1.0 - phi * phi)
    drive[:, 0] /= np.sqrt(1.0 - phi * phi)
    error = CORRELATED * lfilter([1.0], [1.0, -phi], drive) + WHITE * random.standard_normal((2, m))
    error += (random.random(m) < OUTLIERS) * OUTLIER_SIZE * random.standard_normal((2, m))
    table[:, c.EAST] += error[0]
    table[:, c.NORTH] += error[1]
    table[:, [c.SIGMA_EAST, c.SIGMA_NORTH]] = STATED
    speed = table[:, c.GNSS_SPEED]
    turned = SPEED_SIGMA / np.maximum(speed, 1.0) * random.standard_normal(m)
    east, north = table[:, c.COURSE_EAST].copy(), table[:, c.COURSE_NORTH].copy()
    table[:, c.COURSE_EAST], table[:, c.COURSE_NORTH] = east + turned * north, north - turned * east
    table[:, c.GNSS_SPEED] = np.abs(speed + SPEED_SIGMA * random.standard_normal(m))
    table[:, c.SIGMA_SPEED] = SPEED_SIGMA
    way_run = table[:, c.DISTANCE] - table[0, c.DISTANCE]
    creep = np.cumsum(CREEP * np.sqrt(np.diff(way_run, prepend=0.0).clip(0.0)) * random.standard_normal(m))
    wheel = way_run * (1.0 + SCALE_SIGMA * random.standard_normal()) + creep
    table[:, c.DISTANCE] = np.maximum.accumulate(np.round(wheel / RESOLUTION) * RESOLUTION)
    return table


def judge(engine: Engine, way: Way, random: np.random.Generator) -> np.ndarray:
    """Error along the track and protection level at each risk, (risks, 2), at the end of a short run; NaN where not on the track."""
    rows = int(random.integers(SHORTEST, LONGEST + 1))
    first = int(random.integers(len(way.table) - rows))
    table = noisy(way.table[first : first + rows], random)
    out = np.empty((rows, c.OUTPUT_SIZE))
    found = np.full((len(RISKS), 2), np.nan)
    done = 0
    for j, risk in enumerate(RISKS):  # the state does not depend on the risk
        row = rows - len(RISKS) + j
        engine.filter.risk[:] = risk, normal_quantile(risk), _fault_quantile(risk, engine.settings)
        engine.advance(table[: row + 1], out, done)
        done = row + 1
        if out[row, c.OUT_TRACK] == way.track[first + row]:
            found[j] = out[row, c.OUT_OFFSET] - way.offset[first + row], out[row, c.OUT_LEVEL]
    return found


def count(line: rn.TrackModel, through: list[Way], settings: Settings, wanted: int, seed: int, words: str) -> None:
    """Count so many epochs and print."""
    engine = engine_for(line, through[0].lever_arm_b, settings)
    untouched = [a.copy() for a in (*engine.bank, *engine.shared)]
    random = np.random.default_rng(seed)
    begun = time.process_time()
    found = np.empty((wanted, len(RISKS), 2))
    for k in range(wanted):
        for array, before in zip((*engine.bank, *engine.shared), untouched, strict=True):  # a fresh filter
            array[...] = before
        found[k] = judge(engine, through[k % len(through)], random)
    used = time.process_time() - begun
    print(f"{words}: {wanted:,} epochs, each of a run of its own, {used:.0f} s of CPU")
    for j, risk in enumerate(RISKS):
        error, level = np.abs(found[:, j, 0]), found[:, j, 1]
        known = np.isfinite(level)
        over = int((error[known] > level[known]).sum())
        low, high = binomial_bounds(over, int(known.sum()))
        print(
            f"  at {risk:g}: {np.median(level[known]):5.2f} m in the median, exceeded {over:,} of {int(known.sum()):,} "
            f"({over / known.sum():.4%}; 95 %: {low:.4%} to {high:.4%}); on another track {np.mean(~known):.2%}"
        )
    error = found[:, 0, 0]
    print(
        f"  error along the track {np.sqrt(np.nanmean(error**2)):.2f} m RMS, worst {np.nanmax(np.abs(found[:, :, 0])):.1f} m"
    )


def main() -> None:
    """Count and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=12_000)
    parser.add_argument("--full", action="store_true", help="300,000 epochs")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    wanted = 300_000 if options.full else options.epochs
    line = demo_line()
    through = ways(line)
    print("simulated: protection level along the track, GNSS 1.5 m + odometer")
    count(line, through, TOLD, wanted, options.seed, "told of its sensors")
    count(line, through, Settings(), max(wanted // 10, 1), options.seed + 1, "not told")


if __name__ == "__main__":
    main()
