"""`railnav lining`: slews and lifts for the tamping machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from railnav.cli._verb import PATH, json_option

if TYPE_CHECKING:
    from railnav.monitoring.lining import LiningPlan

TABLE_ENDINGS = (".csv", ".parquet")


@click.command("lining")
@click.argument("runs", type=PATH, nargs=-1, required=True, metavar="RUN...")
@click.option("-m", "--model", type=PATH, required=True, help="Reference track model, .gpkg (or .geojson).")
@click.option("-o", "--output", type=PATH, required=True, help="Plan to write: .csv or .parquet.")
@click.option(
    "--design", type=PATH, help="Design to reach: LandXML (.xml) or elements (.csv).  [default: a smoothed target]"
)
@click.option("--alignment", metavar="NAME", help="The design meant, where its file holds several along the section.")
@click.option("--design-crs", help="Plane of the design, where its file does not say.  [default: the model's]")
@click.option("--report", type=PATH, help="Also write a page about the plan, .html.")
@click.option("--axis", type=PATH, help="Also write the lined axis as a model: .gpkg, .geojson, .xml (LandXML), ...")
@click.option(
    "--tracks",
    metavar="TRACK,TRACK",
    help="The section: tracks in order.  [default: the longest way that a run covers]",
)
@click.option("--between", metavar="FROM-TO", help="Only this stretch, metres along the section, e.g. 1200-1800.")
@click.option("--km", metavar="FROM-TO", help="Only this stretch, published kilometres, e.g. 45.2-47.1.")
@click.option(
    "--step", type=click.FloatRange(0.5, 20), default=5.0, show_default=True, help="Distance between slews, m."
)
@click.option(
    "--cutoff",
    type=click.FloatRange(20, 500),
    help="Wavelength that a smoothed target halves, m.  [default: 100; 500 where the axis is known worse than 20 mm]",
)
@click.option(
    "--fixed", type=PATH, help="Fixed points: .csv with track, offset_m, slew_mm, slew_tolerance_mm, lift_mm, ..."
)
@click.option(
    "--most-slew",
    type=click.FloatRange(0, 1000),
    help="Greatest slew, mm.  [default: 100; 1000 where the axis is known worse than 20 mm]",
)
@click.option(
    "--least-lift", type=click.FloatRange(-1000, 1000), default=0.0, show_default=True, help="Least lift, mm."
)
@click.option(
    "--most-lift",
    type=click.FloatRange(0, 1000),
    help="Greatest lift, mm.  [default: 100; 1000 where the axis is known worse than 20 mm]",
)
@click.option(
    "--curvature-rate",
    type=click.FloatRange(0, 1e-2, min_open=True),
    help="Greatest change of curvature that what is left may add, in plan and profile, 1/m^2.  [default: 5e-6; 1e-4 where the axis is "
    "known worse than 20 mm]",
)
@click.option(
    "--ramp",
    type=click.FloatRange(0, 100, min_open=True),
    help="How fast corrections may begin and fade out at the ends, mm a metre.  [default: 1, or what the other limits need]",
)
@json_option
def command(
    runs: tuple[Path, ...],
    model: Path,
    output: Path,
    design: Path | None,
    alignment: str | None,
    design_crs: str | None,
    report: Path | None,
    axis: Path | None,
    tracks: str | None,
    between: str | None,
    km: str | None,
    step: float,
    cutoff: float | None,
    fixed: Path | None,
    most_slew: float | None,
    least_lift: float,
    most_lift: float | None,
    curvature_rate: float | None,
    ramp: float | None,
    as_json: bool,
) -> None:
    """Plan slews and lifts from the measured track to its design or a smoothed target.

    The track is measured by the RUNs' positions and angles where they are good enough, otherwise the model's own axis is taken; the plan
    says which, and how good it is. Slews are to the right as the distance grows. Fixed points, the greatest slew, lifts that only lift
    and the change of curvature are kept exactly (linear programme), and the work fades out at its ends; the classic versine method stands
    beside it. Of a design file the alignment along the section is taken.

    \b
    Example:
      railnav lining demo/survey-1 demo/survey-2 -m demo/line.gpkg -o plan.csv --report plan.html
    """  # noqa: D301
    from dataclasses import replace

    from railnav.cli import _files
    from railnav.cli._terminal import print_json, print_warnings, progress
    from railnav.errors import InputError

    inputs = [
        model,
        *(path for path in (design, fixed) if path is not None),
        *(member for run in runs for member in _files.members(run)),
    ]
    _files.check_output(output, TABLE_ENDINGS, inputs=inputs)
    if report is not None:
        _files.check_output(report, _files.PAGE_ENDINGS, inputs=[*inputs, output])
        _files.need_report()
    if axis is not None:
        _files.check_output(axis, _files.EXPORT_ENDINGS, inputs=[*inputs, output, *([report] if report else [])])
    if most_lift is not None and least_lift > most_lift:
        raise click.UsageError(f"--least-lift {least_lift:g} is above --most-lift {most_lift:g}")
    if between is not None and km is not None:
        raise click.UsageError("--between and --km both name the stretch: give one")
    stretch = _stretch(between or km or "", "--between" if between is not None else "--km")
    if design is None and (alignment is not None or design_crs is not None):
        raise click.UsageError("--alignment and --design-crs go with --design")
    from railnav.io.lining import read_fixed_points, write_plan
    from railnav.io.run import read_run
    from railnav.monitoring.lining import line_up, usual_limits
    from railnav.monitoring.position import stretch_of
    from railnav.monitoring.survey_section import measured_section

    reference = _files.read_model(model)
    designs: Any = ()
    if design is not None:
        from railnav.io.designs import read_designs

        designs = read_designs(design, crs=design_crs or reference.frame.crs_wkt)
        if not designs:
            raise InputError("holds no alignment", file=design)
    names = [name.strip() for name in tracks.split(",") if name.strip()] if tracks is not None else []
    asked = {
        "most_slew": None if most_slew is None else most_slew / 1e3,
        "least_lift": least_lift / 1e3,
        "most_lift": None if most_lift is None else most_lift / 1e3,
        "curvature_rate": curvature_rate,
        "gradient_rate": curvature_rate,
        "ramp": None if ramp is None else ramp / 1e3,
    }
    with progress() as tell:
        recorded = [read_run(run) for run in runs]
        measured, surveyed = measured_section(recorded, reference, tracks=names, progress=tell)
        if stretch is not None:
            scale = 1.0 if km is None else 1e3
            measured = stretch_of(measured, scale * stretch[0], scale * stretch[1], by_chainage=km is not None)
        usual, _ = usual_limits(measured)
        limits = replace(usual, **{name: value for name, value in asked.items() if value is not None})
        if limits.least_lift > limits.most_lift:
            raise click.UsageError(
                f"--least-lift {least_lift:g} is above the greatest lift of {1e3 * limits.most_lift:g} mm"
            )
        slews, lifts = read_fixed_points(fixed, measured.section) if fixed is not None else ((), ())
        if tell:
            tell("line", 0, 1)
        plan = line_up(
            measured,
            designs=designs,
            alignment=alignment or "",
            step=step,
            cutoff=cutoff,
            limits=limits,
            fixed_slew=slews,
            fixed_lift=lifts,
            smooth_base=surveyed,
        )
        if tell:
            tell("line", 1, 1)
    page = None
    if report is not None:
        from railnav.web.lining import lining_page

        page = lining_page(plan, simulated=any(run.simulated for run in recorded))
    write_plan(plan, output)
    if axis is not None:
        from railnav.monitoring.lined import lined_model

        _files.write_model(lined_model(plan), axis)
    if report is not None and page is not None:
        _files.write_text(report, page)
    if as_json:
        print_json({**facts(plan), "output": output, "report": report, "axis": axis})
        return
    print_warnings(plan.notes)
    _print(plan)
    click.echo(f"{', '.join(str(path) for path in (output, report, axis) if path is not None)} written")


def _stretch(text: str, option: str) -> tuple[float, float] | None:
    """From and to, in the option's unit; None for no text."""
    from math import isfinite
    from re import fullmatch

    if not text:
        return None
    found = fullmatch(r"\s*(-?[\d.]+)\s*-\s*(-?[\d.]+)\s*", text)
    try:
        ends = tuple(float(value) for value in found.groups()) if found else ()
    except ValueError:
        ends = ()
    if len(ends) != 2 or not all(isfinite(value) for value in ends) or ends[0] == ends[1]:
        raise click.BadParameter(f"{text!r} is not FROM-TO, e.g. 45.2-47.1", param_hint=option)
    return ends[0], ends[1]


