"""run.toml's frame and epoch: positions of any frame and year come to one datum."""

from __future__ import annotations

import numpy as np
import pytest

import railnav
from railnav.errors import RunError
from railnav.geodesy import WGS84
from railnav.geodesy.plates import plate_motion
from railnav.io.run import read_run, write_run

BERLIN = np.radians([52.52, 13.4])


def write(folder, lines, *, start="2026-07-02T12:00:00Z", place=BERLIN):
    folder.mkdir()
    (folder / "run.toml").write_text(f'[run]\nid = "r"\nstart = "{start}"\n\n[gnss]\nfile = "gnss.csv"\n{lines}\n')
    latitude, longitude = np.degrees(place).tolist()
    rows = [f"{t},{latitude!r},{longitude + t * 1e-5!r},80.0" for t in range(3)]
    (folder / "gnss.csv").write_text("time_s,latitude_deg,longitude_deg,height_m\n" + "\n".join(rows) + "\n")
    return folder


def cartesian(run):
    gnss = run.gnss
    return np.column_stack(WGS84.to_cartesian(gnss.latitude, gnss.longitude, gnss.height))


def test_the_start_is_the_epoch_unless_one_is_given(tmp_path):
    plain = read_run(write(tmp_path / "a", ""))
    moved = read_run(write(tmp_path / "b", 'frame = "ITRF2020"\nfixed_to = "ETRS89"'))
    given = read_run(write(tmp_path / "c", 'frame = "ITRF2020"\nfixed_to = "ETRS89"\nepoch = 2026.5'))
    dated = read_run(write(tmp_path / "d", 'frame = "WGS84"\nfixed_to = "ETRS89"\nepoch = "2026-07-02"'))
    shift = np.linalg.norm(cartesian(moved) - cartesian(plain), axis=1)
    np.testing.assert_allclose(shift, 0.95, atol=0.03)  # spec 1.5, 6: ITRF2020 at 2026 to ETRF, Berlin
    np.testing.assert_allclose(cartesian(moved), cartesian(given), atol=2e-4)
    np.testing.assert_allclose(cartesian(moved), cartesian(dated), atol=2e-4)
    assert (given.gnss.epoch, given.gnss.fixed_to, plain.gnss.epoch) == (2026.5, "ETRS89", None)


def test_what_is_carried_is_written_so_and_not_carried_again(tmp_path):
    first = read_run(write(tmp_path / "a", 'frame = "ITRF2020"\nepoch = 2026.25\nfixed_to = "GSK-2011"'))
    write_run(first, tmp_path / "b")
    again = read_run(tmp_path / "b")
    assert (again.gnss.fixed_to, again.gnss.epoch) == ("GSK-2011", 2026.25)
    np.testing.assert_allclose(cartesian(again), cartesian(first), atol=2e-5)
    toml = tmp_path / "b" / "run.toml"
    toml.write_text(toml.read_text().replace('frame = "WGS84"', 'frame = "ITRF2020"'))
    with pytest.raises(RunError, match="carried"):
        read_run(tmp_path / "b")


def test_one_model_has_one_datum(tmp_path):
    """Runs carried to ETRS89 and to GSK-2011 lie decimetres apart: a build of both is refused."""
    runs = [
        read_run(write(tmp_path / name, f'frame = "ITRF2020"\nfixed_to = "{datum}"'))
        for name, datum in (("a", "ETRS89"), ("b", "GSK-2011"))
    ]
    parted = np.linalg.norm(cartesian(runs[0]) - cartesian(runs[1]), axis=1)
    assert parted.min() > 0.3
    with pytest.raises(RunError, match=r"fixed to several datums: ETRS89 \(r\), GSK-2011 \(r\)"):
        railnav.build(runs)


def test_info_says_so(tmp_path):
    from click.testing import CliRunner

    from railnav.cli import main

    folder = write(tmp_path / "a", 'frame = "ITRF2020"\nepoch = 2026.25\nfixed_to = "ETRS89"')
    assert "ITRF2020 at 2026.25, carried to ETRS89" in CliRunner().invoke(main, ["info", str(folder)]).output


def test_two_years_of_one_place_agree(tmp_path):
    x = np.stack(WGS84.to_cartesian(*BERLIN, 80.0))
    later = np.array(WGS84.to_geodetic(*plate_motion("EURA", 10.0).apply(x)))
    first = read_run(write(tmp_path / "a", 'frame = "ITRF2014"\nepoch = 2016.0\nfixed_to = "ETRS89"'))
    second = read_run(write(tmp_path / "b", 'frame = "ITRF2014"\nepoch = 2026.0\nfixed_to = "ETRS89"', place=later[:2]))
    parted = np.linalg.norm(cartesian(second) - cartesian(first), axis=1)
    assert (
        parted.max() < 0.02
    )  # 0.25 m untreated; what is left is ETRF2000's own rotation, 0.6 mm a year from the plate's
    assert float(np.linalg.norm(plate_motion("EURA", 10.0).apply(x) - x)) > 0.2


def test_written_runs_read_back(tmp_path):
    for name, lines in {
        "a": 'frame = "PZ-90.11"\nepoch = 2020.25',
        "b": 'frame = "ITRF2020"\nfixed_to = "ETRS89"',
    }.items():
        run = read_run(write(tmp_path / name, lines))
        write_run(run, tmp_path / f"{name}-again")
        again = read_run(tmp_path / f"{name}-again")
        np.testing.assert_allclose(cartesian(again), cartesian(run), atol=2e-3)
        assert again.gnss.epoch == (2020.25 if name == "a" else None)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('epoch = "yesterday"', "is no epoch"),
        ("epoch = 20260702", "is no epoch"),
        ("epoch = true", "is no epoch"),
        ('fixed_to = "Tokyo"', "no datum 'Tokyo'"),
        ('frame = "ITRF2020"\nfixed_to = "GSK-2011"\nplate = "EURO"', "no plate"),
    ],
)
def test_refusals(tmp_path, lines, words):
    with pytest.raises(RunError, match=words):
        read_run(write(tmp_path / "a", lines))


def test_a_model_keeps_its_datum_and_takes_runs_of_no_other():
    from dataclasses import replace

    from railnav.simulation import SURVEY, Leg, demo_line, simulate

    line, leg = demo_line(spacing=10.0), Leg(("77R-03",), start=0.0, finish=1200.0)
    outfit = replace(SURVEY, angles=None, gauge=None)
    runs = [simulate(line, leg, seed=k, outfit=outfit, run_id=f"s{k}", direction="up")[0] for k in range(3)]

    def fixed(run, datum):
        return replace(run, gnss=replace(run.gnss, fixed_to=datum))

    model = railnav.build([fixed(run, "ETRS89") for run in runs[:2]], spacing=5.0)
    assert model.provenance["fixed_to"] == "ETRS89"
    assert not any("fixed" in text for text in model.provenance["build"]["warnings"])
    for datum, words in (
        ("", "is fixed to no datum, the model to ETRS89"),
        ("GSK-2011", "is fixed to GSK-2011, the model to ETRS89"),
    ):
        with pytest.raises(RunError, match=words):
            railnav.update(model, [fixed(runs[2], datum)])
    assert railnav.update(model, [fixed(runs[2], "ETRS89")]).provenance["fixed_to"] == "ETRS89"
    mixed = railnav.build([fixed(runs[0], "ETRS89"), runs[1]], spacing=5.0)
    assert any("fixed to ETRS89, but s1 is not" in text for text in mixed.provenance["build"]["warnings"])
