"""A recorded run on a model: filter forward, smooth on the way back, and write down what was found."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import OffModelError
from railnav.matching import _kernels as paths
from railnav.matching.network import balises_of
from railnav.navigation import columns as c
from railnav.navigation.declared import settings_of
from railnav.navigation.engine import SLOTS, Engine
from railnav.navigation.epochs import raw_table
from railnav.navigation.explanation import Decision, alternatives, decisions
from railnav.navigation.smoothing import smooth_rows
from railnav.navigation.solution import Alternatives, Mode, Solution
from railnav.navigation.state import Settings
from railnav.run import Progress, Run

if TYPE_CHECKING:
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Sigma across the track that is stated where the model states none, m.
UNKNOWN_SIGMA_CROSS = 0.5


def navigate(
    run: Run,
    model: TrackModel,
    *,
    smooth: bool = False,
    integrity_risk: float = 1e-4,
    settings: Settings | None = None,
    explain: list[Decision] | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Place a run on a model: which track, where on it, how fast, how sure.

    A square-root filter in arc length over all hypotheses of the path (specification 15, 19-22). Rows are the GNSS fixes and the
    odometer readings; while an IMU measures, further rows keep the step at 0.1 s, and a gap of everything is bridged with a row
    a second (mode coasting). A train changes track only by the model's permitted movements; where an earlier choice turns out
    wrong, one row without a position (mode lost) stands between, never a jump.

    Parameters
    ----------
    run : Run
        With a GNSS stream; odometer and IMU are used where they are there.
    model : TrackModel
        The reference model.
    smooth : bool
        Use the whole run for every row (fixed-interval smoother along the winning path) instead of the past alone.
    integrity_risk : float
        Risk, per row, that the along-track error exceeds the protection level.
    settings : Settings, optional
        What is assumed of sensors and trains; by default `settings_of` the run: what it declares of its sensors, else the usual for the
        receiver that it names.
    explain : list, optional
        Receives a `Decision` for each epoch at which what is said of the track changes: the candidates, and what each kind of evidence
        said of them. With `smooth` these are the decisions of the filter, before the smoother.
    progress : Progress, optional
        Called with a label, rows done and rows in all.

    Returns
    -------
    Solution
        One row an epoch. `track_probability` is the posterior of the row's track; below 0.99 the mode is ambiguous; so it is where the
        fixes of a receiver alone have jumped and the place on the track is open (sigma beyond 25 m).
        `protection_level_along` bounds the error along the track over all hypotheses, also those on other tracks (their places are
        projected onto the row's track), so that it holds whichever track is right; that the track is right, it does not say.
        `alternatives` holds all candidates of the rows whose track is not certain; smoothed ones when smoothed.
        `sigma_cross` is the model's, or 0.5 m where the model states none (diagnostics: sigma_cross_assumed).

    Raises
    ------
    RunError
        The run has no GNSS fix.
    OffModelError
        No fix comes near the model.

    Notes
    -----
    Cost is linear in the epochs: about 5 microseconds for a fix alone, 9 with odometer and IMU.

    Examples
    --------
    >>> from railnav.simulation import demo_line, path_of, simulate
    >>> callable(navigate)
    True
    """
    balises = balises_of(model)
    raw = raw_table(run, balises)
    gnss, odometer, imu = run.gnss, run.odometer, run.imu
    assert gnss is not None
    reads = "" if odometer is None or len(odometer) == 0 else "speed" if odometer.distance is None else "distance"
    m = len(raw)
    engine = Engine(
        model,
        settings or settings_of(run),
        imu=imu is not None and len(imu) > 0,
        odometer=reads,
        speed=gnss.speed is not None,
        signed_odometer=odometer is not None and odometer.signed,
        lever_arm_b=gnss.lever_arm_b,
        integrity_risk=integrity_risk,
        receiver=gnss.receiver,
        balises=run.balise is not None and len(balises) > 0,
        records=2 * m + 2 * SLOTS if smooth else 0,
        journal=(0 if smooth else 2) + (0 if explain is None else 1),
    )
    table = engine.table(raw)
    out = np.empty((m, c.OUTPUT_SIZE))
    stride = m if progress is None else max(2000, m // 50)
    for done in range(0, m, stride):
        stop = min(done + stride, m)
        engine.advance(table[:stop], out, done)
        if progress is not None:
            progress("navigate", stop, m)
    if engine.shared.common[c.C_STARTS] == 0.0:
        raise OffModelError(_distance_from(run, model, table, engine.settings.sigma_usable))
    if explain is not None:
        explain += decisions(engine, table[:, c.TIME], out)
    if smooth:
        out, others = smooth_rows(engine, table, out, progress=progress)
        return _solution(run, engine, table, out, smooth, others)
    return _solution(run, engine, table, out, smooth, alternatives(engine))


def _distance_from(run: Run, model: TrackModel, table: FloatArray, sigma_usable: float) -> str:
    """One line on how far from the model a run stays."""
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(np.isfinite(table[:, c.EAST]))
    usable = rows[table[rows, c.SIGMA_EAST] <= sigma_usable]
    if len(usable) == 0:
        return f"run {run.id!r}: every fix states a sigma above {sigma_usable:.0f} m; there is nothing to start from"
    chosen = usable[:: max(1, len(usable) // 2000)]
    tree = cKDTree(np.column_stack([model.easting, model.northing]))
    distance, _ = tree.query(table[chosen][:, [c.EAST, c.NORTH]])
    nearest = float(distance.min())
    text = f"{nearest / 1000:.1f} km" if nearest >= 1000 else f"{nearest:.0f} m"
    return f"run {run.id!r} never touches the model: its nearest fix lies {text} from the nearest track; is it the right model?"


def _solution(
    run: Run, engine: Engine, table: FloatArray, out: FloatArray, smooth: bool, others: Alternatives
) -> Solution:
    """Turn the kernel's table into a solution: geometry, chainage and geodetic coordinates in bulk."""
    model = engine.model
    m = len(out)
    track = out[:, c.OUT_TRACK].astype(np.int64)
    there = np.flatnonzero(track >= 0)
    names = ("easting", "northing", "height", "heading", "chainage", "cross", "latitude", "longitude", "ellipsoidal")
    columns = {name: np.full(m, np.nan) for name in names}
    assumed = False
    if len(there):
        on = track[there]
        where = np.clip(out[there, c.OUT_OFFSET], 0.0, engine.network.length[on])
        point = model.at(on, where + model.offset[model.knot_start[:-1]][on])
        latitude, longitude, ellipsoidal = model.frame.to_geodetic(point.easting, point.northing, point.height)
        nose = np.where(out[there, c.OUT_WAY] > 0, 0.0, math.pi)
        cross = _sigma_cross(engine, on, where, point.grid_bearing)
        assumed = not bool(np.isfinite(cross).all())
        for name, value in zip(
            names,
            (
                point.easting,
                point.northing,
                point.height,
                np.mod(point.heading + nose, 2.0 * math.pi),
                point.chainage,
                np.where(np.isfinite(cross), cross, UNKNOWN_SIGMA_CROSS),
                latitude,
                longitude,
                ellipsoidal,
            ),
            strict=True,
        ):
            columns[name][there] = value
    mode = out[:, c.OUT_MODE].astype(np.int64)
    return Solution(
        track_id=model.track_id,
        line=model.line,
        time=table[:, c.TIME].copy(),
        track=track,
        offset=out[:, c.OUT_OFFSET].copy(),
        chainage=columns["chainage"],
        easting=columns["easting"],
        northing=columns["northing"],
        height=columns["height"],
        latitude=columns["latitude"],
        longitude=columns["longitude"],
        ellipsoidal_height=columns["ellipsoidal"],
        heading=columns["heading"],
        speed=out[:, c.OUT_SPEED].copy(),
        acceleration=out[:, c.OUT_ACCELERATION].copy(),
        sigma_along=out[:, c.OUT_SIGMA].copy(),
        sigma_cross=columns["cross"],
        protection_level_along=out[:, c.OUT_LEVEL].copy(),
        track_probability=out[:, c.OUT_PROBABILITY].copy(),
        mode=mode,
        running_direction=np.where(track >= 0, np.nan_to_num(out[:, c.OUT_DIRECTION]), 0.0).astype(np.int64),
        run_id=run.id,
        start=run.start.isoformat().replace("+00:00", "Z"),
        crs_wkt=model.frame.crs_wkt,
        integrity_risk=float(engine.filter.risk[0]),
        smoothed=smooth,
        simulated=run.simulated,
        diagnostics=_diagnostics(engine, mode, assumed),
        alternatives=others,
    )


def _sigma_cross(engine: Engine, track: IntArray, offset: FloatArray, bearing: FloatArray) -> FloatArray:
    """Standard deviation of the model's axis across the track at given places, NaN where the model states none."""
    model = engine.model
    # the knot before each offset, from one search over all tracks laid end to end
    laid = np.append(0.0, np.cumsum(engine.network.length + 1.0))
    knots = engine.network.knots[:, paths.OFFSET] + np.repeat(laid[:-1], np.diff(model.knot_start))
    knot = np.clip(np.searchsorted(knots, laid[track] + offset, side="right") - 1, 0, len(knots) - 1)
    ee, en, nn = (model.covariance_g[knot, i] for i in (0, 1, 3))
    sin, cos = np.sin(bearing), np.cos(bearing)
    variance = ee * cos**2 - 2.0 * en * sin * cos + nn * sin**2
    return np.sqrt(np.where(variance >= 0.0, variance, np.nan))


def _diagnostics(engine: Engine, mode: IntArray, assumed: bool) -> dict[str, Any]:
    """Counts and settings of a run: JSON values."""
    common, bank = engine.shared.common, engine.bank
    living = engine.living()
    best = max(living, key=lambda slot: bank.logw[slot], default=None)
    return {
        "epochs": len(mode),
        "modes": {kind.label: int((mode == kind).sum()) for kind in Mode},
        "fixes_used": int(common[c.C_FIXES]),
        "fixes_suspect": int(common[c.C_SUSPECT_FIXES]),
        "gnss_steps": int(common[c.C_STEPS]),
        "gnss_sigma_scale": float(common[c.C_SCALE]),
        "frame_offset_sigma_m": float(common[c.C_FRAME_SIGMA]),
        "frame_offset_m": [] if best is None else bank.x[best, :2].tolist(),
        "wheel_slips": int(common[c.C_SLIPS]),
        "fixes_frozen": int(common[c.C_FROZEN]),
        "inertial_repeated": int(common[c.C_REPEATED]),
        "gyro_faults": int(common[c.C_GYRO_FAULTS]),
        "accelerometer_faults": int(common[c.C_ACCELEROMETER_FAULTS]),
        "odometer_faults": int(common[c.C_ODOMETER_FAULTS]),
        "balises_read": int(common[c.C_BALISES]),
        "balises_strange": int(common[c.C_STRANGE_BALISES]),
        "starts": int(common[c.C_STARTS]),
        "track_revisions": int(common[c.C_REVISIONS]),
        "sigma_cross_assumed": assumed,
        "settings": {field.name: getattr(engine.settings, field.name) for field in fields(Settings)},
    }
