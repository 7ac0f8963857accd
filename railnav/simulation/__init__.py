"""Simulation: fictitious lines, trains that drive on a model, and the sensors they carry."""

from railnav.simulation.bundled import demo_line
from railnav.simulation.driving import Driving, Motion, drive
from railnav.simulation.journey import Leg, Path, Stop, path_of
from railnav.simulation.sensors import (
    OUTFITS,
    PHONE,
    SERVICE,
    SURVEY,
    AnglesSensor,
    GaugeSensor,
    GnssSensor,
    ImuSensor,
    OdometerSensor,
    Outfit,
)
from railnav.simulation.train import poses, simulate

__all__ = [
    "OUTFITS",
    "PHONE",
    "SERVICE",
    "SURVEY",
    "AnglesSensor",
    "Driving",
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
    "path_of",
    "poses",
    "simulate",
]
