"""Inner loops of the matching room: paths over the network and the bank of hypotheses. Float64 arrays, SI, radians, no validation.

A hypothesis is a slot of a `Bank`: a window of oriented tracks that follow each other by permitted movements, a state in the path
coordinate of that window, the lower-triangular root of its covariance and a log-weight.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Parts of a compiled loop: they cannot be called from Python, and count no references to the arrays they are lent, which halves
#: both the time to compile and the time to run. They must not make arrays.
part = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
#: The same, put into the loop where they are called, for those with one place of call or a short body: lending some forty arrays to a part
#: that is called takes longer than most parts.
inlined = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False, forceinline=True)


def source_stamp(*modules: ModuleType) -> int:
    """Checksum of modules' sources: numba's cache watches only the file of the loop, this makes it watch what is compiled in."""
    stamp = 0
    for module in modules:
        if module.__file__ is not None:
            stamp = zlib.crc32(Path(module.__file__).read_bytes(), stamp)
    return stamp


#: Columns of a packed knot: one cache line of eight doubles. Tangents are grid metres per metre of offset.
OFFSET, EAST, NORTH, D_EAST, D_NORTH, CURVATURE, GRADIENT, CANT = range(8)
#: Columns of an evaluated point of a path: as a knot without its offset, d(gradient)/ds, the model's sigma across the track, m, d(cant)/ds,
#: sigma of its curvature, 1/m.
(
    P_EAST,
    P_NORTH,
    P_D_EAST,
    P_D_NORTH,
    P_CURVATURE,
    P_GRADIENT,
    P_CANT,
    P_GRADIENT_RATE,
    P_SIGMA_CROSS,
    P_CANT_RATE,
    P_SIGMA_BEND,
) = range(11)
POINT_SIZE = 11
#: Integer marks of a hypothesis.
COUNT, CURRENT, RECORD, VERSION, MOVED, SIGN, INTO = range(7)  # INTO: slot that it was merged into
TAGS = 7
#: Real-valued marks of a hypothesis: time the slip began (-inf: none), time since when the wheel agrees again, how much of the evidence
#: of positions is believed, path coordinate up to which balises are accounted for; ln p of the fixes if the receiver has gone astray,
#: its error across the track then, m, and that error's variance (negative: not known yet).
SLIP_SINCE, AGREE_SINCE, BELIEVED, PASSED, ASTRAY, ASTRAY_CROSS, ASTRAY_VARIANCE = range(7)
#: The constant part of the error across the track: ln p of the fixes if it may be anything; it and the correlated part, m, with their
#: variances (the first negative: not known yet) and covariance; ln of how much likelier the fixes are under what is known of it,
#: under a frame far off (a share of the former), and if the train is on a track beside that the model lacks.
FRAMED, OFFSET_CROSS, OFFSET_VARIANCE, COLOURED, COLOURED_VARIANCE, COLOURED_OFFSET = range(7, 13)
KNOWN_ODDS, FAULT_ODDS, MISSING_ODDS = range(13, 16)
#: The track last looked at, the place past a turnout's curved leg not yet reached for certain (infinite: none), and once one is
#: passed how likely a track that the model lacks still is (0: none passed).
TURN_TRACK, TURN_PLACE, TURNED = range(16, 19)
#: Metres run since the slow states took their noise.
TRAVELLED = 19
#: Dead reckoning by the wheel from a while ago: when it began, place, wheel distance and scale then, variances of place and scale; twice,
#: the older one in use.
CHECK = 20
CHECK_SIZE = 6
CHECK_TIME, CHECK_PLACE, CHECK_WHEEL, CHECK_SCALE, CHECK_VARIANCE, CHECK_SCALE_VARIANCE = range(6)
#: Then its ledger, what each kind of evidence has added to its log-weight.
LEDGER = CHECK + 2 * CHECK_SIZE
(
    BY_PATH,  # prior of the start and of each turnout's legs, the end of the line
    BY_POSITION,
    BY_SPEED,
    BY_COURSE,
    BY_ODOMETER,
    BY_YAW,
    BY_SIDE,
    BY_BALISE,
    BY_STANDSTILL,
) = range(LEDGER, LEDGER + 9)
ENTRIES = 9
INFO = LEDGER + ENTRIES
#: A train moves one way or the other beyond this speed, m/s.
MOVING = 0.2


class Network(NamedTuple):
    """A track model as the kernels read it (see `railnav.matching.network`)."""

    knots: FloatArray  # (k, 8)
    sigma_cross: FloatArray  # (k,) m, 0 where the model states none
    sigma_bend: FloatArray  # (k,) of the curvature, 1/m
    knot_start: IntArray  # (t + 1,)
    length: FloatArray  # (t,) m
    move_start: IntArray  # (2 t + 1,) CSR pointer by track end 2 * track + end
    move_to: IntArray  # (2 m,) track end entered
    stop: IntArray  # (2 t,) 1: a buffer stop stands at this track end
    balise_start: IntArray  # (t + 1,)
    balise: FloatArray  # (b,) offset from the track's start, m, growing on each track


class Bank(NamedTuple):
    """Hypotheses as arrays over slots; `live[0]` of them live, in the slots `live[1:]`."""

    x: FloatArray  # (slots, n)
    P_sqrt: FloatArray  # (slots, n, n) lower triangular
    logw: FloatArray  # (slots,)
    track: IntArray  # (slots, window)
    way: IntArray  # (slots, window) +1 run to growing offset, -1 the other way
    begin: FloatArray  # (slots, window) path coordinate at the end where the path enters the track, m
    armed: IntArray  # (slots, window) 1: the switch between this track and the next may have been thrown since
    tags: IntArray  # (slots, TAGS)
    info: FloatArray  # (slots, INFO)
    live: IntArray  # (slots + 1,)
    used: IntArray  # (slots,)


@njit(cache=True)
def track_point(net, track, way, local, out):  # m from the entering end -> out (POINT_SIZE,)
    """Evaluate a track at a distance from the end where it is entered: cubic Hermite position, linear curvature, straight beyond."""
    first = net.knot_start[track]
    last = net.knot_start[track + 1] - 1
    length = net.length[track]
    s = local if way > 0 else length - local
    knots = net.knots
    j = first + int(s / length * (last - first))
    if j < first:
        j = first
    if j > last - 1:
        j = last - 1
    while j > first and knots[j, OFFSET] > s:
        j -= 1
    while j < last - 1 and knots[j + 1, OFFSET] <= s:
        j += 1
    h = knots[j + 1, OFFSET] - knots[j, OFFSET]
    u = (s - knots[j, OFFSET]) / h
    over = 0.0
    if u < 0.0:
        over = u * h
        u = 0.0
    elif u > 1.0:
        over = (u - 1.0) * h
        u = 1.0
    v = 1.0 - u
    h00 = v * v * (1.0 + 2.0 * u)
    h10 = u * v * v * h
    h01 = u * u * (3.0 - 2.0 * u)
    h11 = -u * u * v * h
    de = v * knots[j, D_EAST] + u * knots[j + 1, D_EAST]
    dn = v * knots[j, D_NORTH] + u * knots[j + 1, D_NORTH]
    e = h00 * knots[j, EAST] + h10 * knots[j, D_EAST] + h01 * knots[j + 1, EAST] + h11 * knots[j + 1, D_EAST]
    n = h00 * knots[j, NORTH] + h10 * knots[j, D_NORTH] + h01 * knots[j + 1, NORTH] + h11 * knots[j + 1, D_NORTH]
    sign = 1.0 if way > 0 else -1.0
    out[P_EAST] = e + over * de
    out[P_NORTH] = n + over * dn
    out[P_D_EAST] = sign * de
    out[P_D_NORTH] = sign * dn
    out[P_CURVATURE] = sign * (v * knots[j, CURVATURE] + u * knots[j + 1, CURVATURE]) if over == 0.0 else 0.0
    out[P_GRADIENT] = sign * (v * knots[j, GRADIENT] + u * knots[j + 1, GRADIENT])
    out[P_CANT] = sign * (v * knots[j, CANT] + u * knots[j + 1, CANT])
    out[P_SIGMA_CROSS] = v * net.sigma_cross[j] + u * net.sigma_cross[j + 1]
    out[P_SIGMA_BEND] = net.sigma_bend[j]
    out[P_GRADIENT_RATE] = (knots[j + 1, GRADIENT] - knots[j, GRADIENT]) / h if over == 0.0 else 0.0
    out[P_CANT_RATE] = (knots[j + 1, CANT] - knots[j, CANT]) / h if over == 0.0 else 0.0


@inlined
def track_shape(
    net, track, way, local, out
):  # m from the entering end -> out (POINT_SIZE,), all but position and tangent
    """Evaluate how a track bends, rises and leans at a distance from the end where it is entered, as `track_point` does."""
    first = net.knot_start[track]
    last = net.knot_start[track + 1] - 1
    length = net.length[track]
    s = local if way > 0 else length - local
    knots = net.knots
    j = first + int(s / length * (last - first))
    if j < first:
        j = first
    if j > last - 1:
        j = last - 1
    while j > first and knots[j, OFFSET] > s:
        j -= 1
    while j < last - 1 and knots[j + 1, OFFSET] <= s:
        j += 1
    slant = 1.0 / (knots[j + 1, OFFSET] - knots[j, OFFSET])
    u = (s - knots[j, OFFSET]) * slant
    inside = 1.0
    if u < 0.0:
        u = 0.0
        inside = 0.0
    elif u > 1.0:
        u = 1.0
        inside = 0.0
    v = 1.0 - u
    sign = 1.0 if way > 0 else -1.0
    out[P_CURVATURE] = sign * inside * (v * knots[j, CURVATURE] + u * knots[j + 1, CURVATURE])
    out[P_GRADIENT] = sign * (v * knots[j, GRADIENT] + u * knots[j + 1, GRADIENT])
    out[P_CANT] = sign * (v * knots[j, CANT] + u * knots[j + 1, CANT])
    out[P_SIGMA_CROSS] = v * net.sigma_cross[j] + u * net.sigma_cross[j + 1]
    out[P_SIGMA_BEND] = net.sigma_bend[j]
    out[P_GRADIENT_RATE] = inside * (knots[j + 1, GRADIENT] - knots[j, GRADIENT]) * slant
    out[P_CANT_RATE] = inside * (knots[j + 1, CANT] - knots[j, CANT]) * slant


@inlined
def path_index(bank, h, s, start):  # path coordinate, index to start from -> index of the window's track that holds it
    """Which track of a hypothesis' window holds a path coordinate; the first and last hold all that lies beyond."""
    i = start
    while i > 0 and s < bank.begin[h, i]:
        i -= 1
    count = bank.tags[h, COUNT]
    while i < count - 1 and s >= bank.begin[h, i + 1]:
        i += 1
    return i


