"""The model after an update: refined tracks in the place of the stored ones, new ones beside them, and what is known now."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.survey import surveyed
from railnav.survey.changes import mask
from railnav.survey.joining import SAME_NODE, join_tracks
from railnav.survey.laying import Ground, knots_of
from railnav.survey.layout import Join
from railnav.survey.stored import keep_axis, keep_borders, mean_of, model_words
from railnav.survey.tabulation import tabulate
from railnav.survey.vertical import measured_cant
from railnav.track.records import AxisRecords, Borders, ModelRecords, TrackRecords

if TYPE_CHECKING:
    from railnav.survey.refining import Refinement
    from railnav.survey.report import Survey
    from railnav.survey.sides import Side
    from railnav.survey.surveyed import Surveyed
    from railnav.track.alignment import KnotTable
    from railnav.track.assembly import TrackSection
    from railnav.track.model import Nodes, TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: An axis that moves less than this keeps its knots, m.
UNMOVED = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Renewed:
    """A surveyed track after an update.

    Attributes
    ----------
    name : str
    records : TrackRecords
        What is known of it now.
    table : KnotTable or None
        Its knots, before ends are drawn onto other tracks; None where it stays as it is.
    change : (N,) array
        How far its nodes have moved to the right, m; NaN where they are new.
    variance : (N,) array
        Across, m^2.
    settled : tuple of str
        Coordinates whose frame offset is counted from the new estimate.
    """

    name: str
    records: TrackRecords
    table: KnotTable | None
    change: FloatArray
    variance: FloatArray
    settled: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A track of the renewed model: the surveyed track that it is of, its first and last node there, and its knots."""

    name: str
    of: str
    first: int
    last: int
    table: KnotTable


def renewed(
    model: TrackModel,
    records: ModelRecords,
    ground: Ground,
    across: Refinement,
    up: Refinement | None,
    spacing: float,
    *,
    always: bool,
) -> Renewed:
    """Renew one track: as estimated where new runs pass; elsewhere only its frame offset may have changed.

    A track that stays as it is gets a table only where `always` asks for one.
    """
    name, known = ground.name, ground.known
    side = next((s for s in across.sides if s.track.name == name), None)
    high = None if up is None or up.joint is None else next((s for s in up.sides if s.track.name == name), None)
    shift = _shift(across, side, name, None if known is None else known.across)
    assert shift is not None
    rise = None if up is None or up.joint is None else _shift(up, high, name, None if known is None else known.up)
    plane_moves = side is not None or float(np.abs(shift).max()) > UNMOVED
    height_moves = rise is not None and (high is not None or float(np.abs(rise).max()) > UNMOVED)
    variance = _variance(across, side, name, None if known is None else known.across)
    N = len(ground.line)
    change = np.where(ground.stored(), shift if plane_moves else 0.0, np.nan)
    if not plane_moves and not height_moves and not always:
        assert known is not None
        return Renewed(name, known, None, change, variance, ())
    y = shift if plane_moves else np.zeros(N)
    # a track that is longer now keeps its heights only where the new part has them too
    height = ground.height if known is None or len(known.easting) == N or high is not None else None
    if known is None and high is None:
        height = None
    if height is not None and height_moves and rise is not None:
        height = height + rise
    count = sum(name in r["tracks"] for r in records.runs)
    e, n = ground.line.normal
    known_up = None if known is None or height is None else known.up
    rise_variance = None if height is None or up is None else _variance(up, high, name, known_up)
    kept = TrackRecords(
        ground.line.step,
        ground.line.easting + y * e,
        ground.line.northing + y * n,
        height,
        _keep_side(across, side, count) if side is not None else known.across,  # type: ignore[union-attr]
        known_up if high is None or up is None else _keep_side(up, high, count),
    )
    table = tabulate(
        ground.line,
        y,
        variance,
        _track_covariance(across, side, name),
        None if height is None or rise_variance is None else (height, rise_variance),
        _cant(model, records, ground, side, count),
        model.frame,
        spacing,
    )
    settled = (*(("across",) if plane_moves else ()), *(("up",) if height_moves else ()))
    return Renewed(name, kept, table, change, variance, settled)


