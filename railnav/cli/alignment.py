"""`railnav alignment`: from a measured axis to the elements of its design."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from railnav.cli._verb import PATH, json_option

if TYPE_CHECKING:
    from railnav.monitoring.fitting import Fitted

DESIGN_ENDINGS = (".xml", ".landxml", ".csv")


@click.command("alignment")
@click.argument("model", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Design to write: LandXML (.xml) or elements (.csv).")
@click.option("--track", "tracks", multiple=True, metavar="TRACK", help="Fit this track only; may be repeated.")
@click.option("--report", type=PATH, help="Also draw it: page (.html) or picture (.png, .svg, .pdf).")
@click.option(
    "--sigma",
    type=click.FloatRange(1e-5, 50.0),
    help="White noise of the points across the track, m.  [default: found from them]",
)
@click.option(
    "--sigma-height",
    type=click.FloatRange(1e-5, 50.0),
    help="White noise of their heights, m.  [default: found from them]",
)
@click.option(
    "--vertical",
    type=click.Choice(["parabola", "circle"]),
    default="parabola",
    show_default=True,
    help="Vertical curves; heights do not tell which they are.",
)
@click.option("--round", "rounded", is_flag=True, help="Round radii and lengths of transitions to design values.")
@click.option("--ground", is_flag=True, help="Round what they are on the ground, not in the plane.")
@json_option
def command(
    model: Path,
    output: Path,
    tracks: tuple[str, ...],
    report: Path | None,
    sigma: float | None,
    sigma_height: float | None,
    vertical: str,
    rounded: bool,
    ground: bool,
    as_json: bool,
) -> None:
    """Fit straights, transitions, arcs, gradients, vertical curves and cant ramps to a model's tracks.

    Elements are found by how well they explain the points under the noise that these have, waves included: an element stands only
    where the points ask for it. All are then adjusted together, tangent to one another. Lengths, radii and stations are the plane's;
    each has its standard deviation. A model of metre accuracy shows long curves only, and the report says so.

    \b
    Example:
      railnav alignment demo/line.gpkg -o design.xml --report design.html
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_json, print_table, print_warnings, progress
    from railnav.errors import InputError, RailnavError, TrackError

    _files.check_output(output, DESIGN_ENDINGS, inputs=[model])
    if report is not None:
        _files.check_output(report, _files.PICTURE_ENDINGS, inputs=[model, output])
        _files.need_report()
    if ground and not rounded:
        raise click.UsageError("--ground says how to round; it goes with --round")
    if _files.kind_of(model) != "model":
        raise InputError("is no model", file=model, remedy="name a model, .gpkg or .geojson")
    from railnav.io.designs import write_designs
    from railnav.monitoring.fitting import axis_of_model, fit_design
    from railnav.web.bands import drawn_design

    source = _files.read_model(model)
    try:
        for track in tracks:
            source.track_index(track)
    except TrackError as error:
        raise InputError(str(error), file=model) from error
    names = list(dict.fromkeys(tracks)) or list(source.track_id)
    fitted: list[Fitted] = []
    left_out: list[str] = []
    with progress() as tell:
        for name in names:
            try:
                fitted.append(
                    fit_design(
                        axis_of_model(source, name),
                        sigma=sigma,
                        sigma_height=sigma_height,
                        vertical=vertical,
                        rounded=rounded,
                        on_ground=ground,
                        progress=tell,
                    )
                )
            except RailnavError as error:
                if tracks or len(names) == 1:
                    raise InputError(str(error), file=model) from error
                left_out.append(str(error))
    if not fitted:
        raise InputError(f"no track holds elements: {left_out[0]}", file=model)
    designs = [one.design for one in fitted]
    written = write_designs(designs, output)
    if report is not None:
        drawn = [drawn_design(one.design, one) for one in fitted]
        if report.suffix.lower() == ".html":
            from railnav.web.alignment import alignment_page
            from railnav.web.report import is_simulated

            badge = "Simulated data" if is_simulated(source) else ""
            page = alignment_page(
                drawn, title=f"Alignment of {model.stem}", badge=badge, subtitle=model.name, warnings=left_out
            )
            _files.write_text(report, page)
        else:
            from railnav.web.sheets import SHEET, save_sheets, sheets

            length = SHEET if report.suffix.lower() == ".pdf" else None
            save_sheets((picture for one in drawn for picture in sheets(one, length=length)), report)
    warnings = [line for one in fitted for line in one.warnings] + left_out
    if as_json:
        print_json(
            {
                "model": model,
                "output": [str(path) for path in written],
                "tracks": [described(one) for one in fitted],
                "left_out": left_out,
            }
        )
    else:
        for one in fitted:
            shown = described(one)["elements"]
            rows = [
                [
                    e["element"],
                    f"{e['station_m']:.2f}",
                    f"{e['station_sigma_m']:.2g}",
                    f"{e['length_m']:.2f}",
                    f"{e['length_sigma_m']:.2g}",
                    "" if e["radius_m"] is None else f"{e['radius_m']:.2f}",
                    "" if e["radius_sigma_m"] is None else f"{e['radius_sigma_m']:.2g}",
                ]
                for e in shown[:60]
            ]
            title = f"Track {one.design.track}: {len(shown)} elements" + (", the first 60" if len(shown) > 60 else "")
            print_table(title, ("element", "station m", "+-", "length m", "+-", "radius m", "+-"), rows)
        click.echo(f"{', '.join(str(path) for path in written)} written" + (f", {report} drawn" if report else ""))
    print_warnings(warnings)


