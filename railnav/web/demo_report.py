"""The page of the demo: the whole way from simulated survey runs to a train's position and its error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.web import figures, solution_charts, words
from railnav.web.evaluation_report import evaluation_cards, evaluation_sections, evaluation_words
from railnav.web.page import Card, Code, Section, Table, page
from railnav.web.report import SIMULATED, build_sections, build_words

if TYPE_CHECKING:
    from railnav.evaluation import AxisError, Evaluation
    from railnav.navigation.solution import Solution
    from railnav.run import Run
    from railnav.track.model import TrackModel
    from railnav.truth import Truth

FloatArray = NDArray[np.float64]


def demo_page(
    *,
    model: TrackModel,
    surveys: Sequence[Run],
    service: Run,
    solution: Solution,
    truth: Truth,
    evaluation: Evaluation,
    smoothed: Evaluation,
    axis_error: AxisError,
    steps: Sequence[tuple[str, float]],
    commands: Sequence[str],
    seed: int,
) -> str:
    """Compose the page of the demo: the whole way from simulated survey runs to a train's position and its error.

    Parameters
    ----------
    model : TrackModel
        Built from the surveys; its report in `provenance["build"]`.
    surveys : sequence of Run
    service : Run
        The train in service.
    solution : Solution
        Of the service run on the model, filtered.
    truth : Truth
    evaluation, smoothed : Evaluation
        Of the filtered and of the smoothed solution.
    axis_error : AxisError
        Of the built axis against the true one.
    steps : sequence of (name, seconds)
        What was done, and how long it took.
    commands : sequence of str
        What to type next.
    seed : int
        Of the simulation.

    Returns
    -------
    str
        HTML, labelled as simulated.

    Raises
    ------
    RailnavError
        If plotly is not installed.
    """
    silent = gnss_gaps(service)
    drawn = [(f"fixes of {run.id}", *_fixes(run, model)) for run in surveys if run.gnss is not None]
    build = model.provenance.get("build") or {}
    fixes = sum(len(run.gnss) for run in surveys if run.gnss is not None)
    length = float(solution_charts.distance_run(solution)[-1])
    lead = [
        f"Everything on this page is simulated. A survey car ran {words.count(len(surveys), 'time')} over a fictitious double line; "
        f"from its {fixes:,} satellite fixes railnav built a reference track model of {words.count(len(model.track_id), 'track')}, "
        f"{words.length(float(model.lengths.sum()), 4)} in all. Its axis lies within {words.length(axis_error.rms, 2)} "
        f"(RMS) of the true one under open sky; in the tunnels, where the survey saw no satellites, it is off by up to "
        f"{words.length(axis_error.tunnel_max, 2)}, and says so. A train in service then ran {words.length(length)} over "
        f"the model with an everyday receiver, an odometer and an inertial sensor, {words.count(len(silent), 'time')} without satellites.",
        *evaluation_words(evaluation),
    ]
    cards = [
        Card(
            "Axis of the built model",
            words.length(axis_error.rms, 2),
            f"RMS from the true axis under open sky; worst: {words.length(axis_error.max, 2)}",
        ),
        *evaluation_cards(evaluation),
    ]
    both = [
        [
            name,
            words.share(found.selection.rate),
            words.length(found.along_statistics.rms),
            words.length(found.along_statistics.p95),
            words.length(found.along_statistics.max),
            words.figures(found.consistency.nees),
            f"{found.integrity.events:,} of {found.integrity.rows:,}",
        ]
        for name, found in (
            ("as it was known at the time (filtered)", evaluation),
            ("with the whole run (smoothed)", smoothed),
        )
    ]
    columns = ("solution", "right track", "RMS along", "95 %", "worst", "NEES", "beyond the bound")
    sections = [
        *evaluation_sections(solution, truth, evaluation, model, shaded=silent, surveys=drawn),
        Section("At the time, and afterwards", "", [Table(columns, both)]),
        Section(
            "The model that the train runs on",
            build_words(build) if build else "",
            [figures.profile(model)],
        ),
        *(build_sections(build) if build else []),
        Section(
            "Go on from here",
            "The folder of this page holds the model (line.gpkg, opens in QGIS), the runs, the truth and the solution.",
            [Code(commands)],
        ),
        Section(
            "How this page was made",
            "",
            [Table(("step", "seconds"), [[name, f"{seconds:.1f}"] for name, seconds in steps])],
        ),
    ]
    return page(
        "A train, held to its track",
        subtitle="From survey runs to a reference track model, from a run to a train's position, and how far off it is",
        badge=SIMULATED,
        lead=lead,
        cards=cards,
        sections=sections,
        footer=f"Simulated by railnav demo, seed {seed}. The line is fictitious; the figures show what the program does on data of "
        "this kind, not what a real line gives.",
    )


def gnss_gaps(run: Run, *, longer_than: float = 5.0) -> list[tuple[float, float]]:
    """Times between fixes that lie further apart than so many seconds: (from, to), s."""
    if run.gnss is None:
        return []
    time = run.gnss.time
    before = np.flatnonzero(np.diff(time) > longer_than)
    return [(float(time[k]), float(time[k + 1])) for k in before]


def _fixes(run: Run, model: TrackModel) -> tuple[FloatArray, FloatArray]:
    """Some of a run's fixes in the model's plane."""
    assert run.gnss is not None
    rows = np.linspace(0, len(run.gnss) - 1, min(len(run.gnss), 1500)).astype(np.int64)
    easting, northing, _ = model.frame.to_grid(run.gnss.latitude[rows], run.gnss.longitude[rows])
    return easting, northing
