"""GNSS logs out: NMEA 0183, RTKLIB .pos, GPX, CSV; row by row, so that a log of any size can be turned into another.

Each writer takes pieces of fixes in the units of the table of formats. What a format cannot hold is left out, and counted in `notes`.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from railnav.io import gnss_time
from railnav.io.log_reading import COLUMNS

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Endings of logs that can be written.
WRITTEN_ENDINGS = (".nmea", ".pos", ".gpx", ".csv")
#: Kinds of fix on RTKLIB's scale by those of GGA, and back.
_RTKLIB = {1: 5, 2: 4, 3: 6, 4: 1, 5: 2, 6: 5, 7: 5, 8: 5, 9: 3}
_GGA = {1: 4, 2: 5, 3: 2, 4: 2, 5: 1, 6: 3}
_GPX_FIX = {1: "3d", 2: "dgps", 3: "pps", 4: "dgps", 5: "dgps", 9: "dgps"}
_KNOT = 1852.0 / 3600.0


def to_gga(quality: FloatArray) -> FloatArray:
    """Kinds of fix of RTKLIB (1 fixed ... 5 single) on the scale of NMEA's GGA (1 single ... 4 fixed)."""
    return np.array([np.nan if np.isnan(q) else _GGA.get(int(q), 1) for q in quality.tolist()], np.float64)


class Writer:
    """A log being written; `add` pieces, then `close`."""

    def __init__(self, path: Path) -> None:
        self.file: IO[str] = path.open("w", encoding="utf-8", newline="")
        self.left_out: dict[str, int] = {}
        self.fixes = 0

    @property
    def notes(self) -> list[str]:
        """What was left out, one sentence each."""
        return [f"{count} fixes {why} left out" for why, count in self.left_out.items() if count]

    def add(self, stamp: IntArray, columns: Mapping[str, FloatArray]) -> None:
        """Write fixes: stamps, ns since 1970 UTC, and columns of `railnav.io.log_reading.COLUMNS`."""
        self.fixes += len(stamp)
        self.rows(stamp, columns)

    def rows(self, stamp: IntArray, columns: Mapping[str, FloatArray]) -> None:
        """Write the rows of one piece."""
        raise NotImplementedError

    def skip(self, why: str) -> None:
        """Count a fix that the format cannot hold."""
        self.left_out[why] = self.left_out.get(why, 0) + 1
        self.fixes -= 1

    def close(self) -> None:
        """Write what stands at the end."""
        self.file.close()


