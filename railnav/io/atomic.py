"""Saves that leave the old file or the new one, whole.

A file is written under a temporary name in the same folder, flushed to the disk, and renamed over the target in one
step of the file system; whatever goes wrong before that step, the target stays as it was and the temporary file is
removed. A process killed outright cannot remove its temporary file: it is called `.railnav-*.partial*` and may be
deleted by hand.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from railnav.errors import InputError

_SQLITE_COMPANIONS = ("-journal", "-wal", "-shm")


def _resolve(path: str | Path) -> Path:
    """Follow links to the place that a write would change, and check that it has a folder."""
    path = Path(path)
    try:
        target = path.resolve()
        folder_exists = target.parent.is_dir()
        target.exists()
    except (OSError, ValueError, RuntimeError) as error:  # a loop of links, a NUL in the name, a name too long
        raise InputError(f"is no usable path ({error})", file=path, remedy="choose another place") from error
    if not folder_exists:
        raise InputError(f"the folder {path.parent} does not exist", file=path, remedy="create it first")
    return target


def _cannot_write(path: str | Path, error: Exception) -> InputError:
    cause = (error.strerror if isinstance(error, OSError) else None) or str(error)
    return InputError(f"cannot be written ({cause})", file=path, remedy="choose another place or make room")


def _partial(target: Path) -> Path:
    return target.parent / f".railnav-{secrets.token_hex(8)}.partial{target.suffix[-20:]}"


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_folder(path: Path) -> None:
    with suppress(OSError):  # not every system can flush a folder; the rename is atomic all the same
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Lend a temporary path that becomes `path` when the block ends well.

    Parameters
    ----------
    path : path
        File to write; replaced in one step if it exists. A link is followed.

    Yields
    ------
    path
        Temporary path in the same folder and with the same ending; the file exists and is empty.

    Raises
    ------
    InputError
        The folder does not exist or cannot be written, the disk is full, or `path` is a folder or a device.

    Notes
    -----
    The temporary file is removed on every exception, KeyboardInterrupt included, with the files that SQLite may have
    put beside it.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_path(f"{folder}/solution.csv") as draft:
    ...         _ = draft.write_text("time_s")
    ...     [file.name for file in Path(folder).iterdir()]
    ['solution.csv']
    """
    target = _resolve(path)
    if target.is_dir():
        raise InputError("is a folder", file=path, remedy="give the name of a file")
    if target.exists() and not target.is_file():
        raise InputError("is no ordinary file", file=path, remedy="give the name of a file")
    draft = _partial(target)
    try:
        os.close(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))  # the system applies the umask
    except (OSError, ValueError) as error:
        raise _cannot_write(path, error) from error
    try:
        yield draft
        _sync(draft)
        draft.replace(target)
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        for leftover in (draft, *(Path(f"{draft}{ending}") for ending in _SQLITE_COMPANIONS)):
            with suppress(OSError):
                leftover.unlink(missing_ok=True)
    _sync_folder(target.parent)


@contextmanager
def atomic_folder(path: str | Path, *, replaceable: Collection[str] = ()) -> Iterator[Path]:
    """Lend a temporary folder that becomes `path` when the block ends well.

    Parameters
    ----------
    path : path
        Folder to write. It must not exist, be empty, or hold nothing but `replaceable` files.
    replaceable : collection of str
        Names of files that the same writer may have put there earlier; anything else in the folder is never touched.

    Yields
    ------
    path
        Temporary folder beside it, empty.

    Raises
    ------
    InputError
        The parent does not exist or cannot be written, or `path` is a file or a folder with other files in it.

    Notes
    -----
    A new or empty folder appears in one step. A folder that is replaced is first renamed aside, since no system call in
    reach swaps two folders: a process killed between these two renames leaves the old one whole as `.railnav-*.old`.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_folder(f"{folder}/run") as draft:
    ...         _ = (draft / "run.toml").write_text("[run]")
    ...     [file.name for file in (Path(folder) / "run").iterdir()]
    ['run.toml']
    """
    target = _resolve(path)
    try:
        held = sorted(file.name for file in target.iterdir()) if target.exists() else []
    except OSError as error:
        raise InputError("is no folder that can be replaced", file=path, remedy="give a new folder") from error
    foreign = [name for name in held if name not in replaceable]
    if foreign:
        cause = f"the folder is not empty (it holds {foreign[0]})"
        raise InputError(cause, file=path, remedy="give a new folder, or remove this one first")
    draft = _partial(target)
    aside = draft.with_suffix(".old")
    try:
        draft.mkdir()
    except (OSError, ValueError) as error:
        raise _cannot_write(path, error) from error
    try:
        yield draft
        for file in draft.rglob("*"):
            if file.is_file():
                _sync(file)
        _sync_folder(draft)
        if held:
            target.rename(aside)
            try:
                draft.rename(target)
            except BaseException:
                aside.rename(target)
                raise
        else:
            draft.replace(target)
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        if target.exists():
            shutil.rmtree(aside, ignore_errors=True)
    _sync_folder(target.parent)
