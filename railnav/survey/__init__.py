"""Survey runs become a reference track model, refine it later, and show where the track has moved."""

from railnav.survey.construction import build
from railnav.survey.difference import difference
from railnav.survey.updating import update

__all__ = ["build", "difference", "update"]
