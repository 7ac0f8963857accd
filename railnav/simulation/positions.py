"""Simulated sets of positions for a calibration: an inertial unit of a data sheet on a cube, a dividing head or a rate table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from railnav.geodesy.ellipsoid import WGS84
from railnav.inertial.mechanization import EARTH_RATE
from railnav.inertial.positions import PositionLog
from railnav.inertial.procedure import Method
from railnav.inertial.sensors import GRADES, TriadModel, simulate_triad
from railnav.inertial.turns import turned_force
from railnav.run import ImuStream

FloatArray = NDArray[np.float64]
Unit = Literal["L3G4200D", "IMU440", "RT3003", "STIM300", "ASM330LHH"]

#: Data-sheet grades of the gyros and accelerometers of each unit.
UNITS: dict[str, tuple[str, str]] = {
    name: (f"{name} gyroscope", f"{'LSM303DLH' if name == 'L3G4200D' else name} accelerometer")
    for name in ("L3G4200D", "IMU440", "RT3003", "STIM300", "ASM330LHH")
}


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedPositions:
    """A simulated set of positions and the specimen that was in it.

    Attributes
    ----------
    logs : tuple of PositionLog
        As the unit would log them, with what an operator would note: faces, turns, rate of the table.
    gyroscope, accelerometer : TriadModel
        The truth.
    gravity, latitude : float
        m/s^2, rad.
    """

    logs: tuple[PositionLog, ...]
    gyroscope: TriadModel
    accelerometer: TriadModel
    gravity: float
    latitude: float


def simulate_positions(
    method: Method,
    *,
    unit: Unit = "IMU440",
    seed: int = 1,
    count: int = 12,
    duration: float = 20.0,
    interval: float = 0.01,
    latitude: float = math.radians(48.85),
    rate: float = math.radians(60.0),
    temperatures: Sequence[float] | None = None,
    levelling: float = math.radians(0.05),
    fault: tuple[str, float] | None = None,
    series: int = 0,
) -> SimulatedPositions:
    """Simulate the logs of a calibration, one a position.

    Parameters
    ----------
    method : str
        For which method: six faces; `count` attitudes over the sphere; the same on a rate table; or turns by 2 : 4 : 1 times 30 degrees.
    unit : str, optional
        Data sheet of which a specimen is drawn.
    seed : int, optional
        The same seed gives the same specimen and samples.
    count : int, optional
        Positions of the multi-position methods and of turns.
    duration, interval : float, optional
        Of each log and of its samples, s.
    latitude : float, optional
        rad: gravity and the Earth's rotation follow.
    rate : float, optional
        Of the table, rad/s.
    temperatures : sequence of float, optional
        K; the whole set is repeated at each, and the logs carry their temperature.
    levelling : float, optional
        Sigma of the table's tilt about each level axis, rad.
    fault : (str, float), optional
        A parameter of the specimen that moves, and by how much: "accelerometer bias x", "accelerometer scale y", "accelerometer
        misalignment xz" (m/s^2, a share, rad) or the same of "gyroscope".
    series : int, optional
        Another series with the same specimen: other noise, azimuths and tilts.

    Returns
    -------
    SimulatedPositions

    Raises
    ------
    ValueError
        An unknown method, unit or fault.

    Notes
    -----
    Azimuths are random; switch-on biases are drawn once, in-run parts a log. The data are simulated: they show what the methods do with the
    errors of a data sheet, not what a real unit does.

    Examples
    --------
    >>> made = simulate_positions("six-position", unit="STIM300", duration=2.0)
    >>> [log.name for log in made.logs]
    ['01', '02', '03', '04', '05', '06']
    """
    if unit not in UNITS:
        raise ValueError(f"no unit {unit!r}; there are {', '.join(UNITS)}")
    gyro, force = (GRADES[name].draw(seed + k) for k, name in enumerate(UNITS[unit]))
    if fault is not None:
        triad, _, parameter = fault[0].partition(" ")
        if triad == "gyroscope":
            gyro = _moved(gyro, parameter, fault[1])
        elif triad == "accelerometer":
            force = _moved(force, parameter, fault[1])
        else:
            raise ValueError(f"no triad {triad!r}; accelerometer or gyroscope")
    gravity = float(WGS84.normal_gravity(latitude, 0.0))
    random = np.random.default_rng([seed, 7, series])
    ups, rates, turns, turn_rates = _programme(method, count, rate, random)
    n = round(duration / interval)
    time = np.arange(1, n + 1, dtype=np.float64) * float(interval)
    logs: list[PositionLog] = []
    digits = max(2, len(str(len(ups) * len(temperatures or (0,)))))
    for kelvin in temperatures or (None,):
        for k, nominal in enumerate(ups):
            tilt = random.normal(0.0, levelling, 3)
            up = nominal + np.cross(tilt, nominal)
            up /= np.linalg.norm(up)
            east = np.cross(random.normal(size=3), up)
            north = np.cross(up, east / np.linalg.norm(east))
            earth = EARTH_RATE * (math.cos(latitude) * north + math.sin(latitude) * up)
            own = np.zeros(3) if rates is None else rates[k] + np.cross(tilt, rates[k])
            turned = np.broadcast_to(earth, (n, 3))
            if rates is not None and np.linalg.norm(own) > 0.0:  # the level part of the Earth's rotation turns round
                angle = np.linalg.norm(own) * (time - 0.5 * interval)
                axis = own / np.linalg.norm(own)
                level = earth - (earth @ axis) * axis
                turned = (
                    (earth @ axis) * axis
                    + np.outer(np.cos(angle), level)
                    - np.outer(np.sin(angle), np.cross(axis, level))
                )
            warm = np.full(n, kelvin) if kelvin is not None else None
            number = len(logs) + 1
            w = simulate_triad(
                turned + own, interval, gyro, seed=1000 * seed + 2 * number + 500 * series, temperature=warm
            )
            f = simulate_triad(
                np.broadcast_to(gravity * up, (n, 3)),
                interval,
                force,
                seed=1000 * seed + 2 * number + 500 * series + 1,
                temperature=warm,
            )
            stream = ImuStream(time, w.measured, f.measured, temperature=warm)
            logs.append(
                PositionLog(
                    f"{number:0{digits}d}",
                    stream,
                    up=None if turns is not None else nominal,
                    rate=None if rates is None else float(np.linalg.norm(rates[k])) or None,
                    turns=None if turns is None else turns[k],
                    turn_rates=None if turn_rates is None else turn_rates[k],
                )
            )
    return SimulatedPositions(tuple(logs), gyro, force, gravity, latitude)


def _programme(
    method: Method, count: int, rate: float, random: np.random.Generator
) -> tuple[FloatArray, FloatArray | None, FloatArray | None, FloatArray | None]:
    """Up, rates, turns and their rates, position by position."""
    faces = np.array([sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)])
    if method == "six-position":
        return faces, None, None, None
    if method == "modified-six-position":
        return faces, rate * faces, None, None
    if method == "turns":
        steps = np.arange(count)[:, None] * math.radians(30.0) * np.array([2.0, 4.0, 1.0])
        return turned_force(*steps.T), None, steps, None
    if method in ("multi-position", "modified-multi-position"):
        cube = np.array([c for c in product((-1.0, 0.0, 1.0), repeat=3) if any(c)])
        cube = cube[np.argsort(np.abs(cube).sum(axis=1), kind="stable")]  # faces, then edges, then corners
        edges = (
            cube[6:][random.permutation(20)] if count != 9 else np.array([(1, 1, 0), (1, 0, 1), (0, 1, 1)], dtype=float)
        )
        set_ = np.vstack([cube[:6], edges, *(cube for _ in range(max(0, count - 26) // 26 + 1))])[:count]
        ups = set_ / np.linalg.norm(set_, axis=1, keepdims=True)
        return ups, (rate * ups if method != "multi-position" else None), None, None
    raise ValueError(f"no method {method!r}")


def _moved(model: TriadModel, parameter: str, size: float) -> TriadModel:
    kind, _, axis = parameter.partition(" ")
    if kind in ("bias", "scale") and axis in ("x", "y", "z"):
        values = np.array(getattr(model, kind))
        values["xyz".index(axis)] += size
        x, y, z = values.tolist()
        return replace(model, bias=(x, y, z)) if kind == "bias" else replace(model, scale=(x, y, z))
    if kind == "misalignment" and axis in ("xy", "xz", "yz"):
        cross = np.array(model.cross_axis)
        cross["xyz".index(axis[0]), "xyz".index(axis[1])] += size
        (a, b, c), (d, e, f), (g, h, i) = cross.tolist()
        return replace(model, cross_axis=((a, b, c), (d, e, f), (g, h, i)))
    raise ValueError(f"no parameter {parameter!r}; bias x, scale y, misalignment xz, ...")
