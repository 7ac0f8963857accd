"""One coordinate of all tracks that new runs pass: how they err, what has moved, and the stored chains refined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.survey import surveyed
from railnav.survey.axis import ErrorModel, solve, sweep
from railnav.survey.changes import find_changes, mask, set_aside
from railnav.survey.joint_offsets import Joint, settle_with
from railnav.survey.noise import ASSUMED_ERROR, ASSUMED_MEMORY, SCALES, error_model_against
from railnav.survey.offsets import Knowledge
from railnav.survey.sides import Side, know_with, merged
from railnav.track.records import Borders, ModelRecords

if TYPE_CHECKING:
    from railnav.run import Progress
    from railnav.survey.report import Survey

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: How far the first guess of an axis may be off: so many sigma of a fix.
FIRST_SLACK = 2.0
#: And of the first course of a new track, m.
NEW_SLACK = 1.0
#: Of an unknown receiver's runs, how far they scatter in terms of their correlated error.
SCATTER_SHARE = 0.5
#: Rounds of weights.
ROUNDS = 3


@dataclass(slots=True, eq=False)
class Refinement:
    """One coordinate of all tracks that new runs pass."""

    records: ModelRecords
    borders: Borders
    coordinate: str
    receivers: list[str]
    kind: IntArray
    survey: Survey
    sides: list[Side] = None  # type: ignore[assignment]
    joint: Joint = None  # type: ignore[assignment]
    models: dict[str, ErrorModel] = None  # type: ignore[assignment]

    def place(self, side: Side) -> int | None:
        """Place of a track among the frame offsets; a new one has none."""
        return None if side.stored is None else self.borders.tracks.index(side.track.name)

    def part(self, side: Side) -> IntArray:
        """Places of the frame offsets of a side's runs, and of its track where that is stored."""
        place = self.place(side)
        return self.joint.part([] if place is None else [place], side.track.runs)

    def border(self, side: Side) -> FloatArray:
        """Those frame offsets, m."""
        place = self.place(side)
        own = self.joint.run[list(side.track.runs)].ravel()
        return own if place is None else np.concatenate([own, self.joint.track[place]])

    def settle(self, knowledge: Sequence[tuple[int | None, Knowledge]]) -> Joint:
        """Frame offsets from what the chains say."""
        scatter, known = [], []
        for name in self.receivers:
            told = (self.records.receivers.get(name) or {}).get(self.coordinate)
            scatter.append(told["scatter_m"] if told else SCATTER_SHARE * self.models[name].correlated)
            known.append(float(self.records.receivers[name]["runs"]) if told else 0.0)
        B = 2 if self.coordinate == "across" else 1
        return settle_with(self.borders, self.receivers, knowledge, self.kind, np.array(scatter), np.array(known), B)

    def run(self, weight: float, false_alarm: float, tell: Progress) -> None:
        """Find error models, changes and the merged estimates."""
        names = sorted(set(self.survey.receivers))
        self.models = {n: known_model(self.records, n, self.survey, self.coordinate) for n in self.receivers}
        first = [(self.place(s), s.first_offsets()) for s in self.sides]
        self.joint = self.settle(first)
        samples = [self.sample(s) for s in self.sides]
        for name in names:
            if not (self.records.receivers.get(name) or {}).get(self.coordinate):
                self.models[name] = error_model_against(samples, name) or self.models[name]
        for side in self.sides:
            side.track.errors = [self.scaled(side, k) for k in range(len(side.track.runs))]
        self.joint = self.settle(first)
        seen = []
        for i, side in enumerate(self.sides):
            tell(f"compare {self.coordinate}", i, len(self.sides))
            slack = FIRST_SLACK * max(e.total for e in side.errors)
            seen.append(find_changes(side, self.joint, self.part(side), slack, false_alarm))
            set_aside(side)
        tell(f"compare {self.coordinate}", len(self.sides), len(self.sides))
        kept = []
        for side, line in zip(self.sides, seen, strict=True):
            moved = mask(side, "moved")
            side.axis = np.where(moved, line, 0.0)
            old = side.old
            records = None if side.stored is None else side.stored.chain().aged(weight).forgotten(moved[old])
            kept.append((records, moved))
        for turn in range(ROUNDS):
            tell(f"merge {self.coordinate}", turn, ROUNDS)
            chains = []
            for side, (records, moved) in zip(self.sides, kept, strict=True):
                slack = NEW_SLACK + FIRST_SLACK * max(e.total for e in side.errors) if turn == 0 else 0.0
                slack = 0.0 if side.old.all() else slack
                chain = merged(side, records, moved, self.joint.run, slack)
                if side.stored is None and turn == 0:
                    side.noise = np.full(len(side.noise), surveyed.choose_noise(chain))
                    chain = replace(chain, noise=side.noise)
                chains.append(chain)
            swept = [sweep(chain) for chain in chains]
            self.joint = self.settle(
                [
                    (self.place(s), know_with(s, w.border, w.border_value))
                    for s, w in zip(self.sides, swept, strict=True)
                ]
            )
            for side, chain, w in zip(self.sides, chains, swept, strict=True):
                at = self.part(side)
                side.estimate = solve(chain, w, self.border(side), self.joint.covariance[np.ix_(at, at)], sure=True)
                side.axis = side.estimate.state[:, 0]
                fresh = ~(side.old[:-1] & side.old[1:])
                if fresh.any():
                    level = float(np.median(side.noise[fresh]))
                    side.noise = np.where(
                        fresh, surveyed.local_noise(side.estimate, level, side.track.nominal.step), side.noise
                    )
        tell(f"merge {self.coordinate}", ROUNDS, ROUNDS)

    def sample(self, side: Side) -> Any:
        """Distances of the new runs from the stored axis, by bins that hold fixes of most runs."""
        names = [self.survey.receivers[i] for i in side.track.runs]
        if self.coordinate == "across":
            coarse = max(20.0, 1.25 * surveyed.fix_spacing(side.track))
            return replace(
                surveyed.reduced(side.track, self.joint.run, coarse, self.survey.receivers), receiver=tuple(names)
            )
        from railnav.survey.noise import Sample

        count = np.array(
            [float(np.median(row[row > 0])) if (row > 0).any() else 1.0 for row in side.track.profile.count]
        )
        pace = np.array([
            float(np.median(np.abs(np.diff(t[np.isfinite(v)])))) if np.isfinite(v).sum() > 1 else 1.0
            for t, v in zip(side.track.profile.time, side.track.profile.right, strict=True)
        ])  # fmt: skip
        return Sample(
            side.levelled(self.joint.run), side.track.profile.time, count, count / np.maximum(pace, 1e-3), tuple(names)
        )

    def scaled(self, side: Side, k: int) -> ErrorModel:
        """Error model of one run: its receiver's, larger or smaller as its distances to the stored axis say."""
        model = self.models[self.survey.receivers[side.track.runs[k]]]
        level = side.levelled(self.joint.run)[k]
        level = level[np.isfinite(level) & side.old]
        if len(level) < 30 or side.stored is None:
            return model
        solution = side.stored.chain().solve()
        assert solution.covariance is not None
        own = (1.4826 * float(np.median(np.abs(level - np.median(level))))) ** 2
        own = max(own - float(np.median(solution.covariance[:, 0, 0])), 0.0)
        count = max(float(np.median(side.track.profile.count[k][side.track.profile.count[k] > 0])), 1.0)
        usual = model.correlated**2 + model.white**2 / count
        return model.scaled(float(np.clip(np.sqrt(0.8 * own / usual + 0.2), *SCALES)))


def known_model(records: ModelRecords, receiver: str, survey: Survey, coordinate: str) -> ErrorModel:
    """Error model of a receiver as the model knows it, or as the receiver states it."""
    told = (records.receivers.get(receiver) or {}).get(coordinate)
    if told:
        return ErrorModel(told["white_m"], told["correlated_m"], told["correlation_time_s"], told["total_m"])
    stated = (survey.stated if coordinate == "across" else survey.stated_up).get(receiver, np.nan)
    s = float(stated) if np.isfinite(stated) else ASSUMED_ERROR
    return ErrorModel(0.5 * s, s, ASSUMED_MEMORY, 1.1 * s)
