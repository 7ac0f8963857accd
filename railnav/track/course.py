"""The course of a line as one sequence of places: what a corridor plane is fitted to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]


def course(model: TrackModel, *, spacing: float = 1000.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places along all tracks of a model in the order of its longest direction.

    Parameters
    ----------
    model : TrackModel
        A line, of any number of tracks beside each other.
    spacing : float
        Length of a piece along the longest direction that becomes one place, m; shortened for a short model.

    Returns
    -------
    latitude, longitude, height : (n,) array
        WGS 84, rad, rad, m (NaN where the knot has no height): of each piece the knot nearest to the middle of them all.

    Examples
    --------
    >>> import railnav
    >>> latitude, _, height = course(railnav.demo_line())
    >>> len(latitude) > 10, bool(np.isfinite(height).all())
    (True, True)
    """
    xy = np.column_stack([model.easting, model.northing])
    centre = xy.mean(axis=0)
    _, _, rows = np.linalg.svd(np.cov((xy - centre).T))
    along = (xy - centre) @ rows[0]
    if along[int(model.knot_start[1]) - 1] < along[0]:
        along = -along
    reach = float(np.ptp(along))
    piece = np.minimum((along - along.min()) / min(spacing, max(reach / 10.0, 1.0)), 1e9).astype(np.int64)
    order, where = np.unique(piece, return_inverse=True)
    count = np.bincount(where)
    middle = np.column_stack([np.bincount(where, weights=v) / count for v in xy.T])
    away = np.hypot(*(xy - middle[where]).T)
    first = np.searchsorted(where, np.arange(len(order)), sorter=(nearest := np.lexsort((away, where))))
    chosen = nearest[first]
    return model.frame.to_geodetic(model.easting[chosen], model.northing[chosen], model.height[chosen])
