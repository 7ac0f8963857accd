"""The report of a build: what was used, what was rejected and why, how good the result is, where to survey again.

It is one dictionary of JSON values in `model.provenance["build"]`; an unknown number is None. Keys:

- `runs`: one entry a run
  - `id`, `receiver`, `direction`, `start`; `tracks`: identifiers of the tracks it took part in (empty when nothing was used)
  - `fixes`: `total`, `used`, `rejected` {reason: {`count`, `worst`: up to 3 of {`time_s`, `easting_m`, `northing_m`, `size_m`}}}
  - `frame_offset`: `east_m`, `north_m`, `up_m` (how far the run's positions stand from the model's datum) and `sigma_east_m`,
    `sigma_north_m`, `sigma_up_m`
  - `noise`: `cross_sigma_m` (robust, 1.4826 MAD of its fixes across the model's axis, frame offset removed), `white_m`,
    `correlated_m`, `correlation_time_s`, `stated_sigma_m` (median of what the receiver says)
  - `other_track`: stretches set aside because the run is on another track there: {`track`, `from_m`, `to_m`, `distance_m`}
  - `coverage`: `length_m`, `share` (of the tracks it took part in), `gaps`: number of gaps longer than 200 m
- `receivers`: one entry a kind of receiver: `receiver`, `runs`, `offset_east_m`, `offset_north_m`, `sigma_east_m`, `sigma_north_m`
- `datum`: `rule` (plain words), `observable` (bool), `sigma_east_m`, `sigma_north_m`
- `tracks`: one entry a track: `track`, `length_m`, `runs` (identifiers), `sigma_cross_m` and `sigma_cross_95_m`, `unit_weight_rms`
  (of the chain across: 1 where weights are honest and errors white, less where errors of seconds stand as stronger white noise),
  `heights` (bool), `survey_again`: list of {`from_m`, `to_m`, `sigma_m`, `reason`}
- `verdicts`: every gross error (`railnav.survey.verdicts`): `total`, and `list` of up to 300
- `repeatability`: one entry a kind of receiver: axes from single runs of different dates compared, as a histogram
  (`railnav.survey.repeatability`)
- `warnings`: sentences in plain words
- `settings`: the numbers the build chose (`step_m`, `curvature_noise`, ...)
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.survey.axis import ErrorModel
from railnav.survey.fixes import BEYOND, FAR, OTHER_TRACK, REASONS, TURNED, USED, Fixes
from railnav.survey.offsets import Offsets
from railnav.survey.repeatability import repeatability
from railnav.survey.surveyed import Surveyed
from railnav.survey.verdicts import verdicts
from railnav.survey.vertical import Heights

if TYPE_CHECKING:
    from railnav.run import Run
    from railnav.track.alignment import KnotTable

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: Examples a reason of rejection.
WORST = 3
#: A way without fixes is a gap from here on, m.
GAP = 200.0
#: A run is present within this of a fix, m (more where its fixes lie farther apart).
NEAR = 60.0
#: Accuracy is weak where sigma exceeds this times the track's median.
WEAK = 2.0
#: Shorter stretches are not worth a survey, m; more than this many are not listed.
SHORTEST_AGAIN, MOST_AGAIN = 50.0, 100
#: An antenna higher than this above the rails leans noticeably with the cant, m.
LEAN_HEIGHT = 0.3
#: Receivers differ when their offsets stand this many sigma apart.
SIGNIFICANT = 3.0


class Survey:
    """The runs of a build and what is found about them on the way.

    Parameters
    ----------
    fixes : list of Fixes
        Runs that take part.
    courses : list of (k, 2) array
        Their courses.
    refused : list of (Run, str)
        Runs that do not, and why.
    """

    def __init__(self, fixes: list[Fixes], courses: list[FloatArray], refused: list[tuple[Run, str]]) -> None:
        self.fixes, self.courses, self.refused = fixes, courses, refused
        self.receivers = [f.receiver for f in fixes]
        self.receiver_names = sorted(set(self.receivers))
        self.kind: IntArray = np.array([self.receiver_names.index(r) for r in self.receivers], np.int64)
        self.stated = {name: self._stated(name, "sigma") for name in self.receiver_names}
        self.stated_up = {name: self._stated(name, "sigma_up") for name in self.receiver_names}
        self.models: dict[str, ErrorModel] = {}
        self.assumed: set[str] = set()
        self.warnings: list[str] = []

    def _stated(self, receiver: str, which: str) -> float:
        values = []
        for f in self.fixes:
            if f.receiver != receiver:
                continue
            v = f.sigma if which == "sigma" else f.run.gnss.sigma_up if f.run.gnss is not None else None
            if v is not None and np.isfinite(v).any():
                values.append(v[np.isfinite(v)])
        return float(np.median(np.concatenate(values))) if values else float("nan")

    def name_track(self, runs: Sequence[int], others: Sequence[Surveyed]) -> str:
        """Identifier of a new track: its runs' direction where they name one, numbered when taken."""
        labels = [self.fixes[i].run.direction for i in runs if self.fixes[i].run.direction]
        taken = {t.name for t in others}
        base = max(sorted(set(labels)), key=labels.count) if labels else "track"
        if labels and base not in taken:
            return base
        number = 1 if not labels else 2
        while f"{base}-{number}" in taken:
            number += 1
        return f"{base}-{number}"

    def settle_reasons(self, tracks: Sequence[Surveyed]) -> None:
        """Say of the fixes that no track took why: far away, or beyond its end."""
        from scipy.spatial import cKDTree

        taken: dict[int, BoolArray] = {}
        for t in tracks:
            for i, laid in zip(t.runs, t.laid, strict=True):
                taken[i] = taken.get(i, np.zeros(len(laid.fixes), np.bool_)) | np.isfinite(laid.offset)
        for t in tracks:
            tree = None
            for i, laid in zip(t.runs, t.laid, strict=True):
                f = laid.fixes
                lost = np.flatnonzero((f.reason == USED) & ~taken[i])
                if not len(lost):
                    continue
                if tree is None:
                    tree = cKDTree(np.column_stack([t.nominal.easting, t.nominal.northing]))
                distance, node = tree.query(np.column_stack([f.easting[lost], f.northing[lost]]))
                end = (node == 0) | (node == len(t.nominal) - 1)
                f.reason[lost] = np.where(end, BEYOND, FAR)
                f.size[lost] = distance


