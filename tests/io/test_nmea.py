"""NMEA logs: epochs assembled, dates completed, damage counted, against pynmeagps and the standard's sentences."""

from __future__ import annotations

import functools
import operator
from datetime import UTC, datetime, timedelta

import numpy as np
import pynmeagps
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from railnav.errors import RailnavError, RunError
from railnav.io import gnss_time, log_reading
from railnav.io.gnss_log import read_log
from railnav.io.run import read_run

START = datetime(2021, 6, 29, 10, 35, 17, tzinfo=UTC)
KNOT = 1852 / 3600


def sentence(text):
    return f"${text}*{functools.reduce(operator.xor, text.encode(), 0):02X}\r\n"


def gga(time, lat="4723.4658", lon="01902.2695", quality="1", satellites="12", hdop="0.8", sep="43.669", talker="GN"):
    return sentence(f"{talker}GGA,{time},{lat},N,{lon},E,{quality},{satellites},{hdop},118.893,M,{sep},M,,")


def rmc(time, date="290621", status="A", speed="10.5", course="123.4", talker="GN", lat="4723.4658", lon="01902.2695"):
    return sentence(f"{talker}RMC,{time},{status},{lat},N,{lon},E,{speed},{course},{date},,,A")


@pytest.fixture
def log(tmp_path):
    def read(*sentences, start=START):
        data = b"".join(s if isinstance(s, bytes) else s.encode() for s in sentences)
        (tmp_path / "a.nmea").write_bytes(data)
        return read_log(tmp_path / "a.nmea", "nmea", start=start)

    return read


def refusal(log, *sentences, **options):
    with pytest.raises(RunError) as caught:
        log(*sentences, **options)
    return str(caught.value).partition("a.nmea")[2]


# --- what is read -----------------------------------------------------------------------------------------------------


def test_sentences_of_one_instant_make_one_fix(log):
    """The sample GST and VTG are those of the standard's explanations; numbers by hand."""
    read = log(
        rmc("103517.00"),
        gga("103517.00"),
        sentence("GPVTG,054.7,T,034.4,M,005.5,N,010.2,K"),
        sentence("GPGST,103517.00,0.006,0.023,0.020,273.6,0.023,0.020,0.031"),
        sentence("GPGSV,1,1,01,03,03,111,00"),
        rmc("103518.50", course=""),
        gga("103518.50", quality="4"),
    )
    n = read.table.number
    assert n["time_s"].tolist() == [0.0, 1.5]
    np.testing.assert_allclose(n["latitude_deg"], 47 + 23.4658 / 60, rtol=1e-15)
    np.testing.assert_allclose(n["longitude_deg"], 19 + 2.2695 / 60, rtol=1e-15)
    np.testing.assert_allclose(n["height_m"], 118.893 + 43.669)
    np.testing.assert_array_equal(n["sigma_north_m"], [0.023, np.nan])
    np.testing.assert_array_equal(n["sigma_east_m"], [0.020, np.nan])
    np.testing.assert_array_equal(n["sigma_up_m"], [0.031, np.nan])
    np.testing.assert_allclose(n["speed_m_s"], 10.5 * KNOT)
    np.testing.assert_array_equal(n["course_deg"], [123.4, np.nan])
    assert n["quality"].tolist() == [1, 4]
    assert n["satellites"].tolist() == [12, 12]
    assert (read.summary.good, read.summary.broken, read.summary.fixes) == (7, 0, 2)
    assert not read.summary.suspicious


def test_vtg_alone_gives_speed_and_gll_alone_a_position(log):
    read = log(
        gga("103517.00"),
        sentence("GPVTG,054.7,T,034.4,M,,N,036.0,K"),
        sentence("GPGLL,4723.4658,N,01902.2695,E,103518.00,A,D"),
    )
    np.testing.assert_array_equal(read.table.number["speed_m_s"], [10.0, np.nan])
    np.testing.assert_array_equal(read.table.number["course_deg"], [54.7, np.nan])
    assert len(read.table.number["latitude_deg"]) == 2


