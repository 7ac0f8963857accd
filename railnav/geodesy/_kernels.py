"""Transverse Mercator on flat arrays (Karney's 6th-order Krueger series); SI and radians, no validation."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


# parameters: [easting 0, northing of the equator, k0 A (m), k0 A/a, e^2, beta 1..6]
@njit(cache=True)
def transverse_mercator_factors(easting, northing, parameters, latitude, convergence, scale):
    """Latitude (rad), convergence (rad) and point scale at grid positions (m); all arrays (n,)."""
    e2 = parameters[4]
    e = math.sqrt(e2)
    for i in range(easting.shape[0]):
        xi = (northing[i] - parameters[1]) / parameters[2]
        eta = (easting[i] - parameters[0]) / parameters[2]
        xi1, eta1, p, q = xi, eta, 1.0, 0.0
        for j in range(1, 7):  # Karney 2011 eqs 11 and 26, reverse
            beta = parameters[4 + j]
            s, c = math.sin(2 * j * xi), math.cos(2 * j * xi)
            sh, ch = math.sinh(2 * j * eta), math.cosh(2 * j * eta)
            xi1 -= beta * s * ch
            eta1 -= beta * c * sh
            p -= 2 * j * beta * c * ch
            q += 2 * j * beta * s * sh
        sinh_eta, cos_xi = math.sinh(eta1), math.cos(xi1)
        h = math.hypot(sinh_eta, cos_xi)
        tau1 = math.sin(xi1) / h
        tau = tau1 / (1.0 - e2)
        for _ in range(3):  # Newton, eqs 19 to 21
            root = math.sqrt(1.0 + tau * tau)
            sigma = math.sinh(e * math.atanh(e * tau / root))
            tau_i = tau * math.sqrt(1.0 + sigma * sigma) - sigma * root
            tau += (
                (tau1 - tau_i) / math.sqrt(1.0 + tau_i * tau_i) * (1.0 + (1.0 - e2) * tau * tau) / ((1.0 - e2) * root)
            )
        latitude[i] = math.atan(tau)
        convergence[i] = math.atan2(math.sin(xi1) * math.tanh(eta1), cos_xi) + math.atan2(q, p)  # eqs 27, 28
        sine_squared = tau * tau / (1.0 + tau * tau)
        scale[i] = (  # eqs 28, 29 with k0
            math.sqrt((1.0 - e2 * sine_squared) * (1.0 + tau * tau)) * h * parameters[3] / math.hypot(p, q)
        )


def krueger_beta(n: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Coefficients beta 1..6 of the reverse series for the third flattening n (Karney 2011, eq. 36)."""
    return np.array(
        [
            n * (1 / 2 + n * (-2 / 3 + n * (37 / 96 + n * (-1 / 360 + n * (-81 / 512 + n * 96199 / 604800))))),
            n**2 * (1 / 48 + n * (1 / 15 + n * (-437 / 1440 + n * (46 / 105 - n * 1118711 / 3870720)))),
            n**3 * (17 / 480 + n * (-37 / 840 + n * (-209 / 4480 + n * 5569 / 90720))),
            n**4 * (4397 / 161280 + n * (-11 / 504 - n * 830251 / 7257600)),
            n**5 * (4583 / 161280 - n * 108847 / 3991680),
            n**6 * 20648693 / 638668800,
        ]
    )
