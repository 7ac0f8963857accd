"""Where a shared model lies: the address of a PostGIS store, a model and a version in it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qsl, quote, urlencode, urlsplit

from railnav.errors import ModelError

_STORE = re.compile(r"^postgres(?:ql)?:/+", re.I)
_USER = re.compile(r"postgres(?:ql)?:/+(?:[^@/\s?]*@)?", re.I)
#: What an address adds to libpq's own keys.
_OWN = ("model", "version", "schema", "note")


@dataclass(frozen=True, slots=True)
class StoreAddress:
    """A model in a store.

    Attributes
    ----------
    dsn : str
        What libpq connects by; it may hold a password and is never shown.
    model : str
        Name of the model; empty where the address names none.
    version : int or None
        None means the newest.
    schema : str
        Schema of the database that holds the tables.
    note : str
        Said with a version that is written.
    """

    dsn: str
    model: str
    version: int | None
    schema: str
    note: str = ""

    def __str__(self) -> str:
        """The address for people: without user and password."""
        parts = urlsplit(self.dsn)
        shown = f"postgresql://{parts.netloc.rpartition('@')[2]}{parts.path}"
        return f"{shown}?model={self.model}" + ("" if self.version is None else f"&version={self.version}")


def is_store(path: str | Path) -> bool:
    """Whether a path is the address of a store.

    Examples
    --------
    >>> is_store("postgresql://localhost/rail?model=line80"), is_store("line80.gpkg")
    (True, False)
    """
    return _STORE.match(str(path)) is not None


def redacted(text: str) -> str:
    """A text without the user and password of any store's address in it.

    Examples
    --------
    >>> redacted("postgresql://me:secret@host/rail?model=a written")
    'postgresql://host/rail?model=a written'
    """
    return _USER.sub("postgresql://", text)


def store_address(path: str | Path) -> StoreAddress:
    """Read the address of a store.

    Parameters
    ----------
    path : str or path
        "postgresql://user@host:5432/database?model=line80&version=3": libpq's own address (its keys, such as sslmode, may follow
        too) with the model's name and, unless the newest is meant, its version; `schema` names the schema ("railnav").

    Returns
    -------
    StoreAddress

    Raises
    ------
    ModelError
        No such address, or a version that is no number.

    Examples
    --------
    >>> store_address("postgresql://me:secret@db.example/rail?model=line80&version=3")
    StoreAddress(dsn='postgresql://me:secret@db.example/rail', model='line80', version=3, schema='railnav', note='')
    >>> print(store_address("postgresql://me:secret@db.example/rail?model=line80"))
    postgresql://db.example/rail?model=line80
    """
    text = str(path)
    if not is_store(text):
        raise ModelError("is no address of a store", file=text[:40], remedy="postgresql://host/database?model=name")
    rest = _STORE.sub("", text)  # a path object has folded "//" into "/"
    head, _, query = rest.partition("?")
    lone = "/" not in head
    try:
        parts = urlsplit(f"postgresql:///{head}" if lone else f"postgresql://{head}")
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError as error:
        remedy = "postgresql://host/database?model=name"
        raise ModelError("is no address of a store", file="postgresql://...", remedy=remedy) from error
    own = {key: value for key, value in pairs if key in _OWN}
    others = [(key, value) for key, value in pairs if key not in _OWN]
    version = own.get("version", "")
    if version and not (version.isascii() and version.isdigit() and 0 < int(version) < 2**31):
        raise ModelError(f"version {version[:20]!r} is no number", file="postgresql://...", remedy="count from 1")
    model = own.get("model", "")
    for what, value in (("model", model), ("schema", own.get("schema", "railnav"))):
        if len(value) > 60 or "\0" in value or any(ord(c) < 32 for c in value):
            raise ModelError(f"{what} {value[:20]!r} is no name", file="postgresql://...", remedy="60 letters at most")
    asked = urlencode(others, quote_via=quote)
    dsn = f"postgresql://{parts.netloc}{parts.path}{'?' if asked else ''}{asked}"
    return StoreAddress(
        dsn, model, int(version) if version else None, own.get("schema", "railnav"), own.get("note", "")
    )
