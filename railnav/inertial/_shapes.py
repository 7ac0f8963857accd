"""Shapes that arguments must have, refused by name."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


def three(name: str, value: ArrayLike) -> FloatArray:
    """Three finite numbers."""
    x = np.asarray(value, dtype=np.float64)
    if x.shape != (3,) or not np.isfinite(x).all():
        raise ValueError(f"{name} must be three finite numbers")
    return x


def rows(name: str, value: ArrayLike) -> FloatArray:
    """Vectors of positions, (m, 3), m at least 1, finite."""
    x = np.asarray(value, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or not len(x):
        raise ValueError(f"{name} must have the shape (m, 3), not {x.shape}")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if bad.size:
        raise ValueError(f"{name} of position {bad[0]} is not finite")
    return x


def vectors(name: str, value: ArrayLike) -> FloatArray:
    """One vector or many, (3,) or (n, 3), finite."""
    x = np.asarray(value, dtype=np.float64)
    if x.ndim not in (1, 2) or x.shape[-1] != 3 or not x.size or not np.isfinite(x).all():
        raise ValueError(f"{name} must have the shape (3,) or (n, 3) and be finite")
    return x


def positive(name: str, value: float) -> float:
    """A finite number above zero."""
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{name} is {value}; it must be positive")
    return float(value)
