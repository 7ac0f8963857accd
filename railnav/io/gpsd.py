"""gpsd's JSON, a report a line (`gpspipe -w`): TPV reports are fixes, SKY reports their satellites and HDOP.

`height_m` is `altHAE`, the height above the ellipsoid; `alt` of gpsd before 3.20 is above mean sea level and left out. `quality` is
on the scale of NMEA's GGA. The error estimates (epx, epy, epv, eps) are left out: gpsd's own description calls their certainty unknown.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from railnav.io import gnss_time
from railnav.io.log_reading import COLUMNS, Found, Gathered, Sink, rank

_ROWS = 1 << 14
#: A line longer than this is no report.
_MAX_LINE = 1 << 20
#: gpsd's status on the scale of GGA: differential, fixed, float, dead reckoning (and with GNSS), surveyed, simulated, military.
_STATUS = {2: 2.0, 3: 4.0, 4: 5.0, 5: 6.0, 6: 6.0, 7: 7.0, 8: 8.0, 9: 3.0}


def scan(path: Path, start: int, *, sink: Sink | None = None, part: int = 0) -> Found:  # noqa: ARG001 - reports state their dates
    """Collect the fixes of a log; with a `sink`, every `part` fixes go there, and the last ones are returned.

    References
    ----------
    gpsd_json(5): classes TPV and SKY.
    """
    import msgspec

    decode = msgspec.json.Decoder().decode
    numbers, instants = Gathered(COLUMNS), Gathered(("stamp", "row"))
    rows: list[list[float]] = []
    stamps: list[tuple[int, int]] = []
    counts: dict[str, int] = {}
    broken = void = good = above_sea = 0
    first_broken: int | None = None
    sky = (np.nan, np.nan)

    def flush() -> None:
        nonlocal rows, stamps
        if rows:
            numbers.add(np.array(rows))
            instants.add(np.array(stamps, dtype=np.int64))
            rows, stamps = [], []

    def found() -> Found:
        flush()
        stamp, row = instants.take("stamp"), instants.take("row")
        number = {name: values for name in COLUMNS if (values := numbers.take(name)) is not None}
        numbers.restart()
        instants.restart()
        none = np.empty(0, dtype=np.int64)
        return Found(
            file=path,
            format="gpsd",
            unit="reports",
            stamp=none if stamp is None else stamp,
            number=number,
            row=none if row is None else row,
            better=lambda: rank(number),
            good=good,
            broken=broken,
            first_broken=first_broken,
            void=void,
            counts=dict(counts),
        )

    with path.open("rb") as file:
        number_of = 0
        while line := file.readline(_MAX_LINE):
            number_of += 1
            text = line.strip()
            if not text:
                continue
            try:
                report = decode(text)
                kind = report["class"] if isinstance(report, dict) else None
            except (msgspec.DecodeError, UnicodeDecodeError, KeyError, RecursionError):
                kind = None
            if not isinstance(kind, str):
                broken += 1
                first_broken = first_broken or number_of
                continue
            good += 1
            counts[kind[:20]] = counts.get(kind[:20], 0) + 1
            if kind == "SKY":
                sky = _sky(report)
            if kind != "TPV":
                continue
            if _number(report, "mode") not in (2.0, 3.0):
                void += 1
                continue
            row = _fix(report, sky)
            time = report.get("time")
            stamp = gnss_time.instant(time) if isinstance(time, str) else None
            if row is None or stamp is None:
                broken += 1
                good -= 1
                first_broken = first_broken or number_of
                continue
            above_sea += "altHAE" not in report and ("alt" in report or "altMSL" in report)
            rows.append(row)
            stamps.append((stamp, number_of))
            if len(rows) == _ROWS:
                flush()
                if sink is not None and numbers.length >= part:
                    sink(found())
    last = found()
    if above_sea:
        last.notes.append(f"{above_sea} heights are above mean sea level, without altHAE, and are left out")
    return last


def _number(report: dict[str, Any], key: str) -> float:
    value = report.get(key)
    known = isinstance(value, int | float) and not isinstance(value, bool) and -1e15 < value < 1e15
    return float(value) if known else np.nan  # type: ignore[arg-type]


def _sky(report: dict[str, Any]) -> tuple[float, float]:
    used = _number(report, "uSat")
    satellites = report.get("satellites")
    if np.isnan(used) and isinstance(satellites, list):
        used = float(sum(isinstance(each, dict) and each.get("used") is True for each in satellites))
    return used, _number(report, "hdop")


def _fix(report: dict[str, Any], sky: tuple[float, float]) -> list[float] | None:
    """A row in the order of COLUMNS, or None where the report is no position."""
    latitude, longitude = _number(report, "lat"), _number(report, "lon")
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        return None
    status = _number(report, "status")
    speed = _number(report, "speed")
    row = dict.fromkeys(COLUMNS, np.nan) | {
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "height_m": _number(report, "altHAE") if _number(report, "mode") == 3.0 else np.nan,
        "speed_m_s": speed if speed >= 0.0 else np.nan,
        "course_deg": _number(report, "track"),
        "quality": 1.0 if np.isnan(status) else _STATUS.get(int(status), 1.0),
        "satellites": sky[0],
        "hdop": sky[1],
    }
    return list(row.values())
