"""From a measured axis to its design: elements of plan, profile and cant, and how sure each is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError, TrackError
from railnav.monitoring.design import Design
from railnav.monitoring.fitting import judgement, precision, segmentation, stretches
from railnav.monitoring.fitting.axis import Axis
from railnav.monitoring.fitting.noise import Resolution, fourth_difference_sigma, likeliest, resolution
from railnav.monitoring.fitting.plan import Chain, PlanFit, chain_of_pieces, fit_plan
from railnav.monitoring.fitting.rounding import round_design
from railnav.monitoring.fitting.segmentation import Noise, Pieces
from railnav.run import Progress
from railnav.track import elements
from railnav.track.elements import CLOTHOID, Cant, Gradients

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Points count as exact below this, m: coordinates of designs are rounded, and joints close to a millimetre.
FLOOR = 5e-4
FLOOR_CANT = 3e-4
#: Cant of smoothed values is told to this, m.
SMOOTH_CANT = 1e-3
#: A law must be likelier than the clothoid by this, in -2 log likelihood, to be said; and one transition's than the track's.
LAW_WORTH = 8.0
LAW_ALONE = 25.0
#: A sum of squares may grow by this for each element that is left out.
_DEARER = 9.0
#: Points this far on both sides tell whether an edit is worth it, m.
_AROUND = 20.0
#: Cubic parabolas turn by less, rad.
_CUBIC_TURN = 0.5
#: Transitions tell their law if they shift the curve by this many sigmas.
_TELLING = 3.0
#: A fit whose residuals are this many times the noise has failed.
_FAILED = 5.0
#: An element this short is nothing, m.
_STUB = 0.1
#: Points that lie closer to the axis than their noise count as if they lay this share of its square off.
_EXACT = 0.25
#: Nor may the whole get dearer by more than this.
_DEAREST = 1.3
#: Rounds of leaving out elements.
_ROUNDS = 5
_LAWS = (elements.BLOSS, elements.COSINE, elements.SINE, elements.HELMERT, elements.CUBIC)
#: Height of the centre of gravity that a Viennese bend is made for, m.
SWAY_HEIGHT = 1.8
_CANT_BASE = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A design fitted to a measured axis, and how sure it is.

    Attributes
    ----------
    design : Design
        Its stations and lengths are the plane's.
    length_sigma, radius_sigma, station_sigma : (m,) array
        Of the plan's elements: length, m; radius of arcs, m (NaN of others); station where they begin, m.
    residual : (n,) array
        Distance of the points used from the axis, positive to the right, m.
    station : (n,) array
        Stations of their feet, m.
    noise : Noise
        White and correlated noise that the points have across the track.
    resolution : Resolution
        Which points were used.
    scale : float
        Grid metres per metre on the ground: a radius of the plane over it is the one on the ground.
    law_margin : float
        By how much the law of transitions is likelier than the next best, in -2 log likelihood; NaN without transitions.
    law_second : str
        The next best law.
    profile_sigma : (p, 3) array or None
        Of the profile's pieces: begin, m; gradient there; radius of vertical curves, m (NaN of grades).
    profile_noise, cant_noise : Noise or None
    cant_sigma : (c, 2) array or None
        Of the cant's pieces: begin, m; cant there, m.
    height_residual, cant_residual : array or None
        m.
    shortest : float
        Length of the shortest curve of the track's median radius that its points would show, m.
    warnings : tuple of str
        What a user should know.
    """

    design: Design
    length_sigma: FloatArray
    radius_sigma: FloatArray
    station_sigma: FloatArray
    residual: FloatArray
    station: FloatArray
    noise: Noise
    resolution: Resolution
    scale: float
    law_margin: float
    law_second: str
    profile_sigma: FloatArray | None
    profile_noise: Noise | None
    cant_sigma: FloatArray | None
    cant_noise: Noise | None
    height_residual: FloatArray | None
    cant_residual: FloatArray | None
    shortest: float
    warnings: tuple[str, ...]


