"""railML: a model out and in again, curves against an independent integration, signs, what is refused; railML 2."""

from __future__ import annotations

import math

import numpy as np
import pyproj
import pytest

from railnav.errors import InputError
from railnav.io.railml import read_railml
from railnav.io.railml_writer import write_railml
from railnav.simulation import demo_line
from railnav.track.model import NodeKind
from railnav.track.validation import validate

E0, N0 = 2_690_000.0, 1_250_000.0


def walked(bearing, pieces, steps=20_000):
    """End of (length, curvature law) pieces by summing many small chords: shares no code with the reader."""
    east, north, places = E0, N0, [(E0, N0, bearing)]
    for length, law in pieces:
        t = (np.arange(steps) + 0.5) / steps
        turn = law(t) * length / steps
        theta = bearing + np.cumsum(turn) - turn / 2
        east += float(np.sin(theta).sum() * length / steps)
        north += float(np.cos(theta).sum() * length / steps)
        bearing += float(turn.sum())
        places.append((east, north, bearing))
    return places


def curve(kind, element, begin, end, length, radius=0.0, azimuth=None, delta=None, keeps="true"):
    more = "" if azimuth is None else f' azimuth="{math.degrees(azimuth):.12f}"'
    more += "" if delta is None else f' deltaAzimuth="{math.degrees(delta):.12f}"'
    return (
        f'<horizontalCurve id="h{element}{begin:.3f}" curveType="{kind}" radius="{radius}" length="{length}"{more}>'
        f'<linearLocation id="l"><associatedNetElement netElementRef="{element}" keepsOrientation="{keeps}" '
        f'intrinsicCoordBegin="{begin}" intrinsicCoordEnd="{end}"/></linearLocation></horizontalCurve>'
    )


def element(name, *points, measures=()):
    inner = "".join(
        f'<intrinsicCoordinate intrinsicCoord="{at}"><geometricCoordinate positioningSystemRef="g" x="{x:.6f}" y="{y:.6f}"'
        + (f' z="{rest[0]}"' if rest else "")
        + "/></intrinsicCoordinate>"
        for at, x, y, *rest in points
    )
    inner += "".join(
        f'<intrinsicCoordinate intrinsicCoord="{at}"><linearCoordinate positioningSystemRef="l" measure="{m}"/></intrinsicCoordinate>'
        for at, m in measures
    )
    return f'<netElement id="{name}"><associatedPositioningSystem id="a{name}">{inner}</associatedPositioningSystem></netElement>'


def relation(a, ea, b, eb, way="Both"):
    return (
        f'<netRelation id="r{a}{b}" positionOnA="{ea}" positionOnB="{eb}" navigability="{way}">'
        f'<elementA ref="{a}"/><elementB ref="{b}"/></netRelation>'
    )


def document(elements, relations="", geometry="", functional="", crs='crsDefinition="EPSG:2056"', version="3.2"):
    return (
        f'<?xml version="1.0"?><railML xmlns="https://www.railml.org/schemas/3.2" version="{version}"><common><positioning>'
        f'<geometricPositioningSystems><geometricPositioningSystem id="g" {crs}/></geometricPositioningSystems></positioning>'
        f"</common><infrastructure><topology><netElements>{elements}</netElements><netRelations>{relations}</netRelations>"
        f"</topology><geometry><horizontalCurves>{geometry}</horizontalCurves></geometry>"
        f"<functionalInfrastructure>{functional}</functionalInfrastructure></infrastructure></railML>"
    )


@pytest.fixture
def read(tmp_path):
    def read_text(text, **options):
        path = tmp_path / "net.railml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_railml(path, **options)

    return read_text


STRAIGHT_TRACK = element("A", (0, E0, N0), (1, E0, N0 + 300.0))