def compose(
    survey: Survey,
    tracks: Sequence[Surveyed],
    offsets: Offsets,
    heights: Sequence[Heights | None],
    up: Offsets | None,
    tables: Sequence[KnotTable],
) -> dict[str, Any]:
    """Write the report of a build as JSON values."""
    home: dict[int, tuple[Surveyed, int, KnotTable]] = {}
    most: dict[int, int] = {}
    for t, table in zip(tracks, tables, strict=True):
        for k, i in enumerate(t.runs):  # the track on which a run has most of its fixes
            many = int(np.count_nonzero(np.isfinite(t.laid[k].offset)))
            if many > most.get(i, -1):
                most[i], home[i] = many, (t, k, table)
    runs = [_run(survey, i, home.get(i), offsets, up) for i in range(len(survey.fixes))]
    for i, entry in enumerate(runs):
        entry["tracks"] = [t.name for t in tracks if i in t.runs and t.profile.present[t.runs.index(i)].any()]
    runs += [_refused(run, cause) for run, cause in survey.refused]
    receivers = _receivers(survey, offsets)
    datum = _datum(survey, offsets)
    told = [_track(survey, t, table, h is not None) for t, table, h in zip(tracks, tables, heights, strict=True)]
    return {
        "runs": runs,
        "receivers": receivers,
        "datum": datum,
        "tracks": told,
        "verdicts": verdicts(survey.fixes, tracks, heights, tables, runs),
        "repeatability": repeatability(survey.fixes, tracks, offsets),
        "warnings": _warnings(survey, offsets, datum, tracks, heights, runs, told),
        "settings": {
            "step_m": [t.nominal.step for t in tracks],
            "curvature_noise": [t.noise_level for t in tracks],
            "error_models": {
                name: {
                    "white_m": _number(m.white),
                    "correlated_m": _number(m.correlated),
                    "correlation_time_s": _number(m.memory),
                    "assumed": name in survey.assumed,
                }
                for name, m in survey.models.items()
            },
        },
    }


def _number(value: float, digits: int = 4) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None


