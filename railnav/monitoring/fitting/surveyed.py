"""How the axis of a surveyed model errs: read from its chain records, not guessed from its points.

A survey smooths: its axis is the likeliest one under a curvature that walks at random (strength q) and fixes that err in white noise and
in waves. At wavelengths longer than what it smooths over, the axis errs as the fixes do, in white noise of spectral density r and in
waves that forget over kilometres; shorter waves it has none, and so no elements either. Both follow from the variances of slope and
curvature that the records state, and the walk (docs/theory/alignment.md, eqs 13, 14). Points are taken as far apart as the axis
was smoothed over: what lies between them is interpolation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RailnavError
from railnav.monitoring.fitting.segmentation import Noise
from railnav.track.elements import ARC, CLOTHOID, Plan
from railnav.track.model import TrackModel
from railnav.track.records import AxisRecords

FloatArray = NDArray[np.float64]

#: Wave numbers at which spectra are summed, in units of that at which smoothing sets in.
_WAVES = np.geomspace(1e-5, 1e4, 800)
#: Waves of fixes reach over this at least, in lengths of smoothing: shorter ones count as white.
_LONG = 5.0
#: Waves smaller than this share of the white noise are none.
_SLIGHT = 0.05
#: And at most so far, m: fixes of trains err alike over minutes.
_LONGEST = 5_000.0
#: A transition shows where it is worth this, in -2 log likelihood; none is taken to be longer than that unseen, m.
_SHOWN, _LONGEST_UNSEEN = 16.0, 150.0
#: Where transitions shorter than this are hidden, they are not expected to show, m.
HIDDEN = 50.0
#: Rounds of the search for white noise and waves.
_ROUNDS = 50


@dataclass(frozen=True, slots=True)
class SurveyNoise:
    """Errors of a surveyed axis in one coordinate.

    Attributes
    ----------
    smoothing : float
        Length L over which it is smoothed: waves of length 2 pi L pass by half, m.
    density : float
        Spectral density r of the white part of its errors at longer waves, m^2 m.
    correlated, length : float
        Size of the waves of its fixes, m, and the distance over which they forget, m.
    """

    smoothing: float
    density: float
    correlated: float
    length: float

    def noise(self, spacing: float) -> Noise:
        """Noise of points taken so far apart, m."""
        return Noise(float(np.sqrt(self.density / spacing)), self.correlated, self.length)


def noise_of_smoothed(walk: float, offset: float, slope: float, curvature: float) -> SurveyNoise:
    """Errors of an axis that was smoothed, from what its estimate states.

    Parameters
    ----------
    walk : float
        Random walk of the curvature, 1/m per sqrt(m).
    offset, slope, curvature : float
        Standard deviations of distance, m, slope, and curvature, 1/m, that the estimate states.

    Returns
    -------
    SurveyNoise

    Notes
    -----
    With S(k) = r + c/k^2 the spectrum of what the fixes err by and H = 1/(1 + S k^6/q), the estimate errs by S H:
    var slope = int k^2 S H dk/2 pi, var curvature = int k^4 S H dk/2 pi are solved for r and c; c = 2 s^2/l with what is left of the
    variance of the distance gives waves of size s and length l. With c = 0, L = (r/q)^(1/6) = 3 var curvature/q.

    Examples
    --------
    >>> q, r = 2e-9, 10.0
    >>> L = (r / q) ** (1.0 / 6.0)
    >>> one = noise_of_smoothed(q**0.5, (r / (3.0 * L)) ** 0.5, (r / (6.0 * L**3)) ** 0.5, (q * L / 3.0) ** 0.5)
    >>> round(one.smoothing / L, 2), round(one.density, 1), one.correlated < 0.1
    (1.0, 10.0, True)
    """
    q = walk**2
    L = 3.0 * curvature**2 / q
    k = _WAVES / L
    step = k * np.log(_WAVES[1] / _WAVES[0])

    def told(r: float, c: float) -> tuple[float, float, float]:
        """Variances of slope and curvature, and of the distance but for waves longer than any here."""
        spectrum = r + c / k**2
        left = spectrum / (1.0 + spectrum * k**6 / q) / np.pi * step
        return float(k**2 @ left), float(k**4 @ left), float(np.sum(r / (1.0 + spectrum * k**6 / q) / np.pi * step))

    # the share of waves in the spectrum where smoothing sets in: curvature settles the sum, slope the share
    low, high = 0.0, 1.0
    r = c = 0.0
    for _ in range(_ROUNDS):
        share = 0.5 * (low + high)
        total_low, total_high = 1e-3 * q * L**6, 1e3 * q * L**6
        for _ in range(_ROUNDS):
            total = float(np.sqrt(total_low * total_high))
            r, c = (1.0 - share) * total, share * total / L**2
            if told(r, c)[1] > curvature**2:
                total_high = total
            else:
                total_low = total
        if told(r, c)[0] > slope**2:
            high = share
        else:
            low = share
    white = told(r, c)[2]
    waves = max(offset**2 - white, 0.0)
    smoothing = float((max(r + c * L**2, 1e-30) / q) ** (1.0 / 6.0))
    if waves < _SLIGHT**2 * r / smoothing:
        return SurveyNoise(smoothing, r + c * smoothing**2, 0.0, 1.0)
    length = min(2.0 * waves / max(c, 1e-30), _LONGEST)  # chains that were merged forget that their runs erred alike
    if length < _LONG * smoothing:
        return SurveyNoise(smoothing, r + c * smoothing**2, 0.0, 1.0)
    return SurveyNoise(smoothing, r, float(np.sqrt(waves)), length)


def noise_of_records(side: AxisRecords) -> SurveyNoise | None:
    """Errors of one coordinate of a surveyed axis, from the median of what its nodes state; None where they do not tell."""
    try:
        solution = side.chain().solve()
    except RailnavError:
        return None
    if solution.covariance is None or len(side.noise) < 10:
        return None
    variance = np.einsum("kii->ki", solution.covariance)
    offset, slope, bend = (float(np.sqrt(np.median(variance[:, i]))) for i in range(3))
    walk = float(np.median(side.noise))
    if not (np.isfinite([offset, slope, bend, walk]).all() and min(offset, slope, bend, walk) > 0.0):
        return None
    return noise_of_smoothed(walk, offset, slope, bend)


def noise_of_model(model: TrackModel, track: str) -> tuple[SurveyNoise | None, SurveyNoise | None]:
    """Errors across and in height of a track, where its model has the records of its surveys."""
    try:
        records = model.records
    except RailnavError:
        return None, None
    kept = None if records is None else records.tracks.get(records.surveyed(track))
    if kept is None:
        return None, None
    return noise_of_records(kept.across), None if kept.up is None else noise_of_records(kept.up)


def longest_unseen(density: float, jump: float) -> float:
    """Length of the longest transition that stays hidden between plain elements whose curvatures are `jump` apart, m."""
    return float((_SHOWN * density * (48.0 / jump) ** 2) ** 0.2)


def owed_to_unseen(plan: Plan, density: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Standard deviations of stations, lengths and radii (m,), m, because transitions may be hidden where plain elements meet.

    A transition of length x between plain elements of curvatures k apart lies k x^2/48 off their joint at most, and shows where that,
    squared, over its length and the noise is worth 16: x^5 = 16 r (48/k)^2. Hidden ones of any length up to that make an arc of length
    l seem longer by x^2/(3 l) and its radius larger alike, while the joint stays about its middle (docs/theory/alignment.md, eq 15).
    """
    count = len(plan.kind)
    plain = plan.kind < CLOTHOID
    joint, radius = np.zeros(count + 1), np.zeros(count)
    for j in range(1, count):
        if not (plain[j - 1] and plain[j]):
            continue
        jump = abs(float(plan.curvature_start[j] - plan.curvature_end[j - 1]))
        if jump == 0.0:
            continue
        longest = min(longest_unseen(density, jump), _LONGEST_UNSEEN)
        square = longest**2 / np.sqrt(5.0)  # root of the mean fourth power of lengths up to that
        arcs = [i for i in (j - 1, j) if plan.kind[i] == ARC]
        shortest = max(min((float(plan.length[i]) for i in arcs), default=longest), longest)
        joint[j] = square / (6.0 * shortest)
        for i in arcs:
            radius[i] += square / (6.0 * max(float(plan.length[i]), longest) ** 2) / abs(float(plan.curvature_start[i]))
    return joint[:-1], joint[:-1] + joint[1:], radius
