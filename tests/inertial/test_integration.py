"""The aided filter and its smoother know how wrong they are; what was unknown is found; architectures rank as they must."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from railnav.attitude import dcm_from_rotation_vector, rotation_vector_from_dcm
from railnav.errors import EstimationError
from railnav.inertial.aided.aiding import Fixes, Rests, VehicleMotion, find_rests, without_lever_arm
from railnav.inertial.aided.integration import integrate
from railnav.inertial.aided.unknowns import Unknowns, Vehicle
from railnav.inertial.error_model import position_scale
from railnav.inertial.imu_noise import ImuNoise, InitialSigma
from railnav.inertial.mechanization import GravityField, NavigationState
from railnav.simulation.road import road_drive

DEGREE = np.pi / 180
H = 0.02
FIELD = GravityField(free_air="linear")  # as the simulator
NOISE = ImuNoise(0.3 * DEGREE / 60, 0.1 / 60, 20 * DEGREE / 3600, 2e-3, 200.0, 200.0)
INITIAL = InitialSigma(np.full(3, 1.0), np.full(3, 0.1), np.array([0.3, 0.3, 1.0]) * DEGREE, 60 * DEGREE / 3600, 0.02)
UNKNOWN = Unknowns(
    gyro_scale=3e-3,
    accelerometer_scale=3e-3,
    antenna_arm=0.3,
    axle_arm=0.5,
    mounting=0.02,
    time_offset=0.02,
    odometer_scale=0.01,
)


@pytest.fixture(scope="module")
def drive():
    return road_drive("city", 120.0, interval=H)


def trial(drive, seed, *, odometer=True, without=(), fixes_until=np.inf, **options):
    """One drive with everything that the filter assumes drawn as it assumes it; the solution and the true parameters."""
    rng = np.random.default_rng(seed)
    count = len(drive.rate_ib_b)

    def slow(sigma, tau, first):
        keep, x, path = np.exp(-H / tau), rng.normal(0, first, 3), np.empty((count, 3))
        for i in range(count):
            path[i] = x
            x = keep * x + sigma * np.sqrt(1 - keep**2) * rng.normal(size=3)
        return path

    true = {
        "gyro_bias": slow(NOISE.gyro_instability, 200.0, INITIAL.gyro_bias),
        "accelerometer_bias": slow(NOISE.accelerometer_instability, 200.0, INITIAL.accelerometer_bias),
        "gyro_scale": rng.normal(0, UNKNOWN.gyro_scale, 3),
        "accelerometer_scale": rng.normal(0, UNKNOWN.accelerometer_scale, 3),
        "antenna_arm": rng.normal(0, UNKNOWN.antenna_arm, 3),
        "axle_arm": rng.normal(0, UNKNOWN.axle_arm, 3),
        "mounting": rng.normal(0, UNKNOWN.mounting, 2),
        "time_offset": rng.normal(0, UNKNOWN.time_offset, 1),
        "odometer_scale": rng.normal(0, UNKNOWN.odometer_scale, 1),
    }
    axle = np.array([-1.0, 0.0, 1.5]) + true["axle_arm"]
    antenna = np.array([0.5, -0.3, -1.0]) + true["antenna_arm"]
    # the drive is of the axle in the vehicle's axes; the IMU sits elsewhere and askew
    turn = dcm_from_rotation_vector(np.array([0.0, *true["mounting"]]))  # body axes of the IMU -> vehicle
    attitude = drive.attitude_nb @ turn
    t = drive.time
    rate_v = np.vstack([drive.rate_ib_b[:1], 0.5 * (drive.rate_ib_b[1:] + drive.rate_ib_b[:-1]), drive.rate_ib_b[-1:]])
    scale = position_scale(NavigationState(drive.latitude[0], drive.longitude[0], drive.height[0]))
    offset = -np.einsum("kij,j->ki", attitude, axle)
    latitude, longitude = drive.latitude + offset[:, 0] / scale[0], drive.longitude + offset[:, 1] / scale[1]
    height = drive.height - offset[:, 2]
    velocity = np.gradient(offset, H, axis=0) + drive.velocity_n
    from railnav.simulation.inertial import interval_means

    w, f = interval_means(t, latitude, height, velocity, attitude)
    whirl = np.einsum("kij,kj->ki", attitude, np.cross(rate_v @ turn, antenna))
    lever = np.einsum("kij,j->ki", attitude, antenna)
    w = w * (1 + true["gyro_scale"]) + true["gyro_bias"] + rng.normal(0, NOISE.angle_random_walk / np.sqrt(H), w.shape)
    f = f * (1 + true["accelerometer_scale"]) + true["accelerometer_bias"]
    f = f + rng.normal(0, NOISE.velocity_random_walk / np.sqrt(H), f.shape)

    def at(column, when):
        return np.stack([np.interp(when, t, c) for c in column.T], axis=1)

    stamp = np.arange(0.5, t[-1] - 0.3, 0.25)
    when = stamp + true["time_offset"]
    place = np.column_stack([latitude, longitude, height])
    R_p, R_v = np.array([0.3, 0.3, 0.6]), np.array([0.05, 0.05, 0.08])
    position = at(place, when) + (at(lever, when) * [1, 1, -1] + rng.normal(0, R_p, (len(stamp), 3))) / scale
    moving = at(velocity, when) + at(whirl, when) + rng.normal(0, R_v, (len(stamp), 3))
    keep = stamp < fixes_until
    fixes = Fixes(stamp[keep], position[keep], R_p, moving[keep], R_v)
    ticks = np.arange(5, count, 5)
    forward = (1 + true["odometer_scale"]) * drive.speed[ticks] + rng.normal(0, 0.03, len(ticks))
    # the constraint is not exact: the vehicle slides a little
    motion = VehicleMotion(t[ticks], forward if odometer else None, 0.03 if odometer else np.inf, 0.05, 0.05)
    start = NavigationState.from_dcm(
        *(place[0] + rng.normal(0, INITIAL.position) / scale),
        velocity_n=velocity[0] + rng.normal(0, INITIAL.velocity),
        C_nb=dcm_from_rotation_vector(rng.normal(0, INITIAL.attitude)) @ attitude[0],
    )
    got = integrate(
        start,
        INITIAL,
        t[1:],
        w,
        f,
        NOISE,
        start_time=0.0,
        **{
            "fixes": fixes,
            "vehicle_motion": motion,
            "vehicle": Vehicle((0.5, -0.3, -1.0), (-1.0, 0.0, 1.5)),
            "unknowns": UNKNOWN,
        }
        | {"gravity": FIELD}
        | dict.fromkeys(without)
        | options,
    )
    tr = got.trajectory
    error = np.hstack(
        [
            np.stack([tr.latitude - latitude, tr.longitude - longitude, tr.height - height], axis=1) * scale,
            tr.velocity_n - velocity,
            rotation_vector_from_dcm(attitude @ np.swapaxes(tr.C_nb, 1, 2)),
        ]
    )
    return got, error, true, scale


def whole_error(got, error, true, scale, names):
    parts = [
        np.broadcast_to(true[n], got.parameters[n].shape)[-1]
        if n not in ("gyro_bias", "accelerometer_bias")
        else true[n][-1]
        for n in names
    ]
    x = np.concatenate([p - got.parameters[n][-1] for n, p in zip(names, parts, strict=True)])
    return np.concatenate([x, error[-1, 6:], error[-1, 3:6], error[-1, :3] / scale])


NAMES = (
    "antenna_arm",
    "axle_arm",
    "mounting",
    "time_offset",
    "odometer_scale",
    "gyro_scale",
    "accelerometer_scale",
    "gyro_bias",
    "accelerometer_bias",
)


@pytest.mark.slow
def test_the_full_filter_and_smoother_know_how_wrong_they_are(drive):
    nees, nis, past = [], {"fixes": [], "vehicle": []}, []
    for seed in range(20):
        got, error, true, scale = trial(drive, seed, smooth=True)
        past.append((error[100:-100:250] / got.sigma[100:-100:250]) ** 2)
        got, error, true, scale = trial(drive, seed)
        x = np.linalg.solve(got.P_sqrt, whole_error(got, error, true, scale, NAMES))
        nees.append(x @ x)
        for name, values in nis.items():
            values.append(np.nanmean(got.nis[name]))
    low, high = chi2.ppf([0.0005, 0.9995], 30 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high
    assert np.mean(nis["fixes"]) == pytest.approx(1.0, abs=0.03)
    assert 0.75 < np.mean(past) < 1.25


def test_smoothing_gains_and_stays_honest(drive):
    filtered, before, *_ = trial(drive, 3)
    smoothed, after, *_ = trial(drive, 3, smooth=True)
    inside = slice(500, -500)
    assert np.sqrt((after[inside, :2] ** 2).mean()) < 0.8 * np.sqrt((before[inside, :2] ** 2).mean())
    assert np.all(smoothed.sigma[inside, :2] < 1.05 * filtered.sigma[inside, :2])
    assert 0.3 < ((after[inside] / smoothed.sigma[inside]) ** 2).mean() < 2.5
    # the last instant knows nothing more
    np.testing.assert_allclose(smoothed.trajectory.latitude[-1], filtered.trajectory.latitude[-1], rtol=0, atol=1e-15)


def test_arms_mounting_and_time_offset_are_found(drive):
    got, _, true, _ = trial(drive, 5)
    for name in ("antenna_arm", "axle_arm", "mounting", "time_offset", "odometer_scale"):
        miss, sigma = got.parameters[name][-1] - true[name], got.parameter_sigma[name][-1]
        assert np.all(np.abs(miss) < 4 * sigma), name
    assert got.parameter_sigma["time_offset"][-1, 0] < 5e-3
    assert got.parameter_sigma["mounting"][-1, 1] < 2e-3
    assert got.parameter_sigma["antenna_arm"][-1, :2].max() < 0.1


def test_a_time_offset_left_out_is_unmasked(drive):
    right, *_ = trial(drive, 5)
    wrong, *_ = trial(drive, 5, unknowns=Unknowns(), gate=1e9)
    assert np.nanmean(right.nis["fixes"]) < 1.2 < np.nanmean(wrong.nis["fixes"])


def test_wheels_bridge_an_outage(drive):
    """A minute without GNSS: the IMU alone, the constraint, the odometer."""
    largest = {}
    for name, options in (
        ("alone", {"without": ("vehicle_motion",)}),
        ("constraint", {"odometer": False}),
        ("odometer", {}),
    ):
        worst = []
        for seed in (1, 2, 3):
            _, error, *_ = trial(drive, seed, fixes_until=60.0, **options)
            worst.append(np.hypot(error[3000:, 0], error[3000:, 1]).max())
        largest[name] = np.mean(worst)
    assert largest["odometer"] < 5.0
    assert largest["odometer"] < 0.5 * largest["constraint"] < 0.25 * largest["alone"]


def test_the_open_loop_gives_the_same_while_errors_are_small_only():
    drive = road_drive("road", 60.0, interval=H)
    scale = position_scale(NavigationState(drive.latitude[0], drive.longitude[0], drive.height[0]))
    rng = np.random.default_rng(1)
    k = np.arange(10, len(drive.time), 10)
    place = (
        np.column_stack([drive.latitude, drive.longitude, drive.height])[k] + rng.normal(0, 1.0, (len(k), 3)) / scale
    )
    fixes = Fixes(drive.time[k], place, [1.0] * 3, drive.velocity_n[k] + rng.normal(0, 0.1, (len(k), 3)), [0.1] * 3)
    apart = []
    for bias in (1e-5, 5e-3):
        ends = []
        for closed in (True, False):
            start = NavigationState.from_dcm(*place[0], velocity_n=drive.velocity_n[0], C_nb=drive.attitude_nb[0])
            initial = InitialSigma(np.full(3, 1.0), np.full(3, 0.1), np.full(3, 0.01), max(bias, 1e-5), 0.01)
            got = integrate(
                start,
                initial,
                drive.time[1:],
                drive.rate_ib_b + bias,
                drive.specific_force_b,
                NOISE,
                start_time=0.0,
                fixes=fixes,
                closed_loop=closed,
                gravity=FIELD,
                gate=1e9,
            )
            ends.append(drive.error(got.trajectory.latitude, got.trajectory.longitude))
        apart.append(np.abs(ends[0] - ends[1])[500:].max())
    assert apart[0] < 0.05
    assert apart[1] > 3 * apart[0]


def test_rests_are_found_by_quiet(drive):
    rng = np.random.default_rng(0)
    w, f = drive.rate_ib_b, drive.specific_force_b
    shaken = (drive.speed[1:] > 0.05)[:, None] * 0.2
    f = f + rng.normal(0, 0.01, f.shape) + shaken * rng.normal(size=f.shape)
    rests = find_rests(drive.time[1:], w + 0.01 + rng.normal(0, 1e-3, w.shape), f)
    assert len(rests.time) > 20
    assert np.interp(rests.time, drive.time, drive.speed).max() < 0.05
    np.testing.assert_allclose(rests.rate_ib_b.mean(axis=0), 0.01, atol=3e-4)
    # a log that never moves, or never rests, gives none
    assert len(find_rests(drive.time[1:], rng.normal(0, 1e-3, w.shape), rng.normal(0, 0.01, f.shape)).time) == 0


def test_a_rest_stops_the_drift():
    t = np.arange(1, 3001) * H
    state = NavigationState(0.85, 0.3, 100.0)
    w = np.tile([7.292115e-5 * np.cos(0.85), 0.0, -7.292115e-5 * np.sin(0.85)], (len(t), 1)) + 5e-4
    f = np.tile(-FIELD.vector(0.85, 100.0), (len(t), 1)) + 0.02
    initial = InitialSigma(np.full(3, 0.1), np.full(3, 0.01), np.full(3, 0.01), 1e-3, 0.03)
    rests = Rests(t[::10], w[::10], 0.01, 1e-5)
    got = integrate(state, initial, t, w, f, NOISE, start_time=0.0, rests=rests, gravity=FIELD)
    alone = integrate(state, initial, t, w, f, NOISE, start_time=0.0, gravity=FIELD)
    assert np.abs(got.trajectory.velocity_n[-1]).max() < 0.01
    assert np.abs(alone.trajectory.velocity_n[-1]).max() > 5.0
    np.testing.assert_allclose(got.parameters["gyro_bias"][-1], 5e-4, atol=3e-5)


def test_too_long_a_log_for_the_smoother_is_refused():
    start = NavigationState(0.85, 0.3, 150.0)
    t = np.arange(1, 700_001) * 0.05
    zero = np.zeros((len(t), 3))
    with pytest.raises(EstimationError, match="in pieces"):
        integrate(start, INITIAL, t, zero, zero, NOISE, start_time=0.0, smooth=True, unknowns=UNKNOWN)


def test_the_arm_between_antenna_and_imu():
    state = NavigationState.from_euler(0.85, 0.0, 100.0, heading=np.pi / 2)
    moved = without_lever_arm(state, [2.0, 0.0, 0.0])
    assert (moved.longitude - state.longitude) * position_scale(state)[1] == pytest.approx(2.0)
    assert moved.latitude == pytest.approx(state.latitude, abs=1e-15)
