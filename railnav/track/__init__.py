"""The reference track model: alignment, graph of tracks and permitted movements, spatial index, validation."""

from railnav.track.alignment import KnotTable, fit_alignment
from railnav.track.assembly import TrackSection, assemble
from railnav.track.model import (
    Candidate,
    End,
    MilePosts,
    NodeKind,
    Nodes,
    Route,
    TrackModel,
    TrackPoints,
)
from railnav.track.validation import Defect, validate

__all__ = [
    "Candidate",
    "Defect",
    "End",
    "KnotTable",
    "MilePosts",
    "NodeKind",
    "Nodes",
    "Route",
    "TrackModel",
    "TrackPoints",
    "TrackSection",
    "assemble",
    "fit_alignment",
    "validate",
]
