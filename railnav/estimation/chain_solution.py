"""A chain solved: states, covariances, residuals, and the records that hold all of its data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class ChainSolution:
    """A chain solved.

    Attributes
    ----------
    state : (N, n) array
        Smoothed states: each estimated from all rows. The last one is the filter's estimate.
    covariance : (N, n, n) array or None
        Their covariances P_k.
    lag_one : (N - 1, n, n) array or None
        C_k = cov(x_k, x_(k+1)).
    filtered : (N, n) array or None
        Estimates from the rows up to each epoch; NaN until the rows determine them (`first_determined`).
    nis, dof : (N,) array
        Sum of squared residuals and number of redundant rows of each epoch's observations: nu^T S^-1 nu of the innovation,
        chi-square with ``dof`` degrees of freedom if the model holds.
    log_evidence : (N,) array or None
        ln p(z_k | all rows before), but for ln |det W_k| of the whitening, which must be added where hypotheses differ in it;
        NaN while the rows before do not determine the state (rail 15.4).
    rejected : (N,) bool array
        Epochs whose observations failed the gate and were left out (`nis` still says by how much).
    coupling_nis, coupling_dof : (N - 1,) array
        The same for coupling rows beyond those that carry the state on.
    packed : (N - 1, n (3n + 3) / 2) array
        [R_kk R_kn | d_k]: whitened rows that hold all the past knows of x_k given x_(k+1), by rows, without the zeros left of the
        diagonal (144 bytes a node for n = 3, rail 15.7); (0, ...) if not kept.
    triangle : (n, n + 1) array
        [R | b] of the last epoch.
    """

    state: FloatArray
    covariance: FloatArray | None
    lag_one: FloatArray | None
    filtered: FloatArray | None
    nis: FloatArray
    dof: IntArray
    log_evidence: FloatArray | None
    rejected: BoolArray
    coupling_nis: FloatArray
    coupling_dof: IntArray
    packed: FloatArray
    triangle: FloatArray

    @property
    def records(self) -> FloatArray:
        """The same rows unpacked, (N - 1, n, 2n + 1): a new array each time."""
        return unpacked(self.packed, self.state.shape[1])

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the states (N, n), for unit weight 1.

        Raises
        ------
        EstimationError
            The chain was solved without covariances.
        """
        if self.covariance is None:
            raise EstimationError(
                "the chain was solved without covariances; solve_chain(..., covariance=True) gives them"
            )
        return np.asarray(np.sqrt(np.einsum("kii->ki", self.covariance)))

    @property
    def sum_of_squares(self) -> float:
        """v^T v, the minimum that the estimate attains, over the rows that were used."""
        return float(self.nis[~self.rejected].sum() + self.coupling_nis.sum())

    @property
    def redundancy(self) -> int:
        """Number of redundant rows that were used: rows less unknowns."""
        return int(self.dof[~self.rejected].sum() + self.coupling_dof.sum())

    @property
    def unit_weight_rms(self) -> float:
        """Unit-weight RMS mu = sqrt(v^T v / redundancy): 1 if the stated covariances are honest (rail 5, step 8).

        Raises
        ------
        EstimationError
            There are no redundant rows, so nothing can be said.
        """
        if self.redundancy == 0:
            raise EstimationError("no row is redundant: the chain cannot tell how well it fits")
        return float(np.sqrt(self.sum_of_squares / self.redundancy))

    @property
    def first_determined(self) -> int:
        """First epoch whose filtered estimate exists.

        Raises
        ------
        EstimationError
            The chain was solved without filtered estimates.
        """
        if self.filtered is None:
            raise EstimationError("the chain was solved without filtered estimates; solve_chain(..., filtered=True)")
        return int(np.argmax(np.isfinite(self.filtered).all(axis=1)))

    def cross_covariance(self, i: int, j: int) -> FloatArray:
        """Covariance of two states, cov(x_i, x_j) = G_i ... G_(j-1) P_j for i <= j (rail 15.3).

        Parameters
        ----------
        i, j : int
            Epochs, 0 <= i <= j < N.

        Returns
        -------
        (n, n) array
            Covariance of x_i (rows) with x_j (columns).

        Raises
        ------
        EstimationError
            The epochs are not in order or not there, or the chain was solved without covariances.
        """
        if self.covariance is None:
            raise EstimationError(
                "the chain was solved without covariances; solve_chain(..., covariance=True) gives them"
            )
        if not len(self.packed) and i < j:
            raise EstimationError("the chain was solved without records; solve_chain(..., records=True) keeps them")
        if not 0 <= i <= j < len(self.state):
            raise EstimationError(f"epochs {i} and {j} are not 0 <= i <= j < {len(self.state)}")
        n = self.state.shape[1]
        out: FloatArray = self.covariance[j]
        for rows in unpacked(self.packed[i:j], n)[::-1]:
            out = np.asarray(-np.linalg.solve(rows[:, :n], rows[:, n : 2 * n] @ out), np.float64)
        return out


