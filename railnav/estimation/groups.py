"""Least squares in groups of unknowns: each group is projected off the ones before it, and the last is found first.

The rows are whitened. v = A x - l, as in the source. Projectors are kept as orthonormal bases, P_i = Q_i Q_i^T, m x r_i numbers
instead of m x m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation.chain import as_floats

FloatArray = NDArray[np.float64]

#: A direction of a group this small, against its own columns, after projection: it lies in the groups before (or in the group).
RANK_TOLERANCE = 1e-12
#: Longest right-hand side for which `GroupSolution.projector` writes out an m x m matrix.
PROJECTOR_LIMIT = 500


@dataclass(frozen=True, slots=True, eq=False)
class GroupSolution:
    """A group least-squares problem solved.

    Attributes
    ----------
    x : tuple of (n_i,) array
        The unknowns of each group.
    v : (m,) array
        Residuals A x - l.
    bases : tuple of (m, r_i) array
        Orthonormal bases Q_i of what each group adds to the ones before, P_i = Q_i Q_i^T.
    triangle : tuple of tuples of array
        Quasi-triangular form: ``triangle[i][j - i]`` is Q_i^T A_j, j >= i, and row i reads sum_j Q_i^T A_j x_j = Q_i^T l.
    pseudo_inverse : tuple of (n_i, r_i) array
        Pseudo-inverses of the diagonal blocks Q_i^T A_i.
    """

    x: tuple[FloatArray, ...]
    v: FloatArray
    bases: tuple[FloatArray, ...]
    triangle: tuple[tuple[FloatArray, ...], ...]
    pseudo_inverse: tuple[FloatArray, ...]

    @property
    def ranks(self) -> tuple[int, ...]:
        """Rank r_i that each group adds; below n_i the group is deficient and its x_i is not the only one."""
        return tuple(basis.shape[1] for basis in self.bases)

    @property
    def sum_of_squares(self) -> float:
        """v^T v."""
        return float(self.v @ self.v)

    @property
    def redundancy(self) -> int:
        """Rows less the rank of all groups together."""
        return len(self.v) - sum(self.ranks)

    def project(self, group: int, vector: ArrayLike) -> FloatArray:
        """Apply P_i to a vector or to columns, without writing P_i out.

        Parameters
        ----------
        group : int
            i, from 0.
        vector : (m,) or (m, k) array
            What is projected.

        Returns
        -------
        array
            P_i vector.
        """
        basis = self.bases[group]
        return np.asarray(basis @ (basis.T @ np.asarray(vector, np.float64)))

    def remove(self, groups: int, vector: ArrayLike) -> FloatArray:
        """Project a vector off the first groups, Q vector with Q = I - sum_(j < groups) P_j (equation 10).

        Parameters
        ----------
        groups : int
            How many groups; all of them leave -v of the right-hand side (equation 7).
        vector : (m,) or (m, k) array
            What is projected.

        Returns
        -------
        array
            The rest.
        """
        out = np.array(vector, np.float64)
        for basis in self.bases[:groups]:
            out -= basis @ (basis.T @ out)
        return out

    def projector(self, group: int) -> FloatArray:
        """Write P_i out, (m, m), for study and small m.

        Parameters
        ----------
        group : int
            i, from 0.

        Returns
        -------
        (m, m) array
            P_i = Q_i Q_i^T.

        Raises
        ------
        EstimationError
            m is above 500; `project` applies it at any size.
        """
        if len(self.v) > PROJECTOR_LIMIT:
            raise EstimationError(
                f"a projector of {len(self.v)} x {len(self.v)} is not written out; project() applies it"
            )
        return np.asarray(self.bases[group] @ self.bases[group].T)

    def weighted_pseudo_inverse(self, group: int) -> FloatArray:
        """Pseudo-inverse of a group weighted by the projector before it, A_i+_Q = (A_i^T Q A_i)^- A_i^T Q (equations 3, 12).

        Parameters
        ----------
        group : int
            i, from 0.

        Returns
        -------
        (n_i, m) array
            A_i+_Q. With it (A_i^T Q A_i)^- = A_i+_Q Q (A_i+_Q)^T, and A_i A_i+_Q is the oblique projector of equation (13).
        """
        return np.asarray(self.pseudo_inverse[group] @ self.bases[group].T)


def group_least_squares(blocks: Sequence[ArrayLike], l: ArrayLike) -> GroupSolution:  # noqa: E741 - the source's letter
    """Minimise |A_1 x_1 + ... + A_K x_K - l| group by group, by successive orthogonal projection.

    A_i^(i-1) = A_i - sum_(j<i) P_j A_i is reduced by QR, P_i = P_R(A_i^(i-1)); the quasi-triangular system that is left is solved
    from the last group back. Two groups: x_2 = A_2+_P l with P = I - P_R(A_1), x_1 = A_1+ (l - A_2 x_2).

    Parameters
    ----------
    blocks : sequence of (m, n_i) array
        Whitened coefficients of each group.
    l : (m,) array
        Whitened right-hand side.

    Returns
    -------
    GroupSolution
        Unknowns by group, residuals, bases of the projectors.

    Raises
    ------
    EstimationError
        There is no group, shapes do not fit, or a value is not finite.

    Notes
    -----
    Work is 2 m n^2, as for one QR of all columns; each block is projected twice, so that bases stay orthogonal to rounding even
    if a group nearly lies in the ones before. A group whose columns depend on each other or on earlier groups (within 1e-12 of
    the columns) is allowed: fitted values and v are exact, x_i is the shortest that its row of the quasi-triangular system
    allows; **the whole x is then not the shortest of all minimisers**. `GroupSolution.ranks` shows it.

    References
    ----------
    Specification rail 3, equations (1)-(13) with Theorem 1 corrected: (12) and (13) hold with the weighted pseudo-inverse.

    Examples
    --------
    >>> solution = group_least_squares([[[1, 0], [1, 1], [1, 2], [1, 3]], [[0], [1], [4], [9]]], [1, 3, 2, 5])
    >>> solution.x[1].round(12), solution.x[0].round(12), solution.v.round(12)
    (array([0.25]), array([1.35, 0.35]), array([ 0.35, -1.05,  1.05, -0.35]))
    """
    right = as_floats("l", l)
    A = [as_floats(f"blocks[{i}]", block) for i, block in enumerate(blocks)]
    if not A or right.ndim != 1:
        raise EstimationError(f"{len(A)} groups and l of shape {right.shape}; at least one group and (m,) fit")
    m = len(right)
    for i, block in enumerate(A):
        if block.ndim != 2 or len(block) != m or block.shape[1] == 0:
            raise EstimationError(f"blocks[{i}] has shape {block.shape}; ({m}, n) with n >= 1 fits l")
        for row in np.flatnonzero(~np.isfinite(block).all(axis=1))[:1]:
            raise EstimationError(f"blocks[{i}] is not finite in row {row}; leave that row out of all blocks and of l")
    for row in np.flatnonzero(~np.isfinite(right))[:1]:
        raise EstimationError(f"l is not finite in row {row}; leave that row out of all blocks and of l")
    bases: list[FloatArray] = []
    inverses: list[FloatArray] = []
    for block in A:
        basis, inverse = _reduce(block, bases)
        bases.append(basis)
        inverses.append(inverse)
    triangle = tuple(tuple(np.asarray(basis.T @ A[j]) for j in range(i, len(A))) for i, basis in enumerate(bases))
    rest = right.copy()  # l^(i) = l^(i-1) - P_i l^(i-1), eq. 9
    reduced = []
    for basis in bases:
        c = basis.T @ rest
        rest -= basis @ c
        reduced.append(c)
    x: list[FloatArray] = [np.empty(0)] * len(A)
    for i in range(len(A) - 1, -1, -1):
        known = reduced[i].copy()
        for j in range(i + 1, len(A)):
            known -= triangle[i][j - i] @ x[j]
        x[i] = np.asarray(inverses[i] @ known)
    for basis in bases:  # what rounding left in the columns
        rest -= basis @ (basis.T @ rest)
    return GroupSolution(tuple(x), -rest, tuple(bases), triangle, tuple(inverses))


def _reduce(block: FloatArray, bases: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Orthonormal basis of a block projected off earlier bases, and the pseudo-inverse of basis^T block."""
    rest = block.copy()
    for _ in range(2):
        for basis in bases:
            rest -= basis @ (basis.T @ rest)
    norm = np.linalg.norm(block, axis=0)
    scale = np.where(norm > 0, norm, 1.0)
    Q, R = np.linalg.qr(rest)
    U, s, _ = np.linalg.svd(R / scale)
    rank = int((s > RANK_TOLERANCE).sum())
    n = block.shape[1]
    if rank < n:  # the shortest x_i: units of the columns count, as in the source's pseudo-inverse
        U = np.linalg.svd(R)[0]
        Q = np.ascontiguousarray(Q @ U[:, :rank])
        for _ in range(2 if rank else 0):  # a weak direction is known less well than a strong one
            for basis in bases:
                Q -= basis @ (basis.T @ Q)
            Q = np.linalg.qr(Q)[0]
        return Q, np.asarray(np.linalg.pinv(Q.T @ block, rcond=RANK_TOLERANCE)).reshape(n, rank)
    for basis in bases:
        Q -= basis @ (basis.T @ Q)
    Q = np.linalg.qr(Q)[0]
    return Q, np.asarray(np.linalg.solve((Q.T @ block) / scale, np.eye(n)) / scale[:, None])
