"""XML files read as a whole, without entities, document types or network, and up to a stated size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from railnav.errors import InputError, RailnavError

#: A larger file is refused: it is read as a whole.
MAX_XML_BYTES = 256 * 1024**2


def read_document(path: Path, *, what: str, too_large: str) -> Any:
    """Root element of an XML file.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What it shall be, for messages: "LandXML", "railML".
    too_large : str
        What to do where it is larger than 256 MB.

    Raises
    ------
    InputError
        The file is missing, too large, no XML, or has a document type (entities are never expanded).
    RailnavError
        lxml is not installed.

    Examples
    --------
    >>> read_document(Path("nowhere.xml"), what="LandXML", too_large="split it")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.xml: does not exist; check the name
    """
    try:
        from lxml import etree
    except ImportError as error:
        raise RailnavError(f'{what} needs lxml; install with: pip install "railnav[network]"') from error
    try:
        if path.is_dir():
            raise InputError("is a folder", file=path, remedy=f"name a {what} file")
        size = path.stat().st_size
        if size > MAX_XML_BYTES:
            raise InputError(
                f"is {size / 1e6:.0f} MB; {what} up to {MAX_XML_BYTES / 1e6:.0f} MB is read",
                file=path,
                remedy=too_large,
            )
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise InputError("does not exist", file=path, remedy="check the name") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(f"cannot be read ({reason})", file=path) from error
    typed = any(
        word.encode(code) in data for word in ("<!DOCTYPE", "<!ENTITY") for code in ("utf-8", "utf-16-le", "utf-16-be")
    )
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        dtd_validation=False,
        huge_tree=False,
        remove_comments=True,
        remove_pis=True,
    )
    try:
        root = None if typed else etree.fromstring(data, parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        cause = " ".join(str(error).split())[:200]
        raise InputError(f"is no XML ({cause})", file=path, remedy="export it again; it may be cut short") from error
    if root is None or root.getroottree().docinfo.internalDTD is not None:
        raise InputError(
            "has a document type, which may hold entities",
            file=path,
            remedy=f"remove <!DOCTYPE ...>; {what} needs none",
        )
    return root


def local_name(node: Any) -> str:
    """Name of an element without its namespace; empty for what is no element."""
    return node.tag.rpartition("}")[2] if isinstance(node.tag, str) else ""


def children(node: Any, *names: str) -> list[Any]:
    """Child elements of these names, whatever their namespace."""
    return [child for child in node if local_name(child) in names]
