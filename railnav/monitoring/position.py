"""The measured axis: where the track lies beside and above the model, from the positions and angles of runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.monitoring.filters import Band, band_noise, gain, low_pass, stretches
from railnav.monitoring.recording import Recording, Series
from railnav.monitoring.section import Section

FloatArray = NDArray[np.float64]

#: Waves longer than this come from GNSS positions, shorter ones from angles, m.
CROSSOVER = 300.0
#: Positions alone are smoothed to waves of at least this, m.
SHORTEST_ALONE = 30.0
#: Runs whose smoothed positions scatter more than this are not used: they would only spoil the model's axis, m.
COARSEST = 0.03


@dataclass(frozen=True, slots=True)
class AxisNoise:
    """What one run's noise leaves in the shape of the axis.

    Attributes
    ----------
    position, position_spacing : float
        Sigma of a fix, m, and the distance between fixes, m.
    angle, angle_spacing : float
        Sigma of an angle, rad, and the distance between samples, m; 0 without angles.
    crossover : float
        Wave at which the one takes over from the other (`CROSSOVER`), m.
    share : float
        Weight of the run in the mean.
    """

    position: float
    position_spacing: float
    angle: float
    angle_spacing: float
    crossover: float
    share: float = 1.0


def shape_sigma(noise: Sequence[AxisNoise], cutoff: float) -> float:
    """Standard deviation that runs leave in the waves of an axis that a Whittaker smoother of a cut-off takes out.

    The densities of position and angle noise through the crossover G and past the smoother S,

        sigma^2 = sum share^2 integral |1 - S|^2 [ 2 s_p^2 d_p G^2 + 2 s_a^2 d_a (1 - G)^2 / (2 pi f)^2 ] df.

    Parameters
    ----------
    noise : sequence of AxisNoise
    cutoff : float
        m.

    Returns
    -------
    float
        m; NaN without runs.

    References
    ----------
    docs/theory/geometry.md (16).

    Examples
    --------
    >>> angles = AxisNoise(0.02, 30.0, 4e-5, 0.2, 300.0)
    >>> bool(shape_sigma([angles], 100.0) < 0.2e-3 < 2e-3 < shape_sigma([AxisNoise(0.02, 30.0, 0.0, 0.0, 90.0)], 100.0))
    True
    """
    f = np.geomspace(1.0 / (20.0 * cutoff), 1.0 / 3.0, 2000)
    return _through(noise, f, 1.0 - 1.0 / (1.0 + (cutoff * f) ** 6))


def band_sigma(noise: Sequence[AxisNoise], band: Band) -> float:
    """Standard deviation that runs leave in an axis within a band, m; NaN without runs: `shape_sigma` with the band's gain for 1 - S."""
    f = np.geomspace(1.0 / (4.0 * band.upper), 4.0 / band.lower, 2000)
    return _through(noise, f, gain(1.0 / f, band))


def _through(noise: Sequence[AxisNoise], f: FloatArray, passed: FloatArray) -> float:
    """Sigma of the noise through a filter of given gain at frequencies, 1/m."""
    if not noise:
        return math.nan
    total = 0.0
    for one in noise:
        low = 0.5 ** ((one.crossover * f) ** 2)
        density = 2.0 * one.position**2 * one.position_spacing * low**2
        if one.angle_spacing > 0.0:
            density = density + 2.0 * one.angle**2 * one.angle_spacing * ((1.0 - low) / (2.0 * np.pi * f)) ** 2
        total += one.share**2 * float(np.trapezoid(passed**2 * density, f))
    return math.sqrt(total)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredAxis:
    """The track as measured, on a uniform grid of a section.

    Attributes
    ----------
    section : Section
    step : float
        m.
    distance : (n,) array
        m.
    right, up : (n,) array
        Of the track beside and above the model's axis, m; up NaN where no heights are known.
    sigma_right, sigma_up : float
        Standard deviation of the place of the axis (long waves included), m; NaN unknown.
    relative_right, relative_up : float
        Standard deviation of the shape within waves up to `CROSSOVER`, m; NaN unknown.
    runs : tuple of str
        Runs whose measurements shape it.
    notes : tuple of str
        What was used, what not, and why.
    local_right, local_up : (n,) array or None
        Standard deviation place by place, where runs or the model's knots differ along the section, m; NaN where nothing was measured.
    noise_right, noise_up : tuple of AxisNoise
        Of each run, for `shape_sigma`.
    sigma_along : float
        Standard deviation of the place along the track that values stand at, m; 0 where they are the model's own.
    """

    section: Section
    step: float
    distance: FloatArray
    right: FloatArray
    up: FloatArray
    sigma_right: float
    sigma_up: float
    relative_right: float
    relative_up: float
    runs: tuple[str, ...]
    notes: tuple[str, ...]
    local_right: FloatArray | None = None
    local_up: FloatArray | None = None
    noise_right: tuple[AxisNoise, ...] = ()
    noise_up: tuple[AxisNoise, ...] = ()
    sigma_along: float = 0.0


