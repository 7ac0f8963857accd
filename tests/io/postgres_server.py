"""A PostgreSQL server of one's own: made in a temporary folder, reached on the loopback alone, stopped when the tests end."""

from __future__ import annotations

import os
import pwd
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class NoServer(Exception):
    """Why there is none."""


def _programs() -> Path:
    found = shutil.which("pg_ctl")
    if found:
        return Path(found).resolve().parent
    for folder in sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True):
        if (folder / "initdb").exists() and (folder / "postgres").exists():
            return folder
    raise NoServer("PostgreSQL is not installed (Debian: postgresql, postgresql-15-postgis-3)")


def _user() -> dict[str, object]:
    """The server refuses to run as root: another user then, the one of the package or nobody."""
    if os.geteuid() != 0:
        return {}
    for name in ("postgres", "nobody"):
        try:
            entry = pwd.getpwnam(name)
        except KeyError:
            continue
        return {"user": entry.pw_uid, "group": entry.pw_gid, "extra_groups": []}
    raise NoServer("PostgreSQL does not run as root, and there is no user postgres or nobody")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def running_server() -> Iterator[str]:
    """Lend the address of a server with PostGIS, "postgresql://tester:...@127.0.0.1:port/postgres"."""
    programs, who = _programs(), _user()
    folder = Path(tempfile.mkdtemp(prefix="railnav-postgres-"))
    server = None
    try:
        if who:
            os.chown(folder, who["user"], who["group"])
        password = secrets.token_hex(16)
        secret = folder / "password"
        secret.write_text(password)
        if who:
            os.chown(secret, who["user"], who["group"])
        environment = {**os.environ, "LC_ALL": "C.UTF-8", "HOME": str(folder)}
        made = subprocess.run(
            [programs / "initdb", "-D", folder / "data", "-U", "tester", "-A", "scram-sha-256", "--pwfile", secret, "-E", "UTF8", "-N"],
            capture_output=True, text=True, timeout=120, cwd=folder, env=environment, **who,
        )  # fmt: skip
        if made.returncode != 0:
            raise NoServer(f"initdb failed: {' '.join(made.stderr.split())[-300:]}")
        port = _free_port()
        log = (folder / "log").open("wb")
        server = subprocess.Popen(
            [
                programs / "postgres", "-D", folder / "data", "-p", str(port), "-c", "listen_addresses=127.0.0.1",
                "-c", "unix_socket_directories=", "-c", "fsync=off", "-c", "full_page_writes=off", "-c", "synchronous_commit=off",
            ],
            stdout=log, stderr=log, cwd=folder, env=environment, **who,
        )  # fmt: skip
        log.close()
        address = f"postgresql://tester:{password}@127.0.0.1:{port}/postgres"
        _wait(address, server, folder / "log")
        yield address
    finally:
        if server is not None:
            server.send_signal(signal.SIGQUIT)  # at once: what it holds is thrown away
            try:
                server.wait(timeout=20)
            except subprocess.TimeoutExpired:
                server.kill()
                server.wait(timeout=10)
        shutil.rmtree(folder, ignore_errors=True)


def _wait(address: str, server: subprocess.Popen[bytes], log: Path) -> None:
    import psycopg

    end = time.monotonic() + 60.0
    while True:
        if server.poll() is not None:
            raise NoServer(f"the server stopped at once: {log.read_text(errors='replace')[-300:]}")
        try:
            with psycopg.connect(address, connect_timeout=5, autocommit=True) as connection:
                connection.execute("CREATE EXTENSION IF NOT EXISTS postgis")
                return
        except psycopg.OperationalError as error:
            if time.monotonic() > end:
                raise NoServer(f"the server does not answer: {error}") from error
            time.sleep(0.1)
        except psycopg.Error as error:
            raise NoServer(f"PostGIS is not installed (Debian: postgresql-15-postgis-3): {error}") from error
