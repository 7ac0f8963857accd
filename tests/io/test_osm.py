"""OpenStreetMap: tracks between junctions, movements, rounding, mile posts, tunnels; Cologne; what is refused."""

from __future__ import annotations

import math
import random
import resource
import time

import numpy as np
import pytest

from railnav.errors import InputError, RailnavError
from railnav.geodesy.grid import frame_for_grid
from railnav.io.drawn import round_lines
from railnav.io.osm import read_osm
from railnav.io.osm_mileposts import kilometres
from railnav.track.model import NodeKind
from railnav.track.validation import validate

osmium = pytest.importorskip("osmium", reason="osmium is not installed (extra network)")

LAT0, LON0 = 50.94, 6.96


@pytest.fixture
def write(tmp_path):
    """Write nodes {id: (east m, north m, tags)} and ways [(id, nodes, tags)] as .osm.pbf."""

    def write_map(nodes, ways, name="net.osm.pbf"):
        path = tmp_path / name
        path.unlink(missing_ok=True)
        with osmium.SimpleWriter(str(path)) as writer:
            for number, (east, north, *tags) in sorted(nodes.items()):
                latitude = LAT0 + math.degrees(north / 6.371e6)
                longitude = LON0 + math.degrees(east / 6.371e6 / math.cos(math.radians(LAT0)))
                writer.add_node(
                    osmium.osm.mutable.Node(id=number, location=(longitude, latitude), tags=tags[0] if tags else {})
                )
            for number, refs, tags in ways:
                writer.add_way(osmium.osm.mutable.Way(id=number, nodes=refs, tags={"railway": "rail"} | tags))
        return path

    return write_map


def ends(model):
    """Movements as text."""
    words = ("start", "finish")
    return {
        frozenset([(model.track_id[a], words[i]), (model.track_id[b], words[j])])
        for a, i, b, j in model.movements.tolist()
    }


# --- topology ---------------------------------------------------------------------------------------------------------


def test_ways_are_cut_at_a_turnout_and_joined_elsewhere(write):
    nodes = {1: (0, -300), 2: (0, -100), 3: (0, 0, {"railway": "switch"}), 4: (0, 200), 5: (4, 50), 6: (12, 200)}
    path = write(nodes, [(10, [1, 2], {}), (11, [2, 3, 4], {"ref": "2600"}), (12, [3, 5, 6], {"service": "siding"})])
    model = read_osm(path)
    assert len(model.track_id) == 3
    stem = next(t for t in model.track_id if model.length(t) == pytest.approx(300, abs=0.8))
    main = next(t for t in model.track_id if model.length(t) == pytest.approx(200, abs=0.5) and t != "12")
    assert [len(model.routes(stem, leg)) for leg in (main, "12")] == [1, 1]
    assert not model.routes(main, "12")
    assert (model.nodes.kind == NodeKind.TURNOUT).sum() == 1
    assert model.line[model.track_index(main)] == "2600"
    assert {defect.kind for defect in validate(model)} == {"missing heights"}


@pytest.mark.parametrize(
    ("tags", "count"),
    [
        ({"railway": "railway_crossing"}, 2),
        ({}, 2),
        ({"railway": "switch", "railway:switch": "double_slip"}, 4),
        ({"railway": "switch", "railway:switch": "single_slip"}, 4),
    ],
)
def test_a_crossing_and_a_slip(write, tags, count):
    nodes = {1: (-10, -100), 2: (10, -100), 3: (0, 0, tags), 4: (10, 100), 5: (-10, 100)}
    model = read_osm(write(nodes, [(10, [1, 3, 4], {}), (11, [2, 3, 5], {})]))
    assert len(model.movements) == count
    assert frozenset([("10.1", "finish"), ("10.2", "start")]) in ends(model)
    assert (frozenset([("10.1", "finish"), ("11.2", "start")]) in ends(model)) == (count == 4)
    told = model.provenance["import"]
    assert any("single slips" in note for note in told["notes"]) == (tags.get("railway:switch") == "single_slip")


def test_a_tight_tram_curve_is_a_lawful_turnout(write):
    """Drawn with one vertex: 40 degrees at the node."""
    nodes = {1: (0, -50), 2: (0, 0), 3: (0, 50), 4: (8, 10), 5: (40, 20)}
    model = read_osm(write(nodes, [(1, [1, 2, 3], {"railway": "tram"}), (2, [2, 4, 5], {"railway": "tram"})]))
    assert len(model.movements) == 2
    assert "impossible turnout" not in {defect.kind for defect in validate(model)}


