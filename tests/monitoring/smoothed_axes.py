"""Simulated axes of surveys: fixes with white noise and waves about a true line, smoothed by a random walk of curvature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.design import Design
from railnav.monitoring.fitting import Axis, axis_of_points
from railnav.monitoring.fitting.surveyed import noise_of_smoothed

FloatArray = NDArray[np.float64]


def surveyed_axis(
    design: Design,
    seed: int,
    *,
    step: float = 20.0,
    white: float = 0.8,
    waves: float = 1.5,
    length: float = 4000.0,
    walk: float = 4.5e-5,
) -> Axis:
    """The likeliest axis through noisy fixes at each node, with what its estimate states of itself.

    Nodes stand `step` metres apart and each has a fix with white noise and waves (exponential over `length`), m; the curvature is
    taken to walk by `walk` 1/m per sqrt(m), as `railnav build` does.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    station = np.arange(0.0, design.length, step)
    here = design.at(design.start + station)
    n, h = len(station), step
    rng = np.random.default_rng(seed)
    keep = np.exp(-h / length)
    drive = rng.normal(0.0, waves, n) * np.append(1.0, np.full(n - 1, np.sqrt(1.0 - keep**2)))
    common = np.empty(n)
    at = 0.0
    for k in range(n):
        at = drive[k] if k == 0 else keep * at + drive[k]
        common[k] = at
    fix = common + rng.normal(0.0, white, n)
    Q = np.array([[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2], [h**3 / 6, h**2 / 2, h]])
    scale = np.sqrt(np.diag(Q))
    W = np.linalg.inv(np.linalg.cholesky(Q / np.outer(scale, scale))) / scale / walk
    F = np.array([[1.0, h, 0.5 * h * h], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
    # unknowns of a node: distance from the true line, slope, and curvature less the true one; then the waves
    steps = sparse.kron(sparse.eye_array(n - 1, n), -W @ F) + sparse.kron(sparse.eye_array(n - 1, n, k=1), W)
    bend = W[:, 2][None, :] * -np.diff(here.curvature)[:, None]
    pick = sparse.kron(sparse.eye_array(n), np.array([[1.0, 0.0, 0.0]])) / white
    decay = np.sqrt(1.0 - keep**2) * waves
    forget = sparse.diags_array(
        [np.append(1.0 / waves, np.full(n - 1, 1.0 / decay)), np.full(n - 1, -keep / decay)], offsets=[0, -1]
    )
    first = sparse.csr_array(np.eye(3, 3 * n) / np.array([[1e3], [1.0], [5e-3]]))
    rows = sparse.block_array(
        [[steps, None], [pick, sparse.eye_array(n) / white], [None, forget], [first, sparse.csr_array((3, n))]],
        format="csc",
    )
    value = np.concatenate([bend.ravel(), fix / white, np.zeros(n), [0.0, 0.0, -here.curvature[0] / 5e-3]])
    normal = splu((rows.T @ rows).tocsc())
    y = normal.solve(rows.T @ value)[: 3 * n : 3]
    middle = np.zeros((4 * n, 3))
    middle[3 * (n // 2) + np.arange(3), np.arange(3)] = 1.0
    variance = np.diag(normal.solve(middle)[3 * (n // 2) :][:3])
    axis = axis_of_points(
        "1", here.easting + y * np.cos(here.grid_bearing), here.northing - y * np.sin(here.grid_bearing)
    )
    return replace(axis, surveyed=noise_of_smoothed(walk, *np.sqrt(variance).tolist()))
