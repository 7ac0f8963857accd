"""What the shape of a model is wrong by: curvature, bearing, gradient and cant, from what the model says of itself.

A model built from runs has an axis that is off by centimetres to metres, and a curvature, its second derivative, that is off by as much
as a line ever bends: over a few metres such a table tells nothing of where the train is. Averaged over the length at which the errors
cancel, it does. A design has no such errors, and a model that states nothing is taken for what the settings say.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.matching._kernels import CANT, CURVATURE, Network
from railnav.navigation.columns import BLIND_LENGTH
from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

#: Laws of a built model, of the form a * (sigma across in m)^b, found on builds of the simulated line from three survey passes (6 mm
#: across), five service runs (0.6 m), one (1.7 m) and five telephones (1.2 m): length over which its curvature is averaged, m; sigma of
#: the averaged curvature, 1/m; and sigma of the gradient, by the sigma of the height.
AVERAGED, BENT, INCLINED = (35.0, 0.35), (7e-5, 0.45), (1.8e-3, 0.8)
#: Sigma of a built model's bearing, of its sigma across, rad/m; slope of the error of the averaged curvature, 1/m^2; and length over
#: which the error of the gradient is the same, m.
TURNED, SLOPE, INCLINED_LENGTH = 8e-3, 1.2e-6, 200.0
#: What is left of the curvature (1/m) and of the places where it changes (m) in a model that is exact: a vehicle's bogies are metres apart.
LEAST_BENT, LEAST_SHIFT = 2e-6, 0.2
#: A model that is not built from runs is exact in shape if it states no more than this across, m; else it is a map, drawn or refined, whose
#: shape is taken for what the settings say.
EXACT = 0.05
#: Speed at which an error of the gradient is counted as noise of the acceleration, m/s.
USUAL_SPEED = 20.0
#: Least error across that a built model is credited with, m.
LEAST = 1e-3
#: Step of the averaging, m.
STEP = 2.0


@dataclass(frozen=True, slots=True)
class Shape:
    """Errors of a model's shape.

    Attributes
    ----------
    curvature : (k,) array
        Curvature of each knot as it is compared with a gyro: averaged, where the model's own is too noisy, 1/m.
    sigma_curvature : (k,) array
        Its standard deviation, 1/m; NaN where the model states none.
    slope : float
        Standard deviation of the error of d(curvature)/d(offset), 1/m^2: a slope no larger than that is no landmark.
    length : float
        Over which the error of the curvature is the same, m; NaN where the model states none.
    shift : float
        Standard deviation of the place where the curvature changes, m; 0 in a built model, whose slopes are discounted; NaN where the
        model states none.
    turned : float
        Standard deviation of the bearing over that across, rad/m.
    force_noise : float
        What errors of the gradient add to the noise of the forward accelerometer, m/s^2/sqrt(Hz).
    canted : bool
        Whether the model knows cant: one whose cant is zero throughout does not.
    """

    curvature: FloatArray
    sigma_curvature: FloatArray
    slope: float
    length: float
    shift: float
    turned: float
    force_noise: float
    canted: bool


def shape_of(model: TrackModel, network: Network, *, gravity: float = 9.80665) -> Shape:
    """Say what a model's shape is wrong by.

    Parameters
    ----------
    model : TrackModel
        Built from runs where its provenance has a "build"; otherwise a design or an import.
    network : Network
        The same, packed: its standard deviation across.
    gravity : float
        m/s^2.

    Returns
    -------
    Shape
        Built: the laws above. Not built, stated to be within `EXACT`: exact in shape but for the vehicle, and for what the sigma across
        makes over 200 m, which the filter counts anyway. Nothing stated, or more: NaN.

    Notes
    -----
    The laws were measured on simulated builds, where the unaveraged curvature is off by 1e-5 (6 mm across) to
    6e-4 per metre (1.2 m), as much as a bend of 1700 m radius. Where averaging itself bends the curvature, at the ends of
    transitions, half of what twice the averaging changes is added.

    Examples
    --------
    >>> from railnav.matching.network import pack_network
    >>> from railnav.simulation import demo_line
    >>> shape_of(demo_line(), pack_network(demo_line())).slope
    0.0
    """
    k = len(model.offset)
    curvature = network.knots[:, CURVATURE].copy()
    canted = bool(np.any(network.knots[:, CANT] != 0.0))
    stated = np.isfinite(model.covariance_g[:, [0, 1, 3]]).all(axis=1)
    along = _along(model)
    sigma = network.sigma_cross
    if not isinstance(model.provenance.get("build"), dict) or not sigma.any():
        exact = stated & (sigma <= EXACT)
        shift = max(float(np.median(along[exact])), LEAST_SHIFT) if exact.any() else math.nan
        return Shape(
            curvature,
            np.where(exact, LEAST_BENT, np.nan),
            0.0,
            math.nan,
            shift,
            1.0 / BLIND_LENGTH,
            0.0,
            canted,
        )
    bent = np.zeros(k)
    for i in range(len(model.track_id)):
        rows = slice(int(model.knot_start[i]), int(model.knot_start[i + 1]))
        length = float(_law(AVERAGED, np.maximum(np.median(sigma[rows]), LEAST)))
        offset = network.knots[rows, 0]
        once = _averaged(offset, curvature[rows], length)
        bent[rows] = 0.5 * np.abs(_averaged(offset, once, length) - once)
        curvature[rows] = once
    up = np.sqrt(np.maximum(model.covariance_g[:, 5], 0.0))
    up = up[np.isfinite(up)]
    inclined = float(_law(INCLINED, np.asarray(np.median(up)))) if len(up) else 0.0
    return Shape(
        curvature,
        np.hypot(_law(BENT, np.maximum(sigma, LEAST)), bent),
        SLOPE,
        2.0 * float(_law(AVERAGED, np.asarray(np.median(sigma)))),
        0.0,
        TURNED,
        gravity * inclined * math.sqrt(2.0 * INCLINED_LENGTH / USUAL_SPEED),
        canted,
    )


def _law(law: tuple[float, float], sigma: FloatArray) -> FloatArray:
    """Evaluate a * sigma^b."""
    return np.asarray(law[0] * sigma ** law[1])


def _along(model: TrackModel) -> FloatArray:
    """Stated standard deviation along the track of each knot, m."""
    sin, cos = np.sin(model.grid_bearing), np.cos(model.grid_bearing)
    ee, en, nn = (model.covariance_g[:, i] for i in (0, 1, 3))
    return np.asarray(np.sqrt(np.maximum(ee * sin**2 + 2.0 * en * sin * cos + nn * cos**2, 0.0)))


def _averaged(offset: FloatArray, value: FloatArray, length: float) -> FloatArray:
    """Average along a track with a normal weight of this standard deviation, m; its ends are carried on."""
    from scipy.ndimage import gaussian_filter1d

    at = np.linspace(offset[0], offset[-1], max(2, round((offset[-1] - offset[0]) / STEP) + 1))
    smooth = gaussian_filter1d(np.interp(at, offset, value), length / (at[1] - at[0]), mode="nearest")
    return np.asarray(np.interp(offset, at, smooth))
