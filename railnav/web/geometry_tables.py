"""Tables of the page of track geometry: what the runs can bear, quality over 200 m, growth, and where each run lies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from railnav.web import words
from railnav.web.page import Section, Table, Warnings

if TYPE_CHECKING:
    from railnav.monitoring.channel import Channel
    from railnav.monitoring.monitor import Report

#: Factor and word of the unit that a page shows.
SHOWN = {"m": (1e3, "mm"), "m/m": (1e3, "mm/m"), "1/m": (1e3, "1/km")}


def ability_section(report: Report) -> Section:
    """Which channels and bands the runs can bear, and which not."""
    merged: dict[tuple[str, str, str, str], list[tuple[str, Channel]]] = {}
    wanting: dict[tuple[str, str], dict[str, None]] = {}
    count = len({g.recording.run.id for part in report.sections for g in part.geometries})
    for part in report.sections:
        for geometry, verdicts in zip(part.geometries, part.verdicts, strict=True):
            run = geometry.recording.run.id
            for v in verdicts:
                channel = geometry.channels.get(v.channel)
                if channel is not None:
                    judged = words.share(round(v.share, 2)) if not v.reason else "channel only"
                    merged.setdefault((v.title, channel.source, v.reason, judged), []).append((run, channel))
            for key, reason in geometry.refused.items():
                wanting.setdefault((key, reason), {})[run] = None
    text = (
        "A band is given where its shortest wave is sampled three times, and judged where the noise is at most a third of the "
        "mildest limit. Sigma is that of the samples' white noise, at most, and in bands of the place; long-wave distances from the "
        "model by GNSS state their whole scatter. Sensors on a sprung body do not show the rails above some hertz."
    )
    columns = ("channel", "runs", "from", "why not judged", "sample each, m", "sigma at most", "judged")
    rows = []
    for (title, source, reason, judged), having in sorted(merged.items(), key=lambda item: item[0][0].lower()):
        channels = [channel for _, channel in having]
        runs = sorted({run for run, _ in having})
        worst = max(channels, key=lambda c: c.sigma if np.isfinite(c.sigma) else -1.0)
        spacing = f"{max(c.spacing for c in channels):.2f}"
        named = "all" if len(runs) == count > 1 else f"{len(runs)} runs" if len(runs) > 2 else ", ".join(runs)
        rows.append([title, named, source, reason, spacing, _sigma(worst), judged])
    tables = [Table(columns, _both_rails(rows), left=4)] if rows else []
    if wanting:
        grouped: dict[str, list[str]] = {}
        for (key, reason), lacking in wanting.items():
            said = reason if len(lacking) == count else f"{', '.join(lacking)}: {reason}"
            grouped.setdefault(said, []).append(words.channel(key))
        lines = [[", ".join(keys), said] for said, keys in grouped.items()]
        tables.append(Table(("not given", "why"), lines, left=2))
    return Section("What these runs can bear", text, tables)


def _both_rails(rows: list[list[str]]) -> list[list[str]]:
    """Rows in which the left and the right rail say the same, as one."""
    out: list[list[str]] = []
    for row in rows:
        left = row[0].replace(", right rail", ", left rail")
        if left != row[0] and [left, *row[1:]] in out:
            out[out.index([left, *row[1:]])][0] = row[0].replace(", right rail", ", each rail")
        else:
            out.append(row)
    return out


def _sigma(channel: Channel) -> str:
    if not np.isfinite(channel.sigma):
        return ""
    factor, unit = SHOWN[channel.unit]
    return f"{words.figures(channel.sigma * factor, 2)} {unit}"


def quality_section(report: Report) -> Section:
    """Standard deviations over 200 m and classes, by section, run and channel."""
    columns = (
        "section",
        "run",
        "channel",
        "segments",
        "median",
        "90 %",
        "largest",
        "over alert",
        "A",
        "B",
        "C",
        "D",
        "E",
    )
    rows = []
    for part in report.sections:
        for geometry, graded in zip(part.geometries, part.segments, strict=True):
            for key in dict.fromkeys(s.channel for s in graded):
                mine = [s for s in graded if s.channel == key]
                sd = 1e3 * np.array([s.deviation for s in mine])
                over = sum(s.deviation > s.alert for s in mine)
                graded_any = any(s.grade for s in mine)
                rows.append(
                    [
                        part.section.name,
                        geometry.recording.run.id,
                        mine[0].title,
                        f"{len(mine):,}",
                        *(f"{v:.2f}" for v in (np.median(sd), np.quantile(sd, 0.9), sd.max())),
                        f"{over:,}" if np.isfinite(mine[0].alert) else "",
                        *((f"{sum(s.grade == g for s in mine):,}" if graded_any else "") for g in "ABCDE"),
                    ]
                )
    text = "Standard deviations over segments of 200 m, mm, and how many segments fall into each class. "
    combined = report.table.combined
    if combined is not None:
        weights = ", ".join(f"{words.channel(key)} by {weight:g}" for key, weight in combined.weights.items())
        text += f"Combined weighs {weights} ({combined.status}: {combined.source})."
    return Section("Quality", text, [Table(columns, rows, left=3)] if rows else [])


def trend_section(report: Report) -> Section:
    """Segments that change significantly, fastest first."""
    rows = []
    summary = []
    for part in report.sections:
        for trend in part.trends:
            g = trend.growth
            known = np.isfinite(g.rate)
            summary.append(
                f"{trend.title}, {part.section.name}: {int(g.significant.sum())} of {int(known.sum())} segments change significantly; one "
                f"standard deviation over 200 m repeats within {words.length(g.noise, 2)}."
            )
            for i in sorted(np.flatnonzero(g.significant), key=lambda k: -abs(g.rate[k]))[:25]:
                track, offset = part.section.locate(trend.start[i])
                rows.append(
                    [
                        trend.title,
                        report.model.track_id[int(track)],
                        f"{float(offset):,.0f}",
                        f"{1e3 * trend.values[0, i]:.2f}",
                        f"{1e3 * trend.values[-1, i]:.2f}",
                        f"{1e3 * g.rate[i]:+.3f}",
                        f"{1e3 * g.sigma[i]:.3f}",
                        f"{g.probability[i]:.1e}",
                    ]
                )
    columns = (
        "channel",
        "track",
        "from offset, m",
        "first, mm",
        "last, mm",
        "mm a month",
        "sigma",
        "probability by chance",
    )
    text = " ".join(summary) + " Significant: at most 5 % false findings among them (Benjamini and Hochberg)."
    return Section("Trends", text, [Table(columns, rows, left=2)] if rows else [])


def runs_section(report: Report) -> Section:
    """Where each run lies on the model, how it was laid over the others, and what its reader noted."""
    rows = []
    notes = []
    for part in report.sections:
        for geometry, lies in zip(part.geometries, part.overlays, strict=True):
            r = geometry.recording
            rows.append(
                [
                    r.run.id,
                    part.section.name,
                    f"{r.run.start:%Y-%m-%d}",
                    words.length(r.covered * part.section.length, 4),
                    words.share(r.covered),
                    words.length(r.passage.sigma, 2),
                    words.share(r.passage.probability),
                    "reference" if lies is None else f"{len(lies.shift)} of {lies.windows}",
                    "" if lies is None or not len(lies.shift) else f"{float(np.median(lies.shift)):+.2f} m",
                    "" if lies is None else words.length(lies.scatter, 2),
                ]
            )
            notes += [f"{r.run.id}, {part.section.name}: {note}" for note in r.notes]
    columns = (
        "run",
        "section",
        "date",
        "covers",
        "share",
        "sigma along",
        "track certain",
        "overlay windows",
        "shift found",
        "left after",
    )
    parts: list[Table | Warnings] = [Table(columns, rows, left=3)]
    if notes:
        parts.append(Warnings(notes))
    return Section("Runs", "Where each run lies on the model, and how it was laid over the others.", parts)
