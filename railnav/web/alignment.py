"""Diagrams of an alignment as engineers draw them: plan, curvature band, cant, gradient, stacked along chainage.

A band shows what the line does without a scale to read: a box above the axis is a curve to the right, its sloping sides are the
transitions; a gradient is a diagonal in its box. Values stand beside them: R and L of arcs, L and A of clothoids, per mille over
metres of gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RailnavError
from railnav.track.elements import ARC, CLOTHOID, STRAIGHT
from railnav.web import figures
from railnav.web.page import Card, Figure, Section, Table, Warnings, page

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Picture

    from railnav.monitoring.design import Design
    from railnav.monitoring.fitting import Fitted

FloatArray = NDArray[np.float64]

RIGHT, LEFT, TURNING, RISE, CANT = "#1b6ca8", "#b5442e", "#7a8791", "#3a7d44", "#8a5a9e"
#: Metres between points of drawn curves.
_STEP = 2.0
#: Length of a sheet of a paper drawing, m.
SHEET = 5000.0
#: Most points of a page's curve.
_MOST = 6000


@dataclass(frozen=True, slots=True)
class Bar:
    """One element in a band: from and to (station, m), kind by name, values at both ends, and words for it."""

    begin: float
    end: float
    kind: str
    first: float
    last: float
    short: str
    words: str


def plan_bars(design: Design, fitted: Fitted | None = None) -> list[Bar]:
    """Elements of the plan as bars; values are curvatures, 1/m."""
    plan, edges = design.plan, design.stations
    bars = []
    for j, kind in enumerate(design.kinds):
        k0, k1, length = float(plan.curvature_start[j]), float(plan.curvature_end[j]), float(plan.length[j])
        sigma_l = "" if fitted is None else _pm(float(fitted.length_sigma[j]))
        if plan.kind[j] == STRAIGHT:
            short = words = f"L {_m(length)}"
        elif plan.kind[j] == ARC:
            sigma_r = "" if fitted is None else _pm(float(fitted.radius_sigma[j]))
            short = f"R {_m(abs(1.0 / k0))}\nL {_m(length)}"
            words = f"R {_m(abs(1.0 / k0))}{sigma_r} m {'right' if k0 > 0 else 'left'}, L {_m(length)}{sigma_l} m"
        else:
            change = abs(k1 - k0)
            a = f" A {np.sqrt(length / change):.0f}" if plan.kind[j] == CLOTHOID and change > 0.0 else ""
            short = f"L {_m(length)}{a.replace(' A', chr(10) + 'A')}"
            words = f"{kind} L {_m(length)}{sigma_l} m{a}, R {_radius(k0)} to {_radius(k1)}"
        bars.append(Bar(float(edges[j]), float(edges[j + 1]), kind, k0, k1, short, words))
    return bars


def gradient_bars(design: Design) -> list[Bar]:
    """Pieces of the profile as bars; values are slopes."""
    profile = design.profile
    if profile is None:
        return []
    begins = np.clip(profile.begin, 0.0, design.length)
    ends = np.append(begins[1:], design.length)
    bars = []
    for j, (a, b) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
        if b - a < 1e-3:
            continue
        inside = np.array([a + 1e-6, b - 1e-6])
        g0, g1 = (float(v) for v in profile(inside, 1))
        if profile.bend[j] == 0.0 and profile.radius[j] == 0.0:
            bars.append(
                Bar(a + design.start, b + design.start, "grade", g0, g1, f"{1e3 * g0:.1f} \u2030\n{_m(b - a)}", "")
            )
        else:
            bend = float(profile(np.array([0.5 * (a + b)]), 2)[0])
            radius = abs(1.0 / bend) if bend else np.inf
            word = "sag" if bend > 0.0 else "crest"
            bars.append(Bar(a + design.start, b + design.start, word, g0, g1, f"R {_m(radius)}", word))
    return bars


def _m(value: float) -> str:
    """Metres as short as they are worth."""
    if not np.isfinite(value):
        return "\u221e"
    return f"{value:.0f}" if value >= 1000.0 or abs(value - round(value)) < 0.05 else f"{value:.1f}"


def _pm(sigma: float) -> str:
    return f" \u00b1{sigma:.2g}" if np.isfinite(sigma) and sigma > 0.0 else ""


def _radius(bend: float) -> str:
    return "\u221e" if bend == 0.0 else _m(abs(1.0 / bend))


# --- pictures ---------------------------------------------------------------------------------------------------------


def sheets(design: Design, *, title: str = "", length: float | None = None) -> list[Picture]:
    """Draw an alignment on sheets: plan, curvature, cant, gradient and height along chainage.

    Parameters
    ----------
    design : Design
    title : str
        Above the plan.
    length : float, optional
        Of a sheet, m; by default all on one.

    Returns
    -------
    list of matplotlib.figure.Figure

    Raises
    ------
    RailnavError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure as Picture_
    except ImportError as error:
        raise RailnavError('pictures need matplotlib; install with: pip install "railnav[report]"') from error
    whole = design.length
    count = 1 if length is None else max(1, int(np.ceil(whole / length - 0.05)))
    made = []
    for k in range(count):
        low = design.start + whole * k / count
        high = design.start + whole * (k + 1) / count
        wide = float(np.clip((high - low) / 250.0, 12.0, 60.0))
        has_cant, has_profile = design.cant is not None, design.profile is not None
        heights = [4.2, 1.7, *([1.3] if has_cant else []), *([1.5, 1.6] if has_profile else [])]
        picture = Picture_(figsize=(wide, sum(heights) + 1.0), dpi=110, layout="constrained", facecolor="white")
        panels = picture.subplots(len(heights), 1, height_ratios=heights)
        axes = list(np.atleast_1d(panels))
        part = f" ({k + 1} of {count})" if count > 1 else ""
        axes[0].set_title(
            f"{title or f'Track {design.track}'}{part}",
            loc="left",
            fontsize=13,
            fontweight="bold",
            color=figures.INK,
        )
        _draw_plan(axes[0], design, low, high)
        rest = iter(axes[1:])
        _draw_curvature(next(rest), design, low, high)
        if has_cant:
            _draw_cant(next(rest), design, low, high)
        if has_profile:
            _draw_gradient(next(rest), design, low, high)
            _draw_height(next(rest), design, low, high)
        below = axes[1:]
        for panel in below:
            panel.set_xlim(low, high)
            panel.xaxis.set_major_formatter(lambda value, _: f"{value / 1e3:.1f}")
            for side in ("top", "right"):
                panel.spines[side].set_visible(False)
            panel.tick_params(colors=figures.SOFT, labelsize=8)
        for panel in below[:-1]:
            panel.tick_params(labelbottom=False)
        below[-1].set_xlabel("station, km", color=figures.SOFT)
        made.append(picture)
    return made


