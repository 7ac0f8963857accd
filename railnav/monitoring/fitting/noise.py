"""How measured points err: white or in waves, and how far apart they are worth taking.

The noise decides what is an element and how sure it is. Its white part follows from fourth differences, which straights, arcs and
clothoids hardly have; points that come from smoothing are thinned until their differences stop growing; waves are a first-order
process whose size and length make the measured points likeliest, elements and all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.fitting.segmentation import Noise, Pieces

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: A fourth difference of white noise has this many times its variance.
_FOURTH = 70.0
#: Differences of smooth points grow sixteenfold as the spacing doubles, those of white noise not; points are thinned above this.
_STILL_SMOOTH = 2.5
#: Samples on which the waves of the noise are judged.
_JUDGED = 1600
#: Lengths of waves tried, in spacings, and their sizes, in white sigmas.
_LENGTHS = (3.0, 8.0, 20.0, 60.0)
_SIZES = (0.5, 1.0, 2.0, 4.0, 8.0)
#: Waves must be likelier than none by this, in -2 log likelihood.
_WORTH = 12.0


@dataclass(frozen=True, slots=True)
class Resolution:
    """How far apart points are worth taking.

    Attributes
    ----------
    every : int
        Take each n-th point.
    spacing : float
        Their mean distance then, m.
    sigma : float
        White noise at that distance, m.
    """

    every: int
    spacing: float
    sigma: float


def fourth_difference_sigma(values: FloatArray, every: int = 1) -> float:
    """White noise of evenly spaced values from the median size of their fourth differences."""
    taken = [np.diff(values[k::every], 4) for k in range(every)]
    joined = np.concatenate([d for d in taken if len(d)]) if any(len(d) for d in taken) else np.zeros(1)
    return float(np.median(np.abs(joined)) / 0.6745 / np.sqrt(_FOURTH))


def resolution(across: Callable[[int], FloatArray], spacing: float, count: int, *, floor: float) -> Resolution:
    """Find how far apart points are worth taking, and their white noise there.

    Parameters
    ----------
    across : callable
        From a stride to fourth differences across the track, m.
    spacing : float
        Mean distance of the points, m.
    count : int
        How many there are.
    floor : float
        Noise below which points count as exact, m.
    """
    sizes = {}

    def sigma(every: int) -> float:
        if every not in sizes:
            fourth = across(every)
            sizes[every] = float(np.median(np.abs(fourth)) / 0.6745 / np.sqrt(_FOURTH)) if len(fourth) else 0.0
        return sizes[every]

    every = 1
    while (
        2 * every * 40 < count
        and 2 * every * spacing <= 200.0
        and sigma(2 * every) > _STILL_SMOOTH * sigma(every)
        and sigma(2 * every) > floor
    ):
        every *= 2
    return Resolution(every, every * spacing, max(sigma(every), floor))


def likeliest(
    pieces: Callable[[Noise, slice], Pieces],
    count: int,
    spacing: float,
    sigma: float,
    *,
    floor: float,
    stated: float | None = None,
) -> Noise:
    """Noise under which the points, elements and all, are likeliest.

    Parameters
    ----------
    pieces : callable
        From a noise and a stretch of samples to its pieces and their cost.
    count, spacing : int, float
        Samples and their distance, m.
    sigma : float
        White noise to begin from, m.
    floor : float
        Least white noise, m.
    stated : float, optional
        White noise that the user states, m: then it stays, and only waves are looked for.
    """
    if count <= _JUDGED:
        stretches = [slice(0, count)]
    else:
        third = _JUDGED // 3
        stretches = [slice(a, a + third) for a in np.linspace(0, count - third, 3).astype(int).tolist()]

    def cost(noise: Noise) -> float:
        white = float(np.mean(noise.sigma))
        return sum(pieces(noise, p).cost + (p.stop - p.start) * 2.0 * float(np.log(white)) for p in stretches)

    best = Noise(sigma if stated is None else stated)
    plain = least = cost(best)
    whites = (1.0,) if stated is not None else (1.0, 0.7)
    for length in _LENGTHS:
        for size in _SIZES:
            improved = False
            for share in whites:
                trial = Noise(max(share * sigma, floor) if stated is None else stated, size * sigma, length * spacing)
                value = cost(trial)
                if value < least - 1.0 and value < plain - _WORTH:
                    best, least, improved = trial, value, True
            if not improved and size >= 2.0:
                break
    if stated is None:
        for share in (0.7, 0.85, 1.2, 1.5, 2.0):
            trial = Noise(max(share * float(np.mean(best.sigma)), floor), best.correlated, best.length)
            value = cost(trial)
            if value < least - 1.0:
                best, least = trial, value
    return best
