"""LandXML out and in again: a model within 1 mm, designed elements to their digits, stations, lines, heights, cant."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from railnav.errors import InputError, TrackError
from railnav.geodesy.grid import frame_for_grid
from railnav.io.design import (
    ARC,
    BLOSS,
    CLOTHOID,
    COSINE,
    CUBIC,
    HELMERT,
    SINE,
    STRAIGHT,
    VIENNESE,
    Cant,
    Plan,
    integrate,
)
from railnav.io.designed import DesignedAlignment, VerticalPoints, designed_track, designed_tracks
from railnav.io.landxml import read_landxml
from railnav.io.landxml_writer import write_landxml
from railnav.simulation import demo_line

CRS = "EPSG:2056"
E0, N0 = 2_690_000.0, 1_250_000.0


def chained(rows, sway=(), bearing=0.7):
    """A plan of (length, kind, k0, k1) rows that close exactly."""
    east, north = E0, N0
    starts = []
    swing = np.array([*sway, *np.zeros(len(rows) - len(sway))])
    for i, (length, kind, k0, k1) in enumerate(rows):
        one = Plan(
            np.array([length]),
            np.array([kind]),
            np.array([k0]),
            np.array([k1]),
            np.array([east]),
            np.array([north]),
            np.array([bearing]),
            swing[i : i + 1],
        )
        starts.append((east, north, bearing))
        at, onward = integrate(one, one.edges)
        east, north, bearing = float(at[-1, 0]), float(at[-1, 1]), float(onward[-1])
    length, kind, k0, k1 = (np.array(c) for c in zip(*rows, strict=True))
    e, n, b = (np.array(c) for c in zip(*starts, strict=True))
    return Plan(length, kind, k0, k1, e, n, b, swing)


def apart(one, other, track):
    """Greatest distance in plan, height and cant of two models along a track, m, and of their lengths."""
    length = min(one.length(track), other.length(track))
    at = np.linspace(0.0, length, max(3, int(2 * length)))
    p, q = one.at(track, at), other.at(track, at)
    return (
        float(np.hypot(p.easting - q.easting, p.northing - q.northing).max()),
        float(np.abs(np.nan_to_num(p.height - q.height)).max()),
        float(np.abs(p.cant - q.cant).max()),
        abs(one.length(track) - other.length(track)),
    )


def test_a_model_comes_back_within_a_millimetre(tmp_path):
    model = demo_line()
    write_landxml(model, tmp_path / "line.xml")
    again = read_landxml(tmp_path / "line.xml")
    assert sorted(again.track_id) == sorted(model.track_id)
    worst = np.max([apart(model, again, track) for track in model.track_id], axis=0)
    assert worst[0] < 1e-3
    assert worst[1] < 1e-3
    assert worst[2] < 1e-4
    assert worst[3] < 1e-3
    assert len(again.movements) == len(model.movements)
    lines = dict(zip(again.track_id, again.line, strict=True))
    assert [lines[track] for track in model.track_id] == list(model.line)
    posts = model.mileposts
    for track, offset, chainage in zip(posts.track, posts.offset, posts.chainage, strict=True):
        name = model.track_id[int(track)]
        found = float(again.at(name, min(float(offset), again.length(name))).chainage)
        assert found == pytest.approx(float(chainage), abs=0.5), (
            name,
            offset,
        )  # stations count grid metres between posts


def test_few_elements_are_found_for_a_designed_line():
    model = demo_line()
    found = designed_tracks(model)
    assert sum(len(each.plan.length) for each in found) < 12 * len(found)
    with pytest.raises(TrackError, match="not positive"):
        designed_track(model, model.track_id[0], tolerance=0.0)


@pytest.mark.parametrize("kind", [CLOTHOID, BLOSS, COSINE, SINE, HELMERT, VIENNESE])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_designed_elements_keep_their_kind(tmp_path, kind, side):
    k = side / 450.0
    rows = [(50.0, STRAIGHT, 0.0, 0.0), (80.0, kind, 0.0, k), (120.0, ARC, k, k), (60.0, kind, k, 0.5 * k)]
    rows += [(70.0, kind, 0.5 * k, 0.0), (40.0, STRAIGHT, 0.0, 0.0)]
    cant = Cant(np.array([50.0, 130.0, 310.0, 380.0]), *np.array([[0.0, 0.12, 0.12], [0.12, 0.12, 0.0]]) * side,
                np.array([kind, CLOTHOID, kind]))  # fmt: skip
    vertical = VerticalPoints(*np.array([[0, 150, 300, 420], [400, 401.5, 401.5, 405], [0, 60, 0, 0], [0, 0, 4000, 0]]))
    lift = 1.8 * side * 0.12 / 1.5  # a centre of gravity 1.8 m above the rails
    plan = chained(rows, sway=[0, lift / 80**2, 0, 0, -lift / 70**2] if kind == VIENNESE else ())
    design = DesignedAlignment("T", plan, vertical, cant, 1200.5, ((300.0, 5000.0, -1.0),), "80", "through <track>")
    write_landxml([design], tmp_path / "t.xml", crs_wkt=frame_for_grid(E0, N0, crs=CRS).crs_wkt)
    text = (tmp_path / "t.xml").read_text()
    assert text.count("<Spiral") == 3
    assert 'epsgCode="2056"' in text
    model = read_landxml(tmp_path / "t.xml")
    assert model.provenance["import"]["largest_gap_m"] < 2e-6
    assert model.provenance["import"]["notes"] == []
    assert (model.line[0], model.name[0]) == ("80", "through <track>")
    at, _ = integrate(plan, np.array([90.0, 200.0, 300.0]))
    step = np.hypot(np.diff(model.easting), np.diff(model.northing))
    step *= 1.0 + (0.5 * (model.curvature[1:] + model.curvature[:-1])) ** 2 * step**2 / 24.0
    grid = np.append(0.0, np.cumsum(step))
    here = model.at("T", np.interp([90.0, 200.0, 300.0], grid, model.offset))
    assert np.hypot(here.easting - at[:, 0], here.northing - at[:, 1]).max() < 1e-4
    assert float(here.cant[1]) == pytest.approx(side * 0.12, abs=1e-6)
    assert float(here.height[1]) == pytest.approx(401.5, abs=1e-4)
    assert float(model.at("T", 0.0).chainage) == pytest.approx(1200.5)
    assert float(model.at("T", model.length("T")).chainage) == pytest.approx(5000.0 - 120.0, abs=2e-2)


def test_cubic_parabolas_keep_their_kind(tmp_path):
    k = -1 / 450.0
    rows = [(50.0, STRAIGHT, 0.0, 0.0), (80.0, CUBIC, 0.0, k), (120.0, ARC, k, k), (60.0, CUBIC, k, 0.0)]
    plan = chained(rows)
    write_landxml([DesignedAlignment("T", plan)], tmp_path / "t.xml")
    assert (tmp_path / "t.xml").read_text().count('spiType="cubicParabola"') == 2
    model = read_landxml(tmp_path / "t.xml", crs=CRS)
    assert model.provenance["import"]["largest_gap_m"] < 2e-6
    at, _ = integrate(plan, plan.edges)
    assert np.hypot(model.easting[-1] - at[-1, 0], model.northing[-1] - at[-1, 1]) < 1e-5


def test_a_track_without_chainage_comes_back_without(tmp_path):
    design = DesignedAlignment("T", chained([(100.0, STRAIGHT, 0.0, 0.0)]))
    write_landxml([design], tmp_path / "t.xml")
    model = read_landxml(tmp_path / "t.xml", crs=CRS)
    assert not len(model.mileposts.track)
    assert math.isnan(float(model.at("T", 10.0).chainage))
    assert math.isnan(float(model.at("T", 10.0).height))


def test_a_clothoid_that_bends_both_ways_becomes_two(tmp_path):
    plan = chained([(50.0, ARC, -1e-3, -1e-3), (120.0, CLOTHOID, -1e-3, 2e-3), (60.0, ARC, 2e-3, 2e-3)])
    write_landxml([DesignedAlignment("T", plan)], tmp_path / "t.xml")
    text = (tmp_path / "t.xml").read_text()
    assert text.count('spiType="clothoid"') == 2
    assert 'length="40" radiusStart="1000" radiusEnd="INF"' in text
    assert 'length="80" radiusStart="INF" radiusEnd="500"' in text
    model = read_landxml(tmp_path / "t.xml", crs=CRS)
    assert model.provenance["import"]["largest_gap_m"] < 2e-6
    at, _ = integrate(plan, np.array([0.0, 70.0, 110.0, 230.0]))
    for easting, northing in at:
        assert min(abs(foot.cross) for foot in model.locate(easting, northing)) < 1e-4


def test_what_cannot_be_written(tmp_path):
    plan = chained([(100.0, BLOSS, -1e-3, 1e-3)])
    with pytest.raises(InputError, match="bends both ways"):
        write_landxml([DesignedAlignment("T", plan)], tmp_path / "t.xml")
    good = DesignedAlignment("T", chained([(100.0, STRAIGHT, 0.0, 0.0)]))
    with pytest.raises(InputError, match="stands twice"):
        write_landxml([good, good], tmp_path / "t.xml")
    with pytest.raises(InputError, match="no alignments"):
        write_landxml([], tmp_path / "t.xml")
    assert not list(tmp_path.iterdir())
    write_landxml([good], tmp_path / "t.xml")
    with pytest.raises(InputError, match="need the plane"):
        read_landxml(tmp_path / "t.xml")


@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(5.0, 300.0), st.sampled_from([0.0, 1 / 200, -1 / 200, 1 / 900, -1 / 3000, 1 / 20_000])),
        min_size=1,
        max_size=6,
    )
)
def test_any_chain_of_elements_comes_back(tmp_path_factory, pieces):
    rows, last = [], 0.0
    for length, k in pieces:
        if last * k < 0.0:
            rows.append((60.0, CLOTHOID, last, 0.0))
            last = 0.0
        if k != last:
            rows.append((60.0, CLOTHOID, last, k))
        rows.append((length, ARC if k else STRAIGHT, k, k))
        last = k
    path = tmp_path_factory.mktemp("chain") / "t.xml"
    write_landxml([DesignedAlignment("T", chained(rows))], path)
    model = read_landxml(path, crs=CRS)
    write_landxml(model, path)  # and what is found in its knots
    again = read_landxml(path)
    assert apart(model, again, "T")[0] < 1e-3
