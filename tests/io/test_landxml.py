"""LandXML: plan against an independent integration, profile against circles and parabolas, cant, stations; what is refused."""

from __future__ import annotations

import math
import random
import re

import numpy as np
import pytest

from railnav.errors import CrsError, InputError, RailnavError
from railnav.io.landxml import read_landxml
from railnav.track.validation import validate

CRS = "EPSG:2056"
E0, N0 = 2_690_000.0, 1_250_000.0

LAWS = {
    "clothoid": lambda t: t,
    "bloss": lambda t: 3 * t**2 - 2 * t**3,
    "cosine": lambda t: (1 - np.cos(np.pi * t)) / 2,
    "sinusoid": lambda t: t - np.sin(2 * np.pi * t) / (2 * np.pi),
    "biquadratic": lambda t: np.where(t < 0.5, 2 * t**2, -1 + 4 * t - 2 * t**2),
    "wienerBogen": lambda t: 35 * t**4 - 84 * t**5 + 70 * t**6 - 20 * t**7,
}


def sway_law(t):
    return 420 * t**2 - 1680 * t**3 + 2100 * t**4 - 840 * t**5


class Pen:
    """Draws elements by summing 20,000 steps each, and writes them as LandXML: shares no code with the reader."""

    def __init__(self, bearing=0.3, east=E0, north=N0):
        self.east, self.north, self.bearing, self.length, self.xml = east, north, bearing, 0.0, []

    def _run(self, length, curvature):
        t = (np.arange(20_000) + 0.5) / 20_000
        step = length / 20_000
        bends = curvature(t) * step
        bearing = self.bearing + np.cumsum(bends) - bends / 2
        start = (self.east, self.north, self.bearing)
        self.east += float(np.sin(bearing).sum() * step)
        self.north += float(np.cos(bearing).sum() * step)
        self.bearing += float(bends.sum())
        self.length += length
        return start

    @staticmethod
    def _point(name, east, north):
        return f"<{name}>{north:.6f} {east:.6f}</{name}>"

    def _add(self, head, start, *middle):
        points = self._point("Start", *start[:2]) + "".join(middle) + self._point("End", self.east, self.north)
        self.xml.append(f"<{head}>{points}</{head.split()[0]}>")
        return self

    def line(self, length):
        return self._add(f'Line length="{length}"', self._run(length, np.zeros_like))

    def curve(self, length, radius, rot):
        side = 1.0 if rot == "cw" else -1.0
        start = self._run(length, lambda t: np.full_like(t, side / radius))
        centre = start[0] + side * radius * math.cos(start[2]), start[1] - side * radius * math.sin(start[2])
        return self._add(
            f'Curve rot="{rot}" radius="{radius}" length="{length}" crvType="arc"',
            start,
            self._point("Center", *centre),
        )

    def spiral(self, length, first, last, rot, kind, sway=0.0):
        side = 1.0 if rot == "cw" else -1.0
        k0, k1 = side / first, side / last
        start = self._run(length, lambda t: k0 + (k1 - k0) * LAWS[kind](t) - sway * sway_law(t))
        a = np.array([math.sin(start[2]), math.cos(start[2])])
        b = np.array([math.sin(self.bearing), math.cos(self.bearing)])
        along = np.linalg.solve(np.column_stack([a, b]), [self.east - start[0], self.north - start[1]])
        radii = [("INF" if math.isinf(r) else r) for r in (first, last)]
        head = f'Spiral spiType="{kind}" rot="{rot}" length="{length}" radiusStart="{radii[0]}" radiusEnd="{radii[1]}"'
        return self._add(head, start, self._point("PI", start[0] + along[0] * a[0], start[1] + along[0] * a[1]))


def document(*alignments, units='<Metric linearUnit="meter" directionUnit="radians"/>'):
    return (
        '<?xml version="1.0"?><LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2">'
        f"<Units>{units}</Units><Alignments>{''.join(alignments)}</Alignments></LandXML>"
    )


def alignment(pen, extra="", name="A", start=0.0):
    xml = pen if isinstance(pen, str) else "".join(pen.xml)
    return f'<Alignment name="{name}" staStart="{start}"><CoordGeom>{xml}</CoordGeom>{extra}</Alignment>'


