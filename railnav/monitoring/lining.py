"""Lining and lifting: from the measured track to its design, or to a smoothed target, within what a machine may do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.monitoring.design import Design
from railnav.monitoring.filters import D1, D2, D3_ALIGNMENT, D3_LEVEL, Band, band_pass, low_pass, stretches
from railnav.monitoring.position import MeasuredAxis
from railnav.monitoring.section import Section
from railnav.monitoring.smoothing import Bounds, FixedPoint, InfeasibleError, corrections, whittaker
from railnav.monitoring.versines import Chord, closed_versines, hallade, versines_in_plan

FloatArray = NDArray[np.float64]

#: A design farther than this from the measured axis is not this track's, m.
FARTHEST = 1.0
#: Heights of a design farther than this from the measured ones have another datum, m.
FARTHEST_HEIGHT = 1.0
#: A foot this far ahead of or behind its point lies beyond the design's ends, m.
BEYOND = 0.05
#: Shortest stretch that is lined, m.
SHORTEST = 100.0
#: A plan on an axis known worse than this is not for a machine, m.
USABLE = 0.02
#: A shape known worse than this is said, m.
COARSE_SHAPE = 0.002
#: Chord of the versines, m.
CHORD = 20.0


@dataclass(frozen=True, slots=True)
class LiningLimits:
    """What the machine and the track allow.

    Attributes
    ----------
    most_slew : float
        Either way, m.
    least_lift, most_lift : float
        m; 0 and more for a machine that cannot lower.
    curvature_rate : float
        Greatest third derivative of the deviation left in plan, 1/m^2.
    gradient_rate : float
        The same in profile, 1/m^2.
    """

    most_slew: float = 0.10
    least_lift: float = 0.0
    most_lift: float = 0.10
    curvature_rate: float = 5e-6
    gradient_rate: float = 5e-6


@dataclass(frozen=True, slots=True, eq=False)
class LiningPlan:
    """Slews and lifts along a section.

    Attributes
    ----------
    section : Section
    distance : (n,) array
        Nodes, m along the section.
    easting, northing, height : (n,) array
        The measured axis, m.
    station : (n,) array
        Of the design, m; NaN without one.
    slew, lift : (n,) array
        What to move: to the right as distance grows, and up, m; lift NaN without heights.
    right_before, right_after : (n,) array
        Beside the design (or the smooth base), m.
    up_before, up_after : (n,) array
        Above the design's profile (or the model's), m.
    versine_before, versine_after : (n,) array
        On a chord of 20 m, m; NaN near the ends.
    hallade_distance, hallade_slew : (k,) array
        The versine method beside it: points and slews, m.
    spread : mapping of (str, str) to (float, float)
        Standard deviation before and after by channel ("alignment", "longitudinal_level") and band, m.
    measured : MeasuredAxis
    design : str
        The design's track; empty for a smoothed target.
    cutoff : float
        Of the smoothed target, m; NaN with a design.
    limits : LiningLimits
    fixed_slew, fixed_lift : tuple of FixedPoint
    notes : tuple of str
    """

    section: Section
    distance: FloatArray
    easting: FloatArray
    northing: FloatArray
    height: FloatArray
    station: FloatArray
    slew: FloatArray
    lift: FloatArray
    right_before: FloatArray
    right_after: FloatArray
    up_before: FloatArray
    up_after: FloatArray
    versine_before: FloatArray
    versine_after: FloatArray
    hallade_distance: FloatArray
    hallade_slew: FloatArray
    spread: Mapping[tuple[str, str], tuple[float, float]]
    measured: MeasuredAxis
    design: str
    cutoff: float
    limits: LiningLimits
    fixed_slew: tuple[FixedPoint, ...] = ()
    fixed_lift: tuple[FixedPoint, ...] = ()
    notes: tuple[str, ...] = field(default_factory=tuple)

    @property
    def usable(self) -> bool:
        """Whether the measured axis is known to `USABLE` or better, so that slews of millimetres mean anything."""
        return self.measured.sigma_right <= USABLE


def line_up(
    measured: MeasuredAxis,
    *,
    designs: Sequence[Design] = (),
    step: float = 5.0,
    cutoff: float = 100.0,
    limits: LiningLimits | None = None,
    fixed_slew: Sequence[FixedPoint] = (),
    fixed_lift: Sequence[FixedPoint] = (),
    smooth_base: bool = False,
) -> LiningPlan:
    """Plan slews and lifts.

    With a design, deviations from it are brought to zero as nearly as limits allow; without one, to a target smoothed by a Whittaker
    smoother with third differences, and lifts are the smallest that smooth the profile upwards. Both are linear programmes.

    Parameters
    ----------
    measured : MeasuredAxis
    designs : sequence of Design
        The one that lies along most of the section is used.
    step : float
        Between nodes, m: 1 or 5, or another multiple of the measured axis's step.
    cutoff : float
        Wavelength that the smoothed target halves, m.
    limits : LiningLimits, optional
    fixed_slew, fixed_lift : sequence of FixedPoint
    smooth_base : bool
        Without a design: measure deviations from the model's axis smoothed to the cut-off, not from the axis itself: right where the model
        was surveyed and carries the track's own roughness.

    Returns
    -------
    LiningPlan

    Raises
    ------
    TrackError
        The design misses the axis by more than a metre, or covers less than 100 m of it; the message says where.
    InfeasibleError
        Limits and fixed points contradict each other; the message names them.

    Notes
    -----
    10 km at 1 m take about a second.
    """
    limits = limits or LiningLimits()
    every = step / measured.step
    if abs(every - round(every)) > 1e-9 or every < 1.0:
        raise TrackError(f"nodes each {step} m do not fit an axis measured each {measured.step} m")
    k = round(every)
    notes = list(measured.notes)
    if measured.relative_right > COARSE_SHAPE:
        notes.append(
            f"the shape of the track is known to {1e3 * measured.relative_right:.1f} mm only (no angles, or too far apart): smaller "
            "corrections follow noise"
        )
    part = _longest(measured, notes)
    section, d = measured.section, measured.distance[part]
    model = section.at(d)
    right, up = measured.right[part], measured.up[part]
    sin, cos = np.sin(model.grid_bearing), np.cos(model.grid_bearing)
    scale = grid_scale(section, d)
    east, north = model.easting + right * scale * cos, model.northing - right * scale * sin
    height = model.height + up
    station = np.full(len(d), np.nan)
    name = ""
    if designs:
        design, sense, kept, station, cross = _against(designs, east, north, d, section)
        if kept.stop - kept.start < len(d):
            notes.append(
                f"the design covers {d[kept.stop - 1] - d[kept.start]:.0f} m of the {d[-1] - d[0]:.0f} m measured; the rest stays"
            )
        d, east, north, height, station, up = d[kept], east[kept], north[kept], height[kept], station[kept], up[kept]
        sin, cos, scale = sin[kept], cos[kept], scale[kept]
        deviation, name = sense * cross[kept], design.track
        level = _level_against(design, station, height, notes)
        if np.isnan(level).all() and np.isfinite(height).all() and design.profile is None:
            notes.append("the design has no profile: lifts smooth the profile as measured")
            level = up
            free_level = True
        else:
            free_level = False
    else:
        base_east, base_north = model.easting, model.northing
        if smooth_base:
            base_east = whittaker(model.easting - model.easting[0], measured.step, cutoff) + model.easting[0]
            base_north = whittaker(model.northing - model.northing[0], measured.step, cutoff) + model.northing[0]
        deviation = ((east - base_east) * cos - (north - base_north) * sin) / scale
        level, free_level = up, True
        if smooth_base and np.isfinite(height).all():
            level = height - whittaker(height - height[0], measured.step, cutoff) - height[0]
    nodes = slice(0, (len(d) - 1) // k * k + 1, k)
    y = _noded(deviation, measured.step, step, nodes)
    s = d[nodes]
    target = np.zeros(len(y)) if name else whittaker(y, step, cutoff)
    bounds = Bounds(-limits.most_slew, limits.most_slew, limits.curvature_rate)
    slew = _corrected(measured, y, target, step, bounds, fixed_slew, float(s[0]))
    lift, z = np.full(len(s), np.nan), np.full(len(s), np.nan)
    if np.isfinite(level).all():
        z = _noded(level, measured.step, step, nodes)
        goal = z if free_level else np.zeros(len(z))
        rise = Bounds(limits.least_lift, limits.most_lift, limits.gradient_rate)
        lift = _corrected(measured, z, goal, step, rise, fixed_lift, float(s[0]))
    else:
        notes.append("no heights along the whole stretch: no lifts")
    fine_slew, fine_lift = _between(s, slew, d), _between(s, lift, d)
    spread = _spread(deviation, fine_slew, level, fine_lift, measured.step)
    lined_east, lined_north = east + fine_slew * scale * cos, north - fine_slew * scale * sin
    chord = Chord.symmetric(CHORD)
    before, after = (
        versines_in_plan(e, n, measured.step, chord) for e, n in ((east, north), (lined_east, lined_north))
    )
    classic = _classic(before, deviation, d, measured.step, cutoff, bool(name))
    return LiningPlan(
        section=section,
        distance=s,
        easting=east[nodes],
        northing=north[nodes],
        height=height[nodes],
        station=station[nodes],
        slew=slew,
        lift=lift,
        right_before=y,
        right_after=y + slew,
        up_before=z,
        up_after=z + lift,
        versine_before=before[nodes],
        versine_after=after[nodes],
        hallade_distance=classic[0],
        hallade_slew=classic[1],
        spread=spread,
        measured=measured,
        design=name,
        cutoff=math.nan if name else cutoff,
        limits=limits,
        fixed_slew=tuple(fixed_slew),
        fixed_lift=tuple(fixed_lift),
        notes=tuple(notes),
    )


def _corrected(
    measured: MeasuredAxis,
    deviation: FloatArray,
    target: FloatArray,
    step: float,
    bounds: Bounds,
    fixed: Sequence[FixedPoint],
    start: float,
) -> FloatArray:
    """Corrections, or why there are none: also that the axis itself is not known well enough for such limits."""
    try:
        return corrections(deviation, target, step, bounds, fixed=fixed, start=start)
    except InfeasibleError as error:
        if measured.sigma_right <= USABLE:
            raise
        known = f"to {measured.sigma_right:.2f} m" if math.isfinite(measured.sigma_right) else "with no stated accuracy"
        raise InfeasibleError(f"{error}; note that the axis is only known {known}, too coarse for lining") from error


def _longest(measured: MeasuredAxis, notes: list[str]) -> slice:
    parts = stretches(np.isfinite(measured.right))
    if not parts:
        raise TrackError(f"nothing was measured on section {measured.section.name}")
    a, b = max(parts, key=lambda part: part[1] - part[0])
    length = (b - a - 1) * measured.step
    if length < SHORTEST:
        raise TrackError(f"the longest stretch measured without a gap is {length:.0f} m; lining takes {SHORTEST:.0f} m")
    if b - a < len(measured.right):
        notes.append(
            f"lined from {measured.distance[a]:.0f} to {measured.distance[b - 1]:.0f} m: the runs leave gaps beyond"
        )
    return slice(a, b)


def grid_scale(section: Section, distance: FloatArray) -> FloatArray:
    """Grid metres per ground metre along the section."""
    model = section.model
    track, offset = section.locate(distance)
    out = np.empty(len(distance))
    for i in np.unique(track):
        knots = slice(int(model.knot_start[i]), int(model.knot_start[i + 1]))
        here = track == i
        out[here] = np.interp(offset[here] + model.offset[knots][0], model.offset[knots], model.scale[knots])
    return out


def _against(
    designs: Sequence[Design], east: FloatArray, north: FloatArray, distance: FloatArray, section: Section
) -> tuple[Design, float, slice, FloatArray, FloatArray]:
    """The design along most of the axis, its sense, the rows it covers, their stations and distances to its right."""
    sample = slice(0, len(east), max(1, len(east) // 400))
    best: tuple[int, float, Design] | None = None
    for design in designs:
        feet = design.project(east[sample], north[sample])
        over = np.abs(feet.distance - np.abs(feet.cross)) < BEYOND
        rank = (int((over & (np.abs(feet.cross) < FARTHEST)).sum()), -float(np.median(feet.distance)))
        if best is None or rank > best[:2]:
            best = (*rank, design)
    assert best is not None
    design = best[2]
    feet = design.project(east, north)
    over = np.abs(feet.distance - np.abs(feet.cross)) < BEYOND
    parts = stretches(over)
    a, b = max(parts, key=lambda part: part[1] - part[0]) if parts else (0, 0)
    covered = float(distance[b - 1] - distance[a]) if b > a else 0.0
    if covered < SHORTEST:
        raise TrackError(
            f"design {design.track!r} covers {covered:.0f} m of section {section.name}, too little to line; is it this track's design?"
        )
    worst = a + int(np.argmax(np.abs(feet.cross[a:b])))
    if abs(feet.cross[worst]) > FARTHEST:
        track, offset = section.locate(distance[worst])
        raise TrackError(
            f"design {design.track!r} misses the measured axis by {abs(float(feet.cross[worst])):.2f} m on track "
            f"{section.model.track_id[int(track)]!r} at {float(offset):.0f} m (station {feet.station[worst]:.0f} m; median "
            f"{float(np.median(np.abs(feet.cross[a:b]))):.2f} m): not this track's design, or another plane"
        )
    sense = 1.0 if feet.station[b - 1] >= feet.station[a] else -1.0
    return design, sense, slice(a, b), feet.station, feet.cross


def _level_against(design: Design, station: FloatArray, height: FloatArray, notes: list[str]) -> FloatArray:
    """Measured height above the design's profile; NaN where there is none, or its datum is another."""
    nothing = np.full(len(station), np.nan)
    if design.profile is None:
        return nothing
    level = height - design.at(station).height
    if not np.isfinite(level).all():
        return nothing
    middle = float(np.median(level))
    if abs(middle) > FARTHEST_HEIGHT:
        notes.append(f"the design's heights lie {-middle:+.2f} m from the measured ones (another datum?): no lifts")
        return nothing
    return level