def _run(
    survey: Survey,
    i: int,
    home: tuple[Surveyed, int, KnotTable] | None,
    offsets: Offsets,
    up: Offsets | None,
) -> dict[str, Any]:
    f = survey.fixes[i]
    entry: dict[str, Any] = {
        "id": f.run.id,
        "receiver": f.run.gnss.receiver if f.run.gnss is not None else "",
        "direction": f.run.direction,
        "start": f.run.start.isoformat(),
        "tracks": [home[0].name] if home is not None else [],
        "fixes": {"total": len(f), "used": int(np.count_nonzero(f.reason == USED)), "rejected": rejected(f)},
    }
    sigma = offsets.sigma(i)
    has_up = up is not None and bool(np.isfinite(f.height).any())
    entry["frame_offset"] = {
        "east_m": _number(offsets.run[i, 0]),
        "north_m": _number(offsets.run[i, 1]),
        "up_m": _number(up.run[i, 0]) if up is not None and has_up else None,
        "sigma_east_m": _number(sigma[0]),
        "sigma_north_m": _number(sigma[1]),
        "sigma_up_m": _number(up.sigma(i)[0]) if up is not None and has_up else None,
    }
    noise: dict[str, Any] = {
        "cross_sigma_m": None,
        "white_m": None,
        "correlated_m": None,
        "correlation_time_s": None,
        "stated_sigma_m": _number(float(np.median(f.sigma[np.isfinite(f.sigma)])))
        if np.isfinite(f.sigma).any()
        else None,
    }
    entry["noise"] = noise
    entry["other_track"] = []
    entry["coverage"] = {"length_m": 0.0, "share": 0.0, "gaps": 0}
    if home is None:
        return entry
    t, k, table = home
    model = t.errors[k]
    residual = _residuals(t, k, offsets)
    if len(residual):
        noise["cross_sigma_m"] = _number(1.4826 * float(np.median(np.abs(residual - np.median(residual)))))
    noise["white_m"], noise["correlated_m"] = _number(model.white), _number(model.correlated)
    noise["correlation_time_s"] = _number(model.memory, 1)
    entry["other_track"] = _elsewhere(t, k, table)
    here = _present(t)[k]
    at = np.flatnonzero(here)
    gaps = np.diff(at) * t.nominal.step if len(at) else np.zeros(0)
    entry["coverage"] = {
        "length_m": _number(float(here.mean()) * float(table.offset[-1]), 1),
        "share": _number(float(here.mean())),
        "gaps": int(np.count_nonzero(gaps > GAP)),
    }
    return entry


def _refused(run: Run, cause: str) -> dict[str, Any]:
    many = len(run.gnss) if run.gnss is not None else 0
    return {
        "id": run.id,
        "receiver": run.gnss.receiver if run.gnss is not None else "",
        "direction": run.direction,
        "start": run.start.isoformat(),
        "tracks": [],
        "fixes": {"total": many, "used": 0, "rejected": {cause: {"count": many, "worst": []}}},
        "frame_offset": None,
        "noise": None,
        "other_track": [],
        "coverage": {"length_m": 0.0, "share": 0.0, "gaps": 0},
    }


def rejected(f: Fixes) -> dict[str, Any]:
    """Fixes of a run that were not used, by reason: how many, and the worst."""
    out: dict[str, Any] = {}
    for code, reason in enumerate(REASONS):
        rows = np.flatnonzero(f.reason == code)
        if code == USED or not len(rows):
            continue
        worst = rows[np.argsort(-f.size[rows], kind="stable")[:WORST]]
        out[reason] = {
            "count": len(rows),
            "worst": [
                {
                    "time_s": _number(f.time[j], 3),
                    "easting_m": _number(f.easting[j], 2),
                    "northing_m": _number(f.northing[j], 2),
                    "size_m": _number(f.size[j], 2),
                }
                for j in worst
            ],
        }
    return out


def _residuals(t: Surveyed, k: int, offsets: Offsets) -> FloatArray:
    """Distances of a run's used fixes from the axis, frame offset removed, m."""
    laid, i = t.laid[k], t.runs[k]
    use = np.flatnonzero((laid.fixes.reason == USED) & np.isfinite(laid.offset))
    e, n = t.nominal.normal
    nodes = np.arange(len(t.nominal))
    line = t.axis + offsets.run[i, 0] * e + offsets.run[i, 1] * n
    return np.asarray(laid.right[use] - np.interp(laid.offset[use] / t.nominal.step, nodes, line))


def _elsewhere(t: Surveyed, k: int, table: KnotTable) -> list[dict[str, Any]]:
    """Stretches of a run on another track, by offset."""
    laid = t.laid[k]
    f = laid.fixes
    rows = np.flatnonzero((f.reason == OTHER_TRACK) & np.isfinite(laid.offset))
    if not len(rows):
        return []
    rows = rows[np.argsort(laid.offset[rows], kind="stable")]
    s = laid.offset[rows]
    cuts = np.flatnonzero(np.diff(s) > GAP) + 1
    stretch = float(table.offset[-1]) / ((len(t.nominal) - 1) * t.nominal.step)
    parts = [part for part in np.split(rows, cuts) if laid.offset[part[-1]] - laid.offset[part[0]] >= 0.5 * NEAR]
    return [
        {
            "track": t.name,
            "from_m": _number(float(laid.offset[part[0]]) * stretch, 1),
            "to_m": _number(float(laid.offset[part[-1]]) * stretch, 1),
            "distance_m": _number(float(np.median(f.size[part])), 2),
        }
        for part in parts
    ]


