"""How fast GNSS logs are read, and in how much memory: NMEA lines, .pos rows and UBX messages a second.

python benchmarks/logs.py [--json] [--peers] [--hours 24] [--stream]

Logs of a receiver at 10 Hz are written to a temporary folder and read in a fresh process each, three times: the first reading
loads the compiled parser. Beside the wall clock stands CPU time, for machines that others use too.
`--stream` turns logs of two sizes into a run folder, piece by piece, and prints the peak memory of each: it must not grow with the log.
`--peers` reads a piece of them with pynmeagps and pyubx2, which parse every field of every message.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import operator
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

START = datetime(2025, 7, 8, tzinfo=UTC)
#: What is asked for, units a second.
LIMITS = {"nmea": 100_000, "rtklib-pos": 500_000, "ubx": 80_000, "gpx": 0}
UNITS = {"nmea": "lines", "rtklib-pos": "rows", "ubx": "messages", "gpx": "points"}
RATE = 10


def sentence(text: str) -> str:
    """Close a sentence with its checksum."""
    return f"${text}*{functools.reduce(operator.xor, text.encode(), 0):02X}\r\n"


def nmea(i: int) -> tuple[int, bytes]:
    """One epoch of a receiver with RMC, VTG, GGA, GST and three GSV."""
    at = START + timedelta(seconds=i / RATE)
    clock, date = at.strftime("%H%M%S.%f")[:9], at.strftime("%d%m%y")
    place = f"47{23 + 1e-6 * (i % 1000):09.6f},N,019{2 + 1e-6 * (i % 777):09.6f},E"
    lines = [
        sentence(f"GNRMC,{clock},A,{place},{i % 60}.512,{i % 360}.21,{date},,,D,V"),
        sentence(f"GNVTG,{i % 360}.21,T,,M,{i % 60}.512,N,18.5,K,D"),
        sentence(f"GNGGA,{clock},{place},2,12,0.81,118.893,M,43.669,M,1.0,0000"),
        sentence(f"GNGST,{clock},21,1.2,0.9,33,0.81,0.92,1.73"),
        *(sentence(f"GPGSV,3,{k},12,03,03,111,30,04,15,270,31,06,01,010,22,13,06,292,28,1") for k in (1, 2, 3)),
    ]
    return len(lines), "".join(lines).encode()


def pos(i: int) -> tuple[int, bytes]:
    """One row with velocity, as the real drive in shared/data has them."""
    week, second = divmod((START - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds() + 18 + i / RATE, 604_800)
    text = (
        f"{week:.0f} {second:.3f} {40.0966268 + 1e-7 * (i % 1000):.9f} {-105.1474483:.9f} 1601.474 1 21 "
        "0.0098995 0.0098995 0.0100000 0.0000000 0.0000000 0.0000000 0.0 0.0 "
        f"{math.cos(i):.7f} {math.sin(i):.7f} 0.0090000 0.0586899 0.0586899 0.0586899 0.0000000 0.0000000 0.0000000\n"
    )
    return 1, text.encode()


def frame(number: int, payload: bytes) -> bytes:
    """Close a UBX message with its checksum."""
    body = bytes([1, number]) + struct.pack("<H", len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes([a, b])


def ubx(i: int) -> tuple[int, bytes]:
    """One epoch of NAV-PVT, NAV-DOP and NAV-COV."""
    at = START + timedelta(seconds=i / RATE)
    itow = i * 1000 // RATE
    pvt = struct.pack(
        "<IHBBBBBBIiBBBBiiiiIIiiiiiIIHHIihH",
        *(itow, at.year, at.month, at.day, at.hour, at.minute, at.second, 7, 20, at.microsecond * 1000, 3, 131, 0, 21),
        *(-1_051_474_483, 400_966_268 + i % 1000, 1_601_474, 1_618_000, 14, 10, 3000, -4000, 0, 5000, 30_687_000, 83),
        *(100_000, 120, 0, 0, 0, 0, 0),
    )
    dop = struct.pack("<I7H", itow, 120, 110, 60, 90, 61, 40, 40)
    cov = struct.pack("<IBBB9x12f", itow, 0, 1, 1, 0.04, 0, 0, 0.09, 0, 0.25, 0.01, 0, 0, 0.01, 0, 0.01)
    return 3, frame(0x07, pvt) + frame(0x04, dop) + frame(0x36, cov)


def gpx(i: int) -> tuple[int, bytes]:
    """One point."""
    at = (START + timedelta(seconds=i / RATE)).strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3]
    inner = (
        f"<ele>118.9</ele><time>{at}Z</time><geoidheight>43.7</geoidheight><fix>3d</fix><sat>9</sat><hdop>0.8</hdop>"
    )
    return 1, f'<trkpt lat="47.{i % 1000:07d}" lon="19.0">{inner}</trkpt>\n'.encode()


MAKERS = {"nmea": nmea, "rtklib-pos": pos, "ubx": ubx, "gpx": gpx}
POS_HEAD = (
    "%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio "
    "vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun\n"
)
HEADS = {"rtklib-pos": POS_HEAD, "gpx": '<gpx version="1.1"><trk><trkseg>\n'}
TAILS = {"gpx": "</trkseg></trk></gpx>"}


def parts(name: str, epochs: int) -> Iterator[tuple[int, bytes]]:
    yield 0, HEADS.get(name, "").encode()
    for i in range(epochs):
        yield MAKERS[name](i)
    yield 0, TAILS.get(name, "").encode()


def read(name: str, path: str) -> None:
    """Read a log twice in this process and print the times and the peak memory."""
    import resource

    from railnav.io.gnss_log import read_log

    times, cpu = [], []
    log = None
    for _ in range(3):
        del log
        begin, began = time.perf_counter(), time.process_time()
        log = read_log(path, name, start=START)
        times.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - began)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        json.dumps(
            {"times": times, "cpu": cpu, "fixes": log.summary.fixes, "peak_mb": peak, "broken": log.summary.broken}
        )
    )


def convert(path: str, output: str) -> None:
    """Turn a log into a run folder in this process, and print the time and the peak memory."""
    import resource

    from railnav.io.logs import convert_log

    began = time.process_time()
    fixes, _ = convert_log(path, output)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"cpu_s": round(time.process_time() - began, 2), "peak_mb": round(peak), "fixes": fixes}))


def stream(hours: float) -> dict[str, Any]:
    """Peak memory of converting an NMEA log of `hours`, and one ten times as long."""
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for factor in (1, 10):
            path = Path(folder, f"log{factor}.nmea")
            with path.open("wb") as file:
                for _, data in parts("nmea", round(hours * factor * 3600 * RATE)):
                    file.write(data)
            command = [sys.executable, __file__, "--convert", str(path), str(Path(folder, f"run{factor}"))]
            got = json.loads(
                subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]
            )
            figures[f"{path.stat().st_size / 1e6:.0f} MB"] = got
            path.unlink()
    return figures


def peer(name: str, path: Path) -> float | None:
    """Units a second of the usual Python reader, over the first 2 MB."""
    import io

    head = path.read_bytes()[:2_000_000]
    if name == "nmea":
        from pynmeagps import NMEAReader as Reader
    elif name == "ubx":
        from pyubx2 import UBXReader as Reader
    else:
        return None
    begin = time.perf_counter()
    count = sum(1 for _ in Reader(io.BytesIO(head), quitonerror=0))
    return count / (time.perf_counter() - begin)


def main() -> None:
    """Measure, and print words or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--peers", action="store_true")
    parser.add_argument("--hours", type=float, default=6.0)
    parser.add_argument("--stream", action="store_true")
    parser.add_argument("--read", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--convert", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.read:
        read(*options.read)
        return
    if options.convert:
        convert(*options.convert)
        return
    if options.stream:
        streamed = stream(options.hours)
        if options.json:
            print(json.dumps({"benchmark": "logs, streamed", "figures": streamed}, indent=2))
        for size, got in () if options.json else streamed.items():
            print(
                f"nmea of {size} into a run folder: {got['fixes']:,} fixes, {got['cpu_s']} s of CPU, peak {got['peak_mb']} MB"
            )
        return
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in MAKERS:
            path = Path(folder, "log")
            units = 0
            with path.open("wb") as file:
                for count, data in parts(name, round(options.hours * 3600 * RATE)):
                    units += count
                    file.write(data)
            command = [sys.executable, __file__, "--read", name, str(path)]
            got = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
            best = min(got["times"])
            figures[name] = {
                "megabytes": round(path.stat().st_size / 1e6, 1),
                UNITS[name]: units,
                "fixes": got["fixes"],
                "first_s": round(got["times"][0], 3),
                "best_s": round(best, 3),
                "per_second": round(units / best),
                "per_cpu_second": round(units / min(got["cpu"])),
                "limit_per_second": LIMITS[name],
                "peak_mb": round(got["peak_mb"]),
                "peer_per_second": round(speed) if options.peers and (speed := peer(name, path)) else None,
            }
    if options.json:
        print(json.dumps({"benchmark": "logs", "rate_hz": RATE, "hours": options.hours, "figures": figures}, indent=2))
        return
    for name, f in figures.items():
        beside = f"   usual reader {f['peer_per_second']:,}" if f["peer_per_second"] else ""
        print(
            f"{name:<11} {f['megabytes']:7.1f} MB  {f[UNITS[name]]:>9,} {UNITS[name]:<9} {f['best_s']:7.3f} s  "
            f"{f['per_second']:>10,}/s, {f['per_cpu_second']:,} a CPU second "
            f"(limit {f['limit_per_second']:,})  peak {f['peak_mb']} MB{beside}"
        )


if __name__ == "__main__":
    main()
