"""Road drives of the integration experiments, simulated: campus, city and road, with exact inertial samples and GNSS errors that last.

The source drove an electric car on a campus (4 m/s, stops, right angles) and took city and road drives from elsewhere; their logs are not
published. These drives have their speeds, turns and stops.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from railnav.geodesy.ellipsoid import WGS84
from railnav.simulation.inertial import attitude_matrix, interval_means
from railnav.simulation.sensors import gauss_markov

FloatArray = NDArray[np.float64]
Kind = Literal["campus", "city", "road"]


@dataclass(frozen=True, slots=True, eq=False)
class RoadDrive:
    """A drive and what error-free sensors of it would say.

    Attributes
    ----------
    time : (n + 1,) array
        s.
    latitude, longitude, height : (n + 1,) array
        Of the IMU, rad, rad, m.
    velocity_n : (n + 1, 3) array
        North, east, down, m/s.
    attitude_nb : (n + 1, 3, 3) array
        C_nb.
    speed, heading : (n + 1,) array
        Along the nose, m/s; rad.
    rate_ib_b, specific_force_b : (n, 3) array
        Means over the intervals, rad/s, m/s^2; gravity is normal gravity with its linear free-air change.
    """

    time: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    height: FloatArray
    velocity_n: FloatArray
    attitude_nb: FloatArray
    speed: FloatArray
    heading: FloatArray
    rate_ib_b: FloatArray
    specific_force_b: FloatArray

    def error(self, latitude: FloatArray, longitude: FloatArray, height: FloatArray | None = None) -> FloatArray:
        """Error of positions at all instants: north, east and, if given, up, m, (n + 1, 2 or 3)."""
        north = (latitude - self.latitude) * (WGS84.meridian_radius(self.latitude) + self.height)
        across = (WGS84.transverse_radius(self.latitude) + self.height) * np.cos(self.latitude)
        columns = [north, (longitude - self.longitude) * across]
        if height is not None:
            columns.append(height - self.height)
        return np.stack(columns, axis=1)


def road_drive(kind: Kind, duration: float, *, interval: float = 0.01, heading: float = 0.3) -> RoadDrive:
    """Simulate a drive.

    Parameters
    ----------
    kind : {"campus", "city", "road"}
        4 m/s with a right angle every half minute and a stop every other; 9 m/s with right angles and stops; 18 m/s with bends.
    duration, interval : float, optional
        s.
    heading : float, optional
        At the start, rad.

    Returns
    -------
    RoadDrive

    Raises
    ------
    ValueError
        A kind that is none of these, a duration below 10 s.

    References
    ----------
    `spec/inertial.md` B14.2.

    Examples
    --------
    >>> drive = road_drive("city", 20.0)
    >>> float(drive.speed.max().round(3))
    9.0
    """
    if kind not in ("campus", "city", "road"):
        raise ValueError(f"kind {kind!r} is none of campus, city, road")
    if duration < 10.0:
        raise ValueError(f"a drive of {duration:g} s is too short: give at least 10 s")
    count = round(duration / interval) + 1
    t: FloatArray = np.arange(count, dtype=np.float64) * interval
    v, r = np.zeros(count), np.zeros(count)
    if kind == "road":
        v[:] = 18.0
        r[:] = 0.02 * np.sin(2 * np.pi * t / 80) + 0.01 * np.sin(2 * np.pi * t / 23)
    else:
        fast, first, period, halt, bend, left = (
            (4.0, 60.0, 120.0, 10.0, 6.0, 4) if kind == "campus" else (9.0, 40.0, 60.0, 6.0, 4.0, 2)
        )
        v[:] = fast
        for start in np.arange(first, duration, period):
            v[(t >= start) & (t < start + halt)] = 0.0
        for i, start in enumerate(np.arange(25.0, duration, 30.0)):
            r[(t >= start) & (t < start + bend)] = (-1.0 if i % left == left - 1 else 1.0) * np.pi / 2 / bend
    v[t < 5] = 0.0
    taps = int(3.0 / interval)
    window = np.hanning(taps) / np.hanning(taps).sum()
    v, r = (np.convolve(np.pad(x, (taps // 2, taps - 1 - taps // 2), mode="edge"), window, "valid") for x in (v, r))
    r = np.where(v < 0.3, 0.0, r)
    turned = heading + np.concatenate([[0.0], np.cumsum(0.5 * (r[1:] + r[:-1]) * interval)])
    way = np.concatenate([[0.0], np.cumsum(v[:-1] * interval)])
    pitch, roll = 0.01 * np.sin(2 * np.pi * way / 900), 0.3 * v * r / 9.81
    attitude = attitude_matrix(roll, pitch, turned)
    velocity = attitude[:, :, 0] * v[:, None]
    latitude0, longitude0, height0 = (0.852398, 0.036710, 150.0) if kind == "campus" else (0.855211, 0.146608, 110.0)
    mean = 0.5 * (velocity[1:] + velocity[:-1]) * interval
    height = height0 - np.concatenate([[0.0], np.cumsum(mean[:, 2])])
    latitude = np.full(count, latitude0)
    for _ in range(3):  # the radii change with latitude and height
        half = 0.5 * (latitude[1:] + latitude[:-1]), 0.5 * (height[1:] + height[:-1])
        latitude = latitude0 + np.concatenate(
            [[0.0], np.cumsum(mean[:, 0] / (WGS84.meridian_radius(half[0]) + half[1]))]
        )
    across = (WGS84.transverse_radius(half[0]) + half[1]) * np.cos(half[0])
    longitude = longitude0 + np.concatenate([[0.0], np.cumsum(mean[:, 1] / across)])
    w, f = interval_means(t, latitude, height, velocity, attitude)
    return RoadDrive(t, latitude, longitude, height, velocity, attitude, v, turned, w, f)


def gnss_error(
    generator: np.random.Generator,
    count: int,
    interval: float,
    *,
    variance: float,
    white: float,
    correlation_time: float,
) -> FloatArray:
    """Position errors of a receiver: a white part and a first-order Gauss-Markov part.

    Parameters
    ----------
    generator : numpy Generator
    count : int
    interval, correlation_time : float
        s.
    variance : float
        Mean of the squared horizontal error, m^2, both axes together; up has twice the sigma of an axis.
    white : float
        Share of the variance that is white.

    Returns
    -------
    (count, 3) array
        North, east, up, m.

    References
    ----------
    `spec/inertial.md` B14.2.

    Examples
    --------
    >>> e = gnss_error(np.random.default_rng(1), 100_000, 0.2, variance=8.8775, white=0.7, correlation_time=30.0)
    >>> round(float((e[:, :2] ** 2).sum(axis=1).mean()), 1)
    8.9
    """
    columns = []
    for sigma in np.sqrt(variance / 2.0) * np.array([1.0, 1.0, 2.0]):
        slow = gauss_markov(generator, count, interval, float(sigma * np.sqrt(1.0 - white)), correlation_time)
        columns.append(slow + sigma * np.sqrt(white) * generator.standard_normal(count))
    return np.stack(columns, axis=1)