def test_an_angle_that_no_train_passes_is_a_defect(write):
    nodes = {1: (0, -50), 2: (0, 0), 3: (0, 50), 4: (50, 0)}
    model = read_osm(write(nodes, [(1, [1, 2, 3], {}), (2, [2, 4], {})]))
    assert model.provenance["import"]["junctions"]["not_lawful"] == 1
    assert "impossible turnout" in {defect.kind for defect in validate(model)}


def test_rings_doubled_ways_and_absent_nodes(write):
    ring = {i: (100 * math.cos(i / 8 * math.tau), 100 * math.sin(i / 8 * math.tau)) for i in range(1, 9)}
    way = [*ring, 1]
    model = read_osm(write(ring, [(1, way, {})]))
    assert len(model.track_id) == 2
    assert len(model.movements) == 2
    again = read_osm(write(ring, [(1, way, {}), (2, way, {})]))
    assert len(again.track_id) == 2
    cut = read_osm(write(ring, [(1, [1, 2, 3, 99, 4, 5], {})]))
    assert sorted(cut.lengths) == pytest.approx([76.5, 153.1], abs=1.0)
    assert "1 nodes of ways are not in the file" in cut.provenance["import"]["notes"][0]


def test_only_railways_in_use_and_their_facts(write):
    nodes = {1: (0, 0), 2: (0, 200), 3: (0, 300), 4: (50, 0), 5: (50, 100), 6: (0, 400, {"railway": "buffer_stop"})}
    ways = [
        (1, [1, 2], {"tunnel": "yes", "name": "Long tunnel", "electrified": "contact_line", "gauge": "1435"}),
        (2, [2, 3, 6], {"electrified": "no"}),
        (3, [4, 5], {"railway": "abandoned"}),
    ]
    model = read_osm(write(nodes, ways))
    assert model.track_id == ("1",)
    (tunnel,) = model.provenance["tunnels"]
    assert tunnel == {"name": "Long tunnel", "track": "1", "from_m": 0.0, "to_m": pytest.approx(200, abs=1)}
    assert model.provenance["import"]["electrified_km"] == pytest.approx({"no": 0.2, "contact_line": 0.2}, abs=2e-3)
    assert sorted(model.nodes.kind.tolist()) == [NodeKind.BUFFER_STOP, NodeKind.END_OF_MODEL]


def test_ways_that_cross_without_a_node_are_told(write):
    nodes = {1: (-100, 0), 2: (100, 3), 3: (-20, -100), 4: (20, 100)}
    flat = read_osm(write(nodes, [(1, [1, 2], {}), (2, [3, 4], {})])).provenance["import"]
    assert flat["ways_that_cross_without_a_node"] == 1
    assert flat["notes"][0].startswith("ways 1 and 2 cross without a node at 50.94")
    bridge = read_osm(write(nodes, [(1, [1, 2], {}), (2, [3, 4], {"bridge": "yes", "layer": "1"})])).provenance[
        "import"
    ]
    assert bridge["ways_that_cross_without_a_node"] == 0


# --- geometry ---------------------------------------------------------------------------------------------------------


def test_rounding_stays_by_the_drawing_and_does_not_swing_out():
    frame = frame_for_grid(3.5e6, 5.6e6, crs="EPSG:31467")
    shape = np.array([[0, 0], [0, 400], [60, 500], [60, 900], [75, 940], [110, 960]])
    drawn = np.add(shape, (3.5e6, 5.6e6))
    (table,) = round_lines(frame, [drawn], start_bearing=np.array([0.08]), end_bearing=np.array([np.nan]))
    import shapely

    apart = shapely.distance(shapely.LineString(drawn), shapely.points(table.easting, table.northing))
    assert 0.25 < apart.max() < 0.3 + 1e-3
    assert table.easting.min() > 3.5e6 - 1e-6  # a spline swings out by metres before the first kink
    assert table.grid_bearing[0] == pytest.approx(0.08)
    assert np.hypot(table.easting[-1] - drawn[-1, 0], table.northing[-1] - drawn[-1, 1]) < 1e-6
    # bearing is the direction of travel, offset the length
    step = np.hypot(np.diff(table.easting), np.diff(table.northing))
    gentle = np.abs(table.curvature[1:] - table.curvature[:-1]) < 1e-6
    np.testing.assert_allclose(
        (step / np.diff(table.offset))[gentle & (np.abs(table.curvature[1:]) < 1e-6)], table.scale.mean(), atol=1e-8
    )
    along = np.arctan2(np.diff(table.easting), np.diff(table.northing))
    np.testing.assert_allclose(
        along[gentle], 0.5 * (table.grid_bearing[1:] + table.grid_bearing[:-1])[gentle], atol=1e-8
    )


