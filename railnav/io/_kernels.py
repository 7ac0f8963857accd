"""Byte parsers of GNSS logs: a block of bytes in, rows of numbers out, no validation of arguments.

Each parser is resumable: what it knows between two blocks lies in the arrays `count` and `slot*`. Rows are written in the order
of `railnav.io.log_reading.COLUMNS`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

LAT, LON, HEIGHT, SIGMA_E, SIGMA_N, SIGMA_U, SPEED, COURSE, SIGMA_SPEED, QUALITY, SATELLITES, HDOP = range(12)
#: Columns of a row of numbers.
WIDTH = 12

#: Epochs that may be open at once: a sentence or message that comes late still finds its own.
SLOTS = 4
#: Bytes of a row of text; longer ones are broken.
MAX_ROW = 1024
#: Fields of a row of text; further ones are not looked at.
MAX_FIELDS = 40

#: Counters shared by the parsers.
LINES, GOOD, BROKEN, FIRST_BROKEN, VOID, DUPLICATES, SEQUENCE, KINDS = range(8)

#: A day, ns.
DAY = 86_400_000_000_000

_POWER = 10.0 ** np.arange(23)
_NS = 10 ** np.arange(10, dtype=np.int64)


# --- text -------------------------------------------------------------------------------------------------------------


@njit(cache=True)
def number(data, a, b):  # bytes, half-open range -> value, lawful; empty is NaN and lawful
    """Parse a decimal number; digits beyond the eighteenth are dropped."""
    while a < b and data[a] == 32:
        a += 1
    while a < b and data[b - 1] == 32:
        b -= 1
    if a == b:
        return np.nan, True
    negative = data[a] == 45
    if negative or data[a] == 43:
        a += 1
    mantissa = np.int64(0)
    digits = 0
    seen = 0
    decimals = 0
    point = False
    for i in range(a, b):
        c = data[i]
        if c == 46:
            if point:
                return np.nan, False
            point = True
        elif 48 <= c <= 57:
            seen += 1
            if digits < 18:
                mantissa = mantissa * 10 + np.int64(c - 48)
                if mantissa > 0:
                    digits += 1
                if point:
                    decimals += 1
            elif not point:
                return np.nan, False
        else:
            return np.nan, False
    if seen == 0 or decimals > 22:
        return np.nan, False
    value = mantissa / _POWER[decimals]
    return (-value if negative else value), True


@njit(cache=True)
def clock(data, a, b):  # bytes, half-open range -> ns, -1 empty, -2 unlawful
    """Parse seconds with up to nine decimals, ss.sss, as ns; at most 604800 s."""
    if a == b:
        return np.int64(-1)
    value = np.int64(0)
    decimals = -1
    for i in range(a, b):
        c = data[i]
        if c == 46 and decimals < 0:
            decimals = 0
        elif 48 <= c <= 57:
            if decimals < 9:
                value = value * 10 + np.int64(c - 48)
                if decimals >= 0:
                    decimals += 1
            if value > np.int64(604_800_000_000_000):
                return np.int64(-2)
        else:
            return np.int64(-2)
    if decimals < 0:
        decimals = 0
    value *= _NS[9 - decimals]
    return value if value <= np.int64(604_800_000_000_000) else np.int64(-2)


@njit(cache=True)
def integer(data, a, b):  # bytes, half-open range -> value, -1 where it is none
    """Parse up to nine digits."""
    if a >= b or b - a > 9:
        return np.int64(-1)
    value = np.int64(0)
    for i in range(a, b):
        c = data[i]
        if c < 48 or c > 57:
            return np.int64(-1)
        value = value * 10 + np.int64(c - 48)
    return value


@njit(cache=True)
def day_number(year, month, day):  # calendar -> days since 1970-01-01, -1 where there is no such day
    """Days from the civil calendar (Hinnant's algorithm), years 1980 to 2199."""
    if year < 1980 or year > 2199 or month < 1 or month > 12 or day < 1:
        return np.int64(-1)
    if day > 31 or (day == 31 and (month == 4 or month == 6 or month == 9 or month == 11)):
        return np.int64(-1)
    leap = year % 4 == 0 and (year % 100 != 0 or year % 400 == 0)
    if month == 2 and day > (29 if leap else 28):
        return np.int64(-1)
    y = year - 1 if month <= 2 else year
    era = y // 400
    of_era = y - era * 400
    m = month - 3 if month > 2 else month + 9
    of_year = (153 * m + 2) // 5 + day - 1
    return np.int64(era * 146_097 + of_era * 365 + of_era // 4 - of_era // 100 + of_year - 719_468)


@njit(cache=True)
def condemn(count, where):  # counters, row or byte
    """Count something broken and remember where the first was."""
    if count[BROKEN] == 0:
        count[FIRST_BROKEN] = where
    count[BROKEN] += 1


@njit(cache=True)
def fix_order(quality):  # GGA quality -> order, larger is better
    """Order of the kinds of fix: RTK, float, differential, single, the rest."""
    if quality == 4.0:
        return 6
    if quality == 5.0:
        return 5
    if quality == 2.0 or quality == 3.0 or quality == 9.0:
        return 4
    if quality == 1.0:
        return 3
    if quality == 6.0:
        return 2
    return 1 if quality > 0.0 else 0
