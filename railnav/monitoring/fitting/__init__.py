"""Alignment fitting: from a measured axis to straights, arcs, transitions, grades, vertical curves and cant ramps."""

from railnav.monitoring.fitting.axis import Axis, axis_of_model, axis_of_points
from railnav.monitoring.fitting.fit import Fitted, fit_design

__all__ = ["Axis", "Fitted", "axis_of_model", "axis_of_points", "fit_design"]
