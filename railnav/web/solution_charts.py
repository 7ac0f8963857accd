"""Charts of solutions and their errors along time and along the line: bounds, modes, tracks, Stanford and reliability diagrams."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.web.figures import (
    BAND,
    ESTIMATE,
    INK,
    LIMIT,
    MODE_COLOURS,
    PALETTE,
    POINTS,
    SOFT,
    TRUTH,
    WRONG,
    _axis,
    _layout,
    _line,
    _runs_of,
    thin,
)
from railnav.web.page import Figure

if TYPE_CHECKING:
    from railnav.evaluation import Evaluation
    from railnav.navigation.solution import Solution
    from railnav.track.model import TrackModel
    from railnav.truth import Truth

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def along_time(
    solution: Solution,
    evaluation: Evaluation | None = None,
    truth: Truth | None = None,
    *,
    shaded: Sequence[tuple[float, float]] = (),
) -> Figure:
    """Draw speed, error, uncertainty and mode along time, one chart above another on one time axis.

    Parameters
    ----------
    solution : Solution
    evaluation : Evaluation, optional
        Without it the second chart shows what the solution says of itself: sigma and protection level.
    truth : Truth, optional
        Adds the true speed.
    shaded : sequence of (from, to)
        Times to shade, s: where GNSS was silent.

    Returns
    -------
    Figure
        x is minutes since the run's start; hovering moves the train in the plan.
    """
    minutes = solution.time / 60.0
    rows = thin(POINTS, solution.speed, solution.sigma_along, solution.protection_level_along)
    rows = np.union1d(rows, np.flatnonzero(np.diff(solution.mode, prepend=-1) != 0))
    data = [
        _line(
            "speed",
            minutes[rows],
            solution.speed[rows] * 3.6,
            ESTIMATE,
            hovertemplate="%{y:.1f} km/h<extra>speed</extra>",
        )
    ]
    if truth is not None:
        kept = thin(POINTS, truth.speed)
        data.append(
            _line(
                "true speed",
                truth.time[kept] / 60.0,
                truth.speed[kept] * 3.6,
                TRUTH,
                line={"dash": "dot", "width": 1.2},
                hovertemplate="%{y:.1f} km/h<extra>true speed</extra>",
            )
        )
    data += [{**trace, "yaxis": "y2"} for trace in _uncertainty(minutes[rows], solution, rows)]
    scale = solution.protection_level_along
    if evaluation is not None:
        time, along = evaluation.time, evaluation.along
        kept = thin(POINTS, along)
        data.append(
            _line(
                "error along",
                time[kept] / 60.0,
                along[kept],
                INK,
                yaxis="y2",
                line={"width": 1.3},
                hovertemplate="%{y:.3f} m<extra>error along</extra>",
            )
        )
        scale = np.concatenate([scale, np.abs(along)])
    data += _mode_ribbon(solution, minutes)
    layout = _layout(
        640,
        xaxis=_axis("minutes since the start of the run", anchor="y3", domain=[0, 1]),
        yaxis=_axis("speed, km/h", domain=[0.66, 1.0]),
        yaxis2=_axis("along the track, m", domain=[0.13, 0.6], range=_reach(scale)),
        yaxis3=_axis("mode", domain=[0.0, 0.06], range=[0, 1], showticklabels=False, ticks="", showgrid=False),
    )
    layout["shapes"] = [_shade(a / 60.0, b / 60.0) for a, b in shaded]
    return Figure("time", data, layout, moves=True)


def _uncertainty(x: FloatArray, solution: Solution, rows: IntArray) -> list[dict[str, Any]]:
    """Two standard deviations as a band around zero, and the protection level on both sides."""
    sigma, level = 2.0 * solution.sigma_along[rows], solution.protection_level_along[rows]
    edge = {"color": LIMIT, "width": 1.1}
    around: list[FloatArray] = []
    up_and_back: list[FloatArray] = []
    gap = np.array([np.nan])
    for known, a, b in _runs_of(np.isfinite(sigma).astype(np.int64)):
        if known:
            around += [x[a:b], x[a:b][::-1], gap]
            up_and_back += [sigma[a:b], -sigma[a:b][::-1], gap]
    return [
        _line(
            "two sigma",
            np.concatenate(around or [gap]),
            np.concatenate(up_and_back or [gap]),
            BAND,
            line={"width": 0},
            fill="toself",
            fillcolor=BAND,
            hoverinfo="skip",
        ),
        _line(
            "", x, sigma, BAND, line={"width": 0}, showlegend=False, hovertemplate="%{y:.3f} m<extra>two sigma</extra>"
        ),
        _line(
            "protection level", x, level, LIMIT, line=edge, hovertemplate="%{y:.3f} m<extra>protection level</extra>"
        ),
        _line("", x, -level, LIMIT, line=edge, hoverinfo="skip", showlegend=False),
    ]


def _reach(values: FloatArray) -> list[float]:
    """A symmetric range that shows all but the rare extremes."""
    values = np.abs(values[np.isfinite(values)])
    if not len(values):
        return [-1.0, 1.0]
    top = float(min(values.max(), 6.0 * np.quantile(values, 0.9)))
    return [-1.1 * max(top, 1e-3), 1.1 * max(top, 1e-3)]


def _mode_ribbon(solution: Solution, minutes: FloatArray) -> list[dict[str, Any]]:
    """One coloured bar a mode along the foot of the chart."""
    from railnav.navigation.solution import Mode

    traces = []
    for mode in Mode:
        spans = [(a, b) for value, a, b in _runs_of(solution.mode) if value == mode]
        if not spans:
            continue
        x: list[float | None] = []
        for a, b in spans[:1000]:
            x += [float(minutes[a]), float(minutes[min(b, len(minutes) - 1)]), None]
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": mode.label,
                "x": x,
                "y": [None if value is None else 0.5 for value in x],
                "yaxis": "y3",
                "line": {"width": 12, "color": MODE_COLOURS[mode.label]},
                "connectgaps": False,
                "hovertemplate": f"{mode.label}<extra></extra>",
            }
        )
    return traces


def along_line(
    solution: Solution,
    evaluation: Evaluation | None,
    model: TrackModel | None,
    *,
    shaded: Sequence[tuple[float, float]] = (),
) -> Figure:
    """Draw error and uncertainty along the line, above the line's own curvature and height.

    Parameters
    ----------
    solution : Solution
    evaluation : Evaluation, optional
    model : TrackModel, optional
        Adds curvature and height of the track under the train.
    shaded : sequence of (from, to)
        Times to shade, s: where GNSS was silent.

    Returns
    -------
    Figure
        x is the distance run, km.
    """
    placed = np.flatnonzero(solution.track >= 0)
    if not len(placed):
        return Figure("line", [], _layout(200))
    distance = distance_run(solution) / 1e3
    rows = placed[thin(POINTS, solution.sigma_along[placed], solution.protection_level_along[placed])]
    data = _uncertainty(distance[rows], solution, rows)
    scale = solution.protection_level_along[placed]
    if evaluation is not None:
        along = np.interp(solution.time, evaluation.time, evaluation.along)
        kept = placed[thin(POINTS, along[placed])]
        data.append(
            _line(
                "error along",
                distance[kept],
                along[kept],
                INK,
                line={"width": 1.3},
                hovertemplate="%{y:.3f} m<extra>error along</extra>",
            )
        )
        scale = np.concatenate([scale, np.abs(evaluation.along)])
    layout = _layout(
        620 if model is not None else 400,
        xaxis=_axis("distance run, km", anchor="y3" if model is not None else "y"),
        yaxis=_axis("along the track, m", domain=[0.52, 1.0] if model is not None else [0, 1], range=_reach(scale)),
    )
    if model is not None:
        kept = placed[np.linspace(0, len(placed) - 1, min(len(placed), POINTS)).astype(np.int64)]
        points = _geometry(model, solution, kept)
        nose = np.where(solution.running_direction[kept] < 0, -1.0, 1.0)
        data.append(
            _line(
                "curvature",
                distance[kept],
                points.curvature * nose * 1e3,
                PALETTE[3],
                yaxis="y2",
                hovertemplate="%{y:.3f} /km<extra>curvature</extra>",
            )
        )
        data.append(
            _line(
                "height",
                distance[kept],
                points.height,
                PALETTE[2],
                yaxis="y3",
                hovertemplate="%{y:.1f} m<extra>height</extra>",
            )
        )
        layout["yaxis2"] = _axis("curvature, 1/km", domain=[0.26, 0.46])
        layout["yaxis3"] = _axis("height, m", domain=[0.0, 0.2])
    spans = np.interp(np.asarray(shaded, dtype=np.float64).reshape(-1, 2), solution.time, distance)
    layout["shapes"] = [_shade(float(a), float(b)) for a, b in spans]
    return Figure("line", data, layout)


def _shade(begin: float, end: float) -> dict[str, Any]:
    """A grey stretch behind all charts of a figure."""
    return {
        "type": "rect",
        "layer": "below",
        "xref": "x",
        "yref": "paper",
        "x0": begin,
        "x1": end,
        "y0": 0,
        "y1": 1,
        "line": {"width": 0},
        "fillcolor": "rgba(93,107,118,0.12)",
    }


def which_track(solution: Solution, truth: Truth | None = None, *, at_most: int = 60) -> Figure:
    """Draw the tracks in the order run, as the solution has them and as they were.

    Parameters
    ----------
    solution : Solution
    truth : Truth, optional
    at_most : int
        Greatest number of tracks to name; the rest is left out.

    Returns
    -------
    Figure
        x is minutes since the run's start; one row a track.
    """
    names: dict[str, None] = {}
    data = []
    for label, source, colour, width in (
        ("as it was", truth, "#c9d1d6", 11),
        ("as navigated", solution, ESTIMATE, 3.5),
    ):
        if source is None:
            continue
        x: list[float | None] = []
        y: list[str | None] = []
        for value, a, b in _runs_of(source.track):
            if value < 0:
                continue
            name = source.track_id[value]
            if name not in names and len(names) >= at_most:
                continue
            names[name] = None
            x += [float(source.time[a]) / 60.0, float(source.time[min(b, len(source.time) - 1)]) / 60.0, None]
            y += [escape(name), escape(name), None]
        data.append(
            _line(
                label,
                x,
                y,
                colour,
                line={"width": width},
                connectgaps=False,
                hovertemplate=f"%{{y}}<extra>{label}</extra>",
            )
        )
    layout = _layout(
        110 + 24 * max(len(names), 2),
        hovermode="closest",
        xaxis=_axis("minutes since the start of the run"),
        yaxis=_axis(
            "",
            type="category",
            categoryorder="array",
            categoryarray=[escape(name) for name in names],
            autorange="reversed",
        ),
    )
    return Figure("tracks", data, layout, moves=True)


def _geometry(model: TrackModel, solution: Solution, rows: IntArray) -> Any:
    """Track geometry under the train; the solution's tracks are looked up in the model by name."""
    index = np.asarray([model.track_index(track) for track in solution.track_id], dtype=np.int64)
    which = index[solution.track[rows]]
    return model.at(which, np.clip(solution.offset[rows], 0.0, model.lengths[which]))