def test_a_model_comes_back_within_a_millimetre(tmp_path):
    model = demo_line()
    write_railml(model, tmp_path / "line.railml")
    again = read_railml(tmp_path / "line.railml")
    assert again.track_id == model.track_id
    assert again.line == model.line
    assert again.name == model.name
    for was, now in zip(model.provenance.get("balises", []), again.provenance["balises"], strict=True):
        assert (was["id"], was["track"]) == (now["id"], now["track"])
        assert now["offset_m"] == pytest.approx(was["offset_m"], abs=1e-3)
    assert again.nodes.id == model.nodes.id
    assert (again.nodes.kind == NodeKind.TURNOUT).sum() == (model.nodes.kind == NodeKind.TURNOUT).sum()
    assert {tuple(row) for row in again.movements.tolist()} == {tuple(row) for row in model.movements.tolist()}
    for track in model.track_id:
        length = min(model.length(track), again.length(track))
        assert abs(model.length(track) - again.length(track)) < 1e-3
        at = np.linspace(0.0, length, max(3, int(length)))
        p, q = model.at(track, at), again.at(track, at)
        assert np.hypot(p.easting - q.easting, p.northing - q.northing).max() < 1e-3
        assert np.nan_to_num(np.abs(p.height - q.height)).max() < 1e-3
        assert np.nan_to_num(np.abs(p.chainage - q.chainage)).max() < 1e-3
    assert again.provenance["import"]["notes"] == []


@pytest.mark.parametrize(
    ("kind", "law"),
    [
        ("clothoide", lambda t: t),
        ("curveBloss", lambda t: 3 * t**2 - 2 * t**3),
        ("cosinusoide", lambda t: (1 - np.cos(np.pi * t)) / 2),
        ("sinusoide", lambda t: t - np.sin(2 * np.pi * t) / (2 * np.pi)),
    ],
)
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("stated", ["neighbours", "radius and deltaAzimuth"])
def test_curves_run_where_they_should(read, kind, law, side, stated):
    """Positive radii turn right; a transition's curvature comes from its neighbours, or from its radius and turn."""
    k = side / 400.0
    places = walked(0.7, [(50.0, lambda t: 0 * t), (80.0, lambda t: k * law(t)), (120.0, lambda t: k + 0 * t)])
    delta = places[2][2] - places[1][2]
    told = {} if stated == "neighbours" else {"radius": 400.0 * side, "delta": delta}
    middle = curve(kind, "A", 0.2, 0.52, 80.0, **told)
    curves = (
        curve("straight", "A", 0.0, 0.2, 50.0, azimuth=0.7) + middle + curve("arc", "A", 0.52, 1.0, 120.0, 400.0 * side)
    )
    model = read(document(element("A", (0, *places[0][:2]), (1, *places[3][:2])), geometry=curves))
    assert model.provenance["import"]["notes"] == []
    here = model.at("A", 50.0 * 1.0)
    assert math.hypot(float(here.easting) - places[1][0], float(here.northing) - places[1][1]) < 0.02  # grid scale
    at = np.linspace(0, model.length("A"), 2000)
    track = model.at("A", at)
    assert np.hypot(track.easting - places[2][0], track.northing - places[2][1]).min() < 0.08
    assert float(model.at("A", 200.0).curvature) == pytest.approx(k, rel=1e-3)
    assert not [d for d in validate(model) if d.kind != "missing heights"]


def test_a_curve_against_its_net_element(read):
    """keepsOrientation false: radius and azimuth are those of a train that runs from end to begin."""
    places = walked(0.3, [(200.0, lambda t: 1 / 500.0 + 0 * t)])
    backwards = curve("arc", "A", 0.0, 1.0, 200.0, -500.0, azimuth=places[1][2] + math.pi, delta=-0.4, keeps="false")
    model = read(document(element("A", (0, *places[0][:2]), (1, *places[1][:2])), geometry=backwards))
    assert model.provenance["import"]["notes"] == []
    assert float(model.at("A", 100.0).curvature) == pytest.approx(1 / 500.0, rel=1e-3)


