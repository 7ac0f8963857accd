"""Limits: where a channel is beyond them, and which channels can be held against them at all.

Limits come from an editable table (`railnav.io.limits`); each value carries its source and whether it was read there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.channel import Channel
from railnav.monitoring.channels import Geometry
from railnav.monitoring.filters import stretches
from railnav.monitoring.rails import RAILS, axis_key, rail_key

FloatArray = NDArray[np.float64]

#: Levels of action, mildest first.
LEVELS = ("alert", "intervention", "immediate")
#: Names of quality classes, best first.
CLASSES = "ABCDE"
#: A channel is judged where its sigma is at most this share of the mildest limit.
FINE_ENOUGH = 1.0 / 3.0
#: A channel that is fine enough on less than this share of what the run covers is not judged at all.
LEAST_SHARE = 0.2
#: Stretches beyond a limit, of one sign and nearer than this, are one defect, m.
ONE_DEFECT = 2.0
#: A passage whose track is certain in less than this share of its rows is not judged: which track it shows is not known.
CERTAIN = 0.5


@dataclass(frozen=True, slots=True)
class Limit:
    """Limits of one channel in a range of speeds.

    Attributes
    ----------
    channel : str
        Key of the channel.
    speed : (float, float)
        Above, up to, m/s.
    radius : (float, float)
        From, below, m: of the model's curve.
    levels : mapping of str to (float, float)
        By level: low (negative) and high, in the channel's SI unit; from nominal for gauge.
    status : str
        "read", "recalled" or "own".
    source : str
    """

    channel: str
    speed: tuple[float, float]
    radius: tuple[float, float]
    levels: Mapping[str, tuple[float, float]]
    status: str
    source: str

    @property
    def mildest(self) -> str:
        """The mildest level that the table states."""
        return next(level for level in LEVELS if level in self.levels)


@dataclass(frozen=True, slots=True)
class ClassLimit:
    """Upper limits of the quality classes of a standard deviation over 200 m, m, best class first."""

    channel: str
    speed: tuple[float, float]
    limits: tuple[float, ...]
    status: str
    source: str


@dataclass(frozen=True, slots=True)
class Combination:
    """Weights of the combined standard deviation, by channel: a channel without one is left out."""

    weights: Mapping[str, float]
    status: str
    source: str


@dataclass(frozen=True, slots=True)
class LimitTable:
    """A table of limits.

    Attributes
    ----------
    name : str
    gauge : float
        Nominal gauge that it is for, m; NaN for any.
    limits : tuple of Limit
    deviations : tuple of Limit
        Of standard deviations over 200 m.
    classes : tuple of ClassLimit
    combined : Combination or None
        How standard deviations are combined into one.
    """

    name: str
    gauge: float
    limits: tuple[Limit, ...]
    deviations: tuple[Limit, ...]
    classes: tuple[ClassLimit, ...]
    combined: Combination | None = None

    @property
    def status(self) -> tuple[str, ...]:
        """Status of every entry: "read", "recalled" or "own"."""
        limits = tuple(limit.status for limit in (*self.limits, *self.deviations))
        combined = () if self.combined is None else (self.combined.status,)
        return limits + tuple(limit.status for limit in self.classes) + combined

    @property
    def recalled(self) -> int:
        """How many entries were recalled rather than read."""
        return self.status.count("recalled")

    def sourced(self) -> LimitTable:
        """The same table without what was recalled rather than read."""
        known = ("read", "own")
        return replace(
            self,
            limits=tuple(limit for limit in self.limits if limit.status in known),
            deviations=tuple(limit for limit in self.deviations if limit.status in known),
            classes=tuple(limit for limit in self.classes if limit.status in known),
            combined=self.combined if self.combined is not None and self.combined.status in known else None,
        )


@dataclass(frozen=True, slots=True)
class Exceedance:
    """One place where a channel is beyond a limit.

    Attributes
    ----------
    channel, title, unit : str
    level : str
        The severest level reached: "alert", "intervention" or "immediate".
    value, limit : float
        The extreme value (gauge: from nominal) and the limit of that level, SI.
    start, finish, peak : float
        Distances along the section: beyond the mildest limit from start to finish, the extreme at peak, m.
    track : str
    offset, chainage : float
        Of the extreme, m; chainage NaN where the model has no posts.
    easting, northing : float
        Of the extreme, on the model's axis, m.
    status, source : str
        Of the limit.
    run : str
    """

    channel: str
    title: str
    unit: str
    level: str
    value: float
    limit: float
    start: float
    finish: float
    peak: float
    track: str
    offset: float
    chainage: float
    easting: float
    northing: float
    status: str
    source: str
    run: str

    @property
    def length(self) -> float:
        """Length beyond the mildest limit, m."""
        return self.finish - self.start


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a channel was judged, and if not, why: `reason` is empty where it was; `share` of what the run covers was."""

    channel: str
    title: str
    sigma: float
    mildest: float
    reason: str
    share: float = 0.0


