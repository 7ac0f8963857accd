"""The six faces of a cube: which position is which, what each axis reads there, and how well repeated faces agree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError
from railnav.inertial.positions import LARGEST_TILT, PositionResult

FloatArray = NDArray[np.float64]


def faces(
    found: Sequence[PositionResult], means: FloatArray, what: Literal["up", "turning"]
) -> tuple[FloatArray, FloatArray, list[int], float | None]:
    """Readings of each axis with that axis up and down (or turned both ways), how many there were of each, and how those of one scatter."""
    sums, squares, counts = np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((3, 2), dtype=int)
    whole = len(found) >= 6
    # the bias of raw gyros may be half the rate, of raw accelerometers a sixth of gravity
    bias = np.median(means, axis=0) if whole else np.zeros(3)
    for one, mean in zip(found, means, strict=True):
        sensed = mean - bias
        axis = int(np.argmax(np.abs(sensed)))
        tilt = math.acos(min(1.0, abs(sensed[axis]) / float(np.linalg.norm(sensed))))
        if whole and tilt > LARGEST_TILT:
            raise EstimationError(
                f"position {one.name} lies {math.degrees(tilt):.0f} degrees off the nearest axis: level it (to a degree), or use "
                f"{'multi-position' if what == 'up' else 'modified-multi-position'}, which takes any attitude"
            )
        side = int(sensed[axis] < 0.0)
        sums[axis, side] += mean[axis]
        squares[axis, side] += mean[axis] ** 2
        counts[axis, side] += 1
    missing = [f"{'+-'[side]}{'xyz'[axis]}" for axis in range(3) for side in range(2) if not counts[axis, side]]
    if missing:
        verb = "up" if what == "up" else "turning (rate of this sign)"
        leave = "1 position leaves" if len(found) == 1 else f"{len(found)} positions leave"
        raise EstimationError(f"{leave} faces out; add positions with these axes {verb}: {'; '.join(missing)}")
    mean = sums / counts
    left = len(found) - 6
    scatter = math.sqrt(max(float(np.sum(squares) - np.sum(counts * mean**2)), 0.0) / left) if left else None
    return mean[:, 0], mean[:, 1], counts.ravel().tolist(), scatter


def repeated_sigma(sigma: float, counts: list[int], scatter: float | None, remarks: list[str], what: str) -> float:
    """Sigma of the mean of a face: of the readings' noise, or of what repeated faces scatter by, if that is more."""
    if scatter is None:
        remarks.append(
            f"six positions leave nothing over: the sigmas of the {what} are those of the readings' noise; take each face twice, and they "
            "know the slow parts too"
        )
    return max(sigma, scatter or 0.0) / math.sqrt(min(counts))
