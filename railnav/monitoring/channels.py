"""Track geometry channels: longitudinal level and alignment of the axis and of each rail, cross level, gauge, twist, curvature.

Names and signs: longitudinal level is the height of the track above its smoothed course, positive upwards; alignment its distance to the
right; cross level positive with the left rail high; twist the growth of cross level over a base; gauge as measured. All as
distance along the section grows. Metres and radians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError
from railnav.monitoring.channel import SAMPLES_A_WAVE, Channel
from railnav.monitoring.filters import (
    D0,
    D1,
    D2,
    D3_ALIGNMENT,
    D3_LEVEL,
    Band,
    band_noise,
    band_pass,
    low_pass,
)
from railnav.monitoring.rails import rail_channels
from railnav.monitoring.recording import Recording, Series
from railnav.monitoring.versines import Chord

FloatArray = NDArray[np.float64]

#: Twist bases used by default, m.
TWIST_BASES = (3.0, 9.0)
#: Shortest wavelength that is asked of GNSS positions, m.
SHORTEST_GNSS = 200.0


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """The channels of one run on one section.

    Attributes
    ----------
    recording : Recording
    channels : dict of str to Channel
    refused : dict of str to str
        Channels that the run cannot give, and why.
    distance : (n,) array
        Along the section, m; for an overlaid run the corrected one.
    """

    recording: Recording
    channels: dict[str, Channel]
    refused: dict[str, str]

    @property
    def distance(self) -> FloatArray:
        """Grid along the section, m."""
        return self.recording.distance


def twist(cross_level: ArrayLike, step: float, base: float) -> FloatArray:
    """Twist: growth of cross level over a base, centred, as a gradient.

    t(s) = [c(s + l/2) - c(s - l/2)] / l: no shift along the track. A linear cant ramp of 1 in n shows as 1/n.

    Parameters
    ----------
    cross_level : (n,) array
        m.
    step, base : float
        m; between samples linear.

    Returns
    -------
    (n,) array
        m/m; NaN where the base reaches beyond the ends.

    References
    ----------
    docs/theory/geometry.md (8).

    Examples
    --------
    >>> twist(np.arange(0.0, 0.021, 0.001), 1.0, 3.0)[10].round(6)
    np.float64(0.001)
    """
    c = np.asarray(cross_level, float)
    if not 0.0 < base <= step * len(c) or base < 2.0 * step:
        raise TrackError(f"a twist base of {base} m does not fit a channel of {len(c)} samples at {step} m")
    half = 0.5 * base / step
    index = np.arange(len(c), dtype=float)
    ahead, behind = (_between(c, index + half), _between(c, index - half))
    return np.asarray((ahead - behind) / base)


def _between(values: FloatArray, index: FloatArray) -> FloatArray:
    low = np.floor(index).astype(np.int64)
    share = index - low
    inside = (low >= 0) & (low + (share > 1e-9) < len(values))
    i = np.clip(low, 0, len(values) - 1)
    j = np.clip(low + 1, 0, len(values) - 1)
    out = np.where(share > 1e-9, (1.0 - share) * values[i] + share * values[j], values[i])
    return np.where(inside, out, np.nan)


def twist_gain(wavelength: ArrayLike, base: float) -> FloatArray:
    """Growth over the base that a wave of cross level of unit amplitude shows, |2 sin(pi l / L)|: 0 where the base holds whole waves."""
    return np.abs(2.0 * np.sin(np.pi * base / np.asarray(wavelength, float)))


def channels_of(
    recording: Recording, *, bases: Sequence[float] = TWIST_BASES, chords: Sequence[Chord] = ()
) -> Geometry:
    """Work out every channel that a run's streams support, and say why not for the others.

    Parameters
    ----------
    recording : Recording
    bases : sequence of float
        Twist bases, m.
    chords : sequence of Chord
        Chords to give versines of alignment for.

    Returns
    -------
    Geometry
        A band is refused where samples lie too far apart for its shortest wave (three samples a wave).

    Notes
    -----
    100 km at 0.25 m take about 2 s.
    """
    step, series = recording.step, recording.series
    channels: dict[str, Channel] = {}
    refused: dict[str, str] = {}

    def add(
        key: str, title: str, unit: str, values: FloatArray, sigma: float, of: Series, band: Band | None = None
    ) -> None:
        channels[key] = Channel(key, title, unit, values, sigma, of.source, band, of.spacing)

    if "gauge" in series:
        gauge = series["gauge"]
        add("gauge", "Gauge", "m", gauge.values, gauge.noise, gauge)
    else:
        refused["gauge"] = recording.refused.get("gauge", "the run has no gauge stream")
    _cross_level(recording, bases, channels, refused)
    _bands(recording, channels, refused)
    rails, without = rail_channels(recording, channels)
    channels |= rails
    refused |= without
    if "curvature_full" in series:
        curve = series["curvature_full"]
        smooth = low_pass(curve.values, step, 25.0)
        add(
            "curvature",
            "Curvature, waves over 25 m",
            "1/m",
            smooth,
            curve.noise * math.sqrt(2.0 * curve.spacing / 25.0),
            curve,
        )
    elif "bearing" in series and series["bearing"].spacing <= 25.0:
        bearing = series["bearing"]
        values = low_pass(bearing.values, step, 25.0)
        curvature = np.gradient(values, step)
        if recording.against_model:
            curvature = curvature + recording.points.curvature
        noise = bearing.noise * math.sqrt(2.0 * bearing.spacing / 25.0) * 2.0 * math.pi / 25.0
        add("curvature", "Curvature, waves over 25 m", "1/m", curvature, noise, bearing)
    else:
        refused["curvature"] = "the run has neither an IMU nor gyro angles, or samples them more than 25 m apart"
    _gnss(recording, channels, refused)
    geometry = Geometry(recording, channels, refused)
    for chord in chords:
        _versines(geometry, chord)
    return geometry


def chord_key(chord: Chord) -> str:
    """Key of the channel of versines on a chord: versine_10+10m.

    Examples
    --------
    >>> chord_key(Chord(4.1, 17.4))
    'versine_4.1+17.4m'
    """
    return f"versine_{chord.behind:g}+{chord.ahead:g}m"


def _versines(geometry: Geometry, chord: Chord) -> None:
    """Versines of alignment on a chord, or why there are none."""
    key, step = chord_key(chord), geometry.recording.step
    parts = [geometry.channels.get(f"alignment_{band}") for band in ("d1", "d2", "d3")]
    known = [part for part in parts if part is not None]
    if len(known) < len(parts):
        geometry.refused[key] = "versines take alignment in D1, D2 and D3: " + next(
            geometry.refused[f"alignment_{band}"]
            for band in ("d1", "d2", "d3")
            if f"alignment_{band}" in geometry.refused
        )
        return
    if any(abs(arm / step - round(arm / step)) > 1e-3 or arm < step for arm in (chord.behind, chord.ahead)):
        geometry.refused[key] = (
            f"arms of {chord.behind:g} and {chord.ahead:g} m are no whole numbers of steps of {step:g} m"
        )
        return
    values = versine_channel(geometry, chord)
    # of each band, the chord shows at most the greatest share of its waves
    sigma = math.hypot(*(part.sigma * chord.seen(part.band)[1] for part in known if part.band is not None))
    title = f"Versine of alignment on {chord.behind:g} + {chord.ahead:g} m"
    geometry.channels[key] = Channel(key, title, "m", values, sigma, known[0].source, None, known[0].spacing)


def _cross_level(
    recording: Recording, bases: Sequence[float], channels: dict[str, Channel], refused: dict[str, str]
) -> None:
    if "cross_level" not in recording.series:
        for key in ("cross_level", *(twist_key(base) for base in bases)):
            refused[key] = "the run has neither cant in a gauge stream nor gyro angles"
        return
    of = recording.series["cross_level"]
    channels["cross_level"] = Channel(
        "cross_level", "Cross level", "m", of.values, of.noise, of.source, None, of.spacing
    )
    if recording.against_model:
        cant = recording.points.cant
        channels["cross_level_deviation"] = Channel(
            "cross_level_deviation",
            "Cross level minus the model's cant",
            "m",
            of.values - cant,
            of.noise,
            of.source,
            None,
            of.spacing,
        )
    for base in bases:
        key = twist_key(base)
        if not of.spacing <= base / 2.0:
            refused[key] = (
                f"cross level was sampled each {of.spacing:.1f} m; a base of {base:g} m takes {base / 2.0:g} m"
            )
        elif base > recording.distance[-1] or base < 2.0 * recording.step:
            refused[key] = f"a base of {base:g} m does not fit the section at steps of {recording.step:g} m"
        else:
            values = twist(of.values, recording.step, base)
            sigma = math.sqrt(2.0) * of.noise / base
            channels[key] = Channel(key, f"Twist on {base:g} m", "m/m", values, sigma, of.source, None, of.spacing)


def twist_key(base: float) -> str:
    """Key of the twist channel on a base, m: twist_3m, twist_2.5m."""
    return f"twist_{base:g}m"


#: The banded channels: key, title, series in the order preferred with how often to integrate and the sign, bands.
_BANDED: tuple[tuple[str, str, tuple[tuple[str, int], ...], tuple[Band, ...]], ...] = (
    ("longitudinal_level", "Longitudinal level", (("slope", 1), ("pitch_rate", 2)), (D0, D1, D2, D3_LEVEL)),
    ("alignment", "Alignment", (("bearing", 1), ("curvature", 2)), (D1, D2, D3_ALIGNMENT)),
)


def _bands(recording: Recording, channels: dict[str, Channel], refused: dict[str, str]) -> None:
    """Longitudinal level and alignment of the axis in their bands, each from the series that leaves least noise."""
    for name, title, sources, bands in _BANDED:
        present = [(recording.series[key], times) for key, times in sources if key in recording.series]
        for band in bands:
            key = f"{name}_{band.name.lower()}"
            fine = [(of, times) for of, times in present if of.spacing <= band.lower / SAMPLES_A_WAVE]
            if not present:
                refused[key] = "the run has neither gyro angles nor an IMU" + _gnss_instead(recording, name, band)
                continue
            if not fine:
                best = min(of.spacing for of, _ in present)
                refused[key] = (
                    f"sampled each {best:.2g} m; {band.name}, waves from {band.lower:g} m, takes {band.lower / SAMPLES_A_WAVE:.2g} m"
                )
                continue
            if recording.step > band.lower / SAMPLES_A_WAVE:
                enough = f"{band.lower / SAMPLES_A_WAVE:.2g} m"
                refused[key] = (
                    f"{band.name}, waves from {band.lower:g} m, takes steps of {enough}, not of {recording.step:g} m"
                )
                continue
            of, times = min(fine, key=lambda pair: band_noise(pair[0].noise, pair[0].spacing, band, integrate=pair[1]))
            values = band_pass(of.values, recording.step, band, integrate=times)
            if not np.isfinite(values).any():
                refused[key] = f"no stretch without a gap is longer than {2 * band.settling:g} m"
                continue
            white = band_noise(of.noise, of.spacing, band, integrate=times)
            misplaced = _misplaced(recording, name, band)
            steady = math.hypot(white, _slope(values, recording.step) * recording.passage.sigma)
            mean_square = (
                float(np.mean(misplaced[np.isfinite(misplaced)] ** 2)) if np.isfinite(misplaced).any() else 0.0
            )
            channels[key] = Channel(
                key,
                f"{title} {band.name}",
                "m",
                values,
                math.sqrt(steady**2 + mean_square),
                of.source,
                band,
                of.spacing,
                np.hypot(steady, misplaced),
            )


def _slope(values: FloatArray, step: float) -> float:
    """Root mean square slope of a channel: what an error of place along the track makes of its values."""
    slope = np.diff(values) / step
    known = slope[np.isfinite(slope)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else 0.0


def _gnss_instead(recording: Recording, name: str, band: Band) -> str:
    """What GNSS positions alone would leave in a band."""
    of = recording.series.get("plan_gnss" if name == "alignment" else "height_gnss")
    if of is None or not math.isfinite(of.spacing):
        return ""
    if of.spacing > band.lower / SAMPLES_A_WAVE:
        return f"; its GNSS positions lie {of.spacing:.0f} m apart, too far for waves of {band.lower:g} m"
    noise = band_noise(of.noise, of.spacing, band)
    return f"; its GNSS positions would leave {1e3 * noise:,.0f} mm of noise in {band.name}"


def _misplaced(recording: Recording, name: str, band: Band) -> FloatArray:
    """What an error of place along the track leaves in a band when the model's shape is taken off: its bearing there, times the error.

    Greatest within half a longest wave, since a curve that begins elsewhere shows all around its beginning.
    """
    from scipy.ndimage import maximum_filter1d

    if not recording.against_model:
        return np.zeros(len(recording.distance))
    point = recording.points
    bend = point.curvature if name == "alignment" else np.gradient(np.arctan(point.gradient), recording.step)
    shape = band_pass(np.where(np.isfinite(bend), bend, 0.0), recording.step, band, integrate=1)
    reach = 2 * round(0.25 * band.upper / recording.step) + 1
    largest = maximum_filter1d(np.where(np.isfinite(shape), np.abs(shape), 0.0), reach)
    return np.asarray(largest * recording.passage.sigma)


def _gnss(recording: Recording, channels: dict[str, Channel], refused: dict[str, str]) -> None:
    """Long-wave deviations from the model: what GNSS positions alone can say."""
    for key, title, name in (
        ("plan_deviation", "Distance from the model to the right", "plan_gnss"),
        ("height_deviation", "Height above the model", "height_gnss"),
    ):
        of = recording.series.get(name)
        if of is None:
            refused[key] = (
                "no GNSS positions on the section"
                if name == "plan_gnss"
                else "no GNSS heights, or a model without heights"
            )
            continue
        shortest = max(SHORTEST_GNSS, 10.0 * of.spacing)
        values = low_pass(of.values, recording.step, shortest)
        # slow receiver errors do not average out over a wave: the scatter of the smoothed deviation itself bounds what it can show
        known = values[np.isfinite(values)]
        scatter = float(1.4826 * np.median(np.abs(known - np.median(known)))) if len(known) else math.nan
        white = of.noise * math.sqrt(2.0 * of.spacing / shortest)
        channels[key] = Channel(
            key,
            f"{title}, waves over {shortest:.0f} m",
            "m",
            values,
            max(scatter, white),
            of.source,
            None,
            of.spacing,
        )


def versine_channel(geometry: Geometry, chord: Chord, name: str = "alignment") -> FloatArray:
    """Versines that a chord would show of alignment (or longitudinal level) in D1 to D3, worked out from the inertial channels.

    Parameters
    ----------
    geometry : Geometry
    chord : Chord
        Arms that are whole numbers of steps.
    name : str
        "alignment" or "longitudinal_level".

    Returns
    -------
    (n,) array
        m; of the deviations alone, the design's own versines not included.
    """
    from railnav.monitoring.versines import versines

    parts = [
        geometry.channels[f"{name}_{band}"].values
        for band in ("d1", "d2", "d3")
        if f"{name}_{band}" in geometry.channels
    ]
    if not parts:
        raise TrackError(f"the run gives no {name} channel to take versines of")
    return versines(np.sum(parts, axis=0), geometry.recording.step, chord)
