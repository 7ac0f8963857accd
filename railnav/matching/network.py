"""A track model packed for the inner loops: knots in cache lines, permitted movements by track end."""

from __future__ import annotations

import numpy as np

from railnav.matching._kernels import Network
from railnav.track.model import NodeKind, TrackModel


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
    return Network(
        np.ascontiguousarray(knots),
        np.nan_to_num(np.sqrt(np.maximum(across, 0.0))),
        np.ascontiguousarray(model.knot_start, np.int64),
        np.ascontiguousarray(model.lengths, np.float64),
        np.append(0, np.cumsum(counts)).astype(np.int64),
        enter[order].astype(np.int64),
        (model.nodes.kind[np.column_stack([model.start_node, model.end_node]).ravel()] == NodeKind.BUFFER_STOP).astype(
            np.int64
        ),
    )
