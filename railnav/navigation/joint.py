"""The train and the map's errors at once: scheme B done consistently.

An accurate model gives a train's place (scheme A). A model with errors of decimetres tells the train less, and the train tells the
model something: both are estimated together, and the model's part is kept for the next train. Taking the map as one more
measurement of the same weight at every epoch, as the source words scheme B, counts one map error many times over: five times too
sure (NEES 5.8, rail 23).

The true axis is c(s) + sum_i eta_i(s) E(s) delta_i: eta_i hat functions on nodes `spacing` apart, E the cross directions (to the
right, and up where there are heights), delta_i the errors of the map at the nodes, a chain with a stored prior. The component along
the track is left out: a shift along is the same as another offset, no run can tell them apart (its gauge is frozen).

Per epoch the window holds the train, its GNSS errors and the nodes around it; what lies behind is eliminated, and comes back
smoothed when the run is over. The exact posterior is no chain any more (the train ties nodes together); the closest chain in the
sense of Kullback and Leibler is stored.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation.square_root import inverse_root
from railnav.estimation.window import Window, WindowMarginal
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

#: Offsets, (m,) m -> points (m, d), unit tangents (m, d) per metre of offset, and cross directions (m, d, c).
Curve = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]

#: Cells kept behind the train, so that it may step back a little after an update (rail 26.12).
CELLS_BEHIND = 2


@dataclass(frozen=True, slots=True, eq=False)
class MapChain:
    """Errors of a map at nodes along a track: a Gaussian Markov chain, p(delta_0) prod p(delta_(i+1) | delta_i).

    Attributes
    ----------
    start, spacing : float
        Offset of the first node, and distance between nodes, m.
    mean, covariance : (c,), (c, c) array
        Of the first node, m and m^2.
    F, shift, Q : (n - 1, c, c), (n - 1, c), (n - 1, c, c) array
        delta_(i+1) = F_i delta_i + shift_i + noise of covariance Q_i.
    """

    start: float
    spacing: float
    mean: FloatArray
    covariance: FloatArray
    F: FloatArray
    shift: FloatArray
    Q: FloatArray

    def __len__(self) -> int:
        return len(self.F) + 1

    @classmethod
    def stationary(
        cls,
        length: float,
        *,
        sigma: ArrayLike,
        correlation_length: float = 200.0,
        spacing: float = 25.0,
        start: float = 0.0,
        components: int = 2,
    ) -> MapChain:
        """First-order Gauss-Markov errors, as long as nothing better is known.

        Parameters
        ----------
        length : float
            Way that the nodes must span, m.
        sigma : float or (n,) array
            Standard deviation of each component at every node, m.
        correlation_length : float
            m.
        spacing, start : float
            m.
        components : int
            1 (to the right) or 2 (to the right and up).

        Returns
        -------
        MapChain

        Examples
        --------
        >>> chain = MapChain.stationary(1000.0, sigma=0.5)
        >>> len(chain), round(float(chain.marginals()[1][-1, 0, 0]), 6)
        (42, 0.25)
        """
        n = int(np.ceil(length / spacing)) + 2
        s = np.broadcast_to(np.asarray(sigma, float), (n,))
        phi = float(np.exp(-spacing / correlation_length))
        eye = np.eye(components)
        keep = phi * s[1:] / s[:-1]
        return cls(
            start,
            spacing,
            np.zeros(components),
            eye * s[0] ** 2,
            keep[:, None, None] * eye,
            np.zeros((n - 1, components)),
            (s[1:] ** 2 * (1.0 - phi * phi))[:, None, None] * eye,
        )

    def marginals(self) -> tuple[FloatArray, FloatArray]:
        """Mean (n, c), m, and covariance (n, c, c), m^2, of every node."""
        mean, covariance = np.empty((len(self), len(self.mean))), np.empty((len(self), *self.covariance.shape))
        mean[0], covariance[0] = self.mean, self.covariance
        for i, F in enumerate(self.F):
            mean[i + 1] = F @ mean[i] + self.shift[i]
            covariance[i + 1] = F @ covariance[i] @ F.T + self.Q[i]
        return mean, covariance

    def aged(self, share: float) -> MapChain:
        """Keep only a share of the information, 0 < share <= 1: the means stay, covariances grow by 1 / share (rail 18).

        A track may have moved since. And a chain ties neighbours only: what a train with good dead reckoning knows over hundreds of
        metres is
        lost when its pass is stored, so that a chain may be too sure after many passes.
        """
        if not 0.0 < share <= 1.0:
            raise EstimationError(f"a chain keeps a share of its information between 0 and 1, not {share}")
        return replace(self, covariance=self.covariance / share, Q=self.Q / share)

    def reversed(self) -> MapChain:
        """The same joint distribution, told from the other end: node i becomes node n - 1 - i.

        `start` becomes minus the offset of the last node: offsets count backwards, s' = -s.
        """
        mean, covariance = self.marginals()
        back = self.F @ covariance[:-1]  # cov(delta_(i+1), delta_i)
        F = np.swapaxes(np.linalg.solve(covariance[1:], back), 1, 2)  # P_(i,i+1) P_(i+1)^-1
        shift = mean[:-1] - np.einsum("nij,nj->ni", F, mean[1:])
        Q = covariance[:-1] - F @ back
        last = self.start + self.spacing * (len(self) - 1)
        return MapChain(
            -last,
            self.spacing,
            mean[-1],
            covariance[-1],
            F[::-1].copy(),
            shift[::-1].copy(),
            _symmetric(Q)[::-1].copy(),
        )

    def with_pairs(self, first: int, pairs: FloatArray, covariances: FloatArray) -> MapChain:
        """Take over new joint distributions of neighbouring nodes; nodes beyond keep their old conditionals on the nearest new one.

        Parameters
        ----------
        first : int
            Node at which the new pairs begin.
        pairs, covariances : (k, 2 c), (k, 2 c, 2 c) array
            Mean and covariance of (delta_i, delta_(i+1)) for i = first ... first + k - 1.

        Returns
        -------
        MapChain
            The closest chain in the sense of Kullback and Leibler: F_i = P_(i+1,i) P_ii^-1 (rail 23).
        """
        c = len(self.mean)
        F, shift, Q = self.F.copy(), self.shift.copy(), self.Q.copy()
        back = self.reversed()  # conditionals of a node on its successor stay where no new pair is
        n = len(self)
        means, Ps = [pairs[0, :c]], [covariances[0, :c, :c]]
        for i in range(first - 1, -1, -1):
            k = n - 2 - i  # link from node i + 1 to node i in the reversed chain
            B, b, R = back.F[k], back.shift[k], back.Q[k]
            m1, P1 = means[-1], Ps[-1]
            m0, P0 = B @ m1 + b, B @ P1 @ B.T + R
            F[i] = np.linalg.solve(P0, B @ P1).T
            shift[i] = m1 - F[i] @ m0
            Q[i] = P1 - F[i] @ (B @ P1)
            means.append(m0)
            Ps.append(P0)
        for k, (m, P) in enumerate(zip(pairs, covariances, strict=True)):
            i = first + k
            F[i] = np.linalg.solve(P[:c, :c], P[:c, c:]).T
            shift[i] = m[c:] - F[i] @ m[:c]
            Q[i] = P[c:, c:] - F[i] @ P[:c, c:]
        return MapChain(self.start, self.spacing, means[-1], Ps[-1], F, shift, _symmetric(Q))


@dataclass(frozen=True, slots=True)
class JointSettings:
    """What the joint estimation assumes of the receiver and the wheel.

    Attributes
    ----------
    coloured_sigma : float
        Correlated part of a GNSS error, per axis, m; 0 for none.
    correlation_time : float
        Of that part, s.
    frame_sigma : float
        Constant part of a run's GNSS errors, per axis, m; 0 for none. It is what keeps one run from moving the whole map.
    offset_sigma : float
        Of the first offset, m.
    scale_sigma : float
        Scale error of the distances run; 0 for none.
    gate : float
        Positions whose squared normalised innovation exceeds this are left out (chi-square, 3: 1e-5).
    """

    coloured_sigma: float = 0.0
    correlation_time: float = 60.0
    frame_sigma: float = 0.0
    offset_sigma: float = 10.0
    scale_sigma: float = 0.0
    gate: float = 25.9


@dataclass(frozen=True, slots=True, eq=False)
class JointPass:
    """One run over one track, train and map together.

    Attributes
    ----------
    time : (m,) array
        s.
    offset, offset_sigma : (m,) array
        m, as known at the time. Offset and its sigma carry the map's labels: the gauge along the track is frozen.
    position, covariance : (m, d), (m, d, d) array
        The train with the corrected map, m, as known at the time.
    nis : (m,) array
        Normalised innovation squared of each position, d degrees of freedom; NaN where none was used.
    rejected : int
        Positions left out by the gate.
    chain : MapChain
        The map's errors after the run.
    first_node, last_node : int
        Nodes that the run has seen.
    """

    time: FloatArray
    offset: FloatArray
    offset_sigma: FloatArray
    position: FloatArray
    covariance: FloatArray
    nis: FloatArray
    rejected: int
    chain: MapChain
    first_node: int
    last_node: int


def joint_pass(
    curve: Curve,
    chain: MapChain,
    time: ArrayLike,
    position: ArrayLike,
    covariance: ArrayLike,
    *,
    offset: float,
    increments: ArrayLike | None = None,
    increment_covariance: ArrayLike | None = None,
    distances: ArrayLike | None = None,
    distance_sigma: ArrayLike | None = None,
    settings: JointSettings | None = None,
) -> JointPass:
    """Estimate a train's places and the errors of the map it runs on, in one pass with growing offset.

    Parameters
    ----------
    curve : callable
        The map: points, tangents and cross directions at offsets; see `track_curve`.
    chain : MapChain
        What is known of the map's errors beforehand.
    time : (m,) array
        s, increasing.
    position : (m, d) array
        Positions of the track axis, m; NaN rows where there is none.
    covariance : (m, d, d) array
        Of their uncorrelated part, m^2.
    offset : float
        First offset, m, to within `settings.offset_sigma`.
    increments, increment_covariance : (m - 1, d), (m - 1, d, d) array, optional
        Displacements from epoch to epoch, m, from odometer and gyro angles.
    distances, distance_sigma : (m - 1,) array, optional
        Ways run along the track from epoch to epoch, m, instead of displacements.
    settings : JointSettings, optional

    Returns
    -------
    JointPass

    Raises
    ------
    EstimationError
        Neither displacements nor distances, wrong shapes, or a train that leaves the nodes of the chain.

    Notes
    -----
    The cost of an epoch does not depend on the length of the line. Linearised once an epoch at the predicted offset; curves of 200
    m radius and
    predictions good to metres leave errors of second order, e^2 / 2R.

    Over 40 simulated lines (map errors 0.5 m over 200 m, positions 1 m, displacements 3 cm) the map's errors after 1, 2, 3, 4, 5 and 6
    passes are 124, 90, 73, 63, 57 and 52 mm with a NEES of 1.03, 1.07, 1.05, 1.04, 1.06 and 1.06, each to 0.06
    (`benchmarks/records.py`): what storing a chain instead of the exact posterior costs in honesty is not seen there.

    References
    ----------
    `spec/rail.md` 23.

    Examples
    --------
    A straight map that lies 0.4 m to the left of the truth, seen once with positions of 5 cm:

    >>> def straight(s):
    ...     s = np.asarray(s, float)
    ...     one, nought = np.ones(len(s)), np.zeros(len(s))
    ...     return np.column_stack([s, nought]), np.column_stack([one, nought]), np.column_stack([nought, -one])[:, :, None]
    >>> t = np.arange(40.0)
    >>> truth = np.column_stack([10.0 * t, np.full(40, -0.4)])
    >>> seen = joint_pass(
    ...     straight, MapChain.stationary(400.0, sigma=0.5, components=1), t, truth, np.tile(0.0025 * np.eye(2), (40, 1, 1)),
    ...     offset=0.0, distances=np.full(39, 10.0), distance_sigma=np.full(39, 0.02),
    ... )
    >>> bool(np.all(np.abs(seen.chain.marginals()[0][2:-3, 0] - 0.4) < 0.03))
    True
    """
    given = settings or JointSettings()
    t, z = np.asarray(time, float), np.asarray(position, float)
    R = np.asarray(covariance, float)
    m, d = z.shape
    if (increments is None) == (distances is None):
        raise EstimationError("give either displacements with their covariance or distances with their sigma")
    if R.shape != (m, d, d) or t.shape != (m,):
        raise EstimationError(
            f"{m} positions of {d} coordinates need times ({m},) and covariances ({m}, {d}, {d}); got {t.shape}, {R.shape}"
        )
    if increments is not None:
        dx, dx_covariance = np.asarray(increments, float), np.asarray(increment_covariance, float)
        root_dx = inverse_root(dx_covariance)
    else:
        way, way_sigma = np.asarray(distances, float), np.asarray(distance_sigma, float)
    root_z = np.zeros((m, d, d))
    known = np.isfinite(z).all(axis=1)
    root_z[known] = inverse_root(R[known])
    window = _Pass(curve, chain, given, d)
    window.begin(offset)
    s = float(offset)
    out = JointPass(
        t, np.empty(m), np.empty(m), np.empty((m, d)), np.empty((m, d, d)), np.full(m, np.nan), 0, chain, 0, 0
    )
    rejected = 0
    for k in range(m):
        if k:
            if increments is not None:
                s = window.displaced(k, s, dx[k - 1], root_dx[k - 1], t[k] - t[k - 1])
            else:
                s = window.moved(k, s, float(way[k - 1]), float(way_sigma[k - 1]), t[k] - t[k - 1])
        if known[k]:
            nis, used = window.seen(k, s, z[k], root_z[k])
            rejected += not used
            if used:
                out.nis[k] = nis
        s, out.offset_sigma[k], out.position[k], out.covariance[k] = window.now(k)
        out.offset[k] = s
    first, pairs, covariances = window.pairs()
    return replace(
        out,
        rejected=rejected,
        chain=chain.with_pairs(first, pairs, covariances),
        first_node=first,
        last_node=first + len(pairs),
    )


class _Pass:
    """The window of one pass and what it names: ("s", k), ("b", k), ("frame",), ("scale",), ("d", i)."""

    def __init__(self, curve: Curve, chain: MapChain, settings: JointSettings, d: int) -> None:
        self.curve, self.chain, self.settings, self.d = curve, chain, settings, d
        self.c = len(chain.mean)
        self.window = Window()
        self.roots = [inverse_root(Q) for Q in chain.Q]
        self.first = self.last = 0

    def begin(self, offset: float) -> None:
        given, w = self.settings, self.window
        if given.frame_sigma > 0.0:
            w.add(("frame",), self.d)
            w.observe({("frame",): np.eye(self.d) / given.frame_sigma}, np.zeros(self.d))
        if given.scale_sigma > 0.0:
            w.add(("scale",), 1)
            w.observe({("scale",): [[1.0 / given.scale_sigma]]}, [0.0])
        mean, covariance = self.chain.marginals()
        self.first = self.last = max(0, self.cell(offset) - CELLS_BEHIND)
        root = inverse_root(covariance[self.first])
        w.add(("d", self.first), self.c)
        w.observe({("d", self.first): root}, root @ mean[self.first])
        self.reach(offset)
        w.add(("s", 0), 1)
        w.observe({("s", 0): [[1.0 / given.offset_sigma]]}, [0.0])
        self.origin = float(offset)  # ("s", k) counts from here
        if given.coloured_sigma > 0.0:
            w.add(("b", 0), self.d)
            w.observe({("b", 0): np.eye(self.d) / given.coloured_sigma}, np.zeros(self.d))

    def cell(self, s: float) -> int:
        return int(np.floor((s - self.chain.start) / self.chain.spacing))

    def reach(self, s: float) -> None:
        """Take in the nodes up to the far end of the cell of s and the next one."""
        i = self.cell(s)
        if i < self.first or i + 1 >= len(self.chain):
            raise EstimationError(
                f"offset {s:.1f} m lies off the nodes of the map's errors, which reach from {self.chain.start:.1f} to "
                f"{self.chain.start + self.chain.spacing * (len(self.chain) - 1):.1f} m and begin at node {self.first} in this pass"
            )
        while self.last < min(i + 2, len(self.chain) - 1):
            k = self.last
            W = self.roots[k]
            self.window.add(("d", k + 1), self.c)
            self.window.observe({("d", k): -W @ self.chain.F[k], ("d", k + 1): W}, W @ self.chain.shift[k])
            self.last = k + 1

    def hats(self, s: float, E: FloatArray) -> dict[object, FloatArray]:
        """The share of each node in the error at s, in coordinates."""
        i = self.cell(s)
        u = (s - self.chain.start) / self.chain.spacing - i
        if ("d", i) not in self.window.names:
            raise EstimationError(
                f"the train stepped back to {s:.1f} m, more than {CELLS_BEHIND} cells behind its foremost place"
            )
        return {("d", i): (1.0 - u) * E, ("d", i + 1): u * E}

    def point(self, s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        c, t, E = self.curve(np.array([s]))
        return c[0], t[0], E[0]

    def _onward(self, k: int, dt: float) -> None:
        given, w = self.settings, self.window
        if given.coloured_sigma > 0.0:
            phi = float(np.exp(-dt / given.correlation_time))
            scale = 1.0 / (given.coloured_sigma * np.sqrt(max(1.0 - phi * phi, 1e-12)))
            w.add(("b", k), self.d)
            w.observe({("b", k - 1): -phi * scale * np.eye(self.d), ("b", k): scale * np.eye(self.d)}, np.zeros(self.d))

    def _leave(self, k: int, s: float) -> None:
        """Eliminate the epoch before, and nodes too far behind."""
        gone: list[object] = [("s", k - 1)]
        if self.settings.coloured_sigma > 0.0:
            gone.append(("b", k - 1))
        behind = self.cell(s) - CELLS_BEHIND
        gone += [n for n in self.window.names if isinstance(n, tuple) and n[0] == "d" and n[1] < behind]
        self.window.eliminate(gone)

    def displaced(self, k: int, s: float, dx: FloatArray, root: FloatArray, dt: float) -> float:
        """Displacement rows: [c + eta delta](s_k) - [c + eta delta](s_(k-1)) = dx."""
        c0, t0, E0 = self.point(s)
        ahead = s + float(t0 @ dx) / float(t0 @ t0)
        for _ in range(3):
            c1, t1, _E = self.point(ahead)
            ahead += float(t1 @ (c0 + dx - c1)) / float(t1 @ t1)
        c1, t1, E1 = self.point(ahead)
        self.reach(ahead)
        rows: dict[object, FloatArray] = {}
        for name, block in self.hats(ahead, E1).items():
            rows[name] = rows.get(name, 0.0) + block
        for name, block in self.hats(s, E0).items():
            rows[name] = rows.get(name, 0.0) - block
        self.window.add(("s", k), 1)
        rows[("s", k)], rows[("s", k - 1)] = t1[:, None], -t0[:, None]
        there, here = c1 - t1 * (ahead - self.origin), c0 - t0 * (s - self.origin)
        self.window.observe({n: root @ b for n, b in rows.items()}, root @ (dx - there + here))
        self._onward(k, dt)
        self._leave(k, ahead)
        return ahead

    def moved(self, k: int, s: float, way: float, sigma: float, dt: float) -> float:
        """A distance row: s_k - s_(k-1) (1 + scale) = way."""
        ahead = s + way
        self.reach(ahead)
        self.window.add(("s", k), 1)
        rows: dict[object, FloatArray] = {("s", k): np.array([[1.0 / sigma]]), ("s", k - 1): np.array([[-1.0 / sigma]])}
        if self.settings.scale_sigma > 0.0:
            rows[("scale",)] = np.array([[-way / sigma]])
        self.window.observe(rows, [way / sigma])
        self._onward(k, dt)
        self._leave(k, ahead)
        return ahead

    def seen(self, k: int, s: float, z: FloatArray, root: FloatArray) -> tuple[float, bool]:
        """Position rows: t s_k + eta delta + b + frame = z - c(s) + t s."""
        c, t, E = self.point(s)
        rows: dict[object, FloatArray] = {("s", k): t[:, None], **self.hats(s, E)}
        eye = np.eye(self.d)
        if self.settings.coloured_sigma > 0.0:
            rows[("b", k)] = eye
        if self.settings.frame_sigma > 0.0:
            rows[("frame",)] = eye
        whitened = {n: root @ b for n, b in rows.items()}
        nis = self.window.observe(whitened, root @ (z - c + t * (s - self.origin)), gate=self.settings.gate)
        return nis, nis <= self.settings.gate

    def now(self, k: int) -> tuple[float, float, FloatArray, FloatArray]:
        """Offset, its sigma, position and covariance of the train with the corrected map."""
        now = self.window.marginal()
        at, P = now.of(("s", k))
        s = self.origin + float(at[0])
        c, t, E = self.point(s)
        names = [("s", k), *self.hats(s, E)]
        J = np.hstack([t[:, None], *self.hats(s, E).values()])
        mean, C = now.of(*names)
        mean[0] = 0.0  # c is taken at the estimated offset itself
        return s, float(np.sqrt(P[0, 0])), c + J @ mean, J @ C @ J.T

    def pairs(self) -> tuple[int, FloatArray, FloatArray]:
        """Smoothed joint distributions of neighbouring nodes, from the first to the last that the pass took in."""
        found: dict[int, tuple[FloatArray, FloatArray]] = {}

        def take(marginal: WindowMarginal) -> None:
            nodes = sorted(n[1] for n in marginal.names if isinstance(n, tuple) and n[0] == "d")
            for i in nodes:
                if i + 1 in nodes and i not in found:
                    found[i] = marginal.of(("d", i), ("d", i + 1))

        for marginal in self.window.backward():
            take(marginal)
        order = sorted(found)
        return order[0], np.array([found[i][0] for i in order]), np.array([found[i][1] for i in order])


def track_curve(model: TrackModel, track: str) -> Curve:
    """Make the curve of a model's track for `joint_pass`: (easting, northing) by offset, or with heights (easting, northing, height).

    Parameters
    ----------
    model : TrackModel
    track : str

    Returns
    -------
    callable
        With one cross direction (to the right) in the plane, with a second (up) where the track has heights. Beyond the ends the
        curve goes on
        straight.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> c, t, E = track_curve(demo_line(spacing=20.0), "77R-03")(np.array([100.0, 200.0]))
    >>> c.shape, t.shape, E.shape
    ((2, 3), (2, 3), (2, 3, 2))
    """
    knots = model.knots(track)
    length = float(model.offset[knots.stop - 1])
    heights = bool(np.isfinite(model.height[knots]).all())
    step = 0.5

    def inside(s: FloatArray) -> FloatArray:
        here = model.at(track, np.clip(s, 0.0, length))
        columns = [here.easting, here.northing] + ([here.height] if heights else [])
        return np.column_stack(columns)

    def curve(s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        s = np.asarray(s, float)
        a = np.clip(s - step, 0.0, length - 2.0 * step)
        t = (inside(a + 2.0 * step) - inside(a)) / (2.0 * step)
        c = inside(s) + (s - np.clip(s, 0.0, length))[:, None] * t
        level = np.hypot(t[:, 0], t[:, 1])
        right = np.column_stack([t[:, 1] / level, -t[:, 0] / level] + ([np.zeros(len(s))] if heights else []))
        if not heights:
            return c, t, right[:, :, None]
        up = np.column_stack([np.zeros(len(s)), np.zeros(len(s)), np.ones(len(s))])
        return c, t, np.stack([right, up], axis=2)

    return curve


def _symmetric(P: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (P + np.swapaxes(P, -1, -2)))