def fit_design(
    axis: Axis,
    *,
    sigma: float | None = None,
    sigma_height: float | None = None,
    laws: tuple[int, ...] = _LAWS,
    rounded: bool = False,
    on_ground: bool = False,
    progress: Progress | None = None,
) -> Fitted:
    """Fit straights, arcs, transitions, grades, vertical curves and cant ramps to a measured axis.

    Parameters
    ----------
    axis : Axis
        Points in order.
    sigma, sigma_height : float, optional
        White noise of the points across the track and in height, m; by default found from the points.
    laws : tuple of int
        Laws of transitions that may be chosen besides the clothoid.
    rounded : bool
        Round radii and lengths of transitions to design values as far as their sigmas allow, and adjust the rest again.
    on_ground : bool
        Round what they are on the ground, not in the plane.
    progress : callable, optional
        As in `railnav.run.Progress`.

    Returns
    -------
    Fitted

    Raises
    ------
    TrackError
        Points or sigmas out of range.
    EstimationError
        Elements that the points do not determine.

    Notes
    -----
    docs/theory/alignment.md; measured accuracy in docs/accuracy.md.

    Examples
    --------
    >>> import numpy as np
    >>> from railnav.monitoring.design import design_of_elements
    >>> from railnav.monitoring.fitting import axis_of_points, fit_design
    >>> true = design_of_elements("1", ["straight", "clothoid", "arc"], [150.0, 80.0, 250.0], [0, 600.0, 600.0])
    >>> here = true.at(np.arange(0.0, 480.0))
    >>> fitted = fit_design(axis_of_points("1", here.easting, here.northing))
    >>> fitted.design.kinds, fitted.design.plan.length[:2].round(1).tolist()
    (('straight', 'clothoid', 'arc'), [150.0, 80.0])
    """
    for what, value in (("sigma", sigma), ("sigma of heights", sigma_height)):
        if value is not None and not 1e-6 <= value <= 100.0:
            raise TrackError(f"a {what} of {value} m; give metres, as 0.01")
    tell = progress or (lambda _stage, _done, _total: None)
    total = 5
    label = f"fit {axis.track}"
    tell(label, 0, total)
    warnings: list[str] = []
    chosen = _resolution_of(axis, sigma)
    rows = np.arange(0, len(axis.along), chosen.every)
    along, east, north = axis.along[rows], axis.easting[rows], axis.northing[rows]
    largest = 0.0 if axis.stated is None else 1.5 * float(np.median(axis.stated[:, 0]))
    noise, pieces, ref = _segment(along, east, north, chosen, sigma, largest)
    tell(label, 1, total)
    white = np.full(len(along), float(np.mean(noise.sigma)))
    per_point = np.sqrt(white**2 + noise.correlated**2) if noise.correlated > 0.0 else white
    fit = fit_plan(chain_of_pieces(pieces, along, ref), along, east, north, per_point)
    fit = _simplified(fit, east, north, per_point, noise)
    items = judgement.items_of(fit.chain)
    smoother = _tried(fit, judgement.smooth_joints(items), east, north, per_point, _spread(fit, noise))
    items = judgement.items_of(smoother.chain)
    smoother = _tried(smoother, judgement.plain_transitions(items), east, north, per_point, _spread(fit, noise))
    fit = fit if smoother is fit else _simplified(smoother, east, north, per_point, noise)
    tell(label, 2, total)
    fit, margin, second = _with_laws(fit, east, north, per_point, noise, laws)
    fit = _one_sided(_without_stubs(fit, east, north, per_point), east, north, per_point)
    tell(label, 3, total)
    if not fit.settled:
        warnings.append(f"track {axis.track}: the elements did not come to rest; their sigmas may be too small")
    if margin < LAW_WORTH and second:
        said = {elements.KIND_NAMES[kind] for kind in fit.chain.kind.tolist() if kind >= CLOTHOID}
        warnings.append(
            f"track {axis.track}: transitions are given as {' and '.join(sorted(said))}, but {second} fits about as well; their "
            "lengths depend on it"
        )
    expected = float(np.hypot(np.mean(noise.sigma), noise.correlated))
    noise = _as_found(fit, noise, sigma)
    if float(np.hypot(np.mean(noise.sigma), noise.correlated)) > _FAILED * expected and sigma is None:
        raise EstimationError(
            f"track {axis.track}: no elements were found that pass the points within {_FAILED:.0f} times their noise of "
            f"{expected:.3f} m; state their noise (--sigma), or fit a shorter piece"
        )
    if rounded:
        length_sigma, bend_sigma, _ = _plan_sigmas(fit, noise)
        with np.errstate(divide="ignore"):
            of_radius = bend_sigma / np.where(fit.chain.kind == elements.ARC, fit.chain.k0, np.nan) ** 2
        fit, count = round_design(fit, east, north, of_radius, length_sigma, scale=axis.scale if on_ground else 1.0)
        fit = _one_sided(fit, east, north, per_point)
        warnings.append(
            f"track {axis.track}: {count} radii and lengths rounded and held: they have no sigma of their own"
        )
    length_sigma, bend_sigma, station_sigma = _plan_sigmas(fit, noise)
    plan = fit.chain.plan
    k = np.where(plan.kind == elements.ARC, plan.curvature_start, np.nan)
    radius_sigma = bend_sigma / k**2
    profile, profile_sigma, profile_noise, height_residual = _profile(axis, rows, fit, sigma_height, warnings)
    tell(label, 4, total)
    cant, cant_sigma, cant_noise, cant_residual = _cant(axis, rows, fit)
    design = Design(axis.track, plan, axis.start, profile, cant, axis.crs)
    tell(label, total, total)
    shortest = _shortest(chosen, noise, plan)
    warnings += _doubts(axis, plan, length_sigma, radius_sigma, chosen, noise, shortest)
    return Fitted(
        design,
        length_sigma,
        radius_sigma,
        station_sigma,
        fit.residual,
        axis.start + fit.along,
        noise,
        chosen,
        axis.scale,
        margin,
        second,
        profile_sigma,
        profile_noise,
        cant_sigma,
        cant_noise,
        height_residual,
        cant_residual,
        shortest,
        tuple(warnings),
    )


