"""`railnav navigate --scheme`: every scheme on one run, solutions without tracks in every format, refusals in one line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from railnav.cli import main
from railnav.errors import InputError
from railnav.geodesy.ellipsoid import WGS84
from railnav.inertial.aided import Ranges
from railnav.io.ranges import read_ranges, write_ranges
from railnav.io.solution import read_solution
from railnav.io.truth import read_truth
from railnav.simulation.constellation import elevations, satellites


def run(*arguments, ok=True):
    done = CliRunner().invoke(main, [str(a) for a in arguments])
    assert (done.exit_code == 0) == ok, done.output
    return done.output


@pytest.fixture
def ranges(stock):
    """Pseudoranges of the train's truth, 1 Hz."""
    truth = read_truth(stock / "truth.csv")
    rng, rows = np.random.default_rng(0), []
    speed_north = np.gradient(truth.latitude, truth.time) * WGS84.meridian_radius(truth.latitude)
    speed_east = (
        np.gradient(truth.longitude, truth.time) * WGS84.transverse_radius(truth.latitude) * np.cos(truth.latitude)
    )
    from railnav.inertial.aided.single_point import north_east_down

    for t in np.arange(np.ceil(truth.time[0]), truth.time[-1], 1.0):
        place = [float(np.interp(t, truth.time, c)) for c in (truth.latitude, truth.longitude, truth.height)]
        s, v = satellites(30000.0 + t)
        x = np.array(WGS84.to_cartesian(*place)).ravel()
        moving = north_east_down(place[0], place[1]).T @ [
            np.interp(t, truth.time, speed_north),
            np.interp(t, truth.time, speed_east),
            0.0,
        ]
        for i in np.flatnonzero(elevations(s, *place) > 0.2):
            r = np.linalg.norm(x - s[i])
            rate = (x - s[i]) @ (moving - v[i]) / r
            rows.append([t, *s[i], *v[i], r + 40 + rng.normal(0, 1.0), rate + 0.5 + rng.normal(0, 0.05)])
    a = np.array(rows)
    path = stock / "ranges.csv"
    write_ranges(Ranges(a[:, 0], a[:, 1:4], a[:, 4:7], a[:, 7], a[:, 8], 1.0, 0.05), path)
    return path


def test_every_scheme_navigates_the_run(stock, ranges):
    for scheme, more in (
        ("track", ["-m", stock / "line.gpkg"]),
        ("map-corrector", ["-m", stock / "line.gpkg"]),
        ("loose", []),
        ("odometer", ["-m", stock / "line.gpkg"]),
        ("decentralised", []),
        ("tight", ["--ranges", ranges]),
    ):
        out = stock / f"{scheme}.csv"
        facts = json.loads(run("navigate", stock / "service", "--scheme", scheme, *more, "-o", out, "--json"))
        assert facts["placed"] > 0.5 * facts["epochs"], scheme
        told = json.loads(run("evaluate", out, stock / "truth.csv", "--json"))
        assert told["along"]["rms"] < 10.0, scheme
        if scheme in ("loose", "tight", "odometer", "decentralised"):
            assert facts["tracks"] == []
            assert facts["diagnostics"]["scheme"] == scheme


@pytest.mark.parametrize("ending", ["csv", "parquet", "gpkg", "geojson"])
def test_solutions_without_tracks_survive_every_format(stock, ending):
    out = stock / f"free.{ending}"
    run("navigate", stock / "service", "--scheme", "loose", "-o", out)
    back = read_solution(out)
    assert np.isfinite(back.latitude).sum() > 100
    assert np.all(back.track == -1)
    assert np.isfinite(back.sigma_along[np.isfinite(back.latitude)]).all()


def test_refusals_are_one_line(stock, ranges):
    for arguments, words in (
        (["-o", "x.csv"], "needs|none is given"),
        (["--scheme", "map-corrector", "-o", "x.csv"], "none is given"),
        (["--scheme", "tight", "-o", "x.csv"], "go together"),
        (["--scheme", "loose", "--ranges", ranges, "-o", "x.csv"], "go together"),
        (["--scheme", "decentralised", "--smooth", "-o", "x.csv"], "only looks back"),
        (["--scheme", "loose", "--explain", "why.csv", "-o", "x.csv"], "only --scheme track"),
        (["--scheme", "loose", "-o", "x.shp"], "shp"),
    ):
        text = run("navigate", stock / "service", *arguments, ok=False)
        assert text.count("\n") == 1, text
        assert any(word in text for word in words.split("|")), text


def test_tables_of_ranges(tmp_path, ranges):
    read = read_ranges(ranges)
    assert len(read.time) > 100
    assert read.sigma_range[0] == 1.0
    for change, words in (
        (lambda rows: [rows[0], rows[2], rows[1], *rows[40:]], ""),
        (lambda rows: [rows[0], rows[40], rows[1]], "backwards"),
        (lambda rows: [rows[0], "1,100,100,100,0,0,0,2e7,0,1,1"], "km from the Earth"),
        (lambda rows: ["time_s,pseudorange_m", "0,1"], "satellite_x_m"),
    ):
        path = tmp_path / "r.csv"
        path.write_text("\n".join(change(ranges.read_text().splitlines())) + "\n")
        if words:
            with pytest.raises(InputError, match=words):
                read_ranges(path)
        else:
            read_ranges(path)
