"""Protection level of a mixture of normal hypotheses (specification 22). No validation."""

from __future__ import annotations

import math

from numba import njit


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
