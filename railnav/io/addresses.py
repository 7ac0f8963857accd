"""Published addresses of places on tracks, as a column of a table: 53+1054.0 where one number of kilometres would name two places."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from railnav.io.tables import Words
from railnav.track.chainage import ChainageAddress, along_anchors
from railnav.track.chainage_notation import format_chainage
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]


def addresses(model: TrackModel, track: NDArray[np.int64], offset: FloatArray) -> Words | None:
    """Write the address of each place on the first of the model's lines that runs over it.

    Parameters
    ----------
    model : TrackModel
    track : (n,) int array
    offset : (n,) array
        m.

    Returns
    -------
    Words or None
        German notation with decimetres, empty where no line runs; None where the model has no line references.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> addresses(demo_line(spacing=50.0), np.array([0]), np.array([10.0])) is None
    True
    """
    references = model.references
    if not len(references):
        return None
    out = [""] * len(track)
    for i, line, here in references.stretches():
        rows = [k for k in np.flatnonzero(track == i).tolist() if not out[k]]
        if not rows:
            continue
        at = along_anchors(references.offset[here], references.position[here], offset[rows])
        label, metre = references.lines[line].addresses(at)
        for k, kilometre, metres in zip(rows, label.tolist(), metre.tolist(), strict=True):
            if metres >= 0.0:
                out[k] = format_chainage(ChainageAddress(int(kilometre), float(metres)), decimals=1)
    return Words.of(out)
