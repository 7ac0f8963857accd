"""Chains driven by fewer noises than the state has numbers: x+ = F x + g + G w, w ~ N(0, I), rank G < n.

Q = G G^T has no inverse, so there are no coupling rows W (x+ - F x - g). The noises themselves are kept as unknowns instead, r of
them a step, and eliminated together with the old state, which F^-1 gives back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation import _bordered_kernels, _row_kernels
from railnav.estimation.bordered import owned
from railnav.estimation.chain import Chain, as_floats, start_triangle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: A transition whose condition number is beyond this cannot be run backwards.
CONDITION_LIMIT = 1e12


@dataclass(frozen=True, slots=True, eq=False)
class DrivenSolution:
    """A driven chain solved.

    Attributes
    ----------
    state, covariance, lag_one : (N, n), (N, n, n), (N - 1, n, n) array
        As in `ChainSolution`.
    noise : (N - 1, r) array
        The noises w, smoothed, in units of their sigma.
    filtered : (N, n) array
        Estimates from the rows up to each epoch; NaN until the rows determine them.
    nis, dof, log_evidence : (N,) array
        As in `ChainSolution`.
    records : (N - 1, r, r + n + 1) array
        [R_w R_wx | d_w].
    triangle : (n, n + 1) array
        [R | b] of the last epoch.
    """

    state: FloatArray
    covariance: FloatArray
    lag_one: FloatArray
    noise: FloatArray
    filtered: FloatArray
    nis: FloatArray
    dof: IntArray
    log_evidence: FloatArray
    records: FloatArray
    triangle: FloatArray

    @property
    def sum_of_squares(self) -> float:
        """v^T v, the noises' squares included."""
        return float(self.nis.sum())

    @property
    def redundancy(self) -> int:
        """Rows less unknowns."""
        return int(self.dof.sum())


def solve_driven_chain(
    H: ArrayLike,
    z: ArrayLike,
    F: ArrayLike,
    G: ArrayLike,
    *,
    g: ArrayLike | None = None,
    counts: ArrayLike | None = None,
    prior: tuple[ArrayLike, ArrayLike] | None = None,
) -> DrivenSolution:
    """Estimate a chain whose process noise is singular.

    Rows w = 0 and R F^-1 (x+ - g - G w) = b are reduced over (w | x+); the record R_w w + R_wx x+ = d_w gives w and then x back:
    w = R_w^-1 (d_w - R_wx x+), x = F^-1 (x+ - g - G w), P = T P+ T^T + E E^T with E = F^-1 G R_w^-1,
    T = F^-1 (I + G R_w^-1 R_wx).

    Parameters
    ----------
    H, z, counts, prior
        Whitened observation rows and prior rows, as in `Chain`.
    F : (N - 1, n, n) or (n, n) array
        Transition matrices; each must have an inverse.
    G : (N - 1, n, r) or (n, r) array
        Roots of the process noise, Q = G G^T; r may be anything from 1, also above n.
    g : (N - 1, n) or (n,) array, optional
        Known steps; zero by default.

    Returns
    -------
    DrivenSolution
        States, noises, covariances.

    Raises
    ------
    EstimationError
        Shapes do not fit, a value is not finite, a transition has no inverse, or the state is not determined by the rows.

    Notes
    -----
    Steps that shrink the state (F far from orthogonal) lose digits backwards by their condition number.

    References
    ----------
    Specification rail 15.5.

    Examples
    --------
    Constant velocity, noise on the velocity alone:

    >>> solution = solve_driven_chain([[1.0, 0.0]], [[0.0], [1.0], [2.0]], [[1.0, 1.0], [0.0, 1.0]], [[0.0], [0.1]])
    >>> solution.state[:, 1].round(9)
    array([1., 1., 1.])
    """
    right = as_floats("z", z)
    if right.ndim != 2 or len(right) == 0:
        raise EstimationError(f"z has shape {right.shape}; a chain needs (N, m) with at least one epoch")
    N = len(right)
    links = N - 1
    transition = _steps("F", F, links, 3)
    n = transition.shape[1]
    driving = _steps("G", G, links, 3)
    if transition.shape[2] != n or driving.shape[1] != n or driving.shape[2] == 0:
        raise EstimationError(
            f"F has shape {np.shape(F)} and G {np.shape(G)}; (n, n) and (n, r) with r >= 1 fit each other"
        )
    known = np.zeros((1, n)) if g is None else _steps("g", g, links, 2)
    if known.shape[1] != n:
        raise EstimationError(f"g has shape {known.shape}; ({links}, {n}) fits F")
    rows = as_floats("H", H)
    if rows.shape[-1] != n:
        raise EstimationError(f"H has shape {rows.shape}; the state that F carries has {n} numbers")
    for name, value in (("F", transition), ("G", driving), ("g", known)):
        for k in np.flatnonzero(~np.isfinite(value.reshape(len(value), -1)).all(axis=1))[:1]:
            raise EstimationError(f"{name} is not finite at step {k}")
    none = np.zeros((0, n))  # the rows are checked as those of a chain that nothing links
    chain = Chain(rows, right, none, none, np.zeros(0), counts=counts, prior=prior)
    condition = np.linalg.cond(transition)
    for k in np.flatnonzero(~(condition < CONDITION_LIMIT))[:1]:
        raise EstimationError(
            f"the transition of step {k} has no inverse (condition number {condition[k]:.2g}); "
            "give noise to the lost directions and use coupling rows (Chain)"
        )
    inverse = np.ascontiguousarray(np.linalg.inv(transition))
    r = driving.shape[2]
    triangle = start_triangle(chain.prior, n)
    records, filtered = np.empty((links, r, r + n + 1)), np.empty((N, n))
    nis, dof, growth = np.empty(N), np.empty(N, np.int64), np.empty(N)
    _bordered_kernels.driven_forward_kernel(
        owned(chain.H),
        owned(chain.z),
        owned(chain.counts),
        inverse,
        known,
        driving,
        triangle,
        records,
        nis,
        dof,
        filtered,
        growth,
    )
    if not np.isfinite(triangle).all():
        raise EstimationError(chain.blame())
    for i in np.flatnonzero(np.diagonal(triangle) == 0)[:1]:
        raise EstimationError(
            f"component {i} of the last state is not determined by the rows; add observations or a prior"
        )
    root = np.zeros((n, n))
    _row_kernels.invert_upper_kernel(triangle, root)
    state, P, C, noise = np.empty((N, n)), np.empty((N, n, n)), np.empty((links, n, n)), np.empty((links, r))
    state[-1], P[-1] = root @ triangle[:, n], root @ root.T
    _bordered_kernels.driven_backward_kernel(inverse, known, driving, records, state, noise, P, C)
    return DrivenSolution(
        state=state,
        covariance=P,
        lag_one=C,
        noise=noise,
        filtered=filtered,
        nis=nis,
        dof=dof,
        log_evidence=growth - 0.5 * (nis + dof * np.log(2 * np.pi)),
        records=records,
        triangle=triangle,
    )


def _steps(name: str, value: ArrayLike, links: int, dimensions: int) -> FloatArray:
    out = as_floats(name, value)
    out = out[np.newaxis] if out.ndim == dimensions - 1 else out
    if out.ndim != dimensions or len(out) not in (1, links):
        raise EstimationError(
            f"{name} has shape {np.shape(value)}; one for each of {links} steps, or one for all, fits"
        )
    return owned(out)
