"""The charts of the pages, as plain data for plotly.js: the line in plan, a train along time and along the line.

Long series are thinned so that a page stays small, in a way that keeps every peak.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.web.page import Figure

if TYPE_CHECKING:
    from railnav.evaluation import Evaluation
    from railnav.navigation.solution import Solution
    from railnav.track.model import TrackModel
    from railnav.truth import Truth

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

INK, SOFT, GRID = "#1d2b36", "#5d6b76", "#e8ebed"
TRACK, TRUTH, ESTIMATE, BAND, LIMIT, WRONG = (
    "#9aa7b1",
    "#1d2b36",
    "#1f77b4",
    "rgba(31,119,180,0.18)",
    "#d9822b",
    "#c0392b",
)
MODE_COLOURS = {
    "initialising": "#b9c2c9",
    "tracking": "#2f8f5b",
    "coasting": "#e0a030",
    "ambiguous": "#8a63b8",
    "off-model": "#c0392b",
    "lost": "#5b2020",
}
#: Colours of tracks and runs that stand beside each other.
PALETTE = ("#1f77b4", "#d9822b", "#2f8f5b", "#8a63b8", "#b5485d", "#4f7f8f", "#8c6d31", "#6b7f2a", "#c06fa0", "#5566aa")
#: Points of one thinned series.
POINTS = 3000
#: Points of the lines in plan, all tracks together.
PLAN_POINTS = 40_000


def thin(limit: int, *series: FloatArray) -> IntArray:
    """Choose rows that keep the look of every series: of each stretch its first row and the rows of least and greatest value.

    Parameters
    ----------
    limit : int
        About how many rows to keep.
    *series : (m,) arrays
        Values along the same rows; NaN is allowed.

    Returns
    -------
    (k,) int array
        Rows to keep, growing; the first and the last are among them.

    Examples
    --------
    >>> rows = thin(10, np.where(np.arange(1000) == 637, 9.0, 0.0))
    >>> bool(637 in rows), len(rows) < 20
    (True, True)
    """
    m = len(series[0])
    if m <= limit:
        return np.arange(m)
    stretch = max(1, -(-m * (1 + 2 * len(series)) // limit))
    first = np.arange(0, m, stretch)
    keep = [first, np.array([m - 1])]
    for values in series:
        padded = np.full(len(first) * stretch, np.nan)
        padded[:m] = values
        table = padded.reshape(-1, stretch)
        keep.append(first + np.argmin(np.where(np.isfinite(table), table, np.inf), axis=1))
        keep.append(first + np.argmax(np.where(np.isfinite(table), table, -np.inf), axis=1))
    return np.unique(np.concatenate(keep))


def outline(easting: FloatArray, northing: FloatArray, tolerance: float) -> IntArray:
    """Choose the vertices that a drawn line needs so that it leaves the given one by no more than a tolerance, m."""
    from shapely import LineString

    line = LineString(np.column_stack([easting, northing, np.arange(len(easting), dtype=np.float64)]))
    kept = np.asarray([point[2] for point in line.simplify(tolerance, preserve_topology=False).coords])
    return kept.astype(np.int64)


def _axis(title: str, **more: Any) -> dict[str, Any]:
    return {
        "title": {"text": title, "font": {"size": 13, "color": SOFT}, "standoff": 8},
        "gridcolor": GRID,
        "zerolinecolor": "#c3cad0",
        "linecolor": "#c3cad0",
        "ticks": "outside",
        "tickcolor": "#c3cad0",
        "ticklen": 4,
        "automargin": True,
        **more,
    }


def _layout(height: int, **more: Any) -> dict[str, Any]:
    return {
        "height": height,
        "margin": {"l": 68, "r": 20, "t": 66, "b": 48},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {
            "family": "system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif",
            "size": 13,
            "color": INK,
        },
        "legend": {
            "orientation": "h",
            "x": 0,
            "y": 1,
            "yanchor": "bottom",
            "traceorder": "normal",
            "font": {"size": 13},
        },
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#b6bfc6", "activecolor": SOFT},
        "hoverlabel": {"font": {"size": 13}},
        "hovermode": "x unified",
        "colorway": list(PALETTE),
        **more,
    }


def _line(name: str, x: Any, y: Any, colour: str, **more: Any) -> dict[str, Any]:
    line = {"color": colour, "width": 1.6, **more.pop("line", {})}
    return {"type": "scatter", "mode": "lines", "name": name, "x": x, "y": y, "line": line, **more}


def _runs_of(values: IntArray) -> list[tuple[int, int, int]]:
    """Stretches of equal value: (value, first row, row after the last)."""
    if not len(values):
        return []
    starts = np.flatnonzero(np.diff(values, prepend=values[0] - 1))
    stops = np.append(starts[1:], len(values))
    return [(int(values[a]), int(a), int(b)) for a, b in zip(starts, stops, strict=True)]


def plan(
    model: TrackModel | None,
    solution: Solution | None = None,
    *,
    surveys: Sequence[tuple[str, FloatArray, FloatArray]] = (),
    truth: tuple[FloatArray, FloatArray] | None = None,
) -> Figure:
    """Draw the line in plan, with the train's path, its modes, and what a survey saw.

    Parameters
    ----------
    model : TrackModel, optional
    solution : Solution, optional
    surveys : sequence of (name, easting, northing)
        Fixes of survey runs in the model's plane, m.
    truth : (easting, northing), optional
        Where the train really was, in the model's plane, m.

    Returns
    -------
    Figure
        Kilometres from the lower left corner; with a solution, `marker` lets charts along time move the train.
    """
    east0, north0, width, tall = _corner(model, solution)
    data: list[dict[str, Any]] = []
    if model is not None:
        x, y, text = _tracks(model, east0, north0)
        data.append(
            _line("tracks", x, y, TRACK, text=text, hovertemplate="track %{text}<extra></extra>", connectgaps=False)
        )
        data.append(_nodes(model, east0, north0))
    if surveys:
        parts = [(name, np.linspace(0, len(e) - 1, min(len(e), 1500)).astype(np.int64), e, n) for name, e, n in surveys]
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": "survey fixes",
                "x": np.concatenate([(e[rows] - east0) / 1e3 for _, rows, e, _ in parts]),
                "y": np.concatenate([(n[rows] - north0) / 1e3 for _, rows, _, n in parts]),
                "text": [escape(name) for name, rows, _, _ in parts for _ in rows],
                "marker": {"size": 3, "opacity": 0.55, "color": PALETTE[3]},
                "hovertemplate": "%{text}<extra></extra>",
                "visible": "legendonly",
            }
        )
    if truth is not None:
        rows = outline(truth[0], truth[1], 0.05)
        data.append(
            _line(
                "true path",
                (truth[0][rows] - east0) / 1e3,
                (truth[1][rows] - north0) / 1e3,
                TRUTH,
                line={"width": 1, "dash": "dot"},
                hoverinfo="skip",
            )
        )
    marker: dict[str, Any] | None = None
    if solution is not None:
        data += _path(solution, east0, north0)
        placed = np.flatnonzero(solution.track >= 0)
        if len(placed):
            rows = placed[np.linspace(0, len(placed) - 1, min(len(placed), 2000)).astype(np.int64)]
            marker = {
                "time": solution.time[rows] / 60.0,
                "x": (solution.easting[rows] - east0) / 1e3,
                "y": (solution.northing[rows] - north0) / 1e3,
                "trace": len(data),
            }
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": "train",
                    "x": [marker["x"][0]],
                    "y": [marker["y"][0]],
                    "marker": {"size": 14, "color": WRONG, "line": {"width": 2, "color": "#fff"}},
                    "hoverinfo": "skip",
                    "showlegend": False,
                }
            )
    height = int(np.clip(1040 * tall / max(width, 1.0) + 110, 340, 760))
    layout = _layout(
        height,
        hovermode="closest",
        dragmode="pan",
        xaxis=_axis(f"km east of {east0:,.0f} m"),
        yaxis=_axis(f"km north of {north0:,.0f} m", scaleanchor="x", scaleratio=1),
    )
    return Figure("plan", data, layout, marker=marker)


def _corner(model: TrackModel | None, solution: Solution | None) -> tuple[float, float, float, float]:
    """Lower left corner, rounded down to a kilometre, and the extent, m."""
    source: Any = model if model is not None else solution
    easting, northing = source.easting[np.isfinite(source.easting)], source.northing[np.isfinite(source.northing)]
    if not len(easting):
        return 0.0, 0.0, 1.0, 1.0
    west, south = float(easting.min()), float(northing.min())
    return (
        float(np.floor(west / 1e3) * 1e3),
        float(np.floor(south / 1e3) * 1e3),
        float(easting.max()) - west,
        float(northing.max()) - south,
    )


def _tracks(model: TrackModel, east0: float, north0: float) -> tuple[FloatArray, FloatArray, list[str]]:
    """All tracks as one broken line, with the track's name at each vertex."""
    tolerance = 0.05
    while True:
        x, y, text = [], [], []
        for t, track in enumerate(model.track_id):
            knots = slice(int(model.knot_start[t]), int(model.knot_start[t + 1]))
            east, north = model.easting[knots], model.northing[knots]
            rows = outline(east, north, tolerance)
            x += [(east[rows] - east0) / 1e3, np.array([np.nan])]
            y += [(north[rows] - north0) / 1e3, np.array([np.nan])]
            text += [escape(track)] * (len(rows) + 1)
        if len(text) <= max(PLAN_POINTS, 6 * len(model.track_id)) or tolerance > 50:
            return np.concatenate(x), np.concatenate(y), text
        tolerance *= 2


