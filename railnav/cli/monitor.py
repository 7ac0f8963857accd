"""`railnav monitor`: track geometry of runs on a model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from railnav.cli._verb import PATH, json_option

if TYPE_CHECKING:
    from railnav.monitoring.limits import Exceedance
    from railnav.monitoring.monitor import Monitored, Report
    from railnav.monitoring.quality import Segment
    from railnav.monitoring.trends import Trend
    from railnav.monitoring.versines import Chord

TABLE_ENDINGS = (".csv", ".parquet")
#: Standard deviations shown in the terminal.
SUMMARY = (
    "combined",
    "longitudinal_level_left_d1",
    "longitudinal_level_right_d1",
    "longitudinal_level_d1",
    "alignment_d1",
)
#: Exceedances shown in the terminal.
SHOWN = 20


def _default_limits(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    if not value or ctx.resilient_parsing:
        return
    from railnav.io.limits import default_text

    click.echo(default_text(), nl=False)
    ctx.exit()


@click.command("monitor")
@click.argument("runs", type=PATH, nargs=-1, required=True, metavar="RUN...")
@click.option("-m", "--model", type=PATH, required=True, help="Reference track model, .gpkg (or .geojson).")
@click.option("-o", "--output", type=PATH, required=True, help="Page to write, .html.")
@click.option("--channels", type=PATH, help="Also write all channels: .csv or .parquet.")
@click.option("--exceedances", "list_file", type=PATH, help="Also write the exceedances of all runs: .csv or .parquet.")
@click.option("--quality", type=PATH, help="Also write standard deviations and classes over 200 m: .csv or .parquet.")
@click.option("--trends", type=PATH, help="Also write the growth of standard deviations a month: .csv or .parquet.")
@click.option("--limits", type=PATH, help="Table of limits, .toml.  [default: standard gauge; see --default-limits]")
@click.option(
    "--sourced",
    is_flag=True,
    help="Leave out limits that were recalled, not read in their source.",
)
@click.option(
    "--default-limits",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_default_limits,
    help="Print the default table of limits, to edit, and stop.",
)
@click.option(
    "--tracks", metavar="TRACK,TRACK", help="The section: tracks in order.  [default: whatever the runs cover]"
)
@click.option(
    "--speed",
    type=click.FloatRange(0, 300, min_open=True),
    help="Speed of the line for the limits, km/h.  [default: the class of the fastest run]",
)
@click.option(
    "--gauge",
    type=click.FloatRange(500, 2000),
    help="Nominal gauge, mm.  [default: the usual one nearest to the median]",
)
@click.option(
    "--base",
    "bases",
    type=click.FloatRange(0.5, 50),
    multiple=True,
    default=(3.0, 9.0),
    show_default=True,
    help="Twist base, m; may be given more than once.",
)
@click.option(
    "--chord",
    "chords",
    metavar="LENGTH | A+B",
    multiple=True,
    help="Versines of alignment on this chord, m: 20 about its middle, or 4.1+17.4 behind and ahead; may be given more than once.",
)
@click.option(
    "--step", type=click.FloatRange(0.05, 1.0), default=0.25, show_default=True, help="Distance between values, m."
)
@click.option(
    "--against",
    type=click.Choice(["auto", "model", "nothing"]),
    default="auto",
    show_default=True,
    help="Take the model's shape off level and alignment: auto does where the model is a design.",
)
@click.option(
    "--calibration", type=PATH, help="Calibration file of the IMU, .toml, for runs whose run.toml names none."
)
@json_option
def command(
    runs: tuple[Path, ...],
    model: Path,
    output: Path,
    channels: Path | None,
    list_file: Path | None,
    quality: Path | None,
    trends: Path | None,
    limits: Path | None,
    sourced: bool,
    tracks: str | None,
    speed: float | None,
    gauge: float | None,
    bases: tuple[float, ...],
    chords: tuple[str, ...],
    step: float,
    against: str,
    calibration: Path | None,
    as_json: bool,
) -> None:
    """Work out track geometry channels from runs on a model, and hold them against limits.

    Longitudinal level and alignment of axis and rails in D0 to D3, cross level, twist, gauge and curvature, each from the streams that a
    RUN has; the page says which bands its sensors can bear and which not. Several runs are laid over each other to the decimetre or better;
    runs of several dates give growth per month.

    \b
    Example:
      railnav monitor demo/survey-1 demo/survey-2 -m demo/line.gpkg -o geometry.html --channels channels.csv
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_json, print_warnings, progress

    inputs = [model, *([limits] if limits else []), *(member for run in runs for member in _files.members(run))]
    _files.check_output(output, _files.PAGE_ENDINGS, inputs=inputs)
    taken = [output]
    for extra in (channels, list_file, quality, trends):
        if extra is not None:
            _files.check_output(extra, TABLE_ENDINGS, inputs=inputs)
            if extra.resolve() in [path.resolve() for path in taken]:
                raise click.UsageError(f"{extra} is named twice")
            taken.append(extra)
    _files.need_report()
    from railnav.io.imu_calibration import calibrated_run
    from railnav.io.limits import default_limits, read_limits
    from railnav.io.run import read_run
    from railnav.monitoring.monitor import monitor
    from railnav.monitoring.section import section_of

    table = read_limits(limits) if limits else default_limits()
    table = table.sourced() if sourced else table
    reference = _files.read_model(model)
    names = [name.strip() for name in tracks.split(",") if name.strip()] if tracks is not None else []
    section = section_of(reference, names) if tracks is not None else None
    with progress() as tell:
        report = monitor(
            [calibrated_run(read_run(run), calibration) for run in runs],
            reference,
            table,
            section=section,
            speed=speed / 3.6 if speed else None,
            step=step,
            gauge=gauge / 1e3 if gauge else None,
            bases=bases,
            chords=[_chord(text) for text in chords],
            against_model={"auto": None, "model": True, "nothing": False}[against],
            progress=tell,
        )
    from railnav.web.geometry import geometry_page

    page = geometry_page(report)
    found = [e for part in report.sections for e in part.exceedances]
    if channels is not None:
        from railnav.io.geometry import write_channels

        write_channels(report, channels)
    if list_file is not None:
        from railnav.io.geometry import write_exceedances

        write_exceedances(found, list_file, model=report.model)
    if quality is not None:
        from railnav.io.geometry import write_quality

        write_quality(report, quality)
    if trends is not None:
        from railnav.io.geometry import write_trends

        write_trends(report, trends)
    _files.write_text(output, page)
    written = taken
    if as_json:
        print_json(
            {
                **facts(report),
                "output": output,
                "channels": channels,
                "exceedances_file": list_file,
                "quality_file": quality,
                "trends_file": trends,
            }
        )
        return
    print_warnings(report.notes)
    _print(report, found, written)


