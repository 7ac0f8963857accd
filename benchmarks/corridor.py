"""Distortion of planes along trunk lines: Gauss-Krueger zones, one fitted oblique Mercator, sections; heights included or not.

Run `python benchmarks/corridor.py [--json PATH]`. The lines are rough: towns joined by geodesics, and for one of them the heights of
the ground in round figures. Their size and bends are those of the real ones; nobody's survey is in them.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from pathlib import Path

import numpy as np
import pyproj

from railnav.geodesy.axis_projection import AxisProjection, CompositeLine
from railnav.geodesy.corridor import fit_corridor

LINES = {
    "Moscow - St Petersburg": [
        (55.776, 37.655, 165), (56.34, 36.73, 175), (56.835, 35.893, 150), (57.58, 34.56, 180), (57.88, 34.05, 190),
        (58.39, 33.29, 120), (58.85, 32.22, 75), (59.12, 31.66, 45), (59.54, 30.88, 50), (59.93, 30.36, 25),
    ],
    "Moscow - Kazan - Yekaterinburg": [(55.776, 37.655), (55.57, 42.05), (55.79, 49.12), (56.51, 53.99), (56.84, 60.6)],
    "Moscow - Adler": [(55.73, 37.64), (54.2, 37.62), (51.67, 39.2), (47.22, 39.69), (45.04, 38.98), (43.43, 39.92)],
}  # fmt: skip


def zones(lat: np.ndarray, lon: np.ndarray, width: float) -> tuple[float, float]:
    """Least and largest scale less 1 of Gauss-Krueger with a change of zone at every boundary, ppm."""
    degrees = np.degrees(lon)
    meridian = np.floor(degrees / 6) * 6 + 3 if width == 6 else np.round(degrees / 3) * 3
    y = np.radians(degrees - meridian) * np.cos(lat)
    n = 6378137.0 / np.sqrt(1 - 0.00669438 * np.sin(lat) ** 2)
    m = n * (1 - 0.00669438) / (1 - 0.00669438 * np.sin(lat) ** 2)
    off = 0.5 * (n * y) ** 2 / (m * n) * 1e6
    return float(off.min()), float(off.max())


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    geod = pyproj.Geod(ellps="WGS84")
    result: dict[str, dict[str, float]] = {}
    print(f"{'mm/km, largest on the line':<42} {'GK 6':>7} {'GK 3':>7} {'one':>7} {'200 km':>7} {'s':>6}")
    for name, places in LINES.items():
        rows = np.array([p[:2] for p in places])
        lat, lon = np.radians(rows.T)
        dense = [np.array(geod.npts(a[1], a[0], b[1], b[0], 200)) for a, b in itertools.pairwise(rows)]
        dlon, dlat = np.radians(np.concatenate(dense).T)
        begin = time.perf_counter()
        one = fit_corridor(lat, lon)
        seconds = time.perf_counter() - begin
        parts = fit_corridor(lat, lon, section_length=200e3, overlap=0.0)
        numbers = {
            "length_km": one.length / 1e3,
            "gk6_ppm": zones(dlat, dlon, 6)[1],
            "gk3_ppm": zones(dlat, dlon, 3)[1],
            "one_ppm": one.largest * 1e6,
            "sections_ppm": parts.largest * 1e6,
            "fit_s": seconds,
        }
        result[name] = numbers
        print(
            f"{name + f', {one.length / 1e3:.0f} km':<42} {numbers['gk6_ppm']:7.0f} {numbers['gk3_ppm']:7.0f} "
            f"{numbers['one_ppm']:7.2f} {numbers['sections_ppm']:7.2f} {seconds:6.2f}"
        )
    name = "Moscow - St Petersburg"
    lat, lon, height = np.array(LINES[name], float).T
    high = {}
    for label, length in (("one plane", None), ("3 sections", 220e3), ("4 sections", 200e3)):
        found = fit_corridor(np.radians(lat), np.radians(lon), height, section_length=length)
        high[label] = found.largest * 1e6
    result["with heights"] = high
    print(f"{name} with the heights of its ground, 25 to 190 m (26 mm/km between them):")
    print("  " + ", ".join(f"{label} {value:.2f} mm/km" for label, value in high.items()) + "   (goal 10 on 600 km)")
    axis = AxisProjection(np.radians((55.75, 37.6)), np.radians((56.3, 36.7)))
    lats, lons = axis.to_geodetic(np.linspace(0, axis.length, 50), np.zeros(50))
    on_axis = float(np.abs(axis.point_scale(lats, lons) - 1).max() * 1e6)
    line = CompositeLine(np.radians(lat), np.radians(lon))
    random = np.random.default_rng(0)
    there = np.radians(np.column_stack([random.uniform(55.8, 59.9, 100_000), random.uniform(30.4, 37.6, 100_000)])).T
    begin = time.perf_counter()
    address = line.address(*there)
    rate = 1e5 / (time.perf_counter() - begin)
    back = line.position(address)
    closed = float(np.max(np.hypot(back[0] - there[0], (back[1] - there[1]) * np.cos(there[0]))) * 6.38e6)
    print(f"Axis projection of a {axis.length / 1e3:.0f} km link: {on_axis:.4f} mm/km on the axis (goal 1 on 200 km).")
    print(f"Addresses on {len(line.links)} links: {rate / 1e3:.0f} thousand/s, closing to {closed * 1e9:.0f} nm.")
    result["axis"] = {"on_axis_ppm": on_axis, "addresses_per_s": rate, "closing_m": closed}
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