def _noded(values: FloatArray, fine: float, step: float, nodes: slice) -> FloatArray:
    """Values at the nodes, waves shorter than two steps smoothed away; a straight continuation beyond the ends."""
    if step < 2.0 * fine:
        return values[nodes]
    pad = min(len(values) - 1, round(4.0 * step / fine))
    wide = np.concatenate([2 * values[0] - values[pad:0:-1], values, 2 * values[-1] - values[-2 : -pad - 2 : -1]])
    return low_pass(wide, fine, 2.0 * step)[pad : pad + len(values)][nodes]


def _between(nodes: FloatArray, values: FloatArray, distance: FloatArray) -> FloatArray:
    """Corrections between nodes, as the machine would interpolate: cubic, and constant beyond the last node."""
    from scipy.interpolate import PchipInterpolator

    if not np.isfinite(values).all():
        return np.full(len(distance), np.nan)
    return np.asarray(PchipInterpolator(nodes, values)(np.clip(distance, nodes[0], nodes[-1])))


def _spread(
    right: FloatArray, slew: FloatArray, up: FloatArray, lift: FloatArray, step: float
) -> dict[tuple[str, str], tuple[float, float]]:
    """Standard deviations in the bands, before and after."""
    found: dict[tuple[str, str], tuple[float, float]] = {}
    for name, values, change, bands in (
        ("alignment", right, slew, (D1, D2, D3_ALIGNMENT)),
        ("longitudinal_level", up, lift, (D1, D2, D3_LEVEL)),
    ):
        if not (np.isfinite(values).all() and np.isfinite(change).all()):
            continue
        for band in bands:
            if step <= band.lower / 3.0 and len(values) * step > 4.0 * band.upper:
                found[name, band.name] = (_sd(values, step, band), _sd(values + change, step, band))
    return found


def _sd(values: FloatArray, step: float, band: Band) -> float:
    out = band_pass(values, step, band)
    return float(np.nanstd(out))


def _classic(
    versine: FloatArray, deviation: FloatArray, distance: FloatArray, step: float, cutoff: float, designed: bool
) -> tuple[FloatArray, FloatArray]:
    """Slews by the versine method on half chords of 10 m, from the versines as measured to smoothed or designed ones."""
    every = round(0.5 * CHORD / step)
    rows = np.arange(0, len(versine), every)
    rows = rows[np.isfinite(versine[rows])]
    if len(rows) < 8:
        return np.empty(0), np.empty(0)
    v_e = versine[rows]
    if designed:  # the design's versines: those measured, less what the deviation adds to them
        y = deviation[rows]
        own = np.zeros(len(rows))
        own[1:-1] = 0.5 * (y[:-2] + y[2:]) - y[1:-1]
        v_d = v_e - own
    else:
        v_d = whittaker(v_e, 0.5 * CHORD, cutoff)
    closed = closed_versines(v_e, v_d)
    return distance[rows], hallade(v_e, closed).slew
