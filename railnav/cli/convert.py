"""`railnav convert`: the same thing in another format."""

from __future__ import annotations

from pathlib import Path

import click

from railnav.cli._verb import PATH, json_option


@click.command("convert")
@click.argument("source", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="File to write; its ending names the format.")
@json_option
def command(source: Path, output: Path, as_json: bool) -> None:
    """Write a model or a solution in another format.

    A model: .gpkg or .geojson. A solution: .csv, .parquet, .gpkg or .geojson. GeoJSON carries the line of a track in
    WGS 84 and leaves out what that format has no place for (covariance, knots, provenance).

    \b
    Example:
      railnav convert demo/line.gpkg -o line.geojson
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_json
    from railnav.errors import InputError

    kind = _files.kind_of(source)
    if kind == "run":
        raise InputError("a run cannot be converted", file=source, remedy="name a model or a solution")
    endings = _files.MODEL_ENDINGS if kind == "model" else _files.SOLUTION_ENDINGS
    _files.check_output(output, endings, inputs=[source])
    if kind == "model":
        _files.write_model(_files.read_model(source), output)
    elif kind == "truth":
        raise InputError("a truth file cannot be converted", file=source, remedy="name a model or a solution")
    else:
        _files.read_solution(source).to_file(output)
    if as_json:
        print_json({"source": source, "kind": kind, "output": output})
    else:
        click.echo(f"{output} written ({kind})")
