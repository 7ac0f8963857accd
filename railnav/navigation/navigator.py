"""The navigator: a train held to its track model, forward as on board, or smoothed after the fact."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import OffModelError, RunError
from railnav.matching import _kernels as paths
from railnav.matching.network import pack_network
from railnav.navigation import _kernels as kernel
from railnav.navigation.epochs import COLUMNS, IDLE_STEP, Epoch, kernel_table, raw_table
from railnav.navigation.solution import Mode, Solution
from railnav.navigation.state import Settings, State, layout
from railnav.run import Progress, Run

if TYPE_CHECKING:
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Hypotheses that fit at a time (more than are kept, for those at a start or a fan of turnouts), and tracks in a window.
SLOTS, WINDOW = 48, 12


def _quantile(risk: float) -> float:
    """Two-sided normal quantile: k with 2 Q(k) = risk."""
    from statistics import NormalDist

    return NormalDist().inv_cdf(1.0 - 0.5 * risk)


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another track the train may be on: identifier, offset, m, and posterior probability."""

    track: str
    offset: float
    probability: float


@dataclass(frozen=True, slots=True)
class Position:
    """Where the train is at one epoch, as a row of `Solution` says it; SI and radians.

    Attributes
    ----------
    time : float
        Seconds on the run's clock.
    track : str or None
        Identifier; None when there is no position (mode initialising, lost, off-model).
    offset : float
        On the track, m.
    speed, acceleration : float
        Along the nose, m/s and m/s^2.
    sigma_along, protection_level_along : float
        Standard deviation and bound of the error along the track, m.
    track_probability : float
        Posterior of the track.
    mode : Mode
    running_direction : int
        +1 when the nose points to growing offset, -1 otherwise, 0 when not yet known.
    alternatives : tuple of Alternative
        Other tracks, most probable first.
    """

    time: float
    track: str | None
    offset: float
    speed: float
    acceleration: float
    sigma_along: float
    protection_level_along: float
    track_probability: float
    mode: Mode
    running_direction: int
    alternatives: tuple[Alternative, ...]
    _model: TrackModel

    @property
    def chainage(self) -> float:
        """Published chainage, m; NaN where there is no position."""
        if self.track is None:
            return math.nan
        return float(self._model.chainage(self._model.track_index(self.track), self.offset))

    @property
    def grid(self) -> tuple[float, float, float]:
        """Easting, northing, height of the track axis, m; NaN where there is no position."""
        if self.track is None:
            return (math.nan, math.nan, math.nan)
        point = self._model.at(self.track, self.offset)
        return float(point.easting), float(point.northing), float(point.height)

    @property
    def geodetic(self) -> tuple[float, float, float]:
        """WGS 84 latitude, longitude, rad, and ellipsoidal height, m."""
        if self.track is None:
            return (math.nan, math.nan, math.nan)
        latitude, longitude, height = self._model.frame.to_geodetic(*self.grid)
        return float(latitude), float(longitude), float(height)


