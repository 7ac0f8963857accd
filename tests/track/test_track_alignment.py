"""Alignment and evaluation against curves known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from railnav.errors import TrackError
from railnav.geodesy.grid import choose_frame
from railnav.track import TrackSection, assemble, fit_alignment

FRAME = choose_frame(np.radians([50.0, 50.1]), np.radians([9.0, 9.1]))
EAST, NORTH = FRAME.to_grid(np.radians(50.05), np.radians(9.05))[:2]


def arc(radius: float, angle: float, gradient: float = 0.0, step: float = 5.0):
    """Vertices of a circular arc that starts northward at (EAST, NORTH) and turns right (radius in grid metres)."""
    a = np.linspace(0.0, angle, max(2, round(abs(radius) * angle / step) + 1))
    return EAST + radius * (1 - np.cos(a)), NORTH + abs(radius) * np.sin(a), 150.0 + gradient * abs(radius) * a


def one_track(*vertices, **options):
    return assemble(FRAME, [TrackSection("a", fit_alignment(FRAME, *vertices, **options))])


@pytest.mark.parametrize("radius", [180.0, 300.0, 2000.0, -300.0])
def test_an_arc_keeps_its_radius_sign_and_length(radius):
    east, north, height = arc(radius, 0.8, gradient=0.02)
    model = one_track(east, north, height)
    length = model.length("a")
    scale = model.scale.mean()  # it shrinks by 1e-6 as the track climbs 6 m
    assert length == pytest.approx(abs(radius) * 0.8 * math.hypot(1.0 / scale, 0.02), rel=2e-7)
    points = model.at("a", np.linspace(0, length, 1001))
    turned = np.hypot(points.easting - EAST - radius, points.northing - NORTH)
    assert np.abs(turned - abs(radius)).max() < 2e-5  # 5 m vertices on R = 180 m
    inner = slice(100, -100)
    assert np.allclose(points.curvature[inner], 1.0 / radius, rtol=2e-3)  # positive to the right
    assert np.allclose(points.gradient, 0.02 * scale, atol=1e-6)  # rise over ground run: grid run / scale


def test_length_is_true_ground_length_not_grid_length():
    """A straight of 1 km of grid metres, 210 km east of the central meridian at 800 m: +541 ppm grid, -125 ppm height."""
    east, north, height = np.array([4_710_000.0, 4_711_000.0]), np.array([5_500_000.0, 5_500_000.0]), np.full(2, 800.0)
    frame = choose_frame(np.radians([50.0]), np.radians([21.0]))
    knots = fit_alignment(frame, east, north, height)
    true = float(frame.ground_length(east[0], north[0], 800.0, east[1], north[1], 800.0))
    assert knots.offset[-1] == pytest.approx(true, rel=5e-8)
    assert abs(true - 1000.0) > 0.3


def test_position_is_c2_across_knots():
    east, north, height = arc(300.0, 1.0, gradient=0.01)
    model = one_track(east, north, height, spacing=4.0)
    knot = model.offset[10]
    h = 0.02
    s = knot + h * np.arange(-3, 4)
    for values in (model.at("a", s).easting, model.at("a", s).northing, model.at("a", s).height):
        second = np.diff(values - values[0], 2) / h**2
        assert np.ptp(second) < 1e-4  # differencing noise is 1e-5; a curvature jump of 10 % of 1/300 would be 3e-4


def test_derivatives_are_those_of_the_curve_not_chords():
    a = np.linspace(0, 1, 200)
    east, north = EAST + 800 * a, NORTH + 60 * np.sin(3 * a)
    model = one_track(east, north, 100 + 5 * np.sin(2 * a))
    s = np.linspace(20, model.length("a") - 20, 300)
    h = 0.01
    lo, hi, mid = model.at("a", s - h), model.at("a", s + h), model.at("a", s)
    bearing = np.arctan2(hi.easting - lo.easting, hi.northing - lo.northing)
    assert np.abs(bearing - mid.grid_bearing).max() < 1e-6
    assert np.abs((hi.grid_bearing - lo.grid_bearing) / (2 * h) - mid.curvature).max() < 5e-6
    run = np.hypot(hi.easting - lo.easting, hi.northing - lo.northing) / model.scale[0]
    assert np.abs((hi.height - lo.height) / run - mid.gradient).max() < 5e-6


def test_reversing_the_vertices_reverses_offsets_and_signs():
    east, north, height = arc(400.0, 0.7, gradient=0.015)
    cant = np.linspace(0.0, 0.1, len(east))
    there, back = (
        one_track(east, north, height, cant=cant),
        one_track(east[::-1], north[::-1], height[::-1], cant=-cant[::-1]),
    )
    length = there.length("a")
    assert back.length("a") == pytest.approx(length, abs=1e-6)
    s = np.linspace(0, length, 50)
    p, q = there.at("a", s), back.at("a", np.minimum(length - s, back.length("a")))
    for name, sign in (
        ("easting", 1),
        ("northing", 1),
        ("height", 1),
        ("curvature", -1),
        ("gradient", -1),
        ("cant", -1),
    ):
        assert np.allclose(getattr(p, name), sign * getattr(q, name), atol=1e-5), name


def test_missing_heights_stay_missing_and_never_enter_a_length():
    east, north, height = arc(500.0, 0.3)
    height[3] = np.nan
    model = one_track(east, north, height)
    assert np.isnan(model.height).all()
    assert (model.gradient == 0).all()
    assert np.isnan(model.at("a", 10.0).height)


@pytest.mark.parametrize(
    ("east", "north", "match"),
    [
        ([EAST], [NORTH], "two distinct"),
        ([EAST, EAST], [NORTH, NORTH], "two distinct"),
        ([EAST, np.nan], [NORTH, NORTH], "not finite"),
        ([EAST, EAST + 5], [NORTH], "differ in length"),
    ],
)
def test_degenerate_vertices_are_refused_by_meaning(east, north, match):
    with pytest.raises(TrackError, match=match):
        fit_alignment(FRAME, east, north)


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_few_vertices_make_a_track(count):
    knots = fit_alignment(FRAME, EAST + np.linspace(0, 20, count), np.full(count, NORTH))
    assert np.allclose(knots.curvature, 0, atol=1e-9)
    assert np.allclose(np.degrees(knots.grid_bearing), 90.0)


def test_read_only_and_repeated_vertices_are_accepted():
    east, north, height = arc(500.0, 0.3)
    east, north, height = np.repeat(east, 2), np.repeat(north, 2), np.repeat(height, 2)
    for a in (east, north, height):
        a.flags.writeable = False
    model = one_track(east, north, height)
    assert model.length("a") == pytest.approx(one_track(*arc(500.0, 0.3)).length("a"), abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(
    s=st.floats(0.05, 0.95),
    cross=st.floats(-25.0, 25.0),
)
def test_foot_point_returns_where_the_point_was_set_off(s, cross):
    model = MODEL
    offset = s * model.length("a")
    p = model.at("a", offset)
    east = float(p.easting + cross * np.cos(p.grid_bearing))
    north = float(p.northing - cross * np.sin(p.grid_bearing))
    best = model.locate(east, north, within=30.0)[0]
    assert best.offset == pytest.approx(offset, abs=2e-4)
    assert best.cross == pytest.approx(cross, abs=2e-6)  # positive to the right
    assert best.distance == pytest.approx(abs(cross), abs=2e-6)


MODEL = one_track(*arc(300.0, 1.2, gradient=0.01))


def test_cant_and_covariance_are_linear_between_vertices():
    east, north = EAST + np.arange(0.0, 101.0, 10.0), np.full(11, NORTH)
    cov = np.tile(np.arange(11.0)[:, None], (1, 6))
    knots = fit_alignment(FRAME, east, north, cant=np.arange(11.0) / 100, covariance_g=cov)
    assert np.allclose(knots.cant, (knots.easting - EAST) / 1000, atol=1e-9)
    assert np.allclose(knots.covariance_g[:, 5], (knots.easting - EAST) / 10, atol=1e-8)
