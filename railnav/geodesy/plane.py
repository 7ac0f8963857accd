"""A projected plane with the one transformation to it that is pinned, and its true scale.

`GridFrame` carries the operation's own text, so that a model read years later gives the same numbers whatever the registry then
prefers. Distances on the ground follow from the projection's scale, the height and the datum's own scale:
s = ((L/6)(1/k1 + 4/km + 1/k2))(1 + h/R_A), joined with the rise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import CrsError
from railnav.geodesy.projection import projection_of
from railnav.geodesy.transformation import DEGREE, PER_DEGREE, forward, inverse, registered

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GridFrame:
    """A projected plane g (easting, northing, height) with the one transformation from WGS 84 pinned to it.

    Values of this class compare, hash and pickle by their five fields; nothing else is kept in them.

    Attributes
    ----------
    crs_wkt : str
        The coordinate system, WKT2:2019 on one line (QGIS and GDAL open it).
    name : str
        Its name for people.
    pipeline : str
        The PROJ pipeline that is run: WGS 84 longitude, latitude (degrees), ellipsoidal height (m) to easting, northing,
        height (m). Heights are above the ellipsoid of the frame's own datum.
    operation : str
        What the registry calls that operation.
    accuracy : float
        Its stated accuracy, m; 0 where the operation defines the frame.

    Notes
    -----
    Coordinates may be scalars or arrays of one broadcast shape; the answer has that shape. A coordinate that is not finite
    or that the projection cannot take raises `CrsError`. A scalar position costs about 2 microseconds, an array 0.5
    microseconds a point.

    Examples
    --------
    >>> from railnav.geodesy.grid import choose_frame
    >>> frame = choose_frame(np.radians(47.5), np.radians(19.1))
    >>> frame.name, frame.accuracy
    ('WGS 84 / Gauss-Kruger zone 4', 0.0)
    """

    crs_wkt: str
    name: str
    pipeline: str
    operation: str
    accuracy: float

    def to_grid(
        self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Grid coordinates of WGS 84 positions.

        Parameters
        ----------
        latitude, longitude : float or array
            WGS 84, rad.
        height : float or array, optional
            Above the WGS 84 ellipsoid, m; where it is missing (None or NaN) the position is taken at height 0 and the
            height returned is NaN.

        Returns
        -------
        easting, northing, height : array of the broadcast shape
            m.

        Raises
        ------
        CrsError
            A position that is not finite or that the projection cannot take.

        Examples
        --------
        >>> from railnav.geodesy.grid import choose_frame
        >>> frame = choose_frame(np.radians(47.5), np.radians(21.0))
        >>> easting, northing, height = frame.to_grid(np.radians(47.5), np.radians(21.0), 120.0)
        >>> round(float(easting), 3), round(float(northing), 3), round(float(height), 3)
        (4500000.0, 5262834.867, 120.0)
        """
        if isinstance(latitude, float) and isinstance(longitude, float) and isinstance(height, float):  # one live fix
            one = forward(self.pipeline, longitude * PER_DEGREE, latitude * PER_DEGREE, height)
            if math.isfinite(one[0]) and math.isfinite(one[1]) and math.isfinite(one[2]):
                return one
        latitude, longitude, height_, missing = _positions(latitude, longitude, height)
        easting, northing, up = forward(self.pipeline, longitude * PER_DEGREE, latitude * PER_DEGREE, height_)
        _refuse_unprojected(self, (easting, northing, up), latitude, longitude, geodetic=True)
        return _shaped(easting, latitude), _shaped(northing, latitude), _shaped(np.where(missing, np.nan, up), latitude)

    def to_geodetic(
        self, easting: ArrayLike, northing: ArrayLike, height: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """WGS 84 positions of grid coordinates: the inverse of `to_grid`.

        Parameters
        ----------
        easting, northing : float or array
            Grid, m.
        height : float or array, optional
            Grid height, m; missing (None or NaN) is treated as 0 and returned as NaN.

        Returns
        -------
        latitude, longitude : array of the broadcast shape
            WGS 84, rad.
        height : array of the broadcast shape
            Above the WGS 84 ellipsoid, m.

        Raises
        ------
        CrsError
            A position that is not finite or lies outside the plane.

        Examples
        --------
        >>> from railnav.geodesy.grid import choose_frame
        >>> frame = choose_frame(np.radians(47.5), np.radians(21.0))
        >>> latitude, longitude, _ = frame.to_geodetic(4500000.0, 5262834.867)
        >>> round(float(np.degrees(latitude)), 6), round(float(np.degrees(longitude)), 6)
        (47.5, 21.0)
        """
        if isinstance(easting, float) and isinstance(northing, float) and isinstance(height, float):
            longitude, latitude, up = inverse(self.pipeline, easting, northing, height)
            if math.isfinite(longitude) and math.isfinite(latitude) and math.isfinite(up):
                return latitude * DEGREE, longitude * DEGREE, up
        easting, northing, height_, missing = _positions(easting, northing, height)
        longitude, latitude, up = inverse(self.pipeline, easting, northing, height_)
        _refuse_unprojected(self, (longitude, latitude, up), easting, northing, geodetic=False)
        return (
            _shaped(latitude * DEGREE, easting),
            _shaped(longitude * DEGREE, easting),
            _shaped(np.where(missing, np.nan, up), easting),
        )

    def convergence(self, easting: ArrayLike, northing: ArrayLike) -> FloatArray:
        """Grid convergence: the true azimuth of grid north, rad; heading = grid_bearing + convergence.

        Parameters
        ----------
        easting, northing : float or array
            Grid, m.

        Returns
        -------
        array of the broadcast shape
            rad, in (-pi, pi]; positive east of the central meridian in the northern hemisphere.

        Notes
        -----
        Of the projection alone: true north is that of the frame's own datum, within 4e-5 rad of that of WGS 84. Closed
        for the transverse Mercator (Karney's series, 1e-14 rad); by derivatives of the projection otherwise (1e-11 rad).

        References
        ----------
        Karney, C. F. F.: Transverse Mercator with an accuracy of a few nanometers. J. Geodesy 85 (2011), eqs 24 to 29.

        Examples
        --------
        >>> from railnav.geodesy.grid import choose_frame
        >>> frame = choose_frame(np.radians(47.5), np.radians(21.0))
        >>> round(float(np.degrees(frame.convergence(4600000.0, 5263000.0))), 4)
        0.9784
        """
        return self._factor(1, easting, northing)

    def point_scale(self, easting: ArrayLike, northing: ArrayLike) -> FloatArray:
        """Point scale of the projection, k: grid metres per metre on the ellipsoid of the frame's datum.

        Parameters
        ----------
        easting, northing : float or array
            Grid, m.

        Returns
        -------
        array of the broadcast shape
            k; the square root of the areal scale where the projection is not exactly conformal.

        Examples
        --------
        >>> from railnav.geodesy.grid import choose_frame
        >>> frame = choose_frame(np.radians(47.5), np.radians(21.0))
        >>> round(float(frame.point_scale(4600000.0, 5263000.0) - 1) * 1e6, 1)  # ppm, 100 km off the meridian
        122.8
        """
        return self._factor(2, easting, northing)

    def _factor(self, which: int, easting: ArrayLike, northing: ArrayLike) -> FloatArray:
        """One of latitude, convergence, point scale."""
        projection = projection_of(self.pipeline)
        if isinstance(easting, float) and isinstance(northing, float) and math.isfinite(easting + northing):
            value: FloatArray = projection.factors(np.array([easting]), np.array([northing]))[which][0]
            return value
        east, north = broadcast(easting, northing)
        refuse_not_finite(east, north)
        return _shaped(projection.factors(east.ravel(), north.ravel())[which], east)

    def ground_scale(
        self, easting: ArrayLike, northing: ArrayLike, height: ArrayLike | None, grid_bearing: ArrayLike
    ) -> FloatArray:
        """Grid metres per horizontal metre on the ground in a direction, k/(1 + h/R_A), with the datum's own scale.

        Parameters
        ----------
        easting, northing : float or array
            Grid, m.
        height : float or array or None
            Grid height, m; missing (None or NaN) means height 0.
        grid_bearing : float or array
            Direction from grid north, rad.

        Returns
        -------
        array of the broadcast shape
            Scale: divide a horizontal grid length by it to have ground metres.

        Notes
        -----
        R_A is the Euler radius in the direction's true azimuth. A datum joined to WGS 84 with a scale (DHDN 6.7 ppm,
        DB_REF 8.0 ppm, Pulkovo 1942 -0.22 ppm) has metres of another length than the ground's; that is in the figure.

        Examples
        --------
        >>> from railnav.geodesy.grid import choose_frame
        >>> frame = choose_frame(np.radians(47.5), np.radians(21.0))
        >>> round(float(frame.ground_scale(4500000.0, 5263000.0, 100.0, 0.0) - 1) * 1e6, 1)  # ppm, on the meridian
        -15.7
        """
        easting, northing, height_, bearing = broadcast(
            easting, northing, 0.0 if height is None else height, grid_bearing
        )
        refuse_not_finite(easting, northing, bearing)
        height_ = np.where(np.isnan(height_), 0.0, height_)
        scale = projection_of(self.pipeline).line_scale(
            easting.ravel(), northing.ravel(), height_.ravel(), bearing.ravel()
        )
        return _shaped(scale, easting)

    def ground_length(
        self,
        easting_1: ArrayLike,
        northing_1: ArrayLike,
        height_1: ArrayLike | None,
        easting_2: ArrayLike,
        northing_2: ArrayLike,
        height_2: ArrayLike | None,
    ) -> FloatArray:
        """True 3-D length on the ground of straight grid segments with even rise, m.

        s_ell = L (1/k1 + 4/km + 1/k2)/6, s = sqrt((s_ell (1 + h_m/R_A))^2 + (h2 - h1)^2), over the datum's own scale.

        Parameters
        ----------
        easting_1, northing_1, easting_2, northing_2 : float or array
            Ends, grid, m.
        height_1, height_2 : float or array or None
            Their grid heights, m; where either is missing (None or NaN) the length is horizontal at height 0.

        Returns
        -------
        array of the broadcast shape
            m.

        Notes
        -----
        Within 0.002 ppm of ECEF for segments of 1 m to 5 km, 200 km off the central meridian, heights to 800 m and
        slopes to 3 % (tests/geodesy/test_grid.py asks for 0.05).

        References
        ----------
        `spec/track_geometry.md`, section 1.6.

        Examples
        --------
        >>> from railnav.geodesy.grid import choose_frame
        >>> frame = choose_frame(np.radians(47.5), np.radians(21.0))
        >>> round(float(frame.ground_length(4600000.0, 5263000.0, 200.0, 4600000.0, 5264000.0, 200.0)), 4)
        999.9086
        """
        nothing = np.nan
        e1, n1, h1, e2, n2, h2 = broadcast(
            easting_1,
            northing_1,
            nothing if height_1 is None else height_1,
            easting_2,
            northing_2,
            nothing if height_2 is None else height_2,
        )
        refuse_not_finite(e1, n1, e2, n2)
        flat = np.isnan(h1) | np.isnan(h2)
        h1, h2 = np.where(flat, 0.0, h1), np.where(flat, 0.0, h2)
        length = projection_of(self.pipeline).ground_length(*(v.ravel() for v in (e1, n1, h1, e2, n2, h2)))
        return _shaped(length, e1)

    def __str__(self) -> str:
        """The plane's name."""
        return self.name

    @property
    def authority(self) -> tuple[str, int] | None:
        """Registry and code, e.g. ("EPSG", 28409), or None for a system that no registry lists."""
        return _authority(self.crs_wkt)


@lru_cache(maxsize=16)
def _authority(crs_wkt: str) -> tuple[str, int] | None:
    from pyproj import CRS

    return registered(CRS.from_wkt(crs_wkt))


# --- shapes and refusals -----------------------------------------------------------------------------------------------


def broadcast(*values: ArrayLike) -> list[FloatArray]:
    """Float arrays of one shape."""
    return [np.asarray(v) for v in np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in values))]


