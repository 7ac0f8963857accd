"""Evaluation: a solution beside the truth. Errors along and across, track selection, consistency, integrity."""

from railnav.evaluation.comparison import Comparison, compare
from railnav.evaluation.consistency import Consistency, consistency, effective_samples, pooled
from railnav.evaluation.jumps import Jump, Jumps, find_jumps
from railnav.evaluation.known import truth_as_solution
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
    "CoastingStretch",
    "Comparison",
    "Consistency",
    "Evaluation",
    "Integrity",
    "Jump",
    "Jumps",
    "Statistics",
    "TrackSelection",
    "WrongStretch",
    "compare",
    "consistency",
    "effective_samples",
    "evaluate",
    "find_jumps",
    "pooled",
    "truth_as_solution",
]
