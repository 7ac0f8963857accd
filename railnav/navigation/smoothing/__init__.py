"""Fixed-interval smoothing of a run along the path that won."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.navigation import columns as c
from railnav.navigation.smoothing import _kernels as kernel
from railnav.navigation.solution import Alternatives, Mode
from railnav.navigation.state import State
from railnav.run import Progress

if TYPE_CHECKING:
    from railnav.navigation.engine import Engine

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

__all__ = ["smooth_rows"]


#: Candidates below this posterior are not told.
LEAST = 1e-4


def smooth_rows(
    engine: Engine, table: FloatArray, out: FloatArray, *, progress: Progress | None = None
) -> tuple[FloatArray, Alternatives]:
    """Put smoothed rows in the place of filtered ones.

    Each unbroken stretch of hypotheses is smoothed along the lineage of its last winner, the last stretch first. A row's track
    probability is the weight of all final hypotheses whose past stood on the winner's track then.

    Parameters
    ----------
    engine : Engine
        With records of the whole run.
    table : (m, EPOCH_SIZE) array
        Its epochs.
    out : (m, OUTPUT_SIZE) array
        Filtered rows.
    progress : Progress, optional
        Called with rows done and rows in all.

    Returns
    -------
    (m, OUTPUT_SIZE) array
    Alternatives
        Candidates of the rows whose track is not certain: where each final hypothesis, smoothed along its own past, has the train then.
    """
    out = out.copy()
    records, fil = engine.records, engine.filter
    used = int(records.used[0])
    epoch_of = records.numbers[:used, c.R_EPOCH].astype(np.int64)
    m, n = len(table), engine.states
    x, sigma = np.empty((m, n)), np.empty((m, 2))
    chain, other = np.full(m, -1, np.int64), np.full(m, -1, np.int64)
    track, way, standing, rival = (np.empty(m, np.int64) for _ in range(4))
    offset = np.empty(m)
    told: dict[tuple[int, int, int], tuple[float, float]] = {}  # row, track, way: posterior, posterior times offset
    elsewhere, way_there, offset_there = np.empty(m, np.int64), np.empty(m, np.int64), np.empty(m)
    x_there, sigma_there = np.empty((m, n)), np.empty((m, 2))
    end = used
    while end > 0:
        last = int(epoch_of[end - 1])
        final = np.arange(np.searchsorted(epoch_of, last, side="left"), end)
        weight = np.exp(records.numbers[final, c.R_LOGW])
        weight /= weight.sum()
        best = _winner(engine, final, weight)
        first = int(kernel.lineage(records, int(final[best]), chain))
        kernel.smooth_lineage(fil, records, table, chain, first, last, x, sigma)
        kernel.place(fil, engine.network.length, records, chain, first, last, x, track, way, offset)
        kernel.tracks_of(fil, records, chain, first, last, standing)
        rows = slice(first, last + 1)
        probability = np.zeros(last + 1 - first)
        for w, record in zip(weight.tolist(), final.tolist(), strict=True):
            begin = int(kernel.lineage(records, record, other))
            kernel.tracks_of(fil, records, other, begin, last, rival)
            begin = max(begin, first)
            same = rival[begin : last + 1] == standing[begin : last + 1]
            probability[begin - first :] += w * same
            rows_apart = begin + np.flatnonzero(~same)
            if w >= LEAST and len(rows_apart):
                kernel.smooth_lineage(fil, records, table, other, begin, last, x_there, sigma_there)
                kernel.place(
                    fil, engine.network.length, records, other, begin, last, x_there, elsewhere, way_there, offset_there
                )
                for row in rows_apart.tolist():
                    key = (row, int(elsewhere[row]), int(way_there[row]))
                    before = told.get(key, (0.0, 0.0))
                    told[key] = (before[0] + w, before[1] + w * float(offset_there[row]))
        out[rows, c.OUT_TRACK] = track[rows]
        out[rows, c.OUT_WAY] = way[rows]
        out[rows, c.OUT_DIRECTION] = way[rows]
        out[rows, c.OUT_OFFSET] = offset[rows]
        out[rows, c.OUT_SPEED] = x[rows, fil.at[State.SPEED]]
        out[rows, c.OUT_ACCELERATION] = _acceleration(engine, table, chain, first, last, x)
        out[rows, c.OUT_SIGMA] = sigma[rows, 0]
        out[rows, c.OUT_SIGMA_SPEED] = sigma[rows, 1]
        out[rows, c.OUT_LEVEL] = fil.risk[1] * sigma[rows, 0]
        out[rows, c.OUT_PROBABILITY] = np.minimum(probability, 1.0)
        coasting = out[rows, c.OUT_FIX_AGE] > engine.settings.coasting_after
        decided = np.where(coasting, Mode.COASTING, Mode.TRACKING)
        out[rows, c.OUT_MODE] = np.where(probability < engine.settings.track_confidence, Mode.AMBIGUOUS, decided)
        for row in (first + np.flatnonzero(probability < 1.0 - LEAST)).tolist():
            key, p = (row, int(track[row]), int(way[row])), float(probability[row - first])
            before = told.get(key, (0.0, 0.0))
            told[key] = (before[0] + p, before[1] + p * float(offset[row]))
        end = int(np.searchsorted(epoch_of, first, side="left"))
        if progress is not None:
            progress("smooth", m - first, m)
    if progress is not None:
        progress("smooth", m, m)
    return out, _alternatives(told)


def _alternatives(told: dict[tuple[int, int, int], tuple[float, float]]) -> Alternatives:
    """Candidates by row, most probable first."""
    if not told:
        return Alternatives.none()
    order = sorted(told.items(), key=lambda item: (item[0][0], -item[1][0]))
    row, track, way = (np.array(column, np.int64) for column in zip(*(key for key, _ in order), strict=True))
    mass, moment = (np.array(column, np.float64) for column in zip(*(value for _, value in order), strict=True))
    return Alternatives(row, track, moment / mass, mass, way)


def _winner(engine: Engine, final: IntArray, weight: FloatArray) -> int:
    """Which of the final records is the heaviest on the most probable track."""
    records, i_s = engine.records, engine.filter.at[State.POSITION]
    version = records.numbers[final, c.R_VERSION].astype(np.int64)
    on = np.array(
        [
            records.track[v, kernel.window_index(records, v, s)]
            for v, s in zip(version.tolist(), records.x[final, i_s].tolist(), strict=True)
        ]
    )
    mass = np.array([weight[on == t].sum() for t in on])
    return int(np.lexsort((weight, np.round(mass, 12)))[-1])


def _acceleration(
    engine: Engine, table: FloatArray, chain: IntArray, first: int, last: int, x: FloatArray
) -> FloatArray:
    """Smoothed acceleration of a stretch, NaN where nothing measures it."""
    at = engine.filter.at
    rows = slice(first, last + 1)
    if at[State.ACCELERATION] >= 0:
        return x[rows, at[State.ACCELERATION]]
    pull = engine.records.numbers[chain[rows], c.R_PULL]
    return np.asarray(table[rows, c.FORCE] - pull - x[rows, at[State.ACCELEROMETER_BIAS]])
