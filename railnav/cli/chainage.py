"""`railnav chainage`: published kilometres and the tracks they lie on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from railnav.cli._verb import PATH, json_option


@click.command("chainage")
@click.argument("model_file", metavar="MODEL", type=PATH)
@click.argument("address", required=False)
@click.option("--line", help="Line that the address is on.  [default: the only one]")
@click.option("--track", help="Give the addresses of a place on this track, at --offset.")
@click.option("--offset", type=float, help="True offset on the track, m.")
@click.option(
    "--notation",
    type=click.Choice(["german", "russian", "swiss", "british"]),
    default="german",
    show_default=True,
    help="How addresses are printed; they are read in any.",
)
@click.option("--posts", is_flag=True, help="Make line references of the model's mile posts; with -o.")
@click.option("--kilometres", type=PATH, help="Table of kilometres (line, km, length_m) to take in; with -o.")
@click.option("--stretched", is_flag=True, help="Each kilometre of the table counts 1000 m, whatever it measures.")
@click.option("-o", "--output", type=PATH, help="Model to write with the line references, .gpkg.")
@json_option
def command(
    model_file: Path,
    address: str | None,
    line: str | None,
    track: str | None,
    offset: float | None,
    notation: Any,
    posts: bool,
    kilometres: Path | None,
    stretched: bool,
    output: Path | None,
    as_json: bool,
) -> None:
    """Turn published addresses into places on tracks and back, and list the kilometres of lines.

    With ADDRESS ("12,3+45", "53+1054", "1254 km PK 7 +32", "12.345", "12 m 34 ch"): the places on tracks that it names. With
    --track and --offset: what every line there says of the place. Alone: the lines, and the kilometres that are too long or too
    short. With -o the model gets line references, from its mile posts or from a table of kilometres.

    \b
    Example:
      railnav chainage demo/bundled.gpkg 40,3+25 --line 77
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_facts, print_json, print_table
    from railnav.errors import InputError, TrackError
    from railnav.track.chainage import find_chainage, published
    from railnav.track.chainage_notation import format_chainage, parse_chainage
    from railnav.track.posts import references_from_posts, spread_references

    if (posts or kilometres is not None) != (output is not None):
        raise click.UsageError("--posts or --kilometres make line references, and -o says where the model goes")
    if (track is None) != (offset is None):
        raise click.UsageError("--track and --offset go together")
    if sum((address is not None, track is not None, output is not None)) > 1:
        raise click.UsageError("one thing at a time: an address, a place on a track, or new line references")
    if output is not None:
        inputs = [model_file, *([kilometres] if kilometres else [])]
        _files.check_output(output, (".gpkg",), inputs=inputs)
    model = _files.read_model(model_file)
    if not len(model.references):
        model = replace(model, references=spread_references(model, references_from_posts(model)))
        if posts and not len(model.references):
            raise InputError("has no mile posts", file=model_file, remedy="give a table by --kilometres")
    if kilometres is not None:
        from railnav.io.line_references import read_kilometres
        from railnav.track.posts import with_kilometres

        model = replace(
            model, references=with_kilometres(model.references, read_kilometres(kilometres, stretched=stretched))
        )
    lines = model.references.lines
    names = [reference.line for reference in lines]

    def shown(where: Any) -> str:
        return (
            format_chainage(where, notation, decimals=2) if where.metre >= 0 else f"{where.label}{where.metre:+.2f} m"
        )

    if address is not None:
        if line is None and len(names) != 1:
            raise TrackError(f"name the line by --line; the model has {', '.join(names) or 'no line references'}")
        wanted = parse_chainage(address)
        places = find_chainage(model, names[0] if line is None else line, wanted)
        rows = [{"track": p.track, "offset_m": p.offset, "rising": p.rising} for p in places]
        if as_json:
            print_json({"line": line or names[0], "label": wanted.label, "metre": wanted.metre, "places": rows})
        elif rows:
            print_table(
                f"{shown(wanted)} on line {line or names[0]}",
                ("track", "offset, m", "chainage"),
                [
                    (r["track"], f"{r['offset_m']:.3f}", "rises with offset" if r["rising"] else "falls with offset")
                    for r in rows
                ],
            )
        else:
            click.echo(f"{shown(wanted)} on line {line or names[0]} lies on no track of this model")
        return
    if track is not None and offset is not None:
        said = published(model, track, offset)
        if as_json:
            print_json(
                {
                    "track": track,
                    "offset_m": offset,
                    "addresses": [
                        {"line": p.line, "label": p.address.label, "metre": p.address.metre, "rising": p.rising}
                        for p in said
                    ],
                }
            )
        elif said:
            for p in said:
                click.echo(f"line {p.line or '(without a name)'}: {shown(p.address)}")
        else:
            click.echo(f"no line runs over track {track}")
        return
    if output is not None:
        _files.write_model(model, output)
    facts: list[dict[str, Any]] = [
        {
            "line": reference.line,
            "kilometres": len(reference.label),
            "first": int(reference.label[0]),
            "last": int(reference.label[-1]),
            "length_m": reference.length,
            "irregular": [{"km": km, "surplus_m": surplus} for km, surplus in reference.irregular()],
            "tracks": len({i for i, k, _ in model.references.stretches() if k == number}),
        }
        for number, reference in enumerate(lines)
    ]
    if as_json:
        print_json({"lines": facts, **({"output": output} if output else {})})
        return
    print_facts(
        f"{output} written" if output else str(model_file), {"lines": len(facts) or "none: no posts and no references"}
    )
    print_table(
        "Lines",
        ("line", "kilometres", "first", "last", "length", "tracks", "too long or short"),
        [
            (
                f["line"] or "(without a name)",
                f["kilometres"],
                f["first"],
                f["last"],
                f"{f['length_m'] / 1e3:.3f} km",
                f["tracks"],
                ", ".join(f"km {k['km']} {k['surplus_m']:+.1f} m" for k in f["irregular"][:5])
                + (f" and {len(f['irregular']) - 5} more" if len(f["irregular"]) > 5 else ""),
            )
            for f in facts
        ],
    )