def test_a_line_drawn_backwards_is_the_same_curve_backwards():
    frame = frame_for_grid(3.5e6, 5.6e6, crs="EPSG:31467")
    drawn = np.add([[0, 0], [0, 40], [20, 100], [25, 300]], (3.5e6, 5.6e6))
    wanted = np.array([-0.05]), np.array([0.09])
    (there,) = round_lines(frame, [drawn], start_bearing=wanted[0], end_bearing=wanted[1])
    (back,) = round_lines(frame, [drawn[::-1]], start_bearing=wanted[1] + np.pi, end_bearing=wanted[0] + np.pi)
    assert (there.grid_bearing[0], there.grid_bearing[-1]) == pytest.approx((-0.05, 0.09), abs=1e-9)
    np.testing.assert_allclose(back.offset[-1] - back.offset[::-1], there.offset, atol=1e-7)
    np.testing.assert_allclose(back.easting[::-1], there.easting, atol=1e-6)
    np.testing.assert_allclose(back.northing[::-1], there.northing, atol=1e-6)
    np.testing.assert_allclose(np.sin(back.grid_bearing[::-1] - there.grid_bearing), 0.0, atol=1e-7)


def test_a_branch_leaves_in_the_direction_of_the_stem(write):
    nodes = {1: (0, -300), 3: (0, 0, {"railway": "switch"}), 4: (0, 200), 5: (3, 50), 6: (20, 200)}
    model = read_osm(write(nodes, [(1, [1, 3, 4], {}), (2, [3, 5, 6], {})]))
    own = model.knots("2")
    stem = model.knots("1.1")
    end = stem.stop - 1 if abs(model.northing[stem][-1] - model.northing[own][0]) < 1e-3 else stem.start
    assert math.sin(model.grid_bearing[own][0] - model.grid_bearing[end]) == pytest.approx(0.0, abs=1e-6)
    there = float(model.at("2", 32.0).grid_bearing)  # between the blend and the corner
    assert there - model.grid_bearing[own][0] == pytest.approx(math.atan2(3, 50), abs=2e-3)


# --- mile posts -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value"),
    [("14.8", 14800.0), ("12,35", 12350.0), ("-0.4", -400.0), ("km 7", 7000.0), ("95.123 km", 95123.0)]
    + [(text, None) for text in ("", "mi:7.5", "12.3;14.5", "12+300", "x")],
)
def test_kilometres(text, value):
    assert kilometres(text) == value


def test_posts_become_chainage_of_their_line(write):
    def post(east, north, km):
        return (east, north, {"railway": "milestone", "railway:position": km})

    nodes = {1: (0, 0), 2: (0, 1000), 3: (4, 0), 4: (4, 1000), 5: (20, 0), 6: (20, 1000)}
    nodes |= {21: post(0, 200, "10.8"), 22: post(0, 400, "10.6"), 23: post(0, 600, "10.4"), 24: post(0, 800, "99.9")}
    nodes |= {25: post(0, 900, "mi:3")}
    ways = [
        (1, [1, 21, 22, 23, 24, 25, 2], {"ref": "2600"}),
        (2, [3, 4], {"ref": "2600"}),
        (3, [5, 6], {"ref": "2601"}),
    ]
    model = read_osm(write(nodes, ways))
    for track in ("1", "2"):
        assert float(model.at(track, 500.0).chainage) == pytest.approx(10500, abs=1.0), track
    assert math.isnan(float(model.at("3", 500.0).chainage))
    told = model.provenance["import"]["mileposts"]
    assert told == {"posts": 5, "without_number": 1, "without_line": 0, "laid": 8, "contradicting": 2}


def test_one_post_learns_its_sense_from_its_line(write):
    nodes = {1: (0, 0), 2: (0, 300, {"railway": "switch"}), 3: (0, 900), 4: (10, 600)}
    nodes[21] = (0, 100, {"railway": "milestone", "railway:position": "5.2"})
    nodes[22] = (0, 500, {"railway": "milestone", "railway:position": "4.8"})
    ways = [(1, [1, 21, 2], {"ref": "7"}), (2, [2, 22, 3], {"ref": "7"}), (3, [2, 4], {})]
    model = read_osm(write(nodes, ways))
    assert float(model.at("1", 300.0).chainage) == pytest.approx(5000, abs=1.0)
    assert float(model.at("2", 500.0).chainage) == pytest.approx(4500, abs=1.0)


