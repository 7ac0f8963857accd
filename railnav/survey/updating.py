"""Later runs refine a stored model: no data of the old runs are needed, their square-root records speak for them.

New runs are laid along the stored axes. Their own chain, without the stored one, is compared with it window by window: where the
track was moved, the stored rows of that stretch are forgotten. Then the stored rows take the place of the curvature's random walk in
the chain of the new runs, with the frame offset of the track among the border parameters; receivers that the model knows bring what
it knows of their offsets. What comes out is stored again.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, ModelError, RunError
from railnav.survey.construction import gathered
from railnav.survey.extension import Way, beside, extended, judged_again, laid_anew, told_ways, ways_beyond
from railnav.survey.fixes import FAR, USED
from railnav.survey.laying import Ground, knots_of, lay_runs, refuse_beside, stored_grounds
from railnav.survey.refining import Refinement, known_model
from railnav.survey.renewal import reassembled, renewed, renewed_records, sections_of, with_tables
from railnav.survey.sides import Side
from railnav.survey.surveyed import Surveyed
from railnav.survey.update_report import compose
from railnav.survey.vertical import with_heights
from railnav.track.records import ModelRecords

if TYPE_CHECKING:
    from railnav.run import Progress, Run
    from railnav.survey.report import Survey
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

YEAR_SECONDS = 365.25 * 86400.0
#: New tracks are laid anew so many times.
RELAID = 2
#: Of a run that may extend the model at least this share of its fixes lies on it.
LEAST_SHARE = 0.02


def update(
    model: TrackModel,
    runs: Sequence[Run],
    *,
    crs: str | None = None,
    half_life: float | None = None,
    false_alarm: float = 1e-3,
    extend: bool = False,
    progress: Progress | None = None,
) -> TrackModel:
    """Refine a stored model with later runs; the raw data of the old ones are not needed.

    Parameters
    ----------
    model : TrackModel
        Built or updated by railnav: it carries the square-root records of its surveys.
    runs : sequence of Run
        New drives over its tracks.
    crs : str, optional
        The plane that the model is expected in, anything PROJ knows; refused when it is in another one.
    half_life : float, optional
        Years in which what is stored loses half its weight; by default nothing is lost, and the result is that of all runs together.
    false_alarm : float
        Probability that anywhere along a track a change is seen though nothing has moved.
    extend : bool
        Make track of what runs show beyond the model: lengthen tracks, add new ones and the turnouts that lead to them. Otherwise
        such ways are reported and left out.
    progress : callable, optional
        Called with the stage, how much is done and how much there is.

    Returns
    -------
    TrackModel
        The same tracks, nodes and movements (and more with `extend`); axes, heights and covariances refined. `provenance["updates"]`
        has one more entry: what was used, what was found moved, what was set aside and why (`railnav.survey.update_report.compose`).

    Raises
    ------
    ModelError
        The model carries no records, or its knots were changed since.
    CrsError
        The model is in another plane than `crs`.
    RunError
        No runs, no usable fixes, a run that is in the model already, or one that is of another line.

    Notes
    -----
    Against a build from all runs the axis differs by a small part of its sigma (docs/theory/estimation.md has figures): weights of
    doubtful fixes and the runs' error models are judged by what is there at the time, and of each track the chain nearest to the joint
    distribution is stored. A track that moved as a whole cannot be told from a run whose frame is off.

    References
    ----------
    Specification rail 18.

    Examples
    --------
    >>> import railnav
    >>> update(railnav.demo_line(), [])
    Traceback (most recent call last):
        ...
    railnav.errors.ModelError: the model carries no survey records, so later runs cannot refine it; build it from its runs
    """
    tell = progress or _silent
    records = model.records
    if records is None:
        raise ModelError(
            "the model carries no survey records, so later runs cannot refine it", remedy="build it from its runs"
        )
    if half_life is not None and not half_life > 0:
        raise ModelError(f"a half-life of {half_life} years is not positive")
    _check_plane(model, crs)
    runs = list(runs)
    if not runs:
        raise RunError("no runs to update with", remedy="give one folder or more, each a drive with GNSS")
    _refuse_known(runs, records)
    _refuse_other_datum(model, runs)
    grounds = stored_grounds(model, records)
    survey = gathered(runs, model.frame, tell)
    for run, cause in survey.refused:
        raise RunError(cause, file=run.source or run.id, remedy="leave it out of the update")
    receivers = [*records.across.receivers, *(n for n in survey.receiver_names if n not in records.across.receivers)]
    kind = np.array([receivers.index(name) for name in survey.receivers], np.int64)
    sigma = [known_model(records, name, survey, "across").total for name in survey.receivers]
    labels: dict[str, set[str]] = {name: {name} for name in grounds}
    for known in records.runs:
        for name in known["tracks"]:
            labels.setdefault(name, set()).add(str(known.get("direction", "")))
    tracks = lay_runs(
        grounds, records.joins, labels, survey.fixes, sigma, **({"least_share": LEAST_SHARE} if extend else {})
    )
    ways = ways_beyond(tracks, survey.fixes, sigma)
    joins, extension = records.joins, None
    if extend and ways:
        extension = extended(grounds, records, ways, survey.fixes)
        grounds, joins = extension.grounds, extension.joins
        for name, more in extension.labels.items():
            labels.setdefault(name, set()).update(more)
        tracks = lay_runs(grounds, joins, labels, survey.fixes, sigma, least_share=LEAST_SHARE)
    for t in tracks:
        refuse_beside(t, survey.fixes)
    beyond = told_ways(ways, survey.fixes, extension)
    tell("lay out", 1, 1)
    weight = _age(records, runs, half_life)

    left = [way for way, told in zip(ways, beyond, strict=True) if told["became"] is None]
    across, up = _estimated(records, survey, grounds, tracks, receivers, kind, weight, false_alarm, left, tell)
    for _ in range(RELAID if extension is not None else 0):  # the first course of a new track is one run's
        rises = {s.track.name: s.axis for s in up.sides} if up is not None else {}
        for side in across.sides:
            name = side.track.name
            seen = np.asarray(side.track.profile.present.any(axis=0))
            grounds[name] = laid_anew(grounds[name], side.axis, rises.get(name), seen)
        judged_again(survey.fixes)
        tracks = lay_runs(grounds, joins, labels, survey.fixes, sigma, least_share=LEAST_SHARE)
        across, up = _estimated(records, survey, grounds, tracks, receivers, kind, weight, false_alarm, left, tell)
    for f in survey.fixes:
        f.reason[f.reason == FAR] = USED
    survey.settle_reasons(tracks)
    tell("tabulate", 0, 1)
    out = _refined(model, records, survey, grounds, joins, beyond, tracks, across, up, kind, weight)
    tell("tabulate", 1, 1)
    return out


def _estimated(
    records: ModelRecords,
    survey: Survey,
    grounds: dict[str, Ground],
    tracks: Sequence[Surveyed],
    receivers: list[str],
    kind: IntArray,
    weight: float,
    false_alarm: float,
    left: Sequence[Way],
    tell: Progress,
) -> tuple[Refinement, Refinement | None]:
    """Refine all tracks across, and in height where the model has heights."""
    across = Refinement(records, records.across, "across", receivers, kind, survey)
    across.sides = [_side_across(t, grounds[t.name]) for t in tracks]
    for side in across.sides:
        side.beside = beside(side.track, left)
    across.run(weight, false_alarm, tell)
    if records.up is None:
        return across, None
    up = Refinement(records, records.up, "up", receivers, kind, survey)
    up.sides = [s for s in (_side_up(t, grounds[t.name]) for t in tracks) if s is not None]
    if up.sides:
        up.run(weight, false_alarm, tell)
    return across, up


def _refined(
    model: TrackModel,
    records: ModelRecords,
    survey: Survey,
    grounds: dict[str, Ground],
    joins: tuple[dict[str, Any], ...],
    beyond: list[dict[str, Any]],
    tracks: Sequence[Surveyed],
    across: Refinement,
    up: Refinement | None,
    kind: IntArray,
    weight: float,
) -> TrackModel:
    """Put the refined tracks in the place of the stored ones, and keep what is known now."""
    grown = any(way["became"] for way in beyond)
    stored = {name: float(np.median(np.diff(knots_of(model, records, name).offset))) for name in records.tracks}
    usual = float(np.median(list(stored.values())))
    # a new track that no run follows in the end is none
    followed = {t.name for t in tracks}
    kept = [g for g in grounds.values() if g.known is not None or g.name in followed]
    joins = tuple(j for j in joins if {j["track"], j["parent"]} <= {g.name for g in kept})
    parts = {
        g.name: renewed(model, records, g, across, up, stored.get(g.name, usual), always=bool(joins) or grown)
        for g in kept
    }
    tabled = [part for part in parts.values() if part.table is not None]
    sections, told, names = sections_of(model, records, tabled, joins)
    known = renewed_records(records, survey, tracks, list(parts.values()), across, up, kind, joins, names)
    touched = {name for name, part in parts.items() if part.settled}
    affected = touched | {j["track"] for j in joins if j["parent"] in touched}
    changed = [section for section in told if section.of in affected]
    entry = compose(model, records, survey, across, up, parts, changed, weight, beyond)
    provenance = {**model.provenance, "updates": [*model.provenance.get("updates", []), entry]}
    if any(f.run.simulated for f in survey.fixes):
        provenance["simulated"] = True
    if grown:
        return reassembled(model, records, sections, told, provenance, known)
    return with_tables(model, {section.name: section.table for section in changed}, provenance, known)


def _silent(stage: str, done: int, total: int) -> None:
    pass


def _refuse_other_datum(model: TrackModel, runs: Sequence[Run]) -> None:
    """A model that is fixed to a datum takes runs that are carried to it, and no others."""
    datum = str(model.provenance.get("fixed_to", ""))
    for run in runs:
        if run.gnss is not None and run.gnss.fixed_to != datum:
            carried = f"is fixed to {run.gnss.fixed_to}" if run.gnss.fixed_to else "is fixed to no datum"
            raise RunError(
                f"{carried}, the model {f'to {datum}' if datum else 'to none'}",
                file=run.source or run.id,
                column="gnss.fixed_to",
                remedy=f'write fixed_to = "{datum}" in run.toml' if datum else "build the model anew with it",
            )


def _check_plane(model: TrackModel, crs: str | None) -> None:
    if crs is None:
        return
    import pyproj

    try:
        wanted = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        raise CrsError(f"{crs!r} is no coordinate system that PROJ knows") from error
    if not wanted.equals(pyproj.CRS.from_wkt(model.frame.crs_wkt)):
        raise CrsError(
            f"the model is in {model.frame.name}, not in {wanted.name}: an update keeps the model's plane; name no other, or build "
            "anew in it"
        )


def _refuse_known(runs: Sequence[Run], records: ModelRecords) -> None:
    known = {(r["id"], r["start"]) for r in records.runs}
    seen: set[tuple[str, str]] = set()
    for run in runs:
        key = (run.id, run.start.isoformat())
        if key in known:
            raise RunError(
                f"run {run.id} of {run.start:%Y-%m-%d} is in the model already: it would count twice",
                file=run.source or run.id,
                remedy="leave it out",
            )
        if key in seen:
            raise RunError(f"run {run.id} is given twice", file=run.source or run.id, remedy="give it once")
        seen.add(key)


def _age(records: ModelRecords, runs: Sequence[Run], half_life: float | None) -> float:
    """Share of the stored information that is kept."""
    if half_life is None or not records.runs:
        return 1.0
    last = max(datetime.fromisoformat(r["start"]) for r in records.runs)
    seconds = (min(run.start for run in runs) - last).total_seconds()
    return float(0.5 ** (max(seconds, 0.0) / YEAR_SECONDS / half_life))


def _side_across(t: Surveyed, ground: Ground) -> Side:
    N = len(t.nominal)
    stored = None if ground.known is None else ground.known.across
    return Side(
        track=t,
        stored=stored,
        up=False,
        axis=np.zeros(N),
        design=t.design,
        base=np.zeros(N),
        noise=_noise(None if stored is None else stored.noise, N, ground.first),
        first=ground.first,
    )


def _side_up(t: Surveyed, ground: Ground) -> Side | None:
    """The same in height; None where there are none to refine."""
    if ground.height is None or (ground.known is not None and ground.known.up is None):
        return None
    part = with_heights(t, ground.height)
    if part is None:
        return None
    N = len(t.nominal)
    stored = None if ground.known is None else ground.known.up
    return Side(
        track=part,
        stored=stored,
        up=True,
        axis=np.zeros(N),
        design=np.ones((N, 1)),
        base=np.array(ground.height),
        noise=_noise(None if stored is None else stored.noise, N, ground.first),
        first=ground.first,
    )


def _noise(stored: FloatArray | None, nodes: int, first: int) -> FloatArray:
    """Curvature noise between nodes: the stored one, and its median where the track is new."""
    if stored is None:
        return np.zeros(nodes - 1)
    out = np.full(nodes - 1, float(np.median(stored)))
    out[first : first + len(stored)] = stored
    return out
