"""Models gone stale, by name: tracks slewed or laid since the survey, frames mistaken. What the navigator owes is said as for faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from railnav.errors import InputError
from railnav.simulation.faults import Fault
from railnav.track.chainage import LineReferences
from railnav.track.model import TrackModel

_FOREVER = float("inf")

#: Every way in which a model is out of date, by name; see `model_with_fault`.
MODEL_FAULTS: dict[str, Fault] = {
    fault.name: fault
    for fault in (
        Fault("track-moved-1.5m", "the track was slewed by 1.5 m over 400 m since the survey", "model", "covered"),
        Fault("track-moved-4m", "the track was slewed by 4 m over 400 m since the survey", "model", "covered"),
        Fault("model-2m-east", "the whole model lies 2 m too far east", "model", "covered", _FOREVER, whole_run=True),
        Fault("model-9m-south", "the whole model lies 9 m too far south", "model", "flagged", _FOREVER, whole_run=True),
        Fault(
            "track-missing",
            "the model lacks the track that the train is on",
            "model",
            "flagged",
            _FOREVER,
            whole_run=True,
        ),
    )
}


def model_with_fault(model: TrackModel, name: str, track: str, *, start: float) -> TrackModel:
    """Put one named fault into a model.

    Parameters
    ----------
    model : TrackModel
        As the tracks lie; it stays as it is.
    name : str
        One of `MODEL_FAULTS`.
    track : str
        The track that was moved or is missing.
    start : float
        Offset at which a slew begins, m.

    Raises
    ------
    InputError
        An unknown fault.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> line = demo_line(spacing=50.0)
    >>> len(line.track_id) - len(model_with_fault(line, "track-missing", "77R-03", start=0.0).track_id)
    1
    """
    match name:
        case "track-moved-1.5m":
            return with_stale_track(model, track, start=start, length=400.0, slew=1.5)
        case "track-moved-4m":
            return with_stale_track(model, track, start=start, length=400.0, slew=4.0)
        case "model-2m-east":
            return with_shifted_model(model, east=2.0, north=0.0)
        case "model-9m-south":
            return with_shifted_model(model, east=0.0, north=-9.0)
        case "track-missing":
            return without_track(model, track)
    raise InputError(f"no fault {name!r} of a model; there are {', '.join(MODEL_FAULTS)}")


def with_stale_track(model: TrackModel, track: str, *, start: float, length: float, slew: float) -> TrackModel:
    """Give back the model as it was before a track was slewed: the run saw the track where `model` has it.

    The slew grows and fades as a raised cosine over the whole length; curvature, offset and length stay those of the sound model, as
    in a map that nobody brought up to date.

    Parameters
    ----------
    model : TrackModel
        As the track lies now.
    track : str
    start, length : float
        Offset at which the slew begins, and how far it reaches, m.
    slew : float
        Greatest displacement of the stale model, m, to the right as offset grows.

    Returns
    -------
    TrackModel

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> line = demo_line(spacing=20.0)
    >>> stale = with_stale_track(line, "77R-03", start=1000.0, length=400.0, slew=1.5)
    >>> float(np.hypot(stale.easting - line.easting, stale.northing - line.northing).max().round(1))
    1.5
    """
    knots = model.knots(track)
    offset, bearing = model.offset[knots], model.grid_bearing[knots]
    phase = 2.0 * np.pi * np.clip((offset - start) / length, 0.0, 1.0)
    size = slew * 0.5 * (1.0 - np.cos(phase))
    easting, northing, turned = model.easting.copy(), model.northing.copy(), model.grid_bearing.copy()
    easting[knots] += size * np.cos(bearing)
    northing[knots] -= size * np.sin(bearing)
    turned[knots] = np.mod(bearing + slew * np.pi / length * np.sin(phase), 2.0 * np.pi)
    return replace(model, easting=easting, northing=northing, grid_bearing=turned)


def without_track(model: TrackModel, track: str) -> TrackModel:
    """Give back the model without one of its tracks, as if it had been laid since; its mile posts and line kilometres go, too.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> line = demo_line(spacing=50.0)
    >>> len(line.track_id) - len(without_track(line, "77R-03").track_id)
    1
    """
    gone = model.track_index(track)
    kept = np.delete(np.arange(len(model.track_id)), gone)
    index = np.full(len(model.track_id), -1)
    index[kept] = np.arange(len(kept))
    knots = np.ones(len(model.offset), bool)
    knots[model.knots(track)] = False
    moves = model.movements[(model.movements[:, 0] != gone) & (model.movements[:, 2] != gone)].copy()
    moves[:, [0, 2]] = index[moves[:, [0, 2]]]
    posts = model.mileposts.track != gone
    numbers = kept.tolist()
    return replace(
        model,
        track_id=tuple(model.track_id[i] for i in numbers),
        line=tuple(model.line[i] for i in numbers),
        name=tuple(model.name[i] for i in numbers),
        start_node=model.start_node[kept],
        end_node=model.end_node[kept],
        offset=model.offset[knots],
        easting=model.easting[knots],
        northing=model.northing[knots],
        height=model.height[knots],
        grid_bearing=model.grid_bearing[knots],
        curvature=model.curvature[knots],
        gradient=model.gradient[knots],
        cant=model.cant[knots],
        scale=model.scale[knots],
        covariance_g=model.covariance_g[knots],
        knot_start=np.concatenate([[0], np.cumsum(np.diff(model.knot_start)[kept])]).astype(np.int64),
        movements=moves,
        mileposts=replace(
            model.mileposts,
            track=index[model.mileposts.track[posts]],
            offset=model.mileposts.offset[posts],
            chainage=model.mileposts.chainage[posts],
        ),
        references=LineReferences(),
        record_source=None,
    )


def with_shifted_model(model: TrackModel, *, east: float, north: float) -> TrackModel:
    """Give back the model as if its frame had been mistaken: every track displaced by the same metres.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> line = demo_line(spacing=50.0)
    >>> float((with_shifted_model(line, east=2.0, north=0.0).easting - line.easting).round(6).max())
    2.0
    """
    easting, northing = model.easting + east, model.northing + north
    return replace(model, easting=easting, northing=northing)
