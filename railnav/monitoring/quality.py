"""Quality: how channels spread over segments of 200 m, which class that is, and one figure for all of them together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.monitoring.channels import Geometry
from railnav.monitoring.filters import D1
from railnav.monitoring.limits import CLASSES, ClassLimit, Combination, LimitTable, holds
from railnav.monitoring.rails import RAILS, axis_key, banded, rail_key

FloatArray = NDArray[np.float64]

#: Length over which standard deviations are taken, m, and the share of it that must be known.
SEGMENT, KNOWN = 200.0, 0.5
#: Key of the combined standard deviation.
COMBINED = "combined"
#: Channels that a combined standard deviation may weigh, all in D1.
COMBINABLE = ("longitudinal_level_d1", "alignment_d1", "gauge_d1", "cross_level_d1")


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """Standard deviation of one channel over one segment of a section.

    Attributes
    ----------
    channel : str
        Key of a banded channel, "gauge_d1", "cross_level_d1", or "combined".
    title : str
    start, finish : float
        Distance along the section, m.
    track : str
        At the middle.
    chainage : float
        At the middle, m.
    deviation : float
        Standard deviation about the segment's mean, m.
    grade : str
        Class A to E, or empty where the table has none.
    alert : float
        Alert limit of the standard deviation, m; NaN where the table has none.
    """

    channel: str
    title: str
    start: float
    finish: float
    track: str
    chainage: float
    deviation: float
    grade: str
    alert: float


def segments(geometry: Geometry, table: LimitTable, speed: float, *, length: float = SEGMENT) -> list[Segment]:
    """Standard deviations of the channels over segments of a section, with class and alert limit, and all of them combined.

    The combined standard deviation weighs those of longitudinal level, alignment, gauge and cross level, all in D1,

        CoSD = sqrt( w_L sigma_L^2 + w_A sigma_A^2 + w_G sigma_G^2 + w_C sigma_C^2 ),

    sigma_L and sigma_A being the means of both rails where a run shows them, those of the axis where not.

    Parameters
    ----------
    geometry : Geometry
    table : LimitTable
    speed : float
        Speed of the line, m/s.
    length : float
        Of a segment, m.

    Returns
    -------
    list of Segment
        Of the banded channels, of gauge and cross level in D1, and combined where the table has weights and every weighed channel is
        known; a segment of which less than half is known is left out.

    References
    ----------
    docs/theory/geometry.md (15).
    """
    section, step = geometry.recording.passage.section, geometry.recording.step
    n = round(length / step)
    count = len(geometry.distance) // n
    out: list[Segment] = []
    middle = (np.arange(count) + 0.5) * length
    track, _ = section.locate(middle)
    chainage = section.at(middle).chainage if count else middle
    spread = {
        key: (channel.title, deviations(channel.values, n))
        for key, channel in geometry.channels.items()
        if channel.band is not None
    }
    for name in ("gauge", "cross_level"):
        values = banded(geometry.recording, name, D1)
        if values is not None:
            spread[f"{name}_d1"] = (f"{name.replace('_', ' ').capitalize()} D1", deviations(values, n))
    if table.combined is not None:
        together = combined({key: values for key, (_, values) in spread.items()}, table.combined)
        if together is not None:
            spread[COMBINED] = ("Combined", together)
    for key, (title, deviation) in spread.items():
        mine = axis_key(key)
        classes = [c for c in table.classes if c.channel == mine and holds(c.speed, speed)]
        alert = [d for d in table.deviations if d.channel == mine and holds(d.speed, speed)]
        out += [
            Segment(
                channel=key,
                title=title,
                start=float(i * length),
                finish=float((i + 1) * length),
                track=section.model.track_id[int(track[i])],
                chainage=float(chainage[i]),
                deviation=float(deviation[i]),
                grade=grade(float(deviation[i]), classes[0]) if classes else "",
                alert=alert[0].levels["alert"][1] if alert and "alert" in alert[0].levels else math.nan,
            )
            for i in np.flatnonzero(np.isfinite(deviation))
        ]
    return out


def combined(spread: Mapping[str, FloatArray], how: Combination) -> FloatArray | None:
    """Combined standard deviation of segments; None where a weighed channel is missing.

    Parameters
    ----------
    spread : mapping of str to (n,) array
        Standard deviations by channel, m.
    how : Combination

    Returns
    -------
    (n,) array or None
        m; NaN in segments where a weighed channel is not known.

    References
    ----------
    docs/theory/geometry.md (15).

    Examples
    --------
    >>> how = Combination({"longitudinal_level_d1": 1.0, "alignment_d1": 0.5}, "own", "")
    >>> made = {"longitudinal_level_left_d1": np.array([1e-3]), "longitudinal_level_right_d1": np.array([2e-3])}
    >>> (1e3 * combined(made | {"alignment_d1": np.array([1e-3])}, how)).round(3)
    array([1.658])
    """
    total: FloatArray | None = None
    for key, weight in how.weights.items():
        if weight == 0.0:
            continue
        rails = [rail_key(key, rail) for rail in RAILS] if key.startswith(("longitudinal_level", "alignment")) else []
        if rails and all(rail in spread for rail in rails):
            sigma = np.mean([spread[rail] for rail in rails], axis=0)
        elif key in spread:
            sigma = spread[key]
        else:
            return None
        total = weight * sigma**2 + (0.0 if total is None else total)
    return None if total is None else np.sqrt(total)


def deviations(values: FloatArray, count: int) -> FloatArray:
    """Standard deviation of each whole block of samples about its mean; NaN where less than half is known.

    Examples
    --------
    >>> deviations(np.array([1.0, -1.0, 1.0, -1.0, np.nan, np.nan, np.nan, 2.0]), 4)
    array([ 1., nan])
    """
    if count < 2:
        raise TrackError(f"a standard deviation of {count} samples is none")
    blocks = values[: len(values) // count * count].reshape(-1, count)
    known = np.isfinite(blocks)
    n = known.sum(axis=1)
    filled = np.where(known, blocks, 0.0)
    mean = filled.sum(axis=1) / np.maximum(n, 1)
    square = np.where(known, (blocks - mean[:, None]) ** 2, 0.0).sum(axis=1) / np.maximum(n, 1)
    return np.where(n >= KNOWN * count, np.sqrt(square), np.nan)


def grade(deviation: float, limits: ClassLimit) -> str:
    """Class of a standard deviation: the first whose upper limit it does not pass.

    Examples
    --------
    >>> grade(0.9e-3, ClassLimit("longitudinal_level_d1", (0.0, 40.0), (0.75e-3, 1.1e-3, 1.8e-3, 2.5e-3), "read", ""))
    'B'
    """
    return CLASSES[int(np.searchsorted(limits.limits, deviation, side="left"))]
