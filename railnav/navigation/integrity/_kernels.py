"""Protection levels (specification 22): of a mixture of normal hypotheses, and by solution separation. No validation."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from railnav.matching._kernels import (
    ASTRAY,
    ASTRAY_CROSS,
    ASTRAY_VARIANCE,
    CHECK,
    CHECK_PLACE,
    CHECK_SCALE,
    CHECK_SCALE_VARIANCE,
    CHECK_SIZE,
    CHECK_TIME,
    CHECK_VARIANCE,
    CHECK_WHEEL,
    COLOURED,
    COLOURED_OFFSET,
    COLOURED_VARIANCE,
    CURRENT,
    FAULT_ODDS,
    FRAMED,
    KNOWN_ODDS,
    MISSING_ODDS,
    OFFSET_CROSS,
    OFFSET_VARIANCE,
    P_CURVATURE,
    P_D_EAST,
    P_D_NORTH,
    P_SIGMA_CROSS,
    SIGN,
    TURN_PLACE,
    TURN_TRACK,
    TURNED,
    entering_end,
    inlined,
    leaving_end,
    part,
    track_point,
)
from railnav.navigation.columns import (
    ANYWHERE,
    BESIDE_LEAST,
    BESIDE_MOST,
    C_FIXES,
    C_FRAME_SIGMA,
    C_MISFIT,
    C_SCALE,
    C_SIGMA_EAST,
    C_SIGMA_NORTH,
    C_START_TIME,
    C_TIME,
    C_YAW_DISTRUST,
    CHECK_INTERVAL,
    CROSS_GATE,
    FAULT_SPREAD,
    FRAME_EAST,
    FRAME_NORTH,
    GNSS_EAST,
    GUARD,
    GYRO_BIAS,
    K_ASTRAY_RATE,
    K_ASTRAY_TIME,
    K_ASTRAY_WALK,
    K_CORRELATED,
    K_FRAME,
    K_FRAME_FAULT,
    K_FRAME_FAULT_SIGMA,
    K_FRAME_LEAST,
    K_FRAME_MOST,
    K_GNSS_FAULT,
    K_GNSS_TIME,
    K_MAP_LENGTH,
    K_MEMORY,
    K_MISSING,
    K_MODEL,
    K_ODOMETER_SLIP,
    K_OFFSET_WALK,
    K_TAG_SIGMA,
    K_TAG_WALK,
    K_WHITE,
    LEG_BEND,
    LEG_PLACE,
    MAP_CROSS,
    MISFIT_FIXES,
    MISFIT_USUAL,
    ODOMETER_SCALE,
    POSITION,
    S_ASTRAY,
    S_FRAMED,
    S_KNOWN,
    SPEED,
    TIME_TAG,
    TURN_FELT,
    TURN_SEEN,
    WHEEL_DISTANCE,
)
from railnav.navigation.dynamics._kernels import variance_of


@inlined
def keep_check(fil, bank, h, time, slipping):
    """Let dead reckoning by the wheel begin anew, once a minute; after a slip both beginnings are void."""
    at = fil.at
    info = bank.info[h]
    if slipping:
        info[CHECK + CHECK_TIME] = np.inf
        info[CHECK + CHECK_SIZE + CHECK_TIME] = np.inf
    newer = CHECK + CHECK_SIZE
    if time - info[newer + CHECK_TIME] < CHECK_INTERVAL:
        return
    i_s, i_d, i_k = at[POSITION], at[WHEEL_DISTANCE], at[ODOMETER_SCALE]
    for j in range(CHECK_SIZE):
        info[CHECK + j] = info[newer + j]
    info[newer + CHECK_TIME] = time
    info[newer + CHECK_PLACE] = bank.x[h, i_s]
    info[newer + CHECK_WHEEL] = bank.x[h, i_d]
    info[newer + CHECK_SCALE] = bank.x[h, i_k]
    info[newer + CHECK_VARIANCE] = variance_of(bank.P_sqrt[h], i_s)
    info[newer + CHECK_SCALE_VARIANCE] = variance_of(bank.P_sqrt[h], i_k)


@part
def wander(info, error, variance, off, white, walk):
    """Let a fix into an error across the track that may be anything and wanders by `walk` (variance); gives its NIS and variance."""
    # info (INFO,): its error and variance at the indices `error` and `variance`; a negative variance: not known yet, NaN is given
    if info[variance] < 0.0:
        info[error] = off
        info[variance] = white
        return np.nan, white
    spread = info[variance] + walk
    total = spread + white
    off -= info[error]
    info[error] += spread / total * off
    info[variance] = spread * white / total
    return off * off / total, total


@part
def stray(fil, bank, work, h, since, nis, held):
    """Let a fix into what a hypothesis knows of the error across its track; how much likelier it is then, ln, goes into its slot.

    Two laws: the receiver is astray, and the error wanders fast; or it is a constant, of which nothing is presumed here (`known_odds`
    says what is), plus the correlated part and white noise. Call it before the fix is let in: `work` holds the innovation and its
    covariance. What the fix says along the track, given across, is the same under both laws and the filter's, and all saturate
    alike, as a whole: else a track that is all wrong would be let off its errors along.
    """
    k = fil.settings
    info = bank.info[h]
    slot = work.slot[h]
    x, fix, point = bank.x[h], work.fix[h], work.point[h]
    te, tn = point[P_D_EAST], point[P_D_NORTH]
    size = math.hypot(te, tn)
    te, tn = te / size, tn / size
    i_g, i_m = fil.at[GNSS_EAST], fil.at[MAP_CROSS]
    scale = work.rows[h, 0, i_g]
    east = scale * x[i_g] + x[fil.at[FRAME_EAST]]
    north = work.rows[h, 1, i_g + 1] * x[i_g + 1] + x[fil.at[FRAME_NORTH]]
    innovation = fix[0] * tn - fix[1] * te
    error = innovation + east * tn - north * te
    if i_m >= 0:
        error += point[P_SIGMA_CROSS] * x[i_m]
    usual = fix[4] * tn * tn - 2.0 * fix[6] * te * tn + fix[5] * te * te
    white = fix[2] * tn * tn + fix[3] * te * te
    along = max(nis - innovation * innovation / usual, 0.0)
    sound = min(nis, held) + math.log(usual)
    astray, spread = wander(info, ASTRAY_CROSS, ASTRAY_VARIANCE, error, white, k[K_ASTRAY_WALK] ** 2 * since)
    slot[S_ASTRAY] = 0.5 * (sound - min(along + astray, held) - math.log(spread)) if astray == astray else 0.0
    walk = k[K_OFFSET_WALK] ** 2 * since
    if i_m >= 0:
        walk += 2.0 * point[P_SIGMA_CROSS] ** 2 * min(abs(x[fil.at[SPEED]]) * since / k[K_MAP_LENGTH], 1.0)
    framed, spread = offset_row(info, error, white, scale * scale, math.exp(-since / k[K_GNSS_TIME]), walk)
    slot[S_FRAMED] = 0.5 * (sound - min(along + framed, held) - math.log(spread))
    stated = k[K_FRAME] * k[K_FRAME] * (fix[2] + fix[3]) * 0.5 / (k[K_WHITE] * k[K_WHITE])
    known = min(max(stated + k[K_MODEL] ** 2, k[K_FRAME_LEAST] ** 2), k[K_FRAME_MOST] ** 2)
    if i_m >= 0:
        known += point[P_SIGMA_CROSS] ** 2
    slot[S_KNOWN] = known


@part
def offset_row(info, error, white, coloured, phi, walk):
    """Let a fix into the constant and the correlated part of the error across the track; gives its NIS and variance.

    error = d + b + w: d wanders by `walk` (variance), b is Gauss-Markov of variance `coloured`, w white. Two states, one row.
    """
    if info[OFFSET_VARIANCE] < 0.0:
        info[OFFSET_CROSS] = 0.0
        info[OFFSET_VARIANCE] = ANYWHERE * ANYWHERE
        info[COLOURED] = 0.0
        info[COLOURED_VARIANCE] = coloured
        info[COLOURED_OFFSET] = 0.0
    dd = info[OFFSET_VARIANCE] + walk
    bb = phi * phi * info[COLOURED_VARIANCE] + (1.0 - phi * phi) * coloured
    db = phi * info[COLOURED_OFFSET]
    b = phi * info[COLOURED]
    y = error - info[OFFSET_CROSS] - b
    spread = dd + 2.0 * db + bb + white
    nis = y * y / spread
    total = spread if nis < CROSS_GATE else y * y / CROSS_GATE
    gain_d, gain_b = (dd + db) / total, (db + bb) / total
    info[OFFSET_CROSS] += gain_d * y
    info[COLOURED] = b + gain_b * y
    info[OFFSET_VARIANCE] = dd - gain_d * gain_d * total
    info[COLOURED_VARIANCE] = bb - gain_b * gain_b * total
    info[COLOURED_OFFSET] = db - gain_d * gain_b * total
    return nis, spread


@part
def known_odds(fil, info, known):
    """How much likelier the fixes are under what is known of the constant part than if it may be anything, ln, into the marks.

    The posterior N(m, P) under N(0, S^2) holds a likelihood N(mu, V): 1/V = 1/P - 1/S^2, mu = m V/P. Under any other prior p the
    fixes are likelier by the integral of p(d) N(d; mu, V) over N(mu; 0, S^2 + V). Priors: what is stated, `known` (variance); with
    small probability a frame far off; and, apart, a track beside that the model lacks, equally likely anywhere beside.
    """
    k = fil.settings
    wide = ANYWHERE * ANYWHERE
    if info[OFFSET_VARIANCE] < 0.0 or info[OFFSET_VARIANCE] > 0.5 * wide:
        info[KNOWN_ODDS] = 0.0
        info[FAULT_ODDS] = -np.inf
        info[MISSING_ODDS] = -np.inf
        return
    v = 1.0 / (1.0 / info[OFFSET_VARIANCE] - 1.0 / wide)
    mu = info[OFFSET_CROSS] * v / info[OFFSET_VARIANCE]
    base = log_normal(mu, wide + v)
    fault = k[K_FRAME_FAULT]
    info[FAULT_ODDS] = -np.inf
    info[KNOWN_ODDS] = math.log(1.0 - fault) + log_normal(mu, known + v) - base
    if fault > 0.0:
        info[FAULT_ODDS] = math.log(fault) + log_normal(mu, known + k[K_FRAME_FAULT_SIGMA] ** 2 + v) - base
        info[KNOWN_ODDS] = log_sum(info[KNOWN_ODDS], info[FAULT_ODDS])
    info[MISSING_ODDS] = -np.inf
    if k[K_MISSING] > 0.0:
        root = math.sqrt(0.5 / (v + known))
        beside = 0.0
        for side in (-1.0, 1.0):
            beside += math.erfc((BESIDE_LEAST - side * mu) * root) - math.erfc((BESIDE_MOST - side * mu) * root)
        beside *= 0.25 / (BESIDE_MOST - BESIDE_LEAST)
        if beside > 0.0:
            info[MISSING_ODDS] = math.log(k[K_MISSING] * beside) - base
            if info[TURNED] > 0.0:
                info[MISSING_ODDS] += math.log(info[TURNED])


@part
def curved_leg(net, bank, h, c, probe):
    """Whether a window's track is entered over the curved leg of a turnout, facing or trailing."""
    before, way = bank.track[h, c - 1], bank.way[h, c - 1]
    out, into = leaving_end(before, way), entering_end(bank.track[h, c], bank.way[h, c])
    track_point(net, bank.track[h, c], bank.way[h, c], LEG_PLACE, probe)
    own = abs(probe[P_CURVATURE])
    for k in range(net.move_start[out], net.move_start[out + 1]):
        other = net.move_to[k]
        if other != into:
            track_point(net, other // 2, 1 if other % 2 == 0 else -1, LEG_PLACE, probe)
            if own > abs(probe[P_CURVATURE]) + LEG_BEND:
                return True
    track_point(net, before, -way, LEG_PLACE, probe)
    own = abs(probe[P_CURVATURE])
    for k in range(net.move_start[into], net.move_start[into + 1]):
        other = net.move_to[k]
        if other != out:
            track_point(net, other // 2, 1 if other % 2 == 0 else -1, LEG_PLACE, probe)
            if own > abs(probe[P_CURVATURE]) + LEG_BEND:
                return True
    return False


@part
def note_turn(fil, net, shared, bank, h, probe):
    """Note that a train has run through a turnout's curved leg: a track that the model lacks would not lead there."""
    info = bank.info[h]
    c = bank.tags[h, CURRENT]
    track = bank.track[h, c]
    if info[TURN_TRACK] != track:
        info[TURN_TRACK] = track
        trusted = shared.common[C_TIME] >= shared.common[C_YAW_DISTRUST]
        if c > 0 and trusted and info[TURNED] == 0.0 and curved_leg(net, bank, h, c, probe):
            info[TURN_PLACE] = bank.begin[h, c] + 2.0 * LEG_PLACE
    i_s = fil.at[POSITION]
    if bank.x[h, i_s] - GUARD * math.sqrt(variance_of(bank.P_sqrt[h], i_s)) > info[TURN_PLACE]:
        info[TURNED] = TURN_FELT if fil.at[GYRO_BIAS] >= 0 else TURN_SEEN
        info[TURN_PLACE] = np.inf


@part
def log_normal(x, variance):
    """Ln N(x; 0, variance) without the constant."""
    return -0.5 * (x * x / variance + math.log(6.283185307179586 * variance))


@part
def log_sum(a, b):
    """ln(exp(a) + exp(b))."""
    top = max(a, b)
    if top == -np.inf:
        return top
    return top + math.log(math.exp(a - top) + math.exp(b - top))


@inlined
def weigh_positions(fil, bank, slot, h, said, since):
    """Evidence of positions for a hypothesis, whether the receiver is sound or astray: that comes and goes.

    Forward recursion on ln p(fixes, sound) and ln p(fixes, astray); what is older fades. What is known of the constant part
    does not: that it is off by just this much stays as odd as it was, no length of the run makes it likelier. If the receiver is
    astray or its frame is off, its error may be the one that each of several tracks side by side needs, so that positions alone
    never tell one from the other beyond the odds of such a fault.
    """
    k = fil.settings
    info = bank.info[h]
    fade = math.exp(-since / k[K_MEMORY])
    sound, astray = fade * info[FRAMED], fade * info[ASTRAY]
    begins = k[K_ASTRAY_RATE] * since
    ends = since / k[K_ASTRAY_TIME]
    if begins > 0.0 and since > 0.0:
        begins, ends = min(begins, 0.5), min(ends, 0.5)
        odds = info[KNOWN_ODDS]
        info[FRAMED] = log_sum(sound + math.log(1.0 - begins), astray + math.log(ends) - odds) + said + slot[S_FRAMED]
        info[ASTRAY] = log_sum(astray + math.log(1.0 - ends), sound + odds + math.log(begins)) + said + slot[S_ASTRAY]
    else:
        info[FRAMED] = sound + said + slot[S_FRAMED]
        info[ASTRAY] = astray + said + slot[S_ASTRAY]
    known_odds(fil, info, slot[S_KNOWN])
    return log_sum(info[FRAMED] + info[KNOWN_ODDS], info[ASTRAY])


@inlined
def separation_bound(fil, bank, h, time):
    """Bound by solution separation (22): how far the filter lies from dead reckoning that has used no fix for one to two minutes.

    PL = |s - s_0| + K sigma_0, K the two-sided quantile at the risk over the probability of such a fault; 0 where there is none.
    """
    info = bank.info[h]
    begun = info[CHECK + CHECK_TIME]
    if not -np.inf < begun < time or fil.risk[2] <= 0.0:
        return 0.0
    k = fil.settings
    way = (bank.x[h, fil.at[WHEEL_DISTANCE]] - info[CHECK + CHECK_WHEEL]) / (1.0 + info[CHECK + CHECK_SCALE])
    if bank.tags[h, SIGN] < 0 and fil.signed == 0:
        way = -way
    apart = abs(bank.x[h, fil.at[POSITION]] - info[CHECK + CHECK_PLACE] - way)
    variance = info[CHECK + CHECK_VARIANCE] + info[CHECK + CHECK_SCALE_VARIANCE] * way * way
    variance += k[K_ODOMETER_SLIP] ** 2 * abs(way)
    return apart + fil.risk[2] * math.sqrt(variance)


@inlined
def residual_bound(fil, shared, bank, work, h):
    """Bound by solution separation from the fixes alone (22): how far they lie along from the estimate, and what they are worth.

    PL = |e| + K sigma, e the receiver's error along the track as the filter sees it, that of its stamps included: it is the estimate
    that is off by that, if a wheel, an inertial sensor, a clock or the model's curvature has misled it. 2 Q(K) is the risk over the
    probability of such a fault, given e; 0 where faults are not reckoned with.
    """
    if fil.risk[2] <= 0.0:
        return 0.0
    k = fil.settings
    common = shared.common
    x = bank.x[h]
    te, tn = work.point[h, P_D_EAST], work.point[h, P_D_NORTH]
    size = math.hypot(te, tn)
    te, tn = te / size, tn / size
    i_g, i_f = fil.at[GNSS_EAST], fil.at[FRAME_EAST]
    scale = common[C_SCALE] * k[K_CORRELATED]
    east, north = scale * common[C_SIGMA_EAST], scale * common[C_SIGMA_NORTH]
    error = (x[i_f] + east * x[i_g]) * te + (x[i_f + 1] + north * x[i_g + 1]) * tn
    variance = common[C_FRAME_SIGMA] ** 2 + (east * te) ** 2 + (north * tn) ** 2
    # a shift of the stamps moves the fixes along as well: the clock of wheel or gyro may be the one that is wrong
    speed, shift = x[fil.at[SPEED]], x[fil.at[TIME_TAG]]
    stamps = k[K_TAG_SIGMA] ** 2 + k[K_TAG_WALK] ** 2 * max(common[C_TIME] - common[C_START_TIME], 0.0)
    error += speed * shift
    variance += speed * speed * stamps
    # the farther the fixes or their stamps lie, the likelier something has misled the estimate: prior odds, and a wide law's against this
    odd = max(error * error / variance, shift * shift / stamps)
    odds = k[K_GNSS_FAULT] * math.exp(min(0.5 * odd, 50.0)) / FAULT_SPREAD
    quantile = max(fil.risk[2], tail_quantile(min(fil.risk[0] * (1.0 + 1.0 / odds), 1.0)))
    bound = abs(error) + quantile * math.sqrt(variance)
    # a frame that is off across the track is off along as well, as far as nothing else has told the place
    info = bank.info[h]
    framed = frame_off(info)
    if framed <= fil.risk[0]:
        return bound
    share = min(variance_of(bank.P_sqrt[h], fil.at[POSITION]) / variance, 1.0)
    return max(bound, tail_quantile(fil.risk[0] / framed) * abs(info[OFFSET_CROSS]) * share)


@inlined
def frame_off(info):
    """Probability, if the train is on a hypothesis' track, that the run's frame is off by far more than is known of it."""
    if info[FAULT_ODDS] == -np.inf:
        return 0.0
    return math.exp(info[FRAMED] + info[FAULT_ODDS] - log_sum(info[FRAMED] + info[KNOWN_ODDS], info[ASTRAY]))


@part
def track_missing(info):
    """Probability that the train is on a track beside a hypothesis' that the model lacks, rather than on the hypothesis' own."""
    if info[MISSING_ODDS] == -np.inf:
        return 0.0
    elsewhere = info[FRAMED] + info[MISSING_ODDS]
    here = log_sum(info[FRAMED] + info[KNOWN_ODDS], info[ASTRAY])
    return math.exp(elsewhere - log_sum(here, elsewhere))


@part
def tail_quantile(risk):
    """Two-sided normal quantile, k with 2 Q(k) = risk, from above: within 3 % from 1e-9 to 0.3 (Hastings' rational approximation)."""
    t = math.sqrt(-2.0 * math.log(0.5 * risk))
    k = t - (2.515517 + t * (0.802853 + t * 0.010328)) / (1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308)))
    return max(k + 5e-4, 0.0)


