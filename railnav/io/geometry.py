"""Tables of track geometry: channels along the line, exceedances, quality over 200 m and its growth, CSV or Parquet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railnav.io.addresses import addresses
from railnav.io.atomic import atomic_path
from railnav.io.tables import Words, write_table
from railnav.monitoring.limits import Exceedance
from railnav.monitoring.monitor import Report
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

#: Factor, ending of the column and decimals of each SI unit.
_UNITS = {"m": (1e3, "_mm", 3), "m/m": (1e3, "_mm_m", 4), "1/m": (1.0, "_1_m", 8)}


def write_channels(report: Report, path: str | Path) -> int:
    """Write every channel of every run, one row a place.

    Columns: `run, section, distance_m, track, offset_m, chainage_km, easting_m, northing_m, speed_kmh`, then the channels (`gauge_mm,
    cross_level_mm, twist_3m_mm_m, longitudinal_level_d1_mm, ..., curvature_1_m`); empty where a run gives none.

    Parameters
    ----------
    report : Report
    path : path
        .csv or .parquet; replaced whole or not at all.

    Returns
    -------
    int
        Rows written: those where the run was.
    """
    units: dict[str, str] = {}
    for part in report.sections:
        for geometry in part.geometries:
            units.update({key: channel.unit for key, channel in geometry.channels.items()})
    columns: dict[str, list[FloatArray]] = {}
    texts: dict[str, list[str]] = {"run": [], "section": []}
    tracks: list[NDArray[np.int64]] = []
    for part in report.sections:
        for geometry in part.geometries:
            r = geometry.recording
            there = np.flatnonzero(np.isfinite(r.time))
            d = r.distance[there]
            track, offset = part.section.locate(d)
            point = part.section.at(d)
            tracks.append(np.asarray(track, np.int64))
            texts["run"] += [r.run.id] * len(there)
            texts["section"] += [part.section.name] * len(there)
            row = {
                "distance_m": d,
                "offset_m": offset,
                "chainage_km": point.chainage / 1e3,
                "easting_m": point.easting,
                "northing_m": point.northing,
                "speed_kmh": 3.6 * r.speed[there],
            }
            for key, unit in units.items():
                factor, ending, _ = _UNITS[unit]
                channel = geometry.channels.get(key)
                row[key + ending] = np.full(len(there), np.nan) if channel is None else channel.values[there] * factor
            for name, values in row.items():
                columns.setdefault(name, []).append(values)
    table: dict[str, FloatArray | Words] = {
        "run": Words.of(texts["run"]),
        "section": Words.of(texts["section"]),
        "track": Words(np.concatenate(tracks), report.model.track_id),
    }
    table |= {name: np.concatenate(parts) for name, parts in columns.items()}
    decimals = {"distance_m": 3, "offset_m": 3, "chainage_km": 6, "easting_m": 3, "northing_m": 3, "speed_kmh": 1}
    decimals |= {key + _UNITS[unit][1]: _UNITS[unit][2] for key, unit in units.items()}
    with atomic_path(path) as draft:
        write_table(draft, table, decimals=decimals)
    return len(texts["run"])


def write_exceedances(found: Sequence[Exceedance], path: str | Path, *, model: TrackModel | None = None) -> None:
    """Write exceedances, one row a place: channel, level, value, limit, track, offset, chainage, coordinates, status, source, run.

    Parameters
    ----------
    found : sequence of Exceedance
    path : path
        .csv or .parquet; replaced whole or not at all. Values and limits are millimetres (twist: mm/m).
    model : TrackModel, optional
        Adds `address`, as published, where it has line references.
    """

    def numbers(name: str, factor: float = 1.0) -> FloatArray:
        return np.array([factor * float(getattr(e, name)) for e in found], float)

    table: dict[str, FloatArray | Words] = {
        "channel": Words.of(e.channel for e in found),
        "level": Words.of(e.level for e in found),
        "value_mm": numbers("value", 1e3),
        "limit_mm": numbers("limit", 1e3),
        "length_m": numbers("length"),
        "track": Words.of(e.track for e in found),
        "offset_m": numbers("offset"),
        "chainage_km": numbers("chainage", 1e-3),
        **({} if model is None else _address(found, model)),
        "easting_m": numbers("easting"),
        "northing_m": numbers("northing"),
        "status": Words.of(e.status for e in found),
        "source": Words.of(e.source for e in found),
        "run": Words.of(e.run for e in found),
    }
    decimals = {
        "value_mm": 2,
        "limit_mm": 2,
        "length_m": 2,
        "offset_m": 2,
        "chainage_km": 5,
        "easting_m": 3,
        "northing_m": 3,
    }
    with atomic_path(path) as draft:
        write_table(draft, table, decimals=decimals)


def _address(found: Sequence[Exceedance], model: TrackModel) -> dict[str, Words]:
    track = np.array([model.track_index(e.track) for e in found], np.int64)
    where = addresses(model, track, np.array([e.offset for e in found], float))
    return {} if where is None else {"address": where}


def write_quality(report: Report, path: str | Path) -> int:
    """Write standard deviations over segments of 200 m, one row a channel, segment and run.

    Columns: `run, section, channel, track, from_m, to_m, chainage_km` (of the middle), `deviation_mm, alert_mm, class`.

    Parameters
    ----------
    report : Report
    path : path
        .csv or .parquet; replaced whole or not at all.

    Returns
    -------
    int
        Rows written.
    """
    rows = [
        (geometry.recording.run.id, part.section.name, segment)
        for part in report.sections
        for geometry, graded in zip(part.geometries, part.segments, strict=True)
        for segment in graded
    ]

    def numbers(name: str, factor: float = 1.0) -> FloatArray:
        return np.array([factor * float(getattr(segment, name)) for _, _, segment in rows], float)

    table: dict[str, FloatArray | Words] = {
        "run": Words.of(run for run, _, _ in rows),
        "section": Words.of(section for _, section, _ in rows),
        "channel": Words.of(segment.channel for _, _, segment in rows),
        "track": Words.of(segment.track for _, _, segment in rows),
        "from_m": numbers("start"),
        "to_m": numbers("finish"),
        "chainage_km": numbers("chainage", 1e-3),
        "deviation_mm": numbers("deviation", 1e3),
        "alert_mm": numbers("alert", 1e3),
        "class": Words.of(segment.grade for _, _, segment in rows),
    }
    decimals = {"from_m": 1, "to_m": 1, "chainage_km": 5, "deviation_mm": 4, "alert_mm": 3}
    with atomic_path(path) as draft:
        write_table(draft, table, decimals=decimals)
    return len(rows)


def write_trends(report: Report, path: str | Path) -> int:
    """Write the growth of standard deviations over segments of 200 m, one row a channel and segment.

    Columns: `section, channel, track, offset_m` (where the segment begins), `distance_m, chainage_km, runs, months` (between the first run
    and the last), `first_mm, last_mm` (standard deviations), `growth_mm_month, sigma_mm_month, probability` (of a growth this large by
    chance), `significant` (1 or 0).

    Parameters
    ----------
    report : Report
    path : path
        .csv or .parquet; replaced whole or not at all.

    Returns
    -------
    int
        Rows written: segments that two dates know.
    """
    texts: dict[str, list[str]] = {"section": [], "channel": []}
    tracks: list[NDArray[np.int64]] = []
    columns: dict[str, list[FloatArray]] = {}
    for part in report.sections:
        for trend in part.trends:
            g = trend.growth
            rows = np.flatnonzero(np.isfinite(g.rate))
            start = trend.start[rows]
            track, offset = part.section.locate(start)
            tracks.append(np.atleast_1d(np.asarray(track, np.int64)))
            texts["section"] += [part.section.name] * len(rows)
            texts["channel"] += [trend.channel] * len(rows)
            row = {
                "offset_m": offset,
                "distance_m": start,
                "chainage_km": part.section.at(start).chainage / 1e3,
                "runs": np.full(len(rows), float(len(trend.months))),
                "months": np.full(len(rows), float(np.ptp(trend.months))),
                "first_mm": 1e3 * trend.values[int(np.argmin(trend.months)), rows],
                "last_mm": 1e3 * trend.values[int(np.argmax(trend.months)), rows],
                "growth_mm_month": 1e3 * g.rate[rows],
                "sigma_mm_month": 1e3 * g.sigma[rows],
                "probability": g.probability[rows],
                "significant": g.significant[rows].astype(float),
            }
            for name, values in row.items():
                columns.setdefault(name, []).append(np.asarray(values, float))
    empty = np.empty(0)
    names = "offset_m distance_m chainage_km runs months first_mm last_mm growth_mm_month sigma_mm_month probability significant"
    table: dict[str, FloatArray | Words] = {
        "section": Words.of(texts["section"]),
        "channel": Words.of(texts["channel"]),
        "track": Words(np.concatenate([np.empty(0, np.int64), *tracks]), report.model.track_id),
    }
    table |= {name: np.concatenate([empty, *columns.get(name, [])]) for name in names.split()}
    decimals = {
        "offset_m": 1,
        "distance_m": 1,
        "chainage_km": 5,
        "runs": 0,
        "months": 2,
        "significant": 0,
        "probability": 8,
    }
    decimals |= dict.fromkeys(("first_mm", "last_mm"), 4) | dict.fromkeys(("growth_mm_month", "sigma_mm_month"), 5)
    with atomic_path(path) as draft:
        write_table(draft, table, decimals=decimals)
    return len(texts["section"])