@part
def path_point(net, bank, h, s, out):  # path coordinate -> out (POINT_SIZE,)
    """Evaluate a hypothesis' path at a path coordinate; gives the index in its window."""
    i = path_index(bank, h, s, bank.tags[h, CURRENT])
    track_point(net, bank.track[h, i], bank.way[h, i], s - bank.begin[h, i], out)
    return i


@inlined
def path_shape(net, bank, h, s, out):  # path coordinate -> out (POINT_SIZE,)
    """Evaluate how a hypothesis' path bends, rises and leans at a path coordinate."""
    i = path_index(bank, h, s, bank.tags[h, CURRENT])
    track_shape(net, bank.track[h, i], bank.way[h, i], s - bank.begin[h, i], out)


@njit(cache=True)
def take_slot(bank):
    """Bring one more hypothesis to life; gives its slot, or -1 when all are taken."""
    for h in range(bank.used.shape[0]):
        if bank.used[h] == 0:
            bank.used[h] = 1
            bank.live[0] += 1
            bank.live[bank.live[0]] = h
            return h
    return -1


@part
def drop(bank, i):
    """Drop the i-th living hypothesis; the last one moves to its place."""
    n = bank.live[0]
    bank.used[bank.live[1 + i]] = 0
    bank.live[1 + i] = bank.live[n]
    bank.live[0] = n - 1


