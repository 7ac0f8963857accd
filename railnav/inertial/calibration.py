"""Calibration of an inertial triad at rest or on a rate table: bias, scale, cross-axis terms, each with its sigma.

Every method gives the same thing: true = matrix @ (measured - bias). A position is a mean reading, a reference is what the triad should
have read there: the local gravity (accelerometers, specific force points up) or the rate of the table (gyros: the "modified" methods).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import rotation_vector_from_dcm
from railnav.errors import EstimationError
from railnav.units import STANDARD_GRAVITY

FloatArray = NDArray[np.float64]
Form = Literal["symmetric", "lower"]
Design = Literal["norm", "vector"]

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


@dataclass(frozen=True, slots=True, eq=False)
class Position:
    """Mean reading at rest in one position.

    Attributes
    ----------
    mean : (3,) array
        Unit of the readings.
    sigma : (3,) array
        Of the mean, from the scatter of ten pieces, so that slow noise counts.
    samples : int
        How many there were.
    """

    mean: FloatArray
    sigma: FloatArray
    samples: int


@dataclass(frozen=True, slots=True, eq=False)
class Solvability:
    """Whether a set of reference vectors determines bias, scale and cross-axis terms, and how well.

    Attributes
    ----------
    rank : int
        4 is needed.
    condition : float
        Of the design matrix [1, x, y, z]; infinite if the rank is short.
    sigma_factor : (4,) array
        Sigma of bias and of the three columns, per sigma of a reading (references in units of `scale`); infinite if the rank is short.
    """

    rank: int
    condition: float
    sigma_factor: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TemperaturePolynomial:
    """Polynomials of one or more parameters against temperature.

    Attributes
    ----------
    coefficients : (degree + 1, k) array
        Of powers of (temperature - centre)/half_range.
    covariance : (degree + 1, degree + 1) array
        Of the coefficients of each parameter, per unit variance of a value.
    sigma : (k,) array
        Of a value, given or estimated from the residuals.
    centre, half_range : float
        Of the temperatures that were measured, K.
    """

    coefficients: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    centre: float
    half_range: float

    def at(self, temperature: ArrayLike, *, beyond: float = 5.0) -> FloatArray:
        """Values at temperatures, (...) K -> (..., k).

        Parameters
        ----------
        temperature : float or (...) array
            K.
        beyond : float, optional
            How far outside the measured range is still allowed, K.

        Raises
        ------
        EstimationError
            Further outside: polynomials run away there.
        """
        return np.asarray(self._powers(temperature, beyond) @ self.coefficients)

    def sigma_at(self, temperature: ArrayLike, *, beyond: float = 5.0) -> FloatArray:
        """Standard deviations of `at`, (..., k)."""
        p = self._powers(temperature, beyond)
        return np.asarray(np.sqrt(np.einsum("...i,ij,...j->...", p, self.covariance, p))[..., None] * self.sigma)

    def _powers(self, temperature: ArrayLike, beyond: float) -> FloatArray:
        t = np.asarray(temperature, dtype=np.float64)
        outside = np.abs(t - self.centre) > self.half_range + beyond
        if np.any(outside) or not np.isfinite(t).all():
            worst = float(t[outside].flat[0]) if np.any(outside) else math.nan
            raise EstimationError(
                f"temperature {worst:.1f} K lies outside what was calibrated, "
                f"{self.centre - self.half_range:.1f} to {self.centre + self.half_range:.1f} K; measure there too"
            )
        x = (t - self.centre) / self.half_range
        return np.asarray(x[..., None] ** np.arange(len(self.coefficients)))


def position_mean(samples: ArrayLike, *, largest_sigma: float) -> Position:
    """Mean of a log at rest, refused if the triad moved or an axis is dead.

    Parameters
    ----------
    samples : (n, 3) array
        At least 20.
    largest_sigma : float
        Scatter of the means of ten equal pieces that still counts as rest, unit.

    Returns
    -------
    Position

    Raises
    ------
    ValueError
        Wrong shape, too few samples.
    EstimationError
        A gap, a frozen axis, or motion: with the axis and its scatter.

    Examples
    --------
    >>> position_mean(np.random.default_rng(1).normal([0, 0, 9.8], 0.01, (1000, 3)), largest_sigma=0.01).mean.round(2)
    array([0. , 0. , 9.8])
    """
    x = np.asarray(samples, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or len(x) < 20:
        raise ValueError(f"a position needs samples of the shape (n, 3), n at least 20, not {x.shape}")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if bad.size:
        raise EstimationError(f"sample {bad[0]} is not finite; cut the log there")
    for axis in np.flatnonzero(np.ptp(x, axis=0) == 0.0)[:1]:
        raise EstimationError(f"axis {'xyz'[axis]} reads {x[0, axis]:g} all the time: it is frozen or missing")
    pieces = np.array([piece.mean(axis=0) for piece in np.array_split(x, 10)])
    scatter = pieces.std(axis=0, ddof=1)
    for axis in np.flatnonzero(scatter > largest_sigma)[:1]:
        raise EstimationError(
            f"the triad moved: means of tenths of the log scatter by {scatter[axis]:.3g} on axis {'xyz'[axis]}, "
            f"more than {largest_sigma:.3g}; record this position again at rest"
        )
    return Position(x.mean(axis=0), scatter / math.sqrt(10.0), len(x))


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
    u, d = (_three(name, v) for name, v in (("up", up), ("down", down)))
    g = _positive("reference", reference)
    _check_unit(np.abs(u - d) / 2.0, np.full(3, g))
    K = (u - d) / (2.0 * g) - 1.0
    for axis in np.flatnonzero(np.abs(K) > 0.5)[:1]:
        raise EstimationError(
            f"axis {'xyz'[axis]} reads {u[axis]:g} up and {d[axis]:g} down against a reference of {g:g}: check which way was up"
        )
    covariance = None
    if sigma is not None:
        variance = _positive("sigma", sigma) ** 2
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
    V = _rows("readings", readings)
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
    _refuse_rank(V, _norm_rows(v - b, np.linalg.norm(v - b, axis=1)))
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
    spread = _positive("sigma", sigma) if sigma is not None else (rms if left else None)
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
    >>> force = turned_force(*(np.radians(30.0) * np.arange(12)[:, None] * [2, 4, 1]).T)
    >>> vector_calibration(force * 1.01 + 0.02, force).bias.round(9)
    array([0.02, 0.02, 0.02])
    """
    U, G = _rows("readings", readings), _rows("reference", reference)
    if len(U) != len(G):
        raise ValueError(f"{len(U)} readings but {len(G)} reference vectors")
    length = np.linalg.norm(G, axis=1)
    unit = float(np.sqrt(np.mean(length**2)))
    if unit == 0.0:
        raise EstimationError("all reference vectors are zero: only the bias would be determined; turn the block")
    found = solvability(G)
    if found.rank < 4:
        raise EstimationError(_too_few_turns(found.rank, len(U)))
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
    spread = _positive("sigma", sigma) if sigma is not None else (rms if left else None)
    covariance = None
    if spread is not None:
        inner = np.linalg.inv(A.T @ A) * spread**2  # of one row (bias_i, response_i x, y, z), alike for each sensor i
        inner[1:] /= unit
        inner[:, 1:] /= unit
        change = np.zeros((12, 12))  # d(bias, M) = change d(rows): dM = -M dR M
        rows = np.zeros((12, 12))
        for i in range(3):
            rows[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = inner
            change[i, 4 * i] = 1.0
            for j in range(3):
                change[3:, 4 * i + 1 + j] = -np.outer(M[:, i], M[j]).ravel()
        covariance = change @ rows @ change.T
    return TriadCalibration("vector", X[0], M, covariance, rms, len(U), 4, found.condition)


def solvability(reference: ArrayLike, *, scale: float | None = None) -> Solvability:
    """Rank and conditioning of a set of reference vectors, before any reading is taken.

    Parameters
    ----------
    reference : (m, 3) array
        Specific forces or rates in block axes.
    scale : float, optional
        Unit in which they enter the design matrix [1, x, y, z]; default: their root mean square length, so that the unit does not matter.

    Returns
    -------
    Solvability

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite.

    References
    ----------
    `spec/inertial.md` A10.

    Examples
    --------
    >>> solvability([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]).rank
    2
    """
    G = _rows("reference", reference)
    unit = scale if scale is not None else float(np.sqrt(np.mean(np.sum(G**2, axis=1)))) or 1.0
    A = np.column_stack([np.ones(len(G)), G / unit])
    singular = np.linalg.svd(A, compute_uv=False)
    rank = int(np.sum(singular > 1e-9 * singular[0]))
    if rank < 4:
        return Solvability(rank, math.inf, np.full(4, math.inf))
    return Solvability(rank, float(singular[0] / singular[-1]), np.sqrt(np.diagonal(np.linalg.inv(A.T @ A))))


def turned_force(
    alpha: ArrayLike, beta: ArrayLike, gamma: ArrayLike, *, up: ArrayLike = (0.0, 0.0, -1.0)
) -> FloatArray:
    """Specific force in block axes after turns about x, then y, then z: Rz(gamma) Ry(beta) Rx(alpha) up.

    Parameters
    ----------
    alpha, beta, gamma : float or (m,) array
        Turns of the block, rad.
    up : (3,) array, optional
        Specific force before the turns; default: one unit, axes forward, right, down.

    Returns
    -------
    (m, 3) array

    References
    ----------
    `spec/inertial.md` A10.

    Examples
    --------
    >>> turned_force(np.pi / 2, 0.0, 0.0).round(12) + 0.0
    array([ 0., -1.,  0.])
    """
    return np.asarray(_turn(alpha, beta, gamma) @ _three("up", up))


def turned_rate(alpha: ArrayLike, beta: ArrayLike, gamma: ArrayLike, rates: ArrayLike) -> FloatArray:
    """Angular rate in block axes while it turns: gamma' e_z + beta' Rz(gamma) e_y + alpha' Rz(gamma) Ry(beta) e_x.

    Parameters
    ----------
    alpha, beta, gamma : float or (m,) array
        Turns reached, rad.
    rates : (3,) or (m, 3) array
        Their rates, in the unit of the result.

    Returns
    -------
    (m, 3) array

    References
    ----------
    `spec/inertial.md` A10.

    Examples
    --------
    >>> turned_rate(0.0, 0.0, 0.0, [1.0, 2.0, 3.0])
    array([1., 2., 3.])
    """
    r = np.asarray(rates, dtype=np.float64)
    zero = np.zeros_like(np.asarray(alpha, dtype=np.float64))
    about_y = _turn(zero, zero, gamma)[..., 1]
    about_x = _turn(zero, beta, gamma)[..., 0]
    return np.asarray(r[..., 2:] * [0.0, 0.0, 1.0] + r[..., 1:2] * about_y + r[..., :1] * about_x)


def finite_rotation(alpha: float, beta: float, gamma: float) -> FloatArray:
    """Rotation vector of the turns of `turned_force` as one turn, (3,), rad.

    Examples
    --------
    >>> np.degrees(np.linalg.norm(finite_rotation(*np.radians([30.0, 30.0, 30.0])))).round(6)
    np.float64(55.771134)
    """
    return rotation_vector_from_dcm(_turn(alpha, beta, gamma).T)


def advise_turns(step: float, count: int, *, largest: int = 5) -> tuple[tuple[int, int, int], Solvability]:
    """Multiples of a step by which to turn the three axes at once, so that `count` positions determine everything best.

    Parameters
    ----------
    step : float
        rad.
    count : int
        Positions: position k has the turns k times the multiples times `step`.
    largest : int, optional
        Largest multiple tried.

    Returns
    -------
    multiples : (3,) tuple of int
        For alpha, beta, gamma; of all with the best condition, the smallest.
    solvability : Solvability
        What they reach.

    Raises
    ------
    EstimationError
        No multiples of this step reach rank 4.

    Examples
    --------
    >>> advise_turns(np.radians(30.0), 12)[1].condition.__round__(3)
    1.789
    """
    k = np.arange(count)[:, None] * step
    best: tuple[float, int, tuple[int, int, int], Solvability] | None = None
    for p, q, r in product(range(largest + 1), repeat=3):
        found = solvability(turned_force(*(k * [p, q, r]).T))
        key = (round(found.condition, 6), p + q + r)
        if found.rank == 4 and (best is None or key < best[:2]):
            best = (*key, (p, q, r), found)
    if best is None:
        raise EstimationError(
            f"no turns by multiples of {math.degrees(step):g} degrees determine a triad; take a smaller step"
        )
    return best[2], best[3]


def advise_positions(directions: ArrayLike, count: int, *, design: Design = "norm") -> FloatArray:
    """Which positions to add: greedily, the one that adds most information among faces, edges and corners of a cube.

    Parameters
    ----------
    directions : (m, 3) array
        Positions at hand: direction of the specific force (up) in block axes, any length; m may be 0.
    count : int
        How many to add.
    design : {"norm", "vector"}, optional
        For `multi_position` (nine parameters) or `vector_calibration` (four a sensor).

    Returns
    -------
    (count, 3) array
        Unit vectors: block axes that should point up, together where there are several.

    Raises
    ------
    ValueError
        Wrong shape, or a direction of length zero.

    Examples
    --------
    >>> advise_positions(np.vstack([np.eye(3), -np.eye(3)]), 3).round(3) + 0.0
    array([[-0.577, -0.577, -0.577],
           [-0.577, -0.577,  0.577],
           [-0.577,  0.577, -0.577]])
    """
    d = np.asarray(directions, dtype=np.float64).reshape(-1, 3)
    length = np.linalg.norm(d, axis=1, keepdims=True)
    if not np.isfinite(d).all() or np.any(length == 0.0):
        raise ValueError("directions must be finite and not of length zero")
    cube = np.array([c for c in product((-1.0, 0.0, 1.0), repeat=3) if any(c)])
    cube /= np.linalg.norm(cube, axis=1, keepdims=True)

    def rows(u: FloatArray) -> FloatArray:
        return _norm_rows(u, np.ones(len(u))) if design == "norm" else np.column_stack([np.ones(len(u)), u])

    candidates = rows(cube)
    information = 1e-6 * np.eye(candidates.shape[1])
    information += rows(d / length).T @ rows(d / length)
    chosen = []
    for _ in range(count):
        gain = np.einsum("ki,ij,kj->k", candidates, np.linalg.inv(information), candidates)
        best = int(np.argmax(gain > gain.max() * (1.0 - 1e-9)))
        chosen.append(cube[best])
        information += np.outer(candidates[best], candidates[best])
    return np.array(chosen).reshape(-1, 3)


def fit_temperature(
    temperature: ArrayLike, values: ArrayLike, *, degree: int = 2, sigma: ArrayLike | None = None
) -> TemperaturePolynomial:
    """Polynomial of calibration parameters against temperature.

    Parameters
    ----------
    temperature : (m,) array
        K.
    values : (m,) or (m, k) array
        Biases, scale errors, ... at these temperatures.
    degree : int, optional
        Of the polynomial.
    sigma : float or (k,) array, optional
        Of a value; by default estimated from the residuals.

    Returns
    -------
    TemperaturePolynomial

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite.
    EstimationError
        Fewer different temperatures than coefficients, or none left over to estimate sigma from.

    Examples
    --------
    >>> fit_temperature([273.0, 283.0, 293.0, 303.0], [0.0, 0.1, 0.2, 0.3], degree=1).at(288.0).round(6)
    array([0.15])
    """
    t = np.asarray(temperature, dtype=np.float64)
    y = np.asarray(values, dtype=np.float64)
    y = y[:, None] if y.ndim == 1 else y
    if t.ndim != 1 or y.ndim != 2 or len(t) != len(y):
        raise ValueError(f"needs temperatures (m,) and values (m, k), not {t.shape} and {y.shape}")
    if not (np.isfinite(t).all() and np.isfinite(y).all()):
        raise ValueError("temperature or values hold a value that is not finite")
    different = len(np.unique(t))
    if different < degree + 1:
        raise EstimationError(
            f"{different} temperatures do not determine a polynomial of degree {degree}; measure at {degree + 1} or lower the degree"
        )
    left = len(t) - degree - 1
    if sigma is None and left == 0:
        raise EstimationError(
            "no measurement is left over to estimate the sigma from; give sigma, or measure once more"
        )
    centre, half_range = 0.5 * (t.max() + t.min()), 0.5 * float(np.ptp(t)) or 1.0
    A = ((t - centre) / half_range)[:, None] ** np.arange(degree + 1)
    X, _, _, _ = np.linalg.lstsq(A, y, rcond=None)
    if sigma is None:
        spread = np.sqrt(np.sum((y - A @ X) ** 2, axis=0) / left)
    else:
        spread = np.broadcast_to(np.asarray(sigma, dtype=np.float64), (y.shape[1],)).copy()
    return TemperaturePolynomial(X, np.linalg.inv(A.T @ A), spread, float(centre), half_range)


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


def _norm_rows(d: FloatArray, length: FloatArray) -> FloatArray:
    """Derivatives of |M (v - b)| at M = I by the symmetric M and by b."""
    x, y, z = (d / length[:, None]).T
    return np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, -x, -y, -z])


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
    return f"{what}; add positions with these axes up: {'; '.join(_name(u) for u in add)}"


