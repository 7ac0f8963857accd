"""The projected plane of a model: one coordinate system, one pinned transformation to it, and its true scale.

`choose_frame` picks the plane and pins one PROJ operation from WGS 84; `GridFrame` carries the operation's own text, so that
a model read years later gives the same numbers whatever the registry then prefers. Distances on the ground follow from the
projection's scale, the height and the datum's own scale: s = ((L/6)(1/k1 + 4/km + 1/k2))(1 + h/R_A), joined with the rise.
"""

from __future__ import annotations

import math
import warnings
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import CrsError
from railnav.geodesy.projection import projection_of
from railnav.geodesy.transformation import (
    DEGREE,
    PER_DEGREE,
    Extent,
    forward,
    inverse,
    pin_operation,
    registered,
    shortened,
    wrapped_deg,
)

if TYPE_CHECKING:
    import pyproj

FloatArray = NDArray[np.float64]

#: Largest |k - 1| of a usable plane: beyond, bearings and lengths are those of another country.
_LARGEST_DISTORTION = 0.01
#: Largest difference of scale between two directions: heading = grid_bearing + convergence then holds to 0.03 degrees.
_LARGEST_ANISOTROPY = 1e-3
#: Degrees that data may lie outside a registered area of use.
_AREA_MARGIN_DEG = 3.0

# EPSG codes of the Gauss-Kruger zones on the Krassowsky ellipsoid by width and zone, the eastern realisation first
_PULKOVO = {
    6: (
        {zone: 28400 + zone for zone in range(4, 33)},  # Pulkovo 1942
        {2: 3834, 3: 3835, 4: 3836},  # Pulkovo 1942(83)
        {2: 3833, 3: 3333, 4: 3334, 5: 3335},  # Pulkovo 1942(58)
    ),
    3: (
        {
            **{zone: 2516 + zone for zone in range(7, 34)},
            **{zone: 2517 + zone for zone in range(34, 65)},
            60: 3389,
        },
        {3: 2397, 4: 2398, 5: 2399, 6: 3841, 7: 4417, 8: 4434},
        {3: 3837, 4: 3838, 5: 3329, 6: 3330, 7: 3331, 8: 3332, 9: 3839, 10: 3840},
    ),
}


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
        east, north = _broadcast(easting, northing)
        _refuse_not_finite(east, north)
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
        >>> frame = choose_frame(np.radians(47.5), np.radians(21.0))
        >>> round(float(frame.ground_scale(4500000.0, 5263000.0, 100.0, 0.0) - 1) * 1e6, 1)  # ppm, on the meridian
        -15.7
        """
        easting, northing, height_, bearing = _broadcast(
            easting, northing, 0.0 if height is None else height, grid_bearing
        )
        _refuse_not_finite(easting, northing, bearing)
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
        >>> frame = choose_frame(np.radians(47.5), np.radians(21.0))
        >>> round(float(frame.ground_length(4600000.0, 5263000.0, 200.0, 4600000.0, 5264000.0, 200.0)), 4)
        999.9086
        """
        nothing = np.nan
        e1, n1, h1, e2, n2, h2 = _broadcast(
            easting_1,
            northing_1,
            nothing if height_1 is None else height_1,
            easting_2,
            northing_2,
            nothing if height_2 is None else height_2,
        )
        _refuse_not_finite(e1, n1, e2, n2)
        flat = np.isnan(h1) | np.isnan(h2)
        h1, h2 = np.where(flat, 0.0, h1), np.where(flat, 0.0, h2)
        length = projection_of(self.pipeline).ground_length(*(v.ravel() for v in (e1, n1, h1, e2, n2, h2)))
        return _shaped(length, e1)

    @property
    def authority(self) -> tuple[str, int] | None:
        """Registry and code, e.g. ("EPSG", 28409), or None for a system that no registry lists."""
        return _authority(self.crs_wkt)


