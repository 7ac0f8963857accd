"""Service runs refine a model: every train that is navigated says a little of where the track lies (scheme B, rail 10 and 23).

An update (`railnav.survey.updating`) takes survey runs over a model that carries the records of its surveys. Here any model will do,
one drawn from a map too, and any run that can be navigated on it, with turnouts and changes of track: the navigator says which track
and how far along, and train and map errors are estimated together from the fixes (`railnav.navigation.joint`). The gauge is stated:
only the position across is refined, offsets keep the model's own labels, and where the whole line lies is left to the model as far as
receivers have errors that stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RunError
from railnav.navigation import navigate
from railnav.navigation.joint import JointSettings, MapChain, joint_pass, track_curve
from railnav.navigation.solution import Mode
from railnav.navigation.state import Settings
from railnav.track.alignment import KnotTable, fit_alignment

if TYPE_CHECKING:
    from railnav.navigation.solution import Solution
    from railnav.run import Progress, Run
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Distance between nodes of the map's errors, m.
SPACING = 25.0
#: Sigma across of a model that states none, m.
UNSTATED = 2.0
#: A pass shorter than so many fixes tells too little.
FEWEST = 15
#: Fixes nearer in time than this share their error, s: one of them is enough.
PACE = 0.95
#: Below this speed a receiver's errors wander while the train stands, m/s.
SLOWEST = 2.0
#: Way from a joint over which tracks that meet are brought together again, m.
BLEND = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class _Visit:
    """A stretch of one run on one track, in one direction: rows of the solution and of the fixes."""

    track: int
    direction: int
    rows: IntArray
    fixes: IntArray


def refine_from_service(
    model: TrackModel,
    runs: Sequence[Run],
    *,
    map_sigma: float | None = None,
    correlation_length: float = 200.0,
    progress: Progress | None = None,
) -> TrackModel:
    """Refine a model across the track from runs in service.

    Parameters
    ----------
    model : TrackModel
        Of any origin.
    runs : sequence of Run
        With GNSS; what else they carry helps the navigator.
    map_sigma : float, optional
        Error of the model across, m, where it states none (2 m by default). Where its covariance states one, that counts.
    correlation_length : float
        Way over which the model's errors are alike, m.
    progress : callable, optional

    Returns
    -------
    TrackModel
        The same tracks, nodes, movements and mile posts; axes moved across, lengths that follow, covariances of what is left.
        `provenance["service"]` has one more entry: runs, tracks, how far they moved. It carries no survey records: those of the model
        would not fit the moved axes.

    Raises
    ------
    RunError
        No runs, or none that is navigated on the model with certainty anywhere.

    Notes
    -----
    Fixes of one run are correlated over a minute and share a constant; both are in the estimation, so that a single run moves little.
    Along the track a run is taken as navigated. Errors of the map that are alike over kilometres look like errors of the receiver and
    go only as fast as runs of independent errors come in.

    References
    ----------
    `spec/rail.md` 10 (scheme B), 23.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> refine_from_service(demo_line(spacing=50.0), [])
    Traceback (most recent call last):
        ...
    railnav.errors.RunError: no runs in service to refine the model with
    """
    runs = list(runs)
    if not runs:
        raise RunError("no runs in service to refine the model with")
    tell = progress or _silent
    chains = [_prior(model, track, map_sigma, correlation_length) for track in model.track_id]
    known = _with_sigma(model, map_sigma)
    told: list[dict[str, Any]] = []
    for number, run in enumerate(runs):
        tell("navigate and refine", number, len(runs))
        told.append(_learn(known, run, chains))
    tell("navigate and refine", len(runs), len(runs))
    if not any(entry["fixes_used"] for entry in told):
        raise RunError(
            f"none of the {len(runs)} runs is navigated on the model with certainty anywhere: {told[0]['words']}",
            remedy="look at `railnav navigate` of one of them first",
        )
    return _moved(model, chains, told, simulated=any(run.simulated for run in runs))


def _silent(stage: str, done: int, total: int) -> None:
    pass


def _prior(model: TrackModel, track: str, map_sigma: float | None, correlation_length: float) -> MapChain:
    length = model.length(track)
    margin = 4.0 * SPACING  # places beyond the ends that an estimate may take
    nodes = np.arange(int(np.ceil((length + 2.0 * margin) / SPACING)) + 2) * SPACING - margin
    sigma = cross_sigma(model, track)
    stated = np.interp(nodes, model.offset[model.knots(track)], sigma) if sigma is not None else None
    if map_sigma is not None or stated is None:
        stated = np.full(len(nodes), UNSTATED if map_sigma is None else map_sigma)
    return MapChain.stationary(
        length + 2.0 * margin,
        sigma=np.maximum(stated, 1e-3),
        correlation_length=correlation_length,
        spacing=SPACING,
        start=-margin,
        components=1,
    )


def _with_sigma(model: TrackModel, map_sigma: float | None) -> TrackModel:
    """The model with a covariance for the navigator where it states none."""
    stated = np.asarray(np.isfinite(model.covariance_g[:, [0, 1, 3]]).all(axis=1))
    unknown = np.flatnonzero(~stated if map_sigma is None else np.ones(len(stated), np.bool_))
    if not len(unknown):
        return model
    P = model.covariance_g.copy()
    P[unknown, 0] = P[unknown, 3] = (UNSTATED if map_sigma is None else map_sigma) ** 2
    P[unknown, 1] = 0.0
    return replace(model, covariance_g=P)


def cross_sigma(model: TrackModel, track: str) -> FloatArray | None:
    """Standard deviation across a track at its knots, (k,) m; None where the model states none."""
    knots = model.knots(track)
    P, bearing = model.covariance_g[knots], model.grid_bearing[knots]
    if not np.isfinite(P[:, [0, 1, 3]]).all():
        return None
    e, n = np.cos(bearing), -np.sin(bearing)
    return np.asarray(np.sqrt(np.maximum(e * e * P[:, 0] + 2.0 * e * n * P[:, 1] + n * n * P[:, 3], 0.0)))


def _learn(model: TrackModel, run: Run, chains: list[MapChain]) -> dict[str, Any]:
    """Navigate one run and let the chains of its tracks learn; say what was used."""
    entry: dict[str, Any] = {"id": run.id, "start": run.start.isoformat(), "fixes_used": 0, "tracks": [], "words": ""}
    if run.gnss is None:
        return entry | {"words": f"run {run.id} has no GNSS"}
    solution = navigate(run, model, smooth=True)
    visits = _visits(run, solution)
    if not visits:
        sure = float(np.mean(solution.mode == Mode.TRACKING))
        return entry | {
            "words": f"run {run.id} is sure of its track in {sure:.0%} of its epochs, nowhere for {FEWEST} fixes"
        }
    settings, white, scale = _errors(run, solution)
    for visit in visits:
        name = model.track_id[visit.track]
        z, forward = _axis_fixes(model, run, solution, visit), visit.direction > 0
        offset = solution.offset[visit.rows]
        chain = chains[visit.track]
        curve = track_curve(model, name)
        if not forward:
            offset, chain, curve = -offset, chain.reversed(), _reversed(curve)
        way = np.diff(offset)
        seen = joint_pass(
            _plane(curve),
            chain,
            solution.time[visit.rows],
            z,
            white[visit.fixes, None, None] ** 2 * np.eye(2),
            offset=float(offset[0]),
            distances=way,
            distance_sigma=0.05 + 0.005 * np.abs(way),
            settings=replace(settings, offset_sigma=float(max(solution.sigma_along[visit.rows[0]], 0.1))),
        )
        chains[visit.track] = seen.chain if forward else seen.chain.reversed()
        entry["fixes_used"] += int(np.isfinite(seen.nis).sum())
        if name not in entry["tracks"]:
            entry["tracks"].append(name)
    entry["sigma_scale"] = round(scale, 3)
    return entry


def _visits(run: Run, solution: Solution) -> list[_Visit]:
    """Stretches in which the smoothed solution is sure of the track and the train moves one way, a fix a second."""
    assert run.gnss is not None
    row = np.searchsorted(solution.time, run.gnss.time - 1e-6)
    row = np.minimum(row, len(solution) - 1)
    good = np.abs(solution.time[row] - run.gnss.time) < 1e-3
    good &= (solution.mode[row] == Mode.TRACKING) & (np.abs(solution.speed[row]) > SLOWEST)
    fixes = np.flatnonzero(good)
    kept, last = [], -np.inf
    for i in fixes:
        if run.gnss.time[i] - last >= PACE:
            kept.append(i)
            last = float(run.gnss.time[i])
    fixes = np.array(kept, np.int64)
    if not len(fixes):
        return []
    rows = row[fixes]
    direction = np.sign(solution.running_direction[rows] * np.sign(solution.speed[rows])).astype(np.int64)
    step = np.diff(solution.offset[rows]) * direction[:-1]
    new = (np.diff(solution.track[rows]) != 0) | (np.diff(direction) != 0) | (step <= 0.0) | (np.diff(rows) > 200)
    parts = np.split(np.arange(len(fixes)), np.flatnonzero(new) + 1)
    return [
        _Visit(int(solution.track[rows[p[0]]]), int(direction[p[0]]), rows[p], fixes[p])
        for p in parts
        if len(p) >= FEWEST
    ]


def _errors(run: Run, solution: Solution) -> tuple[JointSettings, FloatArray, float]:
    """What the run's receiver errs by: coloured and constant parts, the white sigma of each fix, and the scale of stated sigmas."""
    assert run.gnss is not None
    kind = Settings.of_receiver(run.gnss.receiver)
    scale = float(solution.diagnostics.get("gnss_sigma_scale", 1.0))
    east, north = run.gnss.sigma_east, run.gnss.sigma_north
    stated = (
        np.sqrt(0.5 * (np.square(east) + np.square(north)))
        if east is not None and north is not None
        else np.full(len(run.gnss), 3.0)
    )
    stated = np.where(np.isfinite(stated), stated, np.nanmedian(stated) if np.isfinite(stated).any() else 3.0)
    sigma = scale * stated
    usual = float(np.median(sigma))
    white = np.sqrt((kind.gnss_white_share * sigma) ** 2 + np.maximum(sigma**2 - usual**2, 0.0))
    return (
        JointSettings(
            coloured_sigma=kind.gnss_correlated_share * usual,
            correlation_time=kind.gnss_correlation_time,
            frame_sigma=max(kind.gnss_frame_share * usual, 0.01),
        ),
        np.maximum(white, 0.01),
        scale,
    )


