"""The projected plane: choice, pinned transformation, convergence, scale and true ground length."""

from __future__ import annotations

import dataclasses
import math
import pickle

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from railnav.errors import CrsError
from railnav.geodesy import BESSEL, WGS84, GridFrame, choose_frame, frame_for_grid
from railnav.geodesy.grid import _PULKOVO
from railnav.geodesy.projection import Projection, projection_of

BUDAPEST = (math.radians(47.5), math.radians(19.1))
MOSCOW = (math.radians(55.776), math.radians(37.65))
ZURICH = (math.radians(47.4), math.radians(8.5))
MUNICH = (math.radians(48.1), math.radians(11.6))

# (where, options): every kind of projection and of datum link
FRAMES = {
    "wgs84 gk6": (MOSCOW, {}),
    "wgs84 gk3": (BUDAPEST, {"zone_width": 3}),
    "southern": ((math.radians(-33.9), math.radians(151.2)), {}),
    "pulkovo": (MOSCOW, {"ellipsoid": "krassowsky"}),
    "db_ref": (MUNICH, {"ellipsoid": "bessel", "zone_width": 3}),
    "utm": (ZURICH, {"crs": "EPSG:32632"}),
    "lv95": (ZURICH, {"crs": "EPSG:2056"}),
    "eov": (BUDAPEST, {"crs": "EPSG:23700"}),
    "lambert 93": ((math.radians(47.0), math.radians(2.3)), {"crs": "EPSG:2154"}),
    "british": ((math.radians(52.0), math.radians(-1.0)), {"crs": "EPSG:27700"}),
    "omerc": (BUDAPEST, {"crs": "+proj=omerc +lat_0=47.5 +lonc=19.5 +alpha=70 +gamma=0 +k=1 +datum=WGS84 +units=m"}),
    "local": (
        MOSCOW,
        {
            "crs": "+proj=tmerc +lat_0=0 +lon_0=38.48333333333 +k=1 +x_0=3250000 +y_0=-6012900.566 +ellps=krass "
            "+towgs84=23.57,-140.95,-79.8,0,0.35,0.79,-0.22 +units=m"
        },
    ),
}


@pytest.fixture(params=FRAMES)
def frame_and_place(request):
    place, options = FRAMES[request.param]
    return choose_frame(*place, **options), place


def scatter(place, n=400, degrees=1.2, seed=3):
    rng = np.random.default_rng(seed)
    latitude, longitude = (v + np.radians(rng.uniform(-degrees, degrees, n)) for v in place)
    return latitude, longitude, rng.uniform(0.0, 800.0, n)


# --- choice -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("longitude_deg", "width", "zone", "meridian"),
    [
        (0.0, 6, 1, 3.0),
        (19.1, 6, 4, 21.0),
        (37.6, 6, 7, 39.0),
        (-75.0, 6, 48, -75.0),
        (179.9, 6, 30, 177.0),
        (-179.9, 6, 31, -177.0),
        (19.1, 3, 6, 18.0),
        (19.6, 3, 7, 21.0),
        (0.2, 3, 0, 0.0),
        (-0.2, 3, 0, 0.0),
        (-3.0, 3, 119, -3.0),
    ],
)
def test_default_is_the_gauss_krueger_zone_of_the_data(longitude_deg, width, zone, meridian):
    frame = choose_frame(math.radians(50.0), math.radians(longitude_deg), zone_width=width)
    assert frame.name.endswith(f"zone {zone}")
    assert frame.accuracy == 0.0
    easting, northing, height = frame.to_grid(math.radians(50.0), math.radians(meridian), 12.0)
    assert easting == pytest.approx(zone * 1e6 + 500_000.0, abs=1e-6)
    assert northing == pytest.approx(5540847.042, abs=1e-3)  # meridian arc to 50 N on WGS 84
    assert height == 12.0  # no datum shift


def test_names_of_zones_and_options_mean_the_same():
    assert choose_frame(*MOSCOW, crs="gk3") == choose_frame(*MOSCOW, zone_width=3)
    assert choose_frame(*MOSCOW, crs="GK6") == choose_frame(*MOSCOW)
    assert choose_frame(*MOSCOW, ellipsoid="krassowsky") == choose_frame(*MOSCOW, crs="EPSG:28407")
    assert choose_frame(*MUNICH, zone_width=3, ellipsoid="bessel") == choose_frame(*MUNICH, crs="EPSG:5684")
    assert choose_frame(*BUDAPEST, crs=32634) == choose_frame(*BUDAPEST, crs=pyproj.CRS("EPSG:32634"))


