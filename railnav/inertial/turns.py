"""Turns of a block about all three axes at once: what its sensors should read, and whether the turns determine them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.attitude import rotation_vector_from_dcm
from railnav.errors import EstimationError
from railnav.inertial._shapes import rows, three

FloatArray = NDArray[np.float64]


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
    G = rows("reference", reference)
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
    return np.asarray(_turn(alpha, beta, gamma) @ three("up", up))


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


def too_few_turns(rank: int, positions: int) -> str:
    """Sentence on turns that leave unknowns undetermined."""
    return (
        f"{positions} turns determine only {rank} of the 4 unknowns of a sensor (a fixed axis, or steps that repeat themselves); "
        "turn all three axes by unequal multiples, such as 2 : 4 : 1 times 30 degrees"
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
