"""A day on the line, simulated: sensor epochs a second of one core, and whether the navigator's memory stays flat.

    python benchmarks/endurance.py [--hours 24] [--json PATH]

One out-and-back ride (100 Hz IMU, 10 Hz odometer, 1 Hz GNSS; simulated) is repeated through one and the same navigator, clock and odometer
running on: 8.6 million IMU epochs in 24 hours. The IMU is averaged between odometer readings, as always. Times are CPU seconds.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path

import numpy as np

import railnav as rn
from railnav.navigation import Mode, Settings
from railnav.navigation import columns as c
from railnav.navigation.engine import Engine
from railnav.navigation.epochs import raw_table
from railnav.simulation import SERVICE, Leg, simulate


def main() -> None:
    """Print the figures, and write them where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--json", type=Path, metavar="PATH")
    options = parser.parse_args()
    line = rn.demo_line()
    legs = [Leg(("77R-03",), start=500.0, finish=8500.0, dwell=20.0), Leg(("77R-03",), finish=500.0, dwell=20.0)]
    run, truth = simulate(line, legs, seed=1, outfit=SERVICE, tunnels=False)
    assert run.imu is not None
    assert run.gnss is not None
    assert run.odometer is not None
    assert run.odometer.distance is not None
    length, way = float(truth.time[-1]) + 0.1, float(run.odometer.distance[-1])
    engine = Engine(
        line,
        Settings(),
        imu=True,
        odometer="distance",
        speed=True,
        signed_odometer=False,
        lever_arm_b=run.gnss.lever_arm_b,
        integrity_risk=1e-4,
    )
    rides = max(2, round(options.hours * 3600.0 / length))
    sensor_epochs = len(run.imu) + len(run.odometer) + len(run.gnss)
    begin, early, lost, rows, elsewhere, squares = 0.0, 0, 0, 0, 0, 0.0
    for ride in range(rides):
        if ride == 1:  # the first compiles
            begin = time.process_time()
        raw = raw_table(run)
        table = engine.table(raw)
        table[:, c.TIME] += ride * length
        table[:, c.DISTANCE] += ride * way
        out = np.empty((len(table), c.OUTPUT_SIZE))
        engine.advance(table, out)
        rows += len(table) if ride > 0 else 0
        lost += int(np.isin(out[:, c.OUT_MODE], (Mode.LOST, Mode.OFF_MODEL)).sum())
        if ride:
            k = np.clip(np.searchsorted(truth.time, raw[:, 0] + 1e-4) - 1, 0, len(truth.time) - 1)
            right = out[:, c.OUT_TRACK] == truth.track[k]
            elsewhere += int((~right).sum())
            squares += float(np.sum((out[right, c.OUT_OFFSET] - truth.offset[k][right]) ** 2))
        if ride == max(1, rides // 20):
            early = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = time.process_time() - begin
    rms = float(np.sqrt(squares / max(rows - elsewhere, 1)))
    late = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    figures = {
        "rides": rides,
        "imu_epochs": rides * len(run.imu),
        "sensor_epochs_per_s": round((rides - 1) * sensor_epochs / seconds),
        "rows_per_s": round(rows / seconds),
        "cpu_s": round(seconds, 1),
        "memory_mb": [round(early / 1024), round(late / 1024)],
        "rows_lost": lost,
        "rows_elsewhere": elsewhere,
        "along_rms_m": round(rms, 3),
    }
    print(
        f"simulated: {rides} rides, {figures['imu_epochs']:,} IMU epochs ({options.hours:g} h at 100 Hz) with odometer and GNSS in "
        f"{seconds:.1f} s of CPU: {figures['sensor_epochs_per_s']:,} sensor epochs/s, "
        f"{figures['rows_per_s']:,} rows of solution/s (bar for either: 200,000)\n"
        f"greatest memory of the process after a twentieth of the way {early / 1024:.0f} MB, at the end {late / 1024:.0f} MB; "
        f"{lost} rows lost, {elsewhere} of {rows:,} on another track or none, error along {rms:.2f} m RMS on the right one"
    )
    if options.json:
        options.json.write_text(json.dumps({"simulated": True, **figures}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
