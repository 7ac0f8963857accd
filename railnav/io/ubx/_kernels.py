"""Parser of UBX in a block of bytes: navigation messages of one instant become one row."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from railnav.io._kernels import (
    COURSE,
    DAY,
    DUPLICATES,
    GOOD,
    HDOP,
    HEIGHT,
    KINDS,
    LAT,
    LINES,
    LON,
    QUALITY,
    SATELLITES,
    SEQUENCE,
    SIGMA_E,
    SIGMA_N,
    SIGMA_SPEED,
    SIGMA_U,
    SLOTS,
    SPEED,
    VOID,
    WIDTH,
    condemn,
    day_number,
    fix_order,
)

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
        old, new = fix_order(row[QUALITY]), fix_order(quality)
        if new < old or (new == old and not sigma < row[SIGMA_E]):
            return True
    slot[U_STATE] = 1
    seconds = np.int64(hours) * 3600 + np.int64(minutes) * 60 + np.int64(second)
    slot[U_STAMP] = day * DAY + seconds * np.int64(1_000_000_000) + nano
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
