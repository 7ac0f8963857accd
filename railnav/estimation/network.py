"""Networks of measured vectors between points: GNSS baselines as edges of a weighted graph in space.

Each edge says x_j - x_i = b_ij with a covariance. Points are held by at least one known point in each connected part; loops show
before the adjustment whether vectors contradict each other.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation.chain import as_floats
from railnav.estimation.gross_error import chi_square_limit
from railnav.estimation.square_root import inverse_root

FloatArray = NDArray[np.float64]
Node = Hashable


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A loop of the graph and how well its vectors close.

    Attributes
    ----------
    nodes : tuple
        Nodes in order; the last edge leads back to the first.
    edges : tuple of (index, sign)
        Edges in order, with -1 where they are passed against their direction.
    closure : (d,) array
        Sum of the vectors, m; 0 for perfect ones.
    statistic, limit : float
        closure^T K^-1 closure, chi-square with d degrees of freedom, and what it may be.
    """

    nodes: tuple[Node, ...]
    edges: tuple[tuple[int, int], ...]
    closure: FloatArray
    statistic: float
    limit: float

    @property
    def closes(self) -> bool:
        """Whether the loop closes within its tolerance."""
        return self.statistic <= self.limit


@dataclass(frozen=True, slots=True, eq=False)
class NetworkSolution:
    """A network adjusted.

    Attributes
    ----------
    nodes : tuple
        Names of the points, known ones included, in order of appearance.
    position : (V, d) array
        Their coordinates, m.
    covariance : (V, d, d) array
        Covariances for unit weight 1; zeros at known points.
    residual : (E, d) array
        Adjusted - measured vector of each edge, m.
    sum_of_squares : float
        v^T v of the whitened residuals.
    redundancy : int
        Rows less unknowns.
    """

    nodes: tuple[Node, ...]
    position: FloatArray
    covariance: FloatArray
    residual: FloatArray
    sum_of_squares: float
    redundancy: int

    @property
    def unit_weight_rms(self) -> float:
        """Unit-weight RMS sqrt(v^T v / redundancy).

        Raises
        ------
        EstimationError
            No row is redundant.
        """
        if self.redundancy == 0:
            raise EstimationError("no vector is redundant: the network cannot tell how well it fits")
        return float(np.sqrt(self.sum_of_squares / self.redundancy))

    def at(self, node: Node) -> FloatArray:
        """Coordinates of one point.

        Parameters
        ----------
        node : hashable
            Its name.

        Returns
        -------
        (d,) array
            Coordinates, m.
        """
        return np.asarray(self.position[self.nodes.index(node)])


def adjust_network(
    edges: Sequence[tuple[Node, Node]], vector: ArrayLike, covariance: ArrayLike, *, fixed: Mapping[Node, ArrayLike]
) -> NetworkSolution:
    """Adjust a network of vectors, min sum |W_ij (x_j - x_i - b_ij)|^2, with known points held.

    Parameters
    ----------
    edges : sequence of (i, j)
        Names of the points that each vector leads from and to; several vectors between the same points are welcome.
    vector : (E, d) array
        b_ij, m, all in one frame.
    covariance : (E, d, d) or (d, d) array
        Their covariances, m^2, independent of each other.
    fixed : mapping of name to (d,) array
        Known points: at least one in each connected part.

    Returns
    -------
    NetworkSolution
        Coordinates, covariances, residuals.

    Raises
    ------
    EstimationError
        Shapes do not fit, a covariance is not positive definite, or a part of the network holds no known point.

    Notes
    -----
    One QR of all rows (incidence matrix x I_d, whitened): work is cubic in the number of points, for hundreds of them. Baselines
    of one session share the receivers' errors and are not independent; give each session's covariance its share.

    References
    ----------
    Specification rail 9, baseline graph.

    Examples
    --------
    >>> levels = adjust_network([("A", "B"), ("B", "C"), ("A", "C")], [[1.0], [1.0], [2.3]], [[1.0]], fixed={"A": [10.0]})
    >>> levels.at("C").round(6), levels.redundancy
    (array([12.2]), 1)
    """
    b, W = _measured(edges, vector, covariance)
    E, d = b.shape
    nodes = _names(edges)
    known = {}
    for node, value in fixed.items():
        x = as_floats(f"fixed[{node!r}]", value)
        if x.shape != (d,) or not np.isfinite(x).all():
            raise EstimationError(f"fixed[{node!r}] has shape {x.shape}; finite ({d},) fits the vectors")
        if node not in nodes:
            raise EstimationError(f"the known point {node!r} is no end of any vector; check its name")
        known[node] = x
    for part in _parts(edges):
        if not any(node in known for node in part):
            raise EstimationError(
                f"no point of the part around {part[0]!r} ({len(part)} points) is known; fix one of them"
            )
    free = [node for node in nodes if node not in known]
    column = {node: i for i, node in enumerate(free)}
    origin = next((known[node] for node in nodes if node in known), np.zeros(d))
    A, right = np.zeros((E * d, len(free) * d)), np.empty(E * d)
    for e, (i, j) in enumerate(edges):
        rows = slice(e * d, (e + 1) * d)
        difference = b[e].copy()
        for node, sign in ((i, -1.0), (j, 1.0)):
            if node in column:
                A[rows, column[node] * d : (column[node] + 1) * d] += sign * W[e]
            else:
                difference -= sign * (known[node] - origin)
        right[rows] = W[e] @ difference
    Q, R = np.linalg.qr(A)
    inverse = np.linalg.solve(R, np.eye(len(R)))
    x = inverse @ (Q.T @ right)
    v = (A @ x - right).reshape(E, d)
    position, P = np.empty((len(nodes), d)), np.zeros((len(nodes), d, d))
    for k, node in enumerate(nodes):
        if node in column:
            own = slice(column[node] * d, (column[node] + 1) * d)
            position[k] = origin + x[own]
            P[k] = inverse[own] @ inverse[own].T
        else:
            position[k] = known[node]
    return NetworkSolution(
        nodes=nodes,
        position=position,
        covariance=P,
        residual=np.linalg.solve(W, v[:, :, None])[:, :, 0],
        sum_of_squares=float((v**2).sum()),
        redundancy=(E - len(free)) * d,
    )


