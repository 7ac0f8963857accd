"""A sliding window of variables: rows come in, old variables are eliminated, and a backward sweep gives them back smoothed.

The chain (`railnav.estimation.chain`) knows its variables beforehand. Where they come and go as the data ask, the same square root works on
a window: a triangle over the live variables, in which a variable that no later row will name is turned into a record
p(eliminated | remaining) (rail 15.2), with the list of the variables that remained.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class WindowRecord:
    """What eliminating some variables left behind: R_ee x_e + R_er x_r = d + noise of unit variance.

    Attributes
    ----------
    eliminated, remaining : tuple
        Names, in the order of the columns; `remaining` is a copy of the window's list at that moment.
    sizes : dict
        Number of components of each of them.
    R_ee, R_er : arrays
        Upper triangle of the eliminated, coupling to the remaining.
    d : array
        Right side.
    """

    eliminated: tuple[Hashable, ...]
    remaining: tuple[Hashable, ...]
    sizes: dict[Hashable, int]
    R_ee: FloatArray
    R_er: FloatArray
    d: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class WindowMarginal:
    """Joint mean and covariance of the variables that lived at one moment, given all rows, earlier and later."""

    names: tuple[Hashable, ...]
    index: dict[Hashable, slice]
    mean: FloatArray
    covariance: FloatArray

    def of(self, *names: Hashable) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of some of them, in that order."""
        rows = np.concatenate([np.arange(self.index[n].start, self.index[n].stop) for n in names])
        return self.mean[rows], self.covariance[np.ix_(rows, rows)]