def exceedances(geometry: Geometry, table: LimitTable, speed: float) -> tuple[list[Exceedance], list[Verdict]]:
    """Hold the channels of a run against limits.

    Parameters
    ----------
    geometry : Geometry
    table : LimitTable
    speed : float
        Speed of the line, m/s.

    Returns
    -------
    list of Exceedance
        Severest first, then along the section.
    list of Verdict
        One for each channel that the table limits or the run gives: judged, or why not. A channel whose sigma is over a third of its
        mildest limit is not judged. Where a run shows both rails, the limits of level and alignment hold for each of them, and their
        axis is not judged again.
    """
    found: list[Exceedance] = []
    verdicts: list[Verdict] = []
    radius = 1.0 / np.maximum(np.abs(geometry.recording.points.curvature), 1e-9)
    named = {limit.channel for limit in table.limits}
    for key in (*geometry.channels, *sorted(named - set(geometry.channels))):
        channel = geometry.channels.get(key)
        title = channel.title if channel else key.replace("_", " ")
        mine = axis_key(key)
        limits = [limit for limit in table.limits if limit.channel == mine and holds(limit.speed, speed)]
        sigma = channel.sigma if channel else math.nan
        if channel is None:
            verdicts.append(Verdict(key, title, sigma, math.nan, geometry.refused.get(key, "not recorded")))
            continue
        if channel.band is not None and all(rail_key(key, rail) in geometry.channels for rail in RAILS):
            verdicts.append(Verdict(key, title, sigma, math.nan, "judged rail by rail"))
            continue
        if mine not in named:
            verdicts.append(Verdict(key, title, sigma, math.nan, "the table has no limit for it"))
            continue
        if not limits:
            verdicts.append(Verdict(key, title, sigma, math.nan, f"the table has no limit at {3.6 * speed:.0f} km/h"))
            continue
        if geometry.recording.passage.probability < CERTAIN:
            verdicts.append(Verdict(key, title, sigma, math.nan, "which track the run was on is not certain"))
            continue
        mildest = min(min(abs(v) for v in limit.levels[limit.mildest]) for limit in limits)
        fine = np.full(len(geometry.distance), sigma) if channel.local is None else channel.local
        known = np.isfinite(channel.values)
        judged = known & (fine <= FINE_ENOUGH * mildest)
        share = float(judged.sum() / known.sum()) if known.any() else 0.0
        if share < LEAST_SHARE:
            verdicts.append(Verdict(key, title, sigma, mildest, "its noise is over a third of the mildest limit"))
            continue
        verdicts.append(Verdict(key, title, sigma, mildest, "", share))
        for limit in limits:
            there = judged & (radius >= limit.radius[0]) & (radius < limit.radius[1])
            found += _beyond(geometry, channel, limit, there)
    order = {level: i for i, level in enumerate(reversed(LEVELS))}
    return sorted(found, key=lambda e: (order[e.level], e.peak)), verdicts


def holds(span: tuple[float, float], speed: float) -> bool:
    """Whether a speed lies in a range: above its lower end, up to its upper one."""
    return span[0] < speed <= span[1] + 1e-9


def _beyond(geometry: Geometry, channel: Channel, limit: Limit, there: NDArray[np.bool_]) -> list[Exceedance]:
    """The places of one channel beyond one limit."""
    section, distance = geometry.recording.passage.section, geometry.distance
    nominal = geometry.recording.gauge_nominal if channel.key == "gauge" else 0.0
    x = channel.values - nominal
    found = []
    low, high = limit.levels[limit.mildest]
    for sign, edge in ((1.0, high), (-1.0, -low)):
        over = there & (sign * x > edge)
        for a, b in _joined(stretches(over), round(ONE_DEFECT / geometry.recording.step)):
            k = a + int(np.nanargmax(sign * x[a:b]))
            reached = [
                level
                for level in LEVELS
                if level in limit.levels and sign * x[k] > sign * limit.levels[level][1 if sign > 0 else 0]
            ]
            bound = limit.levels[reached[-1]][1 if sign > 0 else 0]
            track, offset = section.locate(distance[k])
            point = section.at(distance[k])
            found.append(
                Exceedance(
                    channel=channel.key,
                    title=channel.title,
                    unit=channel.unit,
                    level=reached[-1],
                    value=float(x[k]),
                    limit=float(bound),
                    start=float(distance[a]) - 0.5 * geometry.recording.step,
                    finish=float(distance[b - 1]) + 0.5 * geometry.recording.step,
                    peak=float(distance[k]),
                    track=section.model.track_id[int(track)],
                    offset=float(offset),
                    chainage=float(point.chainage),
                    easting=float(point.easting),
                    northing=float(point.northing),
                    status=limit.status,
                    source=limit.source,
                    run=geometry.recording.run.id,
                )
            )
    return found


def _joined(parts: list[tuple[int, int]], within: int) -> list[tuple[int, int]]:
    out: list[tuple[int, int]] = []
    for a, b in parts:
        if out and a - out[-1][1] <= within:
            out[-1] = (out[-1][0], b)
        else:
            out.append((a, b))
    return out
