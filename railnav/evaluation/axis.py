"""A model built from surveys beside the line it was surveyed on, and a truth carried over to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railnav.errors import OffModelError
from railnav.track.model import TrackModel
from railnav.truth import Truth

#: Knots between two places at which axes are compared.
EVERY = 20
#: A true axis further away than this is another one, m.
NEAR = 20.0
#: Way from a tunnel's mouth in which a receiver may not have found the satellites again, m.
MOUTH = 60.0


@dataclass(frozen=True, slots=True)
class AxisError:
    """How far built axes lie from the true ones, across, m; None where there is nothing to judge.

    Attributes
    ----------
    rms, max : float or None
        Under open sky.
    tunnel_max : float or None
        In the true model's tunnels (`provenance["tunnels"]`) and near their mouths.
    """

    rms: float | None
    max: float | None
    tunnel_max: float | None


def axis_error(model: TrackModel, reference: TrackModel) -> AxisError:
    """Measure the distance of a model's axes from those of the line it was surveyed on, every twentieth knot.

    Along a built track the true axis is followed: among those near, the one whose distance across changes least, so that a parallel
    track is not taken where an error grows.

    Parameters
    ----------
    model : TrackModel
        As built.
    reference : TrackModel
        As it is.

    Returns
    -------
    AxisError

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> axis_error(demo_line(spacing=10.0), demo_line(spacing=5.0)).rms < 1e-3
    True
    """
    latitude, longitude, _ = model.frame.to_geodetic(model.easting, model.northing)
    easting, northing, _ = reference.frame.to_grid(latitude, longitude)
    open_sky: list[float] = []
    tunnel: list[float] = []
    for track in model.track_id:
        knots = model.knots(track)
        before: float | None = None
        for k in range(knots.start, knots.stop, EVERY):
            near = reference.locate(float(easting[k]), float(northing[k]), within=NEAR)
            if not near:
                before = None
                continue
            last = before
            foot = min(near, key=lambda c: c.distance if last is None else abs(c.distance - last))
            before = foot.distance
            (tunnel if _covered(reference, foot.track, foot.offset) else open_sky).append(foot.distance)
    return AxisError(
        rms=float(np.sqrt(np.mean(np.square(open_sky)))) if open_sky else None,
        max=max(open_sky, default=None),
        tunnel_max=max(tunnel, default=None),
    )


def _covered(reference: TrackModel, track: str, offset: float) -> bool:
    return any(
        tunnel["track"] == track and tunnel["from_m"] - MOUTH <= offset <= tunnel["to_m"] + MOUTH
        for tunnel in reference.provenance.get("tunnels", [])
    )


def truth_on(model: TrackModel, truth: Truth) -> Truth:
    """Express a truth on a model built anew, whose track has another name: its foot points on the track the train ran on.

    That track is the one nearest to most of the true positions; true positions beyond its ends are left out.

    Parameters
    ----------
    model : TrackModel
    truth : Truth
        Of a run over one track of the model.

    Returns
    -------
    Truth

    Raises
    ------
    OffModelError
        The run never touches the model.

    Examples
    --------
    >>> from railnav.simulation import Leg, demo_line, simulate
    >>> line = demo_line(spacing=20.0)
    >>> _, truth = simulate(line, Leg(("77R-03",), start=100.0, finish=400.0), seed=1)
    >>> truth_on(line, truth).track_id
    ('77R-03',)
    """
    easting, northing, _ = model.frame.to_grid(truth.latitude, truth.longitude)
    near = [model.locate(float(e), float(n), within=NEAR) for e, n in zip(easting, northing, strict=True)]
    votes = [candidates[0].track for candidates in near if candidates]
    if not votes:
        raise OffModelError("the run never touches the model")
    track = max(set(votes), key=votes.count)
    feet = [next((c.offset for c in candidates if c.track == track), np.nan) for candidates in near]
    last = model.length(track)
    rows = np.flatnonzero([0.0 < foot < last for foot in feet])
    return Truth(
        track_id=(track,),
        time=truth.time[rows],
        track=np.zeros(len(rows), np.int64),
        offset=np.asarray(feet)[rows],
        speed=truth.speed[rows],
        latitude=truth.latitude[rows],
        longitude=truth.longitude[rows],
        height=truth.height[rows],
        heading=truth.heading[rows],
        simulated=truth.simulated,
    )