def sections_of(
    model: TrackModel, records: ModelRecords, parts: Sequence[Renewed], joins: Sequence[dict[str, Any]]
) -> tuple[list[TrackSection], list[Section], dict[str, list[str]]]:
    """Draw ends onto the tracks that they spring from and part those there: the tracks of the renewed model.

    Returns
    -------
    sections : list of TrackSection
    told : list of Section
        The same with their places on the surveyed tracks.
    names : dict
        Sections of each surveyed track that is parted (`ModelRecords.parts`).
    """
    tables = []
    for part in parts:
        assert part.table is not None
        tables.append(part.table)
    before = {
        name: [
            (section, np.column_stack([model.easting[k], model.northing[k]]))
            for section in records.sections(name)
            if (k := model.knots(section))
        ]
        for name in records.tracks
    }
    found, names = join_tracks(
        [part.name for part in parts],
        tables,
        [Join(j["track"], j["end"], j["parent"], j["easting_m"], j["northing_m"]) for j in joins],
        before=before,
    )
    table_of = {section.track_id: section.knots for section in found}
    told: list[Section] = []
    for part in parts:
        of = names.get(part.name, [part.name])
        N = len(part.records.easting)
        lengths = np.cumsum([0.0, *(float(table_of[name].offset[-1]) for name in of)])
        edges = np.rint(lengths / lengths[-1] * (N - 1)).astype(int)
        told += [
            Section(name, part.name, int(a), int(b), table_of[name])
            for name, a, b in zip(of, edges[:-1], edges[1:], strict=True)
        ]
    return found, told, names


def renewed_records(
    records: ModelRecords,
    survey: Survey,
    tracks: Sequence[Surveyed],
    parts: Sequence[Renewed],
    across: Refinement,
    up: Refinement | None,
    kind: IntArray,
    joins: Sequence[dict[str, Any]],
    names: dict[str, list[str]],
) -> ModelRecords:
    """Give what is known after an update."""
    counts = {part.name: sum(part.name in r["tracks"] for r in records.runs) for part in parts}
    settled = {(coordinate, part.name) for part in parts for coordinate in part.settled}
    return ModelRecords(
        tracks={part.name: part.records for part in parts},
        across=_new_borders(across, counts, settled),
        up=records.up if up is None or up.joint is None else _new_borders(up, counts, settled),
        receivers=_receivers(records, survey, across, up, across.receivers, kind),
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
        joins=tuple(joins),
        parts=names,
    )


def _shift(side_of: Refinement, side: Side | None, name: str, stored: AxisRecords | None) -> FloatArray | None:
    """How far a track's nodes move, (N,): as estimated, or with its frame offset alone where no new run passes."""
    if side is not None and side.estimate is not None:
        return side.estimate.state[:, 0]
    if stored is None:
        return None
    c = side_of.joint.track[side_of.borders.tracks.index(name)]
    return np.asarray(stored.lean[:, 0, :] @ c)


def _track_covariance(side_of: Refinement, side: Side | None, name: str) -> FloatArray:
    """Covariance of the frame offset of a track: its own, or of a new one the mean of its runs'."""
    joint = side_of.joint
    if name in side_of.borders.tracks:
        at = joint.part([side_of.borders.tracks.index(name)], [])
        return joint.covariance[np.ix_(at, at)]
    assert side is not None
    at, B, K = joint.part([], side.track.runs), side.design.shape[1], len(side.track.runs)
    M = mean_of(range(K), [1.0 / K] * K, K * B, B)
    return M @ joint.covariance[np.ix_(at, at)] @ M.T


def _variance(side_of: Refinement, side: Side | None, name: str, stored: AxisRecords | None) -> FloatArray:
    if side is not None and side.estimate is not None:
        variance = side.estimate.covariance[:, 0, 0]
        least = _least(side)
        return variance if least is None else variance + np.maximum(least - side.estimate.inner[:, 0, 0], 0.0)
    assert stored is not None
    solution = stored.chain().solve()
    assert solution.covariance is not None
    if side_of.joint is None:
        return solution.covariance[:, 0, 0]
    D, P = stored.lean[:, 0, :], _track_covariance(side_of, side, name)
    return np.asarray(solution.covariance[:, 0, 0] + np.einsum("ki,ij,kj->k", D, P, D))


def _weights(side: Side, old: int) -> FloatArray:
    """The mean frame offset of a track's runs: the new ones each, the stored mean as often as it has runs."""
    K, B = len(side.track.runs), side.design.shape[1]
    if side.stored is None:
        return mean_of(range(K), [1.0 / K] * K, K * B, B)
    total = K + max(old, 1)
    return mean_of(range(K + 1), [1.0 / total] * K + [max(old, 1) / total], (K + 1) * B, B)


