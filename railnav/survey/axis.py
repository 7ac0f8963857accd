"""The axis of a track: corrections to a nominal curve, with every run's correlated error and frame offset beside them.

The chain (spec 15) runs along the curve. At each node it holds y, y', y'' (distance to the right of the nominal curve, m, its
slope, and the correction to the curvature, 1/m) and one correlated error a run (Ornstein-Uhlenbeck in the time that the run took
between nodes). Curvature as a whole, nominal plus correction, is a random walk; so the prior is on the track and not on the
corrections, and a new nominal curve changes nothing. Frame offsets are border parameters, common to all chains.

A run with gyroscopic angles also measures the slope y', with a drift of its own as one more state (a random walk in time): the state
menu of spec 16 in coordinates of the curve. Where a stored chain is refined, its records stand in the place of the random walk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.survey import _kernels

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Prior of the first node: distance, m; slope; whole curvature, 1/m.
FIRST_NODE = (1e3, 1.0, 5e-3)
#: What is left of that prior's weights where a stored chain, which holds it already, is refined.
STORED_START = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """How a run errs about the axis.

    Attributes
    ----------
    white : float
        White part of a single fix, m; it also stands for what decays within seconds, at the same spectral density.
    correlated, memory : float
        Correlated part, m, and its correlation time, s.
    total : float
        Standard deviation of a single fix, m.
    """

    white: float
    correlated: float
    memory: float
    total: float

    def scaled(self, factor: float) -> ErrorModel:
        """The same kind of error, `factor` times as large."""
        return ErrorModel(self.white * factor, self.correlated * factor, self.memory, self.total * factor)


@dataclass(frozen=True, slots=True, eq=False)
class Slopes:
    """Slopes that gyroscopic angles measure: bearing of the track less that of the nominal curve, or its gradient.

    Attributes
    ----------
    value, lead, variance : (K, N) array
        Node means, rad (NaN: none), their place beyond the node, m, and the variance of their white part, rad^2.
    first : (K,) array
        Standard deviation of a run's slope error at its first node, rad.
    walk : (K,) array
        How it drifts, rad per sqrt(s).
    broken : (K, N-1) bool array or None
        Steps in which a run's link was found wrong: its slope error starts anew there.
    """

    value: FloatArray
    lead: FloatArray
    variance: FloatArray
    first: FloatArray
    walk: FloatArray
    broken: NDArray[np.bool_] | None = None

    @property
    def runs(self) -> IntArray:
        """Rows that measure anything."""
        return np.flatnonzero(np.isfinite(self.value).any(axis=1)).astype(np.int64)

    def of(self, run: int) -> Slopes:
        """One run alone."""
        k = slice(run, run + 1)
        broken = None if self.broken is None else self.broken[k]
        return Slopes(self.value[k], self.lead[k], self.variance[k], self.first[k], self.walk[k], broken)

    def part(self, first: int, last: int) -> Slopes:
        """Nodes first..last-1."""
        k = slice(first, last)
        broken = None if self.broken is None else self.broken[:, first : last - 1]
        return replace(self, value=self.value[:, k], lead=self.lead[:, k], variance=self.variance[:, k], broken=broken)


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Whitened rows between neighbouring nodes, and at the last one, that take the place of the curvature's random walk.

    M a_k + L a_(k+1) + U[:, 1:] c = U[:, 0] for the axis a = (y, y', y'') and c border parameters that follow those of the runs.

    Attributes
    ----------
    M, L : (N-1, q, 3) array
    U : (N-1, q, 1 + c) array
    final, final_value : (f, 3), (f, 1 + c) array
        The same at the last node.
    """

    M: FloatArray
    L: FloatArray
    U: FloatArray
    final: FloatArray
    final_value: FloatArray


@dataclass(slots=True, eq=False)
class Chain:
    """What goes into one chain: K runs of one track, or of its heights.

    Attributes
    ----------
    step : float
        Distance between nodes, m.
    value, lead, variance : (K, N) array
        Node means, m (NaN: none), their place beyond the node, m, and the variance of their white part, m^2.
    time : (K, N) array
        When each run passed, s.
    design : (K, N, B) array
        What one metre of each border parameter of the run adds to its value.
    errors : list of ErrorModel
    bend : (N,) array
        Second derivative of the nominal curve (curvature of an axis, 0 for heights).
    noise : (N-1,) array
        Standard deviation of the second derivative's random walk, per sqrt(m).
    first_bend : float
        Prior of the first node's whole second derivative.
    slopes : Slopes or None
        What gyroscopic angles say.
    links : Links or None
        What a stored chain says, in place of the random walk and the first node's prior.
    """

    step: float
    value: FloatArray
    lead: FloatArray
    variance: FloatArray
    time: FloatArray
    design: FloatArray
    errors: list[ErrorModel]
    bend: FloatArray
    noise: FloatArray
    first_bend: float = FIRST_NODE[2]
    slopes: Slopes | None = None
    links: Links | None = None

    def part(self, first: int, last: int) -> Chain:
        """Nodes first..last-1 as a chain of their own."""
        k = slice(first, last)
        return replace(
            self,
            value=self.value[:, k],
            lead=self.lead[:, k],
            variance=self.variance[:, k],
            time=self.time[:, k],
            design=self.design[:, k],
            bend=self.bend[k],
            noise=self.noise[first : last - 1],
            slopes=None if self.slopes is None else self.slopes.part(first, last),
        )


