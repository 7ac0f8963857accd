"""Was it the fix, or the odometer and the gyroscopes? Contradictions within one run, told apart by two clones and their evidence.

A run with odometer and gyroscopic angles measures its way twice: by fixes, and by increments between them (spec 7). Its own chain holds
position, the drifts of the increments (scale, bearing, slope) and the fixes' correlated error (spec 16: n = 9, or 7 in plan). Where a
fix does not fit what the run knew before, two clones go on: one without the fix, one that does not believe the link (spec 17). A fix
that was bad is set aside; where a link was bad the run starts anew there, with the errors of its angles and its odometer free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from railnav.estimation.chain import Chain, solve_chain
from railnav.estimation.menus import CorrelatedError, IncrementDrift, survey_chain
from railnav.estimation.screening import Verdict, screen_chain
from railnav.survey.fixes import LINKS, USED, Fixes
from railnav.survey.surveyed import TOLD_RANGE, tells
from railnav.vehicle.increments import SpaceIncrements, space_increments

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Probability of an alarm for a good fix.
SIGNIFICANCE = 1e-7
#: Two clones go on for so many epochs, and for so long, s.
LOOK_AHEAD, LOOK_SECONDS = 5, 4.0
#: A link that is not believed: factor on its covariance; by it a bearing may jump by some milliradians and a distance by metres.
INFLATION = 1e6
#: How far a bad fix may lie, m.
OUTLIER_RANGE = 10.0
#: Sigma of the drifts at the start: scale, bearing and slope, rad.
FIRST_DRIFT = (0.02, 0.05, 0.05)
#: How they wander, per sqrt(s): the steadiest of these that explains the run.
WALKS = (1e-5, 1e-4, 1e-3)
#: The fixes' correlated error, in terms of the white one, its least size, m, and its memory, s.
CORRELATED, LEAST_CORRELATED, MEMORY = 3.0, 0.02, 60.0
#: Sigma of what increments cannot say better, m and rad; of a fix, m.
LEAST_STEP, LEAST_ANGLE, LEAST_FIX = 2e-4, 2e-5, 2e-3
#: The chain holds a run when half of its NIS, freed of gross errors, stay below so much of chi-square's median (about d - 2/3).
HOLDS = 1.3
#: Where they do not, but stay below this, fixes are taken to be worse by as much.
WORSE = 2.5
#: The first seconds of a run are not judged.
UNTOLD = 2.0
#: More doubtful epochs than this share, and it is the model that does not hold.
MOST_DOUBTFUL = 0.02
#: A jump of the fixes that is taken back within this time, s, was theirs: no slip undoes itself; to this share of its size.
TAKEN_BACK, BACK_SHARE = 180.0, 0.35
#: A slip of a bearing is sought so many fixes back, on the fixes so many before and after.
SEARCHED, SETTLED = 60, 30
#: Fixes that a run needs to be judged.
FEWEST = 50


@dataclass(frozen=True, slots=True, eq=False)
class Attribution:
    """One contradiction between fixes and increments, and what was found to be wrong.

    Attributes
    ----------
    wrong : {"fix", "link"}
    first, last : int
        Fixes of the run: those that are wrong, or the one before and the one after the link.
    time : float
        When it showed, s.
    size : float
        How far the fix lies from where the run's past and the link put it, m.
    statistic, limit : float
        Sum of squares of the block, and what it may be.
    evidence : float
        ln evidence of this verdict over the other.
    """

    wrong: Literal["fix", "link"]
    first: int
    last: int
    time: float
    size: float
    statistic: float
    limit: float
    evidence: float


@dataclass(frozen=True, slots=True, eq=False)
class Attributions:
    """What was found in one run.

    Attributes
    ----------
    found : tuple of Attribution
    judged : int
        Fixes that met a link.
    unsure : str
        Why nothing was judged although there are increments; empty otherwise.
    """

    found: tuple[Attribution, ...] = ()
    judged: int = 0
    unsure: str = ""

    @property
    def breaks(self) -> list[tuple[int, int]]:
        """Fixes before and after each link that is not believed."""
        return [(a.first, a.last) for a in self.found if a.wrong == "link"]


def attribute(fixes: Fixes) -> Attributions:
    """Judge the fixes of a run by its own odometer and gyroscopes, and these by the fixes; nothing without them.

    Fixes that are found wrong get their reason (`LINKS`) and size; links are only told.

    Parameters
    ----------
    fixes : Fixes
        Antenna already at the reference point; `reason` and `size` are written.

    Returns
    -------
    Attributions

    References
    ----------
    Specification rail 7, 16 (n = 9) and 17.
    """
    laid = _increments(fixes)
    if laid is None:
        return Attributions()
    rows, steps = laid
    d = 3 if np.isfinite(fixes.height[rows]).all() else 2
    place = np.column_stack([fixes.easting[rows], fixes.northing[rows], fixes.height[rows]])[:, :d]
    dX, B = steps.increment[:, :d], steps.directions[:, :d]
    time = fixes.time[rows]
    moved = np.linalg.norm(dX, axis=1) > 0.2
    white = _white(np.concatenate([np.zeros((1, d)), np.cumsum(dX, axis=0)]) - (place - place[0]), moved)
    sigma = np.maximum(white, LEAST_FIX)
    share = _stated_share(fixes, rows, place, dX)
    K = np.eye(d) * ((sigma * share) ** 2)[:, :, None]
    KdX = steps.covariance[:, :d, :d] + LEAST_STEP**2 * np.eye(d)
    dt = np.diff(time)
    error = CorrelatedError(np.maximum(CORRELATED * sigma, LEAST_CORRELATED), MEMORY, np.maximum(dt, 1e-3))
    ahead = max(LOOK_AHEAD, int(np.ceil(LOOK_SECONDS / max(float(np.median(dt)), 1e-3))))
    trials = [(walk, 1.0) for walk in WALKS]
    ratios: list[float] = []
    for number, (walk, scale) in enumerate(trials):
        drift = IncrementDrift(B, FIRST_DRIFT, walk * np.sqrt(np.maximum(dt, 1e-3))[:, None] * np.ones(3))
        chain = survey_chain(place, scale**2 * K, dX, KdX, drift=drift, correlated=error, nominal=place)
        screening = screen_chain(
            chain,
            outlier_range=OUTLIER_RANGE / (scale * sigma * share).mean(axis=1),
            significance=SIGNIFICANCE,
            look_ahead=ahead,
            inflation=INFLATION,
        )
        # before the drifts are known the first metres say nothing
        verdicts = tuple(v for v in screening.verdicts if time[v.epoch] - time[0] > UNTOLD)
        nis = solve_chain(screening.chain, covariance=False).nis[10:]
        ratios.append(float(np.median(nis)) / (d - 2.0 / 3.0))
        if ratios[-1] < HOLDS and len(verdicts) <= max(MOST_DOUBTFUL * len(rows), 5.0):
            sigma = scale * sigma
            break
        if (
            number == len(WALKS) - 1 and min(ratios) < WORSE
        ):  # all walks, and the fixes are somewhat worse than they look
            trials.append((WALKS[int(np.argmin(ratios))], float(np.sqrt(min(ratios)))))
    else:
        return Attributions(
            judged=len(rows),
            unsure=f"fixes and increments contradict each other in {len(verdicts)} of {len(rows)} places: neither is judged by the other",
        )
    found = [
        _located(a, chain, rows, time) if a.wrong == "link" else a for a in _paired(verdicts, rows, time, sigma, share)
    ]
    for a in found:
        if a.wrong == "fix":
            bad = rows[(rows >= a.first) & (rows <= a.last)]
            fixes.reason[bad], fixes.size[bad] = LINKS, a.size
    return Attributions(tuple(found), len(rows))


def _increments(fixes: Fixes) -> tuple[IntArray, SpaceIncrements] | None:
    """Increments from each used fix to the next, by odometer and angles; None where these are not there all along."""
    if fixes.angles is None or fixes.odometer is None:
        return None
    nose_time, bearing, pitch = fixes.angles
    wheel_time, distance = fixes.odometer
    first, last = max(nose_time[0], wheel_time[0]), min(nose_time[-1], wheel_time[-1])
    rows = np.flatnonzero((fixes.reason == USED) & (fixes.time >= first) & (fixes.time <= last)).astype(np.int64)
    if len(rows) < FEWEST:
        return None
    t = fixes.time[rows]
    inside = nose_time[(nose_time > t[0]) & (nose_time < t[-1])]
    grid = np.union1d(t, inside)
    middle = 0.5 * (grid[1:] + grid[:-1])
    ds = np.diff(np.interp(grid, wheel_time, distance))
    b, p = np.interp(middle, nose_time, bearing), np.interp(middle, nose_time, pitch)
    moving = np.abs(ds) > 0.02
    steps = space_increments(
        ds, b, np.tan(p),
        distance_sigma=max(_jitter(np.interp(grid, wheel_time, distance)[np.append(moving, True)]), LEAST_STEP),
        bearing_sigma=max(_jitter(b[moving]), LEAST_ANGLE),
        slope_sigma=max(_jitter(p[moving]), LEAST_ANGLE),
    )  # fmt: skip
    return rows, steps.between(np.searchsorted(grid, t))


def _jitter(values: FloatArray) -> float:
    """White part of a smooth series: its third differences are those of the noise alone, sqrt(20) times as large."""
    third = np.diff(values, 3)
    return 1.4826 * float(np.median(np.abs(third))) / np.sqrt(20.0) if len(third) else 0.0


def _white(difference: FloatArray, moved: NDArray[np.bool_]) -> FloatArray:
    """White part of the fixes in each coordinate (d,), from their differences to the dead-reckoned way."""
    use = np.append(True, moved) if np.count_nonzero(moved) >= FEWEST else np.ones(len(difference), np.bool_)
    return np.array([_jitter(column) for column in difference[use].T])


def _located(a: Attribution, chain: Chain, rows: IntArray, time: FloatArray) -> Attribution:
    """The link whose break explains the fixes around best: a bearing that slipped shows only when the way has gone astray."""
    epoch = int(np.searchsorted(rows, a.last))
    first, end = max(epoch - SEARCHED - SETTLED, 0), min(epoch + SETTLED, len(chain))
    links = slice(first, end - 1)
    M, L, u = (np.array(np.broadcast_to(x, (len(chain) - 1, *x.shape[1:]))[links]) for x in (chain.M, chain.L, chain.u))
    H = chain.H if len(chain.H) == 1 else chain.H[first:end]
    weak = 1.0 / np.sqrt(INFLATION)
    best, score = epoch, -np.inf
    for k in range(max(epoch - SEARCHED, first + 1), epoch + 1):
        kept = M[k - 1 - first].copy(), L[k - 1 - first].copy(), u[k - 1 - first].copy()
        for rows_of in (M, L, u):
            rows_of[k - 1 - first] *= weak
        trial = Chain(H, chain.z[first:end], M, L, u, counts=chain.counts[first:end], prior=chain.prior)
        evidence = solve_chain(trial, covariance=False, evidence=True).log_evidence
        assert evidence is not None
        total = float(np.nansum(evidence))
        if total > score:
            best, score = k, total
        M[k - 1 - first], L[k - 1 - first], u[k - 1 - first] = kept
    return replace(a, first=int(rows[best - 1]), last=int(rows[best]), time=float(time[best]))


def _stated_share(fixes: Fixes, rows: IntArray, place: FloatArray, dX: FloatArray) -> FloatArray:
    """Stated sigmas (m, d) in terms of the run's own medians, where errors grow with them (a base station far or near); else ones."""
    d = place.shape[1]
    share = np.ones((len(rows), d))
    if fixes.sigma_axes is None:
        return share
    third = np.abs(np.diff(place - np.concatenate([np.zeros((1, d)), np.cumsum(dX, axis=0)]), 3, axis=0))
    for axis in range(d):
        stated = fixes.sigma_axes[axis][rows]
        if np.isfinite(stated).all() and tells(stated[1:-2] / float(np.median(stated)), third[:, axis]):
            share[:, axis] = np.clip(stated / float(np.median(stated)), *TOLD_RANGE)
    return share


