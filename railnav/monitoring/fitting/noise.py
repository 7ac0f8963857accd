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

from railnav.monitoring.fitting.segmentation import Noise, Pieces, unlikeliness

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: A fourth difference of white noise has this many times its variance.
_FOURTH = 70.0
#: Differences of smooth points grow sixteenfold as the spacing doubles, those of white noise not; points are thinned above this.
_STILL_SMOOTH = 2.5
#: Smoothed points are taken so far apart that they differ by this share of their stated sigma.
_SHARE = 0.25
#: Spacing up to which points are thinned, m: those of a model, whose errors are known to be smooth, not past its transitions.
_FARTHEST, _FARTHEST_SMOOTH = 200.0, 32.0
#: Errors of smoothed points: shares of what they state, lengths in m, and white noise as a share of the waves that are tried.
_SHARES = (0.5, 1.0, 2.0)
_LENGTHS = (25.0, 50.0, 100.0, 200.0, 400.0, 800.0)
_WHITES = (0.003, 0.01, 0.03, 0.1)
#: Samples on which the waves of the noise are judged.
_JUDGED = 1200
#: Steps of the search for waves, in logarithms, and how many noises are tried.
_STRIDES = (1.1, 0.5)
_TRIALS = 32
#: Longer waves bend no element: spacings, m.
_LONGEST, _LONGEST_WAVE = 8.0, 120.0
#: Residuals that tell the noise, at most.
_RESIDUALS = 6000
#: Waves must be likelier than none by this, in -2 log likelihood.
WAVES_WORTH = 25.0
#: Waves are at most this many times the white noise that differences a metre apart show: larger ones are the track's own.
_LARGEST = 5.0


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


def resolution(
    across: Callable[[int], FloatArray], spacing: float, count: int, *, floor: float, stated: float | None = None
) -> Resolution:
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
    stated : float, optional
        Sigma that smoothed points state, m: they are thinned until they differ by a share of it.
    """
    sizes = {}

    def sigma(every: int) -> float:
        if every not in sizes:
            fourth = across(every)
            sizes[every] = float(np.median(np.abs(fourth)) / 0.6745 / np.sqrt(_FOURTH)) if len(fourth) else 0.0
        return sizes[every]

    every = 1
    while (
        2 * every * 24 < count
        and 2 * every * spacing <= (_FARTHEST if stated is None else _FARTHEST_SMOOTH)
        and (sigma(2 * every) > _STILL_SMOOTH * sigma(every) or (stated is not None and sigma(every) < 0.1 * floor))
        and (sigma(2 * every) > floor if stated is None else sigma(every) < _SHARE * stated)
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
    largest: float = 0.0,
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
    largest : float
        Waves may be as large as this in any case: what smoothed points state of themselves, m.
    """
    cost = _cost_of(pieces, count)

    def noise_of(place: tuple[float, float, float]) -> Noise:
        """From logarithms: white noise, growth of the waves over one spacing, their length."""
        white, growth, length = np.exp(place)
        size = growth * np.sqrt(0.5 * length / spacing)
        return Noise(max(float(white), floor) if stated is None else stated, float(size), float(length))

    plain = Noise(sigma if stated is None else stated)
    least_plain = cost(plain)
    if stated is None:
        for share in (0.8, 1.25):
            trial = Noise(max(share * sigma, floor))
            value = cost(trial)
            if value < least_plain:
                plain, least_plain = trial, value
    if sigma <= 1.01 * floor and stated is None:
        return plain  # exact points have no waves
    white = 0.3 * sigma if stated is None else stated
    most = max(_LARGEST * sigma * max(1.0, spacing**-0.5), largest)
    place = (float(np.log(white)), float(np.log(1.2 * sigma)), float(np.log(8.0 * spacing)))
    known = {place: cost(noise_of(place))}
    low = (np.log(floor), np.log(1e-3 * sigma), np.log(2.0 * spacing))
    high = (np.log(4.0 * sigma), np.log(8.0 * sigma), np.log(max(_LONGEST * spacing, _LONGEST_WAVE)))
    for stride in _STRIDES:
        moved = True
        while moved and len(known) < _TRIALS:
            moved = False
            for axis in range(3) if stated is None else (1, 2):
                for sense in (1.0, -1.0):
                    trial_place = list(place)
                    trial_place[axis] = float(np.clip(place[axis] + sense * stride, low[axis], high[axis]))
                    there = (trial_place[0], trial_place[1], trial_place[2])
                    if there in known:
                        continue
                    trial = noise_of(there)
                    known[there] = cost(trial) if trial.correlated <= most else np.inf
                    if known[there] < known[place] - 0.5:
                        place, moved = there, True
                        break
    if known[place] < least_plain - WAVES_WORTH:
        return noise_of(place)
    return plain


