"""Which stretches of track lie elsewhere in a second model by more than the errors explain.

Stored chains are compared window by window with their cross-covariances; a model that was refined from the other one tells what its
updates found; without chains points are compared one by one, a correlation length counting as one trial.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.estimation.change import windows
from railnav.estimation.gross_error import chi_square_limit
from railnav.survey.changes import CLEAR, FEWEST_WINDOWS, WINDOW_LENGTH, WINDOW_NODES
from railnav.survey.stored import section_records
from railnav.track.model import TrackModel
from railnav.track.records import AxisRecords, ModelRecords

FloatArray = NDArray[np.float64]

#: Axes farther apart than this are of different tracks, m.
SAME_TRACK = 15.0
#: Errors farther apart than this are nearly independent, m (without stored chains).
INDEPENDENT = 50.0
#: What is left of the variance where a refined model differs from its origin by less than its arithmetic, m^2.
LEAST_VARIANCE = 1e-8


@dataclass(frozen=True, slots=True)
class MovedStretch:
    """A stretch of track that has moved.

    Attributes
    ----------
    track : str
        Identifier in the old model.
    coordinate : str
        "across" or "up".
    first, last : float
        Offsets in the old model, m.
    shift, sigma : float
        Greatest movement in it (to the right, or up), m, and its standard deviation.
    statistic, limit : float
        Chi-square of the window that shows it best, and what it may be where nothing moved.
    found_by : str
        "window" (stored chains), "update" (the update that refined the model) or "points" (no stored chains).
    """

    track: str
    coordinate: str
    first: float
    last: float
    shift: float
    sigma: float
    statistic: float
    limit: float
    found_by: str


def meet(
    model: TrackModel, track: str, x: FloatArray, y: FloatArray, h: FloatArray, east: FloatArray, north: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Where lines along (east, north) through points meet a track: distance along them, rise, offset on the track; and its sense."""
    from scipy.spatial import cKDTree

    k = model.knots(track)
    _, j = cKDTree(np.column_stack([model.easting[k], model.northing[k]])).query(np.column_stack([x, y]))
    offset = model.offset[k][j]
    end = float(model.offset[k][-1])
    te, tn = -north, east
    off = np.zeros(len(x), np.bool_)
    ahead = np.ones(len(x))
    for _ in range(4):
        there = model.at(track, offset)
        ahead = np.sin(there.grid_bearing) * te + np.cos(there.grid_bearing) * tn
        gap = (there.easting - x) * te + (there.northing - y) * tn
        step = gap / np.where(np.abs(ahead) > 0.5, ahead, 0.5)
        wanted = offset - step
        off = (wanted < -0.5) | (wanted > end + 0.5) | (np.abs(ahead) < 0.5)
        offset = np.clip(wanted, 0.0, end)
    there = model.at(track, offset)
    slew = (there.easting - x) * east + (there.northing - y) * north
    off |= np.abs(slew) > SAME_TRACK
    slew[off] = np.nan
    lift = np.where(off, np.nan, there.height - h)
    return slew, lift, offset, float(np.sign(np.median(ahead)))


def moved_stretches(
    old: TrackModel,
    new: TrackModel,
    records: tuple[ModelRecords | None, ModelRecords | None],
    a: str,
    b: str,
    p: dict[str, Any],
    relation: str,
    common: FloatArray,
    false_alarm: float,
) -> list[MovedStretch]:
    """Set the sigmas of the difference, and find what has moved."""
    out: list[MovedStretch] = []
    for coordinate, which in (("across", "slew"), ("up", "lift")):
        if relation == "update":
            before, after = p[f"P_{which}"]
            p[f"sigma_{which}"] = np.sqrt(np.maximum(np.abs(before - after), LEAST_VARIANCE))
            continue
        stored = [section_records(r, m, name) for r, m, name in zip(records, (old, new), (a, b), strict=True)]
        chains = [None if t is None else (t.across if coordinate == "across" else t.up) for t in stored]
        if stored[0] is not None and stored[1] is not None and chains[0] is not None and chains[1] is not None:
            out += _by_windows(old, new, a, b, stored, (chains[0], chains[1]), coordinate, common, false_alarm)
        else:
            out += _by_points(a, p, coordinate, which, false_alarm)
    return out


