"""The square-root chain against banded normal equations, its cost by length, and the memory of the filter.

Run `python benchmarks/chain.py [--json PATH] [--pairs 15] [--longest 10000000]`; 20 s, and 5 GB where the longest chain is stored.
One core: the thread pools are held to one, times are CPU seconds, the two ways alternate, medians are compared. The peer is
`railnav.estimation.oracle.banded_solution`: scipy.linalg.solveh_banded with the band built by vectorised numpy in the fastest way
we found (2.2 times faster than stacked 3 x 3 products). Both start from the same whitened rows; whitening is timed apart.
"""

# ruff: noqa: E402 - the thread pools read the environment when numpy is imported

from __future__ import annotations

import os

for _pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_pool] = "1"

import argparse
import json
import platform
import resource
import statistics
import sys
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from railnav.estimation import (
    Chain,
    ChainFilter,
    CorrelatedError,
    IncrementDrift,
    constant_velocity_chain,
    increment_chain,
    inverse_root,
    solve_chain,
    survey_chain,
)
from railnav.estimation.oracle import banded_solution

#: Shape of the covariances where one serves for all epochs.
COVARIANCE = np.array([[1.2, 0.2, 0.1], [0.2, 1.4, -0.1], [0.1, -0.1, 1.6]])


def survey(epochs: int, *, every: int = 1, seed: int = 5) -> tuple[Chain, np.ndarray]:
    """Chain of corrections to nominal nodes, 2 cm fixes at every so many nodes, 1 mm increments; and the fixes' covariances."""
    rng = np.random.default_rng(seed)
    A = 0.2 * rng.standard_normal((epochs, 3, 3))
    spread = A @ np.swapaxes(A, 1, 2) + np.eye(3)
    K, KD = 4e-4 * spread, 1e-6 * spread[:-1]
    X = np.einsum("kij,kj->ki", np.linalg.cholesky(K), rng.standard_normal((epochs, 3)))
    dX = np.einsum("kij,kj->ki", np.linalg.cholesky(KD), rng.standard_normal((epochs - 1, 3)))
    X[np.arange(epochs) % every != 0] = np.nan
    return increment_chain(X, K, dX, KD), K


def cpu(call: Callable[[], Any]) -> float:
    """CPU seconds of one call."""
    begin = time.process_time()
    call()
    return time.process_time() - begin


def split(call: Callable[[], Any]) -> tuple[float, float]:
    """CPU seconds of one call: its own, and the system's (fresh pages of memory)."""
    before = resource.getrusage(resource.RUSAGE_SELF)
    call()
    after = resource.getrusage(resource.RUSAGE_SELF)
    return after.ru_utime - before.ru_utime, after.ru_stime - before.ru_stime


def pairs(first: Callable[[], Any], second: Callable[[], Any], count: int) -> tuple[list[float], list[float]]:
    """CPU seconds of two calls that take turns."""
    first(), second()
    times = [(cpu(first), cpu(second)) for _ in range(count)]
    return [a for a, _ in times], [b for _, b in times]


def against_banded(count: int) -> dict[str, Any]:
    """N = 3, 100,000 epochs: forward and smoothing against solveh_banded with its build."""
    out: dict[str, Any] = {"epochs": 100_000}
    for every in (1, 10):
        chain, K = survey(100_000, every=every)
        ours, theirs = pairs(
            lambda c=chain: solve_chain(c, covariance=False), lambda c=chain: banded_solution(c), count
        )
        gap = np.abs(solve_chain(chain, covariance=False).state - banded_solution(chain)).max()
        out[f"fix_every_{every}"] = {
            "chain_ms": round(1e3 * statistics.median(ours), 2),
            "banded_ms": round(1e3 * statistics.median(theirs), 2),
            "ratio": round(statistics.median(b / a for a, b in zip(ours, theirs, strict=True)), 2),
            "ratio_lowest": round(min(b / a for a, b in zip(ours, theirs, strict=True)), 2),
            "largest_difference_m": float(gap),
        }
    chain, K = survey(100_000)
    out["with_covariances_ms"] = round(
        1e3 * statistics.median(cpu(lambda: solve_chain(chain)) for _ in range(count)), 2
    )
    out["whitening_ms"] = round(1e3 * statistics.median(cpu(lambda: inverse_root(K)) for _ in range(count)), 2)
    return out


