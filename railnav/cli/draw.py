"""`railnav draw`: plan, curvature, cant and gradient diagrams."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from railnav.cli._verb import PATH, json_option

if TYPE_CHECKING:
    from railnav.monitoring.design import Design
    from railnav.monitoring.fitting import Fitted

DESIGN_ENDINGS = (".xml", ".landxml", ".csv")


@click.command("draw")
@click.argument("file", type=PATH)
@click.option("-o", "--output", type=PATH, help="Drawing: .html, .svg, .pdf or .png.  [default: FILE's name, .html]")
@click.option("--track", "tracks", multiple=True, metavar="TRACK", help="Draw this track only; may be repeated.")
@click.option(
    "--sheet",
    type=click.FloatRange(200.0, 100_000.0),
    help="Length of a sheet of a picture, m.  [default: 5000 in a .pdf, else all on one]",
)
@json_option
def command(file: Path, output: Path | None, tracks: tuple[str, ...], sheet: float | None, as_json: bool) -> None:
    """Draw plan, curvature, cant and gradient along chainage, as engineers know them.

    FILE is a design (LandXML .xml, elements .csv) or a model; the elements of a model are fitted first (`railnav alignment`).
    Curves to the right stand above the axis, with R and L; transitions with L and A; gradients in per mille over their length. A page
    stands alone and can be zoomed; a .pdf has one sheet a page, other pictures need one track.

    \b
    Example:
      railnav draw demo/line.gpkg -o line.html
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_json, print_warnings, progress
    from railnav.errors import InputError, RailnavError

    output = output or Path(f"{file.stem}.html")
    _files.check_output(output, _files.PICTURE_ENDINGS, inputs=[file])
    _files.need_report()
    if not file.exists():
        raise InputError("no such file or folder", file=file)
    is_design = file.suffix.lower() in (".xml", ".landxml") or (
        file.suffix.lower() == ".csv" and {"element", "grid_bearing_deg"} <= _files.columns(file)
    )
    fitted: list[Fitted] = []
    left_out: list[str] = []
    badge = ""
    designs: list[Design]
    if is_design:
        from railnav.io.designs import read_designs

        designs = list(read_designs(file))
        names = [design.track for design in designs]
        for track in tracks:
            if track not in names:
                raise InputError(f"has no alignment {track!r}; it has {', '.join(names[:8])}", file=file)
        designs = [design for design in designs if not tracks or design.track in tracks]
    else:
        if _files.kind_of(file) != "model":
            raise InputError("is neither a design nor a model", file=file, remedy="name .xml, .csv, .gpkg or .geojson")
        from railnav.monitoring.fitting import axis_of_model, fit_design
        from railnav.web.report import is_simulated

        model = _files.read_model(file)
        badge = "Simulated data" if is_simulated(model) else ""
        with progress() as tell:
            for name in list(dict.fromkeys(tracks)) or list(model.track_id):
                try:
                    fitted.append(fit_design(axis_of_model(model, name), progress=tell))
                except RailnavError as error:
                    if tracks or len(model.track_id) == 1:
                        raise InputError(str(error), file=file) from error
                    left_out.append(str(error))
        designs = [one.design for one in fitted]
    if not designs:
        raise InputError(f"has nothing to draw: {left_out[0]}" if left_out else "has nothing to draw", file=file)
    ending = output.suffix.lower()
    if ending in (".png", ".svg") and len(designs) > 1:
        most = ", ".join(design.track for design in designs[:8])
        raise InputError(
            f"{len(designs)} tracks do not go on one picture",
            file=output,
            remedy=f"name one with --track ({most}), or use .pdf",
        )
    from railnav.web.alignment import alignment_page, save_sheets, sheets

    if ending == ".html":
        _files.write_text(output, alignment_page(designs, fitted, title=file.stem, badge=badge, subtitle=file.name))
    else:
        length = sheet if sheet is not None else 5000.0 if ending == ".pdf" else None
        pictures = [picture for design in designs for picture in sheets(design, length=length)]
        if ending != ".pdf" and len(pictures) > 1:
            raise InputError(
                f"{len(pictures)} sheets do not go on one picture", file=output, remedy="use .pdf, or a longer --sheet"
            )
        save_sheets(pictures, output)
    warnings = [line for one in fitted for line in one.warnings] + left_out
    if as_json:
        print_json(
            {
                "file": file,
                "output": output,
                "tracks": [{"track": d.track, "length_m": d.length, "elements": len(d.kinds)} for d in designs],
                "warnings": warnings,
            }
        )
    else:
        click.echo(f"{output} written")
        print_warnings(warnings)
