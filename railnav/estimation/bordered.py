"""Chains whose rows also hold constants: odometer scale, lever arm, the bias of a run. They are carried as a border.

Rows read H_k x_k + H'_k theta = z_k and M_k x_k + L_k x_(k+1) + M'_k theta = u_k. The p columns of theta go along through every
array; what the redundant rows say of theta gathers in the last p x p triangle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation import _bordered_kernels, _row_kernels
from railnav.estimation.chain import Chain, as_floats, prior_rows, start_triangle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, slots=True, eq=False)
class BorderedSolution:
    """A chain with constants solved.

    Attributes
    ----------
    state, covariance, lag_one : (N, n), (N, n, n), (N - 1, n, n) array
        As in `ChainSolution`; the uncertainty of the constants is in them.
    border, border_covariance : (p,), (p, p) array
        The constants theta and their covariance.
    cross : (N, n, p) array
        cov(x_k, theta).
    nis, dof, log_evidence, coupling_nis, coupling_dof : array
        As in `ChainSolution`.
    records : (N - 1, n, 2n + p + 1) array
        [R_kk R_kn R_kt | d_k].
    triangle : (n + p, n + p + 1) array
        [R | b] of the last state and the constants.
    """

    state: FloatArray
    covariance: FloatArray
    lag_one: FloatArray
    border: FloatArray
    border_covariance: FloatArray
    cross: FloatArray
    nis: FloatArray
    dof: IntArray
    log_evidence: FloatArray
    coupling_nis: FloatArray
    coupling_dof: IntArray
    records: FloatArray
    triangle: FloatArray

    @property
    def border_sigma(self) -> FloatArray:
        """Standard deviations of the constants (p,)."""
        return np.asarray(np.sqrt(np.diagonal(self.border_covariance)))

    @property
    def sum_of_squares(self) -> float:
        """v^T v."""
        return float(self.nis.sum() + self.coupling_nis.sum())

    @property
    def redundancy(self) -> int:
        """Rows less unknowns."""
        return int(self.dof.sum() + self.coupling_dof.sum())


def solve_bordered_chain(
    chain: Chain,
    H_border: ArrayLike,
    M_border: ArrayLike,
    *,
    border_prior: tuple[ArrayLike, ArrayLike] | None = None,
    allow_breaks: bool = False,
) -> BorderedSolution:
    """Estimate the states of a chain together with constants that its rows hold.

    Parameters
    ----------
    chain : Chain
        The rows' coefficients of the states and their right-hand sides.
    H_border : (N, m, p) or (m, p) array
        Whitened coefficients of theta in the observation rows.
    M_border : (N - 1, q, p) or (q, p) array
        Whitened coefficients of theta in the coupling rows.
    border_prior : ((r, p) array, (r,) array), optional
        Whitened rows on theta alone.
    allow_breaks : bool
        Accept a link that couples no states, as long as the rows determine all.

    Returns
    -------
    BorderedSolution
        States, constants, covariances.

    Raises
    ------
    EstimationError
        Shapes do not fit, a row is not finite, a link is broken, or a state or constant is not determined; the message names it.

    Notes
    -----
    Costs O(n^2 p + n p^2) per epoch more than the plain chain; memory of the sweep does not grow with N, records do.

    References
    ----------
    Specification rail 15.6.

    Examples
    --------
    An odometer that reads 1 % long, two fixes 100 m apart:

    >>> chain = Chain([[1.0]], [[0.0], [100.0]], [[-1.0]], [[1.0]], [[101.0]])
    >>> solution = solve_bordered_chain(chain, [[0.0]], [[101.0]])
    >>> round(float(solution.border[0]), 6), solution.state.ravel().round(6)
    (0.009901, array([  0., 100.]))
    """
    if chain.lead:
        raise EstimationError("a stretch that continues a chain (lead = 1) has no border")
    N, n, m, q = len(chain), chain.n, chain.z.shape[1], chain.u.shape[1]
    near = _border("H_border", H_border, N, m, None)
    p = near.shape[2]
    link = _border("M_border", M_border, N - 1, q, p) if N > 1 else np.zeros((0, 0, p))
    triangle = np.zeros((n + p, n + p + 1))
    start = start_triangle(chain.prior, n)
    triangle[:n, :n], triangle[:n, n + p] = start[:, :n], start[:, n]
    if border_prior is not None:
        start = start_triangle(prior_rows(border_prior, p), p)
        triangle[n:, n : n + p], triangle[n:, n + p] = start[:, :p], start[:, p]
    records = np.empty((N - 1, n, 2 * n + p + 1))
    nis, dof, growth = np.empty(N), np.empty(N, np.int64), np.empty(N)
    link_nis, link_dof = np.empty(N - 1), np.empty(N - 1, np.int64)
    broken = _bordered_kernels.bordered_forward_kernel(
        owned(chain.H), near, owned(chain.z), owned(chain.counts), owned(chain.M), owned(chain.L), link, owned(chain.u),
        owned(chain.coupling_counts), triangle, records, nis, dof, link_nis, link_dof, growth,
    )  # fmt: skip
    if not np.isfinite(triangle).all():
        for name, rows, counts, what in (
            ("H_border", near, chain.counts, "epoch"),
            ("M_border", link, chain.coupling_counts, "coupling"),
        ):
            used = np.arange(rows.shape[1]) < (counts[:, None] if len(rows) > 1 else counts.max(initial=0))
            for k, row in np.argwhere(~np.isfinite(rows.sum(axis=2)) & used)[:1]:
                raise EstimationError(f"{name} is not finite at {what} {k}, row {row}; leave that row out by its count")
        raise EstimationError(chain.blame())
    if broken >= 0 and not allow_breaks:
        raise EstimationError(
            f"the link between epochs {broken} and {broken + 1} couples no states; "
            "solve the two parts as chains of their own, or allow_breaks=True"
        )
    for i in np.flatnonzero(np.diagonal(triangle)[n:] == 0)[:1]:
        raise EstimationError(f"constant {i} is not determined by the rows; give a border_prior, or leave it out")
    for i in np.flatnonzero(np.diagonal(triangle)[:n] == 0)[:1]:
        raise EstimationError(
            f"epoch {N - 1}: component {i} of the state is not determined by the rows; add observations"
        )
    root = np.zeros((n + p, n + p))
    _row_kernels.invert_upper_kernel(triangle, root)
    last, joint = root @ triangle[:, n + p], root @ root.T
    state, P, C = np.empty((N, n)), np.empty((N, n, n)), np.empty((N - 1, n, n))
    cross = np.empty((N, n, p))
    state[-1], P[-1], cross[-1] = last[:n], joint[:n, :n], joint[:n, n:]
    theta, T = np.ascontiguousarray(last[n:]), np.ascontiguousarray(joint[n:, n:])
    empty = _bordered_kernels.bordered_backward_kernel(records, state, theta, P, C, cross, T)
    if empty >= 0:
        epoch, i = divmod(empty, n)
        raise EstimationError(
            f"epoch {epoch}: component {i} of the state is not determined by the rows; add observations"
        )
    return BorderedSolution(
        state=state,
        covariance=P,
        lag_one=C,
        border=theta,
        border_covariance=T,
        cross=cross,
        nis=nis,
        dof=dof,
        log_evidence=growth - 0.5 * (nis + dof * np.log(2 * np.pi)),
        coupling_nis=link_nis,
        coupling_dof=link_dof,
        records=records,
        triangle=triangle,
    )


def owned(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Contiguous and writable, so that a kernel compiles once; inside this room only."""
    return np.require(array, requirements=["C", "W"])


def _border(name: str, value: ArrayLike, length: int, rows: int, p: int | None) -> FloatArray:
    out = as_floats(name, value)
    out = out[np.newaxis] if out.ndim == 2 else out
    if out.ndim != 3 or out.shape[1] != rows or len(out) not in (1, length) or p not in (None, out.shape[2]):
        raise EstimationError(
            f"{name} has shape {np.shape(value)}; ({length}, {rows}, {'p' if p is None else p}) fits the chain"
        )
    if out.shape[2] == 0:
        raise EstimationError(f"{name} holds no constants; solve_chain is for chains without")
    return owned(out)
