"""The source's integration experiments on simulated drives: architectures, GNSS errors that last, satellites in a canyon, fused filters.

Run `python benchmarks/integration.py [--seeds 3] [--quick] [--json PATH]`. Everything is simulated (`railnav.simulation.road`), IMU of the
IMU440 class; GNSS at 5 Hz with an error of which a part lasts; initial heading error 2 degrees, tilt 0.2 degrees (one sigma); variances of
GNSS positions times ten where said. Figures: mean of the squared horizontal error after 20 s, m^2. The published conditions leave out what
decides (how long GNSS errors last), so that ratios and orders are what can be held.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from railnav.attitude import dcm_from_rotation_vector
from railnav.geodesy.ellipsoid import WGS84
from railnav.inertial import (
    Fixes,
    GravityField,
    ImuNoise,
    InitialSigma,
    NavigationState,
    Ranges,
    Unknowns,
    VehicleMotion,
    integrate,
    position_scale,
)
from railnav.inertial.aided.fusion import fuse, switch_to_gnss
from railnav.inertial.aided.single_point import north_east_down, single_point
from railnav.inertial.aided.synchronisation import exponential_smoothing, trend_smoothing
from railnav.simulation.constellation import elevations, satellites
from railnav.simulation.road import RoadDrive, gnss_error, road_drive
from railnav.simulation.sensors import gauss_markov

DEGREE, G = np.pi / 180, 9.80665
FIELD = GravityField(free_air="linear")  # as the simulator
#: Switch-on bias of gyro and accelerometer; noise; B14.2.
GRADES = {
    "imu440": (36 * DEGREE / 3600, 2e-3 * G, ImuNoise(4.5 * DEGREE / 60, 1.0 / 60, 10 * DEGREE / 3600, 0.5e-3 * G)),
    "rt3003": (
        2 * DEGREE / 3600,
        1e-4 * G,
        ImuNoise(0.2 * DEGREE / 60, 0.005 / 60, 2 * DEGREE / 3600, 1e-5 * G, 1000.0, 1000.0),
    ),
}
H = 0.01


def imu(drive: RoadDrive, grade: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rate and specific force with the errors of a grade."""
    turn_on_g, turn_on_a, noise = GRADES[grade]
    n = len(drive.rate_ib_b)
    out = []
    for true, first, walk, sigma, tau in (
        (drive.rate_ib_b, turn_on_g, noise.angle_random_walk, noise.gyro_instability, noise.gyro_correlation_time),
        (
            drive.specific_force_b,
            turn_on_a,
            noise.velocity_random_walk,
            noise.accelerometer_instability,
            noise.accelerometer_correlation_time,
        ),
    ):
        slow = np.stack([gauss_markov(rng, n, H, sigma, tau) for _ in range(3)], axis=1)
        out.append(true + first * rng.normal(size=3) + slow + walk / np.sqrt(H) * rng.normal(size=(n, 3)))
    return out[0], out[1]


