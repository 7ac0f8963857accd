"""Geometry of railML net elements: curves and gradients laid out, mile posts along them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railnav.geodesy.grid import GridFrame
from railnav.io.design import LARGEST_GAP, closing, lay
from railnav.io.drawn import lay_line
from railnav.io.railml_document import NetElement, Reader
from railnav.track.alignment import KnotTable
from railnav.track.assembly import TrackSection
from railnav.track.elements import (
    ARC,
    BLOSS,
    CLOTHOID,
    COSINE,
    CUBIC,
    SINE,
    STRAIGHT,
    Gradients,
    Plan,
    integrate,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
#: Kinds of curves that are read, by railML's name.
CURVES = {
    "straight": STRAIGHT,
    "arc": ARC,
    "clothoide": CLOTHOID,
    "curveBloss": BLOSS,
    "cosinusoide": COSINE,
    "sinusoide": SINE,
    "cubicParabola": CUBIC,
}


SAME_PLACE = 1e-6  # of intrinsic coordinates


def section(reader: Reader, frame: GridFrame, element: NetElement, geographic: bool, spacing: float) -> TrackSection:
    """One track: its curves where they cover it, else its drawn line; heights, chainage."""
    knots = None
    if element.curves and geographic:
        reader.note(f"net element {element.id}: curves on geographic coordinates are not laid; its drawn line counts")
    elif element.curves:
        knots = _laid(reader, frame, element, spacing)
    if knots is None:
        knots = lay_line(frame, element.point, spacing)
    posts = _posts(reader, element, float(knots.offset[-1]))
    return TrackSection(element.track, knots, element.line, element.name, posts=posts)


def _posts(reader: Reader, element: NetElement, length: float) -> FloatArray | None:
    """Offsets and chainages of the linear positioning system that has most marks on the net element."""
    systems = {system for _, system, _ in element.measures}
    if not systems:
        return None
    best = max(sorted(systems), key=lambda s: sum(system == s for _, system, _ in element.measures))
    marks = np.array(sorted({(at * length, value) for at, system, value in element.measures if system == best}))
    grown = abs(marks[-1, 1] - marks[0, 1])
    span = marks[-1, 0] - marks[0, 0]
    if len(marks) > 1 and span > 1.0 and 0.5e-3 < grown / span < 2e-3:
        marks[:, 1] *= 1e3
        reader.note(f"net element {element.id}: measures are kilometres, told from its length")
    elif len(marks) > 1 and span > 10.0 and not 0.5 < grown / span < 2.0:
        reader.note(f"net element {element.id}: measures grow {grown:g} on {span:.1f} m")
    return marks


def _laid(reader: Reader, frame: GridFrame, element: NetElement, spacing: float) -> KnotTable | None:
    """The curves of a net element laid out; None, with a note, where they do not lead along its points."""
    rows = sorted(element.curves, key=lambda row: row[:2])
    begin, end = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    holes = max(begin[0], 1.0 - end[-1], float(np.abs(begin[1:] - end[:-1]).max(initial=0.0)))
    drawn = float(np.hypot(*np.diff(element.point[:, :2], axis=0).T).sum())
    if holes * drawn > LARGEST_GAP + 1e-6 * drawn:
        reader.note(
            f"net element {element.id}: its curves leave {holes * drawn:.2f} m uncovered; its drawn line counts"
        )
        return None
    length = np.array([reader.number(row[3], "length", low=1e-3, high=1e6) for row in rows])
    plan = _plan(reader, element, rows, length)
    gap, _ = closing(plan, end=element.point[-1, :2])
    off = np.hypot(gap[:, 0], gap[:, 1])
    worst = int(off.argmax())
    if off[worst] > LARGEST_GAP:
        reader.note(
            f"net element {element.id}: its curves lead {off[worst]:.2f} m past its points (horizontalCurve "
            f"{rows[worst][3].get('id')!r}); its drawn line counts"
        )
        return None
    profile, breaks = _profile(reader, element, plan)
    laid = lay(frame, plan, gap=gap, profile=profile, breaks=breaks, spacing=spacing)
    return laid.tables[0]


def _plan(
    reader: Reader, element: NetElement, rows: Sequence[tuple[float, float, bool, Any]], length: FloatArray
) -> Plan:
    """Elements in order, each from the net element's own point where one stands at its begin, else from the last one's end."""
    n = len(rows)
    kind = np.array([CURVES[str(row[3].get("curveType"))] for row in rows], np.int64)
    sense = np.array([1.0 if row[2] else -1.0 for row in rows])
    radius = np.array([reader.number(row[3], "radius", 0.0) for row in rows]) * sense
    turned = [
        math.radians(reader.number(row[3], "deltaAzimuth", low=-720.0, high=720.0)) * s
        if row[3].get("deltaAzimuth")
        else None
        for row, s in zip(rows, sense, strict=True)
    ]
    for i in np.flatnonzero((kind == ARC) & (np.abs(radius) < 5.0)).tolist():
        reader.refuse(rows[i][3], f"radius is {radius[i]:g} m", "an arc has the radius of its circle, a straight has 0")
    bend = np.where(kind == STRAIGHT, 0.0, 1.0 / np.where(radius == 0.0, np.inf, radius))
    places = np.array([row[0] for row in rows])
    known = np.abs(element.at[:, None] - places[None, :]) < max(SAME_PLACE, 1e-7)
    start = np.full((n, 2), np.nan)
    for i in range(n):
        hits = np.flatnonzero(known[:, i])
        if len(hits):
            start[i] = element.point[hits[0], :2]
    start[0] = element.point[0, :2]
    stops = np.vstack([start[1:], element.point[-1, :2]])
    k0, k1, bearing, onward = np.empty(n), np.empty(n), np.empty(n), 0.0
    for i, (_, _, keeps, node) in enumerate(rows):
        if node.get("azimuth") is not None:
            bearing[i] = math.radians(reader.number(node, "azimuth", low=-720.0, high=720.0))
            if not keeps:
                bearing[i] += math.pi - (turned[i] or 0.0)
        elif i == 0:
            step = element.point[1, :2] - element.point[0, :2]
            bearing[0] = math.atan2(*step) - 0.5 * (turned[0] or bend[0] * length[0]) / max(len(element.at) - 1, 1)
        else:
            bearing[i] = onward
        choices = _ends(reader, i, kind, bend, turned, length, rows)
        one = None
        best = math.inf
        for a, b in choices:
            trial = Plan(
                length[i : i + 1], kind[i : i + 1], np.array([a]), np.array([b]),
                start[i : i + 1, 0], start[i : i + 1, 1], bearing[i : i + 1], np.zeros(1),
            )  # fmt: skip
            at, direction = integrate(trial, trial.edges)
            off = float(np.hypot(*(at[-1] - stops[i]))) if np.isfinite(stops[i]).all() else 0.0
            if one is None or off < best:
                one, best, k0[i], k1[i], onward = at[-1], off, a, b, float(direction[-1])
        if i + 1 < n and np.isnan(start[i + 1, 0]) and one is not None:
            start[i + 1] = one
    return Plan(length, kind, k0, k1, start[:, 0].copy(), start[:, 1].copy(), bearing, np.zeros(n))


def _ends(
    reader: Reader,
    i: int,
    kind: IntArray,
    bend: FloatArray,
    turned: Sequence[float | None],
    length: FloatArray,
    rows: Sequence[tuple[float, float, bool, Any]],
) -> list[tuple[float, float]]:
    """What the curvatures at both ends of a curve may be."""
    if kind[i] in (STRAIGHT, ARC):
        return [(float(bend[i]), float(bend[i]))]
    beside = [float(bend[j]) if 0 <= j < len(kind) and kind[j] in (STRAIGHT, ARC) else None for j in (i - 1, i + 1)]
    whole = turned[i]
    if whole is not None and bend[i] != 0.0 and kind[i] != CUBIC:
        other = 2.0 * whole / float(length[i]) - float(bend[i])
        other = 0.0 if abs(other) < 1e-9 else other
        either = [(float(bend[i]), other), (other, float(bend[i]))]
        # the one that goes on from its neighbours comes first: it counts where no point tells
        return sorted(
            either, key=lambda ends: sum(abs(k - b) for k, b in zip(ends, beside, strict=True) if b is not None)
        )
    first, last = beside
    if first is not None and last is not None:
        return [(first, last)]
    if bend[i] != 0.0 and kind[i] == CUBIC:
        return [(float(bend[i]), 0.0), (0.0, float(bend[i]))]
    if whole is not None and kind[i] != CUBIC and (first is not None or last is not None):
        rest = 2.0 * whole / float(length[i]) - (first if first is not None else last or 0.0)
        return [(first, rest)] if first is not None else [(rest, float(last or 0.0))]
    if bend[i] != 0.0 and (first is not None or last is not None):
        return [(first, float(bend[i]))] if first is not None else [(float(bend[i]), float(last or 0.0))]
    return reader.refuse(
        rows[i][3],
        "the curvatures at its ends are not known",
        "state its radius and deltaAzimuth, or a straight or arc on both sides",
    )


def _profile(reader: Reader, element: NetElement, plan: Plan) -> tuple[Any, FloatArray]:
    """Heights by grid length: gradient curves from the first height, or a spline through the heights of the points."""
    nothing = np.empty(0)
    total = float(plan.edges[-1])
    z = element.point[:, 2]
    have = np.isfinite(z)
    if not have.any():
        return None, nothing
    rows = sorted(element.gradients, key=lambda row: row[:2])
    along = element.at * total
    if rows and have[0] and rows[0][0] < SAME_PLACE and rows[-1][1] > 1.0 - SAME_PLACE:
        table = []
        height = float(z[0])
        for begin, end, keeps, node in rows:
            width = (end - begin) * total
            slope = reader.number(node, "gradient", 0.0, low=-500.0, high=500.0) * 1e-3
            change = reader.number(node, "deltaGradient", 0.0, low=-500.0, high=500.0) * 1e-3
            if not keeps:
                slope, change = -(slope + change), change
            if width < 1e-6:
                continue
            stated = np.flatnonzero(np.abs(element.at - begin) < SAME_PLACE)
            height = float(z[stated[0]]) if len(stated) and have[stated[0]] else height
            table.append((begin * total, begin * total, height, slope, 0.5 * change / width, 0.0))
            height += (slope + 0.5 * change) * width
        if (table and abs(height - float(z[-1])) < LARGEST_GAP) or not have[-1]:
            columns = np.array(table).T.copy()
            columns[0, 0] = -np.inf
            return Gradients(*columns), columns[1, 1:]
        reader.note(
            f"net element {element.id}: its gradients lead {abs(height - float(z[-1])):.2f} m past its last height; "
            "its heights count"
        )
    if not have.all():
        reader.note(f"net element {element.id}: heights are missing at some of its points; it has none")
        return None, nothing
    from scipy.interpolate import CubicSpline

    curve = CubicSpline(along, z) if len(z) > 2 else None
    if curve is None:
        grade = (z[1] - z[0]) / total
        return Gradients(*(np.array([v]) for v in (-np.inf, 0.0, z[0], grade, 0.0, 0.0))), nothing

    def spline(at: FloatArray, derivative: int = 0) -> FloatArray:
        return np.asarray(curve(np.clip(at, 0.0, total), derivative))

    return spline, nothing
