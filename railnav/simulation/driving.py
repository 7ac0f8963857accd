"""How a train is driven: speed within the limits of curves, bounded acceleration, bounded jerk."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import TrackError
from railnav.simulation.journey import Path
from railnav.units import STANDARD_GRAVITY, cant_angle

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Driving:
    """Limits that the driver keeps.

    Attributes
    ----------
    speed : float
        Greatest speed, m/s.
    acceleration, braking : float
        Greatest acceleration and deceleration along the track, m/s^2.
    jerk : float
        Greatest change of acceleration, m/s^3.
    lateral : float
        Greatest lateral acceleration in the plane of the track, cant deducted, m/s^2; 0.65 is usual practice and gives
        50 km/h through a turnout of 300 m radius.
    first_standstill : float
        Standstill before the first leg, s.
    """

    speed: float = 120.0 / 3.6
    acceleration: float = 0.5
    braking: float = 0.5
    jerk: float = 0.4
    lateral: float = 0.65
    first_standstill: float = 20.0

    @property
    def smoothing(self) -> float:
        """Width of the window over which a change of acceleration is spread, s."""
        return (self.acceleration + self.braking) / self.jerk


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Distance run as a function of time, closed form.

    A plan of constant acceleration per cell is averaged over a window of `smoothing` seconds: the mean of distance is again a
    distance, its derivative the mean speed, and the acceleration (v(t + T/2) - v(t - T/2)) / T changes by at most
    (acceleration + braking) / T = jerk a second. Standstills and the places of stops are kept exactly.

    Attributes
    ----------
    time, distance, speed, acceleration : (n,) arrays
        Start of each cell of the plan: s, m, m/s, m/s^2.
    area : (n,) array
        Integral of the distance, m s.
    smoothing : float
        s.
    duration : float
        s.
    """

    time: FloatArray
    distance: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    area: FloatArray
    smoothing: float
    duration: float

    def _plan(self, time: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        i = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 1)
        x = time - self.time[i]
        d, v, a = self.distance[i], self.speed[i], self.acceleration[i]
        return (
            self.area[i] + x * (d + x * (0.5 * v + x * a / 6.0)),
            d + x * (v + 0.5 * x * a),
            v + x * a,
        )

    def at(self, time: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Distance run (m), speed (m/s, never negative) and acceleration (m/s^2) at times, s; any shape."""
        t = np.asarray(time, float)
        half = 0.5 * self.smoothing
        area0, distance0, speed0 = self._plan(t - half)
        area1, distance1, speed1 = self._plan(t + half)
        width = self.smoothing
        return (area1 - area0) / width, (distance1 - distance0) / width, (speed1 - speed0) / width


def speed_limit(path: Path, driving: Driving, distance: ArrayLike) -> FloatArray:
    """Speed that curves and turnouts allow, m/s: |v^2 k - g sin(cant angle)| <= lateral, and never above the line's speed.

    Parameters
    ----------
    path : Path
    driving : Driving
    distance : (m,) array
        Distances run, m.

    Returns
    -------
    (m,) array
    """
    here = path.at(distance)
    bend = np.abs(here.curvature)
    help_of_cant = STANDARD_GRAVITY * np.sin(cant_angle(here.cant)) * np.sign(here.curvature)
    allowed = np.maximum(driving.lateral + help_of_cant, 0.05)
    return np.minimum(driving.speed, np.sqrt(allowed / np.maximum(bend, 1e-9)))


def drive(path: Path, driving: Driving | None = None) -> Motion:
    """Plan the motion along a path as fast as the limits allow.

    Parameters
    ----------
    path : Path
    driving : Driving, optional

    Returns
    -------
    Motion
        From the first standstill to the end of the last leg's dwell.

    Raises
    ------
    TrackError
        A limit that is not positive.

    Notes
    -----
    Limits are evaluated every metre and widened by the way run in half the smoothing window, so that the smoothed speed keeps
    them too.

    Examples
    --------
    >>> from railnav.simulation import demo_line
    >>> from railnav.simulation.journey import Leg, path_of
    >>> path = path_of(demo_line(spacing=50.0), Leg(("77R-01",), start=100.0, finish=700.0))
    >>> motion = drive(path, Driving(speed=10.0))
    >>> [round(float(x), 6) for x in motion.at(motion.duration)]
    [600.0, 0.0, 0.0]
    """
    from scipy.ndimage import minimum_filter1d

    driving = driving or Driving()
    for name in ("speed", "acceleration", "braking", "jerk", "lateral"):
        if not getattr(driving, name) > 0.0:
            raise TrackError(f"{name} {getattr(driving, name)} is not positive")
    if driving.first_standstill < 0.0 or min(h.duration for h in path.halts) < 0.0:
        raise TrackError("a standstill lasts a negative time")
    width = driving.smoothing
    time, distance, speed, acceleration = [0.0], [0.0], [0.0], [0.0]  # first cell: the standstill
    clock = driving.first_standstill + width
    begin = 0.0
    for halt in path.halts:
        cells = max(2, math.ceil(halt.distance - begin))
        q = np.linspace(begin, halt.distance, cells + 1)
        reach = math.ceil((0.5 * driving.speed * width + driving.acceleration * width**2) / (q[1] - q[0]))
        limit = minimum_filter1d(speed_limit(path, driving, q), 2 * reach + 1, mode="nearest") ** 2
        limit[[0, -1]] = 0.0
        up, down = 2.0 * driving.acceleration * q, 2.0 * driving.braking * q
        square = np.minimum.accumulate(limit - up) + up
        square = np.minimum.accumulate((square + down)[::-1])[::-1] - down
        square[[0, -1]] = 0.0
        v = np.sqrt(np.maximum(square, 0.0))
        step = np.diff(q)
        took = 2.0 * step / (v[1:] + v[:-1])
        start = clock + np.append(0.0, np.cumsum(took))
        time += [*start[:-1].tolist(), float(start[-1])]
        distance += q.tolist()
        speed += [*v[:-1].tolist(), 0.0]
        acceleration += [*((v[1:] - v[:-1]) / took).tolist(), 0.0]
        clock = float(start[-1]) + halt.duration + width
        begin = halt.distance
    t, d, v, a = (np.array(x) for x in (time, distance, speed, acceleration))
    x = np.diff(t)
    area = np.append(0.0, np.cumsum(x * (d[:-1] + x * (0.5 * v[:-1] + x * a[:-1] / 6.0))))
    # the plan waits half a window longer at both ends than the smoothed motion
    return Motion(t - 0.5 * width, d, v, a, area, width, clock - width)