def _paired(
    verdicts: tuple[Verdict, ...], rows: IntArray, time: FloatArray, sigma: FloatArray, share: FloatArray
) -> list[Attribution]:
    """Verdicts as attributions; two jumps that cancel each other were of the fixes between them, for no slip undoes itself."""
    d = len(sigma)
    jump = [v.residual[:d] * sigma * share[v.epoch] if len(v.residual) >= d else np.full(d, np.nan) for v in verdicts]
    size = [float(np.linalg.norm(j)) for j in jump]
    out: list[Attribution] = []
    done: set[int] = set()
    for i, v in enumerate(verdicts):
        if i in done:
            continue
        if v.wrong == "link":
            for j in range(i + 1, len(verdicts)):
                w = verdicts[j]
                if j in done or w.wrong != "link" or time[w.epoch] - time[v.epoch] > TAKEN_BACK:
                    continue
                if np.linalg.norm(jump[i] + jump[j]) < BACK_SHARE * min(size[i], size[j]) + 3.0 * float(sigma.max()):
                    done.add(j)
                    out.append(
                        Attribution(
                            "fix", int(rows[v.epoch]), int(rows[w.epoch - 1]), float(time[v.epoch]), 0.5 * (size[i] + size[j]),
                            v.nis, v.limit, float(v.log_odds + w.log_odds),
                        )
                    )  # fmt: skip
                    break
            else:
                out.append(
                    Attribution(
                        "link", int(rows[v.epoch - 1]), int(rows[v.epoch]), float(time[v.epoch]), size[i], v.nis, v.limit,
                        float(v.log_odds),
                    )
                )  # fmt: skip
        else:
            at = int(rows[v.epoch])
            out.append(Attribution("fix", at, at, float(time[v.epoch]), size[i], v.nis, v.limit, float(v.log_odds)))
    return out