@pytest.fixture
def read(tmp_path):
    def read_text(text, crs=CRS, **options):
        path = tmp_path / "line.xml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_landxml(path, crs=crs, **options)

    return read_text


def on_grid(model, track, along):
    """Point of a track where `along` metres of its grid length are run."""
    own = model.knots(track)
    step = np.hypot(np.diff(model.easting[own]), np.diff(model.northing[own]))
    step *= 1.0 + (0.5 * (model.curvature[own][1:] + model.curvature[own][:-1])) ** 2 * step**2 / 24.0  # arc over chord
    grid = np.append(0.0, np.cumsum(step))
    return model.at(track, np.interp(along, grid, model.offset[own]))


# --- plan -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", LAWS)
@pytest.mark.parametrize("rot", ["cw", "ccw"])
def test_every_transition_closes(read, kind, rot):
    pen = Pen().line(50).spiral(80, math.inf, 400, rot, kind).curve(60, 400, rot).spiral(90, 400, 700, rot, kind)
    model = read(document(alignment(pen)))
    told = model.provenance["import"]
    assert told["largest_gap_m"] < 2e-5
    assert told["largest_kink_deg"] < 1e-4
    point = on_grid(model, "A", 50 + 80 + 30)
    assert float(point.curvature) == pytest.approx((1 if rot == "cw" else -1) / 400, rel=1e-3)
    own = model.knots("A")
    assert math.hypot(model.easting[own][-1] - pen.east, model.northing[own][-1] - pen.north) < 2e-5
    slope = np.gradient(np.unwrap(model.grid_bearing[own]), model.offset[own], edge_order=2)
    smooth = slice(5, -5)
    assert np.abs(slope - model.curvature[own])[smooth].max() < 6e-5
    assert not [defect for defect in validate(model) if defect.kind != "missing heights"]


def test_a_wrong_transition_type_is_refused(read):
    """0.28 m between a clothoid and a Bloss curve of L = 100 m, R = 600 m (spec/track_geometry.md 3.1)."""
    text = document(alignment(Pen().spiral(100, math.inf, 600, "cw", "bloss").line(10)))
    read(text)
    with pytest.raises(InputError, match=r"Spiral in line 1: its length, radii and kind lead 0\.\d+ m past"):
        read(text.replace('"bloss"', '"clothoid"'))


@pytest.mark.parametrize("kind", ["cubic", "revBloss", "sineHalfWave", "radioid", "japaneseCubic", "spline"])
def test_unknown_transitions_are_refused_by_name(read, kind):
    text = document(alignment(Pen().spiral(100, math.inf, 600, "cw", "clothoid"))).replace('"clothoid"', f'"{kind}"')
    with pytest.raises(InputError, match=f"spiType '{kind}' is not read; known are clothoid"):
        read(text)


def test_a_cubic_parabola_must_be_one(read):
    """A clothoid of L = 100 m, R = 600 m called a cubic parabola ends 27 mm off: its length is not that of its tangent."""
    text = document(alignment(Pen().spiral(100, math.inf, 600, "cw", "clothoid"))).replace(
        '"clothoid"', '"cubicParabola"'
    )
    with pytest.raises(
        InputError, match=r"spiType 'cubicParabola': one of this length and radius ends \d+\.\d mm from its End"
    ):
        read(text)
    both = document(alignment(Pen().spiral(100, 900, 600, "cw", "clothoid"))).replace('"clothoid"', '"cubicParabola"')
    with pytest.raises(InputError, match="cubic parabola between two arcs"):
        read(both)


def test_the_swing_of_a_viennese_bend_follows_from_its_end(read):
    """h = 1.8 m, cant 100 mm, L = 100 m: 0.12 m (spec/track_geometry.md 3.1), which the end point shows."""
    sway = 1.8 * (0.100 / 1.5) / 100.0**2
    cant = (
        '<Cant><CantStation station="0" appliedCant="0" transitionType="wienerBogen" curvature="cw"/>'
        '<CantStation station="100" appliedCant="100" curvature="cw"/></Cant>'
    )
    pen = Pen().spiral(100, math.inf, 600, "cw", "wienerBogen", sway).curve(30, 600, "cw")
    model = read(document(alignment(pen, cant)))
    assert model.provenance["import"]["largest_gap_m"] < 2e-5
    t = 0.3
    expected = LAWS["wienerBogen"](t) / 600 - sway * sway_law(t)
    assert float(on_grid(model, "A", 30.0).curvature) == pytest.approx(expected, abs=2e-7)
    high = Pen().spiral(100, math.inf, 600, "cw", "wienerBogen", 3 * sway).curve(30, 600, "cw")
    with pytest.raises(InputError, match=r"centre of gravity 5\.4\d? m above the rails"):
        read(document(alignment(high, cant)))


