"""The projected plane of a model: one coordinate system, one pinned transformation to it, and its true scale.

`choose_frame` picks the plane and pins one PROJ operation from WGS 84; `GridFrame` carries the operation's own text, so that
a model read years later gives the same numbers whatever the registry then prefers. Distances on the ground follow from the
projection's scale, the height and the datum's own scale: s = ((L/6)(1/k1 + 4/km + 1/k2))(1 + h/R_A), joined with the rise.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import CrsError
from railnav.geodesy.ellipsoid import Ellipsoid

if TYPE_CHECKING:
    import pyproj

FloatArray = NDArray[np.float64]

_DEGREE = math.pi / 180.0
_PER_DEGREE = 180.0 / math.pi

#: Largest |k - 1| of a usable plane: beyond, bearings and lengths are those of another country.
_LARGEST_DISTORTION = 0.01
#: Largest difference of scale between two directions: heading = grid_bearing + convergence then holds to 0.03 degrees.
_LARGEST_ANISOTROPY = 1e-3
#: Degrees that data may lie outside a registered area of use.
_AREA_MARGIN_DEG = 3.0
#: Step of the numerical derivatives of projections without a closed form, m.
_STEP = 1000.0

# EPSG codes of Pulkovo 1942 / 3-degree Gauss-Kruger, zones 7 to 64
_PULKOVO_3_DEGREE = {
    **{zone: 2516 + zone for zone in range(7, 34)},
    **{zone: 2517 + zone for zone in range(34, 60)},
    60: 3389,
    **{zone: 2517 + zone for zone in range(61, 65)},
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
        transformer = _transformer(self.pipeline)
        if isinstance(latitude, float) and isinstance(longitude, float) and isinstance(height, float):  # one live fix
            one: tuple[Any, Any, Any] = transformer.transform(longitude * _PER_DEGREE, latitude * _PER_DEGREE, height)
            if math.isfinite(one[0]) and math.isfinite(one[1]) and math.isfinite(one[2]):
                return one
        latitude, longitude, height_, missing = _positions(latitude, longitude, height)
        easting, northing, up = transformer.transform(longitude * _PER_DEGREE, latitude * _PER_DEGREE, height_)
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
        from pyproj.enums import TransformDirection

        easting, northing, height_, missing = _positions(easting, northing, height)
        longitude, latitude, up = _transformer(self.pipeline).transform(
            easting, northing, height_, direction=TransformDirection.INVERSE
        )
        _refuse_unprojected(self, (longitude, latitude, up), easting, northing, geodetic=False)
        return (
            _shaped(latitude * _DEGREE, easting),
            _shaped(longitude * _DEGREE, easting),
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
        Of the projection alone: true north is that of the frame's own datum, within 1e-5 rad of that of WGS 84. Closed
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
        easting, northing, _, _ = _positions(easting, northing, None)
        return _shaped(_plane(self.pipeline).factors(easting.ravel(), northing.ravel())[1], easting)

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
        easting, northing, _, _ = _positions(easting, northing, None)
        return _shaped(_plane(self.pipeline).factors(easting.ravel(), northing.ravel())[2], easting)

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
        scale = _plane(self.pipeline).line_scale(easting.ravel(), northing.ravel(), height_.ravel(), bearing.ravel())
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
        Within 0.035 ppm of ECEF for segments of 1 m to 5 km, 210 km off the central meridian, heights to 800 m and
        slopes to 3 % (tests/geodesy/test_grid.py); most of that is the vertical's turn along a sloped segment.

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
        length = _plane(self.pipeline).ground_length(*(v.ravel() for v in (e1, n1, h1, e2, n2, h2)))
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
        "wgs84": the pure projection of WGS 84, no datum shift, accuracy 0; "krassowsky": Pulkovo 1942; "bessel": DB_REF
        (3-degree zones 2 to 5, Germany).

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
    extent = _Extent.of(latitude, longitude)
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
    code = _pulkovo(extent, zone_width) if kind.startswith("krass") else _db_ref(extent, zone_width)
    return _pin(_read_crs(f"EPSG:{code}"), extent, asked=f"EPSG:{code}")


@dataclass(frozen=True, slots=True)
class _Extent:
    """Where data lies, degrees; east may exceed 180 where it crosses the antimeridian."""

    west: float
    south: float
    east: float
    north: float

    @classmethod
    def of(cls, latitude: ArrayLike, longitude: ArrayLike) -> _Extent:
        lat, lon = (np.degrees(v).ravel() for v in _broadcast(latitude, longitude))
        if len(lat) == 0:
            raise CrsError("no positions to choose a coordinate system by; give at least one")
        bad = ~(np.isfinite(lat) & np.isfinite(lon)) | (np.abs(lat) > 90.0) | (np.abs(lon) > 360.0)
        if bad.any():
            i = int(np.argmax(bad))
            raise CrsError(
                f"position {i + 1} is no geodetic one (latitude {lat[i]:g}, longitude {lon[i]:g} degrees); "
                "latitude and longitude are radians, in this order"
            )
        centre = math.degrees(
            math.atan2(float(np.median(np.sin(lon * _DEGREE))), float(np.median(np.cos(lon * _DEGREE))))
        )
        lon = centre + np.mod(lon - centre + 180.0, 360.0) - 180.0
        (south, north), (west, east) = np.quantile(lat, [0.005, 0.995]), np.quantile(lon, [0.005, 0.995])
        return cls(float(west), float(south), float(east), float(north))

    @property
    def longitude(self) -> float:
        return 0.5 * (self.west + self.east)

    @property
    def latitude(self) -> float:
        return 0.5 * (self.south + self.north)

    def __str__(self) -> str:
        return f"{self.latitude:.2f} N {self.longitude:.2f} E"


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


def _pulkovo(extent: _Extent, zone_width: int) -> int:
    """EPSG code of the Pulkovo 1942 zone."""
    zone = _zone_6(extent.longitude) if zone_width == 6 else _zone_3(extent.longitude)
    if zone_width == 6 and 4 <= zone <= 32:
        return 28400 + zone
    if zone_width == 3 and zone in _PULKOVO_3_DEGREE:
        return _PULKOVO_3_DEGREE[zone]
    raise CrsError(
        f"Pulkovo 1942 has no {zone_width}-degree Gauss-Krueger zone {zone} (data about {extent}); "
        'use ellipsoid="wgs84" or name a system by crs='
    )


def _db_ref(extent: _Extent, zone_width: int) -> int:
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
            f"PROJ knows no coordinate system {_shortened(crs)!r}; give an EPSG code, WKT, a PROJ string, gk6 or gk3"
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


def _shortened(text: Any) -> str:
    words = " ".join(str(text).split())
    return words if len(words) <= 80 else words[:77] + "..."


def _label(system: pyproj.CRS, asked: Any) -> str:
    return f"{_shortened(asked)} ({system.name})" if system.name not in {"unknown", "unnamed"} else _shortened(asked)


def _pin(system: pyproj.CRS, extent: _Extent, *, asked: str) -> GridFrame:
    """Pin one transformation from WGS 84 to a projected system and see that it serves the data."""
    from pyproj import CRS

    label = _label(system, asked)
    _refuse_far_outside(system, extent, label)
    pipeline, operation, accuracy = _operation(CRS.from_epsg(4979), system, extent)
    name = system.name if system.name not in {"unknown", "unnamed"} else _shortened(asked)
    frame = GridFrame(" ".join(str(system.to_wkt("WKT2_2019")).split()), name, pipeline, operation, accuracy)
    _refuse_distorted(frame, extent, label)
    return frame


def _operation(source: pyproj.CRS, target: pyproj.CRS, extent: _Extent) -> tuple[str, str, float]:
    """The best operation between two systems that has a stated accuracy and needs no grid: pipeline, name, accuracy (m)."""
    from pyproj.aoi import AreaOfInterest
    from pyproj.exceptions import ProjError
    from pyproj.transformer import TransformerGroup

    bound = target.is_bound or source.is_bound
    words = f"{_title(source)} to {_title(target)}"
    # PROJ takes an area wider than the data: an operation must hold a little beyond the outermost fix
    area: Any = AreaOfInterest(
        _wrapped(extent.west - 0.01),
        max(extent.south - 0.01, -90.0),
        _wrapped(extent.east + 0.01),
        min(extent.north + 0.01, 90.0),
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "best transformation is not available": decided here, below
            group = TransformerGroup(
                source.to_3d(), target.to_3d(), always_xy=True, area_of_interest=area, allow_ballpark=False
            )
    except ProjError as error:
        raise CrsError(f"PROJ has no transformation from {words}: {_shortened(error)}") from error
    why = "PROJ has none that it can run"
    for transformer in group.transformers:
        definition = str(transformer.definition)
        if "ballpark" in transformer.description.lower():
            why = "PROJ offers only a ballpark one, which leaves the coordinates as they are"
        elif "grids=" in definition:
            why = "it would need grid files"
        elif transformer.accuracy < 0 and not bound:
            why = "its accuracy is unknown"
        elif not definition.startswith("proj=") or not transformer.has_inverse:
            why = "it cannot be written down or run backwards"
        else:
            operation = _plain_operation(transformer.description)
            return definition, operation, max(float(transformer.accuracy), 0.0)
    if not group.transformers and group.unavailable_operations:
        why = "it would need grid files"
    raise CrsError(f"no usable transformation from {words} about {extent}: {why}; {_remedy(target)}")


def _title(system: pyproj.CRS) -> str:
    code = _registered(system)
    return f"{system.name} ({code[0]}:{code[1]})" if code else str(system.name)


def _remedy(target: pyproj.CRS) -> str:
    if target.is_compound:
        return "use its horizontal part alone (heights then stay ellipsoidal), or gk6"
    if not _registered(target):
        return "add the datum's link to WGS 84 (+towgs84= or a WKT BoundCRS), or use gk6"
    return "use another realisation of the datum, or a plane on WGS 84 such as gk6"


def _plain_operation(description: str) -> str:
    """An operation's name without the steps that only swap axes or promote dimensions."""
    steps = [step.strip() for step in description.split(" + ")]
    kept = [step for step in steps if not step.startswith(("axis order change", "Null geographic offset"))]
    return " + ".join(kept) or description


