"""Every gross error of a build or an update with time, place, size and reason: fixes, stretches on another track, links, heights.

`total` counts single fixes, stretches, links, and heights of nodes; `list` holds one entry for fixes (heights) that follow one another
and have one reason. Keys: `what`: "fix" | "stretch" | "link" | "height"; `run`; `time_s` (None for a stretch), `to_time_s` where it lasts;
`track`, `offset_m`, `to_m` where it is long; `easting_m`, `northing_m` of its worst; `size` and `unit` ("m", or "rad" for a gyro's
slope); `fixes`, how many (of a height: nodes); `reason`. Where fixes and increments of one run contradicted each other
(`railnav.survey.attribution`) also `statistic` and `limit` (chi-square) and `evidence`: ln odds of this verdict over the other, of two
clones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.survey.angles import slips
from railnav.survey.fixes import BEYOND, FAR, LINKS, OTHER_TRACK, REASONS, STATED_SIGMA, TURNED, USED, Fixes
from railnav.survey.surveyed import Surveyed

if TYPE_CHECKING:
    from railnav.survey.attribution import Attribution
    from railnav.survey.renewal import Section
    from railnav.survey.vertical import Heights
    from railnav.track.alignment import KnotTable

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Track and offset of each fix of a run, as far as it is laid along any (empty, NaN: not)."""

    track: NDArray[np.object_]
    offset: FloatArray

    @classmethod
    def nowhere(cls, fixes: int) -> Place:
        """Start with no fix laid."""
        return cls(np.full(fixes, "", object), np.full(fixes, np.nan))

    def put(self, track: str, offset: FloatArray) -> None:
        """Lay the fixes whose offset is finite."""
        at = np.isfinite(offset)
        self.track[at], self.offset[at] = track, offset[at]

    def everywhere(self) -> tuple[NDArray[np.object_], FloatArray]:
        """Track and offset of all fixes: one that is not laid lies between its neighbours; beyond the ends at none."""
        at = np.flatnonzero(np.isfinite(self.offset))
        if not len(at):
            return self.track, self.offset
        rows = np.arange(len(self.offset))
        after = np.clip(np.searchsorted(at, rows), 0, len(at) - 1)
        before = np.clip(np.searchsorted(at, rows, side="right") - 1, 0, len(at) - 1)
        near = np.where(np.abs(at[after] - rows) < np.abs(rows - at[before]), at[after], at[before])
        track = self.track[near]
        offset = np.interp(rows, at, self.offset[at], left=np.nan, right=np.nan)
        apart = (self.track[at[after]] != self.track[at[before]]) & np.isfinite(offset)
        return track, np.where(apart, self.offset[near], offset)


#: Verdicts that are listed.
MOST_VERDICTS = 300
#: Fixes of one reason no farther apart than this are one verdict, s.
TOGETHER = 5.0
#: Heights that were left out no farther apart than this are one verdict, m.
NEAR = 60.0
#: What a receiver says itself, or where nothing is to be compared with, comes last in the list.
MILD = frozenset({REASONS[STATED_SIGMA], REASONS[FAR], REASONS[BEYOND]})


