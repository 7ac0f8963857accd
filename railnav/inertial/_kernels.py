"""Inner loops of the inertial room: flat float64 arrays, SI and radians, no validation."""

from __future__ import annotations

from numba import njit


@njit(cache=True)
def allan_kernel(integral, factors, variance):  # (n + 1,) integral per sampling interval, (k,), (k,)
    """Overlapping Allan variance at each averaging factor."""
    points = integral.shape[0]
    for i in range(factors.shape[0]):
        m = factors[i]
        total = 0.0
        for k in range(points - 2 * m):
            d = integral[k + 2 * m] - 2.0 * integral[k + m] + integral[k]
            total += d * d
        variance[i] = total / (2.0 * m * m * (points - 2 * m))  # IEEE Std 952, C.11