def stretch_of(measured: MeasuredAxis, start: float, finish: float, *, by_chainage: bool = False) -> MeasuredAxis:
    """The part of a measured axis between two places; what lies beyond counts as not measured.

    Parameters
    ----------
    measured : MeasuredAxis
    start, finish : float
        Distances along the section, or published chainages, m.
    by_chainage : bool

    Returns
    -------
    MeasuredAxis

    Raises
    ------
    TrackError
        Nothing of the section lies between them, or the published kilometres name more than one stretch of it.
    """
    low, high = min(start, finish), max(start, finish)
    along = measured.distance
    if by_chainage:
        along = measured.section.model.chainage(*measured.section.locate(measured.distance))
        if not np.isfinite(along).any():
            raise TrackError(
                f"section {measured.section.name} has no published kilometres; name the stretch by metres along it"
            )
    inside = (along >= low - 1e-6) & (along <= high + 1e-6)
    parts = stretches(inside)
    unit, scale = ("km", 1e3) if by_chainage else ("m", 1.0)
    words = f"{low / scale:g} to {high / scale:g} {unit}"
    if not parts:
        there = f"{np.nanmin(along) / scale:.6g} to {np.nanmax(along) / scale:.6g} {unit}"
        raise TrackError(f"{words} does not lie on section {measured.section.name}, which has {there}")
    if len(parts) > 1:
        where = ", ".join(f"{measured.distance[a]:.0f} to {measured.distance[b - 1]:.0f} m" for a, b in parts[:4])
        raise TrackError(
            f"{words} names {len(parts)} stretches of section {measured.section.name} ({where} along it): its kilometres jump; name one "
            "by metres"
        )
    return replace(measured, right=np.where(inside, measured.right, np.nan), up=np.where(inside, measured.up, np.nan))


