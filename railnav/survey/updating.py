"""Later runs refine a stored model: no data of the old runs are needed, their square-root records speak for them.

New runs are laid along the stored axes. Their own chain, without the stored one, is compared with it window by window: where the
track was moved, the stored rows of that stretch are forgotten. Then the stored rows take the place of the curvature's random walk in
the chain of the new runs, with the frame offset of the track among the border parameters; receivers that the model knows bring what
it knows of their offsets. What comes out is stored again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError, ModelError, RunError
from railnav.survey import surveyed
from railnav.survey.axis import ErrorModel, solve, sweep
from railnav.survey.construction import gathered
from railnav.survey.fixes import USED
from railnav.survey.laying import lay_runs, stored_lines
from railnav.survey.noise import ASSUMED_ERROR, ASSUMED_MEMORY, SCALES, error_model_against
from railnav.survey.refining import (
    ROUNDS,
    Joint,
    Side,
    find_changes,
    know_with,
    mask,
    merged,
    set_aside,
    settle_with,
)
from railnav.survey.report import Survey, rejected
from railnav.survey.stored import keep_axis, keep_borders, mean_of, model_words
from railnav.survey.surveyed import Surveyed
from railnav.survey.tabulation import tabulate
from railnav.survey.vertical import measured_cant, with_heights
from railnav.track.records import AxisRecords, Borders, ModelRecords, TrackRecords

if TYPE_CHECKING:
    from railnav.run import Progress, Run
    from railnav.track.alignment import KnotTable
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: How far the first guess of an axis may be off: so many sigma of a fix.
FIRST_SLACK = 2.0
#: An axis that moves less than this keeps its knots, m.
UNMOVED = 1e-4
#: Of an unknown receiver's runs, how far they scatter in terms of their correlated error.
SCATTER_SHARE = 0.5
YEAR_SECONDS = 365.25 * 86400.0


def update(
    model: TrackModel,
    runs: Sequence[Run],
    *,
    crs: str | None = None,
    half_life: float | None = None,
    false_alarm: float = 1e-3,
    progress: Progress | None = None,
) -> TrackModel:
    """Refine a stored model with later runs; the raw data of the old ones are not needed.

    Parameters
    ----------
    model : TrackModel
        Built or updated by railnav: it carries the square-root records of its surveys.
    runs : sequence of Run
        New drives over its tracks.
    crs : str, optional
        The plane that the model is expected in, anything PROJ knows; refused when it is in another one.
    half_life : float, optional
        Years in which what is stored loses half its weight; by default nothing is lost, and the result is that of all runs together.
    false_alarm : float
        Probability that anywhere along a track a change is seen though nothing has moved.
    progress : callable, optional
        Called with the stage, how much is done and how much there is.

    Returns
    -------
    TrackModel
        The same tracks, nodes and movements; axes, heights and covariances refined. `provenance["updates"]` has one more entry:
        what was used, what was found moved, what was set aside and why (`railnav.survey.updating.compose`).

    Raises
    ------
    ModelError
        The model carries no records, or its knots were changed since.
    CrsError
        The model is in another plane than `crs`.
    RunError
        No runs, no usable fixes, a run that is in the model already, or one that is of another line.

    Notes
    -----
    Against a build from all runs the axis differs by a small part of its sigma (docs/theory/estimation.md has figures): weights of
    doubtful fixes and the runs' error models are judged by what is there at the time, and of each track the chain nearest to the joint
    distribution is stored. A track that moved as a whole cannot be told from a run whose frame is off.

    References
    ----------
    Specification rail 18.

    Examples
    --------
    >>> import railnav
    >>> update(railnav.demo_line(), [])
    Traceback (most recent call last):
        ...
    railnav.errors.ModelError: the model carries no survey records, so later runs cannot refine it; build it from its runs
    """
    tell = progress or _silent
    records = model.records
    if records is None:
        raise ModelError(
            "the model carries no survey records, so later runs cannot refine it", remedy="build it from its runs"
        )
    if half_life is not None and not half_life > 0:
        raise ModelError(f"a half-life of {half_life} years is not positive")
    _check_plane(model, crs)
    runs = list(runs)
    if not runs:
        raise RunError("no runs to update with", remedy="give one folder or more, each a drive with GNSS")
    _refuse_known(runs, records)
    lines = stored_lines(model, records)
    survey = gathered(runs, model.frame, tell)
    for run, cause in survey.refused:
        raise RunError(cause, file=run.source or run.id, remedy="leave it out of the update")
    receivers = [*records.across.receivers, *(n for n in survey.receiver_names if n not in records.across.receivers)]
    kind = np.array([receivers.index(name) for name in survey.receivers], np.int64)
    sigma = [_known_model(records, name, survey, "across").total for name in survey.receivers]
    labels: dict[str, set[str]] = {name: {name} for name in lines}
    for known in records.runs:
        for name in known["tracks"]:
            labels.setdefault(name, set()).add(str(known.get("direction", "")))
    tracks, warnings = lay_runs(lines, labels, survey.fixes, sigma)
    survey.warnings += warnings
    tell("lay out", 1, 1)
    weight = _age(records, runs, half_life)

    across = _Refinement(records, records.across, "across", receivers, kind, survey)
    across.sides = [_side_across(t, records) for t in tracks]
    across.run(weight, false_alarm, tell)
    up: _Refinement | None = None
    if records.up is not None:
        sides = [s for s in (_side_up(t, records) for t in tracks) if s is not None]
        up = _Refinement(records, records.up, "up", receivers, kind, survey)
        up.sides = sides
        if sides:
            up.run(weight, false_alarm, tell)
    tell("tabulate", 0, 1)
    out = _assembled(model, records, survey, tracks, across, up, receivers, kind, weight)
    tell("tabulate", 1, 1)
    return out


def _silent(stage: str, done: int, total: int) -> None:
    pass


def _check_plane(model: TrackModel, crs: str | None) -> None:
    if crs is None:
        return
    import pyproj

    try:
        wanted = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        raise CrsError(f"{crs!r} is no coordinate system that PROJ knows") from error
    if not wanted.equals(pyproj.CRS.from_wkt(model.frame.crs_wkt)):
        raise CrsError(
            f"the model is in {model.frame.name}, not in {wanted.name}: an update keeps the model's plane; name no other, or build "
            "anew in it"
        )


def _refuse_known(runs: Sequence[Run], records: ModelRecords) -> None:
    known = {(r["id"], r["start"]) for r in records.runs}
    seen: set[tuple[str, str]] = set()
    for run in runs:
        key = (run.id, run.start.isoformat())
        if key in known:
            raise RunError(
                f"run {run.id} of {run.start:%Y-%m-%d} is in the model already: it would count twice",
                file=run.source or run.id,
                remedy="leave it out",
            )
        if key in seen:
            raise RunError(f"run {run.id} is given twice", file=run.source or run.id, remedy="give it once")
        seen.add(key)


def _age(records: ModelRecords, runs: Sequence[Run], half_life: float | None) -> float:
    """Share of the stored information that is kept."""
    if half_life is None or not records.runs:
        return 1.0
    last = max(datetime.fromisoformat(r["start"]) for r in records.runs)
    seconds = (min(run.start for run in runs) - last).total_seconds()
    return float(0.5 ** (max(seconds, 0.0) / YEAR_SECONDS / half_life))


def _known_model(records: ModelRecords, receiver: str, survey: Survey, coordinate: str) -> ErrorModel:
    """Error model of a receiver as the model knows it, or as the receiver states it."""
    told = (records.receivers.get(receiver) or {}).get(coordinate)
    if told:
        return ErrorModel(told["white_m"], told["correlated_m"], told["correlation_time_s"], told["total_m"])
    stated = (survey.stated if coordinate == "across" else survey.stated_up).get(receiver, np.nan)
    s = float(stated) if np.isfinite(stated) else ASSUMED_ERROR
    return ErrorModel(0.5 * s, s, ASSUMED_MEMORY, 1.1 * s)


def _side_across(t: Surveyed, records: ModelRecords) -> Side:
    zero = np.zeros(len(t.nominal))
    return Side(
        track=t, stored=records.tracks[t.name].across, up=False, axis=zero.copy(), design=t.design, base=zero.copy()
    )


def _side_up(t: Surveyed, records: ModelRecords) -> Side | None:
    stored = records.tracks[t.name]
    if stored.up is None or stored.height is None:
        return None
    part = with_heights(t, stored.height)
    if part is None:
        return None
    N = len(t.nominal)
    return Side(
        track=part, stored=stored.up, up=True, axis=np.zeros(N), design=np.ones((N, 1)), base=np.array(stored.height)
    )


@dataclass(slots=True, eq=False)
class _Refinement:
    """One coordinate of all tracks that new runs pass."""

    records: ModelRecords
    borders: Borders
    coordinate: str
    receivers: list[str]
    kind: IntArray
    survey: Survey
    sides: list[Side] = None  # type: ignore[assignment]
    joint: Joint = None  # type: ignore[assignment]
    models: dict[str, ErrorModel] = None  # type: ignore[assignment]

    def place(self, side: Side) -> int:
        """Place of a track among the frame offsets."""
        return self.borders.tracks.index(side.track.name)

    def settle(self, knowledge: Sequence[tuple[int, Any]]) -> Joint:
        """Frame offsets from what the chains say."""
        scatter, known = [], []
        for name in self.receivers:
            told = (self.records.receivers.get(name) or {}).get(self.coordinate)
            scatter.append(told["scatter_m"] if told else SCATTER_SHARE * self.models[name].correlated)
            known.append(float(self.records.receivers[name]["runs"]) if told else 0.0)
        B = 2 if self.coordinate == "across" else 1
        return settle_with(self.borders, self.receivers, knowledge, self.kind, np.array(scatter), np.array(known), B)

    def run(self, weight: float, false_alarm: float, tell: Progress) -> None:
        """Find error models, changes and the merged estimates."""
        names = sorted(set(self.survey.receivers))
        self.models = {n: _known_model(self.records, n, self.survey, self.coordinate) for n in self.receivers}
        first = [(self.place(s), s.first_offsets()) for s in self.sides]
        self.joint = self.settle(first)
        samples = [self.sample(s) for s in self.sides]
        for name in names:
            if not (self.records.receivers.get(name) or {}).get(self.coordinate):
                self.models[name] = error_model_against(samples, name) or self.models[name]
        for side in self.sides:
            side.track.errors = [self.scaled(side, k) for k in range(len(side.track.runs))]
        self.joint = self.settle(first)
        seen = []
        for i, side in enumerate(self.sides):
            tell(f"compare {self.coordinate}", i, len(self.sides))
            slack = FIRST_SLACK * max(e.total for e in side.errors)
            seen.append(find_changes(side, self.joint, self.place(side), slack, false_alarm))
            set_aside(side)
        tell(f"compare {self.coordinate}", len(self.sides), len(self.sides))
        kept = []
        for side, line in zip(self.sides, seen, strict=True):
            moved = mask(side, "moved")
            side.axis = np.where(moved, line, 0.0)
            kept.append((side.stored.chain().aged(weight).forgotten(moved), moved))
        for turn in range(ROUNDS):
            tell(f"merge {self.coordinate}", turn, ROUNDS)
            chains = [merged(s, r, m, self.joint.run, 0.0) for s, (r, m) in zip(self.sides, kept, strict=True)]
            swept = [sweep(chain) for chain in chains]
            self.joint = self.settle(
                [
                    (self.place(s), know_with(s, w.border, w.border_value))
                    for s, w in zip(self.sides, swept, strict=True)
                ]
            )
            for side, chain, w in zip(self.sides, chains, swept, strict=True):
                at = self.joint.part([self.place(side)], side.track.runs)
                border = np.concatenate(
                    [self.joint.run[list(side.track.runs)].ravel(), self.joint.track[self.place(side)]]
                )
                side.estimate = solve(chain, w, border, self.joint.covariance[np.ix_(at, at)], sure=True)
                side.axis = side.estimate.state[:, 0]
        tell(f"merge {self.coordinate}", ROUNDS, ROUNDS)

    def sample(self, side: Side) -> Any:
        """Distances of the new runs from the stored axis, by bins that hold fixes of most runs."""
        names = [self.survey.receivers[i] for i in side.track.runs]
        if self.coordinate == "across":
            coarse = max(20.0, 1.25 * surveyed.fix_spacing(side.track))
            return replace(
                surveyed.reduced(side.track, self.joint.run, coarse, self.survey.receivers), receiver=tuple(names)
            )
        from railnav.survey.noise import Sample

        count = np.array(
            [float(np.median(row[row > 0])) if (row > 0).any() else 1.0 for row in side.track.profile.count]
        )
        pace = np.array([
            float(np.median(np.abs(np.diff(t[np.isfinite(v)])))) if np.isfinite(v).sum() > 1 else 1.0
            for t, v in zip(side.track.profile.time, side.track.profile.right, strict=True)
        ])  # fmt: skip
        return Sample(
            side.levelled(self.joint.run), side.track.profile.time, count, count / np.maximum(pace, 1e-3), tuple(names)
        )

    def scaled(self, side: Side, k: int) -> ErrorModel:
        """Error model of one run: its receiver's, larger or smaller as its distances to the stored axis say."""
        model = self.models[self.survey.receivers[side.track.runs[k]]]
        level = side.levelled(self.joint.run)[k]
        level = level[np.isfinite(level)]
        if len(level) < 30:
            return model
        solution = side.stored.chain().solve()
        assert solution.covariance is not None
        own = (1.4826 * float(np.median(np.abs(level - np.median(level))))) ** 2
        own = max(own - float(np.median(solution.covariance[:, 0, 0])), 0.0)
        count = max(float(np.median(side.track.profile.count[k][side.track.profile.count[k] > 0])), 1.0)
        usual = model.correlated**2 + model.white**2 / count
        return model.scaled(float(np.clip(np.sqrt(0.8 * own / usual + 0.2), *SCALES)))


