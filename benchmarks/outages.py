"""A real drive with GNSS withheld: how far a loosely coupled IMU wanders, without odometer, constraints or smoothing.

Run `python benchmarks/outages.py [--data FOLDER] [--json PATH]`. Drive: a car with RTK at 4 Hz and a low-cost IMU at 100 Hz on the roof
(`gnss_imu_drive`), 549 s. RTK is withheld for some seconds in every period; the figure is the largest horizontal distance from the withheld
fixes in an outage, mean over outages, for three phases of the cuts. Gyro noise and instability were chosen on this drive: it is no test of
them, but of the mechanization and the filter.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from railnav.attitude import dcm_from_euler
from railnav.inertial import ImuNoise, InitialSigma, NavigationState, integrate_gnss, level, position_scale

DEGREE = np.pi / 180
#: As the recorder states: roll, pitch, yaw of the IMU, degrees; delay of its stamps, s; antenna against IMU, m.
MOUNTING, DELAY, LEVER_ARM = (180.0, -6.79, 185.35), 0.125, (0.0, -0.05, 0.0)
#: Start of the run, s of the day in UTC; GPS time is 18 s ahead.
RUN_START, LEAP = 19 * 3600 + 34 * 60, 18
NOISE = ImuNoise(3.0 * DEGREE / 60, 0.3 / 60, 200 * DEGREE / 3600, 0.02)
INITIAL = InitialSigma(np.full(3, 0.1), np.full(3, 0.05), np.array([1.0, 1.0, 10.0]) * DEGREE, 0.3 * DEGREE, 0.15)


@dataclass(frozen=True)
class Drive:
    """Samples and fixes on one clock, forward, right, down and north, east, down."""

    time: np.ndarray
    rate: np.ndarray
    force: np.ndarray
    fix_time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray


def read(folder: Path) -> Drive:
    """Read the drive; turning the logged axes by the transpose of the stated mounting levels the car at rest."""
    imu = np.genfromtxt(folder / "imu.csv", delimiter=",", skip_header=1)
    C = dcm_from_euler(*(np.array(MOUNTING) * DEGREE))
    rows = [line.split() for line in (folder / "gnss.pos").read_text().splitlines() if not line.startswith("%")]
    clock = np.array([[float(v) for v in row[1].split(":")] for row in rows]) @ [3600.0, 60.0, 1.0]
    g = np.array([[float(v) for v in row[2:]] for row in rows])
    good = g[:, 3] <= 2  # fixed or float
    position = np.column_stack([g[:, :2] * DEGREE, g[:, 2]])
    velocity = np.column_stack([g[:, 13], g[:, 14], -g[:, 15]])
    return Drive(
        imu[:, 0] - DELAY,
        imu[:, 1:4] @ C,
        imu[:, 4:] @ C,
        (clock - LEAP - RUN_START)[good],
        position[good],
        velocity[good],
    )


def worst_errors(drive: Drive, cut: float, period: float, phase: float, *, shift: float = 0.0) -> list[float]:
    """Largest horizontal error of each complete outage, m."""
    speed = np.hypot(drive.velocity[:, 0], drive.velocity[:, 1])
    off = drive.fix_time[np.argmax(speed > 0.3)] - 1.0  # still at rest
    moving = int(np.argmax(speed > 3.0))
    course = float(np.arctan2(drive.velocity[moving, 1], drive.velocity[moving, 0]))
    roll, pitch = level(drive.force[drive.time < off].mean(axis=0))
    use = drive.time > off
    time = drive.time[use] + shift
    here = int(np.searchsorted(drive.fix_time, time[0]))
    start = NavigationState.from_euler(*drive.position[here], roll=float(roll), pitch=float(pitch), heading=course)
    since = drive.fix_time - time[0] - 60.0 - phase  # a minute to settle
    hidden = (since > 0) & (np.mod(since, period) < cut)
    got = integrate_gnss(
        start,
        INITIAL,
        time,
        drive.rate[use],
        drive.force[use],
        NOISE,
        start_time=time[0] - 0.01,
        fix_time=drive.fix_time[~hidden],
        fix_position=drive.position[~hidden],
        fix_velocity_n=drive.velocity[~hidden],
        sigma_position=[0.02, 0.02, 0.02],
        sigma_velocity=[0.06, 0.06, 0.06],
        lever_arm_b=LEVER_ARM,
        gate=1e9,
    ).trajectory
    scale = position_scale(start)
    north = (np.interp(drive.fix_time, got.time, got.latitude) - drive.position[:, 0]) * scale[0]
    east = (np.interp(drive.fix_time, got.time, got.longitude) - drive.position[:, 1]) * scale[1]
    error, number = np.hypot(north, east), np.floor(since / period)
    whole = [n for n in np.unique(number[hidden]) if np.sum(hidden & (number == n)) > 0.9 * 4 * cut]
    return [float(error[hidden & (number == n)].max()) for n in whole]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    shared = Path(os.environ.get("RAILNAV_DATA", Path(__file__).parents[2] / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=shared / "gnss_imu_drive")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    if not options.data.is_dir():
        print(f"the drive is not here ({options.data}); set RAILNAV_DATA or --data")
        return
    drive, result = read(options.data), {}
    print(
        "largest horizontal error in an outage, m: mean over outages for three phases of the cuts, and the worst of all"
    )
    for shift in (0.0, -0.05):
        for cut, period in ((15.0, 45.0), (30.0, 60.0), (60.0, 120.0)):
            sets = [worst_errors(drive, cut, period, phase, shift=shift) for phase in (0.0, 15.0, 30.0)]
            means = [float(np.mean(s)) for s in sets]
            top = max(max(s) for s in sets)
            name = f"{cut:.0f} s in every {period:.0f} s, IMU stamps {shift * 1e3:+.0f} ms"
            print(f"{name:42}" + "".join(f"{m:9.2f}" for m in means) + f"   worst {top:7.2f}")
            result[name] = {"mean_m": means, "worst_m": top}
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
