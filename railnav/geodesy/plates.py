"""Motion of the Earth's plates: ground carries its stations along by some centimetres a year.

X(t) = X(t0) + (t - t0) w x X with the rotation w of the plate. Good to half a millimetre a year on the rigid inside of a plate;
at its rims, and where the ground rebounds or quakes, it is not valid.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from railnav.errors import CrsError
from railnav.geodesy.helmert import Helmert

#: Rotation of each plate about the axes of the ITRF, milliarc seconds a year (position vector, as published).
#: Altamimi, Metivier, Rebischung, Rouby, Collilieux: ITRF2014 plate motion model. Geophys. J. Int. 209 (2017), table 1.
ROTATION_MAS = {
    "ANTA": (-0.248, -0.324, 0.675),
    "ARAB": (1.154, -0.136, 1.444),
    "AUST": (1.510, 1.182, 1.215),
    "EURA": (-0.085, -0.531, 0.770),
    "INDI": (1.154, -0.005, 1.454),
    "NAZC": (-0.333, -1.544, 1.623),
    "NOAM": (0.024, -0.694, -0.063),
    "NUBI": (0.099, -0.614, 0.733),
    "PCFC": (-0.409, 1.047, -2.169),
    "SOAM": (-0.270, -0.301, -0.140),
    "SOMA": (-0.121, -0.794, 0.884),
}

#: Uncertainty of the model inside a plate, m a year.
SIGMA_RATE = 0.0005

#: Where a position lies on one plate beyond doubt: plate, south, north, west, east, degrees. Rims are left out.
_INSIDE = (
    ("EURA", 43.0, 72.0, -9.5, 20.0),
    ("EURA", 47.0, 80.0, 20.0, 140.0),
    ("NOAM", 30.0, 75.0, -108.0, -58.0),
    ("AUST", -44.0, -11.0, 112.0, 155.0),
    ("NUBI", -33.0, 30.0, -16.0, 25.0),
    ("SOAM", -35.0, 3.0, -60.0, -35.0),
)


def plate_at(latitude: ArrayLike, longitude: ArrayLike) -> str:
    """The plate on which all positions lie.

    Parameters
    ----------
    latitude, longitude : float or array
        Geodetic, rad.

    Returns
    -------
    str
        Its four letters.

    Raises
    ------
    CrsError
        The positions lie near a rim, or on plates that are not told apart here: the plate must be named.

    Examples
    --------
    >>> plate_at(np.radians(55.75), np.radians(37.6))
    'EURA'
    """
    lat, lon = np.degrees(np.asarray(latitude, np.float64)), np.degrees(np.asarray(longitude, np.float64))
    lon = np.mod(lon + 180.0, 360.0) - 180.0
    inside = {name: np.zeros(np.broadcast(lat, lon).shape, bool) for name in dict.fromkeys(box[0] for box in _INSIDE)}
    for name, south, north, west, east in _INSIDE:
        inside[name] |= (lat >= south) & (lat <= north) & (lon >= west) & (lon <= east)
    for name, here in inside.items():
        if here.all():
            return name
    raise CrsError(
        f"the plate about {float(np.mean(lat)):.2f} N {float(np.mean(lon)):.2f} E is not told apart here; "
        f"name it (plate = one of {', '.join(ROTATION_MAS)}), or give positions of one epoch"
    )


def plate_motion(plate: str, years: float) -> Helmert:
    """Carry positions in an ITRF along with a plate for some years (negative: back in time).

    Parameters
    ----------
    plate : str
        Four letters, a key of `ROTATION_MAS`.
    years : float
        Years.

    Returns
    -------
    Helmert
        A rotation, without rates.

    Raises
    ------
    CrsError
        No such plate.

    Examples
    --------
    >>> moscow = np.array([[2849000.0, 2195000.0, 5250000.0]])
    >>> round(float(np.linalg.norm(plate_motion("EURA", 15.0).apply(moscow) - moscow)), 2)
    0.39
    """
    if plate.upper() not in ROTATION_MAS:
        raise CrsError(f"no plate {plate!r}; the plates are {', '.join(ROTATION_MAS)}")
    angle = np.array(ROTATION_MAS[plate.upper()]) * 1e-3 * years
    return Helmert.of((0.0, 0.0, 0.0), angle, convention="position_vector")