def _positions(
    first: ArrayLike, second: ArrayLike, height: ArrayLike | None
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    a, b, h = broadcast(first, second, np.nan if height is None else height)
    missing = np.isnan(h)
    return a, b, np.where(missing, 0.0, h), missing


def _shaped(value: FloatArray, like: FloatArray) -> FloatArray:
    return np.asarray(value, dtype=np.float64).reshape(like.shape)[()]


def refuse_not_finite(*values: FloatArray) -> None:
    """Refuse grid positions that are not finite."""
    for value in values:
        if not np.isfinite(value).all():
            i = int(np.argmax(~np.isfinite(value.ravel())))
            raise CrsError(f"grid position {i + 1} is not finite")


def _refuse_unprojected(
    frame: GridFrame, result: tuple[FloatArray, ...], first: FloatArray, second: FloatArray, *, geodetic: bool
) -> None:
    good = np.isfinite(result[0])
    for value in result[1:]:
        good = good & np.isfinite(value)
    if np.all(good):
        return
    i = int(np.argmax(~np.atleast_1d(good).ravel()))
    a, b = float(np.ravel(first)[i]), float(np.ravel(second)[i])
    where = f"easting {a:g}, northing {b:g} m"
    if geodetic:
        where = f"latitude {math.degrees(a):g}, longitude {math.degrees(b):g} degrees"
    raise CrsError(f"position {i + 1} ({where}) cannot be transformed in {frame.name}; remove it or use another plane")
