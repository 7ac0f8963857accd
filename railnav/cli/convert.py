"""`railnav convert`: the same thing in another format."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from railnav.cli._verb import PATH, json_option

if TYPE_CHECKING:
    from datetime import datetime


@click.command("convert")
@click.argument("source")
@click.option(
    "-o",
    "--output",
    type=PATH,
    required=True,
    help="File to write; its ending names the format. A log: also a new run folder.",
)
@click.option(
    "--format", "kind", help="Format of a log: nmea, ubx, rtklib-pos, gpx, gpsd or bag.  [default: told by the file]"
)
@click.option("--start", help="When a log starts, UTC, e.g. 2021-06-29T10:35:17Z; needed where it states no date.")
@click.option("--topic", "topics", multiple=True, help="Topic of a ROS recording; several.")
@click.option("--seconds", type=click.FloatRange(0, min_open=True), help="How long to record from an address.")
@json_option
def command(
    source: str,
    output: Path,
    kind: str | None,
    start: str | None,
    topics: tuple[str, ...],
    seconds: float | None,
    as_json: bool,
) -> None:
    """Write a model, a solution, a run or a log in another format.

    A model: .gpkg, .geojson, .kml, .xml (LandXML), .railml, .csv or .parquet (elements). A solution: .csv, .parquet, .gpkg,
    .geojson, .kml or .mfjson (OGC Moving Features). A run folder or a receiver's log (NMEA, UBX, RTKLIB .pos, GPX, gpsd JSON, ROS
    .bag and .mcap, or what tcp://host:port and gpsd://host send): .nmea, .pos, .gpx, .kml, .csv, .parquet, or without an ending a
    run folder. docs/formats.md says what each format carries and what it leaves out.

    \b
    Example:
      railnav convert demo/line.gpkg -o line.geojson
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_json, print_warnings
    from railnav.errors import InputError
    from railnav.io.logs import log_format
    from railnav.io.store_address import redacted
    from railnav.io.tcp_log import is_address

    path = Path(source)
    notes: tuple[str, ...] = ()
    more: dict[str, object] = {}
    if is_address(source) or (path.exists() and (kind or log_format(path) or (path / "run.toml").is_file())):
        what = "log" if is_address(source) or not (path / "run.toml").is_file() else "run"
        if output.suffix:
            inputs = [] if is_address(source) else [path, *_files.members(path)]
            _files.check_output(output, LOG_ENDINGS, inputs=inputs)
        else:
            _files.check_output_folder(output, mark="run.toml")
        from railnav.io.logs import convert_log

        with _recorded(source, path, seconds) as log:
            fixes, notes = convert_log(log, output, format=kind, start=_instant(start), topics=topics)
        more = {"fixes": fixes, "notes": list(notes)}
    else:
        if kind or start or topics or seconds:
            raise click.UsageError("--format, --start, --topic and --seconds are for logs")
        what = _files.kind_of(path)
        if what == "truth":
            raise InputError(
                "a truth file cannot be converted", file=path, remedy="name a model, a solution, a run or a log"
            )
        endings = _files.EXPORT_ENDINGS if what == "model" else (*_files.SOLUTION_ENDINGS, *_files.DRAWN_ENDINGS)
        _files.check_output(output, endings, inputs=[path])
        if what == "model":
            _files.write_model(_files.read_model(path), output)
        else:
            _files.write_solution(_files.read_solution(path), output)
    if as_json:
        print_json({"source": source, "kind": what, "output": output, **more})
    else:
        print_warnings(notes)
        click.echo(f"{redacted(str(output))} written ({what}{f', {fixes:,} fixes' if more else ''})")


LOG_ENDINGS = (".nmea", ".pos", ".gpx", ".kml", ".csv", ".parquet")


def _instant(text: str | None) -> datetime | None:
    """What `--start` says."""
    from datetime import UTC, datetime

    if text is None:
        return None
    try:
        value = datetime.fromisoformat(text.strip())
    except ValueError as error:
        raise click.UsageError(f"--start {text!r} is no instant; write 2021-06-29T10:35:17Z") from error
    return (value.replace(tzinfo=UTC) if value.utcoffset() is None else value).astimezone(UTC)


@contextmanager
def _recorded(source: str, path: Path, seconds: float | None) -> Iterator[Path]:
    """The log itself, or what an address sent, recorded beside nothing of the user's."""
    from railnav.io.tcp_log import is_address, record

    if not is_address(source):
        if seconds:
            raise click.UsageError("--seconds is for addresses: tcp://host:port")
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "recorded.log")
        record(source, log, seconds=seconds)
        yield log
