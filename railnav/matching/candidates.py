"""Where a train may stand: the tracks near a fix, each once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from railnav.matching._kernels import Network

if TYPE_CHECKING:
    from railnav.track.model import TrackModel

#: A foot point this close to a track's end may as well lie on the track beyond, m.
END_ZONE = 0.01


@dataclass(frozen=True, slots=True)
class Start:
    """A track a train may stand on: its index, offset of the foot point, distance from the fix in all and across the track, m."""

    track: int
    offset: float
    distance: float
    cross: float


def starting_candidates(
    model: TrackModel,
    network: Network,
    easting: float,
    northing: float,
    *,
    within: float,
    overhang: float = 10.0,
    at_most: int = 12,
) -> list[Start]:
    """Tracks on which a train seen at a grid position may stand, nearest first.

    A foot point at the very end of a track is left out when a track that a train reaches from there lies at least as near: both
    are one place.

    Parameters
    ----------
    model : TrackModel
    network : Network
        The same model, packed.
    easting, northing : float
        Where the train is seen, grid, m.
    within : float
        Greatest distance, m.
    overhang : float
        How far beyond the end of the model the train may seem to stand, m.
    at_most : int
        Greatest number of candidates.

    Returns
    -------
    list of Start
        Empty when no track is that near.
    """
    index = {track: i for i, track in enumerate(model.track_id)} if len(model.track_id) > 1000 else None
    found = [
        Start(index[c.track] if index else model.track_id.index(c.track), c.offset, c.distance, c.cross)
        for c in model.locate(easting, northing, within=within)
    ]
    found.sort(key=lambda c: (c.distance, c.track))
    nearest: dict[int, float] = {}
    for c in found:
        nearest[c.track] = min(c.distance, nearest.get(c.track, c.distance))
    kept = []
    for c in found:
        length = float(network.length[c.track])
        end = 0 if c.offset < END_ZONE else 1 if c.offset > length - END_ZONE else -1
        if end >= 0:
            e = 2 * c.track + end
            along = math.sqrt(max(c.distance**2 - c.cross**2, 0.0))
            beyond = network.move_to[network.move_start[e] : network.move_start[e + 1]].tolist()
            if not beyond and along > overhang:
                continue
            rivals = [(nearest[t // 2], t // 2) for t in beyond if t // 2 in nearest and t // 2 != c.track]
            if any(rival < (c.distance, c.track) or rival[0] < c.distance - 1e-6 for rival in rivals):
                continue
        kept.append(c)
    return kept[:at_most]
