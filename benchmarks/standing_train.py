"""A real train before and after it starts: alignment at rest, noise of the IMU, speed by strapdown against GNSS.

Run `python benchmarks/standing_train.py`. Thirty seconds of a train (500 Hz IMU, 1 Hz GNSS with sigmas), which rests for some two seconds.
The data are not in the repository; without them the script says so.
"""

from __future__ import annotations

import csv
import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from railnav.attitude import dcm_from_euler
from railnav.inertial import (
    NavigationState,
    align_standing,
    mechanize,
    unit_noise,
)
from railnav.run import GnssStream, ImuStream, Run

DATA = Path(os.environ.get("RAILNAV_DATA", Path(__file__).parents[2] / "shared" / "data")) / "tud_train"
DEGREE = np.pi / 180
MILLI_G = 9.80665e-3


def table(name: str) -> list[list[str]]:
    with (DATA / name).open(encoding="utf-8") as stream:
        return list(csv.reader(stream))[1:]


def train() -> Run:
    x = np.array([[float(v) for v in row[1:]] for row in table("imu_processed_data.csv")])
    rows = table("gnss_processed_data.csv")
    latitude, longitude, height, speed, course, sigma = (
        np.array([float(row[k]) for row in rows]) for k in (1, 2, 3, 5, 6, 13)
    )
    gnss = GnssStream(
        np.arange(len(rows), dtype=float),
        latitude * DEGREE,
        longitude * DEGREE,
        height,
        speed=speed,
        course=course * DEGREE,
        sigma_speed=sigma,
    )
    imu = ImuStream(np.arange(1, len(x) + 1) * 0.002, x[:, 3:] * DEGREE, x[:, :3])
    return Run("tud", datetime(2018, 10, 24, tzinfo=UTC), imu=imu, gnss=gnss)


def main() -> None:
    if not DATA.is_dir():
        print("the real train is not here: set RAILNAV_DATA")
        return
    run = train()
    assert run.imu is not None
    assert run.gnss is not None
    assert run.gnss.speed is not None
    assert run.gnss.sigma_speed is not None
    got = align_standing(run, gyro_bias_sigma=30 * DEGREE / 3600, accelerometer_bias_sigma=2 * MILLI_G)
    a = got.alignment
    print(
        f"at rest from {got.begin:.2f} to {got.end:.2f} s: roll {a.roll / DEGREE:+.2f} +- {a.sigma_roll / DEGREE:.2f}, pitch "
        f"{a.pitch / DEGREE:+.2f} +- {a.sigma_pitch / DEGREE:.2f} deg; heading and latitude: {a.note.split(':')[0]}"
    )
    assert got.velocity_heading is not None
    assert got.sigma_velocity_heading is not None
    print(
        f"heading of the first motion by GNSS: {got.velocity_heading / DEGREE % 360:.1f} +- {got.sigma_velocity_heading / DEGREE:.1f} deg"
    )
    noise = unit_noise(run.imu, between=(0.0, got.end), terms=("quantisation", "random_walk"))
    for what, scale, unit in (("gyro", 60 / DEGREE, "deg/sqrt(h)"), ("accelerometer", 60.0, "m/s/sqrt(h)")):
        values = [noise.fits[f"{what} {axis}"].random_walk * scale for axis in "xyz"]
        print(f"{what} random walk over the rest: {values[0]:.3f}, {values[1]:.3f}, {values[2]:.3f} {unit}")
    print("(standing, engine running; two seconds show no floor)")
    # strapdown from the rest on: pitch and forward bias cannot be told apart at rest, so the mean of the first second is what stands
    still = run.imu.time <= 1.0
    bias_g = run.imu.gyro[still].mean(axis=0)
    C = dcm_from_euler(
        a.roll, float(np.arctan2(run.imu.specific_force[still].mean(axis=0)[0], 9.81)), got.velocity_heading
    )
    place = NavigationState.from_dcm(float(run.gnss.latitude[0]), float(run.gnss.longitude[0]), 625.0, C_nb=C)
    free = mechanize(place, 0.002, run.imu.gyro, run.imu.specific_force, gyro_bias=bias_g)
    speed = np.interp(run.gnss.time, free.time, np.hypot(*free.velocity_n[:, :2].T))
    e = speed - run.gnss.speed
    inside = run.gnss.time <= 30.0
    print(
        f"speed of the free strapdown against GNSS: rms {np.sqrt(np.mean(e[inside] ** 2)):.2f} m/s over 30 s, {e[inside][-1]:+.2f} at "
        f"the end (of {run.gnss.speed[inside][-1]:.2f}; GNSS sigma {np.median(run.gnss.sigma_speed):.2f})"
    )


if __name__ == "__main__":
    main()
