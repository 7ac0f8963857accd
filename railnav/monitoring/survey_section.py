"""From runs to the measured axis of one section: navigated, placed, and joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from railnav.errors import OffModelError
from railnav.monitoring.position import MeasuredAxis, measured_axis
from railnav.monitoring.recording import record
from railnav.monitoring.section import Passage, onto, passages_of, section_of, told_apart
from railnav.navigation import navigate
from railnav.run import Progress, Run
from railnav.track.model import TrackModel


def measured_section(
    runs: Sequence[Run], model: TrackModel, *, tracks: Sequence[str] = (), progress: Progress | None = None
) -> tuple[MeasuredAxis, bool]:
    """Measure the axis of a section with runs on a model.

    Parameters
    ----------
    runs : sequence of Run
    model : TrackModel
    tracks : sequence of str
        The section; by default the longest uninterrupted way that a run covers.
    progress : Progress, optional

    Returns
    -------
    axis : MeasuredAxis
    surveyed : bool
        Whether the model states covariances there: it is a survey, not a design.

    Raises
    ------
    OffModelError
        No run covers any of the section.
    """
    told_apart(runs)
    section = section_of(model, tracks) if tracks else None
    found: list[tuple[Run, Passage]] = []
    for i, run in enumerate(runs):
        if progress is not None:
            progress("navigate", i, len(runs))
        found += [(run, passage) for passage in passages_of(navigate(run, model, smooth=True), model)]
    if progress is not None:
        progress("navigate", len(runs), len(runs))
    found.sort(key=lambda pair: pair[1].extent[0] - pair[1].extent[1])
    if section is None:
        if not found:
            raise OffModelError("no run has an uninterrupted way of 50 m on the model")
        section = found[0][1].section
    recordings = []
    for run, passage in found:
        part = passage if passage.section is section else onto(passage, section)
        if part is not None:
            recordings.append(record(run, part, against_model=True))
    there = {recording.run.id for recording in recordings}
    notes = tuple(f"run {run.id}: does not touch section {section.name}" for run in runs if run.id not in there)
    if not recordings:
        ways = sorted({passage.section.name for _, passage in found})
        raise OffModelError(
            f"no run covers any of section {section.name}; they cover {'; '.join(ways[:4]) or 'nothing'}"
        )
    axis = measured_axis(section, recordings)
    return replace(axis, notes=notes + axis.notes), section.surveyed
