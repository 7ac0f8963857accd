"""How runs err: white and correlated parts, found from the differences of runs on one track, in which the track cancels.

For two runs i, j with errors of variance s_k^2 and correlation exp(-|dt| / tau_k), the product of their differences at two nodes
has the expectation sum_k s_k,i^2 exp(-|dt_i| / tau_k) + s_k,j^2 exp(-|dt_j| / tau_k): linear in the variances, which non-negative
least squares finds on a fixed list of tau. What decays faster than `SHORT` is then represented by white noise of the same
spectral density, the rest by one Ornstein-Uhlenbeck process of the same variance and density.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from railnav.survey.axis import ErrorModel

FloatArray = NDArray[np.float64]

#: Correlation times that are tried, s.
MEMORIES = (3.0, 4.5, 7.0, 10.0, 15.0, 22.0, 33.0, 50.0, 75.0, 110.0, 170.0, 250.0)
#: Errors that decay faster than this are white to the track, s.
SHORT = 12.0
#: A longer correlation time is as good when it leaves no more than this times the least misfit.
NEARLY = 1.15
#: A second correlation time is taken when it leaves less than this of the misfit.
CLEARLY = 0.5
#: How much better or worse than its receiver's usual a single run may be.
SCALES = (0.6, 5.0)
#: Lags in nodes.
LAGS = (0, 1, 2, 3, 5, 8, 12, 20, 30, 50, 80, 120, 200, 300)
#: A pair needs this many common nodes to say anything.
FEWEST_COMMON = 30
#: Records of fewer memories than this do not tell them; what GNSS usually has: s, and the spread of its logarithm.
FEW, USUAL_MEMORY = 20.0, (45.0, 0.7)
#: Nodes of a run at most that say what its frame offset took with it; by bands of lags; the share of a turned component that counts.
MOST_KNOTS, GONE_LAGS, STRAIGHT = 150, (0, 1, 4, 10, 20, 40, 80, 160, 320), 0.02
#: With no other run to compare with: correlation time, s, and error where the receiver states none, m.
ASSUMED_MEMORY, ASSUMED_ERROR = 60.0, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Runs on one track, reduced to nodes so far apart that most hold fixes of every run.

    Attributes
    ----------
    value, time : (K, N) array
        Distance from the axis with the frame offset removed, m, and when the run passed, s.
    count, rate : (K,) array
        Fixes behind a value, usually; fixes a second.
    receiver : tuple of str
        Kind of receiver of each run.
    design : (N, B) array or None
        What one metre of each component of a frame offset adds to a value; ones without.
    """

    value: FloatArray
    time: FloatArray
    count: FloatArray
    rate: FloatArray
    receiver: tuple[str, ...]
    design: FloatArray | None = None


def error_models(samples: Sequence[Sample], stated: dict[str, float]) -> tuple[dict[str, ErrorModel], set[str]]:
    """Error model of each receiver, and the receivers for which it is only assumed.

    Parameters
    ----------
    samples : sequence of Sample
        One a track.
    stated : dict
        Median stated sigma of each receiver, m; NaN where it states none.

    Returns
    -------
    models : dict
    assumed : set of str
        Receivers that no pair of runs could check.
    """
    kinds = sorted({name for sample in samples for name in sample.receiver})
    within = {name: _equations(samples, (name, name)) for name in kinds}
    models: dict[str, ErrorModel] = {}
    for name in kinds:
        if len(within[name][1]):
            models[name] = _fit(*within[name])
    for name in kinds:  # a receiver with one run a track: against the others, whose part is known, or halves
        if name in models:
            continue
        for partner in sorted(kinds, key=lambda k: k not in models):
            if partner == name:
                continue
            equations = _equations(samples, (name, partner))
            if not len(equations[1]):
                continue
            half = _fit(*equations)
            if partner in models:
                other = models[partner]
                correlated = np.sqrt(max(2.0 * half.correlated**2 - other.correlated**2, 0.25 * half.correlated**2))
                white = np.sqrt(max(2.0 * half.white**2 - other.white**2, 0.25 * half.white**2))
                total = np.sqrt(max(2.0 * half.total**2 - other.total**2, 0.25 * half.total**2))
                models[name] = ErrorModel(float(white), float(correlated), half.memory, float(total))
            else:
                models[name] = half
            break
    assumed = set(kinds) - set(models)
    for name in assumed:
        sigma = stated.get(name, np.nan)
        sigma = sigma if np.isfinite(sigma) else ASSUMED_ERROR
        models[name] = ErrorModel(0.5 * sigma, sigma, ASSUMED_MEMORY, 1.1 * sigma)
    return models, assumed


