"""The page of track geometry: strip charts one above another along the line, the map, exceedances, quality and trends."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.web import figures, words
from railnav.web.page import Card, Figure, Section, Table, Warnings, page

if TYPE_CHECKING:
    from collections.abc import Sequence

    from railnav.monitoring.channel import Channel
    from railnav.monitoring.channels import Geometry
    from railnav.monitoring.limits import Exceedance
    from railnav.monitoring.monitor import Monitored, Report
    from railnav.monitoring.section import Section as TrackSection

FloatArray = NDArray[np.float64]

#: Points of one curve of a strip chart.
POINTS = 5000
#: Sections drawn with charts; the others stand in the tables.
DRAWN = 3
#: Runs drawn over each other in one strip.
RUNS = 6
#: Rows of the table of exceedances on the page.
ROWS = 200
#: Height of one strip, pixels.
STRIP = 92
LEVEL_COLOURS = {"alert": "#e0a030", "intervention": "#d9622b", "immediate": "#b02323"}
LEVEL_WORDS = {"alert": "alert", "intervention": "intervention", "immediate": "immediate action"}
#: Strips from top to bottom.
ORDER = (
    "curvature",
    "gauge",
    "cross_level",
    "cross_level_deviation",
    "twist_",
    "longitudinal_level_d1",
    "longitudinal_level_d2",
    "longitudinal_level_d3",
    "alignment_d1",
    "alignment_d2",
    "alignment_d3",
    "plan_deviation",
    "height_deviation",
)
#: Factor and word of the unit that a page shows.
SHOWN = {"m": (1e3, "mm"), "m/m": (1e3, "mm/m"), "1/m": (1e3, "1/km")}


def geometry_page(report: Report) -> str:
    """Compose the page of a monitoring report.

    Parameters
    ----------
    report : Report

    Returns
    -------
    str
        Self-contained HTML.

    Raises
    ------
    RailnavError
        If plotly is not installed.
    """
    from railnav.web.report import SIMULATED, is_simulated

    runs = {g.recording.run.id: g.recording.run for part in report.sections for g in part.geometries}
    simulated = is_simulated(report.model) or any(run.simulated for run in runs.values())
    found = [e for part in report.sections for e in part.exceedances]
    latest = {part.section.name: _latest(part) for part in report.sections}
    shown = [e for part in report.sections for e in part.exceedances if e.run == latest[part.section.name]]
    first = report.sections[0]
    sections: list[Section] = [_map(report, shown)]
    warnings = [*report.notes, *_table_warning(report)]
    if warnings:
        sections.insert(0, Section("What to know first", "", [Warnings(warnings)]))
    for i, part in enumerate(report.sections[:DRAWN]):
        sections.append(
            Section(
                f"Channels: {part.section.name}",
                _strip_words(part, i == 0),
                [strips(part, identity=f"strips{i}", moves=i == 0)],
            )
        )
    sections.append(_exceedance_section(shown, len(found)))
    sections.append(_ability_section(report))
    sections.append(_quality_section(report))
    if any(part.trends for part in report.sections):
        sections.append(_trend_section(report))
    sections.append(_runs_section(report))
    counts = {level: sum(e.level == level for e in shown) for level in LEVEL_COLOURS}
    cards = [
        Card("Sections", f"{len(report.sections)}", words.length(sum(p.section.length for p in report.sections), 4)),
        Card("Runs", f"{len(runs)}", "; ".join(sorted(runs))[:60]),
        *(
            Card(f"{LEVEL_WORDS[level].capitalize()} limit", f"{counts[level]:,}", "places in the latest run")
            for level in reversed(LEVEL_COLOURS)
        ),
        Card("Speed for limits", words.speed(first.speed), first.section.name),
    ]
    return page(
        "Track geometry",
        subtitle=", ".join(f"{run.id} ({run.start:%Y-%m-%d})" for run in list(runs.values())[:8]),
        badge=SIMULATED if simulated else "",
        lead=[_lead(report, shown)],
        cards=cards,
        sections=sections,
        footer=f"Limits: {report.table.name}. Channels each {report.step:g} m; bands by a zero-phase Butterworth band-pass of order 4, "
        "-3 dB at its edges.",
    )


def axis_of(section: TrackSection, distance: FloatArray) -> tuple[FloatArray, str]:
    """Kilometres to draw along: the chainage where the model has one that grows steadily, otherwise the distance."""
    chainage = section.at(distance).chainage
    if np.isfinite(chainage).all() and (np.diff(chainage) > 0.0).all():
        return chainage / 1e3, "chainage, km"
    return distance / 1e3, f"km along {section.name}"


def strips(part: Monitored, *, identity: str, moves: bool = False) -> Figure:
    """Draw the channels of a section's runs one above another on one axis along the line.

    Parameters
    ----------
    part : Monitored
    identity : str
        Of the figure in the page.
    moves : bool
        Whether hovering moves the marker in the map.

    Returns
    -------
    Figure
    """
    keys = sorted({key for g in part.geometries for key in g.channels}, key=_rank)
    data: list[dict[str, Any]] = []
    x, title = axis_of(part.section, part.geometries[0].distance)
    layout = figures._layout(STRIP * (len(keys) + 1) + 110, hovermode="x")
    height = 1.0 / (len(keys) + 1)
    newest = _by_date(part)[-RUNS:]
    for row, key in enumerate(["speed", *keys]):
        top = 1.0 - row * height
        axis = "y" if row == 0 else f"y{row + 1}"
        domain = [top - height * 0.86, top]
        label, factor, unit = "Speed", 3.6, "km/h"
        for j, geometry in enumerate(newest):
            values: FloatArray
            if key == "speed":
                values = geometry.recording.speed * factor
            elif key in geometry.channels:
                channel = geometry.channels[key]
                factor, unit = _shown(part, key)
                label = channel.title
                nominal = geometry.recording.gauge_nominal if key == "gauge" else 0.0
                values = (channel.values - nominal) * factor
            else:
                continue
            rows = figures.thin(POINTS, values)
            colour = figures.INK if len(newest) == 1 else figures.PALETTE[j % len(figures.PALETTE)]
            data.append(
                figures._line(
                    escape(f"{geometry.recording.run.start:%Y-%m-%d} {geometry.recording.run.id}"),
                    x[rows],
                    values[rows],
                    colour,
                    yaxis=axis,
                    line={"width": 1.0},
                    showlegend=row == 0,
                    legendgroup=geometry.recording.run.id,
                    connectgaps=False,
                    hovertemplate=f"%{{y:.2f}} {unit}<extra>{escape(geometry.recording.run.id)}</extra>",
                )
            )
        data += _marks(part, key, x, axis, factor, newest[-1].recording.run.id)
        name = "yaxis" if row == 0 else f"yaxis{row + 1}"
        layout[name] = figures._axis("", domain=domain, nticks=4, zeroline=True, fixedrange=False)
        layout.setdefault("annotations", []).append(
            {
                "text": f"{escape(_short(label))}, {unit}",
                "xref": "paper",
                "yref": "paper",
                "x": 0.002,
                "y": top,
                "xanchor": "left",
                "yanchor": "top",
                "showarrow": False,
                "font": {"size": 12, "color": figures.SOFT},
                "bgcolor": "rgba(255,255,255,0.75)",
            }
        )
        limit = _limit_lines(part, key, factor, axis)
        layout.setdefault("shapes", []).extend(limit)
    layout["xaxis"] = figures._axis(
        title, anchor=f"y{len(keys) + 1}", domain=[0, 1], showspikes=True, spikemode="across"
    )
    return Figure(identity, data, layout, moves=moves)


def _shown(part: Monitored, key: str) -> tuple[float, str]:
    """Factor and unit that a strip reads best in: metres where a displacement is metres."""
    channels = [g.channels[key] for g in part.geometries if key in g.channels]
    if (
        channels[0].unit == "m"
        and channels[0].band is None
        and key.endswith("_deviation")
        and channels[0].source == "GNSS"
    ):
        size = [np.nanmax(np.abs(c.values)) for c in channels if np.isfinite(c.values).any()]
        if size and max(size) > 1.0:
            return 1.0, "m"
    return SHOWN[channels[0].unit]


def _short(title: str) -> str:
    return title.replace("Distance from the model to the right", "Right of the model").replace(
        "minus the model's cant", "minus model"
    )


def _rank(key: str) -> tuple[int, str]:
    return next(
        (i for i, start in enumerate(ORDER) if key == start or (start.endswith("_") and key.startswith(start))), 99
    ), key


def _by_date(part: Monitored) -> list[Geometry]:
    return sorted(part.geometries, key=lambda g: g.recording.run.start)


def _latest(part: Monitored) -> str:
    return _by_date(part)[-1].recording.run.id


def _marks(part: Monitored, key: str, x: FloatArray, axis: str, factor: float, run: str) -> list[dict[str, Any]]:
    """Exceedances of the latest run as dots on their strip."""
    distance = part.geometries[0].distance
    traces = []
    for level, colour in LEVEL_COLOURS.items():
        here = [e for e in part.exceedances if e.channel == key and e.level == level and e.run == run]
        if here:
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": LEVEL_WORDS[level],
                    "x": np.interp([e.peak for e in here], distance, x),
                    "y": [e.value * factor for e in here],
                    "yaxis": axis,
                    "marker": {"size": 7, "color": colour, "symbol": "diamond"},
                    "showlegend": False,
                    "hovertemplate": f"%{{y:.1f}}<extra>{LEVEL_WORDS[level]} limit</extra>",
                }
            )
    return traces


def _limit_lines(part: Monitored, key: str, factor: float, axis: str) -> list[dict[str, Any]]:
    """Limits that were exceeded, as lines on their strip; others would flatten the curve."""
    lines = []
    for level, colour in LEVEL_COLOURS.items():
        values = {e.limit for e in part.exceedances if e.channel == key and e.level == level}
        stroke = {"color": colour, "width": 1, "dash": "dot"}
        lines += [
            {
                "type": "line",
                "xref": "paper",
                "x0": 0,
                "x1": 1,
                "yref": axis,
                "y0": y * factor,
                "y1": y * factor,
                "line": stroke,
            }
            for y in sorted(values)
        ]
    return lines


def _map(report: Report, shown: Sequence[Exceedance]) -> Section:
    plan = figures.plan(report.model)
    east0, north0, _, _ = figures._corner(report.model, None)
    data = list(plan.data)
    for part in report.sections:
        d = np.linspace(0.0, part.section.length, int(min(4000, part.section.length / 5.0)) + 2)
        point = part.section.at(d)
        rows = figures.outline(point.easting, point.northing, 0.5)
        data.append(
            figures._line(
                escape(part.section.name),
                (point.easting[rows] - east0) / 1e3,
                (point.northing[rows] - north0) / 1e3,
                figures.ESTIMATE,
                line={"width": 2.5},
                hoverinfo="skip",
                showlegend=False,
            )
        )
    for level, colour in LEVEL_COLOURS.items():
        here = [e for e in shown if e.level == level]
        if here:
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": f"{LEVEL_WORDS[level]} limit",
                    "x": [(e.easting - east0) / 1e3 for e in here],
                    "y": [(e.northing - north0) / 1e3 for e in here],
                    "text": [f"{escape(e.title)} {_value(e)}<br>{escape(e.track)} at {e.offset:.0f} m" for e in here],
                    "hovertemplate": "%{text}<extra></extra>",
                    "marker": {"size": 9, "color": colour, "symbol": "diamond"},
                }
            )
    first = report.sections[0].section
    d = np.linspace(0.0, first.length, 2000)
    point, (x, _) = first.at(d), axis_of(first, d)
    marker: dict[str, Any] = {
        "time": x,
        "x": (point.easting - east0) / 1e3,
        "y": (point.northing - north0) / 1e3,
        "trace": len(data),
    }
    data.append(
        {
            "type": "scatter",
            "mode": "markers",
            "name": "place",
            "x": [marker["x"][0]],
            "y": [marker["y"][0]],
            "marker": {"size": 14, "color": figures.WRONG, "line": {"width": 2, "color": "#fff"}},
            "hoverinfo": "skip",
            "showlegend": False,
        }
    )
    text = "Sections monitored are blue, exceedances of the latest run diamonds. The pointer on the first strip chart moves the dot."
    return Section("Map", text, [Figure("plan", data, plan.layout, marker=marker)])


def _value(found: Exceedance) -> str:
    factor, unit = SHOWN[found.unit]
    return f"{found.value * factor:+.1f} {unit}"


def _lead(report: Report, shown: Sequence[Exceedance]) -> str:
    total = sum(part.section.length for part in report.sections)
    text = f"{words.count(len(report.sections), 'section')}, {words.length(total, 4)} of track, "
    text += f"{words.count(sum(len(p.geometries) for p in report.sections), 'passage')}. "
    judged = sorted({v.title for part in report.sections for row in part.verdicts for v in row if not v.reason})
    if not judged:
        text += "No channel could be held against a limit: the table below says why, channel by channel. "
        long = [
            c for p in report.sections for g in p.geometries for key, c in g.channels.items() if key == "plan_deviation"
        ]
        if long:
            best = max(long, key=lambda c: int(np.isfinite(c.values).sum()))
            text += f"What these runs can show is the distance from the model in long waves ({best.title.split(', ')[-1]}), "
            text += f"within {words.length(best.sigma, 2)} for the longest."
        return text
    severe = sum(e.level == "immediate" for e in shown)
    text += f"Held against limits: {', '.join(judged)}. "
    if not shown:
        return text + "Nothing is beyond a limit in the latest run."
    return (
        text
        + f"{words.count(len(shown), 'place')} beyond a limit in the latest run, {severe} of them beyond the immediate action limit."
    )


def _table_warning(report: Report) -> list[str]:
    lines = []
    if report.table.recalled:
        total = len(report.table.status)
        lines.append(
            f"{report.table.recalled} of {total} entries of the table of limits are recalled, not read in their standard; they are marked "
            "below. Check them, or use a table of your own (--limits), before anything hangs on them."
        )
    return lines


def _strip_words(part: Monitored, moves: bool) -> str:
    text = "Gauge is drawn from nominal; distance grows from left to right, right and up are positive. "
    if any(o is not None and len(o.shift) for o in part.overlays):
        spread = [o.scatter for o in part.overlays if o is not None and np.isfinite(o.scatter)]
        if spread:
            text += f"Runs lie on the one that covers most; what is left of their shift scatters by {words.length(max(spread), 2)}. "
    against = part.geometries[0].recording.against_model
    text += (
        "The model is a design: its shape is taken off longitudinal level and alignment."
        if against
        else "The model was surveyed: its shape is not taken off longitudinal level and alignment, so transitions show in long waves."
    )
    return text + (" Dotted lines are the limits that were exceeded." if moves else "")


def _exceedance_section(shown: Sequence[Exceedance], total: int) -> Section:
    rows = [
        [
            e.title,
            LEVEL_WORDS[e.level],
            e.track,
            f"{e.chainage / 1e3:.4f}" if np.isfinite(e.chainage) else "",
            f"{e.offset:,.1f}",
            _value(e),
            f"{e.limit * SHOWN[e.unit][0]:+.1f}",
            f"{e.length:.1f}",
            f"{e.easting:,.1f}",
            f"{e.northing:,.1f}",
            e.status,
        ]
        for e in shown[:ROWS]
    ]
    columns = (
        "channel",
        "limit",
        "track",
        "km",
        "offset, m",
        "value",
        "limit value",
        "length, m",
        "easting",
        "northing",
        "status",
    )
    text = f"{len(shown):,} places in the latest run of each section, {total:,} in all runs; the severest first."
    if len(shown) > ROWS:
        text += f" The first {ROWS} stand here; --exceedances writes all of them."
    return Section("Exceedances", text, [Table(columns, rows, left=3)] if rows else [])


def _ability_section(report: Report) -> Section:
    """Which channels and bands the runs can bear, and which not."""
    merged: dict[tuple[str, str, str, str], list[tuple[str, Channel | None]]] = {}
    for part in report.sections:
        for geometry, verdicts in zip(part.geometries, part.verdicts, strict=True):
            run = geometry.recording.run.id
            for v in verdicts:
                channel = geometry.channels.get(v.channel)
                judged = (words.share(round(v.share, 2)) if not v.reason else "channel only") if channel else "no"
                merged.setdefault((v.title, channel.source if channel else "", v.reason, judged), []).append(
                    (run, channel)
                )
            named = {v.channel for v in verdicts}
            for name, reason in geometry.refused.items():
                if name not in named:
                    merged.setdefault((name.replace("_", " "), "", reason, "no"), []).append((run, None))
    text = (
        "A band is given where its shortest wave is sampled three times, and judged where the noise is at most a third of the "
        "mildest limit. Sigma is that of the samples' white noise, at most, and in bands of the place; long-wave distances from the "
        "model by GNSS state their whole scatter. Sensors on a sprung body do not show the rails above some hertz."
    )
    columns = ("channel", "runs", "from", "why not judged", "sample each, m", "sigma at most", "judged")
    rows = []
    for (title, source, reason, judged), having in sorted(merged.items(), key=lambda item: item[0][0].lower()):
        channels = [channel for _, channel in having if channel is not None]
        runs = sorted({run for run, _ in having})
        worst = max(channels, key=lambda c: c.sigma if np.isfinite(c.sigma) else -1.0) if channels else None
        spacing = f"{max(c.spacing for c in channels):.2f}" if channels else ""
        rows.append(
            [
                title,
                f"{len(runs)} runs" if len(runs) > 2 else ", ".join(runs),
                source,
                reason,
                spacing,
                _sigma(worst),
                judged,
            ]
        )
    return Section("What these runs can bear", text, [Table(columns, rows, left=4)])


def _sigma(channel: Channel | None) -> str:
    if channel is None or not np.isfinite(channel.sigma):
        return ""
    factor, unit = SHOWN[channel.unit]
    return f"{words.figures(channel.sigma * factor, 2)} {unit}"


def _quality_section(report: Report) -> Section:
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
    text = "Standard deviations over segments of 200 m, mm, and how many segments fall into each class."
    return Section("Quality", text, [Table(columns, rows, left=3)] if rows else [])


def _trend_section(report: Report) -> Section:
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


def _runs_section(report: Report) -> Section:
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
