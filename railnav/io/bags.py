"""ROS 1 and ROS 2 recordings (.bag, .mcap, .db3, folders with metadata.yaml): fixes, inertial samples and wheel speed.

Read are sensor_msgs/NavSatFix, sensor_msgs/Imu, nav_msgs/Odometry and geometry_msgs/TwistStamped. By REP 103 and 145 axes are
forward, left, up and an accelerometer at rest reads +9.81 m/s2 on z: both are turned to forward, right, down. Times are those of the
messages' headers, UTC.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.errors import RailnavError, RunError
from railnav.io import gnss_time
from railnav.run import GnssStream, ImuStream, OdometerStream, Run

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

FIX, IMU = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
SPEEDS = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped")
BAG_ENDINGS = (".bag", ".mcap", ".db3")
#: NavSatStatus on the scale of GGA: fix, satellite-based augmentation, ground-based augmentation.
_STATUS = {0: 1.0, 1: 2.0, 2: 4.0}
_ROWS = 1 << 14


@dataclass(slots=True)
class _Rows:
    """Rows of numbers with stamps, packed now and then."""

    stamps: list[int] = field(default_factory=list)
    rows: list[tuple[float, ...]] = field(default_factory=list)
    packed: list[tuple[IntArray, FloatArray]] = field(default_factory=list)

    def add(self, stamp: int, row: tuple[float, ...]) -> None:
        self.stamps.append(stamp)
        self.rows.append(row)
        if len(self.rows) == _ROWS:
            self.pack()

    def pack(self) -> None:
        if self.rows:
            self.packed.append((np.array(self.stamps, np.int64), np.array(self.rows)))
            self.stamps, self.rows = [], []

    def table(self, name: str, file: Path, notes: list[str]) -> tuple[IntArray, FloatArray] | None:
        """Stamps in order and rows; of two at one instant the first."""
        self.pack()
        if not self.packed:
            return None
        stamp = np.concatenate([s for s, _ in self.packed])
        rows = np.concatenate([r for _, r in self.packed])
        if (stamp <= 0).any():
            raise RunError(
                f"messages of {name} have no time in their header", file=file, remedy="record them with stamps"
            )
        order = np.argsort(stamp, kind="stable")
        if (np.diff(stamp) < 0).any():
            notes.append(f"{name}: messages were not in order of their stamps and were sorted")
        stamp, rows = stamp[order], rows[order]
        first = np.append(True, np.diff(stamp) > 0)
        if not first.all():
            notes.append(f"{name}: {int((~first).sum())} second messages at one instant left out")
        return stamp[first], rows[first]


def read_bag(
    path: str | Path, *, topics: Iterable[str] = (), start: datetime | None = None
) -> tuple[Run, tuple[str, ...]]:
    """Read a recording as a run.

    Parameters
    ----------
    path : path
        A .bag, .mcap or .db3 file, or the folder of a ROS 2 recording.
    topics : iterable of str, optional
        Topics to read; needed where several carry the same kind of message.
    start : datetime, optional
        Start of the run; by default the whole second of the first message.

    Returns
    -------
    Run, notes
        Streams of fixes, inertial samples and speed, those that there are, and what a user should know.

    Raises
    ------
    RailnavError
        rosbags is not installed.
    RunError
        The recording is missing, damaged, holds nothing of these, or several topics of one kind.

    Notes
    -----
    Sigmas of a fix come from its covariance where its type is known. A speed is the forward component of the twist; it is taken as signed.

    References
    ----------
    sensor_msgs/NavSatFix (altitude above the WGS 84 ellipsoid; covariance east, north, up), sensor_msgs/Imu; REP 103, REP 145.

    Examples
    --------
    >>> read_bag("nowhere.mcap")
    Traceback (most recent call last):
    railnav.errors.RunError: nowhere.mcap: does not exist; check the name
    """
    path = Path(path)
    if not path.exists():
        raise RunError("does not exist", file=path, remedy="check the name")
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise RailnavError('recordings of ROS need rosbags; install with: pip install "railnav[bags]"') from error
    fixes, samples, speeds = _Rows(), _Rows(), _Rows()
    notes: list[str] = []
    void = 0
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            chosen = _chosen(path, reader.connections, set(topics))
            for connection, _, raw in reader.messages([c for group in chosen.values() for c in group]):
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp = int(message.header.stamp.sec) * gnss_time.SECOND + int(message.header.stamp.nanosec)
                if connection.msgtype == FIX:
                    row = _fix(message)
                    if row is None:
                        void += 1
                    else:
                        fixes.add(stamp, row)
                elif connection.msgtype == IMU:
                    g, a = message.angular_velocity, message.linear_acceleration
                    samples.add(stamp, (g.x, -g.y, -g.z, a.x, -a.y, -a.z))
                else:
                    twist = message.twist
                    speeds.add(stamp, (getattr(twist, "twist", twist).linear.x,))
    except RailnavError:
        raise
    except Exception as error:  # rosbags raises what its storage plugins raise: sqlite3, struct, zstd, ...
        cause = " ".join(str(error).split())[:200] or type(error).__name__
        raise RunError(
            f"is no whole recording of ROS ({cause})", file=path, remedy="index or repair it first"
        ) from error
    if void:
        notes.append(f"{void} fixes without a position left out")
    tables = {
        name: rows.table(name, path, notes) for name, rows in (("fixes", fixes), ("imu", samples), ("speed", speeds))
    }
    begins = [int(table[0][0]) for table in tables.values() if table is not None]
    if not begins:
        raise RunError(
            "holds no fixes, inertial samples or speeds", file=path, remedy="record NavSatFix, Imu or Odometry"
        )
    origin = gnss_time.nanoseconds(start) if start is not None else min(begins) // gnss_time.SECOND * gnss_time.SECOND
    first = start or datetime.fromtimestamp(origin // gnss_time.SECOND, UTC)
    imu, speed = (
        None if table is None else ((table[0] - origin) / 1e9, table[1]) for table in (tables["imu"], tables["speed"])
    )
    run = Run(
        path.stem,
        first,
        gnss=None if tables["fixes"] is None else _gnss(*tables["fixes"], origin),
        imu=None if imu is None else ImuStream(imu[0], imu[1][:, :3].copy(), imu[1][:, 3:].copy()),
        odometer=None if speed is None else OdometerStream(speed[0], speed=speed[1][:, 0].copy(), signed=True),
        source=path,
    )
    return run, tuple(notes)


def _chosen(path: Path, connections: Any, topics: set[str]) -> dict[str, list[Any]]:
    """Connections to read, by kind."""
    groups: dict[str, list[Any]] = {}
    for connection in connections:
        kind = "speed" if connection.msgtype in SPEEDS else connection.msgtype
        if kind in ("speed", FIX, IMU) and (not topics or connection.topic in topics):
            groups.setdefault(kind, []).append(connection)
    there = {connection.topic for connection in connections}
    missing = sorted(topics - there)
    if missing:
        raise RunError(
            f"has no topic {missing[0][:60]!r}", file=path, remedy=f"it has: {', '.join(sorted(there))[:300]}"
        )
    for kind, group in groups.items():
        names = sorted({connection.topic for connection in group})
        if len(names) > 1:
            raise RunError(
                f"has several topics of {kind}: {', '.join(names)[:200]}", file=path, remedy="choose with --topic"
            )
    return groups


def _fix(message: Any) -> tuple[float, ...] | None:
    """A fix as numbers; None where it is none."""
    status = int(message.status.status)
    latitude, longitude = float(message.latitude), float(message.longitude)
    if status < 0 or not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        return None
    sigmas = (np.nan, np.nan, np.nan)
    if int(message.position_covariance_type) > 0:
        variances = np.asarray(message.position_covariance, np.float64).reshape(3, 3).diagonal()
        sigmas = tuple(float(np.sqrt(v)) if v > 0.0 else np.nan for v in variances)  # type: ignore[assignment]
    return latitude, longitude, float(message.altitude), *sigmas, _STATUS.get(status, 1.0)


def _gnss(stamp: IntArray, rows: FloatArray, origin: int) -> GnssStream:
    def known(k: int) -> FloatArray | None:
        return None if np.isnan(rows[:, k]).all() else rows[:, k].copy()

    return GnssStream(
        (stamp - origin) / 1e9,
        np.radians(rows[:, 0]),
        np.radians(rows[:, 1]),
        known(2),
        known(3),
        known(4),
        known(5),
        quality=known(6),
    )
