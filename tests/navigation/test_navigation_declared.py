"""Declared errors of sensors: from run.toml to the navigator's settings, and what they are worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from railnav.cli import main
from railnav.errors import RunError
from railnav.evaluation import evaluate
from railnav.io.run import read_run, write_run
from railnav.io.run_contents import read_sensors
from railnav.navigation import Mode, Settings, navigate
from railnav.navigation.declared import settings_of
from railnav.run import GnssErrors, ImuErrors
from railnav.simulation import SERVICE, GnssSensor, Leg, simulate

WHITE = GnssSensor(
    white_horizontal=1.5, white_vertical=3.0, coloured_horizontal=0.0, coloured_vertical=0.0, speed_sigma=0.1
)


@pytest.fixture(scope="module")
def driven(line):
    outfit = replace(SERVICE, gnss=WHITE, odometer=replace(SERVICE.odometer, slip_rate=0.0))
    return simulate(line, Leg(("77R-03",), start=200.0, finish=5500.0), seed=11, outfit=outfit, declare=True)


def test_the_data_do_not_depend_on_the_declaration(line, driven):
    outfit = replace(SERVICE, gnss=WHITE, odometer=replace(SERVICE.odometer, slip_rate=0.0))
    run, _ = simulate(line, Leg(("77R-03",), start=200.0, finish=5500.0), seed=11, outfit=outfit)
    assert run.gnss.errors is None
    assert run.imu.errors is None
    assert run.odometer.errors is None
    np.testing.assert_array_equal(run.gnss.latitude, driven[0].gnss.latitude)
    np.testing.assert_array_equal(run.imu.gyro, driven[0].imu.gyro)
    assert settings_of(run) == Settings.of_receiver(run.gnss.receiver)


def test_a_declaration_survives_the_file(tmp_path, driven):
    run, _ = driven
    write_run(run, tmp_path / "a")
    again = read_run(tmp_path / "a")
    assert again.gnss.errors == run.gnss.errors
    assert again.odometer.errors == run.odometer.errors
    for name in ImuErrors.__slots__:
        np.testing.assert_allclose(getattr(again.imu.errors, name), getattr(run.imu.errors, name), rtol=1e-8)
    write_run(again, tmp_path / "b")
    assert (tmp_path / "a" / "run.toml").read_bytes() == (tmp_path / "b" / "run.toml").read_bytes()


@pytest.mark.parametrize(
    ("line_", "said"),
    [
        ("whit_m = 1.0", "whit_m"),
        ("white_m = -1.0", "white_m"),
        ('white_m = "a"', "white_m"),
        ("white_m = nan", "white_m"),
    ],
)
def test_what_is_no_error_is_refused(tmp_path, driven, line_, said):
    write_run(driven[0], tmp_path / "a")
    file = tmp_path / "a" / "run.toml"
    file.write_text(file.read_text().replace("white_m = 1.5", line_))
    with pytest.raises(RunError, match=said):
        read_run(tmp_path / "a")
    (tmp_path / "s.toml").write_text(f"[gnss]\n{line_}\n")
    with pytest.raises(RunError, match=said):
        read_sensors(tmp_path / "s.toml")


def test_parts_are_shares_of_what_the_receiver_states(driven):
    gnss = replace(driven[0].gnss, errors=GnssErrors(white=0.75, correlated=3.0, frame_offset=1.5))
    told = settings_of(replace(driven[0], gnss=gnss))
    assert (told.gnss_white_share, told.gnss_correlated_share, told.gnss_frame_share) == pytest.approx((0.5, 2.0, 1.0))
    assert told.time_tag_sigma == Settings().time_tag_sigma  # not declared: as usual
    unstated = settings_of(replace(driven[0], gnss=replace(gnss, sigma_east=None, sigma_north=None)))
    assert unstated.gnss_white_share == pytest.approx(0.75 / 4.0)
    # the mounting is a bias, too, and curves make it walk: the sheet's own walk is no less than usual
    assert told.accelerometer_bias > 0.02
    assert told.accelerometer_walk == Settings().accelerometer_walk


def test_who_is_told_states_less_and_is_right(line, driven):
    run, truth = driven
    told = evaluate(navigate(run, line), truth)
    usual = evaluate(navigate(run, line, settings=Settings()), truth)
    late = told.time > 60.0
    assert np.mean(told.sigma_along[late]) < 0.75 * np.mean(usual.sigma_along[late])
    assert np.mean((told.along[late] / told.sigma_along[late]) ** 2) < 4.0
    assert not (np.abs(told.along) > told.protection_level).any()


def test_the_verb_takes_sensors_by_name_and_by_file(tmp_path, line, driven):
    line.to_file(tmp_path / "line.gpkg")
    write_run(driven[0], tmp_path / "run")
    (tmp_path / "mine.toml").write_text("[gnss]\nwhite_m = 1.5\ncorrelated_m = 0.0\n")

    def navigated(*more):
        arguments = [
            "navigate",
            str(tmp_path / "run"),
            "-m",
            str(tmp_path / "line.gpkg"),
            "-o",
            str(tmp_path / "s.csv"),
        ]
        return CliRunner().invoke(main, [*arguments, *more])

    sizes = {}
    for sensors in ("declared", "usual", "service", str(tmp_path / "mine.toml")):
        result = navigated("--sensors", sensors)
        assert result.exit_code == 0, result.output
        sizes[sensors] = np.median(np.genfromtxt(tmp_path / "s.csv", delimiter=",", names=True)["sigma_along_m"])
    assert sizes["declared"] < sizes[str(tmp_path / "mine.toml")] < sizes["usual"]
    unknown = navigated("--sensors", "best")
    assert unknown.exit_code == 1
    assert "best" in unknown.output


def test_an_imu_goes_on_when_fixes_and_wheel_end(line):
    run, truth = simulate(
        line,
        Leg(("77R-03",), start=200.0, finish=3000.0),
        seed=3,
        outfit=replace(SERVICE, odometer=None),
        outages=[(60.0, 1e5)],
    )
    solution = navigate(run, line)
    assert solution.time[-1] == pytest.approx(run.imu.time[-1])
    e = evaluate(solution, truth)
    last = e.time > 61.0
    assert (np.abs(e.along[last]) < e.protection_level[last]).mean() > 0.99
    assert (solution.mode[solution.time > 65.0] == Mode.COASTING).mean() > 0.9
