"""Calibration of an inertial triad at rest or on a rate table: bias, scale, cross-axis terms, each with its sigma.

Every method gives the same thing: true = matrix @ (measured - bias). A position is a mean reading, a reference is what the triad should
have read there: the local gravity (accelerometers, specific force points up) or the rate of the table (gyros: the "modified" methods).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.inertial._shapes import positive, rows, three
from railnav.inertial.advice import advise_positions, axes_up, norm_rows
from railnav.inertial.turns import solvability, too_few_turns
from railnav.units import STANDARD_GRAVITY

FloatArray = NDArray[np.float64]
Form = Literal["symmetric", "lower"]

#: Singular values below this share of the largest count as zero: that combination of parameters is not determined.
RANK_TOLERANCE = 1e-4
#: Elements of the calibration matrix that each form of `multi_position` leaves free.
_FREE: dict[str, tuple[tuple[tuple[int, int], ...], ...]] = {
    "symmetric": (
        ((0, 0),),
        ((1, 1),),
        ((2, 2),),
        ((0, 1), (1, 0)),
        ((0, 2), (2, 0)),
        ((1, 2), (2, 1)),
    ),
    "lower": (((0, 0),), ((1, 1),), ((2, 2),), ((1, 0),), ((2, 0),), ((2, 1),)),
}


@dataclass(frozen=True, slots=True, eq=False)
class TriadCalibration:
    """What turns the readings of a triad into the true vector: true = matrix @ (measured - bias).

    Attributes
    ----------
    method : str
        How it was found.
    bias : (3,) array
        Unit of the readings.
    matrix : (3, 3) array
        Inverse of (I + scale errors + cross-axis terms).
    covariance : (12, 12) array or None
        Of bias and matrix (row by row); elements that the method holds fixed have none. None if no sigma was given and no reading is
        left over to estimate it from.
    residual : float
        Root mean square of what the readings still miss the reference by, unit; 0 if none is left over.
    positions, rank : int
        Positions used, parameters determined.
    condition : float
        Of the scaled design matrix: 1 is ideal, above some 30 the positions are poorly chosen.

    Examples
    --------
    >>> unit = six_position([10.0, 10.1, 9.9], [-9.8, -9.5, -9.7], 9.8)
    >>> unit.bias.round(6), unit.scale.round(6)
    (array([0.1, 0.3, 0.1]), array([0.010204, 0.      , 0.      ]))
    """

    method: str
    bias: FloatArray
    matrix: FloatArray
    covariance: FloatArray | None
    residual: float
    positions: int
    rank: int
    condition: float

    @property
    def response(self) -> FloatArray:
        """I + scale errors + cross-axis terms, (3, 3): measured = response @ true + bias."""
        return np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)

    @property
    def scale(self) -> FloatArray:
        """Scale errors K, the diagonal of the response less 1, (3,)."""
        return np.diagonal(self.response) - 1.0

    @property
    def sigma_bias(self) -> FloatArray | None:
        """Standard deviations of the bias, (3,)."""
        return None if self.covariance is None else np.sqrt(np.diagonal(self.covariance)[:3])

    @property
    def sigma_matrix(self) -> FloatArray | None:
        """Standard deviations of the matrix, (3, 3); 0 for elements held fixed."""
        return None if self.covariance is None else np.sqrt(np.diagonal(self.covariance)[3:]).reshape(3, 3)

    def apply(self, measured: ArrayLike) -> FloatArray:
        """Correct readings, (..., 3) -> (..., 3).

        Raises
        ------
        ValueError
            The last axis is not 3.
        """
        v = np.asarray(measured, dtype=np.float64)
        if v.ndim < 1 or v.shape[-1] != 3:
            raise ValueError(f"readings must have the shape (..., 3), not {v.shape}")
        return np.asarray((v - self.bias) @ self.matrix.T)


def six_position(up: ArrayLike, down: ArrayLike, reference: float, *, sigma: float | None = None) -> TriadCalibration:
    """Bias and scale from six levelled positions: each axis up and down (or turned both ways on a rate table).

    b = (up + down)/2, K = (up - down)/(2 g) - 1.

    Parameters
    ----------
    up, down : (3,) array
        Reading of each axis with that axis up, and down. For gyros: turned at +rate and -rate about it (the modified method).
    reference : float
        Local gravity, or rate of the table, in the unit of the readings.
    sigma : float, optional
        Of a mean reading; without it there is no covariance, as no reading is left over.

    Returns
    -------
    TriadCalibration
        With a diagonal matrix: six positions read by their own axis say nothing of cross-axis terms.

    Raises
    ------
    ValueError
        Wrong shape, not finite, a reference that is not positive.
    EstimationError
        Scale errors beyond a half: wrong unit, swapped up and down, or wrong axes.

    Notes
    -----
    The source prints K = 1 - (up - down)/(2 g), the opposite sign. A tilt t of the table makes the scale wrong by t^2/2 (1.5e-4 at one
    degree).

    References
    ----------
    `spec/inertial.md` B11, KZ(2.27), KZ(2.28).

    Examples
    --------
    >>> six_position([1.01, 1.02, 1.0], [-0.99, -1.0, -1.0], 1.0).bias.round(6)
    array([0.01, 0.01, 0.  ])
    """
    u, d = (three(name, v) for name, v in (("up", up), ("down", down)))
    g = positive("reference", reference)
    _check_unit(np.abs(u - d) / 2.0, np.full(3, g))
    K = (u - d) / (2.0 * g) - 1.0
    for axis in np.flatnonzero(np.abs(K) > 0.5)[:1]:
        raise EstimationError(
            f"axis {'xyz'[axis]} reads {u[axis]:g} up and {d[axis]:g} down against a reference of {g:g}: check which way was up"
        )
    covariance = None
    if sigma is not None:
        variance = positive("sigma", sigma) ** 2
        covariance = np.zeros((12, 12))
        for i in range(3):
            covariance[i, i] = variance / 2.0
            covariance[3 + 4 * i, 3 + 4 * i] = variance / (2.0 * g * g) / (1.0 + K[i]) ** 4
    return TriadCalibration("six-position", (u + d) / 2.0, np.diag(1.0 / (1.0 + K)), covariance, 0.0, 6, 6, 1.0)


def multi_position(
    readings: ArrayLike, reference: float | ArrayLike, *, form: Form = "symmetric", sigma: float | None = None
) -> TriadCalibration:
    """Bias, scale and non-orthogonality from nine or more positions at any attitude, by |matrix (reading - bias)| = reference.

    Parameters
    ----------
    readings : (m, 3) array
        Mean readings, m at least 9, spread over the sphere.
    reference : float or (m,) array
        Local gravity, or (gyros, the modified method) rate of the table in each run, in the unit of the readings.
    form : {"symmetric", "lower"}, optional
        Which of the matrices that differ by a rotation is given: the symmetric one, or the lower triangular one, whose x axis lies
        along the x sensor and whose y axis in the plane of the x and y sensors.
    sigma : float, optional
        Of a mean reading. By default it is estimated from the residuals, if m exceeds 9.

    Returns
    -------
    TriadCalibration

    Raises
    ------
    ValueError
        Wrong shape or form, a value that is not finite.
    EstimationError
        Fewer than nine positions, or positions that leave a parameter undetermined (says which to add); wrong unit; no convergence.

    Notes
    -----
    A rotation of the whole triad against its case cannot be seen by any method that uses lengths only. Nine positions leave errors of
    0.7 to 1.3 times a reading's sigma, 24 of 0.4 to 0.6.

    References
    ----------
    `spec/inertial.md` B11, KZ(2.29), KZ(2.30).

    Examples
    --------
    >>> directions = np.array([*np.eye(3), *-np.eye(3), *((1, 1, 0), (1, 0, 1), (0, 1, 1)) / np.sqrt(2)])
    >>> multi_position(1.02 * directions + [0.1, 0.0, 0.0], 1.0).bias.round(9)
    array([0.1, 0. , 0. ])
    """
    if form not in _FREE:
        raise ValueError(f"form is 'symmetric' or 'lower', not {form!r}")
    V = rows("readings", readings)
    g = np.broadcast_to(np.asarray(reference, dtype=np.float64), (len(V),))
    if not (np.isfinite(g).all() and np.all(g > 0.0)):
        raise ValueError("reference must be positive and finite")
    unit = float(np.mean(g))
    length = np.linalg.norm(V, axis=1)
    _check_unit(length, g)
    if len(V) < 9:
        raise EstimationError(_too_few(V, 9 - len(V), f"{len(V)} positions cannot determine 9 parameters"))
    v, r = V / unit, g / unit
    free = _FREE[form]
    M: FloatArray
    b: FloatArray
    M, b = _ellipsoid(v, r) or (np.eye(3), np.zeros(3))
    if form == "lower":  # the lower triangular M with the same M^T M
        M = np.asarray(np.linalg.cholesky((M.T @ M)[::-1, ::-1]).T[::-1, ::-1], dtype=np.float64)
        M = np.asarray(M * np.sign(np.diagonal(M))[:, None])
    # rank is judged at the design itself, so that a bad start cannot hide it
    _refuse_rank(V, norm_rows(v - b, np.linalg.norm(v - b, axis=1)))
    converged = False
    misfit, J = _misfit(M, b, v, r, free)
    damping = 1e-6
    for _ in range(100):
        normal = J.T @ J
        damped = normal + damping * np.diag(np.diagonal(normal))
        step = np.asarray(np.linalg.solve(damped, -J.T @ misfit), dtype=np.float64)
        trial_M, trial_b = _moved(M, b, step, free)
        trial, trial_J = _misfit(trial_M, trial_b, v, r, free)
        if trial @ trial <= misfit @ misfit:
            M, b, misfit, J = trial_M, trial_b, trial, trial_J
            damping = max(damping / 10.0, 1e-15)
        else:
            damping *= 10.0
        if np.abs(step).max() < 1e-13 or (np.abs(step).max() < 1e-9 and damping > 1e3):
            converged = True
            break
    if not converged and float(np.abs(J.T @ misfit).max()) > 1e-10:
        raise EstimationError(
            "the calibration does not converge: a position is grossly wrong; check each against the others"
        )
    singular = np.linalg.svd(J, compute_uv=False)
    left = len(v) - 9
    rms = float(np.sqrt(misfit @ misfit / max(left, 1))) * unit if left else 0.0
    spread = positive("sigma", sigma) if sigma is not None else (rms if left else None)
    covariance = None
    if spread is not None:
        inner = np.linalg.inv(J.T @ J) * (spread / unit) ** 2
        expand = np.zeros((12, 9))
        for k, places in enumerate(free):
            for i, j in places:
                expand[3 + 3 * i + j, k] = 1.0
        expand[:3, 6:] = unit * np.eye(3)
        covariance = expand @ inner @ expand.T
    return TriadCalibration(
        f"multi-position, {form}", b * unit, M, covariance, rms, len(v), 9, float(singular[0] / singular[-1])
    )


def vector_calibration(readings: ArrayLike, reference: ArrayLike, *, sigma: float | None = None) -> TriadCalibration:
    """Bias and the full matrix from readings at known reference vectors: the spatial method, if the block is turned about all axes.

    readings = [1, reference] X by least squares; first row of X: bias, the rest: transposed response.

    Parameters
    ----------
    readings : (m, 3) array
        Mean readings.
    reference : (m, 3) array
        True vectors in block axes, in the unit of the readings; see `turned_force`, `turned_rate`.
    sigma : float, optional
        Of a mean reading. By default it is estimated from the residuals, if m exceeds 4.

    Returns
    -------
    TriadCalibration

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite.
    EstimationError
        References of rank below 4 (says which turns to add), or a wrong unit.

    Notes
    -----
    The source asks for rank [A] = rank [A, U] = 4; with noise the second rank is always higher, so the first is checked and the residual
    is given instead. Twelve positions by equal angles have the condition 9.1; unequal multiples (`advise_turns`) reach 1.8.

    References
    ----------
    `spec/inertial.md` A10.

    Examples
    --------
    >>> from railnav.inertial import turned_force
    >>> force = turned_force(*(np.radians(30.0) * np.arange(12)[:, None] * [2, 4, 1]).T)
    >>> vector_calibration(force * 1.01 + 0.02, force).bias.round(9)
    array([0.02, 0.02, 0.02])
    """
    U, G = rows("readings", readings), rows("reference", reference)
    if len(U) != len(G):
        raise ValueError(f"{len(U)} readings but {len(G)} reference vectors")
    length = np.linalg.norm(G, axis=1)
    unit = float(np.sqrt(np.mean(length**2)))
    if unit == 0.0:
        raise EstimationError("all reference vectors are zero: only the bias would be determined; turn the block")
    found = solvability(G)
    if found.rank < 4:
        raise EstimationError(too_few_turns(found.rank, len(U)))
    _check_unit(np.linalg.norm(U, axis=1), length)
    A = np.column_stack([np.ones(len(G)), G / unit])
    X, _, _, _ = np.linalg.lstsq(A, U, rcond=None)
    left = len(U) - 4
    rms = float(np.sqrt(np.sum((U - A @ X) ** 2) / (3 * left))) if left else 0.0
    response = X[1:].T / unit
    if np.linalg.det(response) <= 0.0:
        raise EstimationError(
            "the readings are mirrored against the reference: an axis has the wrong sign, or two are swapped"
        )
    M = np.linalg.inv(response)
    spread = positive("sigma", sigma) if sigma is not None else (rms if left else None)
    covariance = None
    if spread is not None:
        inner = np.linalg.inv(A.T @ A) * spread**2  # of one row (bias_i, response_i x, y, z), alike for each sensor i
        inner[1:] /= unit
        inner[:, 1:] /= unit
        change = np.zeros((12, 12))  # d(bias, M) = change d(of_rows): dM = -M dR M
        of_rows = np.zeros((12, 12))
        for i in range(3):
            of_rows[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = inner
            change[i, 4 * i] = 1.0
            for j in range(3):
                change[3:, 4 * i + 1 + j] = -np.outer(M[:, i], M[j]).ravel()
        covariance = change @ of_rows @ change.T
    return TriadCalibration("vector", X[0], M, covariance, rms, len(U), 4, found.condition)


def _misfit(
    M: FloatArray, b: FloatArray, v: FloatArray, r: FloatArray, free: tuple[tuple[tuple[int, int], ...], ...]
) -> tuple[FloatArray, FloatArray]:
    """|M (v - b)| - r and its derivatives by the free elements of M and by b."""
    d = v - b
    a = d @ M.T
    length = np.linalg.norm(a, axis=1)
    u = a / length[:, None]
    columns = [np.sum([u[:, i] * d[:, j] for i, j in places], axis=0) for places in free]
    J = np.column_stack([*columns, -u @ M])
    return length - r, J


def _moved(
    M: FloatArray, b: FloatArray, step: FloatArray, free: tuple[tuple[tuple[int, int], ...], ...]
) -> tuple[FloatArray, FloatArray]:
    changed = M.copy()
    for s, places in zip(step, free, strict=False):
        for i, j in places:
            changed[i, j] += s
    return changed, b + step[6:]


def _ellipsoid(v: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Start from the linear fit v^T Q v + 2 u^T v = r^2; None if that is no ellipsoid."""
    x, y, z = v.T
    D = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z, -np.ones(len(v))])
    # nine unknowns for a common length, the tenth moves to the right
    q, _, rank, _ = np.linalg.lstsq(D[:, :9] / (r**2)[:, None], np.ones(len(v)), rcond=1e-10)
    if rank < 9:
        return None
    Q = np.array([[q[0], q[3], q[4]], [q[3], q[1], q[5]], [q[4], q[5], q[2]]])
    values, vectors = np.linalg.eigh(Q)
    if values[0] <= 0.0:
        return None
    b = -np.linalg.solve(Q, q[6:])
    size = 1.0 + b @ Q @ b
    return np.asarray(vectors * np.sqrt(values / size) @ vectors.T), b


def _refuse_rank(V: FloatArray, rows: FloatArray) -> None:
    singular = np.linalg.svd(rows, compute_uv=False)
    rank = int(np.sum(singular > RANK_TOLERANCE * singular[0]))
    if rank < 9:
        raise EstimationError(_too_few(V, 9 - rank, f"{len(V)} positions determine only {rank} of 9 parameters"))


def _too_few(V: FloatArray, missing: int, what: str) -> str:
    add = advise_positions(V[np.linalg.norm(V, axis=1) > 0.0], missing)
    return f"{what}; add positions with these axes up: {'; '.join(axes_up(u) for u in add)}"


def _check_unit(length: FloatArray, reference: FloatArray) -> None:
    """Say so where readings are off by the factor between two common units."""
    known = reference > 0.0
    if not np.any(known):
        return
    ratio = float(np.median(length[known] / reference[known]))
    for factor, words in ((STANDARD_GRAVITY, "g and m/s^2"), (180.0 / math.pi, "degrees and radians")):
        if any(abs(ratio / f - 1.0) < 0.12 for f in (factor, 1.0 / factor)):
            raise EstimationError(
                f"readings are {ratio:.3g} times the reference: {words} are mixed up; give both in one unit"
            )