def likeliest_smooth(
    pieces: Callable[[Noise, slice], Pieces], count: int, size: float, *, floor: float, stated: float | None = None
) -> Noise:
    """Noise of points that come from smoothing: waves with a slope, about as large as the points state.

    Their length, size and the white rest are those under which the points, elements and all, are likeliest.

    Parameters
    ----------
    pieces : callable
        From a noise and a stretch of samples to its pieces and their cost.
    count : int
        Samples.
    size : float
        Sigma that the points state, m.
    floor : float
        Least white noise, m.
    stated : float, optional
        White noise that the user states, m.
    """
    cost = _cost_of(pieces, count)

    def noise_of(place: tuple[int, int, int]) -> Noise:
        waves = size * _SHARES[place[0]]
        return Noise(
            max(_WHITES[place[2]] * size, floor) if stated is None else stated, waves, _LENGTHS[place[1]], True
        )

    most = (len(_SHARES), len(_LENGTHS), len(_WHITES) if stated is None else 1)
    place = (1, 2, min(1, most[2] - 1))
    known = {place: cost(noise_of(place))}
    moved = True
    while moved:
        moved = False
        for axis in (1, 2, 0):
            for sense in (1, -1):
                while True:
                    there = tuple(v + sense * (k == axis) for k, v in enumerate(place))
                    if not 0 <= there[axis] < most[axis]:
                        break
                    trial = (there[0], there[1], there[2])
                    if trial not in known:
                        known[trial] = cost(noise_of(trial))
                    if known[trial] >= known[place] - 0.5:
                        break
                    place, moved = trial, True
    return noise_of(place)


def of_residuals(along: FloatArray, residual: FloatArray, noise: Noise, *, floor: float, stated: float | None) -> Noise:
    """The noise under which what is left of the points is likeliest, from a first guess.

    Elements found, waves tell their size and length better than while elements are looked for.
    """
    from scipy.optimize import minimize

    middle = (
        slice(0, len(along))
        if len(along) <= _RESIDUALS
        else slice(*(len(along) // 2 + np.array([-1, 1]) * _RESIDUALS // 2))
    )
    place, off = along[middle], residual[middle]
    spacing = float(np.median(np.diff(place)))

    def of(logs: FloatArray) -> Noise:
        white = max(float(np.exp(logs[0])), floor) if stated is None else stated
        return Noise(
            white, float(np.exp(logs[1])), float(np.clip(np.exp(logs[2]), spacing, _LONGEST_WAVE)), noise.smooth
        )

    first = np.log([float(np.mean(noise.sigma)), noise.correlated, noise.length])
    found = minimize(
        lambda logs: unlikeliness(place, off, of(logs)),
        first,
        method="Nelder-Mead",
        options={
            "maxfev": 120,
            "xatol": 0.02,
            "fatol": 0.1,
            "initial_simplex": first + np.vstack([np.zeros(3), -0.7 * np.eye(3)]),
        },
    )
    return of(found.x)


def _cost_of(pieces: Callable[[Noise, slice], Pieces], count: int) -> Callable[[Noise], float]:
    """-2 log likelihood of the points under a noise, on some stretches of a long track."""
    if count <= _JUDGED:
        stretches = [slice(0, count)]
    else:
        third = _JUDGED // 3
        stretches = [slice(a, a + third) for a in np.linspace(0, count - third, 3).astype(int).tolist()]

    def cost(noise: Noise) -> float:
        white = float(np.mean(noise.sigma))
        return sum(pieces(noise, p).cost + (p.stop - p.start) * 2.0 * float(np.log(white)) for p in stretches)

    return cost
