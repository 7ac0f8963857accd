"""Transformations: one PROJ operation, chosen once, written down and run the same way ever after.

A "ballpark" operation leaves coordinates as they are and says so only in its accuracy of -1; here it is an error, as are an
unknown accuracy and an operation that needs grid files. PROJ inverts a small-angle Helmert transformation by turning its
angles round, which misses by up to 1.3 mm (DB_REF); `inverse` closes that gap.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import CrsError

if TYPE_CHECKING:
    import pyproj

FloatArray = NDArray[np.float64]

DEGREE = math.pi / 180.0
PER_DEGREE = 180.0 / math.pi


@dataclass(frozen=True, slots=True)
class Extent:
    """Where data lies, degrees; east may exceed 180 where it crosses the antimeridian."""

    west: float
    south: float
    east: float
    north: float

    @classmethod
    def of(cls, latitude: ArrayLike, longitude: ArrayLike) -> Self:
        """Extent of positions (rad) without the outermost half per cent at each side."""
        lat, lon = (
            np.degrees(np.asarray(v, dtype=np.float64)).ravel() for v in np.broadcast_arrays(latitude, longitude)
        )
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
            math.atan2(float(np.median(np.sin(lon * DEGREE))), float(np.median(np.cos(lon * DEGREE))))
        )
        lon = centre + np.mod(lon - centre + 180.0, 360.0) - 180.0
        (south, north), (west, east) = np.quantile(lat, [0.005, 0.995]), np.quantile(lon, [0.005, 0.995])
        return cls(float(west), float(south), float(east), float(north))

    @property
    def longitude(self) -> float:
        """Middle longitude, degrees."""
        return 0.5 * (self.west + self.east)

    @property
    def latitude(self) -> float:
        """Middle latitude, degrees."""
        return 0.5 * (self.south + self.north)

    def __str__(self) -> str:
        longitude = wrapped_deg(self.longitude)
        north, east = "N" if self.latitude >= 0 else "S", "E" if longitude >= 0 else "W"
        return f"{abs(self.latitude):.2f} {north} {abs(longitude):.2f} {east}"


def shortened(text: Any) -> str:
    """One line of at most 80 characters."""
    words = " ".join(str(text).split())
    return words if len(words) <= 80 else words[:77] + "..."


def pin_operation(
    source: pyproj.CRS, target: pyproj.CRS, extent: Extent, *, operation: str | None = None
) -> tuple[str, str, float]:
    """The best operation between two systems that has a stated accuracy and needs no grid: pipeline, name, accuracy (m).

    `operation` picks one by a part of its name.
    """
    usable, why = usable_operations(source, target, extent)
    if operation is not None:
        chosen = [found for found in usable if operation.strip().lower() in found[1].lower()]
        if not chosen:
            offered = "; ".join(f"{name} ({accuracy:g} m)" for _, name, accuracy in usable) or why
            raise CrsError(f"no operation {shortened(operation)!r} about {extent}; PROJ offers: {offered}")
        return min(chosen, key=lambda u: u[2])
    if usable:
        return min(usable, key=lambda u: u[2])  # the first of equals: PROJ knows the areas
    raise CrsError(
        f"no usable transformation from {_title(source)} to {_title(target)} about {extent}: {why}; {_remedy(target)}"
    )


def usable_operations(
    source: pyproj.CRS, target: pyproj.CRS, extent: Extent
) -> tuple[list[tuple[str, str, float]], str]:
    """Every operation that may be pinned (pipeline, name, accuracy in m), and why the last of the others may not."""
    from pyproj.aoi import AreaOfInterest
    from pyproj.exceptions import ProjError
    from pyproj.transformer import TransformerGroup

    bound = target.is_bound or source.is_bound

    def words() -> str:  # looking a system up in the registry takes 0.1 s: to refuse only
        return f"{_title(source)} to {_title(target)}"

    # PROJ takes an area wider than the data: an operation must hold a little beyond the outermost fix
    area: Any = AreaOfInterest(
        wrapped_deg(extent.west - 0.01),
        max(extent.south - 0.01, -90.0),
        wrapped_deg(extent.east + 0.01),
        min(extent.north + 0.01, 90.0),
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "best transformation is not available": decided here, below
            group = TransformerGroup(
                source.to_3d(), target.to_3d(), always_xy=True, area_of_interest=area, allow_ballpark=False
            )
    except IndexError as error:  # pyproj's way of saying that only time-specific operations were left
        raise CrsError(
            f"no usable transformation from {words()} about {extent}: PROJ cannot run it; {_remedy(target)}"
        ) from error
    except ProjError as error:
        raise CrsError(f"PROJ has no transformation from {words()}: {shortened(error)}") from error
    why = "PROJ has none that it can run"
    usable: list[tuple[str, str, float]] = []
    for transformer in group.transformers:
        definition = str(transformer.definition)
        # a conversion changes no datum and is exact; PROJ 9.8 states no accuracy for it, earlier ones stated 0
        parts = transformer.operations or ()
        exact = bound or (len(parts) > 0 and all(part.type_name == "Conversion" for part in parts))
        if "ballpark" in transformer.description.lower():
            why = "PROJ offers only a ballpark one, which leaves the coordinates as they are"
        elif "grids=" in definition:
            why = "it would need grid files"
        elif "proj=push v_3" in definition:
            why = "it leaves heights as they are, on another ellipsoid"
        elif transformer.accuracy < 0 and not exact:
            why = "its accuracy is unknown"
        elif not definition.startswith("proj=") or not transformer.has_inverse:
            why = "it cannot be written down or run backwards"
        else:
            name = "link to WGS 84 as given with the system" if bound else _plain_operation(transformer.description)
            usable.append((definition, name, max(float(transformer.accuracy), 0.0)))
    if not usable and not group.transformers and group.unavailable_operations:
        why = "it would need grid files"
    return usable, why


def _title(system: pyproj.CRS) -> str:
    code = registered(system)
    return f"{system.name} ({code[0]}:{code[1]})" if code else str(system.name)


def _remedy(target: pyproj.CRS) -> str:
    if target.is_compound:
        return "use its horizontal part alone (heights then stay ellipsoidal), or gk6"
    if not registered(target):
        return "add the datum's link to WGS 84 (+towgs84= or a WKT BoundCRS; +datum=WGS84 if it is that), or use gk6"
    return "use another realisation of the datum, or a plane on WGS 84 such as gk6"


def _plain_operation(description: str) -> str:
    """An operation's name without the steps that only swap axes or promote dimensions."""
    plain = description.replace(" (with axis order normalized for visualization)", "")
    steps = [step.strip() for step in plain.split(" + ")]
    kept = [step for step in steps if not step.startswith(("axis order change", "Null geographic offset"))]
    return "projection as given, no change of datum" if kept == ["unknown"] else " + ".join(kept) or plain