def _too_few_turns(rank: int, positions: int) -> str:
    return (
        f"{positions} turns determine only {rank} of the 4 unknowns of a sensor (a fixed axis, or steps that repeat themselves); "
        "turn all three axes by unequal multiples, such as 2 : 4 : 1 times 30 degrees"
    )


def _name(u: FloatArray) -> str:
    return " ".join(f"{'+' if c > 0 else '-'}{axis}" for c, axis in zip(u, "xyz", strict=True) if abs(c) > 1e-9)


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


def _turn(alpha: ArrayLike, beta: ArrayLike, gamma: ArrayLike) -> FloatArray:
    """Passive Rz(gamma) Ry(beta) Rx(alpha), (..., 3, 3)."""
    a, b, c = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (alpha, beta, gamma)))
    sa, ca, sb, cb, sc, cc = np.sin(a), np.cos(a), np.sin(b), np.cos(b), np.sin(c), np.cos(c)
    rows = [
        [cc * cb, cc * sb * sa + sc * ca, -cc * sb * ca + sc * sa],
        [-sc * cb, -sc * sb * sa + cc * ca, sc * sb * ca + cc * sa],
        [sb, -cb * sa, cb * ca],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _rows(name: str, value: ArrayLike) -> FloatArray:
    x = np.asarray(value, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or not len(x):
        raise ValueError(f"{name} must have the shape (m, 3), not {x.shape}")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if bad.size:
        raise ValueError(f"{name} of position {bad[0]} is not finite")
    return x


def _three(name: str, value: ArrayLike) -> FloatArray:
    x = np.asarray(value, dtype=np.float64)
    if x.shape != (3,) or not np.isfinite(x).all():
        raise ValueError(f"{name} must be three finite numbers")
    return x


def _positive(name: str, value: float) -> float:
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{name} is {value}; it must be positive")
    return float(value)
