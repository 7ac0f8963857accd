"""What is wrong with an inertial log before anything is computed from it: clock, gaps, dead or saturated axes, units, axes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.units import STANDARD_GRAVITY

FloatArray = NDArray[np.float64]
Kind = Literal["clock", "gap", "not finite", "frozen", "saturated", "unit", "axes"]

#: No land vehicle turns faster than this for a hundredth of the time, rad/s.
FASTEST_TURN = 3.0
#: A value held for this long is a held value, s.
FROZEN_TIME = 1.0
#: A gap is an interval longer than this many median intervals.
GAP_FACTOR = 5.0
#: Accelerometers that scatter less than this are still, m/s^2; then no gyro scatters more than this, rad/s.
STILL_FORCE, NOISIEST_GYRO = 0.5, 0.03
_CHANNELS = ("rate x", "rate y", "rate z", "specific force x", "specific force y", "specific force z")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong with a log.

    Attributes
    ----------
    kind : str
        "clock", "gap", "not finite", "frozen", "saturated", "unit" or "axes".
    channel : str
        Which one; empty for the clock.
    first, count : int
        First sample concerned, and how many.
    sentence : str
        What, where, and what would work.
    """

    kind: Kind
    channel: str
    first: int
    count: int
    sentence: str


def inspect_log(time: ArrayLike, rate_ib_b: ArrayLike, specific_force_b: ArrayLike) -> tuple[Finding, ...]:
    """Everything suspicious in an inertial log, in the order in which it should be repaired; empty if nothing is.

    Parameters
    ----------
    time : (n,) array
        s.
    rate_ib_b, specific_force_b : (n, 3) array
        Meant to be rad/s and m/s^2, forward, right, down. Values that are not finite are allowed here: they are found.

    Returns
    -------
    tuple of Finding

    Raises
    ------
    ValueError
        Shapes that do not fit, or fewer than 50 samples.

    Notes
    -----
    Rules. Clock: a time that does not increase. Gap: above five median intervals. Frozen: a channel that never changes, or holds one value
    for a second and 50 samples while its usual step is shorter. Saturated: an extreme value held for three samples or more, over eight
    robust sigmas from the median. Unit: a median specific force of 1 (g), 1000 (mg) or 981 (Gal), rates that no land vehicle reaches
    (degrees), or rates that scatter by 1.7 deg/s while the accelerometers are still. Axes: gravity mostly on another axis than
    down. Degrees per second of a very quiet gyro at rest are not recognised.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(0.0, 0.01, (2, 500, 3))
    >>> found = inspect_log(np.arange(500) * 0.01, noise[0], noise[1] + [0.0, 0.0, 1.0])
    >>> [f.kind for f in found], found[0].sentence[:43]
    (['unit', 'axes'], 'the specific force is 1.000 long: it is in ')
    """
    t = np.asarray(time, dtype=np.float64)
    w, f = (np.asarray(v, dtype=np.float64) for v in (rate_ib_b, specific_force_b))
    if t.ndim != 1 or w.shape != (len(t), 3) or f.shape != (len(t), 3):
        raise ValueError(f"needs time (n,), rates and specific forces (n, 3), not {t.shape}, {w.shape}, {f.shape}")
    if len(t) < 50:
        raise ValueError(f"{len(t)} samples are too few to judge a log; at least 50")
    found = _clock(t)
    step = float(np.median(np.abs(np.diff(t)))) if np.isfinite(t).all() else math.nan
    for k, name in enumerate(_CHANNELS):
        found += _channel(name, (w if k < 3 else f)[:, k % 3], step)
    good = np.isfinite(f).all(axis=1)
    if np.any(good):
        found += _force(f[good])
    turning = np.linalg.norm(w[np.isfinite(w).all(axis=1)], axis=1)
    if turning.size and float(np.percentile(turning, 99.0)) > FASTEST_TURN:
        first = int(np.argmax(np.linalg.norm(w, axis=1) > FASTEST_TURN))
        found.append(
            Finding(
                "unit",
                "rate",
                first,
                int(np.sum(turning > FASTEST_TURN)),
                f"one rate in a hundred exceeds {np.percentile(turning, 99.0):.1f} rad/s, which no land vehicle does: "
                "they are in degrees per second; multiply them by pi/180",
            )
        )
    elif turning.size and np.any(good) and not any(one.kind == "unit" for one in found):
        found += _degrees_at_rest(w, f)
    return tuple(found)


def _degrees_at_rest(w: FloatArray, f: FloatArray) -> list[Finding]:
    """Rates that scatter as no gyro does while the accelerometers are still."""
    both = np.isfinite(f).all(axis=1) & np.isfinite(w).all(axis=1)
    if np.sum(both) < 50 or float(f[both].std(axis=0).max()) > STILL_FORCE:
        return []
    scatter = float(np.median(np.diff(w[both], axis=0).std(axis=0))) / math.sqrt(2.0)
    if scatter <= NOISIEST_GYRO:
        return []
    return [
        Finding(
            "unit",
            "rate",
            0,
            int(np.sum(both)),
            f"the rates scatter by {scatter:.3f} rad/s from sample to sample while the accelerometers are still, as no gyro does: they are "
            "in degrees per second; multiply them by pi/180",
        )
    ]


