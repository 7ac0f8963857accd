"""A plane for a whole trunk line: an oblique Mercator projection fitted so that plane metres are ground metres.

The axis, its azimuth and its scale are chosen by minimax: the largest |k R/(R + h) - 1| along the line is the least possible,
heights included. The axis may lie beside the line: scale grows there by (d/R)^2/2, which makes up for falling ground. A line
that bends or climbs too much for one plane is parted into sections; a junction has coordinates in both of its planes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import CrsError
from railnav.geodesy.ellipsoid import WGS84
from railnav.geodesy.grid import choose_frame
from railnav.geodesy.plane import GridFrame

FloatArray = NDArray[np.float64]

#: Points of a line that the fit looks at, at most.
FITTED_POINTS = 150
#: An axis stays within this of its line at the middle, and leans towards or from its ends by as much, km: further off, scale
#: changes by more than 2 mm/km with each kilometre to the side.
FARTHEST = 80.0
#: Easting and northing of the middle of a section, to a kilometre: everything on it is positive and looks like no zone.
FALSE = 1_000_000.0


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """One plane of a corridor.

    Attributes
    ----------
    frame : GridFrame
        The plane: what `choose_frame` and every reader take as `crs`.
    first, last : float
        Stations of the line between which it serves, m.
    station, distortion : (n,) array
        Along the line, m, and plane metres per ground metre less 1, heights included.
    parameters : dict
        Centre latitude and longitude, azimuth of the axis (degrees), scale on it.
    """

    frame: GridFrame
    first: float
    last: float
    station: FloatArray
    distortion: FloatArray
    parameters: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Junction:
    """Where two sections meet: one place with coordinates in both planes, and the angle between their norths.

    Attributes
    ----------
    station : float
        Along the line, m.
    latitude, longitude, height : float
        WGS 84, rad, m (NaN where unknown).
    before, after : tuple of float
        Easting, northing in the section before and after, m.
    turn : float
        grid_bearing after less grid_bearing before, of one direction, rad.
    """

    station: float
    latitude: float
    longitude: float
    height: float
    before: tuple[float, float]
    after: tuple[float, float]
    turn: float


@dataclass(frozen=True, slots=True, eq=False)
class Corridor:
    """The planes of a line.

    Attributes
    ----------
    sections : tuple of Section
    junctions : tuple of Junction
    length : float
        Of the line on the ground, m.
    """

    sections: tuple[Section, ...]
    junctions: tuple[Junction, ...]
    length: float

    @property
    def largest(self) -> float:
        """Largest |distortion| anywhere on the line."""
        return float(max(np.abs(section.distortion).max() for section in self.sections))


def fit_corridor(
    latitude: ArrayLike,
    longitude: ArrayLike,
    height: ArrayLike | None = None,
    *,
    section_length: float | None = None,
    overlap: float = 5000.0,
    base: Any = "EPSG:4326",
    name: str = "Corridor",
) -> Corridor:
    """Fit the plane, or the planes, of a line.

    Parameters
    ----------
    latitude, longitude : (n,) array
        Points of the line in order, WGS 84, rad; consecutive ones are joined by geodesics.
    height : (n,) array, optional
        Heights above the ellipsoid, m; without them the ground is taken to be the ellipsoid.
    section_length : float, optional
        Part the line into equal sections no longer than this, m. Without it there is one.
    overlap : float
        How far each section serves beyond its junctions, m.
    base : str or pyproj.CRS
        The geographic system beneath ("EPSG:7683" for GSK-2011, "EPSG:4258" for ETRS89).
    name : str
        Name of the planes.

    Returns
    -------
    Corridor

    Raises
    ------
    CrsError
        Fewer than two points, a point that is none, a line shorter than a kilometre, or an impossible base.

    Notes
    -----
    Sequential linear programming over offset and azimuth of the axis, its scale and centre; some 20 ms a section. The centre of
    an axis that runs due north or east is moved by a millionth of a degree of azimuth, where the projection has its poles.

    References
    ----------
    `spec/track_geometry.md`, section 2. Snyder, J. P.: Map projections, a working manual. USGS PP 1395 (1987), pp. 66 to 75.

    Examples
    --------
    >>> places = np.radians([[55.776, 37.655], [56.84, 35.89], [57.88, 34.05], [58.85, 32.22], [59.93, 30.36]])
    >>> fit_corridor(*places.T).largest < 1e-6
    True
    """
    line = _densified(latitude, longitude, height)
    lat, _, up, bearing, station = line
    length = float(station[-1])
    if length < 1000.0:
        raise CrsError(f"a line of {length:.0f} m needs no corridor of its own; use gk6")
    parts = 1 if section_length is None else max(1, math.ceil(length / section_length - 1e-9))
    if parts > 999:
        raise CrsError(
            f"sections of {section_length} m make {parts} of a line of {length / 1e3:.0f} km; take longer ones"
        )
    bounds = np.linspace(0.0, length, parts + 1)
    sections = []
    for i in range(parts):
        first = max(bounds[i] - overlap, 0.0) if i else 0.0
        last = min(bounds[i + 1] + overlap, length)
        here = (station >= first - 1e-6) & (station <= last + 1e-6)
        title = name if parts == 1 else f"{name}, section {i + 1} of {parts}"
        lat_, lon_, up_, bearing_, station_ = (v[here] for v in line)
        sections.append(_section(lat_, lon_, up_, bearing_, station_, base, title))
    junctions = [
        _junction(float(at), line, sections[i].frame, sections[i + 1].frame) for i, at in enumerate(bounds[1:-1])
    ]
    ground = np.diff(station) * (1.0 + 0.5 * (up[1:] + up[:-1]) / WGS84.euler_radius(lat[1:], bearing[1:]))
    return Corridor(tuple(sections), tuple(junctions), float(ground.sum()))


def distortion(
    frame: GridFrame, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike | None = None
) -> FloatArray:
    """Plane metres per ground metre less 1 along a line, heights included.

    Parameters
    ----------
    frame : GridFrame
        The plane.
    latitude, longitude : (n,) array
        Points in order, rad.
    height : (n,) array, optional
        Above the ellipsoid, m.

    Returns
    -------
    (n,) array
        1e-6 is a part in a million, a millimetre a kilometre.
    """
    lat, lon = np.asarray(latitude, np.float64), np.asarray(longitude, np.float64)
    up = np.zeros_like(lat) if height is None else np.nan_to_num(np.asarray(height, np.float64))
    easting, northing, grid_height = frame.to_grid(lat, lon, up)
    bearing = np.arctan2(np.gradient(easting), np.gradient(northing))
    return np.asarray(frame.ground_scale(easting, northing, grid_height, bearing) - 1.0)


def ground_profile(
    latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike | None
) -> tuple[FloatArray, FloatArray]:
    """Station and height (m) of the ground that the fit sees, (n,) arrays."""
    _, _, up, _, station = _densified(latitude, longitude, height)
    return station, up


# --- the line ---------------------------------------------------------------------------------------------------------

_Line = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


def _densified(latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike | None) -> _Line:
    """Latitude, longitude, height, azimuth, station of enough points, on geodesics between the given ones."""
    from pyproj import Geod

    lat, lon = (np.degrees(np.asarray(v, np.float64)).ravel() for v in (latitude, longitude))
    up = np.zeros(len(lat)) if height is None else np.asarray(height, np.float64).ravel()
    if not len(lat) == len(lon) == len(up) or len(lat) < 2:
        raise CrsError(f"a line needs two points at least, each with latitude and longitude; there are {len(lat)}")
    bad = ~(np.isfinite(lat) & np.isfinite(lon)) | (np.abs(lat) > 89.0)
    if bad.any():
        raise CrsError(f"point {int(np.argmax(bad)) + 1} of the line is none")
    geod = Geod(ellps="WGS84")
    azimuth, _, step = geod.inv(lon[:-1], lat[:-1], lon[1:], lat[1:])
    known = np.concatenate([[0.0], np.cumsum(step)])
    keep = np.concatenate([[True], np.diff(known) > 0.0])
    if keep.sum() < 2:
        raise CrsError("all points of the line are one place")
    lat, lon, up, known = lat[keep], lon[keep], up[keep], known[keep]
    measured = np.isfinite(up)  # between places with a height it is linear, beyond them level
    azimuth, _, step = geod.inv(lon[:-1], lat[:-1], lon[1:], lat[1:])
    count = max(2, min(4000, round(known[-1] / 500.0)))
    station = np.union1d(np.linspace(0.0, known[-1], count), known if len(known) <= 2000 else known[[0, -1]])
    leg = np.clip(np.searchsorted(known, station, side="right") - 1, 0, len(step) - 1)
    out_lon, out_lat, back = geod.fwd(lon[leg], lat[leg], azimuth[leg], station - known[leg])
    return (
        np.radians(out_lat),
        np.radians(out_lon),
        np.interp(station, known[measured], up[measured]) if measured.any() else np.zeros_like(station),
        np.radians(np.asarray(back) + 180.0),
        station,
    )


# --- the fit ----------------------------------------------------------------------------------------------------------


def _section(
    lat: FloatArray,
    lon: FloatArray,
    up: FloatArray,
    bearing: FloatArray,
    station: FloatArray,
    base: Any,
    name: str,
) -> Section:
    from pyproj import Proj

    bend = np.abs(np.diff(np.unwrap(bearing), 2, prepend=0.0, append=0.0)) + np.abs(
        np.diff(up, 2, prepend=0.0, append=0.0)
    )
    corners = np.argsort(bend)[::-1][
        : FITTED_POINTS // 2
    ]  # where the line turns or the ground breaks: extremes lie there
    rows = np.union1d(np.linspace(0, len(lat) - 1, min(len(lat), FITTED_POINTS)).astype(int), corners)
    wanted = np.log1p(up[rows] / WGS84.euler_radius(lat[rows], bearing[rows]))
    start = _first_guess(lat[rows], lon[rows])
    best, value = start, np.inf
    for middle in (start, *(np.array([start[0], shift, start[2], start[3]]) for shift in (-40e3, 40e3))):
        if value < 1e-8:
            break
        found, largest = _minimax(middle, start, lat[rows], lon[rows], wanted)
        if largest < value * 0.999:
            best, value = found, largest
    centre_lat, centre_lon, azimuth, k0 = _numbers(best, start)
    text = f"+proj=omerc +lat_0={centre_lat!r} +lonc={centre_lon!r} +alpha={azimuth!r} +gamma={azimuth!r} +k_0={k0!r} +ellps=WGS84"
    plane = Proj(text)(np.degrees(lon), np.degrees(lat))
    false_east, false_north = (round((FALSE - 0.5 * (float(v.min()) + float(v.max()))) / 1e3) * 1e3 for v in plane)
    system = _oblique_mercator(base, name, centre_lat, centre_lon, azimuth, k0, false_east, false_north)
    frame = choose_frame(lat, lon, crs=system)
    parameters = {
        "centre_latitude_deg": centre_lat,
        "centre_longitude_deg": centre_lon,
        "azimuth_deg": azimuth,
        "scale": k0,
    }
    return Section(frame, float(station[0]), float(station[-1]), station, distortion(frame, lat, lon, up), parameters)


def _first_guess(lat: FloatArray, lon: FloatArray) -> FloatArray:
    """Centre (rad), azimuth of the great circle nearest to the points, and ln k: [lat, lon, azimuth, 0]."""
    x = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    _, _, rows = np.linalg.svd(x, full_matrices=False)
    pole = rows[2]
    middle = x.mean(axis=0) - (x.mean(axis=0) @ pole) * pole
    middle /= np.linalg.norm(middle)
    latitude, longitude = math.asin(middle[2]), math.atan2(middle[1], middle[0])
    along = np.cross(pole, middle)
    if along @ (x[-1] - x[0]) < 0:
        along = -along
    east = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
    north = np.cross(middle, east)
    return np.array([latitude, longitude, math.atan2(along @ east, along @ north), 0.0])


def _numbers(p: FloatArray, start: FloatArray) -> tuple[float, float, float, float]:
    """Centre latitude and longitude, azimuth in degrees, scale, of [turn (rad), shift to the right (m), ln k, along (m)]."""
    from pyproj import Geod

    geod = Geod(ellps="WGS84")
    if p is start:
        turn, shift, ln_k, along = 0.0, 0.0, 0.0, 0.0
    else:
        turn, shift, ln_k, along = (float(v) for v in p)
    azimuth = math.degrees(start[2])
    lon, lat, back = geod.fwd(math.degrees(start[1]), math.degrees(start[0]), azimuth, along)
    azimuth = float(back) + 180.0
    lon, lat, back = geod.fwd(lon, lat, azimuth + 90.0, shift)
    azimuth = float(back) + 90.0 + math.degrees(turn)
    # an axis has no sense of running; PROJ 9.5 takes an azimuth of 90 to 270 degrees for its mirror image
    azimuth = (azimuth + 90.0) % 180.0 - 90.0
    if azimuth % 90.0 < 1e-6 or azimuth % 90.0 > 90.0 - 1e-6:
        azimuth += 2e-6
    return float(lat), float(lon), azimuth, math.exp(ln_k)


def _log_scale(p: FloatArray, start: FloatArray, lat: FloatArray, lon: FloatArray) -> FloatArray:
    """Logarithm of the projection's scale at points."""
    from pyproj import Proj

    lat0, lon0, azimuth, k0 = _numbers(p, start)
    plane = Proj(
        f"+proj=omerc +lat_0={lat0!r} +lonc={lon0!r} +alpha={azimuth!r} +k_0=1 +ellps=WGS84", preserve_units=True
    )
    factors = plane.get_factors(np.degrees(lon), np.degrees(lat))
    return np.asarray(0.5 * np.log(np.asarray(factors.areal_scale)) + math.log(k0))