def registered(system: pyproj.CRS) -> tuple[str, int] | None:
    """Registry and code of a system, if a registry has it."""
    code = system.to_authority(min_confidence=100)
    return (str(code[0]), int(code[1])) if code is not None and str(code[1]).isdigit() else None


def wrapped_deg(longitude_deg: float) -> float:
    """Longitude in [-180, 180), degrees."""
    return (longitude_deg + 180.0) % 360.0 - 180.0


@lru_cache(maxsize=32)
def transformer(pipeline: str) -> pyproj.Transformer:
    """The transformer of a pipeline, made once.

    Raises
    ------
    CrsError
        PROJ cannot run it.
    """
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    try:
        return Transformer.from_pipeline(pipeline)
    except ProjError as error:
        raise CrsError(
            f"PROJ cannot run the pinned transformation {shortened(pipeline)!r}: {shortened(error)}"
        ) from error


def steps(pipeline: str) -> list[dict[str, str]]:
    """The steps of a PROJ pipeline, each a dict of its parameters (flags have an empty value)."""
    found: list[dict[str, str]] = [{}]
    for word in pipeline.split():
        if word in {"step", "+step"}:
            found.append({})
            continue
        key, _, value = word.lstrip("+").partition("=")
        found[-1][key] = value
    return [step for step in found if step.get("proj", "pipeline") != "pipeline"]


