"""Square roots of covariances: whitening, and a Kalman filter and smoother that never form a covariance.

`P_sqrt` is lower triangular with a positive diagonal and P = P_sqrt P_sqrt^T; a state known exactly has a zero column. Every
step is one orthogonal triangularisation, so a covariance can never lose its positive sign, whatever the rounding. Live loops
call the kernels of the same names in `railnav.estimation._kernels`; these functions validate, explain and leave their
arguments alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation import _kernels

FloatArray = NDArray[np.float64]

#: Relative asymmetry or negative part of a covariance that still counts as rounding and may be repaired.
REPAIR_LIMIT = 1e-6
#: A repaired covariance keeps at least this fraction of the largest eigenvalue of its correlations (rail 26.4).
EIGENVALUE_FLOOR = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class RepairedCovariance:
    """Covariances made symmetric and positive definite, and which of them needed it.

    Attributes
    ----------
    covariance : (..., n, n) array
        Symmetric positive definite.
    repaired : (...) bool array
        Where a matrix was changed by more than rounding of the last place.
    """

    covariance: FloatArray
    repaired: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """A state after a block of measurements, and what the block said of it.

    Attributes
    ----------
    state : (n,) array
        Updated state.
    P_sqrt : (n, n) array
        Root of its covariance.
    innovation : (m,) array
        Measured - predicted.
    S_sqrt : (m, m) array
        Root of the innovation's covariance, lower triangular.
    nis : float
        Normalised innovation squared, nu^T S^-1 nu; chi-square with m degrees of freedom if the model holds.
    log_evidence : float
        ln p(block | past), with the units of the raw measurement.
    """

    state: FloatArray
    P_sqrt: FloatArray
    innovation: FloatArray
    S_sqrt: FloatArray
    nis: float
    log_evidence: float


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A state smoothed by all later data.

    Attributes
    ----------
    state : (n,) array
        Smoothed state.
    P_sqrt : (n, n) array
        Root of its covariance.
    gain : (n, n) array
        G of the step: cov(x_k, x_(k+1) | all) = G P_(k+1 | all).
    """

    state: FloatArray
    P_sqrt: FloatArray
    gain: FloatArray


def repair_covariance(covariance: ArrayLike) -> RepairedCovariance:
    """Make covariances symmetric and positive definite where rounding has spoilt them, and say which.

    A matrix is scaled to correlations, its eigenvalues are lifted to 1e-12 of the largest, and it is scaled back: units do
    not matter. What is wrong by more than rounding (1e-6) is refused, not repaired.

    Parameters
    ----------
    covariance : (..., n, n) array
        Covariances as they came.

    Returns
    -------
    RepairedCovariance
        The matrices and a flag for each.

    Raises
    ------
    EstimationError
        A variance is zero or negative, a value is not finite, or a matrix is asymmetric or indefinite beyond 1e-6.

    References
    ----------
    Specification rail 26.4.

    Examples
    --------
    >>> repair_covariance([[1.0, 1.0], [1.0, 1.0]]).repaired
    array(True)
    """
    K = _square(covariance)
    flat = K.reshape(-1, *K.shape[-2:])
    diagonal = np.einsum("kii->ki", flat)
    for k in np.flatnonzero(~np.isfinite(flat).all(axis=(1, 2)))[:1]:
        raise EstimationError(f"covariance {k} is not finite; leave that measurement out")
    for k in np.flatnonzero((diagonal <= 0).any(axis=1))[:1]:
        raise EstimationError(_zero_sigma(int(k), diagonal[k]))
    scale = np.sqrt(diagonal)
    correlation = flat / (scale[:, :, None] * scale[:, None, :])
    asymmetry = np.abs(correlation - np.swapaxes(correlation, 1, 2)).max(axis=(1, 2), initial=0.0)
    for k in np.flatnonzero(asymmetry > REPAIR_LIMIT)[:1]:
        raise EstimationError(
            f"covariance {k} is not symmetric (correlations differ by {asymmetry[k]:.2g}); give both halves alike"
        )
    correlation = (correlation + np.swapaxes(correlation, 1, 2)) / 2
    values, vectors = np.linalg.eigh(correlation)
    for k in np.flatnonzero(values[:, 0] < -REPAIR_LIMIT * values[:, -1])[:1]:
        raise EstimationError(
            f"covariance {k} is none: an eigenvalue of its correlations is {values[k, 0]:.2g}; a correlation is too large"
        )
    floor = EIGENVALUE_FLOOR * values[:, -1:]
    low = (values < floor).any(axis=1)
    repaired = low | (asymmetry > 1e-14)
    out = np.array((flat + np.swapaxes(flat, 1, 2)) / 2)
    if low.any():
        lifted = np.einsum("kij,kj,klj->kil", vectors[low], np.maximum(values[low], floor[low]), vectors[low])
        lifted = (lifted + np.swapaxes(lifted, 1, 2)) / 2
        out[low] = lifted * scale[low][:, :, None] * scale[low][:, None, :]
    return RepairedCovariance(out.reshape(K.shape), repaired.reshape(K.shape[:-2]))


