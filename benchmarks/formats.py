"""How true networks of other programs go in, and come back after going out: OpenStreetMap, LandXML, axis tables, railML, elements.

python benchmarks/formats.py [--json] [--data ../shared/data]

Real files where they are; each import in a fresh process, with its CPU time and peak memory. Round trips take the models so read, write
them in each format, read them again and compare every metre of every track.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SBB, MANNHEIM, COLOGNE = (
    "sbb/zuerich-winterthur.landxml.xml",
    "mannheim/mannheim_tracks.csv",
    "osm/cologne-railway.osm.pbf",
)


def read(name: str, data: Path) -> Any:
    """One of the real networks as a model."""
    if name == "cologne":
        from railnav.io.osm import read_osm

        return read_osm(data / COLOGNE)
    if name == "sbb":
        from railnav.io.landxml import read_landxml

        return read_landxml(data / SBB, crs="EPSG:2056")
    from railnav.io.axis_table import read_axis_table

    return read_axis_table(data / MANNHEIM, crs="EPSG:31467")


def defects(model: Any) -> dict[str, int]:
    """What validate finds, by kind; remarks apart."""
    from railnav.track.validation import validate

    return dict(Counter(f"{d.kind}{' (remark)' if d.remark else ''}" for d in validate(model)))


def cologne(model: Any, data: Path) -> dict[str, Any]:  # noqa: ARG001 - all measures look alike
    told = model.provenance["import"]
    ends: dict[int, int] = Counter([*model.start_node.tolist(), *model.end_node.tolist()])
    partners: dict[tuple[int, int], int] = Counter()
    for a, end_a, b, end_b in model.movements.tolist():
        partners[a, end_a] += 1
        partners[b, end_b] += 1
    at: dict[int, list[int]] = {}
    for t in range(len(model.track_id)):
        at.setdefault(int(model.start_node[t]), []).append(partners[t, 0])
        at.setdefault(int(model.end_node[t]), []).append(partners[t, 1])
    three = [sorted(at[node]) for node, count in ends.items() if count == 3]
    return {
        "km": round(float(model.lengths.sum()) / 1e3, 1),
        "tracks": len(model.track_id),
        "switches": told["switches"],
        "junctions": told["junctions"],
        "turnouts": len(three),
        "turnouts_with_lawful_movements": sum(counts == [1, 1, 2] for counts in three),
        "corners_left": told["corners"],
        "electrified_km": told["electrified_km"],
        "gauge_km": told["gauge_km"],
        "tunnels": len(model.provenance["tunnels"]),
        "defects": defects(model),
    }


def sbb(model: Any, data: Path) -> dict[str, Any]:
    """Joints, profile and cant against the file's own figures, distance of the two main tracks."""
    told = model.provenance["import"]
    text = (data / SBB).read_text(encoding="utf-8-sig")
    first = text.split('<Alignment name="A50068A"')[0]
    track = "A50034A.1"
    end = float(model.at(track, model.length(track)).chainage)
    offset = np.linspace(0.0, model.length(track), 200_000)
    station = model.at(track, offset).chainage

    def at(where: float) -> float:
        return float(np.interp(where, station, offset))

    cant = [
        abs(abs(float(model.at(track, at(float(s))).cant)) * 1e3 - float(mm))
        for s, mm in re.findall(r'<CantStation station="([\d.]+)" appliedCant="([\d.]+)"', first)
        if 1.0 < float(s) < end - 1.0
    ]
    heights = vertical_misfits(first, model, track, at, end)
    apart = []
    for name in [track for track in model.track_id if track.startswith("A50034A")]:
        for where in np.arange(0.0, model.length(name), 10.0):
            point = model.at(name, where)
            near = model.locate(float(point.easting), float(point.northing), within=12.0)
            near = [c for c in near if c.track.startswith("A50068A")]
            apart += [near[0].distance] if near else []
    return {
        "largest_joint_mm": round(told["largest_gap_m"] * 1e3, 3),
        "cant_stations": len(cant),
        "largest_cant_misfit_mm": round(max(cant), 4) if cant else None,
        "profile_points": len(heights),
        "largest_height_misfit_mm": round(max(heights) * 1e3, 3) if heights else None,
        "main_tracks_apart_m_quartiles": [round(float(v), 3) for v in np.quantile(apart, [0.25, 0.5, 0.75])],
        "defects": defects(model),
    }


def vertical_misfits(text: str, model: Any, track: str, at: Callable[[float], float], end: float) -> list[float]:
    """How far heights lie from the file's tangents where its circles begin and end, and at its corners, m."""
    found = re.findall(r"<(PVI|CircCurve)([^>]*)>\s*(-?[\d.]+)\s+(-?[\d.]+)", text.split("</ProfAlign>")[0])
    station = np.array([float(s) for _, _, s, _ in found])
    height = np.array([float(h) for _, _, _, h in found])
    slope = np.diff(height) / np.diff(station)
    off = []
    for i, (kind, words, _, _) in enumerate(found):
        if kind == "PVI":
            places = [(station[i], height[i])]
        else:
            radius = float(re.search(r'radius="([\d.]+)"', words)[1])  # type: ignore[index]
            a, b = np.arctan(slope[i - 1 : i + 1])
            tangent = radius * abs(np.tan((b - a) / 2.0))
            places = [
                (station[i] - tangent * np.cos(a), height[i] - tangent * np.sin(a)),
                (station[i] + tangent * np.cos(b), height[i] + tangent * np.sin(b)),
            ]
        off += [abs(float(model.at(track, at(float(s))).height) - float(h)) for s, h in places if 1.0 < s < end - 1.0]
    return off


