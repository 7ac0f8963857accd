"""Waves in the errors of measured points: what they are most likely to be, given what the points lie off an axis.

Waves are a process along the track (`Noise`); reckoned as unknowns z beside the elements, each step of theirs an observation of its
own, they turn a least squares of correlated points into a sparse one of independent observations (docs/theory/alignment.md, eq 11).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.fitting.segmentation import Noise

FloatArray = NDArray[np.float64]


class Waves:
    """Waves at points in order.

    Attributes
    ----------
    count : int
        Unknowns: none without waves, one a point, or two (the wave and its scaled slope) where waves are smooth.
    steps : sparse array (count, count)
        From unknowns to independent steps of unit variance.
    """

    def __init__(self, along: FloatArray, noise: Noise) -> None:
        from scipy import sparse

        n = len(along)
        self.points = n
        self.states = 0 if noise.correlated <= 0.0 else 2 if noise.smooth else 1
        self.count = self.states * n
        self.steps: Any = sparse.csr_array((self.count, self.count))
        self.pick: Any = sparse.csr_array((n, self.count))
        if not self.states:
            return
        step = np.maximum(np.diff(along), 1e-3)
        rows = np.arange(n)
        if self.states == 1:
            decay = np.exp(-step / noise.length)
            size = np.append(1.0, np.sqrt(1.0 - decay**2)) * noise.correlated
            self.steps = sparse.diags_array([1.0 / size, -decay / size[1:]], offsets=[0, -1], format="csr")
            self.pick = sparse.eye_array(n, format="csr")
        else:
            passing, colour = noise.passing(step)
            scale = np.sqrt(colour)  # both states in units of their own size
            move = passing.reshape(-1, 2, 2) * (scale[None, None, :] / scale[None, :, None])
            gain = np.eye(2) - move @ move.transpose(0, 2, 1)
            root = np.linalg.cholesky(gain + 1e-13 * np.eye(2))
            inverse = np.linalg.inv(root)
            passed = -(inverse @ move)
            blocks = np.concatenate([np.eye(2)[None], inverse]).ravel()
            i, a, b = (v.ravel() for v in np.meshgrid(rows, [0, 1], [0, 1], indexing="ij"))
            later = i[4:]
            self.steps = sparse.csr_array(
                (
                    np.concatenate([blocks, passed.ravel()]),
                    (
                        np.concatenate([2 * i + a, 2 * later + a[4:]]),
                        np.concatenate([2 * i + b, 2 * (later - 1) + b[4:]]),
                    ),
                ),
                shape=(self.count, self.count),
            )
            self.pick = sparse.csr_array((np.full(n, scale[0]), (rows, 2 * rows)), shape=(n, self.count))
        self._band = 1 if self.states == 1 else 3
        normal = (self.steps.T @ self.steps).todia()
        self._normal = np.zeros((self._band + 1, self.count))
        for offset, data in zip(normal.offsets.tolist(), normal.data, strict=True):
            if -self._band <= offset <= 0:
                self._normal[-offset, : self.count + offset] = data[: self.count + offset]

    def likeliest(self, off: FloatArray, weight: FloatArray) -> FloatArray:
        """Unknowns (count,) that explain distances `off` (n,), m, of weight (n,), 1/m^2, best."""
        if not self.states:
            return np.empty(0)
        from scipy.linalg import solveh_banded

        bands = self._normal.copy()
        bands[0] += self.pick.T.power(2) @ weight
        return np.asarray(solveh_banded(bands, self.pick.T @ (weight * off), lower=True, check_finite=False))

    def at(self, unknowns: FloatArray) -> FloatArray:
        """Waves at the points, (n,), m."""
        return np.asarray(self.pick @ unknowns) if self.states else np.zeros(self.points)

    def squares(self, unknowns: FloatArray) -> FloatArray:
        """Squares of the steps that lead to each point, (n,)."""
        if not self.states:
            return np.zeros(self.points)
        return np.asarray(((self.steps @ unknowns) ** 2).reshape(self.points, self.states).sum(axis=1))