def inverse_root(covariance: ArrayLike, *, method: Literal["cholesky", "symmetric"] = "cholesky") -> FloatArray:
    """Whiten: a matrix W with W^T W = K^-1 for each covariance K, so that W v has unit covariance.

    ``cholesky`` gives W = U^-1 with K = U U^T, upper triangular, the fast default; ``symmetric`` gives
    K^(-1/2) = V diag(lambda)^(-1/2) V^T by eigenvectors, the source's form. Estimates, covariances and the sum of squares of
    a block do not depend on the choice; single residuals do.

    Parameters
    ----------
    covariance : (..., n, n) array
        Symmetric positive definite; only the lower triangle is read.
    method : {"cholesky", "symmetric"}
        Which root.

    Returns
    -------
    (..., n, n) array
        W.

    Raises
    ------
    EstimationError
        A covariance is not positive definite (`repair_covariance` mends rounding), or a sigma is zero.

    Notes
    -----
    Upper and not lower, because a chain keeps its triangles upper: the zeros then survive its rotations, and are skipped.

    References
    ----------
    Specification rail, equations (19)-(21); its default is the lower factor.

    Examples
    --------
    >>> inverse_root([[4.0, 0.0], [0.0, 0.25]])
    array([[0.5, 0. ],
           [0. , 2. ]])
    """
    K = _square(covariance)
    flat = np.require(K.reshape(-1, *K.shape[-2:]), requirements=["C", "W"])  # read-only arrays would compile anew
    out = np.empty_like(flat)
    bad = _kernels.inverse_cholesky_kernel(flat, out)
    if bad >= 0:
        diagonal = np.diagonal(flat[bad])
        if not np.isfinite(flat[bad]).all():
            raise EstimationError(f"covariance {bad} is not finite; leave that measurement out")
        if (diagonal <= 0).any():
            raise EstimationError(_zero_sigma(bad, diagonal))
        raise EstimationError(
            f"covariance {bad} is not positive definite; repair_covariance mends what is wrong by rounding only"
        )
    if method == "symmetric":
        values, vectors = np.linalg.eigh(flat)
        out = np.einsum("kij,kj,klj->kil", vectors, 1.0 / np.sqrt(values), vectors)
    return out.reshape(K.shape)


def lower_root(covariance: ArrayLike) -> FloatArray:
    """Lower-triangular root of one covariance, which may be singular: zero variances are allowed here.

    Parameters
    ----------
    covariance : (n, n) array
        Symmetric positive semi-definite.

    Returns
    -------
    (n, n) array
        P_sqrt with P_sqrt P_sqrt^T the covariance; a zero column for each direction known exactly.

    Raises
    ------
    EstimationError
        The matrix is not symmetric or has a negative eigenvalue beyond rounding.

    Examples
    --------
    >>> lower_root([[4.0, 2.0], [2.0, 1.0]])
    array([[2., 0.],
           [1., 0.]])
    """
    P = _square(covariance)
    n = P.shape[-1]
    if P.ndim != 2 or not np.isfinite(P).all():
        raise EstimationError(f"a root needs one finite (n, n) covariance, not shape {P.shape}")
    diagonal = np.diagonal(P)
    if (diagonal < 0).any():
        raise EstimationError(f"variance {int(np.argmin(diagonal))} is negative ({diagonal.min():.3g})")
    scale = np.where(diagonal > 0, np.sqrt(diagonal), 1.0)
    correlation = P / np.outer(scale, scale)
    if np.abs(correlation - correlation.T).max(initial=0.0) > REPAIR_LIMIT:
        raise EstimationError("the covariance is not symmetric; give both halves alike")
    try:
        return np.asarray(np.linalg.cholesky(P), dtype=np.float64)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh((correlation + correlation.T) / 2)
    if values[0] < -REPAIR_LIMIT * max(values[-1], 1.0):
        raise EstimationError(f"the covariance has a negative eigenvalue ({values[0]:.2g} of its correlations)")
    kept = values > EIGENVALUE_FLOOR * values[-1]
    A = np.ascontiguousarray(np.where(kept, vectors * np.sqrt(np.maximum(values, 0.0)), 0.0))
    _kernels.triangularize_rows(A, n)
    return np.asarray(A * scale[:, None])


