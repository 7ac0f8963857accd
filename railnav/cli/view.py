"""`railnav view`: a model or a solution, drawn."""

from __future__ import annotations

from pathlib import Path

import click

from railnav.cli._verb import PATH, json_option


@click.command("view")
@click.argument("file", type=PATH)
@click.option("-m", "--model", type=PATH, help="Model to draw beneath a solution.")
@click.option("-o", "--output", type=PATH, help="Drawing: .png, .svg, .pdf or .html.  [default: FILE's name, .html]")
@json_option
def command(file: Path, model: Path | None, output: Path | None, as_json: bool) -> None:
    """Draw a model or a solution as a picture or a page.

    A page (.html) stands alone and can be zoomed; it needs no network.

    \b
    Example:
      railnav view demo/line.gpkg -o line.png
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_json
    from railnav.errors import InputError

    output = output or Path(f"{file.stem}.html")
    _files.check_output(output, _files.PICTURE_ENDINGS, inputs=[file, *([model] if model else [])])
    kind = _files.kind_of(file)
    if kind not in ("model", "solution"):
        raise InputError(f"a {kind} cannot be drawn", file=file, remedy="name a model or a solution")
    if kind == "model" and model is not None:
        raise InputError("is a model; --model goes with a solution", file=file)
    _files.need_report()
    line = _files.read_model(file) if kind == "model" else _files.read_model(model) if model else None
    solution = _files.read_solution(file) if kind == "solution" else None
    if output.suffix.lower() == ".html":
        from railnav.web.report import build_page, solution_page

        if solution is not None:
            page = solution_page(solution, line)
        else:
            assert line is not None
            page = build_page(line)
        _files.write_text(output, page)
    else:
        from railnav.web.pictures import save, track_plan

        save(track_plan(line, solution), output)
    if as_json:
        print_json({"file": file, "kind": kind, "output": output})
    else:
        click.echo(f"{output} written")
