"""Survey runs become a reference track model."""

from railnav.survey.construction import build

__all__ = ["build"]
