"""The map projection inside a pinned transformation: its scale, its convergence, and the metre of its datum."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from railnav.errors import CrsError
from railnav.geodesy.ellipsoid import Ellipsoid
from railnav.geodesy.transformation import DEGREE, shortened, steps, transformer

FloatArray = NDArray[np.float64]

#: Step of the numerical derivatives of projections without a closed form, m.
STEP = 1000.0

_NOT_PROJECTIONS = {
    "affine", "axisswap", "cart", "deformation", "geogoffset", "gridshift", "helmert", "hgridshift", "molobadekas",
    "molodensky", "noop", "pop", "push", "set", "tinshift", "unitconvert", "vgridshift", "xyzgridshift", "latlong", "longlat",
}  # fmt: skip


def _text(parts: Sequence[dict[str, str]]) -> str:
    words = [" ".join(f"{key}={value}" if value else key for key, value in step.items()) for step in parts]
    return "proj=pipeline step proj=unitconvert xy_in=deg xy_out=rad step " + " step ".join(words)


@lru_cache(maxsize=32)
def projection_of(pipeline: str) -> Projection:
    """Projection at the end of a pinned pipeline, made once."""
    parts = steps(pipeline)
    at = next((i for i, step in enumerate(parts) if step["proj"] not in _NOT_PROJECTIONS), None)
    if at is None:
        raise CrsError(f"the pinned transformation {shortened(pipeline)!r} has no map projection in it")
    from pyproj import Geod

    projection = parts[at]
    geod = Geod(
        " ".join(f"+{k}={projection[k]}" for k in ("ellps", "a", "b", "rf", "f", "R", "datum") if k in projection)
    )
    ellipsoid = Ellipsoid(projection.get("ellps", "custom"), geod.a, 1.0 / geod.f if geod.f else 0.0)
    datum_scale = 1.0  # metres of the datum per metre of WGS 84
    for step in parts[:at]:
        if step["proj"] in {"helmert", "molobadekas"}:
            factor = 1.0 + float(step.get("s", "0")) * 1e-6
            datum_scale *= 1.0 / factor if "inv" in step else factor
    text = _text(parts[at:])
    if (
        projection["proj"] in {"tmerc", "utm", "etmerc"}
        and at == len(parts) - 1
        and not {"axis", "approx", "inv"} & set(projection)
    ):
        return TransverseMercator(ellipsoid, datum_scale, text, projection)
    return Projection(ellipsoid, datum_scale, text)


class Projection:
    """A map projection with the metre of its datum: flat arrays in, flat arrays out."""

    def __init__(self, ellipsoid: Ellipsoid, datum_scale: float, text: str) -> None:
        self.ellipsoid = ellipsoid
        self.datum_scale = datum_scale
        self.text = text

    def _derivatives(self, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latitude (n,) and ground metres (east, north) per grid metre (easting, northing), (n, 2, 2), on the ellipsoid."""
        from pyproj.enums import TransformDirection

        run = transformer(self.text)
        offsets = np.array([0.0, -2.0, -1.0, 1.0, 2.0]) * STEP
        weights = np.array([0.0, 1.0, -8.0, 8.0, -1.0]) / (12.0 * STEP)  # fourth order, central
        lon0, lat0 = run.transform(easting, northing, direction=TransformDirection.INVERSE)
        latitude = lat0 * DEGREE
        metres = np.empty((len(easting), 2, 2))
        to_east = self.ellipsoid.transverse_radius(latitude) * np.cos(latitude) * DEGREE
        to_north = self.ellipsoid.meridian_radius(latitude) * DEGREE
        for axis, (de, dn) in enumerate(((1.0, 0.0), (0.0, 1.0))):
            lon, lat = run.transform(
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


class TransverseMercator(Projection):
    """Transverse Mercator: convergence and scale by Karney's series."""

    def __init__(self, ellipsoid: Ellipsoid, datum_scale: float, text: str, projection: dict[str, str]) -> None:
        super().__init__(ellipsoid, datum_scale, text)
        from railnav.geodesy._kernels import krueger_beta

        k0 = 0.9996 if projection["proj"] == "utm" else float(projection.get("k", projection.get("k_0", "1")))
        zone = projection.get("zone")
        meridian = 6.0 * int(zone) - 183.0 if zone else float(projection.get("lon_0", "0"))
        easting_0, northing_0 = transformer(text).transform(meridian, 0.0)  # where the meridian meets the equator
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