class Navigator:
    """The live navigator: one epoch in, one position out; the same mathematics and the same inner loop as `navigate`.

    The state runs along the paths that the model permits (spec 19): each hypothesis owns a path, its place and speed on it, the
    sensors' errors, the square root of their covariance, and a weight. Before a turnout it is cloned for each lawful way; what the
    sensors say decides. A train that can be on several tracks is said to be (`mode` ambiguous), never placed on the nearest.

    Parameters
    ----------
    model : TrackModel
        The reference model.
    imu : bool
        Whether epochs bring `forward_force` and `yaw_rate`.
    odometer : str
        What epochs bring of an odometer: "distance", "speed" or "" (nothing).
    speed : bool
        Whether the receiver gives a speed.
    signed_odometer : bool
        Whether backing up subtracts from the distance.
    lever_arm_b : (3,) array
        Reference point to antenna: forward, right, down, m.
    integrity_risk : float
        Risk, per epoch, that the along-track error exceeds the protection level.
    settings : Settings, optional
        What is assumed of sensors and trains.

    Notes
    -----
    Memory is constant; a step takes some 50 microseconds. Leaving out a sensor that is not there makes it cheaper.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> Navigator(demo_line(), imu=False, odometer="").step(Epoch(0.0)).mode.label
    'initialising'
    """

    def __init__(
        self,
        model: TrackModel,
        *,
        imu: bool = True,
        odometer: str = "distance",
        speed: bool = True,
        signed_odometer: bool = False,
        lever_arm_b: ArrayLike = (0.0, 0.0, 0.0),
        integrity_risk: float = 1e-4,
        settings: Settings | None = None,
    ) -> None:
        if not 0.0 < integrity_risk < 1.0:
            raise ValueError(f"integrity_risk {integrity_risk} is not between 0 and 1")
        if odometer not in ("distance", "speed", ""):
            raise ValueError(f"odometer {odometer!r} is not 'distance', 'speed' or ''")
        self._model = model
        self._settings = _settings_for(model, settings or Settings())
        self._network = pack_network(model)
        at = layout(imu=imu, odometer=odometer, speed=speed)
        n = int(at.max()) + 1
        lever = np.array(lever_arm_b, np.float64).reshape(3)
        self._filter = kernel.Filter(
            at,
            self._settings.packed(),
            lever,
            np.array([integrity_risk, _quantile(integrity_risk)]),
            int(signed_odometer),
        )
        self._bank = paths.Bank(
            np.zeros((SLOTS, n)),
            np.zeros((SLOTS, n, n)),
            np.zeros(SLOTS),
            np.zeros((SLOTS, WINDOW), np.int64),
            np.ones((SLOTS, WINDOW), np.int64),
            np.zeros((SLOTS, WINDOW)),
            np.zeros((SLOTS, WINDOW), np.int64),
            np.zeros((SLOTS, paths.TAGS), np.int64),
            np.zeros((SLOTS, paths.INFO)),
            np.zeros(SLOTS + 1, np.int64),
            np.zeros(SLOTS, np.int64),
        )
        common = np.zeros(kernel.COMMON_SIZE)
        common[
            [kernel.C_TIME, kernel.C_FIX_TIME, kernel.C_TRY, kernel.C_WHEEL_SEEN, kernel.C_GNSS_SPEED_TIME]
        ] = -np.inf
        common[[kernel.C_WHEEL_MOVED, kernel.C_GNSS_STILL]] = np.inf
        common[kernel.C_SCALE] = self._settings.scale_start
        common[kernel.C_OUT_TRACK] = -1.0
        ring = np.column_stack([np.full(kernel.RING, -np.inf), np.full(kernel.RING, np.nan)])
        self._shared = kernel.Shared(common, ring, np.zeros(SLOTS))
        self._records = _records(n, 0, 0)

    @property
    def model(self) -> TrackModel:
        """The model that the train is held to."""
        return self._model

    @property
    def settings(self) -> Settings:
        """What is assumed of sensors and trains, with what the model itself says filled in."""
        return self._settings

    def step(self, epoch: Epoch) -> Position:
        """Take in one epoch and say where the train is.

        Parameters
        ----------
        epoch : Epoch
            Later than the one before. A gap is bridged in steps of at most 1 s.

        Returns
        -------
        Position

        Raises
        ------
        RunError
            The epoch is not later than the one before.
        """
        before = float(self._shared.common[kernel.C_TIME])
        if not epoch.time > before:
            raise RunError(
                f"epoch at {epoch.time} s is not later than the one before, {before} s", remedy="sort the epochs"
            )
        raw = np.array([[getattr(epoch, name) for name in COLUMNS]])
        table = kernel_table(raw, self._model)
        if epoch.time - before > 1.5 * IDLE_STEP and math.isfinite(before):
            steps = math.ceil((epoch.time - before) / IDLE_STEP - 1e-6)
            idle = np.full((steps, table.shape[1]), np.nan)
            idle[:-1, kernel.TIME] = before + IDLE_STEP * np.arange(1, steps)
            idle[-1] = table[0]
            table = idle
        out = np.empty((len(table), kernel.OUTPUT_SIZE))
        self._advance(table, out)
        return self._position(epoch.time, out[-1])

    def _position(self, time: float, row: FloatArray) -> Position:
        track = int(row[kernel.OUT_TRACK])
        return Position(
            time,
            self._model.track_id[track] if track >= 0 else None,
            float(row[kernel.OUT_OFFSET]),
            float(row[kernel.OUT_SPEED]),
            float(row[kernel.OUT_ACCELERATION]),
            float(row[kernel.OUT_SIGMA]),
            float(row[kernel.OUT_LEVEL]),
            float(row[kernel.OUT_PROBABILITY]),
            Mode(int(row[kernel.OUT_MODE])),
            int(row[kernel.OUT_DIRECTION]) if track >= 0 else 0,
            self._alternatives(track),
            self._model,
        )

    def _alternatives(self, track: int) -> tuple[Alternative, ...]:
        """Tracks other than `track` that living hypotheses stand on."""
        bank, i_s = self._bank, int(self._filter.at[State.POSITION])
        if bank.live[0] < 2 and track >= 0:
            return ()
        best: dict[int, list[float]] = {}
        for h in bank.live[1 : 1 + bank.live[0]].tolist():
            i = int(bank.tags[h, paths.CURRENT])
            t = int(bank.track[h, i])
            if t == track:
                continue
            length = float(self._network.length[t])
            local = min(max(float(bank.x[h, i_s] - bank.begin[h, i]), 0.0), length)
            offset = local if bank.way[h, i] > 0 else length - local
            weight = float(self._shared.weight[h])
            entry = best.setdefault(t, [0.0, 0.0, offset])
            entry[0] += weight
            if weight > entry[1]:
                entry[1:] = [weight, offset]
        ordered = sorted(best.items(), key=lambda item: -item[1][0])
        return tuple(Alternative(self._model.track_id[t], offset, weight) for t, (weight, _, offset) in ordered)

    def _advance(self, table: FloatArray, out: FloatArray, first: int = 0) -> None:
        """Work through the rows of a table from `first`, starting hypotheses and making room where the loop asks for it."""
        while True:
            first, why = kernel.run(
                self._filter, self._network, self._shared, self._bank, self._records, table, first, out
            )
            if why == kernel.DONE:
                return
            if why == kernel.NEEDS_ROOM:
                self._records = _grown(self._records)
            else:
                self._start(table[first])

    def _start(self, row: FloatArray) -> None:
        """Put a hypothesis on every track near a fix, for each direction that speed and course leave open."""
        common, bank, settings = self._shared.common, self._bank, self._settings
        at, network = self._filter.at, self._network
        time = float(row[kernel.TIME])
        common[kernel.C_TRY] = time
        sigma = float(max(row[kernel.SIGMA_EAST], row[kernel.SIGMA_NORTH]))
        within = max(50.0, 4.0 * sigma)
        from railnav.matching.candidates import starting_candidates

        found = starting_candidates(
            self._model,
            network,
            float(row[kernel.EAST]),
            float(row[kernel.NORTH]),
            within=within,
            overhang=2.0 * sigma + 5.0,
        )
        common[kernel.C_NOTHING_NEAR] = float(not found)
        if not found:
            return
        frame = math.hypot(settings.gnss_frame_share * sigma, settings.model_sigma)
        frame = min(max(frame, settings.frame_sigma_least), settings.frame_sigma_most)
        common[kernel.C_FRAME_SIGMA] = max(frame, common[kernel.C_FRAME_SIGMA])
        common[kernel.C_FRAME_TIME] = time + 60.0
        common[kernel.C_FRESH] = 1.0
        common[kernel.C_STARTED] = 1.0
        common[kernel.C_STARTS] += 1.0
        common[kernel.C_SUSPECTS] = 0.0
        common[kernel.C_FIX_TIME] = time
        common[kernel.C_TIME] = time
        speed, sigma_speed = float(row[kernel.GNSS_SPEED]), float(row[kernel.SIGMA_SPEED])
        if not sigma_speed > 0.0:
            sigma_speed = settings.speed_sigma
        scale = math.sqrt(common[kernel.C_SCALE] ** 2 + settings.gnss_white_share**2)
        sd = np.ones(len(State))
        sd[[State.FRAME_EAST, State.FRAME_NORTH]] = common[kernel.C_FRAME_SIGMA]
        sd[State.TIME_TAG] = settings.time_tag_sigma
        sd[State.SPEED_LATENCY] = settings.speed_latency
        sd[State.ODOMETER_SCALE] = settings.odometer_scale
        sd[State.GYRO_BIAS] = settings.gyro_bias
        sd[State.ACCELEROMETER_BIAS] = settings.accelerometer_bias
        sd[State.ACCELERATION] = settings.acceleration_sigma
        sd[State.POSITION] = 3.0 * math.hypot(scale * sigma, common[kernel.C_FRAME_SIGMA]) + 5.0
        point = np.empty(paths.POINT_SIZE)
        bank.live[0] = 0
        bank.used[:] = 0
        for start in found:
            paths.track_point(network, start.track, 1, start.offset, point)
            for way, v, sd_v, moved, prior in self._directions(row, point, speed, sigma_speed):
                h = paths.take_slot(bank)
                if h < 0:
                    return
                sd[State.SPEED] = sd_v
                bank.x[h] = 0.0
                bank.x[h, at[State.SPEED]] = v
                length = float(network.length[start.track])
                bank.x[h, at[State.POSITION]] = start.offset if way > 0 else length - start.offset
                bank.P_sqrt[h] = np.diag(sd[at >= 0])
                i_d = int(at[State.WHEEL_DISTANCE])
                if i_d >= 0:
                    reading = self._shared.ring[(int(common[kernel.C_RING]) - 1) % kernel.RING, 1]
                    known = math.isfinite(reading)
                    bank.x[h, i_d] = reading if known else 0.0
                    bank.P_sqrt[h, i_d, i_d] = 100.0 if known else 1.0
                bank.logw[h] = math.log(prior)
                bank.track[h, 0], bank.way[h, 0], bank.begin[h, 0] = start.track, way, 0.0
                bank.armed[h] = 0
                bank.tags[h] = 0
                bank.tags[h, paths.COUNT] = 1
                bank.tags[h, paths.RECORD] = -1
                bank.tags[h, paths.VERSION] = -1
                bank.tags[h, paths.MOVED] = int(moved)
                bank.tags[h, paths.SIGN] = 1 if v >= 0.0 else -1
                bank.info[h] = -np.inf
                bank.info[h, paths.FADING] = 0.0

    def _directions(
        self, row: FloatArray, point: FloatArray, speed: float, sigma_speed: float
    ) -> list[tuple[int, float, float, bool, float]]:
        """Directions of the nose worth a hypothesis on a track, with speed, its sigma, whether it moves, and the prior."""
        sigma = math.hypot(sigma_speed, 0.5)
        if not math.isfinite(speed):
            return [(1, 0.0, 20.0, False, 0.5), (-1, 0.0, 20.0, False, 0.5)]
        if speed < max(1.0, 3.0 * sigma_speed):
            return [(1, 0.0, sigma + speed, False, 0.5), (-1, 0.0, sigma + speed, False, 0.5)]
        along = row[kernel.COURSE_EAST] * point[paths.P_D_EAST] + row[kernel.COURSE_NORTH] * point[paths.P_D_NORTH]
        reverse = self._settings.reverse_prior
        ways = [1 if along > 0 else -1] if abs(along) > 0.5 else [1, -1]
        chosen = [(way, speed, sigma, True, (1.0 - reverse) / len(ways)) for way in ways]
        if (
            self._filter.at[State.ACCELEROMETER_BIAS] >= 0 or self._filter.signed
        ):  # only these can tell a train that is pushed
            chosen += [(-way, -speed, sigma, True, reverse / len(ways)) for way in ways]
        return chosen


