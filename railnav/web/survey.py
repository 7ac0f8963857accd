"""Sections of a build's page that a surveyor wants: where to go again, what was a gross error, how well axes repeat."""

from __future__ import annotations

from collections.abc import Mapping
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
    again = [
        (
            str(t["track"]),
            str(p.get("reason", "")),
            f"{p['from_m']:.0f}",
            f"{p['to_m']:.0f}",
            words.length(p.get("sigma_m"), 2),
        )
        for t in build.get("tracks", [])
        for p in t.get("survey_again") or []
    ]
    if again:
        many = f"The first {MOST_ROWS} of {len(again)}." if len(again) > MOST_ROWS else ""
        columns: tuple[str, ...] = ("track", "why", "from, m", "to, m", "largest sigma")
        sections.append(Section("Where to survey again", many, [Table(columns, again[:MOST_ROWS], 2)]))
    verdicts = build.get("verdicts") or {}
    if verdicts.get("list"):
        rows = [
            (
                v["what"], str(v["run"]), str(v["track"]), str(v["reason"]), "" if v["time_s"] is None else f"{v['time_s']:.1f}",
                "" if v["offset_m"] is None else f"{v['offset_m']:.0f}" + (f" to {v['to_m']:.0f}" if "to_m" in v else ""),
                "" if v["size"] is None else f"{v['size']:.4f} rad" if v.get("unit") == "rad" else words.length(v["size"], 3),
                "" if v.get("evidence") is None else f"{v['evidence']:.0f}",
            )
            for v in verdicts["list"][:MOST_ROWS]
        ]  # fmt: skip
        columns = ("what", "run", "track", "why", "time, s", "offset, m", "size", "evidence")
        sections.append(
            Section(
                "Gross errors",
                f"The largest of {verdicts['total']:,}: fixes, stretches on another track, and links (angles, odometer). None of them is "
                "used. Where fixes and increments of one run contradict each other, two clones of its filter went on, one without the "
                "fix, one without the link: evidence is the logarithm of the odds of what is said over the other.",
                [Table(columns, rows, 4)],
            )
        )
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
    return sections


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
