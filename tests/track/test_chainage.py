"""Line references: over-long and short kilometres, stretched ones, negative starts, several lines; notations of four railways."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import assume, given
from hypothesis import strategies as st

import railnav
from railnav.cli import main
from railnav.errors import InputError, ModelError, TrackError
from railnav.io.line_references import read_kilometres
from railnav.track.chainage import (
    CHAIN,
    MILE,
    ChainageAddress,
    LineReference,
    LineReferences,
    find_chainage,
    published,
)
from railnav.track.chainage_notation import format_chainage, parse_chainage
from railnav.track.posts import references_from_posts, spread_references, with_kilometres

kilometres = st.lists(st.floats(5.0, 2500.0), min_size=1, max_size=30)


# --- one line ----------------------------------------------------------------------------------------------------------


@given(kilometres, st.integers(-20, 3000), st.booleans(), st.floats(0.0, 1.0), st.floats(-5e4, 5e6))
def test_addresses_and_positions_are_inverse(lengths, first, stretched, share, origin):
    line = LineReference.of("L", first, lengths, stretched=stretched, origin=origin)
    s = origin + share * line.length
    address = line.address(s)
    assert abs(line.position(address) - s) < 1e-8
    assert first <= address.label < first + len(lengths)
    # metres never pass what the kilometre counts, but at the very end of the line
    k = address.label - first
    assert address.metre <= line.counted[k] + 1e-6
    grid = np.concatenate([line.start, origin + np.linspace(-100.0, line.length + 100.0, 50)])
    np.testing.assert_allclose(line.positions(*line.addresses(grid)), grid, atol=1e-7)


@given(kilometres, st.integers(-20, 3000), st.data())
def test_positions_and_addresses_are_inverse_the_other_way(lengths, first, data):
    line = LineReference.of("L", first, lengths)
    k = data.draw(st.integers(0, len(lengths) - 1))
    metre = data.draw(st.floats(0.0, lengths[k] - 1e-6))
    address = line.address(line.position(ChainageAddress(first + k, metre)))
    assume(address.metre > 1e-9)  # on the joint itself either name is right
    assert (address.label, pytest.approx(address.metre, abs=1e-8)) == (first + k, metre)


def test_over_long_and_short_kilometres():
    """Kilometre 53 has 1,054 m, kilometre 54 is missing after 420 m of ... 55: no two places share an address."""
    line = LineReference.of("80", 52, [1000.0, 1054.0, 420.0, 1000.0], labels=[52, 53, 55, 56])
    assert line.address(1000.0 + 1054.0 - 1.0) == ChainageAddress(53, 1053.0)
    assert line.position(ChainageAddress(53, 1053.0)) == 2053.0
    assert line.irregular() == [(53, 54.0), (55, -580.0)]
    with pytest.raises(TrackError, match="kilometre 53 of line '80' is 1054 m long; there is no metre 1060"):
        line.position(ChainageAddress(53, 1060.0))
    with pytest.raises(TrackError, match="has no kilometre 54; it has 52 to 56, with gaps"):
        line.position(ChainageAddress(54, 0.0))


def test_stretched_kilometres():
    line = LineReference.of("F", 12, [1012.0, 988.0], stretched=True)
    assert line.address(506.0) == ChainageAddress(12, 500.0)
    assert line.address(1012.0 + 494.0) == ChainageAddress(13, pytest.approx(500.0))


def test_negative_start_and_miles():
    line = LineReference.of("N", -1, [1000.0, 1000.0], origin=-1000.0)
    assert line.address(-400.0) == ChainageAddress(-1, 600.0)
    assert format_chainage(line.address(-400.0)) == "-0,4+00"
    miles = LineReference.of("M", 10, [MILE, MILE], unit=MILE)
    assert miles.irregular() == []
    assert format_chainage(miles.address(MILE + 40 * CHAIN), "british") == "11 m 40 ch"


def test_lines_that_are_none():
    for label, start, counted, words in (
        ([1, 1], [0, 1, 2], [1, 1], "stands twice"),
        ([1, 2], [0, 1, 1], [1, 1], "does not end after it begins"),
        ([1], [0, 1, 2], [1], "as many lengths"),
        ([1], [0, math.nan], [1], "has no length"),
        ([1], [0, 1], [0], "has no length"),
    ):
        with pytest.raises(TrackError, match=words):
            LineReference("L", np.array(label), np.array(start, float), np.array(counted, float))
    with pytest.raises(TrackError, match="not finite"):
        LineReference.of("L", 1, [1000.0]).address(math.nan)


# --- notations ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "label", "metre"),
    [
        ("12,3+45", 12, 345.0),
        ("km 12,3 + 45", 12, 345.0),
        ("53+1054", 53, 1054.0),
        ("12,9+154,5", 12, 1054.5),
        ("12,345", 12, 345.0),
        ("-0,4+12", -1, 612.0),
        ("-0,4", -1, 600.0),
        ("1254 km PK 7 +32", 1254, 632.0),
        ("1254 км ПК 7+32", 1254, 632.0),
        ("1254км пк11 +8.5", 1254, 1008.5),
        ("1254 km", 1254, 0.0),
        ("12.345", 12, 345.0),
        ("km 12.3", 12, 300.0),
        ("-1.250", -2, 750.0),
        ("12 m 34 ch", 12, 34 * CHAIN),
        ("12m 34.5ch", 12, 34.5 * CHAIN),
        ("12 miles 567 yards", 12, 567 * CHAIN / 22),
        ("7", 7, 0.0),
    ],
)
def test_published_notations(text, label, metre):
    assert parse_chainage(text) == ChainageAddress(label, pytest.approx(metre, abs=1e-9))


@pytest.mark.parametrize(
    "text", ["", "km", "12,3,4", "1254 km PK 0", "twelve", "12.3.4", "12+", "--3", "12 m 34 m", "1e5", "nan"]
)
def test_what_is_no_address(text):
    with pytest.raises(TrackError, match=r"is no chainage|is none"):
        parse_chainage(text)


@given(
    st.integers(0, 9999),
    st.floats(0.0, 1999.0),
    st.sampled_from(["german", "russian", "swiss", "british"]),
    st.integers(0, 3),
)
def test_what_is_printed_reads_back(label, metre, notation, decimals):
    address = ChainageAddress(label, metre)
    text = format_chainage(address, notation, decimals=decimals)
    back = parse_chainage(text)
    unit = CHAIN if notation == "british" else 1.0
    assert back.label == label
    assert abs(back.metre - metre) <= unit * 0.5 * 10.0**-decimals + 1e-6


@given(st.integers(-50, -1), st.floats(0.0, 999.0), st.sampled_from(["german", "swiss"]))
def test_negative_addresses_read_back(label, metre, notation):
    address = ChainageAddress(label, metre)
    back = parse_chainage(format_chainage(address, notation, decimals=3))
    assert abs((back.label - label) * 1000.0 + back.metre - metre) < 1e-3


@given(st.text(max_size=30))
def test_any_text_is_read_or_refused(text):
    try:
        address = parse_chainage(text)
    except TrackError:
        return
    assert math.isfinite(address.metre)


def test_what_cannot_be_printed():
    with pytest.raises(TrackError, match="before its kilometre"):
        format_chainage(ChainageAddress(3, -1.0))
    with pytest.raises(TrackError, match="no notation"):
        format_chainage(ChainageAddress(3, 1.0), "french")


# --- lines on tracks ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model():
    plain = railnav.demo_line()
    return replace(plain, references=references_from_posts(plain))


def test_posts_give_line_references(model):
    """Every post is its own address, on every track, within a micrometre."""
    posts = model.mileposts
    random = np.random.default_rng(1)
    for i in random.choice(len(posts.track), 60, replace=False):
        track = model.track_id[posts.track[i]]
        (said,) = published(model, track, float(posts.offset[i]))
        assert said.address.label * 1000.0 + said.address.metre == pytest.approx(posts.chainage[i], abs=1e-6)
        assert any(
            p.track == track and abs(p.offset - posts.offset[i]) < 1e-6
            for p in find_chainage(model, said.line, said.address)
        )


@given(st.data())
def test_chainage_and_place_are_exact_inverses(model, data):
    stretches = model.references.stretches()
    track, _, _ = data.draw(st.sampled_from(stretches))
    offset = data.draw(st.floats(0.0, float(model.lengths[track])))
    for said in published(model, model.track_id[track], offset):
        if said.address.metre < 0:
            continue  # beyond the line's first kilometre there is no address
        try:
            places = find_chainage(model, said.line, said.address)
        except TrackError:
            continue
        mine = [p for p in places if p.track == model.track_id[track]]
        assert mine
        assert min(abs(p.offset - offset) for p in mine) < 1e-6


def test_tracks_without_posts_get_theirs_from_both_sides(model):
    """Posts of every third main track are taken away: what is spread agrees with what they said, within a metre."""
    full = references_from_posts(model)
    mains = [i for i, name in enumerate(model.track_id) if name.startswith("77R-")]
    gone = set(mains[1:-1:3])
    posts = model.mileposts
    keep = np.array([i not in gone for i in posts.track.tolist()])
    fewer = replace(model, mileposts=type(posts)(posts.track[keep], posts.offset[keep], posts.chainage[keep]))
    spread = spread_references(fewer, references_from_posts(fewer))
    spread_model = replace(fewer, references=spread)
    compared = 0
    for i in gone:
        name, middle = model.track_id[i], float(model.lengths[i]) / 2
        (truth,) = published(replace(model, references=full), name, middle)
        said = published(spread_model, name, middle)
        if not said:
            continue  # the chainage jumps on it: its length contradicts the line, and it stays without
        compared += 1
        away = (said[0].address.label - truth.address.label) * 1000.0 + said[0].address.metre - truth.address.metre
        assert abs(away) < 1.0
        assert said[0].rising == truth.rising
    assert compared >= len(gone) - 1
    assert spread_references(model, full) is not None


def test_several_lines_over_one_track(model):
    """Line 77 and a line of its own numbering, falling as offset grows, with an over-long kilometre."""
    track = model.track_index("77R-02")
    length = float(model.lengths[track])
    other = LineReference.of("X", 5, [1000.0, 1054.0, 1000.0])
    old = model.references
    anchors = [
        *zip(old.track, old.line, old.offset, old.position, strict=True),
        (track, 2, 0.0, 2900.0),
        (track, 2, length, 2900.0 - length),
    ]
    anchors.sort()
    columns = [np.array(c) for c in zip(*anchors, strict=True)]
    references = LineReferences(
        (*old.lines, other), columns[0].astype(int), columns[1].astype(int), columns[2], columns[3]
    )
    both = replace(model, references=references)
    said = published(both, "77R-02", 10.0)
    assert [p.line for p in said] == ["77", "X"]
    assert (said[1].address, said[1].rising) == (ChainageAddress(7, pytest.approx(836.0)), False)
    (place,) = find_chainage(both, "X", said[1].address)
    assert (place.track, place.offset, place.rising) == ("77R-02", pytest.approx(10.0), False)
    assert find_chainage(both, "X", ChainageAddress(5, 0.0)) == ([] if length < 2900.0 else [pytest.approx(place)])


def test_a_table_of_kilometres_replaces_what_posts_suggest(model):
    name = model.references.lines[1].line
    lengths = [1000.0, 1030.0, 990.0, 1000.0]
    table = LineReference.of(name, 0, lengths)
    changed = with_kilometres(model.references, [table])
    assert changed.lines[1].irregular() == [(1, 30.0), (2, -10.0)]
    for i in np.flatnonzero(changed.line == 1):
        old = model.references.lines[1].address(model.references.position[i])
        new = changed.lines[1].address(changed.position[i])
        assert (new.label, new.metre) == (old.label, pytest.approx(old.metre, abs=1e-6))
    with pytest.raises(TrackError, match="no posts of line"):
        with_kilometres(model.references, [LineReference.of("other", 0, lengths)])
    with pytest.raises(TrackError, match="has no place in the table"):
        with_kilometres(model.references, [LineReference.of(name, 100, lengths)])


def test_they_are_stored_with_the_model(model, tmp_path):
    model.to_file(tmp_path / "line.gpkg")
    again = railnav.TrackModel.read(tmp_path / "line.gpkg")
    assert again.references == model.references
    assert again.references != LineReferences()
    plain = railnav.demo_line()
    plain.to_file(tmp_path / "plain.gpkg")
    assert len(railnav.TrackModel.read(tmp_path / "plain.gpkg").references) == 0


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        ("UPDATE kilometres SET end_m = end_m + 5 WHERE fid = 3", "does not begin where"),
        ("UPDATE kilometres SET label = 'x' WHERE fid = 3", "is no finite number"),
        ("UPDATE line_positions SET track = 'gone' WHERE fid = 1", "is no track"),
        ("UPDATE line_positions SET line = 'gone' WHERE fid = 1", "is no line of the table"),
        ("UPDATE line_positions SET position_m = 1e7 WHERE fid = 2", "neither grow nor fall"),
        ("DROP TABLE kilometres", "kilometres: the table is missing"),
    ],
)
def test_damaged_tables_are_refused(model, tmp_path, statement, words):
    import sqlite3

    model.to_file(tmp_path / "line.gpkg")
    with sqlite3.connect(tmp_path / "line.gpkg") as connection:
        connection.execute(statement)
    connection.close()
    with pytest.raises(ModelError, match=words):
        railnav.TrackModel.read(tmp_path / "line.gpkg")


def test_references_that_are_none(model):
    good = LineReference.of("A", 0, [1000.0])
    one = np.zeros(1, int)
    with pytest.raises(TrackError, match="stands twice"):
        LineReferences((good, good))
    with pytest.raises(TrackError, match="names a line or track"):
        LineReferences((good,), one, one + 4, np.zeros(1), np.zeros(1))
    with pytest.raises(TrackError, match="different lengths"):
        LineReferences((good,), one, one, np.zeros(2), np.zeros(1))
    with pytest.raises(TrackError, match="not sorted"):
        LineReferences((good,), np.array([0, 1, 0]), np.zeros(3, int), np.arange(3.0), np.arange(3.0))
    with pytest.raises(TrackError, match="names a track that the model does not have"):
        replace(model, references=LineReferences((good,), one + 9999, one, np.zeros(1), np.zeros(1)))
    with pytest.raises(TrackError, match="has no line 'Q'"):
        find_chainage(model, "Q", ChainageAddress(1, 0.0))
    with pytest.raises(TrackError, match="is not on track"):
        published(model, "77R-02", 1e6)


# --- the verb ----------------------------------------------------------------------------------------------------------


def run(*arguments, ok=True):
    done = CliRunner().invoke(main, [str(a) for a in arguments])
    assert (done.exit_code == 0) == ok, done.output
    return done.output


def test_the_verb(tmp_path):
    railnav.demo_line().to_file(tmp_path / "line.gpkg")
    file = tmp_path / "line.gpkg"
    places = json.loads(run("chainage", file, "40,3+25", "--line", "77", "--json"))["places"]
    assert {p["track"] for p in places} == {"77R-01", "77L-01"}
    place = places[0]
    said = json.loads(run("chainage", file, "--track", place["track"], "--offset", place["offset_m"], "--json"))[
        "addresses"
    ]
    assert said == [{"line": "77", "label": 40, "metre": pytest.approx(325.0, abs=1e-3), "rising": True}]
    assert "40 km PK 4 +25.00" in run("chainage", file, "40,3+25", "--line", "77", "--notation", "russian")
    assert "name the line" in run("chainage", file, "40,3+25", ok=False)
    run("chainage", file, "--posts", "-o", tmp_path / "with.gpkg")
    assert len(railnav.TrackModel.read(tmp_path / "with.gpkg").references) == 2
    (tmp_path / "km.csv").write_text("line,km,length_m\n78,0,1000\n78,1,1030\n78,2,990\n78,3,1000\n")
    assert "km 1 +30.0 m" in run("chainage", file, "--kilometres", tmp_path / "km.csv", "-o", tmp_path / "long.gpkg")
    (place,) = json.loads(run("chainage", tmp_path / "long.gpkg", "1+1010", "--line", "78", "--json"))["places"]
    assert place["track"]
    assert "there is no metre 1040" in run("chainage", tmp_path / "long.gpkg", "1+1040", "--line", "78", ok=False)


def test_tables_of_kilometres(tmp_path):
    file = tmp_path / "km.csv"
    file.write_text("km,length_m,counted_m\n-1,400,\n0,1000,1000\n1,1054,\n")
    (line,) = read_kilometres(file)
    assert line.address(400.0 + 1000.0 + 1050.0) == ChainageAddress(1, 1050.0)
    (stretched,) = read_kilometres(file, stretched=True)
    assert stretched.address(200.0) == ChainageAddress(-1, 500.0)
    for text, words in (
        ("km,length_m\n1.5,1000\n", "row 2, column km: 1.5 is no whole kilometre"),
        ("km,length_m\n1,1000\n1,1000\n", "stands twice"),
        ("km,length_m\n1,0\n", "length_m"),
        ("km\n1\n", "length_m"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=words):
            read_kilometres(file)
