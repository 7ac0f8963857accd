"""Vectors of the specification that belong to no other test: radii, gravity, frames, growth of errors, noise of headings and speeds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from railnav.geodesy.ellipsoid import WGS84, Ellipsoid
from railnav.inertial import (
    EARTH_RATE,
    GravityField,
    NavigationState,
    geodetic_minus_geocentric,
    great_circle_heading,
    great_circle_heading_error,
    ground_speed,
    mechanize,
)
from railnav.inertial.aided.single_point import north_east_down
from railnav.inertial.growth import leg_error
from railnav.inertial.sensors import TriadModel, simulate_triad

DEGREE = math.pi / 180
HOUR = DEGREE / 3600
MILLI_G = 9.81e-3


@pytest.mark.parametrize(
    ("degrees", "meridian", "transverse", "gravity"),
    [
        (0.0, 6335439.3272, 6378137.0, 9.78032534),
        (45.0, 6367381.8156, 6388838.2901, 9.80619777),
        (48.8388, 6371669.6168, 6390272.0517, 9.80966296),
        (90.0, 6399593.6258, 6399593.6258, 9.83218494),
    ],
)
def test_radii_and_gravity(degrees, meridian, transverse, gravity) -> None:
    phi = degrees * DEGREE
    assert WGS84.meridian_radius(phi) == pytest.approx(meridian, abs=2e-4)  # printed with b to 0.1 mm
    assert WGS84.transverse_radius(phi) == pytest.approx(transverse, abs=2e-4)
    assert WGS84.normal_gravity(phi, 0.0) == pytest.approx(gravity, abs=6e-9)
    if degrees == 45.0:
        assert GravityField().vector(phi, 1000.0)[2] == pytest.approx(9.80311294, abs=6e-9)


def test_cartesian_and_local_offsets() -> None:
    x = np.array(WGS84.to_cartesian(48.8388 * DEGREE, 2.1033 * DEGREE, 150.0))
    np.testing.assert_allclose(x, (4203212.908041734, 154367.234322158, 4778891.648309379), atol=2e-9)
    other = np.array(WGS84.to_cartesian(48.8397 * DEGREE, 2.1050 * DEGREE, 152.0))
    C = north_east_down(48.8388 * DEGREE, 2.1033 * DEGREE)
    np.testing.assert_allclose(C @ (other - x), (100.0897415661, 124.7937180646, -1.9979953846), atol=5e-9)
    printed = [
        [-0.155153496561, -0.666732429645, 0.728968627421],
        [-0.973975967279, 0.226651307437, 0.0],
        [-0.165221692486, -0.709997924009, -0.684547105929],
    ]
    np.testing.assert_allclose(north_east_down(43.2 * DEGREE, 76.9 * DEGREE), printed, atol=6e-13)


def test_difference_of_two_ellipsoids_in_angles() -> None:
    krassowsky = Ellipsoid("Krassowsky", 6378245.0, 6378245.0 / (6378245.0 - 6356863.0))
    difference = geodetic_minus_geocentric(45 * DEGREE) - geodetic_minus_geocentric(45 * DEGREE, krassowsky)
    assert difference / DEGREE == pytest.approx(2.7471e-5, abs=1e-9)
    assert difference == pytest.approx(4.7946e-7, abs=2e-11)
    metres = 0.192424 * DEGREE * 6371000
    assert metres == pytest.approx(21.4e3, rel=2e-3)


def test_polynomial_of_the_position_error() -> None:
    got = leg_error(
        60.0,
        position=1.0,
        velocity=0.05,
        accelerometer_bias=MILLI_G,
        gyro_bias=10 * HOUR,
        tilt=1e-3,
        heading=2e-3,
        speed=10.0,
        accelerometer_scale=1e-3,
        acceleration=0.5,
        gyro_scale=1e-3,
        turn=1.57,
        gravity=9.81,
    )
    terms = [getattr(got, name) for name in got.__slots__]
    np.testing.assert_allclose(terms, (1, 3, 17.658, 17.12168, 17.658, 1.2, 0.9, 0.471), atol=5e-6)
    assert got.total == pytest.approx(59.00867996, abs=5e-9)
    assert got.root_sum_square == pytest.approx(math.sqrt(sum(t * t for t in terms)))
    assert leg_error(300.0, accelerometer_bias=MILLI_G).total == pytest.approx(441.45, abs=0.05)
    assert leg_error(300.0, gyro_bias=10 * HOUR, gravity=9.81).total == pytest.approx(2140.0, abs=0.3)
    with pytest.raises(ValueError, match="must not be negative"):
        leg_error(-1.0)


def test_a_schuler_loop_bounds_the_error() -> None:
    """0.1 mg for three quarters of an hour, height held by its start: at most 2 (b/g) R = 1274 m."""
    place = NavigationState(48.8388 * DEGREE, 0.0, 0.0)
    g = GravityField().vector(place.latitude, 0.0)[2]
    n, h = 27_00, 1.0
    rate = EARTH_RATE * np.array([math.cos(place.latitude), 0.0, -math.sin(place.latitude)])
    force = np.array([0.0, 0.0, -g])
    free, biased = (
        mechanize(place, h, np.tile(rate, (n, 1)), np.tile(force + np.array([b, 0.0, 0.0]), (n, 1)), scheme="matrix")
        for b in (0.0, 1e-4 * g)
    )
    north = (biased.latitude - free.latitude) * WGS84.meridian_radius(place.latitude)
    assert np.abs(north).max() == pytest.approx(1268.5, rel=0.02)
    assert np.abs(north).max() < 2 * 1e-4 * 6371000 * 1.01
    assert abs(int(np.argmax(np.abs(north))) - 2529) < 60


def test_noise_of_a_sample() -> None:
    arw = 4.5 * DEGREE / 60
    x = simulate_triad(np.zeros((40_000, 3)), 0.01, TriadModel(random_walk=arw), seed=1).measured
    assert x.std() == pytest.approx(arw / math.sqrt(0.01), rel=0.01)


@pytest.mark.parametrize(("noise", "printed"), [(1e-6, 3.9e-5), (1e-5, 2.9e-4), (1e-4, 2.5e-3)])
def test_heading_noise_near_the_vertex(noise: float, printed: float) -> None:
    """Latitude noise at an arc of 25 degrees, a little past the vertex at 22.767."""
    phi0, H0, arc = 50 * DEGREE, 60 * DEGREE, 25 * DEGREE
    phi = math.asin(math.sin(phi0) * math.cos(arc) + math.cos(phi0) * math.sin(arc) * math.cos(H0))
    rng = np.random.default_rng(1)
    # in small steps, so that the branch after the vertex is taken; only the last latitude is noisy
    top = math.acos(math.cos(phi0) * math.sin(H0))
    got = [
        great_circle_heading(phi + n, top - 1e-9, math.pi / 2) / DEGREE for n in rng.normal(0.0, noise * DEGREE, 2000)
    ]
    sigma = abs(great_circle_heading_error(phi, phi0, H0, latitude_error=noise * DEGREE)) / DEGREE
    assert np.std(got) == pytest.approx(sigma, rel=0.05)
    assert sigma == pytest.approx(printed, rel=0.5)  # the witness has noise on every latitude of its steps


def test_reduced_latitude_over_five_degrees() -> None:
    sphere, ellipsoid = (
        great_circle_heading(55 * DEGREE, 50 * DEGREE, 30 * DEGREE, ellipsoid=e) for e in (None, WGS84)
    )
    assert abs(sphere - ellipsoid) / DEGREE == pytest.approx(1.1e-2, rel=0.05)


def test_speed_from_noisy_fixes() -> None:
    """1 m of white noise at 1 Hz, central differences: the printed 0.68 m/s."""
    rng = np.random.default_rng(2)
    n, R = 4000, 6371000.0
    t = np.arange(n, dtype=float)
    lat = 0.9 + 10.0 * t / R + rng.normal(0.0, 1.0, n) / R
    lon = rng.normal(0.0, 1.0, n) / (R * np.cos(0.9))
    rates = [(x[2:] - x[:-2]) / 2.0 for x in (lat, lon)]
    speed = ground_speed(*rates, lat[1:-1], ellipsoid=None)
    assert np.std(speed) == pytest.approx(0.70, abs=0.04)


def test_westward_speeds_that_stop_the_earth() -> None:
    at_50 = EARTH_RATE * 6371000 * math.cos(50 * DEGREE)
    assert at_50 == pytest.approx(298.6, abs=0.05)
    equator = EARTH_RATE * 6371000
    assert equator == pytest.approx(464.6, abs=0.05)