def _present(t: Surveyed) -> BoolArray:
    """Where each run of a track is present: within reach of a used fix (K, N)."""
    from scipy.ndimage import maximum_filter1d

    out = np.zeros(t.profile.count.shape, np.bool_)
    for k, row in enumerate(t.profile.present):
        at = np.flatnonzero(row)
        if not len(at):
            continue
        apart = float(np.median(np.diff(at))) if len(at) > 1 else 1.0
        width = max(round(NEAR / t.nominal.step), int(2 * apart))
        out[k] = maximum_filter1d(row.astype(np.int8), 2 * width + 1) > 0
    return out


def _receivers(survey: Survey, offsets: Offsets) -> list[dict[str, Any]]:
    B = offsets.run.shape[1]
    sigma = np.sqrt(np.maximum(np.diag(offsets.receiver_covariance), 0.0)).reshape(-1, B)
    return [
        {
            "receiver": name,
            "runs": int(np.count_nonzero(survey.kind == c)),
            "offset_east_m": _number(offsets.receiver[c, 0]),
            "offset_north_m": _number(offsets.receiver[c, 1]),
            "sigma_east_m": _number(sigma[c, 0]),
            "sigma_north_m": _number(sigma[c, 1]),
            "scatter_m": _number(offsets.scatter[c]),
            "weight_in_datum": _number(offsets.weight[c]),
        }
        for c, name in enumerate(survey.receiver_names)
    ]


def _datum(survey: Survey, offsets: Offsets) -> dict[str, Any]:
    sigma = offsets.datum_sigma()
    names = survey.receiver_names
    if sigma is None:
        stated = survey.stated[names[0]]
        own = stated if np.isfinite(stated) else survey.models[names[0]].total
        return {
            "rule": f"mean of the runs of the only kind of receiver ({names[0]}); an offset common to all of them cannot be seen",
            "observable": False,
            "sigma_east_m": _number(own),
            "sigma_north_m": _number(own),
        }
    shares = ", ".join(f"{name} {100 * w:.0f} %" for name, w in zip(names, offsets.weight, strict=True))
    return {
        "rule": f"weighted mean of the kinds of receiver ({shares}); which of them is right cannot be seen",
        "observable": True,
        "sigma_east_m": _number(sigma[0]),
        "sigma_north_m": _number(sigma[1]),
    }


def _track(survey: Survey, t: Surveyed, table: KnotTable, heights: bool) -> dict[str, Any]:
    assert t.estimate is not None
    sigma = np.sqrt(t.estimate.covariance[:, 0, 0])
    return {
        "track": t.name,
        "length_m": _number(float(table.offset[-1])),
        "runs": [survey.fixes[i].run.id for k, i in enumerate(t.runs) if t.profile.present[k].any()],
        "sigma_cross_m": _number(float(np.median(sigma))),
        "sigma_cross_95_m": _number(float(np.quantile(sigma, 0.95))),
        "unit_weight_rms": _number(t.unit_weight),
        "heights": heights,
        "survey_again": _survey_again(t, sigma, float(table.offset[-1])),
    }


def _survey_again(t: Surveyed, sigma: FloatArray, length: float) -> list[dict[str, Any]]:
    """Stretches without fixes, with a single run where there are several, or of weak accuracy."""
    many = _present(t).sum(axis=0)
    weak = sigma > WEAK * float(np.median(sigma))
    reason = np.where(many == 0, 1, np.where((many == 1) & (len(t.runs) >= 3), 2, np.where(weak, 3, 0)))
    words = {1: "no fixes", 2: "one run only", 3: "weak accuracy"}
    edges = np.concatenate([[0], np.flatnonzero(np.diff(reason)) + 1, [len(reason)]])
    scale = length / (len(reason) - 1)
    found: list[dict[str, Any]] = [
        {
            "from_m": _number(a * scale, 1),
            "to_m": _number(min(b, len(reason) - 1) * scale, 1),
            "sigma_m": _number(float(sigma[a:b].max())),
            "reason": words[int(reason[a])],
        }
        for a, b in pairwise(edges)
        if reason[a] and (b - a) * scale >= SHORTEST_AGAIN
    ]
    worst = sorted(found, key=lambda item: item["from_m"] - item["to_m"])[:MOST_AGAIN]
    return sorted(worst, key=lambda item: item["from_m"])