def test_movements_are_the_relations(read):
    elements = (
        element("A", (0, E0, N0), (1, E0, N0 + 100), measures=[(0, 1000.0), (1, 1100.0)])
        + element("B", (0, E0, N0 + 100), (1, E0, N0 + 200))
        + element("C", (0, E0, N0 + 100), (1, E0 + 10, N0 + 200))
    )
    relations = relation("A", 1, "B", 0) + relation("A", 1, "C", 0) + relation("B", 0, "C", 0, "None")
    functional = (
        '<switchesIS><switchIS id="s1"><name name="W 1"/><spotLocation netElementRef="A" intrinsicCoord="1"/></switchIS></switchesIS>'
        '<balises><balise id="b1"><name name="B 7"/><spotLocation netElementRef="B" intrinsicCoord="0.25"/></balise></balises>'
        '<bufferStops><bufferStop id="p"><spotLocation netElementRef="C" intrinsicCoord="1"/></bufferStop></bufferStops>'
        '<lines><line id="l"><name name="80"/><linearLocation><associatedNetElement netElementRef="A"/></linearLocation></line></lines>'
    )
    model = read(document(elements, relations, functional=functional))
    assert {tuple(row) for row in model.movements.tolist()} == {(0, 1, 1, 0), (0, 1, 2, 0)}
    assert "W 1" in model.nodes.id
    assert model.nodes.kind[model.nodes.id.index("W 1")] == NodeKind.TURNOUT
    assert model.nodes.kind[model.end_node[2]] == NodeKind.BUFFER_STOP
    assert model.line == ("80", "", "")
    assert float(model.at("A", 50.0).chainage) == pytest.approx(1050.0, abs=0.1)
    (balise,) = model.provenance["balises"]
    assert (balise["name"], balise["track"]) == ("B 7", "B")
    assert balise["offset_m"] == pytest.approx(25.0, abs=0.01)


def test_curves_that_do_not_fit_are_said(read):
    off = document(STRAIGHT_TRACK, geometry=curve("arc", "A", 0.0, 1.0, 300.0, 400.0, azimuth=0.0))
    model = read(off)
    assert "its drawn line counts" in model.provenance["import"]["notes"][0]
    assert abs(float(model.at("A", 150.0).curvature)) < 1e-9
    part = document(STRAIGHT_TRACK, geometry=curve("straight", "A", 0.0, 0.5, 150.0))
    assert "150.00 m uncovered" in read(part).provenance["import"]["notes"][0]


def test_geographic_positions(read):
    text = document(
        element("A", (0, 8.5, 47.4, 500.0), (1, 8.51, 47.4, 501.0)), crs='crsDefinition="urn:ogc:def:crs:EPSG::4326"'
    )
    model = read(text)
    _, _, distance = pyproj.Geod(ellps="WGS84").inv(8.5, 47.4, 8.51, 47.4)
    assert model.length("A") == pytest.approx(distance * (1 + 500.5 / 6.38e6), abs=1e-2)
    assert float(model.at("A", 0.0).height) == pytest.approx(500.0)


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]><railML version="3.2">&b;</railML>'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is no XML"),
        (document(STRAIGHT_TRACK)[:300], "may be cut short"),
        (BOMB, "has a document type"),
        ("<LandXML/>", "'LandXML', not railML"),
        ("<railML version='4.0'/>", "is railML '4.0'"),
        ("<railML version='3.2'/>", "has no infrastructure"),
        (document(""), "has no netElement"),
        (document('<netElement id="A"/>'), "no geometricCoordinate at both of its ends"),
        (document(element("A", (0, E0, N0))), "no geometricCoordinate at both of its ends"),
        (document(STRAIGHT_TRACK + STRAIGHT_TRACK), "netElement 'A' in line 1: stands twice"),
        (document(STRAIGHT_TRACK, crs=""), "does not state the coordinate system"),
        (document(STRAIGHT_TRACK, crs='crsDefinition="EPSG:999999"'), "999999"),
        (document(STRAIGHT_TRACK.replace(f'x="{E0:.6f}"', 'x="nan"')), "x is nan"),
        (document(STRAIGHT_TRACK, relation("A", 1, "B", 0)), "names a net element 'B' that is not there"),
        (document(STRAIGHT_TRACK, relation("A", 0.5, "A", 0)), "positionOnA is 0.5"),
        (document(STRAIGHT_TRACK, relation("A", 1, "A", 0, "Up")), "navigability is 'Up'"),
        (
            document(STRAIGHT_TRACK, geometry=curve("curveWiener", "A", 0, 1, 300)),
            "curveType 'curveWiener' is not read",
        ),
        (
            document(STRAIGHT_TRACK, geometry=curve("doucine", "A", 0, 1, 300)),
            "'doucine' is not read; known are straight",
        ),
        (document(STRAIGHT_TRACK, geometry=curve("arc", "A", 0, 1, 300)), "radius is 0 m"),
        (document(STRAIGHT_TRACK, geometry=curve("clothoide", "A", 0, 1, 300)), "curvatures at its ends are not known"),
    ],
)
def test_what_is_refused(read, text, words):
    with pytest.raises(InputError, match=words):
        read(text)


