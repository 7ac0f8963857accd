"""Autonomous determination: printed tables and vectors of A1 to A3, A5, A7 and A8; source errors shown; refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from railnav.attitude import dcm_from_euler, euler_rates
from railnav.errors import EstimationError
from railnav.geodesy import WGS84, Ellipsoid
from railnav.inertial.autonomous import (
    averaging_time,
    coning_rate,
    fixed_latitude,
    fixed_latitude_error,
    geodetic_minus_geocentric,
    required_grade,
)
from railnav.inertial.great_circle import (
    great_circle_heading,
    great_circle_heading_error,
    ground_speed,
    ground_speed_error,
)
from railnav.inertial.mechanization import EARTH_RATE
from railnav.inertial.moving_base import moving_position
from railnav.inertial.reference_azimuth import longitude_from_reference

DEGREE = math.pi / 180
HOUR = DEGREE / 3600
MINUTE = DEGREE / 60
SWAP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
SPHERE = 6371000.0
#: The source rounds the semi-minor axis to 6,356,863.0 m; of 1/298.3 it is 6,356,863.019, 19 mm that make 19 mm in the difference.
KRASSOWSKY = Ellipsoid("Krassowsky, as rounded in the source", 6378245.0, 6378245.0 / (6378245.0 - 6356863.0))


def earth(latitude):
    return EARTH_RATE * np.array([np.cos(latitude), 0.0, -np.sin(latitude)])


# --- A1 ---------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("w", "f", "degrees"),
    [
        ((9.426, 11.663, -1.055), (-0.0437, 9.817, -0.0070), 50.6315),
        ((9.556, 11.460, 0.057), (0.0236, 9.809, 0.0626), 50.3149),
        ((11.147, -9.379, 0.081), (9.809, 0.0003, -0.0002), 49.9202),
        ((11.098, -9.392, 0.065), (9.809, 0.0002, -0.0002), 49.7576),
        ((11.655, -10.152, 0.097), (9.809, 0.0005, 0.00007), 48.9385),
        ((11.607, -10.127, 0.131), (9.809, 0.0005, 0.00006), 48.8903),
    ],
)
def test_tables_1_and_2(w, f, degrees):
    assert fixed_latitude(w, f).latitude / DEGREE == pytest.approx(degrees, abs=5.1e-5)


def test_source_errors_of_tables_2_to_4_are_against_48_4338():
    rows = [
        ((11.147, -9.379, 0.081), (9.809, 0.0003, -0.0002), 1.484, 0.003),
        ((11.098, -9.392, 0.065), (9.809, 0.0002, -0.0002), 1.321, 0.003),
        ((11.655, -10.152, 0.097), (9.809, 0.0005, 0.00007), 0.505, 0.003),
        ((11.607, -10.127, 0.131), (9.809, 0.0005, 0.00006), 0.454, 0.003),
        ((11.60712, -10.12774, 0.13169), (9.80903, 0.00051, 6.98988e-5), 0.45469, 1e-4),
        ((11.53242, -10.12005, 0.14469), (9.80904, 0.00051, 9.97693e-5), 0.29242, 1e-4),
        ((11.605188, -10.127233, 0.130684), (9.809032, 0.000511, 6.985569e-5), 0.451433, 1e-4),
        ((11.548486, -10.073288, 0.131826), (9.768779, 0.000509, 0.040323), 0.466475, 1e-4),
    ]
    latitudes = []
    for w, f, printed, tolerance in rows:
        latitudes.append(fixed_latitude(w, f).latitude / DEGREE)
        assert latitudes[-1] - 48.4338 == pytest.approx(printed, abs=tolerance)
    np.testing.assert_allclose(latitudes[4:], [48.888450, 48.726189, 48.885177, 48.900215], atol=6e-7)


def test_vector_of_a1_5_and_its_error():
    w = np.array([8.833422523201, 5.800855442584, 10.703010070729])
    f = np.array([0.482727220312, 0.871544111294, 9.759276883706])
    dw, df = np.array([0.01, -0.02, 0.03]), np.array([0.001, 0.002, -0.001])
    base = fixed_latitude(w, f).latitude
    assert base / DEGREE == pytest.approx(50.45, abs=1e-10)
    assert (fixed_latitude(w + dw, f + df).latitude - base) / DEGREE == pytest.approx(0.0920304663, abs=1e-10)
    linear = fixed_latitude_error(w, f, rate_error=dw, force_error=df) / DEGREE
    assert linear == pytest.approx(0.0922407785, abs=1e-10)


def test_attitude_does_not_matter():
    rng = np.random.default_rng(0)
    for turn in Rotation.random(2000, random_state=1).as_matrix():
        latitude = rng.uniform(-89, 89) * DEGREE
        got = fixed_latitude(turn @ earth(latitude), turn @ [0, 0, -9.81]).latitude
        assert abs(got - latitude) < 1e-9 * DEGREE
    assert fixed_latitude([0, 0, -1.0], [0, 0, -9.8]).latitude == pytest.approx(math.pi / 2)


def test_error_model_is_the_derivative():
    rng = np.random.default_rng(1)
    for turn in Rotation.random(200, random_state=2).as_matrix():
        latitude = rng.uniform(-80, 80) * DEGREE
        w, f = turn @ earth(latitude) / EARTH_RATE, turn @ [0, 0, -1.0]
        dw, df = rng.normal(size=3) * 1e-6, rng.normal(size=3) * 1e-6
        numeric = fixed_latitude(w + dw, f + df).latitude - fixed_latitude(w - dw, f - df).latitude
        assert fixed_latitude_error(w, f, rate_error=dw, force_error=df) == pytest.approx(numeric / 2, abs=1e-11)


def test_grades_as_printed():
    alone = 0.0024 * HOUR / EARTH_RATE / MINUTE
    assert alone == pytest.approx(0.549, abs=1e-3)
    level = earth(50 * DEGREE), np.array([0, 0, -9.80665])
    worst = max(
        abs(fixed_latitude_error(*level, rate_error=[a * 0.0024 * HOUR, 0, b * 0.0024 * HOUR])) / MINUTE
        for a in (-1, 1)
        for b in (-1, 1)
    )
    assert worst == pytest.approx(0.773, abs=1e-3)
    force = fixed_latitude_error(*level, force_error=[1.5e-4 * 9.80665, 0, 0]) / MINUTE
    assert abs(force) == pytest.approx(0.516, abs=1e-3)
    assert fixed_latitude_error(*level, rate_error=[0, 1e-8, 0], force_error=[0, 1e-3, 0]) == pytest.approx(
        0, abs=1e-15
    )
    gyro, accelerometer = required_grade(MINUTE)
    assert gyro / HOUR == pytest.approx(0.00219, abs=5e-6)
    assert accelerometer == pytest.approx(1.454e-4, abs=5e-8)


def test_confidence_as_printed():
    n, sigma = 38281, 34.457 * HOUR
    latitude = 48.4338 * DEGREE
    noise = np.random.default_rng(2).normal(0, sigma, (n, 3))
    got = fixed_latitude(earth(latitude) + noise, [0, 0, -9.81])
    assert got.sigma / DEGREE == pytest.approx(0.671, rel=0.02)
    spread = [
        fixed_latitude(
            earth(latitude) + np.random.default_rng(k).normal(0, sigma / math.sqrt(n), 3), [0, 0, -9.81]
        ).latitude
        for k in range(1500)
    ]
    assert np.std(spread) / DEGREE == pytest.approx(0.6716, rel=0.05)
    for arw, hours in ((0.2, (0.58, 58, 2090)), (0.02, (0.0058, 0.58, 20.9)), (0.002, (0.00006, 0.0058, 0.21))):
        for goal, printed in zip((1.0, 0.1, 1 / 60), hours, strict=True):
            got_hours = averaging_time(arw * DEGREE / 60, goal * DEGREE) / 3600
            assert got_hours == pytest.approx(printed, rel=0.06)


def test_averaging_after_the_formula_is_wrong():
    latitude = 48.4337 * DEGREE
    w = earth(latitude) + np.random.default_rng(3).normal(0, 34 * HOUR, (40_000, 3))
    samples = np.arcsin(-w[:, 2] / np.linalg.norm(w, axis=1)) / DEGREE
    assert samples.mean() == pytest.approx(11.8, abs=0.8)
    assert fixed_latitude(w, [0, 0, -9.8]).latitude / DEGREE == pytest.approx(48.4, abs=2)


def test_coning_spoils_it_and_is_noticed():
    latitude, half, turn, dt = 48.4337 * DEGREE, 0.1 * DEGREE, 2 * np.pi * 10, 5e-4
    t = np.arange(20_000) * dt
    cone = turn * np.column_stack(
        [-np.sin(half) * np.sin(turn * t), np.sin(half) * np.cos(turn * t), np.full_like(t, 2 * np.sin(half / 2) ** 2)]
    )
    w = earth(latitude) + cone
    got = fixed_latitude(w, [0, 0, -9.81], interval=dt)
    assert got.latitude / DEGREE == pytest.approx(-40.4, abs=0.1)
    assert got.coning_rate / HOUR == pytest.approx(19.7, rel=0.01)
    with pytest.raises(EstimationError, match="the base cones"):
        fixed_latitude(w, [0, 0, -9.81], interval=dt, largest_coning=0.01 * HOUR)
    straight = np.column_stack([np.sin(turn * t), 0 * t, 0 * t])
    assert coning_rate(straight, dt) == pytest.approx(0.0, abs=1e-15)
    for frequency, seconds in ((1, 20.8), (10, 6.6), (50, 2.9)):  # cone that costs one minute
        rate = MINUTE * EARTH_RATE / math.cos(latitude)
        angle = 2 * math.asin(math.sqrt(rate / (2 * 2 * math.pi * frequency)))
        assert angle / DEGREE * 3600 == pytest.approx(seconds, abs=0.06)


# --- A2 ---------------------------------------------------------------------------------------------------------------------------


def test_geodetic_minus_geocentric_as_printed():
    for degrees, krassowsky, wgs in (
        (30, 0.166899979, 0.166923850),
        (45, 0.192395746, 0.192423216),
        (50.45, 0.188804819, 0.188831760),
        (60, 0.166340480, 0.166364191),
    ):
        x = degrees * DEGREE
        assert geodetic_minus_geocentric(x, KRASSOWSKY) / DEGREE == pytest.approx(krassowsky, abs=2e-9)
        assert geodetic_minus_geocentric(x) / DEGREE == pytest.approx(wgs, abs=2e-9)
        assert geodetic_minus_geocentric(-x) == -geodetic_minus_geocentric(x)
    np.testing.assert_allclose(geodetic_minus_geocentric([0.0, math.pi / 2]), 0.0, atol=1e-15)
    grid = np.linspace(0, math.pi / 2, 900_001)
    change = geodetic_minus_geocentric(grid)
    assert change.max() / DEGREE == pytest.approx(0.192424, abs=5e-7)
    assert grid[change.argmax()] / DEGREE == pytest.approx(44.904, abs=5e-4)
    # outside truth: the ellipsoid's own Cartesian coordinates
    x, _, z = WGS84.to_cartesian(50.45 * DEGREE, 0.0)
    geocentric = math.atan2(z, x)
    assert geocentric / DEGREE == pytest.approx(50.260928, abs=5e-7)
    assert geocentric + geodetic_minus_geocentric(geocentric) == pytest.approx(50.45 * DEGREE, abs=1e-15)


def test_the_sources_175_metres_are_3():
    x = 45 * DEGREE
    difference = geodetic_minus_geocentric(x) - geodetic_minus_geocentric(x, KRASSOWSKY)
    assert difference * 6378137.0 == pytest.approx(3.058, abs=1e-3)
    assert difference / DEGREE * 6378137.0 == pytest.approx(175.21, abs=0.01)  # degrees taken for radians


# --- A3 ---------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("latitude", "azimuth", "degrees"),
    [(48, 30, -1.760381833), (48, 45, -3.049070776), (48, 60, -5.281145499), (50.4, 20, 0.227444204)],
)
def test_loxodrome_as_printed(latitude, azimuth, degrees):
    got = longitude_from_reference(latitude * DEGREE, 50 * DEGREE, 0.0, azimuth * DEGREE, kind="loxodrome")
    assert got.longitude / DEGREE == pytest.approx(degrees, abs=6e-10)


def test_figure_5():
    for latitude, row in {
        46: (0.009402, 0.004555, 0.001976),
        47: (0.004083, 0.001978, 0.000858),
        48: (0.001246, 0.000604, 0.000262),
    }.items():
        for azimuth, printed in zip((-60, -40, -20), row, strict=True):
            a, b, A = latitude * DEGREE, 50 * DEGREE, azimuth * DEGREE
            older = 2 * math.sin((a - b) / 2) / math.cos((a + b) / 2) * math.tan(A)
            exact = longitude_from_reference(a, b, 0.0, A, kind="loxodrome").longitude
            assert (exact - older) / DEGREE == pytest.approx(printed, abs=1e-6)


@pytest.mark.parametrize(
    ("latitude", "azimuth", "loxodrome", "sighted"),
    [(49.99, 45, 0.2, 0.0), (49.9, 45, 23, 0.01), (49.5, 45, 583, 1.7), (48, 45, 9587, 119), (46, 60, 172e3, 5500)],
)
def test_a_sighted_azimuth_is_no_loxodrome(latitude, azimuth, loxodrome, sighted):
    arguments = (latitude * DEGREE, 50 * DEGREE, 0.3, azimuth * DEGREE)
    true = longitude_from_reference(*arguments).longitude
    # the great circle from there in that azimuth does reach the reference: an outside check in vectors
    place = np.array(
        [math.cos(arguments[0]) * math.cos(true), math.cos(arguments[0]) * math.sin(true), math.sin(arguments[0])]
    )
    target = np.array(
        [math.cos(arguments[1]) * math.cos(0.3), math.cos(arguments[1]) * math.sin(0.3), math.sin(arguments[1])]
    )
    east = np.array([-math.sin(true), math.cos(true), 0.0])
    north = np.cross(place, east)
    assert math.atan2(target @ east, target @ north) == pytest.approx(arguments[3], abs=1e-12)
    for kind, metres, tolerance in (("loxodrome", loxodrome, 0.05), ("sighted", sighted, 0.1)):
        got = longitude_from_reference(*arguments, kind=kind).longitude
        error = abs(got - true) * SPHERE * math.cos(arguments[0])
        assert error == pytest.approx(metres, rel=tolerance, abs=0.05)


def test_error_model_of_the_longitude():
    a, b, A = 50 * DEGREE, 52 * DEGREE, 57.7 * DEGREE
    got = longitude_from_reference(a, b, 0.1, A, kind="loxodrome")
    h = 1e-6

    def at(*shift):
        return longitude_from_reference(a + shift[0], b + shift[1], 0.1, A + shift[2], kind="loxodrome").longitude

    numeric = [(at(*(h * e)) - at(*(-h * e))) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose([got.by_latitude, got.by_reference_latitude, got.by_azimuth], numeric, rtol=1e-7)
    assert 3 * got.by_latitude == pytest.approx(7.38, abs=5e-3)
    assert 3 * longitude_from_reference(46 * DEGREE, b, 0.1, 60 * DEGREE).by_latitude == pytest.approx(7.48, abs=5e-3)
    assert 3 * longitude_from_reference(a, b, 0.1, 45 * DEGREE).by_latitude == pytest.approx(4.67, abs=5e-3)
    assert got.sigma(1e-4, 0.0, 0.0) == pytest.approx(1e-4 * got.by_latitude)


def test_ellipsoid_in_the_loxodrome():
    arguments = (48 * DEGREE, 50 * DEGREE, 0.0, 45 * DEGREE)
    sphere = longitude_from_reference(*arguments, kind="loxodrome").longitude
    ellipsoid = longitude_from_reference(*arguments, kind="loxodrome", ellipsoid=WGS84).longitude
    assert abs(sphere - ellipsoid) / DEGREE == pytest.approx(0.0088, abs=5e-5)


# --- A5 ---------------------------------------------------------------------------------------------------------------------------


def test_single_vector_of_a5():
    w = SWAP @ [0.002162098894, -0.00283882373, 0.00069975667]
    # psi, theta, gamma of the source: counter-clockwise yaw, pitch, roll
    attitude, rates = np.array([[-10, 5, -30]]) * DEGREE, [[-0.003, 0.002, -0.001]]
    got = moving_position([0.0], w, attitude, rates, 30 * DEGREE)
    assert got.latitude[0] / DEGREE == pytest.approx(50.0, abs=1e-5)
    assert got.longitude_rate[0] == pytest.approx(2.4418832630e-5, abs=2e-12)  # the rates are printed to 1e-12
    assert got.longitude[0] == pytest.approx(30 * DEGREE)


@pytest.mark.parametrize(
    ("speed", "latitude", "longitude", "tolerance"),
    [(200, 55.607615, 35.364944, 1.5e-9), (400, 61.215229, 41.561246, 1.6e-8), (600, 66.822844, 48.979693, 7.5e-8)],
)
def test_figure_7_on_a_sphere(speed, latitude, longitude, tolerance):
    t = np.arange(3601.0)
    course = 30 * DEGREE
    phi = 50 * DEGREE + speed * math.cos(course) / SPHERE * t
    psi = np.arcsinh(np.tan(phi))
    lam = 30 * DEGREE + (psi - psi[0]) * math.tan(course)
    lamdot = speed * math.sin(course) / (SPHERE * np.cos(phi))
    turning = np.stack(
        [
            (EARTH_RATE + lamdot) * np.cos(phi),
            np.full_like(t, -speed * math.cos(course) / SPHERE),
            -(EARTH_RATE + lamdot) * np.sin(phi),
        ],
        axis=-1,
    )
    roll, pitch, heading = 0.1 * np.sin(0.1 * t), 0.05 * np.cos(0.07 * t), course + 0.02 * np.sin(0.05 * t)
    rates = np.stack([0.01 * np.cos(0.1 * t), -0.0035 * np.sin(0.07 * t), 0.001 * np.cos(0.05 * t)], axis=-1)
    # invert the Euler rates
    inverse = np.stack([euler_rates(roll, pitch, np.tile(e, (len(t), 1))) for e in np.eye(3)], axis=-1)
    own = np.linalg.solve(inverse, rates[..., None])[..., 0]
    w = np.einsum("kji,kj->ki", dcm_from_euler(roll, pitch, heading), turning) + own
    got = moving_position(t, w, np.stack([roll, pitch, heading], axis=-1), rates, 30 * DEGREE)
    assert got.valid.all()
    assert got.latitude[-1] / DEGREE == pytest.approx(latitude, abs=5e-7)
    assert got.longitude[-1] / DEGREE == pytest.approx(longitude, abs=5e-7)
    assert np.abs(got.latitude - phi).max() / DEGREE < 1e-9
    assert np.abs(got.longitude - lam).max() / DEGREE < 1.5 * tolerance


def test_error_budget_of_a5():
    speed, course = 200.0, 30 * DEGREE
    t = np.arange(601.0)
    phi = 50 * DEGREE + speed * math.cos(course) / SPHERE * t
    spin = EARTH_RATE + speed * math.sin(course) / (SPHERE * np.cos(phi))
    turning = np.stack(
        [spin * np.cos(phi), np.full_like(t, -speed * math.cos(course) / SPHERE), -spin * np.sin(phi)], axis=-1
    )
    zero = np.zeros((len(t), 3))
    base = moving_position(t, turning, zero, zero, 0.0)

    def change(rate=(0, 0, 0), angles=(0, 0, 0)):
        got = moving_position(t, turning + np.array(rate) * HOUR, zero + angles, zero, 0.0)
        return (got.latitude[-1] - base.latitude[-1]) / DEGREE, (got.longitude[-1] - base.longitude[-1]) / DEGREE

    north, up, east = change((0.01, 0, 0)), change((0, 0, -0.01)), change((0, 0.01, 0))
    assert north == (pytest.approx(-0.0220, abs=6e-5), pytest.approx(0.00106, abs=1e-5))
    assert up == (pytest.approx(0.0179, abs=6e-5), pytest.approx(0.00129, abs=1e-5))
    assert east == pytest.approx((0.0, 0.0), abs=1e-12)
    assert abs(change(angles=(0, MINUTE, 0))[0]) == pytest.approx(1 / 60, rel=1e-3)
    assert abs(change(angles=(MINUTE, 0, 0))[0]) < 0.006
    assert abs(change(angles=(0, 0, MINUTE))[0]) < 0.006


def test_flying_west_with_the_earth_loses_latitude_and_says_so():
    w = np.zeros((5, 3)) + 0.05 * EARTH_RATE
    w[0] = earth(50 * DEGREE)
    got = moving_position(np.arange(5.0), w, np.zeros((5, 3)), np.zeros((5, 3)), 0.0)
    np.testing.assert_array_equal(got.valid, [True, False, False, False, False])
    assert np.isnan(got.latitude[1:]).all()
    assert np.isnan(got.longitude[1:]).all()
    assert EARTH_RATE * SPHERE * math.cos(50 * DEGREE) == pytest.approx(298.6, abs=0.1)


# --- A7, A8 -------------------------------------------------------------------------------------------------------------------------


def test_great_circle_heading_as_printed():
    latitudes = np.array([50, 52.292242485, 54.117036197, 56.075063825, 55.498448486]) * DEGREE
    printed = [65.524181856, 71.756821499, 85.889132858, 100.650606976]
    heading = 60 * DEGREE
    for before, now, degrees in zip(latitudes, latitudes[1:], printed, strict=False):
        heading = great_circle_heading(now, before, heading)
        assert heading / DEGREE == pytest.approx(degrees, abs=2e-7)
    # past the vertex the source's arcsin alone would say 79.35 degrees
    assert math.asin(math.sin(heading)) / DEGREE == pytest.approx(180 - printed[-1], abs=2e-7)


def test_great_circle_in_small_steps_and_southbound():
    arc = np.arange(0, 80, 1 / 60) * DEGREE
    phi0, H0 = 50 * DEGREE, 60 * DEGREE
    phi = np.arcsin(np.sin(phi0) * np.cos(arc) + np.cos(phi0) * np.sin(arc) * np.cos(H0))
    true = np.arctan2(np.sin(H0) * np.cos(phi0), np.cos(phi0) * np.cos(H0) * np.cos(arc) - np.sin(phi0) * np.sin(arc))
    heading, error = H0, [0.0]
    for k in range(1, len(arc)):
        heading = great_circle_heading(phi[k], phi[k - 1], heading)
        error.append(abs(heading - true[k]) / DEGREE)
    error = np.array(error)
    vertex = 22.767 * DEGREE
    assert math.acos(math.cos(phi0) * math.sin(H0)) / DEGREE == pytest.approx(56.174155, abs=5e-7)
    assert error[arc < vertex - 0.5 * DEGREE].max() < 1e-10
    assert error[np.abs(arc - vertex) > 0.5 * DEGREE].max() < 1e-6
    assert error.max() < 0.05


def test_reduced_latitude_on_the_ellipsoid():
    arguments = (51 * DEGREE, 50 * DEGREE, 45 * DEGREE)
    assert great_circle_heading(*arguments) / DEGREE == pytest.approx(46.239614, abs=5e-7)
    assert great_circle_heading(*arguments, ellipsoid=WGS84) / DEGREE == pytest.approx(46.236170, abs=5e-7)


@pytest.mark.parametrize("now", [51.0, 49.0])
def test_error_of_the_great_circle_heading_is_the_derivative(now):
    phi, phi0, H0, h = now * DEGREE, 50 * DEGREE, (45 if now > 50 else 150) * DEGREE, 1e-6
    for name, e in zip(("latitude_error", "latitude_before_error", "heading_before_error"), np.eye(3), strict=True):
        ends = [great_circle_heading(phi + s * h * e[0], phi0 + s * h * e[1], H0 + s * h * e[2]) for s in (1, -1)]
        model = great_circle_heading_error(phi, phi0, H0, **{name: h})
        assert model == pytest.approx((ends[0] - ends[1]) / 2, rel=1e-5)


def test_leaving_the_great_circle_is_noticed():
    assert great_circle_heading(56.1742 * DEGREE, 50 * DEGREE, 60 * DEGREE) == pytest.approx(math.pi / 2)
    with pytest.raises(EstimationError, match="beyond the vertex"):
        great_circle_heading(57 * DEGREE, 50 * DEGREE, 60 * DEGREE)


def test_speed_as_printed_and_on_the_ellipsoid():
    phi = 50 * DEGREE
    assert ground_speed(1.2e-5, 2e-5, phi, ellipsoid=None) == pytest.approx(112.040943702, abs=5e-10)
    for degrees, row in ((28.5, (100.33, 100.07, 99.81)), (50.0, (99.97, 99.83, 99.69))):
        x = degrees * DEGREE
        for heading, printed in zip((0, 45, 90), row, strict=True):
            north, east = 100 * math.cos(heading * DEGREE), 100 * math.sin(heading * DEGREE)
            rates = north / WGS84.meridian_radius(x), east / (WGS84.transverse_radius(x) * math.cos(x))
            assert ground_speed(*rates, x) == pytest.approx(100.0, abs=1e-11)
            assert ground_speed(*rates, x, ellipsoid=None) == pytest.approx(printed, abs=5.1e-3)


def test_speed_error_is_the_derivative_and_as_printed():
    place = (1.2e-5, 2e-5, 50 * DEGREE)
    errors = {"latitude_rate_error": 1e-9, "longitude_rate_error": 1e-9, "latitude_error": 1e-4, "radius_error": 100.0}
    assert ground_speed_error(*place, **errors) == pytest.approx(0.001964150, abs=5e-10)
    h = 1e-4
    ends = [
        (SPHERE + s * h * 100)
        * math.hypot(place[0] + s * h * 1e-9, (place[1] + s * h * 1e-9) * math.cos(place[2] + s * h * 1e-4))
        for s in (1, -1)
    ]
    assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(ground_speed_error(*place, **errors), rel=1e-6)
    at_rest = ground_speed_error(0.0, 0.0, 0.9, latitude_rate_error=3e-9)
    assert at_rest == pytest.approx(SPHERE * 3e-9)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: fixed_latitude([0, 0, 0], [0, 0, 1]), ValueError, "no direction"),
        (lambda: fixed_latitude([np.nan, 0, 0], [0, 0, 1]), ValueError, "finite"),
        (lambda: fixed_latitude([1, 0, 0], [0, 0, 1], largest_coning=1.0), ValueError, "interval"),
        (lambda: fixed_latitude_error([0, 0, 1], [0, 0, 1]), EstimationError, "pole"),
        (lambda: longitude_from_reference(0.8, 0.9, 0.0, 1.57), EstimationError, "due east or west"),
        (lambda: longitude_from_reference(math.pi / 2, 0.9, 0.0, 0.5), EstimationError, "pole"),
        (lambda: longitude_from_reference(0.8, 1.5, 0.0, 1.3), EstimationError, "never reaches"),
        (lambda: longitude_from_reference(0.8, 0.9, 0.0, 0.5, kind="geodesic"), ValueError, "kind"),
        (
            lambda: moving_position([0, 0], np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3)), 0),
            ValueError,
            "sample 1",
        ),
        (lambda: moving_position([0], np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3)), 0), ValueError, "rows"),
    ],
)
def test_refusals_say_why(call, error, words):
    with pytest.raises(error, match=words):
        call()