@njit(cache=True)
def drop_all(bank):
    """Drop every hypothesis."""
    for h in range(bank.used.shape[0]):
        bank.used[h] = 0
    bank.live[0] = 0


@part
def drop_lightest(bank, keep):
    """Drop the lightest hypothesis other than slot `keep`."""
    worst = -1
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        if h != keep and (worst < 0 or bank.logw[h] < bank.logw[bank.live[1 + worst]]):
            worst = i
    if worst >= 0:
        drop(bank, worst)


@part
def clone(bank, h):
    """Copy a hypothesis; gives the new slot."""
    g = take_slot(bank)
    if g < 0:
        drop_lightest(bank, h)
        g = take_slot(bank)
    n = bank.x.shape[1]
    for i in range(n):
        bank.x[g, i] = bank.x[h, i]
        for j in range(n):
            bank.P_sqrt[g, i, j] = bank.P_sqrt[h, i, j]
    bank.logw[g] = bank.logw[h]
    for i in range(bank.track.shape[1]):
        bank.track[g, i] = bank.track[h, i]
        bank.way[g, i] = bank.way[h, i]
        bank.begin[g, i] = bank.begin[h, i]
        bank.armed[g, i] = bank.armed[h, i]
    for i in range(TAGS):
        bank.tags[g, i] = bank.tags[h, i]
    for i in range(INFO):
        bank.info[g, i] = bank.info[h, i]
    return g