class Trial:
    """One drive with one seed: what all architectures are given."""

    def __init__(
        self,
        drive: RoadDrive,
        seed: int,
        *,
        variance: float,
        white: float = 0.7,
        tau: float = 30.0,
        inflate: float = 10.0,
        grade: str = "imu440",
        heading_error: float | None = None,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.drive, self.grade = drive, grade
        self.rate, self.force = imu(drive, grade, rng)
        here = NavigationState(float(drive.latitude[0]), float(drive.longitude[0]), float(drive.height[0]))
        self.scale = position_scale(here)
        self.k = np.arange(20, len(drive.time), 20)
        self.gnss_error = gnss_error(rng, len(self.k), 20 * H, variance=variance, white=white, correlation_time=tau)
        place = np.column_stack([drive.latitude, drive.longitude, drive.height])[self.k] + self.gnss_error / self.scale
        self.sigma = np.sqrt(variance / 2 * inflate) * np.array([1.0, 1.0, 2.0])
        velocity = drive.velocity_n[self.k] + 0.1 * rng.normal(size=(len(self.k), 3))
        self.fixes = Fixes(drive.time[self.k], place, self.sigma, velocity, [0.1] * 3)
        j = np.arange(10, len(drive.time), 10)
        self.motion = VehicleMotion(drive.time[j], drive.speed[j] + 0.05 * rng.normal(size=len(j)), 0.1, 0.1, 0.1)
        tilt = np.array([0.2, 0.2, 2.0]) * DEGREE * rng.normal(size=3)
        if heading_error is not None:
            tilt[2] = heading_error
        self.start = NavigationState.from_dcm(
            here.latitude,
            here.longitude,
            here.height,
            velocity_n=drive.velocity_n[0],
            C_nb=dcm_from_rotation_vector(-tilt) @ drive.attitude_nb[0],
        )
        bg, ba, self.noise = GRADES[grade]
        heading_sigma = max(3.0 * DEGREE, abs(heading_error or 0.0))
        attitude = np.array([0.3 * DEGREE, 0.3 * DEGREE, heading_sigma])
        self.initial = InitialSigma(np.array([2.0, 2.0, 3.0]), np.full(3, 0.1), attitude, bg, ba)

    def without(self, begin: float, end: float) -> Fixes:
        """Fixes outside an outage."""
        f = self.fixes
        keep = (f.time < begin) | (f.time >= end)
        assert f.velocity_n is not None
        return Fixes(f.time[keep], f.position[keep], self.sigma, f.velocity_n[keep], [0.1] * 3)

    def solve(self, **options: Any) -> Any:
        """Integrate with what is given."""
        return integrate(
            self.start,
            self.initial,
            self.drive.time[1:],
            self.rate,
            self.force,
            self.noise,
            start_time=0.0,
            gravity=FIELD,
            gate=1e9,
            **options,
        )

    def horizontal(self, trajectory: Any) -> np.ndarray:
        """North and east errors at all instants, m."""
        return self.drive.error(trajectory.latitude, trajectory.longitude)


def after(trial: Trial, error: np.ndarray, begin: float = 20.0) -> float:
    """Mean squared horizontal error at the instants of the fixes, m^2."""
    rows = trial.k[trial.drive.time[trial.k] > begin]
    return float((error[rows] ** 2).sum(axis=1).mean())


def correlated(seeds: int, duration: float) -> dict[str, Any]:
    """How much the gain depends on how long GNSS errors last (campus)."""
    drive = road_drive("campus", duration, interval=H)
    result = {}
    print(f"campus {duration:.0f} s: GNSS error model, GNSS and INS/GNSS m^2, ratio; figure of the specification; bar")
    for white, tau, inflate, own, bar in (
        (1.0, 30.0, 1.0, 0.009, 0.02),
        (0.7, 30.0, 1.0, 0.18, None),
        (0.7, 30.0, 10.0, 0.12, None),
        (0.5, 60.0, 10.0, 0.28, 0.30),
        (0.3, 100.0, 10.0, 0.47, 0.50),
    ):
        raw, closed = [], []
        for seed in range(seeds):
            trial = Trial(drive, seed, variance=8.8775, white=white, tau=tau, inflate=inflate)
            raw.append(float((trial.gnss_error[drive.time[trial.k] > 20, :2] ** 2).sum(axis=1).mean()))
            closed.append(after(trial, trial.horizontal(trial.solve(fixes=trial.fixes).trajectory)))
        name = f"{white:.0%} white, rest {tau:.0f} s, R x {inflate:.0f}"
        a, b = float(np.mean(raw)), float(np.mean(closed))
        print(f"  {name:32}{a:8.2f}{b:9.3f}{b / a:8.3f}{own:8.3f}" + (f"   bar {bar}" if bar else ""))
        result[name] = {"gnss_m2": a, "ins_gnss_m2": b, "ratio": b / a}
    return result


def architectures(kind: str, duration: float, seeds: int) -> dict[str, Any]:
    """Every scheme on one kind of drive."""
    drive = road_drive(kind, duration, interval=H)  # type: ignore[arg-type]
    variance = 8.8775 if kind == "campus" else 4.0
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for seed in range(seeds):
        trial = Trial(drive, seed, variance=variance)
        gap = trial.without(100.0, 160.0)

        def note(name: str, trajectory: Any, trial: Trial = trial) -> None:
            e = trial.horizontal(trajectory)
            turn = trajectory.euler()[2] - drive.heading
            yaw = (turn + np.pi) % (2 * np.pi) - np.pi
            late = drive.time > 60
            rows.setdefault(name, []).append(
                (after(trial, e), float(np.hypot(*e.T).max()), float(np.sqrt((yaw[late] ** 2).mean()) / DEGREE))
            )

        note("INS alone", trial.solve().trajectory)
        plain = switch_to_gnss(
            trial.start, drive.time[1:], trial.rate, trial.force, trial.fixes, start_time=0.0, gravity=FIELD
        )
        note("separate: GNSS, INS between", plain)
        note("INS + odometer", trial.solve(vehicle_motion=trial.motion).trajectory)
        note("loose, open loop", trial.solve(fixes=trial.fixes, closed_loop=False).trajectory)
        note("loose, closed loop", trial.solve(fixes=trial.fixes).trajectory)
        note("loose + odometer", trial.solve(fixes=trial.fixes, vehicle_motion=trial.motion).trajectory)
        note("loose, no GNSS 100 to 160 s", trial.solve(fixes=gap).trajectory)
        note("loose + odometer, same", trial.solve(fixes=gap, vehicle_motion=trial.motion).trajectory)
    print(f"{kind} {duration:.0f} s: mean squared error m^2, largest m, heading rms degrees")
    result = {}
    for name, values in rows.items():
        mean = np.mean(values, axis=0)
        print(f"  {name:32}{mean[0]:12.4g}{mean[1]:11.2f}{mean[2]:9.2f}")
        result[name] = {"mse_m2": mean[0], "largest_m": mean[1], "heading_deg": mean[2]}
    return result


def wheels_only(seeds: int, duration: float) -> dict[str, Any]:
    """120 s with GNSS, then none: INS and odometer (K5)."""
    drive = road_drive("campus", 120.0 + duration, interval=H)
    result = {}
    print(f"INS + odometer for {duration:.0f} s after 120 s of GNSS (campus): largest and last error, m")
    for grade in GRADES:
        largest, last = [], []
        for seed in range(seeds):
            trial = Trial(drive, seed, variance=8.8775, grade=grade)
            got = trial.solve(fixes=trial.without(120.0, 1e9), vehicle_motion=trial.motion)
            e = np.hypot(*trial.horizontal(got.trajectory).T)
            largest.append(float(e[drive.time > 120].max()))
            last.append(float(e[-1]))
        print(f"  {grade:10}" + "  ".join(f"{a:.2f}/{b:.2f}" for a, b in zip(largest, last, strict=True)))
        result[grade] = {"largest_m": largest, "last_m": last}
    return result


def canyon(seeds: int) -> dict[str, Any]:
    """A city street with only the k highest satellites for a minute: loose against tight (B7)."""
    drive = road_drive("city", 200.0, interval=0.02)
    result: dict[str, Any] = {}
    print(
        "a minute with k satellites (city, 1 Hz ranges 2 m, rates 0.05 m/s): largest horizontal error, m, mean over seeds"
    )
    for count in (3, 2, 1, 0):
        worst: dict[str, list[float]] = {"loose": [], "tight": []}
        for seed in range(1, seeds + 1):
            for name, value in canyon_trial(drive, seed, count).items():
                worst[name].append(value)
        means = {name: float(np.mean(v)) for name, v in worst.items()}
        print(f"  k = {count}: loose {means['loose']:7.1f}   tight {means['tight']:7.1f}")
        result[f"k={count}"] = means
    return result


def canyon_trial(drive: RoadDrive, seed: int, count: int) -> dict[str, float]:
    """Largest errors, loose and tight, with `count` satellites from 100 to 160 s."""
    h = 0.02
    rng = np.random.default_rng(seed)
    bg, ba, noise = GRADES["imu440"]
    n = len(drive.rate_ib_b)
    slow_g = np.stack([gauss_markov(rng, n, h, noise.gyro_instability, 600.0) for _ in range(3)], axis=1)
    slow_a = np.stack([gauss_markov(rng, n, h, noise.accelerometer_instability, 600.0) for _ in range(3)], axis=1)
    w = drive.rate_ib_b + bg * rng.normal(size=3) + slow_g
    f = drive.specific_force_b + ba * rng.normal(size=3) + slow_a
    w = w + noise.angle_random_walk / np.sqrt(h) * rng.normal(size=(n, 3))
    f = f + noise.velocity_random_walk / np.sqrt(h) * rng.normal(size=(n, 3))
    rows: list[tuple[float, ...]] = []
    stamps, places, speeds, sigma_p, sigma_v = [], [], [], [], []
    for j in range(50, n + 1, 50):
        t = float(drive.time[j])
        s, v = satellites(t + 20000.0)
        here = float(drive.latitude[j]), float(drive.longitude[j]), float(drive.height[j])
        elevation = elevations(s, *here)
        visible = np.flatnonzero(elevation > 10 * DEGREE)
        if 100 <= t < 160:
            visible = visible[np.argsort(-elevation[visible])][:count]
        x = np.array(WGS84.to_cartesian(*here)).ravel()
        C = north_east_down(here[0], here[1])
        line = x - s[visible]
        distance = np.linalg.norm(line, axis=1)
        rho = distance + 50.0 + t + 2.0 * rng.normal(size=len(visible))
        rate = np.einsum("ij,ij->i", line / distance[:, None], C.T @ drive.velocity_n[j] - v[visible]) + 1.0
        rate = rate + 0.05 * rng.normal(size=len(visible))
        rows += [(t, *s[i], *v[i], a, b) for i, a, b in zip(visible, rho, rate, strict=True)]
        if len(visible) >= 4:
            fix = single_point(s[visible], v[visible], rho, rate, start=x)
            root = np.sqrt(np.diagonal(fix.cofactor_n)[:3])
            stamps.append(t)
            places.append((fix.latitude, fix.longitude, fix.height))
            speeds.append(fix.velocity_n)
            sigma_p.append(2.0 * root)
            sigma_v.append(0.05 * root)
    table = np.array(rows)
    ranges = Ranges(table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7], table[:, 8], 2.0, 0.05)
    fixes = Fixes(np.array(stamps), np.array(places), np.array(sigma_p), np.array(speeds), np.array(sigma_v))
    start = NavigationState.from_dcm(
        float(drive.latitude[0]),
        float(drive.longitude[0]),
        float(drive.height[0]),
        velocity_n=drive.velocity_n[0],
        C_nb=dcm_from_rotation_vector(np.array([0.003, -0.003, 0.03])) @ drive.attitude_nb[0],
    )
    initial = InitialSigma(np.full(3, 3.0), np.full(3, 0.2), np.array([0.3, 0.3, 3.0]) * DEGREE, bg, ba)
    dark = (drive.time >= 100) & (drive.time <= 160)
    result = {}
    clock = Unknowns(clock_bias=100.0, clock_drift=10.0)
    for name, options in (("loose", {"fixes": fixes}), ("tight", {"ranges": ranges, "unknowns": clock})):
        got = integrate(
            start,
            initial,
            drive.time[1:],
            w,
            f,
            noise,
            start_time=0.0,
            gravity=FIELD,
            gate=1e9,
            **options,  # type: ignore[arg-type]
        )
        e = drive.error(got.trajectory.latitude, got.trajectory.longitude)
        result[name] = float(np.hypot(*e[dark].T).max())
    return result


