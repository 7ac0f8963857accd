"""Bare logs: told by their bytes, turned into one another piece by piece, gpsd, TCP, ROS, the inertial data of UBX."""

from __future__ import annotations

import functools
import json
import math
import operator
import os
import socket
import struct
import threading
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from railnav.errors import InputError, RunError
from railnav.io.gnss_log import read_log, stream_log
from railnav.io.log_writers import writer_for
from railnav.io.logs import convert_log, log_format, read_bare_log
from railnav.io.run import read_run, write_run
from railnav.io.tcp_log import is_address, record
from railnav.run import GnssStream, Run

START = datetime(2025, 7, 8, 23, 59, 58, tzinfo=UTC)
COUNT = 50


def fixes(count=COUNT, seed=1):
    random = np.random.default_rng(seed)
    return GnssStream(
        np.arange(count) * 0.2,
        np.radians(47.5 + np.cumsum(random.normal(0, 1e-6, count))),
        np.radians(-19.1 + np.cumsum(random.normal(0, 1e-6, count))),
        height=100 + random.normal(0, 1, count),
        sigma_east=random.uniform(0.5, 2, count),
        sigma_north=random.uniform(0.5, 2, count),
        sigma_up=random.uniform(1, 4, count),
        speed=random.uniform(0, 30, count),
        course=random.uniform(0, 2 * np.pi, count),
        quality=random.choice([1.0, 2.0, 4.0, 5.0], count),
        satellites=random.integers(5, 20, count).astype(float),
        hdop=random.uniform(0.6, 2, count),
    )


@pytest.fixture
def folder(tmp_path):
    write_run(Run("drive", START, gnss=fixes()), tmp_path / "drive")
    return tmp_path / "drive"


#: What each format carries of a fix: column and how exactly.
CARRIED = {
    "nmea": {"latitude": 3e-11, "longitude": 3e-11, "height": 1e-4, "sigma_east": 1e-4, "sigma_up": 1e-4, "speed": 1e-4,
             "course": 1e-5, "quality": 0, "satellites": 0, "hdop": 0.01},
    "pos": {"latitude": 1e-11, "longitude": 1e-11, "height": 1e-4, "sigma_east": 1e-4, "sigma_north": 1e-4, "sigma_up": 1e-4,
            "satellites": 0},
    "gpx": {"latitude": 1e-12, "longitude": 1e-12, "height": 1e-4, "satellites": 0, "hdop": 0.01},
    "csv": {"latitude": 1e-12, "longitude": 1e-12, "height": 1e-5, "sigma_east": 1e-5, "speed": 1e-6, "course": 1e-7,
            "quality": 0, "satellites": 0, "hdop": 1e-3},
}  # fmt: skip


@pytest.mark.parametrize("ending", CARRIED)
def test_a_run_becomes_a_log_and_comes_back(folder, tmp_path, ending):
    truth = read_run(folder).gnss
    out = tmp_path / f"log.{ending}"
    count, notes = convert_log(folder, out)
    assert (count, notes) == (COUNT, ())
    if ending == "csv":
        (tmp_path / "again").mkdir()
        (tmp_path / "again" / "run.toml").write_text(
            f'[run]\nid = "a"\nstart = "{START.isoformat()}"\n[gnss]\nfile = "gnss.csv"\n'
        )
        out.rename(tmp_path / "again" / "gnss.csv")
        run = read_run(tmp_path / "again")
    else:
        run, _ = read_bare_log(out)
    got = run.gnss
    shift = (run.start - START).total_seconds()
    assert np.abs(got.time + shift - truth.time).max() < 1e-6
    for name, within in CARRIED[ending].items():
        assert np.abs(getattr(got, name) - getattr(truth, name)).max() <= within, name


