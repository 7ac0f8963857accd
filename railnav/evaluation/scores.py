"""Scores of a solution against the truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import InputError
from railnav.evaluation.comparison import Comparison, compare
from railnav.evaluation.consistency import NOMINAL_COVERAGE, Consistency, consistency
from railnav.evaluation.jumps import Jumps, find_jumps
from railnav.evaluation.reliability import Reliability, reliability
from railnav.navigation.solution import Mode, Solution
from railnav.track.model import TrackModel
from railnav.truth import Truth

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Statistics:
    """Size of errors; None where there are none to judge.

    Attributes
    ----------
    count : int
    mean, rms : float or None
        Of the signed error.
    median, p95, max : float or None
        Of its absolute value.
    """

    count: int
    mean: float | None
    rms: float | None
    median: float | None
    p95: float | None
    max: float | None

    @classmethod
    def of(cls, error: ArrayLike) -> Statistics:
        """Statistics of the finite values.

        Examples
        --------
        >>> Statistics.of([3.0, -4.0, float("nan")]).rms
        3.5355339059327378
        """
        e = np.asarray(error, float)
        e = e[np.isfinite(e)]
        if len(e) == 0:
            return cls(0, None, None, None, None, None)
        size = np.abs(e)
        return cls(
            len(e),
            float(e.mean()),
            float(np.sqrt((e * e).mean())),
            float(np.median(size)),
            float(np.quantile(size, 0.95)),
            float(size.max()),
        )


@dataclass(frozen=True, slots=True)
class WrongStretch:
    """A stretch of rows on the wrong track.

    Attributes
    ----------
    start, end : float
        First and last row, s.
    rows : int
    tracking : int
        Rows among them that claim to be sure (mode tracking).
    track, true_track : str
        At the first row.
    """

    start: float
    end: float
    rows: int
    tracking: int
    track: str
    true_track: str


@dataclass(frozen=True, slots=True)
class TrackSelection:
    """How often the right track was named.

    Attributes
    ----------
    compared_by : str
        "name" or "distance".
    rows, right : int
        Rows with a position, and those on the right track.
    tracking, tracking_right : int
        The same among rows in mode tracking.
    across_joint : int
        Rows counted right though they name the neighbouring track on the train's path, a small error along away.
    overconfident : int
        Wrong rows that state a track probability of at least 0.999.
    mean_probability : float or None
        Mean stated probability; an honest navigator's equals the share of right rows.
    wrong : tuple of WrongStretch
    """

    compared_by: str
    rows: int
    right: int
    tracking: int
    tracking_right: int
    across_joint: int
    overconfident: int
    mean_probability: float | None
    wrong: tuple[WrongStretch, ...]

    @property
    def rate(self) -> float | None:
        """Share of rows with a position that are on the right track."""
        return self.right / self.rows if self.rows else None

    @property
    def rate_tracking(self) -> float | None:
        """The same over rows in mode tracking."""
        return self.tracking_right / self.tracking if self.tracking else None

    @property
    def wrong_while_tracking(self) -> int:
        """Rows that are sure of a wrong track: the worst a navigator can do."""
        return self.tracking - self.tracking_right


@dataclass(frozen=True, slots=True)
class Integrity:
    """Errors along against the protection level (Stanford diagram).

    Attributes
    ----------
    rows : int
        Rows with a protection level.
    integrity_risk : float
        Probability per row at which the level should fail.
    alert_limit : float
        m.
    events : int
        Rows whose error exceeds the protection level.
    largest_ratio : float or None
        Greatest |error| / protection level.
    available : int
        Error <= level <= alert limit: safe to use.
    unavailable : int
        Error <= level, level > alert limit: honest, but not usable.
    misleading : int
        Error > level, not hazardous: both on one side of the alert limit.
    hazardous : int
        Error > alert limit >= level.
    median_level : float or None
        Median protection level, m.
    """

    rows: int
    integrity_risk: float
    alert_limit: float
    events: int
    largest_ratio: float | None
    available: int
    unavailable: int
    misleading: int
    hazardous: int
    median_level: float | None


@dataclass(frozen=True, slots=True)
class CoastingStretch:
    """A stretch without fixes.

    Attributes
    ----------
    start, end : float
        First and last row, s.
    distance : float
        Way run in it, m.
    error_at_end, largest_error, sigma_at_end, level_at_end : float or None
        Along, m.
    """

    start: float
    end: float
    distance: float
    error_at_end: float | None
    largest_error: float | None
    sigma_at_end: float | None
    level_at_end: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """How good a solution is, and whether it knows.

    Attributes
    ----------
    run_id : str
    start, end : float
        Common time of solution and truth, s.
    epochs, positioned : int
        Rows of the solution in that time, and those with a position.
    along_statistics, across_statistics, speed_statistics : Statistics
        Errors over all rows with a position; m, m, m/s.
    along_by_mode : dict of Statistics
        Errors along by mode, for modes that occur with a position.
    modes : dict of int
        Rows in each mode.
    selection : TrackSelection
    reliability : Reliability
        Stated track probabilities against the share of right rows.
    consistency : Consistency
        NEES and coverage along, over rows on the right track.
    integrity : Integrity
    coasting : tuple of CoastingStretch
        Stretches in mode coasting.
    jumps : Jumps or None
        Only where the model was given.
    time, way, along, across, speed, sigma_along, protection_level : (p,) array
        The rows with a position, for diagrams (not part of `to_dict`): s; the truth's way in the direction of the nose, m;
        errors along (ahead positive) and across (right positive), m; error of the speed, m/s; stated sigma and level, m.
    right : (p,) bool array
        Whether the track is right.
    """

    run_id: str
    start: float
    end: float
    epochs: int
    positioned: int
    along_statistics: Statistics
    across_statistics: Statistics
    speed_statistics: Statistics
    along_by_mode: dict[str, Statistics]
    modes: dict[str, int]
    selection: TrackSelection
    reliability: Reliability
    consistency: Consistency
    integrity: Integrity
    coasting: tuple[CoastingStretch, ...]
    jumps: Jumps | None
    time: FloatArray
    way: FloatArray
    along: FloatArray
    across: FloatArray
    speed: FloatArray
    sigma_along: FloatArray
    protection_level: FloatArray
    right: BoolArray

    @property
    def availability(self) -> float:
        """Share of epochs with a position."""
        return self.positioned / self.epochs

    def to_dict(self) -> dict[str, Any]:
        """JSON values: numbers, texts, lists and dicts; None where there was nothing to judge.

        Units stand in the names' definitions: SI.
        """
        values: dict[str, Any] = {
            "run_id": self.run_id,
            "start": self.start,
            "end": self.end,
            "epochs": self.epochs,
            "positioned": self.positioned,
            "availability": self.availability,
            "along": asdict(self.along_statistics),
            "across": asdict(self.across_statistics),
            "speed": asdict(self.speed_statistics),
            "along_by_mode": {mode: asdict(s) for mode, s in self.along_by_mode.items()},
            "modes": dict(self.modes),
            "selection": {
                **asdict(self.selection),
                "rate": self.selection.rate,
                "rate_tracking": self.selection.rate_tracking,
                "wrong_while_tracking": self.selection.wrong_while_tracking,
                "wrong": [asdict(w) for w in self.selection.wrong],
            },
            "reliability": {**asdict(self.reliability), "honest": self.reliability.honest},
            "consistency": {
                **asdict(self.consistency),
                "inside": self.consistency.inside,
                "coverage": None if self.consistency.coverage is None else list(self.consistency.coverage),
                "nominal_coverage": list(NOMINAL_COVERAGE),
            },
            "integrity": asdict(self.integrity),
            "coasting": [asdict(c) for c in self.coasting],
            "jumps": None
            if self.jumps is None
            else {
                "changes": self.jumps.changes,
                "illegal": [asdict(j) for j in self.jumps.illegal],
                "corrections": self.jumps.corrections,
            },
        }
        return values


def evaluate(
    solution: Solution,
    truth: Truth,
    *,
    model: TrackModel | None = None,
    alert_limit: float = 25.0,
    confidence: float = 0.95,
    by: str = "auto",
    joint_within: float = 25.0,
    track_within: float = 1.9,
) -> Evaluation:
    """Judge a solution by the truth of the same run.

    Parameters
    ----------
    solution : Solution
        Fresh, or read back from a file.
    truth : Truth
        On the same clock.
    model : TrackModel, optional
        The model that the solution was made with; then jumps between tracks are checked for lawfulness.
    alert_limit : float
        Largest tolerable error along, m, for the Stanford diagram.
    confidence : float
        Of the bounds of the NEES.
    by, joint_within, track_within
        How tracks are compared; see `compare`.

    Returns
    -------
    Evaluation

    Raises
    ------
    InputError
        Nothing to compare: empty tables or no common time; or a limit that makes no sense.
    TrackError
        A model that the solution was not made with.

    Notes
    -----
    Errors one epoch apart are nearly the same error: the bounds of the NEES use the effective number of independent samples,
    estimated from the errors themselves, and widen accordingly. Over a short run with slow GNSS errors they say little, and say so.

    Examples
    --------
    >>> from railnav.evaluation import truth_as_solution
    >>> from railnav.simulation import Leg, demo_line, simulate
    >>> model = demo_line(spacing=20.0)
    >>> _, truth = simulate(model, Leg(("77R-01",), start=50.0, finish=700.0), seed=1)
    >>> evaluation = evaluate(truth_as_solution(truth, model, along=1.5), truth)
    >>> round(evaluation.along_statistics.rms, 3), evaluation.selection.rate
    (1.5, 1.0)
    """
    if not alert_limit > 0.0:
        raise InputError(f"alert limit {alert_limit} m is not positive")
    if not 0.0 < confidence < 1.0:
        raise InputError(f"confidence {confidence} is not between 0 and 1")
    c = compare(solution, truth, by=by, joint_within=joint_within, track_within=track_within)
    mode = solution.mode[c.row]
    positioned = np.isfinite(c.along)
    sigma, level = solution.sigma_along[c.row], solution.protection_level_along[c.row]
    told = positioned & (solution.track[c.row] >= 0)
    judged = positioned & c.right & np.isfinite(sigma) & (sigma > 0.0)
    return Evaluation(
        run_id=solution.run_id,
        start=float(c.time[0]),
        end=float(c.time[-1]),
        epochs=len(c.row),
        positioned=int(positioned.sum()),
        along_statistics=Statistics.of(c.along),
        across_statistics=Statistics.of(c.across),
        speed_statistics=Statistics.of(c.speed),
        along_by_mode={
            Mode(m).label: Statistics.of(c.along[mode == m]) for m in np.unique(mode) if positioned[mode == m].any()
        },
        modes={m.label: int((mode == m).sum()) for m in Mode if (mode == m).any()},
        selection=_selection(solution, truth, c, mode, positioned),
        reliability=reliability(solution.track_probability[c.row][told], c.right[told]),
        consistency=consistency(c.along[judged], sigma[judged], c.time[judged], confidence=confidence),
        integrity=_integrity(c.along, level, alert_limit, solution.integrity_risk),
        coasting=_coasting(c, mode, sigma, level),
        jumps=None if model is None else find_jumps(solution, model),
        time=c.time[positioned],
        way=c.way[positioned],
        along=c.along[positioned],
        across=c.across[positioned],
        speed=c.speed[positioned],
        sigma_along=sigma[positioned],
        protection_level=level[positioned],
        right=c.right[positioned],
    )


def _stretches(flag: BoolArray) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edge = np.diff(np.concatenate([[0], flag.astype(np.int8), [0]]))
    return list(zip(np.flatnonzero(edge == 1).tolist(), (np.flatnonzero(edge == -1) - 1).tolist(), strict=True))


def _selection(
    solution: Solution, truth: Truth, c: Comparison, mode: NDArray[np.int64], positioned: BoolArray
) -> TrackSelection:
    positioned = positioned & (solution.track[c.row] >= 0)  # a scheme without a map chooses none
    tracking = positioned & (mode == Mode.TRACKING)
    wrong = positioned & ~c.right
    probability = solution.track_probability[c.row]
    stretches = []
    for a, b in _stretches(wrong):
        stretches.append(
            WrongStretch(
                start=float(c.time[a]),
                end=float(c.time[b]),
                rows=b - a + 1,
                tracking=int(tracking[a : b + 1].sum()),
                track=solution.track_id[solution.track[c.row[a]]],
                true_track=truth.track_id[c.true_track[a]],
            )
        )
    stated = probability[positioned & np.isfinite(probability)]
    return TrackSelection(
        compared_by="name" if c.by_name else "distance",
        rows=int(positioned.sum()),
        right=int((positioned & c.right).sum()),
        tracking=int(tracking.sum()),
        tracking_right=int((tracking & c.right).sum()),
        across_joint=int((positioned & c.across_joint).sum()),
        overconfident=int((wrong & (probability >= 0.999)).sum()),
        mean_probability=float(stated.mean()) if len(stated) else None,
        wrong=tuple(stretches),
    )


def _integrity(along: FloatArray, level: FloatArray, alert_limit: float, risk: float) -> Integrity:
    known = np.isfinite(along) & np.isfinite(level)
    error, bound = np.abs(along[known]), level[known]
    fails, usable = error > bound, bound <= alert_limit
    hazardous = fails & usable & (error > alert_limit)
    ratio = error / np.maximum(bound, 1e-9)
    return Integrity(
        rows=int(known.sum()),
        integrity_risk=risk,
        alert_limit=alert_limit,
        events=int(fails.sum()),
        largest_ratio=float(ratio.max()) if len(ratio) else None,
        available=int((~fails & usable).sum()),
        unavailable=int((~fails & ~usable).sum()),
        misleading=int((fails & ~hazardous).sum()),
        hazardous=int(hazardous.sum()),
        median_level=float(np.median(bound)) if len(bound) else None,
    )


def _coasting(
    c: Comparison, mode: NDArray[np.int64], sigma: FloatArray, level: FloatArray
) -> tuple[CoastingStretch, ...]:
    def known(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    found = []
    for a, b in _stretches(mode == Mode.COASTING):
        errors = np.abs(c.along[a : b + 1])
        finite = errors[np.isfinite(errors)]
        found.append(
            CoastingStretch(
                start=float(c.time[a]),
                end=float(c.time[b]),
                distance=float(np.abs(np.diff(c.way[a : b + 1])).sum()),
                error_at_end=known(c.along[b]),
                largest_error=float(finite.max()) if len(finite) else None,
                sigma_at_end=known(sigma[b]),
                level_at_end=known(level[b]),
            )
        )
    return tuple(found)