def test_pulkovo_zones_are_what_their_codes_say():
    for width, realisations in _PULKOVO.items():
        for codes, datum in zip(realisations, ("", "(83)", "(58)"), strict=True):
            for zone, code in codes.items():
                system = pyproj.CRS.from_epsg(code)
                words = "3-degree " if width == 3 else ""
                assert system.name == f"Pulkovo 1942{datum} / {words}Gauss-Kruger zone {zone}"


def test_pulkovo_west_of_its_area_takes_the_realisation_that_serves():
    dresden = (math.radians(51.05), math.radians(13.7))
    assert choose_frame(*dresden, ellipsoid="krassowsky").name == "Pulkovo 1942(83) / Gauss-Kruger zone 3"
    assert choose_frame(*BUDAPEST, ellipsoid="krassowsky").accuracy <= 4.0
    gdansk = (math.radians(54.4), math.radians(18.6))
    assert choose_frame(*gdansk, ellipsoid="krassowsky").name == "Pulkovo 1942(58) / Gauss-Kruger zone 4"


def test_wild_fixes_do_not_move_the_zone():
    latitude, longitude = np.full(1000, BUDAPEST[0]), np.full(1000, BUDAPEST[1])
    latitude[:3], longitude[:3] = 0.0, 0.0
    assert choose_frame(latitude, longitude) == choose_frame(*BUDAPEST)


def test_data_across_the_antimeridian():
    frame = choose_frame(math.radians(66.0), np.radians([179.2, -178.0]))
    assert frame.name.endswith("zone 31")
    _, longitude, _ = frame.to_geodetic(*frame.to_grid(math.radians(66.0), math.radians(179.2), 0.0))
    assert math.degrees(longitude) == pytest.approx(179.2, abs=1e-11)


# --- outside truth ----------------------------------------------------------------------------------------------------


def test_axis_order_is_east_north_whatever_the_registry_says():
    """spec/track_geometry.md 1.2: EPSG:28407 states (X north, Y east) = (6184549.374, 7415402.257) for this point."""
    easting, northing, _ = choose_frame(*MOSCOW, crs="EPSG:28407").to_grid(*MOSCOW, 0.0)
    assert (easting, northing) == pytest.approx((7415402.257, 6184549.374), abs=0.005)


def test_published_point_of_the_british_grid():
    """Ordnance Survey, A guide to coordinate systems in Great Britain, annexe C: Caister water tower."""
    frame = choose_frame(math.radians(52.6), math.radians(1.7), crs="EPSG:27700")
    latitude, longitude = 52 + 39 / 60 + 27.2531 / 3600, 1 + 43 / 60 + 4.5177 / 3600  # OSGB36
    easting, northing = pyproj.Transformer.from_pipeline(projection_of(frame.pipeline).text).transform(
        longitude, latitude
    )
    assert (easting, northing) == pytest.approx((651409.903, 313177.270), abs=1e-3)


def test_published_point_of_db_ref():
    """The DB_REF link is EPSG:5826, defining: its seven parameters applied by hand give the same Cartesian point."""
    frame = choose_frame(*MUNICH, crs="EPSG:5684")
    easting, northing, height = frame.to_grid(*MUNICH, 500.0)
    x = np.array(WGS84.to_cartesian(*MUNICH, 500.0))
    rx, ry, rz = np.radians(np.array([-1.1155, -0.2824, 3.1384]) / 3600.0)
    rotation = np.array([[1.0, rz, -ry], [-rz, 1.0, rx], [ry, -rx, 1.0]])  # coordinate frame
    translation = np.array([584.9636, 107.7175, 413.8067])
    datum = np.linalg.solve((1 + 7.9922e-6) * rotation, x - translation)
    latitude, longitude, up = BESSEL.to_geodetic(*datum)
    expected = pyproj.Proj("+proj=tmerc +lon_0=12 +x_0=4500000 +ellps=bessel")(
        np.degrees(longitude), np.degrees(latitude)
    )
    assert (easting, northing, height) == pytest.approx((*expected, float(up)), abs=0.005)


