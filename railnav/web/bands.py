"""What a drawing of an alignment shows of one track: its geometry by station, and its elements as bars in bands.

A band shows what the line does without a scale to read: a box above the axis is a curve to the right, its sloping sides are the
transitions; a gradient is a diagonal in its box. A track whose elements nobody has fitted is drawn by its own curvature, cant and
gradient, without boxes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.design import Design, DesignPoints
from railnav.track.elements import ARC, CLOTHOID, STRAIGHT

if TYPE_CHECKING:
    from railnav.monitoring.fitting import Fitted
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

RIGHT, LEFT, TURNING, RISE, CANT = "#1b6ca8", "#b5442e", "#7a8791", "#3a7d44", "#8a5a9e"

#: Shares of a track's length whose curvature may go beyond the band: single knots at its ends are often noise.
_BEYOND = 1e-3


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
            short = words = f"L {metres(length)}"
        elif plan.kind[j] == ARC:
            sigma_r = "" if fitted is None else _pm(float(fitted.radius_sigma[j]))
            short = f"R {metres(abs(1.0 / k0))}\nL {metres(length)}"
            words = (
                f"R {metres(abs(1.0 / k0))}{sigma_r} m {'right' if k0 > 0 else 'left'}, L {metres(length)}{sigma_l} m"
            )
        else:
            change = abs(k1 - k0)
            a = f" A {np.sqrt(length / change):.0f}" if plan.kind[j] == CLOTHOID and change > 0.0 else ""
            short = f"L {metres(length)}{a.replace(' A', chr(10) + 'A')}"
            words = f"{kind} L {metres(length)}{sigma_l} m{a}, R {radius_words(k0)} to {radius_words(k1)}"
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
                Bar(a + design.start, b + design.start, "grade", g0, g1, f"{1e3 * g0:.1f} \u2030\n{metres(b - a)}", "")
            )
        else:
            bend = float(profile(np.array([0.5 * (a + b)]), 2)[0])
            radius = abs(1.0 / bend) if bend else np.inf
            word = "sag" if bend > 0.0 else "crest"
            bars.append(Bar(a + design.start, b + design.start, word, g0, g1, f"R {metres(radius)}", word))
    return bars


def metres(value: float) -> str:
    """Metres as short as they are worth."""
    if not np.isfinite(value):
        return "\u221e"
    return f"{value:.0f}" if value >= 1000.0 or abs(value - round(value)) < 0.05 else f"{value:.1f}"


def _pm(sigma: float) -> str:
    return f" \u00b1{sigma:.2g}" if np.isfinite(sigma) and sigma > 0.0 else ""


def radius_words(bend: float) -> str:
    """Radius of a curvature in words, m."""
    return "\u221e" if bend == 0.0 else metres(abs(1.0 / bend))


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """One track as it is drawn.

    Attributes
    ----------
    track : str
        Identifier.
    start, length : float
        Station of its first point, and its length in the plane, m.
    at : callable
        From stations (n,) within it to `DesignPoints`; NaN heights and cants where it has none.
    sharpest : float
        Curvature to which the band reaches, 1/m.
    has_profile, has_cant : bool
    plan, profile : list of Bar
        Elements; none where nobody has fitted them.
    levels : list of (float, float, float)
        Stations from and to which cant is level, m, and the cant, m.
    design : Design or None
        Whose elements they are.
    fitted : Fitted or None
        What fitting found.
    accuracy : float
        Median sigma of a model's axis across the track, m; NaN where it states none, or where elements are drawn.
    """

    track: str
    start: float
    length: float
    at: Callable[[FloatArray], DesignPoints]
    sharpest: float
    has_profile: bool
    has_cant: bool
    plan: list[Bar]
    profile: list[Bar]
    levels: list[tuple[float, float, float]]
    design: Design | None = None
    fitted: Fitted | None = None
    accuracy: float = float("nan")

    @property
    def end(self) -> float:
        """Station of the last point, m."""
        return self.start + self.length

    @property
    def joints(self) -> FloatArray:
        """Stations where elements begin, and the end; empty without elements."""
        return np.array([bar.begin for bar in self.plan] + [bar.end for bar in self.plan[-1:]])

    def inside(self, station: FloatArray) -> DesignPoints:
        """Geometry at stations, those beyond the ends taken to them."""
        return self.at(np.clip(station, self.start, self.end))


def drawn_design(design: Design, fitted: Fitted | None = None) -> Drawn:
    """A design as it is drawn, with its elements."""
    sharp = np.maximum(np.abs(design.plan.curvature_start), np.abs(design.plan.curvature_end))
    levels: list[tuple[float, float, float]] = []
    if design.cant is not None:
        c = design.cant
        rows = zip(c.edges[:-1].tolist(), c.edges[1:].tolist(), c.start.tolist(), c.end.tolist(), strict=True)
        levels = [(a + design.start, b + design.start, u) for a, b, u, v in rows if abs(u - v) < 1e-6]
    return Drawn(
        design.track,
        design.start,
        design.length,
        design.at,
        float(max(sharp.max(initial=0.0), 1e-6)),
        design.profile is not None,
        design.cant is not None,
        plan_bars(design, fitted),
        gradient_bars(design),
        levels,
        design,
        fitted,
    )


def drawn_track(model: TrackModel, track: str) -> Drawn:
    """A track of a model as it is drawn: its own curvature, cant and gradient by length in the plane, no elements.

    Raises
    ------
    TrackError
        No such track.
    """
    own = model.knots(track)
    index = model.track_index(track)
    offset, east, north = model.offset[own], model.easting[own], model.northing[own]
    along = np.append(0.0, np.cumsum(np.hypot(np.diff(east), np.diff(north))))
    chainage = float(model.chainage(np.array([index]), offset[:1])[0])
    start = chainage if np.isfinite(chainage) else 0.0
    height, cant, covariance = model.height[own], model.cant[own], model.covariance_g[own]
    has_profile = bool(np.isfinite(height).all())
    has_cant = bool(np.isfinite(cant).all() and np.ptp(cant) > 0.0)
    bearing = model.grid_bearing[own]
    across = covariance[:, 0] * np.cos(bearing) ** 2 + covariance[:, 3] * np.sin(bearing) ** 2
    across = across - covariance[:, 1] * np.sin(2.0 * bearing)
    scale = float(np.mean(model.scale[own]))

    def at(station: FloatArray) -> DesignPoints:
        where = np.interp(station - start, along, offset)
        here = model.at(track, where)
        nothing = np.full(len(where), np.nan)
        return DesignPoints(
            station,
            here.easting,
            here.northing,
            here.grid_bearing,
            here.curvature / scale,
            here.height if has_profile else nothing,
            here.gradient if has_profile else nothing,
            here.cant if has_cant else nothing,
        )

    bend = np.abs(model.curvature[own])
    sharpest = float(max(np.quantile(bend, 1.0 - _BEYOND), 0.3 * bend.max(initial=0.0), 1e-6))
    finite = np.isfinite(across) & (across > 0.0)
    accuracy = float(np.sqrt(np.median(across[finite]))) if finite.any() else float("nan")
    return Drawn(track, start, float(along[-1]), at, sharpest, has_profile, has_cant, [], [], [], accuracy=accuracy)
