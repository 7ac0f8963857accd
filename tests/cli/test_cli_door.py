"""The door itself: help, version, laziness, exit codes, output paths, JSON."""

from __future__ import annotations

import inspect
import json
import math
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from railnav.cli import VERBS, _files, _terminal, _verb, main
from railnav.errors import InputError, RailnavError


def verb_of(name: str) -> click.Command:
    command = main.get_command(click.Context(main), name)
    assert command is not None
    return command


def test_help_lists_every_verb_without_loading_one() -> None:
    code = (
        "import sys\n"
        "from railnav.cli import main, VERBS\n"
        "main(['--help'], standalone_mode=False)\n"
        "loaded = {m.split('.')[0] for m in sys.modules}\n"
        "heavy = loaded & {'numpy', 'numba', 'scipy', 'pyproj', 'shapely', 'networkx', 'pyarrow', 'rich', 'msgspec', 'plotly',"
        " 'matplotlib', 'sqlite3'}\n"
        "verbs = [m for m in sys.modules if m.startswith('railnav.cli.') and not m.startswith('railnav.cli._')]\n"
        "print('LOADED', sorted(heavy), verbs)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "LOADED [] []" in done.stdout
    for verb, (_, short) in VERBS.items():
        assert verb in done.stdout
        assert short.split()[0] in done.stdout


def test_help_of_a_verb_loads_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from railnav.cli import main, VERBS\n"
        "for verb in VERBS:\n"
        "    main([verb, '--help'], standalone_mode=False)\n"
        "print('LOADED', sorted({m.split('.')[0] for m in sys.modules} & {'numpy', 'numba', 'scipy', 'pyproj', 'pyarrow', 'rich'}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "LOADED []" in done.stdout


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_is_documented(verb: str) -> None:
    command = verb_of(verb)
    assert command.name == verb
    text = inspect.cleandoc(command.help or "")
    assert text.split("\n\n")[0].replace("\n", " ") == VERBS[verb][1], (
        "the short help in VERBS is the first sentence of the long one"
    )
    assert f"Example:\n  railnav {verb} " in text or f"Example:\n  railnav {verb}\n" in text
    assert any("--json" in option.opts for option in command.params)
    for option in command.params:
        if isinstance(option, click.Option):
            assert option.help, f"{option.opts} of {verb} says nothing"


def test_reference_is_up_to_date() -> None:
    script = Path(__file__).parents[2] / "docs" / "make_cli_reference.py"
    done = subprocess.run([sys.executable, str(script), "--check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    text = script.with_name("cli.md").read_text(encoding="utf-8")
    for verb in VERBS:
        assert f"## railnav {verb}\n" in text


def test_version() -> None:
    import railnav

    done = CliRunner().invoke(main, ["--version"])
    assert (done.exit_code, done.stdout) == (0, f"railnav {railnav.__version__}\n")
    by_module = subprocess.run([sys.executable, "-m", "railnav", "--version"], capture_output=True, text=True)
    assert by_module.stdout == done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["bild"], "did you mean 'build'"),
        (["xyzzy"], "the verbs are demo, import"),
        (["navigate"], "RUN"),
        (["navigate", "run", "-m", "m.gpkg"], "--output"),
        (["navigate", "run", "-m", "m.gpkg", "-o", "s.csv", "--integrity-risk", "2"], "integrity-risk"),
        (["build", "-o", "m.gpkg"], "RUN"),
        (["build", "run", "-o", "m.gpkg", "--crs", "gk3", "--zone-width", "6"], "contradict"),
        (["build", "run", "-o", "m.gpkg", "--crs", "EPSG:28409", "--ellipsoid", "bessel"], "another plane"),
        (["info", "--wat", "x"], "--wat"),
    ],
)
def test_usage_is_exit_code_2(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 2
    assert words in done.stderr
    assert done.stdout == ""


def _raise(error: BaseException) -> click.Command:
    @click.command()
    def command() -> None:
        raise error

    return command


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (RailnavError("no such\n  luck"), "railnav: error: no such luck\n"),
        (
            InputError("NaN", file="gnss.csv", row=7, column="time_s"),
            "railnav: error: gnss.csv, row 7, column time_s: NaN\n",
        ),
        (
            FileNotFoundError(2, "No such file or directory", "x.csv"),
            "railnav: error: x.csv: No such file or directory\n",
        ),
        (OSError(28, "No space left on device"), "railnav: error: No space left on device\n"),
    ],
)
def test_errors_become_one_line(monkeypatch: pytest.MonkeyPatch, error: Exception, line: str) -> None:
    monkeypatch.setattr(type(main), "get_command", lambda *_: _raise(error))
    done = CliRunner().invoke(main, ["info"])
    assert (done.exit_code, done.stderr, done.stdout) == (1, line, "")


def test_bugs_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(main), "get_command", lambda *_: _raise(ZeroDivisionError("a bug")))
    done = CliRunner().invoke(main, ["info"])
    assert isinstance(done.exception, ZeroDivisionError)


def test_interrupt_is_130(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(main), "get_command", lambda *_: _raise(KeyboardInterrupt()))
    done = CliRunner().invoke(main, ["info"])
    assert done.exit_code == 130
    assert "interrupted" in done.stderr


