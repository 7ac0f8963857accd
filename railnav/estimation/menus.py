"""State menus: what a node's state holds, turned into whitened rows of a chain.

Each function takes observations with their covariances and gives a `Chain`; the estimation itself does not know what the
numbers mean. `fit_planar_curve` alone solves as well: its equations are not linear.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation.chain import Chain, as_floats
from railnav.estimation.driven import solve_driven_chain
from railnav.estimation.square_root import inverse_root

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def increment_chain(
    position: ArrayLike,
    covariance: ArrayLike,
    increment: ArrayLike,
    increment_covariance: ArrayLike,
    *,
    nominal: ArrayLike | None = None,
    prior: tuple[ArrayLike, ArrayLike] | None = None,
    root: Literal["cholesky", "symmetric"] = "cholesky",
) -> Chain:
    """Chain of the reference coordinate model: positions X_k and increments dX_k between them, with their covariances.

    K(X_k)^(-1/2) X_k and K(dX_k)^(-1/2) (X_(k+1) - X_k) = K(dX_k)^(-1/2) dX_k become unit-weight rows.

    Parameters
    ----------
    position : (N, n) array
        Observed positions, m; n is usually 3. A row with a NaN is no fix.
    covariance : (N, n, n) or (n, n) array
        Their covariances, m^2.
    increment : (N - 1, n) array
        Observed X_(k+1) - X_k, m.
    increment_covariance : (N - 1, n, n) or (n, n) array
        Their covariances, m^2, independent of each other.
    nominal : (N, n) array, optional
        Nominal positions; the states are then corrections to them, m. Give them whenever coordinates are large.
    prior : ((r, n) array, (r,) array), optional
        Whitened rows on the first state.
    root : {"cholesky", "symmetric"}
        Which inverse root whitens (equations 19-21 or Cholesky); the estimates do not depend on it.

    Returns
    -------
    Chain
        To be solved.

    Raises
    ------
    EstimationError
        Shapes do not fit, or a covariance is not positive definite.

    References
    ----------
    Specification rail 4, equations (17)-(21).

    Examples
    --------
    >>> chain = increment_chain(np.zeros((5, 3)), np.eye(3), np.zeros((4, 3)), 0.01 * np.eye(3))
    >>> len(chain), chain.n
    (5, 3)
    """
    X = as_floats("position", position)
    if X.ndim != 2 or len(X) == 0:
        raise EstimationError(f"position has shape {X.shape}, not (N, n)")
    N, n = X.shape
    dX = as_floats("increment", increment).reshape(-1, n) if N == 1 else as_floats("increment", increment)
    if dX.shape != (N - 1, n):
        raise EstimationError(f"{N} positions have {N - 1} increments between them, not {len(dX)}")
    if nominal is not None:
        x0 = as_floats("nominal", nominal)
        if x0.shape != X.shape:
            raise EstimationError(f"nominal has shape {x0.shape}; the positions have {X.shape}")
        X, dX = X - x0, dX - np.diff(x0, axis=0)
    H, z, counts = _fixes(X, covariance, root)
    W = _whitening(increment_covariance, "increment_covariance", N - 1, n, root)
    return Chain(H, z, -W, W, _apply(W, dX), counts=counts, prior=prior)


def constant_velocity_chain(
    time: ArrayLike,
    position: ArrayLike,
    covariance: ArrayLike,
    *,
    acceleration_density: float | ArrayLike,
    velocity: ArrayLike | None = None,
    velocity_covariance: ArrayLike | None = None,
    nominal: ArrayLike | None = None,
    prior: tuple[ArrayLike, ArrayLike] | None = None,
) -> Chain:
    """Chain of positions in time with nearly constant velocity: state (X, V), white acceleration (n = 6 in space).

    X+ = X + h V, V+ = V, with process noise S [[h^3/3, h^2/2], [h^2/2, h]] on each axis.

    Parameters
    ----------
    time : (N,) array
        Seconds, strictly increasing; steps may differ.
    position : (N, d) array
        Observed positions, m; a row with a NaN is no fix. The state has 2 d numbers: positions, then velocities.
    covariance : (N, d, d) or (d, d) array
        Their covariances, m^2.
    acceleration_density : float or (d,) array
        Spectral density S of the acceleration on each axis, m^2/s^3.
    velocity, velocity_covariance : (N, d), (N, d, d) or (d, d) array, optional
        Observed velocities, m/s, and their covariances; a row with a NaN is none.
    nominal : (N, 2 d) array, optional
        Nominal states; the states are then corrections to them.
    prior : ((r, 2 d) array, (r,) array), optional
        Whitened rows on the first state.

    Returns
    -------
    Chain
        To be solved.

    Raises
    ------
    EstimationError
        Time does not increase, the density is not positive, shapes do not fit, or a covariance is not positive definite.

    References
    ----------
    Specification rail 16, row n = 6 (X, V).

    Examples
    --------
    >>> chain = constant_velocity_chain([0, 1, 2], [[0.0], [1.0], [2.0]], [[0.01]], acceleration_density=0.1)
    >>> from railnav.estimation import solve_chain
    >>> solve_chain(chain, covariance=False).state[:, 1]
    array([1., 1., 1.])
    """
    t, X = as_floats("time", time), as_floats("position", position)
    if X.ndim != 2 or len(X) == 0 or t.shape != (len(X),):
        raise EstimationError(f"position has shape {X.shape} and time {t.shape}; (N, d) and (N,) fit")
    N, d = X.shape
    h = np.diff(t)
    for k in np.flatnonzero(~(h > 0))[:1]:
        raise EstimationError(
            f"time does not increase from epoch {k} ({t[k]} s) to {k + 1} ({t[k + 1]} s); sort the epochs"
        )
    S = np.broadcast_to(as_floats("acceleration_density", acceleration_density), (d,))
    if not (S > 0).all() or not np.isfinite(S).all():
        raise EstimationError(f"acceleration_density is {S.min()}; it must be positive, in m^2/s^3")
    x0 = np.zeros((N, 2 * d)) if nominal is None else as_floats("nominal", nominal)
    if x0.shape != (N, 2 * d):
        raise EstimationError(f"nominal has shape {x0.shape}; the states are ({N}, {2 * d})")
    H, z, counts = _fixes(X - x0[:, :d], covariance, "cholesky")
    H = np.concatenate([H, np.zeros_like(H)], axis=2)
    if velocity is not None:
        V = as_floats("velocity", velocity)
        if V.shape != X.shape or velocity_covariance is None:
            raise EstimationError(f"velocity has shape {V.shape}; ({N}, {d}) and velocity_covariance belong together")
        HV, zV, with_velocity = _fixes(V - x0[:, d:], velocity_covariance, "cholesky")
        H = np.broadcast_to(H, (N, d, 2 * d))
        HV = np.broadcast_to(np.concatenate([np.zeros_like(HV), HV], axis=2), (N, d, 2 * d))
        # the rows that exist come first: position, then velocity, or velocity alone
        alone = ((counts == 0) & (with_velocity > 0))[:, None]
        H = np.concatenate([np.where(alone[:, :, None], HV, H), HV], axis=1)
        z = np.concatenate([np.where(alone, zV, z), zV], axis=1)
        counts = counts + with_velocity
    # inverse upper Cholesky root of S [[h^3/3, h^2/2], [h^2/2, h]], written out: [[a, b], [0, c]]
    L = np.zeros((N - 1, 2 * d, 2 * d))
    M = np.zeros_like(L)
    a = np.sqrt(12.0 / (S * h[:, None] ** 3))
    b, c = -0.5 * a * h[:, None], 1.0 / np.sqrt(S * h[:, None])
    i = np.arange(d)
    L[:, i, i], L[:, i, d + i], L[:, d + i, d + i] = a, b, c
    M[:, i, i], M[:, i, d + i], M[:, d + i, d + i] = -a, -a * h[:, None] - b, -c
    # nominal states that do not follow the dynamics leave W (F x0_k - x0_(k+1)), small before it is whitened
    step = np.concatenate([x0[:-1, :d] + h[:, None] * x0[:-1, d:], x0[:-1, d:]], axis=1) - x0[1:]
    return Chain(H, z, M, L, _apply(L, step), counts=counts, prior=prior)


@dataclass(frozen=True, slots=True, eq=False)
class IncrementDrift:
    """Slowly changing errors delta of increments: measured dX = true + B delta + noise, delta+ = delta + w.

    Attributes
    ----------
    directions : (N - 1, d, p) or (d, p) array
        B, e.g. ds [t, dt/dbearing, dt/dgrade] for the errors of scale, bearing and grade of an odometer with gyros.
    initial_sigma : (p,) array
        Sigma of delta at the first node.
    step_sigma : (N - 1, p) or (p,) array
        Sigma of its change from one node to the next; for white noise per root metre times the root of the step.
    """

    directions: ArrayLike
    initial_sigma: ArrayLike
    step_sigma: ArrayLike


@dataclass(frozen=True, slots=True, eq=False)
class CorrelatedError:
    """Correlated error b of positions: observed X + b + white noise, b+ = exp(-h / length) b + w, stationary.

    Attributes
    ----------
    sigma : float or (d,) array
        Sigma of b, m.
    length : float
        Correlation length, in the units of `distance`.
    distance : float or (N - 1,) array
        Distance h (or time) from each node to the next.
    """

    sigma: ArrayLike
    length: float
    distance: ArrayLike


def survey_chain(
    position: ArrayLike,
    covariance: ArrayLike,
    increment: ArrayLike,
    increment_covariance: ArrayLike,
    *,
    drift: IncrementDrift | None = None,
    correlated: CorrelatedError | None = None,
    nominal: ArrayLike | None = None,
) -> Chain:
    """Chain of a survey: positions X, and with them the drifts of the increments and the correlated error of the positions.

    The state is (X, delta, b), as far as given: n = 3 without, 6 with either, 9 with both. Rows: X + b observed;
    X+ - X + B delta = dX; delta+ - delta = 0; b+ - e^(-h/length) b = 0; delta_0 and b_0 at 0.

    Parameters
    ----------
    position, covariance, increment, increment_covariance, nominal
        As in `increment_chain`; the covariances are those of the white parts. `nominal` are positions (N, d).
    drift : IncrementDrift, optional
        Errors of scale and direction of the increments.
    correlated : CorrelatedError, optional
        Error of the positions that is alike at neighbouring nodes.

    Returns
    -------
    Chain
        To be solved; the first d numbers of a state are the position (less nominal).

    Raises
    ------
    EstimationError
        Shapes do not fit, a covariance is not positive definite, or a sigma or length is not positive.

    Notes
    -----
    What is correlated must not be called white: an error of 10 mm over 300 m taken as white claims 3.4 mm where 15 mm is true.
    Constants (a scale that does not change) are better kept in `solve_bordered_chain`.

    References
    ----------
    Specification rail 16, rows n = 6 and n = 9.

    Examples
    --------
    >>> still = np.zeros((4, 3))
    >>> drift = IncrementDrift(np.eye(3), [1e-3] * 3, [1e-5] * 3)
    >>> error = CorrelatedError(0.01, 300.0, 1.0)
    >>> survey_chain(np.zeros((5, 3)), np.eye(3), still, np.eye(3), drift=drift, correlated=error).n
    9
    """
    base = increment_chain(position, covariance, increment, increment_covariance, nominal=nominal)
    N, d = len(base), base.n
    if drift is None and correlated is None:
        return base
    links = N - 1
    H, M, L = base.H, base.M, base.L
    sizes = [d]
    variances: list[FloatArray] = []
    steps: list[FloatArray] = []
    decays: list[FloatArray] = []
    B = np.zeros((1, d, 0))
    if drift is not None:
        B = as_floats("directions", drift.directions)
        B = B[np.newaxis] if B.ndim == 2 else B
        if B.ndim != 3 or B.shape[1] != d or len(B) not in (1, links) or B.shape[2] == 0:
            raise EstimationError(
                f"directions have shape {np.shape(drift.directions)}; ({links}, {d}, p) fits the increments"
            )
        p = B.shape[2]
        sizes.append(p)
        variances.append(_sigmas("initial_sigma", drift.initial_sigma, (p,)))
        steps.append(np.broadcast_to(_sigmas("step_sigma", drift.step_sigma, (p,), links), (links, p)))
        decays.append(np.ones((links, p)))
    if correlated is not None:
        sizes.append(d)
        sigma = np.broadcast_to(_sigmas("sigma", correlated.sigma, (d,)), (d,))
        h = np.broadcast_to(_sigmas("distance", correlated.distance, (), links), (links,))
        if not correlated.length > 0:
            raise EstimationError(f"the correlation length is {correlated.length}; it must be positive")
        decay = np.exp(-h / correlated.length)[:, None] * np.ones(d)
        variances.append(sigma)
        steps.append(sigma * np.sqrt(-np.expm1(-2 * h / correlated.length))[:, None])
        decays.append(decay)
    extra = sum(sizes) - d
    H = np.concatenate([H, np.zeros((len(H), d, extra))], axis=2)
    if correlated is not None:
        H[:, :, -d:] = base.H
    W = np.broadcast_to(L, (links, d, d))
    inverse = 1.0 / np.concatenate(steps, axis=1)
    i = np.arange(extra)
    wide_M, wide_L = np.zeros((links, d + extra, d + extra)), np.zeros((links, d + extra, d + extra))
    wide_M[:, :d, :d], wide_L[:, :d, :d] = M, L
    wide_M[:, :d, d : d + B.shape[2]] = W @ B
    wide_M[:, d + i, d + i] = -np.concatenate(decays, axis=1) * inverse
    wide_L[:, d + i, d + i] = inverse
    u = np.concatenate([np.broadcast_to(base.u, (links, d)), np.zeros((links, extra))], axis=1)
    prior = np.concatenate([np.zeros((extra, d)), np.diag(1.0 / np.concatenate(variances))], axis=1)
    return Chain(H, base.z, wide_M, wide_L, u, counts=base.counts, prior=(prior, np.zeros(extra)))


@dataclass(frozen=True, slots=True, eq=False)
class PlanarCurve:
    """A plane curve estimated through its curvature.

    Attributes
    ----------
    state : (N, 4) array
        x, y, bearing psi, curvature kappa at each node.
    covariance : (N, 4, 4) array
        Their covariances.
    nis, dof : (N,) array
        As in `ChainSolution`.
    iterations : int
        Gauss-Newton steps taken.
    """

    state: FloatArray
    covariance: FloatArray
    nis: FloatArray
    dof: IntArray
    iterations: int

    @property
    def unit_weight_rms(self) -> float:
        """Root of the sum of squares per redundant row; well above 1 if the curvature may not change as fast as it does."""
        return float(np.sqrt(self.nis.sum() / self.dof.sum()))


def fit_planar_curve(
    step: ArrayLike,
    position: ArrayLike,
    covariance: ArrayLike,
    *,
    curvature_density: float,
    curvature: ArrayLike | None = None,
    curvature_sigma: ArrayLike | None = None,
    initial: ArrayLike | None = None,
    tolerance: float = 1e-8,
    most: int = 20,
) -> PlanarCurve:
    """Estimate a plane curve whose curvature changes at random, from positions and measured curvatures (Gauss-Newton).

    x+ = x + h cos m, y+ = y + h sin m, psi+ = psi + h kappa, kappa+ = kappa + w with m = psi + h kappa / 2 and
    w ~ N(0, density^2 h). Only the curvature is noisy: a chain driven by one noise (`solve_driven_chain`).

    Parameters
    ----------
    step : float or (N - 1,) array
        Arc length h from each node to the next, m.
    position : (N, 2) array
        Observed x, y, m; a row with a NaN is no fix. psi turns from x towards y: give (northing, easting) for grid bearings
        and curvature to the right.
    covariance : (N, 2, 2) or (2, 2) array
        Their covariances, m^2.
    curvature_density : float
        What the curvature may change by in a root metre, 1/m per root m: at least the largest |dkappa/ds| times one root metre.
    curvature, curvature_sigma : (N,) array, float or (N,) array, optional
        Measured curvatures, 1/m (a NaN is none), and their sigma.
    initial : (N, 4) array, optional
        Where to start; by default positions are interpolated between the fixes.
    tolerance : float
        Largest correction, m, rad and 1/m, of a step that is the last.
    most : int
        Steps after which it is given up.

    Returns
    -------
    PlanarCurve
        States with covariances.

    Raises
    ------
    EstimationError
        Shapes do not fit, fewer than two fixes, a sigma is not positive, or the iteration does not end.

    Notes
    -----
    Nodes 1 m apart, fixes of 2 cm every 10 m, measured curvature 2e-4: about 8 mm across, 0.3 mrad, 2.4e-5 1/m. From the
    interpolated start 4 to 6 steps.

    References
    ----------
    Specification rail 16, row n = 4.

    Examples
    --------
    >>> x = np.column_stack([np.arange(50.0), np.zeros(50)])
    >>> curve = fit_planar_curve(1.0, x, 1e-4 * np.eye(2), curvature_density=1e-4)
    >>> bool(np.abs(curve.state[:, 1:]).max() < 1e-9)
    True
    """
    X = as_floats("position", position)
    if X.ndim != 2 or X.shape[1] != 2 or len(X) < 2:
        raise EstimationError(f"position has shape {X.shape}; (N, 2) with at least two nodes fits")
    N = len(X)
    h = np.broadcast_to(_sigmas("step", step, (), N - 1), (N - 1,))
    if not curvature_density > 0:
        raise EstimationError(f"curvature_density is {curvature_density}; it must be positive")
    H_fix, _, counts = _fixes(X, covariance, "cholesky")
    present = counts > 0
    if present.sum() < 2:
        raise EstimationError(f"{int(present.sum())} fixes do not place a curve; at least two do")
    rows = np.zeros((N, 3, 4))
    rows[:, :2, :2] = np.where(present[:, None, None], H_fix, 0.0)
    measured = np.full(N, np.nan)
    if curvature is not None:
        measured = as_floats("curvature", curvature)
        if measured.shape != (N,) or curvature_sigma is None:
            raise EstimationError(f"curvature has shape {measured.shape}; ({N},) and curvature_sigma belong together")
        inverse = 1.0 / np.broadcast_to(_sigmas("curvature_sigma", curvature_sigma, (), N), (N,))
        rows[:, 2, 3] = np.where(np.isfinite(measured), inverse, 0.0)
    x = _start(X, present, h) if initial is None else np.array(initial, np.float64)
    if x.shape != (N, 4) or not np.isfinite(x).all():
        raise EstimationError(f"initial has shape {x.shape}; finite ({N}, 4) fits")
    G = np.zeros((N - 1, 4, 1))
    G[:, 3, 0] = curvature_density * np.sqrt(h)
    z = np.zeros((N, 3))
    for iteration in range(1, most + 1):
        ahead, F = _curve_step(x[:-1], h)
        z[:, :2] = np.where(
            present[:, None], np.einsum("kij,kj->ki", rows[:, :2, :2], np.nan_to_num(X - x[:, :2])), 0.0
        )
        z[:, 2] = rows[:, 2, 3] * np.nan_to_num(measured - x[:, 3])
        solution = solve_driven_chain(rows, z, F, G, g=ahead - x[1:])
        x = x + solution.state
        if np.abs(solution.state).max() < tolerance:
            return PlanarCurve(x, solution.covariance, solution.nis, solution.dof, iteration)
    raise EstimationError(
        f"the curve does not settle in {most} steps (last correction {np.abs(solution.state).max():.2g}); "
        "give a better initial, or look for gross errors in the positions"
    )


def _curve_step(x: FloatArray, h: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The next states of a plane curve, and their derivatives by the states."""
    middle = x[:, 2] + 0.5 * h * x[:, 3]
    sin, cos = np.sin(middle), np.cos(middle)
    F = np.zeros((len(x), 4, 4))
    F[:] = np.eye(4)
    F[:, 0, 2], F[:, 1, 2], F[:, 2, 3] = -h * sin, h * cos, h
    F[:, 0, 3], F[:, 1, 3] = -0.5 * h * h * sin, 0.5 * h * h * cos
    return x + np.column_stack([h * cos, h * sin, h * x[:, 3], np.zeros(len(x))]), F


