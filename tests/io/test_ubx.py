"""u-blox logs: messages of one instant joined, damage counted, against messages that pyubx2 writes and reads."""

from __future__ import annotations

import io
import math
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pyubx2 import GET, UBXMessage, UBXReader

from railnav.errors import RailnavError, RunError
from railnav.io import log_reading
from railnav.io.gnss_log import read_log
from railnav.io.run import read_run

START = datetime(2025, 7, 8, 19, 34, tzinfo=UTC)


def pvt(second=0.0, **fields):
    instant = START + timedelta(seconds=math.floor(second))
    values = {
        "iTOW": int(second * 1000) + 1000,
        "year": instant.year,
        "month": instant.month,
        "day": instant.day,
        "hour": instant.hour,
        "min": instant.minute,
        "second": instant.second,
        "validDate": 1,
        "validTime": 1,
        "fullyResolved": 1,
        "nano": round((second - math.floor(second)) * 1e9),
        "fixType": 3,
        "gnssFixOk": 1,
        "numSV": 21,
        "lon": -105.1474483,
        "lat": 40.0966268,
        "height": 1601474,
        "hMSL": 1618000,
        "hAcc": 14,
        "vAcc": 10,
        "velN": 3000,
        "velE": -4000,
        "gSpeed": 5000,
        "headMot": 306.87,
        "sAcc": 83,
        "pDOP": 1.2,
    }
    return UBXMessage("NAV", "NAV-PVT", GET, **(values | fields)).serialize()


def cov(second=0.0, **fields):
    values = {
        "posCovNN": 0.04,
        "posCovEE": 0.09,
        "posCovDD": 0.25,
        "velCovNN": 0.04,
        "velCovNE": -0.01,
        "velCovEE": 0.09,
    }
    valid = {"posCovValid": 1, "velCovValid": 1}
    return UBXMessage("NAV", "NAV-COV", GET, iTOW=int(second * 1000) + 1000, **(valid | values | fields)).serialize()


def hp(second=0.0, **fields):
    values = {
        "iTOW": int(second * 1000) + 1000,
        "lon": -105.1474483,
        "lat": 40.0966268,
        "height": 1601474,
        "_HPlon": -0.000000012,
        "_HPlat": 0.000000034,
        "_HPheight": 0.5,
        "hAcc": 14.2,
        "vAcc": 10.1,
    }
    return UBXMessage("NAV", "NAV-HPPOSLLH", GET, **(values | fields)).serialize()


def dop(second=0.0):
    return UBXMessage("NAV", "NAV-DOP", GET, iTOW=int(second * 1000) + 1000, hDOP=0.61).serialize()


@pytest.fixture
def log(tmp_path):
    def read(*messages, start=START):
        (tmp_path / "a.ubx").write_bytes(b"".join(messages))
        return read_log(tmp_path / "a.ubx", "ubx", start=start)

    return read


def refusal(log, *messages, **options):
    with pytest.raises(RunError) as caught:
        log(*messages, **options)
    return str(caught.value).partition("a.ubx")[2]


# --- what is read -----------------------------------------------------------------------------------------------------


def test_a_position_alone(log):
    read = log(pvt(0.25), pvt(1.25, carrSoln=2), pvt(2.25, carrSoln=1, headMot=-10.0), pvt(3.25, diffSoln=1))
    n = read.table.number
    assert n["time_s"].tolist() == [0.25, 1.25, 2.25, 3.25]
    assert n["latitude_deg"].tolist() == [40.0966268] * 4
    assert n["longitude_deg"].tolist() == [-105.1474483] * 4
    assert n["height_m"].tolist() == [1601.474] * 4
    np.testing.assert_allclose(n["sigma_east_m"], 0.014 / np.sqrt(2))
    np.testing.assert_allclose(n["sigma_up_m"], 0.010)
    np.testing.assert_allclose(n["speed_m_s"], 5)
    np.testing.assert_allclose(n["course_deg"], [306.87, 306.87, 350, 306.87])
    np.testing.assert_allclose(n["sigma_speed_m_s"], 0.083)
    assert n["quality"].tolist() == [1, 4, 5, 2]
    assert n["satellites"].tolist() == [21] * 4
    assert "hdop" not in n
    assert not read.summary.suspicious