@lru_cache(maxsize=32)
def _small_angles(pipeline: str) -> bool:
    return any(
        step["proj"] == "helmert" and "exact" not in step and {"rx", "ry", "rz"} & set(step) for step in steps(pipeline)
    )


def forward(
    pipeline: str, longitude_deg: ArrayLike, latitude_deg: ArrayLike, height: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Run a pipeline: longitude, latitude (degrees), height (m) to its x, y, z; inf where PROJ cannot."""
    x, y, z = transformer(pipeline).transform(longitude_deg, latitude_deg, height)
    return x, y, z


def inverse(pipeline: str, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Run a pipeline backwards: x, y, z to longitude, latitude (degrees), height (m); inf where PROJ cannot."""
    from pyproj.enums import TransformDirection

    run = transformer(pipeline)
    longitude, latitude, height = run.transform(x, y, z, direction=TransformDirection.INVERSE)
    if _small_angles(pipeline) and np.isfinite(longitude).all():
        x1, y1, z1 = run.transform(longitude, latitude, height)  # misses by the square of the angles: one step suffices
        longitude, latitude, height = run.transform(
            2.0 * np.asarray(x) - x1,
            2.0 * np.asarray(y) - y1,
            2.0 * np.asarray(z) - z1,
            direction=TransformDirection.INVERSE,
        )
    return longitude, latitude, height


@dataclass(frozen=True, slots=True)
class GeodeticFrame:
    """A geodetic frame in which a receiver states its positions, with the one transformation from it to WGS 84 pinned.

    Attributes
    ----------
    name : str
        Its name.
    pipeline : str
        The PROJ pipeline: longitude, latitude (degrees), height (m) in this frame to the same in WGS 84.
    operation : str
        What the registry calls it.
    accuracy : float
        Its stated accuracy, m; 0 for WGS 84 itself.

    Examples
    --------
    >>> geodetic_frame("WGS84", 0.83, 0.33).operation
    'none: the frame is WGS 84'
    """

    name: str
    pipeline: str
    operation: str
    accuracy: float

    def to_wgs84(
        self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """WGS 84 positions of positions in this frame.

        Parameters
        ----------
        latitude, longitude : float or array
            In this frame, rad.
        height : float or array, optional
            Ellipsoidal, m; where missing (None or NaN) it is taken as 0 and returned as NaN.

        Returns
        -------
        latitude, longitude, height : array of the broadcast shape
            WGS 84, rad, rad, m.

        Raises
        ------
        CrsError
            A position that is not finite or that the transformation cannot take.

        Examples
        --------
        >>> frame = geodetic_frame("GSK-2011", np.radians(55.8), np.radians(37.6))
        >>> _, _, height = frame.to_wgs84(np.radians(55.8), np.radians(37.6), 150.0)
        >>> round(float(height), 2)  # another ellipsoid, another height
        149.46
        """
        lat, lon, up = np.broadcast_arrays(
            *(np.asarray(v, dtype=np.float64) for v in (latitude, longitude, np.nan if height is None else height))
        )
        missing = np.isnan(up)
        if self.pipeline == _IDENTITY:
            x, y, z = lon, lat, np.where(missing, 0.0, up)
        else:
            x, y, z = forward(self.pipeline, lon * PER_DEGREE, lat * PER_DEGREE, np.where(missing, 0.0, up))
            x, y = np.asarray(x) * DEGREE, np.asarray(y) * DEGREE
        good = np.ravel(np.isfinite(x) & np.isfinite(y) & np.isfinite(z))
        if not good.all():
            i = int(np.argmin(good))
            raise CrsError(
                f"position {i + 1} (latitude {np.degrees(lat.ravel()[i]):g}, longitude {np.degrees(lon.ravel()[i]):g} "
                f"degrees) cannot be transformed from {self.name} to WGS 84; remove it"
            )
        return np.array(y)[()], np.array(x)[()], np.where(missing, np.nan, z)[()]


#: WGS 84 to itself.
_IDENTITY = "proj=noop"


def geodetic_frame(
    name: str,
    latitude: ArrayLike,
    longitude: ArrayLike,
    *,
    epoch: float | None = None,
    fixed_to: str | None = None,
    plate: str | None = None,
) -> GeodeticFrame:
    """The geodetic frame of a receiver's positions, as a run names it, with its transformation to WGS 84 pinned.

    Parameters
    ----------
    name : str
        "WGS84" (also its realisations), or an EPSG code or PROJ name of another frame: "ETRS89", "EPSG:7683",
        "GSK-2011", "PZ-90.11", ...
    latitude, longitude : float or array
        Where the data lies, in that frame, rad; the operation is chosen for this area and no other.
    epoch : float, optional
        Decimal year of the positions; needed where the frame moves and `fixed_to` is given.
    fixed_to : str, optional
        The plate-fixed datum that stands for WGS 84 in the project ("ETRS89", "GSK-2011"), in which the ground does not move:
        positions of any frame and year are carried to it, so that surveys of different years agree. Without it, positions keep
        the epoch they were taken at.
    plate : str, optional
        Four letters (see `railnav.geodesy.plates`); by default the one that the data lies on beyond doubt.

    Returns
    -------
    GeodeticFrame
        The frame with its pinned transformation.

    Raises
    ------
    CrsError
        No such frame; a projected or geocentric one; or no transformation to WGS 84 with a stated accuracy.

    Notes
    -----
    A frame fixed to a plate and one fixed to the Earth part by some 2.5 cm a year: 0.37 m at Berlin from 2011 to 2026. Without
    `fixed_to` that stays in the positions, inside the metre that such operations state; a survey and a service run of one
    summer then still agree. With it, a chain of the table in `railnav.geodesy.datums` is run, good to some centimetres.

    Examples
    --------
    >>> geodetic_frame("ETRS89", np.radians(52.5), np.radians(13.4)).accuracy
    1.0
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError as ProjError

    from railnav.geodesy.datums import find_datum

    plain = "".join(c for c in name.upper() if c.isalnum())
    bare = plain in {"WGS84", "EPSG4326", "EPSG4979", "OGCCRS84"}
    if fixed_to is not None:
        return _carried("ITRF2020" if bare else name, fixed_to, latitude, longitude, epoch, plate)
    if bare or plain.startswith("WGS84G"):
        return GeodeticFrame("WGS 84", _IDENTITY, "none: the frame is WGS 84", 0.0)
    known = find_datum(name)
    if known is not None and known.name == "PZ-90.11":  # PROJ's one way there leaves heights half a metre off
        return _carried(name, "ITRF2008", latitude, longitude, 2010.0, plate)
    try:
        system = CRS.from_user_input(name)
    except (ProjError, TypeError, ValueError) as error:
        raise CrsError(
            f"PROJ knows no geodetic frame {shortened(name)!r}; give WGS84, ETRS89 or an EPSG code"
        ) from error
    if not system.is_geographic:
        raise CrsError(
            f"{system.name} is a {system.type_name.lower()}, not a frame of latitude and longitude; give WGS84 or another"
        )
    pipeline, operation, accuracy = pin_operation(system, CRS.from_epsg(4979), Extent.of(latitude, longitude))
    return GeodeticFrame(system.name, pipeline, operation, accuracy)


def _carried(
    name: str, target: str, latitude: ArrayLike, longitude: ArrayLike, epoch: float | None, plate: str | None
) -> GeodeticFrame:
    """A frame joined by the table of datums to the one that stands for WGS 84."""
    from railnav.geodesy.datums import datum_shift, find_datum

    shift = datum_shift(name, target, latitude, longitude, epoch=epoch, plate=plate)
    source = find_datum(name)
    assert source is not None
    words = f"proj=pipeline step proj=unitconvert xy_in=deg xy_out=rad step proj=cart {source.ellipsoid} {shift.proj} "
    pipeline = words + "step inv proj=cart ellps=WGS84 step proj=unitconvert xy_in=rad xy_out=deg"
    at = f" at {epoch:.2f}" if source.moving and epoch is not None else ""
    return GeodeticFrame(
        f"{source.name}{at}",
        " ".join(pipeline.split()),
        f"{shift.operation}; {target} stands for WGS 84",
        shift.accuracy,
    )
