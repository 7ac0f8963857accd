"""The page of a lining plan: slews, lifts, deviations and versines before and after, one above another along the line."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.web import figures, words
from railnav.web.page import Card, Figure, Section, Table, Warnings, page
from railnav.web.strips import Curve, Strip, axis_of, jumps_in_words, line_map, stack

if TYPE_CHECKING:
    from collections.abc import Sequence

    from railnav.monitoring.lining import LiningPlan
    from railnav.monitoring.smoothing import FixedPoint

FloatArray = NDArray[np.float64]
#: Resolution of values that travel along for zooming, mm.
RESOLUTION = 0.01
BEFORE, AFTER, MOVE = "#9aa7b1", "#1f77b4", "#d9822b"


def lining_page(plan: LiningPlan, *, simulated: bool = False) -> str:
    """Compose the page of a lining plan.

    Parameters
    ----------
    plan : LiningPlan
    simulated : bool
        Whether a run was simulated; a simulated model is seen by itself.

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
        lead += f"The track was measured by {words.count(len(plan.measured.runs), 'run')}, its place good (one sigma) to {good_to(plan)}."
    else:
        lead += f"What was measured is the model's own axis, good (one sigma) to {good_to(plan)}."
    known = plan.sigma_slew[np.isfinite(plan.sigma_slew)]
    if len(known):
        lead += f" A slew is good to {words.length(float(np.median(known)), 2)}"
        lead += " by the noise of the sensors." if plan.measured.runs else "."
    warnings = list(plan.notes)
    sections = [Section("What to know first", "", [Warnings(warnings)])] if warnings else []
    sections += [
        _map(plan),
        Section(
            "Along the line",
            "Right and up are positive as distance grows. Grey is before, blue after, orange what is to be moved. "
            "Diamonds are fixed points. The dotted line is the slew of the versine method. Below stand alignment and longitudinal level in "
            "their bands, before and after. Drag across the chart to zoom in; a double click leads back."
            + jumps_in_words(plan.section, plan.fine.distance),
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
        )
        if np.isfinite(plan.lift).all()
        else Card("Greatest lift", "none", "no heights"),
        Card("Nodes", f"{len(plan.distance):,}", f"each {plan.distance[1] - plan.distance[0]:g} m"),
    ]
    return page(
        f"Lining of {plan.section.name}",
        subtitle=", ".join(plan.measured.runs),
        badge=SIMULATED if simulated or is_simulated(plan.section.model) else "",
        lead=[lead],
        cards=cards,
        sections=sections,
    )


def good_to(plan: LiningPlan) -> str:
    """What the place of the measured axis is good to, in words."""
    across, up = plan.measured.sigma_right, plan.measured.sigma_up
    said = f"{words.length(across, 2)} across" if np.isfinite(across) else "an unknown amount across"
    if np.isfinite(up):
        return f"{said} and {words.length(up, 2)} in height"
    known = np.isfinite(plan.measured.up).any()
    return (
        f"{said} and {'an unknown amount ' if np.isfinite(across) else ''}in height"
        if known
        else f"{said}; heights are not known"
    )


def strips(plan: LiningPlan) -> Figure:
    """Draw the plan along the line, and the channels before and after it, one strip above another.

    Parameters
    ----------
    plan : LiningPlan

    Returns
    -------
    Figure
    """
    fine = plan.fine
    d = fine.distance
    x, _ = axis_of(plan.section, d)
    target = "target" if plan.design else "base"
    drawn = [
        Strip("Model's curvature, 1/km", [Curve("curvature", x, 1e3 * plan.section.at(d).curvature, figures.INK)]),
        _before_after(f"Right of the {target} line, mm", x, fine.right, fine.right + fine.slew),
        Strip(
            "Slew to the right, mm",
            [Curve("slew", x, 1e3 * fine.slew, MOVE, fine=RESOLUTION), *_strung(plan, d, x)],
            _fixed(plan.fixed_slew, d, x),
        ),
        _before_after("Versine on 20 m, mm", x, fine.versine_before, fine.versine_after),
    ]
    if np.isfinite(fine.lift).all():
        drawn += [
            _before_after(f"Above the {target} profile, mm", x, fine.up, fine.up + fine.lift),
            Strip(
                "Lift, mm", [Curve("lift", x, 1e3 * fine.lift, MOVE, fine=RESOLUTION)], _fixed(plan.fixed_lift, d, x)
            ),
        ]
    drawn += [
        _before_after(f"{name.replace('_', ' ').capitalize()} {band}, mm", x, before, after, form=".2f")
        for (name, band), (before, after) in fine.channels.items()
    ]
    return stack(drawn, identity="strips", section=plan.section, distance=d, height=120, legend=False)


