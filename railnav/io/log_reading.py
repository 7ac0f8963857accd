"""What the readers of GNSS logs share: what they collect on the way, columns that grow, and reading by blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ByteArray = NDArray[np.uint8]

#: Bytes read at a time.
BLOCK = 1 << 21
#: What a reader notes where the log never says which day it is.
NO_DATE = "no sentence states the date"

#: Kinds of fix (GGA quality), larger is better: RTK, float, differential, single, dead reckoning.
QUALITY_ORDER = {4: 6, 5: 5, 2: 4, 3: 4, 9: 4, 1: 3, 6: 2, 7: 1, 8: 1}

#: Columns of a log, in the units of the table of formats; the kernels write them in this order.
COLUMNS = (
    "latitude_deg",
    "longitude_deg",
    "height_m",
    "sigma_east_m",
    "sigma_north_m",
    "sigma_up_m",
    "speed_m_s",
    "course_deg",
    "sigma_speed_m_s",
    "quality",
    "satellites",
    "hdop",
)


@dataclass(slots=True)
class Found:
    """What a reader collects on its way through a log; `gnss_log.settle` turns it into a GnssLog.

    `stamp` is in ns since 1970, on GPS time where `gps_time`, else UTC. `better` ranks fixes
    of one instant, larger is better, and is only asked where there are such.
    """

    file: Path
    format: str
    unit: str
    stamp: IntArray
    number: dict[str, FloatArray]
    row: IntArray
    better: Callable[[], FloatArray]
    gps_time: bool = False
    good: int = 0
    broken: int = 0
    first_broken: int | None = None
    void: int = 0
    duplicates: int = 0
    counts: Mapping[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


#: Takes what a reader has collected so far; it begins again after that.
Sink = Callable[["Found"], None]


def rank(number: Mapping[str, FloatArray], order: Mapping[int, int] = QUALITY_ORDER) -> FloatArray:
    """Order fixes of one instant: by kind of fix (`order` of the quality), satellites, smaller HDOP, smaller sigma."""
    better = np.zeros(len(number["latitude_deg"]))
    if "quality" in number:
        for value, place in order.items():
            better[number["quality"] == value] = place * 1e9
    for name, weight, unknown, limit in (
        ("satellites", 1e6, 0.0, 999.0),
        ("hdop", -1e3, 99.0, 99.0),
        ("sigma_east_m", -1.0, 99.0, 99.0),
    ):
        if name in number:
            better += weight * np.clip(np.nan_to_num(number[name], nan=unknown), 0, limit)
    return better


class Gathered:
    """Columns that grow block by block; a column that stays empty costs nothing.

    A column grows in place where the system can move its pages, so that it never stands in memory twice.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.names = tuple(names)
        self.columns: dict[str, NDArray[Any]] = {}
        self.length = 0

    def add(self, rows: NDArray[Any]) -> None:
        """Keep a copy of rows (k, columns)."""
        end = self.length + len(rows)
        for name, new in zip(self.names, rows.T, strict=True):
            column = self.columns.get(name)
            if column is None:
                if len(rows) == 0 or (rows.dtype.kind == "f" and bool(np.isnan(new).all())):
                    continue
                column = self.columns[name] = np.empty(end, dtype=rows.dtype)
                column[: self.length] = 0 if rows.dtype.kind == "i" else np.nan
            if end > len(column):
                column.resize(max(end, len(column) + len(column) // 2), refcheck=False)  # nobody else holds it
            column[self.length : end] = new
        self.length = end

    def restart(self) -> None:
        """Begin again with nothing; what was not taken is forgotten."""
        self.columns, self.length = {}, 0

    def take(self, name: str) -> NDArray[Any] | None:
        """Give a whole column away; None where it holds nothing."""
        column = self.columns.pop(name, None)
        if column is not None:
            column.resize(self.length, refcheck=False)
        return column


def through(path: Path, step: Callable[[ByteArray, bool], int]) -> None:
    """Lead a file through `step` block by block.

    `step(bytes, last)` uses what it can from the front and says how much; the rest comes again with more behind it. It must use
    everything of the last block, and all but a small part of a full one.
    """
    store = bytearray(BLOCK)
    buffer: ByteArray = np.frombuffer(store, dtype=np.uint8)
    held = 0
    with path.open("rb") as file:
        while True:
            got = file.readinto(memoryview(store)[held:])
            used = step(buffer[: held + got], got == 0)
            if got == 0:
                return
            held = held + got - used
            if held == BLOCK:
                raise AssertionError("a step must use up a full block")  # else this would never end
            buffer[:held] = buffer[used : used + held].copy()
