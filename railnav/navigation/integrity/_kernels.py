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
    FADING,
    FRAMED,
    FRAMED_CROSS,
    FRAMED_ODDS,
    FRAMED_VARIANCE,
    P_D_EAST,
    P_D_NORTH,
    SIGN,
    part,
)
from railnav.navigation.columns import (
    C_FIXES,
    C_FRAME_SIGMA,
    C_MISFIT,
    C_SCALE,
    C_SIGMA_EAST,
    C_SIGMA_NORTH,
    CHECK_INTERVAL,
    FAULT_SPREAD,
    FRAME_EAST,
    FRAME_NORTH,
    GNSS_EAST,
    K_ASTRAY_RATE,
    K_ASTRAY_TIME,
    K_ASTRAY_WALK,
    K_CORRELATED,
    K_FRAME_FAULT,
    K_FRAME_FAULT_SIGMA,
    K_GNSS_FAULT,
    K_GNSS_TIME,
    K_MEMORY,
    K_ODOMETER_SLIP,
    MISFIT_FIXES,
    MISFIT_USUAL,
    ODOMETER_SCALE,
    POSITION,
    S_ASTRAY,
    S_FRAMED,
    WHEEL_DISTANCE,
)
from railnav.navigation.dynamics._kernels import variance_of


@part
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
    """How much likelier a fix is across the track if the receiver has gone astray, and if the run's frame is off, ln, into its slot.

    The error is then anything: it wanders, fast for a receiver astray, and for a frame no faster than the correlated part does. Call
    it before the fix is let in: `work` holds the innovation and its covariance. What the fix says along the track, given across, is
    the same under all laws, and all saturate alike, as a whole: else a track that is all wrong would be let off its errors along.
    """
    k = fil.settings
    info = bank.info[h]
    slot = work.slot[h]
    x, fix = bank.x[h], work.fix[h]
    te, tn = work.point[h, P_D_EAST], work.point[h, P_D_NORTH]
    size = math.hypot(te, tn)
    te, tn = te / size, tn / size
    i_g = fil.at[GNSS_EAST]
    scale = work.rows[h, 0, i_g]
    east = scale * x[i_g] + x[fil.at[FRAME_EAST]]
    north = work.rows[h, 1, i_g + 1] * x[i_g + 1] + x[fil.at[FRAME_NORTH]]
    innovation = fix[0] * tn - fix[1] * te
    error = innovation + east * tn - north * te
    usual = fix[4] * tn * tn - 2.0 * fix[6] * te * tn + fix[5] * te * te
    white = fix[2] * tn * tn + fix[3] * te * te
    along = max(nis - innovation * innovation / usual, 0.0)
    sound = min(nis, held) + math.log(usual)
    astray, spread = wander(info, ASTRAY_CROSS, ASTRAY_VARIANCE, error, white, k[K_ASTRAY_WALK] ** 2 * since)
    slot[S_ASTRAY] = 0.5 * (sound - min(along + astray, held) - math.log(spread)) if astray == astray else 0.0
    walk = 2.0 * scale * scale / k[K_GNSS_TIME] * since
    framed, spread = wander(info, FRAMED_CROSS, FRAMED_VARIANCE, error, white, walk)
    slot[S_FRAMED] = 0.5 * (sound - min(along + framed, held) - math.log(spread)) if framed == framed else 0.0
    # that a frame is off, and off by just this much, stays as odd as it was: no length of the run makes it likelier
    if k[K_FRAME_FAULT] > 0.0:
        usual = scale * scale + white
        anywhere = usual + k[K_FRAME_FAULT_SIGMA] ** 2
        size = info[FRAMED_CROSS] * info[FRAMED_CROSS] / anywhere
        info[FRAMED_ODDS] = math.log(k[K_FRAME_FAULT]) + 0.5 * (math.log(usual / anywhere) - size)


@part
def log_sum(a, b):
    """ln(exp(a) + exp(b))."""
    top = max(a, b)
    if top == -np.inf:
        return top
    return top + math.log(math.exp(a - top) + math.exp(b - top))


