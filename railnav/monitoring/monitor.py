"""Monitoring: runs on a model become channels, exceedances, quality and trends, section by section."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from railnav.errors import OffModelError, TrackError
from railnav.monitoring.channels import TWIST_BASES, Geometry, channels_of
from railnav.monitoring.limits import CERTAIN, Exceedance, LimitTable, Verdict, exceedances
from railnav.monitoring.overlay import Overlay, overlay, shifted
from railnav.monitoring.quality import Segment, segments
from railnav.monitoring.recording import record
from railnav.monitoring.section import Passage, Section, onto, passages_of, told_apart
from railnav.monitoring.trends import Trend, trends
from railnav.monitoring.versines import Chord
from railnav.navigation import navigate
from railnav.run import Progress, Run
from railnav.track.model import TrackModel

#: A passage shorter than this is no section of its own, m.
SHORTEST_SECTION = 200.0
#: A passage that lies on a section by this share of its length belongs to it.
SAME_SECTION = 0.5
#: A shift smaller than this is not applied, m.
LEAST_SHIFT = 0.02
#: Speeds that limits change at, km/h.
SPEED_CLASSES = (40.0, 80.0, 120.0, 160.0, 230.0, 300.0)


@dataclass(frozen=True, slots=True, eq=False)
class Monitored:
    """What the runs say of one section.

    Attributes
    ----------
    section : Section
    speed : float
        Speed that limits were chosen for, m/s.
    geometries : tuple of Geometry
        One a passage, the reference first.
    overlays : tuple of Overlay or None
        How each lies on the reference (shift found before it was applied); None for the reference itself.
    exceedances : tuple of Exceedance
        Of the latest run first.
    verdicts : tuple of tuple of Verdict
        One tuple a geometry.
    segments : tuple of tuple of Segment
        One tuple a geometry.
    trends : tuple of Trend
    """

    section: Section
    speed: float
    geometries: tuple[Geometry, ...]
    overlays: tuple[Overlay | None, ...]
    exceedances: tuple[Exceedance, ...]
    verdicts: tuple[tuple[Verdict, ...], ...]
    segments: tuple[tuple[Segment, ...], ...]
    trends: tuple[Trend, ...]

    @property
    def latest(self) -> str:
        """The latest run, by its identifier."""
        return max((g.recording.run for g in self.geometries), key=lambda run: run.start).id


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """The result of `monitor`.

    Attributes
    ----------
    model : TrackModel
    sections : tuple of Monitored
        Longest first.
    table : LimitTable
    step : float
        Of the grids, m.
    notes : tuple of str
        What must be known of the runs as a whole.
    """

    model: TrackModel
    sections: tuple[Monitored, ...]
    table: LimitTable
    step: float
    notes: tuple[str, ...] = field(default_factory=tuple)


def monitor(
    runs: Sequence[Run],
    model: TrackModel,
    table: LimitTable,
    *,
    section: Section | None = None,
    speed: float | None = None,
    step: float = 0.25,
    gauge: float | None = None,
    bases: Sequence[float] = TWIST_BASES,
    chords: Sequence[Chord] = (),
    against_model: bool | None = None,
    progress: Progress | None = None,
) -> Report:
    """Work out track geometry from runs on a model, and hold it against limits.

    Each run is placed on the model (smoothed navigation), parted into uninterrupted ways, and its streams are brought onto a uniform grid.
    Runs over one section are shifted onto the one that covers it best.

    Parameters
    ----------
    runs : sequence of Run
    model : TrackModel
    table : LimitTable
    section : Section, optional
        The tracks of interest; by default whatever the runs cover, the longest ways first.
    speed : float, optional
        Speed of the line for the limits, m/s; by default the class that the fastest run reaches (95 % of its way).
    step : float
        Of the grid, m.
    gauge : float, optional
        Nominal gauge, m.
    bases : sequence of float
        Twist bases, m.
    chords : sequence of Chord
        Chords to give versines of alignment for.
    against_model : bool, optional
        Whether the model's shape is taken off; by default where it is a design.
    progress : Progress, optional

    Returns
    -------
    Report

    Raises
    ------
    OffModelError
        A run never touches the model, or none covers any of the section.
    """
    if not runs:
        raise TrackError("there is no run to monitor")
    told_apart(runs)
    passages: list[tuple[Run, Passage]] = []
    notes: list[str] = []
    for i, run in enumerate(runs):
        if progress is not None:
            progress("navigate", i, len(runs))
        found = passages_of(navigate(run, model, smooth=True), model)
        if not found:
            notes.append(f"run {run.id!r}: no uninterrupted way of 50 m on the model")
        passages += [(run, passage) for passage in found]
    if progress is not None:
        progress("navigate", len(runs), len(runs))
    groups = _groups(passages, section, notes)
    if not groups:
        asked = f"section {section.name} ({section.length:.0f} m)" if section is not None else "a section of 200 m"
        raise OffModelError(f"no run covers any of {asked}; {_covered_instead(passages)}")
    done = []
    for i, (where, members) in enumerate(groups):
        if progress is not None:
            progress("channels", i, len(groups))
        done.append(
            _monitored(
                where,
                members,
                table,
                speed=speed,
                step=step,
                gauge=gauge,
                bases=bases,
                chords=chords,
                against_model=against_model,
            )
        )
    if progress is not None:
        progress("channels", len(groups), len(groups))
    notes += [
        f"run {g.recording.run.id!r} on {part.section.name}: its track is certain in {100.0 * g.recording.passage.probability:.0f} % of "
        "the rows; it may have been on a track beside, and is not judged"
        for part in done
        for g in part.geometries
        if g.recording.passage.probability < CERTAIN
    ]
    gauges = sorted(
        {
            g.recording.gauge_nominal
            for part in done
            for g in part.geometries
            if math.isfinite(g.recording.gauge_nominal)
        }
    )
    wrong = [value for value in gauges if abs(value - table.gauge) > 0.003]
    if wrong:
        notes.append(
            f"limits not applied: the table is for a gauge of {1e3 * table.gauge:.0f} mm, the runs show {1e3 * wrong[0]:.0f} mm; name a "
            "table for it, or the nominal gauge"
        )
    return Report(model, tuple(done), table, step, tuple(notes))


def speed_class(speed: float) -> float:
    """The speed class that a speed falls in: its upper end, m/s.

    Examples
    --------
    >>> round(3.6 * speed_class(33.0))
    120
    """
    return next((c for c in SPEED_CLASSES if 3.6 * speed <= c * 1.02), SPEED_CLASSES[-1]) / 3.6


def _groups(
    passages: list[tuple[Run, Passage]], section: Section | None, notes: list[str]
) -> list[tuple[Section, list[tuple[Run, Passage]]]]:
    """Passages by section: the section asked for, or the longest ways one after another."""
    groups: list[tuple[Section, list[tuple[Run, Passage]]]] = [] if section is None else [(section, [])]
    for run, passage in sorted(passages, key=lambda pair: pair[1].extent[0] - pair[1].extent[1]):
        length = passage.extent[1] - passage.extent[0]
        for where, members in groups:
            part = onto(passage, where)
            share = 0.0 if part is None else (part.extent[1] - part.extent[0]) / length
            if part is not None and (section is not None or share >= SAME_SECTION):
                members.append((run, part))
                break
        else:
            if section is None and length >= SHORTEST_SECTION:
                groups.append((passage.section, [(run, passage)]))
    if section is not None:
        for run_id in dict.fromkeys(run.id for run, _ in passages):
            ways = [p for run, p in groups[0][1] if run.id == run_id]
            covered = sum(p.extent[1] - p.extent[0] for p in ways)
            if covered < 0.9 * section.length:
                notes.append(f"run {run_id!r} covers {covered:.0f} m of the {section.length:.0f} m asked for")
    return [(where, members) for where, members in groups if members]


def _covered_instead(passages: list[tuple[Run, Passage]]) -> str:
    ways = [f"{passage.section.name} (run {run.id!r})" for run, passage in passages[:4]]
    return f"they cover {'; '.join(ways)}" if ways else "they have no uninterrupted way on the model"


def _monitored(
    where: Section,
    members: list[tuple[Run, Passage]],
    table: LimitTable,
    *,
    speed: float | None,
    step: float,
    gauge: float | None,
    bases: Sequence[float],
    chords: Sequence[Chord],
    against_model: bool | None,
) -> Monitored:
    members = sorted(members, key=lambda pair: pair[1].extent[0] - pair[1].extent[1])
    geometries: list[Geometry] = []
    overlays: list[Overlay | None] = []
    for run, passage in members:
        recorded = record(run, passage, step=step, gauge=gauge, against_model=against_model)
        made = channels_of(recorded, bases=bases, chords=chords)
        lies: Overlay | None = None
        if geometries:
            # a pass that covers what the reference does not is held against it where both are
            lies = overlay(made, geometries[0])
            if len(lies.shift) and float(np.abs(lies.shift).max()) > LEAST_SHIFT:
                moved = shifted(passage, lies)
                if len(moved.time) >= 10:
                    recorded = record(run, moved, step=step, gauge=gauge, against_model=against_model)
                    made = channels_of(recorded, bases=bases, chords=chords)
        geometries.append(made)
        overlays.append(lies)
    if speed is None:
        fastest = [float(np.nanquantile(g.recording.speed, 0.95)) for g in geometries]
        speed = speed_class(max(fastest))
    found: list[Exceedance] = []
    verdicts: list[tuple[Verdict, ...]] = []
    graded: list[tuple[Segment, ...]] = []
    nominal = [g.recording.gauge_nominal for g in geometries if math.isfinite(g.recording.gauge_nominal)]
    if any(abs(value - table.gauge) > 0.003 for value in nominal):
        table = replace(table, limits=(), deviations=(), classes=())  # said in the report's notes
    latest_first = sorted(range(len(geometries)), key=lambda i: geometries[i].recording.run.start, reverse=True)
    judged = {i: exceedances(geometries[i], table, speed) for i in latest_first}
    for i in latest_first:
        found += judged[i][0]
    for i, geometry in enumerate(geometries):
        verdicts.append(tuple(judged[i][1]))
        graded.append(tuple(segments(geometry, table, speed)))
    return Monitored(
        where,
        speed,
        tuple(geometries),
        tuple(overlays),
        tuple(found),
        tuple(verdicts),
        tuple(graded),
        tuple(trends(geometries)),
    )
