"""Elements: curvature laws, joints, profiles and true lengths; what is refused and by which words."""

from __future__ import annotations

import csv
import itertools
import math

import numpy as np
import pytest

from railnav.errors import CrsError, InputError
from railnav.io.elements import read_elements

HEADER = (
    "track", "sequence", "start_m", "length_m", "element", "radius_start_m", "radius_end_m",
    "easting_m", "northing_m", "grid_bearing_deg",
)  # fmt: skip
E0, N0 = 3_462_825.0, 5_481_774.0
CRS = "EPSG:31467"


def straight(**changes):
    row = dict(zip(HEADER, ("A", 1, 0.0, 100.0, "straight", "", "", E0, N0, 0.0), strict=True))
    return row | changes


@pytest.fixture
def read(tmp_path):
    def read_rows(*rows, crs=CRS, **options):
        path = tmp_path / "elements.csv"
        names = list(dict.fromkeys(key for row in rows for key in row))
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(rows)
        return read_elements(path, crs=crs, **options)

    return read_rows


# --- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("element", "lateral"),
    [("clothoid", 2.776), ("Bloss", 2.499), ("cosine", 2.477), ("helmert", 2.429), ("schramm", 2.429), ("sine", 2.354)],
)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_transitions_end_where_their_law_says(read, element, lateral, side):
    """spec/track_geometry.md 3.1: end offset of L = 100 m, R = 600 m, all laws checked there on buildingSMART's files."""
    model = read(straight(element=element, radius_end_m=600.0 * side))
    own = model.knots("A")
    assert model.easting[own][-1] - E0 == pytest.approx(side * lateral, abs=6e-4)
    assert float(model.grid_bearing[own][-1]) == pytest.approx(side * 100.0 / 1200.0, abs=1e-12)  # every law: half k L
    assert float(model.curvature[own][-1]) == pytest.approx(side / 600.0, rel=2e-5)
    # and backwards it is the mirror image
    back = read(straight(element=element, radius_start_m=600.0 * side))
    assert back.grid_bearing[back.knots("A")][-1] == pytest.approx(side * 100.0 / 1200.0, abs=1e-12)


@pytest.mark.parametrize("element", ["clothoid", "bloss", "cosine", "helmert", "sine"])
def test_curvature_is_the_derivative_of_bearing(read, element):
    model = read(straight(element=element, radius_start_m=-400.0, radius_end_m=500.0), spacing=0.25)
    own = model.knots("A")
    slope = np.gradient(model.grid_bearing[own], model.offset[own], edge_order=2)
    np.testing.assert_allclose(slope, model.curvature[own], rtol=0, atol=3e-7)
    chord = np.hypot(np.diff(model.easting[own]), np.diff(model.northing[own]))
    along = np.arctan2(np.diff(model.easting[own]), np.diff(model.northing[own]))
    np.testing.assert_allclose(along, 0.5 * (model.grid_bearing[own][1:] + model.grid_bearing[own][:-1]), atol=1e-6)
    np.testing.assert_allclose(chord.sum(), 100.0, atol=1e-4)


def test_an_arc_is_a_circle_in_the_grid(read):
    model = read(
        straight(element="arc", radius_start_m=300.0, radius_end_m=300.0, grid_bearing_deg=90.0, length_m=500.0)
    )
    own = model.knots("A")
    centre = (E0, N0 - 300.0)  # to the right of eastwards is south
    np.testing.assert_allclose(
        np.hypot(model.easting[own] - centre[0], model.northing[own] - centre[1]), 300.0, atol=1e-9
    )
    assert (model.curvature[own] > 0).all()


def test_offsets_are_true_ground_lengths(read):
    rows = [
        straight(length_m=1000.0, grid_bearing_deg=30.0, height_m=300.0, gradient=0.02),
        straight(
            sequence=2, start_m=1000.0, length_m=500.0, grid_bearing_deg=30.0, height_m=320.0, gradient=0.02,
            easting_m=E0 + 1000.0 * math.sin(math.radians(30.0)), northing_m=N0 + 1000.0 * math.cos(math.radians(30.0)),
        ),
    ]  # fmt: skip
    model = read(*rows)
    own = model.knots("A")
    e, n, h = model.easting[own], model.northing[own], model.height[own]
    pieces = model.frame.ground_length(e[:-1], n[:-1], h[:-1], e[1:], n[1:], h[1:])
    np.testing.assert_allclose(np.diff(model.offset[own]), pieces, rtol=0, atol=1e-8)
    # 6.7 ppm: the metre of DHDN is longer; 17 ppm of the zone, 47 ppm of 300 m, 200 ppm of the slope
    assert model.length("A") == pytest.approx(1500.0 * (1.0 + 6.7e-6 - 17e-6 + 47e-6 + 200e-6), abs=0.02)
    flat = read(*({k: v for k, v in row.items() if k not in ("height_m", "gradient")} for row in rows))
    assert np.isnan(flat.height).all()
    assert flat.length("A") < model.length("A") - 0.3