def predict(P_sqrt: ArrayLike, F: ArrayLike, Q_sqrt: ArrayLike) -> FloatArray:
    """Carry the root of a covariance over one step, P becomes F P F^T + Q, by one triangularisation of [F P_sqrt, Q_sqrt].

    Parameters
    ----------
    P_sqrt : (n, n) array
        Root of the covariance, lower triangular.
    F : (n, n) array
        Transition matrix; may be singular.
    Q_sqrt : (n, q) array
        Any root of the process noise, q of any size: singular noise needs no special care.

    Returns
    -------
    (n, n) array
        Root of the predicted covariance.

    Raises
    ------
    EstimationError
        Shapes do not fit, or a value is not finite.

    Examples
    --------
    >>> predict([[1.0, 0.0], [0.0, 1.0]], [[1.0, 1.0], [0.0, 1.0]], [[0.0], [1.0]]).round(6)
    array([[1.414214, 0.      ],
           [0.707107, 1.224745]])
    """
    root = _lower("P_sqrt", P_sqrt)
    n = len(root)
    _kernels.predict_kernel(root, _matrix("F", F, (n, n)), _matrix("Q_sqrt", Q_sqrt, (n, None)))
    return root


def update(state: ArrayLike, P_sqrt: ArrayLike, innovation: ArrayLike, H: ArrayLike, R_sqrt: ArrayLike) -> Update:
    """Let a block of measurements into a state by one triangularisation of the array of roots.

    The array [[R_sqrt, H P_sqrt], [0, P_sqrt]] becomes [[S_sqrt, 0], [K S_sqrt, P_sqrt+]]; NIS = |S_sqrt^-1 nu|^2 and
    ln p = -(NIS + ln det S + m ln 2 pi) / 2.

    Parameters
    ----------
    state : (n,) array
        Predicted state.
    P_sqrt : (n, n) array
        Root of its covariance, lower triangular.
    innovation : (m,) array
        Measured - predicted, z - h(state).
    H : (m, n) array
        Derivatives of the measurement by the state.
    R_sqrt : (m, r) array
        Any root of the measurement covariance, r >= m.

    Returns
    -------
    Update
        New state, roots, NIS and evidence.

    Raises
    ------
    EstimationError
        Shapes do not fit, a value is not finite, or a measurement is claimed to be perfect (a sigma of zero).

    References
    ----------
    Specification rail 15.4.

    Examples
    --------
    >>> after = update([0.0], [[1.0]], [2.0], [[1.0]], [[1.0]])
    >>> round(float(after.state[0]), 6), round(float(after.P_sqrt[0, 0]), 6), round(after.nis, 6)
    (1.0, 0.707107, 2.0)
    """
    root = _lower("P_sqrt", P_sqrt)
    n = len(root)
    x = _vector("state", state, n)
    nu = _vector("innovation", innovation, None)
    m = len(nu)
    rows = _matrix("H", H, (m, n))
    noise = _matrix("R_sqrt", R_sqrt, (m, None))
    if np.linalg.matrix_rank(noise) < m:
        raise EstimationError(
            "a measurement is claimed to be perfect (singular R_sqrt); use a sigma of 1e-6 instead of 0"
        )
    S_sqrt = np.empty((m, m))
    nis, logdet = _kernels.update_kernel(x, root, nu, rows, noise, S_sqrt)
    return Update(x, root, nu, S_sqrt, float(nis), -0.5 * float(nis + logdet + m * np.log(2 * np.pi)))