def described(one: Fitted) -> dict[str, Any]:
    """Describe a fitted design in values of JSON."""
    import numpy as np

    from railnav.track.elements import KIND_NAMES
    from railnav.web.bands import gradient_bars

    plan, design = one.design.plan, one.design
    with np.errstate(divide="ignore"):
        first = np.where(plan.curvature_start == 0.0, np.nan, 1.0 / plan.curvature_start)
        last = np.where(plan.curvature_end == 0.0, np.nan, 1.0 / plan.curvature_end)

    def value(number: float) -> float | None:
        return float(number) if np.isfinite(number) else None

    rows = [
        {
            "element": kind,
            "station_m": float(design.stations[j]),
            "station_sigma_m": float(one.station_sigma[j]),
            "length_m": float(plan.length[j]),
            "length_sigma_m": float(one.length_sigma[j]),
            "radius_m": value(first[j]) if plan.kind[j] == 1 else None,
            "radius_start_m": value(first[j]),
            "radius_end_m": value(last[j]),
            "radius_sigma_m": value(one.radius_sigma[j]),
            "easting_m": float(plan.easting[j]),
            "northing_m": float(plan.northing[j]),
            "grid_bearing_deg": float(np.degrees(plan.grid_bearing[j])),
        }
        for j, kind in enumerate(design.kinds)
    ]
    sigma = None if one.profile is None else one.profile.sigma
    profile = [
        {
            "piece": bar.kind,
            "station_m": bar.begin,
            "length_m": bar.end - bar.begin,
            "gradient_start": bar.first,
            "gradient_end": bar.last,
        }
        for bar in gradient_bars(design)
    ]
    if sigma is not None and len(sigma) == len(profile):
        for row, (at, slope, radius) in zip(profile, sigma.tolist(), strict=True):
            row |= {"station_sigma_m": at, "gradient_sigma": slope, "radius_sigma_m": value(radius)}
    c = design.cant
    cant = [] if c is None or one.cant is None else [
        {
            "station_m": float(c.edges[j] + design.start),
            "length_m": float(c.edges[j + 1] - c.edges[j]),
            "cant_start_mm": 1e3 * float(c.start[j]),
            "cant_end_mm": 1e3 * float(c.end[j]),
            "law": KIND_NAMES[c.kind[j]] if c.start[j] != c.end[j] else None,
            "station_sigma_m": float(one.cant.sigma[j, 0]),
            "cant_sigma_mm": 1e3 * float(one.cant.sigma[j, 1]),
        }
        for j in range(len(c.start))
    ]  # fmt: skip
    return {
        "track": design.track,
        "length_m": design.length,
        "scale": one.scale,
        "elements": rows,
        "profile": profile,
        "cant": cant,
        "residual_rms_m": float(np.sqrt(np.mean(one.residual**2))),
        "noise": {
            "white_m": float(np.mean(one.noise.sigma)),
            "correlated_m": one.noise.correlated,
            "correlation_length_m": one.noise.length if one.noise.correlated > 0.0 else None,
            "smooth": one.noise.smooth,
        },
        "points_apart_m": one.resolution.spacing,
        "shortest_curve_m": one.shortest,
        "law": one.law.said or None,
        "law_probability": {KIND_NAMES[law]: p for law, p in one.law.probability.items()},
        "law_from_points": one.law.told,
        "settled": one.settled,
        "warnings": list(one.warnings),
    }
