"""Evaluation: a solution beside the truth. Errors along and across, track selection, consistency, integrity."""

from railnav.evaluation.axis import AxisError, axis_error, truth_on
from railnav.evaluation.comparison import Comparison, compare
from railnav.evaluation.consistency import Consistency, consistency, effective_samples, pooled
from railnav.evaluation.jumps import Jump, Jumps, find_jumps
from railnav.evaluation.known import truth_as_solution
from railnav.evaluation.reliability import Reliability, ReliabilityClass, pooled_reliability, reliability
from railnav.evaluation.scores import (
    CoastingStretch,
    Evaluation,
    Integrity,
    Statistics,
    TrackSelection,
    WrongStretch,
    evaluate,
)

__all__ = [
    "AxisError",
    "CoastingStretch",
    "Comparison",
    "Consistency",
    "Evaluation",
    "Integrity",
    "Jump",
    "Jumps",
    "Reliability",
    "ReliabilityClass",
    "Statistics",
    "TrackSelection",
    "WrongStretch",
    "axis_error",
    "compare",
    "consistency",
    "effective_samples",
    "evaluate",
    "find_jumps",
    "pooled",
    "pooled_reliability",
    "reliability",
    "truth_as_solution",
    "truth_on",
]
