"""A picture of what planes do to the metre along a line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RailnavError
from railnav.web.figures import INK, SOFT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]

_COLOURS = ("#1f6f8b", "#d9822b", "#5b8c3a", "#8a4f9e", "#b03a48")


def distortion_figure(
    curves: Sequence[tuple[str, FloatArray, FloatArray]],
    *,
    height: tuple[FloatArray, FloatArray] | None = None,
    title: str = "",
    limit: float | None = 10e-6,
) -> Figure:
    """Draw distortion along a line, one curve a plane or section; beneath it the ground.

    Parameters
    ----------
    curves : sequence of (name, station, distortion)
        Stations in m, distortion as a ratio (1e-6 is a millimetre a kilometre).
    height : (station, height), optional
        Of the ground, m.
    title : str
        Words above.
    limit : float, optional
        A band to either side of zero.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    RailnavError
        If matplotlib is not installed, or there is nothing to draw.
    """
    if not curves:
        raise RailnavError("nothing to draw: no plane")
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RailnavError('pictures need matplotlib; install with: pip install "railnav[report]"') from error
    rows = 2 if height is not None else 1
    figure = Figure(figsize=(11.0, 3.6 + 1.8 * (rows - 1)), dpi=110, layout="constrained", facecolor="white")
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False, height_ratios=[2.4, 1.0][:rows])[:, 0]
    above = axes[0]
    if limit is not None:
        above.axhspan(-limit * 1e6, limit * 1e6, color="#e8f1f4", zorder=0)
    for i, (name, station, ratio) in enumerate(curves):
        above.plot(station / 1e3, ratio * 1e6, color=_COLOURS[i % len(_COLOURS)], linewidth=1.6, label=name)
    above.axhline(0.0, color=SOFT, linewidth=0.8)
    above.set_ylabel("plane less ground, mm/km")
    above.legend(frameon=False, fontsize=9, labelcolor=INK, loc="best")
    if title:
        above.set_title(title, loc="left", fontsize=13, fontweight="semibold", color=INK, pad=10)
    if height is not None:
        axes[1].fill_between(height[0] / 1e3, height[1], float(np.min(height[1])), color="#d8dee2", linewidth=0)
        axes[1].plot(height[0] / 1e3, height[1], color=SOFT, linewidth=1.0)
        axes[1].set_ylabel("height, m")
    axes[-1].set_xlabel("km along the line")
    for axis in axes:
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
        axis.tick_params(colors=SOFT, labelsize=9)
        axis.grid(visible=True, color="#eceff1", linewidth=0.8)
        axis.set_axisbelow(True)
    return figure