def save_sheets(pictures: Sequence[Picture], path: Any) -> None:
    """Write sheets: a PDF has one a page, other pictures hold one."""
    from railnav.io.atomic import atomic_path
    from railnav.web.pictures import save

    if str(path).lower().endswith(".pdf"):
        from matplotlib.backends.backend_pdf import PdfPages

        with atomic_path(path) as draft, PdfPages(draft, metadata={"CreationDate": None}) as book:
            for picture in pictures:
                book.savefig(picture)
        return
    save(pictures[0], path)


def _draw_plan(axes: Axes, design: Design, low: float, high: float) -> None:
    s = np.linspace(low, high, max(2, int((high - low) / _STEP)))
    here = design.at(s)
    east0, north0 = np.floor(here.easting.min() / 1e3) * 1e3, np.floor(here.northing.min() / 1e3) * 1e3
    middle = np.column_stack([here.easting - east0, here.northing - north0])
    # turned so that the sheet's chord lies level
    chord = middle[-1] - middle[0]
    angle = float(np.arctan2(chord[1], chord[0])) if np.hypot(*chord) > 1.0 else 0.0
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    at = (middle - middle[0]) @ turn.T
    for begin, end, k in _spans(design, low, high):
        inside = (s >= begin) & (s <= end)
        colour = figures.INK if k == 0 else RIGHT if k > 0 else LEFT
        axes.plot(at[inside, 0], at[inside, 1], color=colour, linewidth=1.8, solid_capstyle="butt")
    # ticks across the track at element joints, and kilometres
    for station in design.stations[(design.stations >= low) & (design.stations <= high)].tolist():
        i = int(np.argmin(np.abs(s - station)))
        way = at[min(i + 1, len(at) - 1)] - at[max(i - 1, 0)]
        way = way / max(float(np.hypot(*way)), 1e-9)
        tick = np.array([-way[1], way[0]]) * (high - low) * 0.004
        axes.plot(
            [at[i, 0] - tick[0], at[i, 0] + tick[0]], [at[i, 1] - tick[1], at[i, 1] + tick[1]], color="#7a8791", lw=0.7
        )
    step = 1000.0 if high - low > 2500.0 else 500.0 if high - low > 1000.0 else 100.0
    for station in np.arange(np.ceil(low / step) * step, high, step).tolist():
        i = int(np.argmin(np.abs(s - station)))
        axes.annotate(
            f"{station / 1e3:.1f}", at[i], xytext=(4, 6), textcoords="offset points", fontsize=8, color=figures.SOFT
        )
        axes.plot(*at[i], "o", color=figures.SOFT, markersize=3)
    north = turn @ np.array([0.0, 1.0])
    axes.annotate(
        "", xy=(0.97 + 0.025 * north[0], 0.86 + 0.1 * north[1]), xytext=(0.97, 0.86), xycoords="axes fraction",
        arrowprops={"arrowstyle": "-|>", "color": figures.SOFT},
    )  # fmt: skip
    axes.text(0.965, 0.80, "N", transform=axes.transAxes, fontsize=9, color=figures.SOFT, ha="center")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(False)


