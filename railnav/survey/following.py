"""Which of several tracks that spring from each other a run followed, fix by fix: the likeliest lawful way through them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.survey import _kernels
from railnav.survey.grouping import PRECISE
from railnav.survey.nominal import Nominal
from railnav.survey.profiles import Traverse

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Distances across count in this many metres, or in sigma of a fix where that is more.
LEAST_SCALE = 0.3
#: Fixes within this time err together, s.
TOGETHER = 30.0
#: What passing a joint onto the other track costs, and a change of track where there is none (half chi-squares would be 9 and 25).
JOINT_COST, LEAP_COST = 2.0, 50.0
#: Another track than that of its direction must lie so many sigma nearer to a rough run.
WRONG_DIRECTION = 3.0
#: How far from a joint a run may change track when its fixes leave a gap there, m.
JOINT_REACH = 150.0


def joined_groups(names: Sequence[str], joins: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Sort tracks into groups that joins tie together."""
    group = {name: name for name in names}

    def root(name: str) -> str:
        while group[name] != name:
            name = group[name]
        return name

    for join in joins:
        if join["track"] in group and join["parent"] in group:
            group[root(str(join["track"]))] = root(str(join["parent"]))
    out: dict[str, list[str]] = {}
    for name in names:
        out.setdefault(root(name), []).append(name)
    return list(out.values())


def followed(
    laid: Mapping[str, Traverse],
    lines: Mapping[str, Nominal],
    joins: Sequence[Mapping[str, Any]],
    use: BoolArray,
    sigma: float,
    labelled: frozenset[str],
) -> dict[str, BoolArray]:
    """Give each fix to the track that the run was on.

    Parameters
    ----------
    laid : dict
        The run along each track of a group.
    lines : dict
        Nominal curves of the tracks.
    joins : sequence of dict
        Where tracks spring from others (`ModelRecords.joins`).
    use : (m,) bool array
        Fixes that take part.
    sigma : float
        What a fix errs, m.
    labelled : frozenset of str
        Tracks made by runs of this one's direction; empty where none, or it names none.

    Returns
    -------
    dict
        Of each track the fixes on it, (m,) bool. Fixes near none of them are in no track.
    """
    names = list(laid)
    at = np.flatnonzero(use)
    out = {name: np.zeros(len(use), np.bool_) for name in names}
    if not len(at) or not names:
        return out
    time = laid[names[0]].fixes.time[at]
    pace = float(np.median(np.diff(time))) if len(at) > 1 else 1.0
    scale = max(LEAST_SCALE, sigma)
    together = max(1.0, TOGETHER / max(pace, 1e-3))
    offset = np.column_stack([laid[name].offset[at] for name in names])
    right = np.column_stack([laid[name].right[at] for name in names])
    farthest = (_farthest(right) / scale) ** 2
    cost = np.where(np.isfinite(right), (right / scale) ** 2, farthest) / together
    if labelled and sigma >= PRECISE:
        wrong = np.array([name not in labelled for name in names])
        cost += np.where(wrong, WRONG_DIRECTION**2 / together, 0.0)
    track = np.empty(len(at), np.int64)
    _kernels.follow(cost, offset, _joints(names, lines, joins), JOINT_REACH, LEAP_COST, track)
    for number, name in enumerate(names):
        out[name][at] = (track == number) & np.isfinite(offset[:, number])
    return out


def _farthest(right: FloatArray) -> float:
    """Distance that counts where a fix is not on a track at all, m: beyond all that are on one."""
    known = np.abs(right[np.isfinite(right)])
    return 1.5 * float(known.max()) + 1.0 if len(known) else 1.0


def _joints(names: Sequence[str], lines: Mapping[str, Nominal], joins: Sequence[Mapping[str, Any]]) -> FloatArray:
    """Joints as rows for the kernel: track and its own offset there, parent and its offset there, cost."""
    rows = []
    for join in joins:
        own, parent = str(join["track"]), str(join["parent"])
        if own not in names or parent not in names:
            continue
        line, ground = lines[own], lines[parent]
        end = 0.0 if int(join["end"]) == 0 else (len(line) - 1) * line.step
        node = int(np.argmin(np.hypot(ground.easting - join["easting_m"], ground.northing - join["northing_m"])))
        rows.append([names.index(own), end, names.index(parent), node * ground.step, JOINT_COST])
    return np.array(rows, float).reshape(-1, 5)