def _strung(plan: LiningPlan, distance: FloatArray, x: FloatArray) -> list[Curve]:
    """Slews of the versine method, where there are any."""
    if not len(plan.hallade_slew):
        return []
    at = np.interp(plan.hallade_distance, distance, x)
    return [Curve("versine method", at, 1e3 * plan.hallade_slew, figures.SOFT, "dot")]


def _before_after(name: str, x: FloatArray, before: FloatArray, after: FloatArray, *, form: str = ".1f") -> Strip:
    curves = [
        Curve("before", x, 1e3 * before, BEFORE, fine=RESOLUTION),
        Curve("after", x, 1e3 * after, AFTER, fine=RESOLUTION),
    ]
    return Strip(name, curves, form=form)


def _fixed(points: Sequence[FixedPoint], distance: FloatArray, x: FloatArray) -> list[dict[str, Any]]:
    """Fixed points as diamonds with their tolerance."""
    here = [p for p in points if distance[0] <= 0.5 * (p.start + p.finish) <= distance[-1]]
    if not here:
        return []
    return [
        {
            "x": np.interp([0.5 * (p.start + p.finish) for p in here], distance, x),
            "y": [1e3 * p.correction for p in here],
            "error_y": {"type": "data", "array": [1e3 * p.tolerance for p in here], "color": figures.WRONG},
            "text": [escape(p.name) for p in here],
            "hovertemplate": "%{text}<extra>fixed</extra>",
            "marker": {"size": 8, "color": figures.WRONG, "symbol": "diamond"},
        }
    ]


def _map(plan: LiningPlan) -> Section:
    x, _ = axis_of(plan.section, plan.distance)
    line = ("strips", "lined", x, plan.easting, plan.northing)
    text = "Moving the pointer along the charts moves the dot; zooming them marks the stretch in view."
    return Section("Map", text, [line_map(plan.section.model, [line])])


def _spread(plan: LiningPlan) -> Section:
    strings = plan.hallade_spread
    rows = [
        [
            name.replace("_", " "),
            band,
            f"{1e3 * before:.2f}",
            f"{1e3 * after:.2f}",
            f"{1e3 * strings[name, band][1]:.2f}" if (name, band) in strings else "",
            f"{1e3 * plan.bears[name, band][0]:.3f}" if np.isfinite(plan.bears[name, band][0]) else "not known",
            "yes" if plan.bears[name, band][1] else "no",
        ]
        for (name, band), (before, after) in plan.spread.items()
    ]
    text = (
        "Standard deviation over the stretch, mm, of what was measured and of what is planned (the machine's own errors are not in it). "
        "By versines: what the classic method on half chords of 10 m would leave; it keeps no limits but the ends, and its slews drift "
        "where small errors of versines add up. The axis bears corrections in a band where the noise of its sensors there is at most "
        "a third of what was found."
    )
    columns = ("channel", "band", "before", "after", "by versines", "sigma of the axis", "axis bears it")
    return Section("Before and after", text, [Table(columns, rows, left=2)] if rows else [])


def _limits(plan: LiningPlan) -> Section:
    limit = plan.limits
    fade = (
        "as gently as the other limits let them"
        if limit.ramp is None
        else f"by {1e3 * limit.ramp:g} mm a metre at most"
    )
    rows: list[list[str]] = [
        ["greatest slew", words.length(limit.most_slew, 3)],
        ["lifts", f"{1e3 * limit.least_lift:.0f} to {1e3 * limit.most_lift:.0f} mm"],
        ["change of curvature left, plan", f"{limit.curvature_rate:.1e} 1/m^2"],
        ["change of curvature left, profile", f"{limit.gradient_rate:.1e} 1/m^2"],
        ["ends", f"stay; corrections begin and fade out {fade}"],
    ]
    for what, points in (("slew", plan.fixed_slew), ("lift", plan.fixed_lift)):
        rows += [[f"{what} at {p.name}", f"{1e3 * p.correction:+.1f} +- {1e3 * p.tolerance:.1f} mm"] for p in points]
    return Section("Limits kept", "", [Table(("limit", "value"), rows, left=1)])
