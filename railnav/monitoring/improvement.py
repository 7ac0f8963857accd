"""What a lining plan makes of the channels, band by band, and in which bands the measured axis bears corrections at all."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.filters import D1, D2, D3_ALIGNMENT, D3_LEVEL, band_pass
from railnav.monitoring.limits import FINE_ENOUGH
from railnav.monitoring.position import MeasuredAxis, band_sigma

FloatArray = NDArray[np.float64]
#: Values before and after a plan, by channel and band.
BeforeAfter = Mapping[tuple[str, str], tuple[FloatArray, FloatArray]]

#: The channels that lining changes, and their bands.
LINED = {"alignment": (D1, D2, D3_ALIGNMENT), "longitudinal_level": (D1, D2, D3_LEVEL)}


def improved(right: FloatArray, slew: FloatArray, up: FloatArray, lift: FloatArray, step: float) -> BeforeAfter:
    """Alignment and longitudinal level in their bands, before and after a plan.

    Parameters
    ----------
    right, up : (n,) array
        Of the track beside and above its base line, m; a channel with a value unknown is left out.
    slew, lift : (n,) array
        Corrections to the right and up, m.
    step : float
        m.

    Returns
    -------
    mapping of (str, str) to (array, array)
        By channel and band ("alignment", "D1"), m; NaN near the ends. Bands that the step or the length does not bear are left out.

    Examples
    --------
    >>> wave = 0.01 * np.sin(2 * np.pi * np.arange(800) / 40.0)
    >>> made = improved(wave, -0.5 * wave, np.empty(0), np.empty(0), 1.0)
    >>> [(key, round(float(np.nanmax(after / before)), 6)) for key, (before, after) in made.items() if key[1] == "D2"]
    [(('alignment', 'D2'), 0.5)]
    """
    found: dict[tuple[str, str], tuple[FloatArray, FloatArray]] = {}
    for (name, bands), values, change in zip(LINED.items(), (right, up), (slew, lift), strict=True):
        if not (len(values) and np.isfinite(values).all() and np.isfinite(change).all()):
            continue
        for band in bands:
            if step <= band.lower / 3.0 and len(values) * step > 4.0 * band.upper:
                found[name, band.name] = band_pass(values, step, band), band_pass(values + change, step, band)
    return found


def spread_of(channels: BeforeAfter) -> dict[tuple[str, str], tuple[float, float]]:
    """Standard deviations of channels before and after, m.

    Examples
    --------
    >>> spread_of({("alignment", "D1"): (np.array([1.0, -1.0]), np.array([0.5, -0.5]))})
    {('alignment', 'D1'): (1.0, 0.5)}
    """
    return {key: (float(np.nanstd(before)), float(np.nanstd(after))) for key, (before, after) in channels.items()}


def borne(
    measured: MeasuredAxis, spread: Mapping[tuple[str, str], tuple[float, float]]
) -> dict[tuple[str, str], tuple[float, bool]]:
    """Sigma of a measured axis in each band, m, and whether it bears corrections there: at most a third of what was found.

    Parameters
    ----------
    measured : MeasuredAxis
    spread : mapping of (str, str) to (float, float)
        As `spread_of` gives it; its bands are judged.

    Returns
    -------
    dict of (str, str) to (float, bool)
        The sigma is NaN, and the answer no, where the noise of the axis is not known.
    """
    found = {}
    for (name, bands), noise in zip(LINED.items(), (measured.noise_right, measured.noise_up), strict=True):
        for band in bands:
            if (name, band.name) in spread:
                sigma = band_sigma(noise, band)
                found[name, band.name] = (sigma, sigma <= FINE_ENOUGH * spread[name, band.name][0])
    return found


def borne_in_words(bears: Mapping[tuple[str, str], tuple[float, bool]]) -> list[str]:
    """Which bands the accuracy of the axis allows, in words, where it does not allow all.

    Examples
    --------
    >>> borne_in_words({("alignment", "D1"): (0.001, False), ("alignment", "D2"): (0.0, True)})
    ['the accuracy of the axis allows corrections in alignment D2; in alignment D1 they follow noise']
    """
    if not bears or all(good for _, good in bears.values()):
        return []
    words = {key: f"{key[0].replace('_', ' ')} {key[1]}" for key in bears}
    allowed = ", ".join(words[key] for key, (_, good) in bears.items() if good) or "none of the bands up to 200 m"
    wanting = ", ".join(words[key] for key, (_, good) in bears.items() if not good)
    return [f"the accuracy of the axis allows corrections in {allowed}; in {wanting} they follow noise"]
