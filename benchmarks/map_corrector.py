"""The map-constrained road scheme on its three-lobed loop, simulated: the source's literal corrector and what replaces it.

Run `python benchmarks/map_corrector.py [--trials 40] [--json PATH]`. A near-circular road of 1.2 km with hills, 9 to 15 m/s; IMU at 10 Hz
with the white noise of L3G4200D and LSM303DLH and no systematic errors (unless said), GNSS at 1 Hz with 3 m in each axis; map of points
1 m apart. Root mean square over each run of 300 s; bars: 3 m, 0.23 m/s, 30 arc minutes.
"""

from __future__ import annotations

import argparse
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from railnav.attitude import dcm_from_euler
from railnav.geodesy.ellipsoid import WGS84
from railnav.inertial import GravityField, NavigationState, mechanize
from railnav.navigation.schemes.map_constrained import PointMap, map_constrained
from railnav.simulation.inertial import interval_means

DEGREE = np.pi / 180
LATITUDE, LONGITUDE, HEIGHT = 55.75 * DEGREE, 37.6 * DEGREE, 150.0
#: Noise of one sample at 10 Hz: 0.03 deg/s/sqrt(Hz) and 218 ug/sqrt(Hz) over 50 Hz.
GYRO, FORCE = 0.03 * DEGREE * np.sqrt(50.0), 218e-6 * 9.81 * np.sqrt(50.0)
FIELD = GravityField(free_air="linear")  # as the simulator


@cache
def loop(points: int = 200_001) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The road: parameter, way, m, and east, north, up, m."""
    angle = np.linspace(0, 2 * np.pi, points)
    r = 180.0 * (1 + 0.12 * np.cos(3 * angle))
    x = np.stack([r * np.cos(angle), r * np.sin(angle), 2.5 * np.sin(2 * angle)], axis=1)
    return angle, np.append(0.0, np.cumsum(np.linalg.norm(np.diff(x, axis=0), axis=1))), x


def geodetic(x: np.ndarray) -> np.ndarray:
    """Latitude, longitude, height of east, north, up about the loop's centre."""
    s, c, sl, cl = np.sin(LATITUDE), np.cos(LATITUDE), np.sin(LONGITUDE), np.cos(LONGITUDE)
    axes = np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
    centre = np.array(WGS84.to_cartesian(LATITUDE, LONGITUDE, HEIGHT)).ravel()
    return np.stack(WGS84.to_geodetic(*(centre + x @ axes).T), axis=1)


@cache
def truth(duration: float, interval: float, held: bool = False) -> dict[str, np.ndarray]:
    """The drive: states at the ends of samples, and what an ideal IMU says (means, or values at the beginning of each interval)."""
    from scipy.interpolate import make_interp_spline

    angle, way, _ = loop()
    knots = np.arange(-2.0, duration + 2.0, 0.25)
    run = 12.0 * (knots + 5) - 30.0 * (np.cos(0.1 * (knots + 5)) - 1)
    a = np.interp(np.mod(run, way[-1]), way, angle)
    r = 180.0 * (1 + 0.12 * np.cos(3 * a))
    path = make_interp_spline(knots, np.stack([r * np.cos(a), r * np.sin(a), 2.5 * np.sin(2 * a)], axis=1), k=7)
    fine = 20 if held else 1
    t = np.arange(round(duration / interval) * fine + 1) * interval / fine
    place = geodetic(path(t))
    # velocities in the axes of the place
    s, c, sl, cl = np.sin(LATITUDE), np.cos(LATITUDE), np.sin(LONGITUDE), np.cos(LONGITUDE)
    axes = np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
    v_e = path(t, 1) @ axes
    sp, cp, so, co = np.sin(place[:, 0]), np.cos(place[:, 0]), np.sin(place[:, 1]), np.cos(place[:, 1])
    north = -sp * co * v_e[:, 0] - sp * so * v_e[:, 1] + cp * v_e[:, 2]
    east = -so * v_e[:, 0] + co * v_e[:, 1]
    down = -cp * co * v_e[:, 0] - cp * so * v_e[:, 1] - sp * v_e[:, 2]
    v = np.stack([north, east, down], axis=1)
    heading, pitch = np.arctan2(east, north), np.arcsin(-down / np.linalg.norm(v, axis=1))
    attitude = dcm_from_euler(np.zeros(len(t)), pitch, heading)
    w, f = interval_means(t, place[:, 0], place[:, 2], v, attitude)
    at = slice(None, None, fine)
    return {
        "time": t[at],
        "place": place[at],
        "velocity": v[at],
        "heading": heading[at],
        "pitch": pitch[at],
        "attitude": attitude[at],
        "rate": w[::fine],
        "force": f[::fine],
    }


def road_map(step: float = 1.0, chord: float | None = None) -> PointMap:
    """The map: points on the road, or on chords of it."""
    _, way, x = loop()
    vertices = np.arange(0.0, way[-1], chord or 0.25)
    place = geodetic(np.stack([np.interp(vertices, way, c) for c in x.T], axis=1))
    return PointMap.from_line(*place.T, step=step, closed=True)