def test_profile_holds_heights_and_gradients(read):
    def row(i, height, gradient):
        return straight(sequence=i, start_m=100.0 * i, northing_m=N0 + 100.0 * i, height_m=height, gradient=gradient)

    model = read(row(0, 100.0, 0.0), row(1, 100.5, 0.01), row(2, 101.5, 0.01))
    for i, (height, gradient) in enumerate([(100.0, 0.0), (100.5, 0.01), (101.5, 0.01), (102.5, 0.01)]):
        offset = min(100.0 * i * model.length("A") / 300.0, model.length("A"))
        point = model.at("A", offset)
        assert float(point.height) == pytest.approx(height, abs=2e-4)
        assert float(point.gradient) == pytest.approx(gradient, abs=2e-4)


def test_heights_without_gradients_are_joined_smoothly(read):
    rows = [
        straight(sequence=i, start_m=100.0 * i, northing_m=N0 + 100.0 * i, height_m=100.0 + i + 0.5 * math.sin(i))
        for i in range(8)
    ]
    model = read(*rows)
    own = model.knots("A")
    for i in range(8):
        assert np.interp(i / 8.0, model.offset[own] / model.length("A"), model.height[own]) == pytest.approx(
            100.0 + i + 0.5 * math.sin(i), abs=1e-3
        )
    assert np.abs(np.diff(model.gradient[own])).max() < 5e-4
    one = read(straight(height_m=50.0))
    np.testing.assert_array_equal(one.height, 50.0)


def test_cant_runs_with_the_curvature(read):
    arc = straight(element="bloss", radius_end_m=600.0, cant_start_mm=0, cant_end_mm=120)
    model = read(arc)
    own = model.knots("A")
    share = model.offset[own] / model.length("A")
    np.testing.assert_allclose(model.cant[own], 0.120 * (3 * share**2 - 2 * share**3), atol=1e-6)
    ramp = read(straight(cant_end_mm=-60))
    assert float(ramp.at("A", ramp.length("A") / 2).cant) == pytest.approx(-0.030, abs=1e-6)


def test_rows_in_any_order_and_tracks_side_by_side(read):
    rows = [
        straight(track="B", easting_m=E0 + 4.0),
        straight(sequence=20, start_m=100.0, northing_m=N0 + 100.0),
        straight(sequence=10),
        straight(track="B", sequence=2, start_m=100.0, easting_m=E0 + 4.0, northing_m=N0 + 100.0),
    ]
    model = read(*rows)
    assert model.track_id == ("B", "A")
    assert model.length("A") == pytest.approx(200.0, abs=0.01)
    assert model.provenance["import"]["joints"] == 2
    assert model.provenance["import"]["largest_gap_m"] < 1e-9
    assert len(model.nodes.id) == 4


def test_what_an_element_misses_is_reported_and_spread(read):
    rows = [straight(), straight(sequence=2, start_m=100.0, northing_m=N0 + 100.03, easting_m=E0 + 0.02)]
    model = read(*rows)
    assert model.provenance["import"]["largest_gap_m"] == pytest.approx(math.hypot(0.02, 0.03), abs=1e-9)
    own = model.knots("A")
    e, n = model.easting[own], model.northing[own]
    before = n <= N0 + 100.03
    np.testing.assert_allclose((e - E0)[before], 0.02 * (n - N0)[before] / 100.03, atol=1e-6)  # no leap at the joint
    np.testing.assert_allclose(
        np.diff(model.offset[own]), model.frame.ground_length(e[:-1], n[:-1], None, e[1:], n[1:], None), atol=1e-6
    )
    middle = model.at("A", 100.03 * model.length("A") / 200.03)
    assert (float(middle.easting), float(middle.northing)) == pytest.approx((E0 + 0.02, N0 + 100.03), abs=2e-3)


def test_small_kinks_are_said(read):
    model = read(straight(), straight(sequence=2, start_m=100.0, northing_m=N0 + 100.0, grid_bearing_deg=0.5))
    assert model.provenance["import"]["notes"] == ["track 'A', row 3: the axis turns 0.50 degrees at the joint"]


def test_stations_become_chainage_with_their_jumps(read):
    rows = [
        straight(start_m=5000.0),
        straight(sequence=2, start_m=5100.0, northing_m=N0 + 100.0),
        straight(sequence=3, start_m=5250.0, northing_m=N0 + 200.0),  # 50 m of chainage are missing here
    ]
    model = read(*rows)
    assert float(model.at("A", 0.0).chainage) == pytest.approx(5000.0)
    assert float(model.at("A", 50.0).chainage) == pytest.approx(5050.0, abs=0.01)
    assert float(model.at("A", model.length("A")).chainage) == pytest.approx(5350.0)
    continuous = read(*rows[:2])
    assert len(continuous.mileposts.track) == 2