def test_scale_off_the_central_meridian():
    """spec/track_geometry.md 1.6, ppm at kilometres from the central meridian."""
    frame = choose_frame(math.radians(55.0), math.radians(39.0))
    y = np.array([10, 20, 50, 75, 100, 150, 200, 250]) * 1e3
    ppm = (frame.point_scale(7_500_000.0 + y, 6_097_000.0) - 1.0) * 1e6
    np.testing.assert_allclose(ppm, [1.2, 4.9, 30.7, 69.1, 122.8, 276, 491, 767], rtol=0.005, atol=0.05)
    np.testing.assert_array_equal(ppm, (frame.point_scale(7_500_000.0 - y, 6_097_000.0) - 1.0) * 1e6)


def test_ground_scale_with_height():
    """spec/track_geometry.md 1.6: -15.7, -31.3, -78 and -157 ppm at 100, 200, 500 and 1000 m."""
    frame = choose_frame(math.radians(55.0), math.radians(39.0))
    height = np.array([100.0, 200.0, 500.0, 1000.0])
    ppm = (frame.ground_scale(7_500_000.0, 6_097_000.0, height, 0.0) - 1.0) * 1e6
    np.testing.assert_allclose(ppm, [-15.7, -31.3, -78.0, -157.0], rtol=0.01)
    assert frame.ground_scale(7_500_000.0, 6_097_000.0, None, 0.3) == pytest.approx(1.0, abs=1e-12)


# --- PROJ as oracle ---------------------------------------------------------------------------------------------------


def test_convergence_and_scale_against_proj(frame_and_place):
    frame, place = frame_and_place
    easting, northing, _ = frame.to_grid(*scatter(place))
    system = pyproj.CRS.from_wkt(frame.crs_wkt)
    proj = pyproj.Proj(system.source_crs if system.is_bound else system)
    factors = proj.get_factors(*proj(easting, northing, inverse=True))  # numerical: good to some 1e-10
    np.testing.assert_allclose(
        frame.convergence(easting, northing), np.radians(factors.meridian_convergence), rtol=0, atol=1e-10
    )
    np.testing.assert_allclose(frame.point_scale(easting, northing), factors.meridional_scale, rtol=0, atol=2e-10)


def test_series_against_derivatives(frame_and_place):
    """The closed transverse Mercator against the numerical derivatives that serve every other projection."""
    frame, place = frame_and_place
    projection = projection_of(frame.pipeline)
    easting, northing, _ = frame.to_grid(*scatter(place))
    numerical = Projection(projection.ellipsoid, projection.datum_scale, projection.text)
    for closed, differences in zip(
        projection.factors(easting, northing), numerical.factors(easting, northing), strict=True
    ):
        np.testing.assert_allclose(closed, differences, rtol=0, atol=1e-11)


def test_convergence_is_the_azimuth_of_grid_north(frame_and_place):
    frame, place = frame_and_place
    easting, northing, _ = frame.to_grid(*scatter(place, n=50))
    lat1, lon1, _ = frame.to_geodetic(easting, northing, 0.0)
    lat2, lon2, _ = frame.to_geodetic(easting, northing + 10.0, 0.0)
    azimuth, _, _ = pyproj.Geod(ellps="WGS84").inv(*np.degrees([lon1, lat1, lon2, lat2]))
    np.testing.assert_allclose(np.radians(azimuth), frame.convergence(easting, northing), rtol=0, atol=4e-5)


def test_round_trip_and_heights(frame_and_place):
    frame, place = frame_and_place
    latitude, longitude, height = scatter(place)
    easting, northing, up = frame.to_grid(latitude, longitude, height)
    again = frame.to_geodetic(easting, northing, up)
    assert np.max(np.abs(again[0] - latitude)) * 6.4e6 < 5e-8
    assert np.max(np.abs(again[1] - longitude)) * 6.4e6 < 5e-8
    np.testing.assert_allclose(again[2], height, rtol=0, atol=5e-8)


ZONE_7 = choose_frame(*MOSCOW)


