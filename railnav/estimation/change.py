"""Has the track moved? Two surveys of the same nodes compared window by window, with the covariances between their nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation.chain import as_floats
from railnav.estimation.chain_solution import ChainSolution
from railnav.estimation.gross_error import chi_square_limit

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: Locating a change: nodes that are looked at in one group of windows, and how a move wanders, per node, in terms of its greatest size
#: squared: slowly over a long plateau with short ramps, fast where it is short. So many nodes beside a coarse end are tried, and so
#: many pairs of ends at once.
LOCATE_NODES = 60
LOCATE_NEAR, LOCATE_TOGETHER = 3, 200
LOCATE_WALKS = (1 / 20, 1 / 60, 1 / 180, 1 / 540)


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
        Nodes between which something moved, one stretch in each group of windows that overlap: that with the greatest evidence, the
        move taken as a random walk tied to zero at both ends.
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

    def nodes(self, *, margin: int = 2) -> BoolArray:
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
    >>> from railnav.estimation import Chain, solve_chain
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
    """The stretch of each group of overlapping windows that the difference speaks for most."""
    groups: list[list[int]] = []
    for a, b in zip(first.tolist(), last.tolist(), strict=True):
        if groups and a <= groups[-1][1]:
            groups[-1][1] = max(groups[-1][1], b)
        else:
            groups.append([a, b])
    out = []
    for a, b in groups:
        spread = max(spacing, -(-(b - a) // (LOCATE_NODES - 1)))
        nodes = np.arange(a, b + 1, spread)
        if nodes[-1] != b:
            nodes = np.append(nodes, b)
        sigma = factor * (_window_covariance(old, nodes[None], E) + _window_covariance(new, nodes[None], E))[0]
        first_node, last_node = _located(nodes, difference[nodes], sigma, spread)
        slack = spread - spacing  # coarse nodes leave the ends open by as much
        out.append((max(first_node - slack, a), min(last_node + slack, b)))
    return tuple(out)


def _located(nodes: IntArray, delta: FloatArray, sigma: FloatArray, spread: int) -> tuple[int, int]:
    """Ends (nodes that have not moved) of the stretch with the greatest evidence: on every other node, then on all beside those ends.

    Between its ends the move is a random walk tied to zero at both (a Brownian bridge), cov(d_i, d_j) = q u_i (L - u_j) / L for u_i <= u_j
    beyond the first end; q per node is one of `LOCATE_WALKS` in terms of the largest difference squared. What is sought is the largest
    -1/2 (delta^T S^-1 delta + ln |S|), S = sigma + cov.
    """
    w, c = delta.shape
    ends = np.concatenate([[nodes[0] - spread], nodes, [nodes[-1] + spread]])  # end e lies at node e - 1
    first, last = np.triu_indices(w + 2, 2)
    some = np.arange(0, w, 2)
    kept = (some[:, None] * c + np.arange(c)).ravel()
    near = (first % 2 == 1) & (last % 2 == 1)
    if near.any():
        coarse = _evidence(nodes[some], delta[some], sigma[np.ix_(kept, kept)], ends[first[near]], ends[last[near]])
        best = int(np.argmax(coarse))
        near = (np.abs(first - first[near][best]) <= LOCATE_NEAR) & (np.abs(last - last[near][best]) <= LOCATE_NEAR)
    else:
        near = np.ones(len(first), np.bool_)
    best = int(np.argmax(_evidence(nodes, delta, sigma, ends[first[near]], ends[last[near]])))
    return max(int(ends[first[near][best]]), int(nodes[0])), min(int(ends[last[near][best]]), int(nodes[-1]))


def _evidence(nodes: IntArray, delta: FloatArray, sigma: FloatArray, first: IntArray, last: IntArray) -> FloatArray:
    """Log evidence (t,) of a move between each pair of ends, of the walk that suits it best."""
    w, c = delta.shape
    peak = float(np.max(delta**2))
    out = np.full(len(first), -np.inf)
    for few in np.array_split(np.arange(len(first)), max(1, len(first) // LOCATE_TOGETHER)):
        u = np.maximum(nodes - first[few, None], 0).astype(np.float64)
        v = np.maximum(last[few, None] - nodes, 0).astype(np.float64)
        length = (last[few] - first[few]).astype(np.float64)[:, None, None]
        # u_i (L - u_j) / L for u_i <= u_j: zero wherever either lies beyond an end
        lower, upper = u[:, :, None] * v[:, None, :], v[:, :, None] * u[:, None, :]
        bridge = np.where(np.tri(w, dtype=np.bool_).T, lower, upper) / length
        move = peak * np.einsum("tij,ab->tiajb", bridge, np.eye(c)).reshape(len(few), w * c, w * c)
        right = np.broadcast_to(delta.reshape(1, -1, 1), (len(few), w * c, 1))
        for walk in LOCATE_WALKS:
            root = np.linalg.cholesky(sigma + walk * move)
            white = np.linalg.solve(root, right)[:, :, 0]
            score = -0.5 * (white**2).sum(axis=1) - np.log(np.einsum("tii->ti", root)).sum(axis=1)
            out[few] = np.maximum(out[few], score)
    return out


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
