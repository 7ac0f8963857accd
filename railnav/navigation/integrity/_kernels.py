"""Protection level of a mixture of normal hypotheses (specification 22). No validation."""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True)
def mixture_bound(weight, mean, sigma, count, risk, quantile):  # (count,) each -> m
    """Smallest L with sum w [Q((L - mu)/sigma) + Q((L + mu)/sigma)] <= risk (section 22), by bisection from above."""
    if count == 1 and mean[0] == 0.0:
        return quantile * sigma[0]
    low = 0.0
    high = 0.0
    for i in range(count):
        high = max(high, abs(mean[i]) + (quantile + 0.1) * sigma[i])
    root = math.sqrt(0.5)
    for _ in range(30):
        middle = 0.5 * (low + high)
        total = 0.0
        for i in range(count):
            total += (
                0.5
                * weight[i]
                * (math.erfc((middle - mean[i]) / sigma[i] * root) + math.erfc((middle + mean[i]) / sigma[i] * root))
            )
        if total > risk:
            low = middle
        else:
            high = middle
        if high - low < 1e-3 * high:
            break
    return high
