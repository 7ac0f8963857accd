"""What a surveyed model knows beyond its axes: square-root chain records, so that later runs refine it without the old data.

Each track keeps nodes on its axis and, for the deviation a = (y, y', y'') of the true axis from them (to the right, and in height: m,
slope, second derivative), whitened rows that state what all surveys together know:

    R_k (a_k - D_k c) + S_k (a_(k+1) - D_(k+1) c) = 0        R_N (a_N - D_N c) = 0

c is the frame offset that the runs of the track had in common, D its effect on the axis. What the c of all tracks and the frame
offsets of the kinds of receiver have to do with each other are rows as well (`Borders`). The nodes are the estimates, so all
right-hand sides are zero.

Where tracks spring from each other (turnouts), each keeps the chain of its own fixes, every fix in one of them: nothing is counted
twice. A model's track between two nodes may then be a part of such a surveyed track; `ModelRecords.parts` says which, and
`ModelRecords.joins` where ends are drawn onto other tracks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import TrackError

if TYPE_CHECKING:
    from railnav.estimation.merging import ChainRecords

FloatArray = NDArray[np.float64]

#: Numbers in a stored row: R_k packed by rows (6), then S_k (9).
ROW_SIZE = 15
_UPPER = np.triu_indices(3)


@dataclass(frozen=True, slots=True, eq=False)
class AxisRecords:
    """Records of one coordinate of a track, across or up, at its N nodes.

    Attributes
    ----------
    rows : (N, 15) array
        R_k (upper triangle by rows) and S_k of each node; S of the last node is zero.
    lean : (N, 3, B) array
        D_k: what one metre of the common frame offset adds to the axis; B is 2 (east, north) across and 1 up.
    noise : (N - 1,) array
        Random walk of the second derivative between nodes that the survey found, 1/m per sqrt(m).
    """

    rows: FloatArray
    lean: FloatArray
    noise: FloatArray

    @classmethod
    def of(cls, chain: ChainRecords, lean: FloatArray, noise: FloatArray) -> AxisRecords:
        """Keep a chain whose estimate is zero; its blocks must be upper triangular."""
        N = len(chain)
        rows = np.zeros((N, ROW_SIZE))
        rows[:-1, :6] = chain.records[:, _UPPER[0], _UPPER[1]]
        rows[:-1, 6:] = chain.records[:, :, 3:6].reshape(N - 1, 9)
        rows[-1, :6] = chain.triangle[_UPPER]
        return cls(rows, np.ascontiguousarray(lean), np.ascontiguousarray(noise))

    def chain(self) -> ChainRecords:
        """Give the rows as records of the estimation room, the common frame offset held fixed."""
        from railnav.estimation.merging import ChainRecords  # kernels are loaded when they are needed

        N = len(self.rows)
        records = np.zeros((N - 1, 3, 7))
        records[:, _UPPER[0], _UPPER[1]] = self.rows[:-1, :6]
        records[:, :, 3:6] = self.rows[:-1, 6:].reshape(N - 1, 3, 3)
        triangle = np.zeros((3, 4))
        triangle[_UPPER] = self.rows[-1, :6]
        return ChainRecords(records, triangle)


@dataclass(frozen=True, slots=True, eq=False)
class TrackRecords:
    """Records of one track.

    Attributes
    ----------
    step : float
        Distance between nodes, grid metres.
    easting, northing : (N,) array
        The nodes, on the axis, grid m.
    height : (N,) array or None
        Their heights, m, where the track has been surveyed in height.
    across : AxisRecords
    up : AxisRecords or None
    """

    step: float
    easting: FloatArray
    northing: FloatArray
    height: FloatArray | None
    across: AxisRecords
    up: AxisRecords | None


@dataclass(frozen=True, slots=True, eq=False)
class Borders:
    """Whitened rows over frame offsets: of the tracks in order, then of the kinds of receiver, B numbers each.

    Attributes
    ----------
    tracks, receivers : tuple of str
        Who they are.
    rows, value : (p, p), (p,) array
        rows @ (offsets) = value with unit noise; the model's datum is in them.
    """

    tracks: tuple[str, ...]
    receivers: tuple[str, ...]
    rows: FloatArray
    value: FloatArray

    def __post_init__(self) -> None:
        p = len(self.value)
        if self.rows.shape != (p, p) or not (np.isfinite(self.rows).all() and np.isfinite(self.value).all()):
            raise TrackError(
                f"rows of the frame offsets have shape {self.rows.shape} for {p} values, or are not finite"
            )


@dataclass(frozen=True, slots=True, eq=False)
class ModelRecords:
    """All that the surveys of a model know.

    Attributes
    ----------
    tracks : dict
        `TrackRecords` by the name of the surveyed track: the model's track, or one that turnouts part into several (`parts`).
    across, up : Borders, Borders or None
        What is known of the frame offsets in the plane and in height.
    receivers : dict
        Of each kind of receiver: `runs`, `weight` in the datum, and for `across` and `up` {`scatter_m`, `white_m`,
        `correlated_m`, `correlation_time_s`, `total_m`}. JSON values.
    runs : tuple of dict
        The runs in it: `id`, `start`, `tracks`. JSON values.
    joins : tuple of dict
        Ends of surveyed tracks that spring from another one: `track`, `end` (0 start, 1 finish), `parent`, `easting_m`, `northing_m`.
        JSON values.
    parts : dict
        The model's tracks, in order, that a surveyed track became where turnouts part it. JSON values.
    """

    tracks: dict[str, TrackRecords]
    across: Borders
    up: Borders | None
    receivers: dict[str, Any] = field(default_factory=dict)
    runs: tuple[dict[str, Any], ...] = ()
    joins: tuple[dict[str, Any], ...] = ()
    parts: dict[str, list[str]] = field(default_factory=dict)

    def sections(self, track: str) -> list[str]:
        """The model's tracks that a surveyed track consists of, in order."""
        return list(self.parts.get(track, [track]))

    def surveyed(self, section: str) -> str:
        """The surveyed track that a track of the model belongs to; its own name where it is whole, or unknown."""
        return next((name for name, parts in self.parts.items() if section in parts), section)


#: Gives the records of a model when they are asked for.
RecordSource = Callable[[], ModelRecords]
