"""One channel of track geometry: values along a section, how good they are, and where they come from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.filters import Band

FloatArray = NDArray[np.float64]

#: A displacement's wavelength needs this many samples.
SAMPLES_A_WAVE = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One channel on the grid of a section.

    Attributes
    ----------
    key : str
        e.g. "longitudinal_level_d1", "twist_3m", "gauge".
    title : str
        In words.
    unit : str
        SI unit of the values: "m", "m/m" or "1/m".
    values : (n,) array
        NaN where there is no answer.
    sigma : float
        Standard deviation of a value: by the white noise of the samples, at most, and for bands by the error of place as well; NaN unknown.
    source : str
        The stream, in words.
    band : Band or None
    spacing : float
        Distance between raw samples, m.
    local : (n,) array or None
        Standard deviation place by place, where it differs: in bands, an error of place costs most where the model's shape, taken off, is
        sharpest.
    """

    key: str
    title: str
    unit: str
    values: FloatArray
    sigma: float
    source: str
    band: Band | None = None
    spacing: float = math.nan
    local: FloatArray | None = None