def test_axes_exchanged_are_told_from_the_points(read):
    text = document(alignment(Pen().line(50).curve(200, 400, "cw")))
    swapped = re.sub(r"(?<=>)([\d.]+) ([\d.]+)(?=<)", r"\2 \1", text)
    with pytest.raises(InputError, match=r"points turn the other way than rot='cw' says.*northing easting"):
        read(swapped)
    with pytest.raises(InputError, match="axes exchanged"):
        read(document(alignment(Pen().spiral(100, math.inf, 400, "cw", "bloss"))).replace('"cw"', '"ccw"'))


@pytest.mark.parametrize(
    ("unit", "zero", "sense", "per"),
    [
        ("grads", 0.0, 1, 200 / math.pi),
        ("decimal degrees", math.pi / 2, -1, 180 / math.pi),
        ("radians", 0.0, -1, 1.0),
    ],
)
def test_directions_of_every_program(read, unit, zero, sense, per):
    text = document(
        alignment(Pen(0.3).line(50).curve(80, 500, "cw").line(20)),
        units=f'<Metric linearUnit="meter" directionUnit="{unit}"/>',
    )
    bearings = iter([0.3, 0.3 + 80 / 500])
    text = re.sub("<Line ", lambda m: f'<Line dir="{((next(bearings) - zero) * sense) * per:.9f}" ', text)
    told = read(text).provenance["import"]
    assert told["directions"] == [
        {(0.0, 1): "clockwise from north", (0.0, -1): "counter-clockwise from north"}.get(
            (zero, sense), "counter-clockwise from east"
        )
    ]
    assert told["notes"] == []
    wrong = read(re.sub('dir="[^"]*"', 'dir="1.23"', text)).provenance["import"]
    assert "dir" in wrong["notes"][0]


def test_sexagesimal_directions(read):
    text = document(
        alignment(Pen(math.radians(17 + 11 / 60 + 19.4 / 3600)).line(50)),
        units='<Metric linearUnit="meter" directionUnit="decimal dd.mm.ss"/>',
    )
    told = read(text.replace("<Line ", '<Line dir="17.11194" ')).provenance["import"]
    assert told["directions"] == ["clockwise from north"]
    assert told["notes"] == []


# --- profile, cant, stations ------------------------------------------------------------------------------------------


def test_profile_of_circles_and_parabolas(read):
    profile = (
        "<Profile><ProfAlign><PVI>100 50</PVI><CircCurve length='60' radius='3000'>300 50</CircCurve>"
        "<ParaCurve length='80'>600 56</ParaCurve><UnsymParaCurve lengthIn='20' lengthOut='60'>800 52</UnsymParaCurve>"
        "<PVI>1100 58</PVI></ProfAlign></Profile>"
    )
    model = read(document(alignment(Pen().line(1000), profile, start=100.0)))
    truth = {100: 50.0, 200: 50.0, 450: 53.0, 700: 54.0, 1000: 56.0, 1100: 58.0}
    # a circle of 3,000 m touches both straights: mid-ordinate R (1/cos(a/2) - 1) seen from the corner
    a = math.atan(0.02)
    x = 3000 * math.sin(a / 2)  # where its gradient is half way
    begin = 300 - 3000 * math.tan(a / 2)
    truth[begin + x] = 50 + 3000 * (1 - math.cos(a / 2))
    truth[600] = 56 - (0.04) * 80 / 8
    truth[800] = 52 + (0.04) * 20 * 60 / (2 * 80)
    for station, height in truth.items():
        assert float(on_grid(model, "A", station - 100).height) == pytest.approx(height, abs=2e-4), station
    assert float(on_grid(model, "A", begin + x - 100).gradient) == pytest.approx(math.tan(a / 2), abs=2e-6)
    slope = np.gradient(model.height, model.offset)
    assert np.abs(slope - model.gradient / np.hypot(1, model.gradient))[2:-2].max() < 6e-4
    assert float(on_grid(model, "A", 350).gradient) == pytest.approx(0.02, rel=3e-4)