def _warnings(
    survey: Survey,
    offsets: Offsets,
    datum: dict[str, Any],
    tracks: Sequence[Surveyed],
    heights: Sequence[Heights | None],
    runs: Sequence[dict[str, Any]],
    told: Sequence[dict[str, Any]],
) -> list[str]:
    out = list(survey.warnings)
    out += [f"run {run.id} was left out: {cause}" for run, cause in survey.refused]
    names = survey.receiver_names
    B = 2
    P = offsets.receiver_covariance
    for a in range(len(names)):
        for b in range(a):
            d = offsets.receiver[a] - offsets.receiver[b]
            i, j = slice(a * B, (a + 1) * B), slice(b * B, (b + 1) * B)
            sigma = np.sqrt(np.diag(P[i, i] + P[j, j] - P[i, j] - P[j, i]))
            if (np.abs(d) > SIGNIFICANT * sigma).any():
                ns, ew = ("north" if d[1] > 0 else "south"), ("east" if d[0] > 0 else "west")
                out.append(
                    f"positions of {names[a]} lie {abs(d[1]):.2f} m {ns} and {abs(d[0]):.2f} m {ew} of those of {names[b]} "
                    f"(sigma {sigma[1]:.2f} and {sigma[0]:.2f} m): a difference of frames; the model lies between, by the datum rule"
                )
    if not datum["observable"]:
        out.append(
            "all runs come from one kind of receiver: an offset common to them (antenna, datum, software) moves the model as a "
            "whole and cannot be seen; add runs of another kind"
        )
    if survey.assumed:
        out.append(
            f"no two runs of one track let the errors of {', '.join(sorted(survey.assumed))} be checked: they are assumed from the "
            "stated sigmas"
        )
    out += [f"run {f.run.id}: {f.attributed.unsure}" for f in survey.fixes if f.attributed and f.attributed.unsure]
    leaning = [f for f in survey.fixes if f.run.gnss is not None and abs(f.run.gnss.lever_arm_b[2]) > LEAN_HEIGHT]
    leaning = [f for f in leaning if f.angles is None and (f.run.gauge is None or f.run.gauge.cant is None)]
    if leaning:
        high = max(abs(float(f.run.gnss.lever_arm_b[2])) for f in leaning if f.run.gnss is not None)
        out.append(
            f"{len(leaning)} runs carry the antenna up to {high:.1f} m above the rails and measure neither attitude nor cant: in a curve "
            f"with 100 mm of cant it leans {100 * high * 0.1 / 1.5:.0f} cm to the inside, and the axis with it; give gyro_angles or "
            "gauge with cant"
        )
    frames = sorted({f.run.gnss.frame for f in survey.fixes if f.run.gnss is not None})
    if len(frames) > 1:
        out.append(f"runs came in different frames ({', '.join(frames)}), turned to WGS 84 as the registry has it")
    for t in tracks:
        if len(t.runs) == 1:
            out.append(
                f"track {t.name} rests on one run ({survey.fixes[t.runs[0]].run.id}): its errors are nobody's to see"
            )
    for entry in runs:
        aside = entry["other_track"]
        if aside:
            far = sorted(part["distance_m"] for part in aside)
            where = ", ".join(f"{part['from_m']:.0f} to {part['to_m']:.0f}" for part in aside[:5])
            where += f" and {len(aside) - 5} more" if len(aside) > 5 else ""
            out.append(
                f"run {entry['id']} lies {far[0]:.1f}{f' to {far[-1]:.1f}' if len(far) > 1 else ''} m beside track "
                f"{aside[0]['track']} at offsets {where} m: on another track there, or wrong; not used there"
            )
        if REASONS[TURNED] in entry["fixes"]["rejected"]:
            out.append(
                f"run {entry['id']} turns back; only its longest way in one sense is used: make a run of each way"
            )
        fixes = entry["fixes"]
        if entry["tracks"] and fixes["used"] < 0.5 * fixes["total"]:
            out.append(f"of run {entry['id']} less than half is used ({fixes['used']} of {fixes['total']} fixes)")
    for track in told:
        bare = [part for part in track["survey_again"] if part["reason"] == "no fixes"]
        if bare:
            length = sum(part["to_m"] - part["from_m"] for part in bare)
            out.append(
                f"track {track['track']} has no fixes over {length:.0f} m in {len(bare)} places; it is bridged smoothly there"
            )
    for t, h in zip(tracks, heights, strict=True):
        if h is not None and h.rejected > 0.05 * h.total:
            out.append(f"of the heights along {t.name} {100 * h.rejected / h.total:.0f} % are gross errors")
    return out
