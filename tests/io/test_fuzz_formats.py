"""1,000 damaged files of every format: each is read or refused in one line, within a second, never a traceback."""

from __future__ import annotations

import random
import re
import time
import warnings
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from railnav.errors import RailnavError
from railnav.evaluation import truth_as_solution
from railnav.io import elements_writer, geojson, geopackage, landxml_writer, railml_writer
from railnav.io.axis_table import read_axis_table
from railnav.io.elements import read_elements
from railnav.io.gnss_log import read_log
from railnav.io.landxml import read_landxml
from railnav.io.layers import read_layer
from railnav.io.logs import convert_log, read_bare_log
from railnav.io.osm import read_osm
from railnav.io.railml import read_railml
from railnav.io.run import read_run, write_run
from railnav.io.run_check import run_defects
from railnav.io.solution import read_solution
from railnav.run import GnssStream, Run
from railnav.track.model import TrackModel
from railnav.truth import Truth

MUTATIONS = 1000
START = datetime(2025, 7, 8, 12, tzinfo=UTC)
#: What a hand or a bad disk may put into text.
TOKENS = [
    b"INF", b"-1", b"1e308", b"1e-300", b"nan", b"0", b"", b"<", b">", b'"', b"\xff\xfe", b"99999999999999999999", b"[", b"}", b",",
    b"null", b"&#0;", b"\x00", b"\r", b"-", b"true", b"'; DROP", b"A" * 5000, b"1" * 400,
]  # fmt: skip


@pytest.fixture(scope="module")
def model() -> TrackModel:
    """Three tracks that meet in a turnout, with heights, cant and chainage."""
    from railnav.geodesy.grid import frame_for_grid
    from railnav.track.alignment import fit_alignment
    from railnav.track.assembly import TrackSection, assemble

    frame = frame_for_grid(3_461_000.0, 5_482_000.0, crs="EPSG:31467")

    def track(name, bend, start, length=60.0):
        s = np.linspace(0, length, 25)
        e = 3_461_000.0 + bend * s**2 / 2
        n = 5_482_000.0 + start + s
        return TrackSection(
            name,
            fit_alignment(frame, e, n, 100 + 0.01 * s, cant=0.02 * s / length, spacing=5.0),
            "80",
            "x",
            start,
            start + length,
        )

    return assemble(frame, [track("A", 0.0, -60.0), track("B", 0.0, 0.0), track("C", 1 / 300, 0.0)])


def write_pbf(model: TrackModel, path: Path) -> None:
    import osmium

    writer = osmium.SimpleWriter(str(path))
    number = 1
    ways = []
    known: dict[tuple[float, float], int] = {}
    for track in model.track_id:
        own = model.knots(track)
        latitude, longitude, _ = model.frame.to_geodetic(model.easting[own], model.northing[own])
        refs = []
        for place in zip(np.degrees(longitude).round(6).tolist(), np.degrees(latitude).round(6).tolist(), strict=True):
            if place not in known:
                known[place] = number
                tags = {"railway": "switch"} if number == 13 else {}
                writer.add_node(osmium.osm.mutable.Node(id=number, location=place, tags=tags))
                number += 1
            refs.append(known[place])
        ways.append(refs)
    for i, refs in enumerate(ways):
        writer.add_way(osmium.osm.mutable.Way(id=i + 1, nodes=refs, tags={"railway": "rail", "ref": "80"}))
    writer.close()


AXIS = (
    "n,s,ds,R,cl,tang,rw,hw\n1,0,0,0,0,0,3461000,5482000\n1,100,100,300,0,0,3461000,5482100\n"
    "1,200,100,0,0,21.2207,3461016.515,5482198.158\n"
)
GPX = '<?xml version="1.0"?><gpx version="1.1"><trk><trkseg>{}</trkseg></trk></gpx>'


def run_of(count=30) -> Run:
    t = np.arange(count) * 1.0
    return Run(
        "a", START,
        gnss=GnssStream(t, np.radians(47.5 + 1e-5 * t), np.radians(19.1 + 0 * t), height=100 + 0 * t, sigma_east=1 + 0 * t,
                        sigma_north=1 + 0 * t, sigma_up=2 + 0 * t, speed=10 + 0 * t, course=0 * t),
    )  # fmt: skip


def ubx_log() -> bytes:
    from test_logs import inertial_log

    return inertial_log(seconds=6, rate=10, message=0x02)[0]