def test_covariance_high_precision_and_dop_join_their_instant(log):
    """Whatever the order, and also where they come after the next position."""
    for messages in (
        [dop(), pvt(), hp(), cov(), pvt(1)],
        [cov(), hp(), dop(), pvt(), pvt(1)],
        [pvt(), pvt(1), cov(), dop(), hp()],
    ):
        n = log(*messages).table.number
        np.testing.assert_allclose(n["latitude_deg"], [40.096626834, 40.0966268], rtol=0, atol=1e-13)
        np.testing.assert_allclose(n["longitude_deg"], [-105.147448312, -105.1474483], rtol=0, atol=1e-13)
        np.testing.assert_allclose(n["height_m"], [1601.4745, 1601.474], rtol=0, atol=1e-9)
        np.testing.assert_allclose(n["sigma_north_m"][0], 0.2, rtol=1e-6)
        np.testing.assert_allclose(n["sigma_east_m"][0], 0.3, rtol=1e-6)
        np.testing.assert_allclose(n["sigma_up_m"][0], 0.5, rtol=1e-6)
        u = np.array([0.6, -0.8])
        covariance = np.array([[0.04, -0.01], [-0.01, 0.09]])
        np.testing.assert_allclose(n["sigma_speed_m_s"], [np.sqrt(u @ covariance @ u), 0.083], rtol=1e-6)
        np.testing.assert_array_equal(n["hdop"], [0.61, np.nan])


def test_what_is_not_valid_is_not_used(log):
    read = log(
        *(pvt(), cov(posCovValid=0, velCovNN=float("nan")), hp(invalidLlh=1)),
        pvt(1, hAcc=0xFFFFFFFF, vAcc=0),
        pvt(2, fixType=2),
    )
    n = read.table.number
    np.testing.assert_allclose(n["sigma_east_m"], [0.014 / np.sqrt(2), np.nan, 0.014 / np.sqrt(2)])
    np.testing.assert_array_equal(n["sigma_up_m"], [0.01, np.nan, np.nan])
    np.testing.assert_array_equal(n["height_m"], [1601.474, 1601.474, np.nan])
    assert n["latitude_deg"][0] == 40.0966268
    np.testing.assert_allclose(n["sigma_speed_m_s"], 0.083)


def test_every_number_agrees_with_pyubx2(log):
    random = np.random.default_rng(3)
    messages = []
    for i in range(200):
        messages.append(
            pvt(
                i + random.integers(1000) / 1000,
                iTOW=i,
                lat=random.integers(-900_000_000, 900_000_000) / 1e7,
                lon=random.integers(-1_800_000_000, 1_800_000_000) / 1e7,
                height=int(random.integers(-100_000, 5_000_000)),
                hAcc=int(random.integers(1, 100_000)),
                sAcc=int(random.integers(1, 10_000)),
                gSpeed=int(random.integers(0, 90_000)),
                headMot=random.integers(0, 36_000_000) / 1e5,
                numSV=int(random.integers(4, 40)),
            )
        )
    n = log(*messages).table.number
    for i, (_, m) in enumerate(UBXReader(io.BytesIO(b"".join(messages)))):
        time = datetime(m.year, m.month, m.day, m.hour, m.min, m.second, tzinfo=UTC) - START
        assert n["time_s"][i] == pytest.approx(time.total_seconds() + m.nano / 1e9, abs=1e-9)
        assert n["latitude_deg"][i] == pytest.approx(m.lat, abs=1e-9)
        assert n["longitude_deg"][i] == pytest.approx(m.lon, abs=1e-9)
        assert n["height_m"][i] == pytest.approx(m.height / 1000)
        assert n["sigma_north_m"][i] == pytest.approx(m.hAcc / 1000 / math.sqrt(2))
        assert n["sigma_speed_m_s"][i] == pytest.approx(m.sAcc / 1000)
        assert n["speed_m_s"][i] == pytest.approx(m.gSpeed / 1000)
        assert n["course_deg"][i] == pytest.approx(m.headMot)
        assert n["satellites"][i] == m.numSV


