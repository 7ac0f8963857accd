"""A datum fitted to common points: positions known both in WGS 84 and in a local plane.

Seven (or three) parameters join the geocentric frames, X_local = T + (1 + s) R X; four join two planes by a similarity,
E' = tE + a E + b N, N' = tN - b E + a N, with a constant shift of heights. Least squares about the centroid; points that
contradict the others are found robustly (least median of squares over minimal subsets, then an F test of each point against
the fit without it) and set aside by name, never in silence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import CrsError
from railnav.geodesy.agreement import agreeing_points, least_squares
from railnav.geodesy.ellipsoid import WGS84, Ellipsoid
from railnav.geodesy.grid import choose_frame
from railnav.geodesy.helmert import ARC_SECOND, LARGEST_ANGLE, Helmert
from railnav.geodesy.plane import GridFrame

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Kind = Literal[3, 4, 7]

#: Heights by GNSS are this many times as uncertain as positions, where nobody says.
UP_FACTOR = 2.0
_NEEDED = {3: 1, 4: 2, 7: 3}


@dataclass(frozen=True, slots=True, eq=False)
class DatumFit:
    """What came of the fit.

    Attributes
    ----------
    frame : GridFrame
        The local plane with the fitted transformation pinned to it: what `choose_frame` and every reader take as `crs`.
    kind : {3, 4, 7}
        Number of parameters.
    parameters : dict
        Their values by name, in the units of their names.
    sigmas : dict
        One standard deviation of each (about the centroid of the points, where shifts are independent of rotations).
    names : tuple of str
        The points.
    residual : (n, 3) array
        Local minus transformed, east, north, up, m; NaN up where a point has no local height. Of all points, used or not.
    used : (n,) bool array
        False for a point that was set aside.
    ratio : (n,) array
        The test of each point, F over its critical value: above 1 it contradicts the others. NaN where nothing is left to test by.
    detectable : (n,) array
        Horizontal error of a point that the test would find with four chances in five, m; infinite where none would be.
    sigma : float
        Standard deviation of one horizontal coordinate difference after the fit, m.
    freedom : int
        Observations used less parameters.
    advice : tuple of str
        What the geometry of the points allows and what it does not.
    """

    frame: GridFrame
    kind: Kind
    parameters: dict[str, float]
    sigmas: dict[str, float]
    names: tuple[str, ...]
    residual: FloatArray
    used: BoolArray
    ratio: FloatArray
    detectable: FloatArray
    sigma: float
    freedom: int
    advice: tuple[str, ...]
    _model: _Model
    _cofactor: FloatArray

    def predicted_sigma(self, latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
        """Standard deviation of the transformation itself at places, the larger of east and north, m.

        Parameters
        ----------
        latitude, longitude : float or (n,) array
            WGS 84, rad.

        Returns
        -------
        (n,) array
            m; grows outside the points.
        """
        lat, lon = (np.atleast_1d(np.asarray(v, np.float64)) for v in np.broadcast_arrays(latitude, longitude))
        design = self._model.design(lat, lon, np.zeros(len(lat)))
        cofactor = np.einsum("nij,jk,nlk->nil", design, self._cofactor, design)
        return np.asarray(self.sigma * np.sqrt(np.max(np.einsum("nii->ni", cofactor)[:, :2], axis=1)))


def fit_datum(
    latitude: ArrayLike,
    longitude: ArrayLike,
    height: ArrayLike,
    easting: ArrayLike,
    northing: ArrayLike,
    height_local: ArrayLike | None = None,
    *,
    crs: Any,
    parameters: Kind = 7,
    names: Sequence[str] | None = None,
    sigma: float | None = None,
    name: str = "",
    keep_all: bool = False,
) -> DatumFit:
    """Fit the transformation from WGS 84 to a local plane by points known in both.

    Parameters
    ----------
    latitude, longitude, height : (n,) array
        WGS 84, rad, and ellipsoidal height, m.
    easting, northing : (n,) array
        In the local plane, m.
    height_local : (n,) array, optional
        Height in the local system, m; NaN where unknown. Ellipsoidal of its datum for 7 and 3 parameters (a height above sea
        level takes the geoid into the shift, which then holds only as far as the geoid is flat).
    crs : str or pyproj.CRS
        7 and 3 parameters: the plane itself, its projection and ellipsoid (its own link to WGS 84, if any, is not used). 4
        parameters: a plane with a known link that is near the local one in scale ("gk6", "EPSG:28407").
    parameters : {7, 4, 3}
        7: shift, rotation, scale in space; 3: shift in space; 4: shift, rotation, scale in the plane.
    names : sequence of str, optional
        The points' names.
    sigma : float, optional
        Known standard deviation of one horizontal coordinate difference, m. Without it the residuals say.
    name : str
        What the new plane is called.
    keep_all : bool
        Keep points that the test condemns; they are still reported.

    Returns
    -------
    DatumFit

    Raises
    ------
    CrsError
        Too few points, a point that is not finite, points on one spot or (7 parameters) on one line, or an impossible plane.

    Notes
    -----
    Heights are weighted as twice as uncertain as positions. Cost: a millisecond for tens of points; subsets are drawn with a
    fixed seed beyond 300, so that the same points give the same answer.

    References
    ----------
    Rousseeuw, P. J.: Least median of squares regression. J. Am. Stat. Assoc. 79 (1984). Baarda, W.: A testing procedure for
    use in geodetic networks. Netherlands Geodetic Commission 2-5 (1968).

    Examples
    --------
    >>> place = np.radians([[55.70, 37.40], [55.80, 37.50], [55.72, 37.75], [55.60, 37.60]])
    >>> plane = choose_frame(*place.T, crs="EPSG:28407")
    >>> grid = plane.to_grid(*place.T, np.full(4, 150.0))
    >>> local = "+proj=tmerc +lon_0=39 +x_0=7500000 +ellps=krass +units=m"
    >>> fit = fit_datum(*place.T, np.full(4, 150.0), *grid, crs=local, parameters=7)
    >>> bool(fit.sigma < 1e-4), bool(np.abs(fit.residual).max() < 1e-3)
    (True, True)
    """
    if parameters not in (3, 4, 7):
        raise CrsError(f"a fit has 3, 4 or 7 parameters, not {parameters!r}")
    data = [
        np.asarray(v, np.float64).ravel()
        for v in (latitude, longitude, height, easting, northing, np.nan if height_local is None else height_local)
    ]
    lat, lon, up, east, north, up_local = np.broadcast_arrays(*data)
    labels = tuple(str(v) for v in (names if names is not None else range(1, len(lat) + 1)))
    if len(labels) != len(lat):
        raise CrsError(f"{len(labels)} names for {len(lat)} points")
    for what, values in {"latitude": lat, "longitude": lon, "height": up, "easting": east, "northing": north}.items():
        if not np.isfinite(values).all():
            raise CrsError(f"point {labels[int(np.argmin(np.isfinite(values)))]}: its {what} is not finite")
    if len(lat) < _NEEDED[parameters]:
        raise CrsError(
            f"{parameters} parameters need {_NEEDED[parameters]} common points at least, and there are {len(lat)}"
        )
    model: _Model = (
        _Plane(lat, lon, up, crs) if parameters == 4 else _Space(lat, lon, up, east, north, crs, full=parameters == 7)
    )
    weight = np.tile([1.0, 1.0, 1.0 / UP_FACTOR], (len(lat), 1))
    weight[np.isnan(up_local), 2] = 0.0
    observed = model.observed(east, north, np.where(np.isnan(up_local), model.height_guess(up), up_local))
    design = model.design(lat, lon, up)
    _refuse_geometry(model, design, weight, parameters, labels)
    used, ratio, detectable = agreeing_points(design, observed, weight, sigma)
    kept = np.ones(len(lat), bool) if keep_all else used
    solution, cofactor, s0, freedom = least_squares(design[kept], observed[kept], weight[kept])
    scale = sigma if sigma is not None else s0
    residual = observed - design @ solution
    residual[weight[:, 2] == 0.0, 2] = np.nan
    named, sigmas = model.named(solution, scale * np.sqrt(np.diag(cofactor)))
    advice = _advice(parameters, lat[kept], lon[kept], named, sigmas, freedom, s0, sigma, len(lat) - int(used.sum()))
    at_points = scale * np.sqrt(np.max(np.einsum("nij,jk,nik->ni", design[kept], cofactor, design[kept])[:, :2]))
    words = f"{parameters} parameters fitted to {int(kept.sum())} common points"
    title = name.strip() or f"Local plane, {words}"
    frame = model.frame(solution, title, words, float(at_points) if math.isfinite(at_points) else 0.0)
    return DatumFit(
        frame,
        parameters,
        named,
        sigmas,
        labels,
        residual,
        used,
        ratio,
        detectable,
        float(scale),
        freedom,
        advice,
        model,
        cofactor,
    )


# --- the two kinds of model ---------------------------------------------------------------------------------------------


class _Space:
    """Seven or three parameters between geocentric frames; observations are local east, north, up differences."""

    def __init__(
        self,
        latitude: FloatArray,
        longitude: FloatArray,
        height: FloatArray,
        easting: FloatArray,
        northing: FloatArray,
        crs: Any,
        *,
        full: bool,
    ) -> None:
        from pyproj import Proj

        from railnav.geodesy.grid import read_plane

        system = read_plane(crs)
        self.system = system.source_crs if system.is_bound and system.source_crs is not None else system
        if self.system.ellipsoid is None:
            raise CrsError(f"{self.system.name} has no ellipsoid")
        self.ellipsoid = Ellipsoid(
            "local", self.system.ellipsoid.semi_major_metre, self.system.ellipsoid.inverse_flattening
        )
        self.full = full
        self.proj = Proj(self.system)
        lon, lat = self.proj(easting, northing, inverse=True)
        again = np.hypot(*(np.subtract(a, b) for a, b in zip(self.proj(lon, lat), (easting, northing), strict=True)))
        if not (np.isfinite(again).all() and float(np.max(again)) < 1.0):
            raise CrsError(f"point {int(np.argmax(~(again < 1.0))) + 1} does not lie in {self.system.name}")
        self.local_lat, self.local_lon = np.radians(lat), np.radians(lon)
        self.position = np.column_stack(WGS84.to_cartesian(latitude, longitude, height))
        self.centre = self.position.mean(axis=0)
        self.enu = _enu(latitude, longitude)

    def height_guess(self, height: FloatArray) -> FloatArray:
        """Height where a point has no local one: it turns the horizontal by nothing that matters."""
        return height

    def observed(self, _easting: FloatArray, _northing: FloatArray, height: FloatArray) -> FloatArray:
        """Local minus WGS 84 position, resolved east, north, up, (n, 3) m."""
        target = np.column_stack(self.ellipsoid.to_cartesian(self.local_lat, self.local_lon, height))
        return np.asarray(np.einsum("nij,nj->ni", self.enu, target - self.position))

    def design(self, latitude: FloatArray, longitude: FloatArray, height: FloatArray) -> FloatArray:
        """Derivatives of the difference, (n, 3, 7 or 3): shift at the centroid (m), angles times 1e6 m, scale times 1e6 m."""
        x = np.column_stack(WGS84.to_cartesian(latitude, longitude, height)) - self.centre
        out = np.zeros((len(x), 3, 7 if self.full else 3))
        out[:, 0, 0] = out[:, 1, 1] = out[:, 2, 2] = 1.0
        if self.full:
            out[:, 0, 4], out[:, 0, 5] = -x[:, 2] * 1e-6, x[:, 1] * 1e-6
            out[:, 1, 3], out[:, 1, 5] = x[:, 2] * 1e-6, -x[:, 0] * 1e-6
            out[:, 2, 3], out[:, 2, 4] = -x[:, 1] * 1e-6, x[:, 0] * 1e-6
            out[:, :, 6] = x * 1e-6
        return np.asarray(np.einsum("nij,njk->nik", _enu(latitude, longitude), out))

    def helmert(self, solution: FloatArray) -> Helmert:
        scale = float(solution[6]) * 1e-6 if self.full else 0.0
        angles = solution[3:6] * 1e-6 / (1.0 + scale) if self.full else np.zeros(3)
        widest = float(np.max(np.abs(angles)))
        if widest > LARGEST_ANGLE:
            raise CrsError(
                f"a rotation of {widest / ARC_SECOND:.0f} arc seconds comes out, which joins no two datums: the points lie too nearly on a "
                "line to tell it, or are not in this plane; use 4 or 3 parameters, or look at units and axes"
            )
        turned = Helmert((0.0, 0.0, 0.0, *map(float, angles), scale))
        shift = solution[:3] + self.centre - turned.apply(self.centre)
        return Helmert((*map(float, shift), *map(float, angles), scale))

    def named(self, solution: FloatArray, sigma: FloatArray) -> tuple[dict[str, float], dict[str, float]]:
        shift = self.helmert(solution).parameters
        values = dict(zip(("tx_m", "ty_m", "tz_m"), shift[:3], strict=True))
        sigmas = dict(zip(("tx_m", "ty_m", "tz_m"), map(float, sigma[:3]), strict=True))
        if self.full:
            values |= {f"r{axis}_arcsec": angle / ARC_SECOND for axis, angle in zip("xyz", shift[3:6], strict=True)}
            sigmas |= {
                f"r{axis}_arcsec": float(s) * 1e-6 / ARC_SECOND for axis, s in zip("xyz", sigma[3:6], strict=True)
            }
            values["scale_ppm"], sigmas["scale_ppm"] = shift[6] * 1e6, float(sigma[6])
        return values, sigmas

    def frame(self, solution: FloatArray, name: str, words: str, accuracy: float) -> GridFrame:
        from pyproj import CRS
        from pyproj.crs import BoundCRS
        from pyproj.crs.coordinate_operation import ToWGS84Transformation

        from railnav.geodesy.grid import pipeline_through

        helmert = self.helmert(solution)
        pipeline = pipeline_through(self.system, helmert.step(), name)
        # programs that read the WKT want the way from the local datum to WGS 84, position vector: exact at the centroid
        rx, ry, rz, s = helmert.parameters[3:]
        turned = Helmert((0.0, 0.0, 0.0, -rx, -ry, -rz, 1.0 / (1.0 + s) - 1.0))
        back = self.centre - turned.apply(helmert.apply(self.centre))
        angles = (rx / ARC_SECOND, ry / ARC_SECOND, rz / ARC_SECOND)  # backwards and position vector: signs as they are
        seven = (*back.tolist(), *angles, turned.parameters[6] * 1e6)
        base = self.system.geodetic_crs
        plain = self.system
        if plain.name in ("unknown", "unnamed"):  # a PROJ string has no name of its own
            text = str(plain.to_wkt("WKT2_2019"))
            plain = CRS.from_wkt(text.replace(f'"{plain.name}"', f'"{name.replace(chr(34), "")}"', 1))
        bound = BoundCRS(plain, CRS.from_epsg(4326), ToWGS84Transformation(base, *seven))
        return GridFrame(" ".join(str(bound.to_wkt("WKT2_2019")).split()), name, pipeline, words, accuracy)


class _Plane:
    """Four parameters between two planes and a shift of heights; observations are grid differences."""

    def __init__(self, latitude: FloatArray, longitude: FloatArray, height: FloatArray, crs: Any) -> None:
        self.base = choose_frame(latitude, longitude, crs=crs)
        easting, northing, up = self.base.to_grid(latitude, longitude, height)
        self.position = np.column_stack([easting, northing, up])
        self.centre = self.position.mean(axis=0)

    def height_guess(self, height: FloatArray) -> FloatArray:  # noqa: ARG002 - the other model's signature
        """Any number: a point without a local height has no weight in height."""
        return self.position[:, 2]

    def observed(self, easting: FloatArray, northing: FloatArray, height: FloatArray) -> FloatArray:
        """Local coordinates less the base plane's height, (n, 3) m."""
        self.local_centre = np.array([easting.mean(), northing.mean()])
        return np.column_stack(
            [easting - self.local_centre[0], northing - self.local_centre[1], height - self.position[:, 2]]
        )

    def design(self, latitude: FloatArray, longitude: FloatArray, height: FloatArray) -> FloatArray:
        """Derivatives, (n, 3, 5): tE, tN at the centroid (m), a, b times 1e6, height shift (m)."""
        x = np.column_stack(self.base.to_grid(latitude, longitude, height)) - self.centre
        out = np.zeros((len(x), 3, 5))
        out[:, 0, 0] = out[:, 1, 1] = out[:, 2, 4] = 1.0
        out[:, 0, 2], out[:, 0, 3] = x[:, 0] * 1e-6, x[:, 1] * 1e-6
        out[:, 1, 2], out[:, 1, 3] = x[:, 1] * 1e-6, -x[:, 0] * 1e-6
        return out

    def named(self, solution: FloatArray, sigma: FloatArray) -> tuple[dict[str, float], dict[str, float]]:
        a, b = solution[2] * 1e-6, solution[3] * 1e-6
        scale = math.hypot(a, b)
        values = {
            "te_m": float(self.local_centre[0] + solution[0] - self.centre[0] * a - self.centre[1] * b),
            "tn_m": float(self.local_centre[1] + solution[1] - self.centre[1] * a + self.centre[0] * b),
            "rotation_arcsec": math.atan2(b, a) / ARC_SECOND,
            "scale_ppm": (scale - 1.0) * 1e6,
            "height_m": float(solution[4]),
        }
        sigmas = {
            "te_m": float(sigma[0]),
            "tn_m": float(sigma[1]),
            "rotation_arcsec": float(sigma[3]) * 1e-6 / scale / ARC_SECOND,
            "scale_ppm": float(sigma[2]),
            "height_m": float(sigma[4]),
        }
        return values, sigmas

    def frame(self, solution: FloatArray, name: str, words: str, accuracy: float) -> GridFrame:
        a, b = float(solution[2]) * 1e-6, float(solution[3]) * 1e-6
        values, _ = self.named(solution, np.zeros(5))
        te, tn, up = values["te_m"], values["tn_m"], float(solution[4])
        pipeline = (
            self.base.pipeline
            if self.base.pipeline.startswith("proj=pipeline")
            else (f"proj=pipeline step {self.base.pipeline}")
        )
        pipeline += f" step proj=affine xoff={te!r} yoff={tn!r} zoff={up!r} s11={a!r} s12={b!r} s21={-b!r} s22={a!r}"
        return GridFrame(
            _derived_wkt(self.base.crs_wkt, name, (te, a, b, tn, -b, a)),
            name,
            pipeline,
            f"{words}, from {self.base.name} ({self.base.operation})",
            accuracy,
        )


