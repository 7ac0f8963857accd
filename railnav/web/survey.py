"""Sections of a build's page that a surveyor wants: where to go again, what was a gross error, how well axes repeat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from itertools import pairwise
from typing import Any

from railnav.web import figures, words
from railnav.web.page import Figure, Section, Table

#: Rows of a table on the page.
MOST_ROWS = 60


def survey_sections(build: Mapping[str, Any]) -> list[Section]:
    """Compose the sections; what a report does not hold is left out.

    Parameters
    ----------
    build : mapping
        `model.provenance["build"]`.

    Returns
    -------
    list of Section
    """
    sections = []
    if "tracks" in build:
        sections.append(_again(build["tracks"]))
    found = build.get("repeatability") or []
    if found:
        told = "; ".join(
            f"{r['receiver'] or 'unknown'}: {words.length(r['rms_m'], 3)} RMS, 95 % {words.length(r['q95_m'], 3)}, {r['pairs']} pairs"
            for r in found
        )
        sections.append(
            Section(
                "How well the axis repeats",
                "The axis from one run alone against that from a run of another date by the same kind of receiver, offsets removed. "
                f"{told}.",
                [_histogram(found)],
            )
        )
    verdicts = build.get("verdicts") or {}
    if verdicts.get("list"):
        sections.append(_gross(verdicts))
    return sections


def _again(tracks: Sequence[Mapping[str, Any]]) -> Section:
    """Stretches that deserve another run, or the word that there are none."""
    rows = [
        (
            str(t["track"]),
            str(p.get("reason", "")),
            f"{p['from_m']:,.0f}",
            f"{p['to_m']:,.0f}",
            words.length(p["to_m"] - p["from_m"], 3),
            words.length(p.get("sigma_m"), 2),
        )
        for t in tracks
        for p in t.get("survey_again") or []
    ]
    if not rows:
        return Section(
            "Where to survey again",
            "Nowhere: no stretch is without fixes, rests on one run of several, or is much weaker than its track.",
        )
    many = f"The first {MOST_ROWS} of {len(rows)}." if len(rows) > MOST_ROWS else ""
    columns = ("track", "why", "from, m", "to, m", "length", "largest sigma")
    return Section("Where to survey again", many, [Table(columns, rows[:MOST_ROWS], 2)])


def _gross(verdicts: Mapping[str, Any]) -> Section:
    """Gross errors, the gravest first."""
    rows = [
        (
            str(v["what"]),
            str(v["run"]),
            str(v["track"]),
            str(v["reason"]),
            _span(v["time_s"], v.get("to_time_s"), 1),
            _span(v["offset_m"], v.get("to_m"), 0),
            f"{v['fixes']:,}" if v.get("fixes") else "",
            _size(v),
            "" if v.get("evidence") is None else f"{v['evidence']:.0f}",
        )
        for v in verdicts["list"][:MOST_ROWS]
    ]
    columns = ("what", "run", "track", "why", "time, s", "offset, m", "fixes", "size", "evidence")
    many = f" The table holds the {len(rows)} gravest." if len(verdicts["list"]) > len(rows) else ""
    return Section(
        "Gross errors",
        f"{verdicts['total']:,} fixes, heights, stretches on another track and links (angles, odometer) were set aside; none is used. "
        "Times count from the start of the run. Where fixes and increments of one run contradicted each other, two clones of its filter "
        f"went on, one without the fix, one without the link: evidence is the logarithm of the odds of what is said.{many}",
        [Table(columns, rows, 4)],
    )


def _span(first: float | None, last: float | None, digits: int) -> str:
    if first is None:
        return "" if last is None else f"to {last:,.{digits}f}"
    return f"{first:,.{digits}f}" + ("" if last is None else f" to {last:,.{digits}f}")


def _size(verdict: Mapping[str, Any]) -> str:
    size = verdict["size"]
    if size is None:
        return ""
    return f"{1e3 * size:.1f} mrad" if verdict.get("unit") == "rad" else words.length(size, 3)


def _histogram(found: list[dict[str, Any]]) -> Figure:
    data = []
    for k, r in enumerate(found):
        edges, counts = r["edges_m"], r["counts"]
        total = max(r["points"], 1)
        data.append(
            {
                "type": "bar",
                "name": escape(str(r["receiver"] or "unknown")),
                "x": [0.5 * (a + b) for a, b in pairwise(edges)],
                "width": [b - a for a, b in pairwise(edges)],
                "y": [100.0 * c / total for c in counts],
                "marker": {"color": figures.PALETTE[k % len(figures.PALETTE)], "opacity": 0.55},
                "hovertemplate": "%{x:.3f} m: %{y:.1f} %",
            }
        )
    layout = figures._layout(
        360,
        barmode="overlay",
        xaxis=figures._axis("difference across the track, m"),
        yaxis=figures._axis("share of the points, %"),
    )
    return Figure("repeatability", data, layout)
