"""Cant along a track: levels and ramps fitted to measured cant, ramps where the plan has its transitions if the cant agrees.

A ramp belongs to a transition and follows its law of curvature; where the measured cant does not contradict, places and law are those
of the plan, and only the levels remain to be found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.monitoring.fitting import segmentation, stretches
from railnav.monitoring.fitting.axis import Axis
from railnav.monitoring.fitting.laws import shift_share
from railnav.monitoring.fitting.noise import fourth_difference_sigma, likeliest
from railnav.monitoring.fitting.plan import ROBUST
from railnav.monitoring.fitting.profile import noise_of_stretches, settled
from railnav.monitoring.fitting.segmentation import Noise, Pieces
from railnav.track import elements
from railnav.track.elements import CLOTHOID, Cant, Plan

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: No gauge measures cant better than this, m: what is smoother comes from smoothing, and is told to `SMOOTH_CANT`.
FLOOR_CANT, SMOOTH_CANT = 3e-4, 1e-3
#: A ramp may lie this far from a transition to be held against it, m and as a share of its length.
_NEAR, _NEAR_SHARE = 15.0, 0.3
#: What a place costs, in -2 log likelihood, and how much more railways build ramps where the transitions are.
_PRICE, _WORTH = 9.0, 20.0
#: Points this far beyond a ramp tell of it, m.
_AROUND = 20.0
#: Smoothed cant says the same again over this length, m.
_SMOOTH_LENGTH = 15.0


@dataclass(frozen=True, slots=True, eq=False)
class FittedCant:
    """A fitted cant.

    Attributes
    ----------
    cant : Cant
    sigma : (c, 2) array
        Of its pieces: begin, m; cant there, m.
    noise : Noise
    residual : (n,) array
        m.
    of_plan : int
        Ramps that coincide with transitions of the plan.
    ramps : int
        All of them.
    """

    cant: Cant
    sigma: FloatArray
    noise: Noise
    residual: FloatArray
    of_plan: int
    ramps: int


@dataclass(frozen=True, slots=True)
class _Ramp:
    """A run of ramps: its edges, the law of each, and sigmas of its edges."""

    edges: tuple[float, ...]
    law: tuple[int, ...]
    sigma: tuple[float, ...]
    of_plan: bool


def fit_cant(axis: Axis, along: FloatArray, plan: Plan, station_sigma: FloatArray) -> FittedCant:
    """Fit levels and ramps to the cant of an axis.

    Parameters
    ----------
    axis : Axis
        With cant.
    along : (n,) array
        Lengths of its points along the plan, growing, m.
    plan : Plan
    station_sigma : (m,) array
        Of the starts of its elements, m.

    Raises
    ------
    TrackError
        No cant.
    """
    if axis.cant is None:
        raise TrackError(f"track {axis.track!r} has no cant")
    cant = axis.cant
    white = fourth_difference_sigma(cant)
    smooth = white < FLOOR_CANT
    white = SMOOTH_CANT if smooth else white

    def pieces(noise: Noise, part: slice, beam: int = segmentation.NARROW) -> Pieces:
        return segmentation.segment_cant(along[part], cant[part], noise, rate_scale=1e-3, beam=beam)

    spacing = float(along[-1] - along[0]) / (len(along) - 1)
    noise = Noise(white) if smooth else likeliest(pieces, len(along), spacing, white, floor=FLOOR_CANT)
    first = stretches.stretches_of_pieces(pieces(noise, slice(0, len(along)), segmentation.BEAM), along, cant, 1)
    per_point = np.full(len(along), noise.total)
    free = stretches.fit_stretches(first, along, cant, per_point)
    free, each = settled(free, along, cant, per_point, noise, None, 1)
    true = noise_of_stretches(free, noise, None, per_point)
    again = (
        max(1.0, _SMOOTH_LENGTH / spacing)
        if smooth
        else 1.0 + 2.0 * true.length / spacing * (true.correlated / true.total) ** 2
    )
    if (free.stretches.order[1:] == 0).any():  # cant that jumps: as found
        return _as_found(free, each, true)
    ramps = _runs(free.stretches, each)
    options = _options(ramps, _transitions(plan, station_sigma))
    end = float(along[-1])
    replaced = [group if other is None else [other] for group, other in options]
    _, found, _ = _solved([ramp for group, _ in options for ramp in group], along, cant, true.total)
    _, told, _ = _solved([ramp for some in replaced for ramp in some], along, cant, true.total)
    chosen: list[_Ramp] = []
    for group, other in options:
        if other is None:
            chosen += group
            continue
        low, high = (
            min(group[0].edges[0], other.edges[0]) - _AROUND,
            max(group[-1].edges[-1], other.edges[-1]) + _AROUND,
        )
        here = (along >= low) & (along <= high)
        own, of_plan = (float(np.sum((r[here] / true.total) ** 2)) / again for r in (found, told))
        fewer = sum(len(ramp.edges) for ramp in group)
        chosen += [other] if of_plan < own + _WORTH + _PRICE * fewer else group
    levels, residual, level_sigma = _solved(chosen, along, cant, true.total * float(np.sqrt(again)))
    edges, start, stop, law, sigma = _pieces_of(chosen, levels, level_sigma, end)
    return FittedCant(Cant(edges, start, stop, law), sigma, true, residual, sum(r.of_plan for r in chosen), len(chosen))


def _options(ramps: list[_Ramp], runs: list[_Ramp]) -> list[tuple[list[_Ramp], _Ramp | None]]:
    """Ramps as found, by the transitions of the plan that they may belong to."""
    out: list[tuple[list[_Ramp], _Ramp | None]] = []
    for ramp in ramps:
        middle = 0.5 * (ramp.edges[0] + ramp.edges[-1])
        other = None
        for run in runs:
            near = max(_NEAR, _NEAR_SHARE * (run.edges[-1] - run.edges[0]))
            if run.edges[0] - near < middle < run.edges[-1] + near:
                inside = run.edges[0] - near < ramp.edges[0] and ramp.edges[-1] < run.edges[-1] + near
                other = run if inside else None
                if inside:
                    break
        if other is not None and out and out[-1][1] is other:
            out[-1][0].append(ramp)
        else:
            out.append(([ramp], other))
    # where the transitions of two neighbours would overlap what is found beside them, as found
    for j, (group, other) in enumerate(out):
        before = out[j - 1] if j else None
        last = -np.inf if before is None else (before[1] or before[0][-1]).edges[-1]
        first = np.inf if j + 1 == len(out) else out[j + 1][0][0].edges[0]
        if other is not None and (other.edges[0] < last - 1e-6 or other.edges[-1] > first + 1e-6):
            out[j] = (group, None)
    return out


def law_of_ramps(axis: Axis, along: FloatArray, plan: Plan, laws: tuple[int, ...]) -> dict[int, float]:
    """What the cant says of the law of transitions: -2 log likelihood of each law under which ramps may follow them.

    Ramps are laid between the same middles as the plan's transitions; those of another law are as much longer as it shifts less.
    Empty without cant or ramps.
    """
    if axis.cant is None:
        return {}
    cant = axis.cant
    white = fourth_difference_sigma(cant)
    smooth = white < FLOOR_CANT
    spacing = float(along[-1] - along[0]) / (len(along) - 1)
    sigma, again = (SMOOTH_CANT, max(1.0, _SMOOTH_LENGTH / spacing)) if smooth else (max(white, FLOOR_CANT), 1.0)
    runs = [run for run in _transitions(plan, np.zeros(len(plan.kind))) if len(run.law) == 1]
    place = np.searchsorted(along, [edge for run in runs for edge in (run.edges[0], run.edges[-1])])
    level = cant[np.clip(place, 0, len(cant) - 1)].reshape(-1, 2)
    runs = [run for run, (a, b) in zip(runs, level.tolist(), strict=True) if abs(b - a) > 10.0 * sigma]
    out: dict[int, float] = {}
    for law in (CLOTHOID, *laws) if runs else ():
        kind = CLOTHOID if law == elements.CUBIC else law
        total = 0.0
        for run in runs:
            middle, half = 0.5 * (run.edges[0] + run.edges[1]), 0.5 * (run.edges[1] - run.edges[0])
            least = np.inf
            for stretch in (0.85, 0.925, 1.0, 1.08, 1.17):  # ends are not known better than this beside their law
                longer = half * stretch * float(np.sqrt(shift_share(plan_law(run.law[0])) / shift_share(kind)))
                here = np.abs(along - middle) < 1.6 * half
                f, _ = elements.law(
                    np.full(int(here.sum()), kind), np.clip(0.5 + 0.5 * (along[here] - middle) / longer, 0.0, 1.0)
                )
                base = np.column_stack([1.0 - f, f])
                off = cant[here] - base @ np.linalg.lstsq(base, cant[here], rcond=None)[0]
                least = min(least, float(np.sum(np.minimum(np.abs(off) / sigma, 5.0) ** 2)) / again)
            total += least
        out[law] = total
    return out


def plan_law(kind: int) -> int:
    """The law of a transition's kind: a cubic parabola shifts its curve as a clothoid does."""
    return CLOTHOID if kind == elements.CUBIC else kind


