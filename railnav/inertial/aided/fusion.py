"""Schemes beside the one filter: two filters fused at their outputs, and the plain switch between GNSS and INS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.inertial.aided.aiding import Fixes
from railnav.inertial.mechanization import GravityField, NavigationState, Trajectory, mechanize

FloatArray = NDArray[np.float64]
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Fused:
    """One estimate out of two.

    Attributes
    ----------
    state : (..., n) array
    covariance : (..., n, n) array
    weight : (...) array
        Weight of the first estimate's information in covariance intersection; 1 for the source's rule, which takes both in full.
    """

    state: FloatArray
    covariance: FloatArray
    weight: FloatArray


def fuse(
    first: ArrayLike,
    first_covariance: ArrayLike,
    second: ArrayLike,
    second_covariance: ArrayLike,
    *,
    method: Literal["information", "covariance_intersection"] = "covariance_intersection",
) -> Fused:
    """Fuse two estimates of one state, as the decentralised scheme does with an INS/GNSS and an INS/odometer filter.

    "information" is the source's rule, P = (P1^-1 + P2^-1)^-1, x = P (P1^-1 x1 + P2^-1 x2), right for independent errors only. Both filters
    share the IMU: "covariance_intersection", P = (w P1^-1 + (1 - w) P2^-1)^-1 with the w of least determinant, is never optimistic,
    whatever the correlation.

    Parameters
    ----------
    first, second : (..., n) array
        Estimates.
    first_covariance, second_covariance : (..., n, n) array
        Theirs.
    method : {"covariance_intersection", "information"}, optional
        Which rule.

    Returns
    -------
    Fused

    Raises
    ------
    ValueError
        Shapes that do not fit, an unknown method.
    EstimationError
        A covariance that is not positive definite.

    Notes
    -----
    Variances 4 and 1 with correlation 0.6: the source's rule claims 0.8 where 1.184 is true; covariance intersection claims 1.

    References
    ----------
    `spec/inertial.md` B9, KZ(2.15), KZ(2.16) as matrices. Julier, S. J. and Uhlmann, J. K.: A non-divergent estimation algorithm in the
    presence of unknown correlations. Proc. American Control Conference, 1997.

    Examples
    --------
    >>> both = fuse([1.0, 2.0], np.diag([4.0, 1.0]), [2.0, 0.0], np.diag([1.0, 9.0]), method="information")
    >>> both.state, np.diagonal(both.covariance)
    (array([1.8, 1.8]), array([0.8, 0.9]))
    """
    x1, x2 = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    P1, P2 = np.asarray(first_covariance, dtype=np.float64), np.asarray(second_covariance, dtype=np.float64)
    n = x1.shape[-1] if x1.ndim else 0
    if n == 0 or x2.shape != x1.shape or P1.shape != (*x1.shape, n) or P2.shape != P1.shape:
        raise ValueError(f"shapes do not fit: {x1.shape}, {P1.shape}, {x2.shape}, {P2.shape}")
    if method not in ("information", "covariance_intersection"):
        raise ValueError(f"method {method!r} is none of information, covariance_intersection")
    try:
        np.linalg.cholesky(P1)
        np.linalg.cholesky(P2)
    except np.linalg.LinAlgError:
        raise EstimationError("a covariance to be fused is not positive definite") from None
    I1: FloatArray = np.asarray(np.linalg.inv(P1), dtype=np.float64)
    I2: FloatArray = np.asarray(np.linalg.inv(P2), dtype=np.float64)
    if method == "information":
        weight = np.ones(x1.shape[:-1])
        a, b = weight, weight
    else:
        weight = _intersection_weight(I1, I2)
        a, b = weight, 1.0 - weight
    P = np.linalg.inv(a[..., None, None] * I1 + b[..., None, None] * I2)
    P = 0.5 * (P + np.swapaxes(P, -1, -2))
    mixed = a[..., None] * np.einsum("...ij,...j->...i", I1, x1) + b[..., None] * np.einsum("...ij,...j->...i", I2, x2)
    return Fused(np.einsum("...ij,...j->...i", P, mixed), np.asarray(P, dtype=np.float64), weight)


def _intersection_weight(I1: FloatArray, I2: FloatArray) -> FloatArray:
    """Weight w in 0 to 1 of the greatest det(w I1 + (1 - w) I2): the log of a determinant is concave, golden section finds the top."""

    def height(w: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.slogdet(w[..., None, None] * I1 + (1.0 - w)[..., None, None] * I2)[1])

    low, high = np.zeros(I1.shape[:-2]), np.ones(I1.shape[:-2])
    for _ in range(40):
        left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        better = height(left) > height(right)
        high, low = np.where(better, right, high), np.where(better, low, left)
    w = 0.5 * (low + high)
    for end in (np.zeros_like(w), np.ones_like(w)):
        w = np.where(height(end) >= height(w), end, w)
    return np.asarray(w)


def switch_to_gnss(
    start: NavigationState,
    time: ArrayLike,
    rate_ib_b: ArrayLike,
    specific_force_b: ArrayLike,
    fixes: Fixes,
    *,
    start_time: float,
    gravity: GravityField | None = None,
) -> Trajectory:
    """The separate scheme: the output is GNSS where there is a fix and the INS between; each fix resets position and velocity.

    Parameters
    ----------
    start : NavigationState
        Of the antenna at `start_time`.
    time : (n,) array
        End of the interval of each sample, s.
    rate_ib_b, specific_force_b : (n, 3) array
        rad/s, m/s^2.
    fixes : Fixes
        Without velocities the INS keeps its own.
    start_time : float
        s.
    gravity : GravityField, optional
        Default: WGS 84.

    Returns
    -------
    Trajectory
        n + 1 states; no covariance, as the scheme has none.

    Raises
    ------
    ValueError
        Wrong shapes, times that do not increase.

    Notes
    -----
    The simplest and cheapest form: attitude errors are never corrected, and the output is never better than the active sensor. The source
    names it "direct"; it stands here to be compared with.

    References
    ----------
    `spec/inertial.md` B7.

    Examples
    --------
    >>> rest = np.tile(-GravityField().vector(0.9), (100, 1))
    >>> out = switch_to_gnss(NavigationState(0.9, 0.0, 0.0), np.arange(1, 101) * 0.01, np.zeros((100, 3)), rest,
    ...     Fixes([0.5], [[0.9, 1e-6, 0.0]], [3.0] * 3), start_time=0.0)
    >>> float(out.longitude[50])
    1e-06
    """
    t = np.asarray(time, dtype=np.float64)
    w, f = np.asarray(rate_ib_b, dtype=np.float64), np.asarray(specific_force_b, dtype=np.float64)
    if t.ndim != 1 or w.shape != (len(t), 3) or f.shape != (len(t), 3):
        raise ValueError("needs one time, rate and specific force a sample")
    interval = np.diff(t, prepend=start_time)
    inside = np.flatnonzero((fixes.time > start_time) & (fixes.time <= t[-1]))
    row = np.searchsorted(t, fixes.time[inside], side="left")
    out = np.empty((len(t) + 1, 10))
    state, first = start, 0
    for last, fix in [*zip((row + 1).tolist(), inside.tolist(), strict=True), (len(t), -1)]:
        if last > first:
            leg = mechanize(state, interval[first:last], w[first:last], f[first:last], gravity=gravity)
            out[first : last + 1] = np.column_stack(
                [leg.latitude, leg.longitude, leg.height, leg.velocity_n, leg.quaternion_nb]
            )
            state, first = leg.state(), last
        if fix >= 0:
            velocity = state.velocity_n if fixes.velocity_n is None else fixes.velocity_n[fix]
            latitude, longitude, height = fixes.position[fix].tolist()
            state = NavigationState(latitude, longitude, height, velocity, state.quaternion_nb)
            out[first] = [*fixes.position[fix], *velocity, *state.quaternion_nb]
    stamps = np.concatenate([[start_time], t])
    return Trajectory(stamps, out[:, 0], out[:, 1], out[:, 2], out[:, 3:6], out[:, 6:])
