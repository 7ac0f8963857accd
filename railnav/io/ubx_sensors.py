"""Inertial samples and wheel ticks of UBX logs: ESF-RAW or ESF-MEAS, on the clock of NAV-PVT.

The messages stamp samples with a clock of their own (a counter of the receiver or the sensor); the navigation epoch that stands before them
in the log ties it to UTC. Axes are the receiver's own: `[imu] mounting_deg` in run.toml turns them. ESF-INS, which is free of gravity and
compensated with the solution itself, is no measurement and is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RunError
from railnav.io import _ubx_kernels, gnss_time
from railnav.io.log_reading import ByteArray, through
from railnav.io.tables import Table, _check_file, freeze
from railnav.run import ImuStream, OdometerStream

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_PVT, _MEAS, _RAW = 0x0107, 0x1002, 0x1003
#: Types of data: gyroscopes 2^-12 deg/s, accelerometers 2^-10 m/s2, 24 bits signed.
_GYRO, _ACCEL = (14, 13, 5), (16, 17, 18)
#: Speed, 1e-3 m/s signed; ticks: 23 bits and a direction (1 = backward).
_SPEED, _TICKS, _TEMPERATURE = 11, (10, 8, 9, 6, 7), 12
_ROOM = 1 << 15
#: Stamps of the sensors' clock count milliseconds where that makes a second a second, within this share.
_SAME_RATE = 0.05
#: Samples of the axes within this of each other are one, s.
_TOGETHER = 2e-3


@dataclass(frozen=True, slots=True, eq=False)
class Sensors:
    """What a log holds besides fixes: streams or None, their sensors' readings counted, and what a user should know."""

    imu: ImuStream | None
    odometer: OdometerStream | None
    counts: dict[str, int]
    notes: tuple[str, ...]