# --- plan -------------------------------------------------------------------------------------------------------------


def _resolution_of(axis: Axis, sigma: float | None) -> Resolution:
    spacing = float(axis.along[-1] / (len(axis.along) - 1))

    def across(every: int) -> FloatArray:
        found = []
        for k in range(every):
            e, n = axis.easting[k::every], axis.northing[k::every]
            if len(e) < 6:
                continue
            bearing = np.arctan2(e[4:] - e[:-4], n[4:] - n[:-4])
            found.append(np.diff(e, 4) * np.cos(bearing) - np.diff(n, 4) * np.sin(bearing))
        return np.concatenate(found) if found else np.empty(0)

    stated = None if axis.stated is None else float(np.median(axis.stated[:, 0]))
    chosen = resolution(across, spacing, len(axis.along), floor=FLOOR, stated=stated)
    return chosen if sigma is None else replace(chosen, sigma=sigma)


def _segment(
    along: FloatArray, east: FloatArray, north: FloatArray, chosen: Resolution, sigma: float | None, largest: float
) -> tuple[Noise, Pieces, tuple[FloatArray, ...]]:
    white = chosen.sigma
    window = float(np.clip((720.0 * chosen.spacing * white**2 / 1e-6) ** 0.2, 6.5 * chosen.spacing, 120.0))
    ref = segmentation.reference(along, east, north, window)
    wide = max(round(20.0 / chosen.spacing), 3)
    smooth = _averaged(ref[3], wide)
    bend = float(np.clip(np.percentile(np.abs(smooth), 90), 2e-4, 0.05))
    rate = float(np.clip(bend / 20.0, 5e-6, 5e-3))

    def pieces(noise: Noise, part: slice, beam: int = segmentation.NARROW) -> Pieces:
        return segmentation.segment_plan(
            along[part], east[part], north[part], noise, window=window, curvature_scale=bend, rate_scale=rate, beam=beam
        )

    noise = likeliest(pieces, len(along), chosen.spacing, white, floor=FLOOR, stated=sigma, largest=largest)
    return noise, pieces(noise, slice(0, len(along)), segmentation.BEAM), ref


