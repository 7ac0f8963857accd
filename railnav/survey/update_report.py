"""What an update says of itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.survey.extension import ways_in_words
from railnav.survey.fixes import USED
from railnav.survey.report import rejected
from railnav.survey.stored import digest
from railnav.survey.verdicts import verdicts_of_update
from railnav.track.records import AxisRecords, ModelRecords

if TYPE_CHECKING:
    from railnav.survey.refining import Refinement
    from railnav.survey.renewal import Renewed, Section
    from railnav.survey.report import Survey
    from railnav.survey.sides import Side
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]


def compose(
    model: TrackModel,
    records: ModelRecords,
    survey: Survey,
    across: Refinement,
    up: Refinement | None,
    parts: Mapping[str, Renewed],
    sections: Sequence[Section],
    weight: float,
    beyond: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Report of an update as JSON values, one entry of `model.provenance["updates"]`.

    Keys: `parent` (fingerprint of the records that were refined), `weight_of_stored`; `runs` (`id`, `start`, `receiver`, `tracks`,
    `fixes` as in the report of a build, `frame_offset`); `tracks` (`track`, `length_before_m` (null: new), `length_m`,
    `new_m` (how much of it is new), `sigma_before_m`, `sigma_m`, `change_rms_m`, `change_max_m` and `changes`: stretches {`from_m`,
    `to_m`, `coordinate`, `verdict`, `shift_m`, `sigma_m`, `statistic`, `limit`, `dof`, `runs`}); `beyond`: ways of runs off the model's
    tracks ({`run`, `from_s`, `to_s`, `length_m`, `fixes`, `where`, `became`: the track that it lengthened or made, or null});
    `receivers` (`receiver`, `offset_east_m`, `offset_north_m`, `up_m`); `verdicts`: every gross error of the new runs
    (`railnav.survey.verdicts`): `total` and `list`, attributions to fixes or links with the evidence of two clones; `warnings`: sentences
    in plain words.
    """
    warnings = [*survey.warnings, *ways_in_words(beyond)]
    plan = {s.track.name: s for s in across.sides}
    rise = {s.track.name: s for s in up.sides} if up is not None else {}
    told: list[dict[str, Any]] = []
    for section in sections:
        side = plan.get(section.of)
        part = parts[section.of]
        old = records.tracks.get(section.of)
        here = slice(section.first, section.last + 1)
        length = float(section.table.offset[-1])
        found: list[dict[str, Any]] = []
        for coordinate, which in (("across", side), ("up", rise.get(section.of))):
            if which is not None:
                found += _changes(survey, which, coordinate, section, length)
        warnings += [_words(section.name, change) for change in found if change["verdict"] != "unsure"]
        moved = part.change[here]
        known = np.isfinite(moved)
        before = None
        if old is not None and known.any():
            first = int(np.flatnonzero(np.isfinite(part.change))[0])
            before = np.sqrt(_stored_variance(across, old.across, section.of))[
                max(section.first - first, 0) : section.last + 1 - first
            ]
        told.append(
            {
                "track": section.name,
                "length_before_m": round(model.length(section.name), 4) if section.name in model.track_id else None,
                "length_m": round(length, 4),
                "new_m": round(length * float(np.mean(~known)), 1),
                "runs": []
                if side is None
                else [
                    survey.fixes[i].run.id
                    for k, i in enumerate(side.track.runs)
                    if side.track.profile.present[k, section.first + 1 : section.last].any()
                ],
                "sigma_before_m": None if before is None else round(float(np.median(before)), 4),
                "sigma_m": round(float(np.sqrt(np.median(part.variance[here]))), 4),
                "change_rms_m": round(float(np.sqrt(np.mean(moved[known] ** 2))), 4) if known.any() else None,
                "change_max_m": round(float(np.abs(moved[known]).max()), 4) if known.any() else None,
                "changes": sorted(found, key=lambda part: part["from_m"]),
            }
        )
    runs: list[dict[str, Any]] = []
    for i, f in enumerate(survey.fixes):
        offset = across.joint.run[i]
        runs.append(
            {
                "id": f.run.id,
                "start": f.run.start.isoformat(),
                "receiver": f.run.gnss.receiver if f.run.gnss is not None else "",
                "direction": f.run.direction,
                "tracks": [t["track"] for t in told if f.run.id in t["runs"]],
                "fixes": {"total": len(f), "used": int(np.count_nonzero(f.reason == USED)), "rejected": rejected(f)},
                "frame_offset": {
                    "east_m": round(float(offset[0]), 4),
                    "north_m": round(float(offset[1]), 4),
                    "up_m": None
                    if up is None or up.joint is None or not np.isfinite(f.height).any()
                    else round(float(up.joint.run[i, 0]), 4),
                },
            }
        )
        if np.count_nonzero(f.reason == USED) < 0.5 * len(f):
            warnings.append(f"of run {f.run.id} less than half is used ({runs[-1]['fixes']['used']} of {len(f)} fixes)")
    warnings += [f"run {f.run.id}: {f.attributed.unsure}" for f in survey.fixes if f.attributed and f.attributed.unsure]
    unsure = sum(part["verdict"] == "unsure" for track in told for part in track["changes"])
    if unsure:
        warnings.append(
            f"at {unsure} places the new runs show another shape than the stored axis, but no distance that their errors would not "
            "explain: merged (verdict unsure in the report)"
        )
    return {
        "parent": digest(records),
        "weight_of_stored": weight,
        "runs": runs,
        "tracks": told,
        "beyond": [dict(way) for way in beyond],
        "receivers": [
            {
                "receiver": name,
                "offset_east_m": round(float(across.joint.receiver[c, 0]), 4),
                "offset_north_m": round(float(across.joint.receiver[c, 1]), 4),
                "known_before": name in records.across.receivers,
            }
            for c, name in enumerate(across.receivers)
        ],
        "verdicts": verdicts_of_update(survey.fixes, [s.track for s in across.sides], sections),
        "warnings": warnings,
    }