def _nodes(model: TrackModel, east0: float, north0: float) -> dict[str, Any]:
    from railnav.track.model import NodeKind

    shown = np.flatnonzero(model.nodes.kind != NodeKind.JOINT)[:2000]
    label = {kind: kind.name.lower().replace("_", " ") for kind in NodeKind}
    symbol = {
        NodeKind.TURNOUT: "triangle-up",
        NodeKind.CROSSING: "x",
        NodeKind.BUFFER_STOP: "square",
        NodeKind.END_OF_MODEL: "circle-open",
    }
    kinds = [NodeKind(int(model.nodes.kind[k])) for k in shown]
    return {
        "type": "scatter",
        "mode": "markers",
        "name": "turnouts and ends",
        "x": (model.nodes.easting[shown] - east0) / 1e3,
        "y": (model.nodes.northing[shown] - north0) / 1e3,
        "text": [f"{label[kind]} {escape(model.nodes.id[k])}" for kind, k in zip(kinds, shown, strict=True)],
        "hovertemplate": "%{text}<extra></extra>",
        "marker": {"size": 6, "color": SOFT, "symbol": [symbol.get(kind, "circle") for kind in kinds]},
    }


def _path(solution: Solution, east0: float, north0: float) -> list[dict[str, Any]]:
    """The train's path, one trace a mode."""
    from railnav.navigation.solution import Mode

    traces = []
    placed = np.where(solution.track >= 0, solution.mode, -1)
    for mode in Mode:
        x, y, text = [], [], []
        for value, a, b in _runs_of(placed):
            if value != mode:
                continue
            stop = min(b + 1, len(placed)) if b < len(placed) and placed[b] >= 0 else b
            east, north = solution.easting[a:stop], solution.northing[a:stop]
            rows = a + (outline(east, north, 0.2) if len(east) > 1 else np.zeros(1, np.int64))
            x += [(solution.easting[rows] - east0) / 1e3, np.array([np.nan])]
            y += [(solution.northing[rows] - north0) / 1e3, np.array([np.nan])]
            text += [
                f"{escape(solution.track_id[int(solution.track[r])])}, {solution.time[r] / 60:.2f} min" for r in rows
            ]
            text.append("")
        if x:
            traces.append(
                _line(
                    f"train: {mode.label}",
                    np.concatenate(x),
                    np.concatenate(y),
                    MODE_COLOURS[mode.label],
                    line={"width": 3.2},
                    text=text,
                    hovertemplate="%{text}<extra></extra>",
                    connectgaps=False,
                )
            )
    return traces


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