def test_gns_gives_height_and_kind_of_fix(log):
    """GNS of the standard's own example, with a mode for each of two systems."""
    read = log(
        sentence("GNGNS,122310.2,3722.425671,N,12258.856215,W,DA,14,0.9,1005.543,6.5,5.2,23"),
        start=datetime(2021, 6, 29, 12, tzinfo=UTC),
    )
    n = read.table.number
    assert n["time_s"].tolist() == [1390.2]
    assert n["quality"].tolist() == [2]
    np.testing.assert_allclose(n["height_m"], 1012.043)
    np.testing.assert_allclose(n["longitude_deg"], -(122 + 58.856215 / 60), rtol=1e-15)


def test_every_number_agrees_with_pynmeagps(log):
    random = np.random.default_rng(5)
    lines, expected = [], []
    for i in range(400):
        lat, lon = random.uniform(0, 90), random.uniform(0, 180)
        ns, ew = random.choice(["N", "S"]), random.choice(["E", "W"])
        time = f"{10 + i // 60:02d}{i % 60:02d}{random.integers(60):02d}.{random.integers(100):02d}"
        dm = f"{int(lat):02d}{lat % 1 * 60:08.5f}".replace("60.00000", "59.99999")
        dl = f"{int(lon):03d}{lon % 1 * 60:08.5f}".replace("60.00000", "59.99999")
        height, sep = random.uniform(-50, 3000), random.uniform(-100, 80)
        text = f"{dm},{ns},{dl},{ew}"
        talker = random.choice(["GN", "GP", "GL", "GA", "GB"])
        hdop, knots, course = random.uniform(0.5, 9), random.uniform(0, 90), random.uniform(0, 360)
        g = sentence(f"{talker}GGA,{time},{text},{random.integers(1, 7)},09,{hdop:.2f},{height:.3f},M,{sep:.2f},M,,")
        r = sentence(f"{talker}RMC,{time},A,{text},{knots:.3f},{course:.2f},290621,,,A")
        lines += [g, r]
        one, two = pynmeagps.NMEAReader.parse(g), pynmeagps.NMEAReader.parse(r)
        instant = datetime.combine(two.date, two.time, UTC)
        expected.append(
            ((instant - START).total_seconds(), one.lat, one.lon, one.alt + one.sep, two.spd * KNOT, two.cog, one.HDOP)
        )
    n = log(*lines).table.number
    names = ("time_s", "latitude_deg", "longitude_deg", "height_m", "speed_m_s", "course_deg", "hdop")
    # pynmeagps rounds degrees to ten decimals
    np.testing.assert_allclose(np.column_stack([n[name] for name in names]), expected, rtol=0, atol=6e-11)


# --- time -------------------------------------------------------------------------------------------------------------


def test_midnight_passes_with_and_without_a_date(log):
    start = datetime(2021, 6, 29, 23, 59, 58, tzinfo=UTC)
    for stated, *lines in (
        [False, gga("235959.00"), gga("000000.00"), gga("000001.00")],
        [True, gga("235959.00"), gga("000000.00"), rmc("000001.00", "300621")],
        [True, rmc("235959.00"), gga("000000.00"), gga("000001.00")],
    ):
        read = log(*lines, start=start)
        assert read.table.number["time_s"].tolist() == [1.0, 2.0, 3.0]
        assert any("no sentence states the date" in note for note in read.summary.notes) == (not stated)


def test_zda_states_the_date(log):
    read = log(gga("103517.00"), sentence("GPZDA,103517.00,30,06,2021,00,00"))
    assert read.table.number["time_s"].tolist() == [86400.0]