def test_old_firmware_writes_a_shorter_message(log):
    """Protocol version 14 has 84 bytes of payload: the last eight are not there."""
    body = pvt(1)[2:-2]
    short = body[:2] + (84).to_bytes(2, "little") + body[4:88]
    a = b = 0
    for byte in short:
        a = (a + byte) & 255
        b = (b + a) & 255
    read = log(b"\xb5\x62" + short + bytes([a, b]))
    assert read.table.number["time_s"].tolist() == [1.0]


def test_a_week_roll_over_is_put_right_and_said(log):
    old = START - timedelta(weeks=1024)
    read = log(pvt(0.5, year=old.year, month=old.month, day=old.day))
    assert read.table.number["time_s"].tolist() == [0.5]
    assert "moved by +1024 weeks" in str(read.summary)


# --- what is left out -------------------------------------------------------------------------------------------------


def test_void_fixes_and_second_fixes(log):
    read = log(
        pvt(0, gnssFixOk=0),
        pvt(1, fixType=0),
        pvt(2, fixType=5),
        pvt(3, validDate=0),
        pvt(4, validTime=0),
        pvt(5, invalidLlh=1),
        *(pvt(6), pvt(6, carrSoln=2, lat=41.0), pvt(6, lat=42.0)),
        *(pvt(7, lat=43.0), pvt(7, hAcc=13), pvt(7, hAcc=15, lat=44.0)),
    )
    assert read.table.number["latitude_deg"].tolist() == [41.0, 40.0966268]
    assert (read.summary.void, read.summary.duplicates, read.summary.broken) == (6, 4, 0)


def test_messages_among_other_bytes(log):
    junk = bytes(range(256)) * 4 + b"$GNGGA,1,2,3*00\r\n" + b"\xb5\xb5\xb5"
    read = log(junk, pvt(0), junk, pvt(1), junk)
    assert (read.summary.fixes, read.summary.broken, read.summary.good) == (2, 0, 2)


def test_broken_messages_are_counted_and_skipped(log, caplog):
    good = [pvt(i) for i in range(40)]
    bad = bytearray(pvt(9.5))
    bad[40] ^= 1
    large = bytearray(pvt(10.5))
    large[4:6] = b"\xff\xff"
    read = log(*good[:10], bytes(bad), *good[10:20], bytes(large), *good[20:], pvt(50)[:60])
    assert read.summary.fixes == 40
    assert (read.summary.broken, read.summary.first_broken) == (3, 1000)
    assert "3 broken messages left out (the first at byte 1000)" in caplog.text
    assert ": 2 of 5 messages are broken (the first at byte 0); copy the log again" in refusal(
        log, bytes(bad), *good[:3], bytes(bad)
    )


def test_refusals(log):
    assert ": holds no fix (0 instants without one; no messages)" in refusal(log, b"")
    assert ": holds no fix (0 instants without one; 1 NAV-DOP)" in refusal(log, dop())
    assert ": holds no fix (1 instants without one; 1 NAV-PVT)" in refusal(log, pvt(fixType=0))
    assert ": time runs backwards (2025-07-08T19:34:00Z after 2025-07-08T19:34:05Z)" in refusal(
        log, *(pvt(i) for i in (1, 2, 3, 4, 5, 0))
    )
    assert ": the first fix is of 2024-01-08T19:34:01Z, the run starts at 2025-07-08" in refusal(
        log, pvt(1, year=2024, month=1)
    )
    good = [pvt(i) for i in range(1, 20)]
    assert log(pvt(0, month=2, day=31), *good).summary.broken == 1
    assert log(pvt(0, lat=91.0), *good).summary.broken == 1


# --- blocks, run folders, damage --------------------------------------------------------------------------------------