@dataclass(slots=True, eq=False)
class Swept:
    """A chain after the forward sweep: its records and what it knows of the border parameters."""

    Rkk: FloatArray
    Rkn: FloatArray
    D: FloatArray
    border: FloatArray
    border_value: FloatArray
    log_det: float
    residual: float


@dataclass(slots=True, eq=False)
class Estimate:
    """The axis estimated.

    Attributes
    ----------
    state : (N, 3) array
        y, y', y'', smoothed.
    covariance : (N, 3, 3) array
        Their covariance, that of the border included.
    step_power : (N-1,) array
        E[(step of the whole second derivative)^2].
    inner, inner_lag : (N, 3, 3), (N-1, 3, 3) array
        Covariance of a node, and with the next one, the border held fixed.
    lean : (N, 3, b) array
        What one metre of each border parameter takes off the state.
    """

    state: FloatArray
    covariance: FloatArray
    step_power: FloatArray
    inner: FloatArray
    inner_lag: FloatArray
    lean: FloatArray

    def part(self, first: int, last: int) -> Estimate:
        """Nodes first..last-1."""
        k, j = slice(first, last), slice(first, last - 1)
        return Estimate(
            self.state[k], self.covariance[k], self.step_power[j], self.inner[k], self.inner_lag[j], self.lean[k]
        )