def _changes(survey: Survey, side: Side, coordinate: str, section: Section, length: float) -> list[dict[str, Any]]:
    """The stretches of a section that new runs see elsewhere, at its own offsets."""
    scale = length / max(section.last - section.first, 1)
    out = []
    for c in side.changes:
        first, last = max(c.first, section.first), min(c.last, section.last)
        if first > last or (first == last and c.first < c.last):
            continue
        out.append(
            {
                "from_m": round((first - section.first) * scale, 1),
                "to_m": round((last - section.first) * scale, 1),
                "coordinate": coordinate,
                "verdict": c.verdict,
                "shift_m": round(c.shift, 4),
                "sigma_m": round(c.sigma, 4),
                "statistic": round(c.statistic, 1),
                "limit": round(c.limit, 1),
                "dof": c.dof,
                "runs": [survey.fixes[i].run.id for i in c.runs],
            }
        )
    return out


def _stored_variance(side_of: Refinement, stored: AxisRecords, name: str) -> FloatArray:
    solution = stored.chain().solve()
    assert solution.covariance is not None
    B = 2
    i = side_of.borders.tracks.index(name) * B
    inverse = np.linalg.inv(side_of.borders.rows)
    P = (inverse @ inverse.T)[i : i + B, i : i + B]
    D = stored.lean[:, 0, :]
    return np.asarray(solution.covariance[:, 0, 0] + np.einsum("ki,ij,kj->k", D, P, D))


def _words(track: str, part: dict[str, Any]) -> str:
    where = f"track {track} at offsets {part['from_m']:.0f} to {part['to_m']:.0f} m"
    ahead, back = ("to the right", "to the left") if part["coordinate"] == "across" else ("up", "down")
    size = (
        f"{_length(abs(part['shift_m']))} {ahead if part['shift_m'] > 0 else back} (sigma {_length(part['sigma_m'])})"
    )
    if part["verdict"] == "moved":
        return f"{where} has moved {size}: what was stored of it there is forgotten"
    if part["verdict"] == "contradiction":
        return f"{where}: the new runs contradict each other ({', '.join(part['runs'])}); none is used there, the stored axis stays"
    return f"{where}: the new runs lie {size}, farther than tracks are moved: another track; not used there"


def _length(metres: float) -> str:
    return f"{metres * 1e3:.0f} mm" if metres < 1.0 else f"{metres:.1f} m"
