"""Runs reduced to profiles along a curve: one mean a run and node, so that a stop weighs no more than a pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.survey.fixes import USED, Fixes
from railnav.survey.nominal import Nominal, along

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(slots=True, eq=False)
class Traverse:
    """One run laid along a nominal curve.

    Attributes
    ----------
    fixes : Fixes
    offset, right : (m,) array
        Place of the reference point along the curve and to its right, m; NaN where too far from it.
    sense : int
        +1 when the run goes as the curve does, -1 against it.
    sigma : (m,) array or None
        Stated standard deviation across the curve, m, from those east and north; None where the run does not state both.
    """

    fixes: Fixes
    offset: FloatArray
    right: FloatArray
    sense: int
    sigma: FloatArray | None = None


def traverse(nominal: Nominal, fixes: Fixes, limit: float) -> Traverse:
    """Lay a run along a curve and bring its antenna to the reference point."""
    s, d = along(nominal, fixes, limit)
    here = np.isfinite(s) & (fixes.reason == USED)
    sense = 1
    if np.count_nonzero(here) >= 2:
        sense = 1 if float(np.diff(s[here]).sum()) >= 0.0 else -1
    sigma = None
    if fixes.sigma_axes is not None:
        node = np.clip(np.rint(np.nan_to_num(s) / nominal.step), 0, len(nominal) - 1).astype(np.int64)
        e, n = nominal.normal
        sigma = np.hypot(fixes.sigma_axes[0] * e[node], fixes.sigma_axes[1] * n[node])  # n^T K n
    return Traverse(fixes, s - sense * fixes.forward, d - sense * fixes.right, sense, sigma)


@dataclass(slots=True, eq=False)
class Profiles:
    """K runs as values at the N nodes of a curve; NaN where a run has nothing.

    Attributes
    ----------
    right : (K, N) array
        Mean distance to the right of the curve, m.
    lead : (K, N) array
        Mean place of those fixes beyond the node, m (within half a step).
    count : (K, N) array
        How many fixes stand behind it, at a stop no more than in an ordinary passing.
    height, height_lead : (K, N) array
        Mean height, m, and mean place of the fixes with height.
    time : (K, N) array
        When the run passed the node, s, interpolated where it has no fix; constant beyond its ends.
    sigma : (K, N) array
        Mean stated sigma across, m.
    height_sigma : (K, N) array or None
        Mean stated sigma of the heights, m.
    """

    right: FloatArray
    lead: FloatArray
    count: FloatArray
    height: FloatArray
    height_lead: FloatArray
    time: FloatArray
    sigma: FloatArray
    height_sigma: FloatArray | None = None

    @property
    def present(self) -> BoolArray:
        """Where a run has fixes (K, N)."""
        return self.count > 0


def passing_count(count: FloatArray) -> float:
    """Most fixes that a node holds in an ordinary passing: their spacing does not divide the nodes' evenly, so one above the median."""
    return float(np.median(count)) + 1.0 if len(count) else 1.0


def profiles(traverses: Sequence[Traverse], nodes: int, step: float) -> Profiles:
    """Reduce runs to node means of their used fixes."""
    K = len(traverses)
    out = Profiles(*(np.full((K, nodes), np.nan) for _ in range(8)))
    assert out.height_sigma is not None
    out.count[:] = 0.0
    for k, t in enumerate(traverses):
        f = t.fixes
        use = np.flatnonzero((f.reason == USED) & np.isfinite(t.offset))
        node = np.rint(t.offset[use] / step).astype(np.int64)
        inside = (node >= 0) & (node < nodes)
        use, node = use[inside], node[inside]
        if not len(use):
            out.time[k] = 0.0
            continue
        count = np.bincount(node, minlength=nodes).astype(float)
        hit = count > 0

        def mean(
            values: FloatArray, node: IntArray = node, count: FloatArray = count, hit: BoolArray = hit
        ) -> FloatArray:
            total = np.bincount(node, weights=values, minlength=nodes)
            return np.where(hit, total / np.maximum(count, 1.0), np.nan)

        out.right[k] = mean(t.right[use])
        out.lead[k] = mean(t.offset[use] - node * step)
        out.sigma[k] = mean((f.sigma if t.sigma is None else t.sigma)[use])
        out.count[k] = np.minimum(count, passing_count(count[hit]))
        when = mean(f.time[use])
        out.time[k] = np.interp(np.arange(nodes), np.flatnonzero(hit), when[hit])
        up = np.isfinite(f.height[use])
        if up.any():
            n_up = np.bincount(node[up], minlength=nodes)
            out.height[k] = np.where(
                n_up > 0,
                np.bincount(node[up], weights=f.height[use][up], minlength=nodes) / np.maximum(n_up, 1),
                np.nan,
            )
            if f.sigma_axes is not None:
                out.height_sigma[k] = np.where(
                    n_up > 0,
                    np.bincount(node[up], weights=f.sigma_axes[2][use][up], minlength=nodes) / np.maximum(n_up, 1),
                    np.nan,
                )
            out.height_lead[k] = np.where(
                n_up > 0,
                np.bincount(node[up], weights=(t.offset[use] - node * step)[up], minlength=nodes) / np.maximum(n_up, 1),
                np.nan,
            )
    return out
