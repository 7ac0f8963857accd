"""Byte parsers of GNSS logs: a block of bytes in, rows of numbers out, no validation of arguments.

Each parser is resumable: what it knows between two blocks lies in the arrays `count` and `slot*`. Rows are written in the order
of `railnav.io.log_reading.COLUMNS`.
"""

from __future__ import annotations

import math

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


# --- NMEA 0183 --------------------------------------------------------------------------------------------------------

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
def nmea_place(quality):  # GGA quality -> order, larger is better
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
                if best < 0 or nmea_place(float(q)) > best:
                    best = nmea_place(float(q))
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
            old, new = nmea_place(slot_row[i, QUALITY]), nmea_place(quality)
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


# --- RTKLIB .pos ------------------------------------------------------------------------------------------------------

#: Further numbers of a row: velocity to north and east, m/s; their sigmas; the signed root of their covariance.
P_NORTH, P_EAST, P_SIGMA_NORTH, P_SIGMA_EAST, P_COVARIANCE, P_NUMBERS = range(WIDTH, WIDTH + 6)
#: Further counters of .pos: within a row that is too long.
SKIPPING, POS_COUNTERS = range(KINDS, KINDS + 2)

_DAY = 86_400_000_000_000
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
        return day * _DAY + (hours * 3600 + minutes * 60) * np.int64(1_000_000_000) + second
    week, second = integer(data, a, b), clock(data, c, d)
    if week < 0 or week > 11_000 or second < 0:
        return np.int64(-1)
    return (week * 7 + _GPS_EPOCH_DAY) * _DAY + second


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


# --- UBX --------------------------------------------------------------------------------------------------------------

#: Class and number of the messages that are used, as class * 256 + number.
NAV_PVT, NAV_COV, NAV_HPPOSLLH, NAV_DOP = 0x0107, 0x0136, 0x0114, 0x0104
#: Integers of an open epoch: iTOW, ms; ns since 1970; byte; order of opening, 0 free; 1 a fix, -1 void, 0 no PVT yet.
U_ITOW, U_STAMP, U_BYTE, U_ORDER, U_STATE, U_INTEGERS = range(6)
#: Numbers of an open epoch beside the row's: high-precision position and its sigmas; covariances; velocity.
U_LAT, U_LON, U_HEIGHT, U_HACC, U_VACC, U_NN, U_EE, U_DD, U_VNN, U_VNE, U_VEE, U_NORTH, U_EAST, U_NUMBERS = range(
    WIDTH, WIDTH + 14
)
UBX_COUNTERS = KINDS + 1
#: Bytes of the largest message with its frame.
UBX_LARGEST = 65_535 + 8

_UNKNOWN = 0xFFFFFFFF
_AXIS = math.sqrt(0.5)


@njit(cache=True)
def u2(data, p):  # bytes, place -> integer
    """Two bytes, little-endian, unsigned."""
    return np.int64(data[p]) | (np.int64(data[p + 1]) << 8)


@njit(cache=True)
def u4(data, p):  # bytes, place -> integer
    """Four bytes, little-endian, unsigned."""
    return u2(data, p) | (u2(data, p + 2) << 16)


@njit(cache=True)
def i4(data, p):  # bytes, place -> integer
    """Four bytes, little-endian, two's complement."""
    value = u4(data, p)
    return value - (np.int64(1) << 32) if value >= (np.int64(1) << 31) else value


@njit(cache=True)
def i1(data, p):  # bytes, place -> integer
    """One byte, two's complement."""
    value = np.int64(data[p])
    return value - 256 if value > 127 else value


@njit(cache=True)
def ubx_float(data, p, word):  # bytes, place, (1,) uint32 to work in -> number
    """Four bytes as an IEEE 754 single."""
    word[0] = np.uint32(u4(data, p))
    return float(word.view(np.float32)[0])


@njit(cache=True)
def ubx_sigma(value, unit):  # integer, m -> m, NaN where nothing is known
    """Accuracy estimate; zero and all ones say nothing."""
    return value * unit if 0 < value < _UNKNOWN else np.nan


@njit(cache=True)
def ubx_open(slot, slot_row, count, itow, out, stamp, n):  # -> slot of an instant, rows written
    """Find the open epoch of an instant, or make room for it."""
    oldest = 0
    for i in range(SLOTS):
        if slot[i, U_ORDER] > 0 and slot[i, U_ITOW] == itow:
            return i, 0
        if slot[i, U_ORDER] < slot[oldest, U_ORDER]:
            oldest = i
    written = ubx_close(slot, slot_row, oldest, count, out, stamp, n) if slot[oldest, U_ORDER] > 0 else 0
    count[SEQUENCE] += 1
    slot[oldest, :] = 0
    slot[oldest, U_ITOW] = itow
    slot[oldest, U_ORDER] = count[SEQUENCE]
    slot_row[oldest, :] = np.nan
    return oldest, written


