"""Store of a reference track model: size, time and memory for 1,000 km at 1 m knots.

Run `python benchmarks/store.py [--km 1000] [--tracks 100] [--postgis] [--json PATH]`. Writing and reading run in processes of their own,
so that the peak of memory is theirs alone. The model is synthetic: every column holds digits of its own, as surveyed track
does, so nothing shrinks to one value but the cant of straight track.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from railnav.geodesy.grid import choose_frame
from railnav.io.geopackage import read_model, write_model
from railnav.track.model import MilePosts, Nodes, TrackModel


def synthetic_model(km: float, tracks: int, *, seed: int = 1, spacing: float = 1.0) -> TrackModel:
    """Parallel winding tracks one after another, joined end to end."""
    random = np.random.default_rng(seed)
    each = round(km * 1000 / tracks / spacing) + 1
    total = each * tracks
    offset = np.tile(np.arange(each) * spacing, tracks)
    along = np.arange(total) * spacing
    curvature = 1e-3 * np.sin(along / 700.0) + random.normal(0, 1e-6, total)
    bearing = 0.7 * (1 - np.cos(along / 700.0)) + random.normal(0, 1e-6, total)
    easting = 4_500_000 + np.cumsum(np.sin(bearing)) * spacing / 4
    northing = 5_260_000 + np.cumsum(np.cos(bearing)) * spacing / 4
    height = 120 + 20 * np.sin(along / 5000.0) + random.normal(0, 1e-3, total)
    covariance = np.tile([1e-4, 0.0, 0.0, 1e-4, 0.0, 4e-4], (total, 1)) * random.uniform(1, 2, (total, 1))
    covariance[:, [1, 2, 4]] = random.normal(0, 1e-5, (total, 3))
    knot_start = np.arange(tracks + 1) * each
    ends = np.append(knot_start[:-1], total - 1)
    index = np.arange(tracks)
    return TrackModel(
        frame=choose_frame(np.radians(47.5), np.radians(21.0)),
        track_id=tuple(f"T{i:05d}" for i in index),
        line=("80",) * tracks,
        name=("",) * tracks,
        start_node=index,
        end_node=index + 1,
        knot_start=knot_start,
        offset=offset,
        easting=easting,
        northing=northing,
        height=height,
        grid_bearing=bearing,
        curvature=curvature,
        gradient=np.gradient(height, spacing),
        cant=np.where(np.abs(curvature) > 5e-4, curvature * 100, 0.0),
        scale=1.0 + random.normal(0, 1e-7, total),
        covariance_g=covariance,
        nodes=Nodes(
            tuple(f"N{i:05d}" for i in range(tracks + 1)),
            np.zeros(tracks + 1, np.int64),
            easting[ends],
            northing[ends],
            height[ends],
        ),
        movements=np.column_stack([index[:-1], np.ones(tracks - 1), index[1:], np.zeros(tracks - 1)]).astype(np.int64),
        mileposts=MilePosts(index, np.zeros(tracks), index * each * spacing),
        provenance={"made_by": "benchmarks/store.py", "seed": seed},
    )


def peak_mb() -> float:
    """Peak resident memory of this process, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _child(task: str, path: Path | str, km: float, tracks: int) -> dict[str, float]:
    if task == "write":
        model = synthetic_model(km, tracks)
        before = peak_mb()
        start = time.perf_counter()
        write_model(model, path)
        return {"write_s": time.perf_counter() - start, "write_extra_mb": max(0.0, peak_mb() - before)}
    before = peak_mb()
    start = time.perf_counter()
    model = read_model(path)
    first = time.perf_counter() - start
    peak = peak_mb()
    start = time.perf_counter()
    read_model(path)
    return {
        "load_s": first,
        "load_again_s": time.perf_counter() - start,
        "peak_mb": peak,
        "imports_mb": before,
        "knots": float(len(model.offset)),
    }


def measure(km: float, tracks: int) -> dict[str, float]:
    """Write and read in processes of their own."""
    result: dict[str, float] = {"km": km, "tracks": tracks}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.gpkg"
        for task in ("write", "read"):
            command = [
                sys.executable,
                __file__,
                "--task",
                task,
                "--path",
                str(path),
                "--km",
                str(km),
                "--tracks",
                str(tracks),
            ]
            result |= json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
        result["file_mb"] = path.stat().st_size / 1e6
    return result


def measure_postgis(km: float, tracks: int) -> dict[str, float | str]:
    """The same in a PostGIS store, by the server that the tests start."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "io"))
    from postgres_server import NoServer, running_server

    result: dict[str, float | str] = {"postgis_note": "fsync off, as the tests run it"}
    with contextlib.ExitStack() as stack:
        try:
            server = stack.enter_context(running_server())
        except NoServer as why:
            return {"postgis_note": str(why)}
        for task in ("write", "read"):
            command = [sys.executable, __file__, "--task", task, "--address", f"{server}?model=bench"]
            command += ["--km", str(km), "--tracks", str(tracks)]
            done = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
            result |= {f"postgis_{key}": value for key, value in done.items()}
    return result


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--km", type=float, default=1000.0)
    parser.add_argument("--tracks", type=int, default=100)
    parser.add_argument(
        "--postgis", action="store_true", help="also in a PostGIS store, by a server that is started for it"
    )
    parser.add_argument("--address", help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--task", choices=("write", "read"), help=argparse.SUPPRESS)
    parser.add_argument("--path", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.task:
        where = options.address or options.path
        print(json.dumps(_child(options.task, where, options.km, options.tracks)))
        return
    result = measure(options.km, options.tracks)
    print(f"{result['knots']:,.0f} knots on {result['tracks']:.0f} tracks")
    print(f"file    {result['file_mb']:8.1f} MB   (goal 250)")
    print(f"load    {result['load_s']:8.2f} s    (goal 2; {result['load_again_s']:.2f} s once libraries are warm)")
    print(
        f"memory  {result['peak_mb']:8.0f} MB   (goal 400; of the process, {result['imports_mb']:.0f} of it libraries)"
    )
    print(f"write   {result['write_s']:8.2f} s    ({result['write_extra_mb']:.0f} MB more than the model)")
    if options.postgis:
        result |= measure_postgis(options.km, options.tracks)
        print(f"PostGIS, a server of its own on the loopback ({result['postgis_note']})")
        print(
            f"load    {result['postgis_load_s']:8.2f} s    (goal 5; GeoPackage {result['load_s']:.2f} s in the same run)"
        )
        print(f"memory  {result['postgis_peak_mb']:8.0f} MB   (of the reading process)")
        print(f"write   {result['postgis_write_s']:8.2f} s    (one version)")
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