def test_blocks_change_nothing(log, monkeypatch):
    messages = [part for i in range(400) for part in (pvt(i, lat=40 + i / 1e4), cov(i), dop(i), b"junk\xb5")]
    messages.insert(-8, pvt(399)[:50] + b"x")  # broken, far behind the first block
    whole = log(*messages)
    for size in (65_600, 70_003):
        monkeypatch.setattr(log_reading, "BLOCK", size)
        monkeypatch.setattr("railnav.io.ubx.BLOCK", size)
        monkeypatch.setattr("railnav.io.ubx._ROOM", 50)
        pieces = log(*messages)
        assert pieces.summary == whole.summary
        assert (whole.summary.fixes, whole.summary.broken) == (400, 1)
        assert whole.summary.first_broken > 70_003
        for name, values in whole.table.number.items():
            np.testing.assert_array_equal(pieces.table.number[name], values)


def test_a_run_folder_reads(tmp_path):
    (tmp_path / "run.toml").write_text(
        '[run]\nid = "a"\nstart = "2025-07-08T19:34:00Z"\n[gnss]\nfile = "a.ubx"\nformat = "ubx"\n'
    )
    (tmp_path / "a.ubx").write_bytes(b"".join(pvt(i) for i in range(5)))
    run = read_run(tmp_path)
    np.testing.assert_array_equal(run.gnss.time, np.arange(5.0))
    np.testing.assert_allclose(run.gnss.course, np.radians(306.87))


HUNDRED = [pvt(i) for i in range(100)]
DATA = b"".join(part for i in range(6) for part in (pvt(i), cov(i), hp(i), dop(i)))


@settings(max_examples=250, deadline=1000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    edits=st.lists(st.tuples(st.integers(0, len(DATA) - 1), st.binary(max_size=6), st.integers(0, 40)), max_size=8),
    cut=st.integers(0, len(DATA)),
)
@example(edits=[(0, b"\xb5\x62\xff\xff\xff\xff", 0)] * 8, cut=len(DATA))
def test_a_mutated_log_is_read_or_refused(tmp_path, edits, cut):
    data = bytearray(DATA)
    for place, new, gone in edits:
        data[place : place + gone] = new
    (tmp_path / "a.ubx").write_bytes(data[:cut])
    try:
        read = read_log(tmp_path / "a.ubx", "ubx", start=START)
    except RailnavError:
        return
    n = read.table.number
    assert (np.diff(n["time_s"]) > 0).all()
    assert (np.abs(n["latitude_deg"]) <= 90).all()


@settings(max_examples=200, deadline=1000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(st.sampled_from(["NAV-PVT", "NAV-COV", "NAV-HPPOSLLH", "NAV-DOP"]), st.binary(max_size=92)),
        max_size=9,
    )
)
def test_any_payload_with_a_lawful_checksum_is_read_or_counted(tmp_path, messages):
    number = {"NAV-PVT": 7, "NAV-COV": 0x36, "NAV-HPPOSLLH": 0x14, "NAV-DOP": 4}
    frames = []
    for name, payload in messages:
        body = bytes([1, number[name]]) + len(payload).to_bytes(2, "little") + payload
        a = b = 0
        for byte in body:
            a = (a + byte) & 255
            b = (b + a) & 255
        frames.append(b"\xb5\x62" + body + bytes([a, b]))
    (tmp_path / "a.ubx").write_bytes(b"".join(HUNDRED + frames))
    try:
        read = read_log(tmp_path / "a.ubx", "ubx", start=START)
    except RailnavError:
        return
    assert read.summary.good + read.summary.broken == 100 + len(frames)


def test_false_beginnings_cost_no_second_look(log):
    """A million beginnings of the longest message, in 6 MB; looking at each would take minutes."""
    import time

    log(pvt())
    begin = time.perf_counter()
    text = refusal(log, pvt(), b"\xb5\x62\x01\x07\xff\xff" * 1_000_000)
    assert time.perf_counter() - begin < 2.0
    assert "1000000 of 1000001 messages are broken" in text