def profile(model: TrackModel, *, tracks: int = len(PALETTE)) -> Figure:
    """Draw curvature, height and cross-track standard deviation along the longest tracks of a model.

    Parameters
    ----------
    model : TrackModel
    tracks : int
        How many tracks to draw.

    Returns
    -------
    Figure
        x is the offset on each track, km; the legend switches tracks on and off.
    """
    longest = np.argsort(model.lengths)[::-1][:tracks]
    data = []
    for k, t in enumerate(longest):
        knots = slice(int(model.knot_start[t]), int(model.knot_start[t + 1]))
        sigma = cross_sigma(model, knots)
        rows = thin(2400 if len(longest) <= 4 else 1200, model.curvature[knots], sigma)
        x = model.offset[knots][rows] / 1e3
        name, colour = escape(model.track_id[t]), PALETTE[k % len(PALETTE)]
        for axis, values, form in (
            ("y", model.curvature[knots] * 1e3, "%{y:.3f} /km"),
            ("y2", model.height[knots], "%{y:.2f} m"),
            ("y3", sigma, "%{y:.4f} m"),
        ):
            data.append(
                _line(
                    name,
                    x,
                    values[rows],
                    colour,
                    yaxis=axis,
                    legendgroup=name,
                    showlegend=axis == "y",
                    visible=True if k < 2 else "legendonly",
                    hovertemplate=f"{form}<extra>{name}</extra>",
                    line={"width": 1.3},
                )
            )
    size = np.abs(model.curvature) * 1e3
    steep = 1.1 * max(0.5, float(min(size.max(), 1.5 * np.quantile(size, 0.99))))
    layout = _layout(
        660,
        xaxis=_axis("offset on the track, km", anchor="y3"),
        yaxis=_axis("curvature, 1/km", domain=[0.7, 1.0], range=[-steep, steep]),
        yaxis2=_axis("height, m", domain=[0.36, 0.64]),
        yaxis3=_axis("sigma across, m", domain=[0.0, 0.3], type="log"),
    )
    return Figure("profile", data, layout)


def cross_sigma(model: TrackModel, knots: slice) -> FloatArray:
    """Cross-track standard deviation of knots, m; NaN where unknown."""
    east, north = np.cos(model.grid_bearing[knots]), -np.sin(model.grid_bearing[knots])
    covariance = model.covariance_g[knots]
    variance = covariance[:, 0] * east**2 + 2.0 * covariance[:, 1] * east * north + covariance[:, 3] * north**2
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
