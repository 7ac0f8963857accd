"""`railnav monitor` and `railnav lining` as a user runs them: files out, figures in words, and one line for what is wrong."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from railnav.cli import main

sys.path.insert(0, str(Path(__file__).parents[1] / "monitoring"))
from recorded import TRACK, design_of, line, recorded

from railnav.io.designs import write_designs
from railnav.io.run import write_run


@pytest.fixture(scope="module")
def cars(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model and two recording cars on it, as files; not to be changed."""
    folder = tmp_path_factory.mktemp("cars")
    line().to_file(folder / "line.gpkg")
    write_run(recorded(1), folder / "car-1")
    write_run(recorded(2, month=4, growing=0.4), folder / "car-2")
    return folder


def run(*words: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(main, [str(word) for word in words], catch_exceptions=False)
    return result.exit_code, result.stdout, result.stderr


def test_monitor_writes_a_page_that_asks_nothing_of_the_network(cars, tmp_path):
    page, channels, found, quality = (tmp_path / name for name in ("g.html", "c.parquet", "e.csv", "q.csv"))
    code, out, _ = run(
        "monitor",
        cars / "car-1",
        cars / "car-2",
        "-m",
        cars / "line.gpkg",
        "-o",
        page,
        "--channels",
        channels,
        "--exceedances",
        found,
        "--quality",
        quality,
        "--against",
        "model",
    )
    assert code == 0
    assert TRACK in out
    html = page.read_text(encoding="utf-8")
    for words in (
        "Longitudinal level D1",
        "What these runs can bear",
        "Exceedances",
        "Trends",
        "recalled",
        "strips0",
        "Quality",
    ):
        assert words in html
    assert "connect-src &#x27;none&#x27;" in html
    with found.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {"gauge", "longitudinal_level_left_d1", "alignment_right_d1"} <= {row["channel"] for row in rows}
    assert "Alignment D1, each rail" in html
    assert channels.stat().st_size > 100_000
    with quality.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {"combined", "gauge_d1", "longitudinal_level_left_d1"} <= {row["channel"] for row in rows}
    assert {row["class"] for row in rows if row["channel"] == "longitudinal_level_left_d1"} <= set("ABCDE")
    assert all(float(row["deviation_mm"]) > 0.0 for row in rows)


def test_growth_a_month_is_told_written_and_counted(cars, tmp_path):
    """Longitudinal level was scaled by 1.4 between 2,300 and 2,600 m in the three months between the cars."""
    written = tmp_path / "trends.csv"
    words = ["monitor", cars / "car-1", cars / "car-2", "-m", cars / "line.gpkg", "-o", tmp_path / "g.html"]
    code, out, err = run(*words, "--trends", written, "--against", "model")
    assert code == 0, err
    assert "Growth of standard deviations, mm a month" in out
    assert "Exceedances of the latest run" in out
    with written.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["channel"] == "longitudinal_level_d1"]
    grows = [row for row in rows if row["significant"] == "1"]
    assert {float(row["offset_m"]) for row in grows} >= {2400.0}
    assert all(2050.0 < float(row["offset_m"]) < 2650.0 for row in grows)
    fastest = max(rows, key=lambda row: float(row["growth_mm_month"]))
    apart = float(fastest["last_mm"]) - float(fastest["first_mm"])
    assert float(fastest["growth_mm_month"]) * float(fastest["months"]) == pytest.approx(apart, abs=1e-3)
    code, out, err = run(*words, "--against", "model", "--json")
    assert code == 0, err
    told = json.loads(out)["sections"][0]["trends"]["longitudinal_level_d1"]
    assert told["significant"] == len(told["grows"]) == len(grows)
    assert told["months"][-1] == pytest.approx(2.96, abs=0.05)
    code, out, err = run(*words[:2], *words[3:], "--trends", written)
    assert code == 0, err
    assert written.read_text(encoding="utf-8").count("\n") == 1  # one date: the header alone


def test_monitor_in_json(cars, tmp_path):
    code, out, _ = run(
        "monitor",
        cars / "car-1",
        "-m",
        cars / "line.gpkg",
        "-o",
        tmp_path / "g.html",
        "--json",
        "--speed",
        100,
        "--against",
        "model",
    )
    assert code == 0
    facts = json.loads(out)
    assert facts["sections"][0]["speed_kmh"] == pytest.approx(100)
    channels = facts["sections"][0]["runs"][0]["channels"]
    assert channels["gauge"]["judged"]
    assert facts["limits_recalled"] > 0
    assert {e["channel"] for e in facts["sections"][0]["exceedances"]} >= {"gauge"}


