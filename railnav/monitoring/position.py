"""The measured axis: where the track lies beside and above the model, from the positions and angles of runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.monitoring.filters import band_noise, low_pass, stretches
from railnav.monitoring.recording import Recording, Series
from railnav.monitoring.section import Section

FloatArray = NDArray[np.float64]

#: Waves longer than this come from GNSS positions, shorter ones from angles, m.
CROSSOVER = 300.0
#: Positions alone are smoothed to waves of at least this, m.
SHORTEST_ALONE = 30.0
#: Runs whose smoothed positions scatter more than this are not used: they would only spoil the model's axis, m.
COARSEST = 0.03


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
    parts: list[tuple[Recording, FloatArray, float, float]] = []
    rises: list[tuple[FloatArray, float, float]] = []
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
        right, sigma, relative = plan
        if not sigma <= COARSEST:
            notes.append(
                f"run {recording.run.id}: its smoothed positions are good to {_mm(sigma)}, not to {_mm(COARSEST)}; not used for the axis"
            )
            continue
        parts.append((recording, _on(right, recording, grid), sigma, relative))
        rise = _joined(recording, "height_gnss", "slope")
        if rise is not None and rise[1] <= 2.0 * COARSEST:
            rises.append((_on(rise[0], recording, grid), rise[1], rise[2]))
    model = section.at(grid)
    if not parts:
        sigma_cross, sigma_height = _model_sigma(section)
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
        )
    right, sigma_right, relative_right = _mean([(x, s, r) for _, x, s, r in parts])
    up, sigma_up, relative_up = _mean(rises) if rises else (np.full(len(grid), np.nan), math.nan, math.nan)
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
        tuple(dict.fromkeys(recording.run.id for recording, _, _, _ in parts)),
        tuple(notes),
    )


def _joined(recording: Recording, position: str, angle: str) -> tuple[FloatArray, float, float] | None:
    """Displacement of one run on its grid, its sigma in place, and its sigma in shape."""
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
        return smooth, math.hypot(white, slow), white
    shape = np.full(len(smooth), np.nan)
    for a, b in stretches(np.isfinite(turn.values)):
        if b - a < 8:
            continue
        integral = np.append(0.0, np.cumsum(0.5 * (turn.values[a : b - 1] + turn.values[a + 1 : b]))) * recording.step
        s = np.arange(b - a, dtype=float)
        integral -= np.polyval(np.polyfit(s, integral, 1), s)
        shape[a:b] = integral - low_pass(integral, recording.step, wave)
    from railnav.monitoring.filters import Band

    relative = band_noise(turn.noise, turn.spacing, Band("shape", 3.0, wave), integrate=1)
    # of the positions' noise about a third lies in waves up to the crossover, where the smoothing lets go
    relative = math.hypot(relative, white / 3.0)
    return smooth + shape, math.hypot(white, slow), relative


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


def _mean(parts: Sequence[tuple[FloatArray, float, float]]) -> tuple[FloatArray, float, float]:
    """Weighted mean of runs where they are, and its sigmas where most of them are."""
    weight = np.array([1.0 / max(sigma, 1e-6) ** 2 for _, sigma, _ in parts])
    values = np.array([x for x, _, _ in parts])
    known = np.isfinite(values)
    total = (weight[:, None] * known).sum(axis=0)
    mean = np.where(
        total > 0, (weight[:, None] * np.where(known, values, 0.0)).sum(axis=0) / np.maximum(total, 1e-300), np.nan
    )
    least = float(np.median(total[total > 0])) if (total > 0).any() else math.nan
    share = weight / weight.sum()
    relative = math.sqrt(float(np.sum((share * np.array([r for _, _, r in parts])) ** 2)))
    return mean, 1.0 / math.sqrt(least) if least > 0 else math.nan, relative


def _model_sigma(section: Section) -> tuple[float, float]:
    """Median sigma of the model's axis across and in height, m; NaN where it states none."""
    model = section.model
    rows = np.concatenate([np.arange(model.knot_start[i], model.knot_start[i + 1]) for i in section.track])
    ee, en, nn, uu = (model.covariance_g[rows, i] for i in (0, 1, 3, 5))
    sin, cos = np.sin(model.grid_bearing[rows]), np.cos(model.grid_bearing[rows])
    cross = ee * cos**2 - 2.0 * en * sin * cos + nn * sin**2
    out = []
    for variance in (cross, uu):
        known = variance[np.isfinite(variance) & (variance >= 0.0)]
        out.append(float(np.sqrt(np.median(known))) if len(known) else math.nan)
    return out[0], out[1]


def _mm(value: float) -> str:
    return (
        "an unknown amount"
        if not math.isfinite(value)
        else f"{1e3 * value:,.0f} mm"
        if value < 1.0
        else f"{value:.1f} m"
    )
