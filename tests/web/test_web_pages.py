"""Pages: self-contained, escaped, small, and true to what they are given."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from railnav.errors import RailnavError
from railnav.navigation.solution import Solution
from railnav.track.model import TrackModel
from railnav.truth import Truth
from railnav.web import figures, report
from railnav.web.page import Card, Code, Figure, Section, Table, Warnings, page

Journey = Callable[[int], tuple[Solution, Truth]]


class Parts(HTMLParser):
    """Tags and attributes of a page, and the texts of its scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.scripts: list[str] = []
        self.words: list[str] = []
        self._script = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "action", "data", "srcset")]
        self._script = tag == "script"
        if self._script:
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        self._script = False

    def handle_data(self, data: str) -> None:
        if self._script:
            self.scripts[-1] += data
        else:
            self.words.append(data)


def figures_of(text: str) -> dict[str, dict[str, Any]]:
    return {figure["id"]: figure for figure in json.loads(Parts(text).scripts[0])}


def test_a_page_asks_nothing_of_the_network(line: TrackModel, journey: Journey) -> None:
    solution, _ = journey(500)
    text = report.solution_page(solution, line)
    parts = Parts(text)
    assert parts.links == []
    assert not {"link", "img", "iframe", "object", "base", "form"} & set(parts.tags)
    policy = unescape(text.partition("Content-Security-Policy")[2][:400])
    assert "default-src 'none'" in policy
    assert "connect-src 'none'" in policy
    data, plotly, own = parts.scripts
    assert "plotly.js v" in plotly[:400]
    rest = text.replace(plotly, "")
    assert "http:" not in rest
    assert "https:" not in rest
    for phrase in (
        'plotlyServerURL: ""',
        'topojsonURL: ""',
        "showLink: false",
        "sendData: false",
        "showSendToCloud: false",
    ):
        assert phrase in own
    assert re.findall(r"modeBarButtons: (.*),\n", own) == [
        '[["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]]'
    ], "buttons are named one by one: plotly.js 4 has one that uploads the chart"
    types = {trace["type"] for figure in json.loads(data) for trace in figure["data"]}
    assert types == {"scatter"}, "maps would fetch tiles, WebGL would need eval"


HOSTILE = '</script><script>alert(1)</script><b onmouseover="x">&amp;\u2028 %{x} <!--'


def test_every_text_is_escaped(line: TrackModel, journey: Journey) -> None:
    solution, truth = journey(300)
    hostile = replace(line, track_id=(HOSTILE, *line.track_id[1:]), name=(HOSTILE, *line.name[1:]))
    build = {
        "runs": [
            {
                "id": HOSTILE,
                "receiver": HOSTILE,
                "direction": HOSTILE,
                "fixes": {"total": 2, "used": 1, "rejected": {HOSTILE: {"count": 1}}},
                "frame_offset": None,
            }
        ],
        "tracks": [{"track": HOSTILE, "length_m": 1.0}],
        "warnings": [HOSTILE],
        "datum": {"rule": HOSTILE},
    }
    hostile = replace(hostile, provenance={"build": build})
    named = replace(solution, track_id=hostile.track_id, run_id=HOSTILE)
    for text in (report.build_page(hostile), report.solution_page(named, hostile)):
        parts = Parts(text)
        assert len(parts.scripts) == 3
        assert "alert(1)" not in "".join(parts.scripts[1:])
        assert "b" not in parts.tags
        assert "<" not in parts.scripts[0]
    parts = Parts(
        page(
            HOSTILE,
            subtitle=HOSTILE,
            badge=HOSTILE,
            lead=[HOSTILE],
            footer=HOSTILE,
            cards=[Card(HOSTILE, HOSTILE, HOSTILE)],
            sections=[
                Section(
                    HOSTILE,
                    HOSTILE,
                    [Table([HOSTILE], [[HOSTILE]], caption=HOSTILE), Code([HOSTILE]), Warnings([HOSTILE])],
                )
            ],
        )
    )
    assert "b" not in parts.tags
    assert sum(HOSTILE.replace("&amp;", "&amp;") in word for word in parts.words) >= 10
    shown = figures_of(report.solution_page(named, hostile))["plan"]["data"]
    assert all("<" not in label for trace in shown for label in trace.get("text", []))
    assert truth.simulated


