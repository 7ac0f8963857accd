"""Profile of a track: grades and vertical curves fitted to heights along its plan."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railnav.errors import EstimationError, TrackError
from railnav.monitoring.fitting import judgement, precision, segmentation, stretches
from railnav.monitoring.fitting.axis import LEAST_POINTS, Axis
from railnav.monitoring.fitting.noise import Resolution, likeliest, likeliest_smooth, resolution
from railnav.monitoring.fitting.segmentation import Noise, Pieces
from railnav.track.elements import Gradients

FloatArray = NDArray[np.float64]

#: Heights count as exact below this, m.
FLOOR = 5e-4
#: A sum of squares may grow by this for each piece that is left out.
_DEARER = 9.0
#: Pieces left out, at most.
_MOST_DROPPED = 20
#: Steps after which a piece left out is judged.
_FEW = 4
#: What vertical curves may be.
VERTICAL = ("parabola", "circle")


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """A fitted profile.

    Attributes
    ----------
    gradients : Gradients
    sigma : (p, 3) array
        Of its pieces: begin, m; gradient there; radius of vertical curves, m (NaN of grades).
    noise : Noise
        Of the heights.
    residual : (n,) array
        m.
    """

    gradients: Gradients
    sigma: FloatArray
    noise: Noise
    residual: FloatArray


def fit_profile(axis: Axis, along: FloatArray, *, sigma: float | None = None, vertical: str = "parabola") -> Profile:
    """Fit grades and vertical curves to the heights of an axis.

    Parameters
    ----------
    axis : Axis
        With heights.
    along : (n,) array
        Lengths of its points along the plan, growing, m.
    sigma : float, optional
        White noise of the heights, m; by default found from them.
    vertical : str
        "parabola" or "circle": of the same radius they differ by micrometres, so that heights do not tell.

    Raises
    ------
    TrackError
        No heights, or another word.
    """
    if vertical not in VERTICAL:
        raise TrackError(f"vertical curves as {vertical!r}; use {' or '.join(VERTICAL)}")
    if axis.height is None:
        raise TrackError(f"track {axis.track!r} has no heights")
    height = axis.height
    stated = None if axis.stated is None else float(np.median(axis.stated[:, 1]))
    surveyed = axis.surveyed_height
    if surveyed is None:
        chosen = resolution_of_values(height, along, FLOOR, stated)
    else:
        spacing = float(along[-1] - along[0]) / (len(along) - 1)
        every = max(1, min(round(surveyed.smoothing / spacing), len(along) // LEAST_POINTS))
        chosen = Resolution(every, every * spacing, max(float(surveyed.noise(every * spacing).sigma), FLOOR))
    smooth = surveyed is None and stated is not None and chosen.every > 1
    pick = np.arange(0, len(along), chosen.every)
    place = axis.along[pick]
    along, height = along[pick], height[pick]
    slope = np.gradient(height, place)
    wide = min(max(3, round(50.0 / chosen.spacing)), len(slope))
    mean = np.convolve(slope, np.ones(wide) / wide, mode="same")
    bend = float(np.clip(np.percentile(np.abs(np.gradient(mean, place)), 90), 2e-5, 2e-3))

    def pieces(noise: Noise, part: slice, beam: int = segmentation.NARROW) -> Pieces:
        return segmentation.segment_profile(along[part], height[part], noise, bend_scale=bend, beam=beam)

    if surveyed is not None:
        noise = replace(surveyed.noise(chosen.spacing), sigma=chosen.sigma if sigma is None else sigma)
    elif smooth and stated is not None:
        noise = likeliest_smooth(pieces, len(along), stated, floor=0.1 * FLOOR, stated=sigma)
    else:
        white = chosen.sigma if sigma is None else sigma
        noise = likeliest(pieces, len(along), chosen.spacing, white, floor=FLOOR, stated=sigma)
    found = stretches.stretches_of_pieces(pieces(noise, slice(0, len(along)), segmentation.BEAM), along, height, 2)
    per_point = np.full(len(along), noise.total)
    fitted = stretches.fit_stretches(found, along, height, per_point)
    fitted, each = settled(fitted, along, height, per_point, noise, sigma, 2)
    s = fitted.stretches
    m = len(s.begin)
    begin = s.begin.copy()
    begin[0] = -np.inf
    gradients = Gradients(
        begin, s.begin, s.state[:, 0].copy(), s.state[:, 1].copy(), 0.5 * np.where(s.bent, s.top, 0.0), np.zeros(m)
    )
    if vertical == "circle":
        gradients = circular(gradients, s.end)
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.where(s.bent, each[:, 3] / s.top**2, np.nan)
    table = np.column_stack([each[:, 2], each[:, 1], radius])
    return Profile(gradients, table, noise_of_stretches(fitted, noise, sigma, per_point), fitted.residual)


def circular(gradients: Gradients, end: float) -> Gradients:
    """The profile with circles in place of parabolas: between the same places, from and to the same gradients."""
    ends = np.append(gradients.begin[1:], end)
    bent = gradients.bend != 0.0
    first = gradients.slope
    last = first + 2.0 * gradients.bend * (ends - gradients.origin)
    turn = last / np.hypot(1.0, last) - first / np.hypot(1.0, first)
    radius = np.where(bent, (ends - gradients.origin) / np.where(bent, turn, 1.0), 0.0)
    return Gradients(
        gradients.begin,
        gradients.origin,
        gradients.height,
        gradients.slope,
        np.where(bent, 0.0, gradients.bend),
        radius,
    )


def resolution_of_values(
    values: FloatArray, along: FloatArray, floor: float, stated: float | None = None
) -> Resolution:
    """How far apart values along a track are worth taking."""
    spacing = float(along[-1] - along[0]) / (len(along) - 1)

    def fourth(every: int) -> FloatArray:
        found = [np.diff(values[k::every], 4) for k in range(every)]
        return np.concatenate(found)

    return resolution(fourth, spacing, len(along), floor=floor, stated=stated)


def settled(
    fitted: stretches.StretchesFit,
    along: FloatArray,
    values: FloatArray,
    per_point: FloatArray,
    noise: Noise,
    sigma: float | None,
    states: int,
) -> tuple[stretches.StretchesFit, FloatArray]:
    """The fit without pieces shorter than their sigmas or alike on both sides, and sigmas (m, states + 2) of its unknowns."""
    refused: set[float] = set()
    # what the values as first found scatter by; it must not grow with what is left out
    size = float(np.clip(fitted.cost / max(len(along) - 2 * len(fitted.stretches.begin), 1), 1e-3, 1.0))
    size *= _again(noise, along)
    for _ in range(_MOST_DROPPED):
        true = noise_of_stretches(fitted, noise, sigma, per_point)
        each = stretch_sigmas(fitted, along, true, per_point)
        s = fitted.stretches
        begin_sigma = each[:, states]
        ends = np.append(begin_sigma[1:], 0.0)
        doubt = s.length / (2.0 * np.hypot(begin_sigma, ends) + 1e-9)
        flat = np.abs(s.top) / (judgement.NOTHING * each[:, states + 1] + 1e-30)
        doubt = np.where(s.bent, np.minimum(doubt, flat), doubt)
        doubt[0] = np.inf if not s.bent[0] else flat[0]
        doubt[[round(at, 3) in refused for at in s.begin.tolist()]] = np.inf
        j = int(np.argmin(doubt))
        if doubt[j] >= 1.0 or len(s.begin) < 2:
            return fitted, each
        try:
            again = stretches.fit_stretches(_without(s, j), along, values, per_point, steps=_FEW)
        except EstimationError:
            refused.add(round(float(s.begin[j]), 3))
            continue
        if again.cost > fitted.cost + _DEARER * size:
            refused.add(round(float(s.begin[j]), 3))
        else:
            fitted = again
    true = noise_of_stretches(fitted, noise, sigma, per_point)
    return fitted, stretch_sigmas(fitted, along, true, per_point)


def _again(noise: Noise, along: FloatArray) -> float:
    """How often points tell the same: waves make neighbours alike."""
    step = float(np.median(np.diff(along)))
    return 1.0 + 2.0 * noise.length / step * (noise.correlated / noise.total) ** 2


def _without(s: stretches.Stretches, j: int) -> stretches.Stretches:
    """Pieces without piece j: a curve that is none joins the grades beside it into one."""
    keep = np.ones(len(s.begin), bool)
    if j == 0:
        bent, top = s.bent.copy(), s.top.copy()
        bent[0], top[0] = False, 0.0
        if len(bent) > 1 and not bent[1]:
            keep[1] = False
        return stretches.Stretches(s.begin[keep], s.end, s.state[keep], top[keep], bent[keep], s.order[keep])
    keep[j] = False
    if j + 1 < len(keep) and not s.bent[j - 1] and not s.bent[j + 1]:
        keep[j + 1] = False
    return stretches.Stretches(s.begin[keep], s.end, s.state[keep], s.top[keep], s.bent[keep], s.order[keep])


def noise_of_stretches(
    fitted: stretches.StretchesFit, noise: Noise, sigma: float | None, per_point: FloatArray
) -> Noise:
    """The noise with the size that the residuals have; never less than the user states."""
    unknown = 2 * len(fitted.stretches.begin)
    square = float(np.sum(fitted.weight * fitted.residual**2)) / max(len(fitted.residual) - unknown, 1)
    factor = float(np.sqrt(square) / per_point[0])
    if sigma is not None or factor < 1.0:
        factor = max(factor, 1.0)
    return noise.scaled(factor)


def stretch_sigmas(
    fitted: stretches.StretchesFit, along: FloatArray, noise: Noise, per_point: FloatArray
) -> FloatArray:
    """Sigmas (m, states + 2) of the unknowns of pieces under a noise."""
    from scipy import sparse

    p = stretches.unknowns(fitted.stretches)
    middle = precision.noise_of_points(fitted.design, along, noise, per_point, fitted.weight)
    found = precision.sigmas(fitted.factor, p, sparse.eye_array(p, format="csr"), middle)
    return found.reshape(len(fitted.stretches.begin), -1)