# --- bad input --------------------------------------------------------------------------------------------------------


def test_what_is_refused(write, tmp_path):
    path = tmp_path / "bad.osm.pbf"
    for data, words in ((b"", "is empty"), (b"<osm/>", "no whole OpenStreetMap file"), (b"\0" * 99, "no whole")):
        path.write_bytes(data)
        with pytest.raises(InputError, match=words):
            read_osm(path)
    with pytest.raises(InputError, match="is a folder"):
        read_osm(tmp_path)
    with pytest.raises(InputError, match="holds no railway"):
        read_osm(write({1: (0, 0), 2: (0, 9)}, [(1, [1, 2], {"railway": "razed"})]))
    with pytest.raises(InputError, match="without their nodes"):
        read_osm(write({1: (0, 0)}, [(1, [5, 6], {})]))
    with pytest.raises(InputError, match="of any length"):
        read_osm(write({1: (0, 0), 2: (0, 0)}, [(1, [1, 2], {})]))
    good = write({1: (0, 0), 2: (0, 99)}, [(1, [1, 2], {})]).read_bytes()
    for cut in (5, len(good) // 2, len(good) - 3):
        path.write_bytes(good[:cut])
        with pytest.raises(InputError, match=r"bad\.osm\.pbf: is no whole OpenStreetMap file .*download it again"):
            read_osm(path)


def test_mutated_files_and_odd_networks_never_trace_back(write, tmp_path):
    dice = random.Random(5)
    path = tmp_path / "odd.osm.pbf"
    outcomes = {"read": 0, "refused": 0}
    for k in range(120):
        nodes = {i: (dice.choice((0, 1e-4, 5, 300)) * dice.random(), dice.gauss(0, 100)) for i in range(1, 12)}
        tag = [{"railway": "switch"}, {"railway": "milestone", "railway:position": dice.choice(("1", "x", "-99999"))}]
        nodes[3] = (*nodes[3], dice.choice(tag))
        ways = [
            (
                i,
                dice.choices(range(1, 14), k=dice.randrange(1, 6)),
                {"ref": "1", "layer": dice.choice(("1", "nan", "x"))},
            )
            for i in range(1, 5)
        ]
        data = bytearray(write(nodes, ways).read_bytes())
        if k % 3 == 0:
            for _ in range(dice.choice((1, 4))):
                data[dice.randrange(len(data))] = dice.randrange(256)
        path.write_bytes(data)
        began = time.monotonic()
        try:
            read_osm(path)
            outcomes["read"] += 1
        except RailnavError:
            outcomes["refused"] += 1
        assert time.monotonic() - began < 10.0
    assert min(outcomes.values()) > 10, outcomes


# --- Cologne ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_cologne(shared_data):
    path = shared_data / "osm" / "cologne-railway.osm.pbf"
    if not path.is_file():
        pytest.skip("the Cologne extract is not here")
    began = time.process_time()
    model = read_osm(path)
    assert time.process_time() - began < 15.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 1.5e6  # kB, with all that the test run holds
    told = model.provenance["import"]
    assert model.lengths.sum() == pytest.approx(1.938e6, rel=2e-3)
    assert told["switches"] == 3657
    # five times two ways are drawn into each other back to back: there a train comes to a stand
    assert told["junctions"]["not_lawful"] == 5
    assert sum("doubles back" in note for note in told["notes"]) == 5
    assert len(model.provenance["tunnels"]) > 200
    found = [defect for defect in validate(model) if not defect.remark]
    kinds = [defect.kind for defect in found]
    assert kinds.count("gap") == 0
    assert kinds.count("impossible turnout") == 5
    assert kinds.count("missing joint") <= 2
    assert kinds.count("inconsistent knots") <= 2
    # what is left are corners of the drawing: slips drawn as a point, and legs that no curve of 15 m would meet
    assert kinds.count("kink") < 650
    assert sum(defect.kind == "kink" and "slip" not in defect.detail for defect in found) < 260
    posts = model.mileposts
    own = np.diff(posts.track) == 0
    rate = np.abs(np.diff(posts.chainage) / np.diff(posts.offset))[own]
    assert np.median(rate) == pytest.approx(1.0, abs=0.01)
    assert told["mileposts"]["contradicting"] < 0.05 * told["mileposts"]["laid"]