def _settings_for(model: TrackModel, settings: Settings) -> Settings:
    """Fill in what the model says: the accuracy of its axis, and whether it has gradients."""
    if settings.model_sigma == 0.0:
        variance = 0.5 * (model.covariance_g[:, 0] + model.covariance_g[:, 3])
        variance = variance[np.isfinite(variance)]
        if len(variance):
            settings = replace(settings, model_sigma=math.sqrt(float(np.median(variance))))
    if not np.isfinite(model.height).any():
        settings = replace(settings, accelerometer_walk=settings.accelerometer_walk + settings.gradient_walk)
    return settings


def _records(n: int, records: int, versions: int) -> kernel.Records:
    """Room for the smoother's records; none when nothing is to be kept."""
    return kernel.Records(
        np.empty((records, n)),
        np.empty((records, n, n)),
        np.empty((records, kernel.RECORD_SIZE)),
        np.empty((versions, WINDOW), np.int64),
        np.empty((versions, WINDOW), np.int64),
        np.empty((versions, WINDOW)),
        np.empty(versions, np.int64),
        np.array([0, 0, int(records > 0)], np.int64),
    )


def _grown(records: kernel.Records) -> kernel.Records:
    """Twice the room of records and windows, what is there kept."""
    grown = []
    for array in records[:-1]:
        larger = np.empty((2 * len(array), *array.shape[1:]), array.dtype)
        larger[: len(array)] = array
        grown.append(larger)
    return kernel.Records(*grown, records.used)