@njit(cache=True)
def ubx_close(slot, slot_row, i, count, out, stamp, n):  # epoch i -> number of rows written (0 or 1)
    """Write an epoch that has a fix, completed by what came beside NAV-PVT."""
    slot[i, U_ORDER] = 0
    if slot[i, U_STATE] <= 0:
        if slot[i, U_STATE] < 0:
            count[VOID] += 1
        return 0
    had = slot_row[i]
    row = out[n]
    for k in range(WIDTH):
        row[k] = had[k]
    if not math.isnan(had[U_LAT]):
        row[LAT] = had[U_LAT]
        row[LON] = had[U_LON]
        if not math.isnan(row[HEIGHT]):
            row[HEIGHT] = had[U_HEIGHT]
        if not math.isnan(had[U_HACC]):
            row[SIGMA_E] = row[SIGMA_N] = had[U_HACC] * _AXIS
        if not math.isnan(row[HEIGHT]) and not math.isnan(had[U_VACC]):
            row[SIGMA_U] = had[U_VACC]
    if had[U_NN] > 0.0 and had[U_EE] > 0.0 and had[U_DD] > 0.0:
        row[SIGMA_N] = math.sqrt(had[U_NN])
        row[SIGMA_E] = math.sqrt(had[U_EE])
        if not math.isnan(row[HEIGHT]):
            row[SIGMA_U] = math.sqrt(had[U_DD])
    if had[U_VNN] > 0.0 and had[U_VEE] > 0.0:
        north, east = had[U_NORTH], had[U_EAST]
        speed2 = north * north + east * east
        variance = 0.5 * (had[U_VNN] + had[U_VEE])
        if speed2 > 0.0:
            along = (north * north * had[U_VNN] + east * east * had[U_VEE] + 2.0 * north * east * had[U_VNE]) / speed2
            if along > 0.0:
                variance = along
        row[SIGMA_SPEED] = math.sqrt(variance)
    stamp[n, 0] = slot[i, U_STAMP]
    stamp[n, 1] = slot[i, U_BYTE]
    return 1


@njit(cache=True)
def ubx_pvt(
    data, p, size, slot, row, place, count
):  # payload at p, its size; integers and numbers of the epoch -> lawful
    """Take a NAV-PVT into its epoch."""
    valid, kind, flags = data[p + 11], data[p + 20], data[p + 21]
    fix = (valid & 3) == 3 and (flags & 1) == 1 and 1 <= kind <= 4
    if fix and size >= 92 and (data[p + 78] & 1) == 1:
        fix = False
    if not fix:
        if slot[U_STATE] == 0:
            slot[U_STATE] = -1
        return True
    day = day_number(u2(data, p + 4), np.int64(data[p + 6]), np.int64(data[p + 7]))
    hours, minutes, second, nano = data[p + 8], data[p + 9], data[p + 10], i4(data, p + 16)
    lon, lat = i4(data, p + 24), i4(data, p + 28)
    if day < 0 or hours > 23 or minutes > 59 or second > 60 or abs(nano) > 1_000_000_000:
        return False
    if abs(lat) > 900_000_000 or abs(lon) > 1_800_000_000 or i4(data, p + 60) < 0:
        return False
    carrier = flags >> 6
    quality = 4.0 if carrier == 2 else 5.0 if carrier == 1 else 6.0 if kind == 1 else 2.0 if flags & 2 else 1.0
    sigma = ubx_sigma(u4(data, p + 40), 1e-3) * _AXIS
    if slot[U_STATE] == 1:
        count[DUPLICATES] += 1
        old, new = nmea_place(row[QUALITY]), nmea_place(quality)
        if new < old or (new == old and not sigma < row[SIGMA_E]):
            return True
    slot[U_STATE] = 1
    seconds = np.int64(hours) * 3600 + np.int64(minutes) * 60 + np.int64(second)
    slot[U_STAMP] = day * _DAY + seconds * np.int64(1_000_000_000) + nano
    slot[U_BYTE] = place
    row[LAT] = lat / 1e7
    row[LON] = lon / 1e7
    row[SIGMA_E] = row[SIGMA_N] = sigma
    row[HEIGHT] = row[SIGMA_U] = np.nan
    if kind != 2:  # a two-dimensional fix holds an old height
        row[HEIGHT] = i4(data, p + 32) / 1e3
        row[SIGMA_U] = ubx_sigma(u4(data, p + 44), 1e-3)
    row[SPEED] = i4(data, p + 60) / 1e3
    course = i4(data, p + 64) / 1e5
    row[COURSE] = course + 360.0 if course < 0.0 else course
    row[SIGMA_SPEED] = ubx_sigma(u4(data, p + 68), 1e-3)
    row[QUALITY] = quality
    row[SATELLITES] = data[p + 23]
    row[U_NORTH] = i4(data, p + 48) / 1e3
    row[U_EAST] = i4(data, p + 52) / 1e3
    return True