@part
def weigh_positions(fil, bank, slot, h, said, since):
    """Evidence of positions for a hypothesis, whether the receiver is sound, astray, or its frame off: the first two come and go.

    Forward recursion on ln p(fixes, sound), ln p(fixes, astray) and ln p(fixes, framed); what is older fades. If the receiver is
    astray or its frame is off, its error may be the one that each of several tracks side by side needs, so that positions alone
    never tell one from the other beyond the odds of such a fault.
    """
    k = fil.settings
    info = bank.info[h]
    fade = math.exp(-since / k[K_MEMORY])
    sound, astray = fade * info[FADING], fade * info[ASTRAY]
    begins = k[K_ASTRAY_RATE] * since
    ends = since / k[K_ASTRAY_TIME]
    if begins > 0.0 and since > 0.0:
        begins, ends = min(begins, 0.5), min(ends, 0.5)
        info[FADING] = log_sum(sound + math.log(1.0 - begins), astray + math.log(ends)) + said
        info[ASTRAY] = log_sum(astray + math.log(1.0 - ends), sound + math.log(begins)) + said + slot[S_ASTRAY]
    else:
        info[FADING] = sound + said
        info[ASTRAY] = astray + said + slot[S_ASTRAY]
    info[FRAMED] = fade * info[FRAMED] + said + slot[S_FRAMED]
    return log_sum(log_sum(info[FADING], info[ASTRAY]), info[FRAMED] + info[FRAMED_ODDS])


@part
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


@part
def residual_bound(fil, shared, bank, work, h):
    """Bound by solution separation from the fixes alone (22): how far they lie along from the estimate, and what they are worth.

    PL = |e| + K sigma, e the receiver's error along the track as the filter sees it: it is the estimate that is off by that, if a
    wheel, an inertial sensor or the model's curvature has misled it. 2 Q(K) is the risk over the probability of such a fault, given e;
    0 where faults are not reckoned with.
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
    # the farther the fixes lie, the likelier something has misled the estimate: prior odds, and those of a wide law against this one
    odds = k[K_GNSS_FAULT] * math.exp(min(0.5 * error * error / variance, 50.0)) / FAULT_SPREAD
    quantile = max(fil.risk[2], tail_quantile(min(fil.risk[0] * (1.0 + 1.0 / odds), 1.0)))
    bound = abs(error) + quantile * math.sqrt(variance)
    # a frame that is off across the track is off along as well, as far as nothing else has told the place
    info = bank.info[h]
    framed = frame_off(info)
    if framed <= fil.risk[0]:
        return bound
    share = min(variance_of(bank.P_sqrt[h], fil.at[POSITION]) / variance, 1.0)
    return max(bound, tail_quantile(fil.risk[0] / framed) * abs(info[FRAMED_CROSS]) * share)


@part
def frame_off(info):
    """Probability, if the train is on a hypothesis' track, that the run's frame is off by far more than is known of it."""
    framed = info[FRAMED] + info[FRAMED_ODDS]
    return math.exp(framed - log_sum(log_sum(info[FADING], info[ASTRAY]), framed))


@part
def tail_quantile(risk):
    """Two-sided normal quantile, k with 2 Q(k) = risk, from above: within 3 % from 1e-9 to 0.3 (Hastings' rational approximation)."""
    t = math.sqrt(-2.0 * math.log(0.5 * risk))
    k = t - (2.515517 + t * (0.802853 + t * 0.010328)) / (1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308)))
    return max(k + 5e-4, 0.0)


@part
def watch_misfit(common, nis):
    """Follow the squared normalised innovation of fixes in the hypothesis that they fit best, per degree of freedom, over 20 fixes."""
    share = max(1.0 / MISFIT_FIXES, 1.0 / (1.0 + common[C_FIXES]))
    common[C_MISFIT] += share * (0.5 * nis - common[C_MISFIT])


@part
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
