"""A network of your own: from GeoJSON to questions about places and ways.

    python examples/own_track.py

Three track sections, written as any GIS writes them, become a model: two that follow each other, and one that leaves by a turnout.
Nothing but ends that coincide and tangents tells which way a train can pass.
"""

from __future__ import annotations

import json
import math
import tempfile
from pathlib import Path

import railnav as rn

#: Where the example lies: degrees north and east of nothing in particular.
LATITUDE, LONGITUDE = 50.0, 10.0


def polyline(points: list[tuple[float, float]]) -> list[list[float]]:
    """Metres east and north of the origin as longitude, latitude, height."""
    metres = 111_320.0
    across = metres * math.cos(math.radians(LATITUDE))
    return [[LONGITUDE + east / across, LATITUDE + north / metres, 200.0] for east, north in points]


def network() -> dict[str, object]:
    """A line to the north, and a branch that bends away to the right (radius 500 m)."""
    straight = [(0.0, 25.0 * i) for i in range(21)]  # 500 m to the turnout
    onward = [(0.0, 500.0 + 25.0 * i) for i in range(21)]
    bend = [i * 10.0 / 500.0 for i in range(31)]  # angle turned, rad: 300 m of arc
    branch = [(500.0 * (1.0 - math.cos(a)), 500.0 + 500.0 * math.sin(a)) for a in bend]
    sections = {"1": ("main", straight), "2": ("main", onward), "3": ("branch", branch)}
    return {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "properties": {"track": track, "line": line},
                "geometry": {"type": "LineString", "coordinates": polyline(points)},
            }
            for track, (line, points) in sections.items()
        ],
    }


def main() -> rn.TrackModel:
    """Import the network and ask about it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "own.geojson"
        path.write_text(json.dumps(network()), encoding="utf-8")
        model = rn.read_geojson(path)

    print(f"{len(model.track_id)} tracks, {model.lengths.sum():.1f} m, in {model.frame.name}")
    for defect in rn.validate(model):
        print(f"  {defect.kind}: {defect.where}: {defect.detail}")

    here = model.at("3", 150.0)
    print(
        f"150 m along track 3: heading {math.degrees(float(here.heading)):.2f} degrees, "
        f"radius {1.0 / float(here.curvature):.0f} m to the right"
    )

    print("Tracks within 10 m of that place, nearest first:")
    for found in model.locate(float(here.easting), float(here.northing), within=10.0):
        print(f"  {found.track} at {found.offset:.2f} m, {found.cross:+.2f} m across")

    for goal in ("2", "3"):
        way = model.routes("1", goal)[0]
        print(f"1 to {goal}: {' > '.join(way.tracks)}, {way.length:.1f} m")
    print(f"2 to 3 without reversing: {'no way' if not model.routes('2', '3') else 'a way, which would be wrong'}")
    return model


if __name__ == "__main__":
    main()