_Model = _Space | _Plane


def _derived_wkt(base_wkt: str, name: str, affine: tuple[float, ...]) -> str:
    """WKT2 of a plane derived from another by an affine transformation (EPSG method 9624)."""
    from pyproj import CRS

    system = CRS.from_wkt(base_wkt)
    plain = system.source_crs if system.is_bound and system.source_crs is not None else system
    text = " ".join(str(plain.to_wkt("WKT2_2019")).split())
    # a base that is named as the registry names it gets the registry's axis order; this one counts east, then north
    named = text.index('",', text.index('["') + 2)
    inner = f'"{plain.name.replace(chr(34), "")} (east, north)' + text[named : text.rindex(",CS[Cartesian")]
    metre, unity = 'LENGTHUNIT["metre",1]', 'SCALEUNIT["coefficient",1]'
    codes = (
        ("A0", 8623, metre),
        ("A1", 8624, unity),
        ("A2", 8625, unity),
        ("B0", 8639, metre),
        ("B1", 8640, unity),
        ("B2", 8641, unity),
    )
    terms = ",".join(
        f'PARAMETER["{key}",{value!r},{unit},ID["EPSG",{code}]]'
        for (key, code, unit), value in zip(codes, affine, strict=True)
    )
    quoted = name.replace('"', '""')
    return (
        f'DERIVEDPROJCRS["{quoted}",BASEPROJCRS[{inner}],DERIVINGCONVERSION["common points",'
        f'METHOD["Affine parametric transformation",ID["EPSG",9624]],{terms}],CS[Cartesian,2],'
        f'AXIS["easting (E)",east,ORDER[1],{metre}],AXIS["northing (N)",north,ORDER[2],{metre}]]'
    )