def test_cant_follows_the_curve(read):
    def stations(*rows):
        return "<Cant>" + "".join(f"<CantStation {row}/>" for row in rows) + "</Cant>"

    pen = Pen().line(50).spiral(50, math.inf, 400, "ccw", "bloss").curve(60, 400, "ccw")
    cant = stations(
        'station="0" appliedCant="0" curvature="cw"',
        'station="50" appliedCant="0" curvature="cw" transitionType="bloss"',
        'station="100" appliedCant="120" curvature="ccw"',
    )
    model = read(document(alignment(pen, cant)))
    assert float(on_grid(model, "A", 130).cant) == pytest.approx(-0.120, abs=1e-9)  # left curve: right rail high
    assert float(on_grid(model, "A", 62.5).cant) == pytest.approx(-0.120 * LAWS["bloss"](0.25), abs=4e-5)
    adverse = cant.replace('appliedCant="120"', 'appliedCant="120" adverse="true"')
    assert float(on_grid(read(document(alignment(pen, adverse))), "A", 130).cant) == pytest.approx(0.120, abs=1e-9)
    with pytest.raises(InputError, match="transitionType 'cubic' is not read"):
        read(document(alignment(pen, cant.replace('"bloss"', '"cubic"'))))
    with pytest.raises(InputError, match="cw or ccw: it names the higher rail"):
        read(document(alignment(pen, cant.replace('curvature="ccw"', ""))))


def test_station_equations_become_chainage(read):
    equations = '<StaEquation staInternal="100" staAhead="5000"/><StaEquation staInternal="200" staAhead="5300" staBack="5100"/>'
    model = read(document(alignment(Pen().line(300), equations, start=-50.0)))
    for along, station in (
        (0, -50),
        (100, 50),
        (149.9, 99.9),
        (150.1, 5000.1),
        (200, 5050),
        (249.9, 5099.9),
        (250.1, 5300.1),
    ):
        assert float(on_grid(model, "A", along).chainage) == pytest.approx(station, abs=2e-3)
    assert float(on_grid(model, "A", 300).chainage) == pytest.approx(5350, abs=2e-3)
    back = '<StaEquation staInternal="100" staAhead="900" staIncrement="decreasing"/>'
    falling = read(document(alignment(Pen().line(300), back)))
    assert float(on_grid(falling, "A", 250).chainage) == pytest.approx(750, abs=2e-3)


# --- networks ---------------------------------------------------------------------------------------------------------


def test_a_branch_cuts_the_track_it_leaves(read):
    main = Pen(0.0).line(400)
    branch = Pen(0.0, north=N0 + 150).curve(60, 300, "cw")
    model = read(document(alignment(main, name="M"), alignment(branch, name="B")))
    assert model.track_id == ("M.1", "M.2", "B")
    (junction,) = model.provenance["import"]["joined"]
    assert junction["track"] == "B"
    assert junction["on"] == "M"
    assert junction["distance_m"] < 1e-3
    assert model.length("M.1") == pytest.approx(150.0, abs=0.05)
    assert [len(r.tracks) for r in model.routes("M.1", "B")] == [2]
    assert not model.routes("M.2", "B")
    assert float(model.at("M.2", 0.0).chainage) == pytest.approx(150.0, abs=1e-3)
    assert not [defect for defect in validate(model) if defect.kind != "missing heights"]
    across = Pen(0.6, north=N0 + 150).line(60)
    lone = read(document(alignment(main, name="M"), alignment(across, name="B")))
    assert lone.track_id == ("M", "B")
    assert len(lone.provenance["import"]["not_joined"]) == 1


# --- bad input --------------------------------------------------------------------------------------------------------

