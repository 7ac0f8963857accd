"""GPX 1.0 and 1.1 tracks: points of all tracks and segments in the order of the file.

`ele` of a GPX file is the height above mean sea level: with the point's own `geoidheight` it becomes an ellipsoidal height, without
it there is none. `quality` is stated on the scale of NMEA's GGA: 1 for 2d and 3d, 2 for dgps, 3 for pps. Way points and routes are
no recording and are left alone. A document type is refused: entities are of no use here, and a means of attack.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat  # document types are refused, so that there are no entities to expand

import numpy as np

from railnav.errors import RunError
from railnav.io import gnss_time
from railnav.io.log_reading import COLUMNS, Found, Gathered, Sink, rank

_BLOCK = 1 << 18
_ROWS = 1 << 14
#: Elements may lie this deep in one another, and text may be this long.
_MAX_DEPTH = 50
_MAX_TEXT = 1000
_QUALITY = {"none": 0.0, "2d": 1.0, "3d": 1.0, "dgps": 2.0, "pps": 3.0}
_NUMBERS = {"ele", "geoidheight", "sat", "hdop", "speed", "course"}
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?", re.ASCII)


class _Track:
    """Handlers of the parser: what is known of the point that is open, and the points before it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.parser = expat.ParserCreate(namespace_separator=" ")
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self.start
        self.parser.EndElementHandler = self.end
        self.parser.CharacterDataHandler = self.text
        self.parser.StartDoctypeDeclHandler = self.doctype
        self.depth = 0
        self.point: dict[str, str] | None = None
        self.row = 0
        self.name = ""
        self.words: list[str] = []
        self.length = 0
        self.count = 0
        self.void = 0
        self.no_height = 0
        self.rows: list[list[float]] = []
        self.stamps: list[tuple[int, int]] = []
        self.numbers, self.instants = Gathered(COLUMNS), Gathered(("stamp", "row"))

    def refuse(self, cause: str, *, column: str | None = None, remedy: str | None = None) -> NoReturn:
        row = self.row if self.point is not None else self.parser.CurrentLineNumber
        raise RunError(cause, file=self.path, row=row, column=column, remedy=remedy)

    def doctype(self, *_: object) -> None:
        self.refuse("has a document type, which GPX needs not", remedy="remove the line that starts with <!DOCTYPE")

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        name = tag.rpartition(" ")[2]
        if self.depth == 0 and name != "gpx":
            self.refuse(f"is no GPX file (it holds {name[:40]!r})", remedy="name the right format")
        self.depth += 1
        if self.depth > _MAX_DEPTH:
            self.refuse(f"elements lie more than {_MAX_DEPTH} deep in one another")
        if name == "trkpt":
            if self.point is not None:
                self.refuse("a trkpt lies within another")
            self.row = self.parser.CurrentLineNumber
            self.point = {key: attributes[key] for key in ("lat", "lon") if key in attributes}
        self.name, self.words, self.length = name, [], 0

    def text(self, words: str) -> None:
        if self.point is not None and self.length <= _MAX_TEXT:
            self.words.append(words)
            self.length += len(words)

    def end(self, tag: str) -> None:
        self.depth -= 1
        name = tag.rpartition(" ")[2]
        if self.point is None:
            return
        if name == "trkpt":
            self.close(self.point)
            self.point = None
        elif name == self.name and (name in _NUMBERS or name in ("time", "fix")):
            self.point.setdefault(name, "".join(self.words).strip())
        self.name = ""

    def close(self, point: dict[str, str]) -> None:
        self.count += 1
        latitude, longitude = self.number(point, "lat", 90.0), self.number(point, "lon", 180.0)
        for name, value in (("lat", latitude), ("lon", longitude)):
            if np.isnan(value):
                self.refuse("is missing", column=name, remedy="remove the point")
        if "time" not in point:
            self.refuse("is missing", column="time", remedy="a route that was drawn is no log: record one")
        quality = _QUALITY.get(point.get("fix", "").lower(), np.nan)
        if quality == 0.0:
            self.void += 1
            return
        above, separation = self.number(point, "ele"), self.number(point, "geoidheight")
        if not np.isnan(above) and np.isnan(separation):
            self.no_height += 1
        speed = self.number(point, "speed")
        if speed < 0:
            self.refuse(f"{point['speed']!r} is negative", column="speed", remedy="leave the element out")
        row = dict.fromkeys(COLUMNS, np.nan) | {
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": above + separation,
            "speed_m_s": speed,
            "course_deg": self.number(point, "course"),
            "quality": quality,
            "satellites": self.number(point, "sat"),
            "hdop": self.number(point, "hdop"),
        }
        self.rows.append(list(row.values()))
        self.stamps.append((self.stamp(point["time"]), self.row))
        if len(self.rows) == _ROWS:
            self.flush()

    def flush(self) -> None:
        if self.rows:
            self.numbers.add(np.array(self.rows))
            self.instants.add(np.array(self.stamps, dtype=np.int64))
            self.rows, self.stamps = [], []

    def number(self, point: dict[str, str], name: str, limit: float = 1e12) -> float:
        text = point.get(name, "").strip()
        if not text:
            return float("nan")
        if not _NUMBER.fullmatch(text):
            self.refuse(f"{text[:40]!r} is not a number", column=name, remedy="correct it or leave the element out")
        value = float(text)
        if not abs(value) <= limit:
            self.refuse(f"{text[:40]} is outside -{limit:g} to {limit:g}", column=name, remedy="correct it")
        return value

    def stamp(self, text: str) -> int:
        stamp = gnss_time.instant(text)
        if stamp is None:
            remedy = "write UTC, as in 2021-06-29T10:35:17.25Z"
            self.refuse(f"{text[:40]!r} is no instant", column="time", remedy=remedy)
        return stamp