@given(
    latitude=st.floats(math.radians(-80), math.radians(80)),
    offset=st.floats(math.radians(-3.5), math.radians(3.5)),
    height=st.floats(-400, 5000),
)
def test_round_trip_anywhere_in_a_zone(latitude, offset, height):
    frame = ZONE_7
    longitude = math.radians(39.0) + offset
    again = frame.to_geodetic(*frame.to_grid(latitude, longitude, height))
    assert again == pytest.approx((latitude, longitude, height), abs=2e-15 * 6.4e6, rel=1e-14)


# --- true ground length -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["wgs84 gk6", "pulkovo", "db_ref", "lv95", "omerc", "local"])
def test_ground_length_against_ecef(name):
    """0.05 ppm for 1 m to 5 km, 210 km off the meridian, heights to 800 m, slopes to 3 %: the figure asked for.

    Outside truth: the segment is cut into 64 pieces, each taken to WGS 84 and measured as an ECEF chord.
    """
    place, options = FRAMES[name]
    frame = choose_frame(*place, **options)
    rng = np.random.default_rng(7)
    n = 2000
    half = 1.0 if name in {"lv95", "db_ref"} else 3.0
    e1, n1, h1 = frame.to_grid(
        place[0] + np.radians(rng.uniform(-1, 1, n)),
        place[1] + np.radians(rng.uniform(-half, half, n)),
        rng.uniform(0, 776, n),
    )
    length, bearing, slope = (
        10.0 ** rng.uniform(0.0, math.log10(5000.0), n),
        rng.uniform(0, 2 * math.pi, n),
        rng.uniform(-0.03, 0.03, n),
    )
    e2, n2, h2 = e1 + length * np.sin(bearing), n1 + length * np.cos(bearing), h1 + slope * length
    part = np.linspace(0.0, 1.0, 65)[:, None]
    x = np.stack(
        WGS84.to_cartesian(*frame.to_geodetic(e1 + part * (e2 - e1), n1 + part * (n2 - n1), h1 + part * (h2 - h1)))
    )
    truth = np.sqrt((np.diff(x, axis=1) ** 2).sum(axis=0)).sum(axis=0)
    error = np.abs(frame.ground_length(e1, n1, h1, e2, n2, h2) - truth)
    # cutting a metre into 64 pieces leaves the truth itself uncertain by some 1e-8 m
    assert np.max((error - 5e-8) / truth) < 0.05e-6
    assert np.max(np.abs(length / truth - 1.0)) > 10e-6  # the grid length itself is far from it


def test_ground_length_is_symmetric_and_additive():
    frame = choose_frame(*MOSCOW)
    a, b = (7_600_000.0, 6_100_000.0, 100.0), (7_603_000.0, 6_104_000.0, 160.0)
    middle = tuple(0.5 * (p + q) for p, q in zip(a, b, strict=True))
    whole = frame.ground_length(*a, *b)
    assert frame.ground_length(*b, *a) == pytest.approx(float(whole), abs=1e-9)
    assert frame.ground_length(*a, *middle) + frame.ground_length(*middle, *b) == pytest.approx(float(whole), abs=1e-6)
    assert frame.ground_length(*a, *a) == 0.0


def test_ground_length_without_heights_is_horizontal_at_height_0():
    frame = choose_frame(*MOSCOW)
    flat = frame.ground_length(7.6e6, 6.1e6, 0.0, 7.601e6, 6.1e6, 0.0)
    for h1, h2 in [(None, None), (100.0, None), (np.nan, 50.0)]:
        assert frame.ground_length(7.6e6, 6.1e6, h1, 7.601e6, 6.1e6, h2) == flat


def test_ground_length_differentiates_to_ground_scale(frame_and_place):
    frame, place = frame_and_place
    easting, northing, height = frame.to_grid(*scatter(place, n=50))
    bearing = np.linspace(-3.0, 3.0, 50)
    step = 10.0
    length = frame.ground_length(
        easting - step * np.sin(bearing), northing - step * np.cos(bearing), height,
        easting + step * np.sin(bearing), northing + step * np.cos(bearing), height,
    )  # fmt: skip
    np.testing.assert_allclose(
        2 * step / length, frame.ground_scale(easting, northing, height, bearing), rtol=0, atol=3e-10
    )


