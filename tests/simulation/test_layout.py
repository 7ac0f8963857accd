"""Alignment elements: closed forms, textbook numbers, and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from railnav.errors import TrackError
from railnav.geodesy.grid import choose_frame
from railnav.simulation.layout import (
    Axis,
    Element,
    Profile,
    connecting_track,
    curve,
    parallel_track,
    place_axis,
    subdivide,
    turnout_connection,
)

FRAME = choose_frame(math.radians(50.6), math.radians(10.9))
E0, N0, _ = (float(x) for x in FRAME.to_grid(math.radians(50.6), math.radians(10.9), 0.0))


def placed(elements: list[Element], grades=((0.0, 0.0),), height: float = 300.0, radius: float = 5000.0):
    profile = Profile.of(height, list(grades), radius=radius)
    return place_axis(FRAME, elements, profile, easting=E0, northing=N0, grid_bearing=0.7)


def test_clothoid_end_offset_is_the_textbook_one():
    axis = Axis.of([Element(100.0, 0.0, 1.0 / 600.0)])
    across, along = axis.plane(100.0)
    assert float(across) == pytest.approx(2.776, abs=5e-4)  # spec/track_geometry.md 3.1: clothoid L=100 R=600
    # series of the Fresnel integrals, written out
    a = 100.0 * 600.0
    assert float(along) == pytest.approx(100.0 - 100.0**5 / (40 * a**2) + 100.0**9 / (3456 * a**4), abs=1e-8)


def test_clothoid_agrees_with_fresnel_integrals():
    from scipy.special import fresnel

    length, radius = 140.0, 300.0
    axis = Axis.of([Element(length, 0.0, 1.0 / radius)])
    run = np.linspace(0.0, length, 37)
    unit = math.sqrt(math.pi * radius * length)
    s, c = fresnel(run / unit)
    across, along = axis.plane(run)
    np.testing.assert_allclose(across, unit * s, atol=1e-11)
    np.testing.assert_allclose(along, unit * c, atol=1e-11)


def test_full_circle_closes():
    axis = Axis.of([Element(2 * math.pi * 250.0, 1 / 250.0, 1 / 250.0)])
    across, along = axis.plane(axis.station[-1])
    assert abs(float(across)) < 1e-9
    assert abs(float(along)) < 1e-9
    right, _ = axis.plane(math.pi * 250.0)
    assert float(right) == pytest.approx(500.0, abs=1e-9)  # positive curvature turns right


def test_parabola_heights():
    profile = Profile.of(100.0, [(0.0, 0.01), (1000.0, -0.005)], radius=8000.0)
    # tangents meet at 110 m; the parabola lies delta^2 R / 8 below: 0.015^2 * 8000 / 8
    height, gradient = profile.at(np.array([0.0, 500.0, 1000.0, 2000.0]))
    np.testing.assert_allclose(height, [100.0, 105.0, 110.0 - 0.225, 105.0], atol=1e-12)
    np.testing.assert_allclose(gradient, [0.01, 0.01, 0.0025, -0.005], atol=1e-15)


def test_gradient_is_the_slope_of_the_height():
    profile = Profile.of(0.0, [(0.0, 0.002), (300.0, 0.02), (900.0, -0.01)], radius=4000.0)
    s = np.arange(5.0, 1200.0, 3.7)
    slope = (profile.at(s + 1e-3)[0] - profile.at(s - 1e-3)[0]) / 2e-3
    np.testing.assert_allclose(slope, profile.at(s)[1], atol=1e-6)


@pytest.mark.parametrize(("number", "radius", "lateral"), [(9, 300.0, 4.0), (12, 500.0, -4.0), (14, 760.0, 4.5)])
def test_connection_closes_heading_and_distance(number, radius, lateral):
    axis = Axis.of(turnout_connection(lateral, number=number, radius=radius))
    assert abs(axis.bearing[-1]) < 1e-14
    assert float(axis.plane(axis.station[-1])[0]) == pytest.approx(lateral, abs=1e-9)
    assert np.abs(axis.bearing).max() == pytest.approx(math.atan(1 / number), abs=1e-12)
    assert np.abs(axis.at(np.linspace(0, axis.station[-1], 500))[1]).max() == pytest.approx(1 / radius, rel=1e-12)


def test_loop_comes_back():
    axis = Axis.of(turnout_connection(5.0, number=9, radius=300.0, parallel=400.0))
    across, _ = axis.plane(axis.station)
    assert abs(float(across[-1])) < 1e-9
    assert float(across.max()) == pytest.approx(5.0, abs=1e-9)
    assert abs(axis.bearing[-1]) < 1e-14


def test_tracks_too_close_for_the_turnout():
    with pytest.raises(TrackError, match="reach"):
        turnout_connection(3.0, number=9, radius=300.0)


def test_parallel_arcs_have_the_lengths_of_their_radii():
    on = placed([Element(1.0), *curve(400.0, 300.0, transition=60.0)], height=0.0)
    inner, _ = parallel_track(on, 70.0, 360.0, 2.0)
    outer, _ = parallel_track(on, 70.0, 360.0, -2.0)
    angle = 290.0 / 400.0
    assert inner.offset[-1] == pytest.approx(398.0 * angle, abs=1e-5)
    assert outer.offset[-1] == pytest.approx(402.0 * angle, abs=1e-5)
    np.testing.assert_allclose(1.0 / inner.curvature, 398.0, rtol=1e-9)
    np.testing.assert_allclose(1.0 / outer.curvature, 402.0, rtol=1e-9)


def test_offset_is_ground_length_up_a_slope_far_from_the_meridian():
    on = placed([Element(1000.0)], grades=((0.0, 0.02),), height=500.0)
    knots, _ = parallel_track(on, 0.0, 1000.0, 0.0)
    assert knots.offset[-1] == pytest.approx(1000.0 * math.hypot(1.0, 0.02), abs=1e-6)
    ends = [getattr(knots, c)[i] for i in (0, -1) for c in ("easting", "northing", "height")]
    assert float(FRAME.ground_length(*ends)) == pytest.approx(knots.offset[-1], abs=1e-5)
    grid = math.hypot(ends[3] - ends[0], ends[4] - ends[1])
    assert abs(grid - 1000.0) > 0.05  # the plane is not the ground here


def test_reversing_the_side_mirrors_the_connection():
    right = Axis.of(turnout_connection(4.0, number=9, radius=300.0))
    left = Axis.of(turnout_connection(-4.0, number=9, radius=300.0))
    s = np.linspace(0.0, right.station[-1], 50)
    np.testing.assert_allclose(right.plane(s)[0], -left.plane(s)[0], atol=1e-12)
    np.testing.assert_allclose(right.plane(s)[1], left.plane(s)[1], atol=1e-12)


def test_refusals():
    with pytest.raises(TrackError, match="overlaps"):
        Profile.of(0.0, [(0.0, 0.0), (100.0, 0.02), (150.0, -0.02)], radius=8000.0)
    with pytest.raises(TrackError, match="positive length"):
        Axis.of([])
    with pytest.raises(TrackError, match="not straight"):
        connecting_track(
            placed([Element(50.0), *curve(500.0, 200.0)]), 20.0, 2.0, turnout_connection(-4.0, number=9, radius=300.0)
        )
    with pytest.raises(TrackError, match="gradient changes"):
        connecting_track(
            placed([Element(500.0)], grades=((0.0, 0.0), (100.0, 0.01))),
            60.0,
            2.0,
            turnout_connection(-4.0, number=9, radius=300.0),
        )
    with pytest.raises(TrackError, match="no room"):
        turnout_connection(4.0, number=300, radius=300.0)


def test_subdivide_keeps_edges_and_limits():
    edges = np.array([0.0, 3.0, 3.4, 10.0])
    fine = subdivide(edges, 1.0)
    assert set(edges) <= set(fine.tolist())
    assert np.diff(fine).max() <= 1.0 + 1e-12
    assert len(subdivide([0.0, 5.0], 1.0)) == 6
