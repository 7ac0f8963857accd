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

    The runs of a track of a built model all ran to growing offset; where they name one direction and the model has another track for
    another direction, that is the way the track is usually run.

    Parameters
    ----------
    model : TrackModel

    Returns
    -------
    (t,) int array
    """
    usual = np.zeros(len(model.track_id), np.int64)
    report = model.provenance.get("build")
    if not isinstance(report, dict):
        return usual
    named: dict[str, set[str]] = {}
    for run in report.get("runs", []):
        for track in run.get("tracks", []):
            named.setdefault(track, set()).add(run.get("direction", ""))
    ways = [next(iter(named[t])) if len(named.get(t, ())) == 1 else "" for t in model.track_id]
    if len({w for w in ways if w}) > 1:
        usual[[bool(w) for w in ways]] = 1
    return usual
