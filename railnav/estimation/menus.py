"""State menus: what a node's state holds, turned into whitened rows of a chain.

Each function takes observations with their covariances and gives a `Chain`; the estimation itself does not know what the
numbers mean.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation.chain import Chain, as_floats
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