def _clock(t: FloatArray) -> list[Finding]:
    bad = np.flatnonzero(~np.isfinite(t))
    if bad.size:
        return [
            Finding("not finite", "", int(bad[0]), bad.size, f"time of sample {bad[0]} is not finite; drop the row")
        ]
    step = np.diff(t)
    found = []
    back = np.flatnonzero(step <= 0.0)
    if back.size:
        k = int(back[0]) + 1
        found.append(
            Finding(
                "clock",
                "",
                k,
                back.size,
                f"time does not increase at sample {k} ({t[k - 1]:.3f} s, then {t[k]:.3f} s): sort the rows, or cut the log where the "
                "clock was set",
            )
        )
    forward = step[step > 0.0]
    usual = float(np.median(forward)) if forward.size else math.inf
    wide = np.flatnonzero(step > GAP_FACTOR * usual)
    if wide.size:
        k = int(wide[np.argmax(step[wide])])
        found.append(
            Finding(
                "gap",
                "",
                k + 1,
                wide.size,
                f"{wide.size} gaps, the longest of {step[k]:.2f} s before sample {k + 1} (usual interval {usual:.4f} s): "
                "a strapdown run cannot bridge it without an aid",
            )
        )
    return found


def _channel(name: str, x: FloatArray, step: float) -> list[Finding]:
    bad = np.flatnonzero(~np.isfinite(x))
    found = []
    if bad.size:
        what = "missing" if bad.size == len(x) else f"not finite at {bad.size} samples, first {bad[0]}"
        found.append(
            Finding("not finite", name, int(bad[0]), bad.size, f"{name} is {what}; the axis cannot be used there")
        )
    y = x[np.isfinite(x)]
    if len(y) < 2:
        return found
    if np.ptp(y) == 0.0:
        return [
            *found,
            Finding("frozen", name, 0, len(y), f"{name} is {y[0]:g} all the time: the axis is frozen or missing"),
        ]
    # runs of equal values
    change = np.flatnonzero(np.concatenate([[True], np.diff(x) != 0.0, [True]]))
    run = np.diff(change)
    longest = int(np.argmax(run))
    usual = float(np.median(run))
    length = int(run[longest])
    first = int(change[longest])
    held = step * length if math.isfinite(step) else 0.0
    centre = float(np.median(y))
    sigma = 1.4826 * float(np.median(np.abs(y - centre)))
    extreme = [
        k
        for k in np.flatnonzero(run >= 3)
        if x[change[k]] in (y.max(), y.min()) and abs(x[change[k]] - centre) > max(8.0 * sigma, 1e-12) and sigma > 0.0
    ]
    if extreme:
        k = int(change[extreme[0]])
        count = int(run[extreme].sum())
        found.append(
            Finding(
                "saturated",
                name,
                k,
                count,
                f"{name} stands at {x[k]:g} for {count} samples from sample {k}: the sensor is at the end of its range",
            )
        )
    elif length >= 50 and held >= FROZEN_TIME and length > 20.0 * usual:
        found.append(
            Finding(
                "frozen",
                name,
                first,
                length,
                f"{name} holds {x[first]:g} for {held:.1f} s from sample {first}: the axis froze or the logger repeated a value",
            )
        )
    return found


def _force(f: FloatArray) -> list[Finding]:
    found = []
    length = float(np.median(np.linalg.norm(f, axis=1)))
    for size, unit, factor in (
        (1.0, "g", STANDARD_GRAVITY),
        (1000.0, "mg", STANDARD_GRAVITY / 1e3),
        (980.665, "Gal", 0.01),
    ):
        tolerance = 0.1 if size == 1.0 else 0.009
        if abs(length / size - 1.0) < tolerance:
            found.append(
                Finding(
                    "unit",
                    "specific force",
                    0,
                    len(f),
                    f"the specific force is {length:.3f} long: it is in {unit}; multiply it by {factor:.6g}",
                )
            )
            break
    else:
        if not 0.75 < length / STANDARD_GRAVITY < 1.25:  # 0.2 g of bias are found in telephones
            found.append(
                Finding(
                    "unit",
                    "specific force",
                    0,
                    len(f),
                    f"the specific force is {length:.3f} long, not gravity in any unit known here: an axis is missing, the unit is "
                    "wrong, or gravity was taken off by the sensor",
                )
            )
            return found  # nothing tells where down is
    mean = np.median(f, axis=0)
    axis = int(np.argmax(np.abs(mean)))
    if np.abs(mean[axis]) > 0.8 * np.linalg.norm(mean) and not (axis == 2 and mean[2] < 0.0):
        side = "+" if mean[axis] > 0 else "-"
        remedy = "turn the signs of y and z" if axis == 2 else "reorder the axes"
        found.append(
            Finding(
                "axes",
                "specific force",
                0,
                len(f),
                f"gravity is felt on {side}{'xyz'[axis]}, not on -z: the axes are not forward, right, down; "
                f"{remedy}, or state the mounting",
            )
        )
    return found