@inlined
def credit(bank, h, entry, nats):
    """Add evidence to a hypothesis' log-weight, and write it in its ledger."""
    bank.logw[h] += nats
    bank.info[h, entry] += nats


@part
def leaving_end(track, way):
    """Track end by which a train that runs this way leaves."""
    return 2 * track + (1 if way > 0 else 0)


@part
def entering_end(track, way):
    """Track end by which a train that runs this way entered."""
    return 2 * track + (0 if way > 0 else 1)


@part
def append(net, bank, h, target):
    """Append the track entered by `target` (a track end) to the far end of a window, dropping its oldest track when full."""
    window = bank.track.shape[1]
    count = bank.tags[h, COUNT]
    if count == window:
        for i in range(count - 1):
            bank.track[h, i] = bank.track[h, i + 1]
            bank.way[h, i] = bank.way[h, i + 1]
            bank.begin[h, i] = bank.begin[h, i + 1]
            bank.armed[h, i] = bank.armed[h, i + 1]
        count -= 1
        bank.tags[h, CURRENT] = max(bank.tags[h, CURRENT] - 1, 0)
    last = count - 1
    bank.begin[h, count] = bank.begin[h, last] + net.length[bank.track[h, last]]
    bank.track[h, count] = target // 2
    bank.way[h, count] = 1 if target % 2 == 0 else -1
    bank.armed[h, last] = 0
    bank.armed[h, count] = 0
    bank.tags[h, COUNT] = count + 1
    bank.tags[h, VERSION] = -1


@part
def prepend(net, bank, h, source):
    """Put the track that is left by `source` (a track end) before a window, dropping its farthest track when full."""
    window = bank.track.shape[1]
    count = bank.tags[h, COUNT]
    if count == window:
        count -= 1
    for i in range(count, 0, -1):
        bank.track[h, i] = bank.track[h, i - 1]
        bank.way[h, i] = bank.way[h, i - 1]
        bank.begin[h, i] = bank.begin[h, i - 1]
        bank.armed[h, i] = bank.armed[h, i - 1]
    track = source // 2
    bank.track[h, 0] = track
    bank.way[h, 0] = 1 if source % 2 == 1 else -1
    bank.begin[h, 0] = bank.begin[h, 1] - net.length[track]
    bank.armed[h, 0] = 0
    bank.tags[h, COUNT] = count + 1
    bank.tags[h, CURRENT] = min(bank.tags[h, CURRENT] + 1, count)
    bank.tags[h, VERSION] = -1


@part
def follow(
    net, bank, h, s, speed, margin
):  # m, m/s, m -> 0: the path reaches on both sides, 1: it ends ahead, -1: behind
    """Keep a hypothesis' window `margin` ahead of and behind s: extend by permitted movements, one clone for each further one.

    Where the way is known it stays known: going back, a train returns as it came, unless the switch may have been thrown meanwhile.
    """
    track, way, begin, tags = bank.track, bank.way, bank.begin, bank.tags
    ends = 0
    # ahead: new tracks
    while True:
        last = tags[h, COUNT] - 1
        far = begin[h, last] + net.length[track[h, last]]
        if s + margin <= far:
            break
        e = leaving_end(track[h, last], way[h, last])
        k0, k1 = net.move_start[e], net.move_start[e + 1]
        if k0 == k1 or (last + 1 == track.shape[1] and tags[h, CURRENT] == 0):
            if s > far:
                ends = 1
            break
        credit(bank, h, BY_PATH, -math.log(k1 - k0))
        for k in range(k0 + 1, k1):
            append(net, bank, clone(bank, h), net.move_to[k])
        append(net, bank, h, net.move_to[k0])
    # behind: new tracks; alternatives only for a train that backs up
    while True:
        if s - margin >= begin[h, 0]:
            break
        e = entering_end(track[h, 0], way[h, 0])
        k0, k1 = net.move_start[e], net.move_start[e + 1]
        if k0 == k1 or tags[h, COUNT] == track.shape[1]:
            if s < begin[h, 0] and k0 == k1:
                ends = -1
            break
        if k1 - k0 > 1 and not speed < -MOVING:
            break
        credit(bank, h, BY_PATH, -math.log(k1 - k0))
        for k in range(k0 + 1, k1):
            prepend(net, bank, clone(bank, h), net.move_to[k])
        prepend(net, bank, h, net.move_to[k0])
    if tags[h, COUNT] > 1:
        _rearm(net, bank, h, s, speed, margin)
    return ends