def test_versines_on_chords_are_given_or_refused(cars, tmp_path):
    words = ["monitor", cars / "car-1", "-m", cars / "line.gpkg", "-o", tmp_path / "g.html"]
    code, out, err = run(*words, "--json", "--chord", "20", "--chord", "4+6", "--chord", "4.1+17.4")
    assert code == 0, err
    part = json.loads(out)["sections"][0]["runs"][0]
    assert {"versine_10+10m", "versine_4+6m"} <= set(part["channels"])
    assert "no whole numbers of steps of 0.25 m" in part["refused"]["versine_4.1+17.4m"]
    code, _, err = run(*words, "--chord", "long")
    assert code == 2
    assert "'long' is no chord" in err


def test_recalled_limits_are_left_out_on_request(cars, tmp_path):
    words = [
        "monitor",
        cars / "car-1",
        "-m",
        cars / "line.gpkg",
        "-o",
        tmp_path / "g.html",
        "--against",
        "model",
        "--json",
    ]
    code, out, err = run(*words, "--sourced")
    assert code == 0, err
    facts = json.loads(out)
    assert facts["limits_recalled"] == 0
    part = facts["sections"][0]
    assert {e["status"] for e in part["exceedances"]} == {"read"}
    assert part["runs"][0]["channels"]["gauge"]["judged"]
    assert part["runs"][0]["channels"]["alignment_left_d1"]["reason"] == "the table has no limit for it"
    assert "are recalled" not in (tmp_path / "g.html").read_text(encoding="utf-8")


def test_default_limits_are_printed_and_read_back(cars, tmp_path):
    code, out, _ = run("monitor", "--default-limits")
    assert code == 0
    table = tmp_path / "limits.toml"
    table.write_text(out.replace("alert = [-7, 15]", "alert = [-7, 28]"), encoding="utf-8")
    code, out, _ = run(
        "monitor", cars / "car-1", "-m", cars / "line.gpkg", "-o", tmp_path / "g.html", "--limits", table, "--json"
    )
    assert code == 0
    assert not [
        e for e in json.loads(out)["sections"][0]["exceedances"] if e["channel"] == "gauge" and e["value_mm"] > 0
    ]


def test_lining_writes_a_plan_and_a_page(cars, tmp_path):
    from dataclasses import replace

    # a model that does not say it is simulated: the page must know it from the runs
    replace(line(), provenance={}).to_file(tmp_path / "line.gpkg")
    plan, page = tmp_path / "plan.csv", tmp_path / "plan.html"
    code, out, _ = run(
        "lining", cars / "car-1", cars / "car-2", "-m", tmp_path / "line.gpkg", "-o", plan, "--report", page
    )
    assert code == 0
    assert "smoothed" in out
    with plan.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["slew_mm"]) == float(rows[-1]["slew_mm"]) == 0.0
    assert min(float(row["lift_mm"]) for row in rows) >= 0.0
    assert max(abs(float(row["slew_mm"])) for row in rows) <= 100.0
    html = page.read_text(encoding="utf-8")
    for words in ("Slew to the right, mm", "Before and after", "Alignment D2, mm", "Longitudinal level D1, mm"):
        assert words in html
    assert "Simulated data" in html


