"""The simulated IMU against an independent strapdown integration and the closed forms of the specification."""

from __future__ import annotations

import math

import numpy as np
import pytest

from railnav.geodesy.ellipsoid import WGS84
from railnav.simulation import ImuSensor, Leg, Outfit, Stop, simulate
from railnav.simulation.inertial import (
    EARTH_RATE,
    attitude_matrix,
    interval_means,
    rotation_matrix,
    rotation_vector,
)
from railnav.units import cant_angle, wrap_angle

IDEAL = ImuSensor(
    mounting_sigma=0.0,
    gyro_white=0.0,
    accelerometer_white=0.0,
    gyro_bias=0.0,
    accelerometer_bias=0.0,
    gyro_bias_walk=0.0,
    accelerometer_bias_walk=0.0,
    gyro_scale=0.0,
    accelerometer_scale=0.0,
)


def strapdown(imu, truth, roll, pitch):
    """Plain integration in north-east-down, written for this test: rotation vectors, mid-step attitude, trapezoid."""
    rotations = rotation_matrix(imu.gyro * np.diff(imu.time, prepend=0.0)[:, None])
    halves = rotation_matrix(0.5 * imu.gyro * np.diff(imu.time, prepend=0.0)[:, None])
    # slowly varying: radii and gravity where the train is
    meridian = WGS84.meridian_radius(truth.latitude) + truth.height
    transverse = WGS84.transverse_radius(truth.latitude) + truth.height
    gravity = WGS84.normal_gravity(truth.latitude, truth.height)
    latitude, longitude, height = truth.latitude[0], truth.longitude[0], truth.height[0]
    c = attitude_matrix(*np.array([[roll], [pitch], [truth.heading[0]]]))[0]
    v, before = np.zeros(3), np.zeros(3)
    time = np.append(0.0, imu.time)
    out = np.empty((len(imu.time), 3))
    for k in range(len(imu.time)):
        dt = time[k + 1] - time[k]
        m, n, sine, cosine = meridian[k], transverse[k], math.sin(latitude), math.cos(latitude)
        ahead = 1.5 * v - 0.5 * before  # speed in the middle of the step
        en = ahead[1] / n, -ahead[0] / m, -ahead[1] * sine / cosine / n
        x, y, z = EARTH_RATE * cosine + en[0], en[1], en[2] - EARTH_RATE * sine
        still = np.array([[1.0, z * dt, -y * dt], [-z * dt, 1.0, x * dt], [y * dt, -x * dt, 1.0]])  # exp(-w dt)
        still_half = 0.5 * (np.eye(3) + still)
        force = still_half @ c @ halves[k] @ imu.specific_force[k]
        p, q, r = x + EARTH_RATE * cosine, y, z - EARTH_RATE * sine
        coriolis = np.array([q * ahead[2] - r * ahead[1], r * ahead[0] - p * ahead[2], p * ahead[1] - q * ahead[0]])
        new = v + (force - coriolis) * dt
        new[2] += 0.5 * (gravity[k] + gravity[k + 1]) * dt
        mean = 0.5 * (v + new)
        latitude += mean[0] / m * dt
        longitude += mean[1] / (n * cosine) * dt
        height -= mean[2] * dt
        before, v = v, new
        c = still @ c @ rotations[k]
        out[k] = latitude, longitude, height
    return out, c


@pytest.fixture(scope="module")
def ride(line):
    """Two and a half kilometres with a canted curve, a climb, a stop and a crossover."""
    leg = Leg(
        ("77R-01", "77X-01", "77L-02", "77L-03"),
        start=300.0,
        finish=1900.0,
        stops=(Stop("77X-01", 30.0, 10.0),),
        dwell=5.0,
    )
    return simulate(line, leg, seed=1, outfit=Outfit("imu", imu=IDEAL), truth_interval=0.01)


