"""Clocks of GNSS logs: GPS time and UTC, leap seconds, days that roll over at midnight and weeks that roll over after 1,024.

Instants are int64 nanoseconds since 1970-01-01, counted without leap seconds as POSIX does: equal stamps are equal instants, and no
digit of a log is lost. A stamp within a leap second falls on the second that follows it.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]

SECOND = 1_000_000_000
DAY = 86_400 * SECOND
#: A ten-bit week number counts to here and starts again.
ROLL_OVER = 1024 * 7 * DAY
#: A log that starts further than this from the run's start is not of this run, or its clock is wrong.
MAX_FROM_START = 7 * DAY
#: A log displaced by whole roll-overs is put right when it then starts this near to the run's start.
MAX_AFTER_SHIFT = DAY

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_GPS_EPOCH = 3657 * DAY  # 1980-01-06

#: Days (UTC) at whose beginning GPS time went ahead of UTC by one more second: IERS Bulletin C. None has been announced since.
LEAP_DAYS = (
    (1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7),
    (1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1),
)  # fmt: skip
_TIME = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d):(\d\d)(?:[.,](\d{1,9})\d*)?(Z|[+-]\d\d:?\d\d)?", re.ASCII
)  # without a zone: UTC, as GPX says


def nanoseconds(instant: datetime) -> int:
    """Give an aware instant in ns since 1970, exactly."""
    return (instant.astimezone(UTC) - _EPOCH) // timedelta(microseconds=1) * 1000


def instant(text: str) -> int | None:
    """Give an ISO 8601 instant with its zone (UTC where it names none) in ns since 1970; None if it is none of 1980 to 2199."""
    match = _TIME.fullmatch(text)
    if not match:
        return None
    year, month, day, hour, minute, second = (int(part) for part in match.groups()[:6])
    if second > 60 or not 1980 <= year < 2200:
        return None
    try:
        start = nanoseconds(datetime(year, month, day, hour, minute, tzinfo=UTC))
    except ValueError:
        return None
    fraction = int((match[7] or "").ljust(9, "0"))
    zone = match[8] or "Z"
    east = 0 if zone == "Z" else (int(zone[1:3]) * 60 + int(zone[-2:])) * (-60 if zone[0] == "-" else 60)
    return start + (second - east) * SECOND + fraction


def calendar(stamp: int) -> str:
    """Give a stamp as text to the second, UTC; outside the calendar as seconds."""
    try:
        return (_EPOCH + timedelta(seconds=int(stamp) // SECOND)).strftime("%Y-%m-%dT%H:%M:%SZ")
    except OverflowError:
        return f"{int(stamp) / SECOND:.0f} s since 1970"


def _leap_starts() -> IntArray:
    utc = [nanoseconds(datetime(year, month, 1, tzinfo=UTC)) for year, month in LEAP_DAYS]
    return np.array([stamp + (count + 1) * SECOND for count, stamp in enumerate(utc)], dtype=np.int64)


def gps_to_utc(stamp: IntArray) -> IntArray:
    """Turn stamps that read GPS time into UTC.

    Parameters
    ----------
    stamp : (m,) array of int64
        ns since 1970 as a clock on GPS time shows them.

    Returns
    -------
    (m,) array of int64
        ns since 1970, UTC. Within a leap second, the second that follows it.

    References
    ----------
    IS-GPS-200, 20.3.3.5.2.4: GPS time equals UTC on 1980-01-06 and has no leap seconds; IERS Bulletin C names them.

    Examples
    --------
    >>> noon = np.array([nanoseconds(datetime(2025, 7, 8, 12, 0, 18, tzinfo=UTC))])
    >>> calendar(gps_to_utc(noon)[0])
    '2025-07-08T12:00:00Z'
    """
    leap = np.searchsorted(_leap_starts(), stamp, side="right")
    return np.asarray(stamp - leap * SECOND, dtype=np.int64)


def gps_week(week: IntArray, of_week: IntArray) -> IntArray:
    """Turn full GPS weeks and ns of the week into stamps on GPS time, ns since 1970."""
    return np.asarray(_GPS_EPOCH + week * (7 * DAY) + of_week, dtype=np.int64)


def roll_overs(stamp: int, start: int) -> int:
    """Say how many roll-overs of 1,024 weeks put a stamp back near the run's start; 0 where none does.

    Parameters
    ----------
    stamp, start : int
        First fix of the log and start of the run, ns since 1970.

    Returns
    -------
    int
        To add, in units of `ROLL_OVER`. Receivers whose firmware is older than 19.6 years are behind: 1.

    Examples
    --------
    >>> roll_overs(nanoseconds(datetime(2003, 1, 5, tzinfo=UTC)), nanoseconds(datetime(2022, 8, 21, 1, tzinfo=UTC)))
    1
    """
    count = round((start - stamp) / ROLL_OVER)
    return count if abs(stamp + count * ROLL_OVER - start) <= MAX_AFTER_SHIFT else 0


def days(of_day: IntArray, day: IntArray, start: int) -> tuple[IntArray, bool]:
    """Complete the days of stamps that state the time of day and not always the date.

    Parameters
    ----------
    of_day : (m,) array of int64
        ns since midnight UTC, in the order of the log.
    day : (m,) array of int64
        Days since 1970; -1 at the front of the log before the first date, or everywhere.
    start : int
        Start of the run, ns since 1970: chooses the day where the log never states one.

    Returns
    -------
    day : (m,) array of int64
        Complete. The clock passes midnight where the time of day falls, or grows, by more than 12 h.
    stated : bool
        Whether the log states a date.

    Examples
    --------
    >>> late = np.array([23, 23, 0]) * 3600 * SECOND
    >>> days(late, np.array([-1, -1, -1]), 10 * DAY + 23 * 3600 * SECOND)[0].tolist()
    [10, 10, 11]
    """
    if (day >= 0).all():
        return day, True
    step = np.diff(of_day)
    turn = np.concatenate([[0], np.cumsum((step < -DAY // 2).astype(np.int64) - (step > DAY // 2))])
    known = np.flatnonzero(day >= 0)
    if len(known):
        first = int(known[0])
        return np.where(day >= 0, day, day[first] + turn - turn[first]), True
    nearest = int((start - int(of_day[0]) + DAY // 2) // DAY)
    return nearest + turn, False