def _start(X: FloatArray, present: BoolArray, h: FloatArray) -> FloatArray:
    """Positions interpolated between fixes, bearings of the chords, no curvature."""
    s = np.concatenate([[0.0], np.cumsum(h)])
    fixes = np.flatnonzero(present)
    x, y = (np.interp(s, s[fixes], X[fixes, i]) for i in (0, 1))
    chords = np.diff(X[fixes], axis=0)
    bearing = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
    return np.column_stack([x, y, np.interp(s, 0.5 * (s[fixes[:-1]] + s[fixes[1:]]), bearing), np.zeros(len(s))])


def _sigmas(name: str, value: ArrayLike, shape: tuple[int, ...], links: int | None = None) -> FloatArray:
    """Positive numbers: one, one a component, and (links given) one of either a link."""
    out = as_floats(name, value)
    fits = [(), shape] if links is None else [(), shape, (links, *shape)]
    if out.shape not in fits:
        raise EstimationError(f"{name} has shape {out.shape}; {fits[-1]} fits")
    if out.size and not ((out > 0).all() and np.isfinite(out).all()):
        raise EstimationError(
            f"{name} is {out.min():.3g} somewhere; it must be positive and finite; use 1e-9 rather than 0"
        )
    return np.broadcast_to(out, shape) if out.ndim < len(shape) else out


