"""Chord measures: versines of any chord, what they show of each wavelength, and the track restored from them.

A chord of `a` metres behind and `b` metres ahead of a point; the versine is the distance from the rail to the chord there. Positive
on a curve to the right, like curvature: on a circle it is a b / 2R.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError
from railnav.monitoring.filters import Band

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

#: A chord that shows less than this share of a wave cannot give it back: noise would come back tenfold.
LEAST_GAIN = 0.1


@dataclass(frozen=True, slots=True)
class Chord:
    """A measuring chord.

    Attributes
    ----------
    behind, ahead : float
        From the measured point to the chord's ends, m: against and along growing distance.
    """

    behind: float
    ahead: float

    def __post_init__(self) -> None:
        if not (0.0 < self.behind < math.inf and 0.0 < self.ahead < math.inf):
            raise TrackError(f"a chord reaches {self.behind} m behind and {self.ahead} m ahead; both must be positive")

    @classmethod
    def symmetric(cls, length: float) -> Chord:
        """Chord of a length, measured at its middle."""
        return cls(0.5 * length, 0.5 * length)

    @property
    def length(self) -> float:
        """Whole length, m."""
        return self.behind + self.ahead

    @property
    def factor(self) -> float:
        """Versine over curvature, m^2: a b / 2."""
        return 0.5 * self.behind * self.ahead

    def transfer(self, wavelength: ArrayLike) -> ComplexArray:
        """Complex amplitude of rail minus chord for a wave of unit amplitude.

        H = 1 - (b e^(-i w a) + a e^(i w b)) / (a + b), w = 2 pi / wavelength; the versine is -H times the wave's displacement to the
        right.

        References
        ----------
        docs/theory/geometry.md (4).

        Examples
        --------
        >>> abs(Chord.symmetric(10.0).transfer([5.0, 10.0, 70.0])).round(3)
        array([0.   , 2.   , 0.099])
        """
        return self._transfer(2.0 * np.pi / np.asarray(wavelength, float))

    def _transfer(self, omega: FloatArray) -> ComplexArray:
        a, b = self.behind, self.ahead
        return np.asarray(1.0 - (b * np.exp(-1j * omega * a) + a * np.exp(1j * omega * b)) / (a + b))

    def blind(self, shortest: float, longest: float) -> FloatArray:
        """Wavelengths between two that the chord does not show at all, m, longest first.

        Zeros of H: both a and b are whole numbers of the wavelength.

        Examples
        --------
        >>> Chord.symmetric(20.0).blind(3.0, 25.0).round(2)
        array([10.  ,  5.  ,  3.33])
        """
        count = np.arange(1, math.floor(self.behind / shortest + 1e-9) + 1)
        waves = self.behind / count
        whole = np.abs(self.ahead / waves - np.round(self.ahead / waves)) < 1e-9
        return waves[whole & (waves <= longest * (1 + 1e-12)) & (waves >= shortest * (1 - 1e-12))]

    def seen(self, band: Band) -> tuple[float, float]:
        """Least and greatest share that the chord shows of a wave in a band.

        Examples
        --------
        >>> low, high = Chord(4.1, 17.4).seen(Band("D1", 3.0, 25.0))
        >>> round(low, 3), round(high, 2)
        (0.264, 1.95)
        """
        count = 4001 + int(400.0 * self.length * (1.0 / band.lower - 1.0 / band.upper))
        omega = np.linspace(2.0 * np.pi / band.upper, 2.0 * np.pi / band.lower, count)
        size = np.abs(self._transfer(omega))
        low = 0.0 if len(self.blind(band.lower, band.upper)) else float(size.min())
        return low, float(size.max())


def versines(displacement: ArrayLike, step: float, chord: Chord) -> FloatArray:
    """Versines of a rail given by its displacements from a straight line.

    Parameters
    ----------
    displacement : (n,) array
        To the right (or, for a profile, downwards), m, at uniform distances.
    step : float
        Distance between samples, m.
    chord : Chord
        Its arms must be whole numbers of steps (to a tenth of a percent); resample first where they are not.

    Returns
    -------
    (n,) array
        m; positive where the track bends to the right. NaN where the chord would reach beyond the ends.

    Examples
    --------
    >>> s = np.arange(0.0, 41.0)
    >>> float(versines(s**2 / 2000.0, 1.0, Chord.symmetric(20.0))[20].round(6))
    0.05
    """
    y = np.asarray(displacement, float)
    behind, ahead = _steps(chord.behind, step), _steps(chord.ahead, step)
    out = np.full(len(y), np.nan)
    if len(y) > behind + ahead:
        here = slice(behind, len(y) - ahead)
        chord_there = (chord.ahead * y[: len(y) - ahead - behind] + chord.behind * y[behind + ahead :]) / chord.length
        out[here] = chord_there - y[here]
    return out


def versines_in_plan(easting: ArrayLike, northing: ArrayLike, step: float, chord: Chord) -> FloatArray:
    """Versines of an axis in the plane: the distance from point to chord, as stretched string and ruler give it.

    Parameters
    ----------
    easting, northing : (n,) array
        Points at uniform arc length, m.
    step : float
        Distance between points, m.
    chord : Chord

    Returns
    -------
    (n,) array
        m; positive on a curve to the right, NaN where the chord would reach beyond the ends.

    Examples
    --------
    >>> angle = np.arange(0.0, 41.0) / 300.0
    >>> v = versines_in_plan(300 * (1 - np.cos(angle)), 300 * np.sin(angle), 1.0, Chord.symmetric(20.0))
    >>> float(v[20].round(4))
    0.1667
    """
    e, n = np.asarray(easting, float), np.asarray(northing, float)
    behind, ahead = _steps(chord.behind, step), _steps(chord.ahead, step)
    out = np.full(len(e), np.nan)
    count = len(e) - behind - ahead
    if count > 0:
        here, back, front = slice(behind, behind + count), slice(0, count), slice(behind + ahead, len(e))
        de, dn = e[front] - e[back], n[front] - n[back]
        out[here] = ((n[here] - n[back]) * de - (e[here] - e[back]) * dn) / np.hypot(de, dn)
    return out


def restore(versine: ArrayLike, step: float, chord: Chord, band: Band) -> FloatArray:
    """Give back the displacements, band-passed, that made these versines: the inverse transfer, where it exists.

    Parameters
    ----------
    versine : (n,) array
        m, at uniform distances; NaN parts it into stretches.
    step : float
        m.
    chord : Chord
        The chord that measured them.
    band : Band
        Wavelengths wanted; the stated band-pass of `railnav.monitoring.filters` is applied as well.

    Returns
    -------
    (n,) array
        Displacement to the right in the band, m; NaN within the band's settling length and a chord of an end.

    Raises
    ------
    TrackError
        The chord shows less than a tenth of some wave in the band; the message names it.

    References
    ----------
    docs/theory/geometry.md (5).
    """
    from railnav.monitoring.filters import _gain, stretches

    low, _ = chord.seen(band)
    if low < LEAST_GAIN:
        blind = chord.blind(band.lower, band.upper)
        waves = np.geomspace(band.lower, band.upper, 2001)
        worst = blind if len(blind) else waves[[int(np.argmin(np.abs(chord.transfer(waves))))]]
        raise TrackError(
            f"a chord of {chord.behind:g} + {chord.ahead:g} m shows {low:.2f} of waves of "
            f"{', '.join(f'{w:.2f}' for w in worst[:4])} m: {band.name} ({band.lower:g} to {band.upper:g} m) cannot be restored; "
            "choose an asymmetric chord or a narrower band"
        )
    v = np.asarray(versine, float)
    out = np.full(len(v), np.nan)
    margin = round((band.settling + chord.length) / step)
    for a, b in stretches(np.isfinite(v)):
        if b - a > 2 * margin:
            out[a + margin : b - margin] = _restored(v[a:b], step, chord, band, _gain)[margin : b - a - margin]
    return out


def _restored(v: FloatArray, step: float, chord: Chord, band: Band, gain_of: object) -> FloatArray:
    from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

    assert callable(gain_of)
    n = len(v)
    pad = min(n - 1, math.ceil(2.0 * (band.upper + chord.length) / step))
    y = v - v.mean()
    wide = np.concatenate([2.0 * y[0] - y[pad:0:-1], y, 2.0 * y[-1] - y[-2 : -pad - 2 : -1]])
    size = next_fast_len(len(wide) + pad, real=True)
    frequency = rfftfreq(size, step)
    response = gain_of(frequency, band).astype(complex)
    transfer = -chord._transfer(2.0 * np.pi * frequency)
    weak = np.abs(transfer) < LEAST_GAIN  # beyond the band: kept from growing
    response = np.where(weak, response * np.conj(transfer) / LEAST_GAIN**2, response / np.where(weak, 1.0, transfer))
    response[0] = 0.0
    return np.asarray(irfft(rfft(wide, size) * response, size)[pad : pad + n])


def _steps(arm: float, step: float) -> int:
    count = round(arm / step)
    if count < 1 or abs(count * step - arm) > 1e-3 * arm:
        raise TrackError(
            f"a chord's arm of {arm:g} m is no whole number of steps of {step:g} m; resample to a step that divides it"
        )
    return count


@dataclass(frozen=True, slots=True, eq=False)
class HalladeSlews:
    """Slews by the versine method.

    Attributes
    ----------
    slew : (n,) array
        To the right, m, at the versine points; the first and the last are zero up to `closure` and `closure_moment`.
    closure, closure_moment : float
        Sum and first moment of designed minus measured versines, m and m times points: both zero where the ends can stay.
    """

    slew: FloatArray
    closure: float
    closure_moment: float


def hallade(measured: ArrayLike, designed: ArrayLike) -> HalladeSlews:
    """Slews from measured to designed versines by double summation (Hallade).

    Points stand half a chord apart. A slew e_i changes the versines: e[i+1] - 2 e[i] + e[i-1] = 2 (v_designed - v_measured) (versine and
    slew both positive to the right; sources that count the versine as rail minus chord have -2).

    Parameters
    ----------
    measured, designed : (n,) array
        Versines, m, at points half a chord apart; the first and the last point are ends that stay.

    Returns
    -------
    HalladeSlews

    References
    ----------
    O'Dwyer, Proc. ICE Transport 1997; docs/theory/geometry.md (6).

    Examples
    --------
    >>> slews = hallade([0.0, 0.010, 0.030, 0.010, 0.0], [0.0, 0.015, 0.020, 0.015, 0.0])
    >>> slews.slew.round(3), slews.closure
    (array([0.  , 0.  , 0.01, 0.  , 0.  ]), 0.0)
    """
    v_e, v_d = np.asarray(measured, float), np.asarray(designed, float)
    if v_e.shape != v_d.shape or v_e.ndim != 1 or len(v_e) < 3:
        raise TrackError(
            f"{v_e.shape} measured and {v_d.shape} designed versines; two rows of equal length, at least 3, are needed"
        )
    change = v_d - v_e
    if not np.isfinite(change).all():
        raise TrackError(
            f"versine {int(np.argmin(np.isfinite(change)))} is not finite; cut the ends and gaps off first"
        )
    slew = np.concatenate([[0.0], 2.0 * np.cumsum(np.cumsum(change[:-1]))])
    moment = float(np.arange(len(change)) @ change)
    closure = float(change.sum())
    return HalladeSlews(slew, round(closure, 15), moment)


def closed_versines(measured: ArrayLike, designed: ArrayLike) -> FloatArray:
    """Designed versines whose first and last value are changed so that both closure sums vanish and the ends stay.

    Parameters
    ----------
    measured, designed : (n,) array
        As in `hallade`.

    Returns
    -------
    (n,) array

    Examples
    --------
    >>> v_e = np.array([0.0, 0.010, 0.030, 0.010, 0.0])
    >>> v_d = closed_versines(v_e, [0.0, 0.016, 0.016, 0.016, 0.0])
    >>> v_d.round(3), hallade(v_e, v_d).slew.round(3)
    (array([0.001, 0.016, 0.016, 0.016, 0.001]), array([0.   , 0.002, 0.016, 0.002, 0.   ]))
    """
    v_e, v_d = np.asarray(measured, float), np.array(designed, float)
    change = v_d - v_e
    last = -float(np.arange(len(change)) @ change) / (len(change) - 1)
    v_d[0] += -float(change.sum()) - last
    v_d[-1] += last
    return v_d


def slews_by_versines(deviation: ArrayLike, cutoff: float) -> FloatArray:
    """Slews of the versine method along a base line: to it, or to a smoothed course beside it.

    The versines of the deviation are those measured less those of the base line. To reach the base line they are brought to zero;
    otherwise they are smoothed (Whittaker), so that curves of the base line stay curves however sharp they are. Both ends stay.

    Parameters
    ----------
    deviation : (n,) array
        Of the track to the right of the base line, m, at points half a chord apart.
    cutoff : float
        Wave that smoothing halves, in half chords; NaN to reach the base line.

    Returns
    -------
    (n,) array
        To the right, m; empty where fewer than 8 points or a cut-off of less than two half chords leave nothing to smooth.

    Examples
    --------
    >>> bump = 0.01 * np.exp(-(((np.arange(21) - 10.0) / 3.0) ** 2))
    >>> bool(np.abs(bump + slews_by_versines(bump, float("nan"))).max() < 1e-6)
    True
    """
    from railnav.monitoring.smoothing import whittaker

    y = np.asarray(deviation, float)
    if len(y) < 8 or cutoff <= 2.0:
        return np.empty(0)
    own = np.zeros(len(y))
    own[1:-1] = 0.5 * (y[:-2] + y[2:]) - y[1:-1]
    aim = np.zeros(len(y)) if math.isnan(cutoff) else whittaker(own, 1.0, cutoff)
    return hallade(own, closed_versines(own, aim)).slew
