"""A measured axis: points of one track in order, what is known of their noise, and the plane's scale."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError
from railnav.monitoring.fitting.surveyed import SurveyNoise, noise_of_model
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

#: Fewer points, or a shorter track, hold no elements.
LEAST_POINTS = 12
LEAST_LENGTH = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """Points of one track in order: arrays (n,).

    Attributes
    ----------
    track : str
        Identifier.
    easting, northing : (n,) array
        Plane, m.
    along : (n,) array
        Length in the plane from the first point, m.
    height : (n,) array or None
        m.
    cant : (n,) array or None
        Positive with the left rail high, m.
    stated : (n, 2) array or None
        Stated sigmas across the track and of the height, m.
    scale : float
        Grid metres per metre on the ground, mean of the track.
    start : float
        Station of the first point, m.
    crs : str
        The plane.
    surveyed, surveyed_height : SurveyNoise or None
        How the points err across the track and in height, where the records of a survey say so.
    """

    track: str
    easting: FloatArray
    northing: FloatArray
    along: FloatArray
    height: FloatArray | None = None
    cant: FloatArray | None = None
    stated: FloatArray | None = None
    scale: float = 1.0
    start: float = 0.0
    crs: str = ""
    surveyed: SurveyNoise | None = None
    surveyed_height: SurveyNoise | None = None


def axis_of_points(
    track: str,
    easting: ArrayLike,
    northing: ArrayLike,
    height: ArrayLike | None = None,
    *,
    cant: ArrayLike | None = None,
    stated: FloatArray | None = None,
    scale: float = 1.0,
    start: float = 0.0,
    crs: str = "",
) -> Axis:
    """Axis of points in the order of running.

    Raises
    ------
    TrackError
        Too few points, a track too short, values that are not finite, arrays that differ in length, or points that turn back.

    Examples
    --------
    >>> import numpy as np
    >>> s = np.arange(0.0, 100.0)
    >>> float(axis_of_points("1", 0.0 * s, s).along[-1])
    99.0
    """
    east, north = np.asarray(easting, np.float64), np.asarray(northing, np.float64)
    level = None if height is None else np.asarray(height, np.float64)
    roll = None if cant is None else np.asarray(cant, np.float64)
    for what, values in (("eastings", east), ("northings", north), ("heights", level), ("cants", roll)):
        if values is None:
            continue
        if values.shape != east.shape or values.ndim != 1:
            raise TrackError(f"track {track!r}: {values.size} {what} for {east.size} points")
        if not np.isfinite(values).all():
            raise TrackError(
                f"track {track!r}: point {int(np.argmin(np.isfinite(values))) + 1} of the {what} is not finite"
            )
    step = np.hypot(np.diff(east), np.diff(north))
    keep = np.append(True, step > 1e-3)
    if not keep.all():
        return axis_of_points(
            track,
            east[keep],
            north[keep],
            None if level is None else level[keep],
            cant=None if roll is None else roll[keep],
            stated=None if stated is None else stated[keep],
            scale=scale,
            start=start,
            crs=crs,
        )
    if len(east) < LEAST_POINTS or step.sum() < LEAST_LENGTH:
        raise TrackError(
            f"track {track!r} is too short to find elements in: {len(east)} points over {step.sum():.1f} m; "
            f"at least {LEAST_POINTS} points over {LEAST_LENGTH:.0f} m would do"
        )
    bearing = np.arctan2(np.diff(east), np.diff(north))
    turn = np.abs((np.diff(bearing) + np.pi) % (2.0 * np.pi) - np.pi)
    back = np.flatnonzero(turn > np.radians(120.0))
    if len(back) > 0.02 * len(east) + 2:
        raise TrackError(
            f"track {track!r} turns back {len(back)} times, first at point {int(back[0]) + 2}; its noise is larger than the distance "
            "of its points: smooth or thin them"
        )
    if len(back):
        i = int(back[0]) + 1
        gone = np.ones(len(east), bool)
        gone[i] = False
        if len(back) <= 2 and step[i - 1] > 5.0 * np.median(step):
            raise TrackError(f"track {track!r}: point {i + 1} lies {step[i - 1]:.1f} m from the one before; remove it")
    half = np.append(0.0, np.diff(np.unwrap(bearing)))
    arc = step / np.sinc(np.clip(half, -0.5, 0.5) / (2.0 * np.pi)) if _smooth(half) else step
    return Axis(track, east, north, np.append(0.0, np.cumsum(arc)), level, roll, stated, scale, start, crs)


def _smooth(turn: FloatArray) -> bool:
    """Whether the points turn evenly: then chords are arcs, and not noise."""
    if len(turn) < 6:
        return False
    return bool(np.median(np.abs(np.diff(turn, 2))) < 0.1 * np.median(np.abs(turn)) + 1e-12)


def axis_of_model(model: TrackModel, track: str) -> Axis:
    """Axis of a track of a model: its knots, how they err, and the plane's mean scale.

    Raises
    ------
    TrackError
        No such track, or one too short.
    """
    own = model.knots(track)
    index = model.track_index(track)
    height = model.height[own]
    cant = model.cant[own]
    cov = model.covariance_g[own]
    bearing = model.grid_bearing[own]
    stated: FloatArray | None = None
    if np.isfinite(cov).all():
        sin, cos = np.sin(bearing), np.cos(bearing)
        across = cov[:, 0] * cos**2 - 2.0 * cov[:, 1] * sin * cos + cov[:, 3] * sin**2
        stated = np.sqrt(np.maximum(np.column_stack([across, cov[:, 5]]), 0.0))
    chainage = model.chainage(np.array([index]), model.offset[own][:1])
    start = float(chainage[0])
    axis = axis_of_points(
        track,
        model.easting[own],
        model.northing[own],
        height if np.isfinite(height).all() else None,
        cant=cant if np.isfinite(cant).all() and np.ptp(cant) > 0.0 else None,
        stated=stated,
        scale=float(np.mean(model.scale[own])),
        start=start if np.isfinite(start) else 0.0,
        crs=model.frame.crs_wkt,
    )
    across, up = noise_of_model(model, track)
    return replace(axis, surveyed=across, surveyed_height=up)