def test_integrating_the_imu_gives_the_motion_back(line, ride):
    run, truth = ride
    points = line.at(truth.track[0], truth.offset[0])
    out, c = strapdown(run.imu, truth, float(cant_angle(points.cant)), math.atan(float(points.gradient)))
    north = (out[:, 0] - truth.latitude[1:]) * WGS84.meridian_radius(truth.latitude[1:])
    east = (out[:, 1] - truth.longitude[1:]) * WGS84.transverse_radius(truth.latitude[1:]) * np.cos(truth.latitude[1:])
    up = out[:, 2] - truth.height[1:]
    assert truth.time[-1] > 180.0
    assert np.abs(north).max() < 1e-3  # four minutes of free double integration
    assert np.abs(east).max() < 1e-3
    assert np.abs(up).max() < 1e-3
    assert abs(float(wrap_angle(math.atan2(c[1, 0], c[0, 0]) - truth.heading[-1]))) < 1e-7


def test_it_does_so_against_growing_offset_too(line):
    leg = Leg(("77R-03",), start=2100.0, finish=1500.0, dwell=1.0)
    run, truth = simulate(line, leg, seed=1, outfit=Outfit("imu", imu=IDEAL), truth_interval=0.01)
    points = line.at("77R-03", 2100.0)
    assert float(points.gradient) > 5e-3
    out, _ = strapdown(run.imu, truth, -float(cant_angle(points.cant)), -math.atan(float(points.gradient)))
    assert np.abs(out[:, 2] - truth.height[1:]).max() < 1e-3
    assert np.abs(out[:, 0] - truth.latitude[1:]).max() * 6.4e6 < 1e-3
    assert truth.height[-1] < truth.height[0] - 3.0


def test_at_rest_it_feels_gravity_and_the_earth(line, ride):
    run, truth = ride
    rest = run.imu.time < 15.0
    force, rate = run.imu.specific_force[rest].mean(axis=0), run.imu.gyro[rest].mean(axis=0)
    gravity = float(WGS84.normal_gravity(truth.latitude[0], truth.height[0]))
    points = line.at(truth.track[0], truth.offset[0])
    slope = math.atan(float(points.gradient))
    np.testing.assert_allclose(force, [gravity * math.sin(slope), 0.0, -gravity * math.cos(slope)], atol=1e-9)
    assert force[2] == pytest.approx(-9.81, abs=0.01)
    assert np.linalg.norm(rate) == pytest.approx(EARTH_RATE, rel=1e-9)
    assert rate[2] == pytest.approx(-EARTH_RATE * math.sin(truth.latitude[0]), rel=1e-2)


def test_body_forces_of_the_specification():
    """TV13: v=22, k=1/700, grade 6 mrad, vertical curvature 2e-6, cant angle 0.07, g=9.81, no Earth rate; house signs."""
    v, k, alpha, kv, phi = 22.0, 1 / 700.0, 0.006, 2e-6, 0.07
    latitude, dt = 0.9, 0.01
    s = v * np.array([-0.5 * dt, 0.5 * dt])
    heading, pitch = 0.4 + k * s, alpha + kv * s
    velocity = v * np.stack([np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), -np.sin(pitch)], axis=-1)
    attitude = attitude_matrix(np.full(2, phi), pitch, heading)
    rate, force = interval_means(np.array([0.0, dt]), np.full(2, latitude), np.zeros(2), velocity, attitude)
    # take away what the specification leaves out: Earth rate, transport, Coriolis, and normal gravity for 9.81
    c = attitude_matrix(np.array([phi]), np.array([alpha]), np.array([0.4]))[0]
    mean = velocity.mean(axis=0)
    m, n = float(WGS84.meridian_radius(latitude)), float(WGS84.transverse_radius(latitude))
    ie = EARTH_RATE * np.array([math.cos(latitude), 0.0, -math.sin(latitude)])
    en = np.array([mean[1] / n, -mean[0] / m, -mean[1] * math.tan(latitude) / n])
    rate = rate[0] - c.T @ (ie + en)
    extra = np.cross(2 * ie + en, mean) + np.array([0.0, 0.0, 9.81 - float(WGS84.normal_gravity(latitude))])
    force = force[0] - c.T @ extra
    assert rate[2] == pytest.approx(0.031347961, abs=1e-8)
    # forward, right, down: the specification's up is the house's minus down
    np.testing.assert_allclose(force, [0.058859647, 0.003528161, -9.835124407], atol=2e-7)


