"""`railnav store`: what a shared store of models holds."""

from __future__ import annotations

import click

from railnav.cli._verb import json_option


@click.command("store")
@click.argument("address")
@json_option
def command(address: str, as_json: bool) -> None:
    """List the models of a shared store, and their versions.

    ADDRESS is postgresql://user@host/database, with ?model=NAME for one model. Every verb that reads a model takes such an
    address with ?model=NAME (the newest version, or &version=3); every verb that writes one saves a new version there. Keep
    passwords in ~/.pgpass or PGPASSWORD rather than in the address.

    \b
    Example:
      railnav store "postgresql://localhost/rail"
    """  # noqa: D301
    from railnav.cli._terminal import print_json, print_table
    from railnav.errors import ModelError
    from railnav.io.postgis import list_versions
    from railnav.io.store_address import is_store, redacted

    if not is_store(address):
        raise ModelError("is no address of a store", file=address[:60], remedy="postgresql://host/database")
    found = list_versions(address)
    if as_json:
        rows = [
            {
                "model": v.model,
                "version": v.version,
                "created": v.created.isoformat(),
                "created_by": v.created_by,
                "note": v.note,
                "tracks": v.tracks,
                "length_m": v.length,
            }
            for v in found
        ]
        print_json({"store": address, "versions": rows})
    elif not found:
        click.echo(f"{redacted(address)}: no models")
    else:
        print_table(
            redacted(address),
            ("model", "note", "by", "version", "saved", "tracks", "length"),
            [
                (
                    v.model,
                    v.note,
                    v.created_by,
                    v.version,
                    f"{v.created:%Y-%m-%d %H:%M}",
                    v.tracks,
                    f"{v.length / 1e3:,.3f} km",
                )
                for v in found
            ],
            left=3,
        )