def _spans(design: Design, low: float, high: float) -> list[tuple[float, float, int]]:
    rows = []
    for bar in plan_bars(design):
        if bar.end < low or bar.begin > high:
            continue
        bend = 0.5 * (bar.first + bar.last)
        rows.append((max(bar.begin, low), min(bar.end, high), 0 if bend == 0.0 else 1 if bend > 0 else -1))
    return rows


def _band_height(design: Design) -> float:
    sharp = np.maximum(np.abs(design.plan.curvature_start), np.abs(design.plan.curvature_end))
    return float(max(sharp.max(initial=0.0), 1e-6))


def _draw_curvature(axes: Axes, design: Design, low: float, high: float) -> None:
    s = np.linspace(low, high, max(2, int((high - low) / _STEP)))
    edges = design.stations
    s = np.unique(
        np.concatenate([s, edges[(edges > low) & (edges < high)] + 1e-6, edges[(edges > low) & (edges < high)]])
    )
    bend = design.at(np.clip(s, design.start, design.start + design.length)).curvature * 1e3
    axes.axhline(0.0, color=figures.SOFT, linewidth=0.8)
    axes.fill_between(s, 0.0, np.where(bend > 0, bend, 0.0), color=RIGHT, alpha=0.25, linewidth=0)
    axes.fill_between(s, 0.0, np.where(bend < 0, bend, 0.0), color=LEFT, alpha=0.25, linewidth=0)
    axes.plot(s, bend, color=figures.INK, linewidth=1.1)
    top = 1e3 * _band_height(design)
    axes.set_ylim(-1.75 * top, 1.75 * top)
    room = (high - low) / 90.0 * 12.0 / max(float(np.clip((high - low) / 250.0, 12.0, 60.0)), 12.0) * 1.4
    for bar in plan_bars(design):
        if bar.end <= low or bar.begin >= high:
            continue
        begin, end = max(bar.begin, low), min(bar.end, high)
        middle, bend_here = 0.5 * (begin + end), 0.5e3 * (bar.first + bar.last)
        if bar.kind == "arc" and end - begin > 0.7 * room:
            up = bar.first > 0
            level = 1e3 * bar.first + (0.1 if up else -0.1) * top
            axes.text(
                middle, level, bar.short, ha="center", va="bottom" if up else "top", fontsize=7, color=figures.INK
            )
        elif bar.kind == "straight" and end - begin > 2.5 * room:
            axes.text(middle, 0.06 * top, bar.short, ha="center", va="bottom", fontsize=7, color=figures.SOFT)
        elif bar.kind not in ("arc", "straight") and end - begin > 0.35 * room:
            other = -1.0 if bend_here > 0 else 1.0
            axes.text(
                middle, other * 0.12 * top, bar.short, ha="center", va="top" if other < 0 else "bottom", fontsize=6.5,
                color=TURNING, rotation=90,
            )  # fmt: skip
    axes.set_ylabel("curvature\n1/km", color=figures.SOFT, fontsize=9)


def _draw_cant(axes: Axes, design: Design, low: float, high: float) -> None:
    s = np.linspace(low, high, max(2, int((high - low) / _STEP)))
    cant = 1e3 * design.at(s).cant
    axes.axhline(0.0, color=figures.SOFT, linewidth=0.8)
    axes.plot(s, cant, color=CANT, linewidth=1.3)
    axes.fill_between(s, 0.0, cant, color=CANT, alpha=0.2, linewidth=0)
    top = max(float(np.abs(cant).max()), 1.0)
    axes.set_ylim(-1.45 * top, 1.45 * top)
    if design.cant is not None:
        c = design.cant
        for a, b, u, v in zip(c.edges, c.edges[1:], c.start, c.end, strict=False):
            a, b = a + design.start, b + design.start
            if abs(u - v) < 1e-6 and abs(u) > 1e-3 and low < 0.5 * (a + b) < high and b - a > (high - low) / 120.0:
                up = u > 0
                axes.text(
                    0.5 * (a + b), 1e3 * u, f"{abs(1e3 * u):.0f}", ha="center", va="bottom" if up else "top", fontsize=7
                )
    axes.set_ylabel("cant\nmm", color=figures.SOFT, fontsize=9)


