"""A real drive with GNSS withheld: how far an aided IMU wanders, causal and smoothed, alone and held by what wheels can do.

Run `python benchmarks/outages.py [--data FOLDER] [--json PATH]`. Drive: a car with RTK at 4 Hz and a low-cost IMU at 100 Hz on the roof
(`gnss_imu_drive`), 549 s. RTK is withheld for some seconds in every period; the figure is the largest horizontal distance from the withheld
fixes in an outage, mean over outages, for three phases of the cuts, and the error over the stated sigma. Noise of gyro, accelerometer and
GNSS velocity was chosen on this drive: it is no test of them, but of mechanization, constraints and filter. What no noise makes up
(mounting, arms, time offset, scale factors, biases) is estimated, causally in the causal rows.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from railnav.attitude import dcm_from_euler
from railnav.inertial import (
    AidedSolution,
    Fixes,
    ImuNoise,
    InitialSigma,
    NavigationState,
    Unknowns,
    Vehicle,
    VehicleMotion,
    find_rests,
    integrate,
    level,
    position_scale,
)

DEGREE = np.pi / 180
#: As the recorder states: roll, pitch, yaw of the IMU, degrees; delay of its stamps, s; antenna against IMU, m.
MOUNTING, DELAY, LEVER_ARM = (180.0, -6.79, 185.35), 0.125, (0.0, -0.05, 0.0)
#: Start of the run, s of the day in UTC; GPS time is 18 s ahead.
RUN_START, LEAP = 19 * 3600 + 34 * 60, 18
NOISE = ImuNoise(5.0 * DEGREE / 60, 1.5 / 60, 250 * DEGREE / 3600, 0.015)
INITIAL = InitialSigma(np.full(3, 0.1), np.full(3, 0.05), np.array([1.0, 1.0, 10.0]) * DEGREE, 0.3 * DEGREE, 0.15)
SENSOR = {"time_offset": 0.1, "antenna_arm": 0.05, "gyro_scale": 0.01, "accelerometer_scale": 0.01}
CAR = {"axle_arm": 1.0, "mounting": 2.0 * DEGREE}
#: Steps between constraints, s; their sigma across and up, m/s; of GNSS positions, m, and velocities, m/s.
STEP, SLIDE, POSITION, VELOCITY = 0.1, 0.2, 0.03, 0.1
#: Cut, period, s.
CUTS = ((15.0, 45.0), (30.0, 60.0), (60.0, 120.0))
#: Bars for the first of them, m.
BARS = {"causal": 6.3, "causal, wheels": 4.8, "smoothed, wheels": 0.44}


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


def solve(drive: Drive, hidden: np.ndarray, *, wheels: bool, smooth: bool) -> AidedSolution:
    """The drive without the hidden fixes."""
    speed = np.hypot(drive.velocity[:, 0], drive.velocity[:, 1])
    off = drive.fix_time[np.argmax(speed > 0.3)] - 1.0  # still at rest
    moving = int(np.argmax(speed > 3.0))
    course = float(np.arctan2(drive.velocity[moving, 1], drive.velocity[moving, 0]))
    roll, pitch = level(drive.force[drive.time < off].mean(axis=0))
    use = drive.time > off
    time, rate, force = drive.time[use], drive.rate[use], drive.force[use]
    here = int(np.searchsorted(drive.fix_time, time[0]))
    start = NavigationState.from_euler(*drive.position[here], roll=float(roll), pitch=float(pitch), heading=course)
    fixes = Fixes(
        drive.fix_time[~hidden], drive.position[~hidden], [POSITION] * 3, drive.velocity[~hidden], [VELOCITY] * 3
    )
    motion = VehicleMotion(np.arange(time[0], time[-1], STEP), sigma_lateral=SLIDE, sigma_vertical=SLIDE)
    return integrate(
        start,
        INITIAL,
        time,
        rate,
        force,
        NOISE,
        start_time=float(time[0]) - 0.01,
        fixes=fixes,
        vehicle_motion=motion if wheels else None,
        rests=find_rests(time, rate, force) if wheels else None,
        vehicle=Vehicle(antenna_arm_b=LEVER_ARM),
        unknowns=Unknowns(**SENSOR, **(CAR if wheels else {})),
        smooth=smooth,
        gate={"fixes": 1e9, "vehicle": 25.0, "rests": 25.0},
    )


def cut(drive: Drive, length: float, period: float, phase: float) -> tuple[np.ndarray, np.ndarray]:
    """Which fixes are hidden, and the number of their outage; the first minute after the start is left to settle."""
    speed = np.hypot(drive.velocity[:, 0], drive.velocity[:, 1])
    begin = drive.fix_time[np.argmax(speed > 0.3)] - 1.0
    since = drive.fix_time - begin - 60.0 - phase
    return (since > 0) & (np.mod(since, period) < length), np.floor(since / period)


def worst_errors(
    drive: Drive, length: float, period: float, phase: float, **options: bool
) -> list[tuple[float, float]]:
    """Largest horizontal error of each complete outage, m, and that error over the stated sigma."""
    hidden, number = cut(drive, length, period, phase)
    got = solve(drive, hidden, **options)
    t, scale = got.trajectory.time, position_scale(got.trajectory.state(0))
    when = drive.fix_time + np.interp(drive.fix_time, t, got.parameters["time_offset"][:, 0])
    arm = np.einsum("kij,kj->ki", got.trajectory.C_nb, got.parameters["antenna_arm"] + LEVER_ARM)
    north = (np.interp(when, t, got.trajectory.latitude + arm[:, 0] / scale[0]) - drive.position[:, 0]) * scale[0]
    east = (np.interp(when, t, got.trajectory.longitude + arm[:, 1] / scale[1]) - drive.position[:, 1]) * scale[1]
    error = np.hypot(north, east)
    sigma = np.hypot(*(np.interp(when, t, got.sigma[:, i]) for i in range(2)))
    result = []
    for n in np.unique(number[hidden]):
        rows = np.flatnonzero(hidden & (number == n))
        if len(rows) > 0.9 * 4 * length:
            top = rows[np.argmax(error[rows])]
            result.append((float(error[top]), float(error[top] / sigma[top])))
    return result


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
    everything = solve(drive, np.zeros(len(drive.fix_time), dtype=bool), wheels=True, smooth=False)
    print("estimated with all fixes:")
    for name in ("time_offset", "antenna_arm", "axle_arm", "mounting"):
        value, sigma = everything.parameters[name][-1], everything.parameter_sigma[name][-1]
        print(f"  {name:12}" + "  ".join(f"{v:8.4f} +- {s:.4f}" for v, s in zip(value, sigma, strict=True)))
        result[name] = {"value": value.tolist(), "sigma": sigma.tolist()}
    print(
        "largest horizontal error in an outage, m: mean over outages for three phases of the cuts, of all, the worst; over sigma, rms"
    )
    for label, wheels, smooth in (
        ("causal", False, False),
        ("causal, wheels", True, False),
        ("smoothed", False, True),
        ("smoothed, wheels", True, True),
    ):
        for length, period in CUTS:
            sets = [worst_errors(drive, length, period, p, wheels=wheels, smooth=smooth) for p in (0.0, 15.0, 30.0)]
            means = [float(np.mean([e for e, _ in s])) for s in sets]
            every = np.array([pair for s in sets for pair in s])
            name = f"{label}, {length:.0f} s in every {period:.0f} s"
            whole, top, over = every[:, 0].mean(), every[:, 0].max(), np.sqrt((every[:, 1] ** 2).mean())
            bar = f"   bar {BARS[label]}" if length == CUTS[0][0] and label in BARS else ""
            print(f"{name:38}" + "".join(f"{m:8.2f}" for m in [*means, whole, top]) + f"   {over:5.2f}{bar}")
            result[name] = {
                "mean_m": means,
                "mean_of_all_m": float(whole),
                "worst_m": float(top),
                "over_sigma": float(over),
            }
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