def measured_axis(section: Section, recordings: Sequence[Recording], *, step: float = 0.5) -> MeasuredAxis:
    """Join the positions and angles of runs into one measured axis beside the model.

    Long waves come from GNSS, shorter ones from the integral of the angles (complementary filter; both zero-phase), then the runs are
    averaged. Runs whose smoothed positions scatter by more than 3 cm do not take part; without any run that does, the model's own axis is
    the measured one.

    Parameters
    ----------
    section : Section
    recordings : sequence of Recording
        Made with `against_model=True` on this section.
    step : float
        Of the result, m: a multiple of the recordings' step.

    Returns
    -------
    MeasuredAxis

    References
    ----------
    docs/theory/geometry.md (11).
    """
    grid = section.grid(step)
    notes: list[str] = []
    used: list[Recording] = []
    parts: list[_Part] = []
    rises: list[_Part] = []
    for recording in recordings:
        if not recording.against_model:
            raise TrackError(f"the recording of run {recording.run.id!r} was not made against the model")
        stride = step / recording.step
        if abs(stride - round(stride)) > 1e-9:
            raise TrackError(f"a step of {step} m is no multiple of the recordings' {recording.step} m")
        plan = _joined(recording, "plan_gnss", "bearing")
        if plan is None:
            notes.append(f"run {recording.run.id}: no GNSS positions on the section; not used for the axis")
            continue
        if not plan.sigma <= COARSEST:
            good = f"good to {_mm(plan.sigma)}, not to {_mm(COARSEST)}"
            notes.append(f"run {recording.run.id}: its smoothed positions are {good}; not used for the axis")
            continue
        used.append(recording)
        parts.append(replace(plan, values=_on(plan.values, recording, grid)))
        rise = _joined(recording, "height_gnss", "slope")
        if rise is not None and rise.sigma <= 2.0 * COARSEST:
            rises.append(replace(rise, values=_on(rise.values, recording, grid)))
    model = section.at(grid)
    if not parts:
        local_cross, local_height = _model_sigma(section, grid)
        sigma_cross, sigma_height = _median(local_cross), _median(local_height)
        notes.append(
            "the measured axis is the model's own"
            + (
                f", good to {_mm(sigma_cross)} across"
                if math.isfinite(sigma_cross)
                else ", whose accuracy is not known"
            )
        )
        flat = np.zeros(len(grid))
        return MeasuredAxis(
            section,
            step,
            grid,
            flat,
            np.where(np.isfinite(model.height), 0.0, np.nan),
            sigma_cross,
            sigma_height,
            math.nan,
            math.nan,
            (),
            tuple(notes),
            local_cross,
            local_height,
        )
    right, local_right, relative_right, noise_right = _mean(parts)
    unknown = np.full(len(grid), np.nan)
    up, local_up, relative_up, noise_up = _mean(rises) if rises else (unknown, unknown, math.nan, ())
    sigma_right, sigma_up = _median(local_right), _median(local_up)
    return MeasuredAxis(
        section,
        step,
        grid,
        right,
        up,
        sigma_right,
        sigma_up,
        relative_right,
        relative_up,
        tuple(dict.fromkeys(recording.run.id for recording in used)),
        tuple(notes),
        local_right,
        local_up,
        noise_right,
        noise_up,
        math.hypot(*(one.share * recording.passage.sigma for one, recording in zip(noise_right, used, strict=True))),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Displacement of one run, its sigma in place, its sigma in shape, and where the latter is from."""

    values: FloatArray
    sigma: float
    relative: float
    noise: AxisNoise


def _joined(recording: Recording, position: str, angle: str) -> _Part | None:
    """Displacement of one run on its own grid."""
    of = recording.series.get(position)
    if of is None or not np.isfinite(of.values).any():
        return None
    turn = recording.series.get(angle)
    fine = turn is not None and turn.spacing <= 1.0
    wave = CROSSOVER if fine else max(SHORTEST_ALONE, 3.0 * of.spacing)
    white = of.noise * math.sqrt(2.0 * of.spacing / wave)
    slow = _slow(of, recording.step, wave)
    smooth = low_pass(of.values, recording.step, wave)
    if not fine or turn is None:
        return _Part(smooth, math.hypot(white, slow), white, AxisNoise(of.noise, of.spacing, 0.0, 0.0, wave))
    shape = np.full(len(smooth), np.nan)
    for a, b in stretches(np.isfinite(turn.values)):
        if b - a < 8:
            continue
        integral = np.append(0.0, np.cumsum(0.5 * (turn.values[a : b - 1] + turn.values[a + 1 : b]))) * recording.step
        s = np.arange(b - a, dtype=float)
        integral -= np.polyval(np.polyfit(s, integral, 1), s)
        shape[a:b] = integral - low_pass(integral, recording.step, wave)
    relative = band_noise(turn.noise, turn.spacing, Band("shape", 3.0, wave), integrate=1)
    # of the positions' noise about a third lies in waves up to the crossover, where the smoothing lets go
    relative = math.hypot(relative, white / 3.0)
    noise = AxisNoise(of.noise, of.spacing, turn.noise, turn.spacing, wave)
    return _Part(smooth + shape, math.hypot(white, slow), relative, noise)


def _slow(of: Series, step: float, wave: float) -> float:
    """Slow errors of a receiver that no smoothing removes: taken as two thirds of what a fix is good to; all of it on a short stretch."""
    known = np.isfinite(of.values)
    if known.sum() * step < 3.0 * wave:
        return of.noise
    return 2.0 / 3.0 * of.noise


def _on(values: FloatArray, recording: Recording, grid: FloatArray) -> FloatArray:
    known = np.isfinite(values)
    if known.sum() < 2:
        return np.full(len(grid), np.nan)
    stride = round((grid[1] - grid[0]) / recording.step)
    out = np.full(len(grid), np.nan)
    taken = values[::stride][: len(grid)]
    out[: len(taken)] = taken
    return out


def _mean(parts: Sequence[_Part]) -> tuple[FloatArray, FloatArray, float, tuple[AxisNoise, ...]]:
    """Weighted mean of runs where they are, its sigma place by place, that of its shape, and the noise of each run."""
    weight = np.array([1.0 / max(part.sigma, 1e-6) ** 2 for part in parts])
    values = np.array([part.values for part in parts])
    known = np.isfinite(values)
    total = (weight[:, None] * known).sum(axis=0)
    there = total > 0.0
    safe = np.where(there, total, 1.0)
    mean = np.where(there, (weight[:, None] * np.where(known, values, 0.0)).sum(axis=0) / safe, np.nan)
    share = weight / weight.sum()
    relative = math.sqrt(float(np.sum((share * np.array([part.relative for part in parts])) ** 2)))
    noise = tuple(replace(part.noise, share=float(s)) for part, s in zip(parts, share, strict=True))
    return mean, np.where(there, 1.0 / np.sqrt(safe), np.nan), relative, noise


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _model_sigma(section: Section, grid: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sigma of the model's axis across and in height along the section, m; NaN where it states none."""
    model = section.model
    track, offset = section.locate(grid)
    across, height = np.full(len(grid), np.nan), np.full(len(grid), np.nan)
    for i in np.unique(track):
        rows = slice(int(model.knot_start[i]), int(model.knot_start[i + 1]))
        ee, en, nn, uu = (model.covariance_g[rows, k] for k in (0, 1, 3, 5))
        sin, cos = np.sin(model.grid_bearing[rows]), np.cos(model.grid_bearing[rows])
        cross = ee * cos**2 - 2.0 * en * sin * cos + nn * sin**2
        here = track == i
        at = offset[here] + model.offset[rows][0]
        for out, variance in ((across, cross), (height, uu)):
            good = np.isfinite(variance) & (variance >= 0.0)
            if good.sum() > 1:
                out[here] = np.sqrt(np.interp(at, model.offset[rows][good], variance[good]))
    return across, height


def _mm(value: float) -> str:
    return (
        "an unknown amount"
        if not math.isfinite(value)
        else f"{1e3 * value:,.0f} mm"
        if value < 1.0
        else f"{value:.1f} m"
    )