@njit(cache=True)
def ubx_message(data, p, size, name, place, slot, slot_row, count, word, out, stamp, n):  # -> lawful, rows written
    """Take one message of a lawful frame into its epoch."""
    if name == NAV_PVT:
        if size < 84:
            return False, 0
        i, written = ubx_open(slot, slot_row, count, u4(data, p), out, stamp, n)
        return ubx_pvt(data, p, size, slot[i], slot_row[i], place, count), written
    if name == NAV_DOP:
        if size < 18:
            return False, 0
        i, written = ubx_open(slot, slot_row, count, u4(data, p), out, stamp, n)
        slot_row[i, HDOP] = u2(data, p + 12) / 100.0
        return True, written
    if name == NAV_HPPOSLLH:
        if size < 36:
            return False, 0
        i, written = ubx_open(slot, slot_row, count, u4(data, p + 4), out, stamp, n)
        lon = (i4(data, p + 8) * 100 + i1(data, p + 24)) / 1e9
        lat = (i4(data, p + 12) * 100 + i1(data, p + 25)) / 1e9
        if (data[p + 3] & 1) == 0 and abs(lat) <= 90.0 and abs(lon) <= 180.0:
            slot_row[i, U_LAT] = lat
            slot_row[i, U_LON] = lon
            slot_row[i, U_HEIGHT] = (i4(data, p + 16) * 10 + i1(data, p + 26)) / 1e4
            slot_row[i, U_HACC] = ubx_sigma(u4(data, p + 28), 1e-4)
            slot_row[i, U_VACC] = ubx_sigma(u4(data, p + 32), 1e-4)
        return True, written
    if name == NAV_COV:
        if size < 64:
            return False, 0
        i, written = ubx_open(slot, slot_row, count, u4(data, p), out, stamp, n)
        if data[p + 5] == 1:
            slot_row[i, U_NN] = ubx_float(data, p + 16, word)
            slot_row[i, U_EE] = ubx_float(data, p + 28, word)
            slot_row[i, U_DD] = ubx_float(data, p + 36, word)
        if data[p + 6] == 1:
            slot_row[i, U_VNN] = ubx_float(data, p + 40, word)
            slot_row[i, U_VNE] = ubx_float(data, p + 44, word)
            slot_row[i, U_VEE] = ubx_float(data, p + 52, word)
        for k in range(U_NN, U_VEE + 1):
            if not abs(slot_row[i, k]) < 1e15:
                slot_row[i, k] = np.nan
        return True, written
    return True, 0


@njit(cache=True)
def ubx_block(data, last, sums, slot, slot_row, count, kinds, out, stamp):
    # bytes; (2, n + 1) uint8 to work in; epochs, counters, (65536,) messages of each kind, rows -> bytes used, rows written
    """Read messages from a block until it or the room ends; count[LINES] is the number of bytes before the block.

    The two sums of a frame's checksum (8-bit Fletcher) are differences of running sums over the block, so that a false beginning
    costs no second look at its bytes.
    """
    size = len(data)
    room = len(out) - SLOTS
    word = np.zeros(1, dtype=np.uint32)
    a = np.int64(0)
    b = np.int64(0)
    for k in range(size):
        sums[0, k] = a & 255
        sums[1, k] = b & 255
        a += np.int64(data[k])
        b += (np.int64(k) & 255) * np.int64(data[k])
    sums[0, size] = a & 255
    sums[1, size] = b & 255
    p = 0
    n = 0
    while p < size and n < room:
        if data[p] != 0xB5:
            p += 1
            continue
        if p + 1 < size and data[p + 1] != 0x62:
            p += 1
            continue
        end = p + 8 + u2(data, p + 4) if p + 6 <= size else size + 1
        if end > size:
            if not last:
                break  # the rest of it is in the next block
            if p + 2 <= size:
                condemn(count, count[LINES] + p)
            p += 1
            continue
        first = np.int64(sums[0, end - 2]) - np.int64(sums[0, p + 2])
        second = (end - 2) * first - (np.int64(sums[1, end - 2]) - np.int64(sums[1, p + 2]))
        if (first & 255) != data[end - 2] or (second & 255) != data[end - 1]:
            condemn(count, count[LINES] + p)
            p += 2
            continue
        name = np.int64(data[p + 2]) * 256 + np.int64(data[p + 3])
        good, written = ubx_message(
            data, p + 6, end - p - 8, name, count[LINES] + p, slot, slot_row, count, word, out, stamp, n
        )
        n += written
        if good:
            count[GOOD] += 1
            kinds[name] += 1
        else:
            condemn(count, count[LINES] + p)
        p = end
    if last and p >= size:
        while True:
            i = -1
            for k in range(SLOTS):
                if slot[k, U_ORDER] > 0 and (i < 0 or slot[k, U_ORDER] < slot[i, U_ORDER]):
                    i = k
            if i < 0:
                break
            n += ubx_close(slot, slot_row, i, count, out, stamp, n)
    count[LINES] += p
    return p, n