def distance_run(solution: Solution) -> FloatArray:
    """Distance run since the first epoch with a position, m, backing up included; (m,)."""
    speed = np.nan_to_num(np.abs(solution.speed))
    step = np.diff(solution.time, prepend=solution.time[:1])
    return np.cumsum(step * 0.5 * (speed + np.concatenate([speed[:1], speed[:-1]])))


def integrity(evaluation: Evaluation) -> Figure:
    """Draw the Stanford diagram: the size of the error against the protection level, one dot an epoch.

    Dots above the diagonal are honest; a dot below it is an epoch whose error was greater than its bound.
    """
    error, level = np.abs(evaluation.along), evaluation.protection_level
    known = np.flatnonzero(np.isfinite(error) & np.isfinite(level))
    worst = known[np.argsort((error - level)[known])[::-1][:200]]
    even = known[np.linspace(0, len(known) - 1, min(len(known), 2500)).astype(np.int64)] if len(known) else known
    shown = np.union1d(worst, even)
    high = 1.08 * float(np.max(level[known], initial=1e-3))
    wide = min(high, 1.6 * float(np.max(error[known], initial=1e-3))) if len(known) else high
    wide = max(wide, 1.08 * float(np.max(error[known], initial=1e-3)))
    over = error[shown] > level[shown]
    data = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": name,
            "x": error[shown][chosen],
            "y": level[shown][chosen],
            "marker": {"size": 5, "opacity": 0.6, "color": colour},
            "hovertemplate": "error %{x:.2f} m, bound %{y:.2f} m<extra></extra>",
        }
        for name, chosen, colour in (("bounded", ~over, ESTIMATE), ("error beyond its bound", over, WRONG))
        if chosen.any()
    ]
    data.append(_line("error = bound", [0, wide], [0, wide], SOFT, line={"width": 1, "dash": "dash"}, hoverinfo="skip"))
    layout = _layout(
        440,
        hovermode="closest",
        xaxis=_axis("size of the error along the track, m", range=[0, wide]),
        yaxis=_axis("protection level, m", range=[0, max(high, wide)]),
    )
    return Figure("integrity", data, layout)


