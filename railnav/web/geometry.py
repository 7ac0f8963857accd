"""The page of track geometry: strip charts one above another along the line, the map, exceedances, quality and trends."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.quality import COMBINED
from railnav.monitoring.rails import axis_key, rail_key
from railnav.web import figures, words
from railnav.web.geometry_tables import SHOWN, ability_section, quality_section, runs_section, trend_section
from railnav.web.page import Card, Figure, Section, Table, Warnings, page
from railnav.web.strips import Curve, Strip, axis_of, jumps_in_words, line_map, resolution_of, stack

if TYPE_CHECKING:
    from collections.abc import Sequence

    from railnav.monitoring.channels import Geometry
    from railnav.monitoring.limits import Exceedance
    from railnav.monitoring.monitor import Monitored, Report

FloatArray = NDArray[np.float64]

#: Sections drawn with charts; the others stand in the tables.
DRAWN = 3
#: Runs drawn over each other in one strip.
RUNS = 6
#: Rows of the table of exceedances on the page.
ROWS = 200
LEVEL_COLOURS = {"alert": "#e0a030", "intervention": "#d9622b", "immediate": "#b02323"}
LEVEL_WORDS = {"alert": "alert", "intervention": "intervention", "immediate": "immediate action"}
#: Strips from top to bottom.
ORDER = (
    "curvature",
    "gauge",
    "cross_level",
    "cross_level_deviation",
    "twist_",
    "longitudinal_level_d0",
    "longitudinal_level_d1",
    "longitudinal_level_d2",
    "longitudinal_level_d3",
    "alignment_d1",
    "alignment_d2",
    "alignment_d3",
    "versine_",
    "plan_deviation",
    "height_deviation",
)
#: Values as measured that travel along for zooming, all curves together.
FINE = 12_000_000
#: Standard deviations drawn, with their colour and what it is called.
SPREAD = {
    COMBINED: (figures.INK, "black"),
    "longitudinal_level_d1": (figures.PALETTE[0], "blue"),
    "alignment_d1": (figures.PALETTE[1], "orange"),
}
#: Endings of the keys of channels in bands.
BANDS = ("d0", "d1", "d2", "d3")


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
    shown = [e for part in report.sections for e in part.exceedances if e.run == part.latest]
    first = report.sections[0]
    places = _Places(report)
    sections: list[Section] = [_map(report, shown, places)]
    warnings = [*report.notes, *_table_warning(report)]
    if warnings:
        sections.insert(0, Section("What to know first", "", [Warnings(warnings)]))
    budget = FINE
    for i, part in enumerate(report.sections[:DRAWN]):
        figure = strips(part, identity=f"strips{i}", budget=budget)
        if figure.fine is not None:
            budget -= figure.fine["count"] * len(figure.fine["traces"])
        sections.append(Section(f"Channels: {part.section.name}", _strip_words(part, i == 0), [figure]))
    sections.append(_exceedance_section(shown, len(found), places))
    sections.append(ability_section(report))
    sections.append(quality_section(report))
    if any(part.trends for part in report.sections):
        sections.append(trend_section(report))
    sections.append(runs_section(report))
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


def strips(part: Monitored, *, identity: str, budget: int = 0) -> Figure:
    """Draw the channels of a section's runs one above another on one axis along the line.

    Parameters
    ----------
    part : Monitored
    identity : str
        Of the figure in the page.
    budget : int
        How many values may travel along for zooming; the latest run's come first.

    Returns
    -------
    Figure
    """
    newest = _by_date(part)[-RUNS:]
    latest = newest[-1].recording.run.id
    keys = [key for key in sorted({key for g in newest for key in g.channels}, key=_rank) if _drawn(part, key)]
    x, _ = axis_of(part.section, part.geometries[0].distance)
    drawn = []
    for key in ("speed", *keys):
        having = [g for g in newest if key == "speed" or key in g.channels]
        factor, unit = (3.6, "km/h") if key == "speed" else _shown(part, key)
        name = "Speed" if key == "speed" else _short(having[-1].channels[key].title)
        curves = []
        for geometry in reversed(having):
            values, sigma = _values(geometry, key, factor)
            budget -= len(values)
            j = newest.index(geometry)
            run = geometry.recording.run
            curves.append(
                Curve(
                    run.id if f"{run.start:%Y-%m-%d}" in run.id else f"{run.start:%Y-%m-%d} {run.id}",
                    x,
                    values,
                    figures.INK if len(newest) == 1 else figures.PALETTE[j % len(figures.PALETTE)],
                    label=run.id,
                    group=run.id,
                    legend=key == "speed",
                    fine=resolution_of(sigma, float(np.nanstd(values)) if np.isfinite(values).any() else 0.0)
                    if budget >= 0
                    else 0.0,
                )
            )
        drawn.append(
            Strip(
                f"{name}, {unit}", curves[::-1], _marks(part, key, x, factor, latest), _limit_lines(part, key, factor)
            )
        )
    spread = _spread(part, latest, x)
    return stack(
        [*drawn, *([spread] if spread else [])],
        identity=identity,
        section=part.section,
        distance=part.geometries[0].distance,
    )


def _drawn(part: Monitored, key: str) -> bool:
    """Whether a channel has a strip: short waves by rail, longer ones by axis, and any that is beyond a limit."""
    axis = axis_key(key)
    if any(e.channel == key for e in part.exceedances):
        return True
    rails = (
        any(rail_key(axis, "left") in g.channels for g in part.geometries)
        if axis.rsplit("_", 1)[-1] in BANDS
        else False
    )
    return (key != axis) == (rails and axis.endswith(("_d0", "_d1")))


def _values(geometry: Geometry, key: str, factor: float) -> tuple[FloatArray, float]:
    """Values as shown, and their sigma."""
    if key == "speed":
        return geometry.recording.speed * factor, 0.1
    channel = geometry.channels[key]
    nominal = geometry.recording.gauge_nominal if key == "gauge" else 0.0
    return (channel.values - nominal) * factor, channel.sigma * factor


def _spread(part: Monitored, run: str, x: FloatArray) -> Strip | None:
    """Standard deviations over 200 m of the latest run, as steps."""
    index = next(i for i, g in enumerate(part.geometries) if g.recording.run.id == run)
    graded = part.segments[index]
    distance = part.geometries[0].distance
    curves, names = [], []
    for key, (colour, word) in SPREAD.items():
        mine = [s for s in graded if s.channel == key]
        if mine:
            at = np.array([[s.start, s.finish, s.finish] for s in mine]).ravel()
            level = np.array([[1e3 * s.deviation, 1e3 * s.deviation, np.nan] for s in mine]).ravel()
            curves.append(Curve(mine[0].title, np.interp(at, distance, x), level, colour))
            names.append(f"{mine[0].title} ({word})")
    return Strip(f"Standard deviation over 200 m: {', '.join(names)}, mm", curves) if curves else None


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
        (
            i
            for i, start in enumerate(ORDER)
            if axis_key(key) == start or (start.endswith("_") and key.startswith(start))
        ),
        99,
    ), key


def _by_date(part: Monitored) -> list[Geometry]:
    return sorted(part.geometries, key=lambda g: g.recording.run.start)


def _marks(part: Monitored, key: str, x: FloatArray, factor: float, run: str) -> list[dict[str, Any]]:
    """Exceedances of the latest run as dots on their strip."""
    distance = part.geometries[0].distance
    traces = []
    for level, colour in LEVEL_COLOURS.items():
        here = [e for e in part.exceedances if e.channel == key and e.level == level and e.run == run]
        if here:
            traces.append(
                {
                    "name": LEVEL_WORDS[level],
                    "x": np.interp([e.peak for e in here], distance, x),
                    "y": [e.value * factor for e in here],
                    "marker": {"size": 7, "color": colour, "symbol": "diamond"},
                    "hovertemplate": f"%{{y:.1f}}<extra>{LEVEL_WORDS[level]} limit</extra>",
                }
            )
    return traces


def _limit_lines(part: Monitored, key: str, factor: float) -> list[tuple[float, str]]:
    """Limits that were exceeded, as lines on their strip; others would flatten the curve."""
    return [
        (limit * factor, colour)
        for level, colour in LEVEL_COLOURS.items()
        for limit in sorted({e.limit for e in part.exceedances if e.channel == key and e.level == level})
    ]


def _map(report: Report, shown: Sequence[Exceedance], places: _Places) -> Section:
    lines = []
    for i, part in enumerate(report.sections):
        d = np.linspace(0.0, part.section.length, int(min(4000, part.section.length / 5.0)) + 2)
        point = part.section.at(d)
        chart = f"strips{i}" if i < DRAWN else ""
        x = np.interp(d, *places.grid[chart]) if chart else d
        lines.append((chart, part.section.name, x, point.easting, point.northing))
    marks = []
    for level, colour in LEVEL_COLOURS.items():
        here = [e for e in shown if e.level == level]
        if here:
            marks.append(
                {
                    "name": f"{LEVEL_WORDS[level]} limit",
                    "easting": np.array([e.easting for e in here]),
                    "northing": np.array([e.northing for e in here]),
                    "text": [f"{escape(e.title)} {_value(e)}<br>{escape(e.track)} at {e.offset:.0f} m" for e in here],
                    "customdata": [places.of(e) for e in here],
                    "hovertemplate": "%{text}<extra></extra>",
                    "marker": {"size": 9, "color": colour, "symbol": "diamond"},
                }
            )
    text = (
        "Sections monitored are blue, exceedances of the latest run diamonds. The pointer on a strip chart moves the dot, zooming a chart "
        "marks the stretch in view, and a click on a diamond leads to its place on the chart."
    )
    return Section("Map", text, [line_map(report.model, lines, marks=marks)])


class _Places:
    """Where an exceedance stands on the charts of a page."""

    def __init__(self, report: Report) -> None:
        self.chart: dict[int, str] = {}
        self.grid: dict[str, tuple[FloatArray, FloatArray]] = {}
        for i, part in enumerate(report.sections[:DRAWN]):
            grid = part.geometries[0].distance
            self.grid[f"strips{i}"] = grid, axis_of(part.section, grid)[0]
            self.chart |= {id(e): f"strips{i}" for e in part.exceedances}

    def of(self, found: Exceedance) -> tuple[str, float] | None:
        """The chart that shows an exceedance, and the place on its axis; None where its section is not drawn."""
        chart = self.chart.get(id(found))
        return None if chart is None else (chart, float(np.interp(found.peak, *self.grid[chart])))


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
    judged = any(not v.reason for part in report.sections for row in part.verdicts for v in row)
    if report.table.recalled and judged:
        total = len(report.table.status)
        lines.append(
            f"{report.table.recalled} of {total} entries of the table of limits are recalled, not read in their standard; they are marked "
            "below. Check them, use a table of your own (--limits) or leave them out (--sourced), before anything hangs on them."
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
    more = " Dotted lines are the limits that were exceeded. Drag across the chart to zoom in: the values then shown are those each "
    text += f"{more}{part.geometries[0].recording.step:g} m; a double click leads back." if moves else ""
    return text + jumps_in_words(part.section, part.geometries[0].distance)


def _exceedance_section(shown: Sequence[Exceedance], total: int, places: _Places) -> Section:
    counts = []
    for title in dict.fromkeys(e.title for e in sorted(shown, key=lambda e: _rank(e.channel))):
        mine = [e for e in shown if e.title == title]
        counts.append([title, *(f"{sum(e.level == level for e in mine):,}" for level in reversed(LEVEL_COLOURS))])
    order = {level: i for i, level in enumerate(reversed(LEVEL_COLOURS))}
    shown = sorted(shown, key=lambda e: (order[e.level], -abs(e.value / e.limit)))
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
    text = f"{len(shown):,} places in the latest run of each section, {total:,} in all runs; the severest first, by how far they are "
    text += "beyond their limit. A click on a row leads to its place on the chart."
    if len(shown) > ROWS:
        text += f" The first {ROWS} stand here; --exceedances writes all of them."
    at = [places.of(e) for e in shown[:ROWS]]
    summary = Table(("channel", *(LEVEL_WORDS[level] for level in reversed(LEVEL_COLOURS))), counts)
    return Section("Exceedances", text, [summary, Table(columns, rows, left=3, at=at)] if rows else [])
