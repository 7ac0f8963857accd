"""Coordinates along a trunk line: a conformal projection about the axis of each link, and links joined into one line.

The ellipsoid is mapped conformally to a sphere whose scale is 1 to third order at the link's middle latitude, and the sphere to
the plane by a Mercator projection whose equator is the great circle through the link's ends. Lengths along the axis are true to
0.001 ppm over 100 km; off the axis scale grows by cross^2/(2 R^2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import CrsError
from railnav.geodesy.ellipsoid import WGS84, Ellipsoid

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Longest link, m: beyond, the axis' scale error passes 0.1 ppm.
LONGEST_LINK = 500e3


class AxisProjection:
    """Oblique conformal projection about the axis of one link.

    Parameters
    ----------
    start, finish : (latitude, longitude)
        Ends of the link, rad: along is 0 at start, cross is 0 at both.
    height : float
        Reference height, m: horizontal lengths at this height have scale 1.
    ellipsoid : Ellipsoid
        That of the datum.

    Attributes
    ----------
    length : float
        Length of the axis at the reference height, m.

    Raises
    ------
    CrsError
        Ends that coincide, lie more than 500 km apart, or within a degree of a pole.

    Notes
    -----
    R = sqrt(M0 N0), alpha = sqrt(1 + e^2 cos^4 phi0/(1 - e^2)), sin chi0 = sin phi0/alpha; chi, l on the sphere;
    w = B (cos chi cos l, cos chi sin l, sin chi); along = k R atan2(w2, w1), cross = -k R artanh(w3), k = 1 + H/R.
    0.001 ppm on the axis of a 100 km link, 0.003 of a 200 km link; 1.25 ppm at 10 km to the side. Round trip 1e-8 m.

    References
    ----------
    `spec/rail.md`, section 8.

    Examples
    --------
    >>> link = AxisProjection(np.radians((55.75, 37.6)), np.radians((56.3, 36.7)))
    >>> along, cross = link.to_axis(*np.radians((56.0, 37.2)))
    >>> round(float(along), 1), round(float(cross), 1)
    (37438.1, 210.9)
    """

    def __init__(
        self,
        start: ArrayLike,
        finish: ArrayLike,
        *,
        height: float = 0.0,
        ellipsoid: Ellipsoid = WGS84,
    ) -> None:
        p, q = np.asarray(start, np.float64), np.asarray(finish, np.float64)
        if p.shape != (2,) or q.shape != (2,) or not np.isfinite([*p, *q, height]).all():
            raise CrsError("a link has two ends, each latitude and longitude")
        if max(abs(p[0]), abs(q[0])) > math.radians(89.0):
            raise CrsError("a link within a degree of a pole has no conformal sphere; railways do not go there")
        self.ellipsoid, self.height = ellipsoid, float(height)
        self._e2 = ellipsoid.eccentricity_squared
        self._e = math.sqrt(self._e2)
        self._longitude = float(p[1] + 0.5 * math.remainder(q[1] - p[1], 2 * math.pi))
        middle = float(0.5 * (p[0] + q[0]))
        radius = math.sqrt(float(ellipsoid.meridian_radius(middle)) * float(ellipsoid.transverse_radius(middle)))
        self._alpha = math.sqrt(1.0 + self._e2 * math.cos(middle) ** 4 / (1.0 - self._e2))
        chi0 = math.asin(math.sin(middle) / self._alpha)
        self._ln_k = math.log(math.tan(math.pi / 4 + chi0 / 2)) - self._alpha * float(
            self._isometric(np.array([middle]))[0]
        )
        self._radius, self._scaled = radius, radius + self.height  # k R = (1 + H/R) R
        u, v = self._on_sphere(p[0], p[1]), self._on_sphere(q[0], q[1])
        n = np.cross(u, v)
        if np.linalg.norm(n) * radius < 1.0:
            raise CrsError("the ends of a link coincide; a link needs a metre at least")
        n /= np.linalg.norm(n)
        self._rows = np.stack([u, np.cross(n, u), n])
        self.length = float(self.to_axis(q[0], q[1])[0])
        if self.length > LONGEST_LINK:
            raise CrsError(
                f"a link of {self.length / 1e3:.0f} km is too long for one axis; part the line, 500 km at most"
            )

    def _isometric(self, latitude: FloatArray) -> FloatArray:
        """Isometric latitude."""
        sine = np.sin(latitude)
        return np.asarray(np.arcsinh(np.tan(latitude)) - self._e * np.arctanh(self._e * sine))

    def _on_sphere(self, latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
        """Unit vectors on the conformal sphere, (..., 3)."""
        q = self._ln_k + self._alpha * self._isometric(np.asarray(latitude, np.float64))
        chi = np.arctan(np.sinh(q))
        east = np.remainder(np.asarray(longitude, np.float64) - self._longitude + math.pi, 2 * math.pi) - math.pi
        lam = self._alpha * east
        return np.stack([np.cos(chi) * np.cos(lam), np.cos(chi) * np.sin(lam), np.sin(chi)], axis=-1)

    def to_axis(self, latitude: ArrayLike, longitude: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Axis coordinates of positions.

        Parameters
        ----------
        latitude, longitude : float or array
            Geodetic, in the datum of the ellipsoid, rad.

        Returns
        -------
        along, cross : array of the broadcast shape
            Along the axis from the link's start, and to the right of it, m.

        Raises
        ------
        CrsError
            A position that is not finite, or a quarter of the Earth away.
        """
        latitude, longitude = np.broadcast_arrays(latitude, longitude)
        w = self._on_sphere(latitude, longitude) @ self._rows.T
        good = np.isfinite(w).all(axis=-1) & (np.abs(w[..., 2]) < 0.7)
        if not good.all():
            i = int(np.argmin(np.ravel(good)))
            raise CrsError(f"position {i + 1} is not finite or lies on the other side of the Earth from the link")
        return self._scaled * np.arctan2(w[..., 1], w[..., 0]), -self._scaled * np.arctanh(w[..., 2])

    def to_geodetic(self, along: ArrayLike, cross: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude (rad) of axis coordinates (m): the inverse of `to_axis`."""
        x, y = np.broadcast_arrays(np.asarray(along, np.float64), np.asarray(cross, np.float64))
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise CrsError("axis coordinates are not finite")
        lam, b = x / self._scaled, np.arctan(np.sinh(-y / self._scaled))
        w = np.stack([np.cos(b) * np.cos(lam), np.cos(b) * np.sin(lam), np.sin(b)], axis=-1) @ self._rows
        chi = np.arcsin(np.clip(w[..., 2], -1.0, 1.0))
        longitude = np.arctan2(w[..., 1], w[..., 0]) / self._alpha + self._longitude
        q = (np.arcsinh(np.tan(chi)) - self._ln_k) / self._alpha
        latitude = chi
        for _ in range(8):  # each step gains a factor e^2
            latitude = np.arctan(np.sinh(q + self._e * np.arctanh(self._e * np.sin(latitude))))
        return np.asarray(latitude), np.asarray(np.remainder(longitude + math.pi, 2 * math.pi) - math.pi)

    def point_scale(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike = 0.0) -> FloatArray:
        """Axis metres per horizontal metre at a height above the ellipsoid, in every direction alike.

        k cosh(cross/kR) alpha R cos chi/(N cos phi), over 1 + h/R.
        """
        latitude, longitude, height = np.broadcast_arrays(latitude, longitude, height)
        _, cross = self.to_axis(latitude, longitude)
        chi = np.arctan(np.sinh(self._ln_k + self._alpha * self._isometric(np.asarray(latitude, np.float64))))
        sphere = (
            self._alpha * self._radius * np.cos(chi) / (self.ellipsoid.transverse_radius(latitude) * np.cos(latitude))
        )
        k = self._scaled / self._radius
        return np.asarray(k * np.cosh(cross / self._scaled) * sphere / (1.0 + np.asarray(height) / self._radius))


@dataclass(frozen=True, slots=True, eq=False)
class Addresses:
    """Addresses on a composite line; arrays of one shape.

    Attributes
    ----------
    link : int array
        Index of the link, from 0.
    along : array
        Along the axes from the start of the line, m: it runs on over the links.
    cross : array
        To the right of the link's axis, m.
    height : array
        Above the ellipsoid, m; NaN where unknown.
    """

    link: IntArray
    along: FloatArray
    cross: FloatArray
    height: FloatArray


class CompositeLine:
    """A trunk line as links from node to node, with one three-dimensional address for every place near it.

    Parameters
    ----------
    latitude, longitude : (n,) array
        The nodes, in order, rad.
    heights : (n - 1,) array, optional
        Reference height of each link, m: its mean height makes the line's lengths those of the ground.
    ellipsoid : Ellipsoid
        That of the datum.

    Attributes
    ----------
    links : tuple of AxisProjection
    start : (n,) array
        Distance along at which each link begins, and at last the line's length, m.

    Notes
    -----
    Neighbouring links meet in a node that has coordinates in both; there one turns into the other by the angle between their
    axes, to 0.01 mm within 2 km and 0.13 mm within 5 km of it (60 km links turning by 14 degrees). Inside the turn two links
    claim a place and outside of it none: the nearer one has it.

    References
    ----------
    `spec/rail.md`, section 8.

    Examples
    --------
    >>> line = CompositeLine(np.radians([55.75, 56.85, 59.93]), np.radians([37.6, 35.9, 30.33]))
    >>> here = line.address(np.radians(57.5), np.radians(34.9), 150.0)
    >>> int(here.link), round(float(here.along) / 1e3, 1), round(float(here.cross) / 1e3, 1)
    (1, 255.8, 2.8)
    """

    def __init__(
        self,
        latitude: ArrayLike,
        longitude: ArrayLike,
        *,
        heights: Sequence[float] | FloatArray | None = None,
        ellipsoid: Ellipsoid = WGS84,
    ) -> None:
        lat, lon = np.asarray(latitude, np.float64).ravel(), np.asarray(longitude, np.float64).ravel()
        if len(lat) != len(lon) or len(lat) < 2:
            raise CrsError(
                f"a line needs two nodes at least, each latitude and longitude; there are {len(lat)} and {len(lon)}"
            )
        levels = np.zeros(len(lat) - 1) if heights is None else np.asarray(heights, np.float64)
        if levels.shape != (len(lat) - 1,):
            raise CrsError(f"{len(lat) - 1} links need as many reference heights, not {levels.size}")
        places = np.column_stack([lat, lon])
        self.links = tuple(
            AxisProjection(a, b, height=float(h), ellipsoid=ellipsoid)
            for a, b, h in zip(places[:-1], places[1:], levels, strict=True)
        )
        self.start = np.concatenate([[0.0], np.cumsum([link.length for link in self.links])])

    def address(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike | None = None) -> Addresses:
        """Address of positions: the nearest link has each.

        Parameters
        ----------
        latitude, longitude : float or array
            rad.
        height : float or array, optional
            Above the ellipsoid, m.

        Returns
        -------
        Addresses
        """
        lat, lon, up = np.broadcast_arrays(
            *(np.asarray(v, np.float64) for v in (latitude, longitude, np.nan if height is None else height))
        )
        best = np.full(lat.shape, np.inf)
        link, along, cross = np.zeros(lat.shape, np.int64), np.zeros(lat.shape), np.zeros(lat.shape)
        for i, axis in enumerate(self.links):
            x, y = axis.to_axis(lat, lon)
            beyond = np.maximum(np.maximum(-x, x - axis.length), 0.0)
            away = np.hypot(beyond, y)
            nearer = away < best
            best = np.where(nearer, away, best)
            link, along, cross = (
                np.where(nearer, i, link),
                np.where(nearer, x + self.start[i], along),
                np.where(nearer, y, cross),
            )
        return Addresses(link, along[()], cross[()], np.array(up)[()])

    def position(self, address: Addresses) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude, longitude (rad) and height (m) of addresses: the exact inverse of `address`."""
        link = np.asarray(address.link)
        if link.size and (link.min() < 0 or link.max() >= len(self.links)):
            raise CrsError(f"link {int(link.min())}..{int(link.max())} is not one of 0..{len(self.links) - 1}")
        along, cross, _ = np.broadcast_arrays(address.along, address.cross, link)
        latitude, longitude = np.empty(link.shape), np.empty(link.shape)
        for i in np.unique(link):
            here = link == i
            latitude[here], longitude[here] = self.links[i].to_geodetic(along[here] - self.start[i], cross[here])
        return latitude[()], longitude[()], np.asarray(address.height)

    def on_link(self, address: Addresses, link: int) -> Addresses:
        """The same places addressed on another link, near a node for instance."""
        latitude, longitude, height = self.position(address)
        along, cross = self.links[link].to_axis(latitude, longitude)
        return Addresses(np.full(np.shape(latitude), link, np.int64), along + self.start[link], cross, height)

    def turn(self, node: int) -> float:
        """Angle by which the axis turns at an inner node, rad, positive to the right."""
        if not 0 < node < len(self.links):
            raise CrsError(f"node {node} is none between two links (1..{len(self.links) - 1})")
        before, after = self.links[node - 1], self.links[node]
        latitude, longitude = after.to_geodetic(np.array([0.0, 1.0]), np.zeros(2))
        along, cross = before.to_axis(latitude, longitude)
        return float(np.arctan2(cross[1] - cross[0], along[1] - along[0]))