@pytest.mark.parametrize("verb", ["monitor", "lining"])
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--tracks", "77L-03"], "no run covers any of section 77L-03"),
        (["--tracks", "nowhere"], "no track 'nowhere'"),
        (["--tracks", "77R-01,77L-01"], "no permitted movements"),
    ],
)
def test_a_section_that_the_run_does_not_cover_is_one_line(cars, tmp_path, verb, words, said):
    output = tmp_path / ("out.html" if verb == "monitor" else "out.csv")
    code, _, err = run(verb, cars / "car-1", "-m", cars / "line.gpkg", "-o", output, *words)
    assert code == 1
    assert said in err
    assert err.count("\n") == 1
    assert not output.exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["monitor", "RUN", "-m", "MODEL", "-o", "x.pdf"], "use .html"),
        (["monitor", "RUN", "-m", "MODEL", "-o", "x.html", "--limits", "none.toml"], "none.toml: no such file"),
        (["monitor", "RUN", "-m", "MODEL", "-o", "x.html", "--channels", "x.txt"], "use .csv or .parquet"),
        (["monitor", "none", "-m", "MODEL", "-o", "x.html"], "none"),
        (["monitor", "RUN", "-m", "none.gpkg", "-o", "x.html"], "none.gpkg"),
        (["lining", "RUN", "-m", "MODEL", "-o", "x.html"], "use .csv or .parquet"),
        (["lining", "RUN", "-m", "MODEL", "-o", "x.csv", "--design", "none.xml"], "none.xml"),
        (["lining", "RUN", "-m", "MODEL", "-o", "x.csv", "--fixed", "none.csv"], "none.csv"),
    ],
)
def test_files_that_are_not_there_or_of_no_known_kind_are_one_line(cars, tmp_path, words, said, monkeypatch):
    monkeypatch.chdir(tmp_path)
    known = {"RUN": cars / "car-1", "MODEL": cars / "line.gpkg"}
    code, _, err = run(*(known.get(word, word) for word in words))
    assert code == 1
    assert said in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_two_simulated_recording_cars_see_the_same_irregular_track(cars, tmp_path):
    """Same track seed, other sensors' seed and date: channels agree to their noise, and growth has a date to count from."""
    import numpy as np

    words = ["simulate", "-m", cars / "line.gpkg", "--grade", "geometry", "--route", "77R-02"]
    for name, more in (("a", ["--start", "2026-01-10"]), ("b", ["--start", "2026-07-10", "--seed", 5])):
        code, out, err = run(*words, "-o", tmp_path / name, *more, "--json")
        assert code == 0, err
        assert json.loads(out)["irregular"] == 1.0
    code, out, err = run(
        "monitor",
        tmp_path / "a",
        tmp_path / "b",
        "-m",
        cars / "line.gpkg",
        "-o",
        tmp_path / "g.html",
        "--channels",
        tmp_path / "c.csv",
    )
    assert code == 0, err
    with (tmp_path / "c.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    level = {
        name: {float(r["distance_m"]): float(r["gauge_mm"]) for r in rows if r["run"] == name and r["gauge_mm"]}
        for name in "ab"
    }
    both = sorted(set(level["a"]) & set(level["b"]))
    assert np.corrcoef([level["a"][d] for d in both], [level["b"][d] for d in both])[0, 1] > 0.97
    for wrong, said in ((["--imu", "STIM300"], "leave --imu out"), (["--start", "soon"], "'soon' does not match")):
        code, _, err = run(*words, "-o", tmp_path / "c", *wrong)
        assert code == 2
        assert said in err
    code, out, err = run(
        "simulate", "-m", cars / "line.gpkg", "-o", tmp_path / "d", "--route", "77R-02", "--irregular", "2", "--json"
    )
    assert code == 0, err
    assert json.loads(out)["irregular"] == 2.0


def test_contradictory_fixed_points_are_named_on_one_line(cars, tmp_path):
    fixed = tmp_path / "fixed.csv"
    fixed.write_text(
        f"track,offset_m,slew_mm,slew_tolerance_mm,name\n"
        f"{TRACK},1000,0,5,bridge A\n{TRACK},1005,60,1,bridge B\n{TRACK},2000,0,5,platform\n",
        encoding="utf-8",
    )
    code, _, err = run(
        "lining", cars / "car-1", "-m", cars / "line.gpkg", "-o", tmp_path / "plan.csv", "--fixed", fixed
    )
    assert code == 1
    assert "'bridge A' at 1000.0 m" in err
    assert "'bridge B' at 1005.0 m" in err
    assert "platform" not in err
    assert not (tmp_path / "plan.csv").exists()


def test_a_design_that_misses_the_axis_by_metres_is_one_line_with_the_place(cars, tmp_path):
    write_designs([design_of(line(), 3.5, 900.0)], tmp_path / "design.xml")
    words = [
        "lining",
        cars / "car-1",
        "-m",
        cars / "line.gpkg",
        "-o",
        tmp_path / "plan.csv",
        "--design",
        tmp_path / "design.xml",
    ]
    code, _, err = run(*words)
    assert code == 1
    assert err.count("\n") == 1
    assert "design 'design' misses the measured axis by 3." in err
    assert f"on track '{TRACK}' at " in err
    assert not (tmp_path / "plan.csv").exists()


