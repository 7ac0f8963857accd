"""Lining and lifting: from the measured track to its design, or to a smoothed target, within what a machine may do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.monitoring.design import Design
from railnav.monitoring.filters import low_pass, stretches
from railnav.monitoring.improvement import borne, borne_in_words, improved, spread_of
from railnav.monitoring.position import MeasuredAxis, shape_sigma
from railnav.monitoring.section import Section
from railnav.monitoring.smoothing import Bounds, FixedPoint, InfeasibleError, corrections, whittaker
from railnav.monitoring.target import SHORTEST, level_above, target_along
from railnav.monitoring.versines import Chord, slews_by_versines, versines_in_plan

FloatArray = NDArray[np.float64]

#: A plan on an axis known worse than this is not for a machine, m.
USABLE = 0.02
#: How fast corrections may begin and fade out, gentlest first, m/m.
RAMPS = (1e-3, 2e-3, 5e-3, 1e-2, 2e-2)
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
    ramp : float or None
        Greatest correction over the distance from the nearer end, m/m: how fast the work may begin and fade out. None: 1 mm/m, or
        as much more as the other limits need; the plan's notes say so.
    """

    most_slew: float = 0.10
    least_lift: float = 0.0
    most_lift: float = 0.10
    curvature_rate: float = 5e-6
    gradient_rate: float = 5e-6
    ramp: float | None = None


#: Limits and cut-off, m, that show the method on an axis known worse than `USABLE`: a machine's cannot smooth its errors.
WIDE, WIDE_CUTOFF = LiningLimits(1.0, 0.0, 1.0, 1e-4, 1e-4), 500.0
#: Cut-off of a smoothed target otherwise, m.
CUTOFF = 100.0


def usual_limits(measured: MeasuredAxis) -> tuple[LiningLimits, float]:
    """Limits and cut-off (m) that suit an axis: a machine's, or wide ones where it is known worse than `USABLE`.

    Examples
    --------
    >>> callable(usual_limits)
    True
    """
    coarse = math.isfinite(measured.sigma_right) and measured.sigma_right > USABLE
    return (WIDE, WIDE_CUTOFF) if coarse else (LiningLimits(), CUTOFF)