def error_model_against(samples: Sequence[Sample], receiver: str) -> ErrorModel | None:
    """Error model of a receiver from its distances to an axis that is known without it; None where there are too few.

    The axis stands for a second run that errs by nothing, so the fit's even share of the difference is half of the power.
    """
    paired = []
    for sample in samples:
        rows = [k for k, name in enumerate(sample.receiver) if name == receiver]
        for k in rows:
            value = np.stack([sample.value[k], np.where(np.isfinite(sample.value[k]), 0.0, np.nan)])
            paired.append(
                Sample(value, sample.time[[k, k]], sample.count[[k, k]], sample.rate[[k, k]], (receiver, "the axis"))
            )
    equations = _equations(paired, (receiver, "the axis"))
    return _fit(*equations).scaled(float(np.sqrt(2.0))) if len(equations[1]) else None


def run_models(sample: Sample, models: dict[str, ErrorModel]) -> list[ErrorModel]:
    """Error model of each run of a track: its receiver's, larger or smaller as its differences to the other runs say.

    The scatter of a difference is the sum of two variances, whatever the track; three runs or more tell them apart. Runs are not
    judged by an axis to which they contribute: the axis would follow one run, call that run good, and follow it more.
    """
    from scipy.optimize import nnls

    own = [models[name] for name in sample.receiver]
    K = len(own)
    rows, values = [], []
    for i in range(K):
        for j in range(i + 1, K):
            D = sample.value[i] - sample.value[j]
            D = D[np.isfinite(D)]
            if len(D) < FEWEST_COMMON:
                continue
            row = np.zeros(K)
            row[[i, j]] = 1.0
            spread = 1.4826 * float(np.median(np.abs(D - np.median(D))))
            weight = np.sqrt(len(D)) / (own[i].total ** 2 + own[j].total ** 2)
            rows.append(weight * row)
            values.append(weight * spread**2)
    if K < 3 or len(rows) < K:
        return own
    variance, _ = nnls(np.array(rows), np.array(values))
    usual = {
        n: float(np.mean([v for v, r in zip(variance, sample.receiver, strict=True) if r == n]))
        for n in set(sample.receiver)
    }
    scaled = []
    for m, v, name in zip(own, variance, sample.receiver, strict=True):
        factor = (
            np.sqrt(0.8 * v / usual[name] + 0.2) if usual[name] > 0 else 1.0
        )  # drawn a little to the receiver's own
        scaled.append(m.scaled(float(np.clip(factor, *SCALES))))
    return scaled


def _equations(samples: Sequence[Sample], pair: tuple[str, str]) -> tuple[FloatArray, FloatArray, float, float, float]:
    """Lagged products of pair differences: regressors (lags, 1 + memories), half products (lags,), fixes a value and a second, seconds.

    The seconds are those of independent differences: K runs have K - 1.
    """
    rows: list[FloatArray] = []
    products: list[float] = []
    weights: list[float] = []
    counts: list[float] = []
    rates: list[float] = []
    seconds = 0.0
    for sample in samples:
        K, N = sample.value.shape
        took: dict[int, float] = {}
        for i in range(K):
            for j in range(i + 1, K):
                if {sample.receiver[i], sample.receiver[j]} != set(pair):
                    continue
                D = sample.value[i] - sample.value[j]
                known = np.isfinite(D)
                if np.count_nonzero(known) < FEWEST_COMMON:
                    continue
                spread = 1.4826 * float(np.median(np.abs(D[known])))
                counts += [sample.count[i], sample.count[j]]
                rates += [sample.rate[i], sample.rate[j]]
                D = np.where(np.abs(D) <= 4.0 * max(spread, 1e-4), D, np.nan)
                gone = _gone(sample, i, j, known)
                for k in (i, j):
                    took[k] = max(took.get(k, 0.0), float(np.ptp(sample.time[k, known])))
                for lag in LAGS:
                    if lag >= N:
                        break
                    product = D[: N - lag] * D[lag:]
                    both = np.isfinite(product)
                    many = np.count_nonzero(both)
                    if many < FEWEST_COMMON:
                        continue
                    row = np.zeros(1 + len(MEMORIES))
                    row[0] = lag == 0
                    for t in (sample.time[i], sample.time[j]):
                        dt = float(np.median(np.abs(t[lag:] - t[: N - lag])[both]))
                        row[1:] += 0.5 * np.exp(-dt / np.array(MEMORIES))
                    row[1:] -= gone(lag)
                    rows.append(row)
                    products.append(0.5 * float(product[both].mean()))
                    weights.append(np.sqrt(many))
        seconds += sum(took.values()) * (1.0 - 1.0 / max(len(took), 1))
    w = np.array(weights)
    A = np.array(rows).reshape(-1, 1 + len(MEMORIES))
    count, rate = (float(np.median(v)) if v else 1.0 for v in (counts, rates))
    return A * w[:, None], np.array(products) * w, count, rate, seconds


