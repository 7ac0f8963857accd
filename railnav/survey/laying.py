"""New runs on stored tracks: which of them each run followed, and which runs are of another line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import ModelError, RunError
from railnav.survey.fixes import FAR, USED, Fixes
from railnav.survey.following import followed, joined_groups
from railnav.survey.grouping import APART, PRECISE, parallel_distance
from railnav.survey.joining import LONGEST
from railnav.survey.nominal import Nominal, through
from railnav.survey.profiles import Traverse, profiles, traverse
from railnav.survey.surveyed import REACH, Surveyed
from railnav.track.model import TrackModel
from railnav.track.records import ModelRecords, TrackRecords

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: A run with less than this share of its fixes on the model is of another line.
SHARE_ON_MODEL = 0.5
#: Of a track that a run follows at least this share of its fixes, and so many of them.
SHARE_ON_TRACK, FEWEST_ON_TRACK = 0.02, 20
#: Of a track among others that it joins.
FEWEST_PASSED = 5
#: Stored nodes and knots of a track agree within this, m; where an end is drawn onto another track, within this.
SAME_AXIS, MOST_DRAWN = 0.02, 30.0
#: A run is of another track when it lies this many times its scatter beside it, and no less than `APART`.
BESIDE = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """A track that new runs may follow: as stored, lengthened, or new.

    Attributes
    ----------
    name : str
        Of the surveyed track.
    line : Nominal
        Through its nodes.
    height : (N,) array or None
        Heights of the nodes, m: stored, and guessed where they are new.
    known : TrackRecords or None
        What is stored of it; None of a new track.
    first : int
        Node at which the first stored node lies.
    """

    name: str
    line: Nominal
    height: FloatArray | None
    known: TrackRecords | None
    first: int = 0

    def stored(self) -> BoolArray:
        """Nodes (N,) that are stored."""
        out = np.zeros(len(self.line), np.bool_)
        if self.known is not None:
            out[self.first : self.first + len(self.known.easting)] = True
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Knots:
    """Knots of a surveyed track, its sections one after another: (k,) arrays.

    Attributes
    ----------
    offset : (k,) array
        From the start of the surveyed track, m.
    easting, northing, grid_bearing, curvature, cant : (k,) array
    """

    offset: FloatArray
    easting: FloatArray
    northing: FloatArray
    grid_bearing: FloatArray
    curvature: FloatArray
    cant: FloatArray


def knots_of(model: TrackModel, records: ModelRecords, track: str) -> Knots:
    """Give the knots of a surveyed track; where turnouts part it, its sections follow one another."""
    pieces = [model.knots(section) for section in records.sections(track)]
    columns = {
        name: np.concatenate([getattr(model, name)[k] for k in pieces])
        for name in ("easting", "northing", "grid_bearing", "curvature", "cant")
    }
    lengths = np.cumsum([0.0, *(float(model.offset[k][-1]) for k in pieces)])
    offset = np.concatenate([model.offset[k] + before for k, before in zip(pieces, lengths, strict=False)])
    once = np.append(True, np.diff(offset) > 0.0)  # a node between two sections stands in both
    return Knots(offset[once], **{name: column[once] for name, column in columns.items()})


def stored_grounds(model: TrackModel, records: ModelRecords) -> dict[str, Ground]:
    """Nominal curves through the stored nodes, after seeing to it that the model's knots are still those that the records know.

    Raises
    ------
    ModelError
        Records of a track that the model has not, or whose axis lies elsewhere.
    """
    from scipy.spatial import cKDTree

    drawn = {(str(join["track"]), int(join["end"])) for join in records.joins}
    out: dict[str, Ground] = {}
    for name, t in records.tracks.items():
        missing = [section for section in records.sections(name) if section not in model.track_id]
        if missing:
            raise ModelError(
                f"survey records of a track {missing[0]!r} that the model has not", remedy="build the model again"
            )
        k = knots_of(model, records, name)
        e, n = k.easting, k.northing
        _, at = cKDTree(np.column_stack([e, n])).query(np.column_stack([t.easting, t.northing]))
        off = np.abs(
            (t.easting - e[at]) * np.cos(k.grid_bearing[at]) - (t.northing - n[at]) * np.sin(k.grid_bearing[at])
        )
        spacing = float(np.median(np.diff(k.offset)))
        bend = np.abs(k.curvature[at]) * spacing**2
        same = off < SAME_AXIS + bend
        same[[0, -1]] = True
        reach = (
            min(round(LONGEST / t.step), len(same) // 2) + 1
        )  # ends that are drawn onto other tracks lie beside their nodes
        if (name, 0) in drawn:
            same[:reach] |= off[:reach] < MOST_DRAWN
        if (name, 1) in drawn:
            same[-reach:] |= off[-reach:] < MOST_DRAWN
        if not same.all():
            raise ModelError(
                f"track {name!r} has been moved by {off[~same].max():.2f} m since its survey records were written",
                remedy="build the model again from its runs",
            )
        out[name] = Ground(name, through(t.easting, t.northing, t.step), t.height, t)
    return out


def lay_runs(
    grounds: Mapping[str, Ground],
    joins: Sequence[Mapping[str, Any]],
    labels: Mapping[str, set[str]],
    fixes: Sequence[Fixes],
    sigma: Sequence[float],
    *,
    least_share: float = SHARE_ON_MODEL,
) -> list[Surveyed]:
    """Lay new runs along the tracks, and mark the fixes that lie beyond them.

    A run may follow several tracks one after another, and pass from one to the other where they join; where tracks run side by side
    the one of its direction is taken, or, for a run precise enough to tell, the one that it lies on.

    Parameters
    ----------
    grounds : dict
        The tracks.
    joins : sequence of dict
        Where tracks spring from others (`ModelRecords.joins`).
    labels : dict
        Directions of the runs that made each track.
    fixes : sequence of Fixes
        The new runs.
    sigma : sequence of float
        What a fix of each run errs, m.
    least_share : float
        A run with less than this share of its fixes on the tracks is of another line.

    Returns
    -------
    list of Surveyed
        One for each track that a run follows.

    Raises
    ------
    RunError
        A run lies on another line.
    """
    lines = {name: g.line for name, g in grounds.items()}
    groups = joined_groups(list(lines), joins)
    found: dict[str, list[tuple[int, Traverse]]] = {}
    for i, f in enumerate(fixes):
        f.reason[f.reason == FAR] = USED
        left = f.reason == USED
        total = int(np.count_nonzero(left))
        laid = {name: traverse(line, f, REACH) for name, line in lines.items() if _near(line, f)}
        near = [[name for name in group if name in laid] for group in groups]
        near = [group for group in near if group]
        told = frozenset(
            name for name in laid if f.run.direction and f.run.direction in labels.get(name, set())
        )  # fmt: skip
        used = 0
        while near:
            ways = [
                followed({name: laid[name] for name in group}, lines, joins, left, sigma[i], told)
                if len(group) > 1
                else {group[0]: left & np.isfinite(laid[group[0]].offset)}
                for group in near
            ]
            best = _best(ways, laid, told, sigma[i], max(FEWEST_ON_TRACK, int(SHARE_ON_TRACK * total)))
            if best is None:
                break
            for name, mine in ways[best].items():
                if len(near[best]) > 1 and np.count_nonzero(mine) < FEWEST_PASSED:
                    continue
                t = laid[name]
                found.setdefault(name, []).append(
                    (i, replace(t, offset=np.where(mine, t.offset, np.nan), right=np.where(mine, t.right, np.nan)))
                )
                used += int(np.count_nonzero(mine))
                left &= ~mine
            near.pop(best)
        if used < least_share * total or not used:
            raise RunError(
                f"only {100 * used / max(total, 1):.0f} % of its fixes lie within {REACH:.0f} m of the model's tracks: another line",
                file=f.run.source or f.run.id,
                remedy="leave it out, build that line from its own runs"
                + (", or let --extend make track of it" if used >= FEWEST_ON_TRACK else ""),
            )
        f.reason[left] = FAR
    tracks = []
    for name, line in lines.items():
        if name not in found:
            continue
        runs = tuple(i for i, _ in found[name])
        traverses = [t for _, t in found[name]]
        profile = profiles(traverses, len(line), line.step)
        tracks.append(Surveyed(name, runs, line, traverses, profile, np.zeros(len(line))))
    return tracks


def _near(line: Nominal, f: Fixes) -> bool:
    """Whether a good part of a run lies in the box around a track."""
    inside = (f.easting > line.easting.min() - REACH) & (f.easting < line.easting.max() + REACH)
    inside &= (f.northing > line.northing.min() - REACH) & (f.northing < line.northing.max() + REACH)
    return int(np.count_nonzero(inside)) >= FEWEST_ON_TRACK


def _best(
    ways: Sequence[Mapping[str, BoolArray]],
    laid: Mapping[str, Traverse],
    told: frozenset[str],
    sigma: float,
    fewest: int,
) -> int | None:
    """Group to take next: of those that reach furthest along the rest of a run, the one of its direction, or the nearest."""
    many = [sum(int(np.count_nonzero(mine)) for mine in way.values()) for way in ways]
    most = max(many, default=0)
    if most < fewest:
        return None
    # tracks side by side cover about the same fixes; what covers much less is another stretch
    rivals = [number for number, n in enumerate(many) if n >= 0.5 * most]
    middle = {
        number: float(
            np.median(np.concatenate([np.abs(laid[name].right[mine]) for name, mine in ways[number].items()]))
        )
        for number in rivals
    }
    named = [number for number in rivals if told & set(ways[number])] if sigma >= PRECISE else []
    return min(named or rivals, key=lambda number: middle[number])


def refuse_beside(t: Surveyed, fixes: Sequence[Fixes]) -> None:
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
