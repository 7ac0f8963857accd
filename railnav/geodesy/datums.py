"""Datums by name, and the chain of Helmert steps from one to another at an epoch: what PROJ leaves undone.

PROJ has no way to run the registry's "time-specific" operations (GSK-2011, PZ-90.11, PZ-90.02) and gives such coordinates back
unchanged. Here every link stands in a table with its source, its sign (coordinate frame), its accuracy and the epoch at which it
holds; a chain is looked for in it, and a moving frame is carried to the epoch of a link by the motion of its plate.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import CrsError
from railnav.geodesy.ellipsoid import BESSEL, GRS80, GSK2011, KRASSOWSKY, PZ90, WGS84, Ellipsoid
from railnav.geodesy.helmert import Helmert
from railnav.geodesy.plates import SIGMA_RATE, plate_at, plate_motion

if TYPE_CHECKING:
    import pyproj

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Datum:
    """A geodetic datum.

    Attributes
    ----------
    name : str
        Its name here.
    ellipsoid : str
        Its ellipsoid as words of a PROJ step.
    moving : bool
        Whether coordinates of a point on the ground change by plate motion (an ITRF) or the datum moves along (ETRS89).
    codes : tuple of int
        EPSG codes of its geographic (2-D, 3-D) and geocentric systems.
    aliases : tuple of str
        Other names.
    """

    name: str
    ellipsoid: str
    moving: bool
    codes: tuple[int, ...] = ()
    aliases: tuple[str, ...] = ()

    @property
    def figure(self) -> Ellipsoid:
        """Its ellipsoid."""
        return _FIGURES[self.ellipsoid]


@dataclass(frozen=True, slots=True)
class Link:
    """One published transformation between two datums.

    Attributes
    ----------
    source, target : str
        Names of datums.
    shift : Helmert
        Source to target; with rates where the frames move against each other.
    accuracy : float
        Stated, m.
    published : str
        Where it stands.
    epoch : float or None
        Decimal year at which it holds, where one of the datums moves and the other does not.
    """

    source: str
    target: str
    shift: Helmert
    accuracy: float
    published: str
    epoch: float | None = None


@dataclass(frozen=True, slots=True)
class DatumShift:
    """The way from one datum to another, ready to be run.

    Attributes
    ----------
    steps : tuple of (Helmert, bool)
        Transformations in order; True where one is run backwards.
    operation : str
        What is done, in words.
    accuracy : float
        Root of the sum of squares of the stated accuracies, m.
    """

    steps: tuple[tuple[Helmert, bool], ...]
    operation: str
    accuracy: float

    @property
    def proj(self) -> str:
        """The steps between geocentric coordinates as PROJ writes them; empty where nothing is to be done."""
        return " ".join(shift.step(inverse=backwards) for shift, backwards in self.steps)

    def apply(self, position_e: ArrayLike) -> FloatArray:
        """Geocentric positions, (n, 3) m, in the target datum."""
        x = np.asarray(position_e, np.float64)
        for shift, backwards in self.steps:
            x = shift.apply_inverse(x) if backwards else shift.apply(x)
        return x


_KRASSOWSKY, _BESSEL, _GRS80 = "ellps=krass", "ellps=bessel", "ellps=GRS80"
_WGS84, _PZ90, _GSK = "ellps=WGS84", "a=6378136 rf=298.257839303", "a=6378136.5 rf=298.2564151"

_FIGURES = {_KRASSOWSKY: KRASSOWSKY, _BESSEL: BESSEL, _GRS80: GRS80, _WGS84: WGS84, _PZ90: PZ90, _GSK: GSK2011}

_ALL = (
    Datum("ITRF2000", _GRS80, True, (8997, 7909, 4919), ("WGS84G1150",)),
    Datum("ITRF2005", _GRS80, True, (8998, 7910, 4896)),
    Datum("ITRF2008", _GRS80, True, (8999, 7911, 5332), ("IGS08", "WGS84G1674", "WGS84G1762")),
    Datum("ITRF2014", _GRS80, True, (9000, 7912, 7789), ("IGS14", "IGB14", "WGS84G2139")),
    Datum("ITRF2020", _GRS80, True, (9990, 9989, 9988), ("IGS20", "WGS84G2296")),
    Datum("PZ-90.11", _PZ90, True, (9475, 7680, 7679), ("PZ9011",)),
    Datum("GSK-2011", _GSK, False, (7683, 7682, 7681), ("GSK2011",)),
    Datum("PZ-90.02", _PZ90, False, (9474, 7678, 7677), ("PZ9002",)),
    Datum("PZ-90", _PZ90, False, (4740, 4923, 4922), ("PZ90",)),
    Datum("SK-42", _KRASSOWSKY, False, (4284,), ("Pulkovo 1942",)),
    Datum("SK-95", _KRASSOWSKY, False, (4200,), ("Pulkovo 1995",)),
    Datum("ETRF2000", _GRS80, False, (9067, 7931, 7930, 4258, 4937, 4936), ("ETRS89", "ETRS89/ETRF2000")),
    Datum("ETRF2014", _GRS80, False, (9069, 8403, 8401), ("ETRS89/ETRF2014",)),
    Datum("DB_REF", _BESSEL, False, (5681, 5830, 5828), ("DBREF",)),
)
DATUMS = {datum.name: datum for datum in _ALL}


def _gost(source: str, shift: tuple[float, ...], accuracy: float, epoch: float | None) -> Link:
    """A row of the GOST 32453-2017 table: metres, arc seconds (coordinate frame), ppm."""
    helmert = Helmert.of(shift[:3], shift[3:6], shift[6], convention="coordinate_frame")
    return Link(source, "PZ-90.11", helmert, accuracy, "GOST 32453-2017", epoch)


def _iers(
    source: str, target: str, shift: tuple[float, ...], rates: tuple[float, ...], epoch: float, code: int
) -> Link:
    """Fourteen parameters as the IERS and EUREF publish them: mm, mas (position vector), ppb, and a year."""
    helmert = Helmert.of(
        np.array(shift[:3]) * 1e-3,
        np.array(shift[3:6]) * 1e-3,
        shift[6] * 1e-3,
        convention="position_vector",
        translation_rate=np.array(rates[:3]) * 1e-3,
        rotation_rate_arcsec=np.array(rates[3:6]) * 1e-3,
        scale_rate_ppm=rates[6] * 1e-3,
        epoch=epoch,
    )
    return Link(source, target, helmert, 0.002 if target.startswith("ETRF") else 0.005, f"EPSG:{code}")


_NO = (0.0, 0.0, 0.0)
LINKS = (
    # no epoch is stated for the first three; 2011.0 makes their way to GSK-2011 the one that the same table prints
    _gost("SK-42", (23.557, -140.844, -79.778, -0.00230, -0.34646, -0.79421, -0.228), 3.0, 2011.0),
    _gost("SK-95", (24.457, -130.784, -81.538, -0.00230, 0.00354, -0.13421, -0.228), 1.0, 2011.0),
    _gost("PZ-90", (-1.443, 0.156, 0.222, -0.00230, 0.00354, -0.13421, -0.228), 0.2, 2011.0),
    _gost("PZ-90.02", (-0.373, 0.186, 0.202, -0.00230, 0.00354, -0.00421, -0.008), 0.07, 2010.0),
    _gost("GSK-2011", (0.0, 0.014, -0.008, -0.000562, -0.000019, 0.000053, -0.0006), 0.03, 2011.0),
    Link(
        "PZ-90.11",
        "ITRF2008",
        Helmert.of((-0.003, -0.001, 0.0), (1.9e-5, -4.2e-5, 2e-6), 0.0, convention="coordinate_frame"),
        0.004,
        "EPSG:7960",
    ),
    _iers("ITRF2014", "ITRF2020", (1.4, 0.9, -1.4, *_NO, 0.42), (0.0, 0.1, -0.2, *_NO, 0.0), 2015.0, 9991),
    _iers("ITRF2008", "ITRF2020", (-0.2, -1.0, -3.3, *_NO, 0.29), (0.0, 0.1, -0.1, *_NO, -0.03), 2015.0, 9992),
    _iers("ITRF2005", "ITRF2020", (-2.7, -0.1, 1.4, *_NO, -0.65), (-0.3, 0.1, -0.1, *_NO, -0.03), 2015.0, 9993),
    _iers("ITRF2000", "ITRF2020", (0.2, -0.8, 34.2, *_NO, -2.25), (-0.1, 0.0, 1.7, *_NO, -0.11), 2015.0, 9994),
    _iers(
        "ITRF2020",
        "ETRF2000",
        (53.8, 51.8, -82.2, 2.106, 12.74, -20.592, 2.25),
        (0.1, 0.0, -1.7, 0.081, 0.49, -0.792, 0.11),
        2015.0,
        10586,
    ),
    _iers(
        "ITRF2020",
        "ETRF2014",
        (-1.4, -0.9, 1.4, 2.21, 13.806, -20.02, -0.42),
        (0.0, -0.1, 0.2, 0.085, 0.531, -0.77, 0.0),
        2015.0,
        10587,
    ),
    Link(
        "DB_REF",
        "ETRF2000",
        Helmert.of((584.9636, 107.7175, 413.8067), (-1.1155, -0.2824, 3.1384), 7.9922, convention="coordinate_frame"),
        0.0,
        "EPSG:5826",
    ),
)


#: The registry's year (EPSG unit 1029), s.
_SECONDS_IN_A_YEAR = 31556925.445


def _plain(name: str) -> str:
    return "".join(c for c in name.upper() if c.isalnum() or c == "_")


@lru_cache(maxsize=1)
def _names() -> dict[str, Datum]:
    return {
        _plain(name): datum
        for datum in _ALL
        for name in (datum.name, *datum.aliases, *(f"EPSG:{code}" for code in datum.codes))
    }


def find_datum(name: str | pyproj.CRS) -> Datum | None:
    """A datum of the table by name, EPSG code or coordinate system; None where the table has none such.

    Parameters
    ----------
    name : str or pyproj.CRS
        "GSK-2011", "PZ-90.11", "SK-42" or "Pulkovo 1942", "ITRF2014", "WGS84 (G2139)", "ETRS89", "EPSG:7683", ...

    Returns
    -------
    Datum or None
        The realisations of WGS 84 by their week are the ITRF that they were aligned with; "WGS 84" alone is none.

    Examples
    --------
    >>> find_datum("Pulkovo 1942").name, find_datum("WGS 84 (G2139)").name, find_datum("WGS 84")
    ('SK-42', 'ITRF2014', None)
    """
    if isinstance(name, str):
        return _names().get(_plain(name))
    base = name.geodetic_crs
    if base is None:
        return None
    code = base.to_authority(min_confidence=70)
    found = _names().get(_plain(f"{code[0]}:{code[1]}")) if code else None
    return found or _names().get(_plain(base.name))


def stand_in(datum: Datum) -> str:
    """The frame that stands for WGS 84 beside a datum: the plate-fixed one of its country, as in the registry's null shifts.

    Examples
    --------
    >>> stand_in(DATUMS["SK-42"]), stand_in(DATUMS["DB_REF"])
    ('GSK-2011', 'ETRF2000')
    """
    if datum.name.startswith("ITRF"):
        return datum.name
    return "ETRF2000" if datum.name in ("DB_REF", "ETRF2000", "ETRF2014") else "GSK-2011"


@dataclass(frozen=True, slots=True)
class RegisteredShift:
    """A Helmert transformation as a registry holds it: its name, datums, numbers, stated accuracy (m; -1 unknown), area."""

    name: str
    source: str
    target: str
    shift: Helmert
    accuracy: float
    bounds: tuple[float, float, float, float] | None  # west, south, east, north, degrees


@lru_cache(maxsize=32)
def registered_shift(code: str) -> RegisteredShift | None:
    """Look a transformation up by its code; None where it is not of three, seven or fourteen parameters.

    Parameters
    ----------
    code : str
        "EPSG:1267".

    Raises
    ------
    CrsError
        The registry has no such operation.

    Examples
    --------
    >>> found = registered_shift("EPSG:1267")
    >>> found.name, found.source, found.shift.parameters[0]
    ('Pulkovo 1942 to WGS 84 (17)', 'Pulkovo 1942', 23.92)
    """
    from pyproj.crs import CoordinateOperation  # type: ignore[attr-defined]
    from pyproj.exceptions import CRSError as ProjError

    registry, _, number = code.strip().partition(":")
    try:
        operation = CoordinateOperation.from_authority(registry, number)
    except ProjError as error:
        raise CrsError(f"the registry has no operation {code!r}") from error
    method = str(operation.method_name)
    signs = {"Coordinate Frame": 1.0, "Position Vector": -1.0, "Geocentric translations": 1.0}
    sign = next((value for words, value in signs.items() if words in method), None)
    ends = operation.to_json_dict()
    if sign is None or "source_crs" not in ends or "target_crs" not in ends:
        return None
    static, rates, epoch = [0.0] * 7, [0.0] * 7, 0.0
    for parameter in operation.params:
        name = str(parameter.name)
        if name.endswith("reference epoch"):
            epoch = float(parameter.value)
            continue
        plain = name.removeprefix("Rate of change of ")
        per_year = 1.0 if plain == name else _SECONDS_IN_A_YEAR  # PROJ counts rates by the second
        index = "XYZ".find(plain[0]) + (3 if plain.endswith("rotation") else 0) if plain[1:2] == "-" else 6
        value = float(parameter.value) * float(parameter.unit_conversion_factor) * per_year
        (static if plain == name else rates)[index] = value * (sign if 3 <= index <= 5 else 1.0)
    area = operation.area_of_use
    return RegisteredShift(
        str(operation.name),
        str(ends["source_crs"]["name"]),
        str(ends["target_crs"]["name"]),
        Helmert(tuple(static), tuple(rates), epoch),
        float(operation.accuracy),
        None if area is None else (area.west, area.south, area.east, area.north),
    )


def _path(source: str, target: str) -> list[tuple[Link, bool]]:
    """Links from source to target, fewest first; True where one is gone backwards."""
    reached: dict[str, list[tuple[Link, bool]]] = {source: []}
    queue = deque([source])
    while queue and target not in reached:
        here = queue.popleft()
        for link in LINKS:
            for start, end, backwards in ((link.source, link.target, False), (link.target, link.source, True)):
                if start == here and end not in reached:
                    reached[end] = [*reached[here], (link, backwards)]
                    queue.append(end)
    if target not in reached:
        raise CrsError(f"no chain of published transformations leads from {source} to {target}")
    return reached[target]


def datum_shift(
    source: str,
    target: str,
    latitude: ArrayLike,
    longitude: ArrayLike,
    *,
    epoch: float | None = None,
    target_epoch: float | None = None,
    plate: str | None = None,
) -> DatumShift:
    """The chain of Helmert steps from one datum to another.

    Parameters
    ----------
    source, target : str
        Names as `find_datum` takes them.
    latitude, longitude : float or array
        Where the data lies, rad: for the plate alone.
    epoch, target_epoch : float, optional
        Decimal years of the coordinates in source and target, where these move (an ITRF, PZ-90.11). A chain that ends in a
        moving datum keeps the epoch of the coordinates unless `target_epoch` says another.
    plate : str, optional
        Four letters; by default the plate that the data lies on beyond doubt.

    Returns
    -------
    DatumShift

    Raises
    ------
    CrsError
        A datum that the table does not have, no chain, an epoch that is needed and not given, or no plate.

    Notes
    -----
    Accuracies are those that the publishers state; carrying along with a plate adds 0.5 mm a year.

    References
    ----------
    GOST 32453-2017; EPSG registry; Altamimi et al. 2017 (see `railnav.geodesy.plates`).

    Examples
    --------
    >>> shift = datum_shift("ITRF2020", "GSK-2011", 0.97, 0.66, epoch=2026.5)
    >>> round(shift.accuracy, 3)
    0.032
    """
    a, b = find_datum(source), find_datum(target)
    for name, datum in ((source, a), (target, b)):
        if datum is None:
            raise CrsError(f"no datum {name!r} in the table; it has {', '.join(DATUMS)}")
    assert a is not None
    assert b is not None
    for year in (epoch, target_epoch):
        if year is not None and not 1980.0 <= year <= 2100.0:
            raise CrsError(f"epoch {year:g} is no decimal year of this age")
    now = epoch if a.moving else None
    steps: list[tuple[Helmert, bool]] = []
    words: list[str] = []
    variance = 0.0

    def carry(to: float) -> None:
        nonlocal now, variance
        if now is None or abs(to - now) < 1e-9:
            now = to
            return
        letters = plate or plate_at(latitude, longitude)
        steps.append((plate_motion(letters, to - now), False))
        words.append(f"plate {letters.upper()} {now:.2f} to {to:.2f}")
        variance += (SIGMA_RATE * (to - now)) ** 2
        now = to

    path = _path(a.name, b.name)
    for i, (link, backwards) in enumerate(path):
        start, end = (link.target, link.source) if backwards else (link.source, link.target)
        if DATUMS[start].moving and now is None and (link.epoch is not None or link.shift.moves):
            raise CrsError(f"coordinates in {a.name} change by 2 to 3 cm a year; give their epoch")
        if link.epoch is not None:
            carry(link.epoch)
        elif link.shift.moves and now is None:  # out of a datum that moves with its plate: any epoch serves
            now = target_epoch if target_epoch is not None else link.shift.epoch
        shift = link.shift.at(now) if link.shift.moves and now is not None else link.shift
        steps.append((shift, backwards))
        words.append(f"{start} to {end} ({link.published})")
        variance += link.accuracy**2
        if not DATUMS[end].moving:
            now = None
        elif link.epoch is not None and target_epoch is not None and all(k.epoch is None for k, _ in path[i + 1 :]):
            carry(target_epoch)  # at once, so that the way back takes the same steps
    if b.moving and target_epoch is not None:
        if now is None:
            raise CrsError(f"coordinates in {a.name} change by 2 to 3 cm a year; give their epoch")
        carry(target_epoch)
    return DatumShift(tuple(steps), ", ".join(words) or f"none: the frame is {b.name}", float(np.sqrt(variance)))