# ---------------------------------------------------------------- the new model


def digest(records: ModelRecords) -> str:
    """Fingerprint of stored records: which model an update came from."""
    h = hashlib.sha256()
    for name in sorted(records.tracks):
        t = records.tracks[name]
        for a in (t.easting, t.northing, t.across.rows):
            h.update(np.ascontiguousarray(a, "<f8").tobytes())
    return h.hexdigest()[:16]


def _assembled(
    model: TrackModel,
    records: ModelRecords,
    survey: Survey,
    tracks: Sequence[Surveyed],
    across: _Refinement,
    up: _Refinement | None,
    receivers: list[str],
    kind: IntArray,
    weight: float,
) -> TrackModel:
    """Put the refined tracks in the place of the stored ones, and keep what is known now."""
    plan = {s.track.name: s for s in across.sides}
    rise = {s.track.name: s for s in up.sides} if up is not None and up.joint is not None else {}
    counts = {name: sum(name in r["tracks"] for r in records.runs) for name in records.tracks}
    tables: dict[str, KnotTable] = {}
    kept: dict[str, TrackRecords] = {}
    moved_m: dict[str, FloatArray] = {}
    settled: set[tuple[str, str]] = set()  # offsets that are counted from the new estimate
    for name, old in records.tracks.items():
        side, high = plan.get(name), rise.get(name)
        shift_across = _shift(across, side, name, old.across)
        shift_up = None if old.up is None or up is None or up.joint is None else _shift(up, high, name, old.up)
        plane_moves = side is not None or float(np.abs(shift_across).max()) > UNMOVED
        height_moves = shift_up is not None and (high is not None or float(np.abs(shift_up).max()) > UNMOVED)
        if not plane_moves and not height_moves:
            kept[name] = old
            continue
        line = side.track.nominal if side is not None else _line(old)
        e, n = line.normal
        y = shift_across if plane_moves else np.zeros(len(line))
        moved_m[name] = y
        if plane_moves:
            settled.add(("across", name))
        if height_moves:
            settled.add(("up", name))
        height = old.height if not height_moves or old.height is None or shift_up is None else old.height + shift_up
        new_across = old.across if side is None else _keep_side(across, side, counts[name])
        new_up = old.up if high is None or up is None else _keep_side(up, high, counts[name])
        kept[name] = TrackRecords(old.step, old.easting + y * e, old.northing + y * n, height, new_across, new_up)
        variance = _variance(across, side, name, old.across)
        rise_variance = None if old.up is None or up is None else _variance(up, high, name, old.up)
        k = model.knots(name)
        tables[name] = tabulate(
            line,
            y,
            variance,
            _track_covariance(across, name),
            None if height is None or rise_variance is None else (height, rise_variance),
            _cant(model, name, side, counts[name], len(line)),
            model.frame,
            float(np.median(np.diff(model.offset[k]))),
        )
    new_records = ModelRecords(
        tracks=kept,
        across=_new_borders(across, counts, settled),
        up=records.up if up is None or up.joint is None else _new_borders(up, counts, settled),
        receivers=_receivers(records, survey, across, up, receivers, kind),
        runs=(
            *records.runs,
            *(
                {
                    "id": f.run.id,
                    "start": f.run.start.isoformat(),
                    "direction": f.run.direction,
                    "tracks": [t.name for t in tracks if i in t.runs],
                }
                for i, f in enumerate(survey.fixes)
            ),
        ),
    )
    entry = compose(model, records, survey, tracks, across, up, tables, moved_m, weight)
    provenance = {
        **model.provenance,
        "updates": [*model.provenance.get("updates", []), entry],
    }
    if any(f.run.simulated for f in survey.fixes):
        provenance["simulated"] = True
    return with_tables(model, tables, provenance, new_records)