def test_energy_of_the_specific_force(line, ride):
    """From rest to rest, the work of the specific force along the track is the gain of potential energy."""
    run, truth = ride
    speed = 0.5 * (truth.speed[1:] + truth.speed[:-1])
    work = float((run.imu.specific_force[:, 0] * speed).sum() * 0.01)
    gravity = float(WGS84.normal_gravity(truth.latitude[0], truth.height[0]))
    assert work == pytest.approx(gravity * (truth.height[-1] - truth.height[0]), abs=0.02)


def test_running_back_mirrors_the_imu(line):
    """The same metres run the other way: yaw rate, lateral force and pitch change sign, gravity stays."""
    outfit = Outfit("imu", imu=IDEAL)
    there, _ = simulate(line, Leg(("77R-03",), start=600.0, finish=2400.0), seed=1, outfit=outfit)
    back, _ = simulate(line, Leg(("77R-03",), start=2400.0, finish=600.0), seed=1, outfit=outfit)
    shift = len(there.imu) - len(back.imu)
    assert abs(shift) < 3
    standing = int(10.0 / 0.01)  # dwell 30 s after, 20 s before
    forward = there.imu.gyro[:-standing, 2]
    reverse = back.imu.gyro[:-standing, 2][::-1]
    n = min(len(forward), len(reverse))
    earth = -2 * EARTH_RATE * math.sin(math.radians(50.6))
    assert np.abs(forward[:n] + reverse[:n] - earth).max() < 4e-4
    lateral = there.imu.specific_force[:-standing, 1][:n] + back.imu.specific_force[:-standing, 1][::-1][:n]
    assert np.abs(lateral).max() < 0.02
    assert np.abs(there.imu.specific_force[:, 1]).max() > 0.3


def test_lever_arm_feels_the_turn(line):
    leg = Leg(("77R-03",), start=600.0, finish=2400.0)
    centre, truth = simulate(line, leg, seed=1, outfit=Outfit("imu", imu=IDEAL), truth_interval=0.01)
    arm = ImuSensor(
        **{
            **{f: getattr(IDEAL, f) for f in IDEAL.__dataclass_fields__},
            "lever_arm_b": (0.0, -2.0, 0.0),
        }
    )
    left, _ = simulate(line, leg, seed=1, outfit=Outfit("imu", imu=arm))
    np.testing.assert_allclose(left.imu.gyro, centre.imu.gyro, atol=1e-7)  # the transport rate alone differs
    extra = left.imu.specific_force - centre.imu.specific_force
    yaw = centre.imu.gyro[:, 2] + EARTH_RATE * math.sin(truth.latitude[0])
    steady = np.abs(np.gradient(yaw)) < 1e-7
    # two metres to the left of the centre: centripetal acceleration -(-2) w^2 towards the right
    np.testing.assert_allclose(extra[steady, 1], 2.0 * yaw[steady] ** 2, atol=2e-4)
    assert extra[steady, 1].max() > 1e-3


def test_errors_have_the_stated_size(line):
    sensor = ImuSensor(gyro_bias_walk=0.0, accelerometer_bias_walk=0.0)
    leg = Leg(("77R-01",), start=100.0, finish=101.0, dwell=400.0)
    clean, _ = simulate(line, leg, seed=6, outfit=Outfit("i", imu=IDEAL))
    noisy, _ = simulate(line, leg, seed=6, outfit=Outfit("i", imu=sensor))
    late = clean.imu.time > 60.0
    error = (noisy.imu.gyro - clean.imu.gyro)[late]
    np.testing.assert_allclose(error.std(axis=0), sensor.gyro_white / 0.1, rtol=0.02)
    error = (noisy.imu.specific_force - clean.imu.specific_force)[late]
    np.testing.assert_allclose(error.std(axis=0), sensor.accelerometer_white / 0.1, rtol=0.02)
    ensemble = np.array(
        [
            simulate(
                line, Leg(("77R-01",), start=100.0, finish=101.0, dwell=1.0), seed=s, outfit=Outfit("i", imu=sensor)
            )[0].imu.gyro.mean(axis=0)
            for s in range(60)
        ]
    )
    assert ensemble.std() == pytest.approx(sensor.gyro_bias, rel=0.25)  # 180 values


