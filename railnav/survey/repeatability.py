"""How well the axis repeats: each run's own axis against that of another date by the same kind of receiver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.survey.axis import Chain, solve, sweep
from railnav.survey.fixes import Fixes
from railnav.survey.offsets import Offsets
from railnav.survey.surveyed import Surveyed, cross_chain

FloatArray = NDArray[np.float64]

#: Bars of the histogram.
BARS = 24
#: Nodes farther than this from a fix of a run say nothing of it, m.
NEAR = 60.0


def repeatability(fixes: Sequence[Fixes], tracks: Sequence[Surveyed], offsets: Offsets) -> list[dict[str, Any]]:
    """Differences of axes from single runs of different dates, frame offsets removed, as a histogram for each kind of receiver.

    Returns
    -------
    list of dict
        `receiver`, `pairs` (of runs), `points`, `rms_m`, `median_m` and `q95_m` (of the absolute difference), `edges_m` and `counts`.
    """
    found: dict[str, list[FloatArray]] = {}
    for t in tracks:
        alone: dict[int, FloatArray] = {}
        for k, i in enumerate(t.runs):
            same = [j for j in t.runs if fixes[j].receiver == fixes[i].receiver and _date(fixes[j]) != _date(fixes[i])]
            if same:
                alone[k] = _axis_of(t, k, offsets)
        for a in alone:
            for b in alone:
                i, j = t.runs[a], t.runs[b]
                if b > a and fixes[i].receiver == fixes[j].receiver and _date(fixes[i]) != _date(fixes[j]):
                    both = alone[a] - alone[b]
                    found.setdefault(fixes[i].receiver, []).append(both[np.isfinite(both)])
    out = []
    for name in sorted(found):
        d = np.concatenate(found[name])
        if not len(d):
            continue
        reach = max(float(np.quantile(np.abs(d), 0.99)), 1e-4)
        edges = np.linspace(-reach, reach, BARS + 1)
        counts, _ = np.histogram(d, edges)
        out.append(
            {
                "receiver": name,
                "pairs": len(found[name]),
                "points": len(d),
                "rms_m": round(float(np.sqrt(np.mean(d**2))), 4),
                "median_m": round(float(np.median(np.abs(d))), 4),
                "q95_m": round(float(np.quantile(np.abs(d), 0.95)), 4),
                "edges_m": [round(float(e), 4) for e in edges],
                "counts": [int(c) for c in counts],
            }
        )
    return out


def _date(f: Fixes) -> str:
    return f.run.start.date().isoformat()


def _axis_of(t: Surveyed, k: int, offsets: Offsets) -> FloatArray:
    """The axis as one run alone gives it, (N,), relative to the nominal curve; NaN away from its fixes."""
    from scipy.ndimage import maximum_filter1d

    whole = cross_chain(t, offsets.run, 0.0)
    part = slice(k, k + 1)
    value = whole.value[part] - (whole.design[part] @ offsets.run[t.runs[k]])
    chain: Chain = replace(
        whole,
        value=value,
        lead=whole.lead[part],
        variance=whole.variance[part],
        time=whole.time[part],
        design=whole.design[part],
        errors=[t.errors[k]],
        slopes=None if whole.slopes is None else whole.slopes.of(k),
    )
    axis = solve(chain, sweep(chain, borders=False), np.zeros(0), np.zeros((0, 0)), sure=False).state[:, 0]
    here = maximum_filter1d(np.isfinite(value[0]).astype(np.int8), 2 * max(1, round(NEAR / t.nominal.step)) + 1) > 0
    return np.where(here, axis, np.nan)
