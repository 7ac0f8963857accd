"""Why a track was chosen: the candidates of each decision, and what each kind of evidence said of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.matching import _kernels as paths
from railnav.navigation import columns as c
from railnav.navigation.solution import Alternatives, Mode
from railnav.navigation.state import State

if TYPE_CHECKING:
    from railnav.navigation.engine import Engine

FloatArray = NDArray[np.float64]

#: Kinds of evidence, in the order of a hypothesis' ledger.
EVIDENCE = (
    "path",  # prior of the start, of a turnout's legs, of the usual direction
    "gnss_position",
    "gnss_speed",
    "gnss_course",
    "odometer",
    "yaw_rate",
    "side_force",
    "balise",
    "standstill",
)


@dataclass(frozen=True, slots=True)
class Candidate:
    """One way in which the train can have gone.

    Attributes
    ----------
    track : str
    offset : float
        m.
    running_direction : int
        +1 when the nose points to growing offset.
    probability : float
        Posterior.
    speed : float
        Along the nose, m/s.
    sigma_along : float
        m.
    evidence : dict of str to float
        What each kind of evidence has said, nat, relative to the best candidate: negative counts against this one.
    """

    track: str
    offset: float
    running_direction: int
    probability: float
    speed: float
    sigma_along: float
    evidence: dict[str, float]

    @property
    def against(self) -> str:
        """The kind of evidence that speaks most against this candidate; empty for the best one."""
        worst = min(self.evidence, key=lambda name: self.evidence[name])
        return worst if self.evidence[worst] < 0.0 else ""


@dataclass(frozen=True, slots=True)
class Decision:
    """An epoch at which what is said of the track has changed.

    Attributes
    ----------
    time : float
        s.
    kind : str
        "declared" (a track is claimed), "changed" (another track on the same claimed way), "withdrawn" (no track is claimed any more),
        "preferred" (another track leads, none is claimed), "lost" (no position).
    track : str
        What is said now; empty without a position.
    probability : float
        Of that track.
    mode : str
    candidates : tuple of Candidate
        Most probable first.
    """

    time: float
    kind: str
    track: str
    probability: float
    mode: str
    candidates: tuple[Candidate, ...]


def candidates_now(engine: Engine) -> tuple[Candidate, ...]:
    """The living hypotheses, most probable first."""
    bank, at = engine.bank, engine.filter.at
    lines = []
    for h in engine.living():
        track, offset = engine.place(h)
        root = bank.P_sqrt[h, at[State.POSITION]]
        head = [0.0, 0.0, track, bank.way[h, bank.tags[h, paths.CURRENT]], offset, engine.shared.weight[h]]
        lines.append([*head, float(np.sqrt(root @ root)), bank.x[h, at[State.SPEED]], *bank.info[h, paths.LEDGER :]])
    return _candidates(np.array(lines).reshape(-1, c.JOURNAL_SIZE), engine.model.track_id)


def decisions(engine: Engine, time: FloatArray, out: FloatArray) -> tuple[Decision, ...]:
    """What the journal of a run says of its decisions."""
    lines = engine.journal.lines[: int(engine.journal.used[0])]
    lines = lines[lines[:, c.J_DECISION] == 1.0]
    track_id = engine.model.track_id
    epochs, first = np.unique(lines[:, c.J_EPOCH].astype(np.int64), return_index=True)
    told = []
    for epoch, begin, end in zip(epochs.tolist(), first, [*first[1:], len(lines)], strict=True):
        track = int(out[epoch, c.OUT_TRACK])
        mode, before = Mode(int(out[epoch, c.OUT_MODE])), Mode(int(out[max(epoch - 1, 0), c.OUT_MODE]))
        sure, was_sure = (m in (Mode.TRACKING, Mode.COASTING) for m in (mode, before))
        if track < 0:
            kind = "lost"
        elif sure:
            kind = "changed" if was_sure and epoch > 0 else "declared"
        else:
            kind = "withdrawn" if was_sure else "preferred"
        told.append(
            Decision(
                float(time[epoch]),
                kind,
                track_id[track] if track >= 0 else "",
                float(out[epoch, c.OUT_PROBABILITY]) if track >= 0 else 0.0,
                mode.label,
                _candidates(lines[begin:end], track_id),
            )
        )
    return tuple(told)


def alternatives(engine: Engine) -> Alternatives:
    """The candidates of every epoch that has more than one track, each track once, most probable first."""
    lines = engine.journal.lines[: int(engine.journal.used[0])]
    epoch, track = lines[:, c.J_EPOCH].astype(np.int64), lines[:, c.J_TRACK].astype(np.int64)
    weight = lines[:, c.J_WEIGHT]
    order = np.lexsort((-weight, track, epoch))
    epoch, track, weight = epoch[order], track[order], weight[order]
    first = np.flatnonzero((np.diff(epoch, prepend=-1) != 0) | (np.diff(track, prepend=-1) != 0))
    if not len(first):
        return Alternatives.none()
    total = np.add.reduceat(weight, first)
    row, which = epoch[first], track[first]
    offset, way = lines[order[first], c.J_OFFSET], lines[order[first], c.J_WAY].astype(np.int64)
    worth = total >= c.J_LEAST
    several = worth & np.isin(row, np.flatnonzero(np.bincount(row[worth]) > 1))
    ranked = np.lexsort((-total, row))
    ranked = ranked[several[ranked]]
    return Alternatives(row[ranked], which[ranked], offset[ranked], total[ranked], way[ranked])


def _candidates(lines: FloatArray, track_id: Sequence[str]) -> tuple[Candidate, ...]:
    """Lines of the journal as candidates, evidence relative to the best."""
    lines = lines[np.argsort(-lines[:, c.J_WEIGHT], kind="stable")]
    ledger = lines[:, c.JOURNAL_SIZE - len(EVIDENCE) :]
    return tuple(
        Candidate(
            track_id[int(line[c.J_TRACK])],
            float(line[c.J_OFFSET]),
            int(line[c.J_WAY]),
            float(line[c.J_WEIGHT]),
            float(line[c.J_SPEED]),
            float(line[c.J_SIGMA]),
            {name: float(value) for name, value in zip(EVIDENCE, said - ledger[0], strict=True)},
        )
        for line, said in zip(lines, ledger, strict=True)
    )