# --- railML 2 ---------------------------------------------------------------------------------------------------------


def old(tracks, version="2.5"):
    return (
        f'<railml xmlns="https://www.railml.org/schemas/2021" version="{version}"><infrastructure id="i"><tracks>{tracks}'
        "</tracks></infrastructure></railml>"
    )


def place(x, y):
    return f'<geoCoord coord="{x:.4f} {y:.4f}" epsgCode="2056"/>'


MAIN = (
    f'<track id="main" name="Main"><trackTopology><trackBegin id="mb" pos="0" absPos="5000">{place(E0, N0)}<openEnd id="o1"/></trackBegin>'
    f'<trackEnd id="me" pos="400" absPos="5400">{place(E0, N0 + 400)}<openEnd id="o2"/></trackEnd>'
    '<connections><switch id="w1" pos="100"><connection id="c1" ref="c2" course="right" orientation="outgoing"/></switch></connections>'
    '</trackTopology><ocsElements><balises><balise id="bal" pos="300"/></balises></ocsElements></track>'
)
_ARC = walked(0.0, [(200.0, lambda t: 1 / 300 + 0 * t)])
BRANCH = (
    '<track id="branch"><trackTopology><trackBegin id="bb" pos="0">'
    f'{place(E0, N0 + 100)}<connection id="c2" ref="c1"/></trackBegin><trackEnd id="be" pos="200">'
    f'{place(_ARC[1][0], _ARC[1][1] + 100)}<bufferStop id="x"/></trackEnd></trackTopology>'
    '<trackElements><radiusChanges><radiusChange id="r" pos="0" radius="300"/></radiusChanges></trackElements></track>'
)


def test_railml_2_tracks_are_cut_at_switches(read):
    model = read(old(MAIN + BRANCH))
    assert model.track_id == ("main.1", "main.2", "branch")
    assert {tuple(row) for row in model.movements.tolist()} == {(0, 1, 1, 0), (0, 1, 2, 0)}
    assert model.length("main.1") == pytest.approx(100.0, abs=0.1)
    assert float(model.at("main.2", 0.0).chainage) == pytest.approx(5100.0, abs=1e-6)
    assert float(model.at("branch", 100.0).curvature) == pytest.approx(
        1 / 300, rel=1e-3
    )  # positive radius: to the right
    assert model.provenance["balises"][0]["track"] == "main.2"
    assert not [d for d in validate(model) if d.kind != "missing heights"]


def test_railml_2_left_is_negative(read):
    end = walked(0.0, [(200.0, lambda t: -1 / 300 + 0 * t)])[1]
    left = BRANCH.replace('radius="300"', 'radius="-300"').replace(f"{_ARC[1][0]:.4f}", f"{end[0]:.4f}")
    model = read(old(MAIN + left))
    assert float(model.at("branch", 100.0).curvature) == pytest.approx(-1 / 300, rel=1e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (old(""), "has no track with a trackTopology"),
        (old(MAIN), "refers to 'c2', which is not there"),
        (old(MAIN.replace(place(E0, N0), "") + BRANCH), "no geoCoord at both of its ends"),
        (old(MAIN + BRANCH.replace('epsgCode="2056"', 'epsgCode="4326"')), "mixes coordinate systems"),
        (old(MAIN.replace('pos="400"', 'pos="0"') + BRANCH), "lies 0 m from the trackBegin"),
    ],
)
def test_what_is_refused_of_railml_2(read, text, words):
    with pytest.raises(InputError, match=words):
        read(text)