def _as_found(free: stretches.StretchesFit, each: FloatArray, noise: Noise) -> FittedCant:
    s = free.stretches
    edges = np.append(s.begin, s.end)
    start = s.state[:, 0].copy()
    end = start + np.where(s.bent, s.top, 0.0) * s.length
    law = np.full(len(start), CLOTHOID, np.int64)
    table = np.column_stack([each[:, 1], each[:, 0]])
    return FittedCant(Cant(edges, start, end, law), table, noise, free.residual, 0, int(s.bent.sum()))


def _runs(s: stretches.Stretches, each: FloatArray) -> list[_Ramp]:
    """Ramps that follow each other, as found in the cant."""
    edges = np.append(s.begin, s.end)
    out, j = [], 0
    while j < len(s.begin):
        k = j
        while k < len(s.begin) and s.bent[k]:
            k += 1
        if k > j:
            sigma = np.append(each[:, 1], 0.0)[j : k + 1]
            out.append(_Ramp(tuple(edges[j : k + 1].tolist()), (CLOTHOID,) * (k - j), tuple(sigma.tolist()), False))
        j = max(k, j + 1)
    return out


def _transitions(plan: Plan, station_sigma: FloatArray) -> list[_Ramp]:
    """Transitions that follow each other, of the plan."""
    edges = plan.edges
    sigma = np.append(station_sigma, 0.0)
    out, j = [], 0
    while j < len(plan.kind):
        k = j
        while k < len(plan.kind) and plan.kind[k] >= CLOTHOID:
            k += 1
        if k > j:
            law = tuple(CLOTHOID if kind == elements.CUBIC else kind for kind in plan.kind[j:k].tolist())
            out.append(_Ramp(tuple(edges[j : k + 1].tolist()), law, tuple(sigma[j : k + 1].tolist()), True))
        j = max(k, j + 1)
    return out