def test_output_paths_are_checked_first(tmp_path: Path) -> None:
    endings = (".csv", ".gpkg")
    source = tmp_path / "in.gpkg"
    source.write_bytes(b"x")
    (tmp_path / "link.gpkg").symlink_to(source)
    assert _files.check_output(tmp_path / "out.CSV", endings, inputs=[source]).name == "out.CSV"
    for path, words in [
        (tmp_path / "out.shp", "use .csv or .gpkg"),
        (tmp_path / "missing" / "out.csv", "there is no folder"),
        (source, "would be overwritten"),
        (tmp_path / "link.gpkg", "would be overwritten"),
    ]:
        with pytest.raises(InputError, match=words):
            _files.check_output(path, endings, inputs=[source])
    folder = tmp_path / "folder.csv"
    folder.mkdir()
    with pytest.raises(InputError, match="is a folder"):
        _files.check_output(folder, endings)


def test_output_folders_are_never_mixed(tmp_path: Path) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (full / "mine.txt").write_text("keep")
    with pytest.raises(InputError, match="not empty"):
        _files.check_output_folder(full)
    with pytest.raises(InputError, match="not empty"):
        _files.check_output_folder(full, mark="report.html")
    (full / "report.html").write_text("")
    assert _files.check_output_folder(full, mark="report.html") == full
    with pytest.raises(InputError, match="is a file"):
        _files.check_output_folder(full / "mine.txt")
    with pytest.raises(InputError, match="no folder"):
        _files.check_output_folder(tmp_path / "a" / "b")


def test_json_is_plain(capsys: pytest.CaptureFixture[str]) -> None:
    _terminal.print_json(
        {
            "a": np.float64(1.5),
            "b": np.array([1.0, math.nan]),
            "c": math.inf,
            "d": Path("x"),
            "e": (1, True, None),
            "f": np.int64(3),
        }
    )
    assert json.loads(capsys.readouterr().out) == {
        "a": 1.5,
        "b": [1.0, None],
        "c": None,
        "d": "x",
        "e": [1, True, None],
        "f": 3,
    }


def test_tables_read_whole_in_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    long = "x" * 60
    _terminal.print_table("Runs", ("run", "empty", "why", "[bold]n"), [(long, "", "[red]text[/red]", "12")], left=2)
    out = capsys.readouterr().out
    assert long in out
    assert "[red]text[/red]" in out, "text from files is never markup"
    assert "empty" not in out
    _terminal.print_table("Nothing", ("a",), [])
    assert capsys.readouterr().out == ""


def test_progress_is_silent_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with _terminal.progress() as report:
        assert report is None
    assert capsys.readouterr().err == ""


def test_progress_shows_stages_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    with _terminal.progress() as report:
        assert report is not None
        report("match [1]", 0, 10)
        report("match [1]", 10, 10)
    captured = capsys.readouterr()
    assert "match [1]" in captured.err
    assert "100%" in captured.err
    assert captured.out == ""


def test_planes_on_the_command_line() -> None:
    assert _verb.frame_request(None, None, None) == {"crs": None, "zone_width": 6, "ellipsoid": "wgs84"}
    assert _verb.frame_request("GK6", "6", "bessel") == {"crs": None, "zone_width": 6, "ellipsoid": "bessel"}
    assert _verb.frame_request("31467", None, None)["crs"] == "EPSG:31467"


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("a.csv", "time_s,track,offset_m,mode,heading_deg\n", "solution"),
        ("a.csv", '"time_s","track","offset_m","speed_m_s","heading_deg"\n', "truth"),
        ("a.geojson", '{"type": "FeatureCollection", "features": [{"geometry": {"type": "LineString"}}]}', "model"),
        ("a.geojson", '{"type": "FeatureCollection", "features": [{"geometry": {"type": "Point"}}]}', "solution"),
        ("a.gpkg", "no GeoPackage at all", "model"),
    ],
)
def test_kinds_of_files(tmp_path: Path, name: str, content: str, kind: str) -> None:
    (tmp_path / name).write_text(content)
    assert _files.kind_of(tmp_path / name) == kind


def test_unknown_kinds_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("")
    (tmp_path / "a.parquet").write_text("no parquet")
    (tmp_path / "run.toml").write_text("")
    (tmp_path / "empty").mkdir()
    for name, words in [
        ("a.txt", "neither a model"),
        ("gone.gpkg", "no such file"),
        ("empty", "holds no run.toml"),
        ("a.parquet", "not a Parquet"),
        ("run.toml", "name its folder"),
    ]:
        with pytest.raises(InputError, match=words):
            _files.kind_of(tmp_path / name)


def test_a_terminal_without_the_signs(tmp_path: Path) -> None:
    import os

    (tmp_path / "run.toml").write_text(
        '[run]\nid = "Tőzeg"\nstart = "2026-05-04T08:00:00Z"\n[odometer]\nfile = "o.csv"\n', encoding="utf-8"
    )
    (tmp_path / "o.csv").write_text("time_s,speed_m_s\n0.0,10.0\n0.1,10.2\n")
    done = subprocess.run(
        [sys.executable, "-m", "railnav", "info", str(tmp_path)],
        capture_output=True,
        encoding="latin-1",
        env={**os.environ, "PYTHONIOENCODING": "latin-1", "PYTHONUTF8": "0"},
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "T?zeg" in done.stdout


def test_a_reader_that_leaves_early(tmp_path: Path) -> None:
    command = f"{sys.executable} -m railnav --help | head -1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.stdout.startswith("Usage")