def _gone(sample: Sample, i: int, j: int, known: NDArray[np.bool_]) -> Callable[[int], FloatArray]:
    """What a frame offset fitted to the difference of two runs takes off its lagged products, by lag, for each memory.

    Residuals of a fit to the design X have the covariance R - (H R + R H - H R H) with H = X (X^T X)^-1 X^T. An error that lasts as long
    as a run goes with the offset almost whole; forgotten, the memory would come out at half and the error a third too small.
    """
    at = np.flatnonzero(known)
    at = at[:: max(1, len(at) // MOST_KNOTS)]
    X = np.ones((len(at), 1)) if sample.design is None else sample.design[at]
    Q, R_x = np.linalg.qr(X)
    Q = Q[:, np.abs(np.diag(R_x)) > STRAIGHT * np.abs(R_x[0, 0])]
    apart = np.abs(at[:, None] - at)
    order = np.argsort(apart, axis=None, kind="stable")
    lags = apart.ravel()[order]
    gone = []
    for memory in MEMORIES:
        R = np.zeros_like(apart, dtype=float)
        for t in (sample.time[i, at], sample.time[j, at]):
            R += 0.5 * np.exp(-np.abs(t[:, None] - t) / memory)
        HR = Q @ (Q.T @ R)
        gone.append((HR + HR.T - (HR @ Q) @ Q.T).ravel()[order])
    edges = np.searchsorted(lags, [b for b in GONE_LAGS if b <= lags[-1]] + [lags[-1] + 1])
    centre = np.array([lags[a:b].mean() for a, b in pairwise(edges) if b > a])
    mean = np.array([[g[a:b].mean() for a, b in pairwise(edges) if b > a] for g in gone])
    return lambda lag: np.array([float(np.interp(lag, centre, row)) for row in mean])


def _fit(A: FloatArray, y: FloatArray, count: float, rate: float, seconds: float) -> ErrorModel:
    """White and one correlated part, and a second, short one where it clearly helps; gathered into white and correlated.

    A record that holds few memories does not tell them: then the fits of all memories are averaged, each with the weight of what GNSS
    usually does (`USUAL_MEMORY`) and of how well it fits. The least of the misfits alone would be too sure of itself as often as not.
    """
    from scipy.optimize import nnls

    memory = np.array(MEMORIES)

    def fit(*columns: int) -> tuple[float, FloatArray]:
        part = np.zeros(1 + len(memory))
        chosen = [0, *columns]
        part[chosen], norm = nnls(A[:, chosen], y)
        return float(norm) ** 2, part

    many = len(memory) + 1
    singles = [fit(j) for j in range(1, many)]
    best = min(range(len(singles)), key=lambda j: singles[j][0])
    cost, part = singles[best]
    held = 0.5 * seconds / memory[best]
    if held < FEW:
        usual, spread = USUAL_MEMORY
        misfit = np.array([c for c, _ in singles])
        score = -0.5 * ((np.log(memory / usual)) / spread) ** 2 - 0.5 * held * (
            misfit / max(misfit.min(), 1e-300) - 1.0
        )
        score[memory < SHORT] = -np.inf
        share = np.exp(score - score.max())
        part = (share / share.sum()) @ np.array([p for _, p in singles])
    else:
        if best + 1 < len(singles) and singles[best + 1][0] <= NEARLY * cost:
            part = singles[best + 1][1]  # the next longer memory fits nearly as well, and averages less
        pairs = [fit(i, j) for i in range(1, many) for j in range(i + 2, many)]
        cost_2, part_2 = min(pairs, key=lambda item: item[0])
        if cost_2 < CLEARLY * cost:
            part = part_2
    power = part[1:]
    short = memory < SHORT
    single = part[0] * count  # a value is the mean of `count` fixes
    white = single + float((power[short] * np.maximum(1.0, 2.0 * memory[short] * rate)).sum())  # of the same density
    long = float(power[~short].sum())
    tau = float((power * memory)[~short].sum() / long) if long > 0 else SHORT
    floor = 1e-3
    return ErrorModel(
        white=max(float(np.sqrt(white)), floor),
        correlated=max(float(np.sqrt(long)), floor),
        memory=max(tau, SHORT),
        total=max(float(np.sqrt(single + power.sum())), floor),
    )
