"""Ellipsoids of revolution: radii of curvature, Cartesian coordinates and normal gravity.

Latitude, longitude and azimuth in radians (azimuth clockwise from true north), heights above the ellipsoid in metres,
Cartesian coordinates e (ECEF) in metres: x through the prime meridian, z along the axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """An ellipsoid of revolution with its normal gravity field.

    Attributes
    ----------
    name : str
        Usual name.
    semi_major_axis : float
        a, m.
    inverse_flattening : float
        1/f; 0 means a sphere.
    gravity_equator, gravity_pole : float
        Normal gravity on the ellipsoid at the equator and at the poles, m/s^2.

    Examples
    --------
    >>> float(round(WGS84.meridian_radius(0.0), 3)), float(round(WGS84.transverse_radius(0.0), 3))
    (6335439.327, 6378137.0)
    """

    name: str
    semi_major_axis: float
    inverse_flattening: float
    gravity_equator: float = 9.7803253359
    gravity_pole: float = 9.8321849378

    @property
    def flattening(self) -> float:
        """Flattening, f = (a - b)/a."""
        return 1.0 / self.inverse_flattening if self.inverse_flattening else 0.0

    @property
    def eccentricity_squared(self) -> float:
        """First eccentricity squared, e^2 = f (2 - f)."""
        return self.flattening * (2.0 - self.flattening)

    @property
    def semi_minor_axis(self) -> float:
        """Semi-minor axis, b = a (1 - f), m."""
        return self.semi_major_axis * (1.0 - self.flattening)

    def meridian_radius(self, latitude: ArrayLike) -> FloatArray:
        """Radius of curvature along the meridian, M = a (1 - e^2)/(1 - e^2 sin^2 latitude)^(3/2), m.

        Parameters
        ----------
        latitude : float or array
            Geodetic latitude, rad.

        Returns
        -------
        array of the shape of `latitude`
            M, m.

        Examples
        --------
        >>> round(float(WGS84.meridian_radius(0.9)), 3)
        6374676.649
        """
        e2 = self.eccentricity_squared
        sine = np.sin(np.asarray(latitude, dtype=np.float64))
        return np.asarray(self.semi_major_axis * (1.0 - e2) / (1.0 - e2 * sine * sine) ** 1.5)[()]

    def transverse_radius(self, latitude: ArrayLike) -> FloatArray:
        """Radius of curvature in the prime vertical, N = a/sqrt(1 - e^2 sin^2 latitude), m.

        Parameters
        ----------
        latitude : float or array
            Geodetic latitude, rad.

        Returns
        -------
        array of the shape of `latitude`
            N, m.

        Examples
        --------
        >>> round(float(WGS84.transverse_radius(0.9)), 3)
        6391277.164
        """
        sine = np.sin(np.asarray(latitude, dtype=np.float64))
        return np.asarray(self.semi_major_axis / np.sqrt(1.0 - self.eccentricity_squared * sine * sine))[()]

    def euler_radius(self, latitude: ArrayLike, azimuth: ArrayLike) -> FloatArray:
        """Radius of curvature of the normal section in an azimuth, 1/R = cos^2 A/M + sin^2 A/N (Euler), m.

        Parameters
        ----------
        latitude : float or array
            Geodetic latitude, rad.
        azimuth : float or array
            From true north, rad.

        Returns
        -------
        array of the broadcast shape
            R, m.

        Examples
        --------
        >>> float(WGS84.euler_radius(0.9, 0.0)) == float(WGS84.meridian_radius(0.9))
        True
        """
        cosine_squared = np.cos(np.asarray(azimuth, dtype=np.float64)) ** 2
        curvature = cosine_squared / self.meridian_radius(latitude) + (1.0 - cosine_squared) / self.transverse_radius(
            latitude
        )
        return np.asarray(1.0 / curvature)[()]

    def to_cartesian(
        self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike = 0.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cartesian coordinates of geodetic ones: X = (N + h) cos(lat) cos(lon), ..., Z = (N (1 - e^2) + h) sin(lat).

        Parameters
        ----------
        latitude, longitude : float or array
            Geodetic, rad.
        height : float or array, optional
            Above the ellipsoid, m.

        Returns
        -------
        x, y, z : array of the broadcast shape
            ECEF, m.

        Examples
        --------
        >>> x, y, z = WGS84.to_cartesian(0.0, 0.0, 100.0)
        >>> float(x), float(y), float(z)
        (6378237.0, 0.0, 0.0)
        """
        latitude = np.asarray(latitude, dtype=np.float64)
        longitude = np.asarray(longitude, dtype=np.float64)
        height = np.asarray(height, dtype=np.float64)
        radius = self.transverse_radius(latitude)
        across = (radius + height) * np.cos(latitude)
        z = (radius * (1.0 - self.eccentricity_squared) + height) * np.sin(latitude)
        x, y, z = np.broadcast_arrays(across * np.cos(longitude), across * np.sin(longitude), z)
        return x.copy()[()], y.copy()[()], z.copy()[()]

    def to_geodetic(self, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Geodetic coordinates of Cartesian ones: Bowring's start and two refinements.

        Parameters
        ----------
        x, y, z : float or array
            ECEF, m.

        Returns
        -------
        latitude, longitude, height : array of the broadcast shape
            rad, rad (in (-pi, pi]) and m above the ellipsoid.

        Notes
        -----
        Errors against `to_cartesian` stay below 3e-9 m (a few units in the last place of the coordinates) for heights
        from -10 km to 36,000 km. On the axis the longitude is 0 by convention; within some 43 km of the Earth's centre
        the foot point is not unique and the answer means nothing.

        References
        ----------
        Bowring, B. R.: Transformation from spatial to geographical coordinates. Survey Review 23 (181), 1976.

        Examples
        --------
        >>> latitude, longitude, height = WGS84.to_geodetic(6378237.0, 0.0, 0.0)
        >>> float(latitude), float(longitude), float(height)
        (0.0, 0.0, 100.0)
        """
        x, y, z = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (x, y, z)))
        a, b, e2 = self.semi_major_axis, self.semi_minor_axis, self.eccentricity_squared
        across = np.hypot(x, y)
        longitude = np.arctan2(y, x)
        reduced = np.arctan2(a * z, b * across)  # reduced latitude, Bowring's start
        for _ in range(3):
            latitude = np.arctan2(
                z + e2 / (1.0 - e2) * b * np.sin(reduced) ** 3, across - e2 * a * np.cos(reduced) ** 3
            )
            reduced = np.arctan2(b * np.sin(latitude), a * np.cos(latitude))
        sine, cosine = np.sin(latitude), np.cos(latitude)
        height = across * cosine + z * sine - a * np.sqrt(1.0 - e2 * sine * sine)
        return latitude[()], longitude[()], height[()]

    def normal_gravity(self, latitude: ArrayLike, height: ArrayLike = 0.0) -> FloatArray:
        """Normal gravity at a latitude (Somigliana), lessened with height by the free-air gradient 2 gamma h/a.

        gamma = (a gamma_a cos^2 lat + b gamma_b sin^2 lat)/sqrt(a^2 cos^2 lat + b^2 sin^2 lat).

        Parameters
        ----------
        latitude : float or array
            Geodetic latitude, rad.
        height : float or array, optional
            Above the ellipsoid, m.

        Returns
        -------
        array of the broadcast shape
            m/s^2, positive downwards.

        Notes
        -----
        On the ellipsoid exact for the adopted constants; at height h the linear term leaves up to 2.1e-8 h m/s^2 (flattening and
        rotation, largest at the equator); `railnav.inertial.gravity` has the full form.

        References
        ----------
        Somigliana, C., 1929; Moritz, H.: Geodetic Reference System 1980, eq. 4. `spec/rail.md` section 11, eq. 2.

        Examples
        --------
        >>> round(float(WGS84.normal_gravity(0.0)), 7), round(float(WGS84.normal_gravity(0.0, 1000.0)), 5)
        (9.7803253, 9.77726)
        """
        sine_squared = np.sin(np.asarray(latitude, dtype=np.float64)) ** 2
        cosine_squared = 1.0 - sine_squared
        a, b = self.semi_major_axis, self.semi_minor_axis
        gamma = (a * self.gravity_equator * cosine_squared + b * self.gravity_pole * sine_squared) / np.sqrt(
            a * a * cosine_squared + b * b * sine_squared
        )
        return np.asarray(gamma * (1.0 - 2.0 * np.asarray(height, dtype=np.float64) / a))[()]


WGS84 = Ellipsoid("WGS 84", 6378137.0, 298.257223563)
GRS80 = Ellipsoid("GRS 80", 6378137.0, 298.257222101, 9.7803267715, 9.8321863685)
KRASSOWSKY = Ellipsoid("Krassowsky 1940", 6378245.0, 298.3, 9.780, 9.832)
BESSEL = Ellipsoid("Bessel 1841", 6377397.155, 299.1528128)
PZ90 = Ellipsoid("PZ-90", 6378136.0, 298.257839303)
GSK2011 = Ellipsoid("GSK-2011", 6378136.5, 298.2564151)

#: Ellipsoids by the names used in PROJ.
ELLIPSOIDS = {
    "WGS84": WGS84,
    "GRS80": GRS80,
    "krass": KRASSOWSKY,
    "bessel": BESSEL,
    "PZ90": PZ90,
    "GSK2011": GSK2011,
}
