"""What is said: the track put out, its probability, the mode and the protection level. Float64 arrays, SI, no validation."""

from __future__ import annotations

import math

import numpy as np

from railnav.matching._kernels import (
    COUNT,
    CURRENT,
    ENTRIES,
    LEDGER,
    P_D_EAST,
    P_D_NORTH,
    P_EAST,
    P_GRADIENT,
    P_NORTH,
    inlined,
    part,
)
from railnav.navigation.columns import (
    ACCELERATION,
    ACCELEROMETER_BIAS,
    AMBIGUOUS,
    APART,
    C_FIX_TIME,
    C_NOTHING_NEAR,
    C_OUT_MODE,
    C_OUT_TRACK,
    C_OUT_WAY,
    C_REVISIONS,
    C_STARTED,
    C_TOLD_TRACK,
    C_UNSEEN,
    COASTING,
    DIRECTION_CONFIDENCE,
    FORCE,
    GUARD,
    INITIALISING,
    J_DECISION,
    J_EPOCH,
    J_LEAST,
    J_OFFSET,
    J_SIGMA,
    J_SPEED,
    J_TRACK,
    J_WAY,
    J_WEIGHT,
    JOURNAL_SIZE,
    K_COASTING,
    K_CONFIDENCE,
    K_GRAVITY,
    LOST,
    NEGLIGIBLE,
    OFF_MODEL,
    OUT_ACCELERATION,
    OUT_DIRECTION,
    OUT_FIX_AGE,
    OUT_HYPOTHESES,
    OUT_LEVEL,
    OUT_MODE,
    OUT_OFFSET,
    OUT_PROBABILITY,
    OUT_SIGMA,
    OUT_SIGMA_SPEED,
    OUT_SPEED,
    OUT_TRACK,
    OUT_WAY,
    OUTPUT_SIZE,
    POSITION,
    S_MASS,
    SPEED,
    TIME,
    TRACKING,
    WHEEL_DISTANCE,
)
from railnav.navigation.dynamics._kernels import variance_of
from railnav.navigation.integrity._kernels import (
    mixture_bound,
    residual_bound,
    separation_bound,
    track_missing,
    understated,
)
from railnav.navigation.measurements._kernels import gravity_pull


@inlined
def lawful(bank, h, track, way):
    """Whether a hypothesis' window passes the track that was put out last: then its path leads on from there."""
    for i in range(bank.tags[h, COUNT]):
        if bank.track[h, i] == track and bank.way[h, i] == way:
            return True
    return bank.track[h, bank.tags[h, CURRENT]] == track


@inlined
def choose(fil, shared, bank, work):
    """Hypothesis to put out: the best on the most probable track, or -1 for one row apart when that is no lawful continuation."""
    common = shared.common
    live = bank.live[0]
    mass = work.slot[:, S_MASS]
    for i in range(live):
        h = bank.live[1 + i]
        track = bank.track[h, bank.tags[h, CURRENT]]
        mass[h] = 0.0
        for j in range(live):
            g = bank.live[1 + j]
            if bank.track[g, bank.tags[g, CURRENT]] == track:
                mass[h] += shared.weight[g]
    best = -1
    held = -1
    last = int(common[C_OUT_TRACK])
    for i in range(live):
        h = bank.live[1 + i]
        if best < 0 or _heavier(mass, bank.logw, h, best):
            best = h
        if (
            last >= 0
            and lawful(bank, h, last, int(common[C_OUT_WAY]))
            and (held < 0 or _heavier(mass, bank.logw, h, held))
        ):
            held = h
    if last < 0 or held == best:
        return best
    if held >= 0 and mass[best] < fil.settings[K_CONFIDENCE] and mass[best] < 3.0 * mass[held]:
        return held
    return -1


@part
def _heavier(mass, logw, a, b):
    """Whether a stands on a more probable track than b, or is the heavier one on the same."""
    return mass[a] > mass[b] + 1e-12 or (mass[a] > mass[b] - 1e-12 and logw[a] > logw[b])