def _by_windows(
    old: TrackModel,
    new: TrackModel,
    a: str,
    b: str,
    stored: list[Any],
    chains: tuple[AxisRecords, AxisRecords],
    coordinate: str,
    common: FloatArray,
    false_alarm: float,
) -> list[MovedStretch]:
    """Windows of nodes of the old chain against the nearest nodes of the new one."""
    from scipy.spatial import cKDTree

    t, other = stored
    x, y = t.easting, t.northing
    ke = old.knots(a)
    _, j = cKDTree(np.column_stack([old.easting[ke], old.northing[ke]])).query(np.column_stack([x, y]))
    s = old.offset[ke][j]
    sin, cos = np.sin(old.grid_bearing[ke][j]), np.cos(old.grid_bearing[ke][j])
    slew, lift, _, sense = meet(new, b, x, y, old.height[ke][j] if t.height is None else t.height, cos, -sin)
    delta = slew - (cos * common[0] - sin * common[1]) if coordinate == "across" else lift - common[2]
    _, match = cKDTree(np.column_stack([other.easting, other.northing])).query(np.column_stack([x, y]))
    known = np.isfinite(delta)
    step = max(t.step, other.step)
    spacing = max(1, round(WINDOW_LENGTH / (WINDOW_NODES - 1) / step)) * max(1, round(step / t.step))
    reach = (WINDOW_NODES - 1) * spacing
    if len(x) <= reach:
        return []
    first = np.arange(0, len(x) - reach, max(1, spacing // 2))
    nodes = first[:, None] + spacing * np.arange(WINDOW_NODES)
    partner = match[nodes]
    apart = np.diff(partner, axis=1) * sense
    usable = known[nodes].all(axis=1) & (apart > 0).all(axis=1)
    nodes, partner = nodes[usable], partner[usable]
    if not len(nodes):
        return []
    one = chains[0].chain().solve()
    two = chains[1].chain().solve()
    sigma = windows(one, nodes) + (
        windows(two, partner) if sense > 0 else windows(two, partner[:, ::-1])[:, ::-1, ::-1]
    )
    d = delta[nodes]
    T = np.einsum("wi,wi->w", d, np.linalg.solve(sigma, d[:, :, None])[:, :, 0])
    factor = 1.0
    if len(T) >= FEWEST_WINDOWS:
        from scipy.stats import chi2

        factor = max(1.0, float(np.quantile(T, 0.75) / chi2.ppf(0.75, WINDOW_NODES)))
    T = T / factor
    limit = chi_square_limit(WINDOW_NODES, false_alarm / len(T))
    single = np.sqrt(factor * np.einsum("wii->wi", sigma))
    out: list[MovedStretch] = []
    hits = np.flatnonzero(limit < T)
    group: list[int] = []
    for h in [*hits.tolist(), -1]:
        if group and (h < 0 or nodes[h, 0] > nodes[group[-1], -1]):
            inside = np.array(group)
            best = int(inside[np.argmax(T[inside])])
            # of the windows that alarm, the nodes that stand out
            ratio = np.abs(d[inside]) / single[inside]
            strong = ratio > min(CLEAR, 0.5 * float(ratio.max()))
            who = nodes[inside][strong]
            k = int(np.argmax(np.abs(d[best])))
            peak = float(ratio.max())
            if peak >= 2.0:
                out.append(
                    MovedStretch(
                        a, coordinate, float(s[who.min()]), float(s[who.max()]), float(d[best, k]),
                        float(single[best, k]), float(T[best]), float(limit), "window",
                    )
                )  # fmt: skip
            group = []
        if h >= 0:
            group.append(h)
    return out


def _by_points(a: str, p: dict[str, Any], coordinate: str, which: str, false_alarm: float) -> list[MovedStretch]:
    """Points that stand out one by one, where there are no stored chains; a correlation length counts as one trial."""
    from scipy.stats import norm

    rest = p[which] - p[f"common_{which}"]
    sigma = p[f"sigma_{which}"]
    ratio = np.abs(rest) / sigma
    trials = max(1.0, float(p["offset"][-1]) / INDEPENDENT)
    limit = float(norm.isf(0.5 * false_alarm / trials))
    with np.errstate(invalid="ignore"):
        out_of = np.isfinite(ratio) & (ratio > limit)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], out_of.astype(np.int8), [0]])))
    found = []
    for i, j in zip(edges[::2], edges[1::2], strict=True):
        k = i + int(np.argmax(ratio[i:j]))
        found.append(
            MovedStretch(
                a, coordinate, float(p["offset"][i]), float(p["offset"][j - 1]), float(rest[k]), float(sigma[k]),
                float(ratio[k] ** 2), limit**2, "points",
            )
        )  # fmt: skip
    return found


def moved_by_updates(
    new: TrackModel, relation: str, a: str, b: str, old: TrackModel, p: dict[str, Any]
) -> list[MovedStretch]:
    """What the updates between two models found moved, at offsets of the old one."""
    if relation != "update":
        return []
    refined, origin = (
        (new, old) if len(new.provenance.get("updates", [])) >= len(old.provenance.get("updates", [])) else (old, new)
    )
    known = len(origin.provenance.get("updates", []))
    sign = 1.0 if refined is new else -1.0
    found = []
    for entry in refined.provenance.get("updates", [])[known:]:
        for track in entry["tracks"]:
            if track["track"] != b:
                continue
            length = new.length(b)
            for c in track["changes"]:
                if c["verdict"] != "moved" or not len(p["offset"]):
                    continue
                there = new.at(b, np.clip(np.array([c["from_m"], c["to_m"]]) / track["length_m"], 0.0, 1.0) * length)
                first, last = sorted(
                    float(p["offset"][np.argmin(np.hypot(p["easting"] - e, p["northing"] - n))])
                    for e, n in zip(there.easting, there.northing, strict=True)
                )
                found.append(
                    MovedStretch(
                        a, c["coordinate"], first, last, sign * c["shift_m"], c["sigma_m"], c["statistic"], c["limit"],
                        "update",
                    )
                )  # fmt: skip
    return found