def _minimax(
    guess: FloatArray, start: FloatArray, lat: FloatArray, lon: FloatArray, wanted: FloatArray
) -> tuple[FloatArray, float]:
    """Least largest |ln k - wanted| by sequential linear programming with a trust region."""
    from scipy.optimize import linprog

    p = np.zeros(4) if guess is start else np.array([0.0, guess[1], 0.0, 0.0])
    units = np.array([1e-4, 1e3, 1e-6, 1e3])
    miss = _log_scale(p, start, lat, lon) - wanted
    p[2] -= 0.5 * (miss.max() + miss.min())
    miss = _log_scale(p, start, lat, lon) - wanted
    largest, trust = float(np.abs(miss).max()), 64.0
    reach = 0.5 * WGS84.semi_major_axis * float(np.hypot(np.ptp(lat), np.ptp(lon) * np.cos(lat.mean())))
    most = np.array([FARTHEST * 1e3 / reach, FARTHEST * 1e3, np.inf, FARTHEST * 1e3]) / units
    for _ in range(40):
        if trust < 1e-3 or largest < 1e-9:  # 0.001 ppm: a micrometre a kilometre
            break
        columns = []
        for k, unit in enumerate(units):
            if k == 2:
                columns.append(np.full(len(lat), unit))
                continue
            step = np.zeros(4)
            step[k] = unit
            columns.append(0.5 * (_log_scale(p + step, start, lat, lon) - _log_scale(p - step, start, lat, lon)))
        A = np.column_stack(columns) * 1e6
        y, ones = miss * 1e6, np.ones((len(lat), 1))
        answer = linprog(
            np.array([0.0, 0.0, 0.0, 0.0, 1.0]),
            A_ub=np.block([[A, -ones], [-A, -ones]]),
            b_ub=np.concatenate([-y, y]),
            bounds=[*_within(p / units, most, trust), (0.0, None)],
        )
        if answer.x is None:
            break
        trial = p + answer.x[:4] * units
        trial_miss = _log_scale(trial, start, lat, lon) - wanted
        trial_largest = float(np.abs(trial_miss).max())
        if trial_largest < largest * (1.0 - 1e-9):
            gain = (largest - trial_largest) / largest
            p, miss, largest, trust = trial, trial_miss, trial_largest, trust * 2.0
            if gain < 1e-4:
                break
        else:
            trust *= 0.25
    return p, largest