def verdicts(
    fixes: Sequence[Fixes],
    tracks: Sequence[Surveyed],
    heights: Sequence[Heights | None],
    tables: Sequence[KnotTable],
    runs: Sequence[dict[str, Any]],
) -> dict[str, Any]:
    """Gather the verdicts of a build.

    Parameters
    ----------
    fixes : sequence of Fixes
        Of the runs that took part.
    tracks : sequence of Surveyed
    heights : sequence of (Heights or None)
        Those of the tracks.
    tables : sequence of KnotTable
        Their knots: offsets are those of the model.
    runs : sequence of dict
        Entries of the report, for the stretches on another track.

    Returns
    -------
    dict
        `total` and `list`: stretches first, then links, fixes and heights, the largest of each first.
    """
    found: list[dict[str, Any]] = []
    place = [Place.nowhere(len(f)) for f in fixes]
    for t, table in zip(tracks, tables, strict=True):
        scale = float(table.offset[-1]) / ((len(t.nominal) - 1) * t.nominal.step)
        for laid, i in zip(t.laid, t.runs, strict=True):
            place[i].put(t.name, laid.offset * scale)
        found += [_slip(fixes[t.runs[k]], t, k, node, size, scale) for k, node, size in slips(t)]
    total = len(found)
    for t, h, table in zip(tracks, heights, tables, strict=True):
        if h is not None:
            total += len(h.gross)
            found += _heights(fixes, t, h, float(table.offset[-1]) / (len(t.nominal) - 1))
    for f, where in zip(fixes, place, strict=True):
        many, told = _of_run(f, where, (USED, OTHER_TRACK, TURNED, LINKS))
        total += many
        found += told
    for entry in runs:
        for part in entry["other_track"]:
            total += 1
            found.append(
                {
                    "what": "stretch",
                    "run": entry["id"],
                    "time_s": None,
                    "track": part["track"],
                    "offset_m": part["from_m"],
                    "to_m": part["to_m"],
                    "size": part["distance_m"],
                    "unit": "m",
                    "reason": REASONS[OTHER_TRACK],
                }
            )
    return _gravest(total, found)


def verdicts_of_update(
    fixes: Sequence[Fixes], tracks: Sequence[Surveyed], sections: Sequence[Section]
) -> dict[str, Any]:
    """Gather what an update set aside of its new runs, with places on the renewed model's tracks.

    Parameters
    ----------
    fixes : sequence of Fixes
        Of the new runs.
    tracks : sequence of Surveyed
        What they were laid along: stored axes and new ones.
    sections : sequence of Section
        The renewed model's tracks as parts of these.

    Returns
    -------
    dict
        `total` and `list` as in `verdicts`: links and fixes; stretches on another track are fixes of that reason here.
    """
    place = [Place.nowhere(len(f)) for f in fixes]
    for t in tracks:
        for section in sections:
            if section.of != t.name:
                continue
            scale = float(section.table.offset[-1]) / max(section.last - section.first, 1)
            for laid, i in zip(t.laid, t.runs, strict=True):
                node = laid.offset / t.nominal.step
                inside = np.isfinite(node) & (node >= section.first) & (node <= section.last)
                place[i].put(section.name, np.where(inside, (node - section.first) * scale, np.nan))
    found: list[dict[str, Any]] = []
    total = 0
    for f, where in zip(fixes, place, strict=True):
        many, told = _of_run(f, where, (USED, TURNED, LINKS))
        total += many
        found += told
    return _gravest(total, found)


def _gravest(total: int, found: list[dict[str, Any]]) -> dict[str, Any]:
    order = {"stretch": 0, "link": 1, "fix": 2, "height": 3}
    found.sort(key=lambda v: (order[v["what"]], v["reason"] in MILD, -abs(v["size"] or 0.0)))
    return {"total": total, "list": found[:MOST_VERDICTS]}


def _of_run(f: Fixes, place: Place, told: tuple[int, ...]) -> tuple[int, list[dict[str, Any]]]:
    """What was set aside of one run: how many, and the entries; `told` reasons are said elsewhere or are none."""
    found: list[dict[str, Any]] = []
    track, offset = place.everywhere()
    rows = np.flatnonzero(~np.isin(f.reason, told))
    total = len(rows)
    if f.attributed is not None:
        total += len(f.attributed.found)
        found += [_attributed(f, a, track, offset) for a in f.attributed.found]
    found += [_fixes(f, group, track, offset) for group in _groups(f, rows)]
    return total, found


def _number(value: float, digits: int) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None


def _groups(f: Fixes, rows: IntArray) -> Iterator[IntArray]:
    """Fixes that were set aside for one reason, one after the other."""
    if not len(rows):
        return
    apart = (np.diff(f.reason[rows]) != 0) | (np.diff(f.time[rows]) > TOGETHER)
    yield from np.split(rows, np.flatnonzero(apart) + 1)


