"""Rows into a triangle, and triangles inverted: the loops that the other kernels of this room call.

Empty the numba caches of this room, and of rooms that call these, after a change here (numba watches one file only).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: A pivot this small against the row it would come from counts as empty (rail 15.8).
PIVOT_TOLERANCE = 1e-12
EMPTY = PIVOT_TOLERANCE * PIVOT_TOLERANCE


@njit(cache=True)  # type: ignore[untyped-decorator]
def insert_row_kernel(W: FloatArray, row: FloatArray) -> tuple[int, float]:
    """Rotate one row into the triangle [R | b] (rail 5, eqs 22-23); give (pivot, 0) if necessary, (-1, f) if redundant."""
    # W (p, p + 1) upper triangular with its right-hand side, row (p + 1,): both overwritten
    p = W.shape[0]
    norm2 = 0.0
    for j in range(p):
        norm2 += row[j] * row[j]
    floor = PIVOT_TOLERANCE * np.sqrt(norm2)
    for j in range(p):
        a = row[j]
        if a == 0.0:
            continue
        r = W[j, j]
        if r == 0.0:
            if abs(a) <= floor:  # what rounding left of a zero is no information
                row[j] = 0.0
                continue
            sign = 1.0 if a > 0.0 else -1.0
            for i in range(j, p + 1):
                W[j, i] = sign * row[i]
                row[i] = 0.0
            return j, 0.0
        h = np.sqrt(r * r + a * a)
        c = r / h
        s = a / h
        W[j, j] = h
        row[j] = 0.0
        for i in range(j + 1, p + 1):
            t = W[j, i]
            W[j, i] = c * t + s * row[i]
            row[i] = c * row[i] - s * t
    return -1, float(row[p])


@njit(cache=True)  # type: ignore[untyped-decorator]
def insert_rows_kernel(W: FloatArray, rows: FloatArray, count: int) -> tuple[float, int]:
    """Rotate `count` rows in one by one; give the sum of f^2 and the number of redundant rows (rows of zeros are absent)."""
    # W (p, p + 1), rows (at least count, p + 1): both overwritten
    p = W.shape[0]
    total = 0.0
    redundant = 0
    for i in range(count):
        empty = True
        for j in range(p):
            if rows[i, j] != 0.0:
                empty = False
                break
        if empty:
            continue
        pivot, f = insert_row_kernel(W, rows[i])
        if pivot < 0:
            total += f * f
            redundant += 1
    return total, redundant


@njit(cache=True)  # type: ignore[untyped-decorator]
def invert_upper_kernel(R: FloatArray, inverse: FloatArray) -> None:
    """Invert the upper triangle in the first n columns of R."""
    # R (n, >= n) with non-zero diagonal; inverse (n, n) out, zeros below the diagonal
    n = inverse.shape[0]
    for j in range(n):
        for i in range(n):
            inverse[i, j] = 0.0
        inverse[j, j] = 1.0 / R[j, j]
        for i in range(j - 1, -1, -1):
            t = 0.0
            for c in range(i + 1, j + 1):
                t -= R[i, c] * inverse[c, j]
            inverse[i, j] = t / R[i, i]