def test_a_week_roll_over_is_put_right_and_said(log):
    old = START - timedelta(weeks=1024)
    read = log(rmc("103517.00", old.strftime("%d%m%y")))
    assert read.table.number["time_s"].tolist() == [0.0]
    assert "displaced by a GPS week roll-over and were moved by +1024 weeks" in str(read.summary)
    text = refusal(log, rmc("103517.00", (old + timedelta(days=40)).strftime("%d%m%y")))
    assert (
        ", row 1: the first fix is of 2001-12-23T10:35:17Z, the run starts at 2021-06-29T10:35:17Z; correct run.start"
        in text
    )


def test_a_leap_second_falls_on_the_next(log):
    start = datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC)
    read = log(rmc("235959.00", "311216"), rmc("235960.50", "311216"), rmc("000001.00", "010117"), start=start)
    assert read.table.number["time_s"].tolist() == [0.0, 1.5, 2.0]


def test_time_that_runs_backwards_is_refused(log):
    text = refusal(log, *(rmc(f"1035{s:02d}.00") for s in (17, 18, 19, 20, 21, 22, 16)))
    assert ", row 7: time runs backwards (2021-06-29T10:35:16Z after 2021-06-29T10:35:22Z); split the log" in text


# --- what is left out -------------------------------------------------------------------------------------------------


def test_void_fixes_are_skipped_and_counted(log):
    read = log(
        gga("103517.00", quality="0"),
        rmc("103518.00", status="V"),
        sentence("GNGGA,103519.00,,,,,0,00,99.9,,M,,M,,"),
        sentence("GNRMC,,V,,,,,,,,,,N"),
        gga("103520.00"),
        rmc("103521.00", status="V") + gga("103521.00"),
        rmc("103522.00") + gga("103522.00", quality="0"),
        gga("103523.00") + gga("103523.00", quality="0", talker="GL"),
    )
    assert read.table.number["time_s"].tolist() == [3.0, 6.0]
    assert (read.summary.void, read.summary.broken) == (5, 0)


def test_of_two_fixes_at_one_instant_the_better_is_kept(log):
    for lines in (
        [gga("103517.00", quality="1", lat="4700.0"), gga("103517.00", quality="4", talker="GP")],
        [gga("103517.00", quality="4"), gga("103517.00", quality="1", lat="4700.0")],
        [gga("103517.00", satellites="5", lat="4700.0"), gga("103517.00", satellites="6")],
        [gga("103517.00", hdop="2", lat="4700.0"), gga("103517.00", hdop="1")],
    ):
        read = log(*lines)
        np.testing.assert_allclose(read.table.number["latitude_deg"], [47 + 23.4658 / 60])
        assert read.summary.duplicates == 1
    several = [gga(f"1035{s:02d}.00") for s in (17, 18, 19, 20, 21, 22)]
    read = log(*several, gga("103522.00", quality="5", lat="4800.0"))
    np.testing.assert_allclose(read.table.number["latitude_deg"][-1], 48)


def test_a_late_sentence_finds_its_instant(log):
    read = log(gga("103517.00"), gga("103518.00"), sentence("GPGST,103517.00,1,1,1,1,2.0,3.0,4.0"), gga("103519.00"))
    np.testing.assert_array_equal(read.table.number["sigma_up_m"], [4.0, np.nan, np.nan])


def test_broken_sentences_are_counted_and_skipped(log, caplog):
    good = [gga(f"1036{s:02d}.00") for s in range(30)]
    torn = "$GNGGA,103517.00,4723.4658,N,019"
    read = log(*good[:10], gga("103610.50").replace("4723", "4823"), *good[10:], torn)
    assert len(read.table.number["time_s"]) == 30
    assert (read.summary.broken, read.summary.first_broken) == (2, 11)
    assert "2 broken sentences left out (the first at row 11)" in caplog.text
    text = refusal(log, *good[:5], gga("103610.50").replace("4723", "4823"), torn)
    assert ": 2 of 7 sentences are broken (the first at row 6); copy the log again from the receiver" in text


