"""Track geometry on flat knot arrays: SI, radians, float64, no validation.

The knots of all tracks lie one after another; track i owns the half-open range knot_start[i]:knot_start[i + 1].
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

#: Columns of an evaluated point.
EASTING, NORTHING, HEIGHT, BEARING, CURVATURE, GRADIENT, CANT, SCALE = range(8)
#: Number of columns of an evaluated point.
POINT_SIZE = 8


@njit(cache=True)
def find_segment(offset, first, last, s):  # (k,) m, knot range, m -> index of the segment's left knot
    """Index j with offset[j] <= s < offset[j + 1], kept inside the track."""
    length = offset[last - 1] - offset[first]
    j = first + int((s - offset[first]) / length * (last - 1 - first)) if length > 0.0 else first
    if j < first:
        j = first
    if j > last - 2:
        j = last - 2
    while j > first and offset[j] > s:
        j -= 1
    while j < last - 2 and offset[j + 1] <= s:
        j += 1
    return j


@njit(cache=True)
def gradient_slope(offset, gradient, first, last, j):  # 1/m
    """d(gradient)/d(offset) at a knot by central differences, one-sided at the ends."""
    a = j - 1 if j > first else j
    b = j + 1 if j < last - 1 else j
    return (gradient[b] - gradient[a]) / (offset[b] - offset[a])


@njit(cache=True)
def evaluate(
    offset, easting, northing, height, grid_bearing, curvature, gradient, cant, scale, first, last, s, out
):  # out (POINT_SIZE,): m, m, m, rad, 1/m, -, m, -
    """Evaluate one track at offset s: quintic Hermite position, cubic Hermite bearing, linear curvature, gradient and cant.

    Beyond the ends the track continues straight.
    """
    j = find_segment(offset, first, last, s)
    h = offset[j + 1] - offset[j]
    overrun = 0.0
    u = (s - offset[j]) / h
    if u < 0.0:
        overrun = s - offset[j]
        u = 0.0
    elif u > 1.0:
        overrun = s - offset[j + 1]
        u = 1.0
    b0 = grid_bearing[j]
    turn = grid_bearing[j + 1] - b0
    turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
    k0, k1 = curvature[j], curvature[j + 1]
    g0, g1 = gradient[j], gradient[j + 1]
    d0 = gradient_slope(offset, gradient, first, last, j)
    d1 = gradient_slope(offset, gradient, first, last, j + 1)
    c0 = 1.0 / math.sqrt(1.0 + g0 * g0)  # cosine of the grade angle
    c1 = 1.0 / math.sqrt(1.0 + g1 * g1)
    # d(cos)/ds = -g c^3 g'; d(sin)/ds = c^3 g'
    m0, m1 = scale[j], scale[j + 1]
    sb0, cb0 = math.sin(b0), math.cos(b0)
    b1 = b0 + turn
    sb1, cb1 = math.sin(b1), math.cos(b1)
    dc0 = -g0 * c0 * c0 * c0 * d0
    dc1 = -g1 * c1 * c1 * c1 * d1
    u2 = u * u
    u3 = u2 * u
    u4 = u3 * u
    u5 = u4 * u
    q01 = 10.0 * u3 - 15.0 * u4 + 6.0 * u5
    q00 = 1.0 - q01
    q10 = (u - 6.0 * u3 + 8.0 * u4 - 3.0 * u5) * h
    q11 = (-4.0 * u3 + 7.0 * u4 - 3.0 * u5) * h
    q20 = 0.5 * (u2 - 3.0 * u3 + 3.0 * u4 - u5) * h * h
    q21 = 0.5 * (u3 - 2.0 * u4 + u5) * h * h
    out[0] = (
        q00 * easting[j]
        + q01 * easting[j + 1]
        + q10 * m0 * c0 * sb0
        + q11 * m1 * c1 * sb1
        + q20 * m0 * (c0 * k0 * cb0 + dc0 * sb0)
        + q21 * m1 * (c1 * k1 * cb1 + dc1 * sb1)
    )
    out[1] = (
        q00 * northing[j]
        + q01 * northing[j + 1]
        + q10 * m0 * c0 * cb0
        + q11 * m1 * c1 * cb1
        + q20 * m0 * (-c0 * k0 * sb0 + dc0 * cb0)
        + q21 * m1 * (-c1 * k1 * sb1 + dc1 * cb1)
    )
    out[2] = (
        q00 * height[j]
        + q01 * height[j + 1]
        + q10 * c0 * g0
        + q11 * c1 * g1
        + q20 * c0 * c0 * c0 * d0
        + q21 * c1 * c1 * c1 * d1
    )
    v = 1.0 - u
    out[3] = b0 + turn * (3.0 * u2 - 2.0 * u3) + h * (k0 * u * v * v - k1 * u2 * v)
    out[4] = v * k0 + u * k1
    out[5] = v * g0 + u * g1
    out[6] = v * cant[j] + u * cant[j + 1]
    out[7] = v * m0 + u * m1
    if overrun != 0.0:
        c = 1.0 / math.sqrt(1.0 + out[5] * out[5])
        out[0] += overrun * out[7] * c * math.sin(out[3])
        out[1] += overrun * out[7] * c * math.cos(out[3])
        out[2] += overrun * c * out[5]
        out[4] = 0.0


@njit(cache=True)
def evaluate_many(
    knot_start, offset, easting, northing, height, grid_bearing, curvature, gradient, cant, scale, track, s
):  # (m,) int, (m,) m -> (m, POINT_SIZE)
    """Evaluate many (track, offset) pairs."""
    out = np.empty((len(s), POINT_SIZE))
    for i in range(len(s)):
        t = track[i]
        evaluate(
            offset,
            easting,
            northing,
            height,
            grid_bearing,
            curvature,
            gradient,
            cant,
            scale,
            knot_start[t],
            knot_start[t + 1],
            s[i],
            out[i],
        )
    return out


@njit(cache=True)
def foot_point(
    offset, easting, northing, height, grid_bearing, curvature, gradient, cant, scale, first, last, e, n, s, out
):  # grid point, start offset -> foot offset, signed cross distance (+ right), m; out holds the foot
    """Foot of a grid point on one track by Newton steps from a start offset, kept inside the track."""
    begin, end = offset[first], offset[last - 1]
    for _ in range(12):
        evaluate(offset, easting, northing, height, grid_bearing, curvature, gradient, cant, scale, first, last, s, out)
        sb, cb = math.sin(out[3]), math.cos(out[3])
        de, dn = e - out[0], n - out[1]
        along = de * sb + dn * cb
        cross = de * cb - dn * sb
        rate = out[7] / math.sqrt(1.0 + out[5] * out[5])  # grid metres per metre of offset
        bend = 1.0 - cross * out[4] / rate
        step = along / rate / (bend if bend > 0.1 else 0.1)
        new = min(max(s + step, begin), end)
        if abs(new - s) < 1e-7:
            s = new
            break
        s = new
    evaluate(offset, easting, northing, height, grid_bearing, curvature, gradient, cant, scale, first, last, s, out)
    cross = (e - out[0]) * math.cos(out[3]) - (n - out[1]) * math.sin(out[3])
    return s, cross


@njit(cache=True)
def cell_range(keys, key):  # (c,) sorted int64 -> half-open range of entries with this key
    """Entries of one cell of the spatial index."""
    return np.searchsorted(keys, key, side="left"), np.searchsorted(keys, key, side="right")


@njit(cache=True)
def locate(
    knot_start,
    offset,
    easting,
    northing,
    height,
    grid_bearing,
    curvature,
    gradient,
    cant,
    scale,
    keys,
    sample,
    sample_track,
    sample_knot,
    cell,
    east0,
    north0,
    columns,
    reach,
    e,
    n,
    within,
    found_track,
    found_offset,
    found_distance,
    found_cross,
):  # index arrays of SpatialIndex; grid point, m; result arrays of equal capacity -> number found
    """Foot points of all track stretches that pass within a distance of a grid point, nearest first."""
    radius = within + reach
    near = np.empty(256, np.int64)
    count = 0
    c0 = int(math.floor((e - radius - east0) / cell))
    c1 = int(math.floor((e + radius - east0) / cell))
    r0 = int(math.floor((n - radius - north0) / cell))
    r1 = int(math.floor((n + radius - north0) / cell))
    rows = keys[-1] // columns
    for r in range(max(r0, 0), min(r1, rows) + 1):
        a = np.searchsorted(keys, r * columns + max(c0, 0), side="left")
        b = np.searchsorted(keys, r * columns + min(c1, columns - 1), side="right")
        if c1 < 0 or c0 > columns - 1:
            continue
        for q in range(a, b):
            k = sample[q]
            j = sample_knot[k]
            d = math.hypot(easting[j] - e, northing[j] - n)
            if d <= radius:
                if count == len(near):
                    larger = np.empty(2 * len(near), np.int64)
                    larger[:count] = near
                    near = larger
                near[count] = k
                count += 1
    near = np.sort(near[:count])
    point = np.empty(8)
    total = 0
    for q in range(count):
        k = near[q]
        j = sample_knot[k]
        d = math.hypot(easting[j] - e, northing[j] - n)
        t = sample_track[k]
        lower = False  # a local minimum among the samples of this track
        if q > 0 and near[q - 1] == k - 1 and sample_track[k - 1] == t:
            i = sample_knot[k - 1]
            lower = math.hypot(easting[i] - e, northing[i] - n) < d
        if not lower and q < count - 1 and near[q + 1] == k + 1 and sample_track[k + 1] == t:
            i = sample_knot[k + 1]
            lower = math.hypot(easting[i] - e, northing[i] - n) <= d
        if lower:
            continue
        s, cross = foot_point(
            offset,
            easting,
            northing,
            height,
            grid_bearing,
            curvature,
            gradient,
            cant,
            scale,
            knot_start[t],
            knot_start[t + 1],
            e,
            n,
            offset[j],
            point,
        )
        d = math.hypot(point[0] - e, point[1] - n)
        if d > within:
            continue
        place = total
        twin = False
        for p in range(total):
            if found_track[p] == t and abs(found_offset[p] - s) < 0.5:
                twin = True
        if twin or total >= len(found_track):
            continue
        while place > 0 and found_distance[place - 1] > d:
            found_track[place] = found_track[place - 1]
            found_offset[place] = found_offset[place - 1]
            found_distance[place] = found_distance[place - 1]
            found_cross[place] = found_cross[place - 1]
            place -= 1
        found_track[place] = t
        found_offset[place] = s
        found_distance[place] = d
        found_cross[place] = cross
        total += 1
    return total
