"""The filter with its tables: what the live navigator and the offline run share."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.matching import _kernels as paths
from railnav.matching.candidates import starting_candidates
from railnav.matching.network import pack_network
from railnav.navigation import _kernels as kernel
from railnav.navigation import columns as c
from railnav.navigation.epochs import kernel_table
from railnav.navigation.integrity import normal_quantile
from railnav.navigation.prior import USUAL, frame_prior, usual_directions
from railnav.navigation.shape import shape_of
from railnav.navigation.state import Settings, State, layout

if TYPE_CHECKING:
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Hypotheses that fit at a time (more than are kept, for those at a start or a fan of turnouts), and tracks in a window.
SLOTS, WINDOW = 48, 12
#: When the older and the newer dead reckoning of a hypothesis began.
_CHECKS = [paths.CHECK + paths.CHECK_TIME, paths.CHECK + paths.CHECK_SIZE + paths.CHECK_TIME]
#: Most that a rival can gain or lose by the GNSS error that the train on its track would have, nat.
RIVAL_CREDIT = 6.0
#: Prior odds of a place that a balise shows and no hypothesis is near.
BALISE_PRIOR = 5e-9
#: A model's error across its tracks beyond this is estimated, m; what is smaller counts towards the constant part.
MAP_ERROR_LEAST = 0.1
#: How near to a start a track may begin that the train may be making for, m, and how often such tracks are looked for, s.
LOOSE_REACH, LOOSE_INTERVAL = 1000.0, 5.0


class Engine:
    """All hypotheses of one run on one model.

    Parameters
    ----------
    model : TrackModel
    settings : Settings
    imu, odometer, speed, signed_odometer, lever_arm_b, receiver, integrity_risk, balises
        As for `railnav.navigation.Navigator`.
    records : int
        Room for the smoother's records, to begin with; 0 keeps none.
    journal : int
        What is written down of candidates: 0 nothing, 1 decisions, 2 alternatives, 3 both.
    """

    __slots__ = (
        "_component",
        "_loose",
        "_unseen",
        "bank",
        "filter",
        "frame",
        "journal",
        "latitude",
        "model",
        "network",
        "records",
        "settings",
        "shared",
        "usual",
        "work",
    )

    def __init__(
        self,
        model: TrackModel,
        settings: Settings,
        *,
        imu: bool,
        odometer: str,
        speed: bool,
        signed_odometer: bool,
        lever_arm_b: ArrayLike,
        integrity_risk: float,
        receiver: str = "",
        balises: bool = False,
        records: int = 0,
        journal: int = 0,
    ) -> None:
        if not 0.0 < integrity_risk < 1.0:
            raise ValueError(f"integrity_risk {integrity_risk} is not between 0 and 1")
        if odometer not in ("distance", "speed", ""):
            raise ValueError(f"odometer {odometer!r} is not 'distance', 'speed' or ''")
        self.model = model
        self.frame = frame_prior(model, receiver)
        self.usual = usual_directions(model)
        self._component = _components(model)
        self.settings = _settings_for(model, settings)
        if self.frame.sigma > 0.0:
            self.settings = replace(
                self.settings,
                model_sigma=math.hypot(self.settings.model_sigma, self.frame.sigma),
                gnss_frame_share=0.0 if self.frame.known else self.settings.gnss_frame_share,
            )
        self.network = pack_network(model)
        shape = shape_of(model, self.network, gravity=self.settings.gravity)
        self.network.knots[:, paths.CURVATURE] = shape.curvature
        assumed = np.where(np.isnan(shape.sigma_curvature), self.settings.curvature_sigma, shape.sigma_curvature)
        self.network = self.network._replace(sigma_bend=assumed)
        self.settings = replace(
            self.settings,
            accelerometer_noise=math.hypot(self.settings.accelerometer_noise, shape.force_noise),
            curvature_length=self.settings.curvature_length if math.isnan(shape.length) else shape.length,
            curvature_shift=self.settings.curvature_shift if math.isnan(shape.shift) else shape.shift,
        )
        self._loose = _loose_ends(model, self.network)
        self._unseen: dict[int, float] = {}
        middle, _, _ = model.frame.to_geodetic(model.easting[[0, -1]].mean(), model.northing[[0, -1]].mean(), None)
        self.latitude = float(middle)
        map_error = bool(len(self.network.sigma_cross)) and np.quantile(self.network.sigma_cross, 0.9) > MAP_ERROR_LEAST
        if map_error:
            self.settings = replace(
                self.settings,
                position_doubt=min(100.0 * self.settings.position_doubt, 0.1),
                evidence_memory=self.settings.evidence_memory / 3.0,
            )
        at = layout(imu=imu, odometer=odometer, speed=speed, map_error=bool(map_error))
        n = int(at.max()) + 1
        self.filter = c.Filter(
            at,
            self.settings.packed(),
            np.array(lever_arm_b, np.float64).reshape(3),
            np.array([integrity_risk, normal_quantile(integrity_risk), _fault_quantile(integrity_risk, self.settings)]),
            int(signed_odometer),
            float(np.median(self.network.sigma_cross)),
            int(balises),
            shape.slope,
            shape.turned,
            int(shape.canted),
        )
        self.bank = paths.Bank(
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
        common = np.zeros(c.COMMON_SIZE)
        never = [
            c.C_TIME,
            c.C_FIX_TIME,
            c.C_TRY,
            c.C_WHEEL_SEEN,
            c.C_GNSS_SPEED_TIME,
            c.C_DISTRUST,
            c.C_BALISE_TIME,
            c.C_ALONG_TIME,
        ]
        common[[*never, c.C_YAW_DISTRUST, c.C_BLAMED, c.C_RESCALED]] = -np.inf
        common[[c.C_WHEEL_MOVED, c.C_GNSS_STILL]] = np.inf
        common[c.C_SCALE] = self.settings.scale_start
        common[[c.C_LAST_EAST, c.C_LAST_FORCE, c.C_LAST_SIDE, c.C_LAST_YAW]] = np.nan
        common[[c.C_OUT_TRACK, c.C_TOLD_TRACK]] = -1.0
        ring = np.column_stack([np.full(c.RING, -np.inf), np.full(c.RING, np.nan)])
        self.shared = c.Shared(common, ring, np.zeros(SLOTS))
        self.work = c.Work(
            np.zeros((n, n)),
            np.zeros((c.NOISES, n)),
            np.zeros(c.NOISES, np.int64),
            np.zeros((7, n)),
            np.zeros((SLOTS, paths.POINT_SIZE + 1)),
            np.zeros(paths.POINT_SIZE + 1),
            np.zeros(4),
            np.zeros((SLOTS, 4, n)),
            np.zeros((SLOTS, 7)),
            np.zeros((SLOTS, c.SLOT_SIZE)),
            np.zeros((3, SLOTS)),
        )
        self.records = _records(n, records)
        self.journal = c.Journal(np.empty((1000 if journal else 0, c.JOURNAL_SIZE)), np.array([0, journal], np.int64))

    @property
    def states(self) -> int:
        """Length of the state vector."""
        return int(self.bank.x.shape[1])

    def advance(self, table: FloatArray, out: FloatArray, first: int = 0) -> None:
        """Work through the rows of an epoch table from `first`, starting hypotheses and making room where the loop asks for it."""
        while True:
            first, why = kernel.run(
                self.filter,
                self.network,
                self.shared,
                self.bank,
                self.work,
                self.records,
                self.journal,
                table,
                first,
                out,
            )
            if why == c.DONE:
                return
            if why == c.NEEDS_ROOM:
                if self.records.used[2] == 1:
                    self.records = _grown(self.records)
                if self.journal.used[1] > 0:
                    self.journal = c.Journal(_doubled(self.journal.lines), self.journal.used)
            elif why == c.NEEDS_BALISE:
                self._find_by_balise(table[first])
            elif why == c.NEEDS_RIVALS:
                self._give_rivals(table[first])
            else:
                self._start(table[first])

    def table(self, raw: FloatArray) -> FloatArray:
        """Raw epochs as the loop reads them; see `railnav.navigation.epochs.kernel_table`."""
        table = kernel_table(raw, self.model.frame, self.latitude)
        table[:, c.EAST] -= self.frame.east
        table[:, c.NORTH] -= self.frame.north
        return table

    def living(self) -> list[int]:
        """Slots of the living hypotheses."""
        slots: list[int] = self.bank.live[1 : 1 + self.bank.live[0]].tolist()
        return slots

    def place(self, slot: int) -> tuple[int, float]:
        """Track and offset of a living hypothesis."""
        bank = self.bank
        i = int(bank.tags[slot, paths.CURRENT])
        track = int(bank.track[slot, i])
        length = float(self.network.length[track])
        position = float(bank.x[slot, self.filter.at[State.POSITION]])
        local = min(max(position - float(bank.begin[slot, i]), 0.0), length)
        return track, local if bank.way[slot, i] > 0 else length - local

    def _start(self, row: FloatArray) -> None:
        """Put a hypothesis on every track near a fix, for each direction that speed and course leave open."""
        common, bank, settings = self.shared.common, self.bank, self.settings
        time = float(row[c.TIME])
        common[c.C_TRY] = time
        sigma = float(max(row[c.SIGMA_EAST], row[c.SIGMA_NORTH]))
        found = starting_candidates(
            self.model,
            self.network,
            float(row[c.EAST]),
            float(row[c.NORTH]),
            within=max(50.0, 4.0 * sigma),
            overhang=2.0 * sigma + 5.0,
        )
        common[c.C_NOTHING_NEAR] = float(not found)
        if not found:
            return
        frame = math.hypot(settings.gnss_frame_share * sigma, settings.model_sigma)
        frame = min(max(frame, settings.frame_sigma_least), settings.frame_sigma_most)
        common[c.C_FRAME_SIGMA] = max(frame, common[c.C_FRAME_SIGMA])
        common[c.C_FRAME_TIME] = time + 60.0
        common[[c.C_FRESH, c.C_STARTED]] = 1.0
        common[c.C_STARTS] += 1.0
        common[[c.C_SUSPECTS, c.C_STOOD]] = 0.0
        common[c.C_RIVAL_TIME] = time
        common[[c.C_FIX_TIME, c.C_TIME, c.C_START_TIME]] = time
        speed, sigma_speed = float(row[c.GNSS_SPEED]), float(row[c.SIGMA_SPEED])
        if not sigma_speed > 0.0:
            sigma_speed = settings.speed_sigma
        paths.drop_all(bank)
        point = np.empty(paths.POINT_SIZE)
        total = 0.0
        for start in found:
            paths.track_point(self.network, start.track, 1, start.offset, point)
            for way, v, sigma_v, moved, prior in self._directions(row, point, speed, sigma_speed):
                h = paths.take_slot(bank)
                if h < 0:
                    return
                local = start.offset if way > 0 else float(self.network.length[start.track]) - start.offset
                self._seed(h, local, v, sigma, sigma_v)
                if usual := int(self.usual[start.track]):
                    prior *= USUAL if way == usual else 1.0 - USUAL
                total += prior
                bank.logw[h] = math.log(prior)
                bank.track[h, 0], bank.way[h, 0], bank.begin[h, 0] = start.track, way, 0.0
                bank.armed[h] = 0
                bank.tags[h] = 0
                bank.tags[h, paths.COUNT] = 1
                bank.tags[h, [paths.RECORD, paths.VERSION]] = -1
                bank.tags[h, paths.MOVED] = int(moved)
                bank.tags[h, paths.SIGN] = 1 if v >= 0.0 else -1
                bank.info[h] = 0.0
                bank.info[h, [paths.SLIP_SINCE, paths.AGREE_SINCE]] = -np.inf
                bank.info[h, paths.ASTRAY] = -np.inf
                bank.info[h, paths.MISSING_ODDS] = -np.inf
                bank.info[h, [paths.ASTRAY_VARIANCE, paths.OFFSET_VARIANCE, paths.TURN_TRACK]] = -1.0
                bank.info[h, paths.TURN_PLACE] = np.inf
                bank.info[h, _CHECKS] = np.inf, -np.inf
                bank.info[h, paths.BY_PATH] = math.log(prior)
                bank.info[h, paths.PASSED] = local
            bank.info[h, _CHECKS] = np.inf, -np.inf

        self._foresee(row, {start.track for start in found}, total)

    def _foresee(self, row: FloatArray, found: set[int], total: float) -> None:
        """Weigh tracks that begin near a start and hold no candidate: the train may be on its way to them, outside the model.

        Until it has come alongside them or gone elsewhere, that share of the probability belongs to no candidate.
        """
        distance = np.hypot(self._loose[:, 2] - row[c.EAST], self._loose[:, 3] - row[c.NORTH])
        self._unseen = {}
        for track, way, *_ in self._loose[distance < LOOSE_REACH].tolist():
            if int(track) not in found:
                usual = int(self.usual[int(track)])
                prior = 1.0 if usual == 0 else USUAL if usual == int(way) else 1.0 - USUAL
                self._unseen[int(track)] = prior / total
        self._share_unseen(row)

    def _share_unseen(self, row: FloatArray) -> None:
        """State the probability of tracks not met yet; look for them often while there are any."""
        odds = sum(self._unseen.values())
        self.shared.common[c.C_UNSEEN] = odds / (1.0 + odds)
        if self._unseen:
            self.shared.common[c.C_RIVAL_TIME] = float(row[c.TIME]) - c.RIVAL_INTERVAL + LOOSE_INTERVAL

    def _give_rivals(self, row: FloatArray) -> None:
        """Put a faint hypothesis on every track near the fix that no hypothesis holds.

        A train may have been out of reach of its track when the navigator started, or have crossed over where the model has no
        turnout. A rival takes over the best hypothesis' motion; what that one thinks of the GNSS error it does not believe. It is
        worth `rival_prior`, less where the model leads from track to track: there a train would have been seen to cross; times how
        much likelier the GNSS error is if the train is here rather than there.
        """
        common, bank, settings = self.shared.common, self.bank, self.settings
        common[c.C_RIVAL_TIME] = float(row[c.TIME])
        if bank.live[0] >= int(settings.most_hypotheses):
            return
        living = self.living()
        held = {self.place(h)[0] for h in living}
        best = max(living, key=lambda h: (float(bank.logw[h]), -h))
        track, offset = self.place(best)
        point = np.empty(paths.POINT_SIZE)
        paths.track_point(self.network, track, 1, offset, point)
        bearing = point[[paths.P_D_EAST, paths.P_D_NORTH]] * float(bank.way[best, bank.tags[best, paths.CURRENT]])
        around = 3.0 * math.hypot(common[c.C_FRAME_SIGMA], common[c.C_SCALE] * float(row[c.SIGMA_EAST]))
        found = starting_candidates(
            self.model,
            self.network,
            float(point[paths.P_EAST]),
            float(point[paths.P_NORTH]),
            within=min(max(around, 5.0), 30.0),
            overhang=0.0,
        )
        here = point[[paths.P_EAST, paths.P_NORTH]].copy()
        at = self.filter.at
        blind = [
            int(at[s])
            for s in (State.FRAME_EAST, State.FRAME_NORTH, State.GNSS_EAST, State.GNSS_NORTH, State.MAP_CROSS)
            if at[s] >= 0
        ]
        spread = common[c.C_SCALE] * settings.gnss_correlated_share * row[[c.SIGMA_EAST, c.SIGMA_NORTH]]
        error = bank.x[best, blind[:2]] + spread * bank.x[best, blind[2:4]]
        for start in found:
            linked = self._component[start.track] == self._component[track]
            if start.track in held and linked:
                continue
            paths.track_point(self.network, start.track, 1, start.offset, point)
            way = 1 if float(bearing @ point[[paths.P_D_EAST, paths.P_D_NORTH]]) > 0.0 else -1
            usual = {0: 1.0, way: USUAL, -way: 1.0 - USUAL}[int(self.usual[start.track])]
            before = int(self.usual[track])
            usual /= 1.0 if before == 0 else USUAL if before == self._way(best) else 1.0 - USUAL
            error_there = error + here - point[[paths.P_EAST, paths.P_NORTH]]
            variance = spread**2 + common[c.C_FRAME_SIGMA] ** 2 + point[paths.P_SIGMA_CROSS] ** 2
            likelier = float(np.clip(0.5 * np.sum((error**2 - error_there**2) / variance), -RIVAL_CREDIT, RIVAL_CREDIT))
            odds = self._unseen.pop(start.track, 0.0) or settings.rival_prior * (0.01 if linked else 1.0) * usual
            weight = float(bank.logw[best]) + likelier + math.log(odds)
            if start.track in held:  # a train may have crossed over where the model has no turnout
                there = max((g for g in living if self.place(g)[0] == start.track), key=lambda g: float(bank.logw[g]))
                raised = float(np.logaddexp(bank.logw[there], weight)) - float(bank.logw[there])
                bank.info[there, paths.BY_PATH] += raised
                bank.logw[there] += raised
                continue
            h = paths.take_slot(bank)
            if h < 0:
                return
            local = start.offset if way > 0 else float(self.network.length[start.track]) - start.offset
            P = bank.P_sqrt[best] @ bank.P_sqrt[best].T
            P[blind, :] = P[:, blind] = 0.0
            P[blind[:2], blind[:2]] = common[c.C_FRAME_SIGMA] ** 2
            P[blind[2:], blind[2:]] = 1.0
            P[at[State.POSITION], at[State.POSITION]] += 1.0
            x = bank.x[best].copy()
            x[blind] = 0.0
            x[at[State.POSITION]] = local
            bank.x[h], bank.P_sqrt[h] = self._believing(x, P, error_there, spread, point)
            bank.logw[h] = weight
            bank.track[h, 0], bank.way[h, 0], bank.begin[h, 0] = start.track, way, 0.0
            bank.armed[h] = 0
            bank.tags[h] = bank.tags[best]
            bank.tags[h, [paths.COUNT, paths.CURRENT]] = 1, 0
            bank.tags[h, [paths.RECORD, paths.VERSION]] = -1
            bank.info[h] = bank.info[best]
            bank.info[h, paths.BELIEVED] += likelier
            bank.info[h, paths.ASTRAY_VARIANCE] = -1.0
            bank.info[h, [paths.TURN_PLACE, paths.TURNED]] = np.inf, 0.0
            aside = here - point[[paths.P_EAST, paths.P_NORTH]]
            bank.info[h, paths.OFFSET_CROSS] += (aside[0] * bearing[1] - aside[1] * bearing[0]) / math.hypot(*bearing)
            bank.info[h, paths.BY_PATH] += math.log(odds)
            bank.info[h, paths.PASSED] = local
            bank.info[h, _CHECKS] = np.inf, -np.inf
            bank.info[h, paths.BY_POSITION] += likelier
        if self._unseen:
            away = np.hypot(self._loose[:, 2] - here[0], self._loose[:, 3] - here[1])
            near = set(self._loose[away < 2.0 * LOOSE_REACH, 0].astype(int).tolist())
            self._unseen = {t: odds for t, odds in self._unseen.items() if t in near and t not in held}
        if common[c.C_UNSEEN] > 0.0:
            self._share_unseen(row)

    def _find_by_balise(self, row: FloatArray) -> None:
        """Put a hypothesis on a balise that is read and that no hypothesis is near: the navigator is lost, or the reading is wrong.

        It takes over the best hypothesis' motion and sensor errors and is worth little; the others lose more by the reading.
        """
        bank, at = self.bank, self.filter.at
        track, offset = int(row[c.BALISE_TRACK]), float(row[c.BALISE_OFFSET])
        living = self.living()
        best = max(living, key=lambda h: (float(bank.logw[h]), -h), default=-1)
        if best < 0 or len(living) > int(self.settings.most_hypotheses):
            return
        for way in (1, -1):
            h = paths.take_slot(bank)
            if h < 0:
                return
            local = offset if way > 0 else float(self.network.length[track]) - offset
            P = bank.P_sqrt[best] @ bank.P_sqrt[best].T
            i_s = int(at[State.POSITION])
            P[i_s, :] = P[:, i_s] = 0.0
            P[i_s, i_s] = 25.0
            bank.x[h] = bank.x[best]
            bank.x[h, i_s] = local
            bank.P_sqrt[h] = np.linalg.cholesky(P + 1e-12 * np.eye(len(P)))
            bank.logw[h] = bank.logw[best] + math.log(0.5 * BALISE_PRIOR)
            bank.track[h, 0], bank.way[h, 0], bank.begin[h, 0] = track, way, 0.0
            bank.armed[h] = 0
            bank.tags[h] = bank.tags[best]
            bank.tags[h, [paths.COUNT, paths.CURRENT]] = 1, 0
            bank.tags[h, [paths.RECORD, paths.VERSION]] = -1
            bank.info[h] = bank.info[best]
            bank.info[h, paths.BY_PATH] += math.log(0.5 * BALISE_PRIOR)
            bank.info[h, [paths.ASTRAY_VARIANCE, paths.OFFSET_VARIANCE]] = -1.0
            bank.info[h, [paths.TURN_PLACE, paths.TURNED]] = np.inf, 0.0
            bank.info[h, paths.PASSED] = local
            bank.info[h, _CHECKS] = np.inf, -np.inf

    def _believing(
        self, x: FloatArray, P: FloatArray, error: FloatArray, spread: FloatArray, point: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """State and root of a rival told the GNSS error that the train on its track has: what its credit has paid for already."""
        at = self.filter.at
        across = point[paths.P_SIGMA_CROSS] / math.hypot(point[paths.P_D_EAST], point[paths.P_D_NORTH])
        normal = across * np.array([point[paths.P_D_NORTH], -point[paths.P_D_EAST]])
        for axis in range(2):
            row = np.zeros(len(x))
            row[at[State.FRAME_EAST] + axis] = 1.0
            row[at[State.GNSS_EAST] + axis] = spread[axis]
            if at[State.MAP_CROSS] >= 0:
                row[at[State.MAP_CROSS]] = normal[axis]
            column = P @ row
            gain = column / (row @ column + (0.3 * spread[axis]) ** 2)
            x = x + gain * (error[axis] - row @ x)
            P = P - np.outer(gain, column)
        return x, np.asarray(np.linalg.cholesky(0.5 * (P + P.T)), np.float64)

    def _way(self, slot: int) -> int:
        """Direction in which a hypothesis' nose points on its track."""
        return int(self.bank.way[slot, self.bank.tags[slot, paths.CURRENT]])

    def _seed(self, slot: int, local: float, v: float, sigma: float, sigma_v: float) -> None:
        """Fill state and covariance root of a new hypothesis."""
        settings, bank, at, common = self.settings, self.bank, self.filter.at, self.shared.common
        sd = np.ones(len(State))
        sd[[State.FRAME_EAST, State.FRAME_NORTH]] = common[c.C_FRAME_SIGMA]
        sd[State.TIME_TAG] = settings.time_tag_sigma
        sd[State.SPEED_LATENCY] = settings.speed_latency
        sd[State.ODOMETER_SCALE] = settings.odometer_scale
        sd[State.GYRO_BIAS] = settings.gyro_bias
        sd[State.GYRO_TILT] = settings.gyro_tilt
        sd[State.SIDE_BIAS] = settings.side_bias
        sd[State.ACCELEROMETER_BIAS] = settings.accelerometer_bias
        sd[State.ACCELERATION] = settings.acceleration_sigma
        sd[State.SPEED] = sigma_v
        # as good as no prior along the track: the fix itself is let in next
        scale = math.hypot(common[c.C_SCALE], settings.gnss_white_share)
        sd[State.POSITION] = 3.0 * math.hypot(scale * sigma, common[c.C_FRAME_SIGMA]) + 5.0
        reading = self.shared.ring[(int(common[c.C_RING]) - 1) % c.RING, 1]
        sd[State.WHEEL_DISTANCE] = 100.0
        x = np.zeros(len(State))
        x[State.SPEED] = v
        x[State.POSITION] = local
        x[State.WHEEL_DISTANCE] = reading if math.isfinite(reading) else 0.0
        bank.x[slot] = x[at >= 0]
        bank.P_sqrt[slot] = np.diag(sd[at >= 0])

    def _directions(
        self, row: FloatArray, point: FloatArray, speed: float, sigma_speed: float
    ) -> list[tuple[int, float, float, bool, float]]:
        """Directions of the nose worth a hypothesis on a track, with speed, its sigma, whether it moves, and the prior."""
        sigma = math.hypot(sigma_speed, 0.5)
        if not math.isfinite(speed):
            return [(1, 0.0, 20.0, False, 0.5), (-1, 0.0, 20.0, False, 0.5)]
        if speed < max(1.0, 3.0 * sigma_speed):
            return [(1, 0.0, sigma + speed, False, 0.5), (-1, 0.0, sigma + speed, False, 0.5)]
        along = row[c.COURSE_EAST] * point[paths.P_D_EAST] + row[c.COURSE_NORTH] * point[paths.P_D_NORTH]
        reverse = self.settings.reverse_prior
        ways = [1 if along > 0 else -1] if abs(along) > 0.5 else [1, -1]
        chosen = [(way, speed, sigma, True, (1.0 - reverse) / len(ways)) for way in ways]
        if (
            self.filter.at[State.ACCELEROMETER_BIAS] >= 0 or self.filter.signed
        ):  # only these tell a train that is pushed
            chosen += [(-way, -speed, sigma, True, reverse / len(ways)) for way in ways]
        return chosen


