"""A navigator of a few numbers: fixed gains in arc length on the model's tracks, for small computers; the interface of `Navigator`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import RunError
from railnav.navigation.epochs import SIGMA_PER_HDOP, UNSTATED_SIGMA, Epoch
from railnav.navigation.navigator import Alternative, Position
from railnav.navigation.solution import Mode
from railnav.navigation.state import Settings

if TYPE_CHECKING:
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

#: Hypotheses kept, and the probability below which one is dropped.
MOST, LEAST = 6, 1e-4
#: How often tracks nearby that no hypothesis holds are given one, s, and its prior odds.
RIVAL_STEP, RIVAL_PRIOR = 60.0, 0.01
_GRAVITY = 9.80665


@dataclass(frozen=True, slots=True)
class ArcGains:
    """Gains and limits of the corrector.

    Attributes
    ----------
    memory : float
        How long fixes count in place and speed, s: theta = exp(-T/memory), alpha = 1 - theta^3, beta = 1.5 (1 - theta^2)(1 - theta),
        gamma = (1 - theta)^3/2 (fading memory, critically damped).
    memory_alone : float
        The same where neither odometer nor accelerometer measures, s.
    memory_with_odometer : float
        The same where an odometer measures the way, s: alpha = 1 - theta^2, beta = (1 - theta)^2.
    speed_gain : float
        Share of a receiver's speed that is taken over each second.
    evidence_time : float
        Over which distances across are averaged before they speak for a track, s: errors that last are counted once, not at every fix.
    evidence_sigma : float
        Sigmas of a fix that such a mean is taken to be good for.
    confidence : float
        Probability from which a track is declared.
    coasting_after : float
        s without a fix.
    speed_sigma : float
        Sigma of the speed that grows to an error along while no fix comes, m/s.
    time_sigma, time_sigma_alone : float
        Of the stamps of the fixes, s: times the speed it is an error along; the second of loggers with GNSS alone, phones above all.
    way_sigma : float
        Share of the way run that an odometer may be wrong by.
    slip : float
        Difference between the speeds of wheels and receiver, and a twentieth of the speed on top, from which the wheels slip, m/s.
    lost_fixes : int
        Fixes in a row far from all hypotheses after which the place is given up.
    """

    memory: float = 10.0
    memory_alone: float = 4.0
    memory_with_odometer: float = 20.0
    speed_gain: float = 0.3
    evidence_time: float = 10.0
    evidence_sigma: float = 2.0
    confidence: float = 0.99
    coasting_after: float = 3.0
    speed_sigma: float = 0.4
    time_sigma: float = 0.06
    time_sigma_alone: float = 0.5
    way_sigma: float = 0.015
    slip: float = 1.5
    lost_fixes: int = 10


@dataclass(slots=True)
class _Place:
    """One hypothesis: where, which way the nose points, log of its prior weight, mean distance of the fixes across, log of its weight."""

    track: int
    offset: float
    way: int
    prior: float
    across: float = 0.0
    log_weight: float = 0.0


class ArcNavigator:
    """The live navigator for small computers: place, speed and an acceleration bias, corrected along the track with fixed gains.

    The arc-length corrector that replaces the source's literal one (e = s_GNSS - s, s + alpha e, v + beta e/T), on a network: before a
    turnout the place is doubled for each lawful way, and the distance of the fixes across decides. No covariance is carried: the stated
    sigma is that of a fix, as its error may last, and grows by rule without one.

    Parameters
    ----------
    model : TrackModel
        The reference model.
    odometer : str
        What epochs bring of an odometer: "distance", "speed" or "".
    lever_arm_b : (3,) array
        Reference point to antenna, forward, right, down, m; only its length along counts here.
    receiver : str
        Kind of GNSS receiver, as `Settings.of_receiver` knows it: what its stated sigmas are worth.
    integrity_risk : float
        Risk, per epoch, of the protection level.
    gains : ArcGains, optional

    Notes
    -----
    State: up to six places of five numbers, and a dozen more; some 200 multiplications an epoch, what a port to a small computer needs.
    In Python a step takes 30 microseconds, as much as the compiled filter of `Navigator`: use that where you can, it knows what its
    sensors are worth. A train is taken to move forward when it is first seen to move.

    References
    ----------
    `spec/rail.md` 13 (replacement corrector), 24.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> ArcNavigator(demo_line()).step(Epoch(0.0)).mode.label
    'initialising'
    """

    def __init__(
        self,
        model: TrackModel,
        *,
        odometer: str = "",
        lever_arm_b: ArrayLike = (0.0, 0.0, 0.0),
        receiver: str = "",
        integrity_risk: float = 1e-4,
        gains: ArcGains | None = None,
    ) -> None:
        if not 0.0 < integrity_risk < 0.5:
            raise ValueError(f"integrity_risk is {integrity_risk}; it must lie between 0 and 0.5")
        if odometer not in ("", "distance", "speed"):
            raise ValueError(f"odometer {odometer!r} is none of '', 'distance', 'speed'")
        from statistics import NormalDist

        self._model = model
        self._odometer = odometer
        self._arm = float(np.asarray(lever_arm_b, dtype=np.float64)[0])
        self._gains = gains or ArcGains()
        kind = Settings.of_receiver(receiver)
        self._worth = max(1.0, math.hypot(kind.scale_start, kind.gnss_frame_share))
        self._quantile = NormalDist().inv_cdf(1.0 - 0.5 * integrity_risk)
        self._risk = integrity_risk
        self._begin = model.offset[model.knot_start[:-1]].tolist()
        self._end = model.offset[model.knot_start[1:] - 1].tolist()
        self._next: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for a, end_a, b, end_b in model.movements.tolist():
            self._next.setdefault((a, end_a), []).append((b, end_b))
            self._next.setdefault((b, end_b), []).append((a, end_a))
        self._point = np.empty(8)
        self._places: list[_Place] = []
        self._time = -math.inf
        self._speed = self._bias = self._acceleration = 0.0
        self._distance = math.nan
        self._last_fix: tuple[float, float, float] | None = None  # time, easting, northing
        self._last_velocity: tuple[float, float] | None = None
        self._anchor: tuple[float, float, float] | None = None
        self._since_way = 0.0
        self._sigma = UNSTATED_SIGMA
        self._missed = 0
        self._rivals_at = -math.inf
        self._started = False
        self._aided = bool(odometer)
        self._slip_until, self._slip_speed = -math.inf, 0.0

    @property
    def model(self) -> TrackModel:
        """The model that the train is held to."""
        return self._model

    def step(self, epoch: Epoch) -> Position:
        """Take in one epoch and say where the train is.

        Parameters
        ----------
        epoch : Epoch
            Later than the one before.

        Returns
        -------
        Position

        Raises
        ------
        RunError
            The epoch is not later than the one before.
        """
        if not epoch.time > self._time:
            raise RunError(
                f"epoch at {epoch.time} s is not later than the one before, at {self._time} s", remedy="sort the epochs"
            )
        step = min(epoch.time - self._time, 3600.0)
        if self._places:
            self._predict(epoch, step)
        elif math.isfinite(epoch.distance):
            self._distance = epoch.distance
        self._time = epoch.time
        if math.isfinite(epoch.latitude) and math.isfinite(epoch.longitude):
            self._take_fix(epoch)
        return self._position()

    # ------------------------------------------------------------------ prediction

    def _predict(self, epoch: Epoch, step: float) -> None:
        """Move all places by what odometer or accelerometer say."""
        self._aided = self._aided or math.isfinite(epoch.forward_force)
        moved, before = None, self._speed
        if self._odometer == "distance" and math.isfinite(epoch.distance):
            if math.isfinite(self._distance):
                sign = -1.0 if self._speed < -0.1 else 1.0
                moved = sign * abs(epoch.distance - self._distance)
                self._speed = moved / step if step > 0.05 else self._speed
            self._distance = epoch.distance
            if epoch.time <= self._slip_until:  # wheels that slip: the receiver's speed stands in
                self._speed = self._slip_speed
                moved = self._speed * step
        elif self._odometer == "speed" and math.isfinite(epoch.wheel_speed):
            self._speed = epoch.wheel_speed
            moved = 0.5 * (before + self._speed) * step
        if moved is None:
            force = 0.0
            if self._odometer == "" and math.isfinite(epoch.forward_force):
                best = self._places[0]
                self._at(best.track, best.offset)
                slope = float(self._point[5]) * best.way
                force = epoch.forward_force - self._bias - _GRAVITY * slope / math.sqrt(1.0 + slope * slope)
            moved = self._speed * step + 0.5 * force * step * step
            self._speed += force * step
        self._acceleration += min(1.0, step) * ((self._speed - before) / step - self._acceleration)
        self._since_way += abs(moved)
        # what the odometer was seen to be wrong by
        drift = self._bias * step if self._odometer else 0.0
        kept: list[_Place] = []
        for place in self._places:
            place.offset += place.way * (moved + drift)
            kept += self._followed(place, 0)
        self._places = kept
        self._tidy()

    def _followed(self, place: _Place, depth: int) -> list[_Place]:
        """The place, or those that the permitted movements lead to when its track has ended."""
        begin, end = self._begin[place.track], self._end[place.track]
        if begin <= place.offset <= end:
            return [place]
        side = 1 if place.offset > end else 0  # which end of the track it leaves by
        over = place.offset - end if side else begin - place.offset
        ways = self._next.get((place.track, side), [])
        if not ways or depth > 8:
            if over > 30.0 + 3.0 * self._sigma:
                return []
            return [place]  # a buffer, or the model's edge: wait for the fixes
        forward = place.way if side else -place.way  # +1: the nose leads
        out = []
        for track, entry in ways:
            inward = 1 if entry == 0 else -1
            offset = self._begin[track] + over if entry == 0 else self._end[track] - over
            split = math.log(len(ways))
            after = _Place(track, offset, inward * forward, place.prior - split, place.across, place.log_weight - split)
            out += self._followed(after, depth + 1)
        return out

    # ------------------------------------------------------------------ correction

    def _take_fix(self, epoch: Epoch) -> None:
        easting, northing, _ = (float(c) for c in self._model.frame.to_grid(epoch.latitude, epoch.longitude, None))
        sigma = math.sqrt(0.5 * (epoch.sigma_east**2 + epoch.sigma_north**2))
        if not math.isfinite(sigma) or sigma <= 0.0:
            sigma = SIGMA_PER_HDOP * epoch.hdop if math.isfinite(epoch.hdop) else UNSTATED_SIGMA
        sigma *= self._worth
        last, self._last_fix = self._last_fix, (epoch.time, easting, northing)
        interval = epoch.time - last[0] if last is not None else 1.0
        if not self._places:
            self._acquire(epoch, easting, northing, sigma)
            return
        seen = []
        for place in self._places:
            along, cross = self._apart(place, easting, northing)
            seen.append((along - self._arm * place.way, cross))
        far = 6.0 * sigma + 20.0 + 0.1 * self._since_way
        good = [abs(a) < far and abs(c) < 4.0 * sigma + 10.0 for a, c in seen]
        if not any(good):
            self._missed += 1
            if self._missed >= self._gains.lost_fixes:
                self._places, self._missed = [], 0
            return
        self._missed, self._sigma, self._since_way = 0, sigma, 0.0
        share = 1.0 - math.exp(-interval / self._gains.evidence_time)
        for place, (_, cross) in zip(self._places, seen, strict=True):
            place.across += share * (cross - place.across)
            place.log_weight = place.prior - 0.5 * (place.across / (self._gains.evidence_sigma * sigma)) ** 2
        self._correct([a for a, _ in seen], min(interval, 10.0), epoch)
        if epoch.time - self._rivals_at >= RIVAL_STEP:
            self._rivals_at = epoch.time
            self._add_rivals(easting, northing, sigma)
            good += [True] * (len(self._places) - len(good))
        kept: list[_Place] = []
        for place, inside in zip(self._places, good, strict=True):
            if inside:
                kept += self._followed(place, 0)
        self._places = kept
        self._tidy()

    def _correct(self, along: list[float], interval: float, epoch: Epoch) -> None:
        """Fixed gains: each place by its own innovation, speed and bias by the best one's."""
        gains = self._gains
        best = max(range(len(along)), key=lambda i: self._places[i].log_weight)
        e = along[best] * self._places[best].way
        if self._odometer:
            if math.isfinite(epoch.speed) and abs(abs(self._speed) - epoch.speed) > gains.slip + 0.05 * epoch.speed:
                self._slip_until, self._slip_speed = (
                    epoch.time + interval + 0.5,
                    math.copysign(epoch.speed, self._speed),
                )
            theta = math.exp(-interval / gains.memory_with_odometer)
            alpha, beta = 1.0 - theta * theta, (1.0 - theta) ** 2
            self._bias += beta * e / interval  # of the odometer's speed, m/s
        else:
            theta = math.exp(-interval / (gains.memory if math.isfinite(epoch.forward_force) else gains.memory_alone))
            alpha = 1.0 - theta**3
            self._speed += 1.5 * (1.0 - theta * theta) * (1.0 - theta) * e / interval
            if math.isfinite(epoch.forward_force):
                self._bias -= (1.0 - theta) ** 3 * e / (interval * interval)
            if math.isfinite(epoch.speed):
                sign = -1.0 if self._speed < -0.5 else 1.0
                self._speed += min(1.0, gains.speed_gain * interval) * (sign * epoch.speed - self._speed)
        for place, a in zip(self._places, along, strict=True):
            place.offset += alpha * a

    def _add_rivals(self, easting: float, northing: float, sigma: float) -> None:
        """Give every track nearby that no place holds and that runs our way a faint one: the model may lack a crossover, or we may err."""
        best = max(self._places, key=lambda p: p.log_weight)
        self._at(best.track, best.offset)
        bearing = float(self._point[3]) + (0.0 if best.way > 0 else math.pi)
        held = {p.track for p in self._places}
        for candidate in self._model.locate(easting, northing, within=3.0 * sigma):
            track = self._model.track_index(candidate.track)
            if track in held:
                continue
            self._at(track, candidate.offset)
            agree = math.cos(float(self._point[3]) - bearing)
            if abs(agree) < 0.9:
                continue
            way = 1 if agree > 0 else -1
            place = _Place(track, candidate.offset - way * self._arm, way, best.prior + math.log(RIVAL_PRIOR))
            place.across = self._apart(place, easting, northing)[1]
            place.log_weight = place.prior - 0.5 * (place.across / (self._gains.evidence_sigma * sigma)) ** 2
            self._places.append(place)

    def _acquire(self, epoch: Epoch, easting: float, northing: float, sigma: float) -> None:
        """Begin on every track near a moving train's fix that runs its way."""
        if math.isfinite(epoch.speed) and math.isfinite(epoch.course):
            speed = epoch.speed
            bearing = epoch.course - float(self._model.frame.convergence(easting, northing))
        elif math.isfinite(epoch.speed) and epoch.speed < 2.0:
            return
        else:
            anchor = self._anchor
            if anchor is None or epoch.time - anchor[0] > 30.0:
                self._anchor, self._last_velocity = (epoch.time, easting, northing), None
                return
            interval = epoch.time - anchor[0]
            ve, vn = (easting - anchor[1]) / interval, (northing - anchor[2]) / interval
            speed, bearing = math.hypot(ve, vn), math.atan2(ve, vn)
            if speed * interval < max(3.0 * sigma, 10.0):
                return
            # one wild fix makes one wild speed: two in a row must agree
            before, self._last_velocity, self._anchor = self._last_velocity, (ve, vn), (epoch.time, easting, northing)
            if before is None or math.hypot(ve - before[0], vn - before[1]) > 0.3 * speed:
                return
        if speed < 2.0:
            return
        for candidate in self._model.locate(easting, northing, within=4.0 * sigma + 10.0):
            track = self._model.track_index(candidate.track)
            self._at(track, candidate.offset)
            agree = math.cos(float(self._point[3]) - bearing)
            if abs(agree) < 0.7:
                continue
            way = 1 if agree > 0 else -1
            place = _Place(track, candidate.offset - way * self._arm, way, 0.0)
            place.across = self._apart(place, easting, northing)[1]
            place.log_weight = -0.5 * (place.across / (self._gains.evidence_sigma * sigma)) ** 2
            self._places.append(place)
        if self._places:
            self._speed, self._bias, self._sigma, self._since_way = speed, 0.0, sigma, 0.0
            self._started = True
            self._rivals_at = epoch.time
            kept: list[_Place] = []
            for place in self._places:
                kept += self._followed(place, 0)
            self._places = kept
            self._tidy()

    # ------------------------------------------------------------------ geometry and bookkeeping

    def _at(self, track: int, offset: float) -> None:
        """Evaluate one place into `_point`."""
        from railnav.track._kernels import evaluate

        model = self._model
        evaluate(*model.knot_arrays, model.knot_start[track], model.knot_start[track + 1], offset, self._point)

    def _apart(self, place: _Place, easting: float, northing: float) -> tuple[float, float]:
        """Way along the track, in the sense of its offset, and distance across from a place to a fix, m; the curve is followed twice."""
        along, cross = 0.0, 0.0
        for _ in range(2):
            self._at(place.track, place.offset + along)
            e, n, bearing, scale = self._point[0], self._point[1], self._point[3], self._point[7]
            de, dn = easting - float(e), northing - float(n)
            s, c = math.sin(bearing), math.cos(bearing)
            along += (de * s + dn * c) / float(scale)
            cross = de * c - dn * s
        return along, cross

    def _tidy(self) -> None:
        """Weights that sum to 1, best place first, twins merged, hopeless ones dropped."""
        if not self._places:
            return
        self._places.sort(key=lambda p: -p.log_weight)
        kept: list[_Place] = []
        for place in self._places:
            for other in kept:
                if other.track == place.track and other.way == place.way and abs(other.offset - place.offset) < 10.0:
                    more = math.log1p(math.exp(min(0.0, place.log_weight - other.log_weight)))
                    other.log_weight += more
                    other.prior += more
                    break
            else:
                kept.append(place)
        kept = kept[:MOST]
        top = max(p.log_weight for p in kept)
        total = top + math.log(sum(math.exp(p.log_weight - top) for p in kept))
        for place in kept:
            place.log_weight -= total
            place.prior -= total
        self._places = [p for p in kept if p.log_weight > math.log(LEAST)]

    def _position(self) -> Position:
        model, gains = self._model, self._gains
        nothing = Position(
            self._time,
            None,
            math.nan,
            math.nan,
            math.nan,
            math.nan,
            math.nan,
            math.nan,
            Mode.INITIALISING,
            0,
            (),
            model,
        )
        if not self._places:
            return replace(nothing, mode=Mode.LOST) if self._started else nothing
        weight: dict[int, float] = {}
        for place in self._places:
            weight[place.track] = weight.get(place.track, 0.0) + math.exp(place.log_weight)
        best = self._places[0]
        since = self._time - (self._last_fix[0] if self._last_fix else self._time)
        grown = (
            gains.way_sigma * self._since_way if self._odometer else gains.speed_sigma * since + 0.025 * since * since
        )
        stamp = gains.time_sigma if self._aided else gains.time_sigma_alone
        sigma = math.hypot(self._sigma, grown, stamp * self._speed)
        probability = min(1.0, weight[best.track])
        mode = Mode.TRACKING
        if probability < gains.confidence:
            mode = Mode.AMBIGUOUS
        elif since > gains.coasting_after:
            mode = Mode.COASTING
        apart = 0.0
        if len(self._places) > 1:
            self._at(best.track, best.offset)
            e, n = float(self._point[0]), float(self._point[1])
            for other in self._places[1:]:
                if math.exp(other.log_weight) > self._risk:
                    self._at(other.track, other.offset)
                    apart = max(apart, math.hypot(float(self._point[0]) - e, float(self._point[1]) - n))
        offset = min(max(best.offset, self._begin[best.track]), self._end[best.track])
        rivals = {p.track: p.offset for p in reversed(self._places) if p.track != best.track}
        return Position(
            self._time,
            model.track_id[best.track],
            offset,
            self._speed,
            self._acceleration,
            sigma,
            self._quantile * sigma + apart,
            probability,
            mode,
            best.way,
            tuple(
                Alternative(model.track_id[t], rivals[t], weight[t]) for t in sorted(rivals, key=lambda t: -weight[t])
            ),
            model,
        )
