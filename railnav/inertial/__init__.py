"""Inertial sensors and what can be made of them alone: error models, calibration, alignment, strapdown, GNSS aiding.

Body axes b are forward, right, down; local axes n are north, east, down. `specific_force_b` is what an accelerometer measures,
acceleration minus gravitation: at rest it points up with the size of gravity, so its third component is about -9.81 m/s^2 on a
level vehicle. `rate_ib_b` is what a gyro measures, the rate against inertial space, rad/s. All values are means over the interval that
ends at their time, as in `railnav.run.ImuStream`.
"""

from __future__ import annotations

from railnav.inertial.advice import advise_positions
from railnav.inertial.aided import (
    AidedSolution,
    Fixes,
    Ranges,
    Rests,
    Unknowns,
    Vehicle,
    VehicleMotion,
    find_rests,
    integrate,
    without_lever_arm,
)
from railnav.inertial.alignment import Alignment, coarse_align, level, lever_arm_motion
from railnav.inertial.allan import AllanCurve, NoiseParameters, UnitNoise, allan_deviation, fit_allan, unit_noise
from railnav.inertial.autonomous import (
    FixedLatitude,
    averaging_time,
    coning_rate,
    fixed_latitude,
    fixed_latitude_error,
    geodetic_minus_geocentric,
    required_grade,
)
from railnav.inertial.calibration import TriadCalibration, multi_position, six_position, vector_calibration
from railnav.inertial.compass import compass_heading, gyrocompass, gyrocompass_error
from railnav.inertial.denoising import Denoised, denoise
from railnav.inertial.diagnosis import (
    CAUSES,
    Diagnosis,
    ScalarControl,
    diagnose,
    scalar_control,
)
from railnav.inertial.error_model import (
    ErrorState,
    error_dynamics,
    error_transition,
    feed_back,
    gnss_design,
    position_scale,
    process_noise_sqrt,
    vehicle_design,
)
from railnav.inertial.fine_alignment import FineAlignment, fine_align
from railnav.inertial.great_circle import (
    great_circle_heading,
    great_circle_heading_error,
    ground_speed,
    ground_speed_error,
)
from railnav.inertial.growth import LegError, leg_error
from railnav.inertial.heading import VelocityHeading, heading_from_antennas, heading_from_velocity
from railnav.inertial.imu_calibration import ImuCalibration, Provenance, TriadNoise, TriadTemperature, apply_calibration
from railnav.inertial.imu_diagnosis import ImuDiagnosis, diagnose_imu
from railnav.inertial.imu_noise import ImuNoise, InitialSigma
from railnav.inertial.inspection import Finding, inspect_log
from railnav.inertial.journey import Journey, autonomous_journey
from railnav.inertial.loose import LooseSolution, integrate_gnss
from railnav.inertial.mechanization import (
    EARTH_RATE,
    GravityField,
    NavigationState,
    Trajectory,
    mechanize,
)
from railnav.inertial.moving_base import MovingPosition, moving_position
from railnav.inertial.positions import Position, PositionLog, cut_positions, position_mean
from railnav.inertial.procedure import METHODS, CalibrationResult, calibrate_imu
from railnav.inertial.reference_azimuth import ReferenceLongitude, longitude_from_reference
from railnav.inertial.resting import Rest, Stretch, find_stretches, rest
from railnav.inertial.sensors import GRADES, SensorGrade, TriadModel, TriadSamples, misalignment_matrix, simulate_triad
from railnav.inertial.standing import Standing, align_standing, body_axes
from railnav.inertial.temperature import TemperaturePolynomial, fit_temperature
from railnav.inertial.turns import Solvability, advise_turns, finite_rotation, solvability, turned_force, turned_rate

__all__ = [
    "CAUSES",
    "EARTH_RATE",
    "GRADES",
    "METHODS",
    "AidedSolution",
    "Alignment",
    "AllanCurve",
    "CalibrationResult",
    "Denoised",
    "Diagnosis",
    "ErrorState",
    "Finding",
    "FineAlignment",
    "FixedLatitude",
    "Fixes",
    "GravityField",
    "ImuCalibration",
    "ImuDiagnosis",
    "ImuNoise",
    "InitialSigma",
    "Journey",
    "LegError",
    "LooseSolution",
    "MovingPosition",
    "NavigationState",
    "NoiseParameters",
    "Position",
    "PositionLog",
    "Provenance",
    "Ranges",
    "ReferenceLongitude",
    "Rest",
    "Rests",
    "ScalarControl",
    "SensorGrade",
    "Solvability",
    "Standing",
    "Stretch",
    "TemperaturePolynomial",
    "Trajectory",
    "TriadCalibration",
    "TriadModel",
    "TriadNoise",
    "TriadSamples",
    "TriadTemperature",
    "UnitNoise",
    "Unknowns",
    "Vehicle",
    "VehicleMotion",
    "VelocityHeading",
    "advise_positions",
    "advise_turns",
    "align_standing",
    "allan_deviation",
    "apply_calibration",
    "autonomous_journey",
    "averaging_time",
    "body_axes",
    "calibrate_imu",
    "coarse_align",
    "compass_heading",
    "coning_rate",
    "cut_positions",
    "denoise",
    "diagnose",
    "diagnose_imu",
    "error_dynamics",
    "error_transition",
    "feed_back",
    "find_rests",
    "find_stretches",
    "fine_align",
    "finite_rotation",
    "fit_allan",
    "fit_temperature",
    "fixed_latitude",
    "fixed_latitude_error",
    "geodetic_minus_geocentric",
    "gnss_design",
    "great_circle_heading",
    "great_circle_heading_error",
    "ground_speed",
    "ground_speed_error",
    "gyrocompass",
    "gyrocompass_error",
    "heading_from_antennas",
    "heading_from_velocity",
    "inspect_log",
    "integrate",
    "integrate_gnss",
    "leg_error",
    "level",
    "lever_arm_motion",
    "longitude_from_reference",
    "mechanize",
    "misalignment_matrix",
    "moving_position",
    "multi_position",
    "position_mean",
    "position_scale",
    "process_noise_sqrt",
    "required_grade",
    "rest",
    "scalar_control",
    "simulate_triad",
    "six_position",
    "solvability",
    "turned_force",
    "turned_rate",
    "unit_noise",
    "vector_calibration",
    "vehicle_design",
    "without_lever_arm",
]