def network_loops(
    edges: Sequence[tuple[Node, Node]], vector: ArrayLike, covariance: ArrayLike, *, significance: float = 1e-3
) -> tuple[Loop, ...]:
    """Close the loops of a network: every edge beyond a spanning tree closes one.

    Parameters
    ----------
    edges, vector, covariance
        As in `adjust_network`.
    significance : float
        Probability that a good loop is called open.

    Returns
    -------
    tuple of Loop
        As many as there are redundant vectors; short ones, as the tree is laid in breadth.

    Raises
    ------
    EstimationError
        Shapes do not fit, or a covariance is not positive definite.

    References
    ----------
    Specification rail 9, baseline graph.

    Examples
    --------
    >>> (loop,) = network_loops([("A", "B"), ("B", "C"), ("A", "C")], [[1.0], [1.0], [2.3]], [[1e-4]])
    >>> loop.nodes, loop.closure.round(6), loop.closes
    (('B', 'C', 'A'), array([-0.3]), False)
    """
    import networkx as nx

    b, _ = _measured(edges, vector, covariance)
    E, d = b.shape
    K = np.broadcast_to(np.asarray(covariance, np.float64), (E, d, d))
    limit = chi_square_limit(d, significance)
    graph = nx.MultiGraph()
    graph.add_nodes_from(_names(edges))
    for e, (i, j) in enumerate(edges):
        graph.add_edge(i, j, key=e)
    tree = nx.Graph()
    used = set()
    for part in nx.connected_components(graph):
        root = next(node for node in graph if node in part)
        tree.add_node(root)
        for i, j in nx.bfs_edges(graph, root):
            e = min(graph[i][j])
            used.add(e)
            tree.add_edge(i, j, index=e)
    loops = []
    for e, (i, j) in enumerate(edges):
        if e in used:
            continue
        path = nx.shortest_path(tree, j, i)
        steps = [(e, 1)]
        for p, q in pairwise(path):
            index = tree[p][q]["index"]
            steps.append((index, 1 if edges[index][0] == p else -1))
        closure = np.sum([sign * b[index] for index, sign in steps], axis=0)
        sigma = np.sum([K[index] for index, _ in steps], axis=0)
        statistic = float(closure @ np.linalg.solve(sigma, closure))
        loops.append(Loop((i, *path[:-1]), tuple(steps), closure, statistic, limit))
    return tuple(loops)


def _measured(
    edges: Sequence[tuple[Node, Node]], vector: ArrayLike, covariance: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Vectors and their whitening, checked."""
    b = as_floats("vector", vector)
    if b.ndim != 2 or len(b) != len(edges) or len(b) == 0:
        raise EstimationError(f"vector has shape {b.shape}; ({len(edges)}, d) with at least one edge fits")
    E, d = b.shape
    for e in np.flatnonzero(~np.isfinite(b).all(axis=1))[:1]:
        raise EstimationError(f"vector {e} ({edges[e][0]!r} to {edges[e][1]!r}) is not finite; leave it out")
    for e, (i, j) in enumerate(edges):
        if i == j:
            raise EstimationError(f"vector {e} leads from {i!r} to itself; leave it out")
    K = as_floats("covariance", covariance)
    if K.shape not in ((d, d), (E, d, d)):
        raise EstimationError(f"covariance has shape {K.shape}; ({E}, {d}, {d}) or ({d}, {d}) fits")
    return b, np.broadcast_to(inverse_root(K.reshape(-1, d, d)), (E, d, d))


def _names(edges: Sequence[tuple[Node, Node]]) -> tuple[Node, ...]:
    return tuple(dict.fromkeys(node for edge in edges for node in edge))


def _parts(edges: Sequence[tuple[Node, Node]]) -> list[list[Node]]:
    """Connected parts, nodes in order of appearance."""
    import networkx as nx

    graph = nx.Graph()
    graph.add_nodes_from(_names(edges))
    graph.add_edges_from(edges)
    return [[node for node in graph if node in part] for part in nx.connected_components(graph)]