@part
def _rearm(net, bank, h, s, speed, margin):
    """Arm the switches that a train has left or waits before, and take up an armed one's alternatives when it makes for it.

    A switch that is clear of the train may be thrown while the train stands or draws away.
    """
    track, way, begin, armed, tags = bank.track, bank.way, bank.begin, bank.armed, bank.tags
    for i in range(tags[h, COUNT] - 1):
        gap = begin[h, i + 1] - s  # the boundary lies ahead when positive
        ahead = gap > 0.0
        e = leaving_end(track[h, i], way[h, i]) if ahead else entering_end(track[h, i + 1], way[h, i + 1])
        k0, k1 = net.move_start[e], net.move_start[e + 1]
        if k1 - k0 < 2:
            continue
        if abs(gap) > 0.75 * margin and (speed < MOVING if ahead else speed > -MOVING):
            armed[h, i] = 1
        elif armed[h, i] == 1 and ahead and speed > MOVING and gap < margin:
            armed[h, i] = 0
            kept = entering_end(track[h, i + 1], way[h, i + 1])
            credit(bank, h, BY_PATH, -math.log(k1 - k0))
            for k in range(k0, k1):
                if net.move_to[k] != kept:
                    g = clone(bank, h)
                    tags[g, COUNT] = i + 1
                    tags[g, CURRENT] = min(tags[g, CURRENT], i)
                    append(net, bank, g, net.move_to[k])
        elif armed[h, i] == 1 and not ahead and speed < -MOVING and -gap < margin:
            armed[h, i] = 0
            kept = leaving_end(track[h, i], way[h, i])
            credit(bank, h, BY_PATH, -math.log(k1 - k0))
            for k in range(k0, k1):
                if net.move_to[k] != kept:
                    g = clone(bank, h)
                    kept_count = tags[g, COUNT] - (i + 1)
                    for m in range(kept_count):
                        track[g, m] = track[g, m + i + 1]
                        way[g, m] = way[g, m + i + 1]
                        begin[g, m] = begin[g, m + i + 1]
                        armed[g, m] = armed[g, m + i + 1]
                    tags[g, COUNT] = kept_count
                    tags[g, CURRENT] = max(tags[g, CURRENT] - (i + 1), 0)
                    prepend(net, bank, g, net.move_to[k])


@inlined
def normalise(bank, weight, floor, keep):
    """Scale log-weights so that the posterior sums to 1, drop what falls below `floor` and keep at most `keep`; weight by slot."""
    top = -np.inf
    for i in range(bank.live[0]):
        top = max(top, bank.logw[bank.live[1 + i]])
    total = 0.0
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        weight[h] = math.exp(bank.logw[h] - top)
        total += weight[h]
    i = 0
    while i < bank.live[0]:
        h = bank.live[1 + i]
        if weight[h] < floor * total:
            total -= weight[h]
            drop(bank, i)
        else:
            i += 1
    while bank.live[0] > keep:
        drop_lightest(bank, -1)
    total = 0.0
    for i in range(bank.live[0]):
        total += weight[bank.live[1 + i]]
    shift = top + math.log(total)
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        weight[h] /= total
        bank.logw[h] -= shift