class Window:
    """Square-root information of live variables; rows are whitened (unit noise).

    The cost of a row is that of the window, whatever came before. `records` grow by one for each elimination.

    Examples
    --------
    A random walk of three steps with the ends observed; the middle one comes back from the sweep:

    >>> window = Window()
    >>> for k in range(3):
    ...     window.add(k, 1)
    ...     if k:
    ...         _ = window.observe({k - 1: [[-1.0]], k: [[1.0]]}, [0.0])
    >>> _ = window.observe({0: [[1.0]]}, [0.0]), window.observe({2: [[1.0]]}, [4.0])
    >>> window.eliminate([0]); window.eliminate([1])
    >>> [float(m.of(1)[0][0].round(6)) for m in window.backward() if 1 in m.names]
    [2.0, 2.0]
    """

    def __init__(self) -> None:
        self._names: list[Hashable] = []
        self._sizes: dict[Hashable, int] = {}
        self._R = np.zeros((0, 0))
        self._b = np.zeros(0)
        self.records: list[WindowRecord] = []

    @property
    def names(self) -> tuple[Hashable, ...]:
        """The live variables, in the order of the columns."""
        return tuple(self._names)

    def index(self, name: Hashable) -> slice:
        """Columns of a live variable."""
        start = 0
        for other in self._names:
            if other == name:
                return slice(start, start + self._sizes[other])
            start += self._sizes[other]
        raise EstimationError(f"variable {name!r} is not in the window, which holds {self._names}")

    def add(self, name: Hashable, size: int) -> None:
        """Take in a variable of which nothing is known yet."""
        if name in self._names:
            raise EstimationError(f"variable {name!r} is in the window already")
        p = len(self._b)
        R, b = np.zeros((p + size, p + size)), np.zeros(p + size)
        R[:p, :p], b[:p] = self._R, self._b
        self._R, self._b = R, b
        self._names.append(name)
        self._sizes[name] = size

    def observe(self, rows: Mapping[Any, ArrayLike], rhs: ArrayLike, *, gate: float = np.inf) -> float:
        """Enter whitened rows sum_j A_j x_j = rhs + noise.

        Parameters
        ----------
        rows : mapping of name to (m, size) array
            Blocks of the live variables that the rows name.
        rhs : (m,) array
        gate : float
            Rows whose residuals exceed this are left out: nothing changes.

        Returns
        -------
        float
            Sum of the squared residuals that the rows add: the normalised innovation squared once all variables are determined.

        Raises
        ------
        EstimationError
            A variable that is not in the window.
        """
        z = np.atleast_1d(np.asarray(rhs, float))
        p = len(self._b)
        A = np.zeros((p + len(z), p + 1))
        A[:p, :p], A[:p, p] = self._R, self._b
        for name, block in rows.items():
            A[p:, self.index(name)] = block
        A[p:, p] = z
        T = np.asarray(np.linalg.qr(A, mode="r"))
        residual = float(T[p, p] ** 2) if len(T) > p else 0.0
        if residual <= gate:
            self._R, self._b = T[:p, :p].copy(), T[:p, p].copy()
        return residual

    def eliminate(self, names: Sequence[Hashable]) -> None:
        """Turn variables that no later row names into a record.

        Raises
        ------
        EstimationError
            If the rows so far leave one of them undetermined given the others.
        """
        if not names:
            return
        gone = tuple(names)
        remaining = tuple(n for n in self._names if n not in gone)
        order = np.concatenate([np.arange(self.index(n).start, self.index(n).stop) for n in (*gone, *remaining)])
        e = sum(self._sizes[n] for n in gone)
        T = np.asarray(np.linalg.qr(np.column_stack([self._R[:, order], self._b]), mode="r"))
        diagonal = np.abs(np.diag(T)[:e])
        if not np.all(diagonal > 1e-12 * max(1.0, float(diagonal.max(initial=0.0)))):
            raise EstimationError(
                f"the rows so far do not determine {gone} given {remaining}; observe it before it is eliminated"
            )
        sizes = {n: self._sizes[n] for n in (*gone, *remaining)}
        self.records.append(
            WindowRecord(gone, remaining, sizes, T[:e, :e].copy(), T[:e, e:-1].copy(), T[:e, -1].copy())
        )
        p = len(order) - e
        R, b = np.zeros((p, p)), np.zeros(p)
        rest = T[e : e + p]
        R[: len(rest)], b[: len(rest)] = rest[:, e:-1], rest[:, -1]
        self._R, self._b = R, b
        self._names = list(remaining)
        for name in gone:
            del self._sizes[name]

    def marginal(self) -> WindowMarginal:
        """Mean and covariance of the live variables, given all rows so far.

        Raises
        ------
        EstimationError
            If the rows do not determine them yet.
        """
        p = len(self._b)
        diagonal = np.abs(np.diag(self._R))
        if p and not diagonal.min() > 1e-12 * diagonal.max():
            raise EstimationError("the rows so far do not determine every variable in the window")
        root = np.linalg.inv(self._R)
        return WindowMarginal(self.names, {n: self.index(n) for n in self._names}, root @ self._b, root @ root.T)

    def backward(self) -> Iterator[WindowMarginal]:
        """Sweep back over the records: what lived at each elimination, given all rows, from the last moment to the first.

        Notes
        -----
        x_e = R_ee^-1 (d - R_er x_r), P_e = R_ee^-1 R_ee^-T + G P_r G^T with G = -R_ee^-1 R_er (rail 15.3). Variables that were taken in
        after an elimination are no part of its record and drop out on the way back.
        """
        now = self.marginal()
        yield now
        for record in reversed(self.records):
            mean_r, P_r = now.of(*record.remaining) if record.remaining else (np.zeros(0), np.zeros((0, 0)))
            inverse = np.linalg.inv(record.R_ee)
            G = -inverse @ record.R_er
            cross = G @ P_r
            mean = np.concatenate([inverse @ record.d + G @ mean_r, mean_r])
            covariance = np.block([[inverse @ inverse.T + cross @ G.T, cross], [cross.T, P_r]])
            names = (*record.eliminated, *record.remaining)
            index, start = {}, 0
            for name in names:
                index[name] = slice(start, start + record.sizes[name])
                start += record.sizes[name]
            now = WindowMarginal(names, index, mean, covariance)
            yield now