def six_states(count: int) -> dict[str, Any]:
    """N = 6: positions and velocities, fixes at every epoch."""
    rng = np.random.default_rng(6)
    N = 100_000
    chain = constant_velocity_chain(
        np.arange(N), rng.standard_normal((N, 3)), np.eye(3) + 0.1, acceleration_density=0.1
    )
    ours, theirs = pairs(
        lambda: solve_chain(chain, covariance=False), lambda: banded_solution(chain), max(count // 3, 3)
    )
    return {
        "epochs": N,
        "chain_ms": round(1e3 * statistics.median(ours), 2),
        "banded_ms": round(1e3 * statistics.median(theirs), 2),
        "ratio": round(statistics.median(b / a for a, b in zip(ours, theirs, strict=True)), 2),
        "largest_difference_m": float(
            np.abs(solve_chain(chain, covariance=False).state - banded_solution(chain)).max()
        ),
    }


def stored(longest: int) -> list[dict[str, float]]:
    """Cost of forward and smoothing by length; the rows are kept once, so that the store is the largest thing in memory."""
    rng = np.random.default_rng(7)
    out = []
    for epochs in [10**k for k in range(4, 8) if 10**k <= longest]:
        if epochs == 10**7 and available_gb() < 6.0:
            break
        X, dX = 0.02 * rng.standard_normal((epochs, 3)), 1e-3 * rng.standard_normal((epochs - 1, 3))
        chain = increment_chain(X, 4e-4 * COVARIANCE, dX, 1e-6 * COVARIANCE)
        del X, dX
        solve_chain(chain, covariance=False)
        user, system = zip(*(split(lambda c=chain: solve_chain(c, covariance=False)) for _ in range(5)), strict=True)
        out.append(
            {
                "epochs": epochs,
                "user_s": round(statistics.median(user), 4),
                "ns_per_epoch": round(1e9 * statistics.median(user) / epochs, 1),
                "system_s": round(statistics.median(system), 4),
            }
        )
    return out


def live(longest: int, *, block: int = 10_000) -> list[dict[str, float]]:
    """Cost and memory of the filter alone, fed in blocks that are used again and again."""
    rng = np.random.default_rng(8)
    H, L = inverse_root(4e-4 * COVARIANCE), inverse_root(1e-6 * COVARIANCE)
    z, u = rng.standard_normal((block, 3)), rng.standard_normal((block, 3))

    def run(epochs: int) -> None:
        filtering = ChainFilter(3, lag=10)
        filtering.sweep(H, z, -L, L, u[1:])
        for _ in range(epochs // block - 1):
            filtering.sweep(H, z, -L, L, u)
        filtering.estimate()

    run(block)
    out = []
    for epochs in [10**k for k in range(4, 8) if 10**k <= longest]:
        seconds = statistics.median(cpu(lambda e=epochs: run(e)) for _ in range(3))
        tracemalloc.start()
        run(epochs)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        out.append({"epochs": epochs, "cpu_s": round(seconds, 4), "ns_per_epoch": round(1e9 * seconds / epochs, 1),
                    "peak_kB": round(peak / 1e3)})  # fmt: skip
    return out


def one_epoch() -> dict[str, float]:
    """Latency of one live epoch through the Python door: couple, observe, estimate."""
    H, L, rng = 50.0 * np.eye(3), 1000.0 * np.eye(3), np.random.default_rng(9)
    filtering = ChainFilter(3, prior=(np.eye(3), np.zeros(3)))
    filtering.observe(H, np.zeros(3))
    times = []
    for _ in range(5000):
        u, z = rng.standard_normal((2, 3))
        begin = time.process_time()
        filtering.couple(-L, L, u)
        filtering.observe(H, z)
        filtering.estimate()
        times.append(time.process_time() - begin)
    return {
        "median_us": round(1e6 * float(np.median(times)), 1),
        "p99_us": round(1e6 * float(np.quantile(times, 0.99)), 1),
    }


def wide_states(count: int) -> list[dict[str, float]]:
    """Survey menus n = 6 (drifting increments) and n = 9 (and correlated fixes): microseconds an epoch, forward and smoothing."""
    rng = np.random.default_rng(10)
    N = 100_000
    X, dX = 0.02 * rng.standard_normal((N, 3)), 1e-3 * rng.standard_normal((N - 1, 3))
    drift = IncrementDrift(np.eye(3), [1e-3] * 3, [1e-5] * 3)
    out = []
    for error in (None, CorrelatedError(0.01, 300.0, 1.0)):
        chain = survey_chain(X, 4e-4 * COVARIANCE, dX, 1e-6 * COVARIANCE, drift=drift, correlated=error)
        solve_chain(chain, covariance=False)
        bare = statistics.median(cpu(lambda c=chain: solve_chain(c, covariance=False)) for _ in range(count))
        full = statistics.median(cpu(lambda c=chain: solve_chain(c)) for _ in range(count))
        out.append(
            {"n": chain.n, "us_per_epoch": round(1e6 * bare / N, 2), "with_covariances_us": round(1e6 * full / N, 2)}
        )
    return out


def against_gtsam(count: int) -> dict[str, Any] | None:
    """The same n = 3 chain as a batch of Jacobian factors in GTSAM, built and eliminated; None where it is not installed."""
    try:
        import gtsam
    except ImportError:
        return None
    epochs = 100_000
    chain, _ = survey(epochs)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    unit = gtsam.noiseModel.Unit.Create(3)

    def build() -> Any:
        graph = gtsam.GaussianFactorGraph()
        for k in range(epochs):
            graph.add(gtsam.JacobianFactor(k, chain.H[k], chain.z[k], unit))
        for k in range(epochs - 1):
            graph.add(gtsam.JacobianFactor(k, chain.M[k], k + 1, chain.L[k], chain.u[k], unit))
        return graph

    ordering = gtsam.Ordering()
    for k in range(epochs):
        ordering.push_back(k)
    building = [cpu(build) for _ in range(3)]
    graph = build()
    solving = [cpu(lambda: graph.optimize(ordering)) for _ in range(3)]
    answer = graph.optimize(ordering)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    state = solve_chain(chain, covariance=False).state
    gap = max(float(np.abs(answer.at(k) - state[k]).max()) for k in range(0, epochs, 997))
    ours = statistics.median(cpu(lambda: solve_chain(chain, covariance=False)) for _ in range(count))
    tracemalloc.start()
    solve_chain(chain, covariance=False)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    lean = statistics.median(cpu(lambda: solve_chain(chain, covariance=False, records=False)) for _ in range(count))
    tracemalloc.start()
    solve_chain(chain, covariance=False, records=False)
    lean_peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    built, solved = statistics.median(building), statistics.median(solving)
    return {
        "gtsam_build_ms": round(1e3 * built, 1),
        "gtsam_solve_ms": round(1e3 * solved, 1),
        "gtsam_memory_MB": round((after - before) / 1e3),
        "chain_ms": round(1e3 * ours, 2),
        "chain_memory_MB": round(peak / 1e6, 1),
        "without_records_ms": round(1e3 * lean, 2),
        "without_records_memory_MB": round(lean_peak / 1e6, 1),
        "ratio_solve": round(solved / ours, 1),
        "ratio_whole": round((built + solved) / ours, 1),
        "largest_difference_m": gap,
    }


def available_gb() -> float:
    """Memory that is free, GB, where the system says."""
    try:
        line = next(row for row in Path("/proc/meminfo").read_text().splitlines() if row.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return float("inf")
    return int(line.split()[1]) / 1e6


def main() -> None:
    """Measure, print tables, and write the figures where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--pairs", type=int, default=15)
    parser.add_argument("--longest", type=int, default=10_000_000)
    options = parser.parse_args()
    figures: dict[str, Any] = {
        "command": "python benchmarks/chain.py --json PATH",
        "machine": f"{platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}, one core",
    }
    figures["gtsam"] = against_gtsam(5)  # first: its memory is what the process grows by
    figures["banded_n3"] = against_banded(options.pairs)
    for every in (1, 10):
        row = figures["banded_n3"][f"fix_every_{every}"]
        print(
            f"n = 3, 100,000 epochs, fix every {every:2d}: chain {row['chain_ms']:.1f} ms, solveh_banded {row['banded_ms']:.1f} ms, "
            f"ratio {row['ratio']:.2f} (lowest pair {row['ratio_lowest']:.2f}), difference {row['largest_difference_m']:.1e} m"
        )
    print(f"       with all covariances {figures['banded_n3']['with_covariances_ms']:.1f} ms, "
          f"whitening {figures['banded_n3']['whitening_ms']:.1f} ms")  # fmt: skip
    figures["banded_n6"] = row = six_states(options.pairs)
    print(f"n = 6, 100,000 epochs: chain {row['chain_ms']:.1f} ms, solveh_banded {row['banded_ms']:.1f} ms, "
          f"ratio {row['ratio']:.2f}, difference {row['largest_difference_m']:.1e} m")  # fmt: skip
    figures["stored_n3"] = stored(options.longest)
    figures["filter_n3"] = live(options.longest)
    print("\n     epochs   forward + smoothing + pages        filter alone   filter's peak memory")
    forward = {row["epochs"]: row for row in figures["stored_n3"]}
    for row in figures["filter_n3"]:
        both = forward.get(row["epochs"])
        text = (
            f"{both['user_s']:9.4f} s {both['ns_per_epoch']:6.1f} ns + {both['system_s']:6.3f} s"
            if both
            else "  (not enough memory to store)     "
        )
        print(
            f"{row['epochs']:11,d} {text} {row['cpu_s']:9.4f} s {row['ns_per_epoch']:6.1f} ns {row['peak_kB']:9,d} kB"
        )
    figures["live_epoch_n3"] = row = one_epoch()
    print(f"\none live epoch through Python: median {row['median_us']} us, p99 {row['p99_us']} us (CPU)")
    figures["wide_states"] = wide_states(5)
    for row in figures["wide_states"]:
        print(f"survey menu n = {row['n']}: {row['us_per_epoch']:.2f} us an epoch, with all covariances "
              f"{row['with_covariances_us']:.2f} us (bars 1.5 and 3.5)")  # fmt: skip
    row = figures["gtsam"]
    if row is None:
        print("gtsam is not installed here: no comparison (pip install gtsam, Python 3.11)")
    else:
        print(
            f"gtsam, 100,000 epochs, n = 3: build {row['gtsam_build_ms']:.0f} ms, solve {row['gtsam_solve_ms']:.0f} ms, "
            f"{row['gtsam_memory_MB']} MB; chain {row['chain_ms']:.1f} ms, {row['chain_memory_MB']} MB: "
            f"{row['ratio_solve']:.0f} times faster than its solving, {row['ratio_whole']:.0f} than with its building; "
            f"difference {row['largest_difference_m']:.1e} m; without keeping records {row['without_records_ms']:.1f} ms, "
            f"{row['without_records_memory_MB']} MB"
        )
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n")
    worst = max(figures["banded_n3"][f"fix_every_{every}"]["largest_difference_m"] for every in (1, 10))
    sys.exit(0 if worst <= 1e-9 else "the two ways differ by more than 1e-9 m")


if __name__ == "__main__":
    main()
