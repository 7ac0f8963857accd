"""Simulation: fictitious lines, trains that drive on a model, and the sensors they carry."""

from railnav.simulation.bundled import demo_line
from railnav.simulation.driving import Driving, Motion, drive
from railnav.simulation.faults import FAULTS, Fault, with_fault
from railnav.simulation.journey import Leg, Path, Stop, path_of
from railnav.simulation.sensors import (
    IMU_SHEETS,
    OUTFITS,
    PHONE,
    SERVICE,
    SURVEY,
    AnglesSensor,
    BaliseSensor,
    GaugeSensor,
    GnssSensor,
    ImuSensor,
    OdometerSensor,
    Outfit,
    outfit_of,
)
from railnav.simulation.stale_models import (
    MODEL_FAULTS,
    model_with_fault,
    with_shifted_model,
    with_stale_track,
    without_track,
)
from railnav.simulation.train import poses, simulate

__all__ = [
    "FAULTS",
    "IMU_SHEETS",
    "MODEL_FAULTS",
    "OUTFITS",
    "PHONE",
    "SERVICE",
    "SURVEY",
    "AnglesSensor",
    "BaliseSensor",
    "Driving",
    "Fault",
    "GaugeSensor",
    "GnssSensor",
    "ImuSensor",
    "Leg",
    "Motion",
    "OdometerSensor",
    "Outfit",
    "Path",
    "Stop",
    "demo_line",
    "drive",
    "model_with_fault",
    "outfit_of",
    "path_of",
    "poses",
    "simulate",
    "with_fault",
    "with_shifted_model",
    "with_stale_track",
    "without_track",
]