def test_logs_through_every_format(folder, tmp_path):
    """nmea -> gpx -> run folder -> pos -> nmea: position and time survive all of it."""
    truth = read_run(folder).gnss
    convert_log(folder, tmp_path / "a.nmea")
    convert_log(tmp_path / "a.nmea", tmp_path / "b.gpx")
    convert_log(tmp_path / "b.gpx", tmp_path / "c")
    assert read_run(tmp_path / "c").gnss.height is not None
    convert_log(tmp_path / "a.nmea", tmp_path / "d.pos")
    convert_log(tmp_path / "d.pos", tmp_path / "e.nmea")
    for end in ("c", "e.nmea"):
        run = read_run(tmp_path / end) if end == "c" else read_bare_log(tmp_path / end)[0]
        assert np.abs(run.gnss.latitude - truth.latitude).max() < 1e-10
        assert np.abs(run.gnss.time + (run.start - START).total_seconds() - truth.time).max() < 1e-3
    quality = read_bare_log(tmp_path / "e.nmea")[0].gnss.quality
    assert (quality == truth.quality).all()  # on GGA's scale again after RTKLIB's


def test_pieces_are_the_whole(folder, tmp_path):
    """A log read piece by piece, across midnight, is the log read at once."""
    for ending, kind in (("nmea", "nmea"), ("pos", "rtklib-pos"), ("gpx", "gpx")):
        out = tmp_path / f"log.{ending}"
        convert_log(folder, out)
        many = out.with_name("many." + ending)
        body = out.read_text()
        if ending == "nmea":
            many.write_text("".join(body for _ in range(1)))
        whole = read_log(out, kind, start=START).table
        stamps, latitude, calls = [], [], []
        summary = stream_log(
            out,
            kind,
            lambda stamp, columns, s=stamps, a=latitude, c=calls: (
                s.append(stamp),
                a.append(columns["latitude_deg"]),
                c.append(1),
            ),
            part=7,
        )
        assert summary.fixes == whole.length
        assert (np.concatenate(latitude) == whole.number["latitude_deg"]).all()
        begin = int(START.timestamp()) * 10**9
        assert np.abs((np.concatenate(stamps) - begin) / 1e9 - whole.number["time_s"]).max() < 1e-9


def test_what_a_log_is(tmp_path):
    for name, head, kind in (
        ("a.log", b"$GPGGA,1", "nmea"),
        ("b.txt", b"\xb5\x62\x01\x07", "ubx"),
        ("c.log", b"% program   : RTKPOST\n", "rtklib-pos"),
        ("d.log", b'<?xml version="1.0"?><gpx version="1.1">', "gpx"),
        ("e.log", b'{"class":"VERSION"}\n', "gpsd"),
        ("f.log", b"\x89MCAP0\r\n", "bag"),
        ("g.log", b"nothing", None),
        ("h.csv", b"$GPGGA", None),
    ):
        (tmp_path / name).write_bytes(head)
        assert log_format(tmp_path / name) == kind, name
    with pytest.raises(RunError, match="log of no known format; name it with --format"):
        read_bare_log(tmp_path / "g.log")


def test_a_log_without_a_date_needs_its_start(tmp_path):
    text = "$GPGGA,172814.0,3723.46587704,N,12202.26957864,W,2,6,1.2,18.893,M,-25.669,M,2.0,0031*4F\r\n"
    (tmp_path / "a.nmea").write_text(text)
    with pytest.raises(RunError, match="no sentence states the date; say when the log starts"):
        read_bare_log(tmp_path / "a.nmea")
    with pytest.raises(RunError, match="no sentence states the date"):
        convert_log(tmp_path / "a.nmea", tmp_path / "a.gpx")
    run, notes = read_bare_log(tmp_path / "a.nmea", start=datetime(2026, 5, 4, 17, 28, tzinfo=UTC))
    assert run.gnss.time.tolist() == [14.0]
    assert "states the date" in notes[0]


