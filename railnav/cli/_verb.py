"""What every verb shares: how failure looks, and the options that mean the same everywhere."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])

#: A path on the command line. Existence is checked where the file is read, so that a missing file is one line and exit code 1.
PATH: Any = click.Path(path_type=Path, readable=False)


class Failure(click.ClickException):
    """The data or the request is at fault: one line on stderr, exit code 1."""

    exit_code = 1

    def show(self, file: IO[Any] | None = None) -> None:
        """Print the line, without the password that a store's address may hold."""
        from railnav.io.store_address import redacted

        click.echo(f"railnav: error: {redacted(' '.join(self.message.split()))}", file=file, err=file is None)


def describe(error: BaseException) -> str:
    """Say in one line what went wrong; an error of the operating system names its file first.

    Examples
    --------
    >>> describe(FileNotFoundError(2, "No such file or directory", "line.gpkg"))
    'line.gpkg: No such file or directory'
    """
    if isinstance(error, OSError) and error.strerror:
        names = [str(name) for name in (error.filename, error.filename2) if name is not None]
        return f"{' -> '.join(names)}: {error.strerror}" if names else error.strerror
    return str(error) or type(error).__name__


def json_option(function: F) -> F:
    """Add `--json`: one JSON object on stdout in place of words and tables."""
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of words and tables.")(
        function
    )


def crs_options(function: F) -> F:
    """Add `--crs`, `--zone-width` and `--ellipsoid`: the plane of the model."""
    for option in (
        click.option(
            "--ellipsoid",
            type=click.Choice(["wgs84", "krassowsky", "bessel"]),
            help="Ellipsoid of the Gauss-Krueger zone.  [default: wgs84]",
        ),
        click.option(
            "--zone-width",
            type=click.Choice(["3", "6"]),
            help="Width of the Gauss-Krueger zone, degrees.  [default: 6]",
        ),
        click.option(
            "--crs",
            help="Plane: an EPSG code, WKT, a frame file (.toml), or gk3 or gk6 for the Gauss-Krueger zone that fits.  [default: gk6]",
        ),
    ):
        function = option(function)
    return function


def frame_request(crs: str | None, zone_width: str | None, ellipsoid: str | None) -> dict[str, Any]:
    """Turn the plane options into the arguments that `choose_frame`, `build` and the readers take.

    Raises
    ------
    click.UsageError
        If options contradict each other.

    Examples
    --------
    >>> frame_request("gk3", None, None)
    {'crs': None, 'zone_width': 3, 'ellipsoid': 'wgs84'}
    >>> frame_request("EPSG:28409", None, None)["crs"]
    'EPSG:28409'
    """
    zones = {"gk3": "3", "gk6": "6"}
    named = crs.strip() if crs else None
    if named and named.lower() in zones:
        wanted = zones[named.lower()]
        if zone_width not in (None, wanted):
            raise click.UsageError(f"--crs {named} and --zone-width {zone_width} contradict each other")
        zone_width, named = wanted, None
    elif named and (zone_width or ellipsoid):
        raise click.UsageError("--zone-width and --ellipsoid shape a Gauss-Krueger zone; --crs names another plane")
    if named and named.isdigit():
        named = f"EPSG:{named}"
    plane: Any = named
    if named and ".toml" in named.lower():
        from railnav.io.frame_file import names_frame_file, read_frame

        if names_frame_file(named):
            plane = read_frame(named)
    return {"crs": plane, "zone_width": int(zone_width or 6), "ellipsoid": ellipsoid or "wgs84"}
