"""`railnav alignment` and `railnav draw` as a user runs them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from railnav.cli import main
from railnav.io.designs import read_designs, write_designs
from railnav.monitoring.design import design_of_elements
from railnav.track.model import TrackModel


def run(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, result.stdout, result.stderr


def test_a_model_becomes_a_design_that_passes_its_knots(stock: Path) -> None:
    code, out, _ = run(
        "alignment",
        stock / "line.gpkg",
        "-o",
        stock / "design.xml",
        "--track",
        "77R-02",
        "--json",
        "--report",
        stock / "d.html",
    )
    assert code == 0
    told = json.loads(out)
    (design,) = read_designs(stock / "design.xml")
    model = TrackModel.read(stock / "line.gpkg")
    own = model.knots("77R-02")
    foot = design.project(model.easting[own], model.northing[own])
    assert np.abs(foot.cross).max() < 0.02
    assert [e["element"] for e in told["tracks"][0]["elements"]] == list(design.kinds)
    page = (stock / "d.html").read_text(encoding="utf-8")
    assert "Track 77R-02" in page
    assert "http://" not in page.split("<script>")[0]


def test_designs_are_drawn(tmp_path: Path) -> None:
    design = design_of_elements("1", ["straight", "bloss", "arc"], [100.0, 80.0, 200.0], [0, 600.0, 600.0])
    write_designs([design], tmp_path / "d.csv")
    write_designs([design], tmp_path / "d.xml")
    for source, target in (("d.csv", "a.svg"), ("d.xml", "b.pdf"), ("d.xml", "c.html"), ("d.csv", "e.png")):
        code, out, err = run("draw", tmp_path / source, "-o", tmp_path / target)
        assert code == 0, err
        assert (tmp_path / target).stat().st_size > 2000
        assert "written" in out


def test_a_model_is_drawn_as_it_is_without_fitting(stock: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import railnav.monitoring.fitting as fitting

    def refused(*_: object, **__: object) -> None:
        raise AssertionError("fitted although nobody asked")

    monkeypatch.setattr(fitting, "fit_design", refused)
    code, out, err = run("draw", stock / "line.gpkg", "-o", stock / "own.html", "--no-elements", "--json")
    assert code == 0, err
    model = TrackModel.read(stock / "line.gpkg")
    assert [t["track"] for t in json.loads(out)["tracks"]] == list(model.track_id)
    assert all(t["elements"] == 0 for t in json.loads(out)["tracks"])
    page = (stock / "own.html").read_text(encoding="utf-8")
    assert "elements were not fitted" in page
    # asked for nothing, a model longer than the limit is drawn as it is
    monkeypatch.setattr("railnav.cli.draw.FITTED_UNASKED", 100.0)
    code, out, _ = run("draw", stock / "line.gpkg", "-o", stock / "own.svg", "--track", "77R-02")
    assert code == 0
    assert "--elements fits its elements first" in out
    assert (stock / "own.svg").stat().st_size > 2000


def test_a_drawn_track_is_the_models_own_geometry(stock: Path) -> None:
    from railnav.web.bands import drawn_track

    model = TrackModel.read(stock / "line.gpkg")
    one = drawn_track(model, "77R-02")
    own = model.knots("77R-02")
    along = np.append(0.0, np.cumsum(np.hypot(np.diff(model.easting[own]), np.diff(model.northing[own]))))
    here = one.inside(one.start + along)
    assert np.hypot(here.easting - model.easting[own], here.northing - model.northing[own]).max() < 1e-6
    assert here.curvature * np.mean(model.scale[own]) == pytest.approx(model.curvature[own], abs=1e-12)
    assert here.gradient == pytest.approx(model.gradient[own], abs=1e-12)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["alignment", "missing.gpkg", "-o", "d.xml"], "no such file or folder"),
        (["alignment", "line.gpkg", "-o", "d.txt"], "an output of this ending is not known"),
        (["alignment", "line.gpkg", "-o", "d.xml", "--track", "99"], "the model has no track '99'"),
        (["draw", "service", "-o", "d.html"], "is neither a design nor a model"),
        (["draw", "missing.xml", "-o", "d.html"], "no such file or folder"),
    ],
)
def test_bad_requests_are_one_line(stock: Path, arguments: list[str], said: str) -> None:
    placed = [str(stock / a) if Path(a).suffix or a == "service" else a for a in arguments]
    code, _, err = run(*placed)
    assert code == 1
    assert said in err
    assert len(err.strip().splitlines()) == 1


def test_several_tracks_do_not_go_on_one_picture(tmp_path: Path) -> None:
    designs = [design_of_elements(name, ["straight"], [100.0], [0.0]) for name in ("1", "2")]
    write_designs(designs, tmp_path / "d.csv")
    code, _, err = run("draw", tmp_path / "d.csv", "-o", tmp_path / "d.png")
    assert code == 1
    assert "2 tracks do not go on one picture" in err
    assert not (tmp_path / "d.png").exists()