def decentralised(seeds: int) -> dict[str, Any]:
    """Two filters fused at their outputs, by the source's rule and by covariance intersection, beside one filter of all (B9)."""
    result: dict[str, Any] = {}
    print("decentralised, 200 s: mean squared error m^2 and NEES/2 (1 if honest)")
    for kind, variance in (("city", 8.0), ("road", 4.0)):
        drive = road_drive(kind, 200.0, interval=H)  # type: ignore[arg-type]
        rows: dict[str, list[tuple[float, float]]] = {}
        for seed in range(seeds):
            trial = Trial(drive, seed, variance=variance, heading_error=1.5 * DEGREE)
            both = trial.solve(fixes=trial.fixes, vehicle_motion=trial.motion)
            use = trial.k[drive.time[trial.k] > 20]
            found = {}
            for name, got in (
                ("INS/GNSS", trial.solve(fixes=trial.fixes)),
                ("INS/odometer", trial.solve(vehicle_motion=trial.motion)),
                ("one filter", both),
            ):
                found[name] = trial.horizontal(got.trajectory)[use], got.sigma[use, :2] ** 2
            (ea, va), (eb, vb) = found["INS/GNSS"], found["INS/odometer"]
            Pa, Pb = va[:, :, None] * np.eye(2), vb[:, :, None] * np.eye(2)
            for name, rule in (
                ("fused, source's rule", "information"),
                ("fused, covariance intersection", "covariance_intersection"),
            ):
                out = fuse(ea, Pa, eb, Pb, method=rule)  # type: ignore[arg-type]
                found[name] = out.state, np.diagonal(out.covariance, axis1=1, axis2=2)
            raw = trial.gnss_error[drive.time[trial.k] > 20, :2]
            found["GNSS"] = raw, np.full_like(raw, variance / 2)
            for name, (e, v) in found.items():
                rows.setdefault(name, []).append(
                    (float((e**2).sum(axis=1).mean()), float((e**2 / v).sum(axis=1).mean() / 2))
                )
        for name, values in rows.items():
            mean = np.mean(values, axis=0)
            print(f"  {kind:6}{name:34}{mean[0]:10.3f}{mean[1]:8.2f}")
            result[f"{kind}, {name}"] = {"mse_m2": mean[0], "nees": mean[1]}
    return result