def trial(seed: int, corrector: str, way: PointMap, *, duration: float = 300.0, **options: Any) -> np.ndarray:
    """One run: errors along, across and up, m, speed, m/s, heading, minutes, share of INS, total of the last 200 s, m."""
    drive = truth(duration, 0.1)
    rng = np.random.default_rng(seed)
    bias = options.pop("bias", (0.0, 0.0))
    x = np.stack(WGS84.to_cartesian(*drive["place"].T), axis=1)
    rows = np.arange(10, len(x), 10)
    gnss = x[rows] + rng.normal(0, 3.0, (len(rows), 3))
    w = drive["rate"] + rng.normal(0, GYRO, drive["rate"].shape) + bias[0] * rng.normal(size=3)
    f = drive["force"] + rng.normal(0, FORCE, drive["force"].shape) + bias[1] * rng.normal(size=3)
    start = NavigationState.from_dcm(*drive["place"][0], velocity_n=drive["velocity"][0], C_nb=drive["attitude"][0])
    found = map_constrained(
        start,
        drive["time"][1:],
        w,
        f,
        drive["time"][rows],
        gnss,
        way,
        start_time=0.0,
        corrector=corrector,  # type: ignore[arg-type]
        gravity=FIELD,
        **options,
    )
    tr = found.trajectory
    e = np.stack(WGS84.to_cartesian(tr.latitude, tr.longitude, tr.height), axis=1) - x
    along = np.gradient(x, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    ahead = (e * along).sum(axis=1)
    aside = np.sqrt(np.maximum((e**2).sum(axis=1) - ahead**2, 0.0))
    speed = np.linalg.norm(tr.velocity_n, axis=1) - np.linalg.norm(drive["velocity"], axis=1)
    turn = (tr.euler()[2] - drive["heading"] + np.pi) % (2 * np.pi) - np.pi
    late = drive["time"] > 10.0

    def rms(a: np.ndarray) -> float:
        return float(np.sqrt((a**2).mean()))

    return np.array(
        [
            rms(ahead),
            rms(aside),
            rms(speed),
            rms(turn) / DEGREE * 60,
            found.ins_chosen,
            rms(np.linalg.norm(e[late], axis=1)),
        ]
    )


def method_error() -> dict[str, float]:
    """Velocity error of a free run of 60 s, per cent of the speed: held samples against means, first order against exponential."""
    result = {}
    for interval in (0.1, 0.01):
        for name, held, scheme in (
            ("first order, held samples", True, "predictor_first_order"),
            ("exponential, held samples", True, "predictor"),
            ("exponential, means", False, "predictor"),
        ):
            drive = truth(60.0, interval, held)
            start = NavigationState.from_dcm(
                *drive["place"][0], velocity_n=drive["velocity"][0], C_nb=drive["attitude"][0]
            )
            got = mechanize(start, interval, drive["rate"], drive["force"], scheme=scheme, gravity=FIELD)  # type: ignore[arg-type]
            error = np.abs(got.velocity_n - drive["velocity"]).max()
            result[f"{name}, {interval:g} s"] = 100 * float(error / np.linalg.norm(drive["velocity"], axis=1).mean())
    return result


#: Name, corrector, options, map options, figures of the specification (along, across, speed, heading).
CASES: tuple[tuple[str, str, dict[str, Any], dict[str, Any], tuple[float, ...] | None], ...] = (
    ("literal (10)-(12), window 50 m", "literal", {}, {}, (27.1, 3.5, 9.5, 1762)),
    ("literal, window 9 m", "literal", {"window": 9.0}, {}, (6.2, 0.45, 4.5, 1290)),
    ("literal, map step 0.05 m", "literal", {}, {"step": 0.05}, (26.5, 3.4, 8.8, 1448)),
    (
        "+ half interval, 0.05 m, first order",
        "literal_half_interval",
        {"first_order": True},
        {"step": 0.05},
        (21.4, 2.4, 4.1, 995),
    ),
    ("+ half interval, 0.05 m, exponential", "literal_half_interval", {}, {"step": 0.05}, None),
    ("GNSS candidate always", "gnss", {}, {}, (4.6, 0.42, 4.1, 624)),
    ("arc length (0.15, 0.012)", "arc", {}, {}, (1.12, 0.03, 0.096, 24.8)),
    ("arc length, 15 m chords", "arc", {}, {"chord": 15.0}, (1.09, 0.19, 0.096, 81)),
    ("arc length (0.4, 0.12), biases", "arc", {"alpha": 0.4, "beta": 0.12, "bias": (0.2 * DEGREE, 0.2)}, {}, None),
    ("arc length, same biases", "arc", {"bias": (0.2 * DEGREE, 0.2)}, {}, (15.0, 1.5, 2.5, 310)),
)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    result: dict[str, Any] = {}
    print(
        "corrector, 300 s, rms: along m, across and up m, speed m/s, heading ', INS chosen; figures of the specification"
    )
    for name, corrector, settings, of_map, own in CASES:
        way = road_map(**of_map)
        runs = np.array([trial(seed, corrector, way, **dict(settings)) for seed in range(options.trials)])
        mean = np.sqrt((runs**2).mean(axis=0))
        told = "" if own is None else "   " + " ".join(f"{v:g}" for v in own)
        print(f"  {name:38}{mean[0]:8.2f}{mean[1]:8.2f}{mean[2]:8.3f}{mean[3]:9.1f}{runs[:, 4].mean():6.2f}{told}")
        result[name] = dict(
            zip(
                ("along_m", "across_m", "speed_m_s", "heading_arcmin", "ins_chosen", "total_after_10_s_m"),
                mean.tolist(),
                strict=True,
            )
        )
    print("bars: 3 m, 0.23 m/s, 30'")
    errors = method_error()
    print("velocity error of 60 s free run, per cent: " + "; ".join(f"{k} {v:.4f}" for k, v in errors.items()))
    result["method error, per cent"] = errors
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
