"""A small survey of its own: an alignment of straights, clothoids and arcs, trains that stop, GNSS with white and correlated errors.

Nothing here is shared with the package but the plane and the run's container: curvature is prescribed, integrated by Simpson's rule,
and the truth is what was prescribed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
from scipy.signal import lfilter
from scipy.spatial import cKDTree

from railnav.geodesy.grid import GridFrame, choose_frame
from railnav.run import GnssStream, GyroAnglesStream, OdometerStream, Run

START = datetime(2026, 5, 4, 8, tzinfo=UTC)


@dataclass(frozen=True)
class Axis:
    """A true track: points every metre of the line's centre, grid bearing and curvature there, height, and its own arc length."""

    east: np.ndarray
    north: np.ndarray
    height: np.ndarray
    bearing: np.ndarray
    curvature: np.ndarray
    arc: np.ndarray

    def right_of(self, east, north):
        """Signed distance of points to the right of the track, and the index of the nearest true point."""
        at = cKDTree(np.column_stack([self.east, self.north])).query(np.column_stack([east, north]))[1]
        sin, cos = np.sin(self.bearing[at]), np.cos(self.bearing[at])
        de, dn = east - self.east[at], north - self.north[at]
        along = de * sin + dn * cos
        return de * cos - dn * sin - 0.5 * self.curvature[at] * along**2, at

    def at(self, s):
        """Position at arc length s."""
        return tuple(np.interp(s, self.arc, v) for v in (self.east, self.north, self.height))

    def shifted(self, right):
        """The track `right` metres beside this one (an array: a switch to another track)."""
        right = np.broadcast_to(np.asarray(right, float), self.east.shape)
        east = self.east + right * np.cos(self.bearing)
        north = self.north - right * np.sin(self.bearing)
        step = np.hypot(np.diff(east), np.diff(north))
        return replace(self, east=east, north=north, arc=np.append(0.0, np.cumsum(step)))


def centre_line(
    seed: int, km: float, *, frame: GridFrame, bearing: float = 1.2, radii=(300, 500, 800, 1500, 3000)
) -> Axis:
    """A line of straights and curves with clothoids (50 m for 300 m radius: the steepest on main lines)."""
    rng = np.random.default_rng(seed)
    pieces, length = [], 0.0
    while length < 1000.0 * km:
        k = rng.choice([-1, 1]) / rng.choice(radii)
        clothoid = float(np.clip(30000.0 * abs(k), 50.0, 160.0))
        straight, arc = rng.uniform(200, 900), rng.uniform(150, 600)
        for part, k0, k1 in ((straight, 0, 0), (clothoid, 0, k), (arc, k, k), (clothoid, k, 0)):
            n = round(part)
            pieces.append(k0 + (k1 - k0) * np.arange(n) / n)
            length += n
    curvature = np.append(np.concatenate(pieces), 0.0)
    middle = 0.5 * (curvature[1:] + curvature[:-1])
    theta = bearing + np.append(0.0, np.cumsum(middle))
    half = theta[:-1] + 0.5 * curvature[:-1] + 0.125 * np.diff(curvature)

    def integral(f):
        return np.append(0.0, np.cumsum((f(theta[:-1]) + 4.0 * f(half) + f(theta[1:])) / 6.0))

    east0, north0, _ = frame.to_grid(np.radians(50.0), np.radians(9.02))
    s = np.arange(len(curvature), dtype=float)
    height = 180.0 + 0.002 * s + 8.0 * np.sin(2 * np.pi * s / 3000.0)
    return Axis(float(east0) + integral(np.sin), float(north0) + integral(np.cos), height, theta, curvature, s)


@dataclass(frozen=True)
class Receiver:
    """How a receiver errs: white and correlated sigma, m; correlation time, s; fixes a second; frame offset, m."""

    name: str = "survey"
    white: float = 0.017
    correlated: float = 0.010
    memory: float = 60.0
    rate: float = 5.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stated: float | None = 1.0


@dataclass(frozen=True)
class Gyros:
    """Gyroscopic angles and odometer: white sigma of a reading and bias, rad; walk, rad per sqrt(s); scale error of the odometer."""

    white: float = 2e-4
    bias: float = 2e-3
    walk: float = 1e-5
    scale: float = 5e-4

    def streams(self, axis: Axis, frame: GridFrame, rng, time, s, backwards: bool) -> dict:
        """The streams of a drive that was at offset s at each time."""
        dt = np.diff(time, prepend=time[0])

        def wrong():
            return (
                self.bias * rng.standard_normal()
                + np.cumsum(self.walk * np.sqrt(dt) * rng.standard_normal(len(time)))
                + self.white * rng.standard_normal(len(time))
            )

        east, north, _ = axis.at(s)
        # bearing and gradient of the shifted track itself, not of the line's centre
        tangent = np.arctan2(np.gradient(axis.east), np.gradient(axis.north))
        bearing = np.interp(s, axis.arc, np.unwrap(tangent)) + (np.pi if backwards else 0.0)
        slope = np.interp(s, axis.arc, np.gradient(axis.height, axis.arc)) * (-1.0 if backwards else 1.0)
        heading = bearing + frame.convergence(east, north)
        return {
            "gyro_angles": GyroAnglesStream(
                time=time, roll=np.zeros(len(time)), pitch=np.arctan(slope) + wrong(), heading=heading + wrong()
            ),
            "odometer": OdometerStream(
                time=time,
                distance=np.cumsum(np.abs(np.diff(s, prepend=s[0]))) * (1.0 + self.scale * rng.standard_normal()),
            ),
        }