def _fault_quantile(risk: float, settings: Settings) -> float:
    """Two-sided quantile at the risk over the probability of a GNSS fault; 0 where that is not reckoned with."""
    return normal_quantile(risk / settings.gnss_fault) if settings.gnss_fault > risk else 0.0


def _settings_for(model: TrackModel, settings: Settings) -> Settings:
    """Fill in what the model says: the accuracy of its axis, and whether it has gradients."""
    if settings.model_sigma == 0.0:
        variance = 0.5 * (model.covariance_g[:, 0] + model.covariance_g[:, 3])
        variance = variance[np.isfinite(variance)]
        if len(variance):
            settings = replace(settings, model_sigma=min(math.sqrt(float(np.median(variance))), MAP_ERROR_LEAST))
    if not np.isfinite(model.height).any():
        settings = replace(settings, accelerometer_walk=settings.accelerometer_walk + settings.gradient_walk)
    return settings


def _components(model: TrackModel) -> IntArray:
    """Connected part of the network that each track belongs to."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    t, m = len(model.track_id), model.movements
    links = coo_array((np.ones(len(m)), (m[:, 0], m[:, 2])), shape=(t, t))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


def _doubled(array: NDArray[Any]) -> NDArray[Any]:
    """Twice the room, what is there kept."""
    larger = np.empty((2 * len(array), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


def _loose_ends(model: TrackModel, network: paths.Network) -> FloatArray:
    """Ends of the model where a train may come in, (k, 5): track, way in, easting, northing, knot's usual direction not applied."""
    t = len(model.track_id)
    free = (np.diff(network.move_start) == 0) & (network.stop == 0)
    ends = np.flatnonzero(free)
    track, end = ends // 2, ends % 2
    knot = np.where(end == 0, model.knot_start[:-1][track], model.knot_start[1:][track] - 1)
    assert len(free) == 2 * t
    return np.column_stack([track, 1 - 2 * end, model.easting[knot], model.northing[knot]]).astype(np.float64)


def _records(n: int, records: int) -> c.Records:
    """Room for the smoother's records and the windows they refer to; none when nothing is to be kept."""
    versions = 8 * SLOTS if records else 0
    return c.Records(
        np.empty((records, n)),
        np.empty((records, n, n)),
        np.empty((records, c.RECORD_SIZE)),
        np.empty((versions, WINDOW), np.int64),
        np.empty((versions, WINDOW), np.int64),
        np.empty((versions, WINDOW)),
        np.empty(versions, np.int64),
        np.array([0, 0, int(records > 0), 0], np.int64),
        np.empty((versions, 3)),
    )


def _grown(records: c.Records) -> c.Records:
    """Twice the room of records and windows, what is there kept."""
    return c.Records(
        _doubled(records.x),
        _doubled(records.P_sqrt),
        _doubled(records.numbers),
        _doubled(records.track),
        _doubled(records.way),
        _doubled(records.begin),
        _doubled(records.tracks),
        records.used,
        _doubled(records.joins),
    )
