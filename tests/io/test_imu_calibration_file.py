"""The calibration file: what is written comes back to the bit; nonsense is refused by its row; a run uses it."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from railnav.errors import EstimationError, InputError
from railnav.inertial import fit_temperature, multi_position, six_position
from railnav.inertial.imu_calibration import (
    ImuCalibration,
    Provenance,
    TriadNoise,
    TriadTemperature,
    apply_calibration,
)
from railnav.io.imu_calibration import calibration_text, read_calibration, write_calibration
from railnav.io.run import read_run, write_run
from railnav.run import ImuStream, Run

EDGE = np.sqrt(0.5)
NINE = np.array([*np.eye(3), *-np.eye(3), (EDGE, EDGE, 0), (EDGE, 0, EDGE), (0, EDGE, EDGE)])
RESPONSE = np.array([[1.02, 0.004, -0.002], [0.004, 0.98, 0.01], [-0.002, 0.01, 1.01]])
BIAS = np.array([0.1, -0.2, 0.05])


def unit(*, warm: bool = False) -> ImuCalibration:
    force = multi_position(9.81 * NINE @ RESPONSE.T + BIAS, 9.81, sigma=0.002)
    gyro = six_position([1.012, 1.0, 0.99], [-1.0, -1.002, -1.0], 1.0, sigma=1e-4)
    temperature = None
    if warm:
        t = np.array([260.0, 280.0, 300.0, 320.0])
        temperature = TriadTemperature(
            fit_temperature(t, BIAS + np.outer(t - 290.0, [1e-3, 2e-3, -1e-3]), degree=1, sigma=1e-4),
            fit_temperature(t, np.outer(t - 290.0, [1e-5, -1e-5, 2e-5]), degree=1, sigma=1e-6),
            290.0,
        )
    return ImuCalibration(
        'unit "7" of ähre',
        force,
        gyro,
        accelerometer_temperature=temperature,
        gyroscope_noise=TriadNoise(1e-4, 2e-5, 3e-7),
        provenance=Provenance("2026-11-22", ("01", "02"), 9.8066, "on a cube"),
    )


@pytest.mark.parametrize("warm", [False, True])
def test_what_is_written_comes_back_to_the_bit(tmp_path: Path, warm: bool) -> None:
    made = unit(warm=warm)
    write_calibration(made, tmp_path / "imu.toml")
    got = read_calibration(tmp_path / "imu.toml")
    for name in ("accelerometer", "gyroscope"):
        a, b = getattr(made, name), getattr(got, name)
        for part in ("bias", "matrix", "residual", "positions", "rank", "method"):
            np.testing.assert_array_equal(getattr(a, part), getattr(b, part))
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-12, atol=1e-30)
    assert (got.name, got.provenance, got.gyroscope_noise) == (made.name, made.provenance, made.gyroscope_noise)
    if warm:
        assert got.accelerometer_temperature.scale_change(310.0) == pytest.approx(
            made.accelerometer_temperature.scale_change(310.0), rel=1e-12
        )
        np.testing.assert_allclose(
            got.accelerometer_temperature.bias.sigma_at(300.0), made.accelerometer_temperature.bias.sigma_at(300.0)
        )
    assert calibration_text(got) == (tmp_path / "imu.toml").read_text(encoding="utf-8")


def test_application_undoes_the_sensor() -> None:
    true = np.random.default_rng(1).normal(size=(50, 3))
    raw = ImuStream(np.arange(50.0), true * [1.006, 1.001, 0.995] + [0.006, -0.001, -0.005], true @ RESPONSE.T + BIAS)
    got = apply_calibration(raw, unit())
    np.testing.assert_allclose(got.specific_force, true, atol=1e-9)
    np.testing.assert_allclose(got.gyro, true, atol=1e-12)
    assert not got.gyro.flags.writeable
    assert raw.calibration == ""
    with pytest.raises(EstimationError, match="calibrated already"):
        apply_calibration(got, unit())


def test_application_follows_the_temperature() -> None:
    true = np.random.default_rng(1).normal(size=(5, 3))
    kelvin = np.linspace(262.0, 318.0, 5)
    warm = kelvin[:, None] - 290.0
    scale = warm * [1e-5, -1e-5, 2e-5]
    raw = (1.0 + scale) * (true @ RESPONSE.T) + BIAS + warm * [1e-3, 2e-3, -1e-3]
    stream = ImuStream(np.arange(5.0), np.zeros((5, 3)), raw, temperature=kelvin)
    np.testing.assert_allclose(apply_calibration(stream, unit(warm=True)).specific_force, true, atol=1e-9)
    with pytest.raises(EstimationError, match="no temperature_c"):
        apply_calibration(replace(stream, temperature=None), unit(warm=True))
    with pytest.raises(EstimationError, match="lies outside what was calibrated"):
        apply_calibration(replace(stream, temperature=kelvin + 30.0), unit(warm=True))


def test_remaining_bias_is_that_of_the_calibration_and_the_instability() -> None:
    got = unit()
    assert got.gyro_bias_sigma() == pytest.approx(math.hypot(1e-4 / math.sqrt(2), 2e-5))
    assert got.accelerometer_bias_sigma() == pytest.approx(got.accelerometer.sigma_bias.max())
    assert ImuCalibration("raw").gyro_bias_sigma() is None


GOOD = calibration_text(unit(warm=True))


@pytest.mark.parametrize(
    ("old", "new", "key", "words"),
    [
        ("format = 1", "format = 9", "format", "newer"),
        ("format = 1", "", "[imu]", "missing required field"),
        ("bias_m_s2 = [0", "bias_m_s2 = [900", "bias_m_s2", "beyond belief"),
        ("bias_m_s2 = [0", "bias_m_s2 = [nan, 0", "bias_m_s2", "of length 3"),
        ("bias_m_s2 = [0.", "bias_m_s2 = [nan, 0.1, 0.1] # ", "bias_m_s2", "not finite"),
        ("bias_m_s2 = ", "bias = ", "bias", "names no unit; write bias_m_s2"),
        ("sigma_bias_m_s2 = [", "sigma_bias_m_s2 = [-", "sigma_bias_m_s2", "negative"),
        ("sigma_bias_m_s2 = [", "sigma_bias_m_s2 = [9", "covariance", "contradicts"),
        ("positions = 9", "positions = -1", "positions", "expected `int` >= 0"),
        ("positions = 9", "places = 9", "[accelerometer]", "unknown field `places`"),
        ("    [0.98", "    [-0.98", "matrix", "mirrors"),
        ("    [0.98", "    [9.98", "matrix", "away from the identity"),
        ("half_range_c = 30.0", "half_range_c = 0.0", "half_range_c", "> 0.0"),
        ("half_range_c = 30.0", "half_range_c = nan", "half_range_c", "> 0.0"),
        ("reference_c = 16", "reference_c = 160", "reference_c", "outside the temperatures"),
        ("gravity_m_s2 = 9", "gravity_m_s2 = 90", "gravity_m_s2", "< 10.5"),
        ("random_walk = 0.0001", "random_walk = -1.0", "random_walk", ">= 0.0"),
    ],
)
def test_nonsense_is_refused_by_its_row(tmp_path: Path, old: str, new: str, key: str, words: str) -> None:
    assert old in GOOD
    text = GOOD.replace(old, new, 1)
    row = next(k for k, line in enumerate(text.splitlines(), start=1) if line.lstrip().startswith(key))
    (tmp_path / "imu.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_calibration(tmp_path / "imu.toml")
    assert words in str(caught.value)
    assert caught.value.row == row
    assert "imu.toml" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[imu\n", "is no TOML"),
        ("[other]\n", r"table \[imu\] is missing"),
        ("[imu]\nformat = 1\n", "neither"),
        ("[imu]\nformat = 1\n[gyroscope]\nbias_rad_s = [0, 0, 0]\n", "missing required field `matrix`"),
    ],
)
def test_what_is_no_calibration_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "imu.toml").write_text(text)
    with pytest.raises(InputError, match=words):
        read_calibration(tmp_path / "imu.toml")


def test_missing_files_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_calibration(tmp_path / "none.toml")
    with pytest.raises(InputError, match="is a folder"):
        read_calibration(tmp_path)
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not UTF-8"):
        read_calibration(tmp_path / "b.toml")
    with pytest.raises(InputError, match="neither triad"):
        write_calibration(ImuCalibration("x"), tmp_path / "x.toml")
    assert not (tmp_path / "x.toml").exists()


def test_a_run_names_its_calibration(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    stream = ImuStream(
        np.arange(1, 21) * 0.1, rng.normal(0, 0.1, (20, 3)), rng.normal(0, 1, (20, 3)), temperature=np.full(20, 291.15)
    )
    write_run(Run("a", datetime(2026, 5, 4, tzinfo=UTC), imu=stream), tmp_path / "a")
    raw = read_run(tmp_path / "a").imu
    np.testing.assert_allclose(raw.temperature, 291.15)
    write_calibration(unit(warm=True), tmp_path / "a" / "imu.toml")
    toml = tmp_path / "a" / "run.toml"
    toml.write_text(toml.read_text() + 'calibration = "imu.toml"\n')
    got = read_run(tmp_path / "a").imu
    assert got.calibration == 'unit "7" of ähre'
    np.testing.assert_array_equal(got.gyro, apply_calibration(raw, unit(warm=True)).gyro)
    # what is written again stands corrected, and says nothing of a calibration
    write_run(Run("a", datetime(2026, 5, 4, tzinfo=UTC), imu=got), tmp_path / "b")
    assert read_run(tmp_path / "b").imu.calibration == ""
    np.testing.assert_allclose(read_run(tmp_path / "b").imu.gyro, got.gyro, atol=1e-10)
    toml.write_text(toml.read_text().replace('"imu.toml"', '"../imu.toml"'))
    with pytest.raises(InputError, match="outside the run folder"):
        read_run(tmp_path / "a")
