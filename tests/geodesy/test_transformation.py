"""Pinned transformations and the geodetic frames of receivers."""

from __future__ import annotations

import math

import numpy as np
import pyproj
import pytest

from railnav.errors import CrsError
from railnav.geodesy import GSK2011, WGS84, geodetic_frame
from railnav.geodesy.transformation import Extent, pin_operation

MOSCOW = (math.radians(55.75), math.radians(37.6))


@pytest.mark.parametrize(("source", "target"), [(7683, 9475), (7681, 7679), (7677, 7679)])
def test_silent_ballpark_is_an_error(source, target):
    """spec/track_geometry.md 1.5: PROJ returns the input unchanged for these, and says so only in an accuracy of -1."""
    with pytest.raises(CrsError, match="no usable transformation"):
        pin_operation(pyproj.CRS.from_epsg(source), pyproj.CRS.from_epsg(target), Extent.of(*MOSCOW))


@pytest.mark.parametrize("name", ["WGS84", "WGS 84", "EPSG:4326", "epsg:4979", "WGS84 (G2139)"])
def test_wgs84_is_left_alone(name):
    frame = geodetic_frame(name, *MOSCOW)
    assert frame.accuracy == 0.0
    assert frame.to_wgs84(*MOSCOW, 10.0) == (*MOSCOW, 10.0)


def test_heights_change_with_the_ellipsoid():
    """GSK-2011 joins WGS 84 by Cartesian coordinates: the same point, another height (0.42 to 0.55 m) and latitude."""
    frame = geodetic_frame("GSK-2011", *MOSCOW)
    latitude, longitude, height = frame.to_wgs84(*MOSCOW, 150.0)
    np.testing.assert_allclose(
        WGS84.to_cartesian(latitude, longitude, height), GSK2011.to_cartesian(*MOSCOW, 150.0), rtol=0, atol=1e-8
    )
    assert 0.4 < 150.0 - float(height) < 0.6


def test_missing_heights_stay_missing():
    frame = geodetic_frame("EPSG:7683", *MOSCOW)
    latitude, _, height = frame.to_wgs84([MOSCOW[0]] * 2, MOSCOW[1], [np.nan, 0.0])
    np.testing.assert_array_equal(np.isnan(height), [True, False])
    assert np.isfinite(latitude).all()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nowhere", "knows no geodetic frame"),
        ("EPSG:28407", "not a frame of latitude and longitude"),
        ("EPSG:4978", "not a frame of latitude and longitude"),
    ],
)
def test_refusals(name, words):
    with pytest.raises(CrsError) as caught:
        geodetic_frame(name, *MOSCOW)
    assert words in str(caught.value)


def test_positions_that_are_none():
    for name in ("WGS84", "GSK-2011"):
        with pytest.raises(CrsError, match="position 2"):
            geodetic_frame(name, *MOSCOW).to_wgs84([MOSCOW[0], math.nan], MOSCOW[1])