GOOD = document(alignment(Pen().line(50).spiral(80, math.inf, 400, "cw", "clothoid").curve(60, 400, "cw")))
BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is no XML"),
        ("{}", "is no XML"),
        (GOOD[: len(GOOD) // 2], "may be cut short"),
        ("<gpx/>", "'gpx', not LandXML"),
        (GOOD.replace('version="1.2"', 'version="2.0"'), "is LandXML '2.0'"),
        (GOOD.replace('linearUnit="meter"', 'linearUnit="USSurveyFoot"'), "is in USSurveyFoot"),
        (GOOD.replace("Metric", "Imperial"), "export it in metres"),
        (GOOD.replace('"radians"', '"mils"'), "directionUnit 'mils' is unknown"),
        (GOOD.replace("Alignment ", "Parcel ").replace("/Alignment>", "/Parcel>"), "has no Alignment"),
        (document(alignment("")), "holds no elements"),
        (document(alignment("<IrregularLine/>")), "IrregularLine in line 1: is no element of a designed track"),
        (GOOD.replace('name="A"', ""), "has no name"),
        (document(*[alignment(Pen().line(9))] * 2), "alignment 'A' stands twice"),
        (GOOD.replace('radius="400"', 'radius="INF"'), "radius is INF; use a Line"),
        (GOOD.replace('radiusEnd="400"', 'radiusEnd="INF"'), "straight at both ends"),
        (GOOD.replace('radiusEnd="400"', 'radiusEnd="nan"'), "radiusEnd is nan"),
        (GOOD.replace('radiusEnd="400"', 'radiusEnd="-400"'), "radiusEnd is -400"),
        (GOOD.replace('radius="400"', 'radius="401"'), "its Center lies 400.000 m"),
        (GOOD.replace('rot="cw"', 'rot="left"'), "use cw or ccw"),
        (GOOD.replace("PI>", "Pi>"), "has no PI"),
        (GOOD.replace('length="80"', 'length="81"'), "past the start of the next element|past its own end"),
        (GOOD.replace("<Start>", "<Start>x"), "not numbers"),
        (BOMB + "]><LandXML>&i;</LandXML>", "has a document type"),
        ('<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><LandXML>&a;</LandXML>', "has a document type"),
        ((BOMB + "]><LandXML>&i;</LandXML>").encode("utf-16"), "has a document type"),
    ],
)  # fmt: skip
def test_what_is_refused(read, text, words):
    with pytest.raises(InputError, match=words):
        read(text)


def test_profiles_that_are_none(read):
    def profile(inner):
        return document(alignment(Pen().line(500), f"<Profile><ProfAlign>{inner}</ProfAlign></Profile>"))

    for inner, words in [
        ("<PVI>0 5</PVI>", "only point"),
        ("<PVI>0 5</PVI><PVI>0 6</PVI>", "does not follow"),
        ("<PVI>0 5</PVI><PVI>500 900</PVI>", "a gradient of 1.79"),
        ("<PVI>0 5</PVI><ParaCurve length='600'>200 5</ParaCurve><PVI>500 8</PVI>", "overlaps"),
        ("<PVI>0 99999</PVI><PVI>500 900</PVI>", "a height of 99999 m"),
    ]:
        with pytest.raises(InputError, match=words):
            read(profile(inner))


def test_a_plane_that_does_not_fit(read):
    with pytest.raises(CrsError):
        read(GOOD, crs="EPSG:31467")


@pytest.mark.slow
def test_mutated_files_never_trace_back(read):
    profile = "<Profile><ProfAlign><PVI>0 5</PVI><CircCurve radius='3000'>90 6</CircCurve><PVI>190 9</PVI></ProfAlign></Profile>"
    cant = "<Cant><CantStation station='0' appliedCant='50' curvature='cw'/></Cant>"
    good = GOOD.replace(
        "</CoordGeom>", f"</CoordGeom>{profile}{cant}<StaEquation staInternal='60' staAhead='9'/>"
    ).encode()
    dice = random.Random(6)
    tokens = [
        b"INF",
        b"-1",
        b"1e300",
        b"nan",
        b"0",
        b"",
        b"cw",
        b"ccw",
        b"<",
        b'"',
        b"\xff",
        b"9999999",
        b"PI",
        b"1e-9",
    ]
    outcomes = {"read": 0, "refused": 0}
    for _ in range(300):
        data = bytearray(good)
        for _ in range(dice.choice((1, 1, 2, 4))):
            if dice.random() < 0.6:
                number = dice.choice(list(re.finditer(rb'[\d.]+|"\w+"', bytes(data))))
                data[number.start() : number.end()] = dice.choice(tokens)
            else:
                at = dice.randrange(len(data))
                data[at : at + dice.randrange(6)] = dice.randbytes(dice.randrange(4))
        try:
            read(bytes(data))
            message = "read"
        except RailnavError as error:
            message = str(error)
        assert "\n" not in message
        outcomes["read" if message == "read" else "refused"] += 1
    assert min(outcomes.values()) > 10, outcomes