SURVEY = Receiver()
PHONE = Receiver("phone", white=0.8, correlated=2.5, memory=40.0, rate=1.0)


def plane() -> GridFrame:
    """The plane of the simulated line."""
    return choose_frame(np.radians([49.9, 50.1]), np.radians([9.0, 9.2]))


def drive(
    axis: Axis, frame: GridFrame, rng, *, run_id: str, direction: str = "", receiver: Receiver = SURVEY, speed: float = 22.0,
    stop: float = 120.0, begin: float = 0.0, end: float = 1.0, backwards: bool = False, day: int = 0, gyros: Gyros | None = None,
    tunnels: tuple[tuple[float, float], ...] = (),
) -> Run:  # fmt: skip
    """One drive over a part of a track, with one stop; no fixes in `tunnels` (shares of the track)."""
    length = axis.arc[-1]
    v = speed * rng.uniform(0.85, 1.15)
    travel = (end - begin) * length / v
    time = np.arange(0.0, travel + stop, 1.0 / receiver.rate)
    halt = rng.uniform(0.3, 0.7) * travel
    moving = np.where(time < halt, time, np.maximum(halt, time - stop))
    s = np.clip(begin * length + v * moving, 0.0, length)
    if backwards:
        s = (begin + end) * length - s
    east, north, height = axis.at(s)

    def error(scale):
        phi = np.exp(-1.0 / (receiver.rate * receiver.memory))
        drift = lfilter(
            [1.0], [1.0, -phi], np.sqrt(1 - phi**2) * rng.standard_normal(len(s)), zi=[phi * rng.standard_normal()]
        )[0]
        return scale * (receiver.white * rng.standard_normal(len(s)) + receiver.correlated * drift)

    latitude, longitude, up = frame.to_geodetic(
        east + error(1.0) + receiver.offset[0],
        north + error(1.0) + receiver.offset[1],
        height + error(2.0) + receiver.offset[2],
    )
    total = np.full(len(s), np.hypot(receiver.white, receiver.correlated))
    says = receiver.stated is not None
    stream = GnssStream(
        time=time,
        latitude=latitude,
        longitude=longitude,
        height=up,
        sigma_east=total * receiver.stated if says else None,
        sigma_north=total * receiver.stated if says else None,
        receiver=receiver.name,
    )
    run = Run(id=run_id, start=START.replace(day=4 + day), direction=direction, gnss=stream)
    if gyros is not None:
        run = replace(run, **gyros.streams(axis, frame, rng, time, s, backwards))
    dark = np.zeros(len(s), bool)
    for a, b in tunnels:
        dark |= (s > a * length) & (s < b * length)
    return only(run, ~dark) if dark.any() else run


def double_line(
    seed: int, *, km: float = 8.0, passes: int = 3, gap: float = 4.0, receivers=(SURVEY,), directions=("up", "down")
):
    """Runs over both tracks of a double line, the true tracks by name, and the plane."""
    rng = np.random.default_rng([seed, 1])
    frame = plane()
    centre = centre_line(seed, km, frame=frame)
    truth = {"up": centre.shifted(0.5 * gap), "down": centre.shifted(-0.5 * gap)}
    runs = [
        drive(
            truth[name], frame, rng, run_id=f"{name}-{p + 1}", direction=label, receiver=receivers[p % len(receivers)],
            backwards=name == "down", day=p,
        )
        for name, label in zip(("up", "down"), directions, strict=True)
        for p in range(passes)
    ]  # fmt: skip
    return runs, truth, frame


def changed(run: Run, **columns) -> Run:
    """The run with some columns of its GNSS replaced."""
    return replace(run, gnss=replace(run.gnss, **columns))


def only(run: Run, keep) -> Run:
    """The run with some of its fixes."""
    gnss = run.gnss
    columns = {
        name: getattr(gnss, name)[keep]
        for name in gnss.__dataclass_fields__
        if isinstance(getattr(gnss, name), np.ndarray) and name != "lever_arm_b"
    }
    return replace(run, gnss=replace(gnss, **columns))


def knots(model, track: str) -> slice:
    """The knots of a track."""
    i = model.track_index(track)
    return slice(int(model.knot_start[i]), int(model.knot_start[i + 1]))


def axis_error(model, track: str, axis: Axis):
    """Error of the model's axis across the track at its knots, its stated sigma, m, and the normal there."""
    k = knots(model, track)
    error, _ = axis.right_of(model.easting[k], model.northing[k])
    east, north = np.cos(model.grid_bearing[k]), -np.sin(model.grid_bearing[k])
    C = model.covariance_g[k]
    sigma = np.sqrt(C[:, 0] * east**2 + 2 * C[:, 1] * east * north + C[:, 3] * north**2)
    # the axis may be nominated from either end: right of it is then left of the truth, errors are of the place all the same
    return error, sigma
