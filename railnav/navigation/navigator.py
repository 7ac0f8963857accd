"""The live navigator: one epoch in, one position out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import RunError
from railnav.matching.network import balises_of
from railnav.navigation import columns as c
from railnav.navigation.engine import Engine
from railnav.navigation.epochs import COLUMNS, IDLE_STEP, IMU_STEP, SAME_TIME, Epoch, LiveTable
from railnav.navigation.explanation import Candidate, candidates_now
from railnav.navigation.solution import Mode
from railnav.navigation.state import Settings

if TYPE_CHECKING:
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

_NUMBERS = COLUMNS[:-2]
_NO_BALISE = (math.nan, math.nan)


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
        What the navigator is doing.
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
        return float(self._model.at(self.track, self.offset).chainage)

    @property
    def grid(self) -> tuple[float, float, float]:
        """Easting, northing and height of the track axis, m; NaN where there is no position."""
        if self.track is None:
            return (math.nan, math.nan, math.nan)
        point = self._model.at(self.track, self.offset)
        return float(point.easting), float(point.northing), float(point.height)

    @property
    def geodetic(self) -> tuple[float, float, float]:
        """WGS 84 latitude and longitude, rad, and ellipsoidal height, m; NaN where there is no position."""
        if self.track is None:
            return (math.nan, math.nan, math.nan)
        latitude, longitude, height = self._model.frame.to_geodetic(*self.grid)
        return float(latitude), float(longitude), float(height)


class Navigator:
    """The live navigator: the same mathematics and the same inner loop as `navigate`, one epoch at a time.

    The state runs along the paths that the model permits (specification 19): each hypothesis owns a path, its place and speed on it,
    the sensors' errors, the square root of their covariance, and a weight. Before a turnout it is cloned for each lawful way; what
    the sensors say decides. A train that can be on several tracks is said to be (`mode` ambiguous), never placed on the nearest.

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
    receiver : str
        Kind of GNSS receiver; one that the model's survey knows is moved to the model's datum.
    balises : bool
        Whether the train has a balise reader: then a balise of the model that is passed and not read is evidence.
    patience : float
        How long an epoch may be under way, s: sensors may then come in any order, and what is said is that much older. 0: in order.
    integrity_risk : float
        Risk, per epoch, that the along-track error exceeds the protection level.
    settings : Settings, optional
        What is assumed of sensors and trains; by default `Settings.of_receiver`.

    Notes
    -----
    Memory is constant; a step takes some 25 microseconds. Leaving out a sensor that is not there makes it cheaper.

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
        receiver: str = "",
        balises: bool = False,
        patience: float = 0.0,
        integrity_risk: float = 1e-4,
        settings: Settings | None = None,
    ) -> None:
        self._engine = Engine(
            model,
            settings or Settings.of_receiver(receiver),
            imu=imu,
            odometer=odometer,
            speed=speed,
            signed_odometer=signed_odometer,
            lever_arm_b=lever_arm_b,
            integrity_risk=integrity_risk,
            receiver=receiver,
            balises=balises,
        )
        if not patience >= 0.0:
            raise ValueError(f"patience {patience} s is not a time")
        self._patience, self._waiting = patience, list[Epoch]()
        self._inertial, self._force, self._force_time = imu, math.nan, -math.inf
        self._latest = _nowhere(model)
        self._balises = balises_of(model)
        self._live = LiveTable(model.frame, self._engine.latitude)
        self._table = np.empty((1, c.EPOCH_SIZE))
        self._row = np.empty((1, c.OUTPUT_SIZE))

    @property
    def model(self) -> TrackModel:
        """The model that the train is held to."""
        return self._engine.model

    @property
    def settings(self) -> Settings:
        """What is assumed of sensors and trains, with what the model itself says filled in."""
        return self._engine.settings

    def candidates(self) -> tuple[Candidate, ...]:
        """All ways in which the train can have gone, most probable first, and what each kind of evidence has said of them."""
        return candidates_now(self._engine)

    def step(self, epoch: Epoch) -> Position:
        """Take in one epoch and say where the train is.

        Parameters
        ----------
        epoch : Epoch
            All that one instant brings, or what one sensor brings of it. With `patience`, epochs may come in any order within that
            time, those of one instant are put together, and what is said is of the newest instant that no epoch can precede any more.
            A gap is bridged in steps of at most 1 s.

        Returns
        -------
        Position

        Raises
        ------
        RunError
            The epoch is late: it belongs before what has been taken in already.
        """
        before = float(self._engine.shared.common[c.C_TIME])
        if not epoch.time > before:
            late = before - epoch.time
            raise RunError(
                f"epoch at {epoch.time} s is not later than the one before, at {before} s: {late:.3g} s late",
                remedy="sort the epochs, or give the navigator patience",
            )
        if self._patience <= 0.0:
            return self._take(epoch)
        self._waiting.append(epoch)
        newest = max(waiting.time for waiting in self._waiting)
        return self._take_until(newest - self._patience)

    def flush(self) -> Position:
        """Take in the epochs that are still waiting, and say where the train is."""
        return self._take_until(math.inf)

    def _take_until(self, time: float) -> Position:
        """Take in the waiting epochs up to a time, in order, those of one instant as one."""
        ready = sorted((e for e in self._waiting if e.time <= time), key=lambda e: e.time)
        self._waiting = [e for e in self._waiting if e.time > time]
        while ready:
            instant = [e for e in ready if e.time - ready[0].time <= SAME_TIME]
            ready = ready[len(instant) :]
            self._latest = self._take(_together(instant))
        return self._latest

    def _take(self, epoch: Epoch) -> Position:
        """Take in one epoch, all of it."""
        before = float(self._engine.shared.common[c.C_TIME])
        if self._inertial and not math.isfinite(epoch.forward_force):
            if epoch.time - self._force_time < 1.5 * IMU_STEP:  # a fix between two inertial samples
                epoch = replace(epoch, forward_force=self._force)
        elif self._inertial:
            self._force, self._force_time = epoch.forward_force, epoch.time
        balise = self._balises.get(epoch.balise, _NO_BALISE) if epoch.balise else _NO_BALISE
        table = self._table
        table[0] = self._live.row(epoch, balise)
        table[0, c.EAST] -= self._engine.frame.east
        table[0, c.NORTH] -= self._engine.frame.north
        out = self._row
        if 1.5 * IDLE_STEP < epoch.time - before < math.inf:
            steps = math.ceil((epoch.time - before) / IDLE_STEP - 1e-6)
            idle = np.full((steps, table.shape[1]), np.nan)
            idle[:-1, c.TIME] = before + IDLE_STEP * np.arange(1, steps)
            idle[-1] = table[0]
            table, out = idle, np.empty((steps, c.OUTPUT_SIZE))
        self._engine.advance(table, out)
        row = out[-1].tolist()
        track = int(row[c.OUT_TRACK])
        return Position(
            epoch.time,
            self.model.track_id[track] if track >= 0 else None,
            row[c.OUT_OFFSET],
            row[c.OUT_SPEED],
            row[c.OUT_ACCELERATION],
            row[c.OUT_SIGMA],
            row[c.OUT_LEVEL],
            row[c.OUT_PROBABILITY],
            Mode(int(row[c.OUT_MODE])),
            int(row[c.OUT_DIRECTION]) if track >= 0 else 0,
            self._alternatives(track),
            self.model,
        )

    def _alternatives(self, track: int) -> tuple[Alternative, ...]:
        """Tracks other than `track` that living hypotheses stand on."""
        living = self._engine.living()
        if len(living) < 2 and track >= 0:
            return ()
        best: dict[int, tuple[float, float, float]] = {}
        for slot in living:
            on, offset = self._engine.place(slot)
            if on == track:
                continue
            weight = float(self._engine.shared.weight[slot])
            total, most, where = best.get(on, (0.0, -1.0, offset))
            best[on] = (total + weight, max(most, weight), offset if weight > most else where)
        ordered = sorted(best.items(), key=lambda item: -item[1][0])
        return tuple(Alternative(self.model.track_id[t], where, total) for t, (total, _, where) in ordered)


def _together(instant: Sequence[Epoch]) -> Epoch:
    """What several sensors bring at one instant as one epoch; where two bring the same, the later one holds."""
    if len(instant) == 1:
        return instant[0]
    brought: dict[str, float | str] = {}
    for epoch in instant:
        for name in _NUMBERS[1:]:
            value = getattr(epoch, name)
            if math.isfinite(value):
                brought[name] = value
        if epoch.balise:
            brought["balise"] = epoch.balise
    return replace(Epoch(instant[-1].time), **brought)  # type: ignore[arg-type]


def _nowhere(model: TrackModel) -> Position:
    """What is said before anything has been taken in."""
    nan = math.nan
    return Position(-math.inf, None, nan, nan, nan, nan, nan, nan, Mode.INITIALISING, 0, (), model)
