"""Strapdown: printed one-step vectors, road predictor vectors, an ECEF integration as outside truth, laws and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

from railnav.attitude import (
    dcm_from_euler,
    dcm_from_quaternion,
    dcm_from_rotation_vector,
    quaternion_from_dcm,
    rotation_vector_from_dcm,
)
from railnav.errors import EstimationError
from railnav.geodesy import KRASSOWSKY, WGS84
from railnav.inertial import _kernels
from railnav.inertial.mechanization import EARTH_RATE, GravityField, NavigationState, mechanize
from railnav.simulation.inertial import interval_means

DEGREE = np.pi / 180
SCHEMES = ("coning", "matrix", "euler", "predictor", "predictor_first_order")
#: east, north, up <-> north, east, down, and right, forward, up <-> forward, right, down: its own inverse.
SWAP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])


def earth_rate_n(latitude):
    return EARTH_RATE * np.array([np.cos(latitude), 0.0, -np.sin(latitude)])


def metres(a, b):
    """Position of a against b: north, east, up."""
    M, N = WGS84.meridian_radius(b.latitude) + b.height, WGS84.transverse_radius(b.latitude) + b.height
    return np.array(
        [(a.latitude - b.latitude) * M, (a.longitude - b.longitude) * N * np.cos(b.latitude), a.height - b.height]
    )


# --- printed vectors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scheme", "velocity", "angles"),
    [
        (
            "matrix",
            (9.99742606741011, -4.998342059759453, 0.500127612722877),
            (1.00669742490582, 1.988054940220937, 30.028490762661832),
        ),
        (
            "euler",
            (9.997420492461861, -4.998351487989741, 0.500127601065755),
            (1.00670041408537, 1.988056597279791, 30.028491563045),
        ),
    ],
)
def test_printed_step(scheme, velocity, angles):
    start = NavigationState.from_euler(
        50 * DEGREE,
        30 * DEGREE,
        200.0,
        velocity_n=[10, -5, 0.5],
        roll=1 * DEGREE,
        pitch=2 * DEGREE,
        heading=30 * DEGREE,
    )
    got = mechanize(start, 0.01, [[0.01, -0.02, 0.05]], [[0.2, 0.1, -9.8]], scheme=scheme).state()
    # normal gravity from rounded polar gravity: 3e-11 m/s^2 beside the source's constants, hence 1e-12 and not the last digit
    np.testing.assert_allclose(got.velocity_n, velocity, atol=1e-12)
    np.testing.assert_allclose(np.array([got.roll, got.pitch, got.heading]) / DEGREE, angles, atol=1e-12)
    if scheme == "matrix":
        assert got.latitude / DEGREE == pytest.approx(50.00000089890168, abs=2e-14)
        assert got.longitude / DEGREE == pytest.approx(29.999999302746065, abs=2e-14)
        assert got.height == pytest.approx(199.99499936193638, abs=2e-13)


def test_normal_gravity_as_printed():
    field = GravityField()
    for latitude, height, printed in (
        (0, 0, 9.78032534),
        (45, 0, 9.80619777),
        (45, 1000, 9.80311294),
        (48.8388, 0, 9.80966296),
        (90, 0, 9.83218494),
    ):
        assert field.vector(latitude * DEGREE, height)[2] == pytest.approx(printed, abs=5.1e-9)


def test_tv7_gravity_of_the_road_predictor():
    field = GravityField(ellipsoid=KRASSOWSKY, free_air="none")
    for latitude, printed in ((0, 9.780), (45, 9.805943), (55.75, 9.815479), (90, 9.832)):
        assert field.vector(latitude * DEGREE, 150.0)[2] == pytest.approx(printed, abs=5.1e-7)
    meridian, across = _kernels.radii(np.sin(55.75 * DEGREE), field.flat())
    assert (meridian + 150, across + 150) == (
        pytest.approx(6379413.9282, abs=1e-4),
        pytest.approx(6393029.9809, abs=1e-4),
    )


def test_tv8_attitude_matrix_of_the_road_predictor():
    expected = [
        [0.8670186903, 0.4980973490, -0.0133274742],
        [-0.4970612314, 0.8627299157, -0.0928828558],
        [-0.0347666936, 0.0871557427, 0.9955878432],
    ]
    C_nb = dcm_from_euler(2 * DEGREE, 5 * DEGREE, 30 * DEGREE)  # theta is roll, gamma pitch, K heading
    np.testing.assert_allclose(SWAP @ C_nb @ SWAP, expected, atol=6e-11)


@pytest.mark.parametrize(
    ("disturbance", "printed"),
    [
        ({}, (-0.001200431631, 0.000608815611, 9.815049237891)),
        (
            {"deflection_east": 5 * DEGREE / 3600, "deflection_north": -3 * DEGREE / 3600, "anomaly": 2e-4},
            (-0.0009624977, 0.000466055252, 9.815249237891),
        ),
    ],
)
def test_tv9_rates_and_compensation(disturbance, printed):
    field = GravityField(ellipsoid=KRASSOWSKY, free_air="none", **disturbance).flat()
    latitude, height, v = 55.75 * DEGREE, 150.0, SWAP @ [5.0, 10.0, 0.2]
    meridian, across = _kernels.radii(np.sin(latitude), field)
    en, ed, wn, we, wd = _kernels.frame_rates(
        np.sin(latitude), np.cos(latitude), across + height, meridian + height, v[0], v[1], EARTH_RATE
    )
    rate = np.array([en + wn, we, ed + wd])
    np.testing.assert_allclose(SWAP @ rate * 1e6, (-1.567542114772, 41.822484313224, 61.424545371205), atol=6e-13)
    compensation = np.cross(rate + np.array([en, 0.0, ed]), v) - _kernels.gravity(np.sin(latitude), height, field)
    np.testing.assert_allclose(SWAP @ compensation, printed, atol=6e-11)


def test_tv10_first_order_cycle():
    start = NavigationState.from_euler(
        55.75 * DEGREE,
        37.6 * DEGREE,
        150.0,
        velocity_n=SWAP @ [5.0, 10.0, 0.2],
        pitch=np.arcsin(0.2 / np.sqrt(125.04)),
        heading=np.arctan2(5, 10),
    )
    rate, force = SWAP @ [0.001, -0.002, -0.06], SWAP @ [0.3, 0.5, 9.82]
    field = GravityField(ellipsoid=KRASSOWSKY, free_air="none")
    got = mechanize(start, 0.1, [rate], [force], scheme="predictor_first_order", gravity=field).state()
    assert (got.latitude - start.latitude) * 1e9 == pytest.approx(156.7542115, abs=3e-7)
    assert (got.longitude - start.longitude) * 1e9 == pytest.approx(138.9649809, abs=3e-7)
    assert got.height == pytest.approx(150.02, abs=1e-12)
    np.testing.assert_allclose(SWAP @ got.velocity_n, (5.041455218476, 10.015527429740, 0.201232278027), atol=6e-13)


def test_tv12_stationary_vehicle():
    latitude = 55.75 * DEGREE
    field = GravityField(ellipsoid=KRASSOWSKY, free_air="none")
    start = NavigationState.from_euler(latitude, 37.6 * DEGREE, 150.0, roll=0.02, pitch=-0.01, heading=1.0)
    rate, force = start.C_nb.T @ earth_rate_n(latitude), -start.C_nb.T @ field.vector(latitude, 150.0)
    got = mechanize(start, 0.1, np.tile(rate, (6000, 1)), np.tile(force, (6000, 1)), scheme="predictor", gravity=field)
    assert np.abs(got.velocity_n).max() < 1e-8
    assert np.abs(got.C_nb - start.C_nb).max() < 1e-11


# --- outside truth ---------------------------------------------------------------------------------------------------------


def rates(t):
    return np.stack([0.05 * np.cos(2 * t), 0.08 * np.sin(3 * t), 0.2 + 0.1 * np.sin(t)], -1)


def forces(t):
    return np.stack([0.5 * np.sin(t), 2 + 0.3 * np.cos(2 * t), -9.81 + 0.2 * np.sin(5 * t)], -1)


START = NavigationState.from_euler(48.8388 * DEGREE, 2.1033 * DEGREE, 150.0, velocity_n=[10.0, 0, 0])
DURATION = 20.0


def axes_en(latitude, longitude):
    s, c, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array([[-s * cl, -sl, -c * cl], [-s * sl, cl, -c * sl], [c, 0, -s]])


@pytest.fixture(scope="module")
def truth():
    """The manoeuvre of section B3 integrated in ECEF axes by an eighth-order method: another formulation altogether."""
    field, spin = GravityField(), np.array([0, 0, EARTH_RATE])

    def derivative(t, y):
        latitude, longitude, height = WGS84.to_geodetic(*y[:3])
        C_eb = dcm_from_quaternion(y[6:] / np.linalg.norm(y[6:]))
        g = axes_en(latitude, longitude) @ field.vector(float(latitude), float(height))
        w = rates(np.array(t)) - C_eb.T @ spin
        q = y[6:]
        turn = 0.5 * np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)])
        return np.concatenate([y[3:6], C_eb @ forces(np.array(t)) + g - 2 * np.cross(spin, y[3:6]), turn])

    C_en = axes_en(START.latitude, START.longitude)
    position = np.array(WGS84.to_cartesian(START.latitude, START.longitude, START.height))
    start = np.concatenate([position, C_en @ START.velocity_n, quaternion_from_dcm(C_en @ START.C_nb)])
    end = solve_ivp(derivative, (0, DURATION), start, method="DOP853", rtol=1e-12, atol=1e-11).y[:, -1]
    latitude, longitude, height = (float(v) for v in WGS84.to_geodetic(*end[:3]))
    C_ne = axes_en(latitude, longitude).T
    return NavigationState.from_dcm(
        latitude,
        longitude,
        height,
        velocity_n=C_ne @ end[3:6],
        C_nb=C_ne @ dcm_from_quaternion(end[6:] / np.linalg.norm(end[6:])),
    )


def error_against(truth, scheme, dt):
    n = round(DURATION / dt)
    t = np.arange(n) * dt
    if scheme in ("euler", "predictor_first_order"):  # as the sources: the sample at the start is held
        w, f = rates(t), forces(t)
    else:
        x, weight = np.polynomial.legendre.leggauss(6)
        inside = t[:, None] + dt * (x + 1) / 2
        w, f = ((g(inside) * weight[:, None] / 2).sum(axis=1) for g in (rates, forces))
    got = mechanize(START, dt, w, f, scheme=scheme).state()
    turn = rotation_vector_from_dcm(got.C_nb.T @ truth.C_nb)
    return (np.linalg.norm(metres(got, truth)), np.linalg.norm(got.velocity_n - truth.velocity_n), np.linalg.norm(turn))


@pytest.mark.parametrize(
    ("scheme", "printed", "order"),
    [
        ("euler", (2.77, 1.38, 0.69, 0.34), 1),
        ("matrix", (3.3e-3, 7.0e-4, 1.2e-4, 3e-5), 2),
        ("predictor_first_order", None, 1),
        ("predictor", None, 2),
        ("coning", None, 3),
    ],
)
def test_order_and_printed_errors_of_the_manoeuvre(truth, scheme, printed, order):
    errors = np.array([error_against(truth, scheme, dt) for dt in (0.04, 0.02, 0.01, 0.005)])
    if printed:
        np.testing.assert_allclose(errors[:, 0], printed, rtol=0.25 if order == 2 else 0.02)
    found = np.log2(errors[0] / errors[1])
    assert np.all(found > order - 0.2), found
    if scheme == "coning":
        assert errors[2, 0] < 1e-5
        assert errors[2, 2] < 1e-8


def test_coning_scheme_holds_a_vibrating_base():
    """1 degree of coning at 10 Hz and 100 Hz sampling: the plain increment drifts as section A9 says, the scheme does not."""
    half_angle, turn, dt, n = 1 * DEGREE, 2 * np.pi * 10, 0.01, 6000
    t = np.arange(n + 1) * dt
    integral = np.stack(
        [
            np.sin(half_angle) * np.cos(turn * t),
            np.sin(half_angle) * np.sin(turn * t),
            -2 * np.sin(half_angle / 2) ** 2 * turn * t,
        ],
        axis=-1,
    )
    w = np.diff(integral, axis=0) / dt
    C0 = dcm_from_rotation_vector([half_angle, 0, 0])
    still = GravityField(earth_rate=0.0)
    start = NavigationState.from_dcm(0.8, 0.0, 0.0, C_nb=C0)
    drift = {}
    for scheme in ("coning", "matrix"):
        got = mechanize(start, dt, w, np.zeros((n, 3)), scheme=scheme, gravity=still)
        level = NavigationState(0.8, 0.0, 0.0)  # what free fall does to n is the same for both
        fall = mechanize(level, dt, np.zeros((n, 3)), np.zeros((n, 3)), scheme=scheme, gravity=still)
        back = fall.state().C_nb.T @ got.state().C_nb @ C0.T
        drift[scheme] = rotation_vector_from_dcm(back)[2] / (n * dt) / DEGREE * 3600
    assert drift["matrix"] == pytest.approx(-126, abs=3)  # table of A9.2, one sample: -126 deg/h
    assert abs(drift["coning"]) < 14


# --- laws ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_vehicle_at_rest_stays_for_ten_minutes(scheme):
    angles = {"roll": 2 * DEGREE, "pitch": -3 * DEGREE, "heading": 40 * DEGREE}
    start = NavigationState.from_euler(48.8388 * DEGREE, 2.1033 * DEGREE, 150.0, **angles)
    rate = start.C_nb.T @ earth_rate_n(start.latitude)
    force = -start.C_nb.T @ GravityField().vector(start.latitude, start.height)
    n = 60_000
    got = mechanize(start, 0.01, np.tile(rate, (n, 1)), np.tile(force, (n, 1)), scheme=scheme)
    assert np.abs(metres(got.state(), start)).max() < 5e-6
    assert np.abs(got.velocity_n).max() < 3e-8
    assert np.linalg.norm(rotation_vector_from_dcm(got.state().C_nb.T @ start.C_nb)) < 5e-10 * DEGREE


def test_a_closed_loop_closes():
    """Truth of a train on a closed curve, turned into samples by the simulator, comes back to its start."""
    t = np.linspace(0, 120, 12001)
    angle = 2 * np.pi * (t / 120 - np.sin(2 * np.pi * t / 120) / (2 * np.pi))  # at rest at both ends
    radius = 300.0
    M, N = WGS84.meridian_radius(0.9), WGS84.transverse_radius(0.9)
    latitude = 0.9 + radius * np.sin(angle) / M
    height = 50 + 5 * (1 - np.cos(angle))
    spin = np.gradient(angle, t, edge_order=2)
    velocity = np.stack(
        [
            radius * np.cos(angle) * spin * (WGS84.meridian_radius(latitude) + height) / M,
            -radius
            * np.sin(angle)
            * spin
            * (WGS84.transverse_radius(latitude) + height)
            * np.cos(latitude)
            / (N * np.cos(0.9)),
            -5 * np.sin(angle) * spin,
        ],
        axis=-1,
    )
    attitude = dcm_from_euler(0.05 * np.sin(angle), 0.02 * np.sin(2 * angle), angle)
    w, f = interval_means(t, latitude, height, velocity, attitude)
    start = NavigationState.from_dcm(0.9, 0.0, 50.0, C_nb=attitude[0])
    end = mechanize(start, np.diff(t), w, f, scheme="coning", gravity=GravityField(free_air="linear")).state()
    assert np.abs(metres(end, start)).max() < 2e-3
    assert np.abs(end.velocity_n).max() < 2e-5
    assert np.linalg.norm(rotation_vector_from_dcm(end.C_nb.T @ attitude[-1])) < 5e-9


@pytest.mark.parametrize(
    ("seconds", "kind", "printed"),
    [
        (10, "accelerometer", 0.4905),
        (60, "accelerometer", 17.648),
        (300, "accelerometer", 436.30),
        (10, "gyro", 0.0793),
        (60, "gyro", 17.115),
        (300, "gyro", 2125.0),
        (300, "tilt", 436.27),
    ],
)
def test_growth_of_errors_is_as_printed(seconds, kind, printed):
    place = NavigationState(48.8388 * DEGREE, 2.1033 * DEGREE, 150.0)
    g = GravityField().vector(place.latitude, 150.0)[2]
    n = seconds * 10
    start, rate, force = place, earth_rate_n(place.latitude), np.array([0.0, 0.0, -g])
    free = mechanize(start, 0.1, np.tile(rate, (n, 1)), np.tile(force, (n, 1)), scheme="matrix").state()
    if kind == "accelerometer":
        force = force + np.array([1e-3 * g, 0, 0])
    elif kind == "gyro":
        rate = rate + np.array([0, -10 * DEGREE / 3600, 0])
    else:
        start = NavigationState.from_dcm(
            place.latitude, place.longitude, 150.0, C_nb=dcm_from_rotation_vector([0, -1e-3, 0])
        )
    got = mechanize(start, 0.1, np.tile(rate, (n, 1)), np.tile(force, (n, 1)), scheme="matrix").state()
    assert metres(got, free)[0] == pytest.approx(printed, rel=3e-4, abs=6e-5)


def test_biases_and_scale_are_taken_off():
    rng = np.random.default_rng(0)
    w, f = rng.normal(0, 0.01, (50, 3)), rng.normal([0, 0, -9.8], 0.2, (50, 3))
    bg, ba, s = np.array([1e-3, -2e-3, 3e-3]), np.array([0.02, 0.03, -0.01]), np.array([1e-3, 2e-3, -1e-3])
    a = mechanize(START, 0.01, w, f)
    b = mechanize(START, 0.01, w + bg, f * (1 + s) + ba, gyro_bias=bg, accelerometer_bias=ba, accelerometer_scale=s)
    np.testing.assert_allclose(a.velocity_n, b.velocity_n, atol=1e-12)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_long_intervals_are_cut_and_times_may_vary(scheme):
    w, f = np.array([[0.01, 0.02, 0.03]]), np.array([[0.1, 0.2, -9.8]])
    once = mechanize(START, 0.4, w, f, scheme=scheme).state()
    parts = mechanize(START, 0.1, np.repeat(w, 4, axis=0), np.repeat(f, 4, axis=0), scheme=scheme).state()
    np.testing.assert_allclose(once.velocity_n, parts.velocity_n, atol=1e-13)
    uneven = np.random.default_rng(0).uniform(0.002, 0.02, 400)
    got = mechanize(START, uneven, np.repeat(w, 400, axis=0), np.repeat(f, 400, axis=0), scheme="coning")
    even = mechanize(
        START, uneven.sum() / 4000, np.repeat(w, 4000, axis=0), np.repeat(f, 4000, axis=0), scheme="coning"
    )
    np.testing.assert_allclose(got.velocity_n[-1], even.velocity_n[-1], atol=1e-6)
    assert got.time[-1] == pytest.approx(uneven.sum())


def test_gravity_anomalies_move_a_vehicle_that_does_not_know_them():
    start = NavigationState(0.9, 0.0, 0.0)
    rate, true = earth_rate_n(0.9), GravityField(deflection_north=1e-4, anomaly=1e-3)
    force = -true.vector(0.9)
    known = mechanize(start, 0.01, np.tile(rate, (1000, 1)), np.tile(force, (1000, 1)), gravity=true)
    ignorant = mechanize(start, 0.01, np.tile(rate, (1000, 1)), np.tile(force, (1000, 1)))
    assert np.abs(known.velocity_n).max() < 1e-10
    assert ignorant.velocity_n[-1, 0] == pytest.approx(1e-4 * 9.812 * 10, rel=1e-3)
    assert ignorant.velocity_n[-1, 2] == pytest.approx(-1e-3 * 10, rel=1e-3)


def test_one_step_at_a_time_equals_the_whole():
    w, f = rates(np.arange(100) * 0.01), forces(np.arange(100) * 0.01)
    whole = mechanize(START, 0.01, w, f, scheme="matrix")
    state = START
    for k in range(100):
        state = mechanize(state, 0.01, w[k : k + 1], f[k : k + 1], scheme="matrix").state()
    np.testing.assert_allclose(state.velocity_n, whole.velocity_n[-1], atol=1e-12)


# --- method error of the road predictor (rail.md 14) ------------------------------------------------------------------------


def test_method_error_of_the_predictor_is_the_hold_delay():
    """Free run of 60 s on the three-lobed loop: 1.757 % of speed at 0.1 s, ten times less at 0.01 s, almost none averaged."""
    theta = np.linspace(0, 2 * np.pi, 40001)

    def place(a):
        r = 180 * (1 + 0.12 * np.cos(3 * a))
        return np.stack([r * np.cos(a), r * np.sin(a), 2.5 * np.sin(2 * a)], -1)

    p = place(theta)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    knots = np.arange(-2, 62, 0.25)
    way = 12 * (knots + 5) - 30 * (np.cos(0.1 * (knots + 5)) - 1)
    spline = make_interp_spline(knots, place(np.interp(np.mod(way, length[-1]), length, theta)), k=7)
    fine = 0.001
    t = np.arange(0, 60 + 2 * fine, fine)
    lat0, lon0 = 55.75 * DEGREE, 37.6 * DEGREE
    C_eg = axes_en(lat0, lon0) @ SWAP
    X = np.array(WGS84.to_cartesian(lat0, lon0, 150.0)) + spline(t) @ C_eg.T
    latitude, longitude, height = WGS84.to_geodetic(*X.T)
    C_en = np.array([axes_en(a, b) for a, b in zip(latitude, longitude, strict=True)])
    v = np.einsum("kij,ki->kj", C_en, spline(t, 1) @ C_eg.T)
    speed = np.linalg.norm(v, axis=1)
    attitude = dcm_from_euler(0.0, np.arcsin(-v[:, 2] / speed), np.arctan2(v[:, 1], v[:, 0]))
    w, f = interval_means(t, latitude, height, v, attitude)
    start = NavigationState.from_dcm(latitude[0], longitude[0], height[0], velocity_n=v[0], C_nb=attitude[0])
    field = GravityField(free_air="linear")

    def error(scheme, every, averaged):
        n = 60_000 // every
        if averaged:
            a, b = (x[: n * every].reshape(n, every, 3).mean(axis=1) for x in (w, f))
        else:
            a, b = w[: n * every : every], f[: n * every : every]
        got = mechanize(start, every * fine, a, b, scheme=scheme, gravity=field)
        return np.abs(got.velocity_n - v[: n * every + 1 : every]).max() / speed.mean() * 100

    assert error("predictor_first_order", 100, False) == pytest.approx(1.757, rel=0.03)
    assert error("predictor_first_order", 10, False) == pytest.approx(0.175, rel=0.1)
    assert error("predictor", 100, False) == pytest.approx(0.610, rel=0.03)
    assert error("predictor", 100, True) < 0.01
    assert error("coning", 100, True) < error("predictor", 100, True) / 3


# --- refusals ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: mechanize(START, 0.01, [[0, 0, 0]], [[0, 0]]), ValueError, "specific_force_b must have the shape"),
        (lambda: mechanize(START, 0.01, [[0, 0, 0]] * 2, [[0, 0, 0]]), ValueError, "2 angular rates but 1"),
        (lambda: mechanize(START, 0.01, [[0, np.nan, 0]], [[0, 0, 0]]), ValueError, "sample 0 is not finite"),
        (lambda: mechanize(START, [0.01, -0.01], [[0, 0, 0]] * 2, [[0, 0, 0]] * 2), ValueError, "sample 1 is -0.01 s"),
        (lambda: mechanize(START, 0.01, [[0, 0, 0]], [[0, 0, 0]], scheme="rk4"), ValueError, "coning, matrix"),
        (lambda: mechanize(START, 0.01, [[0, 0, 0]], [[0, 0, 0]], gyro_bias=[1, 2]), ValueError, "gyro_bias"),
        (
            lambda: mechanize(NavigationState(1.5695, 0.0, 0.0), 0.01, [[0, 0, 0]], [[0, 0, 0]]),
            EstimationError,
            "pole",
        ),
        (
            lambda: mechanize(
                NavigationState.from_euler(0.9, 0, 0, pitch=np.pi / 2), 0.01, [[0, 0, 0]], [[0, 0, 0]], scheme="euler"
            ),
            EstimationError,
            "vertical",
        ),
        (lambda: NavigationState(50.0, 30.0, 0.0), ValueError, "radians"),
        (lambda: NavigationState(0.5, np.nan, 0.0), ValueError, "not finite"),
        (lambda: NavigationState(0.5, 0.0, 0.0, np.zeros(2)), ValueError, "velocity_n"),
        (lambda: NavigationState(0.5, 0.0, 0.0, np.zeros(3), np.ones(4)), ValueError, "length 2"),
    ],
)
def test_refusals_say_why(call, error, words):
    with pytest.raises(error, match=words):
        call()


def test_inputs_are_left_alone():
    w, f = np.zeros((5, 3)), np.full((5, 3), -9.8)
    w.flags.writeable = f.flags.writeable = False
    mechanize(START, 0.01, w, f, gyro_bias=[1e-3, 0, 0])
    assert w.sum() == 0.0
    with pytest.raises(ValueError, match="read-only"):
        START.velocity_n[0] = 1.0