def smooth(
    state: ArrayLike,
    P_sqrt: ArrayLike,
    F: ArrayLike,
    Q_sqrt: ArrayLike,
    *,
    predicted: ArrayLike,
    smoothed: ArrayLike,
    P_sqrt_smoothed: ArrayLike,
) -> Smoothed:
    """Carry the smoothed next state back by one step (Rauch-Tung-Striebel), in roots.

    [[F P_sqrt, Q_sqrt], [P_sqrt, 0]] becomes [[P_sqrt-, 0], [A, B]]; then G = A (P_sqrt-)^-1, x + G (smoothed - predicted),
    and [B, G P_sqrt_smoothed] is triangularised: sums of squares only, no difference of covariances.

    Parameters
    ----------
    state, P_sqrt : (n,), (n, n) array
        Filtered state here and the root of its covariance.
    F, Q_sqrt : (n, n), (n, q) array
        The step from here to the next state.
    predicted : (n,) array
        The next state as predicted from here.
    smoothed, P_sqrt_smoothed : (n,), (n, n) array
        The next state, smoothed.

    Returns
    -------
    Smoothed
        The state here, smoothed, and the gain.

    Raises
    ------
    EstimationError
        Shapes do not fit, or a value is not finite.

    Examples
    --------
    >>> root = [[1.0]]
    >>> back = smooth([0.0], root, root, root, predicted=[0.0], smoothed=[1.0], P_sqrt_smoothed=[[0.5]])
    >>> float(round(back.state[0], 6)), float(round(back.P_sqrt[0, 0] ** 2, 6))
    (0.5, 0.5625)
    """
    root = _lower("P_sqrt", P_sqrt)
    n = len(root)
    x = _vector("state", state, n)
    gain = np.empty((n, n))
    _kernels.smooth_kernel(
        x,
        root,
        _matrix("F", F, (n, n)),
        _matrix("Q_sqrt", Q_sqrt, (n, None)),
        _vector("predicted", predicted, n),
        _vector("smoothed", smoothed, n),
        _lower("P_sqrt_smoothed", P_sqrt_smoothed, n),
        gain,
    )
    return Smoothed(x, root, gain)


def _zero_sigma(index: int, diagonal: FloatArray) -> str:
    i = int(np.argmin(diagonal))
    return (
        f"covariance {index} claims a perfect measurement (variance {i} is {diagonal[i]:.3g}); "
        "use a sigma of 1e-6 instead of 0"
    )


def _square(value: ArrayLike) -> FloatArray:
    K = np.asarray(value, dtype=np.float64)
    if K.ndim < 2 or K.shape[-1] != K.shape[-2] or K.shape[-1] == 0:
        raise EstimationError(f"covariances have shape (..., n, n), not {K.shape}")
    return K


def _matrix(name: str, value: ArrayLike, shape: tuple[int, int | None]) -> FloatArray:
    out = np.array(value, dtype=np.float64, order="C")
    if out.ndim != 2 or out.shape[0] != shape[0] or shape[1] not in (None, out.shape[1]):
        raise EstimationError(f"{name} has shape {out.shape}; {shape[0]} x {shape[1] or 'any'} fits the state")
    if not np.isfinite(out).all():
        raise EstimationError(f"{name} is not finite")
    return out


def _vector(name: str, value: ArrayLike, n: int | None) -> FloatArray:
    out = np.array(value, dtype=np.float64)
    if out.ndim != 1 or n not in (None, out.size):
        raise EstimationError(f"{name} has shape {out.shape}; a vector of {n or 'any length'} fits the state")
    if not np.isfinite(out).all():
        raise EstimationError(f"{name} is not finite")
    return out


def _lower(name: str, value: ArrayLike, n: int | None = None) -> FloatArray:
    out = np.array(value, dtype=np.float64, order="C")
    if out.ndim != 2 or out.shape[0] != out.shape[1] or n not in (None, len(out)):
        raise EstimationError(f"{name} has shape {out.shape}; a square root is n x n")
    if not np.isfinite(out).all():
        raise EstimationError(f"{name} is not finite")
    if np.triu(out, 1).any() or (np.diagonal(out) < 0).any():
        raise EstimationError(f"{name} is not lower triangular with a positive diagonal; lower_root makes one")
    return out