def _simplified(fit: PlanFit, east: FloatArray, north: FloatArray, sigma: FloatArray, noise: Noise) -> PlanFit:
    """The fit without elements that the points do not speak for."""
    chain = judgement.chain_of(judgement.split_inflections(judgement.items_of(fit.chain)))
    if len(chain.kind) != len(fit.chain.kind):
        fit = fit_plan(chain, fit.along, east, north, sigma)
    for _ in range(_ROUNDS):
        length_sigma, bend_sigma, _ = _plan_sigmas(fit, noise)
        items = judgement.items_of(fit.chain)
        least = 0.5 * float(np.median(np.diff(fit.along)))
        edits = judgement.simplifications(items, bend_sigma, length_sigma, least=least)
        fewer = _tried(fit, edits, east, north, sigma, _spread(fit, noise))
        if fewer is fit:
            break
        fit = fewer
    return _without_stubs(fit, east, north, sigma)


def _one_sided(fit: PlanFit, east: FloatArray, north: FloatArray, sigma: FloatArray) -> PlanFit:
    """The fit with every transition bending to one side: cut where it is straight, and adjusted again where that helps."""
    for last in (False, False, True):
        items = judgement.items_of(fit.chain)
        if not any(item.k0 * item.k1 < 0.0 for item in items):
            break
        # no other law can be cut in two of its kind
        both = [replace(item, kind=CLOTHOID) if item.k0 * item.k1 < 0.0 else item for item in items]
        parted = judgement.chain_of(judgement.split_inflections(both))
        again = fit_plan(parted, fit.along, east, north, sigma, steps=0 if last else 40)
        fit = again if last or again.cost < 1.2 * fit.cost else fit_plan(parted, fit.along, east, north, sigma, steps=0)
    return fit


def _without_stubs(fit: PlanFit, east: FloatArray, north: FloatArray, sigma: FloatArray) -> PlanFit:
    """The fit without elements that shrank to nothing."""
    for _ in range(3):
        items = judgement.items_of(fit.chain)
        nothing = np.zeros(len(items))
        edits = [
            edit
            for edit in judgement.simplifications(items, nothing, nothing, least=_STUB)
            if min(item.length for item in items[edit.first : edit.last]) < _STUB
        ]
        if not edits:
            return fit
        try:
            again = fit_plan(judgement.chain_of(judgement.applied(items, edits)), fit.along, east, north, sigma)
        except EstimationError:
            return fit
        if again.cost > 1.05 * fit.cost + _DEARER * len(edits):
            return fit
        fit = again
    return fit