def _each(stamp: IntArray, columns: Mapping[str, FloatArray], unit: int) -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """Moment, to `unit` ns, and cells of each fix, in the order of `COLUMNS`; None in a column that is not there."""
    cells = [columns[name].tolist() if name in columns else [None] * len(stamp) for name in COLUMNS]
    return zip(_moments((stamp + unit // 2) // unit * unit), zip(*cells, strict=True), strict=True)


def _moments(stamp: IntArray) -> Iterator[tuple[datetime, int, int]]:
    """Midnight, second of the day and ns of the second."""
    day = np.int64(-1)
    base = datetime(1970, 1, 1, tzinfo=UTC)
    whole = stamp // gnss_time.SECOND
    for second, rest in zip(whole.tolist(), (stamp - whole * gnss_time.SECOND).tolist(), strict=True):
        if second // 86_400 != day:
            day = second // 86_400
            midnight = base + timedelta(days=day)
        yield midnight, second % 86_400, rest


def _closed(text: str) -> str:
    return f"${text}*{functools.reduce(operator.xor, text.encode(), 0):02X}\r\n"


def _known(value: float | None) -> bool:
    return value is not None and value == value


class NmeaWriter(Writer):
    """NMEA 0183: GGA and RMC, and GST where sigmas are known; times to the millisecond.

    Altitudes are the heights above the ellipsoid with a separation of 0: their sum is right, and no geoid is assumed.
    """

    def rows(self, stamp: IntArray, columns: Mapping[str, FloatArray]) -> None:
        """Write the rows of one piece."""
        write = self.file.write
        for (midnight, second, rest), row in _each(stamp, columns, 1_000_000):
            latitude, longitude, height, east, north, up, speed, course, _, quality, satellites, hdop = row
            clock = f"{second // 3600:02d}{second % 3600 // 60:02d}{second % 60:02d}.{rest // 1_000_000:03d}"
            place = f"{_minutes(latitude, 2)},{'N' if latitude >= 0 else 'S'},{_minutes(longitude, 3)},{'E' if longitude >= 0 else 'W'}"
            kind = int(quality) if _known(quality) else 1
            used = f"{int(satellites):02d}" if _known(satellites) else ""
            tall = f"{height:.4f},M,0.0,M" if _known(height) else ",M,,M"
            dop = f"{hdop:.2f}" if _known(hdop) else ""
            run = f"{speed / _KNOT:.4f}" if _known(speed) else ""
            way = f"{course % 360.0:.4f}" if _known(course) else ""
            mode = {2: "D", 4: "R", 5: "F", 6: "E", 7: "M", 8: "S", 3: "P", 9: "D"}.get(kind, "A")
            write(_closed(f"GNRMC,{clock},A,{place},{run},{way},{midnight:%d%m%y},,,{mode}"))
            write(_closed(f"GNGGA,{clock},{place},{kind},{used},{dop},{tall},,"))
            if _known(east) and _known(north):
                write(_closed(f"GNGST,{clock},,,,,{north:.4f},{east:.4f},{f'{up:.4f}' if _known(up) else ''}"))


def _minutes(degrees: float, width: int) -> str:
    """Degrees and minutes with 7 decimals, 0.2 mm."""
    total = round(abs(degrees) * 60e7)
    whole, rest = divmod(total, 600_000_000)
    return f"{whole:0{width}d}{rest / 1e7:010.7f}"


class PosWriter(Writer):
    """RTKLIB .pos, in UTC; a row needs a height and three sigmas, as the format has no empty cells."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.file.write(
            "% program   : railnav\n% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)\n"
        )
        self.file.write(
            "%  UTC                   latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)"
        )
        self.file.write("  sdeu(m)  sdun(m) age(s)  ratio\n")

    def rows(self, stamp: IntArray, columns: Mapping[str, FloatArray]) -> None:
        """Write the rows of one piece."""
        write = self.file.write
        for (midnight, second, rest), row in _each(stamp, columns, 1_000_000):
            latitude, longitude, height, east, north, up, _, _, _, quality, satellites, _ = row
            if not _known(height):
                self.skip("without a height")
                continue
            if not (_known(east) and _known(north) and _known(up)):
                self.skip("without sigmas")
                continue
            kind = _RTKLIB.get(int(quality), 5) if _known(quality) else 5
            clock = f"{second // 3600:02d}:{second % 3600 // 60:02d}:{second % 60:02d}.{rest // 1_000_000:03d}"
            used = int(satellites) if _known(satellites) else 0
            write(
                f"{midnight:%Y/%m/%d} {clock} {latitude:14.9f} {longitude:14.9f} {height:10.4f} {kind:3d} {used:3d} "
                f"{north:8.4f} {east:8.4f} {up:8.4f}   0.0000   0.0000   0.0000   0.00    0.0\n"
            )


class GpxWriter(Writer):
    """GPX 1.1: one track segment; heights as `ele` with a `geoidheight` of 0, so that their sum is the ellipsoidal height."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.file.write('<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="railnav" ')
        self.file.write('xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>\n')

    def rows(self, stamp: IntArray, columns: Mapping[str, FloatArray]) -> None:
        """Write the rows of one piece."""
        write = self.file.write
        for (midnight, second, rest), row in _each(stamp, columns, 1000):
            latitude, longitude, height, _, _, _, _, _, _, quality, satellites, hdop = row
            clock = f"{second // 3600:02d}:{second % 3600 // 60:02d}:{second % 60:02d}"
            part = f".{rest // 1000:06d}".rstrip("0").rstrip(".")
            inner = f"<ele>{height:.4f}</ele>" if _known(height) else ""
            inner += f"<time>{midnight:%Y-%m-%d}T{clock}{part}Z</time>"
            inner += "<geoidheight>0</geoidheight>" if _known(height) else ""
            kind = _GPX_FIX.get(int(quality)) if _known(quality) else None
            kind = "2d" if kind == "3d" and not _known(height) else kind
            inner += f"<fix>{kind}</fix>" if kind else ""
            inner += f"<sat>{int(satellites)}</sat>" if _known(satellites) else ""
            inner += f"<hdop>{hdop:.2f}</hdop>" if _known(hdop) else ""
            write(f'<trkpt lat="{latitude:.10f}" lon="{longitude:.10f}">{inner}</trkpt>\n')

    def close(self) -> None:
        """Write what stands at the end."""
        self.file.write("</trkseg></trk></gpx>\n")
        super().close()


class CsvWriter(Writer):
    """The `gnss` table of a run folder, all columns; empty cells where nothing is known.

    Parameters
    ----------
    path : Path
        File to write.
    start : int
        Start of the run, ns since 1970 UTC: `time_s` counts from here.
    """

    _DECIMALS: ClassVar[dict[str, int]] = dict(zip(COLUMNS, (10, 10, 5, 5, 5, 5, 6, 6, 6, 0, 0, 3), strict=True))

    def __init__(self, path: Path, start: int) -> None:
        super().__init__(path)
        self.start = start
        self.file.write(",".join(["time_s", *COLUMNS]) + "\n")

    def rows(self, stamp: IntArray, columns: Mapping[str, FloatArray]) -> None:
        """Write the rows of one piece."""
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        nothing = np.full(len(stamp), np.nan)
        values: dict[str, Any] = {"time_s": np.round((stamp - self.start) / gnss_time.SECOND, 6)}
        values |= {name: np.round(columns.get(name, nothing), d) + 0.0 for name, d in self._DECIMALS.items()}
        table = pa.table({name: pa.array(column, mask=np.isnan(column)) for name, column in values.items()})
        self.file.flush()
        arrow_csv.write_csv(table, self.file.buffer, arrow_csv.WriteOptions(include_header=False))  # type: ignore[attr-defined]


def writer_for(path: Path, draft: Path, start: int) -> Writer:
    """The writer of an ending; it writes to `draft`, the place where `path` is prepared."""
    makers: dict[str, Any] = {".nmea": NmeaWriter, ".pos": PosWriter, ".gpx": GpxWriter}
    maker = makers.get(path.suffix.lower())
    return CsvWriter(draft, start) if maker is None else maker(draft)
