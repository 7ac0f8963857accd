"""How long `railnav demo` takes: first as on a fresh machine (nothing compiled), then again; wall and CPU time.

python benchmarks/demo.py [--json]
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import railnav

LIMIT = 60.0


def run(folder: Path, output: str) -> dict[str, Any]:
    """One demo in a fresh process that imports the package from a folder."""
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    environment.pop("NUMBA_CACHE_DIR", None)
    before, begin = os.times(), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "railnav", "demo", "-o", output, "--json"],
        check=True,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    after, end = os.times(), time.perf_counter()
    facts = json.loads(done.stdout)
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return {
        "wall_s": round(end - begin, 1),
        "cpu_s": round(cpu, 1),
        "steps_s": facts["steps_s"],
        "page_bytes": (folder / facts["report"]).stat().st_size,
    }


def main() -> None:
    """Measure, and print words or one JSON object."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = Path(railnav.__file__).parent
        shutil.copytree(source, folder / "railnav", ignore=shutil.ignore_patterns("__pycache__"))
        figures = {"first time": run(folder, "first"), "again": run(folder, "second")}
    result = {"benchmark": "demo", "cores": os.cpu_count(), "limit_wall_s": LIMIT, "figures": figures}
    if "--json" in sys.argv[1:]:
        print(json.dumps(result, indent=2))
        return
    for label, figure in figures.items():
        print(
            f"{label:<12} {figure['wall_s']:6.1f} s wall {figure['cpu_s']:6.1f} s CPU, page {figure['page_bytes'] / 1e6:.1f} MB"
        )
        for step, seconds in figure["steps_s"].items():
            print(f"  {step:<44} {seconds:6.1f} s")
    print(f"limit        {LIMIT:6.1f} s wall, on {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
