"""Inertial sensors and what can be made of them alone: error models, calibration, alignment, strapdown.

Body axes b are forward, right, down; local axes n are north, east, down. `specific_force_b` is what an accelerometer measures,
acceleration minus gravitation: at rest it points up with the size of gravity, so its third component is about -9.81 m/s^2 on a
level vehicle. `rate_ib_b` is what a gyro measures, the rate against inertial space, rad/s. All values are means over the interval that
ends at their time, as in `railnav.run.ImuStream`.
"""

from __future__ import annotations

from railnav.inertial.alignment import (
    Alignment,
    FineAlignment,
    Rest,
    VelocityHeading,
    coarse_align,
    compass_heading,
    fine_align,
    gyrocompass,
    gyrocompass_error,
    heading_from_antennas,
    heading_from_velocity,
    level,
    lever_arm_motion,
    rest,
)
from railnav.inertial.allan import AllanCurve, NoiseParameters, allan_deviation, fit_allan
from railnav.inertial.calibration import (
    Position,
    Solvability,
    TemperaturePolynomial,
    TriadCalibration,
    advise_positions,
    advise_turns,
    finite_rotation,
    fit_temperature,
    multi_position,
    position_mean,
    six_position,
    solvability,
    turned_force,
    turned_rate,
    vector_calibration,
)
from railnav.inertial.diagnosis import (
    CAUSES,
    Diagnosis,
    ScalarControl,
    diagnose,
    scalar_control,
)
from railnav.inertial.mechanization import (
    EARTH_RATE,
    GravityField,
    NavigationState,
    Trajectory,
    mechanize,
)
from railnav.inertial.sensors import GRADES, SensorGrade, TriadModel, TriadSamples, misalignment_matrix, simulate_triad

__all__ = [
    "CAUSES",
    "EARTH_RATE",
    "GRADES",
    "Alignment",
    "AllanCurve",
    "Diagnosis",
    "FineAlignment",
    "GravityField",
    "NavigationState",
    "NoiseParameters",
    "Position",
    "Rest",
    "ScalarControl",
    "SensorGrade",
    "Solvability",
    "TemperaturePolynomial",
    "Trajectory",
    "TriadCalibration",
    "TriadModel",
    "TriadSamples",
    "VelocityHeading",
    "advise_positions",
    "advise_turns",
    "allan_deviation",
    "coarse_align",
    "compass_heading",
    "diagnose",
    "fine_align",
    "finite_rotation",
    "fit_allan",
    "fit_temperature",
    "gyrocompass",
    "gyrocompass_error",
    "heading_from_antennas",
    "heading_from_velocity",
    "level",
    "lever_arm_motion",
    "mechanize",
    "misalignment_matrix",
    "multi_position",
    "position_mean",
    "rest",
    "scalar_control",
    "simulate_triad",
    "six_position",
    "solvability",
    "turned_force",
    "turned_rate",
    "vector_calibration",
]
