"""The page of a difference: slews and lifts along each track, their sigmas, and what has moved."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from railnav.web import figures, words
from railnav.web.page import Card, Figure, Section, Table, Warnings, page

if TYPE_CHECKING:
    from railnav.survey.difference import Difference


#: How the second model comes from the first, in words.
RELATION = {
    "update": "refined from the first",
    "shared": "has runs in common with the first",
    "independent": "is of other runs",
}
#: Lifts and slews are drawn in metres where most are beyond this, m.
IN_METRES = 1.0


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
    notes = [
        *found.warnings,
        *(f"track {t} is in the first model only" for t in found.only_old),
        *(f"track {t} is in the second model only" for t in found.only_new),
    ]
    sections = [Section("Warnings", "", [Warnings(notes)])] if notes else []
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
            Section(
                f"Track {name}" + (f", now {found.partner[i]}" if found.partner[i] != name else ""),
                "The band is two standard deviations of the difference.",
                [_figure(found, i)],
            )
        )
    cards = [
        Card("Moved", f"{moved:.0f} m", words.count(len(found.stretches), "stretch", "stretches")),
        Card("The second model", RELATION[found.relation], ""),
    ]
    return page("Where did the track move?", subtitle=title, lead=lead, cards=cards, sections=sections)


def _figure(found: Difference, track: int) -> Figure:
    here = np.flatnonzero(found.track == track)
    data = []
    lifted = bool(np.isfinite(found.lift[here]).any())
    spread = np.concatenate([np.abs(found.slew[here]), 2.0 * found.sigma_slew[here]])
    spread = spread[np.isfinite(spread)]
    metres = len(spread) > 0 and float(np.quantile(spread, 0.9)) > IN_METRES
    unit, scale = ("m", 1.0) if metres else ("mm", 1e3)
    for axis, value, common, sigma, name, colour in (
        ("y", found.slew, found.common_slew, found.sigma_slew, f"slew, {unit}", figures.PALETTE[0]),
        ("y2", found.lift, found.common_lift, found.sigma_lift, f"lift, {unit}", figures.PALETTE[1]),
    ):
        if axis == "y2" and not lifted:
            continue
        v, s = scale * (value - common)[here], scale * sigma[here]
        rows = figures.thin(2400, v, s)
        x = found.offset[here][rows] / 1e3
        band = {"yaxis": axis, "showlegend": False, "hoverinfo": "skip", "line": {"width": 0}}
        data.append(figures._line("", x, 2.0 * s[rows], colour, **band))
        data.append(
            figures._line("", x, -2.0 * s[rows], colour, **band, fill="tonexty", fillcolor="rgba(120,130,140,0.18)")
        )
        data.append(
            figures._line(
                name, x, v[rows], colour, yaxis=axis, hovertemplate=f"%{{y:.{1 if scale > 1.0 else 2}f}} {unit}"
            )
        )
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
    if not lifted:
        layout = figures._layout(
            280, xaxis=figures._axis("offset on the track, km"), yaxis=figures._axis(f"slew, {unit}"), showlegend=False
        )
        return Figure(f"difference-{track}", data, layout)
    layout = figures._layout(
        480,
        xaxis=figures._axis("offset on the track, km", anchor="y2"),
        yaxis=figures._axis(f"slew, {unit}", domain=[0.55, 1.0]),
        yaxis2=figures._axis(f"lift, {unit}", domain=[0.0, 0.42]),
    )
    return Figure(f"difference-{track}", data, layout)