def test_planes_by_zone_and_by_name(read):
    assert read(straight(), crs="gk3").frame.name == "WGS 84 / 3-degree Gauss-Kruger zone 3"
    assert read(straight(easting_m=2_600_000.0, northing_m=1_200_000.0), crs="EPSG:2056").frame.authority == (
        "EPSG",
        2056,
    )


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([straight(element="bow")], "row 2, column element: 'bow' is no known element; use straight, arc, clothoid"),
        ([straight(radius_start_m=500)], "column radius_start_m: a straight with a radius"),
        ([straight(element="arc")], "an arc without a radius"),
        ([straight(element="arc", radius_start_m=500, radius_end_m=400)], "an arc with two radii"),
        ([straight(element="clothoid")], "a transition from straight to straight"),
        ([straight(element="arc", radius_start_m=0.5, radius_end_m=0.5)], "a radius of 0.5 m"),
        ([straight(length_m=0)], "column length_m: 0 is not positive"),
        ([straight(length_m="")], "row 2, column length_m: is empty"),
        ([straight(easting_m="nan")], "column easting_m: is empty or not a number"),
        ([straight(), straight(northing_m=N0 + 100)], "row 3, column sequence: 1 stands twice in track 'A'"),
        ([straight(), straight(sequence=2, northing_m=N0 + 100.31)],
         "row 2, column element: the element ends 0.310 m from the start of the next one of track 'A' (row 3)"),
        ([straight(), straight(sequence=2, northing_m=N0 + 100, grid_bearing_deg=3)], "ends 3.00 degrees from"),
        ([straight(height_m=5), straight(sequence=2, northing_m=N0 + 100, height_m="")], "row 3, column height_m: is empty"),
        ([straight(height_m=5, gradient=0), straight(sequence=2, northing_m=N0 + 100, height_m=5, gradient="")],
         "row 3, column gradient: is empty"),
        ([straight(height_m=5, gradient=2.5)], "column gradient: 2.5 is outside"),
        ([straight(cant_start_mm=900)], "column cant_start_mm: 900 is outside"),
        ([straight(track="")], "row 2, column track: is empty"),
        ([{k: v for k, v in straight().items() if k != "grid_bearing_deg"}], "grid_bearing_deg"),
    ],
)  # fmt: skip
def test_refusals_name_the_row(read, rows, words):
    with pytest.raises(InputError) as caught:
        read(*rows)
    assert words in str(caught.value)
    assert "elements.csv" in str(caught.value)


def test_planes_that_do_not_fit(read):
    with pytest.raises(CrsError, match=r"elements\.csv: .*outside the area of use"):
        read(straight(easting_m=N0, northing_m=E0))
    with pytest.raises(CrsError, match="not a projected"):
        read(straight(), crs="EPSG:4326")
    with pytest.raises(InputError, match="spacing"):
        read(straight(), spacing=0.0)


def test_gradients_without_heights_are_said(read):
    model = read(straight(gradient=0.01))
    assert model.provenance["import"]["notes"] == ["track 'A': gradients without heights passed over"]


# --- real elements ----------------------------------------------------------------------------------------------------


def test_mannheim(shared_data, tmp_path):
    """147 tram tracks: every joint closes to 2 mm (the data's own promise is 1 to 2 mm)."""
    source = shared_data / "mannheim" / "mannheim_tracks.csv"
    if not source.exists():
        pytest.skip(f"{source} is not here")
    tracks: dict[str, list[dict[str, str]]] = {}
    with source.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            tracks.setdefault(row["n"], []).append(row)
    path = tmp_path / "mannheim.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(HEADER)
        for track, rows in tracks.items():
            for i, (a, b) in enumerate(itertools.pairwise(rows)):
                r0, r1 = float(a["R"]), float(b["R"])
                kind = "clothoid" if float(a["cl"]) else "arc" if r0 else "straight"
                radii = (r0, r1) if kind == "clothoid" else (r0, r0)
                writer.writerow(
                    [
                        track,
                        i,
                        a["s"],
                        b["ds"],
                        kind,
                        *(r or "" for r in radii),
                        a["rw"],
                        a["hw"],
                        float(a["tang"]) * 0.9,
                    ]
                )
    model = read_elements(path, crs=CRS)
    report = model.provenance["import"]
    assert (report["tracks"], report["elements"], report["joints"]) == (147, 3487, 3340)
    assert report["largest_gap_m"] < 0.002
    assert report["rms_gap_m"] < 0.001
    grid = sum(float(row["ds"]) for rows in tracks.values() for row in rows[1:])
    assert model.lengths.sum() == pytest.approx(grid * (1.0 + 6.7e-6 - 17e-6), rel=2e-6)
    for track, rows in list(tracks.items())[::10]:
        here = model.at(track, model.length(track))
        assert (float(here.easting), float(here.northing)) == pytest.approx(
            (float(rows[-1]["rw"]), float(rows[-1]["hw"])), abs=0.003
        )