def fixed_lag(solution: ChainSolution, lag: int) -> FloatArray:
    """Give each state as estimated from the rows up to `lag` epochs later, x_(k-lag | k) (rail 15.3).

    Records are final: only the starting vector x_(k|k) of the substitution changes from epoch to epoch.

    Parameters
    ----------
    solution : ChainSolution
        Solved with ``filtered=True``.
    lag : int
        Epochs to look ahead, at least 0.

    Returns
    -------
    (N - lag, n) array
        x_(i | i + lag) for i = 0 ... N - lag - 1; NaN where the rows up to i + lag do not determine the state.

    Raises
    ------
    EstimationError
        The lag is negative or not shorter than the chain, or the chain was solved without filtered estimates.

    Notes
    -----
    Work is O(lag n^2) per epoch. Live, and with covariances, `ChainFilter.lagged` gives the same.

    Examples
    --------
    >>> from railnav.estimation import Chain, solve_chain
    >>> chain = Chain(np.ones((1, 1)), [[0.0], [1.1], [1.9]], [[-1.0]], [[1.0]], [[1.0], [1.0]])
    >>> fixed_lag(solve_chain(chain, filtered=True), 2).ravel()
    array([0.0125])
    """
    if solution.filtered is None:
        raise EstimationError("the chain was solved without filtered estimates; solve_chain(..., filtered=True)")
    N, n = solution.state.shape
    if not 0 <= lag < N:
        raise EstimationError(f"lag {lag} is not within 0 to {N - 1}, the epochs of the chain")
    if lag and len(solution.packed) < N - 1:
        raise EstimationError("the chain was solved without records; solve_chain(..., records=True) keeps them")
    out = solution.filtered[lag:].copy()
    good = np.isfinite(out).all(axis=1)
    every = solution.records if lag else np.zeros((0, 0, 0))
    for back in range(1, lag + 1):
        records = every[lag - back : N - back]
        # an empty pivot before the state is determined: that estimate does not exist
        good &= (np.einsum("kii->ki", records[:, :, :n]) != 0).all(axis=1)
        R = np.where(good[:, None, None], records[:, :, :n], np.eye(n))
        right = records[:, :, 2 * n] - np.einsum(
            "kij,kj->ki", records[:, :, n : 2 * n], np.where(good[:, None], out, 0.0)
        )
        out = np.asarray(np.linalg.solve(R, right[:, :, None])[:, :, 0])
    out[~good] = np.nan
    return out


def packed_size(n: int) -> int:
    """Numbers in one packed record: rows [R_kk R_kn | d_k] without the zeros left of the diagonal; inside this room only."""
    return n * (2 * n + 1) - n * (n - 1) // 2


def _places(n: int) -> tuple[IntArray, IntArray]:
    row, column = np.nonzero(np.arange(2 * n + 1) >= np.arange(n)[:, None])
    return row, column


def unpacked(packed: FloatArray, n: int) -> FloatArray:
    """Records (N - 1, n, 2n + 1) of packed ones; inside this room only."""
    out = np.zeros((len(packed), n, 2 * n + 1))
    row, column = _places(n)
    out[:, row, column] = packed
    return out


def packed_records(records: FloatArray) -> FloatArray:
    """Packed records of (N - 1, n, 2n + 1) ones, whose R_kk are upper triangular; inside this room only."""
    row, column = _places(records.shape[1])
    return np.ascontiguousarray(records[:, row, column])