@inlined
def watch_misfit(common, nis):
    """Follow the squared normalised innovation of fixes in the hypothesis that they fit best, per degree of freedom, over 20 fixes."""
    share = max(1.0 / MISFIT_FIXES, 1.0 / (1.0 + common[C_FIXES]))
    common[C_MISFIT] += share * (0.5 * nis - common[C_MISFIT])


@inlined
def understated(common):
    """By how much the sigmas of fixes are too small, as their innovations show beyond chance: 1 where they are not."""
    return math.sqrt(max(common[C_MISFIT] / MISFIT_USUAL, 1.0))


@njit(cache=True)
def mixture_bound(weight, mean, sigma, count, risk, quantile):  # (count,) each -> m
    """Smallest L with sum w [Q((L - mu)/sigma) + Q((L + mu)/sigma)] <= risk (section 22), from above.

    Newton steps on the logarithm of the tail, which is nearly concave: they come from the safe side; bisection where they leave the
    bracket.
    """
    if count == 1 and mean[0] == 0.0:
        return quantile * sigma[0]
    low = 0.0
    high = 0.0
    for i in range(count):
        high = max(high, abs(mean[i]) + (quantile + 0.1) * sigma[i])
    root = math.sqrt(0.5)
    at = high
    for _ in range(40):
        total = 0.0
        density = 0.0
        for i in range(count):
            a = (at - mean[i]) / sigma[i] * root
            b = (at + mean[i]) / sigma[i] * root
            total += 0.5 * weight[i] * (math.erfc(a) + math.erfc(b))
            density += weight[i] / sigma[i] * (math.exp(-a * a) + math.exp(-b * b))
        if total > risk:
            low = at
        else:
            high = at
            if total > 0.99 * risk:
                break
        if high - low < 1e-4 * high:
            break
        density *= 0.3989422804014327
        new = at + total / density * math.log(total / risk) if density > 0.0 and total > 0.0 else -1.0
        at = new if low < new < high else 0.5 * (low + high)
    return high