def good_file(kind: str, model: TrackModel, folder: Path):
    """A good file of a kind, and what reads it."""
    path = folder / {
        "osm": "a.osm.pbf", "landxml": "a.xml", "railml": "a.railml", "railml2": "a.railml", "geojson": "a.geojson", "elements": "a.csv",
        "axis": "a.csv", "layer": "a.gpkg", "shapefile": "a.shp", "gpkg": "a.gpkg", "nmea": "a.nmea", "ubx": "a.ubx", "pos": "a.pos",
        "gpx": "a.gpx", "gpsd": "a.gpsd", "bag": "a.mcap", "solution.csv": "a.csv", "solution.parquet": "a.parquet",
        "solution.gpkg": "a.gpkg", "solution.geojson": "a.geojson", "run": "gnss.csv",
    }[kind]  # fmt: skip
    start = START
    if kind == "osm":
        write_pbf(model, path)
        return path, read_osm
    if kind == "landxml":
        landxml_writer.write_landxml(model, path)
        return path, read_landxml
    if kind == "railml":
        railml_writer.write_railml(model, path)
        return path, read_railml
    if kind == "railml2":
        from test_railml import BRANCH, MAIN, old

        path.write_text(old(MAIN + BRANCH))
        return path, read_railml
    if kind == "geojson":
        geojson.write_geojson(model, path)
        return path, geojson.read_geojson
    if kind == "elements":
        elements_writer.write_elements(model, path)
        return path, lambda p: read_elements(p, crs="EPSG:31467")
    if kind == "axis":
        path.write_text(AXIS)
        return path, lambda p: read_axis_table(p, crs="EPSG:31467")
    if kind in ("layer", "shapefile"):
        import pyogrio
        import shapely

        shapes = [
            shapely.LineString([(3_461_000, 5_482_000 + 60 * k), (3_461_000, 5_482_060 + 60 * k)]) for k in range(3)
        ]
        pyogrio.raw.write(
            str(path), np.array([shapely.to_wkb(s) for s in shapes]), [np.array(["1", "2", "3"])], ["track"],
            geometry_type="LineString", crs="EPSG:31467",
        )  # fmt: skip
        return path, lambda p: read_layer(p, crs="EPSG:31467")
    if kind == "gpkg":
        geopackage.write_model(model, path)
        return path, geopackage.read_model
    if kind.startswith("solution"):
        t = np.arange(20.0)
        truth = Truth(("A",), t, np.zeros(20, np.int64), 1.0 + t, 1 + 0 * t, *(0 * t for _ in range(4)))
        truth_as_solution(truth, model, along=1.0).to_file(path)
        return path, read_solution
    write_run(run_of(), folder / "run")
    if kind == "run":

        def both(p):
            run_defects(p.parent)
            return read_run(p.parent)

        return folder / "run" / "gnss.csv", both
    if kind == "gpsd":
        from test_logs import reports

        path.write_text(reports())
        return path, lambda p: read_log(p, "gpsd", start=datetime(2025, 7, 8, 23, 59, 58, tzinfo=UTC))
    if kind == "bag":
        pytest.importorskip("rosbags", reason="rosbags is not installed (extra bags)")
        from test_logs import write_bag

        write_bag(folder / "bag")
        next((folder / "bag").glob("*.mcap")).rename(path)
        return path, read_bare_log
    if kind == "ubx":
        path.write_bytes(ubx_log())
        return path, read_bare_log
    convert_log(folder / "run", path)
    return path, lambda p: read_log(p, {"pos": "rtklib-pos"}.get(kind, kind), start=start)


def damage(good: bytes, dice: random.Random) -> bytes:
    """A few bytes changed, lost, moved or doubled; numbers and words replaced; the end lost."""
    data = bytearray(good)
    for _ in range(dice.choice((1, 1, 1, 2, 4))):
        kind = dice.random()
        at = dice.randrange(len(data)) if data else 0
        if kind < 0.35:
            near = re.search(rb'-?\d[\d.]*|"[^"<>]{1,20}"|[A-Za-z_]{2,20}', bytes(data[at : at + 200]))
            if near:
                data[at + near.start() : at + near.end()] = dice.choice(TOKENS)
        elif kind < 0.6:
            data[at : at + dice.randrange(8)] = dice.randbytes(dice.randrange(8))
        elif kind < 0.75 and data:
            data[at] ^= 1 << dice.randrange(8)
        elif kind < 0.85:
            size = dice.randrange(200)
            data[at:at] = data[at : at + size]
        elif kind < 0.95:
            del data[at : at + dice.randrange(300)]
        else:
            del data[at:]
    return bytes(data)


KINDS = [
    "osm", "landxml", "railml", "railml2", "geojson", "elements", "axis", "layer", "shapefile", "gpkg", "nmea", "ubx", "pos", "gpx", "gpsd",
    "bag", "solution.csv", "solution.parquet", "solution.gpkg", "solution.geojson", "run",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files(kind: str, model: TrackModel, tmp_path: Path) -> None:
    path, read = good_file(kind, model, tmp_path)
    good = path.read_bytes()
    read(path)  # and everything is compiled
    dice = random.Random(f"railnav {kind}")
    outcomes = {"read": 0, "refused": 0}
    slowest = 0.0
    for number in range(MUTATIONS):
        path.write_bytes(damage(good, dice))
        begin = time.process_time()
        message = None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # GDAL and pyproj warn of what they repair
                read(path)
        except RailnavError as error:
            message = str(error)
        outcomes["read" if message is None else "refused"] += 1
        assert message is None or message.strip(), number
        assert "\n" not in (message or ""), (number, message)
        assert len(message or "") < 1200, (number, message)
        slowest = max(slowest, time.process_time() - begin)
        assert slowest < 1.0, (number, slowest)
    with suppress(OSError):
        path.unlink()
    # a log that is damaged in a place or two is read all the same
    assert outcomes["refused"] > (0 if kind in ("nmea", "ubx", "gpsd", "pos") else 20), outcomes
