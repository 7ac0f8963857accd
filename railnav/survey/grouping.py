"""Which runs share a track: as run.toml says, unless the data clearly say otherwise; by geometry where it says nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from railnav.survey.offsets import HOLD, robust_fit

FloatArray = NDArray[np.float64]

#: Pairs whose differences scatter less than this see single tracks, m.
PRECISE = 0.75
#: Precise runs farther apart than this over most of their common way are on two tracks, m.
APART = 1.5
#: Runs without a direction that scatter widely: two tracks when the two senses of running differ by this many sigma and this much, m.
SENSE_SIGMA, SENSE_APART = 3.0, 2.0


def parallel_distance(D: FloatArray, design: FloatArray) -> tuple[float, float, int]:
    """Part of a difference profile that keeps beside the track, m, its scatter, m, and the number of nodes.

    A difference of frames is a constant vector (east, north) and shows as its component across the track; a second track shows as
    a constant distance to the right. On a straight line they are one, and count as distance.
    """
    use = np.isfinite(D)
    many = int(np.count_nonzero(use))
    if many < 5:
        return float("nan"), float("nan"), many
    A = np.column_stack([np.ones(many), design[use]])
    x, spread = robust_fit(A, D[use], np.array([0.0, HOLD, HOLD]))
    return float(x[0]), spread, many


def tracks_of_line(
    value: FloatArray, design: FloatArray, labels: list[str], senses: list[int], names: list[str]
) -> tuple[list[list[int]], list[str]]:
    """Sort the runs of a line into tracks.

    Parameters
    ----------
    value : (K, N) array
        Distances to the right of the line's nominal curve, m; NaN where a run has none.
    design : (N, 2) array
        Normal of the curve.
    labels : list of str
        Direction as run.toml gives it, or empty.
    senses : list of int
        +1 or -1: how each run goes along the curve.
    names : list of str
        Identifiers of the runs, for the warnings.

    Returns
    -------
    groups : list of list of int
        Rows of `value` that share a track.
    warnings : list of str
    """
    K = len(value)
    parent = list(range(K))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    def join(i: int, j: int) -> None:
        parent[max(root(i), root(j))] = min(root(i), root(j))

    warnings: list[str] = []
    undecided: list[tuple[int, int, float]] = []
    within: list[float] = []
    for i in range(K):
        for j in range(i + 1, K):
            apart, scatter, common = parallel_distance(value[i] - value[j], design)
            told = bool(labels[i]) and bool(labels[j])
            if common >= 20 and scatter < PRECISE:
                together = abs(apart) <= APART
                if told and together != (labels[i] == labels[j]):
                    what = "run on one track" if together else f"are {abs(apart):.1f} m apart, on two tracks"
                    kind = "the same direction" if labels[i] == labels[j] else "different directions"
                    warnings.append(f"runs {names[i]} and {names[j]} have {kind} but {what}: the data decide")
            elif told:
                together = labels[i] == labels[j]
            else:
                together = senses[i] == senses[j]
                if not together:
                    if np.isfinite(apart):
                        undecided.append((i, j, senses[i] * apart))
                    continue
                if np.isfinite(apart):
                    within.append(apart)
            if together:
                join(i, j)
    if undecided:
        distance = np.array([d for _, _, d in undecided])
        own = max(float(np.std(within)) / np.sqrt(2.0) if len(within) > 1 else 1.0, 1.0)
        many = min(len({i for i, _, _ in undecided}), len({j for _, j, _ in undecided}))
        sigma = own * np.sqrt(2.0 / many)
        gap = float(np.mean(distance))
        if abs(gap) > max(SENSE_APART, SENSE_SIGMA * sigma):
            warnings.append(
                f"runs name no direction; the two senses of running lie {abs(gap):.1f} m apart (sigma {sigma:.1f} m): two tracks"
            )
        else:
            for i, j, _ in undecided:
                join(i, j)
            warnings.append(
                f"runs name no direction; the two senses of running lie {abs(gap):.1f} m apart (sigma {sigma:.1f} m), too little to "
                "tell two tracks: one track is built; name `direction` in run.toml if there are two"
            )
    groups: dict[int, list[int]] = {}
    for i in range(K):
        groups.setdefault(root(i), []).append(i)
    return list(groups.values()), warnings
