"""The pages: what a demo, an evaluation, a build or a solution found, each one self-contained HTML text.

They show results and compute none; every text is escaped and nothing is asked of the network (see `railnav.web.page`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.web import figures, solution_charts, words
from railnav.web.page import Card, Code, Figure, Section, Table, Warnings, page

if TYPE_CHECKING:
    from railnav.navigation.solution import Solution
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

SIMULATED = "Simulated data"
#: What the pointer does in the plan above charts.
HOVER = "Move the pointer along the charts below to move the train in the plan; drag it to pan, zoom with the tools at its upper right."


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
        subtitle=when_where(solution),
        badge=SIMULATED if solution.simulated or (model is not None and is_simulated(model)) else "",
        lead=[solution_words(solution)],
        cards=_solution_cards(solution),
        sections=[
            Section("The line and the train's path, in plan", HOVER, [figures.plan(model, solution)]),
            Section(
                "Along time",
                "The shaded band is two standard deviations of the position along the track, the orange line the protection "
                "level on either side. No truth is known here: these are the solution's own words.",
                [solution_charts.along_time(solution)],
            ),
            Section("Along the line", "", [solution_charts.along_line(solution, None, model)]),
        ],
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
    columns = ("track", "survey again", "length", "runs", "sigma across", "95 %", "unit weight", "heights")
    rows = []
    for track in build.get("tracks", []):
        again = track.get("survey_again") or []
        first = f"{again[0]['from_m']:,.0f} m to {again[0]['to_m']:,.0f} m" if again else ""
        rows.append(
            [
                str(track["track"]),
                first + (f" and {len(again) - 1} more" if len(again) > 1 else ""),
                words.exact_length(track["length_m"]),
                f"{len(track.get('runs') or [])}",
                words.length(track.get("sigma_cross_m"), 2),
                words.length(track.get("sigma_cross_95_m"), 2),
                words.NOTHING if track.get("unit_weight_rms") is None else f"{track['unit_weight_rms']:.2f}",
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
    told = (
        "Sigma across is that of the axis. Unit weight is the RMS of the whitened residuals: 1 where errors are as they are taken to be, "
        "less where errors that last for seconds are carried as stronger noise."
    )
    sections.append(Section("The tracks", told, [Table(columns, rows[:200], left)]))
    sections += survey_sections(build)
    if build.get("warnings"):
        sections.append(Section("What to know about this build", "", [Warnings([str(w) for w in build["warnings"]])]))
    return sections


def when_where(solution: Solution) -> str:
    """Say when a solution starts and whether it was smoothed."""
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
            "Distance run",
            words.length(float(solution_charts.distance_run(solution)[-1])) if len(solution) else words.NOTHING,
        ),
        Card("Tracks used", f"{len(used)}", ", ".join(sorted(used)[:4]) + (" ..." if len(used) > 4 else "")),
    ]