# --- real files -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sbb(shared_data):
    folder = shared_data / "sbb"
    if not folder.is_dir():
        pytest.skip("the SBB files are not here")
    return folder


def test_zuerich_winterthur(sbb):
    path = sbb / "zuerich-winterthur.landxml.xml"
    model = read_landxml(path, crs=CRS)
    told = model.provenance["import"]
    assert told["tracks"] == 11
    assert told["elements"] == 285
    assert told["largest_gap_m"] < 1e-3
    assert told["largest_kink_deg"] < 0.03
    assert len(told["joined"]) == 14
    assert max(j["distance_m"] for j in told["joined"]) < 1e-3
    assert validate(model) == []
    # the two main tracks
    apart = []
    for track in ("A50034A.1", "A50034A.6"):
        for offset in np.arange(0.0, model.length(track), 10.0):
            point = model.at(track, offset)
            near = [
                c
                for c in model.locate(float(point.easting), float(point.northing), within=12.0)
                if c.track.startswith("A50068A")
            ]
            apart += [near[0].distance] if near else []
    assert np.median(apart) == pytest.approx(4.0, abs=0.25)
    assert np.min(np.abs(np.array(apart)[:, None] - [3.8, 4.0])) < 1e-3
    assert np.mean(np.abs(np.array(apart) - 4.0) < 0.01) > 0.2
    # cant to the file's digits: rows of the file itself, A50034A before its first junction
    text = path.read_text(encoding="utf-8-sig").split('<Alignment name="A50068A"')[0]
    rows = re.findall(r'<CantStation station="([\d.]+)" appliedCant="([\d.]+)" [^>]*curvature="(c?cw)"', text)
    scale = model.length("A50034A.1") / 10107.453
    assert len(rows) > 50
    for station, cant, rot in rows:
        if 1.0 < float(station) < 10000.0:
            found = float(model.at("A50034A.1", model_offset(model, "A50034A.1", float(station))).cant) * 1e3
            assert found == pytest.approx(float(cant) * (1 if rot == "cw" else -1), abs=0.05), station
    assert scale == pytest.approx(1.0, abs=1e-6)
    assert model.cant.max() == pytest.approx(0.150, abs=1e-9)
    assert model.cant.min() == pytest.approx(-0.150, abs=1e-9)


def model_offset(model, track, station):
    """Offset where the chainage is `station`."""
    low, high = 0.0, model.length(track)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if float(model.at(track, middle).chainage) < station else (low, middle)
    return low


def test_stn02(sbb):
    model = read_landxml(sbb / "stn02.landxml.xml", crs="EPSG:32633")
    told = model.provenance["import"]
    assert told["largest_gap_m"] < 1e-6
    assert told["elements"] == 14
    assert any("cant is counted from the start" in note for note in told["notes"])
    assert float(model.at("Asse_BP", 0.0).chainage) == pytest.approx(-153.1)
    assert float(on_grid(model, "Asse_BP", 1029.38).chainage) == pytest.approx(5350.008, abs=2e-3)
    # each arc has its full cant, to its own side, also past the station equation
    for along, cant in ((427.7233, -60), (621.0, -60), (740.2, 60), (849.5, 60), (1139.9, 50), (1312.7, 50)):
        assert abs(float(on_grid(model, "Asse_BP", along).cant)) * 1e3 == pytest.approx(abs(cant), abs=0.02)
    curved = np.abs(model.curvature) > 1e-4
    assert (
        np.sign(model.cant[curved & (np.abs(model.cant) > 1e-3)])
        == np.sign(model.curvature[curved & (np.abs(model.cant) > 1e-3)])
    ).all()
    assert float(on_grid(model, "Asse_BP", 0.0).height) == pytest.approx(5.0, abs=1e-9)
    assert float(on_grid(model, "Asse_BP", 1458.59).height) == pytest.approx(4.0, abs=1e-4)
