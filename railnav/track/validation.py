"""Validation of a track model: every defect at once, each with its place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from railnav.track.model import End, NodeKind, TrackModel
from railnav.units import wrap_angle

#: Joined ends further apart than this are a gap, m.
GAP = 0.05
#: A permitted movement that turns by more than this is a kink, rad.
KINK = math.radians(0.5)
#: An end this near to another track that it does not join is a joint that is missing, m (and 2 m in height).
NEAR_MISS = 1.0
#: Tracks whose heights differ by more than this cross on two levels, m.
LEVEL = 2.0
#: Tracks that stay closer than this along their whole length are one track twice, m.
DUPLICATE = 0.3
#: Knots whose distance disagrees with their offsets by more than this are inconsistent, m per knot.
INCONSISTENT = 1e-3


@dataclass(frozen=True, slots=True)
class Defect:
    """Something wrong with a model.

    Attributes
    ----------
    kind : str
        gap | kink | duplicate | missing heights | impossible turnout | missing joint | disconnected | inconsistent knots.
    where : str
        Track, offset or node.
    detail : str
        What was found, with its size.
    remark : bool
        Worth knowing, but lawful as it is: parts of a network that nowhere come near to each other, a model without any heights.
    """

    kind: str
    where: str
    detail: str
    remark: bool = False


def validate(model: TrackModel) -> list[Defect]:
    """Check a model; an empty list means that nothing was found.

    Parameters
    ----------
    model : TrackModel

    Returns
    -------
    list of Defect
        Gaps over 5 cm and kinks over 0.5 degrees at permitted movements, tracks that lie upon each other, tracks without heights
        among tracks that have them, turnouts that no train can pass both ways, ends that meet but permit no movement, ends within 1 m of
        a track that they do not join, knots whose positions contradict their offsets. Remarks: parts without connection, such as the two
        tracks of a line without a crossover, and a model without any heights.
    """
    return [
        *_joints(model),
        *_turnouts(model),
        *_duplicates(model),
        *_heights(model),
        *_parts(model),
        *_knots(model),
    ]


def _end_knot(model: TrackModel, track: int, end: int) -> int:
    return int(model.knot_start[track + 1] - 1 if end == End.FINISH else model.knot_start[track])


def _joints(model: TrackModel) -> list[Defect]:
    """Gaps and kinks at permitted movements."""
    found = []
    degree = np.bincount(np.concatenate([model.start_node, model.end_node]), minlength=len(model.nodes.id))
    for a, end_a, b, end_b in model.movements.tolist():
        i, j = _end_knot(model, a, end_a), _end_knot(model, b, end_b)
        step = np.array([model.easting[j] - model.easting[i], model.northing[j] - model.northing[i]])
        rise = model.height[j] - model.height[i]
        gap = float(np.hypot(np.hypot(*step), rise if np.isfinite(rise) else 0.0))
        leave = model.grid_bearing[i] + (0.0 if end_a == End.FINISH else np.pi)
        enter = model.grid_bearing[j] + (np.pi if end_b == End.FINISH else 0.0)
        turn = float(wrap_angle(enter - leave))
        where = f"{model.track_id[a]} {End(end_a).name.lower()} to {model.track_id[b]} {End(end_b).name.lower()}"
        if gap > GAP:
            found.append(Defect("gap", where, f"{gap:.3f} m between the joined ends"))
        if abs(turn) > KINK:
            node = int(model.end_node[a] if end_a == End.FINISH else model.start_node[a])
            why = "; a slip that is drawn as a point has no curve" if degree[node] >= 4 else ""
            found.append(Defect("kink", where, f"direction changes by {math.degrees(turn):+.2f} degrees{why}"))
    return found


def _turnouts(model: TrackModel) -> list[Defect]:
    """Nodes where the movements cannot be right."""
    ends: dict[int, list[tuple[int, int]]] = {}
    for t in range(len(model.track_id)):
        ends.setdefault(int(model.start_node[t]), []).append((t, End.START))
        ends.setdefault(int(model.end_node[t]), []).append((t, End.FINISH))
    partners: dict[tuple[int, int], int] = {}
    for a, end_a, b, end_b in model.movements.tolist():
        for key in ((a, end_a), (b, end_b)):
            partners[key] = partners.get(key, 0) + 1
    found = []
    for node, members in ends.items():
        names = ", ".join(model.track_id[t] for t, _ in members)
        counts = [partners.get(member, 0) for member in members]
        where = f"node {model.nodes.id[node]} ({names})"
        if len(members) == 3 and sorted(counts) != [1, 1, 2]:
            found.append(
                Defect("impossible turnout", where, f"its three ends permit {counts} movements, a turnout 1, 1 and 2")
            )
        elif len(members) > 1 and 0 in counts:
            idle = ", ".join(model.track_id[t] for (t, _), c in zip(members, counts, strict=True) if c == 0)
            found.append(Defect("impossible turnout", where, f"no movement leads on from {idle}"))
        elif len(members) == 1 and model.nodes.kind[node] in (NodeKind.TURNOUT, NodeKind.CROSSING):
            found.append(Defect("impossible turnout", where, "a turnout or crossing where only one track ends"))
    return found


def _duplicates(model: TrackModel) -> list[Defect]:
    """Tracks that lie upon another track along their whole length."""
    found = []
    for t, name in enumerate(model.track_id):
        first, last = int(model.knot_start[t]), int(model.knot_start[t + 1])
        upon: set[str] | None = None
        for j in np.unique(np.linspace(first, last - 1, 9).astype(int)):
            near = {
                c.track
                for c in model.locate(float(model.easting[j]), float(model.northing[j]), within=DUPLICATE)
                if c.track != name
            }
            upon = near if upon is None else upon & near
            if not upon:
                break
        found += [Defect("duplicate", name, f"lies within {DUPLICATE} m of {other}") for other in sorted(upon or ())]
    return found


def _heights(model: TrackModel) -> list[Defect]:
    """Missing heights, where the model has heights elsewhere, or none at all."""
    counts = np.add.reduceat(np.isnan(model.height), model.knot_start[:-1])
    if counts.sum() == len(model.height):
        cause = "no track has heights; lengths are horizontal at height 0"
        return [Defect("missing heights", "model", cause, remark=True)]
    return [
        Defect(
            "missing heights",
            model.track_id[t],
            f"{int(c)} of {int(model.knot_start[t + 1] - model.knot_start[t])} knots",
        )
        for t, c in enumerate(counts)
        if c
    ]


def _parts(model: TrackModel) -> list[Defect]:
    """Parts of the network without connection: a remark, unless an end nearly meets a track of another part."""
    import networkx as nx

    network = nx.Graph()
    network.add_nodes_from(range(len(model.track_id)))
    network.add_edges_from((a, b) for a, _, b, _ in model.movements.tolist())
    parts = sorted(nx.connected_components(network), key=len, reverse=True)
    own = {t: k for k, part in enumerate(parts) for t in part}
    index = {track: i for i, track in enumerate(model.track_id)}
    found = []
    if len(parts) > 1:
        for t, name in enumerate(model.track_id):
            for end in (End.START, End.FINISH):
                i = _end_knot(model, t, end)
                near = model.locate(float(model.easting[i]), float(model.northing[i]), within=NEAR_MISS)
                for other in near:
                    if own[index[other.track]] != own[t] and _level(model, i, index[other.track], other.offset):
                        detail = f"lies {other.distance:.2f} m from {other.track} at {other.offset:.1f} m and does not join it"
                        found.append(Defect("missing joint", f"{name} {end.name.lower()}", detail))
                        break
    found += [
        Defect(
            "disconnected",
            ", ".join(model.track_id[t] for t in sorted(part)[:3]),
            f"{len(part)} track(s) apart from the rest",
            remark=True,
        )
        for part in parts[1:]
    ]
    return found


def _level(model: TrackModel, knot: int, track: int, offset: float) -> bool:
    """Whether a track is within 2 m of a knot's height; without heights, the plane decides."""
    rise = float(model.at(model.track_id[track], min(offset, float(model.lengths[track]))).height) - model.height[knot]
    return not abs(rise) > LEVEL


def _knots(model: TrackModel) -> list[Defect]:
    """Knots whose positions contradict their offsets."""
    step = np.diff(model.offset)
    plane = np.hypot(np.diff(model.easting), np.diff(model.northing)) / (0.5 * (model.scale[1:] + model.scale[:-1]))
    rise = np.nan_to_num(np.diff(model.height))
    bend = 0.25 * (model.curvature[1:] + model.curvature[:-1]) ** 2
    chord = step * (1.0 - bend * step**2 / 24.0)  # chord of an arc of the mean curvature
    wrong = np.abs(np.hypot(plane, rise) - chord)
    wrong[model.knot_start[1:-1] - 1] = 0.0
    found = []
    for t, name in enumerate(model.track_id):
        part = wrong[model.knot_start[t] : model.knot_start[t + 1] - 1]
        worst = int(np.argmax(part))
        if part[worst] > INCONSISTENT:
            at = float(model.offset[model.knot_start[t] + worst])
            found.append(
                Defect(
                    "inconsistent knots",
                    f"{name} at {at:.1f} m",
                    f"positions and offsets disagree by {part[worst] * 1e3:.1f} mm",
                )
            )
    return found
