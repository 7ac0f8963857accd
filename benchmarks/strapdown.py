"""Strapdown integration: IMU samples a second on one core, with and without a filter, and the error of each scheme on a manoeuvre.

Run `python benchmarks/strapdown.py [--samples 500000] [--repeats 5] [--json PATH]`. Time is CPU time of this thread, so that a busy
machine does not count; the best of the repeats is given. The error is against the finest run of the third-order scheme. The peer in the
same run is the conventional form of the fifteen-state filter, P = Phi P Phi^T + Q with dense matrices in numpy, around the same strapdown
step: published filters in Python are of its kind.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from pathlib import Path

import numpy as np

from railnav.inertial._kernels import strapdown_kernel
from railnav.inertial.aided import Fixes, Unknowns, VehicleMotion, integrate
from railnav.inertial.imu_noise import ImuNoise, InitialSigma
from railnav.inertial.mechanization import GravityField, NavigationState, mechanize

SCHEMES = ("coning", "matrix", "euler", "predictor", "predictor_first_order")
#: Bar, samples/s.
BAR = 2e6
#: Bars of the square-root filter by its states, samples/s with the covariance carried at each.
FILTER_BARS = {15: 160e3, 21: 70e3}


def samples(n: int, interval: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A train that pitches, rolls and turns, with sensor noise."""
    t = np.arange(n) * interval
    noise = np.random.default_rng(seed).normal(size=(2, n, 3))
    rate = np.stack([0.02 * np.sin(3 * t), 0.01 * np.cos(2 * t), 0.03 * np.sin(0.1 * t)], axis=-1) + 1e-3 * noise[0]
    force = np.stack([0.3 * np.sin(0.05 * t), 0.5 * np.sin(0.1 * t), -9.81 + 0.2 * np.sin(5 * t)], axis=-1)
    return rate, force + 0.02 * noise[1]


def speeds(n: int, repeats: int) -> dict[str, float]:
    """Samples a second: the kernel for each scheme, and the public function with its checks."""
    h = 0.005
    rate, force = samples(n, h)
    start = NavigationState.from_euler(0.83, 0.37, 120.0, velocity_n=[30.0, 10.0, 0.0], heading=0.3)
    interval, field = np.full(n, h), GravityField().flat()
    dtheta, dv = rate * h, force * h
    out = np.empty((n + 1, 10))
    out[0] = [start.latitude, start.longitude, start.height, *start.velocity_n, *start.quaternion_nb]
    result = {}
    for code, scheme in enumerate(SCHEMES):
        strapdown_kernel(code, dtheta[:10], dv[:10], interval[:10], field, out[:11])  # compile
        best = np.inf
        for _ in range(repeats):
            begin = time.thread_time()
            done = strapdown_kernel(code, dtheta, dv, interval, field, out)
            best = min(best, time.thread_time() - begin)
        if done != n:
            raise RuntimeError(f"{scheme} stopped at sample {done}")
        result[scheme] = n / best
    best = np.inf
    for _ in range(repeats):
        begin = time.thread_time()
        mechanize(start, h, rate, force)
        best = min(best, time.thread_time() - begin)
    result["mechanize()"] = n / best
    return result


