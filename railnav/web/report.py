"""The pages: what a demo, an evaluation, a build or a solution found, each one self-contained HTML text.

They show results and compute none; every text is escaped and nothing is asked of the network (see `railnav.web.page`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.web import figures, words
from railnav.web.page import Card, Code, Figure, Section, Table, Warnings, page

if TYPE_CHECKING:
    from railnav.evaluation import AxisError, Evaluation
    from railnav.navigation.solution import Solution
    from railnav.run import Run
    from railnav.track.model import TrackModel
    from railnav.truth import Truth

FloatArray = NDArray[np.float64]

SIMULATED = "Simulated data"
_HOVER = "Move the pointer along the charts below to move the train in the plan; drag it to pan, zoom with the tools at its upper right."


def solution_page(solution: Solution, model: TrackModel | None = None) -> str:
    """Compose the page of a solution: path, speed, modes, and how sure it is.

    Parameters
    ----------
    solution : Solution
    model : TrackModel, optional
        Drawn beneath the path.

    Returns
    -------
    str
        HTML.

    Raises
    ------
    RailnavError
        If plotly is not installed.
    """
    return page(
        f"Solution {solution.run_id}".strip(),
        subtitle=_when(solution),
        badge=SIMULATED if solution.simulated or (model is not None and is_simulated(model)) else "",
        lead=[solution_words(solution)],
        cards=_solution_cards(solution),
        sections=[
            Section("The line and the train's path, in plan", _HOVER, [figures.plan(model, solution)]),
            Section(
                "Along time",
                "The shaded band is two standard deviations of the position along the track, the orange line the protection "
                "level on either side. No truth is known here: these are the solution's own words.",
                [figures.along_time(solution)],
            ),
            Section("Along the line", "", [figures.along_line(solution, None, model)]),
        ],
    )


def evaluation_page(solution: Solution, truth: Truth, evaluation: Evaluation, model: TrackModel | None = None) -> str:
    """Compose the page of an evaluation: errors along time and along the line, track selection, integrity.

    Parameters
    ----------
    solution : Solution
    truth : Truth
    evaluation : Evaluation
        What `railnav.evaluation.evaluate(solution, truth)` found.
    model : TrackModel, optional
        Drawn beneath the path.

    Returns
    -------
    str
        HTML; labelled as simulated where the truth, the solution or the model says so.

    Raises
    ------
    RailnavError
        If plotly is not installed.
    """
    return page(
        f"Solution {solution.run_id} against the truth".replace("  ", " "),
        subtitle=_when(solution),
        badge=SIMULATED if truth.simulated or solution.simulated or (model is not None and is_simulated(model)) else "",
        lead=evaluation_words(evaluation),
        cards=evaluation_cards(evaluation),
        sections=_evaluation_sections(solution, truth, evaluation, model),
    )


def build_page(model: TrackModel) -> str:
    """Compose the page of a model: the line in plan and profile, and what its build says of itself.

    Parameters
    ----------
    model : TrackModel
        With a build's report in `provenance["build"]`, or without.

    Returns
    -------
    str
        HTML.

    Raises
    ------
    RailnavError
        If plotly is not installed.
    """
    build = model.provenance.get("build")
    total = float(model.lengths.sum())
    lead = [
        f"The model holds {words.count(len(model.track_id), 'track')}, together {words.length(total, 5)} long on the ground, "
        f"and {words.count(len(model.movements), 'permitted movement')} between them."
    ]
    cards = [
        Card("Tracks", f"{len(model.track_id):,}", words.length(total, 5)),
        Card("Plane", model.frame.name, words.accuracy(model.frame.accuracy)),
    ]
    sections = [
        Section("The line in plan", "Drag to pan, zoom with the tools at the upper right.", [figures.plan(model)]),
        Section(
            "Along the tracks",
            "The legend switches tracks on and off. Curvature is positive to the right as the offset grows.",
            [figures.profile(model)],
        ),
    ]
    if isinstance(build, Mapping):
        lead.append(build_words(build))
        sections += build_sections(build)
    badge = SIMULATED if is_simulated(model) else ""
    return page("Reference track model", badge=badge, lead=lead, cards=cards, sections=sections)


def is_simulated(model: TrackModel) -> bool:
    """Whether a model says of itself that it is fictitious, or built from simulated runs."""
    source = str(model.provenance.get("source", ""))
    return bool(model.provenance.get("simulated")) or source.startswith("railnav.simulation")


def build_words(build: Mapping[str, Any]) -> str:
    """Say in one paragraph what a build used and how good its result is."""
    runs = build.get("runs", [])
    total = sum(run["fixes"]["total"] for run in runs)
    used = sum(run["fixes"]["used"] for run in runs)
    sigmas = [track["sigma_cross_m"] for track in build.get("tracks", []) if track.get("sigma_cross_m") is not None]
    text = f"It was built from {words.count(len(runs), 'survey run')} with {words.count(total, 'fix', 'fixes')}, "
    text += f"of which {words.share(used / total if total else None)} were used."
    if sigmas:
        text += f" Its tracks are known to {words.length(float(np.median(sigmas)), 2)} across (one sigma, median)."
    datum = build.get("datum")
    if datum and datum.get("rule"):
        text += f" Datum: {datum['rule']}."
    return text


def rejected(run: Mapping[str, Any]) -> list[str]:
    """Say how many fixes of a run of a build were rejected, and why."""
    return [
        f"{entry['count'] if isinstance(entry, Mapping) else entry:,} {reason}"
        for reason, entry in run["fixes"].get("rejected", {}).items()
    ]


def run_rows(build: Mapping[str, Any]) -> tuple[Sequence[str], list[list[str]], int]:
    """Tabulate the runs of a build: what was used, what was rejected and why, how far its positions stand apart."""
    columns = (
        "run",
        "receiver",
        "direction",
        "rejected because",
        "fixes",
        "used",
        "offset east",
        "north",
        "up",
        "sigma across",
    )
    rows = []
    for run in build.get("runs", []):
        fixes, offset = run["fixes"], run.get("frame_offset") or {}
        reasons = "; ".join(rejected(run))
        rows.append(
            [
                str(run["id"]),
                str(run.get("receiver") or ""),
                str(run.get("direction") or ""),
                reasons,
                f"{fixes['total']:,}",
                words.share(fixes["used"] / fixes["total"]) if fixes["total"] else words.NOTHING,
                *(_signed(offset.get(f"{axis}_m")) for axis in ("east", "north", "up")),
                words.length((run.get("noise") or {}).get("cross_sigma_m"), 2),
            ]
        )
    return columns, rows, 4


def track_rows(build: Mapping[str, Any]) -> tuple[Sequence[str], list[list[str]], int]:
    """Tabulate the tracks of a build: length, accuracy, and where to survey again."""
    columns = ("track", "survey again", "length", "runs", "sigma across", "95 %", "heights")
    rows = []
    for track in build.get("tracks", []):
        again = track.get("survey_again") or []
        first = f"{words.length(again[0]['from_m'])} to {words.length(again[0]['to_m'])}" if again else ""
        rows.append(
            [
                str(track["track"]),
                first + (f" and {len(again) - 1} more" if len(again) > 1 else ""),
                words.exact_length(track["length_m"]),
                f"{len(track.get('runs') or [])}",
                words.length(track.get("sigma_cross_m"), 2),
                words.length(track.get("sigma_cross_95_m"), 2),
                "yes" if track.get("heights") else "no",
            ]
        )
    return columns, rows, 2


def _signed(value: float | None) -> str:
    return words.NOTHING if value is None else f"{'+' if value > 0 else ''}{words.length(value)}"


def build_sections(build: Mapping[str, Any]) -> list[Section]:
    """The sections on a build: its runs, its tracks, where to survey again, gross errors, repeatability, its warnings."""
    from railnav.web.survey import survey_sections

    columns, rows, left = run_rows(build)
    parts: list[Figure | Table | Code | Warnings] = [Table(columns, rows, left)]
    sections = [
        Section(
            "The survey runs",
            "The offset is how far a run's positions stand from the model's datum; sigma across is the robust spread of its fixes "
            "about the model, offset removed.",
            parts,
        )
    ]
    columns, rows, left = track_rows(build)
    sections.append(Section("The tracks", "", [Table(columns, rows[:200], left)]))
    sections += survey_sections(build)
    if build.get("warnings"):
        sections.append(Section("What to know about this build", "", [Warnings([str(w) for w in build["warnings"]])]))
    return sections


def _when(solution: Solution) -> str:
    start = f"Start {solution.start}. " if solution.start else ""
    kind = "smoothed over the whole run" if solution.smoothed else "filtered, as it was known at the time"
    return f"{start}{words.count(len(solution), 'epoch')}, {kind}."


def solution_words(solution: Solution) -> str:
    """Say in one paragraph where a solution has a position, and how sure it is."""
    placed = solution.track >= 0
    text = f"The train has a position on the model at {words.share(float(placed.mean()) if len(placed) else None)} of the epochs"
    sigma = solution.sigma_along[placed & np.isfinite(solution.sigma_along)]
    level = solution.protection_level_along[placed & np.isfinite(solution.protection_level_along)]
    if len(sigma):
        text += f", with a standard deviation along the track of {words.length(float(np.median(sigma)), 2)} (median)"
    if len(level):
        text += (
            f" and a bound of {words.length(float(np.median(level)), 2)} (median) that the error shall exceed with a risk of "
            f"{solution.integrity_risk:g} an epoch"
        )
    return f"{text}."


def _solution_cards(solution: Solution) -> list[Card]:
    from railnav.navigation.solution import Mode

    placed = solution.track >= 0
    tracking = float(np.mean(solution.mode == Mode.TRACKING)) if len(solution) else None
    used = {solution.track_id[int(t)] for t in np.unique(solution.track[placed])}
    return [
        Card(
            "Epochs",
            f"{len(solution):,}",
            words.duration(float(solution.time[-1] - solution.time[0])) if len(solution) else "",
        ),
        Card("Tracking", words.share(tracking), "of the epochs; the rest see the modes below"),
        Card(
            "Distance run", words.length(float(figures.distance_run(solution)[-1])) if len(solution) else words.NOTHING
        ),
        Card("Tracks used", f"{len(used)}", ", ".join(sorted(used)[:4]) + (" ..." if len(used) > 4 else "")),
    ]


def evaluation_words(evaluation: Evaluation) -> list[str]:
    """Say in sentences how good a solution is, and whether it knows."""
    selection, integrity, along = evaluation.selection, evaluation.integrity, evaluation.along_statistics
    if not selection.rows:
        return [f"None of the {words.count(evaluation.epochs, 'epoch')} has a position: there is nothing to judge."]
    where = (
        f"The train was on the right track at {words.share(selection.rate)} of {words.count(selection.rows, 'epoch')} with a "
        f"position ({words.share(evaluation.availability)} of all). Along the track its place was off by "
        f"{words.length(along.rms)} (RMS), by no more than {words.length(along.p95)} at 95 % of the epochs, and by "
        f"{words.length(along.max)} at worst"
    )
    across = evaluation.across_statistics.rms
    where += f"; across the track by {words.length(across, 2)} (RMS)." if across is not None else "."
    if selection.wrong_while_tracking:
        where += f" At {words.count(selection.wrong_while_tracking, 'epoch')} it was sure of a wrong track; the table below says where."
    paragraphs = [where]
    if integrity.rows:
        paragraphs.append(
            f"It claimed an error of no more than {words.length(integrity.median_level)} (median of its protection level, at a "
            f"risk of {integrity.integrity_risk:g} an epoch). The error went beyond its bound at {integrity.events:,} of "
            f"{words.count(integrity.rows, 'epoch')}. {_consistency_words(evaluation)}"
        )
    return paragraphs


def _consistency_words(evaluation: Evaluation) -> str:
    found = evaluation.consistency
    if found.nees is None or found.lower is None or found.upper is None:
        return ""
    verdict = "inside" if found.inside else "outside"
    return (
        f"Its errors are {np.sqrt(found.nees):.2f} times as large as it says (NEES {found.nees:.2f}, {verdict} the bounds "
        f"{found.lower:.2f} to {found.upper:.2f} of an honest filter with {words.figures(found.effective, 2)} independent samples)."
    )


def evaluation_cards(evaluation: Evaluation) -> list[Card]:
    """The key figures of an evaluation."""
    selection, integrity, along = evaluation.selection, evaluation.integrity, evaluation.along_statistics
    coasted = max(evaluation.coasting, key=lambda stretch: stretch.distance, default=None)
    cards = [
        Card(
            "On the right track",
            words.share(selection.rate),
            f"of {words.count(selection.rows, 'epoch')} with a position",
        ),
        Card(
            "Error along the track",
            words.length(along.rms),
            f"RMS; 95 %: {words.length(along.p95)}, worst: {words.length(along.max)}",
        ),
        Card(
            "Error beyond its bound",
            f"{integrity.events:,} of {integrity.rows:,}",
            f"epochs; bound {words.length(integrity.median_level)} in the median, risk {integrity.integrity_risk:g}",
        ),
        Card("Error of the speed", f"{words.figures(evaluation.speed_statistics.rms, 2)} m/s", "RMS"),
    ]
    if coasted is not None:
        cards.append(
            Card(
                "Longest way without GNSS",
                words.length(coasted.distance),
                f"error at its end {words.length(coasted.error_at_end)}, its own sigma {words.length(coasted.sigma_at_end)}",
            )
        )
    return cards


def mode_rows(evaluation: Evaluation) -> tuple[Sequence[str], list[list[str]], int]:
    """Tabulate errors along the track by mode."""
    rows = []
    for mode, count in evaluation.modes.items():
        found = evaluation.along_by_mode.get(mode)
        rows.append(
            [
                mode,
                f"{count:,}",
                words.share(count / evaluation.epochs),
                *(words.length(getattr(found, name, None)) for name in ("mean", "rms", "p95", "max")),
            ]
        )
    return ("mode", "epochs", "share", "mean", "RMS", "95 %", "worst"), rows, 1


def coasting_rows(evaluation: Evaluation) -> tuple[Sequence[str], list[list[str]], int]:
    """Tabulate the stretches without GNSS, the longest first."""
    rows = [
        [
            words.duration(stretch.start),
            words.duration(stretch.end - stretch.start),
            words.length(stretch.distance),
            words.length(stretch.error_at_end),
            words.length(stretch.largest_error),
            words.length(stretch.sigma_at_end),
            words.length(stretch.level_at_end),
        ]
        for stretch in sorted(evaluation.coasting, key=lambda stretch: -stretch.distance)[:20]
    ]
    return (
        ("from", "lasted", "way", "error at its end", "largest error", "sigma at its end", "bound at its end"),
        rows,
        1,
    )


def reliability_rows(evaluation: Evaluation) -> tuple[Sequence[str], list[list[str]], int]:
    """Tabulate stated track probabilities against the share of right rows."""
    rows = [
        [
            f"{100 * c.low:g} to {100 * c.high:g} %",
            f"{c.rows:,}",
            f"{c.effective:.0f}",
            f"{100 * c.stated:.2f} %",
            f"{100 * c.right:.2f} %",
            f"{100 * c.lower:.2f} to {100 * c.upper:.2f} %",
        ]
        for c in evaluation.reliability.classes
    ]
    return ("track probability", "epochs", "independent", "mean stated", "right", "95 % bounds"), rows, 1


def wrong_rows(evaluation: Evaluation) -> tuple[Sequence[str], list[list[str]], int]:
    """Tabulate the stretches on a wrong track, in order."""
    rows = [
        [
            stretch.track,
            stretch.true_track,
            words.duration(stretch.start),
            words.duration(stretch.end - stretch.start),
            f"{stretch.rows:,}",
            f"{stretch.tracking:,}",
        ]
        for stretch in evaluation.selection.wrong[:50]
    ]
    return ("navigated", "truth", "from", "lasted", "epochs", "of them sure"), rows, 2


def _evaluation_sections(
    solution: Solution,
    truth: Truth,
    evaluation: Evaluation,
    model: TrackModel | None,
    *,
    shaded: Sequence[tuple[float, float]] = (),
    surveys: Sequence[tuple[str, FloatArray, FloatArray]] = (),
) -> list[Section]:
    grey = " Grey: no GNSS." if shaded else ""
    path = None
    if model is not None:
        east, north, _ = model.frame.to_grid(truth.latitude, truth.longitude, truth.height)
        path = (east, north)
    sections = [
        Section(
            "The line and the train's path, in plan",
            _HOVER,
            [figures.plan(model, solution, surveys=surveys, truth=path)],
        ),
        Section(
            "Along time",
            "Error along the track (ahead of the truth is positive), inside the band of two standard deviations that the "
            f"solution claims, and its protection level on either side.{grey}",
            [figures.along_time(solution, evaluation, truth, shaded=shaded)],
        ),
        Section(
            "Along the line",
            f"The same along the distance run, above the curvature and height of the track under the train.{grey}",
            [figures.along_line(solution, evaluation, model, shaded=shaded)],
        ),
    ]
    if evaluation.selection.compared_by == "name":
        sections.append(Section("Which track", "", [figures.which_track(solution, truth)]))
    columns, rows, left = wrong_rows(evaluation)
    if rows:
        sections.append(Section("On a wrong track", "", [Table(columns, rows, left)]))
    sections.append(
        Section(
            "Does it know how wrong it is?",
            "Each dot is an epoch: the size of its error against the bound it claimed. Dots above the diagonal are honest; one "
            "below it would be an error beyond its bound.",
            [figures.integrity(evaluation), Table(*mode_rows(evaluation), caption="Errors along the track by mode")],
        )
    )
    if evaluation.reliability.classes:
        sections.append(
            Section(
                "Is the track probability true?",
                "Rows sorted by the track probability that they state, and how many of each class were on the right track. Above "
                "the line the navigator is modest, below it overconfident; the bars allow for rows that repeat one decision.",
                [figures.reliability(evaluation), Table(*reliability_rows(evaluation))],
            )
        )
    columns, rows, left = coasting_rows(evaluation)
    if rows:
        sections.append(Section("Without GNSS", "", [Table(columns, rows, left)]))
    return sections


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
    length = float(figures.distance_run(solution)[-1])
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
        *_evaluation_sections(solution, truth, evaluation, model, shaded=silent, surveys=drawn),
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
