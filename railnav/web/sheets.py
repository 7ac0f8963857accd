"""Sheets of an alignment as engineers draw them: plan, curvature, cant, gradient and height, stacked along chainage.

Values stand beside the bands: R and L of arcs, L and A of clothoids, per mille over metres of gradients. A track without elements is
drawn by its own curvature, cant and gradient.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RailnavError
from railnav.web import figures
from railnav.web.bands import CANT, LEFT, RIGHT, RISE, TURNING, Drawn, metres

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Picture

FloatArray = NDArray[np.float64]

#: Metres between points of drawn curves.
STEP = 2.0
#: Most points of a drawn curve.
_MOST = 30_000
#: Length of a sheet of a paper drawing, m.
SHEET = 5000.0


def sheets(drawn: Drawn, *, title: str = "", length: float | None = None) -> Iterator[Picture]:
    """Draw an alignment on sheets: plan, curvature, cant, gradient and height along chainage.

    Parameters
    ----------
    drawn : Drawn
    title : str
        Above the plan.
    length : float, optional
        Of a sheet, m; by default all on one.

    Returns
    -------
    iterator of matplotlib.figure.Figure
        One after another: a long line has many.

    Raises
    ------
    RailnavError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure as Picture_
    except ImportError as error:
        raise RailnavError('pictures need matplotlib; install with: pip install "railnav[report]"') from error
    whole = drawn.length
    count = 1 if length is None else max(1, int(np.ceil(whole / length - 0.05)))
    for k in range(count):
        low = drawn.start + whole * k / count
        high = drawn.start + whole * (k + 1) / count
        wide = float(np.clip((high - low) / 250.0, 12.0, 60.0))
        has_cant, has_profile = drawn.has_cant, drawn.has_profile
        heights = [4.2, 1.7, *([1.3] if has_cant else []), *([1.5, 1.6] if has_profile else [])]
        picture = Picture_(figsize=(wide, sum(heights) + 1.0), dpi=110, layout="constrained", facecolor="white")
        panels = picture.subplots(len(heights), 1, height_ratios=heights)
        axes = list(np.atleast_1d(panels))
        part = f" ({k + 1} of {count})" if count > 1 else ""
        axes[0].set_title(
            f"{title or f'Track {drawn.track}'}{part}",
            loc="left",
            fontsize=13,
            fontweight="bold",
            color=figures.INK,
        )
        _draw_plan(axes[0], drawn, low, high)
        rest = iter(axes[1:])
        _draw_curvature(next(rest), drawn, low, high)
        if has_cant:
            _draw_cant(next(rest), drawn, low, high)
        if has_profile:
            _draw_gradient(next(rest), drawn, low, high)
            _draw_height(next(rest), drawn, low, high)
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
        yield picture


def save_sheets(pictures: Iterable[Picture], path: Any) -> None:
    """Write sheets: a PDF has one a page, other pictures hold one."""
    from railnav.io.atomic import atomic_path
    from railnav.web.pictures import save

    if str(path).lower().endswith(".pdf"):
        from matplotlib.backends.backend_pdf import PdfPages

        with atomic_path(path) as draft, PdfPages(draft, metadata={"CreationDate": None}) as book:
            for picture in pictures:
                book.savefig(picture)
        return
    save(next(iter(pictures)), path)


def _places(low: float, high: float) -> FloatArray:
    """Stations at which curves of a sheet are drawn."""
    return np.linspace(low, high, int(np.clip((high - low) / STEP, 2, _MOST)))


def _draw_plan(axes: Axes, drawn: Drawn, low: float, high: float) -> None:
    s = _places(low, high)
    here = drawn.inside(s)
    east0, north0 = np.floor(here.easting.min() / 1e3) * 1e3, np.floor(here.northing.min() / 1e3) * 1e3
    middle = np.column_stack([here.easting - east0, here.northing - north0])
    # turned so that the sheet's chord lies level
    chord = middle[-1] - middle[0]
    angle = float(np.arctan2(chord[1], chord[0])) if np.hypot(*chord) > 1.0 else 0.0
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    at = (middle - middle[0]) @ turn.T
    for begin, end, k in _spans(drawn, low, high):
        inside = (s >= begin) & (s <= end)
        colour = figures.INK if k == 0 else RIGHT if k > 0 else LEFT
        axes.plot(at[inside, 0], at[inside, 1], color=colour, linewidth=1.8, solid_capstyle="butt")
    # ticks across the track at element joints, and kilometres
    for station in drawn.joints[(drawn.joints >= low) & (drawn.joints <= high)].tolist():
        i = int(np.argmin(np.abs(s - station)))
        way = at[min(i + 1, len(at) - 1)] - at[max(i - 1, 0)]
        way = way / max(float(np.hypot(*way)), 1e-9)
        tick = np.array([-way[1], way[0]]) * (high - low) * 0.004
        axes.plot(
            [at[i, 0] - tick[0], at[i, 0] + tick[0]], [at[i, 1] - tick[1], at[i, 1] + tick[1]], color="#7a8791", lw=0.7
        )
    step = (
        10_000.0
        if high - low > 50_000.0
        else 1000.0
        if high - low > 2500.0
        else 500.0
        if high - low > 1000.0
        else 100.0
    )
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


