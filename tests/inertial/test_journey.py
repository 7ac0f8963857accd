"""A12: the chain of attitude, position, heading on great circles and speed, and its checks."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.attitude import dcm_from_euler, rotation_vector_from_dcm
from railnav.errors import EstimationError
from railnav.geodesy.ellipsoid import WGS84
from railnav.inertial import EARTH_RATE
from railnav.inertial.great_circle import SPHERE_RADIUS
from railnav.inertial.journey import autonomous_journey

DEGREE = np.pi / 180


def frame(latitude: np.ndarray, longitude: np.ndarray, t: np.ndarray) -> np.ndarray:
    """C_in of north-east-down axes on a turning Earth."""
    s = longitude + EARTH_RATE * t
    sp, cp, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(s), np.cos(s)
    z = np.zeros_like(sp)
    return np.moveaxis(np.array([[-sp * cl, -sl, -cp * cl], [-sp * sl, cl, -cp * sl], [cp, z, -sp]]), (0, 1), (-2, -1))


def ride(latitude: np.ndarray, longitude: np.ndarray, t: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Mean rates of a body over the intervals, as rotation vectors."""
    C = frame(latitude, longitude, t) @ dcm_from_euler(*angles.T)
    return rotation_vector_from_dcm(np.swapaxes(C[:-1], 1, 2) @ C[1:]) / np.diff(t)[:, None]


def great_circle(t: np.ndarray, speed: float, latitude: float, heading: float) -> tuple[np.ndarray, ...]:
    arc = speed * t / SPHERE_RADIUS
    lat = np.arcsin(np.sin(latitude) * np.cos(arc) + np.cos(latitude) * np.sin(arc) * np.cos(heading))
    lon = np.arctan2(np.sin(heading) * np.sin(arc) * np.cos(latitude), np.cos(arc) - np.sin(latitude) * np.sin(lat))
    course = np.arctan2(
        np.sin(heading) * np.cos(latitude),
        np.cos(latitude) * np.cos(arc) * np.cos(heading) - np.sin(latitude) * np.sin(arc),
    )
    return lat, lon, course


def wobble(t: np.ndarray) -> np.ndarray:
    return np.column_stack([0.2 * np.sin(0.07 * t), 0.1 * np.sin(0.11 * t), 0.7 + 0.3 * np.sin(0.02 * t)])


def test_a_great_circle_is_followed_and_its_parts_agree() -> None:
    t = np.arange(0.0, 3600.0, 1.0)
    lat, lon, course = great_circle(t, 200.0, 50 * DEGREE, 60 * DEGREE)
    angles = wobble(t)
    got = autonomous_journey(
        t,
        ride(lat, lon, t, angles),
        angles,
        0.0,
        legs=[(10.0, 3500.0)],
        latitude_sigma=1e-6,
        course_sigma=1e-5,
        ellipsoid=None,
    )
    middle = great_circle(got.time, 200.0, 50 * DEGREE, 60 * DEGREE)
    assert np.abs(got.latitude - middle[0]).max() < 3e-9  # second order in the step of one second
    assert np.abs(got.longitude - middle[1]).max() < 3e-8
    inner = slice(2, -2)
    assert np.abs(got.speed[inner] - 200.0).max() < 0.02
    assert np.abs(got.course[inner] - middle[2][inner]).max() < 1e-4
    (leg,) = got.legs
    assert abs(leg.mismatch) < 1e-4
    assert leg.course == pytest.approx(middle[2][np.argmin(np.abs(got.time - leg.end))], abs=1e-4)
    assert 1e-6 < leg.sigma < 1e-4
    assert course.shape == t.shape


def test_velocity_on_the_ellipsoid() -> None:
    t = np.arange(0.0, 600.0, 0.5)
    lat = 50 * DEGREE + 1e-5 * t
    lon = 30 * DEGREE + 2e-5 * t
    got = autonomous_journey(t, ride(lat, lon, t, wobble(t)), wobble(t), 30 * DEGREE)
    phi = np.interp(got.time, t, lat)
    np.testing.assert_allclose(got.velocity_north[1:-1], WGS84.meridian_radius(phi)[1:-1] * 1e-5, rtol=1e-5)
    np.testing.assert_allclose(got.velocity_east, WGS84.transverse_radius(phi) * np.cos(phi) * 2e-5, rtol=1e-4)


def test_a_halt_bounds_the_drift() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 600.0, 0.1)
    angles = np.tile([0.02, -0.01, 0.8], (len(t), 1))
    lat = np.full(len(t), 48.0 * DEGREE)
    w = ride(lat, 0.0 * t, t, angles) + rng.normal(0.0, 2e-6, (len(t) - 1, 3))
    force = np.broadcast_to(dcm_from_euler(*angles[0]).T @ [0.0, 0.0, -9.81], w.shape)
    wrong = angles + np.array([0.0, 2e-4, 0.0])  # pitch of the attitude source drifted
    got = autonomous_journey(t, w, wrong, 0.0, specific_force_b=force, halts=[(0.0, 600.0)])
    (halt,) = got.halts
    assert abs(halt.latitude - 48.0 * DEGREE) < 4.0 * halt.sigma
    # a minute of pitch is a minute of latitude along the nose
    assert abs(halt.drift) == pytest.approx(2e-4 * np.cos(0.8), abs=4.0 * halt.sigma)


def test_flying_west_with_the_earth_is_lost_and_stays_lost() -> None:
    t = np.arange(0.0, 100.0, 1.0)
    speed = np.where(t < 50, -0.5 * EARTH_RATE, -1.0 * EARTH_RATE)
    lon = np.concatenate([[0.0], np.cumsum(speed[:-1])])
    lat = np.full(len(t), 0.9)
    got = autonomous_journey(t, ride(lat, lon, t, np.zeros((100, 3))), np.zeros((100, 3)), 0.0)
    assert np.isfinite(got.longitude[:49]).all()
    assert np.isnan(got.longitude[51:]).all()


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"time": np.array([0.0, 2.0, 1.0])}, ValueError, "does not increase at sample 2"),
        ({"rate_ib_b": np.zeros((3, 3))}, ValueError, "needs times"),
        ({"attitude": np.full((3, 3), np.nan)}, ValueError, "not finite"),
        ({"smoothing": 0}, ValueError, "at least 1"),
        ({"legs": [(10.0, 20.0)]}, EstimationError, "the leg from 10 to 20 s has no samples"),
        ({"halts": [(0.0, 2.0)]}, ValueError, "halts need the specific force"),
    ],
)
def test_refusals_say_why(change, error, words) -> None:
    still = EARTH_RATE * np.array([[0.6, 0.0, -0.8]] * 2)
    call = {"time": np.arange(3.0), "rate_ib_b": still, "attitude": np.zeros((3, 3)), "start_longitude": 0.0} | change
    with pytest.raises(error, match=words):
        autonomous_journey(**call)
