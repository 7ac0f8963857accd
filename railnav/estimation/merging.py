"""Merging: what a solved chain knows is kept as rows, and enters the next chain as rows. No old data are needed.

The records [R_kk R_kn | d_k] of a chain and its last triangle are whitened rows that hold all of its data. Beside the rows of a new
run they are swept again; the result is that of all runs at once. States must be corrections to the same nominal values:
`ChainRecords.shifted` carries records over to others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation import _chain_kernels
from railnav.estimation.chain import Chain, as_floats, compiled_size, start_triangle, sweep_chain
from railnav.estimation.chain_solution import ChainSolution, packed_records, unpacked
from railnav.estimation.square_root import inverse_root

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False, init=False)
class ChainRecords:
    """All that a chain knows, as whitened rows: to be stored, aged and merged.

    Parameters
    ----------
    records : (N - 1, n, 2n + 1) array
        [R_kk R_kn | d_k], as in `ChainSolution`.
    triangle : (n, n + 1) array
        [R | b] of the last node.

    Raises
    ------
    EstimationError
        Shapes do not fit, or a value is not finite.

    Examples
    --------
    >>> from railnav.estimation import Chain, solve_chain
    >>> solution = solve_chain(Chain([[1.0]], [[0.0], [1.1], [1.9]], [[-1.0]], [[1.0]], [[1.0], [1.0]]))
    >>> stored = ChainRecords(solution.records, solution.triangle)
    >>> len(stored), stored.solve().state.ravel()
    (3, array([0.0125, 1.025 , 1.9625]))
    """

    records: FloatArray
    triangle: FloatArray

    def __init__(self, records: ArrayLike, triangle: ArrayLike) -> None:
        rows, last = as_floats("records", records), as_floats("triangle", triangle)
        n = len(last)
        if last.shape != (n, n + 1) or n == 0 or rows.ndim != 3 or rows.shape[1:] != (n, 2 * n + 1):
            raise EstimationError(
                f"records have shape {rows.shape} and the triangle {last.shape}; (N - 1, n, 2n + 1) and (n, n + 1) fit"
            )
        for k in np.flatnonzero(~np.isfinite(rows).all(axis=(1, 2)))[:1]:
            raise EstimationError(f"record {k} is not finite")
        if not np.isfinite(last).all():
            raise EstimationError("the last triangle is not finite")
        object.__setattr__(self, "records", rows)
        object.__setattr__(self, "triangle", last)

    def __len__(self) -> int:
        return len(self.records) + 1

    @property
    def n(self) -> int:
        """Numbers in one state."""
        return len(self.triangle)

    @classmethod
    def of(cls, solution: ChainSolution) -> ChainRecords:
        """Keep what a solved chain knows.

        Parameters
        ----------
        solution : ChainSolution
            The chain.

        Returns
        -------
        ChainRecords
            Its rows.

        Raises
        ------
        EstimationError
            The chain was solved without keeping its records.
        """
        if len(solution.packed) < len(solution.state) - 1:
            raise EstimationError("the chain was solved without records; solve_chain(..., records=True) keeps them")
        return cls(solution.records, solution.triangle)

    @classmethod
    def of_marginals(
        cls, state: ArrayLike, covariance: ArrayLike, lag_one: ArrayLike, *, components: ArrayLike | None = None
    ) -> ChainRecords:
        """Keep some components of a solution only: the chain that comes nearest to their joint distribution.

        p(x_k | x_(k+1)) is taken from the joint covariance of neighbours: gain G = C_k P_(k+1)^-1, covariance P_k - G C_k^T.
        For what a run brought of its own, drifts or a correlated error, and what need not be stored; also for solutions with a
        border, whose constants are in the covariances.

        Parameters
        ----------
        state, covariance, lag_one : (N, n), (N, n, n), (N - 1, n, n) array
            As in `ChainSolution`.
        components : integer array, optional
            Which of the n to keep; all by default.

        Returns
        -------
        ChainRecords
            Rows with the given means, covariances and covariances of neighbours.

        Raises
        ------
        EstimationError
            Shapes do not fit, or the joint covariance of two neighbours is singular.

        Notes
        -----
        Exact if the kept components are a chain by themselves. Otherwise nodes further apart are taken as dependent through
        their neighbours only: of all chains the one nearest in the sense of Kullback and Leibler. Means, sigmas and neighbours
        stay exact; an error that a run has over its whole length is forgotten with the distance.

        References
        ----------
        Specification rail 23, end of pass.
        """
        x, P, C = as_floats("state", state), as_floats("covariance", covariance), as_floats("lag_one", lag_one)
        if x.ndim != 2 or P.shape != (*x.shape, x.shape[1]) or C.shape != (len(x) - 1, *P.shape[1:]):
            raise EstimationError(f"state {x.shape}, covariance {P.shape} and lag_one {C.shape} do not fit each other")
        if components is not None:
            kept = np.asarray(components, np.int64)
            x, P, C = x[:, kept], P[:, kept[:, None], kept], C[:, kept[:, None], kept]
        n = x.shape[1]
        # joint of (x_(k+1), x_k), in units of their sigmas: its root gives gain and covariance without a difference
        sigma = np.sqrt(np.einsum("kii->ki", P))
        scale = np.concatenate([sigma[1:], sigma[:-1]], axis=1)
        joint = np.concatenate(
            [
                np.concatenate([P[1:], np.swapaxes(C, 1, 2)], axis=2),
                np.concatenate([C, P[:-1]], axis=2),
            ],
            axis=1,
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            joint = joint / (scale[:, :, None] * scale[:, None, :])
        try:
            root = np.linalg.cholesky(joint) * scale[:, :, None]
        except np.linalg.LinAlgError:
            raise EstimationError(
                "the joint covariance of two neighbouring nodes is singular: they are known to move as one; keep the full records"
            ) from None
        G = np.swapaxes(
            np.linalg.solve(np.swapaxes(root[:, :n, :n], 1, 2), np.swapaxes(root[:, n:, :n], 1, 2)), 1, 2
        )  # B A^-1
        D = root[:, n:, n:]
        W = inverse_root(D @ np.swapaxes(D, 1, 2)) if len(D) else np.zeros((0, n, n))
        step = x[:-1] - np.einsum("kij,kj->ki", G, x[1:])
        records = np.concatenate([W, -W @ G, np.einsum("kij,kj->ki", W, step)[:, :, None]], axis=2)
        last = inverse_root(P[-1])
        return cls(records, np.column_stack([last, last @ x[-1]]))

    def as_chain(self) -> Chain:
        """Give the rows as a chain without observations but at the last node.

        Returns
        -------
        Chain
            To be solved, or swept in reverse.
        """
        return merge_chain(self, _empty_chain(len(self), self.n))

    def solve(self, *, covariance: bool = True) -> ChainSolution:
        """Estimate the states from the stored rows.

        Parameters
        ----------
        covariance : bool
            As in `solve_chain`.

        Returns
        -------
        ChainSolution
            States and covariances as they were when the rows were stored; no NIS, as no row is redundant.

        Raises
        ------
        EstimationError
            A state is not determined by the rows.
        """
        N, n = len(self), self.n
        state = np.empty((N, n))
        packed = packed_records(self.records)
        empty = _chain_kernels.smooth_chain_kernel(compiled_size(n))(packed, self.triangle, state)
        if empty >= 0:
            k, i = divmod(empty, n)
            raise EstimationError(f"node {k}: component {i} of the state is not determined by the stored rows")
        P = C = None
        if covariance:
            P, C = np.empty((N, n, n)), np.empty((N - 1, n, n))
            _chain_kernels.covariance_chain_kernel(compiled_size(n))(packed, self.triangle, P, C)
        return ChainSolution(
            state=state,
            covariance=P,
            lag_one=C,
            filtered=None,
            nis=np.zeros(N),
            dof=np.zeros(N, np.int64),
            log_evidence=None,
            rejected=np.zeros(N, np.bool_),
            coupling_nis=np.zeros(N - 1),
            coupling_dof=np.zeros(N - 1, np.int64),
            packed=packed,
            triangle=self.triangle,
        )

    def aged(self, factor: ArrayLike) -> ChainRecords:
        """Forget: rows are multiplied by sqrt(lambda_k), 0 < lambda_k <= 1.

        With one lambda for all nodes the mean stays and all covariances grow by 1/lambda. To give up some nodes only, take
        `forgotten`.

        Parameters
        ----------
        factor : float or (N,) array
            lambda, of the information and not of its root.

        Returns
        -------
        ChainRecords
            Aged rows.

        Raises
        ------
        EstimationError
            A factor is not within (0, 1].

        References
        ----------
        Specification rail 18, ageing.
        """
        weight = np.asarray(factor, np.float64)
        if weight.shape not in ((), (len(self),)):
            raise EstimationError(
                f"factor has shape {weight.shape}; one number or one for each of {len(self)} nodes fits"
            )
        if not ((weight > 0) & (weight <= 1)).all():
            raise EstimationError("ageing factors are above 0 and at most 1; 1e-8 gives a node up")
        root = np.broadcast_to(np.sqrt(weight), (len(self),))
        return ChainRecords(self.records * root[:-1, None, None], self.triangle * root[-1])

    def forgotten(self, nodes: ArrayLike, *, factor: float = 1e-8) -> ChainRecords:
        """Give up what is known of some nodes, and keep all that is known of the others (local forgetting).

        Rows of the given nodes are aged by `factor`; the node before each stretch of them gets its own marginal instead of the
        row that ties it to the stretch. Ageing those rows alone would also lose what all earlier data say of the nodes just
        before: in a forward sweep that has already been carried across.

        Parameters
        ----------
        nodes : (N,) bool array
            Where the track was moved, `ChangeTest.nodes`.
        factor : float
            lambda that is left of their information; above 0, so that the stored chain stays solvable.

        Returns
        -------
        ChainRecords
            The joint distribution of the nodes on either side of a stretch is kept; the two sides no longer depend on each other.

        Raises
        ------
        EstimationError
            Shapes do not fit, the factor is not within (0, 1], or the stored rows do not determine the states.

        References
        ----------
        Specification rail 18, change detection; the marginal before a stretch is ours.
        """
        given_up = np.asarray(nodes)
        N, n = len(self), self.n
        if given_up.shape != (N,) or given_up.dtype != np.bool_:
            raise EstimationError(f"nodes have shape {given_up.shape} and type {given_up.dtype}; ({N},) booleans fit")
        out = self.aged(np.where(given_up, factor, 1.0))
        before = np.flatnonzero(~given_up[:-1] & given_up[1:])
        if len(before) == 0:
            return out
        solution = self.solve()
        assert solution.covariance is not None
        W = inverse_root(solution.covariance[before])
        out.records[before] = 0.0  # aged() made them: nobody else holds them
        out.records[before, :, :n] = W
        out.records[before, :, 2 * n] = np.einsum("kij,kj->ki", W, solution.state[before])
        return out

    def shifted(self, shift: ArrayLike) -> ChainRecords:
        """Change the nominal values: x_k becomes x_k - shift_k.

        Parameters
        ----------
        shift : (N, n) array
            New nominal values less old ones.

        Returns
        -------
        ChainRecords
            The same knowledge about corrections to the new nominal values.

        Raises
        ------
        EstimationError
            Shapes do not fit, or a value is not finite.
        """
        s = as_floats("shift", shift)
        N, n = len(self), self.n
        if s.shape != (N, n) or not np.isfinite(s).all():
            raise EstimationError(f"shift has shape {s.shape}; finite ({N}, {n}) fits the records")
        records, triangle = self.records.copy(), self.triangle.copy()
        records[:, :, 2 * n] -= np.einsum("kij,kj->ki", records[:, :, :n], s[:-1])
        records[:, :, 2 * n] -= np.einsum("kij,kj->ki", records[:, :, n : 2 * n], s[1:])
        triangle[:, n] -= triangle[:, :n] @ s[-1]
        return ChainRecords(records, triangle)

    def reversed(self) -> ChainRecords:
        """Sweep the rows from the far end: records that hold what is known of x_k given x_(k-1), last node first.

        Returns
        -------
        ChainRecords
            Nodes in reverse order, with the same posterior.

        References
        ----------
        Specification rail 18, direction.
        """
        back = reverse_chain(self.as_chain())
        triangle = start_triangle(back.prior, self.n)
        sweep = sweep_chain(back, triangle, store=True, filtered=False, gate=None)
        return ChainRecords(unpacked(sweep.records, self.n), triangle)


def merge_chain(stored: ChainRecords, chain: Chain, *, first: int = 0) -> Chain:
    """Put stored rows beside the rows of a new run: records as coupling rows, the last triangle as observation rows.

    Parameters
    ----------
    stored : ChainRecords
        What former runs left, corrections to the same nominal values as the chain's.
    chain : Chain
        Rows of the new run on the same nodes; nodes that it did not pass have no rows. It may reach beyond the stored nodes on
        either side.
    first : int
        Node of the chain at which the first stored node lies.

    Returns
    -------
    Chain
        To be solved; its records are what to store next.

    Raises
    ------
    EstimationError
        State sizes differ, or the stored nodes do not lie within the chain.

    Notes
    -----
    Merging run after run gives the estimate of all runs at once. Couplings are stored rows first, then the chain's own; all of
    them are n + q. NIS of the merged chain is that of the new rows against all that was known; `coupling_nis` counts the n
    stored rows as well.

    References
    ----------
    Specification rail 18, theorem.

    Examples
    --------
    >>> from railnav.estimation import solve_chain
    >>> run = Chain([[1.0]], [[0.0], [1.0]], [[-1.0]], [[1.0]], [[1.0]])
    >>> once = solve_chain(run)
    >>> twice = solve_chain(merge_chain(ChainRecords.of(once), run))
    >>> once.covariance.ravel().round(6), twice.covariance.ravel().round(6)
    (array([0.666667, 0.666667]), array([0.333333, 0.333333]))
    """
    N, n = len(chain), chain.n
    K = len(stored)
    if chain.lead:
        raise EstimationError("a stretch that continues a chain (lead = 1) is for ChainFilter.sweep")
    if stored.n != n:
        raise EstimationError(f"stored states have {stored.n} numbers, the chain's {n}; both need the same menu")
    if not 0 <= first <= N - K:
        raise EstimationError(f"{K} stored nodes from node {first} on do not lie within a chain of {N} nodes")
    last = first + K - 1
    q = chain.u.shape[1]
    M, L, u = np.zeros((N - 1, n + q, n)), np.zeros((N - 1, n + q, n)), np.zeros((N - 1, n + q))
    part = slice(first, last)
    M[part, :n], L[part, :n], u[part, :n] = (
        stored.records[:, :, :n],
        stored.records[:, :, n : 2 * n],
        stored.records[:, :, 2 * n],
    )
    M[:, n:], L[:, n:], u[:, n:] = chain.M, chain.L, chain.u
    m = max(chain.z.shape[1], int(chain.counts[last]) + n)
    if m > chain.z.shape[1]:
        H, z = np.zeros((N, m, n)), np.zeros((N, m))
        H[:, : chain.z.shape[1]], z[:, : chain.z.shape[1]] = chain.H, chain.z
    else:
        H, z = np.array(np.broadcast_to(chain.H, (N, m, n))), chain.z.copy()
    counts = chain.counts.copy()
    rows = slice(int(counts[last]), int(counts[last]) + n)
    H[last, rows], z[last, rows] = stored.triangle[:, :n], stored.triangle[:, n]
    counts[last] += n
    return Chain(H, z, M, L, u, counts=counts, coupling_counts=chain.coupling_counts + n, prior=chain.prior)


def reverse_chain(chain: Chain) -> Chain:
    """Turn a chain round: the last node first, the prior as observations of what is now the last node.

    Parameters
    ----------
    chain : Chain
        Any chain.

    Returns
    -------
    Chain
        Its posterior is the same, node by node in reverse.

    References
    ----------
    Specification rail 18, direction.
    """
    if chain.lead:
        raise EstimationError("a stretch that continues a chain (lead = 1) cannot be turned round")
    N, m, n = len(chain), chain.z.shape[1], chain.n
    H, z, counts = chain.H[::-1], chain.z[::-1], chain.counts[::-1].copy()
    if chain.prior is not None:
        R0, b0 = chain.prior
        have = int(counts[-1])
        wide = max(m, have + len(R0))
        H_wide, z_wide = np.zeros((N, wide, n)), np.zeros((N, wide))
        H_wide[:, :m], z_wide[:, :m] = H, z
        H_wide[-1, have : have + len(R0)], z_wide[-1, have : have + len(R0)] = R0, b0
        counts[-1] += len(R0)
        H, z = H_wide, z_wide
    return Chain(
        H,
        z,
        chain.L[::-1],
        chain.M[::-1],
        chain.u[::-1],
        counts=counts,
        coupling_counts=chain.coupling_counts[::-1].copy(),
    )


def observe_between(chain: Chain, node: ArrayLike, fraction: ArrayLike, H: ArrayLike, z: ArrayLike) -> Chain:
    """Add observations that lie between nodes: H ((1 - tau) x_k + tau x_(k+1)) = z becomes coupling rows.

    Parameters
    ----------
    chain : Chain
        The chain that they join.
    node : (J,) integer array
        Node k before each observation, 0 <= k < N - 1.
    fraction : (J,) array
        tau, 0 at node k, 1 at node k + 1.
    H : (J, r, n) or (r, n) array
        Whitened coefficients; r = 2 rows across the track keep the error along it out.
    z : (J, r) array
        Whitened right-hand sides.

    Returns
    -------
    Chain
        With wider couplings: as many rows more as the fullest link needs.

    Raises
    ------
    EstimationError
        Shapes do not fit, a node is not there, or a fraction is outside 0 to 1.

    References
    ----------
    Specification rail 15.1 and 18, sampling.

    Examples
    --------
    >>> from railnav.estimation import solve_chain
    >>> chain = Chain([[1.0]], [[0.0], [0.0]], [[-1.0]], [[1.0]], [[10.0]], counts=[1, 0])
    >>> solve_chain(observe_between(chain, [0], [0.5], [[100.0]], [[600.0]])).state.ravel().round(3)
    array([ 0.8, 11.2])
    """
    right = as_floats("z", z)
    N, n, q = len(chain), chain.n, chain.u.shape[1]
    if right.ndim != 2:
        raise EstimationError(f"z has shape {right.shape}, not (J, r)")
    J, r = right.shape
    rows = as_floats("H", H)
    rows = rows[np.newaxis] if rows.ndim == 2 else rows
    if rows.shape not in ((J, r, n), (1, r, n)):
        raise EstimationError(f"H has shape {rows.shape}; ({J}, {r}, {n}) fits")
    k, tau = np.asarray(node), as_floats("fraction", fraction)
    if k.shape != (J,) or tau.shape != (J,) or (J and not np.issubdtype(k.dtype, np.integer)):
        raise EstimationError(f"node has shape {k.shape} and fraction {tau.shape}; ({J},) fits, nodes are integers")
    for j in np.flatnonzero((k < 0) | (k >= N - 1))[:1]:
        raise EstimationError(f"observation {j} lies after node {k[j]}; there are links after nodes 0 to {N - 2}")
    for j in np.flatnonzero(~((tau >= 0) & (tau <= 1)))[:1]:
        raise EstimationError(f"observation {j} has fraction {tau[j]}; within a link it is 0 to 1")
    order = np.argsort(k, kind="stable")
    k, tau = k[order].astype(np.int64), tau[order]
    rows, right = np.broadcast_to(rows, (J, r, n))[order], right[order]
    here = np.bincount(k, minlength=max(N - 1, 1))[: max(N - 1, 0)].astype(np.int64)
    place = np.arange(J) - np.concatenate([[0], np.cumsum(here)[:-1]])[k] if J else np.zeros(0, np.int64)
    wide = int((chain.coupling_counts + r * here).max(initial=q))
    M, L, u = np.zeros((N - 1, wide, n)), np.zeros((N - 1, wide, n)), np.zeros((N - 1, wide))
    M[:, :q], L[:, :q], u[:, :q] = chain.M, chain.L, chain.u
    at = (chain.coupling_counts[k] + r * place)[:, None] + np.arange(r)
    M[k[:, None], at] = (1 - tau)[:, None, None] * rows
    L[k[:, None], at] = tau[:, None, None] * rows
    u[k[:, None], at] = right
    return Chain(
        chain.H,
        chain.z,
        M,
        L,
        u,
        counts=chain.counts,
        coupling_counts=chain.coupling_counts + r * here,
        prior=chain.prior,
    )


def _empty_chain(N: int, n: int) -> Chain:
    none = np.zeros((0, n))
    return Chain(none, np.zeros((N, 0)), none, none, np.zeros(0))
