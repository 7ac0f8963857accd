"""Which law the transitions of a track follow: how likely each is, and what their lengths owe to it.

Laws are tried curve by curve, on the points around each curve; a track follows one law, so that what its curves say adds up. Where
the points do not tell, lengths are as unsure as the law is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError
from railnav.monitoring.fitting import judgement
from railnav.monitoring.fitting.editing import PRICE, Points, fit_window, spread, window
from railnav.monitoring.fitting.judgement import Edit, Item
from railnav.monitoring.fitting.plan import Chain, PlanFit, fit_plan
from railnav.track import elements
from railnav.track.elements import CLOTHOID, KIND_NAMES

FloatArray = NDArray[np.float64]

#: Laws besides the clothoid.
OTHER_LAWS = (elements.BLOSS, elements.COSINE, elements.SINE, elements.HELMERT, elements.CUBIC)
#: How much less each is built than the clothoid, in -2 log likelihood.
_RARER = {
    CLOTHOID: 0.0, elements.BLOSS: 3.0, elements.COSINE: 5.0, elements.SINE: 6.0, elements.HELMERT: 5.0, elements.CUBIC: 5.0,
    elements.VIENNESE: 6.0,
}  # fmt: skip
#: A law is said without "or" from this probability on.
DECIDED = 0.95
#: Laws less likely than this do not widen the sigmas of lengths.
_UNLIKELY = 0.02
#: A curve may follow its own law where that is worth this, in -2 log likelihood.
_ALONE = 25.0
#: Curves tell their law if they shift by this many sigmas of a point.
_TELLING = 3.0
#: Plain elements this long part what is looked at together, m.
_APART = 120.0
#: Where S-shaped laws lose by this in the shape of Bloss, the others need not be tried.
_HOPELESS = 60.0
#: Cubic parabolas turn by less, rad.
_CUBIC_TURN = 0.5
#: Height of the centre of gravity that a Viennese bend is made for, and distance of the rails that cant is between, m.
SWAY_HEIGHT, CANT_BASE = 1.8, 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Law:
    """The law of a track's transitions.

    Attributes
    ----------
    probability : dict
        Of each law tried, by its number; they sum to 1. Empty without transitions.
    best : int
        The likeliest.
    told : bool
        Whether the points were asked at all: smoothed points blur what they would tell.
    """

    probability: dict[int, float]
    best: int = CLOTHOID
    told: bool = True

    @property
    def said(self) -> str:
        """The law in words: "clothoid", or "clothoid or bloss: undecided"."""
        if not self.probability:
            return ""
        order = sorted(self.probability, key=lambda law: -self.probability[law])
        named, total = [], 0.0
        for law in order:
            alike = {CLOTHOID: elements.CUBIC, elements.CUBIC: CLOTHOID}.get(law)  # to millimetres, and as long
            if alike is None or KIND_NAMES[alike] not in named:
                named.append(KIND_NAMES[law])
            total += self.probability[law]
            if total >= DECIDED:
                break
        return named[0] if len(named) == 1 else " or ".join(named) + ": undecided"


#: What smoothed points leave of the law: how often each is built.
def prior(laws: tuple[int, ...]) -> Law:
    """The law before points are asked."""
    weight = {law: float(np.exp(-0.5 * _RARER[law])) for law in (CLOTHOID, *laws)}
    total = sum(weight.values())
    return Law({law: value / total for law, value in weight.items()}, CLOTHOID, False)


def with_ramps(law: Law, ramps: dict[int, float]) -> Law:
    """The law after the cant has been asked: its ramps follow the law of their transitions."""
    if not ramps or not law.probability:
        return law
    least = min(ramps.values())
    weight = {
        kind: value * float(np.exp(-0.5 * (ramps.get(kind, least) - least))) for kind, value in law.probability.items()
    }
    total = sum(weight.values())
    probability = {kind: value / total for kind, value in weight.items()}
    return Law(probability, law.best if law.told else max(probability, key=lambda kind: probability[kind]), True)


def shift_share(law: int) -> float:
    """By how much a law shifts its curve, over change of curvature times length squared: 1/24 for a clothoid.

    Examples
    --------
    >>> round(1.0 / shift_share(elements.CLOTHOID), 3), round(1.0 / shift_share(elements.BLOSS), 3)
    (24.0, 40.0)
    """
    if law == elements.CUBIC:
        law = CLOTHOID
    node, weight = np.polynomial.legendre.leggauss(20)
    t = np.concatenate([0.25 + 0.25 * node, 0.75 + 0.25 * node])  # the Helmert law breaks in the middle
    _, whole = elements.law(np.full(len(t), law), t)
    return float(0.25 * np.concatenate([weight, weight]) @ whole - 0.125)


def with_laws(
    fit: PlanFit, points: Points, laws: tuple[int, ...], *, cant: FloatArray | None = None
) -> tuple[PlanFit, Law, FloatArray]:
    """The fit with the likeliest law, how likely each is, and what lengths owe to it.

    Parameters
    ----------
    fit : PlanFit
        Transitions are clothoids.
    points : Points
    laws : tuple of int
        To try besides the clothoid.
    cant : (n,) array, optional
        At the points, m: then Viennese bends may be among `laws`.

    Returns
    -------
    fit : PlanFit
    law : Law
    more : (m,) array
        Variances of lengths besides those under the chosen law, m^2.
    """
    if not (fit.chain.kind >= CLOTHOID).any():
        return fit, Law({}), np.zeros(len(fit.chain.kind))
    items = judgement.items_of(fit.chain)
    factor = spread(fit, points)
    sigma = points.noise.total if not points.noise.smooth else float(np.mean(points.noise.sigma))
    spacing = float(np.median(np.diff(fit.along)))
    cost: dict[int, float] = dict.fromkeys((CLOTHOID, *laws), 0.0)
    curves: list[tuple[tuple[int, int], dict[int, tuple[float, tuple[Item, ...]]]]] = []
    for first, last in _curves(items):
        part = window(fit, items, first, last, spacing=spacing)
        if part is None or _shift(items[first:last]) < _TELLING * sigma:
            continue
        as_is = fit_window(fit, points, part, part.items, steps=8)
        if as_is is None:
            continue
        head, tail = first - part.first, part.last - last
        own = as_is.cost / factor
        found: dict[int, tuple[float, tuple[Item, ...]]] = {CLOTHOID: (own, tuple(items[first:last]))}
        runs = judgement.joined_runs(part.items)
        runs = [run for run in runs if run.first >= head and run.last <= len(part.items) - max(tail - 1, 0)]
        joined = judgement.applied(part.items, runs)
        own += PRICE * sum(run.fewer for run in runs)
        found[CLOTHOID] = (own, found[CLOTHOID][1])
        for law in laws:
            bloss = found[elements.BLOSS][0] if elements.BLOSS in found else own
            if law in (elements.COSINE, elements.SINE, elements.HELMERT, elements.VIENNESE) and bloss > own + _HOPELESS:
                found[law] = (bloss, found[CLOTHOID][1])
                continue
            new = _under(joined, head, len(joined) - tail, law, fit, part.begin, cant)
            trial = None if new is None else fit_window(fit, points, part, new)
            if trial is None or not trial.settled:
                found[law] = (own + _HOPELESS, found[CLOTHOID][1])
                continue
            made = judgement.items_of(trial.chain)[head : len(new or []) - tail]
            found[law] = (trial.cost / factor, tuple(made))
        for law, (value, _) in found.items():
            cost[law] += value - own
        curves.append(((first, last), found))
    weight = {law: np.exp(-0.5 * (value + _RARER[law])) for law, value in _relative(cost).items()}
    total = sum(weight.values())
    probability = {law: float(value / total) for law, value in weight.items()}
    best = max(probability, key=lambda law: probability[law])
    law_of = Law(probability, best)
    edits, lengths = [], np.zeros(len(items))
    for (first, last), found in curves:
        own_law = min(found, key=lambda law: found[law][0])
        law = own_law if found[own_law][0] < found[best][0] - _ALONE else best
        if law != CLOTHOID and found[law][0] < found[CLOTHOID][0] + _ALONE:
            edits.append(Edit(first, last, found[law][1], 0))
    chosen = fit
    if best != CLOTHOID or edits:
        merged = judgement.applied(items, edits)
        if best != CLOTHOID:  # transitions that tell nothing follow the others
            told = {id(item) for edit in edits for item in edit.items}
            merged = [
                replace(item, kind=best, length=item.length * float(np.sqrt(shift_share(CLOTHOID) / shift_share(best))))
                if item.kind == CLOTHOID and id(item) not in told and _lone(item, best)
                else item
                for item in merged
            ]
        try:
            chosen = fit_plan(
                _untie_cubics(judgement.chain_of(merged)), fit.along, points.east, points.north, points.noise
            )
        except EstimationError:
            chosen = fit
        if (
            not chosen.cost / factor
            < fit.cost / factor + PRICE * (len(fit.chain.kind) - len(chosen.chain.kind)) * 2 + _ALONE
        ):
            chosen, law_of = fit, Law(probability, CLOTHOID)
    lengths = owed_to_law(chosen, law_of)
    return chosen, law_of, lengths


def under_law(fit: PlanFit, law: int, points: Points) -> PlanFit:
    """The fit with all transitions under a law; itself where that does not fit."""
    if law in (CLOTHOID, elements.CUBIC):
        return fit
    longer = float(np.sqrt(shift_share(CLOTHOID) / shift_share(law)))
    items = [
        replace(item, kind=law, length=item.length * longer) if item.kind == CLOTHOID else item
        for item in judgement.items_of(fit.chain)
    ]
    try:
        found = fit_plan(judgement.chain_of(items), fit.along, points.east, points.north, points.noise)
    except EstimationError:
        return fit
    return found if found.cost / spread(fit, points) < fit.cost / spread(fit, points) + _ALONE * 2 else fit


def owed_to_law(fit: PlanFit, law: Law) -> FloatArray:
    """Variances of lengths of transitions because their law is not known, (m,), m^2.

    Laws of less than 2 % are left out. A transition of another law that shifts its curve as much is longer by the root of the
    shares of shift.
    """
    counted = {other: value for other, value in law.probability.items() if value > _UNLIKELY}
    total = sum(counted.values())
    share = {other: shift_share(other) for other in counted}
    out = np.zeros(len(fit.chain.kind))
    for j, kind in enumerate(fit.chain.kind.tolist()):
        if kind < CLOTHOID:
            continue
        own = shift_share(kind)
        for other, probability in counted.items():
            change = fit.chain.length[j] * (np.sqrt(own / share[other]) - 1.0)
            out[j] += probability / total * change**2
    return out


# --- within -----------------------------------------------------------------------------------------------------------


def _unknowns(fit: PlanFit) -> int:
    return len(fit.chain.kind) + len(fit.chain.bend)


def _relative(cost: dict[int, float]) -> dict[int, float]:
    least = min(value + _RARER[law] for law, value in cost.items())
    return {law: value - least for law, value in cost.items()}


def _curves(items: list[Item]) -> list[tuple[int, int]]:
    """Runs of elements, each from its first transition (or what may be part of one) to its last, parted by long plain elements."""
    out: list[tuple[int, int]] = []
    inside = {j for run in judgement.joined_runs(items) for j in range(run.first, run.last)}
    for j, item in enumerate(items):
        if item.kind < CLOTHOID and not (j in inside and item.length < _APART):
            continue
        between = 0.0 if not out else sum(other.length for other in items[out[-1][1] : j])
        if out and between < _APART:
            out[-1] = (out[-1][0], j + 1)
        else:
            out.append((j, j + 1))
    return out


def _shift(run: list[Item]) -> float:
    """By how much the transitions shift their curves, at most, m."""
    return max(
        (abs(item.k1 - item.k0) * item.length**2 * shift_share(item.kind) for item in run if item.kind >= CLOTHOID),
        default=0.0,
    )


def _lone(item: Item, law: int) -> bool:
    return law != elements.CUBIC or (item.k0 == 0.0 or item.k1 == 0.0)


def _under(
    items: list[Item], first: int, last: int, law: int, fit: PlanFit, begin: float, cant: FloatArray | None
) -> list[Item] | None:
    """The elements with transitions from `first` to before `last` of another law; None where that cannot be."""
    out = list(items)
    at = begin + np.append(0.0, np.cumsum([item.length for item in items]))
    for j in range(first, last):
        item = items[j]
        if item.kind < CLOTHOID:
            continue
        if law == elements.CUBIC:
            if not _lone(item, law) or max(abs(item.k0), abs(item.k1)) * item.length > _CUBIC_TURN:
                continue
            out[j] = replace(item, kind=law)
            continue
        longer = float(np.sqrt(shift_share(CLOTHOID) / shift_share(law)))
        sway = 0.0
        if law == elements.VIENNESE:
            if cant is None:
                return None
            side = np.interp([at[j], at[j + 1]], fit.along, cant)
            sway = SWAY_HEIGHT * float(side[1] - side[0]) / CANT_BASE
            longer = 1.0
        out[j] = replace(item, kind=law, length=item.length * longer, sway=sway)
    return out


def _untie_cubics(chain: Chain) -> Chain:
    """Cubic parabolas between two arcs as clothoids."""
    return judgement.with_law(chain, chain.kind)
