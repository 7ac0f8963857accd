"""A model as railML 3.2 infrastructure: what `railnav.io.railml` reads, written.

Written are the topology at level Micro (a net element a track, a relation for every pair of ends that meet), positions where elements
begin, horizontal and gradient curves, switches, buffer stops, balises, lines and tracks with their linear positioning systems.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from railnav.io.atomic import atomic_path
from railnav.io.designed import DesignedAlignment, designed_tracks
from railnav.io.designs import profile_of_points
from railnav.track.elements import ARC, STRAIGHT, Gradients, integrate
from railnav.track.model import NodeKind, TrackModel

FloatArray = NDArray[np.float64]

#: What railML calls the kinds that a model's tracks are laid into.
_KIND = {STRAIGHT: "straight", ARC: "arc"}
_TRANSITION = "clothoide"
#: A switch's legs are told apart this far behind it, m.
_BESIDE = 15.0


def write_railml(model: TrackModel, path: str | Path, *, tolerance: float = 2e-4) -> None:
    """Write a model as railML 3.2 infrastructure, whole or not at all.

    Parameters
    ----------
    model : TrackModel
        What to write; its tracks are laid into straights, arcs and clothoids first (`railnav.io.designed.designed_tracks`).
    path : path
        File to write, .railml or .xml; replaced in one step if it exists.
    tolerance : float
        Greatest distance of the elements from the model's knots, m.

    Raises
    ------
    InputError
        The file cannot be written.

    Notes
    -----
    A transition states the radius of its sharper end and its deltaAzimuth, which together with the positions say all. Cant,
    covariance and provenance have no place in what is written. Identifiers of tracks stand in a designator of the register "railnav",
    since identifiers in XML may not begin with a digit.

    References
    ----------
    railML 3.2, infrastructure: netElement, netRelation, horizontalCurve (radius negative = left, 0 = straight), gradientCurve (per
    mille, radius negative = valley), switchIS.

    Examples
    --------
    >>> import tempfile
    >>> from railnav import demo_line
    >>> from railnav.io.railml import read_railml
    >>> model = demo_line()
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_railml(model, f"{folder}/line.railml")
    ...     again = read_railml(f"{folder}/line.railml")
    >>> len(again.movements) == len(model.movements)
    True
    """
    tracks = designed_tracks(model, tolerance=tolerance)
    with atomic_path(path) as draft, draft.open("w", encoding="utf-8", newline="\n") as file:
        for line in _document(model, tracks, Path(path).stem):
            file.write(line + "\n")


def _number(value: float, decimals: int = 6) -> str:
    text = f"{float(value):.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def _profiles(tracks: list[DesignedAlignment]) -> list[Gradients | None]:
    found: list[Gradients | None] = []
    for track in tracks:
        v = track.vertical
        found.append(None if v is None else profile_of_points(v.along, v.height, v.curve_length, v.radius))
    return found


def _document(model: TrackModel, tracks: list[DesignedAlignment], title: str) -> Iterator[str]:
    from railnav import __version__
    from railnav.io.container import _now

    lines = sorted({line for line in model.line if line})
    systems = {line: f"lps_{i + 1}" for i, line in enumerate(lines)}
    systems[""] = "lps_0"
    authority = model.frame.authority
    plane = ":".join(map(str, authority)) if authority else " ".join(model.frame.crs_wkt.split())
    profiles = _profiles(tracks)
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield (
        '<railML xmlns="https://www.railml.org/schemas/3.2" xmlns:dc="http://purl.org/dc/elements/1.1/" version="3.2">'
    )
    yield (
        f" <metadata><dc:title>{_text(title)}</dc:title><dc:date>{_now()}</dc:date>"
        f"<dc:source>railnav {__version__}</dc:source></metadata>"
    )
    yield ' <common id="co_1"><positioning>'
    yield (
        f'  <geometricPositioningSystems><geometricPositioningSystem id="gps_1" crsDefinition={quoteattr(plane)}>'
        f'<name name={quoteattr(model.frame.name)} language="en"/></geometricPositioningSystem></geometricPositioningSystems>'
    )
    yield "  <linearPositioningSystems>"
    posts = model.mileposts
    for line, system in sorted(systems.items(), key=lambda item: item[1]):
        own = [i for i, name in enumerate(model.line) if name == line]
        values = posts.chainage[np.isin(posts.track, own)]
        if len(values):
            yield (
                f'   <linearPositioningSystem id="{system}" linearReferencingMethod="absolute" units="m" '
                f'startMeasure="{_number(values.min(), 3)}" endMeasure="{_number(values.max(), 3)}">'
                f'<name name={quoteattr(line or "without a line")} language="en"/></linearPositioningSystem>'
            )
    yield "  </linearPositioningSystems>"
    yield " </positioning></common>"
    yield ' <infrastructure id="is_1">'
    relations = _relations(model)
    yield from _topology(model, tracks, profiles, systems, relations)
    yield from _geometry(tracks, profiles)
    yield from _functional(model, relations)
    yield " </infrastructure>"
    yield "</railML>"


def _text(text: str) -> str:
    from xml.sax.saxutils import escape

    return escape(text)


# --- topology ---------------------------------------------------------------------------------------------------------


def _relations(model: TrackModel) -> list[tuple[str, int, int, int, int, bool]]:
    """Id, track a, end a, track b, end b, navigable: one for every pair of ends that meet in a node or move."""
    permitted = {frozenset(((a, ea), (b, eb))) for a, ea, b, eb in model.movements.tolist()}
    ends: dict[int, list[tuple[int, int]]] = {}
    for t in range(len(model.track_id)):
        ends.setdefault(int(model.start_node[t]), []).append((t, 0))
        ends.setdefault(int(model.end_node[t]), []).append((t, 1))
    pairs = {frozenset((a, b)) for members in ends.values() for i, a in enumerate(members) for b in members[i + 1 :]}
    rows = sorted(tuple(sorted(pair)) for pair in pairs | permitted if len(pair) == 2)
    return [
        (f"nr_{i + 1}", a, ea, b, eb, frozenset(((a, ea), (b, eb))) in permitted)
        for i, ((a, ea), (b, eb)) in enumerate(rows)
    ]


def _topology(
    model: TrackModel,
    tracks: list[DesignedAlignment],
    profiles: list[Gradients | None],
    systems: dict[str, str],
    relations: list[tuple[str, int, int, int, int, bool]],
) -> Iterator[str]:
    of: dict[int, list[str]] = {}
    for name, a, _, b, _, _ in relations:
        of.setdefault(a, []).append(name)
        of.setdefault(b, []).append(name)
    yield "  <topology><netElements>"
    posts = model.mileposts
    for t, (track, profile) in enumerate(zip(tracks, profiles, strict=True)):
        length = float(model.lengths[t])
        yield f'   <netElement id="ne_{t + 1}" length="{_number(length, 4)}">'
        for name in of.get(t, []):
            yield f'    <relation ref="{name}"/>'
        yield f'    <associatedPositioningSystem id="aps_{t + 1}">'
        for i, (share, inner) in enumerate(_places(model, t, track, profile, posts, systems[model.line[t]])):
            yield f'     <intrinsicCoordinate id="ic_{t + 1}_{i + 1}" intrinsicCoord="{_number(share, 12)}">{inner}</intrinsicCoordinate>'
        yield "    </associatedPositioningSystem>"
        yield "   </netElement>"
    yield "  </netElements><netRelations>"
    for name, a, ea, b, eb, may in relations:
        yield (
            f'   <netRelation id="{name}" positionOnA="{ea}" positionOnB="{eb}" navigability="{"Both" if may else "None"}">'
            f'<elementA ref="ne_{a + 1}"/><elementB ref="ne_{b + 1}"/></netRelation>'
        )
    yield '  </netRelations><networks><network id="nw_1"><level id="lv_1" descriptionLevel="Micro">'
    for t in range(len(tracks)):
        yield f'   <networkResource ref="ne_{t + 1}"/>'
    for name, *_ in relations:
        yield f'   <networkResource ref="{name}"/>'
    yield "  </level></network></networks></topology>"


def _places(
    model: TrackModel, t: int, track: DesignedAlignment, profile: Gradients | None, posts: Any, system: str
) -> list[tuple[float, str]]:
    """Intrinsic coordinates in order, with positions where elements and vertical curves begin, and measures at posts."""
    plan = track.plan
    total = float(plan.edges[-1])
    breaks = np.empty(0) if profile is None else profile.begin[(profile.begin > 0.0) & (profile.begin < total)]
    along = np.unique(np.concatenate([plan.edges, breaks]))
    keep = np.append(np.diff(along) > 1e-7, True)
    along = along[keep]
    along[0], along[-1] = 0.0, total
    at, _ = integrate(plan, along)
    starts = np.column_stack([plan.easting, plan.northing])
    for i, edge in enumerate(plan.edges[:-1]):
        at[int(np.argmin(np.abs(along - edge)))] = starts[i]
    own = model.knots(model.track_id[t])
    at[-1] = (model.easting[own][-1], model.northing[own][-1])
    height = np.full(len(along), np.nan) if profile is None else profile(along, 0)
    rows: dict[float, str] = {}
    for share, (x, y), z in zip((along / total).tolist(), at.tolist(), height.tolist(), strict=True):
        z_ = "" if math.isnan(z) else f' z="{z:.5f}"'
        rows[share] = f'<geometricCoordinate positioningSystemRef="gps_1" x="{x:.6f}" y="{y:.6f}"{z_}/>'
    length = float(model.lengths[t])
    a, b = np.searchsorted(posts.track, [t, t + 1])
    for offset, chainage in zip(posts.offset[a:b].tolist(), posts.chainage[a:b].tolist(), strict=True):
        share = min(max(offset / length, 0.0), 1.0)
        mark = f'<linearCoordinate positioningSystemRef="{system}" measure="{_number(chainage, 4)}"/>'
        rows[share] = rows.get(share, "") + mark
    return sorted(rows.items())


# --- geometry ---------------------------------------------------------------------------------------------------------


def _geometry(tracks: list[DesignedAlignment], profiles: list[Gradients | None]) -> Iterator[str]:
    yield "  <geometry>"
    if any(profile is not None for profile in profiles):
        yield "   <gradientCurves>"
        for t, (track, profile) in enumerate(zip(tracks, profiles, strict=True)):
            if profile is not None:
                yield from _gradients(t, profile, float(track.plan.edges[-1]))
        yield "   </gradientCurves>"
    yield "   <horizontalCurves>"
    for t, track in enumerate(tracks):
        plan = track.plan
        total = float(plan.edges[-1])
        _, after = integrate(plan, plan.edges)
        for i, kind in enumerate(plan.kind.tolist()):
            k0, k1 = float(plan.curvature_start[i]), float(plan.curvature_end[i])
            sharp = k0 if abs(k0) >= abs(k1) else k1
            begin = float(plan.grid_bearing[i])
            change = math.degrees(float(after[i + 1]) - begin)
            bent = "" if kind == STRAIGHT else f' deltaAzimuth="{change:.12g}"'
            radius = 0.0 if sharp == 0.0 else 1.0 / sharp
            yield (
                f'    <horizontalCurve id="hc_{t + 1}_{i + 1}" curveType="{_KIND.get(kind, _TRANSITION)}" '
                f'azimuth="{math.degrees(begin) % 360.0:.12g}"{bent} radius="{radius:.12g}" length="{_number(plan.length[i], 7)}">'
                f"{_location(f'hc_{t + 1}_{i + 1}', t, plan.edges[i] / total, plan.edges[i + 1] / total)}</horizontalCurve>"
            )
    yield "   </horizontalCurves>"
    yield "  </geometry>"


def _gradients(t: int, profile: Gradients, total: float) -> Iterator[str]:
    borders = np.clip(np.append(profile.begin, np.inf), 0.0, total)
    count = 0
    for begin, end in zip(borders[:-1].tolist(), borders[1:].tolist(), strict=True):
        if end - begin < 1e-7:
            continue
        count += 1
        inside = np.array([begin, end]) + np.array([1e-9, -1e-9]) * (end - begin)
        g0, g1 = profile(inside, 1).tolist()
        change = g1 - g0
        straight = abs(change) < 1e-9
        radius = 0.0 if straight else -(end - begin) / change  # negative in a valley
        more = "" if straight else f' deltaGradient="{change * 1e3:.10g}" radius="{radius:.10g}"'
        yield (
            f'    <gradientCurve id="gc_{t + 1}_{count}" curveType="{"straight" if straight else "arc"}" '
            f'gradient="{g0 * 1e3:.10g}"{more} length="{_number(end - begin, 7)}">'
            f"{_location(f'gc_{t + 1}_{count}', t, begin / total, end / total)}</gradientCurve>"
        )


def _location(name: str, t: int, begin: float, end: float) -> str:
    return (
        f'<linearLocation id="{name}_l" applicationDirection="both"><associatedNetElement netElementRef="ne_{t + 1}" '
        f'keepsOrientation="true" intrinsicCoordBegin="{_number(begin, 12)}" intrinsicCoordEnd="{_number(end, 12)}"/></linearLocation>'
    )


# --- functional infrastructure ----------------------------------------------------------------------------------------


def _functional(model: TrackModel, relations: list[tuple[str, int, int, int, int, bool]]) -> Iterator[str]:
    ends: dict[int, list[tuple[int, int]]] = {}
    for t in range(len(model.track_id)):
        ends.setdefault(int(model.start_node[t]), []).append((t, 0))
        ends.setdefault(int(model.end_node[t]), []).append((t, 1))
    yield "  <functionalInfrastructure>"
    balises = model.provenance.get("balises", [])
    if isinstance(balises, list) and balises:
        yield "   <balises>"
        for i, balise in enumerate(balises):
            t = model.track_index(str(balise["track"]))
            share = float(balise["offset_m"]) / float(model.lengths[t])
            own = str(balise.get("id", ""))
            label = f'<designator register="railnav" entry={quoteattr(own)}/>' if own else ""
            yield (
                f'    <balise id="bal_{i + 1}"><name name={quoteattr(str(balise.get("name") or own))} language="en"/>'
                f"{_spot(f'bal_{i + 1}', t, share)}{label}</balise>"
            )
        yield "   </balises>"
    stops = [(n, ends[n][0]) for n in np.flatnonzero(model.nodes.kind == NodeKind.BUFFER_STOP).tolist() if n in ends]
    if stops:
        yield "   <bufferStops>"
        for n, (t, end) in stops:
            yield (
                f'    <bufferStop id="bs_{n + 1}"><name name={quoteattr(model.nodes.id[n])} language="en"/>'
                f"{_spot(f'bs_{n + 1}', t, float(end))}</bufferStop>"
            )
        yield "   </bufferStops>"
    lines = sorted({line for line in model.line if line})
    if lines:
        yield "   <lines>"
        for i, line in enumerate(lines):
            parts = "".join(
                f'<associatedNetElement netElementRef="ne_{t + 1}" keepsOrientation="true"/>'
                for t, name in enumerate(model.line)
                if name == line
            )
            yield (
                f'    <line id="line_{i + 1}"><name name={quoteattr(line)} language="en"/>'
                f'<linearLocation id="line_{i + 1}_l" applicationDirection="both">{parts}</linearLocation></line>'
            )
        yield "   </lines>"
    switches = [n for n, members in ends.items() if len(members) == 3]
    if switches:
        yield "   <switchesIS>"
        for n in sorted(switches):
            yield from _switch(model, n, ends[n], relations)
        yield "   </switchesIS>"
    yield "   <tracks>"
    for t, track in enumerate(model.track_id):
        name = f'<name name={quoteattr(model.name[t])} language="en"/>' if model.name[t] else ""
        yield (
            f'    <track id="trk_{t + 1}">{name}<linearLocation id="trk_{t + 1}_l" applicationDirection="both">'
            f'<associatedNetElement netElementRef="ne_{t + 1}" keepsOrientation="true"/></linearLocation>'
            f'<designator register="railnav" entry={quoteattr(track)}/>'
            f'<length value="{_number(float(model.lengths[t]), 3)}" type="physical"/></track>'
        )
    yield "   </tracks>"
    yield "  </functionalInfrastructure>"


def _spot(name: str, t: int, share: float) -> str:
    return f'<spotLocation id="{name}_s" netElementRef="ne_{t + 1}" applicationDirection="both" intrinsicCoord="{_number(share, 12)}"/>'


def _switch(
    model: TrackModel, n: int, members: list[tuple[int, int]], relations: list[tuple[str, int, int, int, int, bool]]
) -> Iterator[str]:
    """A turnout by its stem, with the relations to its left and right legs; nothing where the movements are none of a turnout."""
    lead = {
        end: [
            (name, (b, eb) if (a, ea) == end else (a, ea))
            for name, a, ea, b, eb, may in relations
            if may and end in ((a, ea), (b, eb))
        ]
        for end in members
    }
    stems = [end for end in members if len(lead[end]) == 2]
    if len(stems) != 1:
        return
    stem = stems[0]
    i = int(model.knot_start[stem[0] + 1] - 1 if stem[1] else model.knot_start[stem[0]])
    onward = float(model.grid_bearing[i]) + (0.0 if stem[1] else math.pi)
    across = []
    bend = []
    for _, (t, end) in lead[stem]:
        length = float(model.lengths[t])
        reach = min(_BESIDE, length)
        point = model.at(model.track_id[t], length - reach if end else reach)
        east, north = float(point.easting) - model.easting[i], float(point.northing) - model.northing[i]
        across.append(east * math.cos(onward) - north * math.sin(onward))
        bend.append(float(point.curvature) * (-1.0 if end else 1.0))
    left, right = (0, 1) if across[0] < across[1] else (1, 0)
    branch = left if abs(across[left]) > abs(across[right]) else right
    branches = "".join(
        f'<{tag} netRelationRef="{lead[stem][which][0]}" radius="{_number(0.0 if abs(bend[which]) < 1e-6 else 1.0 / bend[which], 3)}"/>'
        for tag, which in (("leftBranch", left), ("rightBranch", right))
    )
    courses = ("left", "right") if branch == left else ("right", "left")
    yield (
        f'    <switchIS id="sw_{n + 1}" type="ordinarySwitch" branchCourse="{courses[0]}" continueCourse="{courses[1]}">'
        f'<name name={quoteattr(model.nodes.id[n])} language="en"/>{_spot(f"sw_{n + 1}", stem[0], float(stem[1]))}{branches}</switchIS>'
    )
