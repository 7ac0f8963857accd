"""The bundled model: a fictitious double line, laid out from alignment elements every time it is asked for.

25 km of double track (line 77, right-hand running, tracks 4.0 m apart), crossovers at both ends, a station with four tracks and
crossovers in both throats, a single-track branch (line 78) to a buffer stop, two tunnels, cant to 140 mm, gradients to 12.5 per
mille (18 on the branch), and a jump of 380 m in the chainage. Nothing of it exists; `track_models/demo_line.md` describes it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from railnav.simulation.layout import (
    Element,
    PlacedAxis,
    Profile,
    connecting_track,
    curve,
    parallel_track,
    place_axis,
    turnout_connection,
)
from railnav.track.assembly import TrackSection, assemble
from railnav.track.model import NodeKind

if TYPE_CHECKING:
    from railnav.geodesy.grid import GridFrame
    from railnav.track.alignment import KnotTable
    from railnav.track.model import TrackModel

FloatArray = NDArray[np.float64]

LINE, BRANCH = "77", "78"
#: Length of the axis between the two main tracks, m.
LENGTH = 25_000.0
#: Distance between the main tracks' centre lines, m.
TRACK_DISTANCE = 4.0
#: Distance of the station's outer tracks from the main ones, m.
PLATFORM_DISTANCE = 5.0
#: Chainage at the start; and the jump: station of the axis, metres gained.
FIRST_CHAINAGE, JUMP_AT, JUMP = 40_000.0, 16_000.0, 380.0
#: Name and stations of the axis between which there is no sky.
TUNNELS = (("Summit tunnel", 6_300.0, 7_500.0), ("Bend tunnel", 18_200.0, 18_960.0))
#: Where the line lies: geodetic degrees and grid bearing of its start.
START_LATITUDE_DEG, START_LONGITUDE_DEG, START_BEARING_DEG, START_HEIGHT = 50.62, 10.90, 62.0, 212.0

#: Stations of the axis where connections begin.
_CROSSOVERS = (800.0, 920.0, 11_000.0, 11_120.0, 12_640.0, 12_760.0, 23_900.0, 24_020.0)
_LOOP_BEGIN, _LOOP_PARALLEL, _BRANCH_BEGIN, _BRANCH_LENGTH = 11_240.0, 1_150.0, 12_960.0, 4_000.0


def _main_elements() -> list[Element]:
    """Plan of the axis between the main tracks."""
    bends: list[tuple[float | None, list[Element]]] = [  # station where the bend begins (None: at once), its elements
        (1_800.0, curve(1200.0, 650.0, transition=110.0, cant=0.095)),
        (3_700.0, curve(-800.0, 520.0, transition=140.0, cant=0.120)),
        (None, curve(900.0, 430.0, transition=130.0, cant=0.110)),  # reversing curve without a straight
        (6_100.0, curve(-2500.0, 900.0, transition=60.0, cant=0.040)),
        (8_300.0, curve(600.0, 380.0, transition=150.0, cant=0.140)),
        (9_600.0, curve(-650.0, 560.0, transition=140.0, cant=0.135)),
        (13_400.0, _compound_curve()),
        (16_600.0, curve(1500.0, 800.0, transition=90.0, cant=0.070)),
        (18_300.0, curve(850.0, 480.0, transition=130.0, cant=0.115)),
        (20_000.0, curve(-1800.0, 700.0, transition=80.0, cant=0.055)),
        (22_100.0, curve(750.0, 420.0, transition=140.0, cant=0.125)),
    ]
    elements: list[Element] = []
    done = 0.0
    for begin, bend in bends:
        if begin is not None:
            elements.append(Element(begin - done))
            done = begin
        elements += bend
        done += sum(e.length for e in bend)
    return [*elements, Element(LENGTH - done)]


def _compound_curve() -> list[Element]:
    """Two arcs of one sense, joined by a clothoid between their radii."""
    a, b, cant_a, cant_b = -1.0 / 1000.0, -1.0 / 700.0, -0.090, -0.130
    return [
        Element(120.0, 0.0, a, 0.0, cant_a),
        Element(300.0, a, a, cant_a, cant_a),
        Element(60.0, a, b, cant_a, cant_b),
        Element(350.0, b, b, cant_b, cant_b),
        Element(140.0, b, 0.0, cant_b, 0.0),
    ]


def _main_profile() -> Profile:
    grades = [
        (0.0, 0.002),
        (1_500.0, 0.0085),
        (4_200.0, 0.012),
        (6_700.0, -0.004),
        (8_200.0, -0.0125),
        (10_700.0, -0.001),
        (13_300.0, 0.006),
        (15_500.0, -0.005),
        (17_500.0, 0.0105),
        (19_600.0, -0.009),
        (22_400.0, 0.0015),
    ]
    return Profile.of(START_HEIGHT, grades, radius=8000.0)


def _branch_elements() -> list[Element]:
    """Plan of the branch from the toe of its turnout 1:12 R=500 in the right main track."""
    bend, ramp = 1.0 / 500.0, 2.0
    toe = [
        Element(ramp, 0.0, bend),
        Element(500.0 * math.atan(1.0 / 12.0) - ramp, bend, bend),
        Element(ramp, bend, 0.0),
    ]
    elements = [
        *toe,
        *curve(500.0, 420.0, transition=90.0, cant=0.100, straight_before=120.0),
        *curve(-400.0, 300.0, transition=100.0, cant=0.110, straight_before=700.0),
        *curve(650.0, 250.0, transition=80.0, cant=0.080, straight_before=800.0),
    ]
    return [*elements, Element(_BRANCH_LENGTH - sum(e.length for e in elements))]


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    """A section with the axis's station of its knots and its distance from the axis."""

    section: TrackSection
    station: FloatArray


