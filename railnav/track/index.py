"""Spatial index of a track model: samples of every track in square cells, as flat arrays that kernels can read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Side of a cell, m.
CELL = 64.0
#: Greatest distance between samples along a track, m.
SAMPLE_SPACING = 16.0


@dataclass(frozen=True, slots=True, eq=False)
class SpatialIndex:
    """Samples along all tracks, and the cells they lie in.

    Attributes
    ----------
    keys : (q,) int array
        Cell of each entry, row * columns + column, sorted.
    sample : (q,) int array
        Sample that the entry stands for.
    sample_track, sample_knot : (q,) int array
        Track and knot of each sample; samples of a track are consecutive.
    cell, reach : float
        Side of a cell; how far from its nearest sample a point of a track can lie, m.
    east0, north0 : float
        Corner of the first cell, m.
    columns : int
        Cells a row.
    """

    keys: IntArray
    sample: IntArray
    sample_track: IntArray
    sample_knot: IntArray
    cell: float
    reach: float
    east0: float
    north0: float
    columns: int


def index_tracks(knot_start: IntArray, easting: FloatArray, northing: FloatArray) -> SpatialIndex:
    """Index the knots of all tracks.

    Parameters
    ----------
    knot_start : (t + 1,) int array
        CSR pointer into the knots.
    easting, northing : (k,) array
        Knots, m.

    Returns
    -------
    SpatialIndex
        Samples at most `SAMPLE_SPACING` apart (or one a knot where knots lie further apart), both ends of each track included.
    """
    tracks: list[IntArray] = []
    knots: list[IntArray] = []
    reach = 0.5 * SAMPLE_SPACING
    for t in range(len(knot_start) - 1):
        first, last = int(knot_start[t]), int(knot_start[t + 1])
        step = np.hypot(np.diff(easting[first:last]), np.diff(northing[first:last]))
        longest = float(step.max())
        stride = max(1, int(SAMPLE_SPACING / max(longest, 1e-6)))
        reach = max(reach, 0.5 * stride * longest + 0.01)
        chosen = np.unique(np.append(np.arange(first, last, stride), last - 1)).astype(np.int64)
        knots.append(chosen)
        tracks.append(np.full(len(chosen), t, np.int64))
    sample_knot = np.concatenate(knots)
    sample_track = np.concatenate(tracks)
    east, north = easting[sample_knot], northing[sample_knot]
    east0, north0 = float(east.min()), float(north.min())
    column = np.floor((east - east0) / CELL).astype(np.int64)
    row = np.floor((north - north0) / CELL).astype(np.int64)
    columns = int(column.max()) + 1
    key = row * columns + column
    order = np.argsort(key, kind="stable").astype(np.int64)
    return SpatialIndex(key[order], order, sample_track, sample_knot, CELL, reach, east0, north0, columns)
