"""Strip charts as on a recording car's chart: curves one above another on one axis along the line, linked with the map.

A strip is drawn from a few thousand points; where the values as measured travel along in the page (`Curve.fine`), zooming in shows them.
"""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.web import figures
from railnav.web.page import Figure

if TYPE_CHECKING:
    from railnav.monitoring.section import Section as TrackSection
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

#: Points of one curve of a strip chart before zooming.
POINTS = 4000
#: Height of one strip, pixels, and the share of it left for its name.
STRIP, GAP = 96, 0.22
#: A step of the chainage that differs from that of the distance by more than this is a jump, m.
JUMP = 0.5
#: What stands for an unknown value among packed ones.
UNKNOWN = -32768
#: Jumps drawn in one chart, and the most that are named.
JUMPS_DRAWN, JUMPS_NAMED = 60, 12


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One curve of a strip.

    Attributes
    ----------
    name : str
    x, y : (n,) array
        As drawn: along the axis, and in the strip's unit.
    colour : str
    dash : str
    label : str
        What hovering says besides the value.
    group : str
        Curves of one group are switched together in the legend; empty for none.
    legend : bool
        Whether the curve stands in the legend.
    fine : float
        Resolution to which all values travel along for zooming, in the strip's unit; 0 for none. The values then stand at uniform
        distances, the first at `Stack.start`.
    """

    name: str
    x: FloatArray
    y: FloatArray
    colour: str
    dash: str = "solid"
    label: str = ""
    group: str = ""
    legend: bool = False
    fine: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """One strip: its name with the unit, curves, marks (traces of plotly.js without axes), and level lines as (value, colour)."""

    name: str
    curves: Sequence[Curve]
    marks: Sequence[dict[str, Any]] = field(default_factory=tuple)
    lines: Sequence[tuple[float, str]] = field(default_factory=tuple)
    form: str = ".2f"


def axis_of(section: TrackSection, distance: FloatArray) -> tuple[FloatArray, str]:
    """Kilometres to draw along: the chainage where the model has one that grows steadily, otherwise the distance."""
    chainage = section.model.chainage(*section.locate(distance))
    if np.isfinite(chainage).all() and (np.diff(chainage) > 0.0).all():
        return chainage / 1e3, "chainage, km"
    return distance / 1e3, f"km along {section.name}"


def jumps_of(section: TrackSection, distance: FloatArray) -> list[tuple[float, float, float]]:
    """Where the published kilometres jump: distance, chainage before and after, m."""
    chainage = section.model.chainage(*section.locate(distance))
    step, gone = np.diff(chainage), np.diff(distance)
    with np.errstate(invalid="ignore"):
        jump = np.flatnonzero(np.abs(np.abs(step) - gone) > JUMP)
    return [(float(distance[i + 1]), float(chainage[i]), float(chainage[i + 1])) for i in jump.tolist()]


def jumps_in_words(section: TrackSection, distance: FloatArray) -> str:
    """What the marks across a chart mean, where published kilometres jump; nothing where they do not."""
    if not jumps_of(section, distance):
        return ""
    grey = axis_of(section, distance)[1].startswith("chainage")
    return (
        f" {'Grey marks kilometres that are missing' if grey else 'Dashed lines mark where published kilometres jump'}."
    )


def stack(
    strips: Sequence[Strip],
    *,
    identity: str,
    section: TrackSection,
    distance: FloatArray,
    height: int = STRIP,
    legend: bool = True,
) -> Figure:
    """Draw strips one above another on one axis along the line.

    Parameters
    ----------
    strips : sequence of Strip
    identity : str
        Of the figure in the page.
    section : Section
    distance : (n,) array
        Uniform distances that values with `Curve.fine` stand at, m.
    height : int
        Of one strip, pixels.
    legend : bool

    Returns
    -------
    Figure
        Moves the marker of the map.
    """
    x, title = axis_of(section, distance)
    jumps = jumps_of(section, distance)
    # where kilometres are missing there is no track: curves break there
    breaks = np.array([before / 1e3 for _, before, _ in jumps]) if title.startswith("chainage") else np.empty(0)
    layout = figures._layout(height * len(strips) + 110, hovermode="x", showlegend=legend)
    data: list[dict[str, Any]] = []
    packed: dict[str, Any] = {}
    share = 1.0 / len(strips)
    for row, strip in enumerate(strips):
        top = 1.0 - row * share
        axis = "y" if row == 0 else f"y{row + 1}"
        for curve in strip.curves:
            unknown = np.isnan(curve.y)
            gaps = np.flatnonzero(unknown[1:] & ~unknown[:-1]) + 1  # so that a thinned curve breaks where the values do
            kept = np.union1d(figures.thin(POINTS, curve.y), gaps)
            if curve.fine > 0.0 and len(kept) < len(curve.y):
                packed[str(len(data))] = pack(curve.y, curve.fine)
            at = np.searchsorted(curve.x[kept], breaks, side="right")
            data.append(
                figures._line(
                    escape(curve.name),
                    np.insert(curve.x[kept], at, breaks),
                    np.insert(curve.y[kept], at, np.nan),
                    curve.colour,
                    yaxis=axis,
                    line={"width": 1.1, "dash": curve.dash},
                    showlegend=curve.legend,
                    **({"legendgroup": curve.group} if curve.group else {}),
                    connectgaps=False,
                    hovertemplate=f"%{{y:{strip.form}}}<extra>{escape(curve.label or curve.name)}</extra>",
                )
            )
        data += [
            {"type": "scatter", "mode": "markers", "showlegend": False, "yaxis": axis, **mark} for mark in strip.marks
        ]
        layout["yaxis" if row == 0 else f"yaxis{row + 1}"] = figures._axis(
            "", domain=[top - (1.0 - GAP) * share, top], nticks=4, zeroline=True
        )
        layout.setdefault("annotations", []).append(
            {
                "text": escape(strip.name),
                "xref": "paper",
                "yref": "paper",
                "x": 0.0,
                "y": top,
                "xanchor": "left",
                "yanchor": "bottom",
                "showarrow": False,
                "font": {"size": 12, "color": figures.SOFT},
            }
        )
        layout.setdefault("shapes", []).extend(_line_across(axis, value, colour) for value, colour in strip.lines)
    _mark_jumps(layout, jumps, title.startswith("chainage"))
    layout["xaxis"] = figures._axis(
        title, anchor=f"y{len(strips)}" if len(strips) > 1 else "y", domain=[0, 1], showspikes=True, spikemode="across"
    )
    layout["margin"] = {**layout["margin"], "t": 82}
    layout["legend"] = {**layout["legend"], "y": 1.0 + 34.0 / (height * len(strips))}
    fine = None
    if packed:
        even = np.arange(0, len(distance), max(1, len(distance) // 2000))
        after = np.searchsorted(distance, [where for where, _, _ in jumps])
        nodes = np.unique(np.concatenate([even, after, np.maximum(after - 1, 0), [len(distance) - 1]]))
        fine = {
            "first": float(distance[0]),
            "step": float(distance[1] - distance[0]),
            "count": len(distance),
            "nodes": [distance[nodes], x[nodes]],
            "traces": packed,
        }
    return Figure(identity, data, layout, moves=True, fine=fine)


def _line_across(axis: str, value: float, colour: str) -> dict[str, Any]:
    stroke = {"color": colour, "width": 1, "dash": "dot"}
    return {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "yref": axis, "y0": value, "y1": value, "line": stroke}


def _mark_jumps(layout: dict[str, Any], jumps: Sequence[tuple[float, float, float]], by_chainage: bool) -> None:
    """Mark where the published kilometres jump, with what they jump from and to: a line, or grey where kilometres are missing."""
    for where, before, after in jumps[:JUMPS_DRAWN]:
        ends = (before / 1e3, after / 1e3) if by_chainage else (where / 1e3, where / 1e3)
        layout["shapes"].append(
            {
                "type": "rect",
                "layer": "below",
                "xref": "x",
                "yref": "paper",
                "x0": ends[0],
                "x1": ends[1],
                "y0": 0,
                "y1": 1,
                "fillcolor": "rgba(93,107,118,0.10)",
                "line": {"color": figures.SOFT, "width": 0 if by_chainage else 1, "dash": "dash"},
            }
        )
        if len(jumps) <= JUMPS_NAMED:
            layout["annotations"].append(
                {
                    "text": f"km {before / 1e3:.3f} | {after / 1e3:.3f}",
                    "xref": "x",
                    "yref": "paper",
                    "x": ends[0],
                    "y": 0,
                    "yanchor": "bottom",
                    "showarrow": False,
                    "textangle": -90,
                    "xanchor": "right",
                    "font": {"size": 11, "color": figures.SOFT},
                }
            )


def pack(values: FloatArray, resolution: float) -> dict[str, Any]:
    """Pack values for a page: whole numbers of the resolution, their differences, deflated, in base64.

    Parameters
    ----------
    values : (n,) array
        NaN is kept as unknown.
    resolution : float
        Made coarser where the greatest value would not fit 16 bits.

    Returns
    -------
    dict
        `scale` and `data`.

    Examples
    --------
    >>> made = pack(np.array([1.0, 2.5, np.nan]), 0.5)
    >>> unpack(made["data"], made["scale"])
    array([1. , 2.5, nan])
    """
    known = np.isfinite(values)
    most = float(np.abs(values[known]).max()) if known.any() else 0.0
    scale = max(resolution, most / 32000.0)
    whole = np.where(known, np.rint(np.where(known, values, 0.0) / scale), UNKNOWN).astype("<i2")
    steps = np.diff(whole, prepend=np.zeros(1, "<i2")).astype("<i2")  # wraps around, and back when summed
    return {"scale": scale, "data": base64.b64encode(zlib.compress(steps.tobytes(), 6)).decode("ascii")}


def unpack(data: str, scale: float) -> FloatArray:
    """Undo `pack`, as the page does."""
    steps = np.frombuffer(zlib.decompress(base64.b64decode(data)), "<i2")
    whole = np.cumsum(steps, dtype=np.int64).astype("<i2")
    return np.where(whole == UNKNOWN, np.nan, whole * scale)


def resolution_of(sigma: float, size: float) -> float:
    """Resolution that a curve is worth: a quarter of its sigma, but no coarser than a two-hundredth of its spread."""
    worth = [value for value in (0.25 * sigma, 0.005 * size) if math.isfinite(value) and value > 0.0]
    return min(worth, default=1e-3)


def line_map(
    model: TrackModel,
    lines: Sequence[tuple[str, str, FloatArray, FloatArray, FloatArray]],
    *,
    marks: Sequence[dict[str, Any]] = (),
) -> Figure:
    """Draw the map: the model grey, lines blue, a dot that follows the pointer on their charts, and what a chart shows when zoomed.

    Parameters
    ----------
    model : TrackModel
    lines : sequence of (figure, name, x, easting, northing)
        Identity of the chart, name of the line, and along it the chart's axis and coordinates, m.
    marks : sequence of dict
        Traces of plotly.js in metres of the plane, each with `easting` and `northing`.

    Returns
    -------
    Figure
    """
    drawn = figures.plan(model)
    east0, north0, _, _ = figures._corner(model, None)
    data = list(drawn.data)
    places: dict[str, Any] = {}
    for identity, name, x, easting, northing in lines:
        east, north = (easting - east0) / 1e3, (northing - north0) / 1e3
        rows = figures.outline(easting, northing, 0.5)
        data.append(
            figures._line(
                escape(name),
                east[rows],
                north[rows],
                figures.ESTIMATE,
                line={"width": 2.5},
                hoverinfo="skip",
                showlegend=False,
            )
        )
        if identity:
            kept = np.linspace(0, len(x) - 1, min(len(x), 3000)).astype(np.int64)
            places[identity] = {"time": x[kept], "x": east[kept], "y": north[kept]}
    for mark in marks:
        at = {"x": (mark["easting"] - east0) / 1e3, "y": (mark["northing"] - north0) / 1e3}
        rest = {key: value for key, value in mark.items() if key not in ("easting", "northing")}
        data.append({"type": "scatter", "mode": "markers", **at, **rest})
    if not places:
        return Figure("plan", data, drawn.layout)
    first = next(iter(places.values()))
    seen = figures._line(
        "in view", [None], [None], figures.LIMIT, line={"width": 5}, hoverinfo="skip", showlegend=False
    )
    dot = {
        "type": "scatter",
        "mode": "markers",
        "name": "place",
        "x": [first["x"][0]],
        "y": [first["y"][0]],
        "marker": {"size": 14, "color": figures.WRONG, "line": {"width": 2, "color": "#fff"}},
        "hoverinfo": "skip",
        "showlegend": False,
    }
    marker = {**first, "places": places, "view": len(data), "trace": len(data) + 1}
    return Figure("plan", [*data, seen, dot], drawn.layout, marker=marker)
