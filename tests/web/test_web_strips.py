"""Strip charts: values that travel along packed, places that link charts, map and table, gaps that stay gaps, kilometres that jump."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

sys.path.insert(0, str(Path(__file__).parents[1] / "monitoring"))
from recorded import TRACK, line, recorded

from railnav.io.limits import default_limits
from railnav.monitoring.monitor import Report, monitor
from railnav.monitoring.section import section_of
from railnav.track.model import MilePosts
from railnav.web.geometry import geometry_page
from railnav.web.strips import Curve, Strip, axis_of, jumps_in_words, jumps_of, pack, resolution_of, stack, unpack


@pytest.fixture(scope="module")
def report() -> Report:
    return monitor([recorded(1), recorded(2, month=4)], line(), default_limits(), against_model=True)


@pytest.fixture(scope="module")
def html(report: Report) -> str:
    return geometry_page(report)


def figures_of(html: str) -> dict[str, dict]:
    text = re.search(r'<script type="application/json" id="figures">(.*?)</script>', html, re.S)
    assert text is not None
    return {figure["id"]: figure for figure in json.loads(text.group(1))}


@settings(max_examples=60)
@given(
    arrays(np.float64, st.integers(1, 200), elements=st.floats(-1e4, 1e4) | st.just(np.nan)),
    st.sampled_from([1e-3, 0.05, 1.0]),
)
def test_packed_values_come_back_to_their_resolution(values, resolution):
    made = pack(values, resolution)
    back = unpack(made["data"], made["scale"])
    assert (np.isnan(back) == np.isnan(values)).all()
    known = np.isfinite(values)
    assert (np.abs(back - values)[known] <= 0.5 * made["scale"] * (1 + 1e-6) + 1e-12).all()
    assert made["scale"] == pytest.approx(max(resolution, np.abs(values[known]).max(initial=0.0) / 32000.0))


def test_a_page_carries_every_value_of_every_drawn_curve(report, html):
    figure = figures_of(html)["strips0"]
    fine = figure["fine"]
    part = report.sections[0]
    latest = max(part.geometries, key=lambda g: g.recording.run.start)
    names = [annotation["text"] for annotation in figure["layout"]["annotations"]]
    rows = {name.rsplit(", ", 1)[0]: i for i, name in enumerate(names)}
    for key in ("longitudinal_level_left_d1", "alignment_d2", "twist_3m"):
        channel = latest.channels[key]
        axis = "y" if rows[channel.title] == 0 else f"y{rows[channel.title] + 1}"
        index = max(i for i, t in enumerate(figure["data"]) if t["yaxis"] == axis and t["mode"] == "lines")
        back = unpack(fine["traces"][str(index)]["data"], fine["traces"][str(index)]["scale"])
        assert len(back) == fine["count"] == len(channel.values)
        error = np.abs(back - 1e3 * channel.values)
        assert np.nanmax(error) < 0.3e3 * channel.sigma
    assert "DecompressionStream" in html


def test_short_waves_are_drawn_by_rail_and_long_ones_by_axis(html):
    names = " ".join(a["text"] for a in figures_of(html)["strips0"]["layout"]["annotations"])
    for there in (
        "Longitudinal level D1, left rail",
        "Alignment D1, right rail",
        "Longitudinal level D2,",
        "Alignment D3,",
    ):
        assert there in names
    for absent in ("Longitudinal level D1, mm", "Alignment D2, left rail"):
        assert absent not in names
    assert "Standard deviation over 200 m: Combined (black)" in names


def test_rows_and_diamonds_lead_to_the_place_of_their_exceedance(report, html):
    part = report.sections[0]
    latest = max(part.geometries, key=lambda g: g.recording.run.start).recording.run.id
    mine = sorted(e.peak for e in part.exceedances if e.run == latest)
    x, _ = axis_of(part.section, part.geometries[0].distance)
    expected = np.interp(mine, part.geometries[0].distance, x)
    led = sorted(float(v) for v in re.findall(r'<tr class="go" data-figure="strips0" data-x="([^"]+)">', html))
    assert led == pytest.approx(expected, abs=1e-4)
    plan = figures_of(html)["plan"]
    marks = sorted(at[1] for trace in plan["data"] for at in trace.get("customdata", []))
    assert marks == pytest.approx(expected, abs=1e-4)
    assert set(plan["marker"]["places"]) == {"strips0"}
    assert plan["data"][plan["marker"]["view"]]["name"] == "in view"
    assert plan["data"][plan["marker"]["trace"]]["name"] == "place"


def test_every_section_moves_the_map():
    """Two ways that do not meet make two sections: each chart has its own places on the map."""
    from railnav.simulation import SURVEY, Leg, simulate

    runs = [
        simulate(line(), Leg((track,), start=100.0, finish=1500.0), seed=3, outfit=SURVEY, tunnels=False, run_id=track)[
            0
        ]
        for track in ("77R-03", "77L-03")
    ]
    figures = figures_of(geometry_page(monitor(runs, line(), default_limits())))
    places = figures["plan"]["marker"]["places"]
    assert set(places) == {"strips0", "strips1"}
    for identity, along in places.items():
        assert figures[identity]["moves"]
        assert len(along["time"]) == len(along["x"]) == len(along["y"]) > 100


def test_gaps_stay_gaps_however_thin_a_curve_is_drawn():
    section = section_of(line(), [TRACK])
    d = section.grid(0.25)
    y = np.sin(d / 3.0)
    holes = [(5001, 5040), (20000, 20400), (30001, 30003)]
    for a, b in holes:
        y[a:b] = np.nan
    x, _ = axis_of(section, d)
    trace = stack([Strip("s", [Curve("c", x, y, "#000", fine=0.1)])], identity="i", section=section, distance=d).data[0]
    at, values = np.asarray(trace["x"]), np.asarray(trace["y"])
    for a, b in holes:
        inside = (at > x[a - 1]) & (at < x[b])
        assert inside.any()
        assert np.isnan(values[inside]).all()


def test_a_chart_along_kilometres_that_jump_runs_by_distance_and_marks_the_jumps():
    which = line().track_index(TRACK)
    posts = MilePosts(
        np.full(4, which), np.array([0.0, 2000.0, 2000.01, 9000.0]), np.array([50_000.0, 52_000.0, 51_500.0, 58_499.99])
    )
    section = section_of(replace(line(), mileposts=posts), [TRACK])
    d = section.grid(0.25)
    assert axis_of(section, d)[1] == f"km along {TRACK}"
    (jump,) = jumps_of(section, d)
    assert jump[0] == pytest.approx(2000.25, abs=0.3)
    assert jump[1] - jump[2] == pytest.approx(500.0, abs=1.0)
    layout = stack([Strip("s", [Curve("c", d / 1e3, d, "#000")])], identity="i", section=section, distance=d).layout
    assert any(a["text"].startswith("km 52.000 | 51.500") for a in layout["annotations"])
    assert jumps_of(section_of(line(), [TRACK]), d) == []
    assert jumps_in_words(section, d) == " Dashed lines mark where published kilometres jump."
    assert jumps_in_words(section_of(line(), [TRACK]), d) == ""


def test_a_curve_breaks_where_kilometres_are_missing():
    """Kilometres that jump ahead grow steadily: the chart runs by chainage, and no curve is drawn where there is no track."""
    which = line().track_index(TRACK)
    posts = MilePosts(
        np.full(4, which), np.array([0.0, 2000.0, 2000.01, 9000.0]), np.array([50_000.0, 52_000.0, 52_400.0, 59_399.99])
    )
    section = section_of(replace(line(), mileposts=posts), [TRACK])
    d = section.grid(0.25)
    x, title = axis_of(section, d)
    assert title == "chainage, km"
    figure = stack(
        [Strip("s", [Curve("c", x, np.sin(d), "#000", fine=0.01)])], identity="i", section=section, distance=d
    )
    trace = figure.data[0]
    at, values = np.asarray(trace["x"]), np.asarray(trace["y"])
    k = int(np.searchsorted(at, 52.2))
    assert np.isnan(values[k - 1])
    assert at[k - 1] < 52.001
    assert at[k] > 52.399
    (grey,) = [shape for shape in figure.layout["shapes"] if shape["type"] == "rect"]
    assert (grey["x0"], grey["x1"]) == pytest.approx((52.0, 52.4), abs=1e-3)
    nodes = np.array(figure.fine["nodes"])
    assert np.interp(d, *nodes) == pytest.approx(x, abs=2e-4)  # the values as measured stand where they belong


def test_resolution_is_worth_what_is_known():
    assert resolution_of(0.04, 100.0) == pytest.approx(0.01)
    assert resolution_of(20.0, 10.0) == pytest.approx(0.05)
    assert resolution_of(float("nan"), 10.0) == pytest.approx(0.05)
    assert resolution_of(float("nan"), 0.0) > 0.0
