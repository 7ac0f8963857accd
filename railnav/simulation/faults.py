"""Faults by name, done to a run that was sound: what goes wrong with sensors and clocks.

Models gone stale are faults, too: see `railnav.simulation.stale_models`.

Each fault says what the navigator owes to it. Nobody owes a good position when the sensors lie; everybody owes an error inside the
stated bound, and never to be sure of a wrong track.

`expected` is the least that is owed:

unharmed
    The fault is small, rare or seen through: errors stay as they were (within a factor of two).
covered
    Errors may grow, and the protection level holds them.
flagged
    The navigator says so: it coasts, is ambiguous, off the model or lost at some time during the fault or in the minute after it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError
from railnav.geodesy.ellipsoid import WGS84
from railnav.run import BaliseStream, GnssStream, ImuStream, OdometerStream, Run
from railnav.units import wrap_angle

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Fault:
    """One way in which things go wrong.

    Attributes
    ----------
    name : str
    words : str
        What happens, in one line.
    subject : str
        The stream concerned: "gnss", "odometer", "imu" or "balise"; or "model".
    expected : str
        What the navigator owes: "unharmed", "covered" or "flagged".
    duration : float
        How long it lasts, s; infinite where it does not end.
    whole_run : bool
        Whether it is there from the first epoch on.
    """

    name: str
    words: str
    subject: str
    expected: str
    duration: float = 30.0
    whole_run: bool = False


#: Does the deed: the run, which epochs of the subject's stream are concerned, seconds since the onset, and a generator.
_Deed = Callable[[Any, BoolArray, FloatArray, np.random.Generator], Any]


def _moved(gnss: GnssStream, east: FloatArray, north: FloatArray) -> GnssStream:
    """Fixes displaced by metres."""
    up = np.nan_to_num(gnss.height) if gnss.height is not None else np.zeros(len(gnss))
    return replace(
        gnss,
        latitude=gnss.latitude + north / (WGS84.meridian_radius(gnss.latitude) + up),
        longitude=gnss.longitude + east / ((WGS84.transverse_radius(gnss.latitude) + up) * np.cos(gnss.latitude)),
    )


def _ahead(gnss: GnssStream) -> tuple[FloatArray, FloatArray]:
    """East and north of the direction of motion; while standing, of the last one known."""
    step_n = np.gradient(gnss.latitude) * WGS84.semi_major_axis
    step_e = np.gradient(gnss.longitude) * WGS84.semi_major_axis * np.cos(gnss.latitude)
    smooth = np.ones(9) / 9.0
    if len(gnss) >= 9:
        step_n, step_e = np.convolve(step_n, smooth, "same"), np.convolve(step_e, smooth, "same")
    bearing = np.arctan2(step_e, step_n)
    if gnss.course is not None:
        bearing = np.where(np.isfinite(gnss.course), gnss.course, bearing)
    return np.sin(bearing), np.cos(bearing)


def _displaced(
    along: Callable[[FloatArray], FloatArray] | None, across: Callable[[FloatArray], FloatArray] | None
) -> _Deed:
    """A deed that displaces fixes along and to the right of the motion by metres that depend on the time since onset."""

    def deed(gnss: GnssStream, during: BoolArray, since: FloatArray, _: np.random.Generator) -> GnssStream:
        east, north = _ahead(gnss)
        a = np.where(during, along(since), 0.0) if along else np.zeros(len(gnss))
        c = np.where(during, across(since), 0.0) if across else np.zeros(len(gnss))
        return _moved(gnss, a * east + c * north, a * north - c * east)

    return deed


def _offset(east: float, north: float) -> _Deed:
    """A deed that displaces fixes by constant metres."""

    def deed(gnss: GnssStream, during: BoolArray, _: FloatArray, __: np.random.Generator) -> GnssStream:
        return _moved(gnss, np.where(during, east, 0.0), np.where(during, north, 0.0))

    return deed


def _constant(size: float) -> Callable[[FloatArray], FloatArray]:
    return lambda since: np.full(len(since), size)


def _ramp(rate: float) -> Callable[[FloatArray], FloatArray]:
    return lambda since: rate * since


def _wave(size: float, period: float) -> Callable[[FloatArray], FloatArray]:
    return lambda since: size * np.sin(2.0 * np.pi * since / period)


def _scattered(sigma: float, *, share: float = 1.0) -> _Deed:
    """A deed that scatters fixes whose stated sigma says nothing of it."""

    def deed(gnss: GnssStream, during: BoolArray, _: FloatArray, random: np.random.Generator) -> GnssStream:
        hit = during & (random.random(len(gnss)) < share)
        return _moved(gnss, *(np.where(hit, random.standard_normal(len(gnss)) * sigma, 0.0) for _ in range(2)))

    return deed


def _one_outlier(gnss: GnssStream, during: BoolArray, _: FloatArray, __: np.random.Generator) -> GnssStream:
    first = np.arange(len(gnss)) == np.argmax(during)
    return _moved(gnss, np.where(first, 350.0, 0.0), np.where(first, -350.0, 0.0))


def _frozen_fixes(*, speed_too: bool) -> _Deed:
    def deed(gnss: GnssStream, during: BoolArray, _: FloatArray, __: np.random.Generator) -> GnssStream:
        held = np.where(during, np.argmax(during), np.arange(len(gnss)))
        frozen = replace(gnss, latitude=gnss.latitude[held], longitude=gnss.longitude[held])
        return _rows_of(frozen, held, ("speed", "course")) if speed_too else frozen

    return deed


def _rows_of(stream: GnssStream, rows: NDArray[np.int64], names: tuple[str, ...]) -> GnssStream:
    return replace(stream, **{n: getattr(stream, n)[rows] for n in names if getattr(stream, n) is not None})


def _replayed(ago: float) -> _Deed:
    """A deed that repeats what was received some time ago."""

    def deed(gnss: GnssStream, during: BoolArray, _: FloatArray, __: np.random.Generator) -> GnssStream:
        rows = np.arange(len(gnss))
        rows[during] = np.searchsorted(gnss.time, gnss.time[during] - ago).clip(0, len(gnss) - 1)
        return _rows_of(gnss, rows, ("latitude", "longitude", "height", "speed", "course"))

    return deed


def _stamped_late(by: float) -> _Deed:
    """A deed that stamps a stream late (negative: early) while it lasts; rows that would run backwards are left out."""

    def deed(stream: Any, during: BoolArray, _: FloatArray, __: np.random.Generator) -> Any:
        time = np.where(during, stream.time + by, stream.time)
        order = np.argsort(time, kind="stable")
        keep = order[np.diff(time[order], prepend=-np.inf) > 1e-6]
        kept = _kept(stream, keep)
        return replace(kept, time=time[keep])

    return deed


def _kept(stream: Any, rows: Any) -> Any:
    """Rows of a stream, all its columns."""
    count = len(stream.time)
    columns = {
        name: value[rows]
        for name in stream.__slots__
        if isinstance(value := getattr(stream, name), np.ndarray) and value.ndim and len(value) == count
    }
    if isinstance(stream, BaliseStream):
        columns["id"] = tuple(np.array(stream.id, object)[rows].tolist())
    return replace(stream, **columns)


def _silent(share: float = 1.0) -> _Deed:
    def deed(stream: Any, during: BoolArray, _: FloatArray, random: np.random.Generator) -> Any:
        return _kept(stream, np.flatnonzero(~(during & (random.random(len(stream.time)) < share))))

    return deed


def _stated(factor: float) -> _Deed:
    def deed(gnss: GnssStream, during: BoolArray, _: FloatArray, __: np.random.Generator) -> GnssStream:
        scale = np.where(during, factor, 1.0)
        named = ("sigma_east", "sigma_north", "sigma_up")
        return replace(gnss, **{n: getattr(gnss, n) * scale for n in named if getattr(gnss, n) is not None})

    return deed


def _no_sigmas(gnss: GnssStream, _: BoolArray, __: FloatArray, ___: np.random.Generator) -> GnssStream:
    return replace(gnss, sigma_east=None, sigma_north=None, sigma_up=None, sigma_speed=None)


def _speed(change: Callable[[FloatArray, np.random.Generator], FloatArray]) -> _Deed:
    def deed(gnss: GnssStream, during: BoolArray, _: FloatArray, random: np.random.Generator) -> GnssStream:
        if gnss.speed is None:
            return gnss
        return replace(gnss, speed=np.where(during, np.maximum(change(gnss.speed, random), 0.0), gnss.speed))

    return deed


def _course_reversed(gnss: GnssStream, during: BoolArray, _: FloatArray, __: np.random.Generator) -> GnssStream:
    if gnss.course is None:
        return gnss
    return replace(gnss, course=np.where(during, np.mod(wrap_angle(gnss.course + np.pi), 2.0 * np.pi), gnss.course))


def _wheel(factor: float) -> _Deed:
    """A deed that makes the wheel turn by a factor too much while it lasts."""

    def deed(odometer: OdometerStream, during: BoolArray, _: FloatArray, __: np.random.Generator) -> OdometerStream:
        speed = odometer.speed
        if odometer.distance is None:
            return odometer if speed is None else replace(odometer, speed=np.where(during, speed * factor, speed))
        step = np.diff(odometer.distance, prepend=odometer.distance[:1])
        return replace(odometer, distance=odometer.distance[0] + np.cumsum(np.where(during, step * factor, step)))

    return deed


def _wheel_added(size: float) -> _Deed:
    def deed(odometer: OdometerStream, during: BoolArray, _: FloatArray, __: np.random.Generator) -> OdometerStream:
        if odometer.distance is None:
            return odometer
        after = np.arange(len(odometer)) >= np.argmax(during)
        return replace(odometer, distance=odometer.distance + np.where(after, size, 0.0))

    return deed


def _wheel_reset(odometer: OdometerStream, during: BoolArray, _: FloatArray, __: np.random.Generator) -> OdometerStream:
    if odometer.distance is None:
        return odometer
    first = int(np.argmax(during))
    return replace(
        odometer,
        distance=odometer.distance - np.where(np.arange(len(odometer)) >= first, odometer.distance[first], 0.0),
    )


def _inertial(
    which: str, change: Callable[[FloatArray, np.random.Generator], FloatArray], *, axes: tuple[int, ...] = (0, 1, 2)
) -> _Deed:
    """A deed on some axes of the gyros ("gyro") or accelerometers ("specific_force")."""

    def deed(imu: ImuStream, during: BoolArray, _: FloatArray, random: np.random.Generator) -> ImuStream:
        value = getattr(imu, which).copy()
        for axis in axes:
            value[during, axis] = change(value[during, axis], random)
        return replace(imu, **{which: value})

    return deed


def _other_names(balise: BaliseStream, during: BoolArray, _: FloatArray, __: np.random.Generator) -> BaliseStream:
    """Each balise read under the name of the next one of the run."""
    names = (*balise.id[1:], balise.id[-1]) if balise.id else ()
    return replace(balise, id=tuple(b if hit else a for a, b, hit in zip(balise.id, names, during, strict=True)))


def _held(x: FloatArray, _: np.random.Generator) -> FloatArray:
    return np.full(len(x), x[0] if len(x) else 0.0)


def _plus(size: float) -> Callable[[FloatArray, np.random.Generator], FloatArray]:
    return lambda x, _: x + size


def _clipped(limit: float) -> Callable[[FloatArray, np.random.Generator], FloatArray]:
    return lambda x, _: np.clip(x, -limit, limit)


def _noisy(sigma: float) -> Callable[[FloatArray, np.random.Generator], FloatArray]:
    return lambda x, random: x + random.standard_normal(len(x)) * sigma


def _mounted_aslant(imu: ImuStream, _: BoolArray, __: FloatArray, ___: np.random.Generator) -> ImuStream:
    angle = np.deg2rad(5.0)
    turn = np.array([[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return replace(imu, gyro=imu.gyro @ turn.T, specific_force=imu.specific_force @ turn.T)


_D = np.pi / 180.0
_FOREVER = float("inf")

#: Every fault of a sensor, with the deed.
# fmt: off
_SENSOR_FAULTS: tuple[tuple[Fault, _Deed], ...] = (
    (Fault("gnss-step-along-30m", "fixes 30 m ahead for 30 s", "gnss", "covered"), _displaced(_constant(30.0), None)),
    (Fault("gnss-step-along-100m", "fixes 100 m behind for 30 s", "gnss", "covered"), _displaced(_constant(-100.0), None)),
    (Fault("gnss-step-left-4m", "fixes aside by the distance of the next track for 60 s", "gnss", "covered", 60.0),
     _displaced(None, _constant(-4.0))),
    (Fault("gnss-step-right-4m", "fixes aside, away from the next track, for 60 s", "gnss", "covered", 60.0),
     _displaced(None, _constant(4.0))),
    (Fault("gnss-step-left-10m", "fixes 10 m to the left for 30 s", "gnss", "covered"), _displaced(None, _constant(-10.0))),
    (Fault("gnss-step-left-50m", "fixes 50 m to the left for 30 s", "gnss", "unharmed"), _displaced(None, _constant(-50.0))),
    (Fault("gnss-ramp-along-0.1", "fixes creep ahead by 0.1 m/s for 200 s", "gnss", "covered", 200.0), _displaced(_ramp(0.1), None)),
    (Fault("gnss-ramp-along-0.5", "fixes creep ahead by 0.5 m/s for 100 s", "gnss", "covered", 100.0), _displaced(_ramp(0.5), None)),
    (Fault("gnss-ramp-along-2", "fixes run behind by 2 m/s for 60 s", "gnss", "covered", 60.0), _displaced(_ramp(-2.0), None)),
    (Fault("gnss-ramp-left-0.1", "fixes creep to the left by 0.1 m/s for 100 s", "gnss", "covered", 100.0),
     _displaced(None, _ramp(-0.1))),
    (Fault("gnss-ramp-left-0.5", "fixes creep to the left by 0.5 m/s for 60 s", "gnss", "covered", 60.0), _displaced(None, _ramp(-0.5))),
    (Fault("gnss-ramp-right-2", "fixes run to the right by 2 m/s for 30 s", "gnss", "covered"), _displaced(None, _ramp(2.0))),
    (Fault("gnss-wave-8m", "fixes sway aside by 8 m, period 60 s, as beside a reflecting wall", "gnss", "covered", 120.0),
     _displaced(None, _wave(8.0, 60.0))),
    (Fault("gnss-wave-along-8m", "fixes sway along by 8 m, period 40 s", "gnss", "covered", 120.0), _displaced(_wave(8.0, 40.0), None)),
    (Fault("gnss-burst-10m", "30 s of 10 m scatter under unchanged sigmas", "gnss", "covered"), _scattered(10.0)),
    (Fault("gnss-burst-50m", "30 s of 50 m scatter under unchanged sigmas", "gnss", "covered"), _scattered(50.0)),
    (Fault("gnss-burst-200m", "30 s of 200 m scatter under unchanged sigmas", "gnss", "unharmed"), _scattered(200.0)),
    (Fault("gnss-outlier-500m", "one fix is 500 m off", "gnss", "unharmed"), _one_outlier),
    (Fault("gnss-outliers-10-percent", "one fix in ten is some 30 m off", "gnss", "unharmed", 200.0), _scattered(30.0, share=0.1)),
    (Fault("gnss-outliers-30-percent", "three fixes in ten are some 30 m off", "gnss", "covered", 100.0), _scattered(30.0, share=0.3)),
    (Fault("gnss-frozen-10s", "position and speed stay for 10 s", "gnss", "covered", 10.0), _frozen_fixes(speed_too=True)),
    (Fault("gnss-frozen-60s", "position and speed stay for a minute", "gnss", "covered", 60.0), _frozen_fixes(speed_too=True)),
    (Fault("gnss-frozen-position", "the position stays for 30 s, the speed lives", "gnss", "covered"), _frozen_fixes(speed_too=False)),
    (Fault("gnss-replay-60s", "for 30 s the receiver repeats what it saw a minute ago", "gnss", "covered"), _replayed(60.0)),
    (Fault("gnss-replay-10s", "for 60 s the receiver repeats what it saw 10 s ago", "gnss", "covered", 60.0), _replayed(10.0)),
    (Fault("gnss-late-1s", "stamps 1 s late, from then on", "gnss", "covered", _FOREVER), _stamped_late(1.0)),
    (Fault("gnss-late-0.3s", "stamps 0.3 s late for 60 s", "gnss", "covered", 60.0), _stamped_late(0.3)),
    (Fault("gnss-early-2s", "stamps 2 s early for 30 s", "gnss", "covered"), _stamped_late(-2.0)),
    (Fault("gnss-silent-60s", "no fixes for a minute", "gnss", "flagged", 60.0), _silent()),
    (Fault("gnss-silent-for-good", "no fixes any more", "gnss", "flagged", _FOREVER), _silent()),
    (Fault("gnss-every-second", "half of the fixes are missing", "gnss", "unharmed", 120.0), _silent(0.5)),
    (Fault("gnss-sigma-third", "stated sigmas are a third of the truth", "gnss", "covered", _FOREVER, whole_run=True), _stated(1 / 3)),
    (Fault("gnss-sigma-treble", "stated sigmas are three times the truth", "gnss", "covered", _FOREVER, whole_run=True), _stated(3.0)),
    (Fault("gnss-no-sigma", "the receiver states no sigmas", "gnss", "covered", _FOREVER, whole_run=True), _no_sigmas),
    (Fault("gnss-frame-9m-south", "all fixes 9 m south", "gnss", "covered", _FOREVER, whole_run=True), _offset(0.0, -9.0)),
    (Fault("gnss-frame-2m-east", "all fixes 2 m east", "gnss", "covered", _FOREVER, whole_run=True), _offset(2.0, 0.0)),
    (Fault("gnss-speed-zero", "the receiver says standstill while the train runs", "gnss", "covered"), _speed(lambda v, _: 0.0 * v)),
    (Fault("gnss-speed-1-too-high", "speed 1 m/s too high", "gnss", "covered", 60.0), _speed(lambda v, _: v + 1.0)),
    (Fault("gnss-speed-noise", "speed scatters by 3 m/s under unchanged sigmas", "gnss", "covered"), _speed(_noisy(3.0))),
    (Fault("gnss-course-reversed", "the course points backwards", "gnss", "covered"), _course_reversed),
    (Fault("gnss-elsewhere", "for 30 s all fixes are 1 km away", "gnss", "covered"), _displaced(None, _constant(1000.0))),
    (Fault("odometer-slip-10s", "the wheel runs 30 % ahead for 10 s", "odometer", "unharmed", 10.0), _wheel(1.3)),
    (Fault("odometer-slip-60s", "the wheel runs 10 % ahead for a minute", "odometer", "covered", 60.0), _wheel(1.1)),
    (Fault("odometer-slide-10s", "the wheel turns at 40 % for 10 s", "odometer", "unharmed", 10.0), _wheel(0.4)),
    (Fault("odometer-locked-15s", "the wheel stands while the train runs", "odometer", "covered", 15.0), _wheel(0.0)),
    (Fault("odometer-dead", "the wheel reads no further", "odometer", "covered", _FOREVER), _wheel(0.0)),
    (Fault("odometer-scale-5-percent", "another wheel: 5 % more, from then on", "odometer", "covered", _FOREVER), _wheel(1.05)),
    (Fault("odometer-scale-wrong", "the wheel's diameter is wrong by 3 %", "odometer", "covered", _FOREVER, whole_run=True),
     _wheel(0.97)),
    (Fault("odometer-jump-100m", "the reading jumps by 100 m", "odometer", "unharmed"), _wheel_added(100.0)),
    (Fault("odometer-reset", "the counter starts from zero", "odometer", "covered"), _wheel_reset),
    (Fault("odometer-silent-60s", "no readings for a minute", "odometer", "unharmed", 60.0), _silent()),
    (Fault("odometer-late-0.5s", "stamps 0.5 s late", "odometer", "covered", 60.0), _stamped_late(0.5)),
    (Fault("gyro-bias-step", "the yaw gyro's bias steps by 0.5 degree/s", "imu", "covered", _FOREVER),
     _inertial("gyro", _plus(0.5 * _D), axes=(2,))),
    (Fault("gyro-frozen-30s", "the yaw gyro repeats one value", "imu", "covered"), _inertial("gyro", _held, axes=(2,))),
    (Fault("gyro-saturated", "gyros end at 0.5 degree/s", "imu", "covered", _FOREVER, whole_run=True),
     _inertial("gyro", _clipped(0.5 * _D))),
    (Fault("gyro-reversed", "the yaw gyro counts the other way", "imu", "covered", _FOREVER, whole_run=True),
     _inertial("gyro", lambda x, _: -x, axes=(2,))),
    (Fault("gyro-noise", "the gyros scatter by 2 degree/s", "imu", "covered", 60.0), _inertial("gyro", _noisy(2.0 * _D))),
    (Fault("accelerometer-bias-step", "the forward accelerometer steps by 0.3 m/s2", "imu", "covered", _FOREVER),
     _inertial("specific_force", _plus(0.3), axes=(0,))),
    (Fault("accelerometer-frozen-30s", "the accelerometers repeat one value", "imu", "covered"), _inertial("specific_force", _held)),
    (Fault("accelerometer-saturated", "the forward accelerometer ends at 0.2 m/s2", "imu", "covered", _FOREVER, whole_run=True),
     _inertial("specific_force", _clipped(0.2), axes=(0,))),
    (Fault("accelerometer-noise", "the accelerometers scatter by 2 m/s2", "imu", "covered", 60.0),
     _inertial("specific_force", _noisy(2.0))),
    (Fault("imu-silent-60s", "no inertial samples for a minute", "imu", "unharmed", 60.0), _silent()),
    (Fault("imu-late-0.2s", "inertial stamps 0.2 s late", "imu", "covered", 60.0), _stamped_late(0.2)),
    (Fault("imu-mounted-aslant", "the IMU is turned by 5 degrees in yaw", "imu", "covered", _FOREVER, whole_run=True), _mounted_aslant),
    (Fault("balise-silent", "the reader reads no further", "balise", "covered", _FOREVER), _silent()),
    (Fault("balise-misnamed", "each balise is read under the name of the next", "balise", "covered", _FOREVER), _other_names),
    (Fault("balise-late-1s", "readings 1 s late", "balise", "covered", _FOREVER), _stamped_late(1.0)),
)
# fmt: on

#: Every fault of a sensor by name.
FAULTS: dict[str, Fault] = {fault.name: fault for fault, _ in _SENSOR_FAULTS}


def with_fault(run: Run, name: str, *, start: float, seed: int = 0, duration: float | None = None) -> Run:
    """Do one named fault to a run.

    Parameters
    ----------
    run : Run
        Sound, real or simulated; it stays as it is.
    name : str
        One of `FAULTS`.
    start : float
        Onset, s; faults of a whole run begin at the first epoch.
    seed : int
        Of the fault's own random numbers.
    duration : float, optional
        How long it lasts, s, instead of the fault's own.

    Returns
    -------
    Run
        The same run with one stream spoilt. What the stream states of itself, sigmas above all, stays as it was unless that is the
        fault.

    Raises
    ------
    InputError
        An unknown fault, or a run without that stream.

    Examples
    --------
    >>> from railnav.simulation import Leg, demo_line, simulate
    >>> run, _ = simulate(demo_line(spacing=20.0), Leg(("77R-01",), start=50.0, finish=700.0), seed=1)
    >>> len(run.gnss) - len(with_fault(run, "gnss-silent-60s", start=10.0, duration=20.0).gnss)
    20
    """
    deed = next((d for f, d in _SENSOR_FAULTS if f.name == name), None)
    if deed is None:
        near = get_close_matches(name, FAULTS, 3, 0.4)
        raise InputError(
            f"no fault {name!r}; {'the nearest are ' if near else 'there are '}{', '.join(near or FAULTS)}"
        )
    fault = FAULTS[name]
    stream = getattr(run, fault.subject)
    if stream is None:
        raise InputError(f"run {run.id!r} has no {fault.subject} to spoil with {name!r}")
    begin = -np.inf if fault.whole_run else start
    since = stream.time - start if not fault.whole_run else stream.time - stream.time[0]
    during = (stream.time >= begin) & (since < (fault.duration if duration is None else duration))
    if not during.any():
        raise InputError(f"fault {name!r} at {start:g} s lies outside the run, which ends at {stream.time[-1]:g} s")
    spoilt = deed(stream, during, np.maximum(since, 0.0), np.random.default_rng([seed, len(name)]))
    return replace(run, **{fault.subject: spoilt})
