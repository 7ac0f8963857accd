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
from railnav.estimation import _kernels
from railnav.estimation.chain import Chain, ChainSolution, as_floats, compiled_size, start_triangle, sweep_chain
from railnav.estimation.gross_error import chi_square_limit
from railnav.estimation.square_root import inverse_root

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: Locating a change: nodes that are looked at in one group of windows, and what a number left out must earn.
LOCATE_NODES = 40
LOCATE_PENALTY = 1.5


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
        """
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
        empty = _kernels.smooth_chain_kernel(compiled_size(n))(self.records, self.triangle, state)
        if empty >= 0:
            k, i = divmod(empty, n)
            raise EstimationError(f"node {k}: component {i} of the state is not determined by the stored rows")
        P = C = None
        if covariance:
            P, C = np.empty((N, n, n)), np.empty((N - 1, n, n))
            _kernels.covariance_chain_kernel(compiled_size(n))(self.records, self.triangle, P, C)
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
            records=self.records,
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
        return ChainRecords(sweep.records, triangle)


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


# ---------------------------------------------------------------- has it moved?


@dataclass(frozen=True, slots=True, eq=False)
class ChangeTest:
    """Outcome of the window test for change between two surveys.

    Attributes
    ----------
    first, last : (W,) array
        First and last node of each window.
    statistic : (W,) array
        T = Delta^T (Sigma_old + Sigma_new)^-1 Delta of each window.
    dof : int
        Degrees of freedom of each.
    limit : float
        What T may be.
    changed : (W,) bool array
        Where T passes the limit.
    stretches : tuple of (first, last)
        Nodes between which something moved: in each group of windows that overlap, the stretch without which the rest agrees
        best, min of T(rest) + 1.5 for each number left out.
    difference : (N, c) array
        New less old, at each node, in the components tested.
    sigma : (N, c) array
        Its standard deviation.
    """

    first: IntArray
    last: IntArray
    statistic: FloatArray
    dof: int
    limit: float
    changed: BoolArray
    stretches: tuple[tuple[int, int], ...]
    difference: FloatArray
    sigma: FloatArray

    @property
    def excess(self) -> float:
        """How much more the surveys differ than they state: upper quartile of T over that of chi-square, at least 1.

        Most windows of a line have not moved. Where the factor is well above 1, the surveys' errors are not as their covariances say,
        and a second test with ``variance_factor=excess`` allows for it.
        """
        from scipy.stats import chi2

        return max(1.0, float(np.quantile(self.statistic, 0.75) / chi2.ppf(0.75, self.dof)))

    def nodes(self, *, margin: int = 10) -> BoolArray:
        """Nodes of the stretches that moved, and `margin` nodes beyond each end.

        Parameters
        ----------
        margin : int
            Nodes to add on either side.

        Returns
        -------
        (N,) bool array
            Where to forget what was known before merging, ``stored.forgotten(nodes)``.
        """
        N = len(self.difference)
        out = np.zeros(N, np.bool_)
        for a, b in self.stretches:
            out[max(a - margin, 0) : b + margin + 1] = True
        return out


def change_test(
    old: ChainSolution,
    new: ChainSolution,
    *,
    window: int = 9,
    spacing: int = 10,
    step: int = 10,
    components: ArrayLike | None = None,
    false_alarm: float = 1e-3,
    variance_factor: float = 1.0,
) -> ChangeTest:
    """Test whether two independent surveys of the same nodes differ, window by window, before they are merged.

    T = Delta^T (Sigma_old + Sigma_new)^-1 Delta of `window` nodes is chi-square with c times `window` degrees of freedom if nothing
    has moved; Sigma holds the cross-covariances of the nodes, cov(x_i, x_j) = G_i ... G_(j-1) P_j.

    Parameters
    ----------
    old, new : ChainSolution
        The stored chain and the new run alone, with covariances, corrections to the same nominal values.
    window : int
        Nodes in a window.
    spacing : int
        Nodes from one to the next within a window. A window should hold what moved and a piece of what did not on either side:
        with nodes a metre apart the default spans 80 m.
    step : int
        Nodes from one window to the next.
    components : (N, c, n) or (c, n) array, optional
        What of the states is compared, e.g. the unit vectors across and up; all of it by default.
    false_alarm : float
        Probability that any window of the line alarms though nothing moved (Bonferroni over the windows).
    variance_factor : float
        What both covariances are multiplied by, where the surveys are known to err more than they state (`ChangeTest.excess`).

    Returns
    -------
    ChangeTest
        Windows, decisions, differences by node.

    Raises
    ------
    EstimationError
        The chains do not fit each other, were solved without covariances, or are shorter than a window.

    Notes
    -----
    10 mm over 60 m with ramps of 8 m, old axis known to 1.1 mm, new run to 2.4 mm (fixes of 10 mm every 5 m, increments of 0.5 mm):
    found in 199 of 200 cases, no false alarm in 200; windows of 40 m (the specification's) find 90 %, single nodes 25 %.
    Work is O(N window (window + spacing) n^3 / step). Surveys that share an error (the same stored model in both, a bias of a run that
    is not a state) break the premise.

    References
    ----------
    Specification rail 18, change detection; 15.3.

    Examples
    --------
    >>> from railnav.estimation import solve_chain
    >>> def survey(offset):
    ...     return solve_chain(Chain([[100.0]], np.full((99, 1), 100.0 * offset), [[-1e3]], [[1e3]], np.zeros((98, 1))))
    >>> change_test(survey(0.0), survey(0.03)).changed.any(), change_test(survey(0.0), survey(0.001)).changed.any()
    (np.True_, np.False_)
    """
    if old.state.shape != new.state.shape:
        raise EstimationError(
            f"the chains have shapes {old.state.shape} and {new.state.shape}; the same nodes are needed"
        )
    if old.covariance is None or new.covariance is None:
        raise EstimationError("both chains are needed with covariances; solve_chain(..., covariance=True) gives them")
    N, n = old.state.shape
    if window < 1 or spacing < 1 or step < 1 or (window - 1) * spacing >= N:
        raise EstimationError(
            f"windows of {window} nodes, {spacing} apart, every {step}, do not fit a chain of {N} nodes"
        )
    E = np.eye(n) if components is None else as_floats("components", components)
    if E.ndim not in (2, 3) or E.shape[-1] != n or (E.ndim == 3 and len(E) != N):
        raise EstimationError(f"components have shape {E.shape}; (c, {n}) or ({N}, c, {n}) fits")
    E = np.broadcast_to(E, (N, *E.shape[-2:]))
    c = E.shape[1]
    reach = (window - 1) * spacing
    first = np.arange(0, N - reach, step)
    if first[-1] != N - 1 - reach:
        first = np.append(first, N - 1 - reach)  # the last nodes are tested as well
    nodes = first[:, None] + spacing * np.arange(window)  # (W, window)
    if not variance_factor > 0:
        raise EstimationError(f"the variance factor is {variance_factor}; it must be positive")
    sigma = variance_factor * (_window_covariance(old, nodes, E) + _window_covariance(new, nodes, E))
    difference = np.asarray(np.einsum("kij,kj->ki", E, new.state - old.state))
    delta = difference[nodes].reshape(len(first), window * c)
    statistic = np.einsum("wi,wi->w", delta, np.linalg.solve(sigma, delta[:, :, None])[:, :, 0])
    limit = chi_square_limit(window * c, false_alarm / len(first))
    changed = np.asarray(statistic > limit)
    variance = variance_factor * np.einsum("kij,kjl,kil->ki", E, old.covariance + new.covariance, E)
    return ChangeTest(
        first=first,
        last=nodes[:, -1],
        statistic=np.asarray(statistic),
        dof=window * c,
        limit=limit,
        changed=changed,
        stretches=_stretches(
            old, new, E, difference, first[changed], nodes[changed, -1], max(spacing // 2, 1), variance_factor
        ),
        difference=difference,
        sigma=np.asarray(np.sqrt(variance)),
    )


def _stretches(
    old: ChainSolution,
    new: ChainSolution,
    E: FloatArray,
    difference: FloatArray,
    first: IntArray,
    last: IntArray,
    spacing: int,
    factor: float,
) -> tuple[tuple[int, int], ...]:
    """Stretch of each group of overlapping windows without which the rest agrees best."""
    groups: list[list[int]] = []
    for a, b in zip(first.tolist(), last.tolist(), strict=True):
        if groups and a <= groups[-1][1]:
            groups[-1][1] = max(groups[-1][1], b)
        else:
            groups.append([a, b])
    out = []
    c = difference.shape[1]
    for a, b in groups:
        spread = max(spacing, -(-(b - a) // (LOCATE_NODES - 1)))
        nodes = np.arange(a, b + 1, spread)
        if nodes[-1] != b:
            nodes = np.append(nodes, b)
        w = len(nodes)
        sigma = factor * (_window_covariance(old, nodes[None], E) + _window_covariance(new, nodes[None], E))[0]
        delta = difference[nodes].ravel()
        best, stretch = np.inf, (a, b)
        for i in range(w):
            for j in range(i, w):
                rest = np.r_[0 : i * c, (j + 1) * c : w * c]
                T = float(delta[rest] @ np.linalg.solve(sigma[np.ix_(rest, rest)], delta[rest])) if len(rest) else 0.0
                score = T + LOCATE_PENALTY * c * (j - i + 1)
                if score < best:
                    best, stretch = score, (int(nodes[i]), int(nodes[j]))
        slack = spread - spacing  # coarse nodes leave the ends open by as much
        out.append((max(stretch[0] - slack, a), min(stretch[1] + slack, b)))
    return tuple(out)


def _window_covariance(solution: ChainSolution, nodes: IntArray, E: FloatArray) -> FloatArray:
    """Joint covariance of E x at the nodes of each window: (W, window c, window c)."""
    assert solution.covariance is not None
    P = solution.covariance
    W, w = nodes.shape
    n, c = P.shape[1], E.shape[1]
    out = np.empty((W, w, c, w, c))
    G = -np.linalg.solve(solution.records[:, :, :n], solution.records[:, :, n : 2 * n])
    across = []  # cov(x_i, .) = across cov(x_j, .) from each node of a window to the next
    for a in range(w - 1):
        product = G[nodes[:, a + 1] - 1]
        for k in range(nodes[0, a + 1] - nodes[0, a] - 2, -1, -1):
            product = G[nodes[:, a] + k] @ product
        across.append(product)
    for b in range(w):
        cross = P[nodes[:, b]]
        for a in range(b, -1, -1):
            if a < b:
                cross = across[a] @ cross
            block = E[nodes[:, a]] @ cross @ np.swapaxes(E[nodes[:, b]], 1, 2)
            out[:, a, :, b, :] = block
            out[:, b, :, a, :] = np.swapaxes(block, 1, 2)
    return out.reshape(W, w * c, w * c)


def windows(solution: ChainSolution, nodes: ArrayLike, components: ArrayLike | None = None) -> FloatArray:
    """Joint covariances of the states at windows of nodes, cov(x_i, x_j) = G_i ... G_(j-1) P_j.

    Parameters
    ----------
    solution : ChainSolution
        With covariances.
    nodes : (W, w) integer array
        Nodes of each window, growing.
    components : (c, n) array, optional
        What of the states; the first number by default.

    Returns
    -------
    (W, w c, w c) array
        Node by node, component by component.

    Raises
    ------
    EstimationError
        The chain was solved without covariances, or nodes do not grow.

    References
    ----------
    Specification rail 15.3.
    """
    k = np.asarray(nodes, np.int64)
    n = solution.state.shape[1]
    if solution.covariance is None:
        raise EstimationError("the chain is needed with covariances; solve_chain(..., covariance=True) gives them")
    if k.ndim != 2 or k.min() < 0 or k.max() >= len(solution.state) or (np.diff(k, axis=1) <= 0).any():
        raise EstimationError("nodes of a window must grow and lie within the chain")
    E = np.eye(1, n) if components is None else as_floats("components", components)
    return _ragged_covariance(solution, k, np.broadcast_to(E, (len(solution.state), *E.shape)))


def _ragged_covariance(solution: ChainSolution, nodes: IntArray, E: FloatArray) -> FloatArray:
    """The same for windows whose nodes are not equally far apart."""
    assert solution.covariance is not None
    P = solution.covariance
    W, w = nodes.shape
    n, c = P.shape[1], E.shape[1]
    G = -np.linalg.solve(solution.records[:, :, :n], solution.records[:, :, n : 2 * n])
    across = []
    for a in range(w - 1):
        product = np.broadcast_to(np.eye(n), (W, n, n)).copy()
        far = nodes[:, a + 1] - nodes[:, a]
        for k in range(int(far.max())):
            on = k < far
            product[on] = product[on] @ G[nodes[on, a] + k]
        across.append(product)
    out = np.empty((W, w, c, w, c))
    for b in range(w):
        cross = P[nodes[:, b]]
        for a in range(b, -1, -1):
            if a < b:
                cross = across[a] @ cross
            block = E[nodes[:, a]] @ cross @ np.swapaxes(E[nodes[:, b]], 1, 2)
            out[:, a, :, b, :] = block
            out[:, b, :, a, :] = np.swapaxes(block, 1, 2)
    return out.reshape(W, w * c, w * c)


def _empty_chain(N: int, n: int) -> Chain:
    none = np.zeros((0, n))
    return Chain(none, np.zeros((N, 0)), none, none, np.zeros(0))
