"""Design values: radii and lengths of transitions as a designer would have written them, where the points allow.

A value is rounded as coarsely as its sigma lets it; the elements are then adjusted again with the rounded values held.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from railnav.monitoring.fitting.judgement import items_of
from railnav.monitoring.fitting.plan import PlanFit, fit_plan
from railnav.track import elements

FloatArray = NDArray[np.float64]

#: Steps to which radii and lengths are rounded, the coarsest first, m.
RADIUS_STEPS = (1000.0, 500.0, 100.0, 50.0, 25.0, 10.0, 5.0, 1.0, 0.5)
LENGTH_STEPS = (10.0, 5.0, 1.0, 0.5)
#: A value may move by this many sigmas.
_WITHIN = 2.0
#: And a coarse step must be larger than this many sigmas, or any value would do: it would be a guess.
_TELLING = 3.0


def round_value(value: float, sigma: float, steps: tuple[float, ...]) -> float | None:
    """The roundest value within two sigmas, None where even the finest step is finer than what is known.

    Examples
    --------
    >>> round_value(599.91, 0.06, RADIUS_STEPS), round_value(80.2, 0.3, LENGTH_STEPS), round_value(80.2, 9.0, LENGTH_STEPS)
    (600.0, 80.0, None)
    """
    for step in steps:
        near = round(value / step) * step
        if near != 0.0 and abs(near - value) <= _WITHIN * sigma and step >= _TELLING * sigma:
            return float(near)
    return None


def round_design(
    fit: PlanFit,
    east: FloatArray,
    north: FloatArray,
    radius_sigma: FloatArray,
    length_sigma: FloatArray,
    *,
    scale: float = 1.0,
) -> tuple[PlanFit, int]:
    """The fit with radii of arcs and lengths of transitions rounded and held, and how many were.

    Parameters
    ----------
    fit : PlanFit
    east, north : (n,) array
        The points, m.
    radius_sigma, length_sigma : (m,) array
        m.
    scale : float
        Values are rounded on the ground: in the plane they are this many times larger.
    """
    chain = fit.chain
    m = len(chain.kind)
    held = np.zeros(m + len(chain.bend), bool)
    bend, length = chain.bend.copy(), chain.length.copy()
    for j, item in enumerate(items_of(chain)):
        if item.kind == elements.ARC:
            radius = 1.0 / item.k0 / scale
            near = round_value(abs(radius), float(radius_sigma[j]) / scale, RADIUS_STEPS)
            if near is not None:
                held[m + chain.first[j]] = True
                bend[chain.first[j]] = np.sign(radius) / (near * scale)
        elif item.kind >= elements.CLOTHOID and j < m - 1:
            near = round_value(item.length / scale, float(length_sigma[j]) / scale, LENGTH_STEPS)
            if near is not None:
                held[j] = True
                length[j] = near * scale
    count = int(held.sum())
    if not count:
        return fit, 0
    from dataclasses import replace

    start = replace(chain, bend=bend, length=length)
    return fit_plan(start, fit.along, east, north, fit.noise, held=held), count