MALFORMED = {
    "latitude": gga("103517.00", lat="9123.4658"),
    "minutes": gga("103517.00", lat="4760.0"),
    "letters": gga("103517.00", lat="47a3.4658"),
    "time": gga("256117.00"),
    "date": rmc("103517.00", "310221"),
    "speed": rmc("103517.00", speed="-3"),
    "short": sentence("GNGGA,103517.00,4723.4658,N"),
    "separator": gga("103517.00", hdop="0.8.1"),
    "long": sentence("GNGGA,103517.00," + "9" * 2000),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_a_lawful_checksum_does_not_excuse_nonsense(log, name):
    good = [gga(f"1036{s:02d}.00") for s in range(30)]
    read = log(MALFORMED[name], *good)
    assert (read.summary.fixes, read.summary.broken, read.summary.first_broken) == (30, 1, 1)


def test_a_height_without_separation_is_no_ellipsoidal_height(log):
    read = log(gga("103517.00", sep=""), gga("103518.00"))
    np.testing.assert_array_equal(np.isnan(read.table.number["height_m"]), [True, False])
    assert "1 heights above the geoid come without its separation and are left out" in str(read.summary)


def test_sentences_among_other_bytes_and_without_checksums(log):
    junk = bytes(range(256)) * 3
    read = log(junk, gga("103517.00"), junk, b"2021-06-29 12:00 ", rmc("103518.00"), junk, b"$$$$", b"$PUBX,00,a*00")
    assert (read.summary.fixes, read.summary.good, read.summary.broken) == (2, 2, 1)
    read = log("$GPGGA,103517.00,4723.4658,N,01902.2695,E,1,12,0.8,118.893,M,43.669,M,,\n", "$GPRMC,1035")
    assert (read.summary.fixes, read.summary.broken) == (1, 1)
    assert "no checksums" in str(read.summary)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", ": holds no fix (0 instants without one; no sentences); leave the stream out"),
        (b"\x00" * 5000, ": holds no fix (0 instants without one; no sentences)"),
        (b"a,b\n1,2\n", ": holds no fix"),
        (gga("103517.00", quality="0").encode(), ": holds no fix (1 instants without one; 1 GGA)"),
    ],
)
def test_a_log_without_a_fix_is_refused(log, content, message):
    assert message in refusal(log, content)


# --- blocks, run folders, damage --------------------------------------------------------------------------------------


def some(count):
    lines = []
    for i in range(count):
        t = f"{10 + i // 3600:02d}{i // 60 % 60:02d}{i % 60:02d}.00"
        lines += [rmc(t), gga(t, lat=f"4723.{i:04d}"), sentence(f"GNGST,{t},1,1,1,1,0.{1 + i % 9},0.2,0.3")]
    return lines


@pytest.mark.parametrize("size", [4096, 5003, 30000])
def test_blocks_change_nothing(log, monkeypatch, size):
    lines = some(300)
    whole = log(*lines)
    monkeypatch.setattr(log_reading, "BLOCK", size)
    monkeypatch.setattr("railnav.io.nmea.BLOCK", size)
    pieces = log(*lines)
    assert pieces.summary == whole.summary
    assert len(whole.table.number["time_s"]) == 300
    for name, values in whole.table.number.items():
        np.testing.assert_array_equal(pieces.table.number[name], values)


def test_a_run_folder_reads(tmp_path):
    (tmp_path / "run.toml").write_text(
        '[run]\nid = "a"\nstart = "2021-06-29T10:00:00Z"\n[gnss]\nfile = "a.nmea"\nformat = "nmea"\ntime_offset_s = 0.5\n'
        "lever_arm_m = [1.0, 0.0, -3.0]\n"
    )
    (tmp_path / "a.nmea").write_text("".join(some(20)))
    said = []
    run = read_run(tmp_path, report=said.append)
    np.testing.assert_array_equal(run.gnss.time, np.arange(20) + 0.5)
    np.testing.assert_allclose(run.gnss.course, np.radians(123.4))
    np.testing.assert_allclose(run.gnss.sigma_up, 0.3)
    assert run.gnss.sigma_speed is None
    assert not run.gnss.time.flags.writeable
    assert [s.fixes for s in said] == [20]