def _draw_gradient(axes: Axes, design: Design, low: float, high: float) -> None:
    axes.set_ylim(-1.0, 1.0)
    axes.set_yticks([])
    axes.axhline(-0.85, color="#c3cad0", linewidth=0.8)
    axes.axhline(0.85, color="#c3cad0", linewidth=0.8)
    points = _intersections(design)
    for (a, _), (b, g) in pairwise(points):
        begin, end = max(a, low), min(b, high)
        if end <= begin:
            continue
        axes.plot([a, a], [-0.85, 0.85], color="#c3cad0", linewidth=0.8)
        if abs(g) < 5e-5:
            axes.plot([a, b], [0.0, 0.0], color=RISE, linewidth=1.2)
        else:
            down = -0.85 if g > 0 else 0.85
            axes.plot([a, b], [down, -down], color=RISE, linewidth=1.2)
        if end - begin > (high - low) / 45.0:
            left = g >= 0.0
            axes.text(
                begin + 0.04 * (end - begin) if left else end - 0.04 * (end - begin), 0.62, f"{1e3 * g:.1f}",
                ha="left" if left else "right", va="center", fontsize=7.5,
            )  # fmt: skip
            axes.text(
                end - 0.04 * (end - begin) if left else begin + 0.04 * (end - begin), -0.62, _m(b - a),
                ha="right" if left else "left", va="center", fontsize=7.5, color=figures.SOFT,
            )  # fmt: skip
    axes.set_ylabel("gradient\n\u2030 / m", color=figures.SOFT, fontsize=9)


def _intersections(design: Design) -> list[tuple[float, float]]:
    """Stations of vertical intersection and the grade that leads to each."""
    bars = gradient_bars(design)
    points = [(design.start, 0.0)]
    for bar in bars:
        if bar.kind != "grade" and abs(bar.last - bar.first) > 1e-9:
            points.append((0.5 * (bar.begin + bar.end), bar.first))
        elif bar.kind == "grade" and points and abs(points[-1][0] - bar.begin) < 1e-6:
            continue
    points.append((design.start + design.length, bars[-1].last if bars else 0.0))
    return points


def _draw_height(axes: Axes, design: Design, low: float, high: float) -> None:
    s = np.linspace(low, high, max(2, int((high - low) / _STEP)))
    height = design.at(s).height
    axes.plot(s, height, color=RISE, linewidth=1.3)
    spread = max(float(np.ptp(height)), 1.0)
    axes.set_ylim(height.min() - 0.15 * spread, height.max() + 0.35 * spread)
    for bar in gradient_bars(design):
        if bar.kind in ("sag", "crest") and low < 0.5 * (bar.begin + bar.end) < high:
            inside = (s >= bar.begin) & (s <= bar.end)
            axes.plot(s[inside], height[inside], color=CANT, linewidth=2.2)
            if bar.end - bar.begin > (high - low) / 120.0:
                axes.annotate(
                    bar.short, (0.5 * (bar.begin + bar.end), float(np.interp(0.5 * (bar.begin + bar.end), s, height))),
                    xytext=(0, 7), textcoords="offset points", fontsize=6.5, ha="center", color=CANT,
                )  # fmt: skip
    axes.set_ylabel("height\nm", color=figures.SOFT, fontsize=9)


# --- the page ---------------------------------------------------------------------------------------------------------