def test_a_roll_over_is_put_right_when_the_start_is_known(folder, tmp_path):
    convert_log(folder, tmp_path / "a.nmea")
    old = START - timedelta(weeks=1024)
    text = (tmp_path / "a.nmea").read_bytes().decode()
    lines = []
    for line in text.split("\r\n"):
        for day in (START, START + timedelta(days=1)):
            line = line.replace(f",{day:%d%m%y},", f",{day - timedelta(weeks=1024):%d%m%y},")
        body = line[1:].partition("*")[0]
        lines.append(f"${body}*{functools.reduce(operator.xor, body.encode(), 0):02X}" if body else "")
    (tmp_path / "old.nmea").write_text("\r\n".join(lines), newline="")
    os.utime(tmp_path / "old.nmea", (START.timestamp() + 3600,) * 2)
    run, notes = read_bare_log(tmp_path / "old.nmea")
    assert run.start.date() == old.date()
    assert "its dates lie 1024 weeks before the file was written" in notes[-1]
    count, notes = convert_log(tmp_path / "old.nmea", tmp_path / "b.gpx", start=START)
    assert count == COUNT
    assert "displaced by a GPS week roll-over and were moved by +1024 weeks" in notes[0]
    assert read_bare_log(tmp_path / "b.gpx")[0].start == START


def test_what_a_format_cannot_hold_is_counted(tmp_path):
    lean = GnssStream(
        np.arange(3.0),
        np.radians([47.0, 47.0, 47.0]),
        np.radians([19.0, 19.0, 19.0]),
        height=np.array([1.0, np.nan, 3.0]),
    )
    write_run(Run("lean", START, gnss=lean), tmp_path / "lean")
    with pytest.raises(RunError, match="no fix that this format can hold"):
        convert_log(tmp_path / "lean", tmp_path / "a.pos")
    assert not (tmp_path / "a.pos").exists()
    convert_log(tmp_path / "lean", tmp_path / "a.nmea")
    back = read_bare_log(tmp_path / "a.nmea")[0].gnss
    assert np.isnan(back.height).tolist() == [False, True, False]
    writer = writer_for(tmp_path / "b.pos", tmp_path / "b.pos", 0)
    one = {
        name: np.array([1.0, 1.0])
        for name in ("latitude_deg", "longitude_deg", "sigma_east_m", "sigma_north_m", "sigma_up_m")
    }
    writer.add(np.array([0, 10**9]), {**one, "height_m": np.array([np.nan, 5.0])})
    writer.close()
    assert writer.fixes == 1
    assert writer.notes == ["1 fixes without a height left out"]


def test_a_clock_that_runs_back_is_refused_across_pieces(folder, tmp_path):
    convert_log(folder, tmp_path / "a.gpx")
    text = (tmp_path / "a.gpx").read_text()
    points = text[text.index("<trkpt") : text.index("</trkseg>")]
    (tmp_path / "twice.gpx").write_text(text.replace(points, points + points))
    with pytest.raises(RunError, match="time runs backwards"):
        stream_log(tmp_path / "twice.gpx", "gpx", lambda stamp, columns: None, part=COUNT)


# --- gpsd, TCP --------------------------------------------------------------------------------------------------------


def reports(count=10):
    lines = ['{"class":"VERSION","release":"3.25"}', '{"class":"SKY","uSat":9,"hdop":0.8}']
    for i in range(count):
        time = (START + timedelta(seconds=i)).isoformat().replace("+00:00", "") + ".500Z"
        tpv = {"class": "TPV", "mode": 3, "time": time, "lat": 47.5 + 1e-5 * i, "lon": 19.1, "altHAE": 150.25, "alt": 107.0,
               "speed": 12.5, "track": 90.25, "status": 2, "epx": 3.1}  # fmt: skip
        lines.append(json.dumps(tpv))
    lines.insert(5, json.dumps({"class": "TPV", "mode": 1}))
    return "\n".join(lines) + "\n"


