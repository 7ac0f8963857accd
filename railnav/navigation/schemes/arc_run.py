"""A run on a model by the corrector of a few numbers, as a `Solution`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from railnav.errors import OffModelError
from railnav.navigation.epochs import epochs
from railnav.navigation.schemes.arc import ArcGains, ArcNavigator
from railnav.navigation.solution import Mode, Solution
from railnav.run import Progress, Run

if TYPE_CHECKING:
    from railnav.track.model import TrackModel


def navigate_arc(
    run: Run,
    model: TrackModel,
    *,
    integrity_risk: float = 1e-4,
    gains: ArcGains | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Place a run on a model with the corrector of a few numbers: `ArcNavigator` epoch by epoch.

    Parameters
    ----------
    run : Run
        With a GNSS stream; odometer and IMU are used where they are there.
    model : TrackModel
        The reference model.
    integrity_risk : float, optional
        Risk, per row, of the protection level.
    gains : ArcGains, optional
    progress : Progress, optional
        Called with a label, rows done and rows in all.

    Returns
    -------
    Solution
        As `navigate` gives it; `sigma_cross` is 0.5 m or the model's root mean square.

    Raises
    ------
    RunError
        The run has no GNSS fix.
    OffModelError
        No fix of the moving train comes near the model.

    Examples
    --------
    >>> callable(navigate_arc)
    True
    """
    gnss, odometer = run.gnss, run.odometer
    reads = "" if odometer is None or len(odometer) == 0 else "speed" if odometer.distance is None else "distance"
    table = list(epochs(run))
    assert gnss is not None
    navigator = ArcNavigator(
        model,
        odometer=reads,
        lever_arm_b=gnss.lever_arm_b,
        receiver=gnss.receiver,
        integrity_risk=integrity_risk,
        gains=gains,
    )
    m = len(table)
    rows = np.full((m, 7), np.nan)
    track, mode, way = np.full(m, -1, np.int64), np.zeros(m, np.int64), np.zeros(m, np.int64)
    index = {name: i for i, name in enumerate(model.track_id)}
    for i, epoch in enumerate(table):
        p = navigator.step(epoch)
        mode[i] = int(p.mode)
        if p.track is not None:
            track[i], way[i] = index[p.track], p.running_direction
        rows[i] = (
            p.time,
            p.offset,
            p.speed,
            p.acceleration,
            p.sigma_along,
            p.protection_level_along,
            p.track_probability,
        )
        if progress is not None and (i + 1) % 2000 == 0:
            progress("navigate", i + 1, m)
    if progress is not None:
        progress("navigate", m, m)
    there = np.flatnonzero(track >= 0)
    if len(there) == 0:
        raise OffModelError(
            f"run {run.id!r} is never near the model while it moves: is it the right model, and does the train move faster than 2 m/s?"
        )
    point = model.at(track[there], rows[there, 1])
    latitude, longitude, ellipsoidal = model.frame.to_geodetic(point.easting, point.northing, point.height)
    nose = np.where(way[there] > 0, 0.0, math.pi)
    columns = {
        name: np.full(m, np.nan) for name in ("e", "n", "h", "lat", "lon", "ell", "heading", "chainage", "cross")
    }
    for name, value in (
        ("e", point.easting),
        ("n", point.northing),
        ("h", point.height),
        ("lat", latitude),
        ("lon", longitude),
        ("ell", ellipsoidal),
        ("heading", np.mod(point.heading + nose, 2.0 * math.pi)),
        ("chainage", point.chainage),
        ("cross", np.full(len(there), _model_sigma(model))),
    ):
        columns[name][there] = value
    return Solution(
        track_id=model.track_id,
        line=model.line,
        time=rows[:, 0].copy(),
        track=track,
        offset=rows[:, 1].copy(),
        chainage=columns["chainage"],
        easting=columns["e"],
        northing=columns["n"],
        height=columns["h"],
        latitude=columns["lat"],
        longitude=columns["lon"],
        ellipsoidal_height=columns["ell"],
        heading=columns["heading"],
        speed=rows[:, 2].copy(),
        acceleration=rows[:, 3].copy(),
        sigma_along=rows[:, 4].copy(),
        sigma_cross=columns["cross"],
        protection_level_along=rows[:, 5].copy(),
        track_probability=rows[:, 6].copy(),
        mode=mode,
        running_direction=way,
        run_id=run.id,
        start=run.start.isoformat().replace("+00:00", "Z"),
        crs_wkt=model.frame.crs_wkt,
        integrity_risk=integrity_risk,
        simulated=run.simulated,
        diagnostics={
            "epochs": m,
            "modes": {kind.label: int((mode == kind).sum()) for kind in Mode},
            "scheme": "map-corrector",
        },
    )


def _model_sigma(model: TrackModel) -> float:
    """Root mean square of the model's horizontal sigma, 0.5 m where it states none."""
    variance = 0.5 * (model.covariance_g[:, 0] + model.covariance_g[:, 3])
    known = variance[np.isfinite(variance) & (variance > 0)]
    return float(np.sqrt(known.mean())) if len(known) else 0.5
