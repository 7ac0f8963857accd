"""Strapdown integration: IMU samples a second on one core, with and without a filter, and the error of each scheme on a manoeuvre.

Run `python benchmarks/strapdown.py [--samples 500000] [--repeats 5] [--json PATH]`. Time is CPU time of this thread, so that a busy
machine does not count; the best of the repeats is given. The error is against the finest run of the third-order scheme.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from pathlib import Path

import numpy as np

from railnav.inertial._kernels import strapdown_kernel
from railnav.inertial.loose import ImuNoise, InitialSigma, integrate_gnss
from railnav.inertial.mechanization import GravityField, NavigationState, mechanize

SCHEMES = ("coning", "matrix", "euler", "predictor", "predictor_first_order")
#: Bar of the issue, samples/s.
BAR = 2e6
#: Bar of the fifteen-state square-root filter, samples/s with the covariance carried at each.
FILTER_BAR = 160e3


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
    """Samples a second of the loose closed loop at 100 Hz, by rate of the GNSS fixes."""
    h = 0.01
    rate, force = samples(n, h)
    t = np.arange(1, n + 1) * h
    start = NavigationState.from_euler(0.83, 0.37, 120.0, velocity_n=[30.0, 10.0, 0.0], heading=0.3)
    path = mechanize(start, h, rate, force)
    initial = InitialSigma(np.full(3, 2.0), np.full(3, 0.2), np.array([0.01, 0.01, 0.05]), 1e-4, 0.01)
    noise = ImuNoise(1e-4, 2e-3, 1e-4, 5e-3)
    result = {}
    for fixes_hz in (1, 5):
        k = np.arange(100 // fixes_hz, n, 100 // fixes_hz)
        place = np.column_stack([path.latitude[k], path.longitude[k], path.height[k]])
        best = np.inf
        for repeat in range(repeats + 1):
            begin = time.thread_time()
            integrate_gnss(
                start,
                initial,
                t,
                rate,
                force,
                noise,
                start_time=0.0,
                fix_time=t[k - 1],
                fix_position=place,
                fix_velocity_n=path.velocity_n[k],
                sigma_position=[1.5, 1.5, 3.0],
                sigma_velocity=[0.1, 0.1, 0.1],
            )
            if repeat:  # the first compiles
                best = min(best, time.thread_time() - begin)
        result[f"loose, GNSS {fixes_hz} Hz"] = n / best
    return result


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
    for name, rate in filtered.items():
        print(
            f"{name:24}{rate / 1e3:18.0f} thousand samples/s, covariance carried at each (bar {FILTER_BAR / 1e3:.0f})"
        )
    if options.json:
        result = {
            "samples_per_second": speed | filtered,
            "error_m": error,
            "machine": platform.processor() or platform.machine(),
        }
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
