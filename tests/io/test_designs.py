"""Designs as LandXML and as tables: there and back, and refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from railnav.errors import InputError
from railnav.io.designs import profile_of_points, read_designs, vertical_points, write_designs
from railnav.monitoring.design import Design, design_of_elements
from railnav.track.elements import CLOTHOID, Cant


def sample() -> Design:
    profile = profile_of_points(
        np.array([0.0, 120.0, 300.0, 440.0]),
        np.array([50.0, 51.0, 48.0, 48.0]),
        np.array([0, 60.0, 0, 0]),
        np.array([0, 0, 3000.0, 0]),
    )
    cant = Cant(
        np.array([0.0, 100.0, 180.0, 380.0, 440.0]),
        np.array([0, 0, -0.08, -0.08]),
        np.array([0, -0.08, -0.08, 0]),
        np.full(4, CLOTHOID),
    )
    return design_of_elements(
        "1-up",
        ["straight", "helmert", "arc", "clothoid"],
        [100.0, 80.0, 200.0, 60.0],
        [0, -600.0, -600.0, 0],
        easting=2_683_141.0,
        northing=1_248_117.0,
        grid_bearing=5.0,
        start=-153.1,
        profile=profile,
        cant=cant,
        crs="EPSG:2056",
    )


@pytest.mark.parametrize("ending", ["xml", "csv"])
def test_designs_come_back(tmp_path: Path, ending: str) -> None:
    design = sample()
    written = write_designs([design], tmp_path / f"d.{ending}")
    assert all(path.is_file() for path in written)
    (again,) = read_designs(tmp_path / f"d.{ending}")
    assert again.kinds == design.kinds
    assert again.start == pytest.approx(-153.1)
    s = np.linspace(design.start, design.start + 440.0, 200)
    a, b = design.at(s), again.at(np.minimum(s, again.start + again.length))
    assert np.abs(a.easting - b.easting).max() < 1e-6
    assert np.abs(a.height - b.height).max() < 1e-6
    assert np.abs(a.cant - b.cant).max() < 1e-7
    assert np.abs(a.curvature - b.curvature)[1:].max() < 1e-8


def test_points_of_vertical_intersection_come_back() -> None:
    points = vertical_points(sample())
    assert points[:, 0] == pytest.approx([0.0, 120.0, 300.0, 440.0], abs=1e-6)
    assert points[:, 1] == pytest.approx([50.0, 51.0, 48.0, 48.0], abs=1e-6)
    assert points[:, 2] == pytest.approx([0, 60.0, 0, 0], abs=1e-9)
    assert points[2, 3] == pytest.approx(3000.0)


@pytest.mark.parametrize("ending", ["csv", "xml"])
def test_cubic_parabolas_come_back(tmp_path: Path, ending: str) -> None:
    design = design_of_elements("1", ["straight", "cubic-parabola", "arc"], [50.0, 60.0, 50.0], [0, 300.0, 300.0])
    write_designs([design], tmp_path / f"d.{ending}")
    (again,) = read_designs(tmp_path / f"d.{ending}")
    assert again.kinds == design.kinds
    assert again.at(160.0).easting == pytest.approx(float(design.at(160.0).easting), abs=1e-6)


def test_a_stale_table_beside_is_not_taken_for_this_design(tmp_path: Path) -> None:
    write_designs([sample()], tmp_path / "d.csv")
    with pytest.raises(InputError, match=r"has no profile, but d_profile\.csv stands beside it"):
        write_designs([design_of_elements("1", ["straight"], [50.0], [0.0])], tmp_path / "d.csv")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("helmert", "spline", "'spline' is no known element"),
        (",-600,", ",-2,", "a radius of -2 m"),
        (",80,", ",90,", "from the start of the next one of track '1-up'"),
    ],
)
def test_damaged_tables_are_refused_with_the_row(tmp_path: Path, old: str, new: str, said: str) -> None:
    write_designs([sample()], tmp_path / "d.csv")
    text = (tmp_path / "d.csv").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "d.csv").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=said.replace("(", r"\(")) as caught:
        read_designs(tmp_path / "d.csv")
    assert "row 3" in str(caught.value) or "row 4" in str(caught.value)


def test_real_alignments_come_back(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "sbb" / "zuerich-winterthur.landxml.xml"
    if not source.is_file():
        pytest.skip("no SBB alignments")
    designs = read_designs(source, crs="EPSG:2056")
    assert len(designs) == 11
    write_designs(designs, tmp_path / "d.xml")
    for a, b in zip(designs, read_designs(tmp_path / "d.xml"), strict=True):
        s = np.linspace(a.start, a.start + min(a.length, b.length), 500)
        assert np.abs(a.at(s).easting - b.at(s).easting).max() < 1e-6