def smoothing_of_fixes() -> dict[str, Any]:
    """Exponential smoothing of 5 Hz GNSS on the road, without and with trend (B12)."""
    drive = road_drive("road", 200.0, interval=H)
    trial = Trial(drive, 2, variance=4.0)
    scale = trial.scale
    true = np.column_stack([drive.latitude, drive.longitude])[trial.k] * scale[:2]
    z = true + trial.gnss_error[:, :2]
    late = drive.time[trial.k] > 20
    result = {"GNSS": float((trial.gnss_error[late, :2] ** 2).sum(axis=1).mean())}
    for name, s in (
        ("a = 0.5", exponential_smoothing(z, 0.5)),
        ("a = 0.2", exponential_smoothing(z, 0.2)),
        ("a = 0.5, trend 0.3", trend_smoothing(z, 0.5, 0.3)),
        ("a = 0.2, trend 0.05", trend_smoothing(z, 0.2, 0.05)),
    ):
        result[name] = float(((s - true)[late] ** 2).sum(axis=1).mean())
    print("exponential smoothing of fixes at 18 m/s: m^2: " + ", ".join(f"{k} {v:.2f}" for k, v in result.items()))
    return result


def heading(seeds: int) -> dict[str, Any]:
    """From a heading error of 10 degrees (K7)."""
    drive = road_drive("campus", 600.0, interval=H)
    rows = []
    for seed in range(seeds):
        trial = Trial(drive, seed, variance=8.8775, heading_error=10 * DEGREE)
        row = []
        for options in ({"fixes": trial.fixes}, {"fixes": trial.fixes, "vehicle_motion": trial.motion}):
            turn = trial.solve(**options).trajectory.euler()[2] - drive.heading
            yaw = np.abs((turn + np.pi) % (2 * np.pi) - np.pi) / DEGREE
            row += [float(yaw[drive.time >= 35.0][0]), float(np.sqrt((yaw[drive.time > 400] ** 2).mean()))]
        rows.append(row)
    mean = np.mean(rows, axis=0)
    print(
        f"heading from 10 degrees off (campus): {mean[0]:.2f} degrees 30 s after moving off, rms {mean[1]:.2f} after 400 s; with odometer "
        f"{mean[2]:.2f}, {mean[3]:.2f} (bars 2, 1.2; 0.5)"
    )
    return {"after_30_s": mean[0], "rms": mean[1], "odometer_after_30_s": mean[2], "odometer_rms": mean[3]}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="one seed, shorter drives")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    seeds, long = (1, 200.0) if options.quick else (options.seeds, 600.0)
    result: dict[str, Any] = {"correlated": correlated(seeds, long)}
    for kind in ("campus", "city", "road"):
        result[kind] = architectures(kind, long if kind == "campus" else min(long, 300.0), seeds)
    result["wheels only"] = wheels_only(seeds, long)
    result["canyon"] = canyon(seeds)
    result["decentralised"] = decentralised(seeds)
    result["fixes smoothed"] = smoothing_of_fixes()
    result["heading"] = heading(seeds)
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