DATA = "".join(some(12)).encode()


@settings(max_examples=250, deadline=1000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    edits=st.lists(st.tuples(st.integers(0, len(DATA) - 1), st.binary(max_size=6), st.integers(0, 40)), max_size=8),
    cut=st.integers(0, len(DATA)),
)
@example(edits=[(0, b"$" * 6, 0)], cut=len(DATA))
@example(edits=[(30, b"," * 6, 0)] * 8, cut=len(DATA))
def test_a_mutated_log_is_read_or_refused(tmp_path, edits, cut):
    data = bytearray(DATA)
    for place, new, gone in edits:
        data[place : place + gone] = new
    (tmp_path / "a.nmea").write_bytes(data[:cut])
    try:
        read = read_log(tmp_path / "a.nmea", "nmea", start=START)
    except RailnavError:
        return
    n = read.table.number
    assert (np.diff(n["time_s"]) > 0).all()
    assert (np.abs(n["latitude_deg"]) <= 90).all()


@settings(max_examples=250, deadline=1000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(texts=st.lists(st.text("GNRMCAVTSLZD0159.,-*$", max_size=60), max_size=6))
def test_any_sentence_with_a_lawful_checksum_is_read_or_counted(tmp_path, texts):
    kinds = ["GNGGA", "GNRMC", "GNGST", "GNVTG", "GNGLL", "GNZDA", "GNGNS"]
    lines = [sentence(f"{kind},{text.replace('*', '').replace('$', '')}") for kind in kinds for text in texts]
    lines += [sentence("GNGGA" + "," * k) for k in (5, 40, 60)]
    (tmp_path / "a.nmea").write_text("".join(some(200)[:600] + lines), newline="")
    try:
        read = read_log(tmp_path / "a.nmea", "nmea", start=START)
    except RailnavError:
        return
    assert read.summary.good + read.summary.broken == 600 + len(lines)


# --- clocks -----------------------------------------------------------------------------------------------------------


def test_leap_seconds_are_those_of_the_bulletins():
    """GPS - UTC from IERS Bulletin C: 13 s in 1999, 14 in 2006, 15 in 2009, 16 in July 2012, 17 in July 2015, 18 from 2017."""
    for instant, leap in (
        (datetime(1980, 1, 6, tzinfo=UTC), 0),
        (datetime(1981, 6, 30, 23, 59, 59, tzinfo=UTC), 0),
        (datetime(1981, 7, 1, tzinfo=UTC), 1),
        (datetime(1999, 1, 1, tzinfo=UTC), 13),
        (datetime(2005, 12, 31, 23, 59, 59, tzinfo=UTC), 13),
        (datetime(2006, 1, 1, tzinfo=UTC), 14),
        (datetime(2009, 1, 1, tzinfo=UTC), 15),
        (datetime(2012, 7, 1, tzinfo=UTC), 16),
        (datetime(2015, 7, 1, tzinfo=UTC), 17),
        (datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC), 17),
        (datetime(2017, 1, 1, tzinfo=UTC), 18),
        (datetime(2026, 5, 4, tzinfo=UTC), 18),
    ):
        utc = gnss_time.nanoseconds(instant)
        assert gnss_time.gps_to_utc(np.array([utc + leap * gnss_time.SECOND])).tolist() == [utc]


@given(st.datetimes(datetime(1980, 1, 1), datetime(2199, 12, 31), timezones=st.just(UTC)))  # noqa: DTZ001
def test_day_numbers_follow_the_calendar(instant):
    from railnav.io._kernels import day_number

    assert day_number(instant.year, instant.month, instant.day) == (instant - datetime(1970, 1, 1, tzinfo=UTC)).days
    assert day_number(2023, 2, 29) == -1
