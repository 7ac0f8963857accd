"""Rail by rail: longitudinal level and alignment of the left and the right rail, from the track's axis, cross level and gauge.

Left and right are those of growing distance, as everywhere on a section, whichever way the vehicle ran.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.channel import SAMPLES_A_WAVE, Channel
from railnav.monitoring.filters import Band, band_noise, band_pass
from railnav.monitoring.recording import Recording, Series

FloatArray = NDArray[np.float64]

#: The rails, and what cross level (up) and gauge (right) add to each: the left rail rises with cross level and moves out with gauge.
RAILS = {"left": (0.5, -0.5), "right": (-0.5, 0.5)}


def rail_key(key: str, rail: str) -> str:
    """Key of a rail's channel: longitudinal_level_left_d1.

    Examples
    --------
    >>> rail_key("alignment_d2", "right")
    'alignment_right_d2'
    """
    name, band = key.rsplit("_", 1)
    return f"{name}_{rail}_{band}"


def axis_key(key: str) -> str:
    """Key of the channel of the axis that a rail's channel belongs to; any other key as it is.

    Limits are stated by it: what holds for longitudinal level holds for each rail.

    Examples
    --------
    >>> axis_key("longitudinal_level_left_d1"), axis_key("gauge")
    ('longitudinal_level_d1', 'gauge')
    """
    for rail in RAILS:
        key = key.replace(f"_{rail}_d", "_d")
    return key


def rail_channels(recording: Recording, axis: Mapping[str, Channel]) -> tuple[dict[str, Channel], dict[str, str]]:
    """Longitudinal level and alignment of each rail, in every band that the axis and the other rail's distance support.

    Left and right rail stand half the cross level above and below the axis, and half the gauge beside it; in a band,

        z_left, z_right = z +- H(c - c_model) / 2,        y_left, y_right = y -+ H(g - g_nominal) / 2.

    The model's cant is taken off where its shape is (`Recording.against_model`), so that its ramps are no irregularities.

    Parameters
    ----------
    recording : Recording
    axis : mapping of str to Channel
        The banded channels of the axis: longitudinal_level_d0, ..., alignment_d3.

    Returns
    -------
    channels : dict of str to Channel
    refused : dict of str to str
        Rails that are not given though the axis is, and why.

    References
    ----------
    docs/theory/geometry.md (14).
    """
    channels: dict[str, Channel] = {}
    refused: dict[str, str] = {}
    halves: dict[tuple[str, Band], tuple[FloatArray, float] | str] = {}
    for key, channel in axis.items():
        band = channel.band
        if band is None or not key.startswith(("longitudinal_level_", "alignment_")):
            continue
        level = key.startswith("longitudinal_level_")
        of = "cross_level" if level else "gauge"
        if (of, band) not in halves:
            halves[of, band] = _banded(recording, of, band)
        found = halves[of, band]
        for rail, (rise, out) in RAILS.items():
            if isinstance(found, str):
                refused[rail_key(key, rail)] = found
                continue
            other, noise = found
            local = None if channel.local is None else np.hypot(channel.local, 0.5 * noise)
            channels[rail_key(key, rail)] = Channel(
                rail_key(key, rail),
                f"{channel.title}, {rail} rail",
                channel.unit,
                channel.values + (rise if level else out) * other,
                math.hypot(channel.sigma, 0.5 * noise),
                f"{channel.source} and {recording.series[of].source}",
                band,
                max(channel.spacing, recording.series[of].spacing),
                local,
            )
    return channels, refused


def banded(recording: Recording, of: str, band: Band) -> FloatArray | None:
    """Cross level (less the model's cant, where its shape is taken off) or gauge in a band, m; None where the run has none fine enough."""
    found = _banded(recording, of, band)
    return None if isinstance(found, str) else found[0]


def _banded(recording: Recording, of: str, band: Band) -> tuple[FloatArray, float] | str:
    """Values in the band and their noise, or why there are none."""
    series: Series | None = recording.series.get(of)
    word = of.replace("_", " ")
    if series is None:
        return recording.refused.get(of, f"the run has no {word}: the rails cannot be told from the axis")
    if not series.spacing <= band.lower / SAMPLES_A_WAVE:
        return f"{word} was sampled each {series.spacing:.1f} m; {band.name} takes {band.lower / SAMPLES_A_WAVE:.1f} m"
    values = series.values
    if of == "cross_level" and recording.against_model:
        values = values - recording.points.cant
    inside = band_pass(values, recording.step, band)
    if not np.isfinite(inside).any():
        return f"no stretch of {word} without a gap is longer than {2 * band.settling:g} m"
    return inside, band_noise(series.noise, series.spacing, band)
