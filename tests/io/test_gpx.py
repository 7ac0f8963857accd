"""GPX tracks: what the schema says of a point, refusals with the row, damage, entities."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from railnav.errors import RailnavError, RunError
from railnav.io.gnss_log import read_log
from railnav.io.run import read_run

START = datetime(2021, 6, 29, 10, 35, 17, tzinfo=UTC)
HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">\n'
FULL = (
    '<trkpt lat="47.5" lon="-19.25"><ele>118.9</ele><time>2021-06-29T10:35:17.25Z</time><geoidheight>43.7</geoidheight>'
    "<fix>dgps</fix><sat>9</sat><hdop>0.8</hdop><extensions><g:T xmlns:g='x'><g:speed>12.5</g:speed><g:course>90</g:course>"
    "</g:T></extensions></trkpt>\n"
)


def point(time, inner="", lat="47.5", lon="19.0"):
    return f'<trkpt lat="{lat}" lon="{lon}"><time>{time}</time>{inner}</trkpt>\n'


@pytest.fixture
def log(tmp_path):
    def read(*points, whole=None):
        text = f"{HEAD}<trk><trkseg>\n{''.join(points)}</trkseg></trk></gpx>" if whole is None else whole
        (tmp_path / "a.gpx").write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_log(tmp_path / "a.gpx", "gpx", start=START)

    return read


def refusal(log, *points, **options):
    with pytest.raises(RunError) as caught:
        log(*points, **options)
    text = str(caught.value)
    assert "\n" not in text
    return text.partition("a.gpx")[2]


def test_a_full_point(log):
    read = log(FULL, point("2021-06-29T12:35:18.5+02:00", "<ele>1</ele>"), point("2021-06-29T10:35:19"))
    n = read.table.number
    assert n["time_s"].tolist() == [0.25, 1.5, 2.0]
    assert n["latitude_deg"].tolist() == [47.5] * 3
    assert n["longitude_deg"].tolist() == [-19.25, 19.0, 19.0]
    for name, value in (
        ("height_m", 162.6),
        ("quality", 2),
        ("satellites", 9),
        ("hdop", 0.8),
        ("speed_m_s", 12.5),
        ("course_deg", 90),
    ):
        np.testing.assert_allclose(n[name], [value, np.nan, np.nan])
    assert "1 heights above sea level come without geoidheight and are left out" in str(read.summary)


def test_gpx_1_0_segments_and_other_elements(log):
    whole = (
        '<gpx version="1.0"><wpt lat="1" lon="2"><time>x</time></wpt><rte><rtept lat="1" lon="2"/></rte>'
        f"<trk><name>a</name><trkseg>{point('2021-06-29T10:35:17Z', '<speed>3</speed>')}</trkseg>"
        f"<trkseg>{point('2021-06-29T10:35:18Z')}</trkseg></trk></gpx>"
    )
    read = log(whole=whole)
    np.testing.assert_array_equal(read.table.number["speed_m_s"], [3, np.nan])
    assert not read.summary.suspicious


def test_void_and_second_points(log):
    read = log(
        point("2021-06-29T10:35:17Z", "<fix>none</fix>"),
        point("2021-06-29T10:35:18Z", "<fix>3d</fix>", lat="48"),
        point("2021-06-29T10:35:18Z", "<fix>dgps</fix>"),
    )
    assert read.table.number["latitude_deg"].tolist() == [47.5]
    assert (read.summary.void, read.summary.duplicates) == (1, 1)


LAUGHS = '<?xml version="1.0"?><!DOCTYPE gpx [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]><gpx>&b;</gpx>'
REFUSED = {
    "no time": ('<trkpt lat="1" lon="2"/>', ", row 4, column time: is missing; a route that was drawn is no log"),
    "no lat": ("\n<trkpt lon='2'><time>2021-06-29T10:35:17Z</time></trkpt>", ", row 5, column lat: is missing"),
    "latitude": (
        point("2021-06-29T10:35:17Z", lat="90.5"),
        ", row 4, column lat: 90.5 is outside -90 to 90; correct it",
    ),
    "number": (point("2021-06-29T10:35:17Z", lat="47,5"), ", row 4, column lat: '47,5' is not a number"),
    "nan": (point("2021-06-29T10:35:17Z", "<ele>nan</ele>"), ", row 4, column ele: 'nan' is not a number"),
    "speed": (point("2021-06-29T10:35:17Z", "<speed>-1</speed>"), ", row 4, column speed: '-1' is negative"),
    "time": (point("2021-02-30T10:35:17Z"), ", row 4, column time: '2021-02-30T10:35:17Z' is no instant; write UTC"),
    "no points": ("", ": holds no fix (0 instants without one; no points)"),
    "backwards": (
        point("2021-06-29T10:35:18Z") + point("2021-06-29T10:35:17Z"),
        ", row 5: time runs backwards (2021-06-29T10:35:17Z after 2021-06-29T10:35:18Z)",
    ),
    "within": ('<trkpt lat="1" lon="2"><trkpt/></trkpt>', ", row 4: a trkpt lies within another"),
    "deep": ("<a>" * 60, ", row 4: elements lie more than 50 deep"),
}
WHOLE = {
    "empty": ("", ", row 1: is no well-formed XML (no element found)"),
    "cut": (
        HEAD + "<trk><trkseg>\n" + FULL + "<trkpt lat=",
        ", row 5: is no well-formed XML (unclosed token); was the rec",
    ),
    "other": ("<kml/>", ", row 1: is no GPX file (it holds 'kml')"),
    "laughs": (LAUGHS, ", row 1: has a document type, which GPX needs not"),
    "external": ('<!DOCTYPE gpx SYSTEM "file:///etc/passwd"><gpx/>', ", row 1: has a document type"),
    "encoding": ('<?xml version="1.0" encoding="klingon"?><gpx/>', "ncoding"),
    "binary": (bytes(range(256)), ", row 1: is no well-formed XML"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_points(log, name):
    points, message = REFUSED[name]
    assert message in refusal(log, points)


@pytest.mark.parametrize("name", WHOLE)
def test_refused_files(log, name):
    whole, message = WHOLE[name]
    assert message in refusal(log, whole=whole)


def test_a_run_folder_reads(tmp_path):
    (tmp_path / "run.toml").write_text(
        '[run]\nid = "a"\nstart = "2021-06-29T10:35:17Z"\n[gnss]\nfile = "a.gpx"\nformat = "gpx"\n'
    )
    (tmp_path / "a.gpx").write_text(f"{HEAD}<trk><trkseg>\n{FULL}</trkseg></trk></gpx>")
    run = read_run(tmp_path)
    assert run.gnss.time.tolist() == [0.25]
    assert run.gnss.sigma_east is None


DATA = f"{HEAD}<trk><trkseg>\n{FULL}{point('2021-06-29T10:35:19Z')}</trkseg></trk></gpx>".encode()


@settings(max_examples=300, deadline=1000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    edits=st.lists(st.tuples(st.integers(0, len(DATA) - 1), st.binary(max_size=3), st.integers(0, 9)), max_size=4),
    cut=st.integers(0, len(DATA)),
)
def test_a_mutated_file_is_read_or_refused(tmp_path, edits, cut):
    data = bytearray(DATA)
    for place, new, gone in edits:
        data[place : place + gone] = new
    (tmp_path / "a.gpx").write_bytes(data[: max(cut, len(DATA) // 2)])
    try:
        read = read_log(tmp_path / "a.gpx", "gpx", start=START)
    except RailnavError:
        return
    assert (np.diff(read.table.number["time_s"]) > 0).all()


@settings(max_examples=300, deadline=1000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(texts=st.lists(st.text("0123456789.-+eEnaTZ:, <>&;\u0663", max_size=30), min_size=6, max_size=6))
def test_any_text_in_an_element_is_read_or_refused(tmp_path, texts):
    names = ("time", "ele", "geoidheight", "sat", "hdop", "speed")
    inner = "".join(f"<{name}>{text}</{name}>" for name, text in zip(names, texts, strict=True))
    (tmp_path / "a.gpx").write_text(f'<gpx><trkpt lat="1" lon="2">{inner}</trkpt></gpx>', encoding="utf-8")
    try:
        read_log(tmp_path / "a.gpx", "gpx", start=START)
    except RailnavError:
        return