@dataclass(frozen=True, slots=True, eq=False)
class Lined:
    """The axis as measured and as planned, each step of the measured axis rather than each node.

    Attributes
    ----------
    distance : (n,) array
        m along the section.
    slew, lift : (n,) array
        As the machine interpolates them, m; lift NaN without heights.
    right, up : (n,) array
        Before: beside the target or base line, and above its profile, m.
    versine_before, versine_after : (n,) array
        On a chord of 20 m, m; NaN near the ends.
    channels : mapping of (str, str) to (array, array)
        Before and after by channel ("alignment", "longitudinal_level") and band, m; NaN near the ends.
    """

    distance: FloatArray
    slew: FloatArray
    lift: FloatArray
    right: FloatArray
    up: FloatArray
    versine_before: FloatArray
    versine_after: FloatArray
    channels: Mapping[tuple[str, str], tuple[FloatArray, FloatArray]]


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
    hallade_spread : mapping of (str, str) to (float, float)
        Like `spread`, of alignment, by the versine method's slews.
    sigma_slew, sigma_lift : (n,) array
        Standard deviation of each slew and lift by the errors of the measured axis, m: of its place where the target is a design, of its
        shape where the target is smoothed out of the axis itself. Neighbours share most of it.
    spread : mapping of (str, str) to (float, float)
        Standard deviation before and after by channel ("alignment", "longitudinal_level") and band, m.
    bears : mapping of (str, str) to (float, bool)
        By channel and band: sigma that the axis has there by the noise of its sensors, m (NaN where that is not known), and whether it
        bears corrections in that band: the sigma is at most a third of what was found there.
    measured : MeasuredAxis
    fine : Lined
        The same between the nodes, with the channels before and after.
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
    hallade_spread: Mapping[tuple[str, str], tuple[float, float]]
    sigma_slew: FloatArray
    sigma_lift: FloatArray
    spread: Mapping[tuple[str, str], tuple[float, float]]
    bears: Mapping[tuple[str, str], tuple[float, bool]]
    measured: MeasuredAxis
    fine: Lined
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
    alignment: str = "",
    step: float = 5.0,
    cutoff: float | None = None,
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
        The one named, or that bears the name of a track of the section, or lies along most of it, is used.
    alignment : str
        Name of the design meant, where several lie along the section.
    step : float
        Between nodes, m: 1 or 5, or another multiple of the measured axis's step.
    cutoff : float, optional
        Wavelength that the smoothed target halves, m.
    limits : LiningLimits, optional
        Both by default as `usual_limits` has them: 100 m and a machine's limits, wider ones where the axis is known too coarsely for any
        machine.
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
        The design misses the axis by more than a metre, or covers less than 100 m of it; the message says where. Several designs could be
        meant; the message names them.
    InfeasibleError
        Limits and fixed points contradict each other; the message names them.

    Notes
    -----
    10 km at 1 m take about a second.
    """
    usual, wave = usual_limits(measured)
    limits, cutoff = limits or usual, wave if cutoff is None else cutoff
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
    rows = np.arange(part.start, part.stop)
    sin, cos = np.sin(model.grid_bearing), np.cos(model.grid_bearing)
    scale = grid_scale(section, d)
    east, north = model.easting + right * scale * cos, model.northing - right * scale * sin
    height = model.height + up
    station = np.full(len(d), np.nan)
    name = ""
    if designs:
        target = target_along(designs, east, north, d, section, name=alignment)
        kept = target.rows
        notes += target.notes
        if kept.stop - kept.start < len(d):
            notes.append(
                f"the design covers {d[kept.stop - 1] - d[kept.start]:.0f} m of the {d[-1] - d[0]:.0f} m measured; the rest stays"
            )
        d, east, north, height, up = d[kept], east[kept], north[kept], height[kept], up[kept]
        sin, cos, scale, rows = sin[kept], cos[kept], scale[kept], rows[kept]
        station, design = target.station[kept], target.design
        deviation, name = target.sense * target.cross[kept], design.track
        level, said = level_above(design, station, height)
        notes += [said] if said else []
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
    aim = np.zeros(len(y)) if name else whittaker(y, step, cutoff)
    bounds = Bounds(-limits.most_slew, limits.most_slew, limits.curvature_rate)
    notes += _outside(fixed_slew, "slew", s, step) + _outside(fixed_lift, "lift", s, step)
    slew = _ramped("slews", limits.ramp, notes, measured, y, aim, step, bounds, fixed_slew, float(s[0]))
    lift, z = np.full(len(s), np.nan), np.full(len(s), np.nan)
    if np.isfinite(level).all():
        z = _noded(level, measured.step, step, nodes)
        goal = z if free_level else np.zeros(len(z))
        rise = Bounds(limits.least_lift, limits.most_lift, limits.gradient_rate)
        lift = _ramped("lifts", limits.ramp, notes, measured, z, goal, step, rise, fixed_lift, float(s[0]))
    else:
        notes.append("no heights along the whole stretch: no lifts")
    fine_slew, fine_lift = _between(s, slew, d), _between(s, lift, d)
    channels = improved(deviation, fine_slew, level, fine_lift, measured.step)
    spread = spread_of(channels)
    lined_east, lined_north = east + fine_slew * scale * cos, north - fine_slew * scale * sin
    chord = Chord.symmetric(CHORD)
    before, after = (
        versines_in_plan(e, n, measured.step, chord) for e, n in ((east, north), (lined_east, lined_north))
    )
    every = round(0.5 * CHORD / measured.step)
    strung = slews_by_versines(deviation[::every], math.nan if name else cutoff / (0.5 * CHORD))
    strings = {}
    if len(strung):
        inside = d <= d[::every][-1]
        along = _between(d[::every], strung, d[inside])
        strings = spread_of(improved(deviation[inside], along, np.empty(0), np.empty(0), measured.step))
    shape = [
        shape_sigma(noise, cutoff) if noise else relative
        for noise, relative in (
            (measured.noise_right, measured.relative_right),
            (measured.noise_up, measured.relative_up),
        )
    ]
    bears = borne(measured, spread)
    notes += borne_in_words(bears)
    if not (measured.sigma_right <= USABLE):
        wide = (
            f"; slews of up to {limits.most_slew:g} m and a curvature rate of {limits.curvature_rate:.0e} 1/m^2 only show the method"
            if limits.most_slew >= WIDE.most_slew
            else ""
        )
        notes.append(f"not for a machine: the axis is not known well enough for slews of millimetres{wide}")
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
        hallade_distance=d[::every][: len(strung)],
        hallade_slew=strung,
        hallade_spread=strings,
        sigma_slew=np.hypot(
            _sigma(measured.sigma_right, shape[0], measured.local_right, rows, bool(name))[nodes],
            _misplaced(measured, y - aim, step),
        ),
        sigma_lift=np.hypot(
            _sigma(measured.sigma_up, shape[1], measured.local_up, rows, not free_level)[nodes],
            _misplaced(measured, lift, step),
        ),
        spread=spread,
        bears=bears,
        measured=measured,
        fine=Lined(d, fine_slew, fine_lift, deviation, level, before, after, channels),
        design=name,
        cutoff=math.nan if name else cutoff,
        limits=limits,
        fixed_slew=tuple(fixed_slew),
        fixed_lift=tuple(fixed_lift),
        notes=tuple(notes),
    )


def _outside(fixed: Sequence[FixedPoint], what: str, nodes: FloatArray, step: float) -> list[str]:
    """Fixed points that the stretch lined does not reach."""
    first, last = float(nodes[0]) - 0.5 * step, float(nodes[-1]) + 0.5 * step
    return [
        f"fixed point {point.name!r} ({what}) at {point.start:.0f} m lies outside the stretch lined, {first:.0f} to {last:.0f} m: not used"
        for point in fixed
        if point.finish < first or point.start > last
    ]


def _sigma(place: float, shape: float, local: FloatArray | None, rows: NDArray[np.int64], absolute: bool) -> FloatArray:
    """Standard deviation of corrections at rows of the axis, m.

    A correction to a design carries the error of the axis's place; one to a line smoothed out of the axis itself only that of its shape,
    since what both share drops out.
    """
    relative = 1.0 if local is None else local[rows] / place
    return np.asarray((place if absolute or not math.isfinite(shape) else shape) * relative * np.ones(len(rows)))


def _misplaced(measured: MeasuredAxis, taken: FloatArray, step: float) -> float:
    """What an error of place along the track makes of corrections: root mean square slope of what they take out, times the error, m."""
    slope = np.diff(taken) / step
    return float(np.sqrt(np.mean(slope**2))) * measured.sigma_along if np.isfinite(slope).all() else math.nan


def _ramped(
    what: str,
    ramp: float | None,
    notes: list[str],
    measured: MeasuredAxis,
    deviation: FloatArray,
    target: FloatArray,
    step: float,
    bounds: Bounds,
    fixed: Sequence[FixedPoint],
    start: float,
) -> FloatArray:
    """Corrections that begin and fade out as gently as they can; a ramp that was asked for is kept."""
    if ramp is not None:
        return _corrected(what, measured, deviation, target, step, replace(bounds, ramp=ramp), fixed, start)
    for gentle in RAMPS:
        try:
            out = corrections(deviation, target, step, replace(bounds, ramp=gentle), fixed=fixed, start=start)
        except InfeasibleError:
            continue
        if gentle > RAMPS[0]:
            notes.append(
                f"{what} begin and fade out at up to {1e3 * gentle:.0f} mm a metre: gentler ramps at the ends of the work leave too much "
                "change of curvature there"
            )
        return out
    return _corrected(what, measured, deviation, target, step, bounds, fixed, start)


def _corrected(
    what: str,
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
            raise InfeasibleError(f"{what}: {error}") from error
        known = f"to {measured.sigma_right:.2f} m" if math.isfinite(measured.sigma_right) else "with no stated accuracy"
        wide = bounds.most >= WIDE.most_slew and bounds.third_difference >= WIDE.curvature_rate
        instead = (
            "line a stretch that was surveyed better"
            if wide
            else "slews of a metre, a curvature rate of 1e-4 1/m^2 and a cut-off of 500 m show the method on such data"
        )
        raise InfeasibleError(
            f"{what}: {error}; note that the axis is only known {known}, too coarse for lining; {instead}"
        ) from error


def _longest(measured: MeasuredAxis, notes: list[str]) -> slice:
    parts = stretches(np.isfinite(measured.right))
    if not parts:
        raise TrackError(f"nothing was measured on section {measured.section.name}")
    a, b = max(parts, key=lambda part: part[1] - part[0])
    length = (b - a - 1) * measured.step
    if length < SHORTEST:
        raise TrackError(f"the longest stretch measured without a gap is {length:.0f} m; lining takes {SHORTEST:.0f} m")
    if b - a < len(measured.right):
        ends = f"{measured.distance[a]:.0f} to {measured.distance[b - 1]:.0f} m along the section"
        notes.append(f"lined from {ends}: beyond, nothing was measured or asked for")
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
