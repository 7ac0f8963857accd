"""A chain that is never stored: rows go in as they come, estimates come out, memory stays the same."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation import _chain_kernels
from railnav.estimation.chain import Chain, Sweep, as_floats, compiled_size, prior_rows, start_triangle, sweep_chain
from railnav.estimation.chain_solution import packed_size

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class FilterEstimate:
    """What a filter knows now.

    Attributes
    ----------
    epoch : int
        Index of the epoch, from 0.
    state : (n,) array
        Estimate from all rows so far.
    covariance : (n, n) array
        Its covariance.
    """

    epoch: int
    state: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class BlockResult:
    """What a block of observation rows said.

    Attributes
    ----------
    nis : float
        Normalised innovation squared, chi-square with `dof` degrees of freedom if the model holds.
    dof : int
        Redundant rows; the others filled empty pivots.
    log_evidence : float or None
        ln p(block | past) with the whitening's determinant; None while the state is not determined.
    """

    nis: float
    dof: int
    log_evidence: float | None


@dataclass(frozen=True, slots=True, eq=False)
class SweepResult:
    """NIS of a stretch of epochs that a filter swept.

    Attributes
    ----------
    nis, dof, rejected : (N,) array
        As in `ChainSolution`.
    coupling_nis, coupling_dof : (links,) array
        As in `ChainSolution`.
    filtered : (N, n) array or None
        Estimates from the rows up to each epoch, NaN while they do not exist.
    log_evidence : (N,) array or None
        As in `ChainSolution`.
    """

    nis: FloatArray
    dof: IntArray
    rejected: BoolArray
    coupling_nis: FloatArray
    coupling_dof: IntArray
    filtered: FloatArray | None
    log_evidence: FloatArray | None


class ChainFilter:
    """A chain that is never stored: rows go in epoch by epoch, estimates come out, memory stays the same.

    Parameters
    ----------
    n : int
        Numbers in one state.
    prior : ((r, n) array, (r,) array), optional
        Whitened rows on the first state.
    lag : int
        Keep this many records, so that `lagged` can look back that many epochs.

    Raises
    ------
    EstimationError
        The size or the lag makes no sense, or the prior does not fit.

    Notes
    -----
    The mathematics is that of `solve_chain`, rotation by rotation.

    Examples
    --------
    >>> live = ChainFilter(1, lag=2)
    >>> for measured in (0.0, 1.1, 1.9):
    ...     if live.epoch >= 0:
    ...         live.couple([[-1.0]], [[1.0]], [1.0])
    ...     block = live.observe([[1.0]], [measured])
    >>> round(float(live.estimate().state[0]), 6), round(block.nis, 6)
    (1.9625, 0.010417)
    """

    def __init__(self, n: int, *, prior: tuple[ArrayLike, ArrayLike] | None = None, lag: int = 0) -> None:
        if n < 1 or lag < 0:
            raise EstimationError(f"a filter of {n} states with lag {lag} makes no sense; n >= 1 and lag >= 0 do")
        self.n = n
        self._triangle = start_triangle(None if prior is None else prior_rows(prior, n), n)
        self._records: deque[FloatArray] = deque(maxlen=lag)
        self._epoch = -1

    @property
    def epoch(self) -> int:
        """Index of the current epoch; -1 before the first rows."""
        return self._epoch

    @property
    def determined(self) -> bool:
        """Whether the rows so far determine the state."""
        return bool((np.diagonal(self._triangle) > 0).all())

    @property
    def triangle(self) -> FloatArray:
        """Copy of [R | b], (n, n + 1): all that the filter knows."""
        return self._triangle.copy()

    def couple(self, M: ArrayLike, L: ArrayLike, u: ArrayLike) -> None:
        """Go to the next epoch by coupling rows M x_k + L x_(k+1) = u.

        Parameters
        ----------
        M, L : (q, n) array
            Whitened coefficients.
        u : (q,) array
            Whitened right-hand sides.

        Raises
        ------
        EstimationError
            Shapes do not fit, a value is not finite, or the rows couple nothing.
        """
        rows = np.atleast_2d(as_floats("u", u))
        self._take(Chain(np.zeros((0, self.n)), np.zeros((1, 0)), M, L, rows, lead=1))

    def observe(self, H: ArrayLike, z: ArrayLike, *, log_det_whitening: float = 0.0) -> BlockResult:
        """Let observation rows H x = z of the current epoch in.

        Parameters
        ----------
        H : (m, n) array
            Whitened coefficients.
        z : (m,) array
            Whitened right-hand sides.
        log_det_whitening : float
            ln |det W| of the whitening; give it whenever it differs between hypotheses that are compared.

        Returns
        -------
        BlockResult
            NIS, degrees of freedom and evidence.

        Raises
        ------
        EstimationError
            Shapes do not fit, or a value is not finite.

        References
        ----------
        Specification rail 15.4.
        """
        stretch = Chain(H, np.atleast_2d(as_floats("z", z)))
        before = np.diagonal(self._triangle).copy()
        epoch = max(self._epoch, 0)
        result = self._take(stretch)
        self._epoch = epoch
        evidence = None
        nis, dof = float(result.nis[0]), int(result.dof[0])
        if (before > 0).all():
            after = np.diagonal(self._triangle)
            evidence = float(
                -0.5 * (nis + dof * np.log(2 * np.pi)) + np.log(before).sum() - np.log(after).sum() + log_det_whitening
            )
        return BlockResult(nis, dof, evidence)

    def sweep(
        self,
        H: ArrayLike,
        z: ArrayLike,
        M: ArrayLike | None = None,
        L: ArrayLike | None = None,
        u: ArrayLike | None = None,
        *,
        counts: ArrayLike | None = None,
        coupling_counts: ArrayLike | None = None,
        gate: float | None = None,
        filtered: bool = False,
        evidence: bool = False,
    ) -> SweepResult:
        """Take many epochs at once, as arrays; the first call starts the chain, later ones continue it.

        Parameters
        ----------
        H, z : (N, m, n), (N, m) array
            Observation rows, as in `Chain`.
        M, L, u : (links, q, n), (links, q, n), (links, q) array
            Couplings as in `Chain`: N - 1 in the first call, N later, the first of them from the last epoch to this stretch.
        counts, coupling_counts : integer arrays, optional
            As in `Chain`.
        gate : float, optional
            As in `solve_chain`.
        filtered : bool
            Give the estimate at each epoch.
        evidence : bool
            Give the log-evidence of each epoch.

        Returns
        -------
        SweepResult
            NIS by epoch.

        Raises
        ------
        EstimationError
            Shapes do not fit, a value is not finite, or a link couples nothing.
        """
        lead = 1 if self._epoch >= 0 else 0
        stretch = Chain(H, z, M, L, u, counts=counts, coupling_counts=coupling_counts, lead=lead)
        result = self._take(stretch, gate=gate, filtered=filtered, evidence=evidence)
        return SweepResult(
            result.nis,
            result.dof,
            result.rejected,
            result.coupling_nis,
            result.coupling_dof,
            result.filtered if filtered else None,
            result.log_evidence if evidence else None,
        )

    def estimate(self) -> FilterEstimate:
        """Give the state at the current epoch, x = R^-1 b, and its covariance R^-1 R^-T.

        Returns
        -------
        FilterEstimate
            State and covariance.

        Raises
        ------
        EstimationError
            The rows so far do not determine the state; `determined` asks beforehand.
        """
        if not self.determined:
            missing = np.flatnonzero(np.diagonal(self._triangle) == 0)
            raise EstimationError(
                f"epoch {self._epoch}: component {missing[0]} of the state is not determined by the rows so far; wait for a fix"
            )
        return self.lagged(0)

    def lagged(self, lag: int) -> FilterEstimate:
        """Give the state `lag` epochs back, estimated from all rows so far (fixed-lag smoothing).

        Parameters
        ----------
        lag : int
            Epochs back, at most the lag that the filter keeps and not before the first epoch.

        Returns
        -------
        FilterEstimate
            State and covariance.

        Raises
        ------
        EstimationError
            That epoch is no longer kept or never was, or the rows do not determine it.
        """
        if not 0 <= lag <= len(self._records):
            raise EstimationError(f"lag {lag} is not kept; {len(self._records)} epochs back are")
        n = self.n
        records = np.array(list(self._records)[len(self._records) - lag :]).reshape(lag, packed_size(n))
        state = np.empty((lag + 1, n))
        empty = _chain_kernels.smooth_chain_kernel(compiled_size(n))(records, self._triangle, state)
        if empty >= 0:
            raise EstimationError(
                f"epoch {self._epoch - lag}: the state is not determined by the rows so far; wait for a fix"
            )
        P = np.empty((lag + 1, n, n))
        _chain_kernels.covariance_chain_kernel(compiled_size(n))(records, self._triangle, P, np.empty((0, n, n)))
        return FilterEstimate(self._epoch - lag, state[0], P[0])

    def _take(
        self, stretch: Chain, *, gate: float | None = None, filtered: bool = False, evidence: bool = False
    ) -> Sweep:
        """Sweep a stretch; if that fails, the filter is as it was."""
        if stretch.n != self.n:
            raise EstimationError(f"the rows have {stretch.n} coefficients; the filter's states have {self.n}")
        lag = self._records.maxlen or 0
        triangle = self._triangle.copy()
        result = sweep_chain(stretch, triangle, store=lag > 0, filtered=filtered, gate=gate, evidence=evidence)
        if not np.isfinite(triangle).all():
            raise EstimationError(stretch.blame())
        first = max(self._epoch, 0)
        if result.broken >= 0:
            raise EstimationError(
                f"the link from epoch {first + result.broken} couples nothing; start a new filter there"
            )
        self._triangle = triangle
        self._epoch = (first if stretch.lead else self._epoch) + len(stretch)
        self._records.extend(result.records[-lag:].copy() if lag else ())
        return result
