"""Sensors without errors tell the truth; with errors, the errors have the statistics they claim."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from railnav.errors import TrackError
from railnav.geodesy.ellipsoid import WGS84
from railnav.simulation import (
    PHONE,
    SERVICE,
    SURVEY,
    GnssSensor,
    Leg,
    OdometerSensor,
    Outfit,
    simulate,
)
from railnav.simulation.inertial import attitude_matrix
from railnav.simulation.sensors import gauss_markov
from railnav.units import cant_angle, wrap_angle

CURVE = Leg(("77R-02", "77R-03"), start=0.0, finish=2600.0)
QUIET = GnssSensor(
    white_horizontal=0.0,
    white_vertical=0.0,
    coloured_horizontal=0.0,
    coloured_vertical=0.0,
    speed_sigma=0.0,
    lever_arm_b=(1.2, -0.7, -3.1),
)
PERFECT_WHEEL = OdometerSensor(scale_error=0.0, roughness=0.0, resolution=0.0)


def local(latitude, longitude, height, latitude0, longitude0, height0):
    """East, north, up of one geodetic position from another, by ECEF."""
    x = np.array(WGS84.to_cartesian(latitude, longitude, height)) - np.array(
        WGS84.to_cartesian(latitude0, longitude0, height0)
    )
    sl, cl, so, co = np.sin(latitude0), np.cos(latitude0), np.sin(longitude0), np.cos(longitude0)
    east = -so * x[0] + co * x[1]
    north = -sl * co * x[0] - sl * so * x[1] + cl * x[2]
    up = cl * co * x[0] + cl * so * x[1] + sl * x[2]
    return east, north, up


def truth_at(truth, time):
    """Rows of a truth at given times, which must be among its own."""
    i = np.round(time / 0.1).astype(int)
    np.testing.assert_allclose(truth.time[i], time, atol=1e-9)
    return i


def test_gnss_without_errors_is_the_antenna(line):
    run, truth = simulate(line, CURVE, seed=5, outfit=Outfit("quiet", gnss=QUIET))
    i = truth_at(truth, run.gnss.time)
    east, north, up = local(
        run.gnss.latitude, run.gnss.longitude, run.gnss.height, truth.latitude[i], truth.longitude[i], truth.height[i]
    )
    points = line.at(truth.track[i], truth.offset[i])
    attitude = attitude_matrix(cant_angle(points.cant), np.arctan(points.gradient), points.heading)
    n, e, d = (attitude @ np.array(QUIET.lever_arm_b)).T
    np.testing.assert_allclose(east, e, atol=2e-5)
    np.testing.assert_allclose(north, n, atol=2e-5)
    np.testing.assert_allclose(up, -d, atol=2e-5)
    # the antenna leans into the curve by about 3.1 m * cant / 1.5 m
    lean = north * np.sin(-points.heading) + east * np.cos(points.heading)
    assert (lean + 0.7)[np.argmax(points.cant)] == pytest.approx(3.1 * points.cant.max() / 1.5, abs=0.01)


def test_gnss_speed_and_course_are_those_of_the_antenna(line):
    run, truth = simulate(line, CURVE, seed=5, outfit=Outfit("quiet", gnss=replace(QUIET, interval=0.1)))
    g = run.gnss
    fast = slice(600, -600)
    east, north, _ = local(
        g.latitude[2:], g.longitude[2:], g.height[2:], g.latitude[:-2], g.longitude[:-2], g.height[:-2]
    )
    difference = np.abs(np.hypot(east, north) / 0.2 - g.speed[1:-1])[fast]
    assert np.quantile(difference, 0.98) < 8e-4  # jerk over 0.2 s
    assert difference.max() < 0.01  # where a cant ramp begins, the antenna's own speed jumps
    turn = np.abs(wrap_angle(np.arctan2(east, north) - g.course[1:-1]))[fast]
    assert np.quantile(turn, 0.98) < 5e-5
    assert turn.max() < 2e-3
    assert np.isnan(g.course[truth.speed[: len(g)] < 0.4]).all()


def test_truth_position_is_the_place_on_the_model(line):
    _, truth = simulate(line, CURVE, seed=1)
    points = line.at(truth.track, truth.offset)
    latitude, longitude, height = line.frame.to_geodetic(points.easting, points.northing, points.height)
    np.testing.assert_allclose(truth.latitude, latitude, atol=1e-14)
    np.testing.assert_allclose(truth.height, height, atol=1e-9)
    np.testing.assert_allclose(truth.longitude, longitude, atol=1e-14)
    np.testing.assert_allclose(wrap_angle(truth.heading - points.heading), 0.0, atol=1e-12)
    assert truth.simulated
    way = np.hypot(np.diff(points.easting), np.diff(points.northing)).sum()
    assert (np.abs(truth.speed[1:] + truth.speed[:-1]) * 0.05).sum() == pytest.approx(way, rel=4e-4)


def test_odometer_without_errors_is_the_offset(line):
    run, truth = simulate(
        line, Leg(("77R-03",), start=100.0, finish=2100.0), seed=2, outfit=Outfit("o", odometer=PERFECT_WHEEL)
    )
    np.testing.assert_allclose(run.odometer.distance, truth.offset - 100.0, atol=1e-6)


def test_odometer_counts_both_ways_unless_signed(line):
    legs = [Leg(("77R-03",), start=100.0, finish=700.0), Leg(("77R-03",), finish=300.0)]
    plain, truth = simulate(line, legs, seed=2, outfit=Outfit("o", odometer=PERFECT_WHEEL))
    signed, _ = simulate(line, legs, seed=2, outfit=Outfit("o", odometer=replace(PERFECT_WHEEL, signed=True)))
    assert truth.offset[-1] == pytest.approx(300.0, abs=1e-6)
    assert plain.odometer.distance[-1] == pytest.approx(1000.0, abs=1e-6)
    assert signed.odometer.distance[-1] == pytest.approx(200.0, abs=1e-6)
    assert signed.odometer.signed
    assert (np.diff(plain.odometer.distance) >= 0.0).all()


def test_odometer_scale_resolution_and_slip(line):
    leg = Leg(("77R-03",), start=0.0, finish=5000.0)
    scaled, _ = simulate(
        line, leg, seed=2, outfit=Outfit("o", odometer=OdometerSensor(scale_error=0.01, roughness=0.0, resolution=0.02))
    )
    assert scaled.odometer.distance[-1] == pytest.approx(5050.0, abs=0.03)
    counts = scaled.odometer.distance / 0.02
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    slipping, _ = simulate(
        line, leg, seed=2, outfit=Outfit("o", odometer=replace(PERFECT_WHEEL, slip_rate=2000.0, slip_size=0.2))
    )
    assert abs(slipping.odometer.distance[-1] - 5000.0) > 2.0
    first = slipping.odometer.distance[slipping.odometer.time < 60.0][-1]
    clean, _ = simulate(line, leg, seed=2, outfit=Outfit("o", odometer=PERFECT_WHEEL))
    assert first > clean.odometer.distance[clean.odometer.time < 60.0][-1]  # spinning under power runs ahead


def test_roughness_grows_with_the_root_of_the_way(line):
    leg = Leg(("77R-03",), start=0.0, finish=2000.0)
    wheel = OdometerSensor(scale_error=0.0, roughness=0.01, resolution=0.0)
    ends = [
        simulate(line, leg, seed=s, outfit=Outfit("o", odometer=wheel))[0].odometer.distance[-1] - 2000.0
        for s in range(60)
    ]
    # sigma = 0.01 sqrt(2000) = 0.447 m; chi-square bounds of 60 values at 1e-4
    assert 0.447 * 0.68 < np.std(ends) < 0.447 * 1.37


def test_white_and_coloured_parts(line):
    """Over two hours at rest: variance, and autocorrelation exp(-t / tau) of the coloured share."""
    still = Leg(("77R-01",), start=100.0, finish=101.0, dwell=40_000.0)
    sensor = GnssSensor(lever_arm_b=(0.0, 0.0, 0.0), outlier_probability=0.0, speed_sigma=0.07)
    run, truth = simulate(line, still, seed=11, outfit=Outfit("g", gnss=sensor))
    east, north, up = local(
        run.gnss.latitude,
        run.gnss.longitude,
        run.gnss.height,
        truth.latitude[truth_at(truth, run.gnss.time)],
        truth.longitude[truth_at(truth, run.gnss.time)],
        truth.height[truth_at(truth, run.gnss.time)],
    )
    independent = run.gnss.time[-1] / (2 * sensor.correlation_time)  # effective samples of the coloured part
    for error, white, coloured in (
        (east, sensor.white_horizontal, sensor.coloured_horizontal),
        (north, sensor.white_horizontal, sensor.coloured_horizontal),
        (up, sensor.white_vertical, sensor.coloured_vertical),
    ):
        total = white**2 + coloured**2
        spread = 4.0 * np.sqrt(2.0 / independent)
        assert error.var() == pytest.approx(total, rel=spread)
        for lag in (1, 30, 60):
            product = (error[lag:] * error[:-lag]).mean()
            assert product == pytest.approx(coloured**2 * np.exp(-lag / sensor.correlation_time), abs=spread * total)
        # the second difference at lag 1 sees almost only the white part: var = 2 (white^2 + coloured^2 (1 - phi))
        step = np.diff(error).var() / 2.0
        assert step == pytest.approx(white**2 + coloured**2 * (1 - np.exp(-1 / 60.0)), rel=0.05)
    assert np.corrcoef(east, north)[0, 1] == pytest.approx(0.0, abs=0.2)
    np.testing.assert_allclose(run.gnss.sigma_east, np.hypot(0.5, 1.4))
    # two white components of 0.07 m/s: speed at rest is Rayleigh, mean sigma sqrt(pi / 2)
    assert run.gnss.speed[200:].mean() == pytest.approx(0.07 * np.sqrt(np.pi / 2), rel=0.02)


def test_gauss_markov_is_stationary_from_the_start():
    generator = np.random.default_rng(4)
    ensemble = np.array([gauss_markov(generator, 40, 1.0, 3.0, 20.0) for _ in range(4000)])
    np.testing.assert_allclose(ensemble.std(axis=0), 3.0, rtol=0.06)


def test_outliers_are_rare_large_and_not_stated(line):
    sensor = replace(QUIET, interval=0.2, outlier_probability=0.02, outlier_size=30.0, lever_arm_b=(0.0, 0.0, 0.0))
    run, truth = simulate(line, Leg(("77R-03",), finish=9000.0), seed=8, outfit=Outfit("g", gnss=sensor))
    i = truth_at(truth, run.gnss.time)
    east, north, _ = local(
        run.gnss.latitude, run.gnss.longitude, run.gnss.height, truth.latitude[i], truth.longitude[i], truth.height[i]
    )
    wild = np.hypot(east, north) > 1e-3
    assert 0.01 < wild.mean() < 0.035
    assert np.sqrt(0.5 * (east[wild] ** 2 + north[wild] ** 2).mean()) == pytest.approx(30.0, rel=0.35)


def test_frame_offset_and_stated_sigma(line):
    sensor = replace(
        QUIET, frame_offset=(1.5, -9.0, 0.4), lever_arm_b=(0.0, 0.0, 0.0), white_horizontal=1e-6, stated_factor=0.5
    )
    run, truth = simulate(line, CURVE, seed=8, outfit=Outfit("g", gnss=sensor))
    i = truth_at(truth, run.gnss.time)
    east, north, up = local(
        run.gnss.latitude, run.gnss.longitude, run.gnss.height, truth.latitude[i], truth.longitude[i], truth.height[i]
    )
    np.testing.assert_allclose(east, 1.5, atol=1e-4)
    np.testing.assert_allclose(north, -9.0, atol=1e-4)
    np.testing.assert_allclose(up, 0.4, atol=1e-4)
    np.testing.assert_allclose(run.gnss.sigma_east, 0.5e-6)
    silent, _ = simulate(line, CURVE, seed=8, outfit=Outfit("g", gnss=replace(sensor, stated_factor=0.0)))
    assert silent.gnss.sigma_east is None


def test_no_sky_in_tunnels_and_outages(line):
    leg = Leg(("77R-03",), start=4500.0, finish=7500.0)
    run, truth = simulate(line, leg, seed=1, outages=[(5.0, 12.0)])
    tunnel = next(t for t in line.provenance["tunnels"] if t["track"] == "77R-03")
    offset = np.interp(run.gnss.time, truth.time, truth.offset)
    assert not ((offset > tunnel["from_m"]) & (offset < tunnel["to_m"])).any()
    assert not ((run.gnss.time >= 5.0) & (run.gnss.time < 12.0)).any()
    out = np.interp(tunnel["to_m"], truth.offset, truth.time)
    after = run.gnss.time[run.gnss.time > out][0] - out
    assert SERVICE.gnss.reacquisition - 0.2 <= after <= SERVICE.gnss.reacquisition + 1.2
    open_sky, _ = simulate(line, leg, seed=1, tunnels=False)
    assert np.diff(open_sky.gnss.time).max() < 1.1
    with pytest.raises(TrackError, match="no length"):
        simulate(line, leg, seed=1, outages=[(5.0, 5.0)])


def test_same_seed_same_run_and_sensors_are_independent(line):
    leg = Leg(("77R-01",), start=50.0, finish=600.0)
    a, _ = simulate(line, leg, seed=9)
    b, _ = simulate(line, leg, seed=9)
    c, _ = simulate(line, leg, seed=10)
    alone, _ = simulate(line, leg, seed=9, outfit=replace(SERVICE, imu=None))
    assert a.gnss.latitude.tobytes() == b.gnss.latitude.tobytes() == alone.gnss.latitude.tobytes()
    assert a.imu.gyro.tobytes() == b.imu.gyro.tobytes()
    assert alone.imu is None
    assert a.gnss.latitude.tobytes() != c.gnss.latitude.tobytes()


def test_angles_and_gauge(line):
    run, truth = simulate(line, CURVE, seed=3, outfit=SURVEY)
    i = truth_at(truth, run.gyro_angles.time)
    points = line.at(truth.track[i], truth.offset[i])
    roll_error = run.gyro_angles.roll - cant_angle(points.cant)
    assert roll_error.std() == pytest.approx(SURVEY.angles.white, rel=0.1)
    assert np.abs(wrap_angle(run.gyro_angles.heading - points.heading)).max() < 2e-3
    assert (run.gauge.cant - points.cant).std() == pytest.approx(SURVEY.gauge.sigma, rel=0.1)
    back, truth = simulate(line, Leg(("77R-03",), start=2600.0, finish=1000.0), seed=3, outfit=SURVEY)
    cant = line.at(truth.track, truth.offset).cant
    i = truth_at(truth, back.gauge.time)
    np.testing.assert_allclose(back.gauge.cant, -cant[i], atol=0.004)  # left and right change sides with the nose


def test_outfits_run(line):
    for outfit in (SURVEY, SERVICE, PHONE):
        run, truth = simulate(line, Leg(("77R-01",), start=50.0, finish=400.0), seed=1, outfit=outfit)
        assert len(run.gnss) > 50
        assert len(truth) > 500
    with pytest.raises(TrackError, match="not positive"):
        simulate(line, ["77R-01"], seed=1, outfit=Outfit("x", gnss=GnssSensor(interval=0.0)))


def test_model_without_heights(line):
    flat = replace(line, height=np.full(len(line.height), np.nan), gradient=np.zeros(len(line.height)))
    run, truth = simulate(flat, Leg(("77R-01",), start=50.0, finish=400.0), seed=1)
    assert np.isnan(truth.height).all()
    assert run.gnss.height is None
    assert np.isfinite(run.imu.specific_force).all()
    part = line.height.copy()
    part[line.knots("77R-02")] = np.nan
    with pytest.raises(TrackError, match="only in parts"):
        simulate(replace(line, height=part), ["77R-01", "77R-02"], seed=1)


def test_progress_is_told(line):
    told = []
    simulate(line, Leg(("77R-01",), start=50.0, finish=100.0), seed=1, progress=lambda *step: told.append(step))
    assert told[0] == ("simulating sensors", 0, 3)
    assert told[-1] == ("simulating sensors", 3, 3)


def test_data_sheets_make_outfits_and_ranges_saturate():
    from dataclasses import replace

    from railnav.errors import InputError
    from railnav.simulation import IMU_SHEETS, ImuSensor, Leg, demo_line, outfit_of, simulate
    from railnav.simulation.sensors import Outfit

    assert {outfit_of(n).imu.gyro_white for n in ("mems", "tactical")} == {
        ImuSensor.of_sheet(n).gyro_white for n in ("IMU440", "STIM300")
    }
    for sheet in IMU_SHEETS:
        assert outfit_of("service", imu=sheet).imu == ImuSensor.of_sheet(sheet)
    with pytest.raises(InputError, match="no outfit 'gold'"):
        outfit_of("gold")
    with pytest.raises(InputError, match="no data sheet"):
        ImuSensor.of_sheet("gold")
    narrow = replace(ImuSensor(), gyro_full_scale=0.01, accelerometer_full_scale=9.0)
    run, _ = simulate(
        demo_line(spacing=5.0), Leg(("77R-03",), start=50.0, finish=900.0), seed=1, outfit=Outfit("n", imu=narrow)
    )
    assert np.abs(run.imu.gyro).max() <= 0.01
    assert np.all(run.imu.specific_force[:, 2] == -9.0)  # at rest it would read -9.81


def test_simulate_does_named_faults_from_the_command_line(tmp_path):
    from click.testing import CliRunner

    import railnav as rn
    from railnav.cli import main

    rn.demo_line(spacing=5.0).to_file(tmp_path / "line.gpkg")
    words = ["simulate", "-m", str(tmp_path / "line.gpkg"), "--route", "77R-03", "--grade", "mems"]
    for name, fault in (("sound", []), ("dark", ["--fault", "gnss-silent-60s@100"])):
        result = CliRunner().invoke(main, [*words, "-o", str(tmp_path / name), *fault])
        assert result.exit_code == 0, result.output
    sound, dark = (rn.Run.read(tmp_path / name) for name in ("sound", "dark"))
    assert len(sound.gnss) - len(dark.gnss) == 60
    result = CliRunner().invoke(main, [*words, "-o", str(tmp_path / "x"), "--fault", "gnss-silent-6s@100"])
    assert result.exit_code == 1
    assert "gnss-silent-60s" in result.stderr
    assert not (tmp_path / "x").exists()
    assert "gnss-ramp-left-0.5" in CliRunner().invoke(main, ["simulate", "--list-faults"]).output


def test_balises_are_read_where_they_lie_in_either_direction():
    from dataclasses import replace

    from railnav.simulation import BaliseSensor, Leg, Outfit, demo_line, simulate

    model = demo_line(spacing=5.0)
    places = {b["id"]: b["offset_m"] for b in model.provenance["balises"] if b["track"] == "77R-03"}
    for leg in (Leg(("77R-03",), start=100.0, finish=3800.0), Leg(("77R-03",), start=3800.0, finish=100.0)):
        run, truth = simulate(model, leg, seed=2, outfit=Outfit("reader", balise=BaliseSensor(missed=0.0)))
        assert sorted(run.balise.id) == ["B-77R-03-1", "B-77R-03-2", "B-77R-03-3"]
        there = np.interp(run.balise.time, truth.time, truth.offset)
        np.testing.assert_allclose(there, [places[i] for i in run.balise.id], atol=1.5)
    nameless = replace(model, provenance={})
    run, _ = simulate(nameless, leg, seed=2, outfit=Outfit("reader", balise=BaliseSensor()))
    assert run.balise is None
