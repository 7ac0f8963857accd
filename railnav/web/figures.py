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
    from railnav.navigation.solution import Solution
    from railnav.track.model import TrackModel

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