@part
def same_path(bank, a, b, s_a, margin):
    """Whether two hypotheses stand on the same track, mean to go the same way, and came the same way within `margin` of s_a."""
    i, j = bank.tags[a, CURRENT], bank.tags[b, CURRENT]
    if bank.track[a, i] != bank.track[b, j] or bank.way[a, i] != bank.way[b, j]:
        return False
    if bank.tags[a, SIGN] != bank.tags[b, SIGN]:  # one is about to leave forwards, the other backwards
        return False
    up = 1
    while i + up < bank.tags[a, COUNT] and j + up < bank.tags[b, COUNT]:
        if bank.track[a, i + up] != bank.track[b, j + up] or bank.way[a, i + up] != bank.way[b, j + up]:
            return False
        up += 1
    down = 1
    while i - down >= 0 and j - down >= 0 and bank.begin[a, i - down + 1] > s_a - margin:
        if bank.track[a, i - down] != bank.track[b, j - down] or bank.way[a, i - down] != bank.way[b, j - down]:
            return False
        down += 1
    return True


@part
def add_column(P_sqrt, u, first):  # (n, n) lower triangular, (n,) destroyed: P += u u^T
    """Rotate one more column into a covariance root (Givens), beginning at the first row where it is not zero."""
    n = u.shape[0]
    for j in range(first, n):
        if u[j] == 0.0:
            continue
        a = P_sqrt[j, j]
        r = math.sqrt(a * a + u[j] * u[j])
        inverse = 1.0 / r
        c = a * inverse
        s = u[j] * inverse
        P_sqrt[j, j] = r
        for i in range(j + 1, n):
            t = P_sqrt[i, j]
            P_sqrt[i, j] = c * t + s * u[i]
            u[i] = c * u[i] - s * t


@part
def merge(bank, a, b, offset, position, column):  # slots; m; state index; scratch (n,)
    """Fold hypothesis b into a by matching moments: mu = sum w mu, P = sum w (P + d d^T); b's position is shifted by `offset`."""
    n = bank.x.shape[1]
    top = max(bank.logw[a], bank.logw[b])
    wa = math.exp(bank.logw[a] - top)
    wb = math.exp(bank.logw[b] - top)
    total = wa + wb
    bank.logw[a] = top + math.log(total)
    wa /= total
    wb /= total
    for i in range(LEDGER, INFO):
        bank.info[a, i] = wa * bank.info[a, i] + wb * bank.info[b, i]
    bank.x[b, position] += offset
    root_a = math.sqrt(wa)
    P = bank.P_sqrt[a]
    for i in range(n):
        for j in range(i + 1):
            P[i, j] *= root_a
    root_b = math.sqrt(wb)
    for j in range(n):
        for i in range(n):
            column[i] = root_b * bank.P_sqrt[b, i, j] if i >= j else 0.0
        add_column(P, column, j)
    root_d = math.sqrt(wa * wb)
    for i in range(n):
        d = bank.x[b, i] - bank.x[a, i]
        bank.x[a, i] += wb * d
        column[i] = root_d * d
    add_column(P, column, 0)


@part
def merge_all(bank, position, speed, threshold, column):
    """Merge hypotheses on the same path whose position and speed differ by a Mahalanobis distance below `threshold`."""
    i = 0
    while i < bank.live[0]:
        j = i + 1
        while j < bank.live[0]:
            a, b = bank.live[1 + i], bank.live[1 + j]
            if bank.logw[b] > bank.logw[a]:
                bank.live[1 + i] = b
                bank.live[1 + j] = a
                a, b = b, a
            L = bank.P_sqrt[a]
            pp = 0.0
            pv = 0.0
            vv = 0.0
            for k in range(position + 1):
                pp += L[position, k] * L[position, k]
                if k <= speed:
                    pv += L[position, k] * L[speed, k]
                    vv += L[speed, k] * L[speed, k]
            s = bank.x[a, position]
            if not same_path(bank, a, b, s, 4.0 * math.sqrt(pp) + 10.0):
                j += 1
                continue
            offset = bank.begin[a, bank.tags[a, CURRENT]] - bank.begin[b, bank.tags[b, CURRENT]]
            ds = bank.x[b, position] + offset - s
            dv = bank.x[b, speed] - bank.x[a, speed]
            det = pp * vv - pv * pv
            if det <= 0.0 or (ds * ds * vv - 2.0 * ds * dv * pv + dv * dv * pp) / det >= threshold:
                j += 1
                continue
            merge(bank, a, b, offset, position, column)
            bank.tags[b, INTO] = a
            drop(bank, j)
        i += 1