def _spans(drawn: Drawn, low: float, high: float) -> list[tuple[float, float, int]]:
    """Stretches of the sheet and to which side they bend: 1 right, -1 left, 0 straight or without elements."""
    if not drawn.plan:
        return [(low, high, 0)]
    rows = []
    for bar in drawn.plan:
        if bar.end < low or bar.begin > high:
            continue
        bend = 0.5 * (bar.first + bar.last)
        rows.append((max(bar.begin, low), min(bar.end, high), 0 if bend == 0.0 else 1 if bend > 0 else -1))
    return rows


def _draw_curvature(axes: Axes, drawn: Drawn, low: float, high: float) -> None:
    s = _places(low, high)
    edges = drawn.joints
    s = np.unique(
        np.concatenate([s, edges[(edges > low) & (edges < high)] + 1e-6, edges[(edges > low) & (edges < high)]])
    )
    bend = drawn.inside(s).curvature * 1e3
    axes.axhline(0.0, color=figures.SOFT, linewidth=0.8)
    axes.fill_between(s, 0.0, np.where(bend > 0, bend, 0.0), color=RIGHT, alpha=0.25, linewidth=0)
    axes.fill_between(s, 0.0, np.where(bend < 0, bend, 0.0), color=LEFT, alpha=0.25, linewidth=0)
    axes.plot(s, bend, color=figures.INK, linewidth=1.1)
    top = 1e3 * drawn.sharpest
    axes.set_ylim(-1.75 * top, 1.75 * top)
    room = (high - low) / 90.0 * 12.0 / max(float(np.clip((high - low) / 250.0, 12.0, 60.0)), 12.0) * 1.4
    for bar in drawn.plan:
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


def _draw_cant(axes: Axes, drawn: Drawn, low: float, high: float) -> None:
    s = _places(low, high)
    cant = 1e3 * drawn.inside(s).cant
    axes.axhline(0.0, color=figures.SOFT, linewidth=0.8)
    axes.plot(s, cant, color=CANT, linewidth=1.3)
    axes.fill_between(s, 0.0, cant, color=CANT, alpha=0.2, linewidth=0)
    top = max(float(np.abs(cant).max()), 1.0)
    axes.set_ylim(-1.45 * top, 1.45 * top)
    for a, b, u in drawn.levels:
        if abs(u) > 1e-3 and low < 0.5 * (a + b) < high and b - a > (high - low) / 120.0:
            side = "bottom" if u > 0 else "top"
            axes.text(0.5 * (a + b), 1e3 * u, f"{abs(1e3 * u):.0f}", ha="center", va=side, fontsize=7)
    axes.set_ylabel("cant\nmm", color=figures.SOFT, fontsize=9)


def _draw_gradient(axes: Axes, drawn: Drawn, low: float, high: float) -> None:
    if not drawn.profile:
        s = _places(low, high)
        axes.axhline(0.0, color=figures.SOFT, linewidth=0.8)
        axes.plot(s, 1e3 * drawn.inside(s).gradient, color=RISE, linewidth=1.1)
        axes.set_ylabel("gradient\n\u2030", color=figures.SOFT, fontsize=9)
        return
    axes.set_ylim(-1.0, 1.0)
    axes.set_yticks([])
    axes.axhline(-0.85, color="#c3cad0", linewidth=0.8)
    axes.axhline(0.85, color="#c3cad0", linewidth=0.8)
    points = _intersections(drawn)
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
                end - 0.04 * (end - begin) if left else begin + 0.04 * (end - begin), -0.62, metres(b - a),
                ha="right" if left else "left", va="center", fontsize=7.5, color=figures.SOFT,
            )  # fmt: skip
    axes.set_ylabel("gradient\n\u2030 / m", color=figures.SOFT, fontsize=9)


def _intersections(drawn: Drawn) -> list[tuple[float, float]]:
    """Stations of vertical intersection and the grade that leads to each."""
    bars = drawn.profile
    points = [(drawn.start, 0.0)]
    for bar in bars:
        if bar.kind != "grade" and abs(bar.last - bar.first) > 1e-9:
            points.append((0.5 * (bar.begin + bar.end), bar.first))
        elif bar.kind == "grade" and points and abs(points[-1][0] - bar.begin) < 1e-6:
            continue
    points.append((drawn.end, bars[-1].last if bars else 0.0))
    return points


def _draw_height(axes: Axes, drawn: Drawn, low: float, high: float) -> None:
    s = _places(low, high)
    height = drawn.inside(s).height
    axes.plot(s, height, color=RISE, linewidth=1.3)
    spread = max(float(np.ptp(height)), 1.0)
    axes.set_ylim(height.min() - 0.15 * spread, height.max() + 0.35 * spread)
    for bar in drawn.profile:
        if bar.kind in ("sag", "crest") and low < 0.5 * (bar.begin + bar.end) < high:
            inside = (s >= bar.begin) & (s <= bar.end)
            axes.plot(s[inside], height[inside], color=CANT, linewidth=2.2)
            if bar.end - bar.begin > (high - low) / 120.0:
                axes.annotate(
                    bar.short, (0.5 * (bar.begin + bar.end), float(np.interp(0.5 * (bar.begin + bar.end), s, height))),
                    xytext=(0, 7), textcoords="offset points", fontsize=6.5, ha="center", color=CANT,
                )  # fmt: skip
    axes.set_ylabel("height\nm", color=figures.SOFT, fontsize=9)
