r"""NMEA 0183 logs: GGA, GNS, RMC, GLL, GST, VTG and ZDA of one instant make one fix.

Sentences may stand among other bytes (binary messages, time stamps of a logger): one begins at a `$`. Any talker is read (GN, GP,
GL, GA, GB, ...). Where two talkers state a position for one instant, the better kind of fix, then the one with more satellites
is kept. A VTG has no time of its own and belongs to the sentence before it.

Height is that above the geoid plus the separation that the same sentence states; where it states none there is no height, since an
assumed geoid would be a default in silence.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from railnav.io import _kernels as shared
from railnav.io import gnss_time
from railnav.io.log_reading import BLOCK, COLUMNS, NO_DATE, ByteArray, Found, Gathered, IntArray, Sink, rank, through
from railnav.io.nmea import _kernels

#: Sentences that are used, in the order of their counters.
SENTENCES = ("GGA", "GNS", "RMC", "GLL", "GST", "VTG", "ZDA", "other")

_CHECKED = re.compile(rb"\$[A-Z0-9]{3,5},[^\r\n$*]*\*[0-9A-Fa-f]{2}")
_SHORTEST = 24  # bytes of a sentence that can open an epoch


def scan(path: Path, start: int, *, sink: Sink | None = None, part: int = 0) -> Found:
    """Collect the fixes of a log; `start` (ns since 1970) gives the day where no sentence does.

    With a `sink`, every `part` fixes go there as they come; the last ones are returned.

    References
    ----------
    NMEA 0183 version 4.11, sentences GGA, GLL, GNS, GST, RMC, VTG, ZDA; checksum: exclusive or of all bytes between $ and *.
    """
    count = np.zeros(_kernels.NMEA_COUNTERS, dtype=np.int64)
    count[_kernels.LAST_DAY] = count[_kernels.CURRENT] = -1
    slot = np.zeros((shared.SLOTS, _kernels.S_INTEGERS), dtype=np.int64)
    slot_row = np.full((shared.SLOTS, _kernels.S_NUMBERS), np.nan)
    out = np.empty((BLOCK // _SHORTEST // 4, shared.WIDTH))
    stamp = np.empty((len(out), 3), dtype=np.int64)
    numbers, stamps = Gathered(COLUMNS), Gathered(("time", "day", "row"))
    checked = _has_checksums(path)
    clock: list[tuple[int, int]] = []  # time of day and day of the last fix that a sink took

    def found() -> Found:
        """What is collected, which begins again."""
        row = _integers(stamps, "row")
        of_day, day = _integers(stamps, "time"), _integers(stamps, "day")
        number = {name: values for name in COLUMNS if (values := numbers.take(name)) is not None}
        numbers.restart()
        stamps.restart()
        now = Found(
            file=path,
            format="nmea",
            unit="sentences",
            stamp=of_day,
            number=number,
            row=row,
            better=lambda: rank(number),
            good=int(count[shared.GOOD]),
            broken=int(count[shared.BROKEN]),
            first_broken=int(count[shared.FIRST_BROKEN]) if count[shared.BROKEN] else None,
            void=int(count[shared.VOID]),
            duplicates=int(count[shared.DUPLICATES]),
            counts={name: int(count[shared.KINDS + k]) for k, name in enumerate(SENTENCES)},
        )
        if len(of_day):
            before = len(clock)
            full = np.append([time for time, _ in clock], of_day).astype(np.int64)
            day, stated = gnss_time.days(full, np.append([d for _, d in clock], day).astype(np.int64), start)
            clock[:] = [(int(of_day[-1]), int(day[-1]))]
            now.stamp = day[before:] * gnss_time.DAY + of_day
            if not stated:
                now.notes.append(f"{NO_DATE}; the day nearest to run.start was taken")
        return now

    def step(data: ByteArray, last: bool) -> int:
        used = 0
        while True:
            more, rows = _kernels.nmea_block(data[used:], last, checked, slot, slot_row, count, out, stamp)
            numbers.add(out[:rows])
            stamps.add(stamp[:rows])
            used += int(more)
            if sink is not None and numbers.length >= part:
                sink(found())
            if rows < len(out) - shared.SLOTS:
                return used

    through(path, step)
    last = found()
    if count[_kernels.NO_HEIGHT]:
        last.notes.append(
            f"{count[_kernels.NO_HEIGHT]} heights above the geoid come without its separation and are left out"
        )
    if not checked and last.good:
        last.notes.append("its sentences have no checksums and were taken as they are")
    return last


def _integers(stamps: Gathered, name: str) -> IntArray:
    values = stamps.take(name)
    return np.empty(0, dtype=np.int64) if values is None else values


def _has_checksums(path: Path) -> bool:
    """Whether the head of the log has a sentence with a checksum: then one without is a torn one."""
    with path.open("rb") as file:
        return _CHECKED.search(file.read(BLOCK)) is not None
