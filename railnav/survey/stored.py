"""What a survey leaves for later ones: the chains of its tracks as square-root records, its frame offsets as rows.

A chain is estimated with the frame offsets theta of its runs as border. Runs share much of their error; so what the axis owes to the
mean c of these offsets is kept apart: theta = theta^ + T (c - c^) + rest, T = B M^T (M B M^T)^-1 with c = M theta and B the covariance
of theta. The rest enters the covariances of the nodes; the chain that is kept is the one nearest to their joint distribution (spec 18, 23).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.estimation.merging import ChainRecords
from railnav.estimation.square_root import inverse_root
from railnav.survey.axis import ErrorModel, Estimate
from railnav.survey.layout import Join
from railnav.survey.offsets import Offsets
from railnav.survey.report import Survey
from railnav.survey.surveyed import Surveyed
from railnav.survey.vertical import Heights
from railnav.track.records import AxisRecords, Borders, ModelRecords, TrackRecords

if TYPE_CHECKING:
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]


def digest(records: ModelRecords) -> str:
    """Fingerprint of stored records: which model an update came from."""
    h = hashlib.sha256()
    for name in sorted(records.tracks):
        t = records.tracks[name]
        for a in (t.easting, t.northing, t.across.rows):
            h.update(np.ascontiguousarray(a, "<f8").tobytes())
    return h.hexdigest()[:16]


def mean_of(blocks: Sequence[int], weights: Sequence[float], size: int, B: int) -> FloatArray:
    """Matrix (B, size) that takes the weighted mean of blocks of B numbers each."""
    M = np.zeros((B, size))
    for block, weight in zip(blocks, weights, strict=True):
        M[:, block * B : (block + 1) * B] += weight * np.eye(B)
    return M


def keep_axis(
    estimate: Estimate,
    border_covariance: FloatArray,
    M: FloatArray,
    noise: FloatArray,
    *,
    least: FloatArray | None = None,
) -> AxisRecords:
    """Records of one estimated chain about its own estimate, with the common part M theta of its border kept apart.

    Parameters
    ----------
    estimate : Estimate
        With covariances.
    border_covariance : (b, b) array
        Of its border, m^2.
    M : (B, b) array
        The part of the border that is kept apart.
    noise : (N - 1,) array
    least : (N,) array, optional
        Variance of the distances that is kept at least, m^2: a chain whose variance is less is told with as much more.
    """
    cross = border_covariance @ M.T
    T = np.linalg.solve(M @ cross, cross.T).T  # (b, B)
    rest = border_covariance - T @ cross.T
    lean, D = estimate.lean, -(estimate.lean @ T)
    P = estimate.inner + lean @ rest @ lean.transpose(0, 2, 1)
    C = estimate.inner_lag + lean[:-1] @ rest @ lean[1:].transpose(0, 2, 1)
    if least is not None:
        more = np.sqrt(np.maximum(least / P[:, 0, 0], 1.0))
        P, C = P * (more**2)[:, None, None], C * (more[:-1] * more[1:])[:, None, None]
    chain = ChainRecords.of_marginals(np.zeros(D.shape[:2]), P, C)
    return AxisRecords.of(chain, D, noise)


def keep_borders(tracks: Sequence[str], receivers: Sequence[str], mean: FloatArray, covariance: FloatArray) -> Borders:
    """Rows that hold what is known of the frame offsets of tracks and receivers."""
    # two tracks of the same runs have the same offset: what sets them apart is held at 10 micrometres
    W = inverse_root(0.5 * (covariance + covariance.T) + 1e-10 * np.eye(len(covariance)))
    return Borders(tuple(tracks), tuple(receivers), W, W @ mean)


def model_words(model: ErrorModel, scatter: float) -> dict[str, float]:
    """An error model as JSON values."""
    return {
        "white_m": float(model.white),
        "correlated_m": float(model.correlated),
        "correlation_time_s": float(model.memory),
        "total_m": float(model.total),
        "scatter_m": float(scatter),
    }


def keep_build(
    survey: Survey,
    tracks: Sequence[Surveyed],
    joins: Sequence[Join],
    parts: dict[str, list[str]],
    offsets: Offsets,
    heights: Sequence[Heights | None],
    up: Offsets | None,
) -> ModelRecords:
    """Keep what a build knows."""
    names = survey.receiver_names
    kept: dict[str, TrackRecords] = {}
    for t, h in zip(tracks, heights, strict=True):
        e, n = t.nominal.normal
        kept[t.name] = TrackRecords(
            step=t.nominal.step,
            easting=t.nominal.easting + t.axis * e,
            northing=t.nominal.northing + t.axis * n,
            height=None if h is None else h.height,
            across=_keep(t.estimate, offsets, t.runs, t.noise),
            up=None if h is None or up is None else _keep(h.estimate, up, h.runs, h.noise),
        )
    told: dict[str, Any] = {
        name: {
            "runs": int(np.count_nonzero(survey.kind == c)),
            "weight": float(offsets.weight[c]),
            "across": model_words(survey.models[name], float(offsets.scatter[c])),
            "up": None,
        }
        for c, name in enumerate(names)
    }
    high = [(t, h) for t, h in zip(tracks, heights, strict=True) if h is not None]
    if up is not None:
        for c, name in enumerate(names):
            if name in high[0][1].models:
                told[name]["up"] = model_words(high[0][1].models[name], float(up.scatter[c]))
    return ModelRecords(
        tracks=kept,
        across=_borders([t.name for t in tracks], [t.runs for t in tracks], names, offsets),
        up=None if up is None else _borders([t.name for t, _ in high], [h.runs for _, h in high], names, up),
        receivers=told,
        runs=tuple(
            {
                "id": f.run.id,
                "start": f.run.start.isoformat(),
                "direction": f.run.direction,
                "tracks": [t.name for t in tracks if i in t.runs],
            }
            for i, f in enumerate(survey.fixes)
        ),
        joins=tuple(
            {"track": j.track, "end": j.end, "parent": j.parent, "easting_m": j.easting, "northing_m": j.northing}
            for j in joins
        ),
        parts=parts,
    )


def _keep(estimate: Estimate | None, offsets: Offsets, runs: Sequence[int], noise: FloatArray) -> AxisRecords:
    assert estimate is not None
    K, B = len(runs), offsets.run.shape[1]
    who = (np.array(runs)[:, None] * B + np.arange(B)).ravel()
    M = mean_of(range(K), [1.0 / K] * K, K * B, B)
    return keep_axis(estimate, offsets.covariance[np.ix_(who, who)], M, noise)


def _borders(
    tracks: Sequence[str], runs: Sequence[Sequence[int]], receivers: Sequence[str], offsets: Offsets
) -> Borders:
    (R, B), C, T = offsets.run.shape, len(receivers), len(tracks)
    A = np.zeros(((T + C) * B, (R + C) * B))
    for t, who in enumerate(runs):
        A[t * B : (t + 1) * B] = mean_of(who, [1.0 / len(who)] * len(who), (R + C) * B, B)
    A[T * B :, R * B :] = np.eye(C * B)
    mean = np.concatenate([np.zeros(T * B), offsets.receiver.ravel()])  # a track's own is counted from its estimate
    return keep_borders(tracks, receivers, mean, A @ offsets.joint @ A.T)


def section_records(records: ModelRecords | None, model: TrackModel, section: str) -> TrackRecords | None:
    """Records of one track of a model; where turnouts part a surveyed track, those of its nodes in the section."""
    if records is None:
        return None
    of = records.surveyed(section)
    whole = records.tracks.get(of)
    if whole is None or of == section:
        return whole
    lengths = np.cumsum([0.0, *(model.length(name) for name in records.sections(of))])
    place, N = records.sections(of).index(section), len(whole.easting)
    a, b = (int(v) for v in np.rint(lengths[place : place + 2] / lengths[-1] * (N - 1)))
    if b - a < 2:
        return None
    k = slice(a, b + 1)

    def part(axis: AxisRecords) -> AxisRecords:
        solution = axis.chain().solve()
        assert solution.covariance is not None
        assert solution.lag_one is not None
        chain = ChainRecords.of_marginals(solution.state[k], solution.covariance[k], solution.lag_one[a:b])
        return AxisRecords.of(chain, axis.lean[k], axis.noise[a:b])

    return TrackRecords(
        whole.step,
        whole.easting[k],
        whole.northing[k],
        None if whole.height is None else whole.height[k],
        part(whole.across),
        None if whole.up is None else part(whole.up),
    )