@pytest.mark.parametrize("epochs", [1, 2, 7, 300_000])
def test_pages_stay_small_whatever_the_run(line: TrackModel, journey: Journey, epochs: int) -> None:
    solution, _ = journey(epochs)
    text = report.solution_page(solution, line)
    assert len(text.encode()) < 8e6
    drawn = figures_of(text)
    assert set(drawn) == {"plan", "time", "line"}
    assert drawn["time"]["moves"]
    marker = drawn["plan"]["marker"]
    assert len(marker["time"]) == len(marker["x"]) == len(marker["y"])
    assert drawn["plan"]["data"][marker["trace"]]["name"] == "train"


def test_a_solution_without_a_position_has_a_page(journey: Journey) -> None:
    solution, _ = journey(20)
    nowhere = np.full(20, np.nan)
    lost = replace(
        solution,
        track=np.full(20, -1),
        mode=np.full(20, 5),
        easting=nowhere,
        northing=nowhere,
        speed=nowhere,
        sigma_along=nowhere,
        protection_level_along=nowhere,
    )
    text = report.solution_page(lost, None)
    assert "0 %" in text
    assert "NaN" not in Parts(text).scripts[0]


def test_plan_keeps_to_the_tracks(line: TrackModel) -> None:
    """The drawn outline leaves the knots by no more than a few centimetres."""
    from shapely import LineString, Point

    trace = figures.plan(line).data[0]
    x, y, names = np.asarray(trace["x"]), np.asarray(trace["y"]), trace["text"]
    east0, north0 = (np.floor(values.min() / 1e3) for values in (line.easting, line.northing))
    rows = [k for k, name in enumerate(names) if name == "77R-03" and np.isfinite(x[k])]
    drawn = LineString(np.column_stack([(x[rows] + east0) * 1e3, (y[rows] + north0) * 1e3]))
    knots = line.knots("77R-03")
    worst = max(drawn.distance(Point(e, n)) for e, n in zip(line.easting[knots], line.northing[knots], strict=True))
    assert worst < 0.06
    assert len(rows) < 400


@given(st.integers(1, 5000), st.integers(10, 400), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_thinning_keeps_ends_and_peaks(m: int, limit: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    a, b = generator.normal(size=m), generator.normal(size=m)
    a[generator.random(m) < 0.1] = np.nan
    rows = figures.thin(limit, a, b)
    assert len(rows) <= max(2 * limit, m if m <= limit else 0) + 4
    assert rows[0] == 0
    assert rows[-1] == m - 1
    assert (np.diff(rows) > 0).all()
    for series in (a, b):
        if np.isfinite(series).any():
            assert np.nanmax(series[rows]) == np.nanmax(series)
            assert np.nanmin(series[rows]) == np.nanmin(series)


def test_thinning_of_nothing_known() -> None:
    assert len(figures.thin(10, np.full(1000, np.nan))) < 40


def test_tables_leave_out_empty_columns() -> None:
    text = page("t", sections=[Section("s", "", [Table(("a", "b"), [["1", ""], ["2", ""]])])])
    assert ">a</th>" in text
    assert ">b</th>" not in text


def test_a_page_without_figures_needs_no_plotly() -> None:
    text = page("t", lead=["words"])
    assert len(text) < 20_000


def test_without_plotly_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(RailnavError, match=r"railnav\[report\]"):
        page("t", sections=[Section("s", "", [Figure("f", [], {})])])


def test_build_page_shows_runs_tracks_and_warnings(line: TrackModel) -> None:
    build = {
        "runs": [
            {
                "id": "monday",
                "receiver": "u-blox",
                "direction": "up",
                "fixes": {
                    "total": 1000,
                    "used": 990,
                    "rejected": {"outlier": {"count": 7, "worst": []}, "standstill": {"count": 3, "worst": []}},
                },
                "frame_offset": {"east_m": -0.4, "north_m": -9.03, "up_m": None},
                "noise": {"cross_sigma_m": 1.234},
            }
        ],
        "tracks": [
            {
                "track": "1",
                "length_m": 1234.5678,
                "runs": ["monday"],
                "sigma_cross_m": 0.0123,
                "heights": True,
                "survey_again": [{"from_m": 0.0, "to_m": 250.0}],
            }
        ],
        "warnings": ["one receiver stands 9 m south"],
        "datum": {"rule": "mean of all receivers"},
    }
    words = " ".join(Parts(report.build_page(replace(line, provenance={"build": build}))).words)
    for phrase in (
        "monday",
        "7 outlier; 3 standstill",
        "99.00 %",
        "-9.03 m",
        "-0.400 m",
        "1,234.568 m",
        "12 mm",
        "0 m to 250 m",
        "one receiver stands 9 m south",
        "mean of all receivers",
    ):
        assert phrase in words
    assert re.search(r"1,000 fixes", words)