def _axis_fixes(model: TrackModel, run: Run, solution: Solution, visit: _Visit) -> FloatArray:
    """Fixes of a visit brought from the antenna to the reference point, (m, 2) easting and northing, m."""
    assert run.gnss is not None
    gnss, rows = run.gnss, visit.rows
    easting, northing, _ = model.frame.to_grid(gnss.latitude[visit.fixes], gnss.longitude[visit.fixes])
    forward, right, down = gnss.lever_arm_b
    here = model.at(visit.track, solution.offset[rows])
    nose = solution.running_direction[rows]
    bearing = here.grid_bearing + np.where(nose > 0, 0.0, np.pi)
    roll = np.arcsin(np.clip(nose * here.cant / 1.5, -0.5, 0.5))
    aside = right * np.cos(roll) - down * np.sin(roll)
    return np.column_stack(
        [
            easting - forward * np.sin(bearing) - aside * np.cos(bearing),
            northing - forward * np.cos(bearing) + aside * np.sin(bearing),
        ]
    )


def _plane(curve: Any) -> Any:
    """A curve with its heights left out."""

    def flat(s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        c, t, E = curve(s)
        return c[:, :2], t[:, :2], E[:, :2, :1]

    return flat


def _reversed(curve: Any) -> Any:
    """A curve told from its far end: offsets count backwards, tangents turn round; `right` stays that of growing offset."""

    def back(s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        c, t, E = curve(-np.asarray(s, float))
        return c, -t, E

    return back


# ---------------------------------------------------------------- the refined model


def _moved(model: TrackModel, chains: list[MapChain], told: list[dict[str, Any]], *, simulated: bool) -> TrackModel:
    """The model with every axis where its chain says it lies; tracks that meet still meet."""
    from scipy.interpolate import CubicSpline

    from railnav.survey.renewal import with_tables

    touched = {name for entry in told for name in entry["tracks"]}
    shift: dict[int, FloatArray] = {}
    variance: dict[int, FloatArray] = {}
    for i, name in enumerate(model.track_id):
        knots = model.knots(name)
        s = model.offset[knots]
        if name not in touched:
            shift[i] = np.zeros(len(s))
            continue
        mean, P = chains[i].marginals()
        nodes = chains[i].start + SPACING * np.arange(len(mean), dtype=np.float64)
        shift[i] = CubicSpline(nodes, mean[:, 0])(s)
        between = np.asarray(
            shift[i] - np.interp(s, nodes, mean[:, 0]), np.float64
        )  # what the nodes do not tell of the way between them
        variance[i] = np.asarray(np.interp(s, nodes, P[:, 0, 0] + _spread(s, between, nodes)))
    _meet(model, shift, touched)
    tables: dict[str, KnotTable] = {}
    tracks = []
    for i, name in enumerate(model.track_id):
        if float(np.abs(shift[i]).max()) < 1e-6 and i not in variance:
            continue
        knots = model.knots(name)
        bearing, P = model.grid_bearing[knots], model.covariance_g[knots].copy()
        e, n = np.cos(bearing), -np.sin(bearing)
        if i in variance:
            along = _along_variance(P, e, n)
            P[:, 0], P[:, 3] = variance[i] * e * e + along * n * n, variance[i] * n * n + along * e * e
            P[:, 1] = (variance[i] - along) * e * n
            P[:, [2, 4]] = np.where(np.isfinite(P[:, 5:6]), 0.0, np.nan)
        tables[name] = fit_alignment(
            model.frame,
            model.easting[knots] + shift[i] * e,
            model.northing[knots] + shift[i] * n,
            model.height[knots],
            cant=model.cant[knots],
            covariance_g=P,
            spacing=float(np.median(np.diff(model.offset[knots]))),
        )
        if i in variance:
            before = cross_sigma(model, name)
            tracks.append(
                {
                    "track": name,
                    "moved_rms_m": round(float(np.sqrt(np.mean(shift[i] ** 2))), 4),
                    "moved_max_m": round(float(np.abs(shift[i]).max()), 4),
                    "sigma_before_m": None if before is None else round(float(np.median(before)), 4),
                    "sigma_m": round(float(np.sqrt(np.median(variance[i]))), 4),
                    "length_before_m": round(model.length(name), 4),
                    "length_m": round(float(tables[name].offset[-1]), 4),
                }
            )
    entry = {
        "runs": told,
        "tracks": tracks,
        "gauge": "across the track only; offsets keep the model's labels, and a shift of the whole line is the model's own",
    }
    provenance = {**model.provenance, "service": [*model.provenance.get("service", []), entry]}
    if simulated:
        provenance["simulated"] = True
    return with_tables(model, tables, provenance, None)


def _spread(s: FloatArray, between: FloatArray, nodes: FloatArray) -> FloatArray:
    """Mean square of values within one node's distance of each node, (n,)."""
    total = np.append(0.0, np.cumsum(between**2))
    first, last = np.searchsorted(s, nodes - SPACING), np.searchsorted(s, nodes + SPACING)
    return np.asarray((total[last] - total[first]) / np.maximum(last - first, 1))


def _along_variance(P: FloatArray, e: FloatArray, n: FloatArray) -> FloatArray:
    """Variance along the track, m^2; that across where none is stated."""
    along = n * n * P[:, 0] - 2.0 * e * n * P[:, 1] + e * e * P[:, 3]
    return np.where(np.isfinite(along), np.maximum(along, 0.0), UNSTATED**2)


def _meet(model: TrackModel, shift: dict[int, FloatArray], touched: set[str]) -> None:
    """Bring the ends of tracks together again: each end goes to the mean of those that were refined, fading over `BLEND` metres."""
    ends: dict[int, list[tuple[int, bool]]] = {}
    for i in range(len(model.track_id)):
        ends.setdefault(int(model.start_node[i]), []).append((i, False))
        ends.setdefault(int(model.end_node[i]), []).append((i, True))
    wanted: dict[tuple[int, bool], float] = {}
    for members in ends.values():
        vectors = []
        for i, far in members:
            if model.track_id[i] in touched:
                b = model.grid_bearing[model.knots(model.track_id[i])][-1 if far else 0]
                vectors.append(shift[i][-1 if far else 0] * np.array([np.cos(b), -np.sin(b)]))
        if len(members) < 2 or not vectors:
            continue
        mean = np.mean(vectors, axis=0)
        for i, far in members:
            b = model.grid_bearing[model.knots(model.track_id[i])][-1 if far else 0]
            wanted[(i, far)] = float(mean @ np.array([np.cos(b), -np.sin(b)]))
    for (i, far), value in wanted.items():
        knots = model.knots(model.track_id[i])
        s = model.offset[knots]
        length = float(s[-1])
        reach = min(BLEND, length)
        from_end = (length - s) if far else s
        fade = np.clip(1.0 - from_end / reach, 0.0, 1.0)
        fade = fade * fade * (3.0 - 2.0 * fade)
        shift[i] = shift[i] + (value - shift[i][-1 if far else 0]) * fade