def test_of_several_designs_the_one_meant_is_named(cars, tmp_path):
    from dataclasses import replace

    ours, older = design_of(line(), 0.0, 700.0), replace(design_of(line(), 0.15, 700.0), track="older")
    write_designs([ours, older], tmp_path / "designs.csv")
    words = [
        "lining",
        cars / "car-1",
        "-m",
        cars / "line.gpkg",
        "-o",
        tmp_path / "plan.csv",
        "--design",
        tmp_path / "designs.csv",
    ]
    code, _, err = run(*words)
    assert code == 1
    assert err.count("\n") == 1
    assert "all lie along section" in err
    code, out, err = run(*words, "--alignment", "design", "--json")
    assert code == 0, err
    facts = json.loads(out)
    assert facts["design"] == "design"
    assert facts["versine_method"]["spread_mm"]
    code, _, err = run(*words, "--alignment", "newer")
    assert (code, err.count("\n")) == (1, 1)
    assert "there is no design 'newer'; there are 'design', 'older'" in err


def test_gauge_outliers_are_counted_and_a_broken_gauge_stream_is_not_used(cars, tmp_path):
    from dataclasses import replace

    import numpy as np

    car = recorded(1)
    wild = car.gauge.gauge.copy()
    wild[5000:5030] = 1.9
    write_run(replace(car, id="wild", gauge=replace(car.gauge, gauge=wild)), tmp_path / "wild")
    code, out, err = run("monitor", tmp_path / "wild", "-m", cars / "line.gpkg", "-o", tmp_path / "g.html", "--json")
    assert code == 0, err
    part = json.loads(out)["sections"][0]["runs"][0]
    assert any("gauge: 30 samples outside 1395 to 1515 mm" in note for note in part["notes"])
    assert part["channels"]["gauge"]["judged"]
    noise = np.random.default_rng(1).uniform(1.2, 1.9, len(wild))
    write_run(replace(car, id="broken", gauge=replace(car.gauge, gauge=noise)), tmp_path / "broken")
    code, out, err = run("monitor", tmp_path / "broken", "-m", cars / "line.gpkg", "-o", tmp_path / "g.html", "--json")
    assert code == 0, err
    part = json.loads(out)["sections"][0]["runs"][0]
    assert "of the gauge samples lie outside" in part["refused"]["gauge"]
    assert "of the gauge samples lie outside" in part["refused"]["alignment_left_d1"]
    assert "alignment_d1" in part["channels"]


def test_a_run_that_covers_a_part_of_the_section_is_said(cars, tmp_path):
    section = ["--tracks", f"{TRACK}"]
    code, _, err = run("monitor", cars / "car-1", "-m", cars / "line.gpkg", "-o", tmp_path / "g.html", *section)
    assert code == 0
    assert "covers 3000 m" in err
    assert f"of the {line().length(TRACK):.0f} m asked for" in err
    code, _, err = run("lining", cars / "car-1", "-m", cars / "line.gpkg", "-o", tmp_path / "p.csv", *section)
    assert code == 0
    assert "beyond, nothing was measured or asked for" in err


def test_a_stretch_is_named_by_metres_or_kilometres(cars, tmp_path):
    words = ["lining", cars / "car-1", "-m", cars / "line.gpkg", "-o", tmp_path / "plan.csv", "--json"]
    code, out, err = run(*words, "--between", "800-1400")
    assert code == 0, err
    assert json.loads(out)["length_m"] == pytest.approx(600.0)
    first = float(line().at(TRACK, 1000.0).chainage) / 1e3
    code, out, err = run(*words, "--km", f"{first}-{first + 0.5}")
    assert code == 0, err
    assert json.loads(out)["length_m"] == pytest.approx(500.0, abs=6.0)
    for more, code_, said in (
        (["--km", "5-6"], 1, "5 to 6 km does not lie on section"),
        (["--between", "800"], 2, "'800' is not FROM-TO"),
        (["--between", "1-2", "--km", "1-2"], 2, "both name the stretch"),
    ):
        code, _, err = run(*words, *more)
        assert code == code_
        assert said in err


