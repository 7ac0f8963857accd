"""Static pictures of a line and a train on it, by matplotlib: for README, print and slides."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from railnav.errors import RailnavError
from railnav.web.figures import INK, MODE_COLOURS, SOFT, TRACK, cross_sigma, outline
from railnav.web.solution_charts import distance_run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from railnav.navigation.solution import Solution
    from railnav.track.model import TrackModel


def track_plan(model: TrackModel | None, solution: Solution | None = None, *, title: str = "") -> Figure:
    """Draw a line in plan; beneath it, its profile, or a train's speed and bound along the distance run.

    Parameters
    ----------
    model : TrackModel, optional
        The tracks; may be left out when there is a solution.
    solution : Solution, optional
        The train's path, coloured by the navigator's mode.
    title : str
        Words above the plan.

    Returns
    -------
    matplotlib.figure.Figure
        Made without pyplot: nothing global is touched. `save` writes it.

    Raises
    ------
    RailnavError
        If matplotlib is not installed, or there is neither a model nor a solution.
    """
    if model is None and solution is None:
        raise RailnavError("nothing to draw: neither a model nor a solution")
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RailnavError('pictures need matplotlib; install with: pip install "railnav[report]"') from error
    source: Any = model if model is not None else solution
    known = np.isfinite(source.easting) & np.isfinite(source.northing)
    if not known.any():
        raise RailnavError("nothing to draw: the solution has no position")
    east0 = float(np.floor(source.easting[known].min() / 1e3) * 1e3)
    north0 = float(np.floor(source.northing[known].min() / 1e3) * 1e3)
    tall = float(np.ptp(source.northing[known]) / max(float(np.ptp(source.easting[known])), 1.0))
    plan_height = float(np.clip(10.0 * tall, 2.6, 9.0))
    figure = Figure(figsize=(11.0, plan_height + 3.2), dpi=110, layout="constrained", facecolor="white")
    above, below = figure.subplots(2, 1, height_ratios=[plan_height, 2.2])
    _draw_plan(above, model, solution, east0, north0)
    if title:
        above.set_title(title, loc="left", fontsize=13, fontweight="semibold", color=INK, pad=12)
    if solution is not None:
        _draw_speed(below, solution)
    elif model is not None:
        _draw_profile(below, model)
    for axes in (above, below):
        _quiet(axes)
    return figure


def save(figure: Figure, path: str | Path) -> None:
    """Write a picture, whole or not at all; its ending names the format (.png, .svg, .pdf)."""
    from railnav.io.atomic import atomic_path

    ending = Path(path).suffix.lower().lstrip(".")
    made = {"Date": None} if ending == "svg" else {"CreationDate": None} if ending == "pdf" else None
    with atomic_path(path) as draft:
        figure.savefig(draft, format=ending, metadata=made)


def _quiet(axes: Axes) -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#b6bfc6")
    axes.tick_params(colors=SOFT, labelsize=9)
    axes.xaxis.label.set_color(SOFT)
    axes.yaxis.label.set_color(SOFT)
    axes.grid(visible=True, color="#eceff1", linewidth=0.8)
    axes.set_axisbelow(True)


def _draw_plan(axes: Axes, model: TrackModel | None, solution: Solution | None, east0: float, north0: float) -> None:
    from railnav.navigation.solution import Mode
    from railnav.track.model import NodeKind

    if model is not None:
        for t in range(len(model.track_id)):
            knots = slice(int(model.knot_start[t]), int(model.knot_start[t + 1]))
            east, north = model.easting[knots], model.northing[knots]
            rows = outline(east, north, 0.5)
            axes.plot((east[rows] - east0) / 1e3, (north[rows] - north0) / 1e3, color=TRACK, linewidth=1.2)
        for kind, mark, label in (
            (NodeKind.TURNOUT, "^", "turnout"),
            (NodeKind.BUFFER_STOP, "s", "buffer stop"),
            (NodeKind.END_OF_MODEL, "o", "end of the model"),
        ):
            here = model.nodes.kind == kind
            if here.any():
                axes.plot(
                    (model.nodes.easting[here] - east0) / 1e3,
                    (model.nodes.northing[here] - north0) / 1e3,
                    mark,
                    color=SOFT,
                    markersize=4,
                    label=label,
                    zorder=3,
                )
    if solution is not None:
        for mode in Mode:
            here = (solution.mode == mode) & (solution.track >= 0)
            if here.any():
                east = np.where(here, solution.easting, np.nan)
                north = np.where(here, solution.northing, np.nan)
                axes.plot(
                    (east - east0) / 1e3,
                    (north - north0) / 1e3,
                    color=MODE_COLOURS[mode.label],
                    linewidth=3,
                    solid_capstyle="round",
                    label=mode.label,
                    zorder=4,
                )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"km east of {east0:,.0f} m")
    axes.set_ylabel(f"km north of {north0:,.0f} m")
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=9, labelcolor=INK, loc="best")


def _draw_speed(axes: Axes, solution: Solution) -> None:
    distance = distance_run(solution) / 1e3
    axes.plot(distance, solution.speed * 3.6, color=INK, linewidth=1.4)
    axes.set_xlabel("distance run, km")
    axes.set_ylabel("speed, km/h")
    bound = axes.twinx()
    bound.fill_between(distance, solution.protection_level_along, color="#d9822b", alpha=0.3, linewidth=0)
    level = solution.protection_level_along[np.isfinite(solution.protection_level_along)]
    if len(level):
        bound.set_ylim(0, 4.0 * float(np.quantile(level, 0.98)))
    bound.set_ylabel("protection level, m", color="#b5691c")
    bound.tick_params(colors="#b5691c", labelsize=9)
    for side in ("top", "left", "right"):
        bound.spines[side].set_visible(False)


def _draw_profile(axes: Axes, model: TrackModel) -> None:
    """Height along the longest track; where there are no heights, its cross-track standard deviation."""
    longest = int(np.argmax(model.lengths))
    knots = slice(int(model.knot_start[longest]), int(model.knot_start[longest + 1]))
    axes.set_xlabel(f"km along {model.track_id[longest]}, the longest track")
    if np.isfinite(model.height[knots]).any():
        axes.plot(model.offset[knots] / 1e3, model.height[knots], color=INK, linewidth=1.4)
        axes.set_ylabel("height, m")
        return
    axes.plot(model.offset[knots] / 1e3, cross_sigma(model, knots) * 1e3, color=INK, linewidth=1.2)
    axes.set_ylabel("sigma across, mm")