@part
def at_a_toe(fil, weight, bank, h):
    """Whether another living hypothesis parts from this one at a turnout that either may not have reached yet (20, the guard).

    Evidence of a turnout's legs counts only when the train is past the toe for certain. One that is all but refuted need not be past it.
    """
    i_s = fil.at[POSITION]
    s_h = bank.x[h, i_s] - GUARD * math.sqrt(variance_of(bank.P_sqrt[h], i_s))
    c = bank.tags[h, CURRENT]
    for m in range(bank.live[0]):
        g = bank.live[1 + m]
        if g == h or bank.track[g, bank.tags[g, CURRENT]] == bank.track[h, c]:
            continue
        # the last track that both paths share, entered at the same coordinate
        for i in range(c - 1, -1, -1):
            shared = -1
            for j in range(bank.tags[g, COUNT]):
                if bank.track[g, j] == bank.track[h, i] and bank.begin[g, j] == bank.begin[h, i]:
                    shared = j
            if shared >= 0:
                toe = bank.begin[h, i + 1]
                s_g = bank.x[g, i_s] - GUARD * math.sqrt(variance_of(bank.P_sqrt[g], i_s))
                if s_h < toe or (s_g < toe and weight[g] > NEGLIGIBLE):
                    return True
                break
    return False


@inlined
def put_out(fil, net, shared, bank, work, row, out):
    """Fill one output row from the posterior: the track, where on it, its probability, the mode and the protection level."""
    k = fil.settings
    at = fil.at
    common = shared.common
    for j in range(OUTPUT_SIZE):
        out[j] = np.nan
    live = bank.live[0]
    out[OUT_TRACK] = -1.0
    out[OUT_HYPOTHESES] = live
    out[OUT_FIX_AGE] = row[TIME] - common[C_FIX_TIME]
    if live == 0:
        common[C_OUT_TRACK] = -1.0
        out[OUT_MODE] = INITIALISING
        if common[C_NOTHING_NEAR] == 1.0:
            out[OUT_MODE] = OFF_MODEL
        elif common[C_STARTED] == 1.0:
            out[OUT_MODE] = LOST
        return
    h = choose(fil, shared, bank, work)
    if h < 0:
        common[C_OUT_TRACK] = -1.0
        common[C_REVISIONS] += 1.0
        out[OUT_MODE] = LOST
        return
    i_s, i_v = at[POSITION], at[SPEED]
    point = work.point
    i = bank.tags[h, CURRENT]
    track, way = bank.track[h, i], bank.way[h, i]
    length = net.length[track]
    # all hypotheses along the chosen one's tangent; those on its track make the estimate
    te, tn = point[h, P_D_EAST], point[h, P_D_NORTH]
    size = te * te + tn * tn
    middle = 0.0
    variance = 0.0
    forward = 0.0
    probability = 0.0
    for j in range(live):
        g = bank.live[1 + j]
        w = shared.weight[g]
        p = variance_of(bank.P_sqrt[g], i_s)
        d = 0.0
        if g != h:
            d = ((point[g, P_EAST] - point[h, P_EAST]) * te + (point[g, P_NORTH] - point[h, P_NORTH]) * tn) / size
        c = bank.tags[g, CURRENT]
        if bank.track[g, c] == track:
            probability += w
            middle += w * d
            variance += w * (p + d * d)
            if bank.way[g, c] == way:
                forward += w
        work.mix[0, j] = w
        work.mix[1, j] = d
        work.mix[2, j] = math.sqrt(p)
    standing = probability
    middle /= probability
    variance = variance / probability - middle * middle
    for j in range(live):
        work.mix[1, j] -= middle
    local = min(max(bank.x[h, i_s] + middle - bank.begin[h, i], 0.0), length)
    out[OUT_TRACK] = track
    out[OUT_WAY] = way
    out[OUT_OFFSET] = local if way > 0 else length - local
    out[OUT_SPEED] = bank.x[h, i_v]
    out[OUT_SIGMA_SPEED] = math.sqrt(variance_of(bank.P_sqrt[h], i_v))
    if at[ACCELERATION] >= 0:
        out[OUT_ACCELERATION] = bank.x[h, at[ACCELERATION]]
    elif row[FORCE] == row[FORCE]:
        pull = gravity_pull(k[K_GRAVITY], point[h, P_GRADIENT])
        out[OUT_ACCELERATION] = row[FORCE] - bank.x[h, at[ACCELEROMETER_BIAS]] - pull
    out[OUT_SIGMA] = math.sqrt(variance)
    probability *= 1.0 - common[C_UNSEEN]
    out[OUT_PROBABILITY] = min(probability, 1.0)
    out[OUT_LEVEL] = mixture_bound(work.mix[0], work.mix[1], work.mix[2], live, fil.risk[0], fil.risk[1])
    out[OUT_LEVEL] = understated(common) * max(out[OUT_LEVEL], residual_bound(fil, shared, bank, work, h))
    if at[WHEEL_DISTANCE] >= 0:
        out[OUT_LEVEL] = max(out[OUT_LEVEL], separation_bound(fil, bank, h, row[TIME]))
    out[OUT_DIRECTION] = way if forward >= DIRECTION_CONFIDENCE * standing else 0.0
    aged = row[TIME] - common[C_FIX_TIME] > k[K_COASTING]
    # fixes come, but have jumped: whether the receiver or the place was wrong is open
    jumped = not aged and variance > APART * APART and at[ACCELERATION] >= 0 and at[WHEEL_DISTANCE] < 0
    # the posterior is that of the model's tracks; what is declared must be likely enough even so if the model lacks one
    known = probability * (1.0 - track_missing(bank.info[h]))
    if known < k[K_CONFIDENCE] or jumped or at_a_toe(fil, shared.weight, bank, h):
        out[OUT_MODE] = AMBIGUOUS
    elif aged:
        out[OUT_MODE] = COASTING
    else:
        out[OUT_MODE] = TRACKING
    common[C_OUT_TRACK] = track
    common[C_OUT_WAY] = way