def choose_frame(
    latitude: ArrayLike,
    longitude: ArrayLike,
    *,
    crs: Any = None,
    zone_width: int = 6,
    ellipsoid: str = "wgs84",
) -> GridFrame:
    """Choose the plane for data and pin the one transformation to it.

    Parameters
    ----------
    latitude, longitude : float or array
        Where the data lies, WGS 84, rad. The zone follows from the middle of all but the outermost half per cent of the
        longitudes, so that a few wild fixes do not move it.
    crs : str or pyproj.CRS, optional
        Any projected system in metres that points east and north: "EPSG:2056", WKT, a PROJ string; or "gk6", "gk3" for
        the Gauss-Krueger zone of that width.
    zone_width : {6, 3}
        Width of the Gauss-Krueger zones in degrees: zone z = floor(lon/6) + 1 with central meridian 6 z - 3, or
        z = round(lon/3) with 3 z; scale 1 on it, false easting z 1e6 + 500,000 m.
    ellipsoid : {"wgs84", "krassowsky", "bessel"}
        "wgs84": the pure projection of WGS 84, no datum shift, accuracy 0; "krassowsky": Pulkovo 1942,
        or west of it 1942(83) or 1942(58), whichever is joined to WGS 84 most closely; "bessel": DB_REF (3-degree zones 2 to 5, Germany).

    Returns
    -------
    GridFrame
        The plane with its pinned transformation.

    Raises
    ------
    CrsError
        No such system; a system that is not projected, not in metres, or not east and north; data outside it; or no
        transformation with a stated accuracy that this PROJ can run ("ballpark" ones are refused).

    Notes
    -----
    Coordinates run in the order easting, northing whatever the registry states. A system that itself states its link to
    WGS 84 (WKT BoundCRS, PROJ +towgs84) is taken at its word and has accuracy 0. Transformations that need grid files
    are left aside: a model must open the same everywhere.

    Examples
    --------
    >>> choose_frame(np.radians(47.5), np.radians([19.0, 20.4])).name
    'WGS 84 / Gauss-Kruger zone 4'
    >>> choose_frame(np.radians(47.4), np.radians(8.5), crs="EPSG:2056").accuracy
    1.0
    """
    extent = Extent.of(latitude, longitude)
    if isinstance(crs, str) and crs.strip().lower() in {"gk3", "gk6"}:
        zone_width, crs = int(crs.strip()[2]), None
    if zone_width not in {3, 6}:
        raise CrsError(f"Gauss-Krueger zones are 3 or 6 degrees wide, not {zone_width!r}; use zone_width=6 or 3")
    kind = ellipsoid.lower().replace("-", "").replace(" ", "").replace("_", "")
    if kind not in {"wgs84", "krassowsky", "krass", "bessel"}:
        raise CrsError(f"ellipsoid {ellipsoid!r} is not one of wgs84, krassowsky, bessel; name any other plane by crs=")
    if crs is not None:
        if kind != "wgs84":
            raise CrsError(f"crs={crs!r} brings its own ellipsoid; leave out ellipsoid={ellipsoid!r}")
        return _pin(_read_crs(crs), extent, asked=str(crs))
    if kind == "wgs84":
        return _pin(_gauss_krueger_wgs84(extent.longitude, zone_width), extent, asked=f"gk{zone_width}")
    if kind.startswith("krass"):
        return _pulkovo(extent, zone_width)
    code = _db_ref(extent, zone_width)
    return _pin(_read_crs(f"EPSG:{code}"), extent, asked=f"EPSG:{code}")


