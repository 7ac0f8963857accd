"""The design of a track: plan elements, profile and cant by station, evaluated to a nanometre's noise.

A station is the published length of the design: metres of the plane along the plan, counted from `Design.start`. Curvature,
radii, lengths and slopes are the plane's own (see `railnav.track.elements`); a track model's offsets are true lengths on the
ground, so the two meet in coordinates, by `Design.project`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError
from railnav.track.elements import KIND_NAMES, Cant, Gradients, Plan, closing, curvature, integrate
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: A station this far outside the design is still its end, m.
AT_END = 1e-3
#: Farthest between samples of the axis among which the nearest is looked for, m.
_SAMPLE = 5.0
#: And at most this share of a radius.
_SAMPLE_TURN = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class DesignPoints:
    """A design at given stations: arrays of the shape asked for; SI and radians.

    Attributes
    ----------
    station : array
        m.
    easting, northing : array
        m.
    grid_bearing : array
        Clockwise from grid north, in (-pi, pi], rad.
    curvature : array
        In the plane, positive to the right, 1/m; at a joint, of the element that ends there.
    height : array
        m; NaN where the design has no profile.
    gradient : array
        Rise over length in the plane, positive uphill; NaN where the design has no profile.
    cant : array
        Positive with the left rail high, m; NaN where the design has none.
    """

    station: FloatArray
    easting: FloatArray
    northing: FloatArray
    grid_bearing: FloatArray
    curvature: FloatArray
    height: FloatArray
    gradient: FloatArray
    cant: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FootPoints:
    """Points projected onto a design: arrays (n,).

    Attributes
    ----------
    station : (n,) array
        Of the foot, kept within the design, m.
    cross : (n,) array
        From the design to the point, positive to the right as the station grows, m.
    distance : (n,) array
        To the foot, m: larger than |cross| where the point lies before the start or past the end.
    """

    station: FloatArray
    cross: FloatArray
    distance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """The designed alignment of one track.

    Attributes
    ----------
    track : str
        Identifier.
    plan : Plan
        Elements with their starts, lengths, kinds and curvatures.
    start : float
        Station where the plan begins, m.
    profile : Gradients or None
        Height by length from the plan's start; None where the design has none.
    cant : Cant or None
        Cant by length from the plan's start; None where the design has none.
    crs : str
        The plane, WKT or a name; empty where unknown.

    Examples
    --------
    >>> from railnav.monitoring.design import design_of_elements
    >>> design = design_of_elements("1", ["straight", "clothoid", "arc"], [100.0, 80.0, 200.0], [0, 600.0, 600.0])
    >>> here = design.at([0.0, 180.0])
    >>> here.curvature.round(6).tolist(), here.easting.round(3).tolist()
    ([0.0, 0.001667], [0.0, 1.777])
    """

    track: str
    plan: Plan
    start: float = 0.0
    profile: Gradients | None = None
    cant: Cant | None = None
    crs: str = ""
    _gap: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        plan = self.plan
        if len(plan.length) == 0:
            raise TrackError(f"the design of track {self.track!r} has no elements")
        for name in ("length", "curvature_start", "curvature_end", "easting", "northing", "grid_bearing", "sway"):
            values = getattr(plan, name)
            if values.shape != plan.length.shape:
                raise TrackError(
                    f"the design of track {self.track!r} has {values.size} of {name}, not {plan.length.size}"
                )
            if not np.isfinite(values).all():
                where = int(np.argmin(np.isfinite(values))) + 1
                raise TrackError(f"element {where} of track {self.track!r} has a {name} that is not finite")
        if (plan.length <= 0.0).any():
            raise TrackError(f"element {int(np.argmin(plan.length)) + 1} of track {self.track!r} has no length")
        gap, _ = closing(plan)
        object.__setattr__(self, "_gap", gap)

    @property
    def length(self) -> float:
        """Length in the plane, m."""
        return float(self.plan.length.sum())

    @property
    def stations(self) -> FloatArray:
        """Stations of the elements' starts and of the end, (n + 1,), m."""
        return self.start + self.plan.edges

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the elements by name: straight, arc, clothoid, bloss, cosine, sine, helmert, viennese, cubic-parabola."""
        return tuple(KIND_NAMES[kind] for kind in self.plan.kind)

    @property
    def gap(self) -> FloatArray:
        """What each element misses the next one's stated start by, (n, 2), m; it is spread along the element."""
        return self._gap

    def at(self, station: ArrayLike) -> DesignPoints:
        """Geometry at stations.

        Parameters
        ----------
        station : float or array
            m, in any order.

        Returns
        -------
        DesignPoints
            Arrays of the shape of `station`.

        Raises
        ------
        TrackError
            A station that is not finite, or more than 1 mm outside the design.

        Notes
        -----
        Gauss-Legendre, 8 points on panels of at most 2 m, each panel inside one element: 1e-9 m.
        """
        where = np.asarray(station, np.float64)
        along = where.ravel() - self.start
        outside = ~((along >= -AT_END) & (along <= self.length + AT_END))
        if outside.any():
            first, last = self.start, self.start + self.length
            raise TrackError(
                f"station {where.ravel()[int(np.argmax(outside))]:.3f} m is not on the design of track {self.track!r}, "
                f"which runs from {first:.3f} to {last:.3f} m"
            )
        along = np.clip(along, 0.0, self.length)
        points, bearing, bend = self._plan_at(along)
        nothing = np.full(len(along), np.nan)
        height = nothing if self.profile is None else self.profile(along, 0)
        slope = nothing if self.profile is None else self.profile(along, 1)
        cant = nothing if self.cant is None else self.cant.at(along)
        columns = (points[:, 0], points[:, 1], wrap_angle(bearing), bend, height, slope, cant)
        return DesignPoints(where, *(np.ascontiguousarray(column).reshape(where.shape) for column in columns))

    def project(
        self, easting: ArrayLike, northing: ArrayLike, *, near: ArrayLike | None = None, within: float = 50.0
    ) -> FootPoints:
        """Foot points on the design.

        Parameters
        ----------
        easting, northing : float or (n,) array
            Points of the plane, m.
        near : (n,) array, optional
            Stations near which the feet lie: for designs that cross or meet themselves.
        within : float
            How far from `near` they may lie, m.

        Returns
        -------
        FootPoints
            The nearest foot, whatever its distance: that is the caller's to judge.

        Raises
        ------
        TrackError
            Coordinates that are not finite, or arrays that differ in length.
        """
        from scipy.spatial import cKDTree

        east, north = np.atleast_1d(np.asarray(easting, np.float64)), np.atleast_1d(np.asarray(northing, np.float64))
        if east.shape != north.shape or east.ndim != 1:
            raise TrackError(f"{east.size} eastings and {north.size} northings; give as many of both")
        if not (np.isfinite(east).all() and np.isfinite(north).all()):
            row = int(np.flatnonzero(~(np.isfinite(east) & np.isfinite(north)))[0])
            raise TrackError(f"point {row + 1} is not finite")
        samples = self._samples()
        points, _, _ = self._plan_at(samples)
        if near is None:
            _, nearest = cKDTree(points).query(np.column_stack([east, north]))
            low, high = np.zeros(len(east)), np.full(len(east), self.length)
            at = samples[np.asarray(nearest, np.int64)]
        else:
            guess = np.broadcast_to(np.asarray(near, np.float64) - self.start, east.shape)
            low = np.clip(guess - within, 0.0, self.length)
            high = np.clip(guess + within, 0.0, self.length)
            at = self._nearest_of(samples, points, east, north, low, high)
        for _ in range(8):
            foot, bearing, bend = self._plan_at(at)
            de, dn = east - foot[:, 0], north - foot[:, 1]
            forward = de * np.sin(bearing) + dn * np.cos(bearing)
            across = de * np.cos(bearing) - dn * np.sin(bearing)
            step = forward / np.maximum(1.0 - across * bend, 0.1)
            moved = np.clip(at + step, low, high)
            done = np.abs(moved - at).max(initial=0.0) < 1e-10
            at = moved
            if done:
                break
        foot, bearing, _ = self._plan_at(at)
        de, dn = east - foot[:, 0], north - foot[:, 1]
        across = de * np.cos(bearing) - dn * np.sin(bearing)
        return FootPoints(at + self.start, across, np.hypot(de, dn))

    # --- within -------------------------------------------------------------------------------------------------------

    def _plan_at(self, along: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position (m, 2), bearing and curvature at lengths from the start; what elements miss each other by is spread."""
        points, bearing = integrate(self.plan, along)
        edges = self.plan.edges
        owner = np.clip(np.searchsorted(edges, along, side="left") - 1, 0, len(edges) - 2)
        share = (along - edges[owner]) / self.plan.length[owner]
        return points + self._gap[owner] * share[:, None], bearing, curvature(self.plan, owner, share)

    def _samples(self) -> FloatArray:
        """Lengths so close that between two of them the axis hardly turns."""
        sharp = np.maximum(np.abs(self.plan.curvature_start), np.abs(self.plan.curvature_end))
        step = np.minimum(_SAMPLE, _SAMPLE_TURN / np.maximum(sharp, 1e-9))
        count = np.maximum(1, np.ceil(self.plan.length / step).astype(np.int64))
        edges = self.plan.edges
        parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(edges, edges[1:], count, strict=False)]
        return np.append(np.concatenate(parts), edges[-1])

    @staticmethod
    def _nearest_of(
        samples: FloatArray, points: FloatArray, east: FloatArray, north: FloatArray, low: FloatArray, high: FloatArray
    ) -> FloatArray:
        first = np.clip(np.searchsorted(samples, low) - 1, 0, len(samples) - 1)
        last = np.clip(np.searchsorted(samples, high, side="right"), first + 1, len(samples))
        best = np.empty(len(east))
        for i, (a, b) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
            square = (points[a:b, 0] - east[i]) ** 2 + (points[a:b, 1] - north[i]) ** 2
            best[i] = samples[a + int(np.argmin(square))]
        return np.clip(best, low, high)


def design_of_elements(
    track: str,
    kinds: list[str] | tuple[str, ...],
    lengths: ArrayLike,
    radii: ArrayLike,
    *,
    easting: float = 0.0,
    northing: float = 0.0,
    grid_bearing: float = 0.0,
    start: float = 0.0,
    profile: Gradients | None = None,
    cant: Cant | None = None,
    crs: str = "",
) -> Design:
    """Join elements end to end, each tangent to the one before.

    Parameters
    ----------
    track : str
        Identifier.
    kinds : sequence of str
        "straight", "arc", "clothoid", "bloss", ...
    lengths : (n,) array
        m.
    radii : (n,) array
        Radius at the end of each element, positive to the right, 0 or inf for a straight, m. A transition leads from the radius of
        the element before (straight at the start).
    easting, northing, grid_bearing : float
        Start, m, rad.
    start : float
        Station there, m.
    profile, cant, crs
        As in `Design`.

    Raises
    ------
    TrackError
        A kind that is unknown, or arrays that differ in length.
    """
    length, radius = np.asarray(lengths, np.float64), np.asarray(radii, np.float64)
    if not len(kinds) == len(length) == len(radius):
        raise TrackError(f"{len(kinds)} kinds, {len(length)} lengths and {len(radius)} radii; give as many of each")
    unknown = [kind for kind in kinds if kind not in KIND_NAMES]
    if unknown:
        raise TrackError(f"{unknown[0]!r} is no known element; use {', '.join(KIND_NAMES)}")
    kind = np.array([KIND_NAMES.index(name) for name in kinds], np.int64)
    with np.errstate(divide="ignore"):
        end = np.where((radius == 0.0) | np.isinf(radius), 0.0, 1.0 / radius)
    begin = np.append(0.0, end[:-1])
    end = np.where(kind == 0, 0.0, end)
    begin = np.where(kind <= 1, end, begin)
    return Design(
        track,
        chain(kind, length, begin, end, easting=easting, northing=northing, grid_bearing=grid_bearing),
        start=start,
        profile=profile,
        cant=cant,
        crs=crs,
    )


def chain(
    kind: IntArray,
    length: FloatArray,
    curvature_start: FloatArray,
    curvature_end: FloatArray,
    *,
    easting: float,
    northing: float,
    grid_bearing: float,
    sway: FloatArray | None = None,
) -> Plan:
    """Plan of elements laid end to end: each starts where, and in the direction in which, the one before ends."""
    n = len(length)
    zero = np.zeros(n)
    sway = zero if sway is None else sway
    loose = Plan(length, kind, curvature_start, curvature_end, zero, zero, zero, sway)
    ends, bearing = integrate(loose, loose.edges)
    miss, turned = ends[1:], bearing[1:]
    starts = grid_bearing + np.append(0.0, np.cumsum(turned)[:-1])
    cos, sin = np.cos(starts), np.sin(starts)
    east = miss[:, 0] * cos + miss[:, 1] * sin
    north = -miss[:, 0] * sin + miss[:, 1] * cos
    return Plan(
        length,
        kind,
        curvature_start,
        curvature_end,
        easting + np.append(0.0, np.cumsum(east)[:-1]),
        northing + np.append(0.0, np.cumsum(north)[:-1]),
        starts,
        sway,
    )
