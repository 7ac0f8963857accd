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
    probability is the posterior of all pasts that stood on the winner's track then: the weights of the last epoch, handed back, also to
    the pasts of hypotheses that were merged where ways met again.

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
        Candidates of the rows whose track is not certain: where each past, smoothed for itself, has the train then.
    """
    out = out.copy()
    records, fil = engine.records, engine.filter
    used = int(records.used[0])
    epoch_of = records.numbers[:used, c.R_EPOCH].astype(np.int64)
    m, n = len(table), engine.states
    x, sigma = np.empty((m, n)), np.empty((m, 2))
    chain, other = np.full(m, -1, np.int64), np.full(m, -1, np.int64)
    track, way, elsewhere, way_there = (np.empty(m, np.int64) for _ in range(4))
    offset, offset_there = np.empty(m), np.empty(m)
    told: dict[tuple[int, int, int], tuple[float, float]] = {}  # row, track, way: posterior, posterior times offset
    x_there, sigma_there = np.empty((m, n)), np.empty((m, 2))
    joins = records.joins[: int(records.used[3])]
    joins[:] = joins[np.argsort(joins[:, 0], kind="stable")]
    joined_at = joins[:, 0].astype(np.int64)
    posterior, seen, standing = np.zeros(used), np.zeros(used, np.int8), np.empty(used, np.int64)
    kernel.standing_of(fil, records, 0, used, standing)
    end = used
    while end > 0:
        last = int(epoch_of[end - 1])
        final = np.arange(np.searchsorted(epoch_of, last, side="left"), end)
        posterior[:end], seen[:end] = 0.0, 0
        posterior[final] = np.exp(records.numbers[final, c.R_LOGW])
        posterior[final] /= posterior[final].sum()
        best = int(final[_winner(engine, final, posterior[final])])
        first = int(kernel.new_lineage(records, best, seen, chain))
        begin = int(np.searchsorted(epoch_of, first, side="left"))
        stretch = slice(*np.searchsorted(joined_at, [begin, end]).tolist())
        kernel.weigh(records, begin, end, stretch.stop, posterior)
        kernel.smooth_lineage(fil, records, table, chain, first, last, x, sigma)
        kernel.place(fil, engine.network.length, records, chain, first, last, x, track, way, offset)
        rows = slice(first, last + 1)
        same = standing[begin:end] == standing[chain[epoch_of[begin:end]]]
        probability = np.bincount(epoch_of[begin:end] - first, posterior[begin:end] * same, minlength=last + 1 - first)
        # the others' pasts, the likeliest first: those of the end, and those that were merged into others on the way
        ends = np.unique(np.concatenate([final, joins[stretch, 1].astype(np.int64)]))
        ends = ends[posterior[ends] >= LEAST]
        for record in ends[np.argsort(-posterior[ends], kind="stable")].tolist():
            since, until = int(kernel.new_lineage(records, record, seen, other)), int(epoch_of[record])
            since = max(since, first)
            if since > until or chain[until] == record:
                continue
            span = slice(since, until + 1)
            apart = standing[other[span]] != standing[chain[span]]
            rows_apart = since + np.flatnonzero(apart & (posterior[other[span]] >= LEAST))
            if not len(rows_apart):
                continue
            since, until = int(rows_apart[0]), int(epoch_of[record])
            kernel.smooth_lineage(fil, records, table, other, since, until, x_there, sigma_there)
            kernel.place(
                fil, engine.network.length, records, other, since, until, x_there, elsewhere, way_there, offset_there
            )
            for row in rows_apart.tolist():
                key, w = (row, int(elsewhere[row]), int(way_there[row])), float(posterior[other[row]])
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
        end = begin
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