def _solved(
    ramps: list[_Ramp], along: FloatArray, cant: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Levels before, inside and after ramps of given places by least squares, residuals, and sigmas of the levels."""
    from scipy import sparse

    node = [0]
    x, law = [], []
    for ramp in ramps:
        for k, kind in enumerate(ramp.law):
            x.append((ramp.edges[k], ramp.edges[k + 1]))
            law.append(kind)
            node.append(node[-1] + 1)
    count = len(x) + 1
    if not x:
        level = float(np.median(cant))
        return np.array([level]), cant - level, np.array([sigma / np.sqrt(len(cant))])
    begin, stop = np.array([a for a, _ in x]), np.array([b for _, b in x])
    owner = np.searchsorted(begin, along, side="right") - 1
    inside = np.clip(owner, 0, len(x) - 1)
    share = np.clip((along - begin[inside]) / np.maximum(stop[inside] - begin[inside], 1e-6), 0.0, 1.0)
    share = np.where(owner < 0, 0.0, share)
    f, _ = elements.law(np.array(law)[inside], share)
    rows = np.arange(len(along))
    design = sparse.csr_array(
        (np.concatenate([1.0 - f, f]), (np.concatenate([rows, rows]), np.concatenate([inside, inside + 1]))),
        shape=(len(along), count),
    )
    weight = np.ones(len(along))
    levels, residual = np.zeros(count), cant
    for _ in range(4):
        normal = (design.T @ sparse.diags_array(weight) @ design).toarray() + 1e-9 * np.eye(count)
        levels = np.linalg.solve(normal, design.T @ (weight * cant))
        residual = cant - design @ levels
        ratio = np.abs(residual) / sigma
        weight = np.where(ratio > ROBUST, ROBUST / np.maximum(ratio, ROBUST), 1.0)
    return levels, residual, sigma * np.sqrt(np.diag(np.linalg.inv(normal)))


def _pieces_of(
    ramps: list[_Ramp], levels: FloatArray, level_sigma: FloatArray, end: float
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, FloatArray]:
    """Edges, cant at starts and ends, laws, and sigmas of begin and cant of all pieces, levels between ramps included."""
    rows: list[tuple[float, float, float, int, float, float]] = []  # end, cant there and before, law, sigmas
    at, k, before = 0.0, 0, 0.0
    for ramp in ramps:
        if ramp.edges[0] > at + 1e-6:
            rows.append((ramp.edges[0], levels[k], levels[k], CLOTHOID, before, level_sigma[k]))
        for i, kind in enumerate(ramp.law):
            rows.append((ramp.edges[i + 1], levels[k], levels[k + 1], kind, ramp.sigma[i], level_sigma[k]))
            k += 1
        at, before = ramp.edges[-1], ramp.sigma[-1]
    if end > at + 1e-6:
        rows.append((end, levels[k], levels[k], CLOTHOID, before, level_sigma[k]))
    table = np.array([[*row[:3], *row[4:]] for row in rows])
    law = np.array([row[3] for row in rows], np.int64)
    begin = ramps[0].edges[0] if ramps and ramps[0].edges[0] <= 1e-6 else 0.0
    return np.append(begin, table[:, 0]), table[:, 1], table[:, 2], law, table[:, 3:]