# --- values -----------------------------------------------------------------------------------------------------------


def test_a_stored_frame_gives_identical_numbers(frame_and_place):
    frame, place = frame_and_place
    again = GridFrame(**{f.name: getattr(frame, f.name) for f in dataclasses.fields(frame)})
    assert again == frame
    assert hash(again) == hash(frame)
    assert pickle.loads(pickle.dumps(frame)) == frame
    points = scatter(place, n=20)
    for first, second in zip(frame.to_grid(*points), again.to_grid(*points), strict=True):
        np.testing.assert_array_equal(first, second)
    assert "\n" not in frame.crs_wkt
    system = pyproj.CRS.from_wkt(frame.crs_wkt)
    assert (system.source_crs if system.is_bound else system).is_projected


def test_authority():
    assert choose_frame(*MOSCOW, ellipsoid="krassowsky").authority == ("EPSG", 28407)
    assert choose_frame(*MOSCOW).authority is None


def test_pinned_operation_is_named_with_its_accuracy():
    frame = choose_frame(*MOSCOW, ellipsoid="krassowsky")
    assert "Pulkovo 1942 to WGS 84 (20)" in frame.operation
    assert frame.accuracy == 3.0
    assert "x=23.57" in frame.pipeline


def test_scalars_arrays_and_read_only_inputs():
    frame = choose_frame(*MOSCOW)
    latitude = np.full((2, 3), MOSCOW[0])
    latitude.flags.writeable = False
    grid = frame.to_grid(latitude, MOSCOW[1], 10.0)
    scalar = frame.to_grid(*MOSCOW, 10.0)
    for array, value in zip(grid, scalar, strict=True):
        assert array.shape == (2, 3)
        assert np.ndim(value) == 0
        np.testing.assert_array_equal(array, value)
    for value in grid:
        value.flags.writeable = False
    back = frame.to_geodetic(*grid)
    one = frame.to_geodetic(*(float(v[0, 0]) for v in grid))
    for array, value in zip(back, one, strict=True):
        np.testing.assert_array_equal(array, value)
    easting, northing = grid[0], grid[1]
    for method in (frame.convergence, frame.point_scale):
        assert method(easting, northing).shape == (2, 3)
        np.testing.assert_array_equal(method(easting, northing), method(float(easting[0, 0]), float(northing[0, 0])))
    assert frame.ground_scale(easting, northing, None, 0.0).shape == (2, 3)
    assert frame.to_grid([], [])[0].shape == (0,)
    assert frame.convergence([], []).shape == (0,)