def mannheim(model: Any, data: Path) -> dict[str, Any]:
    """Every row of the table against the model, and the ends against its nodes."""
    with (data / MANNHEIM).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    point = np.array([[float(r["rw"]), float(r["hw"])] for r in rows])
    off = []
    for east, north in point:
        near = model.locate(float(east), float(north), within=1.0)
        off.append(near[0].distance if near else 1.0)
    names = [r["n"] for r in rows]
    edge = [
        i for i in range(len(rows)) if i in (0, len(rows) - 1) or names[i - 1] != names[i] or names[i + 1] != names[i]
    ]
    nodes = np.column_stack([model.nodes.easting, model.nodes.northing])
    apart = np.array([np.hypot(*(nodes - point[i]).T).min() for i in edge])
    return {
        "rows": len(rows),
        "largest_row_misfit_mm": round(max(off) * 1e3, 3),
        "ends": len(edge),
        "node_misfit_mm_median_95_max": [round(float(v) * 1e3, 3) for v in np.quantile(apart, [0.5, 0.95, 1.0])],
        "joined_by_projection": len(model.provenance["import"]["joined"]),
        "defects": defects(model),
    }


MEASURES: dict[str, Callable[[Any, Path], dict[str, Any]]] = {"cologne": cologne, "sbb": sbb, "mannheim": mannheim}


def round_trips(model: Any) -> dict[str, Any]:
    """Greatest difference in plan, height, cant and length after writing and reading, m, and movements lost or won."""
    from railnav.io.elements import read_elements
    from railnav.io.elements_writer import write_elements
    from railnav.io.geojson import read_geojson, write_geojson
    from railnav.io.landxml import read_landxml
    from railnav.io.landxml_writer import write_landxml
    from railnav.io.railml import read_railml
    from railnav.io.railml_writer import write_railml

    found = {}
    crs = model.frame.crs_wkt
    ways: dict[str, tuple[str, Callable[[Any, Path], Any], Callable[[Path], Any]]] = {
        "LandXML": ("a.xml", write_landxml, read_landxml),
        "railML": ("a.railml", write_railml, read_railml),
        "elements": ("a.csv", write_elements, lambda p: read_elements(p, crs=crs)),
        "GeoJSON": ("a.geojson", write_geojson, lambda p: read_geojson(p, crs=crs)),
    }
    with tempfile.TemporaryDirectory() as folder:
        for name, (file, write, again) in ways.items():
            path = Path(folder, file)
            write(model, path)
            back = again(path)
            worst = np.zeros(4)
            lost = 0
            for track in model.track_id:
                if track not in back.track_id:
                    lost += 1
                    continue
                length = min(model.length(track), back.length(track))
                where = np.linspace(0.0, length, max(3, int(length)))
                p, q = model.at(track, where), back.at(track, where)
                off = [
                    float(np.hypot(p.easting - q.easting, p.northing - q.northing).max()),
                    float(np.nan_to_num(np.abs(p.height - q.height)).max()),
                    float(np.abs(p.cant - q.cant).max()),
                    abs(model.length(track) - back.length(track)),
                ]
                worst = np.maximum(worst, off)
            found[name] = {
                "plan_mm": round(worst[0] * 1e3, 3),
                "height_mm": round(worst[1] * 1e3, 3),
                "cant_mm": round(worst[2] * 1e3, 3),
                "length_mm": round(worst[3] * 1e3, 3),
                "movements": f"{len(back.movements)} of {len(model.movements)}",
                "tracks_renamed": lost,
                "mb": round(path.stat().st_size / 1e6, 1),
            }
    return found


def one(name: str, data: Path) -> None:
    """Measure in this process, and print JSON."""
    began = time.process_time()
    if name == "demo":
        from railnav import demo_line

        model = demo_line()
    else:
        model = read(name, data)
    cpu = time.process_time() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    told: dict[str, Any] = {} if name == "demo" else {"cpu_s": round(cpu, 1), "peak_mb": round(peak)}
    told |= MEASURES[name](model, data) if name in MEASURES else {}
    if name in ("demo", "sbb"):
        told["round_trips"] = round_trips(model)
    print(json.dumps(told))


def main() -> None:
    """Measure, and print words or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        one(options.one, options.data)
        return
    figures: dict[str, Any] = {}
    for name, file in (("cologne", COLOGNE), ("sbb", SBB), ("mannheim", MANNHEIM), ("demo", None)):
        if file is not None and not (options.data / file).is_file():
            continue
        command = [sys.executable, __file__, "--one", name, "--data", str(options.data)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        figures[name] = json.loads(done.stdout.splitlines()[-1])
    if options.json:
        print(json.dumps({"benchmark": "formats", "figures": figures}, indent=2))
        return
    for name, told in figures.items():
        print(name)
        for key, value in told.items():
            if key == "round_trips":
                for form, off in value.items():
                    said = ", ".join(
                        f"{what.removesuffix('_mm')} {v} mm" for what, v in off.items() if what.endswith("_mm")
                    )
                    print(f"  {form} out and in: {said}; movements {off['movements']}; {off['mb']} MB")
            else:
                print(f"  {key.replace('_', ' ')}: {value}")


if __name__ == "__main__":
    main()