def test_gpsd_reports(tmp_path):
    (tmp_path / "a.gpsd").write_text(reports())
    log = read_log(tmp_path / "a.gpsd", "gpsd", start=START)
    number = log.table.number
    assert log.summary.fixes == 10
    assert log.summary.void == 1
    assert number["time_s"].tolist() == [i + 0.5 for i in range(10)]
    assert number["height_m"].tolist() == [150.25] * 10
    assert number["course_deg"][0] == 90.25
    assert number["quality"].tolist() == [2.0] * 10
    assert number["satellites"].tolist() == [9.0] * 10
    assert "sigma_east_m" not in number
    (tmp_path / "old.gpsd").write_text(reports().replace('"altHAE": 150.25, ', ""))
    old = read_log(tmp_path / "old.gpsd", "gpsd", start=START)
    assert "height_m" not in old.table.number
    assert "above mean sea level" in old.summary.notes[0]
    (tmp_path / "bad.gpsd").write_text(
        reports(40).replace('"lat": 47.50001', '"lat": 147.50001') + '{"class":"TPV","mode":3'
    )
    bad = read_log(tmp_path / "bad.gpsd", "gpsd", start=START)
    assert bad.summary.broken == 2


@pytest.fixture
def sender():
    """A server that sends what it is given, once, and closes; keeps what it was told."""
    server = socket.create_server(("127.0.0.1", 0))
    told = []

    def serve(data, *, listen=False):
        def run():
            link, _ = server.accept()
            with link:
                if listen:
                    told.append(link.recv(100))
                link.sendall(data)

        threading.Thread(target=run, daemon=True).start()
        return server.getsockname()[1], told

    yield serve
    server.close()


def test_a_log_over_tcp(folder, tmp_path, sender):
    convert_log(folder, tmp_path / "a.nmea")
    port, _ = sender((tmp_path / "a.nmea").read_bytes())
    assert record(f"tcp://127.0.0.1:{port}", tmp_path / "b.log") == (tmp_path / "a.nmea").stat().st_size
    run, _ = read_bare_log(tmp_path / "b.log")
    assert len(run.gnss) == COUNT


def test_gpsd_is_asked_to_watch(tmp_path, sender):
    port, told = sender(reports().encode(), listen=True)
    record(f"gpsd://127.0.0.1:{port}", tmp_path / "b.log")
    assert told == [b'?WATCH={"enable":true,"json":true};\n']
    assert len(read_bare_log(tmp_path / "b.log")[0].gnss) == 10


def test_addresses_that_do_not_answer(tmp_path, sender):
    assert is_address("tcp://a:1")
    assert not is_address("a.nmea")
    for address, words in (
        ("tcp://127.0.0.1:1", "cannot be reached"),
        ("tcp://127.0.0.1", "is no address"),
        ("tcp://127.0.0.1:99999", "is no address"),
    ):
        with pytest.raises(RunError, match=words):
            record(address, tmp_path / "x")
    port, _ = sender(b"")
    with pytest.raises(RunError, match="sends nothing"):
        record(f"tcp://127.0.0.1:{port}", tmp_path / "x")


# --- UBX inertial -----------------------------------------------------------------------------------------------------


