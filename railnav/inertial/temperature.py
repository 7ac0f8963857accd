"""Parameters of a sensor against its temperature, as polynomials with their covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TemperaturePolynomial:
    """Polynomials of one or more parameters against temperature.

    Attributes
    ----------
    coefficients : (degree + 1, k) array
        Of powers of (temperature - centre)/half_range.
    covariance : (degree + 1, degree + 1) array
        Of the coefficients of each parameter, per unit variance of a value.
    sigma : (k,) array
        Of a value, given or estimated from the residuals.
    centre, half_range : float
        Of the temperatures that were measured, K.
    """

    coefficients: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    centre: float
    half_range: float

    def at(self, temperature: ArrayLike, *, beyond: float = 5.0) -> FloatArray:
        """Values at temperatures, (...) K -> (..., k).

        Parameters
        ----------
        temperature : float or (...) array
            K.
        beyond : float, optional
            How far outside the measured range is still allowed, K.

        Raises
        ------
        EstimationError
            Further outside: polynomials run away there.
        """
        return np.asarray(self._powers(temperature, beyond) @ self.coefficients)

    def sigma_at(self, temperature: ArrayLike, *, beyond: float = 5.0) -> FloatArray:
        """Standard deviations of `at`, (..., k)."""
        p = self._powers(temperature, beyond)
        return np.asarray(np.sqrt(np.einsum("...i,ij,...j->...", p, self.covariance, p))[..., None] * self.sigma)

    def _powers(self, temperature: ArrayLike, beyond: float) -> FloatArray:
        t = np.asarray(temperature, dtype=np.float64)
        outside = np.abs(t - self.centre) > self.half_range + beyond
        if np.any(outside) or not np.isfinite(t).all():
            worst = float(t[outside].flat[0]) if np.any(outside) else math.nan
            raise EstimationError(
                f"temperature {worst:.1f} K lies outside what was calibrated, "
                f"{self.centre - self.half_range:.1f} to {self.centre + self.half_range:.1f} K; measure there too"
            )
        x = (t - self.centre) / self.half_range
        return np.asarray(x[..., None] ** np.arange(len(self.coefficients)))


def fit_temperature(
    temperature: ArrayLike, values: ArrayLike, *, degree: int = 2, sigma: ArrayLike | None = None
) -> TemperaturePolynomial:
    """Polynomial of calibration parameters against temperature.

    Parameters
    ----------
    temperature : (m,) array
        K.
    values : (m,) or (m, k) array
        Biases, scale errors, ... at these temperatures.
    degree : int, optional
        Of the polynomial.
    sigma : float or (k,) array, optional
        Of a value; by default estimated from the residuals.

    Returns
    -------
    TemperaturePolynomial

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite.
    EstimationError
        Fewer different temperatures than coefficients, or none left over to estimate sigma from.

    Examples
    --------
    >>> fit_temperature([273.0, 283.0, 293.0, 303.0], [0.0, 0.1, 0.2, 0.3], degree=1).at(288.0).round(6)
    array([0.15])
    """
    t = np.asarray(temperature, dtype=np.float64)
    y = np.asarray(values, dtype=np.float64)
    y = y[:, None] if y.ndim == 1 else y
    if t.ndim != 1 or y.ndim != 2 or len(t) != len(y):
        raise ValueError(f"needs temperatures (m,) and values (m, k), not {t.shape} and {y.shape}")
    if not (np.isfinite(t).all() and np.isfinite(y).all()):
        raise ValueError("temperature or values hold a value that is not finite")
    different = len(np.unique(t))
    if different < degree + 1:
        raise EstimationError(
            f"{different} temperatures do not determine a polynomial of degree {degree}; measure at {degree + 1} or lower the degree"
        )
    left = len(t) - degree - 1
    if sigma is None and left == 0:
        raise EstimationError(
            "no measurement is left over to estimate the sigma from; give sigma, or measure once more"
        )
    centre, half_range = 0.5 * (t.max() + t.min()), 0.5 * float(np.ptp(t)) or 1.0
    A = ((t - centre) / half_range)[:, None] ** np.arange(degree + 1)
    X, _, _, _ = np.linalg.lstsq(A, y, rcond=None)
    if sigma is None:
        spread = np.sqrt(np.sum((y - A @ X) ** 2, axis=0) / left)
    else:
        spread = np.broadcast_to(np.asarray(sigma, dtype=np.float64), (y.shape[1],)).copy()
    return TemperaturePolynomial(X, np.linalg.inv(A.T @ A), spread, float(centre), half_range)
