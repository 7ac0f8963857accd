"""An inertial unit from its positions to its health: calibrate, correct, and diagnose after a fault.

    python examples/calibrate_imu.py

All data are simulated: a specimen of a data sheet in eighteen attitudes on a bench, and the same specimen a year later with a scale factor
that moved.
"""

from __future__ import annotations

import math

import numpy as np

from railnav.inertial import apply_calibration, calibrate_imu, diagnose_imu
from railnav.inertial.imu_calibration import ImuCalibration
from railnav.inertial.imu_diagnosis import ImuDiagnosis
from railnav.simulation.positions import simulate_positions


def main(seed: int = 7) -> tuple[ImuCalibration, ImuDiagnosis]:
    """Simulate a bench, calibrate, spoil, diagnose."""
    bench = simulate_positions("multi-position", unit="STIM300", seed=seed, count=18)
    found = calibrate_imu(bench.logs, ["multi-position"], gravity=bench.gravity, latitude=bench.latitude, name="unit 7")
    unit = found.calibration
    assert unit.accelerometer is not None
    assert unit.accelerometer.sigma_bias is not None
    for axis, bias, sigma, truth in zip(
        "xyz", unit.accelerometer.bias, unit.accelerometer.sigma_bias, bench.accelerometer.bias, strict=True
    ):
        print(f"accelerometer {axis}: bias {bias * 1e3:+.2f} +- {sigma * 1e3:.2f} mm/s2 (truth {truth * 1e3:+.2f})")

    before = np.array([np.linalg.norm(log.imu.specific_force.mean(axis=0)) for log in bench.logs]) - bench.gravity
    after = (
        np.array([np.linalg.norm(apply_calibration(log.imu, unit).specific_force.mean(axis=0)) for log in bench.logs])
        - bench.gravity
    )
    print(
        f"length of gravity: {1e3 * np.sqrt(np.mean(before**2)):.2f} mm/s2 off before, {1e3 * np.sqrt(np.mean(after**2)):.2f} after"
    )

    later = simulate_positions(
        "multi-position", unit="STIM300", seed=seed, count=18, series=1, fault=("accelerometer scale y", 0.003)
    )
    health = diagnose_imu(later.logs, unit, gravity=later.gravity, latitude=later.latitude)
    print("a year later:", "; ".join(health.failures) or "healthy")
    print(
        f"the gyros' biases are known to {math.degrees(unit.gyro_bias_sigma() or math.nan) * 3600:.1f} deg/h: the Earth turns at 15.0"
    )
    return unit, health


if __name__ == "__main__":
    main()