def _keep_side(side_of: Refinement, side: Side, old: int) -> AxisRecords:
    assert side.estimate is not None
    at = side_of.part(side)
    moved = mask(side, "moved")
    noise = side.noise.copy()
    if moved.any():
        local = surveyed.local_noise(side.estimate, float(np.median(noise)), side.track.nominal.step)
        free = moved[:-1] | moved[1:]
        noise[free] = local[free]
    covariance = side_of.joint.covariance[np.ix_(at, at)]
    return keep_axis(side.estimate, covariance, _weights(side, old), noise, least=_least(side))


def _least(side: Side) -> FloatArray | None:
    """Variance that a merged axis has at least, (N,) m^2: that of two surveys which err alike along the track.

    A stored chain ties neighbours only. What its runs err over a kilometre, in common, it takes for errors that average out, and
    merged with another run it would be too sure. The exact variance of two merged surveys at a node is at most
    (1 / P_old + 1 / P_new)^-1 of what each knows there by itself, and is that where their errors are alike along the track
    (the parallel sum of matrices is concave); as much is kept.
    """
    if side.stored is None or side.alone is None:
        return None
    solution = side.stored.chain().solve()
    assert solution.covariance is not None
    out = np.zeros(len(side.axis))
    old, new = solution.covariance[:, 0, 0], side.alone[side.old]
    with np.errstate(divide="ignore"):
        out[side.old] = np.where(np.isfinite(new), 1.0 / (1.0 / old + 1.0 / new), 0.0)
    out[mask(side, "moved")] = 0.0
    return out


def _new_borders(side_of: Refinement, counts: dict[str, int], settled: set[tuple[str, str]]) -> Borders:
    joint, B = side_of.joint, side_of.joint.run.shape[1]
    T, C = len(joint.track), len(joint.receiver)
    new = [side for side in side_of.sides if side.stored is None]
    A = np.zeros(((T + len(new) + C) * B, len(joint.covariance)))
    A[: T * B, : T * B] = np.eye(T * B)
    A[(T + len(new)) * B :, T * B : (T + C) * B] = np.eye(C * B)
    mean = np.concatenate([joint.track.ravel(), np.zeros(len(new) * B), joint.receiver.ravel()])
    for t, name in enumerate(side_of.borders.tracks):
        if (side_of.coordinate, name) in settled:
            mean[t * B : (t + 1) * B] = 0.0
    for side in side_of.sides:
        t = T + new.index(side) if side.stored is None else side_of.borders.tracks.index(side.track.name)
        A[t * B : (t + 1) * B] = 0.0
        A[t * B : (t + 1) * B, side_of.part(side)] = _weights(side, counts[side.track.name])
    names = (*side_of.borders.tracks, *(side.track.name for side in new))
    return keep_borders(names, side_of.receivers, mean, A @ joint.covariance @ A.T)


def _receivers(
    records: ModelRecords,
    survey: Survey,
    across: Refinement,
    up: Refinement | None,
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


def _cant(model: TrackModel, records: ModelRecords, ground: Ground, side: Side | None, old: int) -> FloatArray | None:
    """Cant at the nodes: the stored one and that of the new runs, each run counting the same."""
    new = None if side is None else measured_cant(side.track)
    if ground.known is None:
        return new
    k = knots_of(model, records, ground.name)
    here = ground.stored()
    stored = np.zeros(len(here))
    stored[here] = np.interp(np.linspace(k.offset[0], k.offset[-1], int(here.sum())), k.offset, k.cant)
    if new is None:
        return stored
    if not stored.any():
        return new
    many = sum(t.fixes.run.gauge is not None for t in side.track.laid) if side is not None else 0
    return np.asarray(np.where(here, (old * stored + many * new) / (old + many), new))


def with_tables(
    model: TrackModel, tables: dict[str, KnotTable], provenance: dict[str, Any], records: ModelRecords | None
) -> TrackModel:
    """The model with some of its tracks tabulated anew; mile posts, line references and nodes go with them."""
    from railnav.track.model import KNOT_COLUMNS, MilePosts

    columns: dict[str, list[FloatArray]] = {c: [] for c in (*KNOT_COLUMNS, "covariance_g")}
    posts, anchors = np.array(model.mileposts.offset), np.array(model.references.offset)
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
            anchors[model.references.track == i] *= table.offset[-1] / model.offset[part][-1]
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
        references=replace(model.references, offset=anchors),
        provenance=provenance,
        record_source=None if records is None else lambda: records,
    )