def _line(old: TrackRecords) -> Any:
    from railnav.survey.nominal import through

    return through(old.easting, old.northing, old.step)


def _shift(side_of: _Refinement, side: Side | None, name: str, stored: AxisRecords) -> FloatArray:
    """How far a track's nodes move, (N,): as estimated, or with its frame offset alone where no new run passes."""
    if side is not None and side.estimate is not None:
        return side.estimate.state[:, 0]
    c = side_of.joint.track[side_of.borders.tracks.index(name)]
    return np.asarray(stored.lean[:, 0, :] @ c)


def _track_covariance(side_of: _Refinement, name: str) -> FloatArray:
    at = side_of.joint.part([side_of.borders.tracks.index(name)], [])
    return side_of.joint.covariance[np.ix_(at, at)]


def _variance(side_of: _Refinement, side: Side | None, name: str, stored: AxisRecords) -> FloatArray:
    if side is not None and side.estimate is not None:
        return side.estimate.covariance[:, 0, 0]
    solution = stored.chain().solve()
    assert solution.covariance is not None
    if side_of.joint is None:
        return solution.covariance[:, 0, 0]
    D = stored.lean[:, 0, :]
    return np.asarray(solution.covariance[:, 0, 0] + np.einsum("ki,ij,kj->k", D, _track_covariance(side_of, name), D))


