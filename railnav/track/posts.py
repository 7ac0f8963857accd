"""Line references from what lies on tracks: mile posts, places on both sides of a track without one, tables of kilometres."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError
from railnav.track.chainage import LineReference, LineReferences, along_anchors

if TYPE_CHECKING:
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]


def references_from_posts(model: TrackModel) -> LineReferences:
    """Line references from the posts of a model: stretched kilometres, each as long as the tracks measure it.

    Parameters
    ----------
    model : TrackModel
        With mile posts; posts of tracks without a line's name belong to the line "".

    Returns
    -------
    LineReferences
        Positions are the published chainage in metres and every kilometre counts 1000: where tracks beside each other differ in
        length both keep their posts. A track whose posts contradict themselves (neither growing nor falling) is left out.

    Examples
    --------
    >>> import railnav
    >>> model = railnav.demo_line()
    >>> references = references_from_posts(model)
    >>> len(references) > 0
    True
    """
    posts = model.mileposts
    names = list(dict.fromkeys(model.line[i] for i in posts.track.tolist()))
    kept: list[tuple[int, int, FloatArray, FloatArray]] = []
    for i in np.unique(posts.track).tolist():
        here = slice(*np.searchsorted(posts.track, [i, i + 1]))
        x, y = posts.offset[here], posts.chainage[here]
        step = np.diff(y)
        if len(x) and (np.diff(x) > 0).all() and ((step > 0).all() or (step < 0).all()):
            kept.append((i, names.index(model.line[i]), x, y))
    lines: list[LineReference] = []
    place: dict[int, int] = {}
    for number, name in enumerate(names):
        own = [(x, y) for _, line, x, y in kept if line == number]
        if not own:
            continue
        low, high = min(float(y.min()) for _, y in own), max(float(y.max()) for _, y in own)
        first, last = int(np.floor(low / 1000.0)), max(int(np.ceil(high / 1000.0)), int(np.floor(low / 1000.0)) + 1)
        label = np.arange(first, last)
        place[number] = len(lines)
        lines.append(
            LineReference(
                name, label, 1000.0 * np.arange(first, last + 1, dtype=np.float64), np.full(len(label), 1000.0)
            )
        )
    rows = [(i, place[line], x, y) for i, line, x, y in kept if line in place]
    if not rows:
        return LineReferences(tuple(lines))
    return LineReferences(
        tuple(lines),
        np.concatenate([np.full(len(x), i) for i, _, x, _ in rows]).astype(np.int64),
        np.concatenate([np.full(len(x), line) for _, line, x, _ in rows]).astype(np.int64),
        np.concatenate([x for *_, x, _ in rows]),
        np.concatenate([y for *_, y in rows]),
    )


#: A way between two known places may differ in length from what the line says by this share, and this much, m.
_AGREEMENT = (0.02, 10.0)
#: Ways are looked for between at most this many known places of one connected piece without posts.
_MOST_PLACES = 12


def spread_references(model: TrackModel, references: LineReferences) -> LineReferences:
    """Carry line references over tracks of a line that have no post of their own, from places on both sides that have.

    Parameters
    ----------
    model : TrackModel
        Whose tracks name their lines.
    references : LineReferences
        Known so far, for instance by `references_from_posts`.

    Returns
    -------
    LineReferences
        With two anchors more for each track that lies on a way between two known places, where the way's length agrees with what
        the line says within 2 % or 10 m. A track that leads nowhere known, or that disagrees, stays without.

    Examples
    --------
    >>> import railnav
    >>> model = railnav.demo_line()
    >>> references = references_from_posts(model)
    >>> len(spread_references(model, references).track) >= len(references.track)
    True
    """
    import networkx as nx

    lengths = model.lengths
    anchored: dict[int, set[int]] = {k: set() for k in range(len(references.lines))}
    known: list[dict[int, list[float]]] = [{} for _ in references.lines]
    for track, line, here in references.stretches():
        anchored[line].add(track)
        x, y = references.offset[here], references.position[here]
        s = along_anchors(x, y, np.array([0.0, lengths[track]]))
        for node, value in zip((int(model.start_node[track]), int(model.end_node[track])), s.tolist(), strict=True):
            known[line].setdefault(node, []).append(value)
    found: list[tuple[int, int, float, float]] = []
    for line, reference in enumerate(references.lines):
        free = nx.MultiGraph()
        for track, name in enumerate(model.line):
            if name and name == reference.line and track not in anchored[line]:
                ends = int(model.start_node[track]), int(model.end_node[track])
                free.add_edge(*ends, key=track, weight=float(lengths[track]))
        place = {
            node: float(np.mean(values)) for node, values in known[line].items() if np.ptp(values) <= _AGREEMENT[1]
        }  # a node where tracks contradict each other is no place to start from
        taken: set[int] = set()
        for piece in nx.connected_components(free):
            places = sorted((node for node in piece if node in place), key=lambda node: place[node])
            if len(places) > _MOST_PLACES:
                pairs = list(itertools.pairwise(places))
            else:
                pairs = sorted(itertools.combinations(places, 2), key=lambda ends: place[ends[1]] - place[ends[0]])
            for a, b in pairs:
                try:
                    way = nx.shortest_path(free, a, b, weight="weight")
                except nx.NetworkXNoPath:  # pragma: no cover - one piece
                    continue
                steps = [
                    min(free[u][v].items(), key=lambda edge: edge[1]["weight"]) for u, v in itertools.pairwise(way)
                ]
                length, said = sum(edge["weight"] for _, edge in steps), place[b] - place[a]
                if said <= 0.0 or abs(length - said) > max(_AGREEMENT[0] * length, _AGREEMENT[1]):
                    continue
                at = place[a]
                for (track, edge), u in zip(steps, way[:-1], strict=True):
                    after = at + edge["weight"] * said / length
                    if track not in taken:
                        taken.add(track)
                        first = int(model.start_node[track]) == u
                        found += [
                            (track, line, 0.0, at if first else after),
                            (track, line, edge["weight"], after if first else at),
                        ]
                    at = after
    if not found:
        return references
    old = zip(
        references.track.tolist(),
        references.line.tolist(),
        references.offset.tolist(),
        references.position.tolist(),
        strict=True,
    )
    track_, line_, offset, position = zip(*sorted([*old, *found]), strict=True)
    return LineReferences(
        references.lines,
        np.array(track_, np.int64),
        np.array(line_, np.int64),
        np.array(offset, np.float64),
        np.array(position, np.float64),
    )


def with_kilometres(references: LineReferences, tables: Sequence[LineReference]) -> LineReferences:
    """Give lines the kilometres of a table in place of those that posts suggest; anchors keep their published address.

    Parameters
    ----------
    references : LineReferences
        With anchors on tracks, as `references_from_posts` makes them.
    tables : sequence of LineReference
        Lines by name; a single one without a name is that of the only line.

    Returns
    -------
    LineReferences
        Each anchor's address under the old kilometres has the position that the new ones give it.

    Raises
    ------
    TrackError
        A line that has no anchor, or an address that the table does not have.
    """
    names = [line.line for line in references.lines]
    lines, position = list(references.lines), references.position.copy()
    for table in tables:
        name = names[0] if not table.line and len(names) == 1 else table.line
        if name not in names:
            raise TrackError(
                f"no posts of line {name!r}; there are posts of {', '.join(map(repr, names)) or 'no line'}"
            )
        number = names.index(name)
        here = references.line == number
        label, metre = references.lines[number].addresses(references.position[here])
        try:
            position[here] = table.positions(label, metre)
        except TrackError as error:
            raise TrackError(f"a post of line {name!r} has no place in the table: {error}") from error
        lines[number] = LineReference(name, table.label.copy(), table.start.copy(), table.counted.copy(), table.unit)
    return LineReferences(
        tuple(lines), references.track.copy(), references.line.copy(), references.offset.copy(), position
    )
