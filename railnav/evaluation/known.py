"""Solutions with known errors: what an evaluation must find again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.navigation.solution import Mode, Solution
from railnav.track.model import TrackModel
from railnav.truth import Truth
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]


def truth_as_solution(
    truth: Truth,
    model: TrackModel,
    *,
    along: ArrayLike = 0.0,
    sigma: float = 1.0,
    protection_factor: float = 3.890591886413120,
    rows: Sequence[int] | NDArray[np.int64] | None = None,
) -> Solution:
    """Turn a truth into the solution of a navigator with the errors given.

    Parameters
    ----------
    truth : Truth
        Of a run on the model.
    model : TrackModel
    along : float or (m,) array
        Error along, m, ahead of the nose; the solution stays on its track and stops at its ends.
    sigma : float
        Stated sigma along, m.
    protection_factor : float
        Protection level over sigma; the default holds at a risk of 1e-4 (two-sided normal).
    rows : sequence of int, optional
        Rows of the truth to take; all by default.

    Returns
    -------
    Solution
        Mode tracking throughout.

    Examples
    --------
    >>> from railnav.simulation import Leg, demo_line, simulate
    >>> model = demo_line(spacing=20.0)
    >>> _, truth = simulate(model, Leg(("77R-01",), start=50.0, finish=700.0), seed=1)
    >>> solution = truth_as_solution(truth, model, along=2.0)
    >>> round(float(solution.offset[0] - truth.offset[0]), 3)
    2.0
    """
    pick = np.arange(len(truth)) if rows is None else np.asarray(rows, np.int64)
    track = truth.track[pick]
    index = np.array([model.track_index(name) for name in truth.track_id], np.int64)[track]
    bare = model.at(index, truth.offset[pick])
    sense = np.where(np.abs(wrap_angle(bare.heading - truth.heading[pick])) < 0.5 * np.pi, 1, -1)
    offset = truth.offset[pick] + sense * np.broadcast_to(np.asarray(along, float), len(pick))
    offset = np.clip(offset, 0.0, model.lengths[index])
    here = model.at(index, offset)
    latitude, longitude, height = model.frame.to_geodetic(here.easting, here.northing, here.height)
    one = np.ones(len(pick))
    return Solution(
        track_id=truth.track_id,
        line=tuple(model.line[model.track_index(name)] for name in truth.track_id),
        time=truth.time[pick],
        track=track,
        offset=offset,
        chainage=here.chainage,
        easting=here.easting,
        northing=here.northing,
        height=here.height,
        latitude=latitude,
        longitude=longitude,
        ellipsoidal_height=height,
        heading=np.mod(here.heading + np.where(sense > 0, 0.0, np.pi), 2.0 * np.pi),
        speed=truth.speed[pick],
        acceleration=np.gradient(truth.speed, truth.time)[pick] if len(truth) > 1 else 0.0 * one,
        sigma_along=sigma * one,
        sigma_cross=0.01 * one,
        protection_level_along=protection_factor * sigma * one,
        track_probability=one,
        mode=np.full(len(pick), Mode.TRACKING, np.int64),
        running_direction=sense.astype(np.int64),
        crs_wkt=model.frame.crs_wkt,
    )
