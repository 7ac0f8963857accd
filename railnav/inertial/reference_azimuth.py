"""Longitude from the azimuth of a reference point."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError
from railnav.geodesy.ellipsoid import Ellipsoid
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]


Azimuth = Literal["loxodrome", "sighted", "great_circle"]


@dataclass(frozen=True, slots=True)
class ReferenceLongitude:
    """Longitude from the azimuth of a reference point, with its error model.

    Attributes
    ----------
    longitude : float
        rad, in (-pi, pi].
    by_latitude, by_reference_latitude, by_azimuth : float
        Derivatives of the longitude on the loxodrome, good for short lines of every kind.
    """

    longitude: float
    by_latitude: float
    by_reference_latitude: float
    by_azimuth: float

    def sigma(self, latitude: float, reference_latitude: float, azimuth: float) -> float:
        """Standard deviation from those of latitude, reference latitude and azimuth, rad."""
        return math.hypot(
            self.by_latitude * latitude, self.by_reference_latitude * reference_latitude, self.by_azimuth * azimuth
        )


def longitude_from_reference(
    latitude: float,
    reference_latitude: float,
    reference_longitude: float,
    azimuth: float,
    *,
    kind: Azimuth = "great_circle",
    ellipsoid: Ellipsoid | None = None,
) -> ReferenceLongitude:
    """Longitude of a point of known latitude from the azimuth in which it sees a reference point.

    Loxodrome: lon = lon0 + [psi(lat) - psi(lat0)] tan A, psi(x) = asinh(tan x) (- e artanh(e sin x) on an ellipsoid).

    Parameters
    ----------
    latitude : float
        Of the point, rad.
    reference_latitude, reference_longitude : float
        rad.
    azimuth : float
        Of the reference from the point, clockwise from true north, rad.
    kind : {"great_circle", "sighted", "loxodrome"}, optional
        What the azimuth is. Sighted or gyrocompassed, it is the azimuth of the great circle at the point: solved as a spherical triangle,
        or ("sighted") by the loxodrome with the azimuth at half way, good to 2 m at 80 km and 5 km at 1,000 km.
        The source puts a sighted azimuth into the loxodrome: 23 m wrong at 16 km, 9.6 km at 321 km.
    ellipsoid : Ellipsoid, optional
        For the loxodrome kinds; default: a sphere (the source), up to 0.009 degrees wrong over 2 degrees of latitude.

    Returns
    -------
    ReferenceLongitude

    Raises
    ------
    ValueError
        A value that is not finite, or an unknown kind.
    EstimationError
        Azimuth within 3 degrees of east or west, a point at a pole, or no great circle that reaches the reference's latitude.

    Notes
    -----
    d lon = tan A/cos(lat) d lat - tan A/cos(lat0) d lat0 + (psi - psi0)/cos^2 A dA: an error of three minutes in latitude alone makes 7.4
    minutes at 50 degrees and A = 57.7 degrees.

    References
    ----------
    `spec/inertial.md` A3, UA(3).

    Examples
    --------
    >>> d = math.pi / 180
    >>> round(longitude_from_reference(48 * d, 50 * d, 0.0, 30 * d, kind="loxodrome").longitude / d, 9)
    -1.760381833
    """
    values = (latitude, reference_latitude, reference_longitude, azimuth)
    if not all(math.isfinite(v) for v in values):
        raise ValueError("a latitude, longitude or azimuth is not finite")
    if kind not in ("loxodrome", "sighted", "great_circle"):
        raise ValueError(f"kind is 'loxodrome', 'sighted' or 'great_circle', not {kind!r}")
    if abs(math.cos(azimuth)) < 0.05:
        raise EstimationError(
            f"azimuth {math.degrees(azimuth):.1f} degrees: due east or west the latitude says nothing of the longitude; "
            "take a reference further north or south"
        )
    if min(math.cos(latitude), math.cos(reference_latitude)) < 1e-6:
        raise EstimationError("at a pole there is no longitude")
    e = math.sqrt(ellipsoid.eccentricity_squared) if ellipsoid is not None else 0.0

    def psi(x: float) -> float:
        return math.asinh(math.tan(x)) - (e * math.atanh(e * math.sin(x)) if e else 0.0)

    rise = psi(latitude) - psi(reference_latitude)
    tangent = math.tan(azimuth)
    partials = (
        tangent / math.cos(latitude),
        -tangent / math.cos(reference_latitude),
        rise / math.cos(azimuth) ** 2,
    )
    change = rise * tangent
    if kind == "sighted":
        middle = math.sin(0.5 * (latitude + reference_latitude))
        for _ in range(6):
            change = rise * math.tan(azimuth - 0.5 * change * middle)
    elif kind == "great_circle":
        change = -_great_circle(latitude, reference_latitude, azimuth)
    return ReferenceLongitude(float(wrap_angle(reference_longitude + change)), *partials)


def _great_circle(latitude: float, reference_latitude: float, azimuth: float) -> float:
    """Longitude of the reference minus that of the point: the first place where the circle reaches the reference's latitude."""
    a, b = math.sin(latitude), math.cos(latitude) * math.cos(azimuth)  # sin lat0 = a cos s + b sin s
    size, phase = math.hypot(a, b), math.atan2(b, a)
    ratio = math.sin(reference_latitude) / size
    if abs(ratio) > 1.0:
        raise EstimationError("the great circle in this azimuth never reaches the latitude of the reference")
    swing = math.acos(ratio)
    turns = sorted((phase + sign * swing) % (2.0 * math.pi) for sign in (1.0, -1.0))
    s = next((t for t in turns if t > 1e-12), 0.0)
    return math.atan2(
        math.sin(s) * math.sin(azimuth),
        math.cos(latitude) * math.cos(s) - math.sin(latitude) * math.sin(s) * math.cos(azimuth),
    )
