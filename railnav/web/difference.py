"""The page of a difference: slews and lifts along each track, their sigmas, and what has moved."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from railnav.web import figures, words
from railnav.web.page import Card, Figure, Section, Table, Warnings, page

if TYPE_CHECKING:
    from railnav.survey.difference import Difference


def difference_page(found: Difference, title: str) -> str:
    """Compose the page of two models compared.

    Parameters
    ----------
    found : Difference
    title : str
        What was compared.

    Returns
    -------
    str
        HTML.
    """
    told = found.summary()
    moved = float(sum(t["moved_m"] for t in told["tracks"]))
    lead = [
        f"{words.count(len(found.tracks), 'track')} compared. "
        + (
            f"{words.count(len(found.stretches), 'stretch', 'stretches')} moved by more than the errors explain, together {moved:.0f} m."
            if found.stretches
            else "No stretch has moved by more than the errors explain."
        )
    ]
    if found.relation != "update":
        c = told["common_shift"]
        lead.append(
            f"As a whole the second model lies {c['east_m'] * 1e3:.1f} mm east, {c['north_m'] * 1e3:.1f} mm north and "
            f"{c['up_m'] * 1e3:.1f} mm above the first: a difference of datums, taken off everywhere below."
        )
    sections = [Section("Warnings", "", [Warnings(found.warnings)])] if found.warnings else []
    if found.stretches:
        rows = [
            (
                s.track, "across" if s.coordinate == "across" else "up", f"{s.first:.0f}", f"{s.last:.0f}", f"{s.shift * 1e3:+.1f}",
                f"{s.sigma * 1e3:.1f}", f"{s.statistic:.0f} ({s.limit:.0f})",
            )
            for s in found.stretches
        ]  # fmt: skip
        columns = ("track", "coordinate", "from, m", "to, m", "shift, mm", "sigma, mm", "chi-square (limit)")
        sections.append(
            Section("Moved", "Slews are positive to the right, lifts upwards.", [Table(columns, rows, left=2)])
        )
    for i, name in enumerate(found.tracks):
        sections.append(
            Section(f"Track {name}", "The band is two standard deviations of the difference.", [_figure(found, i)])
        )
    cards = [
        Card("Moved", f"{moved:.0f} m", words.count(len(found.stretches), "stretch", "stretches")),
        Card("Relation", found.relation, "of the second model to the first"),
    ]
    return page("Where did the track move?", subtitle=title, lead=lead, cards=cards, sections=sections)


def _figure(found: Difference, track: int) -> Figure:
    here = np.flatnonzero(found.track == track)
    data = []
    for axis, value, common, sigma, name, colour in (
        ("y", found.slew, found.common_slew, found.sigma_slew, "slew, mm", figures.PALETTE[0]),
        ("y2", found.lift, found.common_lift, found.sigma_lift, "lift, mm", figures.PALETTE[1]),
    ):
        v, s = 1e3 * (value - common)[here], 1e3 * sigma[here]
        rows = figures.thin(2400, v, s)
        x = found.offset[here][rows] / 1e3
        band = {"yaxis": axis, "showlegend": False, "hoverinfo": "skip", "line": {"width": 0}}
        data.append(figures._line("", x, 2.0 * s[rows], colour, **band))
        data.append(
            figures._line("", x, -2.0 * s[rows], colour, **band, fill="tonexty", fillcolor="rgba(120,130,140,0.18)")
        )
        data.append(figures._line(name, x, v[rows], colour, yaxis=axis, hovertemplate="%{y:.1f} mm"))
        which = "across" if axis == "y" else "up"
        moved = [s for s in found.stretches if s.track == found.tracks[track] and s.coordinate == which]
        if moved:
            ends = np.array([[s.first / 1e3, s.last / 1e3, np.nan] for s in moved]).ravel()
            heights = np.array([[0.0, 0.0, np.nan] for _ in moved]).ravel()
            data.append(
                figures._line(
                    "moved", ends, heights, figures.PALETTE[4], yaxis=axis, showlegend=axis == "y", line={"width": 6}
                )
            )
    layout = figures._layout(
        480,
        xaxis=figures._axis("offset on the track, km", anchor="y2"),
        yaxis=figures._axis("slew, mm", domain=[0.55, 1.0]),
        yaxis2=figures._axis("lift, mm", domain=[0.0, 0.42]),
    )
    return Figure(f"difference-{track}", data, layout)