def _posts(knots: KnotTable, station: FloatArray, chainage: FloatArray) -> FloatArray:
    """Hectometre posts: (offset, chainage) at the ends and at every hundred metres of chainage, (p, 2)."""
    inner = np.arange(math.ceil(chainage[0] / 100.0 + 1e-9), math.ceil(chainage[-1] / 100.0 - 1e-9)) * 100.0
    at = np.interp(inner, chainage, station)
    offset = np.interp(at, station, knots.offset)
    return np.column_stack(
        [
            np.concatenate([[0.0], offset, knots.offset[-1:]]),
            np.concatenate([chainage[:1], inner, chainage[-1:]]),
        ]
    )


def _section(track: str, name: str, knots: KnotTable, station: FloatArray) -> _Piece:
    chainage = FIRST_CHAINAGE + station + (JUMP if station[0] >= JUMP_AT - 1e-6 else 0.0)
    return _Piece(TrackSection(track, knots, line=LINE, name=name, posts=_posts(knots, station, chainage)), station)


def _main_track(placed: PlacedAxis, side: str, lateral: float, cuts: list[float], spacing: float) -> list[_Piece]:
    """One main track, cut into sections where something joins it."""
    name = f"{'right' if side == 'R' else 'left'} main track"
    edges = [0.0, *sorted(cuts), LENGTH]
    pieces = []
    for i, (a, b) in enumerate(itertools.pairwise(edges)):
        knots, station = parallel_track(placed, a, b, lateral, spacing=spacing)
        pieces.append(_section(f"{LINE}{side}-{i + 1:02d}", name, knots, station))
    return pieces


def _tunnels(pieces: list[_Piece]) -> list[dict[str, Any]]:
    """Stretches of the main tracks in tunnels, by offset."""
    found = []
    for name, begin, end in TUNNELS:
        for piece in pieces:
            a, b = max(begin, piece.station[0]), min(end, piece.station[-1])
            if a < b:
                offset = np.interp([a, b], piece.station, piece.section.knots.offset)
                found.append(
                    {
                        "name": name,
                        "track": piece.section.track_id,
                        "from_m": round(float(offset[0]), 3),
                        "to_m": round(float(offset[1]), 3),
                    }
                )
    return found


