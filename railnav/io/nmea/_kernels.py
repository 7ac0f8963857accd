"""Parser of NMEA 0183 in a block of bytes: sentences of one instant become one row."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from railnav.io._kernels import (
    COURSE,
    DUPLICATES,
    GOOD,
    HDOP,
    HEIGHT,
    KINDS,
    LAT,
    LINES,
    LON,
    MAX_FIELDS,
    MAX_ROW,
    QUALITY,
    SATELLITES,
    SEQUENCE,
    SIGMA_E,
    SIGMA_N,
    SIGMA_U,
    SLOTS,
    SPEED,
    VOID,
    WIDTH,
    clock,
    condemn,
    day_number,
    fix_order,
    integer,
    number,
)

#: Kinds of sentences, and their counters from KINDS on.
GGA, GNS, RMC, GLL, GST, VTG, ZDA, OTHER = range(8)
#: Further counters of NMEA.
LAST_DAY, LAST_TIME, CURRENT, NO_HEIGHT, NMEA_COUNTERS = range(KINDS + 8, KINDS + 13)
#: Integers of an open epoch: time of day, ns; day; row; order of opening, 0 free; source of position; what RMC says; said void.
S_TIME, S_DAY, S_ROW, S_ORDER, S_SOURCE, S_STATUS, S_VOID, S_INTEGERS = range(8)
#: Numbers of an open epoch beside the row's: speed and course of VTG, quality that RMC states.
V_SPEED, V_COURSE, V_QUALITY, S_NUMBERS = range(WIDTH, WIDTH + 4)

_HALF_DAY = 43_200_000_000_000
_KNOT = 1852.0 / 3600.0


@njit(cache=True)
def nmea_quality(c):  # mode letter -> GGA quality, -1 where it is none
    """Kind of fix of a mode indicator on the scale of GGA."""
    if c == 65:  # A
        return 1
    if c == 68:  # D
        return 2
    if c == 80:  # P
        return 3
    if c == 82:  # R
        return 4
    if c == 70:  # F
        return 5
    if c == 69:  # E
        return 6
    if c == 77:  # M
        return 7
    if c == 83:  # S
        return 8
    if c == 78:  # N
        return 0
    return -1


@njit(cache=True)
def nmea_time(data, a, b):  # field hhmmss.sss -> ns of the day, -1 empty, -2 unlawful
    """Parse the time of day; 60 s is lawful in a leap second."""
    if a == b:
        return np.int64(-1)
    if b - a < 6:
        return np.int64(-2)
    hours, minutes = integer(data, a, a + 2), integer(data, a + 2, a + 4)
    second = clock(data, a + 4, b)
    if hours < 0 or hours > 23 or minutes < 0 or minutes > 59 or second < 0 or second >= 61_000_000_000:
        return np.int64(-2)
    return (hours * 3600 + minutes * 60) * np.int64(1_000_000_000) + second


@njit(cache=True)
def nmea_angle(data, a, b, c, d, positive, negative, limit):  # ddmm.mmm field, hemisphere field -> degrees, lawful
    """Parse an angle in degrees and minutes; the hemisphere gives the sign."""
    value, good = number(data, a, b)
    if not good:
        return np.nan, False
    if math.isnan(value):
        return np.nan, True
    if d - c != 1 or value < 0.0:
        return np.nan, False
    whole = math.floor(value / 100.0)
    point = a
    while point < b and data[point] != 46:
        point += 1
    minutes, good = number(data, max(point - 2, a), b)  # parsed again: no digit is lost in a difference
    if not good or minutes >= 60.0:
        return np.nan, False
    degrees = whole + minutes / 60.0
    if degrees > limit:
        return np.nan, False
    if data[c] == negative:
        return -degrees, True
    return degrees, data[c] == positive


@njit(cache=True)
def nmea_open(
    slot, slot_row, count, time, row
):  # epochs, counters, ns, row -> slot, or -1 - slot where it must be closed first
    """Find the open epoch of an instant, or a free slot for it."""
    oldest = 0
    for i in range(SLOTS):
        if slot[i, S_ORDER] > 0 and slot[i, S_TIME] == time:
            return i
        if slot[i, S_ORDER] < slot[oldest, S_ORDER]:
            oldest = i
    if slot[oldest, S_ORDER] > 0:
        return -1 - oldest
    count[SEQUENCE] += 1
    slot[oldest, :] = 0
    slot[oldest, S_TIME] = time
    slot[oldest, S_DAY] = -1
    slot[oldest, S_ROW] = row
    slot[oldest, S_ORDER] = count[SEQUENCE]
    slot_row[oldest, :] = np.nan
    return oldest


@njit(cache=True)
def nmea_close(slot, slot_row, i, count, out, stamp, n):  # epoch i -> number of rows written (0 or 1)
    """Write an epoch that has a position; carry the date on."""
    time = slot[i, S_TIME]
    slot[i, S_ORDER] = 0
    void = slot[i, S_STATUS] < 0 or slot[i, S_SOURCE] == 0 or (slot[i, S_VOID] == 1 and slot[i, S_SOURCE] < 3)
    if slot[i, S_SOURCE] == 0 and slot[i, S_VOID] == 0 and slot[i, S_STATUS] >= 0:
        return 0  # no word about a position
    if void:
        count[VOID] += 1
        return 0
    day = slot[i, S_DAY]
    if day < 0 and count[LAST_DAY] >= 0:
        day = count[LAST_DAY]
        if time < count[LAST_TIME] - _HALF_DAY:
            day += 1
        elif time > count[LAST_TIME] + _HALF_DAY:
            day -= 1
    if day >= 0:
        count[LAST_DAY] = day
        count[LAST_TIME] = time
    for k in range(WIDTH):
        out[n, k] = slot_row[i, k]
    if math.isnan(out[n, SPEED]):
        out[n, SPEED] = slot_row[i, V_SPEED]
    if math.isnan(out[n, COURSE]):
        out[n, COURSE] = slot_row[i, V_COURSE]
    if math.isnan(out[n, QUALITY]):
        out[n, QUALITY] = slot_row[i, V_QUALITY]
    stamp[n, 0] = time
    stamp[n, 1] = day
    stamp[n, 2] = slot[i, S_ROW]
    return 1


@njit(cache=True)
def nmea_finish(slot, slot_row, count, out, stamp, n):  # -> rows written
    """Close every open epoch, in the order of opening."""
    begin = n
    while True:
        first = -1
        for i in range(SLOTS):
            if slot[i, S_ORDER] > 0 and (first < 0 or slot[i, S_ORDER] < slot[first, S_ORDER]):
                first = i
        if first < 0:
            return n - begin
        n += nmea_close(slot, slot_row, first, count, out, stamp, n)


@njit(cache=True)
def nmea_kind(data, p):  # place of the three letters -> kind
    """Tell the sentences apart that are used."""
    a, b, c = data[p], data[p + 1], data[p + 2]
    if a == 71:  # G
        if b == 71 and c == 65:
            return GGA
        if b == 78 and c == 83:
            return GNS
        if b == 76 and c == 76:
            return GLL
        if b == 83 and c == 84:
            return GST
    elif a == 82 and b == 77 and c == 67:
        return RMC
    elif a == 86 and b == 84 and c == 71:
        return VTG
    elif a == 90 and b == 68 and c == 65:
        return ZDA
    return OTHER


@njit(cache=True)
def nmea_position(data, f, k, row):  # field bounds, index of latitude, (2,) out -> 1 position, 0 empty, -1 unlawful
    """Parse latitude, hemisphere, longitude, hemisphere."""
    lat, good = nmea_angle(data, f[k] + 1, f[k + 1], f[k + 1] + 1, f[k + 2], 78, 83, 90.0)
    lon, also = nmea_angle(data, f[k + 2] + 1, f[k + 3], f[k + 3] + 1, f[k + 4], 69, 87, 180.0)
    if not (good and also):
        return -1
    if math.isnan(lat) or math.isnan(lon):
        return 0
    row[0] = lat
    row[1] = lon
    return 1


@njit(cache=True)
def nmea_sentence(data, kind, f, fields, slot, slot_row, i, count):  # field bounds: f[k] the comma before field k
    """Take one sentence into its epoch i (VTG: the epoch before it); False where a field is unlawful."""
    position = np.empty(2)
    if kind in (GGA, GNS):
        if fields < (12 if kind == GGA else 10):
            return False
        state = nmea_position(data, f, 2, position)
        if state < 0:
            return False
        satellites, good1 = number(data, f[7] + 1, f[8])
        hdop, good2 = number(data, f[8] + 1, f[9])
        above, good3 = number(data, f[9] + 1, f[10])
        if kind == GGA:
            quality, good4 = number(data, f[6] + 1, f[7])
            separation, good5 = number(data, f[11] + 1, f[12])
        else:
            quality, good4 = 0.0, True
            best = -1
            for k in range(f[6] + 1, f[7]):
                q = nmea_quality(data[k])
                if q < 0:
                    return False
                if best < 0 or fix_order(float(q)) > best:
                    best = fix_order(float(q))
                    quality = float(q)
            separation, good5 = number(data, f[10] + 1, f[11])
        if not (good1 and good2 and good3 and good4 and good5):
            return False
        if state == 0 or math.isnan(quality) or quality == 0.0:
            slot[i, S_VOID] = 1
            return True
        source = 4 if kind == GGA else 3
        if slot[i, S_SOURCE] == source:
            count[DUPLICATES] += 1
            old, new = fix_order(slot_row[i, QUALITY]), fix_order(quality)
            if new < old:
                return True
            if new == old:
                had, has = slot_row[i, SATELLITES], satellites
                if had > has or math.isnan(has) or (had == has and not hdop < slot_row[i, HDOP]):
                    return True
        elif slot[i, S_SOURCE] > source:
            return True
        slot[i, S_SOURCE] = source
        slot_row[i, LAT] = position[0]
        slot_row[i, LON] = position[1]
        slot_row[i, HEIGHT] = above + separation
        if math.isnan(separation):
            count[NO_HEIGHT] += 1
        slot_row[i, QUALITY] = quality
        slot_row[i, SATELLITES] = satellites
        slot_row[i, HDOP] = hdop
    elif kind == RMC:
        if fields < 9:
            return False
        state = nmea_position(data, f, 3, position)
        speed, good1 = number(data, f[7] + 1, f[8])
        course, good2 = number(data, f[8] + 1, f[9])
        if state < 0 or not (good1 and good2) or speed < 0.0 or f[3] - f[2] != 2:
            return False
        if data[f[2] + 1] != 65:
            if slot[i, S_STATUS] == 0:
                slot[i, S_STATUS] = -1
            return data[f[2] + 1] == 86
        day = np.int64(-1)
        if f[10] - f[9] == 7:
            a = f[9] + 1
            year = integer(data, a + 4, a + 6)
            day = day_number(
                year + (1900 if year >= 80 else 2000), integer(data, a + 2, a + 4), integer(data, a, a + 2)
            )
            if day < 0:
                return False
        elif f[10] - f[9] != 1:
            return False
        if slot[i, S_STATUS] == 1:
            return True
        slot[i, S_STATUS] = 1
        if day >= 0:
            slot[i, S_DAY] = day
        slot_row[i, SPEED] = speed * _KNOT
        slot_row[i, COURSE] = course
        if fields >= 12 and f[13] - f[12] == 2:
            quality = nmea_quality(data[f[12] + 1])
            if quality > 0:
                slot_row[i, V_QUALITY] = quality
        if state == 1 and slot[i, S_SOURCE] < 2:
            slot[i, S_SOURCE] = 2
            slot_row[i, LAT] = position[0]
            slot_row[i, LON] = position[1]
    elif kind == GLL:
        if fields < 6:
            return False
        state = nmea_position(data, f, 1, position)
        if state < 0 or f[7] - f[6] != 2:
            return False
        if data[f[6] + 1] != 65 or state == 0:
            slot[i, S_VOID] = 1
        elif slot[i, S_SOURCE] == 0:
            slot[i, S_SOURCE] = 1
            slot_row[i, LAT] = position[0]
            slot_row[i, LON] = position[1]
    elif kind == GST:
        if fields < 8:
            return False
        north, good1 = number(data, f[6] + 1, f[7])
        east, good2 = number(data, f[7] + 1, f[8])
        up, good3 = number(data, f[8] + 1, f[9])
        if not (good1 and good2 and good3):
            return False
        if math.isnan(slot_row[i, SIGMA_N]) and north > 0.0 and east > 0.0:
            slot_row[i, SIGMA_N] = north
            slot_row[i, SIGMA_E] = east
            if up > 0.0:
                slot_row[i, SIGMA_U] = up
    elif kind == VTG:
        if fields < 8:
            return False
        course, good1 = number(data, f[1] + 1, f[2])
        knots, good2 = number(data, f[5] + 1, f[6])
        kmh, good3 = number(data, f[7] + 1, f[8])
        if not (good1 and good2 and good3) or knots < 0.0 or kmh < 0.0:
            return False
        slot_row[i, V_SPEED] = kmh / 3.6 if math.isnan(knots) else knots * _KNOT
        slot_row[i, V_COURSE] = course
    elif kind == ZDA:
        if fields < 4:
            return False
        if f[3] - f[2] > 1:
            day = day_number(
                integer(data, f[4] + 1, f[5]), integer(data, f[3] + 1, f[4]), integer(data, f[2] + 1, f[3])
            )
            if day < 0:
                return False
            slot[i, S_DAY] = day
    return True


@njit(cache=True)
def nmea_hex(c):  # byte -> value, -1
    """Value of a hexadecimal digit."""
    if 48 <= c <= 57:
        return c - 48
    if 65 <= c <= 70:
        return c - 55
    if 97 <= c <= 102:
        return c - 87
    return -1


@njit(cache=True)
def nmea_block(data, last, checked, slot, slot_row, count, out, stamp):  # bytes; ... -> bytes used, rows written
    """Read sentences from a block until it or the room for rows ends."""
    size = len(data)
    room = len(out) - SLOTS
    p = 0
    n = 0
    f = np.zeros(MAX_FIELDS + 2, dtype=np.int64)
    while p < size and n < room:
        c = data[p]
        if c != 36:  # anything but $
            if c == 10:
                count[LINES] += 1
            p += 1
            continue
        parity = 0
        fields = 0
        star = -1
        q = p + 1
        while q < size:
            c = data[q]
            if c == 13 or c == 10 or c == 36 or q - p > MAX_ROW:
                break
            if star < 0:
                if c == 42:  # *
                    star = q
                else:
                    parity ^= c
                    if c == 44 and fields < MAX_FIELDS:
                        fields += 1
                        f[fields] = q
            q += 1
        if q == size and not last:
            return p, n  # the rest of it is in the next block
        end = star if star >= 0 else q
        row = count[LINES] + 1
        # an address of capitals and digits makes a sentence; anything else after a $ is not one
        address = f[1] if fields > 0 else end
        sentence = address - p >= 3
        for k in range(p + 1, min(address, p + 6)):
            c = data[k]
            if not (65 <= c <= 90 or 48 <= c <= 57):
                sentence = False
        if not sentence:
            p += 1
            continue
        if star >= 0:
            good = q - star >= 3 and nmea_hex(data[star + 1]) * 16 + nmea_hex(data[star + 2]) == parity
            if q - star >= 3 and (nmea_hex(data[star + 1]) < 0 or nmea_hex(data[star + 2]) < 0):
                good = False
        else:
            good = not checked and q < size and (data[q] == 13 or data[q] == 10)
        if not good:
            condemn(count, row)
            p = q
            continue
        kind = nmea_kind(data, p + 3) if address - p == 6 and data[p + 1] != 80 else OTHER
        if kind != OTHER:
            f[fields + 1] = end  # as if a comma closed the last field
            if kind == VTG:
                i = count[CURRENT]
                if i >= 0 and slot[i, S_ORDER] > 0:
                    good = nmea_sentence(data, kind, f, fields, slot, slot_row, i, count)
            else:
                k = 5 if kind == GLL else 1
                time = nmea_time(data, f[k] + 1, f[k + 1]) if fields >= k else np.int64(-2)
                if time >= 0:
                    i = nmea_open(slot, slot_row, count, time, row)
                    if i < 0:
                        n += nmea_close(slot, slot_row, -1 - i, count, out, stamp, n)
                        i = nmea_open(slot, slot_row, count, time, row)
                    count[CURRENT] = i
                    good = nmea_sentence(data, kind, f, fields, slot, slot_row, i, count)
                elif time == -2:
                    good = False
        if good:
            count[GOOD] += 1
            count[KINDS + kind] += 1
        else:
            condemn(count, row)
        p = q
    if last and p >= size:
        n += nmea_finish(slot, slot_row, count, out, stamp, n)
    return p, n
