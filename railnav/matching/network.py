"""A track model packed for the inner loops: knots in cache lines, permitted movements by track end."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from railnav.matching._kernels import Network
from railnav.track.model import NodeKind, TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def pack_network(model: TrackModel) -> Network:
    """Pack a model's tracks and permitted movements as the kernels read them.

    Parameters
    ----------
    model : TrackModel

    Returns
    -------
    Network
        `knots` (k, 8): offset from the track's start, easting, northing, their derivatives (grid metres per metre of offset),
        curvature, gradient, cant; SI. `sigma_cross` (k,) is the model's standard deviation across the track, 0 where it states none.
        Movements by track end, 2 * track + end, as a CSR list of the track ends entered.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> pack_network(demo_line()).knots.shape[1]
    8
    """
    first = model.knot_start[:-1]
    start = np.repeat(model.offset[first], np.diff(model.knot_start))
    rate = model.scale / np.sqrt(1.0 + model.gradient**2)
    knots = np.column_stack(
        [
            model.offset - start,
            model.easting,
            model.northing,
            rate * np.sin(model.grid_bearing),
            rate * np.cos(model.grid_bearing),
            model.curvature,
            model.gradient,
            model.cant,
        ]
    )
    cos, sin = np.cos(model.grid_bearing), np.sin(model.grid_bearing)
    ee, en, nn = (model.covariance_g[:, i] for i in (0, 1, 3))
    across = ee * cos**2 - 2.0 * en * sin * cos + nn * sin**2
    a = 2 * model.movements[:, 0] + model.movements[:, 1]
    b = 2 * model.movements[:, 2] + model.movements[:, 3]
    leave, enter = np.concatenate([a, b]), np.concatenate([b, a])
    order = np.argsort(leave, kind="stable")
    counts = np.bincount(leave, minlength=2 * len(model.track_id))
    balise_start, balise = _balises(model)
    return Network(
        np.ascontiguousarray(knots),
        np.nan_to_num(np.sqrt(np.maximum(across, 0.0))),
        np.zeros(len(knots)),
        np.ascontiguousarray(model.knot_start, np.int64),
        np.ascontiguousarray(model.lengths, np.float64),
        np.append(0, np.cumsum(counts)).astype(np.int64),
        enter[order].astype(np.int64),
        (model.nodes.kind[np.column_stack([model.start_node, model.end_node]).ravel()] == NodeKind.BUFFER_STOP).astype(
            np.int64
        ),
        balise_start,
        balise,
    )


def balises_of(model: TrackModel) -> dict[str, tuple[int, float]]:
    """Where the model's balises lie, by identifier and by name: track index and offset from the track's start, m.

    They stand in `provenance["balises"]`, a list of objects with `track`, `offset_m` and `id` or `name`, as the import from railML
    writes it; entries of other tracks are left out.
    """
    found: dict[str, tuple[int, float]] = {}
    entries = model.provenance.get("balises", [])
    if not isinstance(entries, list):
        return found
    index = {track: i for i, track in enumerate(model.track_id)}
    for entry in entries:
        track = index.get(str(entry.get("track", "")))
        if track is None:
            continue
        first = float(model.offset[model.knot_start[track]])
        for name in (entry.get("name"), entry.get("id")):
            if name:
                found[str(name)] = (track, float(entry["offset_m"]) - first)
    return found


def _balises(model: TrackModel) -> tuple[IntArray, FloatArray]:
    """The model's balises by track: CSR pointer and offsets."""
    places = sorted(set(balises_of(model).values()))
    track = np.array([t for t, _ in places], np.int64)
    start = np.searchsorted(track, np.arange(len(model.track_id) + 1)).astype(np.int64)
    return start, np.array([offset for _, offset in places], np.float64)