def test_usage_that_cannot_be_meant(cars, tmp_path):
    code, _, err = run(
        "lining",
        cars / "car-1",
        "-m",
        cars / "line.gpkg",
        "-o",
        tmp_path / "p.csv",
        "--least-lift",
        20,
        "--most-lift",
        10,
    )
    assert code == 2
    assert "--least-lift 20 is above --most-lift 10" in err
    same = tmp_path / "same.csv"
    code, _, err = run(
        "monitor",
        cars / "car-1",
        "-m",
        cars / "line.gpkg",
        "-o",
        tmp_path / "g.html",
        "--channels",
        same,
        "--exceedances",
        same,
    )
    assert code == 2


@pytest.mark.slow
def test_a_real_line_with_gnss_alone_is_told_what_its_accuracy_allows(shared_data, tmp_path):
    """The built model of two runs of line80, and a third run on it: long waves only, and the page says so."""
    folder = shared_data / "line80"
    code, _, err = run(
        "build", folder / "2022-01-22_SU-FA_iphone", folder / "2022-01-23_FA-SU_iphone", "-o", tmp_path / "line.gpkg"
    )
    assert code == 0, err
    code, out, err = run(
        "monitor", folder / "2022-01-08_FA-SU_ublox", "-m", tmp_path / "line.gpkg", "-o", tmp_path / "g.html", "--json"
    )
    assert code == 0, err
    facts = json.loads(out)
    for part in facts["sections"]:
        for one in part["runs"]:
            assert not any(channel["judged"] for channel in one["channels"].values())
            assert "GNSS positions would leave" in one["refused"]["alignment_d3"]
    assert "No channel could be held against a limit" in (tmp_path / "g.html").read_text(encoding="utf-8")
    plan = ["lining", folder / "2022-01-08_FA-SU_ublox", "-m", tmp_path / "line.gpkg", "-o", tmp_path / "plan.csv"]
    code, _, err = run(*plan, "--most-slew", 100, "--curvature-rate", 5e-6)
    assert code == 1
    assert err.count("\n") == 1
    assert "the axis is only known to" in err
    assert "show the method on such data" in err
    code, out, err = run(*plan, "--json")
    assert code == 0, err
    facts = json.loads(out)
    assert not facts["usable"]
    assert not any(band["borne"] for band in facts["bears"].values())
    assert any("allows corrections in none of the bands" in note for note in facts["notes"])
    assert any("not for a machine" in note and "only show the method" in note for note in facts["notes"])


@pytest.mark.slow
@pytest.mark.parametrize("which", ["sbb", "mannheim"])
def test_a_recording_car_on_real_axes_is_monitored_and_lined(shared_data, tmp_path, which):
    """Simulated runs on the axes of SBB (with their own design, heights and cant) and of Mannheim (without heights)."""
    source, crs, route, name = {
        "sbb": (shared_data / "sbb" / "zuerich-winterthur.landxml.xml", "EPSG:2056", "A50068A.1", "A50068A"),
        "mannheim": (shared_data / "mannheim" / "mannheim_tracks.csv", "EPSG:31467", "1-S-13-200.1,1-S-13-200.8", ""),
    }[which]
    model, car = tmp_path / "line.gpkg", tmp_path / "car"
    assert run("import", source, "--crs", crs, "-o", model)[0] == 0
    code, _, err = run("simulate", "-m", model, "-o", car, "--grade", "geometry", "--route", route, "--top-speed", 60)
    assert code == 0, err
    code, out, err = run("monitor", car, "-m", model, "-o", tmp_path / "g.html", "--json")
    assert code == 0, err
    channels = json.loads(out)["sections"][0]["runs"][0]["channels"]
    assert all(channels[key]["judged"] for key in ("gauge", "longitudinal_level_left_d1", "alignment_right_d1"))
    more = ["--design", source, "--design-crs", crs] if name else []
    code, out, err = run("lining", car, "-m", model, "-o", tmp_path / "plan.csv", "--json", *more)
    assert code == 0, err
    facts = json.loads(out)
    assert facts["usable"]
    assert (facts["design"] or "") == name
    assert facts["spread_mm"]["alignment D2"][1] < 0.3 * facts["spread_mm"]["alignment D2"][0]
    assert facts["limits"]["most_slew_mm"] == pytest.approx(100.0)
    assert facts["versine_method"]["greatest_slew_mm"] < 3.0 * facts["greatest_slew_mm"]
    assert all(band["borne"] for band in facts["bears"].values())