def read_sensors(path: str | Path, start: datetime) -> Sensors:
    """Read the inertial and wheel data of a UBX log.

    Parameters
    ----------
    path : path
        The log.
    start : datetime
        Start of the run, with its time zone; times count from here.

    Returns
    -------
    Sensors
        `imu` in the receiver's own axes, SI; `odometer` with speed where the log has a speed sensor. Ticks are counted, not used:
        a tick's length is not known to the log.

    Notes
    -----
    The sensors' clock is tied to UTC by the least delay: of all pairs of a sample and the navigation epoch before it, the line that lies
    below all but the fastest, fitted in blocks of 60 s. It is late by the delay of the epoch itself, some tens of milliseconds: estimate
    it (or state it as time_offset_s) where that matters.

    References
    ----------
    u-blox M8 and F9 interface descriptions: ESF-MEAS (0x10 0x02), ESF-RAW (0x10 0x03), table of ESF measurement data.
    """
    path = Path(path)
    kinds: list[IntArray] = []
    values: list[IntArray] = []
    tags: list[IntArray] = []
    epochs: list[IntArray] = []
    utc = np.int64(-1)
    found = np.zeros((_ROOM, 3), np.int64)
    use_raw = _has_raw(path)

    def step(data: ByteArray, last: bool) -> int:
        used = 0
        while True:
            more, rows = _ubx_kernels.frames(data[used:], last, found)
            take(data[used:], found[:rows])
            used += int(more)
            if rows < _ROOM:
                return used

    def take(data: ByteArray, wanted: IntArray) -> None:
        nonlocal utc
        wanted = wanted[np.isin(wanted[:, 0], (_PVT, _RAW if use_raw else _MEAS))]
        for kind, at, size in wanted.tolist():
            if kind == _PVT and size >= 92:
                stamp = _pvt(data[at : at + size])
                utc = utc if stamp is None else np.int64(stamp)
            elif kind == _RAW and size >= 12:
                words = data[at + 4 : at + 4 + (size - 4) // 8 * 8].view("<u4").reshape(-1, 2).astype(np.int64)
                _keep(words[:, 0], words[:, 1])
            elif kind == _MEAS and size >= 12:
                tag = int(data[at : at + 4].view("<u4")[0])
                count = (int(data[at + 4]) | (int(data[at + 5]) << 8)) >> 11
                words = data[at + 8 : at + 8 + min(4 * count, size - 8) // 4 * 4].view("<u4").astype(np.int64)
                _keep(words, np.full(len(words), tag, np.int64))

    def _keep(words: IntArray, tag: IntArray) -> None:
        kinds.append((words >> 24) & 0x3F)
        values.append(words & 0xFFFFFF)
        tags.append(tag)
        epochs.append(np.full(len(words), utc, np.int64))

    through(path, step)
    if not kinds:
        return Sensors(None, None, {}, ())
    kind, value, tag, epoch = (np.concatenate(column) for column in (kinds, values, tags, epochs))
    counts = {_NAMES.get(int(k), f"type {int(k)}"): int((kind == k).sum()) for k in np.unique(kind)}
    notes: list[str] = []
    time = _clock(tag, epoch, gnss_time.nanoseconds(start), notes)
    if time is None:
        return Sensors(None, None, counts, tuple(notes))
    signed = np.where(value >= 1 << 23, value - (1 << 24), value).astype(np.float64)
    imu = _imu(kind, signed, time, notes)
    at = kind == _SPEED
    odometer = None
    if at.any():
        moment, first = np.unique(time[at], return_index=True)
        odometer = OdometerStream(moment, speed=signed[at][first] * 1e-3, signed=True)
    if np.isin(kind, _TICKS).any():
        notes.append("wheel ticks are counted and left out: the log does not say how far a tick is")
    return Sensors(imu, odometer, counts, tuple(notes))


def sensor_table(path: str | Path, stream: str, start: datetime) -> Table:
    """The "imu" or "odometer" of a UBX log as a table of that stream, in the units of the table of formats.

    Raises
    ------
    RunError
        The log has no such data; the message says what it has.
    """
    path = Path(path)
    _check_file(path, RunError)
    found = read_sensors(path, start)
    held = ", ".join(f"{count} {name}" for name, count in found.counts.items()) or "no ESF-RAW or ESF-MEAS"
    if stream == "imu" and found.imu is not None:
        number = {f"gyro_{axis}_rad_s": freeze(found.imu.gyro[:, i]) for i, axis in enumerate("xyz")}
        number |= {f"accel_{axis}_m_s2": freeze(found.imu.specific_force[:, i]) for i, axis in enumerate("xyz")}
        return Table(path, len(found.imu), {"time_s": freeze(found.imu.time), **number}, error=RunError)
    if stream == "odometer" and found.odometer is not None and found.odometer.speed is not None:
        number = {"time_s": freeze(found.odometer.time), "speed_m_s": freeze(found.odometer.speed)}
        return Table(path, len(found.odometer), number, error=RunError)
    raise RunError(f"has no data for [{stream}] ({held})", file=path, remedy="leave the stream out")


_NAMES = {
    5: "gyro z", 13: "gyro y", 14: "gyro x", 16: "accelerometer x", 17: "accelerometer y", 18: "accelerometer z",
    11: "speed", 12: "temperature", 6: "ticks front left", 7: "ticks front right", 8: "ticks rear left",
    9: "ticks rear right", 10: "ticks",
}  # fmt: skip


def _has_raw(path: Path) -> bool:
    """Whether the head of the log has ESF-RAW: then ESF-MEAS repeats it, filtered."""
    with path.open("rb") as file:
        return b"\xb5\x62\x10\x03" in file.read(1 << 22)


def _pvt(payload: ByteArray) -> int | None:
    """UTC of a NAV-PVT, ns since 1970, where its date and time are valid."""
    if payload[11] & 3 != 3:
        return None
    year = int(payload[4:6].view("<u2")[0])
    nano = int(payload[16:20].view("<i4")[0])
    try:
        month, day, hour, minute, second = payload[6:11].tolist()
        moment = datetime(year, month, day, hour, minute, min(second, 59), tzinfo=UTC)
    except ValueError:
        return None
    return gnss_time.nanoseconds(moment) + nano


def _clock(tag: IntArray, epoch: IntArray, start: int, notes: list[str]) -> FloatArray | None:
    """Seconds since the start of every reading, from its tag and the navigation epoch before it; None where they do not go together."""
    steps = np.diff(tag)
    turned = np.append(0, np.cumsum(steps < -(1 << 31)))  # a counter of 32 bits that begins again
    ticks = (tag + turned * (1 << 32)).astype(np.float64)
    known = epoch >= 0
    if known.sum() < 2 or np.ptp(ticks[known]) == 0.0:
        notes.append("sensor readings without a navigation epoch before them are left out")
        return None
    utc = (epoch[known] - start) / 1e9
    slope, _ = np.polyfit(ticks[known] - ticks[known][0], utc, 1)
    unit = next((unit for unit in (1e-3, 1e-6, 39.0625e-6) if abs(slope / unit - 1.0) < _SAME_RATE), None)
    if unit is None:
        notes.append(
            f"the sensors' clock ticks every {slope * 1e6:.3g} us, which is no known unit; readings are left out"
        )
        return None
    run = ticks * unit
    delay = run[known] - utc  # least where the message follows its epoch at once
    block = ((run[known] - run[known][0]) // 60.0).astype(np.int64)
    if block[-1] < 0:
        notes.append("the sensors' clock runs backwards; readings are left out")
        return None
    borders = np.flatnonzero(np.diff(block, prepend=block[0] - 1))
    least = np.minimum.reduceat(delay, borders)
    middle = np.array([run[known][a] for a in borders])
    offset = np.full(len(run), float(least.min())) if len(least) < 3 else np.polyval(np.polyfit(middle, least, 1), run)
    return np.asarray(run - offset)


def _imu(kind: IntArray, signed: FloatArray, time: FloatArray, notes: list[str]) -> ImuStream | None:
    """Samples where all six axes were read together."""
    columns = []
    reference = kind == _GYRO[2]
    if not all((kind == k).sum() > 1 for k in (*_GYRO, *_ACCEL)):
        missing = [_NAMES[k] for k in (*_GYRO, *_ACCEL) if (kind == k).sum() < 2]
        if len(missing) < 6:
            notes.append(f"no inertial stream: the log has no {', '.join(missing)}")
        return None
    moment = np.unique(time[reference])
    keep = np.ones(len(moment), bool)
    for k, scale in zip((*_GYRO, *_ACCEL), (math.radians(2.0**-12),) * 3 + (2.0**-10,) * 3, strict=True):
        order = np.argsort(time[kind == k], kind="stable")
        at, value = time[kind == k][order], signed[kind == k][order] * scale
        near = np.clip(np.searchsorted(at, moment), 1, len(at) - 1)
        near -= moment - at[near - 1] < at[near] - moment
        keep &= np.abs(at[near] - moment) <= _TOGETHER
        columns.append(value[near])
    table = np.column_stack(columns)[keep]
    if len(table) < 2:
        notes.append("no inertial stream: its axes were not read together")
        return None
    left = int((~keep).sum())
    if left:
        notes.append(f"{left} inertial samples with an axis missing left out")
    up = float(np.median(table[:, 5]))
    mounting = np.zeros(3)
    if up > 5.0:  # at rest an accelerometer that looks up reads +9.81
        mounting[0] = math.pi
        notes.append("the IMU's z axis points up: its mounting is stated as a roll of 180 degrees")
    else:
        notes.append("the IMU's axes are the receiver's own: state its mounting")
    return ImuStream(moment[keep], table[:, :3].copy(), table[:, 3:].copy(), mounting=mounting)