def frame_for_grid(easting: ArrayLike, northing: ArrayLike, *, crs: Any) -> GridFrame:
    """Pin the transformation of a plane in which coordinates are given already.

    Parameters
    ----------
    easting, northing : float or array
        Where the data lies, in that plane, m.
    crs : str or pyproj.CRS
        The plane, as for `choose_frame`; "gk6" and "gk3" read the zone from the false easting, int(easting/1e6).

    Returns
    -------
    GridFrame
        The plane with its pinned transformation.

    Raises
    ------
    CrsError
        As for `choose_frame`; also coordinates that are not of that plane.

    Examples
    --------
    >>> frame_for_grid(3462825.3, 5481774.8, crs="EPSG:31467").name
    'DHDN / 3-degree Gauss-Kruger zone 3'
    >>> frame_for_grid(4462825.3, 5481774.8, crs="gk6").name
    'WGS 84 / Gauss-Kruger zone 4'
    """
    from pyproj import Proj

    east, north = (v.ravel() for v in _broadcast(easting, northing))
    _refuse_not_finite(east, north)
    if len(east) == 0:
        raise CrsError("no coordinates to place a plane by; give at least one")
    if isinstance(crs, str) and crs.strip().lower() in {"gk3", "gk6"}:
        width = int(crs.strip()[2])
        zone = int(np.median(east) // 1e6)
        if not (0 if width == 3 else 1) <= zone <= 360 // width:
            raise CrsError(
                f"easting {np.median(east):.0f} has no Gauss-Krueger zone in front; name the plane by its EPSG code"
            )
        system = _gauss_krueger_wgs84(float(6 * zone - 3 if width == 6 else 3 * zone), width)
    else:
        system = _read_crs(crs)
    plain = system.source_crs if system.is_bound and system.source_crs is not None else system
    # the datum's own latitude and longitude: within some 200 m of those of WGS 84, near enough to choose by
    proj = Proj(plain)
    lon, lat = proj(east, north, inverse=True)
    again = np.hypot(*(np.subtract(a, b) for a, b in zip(proj(lon, lat), (east, north), strict=True)))
    bad = ~(np.abs(lat) <= 90.0) | ~(again < 1.0)
    if bad.any():
        i = int(np.argmax(bad))
        raise CrsError(
            f"coordinates {i + 1} (easting {east[i]:.0f}, northing {north[i]:.0f}) do not lie in {_label(system, crs)}; "
            "check the plane, and that easting and northing are not exchanged"
        )
    return _pin(system, Extent.of(np.radians(lat), np.radians(lon)), asked=str(crs))


def _zone_6(longitude_deg: float) -> int:
    return int((longitude_deg % 360.0) // 6.0) + 1


def _zone_3(longitude_deg: float) -> int:
    return math.floor((longitude_deg % 360.0) / 3.0 + 0.5) % 120


def _gauss_krueger_wgs84(longitude_deg: float, zone_width: int) -> pyproj.CRS:
    """Gauss-Krueger on WGS 84: the plane by default."""
    from pyproj import CRS

    if zone_width == 6:
        zone, words = _zone_6(longitude_deg), ""
        meridian = 6 * zone - 3
    else:
        zone, words = _zone_3(longitude_deg), "3-degree "
        meridian = 3 * zone
    meridian = meridian if meridian <= 180 else meridian - 360
    unit, degree = 'LENGTHUNIT["metre",1]', 'ANGLEUNIT["degree",0.0174532925199433]'
    wkt = (
        f'PROJCRS["WGS 84 / {words}Gauss-Kruger zone {zone}",{_wgs84_base()},'
        f'CONVERSION["{words or "6-degree "}Gauss-Kruger zone {zone}",METHOD["Transverse Mercator",ID["EPSG",9807]],'
        f'PARAMETER["Latitude of natural origin",0,{degree},ID["EPSG",8801]],'
        f'PARAMETER["Longitude of natural origin",{meridian},{degree},ID["EPSG",8802]],'
        'PARAMETER["Scale factor at natural origin",1,SCALEUNIT["unity",1],ID["EPSG",8805]],'
        f'PARAMETER["False easting",{zone * 1_000_000 + 500_000},{unit},ID["EPSG",8806]],'
        f'PARAMETER["False northing",0,{unit},ID["EPSG",8807]]],'
        f'CS[Cartesian,2],AXIS["easting (E)",east,ORDER[1],{unit}],AXIS["northing (N)",north,ORDER[2],{unit}]]'
    )
    return CRS.from_wkt(wkt)


@lru_cache(maxsize=1)
def _wgs84_base() -> str:
    """WGS 84 as the base of a projected system, as the registry writes it."""
    from pyproj import CRS

    wkt = str(CRS.from_epsg(32631).to_wkt("WKT2_2019"))
    return wkt[wkt.index("BASEGEOGCRS[") : wkt.index(",CONVERSION[")]


def _pulkovo(extent: Extent, zone_width: int) -> GridFrame:
    """Pin the zone of the Pulkovo 1942 realisation that is joined to WGS 84 most closely at the place."""
    from pyproj import CRS

    found: list[GridFrame] = []
    zone = _zone_6(extent.longitude) if zone_width == 6 else _zone_3(extent.longitude)
    for codes in _PULKOVO[zone_width]:
        if zone not in codes:
            continue
        system = CRS.from_epsg(codes[zone])
        area = system.area_of_use
        if area is not None and area.south - 1.0 <= extent.latitude <= area.north + 1.0:
            with suppress(CrsError):  # another realisation may have a transformation here
                found.append(_pin(system, extent, asked=f"EPSG:{codes[zone]}"))
    if found:
        return min(found, key=lambda frame: frame.accuracy)
    raise CrsError(
        f"no realisation of Pulkovo 1942 (Krassowsky) has a {zone_width}-degree Gauss-Krueger zone {zone} with a "
        f'transformation about {extent}; use ellipsoid="wgs84" or name a system by crs='
    )


def _db_ref(extent: Extent, zone_width: int) -> int:
    """EPSG code of the DB_REF zone."""
    zone = _zone_3(extent.longitude)
    if zone_width != 3:
        raise CrsError('on the Bessel ellipsoid only the 3-degree zones of DB_REF are known; use zone_width=3 or "gk3"')
    if not (2 <= zone <= 5 and 47.0 <= extent.latitude <= 55.5):
        raise CrsError(
            f"DB_REF (Bessel) covers Germany, zones 2 to 5, and the data lies about {extent}, zone {zone}; "
            'use ellipsoid="wgs84" or name a system by crs='
        )
    return 5680 + zone


def _read_crs(crs: Any) -> pyproj.CRS:
    """Any user input as a projected system in metres, east and north; or say why not."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError as ProjError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            system = CRS.from_user_input(crs)
    except (ProjError, TypeError, ValueError) as error:
        raise CrsError(
            f"PROJ knows no coordinate system {shortened(crs)!r}; give an EPSG code, WKT, a PROJ string, gk6 or gk3"
        ) from error
    plain = system.source_crs if system.is_bound and system.source_crs is not None else system
    label = _label(system, crs)
    if not plain.is_projected:
        raise CrsError(
            f"{label} is not a projected coordinate system; give one in metres (for instance gk6), not latitude and longitude"
        )
    axes = plain.axis_info
    directions = {axis.direction.lower() for axis in axes[:2]}
    if not (directions <= {"east", "north"} or plain.name.lower() == "unknown"):
        # polar systems write "south" for both axes; the determinant test in _pin settles what is left
        raise CrsError(
            f"the axes of {label} point {' and '.join(a.direction for a in axes[:2])}; use a system with east and north axes"
        )
    for axis in axes[:2]:
        if abs(axis.unit_conversion_factor - 1.0) > 1e-12:
            raise CrsError(f"{label} counts in {axis.unit_name}; use its sibling in metres")
    return system


def _label(system: pyproj.CRS, asked: Any) -> str:
    return f"{shortened(asked)} ({system.name})" if system.name not in {"unknown", "unnamed"} else shortened(asked)


def _pin(system: pyproj.CRS, extent: Extent, *, asked: str) -> GridFrame:
    """Pin one transformation from WGS 84 to a projected system and see that it serves the data."""
    from pyproj import CRS

    label = _label(system, asked)
    _refuse_far_outside(system, extent, label)
    pipeline, operation, accuracy = pin_operation(CRS.from_epsg(4979), system, extent)
    name = system.name if system.name not in {"unknown", "unnamed"} else shortened(asked)
    frame = GridFrame(" ".join(str(system.to_wkt("WKT2_2019")).split()), name, pipeline, operation, accuracy)
    _refuse_distorted(frame, extent, label, asked)
    return frame


@lru_cache(maxsize=16)
def _authority(crs_wkt: str) -> tuple[str, int] | None:
    from pyproj import CRS

    return registered(CRS.from_wkt(crs_wkt))


def _refuse_far_outside(system: pyproj.CRS, extent: Extent, label: str) -> None:
    area = system.area_of_use
    if area is None:
        return
    middle = 0.5 * (area.west + (area.east if area.east >= area.west else area.east + 360.0))
    half = 0.5 * ((area.east - area.west) % 360.0 or 360.0)
    outside = max(
        abs(wrapped_deg(extent.longitude - middle)) - half, extent.latitude - area.north, area.south - extent.latitude
    )
    if outside > _AREA_MARGIN_DEG:
        raise CrsError(
            f"the data lies about {extent}, {outside:.0f} degrees outside the area of use of {label} ({shortened(area.name)}); "
            "use a system made for that area, or gk6"
        )


def _refuse_distorted(frame: GridFrame, extent: Extent, label: str, asked: str) -> None:
    if max(abs(extent.south), abs(extent.north)) > 89.0:
        raise CrsError(
            f"the data lies within a degree of a pole, where {label} has no grid north; name a polar system by crs="
        )
    corners = [
        (a, b)
        for a in (extent.south, extent.latitude, extent.north)
        for b in (extent.west, extent.longitude, extent.east)
    ]
    latitude, longitude = np.radians(np.array(corners)).T
    easting, northing, _ = frame.to_grid(latitude, longitude, 0.0)
    plane = projection_of(frame.pipeline)
    back = frame.to_geodetic(easting, northing, 0.0)
    _, _, scale = plane.factors(easting, northing)
    stretch = float(np.max(np.abs(scale - 1.0)))
    turned = np.hypot(back[0] - latitude, np.remainder(back[1] - longitude + math.pi, 2 * math.pi) - math.pi)
    if stretch > _LARGEST_DISTORTION or not float(np.max(turned)) < 1e-8:
        remedy = "split the line or name one system for all of it by crs="
        if not asked.startswith("gk"):
            remedy = "split the line or use a system made for that area, or gk6"
        raise CrsError(
            f"{label} would change lengths by up to {stretch * 100:.2g} % over the data ({extent.west:.1f} to {extent.east:.1f} E, "
            f"{extent.south:.1f} to {extent.north:.1f} N); {remedy}"
        )
    anisotropy, handed = plane.shape(easting, northing)
    if not handed:
        raise CrsError(
            f"{label} does not run east and north where the data lies; use a system with east and north axes"
        )
    if anisotropy > _LARGEST_ANISOTROPY:
        raise CrsError(
            f"{label} is not conformal: scales differ by {anisotropy * 100:.2g} % between directions, and bearings with them; "
            "use a conformal system such as gk6"
        )


# --- shapes and refusals -----------------------------------------------------------------------------------------------


def _broadcast(*values: ArrayLike) -> list[FloatArray]:
    return [np.asarray(v) for v in np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in values))]


def _positions(
    first: ArrayLike, second: ArrayLike, height: ArrayLike | None
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    a, b, h = _broadcast(first, second, np.nan if height is None else height)
    missing = np.isnan(h)
    return a, b, np.where(missing, 0.0, h), missing


def _shaped(value: FloatArray, like: FloatArray) -> FloatArray:
    return np.asarray(value, dtype=np.float64).reshape(like.shape)[()]


def _refuse_not_finite(*values: FloatArray) -> None:
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
