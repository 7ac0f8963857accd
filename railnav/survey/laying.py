"""New runs on stored tracks: which of them each run followed, and which runs are of another line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from railnav.errors import ModelError, RunError
from railnav.survey.fixes import FAR, USED, Fixes
from railnav.survey.grouping import APART, PRECISE, parallel_distance
from railnav.survey.nominal import Nominal, through
from railnav.survey.profiles import Traverse, profiles, traverse
from railnav.survey.surveyed import REACH, Surveyed
from railnav.track.model import TrackModel
from railnav.track.records import ModelRecords

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: A run with less than this share of its fixes on the model is of another line.
SHARE_ON_MODEL = 0.5
#: Of a track that a run follows at least this share of its fixes, and so many of them.
SHARE_ON_TRACK, FEWEST_ON_TRACK = 0.02, 20
#: Stored nodes and knots of a track agree within this, m.
SAME_AXIS = 0.02
#: A run is of another track when it lies this many times its scatter beside it, and no less than `APART`.
BESIDE = 6.0


def stored_lines(model: TrackModel, records: ModelRecords) -> dict[str, Nominal]:
    """Nominal curves through the stored nodes, after seeing to it that the model's knots are still those that the records know.

    Raises
    ------
    ModelError
        Records of a track that the model has not, or whose axis lies elsewhere.
    """
    from scipy.spatial import cKDTree

    out: dict[str, Nominal] = {}
    for name, t in records.tracks.items():
        if name not in model.track_id:
            raise ModelError(
                f"survey records of a track {name!r} that the model has not", remedy="build the model again"
            )
        k = model.knots(name)
        e, n, bearing = model.easting[k], model.northing[k], model.grid_bearing[k]
        _, at = cKDTree(np.column_stack([e, n])).query(np.column_stack([t.easting, t.northing]))
        off = np.abs((t.easting - e[at]) * np.cos(bearing[at]) - (t.northing - n[at]) * np.sin(bearing[at]))
        spacing = float(np.median(np.diff(model.offset[k])))
        bend = np.abs(model.curvature[k][at]) * spacing**2
        if not (off[1:-1] < SAME_AXIS + bend[1:-1]).all():
            raise ModelError(
                f"track {name!r} has been moved by {off[1:-1].max():.2f} m since its survey records were written",
                remedy="build the model again from its runs",
            )
        out[name] = through(t.easting, t.northing, t.step)
    return out


def lay_runs(
    lines: Mapping[str, Nominal],
    labels: Mapping[str, set[str]],
    fixes: Sequence[Fixes],
    sigma: Sequence[float],
) -> tuple[list[Surveyed], list[str]]:
    """Lay new runs along the stored tracks.

    A run may follow several tracks one after another; where tracks run side by side the one of its direction is taken, or, for a run
    precise enough to tell, the one that it lies on.

    Parameters
    ----------
    lines : dict
        Nominal curve of each track.
    labels : dict
        Directions of the runs that made each track.
    fixes : sequence of Fixes
        The new runs.
    sigma : sequence of float
        What a fix of each run errs, m.

    Returns
    -------
    tracks : list of Surveyed
        One for each track that a run follows.
    warnings : list of str

    Raises
    ------
    RunError
        A run lies on another line, or beside the tracks all the way.
    """
    found: dict[str, list[tuple[int, Traverse]]] = {}
    warnings: list[str] = []
    for i, f in enumerate(fixes):
        left = f.reason == USED
        total = int(np.count_nonzero(left))
        laid = {name: traverse(line, f, REACH) for name, line in lines.items() if _near(line, f)}
        used = 0
        while True:
            best = _best(laid, left, labels, f, sigma[i], max(FEWEST_ON_TRACK, int(SHARE_ON_TRACK * total)))
            if best is None:
                break
            t = laid.pop(best)
            mine = left & np.isfinite(t.offset)
            found.setdefault(best, []).append(
                (i, replace(t, offset=np.where(mine, t.offset, np.nan), right=np.where(mine, t.right, np.nan)))
            )
            used += int(np.count_nonzero(mine))
            left &= ~mine
        if used < SHARE_ON_MODEL * total:
            raise RunError(
                f"only {100 * used / max(total, 1):.0f} % of its fixes lie within {REACH:.0f} m of the model's tracks: another line",
                file=f.run.source or f.run.id,
                remedy="leave it out, or build that line from its own runs",
            )
        if left.any():
            f.reason[left] = FAR
            warnings.append(
                f"of run {f.run.id} {int(left.sum())} of {total} fixes lie beyond the model's tracks; an update does not lengthen "
                "tracks, a build from all runs does"
            )
    tracks = []
    for name, line in lines.items():
        if name not in found:
            continue
        runs = tuple(i for i, _ in found[name])
        traverses = [t for _, t in found[name]]
        profile = profiles(traverses, len(line), line.step)
        track = Surveyed(name, runs, line, traverses, profile, np.zeros(len(line)))
        _refuse_beside(track, fixes)
        tracks.append(track)
    return tracks, warnings


def _near(line: Nominal, f: Fixes) -> bool:
    """Whether a good part of a run lies in the box around a track."""
    inside = (f.easting > line.easting.min() - REACH) & (f.easting < line.easting.max() + REACH)
    inside &= (f.northing > line.northing.min() - REACH) & (f.northing < line.northing.max() + REACH)
    return int(np.count_nonzero(inside)) >= FEWEST_ON_TRACK


def _best(
    laid: Mapping[str, Traverse],
    left: BoolArray,
    labels: Mapping[str, set[str]],
    f: Fixes,
    sigma: float,
    fewest: int,
) -> str | None:
    """Track to take next: of those that reach furthest along the rest of a run, the one of its direction, or the nearest."""
    many = {name: int(np.count_nonzero(left & np.isfinite(t.offset))) for name, t in laid.items()}
    most = max(many.values(), default=0)
    if most < fewest:
        return None
    # tracks side by side cover about the same fixes; what covers much less is another stretch
    rivals = [name for name, n in many.items() if n >= 0.5 * most]
    middle = {
        name: float(np.median(np.abs(laid[name].right[left & np.isfinite(laid[name].offset)]))) for name in rivals
    }
    if sigma < PRECISE:
        return min(rivals, key=lambda name: middle[name])
    told = [name for name in rivals if f.run.direction and f.run.direction in labels.get(name, set())]
    return min(told or rivals, key=lambda name: middle[name])


def _refuse_beside(t: Surveyed, fixes: Sequence[Fixes]) -> None:
    """Refuse a run that keeps beside a track all the way: it is on a track that the model has not."""
    for k, i in enumerate(t.runs):
        apart, scatter, many = parallel_distance(t.profile.right[k], t.design)
        if many < FEWEST_ON_TRACK or not np.isfinite(apart):
            continue
        if scatter < PRECISE and abs(apart) > max(APART, BESIDE * scatter):
            raise RunError(
                f"it lies {abs(apart):.1f} m beside track {t.name} all the way: on a track that the model has not",
                file=fixes[i].run.source or fixes[i].run.id,
                remedy="leave it out, or build from all runs, which makes a track of it",
            )
