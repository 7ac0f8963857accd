"""The page of alignments: plan, curvature, cant, gradient and height along chainage, and tables of elements."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.design import Design
from railnav.track.elements import ARC, CLOTHOID, STRAIGHT
from railnav.web import figures
from railnav.web.bands import CANT, RIGHT, RISE, Drawn, gradient_bars, radius_words
from railnav.web.page import Card, Figure, Section, Table, Warnings, page

if TYPE_CHECKING:
    from railnav.monitoring.fitting import Fitted

FloatArray = NDArray[np.float64]

#: Metres between points of drawn curves, and most points of one.
_STEP, _MOST = 2.0, 20_000


def alignment_page(
    tracks: Sequence[Drawn],
    *,
    title: str = "Alignment",
    badge: str = "",
    subtitle: str = "",
    warnings: Sequence[str] = (),
) -> str:
    """Compose the page of alignments: bands along chainage, plan, and tables of elements.

    Parameters
    ----------
    tracks : sequence of Drawn
        Designs with their elements, or tracks of a model as they are.
    title, badge, subtitle : str
    warnings : sequence of str
        What a user should know first, besides what the fits say.

    Returns
    -------
    str
        HTML.

    Raises
    ------
    RailnavError
        If plotly is not installed.
    """
    sections = []
    said = [*warnings, *(line for one in tracks if one.fitted is not None for line in one.fitted.warnings)]
    for i, one in enumerate(tracks):
        words = "Curves to the right stand above the axis, to the left below it"
        words += "; sloping sides are transitions. " if one.plan else ". "
        words += "Stations are lengths in the plane. Drag to zoom: all strips move together."
        if one.fitted is not None:
            words += " " + fit_words(one.fitted)
        if not one.plan:
            words += " " + own_words(one)
        parts: list[Any] = [_strips(one, i), _page_plan(one, i)]
        if one.design is not None:
            parts.append(_table(one.design, one.fitted))
            if one.has_profile:
                parts.append(_profile_table(one.design))
        sections.append(Section(f"Track {one.track}", words, parts))
    if said:
        sections.insert(0, Section("What to know", "", [Warnings(said)]))
    count = sum(len(one.plan) for one in tracks)
    return page(
        title,
        subtitle=subtitle,
        badge=badge,
        cards=[
            Card("Tracks", str(len(tracks))),
            Card("Length", f"{sum(one.length for one in tracks) / 1e3:.2f} km"),
            *([Card("Elements", str(count), "of the plan")] if count else []),
            *_radius_card([one.design for one in tracks if one.design is not None]),
        ],
        sections=sections,
    )


def own_words(one: Drawn) -> str:
    """Say in words what a track without elements shows."""
    text = "These are the model's own curvature, cant and gradient; elements were not fitted (railnav alignment, or --elements)."
    if np.isfinite(one.accuracy) and one.accuracy > 0.02:
        text += (
            f" The model states {one.accuracy:.2g} m across the track: short waves of these curves are its errors, not the track's "
            "shape."
        )
    return text


def fit_words(fitted: Fitted) -> str:
    """Say in words how the points lie about the fitted axis."""
    noise = fitted.noise
    white = float(np.mean(noise.sigma))
    waves = f" and waves of {1e3 * noise.correlated:.3g} mm over {noise.length:.0f} m" if noise.correlated > 0.0 else ""
    text = (
        f"The points lie {1e3 * float(np.sqrt(np.mean(fitted.residual**2))):.3g} mm from the axis (root mean square); their noise is "
        f"{1e3 * white:.3g} mm white{waves}."
    )
    if abs(fitted.scale - 1.0) > 1e-6:
        text += (
            f" A metre on the ground is {fitted.scale:.7f} m in the plane: a radius of 1000 m there is {1000.0 / fitted.scale:.3f} m on "
            "the ground."
        )
    return text


def _radius_card(designs: Sequence[Design]) -> list[Card]:
    arcs = [np.abs(d.plan.curvature_start[d.plan.kind == ARC]) for d in designs]
    sharp = max((float(a.max()) for a in arcs if len(a)), default=0.0)
    return [Card("Smallest radius", f"{1.0 / sharp:.0f} m")] if sharp > 0.0 else []


def _places(one: Drawn) -> FloatArray:
    """Stations at which curves are drawn."""
    return np.linspace(one.start, one.end, int(np.clip(one.length / _STEP, 2, _MOST)))


def _strips(one: Drawn, i: int) -> Figure:
    edges = one.joints
    s = np.unique(np.concatenate([_places(one), edges, edges[1:-1] + 1e-6]))
    here = one.inside(s)
    km = np.round(s / 1e3, 6)
    rows: list[tuple[str, list[dict[str, Any]]]] = []
    bars = one.plan
    curve = figures._line(
        "curvature",
        km,
        np.round(1e3 * here.curvature, 6),
        figures.INK,
        fill="tozeroy",
        fillcolor="rgba(27,108,168,0.18)",
    )
    curve |= {"showlegend": False, "hovertemplate": "%{y:.4f} 1/km<extra></extra>"}
    curves = [curve]
    if bars:
        own = np.clip(np.searchsorted(edges, s, side="left") - 1, 0, len(bars) - 1)
        words = [escape(bar.words) for bar in bars]
        curve |= {"text": [words[k] for k in own.tolist()], "hovertemplate": "%{y:.4f} 1/km<br>%{text}<extra></extra>"}
        curves.append(
            {
                "type": "scatter", "mode": "text", "x": [0.5e-3 * (b.begin + b.end) for b in bars],
                "y": [0.5e3 * (b.first + b.last) for b in bars],
                "text": [escape(b.short).replace("\n", "<br>") if b.kind == "arc" else "" for b in bars],
                "textposition": ["top center" if b.first + b.last >= 0 else "bottom center" for b in bars],
                "textfont": {"size": 10}, "hoverinfo": "skip", "showlegend": False,
            }
        )  # fmt: skip
    rows.append(("curvature, 1/km", curves))
    more: dict[str, Any] = {"showlegend": False}
    if one.has_cant:
        cant = np.round(1e3 * here.cant, 2)
        rows.append(("cant, mm", [figures._line("cant", km, cant, CANT, fill="tozeroy", **more)]))
    if one.has_profile:
        gradient = np.round(1e3 * here.gradient, 4)
        rows.append(("gradient, \u2030", [figures._line("gradient", km, gradient, RISE, fill="tozeroy", **more)]))
        rows.append(("height, m", [figures._line("height", km, np.round(here.height, 4), RISE, **more)]))
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = figures._layout(170 * len(rows) + 90, hovermode="x unified")
    gap, n = 0.04, len(rows)
    for k, (name, traces) in enumerate(rows):
        suffix = "" if k == 0 else str(k + 1)
        top = 1.0 - k * (1.0 + gap) / n
        data += [trace | {"xaxis": "x", "yaxis": f"y{suffix}"} for trace in traces]
        layout[f"yaxis{suffix}"] = figures._axis(name, domain=[max(top - (1.0 + gap) / n + gap, 0.0), min(top, 1.0)])
    layout["xaxis"] = figures._axis("station, km", anchor=f"y{'' if n == 1 else n}")
    top = 1.8e3 * one.sharpest
    layout["yaxis"]["range"] = [-top, top]
    return Figure(f"strips{i}", data, layout)


def _page_plan(one: Drawn, i: int) -> Figure:
    here = one.at(_places(one))
    east, north = np.round(here.easting, 2), np.round(here.northing, 2)
    data = [figures._line("axis", east, north, figures.INK, showlegend=False, hoverinfo="skip")]
    if one.plan:
        joints = one.inside(one.joints[:-1])
        data.append(
            {
                "type": "scatter", "mode": "markers", "x": joints.easting, "y": joints.northing,
                "text": [escape(bar.words) for bar in one.plan], "marker": {"size": 6, "color": RIGHT}, "showlegend": False,
                "customdata": (one.joints[:-1] / 1e3).tolist(),
                "hovertemplate": "from %{customdata:.3f} km: %{text}<extra></extra>",
            }
        )  # fmt: skip
    layout = figures._layout(420, hovermode="closest")
    layout["xaxis"] = figures._axis("easting, m", tickformat=".0f")
    layout["yaxis"] = figures._axis("northing, m", tickformat=".0f", scaleanchor="x")
    return Figure(f"plan{i}", data, layout)


def _table(design: Design, fitted: Fitted | None) -> Table:
    plan, stations = design.plan, design.stations
    rows = []
    for j, kind in enumerate(design.kinds):
        k0, k1 = float(plan.curvature_start[j]), float(plan.curvature_end[j])
        rows.append(
            [
                kind,
                "" if plan.kind[j] == STRAIGHT else "right" if k0 + k1 > 0 else "left",
                f"{stations[j]:.2f}",
                "" if fitted is None else f"{fitted.station_sigma[j]:.2g}",
                f"{plan.length[j]:.2f}",
                "" if fitted is None else f"{fitted.length_sigma[j]:.2g}",
                radius_words(k0) if plan.kind[j] != STRAIGHT else "",
                radius_words(k1) if plan.kind[j] >= CLOTHOID else "",
                "" if fitted is None or not np.isfinite(fitted.radius_sigma[j]) else f"{fitted.radius_sigma[j]:.2g}",
            ]
        )
    columns = (
        "element",
        "to the",
        "station, m",
        "\u00b1",
        "length, m",
        "\u00b1",
        "radius, m",
        "to radius, m",
        "\u00b1",
    )
    return Table(columns, rows, left=2, caption=f"Plan of track {design.track}")


def _profile_table(design: Design) -> Table:
    rows = []
    for bar in gradient_bars(design):
        radius = bar.short.split("\n")[0] if bar.kind != "grade" else ""
        rows.append(
            [
                bar.kind,
                f"{bar.begin:.1f}",
                f"{bar.end - bar.begin:.1f}",
                f"{1e3 * bar.first:.2f}",
                f"{1e3 * bar.last:.2f}",
                radius,
            ]
        )
    columns = ("profile", "station, m", "length, m", "from, \u2030", "to, \u2030", "radius, m")
    return Table(columns, rows, left=1, caption=f"Profile of track {design.track}")