def reliability(evaluation: Evaluation) -> Figure:
    """Draw the reliability diagram: the share of rows on the right track against the track probability that they state.

    Each dot is a class of stated probabilities with the bounds of its true share; on the diagonal a probability is true, above it
    modest, below it overconfident. Both axes count nines: the distance from 1 on a logarithmic scale.
    """
    classes = evaluation.reliability.classes
    least = 1e-4

    def nines(share: float) -> float:
        return float(-np.log10(max(1.0 - share, least)))

    x = [nines(c.stated) for c in classes]
    y = [nines(c.right) for c in classes]
    data: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": "classes of stated probability",
            "x": x,
            "y": y,
            "error_y": {
                "type": "data",
                "symmetric": False,
                "array": [nines(c.upper) - b for c, b in zip(classes, y, strict=True)],
                "arrayminus": [b - nines(c.lower) for c, b in zip(classes, y, strict=True)],
                "color": SOFT,
                "thickness": 1.2,
            },
            "marker": {"size": 9, "color": [ESTIMATE if c.honest else WRONG for c in classes]},
            "text": [
                f"stated {100 * c.stated:.2f} %, right {100 * c.right:.2f} % of {c.rows:,} rows ({c.effective:.0f} independent)"
                for c in classes
            ],
            "hovertemplate": "%{text}<extra></extra>",
        }
    ]
    top = nines(1.0)
    data.append(_line("true", [0, top], [0, top], SOFT, line={"width": 1, "dash": "dash"}, hoverinfo="skip"))
    ticks = {
        "tickvals": [nines(s) for s in (0.0, 0.5, 0.9, 0.99, 0.999, 0.9999)],
        "ticktext": ["0", "50 %", "90 %", "99 %", "99.9 %", "99.99 %"],
        "range": [-0.15, top + 0.15],
    }
    layout = _layout(
        400,
        hovermode="closest",
        xaxis=_axis("track probability stated", **ticks),
        yaxis=_axis("share of rows on the right track", **ticks),
    )
    return Figure("reliability", data, layout)