def _weights(side: Side, old: int, B: int) -> FloatArray:
    """The mean frame offset of a track's runs: the new ones each, the stored mean as often as it has runs."""
    K = len(side.track.runs)
    total = K + max(old, 1)
    return mean_of(range(K + 1), [1.0 / total] * K + [max(old, 1) / total], (K + 1) * B, B)


def _keep_side(side_of: _Refinement, side: Side, old: int) -> AxisRecords:
    assert side.estimate is not None
    at = side_of.joint.part([side_of.place(side)], side.track.runs)
    moved = mask(side, "moved")
    noise = side.stored.noise.copy()
    if moved.any():
        local = surveyed.local_noise(side.estimate, float(np.median(noise)), side.track.nominal.step)
        free = moved[:-1] | moved[1:]
        noise[free] = local[free]
    M = _weights(side, old, side.design.shape[1])
    return keep_axis(side.estimate, side_of.joint.covariance[np.ix_(at, at)], M, noise)


def _new_borders(side_of: _Refinement, counts: dict[str, int], settled: set[tuple[str, str]]) -> Borders:
    joint, B = side_of.joint, side_of.joint.run.shape[1]
    T, C = len(joint.track), len(joint.receiver)
    A = np.zeros(((T + C) * B, len(joint.covariance)))
    A[:, : (T + C) * B] = np.eye((T + C) * B)
    mean = np.concatenate([joint.track.ravel(), joint.receiver.ravel()])
    for t, name in enumerate(side_of.borders.tracks):
        if (side_of.coordinate, name) in settled:
            mean[t * B : (t + 1) * B] = 0.0
    for side in side_of.sides:
        t = side_of.place(side)
        at = joint.part([t], side.track.runs)
        A[t * B : (t + 1) * B] = 0.0
        A[t * B : (t + 1) * B, at] = _weights(side, counts[side.track.name], B)
    return keep_borders(side_of.borders.tracks, side_of.receivers, mean, A @ joint.covariance @ A.T)