@part
def keep_journal(fil, net, shared, bank, journal, epoch, out):
    """Write down the candidates of an epoch: where more than one track is possible, and where what is said has changed."""
    kept = journal.used[1]
    live = bank.live[0]
    said = out[OUT_MODE]
    before = shared.common[C_OUT_MODE]
    sure = said in (TRACKING, COASTING)
    was_sure = before in (TRACKING, COASTING)
    changed = out[OUT_TRACK] != shared.common[C_TOLD_TRACK] or sure != was_sure
    shared.common[C_TOLD_TRACK] = out[OUT_TRACK]
    several = out[OUT_PROBABILITY] < 1.0 - J_LEAST or out[OUT_TRACK] < 0.0
    decision = changed and (kept == 1 or kept == 3)
    if not decision and not (several and kept >= 2):
        return
    for i in range(live):
        h = bank.live[1 + i]
        weight = shared.weight[h]
        if weight < J_LEAST and not decision:
            continue
        c = bank.tags[h, CURRENT]
        track, way = bank.track[h, c], bank.way[h, c]
        length = net.length[track]
        local = min(max(bank.x[h, fil.at[POSITION]] - bank.begin[h, c], 0.0), length)
        line = journal.lines[journal.used[0]]
        line[J_EPOCH] = epoch
        line[J_DECISION] = 1.0 if decision else 0.0
        line[J_TRACK] = track
        line[J_WAY] = way
        line[J_OFFSET] = local if way > 0 else length - local
        line[J_WEIGHT] = weight * (1.0 - shared.common[C_UNSEEN])
        line[J_SIGMA] = math.sqrt(variance_of(bank.P_sqrt[h], fil.at[POSITION]))
        line[J_SPEED] = bank.x[h, fil.at[SPEED]]
        for j in range(ENTRIES):
            line[JOURNAL_SIZE - ENTRIES + j] = bank.info[h, LEDGER + j]
        journal.used[0] += 1
