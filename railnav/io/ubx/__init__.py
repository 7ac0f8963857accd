"""u-blox binary logs (UBX): NAV-PVT, completed by NAV-COV, NAV-HPPOSLLH and NAV-DOP of the same instant.

Messages may stand among other bytes (NMEA, RTCM). `quality` is stated on the scale of NMEA's GGA: 1 single, 2 differential, 4 fixed,
5 float, 6 dead reckoning. A two-dimensional fix has no height.

Sigmas: NAV-COV where it is valid; else hAcc / sqrt(2) for each horizontal axis, since hAcc bounds both (a fixed solution shows
hAcc = 14 mm beside 10 mm an axis), vAcc, and sAcc for the speed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from railnav.io import _kernels as shared
from railnav.io.log_reading import BLOCK, COLUMNS, ByteArray, Found, Gathered, IntArray, Sink, rank, through
from railnav.io.ubx import _kernels

#: Names of messages that a log without NAV-PVT is likely to hold.
MESSAGES = {
    0x0107: "NAV-PVT",
    0x0136: "NAV-COV",
    0x0114: "NAV-HPPOSLLH",
    0x0104: "NAV-DOP",
    0x0101: "NAV-POSECEF",
    0x0102: "NAV-POSLLH",
    0x0103: "NAV-STATUS",
    0x0106: "NAV-SOL",
    0x0112: "NAV-VELNED",
    0x0121: "NAV-TIMEUTC",
    0x0135: "NAV-SAT",
    0x0213: "RXM-SFRBX",
    0x0215: "RXM-RAWX",
    0x1002: "ESF-MEAS",
    0x1003: "ESF-RAW",
    0x1015: "ESF-INS",
}
_ROOM = 1 << 14


def scan(path: Path, start: int, *, sink: Sink | None = None, part: int = 0) -> Found:  # noqa: ARG001 - the messages state their dates
    """Collect the fixes of a log; with a `sink`, every `part` fixes go there, and the last ones are returned.

    References
    ----------
    u-blox F9 HPG interface description: frame and checksum, NAV-PVT (0x01 0x07), NAV-COV (0x01 0x36), NAV-HPPOSLLH (0x01 0x14), NAV-DOP
    (0x01 0x04). Layouts and scales are those that pyubx2 knows by these names; the tests hold both against each other.
    """
    count = np.zeros(_kernels.UBX_COUNTERS, dtype=np.int64)
    kinds = np.zeros(1 << 16, dtype=np.int64)
    slot = np.zeros((shared.SLOTS, _kernels.U_INTEGERS), dtype=np.int64)
    slot_row = np.full((shared.SLOTS, _kernels.U_NUMBERS), np.nan)
    sums = np.empty((2, BLOCK + 1), dtype=np.uint8)
    out = np.empty((_ROOM, shared.WIDTH))
    stamp = np.empty((_ROOM, 2), dtype=np.int64)
    numbers, stamps = Gathered(COLUMNS), Gathered(("stamp", "byte"))

    def found() -> Found:
        """What is collected, which begins again."""
        byte, stamped = _integers(stamps, "byte"), _integers(stamps, "stamp")
        number = {name: values for name in COLUMNS if (values := numbers.take(name)) is not None}
        numbers.restart()
        stamps.restart()
        return Found(
            file=path,
            format="ubx",
            unit="messages",
            stamp=stamped,
            number=number,
            row=byte,
            better=lambda: rank({name: number[name] for name in number if name != "satellites"}),
            good=int(count[shared.GOOD]),
            broken=int(count[shared.BROKEN]),
            first_broken=int(count[shared.FIRST_BROKEN]) if count[shared.BROKEN] else None,
            void=int(count[shared.VOID]),
            duplicates=int(count[shared.DUPLICATES]),
            counts={_name(int(kind)): int(kinds[kind]) for kind in np.flatnonzero(kinds)},
        )

    def step(data: ByteArray, last: bool) -> int:
        used = 0
        while True:
            more, rows = _kernels.ubx_block(data[used:], last, sums, slot, slot_row, count, kinds, out, stamp)
            numbers.add(out[:rows])
            stamps.add(stamp[:rows])
            used += int(more)
            if sink is not None and numbers.length >= part:
                sink(found())
            if rows < _ROOM - shared.SLOTS:
                return used

    through(path, step)
    return found()


def _integers(stamps: Gathered, name: str) -> IntArray:
    values = stamps.take(name)
    return np.empty(0, dtype=np.int64) if values is None else values


def _name(kind: int) -> str:
    return MESSAGES.get(kind, f"0x{kind >> 8:02X}-0x{kind & 255:02X}")