def _receivers(
    records: ModelRecords,
    survey: Survey,
    across: _Refinement,
    up: _Refinement | None,
    receivers: Sequence[str],
    kind: IntArray,
) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for c, name in enumerate(receivers):
        old = records.receivers.get(name) or {"runs": 0, "weight": 0.0, "across": None, "up": None}
        new = {**old, "runs": int(old["runs"]) + int(np.count_nonzero(kind == c))}
        new["across"] = model_words(across.models[name], float(across.joint.scatter[c]))
        if up is not None and up.joint is not None and (old["up"] or name in survey.receiver_names):
            new["up"] = model_words(up.models[name], float(up.joint.scatter[c]))
        out[name] = new
    return out


def _cant(model: TrackModel, name: str, side: Side | None, old: int, nodes: int) -> FloatArray | None:
    """Cant at the nodes: the stored one and that of the new runs, each run counting the same."""
    k = model.knots(name)
    at = np.linspace(model.offset[k][0], model.offset[k][-1], nodes)
    stored = np.interp(at, model.offset[k], model.cant[k])
    new = None if side is None else measured_cant(side.track)
    if new is None:
        return stored
    if not stored.any():
        return new
    many = sum(t.fixes.run.gauge is not None for t in side.track.laid) if side is not None else 0
    return np.asarray((old * stored + many * new) / (old + many))