def _chord(text: str) -> Chord:
    from railnav.monitoring.versines import Chord

    arms = text.split("+")
    try:
        metres = [float(arm) for arm in arms]
    except ValueError:
        metres = []
    if len(metres) == 1:
        metres = [0.5 * metres[0]] * 2
    if len(metres) != 2 or not all(0.1 <= arm <= 200.0 for arm in metres):
        raise click.BadParameter(f"{text!r} is no chord; give its length, or A+B in metres", param_hint="--chord")
    return Chord(*metres)


def facts(report: Report) -> dict[str, Any]:
    """The report as plain facts: sections, runs, channels with their sigma, counts and places of exceedances."""
    return {
        "limits": report.table.name,
        "limits_recalled": report.table.recalled,
        "notes": list(report.notes),
        "sections": [
            {
                "section": part.section.name,
                "tracks": [report.model.track_id[i] for i in part.section.track],
                "length_m": part.section.length,
                "speed_kmh": 3.6 * part.speed,
                "runs": [
                    {
                        "run": g.recording.run.id,
                        "covered": g.recording.covered,
                        "sigma_along_m": g.recording.passage.sigma,
                        "shift_left_m": None if lies is None else lies.scatter,
                        "against_model": g.recording.against_model,
                        "channels": {
                            v.channel: {"sigma": v.sigma, "judged": not v.reason, "reason": v.reason} for v in verdicts
                        },
                        "refused": g.refused,
                        "notes": list(g.recording.notes),
                    }
                    for g, lies, verdicts in zip(part.geometries, part.overlays, part.verdicts, strict=True)
                ],
                "exceedances": [
                    {
                        "channel": e.channel,
                        "level": e.level,
                        "value_mm": 1e3 * e.value,
                        "limit_mm": 1e3 * e.limit,
                        "length_m": e.length,
                        "track": e.track,
                        "offset_m": e.offset,
                        "chainage_km": e.chainage / 1e3,
                        "easting_m": e.easting,
                        "northing_m": e.northing,
                        "status": e.status,
                        "run": e.run,
                    }
                    for e in part.exceedances
                ],
                "quality_mm": {
                    g.recording.run.id: _quality(graded)
                    for g, graded in zip(part.geometries, part.segments, strict=True)
                },
                "trends": {t.channel: _growth(report, part, t) for t in part.trends},
            }
            for part in report.sections
        ],
    }


def _growth(report: Report, part: Monitored, trend: Trend) -> dict[str, Any]:
    """Growth of one channel: over all segments, and where it is significant."""
    from numpy import flatnonzero, isfinite, nanmedian

    g = trend.growth
    known = isfinite(g.rate)
    grows = []
    for i in flatnonzero(g.significant).tolist():
        track, offset = part.section.locate(trend.start[i])
        grows.append(
            {
                "track": report.model.track_id[int(track)],
                "offset_m": float(offset),
                "mm_month": 1e3 * g.rate[i],
                "sigma_mm_month": 1e3 * g.sigma[i],
                "probability": g.probability[i],
            }
        )
    return {
        "months": [float(month) for month in trend.months],
        "segments": int(known.sum()),
        "significant": len(grows),
        "median_mm_month": 1e3 * float(nanmedian(g.rate)) if known.any() else None,
        "noise_mm": 1e3 * g.noise,
        "grows": grows,
    }