def _within(p: FloatArray, most: FloatArray, trust: float) -> list[tuple[float | None, float | None]]:
    """Lawful steps from p: inside the trust region, and not beyond `most` from the first guess."""
    steps: list[tuple[float | None, float | None]] = []
    for value, limit in zip(p.tolist(), most.tolist(), strict=True):
        steps.append((None, None) if math.isinf(limit) else (max(-trust, -limit - value), min(trust, limit - value)))
    return steps


def _oblique_mercator(
    base: Any,
    name: str,
    lat: float,
    lon: float,
    azimuth: float,
    k0: float,
    false_east: float = 0.0,
    false_north: float = 0.0,
) -> Any:
    """Hotine's oblique Mercator, variant B, north up at its natural origin, as a projected system."""
    from pyproj import CRS
    from pyproj.crs import ProjectedCRS
    from pyproj.crs.coordinate_operation import HotineObliqueMercatorBConversion
    from pyproj.exceptions import CRSError as ProjError

    try:
        geodetic = CRS.from_user_input(base)
    except ProjError as error:
        raise CrsError(f"PROJ knows no geographic system {base!r}; give an EPSG code such as EPSG:4258") from error
    if not geodetic.is_geographic:
        raise CrsError(f"{geodetic.name} is no geographic system; a corridor is projected from one, such as EPSG:4258")
    conversion = HotineObliqueMercatorBConversion(
        latitude_projection_centre=lat,
        longitude_projection_centre=lon,
        azimuth_projection_centre=azimuth,
        angle_from_rectified_to_skew_grid=azimuth,
        scale_factor_projection_centre=k0,
        easting_projection_centre=false_east,
        northing_projection_centre=false_north,
    )
    return CRS.from_wkt(ProjectedCRS(conversion, name, geodetic_crs=geodetic).to_wkt("WKT2_2019"))


