"""Changes of elements tried where they are: each on the points around it, then all that pay on the whole track.

A change is held against the elements as they are by an adjustment of both on the same few elements and points; it pays where -2 log
likelihood and the price of the unknowns together get less. What pays is put together and adjusted once more as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError
from railnav.monitoring.fitting import judgement, precision
from railnav.monitoring.fitting.judgement import Edit, Item
from railnav.monitoring.fitting.plan import PlanFit, fit_plan
from railnav.monitoring.fitting.segmentation import Noise
from railnav.track import elements

FloatArray = NDArray[np.float64]

#: Price of an unknown in -2 log likelihood.
PRICE = 9.0
#: A change is judged on the elements beside it, and on no more of them than this, m, or so many times what it changes.
_BESIDE, _AS_LONG = 60.0, 1.5
#: And at least so many points of them.
_POINTS = 12
#: Points that lie closer to the axis than their noise count as if they lay this share of its square off.
_EXACT = 0.25
#: Where transitions hardly show, two that meet in a peak of curvature are an arc, and that weighs so much, in -2 log likelihood.
_PEAK = 20.0
#: Rounds of changes; under a known noise the first ones find them.
_ROUNDS, _ROUNDS_KNOWN = 6, 3
#: A whole adjustment may come out dearer than its parts promised by this.
_SLACK = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Measured points (n,), m, and their noise; `known` where that is stated by a survey and not told by what is left of them."""

    east: FloatArray
    north: FloatArray
    noise: Noise
    known: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Some elements of a fit and the points along them.

    Attributes
    ----------
    first, last : int
        The elements from `first` to before `last`.
    items : list of Item
        Those, the outer ones cut to what counts.
    cut : tuple of float
        What was cut from the first and from the last, m.
    rows : slice
        Points.
    begin : float
        Length along the fit where the window begins, m.
    """

    first: int
    last: int
    items: list[Item]
    cut: tuple[float, float]
    rows: slice
    begin: float


def window(fit: PlanFit, items: list[Item], first: int, last: int, *, spacing: float) -> Window | None:
    """Elements and points around the elements from `first` to before `last`; None where there are too few points."""
    edges = fit.chain.edges
    m = len(items)
    reach = max(_BESIDE, _POINTS * spacing, _AS_LONG * float(edges[last] - edges[first]))
    lo, hi = first, last
    while lo > 0 and (edges[first] - edges[lo] < reach or items[lo].kind >= elements.CLOTHOID):
        lo -= 1
    while hi < m and (edges[hi] - edges[last] < reach or items[hi - 1].kind >= elements.CLOTHOID):
        hi += 1
    some = list(items[lo:hi])
    before, after = 0.0, 0.0
    if lo < first and some[0].kind < elements.CLOTHOID:
        before = max(float(edges[lo + 1]) - max(float(edges[first]) - reach, 0.0), 0.0)
        before = max(some[0].length - max(before, min(some[0].length, _POINTS * spacing)), 0.0)
        some[0] = advanced(some[0], before)
    if hi > last and some[-1].kind < elements.CLOTHOID:
        after = max(float(edges[last]) + reach - float(edges[hi - 1]), 0.0)
        after = max(some[-1].length - max(after, min(some[-1].length, _POINTS * spacing)), 0.0)
        some[-1] = replace(some[-1], length=some[-1].length - after)
    begin, end = float(edges[lo]) + before, float(edges[hi]) - after
    rows = slice(int(np.searchsorted(fit.along, begin)), int(np.searchsorted(fit.along, end, side="right")))
    if rows.stop - rows.start < 2 * len(some) + 6:
        return None
    return Window(lo, hi, some, (before, after), rows, begin)


def advanced(item: Item, by: float) -> Item:
    """A straight or an arc without its first metres."""
    if by <= 0.0:
        return item
    east, north, bearing = item.start
    half = 0.5 * item.k0 * by
    chord = by * float(np.sinc(half / np.pi))
    start = (
        east + chord * float(np.sin(bearing + half)),
        north + chord * float(np.cos(bearing + half)),
        bearing + 2.0 * half,
    )
    return replace(item, length=item.length - by, start=start)


def fit_window(fit: PlanFit, points: Points, part: Window, items: list[Item], *, steps: int = 20) -> PlanFit | None:
    """Elements adjusted to the points of a window; None where they are not determined."""
    rows = part.rows
    try:
        return fit_plan(
            judgement.chain_of(items),
            fit.along[rows] - part.begin,
            points.east[rows],
            points.north[rows],
            points.noise,
            steps=steps,
        )
    except EstimationError:
        return None


def tried(fit: PlanFit, edits: list[Edit], points: Points) -> PlanFit:
    """The fit with those edits that pay; itself where none does."""
    if not edits:
        return fit
    items = judgement.items_of(fit.chain)
    spacing = float(np.median(np.diff(fit.along)))
    factor = spread(fit, points)
    good: list[tuple[float, Edit]] = []
    for edit in edits:
        found = _paying(fit, items, edit, points, spacing, factor)
        if found is not None:
            good.append(found)
    # of edits that overlap, the one that pays most
    chosen: list[tuple[float, Edit]] = []
    for gain, edit in sorted(good, key=lambda pair: -pair[0]):
        if all(edit.last <= other.first or edit.first >= other.last for _, other in chosen):
            chosen.append((gain, edit))
    while chosen:
        made = judgement.applied(items, sorted((edit for _, edit in chosen), key=lambda edit: edit.first))
        fewer = PRICE * sum(edit.fewer for _, edit in chosen)
        try:
            again = fit_plan(judgement.chain_of(made), fit.along, points.east, points.north, points.noise)
        except EstimationError:
            again = None
        met = again is not None and (again.closed or not fit.closed)
        if met and again is not None and again.cost / factor < fit.cost / factor + fewer + _SLACK * (len(chosen) > 1):
            return again
        chosen = chosen[: len(chosen) // 2]
    return fit


def _paying(
    fit: PlanFit, items: list[Item], edit: Edit, points: Points, spacing: float, factor: float
) -> tuple[float, Edit] | None:
    """What an edit gains, and the edit with its elements as adjusted; None where it does not pay."""
    part = window(fit, items, edit.first, edit.last, spacing=spacing)
    if part is None:
        return None
    head = edit.first - part.first
    tail = part.last - edit.last
    new = list(edit.items)
    if head == 0:
        new[0] = advanced(new[0], part.cut[0]) if new[0].kind < elements.CLOTHOID else new[0]
    if tail == 0:
        new[-1] = replace(new[-1], length=max(new[-1].length - part.cut[1], 0.5))
    inner = part.items[len(part.items) - tail :] if tail else []
    if inner and new:  # what follows is tied as it was
        inner = [inner[0], *inner[1:]]
    as_is = fit_window(fit, points, part, part.items, steps=8)
    other = fit_window(fit, points, part, part.items[:head] + new + inner)
    if as_is is None or other is None or (as_is.closed and not other.closed):
        return None
    gain = (as_is.cost - other.cost) / factor + PRICE * edit.fewer + edit.bonus
    if not gain > 0.0:
        return None
    made = judgement.items_of(other.chain)[head : head + len(new)]
    if head == 0 and part.cut[0] > 0.0:
        made[0] = replace(made[0], length=made[0].length + part.cut[0], start=edit.items[0].start)
    if tail == 0 and part.cut[1] > 0.0:
        made[-1] = replace(made[-1], length=made[-1].length + part.cut[1])
    made = [replace(item, smooth=was.smooth) for item, was in zip(made, edit.items, strict=True)]
    return gain, replace(edit, items=tuple(made))


def spread(fit: PlanFit, points: Points) -> float:
    """What squares are divided by, so that residuals as they are found count as one each; 1 where their noise is known."""
    if points.known:
        return 1.0
    unknown = 2 * len(fit.chain.kind) + 3
    size = fit.cost / max(len(fit.along) - unknown, 1)
    return float(np.clip(size, _EXACT, 4.0))


def refined(fit: PlanFit, points: Points, *, jump: float = 0.0) -> PlanFit:
    """The fit with elements left out, joined, made plain or smooth, for as long as that pays; `jump` as in `simplifications`."""
    for _ in range(_ROUNDS_KNOWN if points.known else _ROUNDS):
        count = len(fit.chain.kind)
        before = fit
        length_sigma, bend_sigma, _ = plan_sigmas(fit)
        items = judgement.items_of(fit.chain)
        least = 0.5 * float(np.median(np.diff(fit.along)))
        peak = _PEAK if points.known else 0.0
        fit = tried(
            fit, judgement.simplifications(items, bend_sigma, length_sigma, least=least, jump=jump, peak=peak), points
        )
        if points.known:
            length_sigma, _, _ = plan_sigmas(fit)
            fit = tried(fit, judgement.without_leads(judgement.items_of(fit.chain), length_sigma), points)
        for propose in (
            judgement.hardly_bent,
            judgement.smooth_joints,
            judgement.plain_transitions,
            judgement.joined_runs,
        ):
            fit = tried(fit, propose(judgement.items_of(fit.chain)), points)
        if fit is before or (len(fit.chain.kind) == count and fit.cost > before.cost - 1.0):
            break
    return fit


def plan_sigmas(fit: PlanFit) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sigmas of lengths, of arcs' curvatures (NaN of others), and of the stations of starts, (m,)."""
    from scipy import sparse

    chain = fit.chain
    m, c = len(chain.kind), len(chain.bend)
    j = np.arange(m)
    arc = chain.kind == elements.ARC
    sin, cos = np.sin(chain.start[:, 2]), np.cos(chain.start[:, 2])
    wanted = sparse.csr_array(
        (
            np.concatenate([np.ones(m), np.ones(int(arc.sum())), sin, cos]),
            (
                np.concatenate([j, m + j[arc], 2 * m + j, 2 * m + j]),
                np.concatenate([4 * j + 3, 4 * m + chain.first[arc], 4 * j, 4 * j + 1]),
            ),
        ),
        shape=(3 * m, 4 * m + c),
    )
    found = precision.sigmas_of_elements(fit.factor, wanted)
    return found[:m], np.where(arc, found[m : 2 * m], np.nan), found[2 * m :]
