"""RTKLIB solution files: GPS time to UTC, sigmas, velocities, damage counted, against plain Python and the real drive."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from railnav.errors import RailnavError, RunError
from railnav.io import log_reading
from railnav.io.gnss_log import read_log
from railnav.io.run import read_run

START = datetime(2013, 6, 19, 10, 0, tzinfo=UTC)
COLUMNS = "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
HEAD = (
    "% program   : RTKLIB ver.2.4.2\n% obs start : 2013/06/19 10:00:00.0 GPST (week1745 295200.0s)\n%\n"
    "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)\n"
    f"%  GPST                  {COLUMNS}\n"
)
SOLUTION = "35.132114917  139.624397290    74.1234   {q}   8   0.0050   0.0040   0.0100   0.0020  -0.0030   0.0010   1.00   12.3"


def row(time, q=1, text=SOLUTION):
    return f"{time}   {text.format(q=q)}\n"


def rows(count):
    return [row(f"2013/06/19 10:{i // 60:02d}:{i % 60:02d}.200", q=1 + i % 5) for i in range(count)]


@pytest.fixture
def log(tmp_path):
    def read(*parts, start=START):
        (tmp_path / "a.pos").write_bytes("".join(parts).encode())
        return read_log(tmp_path / "a.pos", "rtklib-pos", start=start)

    return read


def refusal(log, *parts, **options):
    with pytest.raises(RunError) as caught:
        log(*parts, **options)
    return str(caught.value).partition("a.pos")[2]


def test_a_row_in_gps_time(log):
    """16 leap seconds in June 2013 (IERS Bulletin C 45)."""
    read = log(HEAD, row("2013/06/19 10:00:16.250"), row("2013/06/19 10:00:17.250", q=2))
    n = read.table.number
    assert n["time_s"].tolist() == [0.25, 1.25]
    assert n["latitude_deg"].tolist() == [35.132114917] * 2
    assert n["longitude_deg"].tolist() == [139.624397290] * 2
    assert n["height_m"].tolist() == [74.1234] * 2
    assert (n["sigma_north_m"][0], n["sigma_east_m"][0], n["sigma_up_m"][0]) == (0.005, 0.004, 0.01)
    assert n["quality"].tolist() == [1, 2]
    assert n["satellites"].tolist() == [8, 8]
    assert "speed_m_s" not in n
    assert not read.summary.suspicious


@pytest.mark.parametrize(
    ("clock", "stamp", "expected"),
    [
        ("GPST", "1745 295216.250", 0.25),
        ("UTC", "2013/06/19 10:00:00.250", 0.25),
        ("JST", "2013/06/19 19:00:00.250", 0.25),
        ("GPST", "721 295216.250", 0.25),  # a week number that rolled over
        ("GPST", "1993/11/03 10:00:16.250", 0.25),
    ],
)
def test_clocks(log, clock, stamp, expected):
    read = log(HEAD.replace("GPST   ", f"{clock}   "), row(stamp))
    assert read.table.number["time_s"].tolist() == [expected]
    assert ("roll-over" in str(read.summary)) == (stamp.startswith(("721", "1993")))


def test_separators_and_line_ends(log):
    plain = log(HEAD, *rows(5)).table.number
    for change in ((" ", "\t"), ("  ", " ; "), ("\n", "\r\n")):
        other = log(
            "\ufeff", HEAD.replace(*change) if change[0] == "\n" else HEAD, *(r.replace(*change) for r in rows(5))
        )
        assert other.summary.broken == 0
        for name in plain:
            np.testing.assert_array_equal(other.table.number[name], plain[name])


def test_velocity_gives_speed_course_and_sigma(log):
    head = HEAD.replace(
        "ratio", "ratio    vn(m/s)    ve(m/s)    vu(m/s)     sdvn     sdve     sdvu    sdvne    sdveu    sdvun"
    )
    moving = SOLUTION + "  3.0 -4.0 0.1  0.2 0.3 0.4 -0.1 0.0 0.0"
    at_rest = SOLUTION + "  0.0 0.0 0.1  0.3 0.4 0.4 0.1 0.0 0.0"
    n = log(
        head, row("2013/06/19 10:00:16.250", text=moving), row("2013/06/19 10:00:17.250", text=at_rest)
    ).table.number
    np.testing.assert_allclose(n["speed_m_s"], [5, 0])
    np.testing.assert_allclose(n["course_deg"], [360 - np.degrees(np.arctan2(4, 3)), np.nan])
    u = np.array([0.6, -0.8])
    covariance = np.array([[0.04, -0.01], [-0.01, 0.09]])
    np.testing.assert_allclose(n["sigma_speed_m_s"], [np.sqrt(u @ covariance @ u), np.sqrt((0.09 + 0.16) / 2)])


def test_heights_above_the_geoid_are_no_ellipsoidal_heights(log):
    read = log(HEAD.replace("WGS84/ellipsoidal", "WGS84/geodetic"), *rows(3))
    assert "height_m" not in read.table.number
    assert "heights are above the geoid" in str(read.summary)


def test_void_broken_and_double_rows(log):
    many = rows(59)
    read = log(
        HEAD,
        row("2013/06/19 09:59:59.250", q=0),
        *many,
        row("2013/06/19 10:00:58.200", q=1, text=SOLUTION.replace("35.", "36.")),
        row("2013/06/19 10:01:30.200").replace("139.6", "139x6"),
        row("2013/06/19 10:01:31.200").replace("35.13", "95.13"),
        "\n",
        row("2013/06/19 10:01:32.200")[:60],
    )
    s = read.summary
    assert (s.fixes, s.void, s.duplicates, s.broken, s.first_broken) == (59, 1, 1, 3, 67)
    np.testing.assert_allclose(read.table.number["latitude_deg"][-1], 36.132114917)  # fixed beats DGPS


REFUSED = {
    "header": (rows(3), ": has no header line that names the clock and the columns"),
    "empty": ([""], ": has no header line"),
    "no rows": ([HEAD], ": holds no fix (0 instants without one; no rows)"),
    "ecef": (
        [HEAD.replace("latitude(deg) longitude(deg)  height(m)", "x-ecef(m) y-ecef(m) z-ecef(m)")],
        ": is in ECEF coordinates; write it with out-solformat = llh",
    ),
    "dms": (
        [HEAD.replace("latitude(deg)", "latitude(d'\")")],
        ": is in degrees, minutes and seconds; write it with out-degform = deg",
    ),
    "column": ([HEAD.replace(" Q ", "   ")], ", column Q: required column is missing"),
    "twice": ([HEAD.replace(" ns ", " Q ")], ", column Q: column stands twice"),
    "change": (
        [HEAD, *rows(3), HEAD.replace("sdn(m)", "sdx(m)")],
        ": columns change within the file ('% GPST latitude(deg)",
    ),
    "backwards": (
        [HEAD, *rows(5), *rows(2)],
        ", row 11: time runs backwards (2013-06-19T09:59:44Z after 2013-06-19T09:59:48Z)",
    ),
    "junk": ([HEAD, "\0\1\2\n" * 50], ": 50 of 50 rows are broken (the first at row 6); is this a log in the format"),
    "one line": ([HEAD, "7" * 100_000], ": holds no fix"),
    "other day": (
        [HEAD, row("2013/08/19 10:00:00.0")],
        ", row 6: the first fix is of 2013-08-19T09:59:44Z, the run starts at",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals(log, name):
    parts, message = REFUSED[name]
    assert message in refusal(log, *parts)


@pytest.mark.parametrize("size", [2048, 5003])
def test_blocks_change_nothing(log, monkeypatch, size):
    parts = [HEAD, *rows(200), "8" * 9000 + "\n", row("2013/06/19 10:09:00")]
    whole = log(*parts)
    monkeypatch.setattr(log_reading, "BLOCK", size)
    monkeypatch.setattr("railnav.io.rtklib.BLOCK", size)
    pieces = log(*parts)
    assert pieces.summary == whole.summary
    assert (whole.summary.fixes, whole.summary.broken) == (201, 1)
    for name, values in whole.table.number.items():
        np.testing.assert_array_equal(pieces.table.number[name], values)


def test_the_real_drive_reads_with_its_inertial_unit(shared_data):
    """Every number against plain Python; and the yaw rate of course and gyroscope agree only when the clocks do."""
    folder = shared_data / "gnss_imu_drive"
    run = read_run(folder)
    lines = (folder / "gnss.pos").read_text().splitlines()[1:]
    assert len(run.gnss) == len(lines) == 2197
    expected = [line.split() for line in lines]
    time = [datetime.strptime(" ".join(e[:2]) + "+0000", "%Y/%m/%d %H:%M:%S.%f%z") - run.start for e in expected]
    np.testing.assert_allclose(run.gnss.time, [(t - timedelta(seconds=18)).total_seconds() for t in time], atol=1e-9)
    number = np.array([[float(x) for x in e[2:]] for e in expected])
    np.testing.assert_array_equal(run.gnss.latitude, np.radians(number[:, 0]))
    np.testing.assert_array_equal(run.gnss.height, number[:, 2])
    np.testing.assert_array_equal(run.gnss.sigma_up, number[:, 7])
    np.testing.assert_array_equal(run.gnss.quality, number[:, 3])
    np.testing.assert_allclose(run.gnss.speed, np.hypot(number[:, 13], number[:, 14]))
    known = ~np.isnan(run.gnss.course)
    stamp, course, speed = run.gnss.time[known], run.gnss.course[known], run.gnss.speed[known]
    moving = (speed[1:] > 3) & (np.diff(stamp) < 0.3)
    rate = np.diff(np.unwrap(course)) / np.diff(stamp)
    middle = (stamp[1:] + stamp[:-1]) / 2
    lags = np.arange(-40, 41) * 0.1
    rising = np.concatenate([[0], np.cumsum(np.diff(run.imu.time) * run.imu.gyro[1:, 2])])

    def agreement(lag):
        ends = (np.interp(middle + side + lag, run.imu.time, rising) for side in (0.125, -0.125))
        gyro = np.subtract(*ends)[moving] / 0.25
        return abs(np.corrcoef(gyro, rate[moving])[0, 1])

    found = [agreement(lag) for lag in lags]
    assert max(found) > 0.95
    assert abs(lags[int(np.argmax(found))]) < 0.15


DATA = (HEAD + "".join(rows(12))).encode()


@settings(max_examples=250, deadline=1000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    edits=st.lists(st.tuples(st.integers(0, len(DATA) - 1), st.binary(max_size=6), st.integers(0, 40)), max_size=8),
    cut=st.integers(0, len(DATA)),
)
def test_a_mutated_file_is_read_or_refused(tmp_path, edits, cut):
    data = bytearray(DATA)
    for place, new, gone in edits:
        data[place : place + gone] = new
    (tmp_path / "a.pos").write_bytes(data[:cut])
    try:
        read = read_log(tmp_path / "a.pos", "rtklib-pos", start=START)
    except RailnavError:
        return
    n = read.table.number
    assert (np.diff(n["time_s"]) > 0).all()
    assert (np.abs(n["latitude_deg"]) <= 90).all()
