"""Allan deviations drawn: six curves with their error bars and the fitted noise, as a picture or a page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from railnav.errors import RailnavError
from railnav.web.figures import INK, PALETTE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from railnav.inertial.allan import AllanCurve, NoiseParameters

#: Panels: channels whose names begin so, factor to the unit drawn, its name.
_PANELS = (("gyro", math.degrees(1.0) * 3600.0, "deg/h"), ("accelerometer", 1e3 / 9.80665, "mg"))


def allan_picture(curves: Mapping[str, AllanCurve], fits: Mapping[str, NoiseParameters], *, title: str = "") -> Figure:
    """Draw the curves of gyros and accelerometers side by side.

    Parameters
    ----------
    curves, fits : mapping of str to AllanCurve and to NoiseParameters
        By channel: "gyro x", "accelerometer z", ...
    title : str
        Above the panels.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    RailnavError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RailnavError('pictures need matplotlib; install with: pip install "railnav[report]"') from error
    figure = Figure(figsize=(11.0, 5.0), dpi=110, layout="constrained", facecolor="white")
    for axes, (kind, factor, unit) in zip(figure.subplots(1, 2), _PANELS, strict=True):
        for k, (name, curve) in enumerate((n, c) for n, c in curves.items() if n.startswith(kind)):
            colour = PALETTE[k]
            y = factor * curve.deviation
            axes.loglog(curve.time, y, "o", color=colour, markersize=3, label=name[-1])
            axes.fill_between(
                curve.time,
                y / (1.0 + curve.relative_error),
                y * (1.0 + curve.relative_error),
                color=colour,
                alpha=0.15,
                linewidth=0,
            )
            axes.loglog(curve.time, factor * fits[name].deviation(curve.time), color=colour, linewidth=1.2)
        axes.set_xlabel("averaging time, s")
        axes.set_ylabel(f"Allan deviation, {unit}")
        axes.set_title(f"{kind}s: points measured, lines fitted", loc="left", fontsize=10, color=INK)
        axes.grid(visible=True, which="both", color="#eceff1", linewidth=0.7)
        axes.legend(frameon=False, fontsize=9)
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=13, fontweight="bold", color=INK)
    return figure


def allan_page(curves: Mapping[str, AllanCurve], fits: Mapping[str, NoiseParameters], *, title: str = "") -> str:
    """Draw the same as a page that stands alone, .html.

    Raises
    ------
    RailnavError
        If plotly is not installed.
    """
    try:
        import plotly.graph_objects as go
        from plotly.subplots import make_subplots
    except ImportError as error:
        raise RailnavError('pages need plotly; install with: pip install "railnav[report]"') from error
    figure = make_subplots(rows=1, cols=2, subplot_titles=[f"{kind}s, {unit}" for kind, _, unit in _PANELS])
    for column, (kind, factor, _) in enumerate(_PANELS, start=1):
        for k, (name, curve) in enumerate((n, c) for n, c in curves.items() if n.startswith(kind)):
            y = factor * curve.deviation
            figure.add_trace(
                go.Scatter(
                    x=curve.time,
                    y=y,
                    error_y={"type": "data", "array": y * curve.relative_error},
                    mode="markers",
                    marker={"color": PALETTE[k], "size": 5},
                    name=name,
                ),
                row=1,
                col=column,
            )
            figure.add_trace(
                go.Scatter(
                    x=curve.time,
                    y=factor * fits[name].deviation(curve.time),
                    mode="lines",
                    line={"color": PALETTE[k]},
                    name=f"{name}, fitted",
                ),
                row=1,
                col=column,
            )
        figure.update_xaxes(type="log", title="averaging time, s", row=1, col=column)
        figure.update_yaxes(type="log", row=1, col=column)
    figure.update_layout(title=title, template="plotly_white")
    return str(figure.to_html(include_plotlyjs=True, full_html=True))
