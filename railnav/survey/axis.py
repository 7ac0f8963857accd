"""The axis of a track: corrections to a nominal curve, with every run's correlated error and frame offset beside them.

The chain (spec 15) runs along the curve. At each node it holds y, y', y'' (distance to the right of the nominal curve, m, its
slope, and the correction to the curvature, 1/m) and one correlated error a run (Ornstein-Uhlenbeck in the time that the run took
between nodes). Curvature as a whole, nominal plus correction, is a random walk; so the prior is on the track and not on the
corrections, and a new nominal curve changes nothing. Frame offsets are border parameters, common to all chains.
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
    """Smoothed y, y', y'' (N, 3), their covariance (N, 3, 3), and E[(step of the whole second derivative)^2] (N-1,)."""

    state: FloatArray
    covariance: FloatArray
    step_power: FloatArray


def _rows(chain: Chain) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    node, who = np.nonzero(np.isfinite(chain.value).T & np.isfinite(chain.variance).T)
    first = np.searchsorted(node, np.arange(chain.value.shape[1] + 1)).astype(np.int64)
    return (
        first,
        who.astype(np.int64),
        np.ascontiguousarray(chain.lead[who, node]),
        1.0 / np.sqrt(chain.variance[who, node]),
        np.ascontiguousarray(chain.value[who, node]),
        np.ascontiguousarray(chain.design[who, node]),
    )


def sweep(chain: Chain, *, borders: bool = True, keep: bool = True) -> Swept:
    """Sweep a chain forward; with `borders`, gather what it says of the frame offsets."""
    K, N = chain.value.shape
    B = chain.design.shape[2]
    b = 1 + K * B if borders else 1
    n = K + 3
    size = N if keep else 1
    first, who, lead, weight, value, design = _rows(chain)
    memory = np.array([e.memory for e in chain.errors])
    sigma = np.array([max(e.correlated, 1e-4) for e in chain.errors])
    elapsed = np.maximum(np.abs(np.diff(chain.time, axis=1)), chain.step / 100.0)
    phi = np.ascontiguousarray(np.exp(-elapsed / memory[:, None]).T)
    phi = np.minimum(phi, 1.0 - 1e-9)
    Rkk, Rkn, D = np.zeros((size, n, n)), np.zeros((size, n, n)), np.zeros((size, n, b))
    T = np.zeros((b, b))
    prior = np.array([1.0 / FIRST_NODE[0], 1.0 / FIRST_NODE[1], 1.0 / chain.first_bend])
    log_det = _kernels.sweep(
        chain.step, chain.noise, -np.diff(chain.bend), phi, sigma, first, who, lead, weight, value, design,
        prior, np.array([0.0, 0.0, -chain.bend[0]]), keep, Rkk, Rkn, D, T,
    )  # fmt: skip
    return Swept(Rkk, Rkn, D, T[:, 1:], T[:, 0], log_det, float(T[:, 0] @ T[:, 0]))


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
    state = axis[:, :, 0] - axis[:, :, 1:] @ border
    covariance, cross = np.full((N, 3, 3), np.nan), np.zeros(N - 1)
    if sure:
        _kernels.covariances(swept.Rkk, swept.Rkn, covariance, cross)
        covariance += axis[:, :, 1:] @ border_covariance @ axis[:, :, 1:].transpose(0, 2, 1)
    return Estimate(state, covariance, np.diff(state[:, 2] + chain.bend) ** 2 + cross)
