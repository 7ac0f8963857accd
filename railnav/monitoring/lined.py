"""The lined axis: the track as it lies once a plan is carried out, as a model of one track."""

from __future__ import annotations

import numpy as np

from railnav.monitoring.lining import LiningPlan, grid_scale
from railnav.track.alignment import fit_alignment
from railnav.track.assembly import TrackSection, assemble
from railnav.track.model import TrackModel


def lined_model(plan: LiningPlan) -> TrackModel:
    """Lay the measured axis where the plan moves it.

    Parameters
    ----------
    plan : LiningPlan

    Returns
    -------
    TrackModel
        One track, named after the section; the model's cant; chainage at its ends where the model has it. The machine's own errors are
        not in it.

    Examples
    --------
    >>> callable(lined_model)
    True
    """
    section, d = plan.section, plan.distance
    point = section.at(d)
    scale = grid_scale(section, d)
    lift = np.where(np.isfinite(plan.lift), plan.lift, 0.0)
    knots = fit_alignment(
        section.model.frame,
        plan.easting + plan.slew * scale * np.cos(point.grid_bearing),
        plan.northing - plan.slew * scale * np.sin(point.grid_bearing),
        plan.height + lift if np.isfinite(plan.height).all() else None,
        cant=point.cant,
        spacing=float(d[1] - d[0]),
    )
    ends = [float(value) if np.isfinite(value) else None for value in point.chainage[[0, -1]]]
    line = section.model.line[int(section.track[0])]
    laid = TrackSection(f"{section.name} lined", knots, line=line, start_chainage=ends[0], end_chainage=ends[1])
    return assemble(
        section.model.frame, [laid], provenance={"lining": {"design": plan.design, "runs": list(plan.measured.runs)}}
    )
