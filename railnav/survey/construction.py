"""Survey runs become a reference track model: the story of a build.

Fixes come into the grid; runs that follow one another make a line, and the runs of a line its tracks; along a nominal curve each
run becomes a profile of distances to the right; what runs differ by shows their frame offsets and how they err; the chain
across, with all that beside it, gives the axis; the axis becomes the next nominal curve. Heights go the same way. At the end
the axes are tabulated by true ground length, with their covariances and a report.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RunError
from railnav.survey import report, surveyed
from railnav.survey.angles import slopes_of
from railnav.survey.attribution import attribute
from railnav.survey.axis import solve, sweep, unit_weight_rms
from railnav.survey.fixes import Fixes, gather
from railnav.survey.joining import join_tracks
from railnav.survey.layout import COARSE_STEP, Join, lay_out
from railnav.survey.noise import error_models, run_models
from railnav.survey.nominal import course
from railnav.survey.offsets import Offsets, differences, settle
from railnav.survey.stored import keep_build
from railnav.survey.surveyed import Surveyed
from railnav.survey.tabulation import tabulate
from railnav.survey.vertical import Heights, estimate_heights, measured_cant

if TYPE_CHECKING:
    from railnav.geodesy.grid import GridFrame
    from railnav.run import Progress, Run
    from railnav.track.alignment import KnotTable
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Smoothing of the first nominal curves (Gaussian sigma), m.
SMOOTHING = (40.0, 20.0)
#: What runs may be off before anything is known of them, m.
FIRST_SPREAD = 20.0
#: Estimations; the first `RELAID` of them each give a new nominal curve.
ROUNDS, RELAID = 4, 2
#: With angles in a gap the nominal curve is laid anew until it moves by less than this, m, at most so many times.
SETTLED, MOST_RELAID = 0.1, 8
#: How far the first guess of an axis may be off, m: no verdict on runs within that.
FIRST_SLACK = 1.0
#: Runs farther apart than this, degrees of latitude or longitude, are not of one survey.
FARTHEST_DEG = 0.5
#: A run that moves less than this surveys nothing, m.
SHORTEST = 200.0


def build(
    runs: Sequence[Run],
    *,
    crs: str | None = None,
    zone_width: Literal[3, 6] = 6,
    ellipsoid: str = "wgs84",
    spacing: float = 1.0,
    progress: Progress | None = None,
) -> TrackModel:
    """Build a reference track model from survey runs.

    Each track is a square-root chain along a nominal curve (state: distance to the right, slope, curvature correction, and one
    correlated error a run), with the runs' frame offsets as border parameters of all chains. Only distances across the track
    are used, so that uneven time stamps do not matter; a stop weighs no more than a pass; error models come from the
    differences of runs; doubtful fixes lose weight, gross ones and stretches on another track are set aside and reported.

    Parameters
    ----------
    runs : sequence of Run
        Drives with GNSS, in any number and direction. `Run.direction` names the track of a double line; without it geometry
        decides.
    crs : str, optional
        Any projected coordinate system that PROJ knows; default: the Gauss-Krueger zone that fits.
    zone_width : {6, 3}
        Width of that zone, degrees.
    ellipsoid : str
        Its ellipsoid (see `railnav.geodesy.grid.choose_frame`).
    spacing : float
        Distance between knots, m.
    progress : callable, optional
        Called with the stage, how much is done and how much there is.

    Returns
    -------
    TrackModel
        One track a direction (or as the data tell), offsets growing as the first run of the line went. `covariance_g` is that of
        the axis relative to the model's datum. `provenance["build"]` is the report (keys: `railnav.survey.report`).

    Raises
    ------
    RunError
        No run, no usable fixes, a run in another part of the world.
    CrsError
        No plane fits.

    Notes
    -----
    What all runs of a track have in common shows in no difference: the datum is a weighted mean of the kinds of receiver (two that
    differ count the same, of three the majority counts), and its uncertainty is stated beside the model, not in the knots. Tracks
    shorter than a few hundred metres, loops that touch themselves and lines that branch are not resolved: each run belongs to
    one track along its whole way, apart from stretches set aside.

    References
    ----------
    Specification rail 4 to 6 and 15 to 18.

    Examples
    --------
    >>> from railnav.survey import build
    >>> build([])
    Traceback (most recent call last):
        ...
    railnav.errors.RunError: no runs to build from; give one folder or more, each a drive with GNSS
    """
    runs = list(runs)
    tell = progress or _silent
    _refuse_strangers(runs)
    frame = _frame(runs, crs, zone_width, ellipsoid)
    survey = gathered(runs, frame, tell)
    tracks, joins = lay_out(survey)
    tell("lay out", 1, 1)
    tracks, offsets = _compared(survey, tracks)
    tell("compare", 1, 1)
    tracks, offsets = _estimated(survey, tracks, offsets, tell)
    heights, up = estimate_heights(tracks, survey.receivers, survey.kind, survey.stated_up)
    survey.settle_reasons(tracks)
    return _assembled(survey, tracks, joins, offsets, heights, up, frame, spacing, tell)


def _silent(stage: str, done: int, total: int) -> None:
    pass


def _refuse_strangers(runs: Sequence[Run]) -> None:
    """Refuse runs that cannot be of one survey: by boxes that touch within half a degree."""
    if not runs:
        raise RunError("no runs to build from", remedy="give one folder or more, each a drive with GNSS")
    boxes = []
    for run in runs:
        gnss = run.gnss
        if gnss is None or len(gnss) == 0:
            raise RunError("no GNSS fixes", file=run.source or run.id, remedy="leave this run out of the build")
        low, high = (np.degrees([np.quantile(gnss.latitude, q), np.quantile(gnss.longitude, q)]) for q in (0.02, 0.98))
        boxes.append((low, high))
    group = list(range(len(runs)))
    for i, (low_i, high_i) in enumerate(boxes):
        for j, (low_j, high_j) in enumerate(boxes[:i]):
            if (low_i <= high_j + FARTHEST_DEG).all() and (low_j <= high_i + FARTHEST_DEG).all():
                old, new = group[i], group[j]
                group = [new if g == old else g for g in group]
    sizes = {g: group.count(g) for g in group}
    home = max(sizes, key=lambda g: (sizes[g], -group.index(g)))
    for run, g, (low, high) in zip(runs, group, boxes, strict=True):
        if g != home:
            middle = 0.5 * (low + high)
            there = runs[group.index(home)]
            raise RunError(
                f"the run lies around latitude {middle[0]:.2f}, longitude {middle[1]:.2f} deg, far from {there.id} and the others",
                file=run.source or run.id,
                remedy="build lines in different places one by one",
            )


def _frame(runs: Sequence[Run], crs: str | None, zone_width: Literal[3, 6], ellipsoid: str) -> GridFrame:
    from railnav.geodesy.grid import choose_frame

    fixed = {run.gnss.fixed_to: run.id for run in runs if run.gnss is not None and run.gnss.fixed_to}
    if len(fixed) > 1:
        named = ", ".join(f"{datum} ({run})" for datum, run in sorted(fixed.items()))
        raise RunError(
            f"runs are fixed to several datums: {named}", column="gnss.fixed_to", remedy="fix all to one of them"
        )
    latitude = np.concatenate([r.gnss.latitude[:: max(1, len(r.gnss) // 500)] for r in runs if r.gnss is not None])
    longitude = np.concatenate([r.gnss.longitude[:: max(1, len(r.gnss) // 500)] for r in runs if r.gnss is not None])
    return choose_frame(latitude, longitude, crs=crs, zone_width=zone_width, ellipsoid=ellipsoid)


def gathered(runs: Sequence[Run], frame: GridFrame, tell: Progress) -> report.Survey:
    """Bring all runs into the grid; a run with too few fixes stays out, unless it is the only one."""
    fixes: list[Fixes] = []
    courses: list[FloatArray] = []
    refused: list[tuple[Run, str]] = []
    for i, run in enumerate(runs):
        tell("gather", i, len(runs))
        try:
            found = gather(run, frame)
        except RunError as error:
            if len(runs) == 1:
                raise
            refused.append((run, error.cause))
            continue
        way = course(found)
        length = float(np.hypot(*np.diff(way, axis=0).T).sum()) if len(way) > 1 else 0.0
        if length < SHORTEST:
            cause = f"it moves over {length:.0f} m only; a survey needs {SHORTEST:.0f} m"
            if len(runs) == 1:
                raise RunError(cause, file=run.source or run.id)
            refused.append((run, cause))
            continue
        found.attributed = attribute(found)
        fixes.append(found)
        courses.append(way)
    tell("gather", len(runs), len(runs))
    if not fixes:
        run, cause = refused[0]
        raise RunError(f"no run can be used: {cause}", file=run.source or run.id)
    return report.Survey(fixes, courses, refused)


def _compared(survey: report.Survey, tracks: list[Surveyed]) -> tuple[list[Surveyed], Offsets]:
    """From differences between runs alone: frame offsets, error models, and a nominal curve along the middle of each track."""
    kinds = len(survey.receiver_names)
    coarse = max(COARSE_STEP, 1.25 * max(surveyed.fix_spacing(t) for t in tracks))
    nowhere = np.zeros((len(survey.fixes), 2))

    def compare(scale: float) -> Offsets:
        known = []
        for t in tracks:
            value = surveyed.reduced(t, nowhere, coarse).value
            node = np.minimum(np.arange(value.shape[1]) * coarse / t.nominal.step, len(t.nominal) - 1).astype(np.int64)
            known.append(differences(value, t.design[node], t.runs))
        return settle(known, survey.kind, np.full(kinds, scale), 2)

    spread = FIRST_SPREAD
    offsets = compare(1.0)
    for turn, width in enumerate(SMOOTHING):
        for t in tracks:
            t.axis = surveyed.middle_axis(t, offsets.run, spread, coarse, width)
        offsets = compare(1.0 if turn == 0 else 0.3 * spread)
        samples = [surveyed.reduced(t, offsets.run, coarse, survey.receivers) for t in tracks]
        survey.models, survey.assumed = error_models(samples, survey.stated)
        spread = max(m.total for m in survey.models.values())
        last = turn == len(SMOOTHING) - 1
        for i, t in enumerate(tracks):
            t.errors = run_models(samples[i], survey.models)
            tracks[i] = surveyed.relaid(t, survey.fixes, step=step_for(spread) if last else None)
    return tracks, offsets


def step_for(spread: float) -> float:
    """Distance between nodes that goes with the accuracy of the runs, m."""
    return 5.0 if spread < 0.2 else 10.0 if spread < 1.0 else COARSE_STEP


def _estimated(
    survey: report.Survey, tracks: list[Surveyed], offsets: Offsets, tell: Progress
) -> tuple[list[Surveyed], Offsets]:
    """Estimate axes and frame offsets together, weights from the round before."""
    scale = np.array([0.5 * survey.models[name].correlated for name in survey.receiver_names])
    turn, left = 0, ROUNDS - RELAID
    while left:
        tell("estimate", min(turn, ROUNDS - 1), ROUNDS)
        slack = FIRST_SLACK if turn == 0 else 0.0
        chains = []
        for t in tracks:
            surveyed.reject(t, offsets.run, slack)
            t.slopes = slopes_of(t, t.axis)
            if t.noise_level == 0.0:
                t.noise_level = surveyed.choose_noise(surveyed.cross_chain(t, offsets.run, slack, level=1e-4))
            chains.append(surveyed.cross_chain(t, offsets.run, slack))
        swept = [sweep(chain) for chain in chains]
        offsets = settle([surveyed.know(t, s) for t, s in zip(tracks, swept, strict=True)], survey.kind, scale, 2)
        for i, t in enumerate(tracks):
            who = (np.array(t.runs)[:, None] * 2 + np.arange(2)).ravel()
            t.estimate = solve(
                chains[i], swept[i], offsets.run.ravel()[who], offsets.covariance[np.ix_(who, who)], sure=True
            )
            t.axis = t.estimate.state[:, 0]
            t.unit_weight = unit_weight_rms(chains[i], swept[i], offsets.run.ravel()[who])
            t.noise = surveyed.free_in_gaps(t, surveyed.local_noise(t.estimate, t.noise_level, t.nominal.step))
        # a tunnel's first curve is a guess: where angles lead through it, it is laid until it stays
        astray = any(t.slopes is not None and float(np.abs(t.axis).max()) > SETTLED for t in tracks)
        again = turn < RELAID or (astray and turn < MOST_RELAID)
        tracks = [surveyed.relaid(t, survey.fixes) if again else surveyed.cut_ends(t) for t in tracks]
        turn, left = turn + 1, left if again else left - 1
    tell("estimate", ROUNDS, ROUNDS)
    return tracks, offsets


def _assembled(
    survey: report.Survey,
    tracks: list[Surveyed],
    joins: list[Join],
    offsets: Offsets,
    heights: list[Heights | None],
    up: Offsets | None,
    frame: GridFrame,
    spacing: float,
    tell: Progress,
) -> TrackModel:
    """Tabulate the axes by true ground length and put the model together."""
    from railnav.track.assembly import assemble

    tables: list[KnotTable] = []
    for i, (t, h) in enumerate(zip(tracks, heights, strict=True)):
        tell("tabulate", i, len(tracks))
        assert t.estimate is not None
        tables.append(
            tabulate(
                t.nominal,
                t.axis,
                t.estimate.covariance[:, 0, 0],
                offsets.common(t.runs),
                None if h is None else (h.height, h.variance),
                measured_cant(t),
                frame,
                spacing,
            )
        )
    tell("tabulate", len(tracks), len(tracks))
    provenance: dict[str, Any] = {"made_by": "railnav build"}
    if any(f.run.simulated for f in survey.fixes):
        provenance["simulated"] = True
    fixed = sorted({f.run.gnss.fixed_to for f in survey.fixes if f.run.gnss is not None and f.run.gnss.fixed_to})
    if fixed:  # one: several are refused at the start
        provenance["fixed_to"] = fixed[0]
    sections, parts = join_tracks([t.name for t in tracks], tables, joins)
    text = report.compose(survey, tracks, offsets, heights, up, tables)
    loose = [f.run.id for f in survey.fixes if f.run.gnss is not None and f.run.gnss.fixed_to not in fixed]
    if fixed and loose:
        text["warnings"].append(
            f"the model is fixed to {fixed[0]}, but {', '.join(loose[:5])}{', ...' if len(loose) > 5 else ''} "
            f"{'is' if len(loose) == 1 else 'are'} not: give fixed_to in every run.toml"
        )
    if joins:
        text["parts"] = parts
        text["warnings"].append(
            f"runs part in {len(joins)} places: turnouts were made there, and their tracks meet in nodes"
        )
    records = keep_build(survey, tracks, joins, parts, offsets, heights, up)
    return assemble(
        frame,
        sections,
        join_within=0.05 if joins else 0.5,
        provenance={**provenance, "build": text},
        record_source=lambda: records,
    )