def alignment_page(
    designs: Sequence[Design],
    fitted: Sequence[Fitted] = (),
    *,
    title: str = "Alignment",
    badge: str = "",
    subtitle: str = "",
) -> str:
    """Compose the page of alignments: bands along chainage, plan, and tables of elements.

    Parameters
    ----------
    designs : sequence of Design
    fitted : sequence of Fitted
        What fitting found, one a design, or none.
    title, badge, subtitle : str

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
    warnings = [line for one in fitted for line in one.warnings]
    for i, design in enumerate(designs):
        one = fitted[i] if fitted else None
        words = (
            "Curves to the right stand above the axis, to the left below it; sloping sides are transitions. Stations are lengths in the "
            "plane. Drag to zoom: all strips move together."
        )
        if one is not None:
            words += " " + fit_words(one)
        parts: list[Any] = [_strips(design, i), _page_plan(design, i), _table(design, one)]
        if design.profile is not None:
            parts.append(_profile_table(design))
        sections.append(Section(f"Track {design.track}", words, parts))
    if warnings:
        sections.insert(0, Section("What to know", "", [Warnings(warnings)]))
    return page(
        title,
        subtitle=subtitle,
        badge=badge,
        cards=[
            Card("Tracks", str(len(designs))),
            Card("Length", f"{sum(d.length for d in designs) / 1e3:.2f} km"),
            Card("Elements", str(sum(len(d.kinds) for d in designs)), "of the plan"),
            *_radius_card(designs),
        ],
        sections=sections,
    )


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


def _strips(design: Design, i: int) -> Figure:
    s = np.linspace(design.start, design.start + design.length, int(np.clip(design.length / _STEP, 2, _MOST)))
    edges = design.stations
    s = np.unique(np.concatenate([s, edges, edges[1:-1] + 1e-6]))
    here = design.at(np.clip(s, edges[0], edges[-1]))
    km = s / 1e3
    rows: list[tuple[str, list[dict[str, Any]]]] = []
    bend = 1e3 * here.curvature
    bars = plan_bars(design)
    middle = [0.5e-3 * (b.begin + b.end) for b in bars]
    marks = {
        "type": "scatter", "mode": "text", "x": middle, "y": [0.5e3 * (b.first + b.last) for b in bars],
        "text": [escape(b.short).replace("\n", "<br>") if b.kind == "arc" else "" for b in bars],
        "textposition": ["top center" if b.first + b.last >= 0 else "bottom center" for b in bars],
        "textfont": {"size": 10}, "hovertext": [escape(b.words) for b in bars], "hoverinfo": "text", "showlegend": False,
    }  # fmt: skip
    hover = [escape(bars[int(k)].words) for k in np.clip(np.searchsorted(edges, s, side="left") - 1, 0, len(bars) - 1)]
    curve = figures._line("curvature", km, bend, figures.INK, fill="tozeroy", fillcolor="rgba(27,108,168,0.18)")
    curve |= {"text": hover, "hovertemplate": "%{y:.4f} 1/km<br>%{text}<extra></extra>", "showlegend": False}
    rows.append(("curvature, 1/km", [curve, marks | {"hoverinfo": "skip"}]))
    if design.cant is not None:
        rows.append(("cant, mm", [figures._line("cant", km, 1e3 * here.cant, CANT, fill="tozeroy", showlegend=False)]))
    if design.profile is not None:
        rows.append(
            (
                "gradient, \u2030",
                [figures._line("gradient", km, 1e3 * here.gradient, RISE, fill="tozeroy", showlegend=False)],
            )
        )
        rows.append(("height, m", [figures._line("height", km, here.height, RISE, showlegend=False)]))
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = figures._layout(170 * len(rows) + 90, hovermode="x unified")
    gap, n = 0.04, len(rows)
    for k, (name, traces) in enumerate(rows):
        suffix = "" if k == 0 else str(k + 1)
        top = 1.0 - k * (1.0 + gap) / n
        data += [trace | {"xaxis": "x", "yaxis": f"y{suffix}"} for trace in traces]
        layout[f"yaxis{suffix}"] = figures._axis(name, domain=[max(top - (1.0 + gap) / n + gap, 0.0), min(top, 1.0)])
    layout["xaxis"] = figures._axis("station, km", anchor=f"y{'' if n == 1 else n}")
    top = 1.8e3 * _band_height(design)
    layout["yaxis"]["range"] = [-top, top]
    return Figure(f"strips{i}", data, layout)


def _page_plan(design: Design, i: int) -> Figure:
    s = np.linspace(design.start, design.start + design.length, int(np.clip(design.length / _STEP, 2, _MOST)))
    here = design.at(s)
    joints = design.at(np.clip(design.stations, design.start, design.start + design.length))
    words = [escape(b.words) for b in plan_bars(design)]
    data = [
        figures._line("axis", here.easting, here.northing, figures.INK, showlegend=False, hoverinfo="skip"),
        {
            "type": "scatter", "mode": "markers", "x": joints.easting[:-1], "y": joints.northing[:-1], "text": words,
            "marker": {"size": 6, "color": RIGHT}, "showlegend": False,
            "customdata": (design.stations[:-1] / 1e3).tolist(),
            "hovertemplate": "from %{customdata:.3f} km: %{text}<extra></extra>",
        },
    ]  # fmt: skip
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
                _radius(k0) if plan.kind[j] != STRAIGHT else "",
                _radius(k1) if plan.kind[j] >= CLOTHOID else "",
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
