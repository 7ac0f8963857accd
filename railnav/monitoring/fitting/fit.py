"""From a measured axis to its design: elements of plan, profile and cant, and how sure each is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError, TrackError
from railnav.monitoring.design import Design
from railnav.monitoring.fitting import judgement, segmentation
from railnav.monitoring.fitting.axis import LEAST_POINTS, Axis
from railnav.monitoring.fitting.cant import FittedCant, fit_cant, law_of_ramps
from railnav.monitoring.fitting.editing import Points, plan_sigmas, refined, tried
from railnav.monitoring.fitting.laws import OTHER_LAWS, Law, owed_to_law, prior, under_law, with_laws, with_ramps
from railnav.monitoring.fitting.noise import (
    WAVES_WORTH,
    Resolution,
    likeliest,
    likeliest_smooth,
    of_residuals,
    resolution,
)
from railnav.monitoring.fitting.plan import PlanFit, chain_of_pieces, fit_plan
from railnav.monitoring.fitting.profile import Profile, fit_profile
from railnav.monitoring.fitting.rounding import round_design
from railnav.monitoring.fitting.segmentation import Noise, Pieces
from railnav.monitoring.fitting.surveyed import HIDDEN, longest_unseen, owed_to_unseen
from railnav.run import Progress
from railnav.track import elements
from railnav.track.elements import CLOTHOID

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Points count as exact below this, m: coordinates of designs are rounded, and joints close to a millimetre.
FLOOR = 5e-4
#: A fit whose residuals are this many times the noise has failed.
_FAILED = 5.0
#: Steps that the last adjustment may take.
_AT_LAST = 120
#: An element this short is nothing, m.
_STUB = 0.1
#: And leaving it out is worth this, in -2 log likelihood.
_GONE = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A design fitted to a measured axis, and how sure it is.

    Attributes
    ----------
    design : Design
        Its stations and lengths are the plane's.
    length_sigma, radius_sigma, station_sigma : (m,) array
        Of the plan's elements: length, m; radius of arcs, m (NaN of others); station where they begin, m. Lengths and stations of
        transitions and their neighbours include that their law is not known.
    residual : (n,) array
        Distance of the points used from the axis, positive to the right, m.
    station : (n,) array
        Stations of their feet, m.
    noise : Noise
        White noise and waves that the points have across the track.
    resolution : Resolution
        Which points were used.
    scale : float
        Grid metres per metre on the ground: a radius of the plane over it is the one on the ground.
    law : Law
        How likely each law of transitions is; without transitions it is empty.
    profile : Profile or None
        Sigmas, noise and residuals of the profile.
    cant : FittedCant or None
        Sigmas, noise and residuals of the cant.
    shortest : float
        Length of the shortest curve of the track's median radius that its points would show, m.
    settled : bool
        Whether the adjustment came to rest.
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
    law: Law
    profile: Profile | None
    cant: FittedCant | None
    shortest: float
    settled: bool
    warnings: tuple[str, ...]


def fit_design(
    axis: Axis,
    *,
    sigma: float | None = None,
    sigma_height: float | None = None,
    laws: tuple[int, ...] = OTHER_LAWS,
    vertical: str = "parabola",
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
    vertical : str
        Vertical curves as "parabola" or "circle".
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
    noise, pieces, ref, jump = _segment(axis, along, east, north, chosen, sigma)
    tell(label, 1, total)
    known = axis.surveyed is not None and sigma is None
    points = Points(east, north, noise, known)
    fit = fit_plan(chain_of_pieces(pieces, along, ref), along, east, north, noise)
    fit = refined(_one_sided(fit, points), points, jump=jump)
    smooth = noise.smooth or axis.surveyed is not None
    if noise.correlated > 0.0 and not smooth:
        noise = of_residuals(fit.along, fit.residual, noise, floor=0.2 * FLOOR, stated=sigma)
        points = Points(east, north, noise)
        fit = refined(fit_plan(fit.chain, fit.along, east, north, noise), points, jump=jump)
    tell(label, 2, total)
    if smooth:
        law = prior(laws) if (fit.chain.kind >= CLOTHOID).any() else Law({})
        law = with_ramps(law, law_of_ramps(axis, _feet_of_all(axis, rows, fit), fit.chain.plan, laws))
        fit = under_law(fit, law.best, points)
        owed = owed_to_law(fit, law)
    else:
        cant_here = None if axis.cant is None else axis.cant[rows]
        tried_laws = laws if cant_here is None or not laws else (*laws, elements.VIENNESE)
        fit, law, owed = with_laws(fit, points, tried_laws, cant=cant_here)
    whole = fit
    fit = _one_sided(_without_stubs(fit, points), points)
    if known:  # cutting leaves pieces that the points do not speak for
        fit = _one_sided(refined(fit, points, jump=jump), points)
    fit = _without_hollow(fit, points)
    if len(fit.chain.kind) != len(whole.chain.kind):
        owed = owed_to_law(fit, law)
    tell(label, 3, total)
    if not fit.settled:
        fit = fit_plan(fit.chain, fit.along, east, north, noise, steps=_AT_LAST)
    if not fit.settled:
        warnings.append(f"track {axis.track}: the elements did not come to rest; their sigmas may be too small")
    if "or" in law.said.split():
        why = "its points are smoothed and do not tell" if smooth else "their lengths depend on it"
        warnings.append(f"track {axis.track}: transitions are {law.said}; {why}, and sigmas of lengths say so")
    factor = _as_found(fit, points.known or sigma is not None)
    if factor > _FAILED and sigma is None:
        raise EstimationError(
            f"track {axis.track}: no elements were found that pass the points within {_FAILED:.0f} times their noise of "
            f"{noise.total:.3f} m; state their noise (--sigma), or fit a shorter piece"
        )
    noise = noise.scaled(factor)
    if rounded:
        length_sigma, bend_sigma, _ = (factor * value for value in plan_sigmas(fit))
        with np.errstate(divide="ignore"):
            of_radius = bend_sigma / np.where(fit.chain.kind == elements.ARC, fit.chain.k0, np.nan) ** 2
        fit, count = round_design(
            fit, east, north, of_radius, np.sqrt(length_sigma**2 + owed), scale=axis.scale if on_ground else 1.0
        )
        fit = _one_sided(fit, points)
        warnings.append(
            f"track {axis.track}: {count} radii and lengths rounded and held: they have no sigma of their own"
        )
        owed = owed_to_law(fit, law)
    length_sigma, bend_sigma, station_sigma = (factor * value for value in plan_sigmas(fit))
    # a transition longer by d begins d/2 earlier, and its neighbours are as much shorter
    beside = 0.25 * (np.append(0.0, owed[:-1]) + np.append(owed[1:], 0.0)) * (fit.chain.kind < CLOTHOID)
    length_sigma = np.sqrt(length_sigma**2 + owed + beside)
    station_sigma = np.sqrt(station_sigma**2 + 0.25 * np.maximum(owed, np.append(0.0, owed[:-1])))
    plan = fit.chain.plan
    k = np.where(plan.kind == elements.ARC, plan.curvature_start, np.nan)
    radius_sigma = bend_sigma / k**2
    if points.known and axis.surveyed is not None:
        of_station, of_length, of_radius = owed_to_unseen(plan, axis.surveyed.density)
        station_sigma = np.hypot(station_sigma, of_station)
        # a transition is at least blurred over what the survey smoothed over
        length_sigma = np.hypot(length_sigma, np.where(plan.kind >= CLOTHOID, axis.surveyed.smoothing, of_length))
        radius_sigma = np.hypot(radius_sigma, of_radius)
    feet = _feet_of_all(axis, rows, fit)
    profile = cant = None
    if axis.height is None:
        warnings.append(f"track {axis.track} has no heights: no profile")
    else:
        profile = fit_profile(axis, feet, sigma=sigma_height, vertical=vertical)
    tell(label, 4, total)
    if axis.cant is not None:
        cant = fit_cant(axis, feet, plan, station_sigma)
    design = Design(
        axis.track,
        plan,
        axis.start,
        None if profile is None else profile.gradients,
        None if cant is None else cant.cant,
        axis.crs,
    )
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
        law,
        profile,
        cant,
        shortest,
        fit.settled,
        tuple(warnings),
    )


# --- plan -------------------------------------------------------------------------------------------------------------


def _resolution_of(axis: Axis, sigma: float | None) -> Resolution:
    spacing = float(axis.along[-1] / (len(axis.along) - 1))
    if axis.surveyed is not None:
        every = max(1, min(round(axis.surveyed.smoothing / spacing), len(axis.along) // LEAST_POINTS))
        white = float(axis.surveyed.noise(every * spacing).sigma)
        return Resolution(every, every * spacing, max(white if sigma is None else sigma, FLOOR))

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
    axis: Axis, along: FloatArray, east: FloatArray, north: FloatArray, chosen: Resolution, sigma: float | None
) -> tuple[Noise, Pieces, tuple[FloatArray, ...], float]:
    """Noise of the points, the pieces that they lie on, the smooth curve beside them, and how rare jumps of curvature are."""
    white = chosen.sigma
    stated = None if axis.stated is None or chosen.every == 1 else float(np.median(axis.stated[:, 0]))
    window = max(min((720.0 * chosen.spacing * white**2 / 1e-6) ** 0.2, 120.0), 6.5 * chosen.spacing)
    ref = segmentation.reference(along, east, north, window)
    wide = min(max(round(20.0 / chosen.spacing), 3), len(along))
    smooth = np.convolve(ref[3], np.ones(wide) / wide, mode="same")
    bend = float(np.clip(np.percentile(np.abs(smooth), 90), 2e-4, 0.05))
    rate = float(np.clip(bend / 20.0, 5e-6, 5e-3))

    def pieces(
        noise: Noise,
        part: slice,
        beam: int = segmentation.NARROW,
        prices: segmentation.Prices = segmentation.RAILWAY,
    ) -> Pieces:
        return segmentation.segment_plan(
            along[part],
            east[part],
            north[part],
            noise,
            window=window,
            curvature_scale=bend,
            rate_scale=rate,
            beam=beam,
            prices=prices,
        )

    if axis.surveyed is not None:
        noise = replace(axis.surveyed.noise(chosen.spacing), sigma=white)
    elif stated is not None:
        noise = likeliest_smooth(pieces, len(along), stated, floor=0.1 * FLOOR, stated=sigma)
    else:
        noise = likeliest(pieces, len(along), chosen.spacing, white, floor=FLOOR, stated=sigma)
    everything = slice(0, len(along))

    unseen = axis.surveyed is not None and longest_unseen(axis.surveyed.density, bend) > HIDDEN

    def learnt(noise: Noise) -> tuple[float, Pieces]:
        """Pieces under a noise, at prices that this track itself teaches, and what they cost."""
        if unseen:  # what such points do not show is built all the same
            return 0.0, pieces(noise, everything, segmentation.BEAM, segmentation.UNSEEN)
        least: tuple[float, Pieces] | None = None
        for prices in (segmentation.RAILWAY, segmentation.TRAMWAY):
            for _ in range(3):
                found = pieces(noise, everything, segmentation.BEAM, prices)
                cost = segmentation.whole_cost(found, prices, len(along))
                if least is not None and cost > least[0] - 0.5:
                    break
                least = cost, found
                prices = segmentation.learnt(found, len(along))
        if least is None:
            raise EstimationError(f"track {axis.track}: no elements were found")
        return least

    cost, best = learnt(noise)
    if (
        noise.correlated > 0.0 and not noise.smooth and axis.surveyed is None
    ):  # the whole track may know better than its samples that there are no waves
        plain = Noise(white)
        cost_plain, other = learnt(plain)
        if cost_plain - cost + 2.0 * len(along) * float(np.log(white / np.mean(noise.sigma))) < WAVES_WORTH:
            noise, best = plain, other
    prices = segmentation.UNSEEN if unseen else segmentation.learnt(best, len(along))
    return noise, best, ref, segmentation.rarity_of_jumps(prices)


def _one_sided(fit: PlanFit, points: Points) -> PlanFit:
    """The fit with every transition bending to one side: cut where it is straight, and adjusted again where that helps."""
    for last in (False, False, True):
        items = judgement.items_of(fit.chain)
        if not any(item.k0 * item.k1 < 0.0 for item in items):
            break
        # no other law can be cut in two of its kind
        both = [replace(item, kind=CLOTHOID) if item.k0 * item.k1 < 0.0 else item for item in items]
        parted = judgement.chain_of(judgement.split_inflections(both))
        again = fit_plan(parted, fit.along, points.east, points.north, points.noise, steps=0 if last else 40)
        fit = (
            again
            if last or again.cost < 1.2 * fit.cost
            else fit_plan(parted, fit.along, points.east, points.north, points.noise, steps=0)
        )
    return fit


def _without_stubs(fit: PlanFit, points: Points) -> PlanFit:
    """The fit without elements that shrank to nothing."""
    for _ in range(3):
        items = judgement.items_of(fit.chain)
        nothing = np.zeros(len(items))
        edits = [
            replace(edit, bonus=_GONE)
            for edit in judgement.simplifications(items, nothing, nothing, least=_STUB)
            if min(item.length for item in items[edit.first : edit.last]) < _STUB
        ]
        again = tried(fit, edits, points)
        if again is fit:
            break
        fit = again
    return fit


def _without_hollow(fit: PlanFit, points: Points) -> PlanFit:
    """The fit without transitions that bend nothing: their lengths are anything, and nothing comes to rest by them."""
    least = 0.5 * float(np.mean(points.noise.sigma))
    for j in reversed(judgement.hollow(judgement.items_of(fit.chain), least)):
        fewer = judgement.without_hollow(judgement.items_of(fit.chain), j)
        try:
            again = fit_plan(judgement.chain_of(fewer), fit.along, points.east, points.north, points.noise)
        except EstimationError:
            continue
        fit = again if again.cost < fit.cost + _GONE else fit
    return fit


def _as_found(fit: PlanFit, stated: bool) -> float:
    """How many times larger residuals are than the noise was thought to be; never less than 1 where that is stated."""
    unknown = 2 * len(fit.chain.kind) + 3
    factor = float(np.sqrt(fit.cost / max(len(fit.along) - unknown, 1)))
    return max(factor, 1.0) if stated or factor < 1.0 else factor


def _feet_of_all(axis: Axis, rows: IntArray, fit: PlanFit) -> FloatArray:
    """Lengths of all points along the fitted axis, also of those that were passed over; strictly growing, m."""
    along = np.interp(axis.along, axis.along[rows], fit.along)
    beyond = axis.along > axis.along[rows[-1]]
    along[beyond] = fit.along[-1] + axis.along[beyond] - axis.along[rows[-1]]
    least = 1e-6 * np.arange(len(along))
    return np.asarray(np.maximum.accumulate(along - least) + least)


# --- what to make of it -----------------------------------------------------------------------------------------------


def _shortest(chosen: Resolution, noise: Noise, plan: elements.Plan) -> float:
    """Length over which the points tell a curve of the track's median radius from a straight: 4 sigmas of curvature."""
    arcs = np.abs(plan.curvature_start[plan.kind == elements.ARC])
    bend = float(np.median(arcs)) if len(arcs) else 1e-3
    white = float(np.mean(noise.sigma)) ** 2 * chosen.spacing
    shortest = 100.0
    for _ in range(20):  # waves count by what they have at wavelengths of about the curve
        waves = 2.0 * noise.length * noise.correlated**2 / (1.0 + (2.0 * np.pi * noise.length / shortest) ** 2)
        shortest = float((720.0 * (white + waves) * (4.0 / bend) ** 2) ** 0.2)
    return shortest


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
    total = noise.total
    if chosen.every > 1:
        said.append(
            f"track {axis.track}: its points are smoothed; one in {chosen.every} was used, {chosen.spacing:.0f} m apart"
        )
    if total > 0.05:
        said.append(
            f"track {axis.track}: noise of {total:.2f} m across the track shows curves longer than about {shortest:.0f} m; "
            "shorter elements, and where transitions begin, are not in these points; a hidden transition may have its middle "
            "where a straight meets an arc"
        )
    return said
