"""RTKLIB solution files (.pos): positions with their sigmas, and velocities where they were written.

The header says what the columns are and on which clock the rows are: GPST (turned to UTC with leap seconds), UTC or JST. `quality`
is RTKLIB's own Q: 1 fixed, 2 float, 3 SBAS, 4 differential, 5 single, 6 PPP.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RunError
from railnav.io import _kernels as shared
from railnav.io import gnss_time
from railnav.io.log_reading import BLOCK, COLUMNS, ByteArray, Found, Gathered, IntArray, Sink, rank, through
from railnav.io.rtklib import _kernels

#: Kinds of fix (Q), larger is better.
ORDER = {1: 6, 2: 5, 6: 4, 4: 3, 3: 2, 5: 1}

_MEANING = {
    "latitude(deg)": shared.LAT,
    "longitude(deg)": shared.LON,
    "height(m)": shared.HEIGHT,
    "Q": shared.QUALITY,
    "ns": shared.SATELLITES,
    "sdn": shared.SIGMA_N,
    "sde": shared.SIGMA_E,
    "sdu": shared.SIGMA_U,
    "vn": _kernels.P_NORTH,
    "ve": _kernels.P_EAST,
    "sdvn": _kernels.P_SIGMA_NORTH,
    "sdve": _kernels.P_SIGMA_EAST,
    "sdvne": _kernels.P_COVARIANCE,
}
_REQUIRED = ("latitude(deg)", "longitude(deg)", "Q")
_CLOCKS = ("GPST", "UTC", "JST")
_JST = 9 * 3600 * gnss_time.SECOND
_SEPARATOR = re.compile(r"[\s,;]+")
_COMMENT = re.compile(rb"^[ \t]*%[^\n]*\n", re.M)
_HEAD = 1 << 16
_SHORTEST = 64  # bytes of a row
_OTHER_COORDINATES = {
    "x-ecef(m)": "is in ECEF coordinates; write it with out-solformat = llh",
    "e-baseline(m)": "holds baselines to a base station; write it with out-solformat = llh",
    "latitude(d'\")": "is in degrees, minutes and seconds; write it with out-degform = deg",
}


def scan(path: Path, start: int, *, sink: Sink | None = None, part: int = 0) -> Found:  # noqa: ARG001 - the file knows its dates
    """Collect the fixes of a solution file; with a `sink`, every `part` fixes go there, and the last ones are returned.

    References
    ----------
    RTKLIB 2.4.2 manual, appendix B.1: solution file; sdne and its like are signed roots of covariances.
    """
    header, height = _header(path)
    names = _names(header)
    meaning = np.full(2 + len(names) - 1, -1, dtype=np.int64)
    for place, name in enumerate(names[1:], start=2):
        plain = name if name in _REQUIRED or name == "height(m)" else name.partition("(")[0]
        meaning[place] = _MEANING.get(plain, -1)
    if not height:
        meaning[meaning == shared.HEIGHT] = -1
    count = np.zeros(_kernels.POS_COUNTERS, dtype=np.int64)
    out = np.empty((BLOCK // _SHORTEST // 4, _kernels.P_NUMBERS))
    stamp = np.empty((len(out), 2), dtype=np.int64)
    numbers, stamps = Gathered(COLUMNS), Gathered(("stamp", "row"))

    def found() -> Found:
        """What is collected, which begins again."""
        stamped, row = _integers(stamps, "stamp"), _integers(stamps, "row")
        number = {name: values for name in COLUMNS if (values := numbers.take(name)) is not None}
        numbers.restart()
        stamps.restart()
        return Found(
            file=path,
            format="rtklib-pos",
            unit="rows",
            stamp=stamped - _JST if names[0] == "JST" else stamped,
            number=number,
            row=row,
            better=lambda: rank(number, ORDER),
            gps_time=names[0] == "GPST",
            good=int(count[shared.GOOD]),
            broken=int(count[shared.BROKEN]),
            first_broken=int(count[shared.FIRST_BROKEN]) if count[shared.BROKEN] else None,
            void=int(count[shared.VOID]),
            counts={"rows": int(count[shared.GOOD])},
        )

    def step(data: ByteArray, last: bool) -> int:
        text = data.tobytes()
        for other in _COMMENT.findall(text) if b"%" in text else ():
            line = other.decode("latin-1")
            if _is_header(line) and _names(line) != names:
                cause = f"columns change within the file ({_short(line)})"
                raise RunError(cause, file=path, remedy="split it where another solution begins")
        used = 0
        while True:
            more, rows = _kernels.pos_block(data[used:], last, meaning, count, out, stamp)
            numbers.add(out[:rows, : shared.WIDTH])
            stamps.add(stamp[:rows])
            used += int(more)
            if sink is not None and numbers.length >= part:
                sink(found())
            if rows < len(out):
                return used

    through(path, step)
    last_part = found()
    if not height:
        last_part.notes.append("its heights are above the geoid, without its separation, and are left out")
    return last_part


def _integers(stamps: Gathered, name: str) -> IntArray:
    values: NDArray[np.int64] | None = stamps.take(name)
    return np.empty(0, dtype=np.int64) if values is None else values


def _names(header: str) -> list[str]:
    return [name for name in _SEPARATOR.split(header.strip().lstrip("%")) if name]


def _is_header(line: str) -> bool:
    names = _names(line)
    return len(names) > 3 and names[0] in _CLOCKS


def _short(line: str) -> str:
    return repr(" ".join(line.split())[:60])


def _header(path: Path) -> tuple[str, bool]:
    """Give the line that names the columns, and whether heights are ellipsoidal."""
    with path.open("rb") as file:
        head = file.read(_HEAD).removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    height = True
    for line in head.splitlines():
        if not line.lstrip().startswith("%"):
            if line.strip():
                break
            continue
        if "/geodetic" in line.lower():
            height = False
        if not _is_header(line):
            continue
        names = _names(line)
        for name, cause in _OTHER_COORDINATES.items():
            if name in names:
                what, _, remedy = cause.partition("; ")
                raise RunError(what, file=path, remedy=remedy)
        for name in _REQUIRED:
            if names.count(name) != 1:
                cause = "required column is missing" if name not in names else "column stands twice"
                raise RunError(cause, file=path, column=name, remedy="write it again with RTKLIB")
        return line, height
    cause = "has no header line that names the clock and the columns (% GPST latitude(deg) ...)"
    raise RunError(cause, file=path, remedy="write it with out-outhead = on, or name the right format")