def smooth_links(step: float, noise: FloatArray, bend: FloatArray) -> Links:
    """The curvature's random walk as rows between nodes: W (a_(k+1) - F a_k) = -W (h^2 / 6, h / 2, 1) (step of the nominal curvature).

    The nominal curvature is linear between nodes, and what the whole one does not do the correction must: its slope and distance follow.
    W is the inverse of the lower Cholesky factor of noise^2 [[h^5/20, h^4/8, h^3/6], [., h^3/3, h^2/2], [., ., h]].
    """
    h = step
    Q = np.array([[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2], [h**3 / 6, h**2 / 2, h]])
    scale = np.sqrt(np.diag(Q))  # in units of their sigmas: the factor loses nothing however short the step
    W = np.linalg.inv(np.linalg.cholesky(Q / np.outer(scale, scale))) / scale
    F = np.array([[1.0, h, 0.5 * h * h], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
    weight = (1.0 / noise)[:, None, None]
    drive = -np.diff(bend)[:, None] * (W @ np.array([h * h / 6.0, 0.5 * h, 1.0])) / noise[:, None]
    return Links(
        -(W @ F) * weight, W * weight, np.ascontiguousarray(drive[:, :, None]), np.zeros((0, 3)), np.zeros((0, 1))
    )


def _rows(chain: Chain) -> tuple[IntArray, IntArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Observation rows, whitened, by node: CSR, error state, run, axis (rows, 3), weight on the error, value, design."""
    node, who = np.nonzero(np.isfinite(chain.value).T & np.isfinite(chain.variance).T)
    w, g = 1.0 / np.sqrt(chain.variance[who, node]), chain.lead[who, node]
    axis = np.column_stack([w, w * g, 0.5 * w * g * g])
    state, run, weight = who, who, w
    value, design = w * chain.value[who, node], w[:, None] * chain.design[who, node]
    if chain.slopes is not None:
        runs = chain.slopes.runs
        column = np.full(len(chain.value), -1)
        column[runs] = len(chain.value) + np.arange(len(runs))
        at, which = np.nonzero(np.isfinite(chain.slopes.value).T)
        v, lead = 1.0 / np.sqrt(chain.slopes.variance[which, at]), chain.slopes.lead[which, at]
        node = np.concatenate([node, at])
        order = np.argsort(node, kind="stable")
        node = node[order]
        axis = np.concatenate([axis, np.column_stack([np.zeros(len(v)), v, v * lead])])[order]
        state = np.concatenate([state, column[which]])[order]
        run = np.concatenate([run, np.full(len(v), -1)])[order]
        weight = np.concatenate([weight, v])[order]
        value = np.concatenate([value, v * chain.slopes.value[which, at]])[order]
        design = np.concatenate([design, np.zeros((len(v), design.shape[1]))])[order]
    first = np.searchsorted(node, np.arange(chain.value.shape[1] + 1)).astype(np.int64)
    return first, state.astype(np.int64), run.astype(np.int64), np.ascontiguousarray(axis), weight, value, design


def _errors(chain: Chain) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Memory (N-1, E) and sigma of the steps (N-1, E) of the runs' errors, and their sigma at the first node (E,)."""
    memory = np.array([e.memory for e in chain.errors])
    sigma = np.array([max(e.correlated, 1e-4) for e in chain.errors])
    elapsed = np.maximum(np.abs(np.diff(chain.time, axis=1)), chain.step / 100.0).T
    phi = np.minimum(np.exp(-elapsed / memory), 1.0 - 1e-9)
    drive = sigma * np.sqrt(1.0 - phi**2)
    if chain.slopes is not None:
        runs = chain.slopes.runs
        phi = np.concatenate([phi, np.ones((len(phi), len(runs)))], axis=1)
        wander = chain.slopes.walk[runs] * np.sqrt(elapsed[:, runs])
        if chain.slopes.broken is not None:
            wander = np.where(chain.slopes.broken[runs].T, chain.slopes.first[runs], wander)
        drive = np.concatenate([drive, wander], axis=1)
        sigma = np.concatenate([sigma, chain.slopes.first[runs]])
    return np.ascontiguousarray(phi), np.ascontiguousarray(drive), sigma


def sweep(chain: Chain, *, borders: bool = True, keep: bool = True) -> Swept:
    """Sweep a chain forward; with `borders`, gather what it says of the frame offsets and of the borders of its links."""
    K, N = chain.value.shape
    B = chain.design.shape[2]
    links = chain.links or smooth_links(chain.step, chain.noise, chain.bend)
    more = links.U.shape[2] - 1
    if more and not borders:
        raise ValueError("links with a border are swept with borders")
    b = 1 + K * B + more if borders else 1
    phi, drive, sigma = _errors(chain)
    n = phi.shape[1] + 3
    size = N if keep else 1
    first, who, run, axis, weight, value, design = _rows(chain)
    place = np.where(run >= 0, 1 + run * B, -1)
    Rkk, Rkn, D = np.zeros((size, n, n)), np.zeros((size, n, n)), np.zeros((size, n, b))
    T = np.zeros((b, b))
    prior = np.array([1.0 / FIRST_NODE[0], 1.0 / FIRST_NODE[1], 1.0 / chain.first_bend])
    if chain.links is not None:
        prior *= STORED_START
    log_det = _kernels.sweep(
        phi, drive, sigma, links.M, links.L, links.U, first, who, place, axis, weight, value, design,
        prior, np.array([0.0, 0.0, -chain.bend[0]]), links.final, links.final_value, keep, Rkk, Rkn, D, T,
    )  # fmt: skip
    return Swept(Rkk, Rkn, D, T[:, 1:], T[:, 0], log_det, float(T[:, 0] @ T[:, 0]))


def unit_weight_rms(chain: Chain, swept: Swept, border: FloatArray) -> float:
    """Unit-weight RMS mu = sqrt(v^T v / redundancy) of a chain, its border known: 1 if the variances are honest (spec 5, step 8).

    Every observation is redundant: states begin with a prior, and the walk gives each node rows of its own. NaN without redundancy.
    """
    rows = int(np.count_nonzero(np.isfinite(chain.value) & np.isfinite(chain.variance)))
    if chain.slopes is not None:
        rows += int(np.count_nonzero(np.isfinite(chain.slopes.value)))
    redundancy = rows - len(border)
    v = swept.border_value - swept.border @ border
    return float(np.sqrt(v @ v / redundancy)) if redundancy > 0 else float("nan")


def log_evidence(chain: Chain) -> float:
    """Log of the likelihood of a chain, up to what does not depend on `noise` (spec 15.4, frame offsets taken as removed)."""
    swept = sweep(chain, borders=False, keep=False)
    return -0.5 * swept.residual - swept.log_det - 3.0 * float(np.log(chain.noise).sum())


def solve(chain: Chain, swept: Swept, border: FloatArray, border_covariance: FloatArray, *, sure: bool) -> Estimate:
    """Substitute backwards with the border parameters known; covariances only when `sure`."""
    N, n, b = swept.D.shape
    X = np.empty((N, n, b))
    _kernels.back(swept.Rkk, swept.Rkn, swept.D, X)
    axis = X[:, n - 3 :, :]
    lean = axis[:, :, 1:]
    state = axis[:, :, 0] - lean @ border
    inner, lag = np.full((N, 3, 3), np.nan), np.zeros((N - 1, 3, 3))
    covariance, cross = np.full((N, 3, 3), np.nan), np.zeros(N - 1)
    if sure:
        _kernels.covariances(swept.Rkk, swept.Rkn, inner, lag)
        covariance = inner + lean @ border_covariance @ lean.transpose(0, 2, 1)
        cross = inner[1:, 2, 2] + inner[:-1, 2, 2] - 2.0 * lag[:, 2, 2]
    return Estimate(state, covariance, np.diff(state[:, 2] + chain.bend) ** 2 + cross, inner, lag, lean)
