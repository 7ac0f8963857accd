"""GNSS logs over TCP: what a receiver, a serial server or gpsd sends is recorded into a file, which is then read like any other."""

from __future__ import annotations

import socket
import time
from pathlib import Path
from urllib.parse import urlsplit

from railnav.errors import RunError

#: Schemes that are understood; gpsd is asked to report in JSON.
SCHEMES = ("tcp", "gpsd")
GPSD_PORT = 2947
#: Without a byte for this long the sender is taken for gone, s.
SILENCE = 30.0
#: More than this is not recorded, bytes.
MAX_BYTES = 64 * 1024**3
_BLOCK = 1 << 16


def is_address(text: str) -> bool:
    """Whether a source is an address rather than a file: `tcp://host:port`, `gpsd://host[:port]`."""
    return text.partition("://")[0].lower() in SCHEMES and "://" in text


def record(address: str, path: str | Path, *, seconds: float | None = None, silence: float = SILENCE) -> int:
    """Record what an address sends until it closes, `seconds` are over, or it is silent.

    Parameters
    ----------
    address : str
        `tcp://host:port`, or `gpsd://host[:port]`.
    path : path
        File to write.
    seconds : float, optional
        How long to record; without it, until the sender closes or the user interrupts (Ctrl-C ends the recording, not the program).
    silence : float
        The sender is taken for gone after this long without a byte, s.

    Returns
    -------
    int
        Bytes recorded, more than 0.

    Raises
    ------
    RunError
        No such address, nobody answers there, or it sends nothing.
    """
    scheme, host, port = _parts(address)
    end = None if seconds is None else time.monotonic() + seconds
    count = 0
    try:
        with socket.create_connection((host, port), timeout=min(silence, 10.0)) as link, Path(path).open("wb") as file:
            if scheme == "gpsd":
                link.sendall(b'?WATCH={"enable":true,"json":true};\n')
            while count < MAX_BYTES:
                left = silence if end is None else min(silence, end - time.monotonic())
                if left <= 0.0:
                    break
                link.settimeout(left)
                try:
                    block = link.recv(_BLOCK)
                except TimeoutError:
                    break
                if not block:
                    break
                file.write(block)
                count += len(block)
    except KeyboardInterrupt:
        pass
    except OSError as error:
        cause = f"cannot be reached ({error.strerror or error})"
        raise RunError(cause, file=address, remedy="check the address and that it is sending") from error
    if not count:
        raise RunError("sends nothing", file=address, remedy="check the address and that the receiver is on")
    return count


def _parts(address: str) -> tuple[str, str, int]:
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError as error:
        raise RunError(f"is no address ({error})", file=address, remedy="write tcp://host:port") from error
    scheme = parts.scheme.lower()
    if scheme == "gpsd":
        port = port or GPSD_PORT
    if scheme not in SCHEMES or not parts.hostname or not port:
        raise RunError("is no address", file=address, remedy="write tcp://host:port, or gpsd://host")
    return scheme, parts.hostname, port
