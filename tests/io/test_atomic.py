"""A save leaves the old file or the new one whole, whatever happens in between."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from railnav.errors import InputError
from railnav.io.atomic import atomic_folder, atomic_path


def names(folder):
    return sorted(file.name for file in folder.iterdir())


def test_new_file_takes_the_place_of_the_old(tmp_path):
    target = tmp_path / "solution.csv"
    target.write_text("old")
    with atomic_path(target) as draft:
        draft.write_text("new")
        assert target.read_text() == "old"
        assert draft.parent == target.parent
        assert draft.suffix == ".csv"
    assert target.read_text() == "new"
    assert names(tmp_path) == ["solution.csv"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit, MemoryError])
def test_failure_keeps_the_old_file_and_leaves_nothing_behind(tmp_path, error):
    target = tmp_path / "model.gpkg"
    target.write_text("old")

    def save():
        with atomic_path(target) as draft:
            draft.write_text("half")
            Path(f"{draft}-journal").write_text("left by SQLite")
            raise error

    with pytest.raises(error):
        save()
    assert target.read_text() == "old"
    assert names(tmp_path) == ["model.gpkg"]


def test_failure_before_any_old_file_leaves_nothing(tmp_path):
    with pytest.raises(ZeroDivisionError), atomic_path(tmp_path / "a.csv"):
        raise ZeroDivisionError
    assert names(tmp_path) == []


def test_system_errors_become_one_line(tmp_path):
    with (
        pytest.raises(InputError, match=r"model.gpkg: cannot be written \(No space left"),
        atomic_path(tmp_path / "model.gpkg"),
    ):
        raise OSError(28, "No space left on device")


def test_permissions_follow_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        with atomic_path(tmp_path / "a.csv") as draft:
            draft.write_text("a")
        with atomic_folder(tmp_path / "run"):
            pass
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.csv").stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "run").stat().st_mode) == 0o750


def test_link_is_followed(tmp_path):
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "real.csv").write_text("old")
    (tmp_path / "link.csv").symlink_to("store/real.csv")
    with atomic_path(tmp_path / "link.csv") as draft:
        draft.write_text("new")
    assert (tmp_path / "link.csv").is_symlink()
    assert (tmp_path / "store" / "real.csv").read_text() == "new"


def test_refusals_say_what_would_work(tmp_path):
    with pytest.raises(InputError, match=r"a.csv: the folder .* does not exist; create it first"):
        atomic_path(tmp_path / "nowhere" / "a.csv").__enter__()
    with pytest.raises(InputError, match="is a folder; give the name of a file"):
        atomic_path(tmp_path).__enter__()
    with pytest.raises(InputError, match="is no ordinary file"):
        atomic_path("/dev/null").__enter__()
    with pytest.raises(InputError, match=r"is no usable path|does not exist"):
        atomic_path(tmp_path / "a\0b").__enter__()
    with pytest.raises(InputError, match="is no usable path"), atomic_path(tmp_path / ("x" * 300)):
        pass
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(InputError, match=r"loop"), atomic_path(tmp_path / "loop" / "a.csv"):
        pass


def test_unwritable_folder_is_refused(tmp_path, monkeypatch):
    def deny(*_args, **_options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", deny)  # the tests may run as root, whom no folder refuses
    with pytest.raises(InputError, match=r"a.csv: cannot be written \(Permission denied\)"):
        atomic_path(tmp_path / "a.csv").__enter__()
    monkeypatch.setattr(Path, "mkdir", deny)
    with pytest.raises(InputError, match=r"run: cannot be written \(Permission denied\)"):
        atomic_folder(tmp_path / "run").__enter__()


CHILD = """
import sys
from railnav.io.atomic import atomic_path
letter = 0
while True:
    letter = 1 - letter
    with atomic_path(sys.argv[1]) as draft, draft.open("w") as file:
        for _ in range(200):
            file.write("AB"[letter] * 5000)
    print("saved", flush=True)
"""


def test_killed_save_leaves_one_whole_file(tmp_path):
    target = tmp_path / "model.gpkg"
    target.write_text("B" * 1_000_000)
    partial_seen = False
    for delay in (0.0, 0.001, 0.002, 0.003, 0.005, 0.008):
        child = subprocess.Popen([sys.executable, "-c", CHILD, str(target)], stdout=subprocess.PIPE)
        child.stdout.readline()
        time.sleep(delay)
        child.send_signal(signal.SIGKILL)
        child.wait()
        child.stdout.close()
        text = target.read_text()
        assert text in ("A" * 1_000_000, "B" * 1_000_000)
        partial_seen |= len(names(tmp_path)) > 1
    assert partial_seen, "no kill hit a save half-way: the test shows nothing"


def test_folder_appears_whole_or_not_at_all(tmp_path):
    target = tmp_path / "run"

    def save():
        with atomic_folder(target) as draft:
            (draft / "gnss.csv").write_text("half")
            assert not target.exists()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        save()
    assert names(tmp_path) == []
    target.mkdir()
    with atomic_folder(target) as draft:
        (draft / "gnss.csv").write_text("whole")
    assert (target / "gnss.csv").read_text() == "whole"
    assert names(tmp_path) == ["run"]


def test_folder_replaces_only_what_it_may(tmp_path):
    target = tmp_path / "run"
    target.mkdir()
    (target / "gnss.csv").write_text("old")
    with pytest.raises(InputError, match=r"run: the folder is not empty \(it holds gnss.csv\)"), atomic_folder(target):
        pass
    with atomic_folder(target, replaceable=["gnss.csv"]) as draft:
        (draft / "imu.csv").write_text("new")
        assert (target / "gnss.csv").read_text() == "old"
    assert names(target) == ["imu.csv"]
    assert names(tmp_path) == ["run"]
    with pytest.raises(ZeroDivisionError), atomic_folder(target, replaceable=["imu.csv"]):
        raise ZeroDivisionError
    assert (target / "imu.csv").read_text() == "new"
    (tmp_path / "file").write_text("a file")
    with pytest.raises(InputError, match="is no folder that can be replaced"), atomic_folder(tmp_path / "file"):
        pass
