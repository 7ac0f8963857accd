"""Which positions of a triad to add, so that a calibration or a diagnosis becomes possible, or better."""

from __future__ import annotations

from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


Design = Literal["norm", "vector"]


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
        return norm_rows(u, np.ones(len(u))) if design == "norm" else np.column_stack([np.ones(len(u)), u])

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


def norm_rows(d: FloatArray, length: FloatArray) -> FloatArray:
    """Derivatives of |M (v - b)| at M = I by the symmetric M and by b."""
    x, y, z = (d / length[:, None]).T
    return np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, -x, -y, -z])


def axes_up(u: FloatArray) -> str:
    """Block axes that point up in a position, in words: "+x -z"."""
    return " ".join(f"{'+' if c > 0 else '-'}{axis}" for c, axis in zip(u, "xyz", strict=True) if abs(c) > 1e-9)