def with_tables(
    model: TrackModel, tables: dict[str, KnotTable], provenance: dict[str, Any], records: ModelRecords | None
) -> TrackModel:
    """The model with some of its tracks tabulated anew; mile posts and nodes go with them."""
    from railnav.track.model import KNOT_COLUMNS, MilePosts

    columns: dict[str, list[FloatArray]] = {c: [] for c in (*KNOT_COLUMNS, "covariance_g")}
    posts = np.array(model.mileposts.offset)
    sizes = []
    for i, name in enumerate(model.track_id):
        part = model.knots(name)
        table: Any = tables.get(name)
        for c, pieces in columns.items():
            pieces.append(getattr(model, c)[part] if table is None else getattr(table, c))
        sizes.append(len(columns["offset"][-1]))
        if table is not None:
            here = model.mileposts.track == i
            posts[here] *= table.offset[-1] / model.offset[part][-1]
    start = np.append(0, np.cumsum(sizes)).astype(np.int64)
    knots: dict[str, Any] = {c: np.concatenate(pieces) for c, pieces in columns.items()}
    nodes = model.nodes
    place = np.zeros((len(nodes.id), 3))
    many = np.zeros(len(nodes.id))
    fresh = np.zeros(len(nodes.id), np.bool_)
    for ends, pick in ((model.start_node, start[:-1]), (model.end_node, start[1:] - 1)):
        np.add.at(place, ends, np.column_stack([knots[c][pick] for c in ("easting", "northing", "height")]))
        np.add.at(many, ends, 1.0)
        fresh[ends[[name in tables for name in model.track_id]]] = True
    place /= np.maximum(many, 1.0)[:, None]
    return replace(
        model,
        knot_start=start,
        **knots,
        nodes=replace(
            nodes,
            easting=np.where(fresh, place[:, 0], nodes.easting),
            northing=np.where(fresh, place[:, 1], nodes.northing),
            height=np.where(fresh, place[:, 2], nodes.height),
        ),
        mileposts=MilePosts(model.mileposts.track, posts, model.mileposts.chainage),
        provenance=provenance,
        record_source=None if records is None else lambda: records,
    )


