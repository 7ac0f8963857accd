"""Line references: kilometres as they are published, and the tracks they lie on.

Two cultures meet here. In one a kilometre is stretched: 12.345 is 345 thousandths of the way from post 12 to post 13, whatever that
measures. In the other metres are metres and a kilometre may have too many of them (over-length, 53+1054) or too few (short-length,
km 12 ends after 420 m and km 14 follows). A `LineReference` holds both: each kilometre has a label, the position at which it begins
on a continuous scale, its true length, and how many metres are counted in it. A single number is not enough: an address is a
label and metres.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError

if TYPE_CHECKING:
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Metres in a mile and in a chain.
MILE, CHAIN = 1609.344, 20.1168


@dataclass(frozen=True, slots=True)
class ChainageAddress:
    """A published address: the kilometre's (or mile's) label and the metres counted from where it begins.

    Examples
    --------
    >>> ChainageAddress(53, 1054.0) == ChainageAddress(54, 54.0)  # on a line with an over-long kilometre 53, two places
    False
    """

    label: int
    metre: float


@dataclass(frozen=True, slots=True, eq=False)
class LineReference:
    """The kilometres of one line.

    Attributes
    ----------
    line : str
        Its name.
    label : (k,) int array
        What each kilometre is called, in the order along the line; unique, may skip, may be negative, may fall.
    start : (k + 1,) array
        Position at which each begins, and at which the last ends: true metres on a continuous scale of the line, growing.
    counted : (k,) array
        Metres counted in each: 1000 where it is stretched, its true length where metres are metres.
    unit : float
        Nominal length: 1000 m, or a mile.
    """

    line: str
    label: IntArray
    start: FloatArray
    counted: FloatArray
    unit: float = 1000.0

    def __post_init__(self) -> None:
        if len(self.label) == 0 or len(self.start) != len(self.label) + 1 or len(self.counted) != len(self.label):
            raise TrackError(
                f"line {self.line!r}: {len(self.label)} kilometres need as many lengths and one start more"
            )
        if not (np.isfinite(self.start).all() and np.isfinite(self.counted).all() and (self.counted > 0).all()):
            raise TrackError(f"line {self.line!r}: a kilometre has no length")
        short = np.flatnonzero(np.diff(self.start) <= 0)
        if len(short):
            raise TrackError(f"line {self.line!r}: kilometre {int(self.label[short[0]])} does not end after it begins")
        names, many = np.unique(self.label, return_counts=True)
        if (many > 1).any():
            raise TrackError(
                f"line {self.line!r}: kilometre {int(names[np.argmax(many)])} stands twice; an address would be two places"
            )
        for array in (self.label, self.start, self.counted):
            array.flags.writeable = False

    @classmethod
    def of(
        cls,
        line: str,
        first: int,
        lengths: ArrayLike,
        *,
        labels: Sequence[int] | None = None,
        stretched: bool = False,
        origin: float = 0.0,
        unit: float = 1000.0,
    ) -> LineReference:
        """A line from the true lengths of its kilometres.

        Parameters
        ----------
        line : str
            Its name.
        first : int
            Label of the first kilometre; the others follow by one, unless `labels` names them all.
        lengths : (k,) array
            True lengths, m.
        labels : sequence of int, optional
            All labels, where one is missing or they fall.
        stretched : bool
            Whether every kilometre counts `unit` metres, whatever it measures.
        origin : float
            Position at which the first begins, m.
        unit : float
            1000 m, or `MILE`.

        Returns
        -------
        LineReference

        Examples
        --------
        >>> line = LineReference.of("80", 52, [1000.0, 1054.0, 1000.0])
        >>> line.address(2040.0)
        ChainageAddress(label=53, metre=1040.0)
        """
        true = np.asarray(lengths, np.float64).ravel()
        label = np.arange(first, first + len(true)) if labels is None else np.asarray(labels, np.int64)
        start = origin + np.concatenate([[0.0], np.cumsum(true)])
        return cls(line, label.astype(np.int64), start, np.full(len(true), unit) if stretched else true.copy(), unit)

    def __eq__(self, other: object) -> bool:
        """Whether every number is the same."""
        if not isinstance(other, LineReference):
            return NotImplemented
        same = (np.array_equal(getattr(self, name), getattr(other, name)) for name in ("label", "start", "counted"))
        return self.line == other.line and self.unit == other.unit and all(same)

    __hash__ = None  # type: ignore[assignment]  # arrays within

    @property
    def length(self) -> float:
        """True length of the line, m."""
        return float(self.start[-1] - self.start[0])

    def addresses(self, position: ArrayLike) -> tuple[IntArray, FloatArray]:
        """Labels and metres of positions.

        Parameters
        ----------
        position : float or (n,) array
            On the line's continuous scale, m. Before the first kilometre and beyond the last metres run on as if it were
            longer (negative before the first).

        Returns
        -------
        label, metre : (n,) arrays
        """
        s = np.atleast_1d(np.asarray(position, np.float64))
        if not np.isfinite(s).all():
            raise TrackError(f"position {int(np.argmin(np.isfinite(s))) + 1} on line {self.line!r} is not finite")
        k = np.clip(np.searchsorted(self.start, s, side="right") - 1, 0, len(self.label) - 1)
        true = np.diff(self.start)
        return self.label[k], (s - self.start[k]) * (self.counted[k] / true[k])

    def address(self, position: float) -> ChainageAddress:
        """Address of one position, m."""
        label, metre = self.addresses(position)
        return ChainageAddress(int(label[0]), float(metre[0]))

    def positions(self, label: ArrayLike, metre: ArrayLike) -> FloatArray:
        """Positions of addresses: the exact inverse of `addresses`.

        Parameters
        ----------
        label : int or (n,) array
            Kilometres.
        metre : float or (n,) array
            Metres in them.

        Returns
        -------
        (n,) array
            m.

        Raises
        ------
        TrackError
            A kilometre that the line does not have, or more metres than it has.
        """
        names, m = (np.atleast_1d(v) for v in np.broadcast_arrays(label, np.asarray(metre, np.float64)))
        order = np.argsort(self.label)
        k = order[np.clip(np.searchsorted(self.label[order], names), 0, len(order) - 1)]
        missing = self.label[k] != names
        if missing.any():
            what = int(names[int(np.argmax(missing))])
            raise TrackError(
                f"line {self.line!r} has no kilometre {what}; it has {int(self.label.min())} to {int(self.label.max())}"
                + (", with gaps" if len(self.label) < int(np.ptp(self.label)) + 1 else "")
            )
        first, last = k == 0, k == len(self.label) - 1
        outside = ~((m >= -1e-6) | first) | ~((m <= self.counted[k] + 1e-6) | last) | ~np.isfinite(m)
        if outside.any():
            i = int(np.argmax(outside))
            raise TrackError(
                f"kilometre {int(names[i])} of line {self.line!r} is {self.counted[k[i]]:g} m long; there is no metre {m[i]:g} in it"
            )
        return np.asarray(self.start[k] + m * (np.diff(self.start)[k] / self.counted[k]))

    def position(self, address: ChainageAddress) -> float:
        """Position of one address, m."""
        return float(self.positions(address.label, address.metre)[0])

    def irregular(self, tolerance: float = 0.5) -> list[tuple[int, float]]:
        """Kilometres that measure otherwise than their unit: label and surplus (over-length positive), m."""
        surplus = np.diff(self.start) - self.unit
        return [(int(self.label[i]), float(surplus[i])) for i in np.flatnonzero(np.abs(surplus) > tolerance)]


@dataclass(frozen=True, slots=True, eq=False)
class LineReferences:
    """The lines of a model and the tracks they run over; a track may carry several lines, a line several tracks.

    Attributes
    ----------
    lines : tuple of LineReference
    track, line : (a,) int array
        Of each anchor: index of the track in the model, and of the line here.
    offset, position : (a,) array
        Of each anchor: true offset on the track, and position on the line, m; linear in between, metre for metre beyond.
        Sorted by track, line and offset; position grows or falls strictly with offset.
    """

    lines: tuple[LineReference, ...] = ()
    track: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    line: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    offset: FloatArray = field(default_factory=lambda: np.zeros(0))
    position: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        count = len(self.track)
        if not len(self.line) == len(self.offset) == len(self.position) == count:
            raise TrackError("anchors of line references have columns of different lengths")
        names = [reference.line for reference in self.lines]
        if len(set(names)) != len(names):
            raise TrackError(f"line {max(names, key=names.count)!r} stands twice among the references")
        if count and not (self.line.min() >= 0 and self.line.max() < len(self.lines) and self.track.min() >= 0):
            raise TrackError("an anchor names a line or track that there is not")
        if not (np.isfinite(self.offset).all() and np.isfinite(self.position).all()):
            raise TrackError("an anchor of a line reference is not finite")
        for track, line, here in self.stretches():
            step = np.diff(self.position[here])
            if not (np.diff(self.offset[here]) > 0).all() or not ((step > 0).all() or (step < 0).all()):
                raise TrackError(
                    f"line {names[line]!r} on track {track}: positions neither grow nor fall with offset all along"
                )
        for array in (self.track, self.line, self.offset, self.position):
            array.flags.writeable = False

    def stretches(self) -> list[tuple[int, int, slice]]:
        """Each track with each line on it, and its anchors."""
        if not len(self.track):
            return []
        new = np.flatnonzero((np.diff(self.track) != 0) | (np.diff(self.line) != 0)) + 1
        bounds = [0, *new.tolist(), len(self.track)]
        pairs = [(int(self.track[a]), int(self.line[a]), slice(a, b)) for a, b in itertools.pairwise(bounds)]
        if len({(track, line) for track, line, _ in pairs}) != len(pairs):
            raise TrackError("anchors of line references are not sorted by track and line")
        return pairs

    def __len__(self) -> int:
        return len(self.lines)

    def __eq__(self, other: object) -> bool:
        """Whether every line and every anchor is the same."""
        if not isinstance(other, LineReferences):
            return NotImplemented
        names = ("track", "line", "offset", "position")
        return self.lines == other.lines and all(
            np.array_equal(getattr(self, name), getattr(other, name)) for name in names
        )

    __hash__ = None  # type: ignore[assignment]  # arrays within


@dataclass(frozen=True, slots=True)
class Published:
    """What a line says of a place: the line, the address on it, and whether the line grows as offset grows."""

    line: str
    address: ChainageAddress
    rising: bool


@dataclass(frozen=True, slots=True)
class TrackPlace:
    """A place on a track: identifier, true offset (m), and whether the line grows as offset grows."""

    track: str
    offset: float
    rising: bool


def along_anchors(x: FloatArray, y: FloatArray, at: FloatArray) -> FloatArray:
    """Linear between anchors, metre for metre beyond them; x grows, y grows or falls."""
    sense = 1.0 if y[-1] >= y[0] else -1.0
    beyond = np.minimum(at - x[0], 0.0) + np.maximum(at - x[-1], 0.0)
    return np.asarray(np.interp(at, x, y) + sense * beyond)


def published(model: TrackModel, track: str, offset: float) -> list[Published]:
    """Every line's address of a place on a track; empty where none runs over it.

    Parameters
    ----------
    model : TrackModel
        With line references.
    track : str
        Identifier.
    offset : float
        True offset, m.

    Returns
    -------
    list of Published
        One a line, in the order of the model's lines.

    Raises
    ------
    TrackError
        No such track, or an offset beyond its ends.
    """
    index = model.track_index(track)
    if not -1e-3 <= offset <= model.length(track) + 1e-3:
        raise TrackError(f"offset {offset} m is not on track {track!r}, 0..{model.length(track):.3f} m")
    references, found = model.references, []
    for i, line, here in references.stretches():
        if i == index:
            x, y = references.offset[here], references.position[here]
            s = float(along_anchors(x, y, np.array([offset]))[0])
            found.append(Published(references.lines[line].line, references.lines[line].address(s), bool(y[-1] >= y[0])))
    return found


def find_chainage(model: TrackModel, line: str, address: ChainageAddress) -> list[TrackPlace]:
    """The places on tracks that a line's address names: one a track beside another, empty where the model has none.

    Parameters
    ----------
    model : TrackModel
        With line references.
    line : str
        Name of the line.
    address : ChainageAddress
        On it.

    Returns
    -------
    list of TrackPlace

    Raises
    ------
    TrackError
        No such line, kilometre, or metre.
    """
    references = model.references
    names = [reference.line for reference in references.lines]
    if line not in names:
        raise TrackError(f"the model has no line {line!r}; it has {', '.join(names) or 'no line references'}")
    wanted = names.index(line)
    s = references.lines[wanted].position(address)
    places = []
    for i, which, here in references.stretches():
        if which != wanted:
            continue
        x, y = references.offset[here], references.position[here]
        rising = bool(y[-1] >= y[0])
        offset = float(along_anchors(y if rising else y[::-1], x if rising else x[::-1], np.array([s]))[0])
        if -1e-3 <= offset <= float(model.lengths[i]) + 1e-3:
            places.append(TrackPlace(model.track_id[i], min(max(offset, 0.0), float(model.lengths[i])), rising))
    return places
