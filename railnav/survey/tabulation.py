"""A surveyed axis becomes a knot table."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from railnav.survey.nominal import Nominal
from railnav.track.alignment import KnotTable, fit_alignment

if TYPE_CHECKING:
    from railnav.geodesy.grid import GridFrame

FloatArray = NDArray[np.float64]


def tabulate(
    nominal: Nominal,
    axis: FloatArray,
    variance: FloatArray,
    shift: FloatArray,
    heights: tuple[FloatArray, FloatArray] | None,
    cant: FloatArray | None,
    frame: GridFrame,
    spacing: float,
) -> KnotTable:
    """Lay the final curve of one track and give each knot its covariance.

    Parameters
    ----------
    nominal : Nominal
    axis, variance : (N,) array
        Distance of the axis to the right of the nominal curve, m, and its variance, m^2.
    shift : (2, 2) array
        Covariance of what moves the axis as a whole, m^2: a shift of the frame moves it along as well.
    heights : ((N,) array, (N,) array) or None
        Heights, m, and their variance, m^2.
    cant : (N,) array or None
    frame, spacing
        As for `fit_alignment`.
    """
    e, n = nominal.normal
    # the part along of a shift of the frame, and what it has in common with the part across
    along = (nominal.tangent_e, nominal.tangent_n)
    lengthwise, mixed = (
        a[0] * (shift[0, 0] * b[0] + shift[0, 1] * b[1]) + a[1] * (shift[1, 0] * b[0] + shift[1, 1] * b[1])
        for a, b in ((along, along), (along, (e, n)))
    )
    limit = 0.99 * np.sqrt(variance * lengthwise)
    mixed = np.clip(mixed, -limit, limit)
    covariance = np.full((len(e), 6), np.nan)
    covariance[:, 0] = variance * e * e + lengthwise * n * n - 2.0 * mixed * e * n
    covariance[:, 1] = variance * e * n - lengthwise * e * n + mixed * (e * e - n * n)
    covariance[:, 3] = variance * n * n + lengthwise * e * e + 2.0 * mixed * e * n
    if heights is not None:
        covariance[:, [2, 4]] = 0.0
        covariance[:, 5] = heights[1]
    return fit_alignment(
        frame,
        nominal.easting + axis * e,
        nominal.northing + axis * n,
        None if heights is None else heights[0],
        cant=cant,
        covariance_g=covariance,
        spacing=spacing,
    )
