"""GeoJSON networks: what is read, what is refused and by which words, and the way back."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from railnav.errors import CrsError, InputError
from railnav.geodesy import choose_frame
from railnav.io.geojson import read_geojson, write_geojson
from railnav.track.alignment import KnotTable
from railnav.track.assembly import TrackSection, assemble
from railnav.track.model import NodeKind, TrackModel


def feature(track="A", coordinates=None, kind="LineString", **properties):
    if coordinates is None:
        coordinates = [[19.0, 47.0, 100.0], [19.0, 47.001, 101.0], [19.0, 47.002, 102.0]]
    return {
        "type": "Feature",
        "geometry": {"type": kind, "coordinates": coordinates},
        "properties": ({} if track is None else {"track": track}) | properties,
    }


@pytest.fixture
def write(tmp_path):
    def write_document(*features, document=None, text=None):
        path = tmp_path / "network.geojson"
        if text is None:
            text = json.dumps(document or {"type": "FeatureCollection", "features": list(features)})
        path.write_text(text, encoding="utf-8")
        return path

    return write_document


def line_of(easting, northing, frame, height=None):
    latitude, longitude, _ = frame.to_geodetic(easting, northing, 0.0)
    columns = [np.degrees(longitude), np.degrees(latitude)] + ([] if height is None else [height])
    return np.round(np.column_stack(columns), 10).tolist()


# --- reading ----------------------------------------------------------------------------------------------------------


def test_one_straight_track(write):
    model = read_geojson(write(feature(line="80", name="main", start_km=3.0, end_km=3.3, cant_mm=[0, 10, 20])))
    assert (model.track_id, model.line, model.name) == (("A",), ("80",), ("main",))
    assert model.length("A") == pytest.approx(222.354, abs=0.01)  # two thousandths of a degree along the meridian
    middle = model.at("A", model.length("A") / 2)
    assert float(middle.height) == pytest.approx(101.0, abs=1e-6)
    assert float(middle.cant) == pytest.approx(0.010, abs=1e-7)
    assert float(middle.chainage) == pytest.approx(3150.0, abs=1e-3)
    assert math.sin(float(middle.heading)) == pytest.approx(0.0, abs=1e-8)
    assert list(model.nodes.kind) == [NodeKind.END_OF_MODEL] * 2
    assert model.provenance["import"]["source"] == "network.geojson"
    assert model.provenance["import"]["notes"] == []


def test_two_dimensions_and_words_as_numbers(write):
    model = read_geojson(write(feature(7, [[19.0, 47.0], [19.01, 47.0]], line=80)))
    assert (model.track_id, model.line) == (("7",), ("80",))
    assert np.isnan(model.height).all()


def test_a_single_feature_is_a_network(write):
    assert read_geojson(write(document=feature("solo"))).track_id == ("solo",)


def test_byte_order_mark_and_unknown_properties(write, tmp_path):
    path = tmp_path / "bom.geojson"
    path.write_bytes(
        b"\xef\xbb\xbf" + json.dumps({"type": "FeatureCollection", "features": [feature(speed=3)]}).encode()
    )
    assert read_geojson(path).track_id == ("A",)


def test_the_plane_can_be_chosen(write):
    path = write(feature())
    assert read_geojson(path, crs="EPSG:23700").frame.authority == ("EPSG", 23700)
    assert read_geojson(path, zone_width=3).frame.name.endswith("zone 6")
    with pytest.raises(CrsError, match=r"network\.geojson: .*EPSG:2056"):
        read_geojson(path, crs="EPSG:2056")
    assert np.diff(read_geojson(path, spacing=10.0).offset).min() == pytest.approx(10.0, rel=0.1)


def test_ends_within_half_a_metre_are_one_node_and_tangents_make_the_turnout(write):
    frame = choose_frame(math.radians(47.0), math.radians(19.0))
    e, n, _ = frame.to_grid(math.radians(47.0), math.radians(19.0))
    s = np.arange(0.0, 201.0, 5.0)
    main = line_of(e + 0 * s, n + s, frame)
    ahead = line_of(e + 0 * s + 0.3, n + 200.0 + s, frame)  # a gap of 30 cm
    branch = line_of(e + s**2 / 600.0, n + 200.0 + s, frame)
    apart = line_of(e + 0 * s + 0.7, n - s, frame)  # 70 cm beside the start: no node
    model = read_geojson(
        write(feature("main", main), feature("ahead", ahead), feature("branch", branch), feature("apart", apart))
    )
    kinds = [NodeKind(int(kind)).name for kind in model.nodes.kind]
    assert sorted(kinds) == ["END_OF_MODEL"] * 5 + ["TURNOUT"]
    movements = {(model.track_id[a], model.track_id[b]) for a, _, b, _ in model.movements.tolist()}
    assert movements == {("main", "ahead"), ("main", "branch")}  # never from one leg to the other


def test_repeated_vertices_are_tolerated_and_said(write):
    coordinates = [[19.0, 47.0], [19.0, 47.0], [19.01, 47.0], [19.01, 47.0]]
    model = read_geojson(write(feature("A", coordinates)))
    assert model.provenance["import"]["notes"] == ["feature 1 (track 'A'): 2 repeated vertices counted once"]


def test_posts_between_the_ends(write):
    model = read_geojson(write(feature(start_km=0.0, end_km=1.0, posts=[[100.0, 0.9]])))
    assert float(model.at("A", 100.0).chainage) == pytest.approx(900.0)


# --- refusals ---------------------------------------------------------------------------------------------------------

NUMBER = "feature 1 (track 'A'): "


@pytest.mark.parametrize(
    ("features", "words"),
    [
        ([feature(), feature("B"), feature()], "feature 3 (track 'A') repeats the track of feature 1"),
        ([feature(1), feature("1")], "feature 2 (track '1') repeats"),
        ([feature(None)], "feature 1: has no property `track`"),
        ([feature("")], "feature 1: property `track` is ''"),
        ([feature(True)], "property `track` is 'True'"),
        ([feature(1.5)], "property `track` is '1.5'"),
        ([feature(line=["80"])], NUMBER + "property `line` is no text"),
        ([feature(kind="MultiLineString")], NUMBER + "is a MultiLineString, not a LineString; give each part"),
        ([feature(kind="Point", coordinates=[19.0, 47.0])], NUMBER + "is a Point"),
        ([{"type": "Feature", "properties": {"track": "A"}, "geometry": None}], "feature without geometry"),
        ([{"type": "Feature", "properties": None, "geometry": None}], "feature 1: has no properties"),
        ([3], "feature 1: is no Feature"),
        ([feature(coordinates=[[19.0, 47.0]])], NUMBER + "has 1 vertex; a track needs two"),
        ([feature(coordinates=[])], NUMBER + "has 0 vertices"),
        ([feature(coordinates=[[19.0, 47.0]] * 3)], NUMBER + "a track needs two distinct vertices"),
        (
            [feature(coordinates=[[19.0, 47.0, 1.0], [19.1, 47.0]])],
            "vertex 2 has 2 coordinates, vertex 1 has 3; give heights",
        ),
        ([feature(coordinates=[[19.0, 47.0], [19.1, "47"]])], "vertex 2 is [19.1, '47']"),
        ([feature(coordinates=[[19.0, 47.0], [19.1, None]])], "vertex 2 is [19.1, None]"),
        ([feature(coordinates=[[19.0], [19.1]])], "vertex 1 is [19.0]"),
        ([feature(coordinates=[[1, 2, 3, 4], [1, 2, 3, 4]])], "vertex 1 is [1, 2, 3, 4]"),
        ([feature(coordinates=[[47.0, 119.0], [47.1, 119.0]])], "GeoJSON has longitude first"),
        ([feature(coordinates=[[650000.0, 240000.0], [650001.0, 240000.0]])], "not grid coordinates"),
        ([feature(coordinates=[[19.0, 47.0, 1e5], [19.1, 47.0, 1e5]])], "vertex 1 has height 100000 m"),
        ([feature(coordinates=[[19.0, 47.0], [19.0, 47.3]])], "vertex 2 lies 33 km from the one before"),
        ([feature(cant_mm=[0.0, 1.0])], "`cant_mm` has 2 values for 3 vertices"),
        ([feature(cant_mm=5)], "`cant_mm` is no list"),
        ([feature(cant_mm=[0.0, "1", 2.0])], "`cant_mm` does not hold 3 numbers"),
        ([feature(cant_mm=[0.0, 1.0, 900.0])], "`cant_mm` reaches 900 mm"),
        ([feature(covariance_m2=[[1, 0, 0]] * 3)], "`covariance_m2` does not hold 3 lists of 6 numbers"),
        ([feature(posts=[[1.0, 2.0], [3.0]])], "`posts` does not hold 2 lists of 2 numbers"),
        ([feature(start_km="three")], "property `start_km` is 'three'"),
        ([], "has no features"),
    ],
)
def test_refusals_name_the_feature(write, features, words):
    with pytest.raises(InputError) as caught:
        read_geojson(write(*features))
    assert words in str(caught.value)
    assert "network.geojson" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("{", "is no JSON"),
        ('{"type": "FeatureCollection", "features": [', "is no JSON"),
        ('{"type":"FeatureCollection","features":[{"type":"Feature","properties":{"track":"A"},"geometry":'
         '{"type":"LineString","coordinates":[[19.0,NaN],[19.1,47.0]]}}]}', "is no JSON"),
        ('{"type":"FeatureCollection","features":[{"type":"Feature","properties":{"track":"A"},"geometry":'
         '{"type":"LineString","coordinates":[[19.0,1e999],[19.1,47.0]]}}]}', ""),
        ("[" * 100_000, "is no JSON"),
        ('"text"', "JSON without a GeoJSON type"),
        ("[1, 2]", "JSON without a GeoJSON type"),
        ('{"type": "Topology"}', "is a Topology"),
        ('{"type": "LineString", "coordinates": [[19, 47], [19, 48]]}', "is a LineString"),
        ('{"type": "FeatureCollection", "features": {}}', "has no features"),
        ('{"type": "FeatureCollection", "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::23700"}},'
         ' "features": []}', "is in urn:ogc:def:crs:EPSG::23700"),
    ],
)  # fmt: skip
def test_files_that_are_no_network(write, text, words):
    with pytest.raises(InputError) as caught:
        read_geojson(write(text=text))
    assert words in str(caught.value)


def test_the_old_name_of_wgs84_is_accepted(write):
    document = {"type": "FeatureCollection", "features": [feature()]}
    for name in ("urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326", "urn:ogc:def:crs:OGC::CRS84"):
        document["crs"] = {"type": "name", "properties": {"name": name}}
        assert read_geojson(write(document=document)).track_id == ("A",)


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_geojson(tmp_path / "none.geojson")
    with pytest.raises(InputError, match="is a folder"):
        read_geojson(tmp_path)
    binary = tmp_path / "picture.geojson"
    binary.write_bytes(b"\x89PNG\r\n\x00\xff" * 10)
    with pytest.raises(InputError, match="is no JSON"):
        read_geojson(binary)


# --- the way back -----------------------------------------------------------------------------------------------------


def demanding_model(frame, place) -> TrackModel:
    """Straight, clothoid, arc R 300 with 150 mm of cant, clothoid back, a vertical curve, and a turnout of R 190 at the end.

    Knots straight from the elements' own law, so that the spline of the reader has no part in the truth.
    """
    e0, n0, _ = frame.to_grid(*place, 0.0)

    def table(pieces, start, bearing, h0, gradients):
        spans, s = [], 0.0
        for length, k0, k1 in pieces:
            spans.append((s, length, k0, k1))
            s += length
        fine = np.linspace(0.0, s, round(s / 0.01) + 1)
        curvature = np.zeros_like(fine)
        for at, length, k0, k1 in spans:
            inside = fine >= at
            curvature[inside] = k0 + (k1 - k0) * np.minimum((fine[inside] - at) / length, 1.0)
        step = fine[1] - fine[0]
        turned = bearing + np.append(0.0, np.cumsum(0.5 * (curvature[1:] + curvature[:-1]) * step))
        along_e, along_n = np.sin(turned), np.cos(turned)
        east = start[0] + np.append(0.0, np.cumsum(0.5 * (along_e[1:] + along_e[:-1]) * step))
        north = start[1] + np.append(0.0, np.cumsum(0.5 * (along_n[1:] + along_n[:-1]) * step))
        gradient = np.interp(fine, *gradients)
        height = h0 + np.append(0.0, np.cumsum(0.5 * (gradient[1:] + gradient[:-1]) * step))
        pick = np.arange(0, len(fine), 100)
        if pick[-1] != len(fine) - 1:
            pick = np.append(pick[:-1], len(fine) - 1)
        scale = frame.ground_scale(east[pick], north[pick], height[pick], turned[pick])
        ground = np.append(
            0.0,
            np.cumsum(
                frame.ground_length(
                    east[pick[:-1]],
                    north[pick[:-1]],
                    height[pick[:-1]],
                    east[pick[1:]],
                    north[pick[1:]],
                    height[pick[1:]],
                )
                * (1.0 + (curvature[pick[1:]] + curvature[pick[:-1]]) ** 2 / 96.0)  # arc over chord
            ),
        )
        return KnotTable(
            ground, east[pick], north[pick], height[pick], turned[pick], curvature[pick], gradient[pick],
            curvature[pick] * 45.0, scale, np.full((len(pick), 6), np.nan),
        )  # fmt: skip

    main = table(
        [(200, 0, 0), (80, 0, 1 / 300), (150, 1 / 300, 1 / 300), (80, 1 / 300, 0), (200, 0, 0)],
        (e0, n0), 0.7, 150.0, ([0, 250, 300, 710], [0.0, 0.0, 0.02, 0.02]),
    )  # fmt: skip
    end = (main.easting[-1], main.northing[-1])
    bearing, height = float(main.grid_bearing[-1]), float(main.height[-1])
    ahead = table([(300, 0, 0)], end, bearing, height, ([0, 300], [0.02, 0.02]))
    branch = table([(40, -1 / 190, -1 / 190), (100, 0, 0)], end, bearing, height, ([0, 140], [0.02, 0.02]))
    covariance = np.tile([4e-4, 1e-4, 0.0, 5e-4, 0.0, 9e-4], (len(main.offset), 1))
    main = KnotTable(*[getattr(main, name) for name in main.__slots__[:-1]], covariance_g=covariance)
    return assemble(
        frame,
        [
            TrackSection("main", main, "80", "Hauptgleis ü", 12_000.0, 12_700.0, np.array([[350.0, 12_400.0]])),
            TrackSection("ahead", ahead, "80", "", 12_700.0, 13_000.0),
            TrackSection("branch", branch),
        ],
    )


@pytest.fixture(params=["wgs84", "krassowsky"])
def model(request):
    place = (math.radians(55.7), math.radians(37.0))
    return demanding_model(choose_frame(*place, ellipsoid=request.param), place)


def test_export_and_import_give_the_same_line(model, tmp_path):
    write_geojson(model, tmp_path / "out.geojson")
    back = read_geojson(tmp_path / "out.geojson", crs=model.frame.crs_wkt)
    assert back.frame.pipeline == model.frame.pipeline
    assert (back.track_id, back.line, back.name) == (model.track_id, model.line, model.name)
    np.testing.assert_array_equal(back.movements, model.movements)
    np.testing.assert_array_equal(back.nodes.kind, model.nodes.kind)
    np.testing.assert_allclose(back.lengths, model.lengths, rtol=1e-6)
    for track in model.track_id:
        share = np.linspace(0.0, 1.0, 2000)
        there, here = model.at(track, share * model.length(track)), back.at(track, share * back.length(track))
        assert np.hypot(there.easting - here.easting, there.northing - here.northing).max() < 1e-3
        assert np.abs(there.height - here.height).max() < 1e-3
        assert np.abs(there.cant - here.cant).max() < 2e-3
        np.testing.assert_allclose(there.chainage, here.chainage, atol=2e-3)
    own = back.knots("main")
    np.testing.assert_allclose(back.covariance_g[own][:, 0], 4e-4, rtol=1e-5)
    assert np.isnan(back.covariance_g[back.knots("ahead")]).all()
    assert back.nodes.id == model.nodes.id


def test_vertices_are_thinned_but_not_at_the_points(model, tmp_path):
    write_geojson(model, tmp_path / "out.geojson")
    document = json.loads((tmp_path / "out.geojson").read_text(encoding="utf-8"))
    count = {f["properties"]["track"]: len(f["geometry"]["coordinates"]) for f in document["features"]}
    assert count["ahead"] == 62  # 300 m at 5 m: the knots are not quite a metre apart
    assert 29 < count["branch"] < 100
    assert "cant_mm" not in document["features"][1]["properties"]
    assert all(
        len(str(vertex[0]).split(".")[1]) <= 9 for f in document["features"] for vertex in f["geometry"]["coordinates"]
    )


def test_a_model_without_heights_stays_without(write, tmp_path):
    model = read_geojson(write(feature("A", [[19.0, 47.0], [19.01, 47.0], [19.02, 47.001]])))
    write_geojson(model, tmp_path / "flat.geojson")
    text = (tmp_path / "flat.geojson").read_text()
    assert all(len(v) == 2 for v in json.loads(text)["features"][0]["geometry"]["coordinates"])
    back = read_geojson(tmp_path / "flat.geojson")
    assert np.isnan(back.height).all()
    np.testing.assert_allclose(back.lengths, model.lengths, rtol=1e-6)


def test_writing_is_whole_or_nothing(model, tmp_path):
    target = tmp_path / "line.geojson"
    target.write_text("old")
    with pytest.raises(InputError):
        write_geojson(model, tmp_path / "no folder" / "line.geojson")
    broken = TrackModel.__new__(TrackModel)
    with pytest.raises(AttributeError):
        write_geojson(broken, target)
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["line.geojson"]


# --- the sample network -----------------------------------------------------------------------------------------------


def test_sample_network(shared_data, tmp_path):
    source = shared_data / "sample_run" / "network.geojson"
    if not source.exists():
        pytest.skip(f"{source} is not here")
    model = read_geojson(source)
    stated = np.array(
        [
            (f["properties"]["end_km"] - f["properties"]["start_km"]) * 1e3
            for f in json.loads(source.read_text())["features"]
        ]
    )
    crossovers = np.array(["X-" in track for track in model.track_id])
    loops = np.array([track.endswith(("S3", "S4")) for track in model.track_id])
    # kilometres are horizontal and at sea level: 180 to 220 m of height add 28 to 34 ppm, slopes some 80
    excess = model.lengths / stated - 1.0
    assert (excess[~(crossovers | loops)] > 15e-6).all()
    assert (excess[~(crossovers | loops)] < 110e-6).all()
    assert (np.abs(excess) < 2e-3).all()
    kinds = [NodeKind(int(kind)).name for kind in model.nodes.kind]
    assert sorted(set(kinds)) == ["END_OF_MODEL", "TURNOUT"]
    assert kinds.count("TURNOUT") == 13
    assert len(model.movements) == 26  # two at every turnout
    between = {frozenset((model.track_id[a], model.track_id[b])) for a, _, b, _ in model.movements.tolist()}
    assert frozenset(("80L-03", "80L-S3")) in between
    assert frozenset(("80L-04", "80L-S3")) not in between
    write_geojson(model, tmp_path / "again.geojson")
    again = read_geojson(tmp_path / "again.geojson")
    np.testing.assert_allclose(again.lengths, model.lengths, rtol=1e-6)
    np.testing.assert_array_equal(again.movements, model.movements)
