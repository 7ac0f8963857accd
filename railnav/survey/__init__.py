"""Survey runs become a reference track model."""

from railnav.survey.build import build

__all__ = ["build"]
