"""The page of a lining plan: slews, lifts, deviations and versines before and after, one above another along the line."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.web import figures, words
from railnav.web.geometry import POINTS, STRIP, axis_of
from railnav.web.page import Card, Figure, Section, Table, Warnings, page

if TYPE_CHECKING:
    from railnav.monitoring.lining import LiningPlan

FloatArray = NDArray[np.float64]
BEFORE, AFTER, MOVE = "#9aa7b1", "#1f77b4", "#d9822b"


def lining_page(plan: LiningPlan) -> str:
    """Compose the page of a lining plan.

    Parameters
    ----------
    plan : LiningPlan

    Returns
    -------
    str
        Self-contained HTML.

    Raises
    ------
    RailnavError
        If plotly is not installed.
    """
    from railnav.web.report import SIMULATED, is_simulated

    length = float(plan.distance[-1] - plan.distance[0])
    target = f"design {plan.design}" if plan.design else f"a target smoothed by {plan.cutoff:.0f} m"
    lead = (
        f"{words.length(length, 5)} of {plan.section.name}, lined to {target}: slews of up to "
        f"{words.length(float(abs(plan.slew).max()), 3)} ({words.length(float(abs(plan.slew).mean()), 2)} in the mean)"
    )
    if np.isfinite(plan.lift).all():
        lead += f" and lifts of up to {words.length(float(plan.lift.max()), 3)}"
    lead += ". "
    if plan.measured.runs:
        lead += (
            f"The track was measured by {words.count(len(plan.measured.runs), 'run')}, its place good to "
            f"{words.length(plan.measured.sigma_right, 2)} across and {words.length(plan.measured.sigma_up, 2)} in height (one sigma)."
        )
    warnings = list(plan.notes)
    if not plan.usable:
        warnings.insert(
            0,
            "Not for a machine: the measured axis is not known well enough for slews of millimetres. It shows the method on these data.",
        )
    sections = [Section("What to know first", "", [Warnings(warnings)])] if warnings else []
    sections += [
        _map(plan),
        Section(
            "Along the line",
            "Right and up are positive as distance grows. Grey is before, blue after, orange what is to be moved. "
            "Diamonds are fixed points. The dotted line is the slew of the versine method.",
            [strips(plan)],
        ),
        _spread(plan),
        _limits(plan),
    ]
    cards = [
        Card("Target", plan.design or "smoothed", "" if plan.design else f"cut-off {plan.cutoff:.0f} m"),
        Card(
            "Greatest slew",
            words.length(float(abs(plan.slew).max()), 3),
            f"limit {words.length(plan.limits.most_slew, 3)}",
        ),
        Card(
            "Greatest lift", words.length(float(plan.lift.max()), 3), f"limit {words.length(plan.limits.most_lift, 3)}"
        ),
        Card("Nodes", f"{len(plan.distance):,}", f"each {plan.distance[1] - plan.distance[0]:g} m"),
    ]
    return page(
        f"Lining of {plan.section.name}",
        subtitle=", ".join(plan.measured.runs),
        badge=SIMULATED if is_simulated(plan.section.model) else "",
        lead=[lead],
        cards=cards,
        sections=sections,
    )


def strips(plan: LiningPlan) -> Figure:
    """Draw the plan along the line, one strip above another.

    Parameters
    ----------
    plan : LiningPlan

    Returns
    -------
    Figure
    """
    x, title = axis_of(plan.section, plan.distance)
    curvature = plan.section.at(plan.distance).curvature * 1e3
    rows: list[tuple[str, list[tuple[str, FloatArray, FloatArray, str, str]]]] = [
        ("Model's curvature, 1/km", [("curvature", x, curvature, figures.INK, "solid")]),
        (
            "Right of the target line, mm" if plan.design else "Right of the base line, mm",
            [
                ("before", x, 1e3 * plan.right_before, BEFORE, "solid"),
                ("after", x, 1e3 * plan.right_after, AFTER, "solid"),
            ],
        ),
        (
            "Slew to the right, mm",
            [("slew", x, 1e3 * plan.slew, MOVE, "solid")]
            + (
                [
                    (
                        "versine method",
                        np.interp(plan.hallade_distance, plan.distance, x),
                        1e3 * plan.hallade_slew,
                        figures.SOFT,
                        "dot",
                    )
                ]
                if len(plan.hallade_distance)
                else []
            ),
        ),
        (
            "Versine on 20 m, mm",
            [
                ("before", x, 1e3 * plan.versine_before, BEFORE, "solid"),
                ("after", x, 1e3 * plan.versine_after, AFTER, "solid"),
            ],
        ),
    ]
    if np.isfinite(plan.lift).all():
        rows += [
            (
                "Above the target profile, mm" if plan.design else "Above the base profile, mm",
                [
                    ("before", x, 1e3 * plan.up_before, BEFORE, "solid"),
                    ("after", x, 1e3 * plan.up_after, AFTER, "solid"),
                ],
            ),
            ("Lift, mm", [("lift", x, 1e3 * plan.lift, MOVE, "solid")]),
        ]
    layout = figures._layout(round(1.5 * STRIP) * len(rows) + 110, hovermode="x", showlegend=False)
    data: list[dict[str, Any]] = []
    height = 1.0 / len(rows)
    for i, (label, curves) in enumerate(rows):
        top = 1.0 - i * height
        axis = "y" if i == 0 else f"y{i + 1}"
        for name, at, values, colour, dash in curves:
            kept = figures.thin(POINTS, values)
            data.append(
                figures._line(
                    name,
                    at[kept],
                    values[kept],
                    colour,
                    yaxis=axis,
                    line={"width": 1.1, "dash": dash},
                    connectgaps=False,
                    hovertemplate=f"%{{y:.1f}}<extra>{name}</extra>",
                )
            )
        fixed = plan.fixed_slew if label.startswith("Slew") else plan.fixed_lift if label.startswith("Lift") else ()
        if fixed:
            middle = np.array([0.5 * (point.start + point.finish) for point in fixed])
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "x": np.interp(middle, plan.distance, x),
                    "y": [1e3 * point.correction for point in fixed],
                    "error_y": {
                        "type": "data",
                        "array": [1e3 * point.tolerance for point in fixed],
                        "color": figures.WRONG,
                    },
                    "text": [escape(point.name) for point in fixed],
                    "hovertemplate": "%{text}<extra>fixed</extra>",
                    "yaxis": axis,
                    "marker": {"size": 8, "color": figures.WRONG, "symbol": "diamond"},
                }
            )
        layout["yaxis" if i == 0 else f"yaxis{i + 1}"] = figures._axis("", domain=[top - 0.86 * height, top], nticks=5)
        layout.setdefault("annotations", []).append(
            {
                "text": label,
                "xref": "paper",
                "yref": "paper",
                "x": 0.002,
                "y": top,
                "xanchor": "left",
                "yanchor": "top",
                "showarrow": False,
                "font": {"size": 12, "color": figures.SOFT},
                "bgcolor": "rgba(255,255,255,0.75)",
            }
        )
    layout["xaxis"] = figures._axis(title, anchor=f"y{len(rows)}", domain=[0, 1], showspikes=True, spikemode="across")
    return Figure("strips", data, layout, moves=True)


def _map(plan: LiningPlan) -> Section:
    drawn = figures.plan(plan.section.model)
    east0, north0, _, _ = figures._corner(plan.section.model, None)
    data = list(drawn.data)
    x, _ = axis_of(plan.section, plan.distance)
    east, north = (plan.easting - east0) / 1e3, (plan.northing - north0) / 1e3
    rows = figures.outline(plan.easting, plan.northing, 0.5)
    data.append(
        figures._line(
            "lined", east[rows], north[rows], figures.ESTIMATE, line={"width": 2.5}, hoverinfo="skip", showlegend=False
        )
    )
    kept = np.linspace(0, len(x) - 1, min(len(x), 2000)).astype(np.int64)
    marker: dict[str, Any] = {"time": x[kept], "x": east[kept], "y": north[kept], "trace": len(data)}
    data.append(
        {
            "type": "scatter",
            "mode": "markers",
            "name": "place",
            "x": [east[0]],
            "y": [north[0]],
            "marker": {"size": 14, "color": figures.WRONG, "line": {"width": 2, "color": "#fff"}},
            "hoverinfo": "skip",
            "showlegend": False,
        }
    )
    return Section(
        "Map", "Moving the pointer along the charts moves the dot.", [Figure("plan", data, drawn.layout, marker=marker)]
    )


def _spread(plan: LiningPlan) -> Section:
    rows = [
        [name.replace("_", " "), band, f"{1e3 * before:.2f}", f"{1e3 * after:.2f}"]
        for (name, band), (before, after) in plan.spread.items()
    ]
    text = "Standard deviation over the stretch, mm, of what was measured and of what is planned (the machine's own errors are not in it)."
    return Section(
        "Before and after", text, [Table(("channel", "band", "before", "after"), rows, left=2)] if rows else []
    )


def _limits(plan: LiningPlan) -> Section:
    limit = plan.limits
    rows: list[list[str]] = [
        ["greatest slew", words.length(limit.most_slew, 3)],
        ["lifts", f"{1e3 * limit.least_lift:.0f} to {1e3 * limit.most_lift:.0f} mm"],
        ["change of curvature left, plan", f"{limit.curvature_rate:.1e} 1/m^2"],
        ["change of curvature left, profile", f"{limit.gradient_rate:.1e} 1/m^2"],
        ["ends", "stay where they are"],
    ]
    for what, points in (("slew", plan.fixed_slew), ("lift", plan.fixed_lift)):
        rows += [[f"{what} at {p.name}", f"{1e3 * p.correction:+.1f} +- {1e3 * p.tolerance:.1f} mm"] for p in points]
    return Section("Limits kept", "", [Table(("limit", "value"), rows, left=1)])