def _fixes(
    X: FloatArray, covariance: ArrayLike, root: Literal["cholesky", "symmetric"]
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Whitened observation rows H, z and counts; a row of X with a NaN is no fix."""
    N, n = X.shape
    present: BoolArray = np.asarray(~np.isnan(X).any(axis=1))
    K = np.asarray(covariance, dtype=np.float64)
    if K.ndim == 3 and not present.all():
        if len(K) == N:
            K = np.where(present[:, None, None], K, np.eye(n))
        X = np.where(present[:, None], X, 0.0)
    elif not present.all():
        X = np.where(present[:, None], X, 0.0)
    W = _whitening(K, "covariance", N, n, root)
    return W, _apply(W, X), np.where(present, n, 0).astype(np.int64)


def _whitening(covariance: ArrayLike, name: str, N: int, n: int, root: Literal["cholesky", "symmetric"]) -> FloatArray:
    K = np.asarray(covariance, dtype=np.float64)
    if K.shape not in ((n, n), (N, n, n)):
        raise EstimationError(f"{name} has shape {K.shape}; ({N}, {n}, {n}) or ({n}, {n}) fits")
    return inverse_root(K.reshape(-1, n, n), method=root)


def _apply(W: FloatArray, v: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("kij,kj->ki", np.broadcast_to(W, (len(v), *W.shape[1:])), v))