def _junction(at: float, line: _Line, before: GridFrame, after: GridFrame) -> Junction:
    lat, lon, up, _, station = line
    i = int(np.argmin(np.abs(station - at)))
    here = (float(lat[i]), float(lon[i]), float(up[i]))
    e1, n1, _ = before.to_grid(*here)
    e2, n2, _ = after.to_grid(*here)
    turn = float(before.convergence(e1, n1) - after.convergence(e2, n2))
    return Junction(
        float(station[i]), *here, (float(e1), float(n1)), (float(e2), float(n2)), math.remainder(turn, 2 * math.pi)
    )


def compare_planes(
    latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike | None, planes: Sequence[GridFrame]
) -> list[dict[str, float | str]]:
    """What planes make of a line: least, largest and mean distortion (ppm), and the error of its whole length, m."""
    lat, lon, up, _, station = _densified(latitude, longitude, height)
    rows: list[dict[str, float | str]] = []
    for frame in planes:
        ppm = distortion(frame, lat, lon, up) * 1e6
        weight = np.gradient(station)
        rows.append(
            {
                "plane": frame.name,
                "least_ppm": float(ppm.min()),
                "largest_ppm": float(ppm.max()),
                "mean_ppm": float(np.average(ppm, weights=weight)),
                "length_error_m": float(np.average(ppm, weights=weight) * 1e-6 * station[-1]),
            }
        )
    return rows
