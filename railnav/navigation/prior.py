"""What a built model says before the first fix: where a kind of receiver stands, and which way a track is usually run.

A model built from survey runs carries its report in `provenance["build"]` (see `railnav.survey`). Receivers differ in frame by metres, as
much as tracks lie apart: a run of a kind that the survey knows is moved by what the survey found; of any other kind only the datum's
own uncertainty is known. On double track each track is usually run one way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.track.model import TrackModel

IntArray = NDArray[np.int64]

#: Prior probability that a train runs a one-way track the usual way; trains do run on the other track at times.
USUAL = 0.95
#: Tracks of one line lie this near to each other, m.
BESIDE = 150.0


@dataclass(frozen=True, slots=True)
class FramePrior:
    """The constant part of a run's GNSS error as the model's survey knows it.

    Attributes
    ----------
    east, north : float
        What this kind of receiver reads too far east and north of the model's datum, m.
    sigma : float
        Standard deviation of what is left of a run's constant part, each axis, m.
    known : bool
        Whether the survey had receivers of this kind.
    """

    east: float = 0.0
    north: float = 0.0
    sigma: float = 0.0
    known: bool = False


def frame_prior(model: TrackModel, receiver: str) -> FramePrior:
    """Look a kind of receiver up in the report of the model's survey.

    Parameters
    ----------
    model : TrackModel
    receiver : str
        As run.toml names it; may be empty.

    Returns
    -------
    FramePrior
        For a kind that the survey knows: its offset, and how its runs scatter about it. For another kind: no offset, and the
        uncertainty of the datum. For a model that was not built from runs: nothing.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> frame_prior(demo_line(), "ublox")
    FramePrior(east=0.0, north=0.0, sigma=0.0, known=False)
    """
    report = model.provenance.get("build")
    if not isinstance(report, dict):
        return FramePrior()
    for entry in report.get("receivers", []):
        if receiver and entry.get("receiver") == receiver:
            east, north = float(entry["offset_east_m"]), float(entry["offset_north_m"])
            scatter, sigma = float(entry["scatter_m"]), math.hypot(entry["sigma_east_m"], entry["sigma_north_m"])
            return FramePrior(east, north, math.hypot(scatter, sigma / math.sqrt(2.0)), True)
    datum = report.get("datum", {})
    east, north = (datum.get(f"sigma_{axis}_m") or 0.0 for axis in ("east", "north"))
    return FramePrior(sigma=math.hypot(east, north) / math.sqrt(2.0))


def usual_directions(model: TrackModel) -> IntArray:
    """Usual running direction of each track, +1 to growing offset, 0 where nothing is known.

    Where the runs of a built model's track name one direction and the model has another track for another direction, that is the way
    the track is usually run. Which way that is the report says ("sense" of a run); in a report that does not, the first run of
    tracks that lie side by side ran to growing offset, and runs of another direction the other way.

    Parameters
    ----------
    model : TrackModel

    Returns
    -------
    (t,) int array
    """
    tracks = len(model.track_id)
    usual = np.zeros(tracks, np.int64)
    report = model.provenance.get("build")
    if not isinstance(report, dict):
        return usual
    runs = report.get("runs", [])
    named: dict[str, set[str]] = {}
    first: dict[str, int] = {}
    sense: dict[str, int] = {}
    for i, run in enumerate(runs):
        for track in run.get("tracks", []):
            named.setdefault(track, set()).add(run.get("direction", ""))
            first.setdefault(track, i)
            sense.setdefault(track, int(run.get("sense", 0)))
    ways = [next(iter(named[t])) if len(named.get(t, ())) == 1 else "" for t in model.track_id]
    if len({w for w in ways if w}) < 2:
        return usual
    order = sorted((t for t in range(tracks) if ways[t]), key=lambda t: first[model.track_id[t]])
    leaders: list[int] = []
    for t in order:
        name = model.track_id[t]
        if sense[name] != 0:
            usual[t] = sense[name]
            continue
        leader, along = next(((k, a) for k in leaders if (a := _side_by_side(model, t, k)) != 0), (-1, 0))
        if leader < 0:
            leaders.append(t)
            usual[t] = 1
        else:
            usual[t] = along if ways[t] == ways[leader] else -along
    return usual


def _side_by_side(model: TrackModel, a: int, b: int) -> int:
    """Whether a track's middle lies beside another track: +1 where their offsets grow the same way, -1 opposite, 0 where it does not."""
    middle = int(model.knot_start[a] + model.knot_start[a + 1]) // 2
    beside = slice(int(model.knot_start[b]), int(model.knot_start[b + 1]))
    distance = np.hypot(model.easting[beside] - model.easting[middle], model.northing[beside] - model.northing[middle])
    nearest = int(np.argmin(distance))
    if float(distance[nearest]) > BESIDE:
        return 0
    turned = float(np.cos(model.grid_bearing[beside][nearest] - model.grid_bearing[middle]))
    return 1 if turned > 0.0 else -1