def test_a_missing_height_is_said_to_be_missing():
    frame = choose_frame(*MOSCOW, ellipsoid="krassowsky")
    easting, northing, height = frame.to_grid(MOSCOW[0], MOSCOW[1])
    assert math.isnan(height)
    mixed = frame.to_grid(np.full(2, MOSCOW[0]), MOSCOW[1], [np.nan, 0.0])
    np.testing.assert_array_equal(np.isnan(mixed[2]), [True, False])
    np.testing.assert_array_equal(mixed[0], [easting, easting])
    assert math.isnan(frame.to_geodetic(easting, northing, math.nan)[2])


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "options", "words"),
    [
        (BUDAPEST, {"crs": "EPSG:4326"}, "not a projected"),
        (BUDAPEST, {"crs": "EPSG:4978"}, "not a projected"),
        (BUDAPEST, {"crs": "EPSG:99999"}, "knows no coordinate system"),
        (BUDAPEST, {"crs": "nonsense"}, "knows no coordinate system"),
        (BUDAPEST, {"crs": ""}, "knows no coordinate system"),
        (BUDAPEST, {"crs": "EPSG:3857"}, "would change lengths by up to 48 %"),
        (BUDAPEST, {"crs": "EPSG:3035"}, "not conformal"),
        (BUDAPEST, {"crs": "EPSG:2056"}, "outside the area of use"),
        (BUDAPEST, {"crs": "EPSG:5513"}, "point south and west"),
        (BUDAPEST, {"crs": "EPSG:2263"}, "counts in US survey foot"),
        (BUDAPEST, {"crs": "EPSG:28404"}, "no usable transformation"),
        (BUDAPEST, {"crs": "+proj=tmerc +lon_0=19 +ellps=krass +units=m"}, "+towgs84="),
        (BUDAPEST, {"crs": "EPSG:32634", "ellipsoid": "bessel"}, "brings its own ellipsoid"),
        (MUNICH, {"crs": "EPSG:9934"}, "no usable transformation"),  # vertical ballpark
        ((math.radians(50.0), math.radians(6.4)), {"crs": "EPSG:5832"}, "use its horizontal part alone"),
        (BUDAPEST, {"zone_width": 4}, "3 or 6 degrees wide"),
        (BUDAPEST, {"ellipsoid": "clarke"}, "not one of"),
        (BUDAPEST, {"ellipsoid": "bessel", "zone_width": 3}, "covers Germany"),
        (MUNICH, {"ellipsoid": "bessel"}, "zone_width=3"),
        ((math.radians(-23.0), math.radians(-46.0)), {"ellipsoid": "krassowsky"}, "zone 53"),
        ((math.radians(89.9), 0.3), {}, "no grid north"),
        ((0.8, np.radians([10.0, 40.0])), {}, "split the line"),
        ((np.empty(0), np.empty(0)), {}, "at least one"),
        ((math.nan, 0.3), {}, "position 1 is no geodetic one"),
        ((47.5, 19.1), {}, "radians"),
    ],
)
def test_refusals(place, options, words):
    with pytest.raises(CrsError) as caught:
        choose_frame(*place, **options)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_plane_for_coordinates_that_are_in_it_already(frame_and_place):
    frame, place = frame_and_place
    easting, northing, _ = frame.to_grid(*scatter(place, n=20))
    again = frame_for_grid(easting, northing, crs=frame.crs_wkt)
    assert (again.pipeline, again.accuracy) == (frame.pipeline, frame.accuracy)
    if frame.name.startswith("WGS 84 /") and "Gauss" in frame.name:
        assert frame_for_grid(easting, northing, crs="gk3" if "3-degree" in frame.name else "gk6") == frame


@pytest.mark.parametrize(
    ("easting", "northing", "crs", "words"),
    [
        (650_000.0, 240_000.0, "gk6", "has no Gauss-Krueger zone in front"),
        (5_481_774.8, 3_462_825.3, "EPSG:31467", "outside the area of use"),
        (650_000.0, 240_000.0, "EPSG:4326", "not a projected"),
        (np.empty(0), np.empty(0), "EPSG:31467", "at least one"),
        (np.nan, 0.0, "EPSG:31467", "not finite"),
        (1e9, 1e9, "EPSG:2056", "do not lie in"),
    ],
)
def test_coordinates_of_another_plane(easting, northing, crs, words):
    with pytest.raises(CrsError, match=words):
        frame_for_grid(easting, northing, crs=crs)


def test_positions_that_cannot_be_projected_are_named():
    frame = choose_frame(*MOSCOW)
    with pytest.raises(CrsError, match=r"position 2 .*latitude nan"):
        frame.to_grid([MOSCOW[0], math.nan], [MOSCOW[1]] * 2, 0.0)
    with pytest.raises(CrsError, match="position 1"):
        frame.to_grid(math.radians(100.0), 0.1, 5.0)
    with pytest.raises(CrsError, match="position 1"):
        frame.to_geodetic(math.inf, 0.0)
    with pytest.raises(CrsError, match="not finite"):
        frame.convergence([7.5e6, math.nan], 6.1e6)
    with pytest.raises(CrsError, match="not finite"):
        frame.convergence(math.nan, 6.1e6)
    with pytest.raises(CrsError, match="not finite"):
        frame.ground_length(7.5e6, 6.1e6, 0.0, math.nan, 6.1e6, 0.0)


def test_a_foreign_pipeline_is_refused():
    with pytest.raises(CrsError, match="cannot run"):
        GridFrame("", "", "proj=nonsense", "", 0.0).to_grid(0.8, 0.3, 0.0)
    with pytest.raises(CrsError, match="no map projection"):
        GridFrame("", "", "proj=noop", "", 0.0).convergence(0.0, 0.0)


def test_a_plane_is_called_by_its_name():
    frame = choose_frame(*BUDAPEST)
    assert str(frame) == f"{frame}" == frame.name
