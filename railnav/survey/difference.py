"""Where did the track move? Two models of a line compared: slews and lifts with their sigmas, and the stretches that have moved.

A difference of two models has three parts: a shift of the one datum against the other, which is no movement; what both owe to their
errors, alike over long stretches; and movement. The common shift is estimated and told apart. Errors enter with their covariances:
of models from different runs they add up, P = P_old + P_new; a model that was refined from the other by `railnav update` holds all that
the other knew, so that P = P_old - P_new, save where an update forgot the old axis. Stretches are found window by window with the
cross-covariances of the stored chains; single points close to each other are worth little more than one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, ModelError
from railnav.survey.movement import SAME_TRACK, MovedStretch, meet, moved_by_updates, moved_stretches
from railnav.survey.offsets import HOLD, robust_fit
from railnav.survey.stored import digest
from railnav.track.model import TrackModel
from railnav.track.records import ModelRecords

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: A track of the same name is taken when it covers this share of the other one.
SHARE = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """Two models compared, point by point along the tracks of the old one.

    Attributes
    ----------
    tracks : tuple of str
        Tracks of the old model that were compared.
    partner : tuple of str
        Which track of the new one each was compared with.
    track : (m,) int array
        Index into `tracks`.
    offset, easting, northing : (m,) array
        Where, on the old model, m.
    slew, lift : (m,) array
        New less old, m: to the right as the old offset grows, and up; NaN where there is nothing to compare.
    common_slew, common_lift : (m,) array
        The part that a common shift of the datum explains, m.
    sigma_slew, sigma_lift : (m,) array
        Standard deviations of the rest, m; NaN where a model states none.
    moved : (m,) bool array
        Within a stretch that has moved.
    common : (3,) array
        Common shift, east, north and up, m; zero where the models share their datum.
    relation : str
        "update": the new model was refined from the old one; "shared": they have runs in common, so that sigmas are too large;
        "independent".
    stretches : tuple of MovedStretch
    only_old, only_new : tuple of str
        Tracks without a partner.
    warnings : tuple of str
    """

    tracks: tuple[str, ...]
    partner: tuple[str, ...]
    track: IntArray
    offset: FloatArray
    easting: FloatArray
    northing: FloatArray
    slew: FloatArray
    lift: FloatArray
    common_slew: FloatArray
    common_lift: FloatArray
    sigma_slew: FloatArray
    sigma_lift: FloatArray
    moved: BoolArray
    common: FloatArray
    relation: str
    stretches: tuple[MovedStretch, ...]
    only_old: tuple[str, ...]
    only_new: tuple[str, ...]
    warnings: tuple[str, ...]

    def summary(self) -> dict[str, Any]:
        """Facts as JSON values: relation, common shift, a line a track, moved stretches, warnings."""
        told = []
        for i, (name, other) in enumerate(zip(self.tracks, self.partner, strict=True)):
            here = self.track == i
            slew = (self.slew - self.common_slew)[here]
            lift = (self.lift - self.common_lift)[here]
            told.append(
                {
                    "track": name,
                    "partner": other,
                    "points": int(here.sum()),
                    "compared": int(np.isfinite(slew).sum()),
                    "slew_rms_m": _rms(slew),
                    "slew_max_m": _most(slew),
                    "sigma_slew_m": _middle(self.sigma_slew[here]),
                    "lift_rms_m": _rms(lift),
                    "lift_max_m": _most(lift),
                    "sigma_lift_m": _middle(self.sigma_lift[here]),
                    "moved_m": float(sum(s.last - s.first for s in self.stretches if s.track == name)),
                }
            )
        return {
            "relation": self.relation,
            "common_shift": {k: float(v) for k, v in zip(("east_m", "north_m", "up_m"), self.common, strict=True)},
            "tracks": told,
            "moved": [
                {
                    "track": s.track,
                    "coordinate": s.coordinate,
                    "from_m": s.first,
                    "to_m": s.last,
                    "shift_m": s.shift,
                    "sigma_m": s.sigma,
                    "statistic": s.statistic,
                    "limit": s.limit,
                    "found_by": s.found_by,
                }
                for s in self.stretches
            ],
            "only_old": list(self.only_old),
            "only_new": list(self.only_new),
            "warnings": list(self.warnings),
        }


def _rms(v: FloatArray) -> float | None:
    v = v[np.isfinite(v)]
    return float(np.sqrt(np.mean(v**2))) if len(v) else None


def _most(v: FloatArray) -> float | None:
    v = v[np.isfinite(v)]
    return float(v[np.argmax(np.abs(v))]) if len(v) else None


def _middle(v: FloatArray) -> float | None:
    v = v[np.isfinite(v)]
    return float(np.median(v)) if len(v) else None


def difference(old: TrackModel, new: TrackModel, *, spacing: float = 5.0, false_alarm: float = 1e-3) -> Difference:
    """Compare two models of a line: where the track lies elsewhere, by how much, and whether the errors explain it.

    Parameters
    ----------
    old, new : TrackModel
        In the same plane.
    spacing : float
        Distance of the points that are compared, m.
    false_alarm : float
        Probability, for each track and coordinate, that a stretch is called moved though nothing has.

    Returns
    -------
    Difference

    Raises
    ------
    CrsError
        The models are in different planes.
    ModelError
        They have no track in common, or the spacing is not positive.

    Notes
    -----
    A movement that the whole of a line shares cannot be told from a difference of datums; it stands in `common`. Windows and limits are
    those of `railnav.estimation.change_test`; where the differences of most windows exceed what the sigmas allow, all are scaled.

    References
    ----------
    Specification rail 18, change detection.

    Examples
    --------
    >>> import railnav
    >>> line = railnav.demo_line(spacing=10.0)
    >>> difference(line, line).stretches
    ()
    """
    if not spacing > 0:
        raise ModelError(f"a spacing of {spacing} m is not positive")
    if old.frame.crs_wkt != new.frame.crs_wkt or old.frame.pipeline != new.frame.pipeline:
        raise CrsError(
            f"the models are in different planes ({old.frame.name} and {new.frame.name}, or another transformation to it); "
            "build both in one"
        )
    records = old.records, new.records
    relation, warnings = _relation(old, new, records)
    pairs, only_old, only_new = _pairs(old, new, records[1])
    if not pairs:
        raise ModelError("the models have no track in common", remedy=f"they must lie within {SAME_TRACK:.0f} m")
    points = [_compare(old, new, a, b, spacing) for a, b in pairs]
    for (a, _), p in zip(pairs, points, strict=True):
        if sum(a == other for other, _ in pairs) > 1:  # each of its parts where it is
            known = np.isfinite(p["slew"])
            p.update({k: v[known] for k, v in p.items() if isinstance(v, np.ndarray)})
            p["P_slew"], p["P_lift"] = (tuple(v[known] for v in p[which]) for which in ("P_slew", "P_lift"))
    common = np.zeros(3)
    if relation != "update":
        common = _common(points)
    pieces = []
    stretches: list[MovedStretch] = []
    for number, ((a, b), p) in enumerate(zip(pairs, points, strict=True)):
        p["common_slew"] = p["normal"] @ common[:2]
        p["common_lift"] = np.full(len(p["offset"]), common[2])
        found = moved_stretches(old, new, records, a, b, p, relation, common, false_alarm)
        forgotten = moved_by_updates(new, relation, a, b, old, p)
        if relation == "update":
            found = forgotten
        p["moved"] = np.zeros(len(p["offset"]), np.bool_)
        for s in found:
            inside = (p["offset"] >= s.first) & (p["offset"] <= s.last)
            p["moved"] |= inside
            if relation == "update":  # there the old axis was given up: nothing is shared any more
                which = "slew" if s.coordinate == "across" else "lift"
                p[f"sigma_{which}"] = np.where(inside, p[f"sum_{which}"], p[f"sigma_{which}"])
        stretches += found
        p["track"] = np.full(len(p["offset"]), number)
        pieces.append(p)
    names = (
        "track", "offset", "easting", "northing", "slew", "lift", "common_slew", "common_lift", "sigma_slew", "sigma_lift", "moved",
    )  # fmt: skip
    columns: dict[str, Any] = {name: np.concatenate([p[name] for p in pieces]) for name in names}
    if not np.isfinite(columns["sigma_slew"]).any():
        warnings.append("one of the models states no covariances: no movement can be called significant")
    return Difference(
        tracks=tuple(a for a, _ in pairs),
        partner=tuple(b for _, b in pairs),
        **columns,
        common=common,
        relation=relation,
        stretches=tuple(stretches),
        only_old=only_old,
        only_new=only_new,
        warnings=tuple(warnings),
    )


def _relation(
    old: TrackModel, new: TrackModel, records: tuple[ModelRecords | None, ModelRecords | None]
) -> tuple[str, list[str]]:
    """How the models come from each other."""
    a, b = records
    warnings: list[str] = []
    if a is not None:
        mark = digest(a)
        if any(entry.get("parent") == mark for entry in new.provenance.get("updates", [])):
            return "update", warnings
    if b is not None and any(entry.get("parent") == digest(b) for entry in old.provenance.get("updates", [])):
        warnings.append(
            "the second model is older: the first one was refined from it; movements have the opposite sign"
        )
        return "update", warnings
    runs = [{(r["id"], r["start"]) for r in _runs(model)} for model in (old, new)]
    shared = runs[0] & runs[1]
    if shared:
        warnings.append(
            f"{len(shared)} runs stand behind both models: their errors are in both, and the sigmas of the difference are too large"
        )
        return "shared", warnings
    return "independent", warnings


def _runs(model: TrackModel) -> list[dict[str, Any]]:
    build = list(model.provenance.get("build", {}).get("runs", []))
    for entry in model.provenance.get("updates", []):
        build += entry.get("runs", [])
    return build


def _pairs(
    old: TrackModel, new: TrackModel, records: ModelRecords | None
) -> tuple[list[tuple[str, str]], tuple[str, ...], tuple[str, ...]]:
    """Tracks that are the same: by name where they lie together, otherwise the nearest."""
    from scipy.spatial import cKDTree

    trees = {}
    for name in new.track_id:
        k = new.knots(name)
        trees[name] = cKDTree(np.column_stack([new.easting[k], new.northing[k]]))
    pairs: list[tuple[str, str]] = []
    taken: set[str] = set()
    for name in old.track_id:
        k = old.knots(name)
        at = np.column_stack([old.easting[k], old.northing[k]])[:: max(1, (k.stop - k.start) // 500)]
        best, least = None, np.inf
        for other, tree in trees.items():
            distance = tree.query(at, distance_upper_bound=SAME_TRACK + 10.0)[0]
            near = distance < SAME_TRACK
            if near.mean() < SHARE:
                continue
            score = float(np.median(distance[near])) - (SAME_TRACK if other == name else 0.0)
            if score < least:
                best, least = other, score
        if best is not None:
            parts = [best]
            if records is not None and best not in old.track_id:  # parted since
                parts = [
                    part
                    for part in records.sections(records.surveyed(best))
                    if part == best
                    or (part not in old.track_id and part in trees and (trees[part].query(at)[0] < 1.0).sum() > 1)
                ]
            pairs += [(name, part) for part in parts]
            taken.update(parts)
    had = {a for a, _ in pairs}
    return (
        pairs,
        tuple(name for name in old.track_id if name not in had),
        tuple(name for name in new.track_id if name not in taken),
    )


def _compare(old: TrackModel, new: TrackModel, a: str, b: str, spacing: float) -> dict[str, Any]:
    """Meet the new track along the normals of the old one; slews, lifts and the covariances of both."""
    k = old.knots(a)
    length = float(old.offset[k][-1])
    s = np.linspace(0.0, length, max(2, round(length / spacing) + 1))
    here = old.at(a, s)
    east, north = np.cos(here.grid_bearing), -np.sin(here.grid_bearing)
    slew, lift, at, sense = meet(new, b, here.easting, here.northing, here.height, east, north)
    C_old, C_new = _covariance(old, a, s), _covariance(new, b, at)
    P_old = C_old[:, 0] * east**2 + 2 * C_old[:, 1] * east * north + C_old[:, 3] * north**2
    P_new = C_new[:, 0] * east**2 + 2 * C_new[:, 1] * east * north + C_new[:, 3] * north**2
    return {
        "offset": s,
        "easting": here.easting,
        "northing": here.northing,
        "normal": np.column_stack([east, north]),
        "slew": slew,
        "lift": lift,
        "at": at,
        "sense": sense,
        "P_slew": (P_old, P_new),
        "P_lift": (C_old[:, 5], C_new[:, 5]),
        "sum_slew": np.sqrt(P_old + P_new),
        "sum_lift": np.sqrt(C_old[:, 5] + C_new[:, 5]),
        "sigma_slew": np.sqrt(P_old + P_new),
        "sigma_lift": np.sqrt(C_old[:, 5] + C_new[:, 5]),
    }


def _covariance(model: TrackModel, track: str, offset: FloatArray) -> FloatArray:
    k = model.knots(track)
    return np.column_stack([np.interp(offset, model.offset[k], model.covariance_g[k][:, c]) for c in range(6)])


def _common(points: list[dict[str, Any]]) -> FloatArray:
    """Shift of one datum against the other: robust, from all tracks together."""
    normal = np.concatenate([p["normal"] for p in points])
    slew = np.concatenate([p["slew"] for p in points])
    lift = np.concatenate([p["lift"] for p in points])
    out = np.zeros(3)
    use = np.isfinite(slew)
    if np.count_nonzero(use) >= 10:
        out[:2], _ = robust_fit(normal[use], slew[use], np.full(2, HOLD))
    if np.isfinite(lift).any():
        out[2] = float(np.median(lift[np.isfinite(lift)]))
    return out