def navigate(
    run: Run,
    model: TrackModel,
    *,
    smooth: bool = False,
    integrity_risk: float = 1e-4,
    settings: Settings | None = None,
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
        What is assumed of sensors and trains.
    progress : Progress, optional
        Called with a label, rows done and rows in all.

    Returns
    -------
    Solution
        One row an epoch. `track_probability` is the posterior of the row's track; below 0.95 the mode is ambiguous.
        `protection_level_along` bounds the error along the track over all hypotheses, also those on other tracks (their places are
        projected onto the row's track), so that it holds whichever track is right; that the track is right, it does not say.
        `sigma_cross` is the model's, or 0.5 m where the model states none (diagnostics: sigma_cross_assumed).

    Raises
    ------
    RunError
        The run has no GNSS fix.
    OffModelError
        No fix comes near the model.

    Notes
    -----
    Cost is linear: about 3 microseconds a GNSS epoch for one hypothesis, 8 with odometer and IMU.

    Examples
    --------
    >>> from railnav.simulation import demo_line, simulate
    >>> model = demo_line()
    >>> run, truth = simulate(model, seed=1)  # doctest: +SKIP
    """
    raw = raw_table(run)
    table = kernel_table(raw, model)
    gnss, odometer, imu = run.gnss, run.odometer, run.imu
    assert gnss is not None
    kind = "" if odometer is None or len(odometer) == 0 else "speed" if odometer.distance is None else "distance"
    navigator = Navigator(
        model,
        imu=imu is not None and len(imu) > 0,
        odometer=kind,
        speed=gnss.speed is not None,
        signed_odometer=odometer is not None and odometer.signed,
        lever_arm_b=gnss.lever_arm_b,
        integrity_risk=integrity_risk,
        settings=settings or Settings.of_receiver(gnss.receiver),
    )
    m = len(table)
    if smooth:
        n = navigator._bank.x.shape[1]
        navigator._records = _records(n, 2 * m + 2 * SLOTS, 8 * SLOTS)
    out = np.empty((m, kernel.OUTPUT_SIZE))
    stride = m if progress is None else max(2000, m // 50)
    done = 0
    while done < m:
        stop = min(done + stride, m)
        navigator._advance(table[:stop], out, done)
        done = stop
        if progress is not None:
            progress("navigate", done, m)
    if navigator._shared.common[kernel.C_STARTS] == 0.0:
        raise OffModelError(_distance_from(run, model, table))
    if smooth:
        _smooth(navigator, table, out, progress)
    return _solution(run, model, navigator, table, out, smooth)


def _distance_from(run: Run, model: TrackModel, table: FloatArray) -> str:
    """One line on how far from the model a run stays."""
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(np.isfinite(table[:, kernel.EAST]))
    usable = rows[table[rows, kernel.SIGMA_EAST] <= Settings().sigma_usable]
    if len(usable) == 0:
        return f"run {run.id!r}: every fix states a sigma above {Settings().sigma_usable:.0f} m; nothing to start from"
    chosen = usable[:: max(1, len(usable) // 2000)]
    tree = cKDTree(np.column_stack([model.easting, model.northing]))
    distance, _ = tree.query(table[chosen][:, [kernel.EAST, kernel.NORTH]])
    nearest = float(distance.min())
    text = f"{nearest / 1000:.1f} km" if nearest >= 1000 else f"{nearest:.0f} m"
    return f"run {run.id!r} never touches the model: its nearest fix lies {text} from the nearest track; is it the right model?"


def _smooth(navigator: Navigator, table: FloatArray, out: FloatArray, progress: Progress | None) -> None:
    """Replace filtered rows by smoothed ones, one unbroken stretch of hypotheses after the other, the last first."""
    from railnav.navigation import _smoothing as smoothing

    records, fil = navigator._records, navigator._filter
    used = int(records.used[0])
    if used == 0:
        return
    epoch_of = records.numbers[:used, kernel.R_EPOCH].astype(np.int64)
    m = len(table)
    n = records.x.shape[1]
    at = fil.at
    x, sigma = np.empty((m, n)), np.empty((m, 2))
    chain = np.full(m, -1, np.int64)
    other = np.full(m, -1, np.int64)
    track, way = np.empty(m, np.int64), np.empty(m, np.int64)
    filtered, rival = np.empty(m, np.int64), np.empty(m, np.int64)
    offset = np.empty(m)
    confidence = navigator.settings.track_confidence
    end = used
    while end > 0:
        last = int(epoch_of[end - 1])
        final = np.arange(np.searchsorted(epoch_of, last, side="left"), end)
        weight = np.exp(records.numbers[final, kernel.R_LOGW])
        weight /= weight.sum()
        # the winner: the heaviest hypothesis on the most probable track
        standing = np.array([_track_of(records, fil, r) for r in final.tolist()])
        mass = np.array([weight[standing == t].sum() for t in standing])
        best = int(np.lexsort((weight, np.round(mass, 12)))[-1])
        first = int(smoothing.lineage(records, int(final[best]), chain))
        smoothing.smooth_lineage(fil, records, table, chain, first, last, x, sigma)
        smoothing.place(fil, navigator._network.length, records, chain, first, last, x, track, way, offset)
        smoothing.tracks_of(fil, records, chain, first, last, filtered)
        rows = slice(first, last + 1)
        probability = np.zeros(last + 1 - first)
        for j, r in enumerate(final.tolist()):
            begin = int(smoothing.lineage(records, r, other))
            smoothing.tracks_of(fil, records, other, begin, last, rival)
            begin = max(begin, first)
            probability[begin - first :] += weight[j] * (rival[begin : last + 1] == filtered[begin : last + 1])
        out[rows, kernel.OUT_TRACK] = track[rows]
        out[rows, kernel.OUT_WAY] = way[rows]
        out[rows, kernel.OUT_DIRECTION] = way[rows]
        out[rows, kernel.OUT_OFFSET] = offset[rows]
        out[rows, kernel.OUT_SPEED] = x[rows, at[State.SPEED]]
        if at[State.ACCELERATION] >= 0:
            out[rows, kernel.OUT_ACCELERATION] = x[rows, at[State.ACCELERATION]]
        else:
            force = np.append(table[first + 1 : last + 1, kernel.FORCE], np.nan)
            chosen = chain[first + 1 : last + 1]
            pull = np.append(records.numbers[chosen, kernel.R_PULL], np.nan)
            acceleration = force - pull - x[rows, at[State.ACCELEROMETER_BIAS]]
            out[rows, kernel.OUT_ACCELERATION] = np.append(np.nan, acceleration[:-1])
        out[rows, kernel.OUT_SIGMA] = sigma[rows, 0]
        out[rows, kernel.OUT_SIGMA_SPEED] = sigma[rows, 1]
        out[rows, kernel.OUT_LEVEL] = fil.risk[1] * sigma[rows, 0]
        out[rows, kernel.OUT_PROBABILITY] = np.minimum(probability, 1.0)
        coasting = out[rows, kernel.OUT_FIX_AGE] > navigator.settings.coasting_after
        out[rows, kernel.OUT_MODE] = np.where(
            probability < confidence, Mode.AMBIGUOUS, np.where(coasting, Mode.COASTING, Mode.TRACKING)
        )
        end = int(np.searchsorted(epoch_of, first, side="left"))
        if progress is not None:
            progress("smooth", m - first, m)
    if progress is not None:
        progress("smooth", m, m)


def _track_of(records: kernel.Records, fil: kernel.Filter, record: int) -> int:
    """Track that a filtered record stands on."""
    version = int(records.numbers[record, kernel.R_VERSION])
    s = records.x[record, fil.at[State.POSITION]]
    begin = records.begin[version, 1 : records.count[version]]
    return int(records.track[version, int(np.searchsorted(begin, s, side="right"))])


#: Sigma across the track that is stated where the model states none, m.
UNKNOWN_SIGMA_CROSS = 0.5


def _solution(
    run: Run, model: TrackModel, navigator: Navigator, table: FloatArray, out: FloatArray, smooth: bool
) -> Solution:
    """Turn the kernel's table into a solution: geometry, chainage and geodetic coordinates in bulk."""
    m = len(out)
    track = out[:, kernel.OUT_TRACK].astype(np.int64)
    there = np.flatnonzero(track >= 0)
    on, where = track[there], out[there, kernel.OUT_OFFSET]
    columns = {name: np.full(m, np.nan) for name in ("easting", "northing", "height", "heading", "chainage", "cross")}
    columns.update({name: np.full(m, np.nan) for name in ("latitude", "longitude", "ellipsoidal_height")})
    way = out[:, kernel.OUT_WAY]
    assumed = False
    if len(there):
        where = np.clip(where, 0.0, navigator._network.length[on])
        first = model.offset[model.knot_start[:-1]][on]
        point = model.at(on, where + first)
        columns["easting"][there] = point.easting
        columns["northing"][there] = point.northing
        columns["height"][there] = point.height
        nose = np.where(way[there] > 0, 0.0, math.pi)
        columns["heading"][there] = np.mod(point.heading + nose, 2.0 * math.pi)
        columns["chainage"][there] = point.chainage
        latitude, longitude, height = model.frame.to_geodetic(point.easting, point.northing, point.height)
        columns["latitude"][there] = latitude
        columns["longitude"][there] = longitude
        columns["ellipsoidal_height"][there] = height
        sin, cos = np.sin(point.grid_bearing), np.cos(point.grid_bearing)
        # the knot before each offset, from one search over all tracks laid end to end
        lengths = navigator._network.length
        laid = np.append(0.0, np.cumsum(lengths + 1.0))
        knots = navigator._network.knots[:, paths.OFFSET] + np.repeat(laid[:-1], np.diff(model.knot_start))
        knot = np.clip(np.searchsorted(knots, laid[on] + where, side="right") - 1, 0, len(knots) - 1)
        ee, en, nn = (model.covariance_g[knot, i] for i in (0, 1, 3))
        variance = ee * cos**2 - 2.0 * en * sin * cos + nn * sin**2
        known = np.isfinite(variance) & (variance >= 0.0)
        assumed = not bool(known.all())
        columns["cross"][there] = np.where(known, np.sqrt(np.where(known, variance, 0.0)), UNKNOWN_SIGMA_CROSS)
    common = navigator._shared.common
    mode = out[:, kernel.OUT_MODE].astype(np.int64)
    diagnostics: dict[str, Any] = {
        "epochs": m,
        "fixes_used": int(common[kernel.C_FIXES]),
        "fixes_suspect": int(common[kernel.C_SUSPECT_FIXES]),
        "gnss_steps": int(common[kernel.C_STEPS]),
        "gnss_sigma_scale": float(common[kernel.C_SCALE]),
        "frame_offset_sigma_m": float(common[kernel.C_FRAME_SIGMA]),
        "frame_offset_m": _frame_offset(navigator),
        "wheel_slips": int(common[kernel.C_SLIPS]),
        "starts": int(common[kernel.C_STARTS]),
        "track_revisions": int(common[kernel.C_REVISIONS]),
        "modes": {kind.label: int((mode == kind).sum()) for kind in Mode},
        "sigma_cross_assumed": assumed,
        "settings": {field.name: getattr(navigator.settings, field.name) for field in fields(Settings)},
    }
    return Solution(
        track_id=model.track_id,
        line=model.line,
        time=table[:, kernel.TIME].copy(),
        track=track,
        offset=out[:, kernel.OUT_OFFSET].copy(),
        chainage=columns["chainage"],
        easting=columns["easting"],
        northing=columns["northing"],
        height=columns["height"],
        latitude=columns["latitude"],
        longitude=columns["longitude"],
        ellipsoidal_height=columns["ellipsoidal_height"],
        heading=columns["heading"],
        speed=out[:, kernel.OUT_SPEED].copy(),
        acceleration=out[:, kernel.OUT_ACCELERATION].copy(),
        sigma_along=out[:, kernel.OUT_SIGMA].copy(),
        sigma_cross=columns["cross"],
        protection_level_along=out[:, kernel.OUT_LEVEL].copy(),
        track_probability=out[:, kernel.OUT_PROBABILITY].copy(),
        mode=mode,
        running_direction=np.where(track >= 0, np.nan_to_num(out[:, kernel.OUT_DIRECTION]), 0.0).astype(np.int64),
        run_id=run.id,
        start=run.start.isoformat().replace("+00:00", "Z"),
        crs_wkt=model.frame.crs_wkt,
        integrity_risk=float(navigator._filter.risk[0]),
        smoothed=smooth,
        diagnostics=diagnostics,
    )


def _frame_offset(navigator: Navigator) -> list[float]:
    """Constant part of the GNSS error as the heaviest hypothesis holds it at the end: east, north, m; empty when none lives."""
    bank = navigator._bank
    live = bank.live[1 : 1 + bank.live[0]]
    if len(live) == 0:
        return []
    best = live[int(np.argmax(bank.logw[live]))]
    return [float(v) for v in bank.x[best, :2]]
