"""Frames of UBX messages in a block of bytes."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

#: Columns of what `frames` finds.
CLASS_ID, PAYLOAD, LENGTH = 0, 1, 2
_MAX_PAYLOAD = 8192


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def frames(
    data: NDArray[np.uint8], last: bool, out: NDArray[np.int64]
) -> tuple[int, int]:  # pragma: no cover - compiled
    """Find whole messages with a right checksum: rows (class * 256 + id, payload, length); says how much was used and found."""
    n, i, count = len(data), 0, 0
    while i + 8 <= n and count < len(out):
        if data[i] != 0xB5 or data[i + 1] != 0x62:
            i += 1
            continue
        size = int(data[i + 4]) | (int(data[i + 5]) << 8)
        if size > _MAX_PAYLOAD:
            i += 2
            continue
        if i + 8 + size > n:
            if last:
                i += 2
                continue
            break
        a = b = 0
        for k in range(i + 2, i + 6 + size):  # checksum over class, id, length, payload
            a = (a + data[k]) & 0xFF
            b = (b + a) & 0xFF
        if a != data[i + 6 + size] or b != data[i + 7 + size]:
            i += 2
            continue
        out[count, CLASS_ID] = int(data[i + 2]) * 256 + int(data[i + 3])
        out[count, PAYLOAD] = i + 6
        out[count, LENGTH] = size
        count += 1
        i += 8 + size
    if last and count < len(out):
        return n, count
    return i, count