def scan(path: Path, start: int, *, sink: Sink | None = None, part: int = 0) -> Found:  # noqa: ARG001 - the points state their dates
    """Collect the points of a track; with a `sink`, every `part` points go there, and the last ones are returned.

    References
    ----------
    GPX 1.1 schema, topografix.com/GPX/1/1: wptType. `speed` and `course` are of GPX 1.0 and of common extensions (m/s, degrees
    from true north).
    """
    track = _Track(path)
    parse: Callable[[bytes, bool], int] = track.parser.Parse
    try:
        with path.open("rb") as file:
            while block := file.read(_BLOCK):
                parse(block, False)
                if sink is not None and track.numbers.length >= part:
                    sink(_found(track))
            parse(b"", True)
    except expat.ExpatError as error:
        cause = f"is no well-formed XML ({expat.ErrorString(error.code)})"
        remedy = "was the recording cut off? Close its elements, or record again"
        raise RunError(cause, file=path, row=error.lineno, remedy=remedy) from error
    except (LookupError, ValueError, UnicodeError) as error:
        raise RunError(
            f"its encoding is not known ({str(error)[:80]})", file=path, remedy="save it as UTF-8"
        ) from error
    track.flush()
    last = _found(track)
    if track.no_height:
        last.notes.append(f"{track.no_height} heights above sea level come without geoidheight and are left out")
    return last


def _found(track: _Track) -> Found:
    """What is collected, which begins again."""
    stamp, row = track.instants.take("stamp"), track.instants.take("row")
    number = {name: values for name in COLUMNS if (values := track.numbers.take(name)) is not None}
    track.instants.restart()
    track.numbers.restart()
    none = np.empty(0, dtype=np.int64)
    return Found(
        file=track.path,
        format="gpx",
        unit="points",
        stamp=none if stamp is None else stamp,
        number=number,
        row=none if row is None else row,
        better=lambda: rank(number),
        good=track.count,
        void=track.void,
        counts={"trkpt": track.count},
    )