def _tried(
    fit: PlanFit,
    edits: list[judgement.Edit],
    east: FloatArray,
    north: FloatArray,
    sigma: FloatArray,
    spread: float,
) -> PlanFit:
    """The fit with those edits that cost less than they save."""
    if not edits:
        return fit
    items = judgement.items_of(fit.chain)
    edges = fit.chain.edges
    low = np.array([edges[edit.first] for edit in edits]) - _AROUND
    high = np.array([edges[edit.last] for edit in edits]) + _AROUND

    def tried(some: list[judgement.Edit]) -> PlanFit | None:
        try:
            return fit_plan(judgement.chain_of(judgement.applied(items, some)), fit.along, east, north, sigma)
        except EstimationError:
            return None

    def worth(found: PlanFit | None, some: list[judgement.Edit]) -> bool:
        saved = _DEARER * sum(edit.fewer for edit in some)
        most = min(fit.cost + spread * saved, _DEAREST * max(fit.cost, len(fit.along)))
        return found is not None and found.cost < most

    trial = tried(edits)
    good: list[judgement.Edit] = []
    if trial is not None:
        dearer = (judgement.squares_between(trial, low, high) - judgement.squares_between(fit, low, high)) / spread
        good = [e for e, cost in zip(edits, dearer.tolist(), strict=True) if cost < _DEARER * e.fewer]
        if len(good) == len(edits) and worth(trial, edits):
            return trial
    # where the steps did not lead there with all of them, with fewer
    batch = good or edits[: len(edits) // 2]
    while batch:
        trial = tried(batch)
        if trial is not None and worth(trial, batch):
            return trial
        batch = batch[: len(batch) // 2]
    return fit


def _with_laws(
    fit: PlanFit,
    east: FloatArray,
    north: FloatArray,
    sigma: FloatArray,
    noise: Noise,
    laws: tuple[int, ...],
) -> tuple[PlanFit, float, str]:
    """The fit with the law of transitions that the points prefer, its margin over the next, and which that is."""
    if not (fit.chain.kind >= CLOTHOID).any():
        return fit, float("nan"), ""
    spread = _spread(fit, noise)
    items = judgement.items_of(fit.chain)
    edits = judgement.joined_runs(items)
    joined = judgement.chain_of(judgement.applied(items, edits))
    fits: dict[int, PlanFit] = {}
    for law in (CLOTHOID, *laws):
        trial = judgement.with_law(joined, law)
        turning = trial.kind >= CLOTHOID
        sharp = (np.maximum(np.abs(trial.k0), np.abs(trial.k1)) * trial.length)[turning]
        if law == elements.CUBIC and sharp.max() > _CUBIC_TURN:
            continue
        if law == CLOTHOID and not edits:
            fits[law] = fit
        else:
            try:
                fits[law] = fit_plan(trial, fit.along, east, north, sigma, steps=15)
            except EstimationError:  # a law under which the elements are not determined is none for these points
                if law == CLOTHOID:
                    fits[law] = fit
    edges = fit.chain.edges
    # stretches of transitions in the fit as found, runs as one
    first = {e.first: e for e in edits}
    spans: list[tuple[int, int, int]] = []
    j = 0
    while j < len(items):
        if j in first:
            spans.append((j, first[j].last, first[j].fewer))
            j = first[j].last
        else:
            if items[j].kind >= CLOTHOID:
                spans.append((j, j + 1, 0))
            j += 1
    low = np.array([edges[a] - max(0.5 * (edges[b] - edges[a]), _AROUND) for a, b, _ in spans])
    high = np.array([edges[b] + max(0.5 * (edges[b] - edges[a]), _AROUND) for a, b, _ in spans])
    several = np.array([few for _, _, few in spans])
    apart = judgement.squares_between(fit, low, high) / spread + _DEARER * several
    # laws differ by less than a transition shifts its curve, change of curvature times length squared over 24
    telling = np.array([_shift(items[a:b]) > _TELLING * float(sigma[0]) for a, b, _ in spans])
    apart = np.where(several > 0, np.where(telling, apart, 0.0), np.inf)
    local = {
        law: np.where(telling, judgement.squares_between(found, low, high) / spread, 0.0) for law, found in fits.items()
    }
    # where several clothoids are needed whatever the law, they tell nothing of it
    cost = {law: float(np.minimum(values, apart).sum()) for law, values in local.items()}
    order = sorted(cost, key=lambda law: cost[law])
    best = order[0] if cost[order[0]] < cost[CLOTHOID] - LAW_WORTH else CLOTHOID
    # a cubic parabola is a clothoid to millimetres: between these two no length depends on the choice
    alike = (CLOTHOID, elements.CUBIC)
    second = next((law for law in order if law != best and not (law in alike and best in alike)), best)
    margin = cost[second] - cost[best] if second != best else float("nan")
    law_of = np.full(len(spans), best)
    least = local[best] - LAW_ALONE
    for law, values in local.items():
        if law not in (best, elements.CUBIC):
            better = values < least
            law_of[better], least[better] = law, values[better]
    chosen_cost = np.choose(np.searchsorted(sorted(local), law_of), [local[law] for law in sorted(local)])
    stay = (several > 0) & telling & (apart < chosen_cost)
    kept = [e for e, whole in zip(edits, stay[several > 0].tolist(), strict=True) if not whole]
    merged = judgement.applied(items, kept)
    # laws by element of the merged chain
    per_item: list[int] = []
    for (a, b, few), law, whole in zip(spans, law_of.tolist(), stay.tolist(), strict=True):
        per_item += [CLOTHOID] * (b - a) if few and whole else [law]
    law_by_item = np.full(len(merged), CLOTHOID)
    law_by_item[[i for i, item in enumerate(merged) if item.kind >= CLOTHOID]] = per_item
    if not edits and (law_of == best).all():
        chosen = fits[best]
        if not chosen.settled:
            chosen = fit_plan(chosen.chain, chosen.along, east, north, sigma)
    else:
        start = fits[best].chain if not stay.any() and (law_of == best).all() else judgement.chain_of(merged)
        chosen = fit_plan(judgement.with_law(start, law_by_item), fit.along, east, north, sigma)
    if chosen.cost > fit.cost + spread * (_DEARER * (sum(e.fewer for e in kept) + len(spans)) + LAW_WORTH):
        return fit, float("nan"), ""  # the steps did not lead there
    return chosen, float(margin), elements.KIND_NAMES[second]


def _shift(run: list[judgement.Item]) -> float:
    """By how much a transition shifts its curve, m."""
    return abs(run[-1].k1 - run[0].k0) * sum(item.length for item in run) ** 2 / 24.0


def _spread(fit: PlanFit, noise: Noise) -> float:
    """What squares must be divided by to count as independent: waves tell the same thing again and again."""
    step = float(np.median(np.diff(fit.along)))
    white = float(np.mean(noise.sigma))
    again = 1.0 + 2.0 * noise.length / step * noise.correlated**2 / (white**2 + noise.correlated**2)
    unknown = 2 * len(fit.chain.kind) + 3
    size = fit.cost / max(len(fit.along) - unknown, 1)
    return again * float(np.clip(size, _EXACT, 2.0))  # exact points do not tell more than their rounding


def _as_found(fit: PlanFit, noise: Noise, sigma: float | None) -> Noise:
    """The noise with the size that the residuals have; never less than the user states."""
    unknown = 2 * len(fit.chain.kind) + 3
    white = float(np.mean(noise.sigma))
    total = np.hypot(white, noise.correlated)
    square = float(np.sum(fit.weight * fit.residual**2)) / max(len(fit.along) - unknown, 1)
    factor = np.sqrt(square) / total
    if sigma is not None or factor < 1.0:
        factor = max(float(factor), 1.0)
    return Noise(white * float(factor), noise.correlated * float(factor), noise.length)


def _plan_sigmas(fit: PlanFit, noise: Noise) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sigmas of lengths, of arcs' curvatures (NaN of others), and of the stations of starts, (m,)."""
    from scipy import sparse

    chain: Chain = fit.chain
    m, c = len(chain.kind), len(chain.bend)
    p = 4 * m + c
    design: Any = fit.design
    middle = precision.noise_of_points(design, fit.along, noise, fit.sigma, fit.weight)
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
        shape=(3 * m, p),
    )
    found = precision.sigmas(fit.factor, p, wanted, middle)
    return found[:m], np.where(arc, found[m : 2 * m], np.nan), found[2 * m :]


# --- profile and cant -------------------------------------------------------------------------------------------------


def _averaged(values: FloatArray, count: int) -> FloatArray:
    """Running mean of `count` values, of all where there are fewer."""
    count = min(count, len(values))
    return np.convolve(values, np.ones(count) / count, mode="same")


def _feet_of_all(axis: Axis, rows: IntArray, fit: PlanFit) -> FloatArray:
    """Lengths of all points along the fitted axis, also of those that were passed over; strictly growing, m."""
    along = np.interp(axis.along, axis.along[rows], fit.along)
    beyond = axis.along > axis.along[rows[-1]]
    along[beyond] = fit.along[-1] + axis.along[beyond] - axis.along[rows[-1]]
    least = 1e-6 * np.arange(len(along))
    return np.asarray(np.maximum.accumulate(along - least) + least)


def _values_resolution(values: FloatArray, along: FloatArray, floor: float, stated: float | None = None) -> Resolution:
    spacing = float(along[-1] - along[0]) / (len(along) - 1)

    def fourth(every: int) -> FloatArray:
        found = [np.diff(values[k::every], 4) for k in range(every)]
        return np.concatenate(found)

    return resolution(fourth, spacing, len(along), floor=floor, stated=stated)


def _profile(
    axis: Axis, rows: IntArray, fit: PlanFit, sigma: float | None, warnings: list[str]
) -> tuple[Gradients | None, FloatArray | None, Noise | None, FloatArray | None]:
    if axis.height is None:
        warnings.append(f"track {axis.track} has no heights: no profile")
        return None, None, None, None
    along, height = _feet_of_all(axis, rows, fit), axis.height
    stated = None if axis.stated is None else float(np.median(axis.stated[:, 1]))
    chosen = _values_resolution(height, along, FLOOR, stated)
    pick = np.arange(0, len(along), chosen.every)
    along, height = along[pick], height[pick]
    white = chosen.sigma if sigma is None else sigma
    place = axis.along[pick]
    slope = np.gradient(height, place)
    wide = max(3, round(50.0 / chosen.spacing))
    smooth = _averaged(slope, wide)
    bend = float(np.clip(np.percentile(np.abs(np.gradient(smooth, place)), 90), 2e-5, 2e-3))

    def pieces(noise: Noise, part: slice, beam: int = segmentation.NARROW) -> Pieces:
        return segmentation.segment_profile(along[part], height[part], noise, bend_scale=bend, beam=beam)

    noise = likeliest(pieces, len(along), chosen.spacing, white, floor=FLOOR, stated=sigma)
    found = stretches.stretches_of_pieces(pieces(noise, slice(0, len(along)), segmentation.BEAM), along, height, 2)
    per_point = np.full(len(along), float(np.hypot(np.mean(noise.sigma), noise.correlated)))
    fitted = stretches.fit_stretches(found, along, height, per_point)
    fitted, each = _settle_stretches(fitted, along, height, per_point, noise, sigma, 2)
    s = fitted.stretches
    m = len(s.begin)
    begin = s.begin.copy()
    begin[0] = -np.inf
    gradients = Gradients(
        begin, s.begin, s.state[:, 0].copy(), s.state[:, 1].copy(), 0.5 * np.where(s.bent, s.top, 0.0), np.zeros(m)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.where(s.bent, each[:, 3] / s.top**2, np.nan)
    table = np.column_stack([each[:, 2], each[:, 1], radius])
    return gradients, table, _noise_of_stretches(fitted, noise, sigma, per_point), fitted.residual


def _cant(
    axis: Axis, rows: IntArray, fit: PlanFit
) -> tuple[Cant | None, FloatArray | None, Noise | None, FloatArray | None]:
    if axis.cant is None:
        return None, None, None, None
    along, cant = _feet_of_all(axis, rows, fit), axis.cant
    white = fourth_difference_sigma(cant)
    smooth = white < FLOOR_CANT  # no gauge is as good: these values come from smoothing
    white = SMOOTH_CANT if smooth else white

    def pieces(noise: Noise, part: slice, beam: int = segmentation.NARROW) -> Pieces:
        return segmentation.segment_cant(along[part], cant[part], noise, rate_scale=1e-3, beam=beam)

    spacing = float(along[-1] - along[0]) / (len(along) - 1)
    noise = Noise(white) if smooth else likeliest(pieces, len(along), spacing, white, floor=FLOOR_CANT)
    found = stretches.stretches_of_pieces(pieces(noise, slice(0, len(along)), segmentation.BEAM), along, cant, 1)
    per_point = np.full(len(along), float(np.hypot(np.mean(noise.sigma), noise.correlated)))
    fitted = stretches.fit_stretches(found, along, cant, per_point)
    fitted, each = _settle_stretches(fitted, along, cant, per_point, noise, None, 1)
    s = fitted.stretches
    edges = np.append(s.begin, s.end)
    start = s.state[:, 0].copy()
    end = start + np.where(s.bent, s.top, 0.0) * s.length
    law = np.full(len(start), CLOTHOID, np.int64)
    table = np.column_stack([each[:, 1], each[:, 0]])
    return Cant(edges, start, end, law), table, _noise_of_stretches(fitted, noise, None, per_point), fitted.residual


def _settle_stretches(
    fitted: stretches.StretchesFit,
    along: FloatArray,
    values: FloatArray,
    per_point: FloatArray,
    noise: Noise,
    sigma: float | None,
    states: int,
) -> tuple[stretches.StretchesFit, FloatArray]:
    """The fit without pieces shorter than their sigmas or alike on both sides, and sigmas (m, states + 2) of its unknowns."""
    for _ in range(4):
        true = _noise_of_stretches(fitted, noise, sigma, per_point)
        each = _stretch_sigmas(fitted, along, true, per_point)
        s = fitted.stretches
        drop = np.zeros(len(s.begin), bool)
        begin_sigma = each[:, states]
        ends = np.append(begin_sigma[1:], 0.0)
        short = s.length < 2.0 * np.hypot(begin_sigma, ends)
        flat = s.bent & (np.abs(s.top) < judgement.NOTHING * each[:, states + 1])
        drop[1:] = (short | flat)[1:]
        drop[1:] &= ~drop[:-1]
        if not drop.any():
            return fitted, each
        fewer = _without(s, drop)
        again = stretches.fit_stretches(fewer, along, values, per_point)
        if again.cost > fitted.cost + _DEARER * drop.sum():
            return fitted, each
        fitted = again
    true = _noise_of_stretches(fitted, noise, sigma, per_point)
    return fitted, _stretch_sigmas(fitted, along, true, per_point)


def _without(s: stretches.Stretches, drop: NDArray[np.bool_]) -> stretches.Stretches:
    """Pieces without some: a curve that is none joins the grades beside it into one."""
    keep = ~drop
    kept = np.flatnonzero(keep)
    # two straight pieces that now follow each other are one, unless a kink stands between
    for a, b in zip(kept[:-1].tolist(), kept[1:].tolist(), strict=True):
        if not s.bent[a] and not s.bent[b] and b - a > 1:
            keep[b] = False
    return stretches.Stretches(
        s.begin[keep],
        s.end,
        s.state[keep],
        s.top[keep],
        s.bent[keep],
        np.where(s.begin[keep] == s.begin[0], 0, s.order[keep]),
    )


def _noise_of_stretches(
    fitted: stretches.StretchesFit, noise: Noise, sigma: float | None, per_point: FloatArray
) -> Noise:
    unknown = 2 * len(fitted.stretches.begin)
    square = float(np.sum(fitted.weight * fitted.residual**2)) / max(len(fitted.residual) - unknown, 1)
    factor = float(np.sqrt(square) / per_point[0])
    if sigma is not None or factor < 1.0:
        factor = max(factor, 1.0)
    return Noise(float(np.mean(noise.sigma)) * factor, noise.correlated * factor, noise.length)


def _stretch_sigmas(
    fitted: stretches.StretchesFit, along: FloatArray, noise: Noise, per_point: FloatArray
) -> FloatArray:
    from scipy import sparse

    p = stretches.unknowns(fitted.stretches)
    middle = precision.noise_of_points(fitted.design, along, noise, per_point, fitted.weight)
    found = precision.sigmas(fitted.factor, p, sparse.eye_array(p, format="csr"), middle)
    return found.reshape(len(fitted.stretches.begin), -1)


# --- what to make of it -----------------------------------------------------------------------------------------------


def _shortest(chosen: Resolution, noise: Noise, plan: elements.Plan) -> float:
    """Length over which the points tell a curve of the track's median radius from a straight: 4 sigmas of curvature."""
    arcs = np.abs(plan.curvature_start[plan.kind == elements.ARC])
    bend = float(np.median(arcs)) if len(arcs) else 1e-3
    white = float(np.mean(noise.sigma))
    square = white**2 * chosen.spacing + 2.0 * noise.length * noise.correlated**2
    return float((720.0 * square * (4.0 / bend) ** 2) ** 0.2)


def _doubts(
    axis: Axis,
    plan: elements.Plan,
    length_sigma: FloatArray,
    radius_sigma: FloatArray,
    chosen: Resolution,
    noise: Noise,
    shortest: float,
) -> list[str]:
    said = []
    turning = plan.kind >= CLOTHOID
    vague = turning & (length_sigma > 0.25 * plan.length)
    if vague.any():
        said.append(
            f"track {axis.track}: {int(vague.sum())} of {int(turning.sum())} transitions are known to worse than a quarter of "
            "their length"
        )
    arcs = plan.kind == elements.ARC
    loose = arcs & (radius_sigma * np.abs(plan.curvature_start) > 0.05)
    if loose.any():
        said.append(f"track {axis.track}: {int(loose.sum())} of {int(arcs.sum())} radii are known to worse than 5 %")
    total = float(np.hypot(np.mean(noise.sigma), noise.correlated))
    if chosen.every > 1:
        said.append(
            f"track {axis.track}: its points are smoothed; one in {chosen.every} was used, {chosen.spacing:.0f} m apart"
        )
    if total > 0.05:
        said.append(
            f"track {axis.track}: noise of {total:.2f} m across the track shows curves longer than about {shortest:.0f} m; "
            "shorter elements, and where transitions begin, are not in these points"
        )
    return said
