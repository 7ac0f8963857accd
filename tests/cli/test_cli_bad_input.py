"""Bad input: one line that names file, row and cause, exit code 1, nothing left at the output path, no traceback."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from railnav.cli import main


def rows(file: Path) -> list[list[str]]:
    return [line.split(",") for line in file.read_text(encoding="utf-8").splitlines()]


def save(file: Path, table: list[list[str]]) -> None:
    file.write_text("\n".join(",".join(row) for row in table) + "\n", encoding="utf-8")


def drop_column(run: Path) -> None:
    table = rows(run / "gnss.csv")
    k = table[0].index("latitude_deg")
    save(run / "gnss.csv", [row[:k] + row[k + 1 :] for row in table])


def put(name: str, row: int, value: str) -> Callable[[Path], None]:
    def change(run: Path) -> None:
        table = rows(run / "gnss.csv")
        table[row - 1][table[0].index(name)] = value
        save(run / "gnss.csv", table)

    return change


def backwards(run: Path) -> None:
    table = rows(run / "gnss.csv")
    table[6], table[7] = table[7], table[6]
    save(run / "gnss.csv", table)


def twice(run: Path) -> None:
    table = rows(run / "gnss.csv")
    table[7][0] = table[6][0]
    save(run / "gnss.csv", table)


def no_rows(run: Path) -> None:
    save(run / "gnss.csv", rows(run / "gnss.csv")[:1])


def no_bytes(run: Path) -> None:
    (run / "gnss.csv").write_bytes(b"")


def no_file(run: Path) -> None:
    (run / "gnss.csv").unlink()


def no_contents(run: Path) -> None:
    (run / "run.toml").unlink()


def broken_contents(run: Path) -> None:
    (run / "run.toml").write_text("[run\n")


def binary(run: Path) -> None:
    (run / "gnss.csv").write_bytes(bytes(range(256)) * 40)


RUN_FAULTS: list[tuple[str, Callable[[Path], None], list[str]]] = [
    ("missing column", drop_column, ["gnss.csv", "latitude_deg"]),
    ("NaN", put("latitude_deg", 9, "nan"), ["gnss.csv", "row 9", "latitude_deg"]),
    ("empty cell", put("longitude_deg", 9, ""), ["gnss.csv", "row 9", "longitude_deg"]),
    ("infinite", put("time_s", 9, "inf"), ["gnss.csv", "row 9", "time_s"]),
    ("words", put("latitude_deg", 9, "north"), ["gnss.csv", "row 9", "latitude_deg"]),
    ("time backwards", backwards, ["gnss.csv", "row 8", "time_s"]),
    ("duplicate time", twice, ["gnss.csv", "row 8", "time_s"]),
    ("sigma zero", put("sigma_east_m", 9, "0"), ["gnss.csv", "row 9", "sigma_east_m"]),
    ("sigma negative", put("sigma_north_m", 9, "-1.5"), ["gnss.csv", "row 9", "sigma_north_m"]),
    ("off the globe", put("latitude_deg", 9, "91"), ["gnss.csv", "row 9", "latitude_deg"]),
    ("no rows", no_rows, ["gnss.csv"]),
    ("no bytes", no_bytes, ["gnss.csv"]),
    ("no file", no_file, ["gnss.csv"]),
    ("no run.toml", no_contents, ["run.toml"]),
    ("broken run.toml", broken_contents, ["run.toml"]),
    ("binary", binary, ["gnss.csv"]),
]


def refused(arguments: list[str], words: list[str], folder: Path) -> str:
    """Run a verb that must refuse; returns its line."""
    before = sorted(folder.rglob("*"))
    done = CliRunner().invoke(main, arguments)
    assert done.exception is None or isinstance(done.exception, SystemExit), repr(done.exception)
    assert done.exit_code == 1, done.output
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("railnav: error: ")
    for word in words:
        assert word in lines[0]
    assert sorted(folder.rglob("*")) == before, "something was left behind"
    return lines[0]


@pytest.mark.parametrize(("fault", "words"), [f[1:] for f in RUN_FAULTS], ids=[f[0] for f in RUN_FAULTS])
@pytest.mark.parametrize("verb", ["navigate", "build", "info"])
def test_bad_runs(stock: Path, verb: str, fault: Callable[[Path], None], words: list[str]) -> None:
    fault(stock / "service")
    run, model = str(stock / "service"), str(stock / "line.gpkg")
    arguments = {
        "navigate": ["navigate", run, "-m", model, "-o", str(stock / "out.csv")],
        "build": ["build", str(stock / "survey-1"), run, "-o", str(stock / "out.gpkg")],
        "info": ["info", run, "--json"],
    }[verb]
    refused(arguments, words, stock)


@pytest.mark.parametrize(("fault", "words"), [f[1:] for f in RUN_FAULTS], ids=[f[0] for f in RUN_FAULTS])
def test_validate_tells_the_same_of_runs(stock: Path, fault: Callable[[Path], None], words: list[str]) -> None:
    fault(stock / "service")
    done = CliRunner().invoke(main, ["validate", str(stock / "service")])
    assert done.exit_code == 1
    assert "Traceback" not in done.output
    for word in words:
        assert word in done.output


def truncated(model: Path) -> None:
    whole = model.read_bytes()
    model.write_bytes(whole[: len(whole) // 2])


def cut_short(model: Path) -> None:
    model.write_bytes(model.read_bytes()[:700])


def foreign(model: Path) -> None:
    model.unlink()
    with sqlite3.connect(model) as connection:
        connection.execute("CREATE TABLE gpkg_contents (table_name TEXT)")
        connection.execute("INSERT INTO gpkg_contents VALUES ('roads')")
    connection.close()


def newer(model: Path) -> None:
    from railnav.io.container import META

    with sqlite3.connect(model) as connection:
        connection.execute(f"UPDATE {META} SET value = '999' WHERE key = 'schema_version'")
    connection.close()


MODEL_FAULTS: list[tuple[str, Callable[[Path], None], list[str]]] = [
    ("truncated", truncated, ["line.gpkg"]),
    ("cut in the first page", cut_short, ["line.gpkg"]),
    ("foreign", foreign, ["line.gpkg"]),
    ("newer schema", newer, ["line.gpkg", "999"]),
    ("empty", lambda model: model.write_bytes(b""), ["line.gpkg"]),
    ("a text", lambda model: model.write_text("hello " * 1000), ["line.gpkg"]),  # type: ignore[list-item]
    ("missing", lambda model: model.unlink(), ["line.gpkg"]),
]


@pytest.mark.parametrize(("fault", "words"), [f[1:] for f in MODEL_FAULTS], ids=[f[0] for f in MODEL_FAULTS])
@pytest.mark.parametrize("verb", ["navigate", "info", "validate", "convert", "view", "simulate"])
def test_bad_models(stock: Path, verb: str, fault: Callable[[Path], None], words: list[str]) -> None:
    model = stock / "line.gpkg"
    fault(model)
    arguments = {
        "navigate": [str(stock / "service"), "-m", str(model), "-o", str(stock / "out.csv")],
        "info": [str(model)],
        "validate": [str(model)],
        "convert": [str(model), "-o", str(stock / "out.geojson")],
        "view": [str(model), "-o", str(stock / "out.png")],
        "simulate": ["-m", str(model), "-o", str(stock / "out")],
    }[verb]
    refused([verb, *arguments], words, stock)


def test_a_run_that_never_touches_the_model(stock: Path) -> None:
    table = rows(stock / "service" / "gnss.csv")
    k = table[0].index("latitude_deg")
    for row in table[1:]:
        row[k] = f"{float(row[k]) + 0.2:.9f}"
    save(stock / "service" / "gnss.csv", table)
    run, model = str(stock / "service"), str(stock / "line.gpkg")
    refused(["navigate", run, "-m", model, "-o", str(stock / "out.gpkg")], ["model"], stock)


@pytest.mark.parametrize(
    ("crs", "word"),
    [
        ("EPSG:999999", "999999"),
        ("nonsense", "nonsense"),
        ("EPSG:4326", "4326"),
        ("PROJCS[broken", "broken"),
        ("EPSG:28355", ""),
    ],
)
@pytest.mark.parametrize("verb", ["build", "import"])
def test_planes_that_will_not_do(stock: Path, crs: str, word: str, verb: str) -> None:
    sources = [str(stock / "survey-1")] if verb == "build" else [str(stock / "line.geojson")]
    refused([verb, *sources, "-o", str(stock / "out.gpkg"), "--crs", crs], [word], stock)


@pytest.mark.parametrize(
    "arguments",
    [
        ["navigate", "service", "-m", "line.gpkg", "-o", "service/gnss.csv"],
        ["navigate", "service", "-m", "line.gpkg", "-o", "line.gpkg"],
        ["convert", "line.gpkg", "-o", "line.gpkg"],
        ["convert", "line.gpkg", "-o", "line.shp"],
        ["convert", "line.gpkg", "-o", "nowhere/line.geojson"],
        ["convert", "line.gpkg", "-o", "line.nmea"],
        ["convert", "service", "-o", "out.geojson"],
        ["convert", "service", "-o", "survey-1/gnss.csv/x"],
        ["convert", "tcp://127.0.0.1:1", "-o", "out.csv"],
        ["import", "line.gpkg", "-o", "out.gpkg"],
        ["convert", "truth.csv", "-o", "out.parquet"],
        ["import", "line.geojson", "-o", "line.geojson"],
        ["import", "truth.csv", "-o", "out.gpkg", "--crs", "EPSG:31467"],
        ["import", "truth.csv", "-o", "out.gpkg"],
        ["import", "missing.geojson", "-o", "out.gpkg"],
        ["import", "service", "-o", "out.gpkg"],
        ["build", "survey-1", "survey-2", "-o", "survey-1/gnss.gpkg/x.gpkg"],
        ["build", "survey-1", "missing", "-o", "out.gpkg"],
        ["build", "survey-1", "-o", "out.gpkg", "--report", "report.pdf"],
        ["build", "survey-1", "survey-1", "-o", "out.csv"],
        ["info", "missing"],
        ["info", "."],
        ["validate", "truth.csv"],
        ["view", "truth.csv"],
        ["view", "line.gpkg", "-m", "line.gpkg", "-o", "out.html"],
        ["simulate", "-m", "line.gpkg", "-o", "service"],
        ["simulate", "-m", "line.gpkg", "-o", "out", "--route", "77R-1"],
        ["simulate", "-m", "line.gpkg", "-o", "out", "--route", ","],
        ["evaluate", "truth.csv", "truth.csv"],
        ["evaluate", "missing.csv", "truth.csv"],
        ["demo", "-o", "service"],
        ["demo", "-o", "nowhere/demo"],
    ],
    ids=" ".join,
)
def test_bad_requests(stock: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]) -> None:
    monkeypatch.chdir(stock)
    refused(arguments, [], stock)


def test_a_folder_that_cannot_be_written(stock: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("railnav.cli._files.os.access", lambda *_: False)
    refused(["convert", str(stock / "line.gpkg"), "-o", str(stock / "out.geojson")], ["not writable"], stock)


@pytest.mark.parametrize("absent", ["plotly", "matplotlib"])
@pytest.mark.parametrize("verb", ["view", "evaluate", "demo", "build"])
def test_without_the_extra_report(stock: Path, monkeypatch: pytest.MonkeyPatch, absent: str, verb: str) -> None:
    monkeypatch.chdir(stock)
    monkeypatch.setattr("railnav.cli._files.find_spec", lambda name: None if name == absent else object())
    arguments = {
        "view": ["view", "line.gpkg", "-o", "out.png"],
        "evaluate": ["evaluate", "solution.csv", "truth.csv", "--report", "out.html"],
        "demo": ["demo", "-o", "out"],
        "build": ["build", "survey-1", "survey-2", "-o", "out.gpkg", "--report", "out.html"],
    }[verb]
    refused(arguments, [absent, 'pip install "railnav[report]"'], stock)


def test_the_installed_program_does_the_same(stock: Path) -> None:
    (stock / "line.gpkg").write_text("no GeoPackage")
    done = subprocess.run(
        [sys.executable, "-m", "railnav", "info", str(stock / "line.gpkg")], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert "line.gpkg" in done.stderr