def demo_line(*, spacing: float = 1.0, frame: GridFrame | None = None) -> TrackModel:
    """Lay out the bundled fictitious line; the same model every time.

    Main tracks "77R-01", "77R-02", ... (toward growing chainage on the right) and "77L-01", ...; crossovers "77X-01" to "77X-08"
    (odd: right to left, even: left to right, toward growing chainage); station tracks "77S-1" (right) and "77S-4" (left);
    branch "78-01".

    Parameters
    ----------
    spacing : float
        Longest distance between knots, m.
    frame : GridFrame, optional
        Another plane than the Gauss-Krueger zone of the line.

    Returns
    -------
    TrackModel
        `provenance["tunnels"]` lists stretches without sky: {name, track, from_m, to_m}, offsets in metres.

    Notes
    -----
    Main tracks exactly 4.0 m apart on the ground; turnouts 1:9 R=300 m (station) and 1:12 R=500 m (line and branch), whose
    branches leave and arrive tangentially; steps of curvature run over 2 m. 57,000 knots in about 0.4 s.

    Examples
    --------
    >>> model = demo_line(spacing=25.0)
    >>> model.line[model.track_index("78-01")], round(model.length("78-01"))
    ('78', 4000)
    """
    if frame is None:
        from railnav.geodesy.grid import choose_frame

        frame = choose_frame(math.radians(START_LATITUDE_DEG), math.radians(START_LONGITUDE_DEG))
    e0, n0, *_ = frame.to_grid(math.radians(START_LATITUDE_DEG), math.radians(START_LONGITUDE_DEG), START_HEIGHT)
    placed = place_axis(
        frame,
        _main_elements(),
        _main_profile(),
        easting=float(e0),
        northing=float(n0),
        grid_bearing=math.radians(START_BEARING_DEG),
    )
    half = 0.5 * TRACK_DISTANCE

    cuts: dict[str, list[float]] = {"R": [JUMP_AT, _BRANCH_BEGIN], "L": [JUMP_AT]}
    others: list[_Piece] = []
    for i, begin in enumerate(_CROSSOVERS):
        from_right = i % 2 == 0
        in_station = 2 <= i <= 5
        elements = turnout_connection(
            -TRACK_DISTANCE if from_right else TRACK_DISTANCE,
            number=9 if in_station else 12,
            radius=300.0 if in_station else 500.0,
        )
        knots, station = connecting_track(placed, begin, half if from_right else -half, elements, spacing=spacing)
        others.append(_section(f"{LINE}X-{i + 1:02d}", "crossover", knots, station))
        cuts["R"].append(float(station[0] if from_right else station[-1]))
        cuts["L"].append(float(station[-1] if from_right else station[0]))
    for track, side, sign in (("1", "R", 1.0), ("4", "L", -1.0)):
        elements = turnout_connection(sign * PLATFORM_DISTANCE, number=9, radius=300.0, parallel=_LOOP_PARALLEL)
        knots, station = connecting_track(placed, _LOOP_BEGIN, sign * half, elements, spacing=spacing)
        others.append(_section(f"{LINE}S-{track}", f"station track {track}", knots, station))
        cuts[side] += [float(station[0]), float(station[-1])]

    right = _main_track(placed, "R", half, cuts["R"], spacing)
    left = _main_track(placed, "L", -half, cuts["L"], spacing)
    branch = _branch(placed, right, spacing)
    mains = [*right, *left]
    model = assemble(
        frame,
        [piece.section for piece in [*mains, *others]] + [branch],
        provenance={
            "source": "railnav.simulation.demo_line: a fictitious line, laid out from alignment elements",
            "simulated": True,
            "licence": "Apache-2.0",
            "tunnels": _tunnels(mains),
            "balises": _balises([*(piece.section for piece in mains), branch]),
        },
    )
    kind = model.nodes.kind.copy()
    kind[model.end_node[model.track_index(branch.track_id)]] = NodeKind.BUFFER_STOP
    return replace(model, nodes=replace(model.nodes, kind=kind))


def _balises(sections: list[TrackSection]) -> list[dict[str, Any]]:
    """A balise every 1,500 m of each track of the main lines and the branch, from 400 m on."""
    return [
        {"id": f"B-{section.track_id}-{k + 1}", "track": section.track_id, "offset_m": float(offset)}
        for section in sections
        for k, offset in enumerate(np.arange(400.0, float(section.knots.offset[-1]) - 100.0, 1_500.0))
    ]


def _branch(placed: PlacedAxis, right: list[_Piece], spacing: float) -> TrackSection:
    """The branch, from the toe of its turnout in the right main track to the buffer stop."""
    toe = next(p for p in right if abs(p.station[0] - _BRANCH_BEGIN) < 1e-6).section.knots
    gradient = float(toe.gradient[0])
    profile = Profile.of(
        float(toe.height[0]), [(0.0, gradient), (300.0, 0.018), (2_600.0, 0.004), (3_700.0, 0.0)], radius=5000.0
    )
    axis = place_axis(
        placed.frame,
        _branch_elements(),
        profile,
        easting=float(toe.easting[0]),
        northing=float(toe.northing[0]),
        grid_bearing=float(toe.grid_bearing[0]),
    )
    knots, station = parallel_track(axis, 0.0, _BRANCH_LENGTH, 0.0, spacing=spacing)
    return TrackSection(f"{BRANCH}-01", knots, line=BRANCH, name="branch", posts=_posts(knots, station, station))