def _quality(graded: tuple[Segment, ...]) -> dict[str, dict[str, Any]]:
    """Standard deviations over 200 m by channel: how many, median, largest, mm, and how many segments a class."""
    from statistics import median

    found: dict[str, dict[str, Any]] = {}
    for key in dict.fromkeys(s.channel for s in graded):
        mine = [s for s in graded if s.channel == key]
        values = [1e3 * s.deviation for s in mine]
        classes = {letter: sum(s.grade == letter for s in mine) for letter in sorted({s.grade for s in mine} - {""})}
        found[key] = {"segments": len(mine), "median": median(values), "largest": max(values), "classes": classes}
    return found


def _print(report: Report, found: list[Exceedance], written: list[Path]) -> None:
    from railnav.cli._terminal import print_table
    from railnav.web import words
    from railnav.web.geometry import LEVEL_WORDS
    from railnav.web.geometry_tables import SHOWN as UNITS

    rows: list[list[Any]] = []
    for part in report.sections:
        for g, verdicts in zip(part.geometries, part.verdicts, strict=True):
            judged = [v.title for v in verdicts if not v.reason]
            mine = [e for e in part.exceedances if e.run == g.recording.run.id]
            rows.append(
                [
                    part.section.name,
                    g.recording.run.id,
                    words.length(g.recording.covered * part.section.length, 4),
                    len(g.channels),
                    len(judged),
                    len(mine),
                    sum(e.level == "immediate" for e in mine),
                ]
            )
    print_table(
        "Sections", ("section", "run", "covers", "channels", "judged", "beyond limits", "immediate"), rows, left=2
    )
    graded = []
    for part in report.sections:
        for g, segments in zip(part.geometries, part.segments, strict=True):
            for key, found_here in _quality(segments).items():
                if key in SUMMARY:
                    classes = ", ".join(f"{letter} {count}" for letter, count in found_here["classes"].items())
                    sizes = [f"{found_here[name]:.2f} mm" for name in ("median", "largest")]
                    graded.append([part.section.name, g.recording.run.id, words.channel(key), *sizes, classes])
    print_table(
        "Standard deviation over 200 m", ("section", "run", "channel", "median", "largest", "classes"), graded, left=3
    )
    print_table(
        "Growth of standard deviations, mm a month",
        ("section", "channel", "segments that change", "of", "median", "fastest", "repeats within"),
        _grown(report),
        left=2,
    )
    refused: dict[str, dict[str, None]] = {}
    for part in report.sections:
        for g in part.geometries:
            for key, reason in g.refused.items():
                refused.setdefault(reason, {})[words.channel(key)] = None
    print_table(
        "Not given", ("channel", "why"), [[", ".join(keys), reason] for reason, keys in refused.items()], left=2
    )
    latest = [e for part in report.sections for e in part.exceedances if e.run == part.latest]
    shown = []
    for e in latest[:SHOWN]:
        factor, unit = UNITS[e.unit]
        shown.append(
            [
                e.title,
                LEVEL_WORDS[e.level] + ("" if e.status == "read" else f" ({e.status})"),
                e.run,
                e.track,
                f"{e.offset:,.1f} m",
                f"{factor * e.value:+.1f} {unit}",
                f"{factor * e.limit:+.1f} {unit}",
                f"{e.length:.1f} m",
            ]
        )
    title = f"Exceedances ({len(shown)} of {len(latest)})" if len(latest) > len(shown) else "Exceedances"
    if len(found) > len(latest):
        title += " of the latest run"
    print_table(title, ("channel", "limit", "run", "track", "offset", "value", "limit value", "length"), shown, left=4)
    click.echo(f"{', '.join(map(str, written))} written")


def _grown(report: Report) -> list[list[Any]]:
    """Channels whose standard deviation changes somewhere, fastest growth beside the median; one row where none does."""
    from numpy import abs as size
    from numpy import isfinite, nanargmax, nanmedian

    rows: list[list[Any]] = []
    for part in report.sections:
        changing = [trend for trend in part.trends if trend.growth.significant.any()]
        for trend in changing:
            g = trend.growth
            rows.append(
                [
                    part.section.name,
                    trend.title,
                    int(g.significant.sum()),
                    int(isfinite(g.rate).sum()),
                    f"{1e3 * nanmedian(g.rate):+.3f}",
                    f"{1e3 * g.rate[nanargmax(size(g.rate))]:+.3f}",
                    f"{1e3 * g.noise:.3f} mm",
                ]
            )
        if part.trends and not changing:
            most = max(int(isfinite(trend.growth.rate).sum()) for trend in part.trends)
            rows.append([part.section.name, f"none of {len(part.trends)} channels", 0, most, "", "", ""])
    return rows