def filter_speeds(n: int, repeats: int) -> dict[str, float]:
    """Samples a second of the closed loop at 100 Hz: states, GNSS rate, smoother."""
    h = 0.01
    rate, force = samples(n, h)
    t = np.arange(1, n + 1) * h
    start = NavigationState.from_euler(0.83, 0.37, 120.0, velocity_n=[30.0, 10.0, 0.0], heading=0.3)
    path = mechanize(start, h, rate, force)
    initial = InitialSigma(np.full(3, 2.0), np.full(3, 0.2), np.array([0.01, 0.01, 0.05]), 1e-4, 0.01)
    noise = ImuNoise(1e-4, 2e-3, 1e-4, 5e-3)
    scales = Unknowns(gyro_scale=1e-3, accelerometer_scale=1e-3, gyro_scale_walk=1e-5, accelerometer_scale_walk=1e-5)
    car = Unknowns(axle_arm=1.0, mounting=0.03, time_offset=0.1, antenna_arm=0.1)
    result = {}
    for name, fixes_hz, unknowns, wheels, smooth in (
        ("15 states, GNSS 1 Hz", 1, None, False, False),
        ("15 states, GNSS 5 Hz", 5, None, False, False),
        ("21 states, GNSS 1 Hz", 1, scales, False, False),
        ("21 states, GNSS 5 Hz", 5, scales, False, False),
        ("24 states, GNSS 5 Hz, wheels 10 Hz", 5, car, True, False),
        ("15 states, GNSS 5 Hz, smoothed", 5, None, False, True),
    ):
        k = np.arange(100 // fixes_hz, n, 100 // fixes_hz)
        place = np.column_stack([path.latitude[k], path.longitude[k], path.height[k]])
        fixes = Fixes(t[k - 1], place, [1.5, 1.5, 3.0], path.velocity_n[k], [0.1] * 3)  # type: ignore[arg-type]
        motion = VehicleMotion(t[10::10], sigma_lateral=1.0, sigma_vertical=1.0) if wheels else None
        best = np.inf
        for repeat in range(repeats + 1):
            begin = time.thread_time()
            integrate(
                start,
                initial,
                t,
                rate,
                force,
                noise,
                start_time=0.0,
                fixes=fixes,
                vehicle_motion=motion,
                unknowns=unknowns,
                smooth=smooth,
                gate=1e9,
            )
            if repeat:  # the first compiles
                best = min(best, time.thread_time() - begin)
        result[name] = n / best
    return result


def dense_speed(n: int) -> float:
    """Samples a second of the conventional covariance filter in numpy, without its updates."""
    from railnav.inertial._kernels import coning_step, error_transition_kernel

    h = 0.01
    rate, force = samples(n, h)
    start = NavigationState.from_euler(0.83, 0.37, 120.0, velocity_n=[30.0, 10.0, 0.0], heading=0.3)
    state = np.array([start.latitude, start.longitude, start.height, *start.velocity_n, *start.quaternion_nb])
    field, memory, Phi = GravityField().flat(), np.zeros(13), np.empty((15, 15))
    P = np.diag([1e-13, 1e-13, 4.0, *[0.04] * 3, 1e-4, 1e-4, 3e-3, *[1e-8] * 3, *[1e-4] * 3])
    Q = np.diag([0.0, 0.0, 0.0, *[4e-6] * 3, *[1e-8] * 3, *[3e-11] * 3, *[8e-8] * 3]) * h
    force_n = np.array([0.0, 0.0, -9.81])
    coning_step(state.copy(), memory.copy(), rate[0] * h, force[0] * h, h, field)  # compile
    error_transition_kernel(state, force_n, h, field, 600.0, 600.0, Phi)
    begin = time.thread_time()
    for k in range(n):
        error_transition_kernel(state, force_n, h, field, 600.0, 600.0, Phi)
        P = Phi @ P @ Phi.T + Q
        coning_step(state, memory, rate[k] * h, force[k] * h, h, field)
    return n / (time.thread_time() - begin)


def errors() -> dict[str, dict[str, float]]:
    """Position error after 20 s of turning at 10 m/s, m, by sampling interval; increments, or held samples for the first-order ones."""

    def rates(t: np.ndarray) -> np.ndarray:
        return np.stack([0.05 * np.cos(2 * t), 0.08 * np.sin(3 * t), 0.2 + 0.1 * np.sin(t)], axis=-1)

    def forces(t: np.ndarray) -> np.ndarray:
        return np.stack([0.5 * np.sin(t), 2 + 0.3 * np.cos(2 * t), -9.81 + 0.2 * np.sin(5 * t)], axis=-1)

    start = NavigationState(0.8523978627, 0.0367095102, 150.0, np.array([10.0, 0.0, 0.0]))
    node, weight = np.polynomial.legendre.leggauss(5)

    def end(scheme: str, dt: float) -> np.ndarray:
        t = np.arange(round(20.0 / dt)) * dt
        w, f = rates(t), forces(t)
        if scheme in ("coning", "matrix", "predictor"):
            inside = t[:, None] + dt * (node + 1) / 2
            w, f = ((g(inside) * weight[:, None] / 2).sum(axis=1) for g in (rates, forces))
        s = mechanize(start, dt, w, f, scheme=scheme).state()  # type: ignore[arg-type]
        return np.array([s.latitude * 6371669.6, s.longitude * 6390272.1 * np.cos(s.latitude), s.height])

    best = end("coning", 0.001)
    return {s: {f"{dt:g}": float(np.linalg.norm(end(s, dt) - best)) for dt in (0.04, 0.02, 0.01)} for s in SCHEMES}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=500_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    speed, error = speeds(options.samples, options.repeats), errors()
    print(f"{'scheme':24}{'million samples/s':>18}   error after 20 s at 25, 50, 100 Hz, m")
    for scheme, rate in speed.items():
        row = "  ".join(f"{e:9.2e}" for e in error.get(scheme, {}).values())
        print(f"{scheme:24}{rate / 1e6:18.2f}   {row}")
    print(f"bar: {BAR / 1e6:.0f} million samples/s a core")
    filtered = filter_speeds(max(1000, options.samples // 5), options.repeats)
    print(f"{'square-root filter, covariance at every sample':48}thousand samples/s")
    for name, rate in filtered.items():
        bar = FILTER_BARS.get(int(name.split()[0])) if "smoothed" not in name else None
        print(f"  {name:44}{rate / 1e3:12.0f}" + (f"   bar {bar / 1e3:.0f}" if bar else ""))
    dense = dense_speed(min(20_000, options.samples))
    ratio = filtered["15 states, GNSS 5 Hz"] / dense
    print(f"  {'peer: 15 states, covariance by numpy':44}{dense / 1e3:12.0f}   ratio {ratio:.0f}")
    if options.json:
        result = {
            "samples_per_second": speed | filtered,
            "error_m": error,
            "dense_numpy": dense,
            "machine": platform.processor() or platform.machine(),
        }
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