def test_bias_walk_grows_with_the_root_of_time(line):
    sensor = ImuSensor(
        **{**{f: getattr(IDEAL, f) for f in IDEAL.__dataclass_fields__}, "gyro_bias_walk": 1e-4, "interval": 0.1}
    )
    leg = Leg(("77R-01",), start=100.0, finish=101.0, dwell=100.0)
    ends = np.array(
        [simulate(line, leg, seed=s, outfit=Outfit("i", imu=sensor))[0].imu.gyro[[0, 400, -1]] for s in range(80)]
    )
    run, _ = simulate(line, leg, seed=0, outfit=Outfit("i", imu=sensor))
    for row, index in ((1, 400), (2, -1)):
        spread = (ends[:, row] - ends[:, 0]).std()
        assert spread == pytest.approx(1e-4 * math.sqrt(run.imu.time[index] - run.imu.time[0]), rel=0.2)


def test_mounting_turns_the_axes(line):
    angles = (0.02, -0.01, 0.3)
    leg = Leg(("77R-03",), start=600.0, finish=1200.0)
    straight, _ = simulate(line, leg, seed=1, outfit=Outfit("i", imu=IDEAL))
    sensor = ImuSensor(**{**{f: getattr(IDEAL, f) for f in IDEAL.__dataclass_fields__}, "mounting": angles})
    turned, _ = simulate(line, leg, seed=1, outfit=Outfit("i", imu=sensor))
    r, p, y = angles
    rx = np.array([[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]])
    ry = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
    rz = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]])
    expected = straight.imu.specific_force @ (rz @ ry @ rx)  # rows of (Rz Ry Rx)^T v
    np.testing.assert_allclose(turned.imu.specific_force, expected, atol=1e-12)
    np.testing.assert_allclose(turned.imu.mounting, angles)


def test_rotation_vector_round_trip():
    generator = np.random.default_rng(2)
    vectors = generator.standard_normal((50, 3)) * 0.3
    vectors[0] = 0.0
    np.testing.assert_allclose(rotation_vector(rotation_matrix(vectors)), vectors, atol=1e-12)


def test_an_independent_simulator_agrees(shared_data):
    """The IMU of sample_run, made elsewhere: the same motion gives its six signals, up to noise, bias and scale."""
    from railnav.io.geojson import read_geojson
    from railnav.io.run import read_run
    from railnav.io.truth import read_truth

    folder = shared_data / "sample_run"
    if not folder.is_dir():
        pytest.skip("sample_run is not among the real data")
    truth, model, imu = read_truth(folder / "truth.csv"), read_geojson(folder / "network.geojson"), read_run(folder).imu
    track = np.array([model.track_index(t) for t in truth.track_id])[truth.track]
    points = model.at(track, np.clip(truth.offset, 0.0, model.lengths[track]))
    sense = np.where(np.cos(points.heading - truth.heading) > 0.0, 1.0, -1.0)
    pitch, roll = sense * np.arctan(points.gradient), sense * cant_angle(points.cant)
    heading = points.heading + np.where(sense > 0.0, 0.0, math.pi)
    direction = np.stack([np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), -np.sin(pitch)], axis=-1)
    attitude = attitude_matrix(roll, pitch, heading)
    rate, force = interval_means(truth.time, truth.latitude, truth.height, truth.speed[:, None] * direction, attitude)
    n = len(rate)
    theirs_rate = imu.gyro[: 10 * n].reshape(n, 10, 3).mean(axis=1)
    theirs_force = imu.specific_force[: 10 * n].reshape(n, 10, 3).mean(axis=1)
    for axis, slope_within in ((0, 0.05), (1, 0.1), (2, 0.02)):
        slope, bias = np.polyfit(rate[:, axis], theirs_rate[:, axis], 1)
        assert slope == pytest.approx(1.0, abs=slope_within)
        assert abs(bias) < 1e-3
    for axis, slope_within in ((0, 0.02), (1, 0.02), (2, 0.1)):
        slope, _ = np.polyfit(force[:, axis], theirs_force[:, axis], 1)
        assert slope == pytest.approx(1.0, abs=slope_within)
    assert np.abs((theirs_force - force).mean(axis=0)).max() < 0.08
