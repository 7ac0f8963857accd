"""Parser of RTKLIB .pos in a block of bytes."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from railnav.io._kernels import (
    COURSE,
    DAY,
    GOOD,
    KINDS,
    LAT,
    LINES,
    LON,
    MAX_ROW,
    QUALITY,
    SIGMA_E,
    SIGMA_N,
    SIGMA_SPEED,
    SIGMA_U,
    SPEED,
    VOID,
    WIDTH,
    clock,
    condemn,
    day_number,
    integer,
    number,
)

#: Further numbers of a row: velocity to north and east, m/s; their sigmas; the signed root of their covariance.
P_NORTH, P_EAST, P_SIGMA_NORTH, P_SIGMA_EAST, P_COVARIANCE, P_NUMBERS = range(WIDTH, WIDTH + 6)
#: Further counters of .pos: within a row that is too long.
SKIPPING, POS_COUNTERS = range(KINDS, KINDS + 2)

_GPS_EPOCH_DAY = 3657


@njit(cache=True)
def pos_stamp(
    data, a, b, c, d
):  # bytes, ranges of the two time fields -> ns since 1970 on the log's clock, -1 unlawful
    """Parse yyyy/mm/dd hh:mm:ss.sss, or GPS week and seconds of the week."""
    if b - a == 10 and data[a + 4] == 47 and data[a + 7] == 47:
        day = day_number(integer(data, a, a + 4), integer(data, a + 5, a + 7), integer(data, a + 8, b))
        if day < 0 or d - c < 8 or data[c + 2] != 58 or data[c + 5] != 58:
            return np.int64(-1)
        hours, minutes = integer(data, c, c + 2), integer(data, c + 3, c + 5)
        second = clock(data, c + 6, d)
        if hours < 0 or hours > 23 or minutes < 0 or minutes > 59 or second < 0 or second >= 61_000_000_000:
            return np.int64(-1)
        return day * DAY + (hours * 3600 + minutes * 60) * np.int64(1_000_000_000) + second
    week, second = integer(data, a, b), clock(data, c, d)
    if week < 0 or week > 11_000 or second < 0:
        return np.int64(-1)
    return (week * 7 + _GPS_EPOCH_DAY) * DAY + second


@njit(cache=True)
def pos_row(data, f, fields, meaning, row):  # bytes, bounds (fields, 2), column of each field, out -> lawful
    """Parse the numbers of a row into the columns that `meaning` gives (-1: not used)."""
    row[:] = np.nan
    for k in range(fields):
        column = meaning[k]
        if column >= 0:
            value, good = number(data, f[k, 0], f[k, 1])
            if not good:
                return False
            row[column] = value
    if not (abs(row[LAT]) <= 90.0 and abs(row[LON]) <= 180.0 and row[QUALITY] >= 0.0):
        return False
    for column in (SIGMA_E, SIGMA_N, SIGMA_U):
        if not row[column] > 0.0:
            row[column] = np.nan
    north, east = row[P_NORTH], row[P_EAST]
    if not math.isnan(north) and not math.isnan(east):
        speed = math.hypot(north, east)
        row[SPEED] = speed
        if speed > 0.0:
            course = math.degrees(math.atan2(east, north))
            row[COURSE] = course + 360.0 if course < 0.0 else course
        a, b, c = row[P_SIGMA_NORTH], row[P_SIGMA_EAST], row[P_COVARIANCE]
        if a > 0.0 and b > 0.0:
            variance = 0.5 * (a * a + b * b)
            if speed > 0.0:
                cross = 0.0 if math.isnan(c) else c * abs(c)
                along = (north * north * a * a + east * east * b * b + 2.0 * north * east * cross) / (speed * speed)
                if along > 0.0:
                    variance = along
            row[SIGMA_SPEED] = math.sqrt(variance)
    return True


@njit(cache=True)
def pos_block(data, last, meaning, count, out, stamp):  # bytes; column of each field; ... -> bytes used, rows written
    """Read rows from a block until it or the room ends; `out` has P_NUMBERS columns."""
    size = len(data)
    p = 0
    n = 0
    expected = len(meaning)
    f = np.zeros((expected + 1, 2), dtype=np.int64)
    while p < size and n < len(out):
        end = p
        while end < size and data[end] != 10:
            end += 1
        if end == size and not last:
            if count[SKIPPING] == 0 and end - p <= MAX_ROW:
                return p, n  # the rest of it is in the next block
            if count[SKIPPING] == 0:
                condemn(count, count[LINES] + 1)
                count[SKIPPING] = 1
            return size, n
        row = count[LINES] + 1
        count[LINES] += 1
        begin = p
        p = end + 1
        if count[SKIPPING] != 0:
            count[SKIPPING] = 0
            continue
        if end - begin > MAX_ROW:
            condemn(count, row)
            continue
        fields = 0
        inside = False
        for q in range(begin, end):
            c = data[q]
            if inside and 45 <= c <= 58:
                continue  # digits and what stands among them
            if c == 32 or c == 9 or c == 44 or c == 59 or c == 13:
                if inside:
                    f[fields - 1, 1] = q
                    inside = False
            elif fields == 0 and begin == 0 and row == 1 and (c == 239 or c == 187 or c == 191):
                inside = False  # a byte order mark
            elif not inside:
                if fields == 0 and c == 37:  # %
                    break
                if fields > expected:
                    break
                inside = True
                f[fields, 0] = q
                fields += 1
        if inside:
            f[fields - 1, 1] = end
        if fields == 0:
            continue  # blank, or a comment
        if fields != expected:
            condemn(count, row)
            continue
        time = pos_stamp(data, f[0, 0], f[0, 1], f[1, 0], f[1, 1])
        if time < 0 or not pos_row(data, f, fields, meaning, out[n]):
            condemn(count, row)
            continue
        count[GOOD] += 1
        if out[n, QUALITY] == 0.0:
            count[VOID] += 1
            continue
        stamp[n, 0] = time
        stamp[n, 1] = row
        n += 1
    return min(p, size), n