def _registered(system: pyproj.CRS) -> tuple[str, int] | None:
    code = system.to_authority(min_confidence=100)
    return (str(code[0]), int(code[1])) if code is not None and str(code[1]).isdigit() else None


@lru_cache(maxsize=16)
def _authority(crs_wkt: str) -> tuple[str, int] | None:
    from pyproj import CRS

    return _registered(CRS.from_wkt(crs_wkt))


def _wrapped(longitude_deg: float) -> float:
    return (longitude_deg + 180.0) % 360.0 - 180.0


def _refuse_far_outside(system: pyproj.CRS, extent: _Extent, label: str) -> None:
    area = system.area_of_use
    if area is None:
        return
    middle = 0.5 * (area.west + (area.east if area.east >= area.west else area.east + 360.0))
    half = 0.5 * ((area.east - area.west) % 360.0 or 360.0)
    outside = max(
        abs(_wrapped(extent.longitude - middle)) - half, extent.latitude - area.north, area.south - extent.latitude
    )
    if outside > _AREA_MARGIN_DEG:
        raise CrsError(
            f"the data lies about {extent}, {outside:.0f} degrees outside the area of use of {label} ({area.name}); "
            "use a system made for that area, or gk6"
        )


def _refuse_distorted(frame: GridFrame, extent: _Extent, label: str) -> None:
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
    plane = _plane(frame.pipeline)
    back = frame.to_geodetic(easting, northing, 0.0)
    _, _, scale = plane.factors(easting, northing)
    stretch = float(np.max(np.abs(scale - 1.0)))
    turned = np.hypot(back[0] - latitude, np.remainder(back[1] - longitude + math.pi, 2 * math.pi) - math.pi)
    if stretch > _LARGEST_DISTORTION or not float(np.max(turned)) < 1e-8:
        raise CrsError(
            f"{label} would change lengths by up to {stretch * 100:.2g} % over the data ({extent.west:.1f} to {extent.east:.1f} E, "
            f"{extent.south:.1f} to {extent.north:.1f} N); split the line or use a system made for that area, or gk6"
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


# --- a pinned pipeline at work -----------------------------------------------------------------------------------------


@lru_cache(maxsize=32)
def _transformer(pipeline: str) -> pyproj.Transformer:
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    try:
        return Transformer.from_pipeline(pipeline)
    except ProjError as error:
        raise CrsError(
            f"PROJ cannot run the pinned transformation {_shortened(pipeline)!r}: {_shortened(error)}"
        ) from error


def _steps(pipeline: str) -> list[dict[str, str]]:
    """The steps of a PROJ pipeline, each a dict of its parameters (flags have an empty value)."""
    steps: list[dict[str, str]] = [{}]
    for word in pipeline.split():
        if word in {"step", "+step"}:
            steps.append({})
            continue
        key, _, value = word.lstrip("+").partition("=")
        steps[-1][key] = value
    return [step for step in steps if step.get("proj", "pipeline") != "pipeline"]


_NOT_PROJECTIONS = {
    "affine", "axisswap", "cart", "deformation", "geogoffset", "gridshift", "helmert", "hgridshift", "molobadekas",
    "molodensky", "noop", "pop", "push", "set", "tinshift", "unitconvert", "vgridshift", "xyzgridshift", "latlong", "longlat",
}  # fmt: skip


def _text(steps: Sequence[dict[str, str]]) -> str:
    words = [" ".join(f"{key}={value}" if value else key for key, value in step.items()) for step in steps]
    return "proj=pipeline step proj=unitconvert xy_in=deg xy_out=rad step " + " step ".join(words)


@lru_cache(maxsize=32)
def _plane(pipeline: str) -> _Plane:
    steps = _steps(pipeline)
    at = next((i for i, step in enumerate(steps) if step["proj"] not in _NOT_PROJECTIONS), None)
    if at is None:
        raise CrsError(f"the pinned transformation {_shortened(pipeline)!r} has no map projection in it")
    from pyproj import Geod

    projection = steps[at]
    geod = Geod(
        " ".join(f"+{k}={projection[k]}" for k in ("ellps", "a", "b", "rf", "f", "R", "datum") if k in projection)
    )
    ellipsoid = Ellipsoid(projection.get("ellps", "custom"), geod.a, 1.0 / geod.f if geod.f else 0.0)
    datum_scale = 1.0  # metres of the datum per metre of WGS 84
    for step in steps[:at]:
        if step["proj"] in {"helmert", "molobadekas"}:
            factor = 1.0 + float(step.get("s", "0")) * 1e-6
            datum_scale *= 1.0 / factor if "inv" in step else factor
    text = _text(steps[at:])
    if (
        projection["proj"] in {"tmerc", "utm", "etmerc"}
        and at == len(steps) - 1
        and not {"axis", "approx", "inv"} & set(projection)
    ):
        return _TransverseMercator(ellipsoid, datum_scale, text, projection)
    return _Plane(ellipsoid, datum_scale, text)


class _Plane:
    """A map projection with the metre of its datum: flat arrays in, flat arrays out."""

    def __init__(self, ellipsoid: Ellipsoid, datum_scale: float, text: str) -> None:
        self.ellipsoid = ellipsoid
        self.datum_scale = datum_scale
        self.text = text

    def _derivatives(self, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latitude (n,) and ground metres (east, north) per grid metre (easting, northing), (n, 2, 2), on the ellipsoid."""
        from pyproj.enums import TransformDirection

        transformer = _transformer(self.text)
        offsets = np.array([0.0, -2.0, -1.0, 1.0, 2.0]) * _STEP
        weights = np.array([0.0, 1.0, -8.0, 8.0, -1.0]) / (12.0 * _STEP)  # fourth order, central
        lon0, lat0 = transformer.transform(easting, northing, direction=TransformDirection.INVERSE)
        latitude = lat0 * _DEGREE
        metres = np.empty((len(easting), 2, 2))
        to_east = self.ellipsoid.transverse_radius(latitude) * np.cos(latitude) * _DEGREE
        to_north = self.ellipsoid.meridian_radius(latitude) * _DEGREE
        for axis, (de, dn) in enumerate(((1.0, 0.0), (0.0, 1.0))):
            lon, lat = transformer.transform(
                easting[:, None] + de * offsets, northing[:, None] + dn * offsets, direction=TransformDirection.INVERSE
            )
            lon = np.remainder(lon - lon0[:, None] + 180.0, 360.0) - 180.0
            metres[:, 0, axis] = (lon @ weights) * to_east
            metres[:, 1, axis] = ((lat - lat0[:, None]) @ weights) * to_north
        if not np.isfinite(metres).all():
            i = int(np.argmax(~np.isfinite(metres).all(axis=(1, 2))))
            raise CrsError(f"position {i + 1} (E {easting[i]:g}, N {northing[i]:g}) lies outside the plane")
        return latitude, metres

    def factors(self, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude, convergence (rad) and point scale."""
        latitude, metres = self._derivatives(easting, northing)
        # the meridian's image runs along the second column of the inverse; grid north turns from it by the convergence
        convergence = np.arctan2(metres[:, 0, 1], metres[:, 0, 0])
        scale = 1.0 / np.sqrt(np.abs(np.linalg.det(metres)))
        return latitude, convergence, scale

    def shape(self, easting: FloatArray, northing: FloatArray) -> tuple[float, bool]:
        """Largest relative difference of scale between directions, and whether axes are right-handed (east, north)."""
        _, metres = self._derivatives(easting, northing)
        singular = np.linalg.svd(metres, compute_uv=False)
        return float(np.max(singular[:, 0] / singular[:, 1] - 1.0)), bool((np.linalg.det(metres) > 0.0).all())

    def _along(self, easting: FloatArray, northing: FloatArray, bearing: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Grid metres per metre on the datum's ellipsoid in a direction, and the Euler radius there, m."""
        latitude, metres = self._derivatives(easting, northing)
        east = metres[:, 0, 0] * np.sin(bearing) + metres[:, 0, 1] * np.cos(bearing)
        north = metres[:, 1, 0] * np.sin(bearing) + metres[:, 1, 1] * np.cos(bearing)
        return 1.0 / np.hypot(east, north), self.ellipsoid.euler_radius(latitude, np.arctan2(east, north))

    def line_scale(
        self, easting: FloatArray, northing: FloatArray, height: FloatArray, bearing: FloatArray
    ) -> FloatArray:
        """Grid metres per horizontal ground metre."""
        scale, radius = self._along(easting, northing, bearing)
        return scale / (1.0 + height / radius) * self.datum_scale

    def ground_length(
        self, e1: FloatArray, n1: FloatArray, h1: FloatArray, e2: FloatArray, n2: FloatArray, h2: FloatArray
    ) -> FloatArray:
        """Length of straight grid segments with even rise, ground metres."""
        de, dn = e2 - e1, n2 - n1
        bearing = np.arctan2(de, dn)
        k1, _ = self._along(e1, n1, bearing)
        km, radius = self._along(0.5 * (e1 + e2), 0.5 * (n1 + n2), bearing)
        k2, _ = self._along(e2, n2, bearing)
        ellipsoidal = np.hypot(de, dn) * (1.0 / k1 + 4.0 / km + 1.0 / k2) / 6.0
        horizontal = ellipsoidal * (1.0 + 0.5 * (h1 + h2) / radius)
        return np.asarray(np.hypot(horizontal, h2 - h1) / self.datum_scale)


class _TransverseMercator(_Plane):
    """Transverse Mercator: convergence and scale by Karney's series."""

    def __init__(self, ellipsoid: Ellipsoid, datum_scale: float, text: str, projection: dict[str, str]) -> None:
        super().__init__(ellipsoid, datum_scale, text)
        from railnav.geodesy._kernels import krueger_beta

        k0 = 0.9996 if projection["proj"] == "utm" else float(projection.get("k", projection.get("k_0", "1")))
        zone = projection.get("zone")
        meridian = 6.0 * int(zone) - 183.0 if zone else float(projection.get("lon_0", "0"))
        easting_0, northing_0 = _transformer(text).transform(meridian, 0.0)  # where the meridian meets the equator
        f = ellipsoid.flattening
        n = f / (2.0 - f)
        a = ellipsoid.semi_major_axis
        rectifying = a / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0 + n**6 / 256.0)
        head = [easting_0, northing_0, k0 * rectifying, k0 * rectifying / a, ellipsoid.eccentricity_squared]
        self.parameters: FloatArray = np.concatenate([head, krueger_beta(n)])

    def factors(self, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude, convergence (rad) and point scale."""
        from railnav.geodesy._kernels import transverse_mercator_factors

        latitude, convergence, scale = np.empty_like(easting), np.empty_like(easting), np.empty_like(easting)
        transverse_mercator_factors(easting, northing, self.parameters, latitude, convergence, scale)
        return latitude, convergence, scale

    def _along(self, easting: FloatArray, northing: FloatArray, bearing: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Grid metres per metre on the datum's ellipsoid (the same in every direction), and the Euler radius, m."""
        latitude, convergence, scale = self.factors(easting, northing)
        return scale, self.ellipsoid.euler_radius(latitude, bearing + convergence)


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
