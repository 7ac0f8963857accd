"""Orientation update: the rotation vector of one step from one to four gyro samples, and the chain of such steps.

The rotation vector of a step obeys Bortz's equation phi' = w + 1/2 phi x w + 1/12 phi x (phi x w) + ... Put the polynomial through the
samples in place of w, integrate, and sort by powers: the plain integral, a sum of cross products of pairs of samples (second order:
coning), and a sum of double cross products of triples (third order). All coefficients here are computed from that definition in
rational arithmetic, not copied.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import _kernels
from railnav.attitude.conversions import quaternion_from_rotation_vector, rotation_vector_from_quaternion

FloatArray = NDArray[np.float64]
Samples = Literal["increments", "rates"]
ThirdOrder = Literal["none", "bortz", "complete"]
_Polynomial = list[Fraction]

#: A rotation vector longer than this in one step means that the sampling is too slow for a truncated series, rad.
LONGEST_STEP = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class UpdateCoefficients:
    """Coefficients of an orientation update for m samples a step, for a step of unit length.

    Attributes
    ----------
    single : (m,) array
        Weights of the samples in the plain integral.
    double : (m, m) array
        Of the cross products s_i x s_j, i < j; zero elsewhere.
    bortz, complete : (m, m, m) array
        Of s_k x (s_i x s_j), index [k, i, j], i < j: the third term of Bortz's equation alone, and all of third order.
    """

    single: FloatArray
    double: FloatArray
    bortz: FloatArray
    complete: FloatArray


@lru_cache(maxsize=16)
def update_coefficients(samples: Samples, steps: int) -> UpdateCoefficients:
    """Coefficients of the update from `steps` angle increments, or from `steps` + 1 rate samples.

    w(t) is the polynomial with the given increments over equal parts of the step (degree steps - 1), or through the given rates at equal
    distances, ends included (degree steps). With alpha the integral of w, the second order is 1/2 int alpha x w, and the third is
    1/2 int (1/2 int alpha x w) x w + 1/12 int alpha x (alpha x w).

    Parameters
    ----------
    samples : {"increments", "rates"}
        What the gyro gives.
    steps : int
        Sampling steps in an update step, 1 to 4.

    Returns
    -------
    UpdateCoefficients
        For a step of unit length: with rates, the second order is to be multiplied by H^2 and the third by H^3.

    Raises
    ------
    ValueError
        `steps` outside 1 to 4, or an unknown kind of sample.

    References
    ----------
    `spec/inertial.md` A9.1 (UA(13), UA(14)) and A9.2 (table 7). Bortz, J. E.: A new mathematical formulation for strapdown inertial
    navigation. IEEE Trans. AES-7 (1), 1971.

    Examples
    --------
    >>> update_coefficients("increments", 2).double[0, 1] == 2 / 3
    np.True_
    """
    if steps not in (1, 2, 3, 4):
        raise ValueError(f"an update takes 1 to 4 sampling steps, not {steps}")
    if samples == "increments":
        basis = _increment_basis(steps)
    elif samples == "rates":
        basis = _rate_basis(steps)
    else:
        raise ValueError(f"samples are 'increments' or 'rates', not {samples!r}")
    m = len(basis)
    integral = [_integrate(p) for p in basis]
    zero = Fraction(0)
    single = np.array([float(_at_one(p)) for p in integral])
    double = np.zeros((m, m))
    bortz = np.zeros((m, m, m))
    complete = np.zeros((m, m, m))
    for i in range(m):
        for j in range(i + 1, m):
            # second order of s_i x s_j as a function of time, antisymmetric in i and j
            pair = _integrate(_subtract(_multiply(integral[i], basis[j]), _multiply(integral[j], basis[i])))
            double[i, j] = float(_at_one(pair) / 2)
            for k in range(m):
                alone = sum(
                    (
                        sign * _at_one(_integrate(_multiply(_multiply(integral[k], integral[a]), basis[b])))
                        for a, b, sign in ((i, j, 1), (j, i, -1))
                    ),
                    zero,
                )
                # (s_i x s_j) x s_k = -s_k x (s_i x s_j)
                nested = -_at_one(_integrate(_multiply(pair, basis[k]))) / 4
                bortz[k, i, j] = float(alone / 12)
                complete[k, i, j] = float(alone / 12 + nested)
    for array in (single, double, bortz, complete):
        array.flags.writeable = False
    return UpdateCoefficients(single, double, bortz, complete)


def rotation_vector_from_increments(
    increments: ArrayLike, *, third_order: ThirdOrder = "none", longest: float = LONGEST_STEP
) -> FloatArray:
    """Rotation vector of a step from one to four equal-length angle increments.

    Two increments give dth1 + dth2 + 2/3 dth1 x dth2, and with the complete third order + 2/15 (dth1 - dth2) x (dth1 x dth2).

    Parameters
    ----------
    increments : (..., m, 3) array
        Integrals of the body rate w_ib_b over m = 1 to 4 equal parts of the step, in order of time, rad.
    third_order : {"none", "bortz", "complete"}, optional
        Leave the third order out; take the third term of Bortz's equation alone (UA(13), worse than none: see Notes); or all of it.
    longest : float, optional
        Rotation in one step that is refused as too long for the series, rad.

    Returns
    -------
    (..., 3) array
        phi, rad: C_nb(after) = C_nb(before) C(phi) in an inertially fixed frame n.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or a rotation above `longest` in one step, where the series is not to be trusted.

    Notes
    -----
    Error of one step under a general motion: order 3 of its length for m = 1, order 5 for m = 2, 3, 4 whatever the third order, which
    lessens the factor (about threefold for m = 2 if the rate is linear, 13-fold for m = 4). The third Bortz term alone is
    (7 dth1 + 3 dth2)/60 for m = 2 and leaves out (dth1 - 11 dth2)/60 of equal size that comes from the second term: it makes the result
    worse, order 4. Tables in `docs/theory/inertial.md`.

    References
    ----------
    `spec/inertial.md` A9.1, UA(13), UA(14).

    Examples
    --------
    >>> rotation_vector_from_increments([[0.02, -0.01, 0.03], [0.015, 0.02, 0.01]]).round(9)
    array([0.03453333, 0.01016667, 0.04036667])
    """
    s = _samples("increments", increments, 1, 4)
    return _combine(s, update_coefficients("increments", s.shape[-2]), third_order, longest)


def rotation_vector_from_rates(
    rates: ArrayLike,
    interval: float | FloatArray,
    *,
    third_order: ThirdOrder = "none",
    longest: float = LONGEST_STEP,
) -> FloatArray:
    """Rotation vector of a step from two to five equally spaced samples of the rate, both ends included.

    Parameters
    ----------
    rates : (..., n + 1, 3) array
        w_ib_b at the start, between and at the end of the step (the last of one step is the first of the next), rad/s, n = 1 to 4.
    interval : float or (...) array
        H, length of the whole step, s.
    third_order : {"none", "bortz", "complete"}, optional
        As in `rotation_vector_from_increments`.
    longest : float, optional
        Rotation in one step that is refused as too long for the series, rad.

    Returns
    -------
    (..., 3) array
        phi, rad.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, an interval that is not positive, or a rotation above `longest` in one step.

    Notes
    -----
    Drift under coning, per square of the half cone angle and per radian of the coning motion, w = coning rate times sampling step:
    n = 1: -w^2/12, n = 2: -w^4/60, n = 3: +w^4/80, n = 4: +2 w^6/189. Samples are taken as exact: a gyro with its own low-pass filter, or
    one that integrates, is better served by increments.

    References
    ----------
    `spec/inertial.md` A9.2, table 7 of the source (its rows n = 2 and 4 are illegible and derived here).

    Examples
    --------
    >>> rotation_vector_from_rates([[0.1, 0.2, -0.3], [0.15, 0.1, -0.2]], 0.1).round(9)
    array([ 0.01249167,  0.01497917, -0.02501667])
    """
    s = _samples("rates", rates, 2, 5)
    H = np.asarray(interval, dtype=np.float64)
    if not (np.isfinite(H).all() and np.all(H > 0.0)):
        raise ValueError("interval must be positive and finite")
    return _combine(s * H[..., None, None], update_coefficients("rates", s.shape[-2] - 1), third_order, longest)


def propagate(quaternion: ArrayLike, rotation_vectors: ArrayLike) -> FloatArray:
    """Quaternions of a body that makes one body-fixed rotation after another.

    Parameters
    ----------
    quaternion : (4,) array
        At the start, scalar first, unit length.
    rotation_vectors : (m, 3) array
        Rotation vector of each step, in axes of the body at the start of the step, rad.

    Returns
    -------
    (m + 1, 4) array
        Start and end of every step, unit length; signs follow on without jumps.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or not of unit length.

    Examples
    --------
    >>> propagate([1.0, 0.0, 0.0, 0.0], np.full((4, 3), [0.0, 0.0, np.pi / 2]))[-1].round(12)
    array([-1.,  0.,  0.,  0.])
    """
    start = np.asarray(quaternion, dtype=np.float64)
    steps = np.ascontiguousarray(rotation_vectors, dtype=np.float64)
    if start.shape != (4,) or steps.ndim != 2 or steps.shape[1] != 3:
        raise ValueError(f"needs a quaternion (4,) and rotation vectors (m, 3), not {start.shape} and {steps.shape}")
    if not np.isfinite(steps).all():
        raise ValueError("rotation_vectors holds a value that is not finite")
    # through the conversions for their refusals; the sign is kept
    unit = quaternion_from_rotation_vector(rotation_vector_from_quaternion(start))
    unit = unit if unit @ start >= 0.0 else -unit
    out = np.empty((len(steps) + 1, 4))
    _kernels.propagate_kernel(unit, steps, out)
    return out


def _combine(s: FloatArray, c: UpdateCoefficients, third_order: ThirdOrder, limit: float) -> FloatArray:
    """Sum of the plain integral and the crossed terms; s (..., m, 3) rad."""
    if third_order not in ("none", "bortz", "complete"):
        raise ValueError(f"third_order is 'none', 'bortz' or 'complete', not {third_order!r}")
    m = s.shape[-2]
    phi = np.einsum("i,...ix->...x", c.single, s)
    for i in range(m):
        for j in range(i + 1, m):
            pair = np.cross(s[..., i, :], s[..., j, :])
            phi = phi + c.double[i, j] * pair
            if third_order != "none":
                triple = c.bortz if third_order == "bortz" else c.complete
                phi = phi + np.cross(np.einsum("k,...kx->...x", triple[:, i, j], s), pair)
    longest = float(np.max(np.linalg.norm(phi, axis=-1), initial=0.0))
    if longest > limit:
        raise ValueError(f"{longest:.2g} rad in one step, above {limit:g}: the series does not hold; sample faster")
    return np.asarray(phi)


def _samples(name: str, value: ArrayLike, fewest: int, most: int) -> FloatArray:
    s = np.asarray(value, dtype=np.float64)
    if s.ndim < 2 or s.shape[-1] != 3 or not fewest <= s.shape[-2] <= most:
        raise ValueError(f"{name} must have the shape (..., {fewest} to {most}, 3), not {s.shape}")
    if not np.isfinite(s).all():
        raise ValueError(f"{name} holds a value that is not finite")
    return s


def _rate_basis(n: int) -> list[_Polynomial]:
    """Lagrange polynomials on [0, 1] with knots i/n."""
    basis: list[_Polynomial] = []
    for i in range(n + 1):
        p: _Polynomial = [Fraction(1)]
        for j in range(n + 1):
            if j != i:
                gap = Fraction(i - j, n)
                p = _multiply(p, [-Fraction(j, n) / gap, 1 / gap])
        basis.append(p)
    return basis


def _increment_basis(n: int) -> list[_Polynomial]:
    """Polynomials of degree n - 1 on [0, 1] whose integral over part j of n is 1 for j = i and 0 otherwise."""
    table = [
        [(Fraction(j + 1, n) ** (d + 1) - Fraction(j, n) ** (d + 1)) / (d + 1) for d in range(n)] for j in range(n)
    ]
    return [_solve(table, [Fraction(int(j == i)) for j in range(n)]) for i in range(n)]


def _solve(matrix: list[list[Fraction]], right: list[Fraction]) -> _Polynomial:
    """Gauss-Jordan in rational numbers."""
    rows = [[*row, r] for row, r in zip(matrix, right, strict=True)]
    n = len(rows)
    for c in range(n):
        pivot = next(r for r in range(c, n) if rows[r][c] != 0)
        rows[c], rows[pivot] = rows[pivot], rows[c]
        rows[c] = [v / rows[c][c] for v in rows[c]]
        for r in range(n):
            if r != c:
                rows[r] = [v - rows[r][c] * w for v, w in zip(rows[r], rows[c], strict=True)]
    return [row[n] for row in rows]


def _multiply(a: _Polynomial, b: _Polynomial) -> _Polynomial:
    out = [Fraction(0)] * (len(a) + len(b) - 1)
    for (i, x), (j, y) in product(enumerate(a), enumerate(b)):
        out[i + j] += x * y
    return out


def _subtract(a: _Polynomial, b: _Polynomial) -> _Polynomial:
    return [x - y for x, y in zip(a, b, strict=True)]


def _integrate(a: _Polynomial) -> _Polynomial:
    return [Fraction(0), *(x / (i + 1) for i, x in enumerate(a))]


def _at_one(a: _Polynomial) -> Fraction:
    return sum(a, Fraction(0))