def facts(plan: LiningPlan) -> dict[str, Any]:
    """The plan as plain facts."""
    from math import isfinite

    return {
        "section": plan.section.name,
        "length_m": float(plan.distance[-1] - plan.distance[0]),
        "nodes": len(plan.distance),
        "design": plan.design or None,
        "cutoff_m": plan.cutoff,
        "limits": {
            "most_slew_mm": 1e3 * plan.limits.most_slew,
            "least_lift_mm": 1e3 * plan.limits.least_lift,
            "most_lift_mm": 1e3 * plan.limits.most_lift,
            "curvature_rate_1_m2": plan.limits.curvature_rate,
            "ramp_mm_m": None if plan.limits.ramp is None else 1e3 * plan.limits.ramp,
        },
        "fixed_points": [point.name for point in dict.fromkeys((*plan.fixed_slew, *plan.fixed_lift))],
        "runs": list(plan.measured.runs),
        "sigma_right_mm": 1e3 * plan.measured.sigma_right,
        "sigma_up_mm": 1e3 * plan.measured.sigma_up,
        "usable": plan.usable,
        "greatest_slew_mm": 1e3 * float(abs(plan.slew).max()),
        "mean_slew_mm": 1e3 * float(abs(plan.slew).mean()),
        "greatest_lift_mm": 1e3 * float(plan.lift.max()),
        "sigma_slew_mm": 1e3 * float(max(plan.sigma_slew)),
        "spread_mm": {f"{name} {band}": [1e3 * a, 1e3 * b] for (name, band), (a, b) in plan.spread.items()},
        "bears": {
            f"{name} {band}": {"sigma_mm": 1e3 * sigma if isfinite(sigma) else None, "borne": good}
            for (name, band), (sigma, good) in plan.bears.items()
        },
        "versine_method": {
            "greatest_slew_mm": 1e3 * float(abs(plan.hallade_slew).max()) if len(plan.hallade_slew) else None,
            "spread_mm": {f"{name} {band}": [1e3 * a, 1e3 * b] for (name, band), (a, b) in plan.hallade_spread.items()},
        },
        "notes": list(plan.notes),
    }


def _print(plan: LiningPlan) -> None:
    from railnav.cli._terminal import print_facts, print_table
    from railnav.web import words
    from railnav.web.lining import good_to

    print_facts(
        f"Lining of {plan.section.name}",
        {
            "target": f"design {plan.design}"
            if plan.design
            else f"smoothed, waves under {plan.cutoff:.0f} m taken out",
            "length": words.length(float(plan.distance[-1] - plan.distance[0]), 5),
            "measured by": ", ".join(plan.measured.runs) or "the model's own axis",
            "good to": good_to(plan),
            "greatest slew": words.length(float(abs(plan.slew).max()), 3),
            "greatest lift": words.length(float(plan.lift.max()), 3),
        },
    )
    strings = plan.hallade_spread
    rows = [
        [
            name.replace("_", " "),
            band,
            f"{1e3 * before:.2f} mm",
            f"{1e3 * after:.2f} mm",
            f"{1e3 * strings[name, band][1]:.2f} mm" if (name, band) in strings else "",
            "yes" if plan.bears[name, band][1] else "no",
        ]
        for (name, band), (before, after) in plan.spread.items()
    ]
    print_table(
        "Standard deviation", ("channel", "band", "before", "after", "by versines", "axis bears it"), rows, left=2
    )
