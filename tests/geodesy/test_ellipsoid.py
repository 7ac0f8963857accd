"""Ellipsoids: radii, Cartesian coordinates, normal gravity."""

from __future__ import annotations

import math

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from railnav.geodesy import ELLIPSOIDS, GRS80, KRASSOWSKY, WGS84

LATITUDES = np.radians([0.0, 45.0, 55.75, 90.0])


def test_normal_gravity_of_the_source():
    """spec/rail.md section 25, TV7."""
    np.testing.assert_allclose(KRASSOWSKY.normal_gravity(LATITUDES), [9.780, 9.805943, 9.815479, 9.832], atol=1e-6)


def test_normal_gravity_of_wgs84_and_grs80():
    """NIMA TR8350.2 (2000), section 4; Moritz, Geodetic Reference System 1980: gamma at 45 degrees 9.806199203."""
    assert GRS80.normal_gravity(math.pi / 4) == pytest.approx(9.806199203, abs=1e-9)
    np.testing.assert_allclose(WGS84.normal_gravity(LATITUDES[[0, 3]]), [9.7803253359, 9.8321849378], rtol=1e-12)
    assert WGS84.normal_gravity(math.pi / 4) == pytest.approx(9.8061977694, abs=1e-10)
    # free air: 0.3086 mGal a metre
    assert WGS84.normal_gravity(math.pi / 4) - WGS84.normal_gravity(math.pi / 4, 100.0) == pytest.approx(
        3.086e-4, rel=0.005
    )


def test_radii_and_cartesian_of_the_source():
    """spec/rail.md section 25, TV7."""
    latitude, longitude, height = math.radians(55.75), math.radians(37.6), 150.0
    assert KRASSOWSKY.meridian_radius(latitude) + height == pytest.approx(6379413.9282, abs=1e-4)
    assert KRASSOWSKY.transverse_radius(latitude) + height == pytest.approx(6393029.9809, abs=1e-4)
    np.testing.assert_allclose(
        KRASSOWSKY.to_cartesian(latitude, longitude, height), (2850680.9358, 2195319.8573, 5249043.0734), atol=1e-4
    )


@pytest.mark.parametrize(("name", "ellipsoid"), ELLIPSOIDS.items())
def test_cartesian_against_proj(name, ellipsoid):
    rng = np.random.default_rng(1)
    lat, lon, h = rng.uniform(-90, 90, 500), rng.uniform(-180, 180, 500), rng.uniform(-500, 9000, 500)
    proj = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart "
        f"+a={ellipsoid.semi_major_axis!r} +rf={ellipsoid.inverse_flattening!r}"
    )
    np.testing.assert_allclose(
        ellipsoid.to_cartesian(np.radians(lat), np.radians(lon), h), proj.transform(lon, lat, h), rtol=0, atol=3e-9
    )
    known = pyproj.Geod(ellps=name)
    assert (known.a, known.f) == pytest.approx((ellipsoid.semi_major_axis, ellipsoid.flattening), rel=3e-9)


@pytest.mark.parametrize("ellipsoid", [WGS84, KRASSOWSKY])
@given(
    latitude=st.floats(-math.pi / 2, math.pi / 2),
    longitude=st.floats(-math.pi, math.pi),
    height=st.floats(-10e3, 36e6),
)
def test_geodetic_round_trip(ellipsoid, latitude, longitude, height):
    x, y, z = ellipsoid.to_cartesian(latitude, longitude, height)
    again = ellipsoid.to_cartesian(*ellipsoid.to_geodetic(x, y, z))
    assert math.dist((x, y, z), again) < 1e-9 * max(1.0, (6.4e6 + height) / 1e6)


def test_poles_and_axis():
    latitude, longitude, height = WGS84.to_geodetic([0.0, 0.0], [0.0, 0.0], [WGS84.semi_minor_axis + 5.0, -6.4e6])
    np.testing.assert_allclose(np.degrees(latitude), [90.0, -90.0], atol=1e-12)
    np.testing.assert_allclose(height, [5.0, 6.4e6 - WGS84.semi_minor_axis], atol=1e-9)
    np.testing.assert_array_equal(longitude, [0.0, 0.0])


def test_euler_radius_lies_between_the_principal_ones():
    azimuth = np.linspace(0, math.pi, 13)
    radius = WGS84.euler_radius(0.9, azimuth)
    assert radius[0] == pytest.approx(float(WGS84.meridian_radius(0.9)), rel=1e-15)
    assert radius[6] == pytest.approx(float(WGS84.transverse_radius(0.9)), rel=1e-15)
    assert (np.diff(radius[:7]) > 0).all()
    np.testing.assert_allclose(radius, radius[::-1], rtol=1e-14)


def test_shapes_and_read_only_inputs():
    latitude = np.full((2, 3), 0.8)
    latitude.flags.writeable = False
    x, y, z = WGS84.to_cartesian(latitude, 0.1, 50.0)
    assert x.shape == y.shape == z.shape == (2, 3)
    assert WGS84.to_geodetic(x, y, z)[0].shape == (2, 3)
    assert np.ndim(WGS84.normal_gravity(0.8)) == 0
