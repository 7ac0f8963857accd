"""How long `railnav --help` takes: CPU time of a fresh process, the median of ten.

python benchmarks/startup.py [--json]
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time

LIMIT = 0.3
REPEATS = 10


def cpu_time(*arguments: str) -> tuple[float, float]:
    """CPU and wall time of one fresh interpreter, s."""
    before, begin = os.times(), time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    after, end = os.times(), time.perf_counter()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return cpu, end - begin


def main() -> None:
    """Measure, and print words or one JSON object."""
    figures = {}
    for name, arguments in {
        "python": ("-c", "pass"),
        "railnav --help": ("-m", "railnav", "--help"),
        "railnav navigate --help": ("-m", "railnav", "navigate", "--help"),
        "import railnav": ("-c", "import railnav"),
    }.items():
        cpu_time(*arguments)  # compiles the bytecode
        times = [cpu_time(*arguments) for _ in range(REPEATS)]
        figures[name] = {
            "cpu_s": round(statistics.median(cpu for cpu, _ in times), 4),
            "wall_s": round(statistics.median(wall for _, wall in times), 4),
        }
    result = {"benchmark": "startup", "repeats": REPEATS, "limit_cpu_s": LIMIT, "figures": figures}
    if "--json" in sys.argv[1:]:
        print(json.dumps(result, indent=2))
        return
    for name, figure in figures.items():
        print(f"{name:<26} {figure['cpu_s'] * 1e3:6.0f} ms CPU {figure['wall_s'] * 1e3:6.0f} ms wall")
    print(f"limit for railnav --help   {LIMIT * 1e3:6.0f} ms CPU")


if __name__ == "__main__":
    main()
