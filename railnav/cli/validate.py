"""`railnav validate`: every defect at once."""

from __future__ import annotations

from pathlib import Path

import click

from railnav.cli._verb import PATH, json_option


@click.command("validate")
@click.argument("file", type=PATH)
@json_option
@click.pass_context
def command(ctx: click.Context, file: Path, as_json: bool) -> None:
    """Check a model or a run and report every defect at once.

    Of a model: gaps, kinks, tracks twice, missing heights, impossible turnouts, joints that are missing, knots that
    contradict their offsets. Of a run folder: every column of every stream is judged, and a receiver's log too. Exit code 1 if
    anything is wrong; remarks (parts of a network without connection, a model without heights) are no defects.

    \b
    Example:
      railnav validate demo/bundled.gpkg
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_json
    from railnav.errors import InputError
    from railnav.web import words

    kind = _files.kind_of(file)
    if kind == "model":
        from railnav.track.validation import validate

        found = validate(_files.read_model(file))
        defects = [(d.kind, d.where, d.detail) for d in found if not d.remark]
        remarks = [(d.kind, d.where, d.detail) for d in found if d.remark]
    elif kind == "run":
        from railnav.io.run_check import run_defects

        defects, remarks = run_defects(file)
    elif kind == "log":
        from railnav.io.run_check import log_defects

        defects, remarks = log_defects(file)
    else:
        raise InputError(f"a {kind} cannot be validated", file=file, remedy="name a model, a run folder or a log")
    if as_json:
        print_json(
            {
                "file": file,
                "kind": kind,
                "valid": not defects,
                "defects": [{"kind": k, "where": where, "detail": detail} for k, where, detail in defects],
                "remarks": [{"kind": k, "where": where, "detail": detail} for k, where, detail in remarks],
            }
        )
    elif defects or remarks:
        counted = words.count(len(defects), "defect") if defects else f"no defects found ({kind})"
        click.secho(f"{file}: {counted}", bold=True)
        for what, where, detail in defects:
            click.echo(f"  {what}: {where}: {detail}")
        for what, where, detail in remarks:
            click.echo(f"  remark: {what}: {where}: {detail}")
    else:
        click.echo(f"{file}: no defects found ({kind})")
    if defects:
        ctx.exit(1)
