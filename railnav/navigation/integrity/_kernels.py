"""Protection levels (specification 22): of a mixture of normal hypotheses, and by solution separation. No validation."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from railnav.matching._kernels import (
    CHECK,
    CHECK_PLACE,
    CHECK_SCALE,
    CHECK_SCALE_VARIANCE,
    CHECK_SIZE,
    CHECK_TIME,
    CHECK_VARIANCE,
    CHECK_WHEEL,
    SIGN,
    part,
)
from railnav.navigation.columns import (
    CHECK_INTERVAL,
    K_ODOMETER_SLIP,
    ODOMETER_SCALE,
    POSITION,
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