def reassembled(
    model: TrackModel,
    records: ModelRecords,
    sections: Sequence[TrackSection],
    told: Sequence[Section],
    provenance: dict[str, Any],
    known: ModelRecords,
) -> TrackModel:
    """The model with other tracks than before: lengthened, new or parted ones, and those that no survey made.

    Lines, names, mile posts and kilometres of the tracks that were there go with the places they stand at; nodes that stay keep
    their names.
    """
    from railnav.track.alignment import KnotTable
    from railnav.track.assembly import TrackSection, assemble
    from railnav.track.chainage import LineReferences
    from railnav.track.model import MilePosts

    surveyed_ones = {section for name in records.tracks for section in records.sections(name)}
    home = {section.name: section.of for section in told}
    out: list[TrackSection] = []
    for section in sections:
        olds = records.sections(home[section.track_id]) if home[section.track_id] in records.tracks else []
        ids = [section.track_id] if section.track_id in olds else olds
        line = {model.line[model.track_index(i)] for i in ids}
        name = {model.name[model.track_index(i)] for i in ids}
        out.append(
            TrackSection(
                section.track_id,
                section.knots,
                line=line.pop() if len(line) == 1 else "",
                name=name.pop() if len(name) == 1 else "",
            )
        )
    for i, track in enumerate(model.track_id):
        if track in surveyed_ones:
            continue
        k = model.knots(track)
        table = KnotTable(**{f.name: np.array(getattr(model, f.name)[k]) for f in fields(KnotTable)})
        out.append(TrackSection(track, table, line=model.line[i], name=model.name[i]))
    new = assemble(model.frame, out, join_within=0.05, provenance=provenance, record_source=lambda: known)
    post_track, post_offset = _carried(model, records, home, new, model.mileposts.track, model.mileposts.offset)
    order = np.lexsort((post_offset, post_track))
    kept = order[post_track[order] >= 0]
    anchor_track, anchor_offset = _carried(model, records, home, new, model.references.track, model.references.offset)
    rank = np.lexsort((anchor_offset, model.references.line, anchor_track))
    rank = rank[anchor_track[rank] >= 0]
    return replace(
        new,
        nodes=_renamed(model, new),
        mileposts=MilePosts(post_track[kept], post_offset[kept], model.mileposts.chainage[kept].copy()),
        references=LineReferences(
            model.references.lines,
            anchor_track[rank],
            model.references.line[rank].copy(),
            anchor_offset[rank],
            model.references.position[rank].copy(),
        ),
    )


def _carried(
    model: TrackModel, records: ModelRecords, home: dict[str, str], new: TrackModel, track: IntArray, offset: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Where places of the old model (track, offset) lie on the tracks of the new one."""
    place, at = np.full(len(track), -1, np.int64), np.zeros(len(track))
    for k in range(len(track)):
        old = model.track_id[int(track[k])]
        of = records.surveyed(old)
        heirs = [name for name in new.track_id if home.get(name, name) == of]
        here = model.at(old, float(offset[k]))
        best = np.inf
        for name in heirs:
            knots = new.knots(name)
            e, n = new.easting[knots], new.northing[knots]
            near = int(np.argmin(np.hypot(e - here.easting, n - here.northing)))
            b = new.grid_bearing[knots][near]
            ahead = (float(here.easting) - e[near]) * np.sin(b) + (float(here.northing) - n[near]) * np.cos(b)
            distance = float(np.hypot(e[near] - here.easting, n[near] - here.northing))
            if distance < best:
                best = distance
                length = float(new.offset[knots][-1])
                place[k] = new.track_index(name)
                at[k] = float(np.clip(new.offset[knots][near] + ahead / new.scale[knots][near], 0.0, length))
    return place, at


def _renamed(model: TrackModel, new: TrackModel) -> Nodes:
    """Nodes of the new model with the names they had where they were there before; buffer stops stay such."""
    from railnav.track.model import NodeKind

    taken: set[str] = set()
    names, kinds = [], np.array(new.nodes.kind)
    for i in range(len(new.nodes.id)):
        distance = np.hypot(model.nodes.easting - new.nodes.easting[i], model.nodes.northing - new.nodes.northing[i])
        near = int(np.argmin(distance))
        name = model.nodes.id[near] if distance[near] < SAME_NODE else ""
        if not name or name in taken:
            number = len(model.nodes.id) + 1
            while f"n{number}" in taken or f"n{number}" in model.nodes.id:
                number += 1
            name = f"n{number}"
        elif model.nodes.kind[near] == NodeKind.BUFFER_STOP and kinds[i] == NodeKind.END_OF_MODEL:
            kinds[i] = NodeKind.BUFFER_STOP
        taken.add(name)
        names.append(name)
    return replace(new.nodes, id=tuple(names), kind=kinds)
