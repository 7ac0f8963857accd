"""`railnav draw`: plan, curvature, cant and gradient diagrams."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from railnav.cli._verb import PATH, json_option

if TYPE_CHECKING:
    from railnav.web.bands import Drawn

DESIGN_ENDINGS = (".xml", ".landxml", ".csv")
#: Longest model whose elements are fitted without being asked for, m.
FITTED_UNASKED = 20_000.0


@click.command("draw")
@click.argument("file", type=PATH)
@click.option("-o", "--output", type=PATH, help="Drawing: .html, .svg, .pdf or .png.  [default: FILE's name, .html]")
@click.option("--track", "tracks", multiple=True, metavar="TRACK", help="Draw this track only; may be repeated.")
@click.option(
    "--sheet",
    type=click.FloatRange(200.0, 100_000.0),
    help="Length of a sheet of a picture, m.  [default: 5000 in a .pdf, else all on one]",
)
@click.option(
    "--elements/--no-elements",
    default=None,
    help="Fit elements to a model first, or draw it as it is.  [default: fit where all tracks together are at most 20 km]",
)
@json_option
def command(
    file: Path,
    output: Path | None,
    tracks: tuple[str, ...],
    sheet: float | None,
    elements: bool | None,
    as_json: bool,
) -> None:
    """Draw plan, curvature, cant and gradient along chainage, as engineers know them.

    FILE is a design (LandXML .xml, elements .csv) or a model. Elements of a short model are fitted first (`railnav alignment`); a
    longer one is drawn by its own curvature, cant and gradient. Curves to the right stand above the axis, with R and L; transitions
    with L and A; gradients in per mille over their length. A page stands alone and can be zoomed; a .pdf has one sheet a page, other
    pictures need one track.

    \b
    Example:
      railnav draw demo/line.gpkg -o line.html
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_json, print_warnings, progress
    from railnav.errors import InputError, RailnavError, TrackError

    output = output or Path(f"{file.stem}.html")
    _files.check_output(output, _files.PICTURE_ENDINGS, inputs=[file])
    _files.need_report()
    if not file.exists():
        raise InputError("no such file or folder", file=file)
    is_design = file.suffix.lower() in (".xml", ".landxml") or (
        file.suffix.lower() == ".csv" and {"element", "grid_bearing_deg"} <= _files.columns(file)
    )
    from railnav.web.bands import drawn_design, drawn_track

    left_out: list[str] = []
    badge = ""
    drawn: list[Drawn] = []
    if is_design:
        if elements is not None:
            raise click.UsageError("--elements is for models; a design holds its elements")
        from railnav.io.designs import read_designs

        designs = read_designs(file)
        names = [design.track for design in designs]
        for track in tracks:
            if track not in names:
                raise InputError(f"has no alignment {track!r}; it has {', '.join(names[:8])}", file=file)
        drawn = [drawn_design(design) for design in designs if not tracks or design.track in tracks]
    else:
        if _files.kind_of(file) != "model":
            raise InputError("is neither a design nor a model", file=file, remedy="name .xml, .csv, .gpkg or .geojson")
        from railnav.web.report import is_simulated

        model = _files.read_model(file)
        badge = "Simulated data" if is_simulated(model) else ""
        names = list(dict.fromkeys(tracks)) or list(model.track_id)
        try:
            rows = [model.knots(name) for name in names]
        except TrackError as error:
            raise InputError(str(error), file=file) from error
        whole = sum(float(model.offset[own][-1] - model.offset[own][0]) for own in rows)
        if elements is None:
            elements = whole <= FITTED_UNASKED
        with progress() as tell:
            for name in names:
                if not elements:
                    drawn.append(drawn_track(model, name))
                    continue
                from railnav.monitoring.fitting import axis_of_model, fit_design

                try:
                    one = fit_design(axis_of_model(model, name), progress=tell)
                    drawn.append(drawn_design(one.design, one))
                except RailnavError as error:
                    left_out.append(f"{error}; drawn without elements")
                    drawn.append(drawn_track(model, name))
    if not drawn:
        raise InputError("has nothing to draw", file=file)
    ending = output.suffix.lower()
    if ending in (".png", ".svg") and len(drawn) > 1:
        most = ", ".join(one.track for one in drawn[:8])
        raise InputError(
            f"{len(drawn)} tracks do not go on one picture",
            file=output,
            remedy=f"name one with --track ({most}), or use .pdf",
        )
    if ending == ".html":
        from railnav.web.alignment import alignment_page

        page = alignment_page(drawn, title=file.stem, badge=badge, subtitle=file.name, warnings=left_out)
        _files.write_text(output, page)
    else:
        from railnav.web.sheets import SHEET, save_sheets, sheets

        length = sheet if sheet is not None else SHEET if ending == ".pdf" else None
        if ending != ".pdf" and length is not None and drawn[0].length > 1.05 * length:
            count = int(-(-drawn[0].length // length))
            raise InputError(
                f"{count} sheets do not go on one picture", file=output, remedy="use .pdf, or a longer --sheet"
            )
        save_sheets((picture for one in drawn for picture in sheets(one, length=length)), output)
    warnings = [line for one in drawn if one.fitted is not None for line in one.fitted.warnings] + left_out
    if as_json:
        print_json(
            {
                "file": file,
                "output": output,
                "tracks": [{"track": d.track, "length_m": d.length, "elements": len(d.plan)} for d in drawn],
                "warnings": warnings,
            }
        )
    else:
        fewer = not is_design and not elements
        click.echo(f"{output} written" + (" (the model as it is; --elements fits its elements first)" if fewer else ""))
        print_warnings(warnings)
