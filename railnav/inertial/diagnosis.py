"""Scalar control of a triad, and which of nine parameters has moved when it fails.

One number needs no attitude: half of (|reading|^2/reference^2 - 1) is zero for a healthy triad in any position at rest. Which bias, scale
or axis failed is found from nine or more known positions. Readings should be corrected by the valid calibration first: what is found
is then the change since.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.inertial.advice import advise_positions, axes_up

FloatArray = NDArray[np.float64]

#: The nine causes, in the order of all arrays here.
CAUSES = (
    "bias x",
    "bias y",
    "bias z",
    "scale x",
    "scale y",
    "scale z",
    "misalignment xy",
    "misalignment xz",
    "misalignment yz",
)


@dataclass(frozen=True, slots=True, eq=False)
class ScalarControl:
    """Scalar control of readings at rest.

    Attributes
    ----------
    residual : (...) array
        (|reading|^2/reference^2 - 1)/2: to first order the share by which the length is off.
    healthy : (...) bool array
        Where its size is within the limit.
    """

    residual: FloatArray
    healthy: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """What nine or more positions say of a triad.

    Attributes
    ----------
    parameters : (9,) array
        In the order of `CAUSES`: biases over the reference, relative scale errors, sums of the two cross-axis terms of each pair, rad.
    sigma : (9,) array
        Their standard deviations.
    limits : (9,) array
        Beyond which a parameter counts as failed.
    failed : tuple of str
        Causes, worst first (by size over sigma); empty if healthy.
    condition : float
        Of the positions.
    """

    parameters: FloatArray
    sigma: FloatArray
    limits: FloatArray
    failed: tuple[str, ...]
    condition: float

    @property
    def healthy(self) -> bool:
        """No parameter beyond its limit."""
        return not self.failed

    def sentence(self) -> str:
        """What to tell the operator, in one line."""
        if self.healthy:
            return "healthy: all nine parameters are within their limits"
        worst = CAUSES.index(self.failed[0])
        others = f"; also {', '.join(self.failed[1:])}" if len(self.failed) > 1 else ""
        return (
            f"failed: {self.failed[0]} moved by {self.parameters[worst]:+.2e} (limit {self.limits[worst]:.1e}, "
            f"sigma {self.sigma[worst]:.1e}){others}"
        )


def scalar_control(readings: ArrayLike, reference: float | ArrayLike, *, limit: float) -> ScalarControl:
    """Whether readings at rest have the length they must have: F0 = 1 if |(|f|^2/g^2 - 1)/2| <= limit.

    Parameters
    ----------
    readings : (..., 3) array
        Corrected readings, at rest (or, for gyros, on a rate table).
    reference : float or (...) array
        Local gravity (not 9.81), or the rate, in the unit of the readings.
    limit : float
        Delta_0, at least three sigma of a reading over the reference.

    Returns
    -------
    ScalarControl

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, a reference or limit that is not positive.

    Notes
    -----
    Necessary, not sufficient: a bias on a level axis is invisible, and a fault ten times the limit trips it in some 90 % of random
    attitudes for a bias, 68 % for a scale factor, 70 % for a misalignment. An acceleration of the vehicle looks like a fault: ask only at
    rest.

    References
    ----------
    `spec/inertial.md` A11, UA(17).

    Examples
    --------
    >>> scalar_control([[0.0, 0.0, -9.81], [0.0, 0.0, -9.91]], 9.81, limit=1e-3).healthy
    array([ True, False])
    """
    v = np.asarray(readings, dtype=np.float64)
    g = np.asarray(reference, dtype=np.float64)
    if v.ndim < 1 or v.shape[-1] != 3 or not np.isfinite(v).all():
        raise ValueError("readings must have the shape (..., 3) and be finite")
    if not (np.isfinite(g).all() and np.all(g > 0.0) and math.isfinite(limit) and limit > 0.0):
        raise ValueError("reference and limit must be positive")
    residual = 0.5 * (np.sum(v * v, axis=-1) / g**2 - 1.0)
    return ScalarControl(np.asarray(residual), np.asarray(np.abs(residual) <= limit))


def diagnose(
    readings: ArrayLike,
    directions: ArrayLike,
    reference: float | ArrayLike,
    *,
    sigma: float,
    limits: ArrayLike | None = None,
    false_alarm: float = 1e-3,
) -> Diagnosis:
    """Which of the nine parameters of a triad has moved, from nine or more known positions.

    (|f|^2/g^2 - 1)/2 = b.u + e_x u_x^2 + ... + d_xy u_x u_y + ... to first order, u the true direction; Gauss-Newton takes the squares of
    the parameters along.

    Parameters
    ----------
    readings : (m, 3) array
        Corrected mean readings, m at least 9.
    directions : (m, 3) array
        True vector in block axes (accelerometers: up), any length.
    reference : float or (m,) array
        Local gravity or rate, in the unit of the readings.
    sigma : float
        Of a mean reading, same unit.
    limits : (9,) array, optional
        Of the parameters; default: such that a healthy triad is called failed in at most a share `false_alarm` of the cases.
    false_alarm : float, optional
        For the default limits.

    Returns
    -------
    Diagnosis

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite.
    EstimationError
        Positions of rank below nine: with those to add.

    Notes
    -----
    A turn of the whole triad cannot be seen; of the two cross-axis terms of a pair only their sum. With six faces and three edges the
    sigmas are 0.707 sigma/reference for bias and scale, 2.646 for the misalignments.

    References
    ----------
    `spec/inertial.md` A11, UA(16), figure 13.

    Examples
    --------
    >>> up = np.array([*np.eye(3), *-np.eye(3), *np.array([(1, 1, 0), (1, 0, 1), (0, 1, 1)]) / np.sqrt(2)])
    >>> diagnose(9.81 * up * [1.0, 1.01, 1.0], up, 9.81, sigma=0.01).sentence()[:29]
    'failed: scale y moved by +1.0'
    """
    V, U = np.asarray(readings, dtype=np.float64), np.asarray(directions, dtype=np.float64)
    if V.ndim != 2 or V.shape[1:] != (3,) or V.shape != U.shape or not len(V):
        raise ValueError(f"needs readings and directions (m, 3), not {V.shape} and {U.shape}")
    g = np.broadcast_to(np.asarray(reference, dtype=np.float64), (len(V),))
    length = np.linalg.norm(U, axis=1)
    if not (np.isfinite(V).all() and np.isfinite(U).all() and np.all(length > 0.0)):
        raise ValueError("readings and directions must be finite, directions longer than zero")
    if not (np.isfinite(g).all() and np.all(g > 0.0) and sigma > 0.0 and 0.0 < false_alarm < 1.0):
        raise ValueError("reference and sigma must be positive, false_alarm between 0 and 1")
    u = U / length[:, None]
    A = _rows(u)
    singular = np.linalg.svd(A, compute_uv=False)
    rank = int(np.sum(singular > 1e-6 * singular[0]))
    if rank < 9:
        add = advise_positions(u, 9 - rank)
        names = "; ".join(axes_up(d) for d in add)
        raise EstimationError(
            f"{len(V)} positions tell only {rank} of 9 causes apart; add positions with these axes up: {names}"
        )
    residual = scalar_control(V, g, limit=1.0).residual
    x = np.zeros(9)
    J = A
    for _ in range(10):
        a = u @ _response(x).T + x[:3]
        J = _jacobian(u, a)
        step, _, _, _ = np.linalg.lstsq(J, residual - 0.5 * (np.sum(a * a, axis=1) - 1.0), rcond=None)
        x = x + step
        if float(np.abs(step).max()) < 1e-14:
            break
    weight = sigma / g  # a reading's noise along the vector is the residual's noise
    left = np.linalg.pinv(J)
    spread = np.sqrt(np.sum((left * weight) ** 2, axis=1))
    if limits is None:
        bound = NormalDist().inv_cdf(1.0 - 0.5 * (1.0 - (1.0 - false_alarm) ** (1.0 / 9.0))) * spread
    else:
        bound = np.asarray(limits, dtype=np.float64)
        if bound.shape != (9,) or not np.all(bound > 0.0):
            raise ValueError("limits must be nine positive numbers")
    score = np.abs(x) / spread
    order = np.argsort(-score)
    failed = tuple(CAUSES[p] for p in order if abs(x[p]) > bound[p])
    return Diagnosis(x, spread, bound, failed, float(singular[0] / singular[-1]))


def _rows(u: FloatArray) -> FloatArray:
    x, y, z = u.T
    return np.column_stack([u, x * x, y * y, z * z, x * y, x * z, y * z])


def _response(p: FloatArray) -> FloatArray:
    """Symmetric response of a triad with scale errors p[3:6] and misalignments p[6:]."""
    half = 0.5 * p[6:]
    return np.array([[1.0 + p[3], half[0], half[1]], [half[0], 1.0 + p[4], half[2]], [half[1], half[2], 1.0 + p[5]]])


def _jacobian(u: FloatArray, a: FloatArray) -> FloatArray:
    """Derivatives of (|a|^2 - 1)/2 with a = response u + bias."""
    x, y, z = u.T
    p, q, r = a.T
    return np.column_stack(
        [a, p * x, q * y, r * z, 0.5 * (p * y + q * x), 0.5 * (p * z + r * x), 0.5 * (q * z + r * y)]
    )
