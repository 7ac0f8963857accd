"""Mean readings of a triad at rest, position by position."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError

FloatArray = NDArray[np.float64]


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
