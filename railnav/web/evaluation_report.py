"""The page of an evaluation: errors along time and along the line, track selection, integrity, in words, cards and tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.web import figures, solution_charts, words
from railnav.web.page import Card, Section, Table, page
from railnav.web.report import HOVER, SIMULATED, is_simulated, when_where

if TYPE_CHECKING:
    from railnav.evaluation import Evaluation
    from railnav.navigation.solution import Solution
    from railnav.track.model import TrackModel
    from railnav.truth import Truth

FloatArray = NDArray[np.float64]


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
        subtitle=when_where(solution),
        badge=SIMULATED if truth.simulated or solution.simulated or (model is not None and is_simulated(model)) else "",
        lead=evaluation_words(evaluation),
        cards=evaluation_cards(evaluation),
        sections=evaluation_sections(solution, truth, evaluation, model),
    )


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


def evaluation_sections(
    solution: Solution,
    truth: Truth,
    evaluation: Evaluation,
    model: TrackModel | None,
    *,
    shaded: Sequence[tuple[float, float]] = (),
    surveys: Sequence[tuple[str, FloatArray, FloatArray]] = (),
) -> list[Section]:
    """Compose the charts and tables of an evaluation; periods that are `shaded` are those without GNSS."""
    grey = " Grey: no GNSS." if shaded else ""
    path = None
    if model is not None:
        east, north, _ = model.frame.to_grid(truth.latitude, truth.longitude, truth.height)
        path = (east, north)
    sections = [
        Section(
            "The line and the train's path, in plan",
            HOVER,
            [figures.plan(model, solution, surveys=surveys, truth=path)],
        ),
        Section(
            "Along time",
            "Error along the track (ahead of the truth is positive), inside the band of two standard deviations that the "
            f"solution claims, and its protection level on either side.{grey}",
            [solution_charts.along_time(solution, evaluation, truth, shaded=shaded)],
        ),
        Section(
            "Along the line",
            f"The same along the distance run, above the curvature and height of the track under the train.{grey}",
            [solution_charts.along_line(solution, evaluation, model, shaded=shaded)],
        ),
    ]
    if evaluation.selection.compared_by == "name":
        sections.append(Section("Which track", "", [solution_charts.which_track(solution, truth)]))
    columns, rows, left = wrong_rows(evaluation)
    if rows:
        sections.append(Section("On a wrong track", "", [Table(columns, rows, left)]))
    sections.append(
        Section(
            "Does it know how wrong it is?",
            "Each dot is an epoch: the size of its error against the bound it claimed. Dots above the diagonal are honest; one "
            "below it would be an error beyond its bound.",
            [
                solution_charts.integrity(evaluation),
                Table(*mode_rows(evaluation), caption="Errors along the track by mode"),
            ],
        )
    )
    if evaluation.reliability.classes:
        sections.append(
            Section(
                "Is the track probability true?",
                "Rows sorted by the track probability that they state, and how many of each class were on the right track. Above "
                "the line the navigator is modest, below it overconfident; the bars allow for rows that repeat one decision.",
                [solution_charts.reliability(evaluation), Table(*reliability_rows(evaluation))],
            )
        )
    columns, rows, left = coasting_rows(evaluation)
    if rows:
        sections.append(Section("Without GNSS", "", [Table(columns, rows, left)]))
    return sections
