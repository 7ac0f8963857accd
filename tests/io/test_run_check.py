"""Every defect of a run folder at once, and what was left out of a log."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from railnav.errors import RunError
from railnav.io.logs import convert_log
from railnav.io.run import read_run, write_run
from railnav.io.run_check import run_defects
from railnav.run import GnssStream, OdometerStream, Run

START = datetime(2025, 7, 8, 12, tzinfo=UTC)


@pytest.fixture
def folder(tmp_path):
    t = np.arange(20.0)
    gnss = GnssStream(
        t, np.radians(47.0 + 0 * t), np.radians(19.0 + 1e-5 * t), height=0 * t + 100, sigma_east=0 * t + 1
    )
    write_run(Run("a", START, gnss=gnss, odometer=OdometerStream(t, speed=0 * t + 3)), tmp_path / "a")
    return tmp_path / "a"


def edit(file, **cells):
    """Change cells: column = {row as an editor counts: text}."""
    rows = [line.split(",") for line in file.read_text().splitlines()]
    for column, changes in cells.items():
        k = rows[0].index(column)
        for row, text in changes.items():
            rows[row - 1][k] = text
    file.write_text("\n".join(",".join(row) for row in rows) + "\n")


def test_a_good_run_has_none(folder):
    assert run_defects(folder) == ([], [])


def test_all_of_them_are_listed(folder):
    edit(
        folder / "gnss.csv",
        latitude_deg={3: "", 5: "", 9: "91"},
        longitude_deg={4: "inf"},
        sigma_east_m={6: "0", 7: "-1"},
        time_s={11: "3", 15: "12"},
    )
    edit(folder / "odometer.csv", speed_m_s={2: "fast"})
    defects, remarks = run_defects(folder)
    assert remarks == []
    found = {(kind, where.rpartition("column ")[2]): (where, what) for kind, where, what in defects}
    assert set(found) == {
        ("gnss", "latitude_deg"),
        ("gnss", "longitude_deg"),
        ("gnss", "sigma_east_m"),
        ("gnss", "time_s"),
        ("odometer", "speed_m_s"),
    }
    said = [what for _, _, what in defects]
    assert "2 cells are empty or not a number (rows 3, 5); remove rows without a fix" in said
    assert "is outside -90 to 90; correct them or their unit" in said
    assert "2 cells are not positive (rows 6, 7); leave cells empty where nothing is known" in said
    assert "'fast' is not a number" in found["odometer", "speed_m_s"][1]
    assert "row 2" in found["odometer", "speed_m_s"][0]
    assert sum("time_s" in where for _, where, _ in defects) == 2  # backwards, and twice at one instant
    with pytest.raises(RunError):
        read_run(folder)


def test_missing_files_and_columns(folder):
    (folder / "odometer.csv").unlink()
    text = (folder / "gnss.csv").read_text()
    (folder / "gnss.csv").write_text(text.replace("latitude_deg", "breite").replace("longitude_deg", "laenge"))
    defects, _ = run_defects(folder)
    assert sorted({kind for kind, _, _ in defects}) == ["gnss", "odometer"]
    assert sum("required column is missing" in what for _, _, what in defects) == 2


def test_what_only_shows_at_the_end(folder):
    toml = folder / "run.toml"
    toml.write_text(toml.read_text().replace('frame = "WGS84"', 'frame = "nowhere"'))
    defects, _ = run_defects(folder)
    assert len(defects) == 1
    assert "gnss.frame" in defects[0][1]


def test_remarks_of_a_log(folder, tmp_path):
    log = tmp_path / "b" / "gnss.nmea"
    log.parent.mkdir()
    convert_log(folder, log)
    text = log.read_bytes().replace(b"GNGGA,120005", b"GNGGX,120005")
    log.write_bytes(text)
    (log.parent / "run.toml").write_text(
        f'[run]\nid = "b"\nstart = "{START.isoformat()}"\n[gnss]\nfile = "gnss.nmea"\nformat = "nmea"\n'
    )
    defects, remarks = run_defects(log.parent)
    assert defects == []
    assert "1 broken sentences left out (the first at row 12)" in [what for _, _, what in remarks]
