"""Truth: where a train really was, from a simulation or a reference system."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The reference point on the track centre line along time; (m,) arrays, SI and radians.

    Attributes
    ----------
    track_id : tuple of str
        Track identifiers; `track` indexes them.
    time : (m,) array
        Seconds since the run's start, strictly increasing.
    track : (m,) int array
        Index into `track_id`.
    offset : (m,) array
        True offset from that track's start, m.
    speed : (m,) array
        Signed along the vehicle's nose, m/s.
    latitude, longitude, height : (m,) array
        WGS 84, rad and ellipsoidal m.
    heading : (m,) array
        Where the nose points, from true north, rad.
    simulated : bool
        Whether this truth comes from a simulation.
    """

    track_id: tuple[str, ...]
    time: FloatArray
    track: IntArray
    offset: FloatArray
    speed: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    height: FloatArray
    heading: FloatArray
    simulated: bool = False

    def __len__(self) -> int:
        return len(self.time)