def _fixes(f: Fixes, group: IntArray, track: NDArray[np.object_], offset: FloatArray) -> dict[str, Any]:
    worst = group[int(np.argmax(f.size[group]))]
    entry = {
        "what": "fix",
        "run": f.run.id,
        "time_s": _number(f.time[group[0]], 3),
        "track": str(track[group[0]]),
        "offset_m": _number(offset[group[0]], 1),
        "easting_m": _number(f.easting[worst], 2),
        "northing_m": _number(f.northing[worst], 2),
        "size": _number(f.size[worst], 2),
        "unit": "m",
        "fixes": len(group),
        "reason": REASONS[f.reason[worst]],
    }
    return entry | _until(f, group[-1], group[0], offset)


def _heights(fixes: Sequence[Fixes], t: Surveyed, h: Heights, knot: float) -> Iterator[dict[str, Any]]:
    """Heights at nodes that were left out; those of one run that follow one another within `NEAR` are one verdict."""
    rows = sorted(h.gross)
    edges = [
        i
        for i in range(1, len(rows))
        if rows[i][0] != rows[i - 1][0] or (rows[i][1] - rows[i - 1][1]) * t.nominal.step > NEAR
    ]
    for a, b in pairwise([0, *edges, len(rows)]):
        if a == b:
            continue
        worst = max(rows[a:b], key=lambda row: abs(row[3]))
        first, last = rows[a][1], rows[b - 1][1]
        times = sorted(row[2] for row in rows[a:b])
        entry = {
            "what": "height",
            "run": fixes[worst[0]].run.id,
            "time_s": _number(times[0], 3),
            "track": t.name,
            "offset_m": _number(first * knot, 1),
            "easting_m": _number(float(t.nominal.easting[worst[1]]), 2),
            "northing_m": _number(float(t.nominal.northing[worst[1]]), 2),
            "size": _number(worst[3], 2),
            "unit": "m",
            "fixes": b - a,
            "reason": "gross error in height",
        }
        yield entry | ({"to_time_s": _number(times[-1], 3), "to_m": _number(last * knot, 1)} if b - a > 1 else {})


def _until(f: Fixes, last: int, first: int, offset: FloatArray) -> dict[str, Any]:
    """Where and when a verdict of several fixes ends."""
    if last == first:
        return {}
    out: dict[str, Any] = {"to_time_s": _number(f.time[last], 3)}
    if abs(offset[last] - offset[first]) > 1.0:
        out["to_m"] = _number(offset[last], 1)
    return out


def _slip(f: Fixes, t: Surveyed, k: int, node: int, size: float, scale: float) -> dict[str, Any]:
    """A gyroscope's angle that stands alone against the axis, its neighbours and the other runs."""
    return {
        "what": "link",
        "run": f.run.id,
        "time_s": _number(float(t.profile.time[k, node]), 3),
        "track": t.name,
        "offset_m": _number(node * t.nominal.step * scale, 1),
        "easting_m": _number(float(t.nominal.easting[node]), 2),
        "northing_m": _number(float(t.nominal.northing[node]), 2),
        "size": _number(size, 5),
        "unit": "rad",
        "reason": "angle against the axis and its neighbours",
    }


def _attributed(f: Fixes, a: Attribution, track: NDArray[np.object_], offset: FloatArray) -> dict[str, Any]:
    """One contradiction of fixes and increments; its place is that of the fix at which it showed."""
    at = a.first if a.wrong == "fix" else a.last
    entry = {
        "what": a.wrong,
        "run": f.run.id,
        "time_s": _number(a.time, 3),
        "track": str(track[at]),
        "offset_m": _number(offset[at], 1),
        "easting_m": _number(f.easting[at], 2),
        "northing_m": _number(f.northing[at], 2),
        "size": _number(a.size, 3),
        "unit": "m",
        "fixes": a.last - a.first + 1 if a.wrong == "fix" else 0,
        "reason": REASONS[LINKS]
        if a.wrong == "fix"
        else "odometer or gyroscope contradicts the fixes before and after",
        "statistic": _number(a.statistic, 1),
        "limit": _number(a.limit, 1),
        "evidence": _number(a.evidence, 1),
    }
    return entry | (_until(f, a.last, a.first, offset) if a.wrong == "fix" else {})