def _enu(latitude: FloatArray, longitude: FloatArray) -> FloatArray:
    """Rotation from geocentric to east, north, up, (n, 3, 3)."""
    sp, cp, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    zero = np.zeros_like(sp)
    rows = [[-sl, cl, zero], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


# --- geometry -----------------------------------------------------------------------------------------------------------


def _extent(x: FloatArray) -> tuple[float, float]:
    """Principal extents of the points, m: along and across."""
    spread = np.sort(np.linalg.svd(x - x.mean(axis=0), compute_uv=False))[::-1] / math.sqrt(max(len(x) - 1, 1))
    return float(spread[0]), float(spread[1])


def _refuse_geometry(
    model: _Model, design: FloatArray, weight: FloatArray, parameters: Kind, names: tuple[str, ...]
) -> None:
    x = model.position
    along, across = _extent(x)
    if parameters != 3 and along < 1.0:
        raise CrsError(f"the {len(names)} points lie on one spot; {parameters} parameters need points apart")
    if parameters == 7 and across < 1e-3 * along:
        raise CrsError("the points lie on one line, about which a rotation cannot be told; use 4 or 3 parameters")
    if parameters == 4 and not (weight[:, 2] > 0).any():
        weight[0, 2] = 1e-6  # heights are left as they are
    live = weight.ravel() > 0.0
    rank = np.linalg.matrix_rank((design * weight[:, :, None]).reshape(-1, design.shape[2])[live], tol=1e-9)
    if rank < design.shape[2]:
        raise CrsError(
            f"{len(names)} points, {int((weight[:, 2] > 0).sum())} of them with a local height, do not determine {parameters} "
            "parameters; add points or take fewer parameters"
        )


def _advice(
    parameters: Kind,
    latitude: FloatArray,
    longitude: FloatArray,
    values: dict[str, float],
    sigmas: dict[str, float],
    freedom: int,
    s0: float,
    sigma: float | None,
    aside: int,
) -> tuple[str, ...]:
    said = []
    x = np.column_stack(WGS84.to_cartesian(latitude, longitude, np.zeros_like(latitude)))
    if freedom == 0:
        said.append(
            "no point is left over: residuals are zero by construction and say nothing of the accuracy; add points"
        )
    elif len(latitude) < _NEEDED[parameters] + 2:
        said.append("with so few points one bad point cannot be told from the others; use two more")
    if len(latitude) > 1:
        along, across = _extent(x)
        if across < 0.2 * along and parameters != 3:
            said.append(
                f"the points lie along a line ({across / 1e3:.1f} km across, {along / 1e3:.1f} km along, as standard deviations): "
                "heights and positions away from it are uncertain; add points to the sides"
            )
        if parameters == 7 and along < 20e3:
            said.append(
                f"over {along / 1e3:.0f} km shifts and rotations cannot be told apart and 7 parameters mean little one by one; "
                "4 or 3 parameters serve as well"
            )
    if parameters == 7:
        turned = [
            key for key in ("rx_arcsec", "ry_arcsec", "rz_arcsec", "scale_ppm") if abs(values[key]) > 3 * sigmas[key]
        ]
        if not turned and freedom > 0:
            said.append(
                "no rotation and no scale differs from zero by three sigma: 3 parameters serve as well and hold further out"
            )
    if parameters == 4 and abs(values["scale_ppm"]) > 1000:
        said.append(
            f"the scale differs by {values['scale_ppm']:.0f} ppm: the base plane is another projection; name one nearer by crs"
        )
    if sigma is not None and freedom > 0:
        from scipy.stats import chi2

        if s0**2 * freedom / sigma**2 > chi2.ppf(0.99, freedom):
            said.append(
                f"residuals of {s0:.3f} m contradict the stated {sigma:.3f} m: a point, the plane or the stated sigma is wrong"
            )
    if aside:
        said.append(f"{aside} of the points contradict the others and were found by the test; look at them before use")
    said.append("outside the points the fit extrapolates: see the sigma of the transformation where the line goes")
    return tuple(said)
