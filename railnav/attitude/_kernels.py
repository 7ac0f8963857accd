"""Quaternions in scalars, for inner loops: radians, scalar first, no validation."""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True)
def multiply(a0, a1, a2, a3, b0, b1, b2, b3):
    """Hamilton product a b."""
    return (
        a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
        a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
        a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
        a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
    )


@njit(cache=True)
def exponential(x, y, z):  # rad
    """Quaternion of a rotation vector; a series below 0.2 rad, exact to the last place."""
    square = 0.25 * (x * x + y * y + z * z)  # of the half angle
    if square < 0.01:
        cosine = 1.0 - square * (1.0 / 2.0 - square * (1.0 / 24.0 - square * (1.0 / 720.0 - square / 40320.0)))
        factor = 0.5 - square * (1.0 / 12.0 - square * (1.0 / 240.0 - square * (1.0 / 10080.0 - square / 725760.0)))
    else:
        half = math.sqrt(square)
        cosine = math.cos(half)
        factor = 0.5 * math.sin(half) / half
    return cosine, factor * x, factor * y, factor * z


@njit(cache=True)
def rotate(q0, q1, q2, q3, x, y, z):
    """Vector q v q*, for a unit quaternion."""
    tx = 2.0 * (q2 * z - q3 * y)
    ty = 2.0 * (q3 * x - q1 * z)
    tz = 2.0 * (q1 * y - q2 * x)
    return (
        x + q0 * tx + q2 * tz - q3 * ty,
        y + q0 * ty + q3 * tx - q1 * tz,
        z + q0 * tz + q1 * ty - q2 * tx,
    )


@njit(cache=True)
def propagate_kernel(start, rotation_vectors, out):  # (4,), (m, 3) rad, (m + 1, 4)
    """Quaternions after each body-fixed rotation in turn, kept at unit length."""
    q0, q1, q2, q3 = start[0], start[1], start[2], start[3]
    out[0] = start
    for i in range(rotation_vectors.shape[0]):
        e0, e1, e2, e3 = exponential(rotation_vectors[i, 0], rotation_vectors[i, 1], rotation_vectors[i, 2])
        q0, q1, q2, q3 = multiply(q0, q1, q2, q3, e0, e1, e2, e3)
        shrink = 1.5 - 0.5 * (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)  # 1/norm to second order
        q0 *= shrink
        q1 *= shrink
        q2 *= shrink
        q3 *= shrink
        out[i + 1, 0] = q0
        out[i + 1, 1] = q1
        out[i + 1, 2] = q2
        out[i + 1, 3] = q3