def compose(
    model: TrackModel,
    records: ModelRecords,
    survey: Survey,
    tracks: Sequence[Surveyed],
    across: _Refinement,
    up: _Refinement | None,
    tables: dict[str, KnotTable],
    moved_m: dict[str, FloatArray],
    weight: float,
) -> dict[str, Any]:
    """Report of an update as JSON values, one entry of `model.provenance["updates"]`.

    Keys: `parent` (fingerprint of the records that were refined), `weight_of_stored`; `runs` (`id`, `start`, `receiver`, `tracks`,
    `fixes` as in the report of a build, `frame_offset`); `tracks` (`track`, `length_before_m`, `length_m`, `sigma_before_m`,
    `sigma_m`, `change_rms_m`, `change_max_m` and `changes`: stretches {`from_m`, `to_m`, `coordinate`, `verdict`, `shift_m`,
    `sigma_m`, `statistic`, `limit`, `dof`, `runs`}); `receivers` (`receiver`, `offset_east_m`, `offset_north_m`, `up_m`);
    `warnings`: sentences in plain words.
    """
    warnings = list(survey.warnings)
    plan = {s.track.name: s for s in across.sides}
    rise = {s.track.name: s for s in up.sides} if up is not None else {}
    told: list[dict[str, Any]] = []
    for name in records.tracks:
        if name not in tables:
            continue
        k = model.knots(name)
        before, after = float(model.offset[k][-1]), float(tables[name].offset[-1])
        side = plan.get(name)
        found: list[dict[str, Any]] = []
        for coordinate, which in (("across", side), ("up", rise.get(name))):
            if which is None:
                continue
            scale = after / (len(which.axis) - 1)
            for c in which.changes:
                names = [survey.fixes[i].run.id for i in c.runs]
                part: dict[str, Any] = {
                    "from_m": round(c.first * scale, 1),
                    "to_m": round(c.last * scale, 1),
                    "coordinate": coordinate,
                    "verdict": c.verdict,
                    "shift_m": round(c.shift, 4),
                    "sigma_m": round(c.sigma, 4),
                    "statistic": round(c.statistic, 1),
                    "limit": round(c.limit, 1),
                    "dof": c.dof,
                    "runs": names,
                }
                found.append(part)
                if c.verdict != "unsure":
                    warnings.append(_words(name, part))
        old = records.tracks[name].across
        sigma_before = np.sqrt(_stored_variance(across, old, name))
        told.append(
            {
                "track": name,
                "length_before_m": round(before, 4),
                "length_m": round(after, 4),
                "runs": [] if side is None else [survey.fixes[i].run.id for i in side.track.runs],
                "sigma_before_m": round(float(np.median(sigma_before)), 4),
                "sigma_m": round(float(np.sqrt(np.median(_variance(across, side, name, old)))), 4),
                "change_rms_m": round(float(np.sqrt(np.mean(moved_m[name] ** 2))), 4),
                "change_max_m": round(float(np.abs(moved_m[name]).max()), 4),
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
                "tracks": [t.name for t in tracks if i in t.runs],
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
        "receivers": [
            {
                "receiver": name,
                "offset_east_m": round(float(across.joint.receiver[c, 0]), 4),
                "offset_north_m": round(float(across.joint.receiver[c, 1]), 4),
                "known_before": name in records.across.receivers,
            }
            for c, name in enumerate(across.receivers)
        ],
        "warnings": warnings,
    }


def _stored_variance(side_of: _Refinement, stored: AxisRecords, name: str) -> FloatArray:
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
    size = f"{abs(part['shift_m']) * 1e3:.0f} mm {ahead if part['shift_m'] > 0 else back} (sigma {part['sigma_m'] * 1e3:.0f} mm)"
    if part["verdict"] == "moved":
        return f"{where} has moved {size}: what was stored of it there is forgotten"
    if part["verdict"] == "contradiction":
        return f"{where}: the new runs contradict each other ({', '.join(part['runs'])}); none is used there, the stored axis stays"
    return f"{where}: the new runs lie {size}, farther than tracks are moved: another track; not used there"
