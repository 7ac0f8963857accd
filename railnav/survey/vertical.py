"""Heights and cant along the tracks, where the runs have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.survey.angles import slopes_of
from railnav.survey.axis import Chain, ErrorModel, Estimate, solve, sweep
from railnav.survey.noise import Sample, error_models, run_models
from railnav.survey.offsets import Knowledge, Offsets, differences, settle
from railnav.survey.profiles import Profiles
from railnav.survey.surveyed import Surveyed, choose_noise, know, local_noise, white_variances

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: A track has heights when this share of its nodes lies within reach of a run with heights.
SHARE_WITH_HEIGHTS = 0.5
#: Height noise that is tried: step of the vertical curvature, 1/m per sqrt(m).
FIRST_VERTICAL_CURVATURE = 1e-3
#: A node mean this many sigma off is left out.
GROSS_RATIO = 6.0
ROUNDS = 3


@dataclass(slots=True, eq=False)
class Heights:
    """Heights of one track at its nodes.

    Attributes
    ----------
    height, variance : (N,) array
        m and m^2.
    rejected, total : int
        Node means left out, of how many.
    runs : tuple of int
        Runs with heights, in the order of the estimate's border.
    estimate : Estimate
        Of the chain.
    noise : (N-1,) array
        Random walk of the vertical curvature, 1/m per sqrt(m).
    models : dict
        Error model of each kind of receiver in height.
    gross : tuple of (int, int, float, float)
        Node means left out: run, node, time, s, and how far off, m.
    """

    height: FloatArray
    variance: FloatArray
    rejected: int
    total: int
    runs: tuple[int, ...]
    estimate: Estimate
    noise: FloatArray
    models: dict[str, ErrorModel]
    gross: tuple[tuple[int, int, float, float], ...] = ()


def estimate_heights(
    tracks: Sequence[Surveyed], receivers: Sequence[str], kind: IntArray, stated: dict[str, float]
) -> tuple[list[Heights | None], Offsets | None]:
    """Estimate the heights of all tracks, with the runs' vertical frame offsets; None for a track without.

    The same chain as across the track: height, gradient, vertical curvature, and one correlated error a run.
    """
    found: list[Heights | None] = [None] * len(tracks)
    work: list[tuple[int, Surveyed, Chain, FloatArray]] = []
    for i, track in enumerate(tracks):
        P = track.profile
        value = P.height.copy()
        has = np.isfinite(value)
        rows = np.flatnonzero(has.any(axis=1))
        if not len(rows) or _reached(has, track).mean() < SHARE_WITH_HEIGHTS:
            continue
        part = replace(
            track,
            runs=tuple(track.runs[k] for k in rows),
            laid=[track.laid[k] for k in rows],
            profile=_rows(P, rows),
        )
        level = float(np.nanmedian(value[rows]))
        N = len(track.nominal)
        chain = Chain(
            step=track.nominal.step,
            value=value[rows] - level,
            lead=P.height_lead[rows],
            variance=np.ones((len(rows), N)),
            time=P.time[rows],
            design=np.ones((len(rows), N, 1)),
            errors=[],
            bend=np.zeros(N),
            noise=np.zeros(N - 1),
            first_bend=FIRST_VERTICAL_CURVATURE,
        )
        work.append((i, part, chain, np.full(N, level)))
    if not work:
        return found, None
    C = int(kind.max()) + 1
    names = sorted(set(receivers))

    coarse = max(max(1, round(20.0 / c.step)) * c.step for _, _, c, _ in work)
    offsets = settle([_differences(c, p.runs, coarse) for _, p, c, _ in work], kind, np.ones(C), 1)
    samples = [_sample(c, p, offsets.run, receivers, coarse) for _, p, c, _ in work]
    models, _ = error_models(samples, stated)
    scale = np.array([0.5 * models[n].correlated if n in models else 1.0 for n in names])
    for (_, _, chain, _), sample in zip(work, samples, strict=True):
        chain.errors = run_models(sample, models)
    axes = [_middle(c, p, offsets.run) for _, p, c, _ in work]
    levels = [0.0] * len(work)
    rejected = [0] * len(work)
    gross: list[tuple[tuple[int, int, float, float], ...]] = [()] * len(work)
    estimates: list[Estimate] = []
    for turn in range(ROUNDS):
        swept = []
        for w, (_, part, chain, _) in enumerate(work):
            residual = chain.value - offsets.run[list(part.runs)] - axes[w]
            total = np.array([e.total for e in chain.errors])[:, None]
            slack = 1.0 if turn == 0 else 0.0
            chain.variance = white_variances(part.profile, residual, chain.errors, slack)
            wild = np.abs(residual) > GROSS_RATIO * total + slack
            rejected[w] = int(np.count_nonzero(wild))
            chain.variance[wild] = np.nan
            gross[w] = tuple(
                (part.runs[k], int(i), float(chain.time[k, i]), float(residual[k, i])) for k, i in np.argwhere(wild)
            )
            chain.slopes = slopes_of(part, axes[w], up=True)
            if turn == 0:
                levels[w] = choose_noise(chain)
                chain.noise = np.full(len(chain.noise), levels[w])
            swept.append(sweep(chain))
        offsets = settle([know(p, s) for (_, p, _, _), s in zip(work, swept, strict=True)], kind, scale, 1)
        estimates = []
        for w, ((_, part, chain, _), s) in enumerate(zip(work, swept, strict=True)):
            who = list(part.runs)
            e = solve(chain, s, offsets.run[who, 0], offsets.covariance[np.ix_(who, who)], sure=True)
            axes[w] = e.state[:, 0]
            chain.noise = local_noise(e, levels[w], chain.step)
            estimates.append(e)
    for w, (i, part, chain, base) in enumerate(work):
        found[i] = Heights(
            height=axes[w] + base,
            variance=estimates[w].covariance[:, 0, 0],
            rejected=rejected[w],
            total=int(np.isfinite(chain.value).sum()),
            runs=part.runs,
            estimate=estimates[w],
            noise=chain.noise,
            models=models,
            gross=gross[w],
        )
    return found, offsets


def _rows(P: Profiles, rows: IntArray) -> Profiles:
    """Profiles of some of the runs, the count and lead those of fixes with height."""
    return Profiles(
        right=P.right[rows],
        lead=P.height_lead[rows],
        count=np.where(np.isfinite(P.height[rows]), P.count[rows], 0.0),
        height=P.height[rows],
        height_lead=P.height_lead[rows],
        time=P.time[rows],
        sigma=np.full_like(P.sigma[rows], np.nan) if P.height_sigma is None else P.height_sigma[rows],
    )


def with_heights(track: Surveyed, base: FloatArray) -> Surveyed | None:
    """The runs of a track that have heights, as distances above `base` (N,), m, in the place of those to the right; None without."""
    value = track.profile.height - base
    rows = np.flatnonzero(np.isfinite(value).any(axis=1))
    if not len(rows):
        return None
    profile = replace(_rows(track.profile, rows), right=value[rows])
    laid = [track.laid[k] for k in rows]
    return replace(track, runs=tuple(track.runs[k] for k in rows), laid=laid, profile=profile, axis=np.zeros(len(base)))


def _reached(has: NDArray[np.bool_], track: Surveyed) -> NDArray[np.bool_]:
    from scipy.ndimage import maximum_filter1d

    width = 2 * max(1, round(100.0 / track.nominal.step)) + 1
    return np.asarray(maximum_filter1d(has.any(axis=0).astype(np.int8), width) > 0)


def _binned(chain: Chain, coarse: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Values and times by the mean of `coarse` metres, and how many nodes usually stand behind one."""
    together = max(1, round(coarse / chain.step))
    K, N = chain.value.shape
    M = -(-N // together)
    pad = M * together - N
    value = np.pad(chain.value, ((0, 0), (0, pad)), constant_values=np.nan).reshape(K, M, together)
    time = np.pad(chain.time, ((0, 0), (0, pad)), mode="edge").reshape(K, M, together).mean(axis=2)
    known = np.isfinite(value)
    many = known.sum(axis=2)
    mean = np.where(many > 0, np.where(known, value, 0.0).sum(axis=2) / np.maximum(many, 1), np.nan)
    usual = np.array([float(np.median(row[row > 0])) if (row > 0).any() else 1.0 for row in many])
    return mean, time, usual


def _differences(chain: Chain, runs: tuple[int, ...], coarse: float) -> Knowledge:
    mean, _, _ = _binned(chain, coarse)
    return differences(mean, np.ones((mean.shape[1], 1)), runs)


def _sample(chain: Chain, part: Surveyed, offset: FloatArray, receivers: Sequence[str], coarse: float) -> Sample:
    mean, time, usual = _binned(chain, coarse)
    count = np.array([float(np.median(row[row > 0])) if (row > 0).any() else 1.0 for row in part.profile.count]) * usual
    rate = np.ones(len(part.runs))
    for k in range(len(part.runs)):
        known = np.isfinite(mean[k])
        if np.count_nonzero(known) > 1:
            seconds = float(np.median(np.abs(np.diff(time[k][known]))))
            rate[k] = count[k] / max(seconds, 1e-3)
    return Sample(mean - offset[list(part.runs)], time, count, rate, tuple(receivers[i] for i in part.runs))


def _middle(chain: Chain, part: Surveyed, offset: FloatArray) -> FloatArray:
    """First guess of the heights: the median of the runs at each node, smoothed over 50 m."""
    from scipy.ndimage import gaussian_filter1d

    value = np.sort(chain.value - offset[list(part.runs)], axis=0)  # NaN last
    many = np.isfinite(value).sum(axis=0)
    at = np.flatnonzero(many > 0)
    low, high = (many[at] - 1) // 2, many[at] // 2
    guess = np.interp(np.arange(value.shape[1]), at, 0.5 * (value[low, at] + value[high, at]))
    return np.asarray(gaussian_filter1d(guess, 50.0 / chain.step, mode="nearest"))


def measured_cant(track: Surveyed) -> FloatArray | None:
    """Mean cant at the nodes from the runs with a gauge sensor, m, positive with the left rail high as the offset grows; or None."""
    N = len(track.nominal)
    total, many = np.zeros(N), np.zeros(N)
    for k, t in enumerate(track.laid):
        gauge = t.fixes.run.gauge
        if gauge is None or gauge.cant is None or len(gauge.time) < 2:
            continue
        time, passed = track.profile.time[k], np.flatnonzero(track.profile.present[k])
        if not len(passed):
            continue
        inside = (time >= gauge.time[0]) & (time <= gauge.time[-1])
        inside &= (np.arange(N) >= passed[0]) & (np.arange(N) <= passed[-1])
        here = np.interp(time, gauge.time, gauge.cant)
        total += np.where(inside, t.sense * here, 0.0)
        many += inside
    if not many.any():
        return None
    at = np.flatnonzero(many)
    return np.interp(np.arange(N), at, total[at] / many[at])