def frame(kind, number, payload):
    body = bytes([kind, number]) + struct.pack("<H", len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes([a, b])


def pvt(second, latitude=475_000_000):
    at = START + timedelta(seconds=second)
    return frame(0x01, 0x07, struct.pack(
        "<IHBBBBBBIiBBBBiiiiIIiiiiiIIHHIihH",
        *(int(second * 1000), at.year, at.month, at.day, at.hour, at.minute, at.second, 7, 20, at.microsecond * 1000, 3, 131, 0, 21),
        *(190_000_000, latitude, 1_601_474, 1_618_000, 14, 10, 0, 0, 0, 5000, 30_687_000, 83),
        *(100_000, 120, 0, 0, 0, 0, 0),
    ))  # fmt: skip


def word(kind, value):
    return struct.pack("<I", (kind << 24) | (int(value) & 0xFFFFFF))


def inertial_log(seconds=30, rate=50, tag0=123_456, up=9.81, message=0x03):
    random = np.random.default_rng(4)
    out, truth = [], []
    for i in range(seconds * rate):
        at = i / rate
        if i % rate == 0:
            out.append(pvt(i // rate))
        rates = np.radians([0.5 * math.sin(at), -0.25, 2.0 * math.cos(at)])
        force = np.array([0.3, -0.1 * math.sin(at), up])
        truth.append((at, *rates, *force))
        words = [(14, math.degrees(rates[0]) * 4096), (13, math.degrees(rates[1]) * 4096), (5, math.degrees(rates[2]) * 4096),
                 (16, force[0] * 1024), (17, force[1] * 1024), (18, force[2] * 1024), (12, 2500)]  # fmt: skip
        tag = tag0 + round(at * 1000)
        if message == 0x03:
            payload = b"\0" * 4 + b"".join(word(k, round(v)) + struct.pack("<I", tag) for k, v in words)
        else:
            words.append((11, -2500))
            payload = struct.pack("<IHH", tag, len(words) << 11, 0) + b"".join(word(k, round(v)) for k, v in words)
        if random.random() < 0.98:
            out.append(frame(0x10, message, payload))
        else:
            truth.pop()
    return b"".join(out), np.array(truth)


@pytest.mark.parametrize("message", [0x03, 0x02])
def test_inertial_samples_of_ubx(tmp_path, message):
    data, truth = inertial_log(message=message)
    (tmp_path / "a.ubx").write_bytes(data)
    run, notes = read_bare_log(tmp_path / "a.ubx")
    assert len(run.gnss) == 30
    imu = run.imu
    assert len(imu) == len(truth)
    assert np.abs(imu.time - truth[:, 0]).max() < 0.021  # the delay to the epoch before: within one sample here
    assert np.abs(imu.gyro - truth[:, 1:4]).max() < math.radians(2.0**-13) * 1.01
    assert np.abs(imu.specific_force - truth[:, 4:7]).max() < 2.0**-11 * 1.01
    assert imu.mounting.tolist() == [math.pi, 0.0, 0.0]  # z points up
    assert any("points up" in note for note in notes)
    if message == 0x02:
        assert run.odometer.signed
        assert np.unique(run.odometer.speed).tolist() == [-2.5]
    convert_log(tmp_path / "a.ubx", tmp_path / "run")
    again = read_run(tmp_path / "run")
    assert len(again.imu) == len(truth)


def test_a_run_folder_names_the_log_for_every_stream(tmp_path):
    data, truth = inertial_log(message=0x02)
    (tmp_path / "a.ubx").write_bytes(data)
    streams = "".join(f'[{name}]\nfile = "a.ubx"\nformat = "ubx"\n' for name in ("gnss", "imu", "odometer"))
    toml = f'[run]\nid = "a"\nstart = "{START.isoformat()}"\n{streams}signed = true\n'
    (tmp_path / "run.toml").write_text(toml)
    run = read_run(tmp_path)
    assert len(run.imu) == len(truth)
    assert run.odometer.speed[0] == -2.5
    (tmp_path / "a.ubx").write_bytes(b"".join(pvt(i) for i in range(5)))
    with pytest.raises(RunError, match=r"has no data for \[imu\] \(no ESF-RAW or ESF-MEAS\); leave the stream out"):
        read_run(tmp_path)


def test_broken_frames_are_left_out(tmp_path):
    data, truth = inertial_log(seconds=5)
    data = bytearray(data)
    data[2000] ^= 0xFF
    (tmp_path / "a.ubx").write_bytes(bytes(data))
    run, _ = read_bare_log(tmp_path / "a.ubx")
    assert len(run.imu) == len(truth) - 1


# --- ROS --------------------------------------------------------------------------------------------------------------


def write_bag(path, *, two=False, stamped=True):
    pytest.importorskip("rosbags", reason="rosbags is not installed (extra bags)")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    t = store.types
    vector, header, time = t["geometry_msgs/msg/Vector3"], t["std_msgs/msg/Header"], t["builtin_interfaces/msg/Time"]
    second = int(START.timestamp())
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        fix = writer.add_connection("/gnss", "sensor_msgs/msg/NavSatFix", typestore=store)
        imu = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
        other = writer.add_connection("/imu2", "sensor_msgs/msg/Imu", typestore=store) if two else None
        for i in range(100):
            stamp = time(sec=second + i // 10 if stamped else 0, nanosec=i % 10 * 10**8 if stamped else 0)
            head = header(stamp=stamp, frame_id="")
            ns = second * 10**9 + i * 10**8
            if i % 10 == 0:
                status = t["sensor_msgs/msg/NavSatStatus"](status=2 if i else -1, service=1)
                message = t["sensor_msgs/msg/NavSatFix"](
                    header=head, status=status, latitude=47.5, longitude=19.1 + 1e-5 * i, altitude=150.0,
                    position_covariance=np.diag([0.04, 0.09, 0.25]).ravel(), position_covariance_type=2,
                )  # fmt: skip
                writer.write(fix, ns, store.serialize_cdr(message, fix.msgtype))
            message = t["sensor_msgs/msg/Imu"](
                header=head,
                orientation=t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
                orientation_covariance=np.zeros(9),
                angular_velocity=vector(0.01, 0.02, 0.03),
                angular_velocity_covariance=np.zeros(9),
                linear_acceleration=vector(0.1, 0.2, 9.81),
                linear_acceleration_covariance=np.zeros(9),
            )
            writer.write(imu, ns, store.serialize_cdr(message, imu.msgtype))
            if other is not None:
                writer.write(other, ns, store.serialize_cdr(message, other.msgtype))


def test_ros_recordings(tmp_path):
    write_bag(tmp_path / "bag")
    for source in (tmp_path / "bag", next((tmp_path / "bag").glob("*.mcap"))):
        run, notes = read_bare_log(source)
        assert run.start == START
        assert len(run.gnss) == 9
        assert run.gnss.sigma_east.tolist() == pytest.approx([0.2] * 9)
        assert run.gnss.quality.tolist() == [4.0] * 9
        assert notes == ("1 fixes without a position left out",)
        assert run.imu.time[:3].tolist() == pytest.approx([0.0, 0.1, 0.2])
        assert run.imu.gyro[0].tolist() == [0.01, -0.02, -0.03]  # forward, left, up -> forward, right, down
        assert run.imu.specific_force[0].tolist() == [0.1, -0.2, -9.81]
    count, _ = convert_log(tmp_path / "bag", tmp_path / "run")
    assert count == 9
    assert read_run(tmp_path / "run").imu.specific_force[5].tolist() == [0.1, -0.2, -9.81]


def test_ros_recordings_that_are_refused(tmp_path):
    write_bag(tmp_path / "two", two=True)
    with pytest.raises(RunError, match="several topics of sensor_msgs/msg/Imu: /imu, /imu2; choose with --topic"):
        read_bare_log(tmp_path / "two")
    assert read_bare_log(tmp_path / "two", topics=["/imu2", "/gnss"])[0].imu is not None
    with pytest.raises(RunError, match="has no topic '/x'"):
        read_bare_log(tmp_path / "two", topics=["/x"])
    write_bag(tmp_path / "zero", stamped=False)
    with pytest.raises(RunError, match="no time in their header"):
        read_bare_log(tmp_path / "zero")
    mcap = next((tmp_path / "two").glob("*.mcap"))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(mcap.read_bytes()[: mcap.stat().st_size // 2])
    with pytest.raises(InputError, match="is no whole recording"):
        read_bare_log(cut)
