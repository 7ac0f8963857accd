"""Orientation update under coning and under large turns: the tables and the figure of docs/theory/inertial.md.

Run `python benchmarks/orientation.py [--figure PATH.svg] [--json PATH]`. Coning is known in closed form: attitude, rate and the integral of
the rate. Drift is what the update makes about the cone's axis, per square of the half cone angle and per radian of the coning motion.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from railnav.attitude import (
    propagate,
    quaternion_multiply,
    rotation_vector_from_increments,
    rotation_vector_from_quaternion,
    rotation_vector_from_rates,
)

STEPS = (1, 2, 3, 4)
KINDS = ("increments", "rates")
#: Leading term of the drift: coefficient and power of the coning per sampling step.
THEORY = {1: (-1 / 12, 2), 2: (-1 / 60, 4), 3: (1 / 80, 4), 4: (2 / 189, 6)}


def drift(kind: str, n: int, w: float, *, half_angle: float = 1e-2, third_order: str = "none") -> float:
    """Drift for n sampling steps an update and w radians of coning a sampling step."""
    steps = max(40, round(2 * np.pi * 40 / (n * w)))
    t = np.arange(n * steps + 1) * w
    s, c, sweep = np.sin(t), np.cos(t), 2 * np.sin(half_angle / 2) ** 2
    rate = np.stack([-np.sin(half_angle) * s, np.sin(half_angle) * c, np.full_like(t, -sweep)], axis=-1)
    integral = np.stack([np.sin(half_angle) * c, np.sin(half_angle) * s, -sweep * t], axis=-1)
    attitude = np.stack(
        [np.full_like(t, np.cos(half_angle / 2)), np.sin(half_angle / 2) * c, np.sin(half_angle / 2) * s, 0 * t],
        axis=-1,
    )
    if kind == "rates":
        index = n * np.arange(steps)[:, None] + np.arange(n + 1)
        phi = rotation_vector_from_rates(rate[index], n * w, third_order=third_order)  # type: ignore[arg-type]
    else:
        parts = np.diff(integral, axis=0).reshape(steps, n, 3)
        phi = rotation_vector_from_increments(parts, third_order=third_order)  # type: ignore[arg-type]
    end = propagate(attitude[0], phi)[-1]
    error = rotation_vector_from_quaternion(quaternion_multiply(end, attitude[-1] * [1, -1, -1, -1]))
    return float(error[2] / (half_angle**2 * t[-1]))


def large_turn(H: float) -> dict[str, float]:
    """Rms error of one double step under linear rates of some 2 rad/s and 6 rad/s^2, rad (A9.1)."""
    rng = np.random.default_rng(4)
    a, b = (
        np.array(v) for v in zip(*[(rng.normal(size=3) * 2, rng.normal(size=3) * 6) for _ in range(12)], strict=True)
    )
    h, t = H / 400, np.arange(400) * H / 400
    first, last = (a[:, None] + b[:, None] * x[:, None] for x in (t, t + h))
    fine = 0.5 * (first + last) * h + np.cross(first, last) * h * h / 12
    exact = [rotation_vector_from_quaternion(propagate([1.0, 0, 0, 0], f)[-1]) for f in fine]
    pair = np.stack([a * H / 2 + b * H * H / 8, a * H / 2 + 3 * b * H * H / 8], axis=1)
    errors = {}
    for kind in ("none", "bortz", "complete"):
        phi = rotation_vector_from_increments(pair, third_order=kind, longest=3.0)  # type: ignore[arg-type]
        errors[kind] = float(np.sqrt(np.mean(np.sum((phi - exact) ** 2, axis=-1))))
    return errors


def draw(path: Path) -> None:
    """Drift against coning per sampling step, with the slopes of theory."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams["svg.hashsalt"] = "railnav"
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.0, 4.5), layout="constrained")
    w = np.geomspace(0.03, 1.0, 25)
    for n, colour in zip(STEPS, ("#d1495b", "#edae49", "#30638e", "#00798c"), strict=True):
        coefficient, power = THEORY[n]
        axes.loglog(w, np.abs(coefficient) * w**power, color=colour, lw=0.8, ls="--")
        lowest = 3e-10  # below it rounding counts, not the algorithm
        for kind, marker in zip(KINDS, ("o", "x"), strict=True):
            y = np.array([abs(drift(kind, n, x)) for x in w])
            shown = y > lowest
            axes.loglog(w[shown], y[shown], marker, ms=4, color=colour, label=f"{n} step{'s' * (n > 1)}, {kind}")
    axes.set_ylim(1e-10, 0.3)
    axes.set_xlabel("coning per sampling step, rad")
    axes.set_ylabel("drift per (half cone angle)^2 and radian")
    axes.set_title("Orientation update under coning: orders 2, 4, 4, 6 (dashed: leading terms)", fontsize=10)
    axes.legend(fontsize=7, ncols=2)
    axes.grid(visible=True, which="major", lw=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    result: dict[str, object] = {}
    print("drift under coning, by coning per sampling step w, rad")
    print(f"{'samples a step':18}{'w = 0.1':>11}{'0.3':>11}{'1.0':>11}{'order':>8}")
    for kind in KINDS:
        for n in STEPS:
            row = [drift(kind, n, w) for w in (0.1, 0.3, 1.0)]
            order = float(np.log2(abs(drift(kind, n, 0.4, half_angle=1e-3) / drift(kind, n, 0.2, half_angle=1e-3))))
            count = n + (kind == "rates")
            print(f"{count} {kind:16}" + "".join(f"{v:11.2e}" for v in row) + f"{order:8.2f}")
            result[f"{kind} {n}"] = {"drift": row, "order": order}
    print("\nrms error of one double step, linear rates, rad")
    print(f"{'step, s':10}{'second order':>14}{'UA(13)':>11}{'UA(14)':>11}")
    for H in (0.4, 0.2, 0.1, 0.05):
        errors = large_turn(H)
        print(f"{H:<10g}{errors['none']:14.2e}{errors['bortz']:11.2e}{errors['complete']:11.2e}")
        result[f"double step {H:g}"] = errors
    if options.figure:
        draw(options.figure)
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
