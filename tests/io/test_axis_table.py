"""Tables of alignment points: element laws, signs, joining by projection; Mannheim's trams; what is refused."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from railnav.errors import InputError, RailnavError
from railnav.io.axis_table import read_axis_table
from railnav.track.validation import validate

CRS = "EPSG:31467"
E0, N0 = 3_462_000.0, 5_481_000.0
HEADER = "n,s,ds,R,cl,tang,rw,hw"


@pytest.fixture
def read(tmp_path):
    def read_rows(*rows, header=HEADER):
        path = tmp_path / "axes.csv"
        path.write_text(
            "\n".join([header, *(row if isinstance(row, str) else ",".join(map(str, row)) for row in rows)]) + "\n"
        )
        return read_axis_table(path, crs=CRS)

    return read_rows


def arc(track, east, north, gon, length, radius):
    """Two rows of an arc: positive radius to the right of increasing azimuth."""
    a = gon * math.pi / 200
    b = a + length / radius
    end = east + radius * (math.cos(a) - math.cos(b)), north + radius * (math.sin(b) - math.sin(a))
    return [
        (track, 0.0, 0.0, radius, 0.0, gon, east, north),
        (track, length, length, radius, 0.0, b * 200 / math.pi, *end),
    ]


MAIN = [("M", 0.0, 0.0, 0.0, 0.0, 0.0, E0, N0), ("M", 200.0, 200.0, 0.0, 0.0, 0.0, E0, N0 + 200.0)]


@pytest.mark.parametrize("radius", [40.0, -40.0])
def test_a_radius_holds_from_its_row_and_is_positive_to_the_right(read, radius):
    model = read(*arc("A", E0, N0, 100.0, 50.0, radius))
    assert np.allclose(model.curvature, 1 / radius, rtol=2e-5)
    assert float(model.northing[-1] - N0) * radius < 0  # eastwards, then right is south
    assert model.provenance["import"]["largest_gap_m"] < 1e-9


def test_a_clothoid_runs_to_the_next_row(read):
    """A^2 = R L: end offset of L = 100 m, R = 600 m is 2.776 m (spec/track_geometry.md 3.1)."""
    rows = [
        ("A", 0.0, 0.0, 0.0, math.sqrt(60000), 0.0, E0, N0),
        ("A", 100.0, 100.0, 600.0, 0.0, 100 / 1200 * 200 / math.pi, E0 + 2.7755, N0 + 99.9306),
    ]
    model = read(*rows)
    assert model.provenance["import"]["largest_gap_m"] < 1e-3
    middle = model.at("A", model.length("A") / 2)
    assert float(middle.curvature) == pytest.approx(1 / 1200, rel=1e-4)
    assert (float(model.easting[-1]), float(model.northing[-1])) == pytest.approx((E0 + 2.7755, N0 + 99.9306), abs=1e-9)
    rows[0] = (*rows[0][:4], 250.0, *rows[0][5:])
    with pytest.raises(
        InputError, match=r"row 2, column cl: a clothoid of parameter 250 .* is 104.167 m long, not 100 m"
    ):
        read(*rows)


def test_ends_are_joined_by_projection_and_told(read):
    model = read(*MAIN, *arc("B", E0, N0 + 80.0, 0.0, 60.0, 50.0))
    assert model.track_id == ("M.1", "M.2", "B")
    (junction,) = model.provenance["import"]["joined"]
    assert (junction["track"], junction["end"], junction["on"]) == ("B", "start", "M")
    assert model.routes("M.1", "B")
    assert not model.routes("M.2", "B")
    assert float(model.at("M.2", 0.0).chainage) == pytest.approx(80.0, abs=1e-3)
    far = read(*MAIN, *arc("B", E0 + 0.2, N0 + 80.0, 0.0, 60.0, 50.0))
    assert far.track_id == ("M", "B")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({0: "M,0,0,3,0,0,3462000,5481000"}, "a radius of 3 m"),
        ({1: "M,200,199,0,0,0,3462000,5481200"}, "does not lead from the last s"),
        ({1: "M,200,200,0,0,0,3462001,5481200"}, r"ends 1.000 m from the next row of track 'M' \(row 3\)"),
        ({1: "M,200,200,0,0,5,3462000,5481200"}, "ends 4.50 degrees from the next row"),
        ({1: "M,-1,1,0,0,0,3462000,5481200"}, "do not grow"),
        ({1: "N,200,200,0,0,0,3462000,5481200"}, "'M' has one point only"),
        ({1: "M,0,0,0,0,0,3462000,5481000"}, "has no length"),
        ({0: "M,0,0,x,0,0,3462000,5481000"}, "column R"),
    ],
)
def test_what_is_refused(read, change, words):
    rows = {0: "M,0,0,0,0,0,3462000,5481000", 1: "M,200,200,0,0,0,3462000,5481200"} | change
    with pytest.raises(InputError, match=words):
        read(*rows.values())


def test_mutated_tables_never_trace_back(read):
    dice = random.Random(3)
    outcomes = {"read": 0, "refused": 0}
    for _ in range(200):
        rows = [[str(cell) for cell in row] for row in (*MAIN, *arc("B", E0, N0 + 80.0, 0.0, 60.0, 50.0))]
        for _ in range(dice.choice((1, 2))):
            dice.choice(rows)[dice.randrange(8)] = dice.choice(
                ["", "nan", "inf", "-1", "1e300", "0", "50", "x", '"', "M"]
            )
        try:
            read(*rows)
            outcomes["read"] += 1
        except RailnavError:
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 5, outcomes


def test_mannheim(shared_data):
    path = shared_data / "mannheim" / "mannheim_tracks.csv"
    if not path.is_file():
        pytest.skip("the Mannheim table is not here")
    model = read_axis_table(path, crs=CRS)
    told = model.provenance["import"]
    assert told["tracks"] == 147
    assert told["largest_gap_m"] < 2e-3
    assert len(told["joined"]) > 240
    assert np.percentile([junction["distance_m"] for junction in told["joined"]], 95) < 2e-3
    # nodes lie where the ends of the file do
    import csv

    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    edge = [
        r
        for i, r in enumerate(rows)
        if i in (0, len(rows) - 1) or rows[i - 1]["n"] != r["n"] or rows[i + 1]["n"] != r["n"]
    ]
    ends = np.array([[float(r["rw"]), float(r["hw"])] for r in edge])
    assert len(ends) == 294
    nodes = np.column_stack([model.nodes.easting, model.nodes.northing])
    apart = np.array([np.hypot(*(nodes - end).T).min() for end in ends])
    assert np.percentile(apart, 95) < 2e-3
    kinds = [defect.kind for defect in validate(model)]
    assert kinds.count("impossible turnout") <= 2
    assert kinds.count("gap") == kinds.count("inconsistent knots") == 0
