"""Choosing the projected plane of a model: one coordinate system, and one pinned transformation to it.

`choose_frame` picks the plane by where the data lies, `frame_for_grid` by coordinates that are in it already; both pin one
operation from WGS 84 in a `railnav.geodesy.plane.GridFrame`.
"""

from __future__ import annotations

import math
import warnings
from contextlib import suppress
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from railnav.errors import CrsError
from railnav.geodesy.datums import datum_shift, find_datum, registered_shift, stand_in
from railnav.geodesy.plane import GridFrame, broadcast, refuse_not_finite
from railnav.geodesy.projection import projection_of
from railnav.geodesy.transformation import Extent, pin_operation, shortened, wrapped_deg

if TYPE_CHECKING:
    import pyproj

__all__ = ["GridFrame", "choose_frame", "frame_for_grid"]

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


def choose_frame(
    latitude: ArrayLike,
    longitude: ArrayLike,
    *,
    crs: Any = None,
    zone_width: int = 6,
    ellipsoid: str = "wgs84",
    operation: str | None = None,
) -> GridFrame:
    """Choose the plane for data and pin the one transformation to it.

    Parameters
    ----------
    latitude, longitude : float or array
        Where the data lies, WGS 84, rad. The zone follows from the middle of all but the outermost half per cent of the
        longitudes, so that a few wild fixes do not move it.
    crs : str, pyproj.CRS or GridFrame, optional
        Any projected system in metres that points east and north: "EPSG:2056", WKT, a PROJ string; or "gk6", "gk3" for
        the Gauss-Krueger zone of that width; or a plane that is pinned already (`railnav.io.frame_file.read_frame`).
    zone_width : {6, 3}
        Width of the Gauss-Krueger zones in degrees: zone z = floor(lon/6) + 1 with central meridian 6 z - 3, or
        z = round(lon/3) with 3 z; scale 1 on it, false easting z 1e6 + 500,000 m.
    ellipsoid : {"wgs84", "krassowsky", "bessel"}
        "wgs84": the pure projection of WGS 84, no datum shift, accuracy 0; "krassowsky": Pulkovo 1942,
        or west of it 1942(83) or 1942(58), whichever is joined to WGS 84 most closely; "bessel": DB_REF (3-degree zones 2 to 5, Germany).
    operation : str, optional
        The link of the plane's datum to WGS 84 where several are published: an EPSG code ("EPSG:1267"), or "table" for the
        chain of `railnav.geodesy.datums` (GOST 32453-2017, with GSK-2011 standing for WGS 84). By default the most accurate
        that PROJ can run, and the table where PROJ has none.

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
        if isinstance(crs, GridFrame):
            if operation is not None:
                raise CrsError(f"{crs.name} is pinned already; leave out operation={operation!r}")
            _refuse_distorted(crs, extent, crs.name, crs.name)
            return crs
        return _pin(read_plane(crs), extent, asked=str(crs), operation=operation)
    if operation is not None:
        raise CrsError(f"operation={operation!r} goes with crs=; name the plane")
    if kind == "wgs84":
        return _pin(_gauss_krueger_wgs84(extent.longitude, zone_width), extent, asked=f"gk{zone_width}")
    if kind.startswith("krass"):
        return _pulkovo(extent, zone_width)
    code = _db_ref(extent, zone_width)
    return _pin(read_plane(f"EPSG:{code}"), extent, asked=f"EPSG:{code}")


def frame_for_grid(easting: ArrayLike, northing: ArrayLike, *, crs: Any, operation: str | None = None) -> GridFrame:
    """Pin the transformation of a plane in which coordinates are given already.

    Parameters
    ----------
    easting, northing : float or array
        Where the data lies, in that plane, m.
    crs : str, pyproj.CRS or GridFrame
        The plane, as for `choose_frame`; "gk6" and "gk3" read the zone from the false easting, int(easting/1e6).
    operation : str, optional
        The link to WGS 84, as for `choose_frame`.

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

    east, north = (v.ravel() for v in broadcast(easting, northing))
    refuse_not_finite(east, north)
    if len(east) == 0:
        raise CrsError("no coordinates to place a plane by; give at least one")
    if isinstance(crs, GridFrame):
        latitude, longitude, _ = crs.to_geodetic(east, north, 0.0)
        return choose_frame(latitude, longitude, crs=crs, operation=operation)
    if isinstance(crs, str) and crs.strip().lower() in {"gk3", "gk6"}:
        width = int(crs.strip()[2])
        zone = int(np.median(east) // 1e6)
        if not (0 if width == 3 else 1) <= zone <= 360 // width:
            raise CrsError(
                f"easting {np.median(east):.0f} has no Gauss-Krueger zone in front; name the plane by its EPSG code"
            )
        system = _gauss_krueger_wgs84(float(6 * zone - 3 if width == 6 else 3 * zone), width)
    else:
        system = read_plane(crs)
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
    return _pin(system, Extent.of(np.radians(lat), np.radians(lon)), asked=str(crs), operation=operation)


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


def read_plane(crs: Any) -> pyproj.CRS:
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


def _pin(system: pyproj.CRS, extent: Extent, *, asked: str, operation: str | None = None) -> GridFrame:
    """Pin one transformation from WGS 84 to a projected system and see that it serves the data."""
    from pyproj import CRS

    label = _label(system, asked)
    _refuse_far_outside(system, extent, label)
    if operation is not None and operation.strip().lower() == "table":
        pipeline, words, accuracy = chained(system, extent, label)
    elif operation is not None and (named := _by_code(system, extent, label, operation)) is not None:
        pipeline, words, accuracy = named
    else:
        try:
            pipeline, words, accuracy = pin_operation(CRS.from_epsg(4979), system, extent, operation=operation)
        except CrsError:
            datum = find_datum(system)
            if operation is not None or system.is_bound or datum is None or datum.name not in ("PZ-90.11", "PZ-90.02"):
                raise  # of the others PROJ runs what holds here; the table would be taken beyond its country
            pipeline, words, accuracy = chained(system, extent, label)
    name = system.name if system.name not in {"unknown", "unnamed"} else shortened(asked)
    frame = GridFrame(" ".join(str(system.to_wkt("WKT2_2019")).split()), name, pipeline, words, accuracy)
    _refuse_distorted(frame, extent, label, asked)
    return frame


def chained(system: pyproj.CRS, extent: Extent, label: str) -> tuple[str, str, float]:
    """The chain of the datum table to a projected system: pipeline, name, accuracy.

    Its datum's plate-fixed companion (GSK-2011 in the east, ETRF2000 in the west) stands for WGS 84, as in the registry's own
    null transformations; `geodetic_frame(..., fixed_to=)` brings receivers to the same.
    """
    datum = find_datum(system)
    if datum is None:
        raise CrsError(
            f"the datum of {label} is not in the table of railnav.geodesy.datums; leave the operation to PROJ"
        )
    companion = stand_in(datum)
    latitude, longitude = np.radians([extent.south, extent.north]), np.radians([extent.west, extent.east])
    shift = datum_shift(companion, datum.name, latitude, longitude, target_epoch=2011.0 if datum.moving else None)
    return pipeline_through(system, shift.proj, label), f"WGS 84 as {companion}; {shift.operation}", shift.accuracy


def _by_code(system: pyproj.CRS, extent: Extent, label: str, code: str) -> tuple[str, str, float] | None:
    """A registry's Helmert transformation between the plane's datum and WGS 84, run as its numbers say; None for other kinds."""
    found = registered_shift(code) if code.partition(":")[2].strip().isdigit() else None
    if found is None:
        return None
    base = system.geodetic_crs
    ends = [found.source, found.target]
    if base is None or base.name not in ends or not any(end.startswith("WGS 84") for end in ends):
        raise CrsError(f"{code} leads from {found.source} to {found.target}, not from {label} to WGS 84")
    if found.shift.moves or found.accuracy < 0:
        raise CrsError(f"{code} ({found.name}) has no fixed parameters of stated accuracy; choose another")
    if found.bounds is not None:
        west, south, east, north = found.bounds
        beyond = max(extent.north - north, south - extent.south)
        if west <= east:
            beyond = max(beyond, extent.east - east, west - extent.west)
        if beyond > _AREA_MARGIN_DEG:
            raise CrsError(f"{code} ({found.name}) does not hold about {extent}; choose another")
    backwards = found.source == base.name
    words = f"{'Inverse of ' if backwards else ''}{found.name}"
    return pipeline_through(system, found.shift.step(inverse=backwards), label), words, found.accuracy


def pipeline_through(system: pyproj.CRS, steps: str, label: str) -> str:
    """The pipeline from WGS 84 by geocentric steps to a projected system."""
    from pyproj import CRS, Transformer

    base = system.geodetic_crs
    if base is None or system.is_compound:
        raise CrsError(f"{label} is no plane on a geodetic datum; use its horizontal part alone")
    plain = CRS.from_wkt(str(system.to_wkt("WKT2_2019"))).to_2d()
    projection = str(Transformer.from_crs(base.to_2d(), plain, always_xy=True).definition)
    turned = "step proj=unitconvert xy_in=deg xy_out=rad "
    if turned not in projection or base.ellipsoid is None or (base.prime_meridian and base.prime_meridian.longitude):
        raise CrsError(f"the projection of {label} cannot be written down as steps after longitude and latitude")
    ellipsoid = f"a={base.ellipsoid.semi_major_metre:.15g} rf={base.ellipsoid.inverse_flattening:.15g}"
    pipeline = f"proj=pipeline {turned}step proj=cart ellps=WGS84 {steps} step inv proj=cart {ellipsoid} step "
    return " ".join((pipeline + projection.split(turned, 1)[1].removeprefix("step ")).split())


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
